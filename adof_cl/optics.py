"""Frozen, checked values that describe the instrument: optics, panel, cameras' sampling.

Made once, refused at once when wrong, passed everywhere. Units stand in the names.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError


def require_finite(**values: float) -> None:
    """Refuse NaN and infinity, naming the argument."""
    for name, value in values.items():
        if not math.isfinite(value):
            raise InputError(f"{name} is {value}: a finite number was wanted")


def require_positive(**values: float) -> None:
    """Refuse anything but a finite number above zero, naming the argument."""
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} is {value}: a finite number above 0 was wanted")


def require_whole(least: int = 1, **values: float) -> None:
    """Refuse anything but a whole number of at least `least`, naming the argument."""
    for name, value in values.items():
        if not isinstance(value, (int, np.integer)) or value < least:
            raise InputError(f"{name} is {value}: a whole number of {least} or more was wanted")


_SMALLEST, _LARGEST = 1e-9, 1e12  # of an instrument's numbers: no formula of them over- or underflows


@dataclass(frozen=True)
class OpticalSystem:
    """One camera's optics: a square stop, and distances to the principal planes.

    The paper does not state focal length or wavelength; the defaults are the set that reproduces its mask
    strengths (docs/maths.md, section 3).

    Attributes
    ----------
    wavelength_um
        Vacuum wavelength.
    aperture_um
        Full width of the square stop, where the phase is applied.
    f_number
        Working f-number on the object side: object distance / aperture.
    magnification
        Image size / object size.
    pixel_pitch_um
        Camera pixel pitch, square pixels, full fill.
    """

    wavelength_um: float = 0.55
    aperture_um: float = 10_000.0
    f_number: float = 6.5
    magnification: float = 1.0
    pixel_pitch_um: float = 7.4

    def __post_init__(self) -> None:
        require_positive(
            wavelength_um=self.wavelength_um,
            aperture_um=self.aperture_um,
            f_number=self.f_number,
            magnification=self.magnification,
            pixel_pitch_um=self.pixel_pitch_um,
        )
        for name, value in vars(self).items():
            if not _SMALLEST <= value <= _LARGEST:
                raise InputError(f"{name} is {value:g}: {_SMALLEST:g} to {_LARGEST:g} was wanted")

    @property
    def object_distance_um(self) -> float:
        """Distance from the object-side principal plane to the plane in focus."""
        return self.f_number * self.aperture_um

    @property
    def object_pitch_um(self) -> float:
        """Size of one pixel at the object."""
        return self.pixel_pitch_um / self.magnification

    def psi_rad(self, depth_um: float) -> float:
        """Return the defocus phase at the stop's edge of a point `depth_um` beyond the plane in focus.

        Exact for any depth (docs/maths.md, eq. O3): positive away from the lens, negative towards it.

        Raises
        ------
        InputError
            Not finite, or at or behind the lens.
        """
        require_finite(depth_um=depth_um)
        distance = self.object_distance_um
        if depth_um <= -distance:
            raise InputError(f"depth_um is {depth_um}: it must lie above {-distance}, the lens itself")
        scale = math.pi * self.aperture_um**2 / (4 * self.wavelength_um)
        return scale * depth_um / (distance * (distance + depth_um))

    def depth_um(self, psi_rad: float) -> float:
        """Return the depth whose defocus is `psi_rad`: the inverse of `psi_rad()`.

        Raises
        ------
        InputError
            Not finite, or beyond the defocus of an infinitely distant point.
        """
        require_finite(psi_rad=psi_rad)
        distance = self.object_distance_um
        s = 4 * self.wavelength_um * psi_rad * distance / (math.pi * self.aperture_um**2)
        if s >= 1:
            raise InputError(
                f"psi_rad is {psi_rad}: no object is so far away; it must lie below {psi_rad / s}"
            )
        return s * distance / (1 - s)

    def normalised_frequency(self, cycles_per_um: float) -> float:
        """Return u = 2 nu lambda N for a frequency measured at the object; the cut-off is u = 2.

        Raises
        ------
        InputError
            Not finite.
        """
        require_finite(cycles_per_um=cycles_per_um)
        return 2 * cycles_per_um * self.wavelength_um * self.f_number

    def frequency_axis(self, samples: int) -> NDArray[np.float64]:
        """Return u at each bin of a discrete Fourier transform over `samples` camera pixels, DC first.

        The Nyquist bin of an even length comes out negative, as `numpy.fft.fftfreq` has it.

        Raises
        ------
        InputError
            Not a whole number of 1 or more.
        """
        require_whole(samples=samples)
        cycles_per_um = np.fft.fftfreq(samples, self.object_pitch_um)
        return np.asarray(2 * cycles_per_um * self.wavelength_um * self.f_number, dtype=np.float64)

    def pixel_otf_axis(self, samples: int) -> NDArray[np.float64]:
        """Return the transfer of a full-fill square pixel, sinc(nu p), at each bin of `frequency_axis`."""
        require_whole(samples=samples)
        return np.sinc(np.fft.fftfreq(samples))

    def shift_px(self, alpha_rad: float, psi_rad: float) -> float:
        """Return how far a defocused, cubic-coded object is displaced, in pixels, along x and along y.

        psi^2 lambda N / (3 pi alpha p): docs/maths.md, eq. O7; valid while |psi| < 3 |alpha|.

        Raises
        ------
        InputError
            Not finite, or an alpha of 0 or next to it, without which nothing is displaced.
        """
        require_finite(alpha_rad=alpha_rad, psi_rad=psi_rad)
        if alpha_rad == 0:
            raise InputError("alpha_rad is 0: without a cubic mask defocus does not shift the image")
        blur_px_per_rad = self.wavelength_um * self.f_number / (math.pi * self.object_pitch_um)
        shift = blur_px_per_rad * psi_rad * (psi_rad / (3 * alpha_rad))
        if not math.isfinite(shift):
            raise InputError(
                f"alpha_rad is {alpha_rad:g} and psi_rad {psi_rad:g}: a mask that displaces by a finite "
                "number of pixels was wanted"
            )
        return shift

    def support_px(self, alpha_rad: float, psi_rad: float) -> float:
        """Return the geometric width of the point-spread function along one axis, in pixels (eq. O8).

        Raises
        ------
        InputError
            Not finite.
        """
        require_finite(alpha_rad=alpha_rad, psi_rad=psi_rad)
        blur_px_per_rad = self.wavelength_um * self.f_number / (math.pi * self.object_pitch_um)
        a, p = 3 * abs(alpha_rad), abs(psi_rad)
        width = blur_px_per_rad * ((a + p) * ((a + p) / a) if p < a else 4 * p)
        require_finite(support_px=width)
        return width


@dataclass(frozen=True)
class PupilGrid:
    """Cell-centred samples across the stop, x in (-1, 1): x_i = (2 i + 1 - n) / n."""

    samples: int

    def __post_init__(self) -> None:
        require_whole(2, samples=self.samples)
        if self.samples > 65536:
            raise InputError(f"samples is {self.samples}: 2 to 65536 pupil samples were wanted")

    @property
    def x(self) -> NDArray[np.float64]:
        """Cell centres, in units of the half aperture."""
        n = self.samples
        return np.asarray((2 * np.arange(n) + 1 - n) / n, dtype=np.float64)

    @staticmethod
    def nyquist_samples(alpha_rad: float, psi_rad: float) -> float:
        """Return how many samples the steepest phase needs: (2/pi)(3 |alpha| + 2 |psi|)."""
        require_finite(alpha_rad=alpha_rad, psi_rad=psi_rad)
        return 2 / math.pi * (3 * abs(alpha_rad) + 2 * abs(psi_rad))


@dataclass(frozen=True)
class SlmPanel:
    """A phase modulator's pixels.

    Attributes
    ----------
    rows, columns
        Addressable pixels.
    pitch_um
        Pixel pitch.
    fill_factor
        Active share of the area.
    frame_rate_hz
        Refresh rate.
    stroke_rad
        Phase between code 0 and code 255; 2 pi or less.
    source
        Where the numbers come from.
    """

    name: str
    rows: int
    columns: int
    pitch_um: float
    fill_factor: float
    frame_rate_hz: float
    stroke_rad: float = 2 * math.pi
    source: str = ""

    def __post_init__(self) -> None:
        require_whole(rows=self.rows, columns=self.columns)
        require_positive(pitch_um=self.pitch_um, frame_rate_hz=self.frame_rate_hz)
        if self.pitch_um < _SMALLEST:
            raise InputError(f"pitch_um is {self.pitch_um:g}: {_SMALLEST:g} or more was wanted")
        if not 0 < self.fill_factor <= 1:
            raise InputError(f"fill_factor is {self.fill_factor}: above 0 and at most 1 was wanted")
        if not 0 < self.stroke_rad <= 2 * math.pi:
            raise InputError(f"stroke_rad is {self.stroke_rad}: above 0 and at most 2 pi was wanted")

    def stop_px(self, aperture_um: float) -> float:
        """Return how many panel pixels the stop is wide."""
        require_positive(aperture_um=aperture_um)
        return aperture_um / self.pitch_um

    def with_stroke(self, stroke_rad: float) -> SlmPanel:
        """Return the same panel at another wavelength or drive, where its full range is `stroke_rad`."""
        return replace(self, stroke_rad=stroke_rad)


@dataclass(frozen=True)
class Mask:
    """What the modulator adds to the pupil: exp(i(alpha x^3 + focus x^2)) along x, and the same along y.

    Attributes
    ----------
    alpha_rad
        Cubic strength at the stop's edge; 0 is no mask.
    focus_psi_rad
        Quadratic term at the stop's edge; -psi(z) brings depth z into focus.
    """

    alpha_rad: float = 0.0
    focus_psi_rad: float = 0.0

    def __post_init__(self) -> None:
        require_finite(alpha_rad=self.alpha_rad, focus_psi_rad=self.focus_psi_rad)

    def psi_rad(self, optics: OpticalSystem, depth_um: float) -> float:
        """Return the total defocus phase of an object at `depth_um` seen through this mask."""
        return optics.psi_rad(depth_um) + self.focus_psi_rad
