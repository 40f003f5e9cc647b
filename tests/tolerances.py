"""Error limits, each derived from the arithmetic that causes it.

eps is the unit of the working precision, n the length or size the rounding errors run over. A limit that no
derivation supports does not belong here.
"""

from __future__ import annotations

import math

import numpy as np

# ---- general ----------------------------------------------------------------------------------------------


def eps(precision: str) -> float:
    """Spacing of 1 in the working precision."""
    return float(np.finfo(precision).eps)


def fft_relative_l2(precision: str, size: int) -> float:
    """Relative L2 limit of a forward and inverse transform of `size` points in all.

    Rounding errors of a mixed-radix transform add like a random walk over log2(size) stages, twice; each
    stage costs at most about 1 eps of rms. Higham, Accuracy and Stability, theorem 24.2, gives the log.
    """
    return eps(precision) * (2 + 0.5 * math.log2(max(size, 2)))


# ---- optics -----------------------------------------------------------------------------------------------


def otf_error(precision: str, alpha: float) -> float:
    """Limit of |dH|.

    The project's bound: 3e-6 in float32 up to |alpha| = 1e3, 1e-5 at 1e4, 1e-12 in float64. The terms of
    docs/maths.md eq. O4 are at most 3.5 and each carries some ten roundings: 35 eps = 4e-6, worst case.
    """
    if precision == "float64":
        return 1e-12
    return 3e-6 if abs(alpha) <= 1e3 else 1e-5


def otf_grid_error(alpha: float, psi: float, samples: int) -> float:
    """Limit of |dH| by `samples` cells across the stop: the midpoint rule on a phase of that slope.

    Measured: 0.2 (3 alpha + 2 psi)/n^2 within a factor 2; 0.5/n^2 remains without phase.
    """
    return 2 * (0.2 * (3 * abs(alpha) + 2 * abs(psi)) + 0.5) / samples**2


def phase_rad(precision: str) -> float:
    """Limit of a wrapped phase: two axes' fractions, a map's, and their sum, each half an eps of one turn."""
    return 2 * math.pi * 2 * eps(precision)


# ---- search -----------------------------------------------------------------------------------------------


def image_prep_real(frame: np.ndarray, dark: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Absolute limit of gain (frame - dark): each of the four numbers and results rounds once, in float32."""
    return 2 * eps("float32") * gain * (frame + np.abs(dark)) + 1e-30


def ssd_relative(rows: int, columns: int) -> float:
    """Relative limit of a float32 SSD (docs/maths.md, eq. S4): terms of one sign, summed row by row."""
    return eps("float32") * (rows + columns + 2) / 2


def gain_offset_bytes(taps: int, image_squares: np.ndarray, template_squares: float) -> np.ndarray:
    """Absolute limit of the gain/offset score on bytes, from eq. S6.

    The ratio carries eight roundings; the covariance's last term, at most `taps`, carries two more of its
    own, which weigh against the root of both sums of squares.
    """
    root = np.sqrt(np.maximum(image_squares, 1e-9) * template_squares)
    return eps("float32") * (8 + 4 * taps / root)


def gain_offset_real(rows: int, columns: int, span: float) -> float:
    """Absolute limit of the gain/offset score on 16-bit and real images.

    Each of three sums is off by (rows + columns + 2)/2 eps, the ratio doubles one of them, and each centred
    value by eps/2 of the window's span, in standard deviations of the place, twice over.
    """
    return eps("float32") * (2 * (rows + columns + 2) + 4 * span + 8)


# ---- restoration ------------------------------------------------------------------------------------------


def restore_relative_l2(precision: str, largest_gain: float = 1.0) -> float:
    """Relative L2 limit of a restored frame.

    The project's bound: 5e-7 in float32, 1e-14 in float64: four and fifty eps, for some twenty passes whose
    roundings add like a random walk. Noise of the transforms is white, a filter amplifies its share at high
    frequencies by up to `largest_gain`, while the frame's own power sits at low ones.
    """
    bound = 5e-7 if precision == "float32" else 1e-14
    return bound * max(1.0, largest_gain / 5)


def wiener_relative(precision: str) -> float:
    """Limit of |dG|/|G| for exact axes: a complex product, a squared modulus, a quotient, a product."""
    return 8 * eps(precision)
