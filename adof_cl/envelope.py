"""The envelope: how far inputs may go, what is promised there, what is refused, what error was measured.

One row for each direction in which an input can become extreme. A row holds its domain, its promise, where
its bound comes from, and a measurement that yields points: an answer with its error against `reference` or a
closed form in float64, or a refusal. A point that is neither within its bound nor refused as promised has
failed; NaN and infinity count as an infinite error. `adof envelope` writes the table for the device at hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import AdofError
from adof_cl.noise import noise_to_signal
from adof_cl.optics import Mask, OpticalSystem, PupilGrid
from adof_cl.otf import Otf1d
from adof_cl.program import Program
from adof_cl.pupil_phase import PupilPhase
from adof_cl.restore import Restore
from adof_cl.servo import require_stable_gain, samples_late, stability_limit_per_s
from adof_cl.ssd_search import SsdSearch
from adof_cl.stereo import AffineCamera, StereoRig, triangulate
from adof_cl.tracking import Template, TemplateTracker
from adof_cl.wiener import WienerFilter, psf_otf

Array = NDArray[Any]

STORAGES = ("float32", "float64", "half")
"""Arithmetic in float32 or float64; half: float32 arithmetic on a spectrum kept in float16."""

_HALF_STEP = 2.0**-11  # of a half number, relative
_HALF_LEAST = 2.0**-14  # below it a device may flush to zero
_FLOAT_LEAST = 2.0**-126


@dataclass(frozen=True)
class Point:
    """One input of a row.

    Attributes
    ----------
    at
        Where on the row's axis: its number, or its name.
    error, bound
        In the row's measure; an error of infinity where there is no finite answer.
    refused
        The refusal's sentence, where one was promised and came.
    failure
        What came instead of an answer or a refusal.
    """

    at: float | str
    error: float = 0.0
    bound: float = 0.0
    refused: str = ""
    failure: str = ""

    @property
    def ok(self) -> bool:
        """Within the bound, or refused as promised."""
        return not self.failure and self.error <= self.bound


Measure = Callable[[Device, str, bool], Iterator[Point]]


@dataclass(frozen=True)
class Row:
    """One direction of the envelope.

    Attributes
    ----------
    domain, promise, refusal
        What may come, what is then true, and what is refused.
    derivation
        Where the bound comes from.
    measure, axis
        What an error is, and what a point's place is; with its unit.
    points
        Yields the points for a device, a storage, and whether the whole range is wanted.
    storages
        In which it is measured; one where the arithmetic is the host's or of one kind.
    """

    name: str
    domain: str
    promise: str
    refusal: str
    derivation: str
    measure: str
    axis: str
    points: Measure
    storages: tuple[str, ...] = ("float32", "float64")


@dataclass(frozen=True)
class Outcome:
    """A row's points on one device in one storage."""

    row: Row
    storage: str
    points: tuple[Point, ...]

    @property
    def ok(self) -> bool:
        """Every point within its bound or refused as promised."""
        return all(point.ok for point in self.points)

    @property
    def refusals(self) -> int:
        """How many points were refused as promised."""
        return sum(bool(point.refused) for point in self.points)

    @property
    def worst(self) -> Point | None:
        """The answer nearest its bound or farthest beyond; None where all were refused."""
        answers = [point for point in self.points if not point.refused]
        return max(answers, key=lambda p: p.error / max(p.bound, 1e-300), default=None)


def run(device: Device, *, quick: bool = False) -> Iterator[Outcome]:
    """Measure every row in every storage the device has; yields outcomes as they come.

    Parameters
    ----------
    quick
        A representative share of each range, in seconds.
    """
    for row in ROWS:
        for storage in row.storages:
            if storage != "float64" or device.facts.fp64 or len(row.storages) == 1:
                yield measured(device, row, storage, quick=quick)


def measured(device: Device, row: Row, storage: str, *, quick: bool = False) -> Outcome:
    """Measure one row in one storage; what a driver throws becomes a failed point."""
    points: list[Point] = []
    try:
        points.extend(row.points(device, storage, not quick))
    except Exception as failure:  # noqa: BLE001 (whatever comes instead of an answer is what was looked for)
        points.append(Point("-", math.inf, 0.0, failure=f"{type(failure).__name__}: {failure}"))
    return Outcome(row, storage, tuple(points))


def _answer(at: float | str, error: Any, bound: float) -> Point:
    value = float(np.max(np.nan_to_num(np.abs(error), nan=math.inf)))
    return Point(at, value, bound)


def _refusal(at: float | str, call: Callable[..., object], *arguments: Any) -> Point:
    """Return the refusal that `call` owes; a failed point where it gives an answer."""
    try:
        call(*arguments)
    except AdofError as refusal:
        return Point(at, refused=str(refusal))
    return Point(at, math.inf, failure="taken without a word")


def _eps(storage: str) -> float:
    return float(np.finfo("float64" if storage == "float64" else "float32").eps)


# ---- optics -----------------------------------------------------------------------------------------------

_ALPHAS = (0.0, 1e-6, 1e-3, 1.0, 100.0, 1e4, 1e5)


def _frequencies(full: bool) -> Array:
    return np.concatenate([np.linspace(-2.2, 2.2, 321 if full else 161), [1e-9, 1e-6, 1e-3]])


def _otf_bound(storage: str) -> float:
    return 35 * _eps(storage) + 2e-13


def _otf_alpha(device: Device, storage: str, full: bool) -> Iterator[Point]:
    u = _frequencies(full)
    plan = Otf1d(device, u, precision=storage)
    range_ = (*_ALPHAS, *np.geomspace(1e-7, 1e5, 25)) if full else _ALPHAS
    for alpha in sorted({*range_, *(-a for a in range_)}):
        for psi in (0.0, 15.0, 150.0, -500.0):
            error = plan.evaluate(alpha, psi) - reference.otf_1d(u, alpha, psi)
            yield _answer(alpha, error, _otf_bound(storage))
    for beyond in (1.001e5, -1e6, math.nan, math.inf):
        yield _refusal(beyond, plan.evaluate, beyond, 0.0)


def _otf_psi(device: Device, storage: str, full: bool) -> Iterator[Point]:
    u = _frequencies(full)
    plan = Otf1d(device, u, precision=storage)
    for psi in np.linspace(0, 500, 51 if full else 6):
        for alpha in (0.0, 1.0, -53.5, 1e4):
            error = plan.evaluate(alpha, psi) - reference.otf_1d(u, alpha, psi)
            yield _answer(float(psi), error, _otf_bound(storage))
    for beyond in (1.001e4, -math.inf, math.nan):
        yield _refusal(beyond, plan.evaluate, 1.0, beyond)


def _otf_ratio(device: Device, storage: str, full: bool) -> Iterator[Point]:
    u = _frequencies(full)
    plan = Otf1d(device, u, precision=storage)
    near = (0.5, 1 - 1e-6, 1.0, 1 + 1e-6, 2.0)
    for ratio in (0.0, *np.geomspace(1e-3, 1e8, 34 if full else 8), *near, math.inf):
        for psi in (15.0, 150.0, 500.0):
            alpha = min(psi / (3 * ratio), 1e5) if ratio > 0 else 1e5
            used = 0.0 if ratio == 0 else min(psi, 3 * ratio * alpha) if math.isfinite(ratio) else psi
            error = plan.evaluate(alpha, used) - reference.otf_1d(u, alpha, used)
            yield _answer(float(ratio), error, _otf_bound(storage))


def _pupil_phase(device: Device, storage: str, full: bool) -> Iterator[Point]:
    side = 257 if full else 33
    x = PupilGrid(side).x
    plan = PupilPhase(device, side, side, precision=storage)
    for alpha in sorted({*_ALPHAS, *(-a for a in _ALPHAS)}):
        for psi in (0.0, -500.0):
            turns = plan.evaluate(Mask(alpha, psi))
            phase = reference.pupil_phase(x, x, alpha, psi)
            apart = turns - phase / (2 * math.pi)
            apart = 2 * math.pi * np.abs(apart - np.rint(apart))
            outside = not ((turns >= 0) & (turns < 1)).all()
            # The reference adds up whole radians, four roundings of their size.
            bound = 4 * math.pi * _eps(storage) + 4 * _eps("float64") * max(float(np.abs(phase).max()), 1.0)
            yield _answer(alpha, math.inf if outside else apart, bound)
    yield _refusal(2e5, plan.evaluate, Mask(2e5, 0.0))


# ---- restoration ------------------------------------------------------------------------------------------


def _wiener_nsr(device: Device, storage: str, full: bool) -> Iterator[Point]:
    shape = (96, 80) if full else (24, 20)
    half = (shape[0], shape[1] // 2 + 1)
    rng = np.random.default_rng(1)
    kind = np.result_type(storage, np.complex64)
    modulus = 10.0 ** rng.uniform(-20, 0, half)
    modulus.flat[::7] = 0  # exact zeros of the transfer function
    otf = (modulus * np.exp(2j * np.pi * rng.random(half))).astype(kind)
    plan = WienerFilter(device, shape, precision=storage)
    values = (0.0, 1e-12, 1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e12)
    for nsr in (*values, *np.geomspace(1e-30, 1e12, 85)) if full else values:
        found = plan.from_otf(otf, nsr).download().astype(complex)
        wanted = reference.wiener(otf, float(np.dtype(storage).type(nsr)))
        # Where nothing passed, nothing may come; a gain below the least normal number may be flushed to 0.
        zero = wanted == 0
        apart = np.maximum(np.abs(found - wanted) - 2 * _FLOAT_LEAST, 0) / np.where(
            zero, 1e-300, np.abs(wanted)
        )
        yield _answer(float(nsr), apart, 8 * _eps(storage))
    for refused in (-1e-12, 1.1e12, math.nan, math.inf):
        yield _refusal(refused, plan.from_otf, otf, refused)
    for modulus_refused in (1.1e3, math.nan, 1e300):
        wrong = np.full(half, modulus_refused)
        yield _refusal(f"|H| = {modulus_refused:g}", plan.from_otf, wrong, 1.0)


def _plan(device: Device, shape: tuple[int, int], storage: str, padding: int = 6, kind: str = "") -> Restore:
    if storage == "half":
        kind = kind or "uint16"
        return Restore(
            device, shape, padding=padding, in_dtype=kind, out_dtype=kind, spectrum_dtype=np.float16
        )
    kind = kind or storage
    return Restore(device, shape, padding=padding, precision=storage, in_dtype=kind, out_dtype=kind)


def _coded_axes(shape: tuple[int, int], storage: str) -> tuple[Array, Array]:
    """Return a coded camera's transfer along each axis, as the storage's arithmetic holds it."""
    optics = OpticalSystem()
    kind = np.complex128 if storage == "float64" else np.complex64
    rows, columns = (reference.otf_1d(optics.frequency_axis(n), 20.0, 10.0).astype(kind) for n in shape)
    return rows, columns


def _scene(shape: tuple[int, int], kind: Any) -> Array:
    """Return a seeded frame that fills the middle half of its range."""
    top = float(np.iinfo(kind).max) if np.dtype(kind).kind == "u" else 1.0
    return (top * np.random.default_rng(2).uniform(0.25, 0.75, shape)).astype(kind)


def _restored(
    plan: Restore, at: float | str, frame: Array, axes: tuple[Array, Array], nsr: float, noisy: bool = False
) -> Point:
    """Restore and compare; the error is the image's rms over the wanted image's or the frame's range.

    `noisy`: no two of the frame's pixels are alike, so that roundings are independent.
    """
    gain = reference.wiener_of_axes(axes[0], axes[1], nsr)
    largest = float(np.abs(gain).max())
    plan.set_filter_axes(axes[0], axes[1], nsr)
    found = plan.restore(frame).astype(np.float64)
    wanted = reference.restore(frame, gain, plan.padded_shape)
    # The padding's share of the energy is what the transforms see too.
    whole = reference.restore_padding(frame, plan.padded_shape)
    size = found.size
    energy = max(float(np.linalg.norm(whole)), float(np.linalg.norm(frame)))
    if plan.out_dtype.kind == "u":
        top = float(np.iinfo(plan.out_dtype).max)
        inside = float(((wanted > 0) & (wanted < top)).mean())  # what is clamped shows no error
        wanted = np.clip(wanted, 0, top)
        if plan.spectrum_dtype == np.float16:
            spread = _half_spread(plan, whole, gain, noisy) * math.sqrt(inside if noisy else 1)
        else:
            spread = 4 * _eps("float32") * (1 + largest) * energy
        error = float(np.linalg.norm(found - wanted)) / math.sqrt(size)
        return _answer(at, error / top, (0.5 + spread / math.sqrt(size)) / top)
    limit = 5e-7 if plan.out_dtype == np.float32 else 1e-14
    floor = _FLOAT_LEAST * math.sqrt(size) * plan.padded_shape[0] * plan.padded_shape[1]
    norm = float(np.linalg.norm(wanted))
    allowed = limit * (norm + largest * energy) + floor * (1 + largest)
    error = float(np.linalg.norm(found - wanted))
    scale = max(norm, allowed, 1e-300)
    return _answer(at, error / scale, allowed / scale)


def _half_spread(plan: Restore, whole: Array, gain: Array, noisy: bool) -> float:
    """Return the norm of the error that keeping a spectrum in halves leaves in the image.

    Each number is stored twice, before the filter and after it, and errs by at most 2^-11 of itself, or by
    2^-14 where a device flushes; an rms of 2^-11/root 3 where roundings are independent. The first error goes
    through the filter: independent ones by its rms along their line, others by at most its largest.
    """
    ny, nx = plan.padded_shape
    modulus = np.abs(gain)
    mirrored = np.roll(modulus[::-1, 1 : nx - nx // 2], 1, axis=0)[:, ::-1]
    power = np.concatenate([modulus, mirrored], axis=1) ** 2
    outer = 0 if plan.family == "lanes" else 1
    lines = (np.abs(np.fft.fft(whole, axis=outer)) ** 2).sum(axis=1 - outer) / whole.shape[outer]
    through = power.mean(axis=1 - outer) if noisy else power.max(axis=1 - outer)
    after = float((power * np.abs(np.fft.fft2(whole)) ** 2).sum()) / (ny * nx)
    before = float(lines @ through)
    relative = math.sqrt((before + after) / 3) if noisy else math.sqrt(before) + math.sqrt(after)
    # Numbers are stored as 256ths of the frame's range; float32 adds four eps on the way.
    level = max(float(np.iinfo(plan.in_dtype).max) / 255, 1)
    absolute = _HALF_LEAST * level * math.sqrt(ny * nx) * (1 + math.sqrt(float(through.mean())))
    return (_HALF_STEP + 4 * _eps("float32")) * relative + absolute


def _restore_nsr(device: Device, storage: str, full: bool) -> Iterator[Point]:
    shape = (120, 93) if full else (40, 33)
    plan = _plan(device, shape, storage)
    frame = _scene(shape, plan.in_dtype)
    axes = _coded_axes(plan.padded_shape, storage)
    axes[1][3] = axes[1][-3] = 0  # a transfer function with exact zeros
    values = (1e-12, 1e-9, 1e-6, 1e-3, 1e-2, 1.0, 1e3, 1e6)
    for nsr in values:
        gain = plan.line_gain(reference.wiener_of_axes(axes[0], axes[1], nsr))
        if storage == "half" and gain > plan.half_gain_limit:
            yield _refusal(nsr, plan.set_filter_axes, *axes, nsr)
        else:
            yield _restored(plan, nsr, frame, axes, nsr, noisy=True)
    for nsr in (-1.0, 1e13, math.nan):
        yield _refusal(nsr, plan.set_filter_axes, *axes, nsr)
    # Without noise: a blur that is nowhere 0.
    rows, columns = (1 / (1 + 4 * np.abs(np.fft.fftfreq(n))) for n in plan.padded_shape)
    yield _restored(plan, 0.0, frame, (rows, columns), 0.0, noisy=True)


def _restore_size(device: Device, storage: str, full: bool) -> Iterator[Point]:
    sizes = [(8, 8), (127, 251), (8, 4096)]
    if full:
        sizes += [(9, 8), (4093, 8), (509, 1021), (4093, 4093)]
    for shape in sizes:
        plan = _plan(device, shape, storage)
        axes = _coded_axes(plan.padded_shape, storage)
        scene = _scene(shape, plan.in_dtype)
        yield _restored(plan, float(math.prod(shape)), scene, axes, 0.05, noisy=True)
    for side in (1, 2, 7, 4097, 8192):
        yield _refusal(float(side * side), _plan, device, (side, side), storage)


def _restore_frames(device: Device, storage: str, full: bool) -> Iterator[Point]:
    shape = (127, 251) if full else (33, 40)
    middle = (shape[0] // 2, shape[1] // 2)
    kinds = ("uint8", "uint16") if storage == "half" else (storage, "uint8", "uint16")
    for kind in kinds if full else (kinds[0], kinds[-1]):
        plan = _plan(device, shape, storage, kind=kind)
        axes = _coded_axes(plan.padded_shape, storage)
        top = np.iinfo(kind).max if kind.startswith("u") else 1
        hot, pedestal, faint = (np.zeros(shape, kind) for _ in range(3))
        hot[middle] = top
        pedestal[:] = 60000 / 65535 * top
        if kind == "uint16":
            pedestal += np.random.default_rng(3).integers(0, 4, shape).astype(kind)
        faint[::2, ::3] = 1 if kind.startswith("u") else np.finfo(kind).smallest_subnormal * 1000
        for name, frame in (
            ("black", np.zeros(shape, kind)),
            ("saturated", np.full(shape, top, kind)),
            ("one hot pixel", hot),
            ("pedestal, contrast 3", pedestal),
            ("least numbers", faint),
        ):
            yield _restored(plan, f"{name}, {kind}", frame, axes, 0.05)
        if not kind.startswith("u"):
            for value in (math.nan, math.inf, -math.inf, float(np.finfo(kind).max)):
                spoilt = np.full(shape, 0.5, kind)
                spoilt[middle] = value
                plan.set_filter_axes(*axes, 1e-3)
                if value == float(np.finfo(kind).max):
                    spoilt[:] = value
                yield _refusal(f"{value:g}", plan.restore, spoilt)


_DENORMALS = """\
__kernel void denormals(__global const float *least, __global const float *below, __global float *made,
                        __global float *taken, __global half *stored, __global float *loaded)
{
    const int i = get_global_id(0);
    made[i] = 0.5f * least[i];
    taken[i] = 16777216.0f * below[i];
    vstore_half(ldexp(least[i], 126 - 15), i, stored);
    loaded[i] = vload_half(i, stored);
}
"""


def _denormals(device: Device, storage: str, full: bool) -> Iterator[Point]:
    """Numbers below the least normal one, as programs are built and with the option that lets them be 0."""
    shape = (127, 251) if full else (24, 20)
    share = np.linspace(1, 2, 64, endpoint=False, dtype=np.float32)
    least = share * np.float32(_FLOAT_LEAST)
    for option in ((), ("-cl-denorms-are-zero",)):
        own = Device(device.facts, device.handle)
        own.build_options = option
        made, taken, loaded = (own.empty(share.shape, np.float32) for _ in range(3))
        below, stored = own.upload(least / 2), own.empty(share.shape, np.float16)
        program = Program(own, "precision.h", generated=("denormals.cl", _DENORMALS))
        program.launch(
            "denormals", share.shape, None, own.upload(least), below, made, taken, stored, loaded
        )()
        name = option[0] if option else "as built"
        results = (
            [("a half", loaded, share * 2.0**-15, _HALF_LEAST)]
            if storage == "half"
            else [
                ("a result", made, share.astype(np.float64) * _FLOAT_LEAST / 2, _FLOAT_LEAST),
                ("an operand", taken, share * 2.0**-103, 2.0**-102),
            ]
        )
        for what, found, wanted, unit in results:
            values = found.download().astype(np.float64)
            kept = "kept" if (values != 0).all() else "0"
            yield _answer(f"{name}: {what} is {kept}", (values - wanted) / unit, 1.0)
        plan = _plan(own, shape, storage)
        axes = _coded_axes(plan.padded_shape, storage)
        frame = np.zeros(shape, plan.in_dtype)
        faint = 1 if storage == "half" else _FLOAT_LEAST / 4
        frame[::2, ::3] = faint
        yield _restored(plan, f"{name}: a frame of {faint:.2g}", frame, axes, 0.05)


def _psf(device: Device, storage: str, full: bool) -> Iterator[Point]:
    del device, storage
    shape = (64, 48) if full else (24, 18)
    delta, signed, cancelling = np.zeros((5, 7)), np.ones((5, 7)), np.zeros((1, 2))
    delta[2, 3] = 7.0
    signed[0, 0] = -20.0
    cancelling[0] = 1.0, -1.0 + 1e-6
    frame = np.random.default_rng(4).random(shape)
    huge = np.full((3, 3), 1e308)
    for name, psf in (("delta", delta), ("full frame", frame), ("some negative", signed), ("1e308", huge),
                      ("one denormal", np.array([[5e-324]]))):  # fmt: skip
        j, i = (np.arange(n) - n // 2 for n in psf.shape)
        scaled = psf / psf.max()
        rows = np.exp(-2j * np.pi * np.outer(np.arange(shape[0]), j) / shape[0])
        columns = np.exp(-2j * np.pi * np.outer(i, np.arange(shape[1] // 2 + 1)) / shape[1])
        wanted = rows @ (scaled / scaled.sum()) @ columns
        moduli = float(np.abs(scaled).sum() / scaled.sum())
        # The matrices' turns reach shape radians, and so many roundings.
        yield _answer(name, psf_otf(psf, shape) - wanted, 8 * sum(shape) * _eps("float64") * moduli)
    for name, psf in (("zero", np.zeros((3, 3))), ("negative", -np.ones((3, 3))), ("cancelling", cancelling),
                      ("NaN", np.full((3, 3), np.nan)), ("too large", np.ones((65, 49)))):  # fmt: skip
        yield _refusal(name, psf_otf, psf, shape)


def _auto_nsr(device: Device, storage: str, full: bool) -> Iterator[Point]:
    del device, storage
    shape = (128, 96) if full else (32, 24)
    otf = np.ones((shape[0], shape[1] // 2 + 1), np.complex128)
    hot = np.zeros(shape)
    hot[7, 9] = 255
    base = np.random.default_rng(5).random(shape)
    for name, frame in (
        ("black", np.zeros(shape)),
        ("saturated", np.full(shape, 65535.0)),
        ("hot pixel", hot),
    ):
        found = noise_to_signal(frame, otf, shape)
        yield _answer(name, 0.0 if np.isfinite(found).all() and found.min() > 0 else math.inf, 0.0)
    wanted = noise_to_signal(base, otf, shape)
    for unit in (1e-200, 1e-3, 6e4, 1e30, 1e300):
        found = noise_to_signal(base * unit, otf, shape)
        yield _answer(f"unit {unit:g}", found / wanted - 1, 0.0)
    for name, value in (("NaN", math.nan), ("infinity", math.inf)):
        yield _refusal(name, noise_to_signal, base + value, otf, shape)


# ---- features ---------------------------------------------------------------------------------------------


def _texture(shape: tuple[int, int], seed: int = 6) -> Array:
    """Return a smooth seeded texture in 0..1: noise whose frequencies end at a sixth of a cycle a pixel."""
    spectrum = np.fft.rfft2(np.random.default_rng(seed).normal(size=shape))
    f = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :])
    image = np.fft.irfft2(spectrum * np.exp(-((f / 0.08) ** 2)), s=shape)
    image -= image.min()
    return np.asarray(image / image.max())


def _search(device: Device, storage: str, full: bool) -> Iterator[Point]:
    del storage
    shape, template, window = ((96, 130), (20, 20), (44, 52)) if full else ((40, 52), (9, 11), (24, 30))
    texture = _texture(shape)
    frames: dict[str, Array] = {
        "full range, uint8": (255 * texture).astype(np.uint8),
        "pedestal 60000, contrast 3, uint16": (60000 + np.random.default_rng(7).integers(0, 4, shape)).astype(
            np.uint16
        ),
        "full range, uint16": (65535 * texture).astype(np.uint16),
        "float32": texture.astype(np.float32),
    }
    corners = {
        "at the top left": (0, 0),
        "at the bottom right": (shape[0] - template[0], shape[1] - template[1]),
        "inside": (11, 13),
    }
    for name, image in frames.items() if full else list(frames.items())[:2]:
        plan = SsdSearch(device, shape, template, window, 1, dtype=image.dtype, score="gain_offset")
        for where, (y, x) in corners.items():
            plan.set_templates(image[None, y : y + template[0], x : x + template[1]].copy())
            plan.set_windows(np.array([[y - 4, x - 5]]), clamp=True)
            found = plan.search(image)
            place = np.abs(found.best_yx[0] - np.array([y, x])).max()
            yield _answer(f"{name}, {where}", place, 0.0)
        flat = np.full((1, *template), 7, image.dtype)
        yield _refusal(f"flat template, {image.dtype}", plan.set_templates, flat)
    edge = np.zeros((40, 40), np.float32)
    edge[:, 20:] = 1
    bad = texture.astype(np.float32)
    bad[15, 15] = np.nan
    for name, call in (
        ("one edge only", lambda: Template.cut(edge, (20, 20), noise=0.01)),
        ("no contrast", lambda: Template.cut(np.zeros((40, 40), np.uint8), (20, 20))),
        ("beyond the border", lambda: Template.cut(edge, (2, 2), noise=0.01)),
        ("NaN in the template", lambda: Template.cut(bad, (15, 15), (9, 9))),
        ("larger than the window", lambda: SsdSearch(device, shape, (30, 30), (20, 20), 1)),
        ("window larger than the image", lambda: SsdSearch(device, shape, template, (200, 200), 1)),
    ):
        yield _refusal(name, call)


@dataclass(frozen=True)
class Walked:
    """How far a long walk of tracking has come.

    Attributes
    ----------
    frames
        Measured so far.
    apart_px
        Farthest that a place came out from what the same frame gave first: 0 where nothing accumulates.
    error_sigmas
        Farthest from the truth, in the standard deviations that each measurement stated for itself.
    lost
        Frames without a measurement.
    unseen
        How many three frames in a row, of those the walk can take, have not come yet.
    """

    frames: int
    apart_px: float
    error_sigmas: float
    lost: int
    unseen: int


_SHIFT_PX = 0.8
# Where image and template agree, a step of Gauss-Newton leaves the square of what it mended times half the
# ratio of the second slope to the first, 2 pi/6 a pixel in this texture; the last mends less than 1e-4 px.
_EXACT_PX = 1e-8


def walk(
    device: Device, frames: int, every: int, *, grid: int = 3, refine: str = "gauss_newton"
) -> Iterator[Walked]:
    """Follow one feature through a long walk of `frames` frames; yields every `every` of them.

    The frames are a noisy 8-bit texture at grid x grid shifts of 0.8 px; the walk goes from one to itself or
    a neighbour, by turns, so that every three in a row come equally often. Places are predicted from the two
    before, as in the loop. What the tracker remembers are those two: once every three in a row have come and
    each frame always had the same place to the bit, no walk of any length can leave it.
    """
    rng = np.random.default_rng(10)
    n = 48
    spectrum = np.fft.rfft2(_texture((n, n), 8))
    fy, fx = np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None, :]
    shifts = [(y, x) for y in range(grid) for x in range(grid)]
    images = []
    for y, x in shifts:
        moved = np.fft.irfft2(spectrum * np.exp(-2j * np.pi * _SHIFT_PX * (fy * y + fx * x)), s=(n, n))
        images.append(np.clip(np.rint(20 + 200 * moved + rng.normal(0, 1, (n, n))), 0, 255).astype(np.uint8))
    start = np.array([20.0, 22.0])
    template = Template.cut(images[0], start, (12, 12), noise=1.0)
    tracker = TemplateTracker(device, (n, n), [template], (24, 24), refine=refine)
    shown = [device.upload(image) for image in images]
    near = [
        [b for b, (y, x) in enumerate(shifts) if max(abs(y - down), abs(x - right)) <= 1]
        for down, right in shifts
    ]
    turns: dict[tuple[int, int], int] = {}
    unseen = sum(len(around) ** 2 for around in near)
    first: dict[int, Array] = {}
    before = at = lost = 0
    apart = error = 0.0
    tracker.aim(start[None])
    for done in range(1, frames + 1):
        turn = turns.get((before, at), 0)
        turns[before, at] = turn + 1
        unseen -= turn < len(near[at])
        before, at = at, near[at][turn % len(near[at])]
        (found,) = tracker.track(shown[at])
        lost += found.lost
        place = first.setdefault(at, found.feature_xy_px)
        if place is found.feature_xy_px or place.tobytes() != found.feature_xy_px.tobytes():
            y, x = shifts[at]
            truth = start + _SHIFT_PX * np.array([x, y])
            apart = max(apart, float(np.abs(found.feature_xy_px - place).max()))
            sigma = np.sqrt(np.diag(found.covariance))
            error = max(error, float((np.abs(found.feature_xy_px - truth) / sigma).max()))
        if done % every == 0 or done == frames:
            yield Walked(done, apart, error, lost, unseen)


def _tracking(device: Device, storage: str, full: bool) -> Iterator[Point]:
    """Two features a pixel apart; a closed path, whose state must come back to the bit; then any path."""
    del storage
    n = 96
    image = (255 * _texture((n, n), 8)).astype(np.uint8)
    truths = np.array([[44.0, 50.0], [45.0, 50.0]])
    templates = [Template.cut(image, at, (20, 20), noise=1.0) for at in truths]
    tracker = TemplateTracker(device, (n, n), templates, (40, 40))
    frame = device.upload(image)
    found = np.array([m.feature_xy_px for m in tracker.track(frame, truths + 3)])
    yield _answer("1 px apart", found - truths, _EXACT_PX)

    steps = np.array([[0, 0], [3, 1], [5, -2], [1, -3], [0, 0], [0, 0]])
    frames = [device.upload(np.roll(image, (dy, dx), (0, 1))) for dx, dy in steps]
    tracker.aim(truths)
    # What is remembered are two places; the same two at the same frame make every later lap the one before.
    laps = np.array(
        [
            [[m.feature_xy_px for m in tracker.track(frame)] for frame in frames]
            for _ in range(20 if full else 3)
        ]
    )
    yield _answer("a lap after a lap", np.diff(laps, axis=0), 0.0)
    yield _answer("after the last lap", laps[-1] - (truths + steps[:, None, :]), _EXACT_PX)

    for walked in walk(device, 20000, 100, grid=3 if full else 2):
        if not walked.unseen:
            break
    yield _answer("any three frames in a row", walked.apart_px, 0.0)
    yield _answer("of them unseen or lost", walked.unseen + walked.lost, 0.0)
    yield _answer("their error, in stated deviations", walked.error_sigmas, 5.0)


# ---- stereo and servo -------------------------------------------------------------------------------------


def _camera(angle_rad: float, origin_um: Array) -> AffineCamera:
    scale = 0.135
    matrix = scale * np.array([[math.cos(angle_rad), 0, math.sin(angle_rad)], [0, 1, 0]])
    volume = np.stack([origin_um - 5e3, origin_um + 5e3])
    return AffineCamera.exact(matrix, np.array([256.0, 200.0]) - matrix @ origin_um, work_volume_um=volume)


def _triangulated(at: float, angle_rad: float, origin_um: Array, full: bool) -> Point:
    rig = StereoRig(_camera(0.0, origin_um), _camera(angle_rad, origin_um))
    truth = origin_um + np.random.default_rng(9).uniform(-4e3, 4e3, (200 if full else 20, 3))
    fix = triangulate(rig, rig.camera_1.project(truth), rig.camera_2.project(truth))
    # Pixels carry an eps of the largest product that made them; the system multiplies it by its condition.
    pixels = 0.135 * float(np.abs(truth).max()) * 2 + 512
    bound = 16 * _eps("float64") * rig.condition * pixels / 0.135
    return _answer(at, fix.xyz_um - truth, bound)


def _stereo_angle(device: Device, storage: str, full: bool) -> Iterator[Point]:
    del device, storage
    for degrees in (5.001, 10.0, 30.0, 45.0, 60.0, 89.9, *(np.linspace(6, 89.9, 57) if full else ())):
        yield _triangulated(float(degrees), math.radians(degrees), np.zeros(3), full)
    for degrees in (0.0, 0.1, 1.0, 4.999):
        yield _refusal(degrees, _triangulated, degrees, math.radians(degrees), np.zeros(3), full)


def _world_origin(device: Device, storage: str, full: bool) -> Iterator[Point]:
    del device, storage
    for away in (1e-3, 1.0, 1e3, 1e6):
        yield _triangulated(away, math.radians(35), np.array([away, -away, away]), full)


def _servo_gain(device: Device, storage: str, full: bool) -> Iterator[Point]:
    del device, storage
    period = 0.1
    for delay in (0.0, 0.1, 0.25, 1.0):
        limit = stability_limit_per_s(delay, period)
        for share in (0.1, 0.5, 0.9, 0.99, 1.01, 1.1):
            d = samples_late(delay, period)
            past = np.ones(d + 1)
            ends = []
            for step in range(20000 if full else 4000):
                past = np.append(past[1:], past[-1] - share * limit * period * past[0])
                ends.append(abs(past[-1]))
                if not 1e-200 < ends[-1] < 1e200 and step > 50:
                    break
            tail = max(ends[-8 * (d + 1) :])
            wrong = (tail >= 1) if share < 1 else (tail <= 1)
            yield _answer(share, 1.0 if wrong else 0.0, 0.0)
            if share <= 0.5:
                require_stable_gain(share * limit, delay, period)
            else:
                gain = share * limit
                yield _refusal(share, require_stable_gain, gain, delay, period)
    for gain in (0.0, -1.0, math.nan, math.inf):
        yield _refusal(gain, require_stable_gain, gain, 0.1, period)


_HOST = ("float64",)
_ONE = ("float32",)

ROWS: tuple[Row, ...] = (
    Row(
        "otf-alpha", "alpha 0 to 1e5 rad, both signs; psi 0, 15, 150, -500", "H finite, within the bound",
        "|alpha| > 1e5, NaN, infinity",
        "the terms of eq. O4 are at most 3.5 in all, ten roundings each: 35 eps; 2e-13 for the reference",
        "|dH|", "alpha (rad)", _otf_alpha,
    ),
    Row(
        "otf-psi", "psi 0 to 500 rad; alpha 0, 1, -53.5, 1e4", "H finite, within the bound",
        "|psi| > 1e4, NaN, infinity", "as otf-alpha", "|dH|", "psi (rad)", _otf_psi,
    ),
    Row(
        "otf-ratio", "psi/(3 alpha) from 0 to infinity, and 1 +- 1e-6", "H finite, within the bound",
        "nothing", "as otf-alpha", "|dH|", "psi/(3 alpha)", _otf_ratio,
    ),
    Row(
        "pupil-phase", "alpha 0 to 1e5 rad, both signs; psi 0, -500", "wrapped phase in [0, 1) turns",
        "|alpha| > 1e5", "two axes and their sum each round by half an eps of a turn; the "
        "reference by eps of whole radians", "rad", "alpha (rad)", _pupil_phase,
    ),
    Row(
        "wiener-nsr", "NSR 0 to 1e12; |H| 1e-20 to 1 and exactly 0", "0 where H is 0, else within the bound",
        "NSR below 0, above 1e12, NaN; |H| above 1e3, NaN",
        "a complex product, a squared modulus, a quotient, a product: 8 eps; below 2^-126 a gain may be 0",
        "|dG|/|G|", "NSR", _wiener_nsr,
    ),
    Row(
        "restore-nsr", "NSR 0 to 1e6, a transfer function with exact zeros", "image within the bound",
        "NSR below 0, above 1e12, NaN; in halves a gain that a line of stored numbers could not hold",
        "5e-7 (float32) or 1e-14 of image and of frame times the largest gain; halves: 2^-11/root 3 of each "
        "number stored, before the filter and behind it, and half a level",
        "relative L2; halves: rms of range", "NSR", _restore_nsr, STORAGES,
    ),
    Row(
        "restore-size", "8 x 8 to 4093 x 4093, primes, 8 x 4096", "image within the bound",
        "sides 1, 2, 7, 4097, 8192", "as restore-nsr", "relative L2; halves: rms of range", "pixels",
        _restore_size, STORAGES,
    ),
    Row(
        "restore-frames", "black, saturated, one hot pixel, pedestal 60000 with contrast 3, least numbers",
        "image within the bound", "NaN, infinity, and what overflows on the way",
        "as restore-nsr; in halves 2^-11 and the largest gain of a line, for a flat frame's roundings agree; "
        "a number below 2^-126 (halves 2^-14) may become 0",
        "relative L2; integers: rms of range", "frame", _restore_frames, STORAGES,
    ),
    Row(
        "denormals", "float32 below 2^-126, halves below 2^-14; built as ever and with -cl-denorms-are-zero",
        "kept or 0, and the image within the bound", "nothing",
        "a number turned 0 was below the least normal one; images as restore-frames",
        "least normal numbers; images: as restore-frames", "case", _denormals, ("float32", "half"),
    ),
    Row(
        "psf", "a delta, a full frame, some negative values, any unit", "OTF within the bound",
        "zero, negative, NaN, larger than the frame, or cancelling to below a thousandth",
        "as many roundings as the direct transform has terms", "|dH|", "PSF", _psf, _HOST,
    ),
    Row(
        "auto-nsr", "flat and hot frames; any unit from 1e-200 to 1e300", "above 0, finite, free of the unit",
        "NaN, infinity", "exact: the answer is one of a grid that the optics alone decide",
        "relative", "frame or unit", _auto_nsr, _HOST,
    ),
    Row(
        "search", "templates at the border, pedestal 60000 with contrast 3, every pixel type",
        "the place it was cut at, to the pixel", "flat, one edge only, larger than the window, NaN",
        "exact: a score of 0 is the least there is", "px", "template", _search, _ONE,
    ),
    Row(
        "tracking", "features 1 px apart; laps of a closed path", "no drift: a lap repeats to the bit, so "
        "any number of laps does; what comes after any two frames depends on neither", "nothing",
        "1e-8 px: the square of Gauss-Newton's last step; five standard deviations where there is noise",
        "px, frames, deviations", "case", _tracking, _ONE,
    ),
    Row(
        "stereo-angle", "5 to 89.9 degrees between the lines of sight", "position within the bound",
        "below 5 degrees", "16 eps of the pixels times the condition of Eq. 8", "um", "degrees",
        _stereo_angle, _HOST,
    ),
    Row(
        "world-origin", "work volume up to 1 m from the world's origin", "position within the bound",
        "nothing", "as stereo-angle: 1e6 um costs six digits of sixteen", "um", "um away",
        _world_origin, _HOST,
    ),
    Row(
        "servo-gain", "0.1 to 1.1 of the stability limit; delays 0 to 10 periods",
        "decays below the limit, grows above", "more than half the limit; 0, negative, NaN",
        "exact: the recursion of eq. C6, run", "1: wrong", "share of the limit", _servo_gain, _HOST,
    ),
)  # fmt: skip
"""Every row, in the order of the frame's path from mask to stage."""
