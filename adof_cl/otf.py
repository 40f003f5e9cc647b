"""Exact optical transfer functions along one axis, formed on the device (kernels/otf.cl)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError, LimitError
from adof_cl.optics import OpticalSystem, PupilGrid, require_finite
from adof_cl.phase_terms import require_envelope, split, split_turns, wrapped_turns
from adof_cl.program import Program

_GROUP = 64


class Otf1d:
    """Form H(u; alpha, psi) of the square stop for fixed frequencies, on the device.

    Built once: compiles, uploads the frequencies, allocates the result. Called often: sets a few numbers and
    enqueues; never waits and copies nothing.

    Parameters
    ----------
    device
        The opened device.
    u : (n,)
        Normalised frequencies, both signs; H is 0 beyond |u| = 2.
    gain : (n, 2) or (n,), optional
        Factors of the real and the imaginary part (one column: of both), such as a pixel's transfer.
    pairs
        How many (alpha, psi) one call forms: rows of the result.
    precision
        "float32" or "float64".

    Raises
    ------
    InputError
        `u` or `gain` is not finite or not of that shape.
    DeviceError
        The device lacks the precision.

    Source
    ------
    The paper's Eq. 2 made exact: docs/maths.md, eqs. O1, O4 and O5. Errors below 4e-7 (float32) and 5e-14
    (float64) for |alpha| <= 1e4, |psi| <= 150.
    """

    def __init__(
        self,
        device: Device,
        u: NDArray[np.float64],
        *,
        gain: NDArray[np.float64] | None = None,
        pairs: int = 1,
        precision: str = "float32",
    ) -> None:
        self.u = np.array(u, dtype=np.float64)
        if self.u.ndim != 1 or not self.u.size:
            raise InputError(f"u has shape {self.u.shape}: a list of at least one frequency was wanted")
        if pairs < 1:
            raise InputError(f"pairs is {pairs}: at least 1 was wanted")
        n = self.u.size
        factors = np.ones((n, 2)) if gain is None else np.asarray(gain, dtype=np.float64)
        if factors.shape == (n,):
            factors = np.repeat(factors[:, None], 2, axis=1)
        if factors.shape != (n, 2):
            raise InputError(f"gain has shape {factors.shape}: ({n}, 2) or ({n},) was wanted")
        if not (np.isfinite(self.u).all() and np.isfinite(factors).all()):
            raise InputError("u or gain holds NaN or infinity: finite numbers were wanted")
        self._real = device.real_type(precision)
        self.out = device.empty((pairs, n), np.result_type(self._real, np.complex64))
        self._pairs = np.zeros((pairs, 2))
        frequencies = device.upload(split(self.u, self._real))
        gains = device.upload(factors.astype(self._real))
        program = Program(device, "otf.cl", {"REAL_IS_DOUBLE": precision == "float64"})
        group = min(_GROUP, device.facts.max_work_group_size)
        numbers = [self._real.type(0)] * 7
        self._launches = [
            program.launch(
                "otf_1d",
                (-(-n // group) * group,),
                (group,),
                frequencies,
                gains,
                self.out,
                np.int32(n),
                np.int32(row),
                *numbers,
            )
            for row in range(pairs)
        ]

    @classmethod
    def for_camera(
        cls,
        device: Device,
        optics: OpticalSystem,
        samples: int,
        *,
        pairs: int = 1,
        precision: str = "float32",
    ) -> Otf1d:
        """Form the transfer along a camera axis of `samples` pixels, DC first, pixel aperture included.

        The Nyquist bin of an even length is real, so that a real image stays real.
        """
        gain = np.repeat(optics.pixel_otf_axis(samples)[:, None], 2, axis=1)
        if samples % 2 == 0:
            gain[samples // 2, 1] = 0.0
        return cls(device, optics.frequency_axis(samples), gain=gain, pairs=pairs, precision=precision)

    def __call__(self, pairs: Sequence[tuple[float, float]] | NDArray[np.float64]) -> DeviceArray:
        """Enqueue the transfer functions of `pairs` of (alpha_rad, psi_rad); return `self.out`.

        Parameters
        ----------
        pairs : (k, 2)
            As many as the plan was made for.

        Returns
        -------
        (k, n) complex
            The plan's own array: the next call overwrites it.

        Raises
        ------
        InputError
            Not that many, not finite, or beyond the limits.
        """
        wanted = np.asarray(pairs, dtype=np.float64)
        if wanted.shape != self._pairs.shape:
            raise InputError(
                f"pairs has shape {wanted.shape}: {self._pairs.shape} of (alpha, psi) was wanted, as planned"
            )
        checked = [require_envelope(float(alpha), float(psi)) for alpha, psi in wanted]
        for launch, (alpha, psi) in zip(self._launches, checked, strict=True):
            for index, value in enumerate(self._numbers(alpha, psi), start=5):
                launch.set(index, value)
            launch()
        return self.out

    def evaluate(self, alpha_rad: float, psi_rad: float) -> NDArray[np.complexfloating[Any, Any]]:
        """Return H at `self.u` on the host; for plans of one pair.

        Raises
        ------
        InputError
            Not finite, beyond the limits, or the plan is for several pairs.
        """
        values: NDArray[np.complexfloating[Any, Any]] = self([(alpha_rad, psi_rad)]).download()[0]
        return values

    def _numbers(self, alpha: float, psi: float) -> list[np.floating[Any]]:
        # The stationary point lies outside the stop otherwise, and the kernel never looks.
        shift = psi**2 / (3 * abs(alpha)) if abs(psi) < 3 * abs(alpha) else 0.0
        numbers = [part for value in (abs(alpha), abs(psi), shift) for part in split_turns(value, self._real)]
        return [*numbers, self._real.type(math.copysign(1.0, alpha))]


def stationary_phase_otf(
    u: NDArray[np.float64], alpha_rad: float, psi_rad: float = 0.0, *, as_printed: bool = False
) -> NDArray[np.complex128]:
    """Return the paper's approximation, to reproduce and to compare: never for a filter.

    Off by 10 to 200 % of |H| where the paper uses it; above 1 near u = 0, where 1 itself is returned.

    Parameters
    ----------
    u : any shape
        Normalised frequency; 0 beyond the cut-off.
    as_printed
        True: Eq. 2 as the paper has it, without its phases pi/4 sgn(alpha u) and -psi^2 u/(3 alpha), so that
        defocus does not enter at all. False: the whole of it.

    Raises
    ------
    InputError
        Not finite, or alpha = 0, where there is no stationary point.

    Source
    ------
    The paper's Eq. 2; docs/maths.md, eq. O6.
    """
    require_finite(alpha_rad=alpha_rad, psi_rad=psi_rad)
    if alpha_rad == 0:
        raise InputError("alpha_rad is 0: the approximation wants a cubic mask, use the exact form")
    at = np.asarray(u, dtype=np.float64)
    safe = np.where(at == 0, 1.0, at)
    phase = alpha_rad * at**3 / 4
    if not as_printed:
        phase = phase - psi_rad**2 * at / (3 * alpha_rad) + np.pi / 4 * np.sign(alpha_rad * at)
    values = np.sqrt(np.pi / (12 * np.abs(alpha_rad * safe))) * np.exp(1j * phase)
    return np.where(at == 0, 1.0, np.where(np.abs(at) > 2, 0.0, values))


class SeparableMaskOtf:
    """Transfer function of a square stop with any phase profile along one axis, by the transform route.

    For masks other than the cubic, whose exact form `Otf1d` is. Built once; a call uploads the profile,
    enqueues, and returns the plan's own array.

    Parameters
    ----------
    device
        The opened device.
    samples
        Cells across the stop, a power of two from 2 to 65536.
    precision
        "float32" or "float64".

    Source
    ------
    docs/maths.md, eq. O10. Grid error about 0.2 (steepest slope)/samples^2.
    """

    def __init__(self, device: Device, samples: int = 4096, *, precision: str = "float32") -> None:
        if samples & (samples - 1):
            raise InputError(f"samples is {samples}: a power of two was wanted")
        self.x = PupilGrid(samples).x
        self.u = 2 * np.arange(samples + 1) / samples
        self._real = device.real_type(precision)
        kind = np.result_type(self._real, np.complex64)
        m = 2 * samples
        self._turns = device.empty((samples,), self._real)
        here, there = device.empty((m,), kind), device.empty((m,), kind)
        roots = device.upload(np.exp(-2j * np.pi * np.arange(samples) / m).astype(kind))
        self.out = device.empty((samples + 1,), kind)
        program = Program(device, "otf.cl", {"REAL_IS_DOUBLE": precision == "float64"})
        self._launches = [
            program.launch("otf_field", (m,), None, self._turns, here, np.int32(samples)),
        ]
        for sign in (-1, 1):
            for s in 2 ** np.arange(m.bit_length() - 1):
                self._launches.append(
                    program.launch(
                        "otf_fft",
                        (samples,),
                        None,
                        here,
                        roots,
                        there,
                        np.int32(m),
                        np.int32(s),
                        np.int32(sign),
                    )
                )
                here, there = there, here
            if sign < 0:
                scale = self._real.type(1 / (m * samples))
                self._launches.append(program.launch("otf_power", (m,), None, here, np.int32(m), scale))
        self._launches.append(
            program.launch("otf_half", (samples + 1,), None, here, self.out, np.int32(samples))
        )

    def __call__(self, profile_rad: NDArray[np.float64]) -> DeviceArray:
        """Enqueue H at `self.u` for a phase profile sampled at `self.x`; return `self.out`.

        Raises
        ------
        InputError
            Another length, NaN or infinity.
        LimitError
            The phase changes by more than pi from one cell to the next.
        """
        profile = np.asarray(profile_rad, dtype=np.float64)
        if profile.shape != self.x.shape:
            raise InputError(f"profile_rad has shape {profile.shape}: {self.x.shape} was wanted, as planned")
        if not np.isfinite(profile).all():
            raise InputError("profile_rad holds NaN or infinity: finite radians were wanted")
        step = float(np.abs(np.diff(profile)).max())
        if step > math.pi:
            raise LimitError(
                f"profile_rad steps by {step:.2f} rad from cell to cell, more than pi: plan at least "
                f"{math.ceil(self.x.size * step / math.pi)} samples"
            )
        self._turns.upload(wrapped_turns(profile, self._real))
        for launch in self._launches:
            launch()
        return self.out

    def evaluate(
        self, profile_rad: NDArray[np.float64], u: NDArray[np.float64] | None = None
    ) -> NDArray[np.complexfloating[Any, Any]]:
        """Return H on the host, at `self.u` or, through a cubic spline, at any frequencies of either sign."""
        values: NDArray[np.complexfloating[Any, Any]] = self(profile_rad).download()
        if u is None:
            return values
        at = np.abs(u)
        spline = CubicSpline(self.u, values.astype(np.complex128))
        half = np.where(at <= 2, spline(np.minimum(at, 2.0)), 0)
        return np.asarray(np.where(u < 0, half.conj(), half), dtype=values.dtype)
