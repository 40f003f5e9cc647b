"""`adof envelope`: how far inputs may go on the chosen device, what is refused, and the errors measured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adof_cl.cli.devices import DeviceOption

if TYPE_CHECKING:
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
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def draw(facts: DeviceFacts, outcomes: list[Outcome], folder: Path) -> list[Path]:
    """Draw every row whose points lie on a number's axis: errors as dots, the bound as a line."""
    import math

    from matplotlib.figure import Figure

    from adof_cl.files import whole_file

    paths = []
    for name in dict.fromkeys(outcome.row.name for outcome in outcomes):
        shown = [outcome for outcome in outcomes if outcome.row.name == name]
        figure = Figure(figsize=(7.5, 4.2), layout="constrained")
        axes = figure.add_subplot()
        drawn: list[float] = []
        for index, outcome in enumerate(shown):
            answers = sorted(
                (float(p.at), p.error, p.bound)
                for p in outcome.points
                if not isinstance(p.at, str) and math.isfinite(p.at) and not p.refused and not p.failure
            )
            if len(answers) < 3 or max(bound for _, _, bound in answers) <= 0:
                continue
            at, errors, bounds = zip(*answers, strict=True)
            drawn += at
            least = min(b for b in bounds if b > 0) * 1e-4
            axes.plot(
                at, [max(e, least) for e in errors], ".", ms=4, color=f"C{index}", label=outcome.storage
            )
            axes.plot(at, bounds, "-", lw=1, color=f"C{index}", label=f"{outcome.storage}, bound")
        if not drawn:
            continue
        if max(drawn) > 1000 or 0 < max(map(abs, drawn)) < 0.01:
            below = min((abs(x) for x in drawn if x), default=1.0)
            axes.set_xscale("symlog", linthresh=below)
        axes.set_yscale("log")
        axes.grid(linewidth=0.4)
        axes.set_xlabel(shown[0].row.axis)
        axes.set_ylabel(shown[0].row.measure)
        axes.set_title(f"{name}: error against {shown[0].row.axis}, {facts.platform}", fontsize=10)
        axes.legend(fontsize=8)
        path = folder / f"{name}.png"
        with whole_file(path) as temporary:
            figure.savefig(temporary, dpi=110)
        paths.append(path)
    return paths
