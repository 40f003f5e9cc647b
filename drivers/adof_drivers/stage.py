"""One stage for the loop, whatever its controller speaks: um and rad, limits, latch, expiry, watch.

    stage = Stage(GcsController(link), {"x": StageAxis("1", "um", 1000.0, 500.0, 0.1)})
    stage.latch.operator(False); stage.latch.operator(True)     # a fresh press
    stage.enable(); stage.home(confirm=True)
    stage.move_to({"x": 1200.0}); stage.wait_until_still()

Opening sends questions only. Everything that could move asks the latch first, then the limits, then sends.
A velocity is a short way at that speed: a host that falls silent leaves a stage at rest.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol

from adof_drivers.errors import (
    DriverError,
    FollowingError,
    LimitError,
    LinkError,
    ReplyTimeoutError,
    RequestError,
    StoppedError,
)
from adof_drivers.safety import Course, EnableLatch, Limits, MotionWatch, StageAxis


class Controller(Protocol):
    """A dialect: axes by the controller's names, values in its units. Every call is bounded in time."""

    @property
    def identity(self) -> str:
        """What it says it is."""
        ...

    @property
    def stops(self) -> int:
        """How often `stop` was called."""
        ...

    def travel(self, axes: Collection[str]) -> dict[str, tuple[float, float]]:
        """Return first and last position of the axes it knows limits of."""
        ...

    def positions(self, axes: Collection[str]) -> dict[str, float]:
        """Read positions."""
        ...

    def homed(self, axes: Collection[str]) -> dict[str, bool]:
        """Say which axes know where they are."""
        ...

    def moving(self) -> bool:
        """Say whether any axis moves."""
        ...

    def enable(self, axes: Collection[str], *, since: int) -> None:
        """Switch the drives on."""
        ...

    def home(self, axes: Collection[str], *, since: int) -> None:
        """Begin to look for the references."""
        ...

    def homing(self) -> bool:
        """Say whether it still looks for them."""
        ...

    def move(
        self, targets: Mapping[str, float], speeds: Mapping[str, float], halt: Collection[str], *, since: int
    ) -> None:
        """Leave for targets at speeds and bring the axes in `halt` to rest; `since` as in `Link.exchange`."""
        ...

    def stop(self) -> None:
        """Bring everything to rest: at once, from any thread, waiting for no reply."""
        ...

    def close(self) -> None:
        """Let go of the connection."""
        ...


class Clock(Protocol):
    """Time that can be waited for."""

    @property
    def now_s(self) -> float:
        """Time."""
        ...

    def wait(self, duration_s: float) -> None:
        """Let time pass."""
        ...


class MonotonicClock:
    """The machine's own."""

    @property
    def now_s(self) -> float:
        """`time.monotonic()`."""
        return time.monotonic()

    def wait(self, duration_s: float) -> None:
        """Sleep."""
        time.sleep(duration_s)


@dataclass(frozen=True)
class StageState:
    """What a stage reports: `position` in um or rad by axis, `fault` is why it is not armed."""

    time_s: float
    position: dict[str, float]
    moving: bool
    fault: str | None


class Stage:
    """Named axes of one controller.

    Parameters
    ----------
    controller
        Taken over: closed with the stage, and when opening fails.
    axes
        By name; um, or rad for rotations.
    clock
        Paces waiting and times the watch.
    latch
        Shared by all stages of a rig; by default its own.

    Raises
    ------
    RequestError
        No axes, or two names for one of the controller's.
    LimitError
        Soft limits outside the controller's.
    LinkError, ReplyError
        The controller does not answer, or not as it should.
    """

    may_move_on_open = False
    _POLL_S = 0.01

    def __init__(
        self,
        controller: Controller,
        axes: Mapping[str, StageAxis],
        *,
        clock: Clock | None = None,
        latch: EnableLatch | None = None,
    ) -> None:
        self._controller = controller
        self.axes = dict(axes)
        self.latch = latch or EnableLatch()
        self._clock = clock or MonotonicClock()
        self._watch = MotionWatch(self.axes)
        self._names = {axis.wire: name for name, axis in self.axes.items()}
        try:
            if not axes or len(self._names) != len(self.axes):
                raise RequestError("every axis wants a controller's axis of its own, and one at least")
            travel = {
                wire: self._scaled(self._names[wire], ends)
                for wire, ends in controller.travel(list(self._names)).items()
            }
            self._limits = {
                name: Limits.of(name, axis, travel.get(axis.wire)) for name, axis in self.axes.items()
            }
        except BaseException:
            controller.close()
            raise

    @property
    def identity(self) -> str:
        """What the controller says it is."""
        return self._controller.identity

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Soft limits of each axis."""
        return {name: (limit.low, limit.high) for name, limit in self._limits.items()}

    @property
    def resolution(self) -> dict[str, float]:
        """Smallest step of each axis."""
        return {name: axis.resolution for name, axis in self.axes.items()}

    @property
    def speed_limits(self) -> dict[str, float]:
        """Fastest speed of each axis."""
        return {name: axis.speed_limit for name, axis in self.axes.items()}

    @property
    def moving(self) -> bool:
        """Whether anything moves."""
        with self._stopped_on_failure():
            return self._controller.moving()

    def homed(self) -> dict[str, bool]:
        """Say which axes know where they are."""
        with self._stopped_on_failure():
            homed = self._controller.homed(list(self._names))
        return {self._names[wire]: known for wire, known in homed.items()}

    def position(self) -> dict[str, float]:
        """Read every axis, and compare with what was commanded.

        Raises
        ------
        FollowingError
            An axis is not where its command should have brought it; everything is stopped and the latch open.
        LinkError, ReplyError
            No answer, or one that makes no sense; likewise.
        """
        with self._stopped_on_failure():
            read = self._controller.positions(list(self._names))
            position = {name: read[axis.wire] * axis.scale for name, axis in self.axes.items()}
            self._watch.check(self._clock.now_s, position)
        return position

    def state(self) -> StageState:
        """Read position, motion and fault."""
        position = self.position()
        return StageState(self._clock.now_s, position, self.moving, self.latch.fault)

    def enable(self) -> None:
        """Switch the drives on.

        Raises
        ------
        NotArmedError
            The operator has not armed the latch.
        """
        since = self._controller.stops
        self.latch.require()
        self._controller.enable(list(self._names), since=since)

    def home(
        self, axes: Collection[str] | None = None, *, confirm: bool = False, timeout_s: float = 60.0
    ) -> None:
        """Look for the references of the axes, all by default, and wait for it: hardware moves by itself.

        Raises
        ------
        RequestError
            Not confirmed, or an unknown axis; nothing was sent.
        ReplyTimeoutError
            Not done in time; everything is stopped.
        """
        since = self._controller.stops
        names = list(self.axes if axes is None else axes)
        wires = [self._axis(name, 0.0).wire for name in names]
        if not confirm:
            raise RequestError(
                f"homing {', '.join(names)} drives to the ends of travel: clear the way, then confirm"
            )
        self.latch.require()
        self._watch.forget()
        self._guarded_home(wires, since, timeout_s)
        missing = [self._names[w] for w, known in self._controller.homed(wires).items() if not known]
        if missing:
            raise LimitError(f"{', '.join(missing)} found no reference: look for what is in the way")

    def _guarded_home(self, wires: list[str], since: int, timeout_s: float) -> None:
        try:
            self._controller.home(wires, since=since)
            self._wait_while(self._controller.homing, timeout_s, "homing")
        except StoppedError:
            raise
        except (DriverError, KeyboardInterrupt):
            self.stop()
            raise
        if self._controller.stops != since:
            raise StoppedError("homing was stopped: the axes do not know where they are")

    def move_to(self, targets: Mapping[str, float], *, speed: float | None = None) -> None:
        """Leave for the given positions, each axis at its own fastest speed or at `speed`.

        Returns at once; `wait_until_still` waits. Limits refuse before a byte is sent.

        Raises
        ------
        NotArmedError
            The operator has not armed the latch.
        LimitError
            A target lies beyond its limits, or `speed` is too fast; no axis has moved.
        RequestError
            Unknown axis; not finite.
        StoppedError
            A stop came meanwhile.
        """
        since = self._controller.stops
        for name, target in targets.items():
            self._axis(name, target)
            self._limits[name].require(name, target)
            if speed is not None:
                self._require_speed(name, speed)
        if speed is not None and speed == 0:
            raise LimitError("a move at speed 0 never ends: above 0 was wanted")
        self.latch.require()
        if not targets:
            return
        self._require_homed(targets)
        position = self.position()
        self._send(
            {
                name: Course(
                    0.0, position[name], target, speed if speed is not None else self.axes[name].speed_limit
                )
                for name, target in targets.items()
            },
            (),
            since,
        )

    def set_velocity(self, velocities: Mapping[str, float], *, expires_s: float = 0.25) -> None:
        """Move the named axes at the given velocities for `expires_s`; others go on.

        The controller is given the place where the axis would be by then: repeat the call sooner than that,
        or the stage comes to rest by itself, whether or not this program still runs.

        Raises
        ------
        NotArmedError
            The operator has not armed the latch.
        LimitError
            Too fast, or the axis would leave its limits before the command expires; no axis has moved.
        RequestError
            Unknown axis; not finite; `expires_s` not above 0 and at most 1 s.
        StoppedError
            A stop came meanwhile.
        """
        since = self._controller.stops
        if not (math.isfinite(expires_s) and 0 < expires_s <= 1):
            raise RequestError(f"expires_s is {expires_s}: above 0 and at most 1 s was wanted")
        for name, velocity in velocities.items():
            self._axis(name, velocity)
            self._require_speed(name, abs(velocity))
        self.latch.require()
        if not velocities:
            return
        self._require_homed(velocities)
        position = self.position()
        courses = {}
        for name, velocity in velocities.items():
            end = position[name] + velocity * expires_s
            if velocity != 0:
                self._limits[name].require(name, end)
                courses[name] = Course(0.0, position[name], end, abs(velocity))
        self._send(courses, [name for name, velocity in velocities.items() if velocity == 0], since)

    def stop(self) -> None:
        """Bring every axis to rest: at once, from any thread, waiting for no reply; may be called again.

        A command under way in another thread does not move the stage afterwards.
        """
        self._watch.forget()
        self._controller.stop()

    def emergency_stop(self, reason: str) -> None:
        """Open the latch and stop; the operator must press anew. Never raises: the latch holds anyway."""
        self.latch.trip(reason)
        # Where the link is gone nothing more can be said to the device; a velocity expires by itself.
        with contextlib.suppress(DriverError):
            self.stop()

    def wait_until_still(self, *, timeout_s: float = 60.0) -> None:
        """Wait until nothing moves, watching that every axis follows.

        Raises
        ------
        ReplyTimeoutError
            Still moving after `timeout_s`; everything is stopped.
        FollowingError
            An axis is stuck or lost; everything is stopped and the latch open.
        """

        def moving() -> bool:
            self.position()
            return self.moving

        try:
            self._wait_while(moving, timeout_s, "the motion")
        except ReplyTimeoutError:
            self.stop()
            raise

    def close(self) -> None:
        """Stop and let go of the controller; may be called again, never raises over a lost link."""
        self.emergency_stop("it was closed")
        self._controller.close()

    def __enter__(self) -> Stage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextlib.contextmanager
    def _stopped_on_failure(self) -> Iterator[None]:
        """Stop and open the latch where the stage cannot be seen any more, or is not where it should be."""
        try:
            yield
        except (FollowingError, LinkError) as failure:
            self.emergency_stop(str(failure))
            raise

    def _send(self, courses: Mapping[str, Course], halt: Collection[str], since: int) -> None:
        targets = {self.axes[n].wire: c.target / self.axes[n].scale for n, c in courses.items()}
        speeds = {self.axes[n].wire: c.speed / abs(self.axes[n].scale) for n, c in courses.items()}
        now_s = self._clock.now_s
        try:
            self._controller.move(targets, speeds, [self.axes[name].wire for name in halt], since=since)
        except StoppedError:
            raise
        except DriverError as failure:
            # What was refused may have been half of it: nothing goes on.
            self.emergency_stop(str(failure))
            raise
        self._watch.leave(halt)
        self._watch.begin({n: Course(now_s, c.start, c.target, c.speed) for n, c in courses.items()})
        if self._controller.stops != since:
            self._watch.forget()

    def _wait_while(self, busy: Callable[[], bool], timeout_s: float, what: str) -> None:
        deadline_s = self._clock.now_s + timeout_s
        while busy():
            if self._clock.now_s > deadline_s:
                raise ReplyTimeoutError(f"{what} is not over after {timeout_s:g} s: everything is stopped")
            self._clock.wait(self._POLL_S)

    def _axis(self, name: str, value: float) -> StageAxis:
        if name not in self.axes:
            raise RequestError(f"axis {name!r} is not on this stage: it has {', '.join(self.axes)}")
        if not math.isfinite(value):
            raise RequestError(f"{name} was given {value}: a finite number was wanted")
        return self.axes[name]

    def _require_speed(self, name: str, speed: float) -> None:
        limit = self.axes[name].speed_limit
        if not 0 <= speed <= limit * (1 + 1e-9):
            raise LimitError(f"{name} was asked to move at {speed:g}: 0 to {limit:g} was wanted")

    def _require_homed(self, names: Collection[str]) -> None:
        homed = self.homed()
        lost = [name for name in names if not homed[name]]
        if lost:
            raise LimitError(f"{', '.join(lost)} does not know where it is: home it first, nothing was moved")

    def _scaled(self, name: str, ends: tuple[float, float]) -> tuple[float, float]:
        scale = self.axes[name].scale
        return (ends[0] * scale, ends[1] * scale)
