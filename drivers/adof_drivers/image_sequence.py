"""A camera that replays recorded frames: a TIFF stack, or PNG and TIFF files in the order of their names."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from adof_drivers.errors import DriverError, EndOfSequenceError


@dataclass(frozen=True)
class Frame:
    """One picture. `pixels` is (rows, columns), uint8 or uint16; `time_s` counts from the first frame."""

    pixels: NDArray[Any]
    number: int
    time_s: float


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
        Frame rate the times are counted with.

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
        self._frames = self._read()
        self._number = 0
        self._shape: tuple[int, ...] | None = None

    def _read(self) -> Iterator[NDArray[Any]]:
        for path in self._paths:
            if path.suffix.lower() == ".png":
                yield _read_png(path)
            else:
                yield from _read_stack(path)

    def grab(self) -> Frame:
        """Return the next frame.

        Raises
        ------
        EndOfSequenceError
            All frames have been served.
        DriverError
            The next one cannot be used; the message says why.
        """
        try:
            pixels = next(self._frames)
        except StopIteration:
            raise EndOfSequenceError(
                f"all {self._number} frames were served: open the sequence again"
            ) from None
        if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
            raise DriverError(
                f"frame {self._number} is {pixels.shape} {pixels.dtype}: "
                "a grey picture of 8 or 16 bits was wanted"
            )
        if self._shape is None:
            self._shape = pixels.shape
        if pixels.shape != self._shape:
            raise DriverError(
                f"frame {self._number} is {pixels.shape}, the first was {self._shape}: "
                "keep one size to a sequence"
            )
        frame = Frame(pixels, self._number, self._number * self._period_s)
        self._number += 1
        return frame
