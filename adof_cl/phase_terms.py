"""Phases on their way to a kernel: in turns, each as a sum of two numbers, within what was measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError, LimitError

ALPHA_LIMIT_RAD = 1e5
PSI_LIMIT_RAD = 1e4
"""Beyond these nothing was measured; a stop with such a phase would need 200 000 samples across."""
PROFILE_LIMIT_RAD = 1e6
"""Of a phase given sample by sample: beyond, float64 tells its place in a turn to worse than 1e-10 rad."""


def require_envelope(alpha_rad: float, psi_rad: float) -> tuple[float, float]:
    """Return the pair, refusing NaN, infinity and what lies beyond the measured range.

    Raises
    ------
    InputError
        Not finite.
    LimitError
        Beyond `ALPHA_LIMIT_RAD` or `PSI_LIMIT_RAD`.
    """
    for name, value, limit in (("alpha", alpha_rad, ALPHA_LIMIT_RAD), ("psi", psi_rad, PSI_LIMIT_RAD)):
        if not math.isfinite(value):
            raise InputError(f"{name} is {value}: a finite number of radians was wanted")
        if abs(value) > limit:
            raise LimitError(f"{name} is {value} rad: at most {limit:g} either way can be computed, use less")
    return alpha_rad, psi_rad


def require_tilt(tilt_xy_rad: Sequence[float]) -> tuple[float, float]:
    """Return the pair, refusing what is no pair, NaN, infinity and more than `ALPHA_LIMIT_RAD`.

    Raises
    ------
    InputError
        Not two finite numbers.
    LimitError
        Beyond the limit.
    """
    if len(tilt_xy_rad) != 2 or not all(math.isfinite(tilt) for tilt in tilt_xy_rad):
        raise InputError(f"tilt_xy_rad is {tilt_xy_rad}: two finite numbers of radians were wanted")
    x, y = tilt_xy_rad
    if max(abs(x), abs(y)) > ALPHA_LIMIT_RAD:
        raise LimitError(
            f"tilt_xy_rad is {tilt_xy_rad}: at most {ALPHA_LIMIT_RAD:g} either way can be computed, use less"
        )
    return x, y


def split(values: NDArray[np.float64], real: np.dtype[Any]) -> NDArray[Any]:
    """Split float64 values into hi + lo of type `real`, on a new last axis (docs/maths.md, eq. P2)."""
    hi = values.astype(real)
    return np.stack((hi, (values - hi).astype(real)), axis=-1)


def split_turns(radians: float, real: np.dtype[Any]) -> tuple[np.floating[Any], np.floating[Any]]:
    """Return a phase in turns as hi + lo of type `real`."""
    turns = radians / (2 * math.pi)
    hi = real.type(turns)
    return hi, real.type(turns - float(hi))


def wrapped_turns(radians: NDArray[np.float64], real: np.dtype[Any]) -> NDArray[Any]:
    """Return phases as fractions of a turn in [0, 1], rounded only after whole turns are dropped.

    Raises
    ------
    LimitError
        A phase beyond `PROFILE_LIMIT_RAD`.
    """
    largest = float(np.abs(radians).max(initial=0.0))
    if largest > PROFILE_LIMIT_RAD:
        raise LimitError(
            f"a phase reaches {largest:g} rad: at most {PROFILE_LIMIT_RAD:g} was wanted, so drop whole turns"
        )
    turns = radians / (2 * math.pi)
    return np.asarray(turns - np.floor(turns), dtype=real)
