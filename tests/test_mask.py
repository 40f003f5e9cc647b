from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import InputError, LimitError
from adof_cl.mask import (
    PAPER_POINTS,
    PAPER_RESOLUTION,
    Calibration,
    ModelCalibration,
    PaperCalibration,
    choose_mask,
    depth_margin_um,
    depth_to_cover_um,
    filter_quality,
)
from adof_cl.optics import Mask, OpticalSystem
from adof_cl.restore import Restore

OPTICS = OpticalSystem()
PAPER = PaperCalibration()
MODEL = ModelCalibration()
both = pytest.mark.parametrize("calibration", [PAPER, MODEL], ids=["paper", "model"])
depths = st.floats(0, 30_000)


@pytest.mark.parametrize(("name", "depth_um", "alpha"), PAPER_POINTS)
def test_the_papers_calibration_goes_through_its_points(name: str, depth_um: float, alpha: float) -> None:
    # The quadratic fits all five to 0.012 rad.
    assert PAPER.alpha_rad(depth_um) == pytest.approx(alpha, abs=0.0125), name


@both
@given(shallow=depths, deep=depths)
def test_strength_never_falls_with_depth_and_is_never_negative(
    calibration: Calibration, shallow: float, deep: float
) -> None:
    shallow, deep = sorted((shallow, deep))
    assert 0 <= calibration.alpha_rad(shallow) <= calibration.alpha_rad(deep)


@both
@given(depth=depths)
def test_the_chosen_strength_covers_the_depth_as_far_as_any_does(
    calibration: Calibration, depth: float
) -> None:
    covered = calibration.depth_um(calibration.alpha_rad(depth))
    if calibration.covers(depth):
        assert covered >= depth * (1 - 1e-9)


@both
@given(weak=st.floats(0, 300), strong=st.floats(0, 300))
def test_a_stronger_mask_never_covers_less(calibration: Calibration, weak: float, strong: float) -> None:
    weak, strong = sorted((weak, strong))
    assert calibration.depth_um(weak) <= calibration.depth_um(strong)


def test_the_models_crossing_is_the_last_one_of_the_exact_contrast() -> None:
    u = OPTICS.normalised_frequency(0.020)
    pixel = np.sinc(0.020 * OPTICS.object_pitch_um)
    psi = np.arange(0, 400, 0.25)
    for alpha in (MODEL._alpha[0], MODEL._alpha[150], MODEL._alpha[400]):
        contrast = [abs(complex(reference.otf_1d(u, float(alpha), float(p)))) * pixel for p in psi]
        last = psi[np.flatnonzero(np.array(contrast) >= MODEL.threshold)[-1]]
        # The envelope may only add to it.
        assert OPTICS.psi_rad(MODEL.depth_um(float(alpha))) >= last - 0.25
    assert MODEL.depth_um(0.0) == pytest.approx(951, abs=5)
    assert OPTICS.psi_rad(MODEL.depth_um(0.0)) == pytest.approx(
        float(
            psi[
                np.flatnonzero(
                    np.abs(np.sinc(2 * psi * u * (1 - u / 2) / np.pi)) * (1 - u / 2) * pixel >= 0.09
                )[-1]
            ]
        ),
        abs=0.25,
    )


def test_a_dip_in_the_crossings_does_not_make_a_stronger_mask_cover_less() -> None:
    class Dipping(ModelCalibration):
        def _last_crossings(self, u: float) -> tuple[np.ndarray, np.ndarray]:
            alpha, psi = super()._last_crossings(u)
            psi[200:260] = psi[180]
            return alpha, psi

    dipping = Dipping()
    depth_um = [dipping.depth_um(float(alpha)) for alpha in dipping._alpha]
    assert np.all(np.diff(depth_um) >= 0)
    assert dipping.depth_um(float(dipping._alpha[230])) == MODEL.depth_um(float(MODEL._alpha[199]))


def test_the_models_contrast_is_the_exact_one() -> None:
    for alpha, psi, lp_per_mm in (
        (0.0, 0.0, 53.0),
        (53.5, 60.0, 20.0),
        (100.0, 3.0, 35.0),
        (0.01, 90.0, 20.0),
    ):
        u = OPTICS.normalised_frequency(lp_per_mm / 1000)
        exact = abs(complex(reference.otf_1d(u, alpha, psi))) * np.sinc(lp_per_mm / 1000 * 7.4)
        assert MODEL.contrast(alpha, psi, lp_per_mm) == pytest.approx(float(exact), abs=1e-12)


def test_the_model_comes_near_the_papers_figures() -> None:
    # One threshold for Figs 3 and 4: within a fifth of each strength it needs, 3 line pairs of each end.
    for _, depth, alpha in PAPER_POINTS[:4]:
        assert MODEL.alpha_rad(depth) == pytest.approx(alpha, rel=0.2)
    for alpha, lp_per_mm in PAPER_RESOLUTION:
        assert MODEL.resolution_lp_per_mm(alpha) == pytest.approx(lp_per_mm, abs=3)


def test_below_the_native_depth_of_field_no_mask_is_needed() -> None:
    assert PAPER.alpha_rad(717.0) == PAPER.alpha_rad(0.0) == 0.0
    assert MODEL.alpha_rad(900.0) == 0.0


@both
@given(near=st.floats(-3000, 3000), extent=st.floats(0, 4000))
def test_moving_the_focus_to_the_middle_never_needs_a_stronger_mask(
    calibration: Calibration, near: float, extent: float
) -> None:
    alone = choose_mask(near, near + extent, calibration, OPTICS)
    joint = choose_mask(near, near + extent, calibration, OPTICS, joint=True)
    assert joint.alpha_rad <= alone.alpha_rad
    assert alone.focus_psi_rad == 0
    ends = joint.psi_rad(OPTICS, near), joint.psi_rad(OPTICS, near + extent)
    assert ends[0] == pytest.approx(-ends[1], abs=1e-9)


@both
def test_a_single_depth_needs_no_mask_once_it_is_in_focus(calibration: Calibration) -> None:
    mask = choose_mask(3000.0, 3000.0, calibration, OPTICS, joint=True)
    assert mask.alpha_rad == 0
    assert mask.psi_rad(OPTICS, 3000.0) == pytest.approx(0, abs=1e-12)


def test_the_assembly_range_gets_the_papers_strength_or_a_third_of_it() -> None:
    assert choose_mask(0.0, 4000.0, PAPER, OPTICS).alpha_rad == pytest.approx(53.5, abs=0.0125)
    assert choose_mask(0.0, 4000.0, PAPER, OPTICS, joint=True).alpha_rad < 20


def test_beyond_its_range_a_calibration_says_so_and_stays_at_its_last_value() -> None:
    assert not PAPER.covers(4001.0)
    assert PAPER.alpha_rad(9000.0) == PAPER.alpha_rad(4000.0)
    deep = depth_to_cover_um(0.0, 40_000.0, OPTICS)
    assert not MODEL.covers(deep)
    assert MODEL.alpha_rad(deep) == MODEL.alpha_rad(MODEL.deepest_um)


@both
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_depths_and_strengths_that_cannot_be_are_refused(calibration: Calibration, value: float) -> None:
    with pytest.raises(InputError, match="depth_um is"):
        calibration.alpha_rad(value)
    with pytest.raises(InputError, match="alpha_rad is"):
        calibration.depth_um(value)


def test_ranges_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="near must not exceed far"):
        choose_mask(2.0, 1.0, PAPER, OPTICS)
    with pytest.raises(InputError, match="far_um is nan"):
        choose_mask(0.0, math.nan, PAPER, OPTICS)
    with pytest.raises(LimitError, match="choose a shallower range"):
        choose_mask(-60_000.0, 0.0, PAPER, OPTICS)


@pytest.mark.parametrize("options", [{"threshold": 2.0}, {"criterion_lp_per_mm": 400.0}])
def test_a_pattern_that_is_never_visible_is_refused(options: dict[str, float]) -> None:
    with pytest.raises(InputError, match="even in focus"):
        ModelCalibration(**options)  # type: ignore[arg-type] # floats by name


@pytest.mark.parametrize(("alpha", "psi", "nsr"), [(10.0, 0.0, 0.01), (30.0, 20.0, 0.003), (0.0, 4.0, 0.1)])
def test_restored_noise_is_as_much_stronger_as_predicted(
    device: Device, alpha: float, psi: float, nsr: float
) -> None:
    shape = (256, 256)
    restore = Restore(device, shape)
    axis = reference.otf_1d(OPTICS.frequency_axis(256), alpha, psi)
    axis[128] = axis[128].real
    restore.set_filter_axes(axis, axis, nsr)
    noise = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    gain = float(restore.restore(noise).std() / noise.std())
    # The sum over 65536 frequencies of a weight of a few thousand strong ones: 1/sqrt(2000) is 2 %.
    predicted = filter_quality(OPTICS, alpha, psi, nsr).noise_gain
    assert gain == pytest.approx(predicted, rel=0.05)
    assert filter_quality(OPTICS, -alpha, psi, nsr) == filter_quality(OPTICS, alpha, -psi, nsr)


@given(alpha=st.floats(0, 100), psi=st.floats(0, 60), nsr=st.floats(1e-4, 1), more=st.floats(1, 100))
def test_less_noise_let_through_costs_detail(alpha: float, psi: float, nsr: float, more: float) -> None:
    fine, smooth = (filter_quality(OPTICS, alpha, psi, n) for n in (nsr, nsr * more))
    assert smooth.noise_gain <= fine.noise_gain * (1 + 1e-12)
    assert smooth.resolution_lp_per_mm <= fine.resolution_lp_per_mm
    # No filter amplifies any frequency by more than 1 / (2 sqrt(nsr)).
    assert fine.noise_gain <= 0.5 / math.sqrt(nsr) * (1 + 1e-12)
    assert 0 < fine.resolution_lp_per_mm <= 500 / OPTICS.object_pitch_um


def test_a_filter_that_cannot_be_is_refused() -> None:
    for wrong in ((math.nan, 0.0, 0.01), (1.0, math.inf, 0.01), (1.0, 0.0, 0.0)):
        with pytest.raises(InputError):
            filter_quality(OPTICS, *wrong)


# ---- the depth it covers ----------------------------------------------------------------------------------


@given(st.floats(1, 60), st.floats(-80, 20), st.floats(-300, 300), st.floats(0, 3000), st.floats(0.2, 0.9))
def test_a_margin_ends_where_defocus_has_taken_its_share_of_the_band(
    alpha: float, focus: float, near: float, deep: float, share: float
) -> None:
    mask, far = Mask(alpha, focus), near + deep
    margin = depth_margin_um(mask, OPTICS, near, far, share)

    def worse(beyond_um: float) -> float:
        return max(-mask.psi_rad(OPTICS, near - beyond_um), mask.psi_rad(OPTICS, far + beyond_um))

    assert worse(margin) == pytest.approx(3 * alpha * share, rel=1e-9, abs=1e-9)
    assert worse(margin + 1) > 3 * alpha * share


@given(st.floats(0, 3000), st.floats(0, 300))
def test_a_wider_range_of_depths_leaves_as_much_less_margin(deep: float, wider: float) -> None:
    mask = Mask(40.0, -50.0)
    assert depth_margin_um(mask, OPTICS, -wider, deep + wider) == pytest.approx(
        depth_margin_um(mask, OPTICS, 0.0, deep) - wider, abs=1e-6
    )


@pytest.mark.parametrize(
    ("near", "far", "share"),
    [(math.nan, 0, 0.6), (0, math.inf, 0.6), (1, 0, 0.6), (0, 1, 1.1), (0, 1, math.nan)],
)
def test_a_margin_of_no_range_or_share_is_refused(near: float, far: float, share: float) -> None:
    with pytest.raises(InputError):
        depth_margin_um(Mask(40.0, -50.0), OPTICS, near, far, share)
