"""What a stage does when something fails, and how soon; prints a Markdown table.

The controllers are emulated on this machine: GCS behind a TCP port and on a USB bus, 4 mm/s, 50 mm/s^2,
time-out 0.1 s. The stage is on a long move, and the program asks every 10 ms where it is. Every row is the
worst of ten. "Told after" counts from the fault to its exception, "at rest after" from the fault to the axis
standing still.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from adof_drivers.emulators.engine import Engine
from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.picomotor import PicomotorEngine
from adof_drivers.emulators.serve import Served
from adof_drivers.emulators.usb_bus import UsbBus
from adof_drivers.errors import DriverError
from adof_drivers.gcs import GcsController
from adof_drivers.link import Link, TcpTransport, Transport, UsbTransport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Controller, Stage

TIMES = 10
TIMEOUT_S = 0.1
PI = 0x1A72
# Three in a row: the first may fall on a command, which has no answer to lose.
FAULTS = {
    "answer lost": [Fault("lose", i) for i in range(3)],
    "answer 0.3 s late": [Fault("delay", i, 0.3) for i in range(3)],
    "answer garbled": [Fault("garble", i) for i in range(3)],
    "connection broken": [Fault("disconnect", 0)],
    "error code 17": [Fault("error", 0, 17)],
    "end switch": [Fault("limit", 0)],
    "servo gave up (-1024)": [Fault("error", 0, -1024)],
    "power cycle": [Fault("power_cycle", 0)],
    "axis stuck": [Fault("stick", 0)],
}
DRIVE = """
import sys
from adof_drivers.gcs import GcsController
from adof_drivers.link import Link, TcpTransport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage
stage = Stage(GcsController(Link(TcpTransport("127.0.0.1", int(sys.argv[1])))),
              {"x": StageAxis("1", "um", 1000.0, 4000.0, 0.1)})
stage.latch.operator(False)
stage.latch.operator(True)
while True:
    COMMAND
    print("driving", flush=True)
"""


def gcs_engine() -> GcsEngine:
    engine = GcsEngine(("1",), now_s=time.monotonic)
    engine.feed(b"SVO 1 1\nFRF\nERR?\n")
    return engine


def gcs(transport: Transport) -> GcsController:
    link = Link(transport)
    controller = GcsController(link)
    link.timeout_s = TIMEOUT_S
    return controller


@contextmanager
def driving(controller: Controller) -> Iterator[Stage]:
    """A stage at full speed on a long move."""
    axes = {"x": StageAxis("1", "um", 1000.0, 4000.0, 0.1, following=20.0, lag_s=0.3)}
    with Stage(controller, axes) as stage:
        stage.latch.operator(False)
        stage.latch.operator(True)
        stage.move_to({"x": 24000.0})
        time.sleep(0.25)
        yield stage


def told(stage: Stage) -> tuple[float, str]:
    while True:
        try:
            stage.position()
        except DriverError as failure:
            return time.perf_counter(), type(failure).__name__
        time.sleep(0.01)


def rest(engine: Engine) -> float:
    """Wait until it stands, and give when."""
    before, now = {}, engine.position
    while before != now:
        time.sleep(0.002)
        before, now = now, engine.position
    return time.perf_counter()


def met(engine: Engine, stage: Stage, begin: Callable[[], None]) -> tuple[float, float, str]:
    began = time.perf_counter()
    begin()
    told_s, name = told(stage)
    return told_s - began, max(rest(engine), told_s) - began, name


def meet(faults: list[Fault]) -> tuple[float, float, str]:
    engine = gcs_engine()
    with (
        Served.tcp(engine) as on,
        driving(gcs(TcpTransport("127.0.0.1", on.port))) as stage,
    ):
        return met(engine, stage, lambda: setattr(engine, "faults", FaultSchedule(faults)))


def unplug() -> tuple[float, float, str]:
    engine = gcs_engine()
    bus = UsbBus(engine, PI, 0x1003)
    with driving(gcs(UsbTransport(PI, backend=bus))) as stage:
        return met(engine, stage, lambda: setattr(bus, "plugged", False))


def replug() -> tuple[float, float, str]:
    """From the plug to a stage that was opened again and answers; it has moved by nothing."""
    engine = gcs_engine()
    bus = UsbBus(engine, PI, 0x1003)
    with driving(gcs(UsbTransport(PI, backend=bus))) as stage:
        bus.plugged = False
        told(stage)
        rest(engine)
    at = engine.position
    bus.plugged = True
    began = time.perf_counter()
    again = gcs(UsbTransport(PI, backend=bus))
    again.positions(("1",))
    took_s = time.perf_counter() - began
    again.close()
    assert engine.position == at
    return took_s, 0.0, "answers again"


def refused(engine: Engine) -> tuple[float, float, str]:
    """Open what is on a port as a GCS controller."""
    with Served.tcp(engine) as on:
        began = time.perf_counter()
        try:
            GcsController(Link(TcpTransport("127.0.0.1", on.port), timeout_s=TIMEOUT_S))
        except DriverError as failure:
            return time.perf_counter() - began, 0.0, type(failure).__name__
    raise SystemExit("it was taken")


def second() -> tuple[float, float, str]:
    engine = gcs_engine()
    with (
        Served.tcp(engine) as on,
        driving(gcs(TcpTransport("127.0.0.1", on.port))) as stage,
    ):
        began = time.perf_counter()
        try:
            GcsController(Link(TcpTransport("127.0.0.1", on.port), timeout_s=TIMEOUT_S))
        except DriverError as failure:
            took_s, name = time.perf_counter() - began, type(failure).__name__
        stage.position()
        return took_s, 0.0, name


def kill(command: str) -> tuple[float, float, str]:
    engine = gcs_engine()
    with Served.tcp(engine) as on:
        program = DRIVE.replace("COMMAND", command)
        client = subprocess.Popen([sys.executable, "-c", program, str(on.port)], stdout=subprocess.PIPE)
        assert client.stdout is not None
        for _ in range(20):
            client.stdout.readline()
        client.send_signal(signal.SIGKILL)
        client.wait()
        began = time.perf_counter()
        return 0.0, rest(engine) - began, ""


def rows() -> dict[str, Callable[[], tuple[float, float, str]]]:
    return {
        **{name: lambda faults=faults: meet(faults) for name, faults in FAULTS.items()},
        "program killed (-9), velocity": lambda: kill('stage.set_velocity({"x": 1000.0}, expires_s=0.25)'),
        "program killed (-9), move": lambda: kill('stage.move_to({"x": 24000.0}, speed=1000.0)'),
        "wrong device: GCS 3.0": lambda: refused(GcsEngine(now_s=time.monotonic, command_set="3.0")),
        "wrong device: a Picomotor": lambda: refused(PicomotorEngine(now_s=time.monotonic)),
        "two programs": second,
        "USB unplugged": unplug,
        "USB plugged in again": replug,
    }


def main() -> None:
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    print("| what fails | what is said | told after, ms | at rest after, ms |")
    print("|---|---|--:|--:|")
    for name, row in rows().items():
        if wanted not in name:
            continue
        found = [row() for _ in range(TIMES)]
        told_s, rest_s = max(each[0] for each in found), max(each[1] for each in found)
        said = ", ".join(f"`{name}`" for name in sorted({each[2] for each in found}))
        print(f"| {name} | {said} | {told_s * 1e3:.0f} | {rest_s * 1e3:.0f} |", flush=True)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
