"""Pairs of one-dimensional transfer functions on the device, for the depths and masks a scene requires.

A separable stop's two-dimensional transfer function is the outer product of two short lists, formed where it
is used; no two-dimensional table is ever stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError
from adof_cl.finite import checked_shape
from adof_cl.optics import Mask, OpticalSystem, require_whole
from adof_cl.otf import Otf1d


class OtfTable:
    """Transfer functions along a camera's rows and columns for several (alpha, psi) at once.

    Built once; `update` is one launch (one more for each further 56 entries, 28 in float64) and never waits.

    Parameters
    ----------
    device
        The opened device.
    optics
        The camera's optics.
    shape
        Samples (rows, columns), padding included: `Restore.padded_shape`.
    entries
        How many (alpha, psi) the table holds.
    pixel
        Whether the pixel's aperture is included.
    precision
        "float32" or "float64".

    Attributes
    ----------
    out : (entries, rows + columns) complex
        On the device: first along the rows' index, then along the columns', each DC first. The Nyquist bin of
        an even length is real, so that a real image stays real.

    Source
    ------
    docs/maths.md, eq. O4; 2-D: `otf[v, u] = out[v] out[rows + u]`.
    """

    def __init__(
        self,
        device: Device,
        optics: OpticalSystem,
        shape: tuple[int, int],
        *,
        entries: int = 1,
        pixel: bool = True,
        precision: str = "float32",
    ) -> None:
        self.optics = optics
        self.shape = checked_shape("shape", shape)
        self.entries = entries
        self._plan = Otf1d.for_frame(device, optics, shape, pixel=pixel, pairs=entries, precision=precision)
        self.out: DeviceArray = self._plan.out

    def update(self, pairs: Sequence[tuple[float, float]] | NDArray[np.float64]) -> None:
        """Enqueue the whole table for `pairs` of (alpha_rad, psi_rad), (entries, 2).

        Raises
        ------
        InputError, LimitError
            Not that many, not finite, or beyond the measured range.
        """
        self._plan(pairs)

    def update_depths(self, mask: Mask, depths_um: Sequence[float]) -> None:
        """Enqueue the table for objects at `depths_um` (entries) seen through `mask`.

        Raises
        ------
        InputError, LimitError
            Not that many, not finite, or beyond the optics.
        """
        self.update([(mask.alpha_rad, mask.psi_rad(self.optics, depth)) for depth in depths_um])

    def axes(self, entry: int) -> tuple[NDArray[np.complexfloating[Any, Any]], ...]:
        """Return one entry's (rows) and (columns) transfer functions on the host.

        Raises
        ------
        InputError
            No such entry.
        """
        require_whole(0, entry=entry)
        if entry >= self.entries:
            raise InputError(f"entry is {entry}: 0 to {self.entries - 1} was wanted")
        line = self.out.download()[entry]
        return line[: self.shape[0]], line[self.shape[0] :]

    def otf(self, entry: int) -> NDArray[np.complexfloating[Any, Any]]:
        """Return one entry's two-dimensional transfer function on the host, `shape` complex, DC first.

        Raises
        ------
        InputError
            No such entry.
        """
        return np.asarray(np.outer(*self.axes(entry)))
