"""Noise-to-signal power: checked when given, estimated from the frame when not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from adof_cl.errors import InputError
from adof_cl.finite import checked_shape, finite_array, require_transfer
from adof_cl.padding import padded_frame

NSR_LIMIT = 1e12
"""Above it a filter restores nothing, and a float32 kernel could no longer form it."""

_CLASSES = 60
_MEMBERS = 8
_DECADES = 14
_STEPS_PER_DECADE = 20


def checked_nsr(nsr: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return `nsr`, a number or one for each frequency, as float64.

    Raises
    ------
    InputError
        Another shape, not finite, below 0, or above `NSR_LIMIT`.
    """
    values = finite_array("nsr", nsr, () if np.ndim(nsr) == 0 else shape)
    lowest = float(values.min())
    if lowest < 0:
        raise InputError(f"nsr is {lowest:g}: a noise-to-signal power of 0 or more was wanted")
    highest = float(values.max())
    if highest > NSR_LIMIT:
        raise InputError(f"nsr is {highest:g}: at most {NSR_LIMIT:g} was wanted, where nothing is restored")
    return values


def noise_to_signal(
    frame: NDArray[np.generic],
    otf: NDArray[np.complexfloating],
    padded: tuple[int, int],
    *,
    taper: bool = True,
) -> NDArray[np.float64]:
    """Estimate the noise-to-signal power of each frequency from the blurred frame itself.

    The scene's power is taken to fall as 1/f^2, as that of most pictures does, and the noise as white. Two
    numbers, the scene's strength and the noise's, are fitted to the frame's periodogram: its medians over
    classes of equal expected signal, on a logarithmic scale, so that neither the few strong frequencies nor
    the many noisy ones decide alone.

    Parameters
    ----------
    frame
        (rows, columns), as it will be restored.
    otf
        (ny, nx // 2 + 1), DC at [0, 0].
    padded
        (ny, nx).
    taper
        As the frame will be padded.

    Returns
    -------
    NDArray[np.float64]
        (ny, nx // 2 + 1), above 0, lowest at DC.

    Raises
    ------
    InputError
        NaN or infinity in the frame, or an OTF of another size, not finite, or above `TRANSFER_LIMIT`.

    Source
    ------
    docs/maths.md, eqs. W7 and W8.
    """
    ny, nx = checked_shape("padded", padded)
    if otf.shape != (ny, nx // 2 + 1):
        raise InputError(f"otf is {otf.shape}, {(ny, nx // 2 + 1)} was wanted: form it for the padded frame")
    if otf.dtype.kind not in "fciu" or not np.isfinite(otf).all():
        raise InputError("otf holds NaN, infinity or no numbers: a finite transfer function was wanted")
    require_transfer("otf", otf)
    image = finite_array("the frame", frame, (None, None))
    # The result has no unit; without this the power of a frame in a large one would overflow.
    image = image / max(float(np.abs(image).max()), 1e-300)
    spectrum = scipy.fft.rfft2(padded_frame(image - image.mean(), padded, taper=taper))
    power = np.abs(spectrum) ** 2 / (ny * nx)
    f_squared = np.fft.fftfreq(ny)[:, None] ** 2 + np.fft.rfftfreq(nx)[None, :] ** 2
    scene = 1 / (f_squared + 1 / max(ny, nx) ** 2)
    expected = np.abs(otf) ** 2 * scene
    return np.asarray(_noise_over_scene(expected.ravel()[1:], power.ravel()[1:]) / scene)


def _noise_over_scene(expected: NDArray[np.float64], power: NDArray[np.float64]) -> float:
    """Fit power = c (expected + t) and return t (eq. W8)."""
    highest = float(expected.max())
    if highest <= 0 or power.max() <= 0:  # nothing passes the optics, or the frame is flat: restore nothing
        return 1.0
    floor = highest * 10.0**-_DECADES
    # Frequencies the optics do not pass at all hold nothing but noise: one class, the lowest.
    edges = np.geomspace(floor, highest, _CLASSES)
    member = np.searchsorted(edges, expected)
    order = np.argsort(member, kind="stable")
    bounds = np.searchsorted(member[order], np.arange(_CLASSES + 1))
    levels, signals = [], []
    for low, high in pairwise(bounds):
        chosen = order[low:high]
        level = float(np.median(power[chosen])) if chosen.size >= _MEMBERS else 0.0
        if level > 0:
            levels.append(np.log(level))
            signals.append(float(np.median(expected[chosen])))
    candidates = np.geomspace(floor, highest, _DECADES * _STEPS_PER_DECADE)
    residual = np.array(levels)[None, :] - np.log(np.array(signals)[None, :] + candidates[:, None])
    spread = np.var(residual, axis=1)
    return float(candidates[np.argmin(spread)])
