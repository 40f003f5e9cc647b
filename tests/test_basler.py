"""Basler's driver on the emulator inside Basler's own software; runs where pypylon is installed."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator

import numpy as np
import pytest

os.environ.setdefault("PYLON_CAMEMU", "2")  # read when pypylon is imported
with warnings.catch_warnings():
    # SWIG's deprecation warnings made errors crash the interpreter in the middle of the import.
    warnings.simplefilter("ignore")
    for module in ("pypylon.genicam", "pypylon.pylon"):
        pytest.importorskip(module, reason="pypylon is not installed")

from adof_drivers.basler import BaslerCamera
from adof_drivers.errors import DriverError, FrameTimeoutError


@pytest.fixture
def camera() -> Iterator[BaslerCamera]:
    opened = BaslerCamera("0815-0000")
    yield opened
    opened.close()


def test_frames_have_the_region_asked_for_and_count_up(camera: BaslerCamera) -> None:
    settings = camera.configure(region=((8, 16), (120, 160)), exposure_s=0.001)
    assert (settings.origin_yx, settings.shape) == ((8, 16), (120, 160))
    camera.start()
    frames = [camera.grab() for _ in range(5)]
    assert all(f.complete and f.pixels.shape == (120, 160) and f.pixels.dtype == np.uint8 for f in frames)
    assert np.diff([f.number for f in frames]).tolist() == [1] * 4


def test_a_software_trigger_gives_one_frame(camera: BaslerCamera) -> None:
    camera.configure(trigger="software")
    camera.start()
    with pytest.raises(FrameTimeoutError):
        camera.grab(0.05)
    camera.trigger()
    assert camera.grab().complete


def test_several_cameras_or_an_unknown_one_ask_for_a_serial_number() -> None:
    for serial in (None, "none"):
        with pytest.raises(DriverError, match="0815-0000, 0815-0001"):
            BaslerCamera(serial)


def test_what_no_camera_can_do_is_refused(camera: BaslerCamera) -> None:
    before = camera.settings
    with pytest.raises(DriverError, match="leaves the sensor"):
        camera.configure(region=((0, 0), (10**6, 10)))
    assert camera.settings == before
    with pytest.raises(DriverError, match="start"):
        camera.grab()
