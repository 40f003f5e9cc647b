"""Find the position of sharpest focus from images, with its uncertainty.

Sweep with the cubic mask off (alpha = 0): a coded image is made not to change with focus. Equation numbers
are those of docs/maths.md, section 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from adof_cl.errors import InputError, TrackingError
from adof_cl.optics import require_finite, require_positive, require_whole

Array = NDArray[np.float64]

_GRAIN_PX = 1.2  # detail this coarse carries most of an optical image's contrast and little of its noise
_CLIPPED = 0.02  # share of pixels at full scale above which the sharpness is of the clipping
_BLACKEST = 0.01  # mean grey, of full scale, below which there is no light to focus
_NEAR_PEAK = 0.6  # the share of the peak's height above which its logarithm is a parabola
_LEAST_RISE = 5.0  # the peak over the curve's floor, in standard deviations of a score
_LEAST_CONTRAST = (
    0.1  # and as a share of the peak: a weak cubic mask leaves up to 0.06, with its peak anywhere
)


@dataclass(frozen=True)
class Focus:
    """Where focus is sharpest.

    Attributes
    ----------
    position
        In the sweep's own unit.
    sigma
        Its standard deviation from the scatter of the scores.
    positions, scores : (n,)
        Every measurement, in order of position.
    """

    position: float
    sigma: float
    positions: Array
    scores: Array


def sharpness(image: NDArray[Any], *, full_scale: float | None = None) -> float:
    """Return the variance of the Laplacian of Gaussian over the squared mean: larger is sharper (eq. S14).

    Dividing by the mean makes it blind to the light's strength.

    Parameters
    ----------
    image : (rows, columns)
        A region with detail, at least 16 pixels a side.
    full_scale
        The grey level at which the camera clips; None: 255, 65535, or 1 for real images.

    Raises
    ------
    InputError
        Not two-dimensional, too small, not finite, black, or clipped.
    """
    if image.ndim != 2 or min(image.shape) < 16:
        raise InputError(f"an image of shape {image.shape} came: at least 16 x 16 pixels were wanted")
    if full_scale is None:
        full_scale = float(np.iinfo(image.dtype).max) if np.issubdtype(image.dtype, np.integer) else 1.0
    require_positive(full_scale=full_scale)
    grey = image.astype(np.float64) / full_scale
    mean = float(grey.mean())
    if not math.isfinite(mean):
        raise InputError("the image holds values that are not finite: take it anew")
    if mean < _BLACKEST:
        raise InputError(
            f"the image is black, its mean {mean:.4f} of full scale: give more light or exposure"
        )
    clipped = float((grey >= 1).mean())
    if clipped > _CLIPPED:
        raise InputError(f"{clipped:.0%} of the image is at full scale: reduce light or exposure")
    detail = ndimage.gaussian_laplace(grey, _GRAIN_PX)
    edge = math.ceil(3 * _GRAIN_PX)
    return float(detail[edge:-edge, edge:-edge].var()) / mean**2


def focus_sweep(
    measure: Callable[[float], NDArray[Any] | float],
    low: float,
    high: float,
    *,
    coarse: int = 13,
    rounds: int = 3,
    full_scale: float | None = None,
) -> Focus:
    """Sweep a range coarsely, then ever closer around the peak, and fit the peak.

    Parameters
    ----------
    measure
        Moves to a position and returns the image there, or a score of its own that grows with sharpness and
        is not negative.
    low, high
        The range, in any unit; the peak must lie inside.
    coarse
        Positions of the first sweep, at least 5.
    rounds
        Closer sweeps of 5 positions, each half as wide.
    full_scale
        As for `sharpness`.

    Raises
    ------
    InputError
        The range is empty or not finite, or an image is black, clipped or not finite.
    TrackingError
        The curve is flat, or still rises at an end of the range.

    Source
    ------
    docs/maths.md, eqs. S14 and S15.
    """
    require_finite(low=low, high=high)
    if low >= high:
        raise InputError(f"the range {low} to {high} is empty: give the smaller end first")
    require_whole(5, coarse=coarse)
    require_whole(1, rounds=rounds)

    def score(position: float) -> float:
        answer = measure(float(position))
        value = sharpness(answer, full_scale=full_scale) if isinstance(answer, np.ndarray) else float(answer)
        if not math.isfinite(value) or value < 0:
            raise InputError(f"the score at {position:g} is {value}: a finite number, 0 or more, was wanted")
        return value

    positions = [float(z) for z in np.linspace(low, high, coarse)]
    scores = [score(z) for z in positions]
    top = int(np.argmax(scores))
    # The same place twice more tells the scores' scatter from their slope.
    again = [score(positions[top]) for _ in range(2)]
    scatter = float(np.std([scores[top], *again], ddof=1))
    floor = float(np.percentile(scores, 20))
    if scores[top] - floor <= max(_LEAST_RISE * scatter, _LEAST_CONTRAST * scores[top]):
        raise TrackingError(
            f"the focus curve is flat from {low:g} to {high:g}: switch the cubic mask off, look at a place "
            "with detail, or widen the range"
        )
    if top in (0, coarse - 1):
        raise TrackingError(
            f"sharpness still rises at {positions[top]:g}, an end of the range: move the range that way"
        )
    positions += [positions[top]] * 2
    scores += again

    centre, width = positions[top], (high - low) / (coarse - 1)
    for _ in range(rounds):
        for z in centre + width * np.linspace(-1, 1, 5):
            if low <= z <= high:
                positions.append(float(z))
                scores.append(score(z))
        centre, sigma = _peak(np.array(positions), np.array(scores), centre, width, scatter)
        width /= 2
    order = np.argsort(positions, kind="stable")
    return Focus(centre, sigma, np.array(positions)[order], np.array(scores)[order])


def _peak(
    positions: Array, scores: Array, centre: float, width: float, scatter: float
) -> tuple[float, float]:
    """Fit a parabola to the logarithm of the scores near the peak (eq. S15): place and standard deviation."""
    near = (scores >= _NEAR_PEAK * scores.max()) & (np.abs(positions - centre) <= 2.5 * width)
    if np.unique(positions[near]).size < 4:  # a peak narrower than the sweep: its five nearest places
        distance = np.abs(positions - positions[scores.argmax()])
        near = (distance <= np.unique(distance)[min(4, np.unique(distance).size - 1)]) & (scores > 0)
    x = (positions[near] - centre) / width
    y = np.log(scores[near] / scores.max())
    weights = scores[near] / scores.max()  # scores of equal scatter: their logarithms are the worse the lower
    design = np.stack([np.ones_like(x), x, x * x], axis=1) * weights[:, None]
    inverse = np.linalg.pinv(design.T @ design)
    _, slope, bend = inverse @ (design.T @ (weights * y))
    if bend >= 0:
        raise TrackingError("the focus curve has no single peak: look at one part, or narrow the range")
    left = weights * y - design @ (inverse @ (design.T @ (weights * y)))
    variance = max(float(left @ left) / max(x.size - 3, 1), (scatter / scores.max()) ** 2)
    place = -slope / (2 * bend)
    by = np.array([0, -1 / (2 * bend), slope / (2 * bend * bend)])
    sigma = math.sqrt(float(by @ inverse @ by) * variance)
    return float(centre + width * np.clip(place, -1, 1)), float(width * sigma)
