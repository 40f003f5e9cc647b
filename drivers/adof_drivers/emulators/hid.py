"""HID devices as hidapi hands them out, byte by byte: SpaceMouse, pedal, relay board; and unplugged."""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence


class EmulatedHid:
    """What hidapi's `device` does once opened and set not to block.

    Attributes
    ----------
    written
        Output reports, as they came.
    """

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self._reports: deque[bytes] = deque()
        self._gone = False

    def send(self, report: bytes) -> None:
        """Let the device say something."""
        self._reports.append(report)

    def unplug(self) -> None:
        """Draw the cable: what was not read is lost, every call fails from now on."""
        self._gone = True
        self._reports.clear()

    def _require_there(self) -> None:
        if self._gone:
            raise OSError("read error")

    def read(self, max_length: int) -> Sequence[int]:
        """Return the next report, or []."""
        self._require_there()
        return list(self._reports.popleft()[:max_length]) if self._reports else []

    def write(self, buff: bytes) -> int:
        """Take an output report."""
        self._require_there()
        self.written.append(bytes(buff))
        return len(buff)

    def send_feature_report(self, buff: bytes) -> int:
        """Refuse: most devices have no feature reports. As hidapi, -1."""
        self._require_there()
        return -1 if buff else 0

    def get_feature_report(self, report_num: int, max_length: int) -> Sequence[int]:
        """Answer nothing."""
        self._require_there()
        return [report_num][:0] if max_length else []

    def close(self) -> None:
        """Give it back; every call fails from now on."""
        self._gone = True


class EmulatedSpaceMouse(EmulatedHid):
    """A SpaceMouse; `joined` for those that send all six axes in one report."""

    def __init__(self, *, joined: bool) -> None:
        super().__init__()
        self._joined = joined

    def deflect(self, x: int, y: int, z: int, about_x: int = 0, about_y: int = 0, about_z: int = 0) -> None:
        """Send the puck's place, each axis from about -350 to 350."""
        if self._joined:
            self.send(struct.pack("<B6h", 1, x, y, z, about_x, about_y, about_z))
        else:
            self.send(struct.pack("<B3h", 1, x, y, z))
            self.send(struct.pack("<B3h", 2, about_x, about_y, about_z))

    def press(self, *buttons: int) -> None:
        """Send which buttons are held, from 0."""
        self.send(bytes([3]) + sum(1 << button for button in buttons).to_bytes(4, "little"))


class EmulatedRelay(EmulatedHid):
    """A relay board; `stuck` relays do not switch."""

    def __init__(self, *, stuck: Sequence[int] = ()) -> None:
        super().__init__()
        self.bits = 0
        self._stuck = sum(1 << channel for channel in stuck)

    def send_feature_report(self, buff: bytes) -> int:
        """Obey `00 FF n` (on), `00 FD n` (off), `00 FE`, `00 FC` (all)."""
        self._require_there()
        self.written.append(bytes(buff))
        command, channel = buff[1], buff[2]
        one = 1 << (channel - 1) if 1 <= channel <= 8 else 0
        new = {0xFF: self.bits | one, 0xFD: self.bits & ~one, 0xFE: 0xFF, 0xFC: 0}.get(command, self.bits)
        self.bits = (self.bits & self._stuck) | (new & ~self._stuck)
        return len(buff)

    def get_feature_report(self, report_num: int, max_length: int) -> Sequence[int]:
        """Answer serial number and state, after the report's number."""
        self._require_there()
        return [report_num, *b"ADOF1", 0, 0, self.bits][:max_length]


class EmulatedDlpc900(EmulatedHid):
    """TI's controller: status, version, display mode, patterns on and off.

    Parameters
    ----------
    locked
        Whether a video signal is there; without one it refuses patterns from video.
    silent
        It takes commands and answers none.

    Attributes
    ----------
    mode, running
        As the commands left them.
    """

    def __init__(self, *, locked: bool = True, silent: bool = False) -> None:
        super().__init__()
        self.mode = 0
        self.running = False
        self._locked = locked
        self._silent = silent

    def write(self, buff: bytes) -> int:
        """Obey one command, `00 flags sequence length command data`."""
        super().write(buff)
        flags, sequence = buff[1], buff[2]
        count = int.from_bytes(buff[3:5], "little")
        command, data = int.from_bytes(buff[5:7], "little"), buff[7 : 5 + count]
        failed, answer = self._obey(command, data, reading=bool(flags & 0x80))
        if flags & 0x40 and not self._silent:
            head = bytes([flags & 0x80 | (0x20 if failed else 0), sequence]) + len(answer).to_bytes(
                2, "little"
            )
            self.send((head + answer).ljust(64, b"\x00"))
        return len(buff)

    def _obey(self, command: int, data: bytes, *, reading: bool) -> tuple[bool, bytes]:
        if reading:
            answers = {0x0205: bytes([3, 0, 1, 6]), 0x1A0A: b"\x01", 0x1A1B: bytes([self.mode])}
            return command not in answers, answers.get(command, b"")
        if command == 0x1A1B and data and data[0] <= 3:
            if data[0] != 2 or self._locked:
                self.mode = data[0]
        elif command == 0x1A24 and data and data[0] <= 2 and not (data[0] and self.mode == 0):
            self.running = data[0] == 2
        else:
            return True, b""
        return False, b""
