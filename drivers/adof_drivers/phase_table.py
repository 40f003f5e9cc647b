"""From measured phase to codes, and from a vendor's correction picture to phase."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from adof_drivers.errors import DriverError

_TURN = 2 * math.pi
_MOST_TURNS = 1e3


def code_table(phase_rad: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the code for each 256th of a turn: the one whose measured phase comes nearest, modulo a turn.

    The table to give `adof_cl.slm_encode.SlmEncode`; the panel itself is left linear, nothing is uploaded.

    Parameters
    ----------
    phase_rad
        (256,) phase of each code as measured at the wavelength in use; any offset, in either direction.

    Raises
    ------
    DriverError
        Another shape, not finite, more than 1000 turns, or not one way only: codes were mixed up, or the
        phase was not unwrapped.
    """
    phase = np.asarray(phase_rad, dtype=np.float64)
    if phase.shape != (256,) or not np.isfinite(phase).all():
        raise DriverError(f"phase_rad is {phase.shape}: 256 finite numbers were wanted, one for each code")
    if np.ptp(phase) > _MOST_TURNS * _TURN:
        raise DriverError(
            f"phase_rad spans {np.ptp(phase):g} rad: at most {_MOST_TURNS:g} turns was wanted: check its unit"
        )
    steps = np.diff(phase)
    if not ((steps >= 0).all() or (steps <= 0).all()) or phase[0] == phase[-1]:
        raise DriverError(
            "phase_rad goes up and down: it must rise or fall from code 0 to 255; unwrap it, or smooth the "
            "measurement"
        )
    wanted = np.arange(256) * (_TURN / 256)
    off = wanted[:, None] - (phase - phase[0])[None, :]
    off -= _TURN * np.rint(off / _TURN)
    return np.asarray(np.abs(off).argmin(axis=1), dtype=np.uint8)


def read_phase_csv(path: Path) -> NDArray[np.float64]:
    """Read lines `code,phase_rad`, one for each code from 0 to 255, with or without a heading.

    Raises
    ------
    DriverError
        Unreadable, or codes missing, double or beyond 255.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as failure:
        raise DriverError(f"{path} cannot be read ({failure})") from failure
    phase = np.full(256, np.nan)
    for count, line in enumerate(filter(None, map(str.strip, text.splitlines()))):
        try:
            first, second = line.split(",")
            code, value = int(first), float(second)
        except ValueError:
            if count == 0:
                continue
            raise DriverError(f"{path}: '{line}' is not `code,phase_rad`") from None
        if not 0 <= code <= 255 or not np.isnan(phase[code]) or not math.isfinite(value):
            raise DriverError(f"{path}: '{line}': each code from 0 to 255 was wanted once, its phase finite")
        phase[code] = value
    missing = np.flatnonzero(np.isnan(phase))
    if missing.size:
        raise DriverError(f"{path} lacks {missing.size} codes, the first of them {missing[0]}")
    return phase


def read_correction_rad(
    pictures: Mapping[float, Path], wavelength_nm: float, shape: tuple[int, int], *, within_nm: float = 5.0
) -> NDArray[np.float64]:
    """Return a panel's flatness correction, radians modulo a turn, from the vendor's picture.

    What `SlmEncode` takes as `correction_rad`: it is added before the table. Grey g of 256 stands for g/256
    of a turn at the wavelength the picture was made for. It is not scaled to another one, though the panel's
    error is a length: the picture has lost its whole turns.

    Parameters
    ----------
    pictures
        Wavelength in nm → BMP or PNG, 8-bit grey.
    wavelength_nm
        In use; the nearest picture is taken if it is at most `within_nm` away.
    shape
        Rows and columns of the panel.

    Raises
    ------
    DriverError
        No picture near enough; unreadable, not grey, or of another size.
    """
    if not 0 < wavelength_nm < math.inf:
        raise DriverError(f"wavelength_nm is {wavelength_nm}: a wavelength above 0 was wanted")
    nearest = min(pictures, key=lambda made_for: abs(made_for - wavelength_nm), default=math.inf)
    if abs(nearest - wavelength_nm) > within_nm:
        there = ", ".join(f"{made_for:g}" for made_for in sorted(pictures)) or "none"
        raise DriverError(
            f"no correction for {wavelength_nm:g} nm (there are: {there}): get it from the panel's vendor"
        )
    path = pictures[nearest]
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise DriverError(f"{path} is not a readable picture: check the file")
    grey = np.asarray(picture)
    if grey.ndim == 3:  # 8-bit BMPs are often written in colour
        if not (grey[..., :1] == grey[..., :3]).all():
            raise DriverError(f"{path} has colours: a grey picture was wanted")
        grey = grey[..., 0]
    if grey.shape != shape or grey.dtype != np.uint8:
        raise DriverError(f"{path} is {grey.shape} {grey.dtype}: {shape} uint8 was wanted, the panel's")
    return grey.astype(np.float64) * (_TURN / 256)
