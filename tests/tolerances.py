"""Error limits, each derived from the arithmetic that causes it.

eps is the unit of the working precision, n the length or size the rounding errors run over. A limit that no
derivation supports does not belong here.
"""

from __future__ import annotations

import math

import numpy as np

# ---- general ----------------------------------------------------------------------------------------------


def eps(precision: str) -> float:
    """Spacing of 1 in the working precision."""
    return float(np.finfo(precision).eps)


def fft_relative_l2(precision: str, size: int) -> float:
    """Relative L2 limit of a forward and inverse transform of `size` points in all.

    Rounding errors of a mixed-radix transform add like a random walk over log2(size) stages, twice; each
    stage costs at most about 1 eps of rms. Higham, Accuracy and Stability, theorem 24.2, gives the log.
    """
    return eps(precision) * (2 + 0.5 * math.log2(max(size, 2)))
