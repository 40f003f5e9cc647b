"""The Picomotor 8742 over an emulated USB bus, by our client and by one that nobody here wrote."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.picomotor import PicomotorEngine
from adof_drivers.emulators.usb_bus import UsbBus
from adof_drivers.errors import DialectError, DriverError, LimitError, LinkError, ReplyTimeoutError
from adof_drivers.link import Link, UsbTransport
from adof_drivers.picomotor import PRODUCT, VENDOR, PicomotorController
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage
from stage_rigs import ManualClock, arm

STEP_UM = 0.03
AXES = {"x": StageAxis("1", "um", STEP_UM, 45.0, STEP_UM, low=-300.0, high=300.0, following=3.0, lag_s=0.2)}


@contextmanager
def rig(*faults: Fault) -> Iterator[tuple[Stage, PicomotorEngine, ManualClock]]:
    clock = ManualClock()
    engine = PicomotorEngine(now_s=lambda: clock.now_s)
    link = Link(UsbTransport(VENDOR, PRODUCT, backend=UsbBus(engine, VENDOR, PRODUCT)), timeout_s=0.2)
    with Stage(PicomotorController(link), AXES, clock=clock) as stage:
        arm(stage)
        stage.home(confirm=True)
        engine.received.clear()
        engine.faults = FaultSchedule(faults)
        yield stage, engine, clock


@given(target=st.floats(-300, 300))
@settings(max_examples=10, deadline=None)
def test_a_move_arrives_within_half_a_step(target: float) -> None:
    with rig() as (stage, _, _clock):
        stage.move_to({"x": target})
        stage.wait_until_still()
        assert stage.position()["x"] == pytest.approx(target, abs=STEP_UM / 2 + 1e-9)


def test_a_velocity_expires_and_a_stop_ends_it_sooner() -> None:
    with rig() as (stage, engine, clock):
        stage.set_velocity({"x": 30.0}, expires_s=0.5)
        clock.wait(5.0)
        assert not engine.moving
        assert stage.position()["x"] == pytest.approx(15.0, abs=STEP_UM)
        stage.set_velocity({"x": 30.0}, expires_s=0.5)
        clock.wait(0.1)
        stage.stop()
        clock.wait(5.0)
        # 0.1 s of the speed, less the acceleration's share.
        assert stage.position()["x"] == pytest.approx(18.0, abs=0.3)


def test_velocities_are_renewed_at_rest_and_zero_halts_at_once() -> None:
    with rig() as (stage, engine, clock):
        for _ in range(5):
            stage.set_velocity({"x": 30.0}, expires_s=0.1)  # sent in motion it would be refused
            clock.wait(0.05)
        assert engine.moving
        before_s = clock.now_s
        stage.set_velocity({"x": 0.0})
        assert clock.now_s == before_s
        at = stage.position()["x"]
        clock.wait(1.0)
        # 1000 steps/s are braked on 5 steps.
        assert stage.position()["x"] - at <= 6 * STEP_UM


def test_homing_moves_nothing_and_is_wanted_again_after_a_new_connection() -> None:
    with rig() as (stage, engine, _clock):
        assert engine.position["1"] == 0.0
        assert stage.homed() == {"x": True}
    engine.faults = FaultSchedule()
    link = Link(UsbTransport(VENDOR, PRODUCT, backend=UsbBus(engine, VENDOR, PRODUCT)))
    with Stage(PicomotorController(link), AXES) as again:
        arm(again)
        with pytest.raises(LimitError, match="home it first"):
            again.move_to({"x": 1.0})
    assert not [line for line in engine.received if re.match(rb"\d(PA|PR|MV)", line)]


@pytest.mark.parametrize("kind", ["lose", "garble", "disconnect", "error", "limit"])
@pytest.mark.parametrize("at", [0, 1, 2, 3])
def test_every_fault_in_a_move_is_a_driver_error_and_opens_the_latch(kind: str, at: int) -> None:
    with rig(Fault(kind, at=at, amount=7)) as (stage, engine, clock):  # type: ignore[arg-type]
        if kind in ("lose", "garble") and at in (1, 2):  # VA and PA have no answer
            return
        with pytest.raises(DriverError):
            stage.move_to({"x": 300.0})
        assert not stage.latch.armed
        clock.wait(60.0)
        assert kind == "disconnect" or engine.position["1"] < 9900
        assert not engine.moving


@given(reply=st.binary(max_size=16) | st.from_regex(rb"[+\-]?[0-9]{1,3}[\r\n ;]{0,3}", fullmatch=True))
@settings(max_examples=200, deadline=None)
def test_a_malformed_count_is_a_driver_error_and_never_a_position(reply: bytes) -> None:
    class Answers:
        name = "memory"
        left = b""

        def write(self, data: bytes) -> None:
            self.left = {b"*IDN?\r": b"8742\r\n", b"TE?\r": b"0\r\n"}.get(data, reply)

        def read_some(self, timeout_s: float) -> bytes:
            assert timeout_s >= 0
            piece, self.left = self.left, b""
            return piece

        def close(self) -> None:
            pass

    link = Link(Answers())
    controller = PicomotorController(link)
    link.timeout_s = 0.002
    try:
        found = controller.positions(("1",))
    except DriverError:
        return
    match = re.fullmatch(rb"\s*([+-]?\d+)\s*\n", reply)
    assert match is not None
    assert found == {"1": float(match[1])}


def test_another_device_on_the_port_is_refused_and_moves_not() -> None:
    engine = GcsEngine(now_s=lambda: 0.0)
    bus = UsbBus(engine, VENDOR, PRODUCT)
    with pytest.raises((DialectError, ReplyTimeoutError)):
        PicomotorController(Link(UsbTransport(VENDOR, PRODUCT, backend=bus), timeout_s=0.05))
    with pytest.raises(LinkError, match="0 devices"):
        UsbTransport(0x1A72, backend=bus)


def test_a_second_program_cannot_claim_the_device() -> None:
    bus = UsbBus(PicomotorEngine(now_s=lambda: 0.0), VENDOR, PRODUCT)
    first = UsbTransport(VENDOR, PRODUCT, backend=bus)
    with pytest.raises(LinkError, match="another program"):
        UsbTransport(VENDOR, PRODUCT, backend=bus)
    first.close()


def test_an_unplugged_device_is_gone_at_once() -> None:
    bus = UsbBus(PicomotorEngine(now_s=lambda: 0.0), VENDOR, PRODUCT)
    controller = PicomotorController(Link(UsbTransport(VENDOR, PRODUCT, backend=bus)))
    bus.plugged = False
    with pytest.raises(LinkError, match="No such device"):
        controller.positions(("1",))


@pytest.mark.filterwarnings("ignore")  # another project's
def test_pylablibs_own_client_drives_the_emulator_unmodified(monkeypatch: pytest.MonkeyPatch) -> None:
    newport = pytest.importorskip(
        "pylablib.devices.Newport", reason="pylablib (GPL) is an oracle, not a need"
    )
    import usb.backend.libusb1

    bus = UsbBus(PicomotorEngine(now_s=time.monotonic), VENDOR, PRODUCT)
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda *_, **__: bus)
    with newport.Picomotor8742() as theirs:
        assert "8742" in theirs.get_id()
        theirs.setup_velocity(1, speed=1000, accel=50000)
        theirs.move_to(1, 150)
        theirs.wait_move(1)
        assert theirs.get_position(1) == 150
        theirs.jog(2, "+")
        assert theirs.is_moving(2)
        theirs.stop("all", immediate=True)
        assert not theirs.is_moving(2)
        assert theirs.get_position(2) == round(bus.engine.position["2"])
