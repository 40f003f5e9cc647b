"""`adof envelope`: how far inputs may go on the chosen device, what is refused, and the errors measured."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adof_cl.cli.devices import DeviceOption

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

    from adof_cl.device import DeviceFacts
    from adof_cl.envelope import Outcome


def envelope(
    quick: Annotated[
        bool, typer.Option("--quick", help="A share of each range: whether it holds, in seconds.")
    ] = False,
    as_file: Annotated[Path | None, typer.Option("--json", help="Write every point to this file.")] = None,
    table: Annotated[
        Path | None, typer.Option("--table", help="Write the table to this Markdown file.")
    ] = None,
    plots: Annotated[
        Path | None, typer.Option("--plots", metavar="DIR", help="Draw error against input into this folder.")
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Measure errors at the extremes of every input; exits 1 where a promise is broken.

    Example: adof envelope --device cpu --plots envelope --json envelope.json
    """
    import json
    from dataclasses import asdict

    from adof_cl import envelope as rows
    from adof_cl.cli.bench import _require_place
    from adof_cl.cli.progress import Live
    from adof_cl.device import Device
    from adof_cl.files import whole_file
    from adof_cl.record import finite_json

    for path in (as_file, table, plots):
        _require_place(path)
    opened = Device.open(device)
    outcomes: list[Outcome] = []
    print(f"{'':6}{'error':>9}{'bound':>10}  {'points':>6} {'refused':>7}  where")
    with Live(f"{opened.facts}: {len(rows.ROWS)} rows") as live:
        for outcome in rows.run(opened, quick=quick):
            outcomes.append(outcome)
            live.tell(outcome.row.name, outcome.storage)
            print(_line(outcome), flush=True)
            for point in outcome.points:
                if not point.ok:
                    print(
                        f"      {point.at}: error {point.error:.2g}, bound {point.bound:.2g} {point.failure}"
                    )
    if as_file is not None:
        found = {
            "device": opened.facts.as_dict(),
            "rows": [
                {
                    "name": o.row.name,
                    "storage": o.storage,
                    "ok": o.ok,
                    "measure": o.row.measure,
                    "axis": o.row.axis,
                    "points": [asdict(point) for point in o.points],
                }
                for o in outcomes
            ],
        }
        with whole_file(as_file) as path:
            path.write_text(json.dumps(finite_json(found), indent=1), encoding="utf-8")
    if table is not None:
        with whole_file(table) as path:
            path.write_text(markdown(opened.facts, outcomes), encoding="utf-8")
    if plots is not None:
        plots.mkdir(exist_ok=True)
        draw(opened.facts, outcomes, plots)
    failed = [outcome for outcome in outcomes if not outcome.ok]
    points = sum(len(outcome.points) for outcome in outcomes)
    print(f"{points} points in {len(outcomes)} rows, {len(failed)} rows failed")
    if failed:
        raise typer.Exit(1)


def _line(outcome: Outcome) -> str:
    worst = outcome.worst
    numbers = f"{worst.error:9.1e}{worst.bound:10.1e}" if worst else f"{'-':>9}{'-':>10}"
    where = f"{outcome.row.name}, {outcome.storage}: {outcome.row.measure}"
    if worst:
        where += f" at {outcome.row.axis} {_place(worst.at)}"
    counts = f"{len(outcome.points):6} {outcome.refusals:7}"
    return f"{'ok' if outcome.ok else 'FAILED':6}{numbers}  {counts}  {where}"


def _place(at: float | str) -> str:
    return at if isinstance(at, str) else f"{at:g}"


def markdown(facts: DeviceFacts, outcomes: list[Outcome]) -> str:
    """Return the promises once, and below them what this device measured."""
    rows = list(dict.fromkeys(outcome.row for outcome in outcomes))
    lines = [
        f"## {facts.platform}, {facts.driver_version}",
        "",
        f"{facts.name}. `adof envelope --table FILE` writes this table for any device.",
        "",
        "| row | domain | promise | refused | bound |",
        "|---|---|---|---|---|",
        *(
            f"| {_cell(r.name)} | {_cell(r.domain)} | {_cell(r.promise)} | {_cell(r.refusal)} | "
            f"{_cell(r.derivation)} |"
            for r in rows
        ),
        "",
        "| row | in | points | refused | measure | worst error | its bound | at | holds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for outcome in outcomes:
        worst = outcome.worst
        numbers = (
            f"{worst.error:.1e} | {worst.bound:.1e} | {_cell(_place(worst.at))}" if worst else "- | - | -"
        )
        lines.append(
            f"| {outcome.row.name} | {outcome.storage} | {len(outcome.points)} | {outcome.refusals} | "
            f"{_cell(outcome.row.measure)} | {numbers} | {'yes' if outcome.ok else '**no**'} |"
        )
    cases = [
        f"| {outcome.row.name} | {outcome.storage} | {_cell(_place(p.at))} | {p.error:.1e} | {p.bound:.1e} |"
        for outcome in outcomes
        if outcome.row.axis == "case"
        for p in outcome.points
        if not p.refused
    ]
    if cases:
        lines += ["", "| row | in | case | error | its bound |", "|---|---|---|---|---|", *cases]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def draw(facts: DeviceFacts, outcomes: list[Outcome], folder: Path) -> list[Path]:
    """Draw every row whose points lie on a number's axis: errors as dots, the bound as a line.

    One picture for each row, and `envelope.png` with all of them.
    """
    from matplotlib.figure import Figure

    from adof_cl.files import whole_file

    def write(figure: Figure, name: str) -> Path:
        path = folder / f"{name}.png"
        with whole_file(path) as temporary:
            figure.savefig(temporary, dpi=110)
        return path

    names = dict.fromkeys(outcome.row.name for outcome in outcomes)
    rows = [[outcome for outcome in outcomes if outcome.row.name == name] for name in names]
    drawn = [shown for shown in rows if any(len(_answers(outcome)) > 1 for outcome in shown)]
    paths = []
    for shown in drawn:
        figure = Figure(figsize=(7.5, 4.2), layout="constrained")
        _panel(figure.add_subplot(), shown)
        figure.suptitle(f"{shown[0].row.name}, {facts.platform}", fontsize=10)
        figure.legend(*_marks(shown), fontsize=8, loc="outside lower center", ncols=4)
        paths.append(write(figure, shown[0].row.name))
    if drawn:
        across = min(3, len(drawn))
        down = -(-len(drawn) // across)
        figure = Figure(figsize=(5.2 * across, 3.2 * down + 0.8), layout="constrained")
        for index, shown in enumerate(drawn):
            axes = figure.add_subplot(down, across, index + 1)
            _panel(axes, shown)
            axes.set_title(shown[0].row.name, fontsize=10)
        figure.suptitle(f"Errors and their bounds: {facts.platform}, {facts.driver_version}")
        figure.legend(*_marks(outcomes), fontsize=9, loc="outside lower center", ncols=4)
        paths.append(write(figure, "envelope"))
    return paths


_COLOURS = {"float32": "C0", "float64": "C1", "half": "C2"}


def _answers(outcome: Outcome) -> list[tuple[float, float, float]]:
    """Return (at, error, bound) of the answer nearest its bound at each number of the axis, in order."""
    nearest: dict[float, tuple[float, float, float]] = {}
    for p in outcome.points:
        if not isinstance(p.at, str) and math.isfinite(p.at) and p.bound > 0 and math.isfinite(p.error):
            kept = nearest.get(p.at)
            if kept is None or p.error / p.bound > kept[1] / kept[2]:
                nearest[p.at] = (float(p.at), p.error, p.bound)
    return [nearest[at] for at in sorted(nearest)]


def _panel(axes: Axes, shown: list[Outcome]) -> None:
    places: list[float] = []
    for outcome in shown:
        answers = _answers(outcome)
        if not answers:
            continue
        at, errors, bounds = zip(*answers, strict=True)
        places += at
        colour = _COLOURS[outcome.storage]
        floor = min(bounds) * 1e-4  # an error of 0 has no place on a logarithmic axis
        axes.plot(at, [max(error, floor) for error in errors], ".", ms=4, color=colour)
        axes.plot(at, bounds, "-", lw=1, color=colour)
    axes.set_yscale("log")
    axes.grid(linewidth=0.4)
    axes.set_xlabel(shown[0].row.axis)
    axes.set_ylabel(shown[0].row.measure, fontsize=9)
    if max(places) > 1000 or 0 < max(map(abs, places)) < 0.01:
        _powers(axes, places)


def _powers(axes: Axes, places: list[float]) -> None:
    """Make the axis logarithmic on both sides of 0 where it has them, with a few powers of ten as ticks."""
    sizes = [abs(at) for at in places if at]
    low, high = math.floor(math.log10(min(sizes))), math.ceil(math.log10(max(sizes)))
    signed = min(places) < 0
    step = max(-(-(high - low) // (3 if signed else 5)), 1)
    powers = range(high, low - 1, -step)
    ticks = [(10.0**power, f"$10^{{{power}}}$") for power in powers]
    if signed:
        ticks += [(-at, f"$-{label[1:]}") for at, label in ticks]
    if min(places) <= 0:
        axes.set_xscale("symlog", linthresh=10.0**low, linscale=(high - low) / 8)
        ticks = [tick for tick in ticks if abs(tick[0]) > 10.0**low] + [(0.0, "0")]
        axes.set_xlim(min(places) * 2 if signed else -0.3 * 10.0**low, max(places) * 2)
    else:
        axes.set_xscale("log")
    axes.set_xticks([at for at, _ in ticks], [label for _, label in ticks])
    axes.minorticks_off()


def _marks(shown: list[Outcome]) -> tuple[list[Line2D], list[str]]:
    """Return the legend: which colour is which storage, and that lines are bounds."""
    from matplotlib.lines import Line2D

    storages = [name for name in _COLOURS if any(outcome.storage == name for outcome in shown)]
    marks = [Line2D([], [], color=_COLOURS[name], marker=".", ls="") for name in storages]
    marks.append(Line2D([], [], color="0.3", lw=1))
    return marks, [*storages, "bound"]
