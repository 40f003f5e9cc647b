"""Write the headline table into README.md from benchmarks/results/*.json.

python benchmarks/headline.py            rewrites the block between the <!-- bench --> marks
python benchmarks/headline.py --check    exits 1 if the block is not what the files say
"""

from __future__ import annotations

import sys
from pathlib import Path

from adof_cl.bench import Report, Result
from adof_cl.turns import Spread

TREE = Path(__file__).parents[1]
MARK, END = "<!-- bench -->", "<!-- /bench -->"
PEERS = {"pyfftw": "FFTW", "mkl_fft": "MKL", "scipy": "scipy.fft", "opencv": "OpenCV", "pyvkfft": "VkFFT"}
CHOSEN = {
    ("restore", "float32"),
    ("ssd_search", "4 templates"),
    ("ssd_search", "16 templates"),
    ("chain", "4 searches"),
}
NAMES = {"ssd_search": "search,", "chain": "frame to places,"}


def shown(ratio: Spread) -> str:
    """With its quartiles where these are so far apart that the median alone would mislead."""
    wide = ratio.high > 2 * ratio.low
    return f"{ratio.median:.1f}" + (f" ({ratio.low:.1f}-{ratio.high:.1f})" if wide else "")


def row(result: Result, peers: list[str]) -> str:
    ratios = {peer.name: peer.ratio for peer in result.peers}
    name = (
        f"{NAMES.get(result.operation, result.operation)} {result.form}, {result.size[0]} × {result.size[1]}"
    )
    cells = [shown(ratios[peer]) if peer in ratios else "" for peer in peers]
    wall = result.wall_s
    times = f"{1e3 * wall.median:.2f} ({1e3 * wall.low:.2f}-{1e3 * wall.high:.2f})"
    return f"| {name} | {times} | {result.per_s:.0f} | {' | '.join(cells)} |"


def table(report: Report) -> str:
    chosen = [result for result in report.results if (result.operation, result.form) in CHOSEN]
    present = {peer.name for result in chosen for peer in result.peers}
    peers = [name for name in PEERS if name in present]
    load = report.machine["load_at_start"], report.machine["load_at_end"]
    lines = [
        f"**{report.device['platform']}** {report.device['driver_version']}, {report.machine['processor']}, "
        f"{report.machine['cores']} cores, {report.when[:10]}; load average {load[0][0]:.1f} at the start, "
        f"{load[1][0]:.1f} at the end",
        "",
        "| | ms (quartiles) | per s | " + " | ".join(f"{PEERS[name]} ÷ ours" for name in peers) + " |",
        "|---|---|---|" + "---|" * len(peers),
        *(row(result, peers) for result in chosen),
    ]
    return "\n".join(lines)


def block() -> str:
    reports = [Report.read(path) for path in sorted((TREE / "benchmarks" / "results").glob("*.json"))]
    introduction = (
        "`adof bench` checks every result against float64, then lets ours and other libraries take turns "
        "in one process; a ratio above 1 means ours is faster. Where the machine has other work to do, "
        "threads that wait for each other suffer most (FFTW's); brackets are quartiles. "
        "[benchmarks/](benchmarks/README.md) says how it was measured and keeps every number."
    )
    reports.sort(key=lambda report: report.device["platform"] != "Portable Computing Language")  # the default
    return "\n\n".join([MARK, introduction, *(table(report) for report in reports), END])


def main() -> int:
    readme = TREE / "README.md"
    text = readme.read_text(encoding="utf-8")
    if text.count(MARK) != 1 or text.count(END) != 1:
        print(f"README.md wants one {MARK} and one {END}")
        return 1
    start, stop = text.index(MARK), text.index(END) + len(END)
    wanted = text[:start] + block() + text[stop:]
    if "--check" in sys.argv:
        if wanted != text:
            print("README.md does not hold the table of benchmarks/results: run benchmarks/headline.py")
        return int(wanted != text)
    readme.write_text(wanted, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
