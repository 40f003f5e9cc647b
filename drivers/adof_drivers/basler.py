"""Basler cameras through Basler's own software, pypylon (extra `basler`; proprietary)."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from adof_drivers.camera import CameraSettings, DeviceClock, Frame, Trigger, require_settings
from adof_drivers.errors import DeviceLostError, DriverError, FrameTimeoutError


class BaslerCamera:
    """A grey Basler camera, GigE or USB.

    Parameters
    ----------
    serial
        Its serial number; default: the only one there is.

    Raises
    ------
    DriverError
        pypylon is absent, no or several cameras, or another program holds it.
    """

    def __init__(self, serial: str | None = None) -> None:
        try:
            from pypylon import genicam, pylon
        except ImportError as failure:
            raise DriverError("Basler cameras need pypylon: pip install 'adof-cl[basler]'") from failure
        self._pylon = pylon
        self._error = genicam.GenericException
        factory = pylon.TlFactory.GetInstance()
        there = {device.GetSerialNumber(): device for device in factory.EnumerateDevices()}
        if serial is None and len(there) == 1:
            serial = next(iter(there))
        if serial not in there:
            raise DriverError(
                f"Basler camera {serial or ''} was not found; there are: {', '.join(there) or 'none'}. "
                "Name one by its serial number"
            )
        self.serial = serial
        try:
            self._camera = pylon.InstantCamera(factory.CreateDevice(there[serial]))
            self._camera.Open()
            # In this order; pypylon's emulator stalls otherwise.
            self._camera.PixelFormat.Value = "Mono8"
        except self._error as failure:
            raise DriverError(
                f"Basler camera {serial} cannot be opened ({failure}): close the program that holds it"
            ) from failure
        self.model = there[serial].GetModelName()
        self._clock = DeviceClock()
        ticks = self._feature("GevTimestampTickFrequency")
        self._tick_s = 1e-9 if ticks is None else 1 / float(ticks.Value)
        self._sensor = (int(self._camera.HeightMax.Value), int(self._camera.WidthMax.Value))
        self.settings = self._read_settings("free")

    def _feature(self, name: str) -> Any:
        """Older cameras call the same feature ...Abs."""
        for spelled in (name, f"{name}Abs"):
            try:
                node = getattr(self._camera, spelled)
                _ = node.Value
            except (self._error, AttributeError):
                continue
            return node
        return None

    def _read_settings(self, trigger: Trigger) -> CameraSettings:
        camera = self._camera
        exposure, rate = self._feature("ExposureTime"), self._feature("AcquisitionFrameRate")
        return CameraSettings(
            (int(camera.OffsetY.Value), int(camera.OffsetX.Value)),
            (int(camera.Height.Value), int(camera.Width.Value)),
            None if exposure is None else float(exposure.Value) * 1e-6,
            None if rate is None else float(rate.Value),
            trigger,
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        return self.settings.shape

    @property
    def sensor(self) -> tuple[int, int]:
        """Rows and columns of the whole sensor."""
        return self._sensor

    def configure(
        self,
        *,
        region: tuple[tuple[int, int], tuple[int, int]] | None = None,
        exposure_s: float | None = None,
        rate_hz: float | None = None,
        trigger: Trigger | None = None,
    ) -> CameraSettings:
        """Change what is given, before `start()`; return what the camera made of it.

        Raises
        ------
        DriverError
            The camera is acquiring, or refuses.
        """
        camera = self._camera
        if camera.IsGrabbing():
            raise DriverError("the camera is acquiring: stop() it before configure()")
        require_settings(self._sensor, region, exposure_s, rate_hz, trigger)
        try:
            if region is not None:
                # Offsets first to 0: a new size must fit at the old offset otherwise.
                camera.OffsetX.Value, camera.OffsetY.Value = 0, 0
                (y, x), (camera.Height.Value, camera.Width.Value) = region
                camera.OffsetX.Value, camera.OffsetY.Value = x, y
            for name, value in (
                ("ExposureTime", None if exposure_s is None else exposure_s * 1e6),
                ("AcquisitionFrameRate", rate_hz),
            ):
                node = self._feature(name)
                if value is not None and node is None:
                    raise DriverError(f"Basler camera {self.serial} has no {name}")
                if value is not None:
                    if name == "AcquisitionFrameRate":
                        camera.AcquisitionFrameRateEnable.Value = True
                    node.Value = value
            if trigger is not None:
                camera.TriggerSelector.Value = "FrameStart"
                camera.TriggerSource.Value = "Software"
                camera.TriggerMode.Value = "On" if trigger == "software" else "Off"
        except self._error as failure:
            raise DriverError(f"Basler camera {self.serial} refuses: {failure}") from failure
        finally:
            self.settings = self._read_settings(trigger or self.settings.trigger)
        return self.settings

    def start(self) -> None:
        """Begin to acquire."""
        if not self._camera.IsGrabbing():
            self._clock = DeviceClock()
            self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)

    def trigger(self) -> None:
        """Expose once; only with `trigger="software"`."""
        if self.settings.trigger != "software":
            raise DriverError("the camera runs freely: configure(trigger='software') first")
        self._camera.TriggerSoftware.Execute()

    def grab(self, timeout_s: float = 1.0) -> Frame:
        """Return the next frame not yet read; see `Camera.grab`."""
        if not self._camera.IsGrabbing():
            raise DriverError("the camera is not acquiring: start() it first")
        try:
            taken = self._camera.RetrieveResult(
                max(round(timeout_s * 1000), 0), self._pylon.TimeoutHandling_Return
            )
        except self._error as failure:
            raise DeviceLostError(f"Basler camera {self.serial} failed: {failure}") from failure
        received_s = time.monotonic()
        if not taken.IsValid():
            if self._camera.IsCameraDeviceRemoved():
                raise DeviceLostError(f"Basler camera {self.serial} was removed: check its cable")
            raise FrameTimeoutError(f"no frame from Basler camera {self.serial} within {timeout_s:.3g} s")
        try:
            complete = bool(taken.GrabSucceeded())
            pixels = np.array(taken.Array) if complete else np.zeros(self.shape, np.uint8)
            device_s = taken.TimeStamp * self._tick_s if taken.TimeStamp else None
            return Frame(
                pixels=pixels,
                number=int(taken.BlockID),
                time_s=received_s if device_s is None else self._clock.host_s(device_s, received_s),
                received_s=received_s,
                device_time_s=device_s,
                complete=complete,
                origin_yx=self.settings.origin_yx,
            )
        finally:
            taken.Release()

    def stop(self) -> None:
        """Acquire no more."""
        if self._camera.IsGrabbing():
            self._camera.StopGrabbing()

    def close(self) -> None:
        """Give the camera back."""
        try:
            self._camera.Close()
        except self._error:
            return
