"""What a modulator offers, and what every one of them refuses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adof_drivers.errors import DriverError


@dataclass(frozen=True)
class Shown:
    """A pattern on its way to the light.

    Attributes
    ----------
    number
        Counts patterns, from 1.
    flip_s
        When the display took it over, in the host's monotonic seconds; the panel's own delay and settling
        come after that.
    """

    number: int
    flip_s: float


class Slm(Protocol):
    """A panel of 8-bit codes."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        ...

    def show(self, codes: NDArray[np.uint8]) -> Shown:
        """Show codes (rows, columns) and return when they were taken over.

        Raises
        ------
        DriverError
            Another shape or type; nothing changes then. Or the panel is gone.
        """
        ...

    def close(self) -> None:
        """Give the panel back; may be called twice, never raises."""
        ...


def require_codes(codes: NDArray[Any], shape: tuple[int, int]) -> None:
    """Refuse anything but uint8 codes of the panel's shape: nothing is scaled, cut or rounded on its way.

    Raises
    ------
    DriverError
        What came and what was wanted.
    """
    if codes.shape != shape or codes.dtype != np.uint8:
        raise DriverError(f"codes are {codes.shape} {codes.dtype}: {shape} uint8 was wanted, the panel's")
