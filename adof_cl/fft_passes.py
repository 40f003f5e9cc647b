"""How a transform of one axis is cut into passes, with their tables.

A length of factors 2, 3, 5 and 7 becomes a few in-place passes of small butterflies (docs/maths.md, eq. W5):
decimation in frequency forward, decimation in time back, so that digit-reversed order is never undone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError

# What a pass costs for each sample, by radix: with its turns, and as the last pass, which has none.
#
# In vectors: nanoseconds measured on one core, the samples in its nearest cache: PoCL with 16 registers,
# Intel's runtime with 32. Larger radices lose what they save where their samples do not fit the registers.
# In scalars: operations counted from restore_butterflies.h, and eight for a pass's loads, stores and turns.
_COSTS: dict[int, dict[int, tuple[float, float]]] = {
    16: {
        2: (0.54, 0.54), 3: (0.77, 0.55), 4: (0.70, 0.54), 5: (1.18, 0.75), 6: (1.06, 0.72), 7: (1.85, 1.27),
        8: (1.44, 0.91), 9: (2.01, 1.58), 10: (1.95, 1.31), 12: (1.94, 1.26), 15: (2.25, 1.54),
    },
    32: {
        2: (1.10, 0.61), 3: (1.49, 1.12), 4: (1.38, 1.09), 5: (2.01, 1.30), 6: (1.96, 1.45), 7: (2.68, 1.90),
        8: (1.98, 1.76), 9: (2.56, 1.85), 10: (2.63, 1.66), 12: (2.89, 1.99), 15: (4.19, 2.26),
    },
    0: {
        radix: (operations + 8, operations + 8)
        for radix, operations in (
            (2, 2), (3, 5.3), (4, 4), (5, 7.2), (6, 7.3), (7, 9.4), (8, 7), (9, 12.4), (10, 9.2), (12, 9.3),
            (15, 12.5),
        )
    },
}  # fmt: skip


@cache
def radices_of(n: int, registers: int = 0) -> tuple[int, ...]:
    """Split a transform into the passes that cost least: the largest first, but for the last.

    Composite lengths get two passes at least: what is done to the first is not done to the last.
    """
    *others, last = _cheapest(n, registers)[1] or (1,)
    return (*sorted(others, reverse=True), last) if n > 1 else ()


def cost_of(n: int, registers: int) -> float:
    """Return what the passes of `n` samples cost for each sample."""
    return _cheapest(n, registers)[0]


@cache
def _cheapest(n: int, registers: int) -> tuple[float, tuple[int, ...]]:
    @cache
    def best(rest: int) -> tuple[float, tuple[int, ...]]:
        found: tuple[float, tuple[int, ...]] = (math.inf, ())
        for radix, (turned, last) in _COSTS[registers].items():
            if rest == radix and (rest < n or n in (2, 3, 5, 7)):
                found = min(found, (last, (radix,)))
            elif rest % radix == 0 and rest > radix:
                cost, tail = best(rest // radix)
                found = min(found, (turned + cost, (radix, *tail)))
        return found

    if n == 1:
        return 0.0, ()
    found = best(n) if isinstance(n, (int, np.integer)) and n > 1 else (math.inf, ())
    if math.isinf(found[0]):
        raise InputError(f"{n} samples came: a whole number without factors but 2, 3, 5 and 7 was wanted")
    return found


@dataclass(frozen=True)
class Passes:
    """How one axis is transformed in place: decimation in frequency, docs/maths.md, eq. W5.

    Attributes
    ----------
    length
        Samples.
    radices
        Of the passes, in forward order.
    """

    length: int
    radices: tuple[int, ...]

    @classmethod
    def of(cls, length: int, registers: int = 0) -> Passes:
        """Choose the passes of a length whose prime factors are 2, 3, 5 and 7.

        Parameters
        ----------
        registers
            How many vectors the registers hold, 16 or 32; 0: scalars.
        """
        return cls(length, radices_of(length, registers))

    def passes(self) -> list[tuple[int, int, int]]:
        """Return (radix, stride, offset of its twiddles in `turns`) of each pass."""
        listed, rest, offset = [], self.length, 0
        for radix in self.radices:
            rest //= radix
            listed.append((radix, rest, offset))
            offset += 2 * (radix - 1) * rest
        return listed

    def turns(self) -> NDArray[np.float64]:
        """Return cos and -sin of 2 pi j q / (radix * stride): pass by pass, j, then q from 1."""
        pieces = []
        for radix, stride, _ in self.passes():
            j, q = np.arange(stride)[:, None], np.arange(1, radix)[None, :]
            angle = 2 * np.pi * (j * q % (radix * stride)) / (radix * stride)
            pieces.append(np.stack([np.cos(angle), -np.sin(angle)], axis=-1).ravel())
        return np.concatenate(pieces)

    def position(self) -> NDArray[np.int32]:
        """Return where each frequency lies after the passes."""
        frequency = np.arange(self.length)
        place = np.zeros(self.length, dtype=np.int64)
        for radix, stride, _ in self.passes():
            place += frequency % radix * stride
            frequency //= radix
        return place.astype(np.int32)

    def order(self) -> NDArray[np.int32]:
        """Return which frequency lies at each place: the inverse of `position`."""
        order = np.empty(self.length, dtype=np.int32)
        order[self.position()] = np.arange(self.length, dtype=np.int32)
        return order


def pass_lists(row: Passes, column: Passes) -> str:
    """Write the passes as macro lists: C can loop over them only if the radix is a literal.

    Of each axis: the first pass, those between (forward and, BACK, in reverse) and the last; and the length
    of the parts the first pass leaves, each of which the others transform by itself.
    """

    def listed(name: str, passes: Sequence[tuple[int, int, int]]) -> str:
        return f"#define {name}(P) " + " ".join(f"P({r}, {m}, {t})" for r, m, t in passes)

    lines = []
    for name, axis in (("ROW", row.passes()), ("COLUMN", column.passes())):
        lines += [
            listed(f"{name}_FIRST", axis[:1]),
            listed(f"{name}_MIDDLE", axis[1:-1]),
            listed(f"{name}_MIDDLE_BACK", axis[-2:0:-1]),
            listed(f"{name}_LAST", axis[-1:]),
            f"#define {name}_INNER {axis[0][1]}",
        ]
    return "\n".join([*lines, ""])
