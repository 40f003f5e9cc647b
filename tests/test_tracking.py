"""Features followed below a pixel: to the noise bound, with an honest covariance, and lost out loud."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage, special

from adof_cl.device import Device
from adof_cl.errors import InputError, TrackingError
from adof_cl.tracking import (
    GaussNewton,
    Template,
    TemplateTracker,
    TrackingLimits,
    estimate_noise,
    locate_corner,
    quadratic_minimum,
)

Array = NDArray[np.float64]
NOISE = 2.0
SIDE = 96


def texture(rng: np.random.Generator, shape: tuple[int, int] = (SIDE, SIDE)) -> Array:
    grain = ndimage.gaussian_filter(rng.normal(size=shape), 1.5, mode="wrap")
    return 128 + 40 * grain / grain.std()


def corner(_: np.random.Generator) -> Array:
    image = np.full((SIDE, SIDE), 68.0)
    image[48:, 48:] = 188
    return ndimage.gaussian_filter(image, 1.0, mode="wrap")


def moved(image: Array, shift_yx: Array) -> Array:
    """Shift exactly: a band-limited image has one Fourier interpolation."""
    fy = np.fft.fftfreq(image.shape[0])[:, None]
    fx = np.fft.fftfreq(image.shape[1])[None, :]
    turn = np.exp(-2j * np.pi * (fy * shift_yx[0] + fx * shift_yx[1]))
    return np.fft.ifft2(np.fft.fft2(image) * turn).real


def refine_many(
    make: Any, noise: float, gain: float = 1.0, offset: float = 0.0, rounds: int = 60
) -> tuple[Array, Array, float]:
    """Errors (n, 2), predicted covariances (n, 2, 2) and the rms of the noise bound."""
    rng = np.random.default_rng(5)
    errors, covariances, bounds = [], [], []
    for _ in range(rounds):
        sharp = make(rng)
        shift = rng.uniform(-0.5, 0.5, 2)
        first = sharp + noise * rng.normal(size=sharp.shape)
        second = gain * moved(sharp, shift) + offset + noise * rng.normal(size=sharp.shape)
        template = Template.cut(first.astype(np.float32), (47.5, 47.5), noise=max(noise, 0.01))
        top, left = np.rint(47.5 - template.anchor_yx).astype(int)
        patch = second[top - 8 : top + 28, left - 8 : left + 28]
        found = GaussNewton([template])(patch[None], np.zeros((1, 2)))
        errors.append(found.shift_yx[0] - shift)
        covariances.append(found.covariance_yx[0])
        bounds.append(
            noise**2 * (1 + gain**-2) * np.trace(np.linalg.inv(template.hessian_yx)) / 2 if noise else 0
        )
    return np.array(errors), np.array(covariances), math.sqrt(float(np.mean(bounds)))


def rms(errors: Any) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def test_without_noise_the_place_comes_out_to_a_thousandth_of_a_pixel() -> None:
    errors, _, _ = refine_many(texture, 0.0, rounds=20)
    assert rms(errors) < 1e-3


@pytest.mark.parametrize(
    ("make", "gain", "offset"),
    [(texture, 1.0, 0.0), (corner, 1.0, 0.0), (corner, 1.2, 0.0), (texture, 0.8, 20.0), (texture, 0.4, 60.0)],
)
def test_with_noise_the_error_is_within_1_3_of_the_noise_bound_and_as_large_as_its_covariance_says(
    make: Any, gain: float, offset: float
) -> None:
    errors, covariances, bound = refine_many(make, NOISE, gain, offset, rounds=120)
    assert rms(errors) < 1.3 * bound
    # The mean of n chi-squared pairs over 2 scatters by 1/sqrt(n). Interpolation takes some of the image's
    # noise, of which fine texture gains.
    normalised = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors) / 2
    assert 0.6 < normalised.mean() < 1 + 4 / math.sqrt(len(errors))


def test_a_fifth_more_light_moves_a_corner_by_less_than_0_03_px_where_the_plain_score_moves_it_by_0_2() -> (
    None
):
    errors, _, _ = refine_many(corner, NOISE, 1.2)
    assert np.abs(errors.mean(axis=0)).max() < 0.03

    still = corner(np.random.default_rng(0))
    template, bright = still[38:58, 38:58], 1.2 * still
    scores = np.array(
        [
            [((bright[y : y + 20, x : x + 20] - template) ** 2).sum() for x in (37, 38, 39)]
            for y in (37, 38, 39)
        ]
    )
    assert np.abs(quadratic_minimum(scores)).max() > 0.2


shapes = st.tuples(
    st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(0.5, 5), st.floats(0.5, 5), st.floats(-0.4, 0.4)
)


@given(shapes)
def test_the_quadratic_finds_the_minimum_of_a_quadratic(
    shape: tuple[float, float, float, float, float],
) -> None:
    y0, x0, hyy, hxx, mixed = shape
    y, x = np.mgrid[-1:2, -1:2] - np.array([y0, x0])[:, None, None]
    scores = 7 + hyy * y * y / 2 + hxx * x * x / 2 + mixed * math.sqrt(hyy * hxx) * x * y
    np.testing.assert_allclose(quadratic_minimum(scores), (y0, x0), atol=1e-12)


def test_the_quadratic_of_scores_without_a_minimum_stays_in_the_middle() -> None:
    edge = np.ones((3, 3))
    edge[0] = np.inf
    y, x = np.mgrid[-1:2, -1:2]
    hill = -((y - 0.3) ** 2) - (x + 0.2) ** 2
    saddle = (y - 0.3) ** 2 - (x + 0.2) ** 2
    assert quadratic_minimum(np.stack([edge, np.zeros((3, 3)), hill, saddle])).tolist() == [[0, 0]] * 4


def test_a_flat_template_noise_alone_and_a_bare_edge_are_refused_and_a_corner_is_not() -> None:
    rng = np.random.default_rng(9)
    noise = NOISE * rng.normal(size=(SIDE, SIDE))
    with pytest.raises(TrackingError, match="no texture"):
        Template.cut((100 + noise).astype(np.float32), (48, 48), noise=NOISE)
    for angle in (0, 20, 45, 90):
        y, x = np.mgrid[:SIDE, :SIDE] - 48.0
        across = math.cos(math.radians(angle)) * y - math.sin(math.radians(angle)) * x
        edge = 68 + 120 * special.ndtr(across) + noise
        with pytest.raises(
            TrackingError, match=rf"slide along ({angle}|{(angle - 1) % 180}|{(angle + 1) % 180}) degrees"
        ):
            Template.cut(edge.astype(np.float32), (48, 48), noise=NOISE)
    template = Template.cut((corner(rng) + noise).astype(np.float32), (47.5, 47.5), noise=NOISE)
    assert template.sigma_px < 0.03


def test_the_naive_texture_bound_accepts_noise_alone() -> None:
    rng = np.random.default_rng(9)
    noise = NOISE * rng.normal(size=(40, 40))
    gy, gx = np.gradient(noise)
    slopes = np.stack([gy[10:30, 10:30].ravel(), gx[10:30, 10:30].ravel()])
    assert NOISE * math.sqrt(2 / np.linalg.eigvalsh(slopes @ slopes.T)[0]) < 0.12


def test_what_cannot_be_a_template_is_refused() -> None:
    image = texture(np.random.default_rng(3)).astype(np.float32)
    broken = image.copy()
    broken[50, 50] = np.nan
    refused: list[tuple[Any, Any, dict[str, Any], str]] = [
        (image, (3, 48), {}, "leaves the image"),
        (image, (48, np.inf), {}, "finite column and row"),
        (image, (48,), {}, "finite column and row"),
        (image, (48, 48), {"shape": (3, 20)}, "whole numbers of 4 or more"),
        (image, (48, 48), {"sigma_limit_px": 0.0}, "above 0"),
        (image, (48, 48), {"noise": np.nan}, "grey levels were wanted"),
        (broken, (48, 48), {}, "not finite or beyond 1e.16 around"),
        (image.astype(np.float64), (48, 48), {}, "convert it first"),
        (image[0], (48, 48), {}, "convert it first"),
    ]
    for picture, place, options, words in refused:
        with pytest.raises(InputError, match=words):
            Template.cut(picture, place, **options)


def test_a_template_keeps_the_fraction_of_its_feature() -> None:
    image = texture(np.random.default_rng(3)).astype(np.float32)
    template = Template.cut(image, (48.3, 40.75), noise=NOISE)
    top, left = np.rint((40.75, 48.3) - template.anchor_yx)
    np.testing.assert_allclose(template.anchor_yx + np.array([top, left]), (40.75, 48.3))
    assert np.abs(template.anchor_yx - 9.5).max() <= 0.5
    np.testing.assert_array_equal(
        template.pixels, image[int(top) : int(top) + 20, int(left) : int(left) + 20]
    )


@pytest.mark.parametrize("level", [1.0, 4.0])
def test_noise_is_estimated_within_a_tenth_on_a_plane_and_on_a_part(level: float) -> None:
    rng = np.random.default_rng(13)
    for clean in (np.add.outer(np.arange(SIDE), 2.0 * np.arange(SIDE)), corner(rng)):
        assert abs(estimate_noise(clean + level * rng.normal(size=clean.shape)) / level - 1) < 0.1
    with pytest.raises(InputError, match="3 x 3"):
        estimate_noise(np.zeros((2, 9)))


# ---- the tracker on the device ----------------------------------------------------------------------------

FRAME = (150, 210)
PLACES = np.array([[60.3, 50.0], [150.0, 100.7], [110.0, 70.0]])


class Scene:
    """A textured scene that moves, as bytes or as real grey levels in [0, 1]."""

    def __init__(self, dtype: str, seed: int = 1) -> None:
        self.rng = np.random.default_rng(seed)
        self.base = texture(self.rng, FRAME) * 0.8
        self.dtype = dtype

    def frame(self, shift_xy: Any = (0, 0), gain: float = 1.0) -> NDArray[Any]:
        shift_yx = np.asarray(shift_xy, dtype=np.float64)[::-1]
        grey = gain * moved(self.base, shift_yx) + NOISE * self.rng.normal(size=FRAME)
        if self.dtype == "uint8":
            return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        return (grey / 255).astype(np.float32)

    def templates(self) -> list[Template]:
        noise = NOISE if self.dtype == "uint8" else NOISE / 255
        frame = self.frame()
        return [Template.cut(frame, place, noise=noise) for place in PLACES]


def tracker_of(device: Device, scene: Scene, **options: Any) -> TemplateTracker:
    return TemplateTracker(device, FRAME, scene.templates(), (40, 44), **options)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene("uint8")


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_features_are_followed_through_gathering_motion_within_four_of_their_sigmas(
    device: Device, dtype: str
) -> None:
    scene = Scene(dtype)
    tracker = tracker_of(device, scene)
    tracker.aim(PLACES)
    # Farther a frame than half the window: only the last displacement, carried on, keeps the features in it.
    for step, along in enumerate((0.0, 8.3, 20.6, 33.2, 44.1)):
        shift = np.array([along, -1.7 * step])
        measured = tracker.track(device.upload(scene.frame(shift, gain=1 - 0.02 * step)))
        for place, m in zip(PLACES, measured, strict=True):
            assert not m.lost, m.reason
            error = m.feature_xy_px - place - shift
            assert error @ np.linalg.solve(m.covariance, error) < 2 * 4**2
            assert math.sqrt(m.covariance[0, 0]) < 0.03
            assert abs(m.gain - (1 - 0.02 * step)) < 0.05


def test_each_step_of_the_ladder_is_more_precise_than_the_one_below_and_says_so(
    device: Device, scene: Scene
) -> None:
    found = {}
    for refine in ("integer", "quadratic", "gauss_newton"):
        tracker = tracker_of(device, scene, refine=refine)
        errors, sigmas = [], []
        for step in range(10):
            shift = np.array([0.37, 0.21]) * step
            measured = tracker.track(device.upload(scene.frame(shift)), PLACES)
            errors += [m.feature_xy_px - p - shift for m, p in zip(measured, PLACES, strict=True)]
            sigmas += [math.sqrt(m.covariance[0, 0]) for m in measured]
        found[refine] = rms(errors)
        assert 0.5 < found[refine] / float(np.mean(sigmas)) < 1.5
    assert found["gauss_newton"] < found["quadratic"] / 1.5 < found["integer"] / 4


def test_the_papers_score_sums_squares_of_grey_in_0_to_1_whatever_the_image_type(device: Device) -> None:
    sums = {}
    for dtype in ("uint8", "float32"):
        scene = Scene(dtype)
        tracker = tracker_of(device, scene, score="ssd")
        frame = scene.frame()
        measured = tracker.track(device.upload(frame), PLACES)
        scale = 255.0 if dtype == "uint8" else 1.0
        for m, template in zip(measured, tracker.templates, strict=True):
            y, x = np.rint(m.feature_xy_px[::-1] - template.anchor_yx).astype(int)
            difference = frame[y : y + 20, x : x + 20].astype(np.float64) - template.pixels
            assert m.ssd == pytest.approx(float((difference**2).sum()) / scale**2, rel=1e-12)
        sums[dtype] = [m.ssd for m in measured]
    # Two noisy images of one scene: 2 n sigma^2 with sigma = 2/255, to the scatter of 400 squares.
    assert np.mean(sums["float32"]) == pytest.approx(
        2 * 400 * (NOISE / 255) ** 2, rel=4 * math.sqrt(2 / 1200)
    )


def test_a_window_that_would_leave_the_frame_is_moved_inside_and_a_template_that_does_is_lost(
    device: Device,
) -> None:
    scene = Scene("uint8", 4)
    places = np.array([[10.0, 10.5], [194.0, 136.0], [110.0, 70.0]])
    frame = scene.frame()
    tracker = TemplateTracker(device, FRAME, [Template.cut(frame, p, noise=NOISE) for p in places], (40, 44))
    measured = tracker.track(device.upload(scene.frame((2.25, -1.5))), places + 2)
    assert measured[0].lost  # its template would leave the frame upwards
    for m, place in zip(measured[1:], places[1:], strict=True):
        assert not m.lost, m.reason
        assert np.abs(m.feature_xy_px - place - (2.25, -1.5)).max() < 0.1


def test_a_feature_that_is_covered_is_lost_waits_where_it_was_expected_and_is_found_again(
    device: Device, scene: Scene
) -> None:
    tracker = tracker_of(device, scene)
    tracker.track(device.upload(scene.frame()), PLACES)
    covered = scene.frame()
    covered[35:65, 40:80] = 90
    measured = tracker.track(device.upload(covered))
    assert [m.lost for m in measured] == [True, False, False]
    assert "does not look like the template" in measured[0].reason or "edge" in measured[0].reason
    assert np.isinf(np.diag(measured[0].covariance)).all()
    np.testing.assert_allclose(measured[0].feature_xy_px, PLACES[0], atol=0.1)
    measured = tracker.track(device.upload(scene.frame()))
    assert not any(m.lost for m in measured)


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (TrackingLimits(displacement_px=1.0), "from where it was expected"),
        (TrackingLimits(gain=(1.5, 9.0)), "contrast is"),
        (TrackingLimits(sigma_px=1e-3), "uncertain by"),
        (TrackingLimits(mismatch=1e-3), "does not look like"),
    ],
)
def test_every_limit_loses_the_feature_and_says_why(
    device: Device, scene: Scene, limits: TrackingLimits, words: str
) -> None:
    tracker = tracker_of(device, scene, limits=limits)
    for m in tracker.track(device.upload(scene.frame((3, 0))), PLACES):
        assert m.lost
        assert words in m.reason


def test_a_feature_beyond_its_window_and_an_image_that_is_not_finite_are_lost(device: Device) -> None:
    scene = Scene("float32")
    tracker = tracker_of(device, scene)
    assert all(m.lost for m in tracker.track(device.upload(scene.frame((25, 0))), PLACES))
    measured = tracker.track(device.upload(np.full(FRAME, np.nan, np.float32)), PLACES)
    assert [m.reason for m in measured] == ["the image is not finite under the window"] * 3


def test_known_motion_moves_the_windows(device: Device, scene: Scene) -> None:
    tracker = tracker_of(device, scene)
    tracker.track(device.upload(scene.frame()), PLACES)
    measured = tracker.track(device.upload(scene.frame((25, 4))), displacement_xy_px=(24, 5))
    for m, place in zip(measured, PLACES, strict=True):
        assert not m.lost, m.reason
        np.testing.assert_allclose(m.feature_xy_px, place + np.array([25, 4]), atol=0.1)


def test_a_template_may_be_replaced(device: Device, scene: Scene) -> None:
    tracker = tracker_of(device, scene)
    elsewhere = np.array([80.0, 110.0])
    tracker.replace(1, Template.cut(scene.frame(), elsewhere, noise=NOISE))
    places = np.stack([PLACES[0], elsewhere, PLACES[2]])
    measured = tracker.track(device.upload(scene.frame()), places)
    np.testing.assert_allclose([m.feature_xy_px for m in measured], places, atol=0.1)


def test_what_cannot_be_tracked_is_refused(device: Device, scene: Scene) -> None:
    with pytest.raises(InputError, match="no template came"):
        TemplateTracker(device, FRAME, [])
    mixed = [*scene.templates(), Template.cut(scene.frame(), PLACES[0], (16, 20), noise=NOISE)]
    with pytest.raises(InputError, match="several kinds"):
        TemplateTracker(device, FRAME, mixed)
    with pytest.raises(InputError, match="choose 'gauss_newton'"):
        tracker_of(device, scene, refine="best")
    tracker = tracker_of(device, scene)
    with pytest.raises(TrackingError, match="no place to start from"):
        tracker.aim()
    with pytest.raises(InputError, match="finite pixels were wanted"):
        tracker.aim(PLACES[:2])
    with pytest.raises(InputError, match="finite"):
        tracker.aim(PLACES, displacement_xy_px=(np.nan, 0))
    with pytest.raises(InputError, match="smaller first"):
        TrackingLimits(gain=(2, 1))
    with pytest.raises(InputError, match="above 0"):
        TrackingLimits(displacement_px=0.0)


# ---- corners ----------------------------------------------------------------------------------------------


def rectangle(
    rng: np.random.Generator, angle_rad: float, *, grain: float = 0.0, flip: bool = False
) -> tuple[NDArray[np.uint8], Array]:
    """Render a soft-edged rectangle, averaged over pixels, textured, with 1 % noise; and its corners."""
    fine, shape, size = 5, (100, 110), np.array([61.0, 54.0])
    centre = np.array([55.0, 50.0]) + rng.uniform(-2, 2, 2)
    y, x = ((np.arange(n * fine) + 0.5) / fine - 0.5 for n in shape)
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    dy, dx = np.meshgrid(y - centre[1], x - centre[0], indexing="ij")
    cover = np.ones(dx.shape)
    for along, width in ((cos * dx + sin * dy, size[0]), (cos * dy - sin * dx, size[1])):
        cover *= special.ndtr((along + width / 2) / 0.4) - special.ndtr((along - width / 2) / 0.4)
    cover = cover.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))
    inside, outside = (0.3, 0.7) if flip else (0.7, 0.3)
    smooth = [ndimage.gaussian_filter(rng.normal(size=shape), 0.8) for _ in range(2)]
    inside, outside = (
        level + grain * s / s.std() for level, s in zip((inside, outside), smooth, strict=True)
    )
    image = cover * inside + (1 - cover) * outside + 0.01 * rng.normal(size=shape)
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * size / 2
    corners = centre + signs @ np.array([[cos, sin], [-sin, cos]])
    return np.clip(np.rint(255 * image), 0, 255).astype(np.uint8), corners


def corner_errors(grain: float, arm_px: float, rounds: int = 8) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(17)
    errors, covariances, refined = [], [], []
    for index in range(rounds):
        image, corners = rectangle(rng, math.radians(rng.uniform(-10, 10)), grain=grain, flip=bool(index % 2))
        for place in corners:
            guess = place + rng.uniform(-3, 3, 2)
            found = locate_corner(image, guess, arm_px=arm_px)
            errors.append(found.xy_px - place)
            covariances.append(found.covariance)
            start = guess.astype(np.float32).reshape(1, 1, 2)
            ending = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
            refined.append(cv2.cornerSubPix(image, start, (10, 10), (-1, -1), ending)[0, 0] - place)
    return np.array(errors), np.array(covariances), np.array(refined)


@pytest.mark.parametrize(("grain", "arm_px"), [(0.0, 30.0), (0.01, 40.0)])
def test_a_corner_is_located_to_three_hundredths_of_a_pixel_at_any_small_rotation(
    grain: float, arm_px: float
) -> None:
    errors, covariances, refined = corner_errors(grain, arm_px)
    assert rms(errors) < 0.03
    assert np.abs(errors).max() < 0.12
    normalised = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors) / 2
    assert 0.4 < normalised.mean() < 2.5
    assert rms(refined) > 2.5 * rms(errors)  # the gradient intersection everyone has at hand


def test_the_corners_edges_have_the_parts_rotation() -> None:
    image, corners = rectangle(np.random.default_rng(19), math.radians(7))
    for place in corners:
        found = locate_corner(image, place)
        np.testing.assert_allclose(np.degrees(found.edges_rad), (7, 97), atol=0.3)


def test_where_there_is_no_corner_none_is_located() -> None:
    rng = np.random.default_rng(23)
    image, corners = rectangle(rng, 0.0)
    flat = np.clip(100 + 2.5 * rng.normal(size=(100, 110)), 0, 255).astype(np.uint8)
    with pytest.raises(TrackingError, match="no corner"):
        locate_corner(flat, (55, 50))
    with pytest.raises(TrackingError, match="no corner"):
        locate_corner(np.full((100, 110), 90, np.uint8), (55, 50))
    middle_of_an_edge = (corners[0] + corners[1]) / 2
    with pytest.raises(TrackingError, match="no corner"):
        locate_corner(image, middle_of_an_edge)
    with pytest.raises(TrackingError, match="no corner"):
        locate_corner(image, corners.mean(axis=0))
    junction = np.full((100, 110), 200.0)  # an edge from top to bottom, and one that ends at it
    junction[:50, 60:], junction[50:, 60:] = 60, 110
    junction += 2.5 * rng.normal(size=junction.shape)
    with pytest.raises(TrackingError, match="runs straight through"):
        locate_corner(junction, (59.5, 49.5))
    with pytest.raises(InputError, match="border"):
        locate_corner(image, (-60, 50))
    with pytest.raises(InputError, match="finite column and row"):
        locate_corner(image, (np.nan, 50))
    with pytest.raises(InputError, match="wanted"):
        locate_corner(image[0], (9, 9))
    broken = image.astype(np.float64)
    broken[50, 60] = np.nan
    with pytest.raises(InputError, match="not finite"):
        locate_corner(broken, corners[1])


@settings(max_examples=10)
@given(st.integers(0, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_a_corner_does_not_depend_on_where_the_guess_lay(index: int, dx: float, dy: float) -> None:
    image, corners = rectangle(np.random.default_rng(29), math.radians(4))
    straight = locate_corner(image, corners[index])
    other = locate_corner(image, corners[index] + (dx, dy))
    limit = 3 * math.sqrt(float(np.linalg.eigvalsh(straight.covariance)[-1]))
    assert np.abs(other.xy_px - straight.xy_px).max() < limit
