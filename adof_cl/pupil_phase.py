"""The phase over the stop, formed on the device (kernels/pupil_phase.cl)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError
from adof_cl.optics import Mask, PupilGrid, require_whole
from adof_cl.phase_terms import require_envelope, require_tilt, split, split_turns, wrapped_turns
from adof_cl.program import Program


class PupilPhase:
    """Form the pupil's phase as fractions of a turn, float32 being enough for any strength.

    Cubic, refocus and tilt change with every call; further odd profiles along x and y and a map over the stop
    (an aberration, a vendor's flatness correction) are set when they change. Built once; a call enqueues and
    returns the plan's own array.

    Parameters
    ----------
    device
        The opened device.
    rows, columns
        Samples across the stop along y and x, at cell centres; 1 sits in the middle.
    precision
        "float32" or "float64".

    Source
    ------
    docs/maths.md, eqs. P1 and P2; the paper's Eq. 1 is the case of alpha alone.
    """

    def __init__(self, device: Device, rows: int, columns: int, *, precision: str = "float32") -> None:
        require_whole(rows=rows, columns=columns)
        self._device = device
        self._real = device.real_type(precision)
        self._shape = (rows, columns)
        program = Program(device, "pupil_phase.cl", {"REAL_IS_DOUBLE": precision == "float64"})
        zero = self._real.type(0)
        self.out = device.empty((rows, columns), self._real)
        axes = []
        self._axis_launches = []
        for n in (columns, rows):
            t = PupilGrid(n).x if n > 1 else np.zeros(1)
            turns = device.empty((n,), self._real)
            axes.append(turns)
            # Without a profile any buffer will do: the kernel does not read it.
            self._axis_launches.append(
                program.launch(
                    "pupil_phase_axis",
                    (n,),
                    None,
                    device.upload(split(t, self._real)),
                    turns,
                    turns,
                    np.int32(n),
                    np.int32(0),
                    *[zero] * 6,
                )
            )
        self._launch = program.launch(
            "pupil_phase",
            (columns, rows),
            None,
            *axes,
            axes[0],
            self.out,
            np.int32(rows),
            np.int32(columns),
            np.int32(0),
        )

    def set_odd(
        self, x_rad: NDArray[np.float64] | None = None, y_rad: NDArray[np.float64] | None = None
    ) -> None:
        """Add further phase profiles along x (columns,) and y (rows,), in radians; None removes one.

        Raises
        ------
        InputError
            Wrong length, NaN or infinity.
        LimitError
            Beyond 1e6 rad.
        """
        for launch, profile, n, name in zip(
            self._axis_launches, (x_rad, y_rad), self._shape[::-1], ("x_rad", "y_rad"), strict=True
        ):
            if profile is not None:
                launch.set(1, self._device.upload(self._turns(profile, (n,), name)))
            launch.set(4, np.int32(profile is not None))

    def set_map(self, map_rad: NDArray[np.float64] | None) -> None:
        """Add a phase map (rows, columns) in radians; None removes it.

        Raises
        ------
        InputError
            Wrong shape, NaN or infinity.
        LimitError
            Beyond 1e6 rad.
        """
        if map_rad is not None:
            self._launch.set(2, self._device.upload(self._turns(map_rad, self._shape, "map_rad")))
        self._launch.set(6, np.int32(map_rad is not None))

    def __call__(self, mask: Mask, *, tilt_xy_rad: tuple[float, float] = (0.0, 0.0)) -> DeviceArray:
        """Enqueue the phase of `mask` and a tilt; return `self.out`, (rows, columns), turns in [0, 1).

        Raises
        ------
        InputError, LimitError
            Not finite, or beyond the measured range.
        """
        alpha, psi = require_envelope(mask.alpha_rad, mask.focus_psi_rad)
        tilts = require_tilt(tilt_xy_rad)
        for launch, tilt in zip(self._axis_launches, tilts, strict=True):
            numbers = [part for value in (tilt, psi, alpha) for part in split_turns(value, self._real)]
            for index, number in enumerate(numbers, start=5):
                launch.set(index, number)
            launch()
        self._launch()
        return self.out

    def evaluate(self, mask: Mask, *, tilt_xy_rad: tuple[float, float] = (0.0, 0.0)) -> NDArray[Any]:
        """Return the phase on the host, (rows, columns), turns in [0, 1)."""
        return self(mask, tilt_xy_rad=tilt_xy_rad).download()

    def _turns(self, radians: NDArray[np.float64], shape: tuple[int, ...], name: str) -> NDArray[Any]:
        values = np.asarray(radians, dtype=np.float64)
        if values.shape != shape:
            raise InputError(f"{name} has shape {values.shape}: {shape} was wanted, as planned")
        if not np.isfinite(values).all():
            raise InputError(f"{name} holds NaN or infinity: finite radians were wanted")
        return wrapped_turns(values, self._real)
