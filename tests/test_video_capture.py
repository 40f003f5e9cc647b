from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from adof_drivers.emulators.hid_nodes import command
from adof_drivers.errors import DriverError, EndOfSequenceError
from adof_drivers.video_capture import VideoCaptureCamera

FRAMES = np.random.default_rng(3).integers(0, 256, (9, 15, 17), dtype=np.uint8)


@pytest.fixture
def pictures(tmp_path: Path) -> str:
    for number, frame in enumerate(FRAMES):
        assert cv2.imwrite(str(tmp_path / f"{number:03}.png"), frame)
    return str(tmp_path / "%03d.png")


def test_every_frame_is_served_in_order_however_slow_the_reader(pictures: str) -> None:
    camera = VideoCaptureCamera(pictures)
    assert camera.shape == (15, 17)
    for _ in range(2):  # it begins anew
        camera.start()
        for number, wanted in enumerate(FRAMES):
            frame = camera.grab()
            assert frame.number == number
            # OpenCV hands out colour; grey made of equal channels may round by 1.
            assert np.abs(frame.pixels.astype(int) - wanted).max() <= 1
        for _ in range(2):
            with pytest.raises(EndOfSequenceError):
                camera.grab()
        camera.stop()
    camera.close()


def test_what_opencv_cannot_open_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DriverError, match="cannot open"):
        VideoCaptureCamera(str(tmp_path / "none.avi"))
    with pytest.raises(DriverError, match="rate_hz"):
        VideoCaptureCamera(0, rate_hz=-1)


def test_a_camera_must_be_started_before_a_frame_is_asked_for(pictures: str) -> None:
    camera = VideoCaptureCamera(pictures)
    with pytest.raises(DriverError, match="start"):
        camera.grab()
    camera.close()
    camera.close()


UVC = """
import time
import numpy as np
from adof_drivers.camera import WatchedCamera
from adof_drivers.errors import DeviceLostError, DriverError, FrameTimeoutError
from adof_drivers.video_capture import VideoCaptureCamera

camera = VideoCaptureCamera(0)
watched = WatchedCamera(camera, policy="lossless")
watched.start()
frames = [watched.grab() for _ in range(20)]
flat = all(np.ptp(frame.pixels) == 0 for frame in frames)
print(camera.shape, {frame.pixels.shape for frame in frames}, flat)
print((np.diff([int(frame.pixels[0, 0]) for frame in frames]) >= 1).all(), flush=True)

def until(wanted):
    ends_s = time.monotonic() + 20
    while time.monotonic() < ends_s:
        try:
            watched.grab(0.1)
        except wanted as failure:
            print(type(failure).__name__, flush=True)
            return

print("!FAULT", flush=True)
until(WANTED)
camera.close()
try:
    camera.start()
except DeviceLostError:
    print("closed", flush=True)
"""


def umockdev_is_there() -> bool:
    try:
        command(["relay"], ["true"])
    except DriverError:
        return False
    return True


@pytest.mark.skipif(not umockdev_is_there(), reason="umockdev with its Python bindings is not installed")
@pytest.mark.parametrize(("fault", "wanted"), [("stall", "FrameTimeoutError"), ("unplug", "DeviceLostError")])
def test_a_uvc_camera_through_v4l2_that_stalls_times_out_and_one_that_is_unplugged_is_lost(
    fault: str, wanted: str
) -> None:
    script = Path(__file__).with_name("umockdev_video.py")
    done = subprocess.run(
        [
            *("umockdev-wrapper", "/usr/bin/python3", str(script), sys.executable),
            UVC.replace("FAULT", fault).replace("WANTED", wanted),
        ],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout.splitlines() == ["(32, 48) {(32, 48)} True", "True", wanted, "closed"], done.stderr
    assert done.returncode == 0, done.stderr
