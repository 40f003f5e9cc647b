"""Laws of the operator's watch, on real TCP and emulated controllers: the pedal stops, and only a fresh press
enables again."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import pytest

from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.hid import EmulatedHid, EmulatedSpaceMouse
from adof_drivers.emulators.serve import Served
from adof_drivers.errors import NotArmedError
from adof_drivers.gcs import STOP, GcsController
from adof_drivers.link import Link, TcpTransport
from adof_drivers.operator import ENABLE, PERIOD_S, START, Operator
from adof_drivers.pedal import StopPedal
from adof_drivers.safety import StageAxis
from adof_drivers.spacemouse import SpaceMouse
from adof_drivers.stage import Stage

CONTROL_PERIOD_S = 1 / 60
SPEED_UM_PER_S, ACCELERATION_MM_PER_S2 = 1000.0, 200.0


class Time:
    """A controller's own, moved by hand."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@dataclass
class Bench:
    time: Time
    engines: dict[str, GcsEngine]
    stages: dict[str, Stage]
    pedal: EmulatedHid
    mouse: EmulatedSpaceMouse
    operator: Operator

    def press(self, *buttons: int) -> None:
        self.mouse.press(*buttons)
        self.operator.look()

    def arm(self) -> None:
        self.press()
        self.press(ENABLE)
        self.press()


@pytest.fixture
def bench() -> Iterator[Bench]:
    """Two homed stages, their operator's watch looking when told to."""
    now = Time()
    with ExitStack() as stack:
        engines, stages = {}, {}
        for name in ("coarse", "fine"):
            engine = GcsEngine(["x", "y"], now_s=now, acceleration=ACCELERATION_MM_PER_S2)
            engine.feed(b"SVO x 1 y 1\nFRF\nERR?\n")
            now.now_s += 1.0  # the reference is found
            served = stack.enter_context(Served.tcp(engine))
            axes = {axis: StageAxis(axis, "um", 1000.0, SPEED_UM_PER_S, 0.1) for axis in ("x", "y")}
            stages[name] = stack.enter_context(
                Stage(GcsController(Link(TcpTransport("127.0.0.1", served.port))), axes)
            )
            engines[name] = engine
        pedal, mouse = EmulatedHid(), EmulatedSpaceMouse(joined=True)
        operator = Operator(stages, pedal=StopPedal(pedal), spacemouse=SpaceMouse(mouse))
        yield Bench(now, engines, stages, pedal, mouse, operator)


def test_a_press_brings_every_axis_of_every_stage_to_rest_within_one_control_period(bench: Bench) -> None:
    bench.arm()
    for stage in bench.stages.values():
        stage.move_to({"x": 14000.0, "y": 14000.0})
    bench.time.now_s += 0.1
    speeds = [motor.velocity for e in bench.engines.values() if e.moving for motor in e.motors.values()]
    assert speeds == pytest.approx([SPEED_UM_PER_S / 1000] * 4)
    bench.pedal.send(b"\x01")
    bench.operator.look()
    for engine in bench.engines.values():
        while STOP not in engine.received:  # on its way through the socket
            pass
    # The watch looks this often, and the drives brake from full speed in the rest of the period.
    bench.time.now_s += CONTROL_PERIOD_S - PERIOD_S
    assert not any(engine.moving for engine in bench.engines.values())


def test_nothing_moves_again_until_the_enable_switch_was_released_and_pressed_anew(bench: Bench) -> None:
    bench.press()
    bench.press(ENABLE)  # and held
    stage = bench.stages["coarse"]
    stage.move_to({"x": 13000.0})
    bench.pedal.send(b"\x01")
    bench.press(ENABLE)
    for _ in range(3):
        bench.press()
        bench.press(ENABLE)
        with pytest.raises(NotArmedError, match="the stop pedal was pressed"):
            stage.move_to({"x": 13000.0})
    bench.pedal.send(b"\x00")
    bench.press(ENABLE)  # still held from before
    with pytest.raises(NotArmedError):
        stage.move_to({"x": 13000.0})
    bench.press()
    bench.press(ENABLE)
    stage.move_to({"x": 13000.0})


def test_an_unplugged_pedal_stops_and_keeps_stopping(bench: Bench) -> None:
    bench.arm()
    bench.pedal.unplug()
    bench.operator.look()
    assert not bench.operator.latch.armed
    bench.arm()
    assert not bench.operator.latch.armed
    with pytest.raises(NotArmedError, match="gone"):
        bench.operator.press()


def test_a_pedal_pressed_between_two_looks_stops_although_it_is_up_again(bench: Bench) -> None:
    bench.arm()
    bench.pedal.send(b"\x01")
    bench.pedal.send(b"\x00")
    bench.operator.look()
    assert not bench.operator.latch.armed


def test_the_puck_jogs_once_enabled_and_the_second_button_starts_at_rest() -> None:
    import time

    engine = GcsEngine(["x", "y"], now_s=time.monotonic)
    engine.feed(b"SVO x 1 y 1\nFRF\nERR?\n")
    mouse = EmulatedSpaceMouse(joined=True)
    with (
        Served.tcp(engine) as served,
        Stage(
            GcsController(Link(TcpTransport("127.0.0.1", served.port))),
            {axis: StageAxis(axis, "um", 1000.0, 1000.0, 0.1) for axis in ("x", "y")},
        ) as stage,
        Operator({"coarse": stage}, spacemouse=SpaceMouse(mouse)) as operator,
    ):
        enabled = threading.Event()

        def hands() -> None:
            mouse.press()
            mouse.deflect(0, 0, 0)
            while not enabled.is_set():  # a finger goes up and down until the lamp is on
                mouse.press(ENABLE)
                enabled.wait(0.05)
                mouse.press()
                enabled.wait(0.05)
            while engine.position["x"] < 12.51:
                mouse.deflect(350, 0, 0)
                enabled.clear()
                enabled.wait(0.01)
            mouse.deflect(0, 0, 0)
            mouse.press(START)

        threading.Thread(target=hands, daemon=True).start()
        jogged = operator.wait_for_start(stage, speed_um_per_s=200.0, speed_rad_per_s=0.01, ready=enabled.set)
        assert not engine.moving
    assert jogged["x"] >= 10.0
    assert jogged["y"] == 0.0


def test_without_a_spacemouse_there_is_nothing_to_wait_for(bench: Bench) -> None:
    operator = Operator(bench.stages, pedal=StopPedal(EmulatedHid()))
    with pytest.raises(NotArmedError, match="no SpaceMouse"):
        operator.wait_for_start(bench.stages["coarse"], speed_um_per_s=1.0, speed_rad_per_s=1.0)
    operator.press()
    assert operator.latch.armed
