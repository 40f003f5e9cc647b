r"""A PI controller that speaks GCS 2.0: bytes in, bytes out, on any clock; no threads.

engine = GcsEngine(("1", "2"), now_s=time.monotonic)
engine.feed(b"POS? 1 2\n")      # [Reply(b"1=0.000000 \n2=0.000000\n", due_s=...)]
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from adof_drivers.emulators.engine import Engine
from adof_drivers.emulators.faults import FaultSchedule
from adof_drivers.emulators.motion import Motor

_HELP = """The following commands are valid:
#5 REQUEST MOTION STATUS
#7 REQUEST CONTROLLER READY STATUS
#24 STOP ALL MOTION
*IDN? GET DEVICE IDENTIFICATION
CST? [{<AxisID>}] GET ASSIGNMENT OF STAGES TO AXES
CSV? GET CURRENT SYNTAX VERSION
ERR? GET ERROR NUMBER
FRF [{<AxisID>}] FAST REFERENCE MOVE TO REFERENCE SWITCH
FRF? [{<AxisID>}] GET REFERENCING RESULT
HLP? GET LIST OF AVAILABLE COMMANDS
HLT [{<AxisID>}] HALT MOTION SMOOTHLY
JOG {<AxisID> <Velocity>} START MOTION WITH GIVEN VELOCITY
JOG? [{<AxisID>}] GET VELOCITY OF JOG MOTION
MOV {<AxisID> <Position>} SET TARGET POSITION
MOV? [{<AxisID>}] GET TARGET POSITION
MVR {<AxisID> <Distance>} SET TARGET RELATIVE TO CURRENT TARGET
ONT? [{<AxisID>}] GET ON TARGET STATE
POS? [{<AxisID>}] GET REAL POSITION
SAI? [ALL] GET LIST OF CURRENT AXIS IDENTIFIERS
STP STOP ALL MOTION
SVO {<AxisID> <State>} SET SERVO STATE
SVO? [{<AxisID>}] GET SERVO STATE
TMN? [{<AxisID>}] GET MINIMUM COMMANDABLE POSITION
TMX? [{<AxisID>}] GET MAXIMUM COMMANDABLE POSITION
TRS? [{<AxisID>}] INDICATE REFERENCE SWITCH
VEL {<AxisID> <Velocity>} SET CLOSED-LOOP VELOCITY
VEL? [{<AxisID>}] GET CLOSED-LOOP VELOCITY
VER? GET VERSION
end of help
"""
_REFERENCING_S = 0.5
_LONGEST_LINE = 1024


class _Refused(Exception):  # noqa: N818
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class GcsEngine(Engine):
    """Axes 0 to 25 mm, 5 mm/s, 50 mm/s^2, servo off and not referenced.

    Parameters
    ----------
    now_s
        The clock.
    faults
        What goes wrong.
    command_set
        What CSV? says.
    """

    singles = b"\x05\x07\x18"
    limit_code = 7

    def __init__(
        self,
        axes: Sequence[str] = ("1",),
        *,
        now_s: Callable[[], float],
        faults: FaultSchedule | None = None,
        identity: str = "(c)2026 adof, Emulated C-863.12, 0, 1.2.0",
        command_set: str = "2.0",
        travel: tuple[float, float] = (0.0, 25.0),
        speed: float = 5.0,
        acceleration: float = 50.0,
    ) -> None:
        self.identity, self.command_set = identity, command_set
        super().__init__(now_s, faults)
        self._travel, self._speed, self._acceleration = travel, speed, acceleration
        self._names = tuple(axes)
        self.power_cycle()

    def power_cycle(self) -> None:
        """Stand where it stood, knowing nothing of it."""
        for name in self._names:
            stood = self.motors[name].position if name in self.motors else sum(self._travel) / 2
            self.motors[name] = Motor(
                *self._travel, speed=self._speed, acceleration=self._acceleration, position=stood
            )
            self.motors[name].advance(self._now_s())
        self._servo = dict.fromkeys(self._names, False)
        self._homed = dict.fromkeys(self._names, False)
        self._jogs = dict.fromkeys(self._names, 0.0)
        self._error = 0
        self._ready_s = -math.inf

    def _force(self, code: int) -> None:
        if code == -1024:  # what a servo says that gave up
            self._servo = dict.fromkeys(self._names, False)
            self._halt(self._names)
        self._error = code

    def _answer(self, line: bytes) -> bytes:
        try:
            return self._act(line)
        except _Refused as refusal:
            self._error = refusal.code
            return b""

    def _act(self, line: bytes) -> bytes:
        if line == b"\x05":
            mask = sum(1 << i for i, motor in enumerate(self.motors.values()) if motor.moving)
            return f"{mask:X}\n".encode()
        if line == b"\x07":
            return b"\xb0\n" if self._now_s() < self._ready_s else b"\xb1\n"
        if line == b"\x18":
            return self._stop()
        try:
            words = line.decode("ascii").split()
        except UnicodeDecodeError:
            raise _Refused(2) from None
        if not words:
            return b""
        command, arguments = words[0].upper(), words[1:]
        whole = {
            "*IDN?": self.identity,
            "CSV?": self.command_set,
            "VER?": "FW_DSP: 1.2.0",
            "HLP?": _HELP.removesuffix("\n").replace("\n", " \n"),
        }
        if command in whole:
            return f"{whole[command]}\n".encode()
        if command == "ERR?":
            code, self._error = self._error, 0
            return f"{code}\n".encode()
        if command == "SAI?":
            return (" \n".join(self._names) + "\n").encode()
        if command == "STP":
            return self._stop()
        if command.endswith("?"):
            return self._ask(command, arguments)
        self._command(command, arguments)
        return b""

    def _ask(self, command: str, arguments: list[str]) -> bytes:
        show: Mapping[str, Callable[[str], str]] = {
            "POS?": lambda axis: f"{self.motors[axis].position:.7f}",
            "MOV?": lambda axis: f"{self.motors[axis].target:.7f}",
            "VEL?": lambda axis: f"{self.motors[axis].speed:.7f}",
            "JOG?": lambda axis: f"{self._jogs[axis]:.7f}",
            "TMN?": lambda axis: f"{self.motors[axis].low:.7f}",
            "TMX?": lambda axis: f"{self.motors[axis].high:.7f}",
            "SVO?": lambda axis: str(int(self._servo[axis])),
            "FRF?": lambda axis: str(int(self._homed[axis])),
            "TRS?": lambda _axis: "1",
            "ONT?": lambda axis: str(int(not self.motors[axis].moving)),
            "CST?": lambda _axis: "M-EMULATED",
        }
        if command not in show:
            raise _Refused(2)
        axes = self._known(arguments or list(self._names))
        return (" \n".join(f"{axis}={show[command](axis)}" for axis in axes) + "\n").encode()

    def _command(self, command: str, arguments: list[str]) -> None:
        if command in ("HLT", "FRF"):
            axes = self._known(arguments or list(self._names))
            if command == "HLT":
                self._halt(axes)
                self._error = 10
            else:
                self._reference(axes)
            return
        if command not in ("MOV", "MVR", "VEL", "SVO", "JOG"):
            raise _Refused(2)
        if len(arguments) % 2 or not arguments:
            raise _Refused(17)
        axes = self._known(arguments[::2])
        try:
            values = dict(zip(axes, map(float, arguments[1::2]), strict=True))
        except ValueError:
            raise _Refused(17) from None
        if not all(map(math.isfinite, values.values())):
            raise _Refused(17)
        # All or nothing: every value is checked before the first acts.
        if command == "SVO":
            if not set(values.values()) <= {0.0, 1.0}:
                raise _Refused(17)
            self._servo |= {axis: value == 1.0 for axis, value in values.items()}
            self._halt([axis for axis, value in values.items() if value == 0.0])
        elif command == "VEL":
            if not all(0 <= value <= self.motors[axis].top_speed for axis, value in values.items()):
                raise _Refused(17)
            for axis, value in values.items():
                self.motors[axis].speed = value
        else:
            if not all(self._servo[axis] and self._homed[axis] for axis in axes):
                raise _Refused(5)
            if command == "JOG":
                self._jog(values)
            else:
                self._go(values, relative=command == "MVR")

    def _go(self, values: dict[str, float], *, relative: bool) -> None:
        ends = {a: v + (self.motors[a].target if relative else 0.0) for a, v in values.items()}
        if not all(self.motors[axis].low <= end <= self.motors[axis].high for axis, end in ends.items()):
            raise _Refused(7)
        for axis, end in ends.items():
            self.motors[axis].go(end)
            self._jogs[axis] = 0.0

    def _jog(self, values: dict[str, float]) -> None:
        if not all(abs(value) <= self.motors[axis].top_speed for axis, value in values.items()):
            raise _Refused(17)
        for axis, value in values.items():
            self.motors[axis].jog(value)
            self._jogs[axis] = value

    def _reference(self, axes: Sequence[str]) -> None:
        if not all(self._servo[axis] for axis in axes):
            raise _Refused(5)
        for axis in axes:
            if not self.motors[axis].stuck:
                self.motors[axis].place(sum(self._travel) / 2)
                self._homed[axis] = True
        self._ready_s = self._now_s() + _REFERENCING_S

    def _halt(self, axes: Sequence[str]) -> None:
        for axis in axes:
            self.motors[axis].halt()
            self._jogs[axis] = 0.0

    def _stop(self) -> bytes:
        self._halt(self._names)
        if self._now_s() < self._ready_s:
            self._homed = dict.fromkeys(self._names, False)
            self._ready_s = -math.inf
        self._error = 10
        return b""

    def _known(self, axes: list[str]) -> list[str]:
        if not all(axis in self.motors for axis in axes) or len(set(axes)) != len(axes):
            raise _Refused(15)
        return axes
