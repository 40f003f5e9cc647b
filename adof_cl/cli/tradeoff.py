"""`adof tradeoff`: what accuracy costs on this device, knob by knob."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adof_cl.cli.devices import DeviceOption

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from adof_cl.profile import DeviceProfile, Reading
    from adof_cl.tradeoff import Verdict


def tradeoff(
    scene: Annotated[
        Path | None,
        typer.Option(
            "--scene", metavar="FILE", help="Depths, noise and speeds under which knobs are turned."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Two specimens, few rounds: whether it works. Not kept for plans.")
    ] = False,
    as_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the device's profile to this file.")
    ] = None,
    plots: Annotated[
        Path | None, typer.Option("--plots", metavar="DIR", help="Draw time against error into this folder.")
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option("--table", metavar="FILE", help="Write the table to this file, as Markdown."),
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Turn every knob that trades time for error, measure both against the twin's truth, and say which pay.

    Takes one to three minutes. The profile is kept for adof plan and adof run on this device and driver.

    Examples: adof tradeoff --plots plots | adof tradeoff --scene mine.json --json mine-profile.json
    """
    from adof_cl import tradeoff as measuring
    from adof_cl.cli.progress import Live
    from adof_cl.device import Device
    from adof_cl.errors import InputError
    from adof_cl.files import whole_file
    from adof_cl.profile import kept_at
    from adof_cl.scene import Scene

    stated = None if scene is None else Scene.read(scene)
    for file in (as_file, table):
        if file is not None and not file.parent.is_dir():
            raise InputError(f"{file} cannot be written (no such folder): choose another place")
    if plots is not None and not plots.is_dir():
        if not plots.parent.is_dir():
            raise InputError(f"{plots} cannot be made (no such folder above it): choose another place")
        plots.mkdir()
    opened = Device.open(device)
    with Live(f"adof tradeoff, {opened.facts}") as live:
        profile = measuring.measure(opened, stated, quick=quick, tell=live.tell)
    _print(profile)
    places = [] if as_file is None else [as_file]
    if not quick:
        kept = kept_at(profile.device)
        kept.parent.mkdir(parents=True, exist_ok=True)
        places.append(kept)
    for place in places:
        with whole_file(place) as path:
            path.write_text(profile.to_json(), encoding="utf-8")
    if plots is not None:
        draw(profile, plots)
    if table is not None:
        with whole_file(table) as path:
            path.write_text(markdown(profile), encoding="utf-8")
    for place in places:
        print(f"profile: {place}")


def _print(profile: DeviceProfile) -> None:
    from rich.table import Table

    from adof_cl.cli.tables import print_table
    from adof_cl.tradeoff import pareto

    load = profile.machine["load_at_start"]
    device, settings = profile.device, profile.settings
    print(f"adof-cl {profile.version} on {device['name']} ({device['platform']}), {profile.when}")
    print(
        f"hole {settings['depth_um']:.0f} um behind the peg, noise {settings['noise_grey']:.2f} of 255; "
        f"{profile.machine['cores']} cores" + (f", load {load[0]:.1f} at the start" if load else "")
    )
    table = Table(box=None, header_style="bold")
    for heading in ("", "setting", "ms", "quartiles", "px", "um", "depth um", "image L2", ""):
        table.add_column(heading, justify="left" if heading in ("", "setting") else "right", no_wrap=True)
    best = {id(r) for stage in _stages(profile.readings) for r in pareto(_of(profile.readings, stage))}
    last = ""
    for reading in profile.readings:
        knob = f"{reading.stage}: {reading.knob}"
        spread = reading.time_s
        table.add_row(
            knob if knob != last else "",
            reading.setting,
            f"{1e3 * spread.median:.3f}",
            f"{1e3 * spread.low:.3f}-{1e3 * spread.high:.3f}",
            _number(reading.error_px, 3),
            _number(reading.error_um, 2),
            "" if reading.depth_um is None else _number(reading.depth_um, 1),
            "" if reading.image_l2 is None else f"{reading.image_l2:.1e}",
            "pareto" if id(reading) in best else "",
        )
        last = knob
    print_table(table)
    print("\n95 % of frames are better; 'lost': features not found. Which knobs pay:")
    for verdict in _worth_first(profile):
        print(f"  {verdict.knob}: {verdict.sentence}")


def markdown(profile: DeviceProfile) -> str:
    """Return every reading as a Markdown table, and which knobs pay."""
    lines = [
        "| knob | setting | ms (quartiles) | µm | depth µm | image L2 |",
        "|---|---|---|---|---|---|",
    ]
    last = ""
    for reading in profile.readings:
        knob, spread = f"{reading.stage}: {reading.knob}", reading.time_s
        cells = [
            knob if knob != last else "",
            reading.setting,
            f"{1e3 * spread.median:.3f} ({1e3 * spread.low:.3f}-{1e3 * spread.high:.3f})",
            _number(reading.error_um, 2),
            "" if reading.depth_um is None else _number(reading.depth_um, 1),
            "" if reading.image_l2 is None else f"{reading.image_l2:.0e}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
        last = knob
    lines += ["", "Which knobs pay:", ""]
    lines += [f"* {verdict.knob}: {verdict.sentence}" for verdict in _worth_first(profile)]
    return "\n".join(lines) + "\n"


def _worth_first(profile: DeviceProfile) -> list[Verdict]:
    from adof_cl.tradeoff import verdicts

    return sorted(verdicts(profile.readings), key=lambda verdict: not verdict.worth)


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if value < float("inf") else "lost"


def _stages(readings: Sequence[Reading]) -> list[str]:
    return list(dict.fromkeys(r.stage for r in readings))


def _of(readings: Sequence[Reading], stage: str) -> list[Reading]:
    return [r for r in readings if r.stage == stage]


def draw(profile: DeviceProfile, folder: Path) -> None:
    """Draw for each stage a panel a knob, and all settings of the whole chain in one plot."""
    title = f"{profile.device['name']}, {profile.device['platform']}, {profile.when[:10]}"
    for stage in _stages(profile.readings):
        mine = _of(profile.readings, stage)
        panels = {knob: [r for r in mine if r.knob == knob] for knob in dict.fromkeys(r.knob for r in mine)}
        _draw(panels, folder / f"{stage}.png", f"{stage}: {title}")
    _draw_all(
        [r for r in profile.readings if r.whole_chain],
        folder / "combined.png",
        f"frame to features, every setting: {title}",
    )


def _draw(panels: dict[str, list[Reading]], path: Path, title: str) -> None:
    import math

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from adof_cl.cli.labels import label_points
    from adof_cl.files import whole_file

    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(5.6 * columns if columns > 1 else 9.0, 3.6 * rows + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for unused in grid.flat[len(panels) :]:
        unused.set_visible(False)
    for axes, (knob, readings) in zip(grid.flat, panels.items(), strict=False):
        drawn = [r for r in readings if math.isfinite(r.worst_um)]
        lost = [r.setting for r in readings if not math.isfinite(r.worst_um)]
        _points(axes, drawn, "C0")
        _front(axes, drawn)
        whole = all(r.whole_chain for r in readings)
        axes.set_title(knob + (f" (features lost: {', '.join(lost)})" if lost else ""), fontsize=9)
        axes.set_xlabel("ms" if whole else "ms, of this part alone", fontsize=8)
    for axes in grid[:, 0]:
        axes.set_ylabel("error, µm", fontsize=8)
    figure.suptitle(
        f"{title}\nerror of place or depth in 95 % of frames, at the object; median time and quartiles; "
        "line: none beats these",
        fontsize=9,
    )
    for axes in grid.flat[: len(panels)]:
        _logarithmic(axes)
        axes.margins(x=0.15)
    low, high = grid[0, 0].get_ylim()  # shared
    grid[0, 0].set_ylim(low / 1.5, 1.5 * high)
    figure.draw_without_rendering()
    for axes, readings in zip(grid.flat, panels.values(), strict=False):
        drawn = [r for r in readings if math.isfinite(r.worst_um)]
        label_points(axes, [_at(r) for r in drawn], [r.setting for r in drawn])
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw_all(readings: Sequence[Reading], path: Path, title: str) -> None:
    import math

    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from adof_cl.cli.labels import label_points
    from adof_cl.files import whole_file

    figure = Figure(figsize=(10.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    drawn = [r for r in readings if math.isfinite(r.worst_um)]
    knobs = list(dict.fromkeys(r.knob for r in readings))
    colours = matplotlib.colormaps["tab20" if len(knobs) > 10 else "tab10"]
    for index, knob in enumerate(knobs):
        mine = [r for r in drawn if r.knob == knob]
        lost = [r.setting for r in readings if r.knob == knob and not math.isfinite(r.worst_um)]
        _points(axes, mine, colours(index), knob + (f" (features lost: {', '.join(lost)})" if lost else ""))
    front = _front(axes, drawn, "no setting beats these")
    _logarithmic(axes)
    axes.set_xlabel("ms, median and quartiles")
    axes.set_ylabel("largest error of place or depth in 95 % of frames, µm at the object")
    axes.set_title(title, fontsize=9)
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.draw_without_rendering()
    told = [r for r in drawn if r in front or r.worst_um > 1.2 * min(d.worst_um for d in drawn)]
    label_points(axes, [_at(r) for r in told], [f"{r.knob}: {r.setting}" for r in told])
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _at(reading: Reading) -> tuple[float, float]:
    return 1e3 * reading.time_s.median, max(reading.worst_um, 1e-3)


def _points(axes: Axes, readings: Sequence[Reading], colour: object, label: str = "") -> None:
    x, y = zip(*map(_at, readings), strict=True) if readings else ((), ())
    bars = [
        [1e3 * (r.time_s.median - r.time_s.low) for r in readings],
        [1e3 * (r.time_s.high - r.time_s.median) for r in readings],
    ]
    axes.errorbar(x, y, xerr=bars, fmt="o", markersize=4, elinewidth=0.8, color=colour, label=label)


def _front(axes: Axes, readings: Sequence[Reading], label: str = "") -> list[Reading]:
    from adof_cl.tradeoff import pareto

    front = pareto(readings)
    x, y = zip(*map(_at, front), strict=True) if front else ((), ())
    axes.step(x, y, where="post", color="black", linewidth=0.8, label=label)
    return front


def _logarithmic(axes: Axes) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _position: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=7)
    axes.grid(which="both", linewidth=0.3)
