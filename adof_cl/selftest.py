"""A known answer for every kernel: seeded odd-sized inputs, the device's answer, and the reference's.

One check per operation, named like it. Each runs the operation's kernels in every form they are built in
(both families, every pixel type) at one precision and yields one outcome for each form: how far the
device is from `reference`, and how far it may be. The bounds follow from eps, the unit of the working
precision, and from the size.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_cl import reference
from adof_cl.device import Device
from adof_cl.errors import AdofError
from adof_cl.image_prep import ImagePrep, Region
from adof_cl.optics import Mask, OpticalSystem, PupilGrid, SlmPanel
from adof_cl.otf import FAMILIES as OTF_FAMILIES
from adof_cl.otf import Otf1d, SeparableMaskOtf
from adof_cl.program import Program
from adof_cl.psf import Psf, stop_amplitude
from adof_cl.pupil_phase import PupilPhase
from adof_cl.restore import FAMILIES, Restore
from adof_cl.slm_encode import SlmEncode
from adof_cl.ssd_search import SearchResult, SsdSearch
from adof_cl.wiener import WienerFilter

Size = tuple[int, int]
Array = NDArray[Any]
_TURN = 2 * math.pi


@dataclass(frozen=True)
class Outcome:
    """One form of some kernels against the reference.

    Attributes
    ----------
    name
        Operation, form, size and precision.
    kernels
        The kernel functions whose joint answer this is.
    error, bound
        In the same measure, named in `measure`; infinite where there is no answer or it is not finite.
    failure
        What the driver said instead of an answer.
    """

    name: str
    kernels: tuple[str, ...]
    measure: str
    error: float
    bound: float
    failure: str = ""

    @property
    def ok(self) -> bool:
        """Within the bound."""
        return self.error <= self.bound


Check = Callable[[Device, Size, str], Iterator[Outcome]]


@dataclass(frozen=True)
class Operation:
    """How an operation is checked.

    Attributes
    ----------
    size, small
        What its check is run at, and on a simulator; (rows, columns) of the frame, stop or panel, or how many
        pairs and frequencies.
    precisions
        In which the kernels are built.
    """

    check: Check
    size: Size
    small: Size
    precisions: tuple[str, ...] = ("float32", "float64")


def run(device: Device, *, small: bool = False) -> Iterator[Outcome]:
    """Check every operation on `device`, at each precision it has; yields outcomes as they come.

    Parameters
    ----------
    small
        Sizes a simulator finishes in minutes.
    """
    for name, operation in OPERATIONS.items():
        for precision in operation.precisions:
            if precision == "float64" and not device.facts.fp64:
                continue
            size = operation.small if small else operation.size
            try:
                # A context of its own: nothing one check leaves in memory can help or mislead the next.
                yield from operation.check(Device(device.facts, device.handle), size, precision)
            except AdofError as failure:
                yield _broken(f"{name}, {precision}", str(failure))
            except Exception as failure:  # noqa: BLE001 (whatever a driver throws is this kernel's failure)
                yield _broken(f"{name}, {precision}", f"{type(failure).__name__}: {failure}")


def _broken(name: str, failure: str) -> Outcome:
    return Outcome(name, (), "no answer", math.inf, 0.0, " ".join(failure.split()))


# ---- optics -----------------------------------------------------------------------------------------------


def check_pupil_phase(device: Device, size: Size, precision: str) -> Iterator[Outcome]:
    """Every term at once; then a cubic of 1e5 rad, which float32 survives only in turns."""
    rows, columns = size
    rng = np.random.default_rng(1)
    odd_x, odd_y = rng.normal(0, 9, columns), rng.normal(0, 9, rows)
    map_rad = rng.normal(0, 50, size)
    x, y = PupilGrid(columns).x, PupilGrid(rows).x
    plan = PupilPhase(device, rows, columns, precision=precision)
    kernels = ("pupil_phase_axis", "pupil_phase")

    def outcome(form: str, roundings: int, turns: Array, phase_rad: Array) -> Outcome:
        # The reference adds up whole radians, four roundings of their size.
        bound = _TURN * roundings * _eps(precision) + 4 * _eps("float64") * float(np.abs(phase_rad).max())
        name = f"pupil_phase {form}, {_at(size, precision)}"
        return Outcome(name, kernels, "rad", _wrapped(turns, phase_rad), bound)

    strong = Mask(1e5, -150.0)
    # Each axis rounds by half an eps of a turn, and so do their sum and its wrapping.
    yield outcome("alpha 1e5", 2, plan.evaluate(strong), reference.pupil_phase(x, y, 1e5, -150.0))
    plan.set_odd(odd_x, odd_y)
    plan.set_map(map_rad)
    found = plan.evaluate(Mask(53.5, -20.0), tilt_xy_rad=(3.0, -7.0))
    wanted = reference.pupil_phase(
        x, y, 53.5, -20.0, tilt_xy_rad=(3.0, -7.0), odd_x_rad=odd_x, odd_y_rad=odd_y, map_rad=map_rad
    )
    # Profiles and map round too, by 3/4 eps, and the sums grow to four turns before they are wrapped.
    yield outcome("every term", 5, found, wanted)


def check_slm_encode(device: Device, size: Size, precision: str) -> Iterator[Outcome]:
    """Codes through a scrambled table, without and with a correction."""
    rows, columns = size
    panel = SlmPanel("self-test", rows, columns, pitch_um=100.0, fill_factor=1.0, frame_rate_hz=60.0)
    optics = OpticalSystem(aperture_um=100.0 * (min(size) - 3.5))
    across = panel.stop_px(optics.aperture_um)
    table = ((37 * np.arange(256) + 11) % 256).astype(np.uint8)
    level_of = np.argsort(table)
    y, x = ((np.arange(n) - (n - 1) / 2) * 2 / across for n in size)
    correction = np.random.default_rng(2).uniform(-0.4, 0.4, size)
    mask, tilt = Mask(0.12 * across, -0.1 * across), (0.5, -0.25)
    for form, added in (("plain", None), ("with correction", correction)):
        plan = SlmEncode(device, panel, optics, table=table, correction_rad=added, precision=precision)
        codes = plan.codes(mask, tilt_xy_rad=tilt)
        terms = mask.alpha_rad, mask.focus_psi_rad
        shift = 0.0 if added is None else added
        wanted = reference.slm_encode(size, across, table, *terms, tilt_xy_rad=tilt, correction_rad=shift)
        phase = reference.pupil_phase(x, y, *terms, tilt_xy_rad=tilt, map_rad=shift)
        # How far the phase would have to move for the reference to give the same code.
        apart = level_of[codes] - 256 * phase / _TURN
        apart = np.abs(apart - 256 * np.rint(apart / 256)) - 0.5
        dark = np.maximum(np.abs(y)[:, None], np.abs(x)[None, :]) >= 1 + 1 / across
        apart[dark] = math.inf
        wrong = codes != wanted
        yield Outcome(
            f"slm_encode {form}, {_at(size, precision)}",
            ("slm_encode_axis", "slm_encode"),
            "levels",
            float(apart[wrong].max(initial=0.0)),
            256 * 4 * _eps(precision),  # two eps of a turn from the phase, two from wrapping and scaling
        )


def check_otf(device: Device, size: Size, precision: str) -> Iterator[Outcome]:
    """The exact form in every branch of eq. O4 and in both families; another profile by transforms."""
    pairs, n = size
    listed = [
        (53.5, 75.0),
        (0.0, 0.0),
        (0.0, -20.0),
        (1e-3, 5.0),
        (-80.0, 40.0),
        (1e3, -150.0),
        (-30.0, 120.0),
    ]
    chosen = [listed[i % len(listed)] for i in range(pairs)]
    scattered = np.concatenate([[0.0, 2.0, -2.0, 2.5, 1e-4], np.random.default_rng(3).uniform(-2, 2, n - 5)])
    every_seventh = np.where(np.arange(n) % 7 == 3, 0.0, np.sinc(scattered / 5))
    axes = 3.6 * np.concatenate([np.fft.fftfreq(n - 1), np.fft.fftfreq(2 * n - 1)])
    imaginary = np.where(axes == -1.8, 0.0, 1.0)  # none at Nyquist
    # Terms of at most 3.5 in all, each with some ten roundings, seldom of one sign.
    bound = 3e-6 if precision == "float32" else 1e-12
    for form, u, gain in (
        ("", scattered, np.stack([np.sinc(scattered / 5), every_seventh], axis=1)),
        ("two axes, ", axes, np.stack([np.ones(axes.size), imaginary], axis=1)),
    ):
        exact = np.stack([reference.otf_1d(u, alpha, psi) for alpha, psi in chosen])
        wanted = exact.real * gain[:, 0] + 1j * exact.imag * gain[:, 1]
        for family in OTF_FAMILIES:
            plan = Otf1d(device, u, gain=gain, pairs=pairs, precision=precision, family=family)
            apart = _largest(plan(chosen).download() - wanted)
            name = f"otf exact, {form}{family}, {_at(size, precision)}"
            yield Outcome(name, ("otf_1d",), "|dH|", apart, bound)

    samples = 1 << (n.bit_length() - 1)
    profile = PupilGrid(samples)
    phase = 0.1 * samples * profile.x**5 - 0.05 * samples * profile.x**2
    found = SeparableMaskOtf(device, samples, precision=precision).evaluate(phase)
    yield Outcome(
        f"otf of a profile, {_at((1, samples), precision)}",
        ("otf_field", "otf_fft", "otf_power", "otf_half"),
        "|dH|",
        _largest(found - reference.otf_of_profile(phase)),
        _transforms(precision, 2 * samples),
    )


def check_psf(device: Device, size: Size, precision: str) -> Iterator[Outcome]:
    """A round stop with a smooth phase, then a square one behind a panel's codes."""
    samples = size[0]
    x = PupilGrid(samples).x
    alpha, psi = 0.15 * samples, -0.1 * samples
    phase = reference.pupil_phase(x, x, alpha, psi)
    real = device.real_type(precision)
    kernels = ("psf_field", "psf_fft", "psf_intensity")

    def outcome(form: str, plan: Psf, found: tuple[Array, Array], phase_rad: Array, stop: str) -> Outcome:
        wanted = reference.psf_of_pupil(phase_rad, stop_amplitude(stop, samples), padded=plan.size)
        error = max(_relative(f, w) for f, w in zip(found, wanted, strict=True))
        bound = _transforms(precision, plan.size**2)
        return Outcome(f"psf {form}, {_at(size, precision)}", kernels, "relative L2", error, bound)

    turns = device.upload((phase / _TURN % 1).astype(real))
    plan = Psf(device, samples, stop="round", precision=precision)
    psf, otf = plan(turns, alpha_rad=alpha, psi_rad=psi)
    yield outcome("round stop", plan, (psf.download(), otf.download()), phase, "round")

    rows, columns = samples - 1, samples + 3
    panel = SlmPanel("self-test", rows, columns, 100.0, 1.0, 60.0, stroke_rad=5.5)
    optics = OpticalSystem(aperture_um=100.0 * (samples - 2.5))
    codes = np.random.default_rng(4).integers(0, 256, (rows, columns)).astype(np.uint8)
    plan = Psf(device, samples, precision=precision)
    shown = plan.panel_turns(device.upload(codes), turns, panel, optics)
    across = panel.stop_px(optics.aperture_um)
    row, column = (np.rint(x * across / 2 + (n - 1) / 2).clip(0, n - 1).astype(int) for n in codes.shape)
    phase = phase + panel.stroke_rad / 255 * codes[np.ix_(row, column)].astype(np.float64)
    yield Outcome(
        f"psf panel, {_at(size, precision)}",
        ("psf_panel",),
        "rad",
        _wrapped(shown.download(), phase),
        _TURN * 2 * _eps(precision) + 4 * _eps("float64") * float(np.abs(phase).max()),
    )
    psf, otf = plan(shown)
    yield outcome("through a panel", plan, (psf.download(), otf.download()), phase, "square")


# ---- restoration ------------------------------------------------------------------------------------------


def check_wiener(device: Device, size: Size, precision: str) -> Iterator[Outcome]:
    """Filters of separable and other blurs, with one level of noise and with one per frequency."""
    ny, nx = size
    half = (ny, nx // 2 + 1)
    rng = np.random.default_rng(5)
    kind = np.result_type(device.real_type(precision), np.complex64)
    rows, columns = _axes(size, precision)
    columns[1] = 0  # here the filter is 0
    noise = (2.0 ** rng.integers(-12, 1, half)).astype(np.float64)
    otf = (rng.normal(size=half) + 1j * rng.normal(size=half)).astype(kind)
    otf[0, 1] = 0
    plan = WienerFilter(device, size, precision=precision)
    for form, nsr in (("one level", 2.0**-7), ("level per frequency", noise), ("no noise", 0.0)):
        for kernel, found, wanted in (
            (
                "wiener_axes",
                plan.from_otf_axes(rows, columns, nsr).download(),
                reference.wiener_of_axes(rows, columns, nsr),
            ),
            ("wiener_spectrum", plan.from_otf(otf, nsr).download(), reference.wiener(otf, nsr)),
        ):
            zero = wanted == 0
            error = np.where(zero, np.where(found == 0, 0, np.inf), np.abs(found - wanted))
            yield Outcome(
                f"{kernel} {form}, {_at(size, precision)}",
                (kernel,),
                "|dG|/|G|",
                float((error / np.where(zero, 1, np.abs(wanted))).max()),
                8 * _eps(precision),  # a complex product, a squared modulus, a quotient, a product
            )

    for half_rows in (0, 1):
        yield from _laid_out(device, otf, (rows.size, columns.size), half_rows, precision)


def _laid_out(
    device: Device,
    gain: NDArray[np.complexfloating[Any, Any]],
    padded: Size,
    half_rows: int,
    precision: str,
) -> Iterator[Outcome]:
    """What the restoration reads: blocks of the axis of which half is held, the other whole, both mixed."""
    (ny, nx), block, scale = padded, 4, 0.375
    rng = np.random.default_rng(6)
    short, long = (ny, nx) if half_rows else (nx, ny)
    held = short // 2 + 1
    shorts = -(-held // block) * block
    frequency = np.full(shorts, -1, np.int32)
    frequency[:held] = rng.permutation(held)
    order = rng.permutation(long).astype(np.int32)
    real = device.real_type(precision)
    defines = {
        "REAL_IS_DOUBLE": precision == "float64",
        "WIENER_BLOCK": block,
        "WIENER_HALF_ROWS": half_rows,
    }
    program = Program(device, "wiener.cl", defines)
    tables = (device.upload(order), device.upload(frequency))
    sides = (np.int32(ny), np.int32(nx))
    where = f"half of the {'rows' if half_rows else 'columns'}, {_at((ny, nx), precision)}"

    def outcome(kernel: str, found: NDArray[Any], wanted: NDArray[Any], bound: float) -> Outcome:
        blocks = np.zeros((shorts, found.shape[1]), complex)
        blocks[:held] = wanted
        there = found[..., 0, :] + 1j * found[..., 1, :]
        apart = np.abs(there.transpose(0, 2, 1).reshape(blocks.shape) - blocks)
        return Outcome(
            f"{kernel}, {where}", (kernel,), "|dG|", float(apart.max() / np.abs(blocks).max()), bound
        )

    out = device.empty((shorts // block, long, 2, block), real)
    program.launch(
        "wiener_arrange", (shorts, long), None,
        device.upload(gain), *tables, out, *sides, real.type(scale),
    )()  # fmt: skip
    # What the inverse real transform makes of any gain at all.
    whole = np.fft.fft2(np.fft.irfft2(gain.astype(np.complex128), s=(ny, nx)))
    half = whole if half_rows else gain.astype(np.complex128).T
    wanted = scale * half[frequency[:held]][:, order]
    # The mean of two, and a product; and what two transforms there and back lose on the page.
    bound = 2 * _eps(precision) + 10 * _eps("float64")
    yield outcome("wiener_arrange", out.download(), wanted, bound)


def check_restore(device: Device, size: Size, precision: str) -> Iterator[Outcome]:
    """Both families, every pixel type, filters formed and filters given; groups without local memory too."""
    cramped = copy.copy(device)
    cramped.facts = replace(device.facts, local_memory_bytes=64)
    kinds = ["uint8", "uint16", "float32"] + (["float64"] if precision == "float64" else [])
    for family, opened, form in (
        *((family, device, family) for family in FAMILIES),
        ("groups", cramped, "groups, global memory"),
    ):
        for kind in kinds if opened is device else kinds[-1:]:
            plan = Restore(
                opened, size, family=family, precision=precision, in_dtype=kind, out_dtype=kind, padding=3
            )
            yield _restored(plan, f"restore {form} of {kind}, {_at(size, precision)}", precision)
        if precision == "float32":
            for kind in ("uint8", "uint16") if opened is device else ():
                plan = Restore(
                    opened, size, family=family, in_dtype=kind, out_dtype=kind, spectrum_dtype=np.float16
                )
                yield _restored(
                    plan, f"restore {form} of {kind} in halves, {_at(size, precision)}", precision
                )


_RESTORE_KERNELS = {
    "lanes": ("restore_frame",),
    "groups": ("restore_rows_forward", "restore_columns", "restore_rows_inverse"),
}


def _restored(plan: Restore, name: str, precision: str) -> Outcome:
    rng = np.random.default_rng(6)
    kind = plan.in_dtype
    top = int(np.iinfo(kind).max) if kind.kind == "u" else 255
    # Between the ends of the range, so that little is clamped.
    frame = (top * rng.uniform(0.2, 0.8, plan.shape)).astype(kind)
    ny, nx = plan.padded_shape
    rows, columns = _axes(plan.padded_shape, precision)
    plan.set_filter_axes(rows, columns, 2.0**-6, slot=0)
    turn = np.exp(-_TURN * 1j * (np.fft.fftfreq(ny)[:, None] + 2 * np.fft.rfftfreq(nx)[None, :]))
    gain = (0.75 * turn).astype(np.result_type(precision, np.complex64))
    plan.set_filter(gain, slot=1)
    noise = 2.0 ** np.random.default_rng(7).integers(-6, 1, gain.shape)
    plan.set_filter_axes(rows, columns, noise, slot=2)
    error, bound = 0.0, 0.0
    limit = 5e-7 if precision == "float32" else 1e-14
    halves = plan.spectrum_dtype == np.float16
    filters = (
        reference.wiener_of_axes(rows, columns, 2.0**-6),
        gain,
        reference.wiener_of_axes(rows, columns, noise),
    )
    for slot, wanted_gain in enumerate(filters):
        wanted = reference.restore(frame, wanted_gain, plan.padded_shape)
        found = plan.restore(frame, slot).astype(np.float64)
        if kind.kind == "u":
            # A code may be off by half a step, and by the whole L2 error in one pixel.
            error = max(error, _largest(found - np.clip(wanted, 0, top)))
            bound = max(bound, 3 * top / 255 if halves else 0.5 + limit * float(np.linalg.norm(wanted)))
        else:
            error, bound = max(error, _relative(found, wanted)), limit
            if kind.name != precision:  # stored in float32 after float64 arithmetic
                bound = _eps("float32") / 2
    return Outcome(
        name,
        (*_RESTORE_KERNELS[plan.family], "wiener_axes", "wiener_arrange"),
        "levels" if kind.kind == "u" else "relative L2",
        error,
        bound,
    )


# ---- images -----------------------------------------------------------------------------------------------


def check_image_prep(device: Device, size: Size, precision: str) -> Iterator[Outcome]:
    """Both raw types, both results, one value and one per pixel, of a region."""
    del precision  # float32 is all a camera needs
    rng = np.random.default_rng(7)
    region = Region(1, 2, size[0] - 2, size[1] - 3)
    held = np.s_[region.top : region.top + region.rows, region.left : region.left + region.columns]
    for in_dtype, out_dtype, form in itertools.product(
        ("uint8", "uint16"), ("float32", "uint8"), ("one value", "per pixel")
    ):
        frame = rng.integers(0, np.iinfo(in_dtype).max, size, endpoint=True).astype(in_dtype)
        shape = size if form == "per pixel" else ()
        to_bytes = out_dtype == "uint8"
        if to_bytes:  # every product exact, ties included, so that bytes must be too
            dark = rng.integers(0, 160, shape) / 4
            gain = rng.integers(1, 6, shape) / (4 if in_dtype == "uint8" else 1024)
        else:
            dark, gain = rng.uniform(0, 40, shape), rng.uniform(0.2, 2, shape)
        plan = ImagePrep(
            device, size, region=region, in_dtype=in_dtype, out_dtype=out_dtype, dark=dark, gain=gain
        )
        corner = (region.top, region.left, region.rows, region.columns)
        wanted = reference.image_prep(frame, dark, gain, region=corner, to_bytes=to_bytes)
        # dark, gain, difference and product each round once, by half an eps.
        limit = (2 * _eps("float32") * gain * (frame + np.abs(dark)))[held]
        yield _worst(
            f"image_prep {in_dtype} to {out_dtype}, {form}, {_at(size, 'float32')}",
            ("image_prep",),
            "levels",
            np.abs(plan.prepare(frame) - wanted),
            np.zeros(region.shape) if to_bytes else limit,
        )


def check_ssd_search(device: Device, size: Size, precision: str) -> Iterator[Outcome]:
    """Both families, every pixel type, both scores, three templates in windows of their own, patches too."""
    del precision  # scores are integers, or float32
    template = (
        size[0] // 2,
        size[1] // 3 | 1,
    )  # odd columns; at the full size more than one tile in lanes too
    search = (size[0] - 4, size[1] - 3)
    origins = np.array([(0, 0), (4, 3), (1, 2)])
    for family, dtype, score in itertools.product(
        FAMILIES, ("uint8", "uint16", "float32"), ("ssd", "gain_offset")
    ):
        rng = np.random.default_rng(8)
        if dtype == "float32":
            image = rng.normal(0.4, 0.2, size).astype(np.float32)
        else:
            image = rng.integers(0, np.iinfo(dtype).max, size, endpoint=True).astype(dtype)
        places = origins + np.array([2, 4])
        templates = np.stack([image[y : y + template[0], x : x + template[1]] for y, x in places])
        templates[2] = templates[2, ::-1]  # one that fits nowhere
        plan = SsdSearch(
            device, size, template, search, 3, dtype=dtype, score=score, family=family, patch_margin=2
        )
        plan.set_templates(templates)
        plan.set_windows(origins)
        found = plan.search(image)
        errors, limits = [], []
        for k, scores in enumerate(plan.score_maps()):
            origin = (int(origins[k, 0]), int(origins[k, 1]))
            exact = image if dtype == "uint8" else image.astype(np.float64)
            best, wanted = reference.ssd_search(exact, templates[k], origin, search, score=score)
            errors.append(np.abs(scores - wanted))
            limits.append(_search_limit(image, templates[k], origin, search, score, wanted))
            if not _found_as_it_lies(found, k, image, template, origin, best, scores):
                errors[-1] = np.full_like(errors[-1], math.inf)
        yield _worst(
            f"ssd_search {family} {dtype} {score}, {_at(size, 'float32')}",
            ("ssd_search", "ssd_search_best"),
            "score",
            np.stack(errors),
            np.stack(limits),
        )


def _search_limit(
    image: Array, template: Array, origin: tuple[int, int], search: Size, score: str, wanted: Array
) -> Array:
    """Bound of each score, from how its sums round (docs/maths.md, eqs. S4 and S6)."""
    rows, columns = template.shape
    eps = _eps("float32")
    if score == "ssd":
        exact = image.dtype == np.uint8
        return np.zeros(wanted.shape) if exact else eps * (rows + columns + 2) / 2 * wanted
    window = image[origin[0] : origin[0] + search[0], origin[1] : origin[1] + search[1]].astype(np.float64)
    places = np.lib.stride_tricks.sliding_window_view(window, template.shape)
    if image.dtype == np.uint8:
        # The ratio rounds eight times; the covariance's last term, at most a unit a tap, twice.
        power = places.var(axis=(2, 3)) * template.astype(np.float64).var()
        return np.asarray(eps * (8 + 4 / np.sqrt(power)))
    # Three sums of rows + columns roundings, one of them doubled; each centred value to
    # half an eps of the span.
    span = np.ptp(window) / places.std(axis=(2, 3))
    return np.asarray(eps * (2 * (rows + columns + 2) + 4 * span + 8))


def _found_as_it_lies(
    found: SearchResult,
    k: int,
    image: Array,
    template: Size,
    origin: tuple[int, int],
    best: Size,
    scores: Array,
) -> bool:
    """Whether place, neighbourhood and patch are those of the scores, and the place is the reference's."""
    y, x = best[0] - origin[0], best[1] - origin[1]
    around = np.pad(scores, 1, constant_values=np.inf)[y : y + 3, x : x + 3]
    edged = np.pad(image, 2, mode="edge").astype(np.float32)
    patch = edged[best[0] : best[0] + template[0] + 4, best[1] : best[1] + template[1] + 4]
    return (
        tuple(found.best_yx[k]) == best
        and np.array_equal(found.neighbourhood[k], around)
        and found.patches is not None
        and np.array_equal(found.patches[k], patch)
    )


# ---- measures ---------------------------------------------------------------------------------------------


def _eps(precision: str) -> float:
    return float(np.finfo(precision).eps)


def _transforms(precision: str, size: int) -> float:
    """Bound of a transform there and back: rounding errors add like a random walk over its stages."""
    return _eps(precision) * (2 + 0.5 * math.log2(size))


def _at(size: Size, precision: str) -> str:
    return f"{precision}, {size[0]} x {size[1]}"


def _largest(difference: Array) -> float:
    """Largest modulus; infinite, not lost, where there is NaN."""
    return float(np.nan_to_num(np.abs(difference), nan=math.inf).max())


def _relative(found: Array, wanted: Array) -> float:
    error = float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))
    return error if math.isfinite(error) else math.inf


def _wrapped(turns: Array, phase_rad: Array) -> float:
    """Largest difference modulo a turn, in radians; infinite beyond [0, 1), where no answer lies."""
    if not ((turns >= 0) & (turns < 1)).all():
        return math.inf
    difference = turns - phase_rad / _TURN
    return _TURN * _largest(difference - np.rint(difference))


def _worst(name: str, kernels: tuple[str, ...], measure: str, errors: Array, limits: Array) -> Outcome:
    """Take the place that comes nearest its bound, or goes farthest beyond."""
    errors = np.nan_to_num(errors, nan=math.inf)
    with np.errstate(over="ignore"):  # beyond a limit of 0 lies infinity
        share = np.where(errors > 0, errors / np.maximum(limits, 1e-300), 0)
    at = np.unravel_index(int(share.argmax()), share.shape)
    return Outcome(name, kernels, measure, float(errors[at]), float(limits[at]))


def _axes(shape: Size, precision: str) -> list[Array]:
    """Return a coded camera's transfer along each axis, as the working precision holds it."""
    optics = OpticalSystem()
    kind = np.result_type(precision, np.complex64)
    return [reference.otf_1d(optics.frequency_axis(n), 20.0, 10.0).astype(kind) for n in shape]


OPERATIONS: dict[str, Operation] = {
    "pupil_phase": Operation(check_pupil_phase, (101, 67), (13, 9)),
    "slm_encode": Operation(check_slm_encode, (121, 167), (13, 17)),
    "otf": Operation(check_otf, (7, 501), (7, 19)),
    "psf": Operation(check_psf, (64, 64), (8, 8)),
    "wiener": Operation(check_wiener, (45, 35), (9, 7)),
    "restore": Operation(check_restore, (93, 57), (19, 37)),
    "image_prep": Operation(check_image_prep, (53, 37), (9, 11), ("float32",)),
    "ssd_search": Operation(check_ssd_search, (61, 83), (29, 43), ("float32",)),
}
"""Every operation, in the order of the frame's path from mask to feature."""
