"""The extremes: every row of the envelope holds on this device, and nothing slips between its points."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import tolerances
from adof_cl import envelope, reference
from adof_cl.cli import main
from adof_cl.device import Device
from adof_cl.envelope import ROWS, Outcome, Point, Row
from adof_cl.errors import AdofError, InputError, LimitError
from adof_cl.finite import TRANSFER_LIMIT
from adof_cl.noise import NSR_LIMIT, noise_to_signal
from adof_cl.otf import Otf1d
from adof_cl.restore import Restore
from adof_cl.servo import require_stable_gain, stability_limit_per_s
from adof_cl.stereo import REFUSE_ANGLE_RAD, AffineCamera, StereoRig, triangulate
from adof_cl.wiener import WienerFilter, psf_otf

CASES = [(row, storage) for row in ROWS for storage in row.storages]
U = np.concatenate([np.linspace(-2.1, 2.1, 43), [1e-9, 1e-4]])
SHAPE = (12, 20)

precisions = st.sampled_from(("float32", "float64"))

signed = st.one_of(
    st.just(0.0), st.builds(lambda e, s: s * 10.0**e, st.floats(-12, 5), st.sampled_from((-1, 1)))
)


@pytest.mark.parametrize(("row", "storage"), CASES, ids=[f"{row.name}-{storage}" for row, storage in CASES])
def test_every_promise_of_the_row_is_kept(device: Device, row: Row, storage: str) -> None:
    if storage == "float64" and len(row.storages) > 1 and not device.facts.fp64:
        pytest.skip(f"{device.facts} has no float64")
    outcome = envelope.measured(device, row, storage, quick=True)
    assert outcome.points
    assert [point for point in outcome.points if not point.ok] == []
    if row.name in ("otf-alpha", "otf-psi", "wiener-nsr", "restore-nsr", "restore-size"):
        assert len({point.at for point in outcome.points if point.bound}) >= 3  # there is a curve to draw


# ---- a broken promise shows -------------------------------------------------------------------------------


def outcome_of(points: Iterator[Point], device: Device) -> Outcome:
    row = Row("made", "", "", "", "", "", "", lambda *_: points)
    return envelope.measured(device, row, "float32")


@pytest.mark.parametrize("error", [2.0, math.nan, math.inf])
def test_an_error_beyond_its_bound_fails_the_row_and_nan_counts_as_one(device: Device, error: float) -> None:
    assert outcome_of(iter([envelope._answer(1.0, 0.5, 1.0)]), device).ok
    assert not outcome_of(iter([envelope._answer(1.0, np.array([0.0, error]), 1.0)]), device).ok


def test_a_refusal_that_does_not_come_fails_the_row(device: Device) -> None:
    assert not outcome_of(iter([envelope._refusal(1.0, lambda: None)]), device).ok


def test_what_a_driver_throws_is_a_failed_point_and_what_was_measured_stays(device: Device) -> None:
    def points() -> Iterator[Point]:
        yield Point(1.0, 0.5, 1.0)
        raise RuntimeError("the device is gone")

    outcome = outcome_of(points(), device)
    assert [point.ok for point in outcome.points] == [True, False]
    assert "the device is gone" in outcome.points[-1].failure


# ---- the whole domain, not only the points ----------------------------------------------------------------


def precision_of(device: Device, precision: str) -> str:
    return precision if device.facts.fp64 else "float32"


@cache
def otf_plan(device: Device, precision: str) -> Otf1d:
    return Otf1d(device, U, precision=precision)


@cache
def wiener_plan(device: Device, precision: str) -> WienerFilter:
    return WienerFilter(device, SHAPE, precision=precision)


@cache
def restore_plan(device: Device, half: bool) -> Restore:
    kind = np.dtype(np.uint8 if half else np.float32)
    spectrum = np.float16 if half else None
    return Restore(device, SHAPE, padding=3, in_dtype=kind, out_dtype=kind, spectrum_dtype=spectrum)


@given(precision=precisions, alpha=signed, psi=st.floats(-500, 500))
def test_any_mask_and_defocus_give_the_exact_transfer(
    device: Device, precision: str, alpha: float, psi: float
) -> None:
    precision = precision_of(device, precision)
    alpha = float(np.clip(alpha, -1e5, 1e5))
    error = np.abs(otf_plan(device, precision).evaluate(alpha, psi) - reference.otf_1d(U, alpha, psi)).max()
    assert error <= envelope._otf_bound(precision)


@given(
    precision=precisions,
    exponent=st.floats(-23, 2.9),
    nsr_exponent=st.floats(-44, 12),
    seed=st.integers(0, 99),
)
def test_any_transfer_above_the_least_and_any_noise_give_the_wiener_gain(
    device: Device, precision: str, exponent: float, nsr_exponent: float, seed: int
) -> None:
    precision = precision_of(device, precision)
    plan = wiener_plan(device, precision)
    rng = np.random.default_rng(seed)
    kind = np.result_type(precision, np.complex64)
    turns = np.exp(2j * np.pi * rng.random(plan.filter_shape))
    otf = (10.0 ** np.minimum(exponent + rng.uniform(-1, 1, plan.filter_shape), 2.9) * turns).astype(kind)
    nsr = float(np.dtype(precision).type(10.0 ** (nsr_exponent - 1e-9)))
    nsr = nsr if nsr >= np.finfo("float32").tiny else 0.0
    wanted = reference.wiener(otf, nsr)
    found = plan.from_otf(otf, nsr).download()
    allowed = tolerances.wiener_relative(precision) * np.abs(wanted) + 2 * np.finfo("float32").tiny
    assert (np.abs(found - wanted) <= allowed).all()


@given(
    frame=arrays.arrays(np.float32, SHAPE, elements=st.floats(width=32)),
    nsr=st.floats(0, 2e12),
    scale=st.floats(0, 2e3),
)
def test_any_frame_noise_and_transfer_give_finite_pixels_or_a_refusal(
    device: Device, frame: np.ndarray, nsr: float, scale: float
) -> None:
    plan = restore_plan(device, half=False)
    ny, nx = plan.padded_shape
    try:
        plan.set_filter_axes(np.full(ny, scale), np.ones(nx), nsr)
        image = plan.restore(frame)
    except AdofError:
        return
    assert np.isfinite(image).all()


@given(data=st.data())
def test_in_halves_any_filter_is_refused_or_within_its_bound(device: Device, data: st.DataObject) -> None:
    plan = restore_plan(device, half=True)
    frame = data.draw(arrays.arrays(np.uint8, SHAPE, elements=st.sampled_from((0, 1, 128, 255))))
    scale = data.draw(st.floats(1e-3, 1))
    nsr = data.draw(st.sampled_from((0.0, 1e-12, 1e-4, 1e-2, 1.0, 1e6)))
    ny, nx = plan.padded_shape
    axes = [np.full(n, scale, np.complex64) for n in (ny, nx)]
    for axis in axes:
        axis[0] = 1
    try:
        point = envelope._restored(plan, nsr, frame, (axes[0], axes[1]), nsr)
    except LimitError:
        largest = plan.line_gain(reference.wiener_of_axes(axes[0], axes[1], nsr))
        assert largest > (1 - 1e-6) * plan.half_gain_limit
        return
    assert point.ok


@given(
    psf=arrays.arrays(
        np.float64, st.tuples(st.integers(1, 12), st.integers(1, 20)), elements=st.floats(width=64)
    )
)
def test_any_psf_gives_a_transfer_function_or_a_refusal(psf: np.ndarray) -> None:
    try:
        otf = psf_otf(psf, SHAPE)
    except InputError:
        return
    assert abs(otf[0, 0] - 1) <= 1e3 * psf.size * tolerances.eps("float64")
    assert np.abs(otf).max() <= TRANSFER_LIMIT * (1 + psf.size * tolerances.eps("float64"))


@given(frame=arrays.arrays(np.float64, SHAPE, elements=st.floats(width=64)))
def test_any_frame_gives_a_noise_level_above_0_or_a_refusal(frame: np.ndarray) -> None:
    try:
        nsr = noise_to_signal(frame, np.ones((12, 11), np.complex128), SHAPE)
    except InputError:
        assert not np.isfinite(frame).all()
        return
    assert np.isfinite(nsr).all()
    assert 0 < nsr.min() <= nsr.max() <= NSR_LIMIT


@given(degrees=st.floats(0, 90), away=st.floats(-1e6, 1e6), seed=st.integers(0, 99))
def test_any_angle_and_any_origin_give_the_point_or_a_refusal(degrees: float, away: float, seed: int) -> None:
    angle = math.radians(degrees)
    origin = np.array([away, -away, away])
    try:
        rig = StereoRig(envelope._camera(0, origin), envelope._camera(angle, origin))
    except AdofError:
        assert angle < REFUSE_ANGLE_RAD * (1 + 1e-9)
        return
    truth = origin + np.random.default_rng(seed).uniform(-4e3, 4e3, 3)
    fix = triangulate(rig, rig.camera_1.project(truth), rig.camera_2.project(truth))
    pixels = 0.27 * np.abs(truth).max() + 512
    assert np.abs(fix.xyz_um - truth).max() <= 16 * tolerances.eps("float64") * rig.condition * pixels / 0.135


@given(share=st.floats(0.001, 10), delay=st.floats(0, 2), period=st.floats(1e-3, 1))
def test_a_gain_is_taken_just_where_it_is_at_most_half_the_limit(
    share: float, delay: float, period: float
) -> None:
    gain = share * stability_limit_per_s(delay, period)
    if share <= 0.5:
        require_stable_gain(gain, delay, period)
    elif share > 0.5 * (1 + 1e-8):
        with pytest.raises(LimitError, match="without overshoot"):
            require_stable_gain(gain, delay, period)


# ---- what was a silent wrong value ------------------------------------------------------------------------


@pytest.mark.parametrize("value", [1e300, 2e15, math.nan])
def test_a_gain_no_number_could_carry_is_refused_and_the_slot_keeps_what_it_had(
    device: Device, value: float
) -> None:
    plan = restore_plan(device, half=False)
    ny, nx = plan.padded_shape
    frame = np.random.default_rng(0).random(SHAPE).astype(np.float32)
    plan.set_filter(np.ones((ny, nx // 2 + 1)))
    before = plan.restore(frame).copy()
    with pytest.raises(InputError):
        plan.set_filter(np.full((ny, nx // 2 + 1), value))
    for axes, nsr in (((np.full(ny, value), np.ones(nx)), 1.0), ((np.ones(ny), np.ones(nx)), 1e20)):
        with pytest.raises(InputError):
            plan.set_filter_axes(*axes, nsr)
    np.testing.assert_array_equal(plan.restore(frame), before)


def test_an_image_beyond_float32_is_refused_not_returned_as_nan(device: Device) -> None:
    plan = restore_plan(device, half=False)
    ny, nx = plan.padded_shape
    plan.set_filter(np.ones((ny, nx // 2 + 1)))
    with pytest.raises(LimitError, match="too large"):
        plan.restore(np.full(SHAPE, 3e38, np.float32))


def test_in_halves_a_filter_whose_gain_cannot_be_bounded_is_refused(device: Device) -> None:
    plan = restore_plan(device, half=True)
    ny, nx = plan.padded_shape
    table = device.upload(np.ones(ny + nx, np.complex64))
    for refused in (
        lambda: plan.set_filter_table(table, 0.0),
        lambda: plan.set_filter(device.upload(np.ones((ny, nx // 2 + 1), np.complex64))),
        lambda: plan.set_filter(np.full((ny, nx // 2 + 1), 1.01 * plan.half_gain_limit)),
    ):
        with pytest.raises(LimitError, match="half numbers"):
            refused()
    plan.set_filter(np.full((ny, nx // 2 + 1), 0.99 * plan.half_gain_limit))
    assert (plan.restore(np.full(SHAPE, 255, np.uint8)) == 255).all()


def test_two_exact_cameras_that_look_along_one_line_are_refused() -> None:
    camera = envelope._camera(0.3, np.zeros(3))
    with pytest.raises(AdofError, match="lines of sight"):
        StereoRig(camera, AffineCamera.exact(camera.matrix_px_per_um, camera.offset_px))


# ---- the command ------------------------------------------------------------------------------------------


def test_the_command_writes_every_point_the_table_and_the_plots(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = tuple(row for row in ROWS if row.name in ("stereo-angle", "auto-nsr"))
    monkeypatch.setattr(envelope, "ROWS", chosen)
    files = [tmp_path / name for name in ("points.json", "table.md", "plots")]
    words = [
        "envelope",
        "--quick",
        "--json",
        str(files[0]),
        "--table",
        str(files[1]),
        "--plots",
        str(files[2]),
    ]
    with pytest.raises(SystemExit) as done:
        main([*words, "--device", str(device.facts.index)])
    assert not done.value.code
    assert "2 rows, 0 rows failed" in capsys.readouterr().out
    found = json.loads(files[0].read_text())["rows"]
    assert [row["name"] for row in found] == [row.name for row in chosen]
    assert all(row["ok"] and row["points"] for row in found)
    assert "| stereo-angle | float64 |" in files[1].read_text()
    assert sorted(file.name for file in files[2].iterdir()) == ["envelope.png", "stereo-angle.png"]
    assert all(file.stat().st_size > 5000 for file in files[2].iterdir())


def test_the_command_exits_1_where_a_promise_is_broken(
    device: Device, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = Row("made", "", "", "", "", "", "", lambda *_: iter([Point(1.0, 2.0, 1.0)]), ("float32",))
    monkeypatch.setattr(envelope, "ROWS", (broken,))
    with pytest.raises(SystemExit) as done:
        main(["envelope", "--device", str(device.facts.index)])
    assert done.value.code == 1
    assert "FAILED" in capsys.readouterr().out


def test_a_place_that_cannot_be_written_is_refused_before_anything_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as done:
        main(["envelope", "--json", str(tmp_path / "none" / "e.json")])
    assert done.value.code == 2
    assert "cannot be written" in capsys.readouterr().err
