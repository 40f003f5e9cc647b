"""All the mathematics in float64 NumPy: the specification, and what every kernel is tested against.

Read this first. One function per operation, named like its kernel file, its plan, its tests and its case.
Nothing on the run-time path may import this module; an import contract holds it. Equation numbers are those of
docs/maths.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fresnel

# ---- pupil_phase ------------------------------------------------------------------------------------------

# ---- slm_encode -------------------------------------------------------------------------------------------

# ---- otf --------------------------------------------------------------------------------------------------

# ---- psf --------------------------------------------------------------------------------------------------

# ---- wiener -----------------------------------------------------------------------------------------------

# ---- restore ----------------------------------------------------------------------------------------------

# ---- image_prep -------------------------------------------------------------------------------------------

# ---- ssd_search -------------------------------------------------------------------------------------------
