from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tolerances
from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import InputError, LimitError
from adof_cl.optics import OpticalSystem, PupilGrid
from adof_cl.otf import FAMILIES, Otf1d, SeparableMaskOtf, _halves, stationary_phase_otf
from adof_cl.program import Launch, Program

# alpha, psi, u, H to 20 digits, from the error-function form in 50-digit arithmetic.
KNOWN = (
    (53.5, 0.0, 0.44, -0.035549460410834884 + 0.089902973475137998j),
    (53.5, 15.0, 0.44, 0.027595585611440270 + 0.107799604867704688j),
    (53.5, 15.0, 0.77, 0.071629761811891749 - 0.037142960156443345j),
    (53.5, 60.0, 0.44, -0.008630776504543639 - 0.093899301571978673j),
    (53.5, 30.0, 1.2, -0.005487804487703711 - 0.070626726782185862j),
    (0.0, 0.0, 0.44, 0.78 + 0j),
)

# Where formulas break: zero, the cut-off, just inside and beyond it, tiny, and a spread of ordinary values.
U = np.concatenate(
    [
        [0.0, 1e-300, 1e-12, 1e-7, 1e-4, 1.0, 2.0, np.nextafter(2.0, 0), np.nextafter(2.0, 3), 2.5, 1e6],
        2 - np.array([1e-9, 1e-6, 1e-3]),
        np.linspace(-1.97, 1.99, 83),
    ]
)
U = np.concatenate([U, -U])

signs = st.sampled_from([1.0, -1.0])
strengths = st.one_of(
    st.just(0.0),
    st.floats(-3, 5).map(lambda power: 10**power),
    st.sampled_from([1e-3, 0.1, 1.0, 53.5, 1e3, 1e4, 1e5]),
)
defoci = st.one_of(st.floats(0, 500), st.floats(-6, 2).map(lambda power: 10**power))

Plans = dict[tuple[str, str], Otf1d]


@pytest.fixture(scope="module")
def plans(device: Device) -> Plans:
    kinds = ["float32", "float64"] if device.facts.fp64 else ["float32"]
    return {
        (kind, family): Otf1d(device, U, precision=kind, family=family)
        for kind in kinds
        for family in FAMILIES
    }


@pytest.mark.parametrize(("alpha", "psi", "u", "expected"), KNOWN)
def test_the_reference_gives_the_known_values(alpha: float, psi: float, u: float, expected: complex) -> None:
    assert abs(complex(reference.otf_1d(u, alpha, psi)) - expected) < 1e-13


@pytest.mark.parametrize(("alpha", "psi", "u", "expected"), KNOWN)
def test_the_device_gives_the_known_values(
    device: Device, precision: str, alpha: float, psi: float, u: float, expected: complex
) -> None:
    value = Otf1d(device, np.array([u]), precision=precision).evaluate(alpha, psi)[0]
    assert abs(complex(value) - expected) < tolerances.otf_error(precision, alpha)


@pytest.mark.parametrize(("alpha", "psi"), [(0.6, 3.0), (5.0, 60.0), (53.5, 15.0), (400.0, 150.0)])
def test_both_routes_of_the_reference_agree(alpha: float, psi: float) -> None:
    w = np.linspace(0.3, 1.5, 25)
    closed = reference._otf_1d_closed(w, alpha, psi)
    summed = reference._otf_1d_quadrature(w, alpha, psi)
    # The closed form loses eps times its largest phase, docs/maths.md eq. O2.
    largest = psi**2 * w / (3 * alpha) + 3 * alpha * w * (1 + psi / (3 * alpha)) ** 2
    assert np.all(np.abs(closed - summed) < 1e-14 + tolerances.eps("float64") * largest)


@settings(max_examples=60)
@given(alpha=strengths, psi=defoci, sign=signs, side=signs)
def test_the_device_agrees_with_the_reference_for_every_strength_and_defocus(
    plans: Plans, alpha: float, psi: float, sign: float, side: float
) -> None:
    expected = reference.otf_1d(U, sign * alpha, side * psi)
    for (kind, _), plan in plans.items():
        error = np.abs(plan.evaluate(sign * alpha, side * psi) - expected)
        assert error.max() <= tolerances.otf_error(kind, alpha)


@pytest.mark.parametrize("alpha", [1e-3, 0.37, 20.0, 1e3])
def test_the_device_is_accurate_where_the_stationary_point_crosses_the_overlaps_end(
    plans: Plans, alpha: float
) -> None:
    # q = c b: psi = 3 alpha b, for every u in turn, and its nearest neighbours on both sides.
    for u in np.linspace(0.05, 1.9, 12):
        psi = 3 * alpha * (1 - u / 2)
        for near in (psi, psi * (1 + 1e-6), psi * (1 - 1e-6)):
            if near > 150:
                continue
            for (kind, _), plan in plans.items():
                error = np.abs(plan.evaluate(alpha, near) - reference.otf_1d(U, alpha, near))
                assert error.max() <= tolerances.otf_error(kind, alpha)


@pytest.mark.parametrize("alpha", [0.0, 1.0, 20.0, 53.5, 100.0, 1e3, 1e4])
def test_errors_stay_below_what_is_promised(plans: Plans, alpha: float) -> None:
    promised = {"float32": 4e-7, "float64": 5e-14}
    for psi in (0.0, 1.0, 15.0, 60.0, 135.0, 150.0):
        expected = reference.otf_1d(U, alpha, psi)
        for (kind, family), plan in plans.items():
            assert np.abs(plan.evaluate(alpha, psi) - expected).max() < promised[kind], (kind, family, psi)


@pytest.mark.parametrize("vector_bytes", [16, 32, 64])
@pytest.mark.parametrize("samples", [3, 30, 65])
def test_vectors_of_every_width_give_the_same(
    device: Device, monkeypatch: pytest.MonkeyPatch, precision: str, vector_bytes: int, samples: int
) -> None:
    monkeypatch.setattr(device, "vector_bytes", vector_bytes)
    u = 3.5 * np.concatenate([np.fft.fftfreq(samples), np.fft.fftfreq(samples + 1)])
    found = Otf1d(device, u, precision=precision, family="lanes").evaluate(35.0, -70.0)
    assert np.abs(found - reference.otf_1d(u, 35.0, -70.0)).max() <= tolerances.otf_error(precision, 35.0)


_TURNS = """
#include "turns.h"
__kernel void turns_check(__global const real2 *turns, __global const real2 *halves, __global real *beyond,
                          __global cplx *wave)
{
    const int i = get_global_id(0);
    turns_factor a;
    turns_split(turns[i], &a);
    beyond[i] = turns_product(a, halves[i].x, halves[i].y);
    cvec w;
    turns_wave(turns[i].x, &w);
    wave[i] = (cplx)(w.re, w.im);
}
"""


def test_whole_turns_are_dropped_before_anything_is_rounded(device: Device, precision: str) -> None:
    real = np.dtype(precision)
    rng = np.random.default_rng(5)
    turns = np.concatenate([[0.0, 0.25, 0.5, 0.75, 1.0, 1e5], rng.uniform(-1.6e4, 1.6e4, 2000)])
    factors = np.concatenate([[1.0, 2.0, 0.5], rng.uniform(0, 2, turns.size - 3)])
    hi = turns.astype(real)
    bits = 12 if precision == "float32" else 26
    coarse, _ = _halves(factors, real)
    split = [np.stack(pair, axis=1).astype(real) for pair in ((hi, turns - hi), (coarse, factors - coarse))]
    beyond, wave = (
        device.empty(turns.shape, real),
        device.empty(turns.shape, np.result_type(real, np.complex64)),
    )
    program = Program(
        device,
        "precision.h",
        {"REAL_IS_DOUBLE": precision == "float64"},
        generated=("turns_check.cl", _TURNS),
    )
    program.launch("turns_check", turns.shape, None, *map(device.upload, split), beyond, wave)()
    wide = np.longdouble
    product = turns.astype(wide) * factors.astype(wide)

    def off(found: np.ndarray) -> np.ndarray:
        apart = found.astype(wide) - product
        return np.abs(apart - np.rint(apart))

    # Eq. P3: the fraction is rounded as a number near 1; the rest, 4/2^bits of the product, three times.
    limit = tolerances.eps(precision) * (1 + 3 * 2.0 ** (2 - bits) * np.abs(product))
    assert np.all(off(beyond.download()) <= limit)
    naive = hi * factors.astype(real)
    assert off(naive).max() > 50 * limit.max()

    angle = 2 * np.arctan2(wide(0), wide(-1)) * (hi - np.rint(hi)).astype(wide)
    exact = (np.cos(angle) + 1j * np.sin(angle)).astype(np.complex128)
    apart = wave.download() - exact
    # Eq. P4: r^2 <= 1/16 and what it is last multiplied with, at most 20, are rounded, then their product and
    # sum: 2 * 20/16 + 2 halves of eps.
    assert max(np.abs(apart.real).max(), np.abs(apart.imag).max()) <= 2.25 * tolerances.eps(precision)


def test_lists_that_only_look_like_an_axis_are_evaluated_in_full(device: Device) -> None:
    u = 3.5 * np.fft.fftfreq(21)
    wanted = reference.otf_1d(u, 20.0, 5.0)
    gain = np.ones(21)
    gain[17] = 0.5  # its mirror image has another
    found = Otf1d(device, u, gain=gain).evaluate(20.0, 5.0)
    assert np.abs(found - wanted * gain).max() <= tolerances.otf_error("float32", 20.0)
    bent = u.copy()
    bent[17] *= 1.25
    found = Otf1d(device, bent).evaluate(20.0, 5.0)
    assert np.abs(found - reference.otf_1d(bent, 20.0, 5.0)).max() <= tolerances.otf_error("float32", 20.0)


@pytest.mark.parametrize(("pairs", "launches"), [(1, 1), (56, 1), (57, 2)])
def test_many_pairs_are_one_launch(
    device: Device, monkeypatch: pytest.MonkeyPatch, pairs: int, launches: int
) -> None:
    plan = Otf1d.for_frame(device, OpticalSystem(), (24, 17), pairs=pairs)
    wanted = [(20.0 + k, k - 30.0) for k in range(pairs)]
    counted: list[Launch] = []
    enqueue = Launch.__call__

    def count(self: Launch) -> object:
        counted.append(self)
        return enqueue(self)

    monkeypatch.setattr(Launch, "__call__", count)
    found = plan(wanted).download()
    assert len(counted) == launches
    for row in (0, pairs - 1):
        assert np.abs(found[row] - _of_frame(OpticalSystem(), (24, 17), wanted[row])).max() <= 3e-6


def _of_frame(optics: OpticalSystem, shape: tuple[int, ...], pair: tuple[float, float]) -> np.ndarray:
    axes = []
    for n in shape:
        axis = reference.otf_1d(optics.frequency_axis(n), *pair) * optics.pixel_otf_axis(n)
        if n % 2 == 0:
            axis[n // 2] = axis[n // 2].real
        axes.append(axis)
    return np.concatenate(axes)


def test_the_textbook_closed_form_would_fail_in_float32() -> None:
    from scipy.special import fresnel

    u, alpha, psi = np.float32(0.1), np.float32(1e-3), np.float32(60)
    b, x0 = 1 - u / 2, psi / (3 * alpha)
    k = np.sqrt(6 * alpha * u / np.float32(np.pi))
    s_high, c_high = fresnel(np.float32(k * (b + x0)))
    s_low, c_low = fresnel(np.float32(k * (x0 - b)))
    phase = np.float32(alpha * u**3 / 4 - psi**2 * u / (3 * alpha))
    textbook = np.exp(1j * phase) / (2 * k) * (c_high - c_low + 1j * (s_high - s_low))
    assert abs(textbook - complex(reference.otf_1d(0.1, 1e-3, 60.0))) > 1e-4


@settings(max_examples=20)
@given(alpha=strengths, psi=defoci)
def test_symmetries_hold_to_the_last_bit(plans: Plans, alpha: float, psi: float) -> None:
    half = U.size // 2
    for plan in plans.values():
        h = plan.evaluate(alpha, psi)
        assert np.array_equal(h[half:], h[:half].conj())  # H(-u) = conj H(u)
        assert np.array_equal(plan.evaluate(-alpha, psi), h.conj()) or alpha == 0
        assert np.array_equal(plan.evaluate(alpha, -psi), h)


@settings(max_examples=20)
@given(alpha=strengths, psi=defoci)
def test_no_mask_passes_more_than_the_diffraction_limit(plans: Plans, alpha: float, psi: float) -> None:
    limit = np.maximum(1 - np.abs(U) / 2, 0)
    for (kind, _), plan in plans.items():
        h = plan.evaluate(alpha, psi)
        assert abs(complex(h[0]) - 1) <= tolerances.otf_error(kind, alpha)
        assert np.all(np.abs(h) <= limit + tolerances.otf_error(kind, alpha))
        assert np.all(h[np.abs(U) >= 2] == 0)


def test_defocus_shifts_a_coded_image_as_predicted() -> None:
    optics = OpticalSystem()
    alpha, psi, u = 500.0, 150.0, np.linspace(0.2, 0.6, 40)
    slope = np.unwrap(np.angle(reference.otf_1d(u, alpha, psi) / reference.otf_1d(u, alpha, 0.0)))
    pixels = -np.polyfit(u, slope, 1)[0] / (2 * np.pi)
    pixels *= 2 * optics.wavelength_um * optics.f_number / optics.object_pitch_um
    # Edge ripple of relative size 0.225 (1/w+ + 1/w-) < 0.03 moves the phase by as much.
    assert pixels == pytest.approx(optics.shift_px(alpha, psi), rel=0.05)


@pytest.mark.parametrize("count", [3, 20])
def test_several_pairs_in_one_call_equal_one_by_one(device: Device, precision: str, count: int) -> None:
    pairs = [(53.5 / 1.3**k, 15.0 * (k % 3 - 1)) for k in range(count - 1)] + [(0.0, 0.0)]
    together = Otf1d(device, U, pairs=count, precision=precision)(pairs).download()
    alone = Otf1d(device, U, precision=precision)
    for row, pair in zip(together, pairs, strict=True):
        assert np.array_equal(row, alone.evaluate(*pair))


@pytest.mark.parametrize("samples", [1, 2, 7, 64, 131])
def test_a_camera_axis_maps_real_images_to_real_images(device: Device, precision: str, samples: int) -> None:
    optics = OpticalSystem()
    otf = Otf1d.for_camera(device, optics, samples, precision=precision).evaluate(53.5, 30.0)
    expected = reference.otf_1d(optics.frequency_axis(samples), 53.5, 30.0) * np.sinc(np.fft.fftfreq(samples))
    if samples % 2 == 0:
        assert otf[samples // 2].imag == 0
        expected[samples // 2] = expected[samples // 2].real
    assert np.abs(otf - expected).max() <= tolerances.otf_error(precision, 53.5)
    psf = np.fft.ifft(otf.astype(np.complex128))
    assert np.abs(psf.imag).max() <= tolerances.eps(precision)


def test_no_kernel_of_the_optics_asks_for_doubles_in_float32() -> None:
    folder = Path(__file__).parents[1] / "kernels"
    names = ["otf.cl", "psf.cl", "pupil_phase.cl", "slm_encode.cl", "fresnel.h", "two_term.h", "stockham.h"]
    for name in [*names, "phase_turns.h", "turns.h"]:
        code = re.sub(r"//.*", "", (folder / name).read_text())
        code = re.sub(r"REAL_C\([^()]*\)", "", code)
        assert not re.search(r"\bdouble\b|\d\.\d|\d[eE][-+]?\d", code), name


@pytest.mark.parametrize(
    ("alpha", "psi", "refusal", "word"),
    [
        (np.nan, 0.0, InputError, "alpha is nan"),
        (0.0, np.inf, InputError, "psi is inf"),
        (1.1e5, 0.0, LimitError, "at most 100000"),
        (0.0, -1.1e4, LimitError, "at most 10000"),
    ],
)
def test_strengths_beyond_the_measured_range_are_refused(
    device: Device, alpha: float, psi: float, refusal: type[Exception], word: str
) -> None:
    with pytest.raises(refusal, match=word):
        Otf1d(device, U).evaluate(alpha, psi)


@pytest.mark.parametrize("u", [np.array([np.nan]), np.array([np.inf]), np.zeros((2, 2)), np.zeros(0)])
def test_frequencies_that_are_no_list_of_numbers_are_refused(device: Device, u: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"u .*(wanted)"):
        Otf1d(device, u)


def test_a_gain_of_another_length_and_a_wrong_count_of_pairs_are_refused(device: Device) -> None:
    with pytest.raises(InputError, match="gain has shape"):
        Otf1d(device, U, gain=np.ones(3))
    with pytest.raises(InputError, match="pairs is 0"):
        Otf1d(device, U, pairs=0)
    with pytest.raises(InputError, match="pairs has shape"):
        Otf1d(device, U, pairs=2)([(1.0, 0.0)])
    with pytest.raises(InputError, match="precision"):
        Otf1d(device, U, precision="half")
    with pytest.raises(InputError, match="family is 'warps'"):
        Otf1d(device, U, family="warps")


def test_a_refused_pair_leaves_the_result_as_it_was(device: Device) -> None:
    plan = Otf1d(device, U, pairs=2)
    before = plan([(20.0, 5.0), (30.0, 0.0)]).download()
    with pytest.raises(LimitError):
        plan([(1.0, 0.0), (2e5, 0.0)])
    assert np.array_equal(plan.out.download(), before)


# ---- other separable masks --------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [2, 16, 256])
def test_the_transform_route_is_the_autocorrelation_of_the_cells(
    device: Device, precision: str, samples: int
) -> None:
    plan = SeparableMaskOtf(device, samples, precision=precision)
    profile = 0.4 * plan.x * np.exp(plan.x**2)
    error = np.abs(plan.evaluate(profile) - reference.otf_of_profile(profile))
    assert error.max() <= tolerances.fft_relative_l2(precision, 2 * samples)


@pytest.mark.parametrize(("alpha", "psi"), [(0.0, 0.0), (53.5, 15.0), (5.0, 5.0)])
def test_the_transform_route_meets_the_exact_form_at_the_grids_error(
    device: Device, alpha: float, psi: float
) -> None:
    plan = SeparableMaskOtf(device, 1024)
    profile = alpha * plan.x**3 + psi * plan.x**2
    limit = tolerances.otf_grid_error(alpha, psi, 1024) + tolerances.otf_error("float32", alpha)
    assert np.abs(plan.evaluate(profile) - reference.otf_1d(plan.u, alpha, psi)).max() <= limit
    u = np.array([-2.0, -0.4401, -0.003, 0.0, 0.1003, 1.7777, 2.0, 3.0])
    assert np.abs(plan.evaluate(profile, u) - reference.otf_1d(u, alpha, psi)).max() <= limit


def test_profiles_that_step_too_far_or_do_not_fit_are_refused(device: Device) -> None:
    plan = SeparableMaskOtf(device, 64)
    with pytest.raises(LimitError, match="plan at least"):
        plan(100 * PupilGrid(64).x ** 3)
    with pytest.raises(InputError, match="profile_rad has shape"):
        plan(np.zeros(63))
    with pytest.raises(InputError, match="NaN"):
        plan(np.full(64, np.nan))
    with pytest.raises(InputError, match="power of two"):
        SeparableMaskOtf(device, 100)


# ---- the paper's Eq. 2 ----


@pytest.mark.parametrize(
    ("alpha", "psi", "u", "completed", "as_printed"),
    [  # relative errors measured for the physics note, section 2
        (20.0, 0.0, 0.44, 0.13, 0.85),
        (53.5, 0.0, 0.1, 0.13, 0.68),
        (53.5, 15.0, 0.77, 0.01, 0.30),
        (53.5, 60.0, 0.44, 0.12, 2.1),
        (500.0, 60.0, 1.2, 0.02, 1.7),
    ],
)
def test_the_papers_approximation_is_off_by_what_was_measured(
    alpha: float, psi: float, u: float, completed: float, as_printed: float
) -> None:
    exact = reference.otf_1d([u], alpha, psi)[0]
    for wanted, printed in ((completed, False), (as_printed, True)):
        found = stationary_phase_otf(np.array([u]), alpha, psi, as_printed=printed)[0]
        off = abs(found - exact) / abs(exact)
        rounding = 0.5 * 10 ** -(1 if wanted >= 1 else 2)  # the figures have two digits
        assert off == pytest.approx(wanted, abs=rounding * 1.02)


def test_the_completed_approximation_converges_as_the_mask_grows() -> None:
    u = np.array([0.3, -0.3])
    errors = [
        np.abs(stationary_phase_otf(u, a, 5.0) / reference.otf_1d(u, a, 5.0) - 1).max() for a in (1e2, 1e4)
    ]
    assert errors[1] < errors[0] / 5  # as 1/sqrt(alpha): tenfold, with ripple


def test_the_approximation_is_one_at_zero_and_nothing_beyond_the_cut_off() -> None:
    found = stationary_phase_otf(np.array([0.0, 2.5]), -53.5, 15.0)
    assert found.tolist() == [1, 0]


def test_the_approximation_without_a_mask_is_refused() -> None:
    with pytest.raises(InputError, match="exact form"):
        stationary_phase_otf(np.array([0.4]), 0.0)
