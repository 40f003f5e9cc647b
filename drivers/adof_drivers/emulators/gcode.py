"""An open-hardware micromanipulator (MicroManipulatorStepper) that speaks its G-code: bytes in, bytes out.

G0 and G1 queue straight segments, each from rest to rest; nothing but M18, which switches the motors off,
ends one early. M50 is the end of the last segment that was accepted, whatever has become of it. M17 measures
and takes what it finds for the pose. Log lines come unasked. Known: G0 G1 G4 G28 M17 M18 M50 M52 M53 M57 M58
M204; another M has no answer at all.

Source: behaviour as read in the project's published firmware, v1.0.5; no code of it is here.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from adof_drivers.emulators.engine import Engine
from adof_drivers.emulators.faults import FaultSchedule
from adof_drivers.emulators.motion import Motor

_AXES = ("X", "Y", "Z")
_JOINTS = 3
_QUEUE = 64
_BUFFERING_S = 0.05
"""How long the first segment waits for others, unless it says I."""
_STEP_S = 1e-3
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class _Segment:
    start: Pose
    end: Pose
    speed: float = 0.0
    acceleration: float = 0.0
    dwell_s: float = 0.0


class GcodeEngine(Engine):
    """Three axes, 5 mm to either side of home, motors off and not homed; 500 mm/s^2.

    Parameters
    ----------
    now_s
        The clock.
    faults
        What goes wrong. At an end of travel it drops the path and wants to be homed.
    version
        What M58 says.
    homing_s
        How long G28 takes, in which nothing is answered.
    """

    limit_code = 7

    def __init__(
        self,
        *,
        now_s: Callable[[], float],
        faults: FaultSchedule | None = None,
        version: str = "v1.0.5",
        homing_s: float = 2.0,
        travel: float = 5.0,
    ) -> None:
        super().__init__(now_s, faults)
        self.version = version
        self._homing_s, self._travel = homing_s, travel
        self.power_cycle()

    def power_cycle(self) -> None:
        """Stand where it stood, knowing nothing of it."""
        for name in _AXES:
            stood = self.motors[name].position if name in self.motors else 1.0
            self.motors[name] = Motor(
                -self._travel, self._travel, speed=1.0, acceleration=1.0, position=stood
            )
        self._powered = self._halted = False
        self._homed = [False] * _JOINTS
        self._pose = self._measured()
        self._speed, self._acceleration = 10.0, 500.0
        self._queue: deque[_Segment] = deque()
        self._running: tuple[_Segment, Motor] | None = None
        self._next_s = -math.inf  # how far the path has come in time, or when it may begin
        self._forced: str | None = None

    @property
    def moving(self) -> bool:
        """Whether anything moves: truth."""
        self._advance()
        return self._powered and not self._finished()

    def _measured(self) -> Pose:
        x, y, z = (self.motors[name].position for name in _AXES)
        return (x, y, z)

    def _finished(self) -> bool:
        return self._running is None and not self._queue and self._next_s <= self._now_s()

    def _force(self, code: int) -> None:
        if code == self.limit_code:
            self._halted = True
            self._queue.clear()
            self._running = None
        self._forced = "joint limit" if code == self.limit_code else f"fault {code}"

    def _advance(self) -> None:
        now_s = self._now_s()
        while True:
            if self._running is None:
                if not self._queue or self._next_s > now_s:
                    return
                segment = self._queue.popleft()
                path = Motor(0.0, math.inf, speed=segment.speed, acceleration=segment.acceleration or 1.0)
                path.advance(self._next_s)
                path.go(math.dist(segment.start, segment.end))
                self._running = segment, path
            segment, path = self._running
            while path.moving and self._next_s < now_s:
                self._next_s = min(self._next_s + _STEP_S, now_s)
                path.advance(self._next_s)
            self._follow(segment, path)
            if path.moving:
                return
            self._running = None
            self._next_s += segment.dwell_s

    def _follow(self, segment: _Segment, path: Motor) -> None:
        length = math.dist(segment.start, segment.end)
        share = path.position / length if length else 1.0
        for name, start, end in zip(_AXES, segment.start, segment.end, strict=True):
            motor = self.motors[name]
            if self._powered and not motor.stuck:
                motor.place(end if share == 1.0 else start + share * (end - start))

    def _answer(self, line: bytes) -> bytes:
        if self._forced is not None:
            text, self._forced = self._forced, None
            return f"error: {text}\n".encode()
        tokens = [token for token in line.decode("latin-1").split(" ") if token]
        if not tokens or not "A" <= tokens[0][0] <= "Z":
            return b"error: malformed command\n"
        if not all("A" <= token[0] <= "Z" for token in tokens[1:]):
            return b"error: invalid parameter\n"
        command, words = tokens[0], {token[0]: _number(token[1:]) for token in tokens[1:]}
        if command in ("G0", "G1", "G4"):
            return self._enqueue(command, words)
        if command == "G28":
            return self._home(words)
        if command.startswith("M"):
            return self._machine(command, words)
        return b"error: unknown command\n"

    def _machine(self, command: str, words: dict[str, float]) -> bytes:
        match command:
            case "M17":
                self._pose = self._measured()
                self._powered = True
                return b"ok\n"
            case "M18":
                self._powered = False
                return b"ok\n"
            case "M50":
                x, y, z = self._pose
                return f"X{x:.6f} Y{y:.6f} Z{z:.6f}\nok\n".encode()
            case "M52":
                return f"Queue Size: {len(self._queue) + (self._running is not None)}\nok\n".encode()
            case "M53":
                return f"{int(self._finished())}\nok\n".encode()
            case "M57":
                return self._report().encode()
            case "M58":
                return f"{self.version}\nok\n".encode()
            case "M204":
                self._acceleration = words.get("L", self._acceleration)
                return b"ok\n"
        return b""

    def _report(self) -> str:
        joints = "".join(
            f"Joint {i}:  is_homed={int(homed)},  is_calibrated=1,  encoder_angle=0.000000 deg\n"
            for i, homed in enumerate(self._homed)
        )
        return joints + "Servo Loop: 30 kHz\nMotion Controler: 2000 Hz\nFiles on flash: \n  ok\nok\n"

    def _enqueue(self, command: str, words: dict[str, float]) -> bytes:
        if not all(self._homed):
            return b"error: not all joints calibrated and homed\n"
        if self._halted:
            return b"error: motion limit fault; home before moving\n"
        if len(self._queue) + (self._running is not None) >= _QUEUE:
            return b"busy\n"
        if command == "G4":
            segment = _Segment(
                self._pose, self._pose, dwell_s=words.get("P", 0.0) / 1e3 + words.get("S", 0.0)
            )
        else:
            x, y, z = (words.get(name, at) for name, at in zip(_AXES, self._pose, strict=True))
            speed = words.get("F", self._speed)
            if not speed > 0:
                return b"error: invalid feedrate or acceleration\n"
            if not all(abs(value) <= self._travel for value in (x, y, z)):
                return b"error: invalid inverse kinematics at path endpoint\n"
            self._speed = speed
            segment = _Segment(self._pose, (x, y, z), speed, self._acceleration)
            self._pose = (x, y, z)
        if self._finished():
            self._next_s = self._now_s() + (0.0 if "I" in words else _BUFFERING_S)
        self._queue.append(segment)
        return b"ok\nI)Starting segment\r\n"

    def _home(self, words: dict[str, float]) -> bytes:
        if not set(words) <= set("ABCDEF"):
            return b"error: Unsupported parameter found\n"
        wanted = [i for i in range(_JOINTS) if "ABC"[i] in words] or list(range(_JOINTS))
        self.silent_until_s = self._next_s = self._now_s() + self._homing_s
        self._queue.clear()
        self._running = None
        self._powered, self._halted = True, False
        said = "I)homing...\r\n"
        for i in wanted:
            motor = self.motors[_AXES[i]]
            self._homed[i] = not motor.stuck
            if motor.stuck:
                said += f"E)homing joint {i} failed\r\n"
            else:
                motor.place(0.0)
        self._pose = self._measured()
        return (said + ("ok\n" if all(self._homed[i] for i in wanted) else "error\n")).encode()


def _number(text: str) -> float:
    """Read what a number begins with, as C's strtof does; 0 where none does."""
    match = _NUMBER.match(text)
    return float(match[0]) if match else 0.0
