"""What a stage does when something fails, and how soon; prints a Markdown table.

The controllers are emulated on this machine: GCS behind a TCP port and on a USB bus, 4 mm/s, 50 mm/s^2;
G-code behind a TCP port, 1 mm/s, 500 mm/s^2; time-out 0.1 s. The stage is on a long move, and the program
asks every 10 ms where it is. Every row is the median of ten (the worst). "Told after" counts from the fault
to its exception, "at rest after" from the fault to the axis standing still.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from statistics import median

from adof_drivers.emulators.engine import Engine
from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcode import GcodeEngine
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.picomotor import PicomotorEngine
from adof_drivers.emulators.serve import Served
from adof_drivers.emulators.usb_bus import UsbBus
from adof_drivers.errors import DriverError
from adof_drivers.gcode import GcodeController
from adof_drivers.gcs import GcsController
from adof_drivers.link import Link, TcpTransport, Transport, UsbTransport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Controller, Stage

TIMES = 10
TIMEOUT_S = 0.1
PHASE = itertools.cycle(0.013 * i for i in range(TIMES))
"""Seconds: the pieces of a move take turns with what fails."""
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
NOT_GCODE = ("servo gave up (-1024)",)
DRIVE = """
import sys
from adof_drivers.gcode import GcodeController
from adof_drivers.gcs import GcsController
from adof_drivers.link import Link, TcpTransport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage
link = Link(TcpTransport("127.0.0.1", int(sys.argv[1])))
if sys.argv[2] == "gcs":
    axis, controller = StageAxis("1", "um", 1000.0, 4000.0, 0.1), GcsController(link)
else:
    axis, controller = StageAxis("X", "um", 1000.0, 1000.0, 0.1, low=-4e3, high=4e3), GcodeController(link)
stage = Stage(controller, {"x": axis})
stage.latch.operator(False)
stage.latch.operator(True)
stage.enable()
if sys.argv[2] == "gcode":
    stage.home(confirm=True)
    stage.move_to({"x": 4000.0})
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
    gcode = isinstance(controller, GcodeController)
    axis = (
        StageAxis("X", "um", 1000.0, 1000.0, 0.1, low=-4e3, high=4e3, following=20.0, lag_s=0.3)
        if gcode
        else StageAxis("1", "um", 1000.0, 4000.0, 0.1, following=20.0, lag_s=0.3)
    )
    with Stage(controller, {"x": axis}) as stage:
        stage.latch.operator(False)
        stage.latch.operator(True)
        stage.enable()
        if gcode:
            stage.home(confirm=True)
        stage.move_to({"x": 2000.0 if gcode else 24000.0})
        time.sleep(0.25 + next(PHASE))
        yield stage


def told(stage: Stage) -> tuple[float, str]:
    """When what failed is raised, and as what; nan where the move ends and nothing was."""
    try:
        while stage.moving:
            stage.position()
            time.sleep(0.01)
    except DriverError as failure:
        return time.perf_counter(), type(failure).__name__
    return math.nan, "nothing"


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
    return told_s - began, rest(engine) - began, name


def meet(faults: list[Fault], protocol: str) -> tuple[float, float, str]:
    engine: Engine = gcs_engine() if protocol == "gcs" else GcodeEngine(now_s=time.monotonic, homing_s=0.01)
    with Served.tcp(engine) as on:
        transport = TcpTransport("127.0.0.1", on.port)
        if protocol == "gcs":
            controller: Controller = gcs(transport)
        else:
            link = Link(transport)
            controller = GcodeController(link)
            link.timeout_s = TIMEOUT_S
        with driving(controller) as stage:
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
    return took_s, math.nan, "answers again"


def refused(engine: Engine) -> tuple[float, float, str]:
    """Open what is on a port as a GCS controller."""
    with Served.tcp(engine) as on:
        began = time.perf_counter()
        try:
            GcsController(Link(TcpTransport("127.0.0.1", on.port), timeout_s=TIMEOUT_S))
        except DriverError as failure:
            return time.perf_counter() - began, math.nan, type(failure).__name__
    raise SystemExit("it was taken")


def second() -> tuple[float, float, str]:
    engine = gcs_engine()
    with (
        Served.tcp(engine) as on,
        driving(GcsController(Link(TcpTransport("127.0.0.1", on.port)))) as stage,
    ):
        began = time.perf_counter()
        try:
            GcsController(Link(TcpTransport("127.0.0.1", on.port), timeout_s=TIMEOUT_S))
        except DriverError as failure:
            took_s, name = time.perf_counter() - began, type(failure).__name__
        stage.position()
        return took_s, math.nan, name


def kill(command: str, protocol: str = "gcs") -> tuple[float, float, str]:
    engine: Engine = gcs_engine() if protocol == "gcs" else GcodeEngine(now_s=time.monotonic, homing_s=0.01)
    with Served.tcp(engine) as on:
        program = DRIVE.replace("COMMAND", command)
        arguments = [sys.executable, "-c", program, str(on.port), protocol]
        client = subprocess.Popen(arguments, stdout=subprocess.PIPE)
        assert client.stdout is not None
        for _ in range(8):
            client.stdout.readline()
        time.sleep(next(PHASE))
        client.send_signal(signal.SIGKILL)
        client.wait()
        began = time.perf_counter()
        return math.nan, rest(engine) - began, ""


def rows() -> dict[str, Callable[[], tuple[float, float, str]]]:
    return {
        **{name: lambda faults=faults: meet(faults, "gcs") for name, faults in FAULTS.items()},
        "program killed (-9), velocity": lambda: kill('stage.set_velocity({"x": 1000.0}, expires_s=0.25)'),
        "program killed (-9), move": lambda: kill('stage.move_to({"x": 24000.0}, speed=1000.0)'),
        "wrong device: GCS 3.0": lambda: refused(GcsEngine(now_s=time.monotonic, command_set="3.0")),
        "wrong device: a Picomotor": lambda: refused(PicomotorEngine(now_s=time.monotonic)),
        "two programs": second,
        "USB unplugged": unplug,
        "USB plugged in again": replug,
        **{
            f"G-code: {name}": lambda faults=faults: meet(faults, "gcode")
            for name, faults in FAULTS.items()
            if name not in NOT_GCODE
        },
        "G-code: program killed (-9), move": lambda: kill("stage.position()", "gcode"),
    }


def spread(times_s: Sequence[float]) -> str:
    """Median and worst, ms; nothing where there is none."""
    known = [time_s * 1e3 for time_s in times_s if not math.isnan(time_s)]
    return f"{median(known):.0f} ({max(known):.0f})" if known else ""


def main() -> None:
    wanted = sys.argv[1] if len(sys.argv) > 1 else ""
    print("| what fails | what is said | told after, ms | at rest after, ms |")
    print("|---|---|--:|--:|")
    for name, row in rows().items():
        if wanted not in name:
            continue
        found = [row() for _ in range(TIMES)]
        told_ms, rest_ms = (spread(times) for times in list(zip(*found, strict=True))[:2])
        said = ", ".join(f"`{name}`" for name in sorted({each[2] for each in found}))
        print(f"| {name} | {said} | {told_ms} | {rest_ms} |", flush=True)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
