"""What goes wrong on the wire, and when: counted in lines received, so that a run repeats exactly."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from random import Random
from typing import Literal, get_args

Kind = Literal["delay", "lose", "garble", "error", "disconnect", "stick", "limit", "power_cycle"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes
    ----------
    kind
        `delay` or `lose` or `garble` the next reply; answer with `error` code; `disconnect`; from now on
        `stick` all axes; hit the `limit` switch of all; forget everything as after a `power_cycle`.
    at
        Which line received, from 0.
    amount
        Seconds of a delay; code of an error.
    """

    kind: Kind
    at: int
    amount: float = 0.0


class FaultSchedule:
    """Faults by line; each happens once."""

    def __init__(self, faults: Iterable[Fault] = ()) -> None:
        self._faults = sorted(faults, key=lambda fault: fault.at)
        self._line = -1

    @classmethod
    def seeded(cls, seed: int, *, count: int, lines: int, kinds: tuple[Kind, ...] = KINDS) -> FaultSchedule:
        """Return `count` faults spread over the first `lines` lines, the same for the same seed."""
        chance = Random(seed)  # noqa: S311  (repeatable, not secret)
        return cls(
            Fault(
                kind := chance.choice(kinds),
                chance.randrange(lines),
                {"delay": chance.uniform(0.005, 0.05), "error": chance.choice((2, 5, 7, 17, -1024))}.get(
                    kind, 0.0
                ),
            )
            for _ in range(count)
        )

    def due(self) -> Iterator[Fault]:
        """Count a line and give its faults."""
        self._line += 1
        while self._faults and self._faults[0].at <= self._line:
            yield self._faults.pop(0)
