"""What a restoration promises before any frame is seen: how loud its noise is, and how fine its detail.

Both follow from the blur and the filter alone, in float64 on the host (docs/maths.md, eqs. W10 and W11).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adof_cl.errors import InputError
from adof_cl.finite import TRANSFER_LIMIT, checked_shape, require_transfer
from adof_cl.noise import checked_nsr
from adof_cl.optics import require_positive

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RestorationQuality:
    """Noise and detail of a restored image.

    Attributes
    ----------
    noise_gain
        Standard deviation of white noise after the restoration, over that before; inside the frame, a blur's
        width from its edges.
    contrast : (ny, nx // 2 + 1)
        Contrast that is left of a pattern of each frequency, 1 at DC: of scene to restored image, pixel
        included if the OTF includes it.
    half_contrast_period_xy_px : (2,)
        Period of the finest lines, along x and along y, up to which everything coarser keeps half its
        contrast; 2, the finest a frame can hold, where nothing falls below half.
    """

    noise_gain: float
    contrast: Array
    half_contrast_period_xy_px: Array

    def half_contrast_period_um(self, object_pitch_um: float) -> float:
        """Return the coarser of the two periods on the object, given its width of a pixel.

        Raises
        ------
        InputError
            Not positive.
        """
        require_positive(object_pitch_um=object_pitch_um)
        return float(self.half_contrast_period_xy_px.max() * object_pitch_um)


def restoration_quality(
    otf: NDArray[np.complexfloating[Any, Any]], nsr: ArrayLike, padded: tuple[int, int]
) -> RestorationQuality:
    """Predict noise and detail of the Wiener restoration of a known blur.

    Parameters
    ----------
    otf : (ny, nx // 2 + 1)
        DC first, as `numpy.fft.rfft2` orders it; H(0) above 0.
    nsr
        Noise to signal power, a number or one for each frequency, as the filter is formed with.
    padded
        (ny, nx).

    Raises
    ------
    InputError
        Another shape, not finite, an OTF above 1e3 anywhere or below 1e-3 at DC, or a negative nsr.
    """
    ny, nx = checked_shape("padded", padded)
    half = np.asarray(otf)
    if half.shape != (ny, nx // 2 + 1) or half.dtype.kind not in "fciu" or not np.isfinite(half).all():
        raise InputError(
            f"the OTF is {half.shape} {half.dtype}: finite numbers of shape {(ny, nx // 2 + 1)} were wanted"
        )
    half = half.astype(np.complex128)
    require_transfer("the OTF", half)
    if abs(half[0, 0]) < 1 / TRANSFER_LIMIT:
        raise InputError(
            f"the OTF is {abs(half[0, 0]):g} at DC: a blur that passes {1 / TRANSFER_LIMIT:g} or more of the "
            "light was wanted"
        )
    power = np.abs(half) ** 2
    noise = checked_nsr(nsr, (ny, nx // 2 + 1))
    seen = power > 0
    gain = np.divide(np.abs(half), power + noise, out=np.zeros(half.shape), where=seen)
    # A real image's spectrum stands for its mirror image too, but for the columns that are their own.
    twice = np.full(half.shape[1], 2.0)
    twice[0] = 1.0
    if nx % 2 == 0:
        twice[-1] = 1.0
    noise_gain = math.sqrt(float((gain**2 @ twice).sum()) / (ny * nx))
    passed = np.abs(half) * gain
    contrast = passed / passed[0, 0]
    along_y, along_x = contrast[: ny // 2 + 1, 0], contrast[0]
    return RestorationQuality(
        noise_gain=noise_gain,
        contrast=contrast,
        half_contrast_period_xy_px=np.array(
            [_half_contrast_period(along_x, nx), _half_contrast_period(along_y, ny)]
        ),
    )


def _half_contrast_period(contrast: Array, samples: int) -> float:
    """Return where the contrast first falls to a half, linearly between samples, as a period in pixels."""
    below = np.flatnonzero(contrast < 0.5)
    if not below.size:
        return 2.0
    k = int(below[0])
    before = k - 1 + float((contrast[k - 1] - 0.5) / (contrast[k - 1] - contrast[k]))
    return samples / before
