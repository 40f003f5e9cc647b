from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tolerances
from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import InputError, LimitError
from adof_cl.optics import Mask, PupilGrid
from adof_cl.pupil_phase import PupilPhase


def difference_rad(turns: np.ndarray, phase_rad: np.ndarray) -> float:
    """Largest difference modulo a turn."""
    difference = turns - phase_rad / (2 * np.pi)
    return float(2 * np.pi * np.abs(difference - np.rint(difference)).max())


def line_psf(turns: np.ndarray) -> np.ndarray:
    intensity = np.abs(np.fft.fft(np.exp(2j * np.pi * turns.astype(np.float64)), 2 * turns.size)) ** 2
    return intensity / intensity.sum()


def test_all_terms_add_as_the_reference_says(device: Device, precision: str) -> None:
    rows, columns = 13, 22
    rng = np.random.default_rng(1)
    odd_x, odd_y = rng.normal(0, 9, columns), rng.normal(0, 9, rows)
    map_rad = rng.normal(0, 50, (rows, columns))
    plan = PupilPhase(device, rows, columns, precision=precision)
    plan.set_odd(odd_x, odd_y)
    plan.set_map(map_rad)
    turns = plan.evaluate(Mask(53.5, -20.0), tilt_xy_rad=(3.0, -7.0))
    expected = reference.pupil_phase(
        PupilGrid(columns).x,
        PupilGrid(rows).x,
        53.5,
        -20.0,
        tilt_xy_rad=(3.0, -7.0),
        odd_x_rad=odd_x,
        odd_y_rad=odd_y,
        map_rad=map_rad,
    )
    assert difference_rad(turns, expected) <= tolerances.phase_rad(precision) + 300 * tolerances.eps(
        "float64"
    )


def test_removed_terms_leave_no_trace(device: Device) -> None:
    plan = PupilPhase(device, 5, 6)
    before = plan.evaluate(Mask(3.0))
    plan.set_odd(np.ones(6), np.ones(5))
    plan.set_map(np.ones((5, 6)))
    assert not np.array_equal(plan.evaluate(Mask(3.0)), before)
    plan.set_odd()
    plan.set_map(None)
    assert np.array_equal(plan.evaluate(Mask(3.0)), before)


@settings(max_examples=30)
@given(
    alpha=st.floats(-1e5, 1e5),
    psi=st.floats(-1e4, 1e4),
    shape=st.tuples(st.integers(1, 9), st.integers(1, 9)),
)
def test_the_phase_is_a_fraction_of_a_turn_and_loses_nothing_at_any_strength(
    device: Device, alpha: float, psi: float, shape: tuple[int, int]
) -> None:
    turns = PupilPhase(device, *shape).evaluate(Mask(alpha, psi))
    assert np.all((turns >= 0) & (turns < 1))
    x, y = (PupilGrid(n).x if n > 1 else np.zeros(1) for n in shape[::-1])
    # The float64 reference itself rounds the largest term three times.
    limit = tolerances.phase_rad("float32") + 3 * tolerances.eps("float64") * (abs(alpha) + abs(psi)) * 2
    assert difference_rad(turns, reference.pupil_phase(x, y, alpha, psi)) <= limit


def test_a_phase_just_below_zero_wraps_into_the_turn(device: Device) -> None:
    turns = PupilPhase(device, 1, 5).evaluate(Mask(-1e-8))
    assert np.all((turns >= 0) & (turns < 1))


@pytest.mark.parametrize("alpha", [1.0, 53.5, 1e3, 1e4, 1e5])
def test_float32_holds_the_point_spread_function_to_3e_7_up_to_1e5(device: Device, alpha: float) -> None:
    n = 4096
    turns = PupilPhase(device, 1, n).evaluate(Mask(alpha))[0]
    exact = line_psf(alpha * PupilGrid(n).x ** 3 / (2 * np.pi))
    assert np.linalg.norm(line_psf(turns) - exact) <= 3e-7 * np.linalg.norm(exact)


def test_a_plain_float32_product_would_not() -> None:
    n, alpha = 4096, 1e5
    x = PupilGrid(n).x
    naive = np.float32(alpha / (2 * np.pi)) * x.astype(np.float32) ** 3
    exact = line_psf(alpha * x**3 / (2 * np.pi))
    assert np.linalg.norm(line_psf(naive % 1) - exact) > 1e-5 * np.linalg.norm(exact)


def test_terms_and_strengths_that_are_no_numbers_are_refused(device: Device) -> None:
    plan = PupilPhase(device, 4, 5)
    with pytest.raises(InputError, match="x_rad has shape"):
        plan.set_odd(x_rad=np.zeros(4))
    with pytest.raises(InputError, match="y_rad holds NaN"):
        plan.set_odd(y_rad=np.full(4, np.nan))
    with pytest.raises(InputError, match="map_rad has shape"):
        plan.set_map(np.zeros((5, 4)))
    with pytest.raises(InputError, match="tilt_xy_rad is"):
        plan(Mask(), tilt_xy_rad=(np.inf, 0.0))
    with pytest.raises(LimitError, match="alpha is 200000"):
        plan(Mask(2e5))
    with pytest.raises(InputError, match="rows is 0"):
        PupilPhase(device, 0, 5)
