"""What emulated controllers share: lines cut out of bytes, motors on a clock, faults by schedule."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from adof_drivers.emulators.faults import FaultSchedule
from adof_drivers.emulators.motion import Motor

_LONGEST_LINE = 1024


class Disconnected(Exception):  # noqa: N818  (an event of the wire, not an error of the engine)
    """The schedule says that the connection breaks here."""


@dataclass(frozen=True)
class Reply:
    """Bytes to send, and how long to hold them back."""

    data: bytes
    delay_s: float = 0.0


class Engine(ABC):
    """A controller on no wire yet.

    Attributes
    ----------
    motors
        By the controller's names.
    faults
        What goes wrong from now on.
    received
        Lines and single bytes, in order.
    silent_until_s
        What is asked before that is answered then.
    """

    singles: bytes = b""
    """Bytes that act by themselves."""
    limit_code: int
    """What it says at an end switch."""

    def __init__(self, now_s: Callable[[], float], faults: FaultSchedule | None = None) -> None:
        self.motors: dict[str, Motor] = {}
        self.faults = faults or FaultSchedule()
        self.received: list[bytes] = []
        self.silent_until_s = -math.inf
        self._now_s = now_s
        self._buffer = b""

    @property
    def position(self) -> dict[str, float]:
        """Where the axes are, in the wire's units: truth."""
        self._advance()
        return {name: motor.position for name, motor in self.motors.items()}

    @property
    def moving(self) -> bool:
        """Whether anything moves: truth."""
        self._advance()
        return any(motor.moving for motor in self.motors.values())

    def feed(self, data: bytes) -> list[Reply]:
        """Take bytes, however cut, and return the replies they bring about.

        Raises
        ------
        Disconnected
            The schedule breaks the connection here.
        """
        replies = []
        for byte in data:
            if byte in self.singles:  # single bytes act at once, even inside a line
                replies.append(self._receive(bytes([byte])))
            elif byte in (10, 13):
                line, self._buffer = self._buffer, b""
                if line:
                    replies.append(self._receive(line))
            elif byte != 0 and len(self._buffer) < _LONGEST_LINE:  # some clients pad with NUL
                self._buffer += bytes([byte])
        return [reply for reply in replies if reply.data]

    def disconnected(self) -> None:
        """The client has gone: half a line is forgotten. What moves goes on."""
        self._buffer = b""

    @abstractmethod
    def power_cycle(self) -> None:
        """Stand where it stood, knowing nothing of it."""

    @abstractmethod
    def _answer(self, line: bytes) -> bytes:
        """Act on a line, or on a single byte, and give what is sent back."""

    @abstractmethod
    def _force(self, code: int) -> None:
        """Have an error."""

    def _advance(self) -> None:
        now_s = self._now_s()
        for motor in self.motors.values():
            motor.advance(now_s)

    def _receive(self, line: bytes) -> Reply:
        self._advance()
        self.received.append(line)
        delay_s, lost, garbled, forced = 0.0, False, False, None
        for fault in self.faults.due():
            match fault.kind:
                case "delay":
                    delay_s += fault.amount
                case "lose":
                    lost = True
                case "garble":
                    garbled = True
                case "error":
                    forced = int(fault.amount)
                case "disconnect":
                    raise Disconnected
                case "stick":
                    for motor in self.motors.values():
                        motor.stuck = True
                case "limit":
                    for motor in self.motors.values():
                        motor.place(motor.position)
                    forced = self.limit_code
                case "power_cycle":
                    self.power_cycle()
        if forced is not None:
            self._force(forced)
        data = self._answer(line)
        if garbled:
            data = bytes(byte ^ 0x15 if byte != 10 else byte for byte in data)
        delay_s += max(0.0, self.silent_until_s - self._now_s())
        return Reply(b"" if lost else data, delay_s)
