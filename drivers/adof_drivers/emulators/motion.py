"""A motor: a position that follows its target with finite speed and acceleration."""

from __future__ import annotations

import math

_STEP_S = 1e-3


class Motor:
    """One axis, in the controller's units; time is told, never taken.

    Parameters
    ----------
    low, high
        End switches: motion ends there.
    speed, acceleration
        Largest of each; `speed` may be set lower by commands.
    """

    def __init__(
        self, low: float, high: float, *, speed: float, acceleration: float, position: float = 0.0
    ) -> None:
        self.low, self.high = low, high
        self.speed = self.top_speed = speed
        self.acceleration = acceleration
        self.position = self.target = position
        self.velocity = 0.0
        self.stuck = False
        self._jog: float | None = None
        self._time_s = 0.0

    @property
    def moving(self) -> bool:
        """Whether it moves or is about to."""
        return self._jog is not None or self.velocity != 0 or self.position != self.target

    def go(self, target: float) -> None:
        """Leave for a target."""
        self.target, self._jog = target, None

    def jog(self, velocity: float) -> None:
        """Run until told otherwise."""
        self._jog = velocity if velocity else None
        if not velocity:
            self.halt()

    def halt(self) -> None:
        """Come to rest as soon as the acceleration allows."""
        way = self.velocity**2 / (2 * self.acceleration)
        self.go(self._inside(self.position + math.copysign(way, self.velocity)))

    def place(self, position: float) -> None:
        """Stand somewhere, as after a reference move or a power cycle."""
        self.position = self.target = position
        self.velocity, self._jog = 0.0, None

    def advance(self, time_s: float) -> None:
        """Let time pass up to `time_s`; what came before is as it was commanded then."""
        if not self.moving:
            self._time_s = max(self._time_s, time_s)
        while self._time_s < time_s and self.moving:
            step_s = min(_STEP_S, time_s - self._time_s)
            self._time_s += step_s
            self._step(step_s)
        self._time_s = max(self._time_s, time_s)

    def _step(self, step_s: float) -> None:
        if self.stuck:
            self.velocity = 0.0
            return
        way = self.target - self.position
        wanted = (
            self._jog
            if self._jog is not None
            # The speed from which it can still stop in time, half a step allowed for.
            else math.copysign(
                min(
                    self.speed,
                    max(0.0, math.sqrt(2 * self.acceleration * abs(way)) - self.acceleration * step_s / 2),
                ),
                way,
            )
        )
        change = self.acceleration * step_s
        self.velocity += min(max(wanted - self.velocity, -change), change)
        moved = self.velocity * step_s
        if (
            self._jog is None
            and abs(way) <= max(abs(moved), change * step_s)
            and abs(self.velocity) <= 2 * change
        ):
            self.position, self.velocity = self.target, 0.0
            return
        self.position += moved
        if not self.low <= self.position <= self.high:
            self.place(self._inside(self.position))

    def _inside(self, position: float) -> float:
        return min(max(position, self.low), self.high)
