"""From what is seen to what the stages do: Eqs 9 and 10, made safe.

Laws are pure functions and frozen values; only one small class, `StageQuantiser`, remembers. One iteration:

    error   = law.error(features_px, desired_px, rotation_centre_um, depth_error_um)
    command = law.command(error, quantiser.wake(error))     velocities, saturated
    move    = quantiser.move(command, dt_s)                 whole stage steps, remainder kept

A stage that takes velocities is given `command`, one that takes steps `move`. Nothing that is not finite gets
into either. Equation numbers are those of docs/maths.md, section 7.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adof_cl.errors import CalibrationError, InputError, LimitError, TrackingError
from adof_cl.finite import finite_array
from adof_cl.optics import require_finite, require_positive

Array = NDArray[np.float64]

QUARTER_TURN: Array = np.array([[0.0, -1.0], [1.0, 0.0]])
JOG_LIMIT_RAD = math.radians(30)
_AXES = ("x", "y", "theta", "z")
_MOST_LATE = 1e6  # periods
_LARGEST_RATIO = 1e60  # its square times another's square fits float64


class ServoCamera(Protocol):
    """What the laws need of a camera: an affine map from the stage's frame to pixels."""

    @property
    def matrix_px_per_um(self) -> Array:
        """(2, 3)."""
        ...

    def project(self, points_um: ArrayLike) -> Array:
        """Return pixels (x, y) of world points."""
        ...


# ---- image Jacobian ---------------------------------------------------------------------------------------


def image_jacobian(camera: ServoCamera, features_px: ArrayLike, rotation_centre_um: ArrayLike) -> Array:
    """Return how the features move with the stage: (2 n, 4), columns x, y, theta_z, z (eq. C1).

    Rows are u1, v1, u2, v2, ... The third column is A S A^-1 r' with A the camera's x-y block, S the quarter
    turn and r' the feature's place from the rotation centre's: right for any aspect, skew, rotation and
    handedness, where the paper's (-v', u') holds for square, aligned, right-handed pixels alone.

    Parameters
    ----------
    features_px : (n, 2)
        Where the features are, (x, y).
    rotation_centre_um : (3,)
        A point of the rotation axis at the features' depth.

    Raises
    ------
    InputError
        Wrong shapes or NaN.

    Source
    ------
    Paper, Eq. 9.
    """
    features = finite_array("features_px", features_px, (None, 2))
    centre = finite_array("rotation_centre_um", rotation_centre_um, (3,))
    block = camera.matrix_px_per_um[:, :2]
    turn = block @ QUARTER_TURN @ np.linalg.inv(block)
    jacobian = np.empty((2 * len(features), 4))
    jacobian[:, :2] = np.tile(block, (len(features), 1))
    jacobian[:, 2] = ((features - camera.project(centre)) @ turn.T).ravel()
    jacobian[:, 3] = np.tile(camera.matrix_px_per_um[:, 2], len(features))
    return jacobian


def damped_pseudo_inverse(matrix: ArrayLike, reference: float, damping: float = 0.1) -> Array:
    """Return the pseudo-inverse with weak singular directions damped and strong ones untouched (eq. C3).

    A singular value s below `reference` becomes s / (s^2 + mu^2) with
    mu = damping reference sqrt(1 - (s / reference)^2), continuous at the reference and 0 at s = 0.

    Raises
    ------
    InputError
        Not a finite matrix, a reference or damping not above 0, or numbers beyond 1e60 either way.
    """
    jacobian = finite_array("matrix", matrix, (None, None))
    require_positive(reference=reference, damping=damping)
    largest = max(float(np.abs(jacobian).max()), reference, 1 / reference, damping)
    if largest > _LARGEST_RATIO:
        raise InputError(
            f"matrix, reference or damping reaches {largest:g} or its inverse: at most {_LARGEST_RATIO:g} "
            "was wanted, so choose other units"
        )
    u, s, vt = np.linalg.svd(jacobian, full_matrices=False)
    mu2 = (damping * reference) ** 2 * np.maximum(1 - (s / reference) ** 2, 0)
    return np.asarray((vt.T * (s / (s**2 + mu2))) @ u.T)


def rotation_sigma_rad(baseline_um: float, sigma_um: float) -> float:
    """Return the error of a bearing measured between two features: sqrt(2) sigma / baseline (eq. C4).

    At most pi: then nothing is known of it.
    """
    require_positive(baseline_um=baseline_um, sigma_um=sigma_um)
    return min(math.sqrt(2) * sigma_um / baseline_um, math.pi)


# ---- gain from delay --------------------------------------------------------------------------------------


def samples_late(delay_s: float, period_s: float) -> int:
    """Return d of e[k+1] = e[k] - g e[k-d]: whole periods between exposure and motion, rounded up.

    Raises
    ------
    InputError
        A period not above 0, a delay below 0, or one of more than a million periods.
    """
    require_positive(period_s=period_s)
    if not (math.isfinite(delay_s) and delay_s >= 0):
        raise InputError(f"delay_s is {delay_s}: the measured age of a frame, 0 or more, was wanted")
    late = delay_s / period_s
    if late > _MOST_LATE:
        raise InputError(
            f"delay_s is {delay_s:g} and period_s {period_s:g}: at most {_MOST_LATE:g} periods of delay were "
            "wanted"
        )
    return math.ceil(late - 1e-9)


def stability_limit_per_s(delay_s: float, period_s: float) -> float:
    """Return the gain at which the loop starts to oscillate for ever: 2 sin(pi / (2 (2d+1))) / T (eq. C6)."""
    d = samples_late(delay_s, period_s)
    return 2 * math.sin(math.pi / (2 * (2 * d + 1))) / period_s


def gain_from_delay(delay_s: float, period_s: float) -> float:
    """Return the largest gain that does not overshoot: d^d / (d+1)^(d+1) / T (eq. C7)."""
    d = samples_late(delay_s, period_s)
    return (d / (d + 1)) ** d / (d + 1) / period_s


def require_stable_gain(gain_per_s: float, delay_s: float, period_s: float) -> None:
    """Refuse a gain above half the stability limit of the measured delay.

    Raises
    ------
    LimitError
        Above half the limit; the message names the gain that does not overshoot.
    """
    require_positive(gain_per_s=gain_per_s)
    half = stability_limit_per_s(delay_s, period_s) / 2
    if gain_per_s > half * (1 + 1e-9):
        raise LimitError(
            f"a gain of {gain_per_s:.3g} /s with {delay_s:.3g} s of delay is above half the stability limit, "
            f"{half:.3g} /s: use {gain_from_delay(delay_s, period_s):.3g} /s, the fastest without overshoot"
        )


# ---- stages -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StageAxis:
    """One stage axis; every number is in `unit` or per second of it.

    Attributes
    ----------
    resolution
        Smallest step.
    speed_limit
        Largest speed the law may command.
    dead_band
        Error within which the axis comes to rest; by default half a step. Where vision is the coarser of
        the two (rotation: 1.6 mrad of noise on a 32 urad stage), state about 3 sigma of it.
    hysteresis
        How far beyond the dead band the error must go to wake the axis; by default half a step.
    """

    unit: Literal["um", "rad"]
    resolution: float
    speed_limit: float
    dead_band: float | None = None
    hysteresis: float | None = None

    def __post_init__(self) -> None:
        if self.unit not in ("um", "rad"):
            raise InputError(f"unit is {self.unit!r}: 'um' or 'rad' was wanted")
        require_positive(resolution=self.resolution, speed_limit=self.speed_limit)
        for name in ("dead_band", "hysteresis"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise InputError(f"{name} is {value}: 0 {self.unit} or more was wanted")

    @property
    def rest(self) -> float:
        """Error at or below which the axis goes to rest."""
        return self.resolution / 2 if self.dead_band is None else self.dead_band

    @property
    def wake(self) -> float:
        """Error above which a resting axis moves again."""
        return self.rest + (self.resolution / 2 if self.hysteresis is None else self.hysteresis)


@dataclass(frozen=True)
class StageAxes:
    """The four axes that carry a part: x, y and z in um, theta in rad."""

    x: StageAxis
    y: StageAxis
    theta: StageAxis
    z: StageAxis

    def __post_init__(self) -> None:
        for name, axis in zip(_AXES, self.all, strict=True):
            wanted = "rad" if name == "theta" else "um"
            if axis.unit != wanted:
                raise InputError(f"axis {name} is in {axis.unit}: {wanted} was wanted")

    @property
    def all(self) -> tuple[StageAxis, StageAxis, StageAxis, StageAxis]:
        """In the order of every four numbers here: x, y, theta, z."""
        return (self.x, self.y, self.theta, self.z)

    @property
    def speed_limits(self) -> Array:
        """(4,), um/s and rad/s."""
        return np.array([axis.speed_limit for axis in self.all])


@dataclass(frozen=True)
class VelocityCommand:
    """Velocities of the four stage axes; never made of anything that is not finite."""

    vx_um_per_s: float
    vy_um_per_s: float
    omega_rad_per_s: float
    vz_um_per_s: float

    def __post_init__(self) -> None:
        require_finite(**vars(self))

    @classmethod
    def zero(cls) -> VelocityCommand:
        """Stand still."""
        return cls(0.0, 0.0, 0.0, 0.0)

    @property
    def array(self) -> Array:
        """(4,): x, y, theta, z."""
        return np.array([self.vx_um_per_s, self.vy_um_per_s, self.omega_rad_per_s, self.vz_um_per_s])


@dataclass(frozen=True)
class StageMove:
    """Relative moves of the four stage axes, whole steps of each."""

    dx_um: float
    dy_um: float
    dtheta_rad: float
    dz_um: float

    def __post_init__(self) -> None:
        require_finite(**vars(self))

    @property
    def array(self) -> Array:
        """(4,): x, y, theta, z."""
        return np.array([self.dx_um, self.dy_um, self.dtheta_rad, self.dz_um])


def saturate(velocities: ArrayLike, limits: ArrayLike) -> Array:
    """Return velocities scaled by one factor so that none exceeds its limit: the direction stays (eq. C5).

    Raises
    ------
    InputError
        Another shape, NaN, limits not above 0, or velocities 1e308 times beyond them.
    """
    wanted = finite_array("velocities", velocities, (None,))
    most = finite_array("limits", limits, (len(wanted),))
    if not np.all(most > 0):
        raise InputError(f"limits are {most.tolist()}: speeds above 0 were wanted")
    with np.errstate(over="ignore"):
        excess = float((np.abs(wanted) / most).max())
    if not math.isfinite(excess):
        raise InputError(f"velocities are {wanted.tolist()}, limits {most.tolist()}: too far apart to scale")
    return np.asarray(np.clip(wanted / max(excess, 1.0), -most, most))


# ---- the law ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TaskError:
    """What remains to be done, as motion of the part about the middle of its features (eq. C2).

    About that middle, translation and rotation do not mix: noise in one cannot reach the other, and a
    rotation held by its dead band leaves x and y right.

    Attributes
    ----------
    x_um, y_um, theta_rad, z_um
        Motion wanted; theta is 0 where rotation was dropped.
    lever_um
        How the middle moves per radian of stage rotation, (x, y).
    walk
        How the middle seems to move in x, y per um of stage z, (x, y), dimensionless.
    residual_px
        What no motion can mend, rms per coordinate: the two parts differ in shape, or a feature is wrong.
    baseline_um
        Distance between the features farthest apart.
    rotation_dropped
        The features lie too close together to tell the rotation.
    """

    x_um: float
    y_um: float
    theta_rad: float
    z_um: float
    lever_um: tuple[float, float]
    walk: tuple[float, float]
    residual_px: float
    baseline_um: float
    rotation_dropped: bool

    def __post_init__(self) -> None:
        require_finite(x_um=self.x_um, y_um=self.y_um, theta_rad=self.theta_rad, z_um=self.z_um)
        require_finite(residual_px=self.residual_px, baseline_um=self.baseline_um)
        for name in ("lever_um", "walk"):
            finite_array(name, getattr(self, name), (2,))

    @property
    def array(self) -> Array:
        """(4,): x, y, theta, z."""
        return np.array([self.x_um, self.y_um, self.theta_rad, self.z_um])


Awake = tuple[bool, bool, bool, bool]
ALL_AWAKE: Awake = (True, True, True, True)


@dataclass(frozen=True)
class ServoLaw:
    """Image-based in x, y and theta_z, position-based in z (paper, Eqs 9 and 10).

    Attributes
    ----------
    camera
        The calibrated camera that looks along z.
    axes
        The stage's axes, for their speed limits.
    gain_per_s, depth_gain_per_s
        K_f and k_z. Refused above half the stability limit of the measured delay.
    delay_s, period_s
        Measured: frame time stamp to motion, and time between iterations.
    rotation_length_um
        Half the taught distance between features: makes rotation and translation comparable.
    damping
        Of the weak singular direction, relative to that of translation.
    sigma_px
        Noise of one tracked coordinate.
    rotation_sigma_limit_rad
        Where the features lie so close that the rotation is less certain than this, it is dropped.
    """

    camera: ServoCamera
    axes: StageAxes
    gain_per_s: float
    depth_gain_per_s: float
    delay_s: float
    period_s: float
    rotation_length_um: float = 325.0
    damping: float = 0.1
    sigma_px: float = 0.1
    rotation_sigma_limit_rad: float = 0.02

    def __post_init__(self) -> None:
        require_stable_gain(self.gain_per_s, self.delay_s, self.period_s)
        require_stable_gain(self.depth_gain_per_s, self.delay_s, self.period_s)
        require_positive(
            rotation_length_um=self.rotation_length_um,
            damping=self.damping,
            sigma_px=self.sigma_px,
            rotation_sigma_limit_rad=self.rotation_sigma_limit_rad,
        )
        scales = np.linalg.svd(self.camera.matrix_px_per_um[:, :2], compute_uv=False)
        if not scales[1] > 0.05 * scales[0]:
            raise CalibrationError(
                "the camera sees the stage's x-y plane edge on: servo with the camera that looks along z"
            )

    @classmethod
    def from_delay(
        cls, camera: ServoCamera, axes: StageAxes, delay_s: float, period_s: float, share: float = 1.0
    ) -> ServoLaw:
        """Return the law whose gains are `share` of the fastest without overshoot at the measured delay."""
        gain = share * gain_from_delay(delay_s, period_s)
        return cls(camera, axes, gain, gain, delay_s, period_s)

    def retimed(self, delay_s: float, period_s: float) -> ServoLaw:
        """Return the law at a newly measured delay: its gains shrink with age as their limit does."""
        factor = gain_from_delay(delay_s, period_s) / gain_from_delay(self.delay_s, self.period_s)
        return replace(
            self,
            gain_per_s=self.gain_per_s * factor,
            depth_gain_per_s=self.depth_gain_per_s * factor,
            delay_s=delay_s,
            period_s=period_s,
        )

    def error(
        self,
        features_px: ArrayLike,
        desired_px: ArrayLike,
        rotation_centre_um: ArrayLike,
        depth_error_um: float,
    ) -> TaskError:
        """Return the motion that would bring the features to their places.

        Parameters
        ----------
        features_px, desired_px : (n, 2)
            Where the features are and should be, (x, y); one is enough for translation.
        rotation_centre_um : (3,)
            A point of the rotation axis at the features' depth; it may ride on x and y.
        depth_error_um
            Z still to go: desired less measured, both relative to the other part (`triangulate_relative`).

        Raises
        ------
        InputError
            Wrong shapes, NaN.
        TrackingError
            The features' bearing is more than 90 degrees off, where the law turns the wrong way.
        """
        features = finite_array("features_px", features_px, (None, 2))
        desired = finite_array("desired_px", desired_px, (len(features), 2))
        centre = finite_array("rotation_centre_um", rotation_centre_um, (3,))
        require_finite(depth_error_um=depth_error_um)
        matrix = self.camera.matrix_px_per_um
        block = matrix[:, :2]
        middle = features.mean(axis=0)
        places_um = np.linalg.solve(block, (features - middle).T).T
        wanted_um = np.linalg.solve(block, (desired - desired.mean(axis=0)).T).T
        baseline = 2 * float(np.linalg.norm(places_um, axis=1).max())

        # About the features' middle translation and rotation are orthogonal: rotation is the weak one.
        jacobian = image_jacobian(_Centred(matrix, middle), features, (0.0, 0.0, 0.0))[:, :3]
        jacobian[:, 2] /= self.rotation_length_um
        reference = math.sqrt(len(features)) * float(np.linalg.svd(block, compute_uv=False)[1])
        sigma_um = self.sigma_px * math.sqrt(2) / float(np.linalg.norm(block))
        dropped = (
            baseline == 0 or rotation_sigma_rad(baseline, sigma_um) > self.rotation_sigma_limit_rad
        )  # also when only one feature is left
        if dropped:
            jacobian = jacobian[:, :2]
        elif float(np.sum(places_um * wanted_um)) < 0:
            cosine = float(np.sum(places_um * wanted_um))
            sine = float(np.sum(places_um @ QUARTER_TURN.T * wanted_um))
            raise TrackingError(
                f"the features are turned {math.degrees(math.atan2(sine, cosine)):.0f} deg off their places: "
                "at most 90 was wanted, so check that they are not swapped"
            )
        pixels = (desired - features).ravel()
        motion = damped_pseudo_inverse(jacobian, reference, self.damping) @ pixels
        undamped = np.linalg.lstsq(jacobian, pixels, rcond=None)[0]
        lever = QUARTER_TURN @ np.linalg.solve(block, middle - self.camera.project(centre))
        walk = np.linalg.solve(block, matrix[:, 2])
        return TaskError(
            x_um=float(motion[0]),
            y_um=float(motion[1]),
            theta_rad=0.0 if dropped else float(motion[2]) / self.rotation_length_um,
            z_um=float(depth_error_um),
            lever_um=(float(lever[0]), float(lever[1])),
            walk=(float(walk[0]), float(walk[1])),
            residual_px=math.sqrt(float(np.mean((pixels - jacobian @ undamped) ** 2))),
            baseline_um=baseline,
            rotation_dropped=dropped,
        )

    def command(self, error: TaskError, awake: Awake = ALL_AWAKE) -> VelocityCommand:
        """Return saturated stage velocities; an axis at rest gives none of its own (eqs C2, C5, C8).

        A resting rotation is left out before x and y are made up for it, and the walk of the image with z is
        fed forward from the z velocity that is really commanded.
        """
        limits = self.axes.speed_limits
        own = np.where(awake, error.array, 0.0)
        vz = float(np.clip(self.depth_gain_per_s * own[3], -limits[3], limits[3]))
        omega = self.gain_per_s * own[2]
        lever, walk = np.array(error.lever_um), np.array(error.walk)
        vxy = self.gain_per_s * own[:2] - omega * lever - vz * walk
        vx, vy, omega = saturate([*vxy, omega], limits[:3]).tolist()
        return VelocityCommand(vx, vy, omega, vz)

    def step(
        self,
        features_px: ArrayLike,
        desired_px: ArrayLike,
        rotation_centre_um: ArrayLike,
        depth_error_um: float,
    ) -> VelocityCommand:
        """Return the command for what is seen, with every axis awake: `error` and `command` in one."""
        return self.command(self.error(features_px, desired_px, rotation_centre_um, depth_error_um))


@dataclass(frozen=True)
class _Centred:
    """The same camera with the world's origin where `middle_px` is seen."""

    matrix_px_per_um: Array
    middle_px: Array

    def project(self, points_um: ArrayLike) -> Array:
        return np.asarray(points_um) @ self.matrix_px_per_um.T + self.middle_px


# ---- whole steps ------------------------------------------------------------------------------------------


class StageQuantiser:
    """Whole stage steps from velocities: keeps what is less than a step, rests inside the dead bands.

    With the remainder dropped a stage stays short for ever, without a dead band it chatters. Eq. C9.
    """

    def __init__(self, axes: StageAxes) -> None:
        self._axes = axes
        self._remainder = np.zeros(4)
        self._awake = np.ones(4, dtype=bool)

    @property
    def remainder(self) -> Array:
        """(4,): motion commanded and not yet a whole step; um, um, rad, um."""
        return self._remainder.copy()

    @property
    def awake(self) -> Awake:
        """Which axes are following their error."""
        x, y, theta, z = self._awake.tolist()
        return (x, y, theta, z)

    @property
    def at_rest(self) -> bool:
        """Whether every axis is inside its dead band."""
        return not self._awake.any()

    def reset(self) -> None:
        """Forget remainders and wake every axis: for the start, and after any stop."""
        self._remainder[:] = 0
        self._awake[:] = True

    def wake(self, error: TaskError) -> Awake:
        """Update and return which axes are awake: at rest inside the dead band, up beyond its hysteresis."""
        size = np.abs(error.array)
        rest = np.array([axis.rest for axis in self._axes.all])
        wake = np.array([axis.wake for axis in self._axes.all])
        slept = self._awake & (size <= rest)
        self._awake = np.where(self._awake, size > rest, size > wake)
        # A resting axis forgets: the error it stopped at is the one the dead band accepts.
        self._remainder[slept] = 0
        return self.awake

    def move(self, command: VelocityCommand, dt_s: float) -> StageMove:
        """Return the whole steps that fall due after `dt_s` of a command, and keep the rest.

        Raises
        ------
        InputError
            dt_s is not above 0.
        LimitError
            A velocity beyond its axis's limit; nothing is kept of it.
        """
        require_positive(dt_s=dt_s)
        for name, axis, speed in zip(_AXES, self._axes.all, command.array, strict=True):
            if abs(speed) > axis.speed_limit * (1 + 1e-9):
                raise LimitError(
                    f"{speed:.6g} {axis.unit}/s on {name} is beyond its limit of {axis.speed_limit:.6g}: "
                    "saturate the command first"
                )
        resolution = np.array([axis.resolution for axis in self._axes.all])
        due = self._remainder + command.array * dt_s
        # The tolerance takes sums like 10 x 0.3 steps for the whole 3 they are.
        steps = np.trunc(due / resolution * (1 + 1e-12))
        self._remainder = due - steps * resolution
        return StageMove(*(steps * resolution).tolist())


# ---- jog test ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class JogResult:
    """How the stage was seen to move against how it was told to.

    Attributes
    ----------
    matrix : (k, k)
        observed = matrix commanded.
    rotation_rad
        Largest angle between an axis and where it went.
    """

    matrix: Array
    rotation_rad: float


def jog_test(commanded: ArrayLike, observed: ArrayLike) -> JogResult:
    """Refuse to arm a stage that does not go where it is sent (eq. C10).

    A rotated estimate of camera against stage costs gain up to 30 degrees and turns the loop unstable at
    90; a mirrored axis runs away at any gain.

    Parameters
    ----------
    commanded, observed : (n, k)
        Relative moves sent, and seen, in the same units: k = 1 to 3 of x, y, z. `AffineCamera.motion_um` or
        `triangulate_relative` turn pixels into them. For a rotation give k = 1.

    Raises
    ------
    InputError
        Wrong shapes, NaN, or moves that do not span the axes.
    CalibrationError
        An axis moved backwards, more than 30 degrees aside, less than half or more than twice as far.
    """
    sent = finite_array("commanded", commanded, (None, None))
    n, k = sent.shape
    seen = finite_array("observed", observed, (n, k))
    if k > 3:
        raise InputError(f"the moves have {k} axes: 1 to 3 were wanted")
    singular = np.linalg.svd(sent, compute_uv=False)
    if len(singular) < k or not singular[-1] > 1e-3 * singular[0]:
        raise InputError(f"the {n} moves do not span {k} axes: jog every axis by itself")
    matrix: Array = np.asarray(np.linalg.lstsq(sent, seen, rcond=None)[0].T, dtype=np.float64)
    worst = 0.0
    for axis in range(k):
        went = matrix[:, axis]
        length = float(np.linalg.norm(went))
        name = "xyz"[axis] if k > 1 else "that was jogged"
        aside = float(np.linalg.norm(np.delete(went, axis)))
        angle = math.atan2(aside, float(went[axis]))
        if length < 0.5 or length > 2:
            raise CalibrationError(
                f"axis {name} moved {length:.3g} times as far as it was sent, 0.5 to 2 was wanted: check "
                "its unit, and that it is switched on and free"
            )
        if angle > math.radians(150):
            raise CalibrationError(f"axis {name} moved backwards: it is mirrored, so change its sign")
        if angle > JOG_LIMIT_RAD:
            raise CalibrationError(
                f"axis {name} moved {math.degrees(angle):.0f} deg aside, where at most "
                f"{math.degrees(JOG_LIMIT_RAD):.0f} was wanted: check which axis is which and calibrate again"
            )
        worst = max(worst, angle)
    return JogResult(matrix, worst)
