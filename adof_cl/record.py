"""What a run leaves behind: one entry per iteration, one per named position, and the metrics.

Estimates come from the loop. Truth, where there is a twin to ask, is filled in by whoever composed the run;
it never reaches the loop.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_cl.files import whole_file

Image = NDArray[np.generic]


@dataclass(frozen=True)
class Latency:
    """From the end of an exposure to the command that came of it, stage by stage.

    Attributes
    ----------
    frame_ms
        From the end of the exposure until both cameras' frames were here: readout, transport, waiting.
    features_ms
        Until both frames were restored, the parts measured and triangulated.
    law_ms
        Until the law had decided, the next mask with it.
    command_ms
        Until the stages had acknowledged the command; NaN where there was nothing to command.
    """

    frame_ms: float = math.nan
    features_ms: float = math.nan
    law_ms: float = math.nan
    command_ms: float = math.nan

    @property
    def total_ms(self) -> float:
        """All of it; NaN without a command."""
        return self.frame_ms + self.features_ms + self.law_ms + self.command_ms


LATENCIES = ("frame_ms", "features_ms", "law_ms", "command_ms", "total_ms")


@dataclass(frozen=True)
class Iteration:
    """One pass of the loop, frame to command.

    Attributes
    ----------
    stage
        "coarse", "fine" or "insert".
    alpha_rad, focus_psi_rad
        The mask the frame was taken through.
    depth_margin_um
        How far beyond the parts' depths that mask covers.
    hole_sigma_px, peg_sigma_px
        Longest half axis of the one-sigma ellipse of the worst feature seen by camera 1.
    hole_depth_um, hole_depth_sigma_um
        Estimated depth of the hole below the peg's focus plane, and its standard deviation.
    error_x_um, error_y_um, error_theta_rad, error_z_um
        What the servo law saw: estimated pose error left.
    velocity
        Command sent: um/s along x, y, z and rad/s about z.
    hole_xy_px
        Where the middle of the hole's features was measured, region of interest.
    hole_bias_px
        Measured minus true position of the hole's features in camera 1, averaged; NaN without a twin.
    true_error_x_um, true_error_y_um, true_error_theta_rad, true_depth_um
        The world's own; NaN without a twin.
    """

    number: int
    time_s: float
    stage: str
    alpha_rad: float
    focus_psi_rad: float
    depth_margin_um: float
    hole_sigma_px: float
    peg_sigma_px: float
    hole_depth_um: float
    hole_depth_sigma_um: float
    error_x_um: float
    error_y_um: float
    error_theta_rad: float
    error_z_um: float
    velocity: tuple[float, float, float, float]
    ssd_hole: float
    ssd_peg: float
    epipolar_residual_px: float
    lost_features: int
    compute_ms: float
    latency: Latency = Latency()
    hole_xy_px: tuple[float, float] = (math.nan, math.nan)
    hole_bias_px: tuple[float, float] = (math.nan, math.nan)
    true_error_x_um: float = math.nan
    true_error_y_um: float = math.nan
    true_error_theta_rad: float = math.nan
    true_depth_um: float = math.nan
    true_hole_xyz_um: tuple[float, float, float] = (math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Position:
    """The loop's state where the hole passes one of the paper's depths A to E, and the errors it states.

    Attributes
    ----------
    depth_sigma_um, hole_sigma_px, peg_sigma_px, depth_margin_um
        As in `Iteration`.
    noise_gain, resolution_lp_per_mm
        Of the hole's filter: what it does to noise, and the finest pattern it keeps half of the contrast of.
    """

    name: str
    depth_um: float
    depth_est_um: float
    alpha: float
    focus_psi: float
    ssd_hole: float
    ssd_peg: float
    lateral_bias_um: tuple[float, float]
    depth_sigma_um: float = math.nan
    hole_sigma_px: float = math.nan
    peg_sigma_px: float = math.nan
    depth_margin_um: float = math.nan
    noise_gain: float = math.nan
    resolution_lp_per_mm: float = math.nan
    raw: Image | None = None
    restored_hole: Image | None = None
    restored_peg: Image | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON-ready part, without images."""
        images = ("raw", "restored_hole", "restored_peg")
        return {k: v for k, v in asdict(self).items() if k not in images}


@dataclass
class RunRecord:
    """Everything one run measured, in the order it happened.

    Attributes
    ----------
    seed
        Of the world; None where the world is real.
    rig
        What the rig's devices did, JSON-ready; empty on the twin.
    real_time
        Frames and commands took the time they take on the wire: latency counts. The twin's clock stands still
        meanwhile.
    """

    seed: int | None
    device: str
    iterations: list[Iteration] = field(default_factory=list)
    positions: list[Position] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    end_state: str = "not started"
    docked: bool = False
    coarse_error: dict[str, float] = field(default_factory=dict)
    fine_error: dict[str, float] = field(default_factory=dict)
    final_error: dict[str, float] = field(default_factory=dict)
    contacts: int = 0
    wall_s: float = math.nan
    rig: dict[str, Any] = field(default_factory=dict)
    real_time: bool = False

    def metrics(self) -> dict[str, Any]:
        """Return what `metrics.json` holds."""
        times = [i.compute_ms for i in self.iterations]
        quantile = {"p50": 50, "p99": 99}
        latency = {}
        for stage in LATENCIES if self.real_time else ():
            took = [getattr(i.latency, stage) for i in self.iterations if math.isfinite(i.latency.total_ms)]
            latency[stage.removesuffix("_ms")] = {
                k: float(np.percentile(took, q)) if took else None for k, q in quantile.items()
            }
        return {
            "docked": self.docked,
            "end_state": self.end_state,
            "final_error_um": {axis: self.final_error.get(axis) for axis in ("x", "y", "z")},
            "final_error_rad": self.final_error.get("theta"),
            "coarse_error_um": {axis: self.coarse_error.get(axis) for axis in ("x", "y", "z")},
            "coarse_error_rad": self.coarse_error.get("theta"),
            "fine_error_um": {axis: self.fine_error.get(axis) for axis in ("x", "y", "z")},
            "contacts_before_alignment": self.contacts,
            "iterations": len(self.iterations),
            "compute_ms": {k: float(np.percentile(times, q)) if times else None for k, q in quantile.items()},
            **({"latency_ms": latency, "rig": self.rig} if self.real_time else {}),
            "error_bars": self._error_bars(),
            "lost_features": sum(i.lost_features for i in self.iterations),
            "positions": [p.as_dict() for p in self.positions],
            "device": self.device,
            "seed": self.seed,
            "run_time_s": self.wall_s,
            "notes": self.notes,
        }

    def _error_bars(self) -> dict[str, dict[str, float | None]]:
        """Return how large the stated errors were: medians, and the 99th of a hundred; margins: the least."""
        stated = {
            "hole_sigma_px": [i.hole_sigma_px for i in self.iterations],
            "peg_sigma_px": [i.peg_sigma_px for i in self.iterations],
            "depth_sigma_um": [i.hole_depth_sigma_um for i in self.iterations],
        }
        bars: dict[str, dict[str, float | None]] = {}
        for name, values in stated.items():
            finite = [value for value in values if math.isfinite(value)]
            bars[name] = {
                key: float(np.percentile(finite, q)) if finite else None
                for key, q in (("p50", 50), ("p99", 99))
            }
        margins = [i.depth_margin_um for i in self.iterations]
        bars["mask_margin_um"] = {
            "p50": float(np.median(margins)) if margins else None,
            "least": min(margins) if margins else None,
        }
        return bars


def finite_json(value: Any) -> Any:
    """Replace what JSON cannot say (NaN, infinity) by null, all the way down."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(k): finite_json(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite_json(v) for v in value]
    if isinstance(value, np.generic):
        return finite_json(value.item())
    return value


def write_metrics(record: RunRecord, folder: Path) -> Path:
    """Write `metrics.json` and `iterations.json` into the run folder; returns the former's path."""
    path = folder / "metrics.json"
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(finite_json(record.metrics()), indent=2) + "\n", encoding="utf-8")
    rows = [finite_json(asdict(i)) for i in record.iterations]
    with whole_file(folder / "iterations.json") as temporary:
        temporary.write_text(json.dumps(rows) + "\n", encoding="utf-8")
    return path
