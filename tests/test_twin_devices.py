"""Laws of the simulated clock, stages, panel and cameras."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adof_cl import reference, twin
from adof_cl.errors import InputError, LimitError
from adof_cl.optics import Mask, SlmPanel
from adof_cl.twin.pupil import Pupil, PupilAxis, read_codes

LINEAR = np.rint(255 / 256 * np.arange(256)).astype(np.uint8)
PANEL = twin.Design().panel
APERTURE_UM = 10_000.0


def codes(mask: Mask, tilt_xy_rad: tuple[float, float] = (0.0, 0.0), panel: SlmPanel = PANEL) -> np.ndarray:
    return reference.slm_encode(
        (panel.rows, panel.columns),
        panel.stop_px(APERTURE_UM),
        LINEAR,
        mask.alpha_rad,
        mask.focus_psi_rad,
        tilt_xy_rad=tilt_xy_rad,
    )


def stage(**axes: twin.AxisDesign) -> tuple[twin.SimulatedStage, twin.Clock]:
    clock = twin.Clock()
    return twin.SimulatedStage(axes, clock, 0.01), clock


X = twin.AxisDesign(3.0, 1000.0, -2500.0, 2500.0)
Z = twin.AxisDesign(0.03, 1000.0, -4300.0, 500.0)


# ---- clock ------------------------------------------------------------------------------------------------


def test_time_passes_only_when_waited_for_and_never_runs_back() -> None:
    clock = twin.Clock()
    heard: list[tuple[float, float]] = []
    clock.on_advance(lambda a, b: heard.append((a, b)))
    assert clock.now_s == 0
    clock.wait(0.5)
    clock.wait_until(0.2)
    assert clock.now_s == 0.5
    assert heard == [(0.0, 0.5)]
    for wrong in (-1.0, math.nan, math.inf):
        with pytest.raises(InputError):
            clock.wait(wrong)


# ---- stages -----------------------------------------------------------------------------------------------


def test_nothing_moves_on_connection() -> None:
    rig = twin.build(0)
    before = rig.coarse.position(), rig.fine.position()
    rig.clock.wait(10)
    assert (rig.coarse.position(), rig.fine.position()) == before
    assert not rig.coarse.may_move_on_open
    assert not rig.coarse.moving


def test_a_velocity_acts_after_the_latency_and_expires() -> None:
    rig, clock = stage(x=X)
    rig.set_velocity({"x": 300.0}, expires_s=0.5)
    clock.wait(0.0099)
    assert rig.position() == {"x": 0.0}
    clock.wait(0.1001)
    assert rig.position() == {"x": 30.0}
    assert rig.moving
    clock.wait(10)
    assert rig.position() == {"x": 150.0}
    assert not rig.moving


def test_a_stopped_stage_stays_where_it_was_when_the_command_arrived() -> None:
    rig, clock = stage(x=X, z=Z)
    rig.set_velocity({"x": 600.0, "z": -900.0}, expires_s=2)
    clock.wait(0.11)
    rig.stop()
    clock.wait(5)
    assert rig.position()["x"] == pytest.approx(66.0, abs=1.5)
    assert rig.position()["z"] == pytest.approx(-99.0, abs=0.015)


def test_a_move_takes_the_time_its_speed_needs() -> None:
    rig, clock = stage(x=X)
    rig.move_to({"x": 1000.0}, speed=500.0)
    clock.wait(1.01)
    assert rig.position()["x"] == pytest.approx(500, abs=1.5)
    rig.wait_until_still()
    assert clock.now_s == pytest.approx(0.01 + 999 / 500, abs=1e-6)
    assert rig.position() == {"x": 999.0}


def test_a_new_command_takes_over_where_the_old_one_was() -> None:
    rig, clock = stage(x=X)
    rig.move_to({"x": 900.0})
    clock.wait(0.31)
    rig.move_to({"x": 0.0})
    rig.wait_until_still()
    # 310 um out before the second command acts, 310 um back at 1 mm/s.
    assert clock.now_s == pytest.approx(0.32 + 0.31, abs=0.01)
    assert rig.position() == {"x": 0.0}


@pytest.mark.parametrize(
    "command",
    [
        lambda s: s.move_to({"z": 0.0, "x": 2501.0}),
        lambda s: s.move_to({"z": -4301.0}),
        lambda s: s.move_to({"z": 0.0}, speed=1001.0),
        lambda s: s.set_velocity({"z": 1001.0}),
        lambda s: s.set_velocity({"z": -10.0, "x": -1000.0}, expires_s=2.6),
    ],
)
def test_a_command_beyond_a_limit_is_refused_whole_and_nothing_has_moved(command) -> None:
    rig, clock = stage(x=X, z=Z)
    with pytest.raises(LimitError):
        command(rig)
    clock.wait(5)
    assert rig.position() == {"x": 0.0, "z": 0.0}


@pytest.mark.parametrize(
    "command",
    [
        lambda s: s.move_to({"w": 1.0}),
        lambda s: s.move_to({"x": math.nan}),
        lambda s: s.set_velocity({"x": math.inf}),
        lambda s: s.set_velocity({"x": 1.0}, expires_s=0.0),
        lambda s: s.set_velocity({"x": 1.0}, expires_s=math.nan),
    ],
)
def test_nonsense_is_refused_and_nothing_has_moved(command) -> None:
    rig, clock = stage(x=X, z=Z)
    with pytest.raises(InputError):
        command(rig)
    clock.wait(5)
    assert rig.position() == {"x": 0.0, "z": 0.0}


@given(
    velocities=st.lists(st.floats(-1000, 1000), min_size=1, max_size=6),
    waits=st.lists(st.floats(0, 0.3), min_size=6, max_size=6),
)
def test_a_stage_always_stands_on_a_whole_step_within_its_limits_and_its_speed(
    velocities: list[float], waits: list[float]
) -> None:
    rig, clock = stage(x=X)
    for velocity, wait in zip(velocities, waits, strict=False):
        before = rig.position()["x"]
        rig.set_velocity({"x": velocity})
        clock.wait(wait)
        now = rig.position()["x"]
        assert now / 3 == pytest.approx(round(now / 3), abs=1e-9)
        assert abs(now - before) <= 1000 * wait + 3
        assert -2500 <= now <= 2500


def test_a_fraction_of_a_step_is_carried_while_moving_and_lost_at_rest() -> None:
    kept, clock = stage(x=X)
    for _ in range(10):
        kept.set_velocity({"x": 10.0}, expires_s=0.2)
        clock.wait(0.1)
    assert kept.position()["x"] >= 9
    lost, clock = stage(x=X)
    for _ in range(10):
        lost.set_velocity({"x": 10.0}, expires_s=0.1)
        clock.wait(0.5)
    assert lost.position() == {"x": 0.0}


def test_the_stages_have_the_papers_resolutions() -> None:
    rig = twin.build(0)
    assert rig.coarse.resolution == {"x": 3.0, "y": 3.0, "theta": 32e-6, "z": 0.03}
    assert rig.fine.resolution == {"x": 0.03, "y": 0.03}
    assert set(rig.coarse.limits) == set(rig.coarse.speed_limits) == {"x", "y", "theta", "z"}


# ---- panel ------------------------------------------------------------------------------------------------


@settings(max_examples=15)
@given(
    alpha=st.floats(-100, 100),
    focus=st.floats(-60, 60),
    tilt=st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
)
def test_the_mask_is_recovered_from_its_codes(alpha: float, focus: float, tilt: tuple[float, float]) -> None:
    pupil = read_codes(codes(Mask(alpha, focus), tilt), PANEL, APERTURE_UM)
    # Level errors telescope along the steps: at most half a level at each end, in all terms together.
    limit = 2 * np.pi / 256
    for axis, wanted_tilt in ((pupil.along_x, tilt[0]), (pupil.along_y, tilt[1])):
        assert axis.alpha_rad == pytest.approx(alpha, abs=2 * limit)
        assert axis.focus_rad == pytest.approx(focus, abs=2 * limit)
        assert axis.tilt_rad == pytest.approx(wanted_tilt, abs=2 * limit)
    # 256 levels through a table of 256 codes: two roundings, one level where they meet.
    assert pupil.residual_rad < 0.025


def test_flat_codes_are_no_mask() -> None:
    pupil = read_codes(np.zeros((600, 800), np.uint8), PANEL, APERTURE_UM)
    u = np.linspace(-1.9, 1.9, 39)
    for psi in (0.0, 40.0):
        # The cells' autocorrelation: 0.2 (2 psi)/n^2 with n = 2500, and the spline's own 1e-6.
        np.testing.assert_allclose(pupil.along_x.otf(u, psi), reference.otf_1d(u, 0.0, psi), atol=1e-5)


def test_the_steps_of_the_panel_change_the_transfer_function_little_but_do_change_it() -> None:
    mask = Mask(53.5)
    u = np.linspace(0, 1.2, 61)
    exact = reference.otf_1d(u, mask.alpha_rad, 60.0)
    stepped = read_codes(codes(mask), PANEL, APERTURE_UM).along_x.otf(u, 60.0)
    smooth = read_codes(codes(mask), PANEL, APERTURE_UM, pixels=False).along_x.otf(u, 60.0)
    # 2 % of the light leaves into the orders at 312 px (notes of section 9 in the physics of the panel).
    assert 1e-4 < np.abs(stepped - exact).max() < 0.03
    assert np.abs(smooth - exact).max() < 2e-3


def test_a_finer_panel_comes_closer_to_glass() -> None:
    u, mask = np.linspace(0, 1.2, 61), Mask(53.5)
    fine = SlmPanel("fine", 2600, 2600, 4.0, 0.9, 60.0)
    errors = [
        np.abs(read_codes(codes(mask, panel=p), p, APERTURE_UM).along_x.otf(u, 30.0)
               - reference.otf_1d(u, 53.5, 30.0)).max()
        for p in (PANEL, fine)
    ]  # fmt: skip
    assert errors[1] < errors[0] / 10


def test_tilt_on_the_panel_moves_the_image_and_nothing_else() -> None:
    u = np.linspace(-1.2, 1.2, 25)
    plain, tilted = PupilAxis(alpha_rad=20.0), PupilAxis(tilt_rad=5.0, alpha_rad=20.0)
    np.testing.assert_allclose(tilted.otf(u, 3.0), plain.otf(u, 3.0) * np.exp(5j * u), atol=1e-12)


def test_glass_is_exactly_the_mask() -> None:
    pupil = Pupil.glass(Mask(40.0, -50.0))
    u = np.linspace(-1, 1, 11)
    np.testing.assert_array_equal(pupil.along_y.otf(u, 20.0), reference.otf_1d(u, 40.0, -30.0))


def test_patterns_that_cannot_be_shown_are_refused_and_the_old_one_stays() -> None:
    rig = twin.build(0)
    rig.slm.show(codes(Mask(10.0)))
    kept = rig.slm.pupil
    y, x = np.mgrid[:600, :800]
    round_phase = np.floor(((x - 399.5) ** 2 * (y - 299.5) / 2e4) % 256).astype(np.uint8)
    for wrong in (np.zeros((800, 600), np.uint8), np.zeros((600, 800)), round_phase):
        with pytest.raises(InputError):
            rig.slm.show(wrong)
    assert rig.slm.pupil is kept
    with pytest.raises(InputError):
        read_codes(codes(Mask(1.0)), PANEL.with_stroke(4.0), APERTURE_UM)
    with pytest.raises(InputError):
        read_codes(codes(Mask(1.0)), PANEL, 30_000.0)


def test_loading_changes_nothing_until_shown() -> None:
    rig = twin.build(0)
    before = rig.slm.pupil
    rig.slm.load(codes(Mask(30.0)))
    assert rig.slm.pupil is before
    rig.slm.show()
    assert rig.slm.pupil.along_x.alpha_rad == pytest.approx(30, abs=0.05)


def test_a_frame_taken_while_the_panel_settles_is_a_mixture_and_the_truth_says_so() -> None:
    rig = twin.build(0, noise=False)
    shape = (rig.design.rows, rig.design.columns)
    rig.clock.wait(0.1)
    old = rig.world.radiance(1, 0.1, 0.1, (0, 0), shape)
    assert rig.slm.settled
    rig.slm.show(codes(Mask(60.0)))
    assert not rig.slm.settled
    early_s = 0.1 + rig.slm.settling_s / 4
    mixed = rig.world.radiance(1, early_s, early_s, (0, 0), shape)
    assert rig.world.truth(early_s).mask_in_transition
    rig.clock.wait(rig.slm.settling_s)
    assert rig.slm.settled
    now_s = rig.clock.now_s
    assert not rig.world.truth().mask_in_transition
    new = rig.world.radiance(1, now_s, now_s, (0, 0), shape)
    np.testing.assert_allclose(mixed, 0.75 * old + 0.25 * new, atol=1e-5)
    assert np.abs(new - old).max() > 0.05
    assert not rig.world.truth(0.05).mask_in_transition


def test_the_panel_does_not_act_on_camera_2() -> None:
    rig = twin.build(0, noise=False)
    before = rig.camera_2.grab().pixels
    rig.slm.show(codes(Mask(60.0)))
    rig.clock.wait(0.1)
    np.testing.assert_array_equal(rig.camera_2.grab().pixels, before)


# ---- cameras ----------------------------------------------------------------------------------------------


def test_a_grab_ends_with_the_exposure_and_frames_come_at_the_cameras_rate() -> None:
    rig = twin.build(0)
    rig.camera_1.set_region((200, 200), (16, 16))
    first = rig.camera_1.grab()
    assert rig.clock.now_s == pytest.approx(first.time_s + rig.design.exposure_s / 2)
    times = [rig.camera_1.grab().time_s for _ in range(5)]
    np.testing.assert_allclose(np.diff([first.time_s, *times]), 1 / 60, rtol=1e-9)
    rig.clock.wait(1.0)
    late = rig.camera_1.grab()
    assert late.number > first.number + 60
    assert late.time_s > rig.clock.now_s - rig.design.exposure_s


def test_two_cameras_asked_one_after_the_other_give_the_same_moment() -> None:
    rig = twin.build(0)
    for camera in (rig.camera_1, rig.camera_2):
        camera.set_region((200, 200), (16, 16))
    for wait in (0.0, 0.013, 0.1, 0.25):
        rig.clock.wait(wait)
        one, two = rig.camera_1.grab(), rig.camera_2.grab()
        assert one.number == two.number
        assert one.time_s == two.time_s


def test_a_region_is_that_part_of_the_whole_frame() -> None:
    rig = twin.build(0, noise=False)
    whole = rig.camera_1.grab()
    assert whole.pixels.shape == (494, 659)
    assert whole.pixels.dtype == np.uint8
    rig.camera_1.set_centred_region()
    part = rig.camera_1.grab()
    assert part.pixels.shape == rig.camera_1.shape == (400, 512)
    assert part.origin_yx == rig.camera_1.origin_yx == (47, 73)
    np.testing.assert_array_equal(part.pixels, whole.pixels[47:447, 73:585])


@pytest.mark.parametrize(
    "region", [((-1, 0), (10, 10)), ((0, 0), (495, 10)), ((490, 0), (10, 10)), ((0, 0), (0, 5))]
)
def test_a_region_off_the_sensor_is_refused(region) -> None:
    rig = twin.build(0)
    with pytest.raises(InputError):
        rig.camera_1.set_region(*region)
    assert rig.camera_1.shape == (494, 659)
