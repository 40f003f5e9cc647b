"""Simulated time: it moves only when someone waits for something."""

from __future__ import annotations

from collections.abc import Callable

from adof_cl.errors import InputError
from adof_cl.optics import require_finite


class Clock:
    """The rig's own time, in seconds from the start.

    Whoever waits advances it; nothing sleeps. `heard` callables are told of every interval that passed.
    """

    def __init__(self) -> None:
        self._now_s = 0.0
        self._listeners: list[Callable[[float, float], None]] = []

    @property
    def now_s(self) -> float:
        """Simulated time."""
        return self._now_s

    def wait(self, duration_s: float) -> None:
        """Let time pass.

        Raises
        ------
        InputError
            Negative or not finite.
        """
        require_finite(duration_s=duration_s)
        if duration_s < 0:
            raise InputError(f"duration_s is {duration_s}: time does not run backwards, wait for 0 or more")
        self.wait_until(self._now_s + duration_s)

    def wait_until(self, time_s: float) -> None:
        """Let time pass until `time_s`; at once if that has passed already."""
        require_finite(time_s=time_s)
        if time_s <= self._now_s:
            return
        before, self._now_s = self._now_s, time_s
        for listener in self._listeners:
            listener(before, time_s)

    def on_advance(self, listener: Callable[[float, float], None]) -> None:
        """Call `listener(from_s, to_s)` after each interval that passed."""
        self._listeners.append(listener)
