"""The open-hardware micromanipulator over an emulated wire: what its G-code can say, and what it cannot."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcode import GcodeEngine
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.serve import Served
from adof_drivers.errors import (
    ControllerError,
    DialectError,
    DriverError,
    FollowingError,
    LimitError,
    LinkError,
    ReplyTimeoutError,
    StoppedError,
)
from adof_drivers.gcode import GcodeController
from adof_drivers.link import Link, TcpTransport, Transport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage
from memory_transport import MemoryTransport
from stage_rigs import ManualClock, arm

RESOLUTION_UM = 0.001
"""Six decimals of a millimetre are what the wire gives."""
AXES = {
    name: StageAxis(
        name.upper(), "um", 1000.0, 1000.0, RESOLUTION_UM, low=-4000.0, high=4000.0, following=5.0, lag_s=0.2
    )
    for name in ("x", "y", "z")
}
MOTION = re.compile(rb"[GM](0|1|4|17|18|24|28|56)\b.*")


@contextmanager
def rig(
    *faults: Fault, wire: str = "memory", ready: bool = True
) -> Iterator[tuple[Stage, GcodeEngine, ManualClock]]:
    """A stage homed to 0; faults count lines from then on."""
    clock = ManualClock()
    engine = GcodeEngine(now_s=lambda: clock.now_s, homing_s=0.0)
    on = nullcontext() if wire == "memory" else Served.tcp(engine)
    with on as served:
        transport: Transport = (
            MemoryTransport(engine) if served is None else TcpTransport("127.0.0.1", served.port)
        )
        link = Link(transport, timeout_s=1.0)
        with Stage(GcodeController(link), AXES, clock=clock) as stage:
            if ready:
                arm(stage)
                stage.enable()
                stage.home(confirm=True)
            engine.received.clear()
            engine.faults = FaultSchedule(faults)
            yield stage, engine, clock


@given(target=st.fixed_dictionaries({name: st.floats(-4000, 4000) for name in AXES}))
@settings(max_examples=5, deadline=None)
def test_a_move_arrives_and_no_segment_takes_longer_than_the_horizon(target: dict[str, float]) -> None:
    with rig() as (stage, engine, _clock):
        stage.move_to(target)
        stage.wait_until_still(timeout_s=30.0)
        assert stage.position() == pytest.approx(target, abs=RESOLUTION_UM)
        assert {n.lower(): v * 1e3 for n, v in engine.position.items()} == pytest.approx(
            target, abs=RESOLUTION_UM
        )
        sent = [line for line in engine.received if line.startswith(b"G0")]
        at = dict.fromkeys("XYZ", 0.0)
        for line in sent:
            words = {word[:1]: float(word[1:]) for word in line.decode().split()[1:-1]}
            # Six decimals of F and of a place.
            assert max(abs(words[n] - at[n]) for n in "XYZ" if n in words) <= 0.1 * 1.0 + 2e-6
            at |= {n: words[n] for n in "XYZ" if n in words}


def test_it_is_asked_where_it_is_at_rest_only() -> None:
    with rig() as (stage, engine, _clock):
        stage.move_to({"x": 1000.0})
        for _ in range(20):
            read = stage.position()
            assert not engine.moving
            assert read["x"] == pytest.approx(engine.position["X"] * 1e3, abs=RESOLUTION_UM)


def test_at_most_one_segment_is_ever_queued() -> None:
    with rig() as (stage, engine, clock):
        longest = 0
        for i in range(30):
            stage.set_velocity({"x": 500.0 if i % 7 else -500.0, "y": 100.0})
            longest = max(longest, int(engine.feed(b"M52\n")[0].data.split()[2]))
            clock.wait(0.02)
        assert longest == 1


def test_a_velocity_expires_and_axes_arrive_together() -> None:
    with rig() as (stage, engine, clock):
        stage.set_velocity({"x": 300.0, "y": -100.0}, expires_s=0.5)
        clock.wait(0.25)
        x, y, _ = engine.position.values()
        assert x == pytest.approx(-3 * y)
        clock.wait(5.0)
        assert not engine.moving
        assert stage.position() == pytest.approx({"x": 150.0, "y": -50.0, "z": 0.0}, abs=RESOLUTION_UM)


def test_a_stop_sends_nothing_and_what_runs_ends_by_itself() -> None:
    with rig() as (stage, engine, clock):
        stage.move_to({"x": 3000.0})
        clock.wait(0.25)
        engine.received.clear()
        stage.stop()
        at = engine.position["X"]
        clock.wait(10.0)
        assert engine.received == []
        assert 0 <= engine.position["X"] - at <= 0.1 * 1.0  # the horizon, at 1 mm/s
        stage.move_to({"x": 200.0})  # a stop is no fault
        stage.wait_until_still()
        assert stage.position()["x"] == pytest.approx(200.0, abs=RESOLUTION_UM)


def test_an_emergency_stop_switches_the_motors_off_and_no_place_is_told_until_it_has_measured() -> None:
    with rig() as (stage, engine, clock):
        stage.move_to({"x": 3000.0})
        clock.wait(0.25)
        stage.emergency_stop("the pedal was pressed")
        at = engine.position["X"]
        clock.wait(10.0)
        assert engine.position["X"] == at
        with pytest.raises(StoppedError, match="enable it"):
            stage.position()
        engine.motors["X"].place(at - 0.1)  # it sinks
        arm(stage)
        with pytest.raises(ControllerError, match="enable it first"):
            stage._controller.move({"X": 0.0}, {"X": 1.0}, (), since=1)
        stage.enable()
        assert stage.position()["x"] == pytest.approx((at - 0.1) * 1e3, abs=RESOLUTION_UM)
        stage.move_to({"x": 0.0})
        stage.wait_until_still()
        assert engine.position["X"] == pytest.approx(0.0, abs=1e-6)


def test_the_motors_are_not_switched_on_while_the_device_still_counts_a_segment_out() -> None:
    with rig() as (stage, engine, clock):
        stage.set_velocity({"x": 1000.0}, expires_s=1.0)
        clock.wait(0.2)
        stage.emergency_stop("the pedal was pressed")
        at = engine.position["X"]
        arm(stage)
        stage.enable()  # waits: switched on at once it would leap to where the segment is by now
        clock.wait(2.0)
        assert engine.position["X"] == pytest.approx(at, abs=1e-9)


def test_opening_and_closing_send_nothing_that_moves_or_drops() -> None:
    with rig(ready=False) as (_stage, engine, _clock):
        pass
    assert not [line for line in engine.received if MOTION.fullmatch(line)]


def test_a_stage_that_is_not_homed_is_not_moved_and_homing_wants_a_word() -> None:
    with rig(ready=False) as (stage, engine, _clock):
        arm(stage)
        stage.enable()
        with pytest.raises(LimitError, match="home it first"):
            stage.move_to({"x": 1.0})
        assert not [line for line in engine.received if line.startswith(b"G0")]
        engine.motors["Y"].stuck = True
        with pytest.raises(ControllerError, match="homing joint 1 failed"):
            stage.home(confirm=True)
        with pytest.raises(LimitError):
            stage.move_to({"x": 1.0})


def test_nothing_is_answered_while_it_homes_and_the_answer_is_waited_for() -> None:
    engine = GcodeEngine(now_s=time.monotonic, homing_s=0.15)
    with Served.tcp(engine) as served:
        controller = GcodeController(Link(TcpTransport("127.0.0.1", served.port), timeout_s=0.1))
        began = time.monotonic()
        controller.home(("X",), since=0)  # longer than the link's time-out
        assert time.monotonic() - began >= 0.15
        assert controller.homed(("X", "Y")) == {"X": True, "Y": True}
        controller.close()


@pytest.mark.parametrize("how", ["stop", "emergency_stop"])
def test_a_stop_while_it_homes_is_not_heard_but_said_and_the_link_stays_in_step(how: str) -> None:
    engine = GcodeEngine(now_s=time.monotonic, homing_s=0.15)
    with Served.tcp(engine) as served:
        controller = GcodeController(Link(TcpTransport("127.0.0.1", served.port)))
        outcome: list[BaseException] = []

        def home() -> None:
            try:
                controller.home((), since=0)
            except DriverError as failure:
                outcome.append(failure)

        homing = threading.Thread(target=home)
        homing.start()
        while b"G28 A B C" not in engine.received:
            threading.Event().wait(0.001)
        getattr(controller, how)()
        homing.join()
        assert isinstance(outcome[0], StoppedError)
        # The ok of M18 is not taken for another's.
        controller.enable((), since=controller.stops)
        assert controller.positions(("X", "Y")) == {"X": 0.0, "Y": 0.0}
        assert not controller.moving()
        controller.close()


def test_a_stuck_axis_is_not_seen_until_the_device_measures() -> None:
    with rig() as (stage, engine, _clock):
        engine.motors["X"].stuck = True
        stage.move_to({"x": 500.0})
        stage.wait_until_still()
        assert stage.position()["x"] == pytest.approx(500.0, abs=RESOLUTION_UM)  # where it was sent
        stage.enable()
        with pytest.raises(FollowingError, match=r"x stands .* stalled"):
            stage.position()


def test_a_power_cycle_is_found_by_the_next_segment_and_wants_homing() -> None:
    with rig() as (stage, engine, clock):
        engine.power_cycle()
        with pytest.raises(LimitError, match="home it first"):
            stage.move_to({"x": 100.0})
        assert not stage.latch.armed
        arm(stage)
        with pytest.raises(LimitError, match="home it first"):
            stage.move_to({"x": 100.0})
        clock.wait(5.0)
        assert not engine.moving


def test_a_place_out_of_reach_is_refused_and_the_motors_stay_on() -> None:
    with rig() as (stage, engine, _clock):
        engine._travel = 1.0
        engine.received.clear()
        stage.move_to({"z": 3000.0})
        with pytest.raises(LimitError, match="kinematics"):
            stage.wait_until_still()
        assert not stage.latch.armed
        assert b"M18" not in engine.received
        assert stage.position()["z"] == pytest.approx(engine.position["Z"] * 1e3, abs=RESOLUTION_UM)


def test_an_end_of_travel_met_on_the_way_opens_the_latch() -> None:
    with rig() as (stage, engine, clock):
        stage.move_to({"x": 3000.0})
        clock.wait(0.3)
        engine.faults = FaultSchedule([Fault("limit", at=0)])
        with pytest.raises(DriverError):
            stage.wait_until_still()
        assert not stage.latch.armed
        assert not engine.moving


@pytest.mark.parametrize("kind", ["lose", "garble", "disconnect", "error", "limit"])
@pytest.mark.parametrize("at", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("wire", ["memory", "tcp"])
def test_every_fault_in_a_move_is_a_driver_error_opens_the_latch_and_leaves_it_at_rest(
    kind: str, at: int, wire: str
) -> None:
    with rig(Fault(kind, at=at, amount=7), wire=wire) as (stage, engine, clock):  # type: ignore[arg-type]
        stage._controller._link.timeout_s = 0.05  # type: ignore[attr-defined]

        def move() -> None:
            stage.move_to({"x": 3000.0})
            stage.wait_until_still()

        with pytest.raises(DriverError):
            move()
        assert not stage.latch.armed
        clock.wait(10.0)
        assert not engine.moving
        assert engine.position["X"] <= 0.2 + 1e-6  # two segments at most


@given(seed=st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_under_any_faults_a_position_is_the_true_one_or_a_driver_error(seed: int) -> None:
    kinds = ("lose", "garble", "error", "disconnect", "limit", "power_cycle")
    with rig() as (stage, engine, clock):
        stage._controller._link.timeout_s = 0.002  # type: ignore[attr-defined]
        engine.faults = FaultSchedule.seeded(seed, count=4, lines=60, kinds=kinds)
        try:
            for _ in range(6):
                stage.set_velocity({"x": 800.0, "y": -600.0}, expires_s=0.1)
                clock.wait(0.05)
                read, truth = stage.position(), engine.position
                assert read == pytest.approx({n: truth[n.upper()] * 1e3 for n in AXES}, abs=RESOLUTION_UM)
        except DriverError:
            assert not stage.latch.armed
        clock.wait(1.0)
        rests_at = engine.position
        clock.wait(10.0)
        assert engine.position == rests_at


near_misses = st.lists(
    st.sampled_from(
        [b"X", b"Y", b"Z", b"1.500000", b"-0.25", b"1e400", b"nan", b"inf", b" ", b"\n", b"ok\n", b"ok",
         b"busy\n", b"error\n", b"error: 7\n", b"I)X1.0 Y1.0 Z1.0\r\n", b"E)", b"\r", b"0\n", b"1\n",
         b"X1.0 Y2.0 Z3.0\n", b"\xb2", b"\0", "٣".encode(), b",", b"+", b"v1.0.5\n"]
    ),
    max_size=10,
).map(b"".join)  # fmt: skip
_POSE = re.compile(rb"X([+-]?\d+\.\d+) Y([+-]?\d+\.\d+) Z([+-]?\d+\.\d+)\nok\n")


def opened() -> tuple[GcodeController, MemoryTransport]:
    clock = ManualClock()
    transport = MemoryTransport(GcodeEngine(now_s=lambda: clock.now_s, homing_s=0.0))
    link = Link(transport)
    controller = GcodeController(link)
    controller.enable((), since=0)
    controller.home((), since=0)
    link.timeout_s = 0.002  # nothing comes later than at once
    return controller, transport


@given(reply=near_misses | st.binary(max_size=60))
@settings(max_examples=200, deadline=None)
def test_a_malformed_pose_is_a_driver_error_and_never_a_position(reply: bytes) -> None:
    controller, transport = opened()
    transport.instead = reply
    try:
        found = controller.positions(("X", "Y", "Z"))
    except DriverError:
        return
    without_log = b"".join(
        line
        for line in re.findall(rb"[^\n]*\n|[^\n]+", reply)
        if line[:2] not in (b"D)", b"I)", b"W)", b"E)")
    )
    match = _POSE.match(without_log)
    assert match is not None
    assert list(found.values()) == [float(number) for number in match.groups()]
    assert without_log.count(b"\n") == 2 or not without_log[match.end() :].strip(b"DIWE")


@pytest.mark.parametrize("ask", ["moving", "homed", "move", "enable", "home"])
@given(reply=near_misses | st.binary(max_size=20))
@settings(max_examples=100, deadline=None)
def test_any_reply_to_anything_is_an_answer_or_a_driver_error(ask: str, reply: bytes) -> None:
    controller, transport = opened()
    calls = {
        "moving": controller.moving,
        "homed": lambda: (setattr(controller, "_homed", False), controller.homed(("X",)))[1],
        "move": lambda: controller.move({"X": 3.0}, {"X": 1.0}, (), since=0),
        "enable": lambda: controller.enable(("X",), since=0),
        "home": lambda: controller.home(("X",), since=0),
    }
    transport.instead = reply
    controller._link.timeout_s = 0.002
    if ask == "home":
        exchange = controller._link.exchange
        controller._link.exchange = lambda *a, **k: exchange(*a, **(k | {"timeout_s": 0.002}))  # type: ignore[method-assign]
    try:
        answer = calls[ask]()
    except DriverError:
        return
    assert b"ok\n" in reply
    assert answer in (None, True, False) or set(answer) == {"X"}


@given(cuts=st.lists(st.integers(1, 40), max_size=8), log=st.sampled_from([b"", b"I)a\r\n", b"E)ok\r\n"]))
def test_log_lines_are_taken_out_however_they_are_cut(cuts: list[int], log: bytes) -> None:
    said = log + b"X1.000000 Y2.000000 Z3.000000\n" + log + b"ok\n" + log
    ends = sorted({min(cut, len(said)) for cut in cuts} | {len(said)})
    pieces = [said[a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True)]

    class Cut:
        name = "cut"

        def write(self, data: bytes) -> None:
            pass

        def read_some(self, timeout_s: float) -> bytes:
            assert timeout_s >= 0
            return pieces.pop(0) if pieces else b""

        def close(self) -> None:
            pass

    from adof_drivers.gcode import WithoutLog

    reader = WithoutLog(Cut())
    heard = b"".join(reader.read_some(0.0) for _ in range(20))
    assert heard == b"X1.000000 Y2.000000 Z3.000000\nok\n"
    assert reader.complaint == ("ok" if log.startswith(b"E)") else "")


@pytest.mark.parametrize("version", ["v1.0.0", "v0.9.5", "v2.0.0", "1.0.5", "v1.0", "Marlin 2.1", ""])
def test_another_version_is_refused_and_the_port_closed(version: str) -> None:
    clock = ManualClock()
    transport = MemoryTransport(GcodeEngine(now_s=lambda: clock.now_s, version=version))
    with pytest.raises(DialectError):
        GcodeController(Link(transport, timeout_s=0.05))
    assert transport.closed


def test_another_device_on_the_port_is_refused_and_moves_not() -> None:
    engine = GcsEngine(now_s=lambda: 0.0)
    transport = MemoryTransport(engine)
    with pytest.raises((DialectError, ReplyTimeoutError)):
        GcodeController(Link(transport, timeout_s=0.05))
    assert transport.closed


def test_a_second_program_does_not_get_the_device() -> None:
    engine = GcodeEngine(now_s=time.monotonic)
    with Served.tcp(engine) as served:
        first = GcodeController(Link(TcpTransport("127.0.0.1", served.port)))
        with pytest.raises(LinkError):
            GcodeController(Link(TcpTransport("127.0.0.1", served.port), timeout_s=0.2))
        first.positions(("X",))
        first.close()


def test_a_stage_whose_program_is_killed_stops_by_itself() -> None:
    program = """
import sys
from adof_drivers.gcode import GcodeController
from adof_drivers.link import Link, TcpTransport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage
link = Link(TcpTransport("127.0.0.1", int(sys.argv[1])))
stage = Stage(GcodeController(link), {"x": StageAxis("X", "um", 1000.0, 500.0, 0.01, low=-4e3, high=4e3)})
stage.latch.operator(False)
stage.latch.operator(True)
stage.enable()
stage.home(confirm=True)
stage.move_to({"x": 3500.0})
while True:
    stage.position()
    print("driving", flush=True)
"""
    engine = GcodeEngine(now_s=time.monotonic, homing_s=0.01)
    with Served.tcp(engine) as served:
        client = subprocess.Popen([sys.executable, "-c", program, str(served.port)], stdout=subprocess.PIPE)
        assert client.stdout is not None
        for _ in range(8):
            assert client.stdout.readline() == b"driving\n"
        client.kill()
        client.communicate()
        killed_at = engine.position["X"]
        while engine.moving:
            threading.Event().wait(0.001)
        assert 0 <= engine.position["X"] - killed_at <= 0.05 + 1e-6  # 0.5 mm/s for 0.1 s
        assert b"M18" not in engine.received
