"""Figures of a run, and one HTML file that opens without a server.

The figures follow the paper: the hole's trajectory (Fig. 9), the frames at positions A to E, raw and restored
(Figs 10 to 13), and beyond it the mask, the depth with its error bars and the servo errors over time.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adof_cl.files import whole_file
from adof_cl.record import RunRecord, finite_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;color:#222}
h1{font-size:1.6rem}h2{font-size:1.2rem;margin-top:2.2rem;border-bottom:1px solid #ddd}
table{border-collapse:collapse;margin:1rem 0}td,th{padding:.25rem .8rem;border-bottom:1px solid #e4e4e4;
text-align:right}td:first-child,th:first-child{text-align:left}img{max-width:100%}
pre{background:#f6f6f6;padding:1rem;overflow:auto}.good{color:#176b2c}.bad{color:#a11}
"""


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _trajectory(record: RunRecord) -> Figure:
    """Draw the hole's path in space, as the paper's Fig. 9."""
    figure = _figure(10, 4.6)
    path = np.array([i.true_hole_xyz_um for i in record.iterations])
    if not np.isfinite(path).any():  # nobody knows: the path as seen from the peg
        path = np.array([(-i.error_x_um, -i.error_y_um, i.hole_depth_um) for i in record.iterations])
    depth = np.array([i.hole_depth_um for i in record.iterations])
    from_above, over_depth = figure.subplots(1, 2)
    from_above.plot(path[:, 0], path[:, 1], ".-", ms=3, lw=1)
    from_above.plot(*path[0, :2], "o", color="C3", label="start")
    from_above.plot(*path[-1, :2], "s", color="C2", label="end")
    from_above.set(xlabel="x (µm)", ylabel="y (µm)", title="Hole seen along the optical axis", aspect="equal")
    from_above.invert_yaxis()
    from_above.legend()
    true_depth = np.array([i.true_depth_um for i in record.iterations])
    for axis, name in ((0, "x"), (1, "y")):
        over_depth.plot(path[:, axis], true_depth, lw=1.2, label=f"{name}, true")
        over_depth.plot(path[:, axis], depth, ".", ms=2.5, color=f"C{axis}", alpha=0.5)
    over_depth.set(
        xlabel="lateral (µm)", ylabel="depth (µm)", title="Hole from the side; dots: estimated depth"
    )
    over_depth.invert_yaxis()
    for position in record.positions:
        over_depth.axhline(position.depth_um, color="0.8", lw=0.7, zorder=0)
        over_depth.text(
            over_depth.get_xlim()[1], position.depth_um, f" {position.name}", va="center", fontsize=9
        )
    over_depth.legend()
    return figure


def _mask_and_depth(record: RunRecord) -> Figure:
    figure = _figure(10, 6.4)
    time = _time(record)
    mask, depth = figure.subplots(2, 1, sharex=True)
    mask.step(time, [i.alpha_rad for i in record.iterations], where="post", label="cubic α")
    mask.step(time, [i.focus_psi_rad for i in record.iterations], where="post", label="focus ψ")
    mask.set(ylabel="phase at the stop's edge (rad)", title="The mask follows the depth")
    mask.legend()
    estimated = np.array([i.hole_depth_um for i in record.iterations])
    sigma = np.array([i.hole_depth_sigma_um for i in record.iterations])
    truth = np.array([i.true_depth_um for i in record.iterations])
    depth.plot(time, truth, "k-", lw=0.8, label="true depth")
    depth.plot(time, estimated, ".", ms=3, label="estimated")
    depth.set(ylabel="depth (µm)", xlabel="time since the first frame (s)")
    error = depth.twinx()
    error.errorbar(time, estimated - truth, yerr=sigma, fmt=".", ms=2, lw=0.6, color="C1", label="error ± σ")
    beyond = [i.depth_margin_um for i in record.iterations]
    error.step(time, beyond, where="post", lw=0.6, color="C2", label="covered beyond the parts")
    limit = (
        max(10.0, float(np.nanpercentile(np.abs(estimated - truth), 98)) * 1.5)
        if np.isfinite(truth).any()
        else 10
    )
    error.set(ylabel="estimate − truth, covered beyond (µm)", ylim=(-limit, limit))
    depth.legend(loc="upper right")
    error.legend(loc="lower left")
    return figure


def _servo_errors(record: RunRecord) -> Figure:
    figure = _figure(10, 6.4)
    time = _time(record)
    position, angle = figure.subplots(2, 1, sharex=True)
    for name in ("x", "y", "z"):
        values = np.abs([getattr(i, f"error_{name}_um") for i in record.iterations])
        position.semilogy(time, np.maximum(values, 1e-3), lw=1, label=f"|{name}| seen")
    for k, name in enumerate(("x", "y")):
        values = np.abs([getattr(i, f"true_error_{name}_um") for i in record.iterations])
        position.semilogy(time, np.maximum(values, 1e-3), ":", lw=1, color=f"C{k}", label=f"|{name}| true")
    position.set(ylabel="error (µm)", title="Servo errors")
    position.legend(ncols=5, fontsize=8)
    angle.semilogy(
        time, np.maximum(np.abs([i.error_theta_rad for i in record.iterations]), 1e-6), label="|θ| seen"
    )
    true_angle = np.abs([i.true_error_theta_rad for i in record.iterations])
    angle.semilogy(time, np.maximum(true_angle, 1e-6), ":", color="C0", label="|θ| true")
    angle.set(ylabel="error (rad)", xlabel="time since the first frame (s)")
    angle.legend()
    previous = ""
    for at_s, iteration in zip(time, record.iterations, strict=True):
        if iteration.stage != previous:
            previous = iteration.stage
            for axes in (position, angle):
                axes.axvline(at_s, color="0.7", lw=0.8)
            top = position.get_ylim()[1]
            position.text(at_s, top, f"{previous} ", va="top", ha="right", rotation=90, fontsize=9)
    return figure


def _time(record: RunRecord) -> NDArray[np.float64]:
    """Seconds since the loop's first frame."""
    return np.array([i.time_s - record.iterations[0].time_s for i in record.iterations])


def _frames(record: RunRecord) -> Figure:
    """Draw the frames at each position: raw, and restored for the hole and for the peg."""
    kept = [p for p in record.positions if p.raw is not None]
    figure = _figure(11, 2.9 * max(1, len(kept)))
    if not kept:
        return figure
    axes = figure.subplots(len(kept), 3, squeeze=False)
    for row, position in zip(axes, kept, strict=True):
        pictures = (
            (position.raw, f"{position.name}: as captured, α = {position.alpha:.1f}"),
            (position.restored_hole, f"restored for the hole ({position.depth_est_um:.0f} µm)"),
            (position.restored_peg, "restored for the peg"),
        )
        for cell, (picture, title) in zip(row, pictures, strict=True):
            cell.set_axis_off()
            if picture is not None:
                cell.imshow(picture, cmap="gray", vmin=0, vmax=255)
                cell.set_title(title, fontsize=9)
    return figure


_STAGES = {
    "frame_ms": "exposure's end → frames here",
    "features_ms": "restored, tracked",
    "law_ms": "law, next mask",
    "command_ms": "command acknowledged",
}


def _latency(record: RunRecord) -> Figure:
    """Draw how old each command's frame was, stage by stage, and how often."""
    figure = _figure(10, 4.2)
    over_time, ranked = figure.subplots(1, 2, width_ratios=(2, 1))
    commanded = [i for i in record.iterations if math.isfinite(i.latency.total_ms)]
    time = np.array([i.time_s - record.iterations[0].time_s for i in commanded])
    took = np.array([[getattr(i.latency, stage) for stage in _STAGES] for i in commanded]).reshape(-1, 4)
    over_time.stackplot(time, took.T, labels=_STAGES.values(), step="post", linewidth=0)
    total = np.sort(took.sum(axis=1))
    # A stall of the computer shows in the ranks; here it would hide all the rest.
    over_time.set(
        xlabel="time since the first frame (s)", ylabel="from exposure to command (ms)",
        ylim=(0, 1.6 * float(np.percentile(total, 95)) if total.size else 1),
    )  # fmt: skip
    over_time.legend(loc="upper right", fontsize=8)
    ranked.semilogx(np.maximum(total, 0.1), (np.arange(total.size) + 0.5) / max(total.size, 1))
    ranked.set(xlabel="from exposure to command (ms)", ylabel="share of commands as quick", ylim=(0, 1))
    ticks = [
        t for t in (5, 10, 20, 50, 100, 200, 500, 1000) if total.size and total[0] / 2 < t < 2 * total[-1]
    ]
    ranked.set_xticks(ticks, [str(t) for t in ticks])
    ranked.minorticks_off()
    ranked.grid(alpha=0.3)
    return figure


_FIGURES: dict[str, tuple[str, Callable[[RunRecord], Figure]]] = {
    "trajectory.png": ("Trajectory of the hole", _trajectory),
    "mask_and_depth.png": ("Mask and depth", _mask_and_depth),
    "servo_errors.png": ("Servo errors", _servo_errors),
    "frames.png": ("Frames at the positions A to E", _frames),
}


def _table(headings: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    head = "".join(f"<th>{html.escape(h)}</th>" for h in headings)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(_shown(value))}</td>" for value in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _shown(value: object) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def write_report(record: RunRecord, folder: Path, extra_html: str = "") -> Path:
    """Write the figures as PNG and `report.html` with all of them inside; returns the latter's path.

    A run cut short is reported up to where it came; one without any iteration has its end state only.

    Raises
    ------
    InputError
        The folder cannot be written.
    """
    metrics = record.metrics()
    verdict = "good" if record.docked else "bad"
    final, coarse = metrics["final_error_um"], metrics["coarse_error_um"]
    parts = [
        "<!doctype html><meta charset='utf-8'><title>adof run</title>",
        f"<style>{_STYLE}</style>",
        f"<h1>adof run{'' if record.seed is None else f', seed {record.seed}'}: "
        f"<span class='{verdict}'>{html.escape(record.end_state)}</span></h1>",
        f"<p>{html.escape(record.device)}; {len(record.iterations)} iterations.</p>",
        _table(
            ["against the world's truth", "x (µm)", "y (µm)", "z (µm)", "θ (mrad)"],
            [
                ["after coarse", coarse["x"], coarse["y"], coarse["z"], _milli(metrics["coarse_error_rad"])],
                ["at the end", final["x"], final["y"], final["z"], _milli(metrics["final_error_rad"])],
            ],
        ),
        _table(
            ["compute, frame on host to command", "p50 (ms)", "p99 (ms)"],
            [["per iteration", metrics["compute_ms"]["p50"], metrics["compute_ms"]["p99"]]],
        ),
    ]
    if record.positions:
        rows = [
            [
                p.name, p.depth_um, p.depth_est_um, p.alpha, p.ssd_hole, p.ssd_peg,
                p.lateral_bias_um[0], p.lateral_bias_um[1],
            ]
            for p in record.positions
        ]  # fmt: skip
        headings = [
            "position", "depth (µm)", "estimated (µm)", "α (rad)", "SSD hole", "SSD peg", "bias x (µm)",
            "bias y (µm)",
        ]  # fmt: skip
        parts.append(_table(headings, rows))
        stated = [
            [
                p.name, p.depth_sigma_um, p.hole_sigma_px, p.peg_sigma_px, p.depth_margin_um, p.noise_gain,
                p.resolution_lp_per_mm,
            ]
            for p in record.positions
        ]  # fmt: skip
        headings = [
            "stated there", "σ of depth (µm)", "σ of the hole (px)", "σ of the peg (px)",
            "depth the mask still covers (µm)", "noise, restored over raw", "detail kept to (lp/mm)",
        ]  # fmt: skip
        parts.append(_table(headings, stated))
    parts.append(extra_html)
    figures = dict(_FIGURES)
    if record.real_time:
        parts.append(_measured(metrics))
        figures["latency.png"] = ("From exposure to command", _latency)
    if record.iterations:
        for name, (title, draw) in figures.items():
            with whole_file(folder / name) as temporary:
                draw(record).savefig(temporary, dpi=110)
            encoded = base64.b64encode((folder / name).read_bytes()).decode()
            parts.append(
                f"<h2>{html.escape(title)}</h2>"
                f"<img alt='{html.escape(title)}' src='data:image/png;base64,{encoded}'>"
            )
    parts.extend(f"<p>{html.escape(note)}</p>" for note in record.notes)
    shown = json.dumps(finite_json(metrics), indent=2)
    parts.append(f"<h2>metrics.json</h2><pre>{html.escape(shown)}</pre>")
    path = folder / "report.html"
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(parts), encoding="utf-8")
    return path


def _measured(metrics: dict[str, Any]) -> str:
    """Return what was measured on a rig: latency by stage, and what its devices did."""
    named = {stage.removesuffix("_ms"): title for stage, title in _STAGES.items()} | {"total": "all of it"}
    latency = metrics["latency_ms"]
    parts = [
        _table(
            ["exposure to command", "p50 (ms)", "p99 (ms)"],
            [[title, latency[stage]["p50"], latency[stage]["p99"]] for stage, title in named.items()],
        )
    ]
    if cameras := metrics["rig"].get("cameras"):
        frames = [[name, cameras[name]] for name in ("camera 1", "camera 2")]
        parts.append(
            _table([f"frames, {cameras['rate_hz']:.1f} pairs a second", "what became of them"], frames)
        )
    if stop := metrics["rig"].get("stop"):
        rows = [["stop sent", stop["pressed_to_sent_ms"]], ["everything at rest", stop["pressed_to_rest_ms"]]]
        parts.append(_table(["after the pedal was pressed", "ms"], rows))
    return "".join(parts)


def _milli(value: float | None) -> float | None:
    return None if value is None else value * 1000
