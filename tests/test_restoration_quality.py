"""What a restoration promises is what it does: noise as loud, detail as fine."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_cl import reference
from adof_cl.errors import InputError
from adof_cl.optics import OpticalSystem
from adof_cl.restoration_quality import RestorationQuality, restoration_quality

PADDED = (96, 135)


def blur(alpha: float, psi: float, padded: tuple[int, int] = PADDED) -> np.ndarray:
    optics = OpticalSystem()
    rows, columns = (reference.otf_1d(optics.frequency_axis(n), alpha, psi) for n in padded)
    for axis in (rows, columns):
        if axis.size % 2 == 0:
            axis[axis.size // 2] = axis[axis.size // 2].real
    return np.outer(rows, columns[: padded[1] // 2 + 1])


@pytest.mark.parametrize("padded", [PADDED, (64, 64), (35, 42)], ids=str)
@pytest.mark.parametrize("nsr", [1e-3, 0.1])
def test_white_noise_comes_out_as_loud_as_predicted(padded: tuple[int, int], nsr: float) -> None:
    otf = blur(20, 10, padded)
    quality = restoration_quality(otf, nsr, padded)
    gain = reference.wiener(otf, nsr)
    rng = np.random.default_rng(1)
    draws = 400
    noise = rng.normal(0, 3, (draws, *padded))
    variance = float(np.var(np.fft.irfft2(np.fft.rfft2(noise) * gain, s=padded)))
    # A mean of |G|^2 times squares of normal numbers: so many are independent as |G|^4 leaves.
    whole = np.abs(np.fft.fft2(np.fft.irfft2(gain, s=padded))) ** 2
    spread = math.sqrt(2 * float((whole**2).sum()) / draws) / float(whole.sum())
    assert abs(variance / (9 * quality.noise_gain**2) - 1) <= 5 * spread


@pytest.mark.parametrize(("ky", "kx"), [(0, 9), (11, 0), (7, 30), (48, 3)])
def test_a_pattern_keeps_the_contrast_that_was_predicted(ky: int, kx: int) -> None:
    ny, nx = PADDED
    otf = blur(30, -12)
    quality = restoration_quality(otf, 0.02, PADDED)
    y, x = np.mgrid[:ny, :nx]
    scene = 100 + 40 * np.cos(2 * np.pi * (ky * y / ny + kx * x / nx) + 0.3)
    blurred = np.fft.irfft2(np.fft.rfft2(scene) * otf, s=PADDED)
    restored = reference.restore(blurred, reference.wiener(otf, 0.02), PADDED)
    there, here = np.fft.rfft2(scene), np.fft.rfft2(restored)
    kept = abs(here[ky, kx] / there[ky, kx]) / abs(here[0, 0] / there[0, 0])
    assert kept == pytest.approx(quality.contrast[ky, kx], rel=1e-9)


def test_a_perfect_system_adds_no_noise_and_resolves_all_a_frame_can_hold() -> None:
    quality = restoration_quality(np.ones((96, 68)), 0, PADDED)
    assert quality.noise_gain == pytest.approx(1, abs=1e-14)
    np.testing.assert_array_equal(quality.contrast, 1)
    np.testing.assert_array_equal(quality.half_contrast_period_xy_px, 2)


def test_detail_ends_where_the_contrast_crosses_a_half() -> None:
    n = 64
    f = np.fft.rfftfreq(n)
    otf = np.outer(np.ones(n), np.sqrt(np.maximum(1 - 2 * f, 0)))  # |H|^2 falls in a straight line
    quality = restoration_quality(otf, 1.0, (n, n))
    # |H|^2/(|H|^2 + 1) is half its value at DC, 1/2, where |H|^2 = 1/3; between samples, a chord.
    assert 1 / quality.half_contrast_period_xy_px[0] == pytest.approx(1 / 3, abs=1 / n)
    assert quality.half_contrast_period_xy_px[1] == 2
    assert quality.half_contrast_period_um(7.4) == pytest.approx(7.4 * quality.half_contrast_period_xy_px[0])


@given(
    alpha=st.floats(0.1, 100),
    psi=st.floats(-60, 60),
    low=st.floats(-6, 1),
    step=st.floats(0.1, 3),
)
def test_more_noise_suppression_is_quieter_and_no_contrast_exceeds_one_by_more_than_the_dip_at_dc(
    alpha: float, psi: float, low: float, step: float
) -> None:
    otf = blur(alpha, psi, (24, 30))
    little, much = (restoration_quality(otf, 10**power, (24, 30)) for power in (low, low + step))
    assert much.noise_gain <= little.noise_gain
    for quality in (little, much):
        assert np.isfinite(quality.contrast).all()
        # |H| <= H(0) = 1 for a stop, so nothing passes better than DC; a rounding of each factor.
        assert quality.contrast.max() <= 1 + 8 * np.finfo(float).eps
        assert (quality.half_contrast_period_xy_px >= 2).all()


REFUSED: list[tuple[Any, Any, str]] = [
    (np.ones((96, 67)), 0.1, "shape"),
    (np.full((96, 68), np.nan), 0.1, "finite"),
    (np.zeros((96, 68)), 0.1, "0 at DC"),
    (np.ones((96, 68)), -1.0, "0 or more"),
    (np.ones((96, 68)), np.ones((3, 3)), "shape"),
    (np.ones((96, 68)), math.inf, "infinite"),
]


@pytest.mark.parametrize(("otf", "nsr", "says"), REFUSED)
def test_what_cannot_be_judged_is_refused(otf: Any, nsr: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        restoration_quality(otf, nsr, PADDED)


@pytest.mark.parametrize("pitch", [0.0, -1.0, math.nan])
def test_a_pitch_that_is_none_is_refused(pitch: float) -> None:
    quality = RestorationQuality(1.0, np.ones((2, 2)), np.array([2.0, 3.0]))
    with pytest.raises(InputError):
        quality.half_contrast_period_um(pitch)
