"""Laws of one frame: each part seen through the filter of its own depth is where it is."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from adof_cl import reference, twin
from adof_cl.device import Device
from adof_cl.errors import InputError, TrackingError
from adof_cl.loop import HOLE, PEG, cut_templates
from adof_cl.optics import Mask, OpticalSystem
from adof_cl.pipeline import Blur, CameraPipeline, Window, WindowedPipeline
from adof_cl.tracking import TrackingLimits

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# The project's bounds: bias with the right filter; of the predicted shift with the wrong one.
BIAS_PX, SHIFT_SHARE, STATIONARY = 0.2, 0.1, 0.5
OPTICS = OpticalSystem()
LINEAR = np.rint(255 / 256 * np.arange(256)).astype(np.uint8)
ANYTHING = TrackingLimits(mismatch=1.1, sigma_px=1e3, gain=(1e-6, 1e6))


def joint(depth_um: float) -> Mask:
    """Focus at half depth, cubic just strong enough for the whole band."""
    half = OPTICS.psi_rad(depth_um) / 2
    return Mask(half / 1.5, -half)


@cache
def rig(depth_um: float) -> twin.Twin:
    """The hole aside, so that the peg hides neither corner of its diagonal."""
    start = twin.Start(x_um=150.0, y_um=-120.0, theta_rad=0.03, depth_um=depth_um)
    made = twin.build(5, start=start, misalignment=twin.Misalignment.none())
    made.camera_1.set_centred_region()
    return made


def frame(depth_um: float, mask: Mask) -> tuple[Pixels, dict[str, Array]]:
    """One frame through a mask, and where two corners of each part are in it."""
    made = rig(depth_um)
    panel = made.design.panel
    stop_px = panel.stop_px(OPTICS.aperture_um)
    shape = (panel.rows, panel.columns)
    made.slm.show(reference.slm_encode(shape, stop_px, LINEAR, mask.alpha_rad, mask.focus_psi_rad))
    made.clock.wait(2 * made.slm.settling_s)
    taken = made.camera_1.grab()
    origin = np.array(made.design.region_origin_yx[::-1])
    return taken.pixels, {
        part: made.world.corners_px(1, part, taken.time_s)[[0, 2]] - origin for part in (PEG, HOLE)
    }


@cache
def taught(device: Device, depth_um: float) -> CameraPipeline:
    """A pipeline with both parts' templates, taken in focus and anchored at their true corners."""
    pipeline = CameraPipeline(device, OPTICS, (400, 512), (PEG, HOLE), search_shape=(84, 84))
    for part, focus in ((PEG, 0.0), (HOLE, depth_um)):
        pixels, corners = frame(depth_um, Mask(0.0, -OPTICS.psi_rad(focus)))
        pipeline.set_templates(part, cut_templates(pixels, corners[part], part), ANYTHING)
    return pipeline


def off_px(device: Device, depth_um: float, mask: Mask, filters: dict[str, float]) -> dict[str, Array]:
    """Measured less true middle of each part, restored with the filter of the depth in `filters`."""
    pixels, corners = frame(depth_um, mask)
    blurs = {part: Blur.of(mask, OPTICS, depth) for part, depth in filters.items()}
    found = taught(device, depth_um)(pixels, blurs, corners)
    return {
        part: np.mean([m.feature_xy_px for m in found[part]], axis=0) - corners[part].mean(axis=0)
        for part in filters
    }


@pytest.mark.parametrize("depth_um", [4000.0, 2500.0, 1000.0, 787.0])
def test_each_part_restored_with_its_own_depths_filter_stays_where_it_is(
    device: Device, depth_um: float
) -> None:
    off = off_px(device, depth_um, joint(depth_um), {PEG: 0.0, HOLE: depth_um})
    assert np.abs(off[PEG]).max() <= BIAS_PX
    assert np.abs(off[HOLE]).max() <= BIAS_PX


@pytest.mark.parametrize("depth_um", [3600.0, 3000.0])
def test_a_stronger_mask_than_needed_leaves_a_deep_hole_in_place_as_well(
    device: Device, depth_um: float
) -> None:
    off = off_px(device, depth_um, Mask(80.0), {HOLE: depth_um})
    assert np.abs(off[HOLE]).max() <= BIAS_PX


@pytest.mark.parametrize("depth_um", [3600.0, 3000.0, 2500.0])
def test_the_in_focus_filter_displaces_a_deep_part_by_the_predicted_shift(
    device: Device, depth_um: float
) -> None:
    mask = Mask(80.0)
    psi = OPTICS.psi_rad(depth_um)
    assert psi / (3 * mask.alpha_rad) < STATIONARY
    shift = OPTICS.shift_px(mask.alpha_rad, psi)
    assert shift > 10 * BIAS_PX
    off = off_px(device, depth_um, mask, {PEG: 0.0, HOLE: 0.0})
    assert off[HOLE].mean() == pytest.approx(shift, rel=SHIFT_SHARE)


def test_an_image_is_that_of_its_own_filter_whatever_was_restored_before(device: Device) -> None:
    pixels, _ = frame(4000.0, joint(4000.0))
    one, other = (Blur.of(joint(4000.0), OPTICS, depth) for depth in (0.0, 4000.0))
    fresh = CameraPipeline(device, OPTICS, (400, 512), (PEG, HOLE))
    wanted = fresh.restored(pixels, {PEG: one, HOLE: other})
    pipeline = taught(device, 4000.0)
    for before in ({PEG: other}, {PEG: other, HOLE: one}, {HOLE: Blur(3.0, 1.0), PEG: one}):
        pipeline.restored(pixels[::-1].copy(), before)
        found = pipeline.restored(pixels, {PEG: one, HOLE: other})
        for part in (PEG, HOLE):
            np.testing.assert_array_equal(found[part], wanted[part])
            np.testing.assert_array_equal(pipeline.last_images()[part], wanted[part])


def test_a_filter_is_formed_anew_when_its_blur_changed_and_only_then(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = CameraPipeline(device, OPTICS, (64, 80), (PEG, HOLE))
    formed: list[int] = []
    form = pipeline._restore.set_filter_table

    def counted(table: object, nsr: float, slot: int) -> None:
        formed.append(slot)
        form(table, nsr, slot)  # type: ignore[arg-type]  # passed on as they came

    monkeypatch.setattr(pipeline._restore, "set_filter_table", counted)
    pixels = np.random.default_rng(1).integers(0, 255, (64, 80), dtype=np.uint8)
    blurs = {PEG: Blur(20.0, 0.0), HOLE: Blur(20.0, 30.0)}
    first = pipeline.restored(pixels, blurs)
    assert formed == [0, 1]
    again = pipeline.restored(pixels, blurs)
    assert formed == [0, 1]
    for part in (PEG, HOLE):
        np.testing.assert_array_equal(again[part], first[part])
    pipeline.restored(pixels, {**blurs, HOLE: Blur(20.0, 31.0)})
    assert formed == [0, 1, 1]


def test_a_blur_that_creeps_is_followed(device: Device) -> None:
    """Small steps must not add up unseen: the filter is compared with the blur it was formed for."""
    pixels, _ = frame(4000.0, joint(4000.0))
    pipeline, fresh = (CameraPipeline(device, OPTICS, (400, 512), (PEG,)) for _ in range(2))
    creeping = [Blur(34.0, 50.0 + step * 0.009) for step in range(12)]
    found = [pipeline.restored(pixels, {PEG: blur})[PEG] for blur in creeping][-1]
    wanted = fresh.restored(pixels, {PEG: creeping[-1]})[PEG].astype(float)
    stale = fresh.restored(pixels, {PEG: creeping[0]})[PEG].astype(float)
    assert np.square(found - wanted).sum() < np.square(found - stale).sum() / 4


def test_without_a_blur_the_frame_is_searched_as_it_is(device: Device) -> None:
    pixels, corners = frame(2500.0, Mask(0.0, -OPTICS.psi_rad(2500.0)))
    found = taught(device, 2500.0)(pixels, {HOLE: None}, corners)
    assert found.keys() == {HOLE}
    off = np.mean([m.feature_xy_px for m in found[HOLE]], axis=0) - corners[HOLE].mean(axis=0)
    assert np.abs(off).max() < BIAS_PX / 4


def test_templates_set_again_replace_those_before(device: Device) -> None:
    pixels, corners = frame(2500.0, Mask(0.0, -OPTICS.psi_rad(2500.0)))
    pipeline = CameraPipeline(device, OPTICS, (400, 512), (PEG, HOLE))
    templates = cut_templates(pixels, corners[HOLE], HOLE)
    for shift in (0.0, 1.5):
        moved = [t.anchored(t.anchor_yx + shift) for t in templates]
        pipeline.set_templates(HOLE, moved)
        assert pipeline.templates(HOLE) == moved
        found = pipeline(pixels, {HOLE: None}, corners)[HOLE]
        np.testing.assert_allclose([m.feature_xy_px for m in found], corners[HOLE] + shift, atol=0.02)


@pytest.mark.parametrize(
    ("pixels", "blurs", "error", "message"),
    [
        (np.zeros((400, 512), np.uint8), {"nut": None}, InputError, "part 'nut' came: .*peg, hole"),
        (np.zeros((400, 511), np.uint8), {HOLE: None}, InputError, "400.*511"),
        (np.zeros((400, 512), np.uint16), {HOLE: None}, InputError, "uint16"),
    ],
    ids=["unknown part", "wrong shape", "wrong type"],
)
def test_what_does_not_fit_is_refused_and_the_next_frame_is_measured_as_ever(
    device: Device,
    pixels: Pixels,
    blurs: dict[str, Blur | None],
    error: type[Exception],
    message: str,
) -> None:
    pipeline = taught(device, 2500.0)
    mask = joint(2500.0)
    good, corners = frame(2500.0, mask)
    own = {PEG: Blur.of(mask, OPTICS, 0.0), HOLE: Blur.of(mask, OPTICS, 2500.0)}
    before = pipeline(good, own, corners)
    images = pipeline.last_images()
    with pytest.raises(error, match=message):
        pipeline(pixels, blurs, corners | {"nut": corners[PEG]})
    for part, image in pipeline.last_images().items():
        np.testing.assert_array_equal(image, images[part])
    after = pipeline(good, own, corners)
    for part in own:
        for one, other in zip(before[part], after[part], strict=True):
            np.testing.assert_array_equal(one.feature_xy_px, other.feature_xy_px)


def test_a_part_without_templates_is_refused_and_one_it_never_heard_of_too(device: Device) -> None:
    pipeline = CameraPipeline(device, OPTICS, (64, 80), (PEG,))
    pixels = np.zeros((64, 80), np.uint8)
    with pytest.raises(TrackingError, match="part 'peg' has no templates: set_templates first"):
        pipeline(pixels, {PEG: None}, {PEG: np.zeros((2, 2))})
    for refused in (
        lambda: pipeline.templates("nut"),
        lambda: pipeline.set_templates("nut", []),
        lambda: pipeline.restored(pixels, {"nut": Blur(20.0, 0.0)}),
    ):
        with pytest.raises(InputError, match="part 'nut' came"):
            refused()


@pytest.mark.parametrize("depth_um", [np.nan, np.inf, -OPTICS.object_distance_um])
def test_a_blur_of_no_depth_is_refused(depth_um: float) -> None:
    with pytest.raises(InputError, match="depth_um is"):
        Blur.of(Mask(20.0), OPTICS, depth_um)


def test_a_part_without_an_expected_place_is_refused(device: Device) -> None:
    pipeline = taught(device, 2500.0)
    pixels, corners = frame(2500.0, joint(2500.0))
    with pytest.raises(InputError, match="part 'hole' has no expected place"):
        pipeline(pixels, {PEG: None, HOLE: None}, {PEG: corners[PEG]})


def test_windows_find_what_the_whole_frame_finds(device: Device) -> None:
    depth_um = 1000.0
    mask = joint(depth_um)
    pixels, corners = frame(depth_um, mask)
    window = Window((192, 192), search_shape=(84, 84), padding=64)
    windowed = WindowedPipeline(device, OPTICS, (400, 512), {PEG: window, HOLE: window})
    whole = taught(device, depth_um)
    for part in (PEG, HOLE):
        windowed.set_templates(part, whole.templates(part), ANYTHING)
    blurs = {PEG: Blur.of(mask, OPTICS, 0.0), HOLE: Blur.of(mask, OPTICS, depth_um)}
    found, wanted = windowed(pixels, blurs, corners), whole(pixels, blurs, corners)
    for part in (PEG, HOLE):
        for one, other in zip(found[part], wanted[part], strict=True):
            # A window's end lies farther from the features than their blur reaches: rounding and its ripples.
            np.testing.assert_allclose(one.feature_xy_px, other.feature_xy_px, atol=0.03)
    (y, x), image = windowed.last_windows()[HOLE]
    assert image.shape == (192, 192)
    middle = whole.last_images()[HOLE][y : y + 192, x : x + 192][64:128, 64:128].astype(int)
    assert np.abs(image[64:128, 64:128].astype(int) - middle).mean() < 1


def test_a_window_is_kept_inside_the_frame_and_a_wrong_call_changes_nothing(device: Device) -> None:
    mask = joint(1000.0)
    pixels, corners = frame(1000.0, mask)
    window = Window((192, 192))
    pipeline = WindowedPipeline(device, OPTICS, (400, 512), {HOLE: window})
    pipeline.set_templates(HOLE, taught(device, 1000.0).templates(HOLE), ANYTHING)
    blurs = {HOLE: Blur.of(mask, OPTICS, 1000.0)}
    first = pipeline(pixels, blurs, corners)[HOLE]
    for wrong, sentence in (
        ((pixels[:-1], blurs, corners), "the frame is"),
        ((pixels, {PEG: None}, corners), "follows hole"),
        ((pixels, blurs, {}), "no expected place"),
        ((pixels, blurs, {HOLE: [[np.nan, 1.0]]}), "finite"),
        ((pixels, blurs, {HOLE: corners[HOLE][:1]}), "wanted"),
    ):
        with pytest.raises(InputError, match=sentence):
            pipeline(*wrong)  # type: ignore[arg-type]  # the wrong ones
    again = pipeline(pixels, blurs, corners)[HOLE]
    np.testing.assert_array_equal(first[0].feature_xy_px, again[0].feature_xy_px)
    corner = np.array([[2.0, 2.0], [60.0, 60.0]])
    pipeline(pixels, blurs, {HOLE: corner})
    assert pipeline.last_windows()[HOLE][0] == (0, 0)
    pipeline(pixels, blurs, {HOLE: corner + 500.0})
    assert pipeline.last_windows()[HOLE][0] == (400 - 192, 512 - 192)
    for made in ({}, {HOLE: Window((401, 192))}):
        with pytest.raises(InputError):
            WindowedPipeline(device, OPTICS, (400, 512), made)


def test_a_filter_within_its_tolerance_stands(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = CameraPipeline(device, OPTICS, (64, 80), (PEG,), tolerance_rad=0.5)
    formed: list[int] = []
    form = pipeline._restore.set_filter_table
    monkeypatch.setattr(pipeline._restore, "set_filter_table", lambda *a: (formed.append(1), form(*a))[1])
    pixels = np.zeros((64, 80), np.uint8)
    for psi in (0.0, 0.4, 0.5, 0.6):
        pipeline.restored(pixels, {PEG: Blur(20.0, psi)})
    assert len(formed) == 2
    with pytest.raises(InputError, match="tolerance_rad"):
        CameraPipeline(device, OPTICS, (64, 80), (PEG,), tolerance_rad=0.0)
