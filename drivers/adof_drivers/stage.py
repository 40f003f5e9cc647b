"""One stage for the loop, whatever its controller speaks: um and rad, limits, latch, expiry, watch.

    stage = Stage(GcsController(link), {"x": StageAxis("1", "um", 1000.0, 500.0, 0.1)})
    stage.latch.operator(False); stage.latch.operator(True)     # a fresh press
    stage.enable(); stage.home(confirm=True)
    stage.move_to({"x": 1200.0}); stage.wait_until_still()

Opening sends questions only. Everything that could move asks the latch first, then the limits, then sends.
A velocity is a short way at that speed, a long move a train of such ways, each sent while the last one runs:
a silent host leaves a stage at rest.
"""

from __future__ import annotations

import contextlib
import math
import threading
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
        """How often it was stopped."""
        ...

    @property
    def rest_s(self) -> float | None:
        """None where axes can be sent elsewhere in motion; else how long they settle before they can."""
        ...

    @property
    def blind(self) -> bool:
        """Whether it knows where its axes are at rest only; then it has a `rest_s` too."""
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

    def emergency_stop(self) -> None:
        """Stop, if need be by switching the drives off; likewise."""
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

    def repeat(self, action: Callable[[], bool], period_s: float) -> None:
        """Call `action` every period until it says no; return at once."""
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

    def repeat(self, action: Callable[[], bool], period_s: float) -> None:
        """In a thread, which ends with the program."""

        def run() -> None:
            time.sleep(period_s)
            while action():
                time.sleep(period_s)

        threading.Thread(target=run, name="stage", daemon=True).start()


@dataclass
class _Way:
    """What is left of a move: its course, how often it had been stopped then, when what was sent is over."""

    course: Course
    since: int
    over_s: float


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
    _HORIZON_S = 0.25
    """How far ahead of itself a move is sent: so long it runs on when the program dies."""
    _RENEW_S = 0.1
    _PIECE_S = 0.1
    """Likewise, where one piece has to end before the next is sent."""
    _PIECE_RENEW_S = 0.01
    """A renewal waits for that end first."""
    _PIECE_TIMEOUT_S = 5.0

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
        self._turn = threading.RLock()  # one command at a time; a stop takes no turn
        self._ways: dict[str, _Way] = {}
        self._renewing = False
        self._settled = self._resting = False  # at rest; waiting to be
        self._failure: DriverError | None = None  # met by a renewal, for the next question to raise
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
        """Whether anything moves, or a move is not at its end."""
        with self._stopped_on_failure():
            on_the_way = bool(self._live_ways())  # first: the last piece may be sent meanwhile
            return self._controller.moving() or on_the_way

    def homed(self) -> dict[str, bool]:
        """Say which axes know where they are."""
        with self._stopped_on_failure():
            homed = self._controller.homed(list(self._names))
        return {self._names[wire]: known for wire, known in homed.items()}

    def position(self) -> dict[str, float]:
        """Read every axis, and compare with what was commanded.

        Where a controller does not know that in motion (`Controller.blind`), wait for what was sent to end.

        Raises
        ------
        FollowingError
            An axis is not where its command should have brought it; everything is stopped and the latch open.
        LinkError, ReplyError
            No answer, or one that makes no sense; likewise.
        """
        with self._turn, self._stopped_on_failure():
            if self._controller.blind:
                self._come_to_rest()
            read = self._controller.positions(list(self._names))
            position = {name: read[axis.wire] * axis.scale for name, axis in self.axes.items()}
            now_s = self._clock.now_s
            for name, way in list(self._ways.items()):
                if now_s > way.over_s:  # it stands since then, for want of a renewal
                    self._watch.delay(name, now_s - way.over_s)
                    way.over_s = now_s
            self._watch.check(now_s, position)
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
        with self._turn:
            self._rest_before_sending()
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
        with self._turn:
            self._watch.forget()
            self._ways.clear()
            self._rest_before_sending()
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

        Returns at once; `wait_until_still` waits. Limits refuse before a byte is sent. The controller is told
        no more of the way than takes a quarter of a second; the next piece follows while that one runs, for
        as long as this program does and hears where the axes are. What goes wrong meanwhile opens the latch
        at once, and is raised by the next question.

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
        with self._turn:
            self._failure = None  # the operator has armed the stage since
            self._rest_before_sending()
            self._require_homed(targets)
            position = self.position()
            now_s = self._clock.now_s
            ways = {
                name: _Way(
                    Course(
                        now_s,
                        position[name],
                        target,
                        speed if speed is not None else self.axes[name].speed_limit,
                    ),
                    since,
                    now_s,
                )
                for name, target in targets.items()
            }
            self._go_on(ways, position, since)
            self._watch_from(since, {name: way.course for name, way in ways.items()})
            if self._ways and not self._renewing:
                self._renewing = True
                self._clock.repeat(self._renew, self._PIECE_RENEW_S if self._in_pieces else self._RENEW_S)

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
        with self._turn:
            self._failure = None
            if any(velocities.values()):  # to halt, none has to rest
                self._rest_before_sending()
            self._require_homed(velocities)
            position = self.position()
            now_s = self._clock.now_s
            courses = {}
            for name, velocity in velocities.items():
                end = position[name] + velocity * expires_s
                if velocity != 0:
                    self._limits[name].require(name, end)
                    courses[name] = Course(now_s, position[name], end, abs(velocity))
            halt = [name for name, velocity in velocities.items() if velocity == 0]
            self._send({n: (c.target, c.speed) for n, c in courses.items()}, halt, since)
            for name in velocities:
                self._ways.pop(name, None)
            self._watch.leave(halt)
            self._watch_from(since, courses)

    def stop(self) -> None:
        """Bring every axis to rest: at once, from any thread, waiting for no reply; may be called again.

        A command under way in another thread does not move the stage afterwards.
        """
        self._watch.forget()
        self._controller.stop()

    def emergency_stop(self, reason: str) -> None:
        """Open the latch and stop; the operator must press anew. Never raises: the latch holds anyway."""
        self.latch.trip(reason)
        self._watch.forget()
        # Where the link is gone nothing more can be said to the device; what it was sent ends by itself.
        with contextlib.suppress(DriverError):
            self._controller.emergency_stop()

    def _trip(self, reason: str) -> None:
        self.latch.trip(reason)
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
        StoppedError
            The latch was opened by someone else: it stands short of its target.
        """

        def moving() -> bool:
            self.position()
            return self.moving

        try:
            self._wait_while(moving, timeout_s, "the motion")
        except (ReplyTimeoutError, KeyboardInterrupt):
            self.stop()
            raise

    def close(self) -> None:
        """Stop and let go of the controller; may be called again, never raises over a lost link."""
        self._trip("it was closed")
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
        if (failure := self._failure) is not None:
            self._failure = None
            raise failure
        try:
            yield
        except StoppedError:
            raise
        except (FollowingError, LinkError) as failure:
            self.emergency_stop(str(failure))
            raise
        except DriverError as failure:
            self._trip(str(failure))
            raise

    def _live_ways(self) -> dict[str, _Way]:
        """Give the moves under way that no stop has ended."""
        return {name: way for name, way in self._ways.items() if way.since == self._controller.stops}

    def _renew(self) -> bool:
        """Send the next pieces of the moves under way; say whether any is left."""
        with self._turn:
            if self._resting:  # the same thread waits: nothing may be sent under its eyes
                return True
            self._renewing = False
            since = self._controller.stops
            self._ways = self._live_ways()
            try:
                if self._ways and not self.latch.armed:  # opened by another stage, or a pedal
                    self.stop()
                    raise StoppedError(f"the move ended short of its target: {self.latch.fault}")
                if self._ways:
                    self._rest_before_sending()
                    self._go_on(dict(self._ways), self.position(), since)
            except DriverError as failure:
                self._ways.clear()
                if self._controller.stops == since or not self.latch.armed:
                    self._failure = failure
            self._renewing = bool(self._ways)
            return self._renewing

    def _go_on(self, ways: Mapping[str, _Way], position: Mapping[str, float], since: int) -> None:
        """Send axes on from where they are, no further than they come within the horizon."""
        horizon_s = self._PIECE_S if self._in_pieces else self._HORIZON_S
        now_s = self._clock.now_s
        pieces, left = {}, {}
        for name, way in ways.items():
            speed, target = way.course.speed, way.course.target
            distance = target - position[name]
            reach = max(speed * horizon_s, self.axes[name].resolution)
            if abs(distance) > reach:
                left[name] = _Way(way.course, since, now_s + reach / speed)
            pieces[name] = (
                position[name] + math.copysign(reach, distance) if name in left else target,
                speed,
            )
        self._send(pieces, (), since)
        for name in ways:
            self._ways.pop(name, None)
        self._ways |= left

    def _send(self, pieces: Mapping[str, tuple[float, float]], halt: Collection[str], since: int) -> None:
        """Send targets with their speeds, and axes to halt."""
        targets = {self.axes[n].wire: target / self.axes[n].scale for n, (target, _) in pieces.items()}
        speeds = {self.axes[n].wire: speed / abs(self.axes[n].scale) for n, (_, speed) in pieces.items()}
        self._settled = False
        try:
            self._controller.move(targets, speeds, [self.axes[name].wire for name in halt], since=since)
        except StoppedError:
            raise
        except DriverError as failure:
            # What was refused may have been half of it: nothing goes on.
            if isinstance(failure, LinkError):
                self.emergency_stop(str(failure))
            else:
                self._trip(str(failure))
            raise

    def _watch_from(self, since: int, courses: Mapping[str, Course]) -> None:
        self._watch.begin(courses)
        if self._controller.stops != since:
            self._watch.forget()

    @property
    def _in_pieces(self) -> bool:
        return self._controller.rest_s is not None

    def _rest_before_sending(self) -> None:
        with self._stopped_on_failure():
            self._come_to_rest()

    def _come_to_rest(self) -> None:
        """Where a controller takes nothing new in motion, wait for the end of what was sent."""
        if (rest_s := self._controller.rest_s) is None or self._settled:
            return
        self._resting = True
        try:
            self._wait_while(self._controller.moving, self._PIECE_TIMEOUT_S, "what was sent")
            self._clock.wait(rest_s)
            self._settled = True
        finally:
            self._resting = False

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
