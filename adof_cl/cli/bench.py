"""`adof bench`: how fast each operation is here, beside other libraries."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adof_cl.cli.devices import DeviceOption

if TYPE_CHECKING:
    from adof_cl.bench import Comparison, Report, Result
    from adof_cl.peers import Peer
    from adof_cl.turns import Case


def bench(
    quick: Annotated[
        bool, typer.Option("--quick", help="Small sizes and few rounds: whether it works, not how fast.")
    ] = False,
    ops: Annotated[
        str | None,
        typer.Option("--ops", metavar="A,B", help="Operations; default: all, and the frame chain."),
    ] = None,
    sizes: Annotated[
        str | None,
        typer.Option("--sizes", metavar="CxR,...", help="Columns x rows, such as 512x400,1024x1024."),
    ] = None,
    peers: Annotated[
        str,
        typer.Option("--peers", metavar="P", help="auto (what is installed), none, or names with commas."),
    ] = "auto",
    as_file: Annotated[Path | None, typer.Option("--json", help="Write the results to this file.")] = None,
    compare: Annotated[
        Path | None, typer.Option("--compare", help="Say what moved since the results in this file.")
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Draw the ratios: PNG, SVG or PDF.")] = None,
    device: DeviceOption = None,
) -> None:
    """Time every operation, checked against float64; exits 1 if a result is wrong.

    Example: adof bench --ops restore,chain --json mine.json --compare benchmarks/results/pocl.json
    """
    import sys

    from adof_cl import bench as timing
    from adof_cl import bench_cases
    from adof_cl.cli.progress import Live
    from adof_cl.device import Device
    from adof_cl.peers import installed

    old = timing.Report.read(compare) if compare is not None else None
    cases = bench_cases.select(_names(ops), bench_cases.parse_sizes(sizes) if sizes else None, quick=quick)
    others = installed(peers)
    if plot is not None:
        _require_drawable(plot, cases, others)
    for path in (as_file, plot):
        _require_place(path)
    opened = Device.open(device)
    with Live(
        f"{opened.facts}: {len(cases)} cases, peers: {', '.join(p.name for p in others) or 'none'}"
    ) as live:
        report = timing.run(opened, cases, others, quick=quick, tell=live.tell)
    _print(report)
    if as_file is not None:
        from adof_cl.files import whole_file

        with whole_file(as_file) as path:
            path.write_text(report.to_json(), encoding="utf-8")
    if plot is not None:
        _draw(report, plot)
    if old is not None:
        _print_changes(timing.compare(old, report))
    for failure in report.failures:
        print(f"FAILED {failure.case}, {failure.who}: {failure.reason}", file=sys.stderr)
    if report.failures:
        raise typer.Exit(1)


def _names(ops: str | None) -> list[str] | None:
    return [name.strip() for name in ops.split(",")] if ops is not None else None


def _print(report: Report) -> None:
    from rich.table import Table

    from adof_cl.cli.tables import print_table

    load = report.machine["load_at_start"]
    print(f"adof-cl {report.version} on {report.device['name']} ({report.device['platform']}), {report.when}")
    print(
        f"copies {report.copy_gbyte_per_s:.1f} GB/s; {report.machine['cores']} cores"
        + (f", load {load[0]:.1f} at the start" if load else "")
    )
    table = Table(box=None, header_style="bold")
    headings = (
        "",
        "ms",
        "quartiles",
        "kernels ms",
        "per s",
        "Mpixel/s",
        "GB/s",
        "of copy",
        "error",
        "first s",
    )
    for heading in headings:
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for result in report.results:
        wall, event, first = result.wall_s, result.event_s, result.first_call
        table.add_row(
            result.name,
            f"{1e3 * wall.median:.3f}",
            f"{1e3 * wall.low:.3f}-{1e3 * wall.high:.3f}",
            f"{1e3 * event.median:.3f}" if event else "-",
            f"{result.per_s:.0f}",
            f"{result.mpixel_per_s:.1f}",
            f"{result.gbyte_per_s:.1f}",
            f"{100 * result.copy_share:.0f} %",
            f"{result.error:.1e}",
            f"{first.cold_s:.2f} / {first.warm_s:.3f}" if first else "-",
        )
    print_table(table)
    compared = [result for result in report.results if result.peers]
    if not compared:
        return
    print("\ntheir time over ours, median of the rounds' ratios [quartiles]")
    table = Table(box=None, header_style="bold")
    names = _peer_names(compared)
    for heading in ("", *names):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for result in compared:
        ratios = {peer.name: peer.ratio for peer in result.peers}
        cells = [
            f"{ratios[name].median:.2f} \\[{ratios[name].low:.2f}-{ratios[name].high:.2f}]"
            if name in ratios
            else ""
            for name in names
        ]
        table.add_row(result.name, *cells)
    print_table(table)


def _peer_names(results: list[Result]) -> list[str]:
    return list(dict.fromkeys(peer.name for result in results for peer in result.peers))


def _print_changes(found: Comparison) -> None:
    print("\nmoved by more than the noise (the quartile ranges of the two runs do not overlap):")
    if not found.same_device:
        print("  the two runs are of different devices or drivers")
    for change in found.changes:
        if change.is_ratio:
            word = "better" if change.factor > 1 else "worse"
            sizes = f"{change.old.median:.2f} -> {change.new.median:.2f}"
        else:
            word = "faster" if change.factor < 1 else "slower"
            sizes = f"{1e3 * change.old.median:.3f} -> {1e3 * change.new.median:.3f} ms"
        times = max(change.factor, 1 / change.factor)
        print(f"  {times:5.2f} times {word}: {change.what}, {sizes}")
    if not found.changes:
        print("  nothing")
    print(f"  {found.unchanged} others did not; median time of all, new over old: {found.drift:.2f}")
    for title, names in (("only in the old run", found.only_old), ("only in the new run", found.only_new)):
        if names:
            print(f"  {title}: {', '.join(names)}")


def _require_drawable(path: Path, cases: list[Case], peers: list[Peer]) -> None:
    from adof_cl.errors import InputError

    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError(f"the plot's name is '{path.name}': one ending in .png, .svg or .pdf was wanted")
    if not any(case.rivals(peers) for case in cases):
        raise InputError("there is no ratio to draw: time some peers, or leave --plot out")


def _require_place(path: Path | None) -> None:
    """Refuse a folder that is not there now, not after minutes of timing."""
    from adof_cl.errors import InputError

    if path is not None and not path.parent.is_dir():
        raise InputError(f"{path} cannot be written (no such folder): choose another place")


def _draw(report: Report, path: Path) -> None:
    """Draw one bar for each peer of each case, with its quartiles, on a logarithmic axis."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    from adof_cl.files import whole_file

    compared = [result for result in report.results if result.peers]
    if not compared:  # every peer failed, which is said
        return
    names = _peer_names(compared)
    colours = {name: f"C{index}" for index, name in enumerate(names)}
    rows = sum(len(result.peers) for result in compared)
    figure = Figure(figsize=(8.0, 1.2 + 0.17 * rows + 0.12 * len(compared)), layout="constrained")
    axes = figure.add_subplot()
    place, ticks = 0.0, []
    for result in compared:
        start = place
        for peer in result.peers:
            spread = peer.ratio
            axes.barh(place, spread.median - 1, left=1, height=0.9, color=colours[peer.name])
            axes.plot([spread.low, spread.high], [place, place], color="black", linewidth=1)
            place += 1
        ticks.append((start + place - 1) / 2)
        place += 0.7
    for name, colour in colours.items():
        axes.barh(0, 0, color=colour, label=name)
    axes.set_xscale("log")
    axes.axvline(1, color="black", linewidth=0.8)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _position: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_yticks(ticks, [result.name for result in compared])
    axes.invert_yaxis()
    axes.margins(y=0.01)
    axes.grid(axis="x", linewidth=0.4)
    axes.set_axisbelow(True)
    axes.set_xlabel("their time over ours: right of 1, ours is faster (line: quartiles)")
    axes.set_title(
        f"adof-cl {report.version} on {report.device['platform']}, {report.when[:10]}", fontsize=10
    )
    figure.legend(fontsize=8, ncols=4, loc="outside lower center", frameon=False)
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)
