"""The window on real X servers, judged by screenshots: Xvfb, and an Xorg with a second monitor."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from PIL import ImageGrab

from adof_drivers.errors import DeviceLostError, DriverError
from adof_drivers.slm_window import SlmWindow, monitors

needs_gl = pytest.mark.skipif(
    find_spec("glfw") is None or find_spec("OpenGL") is None, reason="glfw or PyOpenGL is not installed"
)
SHAPE = (120, 161)  # an odd width, whose lines do not end on 4 bytes

DUMMY = """
Section "ServerFlags"
  Option "DontVTSwitch" "true"
  Option "AllowMouseOpenFail" "true"
  Option "AutoAddDevices" "false"
  Option "AutoAddGPU" "false"
EndSection
Section "Device"
  Identifier "d"
  Driver "dummy"
  VideoRam 64000
EndSection
Section "Monitor"
  Identifier "m"
  HorizSync 5-1000
  VertRefresh 5-200
EndSection
Section "Screen"
  Identifier "s"
  Device "d"
  Monitor "m"
  DefaultDepth 24
  SubSection "Display"
    Depth 24
    Modes "800x600" "640x480"
    Virtual 1600 600
  EndSubSection
EndSection
"""


@contextmanager
def server(*command: str) -> Iterator[str]:
    """Run an X server on a display of its own choice and yield that display's name once it answers."""
    reading, writing = os.pipe()
    with subprocess.Popen(
        # Otherwise a server starts anew when its last window closes, and refuses whoever comes meanwhile.
        [*command, "-displayfd", str(writing), "-nolisten", "tcp", "-noreset"],
        pass_fds=[writing],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        os.close(writing)
        try:
            with os.fdopen(reading) as told:
                number = told.readline().strip()
            if not number:
                pytest.skip(f"{command[0]} does not start here")
            yield f":{number}"
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def xvfb() -> Iterator[str]:
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed")
    with server("Xvfb", "-screen", "0", f"{SHAPE[1]}x{SHAPE[0]}x24") as display:
        yield display


@pytest.fixture
def display(xvfb: str, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("DISPLAY", xvfb)
    return xvfb


def codes(seed: int, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def screen(display: str) -> np.ndarray:
    return np.asarray(ImageGrab.grab(xdisplay=display))


@needs_gl
def test_every_pixel_shows_its_code_in_all_three_channels(display: str) -> None:
    with SlmWindow(SHAPE, monitor=0) as slm:
        for seed in range(3):
            pattern = codes(seed)
            slm.show(pattern)
            np.testing.assert_array_equal(screen(display), pattern[..., None].repeat(3, axis=2))


@needs_gl
def test_what_was_shown_stays_until_the_next_and_refusals_change_nothing(display: str) -> None:
    with SlmWindow(SHAPE, monitor=0) as slm:
        shown = slm.show(codes(1))
        for wrong in (codes(2).T, codes(2).astype(np.uint16), codes(2)[:-1], np.zeros((*SHAPE, 3), np.uint8)):
            with pytest.raises(DriverError, match="uint8 was wanted"):
                slm.show(wrong)
        np.testing.assert_array_equal(screen(display)[..., 0], codes(1))
        again = slm.show(codes(3))
        assert (shown.number, again.number) == (1, 2)
        assert again.flip_s > shown.flip_s


@needs_gl
@pytest.mark.usefixtures("display")
def test_another_resolution_or_monitor_is_refused_and_named() -> None:
    with pytest.raises(DriverError, match=r"runs at 161 x 120, the panel has 1920 x 1080"):
        SlmWindow((1080, 1920), monitor=0)
    for absent in (1, -1, "LETO"):
        with pytest.raises(DriverError, match="is none of: 0 "):
            SlmWindow(SHAPE, monitor=absent)


@needs_gl
@pytest.mark.usefixtures("display")
def test_a_display_that_does_not_keep_its_rate_is_refused_where_pacing_is_required() -> None:
    with SlmWindow(SHAPE, monitor=0) as slm:  # Xvfb shows frames as fast as they come
        assert not slm.paced
    with pytest.raises(DriverError, match="flips come at"):
        SlmWindow(SHAPE, monitor=0, require_pacing=True)


@needs_gl
@pytest.mark.usefixtures("display")
def test_a_closed_window_is_lost_and_can_be_opened_again() -> None:
    import glfw

    for _ in range(2):
        slm = SlmWindow(SHAPE, monitor=0)
        glfw.set_window_should_close(slm._window, value=True)
        for _ in range(2):
            with pytest.raises(DeviceLostError, match="closed"):
                slm.show(codes(1))
        slm.close()


@needs_gl
def test_a_second_program_is_refused_and_the_first_goes_on(display: str) -> None:
    opens = f"from adof_drivers.slm_window import SlmWindow; SlmWindow({SHAPE}, monitor=0)"
    with SlmWindow(SHAPE, monitor=0) as slm:
        slm.show(codes(1))
        other = subprocess.run([sys.executable, "-c", opens], capture_output=True, text=True)
        assert "another program shows its patterns on screen: close that one" in other.stderr
        np.testing.assert_array_equal(screen(display)[..., 0], codes(1))
        assert slm.show(codes(2)).number == 2
        np.testing.assert_array_equal(screen(display)[..., 0], codes(2))
    assert subprocess.run([sys.executable, "-c", opens]).returncode == 0


@needs_gl
@pytest.mark.usefixtures("display")
def test_another_thread_is_refused() -> None:
    with SlmWindow(SHAPE, monitor=0) as slm:
        said: list[str] = []

        def elsewhere() -> None:
            try:
                slm.show(codes(1))
            except DriverError as refusal:
                said.append(str(refusal))

        thread = threading.Thread(target=elsewhere)
        thread.start()
        thread.join()
        assert "another thread" in said[0]
        assert slm.show(codes(1)).number == 1


@needs_gl
@pytest.mark.usefixtures("display")
def test_a_bent_gamma_ramp_is_refused() -> None:
    import glfw

    class Bent(SlmWindow):
        def _make_linear(self) -> None:
            straighten, self._glfw.set_gamma = (
                self._glfw.set_gamma,
                lambda monitor, _: straighten(monitor, 2.2),
            )
            try:
                super()._make_linear()
            finally:
                self._glfw.set_gamma = straighten

    with pytest.raises(DriverError, match="codes off a straight line"):
        Bent(SHAPE, monitor=0)
    assert glfw.set_gamma.__name__ == "set_gamma"


@needs_gl
def test_no_display_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(DriverError, match="set DISPLAY"):
        SlmWindow(SHAPE, monitor=0)


@needs_gl
@pytest.mark.skipif(
    not all(map(shutil.which, ("Xorg", "xrandr")))
    or not Path("/usr/lib/xorg/modules/drivers/dummy_drv.so").exists(),
    reason="Xorg with its dummy driver is not installed",
)
def test_the_chosen_monitor_shows_the_codes_and_the_other_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    configuration = tmp_path / "xorg.conf"
    configuration.write_text(DUMMY, encoding="utf-8")
    log = tmp_path / "xorg.log"
    with server("Xorg", "-config", str(configuration), "-logfile", str(log)) as display:
        monkeypatch.setenv("DISPLAY", display)
        for arguments in (
            ["--addmode", "DUMMY1", "640x480"],
            ["--output", "DUMMY1", "--mode", "640x480", "--right-of", "DUMMY0"],
            [],  # asking is what makes the server notice its second monitor
        ):
            subprocess.run(["xrandr", *arguments], check=True, capture_output=True)
        listed = monitors()
        assert [line.split(":")[0] for line in listed] == ["DUMMY0", "DUMMY1"]
        assert "640 x 480" in listed[1]
        before = screen(display)
        with SlmWindow((480, 640), monitor="DUMMY1") as slm:
            slm.show(codes(5, (480, 640)))
            after = screen(display)
        np.testing.assert_array_equal(
            after[:480, 800:1440], codes(5, (480, 640))[..., None].repeat(3, axis=2)
        )
        np.testing.assert_array_equal(after[:, :800], before[:, :800])
        with SlmWindow((480, 640), monitor="DUMMY1") as slm:
            subprocess.run(["xrandr", "--output", "DUMMY1", "--off"], check=True)
            for said in ("monitor is gone", "is closed"):
                with pytest.raises(DeviceLostError, match=said):
                    slm.show(codes(6, (480, 640)))
        with pytest.raises(DriverError, match="is none of: 0 DUMMY0"):
            SlmWindow((480, 640), monitor="DUMMY1")
        subprocess.run(["xrandr", *["--output", "DUMMY1", "--mode", "640x480", "--right-of", "DUMMY0"]])
        with SlmWindow((480, 640), monitor="DUMMY1") as slm:
            slm.show(codes(7, (480, 640)))
            np.testing.assert_array_equal(screen(display)[:480, 800:1440, 0], codes(7, (480, 640)))
