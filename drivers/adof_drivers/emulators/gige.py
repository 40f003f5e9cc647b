"""A GigE Vision camera on UDP: GVCP control with its heartbeat, GVSP stream with resends, seeded faults.

It serves whatever pictures its source makes, so a client written elsewhere sees real frames through a real
protocol. Pure Python: one thread for control, one for the stream.

Source
------
GigE Vision 2.0: bootstrap registers, GVCP and GVSP packet layouts; GenICam SFNC for the names of features.
"""

from __future__ import annotations

import math
import select
import socket
import struct
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_drivers.emulators.gige_features import (
    EXPOSURE_US,
    FRAME_RATE_HZ,
    HEIGHT,
    LINE_PADDING,
    OFFSET_X,
    OFFSET_Y,
    PAYLOAD_SIZE,
    PIXEL_FORMAT,
    PIXEL_FORMATS,
    SENSOR_HEIGHT,
    SENSOR_WIDTH,
    START,
    STOP,
    TRIGGER_MODE,
    TRIGGER_SOFTWARE,
    WIDTH,
    XML_ADDRESS,
    description,
)
from adof_drivers.errors import DriverError

PORT = 3956

_DISCOVERY, _RESEND, _READ_REGISTER, _WRITE_REGISTER, _READ_MEMORY, _WRITE_MEMORY = (
    0x02,
    0x40,
    0x80,
    0x82,
    0x84,
    0x86,
)
_NOT_IMPLEMENTED, _INVALID_PARAMETER, _INVALID_ADDRESS, _ACCESS_DENIED, _PACKET_UNAVAILABLE = (
    0x8001,
    0x8002,
    0x8003,
    0x8006,
    0x800C,
)
_IDENTITY_SIZE = 0xF8
_HEARTBEAT_MS, _TICKS_HIGH, _TICKS_LOW, _CLOCK_CONTROL, _CLOCK_HIGH, _CLOCK_LOW = (
    0x938,
    0x93C,
    0x940,
    0x944,
    0x948,
    0x94C,
)
_PRIVILEGE, _STREAM_PORT, _PACKET_SIZE, _PACKET_DELAY, _STREAM_ADDRESS = 0xA00, 0xD00, 0xD04, 0xD08, 0xD18
_MEMORY_SIZE = XML_ADDRESS + 0x8000
_WRITABLE = {
    _HEARTBEAT_MS,
    _CLOCK_CONTROL,
    _PRIVILEGE,
    _STREAM_PORT,
    _PACKET_SIZE,
    _PACKET_DELAY,
    _STREAM_ADDRESS,
    WIDTH,
    HEIGHT,
    OFFSET_X,
    OFFSET_Y,
    EXPOSURE_US,
    FRAME_RATE_HZ,
    START,
    STOP,
    TRIGGER_MODE,
    TRIGGER_SOFTWARE,
}
_TICKS_HZ = 1_000_000_000
_IP_UDP_GVSP_BYTES = 36  # what GevSCPSPacketSize counts besides pixels
_KEPT_FRAMES = 8  # for packets asked for again
_LEADER, _TRAILER, _PAYLOAD = 1, 2, 3

Region = tuple[tuple[int, int], tuple[int, int]]
Source = Callable[[int, Region], NDArray[Any]]
"""Make exposure `number` of a region ((row, column) of its first pixel, (rows, columns)) of the sensor."""


@dataclass(frozen=True)
class Faults:
    """What goes wrong, drawn from `seed` for each frame: the same seed, the same faults.

    Attributes
    ----------
    seed
        Of every draw.
    packet_loss
        Share of payload packets that are not sent the first time; resends are always sent.
    frame_loss
        Share of frames of which nothing is sent, though they are counted.
    swapped
        Share of frames sent after the one that follows them.
    garbled
        Share of packets, replies and frames' alike, that are malformed: cut, lengthened, their fields
        changed; pixels are not, for nothing could tell.
    delay_s
        Frames are late by up to this.
    freeze_at, stall_at, disconnect_at
        From this exposure on: the same picture again and again; no frames, control goes on; no answer at all.
    """

    seed: int = 0
    packet_loss: float = 0.0
    frame_loss: float = 0.0
    swapped: float = 0.0
    garbled: float = 0.0
    delay_s: float = 0.0
    freeze_at: int | None = None
    stall_at: int | None = None
    disconnect_at: int | None = None

    def __post_init__(self) -> None:
        for name in ("packet_loss", "frame_loss", "swapped", "garbled"):
            share = getattr(self, name)
            if not 0 <= share <= 1:
                raise DriverError(f"{name} is {share}: a share from 0 to 1 was wanted")
        if not 0 <= self.delay_s < math.inf:
            raise DriverError(f"delay_s is {self.delay_s}: 0 or more seconds were wanted")

    def draw(self, number: int) -> np.random.Generator:
        """Return the generator of exposure `number`."""
        return np.random.default_rng([self.seed, number])


def _garble(packet: bytes, fields: int, draw: np.random.Generator) -> bytes:
    """Cut a packet, lengthen it, or change some of its first `fields` bytes."""
    kind = draw.integers(4)
    if kind == 0:
        return packet[: int(draw.integers(len(packet)))]
    if kind == 1:
        return packet + draw.bytes(int(draw.integers(1, 64)))
    changed = bytearray(packet)
    for place in draw.integers(min(fields, len(packet)), size=int(draw.integers(1, 5))):
        changed[place] = draw.integers(256)
    return bytes(changed)


def _reached(limit: int | None, number: int) -> bool:
    return limit is not None and number >= limit


class TriggerLine:
    """One wire that triggers several cameras: at each pulse all of them expose, so that they keep step.

    While one is still busy with its last exposure the pulse waits, for whole periods of the cameras' rate.
    """

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._seen: dict[object, int] = {}  # by camera, the last pulse it exposed at
        self._ready: set[object] = set()
        self._period_s = 0.0
        self._pulses = 0
        self.moment_s = 0.0

    def leave(self, camera: object) -> None:
        """Wait for this camera no longer: it does not acquire."""
        with self._condition:
            self._seen.pop(camera, None)
            self._ready.discard(camera)
            self._pulse()

    def wait(self, camera: object, period_s: float, timeout_s: float) -> float | None:
        """Be ready for a pulse; return its moment, which may lie ahead, or None after the time-out."""
        with self._condition:
            seen = self._seen.setdefault(camera, self._pulses)
            if seen == self._pulses:
                self._period_s = period_s
                self._ready.add(camera)
                self._pulse()
            if not self._condition.wait_for(lambda: self._pulses != seen, timeout_s):
                return None
            self._seen[camera] = self._pulses
            return self.moment_s

    def _pulse(self) -> None:
        if self._ready and self._ready == self._seen.keys():
            self.moment_s = _next_moment_s(self.moment_s, self._period_s)
            self._ready.clear()
            self._pulses += 1
            self._condition.notify_all()


def _next_moment_s(last_s: float, period_s: float) -> float:
    """When to expose next: free-running cameras of one rate keep step, as if one clock triggered them.

    A moment may begin late by up to a period; later ones are not made up for.
    """
    return period_s * max(round(last_s / period_s) + 1, math.floor(time.monotonic() / period_s))


@dataclass(frozen=True)
class _Block:
    """A frame cut into packets, kept for those who ask again."""

    number: int
    packets: tuple[bytes, ...]


class GigeCameraEmulator:
    """A camera at `address`, port 3956, from `start()` to `close()`; also a context.

    Parameters
    ----------
    source
        Makes the pictures: uint8 for Mono8, uint16 for all else.
    sensor
        Rows and columns.
    address
        Where it listens; each camera needs one of its own. Keep to 127.0.0.0/8 unless others shall see it.
    siblings
        Addresses of other emulators that this one names when asked who is there: clients ask 127.0.0.1 alone.
    pixel_format
        One of `gige_features.PIXEL_FORMATS`; pixels of packed ones follow each other bit for bit, over the
        ends of lines.
    rate_hz, exposure_us
        As switched on; clients may change them.
    line_padding
        Bytes after each line, as cameras send that align their lines.
    faults
        What goes wrong.
    line
        Triggers it instead of its own clock; the rate is still its own.

    Attributes
    ----------
    sent, resent
        Frames handed to the network, packets sent again.

    Raises
    ------
    DriverError
        The address cannot be had, an unknown pixel format, line padding with a packed one, or a picture of
        another size, type or depth than promised.
    """

    def __init__(
        self,
        source: Source,
        sensor: tuple[int, int],
        *,
        address: str = "127.0.0.1",
        siblings: Sequence[str] = (),
        pixel_format: str = "Mono8",
        rate_hz: float = 60.0,
        exposure_us: float = 5000.0,
        line_padding: int = 0,
        faults: Faults | None = None,
        line: TriggerLine | None = None,
    ) -> None:
        if not 0 < rate_hz < math.inf:
            raise DriverError(f"rate_hz is {rate_hz}: a rate above 0 was wanted")
        if min(sensor) < 1:
            raise DriverError(f"sensor is {sensor}: (rows, columns) of 1 or more were wanted")
        if pixel_format not in PIXEL_FORMATS:
            raise DriverError(
                f"pixel_format is '{pixel_format}': one of {', '.join(PIXEL_FORMATS)} was wanted"
            )
        code, self._depth = PIXEL_FORMATS[pixel_format]
        self._bits = code >> 16 & 0xFF
        if line_padding and self._bits % 8:
            raise DriverError(f"line_padding is {line_padding}: lines of {pixel_format} do not end on a byte")
        self._source = source
        self._pixel_format = pixel_format
        self._dtype = np.dtype(np.uint8 if self._depth == 8 else np.uint16)
        self.address = address
        self.sent = 0
        self.resent = 0
        self.failure: BaseException | None = None
        self._siblings = tuple(siblings)
        self._faults = faults or Faults()
        self._line = line
        self._memory = _memory(address, sensor, pixel_format, rate_hz, exposure_us, line_padding)
        self._controller: tuple[str, int] | None = None
        self._heard_s = 0.0
        self._acquiring = threading.Event()
        self._triggered = threading.Semaphore(0)
        self._closing = threading.Event()
        self._kept: OrderedDict[int, _Block] = OrderedDict()
        self._kept_lock = threading.Lock()
        self._exposures = 0
        self._replies = self._faults.draw(-1 % (1 << 32))
        self._lost = False
        self._threads: list[threading.Thread] = []
        self._control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._control.bind((address, PORT))
            self._stream.bind((address, 0))
        except OSError as failure:
            self._control.close()
            self._stream.close()
            raise DriverError(
                f"{address}:{PORT} cannot be had ({failure}): another camera emulator runs there, end it or "
                "give this one another address"
            ) from failure
        self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 << 20)

    def start(self) -> GigeCameraEmulator:
        """Answer from now on; frames come when a client starts the acquisition."""
        for work in (self._serve_control, self._serve_frames):
            self._threads.append(threading.Thread(target=self._guarded, args=(work,), daemon=True))
            self._threads[-1].start()
        return self

    def close(self) -> None:
        """Switch the camera off; what a source raised meanwhile is raised here."""
        self._closing.set()
        self._acquiring.set()
        for thread in self._threads:
            thread.join()
        self._control.close()
        self._stream.close()
        if self.failure is not None:
            raise self.failure

    def __enter__(self) -> GigeCameraEmulator:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def unplug(self) -> None:
        """Answer nothing and send nothing from now on, as when the cable is drawn."""
        self._lost = True

    @property
    def controlled(self) -> bool:
        """Whether a client holds control."""
        return self._controller is not None

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as failure:  # noqa: BLE001  (raised again by close)
            self.failure = failure
            self._lost = True

    # Control

    def _get(self, address: int) -> int:
        return int.from_bytes(self._memory[address : address + 4], "big")

    def _set(self, address: int, value: int) -> None:
        self._memory[address : address + 4] = value.to_bytes(4, "big")

    def _get_float(self, address: int) -> float:
        return float(struct.unpack_from(">f", self._memory, address)[0])

    def _serve_control(self) -> None:
        while not self._closing.is_set():
            ready, _, _ = select.select([self._control], [], [], 0.02)
            silent_s = time.monotonic() - self._heard_s
            if self._controller is not None and silent_s > self._get(_HEARTBEAT_MS) / 1000:
                self._release()
            if not ready:
                continue
            packet, peer = self._control.recvfrom(2048)
            if self._lost or len(packet) < 8 or packet[0] != 0x42:
                continue
            flags, command, length, request = struct.unpack(">xBHHH", packet[:8])
            self._obey(command, packet[8 : 8 + length], request, peer, answer=bool(flags & 1))

    def _obey(self, command: int, body: bytes, request: int, peer: tuple[str, int], *, answer: bool) -> None:
        if command == _DISCOVERY:
            for address in (self.address, *self._siblings):
                identity = bytes(_identity(address))
                self._reply(struct.pack(">HHHH", 0, 3, len(identity), request) + identity, peer)
            return
        if peer == self._controller:
            self._heard_s = time.monotonic()
        if command == _RESEND:
            self._resend(body)
            return
        handler = {
            _READ_REGISTER: self._read_registers,
            _WRITE_REGISTER: self._write_registers,
            _READ_MEMORY: self._read_memory,
            _WRITE_MEMORY: self._write_memory,
        }.get(command)
        status, reply = handler(body, peer) if handler else (_NOT_IMPLEMENTED, b"")
        if answer:
            self._reply(struct.pack(">HHHH", status, command + 1, len(reply), request) + reply, peer)

    def _reply(self, packet: bytes, peer: tuple[str, int]) -> None:
        if self._replies.random() < self._faults.garbled:
            packet = _garble(packet, 8, self._replies)
        self._control.sendto(packet, peer)

    def _read_registers(self, body: bytes, _peer: tuple[str, int]) -> tuple[int, bytes]:
        reply = b""
        for (address,) in struct.iter_unpack(">I", body[: len(body) // 4 * 4]):
            if address % 4 or address + 4 > _MEMORY_SIZE:
                return _INVALID_ADDRESS, reply
            reply += self._memory[address : address + 4]
        return 0, reply

    def _read_memory(self, body: bytes, _peer: tuple[str, int]) -> tuple[int, bytes]:
        if len(body) != 8:
            return _INVALID_PARAMETER, b""
        address, count = struct.unpack(">IxxH", body)
        if address % 4 or count % 4 or address + count > _MEMORY_SIZE:
            return _INVALID_ADDRESS, b""
        return 0, body[:4] + bytes(self._memory[address : address + count])

    def _write_registers(self, body: bytes, peer: tuple[str, int]) -> tuple[int, bytes]:
        written = 0
        for address, value in struct.iter_unpack(">II", body[: len(body) // 8 * 8]):
            status = self._write(address, value, peer)
            if status:
                return status, struct.pack(">HH", 0, written)
            written += 1
        return 0, struct.pack(">HH", 0, written)

    def _write_memory(self, body: bytes, peer: tuple[str, int]) -> tuple[int, bytes]:
        if len(body) < 8 or len(body) % 4:
            return _INVALID_PARAMETER, b""
        (first,) = struct.unpack(">I", body[:4])
        for index, (value,) in enumerate(struct.iter_unpack(">I", body[4:])):
            status = self._write(first + 4 * index, value, peer)
            if status:
                return status, struct.pack(">HH", 0, 4 * index)
        return 0, struct.pack(">HH", 0, len(body) - 4)

    def _write(self, address: int, value: int, peer: tuple[str, int]) -> int:
        if address not in _WRITABLE:
            return _INVALID_ADDRESS if address + 4 > _MEMORY_SIZE else _ACCESS_DENIED
        if self._controller not in (None, peer):
            return _ACCESS_DENIED
        if address == _PRIVILEGE:
            if value & 3:
                self._controller, self._heard_s = peer, time.monotonic()
                self._set(_PRIVILEGE, value)
            else:
                self._release()
            return 0
        if self._controller is None:
            return _ACCESS_DENIED
        return self._act(address, value)

    def _act(self, address: int, value: int) -> int:
        if address in (WIDTH, HEIGHT, OFFSET_X, OFFSET_Y):
            return self._set_region(address, value)
        if address == _CLOCK_CONTROL:
            if value & 2:  # latch
                ticks = self._ticks()
                self._set(_CLOCK_HIGH, ticks >> 32)
                self._set(_CLOCK_LOW, ticks & 0xFFFFFFFF)
            return 0
        if address == START:
            while self._triggered.acquire(blocking=False):
                pass  # what was triggered before is not exposed now
            with self._kept_lock:
                self._kept.clear()
            self._acquiring.set()
            return 0
        if address == STOP:
            self._acquiring.clear()
            return 0
        if address == TRIGGER_SOFTWARE:
            self._triggered.release()
            return 0
        if address in (EXPOSURE_US, FRAME_RATE_HZ):
            (number,) = struct.unpack(">f", value.to_bytes(4, "big"))
            if not 0 < number < math.inf:
                return _INVALID_PARAMETER
        if address == _PACKET_SIZE:
            value &= 0xC000FFFF
            if (value & 0xFFFF) <= _IP_UDP_GVSP_BYTES + 8:
                return _INVALID_PARAMETER
            if value & 0x80000000:  # a test packet, to see whether this size gets through
                self._set(_PACKET_SIZE, value & 0x4000FFFF)
                self._send(bytes((value & 0xFFFF) - 28))
                return 0
        self._set(address, value)
        return 0

    def _set_region(self, address: int, value: int) -> int:
        wanted = {a: self._get(a) for a in (WIDTH, HEIGHT, OFFSET_X, OFFSET_Y)} | {address: value}
        if (
            wanted[WIDTH] < 1
            or wanted[HEIGHT] < 1
            or wanted[OFFSET_X] + wanted[WIDTH] > self._get(SENSOR_WIDTH)
            or wanted[OFFSET_Y] + wanted[HEIGHT] > self._get(SENSOR_HEIGHT)
        ):
            return _INVALID_PARAMETER
        if self._acquiring.is_set():
            return _ACCESS_DENIED
        self._set(address, value)
        shape = (wanted[HEIGHT], wanted[WIDTH])
        self._set(PAYLOAD_SIZE, _payload_bytes(shape, self._bits, self._get(LINE_PADDING)))
        return 0

    def _release(self) -> None:
        self._controller = None
        self._set(_PRIVILEGE, 0)
        self._acquiring.clear()

    # Stream

    @staticmethod
    def _ticks() -> int:
        return time.monotonic_ns()

    def _send(self, packet: bytes) -> None:
        address = socket.inet_ntoa(self._memory[_STREAM_ADDRESS : _STREAM_ADDRESS + 4])
        port = self._get(_STREAM_PORT) & 0xFFFF
        if port and not self._lost:
            self._stream.sendto(packet, (address, port))

    def _serve_frames(self) -> None:
        begun_s = time.monotonic()
        block = 0
        held: _Block | None = None
        frozen: NDArray[Any] | None = None
        while not self._closing.is_set():
            if not self._acquiring.is_set():
                block, held, begun_s = 0, None, time.monotonic()
                if self._line is not None:
                    self._line.leave(self)
                self._acquiring.wait(0.05)
                continue
            if self._get(TRIGGER_MODE):
                if not self._triggered.acquire(timeout=0.02):
                    continue
                begun_s = time.monotonic()
            else:
                period_s = 1 / self._get_float(FRAME_RATE_HZ)
                if self._line is None:
                    begun_s = _next_moment_s(begun_s, period_s)
                else:
                    moment_s = self._line.wait(self, period_s, 0.05)
                    if moment_s is None:
                        continue
                    begun_s = moment_s
                left_s = begun_s - time.monotonic()
                if left_s > 0 and self._closing.wait(left_s):
                    return
                if not self._acquiring.is_set():
                    continue
            ticks = round(begun_s * _TICKS_HZ)
            number, self._exposures = self._exposures, self._exposures + 1
            block = block % 0xFFFF + 1
            if _reached(self._faults.disconnect_at, number):
                self._lost = True
            if self._lost or _reached(self._faults.stall_at, number):
                continue
            pixels = frozen if frozen is not None else self._expose(number)
            if _reached(self._faults.freeze_at, number):
                frozen = pixels
            draw = self._faults.draw(number)
            chances = draw.random(3)
            if chances[0] < self._faults.frame_loss:
                continue
            if self._faults.delay_s and self._closing.wait(self._faults.delay_s * chances[1]):
                return
            cut = self._cut(block, pixels, ticks)
            with self._kept_lock:
                self._kept[block] = cut
                while len(self._kept) > _KEPT_FRAMES:
                    self._kept.popitem(last=False)
            if held is None and chances[2] < self._faults.swapped:
                held = cut
                continue
            for one in (cut, held):
                if one is not None:
                    self._transmit(one, draw)
            held = None

    def _expose(self, number: int) -> NDArray[Any]:
        shape = (self._get(HEIGHT), self._get(WIDTH))
        pixels = self._source(number, ((self._get(OFFSET_Y), self._get(OFFSET_X)), shape))
        if pixels.shape != shape or pixels.dtype != self._dtype:
            raise DriverError(
                f"exposure {number} is {pixels.shape} {pixels.dtype}: {shape} {self._dtype} was wanted"
            )
        if int(pixels.max()) >> self._depth:
            raise DriverError(f"exposure {number} has a {pixels.max()}: {self._depth} bits were wanted")
        return pixels

    def _cut(self, block: int, pixels: NDArray[Any], ticks: int) -> _Block:
        rows, columns = pixels.shape
        padding = self._get(LINE_PADDING)
        data = self._packed(pixels) if self._bits % 8 else self._lines(pixels, padding)
        leader = struct.pack(
            ">HHIIIIIIIHH",
            0,
            1,
            ticks >> 32,
            ticks & 0xFFFFFFFF,
            self._get(PIXEL_FORMAT),
            columns,
            rows,
            self._get(OFFSET_X),
            self._get(OFFSET_Y),
            padding,
            0,
        )
        size = (self._get(_PACKET_SIZE) & 0xFFFF) - _IP_UDP_GVSP_BYTES
        bodies = [(_LEADER, leader)]
        bodies += [(_PAYLOAD, data[first : first + size]) for first in range(0, len(data), size)]
        bodies.append((_TRAILER, struct.pack(">HHI", 0, 1, rows)))
        return _Block(
            block,
            tuple(
                struct.pack(">HHI", 0, block, kind << 24 | index) + body
                for index, (kind, body) in enumerate(bodies)
            ),
        )

    def _lines(self, pixels: NDArray[Any], padding: int) -> bytes:
        rows, columns = pixels.shape
        lines = np.zeros((rows, columns * self._dtype.itemsize + padding), np.uint8)
        little = np.ascontiguousarray(pixels, dtype=self._dtype.newbyteorder("<"))
        lines[:, : columns * self._dtype.itemsize] = little.view(np.uint8)
        return lines.tobytes()

    def _packed(self, pixels: NDArray[Any]) -> bytes:
        """Low bits first; in the older Mono12Packed the byte between two pixels has both low halves."""
        flat = pixels.ravel()
        if self._pixel_format == "Mono12Packed":
            pairs = np.resize(flat, (flat.size + 1) // 2 * 2).reshape(-1, 2)
            first, second = pairs[:, 0], pairs[:, 1]
            triples = np.stack([first >> 4, first & 15 | (second & 15) << 4, second >> 4], axis=1)
            return triples.astype(np.uint8).tobytes()[: -(-flat.size * self._bits // 8)]
        bits = flat[:, None] >> np.arange(self._depth, dtype=np.uint16) & 1
        return np.packbits(bits.astype(np.uint8), bitorder="little").tobytes()

    def _transmit(self, block: _Block, draw: np.random.Generator) -> None:
        lost = draw.random(len(block.packets)) < self._faults.packet_loss
        garbled = draw.random(len(block.packets)) < self._faults.garbled
        last = len(block.packets) - 1
        for index, packet in enumerate(block.packets):
            if lost[index] and 0 < index < last:
                continue
            self._send(_garble(packet, 8 if 0 < index < last else 48, draw) if garbled[index] else packet)
        self.sent += 1

    def _resend(self, body: bytes) -> None:
        if len(body) < 12:
            return
        block, first, last = struct.unpack(">xxHII", body[:12])
        with self._kept_lock:
            kept = self._kept.get(block)
        for index in range(first & 0xFFFFFF, min(last & 0xFFFFFF, (first & 0xFFFFFF) + 4096) + 1):
            if kept is not None and index < len(kept.packets):
                self._send(kept.packets[index])
                self.resent += 1
            else:
                self._send(struct.pack(">HHI", _PACKET_UNAVAILABLE, block, _PAYLOAD << 24 | index))


def _identity(address: str) -> bytearray:
    """The first registers, which discovery answers with: who the camera at `address` is."""
    octets = socket.inet_aton(address)
    memory = bytearray(_IDENTITY_SIZE)
    struct.pack_into(">II", memory, 0, 0x00020000, 0x80000001)  # version 2.0; big endian, UTF-8
    memory[0x0A:0x10] = b"\x02\x00" + octets  # a locally administered MAC
    struct.pack_into(">II", memory, 0x10, 5, 5)  # persistent and link-local addresses
    memory[0x24:0x28] = octets
    memory[0x34:0x38] = socket.inet_aton("255.0.0.0")
    for offset, text in (
        (0x48, "adof"),
        (0x68, "Emulated GigE camera"),
        (0x88, "1"),
        (0xD8, "EMU" + octets.hex()),
    ):
        memory[offset : offset + len(text)] = text.encode()
    return memory


def _payload_bytes(shape: tuple[int, int], bits: int, padding: int) -> int:
    rows, columns = shape
    return -(-rows * columns * bits // 8) + rows * padding


def _memory(
    address: str,
    sensor: tuple[int, int],
    pixel_format: str,
    rate_hz: float,
    exposure_us: float,
    line_padding: int,
) -> bytearray:
    """All registers as they are when the camera is switched on."""
    memory = bytearray(_MEMORY_SIZE)
    identity = _identity(address)
    memory[: len(identity)] = identity
    rows, columns = sensor
    xml = description(pixel_format).encode()
    code = PIXEL_FORMATS[pixel_format][0]
    memory[XML_ADDRESS : XML_ADDRESS + len(xml)] = xml
    url = f"Local:adof.xml;{XML_ADDRESS:x};{len(xml):x}".encode()
    memory[0x200 : 0x200 + len(url)] = url
    for register, value in (
        (0x600, 1),  # network interfaces
        (0x904, 1),  # stream channels
        (0x934, 0x7),  # resend, memory writes, several registers at once
        (_HEARTBEAT_MS, 3000),
        (_TICKS_HIGH, _TICKS_HZ >> 32),
        (_TICKS_LOW, _TICKS_HZ & 0xFFFFFFFF),
        (_PACKET_SIZE, 8192),
        (SENSOR_WIDTH, columns),
        (SENSOR_HEIGHT, rows),
        (WIDTH, columns),
        (HEIGHT, rows),
        (PIXEL_FORMAT, code),
        (LINE_PADDING, line_padding),
        (PAYLOAD_SIZE, _payload_bytes(sensor, code >> 16 & 0xFF, line_padding)),
    ):
        struct.pack_into(">I", memory, register, value)
    struct.pack_into(">f", memory, EXPOSURE_US, exposure_us)
    struct.pack_into(">f", memory, FRAME_RATE_HZ, rate_hz)
    return memory
