"""Images and stacks in PNG and TIFF files, 8 and 16 bit, their depth kept."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from adof_cl.errors import InputError
from adof_cl.files import whole_file

Image = NDArray[np.uint8] | NDArray[np.uint16]
"""(rows, columns) or (rows, columns, 3); colour is red, green, blue."""

_PNG = (".png",)
_TIFF = (".tif", ".tiff")


class ImageStack:
    """A file of one or more pages, read one page at a time.

    Attributes
    ----------
    pages
        How many.
    shape, dtype
        Of the first page: (rows, columns) or (rows, columns, 3), uint8 or uint16.
    """

    def __init__(self, path: Path, pages: int, first: Image) -> None:
        self.path = path
        self.pages = pages
        self.shape = first.shape
        self.dtype = first.dtype
        self._first = first

    def __iter__(self) -> Iterator[Image]:
        """Yield every page.

        Raises
        ------
        InputError
            A page that cannot be read, or of another shape or type than the first.
        """
        yield self._first
        if self.pages == 1:
            return
        with _opened_tiff(self.path) as file:
            for index in range(1, self.pages):
                page = _checked(file.pages[index].asarray(), str(self.path))
                if page.shape != self.shape or page.dtype != self.dtype:
                    raise InputError(
                        f"{self.path} page {index + 1} is {page.shape} {page.dtype}, the first is "
                        f"{self.shape} {self.dtype}: give pages of one kind"
                    )
                yield page


def read_stack(path: Path) -> ImageStack:
    """Open a PNG, or a TIFF of one or more pages.

    Raises
    ------
    InputError
        Missing, unreadable, empty, or not 8 or 16 bit grey or colour.
    """
    suffix = path.suffix.lower()
    if not path.is_file():
        raise InputError(f"{path} is not there: give an existing .png or .tif file")
    if suffix in _TIFF:
        with _opened_tiff(path) as file:
            return ImageStack(path, len(file.pages), _checked(file.pages[0].asarray(), str(path)))
    if suffix in _PNG:
        return ImageStack(path, 1, _read_png(path))
    raise InputError(f"{path} ends in '{path.suffix}': a .png or .tif file was wanted")


def read_image(path: Path) -> Image:
    """Read a file that holds exactly one image.

    Raises
    ------
    InputError
        As `read_stack`, or several pages.
    """
    stack = read_stack(path)
    if stack.pages != 1:
        raise InputError(f"{path} has {stack.pages} pages: a file of one image was wanted")
    return next(iter(stack))


class ImageWriter:
    """Append pages to a file being written; made by `open_writer`."""

    def __init__(self, path: Path, tiff: tifffile.TiffWriter | None, target: Path) -> None:
        self._path = path
        self._tiff = tiff
        self._target = target

    def append(self, image: Image) -> None:
        """Write the next page.

        Raises
        ------
        InputError
            Not 8 or 16 bit grey or colour.
        """
        checked = _checked(image, str(self._path))
        if self._tiff is not None:
            kind = "rgb" if checked.ndim == 3 else "minisblack"
            self._tiff.write(checked, photometric=kind, contiguous=False, metadata=None)
            return
        bgr = checked[..., ::-1] if checked.ndim == 3 else checked
        done, encoded = cv2.imencode(".png", np.ascontiguousarray(bgr))
        if not done:
            raise InputError(f"{self._path} could not be encoded as PNG: write a .tif instead")
        self._target.write_bytes(encoded.tobytes())


@contextmanager
def open_writer(path: Path, pages: int = 1) -> Iterator[ImageWriter]:
    """Write an image or a stack so that the file appears whole or not at all.

    Raises
    ------
    InputError
        An ending other than .png and .tif, several pages to a PNG, or a place that cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in _PNG + _TIFF:
        raise InputError(f"{path} ends in '{path.suffix}': name it .png or .tif")
    if suffix in _PNG and pages > 1:
        raise InputError(f"{path} is to hold {pages} pages, a PNG holds one: name it .tif")
    with whole_file(path) as temporary:
        if suffix in _PNG:
            yield ImageWriter(path, None, temporary)
        else:
            with tifffile.TiffWriter(temporary) as tiff:
                yield ImageWriter(path, tiff, temporary)


def write_image(path: Path, image: Image) -> None:
    """Write one image; the file appears whole or not at all.

    Raises
    ------
    InputError
        As `open_writer` and `ImageWriter.append`.
    """
    with open_writer(path) as writer:
        writer.append(image)


@contextmanager
def _opened_tiff(path: Path) -> Iterator[tifffile.TiffFile]:
    try:
        with tifffile.TiffFile(path) as file:
            yield file
    except InputError:
        raise
    except (OSError, ValueError, LookupError, RuntimeError, struct.error) as failure:
        said = (str(failure) or type(failure).__name__).splitlines()[0]
        raise InputError(f"{path} cannot be read as TIFF ({said}): give a complete file") from failure


def _read_png(path: Path) -> Image:
    try:
        content = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as failure:
        raise InputError(f"{path} cannot be read ({failure.strerror}): check its permissions") from failure
    image: Any = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if content.size else None
    if image is None:
        raise InputError(f"{path} cannot be read as PNG: give a complete file")
    if image.ndim == 3 and image.shape[2] == 3:
        image = np.ascontiguousarray(image[..., ::-1])
    return _checked(image, str(path))


def _checked(image: NDArray[Any], name: str) -> Image:
    grey_or_colour = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if not grey_or_colour or image.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"{name} holds {image.shape} {image.dtype}: 8 or 16 bit grey, or red, green and blue, was wanted"
        )
    return image
