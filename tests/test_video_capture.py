from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

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
