"""Contenders that do the same work, checked and then timed in turns, and the noise of what comes out.

They take turns in one process, one untimed call before each timed one, and a ratio is the median of the
ratios of each round: what disturbs the machine for a while disturbs both.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adof_cl.device import Device
from adof_cl.errors import AdofError
from adof_cl.peers import Peer

Shape = tuple[int, int]
Clock = Callable[[], float]


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of `count` samples."""

    median: float
    low: float
    high: float
    count: int

    @classmethod
    def of(cls, samples: Sequence[float]) -> Spread:
        """Summarise at least one sample."""
        low, median, high = np.quantile(np.asarray(samples, dtype=np.float64), (0.25, 0.5, 0.75))
        return cls(float(median), float(low), float(high), len(samples))

    def apart_from(self, other: Spread) -> bool:
        """Whether the quartile ranges do not overlap: the rule by which `compare` calls a change real."""
        return self.low > other.high or self.high < other.low


@dataclass
class Contender:
    """Something ready to be timed.

    Attributes
    ----------
    run
        One call; returns when the work is done.
    error
        How far the last call's result is from float64, never a NaN that would pass.
    units
        Pieces of work in one call.
    traffic
        Bytes its kernels must read and write at least.
    """

    name: str
    run: Callable[[], object]
    error: Callable[[], float]
    bound: float
    units: float = 1
    traffic: int = 0
    version: str = ""
    options: dict[str, Any] = field(default_factory=dict)


Builder = Callable[[Device], Contender]


@dataclass(frozen=True)
class Case:
    """One operation in one form at one size (rows, columns).

    Attributes
    ----------
    prepare
        Makes the inputs, so that building `ours` costs what it costs a user.
    ours
        Builds our contender on a device.
    rivals
        Who takes turns with it when these peers are there, by name.
    """

    operation: str
    form: str
    size: Shape
    pixels: int
    measure: str
    prepare: Callable[[], object]
    ours: Builder
    rivals: Callable[[Sequence[Peer]], dict[str, Builder]] = lambda _peers: {}
    precision: str = "float32"

    @property
    def name(self) -> str:
        """Operation, form and size (columns x rows)."""
        return case_name(self.operation, self.form, self.size)


def case_name(operation: str, form: str, size: Shape) -> str:
    """Return how results name a case; size (rows, columns), shown as columns x rows."""
    return f"{operation} {form} {size[1]}x{size[0]}"


@dataclass(frozen=True)
class Rounds:
    """How often: at least `fewest`, at most `most`, no more once `budget_s` are spent."""

    fewest: int = 11
    most: int = 41
    budget_s: float = 5.0


QUICK = Rounds(5, 5, 0.0)


def take_turns(
    contenders: Sequence[Callable[[], object]], rounds: Rounds, clock: Clock = time.perf_counter
) -> list[list[float]]:
    """Time each contender once a round, after one untimed call; return seconds, (contenders, rounds).

    Who begins changes from round to round.
    """
    times: list[list[float]] = [[] for _ in contenders]
    began = clock()
    for turn in range(rounds.most):
        for place in range(len(contenders)):
            index = (turn + place) % len(contenders)
            contenders[index]()
            start = clock()
            contenders[index]()
            times[index].append(clock() - start)
        if turn + 1 >= rounds.fewest and clock() - began > rounds.budget_s:
            break
    return times


def ratio(ours: Sequence[float], theirs: Sequence[float], units: float = 1.0) -> Spread:
    """Return their time over ours, round by round; `units` of our work are done in one call of theirs."""
    return Spread.of([t / o / units for o, t in zip(ours, theirs, strict=True)])


def check(contender: Contender) -> str:
    """Run once and say what is wrong with the result; an empty string when nothing is."""
    try:
        contender.run()
        error = contender.error()
    except Exception as failure:  # noqa: BLE001 (whatever a library or driver throws is this contender's failure)
        return sentence(failure)
    if not error <= contender.bound:
        return f"wrong result: error {error:.2g}, at most {contender.bound:.2g} was wanted"
    return ""


def sentence(failure: Exception) -> str:
    """Return an error in one line, with its kind if it is not one of ours."""
    text = " ".join(str(failure).split())
    return text if isinstance(failure, AdofError) else f"{type(failure).__name__}: {text}"
