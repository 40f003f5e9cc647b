"""Wiener filters formed on the device, for separable and for measured blurs (kernels/wiener.cl)."""

from __future__ import annotations

import math

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError
from adof_cl.finite import TRANSFER_LIMIT, checked_shape, require_transfer
from adof_cl.noise import checked_nsr
from adof_cl.program import Program


class WienerFilter:
    """Form restoration filters for one padded size: what `rfft2` of a padded frame is multiplied by.

    Built once: compiles and allocates. Every method enqueues one kernel and does not wait.

    Parameters
    ----------
    device
        The opened device.
    shape
        Padded frame, (ny, nx).
    precision
        "float32" or "float64".

    Raises
    ------
    InputError
        A side below 2.
    DeviceError
        float64 on a device without it.

    Source
    ------
    Paper eq. (3) as corrected in docs/maths.md, eq. W1.
    """

    def __init__(self, device: Device, shape: tuple[int, int], *, precision: str = "float32") -> None:
        self.device = device
        self.shape = ny, nx = checked_shape("the padded shape", shape, 2)
        self.filter_shape = half = (ny, nx // 2 + 1)
        self._real = device.real_type(precision)
        self._complex = np.dtype(np.result_type(self._real, np.complex64))
        program = Program(
            device,
            "wiener.cl",
            {"REAL_IS_DOUBLE": self._real == np.float64},
        )
        self._h_rows = device.empty((ny,), self._complex)
        self._h_cols = device.empty((nx,), self._complex)
        self._otf = device.empty(half, self._complex)
        self._noise = device.empty(half, self._real)
        i32, one, zero = np.int32, self._real.type(1), self._real.type(0)
        self._axes = program.launch(
            "wiener_axes", (half[1], ny), None,
            self._h_rows, self._h_cols, None, None, None, None, i32(ny), i32(nx), i32(0), i32(0), zero, one,
        )  # fmt: skip
        self._spectrum = program.launch(
            "wiener_spectrum", (half[1], ny), None,
            self._otf, None, None, None, None, i32(ny), i32(nx), zero, one,
        )  # fmt: skip

    def from_otf_axes(
        self, h_rows: ArrayLike, h_cols: ArrayLike, nsr: ArrayLike, *, out: DeviceArray | None = None
    ) -> DeviceArray:
        """Form the filter of a separable blur, H[j, i] = h_rows[j] h_cols[i].

        Parameters
        ----------
        h_rows, h_cols
            (ny,) and (nx,) complex, DC first; the Nyquist bin of an even axis is made real.
        nsr
            Noise to signal power, 0 or more: a number, or (ny, nx // 2 + 1).
        out
            (ny, nx // 2 + 1) complex, else a new array.

        Raises
        ------
        InputError
            Wrong shape, not finite, or negative.
        """
        axes = []
        for name, values, length in (("h_rows", h_rows, self.shape[0]), ("h_cols", h_cols, self.shape[1])):
            axis = np.asarray(values)
            if axis.shape != (length,) or axis.dtype.kind not in "fciu" or not np.isfinite(axis).all():
                raise InputError(
                    f"{name} is {axis.shape} {axis.dtype}: ({length},) finite numbers were wanted"
                )
            require_transfer(name, axis)
            axes.append(axis.astype(self._complex))
        level, noise = self._checked_noise(nsr)
        out = self._checked_out(out)
        self._h_rows.upload(axes[0])
        self._h_cols.upload(axes[1])
        self._axes.set(2, noise)
        self._axes.set(5, out)
        self._axes.set(10, level)
        self._axes()
        return out

    def from_otf(self, otf: ArrayLike, nsr: ArrayLike, *, out: DeviceArray | None = None) -> DeviceArray:
        """Form the filter of any blur from the half of its OTF, (ny, nx // 2 + 1) complex, DC at [0, 0].

        Raises
        ------
        InputError
            Wrong shape, not finite, or negative nsr.
        """
        spectrum = np.asarray(otf)
        numbers = spectrum.dtype.kind in "fciu"
        if spectrum.shape != self.filter_shape or not numbers or not np.isfinite(spectrum).all():
            raise InputError(
                f"otf is {spectrum.shape} {spectrum.dtype}: {self.filter_shape} finite numbers were wanted"
            )
        require_transfer("otf", spectrum)
        level, noise = self._checked_noise(nsr)
        out = self._checked_out(out)
        self._otf.upload(spectrum.astype(self._complex))
        self._spectrum.set(1, noise)
        self._spectrum.set(4, out)
        self._spectrum.set(7, level)
        self._spectrum()
        return out

    def from_psf(
        self,
        psf: NDArray[np.generic],
        nsr: ArrayLike,
        *,
        centre_yx: tuple[int, int] | None = None,
        out: DeviceArray | None = None,
    ) -> DeviceArray:
        """Form the filter of a measured blur; see `psf_otf` for `psf` and `centre_yx`.

        Raises
        ------
        InputError
            A PSF that cannot be one, or negative nsr.
        """
        return self.from_otf(psf_otf(psf, self.shape, centre_yx=centre_yx), nsr, out=out)

    def _checked_noise(self, nsr: ArrayLike) -> tuple[np.generic, DeviceArray | None]:
        values = checked_nsr(nsr, self.filter_shape)
        if values.ndim == 0:
            return self._real.type(values), None
        return self._real.type(0), self._noise.upload(values.astype(self._real))

    def _checked_out(self, out: DeviceArray | None) -> DeviceArray:
        if out is None:
            return self.device.empty(self.filter_shape, self._complex)
        if out.shape != self.filter_shape or out.dtype != self._complex:
            raise InputError(
                f"out is {out.shape} {out.dtype}, {self.filter_shape} {self._complex} was wanted: allocate "
                "it for the half spectrum"
            )
        return out


def psf_otf(
    psf: NDArray[np.generic], shape: tuple[int, int], *, centre_yx: tuple[int, int] | None = None
) -> NDArray[np.complex128]:
    """Transform a measured point-spread function to the OTF of a padded frame, in float64.

    Parameters
    ----------
    psf
        (rows, columns), any size up to `shape`, any scale: it is normalised to unit sum.
    shape
        Padded frame, (ny, nx).
    centre_yx
        The pixel a point stays at, (n // 2, m // 2) by default.

    Returns
    -------
    NDArray[np.complex128]
        (ny, nx // 2 + 1), DC at [0, 0] and equal to 1.

    Raises
    ------
    InputError
        Not two-dimensional, larger than the frame, not finite, or a sum that is not above a thousandth of the
        sum of moduli: negative values must not cancel what they are divided by.

    Source
    ------
    docs/maths.md, eq. W6.
    """
    shape = checked_shape("the padded shape", shape)
    values = np.asarray(psf)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "fiu":
        raise InputError(f"the PSF is {values.shape} {values.dtype}: a real (rows, columns) was wanted")
    if values.shape[0] > shape[0] or values.shape[1] > shape[1]:
        raise InputError(
            f"the PSF is {values.shape[0]} x {values.shape[1]}, the frame with its padding only {shape[0]} x "
            f"{shape[1]}: crop the PSF or pad more"
        )
    if not np.isfinite(values).all():
        raise InputError("the PSF holds NaN or infinity: finite numbers were wanted")
    grid = values.astype(np.float64)
    largest = float(np.abs(grid).max())
    grid = np.ldexp(grid, -math.frexp(largest)[1])  # any unit: no sum overflows
    total, moduli = float(grid.sum()), float(np.abs(grid).sum())
    if total <= 0:
        raise InputError(f"the PSF sums to {float(values.sum(dtype=np.float64)):g}: a sum above 0 was wanted")
    if total * TRANSFER_LIMIT < moduli:
        raise InputError(
            f"the PSF's negative values leave {total / moduli:.1g} of its sum: at least "
            f"{1 / TRANSFER_LIMIT:g} was wanted, so subtract the dark frame anew"
        )
    middle = (values.shape[0] // 2, values.shape[1] // 2)
    centre = middle if centre_yx is None else checked_shape("centre_yx", centre_yx, 0)
    if any(c >= side for c, side in zip(centre, values.shape, strict=True)):
        raise InputError(f"the PSF's centre is {centre}: a pixel of its {values.shape} was wanted")
    padded = np.zeros(shape)
    padded[: values.shape[0], : values.shape[1]] = grid / total
    return np.asarray(scipy.fft.rfft2(np.roll(padded, (-centre[0], -centre[1]), (0, 1))))
