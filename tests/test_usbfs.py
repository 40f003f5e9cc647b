"""GCS over the real libusb: the kernel's USB requests, answered by umockdev."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import usb.backend.libusb1

from umockdev_there import SYSTEM_PYTHON, umockdev_is_there

CHILD = """
import threading
from adof_drivers.errors import LinkError
from adof_drivers.gcs import GcsController
from adof_drivers.link import Link, UsbTransport
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Stage

def say(*words):
    print(*words, flush=True)
    input()

stage = Stage(GcsController(Link(UsbTransport(0x1A72))), {"x": StageAxis("1", "um", 1000.0, 4000.0, 0.1)})
say("opened", stage.identity.split(", ")[1])
try:
    UsbTransport(0x1A72)
except LinkError as failure:
    say("second", "another program" in str(failure))
stage.latch.operator(False)
stage.latch.operator(True)
stage.enable()
stage.home(confirm=True)
stage.move_to({"x": 13500.0})
stage.wait_until_still()
say("moved", round(stage.position()["x"], 3))
stage.move_to({"x": 20000.0})
threading.Timer(0.1, stage.stop).start()
stage.wait_until_still()
say("stopped", 13500 < stage.position()["x"] < 19000)
say("unplug")
try:
    stage.position()
except LinkError as failure:
    say("gone", "No such device" in str(failure), stage.latch.armed)
stage.close()
say("plug")
again = Stage(GcsController(Link(UsbTransport(0x1A72))), {"x": StageAxis("1", "um", 1000.0, 4000.0, 0.1)})
say("again", again.homed(), again.latch.armed)
again.close()
"""


@pytest.mark.skipif(not umockdev_is_there(), reason="umockdev with its Python bindings is not installed")
@pytest.mark.skipif(usb.backend.libusb1.get_backend() is None, reason="libusb is not installed")
def test_a_gcs_controller_on_usb_is_driven_stopped_unplugged_and_opened_anew_by_the_real_libusb() -> None:
    script = Path(__file__).with_name("umockdev_gcs.py")
    drivers = Path(__file__).parent.parent / "drivers"
    done = subprocess.run(
        ["umockdev-wrapper", SYSTEM_PYTHON, str(script), sys.executable, CHILD],
        capture_output=True,
        text=True,
        timeout=60,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(drivers), os.environ.get("PYTHONPATH", "")])},
    )
    assert done.stdout.splitlines() == [
        "opened Emulated C-863.12",
        "second True",
        "moved 13500.0",
        "stopped True",
        "unplug",
        "gone True False",
        "plug",
        "again {'x': True} False",
    ], done.stderr
