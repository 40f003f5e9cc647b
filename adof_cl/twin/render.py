"""Blur one flat part by its own transfer function and sample it with the camera's pixels."""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from adof_cl.optics import OpticalSystem
from adof_cl.twin.parts import PITCH_UM, Painted
from adof_cl.twin.pupil import Pupil, PupilAxis

# Samples per camera pixel: the transforms reach 1.5 cycles per pixel, 0.73 of the optics' cut-off (T7).
OVERSAMPLING = 3
_MARGIN_PX = 14
_BLOCK_PX = 16
_MOST_LEAK = 0.03

Planes = NDArray[np.float32]


class Layer:
    """One part seen by one camera. Spectra are kept while it does not turn, images while it stands."""

    def __init__(self, optics: OpticalSystem) -> None:
        self._optics = optics
        self._spectrum_key: tuple[object, ...] = ()
        self._spectrum: NDArray[np.complex64] = np.zeros((0, 0, 0), np.complex64)
        self._images: dict[tuple[object, ...], tuple[Planes, tuple[int, int]]] = {}

    def image(
        self,
        part: Painted,
        pixels_from_part: NDArray[np.float64],
        centre_xy_px: NDArray[np.float64],
        pupil: Pupil,
        psi_rad: float,
    ) -> tuple[Planes, tuple[int, int]]:
        """Return the blurred planes (k, rows, cols) and the sensor (row, column) of their first pixel.

        Parameters
        ----------
        pixels_from_part : (2, 2)
            Linear part of the projection, px/um, (x, y).
        centre_xy_px
            Where the part's origin falls on the sensor.
        psi_rad
            Defocus of the part's depth, without the mask's own focus term.
        """
        key = (part, pixels_from_part.tobytes(), centre_xy_px.tobytes(), pupil, psi_rad)
        if key in self._images:
            return self._images[key]
        corners = np.array([[x, y] for x in (part.low_um[0], part.high_um[0])
                            for y in (part.low_um[1], part.high_um[1])]) @ pixels_from_part.T  # fmt: skip
        low, high = corners.min(axis=0), corners.max(axis=0)
        columns, left = self._window(pupil.along_x, psi_rad, low[0], high[0])
        rows, top = self._window(pupil.along_y, psi_rad, low[1], high[1])
        spectrum = self._spectrum_of(part, pixels_from_part, (rows, columns), low, high)
        first = np.floor(centre_xy_px).astype(int)
        # The part's origin is painted at the window's middle; the phase ramp carries it to its place.
        shift = centre_xy_px - first + np.array([left - columns / 2, top - rows / 2])
        hy = self._axis(pupil.along_y, psi_rad, rows, shift[1])
        hx = self._axis(pupil.along_x, psi_rad, columns, shift[0])[: OVERSAMPLING * columns // 2 + 1]
        planes = _sample(spectrum, hy, hx, rows, columns)
        image = planes, (int(first[1] - top), int(first[0] - left))
        if len(self._images) >= 4:
            self._images.pop(next(iter(self._images)))
        self._images[key] = image
        return image

    def _window(self, axis: PupilAxis, psi_rad: float, low_px: float, high_px: float) -> tuple[int, int]:
        """Return a window that holds part and blur, and where in it the part's origin stands."""
        optics = self._optics
        per_rad = optics.wavelength_um * optics.f_number / (np.pi * optics.object_pitch_um)
        before, after = axis.reach_rad(psi_rad)
        # Light the panel's steps send into its first orders lands this far away; little of it may wrap.
        if axis.order_leak > _MOST_LEAK:
            before, after = before - axis.order_rad, after + axis.order_rad
        first = low_px + before * per_rad - _MARGIN_PX
        last = high_px + after * per_rad + _MARGIN_PX
        size = _BLOCK_PX * int(np.ceil((last - first) / _BLOCK_PX))
        while scipy.fft.next_fast_len(OVERSAMPLING * size, real=True) != OVERSAMPLING * size:
            size += _BLOCK_PX
        return size, int(np.ceil(-first + (size - (last - first)) / 2))

    def _spectrum_of(
        self,
        part: Painted,
        pixels_from_part: NDArray[np.float64],
        shape: tuple[int, int],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
    ) -> NDArray[np.complex64]:
        key = (part, pixels_from_part.tobytes(), shape)
        if key != self._spectrum_key:
            fine = paint(part, pixels_from_part, shape, low, high)
            self._spectrum = scipy.fft.rfft2(fine, workers=2)
            self._spectrum_key = key
        return self._spectrum

    def _axis(self, axis: PupilAxis, psi_rad: float, count: int, shift_px: float) -> NDArray[np.complex64]:
        """Optics, pixel aperture (once, here) and place along one axis, at the fine grid's frequencies."""
        fine = OVERSAMPLING * count
        per_px = np.arange(fine // 2 + 1) / count
        u = 2 * per_px / self._optics.object_pitch_um * self._optics.wavelength_um * self._optics.f_number
        half = axis.otf(u, psi_rad) * np.sinc(per_px) * np.exp(-2j * np.pi * per_px * shift_px)
        half[-1] = half[-1].real
        return np.concatenate([half, half[-2:0:-1].conj()]).astype(np.complex64)


def paint(
    part: Painted,
    pixels_from_part: NDArray[np.float64],
    shape: tuple[int, int],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> Planes:
    """Sample the part on the fine grid, its origin at the window's middle."""
    rows, columns = shape
    fine = np.zeros((part.planes.shape[0], OVERSAMPLING * rows, OVERSAMPLING * columns), dtype=np.float32)
    middle = np.array([OVERSAMPLING * columns // 2, OVERSAMPLING * rows // 2])
    first = np.floor(middle + OVERSAMPLING * low).astype(int) - 3
    last = np.ceil(middle + OVERSAMPLING * high).astype(int) + 4
    inverse = np.asarray(np.linalg.inv(pixels_from_part), dtype=np.float64)
    step = inverse[::-1, ::-1] / (OVERSAMPLING * PITCH_UM)
    start = np.asarray(np.array(part.centre_yx) + step @ (first - middle)[::-1], dtype=np.float64)
    for plane, target in zip(part.planes, fine, strict=True):
        _interpolate(plane, step, start, target[first[1] : last[1], first[0] : last[0]])
    return fine


def _interpolate(
    plane: Planes, step: NDArray[np.float64], start: NDArray[np.float64], out: NDArray[np.float32]
) -> None:
    """Fill out[i, j] with the plane at start + step @ (i, j), linear between samples.

    Three times as fast as the general routine of SciPy, which carries float64 through.
    """
    width = plane.shape[1]
    flat = plane.ravel()
    j = np.arange(out.shape[1])
    along_j = [(step[axis, 1] * j).astype(np.float32) for axis in (0, 1)]
    for block in range(0, out.shape[0], 64):
        i = np.arange(block, min(block + 64, out.shape[0]))
        y, x = (
            np.clip(
                (start[axis] + step[axis, 0] * i).astype(np.float32)[:, None] + along_j[axis],
                0,
                np.float32(plane.shape[axis] - 1.01),
            )
            for axis in (0, 1)
        )
        row, column = y.astype(np.int64), x.astype(np.int64)
        y -= row
        x -= column
        index = row * width + column
        upper = flat.take(index)
        upper += x * (flat.take(index + 1) - upper)
        index += width
        lower = flat.take(index)
        lower += x * (flat.take(index + 1) - lower)
        upper += y * (lower - upper)
        out[i[0] : i[-1] + 1] = upper


def _sample(
    spectrum: NDArray[np.complex64],
    hy: NDArray[np.complex64],
    hx: NDArray[np.complex64],
    rows: int,
    columns: int,
) -> Planes:
    """Filter, fold the fine grid's aliases onto the camera's grid, and return to space (T8)."""
    folded = spectrum[:, :rows] * hy[:rows, None]
    for alias in range(1, OVERSAMPLING):
        part = slice(alias * rows, (alias + 1) * rows)
        folded += spectrum[:, part] * hy[part, None]
    lines = scipy.fft.ifft(folded, axis=1, workers=2, overwrite_x=True)
    lines *= hx
    half = columns // 2 + 1
    kept = lines[..., :half] + lines[..., columns : columns + half]
    kept += lines[..., columns : columns - half : -1].conj()
    sampled = scipy.fft.irfft(kept, columns, axis=2, workers=2)
    sampled *= 1 / OVERSAMPLING**2
    return np.asarray(sampled, dtype=np.float32)
