r"""Bytes to a device and back: TCP, USB bulk, FTDI, serial. One request at a time; a stop waits for none.

    with Link(TcpTransport("192.168.0.20", 50000)) as link:
        link.exchange(b"*IDN?\n", whole=lambda reply: reply.endswith(b"\n"))
        link.interrupt(b"\x18")        # from any thread

A link that missed a reply cannot know to which request the next one belongs. It is broken from then on: every
request is refused until the device is opened anew, only `interrupt` still goes out.
"""

from __future__ import annotations

import itertools
import logging
import select
import socket
import time
from collections.abc import Callable, Sequence
from threading import Lock
from types import TracebackType
from typing import Any, Protocol

from adof_drivers.errors import DriverError, LinkError, ReplyError, ReplyTimeoutError, StoppedError

LONGEST_REPLY = 65536
"""Bytes; HLP? of a large controller is a tenth of it."""


class Transport(Protocol):
    """Bytes out, bytes in."""

    @property
    def name(self) -> str:
        """Where it leads, for messages."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of it or raise `LinkError`. TCP and serial never wait; USB at most 0.1 s."""
        ...

    def read_some(self, timeout_s: float) -> bytes:
        """Return what is there, b"" after the time-out; `LinkError` when the other side is gone."""
        ...

    def close(self) -> None:
        """Let go of it; may be called again."""
        ...


class TcpTransport:
    """A socket that never waits to send: a peer that takes no bytes is an error, not a delay.

    Raises
    ------
    LinkError
        Nobody answers there within `timeout_s`.
    """

    def __init__(self, host: str, port: int, *, timeout_s: float = 2.0) -> None:
        self.name = f"{host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), timeout_s)
        except OSError as failure:
            raise LinkError(
                f"{self.name} does not answer ({failure}): check address, cable and power"
            ) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def write(self, data: bytes) -> None:
        """Send all of it at once."""
        try:
            sent = self._socket.send(data)
        except OSError as failure:
            raise LinkError(f"{self.name} takes no bytes ({failure}): it has to be opened again") from None
        if sent != len(data):
            raise LinkError(f"{self.name} took {sent} of {len(data)} bytes: it has to be opened again")

    def read_some(self, timeout_s: float) -> bytes:
        """Return what is there, b"" after the time-out."""
        try:
            if not select.select([self._socket], [], [], max(timeout_s, 0.0))[0]:
                return b""
            data = self._socket.recv(4096)
        except (OSError, ValueError) as failure:
            raise LinkError(f"{self.name} is gone ({failure}): open it again") from None
        if not data:
            raise LinkError(f"{self.name} closed the connection: check that no other program holds it")
        return data

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class UsbTransport:
    """The first bulk endpoint in each direction of a USB device, by pyusb.

    Parameters
    ----------
    vendor, product
        USB identity; without `product` the vendor's only device.
    serial_number
        Tells devices of one kind apart.
    backend
        pyusb's; tests give an emulated one.

    Raises
    ------
    LinkError
        No libusb, no such device, several of them, no access, or held by another program.
    """

    WRITE_TIMEOUT_MS = 100

    def __init__(
        self,
        vendor: int,
        product: int | None = None,
        *,
        serial_number: str | None = None,
        backend: Any = None,
    ) -> None:
        import usb.core
        import usb.util

        self.name, self._device = _usb_device(vendor, product, serial_number, backend)
        self._gone = usb.core.USBError
        self._late = usb.core.USBTimeoutError
        self._util = usb.util
        try:
            self._device.set_configuration()
            interface = self._device.get_active_configuration()[(0, 0)]
            usb.util.claim_interface(self._device, interface)
        except usb.core.USBError as failure:
            raise LinkError(
                f"{self.name} cannot be claimed ({failure}): another program may hold it"
            ) from None
        bulk = [
            endpoint
            for endpoint in interface
            if usb.util.endpoint_type(endpoint.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK
        ]
        inward = [e for e in bulk if usb.util.endpoint_direction(e.bEndpointAddress) == usb.util.ENDPOINT_IN]
        outward = [
            e for e in bulk if usb.util.endpoint_direction(e.bEndpointAddress) == usb.util.ENDPOINT_OUT
        ]
        if not (inward and outward):
            self.close()
            raise LinkError(f"{self.name} has no pair of bulk endpoints: it is another kind of device")
        self._in, self._out = inward[0], outward[0]

    def write(self, data: bytes) -> None:
        """Send all of it at once."""
        try:
            sent = self._out.write(data, self.WRITE_TIMEOUT_MS)
        except self._gone as failure:
            raise LinkError(f"{self.name} takes no bytes ({failure}): it has to be opened again") from None
        if sent != len(data):
            raise LinkError(f"{self.name} took {sent} of {len(data)} bytes: it has to be opened again")

    def read_some(self, timeout_s: float) -> bytes:
        """Return one packet, b"" after the time-out; libusb counts in whole milliseconds, 0 is for ever."""
        try:
            return bytes(self._in.read(self._in.wMaxPacketSize, max(1, round(timeout_s * 1000))))
        except self._late:
            return b""
        except self._gone as failure:
            raise LinkError(f"{self.name} is gone ({failure}): open it again") from None

    def close(self) -> None:
        """Release the device."""
        self._util.dispose_resources(self._device)


class FtdiTransport:
    """A UART behind an FTDI bridge, by pyftdi (extra `ftdi`): two bytes of status go before every packet.

    The bridge keeps what is short of a packet for 1 ms; as delivered, for 16 ms.

    Parameters
    ----------
    vendor, product, serial_number, backend
        As for `UsbTransport`; any FTDI identity, and those that vendors gave their own.

    Raises
    ------
    LinkError
        pyftdi is missing, or as for `UsbTransport`.
    """

    LATENCY_MS = 1
    WRITE_TIMEOUT_MS = 100
    READ_TIMEOUT_MS = 100

    def __init__(
        self,
        vendor: int,
        product: int | None = None,
        *,
        baud: int = 115200,
        serial_number: str | None = None,
        backend: Any = None,
    ) -> None:
        try:
            from pyftdi.ftdi import Ftdi, FtdiError
        except ImportError:
            raise LinkError("pyftdi is not installed: pip install 'adof-cl[ftdi]'") from None
        import usb.core
        import usb.util

        self.name, self._device = _usb_device(vendor, product, serial_number, backend)
        self.name = f"FTDI {self.name}"
        self._failures = (FtdiError, usb.core.USBError)
        self._util = usb.util
        self._bridge = Ftdi()
        try:
            self._device.set_configuration()
            usb.util.claim_interface(self._device, 0)
            self._bridge.open_from_device(self._device)
            self._bridge.timeouts = (self.READ_TIMEOUT_MS, self.WRITE_TIMEOUT_MS)
            self._bridge.set_baudrate(baud)
            self._bridge.set_line_property(8, 1, "N")
            self._bridge.set_flowctrl("")
            self._bridge.set_latency_timer(self.LATENCY_MS)
        except (*self._failures, ValueError) as failure:
            self._util.dispose_resources(self._device)
            raise LinkError(
                f"{self.name} cannot be claimed as a bridge at {baud} baud ({failure}): another program may "
                "hold it, or it is none"
            ) from None

    def write(self, data: bytes) -> None:
        """Send all of it at once."""
        try:
            self._bridge.write_data(data)
        except self._failures as failure:
            raise LinkError(f"{self.name} takes no bytes ({failure}): it has to be opened again") from None

    def read_some(self, timeout_s: float) -> bytes:
        """Return what is there, b"" after the time-out."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                # A packet of status alone comes each time the latency is over.
                data = bytes(self._bridge.read_data(4096))
            except self._failures as failure:
                raise LinkError(f"{self.name} is gone ({failure}): open it again") from None
            if data or time.monotonic() >= deadline:
                return data

    def close(self) -> None:
        """Release the device; may be called again."""
        logging.getLogger("pyftdi.ftdi").addFilter(lambda _record: False)  # it may be gone, which was said
        self._bridge.close()
        self._util.dispose_resources(self._device)


def _usb_device(vendor: int, product: int | None, serial_number: str | None, backend: Any) -> tuple[str, Any]:
    """Find the one device that is meant, take it from the kernel's driver, and return its name and itself.

    Raises
    ------
    LinkError
        No libusb, no such device, several of them, or no access.
    """
    import usb.core

    name = f"USB {vendor:04x}:{'*' if product is None else f'{product:04x}'}"
    wanted = {"idVendor": vendor} | ({} if product is None else {"idProduct": product})
    try:
        found = list(usb.core.find(find_all=True, backend=backend, **wanted) or ())
        if serial_number is not None:
            found = [device for device in found if device.serial_number == serial_number]
    except usb.core.NoBackendError:
        raise LinkError("libusb is not installed: USB devices cannot be opened without it") from None
    except (usb.core.USBError, ValueError) as failure:
        raise LinkError(f"{name} cannot be read ({failure}): check its access rights") from None
    if len(found) != 1:
        raise LinkError(
            f"{len(found)} devices are {name}"
            + (f" with serial number {serial_number}" if serial_number else "")
            + ": one was wanted, so check cable and power, or give a serial number"
        )
    try:
        if found[0].is_kernel_driver_active(0):
            found[0].detach_kernel_driver(0)
    except (NotImplementedError, usb.core.USBError):
        pass  # no kernel driver to speak of; claiming says whether that matters
    return name, found[0]


class SerialTransport:
    """A serial port, by pyserial (extra `serial`).

    Raises
    ------
    LinkError
        pyserial is missing, or the port is not there, not ours, or in use.
    """

    def __init__(self, port: str, *, baud: int = 115200) -> None:
        try:
            import serial
        except ImportError:
            raise LinkError("pyserial is not installed: pip install 'adof-cl[serial]'") from None
        self.name = port
        try:
            self._port = serial.Serial(port, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError) as failure:
            raise LinkError(
                f"{port} cannot be opened ({failure}): check cable, rights, other programs"
            ) from None
        self._failures = (OSError, TypeError)  # pyserial reads None after a close in another thread

    def write(self, data: bytes) -> None:
        """Send all of it at once."""
        try:
            sent = self._port.write(data)
        except self._failures as failure:
            raise LinkError(f"{self.name} takes no bytes ({failure}): it has to be opened again") from None
        if sent != len(data):
            raise LinkError(f"{self.name} took {sent} of {len(data)} bytes: it has to be opened again")

    def read_some(self, timeout_s: float) -> bytes:
        """Return what is there, b"" after the time-out."""
        try:
            if not select.select([self._port], [], [], max(timeout_s, 0.0))[0]:
                return b""
            return bytes(self._port.read(4096))
        except (*self._failures, ValueError) as failure:
            raise LinkError(f"{self.name} is gone ({failure}): open it again") from None

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class Link:
    """Requests and their replies over a transport, in step.

    Parameters
    ----------
    timeout_s
        Longest wait for a whole reply.
    """

    def __init__(self, transport: Transport, *, timeout_s: float = 1.0) -> None:
        self.transport = transport
        self.timeout_s = timeout_s
        self._turn = Lock()
        self._broken: str | None = None
        self._count = itertools.count(1)
        self._interrupts = 0
        self._interrupt = b""

    @property
    def interrupts(self) -> int:
        """How often `interrupt` was called: a command that began at a smaller number must not move."""
        return self._interrupts

    @property
    def broken(self) -> str | None:
        """Why requests are refused; None while they are not."""
        return self._broken

    def interrupt(self, data: bytes) -> None:
        """Send at once, whatever reply is pending, from any thread; takes no lock."""
        self._interrupt = data
        self._interrupts = next(self._count)  # before sending: who sends later sees it
        self.transport.write(data)

    def exchange(
        self,
        request: bytes,
        whole: Callable[[bytes], bool],
        *,
        since: int | None = None,
        first: Sequence[bytes] = (),
        timeout_s: float | None = None,
    ) -> bytes:
        """Send a request and return its reply, every byte of it.

        Parameters
        ----------
        first
            Commands without a reply that go before it, each by itself.
        whole
            Whether the bytes so far are a whole reply.
        since
            For requests that move: the value of `interrupts` when the command began. An interrupt since then
            refuses the request; one that comes while it is sent is sent again behind it.
        timeout_s
            For requests that take longer than the link's.

        Raises
        ------
        StoppedError
            Interrupted before it was sent; nothing was.
        ReplyTimeoutError, ReplyError, LinkError
            No whole reply, too long a one, bytes nobody asked for, or no connection; the link is broken.
        """
        with self._turn:
            if self._broken is not None:
                raise LinkError(f"{self.transport.name} is out of step: {self._broken}; open it again")
            if since is not None and self._interrupts != since:
                raise StoppedError(f"{self.transport.name} was stopped meanwhile: nothing was sent")
            try:
                return self._exchange(
                    (*first, request), whole, since, self.timeout_s if timeout_s is None else timeout_s
                )
            except DriverError as failure:
                self._broken = str(failure)
                raise

    def _exchange(
        self, requests: Sequence[bytes], whole: Callable[[bytes], bool], since: int | None, timeout_s: float
    ) -> bytes:
        if not isinstance(self.transport, UsbTransport) and (stray := self.transport.read_some(0.0)):
            raise ReplyError(
                f"{self.transport.name} sent {stray[:40]!r} unasked: its replies are out of step"
            )
        for request in requests:
            self.transport.write(request)
        if since is not None and self._interrupts != since:
            self.transport.write(self._interrupt)
        deadline = time.monotonic() + timeout_s
        reply = b""
        while not whole(reply):
            left_s = deadline - time.monotonic()
            piece = self.transport.read_some(max(left_s, 0.0))
            reply += piece
            if left_s <= 0 and not piece:  # asked once more, after the time: the late one may be this program
                raise ReplyTimeoutError(
                    f"{self.transport.name} gave {reply[-40:]!r} to {requests[-1][:60]!r} and no more within "
                    f"{timeout_s:g} s: check cable and power"
                )
            if len(reply) > LONGEST_REPLY:
                raise ReplyError(f"{self.transport.name} does not end its reply to {requests[-1][:60]!r}")
        return reply

    def discard(self, *, quiet_s: float = 0.02, limit_s: float = 0.5) -> None:
        """Throw away what an earlier program left unread, until nothing comes for `quiet_s`.

        Raises
        ------
        ReplyError
            It never ends.
        """
        deadline = time.monotonic() + limit_s
        while self.transport.read_some(quiet_s):
            if time.monotonic() > deadline:
                raise ReplyError(f"{self.transport.name} sends without being asked: it is another device")

    def refuse(self, failure: ReplyError) -> ReplyError:
        """Break the link over a reply that made no sense, and return the error to raise."""
        self._broken = str(failure)
        return failure

    def close(self) -> None:
        """Refuse further requests and close the transport; may be called again."""
        self._broken = self._broken or "it was closed"
        self.transport.close()

    def __enter__(self) -> Link:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
