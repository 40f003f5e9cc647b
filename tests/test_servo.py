"""Servo laws, limits and whole steps: the laws of docs/maths.md, section 7."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from adof_cl.errors import AdofError, CalibrationError, InputError, LimitError, TrackingError
from adof_cl.servo import (
    QUARTER_TURN,
    ServoLaw,
    StageAxes,
    StageAxis,
    StageMove,
    StageQuantiser,
    TaskError,
    VelocityCommand,
    damped_pseudo_inverse,
    gain_from_delay,
    image_jacobian,
    jog_test,
    require_stable_gain,
    rotation_sigma_rad,
    samples_late,
    saturate,
    stability_limit_per_s,
)
from adof_cl.stereo import AffineCamera

Array = NDArray[np.float64]

SCALE = 1 / 7.4  # px per um at 1x
PERIOD_S = 0.1
DELAY_S = 0.1  # the paper's serial loop: one sample late
FEATURES_UM = np.array([[-325.0, -250.0], [325.0, 250.0]])  # two corners of the hole, from its middle

COARSE = StageAxes(
    x=StageAxis("um", 3.0, 2000.0),
    y=StageAxis("um", 3.0, 2000.0),
    theta=StageAxis("rad", 32e-6, 1.0, dead_band=4e-3),
    z=StageAxis("um", 0.03, 2000.0),
)


def turn(angle_rad: float) -> Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def camera(
    block: Any = ((SCALE, 0), (0, SCALE)), walk_px_per_um: tuple[float, float] = (0.0, 0.0)
) -> AffineCamera:
    return AffineCamera.exact(np.column_stack([block, walk_px_per_um]), (256, 200))


def law(eye: AffineCamera | None = None, axes: StageAxes = COARSE, **options: Any) -> ServoLaw:
    made = ServoLaw.from_delay(eye or camera(), axes, DELAY_S, PERIOD_S)
    return replace(made, **options)


class Part:
    """A part on x, y, theta, z stages, its rotation axis riding on x and y."""

    def __init__(
        self, state: tuple[float, float, float, float], axis_um: tuple[float, float] = (0, 0)
    ) -> None:
        self.state = np.array(state, dtype=float)
        self.axis_um = np.array(axis_um, dtype=float)

    def corners_um(self) -> Array:
        x, y, theta, z = self.state
        xy = (FEATURES_UM - self.axis_um) @ turn(theta).T + self.axis_um + [x, y]
        return np.column_stack([xy, np.full(len(xy), z)])

    def centre_um(self, error_um: tuple[float, float] = (0, 0)) -> Array:
        return np.array([*(self.axis_um + self.state[:2] + error_um), self.state[3]])


HOME = Part((0, 0, 0, 0)).corners_um()


def close_the_loop(
    servo: ServoLaw,
    part: Part,
    iterations: int,
    *,
    eye: AffineCamera | None = None,
    late: int = 1,
    noise_px: float = 0.0,
    centre_error_um: tuple[float, float] = (0, 0),
    quantiser: StageQuantiser | None = None,
    seed: int = 0,
) -> Array:
    """Return the (iterations, 4) states of a part brought home by the law, `late` samples late."""
    eye = eye or camera()
    rng = np.random.default_rng(seed)
    past = [part.state.copy()] * (late + 1)
    history = []
    for _ in range(iterations):
        now, part.state = part.state, past[0]
        features = eye.project(part.corners_um()) + rng.normal(0, noise_px, (2, 2))
        centre, depth = part.centre_um(centre_error_um), -part.state[3]
        part.state = now
        error = servo.error(features, eye.project(HOME), centre, depth)
        if quantiser is None:
            part.state = part.state + servo.command(error).array * PERIOD_S
        else:
            command = servo.command(error, quantiser.wake(error))
            part.state = part.state + quantiser.move(command, PERIOD_S).array
        past = [*past[1:], part.state.copy()]
        history.append(part.state.copy())
    return np.array(history)


# ---- image Jacobian ---------------------------------------------------------------------------------------

blocks = st.tuples(
    st.floats(0, 2 * math.pi), st.floats(0.5, 2), st.floats(0.5, 2), st.floats(-0.5, 0.5), st.booleans()
).map(
    lambda p: (
        SCALE * turn(p[0]) @ np.array([[p[1], p[3]], [0, -p[2] if p[4] else p[2]]])
    )  # any rotation, aspect, skew and handedness
)


@given(block=blocks, axis=st.integers(0, 3), cx=st.floats(-3e3, 3e3), cy=st.floats(-3e3, 3e3))
def test_the_jacobian_is_the_derivative_of_what_the_camera_sees(
    block: Array, axis: int, cx: float, cy: float
) -> None:
    eye = camera(block, (0.01, -0.02))
    part = Part((10, 20, 0.1, 500), (cx, cy))
    jacobian = image_jacobian(eye, eye.project(part.corners_um()), part.centre_um())
    step = np.array([1e-2, 1e-2, 1e-5, 1e-2])[axis]
    seen = []
    for sign in (1, -1):
        moved = Part(tuple(part.state + sign * step * np.eye(4)[axis]), (cx, cy))
        seen.append(eye.project(moved.corners_um()).ravel())
    numeric = (seen[0] - seen[1]) / (2 * step)
    # Central differences: third derivative times step^2 / 6, and the rounding of pixels of some hundreds.
    np.testing.assert_allclose(jacobian[:, axis], numeric, rtol=1e-6, atol=1e-6)


def printed_column(places_px: Array) -> Array:
    """The paper's (-v', u')."""
    return np.asarray(places_px @ QUARTER_TURN.T)


def column_error(block: Array) -> float:
    """Relative error of the paper's rotation column, rms over all directions."""
    circle = np.array([[math.cos(a), math.sin(a)] for a in np.linspace(0, 2 * math.pi, 360, endpoint=False)])
    true = image_jacobian(camera(block), 256 * circle + [256, 200], (0, 0, 0))[:, 2].reshape(-1, 2)
    return float(np.linalg.norm(printed_column(256 * circle) - true) / np.linalg.norm(true))


def skewed(angle_deg: float) -> Array:
    """The paper's own block for pixel axes `90 - angle` apart: f_u = -k / tan, f_v = k / sin."""
    theta = math.radians(90 - angle_deg)
    return SCALE * np.array([[1, -1 / math.tan(theta)], [0, 1 / math.sin(theta)]])


@pytest.mark.parametrize(
    ("block", "stated"),
    [
        (SCALE * np.diag([1.1, 1]), 0.097),
        (skewed(1), 0.017),
        (skewed(5), 0.084),
    ],
)
def test_the_printed_rotation_column_is_wrong_by_what_the_note_measured(block: Array, stated: float) -> None:
    # The note measured one pair of features, this averages over directions: they agree to a twentieth.
    assert column_error(block) == pytest.approx(stated, rel=0.05)


@given(angle=st.floats(0, 2 * math.pi))
def test_the_printed_rotation_column_holds_for_a_scaled_rotation(angle: float) -> None:
    assert column_error(SCALE * turn(angle)) < 1e-12


def test_an_image_with_v_down_flips_the_sign_of_the_rotation_column() -> None:
    eye = camera(SCALE * np.diag([1.0, -1.0]))
    features = eye.project(HOME)
    true = image_jacobian(eye, features, (0, 0, 0))[:, 2].reshape(2, 2)
    np.testing.assert_allclose(true, -printed_column(features - [256, 200]), rtol=1e-12)


def test_with_v_down_the_printed_law_turns_away_and_ours_home() -> None:
    eye = camera(SCALE * np.diag([1.0, -1.0]))
    part = Part((0, 0, 0.05, 0))
    error = law(eye).error(eye.project(part.corners_um()), eye.project(HOME), part.centre_um(), 0.0)
    assert error.theta_rad == pytest.approx(-0.05, rel=0.01)
    history = close_the_loop(law(eye), part, 60, eye=eye)
    assert abs(history[-1, 2]) < 1e-5


# ---- the law ----------------------------------------------------------------------------------------------


@given(
    block=blocks,
    x=st.floats(-300, 300),
    y=st.floats(-300, 300),
    theta=st.floats(-0.09, 0.09),
    z=st.floats(0, 4000),
    axis=st.tuples(st.floats(-5e3, 5e3), st.floats(-5e3, 5e3)),
)
def test_every_start_of_the_task_comes_home(
    block: Array, x: float, y: float, theta: float, z: float, axis: tuple[float, float]
) -> None:
    eye = camera(block, (0.001, -0.0005))
    part = Part((x, y, theta, z), axis)
    history = close_the_loop(law(eye), part, 120, eye=eye)
    # The double root at 0.5 shrinks an error beyond rounding in 120 samples; z runs at its speed limit first.
    np.testing.assert_allclose(history[-1], 0, atol=1e-3)


def test_a_misaligned_z_axis_is_fed_forward() -> None:
    # 0.5 deg of misalignment walks 35 um over 4 mm.
    slope = math.tan(math.radians(0.5))
    eye = camera(walk_px_per_um=(SCALE * slope, 0.0))
    part = Part((0, 0, 0, 2000.0))
    part.state[0] = -slope * 2000  # aligned in the image at the start
    middle = []
    servo = law(eye)
    for _ in range(40):
        features = eye.project(part.corners_um())
        command = servo.step(features, eye.project(HOME), part.centre_um(), -part.state[3])
        part.state = part.state + command.array * PERIOD_S
        middle.append(abs(features.mean(axis=0)[0] - 256) / SCALE)
    assert max(middle) < 1e-6
    assert abs(part.state[3]) < 1


@given(
    error_um=st.tuples(st.floats(-2e4, 2e4), st.floats(-2e4, 2e4)),
    block=blocks,
    theta=st.floats(-1, 1),
)
def test_a_wrong_rotation_centre_leaves_every_eigenvalue_1(
    error_um: tuple[float, float], block: Array, theta: float
) -> None:
    eye = camera(block)
    part = Part((30, -20, theta, 0))
    features = eye.project(part.corners_um())
    unit = np.array([1, 1, 1 / 325])
    true = image_jacobian(eye, features, part.centre_um())[:, :3] * unit
    believed = image_jacobian(eye, features, part.centre_um(error_um))[:, :3] * unit
    product = np.linalg.pinv(believed) @ true
    # A triple eigenvalue in one chain: perturbing by eps moves it by a root of eps, so judge the polynomial
    # (z - 1)^3 = z^3 - 3 z^2 + 3 z - 1 that has it.
    scale = np.linalg.norm(product) ** 2
    np.testing.assert_allclose(np.poly(product), [1, -3, 3, -1], atol=1e-6 + 1e-12 * scale)


def test_a_rotation_centre_wrong_by_2_mm_gives_eigenvalues_within_a_millionth() -> None:
    eye, part = camera(), Part((0, 0, 0.5, 0))
    features = eye.project(part.corners_um())
    unit = np.array([1, 1, 1 / 325])
    product = np.linalg.pinv(image_jacobian(eye, features, part.centre_um((2000, 0)))[:, :3] * unit) @ (
        image_jacobian(eye, features, part.centre_um())[:, :3] * unit
    )
    assert np.abs(np.linalg.eigvals(product) - 1).max() < 1e-6


def test_a_rotation_centre_wrong_by_2_mm_costs_excursion_within_the_soft_limit() -> None:
    peaks = []
    for error in ((0.0, 0.0), (2000.0, 0.0)):
        part = Part((500, -500, math.radians(30), 0))
        history = close_the_loop(law(), part, 150, centre_error_um=error)
        np.testing.assert_allclose(history[-1, :3], 0, atol=1e-3)
        peaks.append(np.hypot(history[:, 0], history[:, 1]).max())
    assert peaks[0] <= 708  # the start itself
    assert peaks[0] < peaks[1] < 1500


def test_a_rotated_estimate_of_the_camera_lowers_the_gain_limit() -> None:
    features = camera().project(HOME)
    unit = np.array([1, 1, 1 / 325])
    for angle_deg, stated in ((0, 1.0), (30, 0.68), (60, 0.35), (90, 0.0)):
        eye = camera(SCALE * turn(math.radians(angle_deg)))
        product = np.linalg.pinv(image_jacobian(camera(), features, (0, 0, 0))[:, :3] * unit) @ (
            image_jacobian(eye, eye.project(HOME), (0, 0, 0))[:, :3] * unit
        )
        slowest = np.linalg.eigvals(product[:2, :2])[0]

        def radius(gain: float, factor: complex = slowest) -> float:
            return float(np.abs(np.roots([1, -1, gain * factor])).max())

        gains = np.arange(0.005, 1.2, 0.005)
        unstable = [g for g in gains if radius(float(g)) > 1 + 1e-9]
        assert unstable[0] == pytest.approx(stated, abs=0.015)


def test_features_of_another_shape_leave_a_residual_and_no_command() -> None:
    eye = camera()
    features = eye.project(HOME)
    wider = (features - [256, 200]) * 1.1 + [256, 200]
    error = law().error(features, wider, (0, 0, 0), 0.0)
    np.testing.assert_allclose(error.array, 0, atol=1e-9)
    assert error.residual_px == pytest.approx(math.sqrt(np.mean((wider - features) ** 2)))


def test_one_feature_left_servoes_translation_alone() -> None:
    eye = camera()
    error = law().error(eye.project(HOME[:1]), eye.project(HOME[:1] + np.array([10, -5, 0])), (0, 0, 0), 0.0)
    assert error.rotation_dropped
    np.testing.assert_allclose(error.array, [10, -5, 0, 0], atol=1e-9)


@given(axis=st.tuples(st.floats(-2e4, 2e4), st.floats(-2e4, 2e4)), theta=st.floats(-0.1, 0.1))
def test_a_rotation_at_rest_leaves_x_and_y_right_wherever_its_centre_is(
    axis: tuple[float, float], theta: float
) -> None:
    part = Part((0, 0, theta, 0), axis)
    eye = camera()
    servo = law()
    error = servo.error(eye.project(part.corners_um()), eye.project(HOME), part.centre_um(), 0.0)
    command = servo.command(error, (True, True, False, True))
    assert command.omega_rad_per_s == 0
    middle = part.corners_um().mean(axis=0)[:2]
    wanted = -servo.gain_per_s * middle
    limit = COARSE.speed_limits[0]
    wanted = wanted / max(1.0, np.abs(wanted).max() / limit)
    np.testing.assert_allclose(command.array[:2], wanted, atol=1e-6)


# ---- coincident features and damping ----------------------------------------------------------------------


def rotation_noise(baseline_um: float, damping: float, draws: int = 2000) -> tuple[float, float]:
    """Return rms of commanded rotation and the share of an x error that is commanded, at 0.1 px of noise."""
    eye = camera()
    servo = law(eye, damping=damping, rotation_sigma_limit_rad=10.0)
    pair = np.array([[-baseline_um / 2, 0, 0], [baseline_um / 2, 0, 0]])
    rng = np.random.default_rng(1)
    home = eye.project(pair)
    noise = rng.normal(0, 0.1, (draws, 2, 2))
    # Small against the baseline, so that no draw is taken for a swap of the features.
    errors = [servo.error(home + 1e-3 * n, home, (0, 0, 0), 0.0).theta_rad * 1e3 for n in noise]
    share = -servo.error(home + np.array([SCALE, 0]), home, (0, 0, 0), 0.0).x_um
    return float(np.sqrt(np.mean(np.square(errors)))), share


def test_bearing_noise_is_root_2_sigma_over_the_baseline() -> None:
    assert rotation_sigma_rad(650, 0.74) == pytest.approx(1.6e-3, rel=0.02)
    assert rotation_sigma_rad(20, 0.74) == pytest.approx(52e-3, rel=0.02)
    measured, _ = rotation_noise(650, 1e-9)
    assert measured == pytest.approx(rotation_sigma_rad(650, 0.74), rel=4 / math.sqrt(2 * 2000))


def test_damping_bounds_the_rotation_of_coincident_features_and_keeps_x_and_y() -> None:
    wild, _ = rotation_noise(20, 1e-9)
    tame, share = rotation_noise(20, 0.1)
    assert wild == pytest.approx(5e-2, rel=0.1)
    assert tame < 5e-3
    assert share > 0.99


def test_features_too_close_to_tell_rotation_drop_it_by_rule() -> None:
    eye = camera()
    servo = law(eye)
    for baseline, dropped in ((40.0, True), (60.0, False)):  # sqrt(2) 0.74 um / 0.02 rad = 52 um
        pair = np.array([[-baseline / 2, 0, 0], [baseline / 2, 0, 0]])
        error = servo.error(eye.project(pair), eye.project(pair + np.array([5, 0, 0])), (0, 0, 0), 0.0)
        assert error.rotation_dropped is dropped
        assert error.x_um == pytest.approx(5, rel=0.01)
    same = eye.project([[0.0, 0, 0], [0, 0, 0]])
    assert law().error(same, same, (0, 0, 0), 0.0).rotation_dropped


@given(
    singular=st.lists(st.floats(1e-6, 10), min_size=3, max_size=3),
    seed=st.integers(0, 100),
    damping=st.floats(0.01, 1),
)
def test_damping_acts_on_weak_directions_only(singular: list[float], seed: int, damping: float) -> None:
    rng = np.random.default_rng(seed)
    u = np.linalg.qr(rng.normal(size=(4, 3)))[0]
    v = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    inverse = damped_pseudo_inverse(u @ np.diag(singular) @ v.T, 1.0, damping)
    gains = np.diag(v.T @ inverse @ u)
    for s, gain in zip(singular, gains, strict=True):
        if s >= 1:
            assert gain == pytest.approx(1 / s, rel=1e-9)
        else:
            assert 0 <= gain <= min(1 / s, 1.01 / damping + 1) * (1 + 1e-6)


def test_damping_of_a_singular_matrix_is_zero_in_its_null_direction() -> None:
    np.testing.assert_allclose(damped_pseudo_inverse(np.diag([2.0, 0.0]), 1.0), np.diag([0.5, 0.0]))


# ---- gain from delay --------------------------------------------------------------------------------------


def dominant(gain: float, late: int) -> complex:
    polynomial = np.zeros(late + 2)
    polynomial[0], polynomial[1] = 1, -1
    polynomial[-1] += gain
    roots = np.roots(polynomial)
    return complex(roots[np.argmax(np.abs(roots))])


@pytest.mark.parametrize("late", range(8))
def test_the_delay_limits_are_where_the_roots_say(late: int) -> None:
    delay = late * PERIOD_S
    limit = stability_limit_per_s(delay, PERIOD_S) * PERIOD_S
    assert abs(dominant(limit, late)) == pytest.approx(1, abs=1e-3)
    assert abs(dominant(limit * 0.999, late)) < 1 < abs(dominant(limit * 1.001, late))
    fastest = gain_from_delay(delay, PERIOD_S) * PERIOD_S
    # Just below, the slowest mode is real: no overshoot. Just above, it is a complex pair.
    assert abs(dominant(fastest * 0.999, late).imag) < 1e-9
    if late:
        assert abs(dominant(fastest * 1.001, late).imag) > 1e-3 * fastest


@pytest.mark.parametrize("late", range(8))
def test_the_fastest_gain_never_overshoots(late: int) -> None:
    gain = gain_from_delay(late * PERIOD_S, PERIOD_S) * PERIOD_S
    errors = [1.0] * (late + 1)
    for _ in range(60 * (late + 1)):
        errors.append(errors[-1] - gain * errors[-1 - late])
    assert min(errors) >= -1e-12
    assert errors[-1] < 1e-6


@pytest.mark.parametrize(
    ("delay_s", "period_s", "late", "limit", "fastest"),
    [
        (0.1, 0.1, 1, 10, 2.5),
        (0.2, 0.1, 2, 6.2, 1.5),
        (0.1, 1 / 60, 6, 14.5, 3.4),
        (1 / 60, 1 / 60, 1, 60, 15),
    ],
)
def test_the_notes_table_of_delays(
    delay_s: float, period_s: float, late: int, limit: float, fastest: float
) -> None:
    assert samples_late(delay_s, period_s) == late
    assert stability_limit_per_s(delay_s, period_s) == pytest.approx(limit, rel=0.02)
    assert gain_from_delay(delay_s, period_s) == pytest.approx(fastest, rel=0.02)


def test_a_delay_between_two_samples_counts_as_the_later() -> None:
    assert [samples_late(delay, 0.1) for delay in (0.0, 0.01, 0.1, 0.11, 0.3)] == [0, 1, 1, 2, 3]


@given(delay_s=st.floats(0, 5), period_s=st.floats(0.005, 1))
def test_the_fastest_gain_is_always_one_the_law_accepts(delay_s: float, period_s: float) -> None:
    require_stable_gain(gain_from_delay(delay_s, period_s), delay_s, period_s)


@given(late=st.integers(5, 60))
def test_with_many_samples_of_delay_the_gain_follows_the_continuous_rule(late: int) -> None:
    delay = late * PERIOD_S
    # (d/(d+1))^d/(d+1) tends to 1/(e (d + 1/2)): between delays of d and d + 1 samples.
    assert 1 / (math.e * (delay + PERIOD_S)) < gain_from_delay(delay, PERIOD_S) < 1 / (math.e * delay)


def test_a_gain_above_half_the_limit_is_refused() -> None:
    law(gain_per_s=4.99)
    with pytest.raises(LimitError, match=r"use 2\.5 /s"):
        law(gain_per_s=5.01)
    with pytest.raises(LimitError, match="half the stability limit"):
        law(depth_gain_per_s=6.0)


def test_gains_shrink_with_the_measured_delay() -> None:
    slower = law().retimed(0.3, PERIOD_S)
    assert slower.gain_per_s == pytest.approx(gain_from_delay(0.3, PERIOD_S))
    assert slower.depth_gain_per_s == pytest.approx(slower.gain_per_s)


# ---- saturation -------------------------------------------------------------------------------------------


@given(
    velocities=st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3),
    limits=st.lists(st.floats(1e-3, 1e3), min_size=3, max_size=3),
)
def test_saturation_keeps_the_direction_and_every_limit(velocities: list[float], limits: list[float]) -> None:
    given_v, most = np.array(velocities), np.array(limits)
    safe = saturate(given_v, most)
    assert np.all(np.abs(safe) <= most)
    factor = max(1.0, float((np.abs(given_v) / most).max()))
    np.testing.assert_allclose(safe * factor, given_v, rtol=1e-12, atol=1e-300)


@given(
    x=st.floats(-1e6, 1e6),
    y=st.floats(-1e6, 1e6),
    theta=st.floats(-1.5, 1.5),
    z=st.floats(-1e6, 1e6),
    axis=st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5)),
)
def test_no_command_is_ever_beyond_a_limit(
    x: float, y: float, theta: float, z: float, axis: tuple[float, float]
) -> None:
    part, eye = Part((x, y, theta, z), axis), camera(walk_px_per_um=(0.002, 0.001))
    command = law(eye).step(eye.project(part.corners_um()), eye.project(HOME), part.centre_um(), -z)
    assert np.all(np.abs(command.array) <= COARSE.speed_limits)


# ---- whole steps ------------------------------------------------------------------------------------------


@given(
    velocities=st.lists(st.floats(-2000, 2000), min_size=1, max_size=40),
    dt_s=st.floats(0.001, 1),
)
def test_no_motion_is_ever_lost_to_quantising(velocities: list[float], dt_s: float) -> None:
    quantiser = StageQuantiser(COARSE)
    moved = np.zeros(4)
    for v in velocities:
        move = quantiser.move(VelocityCommand(v, -v, v / 1e4, v / 10), dt_s)
        moved += move.array
        for axis, distance in zip(COARSE.all, move.array, strict=True):
            steps = distance / axis.resolution
            assert abs(steps - round(steps)) <= 1e-9 * max(1, abs(steps))
    asked = sum(velocities) * dt_s * np.array([1, -1, 1e-4, 0.1])
    resolution = np.array([axis.resolution for axis in COARSE.all])
    rounding = 1e-9 * (1 + np.abs(asked) + 2000 * len(velocities) * dt_s)
    assert np.all(np.abs(asked - moved) < resolution + rounding)
    np.testing.assert_allclose(quantiser.remainder, asked - moved, atol=rounding.max())


def test_a_third_of_a_step_becomes_a_step_at_the_third_time() -> None:
    quantiser = StageQuantiser(COARSE)
    moves = [quantiser.move(VelocityCommand(10, 0, 0, 0), 0.1).dx_um for _ in range(9)]
    assert moves == [0, 0, 3, 0, 0, 3, 0, 0, 3]


def rest(seed: int, offset_um: float, axes: StageAxes = COARSE, iterations: int = 700) -> Array:
    servo = law(axes=axes, gain_per_s=2.0, depth_gain_per_s=2.0)
    part = Part((400 + offset_um, -100 + offset_um / 2, 0.05, 300))
    return close_the_loop(servo, part, iterations, noise_px=0.1, quantiser=StageQuantiser(axes), seed=seed)


@pytest.mark.parametrize("offset_um", [0.0, 0.7, 1.4, 2.1])
def test_a_3_um_stage_comes_to_rest_on_its_place_without_chatter(offset_um: float) -> None:
    sigma_um = 0.1 / SCALE / math.sqrt(2)  # of the middle of two features
    for seed in range(3):
        history = rest(seed, offset_um)[100:, :2]
        moves = np.count_nonzero(np.diff(history, axis=0))
        scatter = np.sqrt(np.mean((history - history.mean(axis=0)) ** 2, axis=0))
        offset = np.abs(history.mean(axis=0))
        assert moves <= 2  # a minute at 10 Hz, two axes
        assert np.all(scatter < 0.5)
        assert np.all(offset <= COARSE.x.rest + 3 * sigma_um)  # where the dead band may stop it


def test_without_the_remainder_a_3_um_stage_stays_short_for_ever() -> None:
    class Forgetful(StageQuantiser):
        def move(self, command: VelocityCommand, dt_s: float) -> StageMove:
            self._remainder[:] = 0
            return super().move(command, dt_s)

    servo = law(gain_per_s=2.0, depth_gain_per_s=2.0)
    kept = close_the_loop(servo, Part((400.5, 0, 0, 0)), 200, quantiser=StageQuantiser(COARSE))
    dropped = close_the_loop(servo, Part((400.5, 0, 0, 0)), 200, quantiser=Forgetful(COARSE))
    assert abs(kept[-1, 0]) <= 1.5
    assert abs(dropped[-1, 0]) > 9


def test_without_a_dead_band_a_3_um_stage_chatters() -> None:
    bare = replace(
        COARSE,
        x=StageAxis("um", 3.0, 2000.0, dead_band=0.0, hysteresis=0.0),
        y=StageAxis("um", 3.0, 2000.0, dead_band=0.0, hysteresis=0.0),
    )
    assert np.count_nonzero(np.diff(rest(0, 1.4, bare)[100:, :2], axis=0)) > 10


def task_error(**values: float) -> TaskError:
    zero: dict[str, Any] = {"x_um": 0.0, "y_um": 0.0, "theta_rad": 0.0, "z_um": 0.0}
    return TaskError(
        **(zero | values),
        lever_um=(0, 0),
        walk=(0, 0),
        residual_px=0,
        baseline_um=650,
        rotation_dropped=False,
    )


def test_an_axis_rests_inside_its_dead_band_and_wakes_beyond_its_hysteresis() -> None:
    quantiser = StageQuantiser(COARSE)
    awake = [quantiser.wake(task_error(x_um=e))[0] for e in (4, 1.6, 1.5, 2.9, 3.0, 3.1, 1.6, 1.4)]
    assert awake == [True, True, False, False, False, True, True, False]
    assert quantiser.at_rest
    quantiser.reset()
    assert quantiser.awake == (True, True, True, True)


def test_an_axis_that_comes_to_rest_forgets_its_remainder() -> None:
    quantiser = StageQuantiser(COARSE)
    quantiser.move(VelocityCommand(29, 0, 0, 0), 0.1)
    assert quantiser.remainder[0] == pytest.approx(2.9)
    quantiser.wake(task_error(x_um=1.0))
    assert quantiser.remainder[0] == 0


def test_the_quantiser_refuses_what_is_too_fast_and_keeps_nothing_of_it() -> None:
    quantiser = StageQuantiser(COARSE)
    with pytest.raises(LimitError, match="on theta is beyond its limit"):
        quantiser.move(VelocityCommand(1, 1, 1.1, 1), 0.1)
    assert not quantiser.remainder.any()


# ---- refusals ---------------------------------------------------------------------------------------------


@given(place=st.integers(0, 12), poison=st.sampled_from([math.nan, math.inf, -math.inf]))
def test_nothing_that_is_not_finite_reaches_a_command(place: int, poison: float) -> None:
    eye = camera()
    numbers = np.concatenate([eye.project(HOME).ravel(), eye.project(HOME).ravel(), [0, 0, 0], [0, 0]])
    numbers[place if place < 11 else 11] = poison
    with pytest.raises(AdofError, match=r"NaN or infinite|finite number"):
        law().step(numbers[:4].reshape(2, 2), numbers[4:8].reshape(2, 2), numbers[8:11], float(numbers[11]))


@pytest.mark.parametrize("poison", [math.nan, math.inf])
def test_no_command_and_no_move_is_made_of_what_is_not_finite(poison: float) -> None:
    with pytest.raises(InputError, match="omega_rad_per_s"):
        VelocityCommand(0, 0, poison, 0)
    with pytest.raises(InputError, match="dz_um"):
        StageMove(0, 0, 0, poison)
    with pytest.raises(InputError, match="theta_rad"):
        task_error(theta_rad=poison)
    with pytest.raises(InputError, match="NaN or infinite"):
        saturate([1.0, poison], [1, 1])
    with pytest.raises(InputError, match="dt_s"):
        StageQuantiser(COARSE).move(VelocityCommand.zero(), poison)


def test_features_turned_by_more_than_90_degrees_are_refused_as_swapped() -> None:
    eye = camera()
    features = eye.project(HOME)
    with pytest.raises(TrackingError, match=r"180 deg.*swapped"):
        law().error(features[::-1], features, (0, 0, 0), 0.0)
    part = Part((0, 0, math.radians(89), 0))
    assert law().error(eye.project(part.corners_um()), features, (0, 0, 0), 0.0).theta_rad < 0


@pytest.mark.parametrize(
    ("make", "error", "says"),
    [
        (lambda: StageAxis("mm", 1, 1), InputError, "unit"),  # type: ignore[arg-type]  # what is refused
        (lambda: StageAxis("um", 0, 1), InputError, "resolution"),
        (lambda: StageAxis("um", 1, math.inf), InputError, "speed_limit"),
        (lambda: StageAxis("um", 1, 1, dead_band=-1), InputError, "dead_band"),
        (lambda: StageAxis("um", 1, 1, hysteresis=math.nan), InputError, "hysteresis"),
        (lambda: StageAxes(COARSE.x, COARSE.y, COARSE.x, COARSE.z), InputError, "axis theta is in um"),
        (lambda: law(camera([[1, 0], [1, 1e-3]])), CalibrationError, "edge on"),
        (lambda: law(damping=0.0), InputError, "damping"),
        (lambda: law(gain_per_s=math.nan), InputError, "gain_per_s"),
        (lambda: samples_late(-0.1, 0.1), InputError, "delay_s"),
        (lambda: gain_from_delay(0.1, 0), InputError, "period_s"),
        (lambda: saturate([1.0], [0.0]), InputError, "above 0"),
        (lambda: saturate([1.0], [1.0, 2.0]), InputError, "limits"),
        (lambda: damped_pseudo_inverse([1.0], 1.0), InputError, "matrix"),
        (lambda: damped_pseudo_inverse(np.eye(2), 0.0), InputError, "reference"),
        (lambda: image_jacobian(camera(), [1.0, 2.0], (0, 0, 0)), InputError, "features_px"),
        (lambda: law().error([[1.0, 2]], [[1.0, 2], [3, 4]], (0, 0, 0), 0.0), InputError, "desired_px"),
        (lambda: law().error([[1.0, 2]], [[1.0, 2]], (0, 0), 0.0), InputError, "rotation_centre_um"),
        (lambda: rotation_sigma_rad(0, 1), InputError, "baseline_um"),
    ],
)
def test_the_servo_refuses(make: Any, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says) as refusal:
        make()
    assert "\n" not in str(refusal.value)


# ---- jog test ---------------------------------------------------------------------------------------------

JOGS = np.array([[30.0, 0], [0, 30], [-30, 0], [0, -30]])


@given(angle_deg=st.floats(-29.5, 29.5), scale=st.floats(0.6, 1.9), seed=st.integers(0, 50))
def test_a_stage_within_30_degrees_may_be_armed(angle_deg: float, scale: float, seed: int) -> None:
    matrix = scale * turn(math.radians(angle_deg))
    result = jog_test(JOGS, JOGS @ matrix.T + np.random.default_rng(seed).normal(0, 0.01, JOGS.shape))
    np.testing.assert_allclose(result.matrix, matrix, atol=0.01)
    assert result.rotation_rad == pytest.approx(abs(math.radians(angle_deg)), abs=2e-3)


@pytest.mark.parametrize(
    ("matrix", "says"),
    [
        (turn(math.radians(31)), "31 deg aside"),
        (np.diag([1.0, -1.0]), "axis y moved backwards"),
        (np.diag([-1.0, 1.0]), "axis x moved backwards"),
        (np.array([[0.0, 1], [1, 0]]), "90 deg aside"),
        (np.diag([1.0, 0.01]), "axis y moved 0.01 times"),
        (np.diag([25.4, 1.0]), "axis x moved 25.4 times"),
    ],
)
def test_a_stage_that_does_not_go_where_it_is_sent_is_refused(matrix: Array, says: str) -> None:
    with pytest.raises(CalibrationError, match=says):
        jog_test(JOGS, JOGS @ matrix.T)


def test_depth_and_rotation_are_jogged_alone() -> None:
    assert jog_test([[0.01], [-0.01]], [[0.0101], [-0.0099]]).rotation_rad == 0
    with pytest.raises(CalibrationError, match="mirrored"):
        jog_test([[0.01], [-0.01]], [[-0.01], [0.01]])
    three = 20 * np.eye(3)
    with pytest.raises(CalibrationError, match="axis z moved backwards"):
        jog_test(three, three * [1, 1, -1])


@pytest.mark.parametrize(
    ("sent", "seen", "says"),
    [
        ([[1.0, 0], [2, 0]], [[1.0, 0], [2, 0]], "do not span"),
        ([[1.0, 0]], [[1.0, 0]], "do not span"),
        (np.eye(2), np.eye(3), "observed"),
        (np.eye(4), np.eye(4), "1 to 3"),
        (np.eye(2) * np.nan, np.eye(2), "NaN"),
    ],
)
def test_a_jog_that_cannot_tell_is_refused(sent: Any, seen: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        jog_test(sent, seen)
