from __future__ import annotations

import copy
from dataclasses import replace
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
from adof_cl.fft_passes import Passes, cost_of, radices_of
from adof_cl.optics import OpticalSystem
from adof_cl.otf_table import OtfTable
from adof_cl.padding import good_size, padded_frame, padded_shape
from adof_cl.restore import Restore

SHAPE = (23, 37)
PADDING = (5, 8)


@pytest.fixture(params=["lanes", "groups"])
def family(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@cache
def plan_of(device: Device, family: str, **options: Any) -> Restore:
    """One plan for all laws of a kind: they change nothing but the filters."""
    return Restore(device, SHAPE, family=family, padding=PADDING, **options)


def random_frame(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    return (255 * np.random.default_rng(seed).random(shape)).astype(np.float32)


def cubic_axes(padded: tuple[int, int], alpha: float = 20, psi: float = 10) -> list[np.ndarray]:
    """Axes of a coded camera's OTF, as complex64 holds them, Nyquist bins real."""
    optics = OpticalSystem()
    axes = [reference.otf_1d(optics.frequency_axis(n), alpha, psi).astype(np.complex64) for n in padded]
    for axis in axes:
        if axis.size % 2 == 0:
            axis[axis.size // 2] = axis[axis.size // 2].real
    return axes


def relative_l2(found: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))


@pytest.mark.parametrize(
    ("family", "precision", "shape"),
    [
        *(
            ("lanes", "float32", shape)
            for shape in ((8, 8), (127, 251), (494, 659), (400, 512), (1024, 1024))
        ),
        *(("lanes", "float64", shape) for shape in ((8, 8), (93, 57), (494, 659))),
        *(("groups", "float32", shape) for shape in ((8, 8), (127, 251), (400, 512))),
        ("groups", "float64", (93, 57)),
    ],
    ids=str,
)
def test_every_size_agrees_with_the_numpy_page(
    device: Device, family: str, precision: str, shape: tuple[int, int]
) -> None:
    if precision == "float64" and not device.facts.fp64:
        pytest.skip(f"{device.facts} has no float64")
    plan = Restore(device, shape, family=family, precision=precision, out_dtype=precision)
    rows, columns = cubic_axes(plan.padded_shape)
    plan.set_filter_axes(rows, columns, 0.01)
    frame = random_frame(shape)
    gain = reference.wiener_of_axes(rows, columns, 0.01)
    wanted = reference.restore(frame, gain, plan.padded_shape)
    assert relative_l2(plan.restore(frame), wanted) <= tolerances.restore_relative_l2(precision)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(23, 37), (96, 128), (127, 251)], ids=str)
def test_a_spectrum_in_halves_stays_within_three_of_255_grey_levels(
    device: Device, family: str, shape: tuple[int, int], dtype: type
) -> None:
    top = np.iinfo(dtype).max
    plan = Restore(device, shape, family=family, in_dtype=dtype, out_dtype=dtype, spectrum_dtype=np.float16)
    rows, columns = cubic_axes(plan.padded_shape)
    plan.set_filter_axes(rows, columns, 0.01)
    rng = np.random.default_rng(3)
    # As bright as it can be: nothing may overflow.
    frame = rng.integers(top // 2, top, shape, dtype=dtype, endpoint=True)
    frame[5:12, 7:20] = top
    gain = reference.wiener_of_axes(rows, columns, 0.01)
    wanted = np.clip(reference.restore(frame, gain, plan.padded_shape), 0, top)
    found = plan.restore(frame).astype(np.float64)
    assert np.abs(found - wanted).max() <= 3 * top / 255
    assert relative_l2(found, wanted) <= 3e-3


@pytest.mark.parametrize("other", [{"kind": "gpu"}, {"compute_units": 1}, {"compute_units": 7}], ids=str)
def test_an_image_does_not_depend_on_which_work_items_take_its_tasks(
    device: Device, other: dict[str, Any]
) -> None:
    """A launch a step; one work-item; more than there are cores: bit for bit the same, every time."""
    plan = plan_of(device, "lanes")
    opened = copy.copy(device)
    opened.facts = replace(device.facts, **other)
    second = Restore(opened, SHAPE, family="lanes", padding=PADDING)
    frames = [random_frame(SHAPE, seed) for seed in range(4)]
    for each in (plan, second):
        each.set_filter_axes(*cubic_axes(each.padded_shape), 0.02)
    wanted = [plan.restore(frame) for frame in frames]
    for turn in range(200):
        for each in (plan, second):
            np.testing.assert_array_equal(each.restore(frames[turn % 4]), wanted[turn % 4])


def test_a_filter_follows_its_table(device: Device, family: str) -> None:
    plan = plan_of(device, family)
    table = OtfTable(device, OpticalSystem(), plan.padded_shape, entries=2)
    frame = random_frame(SHAPE)
    table.update([(20, 10), (30, -5)])
    plan.set_filter_table(table.out, 0.02, entry=1)
    before = plan.restore(frame)
    table.update([(30, -5), (20, 10)])
    after = plan.restore(frame)
    plan.set_filter_table(table.out, 0.02, entry=0)
    np.testing.assert_array_equal(plan.restore(frame), before)
    assert not np.array_equal(after, before)
    rows, columns = table.axes(1)
    wanted = reference.restore(frame, reference.wiener_of_axes(rows, columns, 0.02), plan.padded_shape)
    assert relative_l2(after, wanted) <= tolerances.restore_relative_l2("float32")


def test_an_image_larger_than_the_caches_is_streamed_and_the_same(device: Device) -> None:
    shape = (40, 4 * 64)
    results = []
    for size in (device.facts.cache_bytes, 1):
        opened = copy.copy(device)
        opened.facts = replace(device.facts, cache_bytes=size)
        plan = Restore(opened, shape, family="lanes")
        plan.set_filter_axes(*cubic_axes(plan.padded_shape), 0.02)
        results.append(plan.restore(random_frame(shape)))
    np.testing.assert_array_equal(results[1], results[0])


@pytest.mark.parametrize("taper", [True, False])
def test_the_padding_is_that_of_the_numpy_page(device: Device, family: str, taper: bool) -> None:
    plan = plan_of(device, family, taper=taper)
    frame = random_frame(SHAPE)
    wanted = reference.restore_padding(frame, plan.padded_shape, taper=taper)
    np.testing.assert_allclose(padded_frame(frame, plan.padded_shape, taper=taper), wanted, rtol=1e-14)
    # A filter that moves everything by (dy, dx) brings the padding into view.
    ny, nx = plan.padded_shape
    dy, dx = ny - SHAPE[0], nx - SHAPE[1]
    v, u = np.fft.fftfreq(ny)[:, None], np.fft.rfftfreq(nx)[None, :]
    plan.set_filter(np.exp(-2j * np.pi * (v * dy + u * dx)))
    moved = np.roll(wanted, (dy, dx), (0, 1))[: SHAPE[0], : SHAPE[1]]
    assert relative_l2(plan.restore(frame), moved) <= tolerances.restore_relative_l2("float32")


def test_a_perfect_system_without_noise_returns_the_frame(device: Device, family: str) -> None:
    plan = plan_of(device, family)
    ny, nx = plan.padded_shape
    plan.set_filter_axes(np.ones(ny), np.ones(nx), 0)
    frame = random_frame(SHAPE)
    assert relative_l2(plan.restore(frame), frame) <= tolerances.restore_relative_l2("float32")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_come_back_exactly_and_are_rounded_and_clamped(
    device: Device, family: str, dtype: type
) -> None:
    top = np.iinfo(dtype).max
    frame = np.random.default_rng(1).integers(0, top, SHAPE, dtype=dtype, endpoint=True)
    plan = plan_of(device, family, in_dtype=dtype, out_dtype=dtype)
    ny, nx = plan.padded_shape
    gain = np.ones((ny, nx // 2 + 1))
    plan.set_filter(gain)
    np.testing.assert_array_equal(plan.restore(frame), frame)
    # Sixteenths but for the ties: float32 holds 0.02 at 65535.
    exact = frame.astype(np.float64) * 17 / 16
    plan.set_filter(17 / 16 * gain)
    wanted = np.clip(np.floor(exact + 0.5), 0, top)
    clear = exact % 1 != 0.5
    np.testing.assert_array_equal(plan.restore(frame)[clear], wanted[clear])
    plan.set_filter(-gain)
    assert not plan.restore(frame).any()


def test_a_known_kernel_paints_a_point_with_itself(device: Device, family: str) -> None:
    plan = plan_of(device, family, in_dtype=np.uint8, out_dtype=np.uint8)
    ny, nx = plan.padded_shape
    kernel = np.zeros((ny, nx))
    kernel[:2, :3] = [[1, 2, 3], [4, 5, 6]]
    frame = np.zeros(SHAPE, dtype=np.uint8)
    frame[7, 11] = 10
    plan.set_filter(np.fft.rfft2(kernel))
    wanted = np.zeros(SHAPE)
    wanted[7:9, 11:14] = [[10, 20, 30], [40, 50, 60]]
    np.testing.assert_array_equal(plan.restore(frame), wanted)


def test_moving_a_scene_moves_its_restoration(device: Device, family: str) -> None:
    plan = plan_of(device, family)
    plan.set_filter_axes(*cubic_axes(plan.padded_shape), 0.1)
    frame = np.zeros(SHAPE, dtype=np.float32)
    frame[9:12, 15:19] = 100
    # Flat edges: padding and wrap see only zeros, so the shift is circular.
    moved = plan.restore(np.roll(frame, (2, -3), (0, 1)))[4:-4, 5:-5]
    there = np.roll(plan.restore(frame), (2, -3), (0, 1))[4:-4, 5:-5]
    assert relative_l2(moved, there) <= 2 * tolerances.restore_relative_l2("float32")


@given(a=st.floats(-3, 3, width=32), b=st.floats(0.5, 3, width=32), seed=st.integers(0, 99))
def test_restoration_is_linear(device: Device, a: float, b: float, seed: int) -> None:
    plan = plan_of(device, "lanes")
    plan.set_filter_axes(*cubic_axes(plan.padded_shape), 0.05)
    f, g = random_frame(SHAPE, seed), random_frame(SHAPE, seed + 100)
    parts = a * plan.restore(f).astype(np.float64) + b * plan.restore(g)
    size = abs(a) * np.linalg.norm(f) + b * np.linalg.norm(g)
    whole = plan.restore((a * f + b * g).astype(np.float32))
    assert np.linalg.norm(whole - parts) / size <= 2 * tolerances.restore_relative_l2("float32")


def test_a_dim_frame_is_restored_as_a_bright_one_bit_for_bit(device: Device, family: str) -> None:
    # What stands below the frame in its last block of rows would show here, were it anything but zero.
    plan = plan_of(device, family)
    plan.set_filter_axes(*cubic_axes(plan.padded_shape), 0.05)
    frame = random_frame(SHAPE)
    dim = np.float32(2**-20)
    np.testing.assert_array_equal(plan.restore(frame * dim), plan.restore(frame) * dim)


def blurred_scene(shape: tuple[int, int], margin: int, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a scene of bright blocks and its coded picture, cut from a wider field."""
    rng = np.random.default_rng(5)
    field = good_size(max(shape) + 2 * margin)
    scene = np.full((field, field), 40.0)
    for y, x in rng.integers(0, field, (field, 2)):
        scene[y : y + 9, x : x + 6] = rng.integers(40, 220)
    rows, columns = cubic_axes((field, field), alpha, 0)
    picture = np.fft.ifft2(np.fft.fft2(scene) * np.outer(rows, columns)).real
    crop = np.s_[margin : margin + shape[0], margin : margin + shape[1]]
    return scene[crop], picture[crop]


def test_a_blurred_scene_is_recovered_and_replicated_edges_beat_zeros(device: Device) -> None:
    shape, padding = (96, 120), 32
    scene, picture = blurred_scene(shape, 64, alpha=53.5)
    plan = Restore(device, shape, padding=padding)
    rows, columns = cubic_axes(plan.padded_shape, 53.5, 0)
    plan.set_filter_axes(rows, columns, 1e-3)
    restored = plan.restore(picture.astype(np.float32))

    def rms(image: np.ndarray, edge: int = 0) -> float:
        inside = np.s_[edge : shape[0] - edge, edge : shape[1] - edge]
        return float(np.sqrt(np.mean((image - scene)[inside] ** 2)))

    assert rms(restored, 24) < 0.25 * rms(picture, 24)
    zeros = np.zeros(plan.padded_shape)
    zeros[: shape[0], : shape[1]] = picture
    naive = reference.restore(zeros, reference.wiener_of_axes(rows, columns, 1e-3), plan.padded_shape)
    assert rms(restored) < 0.6 * rms(naive[: shape[0], : shape[1]])


def test_a_complex_nyquist_bin_loses_the_finest_stripes_and_is_made_real(device: Device, family: str) -> None:
    ny, nx = padded = (24, 40)
    plan = Restore(device, padded, family=family)
    lag = 0.3  # pixels; a real camera's samples see the real part of the phase it puts on the finest stripes
    u = np.fft.fftfreq(nx)
    otf = np.exp(2j * np.pi * u * lag)
    at_nyquist = np.cos(np.pi * lag)
    stripes = np.tile(50 * (-1.0) ** np.arange(nx), (ny, 1))
    frame = (100 + at_nyquist * stripes).astype(np.float32)
    plan.set_filter_axes(np.ones(ny), otf, 0)
    bound = tolerances.restore_relative_l2("float32") * np.abs(frame).max() * 10
    np.testing.assert_allclose(plan.restore(frame), 100 + stripes, atol=bound)
    naive = np.outer(np.ones(ny), otf[: nx // 2 + 1].conj())
    plan.set_filter(naive)
    assert np.abs(plan.restore(frame) - 100).max() < 50 * (at_nyquist**2 + 0.01)


def test_slots_keep_their_filters_and_one_transform_serves_several(device: Device, family: str) -> None:
    plan = plan_of(device, family)
    frame = device.upload(random_frame(SHAPE))
    for slot, alpha in enumerate((5.0, 30.0)):
        plan.set_filter_axes(*cubic_axes(plan.padded_shape, alpha), 0.02, slot)
    single = [plan(frame, device.empty(SHAPE, np.float32), slot).download().copy() for slot in (0, 1)]
    plan.transform(frame)
    both = [plan.apply(device.empty(SHAPE, np.float32), slot).download() for slot in (1, 0)]
    assert not np.array_equal(single[0], single[1])
    np.testing.assert_array_equal(both[1], single[0])
    np.testing.assert_array_equal(both[0], single[1])


def test_axes_on_the_device_and_a_table_give_the_filter_the_host_would(device: Device, family: str) -> None:
    plan = plan_of(device, family)
    rows, columns = cubic_axes(plan.padded_shape)
    frame = random_frame(SHAPE)
    plan.set_filter_axes(rows, columns, 0.02, slot=3)
    wanted = plan.restore(frame, slot=3)
    pair = np.concatenate([rows, columns])
    plan.set_filter_table(device.upload(np.stack([0 * pair, pair, 0 * pair])), 0.02, slot=4, entry=1)
    np.testing.assert_array_equal(plan.restore(frame, slot=4), wanted)
    plan.set_filter_table(device.upload(pair), 0.02, slot=4)
    np.testing.assert_array_equal(plan.restore(frame, slot=4), wanted)


def test_noise_given_for_each_frequency_is_used_for_each(device: Device, family: str) -> None:
    plan = plan_of(device, family)
    ny, nx = plan.padded_shape
    rows, columns = cubic_axes(plan.padded_shape)
    nsr = np.random.default_rng(2).uniform(0.01, 1, (ny, nx // 2 + 1)).astype(np.float32)
    frame = random_frame(SHAPE)
    wanted = reference.restore(frame, reference.wiener_of_axes(rows, columns, nsr), plan.padded_shape)
    plan.set_filter_axes(rows, columns, nsr)
    assert relative_l2(plan.restore(frame), wanted) <= tolerances.restore_relative_l2("float32")


def test_a_filter_formed_on_the_device_acts_like_the_same_one_from_the_host(device: Device) -> None:
    plan = plan_of(device, "lanes")
    ny, nx = plan.padded_shape
    gain = (
        np.random.default_rng(4)
        .normal(size=(ny, nx // 2 + 1, 2))
        .astype(np.float32)
        .view(np.complex64)[..., 0]
    )
    frame = random_frame(SHAPE)
    plan.set_filter(gain)
    wanted = plan.restore(frame)
    plan.set_filter(device.upload(gain))
    np.testing.assert_array_equal(plan.restore(frame), wanted)
    # Any filter at all means what rfft2 and irfft2 make of it, its bins that mirror themselves included.
    page = reference.restore(frame, gain, plan.padded_shape)
    assert relative_l2(wanted, page) <= tolerances.restore_relative_l2("float32")


@pytest.mark.parametrize("local_memory", [256, 2000])
def test_axes_too_long_for_local_memory_are_restored_in_global_memory(
    device: Device, local_memory: int
) -> None:
    small = copy.copy(device)
    small.facts = replace(device.facts, local_memory_bytes=local_memory, max_work_group_size=64)
    results = []
    for opened in (device, small):
        plan = Restore(opened, SHAPE, family="groups", padding=PADDING)
        plan.set_filter_axes(*cubic_axes(plan.padded_shape), 0.02)
        results.append(plan.restore(random_frame(SHAPE)))
    assert relative_l2(results[1], results[0]) <= tolerances.restore_relative_l2("float32")


def test_what_opencl_itself_offers_is_enough(device: Device) -> None:
    plain = copy.copy(device)
    plain.facts = replace(device.facts, simulated=True)
    results = []
    for opened in (device, plain):
        plan = Restore(opened, SHAPE, family="lanes", padding=PADDING)
        plan.set_filter_axes(*cubic_axes(plan.padded_shape), 0.02)
        results.append(plan.restore(random_frame(SHAPE)))
    assert relative_l2(results[1], results[0]) <= tolerances.restore_relative_l2("float32")


def test_the_family_follows_from_the_kind_of_device(device: Device) -> None:
    wanted = "lanes" if device.facts.kind == "cpu" else "groups"
    assert Restore(device, SHAPE, padding=PADDING).family == wanted


# ---- refusals ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"shape": (7, 64)}, "8 to 4096"),
        ({"shape": (64, 4097)}, "8 to 4096"),
        ({"shape": (8, 8, 3)}, "8 to 4096"),
        ({"padding": -1}, "0 or more"),
        ({"padding": (1, 2, 3)}, "0 or more"),
        ({"padding": 20000}, "16384"),
        ({"in_dtype": np.int32}, "in_dtype"),
        ({"out_dtype": np.float64}, "out_dtype"),
        ({"family": "threads"}, "family"),
        ({"precision": "half"}, "precision"),
        ({"spectrum_dtype": np.float16}, "65504"),
        ({"spectrum_dtype": np.float64}, "spectrum_dtype"),
        ({"spectrum_dtype": np.float16, "precision": "float64"}, "spectrum_dtype"),
    ],
)
def test_a_plan_beyond_the_limits_is_refused(device: Device, options: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Restore(device, **{"shape": (16, 16), **options})


def with_nan(values: np.ndarray) -> np.ndarray:
    spoilt = values.copy()
    spoilt.flat[3] = np.nan
    return spoilt


NY, NX = padded_shape(SHAPE, PADDING)
HALF = (NY, NX // 2 + 1)
ROWS, COLUMNS = np.ones(NY), np.ones(NX)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((ROWS[1:], COLUMNS, 0.1), "h_rows"),
        ((ROWS, COLUMNS[1:], 0.1), "h_cols"),
        ((with_nan(ROWS), COLUMNS, 0.1), "NaN"),
        ((ROWS, COLUMNS, -0.1), "0 or more"),
        ((ROWS, COLUMNS, np.nan), "NaN"),
        ((ROWS, COLUMNS, np.ones((3, 3))), "nsr"),
        ((ROWS, COLUMNS, -np.ones(HALF)), "0 or more"),
        ((ROWS, COLUMNS, 0.1, -1), "slot"),
    ],
)
def test_a_wrong_blur_is_refused_and_the_filter_stays(
    device: Device, arguments: tuple[Any, ...], said: str
) -> None:
    plan = plan_of(device, "lanes")
    plan.set_filter(np.full(HALF, 2.0))
    with pytest.raises(InputError, match=said):
        plan.set_filter_axes(*arguments)
    frame = random_frame(SHAPE)
    assert relative_l2(plan.restore(frame), 2 * frame) <= tolerances.restore_relative_l2("float32")


@pytest.mark.parametrize("gain", [np.ones((3, 3)), with_nan(np.ones(HALF)), np.full(HALF, "a")])
def test_a_wrong_filter_is_refused_and_the_old_one_stays(device: Device, gain: np.ndarray) -> None:
    plan = plan_of(device, "lanes")
    plan.set_filter(np.full(HALF, 2.0))
    with pytest.raises(InputError, match="filter"):
        plan.set_filter(gain)
    with pytest.raises(InputError, match="filter"):
        plan.set_filter(device.empty((3, 3), np.complex64))
    frame = random_frame(SHAPE)
    assert relative_l2(plan.restore(frame), 2 * frame) <= tolerances.restore_relative_l2("float32")


def test_a_wrong_table_on_the_device_is_refused_and_the_filter_stays(device: Device) -> None:
    plan = plan_of(device, "lanes")
    plan.set_filter(np.full(HALF, 2.0))
    pair = np.concatenate([ROWS, COLUMNS]).astype(np.complex64)
    table = device.upload(pair)
    for arguments, options, said in (
        ((device.upload(pair[1:]), 0.1), {}, "rows, then of columns"),
        ((device.upload(pair.astype(np.complex128)), 0.1), {}, "complex64"),
        ((table, 0.1), {"entry": 1}, "entry 1"),
        ((table, table), {}, "nsr"),
        ((table, -1.0), {}, "nsr"),
        ((table, 0.1), {"slot": 0.5}, "slot"),
    ):
        with pytest.raises(InputError, match=said):
            plan.set_filter_table(*arguments, **options)
    frame = random_frame(SHAPE)
    assert relative_l2(plan.restore(frame), 2 * frame) <= tolerances.restore_relative_l2("float32")


def test_a_wrong_frame_an_empty_slot_and_a_missing_transform_are_refused(device: Device) -> None:
    plan = Restore(device, SHAPE, padding=PADDING, family="lanes")
    frame = random_frame(SHAPE)
    with pytest.raises(InputError, match="slot 0 holds no filter"):
        plan.restore(frame)
    plan.set_filter(np.ones(HALF))
    with pytest.raises(InputError, match="transform first"):
        plan.apply(device.empty(SHAPE, np.float32))
    plan.restore(frame)
    with pytest.raises(InputError, match="transform first"):
        plan.apply(device.empty(SHAPE, np.float32))
    with pytest.raises(InputError, match="NaN"):
        plan.restore(with_nan(frame))
    for wrong in (frame[1:], frame.astype(np.float64)):
        with pytest.raises(InputError, match="this plan restores"):
            plan.restore(wrong)
        with pytest.raises(InputError, match="this plan restores"):
            plan(device.upload(wrong), device.empty(SHAPE, np.float32))
        with pytest.raises(InputError, match="out is"):
            plan(device.upload(frame), device.upload(wrong))


# ---- the plan of the passes, on the host ------------------------------------------------------------------


@given(n=st.integers(2, 5000).map(good_size), registers=st.sampled_from([0, 16, 32]))
def test_the_passes_are_a_discrete_fourier_transform(n: int, registers: int) -> None:
    plan = Passes.of(n, registers)
    turns = plan.turns()
    x = np.random.default_rng(n).normal(size=n) + 1j
    work = x.copy()
    for radix, stride, offset in plan.passes():
        blocks = work.reshape(-1, radix, stride)
        table = turns[offset : offset + 2 * (radix - 1) * stride].reshape(stride, radix - 1, 2)
        blocks[:] = np.fft.fft(blocks, axis=1)
        blocks[:, 1:] *= (table[..., 0] + 1j * table[..., 1]).T
    assert np.prod(radices_of(n, registers), initial=1) == n
    assert len(plan.radices) > 1 or n in (2, 3, 5, 7)
    assert relative_l2(work[plan.position()], np.fft.fft(x)) < tolerances.fft_relative_l2("float64", n)
    np.testing.assert_array_equal(plan.position()[plan.order()], np.arange(n))


SMOOTH = sorted(
    2**a * 3**b * 5**c * 7**d for a in range(16) for b in range(10) for c in range(7) for d in range(6)
)


@given(at_least=st.integers(1, 15000))
def test_a_good_size_is_a_product_of_2_3_5_and_7_near_by_that_costs_no_more_than_the_next(
    at_least: int,
) -> None:
    n = good_size(at_least)
    following = next(size for size in SMOOTH if size >= at_least)
    assert n in SMOOTH
    assert n == at_least or at_least != following
    assert n == following or n <= at_least * 17 / 16
    assert n * cost_of(n, 16) <= following * cost_of(following, 16)


def test_a_camera_of_494_rows_is_transformed_as_512() -> None:
    assert padded_shape((494, 659), 0) == (512, 672)
    assert padded_shape((500, 512), 0) == (500, 512)
