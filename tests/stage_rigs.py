"""Stages for tests: a client and an emulated controller that share a clock, over any wire."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from threading import Lock

from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.serve import Served
from adof_drivers.emulators.usb_bus import FtdiBus, UsbBus
from adof_drivers.gcs import GcsController
from adof_drivers.link import (
    FtdiTransport,
    Link,
    SerialTransport,
    TcpTransport,
    Transport,
    UsbTransport,
)
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage

AXES = {
    "x": StageAxis("1", "um", 1000.0, 4000.0, 0.1, following=20.0, lag_s=0.3),
    "y": StageAxis("2", "um", 1000.0, 4000.0, 0.1, following=20.0, lag_s=0.3),
}


class ManualClock:
    """Time that passes only when someone waits for it; what repeats is called as it passes."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._now_s = 100.0
        self._repeated: list[tuple[float, float, Callable[[], bool]]] = []

    @property
    def now_s(self) -> float:
        return self._now_s

    def wait(self, duration_s: float) -> None:
        with self._lock:
            end_s = self._now_s + duration_s
        while self._repeated and min(self._repeated)[0] <= end_s:
            due_s, period_s, action = self._repeated.pop(self._repeated.index(min(self._repeated)))
            with self._lock:
                self._now_s = max(self._now_s, due_s)
            if action():
                self.repeat(action, period_s)
        with self._lock:
            self._now_s = max(self._now_s, end_s)

    def hang(self, duration_s: float) -> None:
        """Let time pass in which the program does nothing."""
        with self._lock:
            self._now_s += duration_s

    def repeat(self, action: Callable[[], bool], period_s: float) -> None:
        self._repeated.append((self._now_s + period_s, period_s, action))


@contextmanager
def wired(engine: GcsEngine, wire: str) -> Iterator[Callable[[], Transport]]:
    """Give what opens a transport to the engine."""
    if wire == "usb":
        bus = UsbBus(engine, 0x1A72, 0x1003)
        yield lambda: UsbTransport(0x1A72, backend=bus)
        return
    if wire == "ftdi":
        bridge = FtdiBus(engine, 0x1A72, 0x1007)
        yield lambda: FtdiTransport(0x1A72, 0x1007, backend=bridge)
        return
    with Served.tcp(engine) if wire == "tcp" else Served.pty(engine) as served:
        yield (
            lambda: (
                TcpTransport("127.0.0.1", served.port) if wire == "tcp" else SerialTransport(served.address)
            )
        )


@dataclass
class Rig:
    clock: ManualClock
    engine: GcsEngine
    link: Link
    stage: Stage


@contextmanager
def gcs_rig(*faults: Fault, wire: str = "tcp", timeout_s: float = 1.0, ready: bool = True) -> Iterator[Rig]:
    """A stage of two axes, armed, enabled and homed to 12.5 mm; faults count lines from then on."""
    clock = ManualClock()
    engine = GcsEngine(("1", "2"), now_s=lambda: clock.now_s)
    with ExitStack() as stack:
        connect = stack.enter_context(wired(engine, wire))
        link = Link(connect())
        stage = stack.enter_context(Stage(GcsController(link), AXES, clock=clock))
        if ready:
            arm(stage)
            stage.enable()
            stage.home(confirm=True)
        link.timeout_s = timeout_s
        engine.received.clear()
        engine.faults = FaultSchedule(faults)
        yield Rig(clock, engine, link, stage)


def arm(stage: Stage) -> None:
    stage.latch.operator(False)
    stage.latch.operator(True)
