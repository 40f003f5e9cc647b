"""How strong the mask must be for a depth range: the paper's Eq. 4, as printed and from the optics.

Two labelled calibrations, alike in shape: `alpha_rad(depth_um)` and `depth_um(alpha_rad)`. Depth ranges are
one-sided, from the plane in focus.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import wofz

from adof_cl.errors import InputError, LimitError
from adof_cl.optics import Mask, OpticalSystem, require_finite, require_positive, require_whole
from adof_cl.phase_terms import require_envelope

PAPER_POINTS: tuple[tuple[str, float, float], ...] = (
    ("A", 4000.0, 53.5),
    ("B", 3000.0, 35.44),
    ("C", 2000.0, 18.9),
    ("D", 1000.0, 3.96),
    ("E", 787.0, 0.97),
)
"""Position, depth_um, alpha_rad of the paper's Fig. 11. The paper gives the depth of A; B to E are inferred
from the constant second difference of alpha, which equal steps of 1 mm explain to 0.012 rad."""

PAPER_RESOLUTION: tuple[tuple[float, float], ...] = ((0.0, 53.0), (100.0, 35.0))
"""alpha_rad and line pairs per mm in the plane in focus: the ends of the paper's Fig. 4."""


class Calibration(Protocol):
    """Maps a one-sided depth range to the mask strength that covers it, and back."""

    @property
    def name(self) -> str:
        """Which calibration this is, for reports."""

    def covers(self, depth_um: float) -> bool:
        """Say whether the calibration reaches that far; beyond, `alpha_rad` stays at its last value."""

    def alpha_rad(self, depth_um: float) -> float:
        """Return the weakest mask that covers `depth_um`; at least 0, never falling with depth."""

    def depth_um(self, alpha_rad: float) -> float:
        """Return the depth range that a mask covers; never falling with strength."""


_LEAST = 1e-6  # of a pattern's frequency in the cut-off, and of its contrast


@dataclass(frozen=True)
class PaperCalibration:
    """The quadratic through the paper's five points, clamped at both ends of its range.

    Below `shallowest_um` no mask is needed; beyond `deepest_um`, where the paper has no point, alpha stays at
    its value there: see `covers`.

    Source
    ------
    The paper's Eq. 4 and Figs 3 and 11; docs/maths.md, eq. O12.
    """

    name: str = "paper"
    shallowest_um: float = 717.0
    deepest_um: float = 4000.0

    def covers(self, depth_um: float) -> bool:
        """Say whether the depth range lies within the paper's own points."""
        return 0 <= depth_um <= self.deepest_um

    def alpha_rad(self, depth_um: float) -> float:
        """Return the weakest mask that covers `depth_um`, clamped to the paper's range.

        Raises
        ------
        InputError
            Negative or not finite.
        """
        _require_depth(depth_um)
        d_mm = min(depth_um, self.deepest_um) / 1000
        if depth_um <= self.shallowest_um:
            return 0.0
        return 0.780 * d_mm**2 + 12.616 * d_mm - 9.440

    def depth_um(self, alpha_rad: float) -> float:
        """Return the depth range `alpha_rad` covers, clamped to the paper's range.

        Raises
        ------
        InputError
            Negative or not finite.
        """
        _require_alpha(alpha_rad)
        root = (-12.616 + math.sqrt(12.616**2 + 4 * 0.780 * (9.440 + alpha_rad))) / (2 * 0.780)
        return min(max(1000 * root, self.shallowest_um), self.deepest_um)


@dataclass(frozen=True)
class ModelCalibration:
    """Depth range from the optics: where the contrast of a line pattern last reaches a threshold.

    The contrast is |H(u; alpha, psi)| times the pixel's transfer; "last" because contrast without a mask
    passes zero and comes back reversed. Made monotone by taking the best of all weaker masks.

    Attributes
    ----------
    optics
        The camera's optics; the default's f-number was itself inferred from the paper's points.
    criterion_lp_per_mm
        The pattern that must stay visible.
    threshold
        The contrast at which it is.
    sensor_share
        The share of the sensor's Nyquist frequency that is resolved at best (Kell factor); 53 line pairs
        per mm without a mask are 0.78 of it.

    Raises
    ------
    InputError
        The pattern lies beyond the optics' cut-off or the threshold outside (0, 1).

    Source
    ------
    docs/maths.md, eq. O13.
    """

    optics: OpticalSystem = field(default_factory=OpticalSystem)
    criterion_lp_per_mm: float = 20.0
    threshold: float = 0.09
    sensor_share: float = 0.78
    name: str = "model"
    _alpha: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    _depth_um: NDArray[np.float64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        require_positive(
            criterion_lp_per_mm=self.criterion_lp_per_mm,
            threshold=self.threshold,
            sensor_share=self.sensor_share,
        )
        u = self._u(self.criterion_lp_per_mm)
        if min(u, self.threshold) < _LEAST:
            raise InputError(
                f"a pattern of {self.criterion_lp_per_mm:g} line pairs per mm at a contrast of "
                f"{self.threshold:g} came: both at least {_LEAST:g} of their largest were wanted"
            )
        if u >= 2 or self.contrast(0.0, 0.0) < self.threshold:
            raise InputError(
                f"a pattern of {self.criterion_lp_per_mm} line pairs per mm does not reach a contrast of "
                f"{self.threshold} even in focus: choose a coarser pattern or a lower threshold"
            )
        alpha, psi = self._last_crossings(u)
        reached = np.maximum.accumulate(psi)
        depth = np.array([self.optics.depth_um(float(p)) for p in reached])
        object.__setattr__(self, "_alpha", alpha)
        object.__setattr__(self, "_depth_um", depth)

    @property
    def deepest_um(self) -> float:
        """The largest depth range any mask covers at this criterion."""
        return float(self._depth_um[-1])

    def covers(self, depth_um: float) -> bool:
        """Say whether any mask keeps the pattern visible over `depth_um`."""
        return 0 <= depth_um <= self.deepest_um

    def contrast(self, alpha_rad: float, psi_rad: float, lp_per_mm: float | None = None) -> float:
        """Return the contrast of a line pattern (the criterion's if none is named) through mask and pixel.

        Raises
        ------
        InputError
            Not finite, or a negative number of line pairs.
        LimitError
            A phase beyond the measured range.
        """
        nu = self.criterion_lp_per_mm if lp_per_mm is None else lp_per_mm
        if not (math.isfinite(nu) and nu >= 0):
            raise InputError(f"lp_per_mm is {nu}: a finite number of 0 or more was wanted")
        require_envelope(alpha_rad, psi_rad)
        u = self._u(nu)
        if u == 0:
            return 1.0
        # alpha < 0 is the conjugate of alpha > 0 at -psi, and neither sign changes the modulus.
        values = _modulus(min(u, 2.0), np.array([abs(alpha_rad)]), np.array([abs(psi_rad)]))
        return float(values[0]) * self._pixel(nu) * (u < 2)

    def alpha_rad(self, depth_um: float) -> float:
        """Return the weakest mask that covers `depth_um`, clamped to what any mask covers.

        Raises
        ------
        InputError
            Negative or not finite.
        """
        _require_depth(depth_um)
        if depth_um <= self._depth_um[0]:
            return 0.0
        # A flat stretch of the envelope is left at its end: the first strength that reaches beyond it.
        after = int(np.searchsorted(self._depth_um, min(depth_um, self.deepest_um), side="left"))
        before = after - 1
        share = (min(depth_um, self.deepest_um) - self._depth_um[before]) / (
            self._depth_um[after] - self._depth_um[before]
        )
        return float(self._alpha[before] + share * (self._alpha[after] - self._alpha[before]))

    def depth_um(self, alpha_rad: float) -> float:
        """Return the depth range that `alpha_rad` covers, or a weaker mask if that covers more.

        Raises
        ------
        InputError
            Negative or not finite.
        """
        _require_alpha(alpha_rad)
        return float(np.interp(alpha_rad, self._alpha, self._depth_um))

    def resolution_lp_per_mm(self, alpha_rad: float) -> float:
        """Return the finest pattern resolved in focus: where contrast first falls below the threshold.

        Never more than the sensor resolves.

        Raises
        ------
        InputError
            Negative or not finite.
        """
        _require_alpha(alpha_rad)
        finest = min(
            self.sensor_share * 500 / self.optics.object_pitch_um,
            1000 / (self.optics.wavelength_um * self.optics.f_number),
        )
        nu = np.linspace(0, finest, 2001)[1:]
        u = 2 * nu / 1000 * self.optics.wavelength_um * self.optics.f_number
        values = _modulus(u, np.full(nu.shape, alpha_rad), np.zeros_like(nu))
        values *= np.sinc(nu / 1000 * self.optics.object_pitch_um)
        below = np.flatnonzero(values < self.threshold)
        return float(nu[below[0]]) if below.size else finest

    def _u(self, lp_per_mm: float) -> float:
        return self.optics.normalised_frequency(lp_per_mm / 1000)

    def _pixel(self, lp_per_mm: float) -> float:
        return float(np.sinc(lp_per_mm / 1000 * self.optics.object_pitch_um))

    def _last_crossings(self, u: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """For each strength that passes in focus or beyond: the largest passing psi."""
        wanted = self.threshold / self._pixel(self.criterion_lp_per_mm)
        b = 1 - u / 2
        # Above this strength even the plateau of eq. O6 lies below the threshold.
        alpha = np.linspace(0.0, math.pi / (12 * u * wanted**2), 600)
        # Beyond the last ray, |H| is at most 1/(u psi - 3 alpha u b): nothing passes further out. A point
        # infinitely far away is as deep as depth goes.
        horizon = math.pi * self.optics.aperture_um**2 / (4 * self.optics.wavelength_um)
        horizon *= 0.999 / self.optics.object_distance_um
        last = np.empty_like(alpha)
        for i, a in enumerate(alpha):
            psi = np.arange(0.0, min(3 * a * b + 1 / (u * wanted), horizon), 0.5)
            passing = np.flatnonzero(_modulus(u, np.full(psi.shape, a), psi) >= wanted)
            last[i] = psi[passing[-1]] if passing.size else 0.0
        low, high = last, np.minimum(last + 0.5, horizon)
        for _ in range(24):
            middle = (low + high) / 2
            passes = _modulus(u, alpha, middle) >= wanted
            low, high = np.where(passes, middle, low), np.where(passes, high, middle)
        return alpha, low


def choose_mask(
    near_um: float,
    far_um: float,
    calibration: Calibration,
    optics: OpticalSystem,
    *,
    joint: bool = False,
) -> Mask:
    """Choose the weakest mask that keeps everything between two depths in view.

    Depths count from the plane in focus, negative towards the lens. A mask covers both sides alike, in
    defocus phase; the larger side decides. With `joint` the modulator also moves the focus to the middle of
    the range (in phase), and the mask need only cover half of it. A range deeper than the calibration covers
    gets the strongest mask it knows: ask `calibration.covers(depth_to_cover_um(...))`.

    Raises
    ------
    InputError
        Not finite, or near beyond far.
    LimitError
        The range reaches beyond any depth the optics can have.

    Source
    ------
    The paper's Eq. 4; docs/maths.md, eqs. O12 to O14.
    """
    alpha = calibration.alpha_rad(depth_to_cover_um(near_um, far_um, optics, joint=joint))
    return Mask(alpha_rad=alpha, focus_psi_rad=_focus(near_um, far_um, optics) if joint else 0.0)


def depth_to_cover_um(near_um: float, far_um: float, optics: OpticalSystem, *, joint: bool = False) -> float:
    """Return the one-sided depth, beyond the focus, that defocuses as much as the worse end of the range.

    Raises
    ------
    InputError
        Not finite, or near beyond far.
    LimitError
        No depth beyond the focus defocuses as much.
    """
    require_finite(near_um=near_um, far_um=far_um)
    if near_um > far_um:
        raise InputError(f"near_um is {near_um}, far_um is {far_um}: near must not exceed far")
    focus = _focus(near_um, far_um, optics) if joint else 0.0
    reach = max(abs(optics.psi_rad(near_um) + focus), abs(optics.psi_rad(far_um) + focus))
    try:
        return optics.depth_um(reach)
    except InputError as refusal:
        raise LimitError(
            f"depths from {near_um:g} to {far_um:g} um defocus by {reach:.0f} rad, more than any depth "
            "beyond the focus: choose a shallower range"
        ) from refusal


def depth_margin_um(
    mask: Mask, optics: OpticalSystem, near_um: float, far_um: float, share: float = 0.6
) -> float:
    """Return how far beyond a depth range a mask still covers what is there, the nearer end counting.

    Covered is what defocus leaves `1 - share` of the band of, |psi| at most 3 |alpha| share (docs/maths.md,
    eq. O6). Negative: how far the range lies beyond what is covered. Without a cubic mask nothing is.

    Raises
    ------
    InputError
        Not finite, near beyond far, or a share outside 0 to 1.
    """
    require_finite(near_um=near_um, far_um=far_um)
    if near_um > far_um:
        raise InputError(f"near_um is {near_um}, far_um is {far_um}: near must not exceed far")
    if not 0 <= share <= 1:
        raise InputError(f"share is {share}: 0 to 1 was wanted")
    reach = 3 * abs(mask.alpha_rad) * share
    nearest = optics.depth_um(-reach - mask.focus_psi_rad)
    try:
        farthest = optics.depth_um(reach - mask.focus_psi_rad)
    except InputError:  # no depth defocuses as much
        farthest = math.inf
    return min(farthest - far_um, near_um - nearest)


@dataclass(frozen=True)
class FilterQuality:
    """What a Wiener filter for one blur does to noise and to detail.

    Attributes
    ----------
    noise_gain
        Standard deviation of the restored image's noise over the frame's, for white noise.
    resolution_lp_per_mm
        Finest pattern along an axis, at the object, up to which every one keeps half of its contrast between
        scene and restored image. At most the sensor's own limit.
    """

    noise_gain: float
    resolution_lp_per_mm: float


def filter_quality(
    optics: OpticalSystem, alpha_rad: float, psi_rad: float, nsr: float, *, samples: int = 256
) -> FilterQuality:
    """Predict what restoring with the exact filter of a blur does to noise and to detail.

    Parameters
    ----------
    nsr
        Noise-to-signal power of the filter, above 0.
    samples
        Frequencies along each axis, 1 to 4096.

    Raises
    ------
    InputError
        Not finite, an nsr not above 0, or another number of samples.
    LimitError
        A phase beyond the measured range.

    Source
    ------
    docs/maths.md, eqs. W12 and W13.
    """
    require_envelope(alpha_rad, psi_rad)
    require_positive(nsr=nsr)
    require_whole(samples=samples)
    if samples > 4096:
        raise InputError(f"samples is {samples}: at most 4096 was wanted")
    # alpha < 0 is the conjugate of alpha > 0 at -psi, and neither sign changes the modulus.
    nu = (np.arange(samples) + 0.5) / (2 * samples)  # cycles a pixel, to the sensor's limit
    u = 2 * nu / optics.object_pitch_um * optics.wavelength_um * optics.f_number
    inside = np.minimum(u, 2 - 1e-9)
    h = _modulus(inside, np.full(samples, abs(alpha_rad)), np.full(samples, abs(psi_rad))) * (u < 2)
    power = np.outer(h * h, h * h)
    noise_gain = math.sqrt(float(np.mean(power / (power + nsr) ** 2)))
    below = np.flatnonzero(h * h < nsr)
    finest = float(nu[below[0]]) if below.size else 0.5
    return FilterQuality(noise_gain, 1000 * finest / optics.object_pitch_um)


def _focus(near_um: float, far_um: float, optics: OpticalSystem) -> float:
    return 0.0 - (optics.psi_rad(near_um) + optics.psi_rad(far_um)) / 2  # not -0


def _modulus(
    u: float | NDArray[np.float64], alpha: NDArray[np.float64], psi: NDArray[np.float64]
) -> NDArray[np.float64]:
    """|H| of the square stop, eq. O4 with A(z) by the Faddeeva function; alpha, psi >= 0, 0 < u < 2."""
    b = 1 - u / 2
    c, q = 3 * alpha * u, psi * u
    weak = c * b * b < 1e-9
    c = np.where(weak, 1.0, c)
    k = np.sqrt(2 * c / math.pi)

    def tail(s: NDArray[np.float64]) -> NDArray[np.complex128]:
        z = 2 * s / (math.pi * k)
        return np.asarray((0.5 + 0.5j) * wofz((1 + 1j) * math.sqrt(math.pi) / 2 * z) / k)

    high, low = q + c * b, q - c * b
    run = 2 * q * b
    ends = np.where(low >= 0, 1.0, -1.0) * np.exp(-1j * run) * tail(np.abs(low)) - np.exp(1j * run) * tail(
        high
    )
    inside = np.where(low < 0, (1 + 1j) / k * np.exp(-1j * (q * q / c + c * b * b)), 0)
    return np.where(weak, b * np.abs(np.sinc(2 * q * b / math.pi)), np.abs(ends + inside) / 2)


def _require_depth(depth_um: float) -> None:
    if not (math.isfinite(depth_um) and depth_um >= 0):
        raise InputError(f"depth_um is {depth_um}: a depth range of 0 or more was wanted")


def _require_alpha(alpha_rad: float) -> None:
    if not (math.isfinite(alpha_rad) and alpha_rad >= 0):
        raise InputError(f"alpha_rad is {alpha_rad}: a mask strength of 0 or more was wanted")
