from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_drivers.dlpc900 import DisplayMode, Dlpc900
from adof_drivers.emulators.hid import EmulatedDlpc900, EmulatedHid
from adof_drivers.errors import DeviceLostError, DriverError


class Time:
    """A clock that only waiting moves."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s


def opened(device: EmulatedHid) -> tuple[Dlpc900, Time]:
    time = Time()
    return Dlpc900(device, clock=lambda: time.now_s, wait=time.wait), time


def test_a_command_is_flags_sequence_length_and_low_byte_first() -> None:
    device = EmulatedDlpc900()
    controller, _ = opened(device)
    controller.status()
    controller.stop()
    assert [sent[:9] for sent in device.written] == [
        bytes([0, 0xC0, 1, 2, 0, 0x0A, 0x1A, 0, 0]),
        bytes([0, 0x40, 2, 3, 0, 0x24, 0x1A, 0, 0]),
    ]
    assert {len(sent) for sent in device.written} == {65}


def test_patterns_from_video_start_only_once_that_mode_is_there() -> None:
    device = EmulatedDlpc900()
    controller, _ = opened(device)
    assert controller.status().ready
    assert controller.version() == "6.1.3"
    with pytest.raises(DriverError, match="refuses command 0x1a24"):
        controller.start()
    controller.set_mode(DisplayMode.VIDEO_PATTERNS)
    controller.start()
    assert (controller.mode(), device.running) == (DisplayMode.VIDEO_PATTERNS, True)
    controller.close()
    assert not device.running


def test_a_mode_it_does_not_take_is_told() -> None:
    controller, _ = opened(EmulatedDlpc900(locked=False))
    with pytest.raises(DriverError, match="stays in mode VIDEO instead of VIDEO_PATTERNS"):
        controller.set_mode(DisplayMode.VIDEO_PATTERNS)


def test_no_answer_ends_in_bounded_time_and_unplugged_is_told() -> None:
    device = EmulatedDlpc900(silent=True)
    controller, time = opened(device)
    with pytest.raises(DriverError, match=r"did not answer 0x1a0a within 0\.5 s"):
        controller.status()
    assert time.now_s == pytest.approx(0.5, abs=0.002)
    device.unplug()
    with pytest.raises(DeviceLostError):
        controller.status()
    controller.close()


@given(st.lists(st.binary(max_size=64), max_size=5))
def test_any_answer_is_a_status_or_a_clear_error(answers: list[bytes]) -> None:
    device = EmulatedHid()
    controller, time = opened(device)
    for answer in answers:
        device.send(answer)
    try:
        controller.status()
    except DriverError:
        assert time.now_s <= 0.502
