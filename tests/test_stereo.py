"""Affine cameras and depth: the laws of docs/maths.md, section 6."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from adof_cl.calibration_file import load_camera, load_rig, save_calibration
from adof_cl.errors import CalibrationError, InputError
from adof_cl.stereo import (
    AffineCamera,
    StereoRig,
    calibrate_camera,
    triangulate,
    triangulate_relative,
)

SCALE = 1 / 7.4  # px per um at 1x
NOISE_PX = 0.1
VOLUME = np.array([[-1500.0, -1500.0, 0.0], [1500.0, 1500.0, 4000.0]])
EPS = float(np.finfo(np.float64).eps)


def tilted(angle_rad: float) -> NDArray[np.float64]:
    """Matrix of a camera tilted in the x-z plane."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return SCALE * np.array([[c, 0, -s], [0, 1, 0]])


def plane(z_um: float = 0.0, half_um: float = 1500.0, side: int = 7) -> NDArray[np.float64]:
    axis = np.linspace(-half_um, half_um, side)
    return np.array([(x, y, z_um) for x in axis for y in axis])


def planes(*heights_um: float) -> NDArray[np.float64]:
    return np.vstack([plane(z) for z in heights_um])


def seen(
    points: NDArray[np.float64], matrix: NDArray[np.float64], seed: int = 0, noise_px: float = NOISE_PX
) -> NDArray[np.float64]:
    noise = np.random.default_rng(seed).normal(0, noise_px, (len(points), 2))
    return np.asarray(points @ matrix.T + [256, 200] + noise)


def exact_rig(angle_deg: float) -> StereoRig:
    angle = math.radians(angle_deg)
    return StereoRig(
        AffineCamera.exact(tilted(0), (256, 200), camera_id="one"),
        AffineCamera.exact(tilted(angle), (256, 200), camera_id="two"),
    )


def calibrated_rig(
    points: NDArray[np.float64], angle_deg: float = 30, seed: int = 0, **options: Any
) -> StereoRig:
    angle = math.radians(angle_deg)
    options = {"work_volume_um": VOLUME} | options
    return StereoRig(
        calibrate_camera(points, seen(points, tilted(0), 2 * seed), camera_id="A", lens_id="L1", **options),
        calibrate_camera(
            points, seen(points, tilted(angle), 2 * seed + 1), camera_id="B", lens_id="L2", **options
        ),
    )


FIVE_PLANES = planes(0, 1000, 2000, 3000, 4000)


# ---- calibration ------------------------------------------------------------------------------------------


def test_five_planes_over_4_mm_give_the_depth_error_the_note_states() -> None:
    # Notes: 0.22 um at mid volume; at the volume's far corner the lever arm is about half as much again.
    rig = calibrated_rig(FIVE_PLANES)
    at_axis = rig.sigma_z_um([[-1.0, -1, 0], [1, 1, 4000]])
    assert 0.15 < at_axis < 0.3
    assert at_axis < rig.sigma_z_um() < 0.5


@pytest.mark.parametrize("origin_um", [0.0, 1e4, 1e6])
def test_a_world_origin_a_metre_away_costs_no_accuracy(origin_um: float) -> None:
    points = FIVE_PLANES + origin_um
    camera = calibrate_camera(points, seen(points - origin_um, tilted(0.5), noise_px=0), sigma_px=0.1)
    worst = np.abs(camera.project(points) - seen(points - origin_um, tilted(0.5), noise_px=0)).max()
    # Each coordinate is stored to eps times its size; a few such errors meet in one pixel.
    assert worst <= 20 * EPS * (origin_um + 4000) * SCALE + 1e-11


def test_the_offset_is_the_papers_q14_and_q24() -> None:
    camera = calibrate_camera(FIVE_PLANES, seen(FIVE_PLANES, tilted(0.5), noise_px=0))
    np.testing.assert_allclose(camera.offset_px, [256, 200], atol=1e-9)
    np.testing.assert_allclose(camera.matrix_px_per_um, tilted(0.5), atol=1e-14)


@pytest.mark.parametrize("z_um", [0.0, 500.0])
@pytest.mark.parametrize("volume", [None, VOLUME])
def test_a_plane_is_refused_with_the_direction_and_the_move(z_um: float, volume: Any) -> None:
    points = plane(z_um)
    with pytest.raises(
        CalibrationError, match=r"\(0\.00, 0\.00, 1\.00\).*unconstrained.*step the target along z by"
    ):
        calibrate_camera(points, seen(points, tilted(0.5)), work_volume_um=volume)


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_with_3_um_of_height_jitter_is_refused(seed: int) -> None:
    points = plane() + np.random.default_rng(seed).normal(0, 3, (49, 3)) * [0, 0, 1]
    pixels = seen(points, tilted(0.5), seed)
    assert np.linalg.matrix_rank(np.column_stack([points, np.ones(49)])) == 4  # a rank test lets it pass
    for volume in (None, VOLUME):
        with pytest.raises(CalibrationError, match="step the target along z by at least"):
            calibrate_camera(points, pixels, work_volume_um=volume)


def test_the_naive_pseudo_inverse_answers_wrong_depths_from_a_jittered_plane() -> None:
    points = plane() + np.random.default_rng(1).normal(0, 3, (49, 3)) * [0, 0, 1]
    design = np.column_stack([points, np.ones(49)])
    rows, offsets, residuals = [], [], []
    for seed, angle in ((2, 0.0), (3, math.radians(30))):
        pixels = seen(points, tilted(angle), seed)
        q = np.linalg.pinv(design) @ pixels
        residuals.append(np.std(pixels - design @ q))
        rows.append(q[:3].T)
        offsets.append(q[3])
    target = np.array([0, 0, 4000.0])
    pixels = np.concatenate([tilted(0) @ target, tilted(math.radians(30)) @ target])
    z = (np.linalg.pinv(np.vstack(rows)) @ (pixels + np.array([256, 200] * 2) - np.concatenate(offsets)))[2]
    assert max(residuals) < 1.2 * NOISE_PX  # the fit looks good
    assert abs(z - 4000) > 40  # and is wrong by more than four times the 10 um wanted


def test_two_planes_1_mm_apart_are_accepted() -> None:
    rig = calibrated_rig(planes(0, 1000))
    assert rig.sigma_z_um() < 2


def test_two_planes_a_tenth_of_a_millimetre_apart_are_refused_over_4_mm() -> None:
    with pytest.raises(CalibrationError, match="too weakly constrained: step the target along z by at least"):
        calibrated_rig(planes(0, 100))


@given(
    tilt_deg=st.floats(0, 40),
    turn_deg=st.floats(0, 360),
    camera_deg=st.floats(0, 45),
    jitter_um=st.sampled_from([0.0, 0.3, 3.0]),
)
@example(tilt_deg=0, turn_deg=0, camera_deg=0, jitter_um=0.0)
def test_the_move_that_the_refusal_names_mends_it(
    tilt_deg: float, turn_deg: float, camera_deg: float, jitter_um: float
) -> None:
    a, b = math.radians(tilt_deg), math.radians(turn_deg)
    about_x = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    about_z = np.array([[math.cos(b), -math.sin(b), 0], [math.sin(b), math.cos(b), 0], [0, 0, 1]])
    flat = plane() + np.random.default_rng(5).normal(0, 1, (49, 3)) * [0, 0, jitter_um]
    points = flat @ (about_z @ about_x).T
    matrix = tilted(math.radians(camera_deg))
    with pytest.raises(CalibrationError) as refusal:
        calibrate_camera(points, seen(points, matrix), work_volume_um=VOLUME)
    words = str(refusal.value).split("step the target along ")[1].split()
    step = float(words[4]) * np.eye(3)["xyz".index(words[0])]
    both = np.vstack([points, points + step])
    camera = calibrate_camera(both, seen(both, matrix, 7), work_volume_um=VOLUME)
    assert camera.sigma_um() <= camera.sigma_limit_um


def test_the_stated_covariance_is_the_scatter_of_repeated_calibrations() -> None:
    points, matrix = planes(0, 2000), tilted(0.5)
    cameras = [calibrate_camera(points, seen(points, matrix, s), work_volume_um=VOLUME) for s in range(400)]
    far = np.array([[1500.0, -1500, 4000]])
    spread = np.cov(np.array([c.project(far)[0] for c in cameras]).T)
    stated = np.mean([c.pixel_covariance(far)[0] for c in cameras], axis=0)
    # A variance from 400 draws is known to sqrt(2/400) = 7 %; four of those.
    np.testing.assert_allclose(np.diag(spread), np.diag(stated), rtol=4 * math.sqrt(2 / 400))


def test_a_stage_noisier_than_the_tracker_enlarges_the_stated_error() -> None:
    stage_noise = np.random.default_rng(8).normal(0, 3, FIVE_PLANES.shape)
    pixels = seen(FIVE_PLANES, tilted(0.5), noise_px=0.02)
    exact = calibrate_camera(FIVE_PLANES, pixels, sigma_px=0.02)
    noisy = calibrate_camera(FIVE_PLANES + stage_noise, pixels, sigma_px=0.02)
    # 3 um are 0.41 px, twenty times the stated noise; the two image axes mix three noisy coordinates.
    assert 15 < noisy.sigma_um() / exact.sigma_um() < 25


def test_points_with_less_noise_weigh_more() -> None:
    sigma = np.where(np.arange(len(FIVE_PLANES)) % 2, 0.02, 2.0)
    rng = np.random.default_rng(4)
    pixels = (
        FIVE_PLANES @ tilted(0.5).T + [256, 200] + rng.normal(0, 1, (len(FIVE_PLANES), 2)) * sigma[:, None]
    )
    weighed = calibrate_camera(FIVE_PLANES, pixels, sigma_px=sigma)
    plain = calibrate_camera(FIVE_PLANES, pixels, sigma_px=1.0)
    truth = FIVE_PLANES @ tilted(0.5).T + [256, 200]
    error = [np.abs(c.project(FIVE_PLANES) - truth).max() for c in (weighed, plain)]
    assert error[0] < error[1] / 10


def test_a_full_covariance_per_point_agrees_with_the_scalar_where_they_say_the_same() -> None:
    pixels = seen(FIVE_PLANES, tilted(0.5))
    scalar = calibrate_camera(FIVE_PLANES, pixels, sigma_px=0.3)
    full = calibrate_camera(
        FIVE_PLANES, pixels, covariance_px2=np.broadcast_to(0.09 * np.eye(2), (len(pixels), 2, 2))
    )
    np.testing.assert_allclose(full.matrix_px_per_um, scalar.matrix_px_per_um, rtol=0, atol=1e-13)
    np.testing.assert_allclose(full.covariance, scalar.covariance, rtol=1e-9, atol=1e-20)


def test_square_pixels_pass_their_check_and_stretched_or_skewed_ones_do_not() -> None:
    pixels = seen(FIVE_PLANES, tilted(0.5))
    assert calibrate_camera(FIVE_PLANES, pixels).pixel_shape().square
    stretched = calibrate_camera(FIVE_PLANES, pixels * [1.1, 1.0]).pixel_shape()
    assert not stretched.square
    assert stretched.aspect == pytest.approx(1.1, abs=5 * stretched.aspect_sigma)
    skewed = calibrate_camera(
        FIVE_PLANES, pixels @ np.array([[1, 0], [math.sin(0.02), math.cos(0.02)]])
    ).pixel_shape()
    assert not skewed.square
    assert skewed.skew_rad == pytest.approx(0.02, abs=5 * skewed.skew_sigma_rad)


def test_the_pixel_checks_state_their_own_scatter() -> None:
    shapes = [
        calibrate_camera(FIVE_PLANES, seen(FIVE_PLANES, tilted(0.5), s)).pixel_shape() for s in range(300)
    ]
    tolerance = 4 / math.sqrt(2 * 300)
    assert np.std([s.aspect for s in shapes]) == pytest.approx(shapes[0].aspect_sigma, rel=2 * tolerance)
    assert np.std([s.skew_rad for s in shapes]) == pytest.approx(shapes[0].skew_sigma_rad, rel=2 * tolerance)


def test_mismatched_pixels_are_refused_as_such() -> None:
    pixels = seen(FIVE_PLANES, tilted(0.5))
    with pytest.raises(CalibrationError, match="check that each pixel belongs to its point"):
        calibrate_camera(FIVE_PLANES, np.random.default_rng(0).permutation(pixels), work_volume_um=VOLUME)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"points_um": FIVE_PLANES[:5]}, CalibrationError, "at least 6"),
        ({"points_um": FIVE_PLANES[:, :2]}, InputError, r"points_um is \(245, 2\)"),
        ({"points_um": FIVE_PLANES * np.nan}, InputError, "NaN or infinite"),
        ({"points_um": "points"}, InputError, "real numbers"),
        ({"points_um": [[1.0, 2], [3.0]]}, InputError, "ragged"),
        ({"points_um": FIVE_PLANES * 1j}, InputError, "complex128"),
        ({"pixels_xy": np.zeros((3, 2))}, InputError, "pixels_xy"),
        ({"pixels_xy": np.full((245, 2), np.inf)}, InputError, "NaN or infinite"),
        ({"pixels_xy": np.ones((245, 2))}, CalibrationError, "do not move with the points"),
        ({"points_um": np.ones((245, 3))}, CalibrationError, "do not move with the points"),
        ({"points_um": FIVE_PLANES * [1, 0, 0]}, CalibrationError, "use a target that is larger along"),
        ({"sigma_px": 0.0}, InputError, "noise above 0"),
        ({"sigma_px": np.ones(3)}, InputError, "sigma_px"),
        ({"sigma_limit_um": -1.0}, InputError, "sigma_limit_um"),
        ({"covariance_px2": np.zeros((245, 2, 2))}, InputError, "positive definite"),
        ({"covariance_px2": np.broadcast_to([[1.0, 0.5], [0, 1]], (245, 2, 2))}, InputError, "symmetric"),
        ({"work_volume_um": VOLUME[::-1]}, InputError, "above the first"),
        ({"work_volume_um": [[0, 0, 0], [1, 1, 0]]}, InputError, "above the first"),
    ],
)
def test_calibration_refuses(change: dict[str, Any], error: type[Exception], says: str) -> None:
    points = change.get("points_um", FIVE_PLANES)
    fine: dict[str, Any] = {"points_um": FIVE_PLANES, "pixels_xy": seen(FIVE_PLANES, tilted(0.5))}
    if isinstance(points, np.ndarray) and len(points) == 5:
        fine["pixels_xy"] = fine["pixels_xy"][:5]
    with pytest.raises(error, match=says) as refusal:
        calibrate_camera(**(fine | change))
    assert "\n" not in str(refusal.value)


def test_a_camera_that_maps_space_onto_a_line_is_refused() -> None:
    with pytest.raises(CalibrationError, match="onto a line"):
        AffineCamera.exact([[1, 2, 3], [2, 4, 6]], (0, 0))


def test_a_camera_without_a_real_covariance_is_refused() -> None:
    good = calibrate_camera(FIVE_PLANES, seen(FIVE_PLANES, tilted(0.5)))
    with pytest.raises(CalibrationError, match="symmetric and positive"):
        AffineCamera(
            good.matrix_px_per_um, good.centre_um, good.centre_px, -good.covariance, good.work_volume_um
        )


def test_a_calibrated_camera_cannot_be_changed() -> None:
    camera = AffineCamera.exact(tilted(0), (0, 0))
    with pytest.raises(ValueError, match="read-only"):
        camera.matrix_px_per_um[0, 0] = 2.0


@given(dx=st.floats(-50, 50), dy=st.floats(-50, 50))
def test_motion_undoes_projection_at_constant_depth(dx: float, dy: float) -> None:
    camera = AffineCamera.exact(tilted(0.6), (256, 200))
    moved = camera.project([[10 + dx, dy, 300.0]]) - camera.project([[10.0, 0, 300]])
    np.testing.assert_allclose(camera.motion_um(moved), [[dx, dy]], atol=1e-9)


# ---- triangulation ----------------------------------------------------------------------------------------


@given(angle_deg=st.floats(5.01, 90))
def test_the_condition_of_eq_8_is_one_over_the_sine_of_half_the_angle(angle_deg: float) -> None:
    rig = exact_rig(angle_deg)
    assert rig.condition == pytest.approx(1 / math.sin(math.radians(angle_deg) / 2), rel=1e-9)
    assert rig.angle_rad == pytest.approx(math.radians(angle_deg), rel=1e-9)


@pytest.mark.parametrize("angle_deg", [10, 30, 45])
def test_depth_scatters_as_the_formula_says(angle_deg: float) -> None:
    rig, angle = exact_rig(angle_deg), math.radians(angle_deg)
    n = 20_000
    rng = np.random.default_rng(angle_deg)
    truth = np.array([120.0, -40.0, 2500.0])
    first = rig.camera_1.project(truth) + rng.normal(0, NOISE_PX, (n, 2))
    second = rig.camera_2.project(truth) + rng.normal(0, NOISE_PX, (n, 2))
    fix = triangulate(rig, first, second)
    sigma = NOISE_PX / SCALE
    formula = np.array([1, 1 / math.sqrt(2), math.sqrt(1 + math.cos(angle) ** 2) / math.sin(angle)]) * sigma
    np.testing.assert_allclose(fix.sigma_um[0], formula, rtol=1e-9)
    # 20 000 draws know a sigma to 0.5 %; the 5 % is ten of those.
    np.testing.assert_allclose(np.std(fix.xyz_um, axis=0), formula, rtol=0.05)
    np.testing.assert_allclose(np.mean(fix.xyz_um, axis=0), truth, atol=0.1 * formula[2])


@given(
    x=st.floats(-2e3, 2e3),
    y=st.floats(-2e3, 2e3),
    z=st.floats(-4e3, 4e3),
    angle_deg=st.floats(6, 90),
    origin_um=st.sampled_from([0.0, 1e6]),
)
def test_projecting_and_triangulating_is_the_identity(
    x: float, y: float, z: float, angle_deg: float, origin_um: float
) -> None:
    rig = exact_rig(angle_deg)
    point = np.array([x, y, z]) + origin_um
    fix = triangulate(rig, rig.camera_1.project(point), rig.camera_2.project(point))
    # Rounding of the pixels, enlarged by the condition number.
    bound = 50 * EPS * (4e3 + origin_um) * rig.condition**2
    np.testing.assert_allclose(fix.xyz_um, point, rtol=0, atol=bound)
    assert abs(float(fix.residual_px)) <= bound * SCALE
    assert bool(fix.consistent)


def test_the_residual_sees_v_errors_and_never_u_errors() -> None:
    rig = exact_rig(30)
    np.testing.assert_allclose(
        rig.null_px * np.sign(rig.null_px[3]), np.array([0, -1, 0, 1]) / math.sqrt(2), atol=1e-12
    )
    point = np.array([0.0, 0, 1000])
    a, b = rig.camera_1.project(point), rig.camera_2.project(point)
    assert bool(triangulate(rig, a, b + np.array([50.0, 0])).consistent)
    # 5 sigma at 0.1 px: a v mismatch of 5 * 0.1 * sqrt(2) = 0.71 px.
    assert bool(triangulate(rig, a, b + np.array([0, 0.70])).consistent)
    assert not bool(triangulate(rig, a, b + np.array([0, 0.72])).consistent)


def test_the_noisier_camera_weighs_less() -> None:
    rig = exact_rig(30)
    point = np.array([0.0, 0, 1000])
    a, b = rig.camera_1.project(point), rig.camera_2.project(point) + np.array([0, 1.0])
    fix = triangulate(rig, a, b, 0.01 * np.eye(2), 1.0 * np.eye(2))
    assert fix.xyz_um[1] == pytest.approx(1 / SCALE * 0.01 / 1.01, rel=1e-9)


def test_the_stated_covariance_covers_calibration_and_features_together() -> None:
    truth = np.array([1000.0, 500, 3900])
    normalised = []
    rng = np.random.default_rng(11)
    for seed in range(150):
        rig = calibrated_rig(planes(0, 1000), seed=seed)
        pixels = [
            tilted(angle) @ truth + [256, 200] + rng.normal(0, NOISE_PX, 2)
            for angle in (0.0, math.radians(30))
        ]
        fix = triangulate(rig, *pixels)
        error = fix.xyz_um - truth
        normalised.append(float(error @ np.linalg.solve(fix.covariance_um2, error)))
    # Chi-square with 3 degrees of freedom: mean 3, variance 6.
    assert np.mean(normalised) == pytest.approx(3, abs=4 * math.sqrt(6 / 150))


def test_relative_depth_forgets_the_calibrations_error_as_the_parts_meet() -> None:
    rig = calibrated_rig(planes(0, 1000))
    quiet = 1e-8 * np.eye(2)
    sigmas = []
    for gap in (4000.0, 400.0, 0.0):
        a, b = np.array([0.0, 0, 0]), np.array([0.0, 0, gap])
        pixels = [camera.project(p) for p in (a, b) for camera in (rig.camera_1, rig.camera_2)]
        fix = triangulate_relative(rig, *pixels, quiet, quiet)
        assert fix.xyz_um[2] == pytest.approx(gap, abs=1e-6)
        sigmas.append(float(fix.sigma_um[2]))
    assert sigmas[0] > 9.9 * sigmas[1]
    assert sigmas[2] < 2e-3  # only the features' own 1e-4 px are left


def test_a_displacement_is_as_noisy_as_both_its_ends() -> None:
    rig, point = exact_rig(30), [0.0, 0, 100]
    a, b = rig.camera_1.project(point), rig.camera_2.project(point)
    one, both = triangulate(rig, a, b), triangulate_relative(rig, a, b, a, b)
    np.testing.assert_allclose(both.covariance_um2, 2 * one.covariance_um2, rtol=1e-9)


def test_an_angle_error_scales_depth_and_cancels_between_parts_that_meet() -> None:
    # docs/maths.md, eq. G10: dZ/dtheta = X - Z cot(theta).
    true, believed = exact_rig(30), exact_rig(31)
    point = np.array([0.0, 0, 4000])
    fix = triangulate(believed, true.camera_1.project(point), true.camera_2.project(point))
    slope = -4000 / math.tan(math.radians(30)) * math.radians(1)
    assert fix.xyz_um[2] - 4000 == pytest.approx(slope, rel=0.05)
    pixels = [camera.project(point) for camera in (true.camera_1, true.camera_2)]
    assert triangulate_relative(believed, *pixels, *pixels).xyz_um[2] == 0


def test_many_points_at_once_agree_with_one_at_a_time() -> None:
    rig = calibrated_rig(planes(0, 1000))
    points = np.random.default_rng(3).uniform(VOLUME[0], VOLUME[1], (5, 3))
    a, b = rig.camera_1.project(points), rig.camera_2.project(points)
    together = triangulate(rig, a, b)
    for k in range(5):
        alone = triangulate(rig, a[k], b[k])
        np.testing.assert_allclose(together.xyz_um[k], alone.xyz_um, rtol=1e-12)
        np.testing.assert_allclose(together.covariance_um2[k], alone.covariance_um2, rtol=1e-9)
        assert alone.residual_px.shape == ()


def test_views_closer_than_15_degrees_warn_and_closer_than_5_are_refused() -> None:
    assert exact_rig(15.1).warnings == ()
    assert "30 to 45 deg" in exact_rig(14.9).warnings[0]
    assert exact_rig(5.1).warnings
    with pytest.raises(CalibrationError, match="tilt camera 2 further"):
        exact_rig(4.9)
    with pytest.raises(CalibrationError, match="tilt camera 2 further"):
        exact_rig(176)  # from behind is the same line of sight


def test_a_pair_whose_calibrations_leave_depth_uncertain_is_refused() -> None:
    with pytest.raises(CalibrationError, match="target stepped along z over"):
        calibrated_rig(planes(0, 1000), angle_deg=6)


@pytest.mark.parametrize(
    ("a", "b", "covariance", "says"),
    [
        ([1.0, np.nan], [1.0, 2], None, "NaN or infinite"),
        ([1.0, 2, 3], [1.0, 2], None, r"xy_1_px is \(3,\)"),
        ([[1.0, 2]], [[1.0, 2], [3, 4]], None, "xy_2_px"),
        ([1.0, 2], [[1.0, 2]], None, "the same shape"),
        ([1.0, 2], [1.0, 2], -np.eye(2), "positive definite"),
        ([1.0, 2], [1.0, 2], np.zeros((2, 2)), "positive definite"),
        ([1.0, 2], [1.0, 2], np.eye(3), "covariance_1_px2"),
    ],
)
def test_triangulation_refuses(a: Any, b: Any, covariance: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        triangulate(exact_rig(30), a, b, covariance)


def test_relative_triangulation_refuses_unlike_shapes() -> None:
    with pytest.raises(InputError, match="all the same shape"):
        triangulate_relative(exact_rig(30), [1.0, 2], [1.0, 2], [[1.0, 2]], [1.0, 2])


# ---- calibration file -------------------------------------------------------------------------------------


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    path = tmp_path / "rig.json"
    save_calibration(path, calibrated_rig(FIVE_PLANES))
    return path


def test_a_saved_pair_comes_back_bit_for_bit(rig_file: Path) -> None:
    rig, again = calibrated_rig(FIVE_PLANES), load_rig(rig_file, camera_ids=("A", "B"), lens_ids=("L1", "L2"))
    for before, after in ((rig.camera_1, again.camera_1), (rig.camera_2, again.camera_2)):
        for name in (
            "matrix_px_per_um",
            "centre_um",
            "centre_px",
            "covariance",
            "work_volume_um",
            "extent_um",
        ):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        assert (before.rms_px, before.points, before.lens_id) == (after.rms_px, after.points, after.lens_id)
    assert again.sigma_z_um() == rig.sigma_z_um()


def test_a_single_camera_is_saved_too(tmp_path: Path) -> None:
    camera = calibrate_camera(FIVE_PLANES, seen(FIVE_PLANES, tilted(0)), camera_id="A", lens_id="L")
    save_calibration(tmp_path / "one.json", camera)
    again = load_camera(tmp_path / "one.json", camera_id="A", lens_id="L")
    np.testing.assert_array_equal(again.covariance, camera.covariance)
    with pytest.raises(CalibrationError, match="single camera"):
        load_rig(tmp_path / "one.json")


def test_a_pair_is_no_single_camera(rig_file: Path) -> None:
    with pytest.raises(CalibrationError, match="holds a pair"):
        load_camera(rig_file)


@pytest.mark.parametrize("kind", ["camera", "lens"])
def test_another_devices_calibration_is_refused(rig_file: Path, tmp_path: Path, kind: str) -> None:
    with pytest.raises(CalibrationError, match=f"belongs to the {kind}"):
        load_rig(rig_file, **{f"{kind}_ids": ("A", "other")})  # type: ignore[arg-type]  # key built from its name
    single = tmp_path / "one.json"
    save_calibration(single, AffineCamera.exact(tilted(0), (0, 0), camera_id="A", lens_id="L"))
    with pytest.raises(CalibrationError, match=f"belongs to the {kind}"):
        load_camera(single, **{f"{kind}_id": "other"})  # type: ignore[arg-type]  # key built from its name


def resigned(path: Path, change: Any) -> None:
    """Change a file's content and give it the checksum that belongs to it."""
    from adof_cl.calibration_file import _checksum

    record = json.loads(path.read_text())
    change(record["content"])
    record["sha256"] = _checksum(record["content"])
    path.write_text(json.dumps(record))


def test_a_file_changed_in_one_digit_is_refused(rig_file: Path) -> None:
    text = rig_file.read_text()
    at = text.index("rms_px") + 12
    rig_file.write_text(text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :])
    with pytest.raises(CalibrationError, match="changed or damaged"):
        load_rig(rig_file)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not a calibration file"),
        ("{", "not a calibration file"),
        ("[" * 100_000, "not a calibration file"),
        ("[1, 2]", "not a calibration file of this program"),
        ('{"format": "another"}', "not a calibration file of this program"),
        ('{"format": "adof calibration", "schema_version": 2}', "schema version 2"),
        ('{"format": "adof calibration", "schema_version": 1}', "not a valid calibration"),
        ('{"format": "adof calibration", "schema_version": NaN}', "it holds NaN"),
        (" " * 1_000_001, "too large"),
    ],
)
def test_what_is_not_our_file_is_refused_in_one_sentence(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "foreign.json"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=says) as refusal:
        load_rig(path)
    assert "\n" not in str(refusal.value)


RIG = calibrated_rig(FIVE_PLANES)


@given(at=st.integers(0, 10**6), byte=st.integers(0, 255))
def test_a_file_with_one_byte_changed_is_refused_or_means_the_same(
    tmp_path_factory: pytest.TempPathFactory, at: int, byte: int
) -> None:
    path = tmp_path_factory.mktemp("flip") / "rig.json"
    save_calibration(path, RIG)
    data = bytearray(path.read_bytes())
    data[at % len(data)] = byte
    path.write_bytes(data)
    with suppress(CalibrationError):
        again = load_rig(path)
        np.testing.assert_array_equal(again.matrix_px_per_um, RIG.matrix_px_per_um)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "image.json"
    path.write_bytes(b"\x89PNG\r\n\xff\xfe")
    with pytest.raises(CalibrationError, match="not a calibration file"):
        load_rig(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_rig(tmp_path / "none.json")


def _unknown_key(content: dict[str, Any]) -> None:
    content["cameras"][0]["colour"] = "red"


def _text_number(content: dict[str, Any]) -> None:
    content["cameras"][0]["rms_px"] = "0.1"


def _three_cameras(content: dict[str, Any]) -> None:
    content["cameras"].append(content["cameras"][0])


def _upside_down(content: dict[str, Any]) -> None:
    content["cameras"][0]["work_volume_um"].reverse()


def _uncertain_camera(content: dict[str, Any]) -> None:
    camera = content["cameras"][0]
    camera["covariance_px_um"] = (np.array(camera["covariance_px_um"]) * 1e4).tolist()


def _uncertain_depth(content: dict[str, Any]) -> None:
    content["rig"]["sigma_z_limit_um"] = 0.1


def _one_view_twice(content: dict[str, Any]) -> None:
    content["cameras"][1] = content["cameras"][0]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_unknown_key, "colour"),
        (_text_number, "rms_px"),
        (_three_cameras, "cameras"),
        (_upside_down, "above the first"),
        (_uncertain_camera, "predicts image positions"),
        (_uncertain_depth, "depth uncertain"),
        (_one_view_twice, "tilt camera 2"),
    ],
)
def test_a_whole_file_still_has_to_pass_the_gates(rig_file: Path, change: Any, says: str) -> None:
    resigned(rig_file, change)
    with pytest.raises(CalibrationError, match=says) as refusal:
        load_rig(rig_file)
    assert "\n" not in str(refusal.value)


def test_a_place_that_cannot_be_written_is_refused_and_nothing_is_left(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        save_calibration(tmp_path / "no folder" / "rig.json", calibrated_rig(FIVE_PLANES))
    assert list(tmp_path.iterdir()) == []
