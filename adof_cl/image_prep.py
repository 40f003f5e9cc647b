"""Correct raw camera frames on the device: dark level, gain, region of interest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError
from adof_cl.finite import checked_shape
from adof_cl.program import Program

_LARGEST_LEVEL = 1e16


@dataclass(frozen=True)
class Region:
    """A rectangle of a frame: its top-left pixel and its size."""

    top: int
    left: int
    rows: int
    columns: int

    @classmethod
    def middle(cls, frame_shape: tuple[int, int], shape: tuple[int, int]) -> Region:
        """Return the region of `shape` in the middle of a frame; both are (rows, columns)."""
        frame_shape, shape = checked_shape("frame_shape", frame_shape), checked_shape("shape", shape)
        return cls((frame_shape[0] - shape[0]) // 2, (frame_shape[1] - shape[1]) // 2, *shape)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns


class ImagePrep:
    """Turn raw integers into a corrected image: gain (frame - dark), cropped.

    Built once: compiles and allocates. Called often: enqueues, allocates nothing, does not wait.

    Parameters
    ----------
    device
        The opened device.
    frame_shape
        (rows, columns) of the camera's frame.
    region
        What to keep; None keeps all.
    in_dtype, out_dtype
        uint8 or uint16 in; float32 or uint8 out. uint8 is rounded half up and held to 0 .. 255.
    dark, gain
        One number or a map of `frame_shape`: the dark level in raw grey levels, and output levels per grey
        level (a flat field's reciprocal).

    Raises
    ------
    InputError
        A shape, type or value outside the above.

    Source
    ------
    docs/maths.md, eq. S1.
    """

    def __init__(
        self,
        device: Device,
        frame_shape: tuple[int, int],
        *,
        region: Region | None = None,
        in_dtype: DTypeLike = np.uint8,
        out_dtype: DTypeLike = np.float32,
        dark: ArrayLike = 0.0,
        gain: ArrayLike = 1.0,
    ) -> None:
        self.device = device
        self.frame_shape = frame_shape = checked_shape("frame_shape", frame_shape)
        self.region = region or Region(0, 0, *frame_shape)
        self.in_dtype = np.dtype(in_dtype)
        self.out_dtype = np.dtype(out_dtype)
        r = self.region
        whole = all(isinstance(n, (int, np.integer)) for n in (r.top, r.left, *r.shape))
        fits = whole and min(r.top, r.left) >= 0 and min(r.shape) >= 1
        if not fits or r.top + r.rows > frame_shape[0] or r.left + r.columns > frame_shape[1]:
            raise InputError(f"{r} does not lie inside a frame of {tuple(frame_shape)}: choose one that does")
        if self.in_dtype not in (np.uint8, np.uint16):
            raise InputError(f"in_dtype is {self.in_dtype}: choose uint8 or uint16")
        if self.out_dtype not in (np.float32, np.uint8):
            raise InputError(f"out_dtype is {self.out_dtype}: choose float32 or uint8")

        maps = [self._map("dark", dark), self._map("gain", gain)]
        brightest = (65535 + float(np.abs(maps[0]).max())) * float(np.abs(maps[1]).max())
        if not brightest <= _LARGEST_LEVEL:
            raise InputError(
                f"dark and gain make levels of up to {brightest:g}: at most {_LARGEST_LEVEL:g} was wanted, "
                "which a search's sums can hold"
            )
        per_pixel = any(m.size > 1 for m in maps)
        if per_pixel:
            maps = [np.ascontiguousarray(np.broadcast_to(m, r.shape)) for m in maps]
        corrections = [device.upload(m) for m in maps]
        program = Program(
            device,
            "image_prep.cl",
            {
                "FRAME_KIND": int(self.in_dtype == np.uint16),
                "PER_PIXEL": per_pixel,
                "TO_BYTES": self.out_dtype == np.uint8,
            },
        )
        run = r.columns if device.facts.kind == "cpu" else 1
        self._frame: DeviceArray | None = None
        self._out: DeviceArray | None = None
        self._launch = program.launch(
            "image_prep",
            (-(-r.columns // run), r.rows),
            None,
            None,
            *corrections,
            None,
            *(np.int32(n) for n in (frame_shape[1], r.top, r.left, r.rows, r.columns, run)),
        )

    def _map(self, name: str, values: ArrayLike) -> NDArray[np.float32]:
        given = np.asarray(values, dtype=np.float64)
        if given.shape not in ((), self.frame_shape):
            raise InputError(
                f"{name} has shape {given.shape}: one number or a map of {tuple(self.frame_shape)} was wanted"
            )
        if not np.isfinite(given).all():
            raise InputError(f"{name} holds values that are not finite: measure it anew")
        if given.ndim:
            r = self.region
            given = given[r.top : r.top + r.rows, r.left : r.left + r.columns]
        return np.array(given, dtype=np.float32, ndmin=1)

    def __call__(self, frame: DeviceArray, out: DeviceArray) -> DeviceArray:
        """Enqueue the correction of `frame` (`frame_shape`, `in_dtype`) into `out` (region's shape).

        Raises
        ------
        InputError
            Another shape or type.
        """
        if frame is not self._frame:
            _require("frame", frame, self.frame_shape, self.in_dtype)
            self._launch.set(0, frame)
            self._frame = frame
        if out is not self._out:
            _require("out", out, self.region.shape, self.out_dtype)
            self._launch.set(3, out)
            self._out = out
        self._launch()
        return out

    def prepare(self, frame: NDArray[Any]) -> NDArray[Any]:
        """Upload one frame, correct it and return the image: the short way, when speed does not matter."""
        _require("frame", frame, self.frame_shape, self.in_dtype)
        out = self.device.empty(self.region.shape, self.out_dtype)
        return self(self.device.upload(frame), out).download()


def _require(
    name: str, array: DeviceArray | NDArray[Any], shape: tuple[int, int], dtype: np.dtype[Any]
) -> None:
    if array.shape != shape or array.dtype != dtype:
        raise InputError(
            f"{name} of shape {array.shape} and type {array.dtype} came, {tuple(shape)} {dtype} was wanted: "
            "convert it first"
        )
