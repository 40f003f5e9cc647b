"""Arrays checked at the door: numbers only, the right shape, nothing infinite."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adof_cl.errors import InputError

TRANSFER_LIMIT = 1e3
"""Largest modulus of a transfer function: lifted by kernels/wiener.cl, its fourth power fits float32."""


def finite_array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """Return a read-only float64 copy of `value`, or refuse it by name.

    Parameters
    ----------
    name
        What the caller calls it, for the message.
    shape
        The shape wanted; None stands for any length of at least 1.

    Raises
    ------
    InputError
        Not numbers, another shape, NaN or infinity.
    """
    wanted = "(" + ", ".join("n" if n is None else str(n) for n in shape) + ")"
    try:
        raw = np.asarray(value)
    except ValueError as error:
        raise InputError(f"{name} is ragged: real numbers of shape {wanted} were wanted") from error
    if raw.dtype.kind not in "iuf":
        raise InputError(f"{name} holds {raw.dtype}: real numbers of shape {wanted} were wanted")
    fits = len(raw.shape) == len(shape) and all(
        have >= 1 if want is None else have == want for have, want in zip(raw.shape, shape, strict=True)
    )
    if not fits:
        raise InputError(f"{name} is {raw.shape}: real numbers of shape {wanted} were wanted")
    checked = raw.astype(np.float64)
    bad = int(np.count_nonzero(~np.isfinite(checked)))
    if bad:
        raise InputError(f"{name} holds {bad} numbers that are NaN or infinite: leave those out")
    checked.flags.writeable = False
    return checked


def checked_shape(name: str, shape: Sequence[int], least: int = 1) -> tuple[int, int]:
    """Return (rows, columns) as whole numbers, or refuse them by name.

    Raises
    ------
    InputError
        Not two whole numbers of at least `least`.
    """
    sides = tuple(shape)
    if len(sides) != 2 or not all(isinstance(n, (int, np.integer)) and n >= least for n in sides):
        raise InputError(f"{name} is {sides}: (rows, columns), whole numbers of {least} or more, was wanted")
    return int(sides[0]), int(sides[1])


def require_transfer(name: str, values: NDArray[Any]) -> None:
    """Refuse what is too large for a transfer function, whose square a kernel must hold.

    Raises
    ------
    InputError
        A modulus above `TRANSFER_LIMIT`.
    """
    largest = float(np.abs(values).max())
    if largest > TRANSFER_LIMIT:
        raise InputError(
            f"{name} reaches {largest:g}: a transfer function is 1 at frequency 0 and at most "
            f"{TRANSFER_LIMIT:g} was wanted, so divide it by its value there"
        )
