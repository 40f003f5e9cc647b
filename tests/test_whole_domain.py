"""Properties over whole domains: a number within its bound of the reference, or one of our errors.

The corners themselves are rows of `adof_cl.envelope`; here nothing may slip between them.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

import tolerances
from adof_cl import envelope, reference
from adof_cl.device import Device
from adof_cl.errors import AdofError, CalibrationError, InputError, LimitError, TrackingError
from adof_cl.image_prep import ImagePrep, Region
from adof_cl.mask import ModelCalibration, PaperCalibration, choose_mask, depth_to_cover_um
from adof_cl.optics import Mask, OpticalSystem, SlmPanel
from adof_cl.otf import Otf1d
from adof_cl.padding import LARGEST_PADDED_SIDE, good_size, padded_frame, padded_shape
from adof_cl.phase_terms import ALPHA_LIMIT_RAD, PSI_LIMIT_RAD
from adof_cl.psf import Psf
from adof_cl.pupil_phase import PupilPhase
from adof_cl.restore import FRAME_LIMIT, Restore
from adof_cl.servo import (
    ServoLaw,
    StageAxes,
    StageAxis,
    StageQuantiser,
    VelocityCommand,
    gain_from_delay,
    samples_late,
    saturate,
)
from adof_cl.slm_encode import SlmEncode, stroke_table
from adof_cl.ssd_search import LARGEST_LEVEL, SsdSearch
from adof_cl.stereo import AffineCamera, StereoRig, triangulate, triangulate_relative
from adof_cl.tracking import Template, TemplateTracker
from adof_drivers.errors import DriverError
from adof_drivers.phase_table import code_table

OPTICS = OpticalSystem()
TURN = 2 * math.pi

signs = st.sampled_from((-1, 1))


def spread(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers of every size between two powers of ten, both signs, and 0."""
    return st.one_of(st.just(0.0), st.builds(lambda e, s: s * 10.0**e, st.floats(low, high), signs))


# ---- mask -------------------------------------------------------------------------------------------------


@cache
def pupil_plan(device: Device, precision: str) -> PupilPhase:
    return PupilPhase(device, 9, 17, precision=precision)


@given(
    precision=st.sampled_from(("float32", "float64")),
    alpha=spread(-12, 5.5),
    psi=spread(-12, 4.5),
    tilt=spread(-12, 5.5),
)
def test_any_mask_and_tilt_give_the_phase_within_its_bound_or_are_refused(
    device: Device, precision: str, alpha: float, psi: float, tilt: float
) -> None:
    precision = precision if device.facts.fp64 else "float32"
    plan = pupil_plan(device, precision)
    try:
        turns = plan.evaluate(Mask(alpha, psi), tilt_xy_rad=(tilt, -tilt))
    except LimitError:
        assert abs(alpha) > ALPHA_LIMIT_RAD or abs(psi) > PSI_LIMIT_RAD or abs(tilt) > ALPHA_LIMIT_RAD
        return
    y, x = ((2 * np.arange(n) + 1 - n) / n for n in turns.shape)
    phase = reference.pupil_phase(x=x, y=y, alpha_rad=alpha, psi_rad=psi, tilt_xy_rad=(tilt, -tilt))
    apart = turns - phase / TURN
    apart = TURN * np.abs(apart - np.rint(apart))
    assert ((turns >= 0) & (turns < 1)).all()
    # The reference adds up whole radians, a few roundings of the largest term's size.
    largest = 2 * (abs(alpha) + abs(psi) + abs(tilt))
    assert apart.max() <= tolerances.phase_rad(precision) + 4 * tolerances.eps("float64") * max(largest, 1)


@cache
def slm_plan(device: Device, rows: int, columns: int) -> SlmEncode:
    panel = SlmPanel("p", rows, columns, pitch_um=100.0, fill_factor=1.0, frame_rate_hz=60.0)
    return SlmEncode(device, panel, OpticalSystem(aperture_um=100.0 * min(rows, columns)))


@given(
    shape=st.sampled_from(((16, 24), (31, 31), (64, 48))),
    alpha=spread(-6, 5.2),
    psi=spread(-6, 4.2),
    tilt=spread(-6, 5.2),
)
def test_any_mask_gives_the_codes_or_is_refused_where_its_phase_outruns_the_pixels(
    device: Device, shape: tuple[int, int], alpha: float, psi: float, tilt: float
) -> None:
    plan, across = slm_plan(device, *shape), min(shape)
    step = (3 * abs(alpha) + 2 * abs(psi) + abs(tilt)) * 2 / across
    try:
        codes = plan.codes(Mask(alpha, psi), tilt_xy_rad=(tilt, 0.0))
    except LimitError:
        assert step > math.pi * (1 - 1e-12) or abs(alpha) > ALPHA_LIMIT_RAD or abs(psi) > PSI_LIMIT_RAD
        return
    assert step <= math.pi * (1 + 1e-12)
    wanted = reference.slm_encode(shape, across, stroke_table(TURN), alpha, psi, tilt_xy_rad=(tilt, 0.0))
    apart = np.abs(codes.astype(int) - wanted)
    assert np.minimum(apart, 255 - apart).max() <= 1  # a phase at a level's edge may fall either way


@given(near=st.floats(-6e4, 1e6), far=st.floats(-6e4, 1e6), joint=st.booleans())
def test_any_depth_range_has_a_mask_that_covers_it_or_is_refused(
    near: float, far: float, joint: bool
) -> None:
    model, paper = model_calibration(), PaperCalibration()
    try:
        reach = depth_to_cover_um(near, far, OPTICS, joint=joint)
    except InputError:
        assert near > far
        return
    except LimitError:
        assert near < 0  # so far before the focus that nothing behind it is as much defocused
        return
    for calibration in (model, paper):
        mask = choose_mask(near, far, calibration, OPTICS, joint=joint)
        assert 0 <= mask.alpha_rad < 1e3
        shallower = choose_mask(near / 2, far / 2, calibration, OPTICS)
        if not joint and near <= 0 <= far:
            assert shallower.alpha_rad <= mask.alpha_rad
    if model.covers(reach):
        mask = choose_mask(near, far, model, OPTICS, joint=joint)
        # Either the pattern is seen at the far end, or a weaker mask already covers more (maths.md, eq. O13).
        assert model.depth_um(mask.alpha_rad) >= reach * (1 - 1e-9)


@cache
def model_calibration() -> ModelCalibration:
    return ModelCalibration()


@given(
    start=spread(-3, 6),
    steps=st.lists(st.floats(0, 1), min_size=255, max_size=255),
    scale=spread(-3, 8),
)
def test_any_measured_curve_gives_the_nearest_codes_or_is_refused(
    start: float, steps: list[float], scale: float
) -> None:
    phase = start + scale * np.concatenate([[0], np.cumsum(steps)]) / 255
    try:
        table = code_table(phase)
    except DriverError:
        assert phase[0] == phase[-1] or np.ptp(phase) > 1e3 * TURN
        return
    off = np.arange(256)[:, None] * TURN / 256 - (phase - phase[0])
    off = np.abs(off - TURN * np.rint(off / TURN))
    assert (off[np.arange(256), table] <= off.min(axis=1) + 1e-9).all()


# ---- sizes ------------------------------------------------------------------------------------------------


@given(
    shape=st.tuples(st.integers(-1, 9000), st.integers(-1, 9000)),
    padding=st.one_of(st.integers(-1, 20000), st.tuples(st.integers(-1, 20000), st.integers(-1, 20000))),
)
@example(shape=(8, 4096), padding=0)
@example(shape=(4096, 4096), padding=12288)
def test_any_frame_and_padding_have_a_size_to_transform_or_are_refused(
    shape: tuple[int, int], padding: int | tuple[int, int]
) -> None:
    added = padding if isinstance(padding, tuple) else (padding, padding)
    wanted = [n + p for n, p in zip(shape, added, strict=True)]
    fine = all(8 <= n <= 4096 for n in shape) and min(added) >= 0
    try:
        padded = padded_shape(shape, padding)
    except InputError:
        assert not fine or max(wanted) > LARGEST_PADDED_SIDE * 16 / 17
        return
    assert fine
    for n, found in zip(wanted, padded, strict=True):
        assert n <= found <= LARGEST_PADDED_SIDE
        assert found == good_size(n)
        rest = found
        for prime in (2, 3, 5, 7):
            while rest % prime == 0:
                rest //= prime
        assert rest == 1


@settings(max_examples=8)
@given(
    rows=st.integers(8, 70), columns=st.integers(8, 70), padding=st.integers(0, 20), seed=st.integers(0, 9)
)
@example(rows=8, columns=8, padding=0, seed=0)
@example(rows=61, columns=67, padding=1, seed=0)
def test_a_frame_of_any_size_is_restored_within_the_bound(
    device: Device, rows: int, columns: int, padding: int, seed: int
) -> None:
    plan = Restore(device, (rows, columns), padding=padding)
    rng = np.random.default_rng(seed)
    frame = rng.random((rows, columns), np.float32)
    axes = envelope._coded_axes(plan.padded_shape, "float32")
    assert envelope._restored(plan, 0.0, frame, axes, 10.0 ** rng.uniform(-4, 2)).ok


@given(rows=st.integers(0, 30), columns=st.integers(0, 30), ny=st.integers(-1, 60), nx=st.integers(-1, 60))
def test_padding_keeps_the_frame_and_stays_between_its_edges_or_is_refused(
    rows: int, columns: int, ny: int, nx: int
) -> None:
    frame = np.random.default_rng(rows + 31 * columns).random((rows, columns))
    try:
        padded = padded_frame(frame, (ny, nx))
    except InputError:
        assert min(rows, columns) < 1 or ny < max(rows, 1) or nx < max(columns, 1)
        return
    assert padded.shape == (ny, nx)
    np.testing.assert_array_equal(padded[:rows, :columns], frame)
    eps = tolerances.eps("float64")
    assert padded.min() >= frame.min() * (1 - 4 * eps)
    assert padded.max() <= frame.max() * (1 + 4 * eps)


@given(samples=st.integers(-1, 4096), alpha=spread(-3, 5), psi=spread(-3, 2.6))
@example(samples=4093, alpha=1e5, psi=500.0)
def test_a_camera_of_any_number_of_pixels_has_its_exact_transfer_or_is_refused(
    device: Device, samples: int, alpha: float, psi: float
) -> None:
    try:
        plan = Otf1d.for_camera(device, OPTICS, samples)
    except InputError:
        assert samples < 1
        return
    wanted = reference.otf_1d(OPTICS.frequency_axis(samples), alpha, psi) * OPTICS.pixel_otf_axis(samples)
    if samples % 2 == 0:
        wanted[samples // 2] = wanted[samples // 2].real
    assert np.abs(plan.evaluate(alpha, psi) - wanted).max() <= envelope._otf_bound("float32")


@given(samples=st.integers(-1, 100), padding=st.integers(-1, 5), alpha=st.floats(-40, 40))
@example(samples=64, padding=2, alpha=30.0)
@example(samples=32, padding=4, alpha=-5.0)
@example(samples=2, padding=2, alpha=0.5)
def test_a_stop_of_any_number_of_cells_gives_a_psf_of_all_its_light_or_is_refused(
    device: Device, samples: int, padding: int, alpha: float
) -> None:
    try:
        plan = Psf(device, samples, padding=padding)
    except InputError:
        powers = all(n >= 2 and n & (n - 1) == 0 for n in (samples, padding))
        assert not powers
        return
    turns = PupilPhase(device, samples, samples)(Mask(alpha, 0))
    try:
        psf, otf = (array.download() for array in plan(turns, alpha_rad=alpha))
    except LimitError:
        assert samples < 6 * abs(alpha) / math.pi
        return
    limit = 8 * tolerances.eps("float32") * math.log2(plan.size)
    assert psf.min() >= 0
    assert abs(float(psf.sum(dtype=np.float64)) - 1) <= limit
    assert abs(otf[0, 0] - 1) <= limit
    assert np.abs(otf).max() <= 1 + limit


@given(
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    region=st.tuples(*[st.integers(-1, 41)] * 4),
    kind=st.sampled_from(("uint8", "uint16")),
    out=st.sampled_from(("float32", "uint8")),
    dark=spread(-3, 6),
    gain=spread(-6, 13),
)
@example(shape=(40, 40), region=(3, 5, 30, 17), kind="uint16", out="float32", dark=100.0, gain=1e11)
@example(shape=(40, 40), region=(0, 0, 40, 40), kind="uint8", out="uint8", dark=-3.0, gain=0.7)
def test_any_frame_region_dark_and_gain_are_prepared_within_the_bound_or_refused(
    device: Device,
    shape: tuple[int, int],
    region: tuple[int, int, int, int],
    kind: str,
    out: str,
    dark: float,
    gain: float,
) -> None:
    top, left, rows, columns = region
    inside = min(top, left) >= 0 and min(rows, columns) >= 1
    inside = inside and top + rows <= shape[0] and left + columns <= shape[1]
    frame = np.random.default_rng(3).integers(0, np.iinfo(kind).max + 1, shape).astype(kind)
    try:
        plan = ImagePrep(
            device, shape, region=Region(*region), in_dtype=kind, out_dtype=out, dark=dark, gain=gain
        )
    except InputError:
        assert not inside or (65535 + abs(dark)) * abs(gain) > 0.999 * LARGEST_LEVEL
        return
    assert inside
    found = plan.prepare(frame).astype(np.float64)
    wanted = reference.image_prep(frame, dark, gain, region=region, to_bytes=out == "uint8")
    seen = frame[top : top + rows, left : left + columns].astype(np.float64)
    bound = tolerances.image_prep_real(seen, np.full_like(seen, dark), np.full_like(seen, abs(gain)))
    if out == "uint8":
        bound = np.minimum(np.ceil(2 * bound), 255)  # a level at a half may fall either way
    assert (np.abs(found - wanted) <= bound).all()


# ---- features ---------------------------------------------------------------------------------------------

IMAGE, CUT, WINDOW = (33, 41), (7, 6), (19, 25)


@cache
def search_plan(device: Device, kind: str, score: str) -> SsdSearch:
    return SsdSearch(device, IMAGE, CUT, WINDOW, 1, dtype=kind, score=score)


@given(
    kind=st.sampled_from(("uint8", "uint16", "float32")),
    score=st.sampled_from(("ssd", "gain_offset")),
    exponent=st.floats(-20, 20),
    pedestal=st.floats(0, 1),
    contrast=st.floats(0, 1),
    place=st.tuples(st.integers(0, 14), st.integers(0, 16)),
    at=st.tuples(st.integers(0, 12), st.integers(0, 19)),
    seed=st.integers(0, 99),
)
def test_a_template_is_found_with_the_references_scores_or_is_refused(
    device: Device,
    kind: str,
    score: str,
    exponent: float,
    pedestal: float,
    contrast: float,
    place: tuple[int, int],
    at: tuple[int, int],
    seed: int,
) -> None:
    """Of any level and contrast, cut anywhere in a window anywhere."""
    texture = np.random.default_rng(seed).random(IMAGE) * contrast * (1 - pedestal) + pedestal
    top = 10.0**exponent if kind == "float32" else float(np.iinfo(kind).max)
    image = (top * texture).astype(kind)
    y, x = place[0] + at[0], place[1] + at[1]
    assume(place[0] + WINDOW[0] <= IMAGE[0] and place[1] + WINDOW[1] <= IMAGE[1])
    template = image[y : y + CUT[0], x : x + CUT[1]].copy()
    values = template.astype(np.float64)
    plan = search_plan(device, kind, score)
    try:
        plan.set_templates(template[None])
    except InputError:
        assert np.abs(values).max() > LARGEST_LEVEL
        return
    except TrackingError:
        assert score == "gain_offset"
        assert ((values - values.mean()) ** 2).sum() < 1e-30
        return
    plan.set_windows(np.array([place]))
    found = plan.search(image)
    best, scores = reference.ssd_search(image.astype(np.float64), values, place, WINDOW, score=score)
    apart = np.abs(plan.score_maps()[0] - scores)
    # Squares of what lies below 1e-19 count as 0 in float32, each of the footprint's.
    least = values.size * 2.0**-126
    if score == "ssd":
        limit = np.zeros_like(scores) if kind == "uint8" else tolerances.ssd_relative(*CUT) * scores + least
        assert (apart <= limit).all()
        assert found.score[0] <= least
    else:
        places = np.lib.stride_tricks.sliding_window_view(image.astype(np.float64), CUT)
        places = places[place[0] : place[0] + scores.shape[0], place[1] : place[1] + scores.shape[1]]
        squares = places.var(axis=(2, 3)) * values.size
        flat = squares < 4e-30  # where the kernel calls a footprint flat, and scores it 1
        if kind == "uint8":
            limit = tolerances.gain_offset_bytes(values.size, squares, values.var() * values.size)
        else:
            window = image[place[0] : place[0] + WINDOW[0], place[1] : place[1] + WINDOW[1]].astype(
                np.float64
            )
            deviations = np.sqrt(np.maximum(squares, 1e-300) / values.size)
            limit = tolerances.gain_offset_real(*CUT, np.ptp(window) / deviations)
        limit = np.minimum(limit, 1.0)
        assert (apart[~flat] <= np.broadcast_to(limit, apart.shape)[~flat]).all()
        assert found.score[0] <= limit.max()
    y0, x0 = found.best_yx[0] - np.array(place)
    assert scores[y0, x0] <= scores.min() + 2 * np.max(limit)
    assert best is not None


SIDE = 64


@cache
def tracker_on(device: Device) -> tuple[TemplateTracker, np.ndarray, np.ndarray]:
    texture = envelope._texture((SIDE, SIDE), 12)
    image = np.clip(np.rint(40 + 160 * texture), 0, 255).astype(np.uint8)
    where = np.array([31.0, 33.0])
    tracker = TemplateTracker(device, image.shape, [Template.cut(image, where, (16, 16))], (40, 40))
    return tracker, np.fft.rfft2(texture), where


@given(
    dx=st.floats(-9, 9),
    dy=st.floats(-9, 9),
    noise=st.floats(0.3, 6),
    gain=st.floats(-0.5, 2.5),
    offset=st.floats(-60, 120),
    seed=st.integers(0, 99),
)
@example(dx=0.5, dy=-0.5, noise=0.3, gain=1.0, offset=0.0, seed=0)
def test_a_feature_moved_dimmed_and_noised_is_where_it_is_said_to_be_or_lost(
    device: Device, dx: float, dy: float, noise: float, gain: float, offset: float, seed: int
) -> None:
    tracker, spectrum, where = tracker_on(device)
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None, :]
    moved = np.fft.irfft2(spectrum * np.exp(-2j * np.pi * (fy * dy + fx * dx)), s=(SIDE, SIDE))
    grey = offset + gain * (40 + 160 * moved) + np.random.default_rng(seed).normal(0, noise, moved.shape)
    image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    clipped = float(((image == 0) | (image == 255))[18:50, 16:46].mean())
    (found,) = tracker.track(device.upload(image), where[None])
    assert np.isfinite([found.ssd, found.mismatch, found.gain]).all()
    if found.lost:
        assert found.reason
        assert np.isinf(np.diag(found.covariance)).all()
        assert gain < 0.5 or noise > 2 or clipped > 0
        return
    if clipped > 0:  # the template's own levels are gone: only that something is said is promised
        return
    error = np.abs(found.feature_xy_px - where - (dx, dy))
    # Six standard deviations, and what the cubic spline adds between pixels to a texture that ends at a sixth
    # of a cycle a pixel: (pi/6)^4/180 of its amplitude, against a slope of 2 pi/6 of it.
    assert (error <= 6 * np.sqrt(np.diag(found.covariance)) + 0.003).all()


# ---- stereo and servo -------------------------------------------------------------------------------------


@given(
    angle=st.floats(0.1, 1.5),
    scales=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    away=spread(-3, 6),
    step=spread(-6, 4),
    seed=st.integers(0, 99),
)
def test_a_displacement_seen_by_any_pair_of_cameras_is_measured_within_the_bound_or_refused(
    angle: float, scales: tuple[float, float], away: float, step: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    origin = np.array([away, -away, away])
    try:
        cameras = [
            AffineCamera.exact(
                10.0**scale * np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0]]),
                rng.normal(size=2),
                work_volume_um=np.stack([origin - 1e4, origin + 1e4]),
            )
            for scale, a in zip(scales, (0.0, angle), strict=True)
        ]
        rig = StereoRig(*cameras)
    except CalibrationError:
        assert angle < math.radians(5)
        return
    start = origin + rng.uniform(-1e3, 1e3, 3)
    moved = step * rng.normal(size=3)
    seen = [[camera.project(p) for camera in cameras] for p in (start, start + moved)]
    fix = triangulate_relative(rig, seen[0][0], seen[0][1], seen[1][0], seen[1][1])
    assert np.isfinite(fix.covariance_um2).all()
    # Pixels round at their own size; the weaker camera's count for least and the system magnifies them.
    largest = max(float(np.abs(pixels).max()) for pair in seen for pixels in pair)
    terms = max(10.0 ** max(scales) * float(np.abs(start).max() + np.abs(moved).max()), largest)
    weakest = float(np.linalg.svd(rig.matrix_px_per_um, compute_uv=False)[-1])
    bound = 64 * tolerances.eps("float64") * rig.condition * terms / weakest
    assert np.abs(fix.xyz_um - moved).max() <= bound
    absolute = triangulate(rig, *seen[0])
    assert np.abs(absolute.xyz_um - start).max() <= bound
    assert absolute.consistent


LIMITS = (50.0, 60.0, 0.05, 40.0)


def law(delay: float, period: float) -> ServoLaw:
    axes = StageAxes(
        *(
            StageAxis(unit, step, limit)  # type: ignore[arg-type]
            for unit, step, limit in zip(
                ("um", "um", "rad", "um"), (0.1, 0.1, 1e-4, 0.5), LIMITS, strict=True
            )
        )
    )
    return ServoLaw.from_delay(envelope._camera(0.0, np.zeros(3)), axes, delay, period)


@given(
    places=st.lists(spread(-3, 12), min_size=4, max_size=4),
    wanted=st.lists(spread(-3, 12), min_size=4, max_size=4),
    centre=spread(-3, 9),
    depth=spread(-6, 12),
    delay=st.floats(0, 3),
    period=st.floats(1e-3, 2),
)
def test_whatever_is_seen_the_stage_is_told_a_speed_within_its_limits_or_nothing(
    places: list[float], wanted: list[float], centre: float, depth: float, delay: float, period: float
) -> None:
    features, desired = np.reshape(places, (2, 2)), np.reshape(wanted, (2, 2))
    try:
        command = law(delay, period).step(features, desired, np.array([centre, -centre, 0.0]), depth)
    except AdofError:
        return
    assert np.isfinite(command.array).all()
    assert (np.abs(command.array) <= LIMITS).all()
    assert command.vz_um_per_s * depth >= 0


@given(
    speeds=st.lists(st.tuples(*[st.floats(-1, 1)] * 4), min_size=1, max_size=30),
    dt=st.floats(1e-4, 10),
)
def test_steps_and_what_remains_of_them_are_all_that_was_commanded(
    speeds: list[tuple[float, float, float, float]], dt: float
) -> None:
    axes = law(0.1, 0.1).axes
    quantiser = StageQuantiser(axes)
    resolution = np.array([axis.resolution for axis in axes.all])
    total, asked = np.zeros(4), np.zeros(4)
    for share in speeds:
        command = VelocityCommand(*(np.array(share) * LIMITS).tolist())
        move = quantiser.move(command, dt).array
        assert np.allclose(move / resolution, np.rint(move / resolution), rtol=0, atol=1e-6)
        total, asked = total + move, asked + command.array * dt
    most = len(speeds) * (np.array(LIMITS) * dt + resolution)
    assert (np.abs(quantiser.remainder) <= resolution * (1 + 1e-9)).all()
    assert (
        np.abs(total + quantiser.remainder - asked) <= 4 * len(speeds) * tolerances.eps("float64") * most
    ).all()


@given(wanted=st.lists(spread(-300, 300), min_size=1, max_size=6), limit=st.floats(-100, 100))
def test_saturation_keeps_the_direction_and_every_limit(wanted: list[float], limit: float) -> None:
    limits = 10.0 ** (limit + np.arange(len(wanted)))
    try:
        found = saturate(wanted, limits)
    except InputError:
        assert np.max(np.log10(np.maximum(np.abs(wanted), 1e-300)) - np.log10(limits)) > 307
        return
    assert (np.abs(found) <= limits).all()
    share = np.max(np.abs(wanted) / limits)
    scaled = np.array(wanted) / max(share, 1.0)
    np.testing.assert_allclose(found, scaled, rtol=4e-16, atol=5e-324)


@given(delay=st.one_of(st.floats(0, 10), spread(-9, 300).map(abs)), period=st.floats(1e-9, 1e3))
def test_any_delay_has_a_gain_that_does_not_overshoot_or_is_refused(delay: float, period: float) -> None:
    try:
        d = samples_late(delay, period)
    except InputError:
        assert delay / period > 1e6
        return
    gain = gain_from_delay(delay, period) * period
    # Eq. C7: e^-1 of a period's inverse at the latest, and one period at the soonest.
    assert 1 / (math.e * (d + 1)) * (1 - 1e-9) <= gain <= 1 / (d + 1) * (1 + 1e-12)


# ---- frames that are on the device already ----------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_spoilt_pixel_on_the_device_spreads_over_the_frame_and_every_search_says_so(
    device: Device, value: float
) -> None:
    shape = (48, 52)
    plan = Restore(device, shape, padding=6)
    axes = envelope._coded_axes(plan.padded_shape, "float32")
    plan.set_filter_axes(*axes, 0.05)
    image = envelope._texture(shape, 3).astype(np.float32)
    template = Template.cut(image, (24.0, 24.0), (12, 12), noise=0.01)
    tracker = TemplateTracker(device, shape, [template], (30, 30))
    spoilt = image.copy()
    spoilt[40, 3] = value
    with pytest.raises(InputError, match="NaN or infinity"):
        plan.restore(spoilt)
    out = plan(device.upload(spoilt), device.empty(shape, np.float32))
    assert not np.isfinite(out.download()).any()
    (found,) = tracker.track(out, np.array([[24.0, 24.0]]))
    assert found.lost
    assert found.reason == "the image is not finite under the window"


@settings(max_examples=15)
@given(level=spread(-40, 38), nsr=st.floats(0, 1e3))
@example(level=3e38, nsr=0.0)
@example(level=1e15, nsr=1e-30)
def test_a_frame_of_reals_makes_an_image_of_bytes_that_is_right_or_is_refused(
    device: Device, level: float, nsr: float
) -> None:
    plan = bytes_plan(device)
    ny, nx = plan.padded_shape
    plan.set_filter_axes(np.full(ny, 0.5), np.full(nx, 0.5), nsr)
    frame = np.full(plan.shape, level, np.float32)
    try:
        image = plan.restore(frame)
    except LimitError:
        assert abs(level) > 0.99 * FRAME_LIMIT
        return
    wanted = np.clip(float(frame[0, 0]) * 0.25 / (0.0625 + nsr), 0, 255)
    assert np.abs(image - wanted).max() <= 0.5 + 1e-5 * wanted


@cache
def bytes_plan(device: Device) -> Restore:
    return Restore(device, (24, 20), padding=3, out_dtype=np.uint8)
