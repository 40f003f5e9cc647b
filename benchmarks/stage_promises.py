"""What a stage does when something fails, and how soon; prints a Markdown table.

The controller is emulated behind a TCP port of this machine, 4 mm/s, 50 mm/s^2, time-out 0.1 s; every row is
the worst of ten. "Told after" counts from the call that meets the fault to its exception, "at rest after"
from there, or from the kill, to the axis standing still.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.serve import Served
from adof_drivers.errors import DriverError
from adof_drivers.gcs import GcsController
from adof_drivers.link import Link, TcpTransport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage

AXES = {"x": StageAxis("1", "um", 1000.0, 4000.0, 0.1, following=20.0, lag_s=0.3)}
TIMES = 10
FAULTS = {
    "answer lost": Fault("lose", 1),
    "answer 0.3 s late": Fault("delay", 1, 0.3),
    "answer garbled": Fault("garble", 1),
    "connection broken": Fault("disconnect", 1),
    "error code 17": Fault("error", 1, 17),
    "end switch": Fault("limit", 3),
    "servo gave up (-1024)": Fault("error", 3, -1024),
    "power cycle": Fault("power_cycle", 0),
    "axis stuck": Fault("stick", 0),
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
    stage.set_velocity({"x": 1000.0}, expires_s=0.25)
    print("driving", flush=True)
"""


@contextmanager
def served() -> Iterator[tuple[GcsEngine, Served]]:
    engine = GcsEngine(("1",), now_s=time.monotonic)
    engine.feed(b"SVO 1 1\nFRF\nERR?\n")
    with Served.tcp(engine) as on:
        yield engine, on


def seconds_to_rest(engine: GcsEngine) -> float:
    began = time.perf_counter()
    while engine.moving and not engine.motors["1"].stuck:
        time.sleep(0.001)
    return time.perf_counter() - began


def meet(fault: Fault) -> tuple[float, float, str]:
    with served() as (engine, on):
        stage = Stage(GcsController(Link(TcpTransport("127.0.0.1", on.port), timeout_s=0.1)), AXES)
        with stage:
            stage.latch.operator(False)
            stage.latch.operator(True)
            stage.move_to({"x": 20000.0})
            time.sleep(0.2)  # it is at full speed
            engine.faults = FaultSchedule([fault])
            began = time.perf_counter()
            try:
                stage.move_to({"x": 22000.0})
                stage.wait_until_still(timeout_s=10.0)
            except DriverError as failure:
                told_s = time.perf_counter() - began
                return told_s, seconds_to_rest(engine), type(failure).__name__
    raise SystemExit(f"{fault} went unnoticed")


def kill() -> float:
    with served() as (engine, on):
        client = subprocess.Popen([sys.executable, "-c", DRIVE, str(on.port)], stdout=subprocess.PIPE)
        assert client.stdout is not None
        for _ in range(20):
            client.stdout.readline()
        client.send_signal(signal.SIGKILL)
        client.wait()
        return seconds_to_rest(engine)


def main() -> None:
    print("| what fails | what is said | told after, ms | at rest after, ms |")
    print("|---|---|--:|--:|")
    for name, fault in FAULTS.items():
        rows = [meet(fault) for _ in range(TIMES)]
        told, rest = max(row[0] for row in rows), max(row[1] for row in rows)
        print(f"| {name} | `{rows[0][2]}` | {told * 1e3:.0f} | {rest * 1e3:.0f} |", flush=True)
    print(f"| program killed (-9), velocity for 0.25 s | | | {max(kill() for _ in range(TIMES)) * 1e3:.0f} |")


if __name__ == "__main__":
    main()
