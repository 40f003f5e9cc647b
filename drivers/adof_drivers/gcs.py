"""PI controllers by GCS 2.0, the General Command Set: ASCII lines, mm and degrees, over any link.

Opening reads; nothing is written that could move. A reply is checked in full: axes, order, numbers, ends of
lines. One that makes no sense breaks the link, since the next one could be anyone's.

Source: formats and codes as in PI's published GCS 2.0 command set; measured on emulators, not on hardware.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping

from adof_drivers.errors import ControllerError, DialectError, LimitError, ReplyError, StoppedError
from adof_drivers.link import Link

STOP = b"\x18"
REQUIRED = ("POS?", "MOV", "VEL", "TMN?", "TMX?", "FRF?", "FRF", "SVO", "HLT", "ERR?")
"""What HLP? must list."""

MEANINGS = {
    0: "no error",
    2: "unknown command",
    5: "the axis is not referenced, or its servo is off",
    7: "beyond the travel",
    10: "stopped by command",
    15: "no such axis",
    17: "a parameter is out of range",
    -1024: "the position error grew too large, and the servo switched itself off",
}
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
_TRAVEL_SLACK = 0.05
"""A referenced axis may read this share of its travel beyond it: overshoot, a limit switch."""


def whole(reply: bytes) -> bool:
    """Whether the last line is there: every line but the last ends in a space."""
    return reply.endswith(b"\n") and not reply.endswith(b" \n")


class GcsController:
    """A GCS 2.0 controller.

    Parameters
    ----------
    link
        Taken over: closed with the controller, and when it is refused.
    axes
        The controller's names that will be used, each with its travel read once; by default all it has.

    Raises
    ------
    DialectError
        It speaks GCS 3.0, something else, or lacks a command or an axis.
    LinkError, ReplyError
        It does not answer, or not as it should.
    """

    rest_s = None
    blind = False

    def __init__(self, link: Link, axes: Collection[str] | None = None) -> None:
        self._link = link
        self._cleared = link.interrupts
        self._travel: dict[str, tuple[float, float]] = {}
        try:
            link.discard()
            # An error left from before would be taken for that of the first command.
            self._error()
            self.identity = self._text(b"*IDN?\n")
            self._require_dialect()
            self.axis_names = tuple(line.strip() for line in self._lines(b"SAI?\n"))
            wanted = self.axis_names if axes is None else tuple(axes)
            absent = [axis for axis in wanted if axis not in self.axis_names]
            if absent:
                raise DialectError(
                    f"{self.identity} has no axis {', '.join(absent)}: it has {', '.join(self.axis_names)}"
                )
            low, high = self._values("TMN?", wanted), self._values("TMX?", wanted)
            self._travel = {axis: (low[axis], high[axis]) for axis in wanted}
            self._homed: dict[str, bool] = {}
            self.homed(wanted)
        except BaseException:
            link.close()
            raise

    @property
    def stops(self) -> int:
        """How often `stop` was called."""
        return self._link.interrupts

    def travel(self, axes: Collection[str]) -> dict[str, tuple[float, float]]:
        """Return first and last position, mm or degrees.

        Raises
        ------
        DialectError
            An axis that was not opened.
        """
        absent = [axis for axis in axes if axis not in self._travel]
        if absent:
            raise DialectError(f"axis {', '.join(absent)} is not there: {', '.join(self._travel)} are")
        return {axis: self._travel[axis] for axis in axes}

    def positions(self, axes: Collection[str]) -> dict[str, float]:
        """Read positions, mm or degrees.

        Raises
        ------
        ReplyError
            A reply that is none, or a place a referenced axis cannot be.
        """
        found = self._values("POS?", axes)
        for axis, value in found.items():
            low, high = self._travel[axis]
            slack = _TRAVEL_SLACK * (high - low)
            if self._homed.get(axis) and not low - slack <= value <= high + slack:
                raise self._link.refuse(
                    ReplyError(
                        f"axis {axis} says {value:g}, its travel is {low:g} to {high:g}: it lost count"
                    )
                )
        return found

    def homed(self, axes: Collection[str]) -> dict[str, bool]:
        """Say which axes are referenced."""
        self._homed |= (found := self._flags("FRF?", axes))
        return found

    def moving(self) -> bool:
        """Ask by the single byte 5, whose answer is a bit mask in hexadecimal."""
        text = self._text(b"\x05")
        if not re.fullmatch(r"(0x)?[0-9A-Fa-f]{1,8}", text):
            raise self._link.refuse(ReplyError(f"#5 was answered {text!r}: a hexadecimal number was wanted"))
        return int(text, 16) != 0

    def homing(self) -> bool:
        """Ask by the single byte 7: B1 is ready, B0 is busy."""
        reply = self._link.exchange(b"\x07", whole)
        if reply not in (b"\xb1\n", b"\xb0\n"):
            raise self._link.refuse(ReplyError(f"#7 was answered {reply!r}: B1 or B0 was wanted"))
        return reply == b"\xb0\n"

    def enable(self, axes: Collection[str], *, since: int) -> None:
        """Switch the servos on."""
        self._command("SVO " + " ".join(f"{axis} 1" for axis in axes) + "\n", since)

    def home(self, axes: Collection[str], *, since: int) -> None:
        """Begin a reference move to the axes' reference switches."""
        self._command("FRF " + " ".join(axes) + "\n", since)

    def move(
        self, targets: Mapping[str, float], speeds: Mapping[str, float], halt: Collection[str], *, since: int
    ) -> None:
        """Send speeds, targets and halts in one go, then ask once whether they were taken."""
        lines = ""
        if halt:
            lines += "HLT " + " ".join(halt) + "\n"
        if targets:
            lines += "VEL " + " ".join(f"{axis} {speeds[axis]:.9f}" for axis in targets) + "\n"
            lines += "MOV " + " ".join(f"{axis} {value:.9f}" for axis, value in targets.items()) + "\n"
        self._command(lines, since, halted=bool(halt))

    def stop(self) -> None:
        """Send the single byte 24: at once, from any thread."""
        self._link.interrupt(STOP)

    def emergency_stop(self) -> None:
        """Stop likewise: the drives stay on, or the axes would fall."""
        self.stop()

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _require_dialect(self) -> None:
        text = self._text(b"CSV?\n")
        if not _NUMBER.fullmatch(text) or not 1 <= float(text) <= 2:
            raise DialectError(
                f"{self.identity} speaks command set {text!r}: GCS 2.0 was wanted, and its stop would differ"
            )
        # The list's first and last lines are headings; a command is the first word of its line.
        known = {line.split(None, 1)[0] for line in self._lines(b"HLP?\n") if line.strip()}
        missing = [command for command in REQUIRED if command not in known]
        if missing:
            raise DialectError(f"{self.identity} has no {', '.join(missing)}: it cannot be a GCS stage")

    def _command(self, lines: str, since: int, *, halted: bool = False) -> None:
        if self._cleared != since:
            self._error()  # the 10 that an earlier stop left is not this command's
            self._cleared = since
        code = self._error(lines, since)
        if code == 10 and halted:
            code = 0
        if code == 10 or (code != 0 and self.stops != since):
            raise StoppedError(f"{self.identity} was stopped meanwhile")
        if code == 7:
            raise LimitError(f"{self.identity} refused with error 7, {MEANINGS[7]}: nothing was moved")
        if code != 0:
            meaning = MEANINGS.get(code, "see its manual")
            raise ControllerError(f"{self.identity} refused with error {code}, {meaning}", code)

    def _error(self, lines: str = "", since: int | None = None) -> int:
        """Send lines that give no answer, and ask for the error; it is cleared by asking."""
        text = self._text(f"{lines}ERR?\n".encode(), since)
        if not re.fullmatch(r"[+-]?\d{1,6}", text):
            raise self._link.refuse(ReplyError(f"ERR? was answered {text!r}: a number was wanted"))
        return int(text)

    def _text(self, request: bytes, since: int | None = None) -> str:
        lines = self._lines(request, since)
        if len(lines) != 1:
            raise self._link.refuse(
                ReplyError(f"{request!r} was answered in {len(lines)} lines: one was wanted")
            )
        return lines[0].strip()

    def _lines(self, request: bytes, since: int | None = None) -> list[str]:
        reply = self._link.exchange(request, whole, since=since)
        try:
            return reply.decode("ascii").removesuffix("\n").split("\n")
        except UnicodeDecodeError:
            raise self._link.refuse(
                ReplyError(f"{request!r} was answered {reply[:40]!r}: no ASCII")
            ) from None

    def _values(self, command: str, axes: Collection[str]) -> dict[str, float]:
        """Ask for one number of every axis; they must come one a line, in the order asked."""
        lines = self._lines(f"{command} {' '.join(axes)}\n".encode())
        values = {}
        for axis, line in zip(axes, lines, strict=False):
            name, _, number = line.strip().partition("=")
            if name != axis or not _NUMBER.fullmatch(number) or not math.isfinite(float(number)):
                break
            values[axis] = float(number)
        if len(values) != len(lines) or len(lines) != len(axes):
            raise self._link.refuse(
                ReplyError(f"{command} was answered {lines!r}: a number for {', '.join(axes)} was wanted")
            )
        return values

    def _flags(self, command: str, axes: Collection[str]) -> dict[str, bool]:
        values = self._values(command, axes)
        if not set(values.values()) <= {0.0, 1.0}:
            raise self._link.refuse(ReplyError(f"{command} was answered {values}: 0 or 1 was wanted"))
        return {axis: value == 1.0 for axis, value in values.items()}
