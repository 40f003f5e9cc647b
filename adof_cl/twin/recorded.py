"""Axes that something else moves, an emulated controller for one: their past, as it was sampled."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

_KEPT = 4096


class RecordedAxis:
    """Where an axis was at the last few thousand samples; straight on between them. Samples come in order."""

    def __init__(self, time_s: float, position: float) -> None:
        self._lock = threading.Lock()
        self._samples = np.empty((2, 2 * _KEPT))
        self._samples[:, 0] = time_s, position
        self._count = 1
        self._moved_s = time_s

    def add(self, time_s: float, position: float) -> None:
        """Take a sample."""
        with self._lock:
            if self._count == 2 * _KEPT:
                self._samples[:, :_KEPT] = self._samples[:, _KEPT:].copy()
                self._count = _KEPT
            if position != self._samples[1, self._count - 1]:
                self._moved_s = time_s
            self._samples[:, self._count] = time_s, position
            self._count += 1

    def at(self, time_s: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where it was; before the first sample as at that, after the last as at the last."""
        with self._lock:
            times, positions = self._samples[:, : self._count]
            return np.asarray(np.interp(time_s, times, positions), dtype=np.float64)

    @property
    def moved_s(self) -> float:
        """When it was last seen at another place than before."""
        return self._moved_s


class RecordedStage:
    """Recorded axes by name, each at 0 from `time_s` until sampled."""

    def __init__(self, names: Iterable[str], time_s: float) -> None:
        self.axes = {name: RecordedAxis(time_s, 0.0) for name in names}

    def add(self, time_s: float, positions: Mapping[str, float]) -> None:
        """Take a sample of every axis: um, rad for "theta"."""
        for name, position in positions.items():
            self.axes[name].add(time_s, position)
