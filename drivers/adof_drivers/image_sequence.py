"""A camera that replays recorded frames: a TIFF stack, or PNG and TIFF files in the order of their names."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from adof_drivers.camera import Frame
from adof_drivers.errors import DriverError, EndOfSequenceError


def _read_stack(path: Path) -> Iterator[NDArray[Any]]:
    try:
        with tifffile.TiffFile(path) as file:
            for page in file.pages:
                yield page.asarray()
    except (OSError, tifffile.TiffFileError, ValueError) as failure:
        raise DriverError(f"{path} is not a readable TIFF ({failure}): check the file") from failure


def _read_png(path: Path) -> NDArray[Any]:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise DriverError(f"{path} is not a readable PNG: check the file")
    return np.asarray(pixels)


class ImageSequenceCamera:
    """Serve recorded frames one by one through the same `grab()` as a real camera.

    Parameters
    ----------
    source
        A TIFF stack, one picture, or a folder of pictures.
    rate_hz
        Frame rate the times are counted with; `time_s` of the first frame is 0. Nothing waits: a frame is
        there when it is asked for.

    Raises
    ------
    DriverError
        Nothing readable there; a frame that is not grey, not 8 or 16 bit, or of another size than the first.
    """

    def __init__(self, source: Path, *, rate_hz: float = 60.0) -> None:
        if not rate_hz > 0:
            raise DriverError(f"rate_hz is {rate_hz}: a rate above 0 was wanted")
        self._period_s = 1 / rate_hz
        if source.is_dir():
            self._paths = sorted(p for p in source.iterdir() if p.suffix.lower() in {".png", ".tif", ".tiff"})
        else:
            self._paths = [source] if source.is_file() else []
        if not self._paths:
            raise DriverError(f"{source} holds no PNG or TIFF: give a picture, a stack or a folder of them")
        self._first: NDArray[Any] | None = None
        self.start()

    def _read(self) -> Iterator[NDArray[Any]]:
        for path in self._paths:
            if path.suffix.lower() == ".png":
                yield _read_png(path)
            else:
                yield from _read_stack(path)

    def start(self) -> None:
        """Begin with the first frame, again if some were served."""
        self._frames = self._read()
        self._number = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame; reads the first one if none was read."""
        if self._first is None:
            self._usable(next(self._read()))
        assert self._first is not None
        return self._first.shape[0], self._first.shape[1]

    def grab(self, timeout_s: float = 1.0) -> Frame:  # noqa: ARG002  (as every camera)
        """Return the next frame.

        Raises
        ------
        EndOfSequenceError
            All frames have been served.
        DriverError
            The next one cannot be used; the message says why.
        """
        try:
            pixels = self._usable(next(self._frames))
        except StopIteration:
            raise EndOfSequenceError(
                f"all {self._number} frames were served: open the sequence again"
            ) from None
        time_s = self._number * self._period_s
        frame = Frame(pixels, self._number, time_s, received_s=time_s, device_time_s=time_s)
        self._number += 1
        return frame

    def _usable(self, pixels: NDArray[Any]) -> NDArray[Any]:
        if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
            raise DriverError(
                f"frame {self._number} is {pixels.shape} {pixels.dtype}: "
                "a grey picture of 8 or 16 bits was wanted"
            )
        if self._first is None:
            self._first = pixels
        if pixels.shape != self._first.shape:
            raise DriverError(
                f"frame {self._number} is {pixels.shape}, the first was {self._first.shape}: "
                "keep one size to a sequence"
            )
        return pixels

    def stop(self) -> None:
        """Nothing runs that could be stopped."""

    def close(self) -> None:
        """Let go of the file."""
        self._frames = iter(())
