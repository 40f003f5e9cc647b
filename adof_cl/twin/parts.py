"""What the parts look like: radiance in [0, 1], painted finely enough that no pixel of it is seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom
from scipy.special import erf

from adof_cl.twin.design import HolePlate, Peg

Plane = NDArray[np.float32]

# A sixth of a camera pixel; edges are soft over _EDGE_UM (standard deviation), so that neither this grid nor
# the camera's threefold one shows (docs/maths.md, T7).
PITCH_UM = 7.4 / 6
_EDGE_UM = 1.5
_CELL_UM = 30.0
_SHEET = 128  # cells along a side of the sheet the marks are drawn from

BACKGROUND = 0.05
_HOLE = 0.08
_PLATE = 0.60
_PEG = 0.45
_PEG_SIDE = 0.16


@dataclass(frozen=True, eq=False)
class Painted:
    """Planes of one part on a common grid.

    Attributes
    ----------
    planes : (k, rows, cols)
        Whatever is to be blurred together; 0 outside the part.
    centre_yx
        Index of the part's origin.
    low_um, high_um
        The part's extent as (x, y).
    """

    planes: NDArray[np.float32]
    centre_yx: tuple[float, float]
    low_um: tuple[float, float]
    high_um: tuple[float, float]


def _axis(low_um: float, high_um: float) -> tuple[NDArray[np.float64], float]:
    before = int(np.ceil(-low_um / PITCH_UM)) + 6
    after = int(np.ceil(high_um / PITCH_UM)) + 6
    return np.asarray(np.arange(-before, after + 1) * PITCH_UM, dtype=np.float64), float(before)


def _within(x: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    # Linear interpolation adds a variance of a sixth of a sample squared, on average.
    soft = np.sqrt(2 * (_EDGE_UM**2 - PITCH_UM**2 / 6))
    return np.asarray((erf((x - low) / soft) - erf((x - high) / soft)) / 2)


def _box(x: NDArray[np.float64], y: NDArray[np.float64], width: float, depth: float) -> Plane:
    return np.outer(_within(y, -depth / 2, depth / 2), _within(x, -width / 2, width / 2)).astype(np.float32)


def _grain(shape: tuple[int, int], size_um: float, strength: float, rng: np.random.Generator) -> Plane:
    """Smooth random shading of the given grain size and rms."""
    coarser = max(1, int(size_um / PITCH_UM / 3))
    small = [n // coarser + 4 for n in shape]
    noise = rng.standard_normal(small, dtype=np.float32)
    noise = gaussian_filter(noise, size_um / PITCH_UM / coarser, mode="wrap")
    noise *= strength / noise.std()
    grown = noise if coarser == 1 else zoom(noise, coarser, order=1)
    return np.ascontiguousarray(grown[: shape[0], : shape[1]], dtype=np.float32)


def _cells(
    x: NDArray[np.float64], y: NDArray[np.float64], rng: np.random.Generator, keep: NDArray[np.bool_]
) -> Plane:
    """Etched squares, each up or down at random: +-1 where `keep`, soft at their edges."""
    column = np.floor(x / _CELL_UM).astype(int)
    row = np.floor(y / _CELL_UM).astype(int)
    # One sheet of marks, counted from the part's origin: the same whatever else is painted beside it.
    signs = rng.choice(np.array([-1, 1], dtype=np.float32), size=(_SHEET, _SHEET))
    pattern = np.where(keep, signs[np.ix_(row + _SHEET // 2, column + _SHEET // 2)], 0)
    return gaussian_filter(pattern.astype(np.float32), _EDGE_UM / PITCH_UM)


def paint_plate(hole: HolePlate, rng: np.random.Generator | None) -> Painted:
    """Paint the plate's top face: bright, grained, etched around the hole's corners; minus the background."""
    x, x0 = _axis(-hole.plate_width_um / 2, hole.plate_width_um / 2)
    y, y0 = _axis(-hole.plate_depth_um / 2, hole.plate_depth_um / 2)
    shape = (y.size, x.size)
    near_x = np.abs(np.abs(x) - hole.width_um / 2) < 5 * _CELL_UM
    near_y = np.abs(np.abs(y) - hole.depth_um / 2) < 5 * _CELL_UM
    face = np.full(shape, _PLATE - BACKGROUND, dtype=np.float32)
    if rng is not None:
        face += _grain(shape, 6.0, 0.02, rng) + _grain(shape, 40.0, 0.025, rng)
    # The etched marks are part of the design: alike in every world.
    face += 0.13 * _cells(x, y, np.random.default_rng(1), np.outer(near_y, near_x))
    opening = _box(x, y, hole.width_um, hole.depth_um)
    face += opening * (_HOLE - BACKGROUND - face)
    face *= _box(x, y, hole.plate_width_um, hole.plate_depth_um)
    half = (hole.plate_width_um / 2, hole.plate_depth_um / 2)
    return Painted(face[None], (y0, x0), (-half[0], -half[1]), half)


def paint_peg(peg: Peg, rng: np.random.Generator | None, *, side_um: float = 0.0) -> Painted:
    """Paint the peg's top face, and `side_um` of its +x side unfolded beside it; planes: radiance, cover."""
    half = (peg.width_um / 2, peg.depth_um / 2)
    x, x0 = _axis(-half[0], half[0] + side_um)
    y, y0 = _axis(-half[1], half[1])
    shape = (y.size, x.size)
    face = np.full(shape, _PEG, dtype=np.float32)
    if rng is not None:
        face += _grain((y.size, y.size * 2), 6.0, 0.02, rng)[:, : x.size]
    face += 0.12 * _cells(x, y, np.random.default_rng(2), np.ones(shape, dtype=np.bool_))
    rows = _within(y, -half[1], half[1])
    top = np.outer(rows, _within(x, -half[0], half[0])).astype(np.float32)
    side = np.outer(rows, _within(x, half[0], half[0] + side_um)).astype(np.float32)
    planes = np.stack([face * top + _PEG_SIDE * side, top + side])
    return Painted(planes, (y0, x0), (-half[0], -half[1]), (half[0] + side_um, half[1]))


@dataclass(frozen=True)
class Drawing:
    """A part's face as drawn, without the grain that no drawing shows.

    Attributes
    ----------
    radiance : (rows, cols)
        Brightness in [0, 1].
    judged : (rows, cols)
        Where a picture may be compared with it: inside the peg's rim; around the hole, not in it.
    pitch_um, centre_yx
        Sampling, and the index of the part's origin.
    """

    radiance: Plane
    judged: NDArray[np.bool_]
    pitch_um: float
    centre_yx: tuple[float, float]


def drawing_of(part: Peg | HolePlate, *, over_hole: bool = False) -> Drawing:
    """Return a part's drawing, cut to where its etched marks are.

    `over_hole`: the peg as it stands over the dark hole, so that its rim can be judged as well.
    """
    painted = paint_peg(part, None) if isinstance(part, Peg) else paint_plate(part, None)
    radiance, centre = painted.planes[0], painted.centre_yx
    if isinstance(part, Peg) and over_hole:
        margin = 24
        radiance = np.pad(radiance + (1 - painted.planes[1]) * _HOLE, margin, constant_values=_HOLE)
        centre = (centre[0] + margin, centre[1] + margin)
    y = (np.arange(radiance.shape[0]) - centre[0]) * PITCH_UM
    x = (np.arange(radiance.shape[1]) - centre[1]) * PITCH_UM
    far_x, far_y = np.abs(x)[None, :], np.abs(y)[:, None]
    half_x, half_y = part.width_um / 2, part.depth_um / 2
    if isinstance(part, Peg):
        rim_um = -22.0 if over_hole else 45.0
        return Drawing(radiance, (far_x < half_x - rim_um) & (far_y < half_y - rim_um), PITCH_UM, centre)
    reach = 6 * _CELL_UM
    judged = (far_x > half_x - 20) | (far_y > half_y - 20)
    judged &= (far_x < half_x + reach) & (far_y < half_y + reach)
    rows = np.flatnonzero(np.abs(y) < half_y + reach + 10)
    columns = np.flatnonzero(np.abs(x) < half_x + reach + 10)
    cut = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    return Drawing(radiance[cut], judged[cut], PITCH_UM, (centre[0] - rows[0], centre[1] - columns[0]))
