"""A Picomotor 8742 that speaks its wire: four axes of steps, always on, counting from 0 at power-up."""

from __future__ import annotations

import re
from collections.abc import Callable

from adof_drivers.emulators.engine import Engine
from adof_drivers.emulators.faults import FaultSchedule
from adof_drivers.emulators.motion import Motor

_AXES = ("1", "2", "3", "4")
_FARTHEST = 2**31 - 1
_MEANINGS = {0: "NO ERROR DETECTED", 6: "COMMAND DOES NOT EXIST", 7: "PARAMETER OUT OF RANGE",
             9: "AXIS NUMBER OUT OF RANGE", 14: "MOTION IN PROGRESS",
             38: "COMMAND PARAMETER MISSING"}  # fmt: skip
# "0>" or "1>" before a command addresses this controller in a chain.
_LINE = re.compile(r"(?:[01]>)?(\d*)([A-Z]{2})(\?|[+-]?\d*|[+-])")


class PicomotorEngine(Engine):
    """Four motors; 1750 steps/s, 100 000 steps/s^2.

    Parameters
    ----------
    now_s
        The clock.
    faults
        What goes wrong.
    """

    limit_code = 101

    def __init__(
        self,
        *,
        now_s: Callable[[], float],
        faults: FaultSchedule | None = None,
        identity: str = "New_Focus 8742 v2.2 08/01/13 10023",
    ) -> None:
        super().__init__(now_s, faults)
        self.identity = identity
        self.power_cycle()

    def power_cycle(self) -> None:
        """Count from 0, here."""
        for name in _AXES:
            self.motors[name] = Motor(-_FARTHEST, _FARTHEST, speed=1750.0, acceleration=1e5)
            self.motors[name].advance(self._now_s())
        self._errors: list[int] = []

    def _force(self, code: int) -> None:
        self._errors.append(code)

    def _answer(self, line: bytes) -> bytes:
        text = line.decode("ascii", "replace").strip().upper()
        if text == "*IDN?":
            return f"{self.identity}\r\n".encode()
        match = _LINE.fullmatch(text)
        if match is None:
            return self._refuse(6)
        axis, command, argument = match.groups()
        if command == "TE" and argument == "?":
            return f"{self._errors.pop() if self._errors else 0}\r\n".encode()
        if command == "TB" and argument == "?":
            code = self._errors.pop() if self._errors else 0
            return f"{code}, {_MEANINGS.get(code % 100, 'SEE THE MANUAL')}\r\n".encode()
        if command in ("AB", "ST") and not axis:
            for motor in self.motors.values():
                motor.place(motor.position) if command == "AB" else motor.halt()
            return b""
        if axis not in self.motors:
            return self._refuse(9)
        motor = self.motors[axis]
        return self._ask(command, motor) if argument == "?" else self._act(command, argument, axis)

    def _ask(self, command: str, motor: Motor) -> bytes:
        answers = {
            "TP": round(motor.position),
            "PA": round(motor.target),
            "VA": round(motor.speed),
            "AC": round(motor.acceleration),
            "MD": int(not motor.moving),
            "DH": 0,
            "QM": 3,
        }
        return f"{answers[command]}\r\n".encode() if command in answers else self._refuse(6)

    def _act(self, command: str, argument: str, axis: str) -> bytes:
        motor = self.motors[axis]
        if command == "ST":
            motor.halt()
            return b""
        if command == "MV" and argument in ("+", "-"):
            motor.jog(motor.speed if argument == "+" else -motor.speed)
            return b""
        if command not in ("PA", "PR", "VA", "AC", "DH"):
            return self._refuse(6)
        if not argument.lstrip("+-"):
            return self._refuse(38)
        value = int(argument)
        low, high = {"VA": (1, 2000), "AC": (1, 200000)}.get(command, (-_FARTHEST, _FARTHEST))
        if not low <= value <= high:
            return self._refuse(7)
        if motor.moving:  # a controller may be more lenient; a client must not count on it
            return self._refuse(100 * int(axis) + 14)
        match command:
            case "PA":
                motor.go(float(value))
            case "PR":
                motor.go(round(motor.position) + float(value))
            case "VA":
                motor.speed = float(value)
            case "AC":
                motor.acceleration = float(value)
            case "DH":
                motor.place(float(value))
        return b""

    def _refuse(self, code: int) -> bytes:
        self._errors.append(code)
        return b""
