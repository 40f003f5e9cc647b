"""One case per operation: known inputs, the device's answer, the reference's answer and the bound.

`adof selftest` and the tests share these known answers; the sizes below are the tests' own: next to nothing,
primes, lengths of many factors, more than one block or tile of every kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

from adof_cl.selftest import OPERATIONS, Check, Size


@dataclass(frozen=True)
class Case:
    """How an operation is checked, and at which sizes."""

    check: Check
    precisions: tuple[str, ...]
    sizes: tuple[Size, ...]


_SIZES: dict[str, tuple[Size, ...]] = {
    "pupil_phase": ((3, 2), (31, 257)),
    "slm_encode": ((7, 5), (67, 131)),
    "otf": ((1, 9), (7, 129)),
    "psf": ((4, 4), (32, 32)),
    "wiener": ((2, 3), (24, 49), (17, 64)),
    "restore": ((19, 37),),  # compiled anew for every size: test_restore.py has the others
    "image_prep": ((4, 5), (19, 131)),
    "ssd_search": ((17, 12), (41, 127)),
}

CASES: dict[str, Case] = {
    name: Case(operation.check, operation.precisions, _SIZES[name]) for name, operation in OPERATIONS.items()
}
