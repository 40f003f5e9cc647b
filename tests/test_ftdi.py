"""A GCS controller behind an FTDI bridge, through the real pyftdi on an emulated bus."""

from __future__ import annotations

import math
import threading
import time

import pytest

from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.usb_bus import FtdiBus
from adof_drivers.errors import LinkError, ReplyTimeoutError
from adof_drivers.gcs import GcsController
from adof_drivers.link import FtdiTransport, Link

pytest.importorskip("pyftdi")
VENDOR, PRODUCT = 0x1A72, 0x1007  # a C-863, which is none of FTDI's own


def bridged(axes: int = 2) -> tuple[GcsEngine, FtdiBus]:
    engine = GcsEngine([str(i + 1) for i in range(axes)], now_s=lambda: 0.0)
    return engine, FtdiBus(engine, VENDOR, PRODUCT)


def test_answers_come_whole_however_many_packets_their_status_bytes_cut_them_into() -> None:
    _, bus = bridged(axes=16)
    with Link(FtdiTransport(VENDOR, PRODUCT, backend=bus)) as link:
        controller = GcsController(link)
        # HLP? takes 25 packets, 16 positions 4.
        assert controller.positions([str(i + 1) for i in range(16)]) == dict.fromkeys(
            controller.axis_names, 12.5
        )


def test_the_bridge_is_told_the_baud_rate_and_to_keep_nothing_for_longer_than_a_millisecond() -> None:
    _, bus = bridged()
    transport = FtdiTransport(VENDOR, PRODUCT, baud=38400, backend=bus)
    assert bus.latency_ms == 1
    assert bus.baud_divisor is not None
    # The low 14 bits divide 3 MHz, the two above them hold eighths.
    eighths = {0: 0, 1: 4, 2: 2, 3: 1}[bus.baud_divisor >> 14]
    assert 3e6 / ((bus.baud_divisor & 0x3FFF) + eighths / 8) == pytest.approx(38400, rel=0.03)
    transport.close()
    transport.close()


def test_a_baud_rate_that_no_divisor_gives_is_refused() -> None:
    _, bus = bridged()
    with pytest.raises(LinkError, match="2500001 baud"):
        FtdiTransport(VENDOR, PRODUCT, baud=2500001, backend=bus)
    FtdiTransport(VENDOR, PRODUCT, backend=bus).close()  # it was let go


def test_a_stop_goes_out_while_an_answer_is_pending() -> None:
    engine, bus = bridged()
    link = Link(FtdiTransport(VENDOR, PRODUCT, backend=bus), timeout_s=5.0)
    controller = GcsController(link)
    engine.faults = FaultSchedule([Fault("delay", at=0, amount=0.3)])
    asking = threading.Thread(target=controller.positions, args=(("1",),))
    engine.received.clear()
    asking.start()
    while not engine.received:
        time.sleep(0.001)
    controller.stop()
    assert asking.is_alive()
    assert engine.received[-1] == b"\x18"
    asking.join()
    controller.close()


def test_silence_is_a_time_out_though_status_packets_go_on_coming() -> None:
    engine, bus = bridged()
    link = Link(FtdiTransport(VENDOR, PRODUCT, backend=bus))
    controller = GcsController(link)
    link.timeout_s = 0.05
    engine.faults = FaultSchedule([Fault("lose", at=0)])
    with pytest.raises(ReplyTimeoutError):
        controller.positions(("1",))
    controller.close()


def test_a_second_program_cannot_claim_it_and_one_unplugged_is_gone_at_once() -> None:
    _, bus = bridged()
    controller = GcsController(Link(FtdiTransport(VENDOR, PRODUCT, backend=bus)))
    with pytest.raises(LinkError, match="another program"):
        FtdiTransport(VENDOR, PRODUCT, backend=bus)
    assert controller.positions(("1",)) == {"1": 12.5}
    bus.plugged = False
    with pytest.raises(LinkError, match="No such device"):
        controller.positions(("1",))
    controller.close()
    with pytest.raises(LinkError, match="0 devices"):
        FtdiTransport(VENDOR, PRODUCT, backend=bus)
    bus.plugged = True
    again = GcsController(Link(FtdiTransport(VENDOR, PRODUCT, backend=bus)))
    assert all(math.isfinite(value) for value in again.positions(("1",)).values())
    again.close()
