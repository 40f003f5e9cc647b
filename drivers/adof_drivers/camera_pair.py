"""Two cameras as one: frames of the same moment, paired by time."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from adof_drivers.camera import Frame, WatchedCamera
from adof_drivers.errors import DeviceLostError, DriverError, FrameTimeoutError, FrozenFramesError


@dataclass(frozen=True)
class FramePair:
    """One frame of each camera, exposed at the same moment."""

    frame_1: Frame
    frame_2: Frame

    @property
    def apart_s(self) -> float:
        """By how much the second was exposed after the first."""
        return self.frame_2.time_s - self.frame_1.time_s


class CameraPair:
    """Pair the frames of two cameras; a frame without a partner is dropped and counted.

    Parameters
    ----------
    camera_1, camera_2
        The cameras, watched.
    tolerance_s
        How far apart two exposures may be; half a period or less, or neighbours would pair.

    Attributes
    ----------
    unpaired
        For each camera, good frames that found no partner.

    Raises
    ------
    DriverError
        A tolerance that is not above 0.
    """

    def __init__(self, camera_1: WatchedCamera, camera_2: WatchedCamera, *, tolerance_s: float) -> None:
        if not 0 < tolerance_s < math.inf:
            raise DriverError(f"tolerance_s is {tolerance_s}: a time above 0 was wanted")
        self.cameras = (camera_1, camera_2)
        self.unpaired = [0, 0]
        self._tolerance_s = tolerance_s

    def start(self) -> None:
        """Begin to acquire with both; if the second cannot, the first is stopped again."""
        self.unpaired = [0, 0]
        self.cameras[0].start()
        try:
            self.cameras[1].start()
        except BaseException:
            self.cameras[0].stop()
            raise

    def grab(self, timeout_s: float = 1.0) -> FramePair:
        """Return the next pair.

        Raises
        ------
        FrameTimeoutError
            No pair in time; names the camera that kept the other waiting.
        DeviceLostError, FrozenFramesError, DriverError
            As of one camera, named.
        """
        deadline_s = time.monotonic() + timeout_s
        frames = [self._grab(0, deadline_s), self._grab(1, deadline_s)]
        while abs(apart_s := frames[1].time_s - frames[0].time_s) > self._tolerance_s:
            earlier = 0 if apart_s > 0 else 1
            self.unpaired[earlier] += 1
            frames[earlier] = self._grab(earlier, deadline_s, apart_s=apart_s)
        return FramePair(frames[0], frames[1])

    def _grab(self, index: int, deadline_s: float, apart_s: float | None = None) -> Frame:
        name = f"camera {index + 1}"
        try:
            return self.cameras[index].grab(max(deadline_s - time.monotonic(), 0.0))
        except FrameTimeoutError as failure:
            unlike = (
                "" if apart_s is None else f"; the last two frames were {1e3 * abs(apart_s):.1f} ms apart"
            )
            raise FrameTimeoutError(f"{name}: {failure}{unlike}") from failure
        except (DeviceLostError, FrozenFramesError) as failure:
            raise type(failure)(f"{name}: {failure}") from failure
        except DriverError as failure:
            raise DriverError(f"{name}: {failure}") from failure

    def stop(self) -> None:
        """Acquire no more, the second first; if one cannot stop, the other still is."""
        try:
            self.cameras[1].stop()
        finally:
            self.cameras[0].stop()

    def close(self) -> None:
        """Give both back."""
        for camera in reversed(self.cameras):
            camera.close()
