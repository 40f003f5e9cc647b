"""HID devices as hidapi hands them out, byte by byte: SpaceMouse, pedal, relay board; and unplugged.

Each is the device alone, without a bus: `hid_nodes` puts it on a device node.
"""

from __future__ import annotations

import random
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence

from adof_drivers.errors import RequestError

_MOST_KEPT = 64  # reports, as the kernel keeps for a program that does not read


class EmulatedHid:
    """What hidapi's `device` does once opened and set not to block.

    Attributes
    ----------
    IDENTITY, PRODUCT
        USB vendor and product, and what it calls itself.
    USAGE
        Begin of its report descriptor: what kind of device it says it is.
    OUTPUT_BYTES
        Length of what is written to it.
    written
        Output reports, as they came.
    """

    IDENTITY = (0, 0)
    PRODUCT = ""
    USAGE = bytes.fromhex("0600ff0901")  # the vendor's own
    OUTPUT_BYTES = 64

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self._reports: deque[bytes] = deque()
        self._gone = False

    def commands(self) -> dict[str, tuple[str, Callable[[Sequence[str]], None]]]:
        """Return what can be done to it: by name, the arguments that are wanted, and what does it."""
        return {"report": ("HEX", lambda words: self.send(bytes.fromhex("".join(words))))}

    def obey(self, words: Sequence[str]) -> None:
        """Do one command.

        Raises
        ------
        RequestError
            None of `commands`, or with other arguments; nothing was done.
        """
        known = self.commands()
        wanted = ", ".join(
            f"'{name} {arguments}'".replace(" '", "'") for name, (arguments, _) in known.items()
        )
        refusal = RequestError(
            f"'{' '.join(words)}' is no command of this device: one of {wanted} was wanted"
        )
        if not words or words[0] not in known:
            raise refusal
        try:
            known[words[0]][1](words[1:])
        except (ValueError, TypeError, struct.error):
            raise refusal from None

    def state(self) -> str:
        """Return what a program made of it, in a word or two; "" if nothing."""
        return ""

    def repeat(self) -> None:
        """Say again what such a device says every 16 ms."""

    def send(self, report: bytes) -> None:
        """Let the device say something; what is not read in time is lost."""
        if len(self._reports) < _MOST_KEPT:
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

    IDENTITY = (0x256F, 0xC635)
    PRODUCT = "SpaceMouse Compact"
    USAGE = bytes.fromhex("05010908")  # a multi-axis controller
    OUTPUT_BYTES = 2

    def __init__(self, *, joined: bool = False) -> None:
        super().__init__()
        self._joined = joined
        self._place: tuple[int, ...] = ()

    def commands(self) -> dict[str, tuple[str, Callable[[Sequence[str]], None]]]:
        """Return what can be done to it."""
        return super().commands() | {
            "deflect": ("X Y Z [AX AY AZ]", lambda words: self.deflect(*map(int, words))),
            "press": ("[BUTTON...]", lambda words: self.press(*map(int, words))),
            "silence": ("", lambda words: self.silence(*words)),
        }

    def state(self) -> str:
        """Return whether its light is on."""
        return f"light {'on' if self.written[-1][1:] == bytes([1]) else 'off'}" if self.written else ""

    def repeat(self) -> None:
        """Send the puck's place again while it is deflected."""
        if any(self._place):
            self.deflect(*self._place)

    def silence(self) -> None:
        """Say nothing more of a puck that is deflected, as out of a wireless one's reach."""
        self._place = ()

    def deflect(self, x: int, y: int, z: int, about_x: int = 0, about_y: int = 0, about_z: int = 0) -> None:
        """Send the puck's place, each axis from about -350 to 350."""
        self._place = (x, y, z, about_x, about_y, about_z)
        if self._joined:
            self.send(struct.pack("<B6h", 1, x, y, z, about_x, about_y, about_z))
        else:
            self.send(struct.pack("<B3h", 1, x, y, z))
            self.send(struct.pack("<B3h", 2, about_x, about_y, about_z))

    def press(self, *buttons: int) -> None:
        """Send which buttons are held, from 0."""
        self.send(bytes([3]) + sum(1 << button for button in buttons).to_bytes(4, "little"))


class EmulatedPedal(EmulatedHid):
    """A pedal of one contact, as a joystick's first button."""

    IDENTITY = (0x05F3, 0x00FF)
    PRODUCT = "VEC Footpedal"
    USAGE = bytes.fromhex("05010904")  # a joystick
    _DOWN, _UP = b"\x01\x00", b"\x00\x00"

    def commands(self) -> dict[str, tuple[str, Callable[[Sequence[str]], None]]]:
        """Return what can be done to it."""
        return super().commands() | {
            "press": ("", lambda words: self.press(*words)),
            "release": ("", lambda words: self.release(*words)),
        }

    def press(self) -> None:
        """Step on it."""
        self.send(self._DOWN)

    def release(self) -> None:
        """Step off it."""
        self.send(self._UP)


class EmulatedKeyboardPedal(EmulatedPedal):
    """A pedal that is a keyboard with one key."""

    IDENTITY = (0x0C45, 0x7404)
    PRODUCT = "FootSwitch"
    USAGE = bytes.fromhex("05010906")  # a keyboard
    _DOWN, _UP = bytes([0, 0, 5, 0, 0, 0, 0, 0]), bytes(8)


class EmulatedRelay(EmulatedHid):
    """A board of two relays; `stuck` ones do not switch."""

    IDENTITY = (0x16C0, 0x05DF)
    PRODUCT = "USBRelay2"

    def __init__(self, *, stuck: Sequence[int] = ()) -> None:
        super().__init__()
        self.bits = 0
        self.stick(*stuck)

    def commands(self) -> dict[str, tuple[str, Callable[[Sequence[str]], None]]]:
        """Return what can be done to it."""
        return super().commands() | {"stick": ("[CHANNEL...]", lambda words: self.stick(*map(int, words)))}

    def stick(self, *channels: int) -> None:
        """Have these relays, from 0, switch no more, and only these."""
        self._stuck = sum(1 << channel for channel in channels)

    def state(self) -> str:
        """Return which relays are on."""
        on = [str(channel) for channel in range(8) if self.bits >> channel & 1]
        return f"on {' '.join(on)}" if on else "all off"

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

    IDENTITY = (0x0451, 0xC900)
    PRODUCT = "DLPC900"
    OUTPUT_BYTES = 65

    def __init__(self, *, locked: bool = True, silent: bool = False) -> None:
        super().__init__()
        self.mode = 0
        self.running = False
        self._locked = locked
        self._silent = silent

    def state(self) -> str:
        """Return its mode, and whether it shows patterns."""
        return f"mode {self.mode}, {'running' if self.running else 'stopped'}"

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


KINDS: dict[str, type[EmulatedHid]] = {
    "spacemouse": EmulatedSpaceMouse,
    "pedal": EmulatedPedal,
    "keyboard-pedal": EmulatedKeyboardPedal,
    "relay": EmulatedRelay,
    "dlpc900": EmulatedDlpc900,
}


def operator(kinds: Sequence[str], seed: int) -> Iterator[str]:
    """Play somebody at these devices for ever: lines as `hid_nodes` takes them; a seed, a play.

    Pucks are pushed and let go, pedals stepped on for a moment; now and then a cable is drawn and put back.
    """
    draw = random.Random(seed)  # noqa: S311  (nothing secret)
    while True:
        kind = draw.choice(kinds)
        yield f"wait {draw.uniform(0.2, 1.0):.2f}"
        if draw.random() < 0.1:
            yield from (f"{kind} unplug", f"wait {draw.uniform(0.5, 2.0):.2f}", f"{kind} plug")
        elif kind == "spacemouse":
            places = [draw.randint(-350, 350) if draw.random() < 0.5 else 0 for _ in range(6)]
            yield f"{kind} deflect {' '.join(map(str, places))}"
            yield f"wait {draw.uniform(0.2, 1.5):.2f}"
            yield f"{kind} deflect 0 0 0"
        elif kind.endswith("pedal"):
            yield from (f"{kind} press", f"wait {draw.uniform(0.05, 0.5):.2f}", f"{kind} release")
