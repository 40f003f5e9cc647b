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

# Vector operations per sample of each small transform, counted from restore_butterflies.h; a pass adds its
# twiddles, loads and stores.
_OPERATIONS = {2: 2, 3: 5.3, 4: 4, 5: 7.2, 6: 7.3, 7: 9.4, 8: 7, 9: 12.4, 10: 9.2, 12: 9.3, 15: 12.5}
_PASS_COST = 8.0


@cache
def radices_of(n: int) -> tuple[int, ...]:
    """Split a transform into the passes that cost least, largest first."""

    @cache
    def best(rest: int, largest: int) -> tuple[float, tuple[int, ...]]:
        if rest == 1:
            return 0.0, ()
        found: tuple[float, tuple[int, ...]] = (math.inf, ())
        for radix, operations in _OPERATIONS.items():
            if radix <= largest and rest % radix == 0:
                cost, tail = best(rest // radix, radix)
                found = min(found, (cost + operations + _PASS_COST, (radix, *tail)))
        return found

    return best(n, max(_OPERATIONS))[1]


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
    def of(cls, length: int) -> Passes:
        """Choose the passes of a length whose prime factors are 2, 3, 5 and 7."""
        return cls(length, radices_of(length))

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
    """Write the passes as macro lists: C can loop over them only if the radix is a literal."""

    def listed(name: str, passes: Sequence[tuple[int, int, int]]) -> str:
        return f"#define {name}(P) " + " ".join(f"P({r}, {m}, {t})" for r, m, t in passes)

    rows, columns = row.passes(), column.passes()
    return "\n".join(
        [
            listed("ROW_PASSES", rows),
            listed("ROW_PASSES_BACK", rows[::-1]),
            listed("COLUMN_PASSES", columns[:-1]),
            listed("COLUMN_PASSES_BACK", columns[-2::-1]),
            f"#define COLUMN_LAST(P) P({columns[-1][0]})",
            "",
        ]
    )
