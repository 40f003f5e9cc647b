"""Affine cameras: calibration with an honest error, and depth from two of them.

At high magnification a camera is scaled-orthographic: pixels are a linear function of position (paper,
Eqs 5-6). Two such cameras measure one point four times for three unknowns (Eq. 8). All in float64.
Equation numbers are those of docs/maths.md, section 6.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adof_cl.errors import CalibrationError, InputError
from adof_cl.finite import finite_array
from adof_cl.optics import require_finite, require_positive

Array = NDArray[np.float64]

DEFAULT_SIGMA_PX = 0.1
"""Noise of one tracked coordinate where the caller states none."""

DEFAULT_SIGMA_LIMIT_UM = 5.0
"""Largest predicted error of position or depth over the work volume that a calibration may have."""

RESIDUAL_GATE_SIGMA = 5.0
"""A pair of features whose residual lies beyond this many sigma does not show one point."""

REFUSE_ANGLE_RAD = math.radians(5)
WARN_ANGLE_RAD = math.radians(15)
MINIMUM_POINTS = 6
_FARTHEST_STEP_UM = 1e6
_FARTHEST = 1e12  # of points in um and of pixels, either way
_SMALLEST_SIGMA_PX, _LARGEST_SIGMA_PX = 1e-6, 1e6
_AXES = "xyz"
_FLAT = 1e-6  # points this flat, against their width, lie in a plane: 3 nm on 3 mm


def _work_volume(value: ArrayLike) -> Array:
    volume = finite_array("work_volume_um", value, (2, 3))
    if not np.all(volume[1] > volume[0]):
        raise InputError(
            f"work_volume_um runs from {volume[0].tolist()} to {volume[1].tolist()}: the second corner "
            "must lie above the first along x, y and z"
        )
    return volume


def _corners(volume_um: Array) -> Array:
    """Return the 8 corners: a predicted sigma is convex in position, so its maximum is at one of them."""
    return np.array(
        [[volume_um[pick, axis] for axis, pick in enumerate(p)] for p in product((0, 1), repeat=3)]
    )


def _pixel_jacobian(offsets_um: Array, constant: float) -> Array:
    """Return d(u, v)/d(q1, u_c, q2, v_c), shape (n, 2, 8), at (n, 3) offsets from the camera's centre."""
    n = len(offsets_um)
    jacobian = np.zeros((n, 2, 8))
    for row in (0, 1):
        jacobian[:, row, 4 * row : 4 * row + 3] = offsets_um
        jacobian[:, row, 4 * row + 3] = constant
    return jacobian


def _worst_sigma_px(covariance: Array, centre_um: Array, volume_um: Array) -> float:
    """Return the largest one-sigma pixel error over the volume that the parameters' covariance predicts."""
    jacobian = _pixel_jacobian(_corners(volume_um) - centre_um, 1.0)
    pixel = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return math.sqrt(max(float(np.linalg.eigvalsh(pixel)[:, -1].max()), 0.0))


@dataclass(frozen=True)
class PixelShape:
    """How square the pixels came out: two checks the eight affine parameters leave free (eq. G4).

    Attributes
    ----------
    aspect, aspect_sigma
        |q1| / |q2| and its one-sigma error; 1 for square pixels.
    skew_rad, skew_sigma_rad
        Departure of the two pixel axes from a right angle.
    """

    aspect: float
    aspect_sigma: float
    skew_rad: float
    skew_sigma_rad: float

    @property
    def square(self) -> bool:
        """Whether both checks hold within 5 sigma (or within rounding, for an exact camera)."""
        rounding = 1e-9
        return (
            abs(self.aspect - 1) <= 5 * self.aspect_sigma + rounding
            and abs(self.skew_rad) <= 5 * self.skew_sigma_rad + rounding
        )


@dataclass(frozen=True, eq=False)
class AffineCamera:
    """One calibrated camera: pixel = matrix (point - centre) + pixel of the centre (eq. G1).

    The parameters are kept about the pattern's centroid, where they are nearly independent and where a world
    origin a metre away costs no digits. The gate of eq. G5 holds for every camera that exists.

    Attributes
    ----------
    matrix_px_per_um : (2, 3)
        Rows q1, q2: pixels along x (columns) and y (rows) per um of world x, y, z.
    centre_um : (3,)
        The calibration pattern's centroid.
    centre_px : (2,)
        Where that centroid is seen, (x, y).
    covariance : (8, 8)
        Of (q1, x of the centre, q2, y of the centre); px^2, px^2/um, px^2/um^2.
    work_volume_um : (2, 3)
        Lower and upper corner of the region the gate covers.
    sigma_limit_um
        Largest predicted error of a point's image over the work volume, at the object's scale.
    rms_px
        Scatter of the fit, per coordinate.
    extent_um : (3,)
        Size of the pattern's bounding box.
    points
        How many points it stands on; 0 for a camera given exactly.
    camera_id, lens_id
        Serial numbers or names of what was calibrated.
    """

    matrix_px_per_um: Array
    centre_um: Array
    centre_px: Array
    covariance: Array
    work_volume_um: Array
    sigma_limit_um: float = DEFAULT_SIGMA_LIMIT_UM
    rms_px: float = 0.0
    extent_um: Array = field(default_factory=lambda: np.zeros(3))
    points: int = 0
    camera_id: str = ""
    lens_id: str = ""

    def __post_init__(self) -> None:
        shapes: dict[str, tuple[int, ...]] = {
            "matrix_px_per_um": (2, 3),
            "centre_um": (3,),
            "centre_px": (2,),
            "covariance": (8, 8),
            "extent_um": (3,),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, finite_array(name, getattr(self, name), shape))
        object.__setattr__(self, "work_volume_um", _work_volume(self.work_volume_um))
        require_positive(sigma_limit_um=self.sigma_limit_um)
        require_finite(rms_px=self.rms_px)
        singular = np.linalg.svd(self.matrix_px_per_um, compute_uv=False)
        if not singular[1] > 1e-6 * singular[0]:
            raise CalibrationError(
                f"the camera matrix {self.matrix_px_per_um.tolist()} maps space onto a line: calibrate again "
                "with points spread over both image axes"
            )
        c = self.covariance
        spread = np.sqrt(np.abs(np.diag(c))) + 1e-30
        # Judged as correlations, since the variances differ by eight orders of magnitude.
        correlation = c / np.outer(spread, spread)
        if not (np.allclose(correlation, correlation.T) and np.linalg.eigvalsh(correlation)[0] >= -1e-9):
            raise CalibrationError(
                "the camera's covariance is not symmetric and positive: calibrate again, it cannot be judged"
            )
        sigma = self.sigma_um()
        if sigma > self.sigma_limit_um:
            raise CalibrationError(
                f"camera {self.camera_id!r} predicts image positions to {sigma:.3g} um over its work volume, "
                f"where at most {self.sigma_limit_um:g} um was wanted: calibrate it again with a pattern "
                "that fills the volume"
            )

    @classmethod
    def exact(
        cls,
        matrix_px_per_um: ArrayLike,
        offset_px: ArrayLike,
        *,
        work_volume_um: ArrayLike = ((-5e3,) * 3, (5e3,) * 3),
        camera_id: str = "",
        lens_id: str = "",
    ) -> AffineCamera:
        """Return a camera known without error: pixel = matrix point + offset."""
        return cls(
            matrix_px_per_um=finite_array("matrix_px_per_um", matrix_px_per_um, (2, 3)),
            centre_um=np.zeros(3),
            centre_px=finite_array("offset_px", offset_px, (2,)),
            covariance=np.zeros((8, 8)),
            work_volume_um=_work_volume(work_volume_um),
            camera_id=camera_id,
            lens_id=lens_id,
        )

    @property
    def offset_px(self) -> Array:
        """Pixel of the world origin: the paper's (q14, q24)."""
        return np.asarray(self.centre_px - self.matrix_px_per_um @ self.centre_um)

    @property
    def scale_px_per_um(self) -> float:
        """Scale across the line of sight, root mean square of its two directions."""
        return float(np.linalg.norm(self.matrix_px_per_um)) / math.sqrt(2)

    @property
    def sight(self) -> Array:
        """Unit vector along the line of sight: the direction this camera cannot see, sign arbitrary."""
        normal = np.cross(*self.matrix_px_per_um)
        return np.asarray(normal / np.linalg.norm(normal))

    def project(self, points_um: ArrayLike) -> Array:
        """Return the pixels (x, y) of world points: (n, 3) gives (n, 2), (3,) gives (2,) (eq. G1)."""
        ndim = np.ndim(points_um)
        points = finite_array("points_um", points_um, (3,) if ndim == 1 else (None, 3))
        return np.asarray((points - self.centre_um) @ self.matrix_px_per_um.T + self.centre_px)

    def pixel_covariance(self, points_um: ArrayLike) -> Array:
        """Return (n, 2, 2): how well the calibration predicts the pixels of (n, 3) world points (eq. G3)."""
        points = finite_array("points_um", points_um, (None, 3))
        jacobian = _pixel_jacobian(points - self.centre_um, 1.0)
        return np.asarray(jacobian @ self.covariance @ jacobian.transpose(0, 2, 1))

    def sigma_um(self, work_volume_um: ArrayLike | None = None) -> float:
        """Return the worst predicted error of a point's image over the volume, at the object (eq. G5)."""
        volume = self.work_volume_um if work_volume_um is None else _work_volume(work_volume_um)
        return _worst_sigma_px(self.covariance, self.centre_um, volume) / self.scale_px_per_um

    def motion_um(self, displacement_px: ArrayLike) -> Array:
        """Return the world (x, y) motion, at constant z, behind image displacements (n, 2)."""
        moved = finite_array("displacement_px", displacement_px, (None, 2))
        return np.asarray(np.linalg.solve(self.matrix_px_per_um[:, :2], moved.T).T)

    def pixel_shape(self) -> PixelShape:
        """Return aspect and skew of the pixels with their errors (eq. G4)."""
        q1, q2 = self.matrix_px_per_um
        n1, n2 = float(np.linalg.norm(q1)), float(np.linalg.norm(q2))
        cosine = float(q1 @ q2) / (n1 * n2)
        aspect = n1 / n2
        d_aspect, d_cosine = np.zeros(8), np.zeros(8)
        d_aspect[0:3], d_aspect[4:7] = aspect * q1 / n1**2, -aspect * q2 / n2**2
        d_cosine[0:3] = q2 / (n1 * n2) - cosine * q1 / n1**2
        d_cosine[4:7] = q1 / (n1 * n2) - cosine * q2 / n2**2
        return PixelShape(
            aspect=aspect,
            aspect_sigma=math.sqrt(max(float(d_aspect @ self.covariance @ d_aspect), 0.0)),
            skew_rad=math.asin(cosine),
            skew_sigma_rad=math.sqrt(
                max(float(d_cosine @ self.covariance @ d_cosine), 0.0) / (1 - cosine**2)
            ),
        )


# ---- calibration ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fit:
    parameters: Array  # (8,): q1, x of the centre, q2, y of the centre
    covariance: Array  # (8, 8)
    determined: bool


def _fit(points: Array, pixels: Array, whitening: Array, centre_um: Array) -> _Fit:
    """Solve eq. G2 by one singular-value factoring, centred and scaled on both sides.

    `whitening` is (n,), 1/sigma, when the noise is the same along both image axes: then the system splits
    into two that share one (n, 4) matrix. Else it is (n, 2, 2), W^T W = inverse covariance, and couples them.
    """
    n = len(points)
    centred = points - centre_um
    point_scale = math.sqrt(float(np.mean(centred**2))) or 1.0
    centre_px = pixels.mean(axis=0)
    pixel_scale = math.sqrt(float(np.mean((pixels - centre_px) ** 2))) or 1.0
    design = np.column_stack([centred / point_scale, np.ones(n)])
    sides = (pixels - centre_px) / pixel_scale
    weights = whitening * pixel_scale
    if weights.ndim == 1:
        u, s, vt = np.linalg.svd(weights[:, None] * design, full_matrices=False)
        rhs = weights[:, None] * sides
    else:
        u, s, vt = np.linalg.svd(
            np.einsum("nab,nc->nabc", weights, design).reshape(2 * n, 8), full_matrices=False
        )
        rhs = np.einsum("nab,nb->na", weights, sides).reshape(2 * n, 1)
    floor = _FLAT * s[0]
    determined = bool(s[-1] > floor)
    s = np.maximum(s, floor)
    solution = vt.T @ ((u.T @ rhs) / s[:, None])
    covariance = (vt.T / s**2) @ vt
    if weights.ndim == 1:
        covariance = np.kron(np.eye(2), covariance)
    unscale = np.tile([pixel_scale / point_scale] * 3 + [pixel_scale], 2)
    parameters = solution.T.ravel() * unscale
    parameters[[3, 7]] += centre_px
    return _Fit(parameters, covariance * np.outer(unscale, unscale), determined)


def _mending_step_um(
    points: Array, whitening: Array, volume_um: Array, limit_px: float, axis: int
) -> float | None:
    """Return the shortest step along a world axis after which a second view of the target meets the gate.

    The predicted error depends on where the points are and not on what was seen, so the answer is exact. Both
    views together count as much as the first alone: the step must mend it, not the mere repetition.
    """
    shared = whitening / math.sqrt(2)

    def passes(step_um: float) -> bool:
        both = np.vstack([points, points + step_um * np.eye(3)[axis]])
        centre = both.mean(axis=0)
        fit = _fit(both, np.zeros((len(both), 2)), np.concatenate([shared, shared]), centre)
        return fit.determined and _worst_sigma_px(fit.covariance, centre, volume_um) <= limit_px

    high = 1.0
    while not passes(high):
        high *= 2
        if high > _FARTHEST_STEP_UM:
            return None
    low = high / 2
    while high - low > 0.005 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if passes(middle) else (middle, high)
    digit = 10.0 ** (math.floor(math.log10(high)) - 1)
    rounded = math.ceil(high / digit) * digit
    return rounded if passes(rounded) else high


def _known_scale(matrix: Array, covariance: Array) -> float:
    """Return the camera's scale from the directions the points determine, px per um.

    A direction they leave open holds noise of any size, which would pass for magnification and open the gate.
    """
    variances, directions = np.linalg.eigh(covariance[0:3, 0:3] + covariance[4:7, 4:7])
    energy = np.sum((matrix @ directions) ** 2, axis=0) - 9 * variances
    return math.sqrt(float(np.sum(np.maximum(energy, 0))) / 2)


def _refusal(
    points: Array, whitening: Array, fit: _Fit, centre: Array, volume: Array, limit_px: float
) -> str:
    """Say which direction the points leave open, and which move mends it."""
    information = fit.covariance[0:3, 0:3] + fit.covariance[4:7, 4:7]
    variances, directions = np.linalg.eigh(information)
    reach = np.abs((_corners(volume) - centre) @ directions).max(axis=0)
    worst = int(np.argmax(variances * reach**2))
    direction = directions[:, worst]
    axis = int(np.argmax(np.abs(direction)))
    direction = direction * np.sign(direction[axis])
    spread = float(np.std((points - centre) @ direction))
    width = math.sqrt(float(np.sum(np.var(points, axis=0))))
    named = f"({', '.join(f'{0.0 if abs(d) < 5e-3 else d:.2f}' for d in direction)})"
    step = _mending_step_um(points, whitening, volume, limit_px, axis)
    move = (
        f"step the target along {_AXES[axis]} by at least {step:.6g} um and image it again"
        if step is not None
        else f"use a target that is larger along {_AXES[axis]}, or more points on it"
    )
    return (
        f"the {len(points)} points spread only {spread:.3g} um along {named} and leave that direction "
        f"{'unconstrained' if spread < 0.01 * width else 'too weakly constrained'}: {move}"
    )


def _whitening(n: int, sigma_px: ArrayLike, covariance_px2: ArrayLike | None) -> Array:
    if covariance_px2 is not None:
        covariance = finite_array("covariance_px2", covariance_px2, (n, 2, 2))
        _require_covariances("covariance_px2", covariance)
        return np.linalg.inv(np.linalg.cholesky(covariance))
    sigma = finite_array("sigma_px", sigma_px, () if np.ndim(sigma_px) == 0 else (n,))
    if not np.all((sigma >= _SMALLEST_SIGMA_PX) & (sigma <= _LARGEST_SIGMA_PX)):
        raise InputError(
            f"sigma_px is {float(np.min(sigma)):g} to {float(np.max(sigma)):g}: noise above 0, of "
            f"{_SMALLEST_SIGMA_PX:g} to {_LARGEST_SIGMA_PX:g} px, was wanted"
        )
    return np.asarray(1 / np.broadcast_to(sigma, n))


def _require_covariances(name: str, covariance: Array) -> None:
    symmetric = np.allclose(covariance, covariance.swapaxes(-1, -2), rtol=1e-6, atol=0)
    values = np.linalg.eigvalsh(covariance) if symmetric else np.zeros((1, 2))
    if not values[..., 0].min() > 0:
        raise InputError(
            f"{name} is not symmetric and positive definite: give the covariance of (x, y) in px^2"
        )
    # Weighing one against the other must not lose all digits of what is seen well.
    if values.max() > _LARGEST_SIGMA_PX**2 or values.min() < _SMALLEST_SIGMA_PX**2:
        raise InputError(
            f"{name} holds variances of {values.min():.3g} to {values.max():.3g} px^2: "
            f"{_SMALLEST_SIGMA_PX**2:g} to {_LARGEST_SIGMA_PX**2:g} was wanted; leave out what was not seen"
        )


def calibrate_camera(
    points_um: ArrayLike,
    pixels_xy: ArrayLike,
    *,
    sigma_px: ArrayLike = DEFAULT_SIGMA_PX,
    covariance_px2: ArrayLike | None = None,
    work_volume_um: ArrayLike | None = None,
    sigma_limit_um: float = DEFAULT_SIGMA_LIMIT_UM,
    camera_id: str = "",
    lens_id: str = "",
) -> AffineCamera:
    """Fit an affine camera to known points, and refuse what they cannot determine.

    Parameters
    ----------
    points_um : (n, 3)
        World positions of the targets, at least 6, not in one plane.
    pixels_xy : (n, 2)
        Where each was seen, (x, y) = (column, row).
    sigma_px
        Noise of each coordinate: one number, or (n,).
    covariance_px2 : (n, 2, 2), optional
        Noise of each point in full; takes the place of `sigma_px`.
    work_volume_um : (2, 3), optional
        Lower and upper corner of the region where positions will be measured. Without it: the cube about the
        points whose side is their longest side.
    sigma_limit_um
        Largest predicted error of a point's image over the work volume, at the object's scale.

    Returns
    -------
    AffineCamera
        Its covariance stands on the stated noise, or on the scatter of the fit where that is larger.

    Raises
    ------
    InputError
        Wrong shapes, NaN, noise beyond 1e-6 to 1e6 px, points or pixels beyond 1e12.
    CalibrationError
        Too few points, or the predicted error over the work volume exceeds `sigma_limit_um`; says which
        direction is unconstrained and which move mends it.

    Source
    ------
    Paper, Eqs 5-7, in the corrected form of docs/maths.md, eqs G2 to G5.
    """
    points = finite_array("points_um", points_um, (None, 3))
    n = len(points)
    pixels = finite_array("pixels_xy", pixels_xy, (n, 2))
    require_positive(sigma_limit_um=sigma_limit_um)
    for name, values in (("points_um", points), ("pixels_xy", pixels)):
        if np.abs(values).max() > _FARTHEST:
            raise InputError(f"{name} reaches {np.abs(values).max():g}: at most {_FARTHEST:g} was wanted")
    if n < MINIMUM_POINTS:
        raise CalibrationError(
            f"{n} points came: at least {MINIMUM_POINTS} were wanted, so that a mismatch shows as residual"
        )
    whitening = _whitening(n, sigma_px, covariance_px2)
    lower, upper = points.min(axis=0), points.max(axis=0)
    if work_volume_um is None:
        half = max(float((upper - lower).max()) / 2, 1.0)
        middle = (lower + upper) / 2
        work_volume_um = np.stack([middle - half, middle + half])
    volume = _work_volume(work_volume_um)

    centre = points.mean(axis=0)
    fit = _fit(points, pixels, whitening, centre)
    q = fit.parameters.reshape(2, 4)
    residual = pixels - ((points - centre) @ q[:, :3].T + q[:, 3])
    whitened = (
        whitening[:, None] * residual if whitening.ndim == 1 else np.einsum("nab,nb->na", whitening, residual)
    )
    # A stage that is worse than the tracker shows here: never report less error than the fit itself has.
    inflation = max(1.0, float(np.sum(whitened**2)) / (2 * n - 8))
    rms_px = math.sqrt(float(np.mean(residual**2)))

    scale = _known_scale(q[:, :3], fit.covariance * inflation)
    if not scale * float((upper - lower).max()) > rms_px:
        raise CalibrationError(
            f"the {n} pixels do not move with the points (they scatter by {rms_px:.3g} px about one place): "
            "check that each pixel belongs to its point"
        )
    limit_px = sigma_limit_um * scale
    stated_px = _worst_sigma_px(fit.covariance, centre, volume)
    predicted_px = stated_px * math.sqrt(inflation)
    if not fit.determined or predicted_px > limit_px:
        if fit.determined and stated_px <= limit_px:
            raise CalibrationError(
                f"the fit misses the pixels by {rms_px:.3g} px rms, {math.sqrt(inflation):.3g} times the "
                f"stated noise, so positions would be wrong by {predicted_px / scale:.3g} um: check that "
                "each pixel belongs to its point and that the stage went where it was sent"
            )
        raise CalibrationError(
            _refusal(points, whitening / math.sqrt(inflation), fit, centre, volume, limit_px)
        )
    return AffineCamera(
        matrix_px_per_um=q[:, :3],
        centre_um=centre,
        centre_px=q[:, 3],
        covariance=fit.covariance * inflation,
        work_volume_um=volume,
        sigma_limit_um=sigma_limit_um,
        rms_px=rms_px,
        extent_um=upper - lower,
        points=n,
        camera_id=camera_id,
        lens_id=lens_id,
    )


# ---- two cameras ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two calibrated cameras that see depth together; a pair that cannot is refused when it is made.

    Attributes
    ----------
    work_volume_um : (2, 3)
        Where depth is wanted; by default the smallest box around both cameras' own volumes.
    sigma_z_limit_um
        Largest depth error that the calibration alone may cause over the work volume (eq. G9).
    """

    camera_1: AffineCamera
    camera_2: AffineCamera
    work_volume_um: Array | None = None
    sigma_z_limit_um: float = DEFAULT_SIGMA_LIMIT_UM

    def __post_init__(self) -> None:
        require_positive(sigma_z_limit_um=self.sigma_z_limit_um)
        if self.work_volume_um is None:
            volumes = np.stack([self.camera_1.work_volume_um, self.camera_2.work_volume_um])
            object.__setattr__(
                self, "work_volume_um", np.stack([volumes[:, 0].min(axis=0), volumes[:, 1].max(axis=0)])
            )
        object.__setattr__(self, "work_volume_um", _work_volume(self.volume_um))
        if self.angle_rad < REFUSE_ANGLE_RAD:
            raise CalibrationError(
                f"the two lines of sight differ by {math.degrees(self.angle_rad):.3g} deg: depth needs at "
                f"least {math.degrees(REFUSE_ANGLE_RAD):.0f} deg and wants 30 to 45, so tilt camera 2 further"
            )
        sigma = self.sigma_z_um()
        if sigma > self.sigma_z_limit_um:
            extent = max(float(self.camera_1.extent_um[2]), float(self.camera_2.extent_um[2]))
            wanted = extent * sigma / self.sigma_z_limit_um
            raise CalibrationError(
                f"the calibration alone makes depth uncertain by {sigma:.3g} um over the work volume, where "
                f"at most {self.sigma_z_limit_um:g} um was wanted: calibrate both cameras again with the "
                f"target stepped along z over {wanted:.3g} um or more"
            )

    @property
    def volume_um(self) -> Array:
        """The work volume, (2, 3)."""
        assert self.work_volume_um is not None
        return self.work_volume_um

    @cached_property
    def matrix_px_per_um(self) -> Array:
        """The 4 x 3 system of Eq. 8: both cameras' rows."""
        return np.vstack([self.camera_1.matrix_px_per_um, self.camera_2.matrix_px_per_um])

    @cached_property
    def angle_rad(self) -> float:
        """Angle between the lines of sight, 0 to pi/2: a line has no front."""
        a, b = self.camera_1.sight, self.camera_2.sight
        return math.atan2(float(np.linalg.norm(np.cross(a, b))), abs(float(a @ b)))

    @cached_property
    def condition(self) -> float:
        """Condition number of Eq. 8; 1/sin(theta/2) for equal scales (eq. G7)."""
        return float(np.linalg.cond(self.matrix_px_per_um))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What works but badly, in sentences."""
        if self.angle_rad >= WARN_ANGLE_RAD:
            return ()
        factor = math.sqrt(1 + math.cos(self.angle_rad) ** 2) / math.sin(self.angle_rad)
        return (
            f"the lines of sight differ by only {math.degrees(self.angle_rad):.3g} deg, so depth is "
            f"{factor:.2g} times as noisy as position: 30 to 45 deg is recommended",
        )

    @cached_property
    def null_px(self) -> Array:
        """Unit left null vector of Eq. 8, (4,): the one combination of pixels that no point can change."""
        null = np.linalg.svd(self.matrix_px_per_um)[0][:, 3]
        return np.asarray(null * np.sign(null[np.argmax(np.abs(null))]))

    def sigma_z_um(self, work_volume_um: ArrayLike | None = None) -> float:
        """Return the worst depth error over the volume that the calibration alone predicts (eq. G9)."""
        volume = self.volume_um if work_volume_um is None else _work_volume(work_volume_um)
        inverse = np.linalg.pinv(self.matrix_px_per_um)
        pixel = _calibration_covariance(self, _corners(volume), relative=False)
        return math.sqrt(max(float((inverse @ pixel @ inverse.T)[:, 2, 2].max()), 0.0))


@dataclass(frozen=True, eq=False)
class Fix:
    """Measured positions with their errors: arrays carry a leading axis n when several points came.

    Attributes
    ----------
    xyz_um : (3,) or (n, 3)
        Position in the world frame; for `triangulate_relative`, the displacement.
    covariance_um2 : (3, 3) or (n, 3, 3)
        Of that position: feature noise and calibration together.
    residual_px, residual_sigma_px : () or (n,)
        The one redundancy, and its predicted error (eq. G8). Blind to motion along the epipolar line.
    """

    xyz_um: Array
    covariance_um2: Array
    residual_px: Array
    residual_sigma_px: Array

    @property
    def sigma_um(self) -> Array:
        """One-sigma errors of x, y, z."""
        return np.sqrt(np.diagonal(self.covariance_um2, axis1=-2, axis2=-1))

    @property
    def gate_px(self) -> Array:
        """The residual's limit: 5 sigma."""
        return np.asarray(RESIDUAL_GATE_SIGMA * self.residual_sigma_px)

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """Whether both cameras can have seen the same point."""
        return np.asarray(np.abs(self.residual_px) <= self.gate_px)


def _calibration_covariance(rig: StereoRig, at_um: Array, *, relative: bool) -> Array:
    """Return (n, 4, 4): pixel error that the two calibrations cause at points, or between points."""
    covariance = np.zeros((len(at_um), 4, 4))
    for k, camera in enumerate((rig.camera_1, rig.camera_2)):
        offsets = at_um if relative else at_um - camera.centre_um
        jacobian = _pixel_jacobian(offsets, 0.0 if relative else 1.0)
        covariance[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = (
            jacobian @ camera.covariance @ jacobian.transpose(0, 2, 1)
        )
    return covariance


def _feature_covariance(name: str, value: ArrayLike | None, n: int) -> Array:
    if value is None:
        return np.broadcast_to(DEFAULT_SIGMA_PX**2 * np.eye(2), (n, 2, 2))
    covariance = finite_array(name, value, (2, 2) if np.ndim(value) == 2 else (n, 2, 2))
    _require_covariances(name, covariance)
    return np.broadcast_to(covariance, (n, 2, 2))


def _features(name: str, value: ArrayLike, n: int | None) -> Array:
    array = finite_array(name, value, (2,) if np.ndim(value) == 1 else (n, 2))
    return np.atleast_2d(array)


def _solve(rig: StereoRig, pixels: Array, feature: Array, origin_um: Array, *, relative: bool) -> Fix:
    """Weighted least squares of eq. G6 for (n, 4) pixel offsets from where `origin_um` is seen."""
    matrix = rig.matrix_px_per_um
    first = pixels @ np.linalg.pinv(matrix).T
    total = feature + _calibration_covariance(rig, first + origin_um, relative=relative)
    whitener = np.linalg.inv(np.linalg.cholesky(total))
    system = whitener @ matrix
    # The pseudo-inverse of the whitened system keeps half the digits that normal equations lose.
    inverse = np.linalg.pinv(system)
    position = np.einsum("nij,njk,nk->ni", inverse, whitener, pixels) + origin_um
    null = rig.null_px
    return Fix(
        xyz_um=position,
        covariance_um2=inverse @ inverse.transpose(0, 2, 1),
        residual_px=pixels @ null,
        residual_sigma_px=np.sqrt(np.einsum("i,nij,j->n", null, total, null)),
    )


def _first_only(fix: Fix) -> Fix:
    return Fix(fix.xyz_um[0], fix.covariance_um2[0], fix.residual_px[0], fix.residual_sigma_px[0])


def _joint(cov_1: Array, cov_2: Array) -> Array:
    joint = np.zeros((len(cov_1), 4, 4))
    joint[:, :2, :2], joint[:, 2:, 2:] = cov_1, cov_2
    return joint


def triangulate(
    rig: StereoRig,
    xy_1_px: ArrayLike,
    xy_2_px: ArrayLike,
    covariance_1_px2: ArrayLike | None = None,
    covariance_2_px2: ArrayLike | None = None,
) -> Fix:
    """Meet two lines of sight in space, weighing each camera by how well it saw.

    Parameters
    ----------
    xy_1_px, xy_2_px : (2,) or (n, 2)
        The same features in camera 1 and camera 2, (x, y).
    covariance_1_px2, covariance_2_px2 : (2, 2) or (n, 2, 2), optional
        Noise of each feature; 0.1 px where none is given.

    Raises
    ------
    InputError
        Wrong shapes, NaN, a covariance that is not positive definite.

    Source
    ------
    Paper, Eq. 8, weighted: docs/maths.md, eqs G6 and G8.
    """
    first = _features("xy_1_px", xy_1_px, None)
    second = _features("xy_2_px", xy_2_px, len(first))
    if np.ndim(xy_1_px) != np.ndim(xy_2_px):
        raise InputError(
            f"xy_1_px is {np.shape(xy_1_px)} and xy_2_px is {np.shape(xy_2_px)}: give both the same shape"
        )
    origin = rig.camera_1.centre_um
    seen = np.concatenate([rig.camera_1.project(origin), rig.camera_2.project(origin)])
    feature = _joint(
        _feature_covariance("covariance_1_px2", covariance_1_px2, len(first)),
        _feature_covariance("covariance_2_px2", covariance_2_px2, len(first)),
    )
    fix = _solve(rig, np.hstack([first, second]) - seen, feature, origin, relative=False)
    return _first_only(fix) if np.ndim(xy_1_px) == 1 else fix


def triangulate_relative(
    rig: StereoRig,
    from_1_px: ArrayLike,
    from_2_px: ArrayLike,
    to_1_px: ArrayLike,
    to_2_px: ArrayLike,
    covariance_1_px2: ArrayLike | None = None,
    covariance_2_px2: ArrayLike | None = None,
) -> Fix:
    """Return the displacement between two features seen by the same cameras.

    What the calibration gets wrong is common to both, so its share of the error vanishes as they meet: dock
    by this, not by two absolute depths (eq. G10). The covariances are those of the pixel differences, the sum
    of both features' own; 2 x 0.1^2 px^2 where none is given.

    Raises
    ------
    InputError
        As for `triangulate`.
    """
    pairs = {"from_1_px": from_1_px, "from_2_px": from_2_px, "to_1_px": to_1_px, "to_2_px": to_2_px}
    n = len(_features("from_1_px", from_1_px, None))
    if len({np.ndim(value) for value in pairs.values()}) != 1:
        raise InputError(
            f"the four features have shapes {', '.join(str(np.shape(v)) for v in pairs.values())}: "
            "give all the same shape"
        )
    a1, a2, b1, b2 = (_features(name, value, n) for name, value in pairs.items())
    feature = _joint(
        _feature_covariance("covariance_1_px2", covariance_1_px2, n) * (2 if covariance_1_px2 is None else 1),
        _feature_covariance("covariance_2_px2", covariance_2_px2, n) * (2 if covariance_2_px2 is None else 1),
    )
    fix = _solve(rig, np.hstack([b1 - a1, b2 - a2]), feature, np.zeros(3), relative=True)
    return _first_only(fix) if np.ndim(from_1_px) == 1 else fix
