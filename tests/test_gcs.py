"""The GCS client against replies no controller should give, and dialects it must refuse."""

from __future__ import annotations

import re
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.serve import Served
from adof_drivers.errors import DialectError, DriverError, LinkError, StoppedError
from adof_drivers.gcs import GcsController
from adof_drivers.link import Link
from memory_transport import MemoryTransport
from stage_rigs import ManualClock

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_POSITIONS = re.compile(rf"\s*1=({_NUMBER})\s*\n\s*2=({_NUMBER})\s*\n")


def opened(**engine: str) -> tuple[GcsController, MemoryTransport]:
    clock = ManualClock()
    transport = MemoryTransport(GcsEngine(("1", "2"), now_s=lambda: clock.now_s, **engine))
    link = Link(transport)
    controller = GcsController(link)
    link.timeout_s = 0.005  # nothing comes later than at once
    return controller, transport


near_misses = st.lists(
    st.sampled_from(
        [b"1", b"2", b"=", b"12.5", b"-3", b"1e400", b"nan", b"inf", b"1_0", b"0x1F", b" ", b"\n", b" \n",
         b"\r", b"1=12.5 \n", b"2=12.5\n", b"\xb2", b"\0", "٣".encode(), b",", b"+"]
    ),
    max_size=12,
).map(b"".join)  # fmt: skip


@given(reply=near_misses | st.binary(max_size=60))
@settings(max_examples=400, deadline=None)
def test_a_malformed_position_is_a_driver_error_and_never_a_position(reply: bytes) -> None:
    controller, transport = opened()
    transport.instead = reply
    try:
        found = controller.positions(("1", "2"))
    except DriverError:
        # And nothing is read from what is left over.
        with pytest.raises(LinkError):
            controller.positions(("1", "2"))
        return
    match = _POSITIONS.fullmatch(reply.decode("ascii"))
    assert match is not None
    assert found == {"1": float(match[1]), "2": float(match[2])}


@pytest.mark.parametrize("ask", ["moving", "homing", "homed", "move", "enable", "home"])
@given(reply=near_misses | st.binary(max_size=20))
@settings(max_examples=100, deadline=None)
def test_any_reply_to_anything_is_an_answer_or_a_driver_error(ask: str, reply: bytes) -> None:
    controller, transport = opened()
    calls = {
        "moving": controller.moving,
        "homing": controller.homing,
        "homed": lambda: controller.homed(("1", "2")),
        "move": lambda: controller.move({"1": 3.0}, {"1": 1.0}, (), since=0),
        "enable": lambda: controller.enable(("1",), since=0),
        "home": lambda: controller.home(("1",), since=0),
    }
    transport.instead = reply
    try:
        answer = calls[ask]()
    except DriverError:
        return
    # What was accepted is well formed: a number or flags, one answer to one question.
    assert reply.endswith(b"\n")
    assert answer in (None, True, False) or set(answer) == {"1", "2"}


def test_an_answer_that_never_ends_is_given_up() -> None:
    controller, transport = opened()
    transport.instead = b"1=0.5 \n" * 20000
    with pytest.raises(DriverError):
        controller.positions(("1", "2"))


@pytest.mark.parametrize("command_set", ["3.0", "2.1", "0.9", "GCS", "", "2.0 extra", "nan"])
def test_an_unknown_dialect_is_refused_and_the_port_closed(command_set: str) -> None:
    clock = ManualClock()
    transport = MemoryTransport(GcsEngine(now_s=lambda: clock.now_s, command_set=command_set))
    with pytest.raises(DriverError):
        GcsController(Link(transport, timeout_s=0.2))
    assert transport.closed


def test_an_axis_that_is_not_there_is_refused_by_name() -> None:
    clock = ManualClock()
    transport = MemoryTransport(GcsEngine(("1", "2"), now_s=lambda: clock.now_s))
    with pytest.raises(DialectError, match=r"no axis Z: it has 1, 2"):
        GcsController(Link(transport), axes=("Z",))


def test_an_error_latched_before_does_not_disturb_opening() -> None:
    clock = ManualClock()
    engine = GcsEngine(("1",), now_s=lambda: clock.now_s)
    engine.feed(b"\x18")
    controller = GcsController(Link(MemoryTransport(engine)))
    controller.enable(("1",), since=controller.stops)


def test_a_referenced_axis_that_says_it_is_beyond_its_travel_is_not_believed() -> None:
    controller, transport = opened()
    controller.enable(("1", "2"), since=0)
    controller.home(("1", "2"), since=0)
    assert controller.homed(("1", "2")) == {"1": True, "2": True}
    transport.instead = b"1=12.5 \n2=99.5\n"
    with pytest.raises(DriverError, match="lost count"):
        controller.positions(("1", "2"))


def test_a_stop_that_comes_while_a_move_is_sent_has_the_last_word() -> None:
    controller, transport = opened()
    controller.enable(("1", "2"), since=0)
    controller.home(("1", "2"), since=0)
    send = transport.write

    def stopped_just_before(data: bytes) -> None:
        transport.write = send  # type: ignore[method-assign]
        controller.stop()
        send(data)

    transport.write = stopped_just_before  # type: ignore[method-assign]
    with pytest.raises(StoppedError):
        controller.move({"1": 20.0}, {"1": 4.0}, (), since=0)
    sent = [line[:3] for line in transport.engine.received[-5:]]
    assert sent == [b"\x18", b"VEL", b"MOV", b"ERR", b"\x18"]
    assert transport.engine.motors["1"].target != 20.0


@pytest.mark.filterwarnings("ignore")  # another project's
def test_pylablibs_own_client_drives_the_emulator_unmodified() -> None:
    pi = pytest.importorskip(
        "pylablib.devices.PhysikInstrumente", reason="pylablib (GPL) is an oracle, not a need"
    )
    engine = GcsEngine(("A",), now_s=time.monotonic)
    # Its E-516 is a piezo amplifier that speaks GCS: online mode is its own, referencing is not.
    with Served.pty(engine) as on, pi.PIE516(("serial", on.address), auto_online=False) as theirs:
        assert "Emulated" in theirs.get_id()
        assert any(line.startswith("MOV ") for line in theirs.get_help())
        assert theirs.enable_servo()
        theirs.query("FRF", reply=False)
        assert theirs.set_velocity(4.0) == 4.0
        assert theirs.move_to(13.0) == 13.0
        while engine.moving:
            time.sleep(0.001)
        assert theirs.get_position() == 13.0
        assert theirs.move_by(5.0) == 18.0
        theirs.stop()
        assert theirs.get_target_position() < 18.0
        while engine.moving:
            time.sleep(0.001)
        assert theirs.get_position() == pytest.approx(engine.position["A"], abs=1e-6)
        assert 13.0 <= engine.position["A"] < 18.0
