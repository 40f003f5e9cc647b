"""From codes on the panel back to the phase in the stop, and from there to the transfer function.

The twin is told nothing about the mask: it sees 8-bit codes, as the light does.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from adof_cl import reference
from adof_cl.errors import InputError
from adof_cl.optics import Mask, SlmPanel

_SAMPLES_PER_PIXEL = 8
# Quantising to 256 levels leaves 0.007 rad; more than this is a pattern that does not separate.
_MOST_RESIDUAL_RAD = 0.1


@dataclass(frozen=True)
class PupilAxis:
    """The stop's phase along one axis.

    Attributes
    ----------
    tilt_rad, focus_rad, alpha_rad
        Phase tilt x + focus x^2 + alpha x^3, fitted; radians at the stop's edge.
    samples_rad
        The phase as the panel's pixels really show it, on equal cells across the stop; empty for glass.
    order_rad, order_leak
        Where the panel's first diffraction orders fall, in the unit of `reach_rad`, and the share of light
        that its steps send there.
    """

    tilt_rad: float = 0.0
    focus_rad: float = 0.0
    alpha_rad: float = 0.0
    samples_rad: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    order_rad: float = 0.0
    order_leak: float = 0.0

    def otf(self, u: NDArray[np.float64], psi_rad: float) -> NDArray[np.complex128]:
        """Evaluate the transfer function for an object defocused by `psi_rad`, mask included (T5, T6)."""
        if self.samples_rad.size == 0:
            exact = reference.otf_1d(u, self.alpha_rad, self.focus_rad + psi_rad)
            return np.asarray(exact * np.exp(1j * self.tilt_rad * u))
        n = self.samples_rad.size
        x = (2 * np.arange(n) + 1 - n) / n
        amplitude = np.exp(1j * (self.samples_rad + psi_rad * x**2))
        spectrum = np.fft.fft(amplitude, 2 * n)
        correlation = np.fft.ifft(np.abs(spectrum) ** 2)[: n + 1] / n
        return np.asarray(CubicSpline(2 * np.arange(n + 1) / n, correlation)(np.abs(u)))

    def reach_rad(self, psi_rad: float) -> tuple[float, float]:
        """Return where one point's rays fall, first and last; times lambda N / pi they are um."""
        x = np.linspace(-1, 1, 65)
        ray = -(3 * self.alpha_rad * x**2 + 2 * (self.focus_rad + psi_rad) * x + self.tilt_rad)
        return float(ray.min()), float(ray.max())


@dataclass(frozen=True, eq=False)
class Pupil:
    """Both axes' phase, and what was left unexplained.

    Attributes
    ----------
    residual_rad
        Rms of the phase that is not a sum of a function of x and one of y.
    """

    along_x: PupilAxis
    along_y: PupilAxis
    residual_rad: float = 0.0

    @classmethod
    def glass(cls, mask: Mask) -> Pupil:
        """Return a fixed plate: exactly the mask, continuous."""
        axis = PupilAxis(alpha_rad=mask.alpha_rad, focus_rad=mask.focus_psi_rad)
        return cls(axis, axis)


def read_codes(
    codes: NDArray[np.uint8], panel: SlmPanel, aperture_um: float, *, pixels: bool = True
) -> Pupil:
    """Recover the phase in the stop from the codes on the panel (docs/maths.md, T5).

    Parameters
    ----------
    codes
        uint8 (rows, columns); code c shows the phase `stroke c/255`.
    pixels
        Keep the panel's steps and quantisation, not the fitted polynomial alone.

    Raises
    ------
    InputError
        Wrong shape or type; a stop larger than the panel; a pattern that is not f(x) + g(y).
    """
    if codes.shape != (panel.rows, panel.columns) or codes.dtype != np.uint8:
        raise InputError(
            f"codes are {codes.dtype} {codes.shape}: the panel {panel.name} wants uint8 "
            f"({panel.rows}, {panel.columns})"
        )
    if panel.stroke_rad < 2 * np.pi * 0.98:
        raise InputError(
            f"panel {panel.name} has a stroke of {panel.stroke_rad:.3f} rad: the twin needs a full turn"
        )
    rows, y = _inside(panel.rows, panel.pitch_um, aperture_um, panel.name)
    columns, x = _inside(panel.columns, panel.pitch_um, aperture_um, panel.name)
    field_ = np.exp(1j * panel.stroke_rad / 255 * np.arange(256))[codes[rows, columns]]
    along_x = _fit(x, np.angle((field_[:, 1:] * field_[:, :-1].conj()).sum(axis=0)))
    along_y = _fit(y, np.angle((field_[1:] * field_[:-1].conj()).sum(axis=1)))
    fx, fy = np.polyval([*along_x, 0], x), np.polyval([*along_y, 0], y)
    rest = field_ * np.exp(-1j * fx) * np.exp(-1j * fy)[:, None]
    rest = np.angle(rest * rest.mean().conj())
    step_x, step_y = rest.mean(axis=0), rest.mean(axis=1)
    residual = float(np.sqrt(np.mean((rest - step_x - step_y[:, None]) ** 2)))
    if residual > _MOST_RESIDUAL_RAD:
        raise InputError(
            f"codes leave {residual:.2f} rad that is not f(x) + g(y): the twin's light needs a separable mask"
        )

    def axis(
        fit: NDArray[np.float64],
        smooth: NDArray[np.float64],
        steps: NDArray[np.float64],
        at: NDArray[np.float64],
    ) -> PupilAxis:
        alpha, focus, tilt = (float(term) for term in fit)
        if not pixels:
            return PupilAxis(tilt, focus, alpha)
        step = (3 * alpha * at**2 + 2 * focus * at + tilt) * 2 * panel.pitch_um / aperture_um
        leak = 1 - float(np.mean(np.sinc(step / (2 * np.pi)) ** 2))
        pitch = at[1] - at[0]
        beyond = np.polyval([*fit, 0], [at[0] - pitch, at[-1] + pitch])
        samples = _cells(smooth + steps, at, beyond, panel.pitch_um, aperture_um)
        return PupilAxis(tilt, focus, alpha, samples, np.pi * aperture_um / panel.pitch_um, leak)

    return Pupil(axis(along_x, fx, step_x, x), axis(along_y, fy, step_y, y), residual)


def _inside(count: int, pitch_um: float, aperture_um: float, name: str) -> tuple[slice, NDArray[np.float64]]:
    x = (np.arange(count) - (count - 1) / 2) * pitch_um / (aperture_um / 2)
    if count * pitch_um < aperture_um:
        raise InputError(
            f"panel {name} is {count * pitch_um:.0f} um wide: the stop of {aperture_um:.0f} um does not fit"
        )
    # A pixel the stop cuts through may or may not carry a code; the fit does without it.
    kept = np.flatnonzero(np.abs(x) <= 1)
    return slice(int(kept[0]), int(kept[-1]) + 1), np.asarray(x[kept], dtype=np.float64)


def _fit(x: NDArray[np.float64], steps_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    terms = np.stack([np.diff(x**3), np.diff(x**2), np.diff(x)], axis=1)
    return np.asarray(np.linalg.lstsq(terms, steps_rad)[0])


def _cells(
    phase_rad: NDArray[np.float64],
    x: NDArray[np.float64],
    beyond_rad: NDArray[np.float64],
    pitch_um: float,
    aperture_um: float,
) -> NDArray[np.float64]:
    """Spread the pixels' phase over equal cells; `beyond_rad` is that of the pixels the stop cuts through."""
    count = int(np.ceil(aperture_um / pitch_um * _SAMPLES_PER_PIXEL))
    at = (2 * np.arange(count) + 1 - count) / count
    nearest = np.rint((at - x[0]) / (x[1] - x[0])).astype(int) + 1
    every = np.concatenate([beyond_rad[:1], phase_rad, beyond_rad[1:]])
    return np.asarray(every[np.clip(nearest, 0, every.size - 1)])
