"""What a pixel costs, by size: restoring N log N work at 256 to 4096 a side.

python benchmarks/scaling.py [--device D] [--json FILE] [--plot FILE]

All sizes take turns in one process; a size's time is the median of its rounds. If only the arithmetic
counted, ns per pixel and level of the transforms, the last column, would be one number.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import numpy as np

from adof_cl.device import Device
from adof_cl.restore import Restore
from adof_cl.turns import Rounds, take_turns

SIDES = (256, 384, 512, 768, 1024, 1536, 2048, 3072, 4096)
KINDS = {"float32": (np.float32, None), "uint8": (np.uint8, None), "uint8, halves": (np.uint8, np.float16)}


def contender(device: Device, side: int, kind: str) -> tuple[object, float]:
    dtype, spectrum = KINDS[kind]
    plan = Restore(device, (side, side), in_dtype=dtype, out_dtype=dtype, spectrum_dtype=spectrum)
    axis = np.exp(-3 * np.abs(np.fft.fftfreq(side)))
    plan.set_filter_axes(axis, axis, 0.01)
    frame = device.upload(np.random.default_rng(1).integers(0, 255, (side, side)).astype(dtype))
    out = device.empty((side, side), dtype)
    repeats = max(1, (1024 // side) ** 2)  # a timed call is never much shorter than the longest

    def run() -> None:
        for _ in range(repeats):
            plan(frame, out)
        device.wait()

    return run, float(repeats)


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("--device", help="index, type or part of a name")
    parser.add_argument("--json", type=Path, help="write the table as JSON")
    parser.add_argument("--plot", type=Path, help="draw ns per pixel against the side")
    options = parser.parse_args()
    device = Device.open(options.device)
    print(f"{device.facts}\n{'':16}" + "".join(f"{kind:>28}" for kind in KINDS))
    print(f"{'side':>8}{'MiB moved':>10}" + f"{'ms':>10}{'ns/px':>8}{'per level':>10}" * len(KINDS))
    table: dict[str, dict[int, float]] = {kind: {} for kind in KINDS}
    cases = [(kind, side) for kind in KINDS for side in SIDES]
    runs = [contender(device, side, kind) for kind, side in cases]
    times = take_turns([run for run, _ in runs], Rounds(7, 15, 40.0))  # type: ignore[misc]
    for (kind, side), (_, repeats), seconds in zip(cases, runs, times, strict=True):
        table[kind][side] = float(np.median(seconds)) / repeats
    for side in SIDES:
        cells = []
        for kind in KINDS:
            seconds = table[kind][side]
            pixel = 1e9 * seconds / side**2
            cells.append(f"{1e3 * seconds:10.3f}{pixel:8.2f}{pixel / (2 * math.log2(side)):10.3f}")
        print(f"{side:8}{12 * side**2 / 2**20:10.1f}" + "".join(cells))
    if options.json:
        found = {"device": device.facts.as_dict(), "seconds": table}
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    if options.plot:
        draw(table, str(device.facts), device.facts.cache_bytes, options.plot)


def draw(table: dict[str, dict[int, float]], title: str, cache_bytes: int, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    for kind, times in table.items():
        sides = np.array(list(times))
        axes.plot(sides, 1e9 * np.array(list(times.values())) / sides**2, "o-", label=kind)
    if cache_bytes:
        # frame, spectrum and image in float32
        axes.axvline(math.sqrt(cache_bytes / 12), color="grey", linewidth=0.8, linestyle="--")
        axes.annotate("largest cache, float32", (math.sqrt(cache_bytes / 12), 0), rotation=90, fontsize=8)
    axes.set_xscale("log", base=2)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("side of the frame, pixels")
    axes.set_ylabel("ns per pixel")
    axes.set_title(f"restore on {title}", fontsize=10)
    axes.grid(linewidth=0.4)
    axes.legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
