"""Cameras in the rig file, and what a check of them looks at: rate, latency, losses."""

from __future__ import annotations

import time
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from adof_drivers.basler import BaslerCamera
from adof_drivers.camera import Camera, Frame, WatchedCamera
from adof_drivers.errors import EndOfSequenceError
from adof_drivers.gige import GigeCamera
from adof_drivers.image_sequence import ImageSequenceCamera
from adof_drivers.rig import Finding, Positive, Section, register
from adof_drivers.video_capture import VideoCaptureCamera

_WATCHED_S = 1.5
_RATE_TOLERANCE = 0.02
Index = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]


class CameraSection(Section):
    """A camera; `rate_hz` is what it is asked for."""

    rate_hz: Positive | None = None

    def identity(self, device: Any) -> str:
        """Say who it is."""
        raise NotImplementedError

    def check(self, name: str, device: Any, *, move: bool) -> list[Finding]:  # noqa: ARG002
        """Take frames for a while: how many a second, how old on arrival, how many lost."""
        rows, columns = device.shape
        watched = WatchedCamera(device, policy="lossless")
        frames: list[Frame] = []
        watched.start()
        try:
            until_s = time.monotonic() + _WATCHED_S
            while time.monotonic() < until_s or len(frames) < 3:
                frames.append(watched.grab(2.0))
        finally:
            watched.stop()
        span_s = frames[-1].time_s - frames[0].time_s
        rate_hz = (frames[-1].number - frames[0].number) / span_s if span_s > 0 else 0.0
        ages_ms = 1e3 * np.array([frame.received_s - frame.time_s for frame in frames])
        wanted_hz = self.rate_hz
        lost = watched.counts.dropped + watched.counts.incomplete + watched.counts.out_of_order
        return [
            Finding(name, "identity", f"{self.identity(device)}, {columns} x {rows}"),
            Finding(
                name,
                "frame rate",
                f"{rate_hz:.2f} Hz" + ("" if wanted_hz is None else f", {wanted_hz:g} asked for"),
                good=wanted_hz is None or abs(rate_hz / wanted_hz - 1) <= _RATE_TOLERANCE,
                mend="shorten the exposure, read fewer rows, or ask for less",
            ),
            Finding(
                name,
                "frame age on arrival",
                f"{median(ages_ms):.1f} ms median, {np.percentile(ages_ms, 99):.1f} ms p99",
            ),
            Finding(
                name,
                "losses",
                f"{lost} of {frames[-1].number - frames[0].number + 1} frames ({watched.counts})",
                good=lost == 0,
                mend="give the network a larger receive buffer and packets, or the camera a line of its own",
            ),
        ]


class SensorSection(CameraSection):
    """A camera whose exposure and region of the sensor can be set; a region by all of its four numbers."""

    exposure_s: Positive | None = None
    first_row: Index | None = None
    first_column: Index | None = None
    rows: Count | None = None
    columns: Count | None = None

    @model_validator(mode="after")
    def _whole_region(self) -> SensorSection:
        given = [v is not None for v in (self.first_row, self.first_column, self.rows, self.columns)]
        if any(given) and not all(given):
            raise ValueError("a region is first_row, first_column, rows and columns: give all four or none")
        return self

    @property
    def region(self) -> tuple[tuple[int, int], tuple[int, int]] | None:
        """Region of the sensor: (row, column) of the first pixel, (rows, columns)."""
        if self.first_row is None or self.first_column is None or self.rows is None or self.columns is None:
            return None
        return (self.first_row, self.first_column), (self.rows, self.columns)

    def identity(self, device: Any) -> str:
        """Its model."""
        return str(device.model)

    def _configured(self, camera: Any) -> Any:
        try:
            camera.configure(region=self.region, exposure_s=self.exposure_s, rate_hz=self.rate_hz)
        except BaseException:
            camera.close()
            raise
        return camera


@register("camera", "gige")
class GigeSection(SensorSection):
    """GigE Vision."""

    address: Annotated[str, Field(pattern=r"^\d{1,3}(\.\d{1,3}){3}$")]
    interface: str | None = None
    packet_bytes: Annotated[int, Field(ge=576, le=16384)] | None = None

    def open(self) -> Camera:
        """Take control of it."""
        camera: Camera = self._configured(
            GigeCamera(self.address, interface=self.interface, packet_size=self.packet_bytes)
        )
        return camera


@register("camera", "basler")
class BaslerSection(SensorSection):
    """Basler's own software."""

    serial_number: str | None = None

    def open(self) -> Camera:
        """Open it."""
        camera: Camera = self._configured(BaslerCamera(self.serial_number))
        return camera


@register("camera", "video_capture")
class VideoCaptureSection(CameraSection):
    """Whatever OpenCV opens: a number for a camera, else a name."""

    source: int | str

    def open(self) -> Camera:
        """Open it."""
        return VideoCaptureCamera(self.source, rate_hz=self.rate_hz)

    def identity(self, device: Any) -> str:  # noqa: ARG002
        """What OpenCV was given."""
        return f"OpenCV source {self.source!r}"


@register("camera", "image_sequence")
class ImageSequenceSection(CameraSection):
    """Recorded pictures; `rate_hz` is what their times are counted with."""

    path: str

    def open(self) -> Camera:
        """Find them."""
        return ImageSequenceCamera(Path(self.path), rate_hz=self.rate_hz or 60.0)

    def check(self, name: str, device: Any, *, move: bool) -> list[Finding]:  # noqa: ARG002
        """Read every frame: they are there, grey and of one size."""
        device.start()
        count = 0
        try:
            while True:
                device.grab()
                count += 1
        except EndOfSequenceError:
            rows, columns = device.shape
            return [Finding(name, "frames", f"{count} of {columns} x {rows} in {self.path}")]
