"""Find a part in a picture by its drawing: where, how turned, to a fraction of a pixel.

A drawing ties templates to the part's geometry without trusting any edge's brightness: the etched marks are
matched as a whole. First a search over place and turn by normalised correlation, then OpenCV's maximisation
of the enhanced correlation coefficient (Evangelidis and Psarakis, IEEE TPAMI 30 (2008) 1858), which no gain
or offset moves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError, TrackingError
from adof_cl.finite import finite_array
from adof_cl.optics import require_positive

Array = NDArray[np.float64]
_FINE_PX, _COARSE_PX = 0.6, 4.0  # band both pictures are compared in: below is noise, above is shading
_TURNS_RAD = np.radians(np.arange(-6.0, 6.01, 1.0))
_FOUND = 0.35
_PASSES = 3
_WIDEST_PX, _FARTHEST_PX, _BRIGHTEST = 4096, 1e6, 1e16


class Drawing(Protocol):
    """A part's face as drawn."""

    @property
    def radiance(self) -> NDArray[np.float32]:
        """(rows, columns): brightness, any scale."""
        ...

    @property
    def judged(self) -> NDArray[np.bool_]:
        """(rows, columns): where to compare it, and not where another part may stand in front."""
        ...

    @property
    def pitch_um(self) -> float:
        """Sampling, finer than a camera pixel."""
        ...

    @property
    def centre_yx(self) -> tuple[float, float]:
        """Index of the part's origin."""
        ...


@dataclass(frozen=True)
class Registration:
    """Where a drawing was found: pixel (x, y) = matrix @ um + origin.

    Attributes
    ----------
    matrix : (2, 2)
        Pixels per um of the drawing.
    origin_px : (2,)
        Where the part's origin is seen.
    correlation
        Of picture and drawing where judged, 1 for a perfect likeness.
    """

    matrix: Array
    origin_px: Array
    correlation: float

    def pixels(self, places_um: Array) -> Array:
        """Return where places (n, 2) on the drawing are seen."""
        return np.asarray(places_um @ self.matrix.T + self.origin_px)


def as_seen(
    drawing: Drawing, matrix: Array, fraction_px: Array | None = None
) -> tuple[NDArray[np.float32], NDArray[np.uint8], Array]:
    """Render the drawing as a camera with `matrix` (pixels per um) sees it, whole pixels integrated.

    The part's origin lies `fraction_px` beyond a pixel's centre, by default on one. Returns the picture,
    where it is judged (uint8, 0 or 1), and where the part's origin lies in it, (x, y).

    Raises
    ------
    InputError
        A matrix or a fraction that is not finite, or a picture narrower than a pixel or wider than 4096.
    """
    matrix = finite_array("matrix", matrix, (2, 2))
    rows, columns = drawing.radiance.shape
    finer = 4
    centre = np.array(drawing.centre_yx[::-1])
    corners = np.array([[x, y] for x in (0, columns - 1) for y in (0, rows - 1)]) - centre
    seen = corners * drawing.pitch_um @ matrix.T
    extent = np.ptp(seen, axis=0)
    if extent.min() < 1 or extent.max() > _WIDEST_PX:
        raise InputError(
            f"the drawing would be {extent[0]:.3g} x {extent[1]:.3g} pixels: 1 to {_WIDEST_PX} a side were "
            "wanted, so check the matrix's unit"
        )
    at = np.zeros(2) if fraction_px is None else finite_array("fraction_px", fraction_px, (2,))
    if np.abs(at).max() > 1:
        raise InputError(f"fraction_px is {at.tolist()}: at most a pixel either way was wanted")
    low = np.floor(seen.min(axis=0) + at).astype(int) - 1
    size = np.ceil(seen.max(axis=0) + at).astype(int) + 2 - low
    to_fine = finer * matrix * drawing.pitch_um
    # A pixel's centre lies at an integer; its first finer sample half a pixel less before it.
    shift = finer * (at - low) + (finer - 1) / 2 - to_fine @ centre
    warp = np.column_stack([to_fine, shift])
    shape = (int(size[0]) * finer, int(size[1]) * finer)
    soft = cv2.GaussianBlur(drawing.radiance, (0, 0), max(0.3, 0.4 / float(np.abs(to_fine).max())))
    fine = cv2.warpAffine(soft, warp, shape, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    where = cv2.warpAffine(drawing.judged.astype(np.float32), warp, shape, flags=cv2.INTER_LINEAR)
    picture = fine.reshape(int(size[1]), finer, int(size[0]), finer).mean(axis=(1, 3), dtype=np.float32)
    judged = where.reshape(int(size[1]), finer, int(size[0]), finer).mean(axis=(1, 3)) > 0.99
    return picture, judged.astype(np.uint8), at - low


def register(
    image: NDArray[np.generic],
    drawing: Drawing,
    matrix: Array,
    *,
    expected_px: Array | None = None,
    reach_px: float = 60.0,
) -> Registration:
    """Find a drawn part in a picture.

    Parameters
    ----------
    image : (rows, columns)
        Grey, in focus or restored.
    drawing
        What to look for.
    matrix : (2, 2)
        Pixels per um as expected, the part unturned; it may be turned by up to 6 degrees.
    expected_px : (2,), optional
        About where the part's origin should be seen; without it the whole picture is searched.
    reach_px
        How far from there it may be.

    Raises
    ------
    InputError
        Not a grey picture of finite levels, or a matrix or place that cannot be.
    TrackingError
        Nothing there resembles the drawing.
    """
    if image.ndim != 2 or not image.size or image.dtype.kind not in "fiu":
        raise InputError(f"an image of shape {image.shape} came: a grey picture was wanted")
    if not np.abs(image, dtype=np.float64).max() <= _BRIGHTEST:  # NaN neither
        raise InputError(f"the image holds NaN, infinity or levels beyond {_BRIGHTEST:g}: take it anew")
    matrix = finite_array("matrix", matrix, (2, 2))
    require_positive(reach_px=reach_px)
    if expected_px is not None:
        expected_px = finite_array("expected_px", expected_px, (2,))
        if max(float(np.abs(expected_px).max()), reach_px) > _FARTHEST_PX:
            raise InputError(
                f"expected_px or reach_px exceeds {_FARTHEST_PX:g} px: a nearer place was wanted"
            )
    soft = _band(image.astype(np.float32))
    best = (-1.0, np.eye(2), np.zeros(2))
    for turn in _TURNS_RAD:
        c, s = math.cos(turn), math.sin(turn)
        turned = matrix @ np.array([[c, -s], [s, c]])
        picture, judged, origin = as_seen(drawing, turned)
        window, first = _window(soft, picture.shape, origin, expected_px, reach_px)
        if window is None:
            continue
        picture = _band(picture)
        score = cv2.matchTemplate(window, picture, cv2.TM_CCOEFF_NORMED, mask=judged.astype(np.float32))
        score[~np.isfinite(score)] = -1
        _, height, _, (x, y) = cv2.minMaxLoc(score)
        if height > best[0]:
            best = (height, turned, np.array([x, y]) + first + origin)
    if best[0] < _FOUND:
        raise TrackingError(
            f"nothing in the picture resembles the drawing (correlation {best[0]:.2f}, {_FOUND} was wanted): "
            "check focus, light and that the part is in view"
        )
    found = Registration(best[1], best[2], best[0])
    for _ in range(_PASSES):  # each renders the drawing as the last one found it
        found = _refined(soft, drawing, found.matrix, found.origin_px)
    return found


def _window(
    image: NDArray[np.float32],
    size: tuple[int, ...],
    origin: Array,
    expected: Array | None,
    reach: float,
) -> tuple[NDArray[np.float32] | None, Array]:
    rows, columns = image.shape
    x0, y0, x1, y1 = 0, 0, columns, rows
    if expected is not None:
        low = np.floor(expected - origin - reach).astype(int)
        high = np.ceil(expected - origin + reach).astype(int) + np.array(size[::-1])
        x0, y0 = max(0, int(low[0])), max(0, int(low[1]))
        x1, y1 = min(columns, int(high[0])), min(rows, int(high[1]))
    if x1 - x0 < size[1] or y1 - y0 < size[0]:
        return None, np.zeros(2)
    return image[y0:y1, x0:x1], np.array([x0, y0], dtype=np.float64)


def _band(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Keep the marks: without the noise, and without the shadow a part in front casts out of focus."""
    fine = cv2.GaussianBlur(picture, (0, 0), _FINE_PX)
    return np.asarray(fine - cv2.GaussianBlur(picture, (0, 0), _COARSE_PX), dtype=np.float32)


def _refined(image: NDArray[np.float32], drawing: Drawing, matrix: Array, origin_px: Array) -> Registration:
    # Rendered at the place found last, to the fraction: what is left to interpolate would shift it.
    picture, judged, origin = as_seen(drawing, matrix, origin_px - np.floor(origin_px))
    start = origin_px - origin
    low = np.maximum(np.floor(start - 8).astype(int), 0)
    high = np.minimum(np.ceil(start + np.array(picture.shape[::-1]) + 8).astype(int), image.shape[::-1])
    part = image[low[1] : high[1], low[0] : high[0]]
    # OpenCV masks the picture it warps, and what is not to be judged is known on the drawing: so the drawing
    # is warped onto the image, and the transform goes from image to drawing.
    inverse = np.array([[1, 0, low[0] - start[0]], [0, 1, low[1] - start[1]]], dtype=np.float32)
    soft = _band(picture)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-5)
    try:
        height, found = cv2.findTransformECC(
            part, soft, inverse, cv2.MOTION_AFFINE, criteria, judged * np.uint8(255), 1
        )
    except cv2.error as failure:
        raise TrackingError(
            "the part was found but its place could not be refined: check focus and light"
        ) from failure
    # `found` maps a pixel of `part` to one of the drawing's picture; its inverse says where a place is seen.
    forward = np.linalg.inv(found[:, :2].astype(np.float64))
    place = forward @ (origin - found[:, 2].astype(np.float64)) + low
    moved = float(np.linalg.norm(place - origin_px))
    if moved > 6 or height < _FOUND:
        raise TrackingError(
            f"the part was found but refining moved it by {moved:.1f} px (correlation {height:.2f}): check "
            "focus and light"
        )
    # A rigid part seen square on turns and, by the magnification's error, grows; shear would be noise.
    turn = math.atan2(forward[1, 0] - forward[0, 1], forward[0, 0] + forward[1, 1])
    scale = math.sqrt(abs(float(np.linalg.det(forward))))
    c, s = scale * math.cos(turn), scale * math.sin(turn)
    return Registration(np.array([[c, -s], [s, c]]) @ matrix, place, float(height))
