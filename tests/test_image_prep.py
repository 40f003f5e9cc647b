"""Raw integers to a corrected image."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tolerances
from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import InputError
from adof_cl.image_prep import ImagePrep, Region


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (13, 1), (37, 53)])
@pytest.mark.parametrize("in_dtype", ["uint8", "uint16"])
def test_the_device_agrees_with_the_reference_on_odd_sizes(
    device: Device, shape: tuple[int, int], in_dtype: str
) -> None:
    rng = np.random.default_rng(1)
    frame = rng.integers(0, np.iinfo(in_dtype).max, shape, endpoint=True).astype(in_dtype)
    dark, gain = rng.uniform(0, 9, shape), rng.uniform(0.5, 2, shape)
    plan = ImagePrep(device, shape, in_dtype=in_dtype, dark=dark, gain=gain)
    wanted = reference.image_prep(frame, dark, gain)
    limit = tolerances.image_prep_real(frame, dark, gain)
    np.testing.assert_array_less(np.abs(plan.prepare(frame) - wanted), limit)


@pytest.fixture(scope="module")
def region_plan(device: Device) -> ImagePrep:
    gain = np.linspace(0.2, 3, 17 * 23).reshape(17, 23)
    return ImagePrep(device, (17, 23), region=Region(3, 5, 11, 13), dark=4.0, gain=gain, out_dtype=np.uint8)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**31))
def test_bytes_are_the_references_wherever_the_real_value_is_not_at_a_rounding_tie(
    region_plan: ImagePrep, seed: int
) -> None:
    frame = np.random.default_rng(seed).integers(0, 255, (17, 23), endpoint=True).astype(np.uint8)
    gain = np.linspace(0.2, 3, 17 * 23).reshape(17, 23)
    real = reference.image_prep(frame, 4.0, gain, region=(3, 5, 11, 13))
    limit = tolerances.image_prep_real(frame, np.full(gain.shape, 4.0), gain)[3:14, 5:18]
    clear = np.abs(real + 0.5 - np.rint(real + 0.5)) > limit
    wanted = reference.image_prep(frame, 4.0, gain, region=(3, 5, 11, 13), to_bytes=True)
    got = region_plan.prepare(frame)
    np.testing.assert_array_equal(got[clear], wanted[clear])
    assert np.abs(got.astype(float) - wanted).max() <= 1
    assert clear.mean() > 0.9


def test_bytes_are_held_to_their_range_and_half_rounds_up(device: Device) -> None:
    frame = np.array([[0, 9, 11, 12, 255]], np.uint8)
    plan = ImagePrep(device, (1, 5), dark=10.0, gain=1.5, out_dtype=np.uint8)
    assert plan.prepare(frame).tolist() == [[0, 0, 2, 3, 255]]


def test_without_correction_the_image_is_the_frame(device: Device) -> None:
    frame = np.random.default_rng(2).integers(0, 65535, (9, 31), endpoint=True).astype(np.uint16)
    np.testing.assert_array_equal(ImagePrep(device, (9, 31), in_dtype=np.uint16).prepare(frame), frame)


def test_the_middle_region_is_centred_to_half_a_pixel() -> None:
    assert Region.middle((494, 659), (400, 512)) == Region(47, 73, 400, 512)


def test_frames_and_outputs_may_change_between_calls(region_plan: ImagePrep) -> None:
    device = region_plan.device
    outs = [device.empty((11, 13), np.uint8) for _ in range(2)]
    frames = [np.full((17, 23), grey, np.uint8) for grey in (40, 90)]
    for frame, out in zip(frames, outs, strict=True):
        region_plan(device.upload(frame), out)
    for frame, out in zip(frames, outs, strict=True):
        np.testing.assert_array_equal(out.download(), region_plan.prepare(frame))


def test_what_cannot_be_prepared_is_refused(device: Device, region_plan: ImagePrep) -> None:
    refused: list[tuple[str, dict[str, Any]]] = [
        ("does not lie inside", {"region": Region(0, 0, 18, 3)}),
        ("does not lie inside", {"region": Region(-1, 0, 3, 3)}),
        ("does not lie inside", {"region": Region(0, 0, 0, 3)}),
        ("choose uint8 or uint16", {"in_dtype": np.float32}),
        ("choose float32 or uint8", {"out_dtype": np.uint16}),
        ("dark has shape", {"dark": np.zeros((3, 3))}),
        ("gain holds values that are not finite", {"gain": np.nan}),
    ]
    for words, options in refused:
        with pytest.raises(InputError, match=words):
            ImagePrep(device, (17, 23), **options)
    with pytest.raises(InputError, match="whole numbers of 1 or more"):
        ImagePrep(device, (0, 23))
    with pytest.raises(InputError, match="frame of shape"):
        region_plan.prepare(np.zeros((17, 23), np.uint16))
    with pytest.raises(InputError, match="out of shape"):
        region_plan(device.upload(np.zeros((17, 23), np.uint8)), device.empty((17, 23), np.uint8))
