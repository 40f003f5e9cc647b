"""What every stage keeps to, whatever it speaks: the enable latch, limits, and a watch on what really moves.

A software stop is no emergency stop: that button cuts the drives' power, and is only seen from here.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from threading import Lock
from typing import Literal

from adof_drivers.errors import FollowingError, LimitError, NotArmedError, RequestError

_START = "it was just switched on"


class EnableLatch:
    """Motion is allowed after an operator's fresh press, until the first fault.

    It starts faulted. A switch found pressed does not count, nor one still pressed from before a fault: the
    latch must see it released, then pressed (LinuxCNC's `estop_latch`).
    """

    def __init__(self) -> None:
        self._lock = Lock()  # held for assignments only
        self._fault: str | None = _START
        self._released = False

    @property
    def armed(self) -> bool:
        """Whether motion is allowed."""
        return self._fault is None

    @property
    def fault(self) -> str | None:
        """Why it is not."""
        return self._fault

    def operator(self, pressed: bool) -> bool:
        """Tell the switch's level; return whether motion is allowed now."""
        with self._lock:
            if pressed and self._released:
                self._fault = None
            self._released = not pressed
            return self._fault is None

    def trip(self, reason: str) -> None:
        """Fault, from any thread; the first reason stays."""
        with self._lock:
            self._fault = self._fault or reason
            self._released = False

    def require(self) -> None:
        """Refuse unless armed.

        Raises
        ------
        NotArmedError
            The message says what tripped it.
        """
        if (fault := self._fault) is not None:
            raise NotArmedError(
                f"the stage is not armed, {fault}: release the enable switch and press it anew"
            )


@dataclass(frozen=True)
class StageAxis:
    """One axis as the caller sees it; every number is in `unit` or per second of it.

    Attributes
    ----------
    wire
        What the controller calls it.
    scale
        `unit` in one of the controller's: 1000 for mm, pi/180 for degrees, the step for step counts.
    speed_limit, resolution
        Largest speed that is asked for; smallest step.
    low, high
        Soft limits; None for the controller's own travel, less 1 % at each end.
    following
        How far an axis may be from where its command should have brought it.
    lag_s
        How late it may be there: transport, acceleration and settling.
    """

    wire: str
    unit: Literal["um", "rad"]
    scale: float
    speed_limit: float
    resolution: float
    low: float | None = None
    high: float | None = None
    following: float = math.inf
    lag_s: float = 0.5

    def __post_init__(self) -> None:
        for name in ("scale", "speed_limit", "resolution", "lag_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RequestError(f"{name} of axis {self.wire} is {value}: a number above 0 was wanted")
        if not self.following > 0:
            raise RequestError(f"following of axis {self.wire} is {self.following}: above 0 was wanted")


@dataclass(frozen=True)
class Limits:
    """First and last position, inside the controller's travel."""

    low: float
    high: float

    @classmethod
    def of(cls, name: str, axis: StageAxis, travel: tuple[float, float] | None) -> Limits:
        """Return an axis's soft limits.

        Parameters
        ----------
        travel
            What the controller allows, in the axis's unit; None where it knows none.

        Raises
        ------
        LimitError
            Outside the controller's, empty, or not known at all.
        """
        if travel is None:
            if axis.low is None or axis.high is None:
                raise LimitError(f"axis {name} has no limits of its own: state low and high")
            travel = (axis.low, axis.high)
        margin = 0.01 * (travel[1] - travel[0])
        low = travel[0] + margin if axis.low is None else axis.low
        high = travel[1] - margin if axis.high is None else axis.high
        slack = 1e-9 * max(abs(travel[0]), abs(travel[1]))  # units were converted, which rounds
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise LimitError(f"limits of axis {name} are {low:g} to {high:g}: low below high was wanted")
        if low < travel[0] - slack or high > travel[1] + slack:
            raise LimitError(
                f"limits of axis {name}, {low:g} to {high:g} {axis.unit}, leave its controller's, "
                f"{travel[0]:g} to {travel[1]:g}: move them inside"
            )
        return cls(low, high)

    def require(self, name: str, target: float) -> None:
        """Refuse a target outside.

        Raises
        ------
        LimitError
            Outside; nothing was moved.
        """
        slack = 1e-9 * max(1.0, abs(self.low), abs(self.high))
        if not self.low - slack <= target <= self.high + slack:
            raise LimitError(
                f"{name} would end at {target:.6g}: its limits are {self.low:g} to {self.high:g}, "
                "nothing was moved"
            )


@dataclass(frozen=True)
class Course:
    """A commanded motion at constant speed: where an axis ought to be, and when."""

    start_s: float
    start: float
    target: float
    speed: float

    def at(self, time_s: float) -> float:
        """Return where it ought to be."""
        way = self.target - self.start
        gone = self.speed * max(time_s - self.start_s, 0.0)
        return self.target if gone >= abs(way) else self.start + math.copysign(gone, way)

    def renewed_by(self, other: Course) -> bool:
        """Whether the other begins before this one is at its end, and goes the same way."""
        same_way = (self.target - self.start) * (other.target - other.start) > 0
        return same_way and self.at(other.start_s) != self.target


@dataclass(frozen=True)
class _Followed:
    """A course, and where the axis may turn at the latest: it was under way when the course was given."""

    course: Course
    low: Course
    high: Course

    def between(self, time_s: float, lag_s: float) -> tuple[float, float]:
        """Return the ends of where it may be."""
        places = (
            self.course.at(time_s),
            self.course.at(time_s - lag_s),
            self.low.at(time_s),
            self.high.at(time_s),
        )
        return min(places), max(places)

    def delayed(self, by_s: float) -> _Followed:
        """Return it so much later."""
        return _Followed(*(replace(c, start_s=c.start_s + by_s) for c in (self.course, self.low, self.high)))


class MotionWatch:
    """Compares readings with commands: an axis stuck, lost or running away is found at the next reading.

    At time t an axis may be anywhere its course was between t - lag and t, give or take `following`; one that
    was on another course before may run on along that for the lag, and turn then. A course that is renewed
    before its end, as velocities are, begins where the axis is: one by one, none tells of an axis that is
    stuck. So their ways are added up: each time they come to twice what an axis may be behind, at least half
    must be gone.
    """

    def __init__(self, axes: Mapping[str, StageAxis]) -> None:
        self._axes = axes
        self._lock = Lock()  # held for arithmetic only: a stop from another thread forgets the courses
        self._followed: dict[str, _Followed] = {}
        # Where it began; the way ordered by earlier courses; the fastest of them.
        self._runs: dict[str, tuple[float, float, float]] = {}
        self._last: dict[str, Course] = {}  # whether followed any more or not
        self._reaches: dict[str, list[tuple[float, float, float]]] = {}  # until when; from where, to where

    def begin(self, courses: Mapping[str, Course]) -> None:
        """Follow these commands from now on."""
        with self._lock:
            for name, course in courses.items():
                low, high = self._reach(name, course)
                began, ordered, fastest = self._runs.get(name, (course.start, 0.0, 0.0))
                before = self._followed.get(name)
                if before is not None and before.course.renewed_by(course):
                    ordered += abs(before.course.at(course.start_s) - before.course.start)
                else:
                    began, ordered, fastest = low if course.target > course.start else high, 0.0, 0.0
                turns_s = course.start_s + self._axes[name].lag_s
                self._followed[name] = _Followed(
                    course,
                    *(Course(turns_s, place, course.target, course.speed) for place in (low, high)),
                )
                self._runs[name] = began, ordered, max(fastest, course.speed)
                self._last[name] = course

    def _reach(self, name: str, course: Course) -> tuple[float, float]:
        """Return between where an axis may turn to a new course: those given just before carry it on."""
        now_s, lag_s = course.start_s, self._axes[name].lag_s
        last = self._last.get(name)
        left = 0.0 if last is None else last.target - course.start
        runs_on = 0.0 if last is None else math.copysign(min(abs(left), last.speed * lag_s), left)
        if runs_on * (course.target - course.start) > 0:  # and goes on from there, slower
            runs_on += course.at(now_s + lag_s) - course.start
        reaches = [reach for reach in self._reaches.get(name, ()) if reach[0] > now_s]
        reaches.append((now_s + lag_s, course.start + min(runs_on, 0.0), course.start + max(runs_on, 0.0)))
        self._reaches[name] = reaches
        return min(low for _, low, _ in reaches), max(high for *_, high in reaches)

    def delay(self, name: str, by_s: float) -> None:
        """Have an axis be later by so much: it stood, because nothing told it to go on."""
        with self._lock:
            if (followed := self._followed.get(name)) is not None:
                self._followed[name] = followed.delayed(by_s)

    def leave(self, names: Collection[str]) -> None:
        """Follow these axes no longer."""
        with self._lock:
            for name in names:
                self._followed.pop(name, None)
                self._runs.pop(name, None)

    def forget(self) -> None:
        """Follow nothing: after a stop nobody knows how far an axis has run."""
        with self._lock:
            self._followed.clear()
            self._runs.clear()

    def check(self, time_s: float, position: Mapping[str, float]) -> None:
        """Refuse readings that no command explains.

        Raises
        ------
        FollowingError
            The message says which axis, where it is and where it ought to be.
        """
        with self._lock:
            for name, followed in self._followed.items():
                self._check(name, followed, time_s, position[name])

    def _check(self, name: str, followed: _Followed, time_s: float, at: float) -> None:
        axis, course = self._axes[name], followed.course
        first, last = followed.between(time_s, axis.lag_s)
        low, high = first - axis.following, last + axis.following
        if not low <= at <= high:
            stands = abs(at - course.start) <= axis.resolution
            raise FollowingError(
                f"{name} {'stands' if stands else 'is'} at {at:.6g} {axis.unit}, where "
                f"{low:.6g} to {high:.6g} was wanted: "
                + ("it is stalled, so look for what holds it" if stands else "check load and speed")
            )
        soon = course.at(time_s)
        began, ordered, fastest = self._runs[name]
        ordered += abs(soon - course.start)
        gone = math.copysign(1.0, course.target - course.start) * (at - began)
        if ordered > 2 * (axis.following + fastest * axis.lag_s):
            if gone < ordered / 2:
                raise FollowingError(
                    f"{name} stands at {at:.6g} {axis.unit}: of {ordered:.6g} ordered it "
                    f"went {gone:.6g}; it is stalled, so look for what holds it"
                )
            self._runs[name] = at, -abs(soon - course.start), course.speed
