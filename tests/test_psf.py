from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tolerances
from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import InputError, LimitError
from adof_cl.optics import Mask, OpticalSystem, PupilGrid, SlmPanel
from adof_cl.psf import Psf, require_sampling, samples_for, stop_amplitude
from adof_cl.pupil_phase import PupilPhase

OPTICS = OpticalSystem()


def transforms(
    device: Device, samples: int, alpha: float, psi: float, **options: object
) -> tuple[np.ndarray, np.ndarray, Psf]:
    plan = Psf(device, samples, **options)  # type: ignore[arg-type] # forwarded as they come
    precision = str(options.get("precision", "float32"))
    turns = PupilPhase(device, samples, samples, precision=precision)(Mask(alpha, psi))
    psf, otf = plan(turns, alpha_rad=alpha, psi_rad=psi)
    return psf.download(), otf.download(), plan


@pytest.mark.parametrize(("samples", "padding"), [(2, 2), (16, 4), (128, 2)])
@pytest.mark.parametrize("stop", ["square", "round"])
def test_both_transforms_agree_with_the_reference(
    device: Device, precision: str, samples: int, padding: int, stop: str
) -> None:
    psf, otf, plan = transforms(device, samples, 0.4, -0.3, stop=stop, padding=padding, precision=precision)
    x = PupilGrid(samples).x
    phase = reference.pupil_phase(x, x, 0.4, -0.3)
    amplitude = stop_amplitude(stop, samples)
    expected_psf, expected_otf = reference.psf_of_pupil(phase, amplitude, padded=plan.size)
    limit = tolerances.fft_relative_l2(precision, plan.size**2)
    assert np.linalg.norm(psf - expected_psf) <= limit * np.linalg.norm(expected_psf)
    assert np.linalg.norm(otf - expected_otf) <= limit * np.linalg.norm(expected_otf)


@settings(max_examples=12)
@given(alpha=st.floats(-20, 20), psi=st.floats(-20, 20), stop=st.sampled_from(["square", "round"]))
def test_the_psf_sums_to_one_and_transforms_to_the_otf(
    device: Device, alpha: float, psi: float, stop: str
) -> None:
    psf, otf, plan = transforms(device, 128, alpha, psi, stop=stop)
    limit = tolerances.fft_relative_l2("float32", plan.size**2)
    assert psf.min() >= 0
    assert abs(psf.sum(dtype=np.float64) - 1) <= limit
    assert np.abs(np.fft.fft2(psf.astype(np.float64)) - otf).max() <= limit
    assert abs(complex(otf[0, 0]) - 1) <= limit


@pytest.mark.parametrize(("alpha", "psi"), [(20.0, -10.0), (-30.0, 15.0)])
def test_a_square_stop_gives_the_exact_forms_outer_product_at_the_grids_error(
    device: Device, alpha: float, psi: float
) -> None:
    _, otf, plan = transforms(device, 256, alpha, psi)
    h = reference.otf_1d(plan.u, alpha, psi)
    # |h| <= 1, so the product errs by at most twice one axis' error.
    assert np.abs(otf - np.outer(h, h)).max() <= 2 * tolerances.otf_grid_error(alpha, psi, 256)


def test_a_positive_cubic_throws_its_tail_to_negative_x_and_y_and_defocus_its_corner_to_positive(
    device: Device,
) -> None:
    alpha, psi = 20.0, 30.0
    psf, _, plan = transforms(device, 256, alpha, psi)
    s = np.fft.fftfreq(plan.size) * plan.samples
    row, column = np.unravel_index(np.argmax(psf), psf.shape)
    corner = psi**2 / (3 * alpha * math.pi)  # s = X/(lambda N): docs/maths.md, eq. O7
    assert s[row] == s[column]
    # The caustic's maximum lies inside the corner by about (3 alpha)^(1/3)/pi Airy units.
    assert corner - 1.5 * (3 * alpha) ** (1 / 3) / math.pi < s[column] < corner
    held = np.abs(s) <= 60
    assert (psf.sum(axis=0) * s)[held].sum() < 0 < s[column]


def test_a_round_stop_meets_the_exact_form_on_its_axis(device: Device) -> None:
    alpha, psi, samples = 20.0, -10.0, 512
    _, otf, plan = transforms(device, samples, alpha, psi, stop="round")
    nodes, weights = np.polynomial.legendre.leggauss(2000)
    worst = 0.0
    for j in range(1, samples, 23):
        u = plan.u[j]
        x = (1 - u / 2) * nodes
        kernel = np.sqrt(1 - (np.abs(x) + u / 2) ** 2) * np.exp(1j * (3 * alpha * u * x**2 + 2 * psi * u * x))
        exact = 2 / np.pi * np.exp(1j * alpha * u**3 / 4) * (1 - u / 2) * (weights @ kernel)
        worst = max(worst, abs(complex(otf[0, j]) - exact))
    # A rim that follows whole cells leaves an area error like n^(-3/2).
    assert worst <= samples**-1.5 + tolerances.otf_grid_error(alpha, psi, samples)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(("alpha", "psi"), [(53.5, 15.0), (100.0, 60.0), (5.0, 5.0)])
def test_prysm_agrees_with_ours_to_rounding_and_with_the_exact_form_at_its_grid_error(
    device: Device, alpha: float, psi: float
) -> None:
    from prysm.propagation import focus

    samples = 512
    psf, otf, plan = transforms(device, samples, alpha, psi)
    x = PupilGrid(samples).x
    pupil = np.exp(1j * reference.pupil_phase(x, x, alpha, psi))
    theirs = np.abs(np.fft.ifftshift(focus(pupil, 2))) ** 2
    theirs /= theirs.sum()
    # prysm's forward kernel gives the conjugate of our transfer function, once and for all.
    their_otf = np.fft.fft2(theirs).conj()
    assert np.abs(otf - their_otf).max() <= tolerances.fft_relative_l2("float32", plan.size**2)
    error = np.abs(their_otf[0] - reference.otf_1d(plan.u, alpha, psi)).max()
    limit = tolerances.otf_grid_error(alpha, psi, samples)
    assert 0.1 * limit < error < limit
    assert psf.shape == theirs.shape


@pytest.mark.parametrize("shape", [(48, 60), (31, 64)])
def test_camera_frequencies_meet_the_separable_route(device: Device, shape: tuple[int, int]) -> None:
    alpha, psi, samples = 20.0, -10.0, 256
    _, _, plan = transforms(device, samples, alpha, psi)
    axes = []
    for n in shape:
        h = reference.otf_1d(OPTICS.frequency_axis(n), alpha, psi) * OPTICS.pixel_otf_axis(n)
        if n % 2 == 0:
            h[n // 2] = h[n // 2].real
        axes.append(h)
    otf = plan.camera_otf(OPTICS, shape)
    assert np.abs(otf - np.outer(*axes)).max() <= 2 * tolerances.otf_grid_error(alpha, psi, samples)
    assert np.abs(np.fft.ifft2(otf).imag).max() <= 4 * tolerances.eps("float64")


def test_a_panel_shows_each_cell_the_pixel_over_it(device: Device) -> None:
    samples, optics = 16, OpticalSystem(aperture_um=750.0)
    panel = SlmPanel("test", 8, 9, pitch_um=100.0, fill_factor=1.0, frame_rate_hz=60.0, stroke_rad=5.0)
    rng = np.random.default_rng(3)
    codes = rng.integers(0, 256, (8, 9), dtype=np.uint8)
    smooth = rng.random((samples, samples)).astype(np.float32)
    plan = Psf(device, samples)
    turns = plan.panel_turns(device.upload(codes), device.upload(smooth), panel, optics).download()
    for row in range(samples):
        for column in range(samples):
            y, x = ((2 * i + 1 - samples) / samples * 375.0 for i in (row, column))
            code = codes[math.floor(y / 100 + 4), math.floor(x / 100 + 4.5)]
            expected = (smooth[row, column] + code / 255 * 5.0 / (2 * math.pi)) % 1
            apart = abs(turns[row, column] - expected)
            assert min(apart, 1 - apart) <= 4 * tolerances.eps("float32")


def test_a_finer_panel_comes_closer_to_the_smooth_mask(device: Device) -> None:
    from adof_cl.slm_encode import SlmEncode

    alpha, samples, optics = 20.0, 256, OpticalSystem(aperture_um=10_000.0)
    smooth_psf, _, plan = transforms(device, samples, alpha, 0.0)
    nothing = PupilPhase(device, samples, samples)(Mask())
    errors = []
    for pixels in (64, 128, 256):
        panel = SlmPanel("test", pixels, pixels, optics.aperture_um / pixels, 1.0, 60.0)
        codes = SlmEncode(device, panel, optics)(Mask(alpha))
        psf, _ = plan(plan.panel_turns(codes, nothing, panel, optics), alpha_rad=alpha)
        errors.append(float(np.linalg.norm(psf.download() - smooth_psf) / np.linalg.norm(smooth_psf)))
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[2] < 0.02  # one cell per pixel: only the codes' rounding, 10 mrad rms, remains


def test_a_pupil_too_coarse_for_its_phase_is_refused_and_the_limit_named(device: Device) -> None:
    wanted = math.ceil(PupilGrid.nyquist_samples(100.0, 0.0))
    with pytest.raises(LimitError, match=f"at least {wanted} are needed"):
        transforms(device, 128, 100.0, 0.0)
    require_sampling(wanted, 100.0, 0.0)
    with pytest.raises(LimitError, match="use the separable route"):
        samples_for(1e4, 0.0)
    assert samples_for(0.0, 0.0) == 128
    assert samples_for(53.5, 127.0) == 1024


@pytest.mark.parametrize(
    ("options", "refusal", "word"),
    [
        ({"samples": 100}, InputError, "powers of two"),
        ({"samples": 64, "padding": 1}, InputError, "powers of two"),
        ({"samples": 64, "padding": 3}, InputError, "powers of two"),
        ({"samples": 8192}, LimitError, "at most 4096"),
        ({"samples": 64, "stop": "oval"}, InputError, "choose 'square' or 'round'"),
        ({"samples": 64, "stop": np.ones((3, 3))}, InputError, "stop has shape"),
        ({"samples": 4, "stop": np.zeros((4, 4))}, InputError, "lets no light through"),
        ({"samples": 4, "stop": np.full((4, 4), np.nan)}, InputError, "NaN"),
    ],
)
def test_stops_that_cannot_be_are_refused(
    device: Device, options: dict[str, object], refusal: type[Exception], word: str
) -> None:
    with pytest.raises(refusal, match=word):
        Psf(device, **options)  # type: ignore[arg-type] # each is wrong on purpose


def test_phases_and_codes_that_do_not_fit_are_refused(device: Device) -> None:
    plan = Psf(device, 16)
    with pytest.raises(InputError, match="turns are"):
        plan(device.empty((8, 8), np.float32))
    panel = SlmPanel("test", 8, 9, 100.0, 1.0, 60.0)
    smooth = device.upload(np.zeros((16, 16), np.float32))
    with pytest.raises(InputError, match="codes are"):
        plan.panel_turns(device.empty((8, 8), np.uint8), smooth, panel, OpticalSystem(aperture_um=700.0))
    with pytest.raises(LimitError, match="at least one cell per pixel"):
        plan.panel_turns(device.empty((8, 9), np.uint8), smooth, panel, OpticalSystem(aperture_um=1700.0))
