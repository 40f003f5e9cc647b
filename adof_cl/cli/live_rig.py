"""A rig of real devices, or of emulated ones behind real protocols, as the loop meets it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from adof_cl.errors import InputError
from adof_cl.optics import OpticalSystem, SlmPanel
from adof_cl.record import RunRecord
from adof_cl.twin.design import Design, HolePlate, Peg
from adof_cl.twin.recorded import RecordedAxis
from adof_drivers.camera import WatchedCamera
from adof_drivers.camera_pair import CameraPair, FramePair
from adof_drivers.camera_sections import SensorSection
from adof_drivers.errors import DriverError
from adof_drivers.operator import Operator
from adof_drivers.operator_sections import SpaceMouseSection
from adof_drivers.rig import Positive, Section
from adof_drivers.safety import EnableLatch
from adof_drivers.slm import Slm
from adof_drivers.stage import MonotonicClock, Stage

CAMERAS = ("camera.1", "camera.2")
AXES = {"stage.coarse": ("x", "y", "z", "theta"), "stage.fine": ("x", "y")}
_DRAWN = Design()
_LATCH_ASKED_S = 0.05
_FOLLOWED_S = 0.004
_FIRST_PAIR_S = 10.0  # until a client has found out its packets' size and a camera has begun
_PAIR_S = 2.0


class DesignTable(BaseModel):
    """The table `[design]`: how the rig was drawn, where it differs from the paper's.

    Optics are both cameras'. Plate and hole, peg: outer sizes; their etched marks are the drawing's.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    wavelength_um: Positive = _DRAWN.optics_1.wavelength_um
    aperture_um: Positive = _DRAWN.optics_1.aperture_um
    f_number: Positive = _DRAWN.optics_1.f_number
    magnification: Positive = _DRAWN.optics_1.magnification
    pixel_pitch_um: Positive = _DRAWN.optics_1.pixel_pitch_um
    tilt_rad: Annotated[float, Field(allow_inf_nan=False)] = _DRAWN.tilt_rad
    depth_range_um: Positive = _DRAWN.depth_range_um
    peg_width_um: Positive = _DRAWN.peg.width_um
    peg_depth_um: Positive = _DRAWN.peg.depth_um
    peg_height_um: Positive = _DRAWN.peg.height_um
    hole_width_um: Positive = _DRAWN.hole.width_um
    hole_depth_um: Positive = _DRAWN.hole.depth_um
    plate_width_um: Positive = _DRAWN.hole.plate_width_um
    plate_depth_um: Positive = _DRAWN.hole.plate_depth_um
    plate_thickness_um: Positive = _DRAWN.hole.thickness_um


TABLES: dict[str, type[BaseModel]] = {"design": DesignTable}


@dataclass(frozen=True)
class LiveFrame:
    """A frame as the loop wants it: `time_s` is the middle of its exposure."""

    pixels: NDArray[np.uint8]
    time_s: float


class FreshPairs:
    """Both cameras' frames of one moment, exposed after they were asked for: what was commanded before shows.

    A thread takes every pair as it comes, so that none is lost while the loop is busy. Camera 2 gives the
    partner of what camera 1 gave last. Nothing is given once the latch has opened. A context.
    """

    def __init__(self, pair: CameraPair, latch: EnableLatch, *, exposure_s: float, timeout_s: float) -> None:
        self._pair, self._latch = pair, latch
        self._exposure_s, self._timeout_s = exposure_s, timeout_s
        self._partner: LiveFrame | None = None
        self._came = threading.Condition()
        self._last: FramePair | DriverError | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._take, name="frames", daemon=True)
        self.pairs, self.since_s = 0, time.monotonic()

    def __enter__(self) -> FreshPairs:
        self._pair.start()
        self.since_s = time.monotonic()
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._closing = True
        self._thread.join()
        self._pair.stop()

    def first(self) -> LiveFrame:
        """Wait for a new pair and return camera 1's frame of it."""
        pair = self._fresh()
        self._partner = self._live(pair.frame_2.pixels, pair.frame_2.time_s)
        return self._live(pair.frame_1.pixels, pair.frame_1.time_s)

    def second(self) -> LiveFrame:
        """Return the partner of the last frame."""
        if self._partner is None:
            self.first()
        partner, self._partner = self._partner, None
        assert partner is not None
        return partner

    def _take(self) -> None:
        timeout_s = _FIRST_PAIR_S
        while not self._closing:
            came: FramePair | DriverError
            try:
                came = self._pair.grab(timeout_s)
                timeout_s = self._timeout_s
                self.pairs += 1
            except DriverError as failure:
                came = failure
            with self._came:
                self._last = came
                self._came.notify_all()
            if isinstance(came, DriverError):
                return

    def _fresh(self) -> FramePair:
        asked_s = time.monotonic()
        with self._came:
            while True:
                self._latch.require()
                last = self._last
                if isinstance(last, DriverError):
                    raise last
                if last is not None and last.frame_1.time_s >= asked_s:
                    return last
                self._came.wait(_LATCH_ASKED_S)

    def _live(self, pixels: NDArray[Any], time_s: float) -> LiveFrame:
        return LiveFrame(pixels, time_s + self._exposure_s / 2)


@dataclass(frozen=True)
class LiveCamera:
    """One of the two, as the loop asks it."""

    number: int
    pairs: FreshPairs

    def grab(self) -> LiveFrame:
        """Return the next frame."""
        return self.pairs.first() if self.number == 1 else self.pairs.second()


class FollowedStage:
    """A stage whose axes are read all the time, so that it can say where it was when a frame was exposed.

    Every other word is the stage's own. A context.
    """

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self._reading = threading.Lock()
        self._read_s = time.monotonic()
        self._axes = {name: RecordedAxis(self._read_s, value) for name, value in stage.position().items()}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="positions", daemon=True)

    def __enter__(self) -> FollowedStage:
        self._thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self._closing.set()
        self._thread.join()

    def _follow(self) -> None:
        pause_s = _FOLLOWED_S
        while not self._closing.wait(pause_s):
            try:
                # A slow line is left to the commands for most of the time.
                pause_s = max(_FOLLOWED_S, 3 * self._read())
            except DriverError:
                return  # it is stopped; whoever asks next is told why

    def _read(self) -> float:
        """Read every axis and keep it; returns how long that took, s."""
        with self._reading:
            asked_s = time.monotonic()
            position = self.stage.position()
            answered_s = time.monotonic()
            for name, value in position.items():
                self._axes[name].add((asked_s + answered_s) / 2, value)
            self._read_s = asked_s
        return answered_s - asked_s

    def position_at(self, time_s: float) -> dict[str, float]:
        """Return where every axis was, straight on between two readings."""
        if self._read_s < time_s:  # the thread was held up
            self._read()
        return {name: float(axis.at(time_s)) for name, axis in self._axes.items()}

    @property
    def resolution(self) -> dict[str, float]:
        """Smallest step of each axis."""
        return self.stage.resolution

    @property
    def speed_limits(self) -> dict[str, float]:
        """Fastest speed of each axis."""
        return self.stage.speed_limits

    def position(self) -> dict[str, float]:
        """Read every axis."""
        return self.stage.position()

    def move_to(self, targets: Mapping[str, float], *, speed: float | None = None) -> None:
        """Leave for the given positions."""
        self.stage.move_to(targets, speed=speed)

    def stop(self) -> None:
        """Bring every axis to rest."""
        self.stage.stop()

    def wait_until_still(self) -> None:
        """Wait until nothing moves."""
        self.stage.wait_until_still()


@dataclass(frozen=True)
class LiveRig:
    """What the loop drives, and how it was drawn."""

    design: Design
    camera_1: LiveCamera
    camera_2: LiveCamera
    slm: Slm
    coarse: FollowedStage
    fine: FollowedStage
    clock: MonotonicClock
    operator: Operator
    watched: tuple[WatchedCamera, WatchedCamera]
    pair: CameraPair
    pairs: FreshPairs

    def home(self) -> None:
        """Let every axis that has to find its reference, the coarse stage's depth first."""
        for stage in (self.coarse.stage, self.fine.stage):
            stage.enable()
            lost = [name for name, known in stage.homed().items() if not known]
            for first in ([name for name in lost if name == "z"], [name for name in lost if name != "z"]):
                if first:
                    stage.home(first, confirm=True)


def require_whole(sections: Mapping[str, Section]) -> None:
    """Refuse a rig file that names too little to run on.

    Raises
    ------
    InputError
        Two cameras with a region, one modulator, a coarse and a fine stage were wanted.
    """
    missing = [place for place in (*CAMERAS, *AXES) if place not in sections]
    panels = [place for place in sections if place.startswith("slm.")]
    if len(panels) != 1:
        missing.append("one slm" if not panels else f"one slm instead of {len(panels)}")
    if missing:
        raise InputError(f"the rig file lacks {', '.join(missing)}: a run needs all of these")
    for place in CAMERAS:
        section = sections[place]
        stated = isinstance(section, SensorSection) and (section.region, section.rate_hz, section.exposure_s)
        if not stated or None in stated:
            raise InputError(
                f"{place} has to state its region, rate_hz and exposure_s: the loop is timed by them"
            )
    for place, axes in AXES.items():
        there = sections[place].axes  # type: ignore[attr-defined]
        if absent := [axis for axis in axes if axis not in there]:
            raise InputError(f"{place} lacks the axis {', '.join(absent)}: {', '.join(axes)} were wanted")


def design_of(sections: Mapping[str, Any], sensor: tuple[int, int]) -> Design:
    """Return the rig as drawn, from the table and from what the devices' sections state.

    Raises
    ------
    InputError
        The two cameras' regions or rates differ, or their region is not at the sensor's middle.
    """
    table: DesignTable = sections.get("design") or DesignTable()
    first, second = (sections[place] for place in CAMERAS)
    for name in ("region", "rate_hz", "exposure_s"):
        if getattr(first, name) != getattr(second, name):
            raise InputError(f"{name} of camera.1 and camera.2 differ: the loop wants frames that pair")
    name, slm = next((place, s) for place, s in sections.items() if place.startswith("slm."))
    optics = OpticalSystem(
        table.wavelength_um, table.aperture_um, table.f_number, table.magnification, table.pixel_pitch_um
    )
    design = Design(
        optics_1=optics,
        optics_2=optics,
        rows=sensor[0],
        columns=sensor[1],
        region_rows=first.rows,
        region_columns=first.columns,
        frame_rate_hz=first.rate_hz,
        exposure_s=first.exposure_s,
        panel=SlmPanel(
            name.partition(".")[2], slm.rows, slm.columns, slm.pitch_um, slm.fill_factor, slm.refresh_hz,
            slm.stroke_rad, "rig file",
        ),
        settling_s=slm.settling_s,
        tilt_rad=table.tilt_rad,
        depth_range_um=table.depth_range_um,
        peg=Peg(table.peg_width_um, table.peg_depth_um, table.peg_height_um),
        hole=HolePlate(
            table.hole_width_um, table.hole_depth_um, table.plate_thickness_um, table.plate_width_um,
            table.plate_depth_um,
        ),
    )  # fmt: skip
    if first.region[0] != design.region_origin_yx:
        raise InputError(
            f"the region begins at {first.region[0]}: the sensor's middle was wanted, "
            f"{design.region_origin_yx}"
        )
    return design


@contextmanager
def opened(sections: Mapping[str, Any], *, instead: Mapping[str, Any] | None = None) -> Iterator[LiveRig]:
    """Open every device, start the cameras and watch the operator; close all in reverse order.

    Parameters
    ----------
    instead
        Devices already opened, by section, for what cannot be opened by a file: emulated HID.
    """
    require_whole(sections)
    instead = instead or {}
    with ExitStack() as stack:
        devices: dict[str, Any] = {}
        for place, section in sections.items():
            if isinstance(section, Section):
                devices[place] = instead[place] if place in instead else section.open()
                stack.callback(devices[place].close)
        cameras = [devices[place] for place in CAMERAS]
        design = design_of(sections, cameras[0].sensor)
        period_s = 1 / design.frame_rate_hz
        watched = WatchedCamera(cameras[0], policy="lossless"), WatchedCamera(cameras[1], policy="lossless")
        pair = CameraPair(*watched, tolerance_s=0.4 * period_s)
        held = {place.partition(".")[0]: device for place, device in devices.items()}
        operators = {sections[place].driver: devices[place] for place in devices if place[:8] == "operator"}
        coarse, fine = (devices[place] for place in AXES)
        operator = stack.enter_context(
            Operator(
                {"coarse": coarse, "fine": fine},
                pedal=operators.get("pedal"),
                spacemouse=operators.get("spacemouse"),
            )
        )
        timeout_s = max(_PAIR_S, 5 * period_s)
        pairs = stack.enter_context(
            FreshPairs(pair, operator.latch, exposure_s=design.exposure_s, timeout_s=timeout_s)
        )
        yield LiveRig(
            design=design,
            camera_1=LiveCamera(1, pairs),
            camera_2=LiveCamera(2, pairs),
            slm=held["slm"],
            coarse=stack.enter_context(FollowedStage(coarse)),
            fine=stack.enter_context(FollowedStage(fine)),
            clock=MonotonicClock(),
            operator=operator,
            watched=watched,
            pair=pair,
            pairs=pairs,
        )


def start(
    rig: LiveRig,
    sections: Mapping[str, Any],
    tell: Callable[[str, str], None],
    *,
    home: bool,
    yes: bool,
    enabled: Callable[[], None] = lambda: None,
) -> None:
    """Let the operator enable, jog and start; without a SpaceMouse agree on the keyboard.

    Parameters
    ----------
    home, yes
        Axes may find their references; nobody has to be asked.
    enabled
        Called when jogging may begin.

    Raises
    ------
    InputError
        Axes that do not know where they are, and no leave to home them.
    """

    def ready() -> None:
        if home:
            rig.home()
        for stage in (rig.coarse.stage, rig.fine.stage):
            stage.enable()
            if lost := [name for name, known in stage.homed().items() if not known]:
                raise InputError(
                    f"{', '.join(lost)} does not know where it is: give --home, the way to the references "
                    "being clear"
                )
        enabled()

    puck = next((s for s in sections.values() if isinstance(s, SpaceMouseSection)), None)
    if puck is None:
        if not yes:
            typer.confirm("Stages will move. Is the way clear?", abort=True, err=True)
        rig.operator.press()
        ready()
        return
    tell("operator", "SpaceMouse: first button enables, the puck jogs, second button starts")
    jogged = rig.operator.wait_for_start(
        rig.coarse.stage,
        speed_um_per_s=puck.jog_speed_um_per_s,
        speed_rad_per_s=puck.jog_speed_rad_per_s,
        ready=ready,
    )
    moved = ", ".join(
        f"{axis} {1e3 * way if axis == 'theta' else way:+.1f} {'mrad' if axis == 'theta' else 'µm'}"
        for axis, way in jogged.items()
        if abs(way) > rig.coarse.resolution[axis]
    )
    tell("operator", f"enabled and started; jogged {moved or 'nothing'}")


def account(rig: LiveRig, record: RunRecord) -> None:
    """Add to the record what the cameras did."""
    counts = [camera.counts for camera in rig.watched]
    record.rig["cameras"] = {
        "rate_hz": rig.pairs.pairs / (time.monotonic() - rig.pairs.since_s),
        **{f"camera {number}": str(count) for number, count in enumerate(counts, start=1)},
        "unpaired": list(rig.pair.unpaired),
    }
    if (fault := rig.operator.latch.fault) is not None:
        record.rig["fault"] = fault
