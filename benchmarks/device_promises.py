"""Measure what devices promise when they fail: from the fault to the word that says so.

python benchmarks/device_promises.py [--rounds 5]

Cameras are emulated GigE Vision cameras at 60 fps, in this process, taken through viva-genicam over loopback
and asked with a time-out of three periods, as a control loop would. The window needs a display of
1920 x 1080, such as xvfb-run gives, the operator's devices umockdev. Prints the numbers of
docs/device-promises.md.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from adof_drivers.camera import WatchedCamera
from adof_drivers.camera_pair import CameraPair
from adof_drivers.emulators.gige import Faults, GigeCameraEmulator, Region
from adof_drivers.emulators.hid_nodes import command
from adof_drivers.errors import DeviceLostError, DriverError, FrameTimeoutError, FrozenFramesError
from adof_drivers.gige import GigeCamera
from adof_drivers.hid_device import choose_hid
from adof_drivers.pedal import StopPedal
from adof_drivers.relay import IDENTITIES, HidRelay
from adof_drivers.slm_window import SlmWindow
from adof_drivers.spacemouse import SpaceMouse

RATE_HZ = 60.0
TIMEOUT_S = 3 / RATE_HZ
SENSOR = (494, 659)
NOISE = np.random.default_rng(0).integers(0, 256, (16, *SENSOR), dtype=np.uint8)


def picture(number: int, region: Region) -> np.ndarray:
    (y, x), (rows, columns) = region
    return NOISE[number % 16, y : y + rows, x : x + columns]


@contextmanager
def camera(
    faults: Faults | None = None, late_s: float = math.inf
) -> Iterator[tuple[GigeCameraEmulator, WatchedCamera]]:
    with GigeCameraEmulator(picture, SENSOR, faults=faults) as emulator:
        opened = WatchedCamera(GigeCamera("127.0.0.1"), late_s=late_s)
        opened.start()
        for _ in range(5):
            opened.grab()
        yield emulator, opened
        opened.close()


def until(wanted: type[DriverError], ask: Callable[[], object], *, ends_s: float = 5.0) -> float:
    """Ask until the error comes; when it did."""
    deadline_s = time.monotonic() + ends_s
    while time.monotonic() < deadline_s:
        try:
            ask()
        except DriverError as failure:
            if isinstance(failure, wanted):
                return time.monotonic()
    raise SystemExit(f"{wanted.__name__} never came")


def unplugged() -> tuple[float, float]:
    with camera() as (emulator, watched):
        emulator.unplug()
        begun_s = time.monotonic()
        silent_s = until(FrameTimeoutError, lambda: watched.grab(TIMEOUT_S)) - begun_s
        return silent_s, until(DeviceLostError, lambda: watched.grab(TIMEOUT_S)) - begun_s


def one_of_two() -> float:
    with (
        GigeCameraEmulator(picture, SENSOR, siblings=["127.0.0.2"]),
        GigeCameraEmulator(picture, SENSOR, address="127.0.0.2") as second,
    ):
        addresses = ("127.0.0.1", "127.0.0.2")
        pair = CameraPair(*(WatchedCamera(GigeCamera(a)) for a in addresses), tolerance_s=0.5 / RATE_HZ)
        pair.start()
        for _ in range(5):
            pair.grab()
        second.unplug()
        begun_s = time.monotonic()
        silent_s = until(FrameTimeoutError, lambda: pair.grab(TIMEOUT_S)) - begun_s
        pair.close()
        return silent_s


def frozen() -> float:
    """From the first repeated frame."""
    with camera(Faults(freeze_at=30)) as (_, watched):
        begun_s = 0.0

        def ask() -> None:
            nonlocal begun_s
            watched.grab(TIMEOUT_S)
            if watched.counts.repeated == 1 and not begun_s:
                begun_s = time.monotonic()

        return until(FrozenFramesError, ask) - begun_s


def worst_gap(faults: Faults, late_s: float) -> tuple[float, WatchedCamera]:
    """The longest wait for a good frame in 2 s."""
    with camera(faults, late_s) as (_, watched):
        times_s = [time.monotonic()]
        while times_s[-1] < times_s[0] + 2:
            watched.grab(1.0)
            times_s.append(time.monotonic())
        return float(np.diff(times_s).max()), watched


def refused(ask: Callable[[], object]) -> float:
    begun_s = time.monotonic()
    try:
        ask()
    except DriverError:
        return time.monotonic() - begun_s
    raise SystemExit("it was not refused")


def second_program() -> float:
    with camera():
        return refused(lambda: GigeCamera("127.0.0.1"))


def power_cycle() -> float:
    """From the camera being there again to its first frame."""
    with camera():
        pass
    with GigeCameraEmulator(picture, SENSOR):
        begun_s = time.monotonic()
        opened = GigeCamera("127.0.0.1")
        opened.start()
        opened.grab()
        took_s = time.monotonic() - begun_s
        opened.close()
        return took_s


def again(open_: Callable[[], Any]) -> Any:
    """Open a device as soon as it is there."""
    ends_s = time.monotonic() + 10
    while True:
        try:
            return open_()
        except DriverError:
            if time.monotonic() > ends_s:
                raise


def when(wanted: Callable[[], bool]) -> float:
    ends_s = time.monotonic() + 10
    while not wanted():
        if time.monotonic() > ends_s:
            raise SystemExit("it never came")
    return time.monotonic()


def among_devices(rounds: int, commands: str) -> None:
    """What the operator's devices promise; runs as a program among them, and says what happens to them."""
    pipe = Path(commands).open("w", buffering=1, encoding="ascii")  # noqa: SIM115  (until the end)
    times_ms: dict[str, list[float]] = {}

    def do(line: str) -> float:
        pipe.write(f"{line}\n")
        return time.monotonic()

    def note(name: str, took_s: float) -> None:
        times_ms.setdefault(name, []).append(1e3 * took_s)

    for _ in range(rounds):
        mouse, pedal, relay = (again(device.open) for device in (SpaceMouse, StopPedal, HidRelay))
        do("spacemouse deflect 0 0 0")
        do("wait 0.1")
        do("spacemouse deflect 350 0 0")
        when(lambda: any(mouse.poll().axes))  # noqa: B023
        begun_s = do("spacemouse silence")
        note("SpaceMouse silent while deflected", when(lambda: not any(mouse.poll().axes)) - begun_s)  # noqa: B023
        do("spacemouse deflect 350 0 0")
        when(lambda: any(mouse.poll().axes))  # noqa: B023
        begun_s = do("spacemouse unplug")
        note("SpaceMouse unplugged while deflected", when(lambda: not any(mouse.poll().axes)) - begun_s)  # noqa: B023
        mouse.close()
        begun_s = do("spacemouse plug")
        mouse = again(SpaceMouse.open)
        note("SpaceMouse plugged in again, opened", time.monotonic() - begun_s)
        begun_s = do("pedal press")
        note("pedal pressed", when(lambda: pedal.poll().stop) - begun_s)  # noqa: B023
        do("pedal release")
        when(lambda: not pedal.poll().stop)  # noqa: B023
        begun_s = do("pedal unplug")
        note("pedal unplugged", when(lambda: pedal.poll().stop) - begun_s)  # noqa: B023
        begun_s = time.monotonic()
        relay.switch(0, on=True)
        note("relay switched and read back", time.monotonic() - begun_s)
        held, _ = choose_hid("USB relay", IDENTITIES)
        note("device held by a program, refused", refused(HidRelay.open))
        note("another device at a path, refused", refused(lambda: SpaceMouse.open(held.decode())))  # noqa: B023
        begun_s = do("relay unplug")
        note("relay unplugged", until(DeviceLostError, relay.state) - begun_s)
        for device in (mouse, pedal, relay):
            device.close()
        do("pedal plug")
        do("relay plug")
    for name, values_ms in times_ms.items():
        tell(name, values_ms)


def operator(rounds: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        commands = Path(folder) / "commands"
        os.mkfifo(commands)
        program = [sys.executable, __file__, "--rounds", str(rounds), "--among-devices", str(commands)]
        with open(os.open(commands, os.O_RDWR)) as pipe:  # noqa: PTH123
            subprocess.run(
                command(["spacemouse", "pedal", "relay"], program, script="-"),
                stdin=pipe,
                stderr=subprocess.DEVNULL,
                check=True,
            )


def tell(name: str, times_ms: list[float]) -> None:
    print(f"{name:42} median {np.median(times_ms):8.3f} ms, worst {max(times_ms):8.3f} ms", flush=True)


def window() -> float:
    import glfw

    slm = SlmWindow((1080, 1920), monitor=0)
    slm.show(NOISE[0].repeat(3, 0)[:1080].repeat(3, 1)[:, :1920])
    glfw.set_window_should_close(glfw.get_current_context(), value=True)
    begun_s = time.monotonic()
    return until(DeviceLostError, lambda: slm.show(np.zeros((1080, 1920), np.uint8))) - begun_s


def second_window() -> float:
    with SlmWindow((1080, 1920), monitor=0):
        return refused(lambda: SlmWindow((1080, 1920), monitor=0))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--among-devices", help=argparse.SUPPRESS)
    given = parser.parse_args()
    rounds = given.rounds
    if given.among_devices:
        among_devices(rounds, given.among_devices)
        return

    def worst(name: str, measure: Callable[[], float]) -> None:
        tell(name, [1e3 * measure() for _ in range(rounds)])

    lost = [unplugged() for _ in range(rounds)]
    for name, times_s in zip(("no frame", "gone"), zip(*lost, strict=True), strict=True):
        tell(f"camera unplugged: {name}", [1e3 * time_s for time_s in times_s])
    worst("camera back after a power cycle, opened", power_cycle)
    worst("camera held by a program, refused", second_program)
    worst("one of two cameras lost: no pair", one_of_two)
    worst("camera frozen, from the first repeat", frozen)
    for name, faults, late_s in (
        ("a tenth of the frames dropped", Faults(frame_loss=0.1), math.inf),
        ("a tenth of the frames out of order", Faults(swapped=0.1), math.inf),
        ("frames late by up to one period", Faults(delay_s=1 / RATE_HZ), 0.5 / RATE_HZ),
        ("2 % of the packets lost", Faults(packet_loss=0.02), math.inf),
    ):
        gap_s, watched = worst_gap(faults, late_s)
        print(f"{name:42} longest wait {1e3 * gap_s:6.1f} ms; {watched.counts}", flush=True)
    operator(rounds)
    worst("SLM window closed", window)
    worst("SLM's monitor held by a program, refused", second_window)


if __name__ == "__main__":
    main()
