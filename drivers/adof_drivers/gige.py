"""GigE Vision cameras, through viva-genicam (extra `gige`)."""

from __future__ import annotations

import math
import socket
import struct
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from adof_drivers.camera import CameraSettings, DeviceClock, Frame, Trigger, require_settings
from adof_drivers.errors import DeviceLostError, DriverError, FrameTimeoutError

_PACKED = {"Mono10p": (4, 5), "Mono10Packed": (2, 3), "Mono12p": (2, 3), "Mono12Packed": (2, 3)}
_GROUPS = {"Mono8": (1, 1), **dict.fromkeys(("Mono10", "Mono12", "Mono14", "Mono16"), (1, 2)), **_PACKED}
"""How many pixels share how many bytes."""
_ASKED = 0.2  # seconds a camera on the same wire gets to answer; they answer within a few ms
_TRIES = 2
_LARGEST_BUFFER = Path("/proc/sys/net/core/rmem_max")
_CLOCK_CONTROL, _CLOCK_VALUE = 0x944, 0x948  # bootstrap registers: 2 latches the clock into 8 bytes
_LATCHES = 5
_LATCHED_EVERY_S = 5.0
_DRIFT = 1e-4  # of one quartz against another


def buffer_advice(frame_bytes: int) -> str | None:
    """Say what to do if the system lets a socket keep less than two frames; else None.

    What comes while this program waits for its turn is kept there, and dropped beyond.
    """
    try:
        largest = int(_LARGEST_BUFFER.read_text(encoding="ascii"))
    except (OSError, ValueError):  # another system
        return None
    if largest >= 2 * frame_bytes:
        return None
    mib = 1 << 20
    wanted = max(4, -(-2 * frame_bytes // mib)) * mib
    return (
        f"the system lets a socket keep {largest} bytes, two frames have {2 * frame_bytes}: frames will be "
        f"lost when the computer is busy; sudo sysctl -w net.core.rmem_max={wanted}"
    )


def answers(address: str, port: int = 3956) -> bool:
    """Whether a GigE Vision device at `address` reads out a register for us, within 0.4 s.

    Anybody may ask, whoever holds control; it tells a camera that sends no frames from one that is gone.
    """
    request = struct.pack(">BBHHHI", 0x42, 1, 0x80, 4, 1, 0xA00)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.settimeout(_ASKED)
        for _ in range(_TRIES):
            try:
                asking.sendto(request, (address, port))
                if asking.recvfrom(64)[0][2:4] == b"\x00\x81":
                    return True
            except OSError:  # no answer in time, or nobody listens there
                continue
    return False


class BlockNumbers:
    """Count on where a camera's 16-bit block numbers go from 65535 to 1; 0 is never used."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._last_block = 0

    def number(self, block: int, *, believed: bool = True) -> int:
        """Return the frame's number, on from the first block seen; below the last one if out of order.

        One that is not `believed`, for the frame is torn, is not counted on from.
        """
        if self._last is None:
            self._last, self._last_block = block, block
            return block
        step = block - self._last_block
        if max(block, self._last_block) <= 0xFFFF:
            step = (step + 0x7FFF) % 0xFFFF - 0x7FFF
        number = self._last + step
        if step > 0 and believed:
            self._last, self._last_block = number, block
        return number


class GigeCamera:
    """A grey GigE Vision camera.

    Parameters
    ----------
    address
        Its IPv4 address.
    interface
        Name or address of the network interface it is on; default: the loopback interface for 127.x.x.x,
        else every interface is searched. Finding a camera broadcasts on the interface.
    packet_size
        Bytes of a network packet; default: the largest that gets through, as tried out.
    serial
        Its serial number, to be sure of which it is: addresses that are given out change places.

    Attributes
    ----------
    model, serial
        As it says; "" if it does not.

    Raises
    ------
    DriverError
        viva-genicam is absent, no camera answers at `address`, another camera does, another program holds
        it, or it is set to a pixel format that is not grey.
    """

    def __init__(
        self,
        address: str,
        *,
        interface: str | None = None,
        packet_size: int | None = None,
        serial: str | None = None,
    ) -> None:
        try:
            import viva_genicam as viva
        except ImportError as failure:
            raise DriverError("GigE Vision needs viva-genicam: pip install 'adof-cl[gige]'") from failure
        self.address = address
        self._interface = interface or ("lo" if address.startswith("127.") else None)
        self._packet_size = packet_size
        self._error = viva.GenicamError
        self._roi = viva.Roi
        self._unpack = viva.Frame.from_bytes
        self._stream: Any = None
        self._acquiring = False
        self._lost = False
        self._silent = False
        found: list[Any] = []
        for timeout_ms in (300, 1500):
            found = viva.discover(timeout_ms, iface=self._interface)
            here = [one for one in found if one.ip == address]
            if here:
                break
        else:
            others = ", ".join(one.ip for one in found) or "none"
            raise DriverError(
                f"no GigE Vision camera answers at {address} (others found: {others}): check its power, "
                "cable and address, and that the firewall lets UDP port 3956 through"
            )
        try:
            self._camera = viva.connect_gige(here[0], iface=self._interface)
        except viva.GenicamError as failure:
            busy = "ACCESS_DENIED" in str(failure)
            raise DriverError(
                f"the camera at {address} cannot be opened ({failure}): "
                + ("another program holds it, close that one" if busy else "switch it off and on")
            ) from failure
        try:
            self.model = f"{here[0].manufacturer} {here[0].model}"
            self.serial = self._read_serial()
            if serial is not None and serial != self.serial:
                raise DriverError(
                    f"at {address} is camera '{self.serial}', '{serial}' was wanted: find out its address"
                )
            self._tick_s = self._read_tick_s()
            self._format = self._camera.get_enum("PixelFormat")
            if self._format not in _GROUPS:
                raise DriverError(
                    f"the camera at {address} sends {self._format}: set it to one of {', '.join(_GROUPS)}"
                )
            self._dtype = np.dtype("u1" if self._format == "Mono8" else "<u2")
            self._sensor = (self._camera.get_integer("SensorHeight"), self._camera.get_integer("SensorWidth"))
            self.settings = self._read_settings("free")
            self._camera.disable_trigger("FrameStart")
        except viva.GenicamError as failure:
            self.close()
            raise DriverError(f"the camera at {address} lacks what was asked of it: {failure}") from failure
        except DriverError:
            self.close()
            raise

    def _read_serial(self) -> str:
        for name in ("DeviceSerialNumber", "DeviceID"):
            try:
                return str(self._camera.get_string(name))
            except self._error:
                continue
        return ""

    def _read_tick_s(self) -> float:
        for name in ("GevTimestampTickFrequency", "TimestampTickFrequency"):
            try:
                return 1 / float(self._camera.get_integer(name))
            except (self._error, ZeroDivisionError):
                continue
        return 1e-9  # GigE Vision 2.1: cameras without that register count nanoseconds

    def _read_settings(self, trigger: Trigger) -> CameraSettings:
        roi = self._camera.roi()
        numbers: list[float | None] = []
        for read in (self._camera.exposure_time, self._camera.frame_rate):
            try:
                numbers.append(float(read()))
            except self._error:
                numbers.append(None)
        exposure_us, rate_hz = numbers
        exposure_s = None if exposure_us is None else exposure_us * 1e-6
        return CameraSettings((roi.y, roi.x), (roi.height, roi.width), exposure_s, rate_hz, trigger)

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

        Parameters
        ----------
        region
            ((row, column) of the first pixel, (rows, columns)).

        Raises
        ------
        DriverError
            The camera is acquiring, or refuses; what was refused here is not sent.
        """
        if self._stream is not None:
            raise DriverError("the camera is acquiring: stop() it before configure()")
        require_settings(self._sensor, region, exposure_s, rate_hz, trigger)
        try:
            if region is not None:
                (y, x), (rows, columns) = region
                self._camera.set_roi(self._roi(x=x, y=y, width=columns, height=rows))
            if exposure_s is not None:
                self._camera.set_exposure_time(exposure_s * 1e6)
            if rate_hz is not None:
                self._camera.set_frame_rate(rate_hz)
            if trigger == "software":
                self._camera.enable_trigger("FrameStart", "Software")
            elif trigger == "free":
                self._camera.disable_trigger("FrameStart")
        except self._error as failure:
            raise DriverError(f"the camera at {self.address} refuses: {failure}") from failure
        finally:
            self.settings = self._read_settings(trigger or self.settings.trigger)
        return self.settings

    def start(self) -> None:
        """Begin to acquire; frames count from 1, or where the camera begins. Warns of a small buffer."""
        if self._stream is not None:
            return
        self._clock, self._numbers = DeviceClock(), BlockNumbers()
        (rows, columns), (pixels, size) = self.shape, _GROUPS[self._format]
        if advice := buffer_advice(rows * columns * size // pixels):
            warnings.warn(advice, stacklevel=2)
        self._ahead_s, self._doubt_s = self._latch_s(_LATCHES)
        self._latched_s = self._asked_s = time.monotonic()
        try:
            self._stream = self._camera.stream(
                iface=self._interface,
                packet_size=self._packet_size,
                auto_packet_size=self._packet_size is None,
                deliver_incomplete=True,
            )
            self._stream.__enter__()
        except self._error as failure:
            self.stop()
            raise self._failed(failure) from failure
        self._acquiring = True

    def _latch_s(self, tries: int) -> tuple[float | None, float]:
        """How far the host's clock is ahead of the camera's, None if it has none to latch; and how far off.

        A question and its answer took the time they took: the moment between them is known to half of it.
        """
        doubt_s, ahead_s = math.inf, None
        for _ in range(tries):
            try:
                sent_s = time.monotonic()
                self._camera.write_register(_CLOCK_CONTROL, b"\0\0\0\2")
                answered_s = time.monotonic()
                ticks = int.from_bytes(self._camera.read_register(_CLOCK_VALUE, 8), "big")
            except self._error:
                return None, math.inf
            if ticks and (answered_s - sent_s) / 2 < doubt_s:
                doubt_s = (answered_s - sent_s) / 2
                ahead_s = (sent_s + answered_s) / 2 - ticks * self._tick_s
        return ahead_s, doubt_s

    def _exposed_s(self, device_s: float, received_s: float) -> float:
        if self._ahead_s is None:
            return self._clock.host_s(device_s, received_s)
        if received_s - self._asked_s > _LATCHED_EVERY_S:
            self._asked_s = received_s
            ahead_s, doubt_s = self._latch_s(1)
            # A slow answer may know less than the last good one, drifting since.
            if ahead_s is not None and doubt_s < self._doubt_s + _DRIFT * (received_s - self._latched_s):
                self._ahead_s, self._doubt_s, self._latched_s = ahead_s, doubt_s, received_s
        return device_s + self._ahead_s

    def trigger(self) -> None:
        """Expose once; only with `trigger="software"`."""
        if self.settings.trigger != "software":
            raise DriverError("the camera runs freely: configure(trigger='software') first")
        try:
            self._camera.trigger_software()
        except self._error as failure:
            raise self._failed(failure) from failure

    def grab(self, timeout_s: float = 1.0) -> Frame:
        """Return the next frame not yet read; see `Camera.grab`.

        Raises
        ------
        FrameTimeoutError
            None in time.
        DeviceLostError
            None in time, again, and the camera does not answer: 0.4 s more.
        """
        if self._stream is None:
            raise DriverError("the camera is not acquiring: start() it first")
        try:
            taken = self._stream.next_frame(max(round(timeout_s * 1000), 0))
        except self._error as failure:
            if "timeout" in str(failure):
                # The first silence is told at once, for whoever must stop; the next one asks the camera.
                if timeout_s > 0 and self._silent:
                    self._require_there()
                self._silent = self._silent or timeout_s > 0
                raise FrameTimeoutError(
                    f"no frame from the camera at {self.address} within {timeout_s:.3g} s"
                ) from None
            raise self._failed(failure) from failure
        received_s = time.monotonic()
        self._silent = False
        if taken is None:
            raise DeviceLostError(f"the stream of the camera at {self.address} has ended: open it again")
        return self._frame(taken, received_s)

    def _frame(self, taken: Any, received_s: float) -> Frame:
        complete = bool(taken.is_complete)
        device_s = None if taken.ts_dev is None else taken.ts_dev * self._tick_s
        return Frame(
            pixels=self._pixels(taken) if complete else np.zeros(self.shape, self._dtype),
            number=self._numbers.number(taken.block_id, believed=complete),
            time_s=received_s if device_s is None or not complete else self._exposed_s(device_s, received_s),
            received_s=received_s,
            device_time_s=device_s,
            complete=complete,
            origin_yx=self.settings.origin_yx,
        )

    def _pixels(self, taken: Any) -> np.ndarray[Any, Any]:
        """The pixels of a whole frame; unless they share bytes, as they lie in the payload, line by line."""
        shape = (taken.height, taken.width)
        if taken.pixel_format != self._format or shape != self.shape:
            raise DriverError(
                f"a frame of {shape} {taken.pixel_format} came from the camera at {self.address}, which was "
                f"set to {self.shape} {self._format}: open it again"
            )
        grouped, size = _GROUPS[self._format]
        if taken.padding_x and taken.width % grouped:
            raise DriverError(
                f"lines of {taken.width} pixels of {self._format} end within a byte and are padded: "
                f"choose a width that is a multiple of {grouped}"
            )
        payload = taken.payload()
        pixels = -(-taken.width * taken.height * size // grouped)
        excess = len(payload) - pixels - taken.padding_x * taken.height
        # The last line may come without its padding, and a payload be rounded up, but not by a line.
        if not -taken.padding_x <= excess < taken.width * size / grouped:
            raise DriverError(
                f"a frame of {len(payload)} bytes came: {taken.height} lines of {taken.width} pixels of "
                f"{self._format}, each padded by {taken.padding_x}, were announced"
            )
        if self._format in _PACKED:
            return self._unpacked(taken, payload, -(-taken.width * taken.height // grouped) * size)
        stride = taken.width * size + taken.padding_x
        return np.ndarray(shape, self._dtype, buffer=payload, strides=(stride, size))

    def _unpacked(self, taken: Any, payload: bytes, groups: int) -> np.ndarray[Any, Any]:
        """Pixels that share bytes, set apart by viva-genicam, which wants the last group whole."""
        whole = groups + taken.padding_x * taken.height
        try:
            unpacked: np.ndarray[Any, Any] = self._unpack(
                payload[:whole].ljust(whole, b"\x00"),
                taken.width,
                taken.height,
                self._format,
                taken.padding_x,
            ).to_numpy()
        except self._error as failure:
            raise DriverError(f"a frame from {self.address} cannot be unpacked: {failure}") from failure
        return unpacked

    def _require_there(self) -> None:
        if not answers(self.address):
            self._lost = True
            raise DeviceLostError(
                f"the camera at {self.address} no longer answers: check cable and power, then open it again"
            )

    def _failed(self, failure: Exception) -> DriverError:
        try:
            self._require_there()
        except DeviceLostError as lost:
            return lost
        return DriverError(f"the camera at {self.address} failed: {failure}")

    def stop(self) -> None:
        """Acquire no more; a camera that is gone is not waited for."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        # To stop a camera that does not answer would take viva-genicam nine seconds of asking.
        if self._acquiring and not self._lost and answers(self.address):
            try:
                stream.__exit__(None, None, None)
            except self._error:
                self._lost = True
        self._acquiring = False
        stream.close()

    def close(self) -> None:
        """Give the camera back to others; may be called twice, never raises."""
        self.stop()
        self._camera.close()
