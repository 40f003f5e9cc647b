"""New Focus Picomotor 8742: four open-loop axes, counted in steps, over USB or TCP.

Nothing measures where an axis is: its position is the count of steps sent, zero where the operator said so by
`home`, which moves nothing. After a power cycle, or a new connection, that has to be said again.

A motor in motion may refuse to be sent elsewhere ("motion in progress"), so that a new target or velocity
waits for the end of the last: choose a velocity's expiry as short as the period at which it is renewed.

Source: formats and codes as in the 8742's published command set; measured on emulators, not on hardware.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping

from adof_drivers.errors import ControllerError, DialectError, LimitError, ReplyError, StoppedError
from adof_drivers.link import Link

VENDOR, PRODUCT = 0x104D, 0x4000
AXES = ("1", "2", "3", "4")
TOP_SPEED = 2000
"""Steps a second; what a standard motor takes."""
STOP = b"AB\r"

_OLDEST_ERRORS = 10
"""Errors the controller keeps."""


def whole(reply: bytes) -> bool:
    """Whether the line is there."""
    return reply.endswith(b"\n")


class PicomotorController:
    """An 8742. Values are steps and steps a second, whole ones.

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

    rest_s = 0.0
    blind = False

    def __init__(self, link: Link) -> None:
        self._link = link
        self._homed: set[str] = set()
        try:
            link.discard()
            self.identity = self._text("*IDN?")
            if "8742" not in self.identity:
                raise DialectError(f"{link.transport.name} is {self.identity!r}: a Picomotor 8742 was wanted")
            for _ in range(_OLDEST_ERRORS + 1):  # left from before
                if self._integer("TE?") == 0:
                    break
            else:
                raise DialectError(f"{self.identity} does not run out of errors: switch it off and on")
        except BaseException:
            link.close()
            raise

    @property
    def stops(self) -> int:
        """How often `stop` was called."""
        return self._link.interrupts

    def travel(self, axes: Collection[str]) -> dict[str, tuple[float, float]]:
        """Return nothing: it knows no ends, so that an axis must state its own.

        Raises
        ------
        DialectError
            An axis that is none of 1 to 4.
        """
        absent = [axis for axis in axes if axis not in AXES]
        if absent:
            raise DialectError(f"axis {', '.join(absent)} is not there: {', '.join(AXES)} are")
        return {}

    def positions(self, axes: Collection[str]) -> dict[str, float]:
        """Read step counts."""
        return {axis: float(self._integer(f"{axis}TP?")) for axis in axes}

    def homed(self, axes: Collection[str]) -> dict[str, bool]:
        """Say which axes were given a zero since the connection was opened."""
        return {axis: axis in self._homed for axis in axes}

    def moving(self) -> bool:
        """Say whether any motor runs."""
        done = [self._integer(f"{axis}MD?") for axis in AXES]
        if not set(done) <= {0, 1}:
            raise self._link.refuse(ReplyError(f"MD? was answered {done}: 0 or 1 was wanted"))
        return 0 in done

    def enable(self, axes: Collection[str], *, since: int) -> None:
        """Do nothing but see that the axes are there and no stop came: its drives are always on."""
        self.travel(axes)
        self._command((), since)

    def home(self, axes: Collection[str], *, since: int) -> None:
        """Count from here; nothing moves."""
        self._command([f"{axis}DH0" for axis in axes], since)
        self._homed |= set(axes)

    def homing(self) -> bool:
        """Say no: it takes no time."""
        return False

    def move(
        self, targets: Mapping[str, float], speeds: Mapping[str, float], halt: Collection[str], *, since: int
    ) -> None:
        """Leave for whole steps, at whole steps a second, one at least."""
        lines = [f"{axis}ST" for axis in halt]
        for axis, target in targets.items():
            lines += [f"{axis}VA{min(max(round(speeds[axis]), 1), TOP_SPEED)}", f"{axis}PA{round(target)}"]
        self._command(lines, since)

    def stop(self) -> None:
        """Abort all motion: at once, from any thread."""
        self._link.interrupt(STOP)

    def emergency_stop(self) -> None:
        """Stop likewise: the drives stay on, or the axes would fall."""
        self.stop()

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _command(self, lines: Collection[str], since: int) -> None:
        code = self._integer("TE?", first=[f"{line}\r".encode() for line in lines], since=since)
        if self.stops != since:
            raise StoppedError(f"{self.identity} was stopped meanwhile")
        # The hundreds say the axis: x01 and x02 are its travel.
        if code > 100 and code % 100 in (1, 2):
            raise LimitError(f"{self.identity} refused with error {code}, beyond the travel")
        if code != 0:
            raise ControllerError(f"{self.identity} refused with error {code}: see TB? in its manual", code)

    def _integer(self, request: str, *, first: Collection[bytes] = (), since: int | None = None) -> int:
        text = self._text(request, first=first, since=since)
        if not re.fullmatch(r"[+-]?[0-9]{1,10}", text):
            raise self._link.refuse(ReplyError(f"{request} was answered {text!r}: a whole number was wanted"))
        return int(text)

    def _text(self, request: str, *, first: Collection[bytes] = (), since: int | None = None) -> str:
        reply = self._link.exchange(f"{request}\r".encode(), whole, since=since, first=tuple(first))
        lines = reply.split(b"\n")
        if len(lines) != 2 or not reply.isascii():
            raise self._link.refuse(ReplyError(f"{request} was answered {reply[:60]!r}: one line was wanted"))
        return lines[0].decode("ascii").strip()
