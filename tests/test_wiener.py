from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tolerances
from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import InputError
from adof_cl.noise import noise_to_signal
from adof_cl.optics import OpticalSystem
from adof_cl.wiener import WienerFilter, psf_otf

SHAPES = ((12, 10), (15, 21))
SHAPE = SHAPES[0]
HALF = (12, 6)


@cache
def plan_of(device: Device, shape: tuple[int, int], precision: str = "float32") -> WienerFilter:
    return WienerFilter(device, shape, precision=precision)


def random_axes(shape: tuple[int, int], precision: str, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    kind = np.complex64 if precision == "float32" else np.complex128
    return [(rng.normal(size=n) + 1j * rng.normal(size=n)).astype(kind) for n in shape]


def error_of(found: np.ndarray, wanted: np.ndarray) -> float:
    return float((np.abs(found - wanted) / np.maximum(np.abs(wanted), 1e-300)).max())


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_filter_of_two_axes_is_that_of_the_numpy_page(
    device: Device, precision: str, shape: tuple[int, int]
) -> None:
    plan = plan_of(device, shape, precision)
    rows, columns = random_axes(shape, precision)
    noise = np.random.default_rng(1).uniform(0, 2, plan.filter_shape).astype(precision)
    for nsr in (np.array(0.5, dtype=precision), noise):
        found = plan.from_otf_axes(rows, columns, nsr).download()
        wanted = reference.wiener_of_axes(rows, columns, nsr)
        assert error_of(found, wanted) <= tolerances.wiener_relative(precision)


def test_the_filter_of_any_spectrum_is_that_of_the_numpy_page(device: Device, precision: str) -> None:
    plan = plan_of(device, SHAPE, precision)
    rng = np.random.default_rng(3)
    otf = (rng.normal(size=HALF) + 1j * rng.normal(size=HALF)).astype(plan.from_otf(np.ones(HALF), 1).dtype)
    noise = rng.uniform(0, 2, HALF).astype(precision)
    for nsr in (0.25, noise):
        found = plan.from_otf(otf, nsr).download()
        assert error_of(found, reference.wiener(otf, nsr)) <= tolerances.wiener_relative(precision)


def test_where_nothing_passes_the_filter_is_zero_with_and_without_noise(device: Device) -> None:
    plan = plan_of(device, SHAPE)
    otf = np.ones(HALF)
    otf[3, 2] = otf[0, 5] = 0
    for nsr in (0.0, 0.1):
        found = plan.from_otf(otf, nsr).download()
        np.testing.assert_array_equal(found == 0, otf == 0)


def test_a_faint_blur_is_inverted_where_its_square_underflows(device: Device) -> None:
    faint = np.complex64(3e-25 - 4e-25j)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        naive = np.conj(faint) / (faint.real * faint.real + faint.imag * faint.imag)
    assert not np.isfinite(naive)
    found = plan_of(device, SHAPE).from_otf(np.full(HALF, faint), 0).download()
    assert error_of(found, 1 / np.full(HALF, complex(faint))) <= tolerances.wiener_relative("float32")


@given(scale=st.floats(1e-6, 1), nsr=st.floats(1e-8, 10), seed=st.integers(0, 99))
def test_the_gain_never_exceeds_half_the_inverse_root_of_the_noise(
    device: Device, scale: float, nsr: float, seed: int
) -> None:
    rows, columns = random_axes(SHAPE, "float32", seed)
    found = plan_of(device, SHAPE).from_otf_axes(scale * rows, columns, nsr).download()
    assert np.abs(found).max() <= 0.5 / np.sqrt(nsr) * (1 + tolerances.wiener_relative("float32"))


def test_the_nyquist_bin_of_each_even_axis_is_made_real(device: Device) -> None:
    rows, columns = random_axes(SHAPE, "float32")
    plan = plan_of(device, SHAPE)
    found = plan.from_otf_axes(rows, columns, 0.1).download()
    rows[6], columns[5] = rows[6].real, columns[5].real
    np.testing.assert_array_equal(found, plan.from_otf_axes(rows, columns, 0.1).download())
    assert found[6, 5].imag == 0
    odd = plan_of(device, SHAPES[1])
    rows, columns = random_axes(SHAPES[1], "float32")
    wanted = reference.wiener(np.outer(rows, columns[:11]), 0.1)
    assert error_of(odd.from_otf_axes(rows, columns, 0.1).download(), wanted) <= tolerances.wiener_relative(
        "float32"
    )


# ---- measured point-spread functions ----------------------------------------------------------------------


@pytest.mark.parametrize("size", [(5, 7), (4, 6), (12, 10), (1, 1)], ids=str)
def test_a_point_in_the_arrays_middle_blurs_nothing(size: tuple[int, int]) -> None:
    psf = np.zeros(size, dtype=np.uint16)
    psf[size[0] // 2, size[1] // 2] = 40_000
    np.testing.assert_allclose(psf_otf(psf, SHAPE), 1, atol=tolerances.eps("float64"))


def test_a_full_size_psf_gives_the_transform_of_itself_shifted_to_the_corner() -> None:
    psf = np.random.default_rng(0).random(SHAPE)
    wanted = np.fft.rfft2(np.fft.ifftshift(psf / psf.sum()))
    np.testing.assert_allclose(
        psf_otf(psf, SHAPE), wanted, atol=tolerances.fft_relative_l2("float64", psf.size)
    )


def test_the_centre_given_is_the_pixel_a_point_stays_at() -> None:
    psf = np.random.default_rng(0).random((3, 4))
    moved = np.zeros((6, 9))
    moved[2:5, 4:8] = psf
    wanted = psf_otf(psf, SHAPE, centre_yx=(2, 1))
    found = psf_otf(moved, SHAPE, centre_yx=(4, 5))
    np.testing.assert_allclose(found, wanted, atol=tolerances.fft_relative_l2("float64", 120))


def test_a_measured_psf_gives_the_filter_of_its_otf(device: Device) -> None:
    psf = np.random.default_rng(0).random((5, 4))
    found = plan_of(device, SHAPE, "float32").from_psf(psf, 0.01).download()
    h = psf_otf(psf, SHAPE)
    largest = np.abs(reference.wiener(h, 0.01)).max()
    assert np.abs(found - reference.wiener(h, 0.01)).max() <= largest * 4 * tolerances.wiener_relative(
        "float32"
    )


# ---- noise fitted to the frame ----------------------------------------------------------------------------


def blurred_noisy(noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a frame of a 1/f^2 scene, its OTF, and the noise-to-signal power that was put in."""
    n = 128
    rng = np.random.default_rng(seed)
    u = OpticalSystem().frequency_axis(n)
    axis = reference.otf_1d(u, 20.0, 5.0)
    axis[n // 2] = axis[n // 2].real
    otf = np.outer(axis, axis[: n // 2 + 1])
    f_squared = np.fft.fftfreq(n)[:, None] ** 2 + np.fft.rfftfreq(n)[None, :] ** 2
    scene = 1 / (f_squared + 1 / n**2)
    white = np.fft.rfft2(rng.normal(size=(n, n)))
    frame = np.fft.irfft2(white * np.sqrt(scene) * otf, s=(n, n)) + noise * rng.normal(size=(n, n))
    return frame, otf, noise**2 / scene


@pytest.mark.parametrize("noise", [0.02, 0.2, 2.0])
def test_the_noise_put_in_is_found_within_a_factor_of_two(noise: float) -> None:
    frame, otf, wanted = blurred_noisy(noise)
    ratio = noise_to_signal(frame, otf, frame.shape) / wanted
    assert 0.5 < ratio.min() <= ratio.max() < 2


def test_the_noise_to_signal_does_not_depend_on_the_units_of_the_frame() -> None:
    frame, otf, _ = blurred_noisy(0.2)
    np.testing.assert_allclose(
        noise_to_signal(1000 * frame + 7, otf, frame.shape),
        noise_to_signal(frame, otf, frame.shape),
        rtol=1e-9,
    )


def test_a_flat_frame_and_a_closed_system_ask_for_no_restoration() -> None:
    flat = np.full((16, 16), 3.0)
    assert noise_to_signal(flat, np.ones((16, 9), complex), (16, 16)).min() > 0
    frame = np.random.default_rng(0).random((16, 16))
    assert np.isfinite(noise_to_signal(frame, np.zeros((16, 9), complex), (16, 16))).all()


# ---- refusals ---------------------------------------------------------------------------------------------


def nan_at(values: np.ndarray) -> np.ndarray:
    spoilt = np.array(values, dtype=float)
    spoilt.flat[0] = np.nan
    return spoilt


@pytest.mark.parametrize(
    ("psf", "options", "said"),
    [
        (np.ones(5), {}, "rows, columns"),
        (np.ones((3, 3), complex), {}, "real"),
        (np.ones((13, 3)), {}, "larger|crop the PSF"),
        (np.ones((3, 11)), {}, "crop the PSF"),
        (np.zeros((3, 3)), {}, "sums to 0"),
        (-np.ones((3, 3)), {}, "sums to -9"),
        (nan_at(np.ones((3, 3))), {}, "NaN"),
        (np.ones((3, 3)), {"centre_yx": (3, 0)}, "centre"),
    ],
)
def test_what_cannot_be_a_psf_is_refused(psf: np.ndarray, options: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        psf_otf(psf, SHAPE, **options)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((np.ones(11), np.ones(10), 0.1), "h_rows"),
        ((np.ones(12), nan_at(np.ones(10)), 0.1), "h_cols"),
        ((np.ones(12), np.ones(10), -0.1), "0 or more"),
        ((np.ones(12), np.ones(10), np.inf), "infinite"),
        ((np.ones(12), np.ones(10), np.ones((12, 10))), "nsr"),
    ],
)
def test_wrong_axes_are_refused(device: Device, arguments: tuple[Any, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        plan_of(device, SHAPE).from_otf_axes(*arguments)


def test_a_wrong_spectrum_a_wrong_target_and_a_wrong_size_are_refused(device: Device) -> None:
    plan = plan_of(device, SHAPE)
    with pytest.raises(InputError, match="otf is"):
        plan.from_otf(np.ones((12, 10)), 0.1)
    with pytest.raises(InputError, match="otf is"):
        plan.from_otf(nan_at(np.ones(HALF)), 0.1)
    with pytest.raises(InputError, match="out is"):
        plan.from_otf(np.ones(HALF), 0.1, out=device.empty(HALF, np.float32))
    with pytest.raises(InputError, match="2 or more"):
        WienerFilter(device, (1, 8))
    with pytest.raises(InputError, match="otf is"):
        noise_to_signal(np.ones((16, 16)), np.ones((16, 16), complex), (16, 16))
    with pytest.raises(InputError, match="NaN"):
        noise_to_signal(nan_at(np.ones((16, 16))), np.ones((16, 9), complex), (16, 16))
