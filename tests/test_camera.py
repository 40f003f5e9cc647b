"""The laws of watching and pairing, on frames whose whole history is known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_drivers.camera import DeviceClock, Frame, WatchedCamera, require_settings
from adof_drivers.camera_pair import CameraPair
from adof_drivers.errors import DeviceLostError, DriverError, FrameTimeoutError, FrozenFramesError

PERIOD_S = 1 / 60


class Recorded:
    """A camera all of whose frames are there already; then it times out, or raises what it is told to."""

    shape = (2, 3)

    def __init__(self, frames: Iterable[Frame], end: DriverError | None = None) -> None:
        self._frames = list(frames)
        self._end = end
        self.running = False

    def start(self) -> None:
        self.running = True

    def grab(self, timeout_s: float = 1.0) -> Frame:
        if self._frames:
            return self._frames.pop(0)
        raise self._end or FrameTimeoutError(f"no frame within {timeout_s:g} s")

    def stop(self) -> None:
        self.running = False

    def close(self) -> None:
        self.running = False


def frame(number: int, *, time_s: float | None = None, alike: bool = False) -> Frame:
    pixels = np.full((2, 3), 0 if alike else number % 251, np.uint8)
    at_s = number * PERIOD_S if time_s is None else time_s
    return Frame(pixels, number, at_s, received_s=at_s)


def watched(frames: Iterable[Frame], **options: object) -> WatchedCamera:
    camera = WatchedCamera(Recorded(frames), **{"policy": "lossless", **options})  # type: ignore[arg-type]
    camera.start()
    return camera


def taken(camera: WatchedCamera) -> list[int]:
    numbers = []
    while True:
        try:
            numbers.append(camera.grab(0).number)
        except FrameTimeoutError:
            return numbers


@given(st.lists(st.integers(0, 40), max_size=60))
def test_frames_come_out_in_order_and_every_number_is_accounted_for(numbers: list[int]) -> None:
    camera = watched(map(frame, numbers))
    out = taken(camera)
    counts = camera.counts
    assert out == sorted(set(out))
    assert counts.good == len(out)
    assert counts.good + counts.out_of_order == len(numbers)
    if out:
        assert out[-1] - out[0] + 1 == counts.good + counts.dropped


@given(st.lists(st.sampled_from(["good", "torn", "late"]), max_size=30))
def test_the_newest_frame_is_the_last_good_one_and_the_rest_is_counted(kinds: list[str]) -> None:
    frames = []
    for number, kind in enumerate(kinds):
        one = replace(frame(number), complete=kind != "torn")
        frames.append(replace(one, received_s=one.time_s + (0.1 if kind == "late" else 0.0)))
    camera = watched(frames, policy="newest", late_s=0.05)
    good = [number for number, kind in enumerate(kinds) if kind == "good"]
    assert taken(camera) == good[-1:]
    counts = camera.counts
    assert (counts.incomplete, counts.late) == (kinds.count("torn"), kinds.count("late"))
    assert counts.good + counts.skipped == len(good)


@pytest.mark.parametrize("limit", [1, 3])
def test_a_frozen_camera_is_told_after_so_many_equal_frames_and_not_before(limit: int) -> None:
    camera = watched((frame(n, alike=n >= 2) for n in range(20)), frozen_limit=limit)
    out = [camera.grab(0).number for _ in range(2 + limit)]
    assert out == list(range(2 + limit))
    with pytest.raises(FrozenFramesError, match="equal in every pixel"):
        camera.grab(0)


def test_a_time_out_says_what_came_instead() -> None:
    torn = (replace(frame(n), complete=False) for n in range(3))
    with pytest.raises(FrameTimeoutError, match="came instead: 3 incomplete"):
        watched(torn).grab(0)


@given(st.lists(st.floats(0, 0.1), min_size=1, max_size=50))
def test_a_carried_time_is_late_by_the_quickest_frame_so_far(delays_s: list[float]) -> None:
    clock, offset_s = DeviceClock(), 1234.5
    for number, delay_s in enumerate(delays_s):
        device_s = number * PERIOD_S
        received_s = device_s + offset_s + delay_s
        error_s = clock.host_s(device_s, received_s) - device_s - offset_s
        # Sums of numbers near 1234.5 round to 2e-13.
        assert error_s == pytest.approx(min(delays_s[: number + 1]), abs=1e-12)


def test_a_clock_that_drifts_is_followed() -> None:
    clock, drift = DeviceClock(window_s=1.0), 1e-4
    for number in range(600):
        device_s = number * PERIOD_S
        received_s = device_s * (1 + drift)
        assert 0 <= received_s - clock.host_s(device_s, received_s) <= 2.1 * drift  # two windows and a frame


@given(st.sets(st.integers(0, 30)), st.sets(st.integers(0, 30)), st.floats(-0.2, 0.2))
def test_pairs_are_of_the_same_moment_and_none_is_missed(one: set[int], two: set[int], skew: float) -> None:
    frames_2 = [frame(n, time_s=(n + skew) * PERIOD_S) for n in sorted(two)]
    pair = CameraPair(watched(map(frame, sorted(one))), watched(frames_2), tolerance_s=0.25 * PERIOD_S)
    numbers = []
    while True:
        try:
            both = pair.grab(0)
        except FrameTimeoutError:
            break
        numbers.append((both.frame_1.number, both.frame_2.number))
        assert both.apart_s == pytest.approx(skew * PERIOD_S, abs=1e-12)
    assert numbers == [(n, n) for n in sorted(one & two)]


def test_a_frame_without_a_partner_is_counted_for_its_camera() -> None:
    pair = CameraPair(
        watched(frame(n) for n in (0, 1, 2, 4)), watched(frame(n) for n in (0, 2, 3, 4)), tolerance_s=0.005
    )
    assert [pair.grab(0).frame_1.number for _ in range(3)] == [0, 2, 4]
    assert pair.unpaired == [1, 1]


def test_the_camera_that_failed_is_named_and_the_other_still_stops() -> None:
    gone = Recorded([], end=DeviceLostError("it no longer answers"))
    first = Recorded(map(frame, range(3)))
    pair = CameraPair(WatchedCamera(first, policy="lossless"), WatchedCamera(gone), tolerance_s=0.005)
    pair.start()
    with pytest.raises(DeviceLostError, match="camera 2: it no longer answers"):
        pair.grab(0)
    assert first.running
    assert gone.running
    pair.stop()
    assert not first.running
    assert not gone.running


def test_a_second_camera_that_cannot_start_leaves_the_first_stopped() -> None:
    class Refuses(Recorded):
        def start(self) -> None:
            raise DriverError("no")

    first = Recorded([])
    pair = CameraPair(WatchedCamera(first), WatchedCamera(Refuses([])), tolerance_s=0.005)
    with pytest.raises(DriverError):
        pair.start()
    assert not first.running


def test_settings_no_camera_can_have_are_refused() -> None:
    for given_settings, said in (
        ({"region": ((0, 0), (10, 21))}, "leaves the sensor"),
        ({"region": ((-1, 0), (5, 5))}, "leaves the sensor"),
        ({"exposure_s": 0.0}, "exposure_s"),
        ({"rate_hz": float("nan")}, "rate_hz"),
        ({"trigger": "line"}, "trigger"),
    ):
        wanted = {"region": None, "exposure_s": None, "rate_hz": None, "trigger": None, **given_settings}
        with pytest.raises(DriverError, match=said):
            require_settings((10, 20), **wanted)  # type: ignore[arg-type]
    for options in ({"policy": "oldest"}, {"frozen_limit": 0}, {"late_s": 0.0}):
        with pytest.raises(DriverError):
            WatchedCamera(Recorded([]), **options)  # type: ignore[arg-type]
    with pytest.raises(DriverError, match="tolerance_s"):
        CameraPair(watched([]), watched([]), tolerance_s=0)
