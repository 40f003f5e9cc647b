"""What an emulated motor and controller must be for a client's tests to mean anything."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.motion import Motor
from adof_drivers.emulators.serve import Served
from adof_drivers.errors import RequestError
from stage_rigs import ManualClock


@given(start=st.floats(1, 24), target=st.floats(0, 25), speed=st.floats(1, 5), acceleration=st.floats(5, 200))
@settings(max_examples=60, deadline=None)
def test_a_motor_keeps_speed_and_acceleration_and_arrives_in_a_trapezoids_time(
    start: float, target: float, speed: float, acceleration: float
) -> None:
    motor = Motor(0.0, 25.0, speed=speed, acceleration=acceleration, position=start)
    motor.go(target)
    way = abs(target - start)
    ramp = speed**2 / acceleration
    ideal_s = way / speed + speed / acceleration if way >= ramp else 2 * math.sqrt(way / acceleration)
    positions, velocities, now_s = [start], [0.0], 0.0
    # Braking begins a step early and ends in shorter and shorter ones: a few steps of 1 ms, and a fifth.
    while motor.moving and now_s < 1.2 * ideal_s + 0.05:
        now_s += 1e-3
        motor.advance(now_s)
        positions.append(motor.position)
        velocities.append(motor.velocity)
    assert motor.position == target
    assert now_s >= ideal_s * 0.95 - 0.01
    assert max(map(abs, velocities)) <= speed * (1 + 1e-9)
    changes = [b - a for a, b in itertools.pairwise(velocities)]
    assert max(map(abs, changes), default=0.0) <= 2 * acceleration * 1e-3 * (1 + 1e-9)
    low, high = min(start, target), max(start, target)
    overshoot = 2 * acceleration * 1e-6
    assert all(low - overshoot <= position <= high + overshoot for position in positions)


def test_a_motor_that_is_halted_runs_out_its_braking_distance() -> None:
    motor = Motor(0.0, 25.0, speed=5.0, acceleration=50.0, position=0.0)
    motor.go(20.0)
    motor.advance(1.0)
    at = motor.position
    motor.halt()
    motor.advance(3.0)
    assert motor.position - at == pytest.approx(5.0**2 / (2 * 50.0), abs=1e-9)
    assert not motor.moving


def test_a_line_means_the_same_however_it_is_cut() -> None:
    script = b"SVO 1 1\nFRF\nVEL 1 2.5\nMOV 1 20\nMOV? 1\nVEL?\n\x05ERR?\nNO\nERR?\n"
    clock = ManualClock()

    def replies(size: int) -> bytes:
        engine = GcsEngine(now_s=lambda: clock.now_s)
        pieces = [script[i : i + size] for i in range(0, len(script), size)]
        return b"".join(reply.data for piece in pieces for reply in engine.feed(piece))

    assert replies(len(script)) == b"1=20.0000000\n1=2.5000000\n1\n0\n2\n"
    assert all(replies(size) == replies(len(script)) for size in (1, 2, 3, 7))


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"MOV 1 3 9 3", 15),
        (b"MOV 1 3 2 99", 7),
        (b"MOV 1 3 2 x", 17),
        (b"MOV 1 3 2 nan", 17),
        (b"MOV 1 3 2", 17),
        (b"MOV 1 3 1 4", 15),
        (b"VEL 1 1 2 99", 17),
        (b"XYZ 1", 2),
        (b"SVO 1 1 2 7", 17),
        (b"\xff\xfe", 2),
    ],
)
def test_a_line_acts_whole_or_not_at_all(line: bytes, code: int) -> None:
    clock = ManualClock()
    engine = GcsEngine(("1", "2"), now_s=lambda: clock.now_s)
    engine.feed(b"SVO 1 1 2 1\nFRF\nERR?\n")
    state = b"MOV?\nVEL?\nSVO?\n"
    before = engine.feed(state)
    engine.feed(line + b"\n")
    assert engine.feed(b"ERR?\nERR?\n")[0].data == f"{code}\n".encode()
    assert engine.feed(state) == before


def test_a_fault_schedule_is_the_same_for_the_same_seed() -> None:
    def drawn(seed: int) -> list[list[Fault]]:
        schedule = FaultSchedule.seeded(seed, count=20, lines=30)
        return [list(schedule.due()) for _ in range(30)]

    assert drawn(7) == drawn(7)
    assert drawn(7) != drawn(8)
    assert sum(map(len, drawn(7))) == 20


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.2", "example.org", "::"])
def test_an_emulator_listens_on_loopback_only(host: str) -> None:
    with pytest.raises(RequestError, match="outside"):
        Served.tcp(GcsEngine(now_s=lambda: 0.0), host)
