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
