"""Motors that are a pure function of time between commands: no threads, nothing to step."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError, LimitError
from adof_cl.twin.clock import Clock
from adof_cl.twin.design import AxisDesign

# Rest begins this long after arrival: keeps the knots of a trajectory strictly ordered.
_INSTANT_S = 1e-9


class Axis:
    """One motor's past and planned motion, as straight pieces of position over time.

    Speed changes at once (no acceleration). What stands is a whole number of steps; while moving the fraction
    of a step is carried on, on coming to rest it is lost.
    """

    def __init__(self, design: AxisDesign, position: float = 0.0) -> None:
        self.design = design
        self._times = [-math.inf, 0.0]
        self._positions = [position, position]

    def at(self, time_s: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the motor stands at any time, in whole steps."""
        return self._whole_steps(self._course(time_s))

    @property
    def rests_at_s(self) -> float:
        """When the last command so far will have been carried out."""
        return self._times[-1]

    def planned(self, time_s: float) -> float:
        """Return the position at `time_s`, the fraction of a step included."""
        return float(self._course(time_s))

    def run(self, from_s: float, velocity: float, until_s: float) -> None:
        """Move at `velocity` between the two times, then rest."""
        start = self._cut(from_s)
        self._add(until_s, start + velocity * (until_s - from_s))
        self._rest()

    def go(self, from_s: float, target: float, speed: float) -> None:
        """Leave for `target` at `speed`, then rest."""
        start = self._cut(from_s)
        end = float(self._whole_steps(np.asarray(target)))
        self._add(from_s + max(abs(end - start) / speed, _INSTANT_S), end)
        self._rest()

    def halt(self, from_s: float) -> None:
        """Rest from `from_s` on."""
        self._cut(from_s)
        self._rest()

    def _course(self, time_s: float | NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.interp(time_s, self._times[1:], self._positions[1:]), dtype=np.float64)

    def _whole_steps(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.rint(position / self.design.resolution) * self.design.resolution)

    def _cut(self, time_s: float) -> float:
        position = self.planned(time_s)
        while self._times[-1] >= time_s:
            self._times.pop()
            self._positions.pop()
        self._add(time_s, position)
        return position

    def _add(self, time_s: float, position: float) -> None:
        self._times.append(time_s)
        self._positions.append(position)

    def _rest(self) -> None:
        whole = float(self._whole_steps(np.asarray(self._positions[-1])))
        self._add(self._times[-1] + _INSTANT_S, whole)


class SimulatedStage:
    """Motors with names, one clock, limits that refuse.

    Commands act `latency_s` after they are given. Nothing moves on connection. A velocity holds only until it
    expires, so a controller that dies leaves a stage at rest. Units: um and um/s, rad and rad/s for "theta".
    """

    may_move_on_open = False

    def __init__(self, axes: Mapping[str, AxisDesign], clock: Clock, latency_s: float) -> None:
        self._clock = clock
        self.latency_s = latency_s
        self.axes = {name: Axis(design) for name, design in axes.items()}

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """First and last position of each axis."""
        return {name: (axis.design.low, axis.design.high) for name, axis in self.axes.items()}

    @property
    def resolution(self) -> dict[str, float]:
        """Smallest step of each axis."""
        return {name: axis.design.resolution for name, axis in self.axes.items()}

    @property
    def speed_limits(self) -> dict[str, float]:
        """Fastest speed of each axis."""
        return {name: axis.design.speed_limit for name, axis in self.axes.items()}

    def position(self) -> dict[str, float]:
        """Read every axis now."""
        return {name: float(axis.at(self._clock.now_s)) for name, axis in self.axes.items()}

    def position_at(self, time_s: float) -> dict[str, float]:
        """Return where every axis was at a time that has passed."""
        return {name: float(axis.at(time_s)) for name, axis in self.axes.items()}

    @property
    def moving(self) -> bool:
        """Whether anything moves or is about to."""
        return any(axis.rests_at_s > self._clock.now_s for axis in self.axes.values())

    def set_velocity(self, velocities: Mapping[str, float], *, expires_s: float = 0.25) -> None:
        """Move the named axes at the given velocities until `expires_s` after they start; others go on.

        Raises
        ------
        LimitError
            Too fast, or the axis would leave its limits before the command expires; no axis has moved.
        InputError
            Unknown axis; not finite.
        """
        if not (math.isfinite(expires_s) and expires_s > 0):
            raise InputError(f"expires_s is {expires_s}: a time above 0 was wanted")
        start_s = self._clock.now_s + self.latency_s
        for name, velocity in velocities.items():
            axis = self._axis(name, velocity)
            if abs(velocity) > axis.design.speed_limit * (1 + 1e-9):
                raise LimitError(
                    f"{name} was asked to move at {velocity:g}: its limit is {axis.design.speed_limit:g}, "
                    "ask for less"
                )
            self._within(name, axis, axis.planned(start_s) + velocity * expires_s)
        for name, velocity in velocities.items():
            self.axes[name].run(start_s, velocity, start_s + expires_s)

    def move_to(self, targets: Mapping[str, float], *, speed: float | None = None) -> None:
        """Leave for the given positions, each axis at its own fastest speed or at `speed`.

        Returns at once; `wait_until_still` waits.

        Raises
        ------
        LimitError
            A target lies beyond its limits, or `speed` is too fast; no axis has moved.
        InputError
            Unknown axis; not finite.
        """
        start_s = self._clock.now_s + self.latency_s
        for name, target in targets.items():
            axis = self._axis(name, target)
            self._within(name, axis, target)
            if speed is not None and not 0 < speed <= axis.design.speed_limit:
                raise LimitError(
                    f"{name} was asked to move at {speed:g}: above 0 and at most "
                    f"{axis.design.speed_limit:g} was wanted"
                )
        for name, target in targets.items():
            axis = self.axes[name]
            axis.go(start_s, target, axis.design.speed_limit if speed is None else speed)

    def stop(self) -> None:
        """Bring every axis to rest, as soon as a command can act."""
        for axis in self.axes.values():
            axis.halt(self._clock.now_s + self.latency_s)

    def wait_until_still(self) -> None:
        """Let time pass until every command given so far has been carried out."""
        self._clock.wait_until(max(axis.rests_at_s for axis in self.axes.values()))

    def _axis(self, name: str, value: float) -> Axis:
        if name not in self.axes:
            raise InputError(f"axis {name!r} is not on this stage: it has {', '.join(self.axes)}")
        if not math.isfinite(value):
            raise InputError(f"{name} was given {value}: a finite number was wanted")
        return self.axes[name]

    @staticmethod
    def _within(name: str, axis: Axis, end: float) -> None:
        if not axis.design.low - 1e-9 <= end <= axis.design.high + 1e-9:
            raise LimitError(
                f"{name} would end at {end:.6g}: its limits are {axis.design.low:g} to {axis.design.high:g}, "
                "nothing was moved"
            )
