"""Exact optical transfer functions along one axis, formed on the device (kernels/otf.cl)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain, pairwise
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError, LimitError
from adof_cl.finite import require_transfer
from adof_cl.optics import OpticalSystem, PupilGrid, require_whole
from adof_cl.phase_terms import ALPHA_LIMIT_RAD, PSI_LIMIT_RAD, require_envelope, wrapped_turns
from adof_cl.program import Launch, Program, vector_bytes

FAMILIES = ("lanes", "groups")

_GROUP = 64
_ITEMS_PER_UNIT = 4  # so that no core waits long for the last
_TURN = 1 / (2 * math.pi)
_FEW = 8
_LIMITS_RAD = np.array([ALPHA_LIMIT_RAD, PSI_LIMIT_RAD])
_PAIR_BYTES = 896  # by value: with the other arguments within the 1024 that every device takes


class Otf1d:
    """Form H(u; alpha, psi) of the square stop for fixed frequencies, on the device.

    Built once: compiles, uploads what depends on the frequencies, allocates the result. Called often: one
    launch for 56 pairs (28 in float64); never waits and copies nothing.

    Of a run of frequencies that is a transform's axis (0, then both signs of the others, as
    `numpy.fft.fftfreq` has them) half is evaluated; the rest is its mirror image, H(-u) = conj H(u), and
    H(0) = 1 is written when the plan is built.

    Parameters
    ----------
    device
        The opened device.
    u : (n,)
        Normalised frequencies, both signs, of one axis or of several; H is 0 beyond |u| = 2.
    gain : (n, 2) or (n,), optional
        Factors of the real and the imaginary part (one column: of both), such as a pixel's transfer.
    pairs
        How many (alpha, psi) one call forms: rows of the result.
    precision
        "float32" or "float64".
    family
        "lanes": as many frequencies at once as a vector holds. "groups": one frequency to a work-item.
        By default lanes on a CPU, groups elsewhere.

    Raises
    ------
    InputError
        `u` or `gain` is not finite or not of that shape, or there is no such family.
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
        family: str | None = None,
    ) -> None:
        self.u = np.array(u, dtype=np.float64)
        if self.u.ndim != 1 or not self.u.size:
            raise InputError(f"u has shape {self.u.shape}: a list of at least one frequency was wanted")
        require_whole(pairs=pairs)
        n = self.u.size
        factors = np.ones((n, 2)) if gain is None else np.asarray(gain, dtype=np.float64)
        if factors.shape == (n,):
            factors = np.repeat(factors[:, None], 2, axis=1)
        if factors.shape != (n, 2):
            raise InputError(f"gain has shape {factors.shape}: ({n}, 2) or ({n},) was wanted")
        if not (np.isfinite(self.u).all() and np.isfinite(factors).all()):
            raise InputError("u or gain holds NaN or infinity: finite numbers were wanted")
        require_transfer("gain", factors)
        self.family = family or ("lanes" if device.facts.kind == "cpu" else "groups")
        if self.family not in FAMILIES:
            raise InputError(f"family is '{family}': choose 'lanes' or 'groups'")
        self._real = device.real_type(precision)
        self._pairs_shape = (pairs, 2)

        width = vector_bytes(device) if self.family == "lanes" else 0
        places, members = _blocks(self.u, factors, max(width // self._real.itemsize, 1))
        terms, least = _terms(self.u, factors, members, self._real)
        blocks = len(places)
        at_once = np.zeros((pairs, n), np.result_type(self._real, np.complex64))
        at_once[:] = np.where(self.u == 0, factors[:, 0], 0)
        self.out = device.upload(at_once)

        # Pairs go by value, `most` to a launch: pair; alpha, psi; hi, lo.
        most = _PAIR_BYTES // (4 * self._real.itemsize)
        self._turns = np.zeros((-(-pairs // most) * most, 2, 2), self._real)
        self._numbers = cast("memoryview[float]", self._turns.reshape(-1).data)
        self._launches: list[Launch] = []
        if not blocks:  # nothing but H(0)
            return
        program = Program(
            device,
            "otf.cl",
            {"REAL_IS_DOUBLE": precision == "float64", "VECTOR_BYTES": width, "OTF_PAIRS": most},
        )
        shared = [device.upload(array) for array in (terms, places, least)]
        for first in range(0, pairs, most):
            rows = min(most, pairs - first)
            each, group = 1, min(_GROUP, device.facts.max_work_group_size)
            if width:
                items = _ITEMS_PER_UNIT * device.facts.compute_units
                each, group = min(-(-blocks * rows // items), blocks), 1
            self._launches.append(
                program.launch(
                    "otf_1d",
                    (-(-blocks // (each * group)) * group, rows),
                    (group, 1),
                    *shared,
                    self.out,
                    *(np.int32(number) for number in (n, blocks, each, first)),
                    self._argument(len(self._launches)),
                )
            )

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
        return cls.for_frame(device, optics, (samples,), pairs=pairs, precision=precision)

    @classmethod
    def for_frame(
        cls,
        device: Device,
        optics: OpticalSystem,
        shape: Sequence[int],
        *,
        pixel: bool = True,
        pairs: int = 1,
        precision: str = "float32",
    ) -> Otf1d:
        """Form the transfer along each axis of a camera frame, one axis after the other, each DC first.

        Parameters
        ----------
        shape
            Samples of each axis.
        pixel
            Whether the pixel's aperture is included.

        The Nyquist bin of an even length is real, so that a real image stays real.

        Raises
        ------
        InputError
            No axis, or one of no whole number of samples.
        """
        require_whole(axes=len(shape))
        for samples in shape:
            require_whole(samples=samples)
        gains = []
        for samples in shape:
            gain = np.repeat(
                (optics.pixel_otf_axis(samples) if pixel else np.ones(samples))[:, None], 2, axis=1
            )
            if samples % 2 == 0:
                gain[samples // 2, 1] = 0.0
            gains.append(gain)
        u = np.concatenate([optics.frequency_axis(samples) for samples in shape])
        return cls(device, u, gain=np.concatenate(gains), pairs=pairs, precision=precision)

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
        if wanted.shape != self._pairs_shape:
            raise InputError(
                f"pairs has shape {wanted.shape}: {self._pairs_shape} of (alpha, psi) was wanted, as planned"
            )
        if len(wanted) <= _FEW:
            self._set_few(wanted.tolist())
        else:
            self._set_many(wanted)
        for index, launch in enumerate(self._launches):
            launch.set(8, self._argument(index))
            launch()
        return self.out

    def _set_few(self, pairs: list[list[float]]) -> None:
        # What a loop does every frame: NumPy takes longer to begin than this does altogether.
        place = 0
        for alpha, psi in pairs:
            if not (abs(alpha) <= ALPHA_LIMIT_RAD and abs(psi) <= PSI_LIMIT_RAD):
                require_envelope(alpha, psi)  # says what is wrong
        for value in chain.from_iterable(pairs):
            turns = value * _TURN
            self._numbers[place] = turns
            self._numbers[place + 1] = turns - self._numbers[place]
            place += 2

    def _set_many(self, pairs: NDArray[np.float64]) -> None:
        if not (np.abs(pairs) <= _LIMITS_RAD).all():
            for alpha, psi in pairs.tolist():
                require_envelope(alpha, psi)
        turns = pairs * _TURN
        parts = self._turns[: len(turns)]
        parts[..., 0] = turns
        parts[..., 1] = turns - parts[..., 0]

    def _argument(self, launch: int) -> np.void:
        most = _PAIR_BYTES // (4 * self._real.itemsize)
        return np.void(self._turns[launch * most : (launch + 1) * most].tobytes())

    def evaluate(self, alpha_rad: float, psi_rad: float) -> NDArray[np.complexfloating[Any, Any]]:
        """Return H at `self.u` on the host; for plans of one pair.

        Raises
        ------
        InputError
            Not finite, beyond the limits, or the plan is for several pairs.
        """
        values: NDArray[np.complexfloating[Any, Any]] = self([(alpha_rad, psi_rad)]).download()[0]
        return values


def _blocks(
    u: NDArray[np.float64], gain: NDArray[np.float64], lanes: int
) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Cut frequencies into blocks of `lanes`, leaving out what is a mirror image.

    Returns
    -------
    places : (blocks, 4)
        Where a block's first goes, where that one's mirror image goes (-1: none), how many it holds, 0.
    members : (blocks, lanes)
        Which frequency each lane has; lanes to spare repeat the last.
    """
    places, members = [], []
    for start, stop in pairwise(np.unique([0, *np.flatnonzero(u == 0), u.size]).tolist()):
        mirrored = _is_transform_axis(u[start:stop], gain[start:stop])
        first, last = (start + 1, (start + stop) // 2 + 1) if mirrored else (start, stop)
        for i in range(first, last, lanes):
            places.append((i, start + stop - i if mirrored else -1, min(lanes, last - i), 0))
            members.append(np.minimum(np.arange(i, i + lanes), last - 1))
    return np.array(places, np.int32).reshape(-1, 4), np.array(members, np.intp).reshape(-1, lanes)


def _is_transform_axis(u: NDArray[np.float64], gain: NDArray[np.float64]) -> bool:
    """Whether u is 0, then frequencies whose negatives follow in reverse, each with the same gain."""
    upper = np.arange(1, (u.size + 1) // 2)
    lower = u.size - upper
    return bool(u[0] == 0 and (u[upper] == -u[lower]).all() and (gain[upper] == gain[lower]).all())


def _terms(
    u: NDArray[np.float64], gain: NDArray[np.float64], members: NDArray[np.intp], real: np.dtype[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return what the kernel needs of each frequency, and `least` of each block: see kernels/otf.cl."""
    w = np.minimum(np.abs(u), 2.0)
    b = 1 - w / 2
    root = np.sqrt(w)
    # Below, the phase of every mask is short, and the kernel does not look.
    over_root = np.divide(1, root, out=np.zeros_like(w), where=w > 1e-9)
    run, slope = w * (2 - w), 6 * w * b
    inside = np.abs(u) < 2
    phases = [half for value in (w * (3 - w * (3 - w)), run, w**3 / 4, w) for half in _halves(value, real)]
    gains = [gain[:, 0] * inside, gain[:, 1] * inside * np.sign(u)]
    terms = np.stack([*phases, 2 * w, slope, b, root, over_root, *gains]).astype(real)[:, members]
    lanes = members.shape[1]
    terms = terms.transpose(1, 0, 2) if lanes > 1 else terms[..., 0]
    least = np.stack(
        [run[members].min(axis=1, initial=2), (slope * b)[members].min(axis=1, initial=2)], axis=1
    )
    return np.ascontiguousarray(terms), least.astype(real)


def _halves(
    values: NDArray[np.float64], real: np.dtype[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Split values into a part with half of a real's bits and the rest (docs/maths.md, eq. P3)."""
    bits = (np.finfo(real).nmant + 1) // 2
    mantissa, exponent = np.frexp(values)
    coarse = np.ldexp(np.rint(np.ldexp(mantissa, bits)), exponent - bits)
    return coarse, values - coarse


_WEAKEST_RAD = 1e-9


def stationary_phase_otf(
    u: NDArray[np.float64], alpha_rad: float, psi_rad: float = 0.0, *, as_printed: bool = False
) -> NDArray[np.complex128]:
    """Return the paper's approximation, to reproduce and to compare: never for a filter.

    Off by 10 to 200 % of |H| where the paper uses it; above 1 near u = 0, below |u| = 1e-9 1 itself.

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
        Not finite, or alpha below 1e-9, where there is no stationary point.
    LimitError
        Beyond the measured range.

    Source
    ------
    The paper's Eq. 2; docs/maths.md, eq. O6.
    """
    require_envelope(alpha_rad, psi_rad)
    if abs(alpha_rad) < _WEAKEST_RAD:
        raise InputError(
            f"alpha_rad is {alpha_rad:g}: the approximation wants a cubic mask of {_WEAKEST_RAD:g} or more, "
            "use the exact form"
        )
    at = np.asarray(u, dtype=np.float64)
    if not np.isfinite(at).all():
        raise InputError("u holds NaN or infinity: finite frequencies were wanted")
    at = np.where(np.abs(at) < _WEAKEST_RAD, 0.0, np.clip(at, -3, 3))
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
        require_whole(2, samples=samples)
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
        """Return H on the host, at `self.u` or, through a cubic spline, at any frequencies of either sign.

        Raises
        ------
        InputError, LimitError
            As the call does, or a frequency that is no finite number.
        """
        if u is not None and not (np.asarray(u).dtype.kind in "fiu" and np.isfinite(u).all()):
            raise InputError("u holds NaN, infinity or no numbers: finite frequencies were wanted")
        values: NDArray[np.complexfloating[Any, Any]] = self(profile_rad).download()
        if u is None:
            return values
        at = np.abs(u)
        spline = CubicSpline(self.u, values.astype(np.complex128))
        half = np.where(at <= 2, spline(np.minimum(at, 2.0)), 0)
        return np.asarray(np.where(u < 0, half.conj(), half), dtype=values.dtype)
