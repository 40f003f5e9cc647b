"""Laws of the latch, the limits and the watch, on their own."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adof_drivers.emulators.motion import Motor
from adof_drivers.errors import FollowingError, LimitError, NotArmedError, RequestError
from adof_drivers.safety import Course, EnableLatch, Limits, MotionWatch, StageAxis

levels = st.lists(st.booleans() | st.just("fault"))
place = st.floats(-1e5, 1e5)


def axis(**given: float | None) -> StageAxis:
    return StageAxis("1", "um", 1000.0, 100.0, 0.1, **given)  # type: ignore[arg-type]


@given(levels)
def test_the_latch_is_armed_only_by_a_release_and_a_press_since_the_last_fault(events: list[object]) -> None:
    latch = EnableLatch()
    assert not latch.armed
    for event in events:
        if event == "fault":
            latch.trip("test")
        else:
            latch.operator(bool(event))
    last = max((i for i, event in enumerate(events) if event == "fault"), default=-1)
    since = events[last + 1 :]
    fresh = any(a is False and b is True for a, b in itertools.pairwise(since))
    assert latch.armed == fresh
    if not fresh:
        with pytest.raises(NotArmedError):
            latch.require()


def test_the_first_fault_is_the_one_that_is_told() -> None:
    latch = EnableLatch()
    latch.operator(False)
    latch.operator(True)
    latch.trip("first")
    latch.trip("second")
    assert latch.fault == "first"


@given(ends=st.tuples(place, place).filter(lambda ends: ends[1] - ends[0] > 1))
def test_limits_that_are_not_stated_lie_inside_the_travel(ends: tuple[float, float]) -> None:
    limits = Limits.of("x", axis(), ends)
    assert ends[0] < limits.low < limits.high < ends[1]


@given(low=place, high=place, target=st.floats())
def test_a_target_is_taken_only_between_the_limits(low: float, high: float, target: float) -> None:
    if not low < high:
        with pytest.raises(LimitError):
            Limits.of("x", axis(low=low, high=high), None)
        return
    limits = Limits.of("x", axis(low=low, high=high), None)
    rounding = 1e-9 * max(1.0, abs(low), abs(high))
    if low <= target <= high:
        limits.require("x", target)
    elif not low - rounding <= target <= high + rounding:
        with pytest.raises(LimitError, match="nothing was moved"):
            limits.require("x", target)


def test_an_axis_whose_limits_nobody_knows_is_refused() -> None:
    with pytest.raises(LimitError, match="state low and high"):
        Limits.of("x", axis(low=0.0), None)


@pytest.mark.parametrize("field", ["scale", "speed_limit", "resolution", "lag_s", "following"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
def test_an_axis_with_a_senseless_number_is_refused(field: str, value: float) -> None:
    good = {"scale": 1.0, "speed_limit": 1.0, "resolution": 1.0, "lag_s": 1.0, "following": 1.0}
    with pytest.raises(RequestError, match=field):
        StageAxis("1", "um", **(good | {field: value}))


@given(
    start=place, target=place, speed=st.floats(0.1, 100), late=st.floats(0, 0.5), time_s=st.floats(0, 1e4),
    aside=st.floats(-5, 5),
)  # fmt: skip
def test_an_axis_no_later_than_its_lag_and_no_further_aside_is_believed(
    start: float, target: float, speed: float, late: float, time_s: float, aside: float
) -> None:
    course = Course(0.0, start, target, speed)
    watch = MotionWatch({"x": axis(following=5.001, lag_s=0.5)})
    watch.begin({"x": course})
    watch.check(time_s, {"x": course.at(time_s - late) + aside})


@given(start=place, way=st.floats(20, 1e4), sign=st.sampled_from([-1, 1]), speed=st.floats(1, 100))
def test_an_axis_that_stands_is_found_once_it_should_have_left_the_tolerance(
    start: float, way: float, sign: int, speed: float
) -> None:
    watch = MotionWatch({"x": axis(following=5.0, lag_s=0.5)})
    watch.begin({"x": Course(0.0, start, start + sign * way, speed)})
    watch.check(0.5 + 4.9 / speed, {"x": start})
    with pytest.raises(FollowingError, match="stalled"):
        watch.check(0.5 + 5.1 / speed, {"x": start})


def test_after_a_stop_no_place_is_held_against_an_axis() -> None:
    watch = MotionWatch({"x": axis(following=1.0)})
    watch.begin({"x": Course(0.0, 0.0, 100.0, 10.0)})
    watch.forget()
    watch.check(100.0, {"x": -3.0})


@given(
    commands=st.lists(
        st.tuples(st.floats(0.01, 0.4), st.floats(0, 25_000), st.floats(50, 5000), st.sampled_from("mmmmhs")),
        min_size=2,
        max_size=8,
    )
)
@settings(max_examples=100, deadline=None)
def test_an_axis_that_brakes_turns_and_is_sent_elsewhere_on_its_way_is_believed(
    commands: list[tuple[float, float, float, str]],
) -> None:
    motor = Motor(-1e4, 35e3, speed=5000.0, acceleration=50_000.0, position=12_500.0)
    # To brake from full speed and to gain it takes 0.1 s each; the emulated motor's step is 1 ms.
    watch = MotionWatch({"x": axis(following=5.0, lag_s=0.2 + 0.01)})
    now_s = 0.0
    for lasts_s, target, speed, what in commands:
        if what == "m":
            motor.speed = speed
            motor.go(target)
            watch.begin({"x": Course(now_s, motor.position, target, speed)})
        else:
            motor.halt()
            watch.forget() if what == "s" else watch.leave(["x"])
        ends_s = now_s + lasts_s
        while now_s < ends_s:
            now_s += 0.01
            motor.advance(now_s)
            watch.check(now_s, {"x": motor.position})


@given(speed=st.floats(100, 5000), slower=st.floats(100, 5000), sign=st.sampled_from([-1, 1]))
def test_an_axis_that_sticks_as_it_is_sent_elsewhere_is_found(speed: float, slower: float, sign: int) -> None:
    watch = MotionWatch({"x": axis(following=5.0, lag_s=0.2)})
    watch.begin({"x": Course(0.0, 0.0, 1e6, speed)})
    watch.check(1.0, {"x": speed})
    watch.begin({"x": Course(1.0, speed, speed + sign * 1e6, slower)})
    # It might have run on for the lag, and come all the way back.
    found_s = 1.0 + 2 * (0.2 * (1 + speed / slower) + 10.1 / slower + 0.2)
    with pytest.raises(FollowingError):
        watch.check(found_s, {"x": speed})
