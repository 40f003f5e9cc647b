"""Laws of every stage, stated through the wire of an emulated controller."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.serve import Served
from adof_drivers.errors import (
    ControllerError,
    DriverError,
    FollowingError,
    LimitError,
    LinkError,
    NotArmedError,
    ReplyError,
    ReplyTimeoutError,
    RequestError,
    StoppedError,
)
from adof_drivers.gcs import GcsController
from adof_drivers.link import Link, TcpTransport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage
from stage_rigs import AXES, Rig, arm, gcs_rig, wired

MOTION = (b"MOV", b"MVR", b"JOG", b"SVO ", b"FRF ", b"VEL ")
STEP_UM = 1e-3
"""A tenth of a thousandth of a millimetre is what the wire's seven digits give."""


@pytest.fixture(scope="module")
def still() -> Iterator[Rig]:
    """A stage that every refusal leaves as it was."""
    with gcs_rig(wire="usb") as rig:
        yield rig


def moves(received: list[bytes]) -> list[bytes]:
    return [line for line in received if line.startswith(MOTION)]


@pytest.mark.parametrize("wire", ["tcp", "pty", "usb", "ftdi"])
def test_a_move_arrives_where_it_was_sent_over_every_wire(wire: str) -> None:
    if wire in ("pty", "ftdi"):
        pytest.importorskip({"pty": "serial", "ftdi": "pyftdi"}[wire])
    with gcs_rig(wire=wire) as rig:
        rig.stage.move_to({"x": 13000.0, "y": 11000.0})
        rig.stage.wait_until_still()
        assert rig.stage.position() == pytest.approx({"x": 13000.0, "y": 11000.0}, abs=STEP_UM)
        assert rig.engine.position == pytest.approx({"1": 13.0, "2": 11.0}, abs=1e-6)


def test_opening_and_closing_a_stage_sends_nothing_that_moves() -> None:
    with gcs_rig(ready=False) as rig:
        received = rig.engine.received
    assert not moves(received)


def test_reconnecting_moves_nothing_and_needs_the_operator_again() -> None:
    with gcs_rig() as rig, wired(rig.engine, "usb") as connect:
        before = rig.engine.position
        with Stage(GcsController(Link(connect())), AXES, clock=rig.clock) as again:
            with pytest.raises(NotArmedError):
                again.move_to({"x": 13000.0})
            rig.clock.wait(1.0)
        assert rig.engine.position == before
        assert not moves(rig.engine.received)


@given(target=st.floats(allow_nan=True, allow_infinity=True))
@settings(max_examples=60, deadline=None)
def test_a_target_outside_the_limits_is_refused_before_a_byte_is_sent(target: float, still: Rig) -> None:
    low, high = still.stage.limits["x"]
    still.engine.received.clear()
    if low <= target <= high:
        return
    with pytest.raises((LimitError, RequestError)):
        still.stage.move_to({"y": 12000.0, "x": target})
    assert still.engine.received == []


@pytest.mark.parametrize("speed", [-1.0, 0.0, 4001.0, float("nan"), float("inf")])
def test_a_speed_that_is_none_is_refused_before_a_byte_is_sent(speed: float, still: Rig) -> None:
    still.engine.received.clear()
    with pytest.raises(LimitError):
        still.stage.move_to({"x": 12000.0}, speed=speed)
    assert still.engine.received == []


@pytest.mark.parametrize("expires_s", [0.0, -1.0, 1.01, float("nan")])
def test_a_velocity_must_expire_soon(expires_s: float, still: Rig) -> None:
    still.engine.received.clear()
    with pytest.raises(RequestError, match="expires_s"):
        still.stage.set_velocity({"x": 1.0}, expires_s=expires_s)
    assert still.engine.received == []


def test_an_unknown_axis_is_refused_before_a_byte_is_sent(still: Rig) -> None:
    still.engine.received.clear()
    with pytest.raises(RequestError, match="it has x, y"):
        still.stage.move_to({"w": 1.0})
    assert still.engine.received == []


def test_soft_limits_lie_inside_the_controllers_by_default_and_must_when_stated() -> None:
    with gcs_rig() as rig, wired(rig.engine, "usb") as connect:
        assert rig.stage.limits["x"] == pytest.approx((250.0, 24750.0))
        wide = {"x": StageAxis("1", "um", 1000.0, 4000.0, 0.1, low=-1.0, high=10.0)}
        with pytest.raises(LimitError, match="leave its controller's"):
            Stage(GcsController(Link(connect())), wide)


def test_a_velocity_expires_when_the_host_falls_silent() -> None:
    with gcs_rig() as rig:
        start = rig.stage.position()["x"]
        rig.stage.set_velocity({"x": 1000.0}, expires_s=0.25)
        rig.clock.wait(0.1)
        assert rig.engine.moving
        rig.clock.wait(10.0)
        assert not rig.engine.moving
        assert rig.stage.position()["x"] - start == pytest.approx(250.0, abs=STEP_UM)


@pytest.mark.parametrize("after_s", [0.0, 0.1, 0.45])
def test_a_long_move_ends_soon_when_the_host_falls_silent(after_s: float) -> None:
    with gcs_rig() as rig:
        start = rig.stage.position()["x"]
        rig.stage.move_to({"x": 24000.0}, speed=1000.0)
        rig.clock.wait(after_s)
        rig.clock.hang(20.0)
        assert not rig.engine.moving
        # A quarter of a second of the speed, from the last renewal on.
        renewed_s = math.floor(after_s / 0.1 + 1e-9) * 0.1
        gone_um = rig.engine.position["1"] * 1e3 - start
        assert gone_um <= 1000.0 * (renewed_s + 0.25) + STEP_UM
        assert gone_um >= 1000.0 * renewed_s


def test_a_long_move_runs_at_its_speed_and_arrives_though_nobody_asks() -> None:
    with gcs_rig() as rig:
        start = rig.stage.position()["x"]
        rig.stage.move_to({"x": start + 4000.0}, speed=1000.0)
        # Half of the ramps' 20 ms each, and the end of a step.
        rig.clock.wait(4.0 + 0.02 + 0.002)
        assert rig.engine.position["1"] * 1e3 - start == pytest.approx(4000.0, abs=STEP_UM)
        rig.stage.wait_until_still()


def test_a_host_that_was_late_goes_on_and_calls_no_axis_stuck() -> None:
    with gcs_rig() as rig:
        rig.stage.move_to({"x": 20000.0}, speed=2000.0)
        for _ in range(3):
            rig.clock.wait(0.35)
            rig.clock.hang(3.0)
            rig.stage.position()
        rig.stage.wait_until_still()
        assert rig.stage.position()["x"] == pytest.approx(20000.0, abs=STEP_UM)


def test_another_axis_may_be_sent_on_its_way_without_ending_the_first_move() -> None:
    with gcs_rig() as rig:
        rig.stage.move_to({"x": 16000.0}, speed=2000.0)
        rig.clock.wait(0.3)
        rig.stage.move_to({"y": 9000.0}, speed=300.0)
        rig.clock.wait(0.3)
        rig.stage.set_velocity({"y": -100.0})
        rig.stage.wait_until_still()
        assert rig.stage.position()["x"] == pytest.approx(16000.0, abs=STEP_UM)
        assert rig.stage.position()["y"] > 9000.0  # its move ended when it was given a velocity


def test_what_fails_while_nobody_asks_opens_the_latch_and_is_raised_by_the_next_question() -> None:
    with gcs_rig() as rig:
        rig.engine.motors["1"].stuck = True
        rig.stage.move_to({"x": 20000.0})
        rig.clock.wait(1.0)
        assert not rig.stage.latch.armed
        with pytest.raises(FollowingError, match=r"x stands .* stalled"):
            rig.stage.wait_until_still()
        rig.engine.motors["1"].stuck = False
        arm(rig.stage)
        rig.stage.move_to({"x": 13000.0})
        rig.stage.wait_until_still()


def test_a_latch_opened_by_another_ends_a_long_move_and_is_told_apart_from_an_arrival() -> None:
    with gcs_rig() as rig:
        rig.stage.move_to({"x": 20000.0})
        rig.clock.wait(0.15)
        rig.stage.latch.trip("the other stage was lost")
        rig.clock.wait(5.0)
        assert not rig.engine.moving
        assert rig.engine.position["1"] < 14.0
        with pytest.raises(StoppedError, match="the other stage was lost"):
            rig.stage.wait_until_still()


def test_a_wait_that_is_interrupted_ends_the_move() -> None:
    with gcs_rig() as rig:
        rig.stage.move_to({"x": 20000.0})

        def interrupted(_duration_s: float) -> None:
            raise KeyboardInterrupt

        rig.clock.wait, wait = interrupted, rig.clock.wait  # type: ignore[method-assign]
        with pytest.raises(KeyboardInterrupt):
            rig.stage.wait_until_still()
        rig.clock.wait = wait  # type: ignore[method-assign]
        never_arrives(rig)


@pytest.mark.parametrize("kind", ["lose", "garble", "disconnect", "error"])
def test_a_fault_met_by_a_renewal_leaves_the_stage_at_rest(kind: str) -> None:
    with gcs_rig(wire="usb", timeout_s=0.05) as rig:
        rig.stage.move_to({"x": 20000.0})
        fault = Fault(kind, at=1 if kind == "error" else 0, amount=17)  # type: ignore[arg-type]
        rig.engine.faults = FaultSchedule([fault])
        rig.clock.wait(0.1)
        assert not rig.stage.latch.armed
        rig.clock.wait(10.0)
        assert not rig.engine.moving
        assert rig.engine.position["1"] < 14.0
        with pytest.raises(DriverError):
            rig.stage.wait_until_still()


def test_repeated_velocities_run_at_the_velocity_that_was_asked_for() -> None:
    with gcs_rig() as rig:
        for _ in range(5):  # the acceleration, 20 ms of it, is over
            rig.stage.set_velocity({"x": 1000.0}, expires_s=0.25)
            rig.clock.wait(0.1)
        start = rig.stage.position()["x"]
        for _ in range(10):
            rig.stage.set_velocity({"x": 1000.0}, expires_s=0.25)
            rig.clock.wait(0.1)
        # The emulator's time step, 1 ms, at the ends.
        assert rig.stage.position()["x"] - start == pytest.approx(1000.0, abs=2.0)


def test_velocity_zero_brings_one_axis_to_rest_and_leaves_the_other() -> None:
    with gcs_rig() as rig:
        rig.stage.set_velocity({"x": 1000.0, "y": 1000.0}, expires_s=1.0)
        rig.clock.wait(0.2)
        rig.stage.set_velocity({"x": 0.0}, expires_s=1.0)
        rig.clock.wait(0.1)
        x, y = rig.engine.position.values()
        rig.clock.wait(0.1)
        assert rig.engine.position["1"] == x
        assert rig.engine.position["2"] > y


def test_a_velocity_that_would_leave_the_limits_before_it_expires_is_refused() -> None:
    with gcs_rig() as rig:
        rig.stage.move_to({"x": 24700.0})
        rig.stage.wait_until_still()
        rig.engine.received.clear()
        with pytest.raises(LimitError):
            rig.stage.set_velocity({"x": 1000.0, "y": 10.0}, expires_s=0.25)
        assert not moves(rig.engine.received)


def test_motion_needs_a_fresh_press_after_every_fault() -> None:
    with gcs_rig() as rig:
        rig.stage.emergency_stop("the pedal was pressed")
        rig.engine.received.clear()
        rig.stage.latch.operator(True)  # still held from before
        for command in (
            lambda: rig.stage.move_to({"x": 12000.0}),
            lambda: rig.stage.set_velocity({"x": 10.0}),
            rig.stage.enable,
            lambda: rig.stage.home(confirm=True),
        ):
            with pytest.raises(NotArmedError, match="pedal"):
                command()
        assert rig.engine.received == []
        arm(rig.stage)
        rig.stage.move_to({"x": 12000.0})
        rig.stage.wait_until_still()


def test_homing_moves_only_when_confirmed() -> None:
    with gcs_rig(ready=False) as rig:
        arm(rig.stage)
        rig.stage.enable()
        rig.engine.received.clear()
        with pytest.raises(RequestError, match="confirm"):
            rig.stage.home()
        assert rig.engine.received == []


def test_an_axis_that_does_not_know_where_it_is_is_not_moved() -> None:
    with gcs_rig(Fault("power_cycle", at=0)) as rig:
        with pytest.raises(LimitError, match="home it first"):
            rig.stage.move_to({"x": 12000.0})
        assert not moves(rig.engine.received)


def test_a_reference_that_is_not_found_is_said() -> None:
    with gcs_rig(ready=False) as rig:
        arm(rig.stage)
        rig.stage.enable()
        rig.engine.motors["2"].stuck = True
        with pytest.raises(LimitError, match="y found no reference"):
            rig.stage.home(confirm=True)


def test_a_stop_waits_for_no_answer_and_beats_the_command_under_way() -> None:
    with gcs_rig(Fault("delay", at=1, amount=0.4), timeout_s=5.0) as rig:
        outcome: list[BaseException] = []

        def move() -> None:
            try:
                rig.stage.move_to({"x": 20000.0})
            except DriverError as failure:
                outcome.append(failure)

        mover = threading.Thread(target=move)
        mover.start()
        while len(rig.engine.received) < 2:  # the move waits for its position
            threading.Event().wait(0.001)
        began = time.monotonic()
        rig.stage.stop()
        took_s = time.monotonic() - began
        answer_was_pending = mover.is_alive()
        mover.join()
        assert answer_was_pending
        assert took_s < 0.4  # the pending answer took longer
        assert isinstance(outcome[0], StoppedError)
        assert not moves(rig.engine.received)
        rig.stage.move_to({"x": 20000.0})  # a stop is no fault
        rig.stage.stop()
        rig.stage.position()  # answered after the stop was received
        rig.clock.wait(1.0)
        at = rig.engine.position
        rig.clock.wait(1.0)
        assert rig.engine.position == at


def test_a_stop_may_be_repeated_and_the_next_command_is_taken() -> None:
    with gcs_rig() as rig:
        for _ in range(3):
            rig.stage.stop()
        rig.stage.move_to({"x": 13000.0})
        rig.stage.wait_until_still()
        assert rig.stage.position()["x"] == pytest.approx(13000.0, abs=STEP_UM)


def test_a_stop_still_goes_out_when_the_link_is_out_of_step() -> None:
    with gcs_rig(Fault("lose", at=0), timeout_s=0.05) as rig:
        with pytest.raises(ReplyTimeoutError):
            rig.stage.position()
        rig.stage.stop()
        while len(rig.engine.received) < 3:
            threading.Event().wait(0.001)
        # The stop of the failure, and the one asked for.
        assert rig.engine.received == [b"POS? 1 2", b"\x18", b"\x18"]


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (Fault("lose", at=1), ReplyTimeoutError),
        (Fault("delay", at=1, amount=0.3), ReplyTimeoutError),
        (Fault("garble", at=1), ReplyError),
        (Fault("disconnect", at=1), LinkError),
        (Fault("error", at=3, amount=17), ControllerError),
        (Fault("error", at=3, amount=-1024), ControllerError),
        (Fault("limit", at=3), LimitError),
    ],
    ids=lambda value: f"{value.kind}{value.amount:g}" if isinstance(value, Fault) else value.__name__,
)
@pytest.mark.parametrize("wire", ["tcp", "usb"])
def test_every_fault_in_a_move_is_its_error_opens_the_latch_and_leaves_a_stage_at_rest(
    fault: Fault, error: type[DriverError], wire: str
) -> None:
    with gcs_rig(fault, wire=wire, timeout_s=0.1) as rig:
        with pytest.raises(error):
            rig.stage.move_to({"x": 20000.0})
        assert not rig.stage.latch.armed
        if fault.kind == "disconnect":
            assert not moves(rig.engine.received)
        else:
            never_arrives(rig)


def test_after_a_late_answer_nothing_is_read_as_another_ones() -> None:
    with gcs_rig(Fault("delay", at=0, amount=0.1), timeout_s=0.05) as rig:
        with pytest.raises(ReplyTimeoutError):
            rig.stage.position()
        for _ in range(3):
            with pytest.raises(LinkError, match="open it again"):
                rig.stage.position()


def test_a_stuck_axis_is_found_stopped_and_named() -> None:
    with gcs_rig() as rig:
        rig.engine.motors["2"].stuck = True
        rig.stage.move_to({"x": 13000.0, "y": 14000.0})
        with pytest.raises(FollowingError, match=r"y stands .* stalled"):
            rig.stage.wait_until_still()
        assert not rig.stage.latch.armed


def test_an_axis_that_sticks_in_mid_move_is_found() -> None:
    with gcs_rig() as rig:
        rig.stage.move_to({"y": 14000.0}, speed=1000.0)
        for _ in range(50):
            rig.clock.wait(0.01)
            rig.stage.position()
        rig.engine.motors["2"].stuck = True
        with pytest.raises(FollowingError, match="y is at"):
            rig.stage.wait_until_still()


@pytest.mark.parametrize("velocity", [300.0, -300.0])
def test_an_axis_that_sticks_under_renewed_velocities_is_found(velocity: float) -> None:
    with gcs_rig() as rig:
        rig.stage.move_to({"y": 12000.0})
        rig.stage.wait_until_still()

        def jog(periods: int) -> None:
            for _ in range(periods):
                rig.stage.set_velocity({"y": velocity})
                rig.clock.wait(1 / 60)
                rig.stage.position()

        jog(240)  # four seconds: an axis that moves is never taken for a stuck one
        rig.engine.motors["2"].stuck = True
        axis = rig.stage.axes["y"]
        # Half of one sum may be gone before it sticks, the next is whole; a period to see it.
        periods = 2 + math.ceil(60 * 2 * 2 * (axis.following / abs(velocity) + axis.lag_s))
        with pytest.raises(FollowingError, match=r"y stands .* stalled"):
            jog(periods)
        assert not rig.stage.latch.armed


def test_a_second_program_does_not_get_the_device_and_does_not_disturb_the_first() -> None:
    with gcs_rig() as rig:
        address = rig.link.transport.name.split(":")
        with pytest.raises(LinkError):
            GcsController(Link(TcpTransport(address[0], int(address[1])), timeout_s=0.2))
        rig.stage.position()


def test_an_exception_in_the_block_stops_and_closes_the_stage() -> None:
    def fails(rig: Rig) -> None:
        with rig.stage:
            rig.stage.move_to({"x": 20000.0})
            raise ZeroDivisionError

    with gcs_rig() as rig:
        with pytest.raises(ZeroDivisionError):
            fails(rig)
        never_arrives(rig)
        with pytest.raises(LinkError):
            rig.link.exchange(b"ERR?\n", lambda reply: reply.endswith(b"\n"))


def never_arrives(rig: Rig) -> None:
    """The stop has gone through the wire, and the stage rests short of the 20 mm it was sent to."""
    while b"\x18" not in rig.engine.received:
        threading.Event().wait(0.001)
    rig.clock.wait(10.0)
    assert not rig.engine.moving
    assert rig.engine.position["1"] < 19.0


@pytest.mark.parametrize(
    "command",
    ['stage.set_velocity({"x": 1000.0}, expires_s=0.25)', 'stage.move_to({"x": 24000.0}, speed=1000.0)'],
)
def test_a_stage_whose_program_is_killed_stops_by_itself(command: str) -> None:
    program = f"""
import sys
from adof_drivers.gcs import GcsController
from adof_drivers.link import Link, TcpTransport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage
link = Link(TcpTransport("127.0.0.1", int(sys.argv[1])))
stage = Stage(GcsController(link), {{"x": StageAxis("1", "um", 1000.0, 4000.0, 0.1)}})
stage.latch.operator(False)
stage.latch.operator(True)
while True:
    {command}
    print("driving", flush=True)
"""
    engine = GcsEngine(("1",), now_s=time.monotonic)
    engine.feed(b"SVO 1 1\nFRF\nERR?\n")
    with Served.tcp(engine) as served:
        client = subprocess.Popen([sys.executable, "-c", program, str(served.port)], stdout=subprocess.PIPE)
        assert client.stdout is not None
        for _ in range(20):
            assert client.stdout.readline() == b"driving\n"
        client.kill()
        client.communicate()
        killed_at = engine.position["1"]
        assert engine.moving
        while engine.moving:
            threading.Event().wait(0.001)
        # 1 mm/s for a quarter of a second at most; 1 mm/s is braked on 10 um, before the target.
        assert 0 < engine.position["1"] - killed_at <= 0.25
        assert not [line for line in engine.received if line == b"\x18"]


@pytest.mark.parametrize("kind", ["lose", "garble", "disconnect"])
def test_whichever_answer_fails_the_latch_opens(kind: str) -> None:
    for ask in ("position", "homed", "moving"):
        with gcs_rig(Fault(kind, at=0), wire="usb", timeout_s=0.02) as rig:  # type: ignore[arg-type]
            with pytest.raises(LinkError):
                rig.stage.moving if ask == "moving" else getattr(rig.stage, ask)()
            assert not rig.stage.latch.armed, ask


@given(seed=st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_under_any_faults_a_position_is_the_true_one_or_a_driver_error(seed: int) -> None:
    kinds = ("lose", "garble", "error", "disconnect", "stick", "limit", "power_cycle")
    schedule = FaultSchedule.seeded(seed, count=4, lines=40, kinds=kinds)
    with gcs_rig(wire="usb") as rig:
        rig.link.timeout_s = 0.005
        rig.engine.faults = schedule
        try:
            for _ in range(6):
                rig.stage.set_velocity({"x": 800.0, "y": -600.0}, expires_s=0.25)
                rig.clock.wait(0.1)
                read = rig.stage.position()
                truth = rig.engine.position
                assert read == pytest.approx({"x": truth["1"] * 1e3, "y": truth["2"] * 1e3}, abs=STEP_UM)
        except DriverError:
            pass
        rig.clock.wait(1.0)
        rests_at = rig.engine.position  # whatever failed, it expired or was stopped
        rig.clock.wait(10.0)
        assert rig.engine.position == rests_at
