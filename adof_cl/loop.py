"""The assembly, closed through images: autofocus, templates, calibration, coarse, fine, insertion.

The loop states the little it needs of a rig as protocols; the twin and real drivers satisfy them by shape. It
knows how the rig was drawn (`Design`) and measures the rest: where the parts are, how the stages lie to the
cameras, where the rotation's centre is, how old a frame is when its command goes out.

One iteration: both cameras' frames, each part restored with the filter of its own depth, features, depth by
triangulation, the mask for what is left of the depth, whole stage steps. Any exception stops the stages.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from adof_cl.autofocus import focus_sweep
from adof_cl.device import Device
from adof_cl.errors import AdofError, InputError, TrackingError
from adof_cl.mask import (
    ModelCalibration,
    PaperCalibration,
    choose_mask,
    depth_margin_um,
    filter_quality,
)
from adof_cl.optics import Mask, OpticalSystem, SlmPanel
from adof_cl.pipeline import Blur, CameraPipeline, WindowedPipeline
from adof_cl.record import Iteration, Latency, Position, RunRecord
from adof_cl.registration import Drawing, register
from adof_cl.replan import Budget, Replanner
from adof_cl.scene import Scene
from adof_cl.servo import ServoLaw, StageAxes, StageAxis, StageQuantiser, VelocityCommand, jog_test
from adof_cl.slm_encode import SlmEncode
from adof_cl.stereo import StereoRig, calibrate_camera, triangulate_relative
from adof_cl.tracking import Measurement, Template, TrackingLimits, extent_px

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

PEG, HOLE, PEG_OVER_HOLE = "peg", "hole", "peg over hole"
POSITIONS: tuple[tuple[str, float], ...] = (
    ("A", 4000.0),
    ("B", 3000.0),
    ("C", 2000.0),
    ("D", 1000.0),
    ("E", 787.0),
)
"""The paper's named depths, as inferred in docs/maths.md from its mask strengths."""


class Frame(Protocol):
    """What a camera gives."""

    @property
    def pixels(self) -> Pixels: ...  # noqa: D102  (protocols below: the names say it)
    @property
    def time_s(self) -> float: ...  # noqa: D102


class Camera(Protocol):
    """A source of frames, region of interest only."""

    def grab(self) -> Frame: ...  # noqa: D102


class Modulator(Protocol):
    """A sink for panel codes."""

    def show(self, codes: Pixels) -> object: ...  # noqa: D102


class Stage(Protocol):
    """Axes by name; um, or rad for "theta"."""

    @property
    def resolution(self) -> Mapping[str, float]: ...  # noqa: D102
    @property
    def speed_limits(self) -> Mapping[str, float]: ...  # noqa: D102
    def position(self) -> Mapping[str, float]: ...  # noqa: D102
    def position_at(self, time_s: float) -> Mapping[str, float]: ...  # noqa: D102
    def move_to(self, targets: Mapping[str, float], *, speed: float | None = None) -> None: ...  # noqa: D102
    def stop(self) -> None: ...  # noqa: D102
    def wait_until_still(self) -> None: ...  # noqa: D102


class Clock(Protocol):
    """The rig's time."""

    @property
    def now_s(self) -> float: ...  # noqa: D102
    def wait(self, duration_s: float) -> None: ...  # noqa: D102


class Rig(Protocol):
    """What the loop drives."""

    @property
    def camera_1(self) -> Camera: ...  # noqa: D102
    @property
    def camera_2(self) -> Camera: ...  # noqa: D102
    @property
    def slm(self) -> Modulator: ...  # noqa: D102
    @property
    def coarse(self) -> Stage: ...  # noqa: D102
    @property
    def fine(self) -> Stage: ...  # noqa: D102
    @property
    def clock(self) -> Clock: ...  # noqa: D102


class PartDesign(Protocol):
    """A part as drawn."""

    @property
    def corners_um(self) -> Array:
        """(4, 2): -x -y, +x -y, +x +y, -x +y from the part's centre."""
        ...


class Design(Protocol):
    """The rig as drawn: what the loop may know beforehand."""

    @property
    def optics_1(self) -> OpticalSystem: ...  # noqa: D102
    @property
    def optics_2(self) -> OpticalSystem: ...  # noqa: D102
    @property
    def mask_2(self) -> Mask: ...  # noqa: D102
    @property
    def panel(self) -> SlmPanel: ...  # noqa: D102
    @property
    def settling_s(self) -> float: ...  # noqa: D102
    @property
    def exposure_s(self) -> float: ...  # noqa: D102
    @property
    def frame_rate_hz(self) -> float: ...  # noqa: D102
    @property
    def command_latency_s(self) -> float: ...  # noqa: D102
    @property
    def tilt_rad(self) -> float: ...  # noqa: D102
    @property
    def region_rows(self) -> int: ...  # noqa: D102
    @property
    def region_columns(self) -> int: ...  # noqa: D102
    @property
    def region_origin_yx(self) -> tuple[int, int]: ...  # noqa: D102
    @property
    def peg(self) -> PartDesign: ...  # noqa: D102
    @property
    def hole(self) -> PartDesign: ...  # noqa: D102
    def projection(self, camera: int) -> tuple[Array, Array]: ...  # noqa: D102


MASKS = ("joint", "paper", "fixed")


@dataclass(frozen=True)
class Options:
    """What an operator may choose.

    Attributes
    ----------
    mask
        "joint": cubic and focus chosen together from the optics; "paper": the paper's curve, focus on the
        peg; "fixed": always `fixed_alpha_rad`.
    stand_off_um
        Depth of the hole under the peg's face where coarse assembly ends: the peg's tip is still above it.
    seat_um
        Depth of the hole's face when the peg is seated.
    nsr
        Noise-to-signal power ratio of the filters.
    iteration_limit
        The loop gives up after so many.
    rig_name
        What the cameras are called in a calibration file.
    budget
        What the loop's frames may cost or err by; None: everything is restored whole and refined fully.
    """

    mask: str = "joint"
    fixed_alpha_rad: float = 80.0
    stand_off_um: float = 400.0
    seat_um: float = 150.0
    nsr: float = 0.003
    iteration_limit: int = 600
    rig_name: str = "rig"
    budget: Budget | None = None

    def __post_init__(self) -> None:
        if self.mask not in MASKS:
            raise InputError(f"mask is '{self.mask}': choose one of {', '.join(MASKS)}")

    @property
    def camera_ids(self) -> tuple[str, str]:
        """Names of both cameras in a calibration file."""
        return f"{self.rig_name} camera 1", f"{self.rig_name} camera 2"


# Opposite corners: whatever blurs a corner moves both alike about the part's middle.
_DIAGONALS = ((0, 2), (1, 3))
_GATE_UM = 900.0  # the peg's tip is 300 um under its face: above this depth nothing can touch
_LOST_LIMIT = 12
_DEPTH_SIGMAS = 3.0  # of depth that a mask covers beyond the parts: one frame in 400 may lie outside
_MOST_SIGMA_UM = 100.0  # no mask covers more beyond the whole range
_TURN_RAD = 0.004  # a template 20 pixels wide turned by this is off by 0.04 at its rim
_TAUGHT_FRAMES = 4  # a template's noise is a quarter's variance: less than a frame's own
_INSET_PX = {PEG: 12.0, HOLE: -8.0}  # templates lie on the peg's face, and on the plate around the hole
_BENT_PX = 0.5  # a target whose two features moved apart by more was half hidden
# The hole's middle may lie 200 um from the axis it turns about, and turn by 0.1 rad; the peg may be 80 um off
# its drawn depth: what is left is a fault.
_DISAGREEMENT_UM = 150.0
_FUSED_FRAMES = 40  # of depth: noise falls sixfold, and what changes with depth is forgotten in three seconds
_DEFOCUS_SHARE = 0.6  # largest |psi| / (3 alpha) of the joint mask

Milestone = Callable[[str], None]
"""Told when a stage of the run has been completed: "coarse", "fine", "insert"."""
Progress = Callable[[str, str], None]
"""Told (stage, sentence) as the run goes on."""
Observer = Callable[[Iteration, float], Iteration]
"""Given each iteration and its frame's time; may add what it knows, and returns it."""


@dataclass
class Features:
    """Where one part's features were last seen in one camera."""

    xy_px: Array
    covariance: Array
    measured: list[Measurement]

    @property
    def middle(self) -> Array:
        """Middle of the two corners: what blurs a corner symmetrically leaves it in place."""
        return np.asarray(self.xy_px.mean(axis=0))

    @property
    def middle_covariance(self) -> Array:
        """Of `middle`."""
        return np.asarray(self.covariance.sum(axis=0) / len(self.covariance) ** 2)

    @property
    def sigma_px(self) -> float:
        """Longest half axis of the one-sigma ellipse of the worst feature."""
        return math.sqrt(max(float(np.linalg.eigvalsh(c)[-1]) for c in self.covariance))

    def bent_px(self, taught: Features) -> float:
        """How far the features' distance differs from what was taught: a part is rigid."""
        return float(np.linalg.norm(np.diff(self.xy_px - taught.xy_px, axis=0)))

    @property
    def lost(self) -> int:
        """How many features were not found."""
        return sum(m.lost for m in self.measured)


class _Eye:
    """One camera as the loop uses it: its pipeline, its drawn geometry, the mask its light passes."""

    def __init__(
        self, number: int, device: Device, design: Design, nsr: float, budget: Budget | None
    ) -> None:
        self.number = number
        self.optics = design.optics_1 if number == 1 else design.optics_2
        self.pipeline = CameraPipeline(
            device, self.optics, (design.region_rows, design.region_columns), (PEG, HOLE), nsr=nsr
        )
        self.replanner: Replanner | None = None
        if budget is not None:
            self.replanner = Replanner(
                device, self.optics, self.pipeline.shape, (PEG, HOLE), budget,
                frame_rate_hz=design.frame_rate_hz,
            )  # fmt: skip
        self.extent_px: dict[str, float] = {}
        self._templates: dict[str, Sequence[Template]] = {}
        self._limits: dict[str, TrackingLimits] = {}
        self._learnt: dict[tuple[CameraPipeline | WindowedPipeline, str], Sequence[Template]] = {}
        matrix, origin = design.projection(number)
        self.matrix: Array = np.asarray(matrix, dtype=np.float64)
        self.origin: Array = np.asarray(origin, dtype=np.float64) - np.array(design.region_origin_yx[::-1])
        # Camera 1 looks along z; camera 2 is turned about y, so that part of x is depth to it.
        tilt = 0.0 if number == 1 else design.tilt_rad
        self.depth_axis = np.array([-math.sin(tilt), 0.0, math.cos(tilt)])
        self.mask = Mask() if number == 1 else design.mask_2
        self.seen: dict[str, Features] = {}
        self.taught: dict[str, Features] = {}
        self.pictures: dict[str, tuple[Pixels, Array]] = {}
        self.turned_rad: dict[str, float] = {}
        self.taught_at_rad = 0.0

    def blur(self, world_um: Array) -> Blur:
        """Return what this camera's optics do to a part at a place, as drawn."""
        return Blur.of(self.mask, self.optics, self.depth_um(world_um))

    def project(self, world_um: Array) -> Array:
        """Return where the drawing says a place is seen."""
        return np.asarray(self.matrix @ world_um + self.origin)

    def depth_um(self, world_um: Array) -> float:
        """Return how far a place lies beyond this camera's plane in focus, as drawn."""
        return float(self.depth_axis @ world_um)

    def set_templates(
        self, part: str, templates: Sequence[Template], limits: TrackingLimits | None = None
    ) -> None:
        """Follow these features of a part; a pipeline learns them when it is next used."""
        limits = limits or self._limits.get(part)
        self._templates[part] = templates
        if limits is not None:
            self._limits[part] = limits

    def templates(self, part: str) -> Sequence[Template]:
        """Return the features of a part that are followed now."""
        return self._templates[part]

    def _taught(self, pipeline: CameraPipeline | WindowedPipeline) -> CameraPipeline | WindowedPipeline:
        for part, templates in self._templates.items():
            if self._learnt.get((pipeline, part)) is not templates:
                pipeline.set_templates(part, templates, self._limits.get(part))
                self._learnt[pipeline, part] = templates
        return pipeline

    def measure(
        self,
        frame: Pixels,
        blurs: Mapping[str, Blur | None],
        expected: Mapping[str, Array],
        *,
        planned: bool = False,
    ) -> dict[str, Features]:
        """Measure parts, as planned or as precisely as can be; remembers where they were seen."""
        if planned and self.replanner is not None:
            unrestored = self.replanner.unrestored
            as_planned = {part: None if part in unrestored else blur for part, blur in blurs.items()}
            found = self._taught(self.replanner.pipeline)(frame, as_planned, expected)
        else:
            found = self._taught(self.pipeline)(frame, blurs, expected)
        for part, measured in found.items():
            covariance = np.stack([m.covariance for m in measured])
            # A lost feature stays where it was expected, and weighs next to nothing.
            covariance = np.where(np.isfinite(covariance), covariance, 0.0)
            for k, m in enumerate(measured):
                if m.lost:
                    covariance[k] = 25.0 * np.eye(2)
            self.seen[part] = Features(np.stack([m.feature_xy_px for m in measured]), covariance, measured)
        return {part: self.seen[part] for part in found}


class Assembly:
    """One assembly run on one rig.

    Parameters
    ----------
    device
        The opened OpenCL device.
    rig, design, drawings
        What is driven, how it was drawn, and its parts' faces: "peg", "hole", and "peg over hole" with the
        rim that shows there.
    record
        Filled in as the run goes on; complete up to the last iteration whatever happens.
    options, progress, observer, milestone
        Choices; who is told of progress; who may add truth to each iteration; who is told of stages done.
    """

    def __init__(
        self,
        device: Device,
        rig: Rig,
        design: Design,
        drawings: Mapping[str, Drawing],
        record: RunRecord,
        *,
        options: Options | None = None,
        progress: Progress | None = None,
        observer: Observer | None = None,
        milestone: Milestone | None = None,
    ) -> None:
        self.rig = rig
        self.design = design
        self.drawings = drawings
        self.record = record
        self.options = options or Options()
        self._tell = progress or (lambda _stage, _sentence: None)
        self._observe = observer or (lambda iteration, _time_s: iteration)
        self._reached = milestone or (lambda _stage: None)
        self._encoder = SlmEncode(device, design.panel, design.optics_1)
        self.eyes = (
            _Eye(1, device, design, self.options.nsr, self.options.budget),
            _Eye(2, device, design, self.options.nsr, self.options.budget),
        )
        self._model = ModelCalibration(design.optics_1)
        self._calibration = PaperCalibration()
        self.world: dict[str, Array] = {PEG: np.zeros(3), HOLE: np.zeros(3)}
        """Where the parts are, as well as known: camera 1's axes, z the depth from its plane in focus."""
        self.stereo: StereoRig | None = None
        self._world_from_stage = np.zeros(3)
        self._rotation_arm_um = np.zeros(2)
        self._fine_px_per_um = np.eye(2)
        self._target: dict[str, float] = {}
        self._positions_left = list(POSITIONS)
        self._shown = False
        self._arm_at_rad = 0.0
        self._lost_in_a_row = 0
        self._peg_stands = True
        self._last_move_um = np.zeros(3)
        self._features: dict[str, tuple[int, int]] = {}
        self._last_frame_s: dict[int, float] = {}
        self._depth_offset_um, self._frames_fused = 0.0, 0
        self.depth_sigma_um = 0.0
        """How well the depth between the parts is known now: what the next mask covers beyond them."""

    # ---- the whole run ------------------------------------------------------------------------------------

    def run(self) -> RunRecord:
        """Do all of it; the stages are at rest when it returns or raises."""
        with self.stages_stopped_afterwards():
            self.prepare()
            self.assemble()
        return self.record

    def assemble(self) -> None:
        """Dock, from wherever the hole is: coarse, fine, insertion."""
        for stage, carry_out in (("coarse", self.coarse), ("fine", self.fine), ("insert", self.insert)):
            carry_out()
            self._reached(stage)
        self.record.docked = True
        self.record.end_state = "docked"

    @contextmanager
    def stages_stopped_afterwards(self) -> Iterator[None]:
        """Stop both stages however the block ends, and say in the record how it ended."""
        try:
            yield
        except KeyboardInterrupt:
            self.record.end_state = "interrupted"
            raise
        except AdofError as failure:
            self.record.end_state = f"stopped: {failure}"
            raise
        except BaseException as failure:
            self.record.end_state = f"failed: {type(failure).__name__}"
            raise
        finally:
            try:
                self.rig.coarse.stop()
            finally:
                self.rig.fine.stop()

    def prepare(self, known: StereoRig | None = None) -> None:
        """Find, focus, learn and calibrate: everything before the first servo step."""
        self.autofocus()
        # Seen from the side the peg stands before nothing, and its rim shows.
        self.take_templates(PEG, (self.drawings[PEG], self.drawings[PEG_OVER_HOLE]))
        self.take_templates(HOLE, (self.drawings[HOLE], self.drawings[HOLE]))
        self.calibrate(known)

    # ---- looking ------------------------------------------------------------------------------------------

    def show(self, mask: Mask) -> None:
        """Put a mask on the modulator and wait until it stands."""
        eye = self.eyes[0]
        if mask == eye.mask and self._shown:
            return
        self.rig.slm.show(self._encoder.codes(mask))
        eye.mask = mask
        self._shown = True
        self.rig.clock.wait(self.design.settling_s)

    def look(self) -> tuple[Frame, Frame]:
        """Take the next pair of frames.

        Raises
        ------
        TrackingError
            A camera gave an old frame again: a loop that went on would move on what is no longer so.
        """
        frames = self.rig.camera_1.grab(), self.rig.camera_2.grab()
        for number, frame in enumerate(frames, start=1):
            if not frame.time_s > self._last_frame_s.get(number, -math.inf):
                raise TrackingError(
                    f"camera {number} gave its frame of {frame.time_s:.3f} s again: check that it is running"
                )
            self._last_frame_s[number] = frame.time_s
        return frames

    def focused(self, depth_um: float) -> Mask:
        """Return the mask that brings a depth into focus and codes nothing."""
        return Mask(0.0, -self.design.optics_1.psi_rad(depth_um))

    def mask_for(self, near_um: float, far_um: float) -> Mask:
        """Choose the mask for a depth range by the operator's rule."""
        if self.options.mask == "fixed":
            return Mask(self.options.fixed_alpha_rad)
        if self.options.mask == "paper":
            return choose_mask(near_um, far_um, self._calibration, self.design.optics_1)
        return self.joint_mask(near_um, far_um)

    def joint_mask(self, near_um: float, far_um: float) -> Mask:
        """Choose cubic and focus together, the focus at the middle of the depth range."""
        optics = self.design.optics_1
        mask = choose_mask(near_um, far_um, self._model, optics, joint=True)
        # The criterion keeps a line pattern visible; tracking wants the whole band of the sensor, which lies
        # within |u| < 2 (1 - |psi| / (3 alpha)): docs/maths.md, eq. O6.
        defocus = max(abs(mask.psi_rad(optics, near_um)), abs(mask.psi_rad(optics, far_um)))
        return replace(mask, alpha_rad=max(mask.alpha_rad, defocus / (3 * _DEFOCUS_SHARE)))

    # ---- preparation --------------------------------------------------------------------------------------

    def autofocus(self) -> None:
        """Find both parts' depths by refocusing on the modulator; nothing moves (decision 0004)."""
        eye = self.eyes[0]
        for part, low_um, high_um in ((PEG, -600.0, 600.0), (HOLE, 3000.0, 4600.0)):
            rows, columns = self._window(eye.project(self.world[part]), 75 if part == PEG else 130)

            def picture(depth_um: float, at: tuple[slice, slice] = (rows, columns)) -> Pixels:
                self.show(self.focused(depth_um))
                return self.rig.camera_1.grab().pixels[at]

            found = focus_sweep(picture, low_um, high_um)
            self.world[part] = np.array([0.0, 0.0, found.position])
            self.depth_sigma_um = math.hypot(self.depth_sigma_um, found.sigma)
            self._tell("autofocus", f"{part} at {found.position:.0f} ± {found.sigma:.0f} µm")

    def take_templates(self, part: str, drawings: Sequence[Drawing]) -> None:
        """Take pictures of a part's features in focus, tied to its drawing: one for each camera, 1 first."""
        self.show(self.focused(float(self.world[part][2])))
        frames = [self.look() for _ in range(_TAUGHT_FRAMES)]
        for eye, taken, drawing in zip(self.eyes, zip(*frames, strict=True), drawings, strict=False):
            pictures = [frame.pixels for frame in taken]
            if eye.number == 2:
                blur = {part: eye.blur(self.world[part])}
                pictures = [eye.pipeline.restored(picture, blur)[part] for picture in pictures]
            image, noise = still_picture(pictures)
            known = part in eye.seen
            expected = eye.seen[part].middle if known else eye.project(self.world[part])
            reach = 15.0 if known else 60.0 if eye.number == 1 else 30.0
            found = register(image, drawing, eye.matrix[:, :2], expected_px=expected, reach_px=reach)
            if eye.number == 1:
                middle = np.linalg.solve(eye.matrix[:, :2], found.origin_px - eye.origin)
                self.world[part] = np.array([*middle, self.world[part][2]])
                if part not in eye.seen:
                    # The peg may stand in front of one corner of the hole: never of both on this diagonal.
                    aside = self.world[HOLE] - self.world[PEG]
                    self._features[part] = _DIAGONALS[int(part == HOLE and aside[0] * aside[1] > 0)]
            corners = found.pixels(self._design_of(part).corners_um[list(self._features[part])])
            self._keep_templates(eye, part, image, noise, corners)
        self._tell("templates", f"{part}: features taken in focus")

    def _design_of(self, part: str) -> PartDesign:
        return self.design.peg if part == PEG else self.design.hole

    def _keep_templates(self, eye: _Eye, part: str, image: Pixels, noise: Array, corners: Array) -> None:
        covariance = np.broadcast_to(0.01 * np.eye(2), (len(corners), 2, 2))
        eye.seen[part] = eye.taught[part] = Features(corners, covariance, [])
        eye.pictures[part] = image, noise
        eye.turned_rad[part] = 0.0
        eye.taught_at_rad = self.rig.coarse.position()["theta"]
        templates = cut_templates(image, corners, part, noise=noise, optics=eye.optics)
        eye.set_templates(part, templates, TrackingLimits(mismatch=0.7))
        eye.extent_px[part] = extent_px(templates, corners)

    def _turn_templates(self, theta: float) -> None:
        """Turn the hole's templates with the hole, as each camera sees a turn."""
        for eye in self.eyes:
            turned = theta - eye.taught_at_rad
            if abs(turned - eye.turned_rad[HOLE]) < _TURN_RAD:
                continue
            eye.turned_rad[HOLE] = turned
            c, s = math.cos(turned), math.sin(turned)
            block = eye.matrix[:, :2]
            seen = block @ np.array([[c, -s], [s, c]]) @ np.linalg.inv(block)
            corners = eye.taught[HOLE].xy_px
            picture, noise = eye.pictures[HOLE]
            templates = cut_templates(picture, corners, HOLE, seen, noise=noise, optics=eye.optics)
            eye.set_templates(HOLE, templates)

    def _window(self, centre_xy: Array, half: int) -> tuple[slice, slice]:
        rows, columns = self.design.region_rows, self.design.region_columns
        x, y = (round(float(v)) for v in centre_xy)
        return slice(max(0, y - half), min(rows, y + half)), slice(max(0, x - half), min(columns, x + half))

    def calibrate(self, known: StereoRig | None = None) -> None:
        """Learn how cameras, rotation and fine axes lie to the coarse stage; the hole ends where it began.

        Parameters
        ----------
        known
            A calibration of these cameras and this stage, taken before; without it the hole is stepped
            through the work volume.
        """
        start = dict(self.rig.coarse.position())
        self._target = dict(start)
        self._world_from_stage = self.world[HOLE] - np.array([start["x"], start["y"], start["z"]])
        self.stereo = known or self._step_target(start)
        self._learn_rotation(start)
        self._learn_fine_stage()

    def _step_target(self, start: Mapping[str, float]) -> StereoRig:
        """Calibrate both cameras with the hole's middle as target: the stage's readings are the world."""
        depth = float(self.world[HOLE][2])
        points: list[list[float]] = []
        pixels: tuple[list[Array], list[Array]] = ([], [])
        covariances: tuple[list[Array], list[Array]] = ([], [])
        # Down to where the peg's tip is 200 um away whatever x and y are: to dock near is to measure near.
        planes = np.linspace(depth, float(self.world[PEG][2]) + 500.0, 5)
        # About where the peg stands, leaning to the side on which camera 2 does not see the peg in front.
        middle = np.array([start["x"], start["y"]]) + (self.world[PEG] - self.world[HOLE])[:2]
        steps = ((0.0, 0.0), (600.0, -300.0), (600.0, 300.0), (-400.0, 300.0), (-400.0, -300.0))
        hidden = 0
        for number, plane in enumerate(planes):
            self._tell("calibration", f"plane {number + 1} of {len(planes)}, {plane:.0f} µm deep")
            for dx, dy in steps:
                there = {"x": middle[0] + dx, "y": middle[1] + dy, "z": start["z"] + plane - depth}
                seen = self.move_hole(there)
                if any(features.lost or features.bent_px(eye.taught[HOLE]) > _BENT_PX
                       for features, eye in zip(seen, self.eyes, strict=True)):  # fmt: skip
                    hidden += 1
                    continue
                reading = self.rig.coarse.position()
                points.append([reading["x"], reading["y"], reading["z"]])
                for k, features in enumerate(seen):
                    pixels[k].append(features.middle)
                    covariances[k].append(features.middle_covariance)
        self.move_hole({axis: start[axis] for axis in ("x", "y", "z")})
        volume = np.array(
            [
                [start["x"] - 600, start["y"] - 600, start["z"] - depth],
                [start["x"] + 600, start["y"] + 600, start["z"] + 200],
            ]
        )
        cameras = [
            calibrate_camera(
                np.array(points),
                np.array(pixels[k]),
                covariance_px2=np.array(covariances[k]),
                work_volume_um=volume,
                camera_id=camera_id,
            )
            for k, camera_id in enumerate(self.options.camera_ids)
        ]
        stereo = StereoRig(cameras[0], cameras[1])
        sigma_z = stereo.sigma_z_um()
        tilt = math.degrees(stereo.angle_rad)
        self._tell(
            "calibration",
            f"{len(points)} places ({hidden} hidden behind the peg), cameras {tilt:.2f}° apart, "
            f"depth good to {sigma_z:.2f} µm",
        )
        return stereo

    def move_hole(self, there: Mapping[str, float]) -> tuple[Features, Features]:
        """Move the hole, focus on it, and measure it in both cameras."""
        before = self._hole_world()
        self.rig.coarse.move_to(there)
        self.rig.coarse.wait_until_still()
        world = self._hole_world()
        self.world[HOLE] = world
        self.show(self.focused(float(world[2])))
        self._turn_templates(self.rig.coarse.position()["theta"])
        frames = self.look()
        found = []
        for eye, frame in zip(self.eyes, frames, strict=True):
            expected = eye.seen[HOLE].xy_px + eye.matrix @ (world - before)
            features = eye.measure(frame.pixels, {HOLE: eye.blur(world)}, {HOLE: expected})[HOLE]
            found.append(features)
        return found[0], found[1]

    def _hole_world(self, reading: Mapping[str, float] | None = None) -> Array:
        reading = reading or self.rig.coarse.position()
        return np.array([reading["x"], reading["y"], reading["z"]]) + self._world_from_stage

    def _learn_rotation(self, start: Mapping[str, float]) -> None:
        """Turn the hole a little and see about which point it turned."""
        assert self.stereo is not None
        camera = self.stereo.camera_1
        before = self.eyes[0].seen[HOLE].middle
        angle = -math.copysign(0.03, start["theta"]) if start["theta"] else 0.03
        after = self.move_hole({"theta": start["theta"] + angle})[0].middle
        turned = self.rig.coarse.position()["theta"] - start["theta"]
        moved = camera.motion_um((after - before)[None])[0]
        jog_test([[turned]], [[self._seen_turn()]])
        c, s = math.cos(turned), math.sin(turned)
        # moved = (R - 1) arm, with the arm from the rotation's centre to the hole's middle.
        self._rotation_arm_um = np.linalg.solve(np.array([[c - 1, -s], [s, c - 1]]), moved)
        self._arm_at_rad = start["theta"]
        self.move_hole({"theta": start["theta"]})

    def _seen_turn(self) -> float:
        """Return how far camera 1 sees the hole turned since its templates were taken."""
        assert self.stereo is not None
        block, eye = self.stereo.camera_1.matrix_px_per_um[:, :2], self.eyes[0]
        taught, seen = (np.diff(f.xy_px, axis=0)[0] for f in (eye.taught[HOLE], eye.seen[HOLE]))
        return _turn_between(np.linalg.solve(block, taught), np.linalg.solve(block, seen))

    def _learn_fine_stage(self) -> None:
        """Jog the peg along both fine axes; refuse a stage that does not go where it is sent."""
        assert self.stereo is not None
        fine, eye = self.rig.fine, self.eyes[0]
        start = dict(fine.position())
        self.show(self.focused(float(self.world[PEG][2])))

        def peg_middle() -> Array:
            frame = self.rig.camera_1.grab()
            found = eye.measure(frame.pixels, {PEG: eye.blur(self.world[PEG])}, {PEG: eye.seen[PEG].xy_px})[
                PEG
            ]
            if found.lost:
                raise TrackingError("the peg was lost while its stage was jogged: check its light and grip")
            return found.middle

        home = peg_middle()
        columns = []
        for axis in ("x", "y"):
            fine.move_to({axis: start[axis] + 60.0})
            fine.wait_until_still()
            columns.append((peg_middle() - home) / 60.0)
            fine.move_to({axis: start[axis]})
            fine.wait_until_still()
        self._fine_px_per_um = np.stack(columns, axis=1)
        observed = self.stereo.camera_1.motion_um(60.0 * np.stack(columns))
        jog_test(60.0 * np.eye(2), observed)
        peg_middle()

    def bring_hole_to(self, depth_um: float) -> None:
        """Put the hole under the peg, aligned, so far below the peg's face: for surveys, not for docking."""
        self._target = dict(self.rig.coarse.position())
        self._last_move_um = np.zeros(3)
        for _ in range(5):
            self.show(self._next_mask())
            sight = self._see()
            self._move(np.array([*sight.error_um, sight.error_rad, depth_um - sight.depth_um]))
            self.rig.coarse.wait_until_still()
        self.show(self._next_mask())
        self._see()
        self._last_move_um = np.zeros(3)

    # ---- the loop -----------------------------------------------------------------------------------------

    def coarse(self) -> None:
        """Bring the hole under the peg: x, y, theta from the image, z from depth, to the stand-off."""
        assert self.stereo is not None
        self._peg_stands = True
        design = self.design
        axes = StageAxes(
            x=replace(self._axis("x", "um"), hysteresis=0.3),
            y=replace(self._axis("y", "um"), hysteresis=0.3),
            theta=replace(self._axis("theta", "rad"), dead_band=5e-4, hysteresis=2e-4),
            z=replace(self._axis("z", "um"), dead_band=0.2, hysteresis=0.4),
        )
        period_s = design.settling_s + 2 / design.frame_rate_hz
        law = ServoLaw.from_delay(self.stereo.camera_1, axes, period_s, period_s)
        quantiser = StageQuantiser(axes)
        self._target = dict(self.rig.coarse.position())
        self.show(self._next_mask())
        taught, resting = False, 0
        last_s = self.rig.clock.now_s - period_s
        while resting < 5:
            sight = self._see()
            now_s = self.rig.clock.now_s
            aligned = math.hypot(*sight.error_um) < 15 and abs(sight.error_rad) < 0.01
            wanted = self.options.stand_off_um if aligned and taught else _GATE_UM
            if sight.usable:
                left_um = wanted - self._fused_depth_um(sight)
                error = law.error(sight.hole_px, sight.desired_px, sight.centre_um, left_um)
                command = law.command(error, quantiser.wake(error))
                # A loop held up takes no longer steps than its law was made for.
                move = quantiser.move(command, min(now_s - last_s, period_s)).array
            else:
                command, move = VelocityCommand.zero(), np.zeros(4)
            last_s = now_s
            mask = self._next_mask()
            codes = None if mask == self.eyes[0].mask else self._encoder.codes(mask)
            decided = time.perf_counter()
            self._move(move)
            self._note("coarse", sight, wanted, command.array, sight.stages(decided, sent=bool(np.any(move))))
            self._change(mask, codes)
            if not sight.usable:
                continue
            if aligned and not taught and abs(sight.depth_um - _GATE_UM) < 30:
                self._teach_again()
                taught = True
                last_s = self.rig.clock.now_s - period_s
            resting = resting + 1 if quantiser.at_rest and wanted == self.options.stand_off_um else 0
        self.rig.coarse.wait_until_still()
        self._tell("coarse", f"hole at its stand-off, {sight.depth_um:.1f} µm under the peg's face")

    def fine(self) -> None:
        """Centre the peg over the hole with the fine stage, from features taken in focus once more."""
        self._peg_stands = False
        self._teach_again()
        self._centre(tolerance_um=0.25, wanted_um=self.options.stand_off_um)
        self._tell("fine", "peg centred over the hole")

    def insert(self) -> None:
        """Raise the hole around the peg, the fine stage keeping it centred."""
        self._centre(tolerance_um=0.25, wanted_um=self.options.seat_um)
        self._tell("insert", "peg seated")

    def _centre(self, *, tolerance_um: float, wanted_um: float) -> None:
        """Servo the peg's x, y on the fine stage and the hole's z, until both rest."""
        assert self.stereo is not None
        fine = self.rig.fine
        target = dict(fine.position())
        self._target = dict(self.rig.coarse.position())
        step_um = 12.0  # of z at a time: x and y keep up with the walk of half a degree
        inverse = np.linalg.inv(self._fine_px_per_um)
        resting = 0
        mean_um, count = np.zeros(2), 0
        last_s = self.rig.clock.now_s - 1 / self.design.frame_rate_hz
        while resting < 6:
            sight = self._see()
            dt_s, last_s = self.rig.clock.now_s - last_s, self.rig.clock.now_s
            mask = self._next_mask()
            codes = None if mask == self.eyes[0].mask else self._encoder.codes(mask)
            clear = math.hypot(*sight.error_um) < 15
            if sight.usable:
                z_left = wanted_um - self._fused_depth_um(sight)
                # A running mean over up to eight frames: the stage is finer than one frame's noise.
                count = min(count + 1, 8) if abs(z_left) < 2 * step_um else 1
                mean_um += (sight.error_um - mean_um) / count
                peg_px = self.stereo.camera_1.matrix_px_per_um[:, :2] @ -mean_um
                move = inverse @ peg_px * (0.5 if count < 3 else 0.25)
                dz = float(np.clip(0.5 * z_left, -step_um, step_um)) if clear else 0.0
            else:
                move, dz, z_left = np.zeros(2), 0.0, math.inf
            decided = time.perf_counter()
            target = {"x": target["x"] + float(move[0]), "y": target["y"] + float(move[1])}
            fine.move_to(target)
            # What the stage was told to mend is mended: the mean starts again from there.
            mean_um -= np.linalg.solve(
                self.stereo.camera_1.matrix_px_per_um[:, :2], -self._fine_px_per_um @ move
            )
            self._move(np.array([0.0, 0.0, 0.0, dz]))
            stages = sight.stages(decided, sent=True)
            self._note("fine" if wanted_um == self.options.stand_off_um else "insert", sight, wanted_um,
                       np.array([move[0], move[1], 0.0, dz]) / dt_s, stages)  # fmt: skip
            self._change(mask, codes)
            calm = sight.usable and count >= 6 and math.hypot(*mean_um) < tolerance_um and abs(z_left) < 0.5
            resting = resting + 1 if calm else 0
        fine.wait_until_still()
        self.rig.coarse.wait_until_still()

    def _teach_again(self) -> None:
        """Let everything come to rest and take the features of both parts anew, in focus.

        In camera 1 only: to camera 2 the peg by now hides some of the marks around the hole.
        """
        self.rig.coarse.wait_until_still()
        self.rig.fine.wait_until_still()
        self.take_templates(PEG, (self.drawings[PEG_OVER_HOLE],))
        self.take_templates(HOLE, (self.drawings[HOLE],))
        self._last_move_um = np.zeros(3)
        self.show(self._next_mask())

    def _axis(self, name: str, unit: Literal["um", "rad"]) -> StageAxis:
        stage = self.rig.coarse
        return StageAxis(unit, stage.resolution[name], 0.8 * stage.speed_limits[name])

    def _next_mask(self) -> Mask:
        """Choose the mask for where the parts are; a mask that is as good stays, for changing costs time."""
        near, far = self._depths()
        beyond = _DEPTH_SIGMAS * self.depth_sigma_um
        wanted = self.mask_for(near - beyond, far + beyond)
        eye = self.eyes[0]
        if eye.replanner is not None:
            plan = eye.replanner.plan(*self._to_see(eye))
            wanted = wanted if plan is None else plan.mask
        now = self.eyes[0].mask
        close = (
            abs(wanted.alpha_rad - now.alpha_rad) < 0.25
            and abs(wanted.focus_psi_rad - now.focus_psi_rad) < 0.25
        )
        if close and self.options.mask == "joint" and eye.replanner is None:
            # Sigma itself scatters: two of three are enough to stay.
            margin = depth_margin_um(now, eye.optics, near, far, _DEFOCUS_SHARE)
            close = margin >= beyond * 2 / 3 or wanted == now
        return now if close else wanted

    def _depths(self) -> tuple[float, float]:
        """Return the nearest and the farthest depth that a mask must cover."""
        peg, hole = float(self.world[PEG][2]), float(self.world[HOLE][2])
        return min(peg, hole, 0.0), max(peg, hole)

    def _change(self, mask: Mask, codes: Pixels | None) -> None:
        if codes is not None:
            self.rig.slm.show(codes)
            self.eyes[0].mask = mask
            self.rig.clock.wait(self.design.settling_s)

    def _move(self, steps: Array) -> None:
        """Send the coarse stage on by x, y, theta, z; what was sent before is not forgotten."""
        for axis, step in zip(("x", "y", "theta", "z"), steps.tolist(), strict=True):
            self._target[axis] += step
        if np.any(steps):
            self.rig.coarse.move_to(self._target)
        self._last_move_um = np.array([steps[0], steps[1], steps[3]])
        self.world[HOLE] = self.world[HOLE] + self._last_move_um

    def _see(self) -> _Sight:
        """Take a pair of frames and say where the parts are, and where the hole should be."""
        assert self.stereo is not None
        frames = self.look()
        begun = time.perf_counter()
        # Where the stage stood in the picture: by now it may be farther on.
        reading = self.rig.coarse.position_at(frames[0].time_s)
        age_s = self.rig.clock.now_s - (frames[0].time_s + self.design.exposure_s / 2)
        self._turn_templates(reading["theta"])
        for eye, frame in zip(self.eyes, frames, strict=True):
            expected = {part: eye.seen[part].xy_px for part in (PEG, HOLE)}
            expected[HOLE] = expected[HOLE] + eye.matrix @ self._last_move_um
            blurs = {part: eye.blur(self.world[part]) for part in (PEG, HOLE)}
            self._replan(eye)
            eye.measure(frame.pixels, blurs, expected, planned=True)
        seen = [eye.seen for eye in self.eyes]
        lost_peg, lost_hole = (sum(s[part].lost for s in seen) for part in (PEG, HOLE))
        fix = triangulate_relative(
            self.stereo,
            seen[0][PEG].middle,
            seen[1][PEG].middle,
            seen[0][HOLE].middle,
            seen[1][HOLE].middle,
            seen[0][PEG].middle_covariance + seen[0][HOLE].middle_covariance,
            seen[1][PEG].middle_covariance + seen[1][HOLE].middle_covariance,
        )
        # A peg that stands still is where it was, also while the hole's edge behind it spoils its picture.
        blind = bool(lost_hole or (lost_peg and not self._peg_stands))
        self._lost_in_a_row = self._lost_in_a_row + 1 if blind else 0
        if self._lost_in_a_row > _LOST_LIMIT:
            reasons = [m.reason for s in seen for part in (PEG, HOLE) for m in s[part].measured if m.lost]
            raise TrackingError(
                f"features were lost for {_LOST_LIMIT} frames in a row ({reasons[0]}): check light and view, "
                "then start again"
            )
        if blind:
            # Nothing was measured: the mask widens until something is.
            self.depth_sigma_um = min(max(2 * self.depth_sigma_um, 1.0), _MOST_SIGMA_UM)
        else:
            self.depth_sigma_um = min(float(fix.sigma_um[2]), _MOST_SIGMA_UM)
            self.world[HOLE] = self.world[PEG] + fix.xyz_um
            self._require_agreement(reading)
        block = self.stereo.camera_1.matrix_px_per_um[:, :2]
        peg, hole = seen[0][PEG], seen[0][HOLE]
        desired = self._desired(block, peg)
        middle_z = float(self.world[HOLE][2] - self._world_from_stage[2])
        turned = reading["theta"] - self._arm_at_rad
        c, s = math.cos(turned), math.sin(turned)
        arm = np.array([[c, -s], [s, c]]) @ self._rotation_arm_um
        at = np.linalg.solve(block, hole.middle - self.stereo.camera_1.project([0.0, 0.0, middle_z]))
        return _Sight(
            begun=begun,
            seen=time.perf_counter(),
            age_s=age_s,
            stage_z_um=float(reading["z"]),
            frame=frames[0],
            hole_px=hole.xy_px,
            desired_px=desired,
            centre_um=np.array([*(at - arm), middle_z]),
            error_um=np.linalg.solve(block, desired.mean(axis=0) - hole.middle),
            error_rad=_turn_between(
                np.linalg.solve(block, hole.xy_px[1] - hole.xy_px[0]),
                np.linalg.solve(block, desired[1] - desired[0]),
            ),
            depth_um=float(fix.xyz_um[2]),
            depth_sigma_um=float(fix.sigma_um[2]),
            hole_sigma_px=hole.sigma_px,
            peg_sigma_px=peg.sigma_px,
            residual_px=float(fix.residual_px),
            lost=lost_peg + lost_hole,
            usable=not blind,
            ssd_hole=float(np.mean([m.ssd for m in hole.measured])),
            ssd_peg=float(np.mean([m.ssd for m in peg.measured])),
        )

    def _replan(self, eye: _Eye) -> None:
        """Choose how this camera's parts are followed: for where they are, through the mask in force."""
        if eye.replanner is None:
            return
        # What was lost is looked for as carefully as can be.
        plan = None if self._lost_in_a_row else eye.replanner.plan(*self._to_see(eye), eye.mask)
        eye.replanner.choose(plan)

    def _to_see(self, eye: _Eye) -> tuple[Scene, float]:
        """Return the scene of one camera, and how far the hole has still to go in depth."""
        assert eye.replanner is not None
        depths = {part: eye.depth_um(self.world[part]) for part in (PEG, HOLE)}
        speed = abs(float(self._last_move_um[2])) * self.design.frame_rate_hz
        left_um = abs(float(self.world[HOLE][2] - self.world[PEG][2])) - self.options.stand_off_um
        scene = eye.replanner.scene(depths, eye.extent_px, speed, self.depth_sigma_um)
        return scene, max(left_um, 0.0)

    def _fused_depth_um(self, sight: _Sight) -> float:
        """Return the depth from the z stage, tied to vision by the last frames.

        The stage's steps are a thirtieth of one frame's depth noise: a running mean of what vision says of
        the stage's zero is better than the last frame.
        """
        self._frames_fused = min(self._frames_fused + 1, _FUSED_FRAMES)
        offset = sight.depth_um - sight.stage_z_um
        self._depth_offset_um += (offset - self._depth_offset_um) / self._frames_fused
        return self._depth_offset_um + float(self.rig.coarse.position()["z"])

    def _require_agreement(self, reading: Mapping[str, float]) -> None:
        """Refuse to go on when vision and stage tell different stories of where the hole is.

        Raises
        ------
        TrackingError
            They differ by more than calibration, rotation about a centre off the hole and motion during an
            exposure can explain.
        """
        apart = float(np.linalg.norm(self.world[HOLE] - self._hole_world(reading)))
        if apart > _DISAGREEMENT_UM:
            raise TrackingError(
                f"the hole is seen {apart:.0f} um from where its stage says it is, at most "
                f"{_DISAGREEMENT_UM:.0f} was wanted: check cameras and stage, then start again"
            )

    def _desired(self, block: Array, peg: Features) -> Array:
        """Return where the hole's corners belong: around the peg's middle, turned as the peg is."""
        drawn = self.design.peg.corners_um[list(self._features[PEG])]
        turn = _turn_between(drawn[1] - drawn[0], np.linalg.solve(block, peg.xy_px[1] - peg.xy_px[0]))
        c, s = math.cos(turn), math.sin(turn)
        corners = self.design.hole.corners_um[list(self._features[HOLE])] @ np.array([[c, s], [-s, c]])
        return np.asarray(peg.middle + corners @ block.T)

    def _note(self, stage: str, sight: _Sight, wanted_um: float, velocity: Array, latency: Latency) -> None:
        """Add one iteration to the record, and a named position where the hole passes it."""
        mask = self.eyes[0].mask
        number = len(self.record.iterations)
        if number >= self.options.iteration_limit:
            raise TrackingError(
                f"the loop did not come to rest within {self.options.iteration_limit} iterations: look at "
                "the servo errors in the report"
            )
        vx, vy, vtheta, vz = velocity.tolist()
        iteration = Iteration(
            number=number,
            time_s=sight.frame.time_s,
            stage=stage,
            alpha_rad=mask.alpha_rad,
            focus_psi_rad=mask.focus_psi_rad,
            depth_margin_um=depth_margin_um(mask, self.design.optics_1, *self._depths(), _DEFOCUS_SHARE),
            hole_sigma_px=sight.hole_sigma_px,
            peg_sigma_px=sight.peg_sigma_px,
            hole_depth_um=sight.depth_um,
            hole_depth_sigma_um=sight.depth_sigma_um,
            error_x_um=float(sight.error_um[0]),
            error_y_um=float(sight.error_um[1]),
            error_theta_rad=sight.error_rad,
            error_z_um=wanted_um - sight.depth_um,
            velocity=(vx, vy, vz, vtheta),
            ssd_hole=sight.ssd_hole,
            ssd_peg=sight.ssd_peg,
            epipolar_residual_px=sight.residual_px,
            lost_features=sight.lost,
            compute_ms=latency.features_ms + latency.law_ms,
            latency=latency,
            hole_xy_px=tuple(sight.hole_px.mean(axis=0).tolist()),
        )
        iteration = self._observe(iteration, sight.frame.time_s)
        self.record.iterations.append(iteration)
        self._tell(
            stage,
            f"depth {sight.depth_um:7.1f} µm  α {mask.alpha_rad:5.1f}  "
            f"x {sight.error_um[0]:7.1f}  y {sight.error_um[1]:7.1f} µm  θ {1e3 * sight.error_rad:6.2f} mrad",
        )
        passed = [p for p in self._positions_left if number == 0 or sight.depth_um <= p[1]]
        if passed and stage == "coarse" and sight.usable:
            name = passed[-1][0] if number else passed[0][0]
            self._positions_left = self._positions_left[
                1 + [p[0] for p in self._positions_left].index(name) :
            ]
            eye = self.eyes[0]
            if eye.replanner is None:
                images = eye.pipeline.last_images()
            else:  # a picture of the whole frame, which no plan restores
                blurs = {part: eye.blur(self.world[part]) for part in (PEG, HOLE)}
                images = eye.pipeline.restored(sight.frame.pixels, blurs)
            bias = np.array(iteration.hole_bias_px) * self.design.optics_1.object_pitch_um
            depth = iteration.true_depth_um
            blur = eye.blur(self.world[HOLE])
            quality = filter_quality(eye.optics, blur.alpha_rad, blur.psi_rad, self.options.nsr)
            self.record.positions.append(
                Position(
                    name=name,
                    depth_um=depth if math.isfinite(depth) else sight.depth_um,
                    depth_est_um=sight.depth_um,
                    alpha=mask.alpha_rad,
                    focus_psi=mask.focus_psi_rad,
                    ssd_hole=sight.ssd_hole,
                    ssd_peg=sight.ssd_peg,
                    lateral_bias_um=(float(bias[0]), float(bias[1])),
                    depth_sigma_um=sight.depth_sigma_um,
                    hole_sigma_px=sight.hole_sigma_px,
                    peg_sigma_px=sight.peg_sigma_px,
                    depth_margin_um=iteration.depth_margin_um,
                    noise_gain=quality.noise_gain,
                    resolution_lp_per_mm=quality.resolution_lp_per_mm,
                    raw=sight.frame.pixels,
                    restored_hole=images[HOLE],
                    restored_peg=images[PEG],
                )
            )


@dataclass(frozen=True, eq=False)
class _Sight:
    """What one pair of frames says."""

    begun: float
    seen: float
    age_s: float
    stage_z_um: float
    frame: Frame
    hole_px: Array
    desired_px: Array
    centre_um: Array
    error_um: Array
    error_rad: float
    depth_um: float
    depth_sigma_um: float
    hole_sigma_px: float
    peg_sigma_px: float
    residual_px: float
    lost: int
    usable: bool
    ssd_hole: float
    ssd_peg: float

    def stages(self, decided: float, *, sent: bool) -> Latency:
        """Return how long each stage took up to now; without a command there is no last one."""
        return Latency(
            frame_ms=1e3 * self.age_s,
            features_ms=1e3 * (self.seen - self.begun),
            law_ms=1e3 * (decided - self.seen),
            command_ms=1e3 * (time.perf_counter() - decided) if sent else math.nan,
        )


def still_picture(pictures: Sequence[Pixels]) -> tuple[Pixels, Array]:
    """Return the mean of pictures of what stands still, and the standard deviation of its noise.

    A template's own noise moves every place that it finds alike, and noise in its slopes passes for texture.

    Returns
    -------
    picture : (rows, columns) uint8
    noise : (rows, columns)
    """
    values = np.stack(pictures).astype(np.float64)
    noise = values.std(axis=0, ddof=1) / math.sqrt(len(pictures))
    return np.rint(values.mean(axis=0)).astype(np.uint8), noise


def _noise_at(noise: Array | None, centre_xy: Array, shape: tuple[int, int]) -> float | None:
    if noise is None:
        return None
    x, y = (max(0, int(v)) for v in np.rint(centre_xy - np.array(shape[::-1]) / 2))
    return math.sqrt(float(np.mean(noise[y : y + shape[0], x : x + shape[1]] ** 2)))


def cut_templates(
    image: Pixels,
    corners: Array,
    part: str,
    seen_turn: Array | None = None,
    *,
    shape: tuple[int, int] = (20, 20),
    noise: Array | None = None,
    optics: OpticalSystem | None = None,
) -> list[Template]:
    """Cut the templates of a part's features where nothing but the part is, each anchored at its corner.

    Parameters
    ----------
    image
        In focus, or restored.
    corners : (k, 2)
        The features in it, (x, y).
    seen_turn : (2, 2), optional
        The pictures are turned by this about their corners first: how the camera sees the part turned.
    shape
        Rows and columns of each template.
    noise : (rows, columns), optional
        Standard deviation of the picture's noise; without it, estimated.
    optics
        The camera's, so that each template states what sampling does to its place.
    """
    templates = []
    middle = corners.mean(axis=0)
    for corner in corners:
        centre = corner + _INSET_PX[part] * np.sign(middle - corner)
        template = Template.cut(image, centre, shape, noise=_noise_at(noise, centre, shape), optics=optics)
        anchor = template.anchor_yx + (corner - centre)[::-1]
        if seen_turn is not None:
            offset = seen_turn @ (centre - corner)
            warp = np.column_stack([seen_turn, corner - seen_turn @ corner])
            turned = cv2.warpAffine(image, warp, image.shape[::-1], flags=cv2.INTER_CUBIC)
            template = Template.cut(turned, corner + offset, shape, noise=template.noise, optics=optics)
            anchor = template.anchor_yx - offset[::-1]
        templates.append(template.anchored(anchor))
    return templates


def _turn_between(before: Array, after: Array) -> float:
    """Return the angle from one direction to another, (-pi, pi]."""
    cross = before[0] * after[1] - before[1] * after[0]
    return math.atan2(float(cross), float(before @ after))
