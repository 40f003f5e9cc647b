"""Cameras that OpenCV can open: UVC through the system's driver, streams, video files."""

from __future__ import annotations

import queue
import threading
import time
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from adof_drivers.camera import Frame, require_settings
from adof_drivers.errors import DeviceLostError, DriverError, EndOfSequenceError, FrameTimeoutError

_KEPT = 4  # frames held for a slow reader; the oldest goes first


class VideoCaptureCamera:
    """A camera by index, or a stream, video file or numbered pictures by name; colour becomes grey.

    OpenCV's read waits as long as it likes, so a thread of its own reads and `grab` waits as long as told.
    OpenCV passes on neither the camera's count nor its clock: frames are numbered as they are read, and
    their time is when they came. What the system dropped before cannot be seen.

    Parameters
    ----------
    source
        0 for the first camera; or what OpenCV can open, such as "frames/%03d.png".
    rate_hz
        Asked of the camera; a file is served as fast as it is read.

    Raises
    ------
    DriverError
        OpenCV cannot open it.
    """

    def __init__(self, source: int | str, *, rate_hz: float | None = None) -> None:
        require_settings((1, 1), None, None, rate_hz, None)
        self._source = source
        self._live = isinstance(source, int)
        self._rate_hz = rate_hz
        self._thread: threading.Thread | None = None
        # OpenCV's capture belongs to one thread at a time: to let go of it during a read crashes.
        self._turn = threading.Lock()
        self._reading = False
        self._closed = False
        self._stopping = threading.Event()
        self._frames: queue.Queue[Frame | None] = queue.Queue(_KEPT)
        self._capture = self._open()
        self._shape = (
            int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT)),
            int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH)),
        )

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(self._source)
        if not capture.isOpened():
            wanted = "a camera's index" if self._live else "a readable video, stream or pattern of pictures"
            raise DriverError(f"OpenCV cannot open {self._source!r}: {wanted} was wanted")
        if self._rate_hz is not None and self._live:
            capture.set(cv2.CAP_PROP_FPS, self._rate_hz)
        return capture

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        return self._shape

    def start(self) -> None:
        """Begin to acquire; a file begins anew.

        Raises
        ------
        DeviceLostError
            It is closed, or the last read still waits for a frame.
        """
        if self._thread is not None:
            return
        with self._turn:
            if self._closed or self._reading:
                raise DeviceLostError(f"{self._source!r} is closed, or sends nothing: open it again")
        if not self._live:
            self._capture.release()
            self._capture = self._open()
        self._stopping.clear()
        self._frames = queue.Queue(_KEPT)
        self._reading = True
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        try:
            self._read_frames()
        finally:
            with self._turn:
                self._reading = False
                if self._closed:
                    self._capture.release()

    def _read_frames(self) -> None:
        number = 0
        while not self._stopping.is_set():
            read, pixels = self._capture.read()
            now_s = time.monotonic()
            frame = Frame(_grey(pixels), number, now_s, received_s=now_s) if read else None
            self._put(frame)
            if frame is None:
                return
            number += 1

    def _put(self, frame: Frame | None) -> None:
        """A file waits for its reader; a camera does not, so that what is read is fresh."""
        while not self._stopping.is_set():
            try:
                self._frames.put(frame, timeout=0 if self._live else 0.02)
            except queue.Full:
                if self._live:
                    try:
                        self._frames.get_nowait()
                    except queue.Empty:
                        continue
            else:
                return

    def grab(self, timeout_s: float = 1.0) -> Frame:
        """Return the next frame not yet read; see `Camera.grab`."""
        if self._thread is None:
            raise DriverError("the camera is not acquiring: start() it first")
        try:
            frame = self._frames.get(timeout=timeout_s) if timeout_s > 0 else self._frames.get_nowait()
        except queue.Empty:
            raise FrameTimeoutError(f"no frame from {self._source!r} within {timeout_s:.3g} s") from None
        if frame is None:
            self._frames.put(None)  # it stays at its end
            if self._live:
                raise DeviceLostError(
                    f"camera {self._source} sends no more: check its cable, then open it again"
                )
            raise EndOfSequenceError(f"all frames of {self._source!r} were served: start() it again")
        return frame

    def stop(self) -> None:
        """Acquire no more; waits for the read that is under way, 2 s at most."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(2.0)
            self._thread = None

    def close(self) -> None:
        """Give the camera back, once OpenCV has done with it: at once, or when the read under way ends."""
        self.stop()
        with self._turn:
            self._closed = True
            if not self._reading:
                self._capture.release()


def _grey(pixels: NDArray[Any]) -> NDArray[Any]:
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))
    return pixels.reshape(pixels.shape[:2]) if pixels.ndim == 3 and pixels.shape[2] == 1 else pixels
