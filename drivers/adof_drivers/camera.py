"""What a camera offers, how its clock is carried to the host's, and a watch over the frames it sends."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from adof_drivers.errors import DriverError, FrameTimeoutError, FrozenFramesError

Trigger = Literal["free", "software"]


@dataclass(frozen=True)
class Frame:
    """One exposure.

    Attributes
    ----------
    pixels
        (rows, columns), uint8 or uint16. Lines may lie further apart than they are long: see `stride_bytes`.
    number
        The camera's own count; where numbers are missing, frames were lost.
    time_s
        When it was exposed, in the host's monotonic seconds, as well as the camera tells.
    received_s
        When it reached this program, same clock.
    device_time_s
        By the camera's own clock, if it has one.
    complete
        Whether every pixel arrived; what did not is 0.
    origin_yx
        Sensor (row, column) of the first pixel.
    """

    pixels: NDArray[Any]
    number: int
    time_s: float
    received_s: float = math.nan
    device_time_s: float | None = None
    complete: bool = True
    origin_yx: tuple[int, int] = (0, 0)

    @property
    def stride_bytes(self) -> int:
        """Bytes from the start of one line to the start of the next."""
        return int(self.pixels.strides[0])


class Camera(Protocol):
    """A source of frames, in order; every wait is bounded."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        ...

    def start(self) -> None:
        """Begin to acquire."""
        ...

    def grab(self, timeout_s: float = 1.0) -> Frame:
        """Return the next frame not yet read; 0 asks only for what is there already.

        Raises
        ------
        FrameTimeoutError
            None came in time.
        DriverError
            The camera is gone, or what it sends cannot be used.
        """
        ...

    def stop(self) -> None:
        """Acquire no more; frames not yet read are dropped."""
        ...

    def close(self) -> None:
        """Give the camera back; may be called twice, never raises."""
        ...


@dataclass(frozen=True)
class CameraSettings:
    """What a camera does, as it reports it.

    Attributes
    ----------
    origin_yx, shape
        Region of the sensor: (row, column) of the first pixel; rows, columns.
    exposure_s, rate_hz
        Exposure and frame rate; None where the camera does not say.
    trigger
        "free" runs by itself, "software" waits for `trigger()`.
    """

    origin_yx: tuple[int, int]
    shape: tuple[int, int]
    exposure_s: float | None
    rate_hz: float | None
    trigger: Trigger = "free"


def require_settings(
    sensor: tuple[int, int],
    region: tuple[tuple[int, int], tuple[int, int]] | None,
    exposure_s: float | None,
    rate_hz: float | None,
    trigger: str | None,
) -> None:
    """Refuse what no camera with `sensor` (rows, columns) can do; None means: leave it.

    Raises
    ------
    DriverError
        What came and what was wanted.
    """
    if region is not None:
        for first, count, size in zip(*region, sensor, strict=True):
            if first < 0 or count < 1 or first + count > size:
                raise DriverError(
                    f"region {region[1]} at {region[0]} leaves the sensor: it has {sensor[0]} x {sensor[1]} "
                    "pixels (rows x columns)"
                )
    for name, value in (("exposure_s", exposure_s), ("rate_hz", rate_hz)):
        if value is not None and not 0 < value < math.inf:
            raise DriverError(f"{name} is {value}: a number above 0 was wanted")
    if trigger not in (None, "free", "software"):
        raise DriverError(f"trigger is '{trigger}': choose 'free' or 'software'")


class DeviceClock:
    """Carry a camera's clock to the host's: the quickest frame of the last while took no time on its way.

    Arrivals are late by a varying amount and never early, so the smallest difference between arrival and
    device time is the best estimate of the offset. It is taken over the last `window_s` to twice that, so
    that the two clocks may drift: 100 ppm in 20 s are 2 ms.
    """

    def __init__(self, window_s: float = 10.0) -> None:
        self._window_s = window_s
        self._since_s = -math.inf
        self._offsets = [math.inf, math.inf]

    def host_s(self, device_s: float, received_s: float) -> float:
        """Return when a frame with device time `device_s`, received at `received_s`, was exposed."""
        if received_s - self._since_s > self._window_s:
            self._since_s = received_s
            self._offsets = [math.inf, self._offsets[0]]
        self._offsets[0] = min(self._offsets[0], received_s - device_s)
        return device_s + min(self._offsets)


@dataclass
class FrameCounts:
    """What became of a camera's frames.

    Attributes
    ----------
    good
        Handed out.
    dropped
        Numbers that were passed over; one that comes after all is out of order too.
    out_of_order, incomplete, late
        Came, and were not handed out.
    skipped
        Good, but a newer one was there.
    repeated
        Equal to the frame before in every pixel.
    """

    good: int = 0
    dropped: int = 0
    out_of_order: int = 0
    incomplete: int = 0
    late: int = 0
    skipped: int = 0
    repeated: int = 0

    def __str__(self) -> str:
        said = [f"{value} {name.replace('_', ' ')}" for name, value in vars(self).items() if value]
        return ", ".join(said) or "no frames"


class WatchedCamera:
    """A camera whose frames a servo may trust: fresh, whole, in order and alive; the rest is counted.

    Parameters
    ----------
    camera
        Any camera.
    policy
        "newest" hands out the latest frame there is; "lossless" every one, and is what recordings need.
    frozen_limit
        So many frames in a row equal to the one before are a frozen camera: a sensor's noise never repeats.
    late_s
        Frames older than this when they arrive are not handed out.

    Attributes
    ----------
    counts
        What became of the frames.

    Raises
    ------
    DriverError
        An unknown policy, or limits that are not above 0.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        policy: Literal["newest", "lossless"] = "newest",
        frozen_limit: int = 3,
        late_s: float = math.inf,
    ) -> None:
        if policy not in ("newest", "lossless"):
            raise DriverError(f"policy is '{policy}': choose 'newest' or 'lossless'")
        if frozen_limit < 1 or not late_s > 0:
            raise DriverError(
                f"frozen_limit is {frozen_limit}, late_s {late_s}: 1 or more, and above 0, were wanted"
            )
        self.camera = camera
        self.counts = FrameCounts()
        self._newest = policy == "newest"
        self._frozen_limit = frozen_limit
        self._late_s = late_s
        self._last: Frame | None = None
        self._alike = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        return self.camera.shape

    def start(self) -> None:
        """Begin to acquire; counting starts anew."""
        self.counts = FrameCounts()
        self._last, self._alike = None, 0
        self.camera.start()

    def grab(self, timeout_s: float = 1.0) -> Frame:
        """Return the next good frame.

        Raises
        ------
        FrameTimeoutError
            No good one came in time; says what came instead.
        FrozenFramesError
            The camera sends one picture over and over.
        DriverError
            As the camera's own `grab`.
        """
        before = FrameCounts(**vars(self.counts))
        deadline_s = time.monotonic() + timeout_s
        found: Frame | None = None
        while True:
            try:
                left_s = 0.0 if found is not None else max(deadline_s - time.monotonic(), 0.0)
                frame = self.camera.grab(left_s)
            except FrameTimeoutError as failure:
                if found is not None:
                    break
                came = ", ".join(
                    f"{value - getattr(before, name)} {name.replace('_', ' ')}"
                    for name, value in vars(self.counts).items()
                    if value > getattr(before, name)
                )
                raise FrameTimeoutError(
                    f"{failure}; came instead: {came}" if came else str(failure)
                ) from None
            if not self._is_good(frame):
                continue
            if found is not None:
                self.counts.skipped += 1
            found = frame
            if not self._newest:
                break
        self.counts.good += 1
        return found

    def _is_good(self, frame: Frame) -> bool:
        last = self._last
        if last is not None and frame.number <= last.number:
            self.counts.out_of_order += 1
            return False
        if last is not None:
            self.counts.dropped += frame.number - last.number - 1
            same = last.pixels.shape == frame.pixels.shape and np.array_equal(last.pixels, frame.pixels)
            self._alike = self._alike + 1 if same else 0
            self.counts.repeated += same
        self._last = frame
        if self._alike >= self._frozen_limit:
            raise FrozenFramesError(
                f"{self._alike + 1} frames up to number {frame.number} are equal in every pixel: the camera "
                "is frozen or sends a test picture; restart it, and see that light reaches it"
            )
        if not frame.complete:
            self.counts.incomplete += 1
            return False
        if frame.received_s - frame.time_s > self._late_s:
            self.counts.late += 1
            return False
        return True

    def stop(self) -> None:
        """Acquire no more."""
        self.camera.stop()

    def close(self) -> None:
        """Give the camera back."""
        self.camera.close()
