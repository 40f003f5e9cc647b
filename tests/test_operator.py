"""Operator devices at the level of their reports: doubt means rest, and never motion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_drivers.emulators.hid import EmulatedHid, EmulatedRelay, EmulatedSpaceMouse
from adof_drivers.errors import DeviceLostError, DriverError
from adof_drivers.hid_device import open_hid
from adof_drivers.pedal import StopPedal
from adof_drivers.relay import HidRelay
from adof_drivers.spacemouse import SpaceMouse

REST = (0.0,) * 6


class Clock:
    """A clock that stands until it is moved."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def at_rest(*, joined: bool = True, **options: float) -> tuple[EmulatedSpaceMouse, SpaceMouse, Clock]:
    """A SpaceMouse that was seen at rest, and so may jog."""
    device, clock = EmulatedSpaceMouse(joined=joined), Clock()
    mouse = SpaceMouse(device, clock=clock, **options)
    device.deflect(0, 0, 0)
    assert mouse.poll().axes == REST
    return device, mouse, clock


axis = st.integers(-0x8000, 0x7FFF)


@pytest.mark.parametrize("joined", [False, True])
@given(st.tuples(axis, axis, axis, axis, axis, axis))
def test_axes_keep_order_sign_and_share_of_the_full_way(joined: bool, pushed: tuple[int, ...]) -> None:
    device, mouse, _ = at_rest(joined=joined)
    device.deflect(*pushed)
    for value, jog in zip(pushed, mouse.poll().axes, strict=True):
        share = min(abs(value) / 350, 1.0)
        wanted = 0.0 if share <= 0.05 else math.copysign((share - 0.05) / 0.95, value)
        assert jog == pytest.approx(wanted, abs=1e-12)
        assert -1 <= jog <= 1


@pytest.mark.parametrize("joined", [False, True])
def test_unplugged_while_deflected_is_rest_at_the_next_poll(joined: bool) -> None:
    device, mouse, _ = at_rest(joined=joined)
    device.deflect(350, 0, 0, 200)
    device.press(1)
    before = mouse.poll()
    assert before.axes[0] == 1
    assert before.buttons == {1}
    device.unplug()
    for _ in range(2):
        after = mouse.poll()
        assert (after.axes, after.buttons, after.connected) == (REST, frozenset(), False)
    with pytest.raises(DeviceLostError):
        mouse.set_light(on=True)


@pytest.mark.parametrize("joined", [False, True])
def test_silent_while_deflected_is_rest_and_speaking_again_is_not(joined: bool) -> None:
    device, mouse, clock = at_rest(joined=joined)
    device.deflect(100, 0, 0)
    assert mouse.poll().axes[0] > 0
    clock.now_s += 0.19
    assert mouse.poll().axes[0] > 0
    clock.now_s += 0.02
    assert mouse.poll().axes == REST
    device.deflect(100, 0, 0)
    assert mouse.poll().axes[0] > 0


def test_plugged_in_while_deflected_is_rest_until_the_puck_was_let_go() -> None:
    device, clock = EmulatedSpaceMouse(joined=True), Clock()
    mouse = SpaceMouse(device, clock=clock)
    for _ in range(20):
        device.deflect(350, 350, 350)
        assert mouse.poll().axes == REST
        clock.now_s += 0.1
    device.deflect(0, 0, 0)
    mouse.poll()
    device.deflect(350, 0, 0)
    assert mouse.poll().axes[0] == 1


@pytest.mark.parametrize("joined", [False, True])
@given(st.lists(st.tuples(st.integers(0, 5), st.floats(0, 1)), min_size=1, max_size=12))
def test_no_silence_and_no_half_at_rest_arms_a_puck_that_was_heard_deflected(
    joined: bool, pushes: list[tuple[int, float]]
) -> None:
    device, clock = EmulatedSpaceMouse(joined=joined), Clock()
    mouse = SpaceMouse(device, clock=clock)
    for axis_, silent_s in pushes:
        device.deflect(*(350 if n == axis_ else 0 for n in range(6)))
        assert mouse.poll().axes == REST
        clock.now_s += silent_s
        assert mouse.poll().axes == REST


def test_an_untouched_puck_says_nothing_and_may_jog_at_its_first_push() -> None:
    device, clock = EmulatedSpaceMouse(joined=True), Clock()
    mouse = SpaceMouse(device, clock=clock)
    clock.now_s += 0.25
    mouse.poll()
    device.deflect(-350, 0, 0)
    assert mouse.poll().axes[0] == -1


@given(st.binary(min_size=1, max_size=64))
def test_any_bytes_give_a_jog_within_bounds_and_unknown_ones_give_rest(report: bytes) -> None:
    device, mouse, _ = at_rest()
    device.deflect(300, 300, 300)
    mouse.poll()
    device.send(report)
    state = mouse.poll()
    assert all(-1 <= a <= 1 for a in state.axes)
    if mouse.malformed:
        assert state.axes == REST


def test_two_reports_run_together_are_not_read_as_one() -> None:
    device, mouse, _ = at_rest(joined=False)
    device.send(bytes([1, 94, 1, 0, 0, 0, 0]) + bytes([2, 0, 0, 0, 0, 0, 0]))
    assert mouse.poll().axes == REST
    assert mouse.malformed == 1


def test_the_light_is_output_report_four() -> None:
    device, mouse, _ = at_rest()
    mouse.set_light(on=True)
    mouse.set_light(on=False)
    assert device.written == [b"\x04\x01", b"\x04\x00"]
    for wrong in ({"dead_zone": 1.0}, {"dead_zone": -0.1}, {"silence_s": 0.0}):
        with pytest.raises(DriverError):
            SpaceMouse(device, **wrong)


KEY, NO_KEY = bytes([0, 0, 5, 0, 0, 0, 0, 0]), bytes(8)
FORMS = {
    "joystick": ("joystick", False, b"\x01\x00", b"\x00\x00"),
    "normally closed": ("joystick", True, b"\x00\x00", b"\x02\x00"),
    "keyboard": ("keyboard", False, KEY, NO_KEY),
    "numbered keyboard": ("keyboard", False, b"\x01" + KEY, b"\x00" + NO_KEY),
}


@pytest.mark.parametrize("kind", FORMS)
def test_a_press_stops_until_it_is_released_and_none_is_missed(kind: str) -> None:
    form, closed, down, up = FORMS[kind]
    device = EmulatedHid()
    pedal = StopPedal(device, form=form, normally_closed=closed)  # type: ignore[arg-type]
    assert pedal.poll().stop is closed  # a closed contact has to be seen first
    device.send(up)
    pedal.poll()
    assert not pedal.poll().stop
    device.send(down)
    assert [pedal.poll().stop for _ in range(3)] == [True] * 3
    assert not pedal.poll().tested
    device.send(up)
    assert pedal.poll().stop  # it was held since the last poll
    state = pedal.poll()
    assert (state.stop, state.tested) == (False, True)
    device.send(down)
    device.send(up)  # pressed and released between two polls
    assert pedal.poll().stop
    assert not pedal.poll().stop


@pytest.mark.parametrize("kind", FORMS)
def test_a_pedal_unplugged_closed_or_not_understood_means_stop(kind: str) -> None:
    form, closed, _, up = FORMS[kind]
    for fault in (lambda d: d.send(bytes(23)), EmulatedHid.unplug, EmulatedHid.close):
        device = EmulatedHid()
        pedal = StopPedal(device, form=form, normally_closed=closed)  # type: ignore[arg-type]
        device.send(up)
        pedal.poll()
        assert not pedal.poll().stop
        fault(device)
        assert [pedal.poll().stop for _ in range(2)] == [True, True]


@pytest.mark.parametrize("kind", FORMS)
@given(st.lists(st.binary(min_size=1, max_size=64), min_size=1, max_size=6))
def test_a_pedal_is_free_only_after_a_report_that_says_so(kind: str, came: list[bytes]) -> None:
    form, closed, down, up = FORMS[kind]
    device = EmulatedHid()
    pedal = StopPedal(device, form=form, normally_closed=closed)  # type: ignore[arg-type]
    for report in came:
        device.send(report)
        pedal.poll()
        last = report[1:] if form == "keyboard" and len(report) == 9 else report
        known = len(last) == 8 if form == "keyboard" else len(last) <= 8
        released = not any(last) if form == "keyboard" else (last[0] == 0) != closed
        assert pedal.poll().stop is not (known and released)
    device.send(up)
    device.send(down)
    assert pedal.poll().stop


def test_a_pedal_of_unknown_form_is_refused() -> None:
    for wrong in ({"form": "mouse"}, {"form": "keyboard", "normally_closed": True}):
        with pytest.raises(DriverError):
            StopPedal(EmulatedHid(), **wrong)  # type: ignore[arg-type]


@given(st.lists(st.tuples(st.integers(0, 3), st.booleans()), max_size=20))
def test_relays_are_as_last_switched_and_off_when_closed(switchings: list[tuple[int, bool]]) -> None:
    device = EmulatedRelay()
    relay = HidRelay(device, 4)
    wanted = [False] * 4
    for channel, on in switchings:
        relay.switch(channel, on=on)
        wanted[channel] = on
        assert list(relay.state()) == wanted
    relay.close()
    relay.close()
    assert device.bits == 0


def test_a_relay_that_sticks_is_told_and_one_that_is_not_there_refused() -> None:
    device = EmulatedRelay(stuck=[1])
    relay = HidRelay(device, 2)
    with pytest.raises(DriverError, match="did not switch on"):
        relay.switch(1, on=True)
    sent = len(device.written)
    for channel in (-1, 2):
        with pytest.raises(DriverError, match="0 to 1 was wanted"):
            relay.switch(channel, on=True)
    assert len(device.written) == sent
    device.unplug()
    for ask in (relay.state, lambda: relay.switch(0, on=True)):
        with pytest.raises(DeviceLostError):
            ask()
    relay.close()
    with pytest.raises(DriverError, match="1 to 8"):
        HidRelay(device, 9)


@given(st.binary(max_size=64), st.integers(0, 7), st.booleans())
def test_whatever_a_relay_board_answers_is_its_state_or_a_clear_error(
    reply: bytes, channel: int, on: bool
) -> None:
    class Garbled(EmulatedRelay):
        def get_feature_report(self, report_num: int, max_length: int) -> Sequence[int]:  # noqa: ARG002
            return list(reply)

    relay = HidRelay(Garbled(), 8)
    if len(reply) not in (8, 9):
        for ask in (relay.state, lambda: relay.switch(channel, on=on)):
            with pytest.raises(DriverError, match=f"answered {len(reply)} bytes"):
                ask()
        return
    told = relay.state()
    assert list(told) == [bool(reply[-1] >> n & 1) for n in range(8)]
    if told[channel] is on:
        relay.switch(channel, on=on)
    else:
        with pytest.raises(DriverError, match="did not switch"):
            relay.switch(channel, on=on)


def test_a_device_that_is_not_connected_is_named_by_its_identity() -> None:
    with pytest.raises(DriverError, match=r"no SpaceMouse is connected \(looked for 046d:ffff\)"):
        open_hid("SpaceMouse", [(0x046D, 0xFFFF)])
    with pytest.raises(DriverError, match="cannot be opened"):
        open_hid("SpaceMouse", [], path="/dev/hidraw-none")
