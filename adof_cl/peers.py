"""Other libraries doing the same work, to be timed beside ours: each as well prepared as it can be.

A peer's filter is transformed beforehand, its arrays are allocated and aligned, its transforms planned, and
its frame already lies, zero-padded, in its own buffer: only the arithmetic is timed.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError

# MKL's threads spin for 200 ms after each call otherwise and slow down whoever comes next; it reads these
# when it loads. The user's own values stand.
os.environ.setdefault("KMP_BLOCKTIME", "0")
os.environ.setdefault("MKL_NUM_THREADS", str(min(2, os.cpu_count() or 1)))
os.environ.setdefault("MKL_DYNAMIC", "FALSE")

THREADS = 2
"""Threads each threaded peer may use."""

Shape = tuple[int, int]
Gain = Callable[[Shape], NDArray[np.complex128]]


class Filter(Protocol):
    """A frame's filter at one padded size: `load` a frame, `run`, and `image` is a view of the result."""

    @property
    def image(self) -> NDArray[np.float32]:
        """The result, (rows, columns)."""

    def load(self, frame: NDArray[Any]) -> None:
        """Convert a frame of any real type into the filter's own buffer."""

    def run(self) -> None:
        """Transform, multiply, transform back; waits."""


class _PyfftwFilter:
    def __init__(self, shape: Shape, padded: Shape, gain: NDArray[np.complex128], _queue: Any) -> None:
        pyfftw = importlib.import_module("pyfftw")
        half = (padded[0], padded[1] // 2 + 1)
        buffer = pyfftw.empty_aligned(padded, np.float32)
        self._spectrum = pyfftw.empty_aligned(half, np.complex64)
        result = pyfftw.empty_aligned(padded, np.float32)
        plan = {"axes": (0, 1), "threads": THREADS}
        self._forward = pyfftw.FFTW(buffer, self._spectrum, flags=("FFTW_MEASURE",), **plan)
        flags = ("FFTW_MEASURE", "FFTW_DESTROY_INPUT")
        self._inverse = pyfftw.FFTW(self._spectrum, result, direction="FFTW_BACKWARD", flags=flags, **plan)
        self._gain = pyfftw.empty_aligned(half, np.complex64)
        self._gain[:] = gain / (padded[0] * padded[1])
        buffer[:] = 0  # planning writes to it
        self._frame = buffer[: shape[0], : shape[1]]
        self.image: NDArray[np.float32] = result[: shape[0], : shape[1]]

    def load(self, frame: NDArray[Any]) -> None:
        self._frame[:] = frame

    def run(self) -> None:
        self._forward.execute()
        np.multiply(self._spectrum, self._gain, out=self._spectrum)
        self._inverse.execute()


class _MklFilter:
    def __init__(self, shape: Shape, padded: Shape, gain: NDArray[np.complex128], _queue: Any) -> None:
        self._mkl = importlib.import_module("mkl_fft")
        self._buffer = np.zeros(padded, np.float32)
        self._padded = padded
        self._gain = gain.astype(np.complex64)
        self._spectrum = np.empty(gain.shape, np.complex64)
        self._result = np.empty(padded, np.float32)
        self._frame = self._buffer[: shape[0], : shape[1]]
        self.image = self._result[: shape[0], : shape[1]]

    def load(self, frame: NDArray[Any]) -> None:
        self._frame[:] = frame

    def run(self) -> None:
        self._mkl.rfft2(self._buffer, out=self._spectrum)
        np.multiply(self._spectrum, self._gain, out=self._spectrum)
        self._mkl.irfft2(self._spectrum, s=self._padded, out=self._result)


class _ScipyFilter:
    def __init__(self, shape: Shape, padded: Shape, gain: NDArray[np.complex128], _queue: Any) -> None:
        self._buffer = np.zeros(padded, np.float32)
        self._shape, self._padded = shape, padded
        self._gain = gain.astype(np.complex64)
        self._frame = self._buffer[: shape[0], : shape[1]]
        self.image = self._frame

    def load(self, frame: NDArray[Any]) -> None:
        self._frame[:] = frame

    def run(self) -> None:
        import scipy.fft

        spectrum = scipy.fft.rfft2(self._buffer, workers=THREADS)
        spectrum *= self._gain
        result = scipy.fft.irfft2(spectrum, s=self._padded, workers=THREADS, overwrite_x=True)
        self.image = result[: self._shape[0], : self._shape[1]]


class _OpencvFilter:
    def __init__(self, shape: Shape, padded: Shape, gain: NDArray[np.complex128], _queue: Any) -> None:
        import cv2

        self._buffer = np.zeros(padded, np.float32)
        self._spectrum = np.empty(padded, np.float32)
        # The library's own packing of a half spectrum, by transforming what the filter does to a point.
        point = np.fft.irfft2(gain, s=padded)
        self._gain = (cv2.dft(point) / (padded[0] * padded[1])).astype(np.float32)
        self._rows = shape[0]
        self._result = np.empty(padded, np.float32)
        self._frame = self._buffer[: shape[0], : shape[1]]
        self.image: NDArray[np.float32] = self._result[: shape[0], : shape[1]]

    def load(self, frame: NDArray[Any]) -> None:
        self._frame[:] = frame

    def run(self) -> None:
        import cv2

        # It is told which rows hold data and which are wanted: the others it need not transform.
        cv2.dft(self._buffer, self._spectrum, 0, self._rows)
        cv2.mulSpectrums(self._spectrum, self._gain, 0, self._spectrum)
        cv2.idft(self._spectrum, self._result, 0, self._rows)


class _PyvkfftFilter:
    """R2C, one multiply kernel, C2R, on the same device and queue as ours."""

    def __init__(self, shape: Shape, padded: Shape, gain: NDArray[np.complex128], queue: Any) -> None:
        # The peer's own bindings, not ours.
        array = importlib.import_module("pyopencl.array")
        elementwise = importlib.import_module("pyopencl.elementwise")
        application = importlib.import_module("pyvkfft.opencl").VkFFTApp
        self._host = np.zeros(padded, np.float32)
        self._queue = queue
        self._buffer = array.zeros(queue, padded, np.float32)
        self._result = array.zeros(queue, padded, np.float32)
        self._spectrum = array.zeros(queue, gain.shape, np.complex64)
        self._gain = array.to_device(queue, gain.astype(np.complex64))
        self._fft = application(padded, np.float32, queue, ndim=2, inplace=False, r2c=True)
        self._multiply = elementwise.ElementwiseKernel(
            queue.context, "cfloat_t *s, cfloat_t *g", "s[i] = cfloat_mul(s[i], g[i])", "peer_multiply"
        )
        self._shape = shape

    def load(self, frame: NDArray[Any]) -> None:
        self._host[: self._shape[0], : self._shape[1]] = frame
        self._buffer.set(self._host)

    def run(self) -> None:
        self._fft.fft(self._buffer, self._spectrum)
        self._multiply(self._spectrum, self._gain)
        self._fft.ifft(self._spectrum, self._result)
        self._queue.finish()

    @property
    def image(self) -> NDArray[np.float32]:
        return np.asarray(self._result.get()[: self._shape[0], : self._shape[1]])


@dataclass(frozen=True)
class Peer:
    """One library that is installed.

    Attributes
    ----------
    name, version
        As the results name it.
    make
        Builds its filter: frame's shape, padded shape, gain (ny, nx // 2 + 1), our device's queue.
    """

    name: str
    version: str
    make: Callable[[Shape, Shape, NDArray[np.complex128], Any], Filter]


# Name: what is imported, whose version counts, and its filter.
_KNOWN: dict[str, tuple[str, tuple[str, ...], Callable[..., Filter]]] = {
    "pyfftw": ("pyfftw", ("pyfftw",), _PyfftwFilter),
    "mkl_fft": ("mkl_fft", ("mkl_fft",), _MklFilter),
    "scipy": ("scipy.fft", ("scipy",), _ScipyFilter),
    "opencv": (
        "cv2",
        ("opencv-contrib-python-headless", "opencv-python"),
        _OpencvFilter,
    ),
    "pyvkfft": ("pyvkfft.opencl", ("pyvkfft",), _PyvkfftFilter),
}
NAMES = tuple(_KNOWN)
"""Every library that can be asked for."""


def installed(wanted: str = "auto") -> list[Peer]:
    """Return the peers asked for: "auto" for all that are installed, "none", or names with commas between.

    Raises
    ------
    InputError
        An unknown name, or one that is not installed.
    """
    if wanted == "none":
        return []
    names = NAMES if wanted == "auto" else tuple(name.strip() for name in wanted.split(","))
    found = []
    for name in names:
        if name not in _KNOWN:
            raise InputError(f"peer is '{name}': choose auto, none, or some of {', '.join(NAMES)}")
        module, packages, make = _KNOWN[name]
        try:
            importlib.import_module(module)
        except (ImportError, OSError) as failure:  # OSError: a shared library it needs is missing
            if wanted != "auto":
                raise InputError(
                    f"peer '{name}' was asked for and cannot be imported ({failure}): install it, or use "
                    "--peers auto"
                ) from failure
            continue
        found.append(Peer(name, _version(packages), make))
    return found


def _version(packages: tuple[str, ...]) -> str:
    for package in packages:
        try:
            return importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return "unknown"


def good_lengths(at_least: int, most: int = 3) -> list[int]:
    """Return even lengths a transform may like: products of 2, 3, 5, 7, 11 and 13 up to 6 % longer.

    A length that is such a product already is the only one.
    """
    found = []
    for n in range(at_least, int(1.06 * at_least) + 3):
        rest = n
        for prime in (2, 3, 5, 7, 11, 13):
            while rest % prime == 0:
                rest //= prime
        if rest > 1 or n % 2:
            continue
        if n == at_least:
            return [n]
        found.append(n)
    # The longer of many are the rounder ones: multiples of the highest power of two first.
    found.sort(key=lambda n: (-(n & -n), n))
    return found[:most]
