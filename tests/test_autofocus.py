"""Focus found from images: where, how surely, and refused where there is none."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from adof_cl import reference
from adof_cl.autofocus import focus_sweep, sharpness
from adof_cl.errors import InputError, TrackingError
from adof_cl.optics import OpticalSystem

OPTICS = OpticalSystem()
SHAPE = (96, 112)


class Bench:
    """A textured part in front of the exact optics: bytes, noise, any mask strength."""

    def __init__(
        self, seed: int, *, focus_um: float = 0.0, noise: float = 0.01, alpha_rad: float = 0.0
    ) -> None:
        self.rng = np.random.default_rng(seed)
        grain = ndimage.gaussian_filter(self.rng.normal(size=SHAPE), 0.8, mode="wrap")
        scene = 0.45 + 0.05 * grain / grain.std()
        scene[30:70, 30:80] += 0.25
        self.spectrum = np.fft.fft2(scene)
        self.focus_um, self.noise, self.alpha_rad = focus_um, noise, alpha_rad

    def __call__(self, depth_um: float) -> NDArray[np.uint8]:
        psi = OPTICS.psi_rad(depth_um - self.focus_um)
        axes = [
            reference.otf_1d(OPTICS.frequency_axis(n), self.alpha_rad, psi) * OPTICS.pixel_otf_axis(n)
            for n in SHAPE
        ]
        grey = np.fft.ifft2(self.spectrum * np.outer(*axes)).real + self.noise * self.rng.normal(size=SHAPE)
        return np.clip(np.rint(255 * grey), 0, 255).astype(np.uint8)


def test_focus_is_found_to_a_micrometre_at_one_per_cent_noise_and_its_sigma_is_honest() -> None:
    normalised = []
    for seed in range(10):
        focus = float(np.random.default_rng(seed).uniform(-900, 900))
        found = focus_sweep(Bench(seed, focus_um=focus), -3000, 3000)
        assert abs(found.position - focus) < 2.0
        normalised.append(((found.position - focus) / found.sigma) ** 2)
    assert 0.1 < float(np.mean(normalised)) < 3.0


@settings(max_examples=15)
@given(focus=st.floats(-40, 40), width=st.floats(8, 60), floor=st.floats(0, 0.5), scale=st.floats(1e-6, 1e6))
def test_a_smooth_peak_is_found_to_a_hundredth_of_its_width_in_any_unit_of_score(
    focus: float, width: float, floor: float, scale: float
) -> None:
    found = focus_sweep(lambda z: scale * (floor + math.exp(-(((z - focus) / width) ** 2))), -100, 100)
    assert abs(found.position - focus) < 0.01 * width


def test_the_curve_holds_every_measurement_in_order() -> None:
    seen: list[float] = []

    def measure(z: float) -> float:
        seen.append(z)
        return 1 / (1 + z * z)

    found = focus_sweep(measure, -10, 9, coarse=7, rounds=2)
    assert sorted(seen) == found.positions.tolist()
    assert (np.diff(found.positions) >= 0).all()
    np.testing.assert_allclose(found.scores, 1 / (1 + found.positions**2))


@pytest.mark.parametrize("alpha_rad", [35.0, 53.5, 80.0])
def test_with_a_cubic_mask_on_there_is_no_focus_to_find(alpha_rad: float) -> None:
    with pytest.raises(TrackingError, match=r"switch the cubic mask off|no single peak"):
        focus_sweep(Bench(3, alpha_rad=alpha_rad), -1500, 1500)


def test_sharpness_does_not_depend_on_the_light_and_falls_with_every_blur() -> None:
    image = Bench(5, noise=0.0)(0.0).astype(np.float64) / 255
    assert sharpness(0.6 * image) == pytest.approx(sharpness(image), rel=1e-12)
    blurred = [sharpness(ndimage.gaussian_filter(image, blur)) for blur in (0, 0.5, 1, 2, 4)]
    assert (np.diff(blurred) < 0).all()


def test_sharpness_is_the_same_for_bytes_and_for_16_bits() -> None:
    image = Bench(5)(0.0)
    assert sharpness(image) == pytest.approx(sharpness(image.astype(np.uint16) * 257), rel=1e-12)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((20, 20), np.uint8), "is black"),
        (np.full((20, 20), 255, np.uint8), "at full scale"),
        (np.full((20, 20), np.nan), "not finite"),
        (np.zeros((15, 20), np.uint8), "16 x 16"),
        (np.zeros(400, np.uint8), "16 x 16"),
    ],
)
def test_images_that_cannot_be_judged_are_refused(image: NDArray[Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        sharpness(image)
    with pytest.raises(InputError, match=words):
        focus_sweep(lambda _: image, -1, 1)


@pytest.mark.parametrize(
    ("measure", "words"),
    [
        (lambda _: 1.0, "is flat"),
        (lambda z: 1 + 1e-3 * math.exp(-z * z), "is flat"),
        (lambda z: 10 + z, "still rises at 5"),
        (lambda z: 10 - z, "still rises at -5"),
    ],
)
def test_a_curve_without_a_peak_inside_is_refused(measure: Callable[[float], float], words: str) -> None:
    with pytest.raises(TrackingError, match=words):
        focus_sweep(measure, -5, 5)


def test_noise_alone_is_no_peak() -> None:
    refused = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        try:
            found = focus_sweep(lambda _, rng=rng: 1 + 0.1 * rng.normal(), -5, 5)
        except TrackingError:
            refused += 1
        else:
            assert found.sigma > 0.05
    assert refused >= 15


def test_what_cannot_be_swept_is_refused() -> None:
    for low, high, options, words in (
        (1, 1, {}, "is empty"),
        (0, math.inf, {}, "finite"),
        (0, 1, {"coarse": 4}, "coarse is 4: a whole number of 5"),
        (0, 1, {"rounds": 0}, "rounds is 0: a whole number of 1"),
    ):
        with pytest.raises(InputError, match=words):
            focus_sweep(lambda _: 1.0, low, high, **options)
    for score in (math.nan, math.inf, -1.0):
        with pytest.raises(InputError, match="0 or more"):
            focus_sweep(lambda _, score=score: score, 0, 1)
