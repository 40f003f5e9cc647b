"""The real hidapi on an emulated device node: the kernel's hidraw interface, answered by umockdev."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SYSTEM_PYTHON = "/usr/bin/python3"
CHILD = """
import time
from adof_drivers.spacemouse import SpaceMouse

mouse = SpaceMouse.open()
print("opened", flush=True)

def wait_until(wanted):
    ends_s = time.monotonic() + 10
    while not wanted(state := mouse.poll()) and time.monotonic() < ends_s:
        pass
    return state

# The report of rest arms it; the pushed one comes after this line.
ends_s = time.monotonic() + 0.25
while time.monotonic() < ends_s:
    mouse.poll()
print("rest", mouse.poll().axes, flush=True)
print("pushed", wait_until(lambda state: any(state.axes)).axes, flush=True)
last = wait_until(lambda state: not state.connected)
print("unplugged", last.axes, last.connected, flush=True)
"""


def umockdev_is_there() -> bool:
    if shutil.which("umockdev-wrapper") is None or not Path(SYSTEM_PYTHON).exists():
        return False
    asked = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    return subprocess.run([SYSTEM_PYTHON, "-c", asked], capture_output=True).returncode == 0


@pytest.mark.skipif(not umockdev_is_there(), reason="umockdev with its Python bindings is not installed")
def test_a_spacemouse_on_a_device_node_is_found_read_and_missed_when_unplugged() -> None:
    script = Path(__file__).with_name("umockdev_spacemouse.py")
    done = subprocess.run(
        ["umockdev-wrapper", SYSTEM_PYTHON, str(script), sys.executable, CHILD],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout.splitlines() == [
        "opened",
        "rest (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)",
        "pushed (1.0, -1.0, 0.0, 0.0, 0.0, 0.0)",
        "unplugged (0.0, 0.0, 0.0, 0.0, 0.0, 0.0) False",
    ], done.stderr
