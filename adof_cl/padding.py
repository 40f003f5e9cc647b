"""How a frame is continued beyond its edges, so that a periodic transform does it no harm."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError
from adof_cl.fft_passes import cost_of
from adof_cl.finite import checked_shape, finite_array
from adof_cl.optics import require_whole

SMALLEST_SIDE = 8
LARGEST_SIDE = 4096
LARGEST_PADDED_SIDE = 16384


def good_size(at_least: int) -> int:
    """Return the length to transform for `at_least` samples: a product of 2, 3, 5 and 7.

    That length itself if it is one. Else the next, or one up to a sixteenth longer whose passes cost less:
    512 samples are transformed sooner than 500.

    Raises
    ------
    InputError
        Not a whole number of 1 or more.
    """
    require_whole(at_least=at_least)
    longest = at_least + at_least // 16
    found = [n for n in range(at_least, longest + 1) if _is_product(n)]
    if found and found[0] == at_least:
        return found[0]
    if not found:
        found = [next(n for n in itertools.count(longest) if _is_product(n))]
    return min(found, key=lambda n: n * cost_of(n, 16))


def _is_product(n: int) -> bool:
    for prime in (2, 3, 5, 7):
        while n % prime == 0:
            n //= prime
    return n == 1


def checked_frame_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """Refuse anything but two sides of 8 to 4096."""
    whole = all(isinstance(side, (int, np.integer)) for side in shape)
    if len(shape) != 2 or not whole or not all(SMALLEST_SIDE <= side <= LARGEST_SIDE for side in shape):
        raise InputError(
            f"the frame's shape is {tuple(shape)}: (rows, columns) of {SMALLEST_SIDE} to {LARGEST_SIDE} each "
            "were wanted"
        )
    return int(shape[0]), int(shape[1])


def padded_shape(shape: tuple[int, int], padding: int | tuple[int, int]) -> tuple[int, int]:
    """Return the transform's (ny, nx) of a frame of `shape` with at least `padding` samples added.

    Raises
    ------
    InputError
        A frame beyond the limits, a negative padding, or one that makes an axis longer than 16384.
    """
    rows, columns = checked_frame_shape(shape)
    pair = tuple(padding) if isinstance(padding, Sequence) else (padding, padding)
    if len(pair) != 2 or not all(isinstance(p, (int, np.integer)) and p >= 0 for p in pair):
        raise InputError(f"padding is {padding}: one whole number or (rows, columns), 0 or more, was wanted")
    ny, nx = good_size(rows + int(pair[0])), good_size(columns + int(pair[1]))
    if max(ny, nx) > LARGEST_PADDED_SIDE:
        raise InputError(
            f"padding is {padding}: the padded frame would be {ny} x {nx}, at most {LARGEST_PADDED_SIDE} a "
            "side was wanted"
        )
    return ny, nx


def padding_weights(samples: int, taper: bool) -> NDArray[np.float64]:
    """Return the share of the near edge in each sample of the padding.

    The padding lies behind the far edge and, the transform being periodic, before the near one: it starts as
    a copy of the far edge (0) and ends as a copy of the near edge (1), by a raised cosine or by a step.

    Raises
    ------
    InputError
        Not a whole number of 0 or more samples.

    Source
    ------
    docs/maths.md, eq. W4.
    """
    require_whole(0, samples=samples)
    t = np.arange(samples)
    if taper:
        return np.asarray(np.sin(np.pi / 2 * (t + 1) / (samples + 1)) ** 2, dtype=np.float64)
    return (t >= samples - samples // 2).astype(np.float64)


def padded_frame(frame: NDArray[Any], padded: tuple[int, int], *, taper: bool = True) -> NDArray[np.float64]:
    """Return the frame at [0, 0] of a larger array, continued as `padding_weights` says, on the host.

    Raises
    ------
    InputError
        A frame that is no (rows, columns), holds NaN or infinity, or is larger than `padded`.

    Source
    ------
    docs/maths.md, eq. W3.
    """
    image = finite_array("the frame", frame, (None, None))
    rows, columns = checked_shape("padded", padded)
    if rows < image.shape[0] or columns < image.shape[1]:
        raise InputError(f"padded is {(rows, columns)}: at least the frame's {image.shape} was wanted")
    for axis in (0, 1):
        w = padding_weights(padded[axis] - image.shape[axis], taper)
        near, far = np.take(image, [0], axis), np.take(image, [-1], axis)
        w = w[:, None] if axis == 0 else w[None, :]
        image = np.concatenate([image, (1 - w) * far + w * near], axis=axis)
    return image
