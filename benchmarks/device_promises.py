"""Measure what devices promise when they fail: from the fault to the word that says so.

python benchmarks/device_promises.py [--rounds 5]

Cameras are emulated GigE Vision cameras at 60 fps, in this process, taken through viva-genicam over loopback
and asked with a time-out of three periods, as a control loop would. The window needs a display of
1920 x 1080, such as xvfb-run gives. Prints the numbers of docs/device-promises.md.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from adof_drivers.camera import WatchedCamera
from adof_drivers.camera_pair import CameraPair
from adof_drivers.emulators.gige import Faults, GigeCameraEmulator, Region
from adof_drivers.emulators.hid import EmulatedHid, EmulatedSpaceMouse
from adof_drivers.errors import DeviceLostError, DriverError, FrameTimeoutError, FrozenFramesError
from adof_drivers.gige import GigeCamera
from adof_drivers.pedal import StopPedal
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


def spacemouse() -> float:
    device = EmulatedSpaceMouse(joined=True)
    mouse = SpaceMouse(device)
    device.deflect(0, 0, 0)
    mouse.poll()
    device.deflect(350, 0, 0)
    assert any(mouse.poll().axes)
    device.unplug()
    begun_s = time.monotonic()
    assert not any(mouse.poll().axes)
    return time.monotonic() - begun_s


def pedal() -> float:
    device = EmulatedHid()
    held = StopPedal(device)
    assert not held.poll().stop
    device.unplug()
    begun_s = time.monotonic()
    assert held.poll().stop
    return time.monotonic() - begun_s


def window() -> float:
    import glfw

    slm = SlmWindow((1080, 1920), monitor=0)
    slm.show(NOISE[0].repeat(3, 0)[:1080].repeat(3, 1)[:, :1920])
    glfw.set_window_should_close(glfw.get_current_context(), value=True)
    begun_s = time.monotonic()
    return until(DeviceLostError, lambda: slm.show(np.zeros((1080, 1920), np.uint8))) - begun_s


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds

    def worst(name: str, measure: Callable[[], float]) -> None:
        times_ms = [1e3 * measure() for _ in range(rounds)]
        print(f"{name:42} median {np.median(times_ms):8.3f} ms, worst {max(times_ms):8.3f} ms", flush=True)

    lost = [unplugged() for _ in range(rounds)]
    for name, times_s in zip(
        ("unplugged: no frame", "unplugged: gone"), zip(*lost, strict=True), strict=True
    ):
        print(
            f"camera {name:35} median {1e3 * np.median(times_s):8.3f} ms, worst {1e3 * max(times_s):8.3f} ms"
        )
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
    worst("SpaceMouse unplugged while deflected", spacemouse)
    worst("pedal unplugged", pedal)
    worst("SLM window closed", window)


if __name__ == "__main__":
    main()
