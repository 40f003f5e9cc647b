"""The paper's Tables 2 and 3, with every column: the same parts at the same depths under different masks.

After calibration the hole is brought to each named depth, aligned under the peg, and seen through each arm's
mask with each arm's filter. What the score cannot show, where the feature really was, comes from whoever
knows the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adof_cl.loop import HOLE, PEG, POSITIONS, Assembly
from adof_cl.mask import PaperCalibration
from adof_cl.optics import Mask
from adof_cl.pipeline import Blur, CameraPipeline
from adof_cl.tracking import TrackingLimits

Array = NDArray[np.float64]

PAPER_HOLE: Mapping[str, Mapping[str, float]] = {
    "adaptive": {"A": 2.45, "B": 2.40, "C": 2.2, "D": 1.81},
    "none": {"A": 3.13, "B": 2.57, "C": 2.41, "D": 2.02, "E": 1.21},
}
"""The paper's Table 2."""
PAPER_PEG: Mapping[str, Mapping[str, float]] = {
    "adaptive": {"A": 2.21, "B": 2.10, "C": 2.03, "D": 1.68, "E": 0.48},
    "fixed": {"A": 2.30, "B": 2.32, "C": 2.31, "D": 2.28, "E": 2.29},
}
"""The paper's Table 3."""


@dataclass(frozen=True)
class Arm:
    """One way of seeing: which mask, and which filter.

    Attributes
    ----------
    mask
        "none", "fixed" (alpha = 80), "paper" (its curve, focus on the peg) or "joint" (ours).
    filter
        "raw": none; "focus": the peg's for everything, as the paper has it; "own": each part's own depth.
    """

    name: str
    mask: str
    filter: str


ARMS: tuple[Arm, ...] = (
    Arm("no mask", "none", "raw"),
    Arm("fixed 80, in-focus filter", "fixed", "focus"),
    Arm("fixed 80, own depth", "fixed", "own"),
    Arm("adaptive, in-focus filter", "paper", "focus"),
    Arm("adaptive, own depth", "paper", "own"),
    Arm("ours: joint mask, own depth", "joint", "own"),
)

FIXED_ALPHA_RAD = 80.0
_FRAMES = 4


@dataclass(frozen=True)
class ArmResult:
    """What one arm shows at one named depth, averaged over frames.

    Attributes
    ----------
    ssd_hole, ssd_peg
        The paper's score: squared differences with grey in [0, 1] summed over 20 x 20 pixels, mean of two
        features.
    bias_px : (2,)
        Where the hole's middle was measured, less where it is.
    predicted_shift_px
        Displacement along x and along y that the filter leaves, by stationary phase; NaN without a mask.
    defocus_share
        |psi| / (3 alpha) of the hole: the prediction holds below about 0.5.
    lost
        Features that a run would have refused.
    """

    position: str
    depth_um: float
    arm: Arm
    alpha_rad: float
    focus_psi_rad: float
    ssd_hole: float
    ssd_peg: float
    bias_px: tuple[float, float]
    predicted_shift_px: float
    defocus_share: float
    lost: int

    def as_dict(self) -> dict[str, object]:
        """Return JSON-ready values."""
        values: dict[str, object] = {k: v for k, v in vars(self).items() if k != "arm"}
        return {"arm": self.arm.name, "mask": self.arm.mask, "filter": self.arm.filter, **values}


def survey(
    assembly: Assembly,
    truth_px: Callable[[float], Array],
    *,
    arms: Sequence[Arm] = ARMS,
    progress: Callable[[str, str], None] | None = None,
) -> list[ArmResult]:
    """Measure every arm at every named depth; the hole ends where it began.

    Parameters
    ----------
    assembly
        Prepared: focused, taught and calibrated.
    truth_px
        Given a frame's time, where the hole's middle really is in camera 1's region of interest, (x, y).
    """
    tell = progress or (lambda _stage, _sentence: None)
    eye = assembly.eyes[0]
    # Its own pipeline: room for the widest blur and the largest displacement, and no feature refused.
    pipeline = CameraPipeline(
        eye.pipeline.device, eye.optics, eye.pipeline.shape, (PEG, HOLE), nsr=eye.pipeline.nsr,
        padding=100, search_shape=(84, 84),
    )  # fmt: skip
    anything = TrackingLimits(mismatch=1.1, sigma_px=1e3, gain=(1e-6, 1e6))
    usual = TrackingLimits(mismatch=0.7)
    results: list[ArmResult] = []
    start = dict(assembly.rig.coarse.position())
    for name, depth_um in POSITIONS:
        tell("compare", f"position {name}, {depth_um:.0f} µm")
        assembly.bring_hole_to(depth_um)
        for part in (PEG, HOLE):
            pipeline.set_templates(part, eye.templates(part), anything)
        results += [_measured(assembly, pipeline, name, arm, truth_px, usual) for arm in arms]
    assembly.move_hole(start)
    return results


def _mask(assembly: Assembly, arm: Arm) -> Mask:
    peg, hole = float(assembly.world[PEG][2]), float(assembly.world[HOLE][2])
    if arm.mask == "none":
        return Mask()
    if arm.mask == "fixed":
        return Mask(FIXED_ALPHA_RAD)
    if arm.mask == "paper":
        return Mask(PaperCalibration().alpha_rad(hole - peg))
    return assembly.joint_mask(min(peg, hole), max(peg, hole))


def _measured(
    assembly: Assembly,
    pipeline: CameraPipeline,
    name: str,
    arm: Arm,
    truth_px: Callable[[float], Array],
    usual: TrackingLimits,
) -> ArmResult:
    eye = assembly.eyes[0]
    mask = _mask(assembly, arm)
    assembly.show(mask)
    own = {part: Blur.of(mask, eye.optics, float(assembly.world[part][2])) for part in (PEG, HOLE)}
    blurs: dict[str, Blur | None] = dict(own)
    if arm.filter == "raw":
        blurs = {PEG: None, HOLE: None}
    elif arm.filter == "focus":
        blurs = {PEG: own[PEG], HOLE: own[PEG]}
    expected = {part: eye.seen[part].xy_px for part in (PEG, HOLE)}
    shift = math.nan
    if mask.alpha_rad:
        left = own[PEG].psi_rad if arm.filter == "focus" else own[HOLE].psi_rad
        shift = eye.optics.shift_px(mask.alpha_rad, own[HOLE].psi_rad)
        shift -= eye.optics.shift_px(mask.alpha_rad, left)
    scores, biases, lost = [], [], 0
    for _ in range(_FRAMES):
        frame = assembly.rig.camera_1.grab()
        found = pipeline(frame.pixels, blurs, expected)
        scores.append([np.mean([m.ssd for m in found[part]]) for part in (HOLE, PEG)])
        middle = np.mean([m.feature_xy_px for m in found[HOLE]], axis=0)
        biases.append(middle - truth_px(frame.time_s))
        lost += sum(m.lost or m.mismatch > usual.mismatch for part in (HOLE, PEG) for m in found[part])
    hole, peg = np.mean(scores, axis=0)
    bias = np.mean(biases, axis=0)
    share = abs(own[HOLE].psi_rad) / (3 * mask.alpha_rad) if mask.alpha_rad else math.inf
    return ArmResult(
        position=name,
        depth_um=float(assembly.world[HOLE][2] - assembly.world[PEG][2]),
        arm=arm,
        alpha_rad=mask.alpha_rad,
        focus_psi_rad=mask.focus_psi_rad,
        ssd_hole=float(hole),
        ssd_peg=float(peg),
        bias_px=(float(bias[0]), float(bias[1])),
        predicted_shift_px=shift,
        defocus_share=share,
        lost=lost,
    )
