"""Open-hardware micromanipulators (the MicroManipulatorStepper family) by G-code over a serial port.

What the device cannot do, and what follows:

* Nothing stops a segment that was accepted, but switching the motors off. So it is only ever sent one, as
  long as the caller lets it run unwatched, and the next at rest; a stop sends nothing more, and what runs
  ends by itself. `emergency_stop` switches the motors off: whatever they hold up falls.
* Nothing says where it is while it moves, and at rest only where it was sent (M50): an axis that is stuck, or
  pushed, is not seen. Switched on (M17, `enable`) it measures, and takes what it finds for its pose.
* While it homes it hears nothing, not even a stop: only its power switch ends that.
* It knows no limits: axes state their own.

Source: the dialect as in the project's published firmware, v1.0.1 to v1.0.5; measured on an emulator, not on
hardware.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping

from adof_drivers.errors import ControllerError, DialectError, LimitError, ReplyError, StoppedError
from adof_drivers.link import Link, Transport

AXES = ("X", "Y", "Z")
OFF = b"M18\n"
HOMING_S = 60.0
"""Longest homing."""

_LINE = re.compile(rb"[^\n]*\n|[^\n]+")
_LOG = (b"D)", b"I)", b"W)", b"E)")
_NUMBER = r"[+-]?\d{1,6}\.\d{1,9}"
_POSE = re.compile(rf"X({_NUMBER}) Y({_NUMBER}) Z({_NUMBER})")
_VERSION = re.compile(r"v(\d{1,4})\.(\d{1,4})\.(\d{1,4})")
_JOINT = re.compile(r"Joint \d+:\s+is_homed=([01]),?\s+is_calibrated=([01])\b.*")
_OLDEST = (1, 0, 1)


def whole(reply: bytes) -> bool:
    """Whether the last line says how it ended."""
    if not reply.endswith(b"\n"):
        return False
    last = reply[:-1].rpartition(b"\n")[2].strip()
    return last in (b"ok", b"busy") or last.startswith(b"error")


class WithoutLog:
    """A transport less the log lines, which come unasked, at any time; the last complaint is kept.

    Parameters
    ----------
    transport
        Taken over.
    """

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.complaint = ""
        self._line = b""  # of the line that has begun: its log, or a first byte that may yet be one
        self._answer = False  # it has begun, and is none

    @property
    def name(self) -> str:
        """Where it leads."""
        return self.transport.name

    def write(self, data: bytes) -> None:
        """Send it."""
        self.transport.write(data)

    def read_some(self, timeout_s: float) -> bytes:
        """Return what is no log of what is there."""
        kept = b""
        for piece in _LINE.findall(self._line + self.transport.read_some(timeout_s)):
            ends = piece.endswith(b"\n")
            if self._answer or not (piece.startswith(_LOG) or (len(piece) == 1 and piece in b"DIWE")):
                kept += piece
                self._line, self._answer = b"", not ends
            elif ends:
                self._line = b""
                if piece.startswith(b"E)"):
                    self.complaint = piece[2:].decode("ascii", "replace").strip()
            else:
                self._line = piece[:200]
        return kept

    def close(self) -> None:
        """Close it."""
        self.transport.close()


class GcodeController:
    """A micromanipulator. Values are mm and mm/s.

    Parameters
    ----------
    link
        Taken over: closed with the controller, and when it is refused.

    Raises
    ------
    DialectError
        Something else answers.
    LinkError, ReplyError
        It does not answer, or not as it should.
    """

    rest_s = 0.02
    """Its last step of a segment, 10 ms, runs when it says that it is done."""
    blind = True

    def __init__(self, link: Link) -> None:
        self._link = link
        self._log = WithoutLog(link.transport)
        link.transport = self._log
        self._homed = self._on = self._fell = False
        self._cuts = self._cuts_heard = 0
        try:
            link.discard()
            self.identity = f"micromanipulator {self._version()}"
            self.homed(AXES)
        except BaseException:
            link.close()
            raise

    @property
    def stops(self) -> int:
        """How often it was stopped."""
        return self._link.interrupts

    def travel(self, axes: Collection[str]) -> dict[str, tuple[float, float]]:
        """Return nothing: it knows no ends, so that an axis must state its own.

        Raises
        ------
        DialectError
            An axis that is none of X, Y, Z.
        """
        absent = [axis for axis in axes if axis not in AXES]
        if absent:
            raise DialectError(f"axis {', '.join(absent)} is not there: {', '.join(AXES)} are")
        return {}

    def positions(self, axes: Collection[str]) -> dict[str, float]:
        """Return where the last segment ends: the place, once `moving` is over and `rest_s` has passed.

        Raises
        ------
        StoppedError
            It was switched off: nobody knows where it fell.
        """
        if self._fell:
            raise StoppedError(f"{self.identity} was switched off: enable it, and it measures where it is")
        pose = self._pose()
        return {axis: pose[axis] for axis in axes}

    def homed(self, axes: Collection[str]) -> dict[str, bool]:
        """Say whether all joints are referenced and calibrated; asked until they are, and after a refusal."""
        if not self._homed:
            lines = [line for line in self._request("M57") if line.startswith("Joint")]
            flags = [match.groups() for line in lines if (match := _JOINT.fullmatch(line))]
            if len(flags) != len(lines) or not flags:
                raise self._link.refuse(ReplyError(f"M57 was answered {lines!r}: joints were wanted"))
            self._homed = all(flag == ("1", "1") for flag in flags)
        return dict.fromkeys(axes, self._homed)

    def moving(self) -> bool:
        """Say whether a segment runs."""
        return self._one_of("M53", ("0", "1")) == "0"

    def enable(self, axes: Collection[str], *, since: int) -> None:
        """Switch the motors on where they stand; all of them, at rest only.

        Raises
        ------
        ControllerError
            A segment still runs: switched on now, it would leap to it.
        """
        self.travel(axes)
        self._require_rest()
        self._command("M17", since)
        self._on, self._fell = True, False

    def home(self, axes: Collection[str], *, since: int) -> None:
        """Reference all joints, whichever axes are named, and wait for it: nothing is heard meanwhile."""
        self.travel(axes)
        self._homed = False
        self._command("G28 A B C", since, timeout_s=HOMING_S)
        self._on, self._fell = True, False

    def homing(self) -> bool:
        """Say no: `home` has waited."""
        return False

    def move(
        self, targets: Mapping[str, float], speeds: Mapping[str, float], halt: Collection[str], *, since: int
    ) -> None:
        """Send one straight segment, in which no axis is faster than its speed; at rest only.

        Axes in `halt` rest already.

        Raises
        ------
        ControllerError
            The motors were not switched on by `enable`, a segment still runs, or it refuses.
        LimitError
            Out of its reach, or not homed; nothing was moved.
        """
        self.travel([*targets, *halt])
        if not self._on:
            raise ControllerError(f"{self.identity} may be switched off: enable it first", 0)
        self._require_rest()
        pose = self._pose()
        ways = {axis: target - pose[axis] for axis, target in targets.items()}
        duration_s = max((abs(way) / speeds[axis] for axis, way in ways.items()), default=0.0)
        if duration_s > 0:
            words = " ".join(f"{axis}{target:.6f}" for axis, target in targets.items())
            speed = max(math.hypot(*ways.values()) / duration_s, 1e-6)
            # I: at once; without it the first segment waits 50 ms for others.
            self._command(f"G0 {words} F{speed:.6f} I", since)
        elif self.stops != since:
            raise StoppedError(f"{self.identity} was stopped meanwhile")

    def stop(self) -> None:
        """Send nothing more: the segment that runs ends by itself."""
        self._link.interrupt(b"")

    def emergency_stop(self) -> None:
        """Switch the motors off: at once, from any thread."""
        self._on, self._fell = False, True
        self._cuts += 1
        self._link.interrupt(OFF)

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _version(self) -> str:
        try:
            lines = self._request("M58")
        except ControllerError as refusal:
            raise DialectError(f"{self._log.name} is no micromanipulator: {refusal}") from None
        match = _VERSION.fullmatch(lines[0]) if len(lines) == 1 else None
        if match is None:
            raise DialectError(f"{self._log.name} answers {lines!r} to M58: a firmware version was wanted")
        if not _OLDEST <= tuple(map(int, match.groups())) < (2, 0, 0):
            raise DialectError(f"{self._log.name} has firmware {lines[0]}: v1, from v1.0.1 on, was wanted")
        return lines[0]

    def _pose(self) -> dict[str, float]:
        lines = self._request("M50")
        match = _POSE.fullmatch(lines[0]) if len(lines) == 1 else None
        if match is None:
            raise self._link.refuse(ReplyError(f"M50 was answered {lines!r}: X, Y and Z were wanted"))
        return dict(zip(AXES, map(float, match.groups()), strict=True))

    def _require_rest(self) -> None:
        if self.moving():
            raise ControllerError(f"{self.identity} still runs a segment: wait until it is still", 0)

    def _one_of(self, request: str, answers: Collection[str]) -> str:
        lines = self._request(request)
        if len(lines) != 1 or lines[0] not in answers:
            raise self._link.refuse(
                ReplyError(f"{request} was answered {lines!r}: {' or '.join(answers)} was wanted")
            )
        return lines[0]

    def _command(self, line: str, since: int, *, timeout_s: float | None = None) -> None:
        lines = self._request(line, since=since, timeout_s=timeout_s)
        if lines:
            raise self._link.refuse(ReplyError(f"{line} was answered {lines!r}: no more than ok was wanted"))
        if self.stops != since:
            raise StoppedError(f"{self.identity} was stopped meanwhile")

    def _request(self, line: str, *, since: int | None = None, timeout_s: float | None = None) -> list[str]:
        """Ask, and return the lines before the ok.

        Raises
        ------
        StoppedError
            It was switched off meanwhile, whose own ok makes the answers one too many.
        """
        if self._cuts_heard != self._cuts:
            self._cuts_heard = self._cuts
            self._link.discard()
        self._log.complaint = ""
        reply = self._link.exchange(f"{line}\n".encode(), whole, since=since, timeout_s=timeout_s)
        if self._cuts_heard != self._cuts:
            raise StoppedError("it was switched off meanwhile: what it answered may be another's")
        try:
            *lines, last = reply.decode("ascii").removesuffix("\n").split("\n")
        except UnicodeDecodeError:
            raise self._link.refuse(ReplyError(f"{line} was answered {reply[:40]!r}: no ASCII")) from None
        if last == "ok":
            return lines
        said = ", ".join(filter(None, (last, self._log.complaint)))
        if "not all joints" in last:
            self._homed = False
            raise LimitError(f"it does not know where it is ({said}): home it first, nothing was moved")
        if any(word in last for word in ("limit", "kinematic", "travel")):
            raise LimitError(f"{line} was refused, {said}: nothing was moved")
        if last != "busy" and not last.startswith("error"):
            raise self._link.refuse(ReplyError(f"{line} was answered {reply[:60]!r}: ok or error was wanted"))
        raise ControllerError(f"{line} was refused with {said!r}: see its firmware", 0)
