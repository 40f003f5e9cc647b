"""A pyusb backend with one emulated device: descriptors, two bulk endpoints, packets, exclusive claim.

`FtdiBus` has the engine behind an FTDI bridge, as PI's serial controllers are on USB.
"""

from __future__ import annotations

import errno
import threading
import time
from array import array
from collections import deque
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from adof_drivers.emulators.engine import Disconnected, Engine


class UsbBus(usb.backend.IBackend):  # type: ignore[misc]  # pyusb has no types
    """One device.

    Parameters
    ----------
    vendor, product
        Its identity.
    endpoint_in, endpoint_out
        Addresses of its bulk endpoints.
    packet
        Largest packet; longer replies come in pieces.
    """

    release = 0x0100
    """What the descriptor says of the device's version."""

    def __init__(
        self,
        engine: Engine,
        vendor: int,
        product: int,
        *,
        endpoint_in: int = 0x81,
        endpoint_out: int = 0x02,
        packet: int = 64,
    ) -> None:
        self.engine = engine
        self.identity = (vendor, product)
        self.endpoints = (endpoint_in, endpoint_out)
        self.packet = packet
        self.plugged = True
        self._claimed_by: object | None = None
        self._news = threading.Condition()
        self._held: deque[tuple[float, bytes]] = deque()

    def enumerate_devices(self) -> list[str]:
        """One device, while it is plugged."""
        return ["device"] if self.plugged else []

    def get_device_descriptor(self, _device: object) -> Any:
        """Descriptor of the device."""
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=self.identity[0], idProduct=self.identity[1], bcdDevice=self.release,
            iManufacturer=0, iProduct=0, iSerialNumber=0, bNumConfigurations=1, address=1, bus=1,
            port_number=1, port_numbers=(1,), speed=3,
        )  # fmt: skip

    def get_configuration_descriptor(self, _device: object, config: int) -> Any:
        """Descriptor of its one configuration."""
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, _device: object, interface: int, alternate: int, _config: int) -> Any:
        """Descriptor of its one interface."""
        if interface or alternate:
            raise IndexError(interface)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=2,
            bInterfaceClass=0xFF, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0,
            extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, _device: object, number: int, *_place: int) -> Any:
        """Descriptor of a bulk endpoint."""
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=self.endpoints[number], bmAttributes=2,
            wMaxPacketSize=self.packet, bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, _device: object) -> object:
        """Give a handle."""
        return object()

    def close_device(self, handle: object) -> None:
        """Take it back."""
        if self._claimed_by is handle:
            self._claimed_by = None

    def set_configuration(self, _handle: object, _value: int) -> None:
        """It has one only."""

    def get_configuration(self, _handle: object) -> int:
        """Its only one."""
        return 1

    def claim_interface(self, handle: object, _interface: int) -> None:
        """Give it to one program only."""
        if self._claimed_by not in (None, handle):
            raise usb.core.USBError("Resource busy", errno=errno.EBUSY)
        self._claimed_by = handle

    def release_interface(self, _handle: object, _interface: int) -> None:
        """Give it back."""
        self._claimed_by = None
        self.engine.disconnected()

    def is_kernel_driver_active(self, _handle: object, _interface: int) -> bool:
        """No kernel, no driver."""
        return False

    def bulk_write(self, _handle: object, _endpoint: int, _interface: int, data: Any, _timeout: int) -> int:
        """Carry bytes to the device."""
        self._require_plugged()
        with self._news:
            try:
                for reply in self.engine.feed(bytes(data)):
                    self._held.append((time.monotonic() + reply.delay_s, reply.data))
            except Disconnected:
                self.plugged = False
            self._news.notify_all()
        return len(data)

    def bulk_read(
        self, _handle: object, _endpoint: int, _interface: int, buffer: array[int], timeout: int
    ) -> int:
        """Carry one packet from the device, or time out."""
        piece = self._take(min(len(buffer), self.packet), timeout / 1000)
        if not piece:
            raise usb.core.USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)
        buffer[: len(piece)] = array("B", piece)
        return len(piece)

    def _take(self, size: int, timeout_s: float) -> bytes:
        """Take what is due of the next reply, b"" when the time is over."""
        deadline_s = time.monotonic() + timeout_s
        with self._news:
            while True:
                self._require_plugged()
                now_s = time.monotonic()
                if self._held and self._held[0][0] <= now_s:
                    break
                if now_s >= deadline_s:
                    return b""
                self._news.wait(min(self._held[0][0] if self._held else deadline_s, deadline_s) - now_s)
            due_s, data = self._held.popleft()
            if rest := data[size:]:
                self._held.appendleft((due_s, rest))
            return data[:size]

    def _require_plugged(self) -> None:
        if not self.plugged:
            raise usb.core.USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)


class FtdiBus(UsbBus):
    """The engine behind an FT232R: modem and line status go before every packet, and come alone when idle.

    Attributes
    ----------
    latency_ms
        How long a packet short of full is kept.
    baud_divisor
        As the bridge was told; None before.
    """

    release = 0x0600
    _STATUS = b"\x01\x60"
    """Nothing is wrong, and all was sent."""
    _SET_BAUD, _SET_LATENCY = 0x03, 0x09
    _OUT = 0x40

    latency_ms = 16
    baud_divisor: int | None = None

    def ctrl_transfer(
        self, _handle: object, kind: int, request: int, value: int, _index: int, data: Any, _timeout: int
    ) -> int:
        """Take a setting."""
        self._require_plugged()
        if kind != self._OUT:
            raise usb.core.USBError("Pipe error", errno=errno.EPIPE)
        if request == self._SET_LATENCY:
            self.latency_ms = value
        elif request == self._SET_BAUD:
            self.baud_divisor = value
        return len(data)

    def bulk_read(
        self, _handle: object, _endpoint: int, _interface: int, buffer: array[int], timeout: int
    ) -> int:
        """Carry one packet from the bridge: status, and what the device has sent."""
        piece = self._STATUS + self._take(self.packet - 2, min(timeout, self.latency_ms) / 1000)
        buffer[: len(piece)] = array("B", piece)
        return len(piece)
