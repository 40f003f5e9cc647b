"""`adof tradeoff`: what accuracy costs on this device, knob by knob."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adof_cl.cli.devices import DeviceOption

if TYPE_CHECKING:
    from adof_cl.profile import DeviceProfile, Reading


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
    if as_file is not None and not as_file.parent.is_dir():
        raise InputError(f"{as_file} cannot be written (no such folder): choose another place")
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
    for place in places:
        print(f"profile: {place}")


def _print(profile: DeviceProfile) -> None:
    from rich.table import Table

    from adof_cl.cli.tables import print_table
    from adof_cl.tradeoff import pareto, verdicts

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
    for verdict in sorted(verdicts(profile.readings), key=lambda v: not v.worth):
        print(f"  {verdict.knob}: {verdict.sentence}")


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if value < float("inf") else "lost"


def _stages(readings: Sequence[Reading]) -> list[str]:
    return list(dict.fromkeys(r.stage for r in readings))


def _of(readings: Sequence[Reading], stage: str) -> list[Reading]:
    return [r for r in readings if r.stage == stage]


def draw(profile: DeviceProfile, folder: Path) -> None:
    """Draw one Pareto plot for each stage, and one of all settings of the whole chain."""
    chains = [r for r in profile.readings if r.whole_chain]
    title = f"{profile.device['name']}, {profile.device['platform']}, {profile.when[:10]}"
    for stage in _stages(profile.readings):
        _draw(_of(profile.readings, stage), folder / f"{stage}.png", f"{stage}: {title}")
    _draw(chains, folder / "combined.png", f"frame to features, every setting: {title}", labels=False)


def _draw(readings: Sequence[Reading], path: Path, title: str, *, labels: bool = True) -> None:
    import math

    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    from adof_cl.files import whole_file
    from adof_cl.tradeoff import pareto

    figure = Figure(figsize=(10.0, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    drawn = [r for r in readings if math.isfinite(r.worst_um)]
    front = pareto(drawn)
    knobs = list(dict.fromkeys(r.knob for r in readings))
    numbered = {id(r): number for number, r in enumerate(drawn, start=1)}
    colours = matplotlib.colormaps["tab20" if len(knobs) > 10 else "tab10"]
    for index, knob in enumerate(knobs):
        mine = [r for r in drawn if r.knob == knob]
        x = [1e3 * r.time_s.median for r in mine]
        bars = [
            [1e3 * (r.time_s.median - r.time_s.low) for r in mine],
            [1e3 * (r.time_s.high - r.time_s.median) for r in mine],
        ]
        y = [max(r.worst_um, 1e-3) for r in mine]
        lost = [r.setting for r in readings if r.knob == knob and not math.isfinite(r.worst_um)]
        label = knob + (f" (features lost: {', '.join(lost)})" if lost else "")
        axes.errorbar(
            x, y, xerr=bars, fmt="o", markersize=4, elinewidth=0.8, color=colours(index), label=label
        )
        for reading, at in zip(mine, zip(x, y, strict=True), strict=True):
            if labels or reading in front:
                axes.annotate(
                    str(numbered[id(reading)]), at, xytext=(4, 4), textcoords="offset points", fontsize=8
                )
    for whole in (False, True):
        steps = [r for r in front if r.whole_chain == whole]
        if not steps:
            continue
        line = "no setting beats these" if whole else "likewise, of a knob's own part"
        axes.step(
            [1e3 * r.time_s.median for r in steps], [max(r.worst_um, 1e-3) for r in steps], where="post",
            color="black", linewidth=0.8, linestyle="-" if whole else ":", label=line,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _position: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(
        "ms, median and quartiles"
        + ("" if all(r.whole_chain for r in readings) else " (of the knob's own part)")
    )
    axes.set_ylabel("largest error of place or depth in 95 % of frames, µm at the object")
    axes.set_title(title, fontsize=9)
    axes.grid(which="both", linewidth=0.3)
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    named = [f"{numbered[id(r)]}  {r.knob}: {r.setting}" for r in drawn if labels or r in front]
    axes.text(1.02, 0.0, "\n".join(named), transform=axes.transAxes, fontsize=6.5, va="bottom")
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=110)
