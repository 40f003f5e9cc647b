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
from adof_cl.optics import Mask, OpticalSystem
from adof_cl.otf import Otf1d


class OtfTable:
    """Transfer functions along a camera's rows and columns for several (alpha, psi) at once.

    Built once; `update` enqueues and never waits.

    Parameters
    ----------
    device
        The opened device.
    optics
        The camera's optics; its pixel aperture is included.
    shape
        Samples (rows, columns), padding included: `Restore.padded_shape`.
    entries
        How many (alpha, psi) the table holds.
    precision
        "float32" or "float64".

    Attributes
    ----------
    otf_y : (entries, rows) complex
        Along the columns' direction, on the device.
    otf_x : (entries, columns) complex
        Along the rows' direction, on the device.

    Source
    ------
    docs/maths.md, eq. O4; 2-D: `otf[v, u] = otf_y[v] otf_x[u]`.
    """

    def __init__(
        self,
        device: Device,
        optics: OpticalSystem,
        shape: tuple[int, int],
        *,
        entries: int = 1,
        precision: str = "float32",
    ) -> None:
        rows, columns = shape
        self.optics = optics
        self.shape = shape
        self.entries = entries
        self._plan_y = Otf1d.for_camera(device, optics, rows, pairs=entries, precision=precision)
        self._plan_x = (
            self._plan_y
            if rows == columns
            else Otf1d.for_camera(device, optics, columns, pairs=entries, precision=precision)
        )
        self.otf_y: DeviceArray = self._plan_y.out
        self.otf_x: DeviceArray = self._plan_x.out

    def update(self, pairs: Sequence[tuple[float, float]] | NDArray[np.float64]) -> None:
        """Enqueue the whole table for `pairs` of (alpha_rad, psi_rad), (entries, 2).

        Raises
        ------
        InputError, LimitError
            Not that many, not finite, or beyond the measured range.
        """
        self._plan_y(pairs)
        if self._plan_x is not self._plan_y:
            self._plan_x(pairs)

    def update_depths(self, mask: Mask, depths_um: Sequence[float]) -> None:
        """Enqueue the table for objects at `depths_um` (entries) seen through `mask`.

        Raises
        ------
        InputError, LimitError
            Not that many, not finite, or beyond the optics.
        """
        self.update([(mask.alpha_rad, mask.psi_rad(self.optics, depth)) for depth in depths_um])

    def otf(self, entry: int) -> NDArray[np.complexfloating[Any, Any]]:
        """Return one entry's two-dimensional transfer function on the host, `shape` complex, DC first.

        Raises
        ------
        InputError
            No such entry.
        """
        if not 0 <= entry < self.entries:
            raise InputError(f"entry is {entry}: 0 to {self.entries - 1} was wanted")
        otf_y = self.otf_y.download()[entry]
        otf_x = self.otf_x.download()[entry]
        return np.asarray(np.outer(otf_y, otf_x))
