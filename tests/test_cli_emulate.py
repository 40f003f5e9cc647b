"""`adof emulate camera` as a process of its own, its frames taken over the wire."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tifffile

from adof_cl import twin
from adof_cl.cli import main
from adof_cl.device import Device
from adof_cl.optics import Mask
from adof_cl.slm_encode import SlmEncode

pytestmark = pytest.mark.usefixtures("loopback_cameras")


@contextmanager
def emulated(*arguments: str) -> Iterator[list[str]]:
    """Run the command until the block ends; yields what it printed when it was ready."""
    cameras = 2 if "both" in arguments else 1
    with subprocess.Popen(
        [sys.executable, "-c", "from adof_cl.cli import main; main()", "emulate", "camera", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        try:
            yield [process.stdout.readline() for _ in range(cameras)]
        finally:
            process.send_signal(signal.SIGINT)
            said, failed = process.communicate(timeout=20)
    assert process.returncode == 0, failed
    assert said.count("frames sent") == cameras


class Exposures:
    """What a twin's camera sees, by number from 1; asked upwards, for a busy client may have missed some."""

    def __init__(self, camera: twin.SimulatedCamera) -> None:
        self._camera = camera
        self._number = 0

    def __getitem__(self, number: int) -> np.ndarray:
        while self._number < number:
            pixels = self._camera.grab().pixels
            self._number += 1
        return pixels


def test_the_twins_frames_cross_the_wire_bit_for_bit() -> None:
    pytest.importorskip("viva_genicam", reason="viva-genicam is not installed")
    from adof_drivers.gige import GigeCamera

    seen = twin.build(3).camera_2
    seen.set_region((40, 50), (60, 81))
    with emulated("--twin", "3", "--camera", "2") as said:
        assert "camera 2 of twin 3: GigE Vision at 127.0.0.1, 659 x 494, 8 bits, 60 Hz" in said[0]
        camera = GigeCamera("127.0.0.1")
        camera.configure(region=((40, 50), (60, 81)))
        camera.start()
        wanted = Exposures(seen)
        for _ in range(5):
            frame = camera.grab()
            assert frame.complete
            np.testing.assert_array_equal(frame.pixels, wanted[frame.number])
        camera.close()


def test_both_cameras_of_a_twin_are_found_and_show_it_through_the_mask(device: Device) -> None:
    viva = pytest.importorskip("viva_genicam", reason="viva-genicam is not installed")
    from adof_drivers.gige import GigeCamera

    rig = twin.build(0)
    encode = SlmEncode(device, rig.design.panel, rig.design.optics_1)
    rig.slm.show(encode.codes(Mask(34.6)))
    rig.clock.wait(rig.design.settling_s)
    rig.camera_1.set_centred_region()
    with emulated("--camera", "both", "--region", "--alpha", "34.6"):
        assert sorted(one.ip for one in viva.discover(500, iface="lo")) == ["127.0.0.1", "127.0.0.2"]
        camera = GigeCamera("127.0.0.1")
        camera.start()
        assert camera.shape == (400, 512)
        frame = camera.grab()
        np.testing.assert_array_equal(frame.pixels, Exposures(rig.camera_1)[frame.number])
        camera.close()


def test_recorded_pictures_are_served_over_and_over(tmp_path: Path) -> None:
    pytest.importorskip("viva_genicam", reason="viva-genicam is not installed")
    from adof_drivers.gige import GigeCamera

    frames = np.random.default_rng(0).integers(0, 65536, (3, 31, 47), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "s.tif", frames, photometric="minisblack")
    with emulated("--images", str(tmp_path / "s.tif")) as said:
        assert "47 x 31, 16 bits" in said[0]
        camera = GigeCamera("127.0.0.1")
        camera.start()
        for _ in range(5):
            frame = camera.grab()
            np.testing.assert_array_equal(frame.pixels, frames[(frame.number - 1) % 3])
        camera.close()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--camera", "3"], "choose 1, 2 or both"),
        (["--address", "localhost"], "an IPv4 address"),
        (["--seconds", "0"], "more than 0"),
        (["--packet-loss", "2"], "a share from 0 to 1"),
        (["--images", "nowhere"], "holds no PNG or TIFF"),
        (["--twin", "-1"], "0 or more was wanted"),
    ],
)
def test_what_cannot_be_emulated_exits_2_and_says_so(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["emulate", "camera", *arguments])
    assert exit_.value.code == 2
    assert said in capsys.readouterr().err
