"""How fast the machine is now: one chain of a profile, timed again.

A profile's times are those of a quiet machine on the day it was measured. Clocks, other programs and power
limits move all of them by nearly the same factor, which one chain shows in a fraction of a second.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from adof_cl.device import Device
from adof_cl.optics import OpticalSystem
from adof_cl.pipeline import Blur, WindowedPipeline
from adof_cl.profile import REFERENCE, DeviceProfile
from adof_cl.tracking import Template, TrackingLimits
from adof_cl.turns import Clock, Rounds, Spread, take_turns

_SHAPE = (400, 512)
_BLUR = Blur(20.0, 10.0)
_ROUNDS = Rounds(15, 101, 0.2)


class ReferenceChain:
    """One frame through the chain that paces are taken from; without the twin, so that it is quick to make.

    Parameters
    ----------
    device
        The opened device.
    nsr
        As the profile's.
    """

    def __init__(self, device: Device, nsr: float) -> None:
        frame, corner = _corner()
        self._pipeline = WindowedPipeline(
            device, OpticalSystem(), _SHAPE, {"part": REFERENCE.window(_SHAPE)}, nsr=nsr
        )
        # Blurred by no mask, restored for one: it need not be found, only searched for.
        self._pipeline.set_templates("part", [Template.cut(frame, corner)], TrackingLimits(mismatch=1.0))
        self._frame, self._expected = frame, {"part": corner[None]}

    def __call__(self) -> None:
        """Follow one feature in one frame."""
        self._pipeline(self._frame, {"part": _BLUR}, self._expected)


def pace(device: Device, profile: DeviceProfile, clock: Clock = time.perf_counter) -> float:
    """Return how many times as long as in the profile the reference chain takes now.

    Takes a quarter of a second once its kernels are compiled.

    Raises
    ------
    InputError
        The profile holds no reference.
    """
    (times,) = take_turns([ReferenceChain(device, profile.nsr)], _ROUNDS, clock)
    return Spread.of(times).median / profile.reference_s


def _corner() -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return a grained frame with a bright quarter, and where its corner is, (x, y)."""
    rows, columns = _SHAPE
    frame = np.random.default_rng(0).normal(60.0, 4.0, _SHAPE)
    frame[: rows // 2, : columns // 2] += 90.0
    return np.rint(frame).astype(np.uint8), np.array([columns / 2 - 0.5, rows / 2 - 0.5])
