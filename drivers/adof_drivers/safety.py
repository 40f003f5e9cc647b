"""What every stage keeps to, whatever it speaks: the enable latch, limits, and a watch on what really moves.

A software stop is no emergency stop: that button cuts the drives' power, and is only seen from here.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
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


class MotionWatch:
    """Compares readings with commands: an axis stuck, lost or running away is found at the next reading.

    At time t an axis may be anywhere its course was between t - lag and t, give or take `following`. A course
    that is renewed before its end, as velocities are, begins where the axis is: one by one, none tells of an
    axis that is stuck. So their ways are added up: each time they come to twice what an axis may be behind,
    at least half must be gone.
    """

    def __init__(self, axes: Mapping[str, StageAxis]) -> None:
        self._axes = axes
        self._courses: dict[str, Course] = {}
        self._runs: dict[str, tuple[float, float]] = {}  # where it began; the way ordered by earlier courses

    def begin(self, courses: Mapping[str, Course]) -> None:
        """Follow these commands from now on."""
        for name, course in courses.items():
            began, ordered = self._runs.get(name, (course.start, 0.0))
            before = self._courses.get(name)
            if before is not None and before.renewed_by(course):
                ordered += abs(before.at(course.start_s) - before.start)
            else:
                began, ordered = course.start, 0.0
            self._runs[name] = began, ordered
            self._courses[name] = course

    def leave(self, names: Collection[str]) -> None:
        """Follow these axes no longer."""
        for name in names:
            self._courses.pop(name, None)
            self._runs.pop(name, None)

    def forget(self) -> None:
        """Follow nothing: after a stop nobody knows how far an axis has run."""
        self._courses.clear()
        self._runs.clear()

    def check(self, time_s: float, position: Mapping[str, float]) -> None:
        """Refuse readings that no command explains.

        Raises
        ------
        FollowingError
            The message says which axis, where it is and where it ought to be.
        """
        for name, course in list(self._courses.items()):
            axis = self._axes[name]
            soon, late = course.at(time_s), course.at(time_s - axis.lag_s)
            low, high = min(soon, late) - axis.following, max(soon, late) + axis.following
            if not low <= position[name] <= high:
                stands = abs(position[name] - course.start) <= axis.resolution
                raise FollowingError(
                    f"{name} {'stands' if stands else 'is'} at {position[name]:.6g} {axis.unit}, where "
                    f"{low:.6g} to {high:.6g} was wanted: "
                    + ("it is stalled, so look for what holds it" if stands else "check load and speed")
                )
            if (run := self._runs.get(name)) is None:
                continue  # a stop in another thread came meanwhile
            began, ordered = run
            ordered += abs(soon - course.start)
            gone = math.copysign(1.0, course.target - course.start) * (position[name] - began)
            if ordered > 2 * (axis.following + course.speed * axis.lag_s):
                if gone < ordered / 2:
                    raise FollowingError(
                        f"{name} stands at {position[name]:.6g} {axis.unit}: of {ordered:.6g} ordered it "
                        f"went {gone:.6g}; it is stalled, so look for what holds it"
                    )
                self._runs[name] = position[name], -abs(soon - course.start)
