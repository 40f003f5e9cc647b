"""A modulator that is a monitor: a full-screen window, pixel by pixel (extra `display`: glfw, PyOpenGL)."""

from __future__ import annotations

import math
import os
import socket
import sys
import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_drivers.errors import DeviceLostError, DriverError
from adof_drivers.slm import Shown, require_codes

_FLIPS_TIMED = 12
_PACE_TOLERANCE = 0.05
_windows = 0  # glfw is one for the whole process


def _libraries() -> tuple[Any, Any]:
    try:
        import glfw
        from OpenGL import GL
    except ImportError as failure:
        raise DriverError(
            "an SLM on a monitor needs glfw and PyOpenGL: pip install 'adof-cl[display]'"
        ) from failure
    return glfw, GL


def monitors() -> list[str]:
    """Return one line for each monitor: its name, columns x rows, refresh rate.

    Raises
    ------
    DriverError
        glfw is absent, or there is no display.
    """
    glfw, _ = _libraries()
    _enter(glfw)
    try:
        return [_describe(glfw, monitor) for monitor in glfw.get_monitors()]
    finally:
        _leave(glfw)


def _describe(glfw: Any, monitor: Any) -> str:
    mode = glfw.get_video_mode(monitor)
    name = glfw.get_monitor_name(monitor)
    name = name.decode() if isinstance(name, bytes) else name
    return f"{name}: {mode.size.width} x {mode.size.height}, {mode.refresh_rate} Hz"


def _enter(glfw: Any) -> None:
    global _windows
    if _windows == 0:
        glfw.ERROR_REPORTING = "ignore"  # failures are told by what comes back
        glfw.NORMALIZE_GAMMA_RAMPS = True
        if not glfw.init():
            raise DriverError("no display can be opened: connect the panel, and set DISPLAY on X11")
    _windows += 1


def _leave(glfw: Any) -> None:
    global _windows
    _windows -= 1
    if _windows == 0:
        glfw.terminate()


def _claim(monitor: str) -> socket.socket | None:
    """Hold the monitor against a second program of ours: X puts one full-screen window over the other.

    A name without a file, which goes with the program however it ends; Linux only.
    """
    if sys.platform != "linux":
        return None
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or ""
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        claim.bind(f"\0adof SLM on {monitor} of {display.partition('.')[0]}")
    except OSError as failure:
        claim.close()
        raise DriverError(f"another program shows its patterns on {monitor}: close that one") from failure
    return claim


class SlmWindow:
    """Codes on a monitor's own pixels: grey on R = G = B, nothing scaled, dithered, blended or gamma-bent.

    The gamma ramp is made linear and read back; the first pattern is read back from the frame buffer. All
    calls must come from the thread that made it.

    Parameters
    ----------
    shape
        Rows and columns of the panel; the monitor must run at exactly this.
    monitor
        Its number, or part of its name as `monitors()` lists it. A panel is seldom monitor 0.
    require_pacing
        Refuse a display whose flips do not keep its refresh rate.

    Attributes
    ----------
    refresh_hz, measured_hz
        As the monitor states it, NaN if it does not, and as flips were timed; without a real display behind
        it the second is what the computer can do.
    paced
        Whether they agree to 5 %: then `flip_s` tells when the panel took a pattern over.

    Raises
    ------
    DriverError
        No such monitor; another resolution; another program's; a gamma ramp that is not linear; a pattern
        that comes back changed; no pacing though required.
    """

    def __init__(self, shape: tuple[int, int], *, monitor: int | str, require_pacing: bool = False) -> None:
        self._glfw, self._gl = glfw, gl = _libraries()
        self.shape = shape
        self._number = 0
        self._thread = threading.get_ident()
        self._window: Any = None
        self._held: socket.socket | None = None
        self._verified = False
        _enter(glfw)
        self._entered = True
        try:
            self._monitor = self._choose(monitor)
            self._require_mode()
            self._held = _claim(_describe(glfw, self._monitor).partition(":")[0])
            self._make_linear()
            self._window = self._create()
            self._require_framebuffer()
            gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
            gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
            for bending in (gl.GL_DITHER, gl.GL_BLEND, gl.GL_FRAMEBUFFER_SRGB, gl.GL_MULTISAMPLE):
                gl.glDisable(bending)
            self.show(np.zeros(shape, np.uint8))
            self.measured_hz = self._time_flips()
            self.paced = abs(self.measured_hz / self.refresh_hz - 1) <= _PACE_TOLERANCE
            if require_pacing and not self.paced:
                raise DriverError(
                    f"flips come at {self.measured_hz:.0f} Hz, the monitor states {self.refresh_hz:.0f}: "
                    "switch the compositor off and vertical synchronisation on"
                )
            self._number = 0
        except BaseException:
            self.close()
            raise

    def _choose(self, monitor: int | str) -> Any:
        there = self._glfw.get_monitors()
        lines = [_describe(self._glfw, one) for one in there]
        if isinstance(monitor, int):
            chosen = [monitor] if 0 <= monitor < len(there) else []
        else:
            chosen = [index for index, line in enumerate(lines) if monitor.lower() in line.lower()]
        if len(chosen) != 1:
            listed = "; ".join(f"{index} {line}" for index, line in enumerate(lines))
            raise DriverError(
                f"monitor {monitor!r} is {'none' if not chosen else 'several'} of: {listed or 'no monitor'}"
            )
        return there[chosen[0]]

    def _require_mode(self) -> None:
        mode = self._glfw.get_video_mode(self._monitor)
        if (mode.size.height, mode.size.width) != self.shape:
            raise DriverError(
                f"the monitor runs at {mode.size.width} x {mode.size.height}, the panel has "
                f"{self.shape[1]} x {self.shape[0]} pixels: set the monitor to that, or choose another one"
            )
        if min(mode.bits) < 8:
            raise DriverError(f"the monitor has {tuple(mode.bits)} bits of colour: 8 of each were wanted")
        self.refresh_hz = float(mode.refresh_rate) or math.nan

    def _make_linear(self) -> None:
        """Set a straight ramp, and see that it is there; glfw puts the old one back at the end."""
        self._glfw.set_gamma(self._monitor, 1.0)
        ramp = self._glfw.get_gamma_ramp(self._monitor)
        channels = [np.asarray(channel, dtype=np.float64) for channel in ramp] if ramp else []
        if not channels or not len(channels[0]):
            raise DriverError(
                "the monitor's gamma ramp cannot be read: it may bend the codes; use another output"
            )
        for name, channel in zip(("red", "green", "blue"), channels, strict=False):
            # Half a code: less cannot change what an 8-bit panel shows.
            off = 255 * float(np.abs(channel - np.linspace(0, 1, len(channel))).max())
            if off >= 0.5:
                raise DriverError(
                    f"the gamma ramp of {name} is {off:.1f} codes off a straight line, and stays so when "
                    "set: switch off night light and colour profiles for this monitor"
                )

    def _create(self) -> Any:
        glfw = self._glfw
        mode = glfw.get_video_mode(self._monitor)
        glfw.default_window_hints()
        for hint, value in (
            (glfw.RED_BITS, 8),
            (glfw.GREEN_BITS, 8),
            (glfw.BLUE_BITS, 8),
            (glfw.REFRESH_RATE, mode.refresh_rate or glfw.DONT_CARE),
            (glfw.SAMPLES, 0),
            (glfw.SRGB_CAPABLE, glfw.FALSE),
            (glfw.DOUBLEBUFFER, glfw.TRUE),
            (glfw.AUTO_ICONIFY, glfw.FALSE),
            (glfw.FOCUSED, glfw.FALSE),
        ):
            glfw.window_hint(hint, value)
        window = glfw.create_window(self.shape[1], self.shape[0], "SLM", self._monitor, None)
        if not window:
            raise DriverError("no OpenGL window can be opened on that monitor: install its graphics driver")
        glfw.make_context_current(window)
        glfw.set_input_mode(window, glfw.CURSOR, glfw.CURSOR_HIDDEN)
        glfw.swap_interval(1)
        glfw.poll_events()
        return window

    def _require_framebuffer(self) -> None:
        columns, rows = self._glfw.get_framebuffer_size(self._window)
        if (rows, columns) != self.shape:
            raise DriverError(
                f"the window has {columns} x {rows} pixels, the panel {self.shape[1]} x {self.shape[0]}: "
                "switch off the scaling of this monitor"
            )

    def show(self, codes: NDArray[np.uint8]) -> Shown:
        """Draw codes (rows, columns), row 0 at the top; return when the display took them over.

        Raises
        ------
        DriverError
            Another shape or type, or called from another thread; nothing changes then.
        DeviceLostError
            The window was closed or its monitor is gone.
        """
        require_codes(codes, self.shape)
        self._require_open()
        gl = self._gl
        self._glfw.make_context_current(self._window)
        gl.glWindowPos2i(0, 0)
        upwards = np.ascontiguousarray(codes[::-1])  # OpenGL begins at the bottom
        gl.glDrawPixels(self.shape[1], self.shape[0], gl.GL_LUMINANCE, gl.GL_UNSIGNED_BYTE, upwards)
        if not self._verified:
            # The opening pattern is flat; a changed value shows in any that is not.
            self._require_drawn(upwards)
            self._verified = bool(codes.min() != codes.max())
        flip_s = self._flip()
        self._number += 1
        return Shown(self._number, flip_s)

    def _flip(self) -> float:
        self._glfw.swap_buffers(self._window)
        self._gl.glFinish()
        return time.monotonic()

    def _require_open(self) -> None:
        if threading.get_ident() != self._thread:
            raise DriverError("show() came from another thread: use the one that opened the window")
        if self._window is None:
            raise DeviceLostError("the SLM window is closed: open it again")
        self._glfw.poll_events()
        if self._glfw.window_should_close(self._window):
            self.close()
            raise DeviceLostError("the SLM window was closed by somebody: open it again")
        if not self._glfw.get_window_monitor(self._window):
            self.close()
            raise DeviceLostError("the SLM's monitor is gone: check its cable, then open the window again")

    def _require_drawn(self, upwards: NDArray[np.uint8]) -> None:
        gl = self._gl
        rows, columns = self.shape
        raw = gl.glReadPixels(0, 0, columns, rows, gl.GL_RGB, gl.GL_UNSIGNED_BYTE)
        back = np.frombuffer(raw, np.uint8).reshape(rows, columns, 3)
        wrong = int(np.count_nonzero((back != upwards[..., None]).any(axis=2)))
        if wrong:
            raise DriverError(
                f"{wrong} of {rows * columns} pixels came back changed from the frame buffer: the graphics "
                "driver alters colours; switch its enhancements off"
            )

    def _time_flips(self) -> float:
        """Return the rate of flips, Hz: the median of a few."""
        times_s = [self._flip() for _ in range(_FLIPS_TIMED)]
        return 1 / max(float(np.median(np.diff(times_s))), 1e-6)

    def close(self) -> None:
        """Close the window and put the old gamma ramp back; may be called twice, never raises."""
        window, self._window = self._window, None
        if window is not None:
            self._glfw.destroy_window(window)
        if self._held is not None:
            self._held.close()
            self._held = None
        if self._entered:
            self._entered = False
            _leave(self._glfw)

    def __enter__(self) -> SlmWindow:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()
