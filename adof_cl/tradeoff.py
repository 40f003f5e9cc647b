"""Accuracy against speed: every knob that trades one for the other, turned on one device, against the truth.

Times are taken in turns. Errors are distances from where the twin's features really are, at known depth
unless the knob is depth itself. Two things come of it: readings, a table for people, and what plans are made
of: the times of every chain, and their errors over masks and defocus.
"""

from __future__ import annotations

import math
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from adof_cl import __version__, reference
from adof_cl.device import Device, DeviceArray
from adof_cl.loop import HOLE, PEG
from adof_cl.noise import noise_to_signal
from adof_cl.optics import Mask, OpticalSystem
from adof_cl.otf import Otf1d, SeparableMaskOtf, stationary_phase_otf
from adof_cl.otf_table import OtfTable
from adof_cl.pipeline import Blur, CameraPipeline, WindowedPipeline
from adof_cl.profile import (
    REFERENCE,
    REFINES,
    RESTORATIONS,
    SCHEMA,
    SEARCHES,
    TEMPLATE_PX,
    WINDOWS,
    Chain,
    ChainError,
    ChainTime,
    DeviceProfile,
    FormTime,
    Reading,
)
from adof_cl.restore import Restore
from adof_cl.scene import Scene, SceneObject
from adof_cl.slm_encode import SlmEncode
from adof_cl.specimen import FARTHEST_UM, PARTS, Exposure, Pixels, Specimen
from adof_cl.tracking import Measurement, Template, TemplateTracker, TrackingLimits
from adof_cl.turns import Clock, Rounds, Spread, take_turns

Array = NDArray[np.float64]
Places = Mapping[str, Array]
Transfer = NDArray[np.complexfloating[Any, Any]]
Axes = Sequence[Transfer]
Route = Callable[[float, float], Axes]
Tell = Callable[[str, str], None]

STAGES = ("optics", "restoration", "search", "refresh")
LIMITS = TrackingLimits(mismatch=0.7)
NSR = 0.003
"""Of filters here and in plans: for places, less than looks best (decision 0020)."""
SHARE = 0.6
"""Largest |psi|/(3 alpha) of the mask under which knobs are turned: the loop's."""

ALPHAS_RAD = (3.0, 6.0, 12.0, 20.0, 28.0, 37.5, 50.0, 75.0)
SHARES = (0.0, 0.3, 0.45, 0.6)
DEFOCUS_RAD = (0.0, 1.0, 2.0, 3.0, 4.5, 6.0, 9.0)
"""Where the errors of plans are measured: masks and shares of defocus; and defocus without a mask."""
NOISES = (0.0, 1.0, 2.0, 4.0)
"""Of the design's: at how much noise."""

_SEARCH_PX = 48  # while other knobs are turned
_MOVED_UM = 33.0  # parts are moved by up to this between template and frame
_EXPECTED_PX = 2.0  # and are looked for this far off


def default_scene() -> Scene:
    """Return the scene under which knobs are turned when none is given: a peg in focus, a hole behind it."""
    accuracy = {"approach": 20.0, "dock": 2.0}
    peg = SceneObject("peg", 0.0, extent_px=37, accuracy_um=accuracy)
    hole = SceneObject("hole", 2000.0, extent_px=103, speed_um_per_s=500.0, accuracy_um=accuracy)
    return Scene((peg, hole))


# ---- what is measured ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Setting:
    """One setting of one knob.

    Attributes
    ----------
    run
        What is timed.
    places
        Where it finds each part's features in an exposure, (k, 2); NaN where lost.
    image
        What it restores an exposure to, for a part; None where nothing is restored.
    frames
        What `run` does serves so many frames.
    depths_um
        Errors of depth, where the knob bears on it.
    """

    stage: str
    knob: str
    name: str
    run: Callable[[], object]
    places: Callable[[Specimen, Exposure, Places], Places]
    image: Callable[[Specimen, Exposure, str], Pixels] | None = None
    frames: int = 1
    whole_chain: bool = True
    depths_um: Sequence[float] = ()


@dataclass(frozen=True, eq=False)
class _Sample:
    specimen: Specimen
    exposure: Exposure
    expected: Places


def _found(measured: Sequence[Measurement]) -> Array:
    return np.array([np.full(2, np.nan) if m.lost else m.feature_xy_px for m in measured])


def off_px(found: Array, truth: Array) -> float:
    """Return how far the worst of the features is off; infinite when one was lost."""
    distance = np.linalg.norm(found - truth[: len(found)], axis=1)
    return float(np.where(np.isfinite(distance), distance, np.inf).max())


def highest(samples: Sequence[float], most: float = 0.95) -> float:
    """Return what the given share of the samples do not exceed; infinite samples count."""
    return float(np.quantile(np.asarray(samples, dtype=np.float64), most, method="higher"))


class Sweep:
    """Everything that turning knobs needs: specimens, exposures, the exact restoration to compare with.

    Parameters
    ----------
    device
        The opened device.
    scene
        Its first and last object's depths, its noise and its speeds.
    seeds
        One specimen each.
    """

    def __init__(self, device: Device, scene: Scene, seeds: Sequence[int]) -> None:
        self.device = device
        self.scene = scene
        nominal = nominal_noise_grey(Specimen(device, seeds[0]))
        self.specimens = [Specimen(device, seed, noise=scene.noise_grey / nominal) for seed in seeds]
        self.optics = self.specimens[0].optics
        self.shape = self.specimens[0].shape
        depths = [thing.depth_um for thing in scene.objects]
        self.depth_um = float(np.clip(max(depths) - min(depths), 100.0, FARTHEST_UM))
        self.mask = joint_mask(self.optics, self.depth_um)
        for specimen in self.specimens:
            for part in PARTS:
                specimen.templates(part, 20)
        self.rng = np.random.default_rng(0)
        self.samples = [self._sample(specimen) for specimen in self.specimens for _ in range(2)]
        self.exact = Plain(
            device, self.optics, self.shape, precision="float64" if device.facts.fp64 else "float32"
        )

    def _sample(self, specimen: Specimen) -> _Sample:
        place_at_random(specimen, self.depth_um, self.rng)
        exposure = specimen.expose(self.mask)
        return _Sample(specimen, exposure, expected_places(exposure, self.rng))

    def pipeline(self, chain: Chain, parts: Sequence[str] = PARTS) -> WindowedPipeline:
        """Build a chain for each part, taught from the first specimen."""
        window = chain.window(self.shape)
        made = WindowedPipeline(self.device, self.optics, self.shape, dict.fromkeys(parts, window), nsr=NSR)
        teach(made, self.specimens[0], chain.template_px)
        return made


def nominal_noise_grey(specimen: Specimen) -> float:
    """Return the twin's noise where parts are brightest: shot and read noise, of 255."""
    design = specimen.design
    electrons = 0.6 * design.exposure_level * design.full_well_e
    return 255 * math.sqrt(electrons + design.read_noise_e**2) / design.full_well_e


def joint_mask(optics: OpticalSystem, depth_um: float, share: float = SHARE) -> Mask:
    """Return the mask for parts at 0 and at `depth_um`: focus between them in phase, cubic to match."""
    half = optics.psi_rad(depth_um) / 2
    return Mask(abs(half) / (3 * share), -half)


def place_at_random(specimen: Specimen, depth_um: float, rng: np.random.Generator) -> None:
    """Bring the hole to a depth, and both parts to another fraction of a pixel than their templates had."""
    hole, peg = rng.uniform(-_MOVED_UM, _MOVED_UM, (2, 2))
    specimen.place(depth_um, tuple(hole.tolist()), tuple(peg.tolist()))


def expected_places(exposure: Exposure, rng: np.random.Generator, reach_px: float = _EXPECTED_PX) -> Places:
    """Return where a loop would look for the features: near them."""
    return {part: c + rng.uniform(-reach_px, reach_px, 2) for part, c in exposure.corners_px.items()}


def teach(
    pipeline: WindowedPipeline, specimen: Specimen, side_px: int, features: int = 2, camera: int = 1
) -> None:
    """Give a pipeline a specimen's templates."""
    for part in pipeline.parts:
        made = specimen.templates(part, side_px, camera=camera, features=features)
        pipeline.set_templates(part, made, LIMITS)


class Plain:
    """The whole frame through one filter and one search after the other: room for any filter."""

    def __init__(
        self, device: Device, optics: OpticalSystem, shape: tuple[int, int], *, precision: str = "float32",
        padding: int = 64, search_px: int = 84, out: type[np.generic] = np.uint8,
    ) -> None:  # fmt: skip
        self.device, self.optics, self.shape = device, optics, shape
        self.restore = Restore(
            device, shape, precision=precision, in_dtype=np.uint8, out_dtype=out, padding=padding
        )
        self.frame = device.empty(shape, np.uint8)
        self.out = device.empty(shape, out)
        self.search_px = search_px
        self._trackers: dict[str, TemplateTracker] = {}
        self._taught: dict[str, Specimen] = {}

    def axes(self, blur: Blur) -> Axes:
        """Return both axes' exact transfer, float64 on the host."""
        found = []
        for samples in self.restore.padded_shape:
            h = reference.otf_1d(self.optics.frequency_axis(samples), blur.alpha_rad, blur.psi_rad)
            found.append(h)
        return found

    def set_filter(self, axes: Axes, nsr: float) -> None:
        """Set the Wiener filter of a transfer along rows and columns."""
        h_rows, h_cols = axes
        self.restore.set_filter_axes(h_rows, h_cols, nsr)

    def image(self, pixels: Pixels) -> Pixels:
        """Restore with the filter that was set last."""
        return np.asarray(self.restore(self.frame.upload(pixels), self.out).download())

    def follow(self, sample: _Sample, filters: int) -> None:
        """Restore with a standing filter, once or for each part, and search for every part's features."""
        self.restore.transform(self.frame.upload(sample.exposure.pixels))
        for number, part in enumerate(PARTS):
            if number < filters:
                self.restore.apply(self.out)
            self.places(sample.specimen, part, self.out, sample.expected[part])

    def places(self, specimen: Specimen, part: str, image: DeviceArray, expected: Array) -> Array:
        """Search one image for a part's features."""
        templates = specimen.templates(part, 20)
        if part not in self._trackers:
            shape = (self.search_px, self.search_px)
            self._trackers[part] = TemplateTracker(self.device, self.shape, templates, shape, limits=LIMITS)
        elif self._taught[part] is not specimen:
            for index, template in enumerate(templates):
                self._trackers[part].replace(index, template)
        self._taught[part] = specimen
        return _found(self._trackers[part].track(image, expected))


# ---- the knobs -------------------------------------------------------------------------------------------


def _chained(
    sweep: Sweep,
    stage: str,
    knob: str,
    name: str,
    chain: Chain,
    blurs: Callable[[Specimen], Mapping[str, Blur | None]] | None = None,
) -> Setting:
    """Return a setting that is a chain of the pipeline's own."""
    pipeline = sweep.pipeline(chain)
    first = sweep.samples[0]

    def own(specimen: Specimen) -> Mapping[str, Blur | None]:
        if chain.restoration == "none":
            return dict.fromkeys(PARTS)
        return {part: specimen.blur(part, sweep.mask) for part in PARTS}

    choose = blurs or own

    def places(specimen: Specimen, exposure: Exposure, expected: Places) -> Places:
        teach(pipeline, specimen, chain.template_px)
        measured = pipeline(exposure.pixels, choose(specimen), expected)
        return {part: _found(measured[part]) for part in PARTS}

    def image(specimen: Specimen, exposure: Exposure, part: str) -> Pixels:
        pipeline(exposure.pixels, choose(specimen), exposure.corners_px)
        (y, x), window = pipeline.last_windows()[part]
        full = np.zeros(sweep.shape, np.uint8)
        full[y : y + window.shape[0], x : x + window.shape[1]] = window
        return full

    now = choose(first.specimen)
    return Setting(
        stage, knob, name,
        lambda: pipeline(first.exposure.pixels, now, first.expected),
        places,
        image if chain.restoration != "none" else None,
    )  # fmt: skip


def _filtered(
    sweep: Sweep,
    stage: str,
    knob: str,
    name: str,
    plain: Plain,
    arm: Callable[[Specimen, Exposure, str], object],
    *,
    shift: bool = False,
    one: bool = False,
    timed: Callable[[], object] | None = None,
) -> Setting:
    """Return a setting that sets some filter before it restores.

    `shift`: known displacements are undone; `one`: the filter serves all parts.
    """
    first = sweep.samples[0]

    def image(specimen: Specimen, exposure: Exposure, part: str) -> Pixels:
        arm(specimen, exposure, part)
        return plain.image(exposure.pixels)

    def places(specimen: Specimen, exposure: Exposure, expected: Places) -> Places:
        found = {}
        for number, part in enumerate(PARTS):
            aside = 0.0
            if shift:
                blur = specimen.blur(part, sweep.mask)
                aside = sweep.optics.shift_px(blur.alpha_rad, blur.psi_rad)
            if not (one and number):  # one restored image serves all parts
                image(specimen, exposure, part)
            found[part] = plain.places(specimen, part, plain.out, expected[part] + aside) - aside
        return found

    def chain() -> None:
        places(first.specimen, first.exposure, first.expected)

    return Setting(stage, knob, name, timed or chain, places, image, whole_chain=timed is None)


def optics_knobs(sweep: Sweep) -> Iterator[Setting]:
    """Ways to form a transfer function, from the exact ones to the paper's Eq. 2; timed alone."""
    plain = Plain(sweep.device, sweep.optics, sweep.shape)
    padded = plain.restore.padded_shape
    u = [sweep.optics.frequency_axis(samples) for samples in padded]
    blur = sweep.samples[0].specimen.blur(HOLE, sweep.mask)

    def setting(name: str, form: Route) -> Setting:
        def arm(specimen: Specimen, _exposure: Exposure, part: str) -> None:
            now = specimen.blur(part, sweep.mask)
            plain.set_filter(form(now.alpha_rad, now.psi_rad), NSR)

        return _filtered(
            sweep, "optics", "transfer", name, plain, arm,
            timed=lambda: form(blur.alpha_rad, blur.psi_rad),
        )  # fmt: skip

    every = np.concatenate(u)

    def route(values: Callable[[float, float], Transfer]) -> Route:
        """Cut what is formed for both axes at once."""

        def axes(alpha_rad: float, psi_rad: float) -> Axes:
            line = values(alpha_rad, psi_rad)
            return [line[: padded[0]], line[padded[0] :]]

        return axes

    for precision in ("float32", "float64") if sweep.device.facts.fp64 else ("float32",):
        exact = Otf1d.for_frame(sweep.device, sweep.optics, padded, pixel=False, precision=precision)
        yield setting(f"exact, {precision}", route(exact.evaluate))
    staying = OtfTable(sweep.device, sweep.optics, padded, pixel=False)

    def on_device(now: Blur = blur) -> None:
        staying.update([(now.alpha_rad, now.psi_rad)])
        plain.restore.set_filter_table(staying.out, NSR)

    def ended() -> None:
        on_device()
        sweep.device.wait()

    yield _filtered(
        sweep, "optics", "transfer", "exact, never leaves the device", plain,
        lambda specimen, _exposure, part: on_device(specimen.blur(part, sweep.mask)), timed=ended,
    )  # fmt: skip
    for nodes in (16, 64, 256):
        yield setting(f"quadrature, {nodes} nodes", route(partial(quadrature_otf, every, nodes=nodes)))
    for samples in (512, 1024, 2048, 4096):
        plan = SeparableMaskOtf(sweep.device, samples)
        yield setting(f"1-D FFT, {samples} samples", route(partial(_otf_by_transform, plan, every)))
    for step in (0.5, 2.0, 8.0):
        yield setting(f"table, alpha step {step:g} rad", route(InterpolatedOtf(every, step, 0.0)))
        yield setting(f"table, psi step {step:g} rad", route(InterpolatedOtf(every, 0.0, step)))
    yield setting("Eq. (2), all phases", route(partial(stationary_phase_otf, every)))
    yield setting("Eq. (2) as printed", route(partial(stationary_phase_otf, every, as_printed=True)))


def _otf_by_transform(plan: SeparableMaskOtf, u: Array, alpha_rad: float, psi_rad: float) -> Transfer:
    values = plan(alpha_rad * plan.x**3 + psi_rad * plan.x**2).download()
    at = np.abs(u)
    found = CubicSpline(plan.u, values)(np.minimum(at, 2.0)) * (at < 2)
    return np.asarray(np.where(u < 0, found.conj(), found))


def quadrature_otf(u: Array, alpha_rad: float, psi_rad: float, nodes: int) -> NDArray[np.complex128]:
    """Return H by Gauss-Legendre quadrature with a fixed number of nodes (docs/maths.md, eq. O1)."""
    x, weights = np.polynomial.legendre.leggauss(nodes)
    at = np.minimum(np.abs(u), 2.0)[:, None]
    b = 1 - at / 2
    phase = alpha_rad * (3 * (b * x) ** 2 * at + at**3 / 4) + 2 * psi_rad * b * x * at
    h = (b * np.exp(1j * phase)) @ weights / 2
    return np.asarray(np.where(u < 0, h.conj(), h))


class InterpolatedOtf:
    """Transfer functions kept at steps of alpha or psi, and linear between them; a step of 0: exact there."""

    def __init__(self, u: Array, alpha_step_rad: float, psi_step_rad: float) -> None:
        self._u = u
        self._steps = (alpha_step_rad, psi_step_rad)
        self._kept: dict[tuple[float, float], NDArray[np.complex128]] = {}

    def __call__(self, alpha_rad: float, psi_rad: float) -> NDArray[np.complex128]:
        """Return H, from two kept neighbours."""
        axis = 0 if self._steps[0] else 1
        value, step = (alpha_rad, psi_rad)[axis], self._steps[axis]
        low = step * math.floor(value / step)
        share = (value - low) / step
        ends = [(v, psi_rad) if axis == 0 else (alpha_rad, v) for v in (low, low + step)]
        return np.asarray((1 - share) * self._at(*ends[0]) + share * self._at(*ends[1]))

    def _at(self, alpha_rad: float, psi_rad: float) -> NDArray[np.complex128]:
        key = alpha_rad, psi_rad
        if key not in self._kept:
            self._kept[key] = reference.otf_1d(self._u, alpha_rad, psi_rad)
        return self._kept[key]


def restoration_knobs(sweep: Sweep) -> Iterator[Setting]:
    """Which filter, at what noise, how padded, where, and in which precision."""
    usual = Chain("float32", 0, "gauss_newton", 20, _SEARCH_PX)
    stage = "restoration"
    plain = Plain(sweep.device, sweep.optics, sweep.shape)

    def own(specimen: Specimen, _exposure: Exposure, part: str) -> None:
        plain.set_filter(plain.axes(specimen.blur(part, sweep.mask)), NSR)

    def focus(_specimen: Specimen, _exposure: Exposure, _part: str) -> None:
        plain.set_filter(plain.axes(Blur(sweep.mask.alpha_rad, 0.0)), NSR)

    def average(_specimen: Specimen, _exposure: Exposure, _part: str) -> None:
        plain.set_filter(_aligned_average(plain, sweep.mask, sweep.depth_um), NSR)

    first = sweep.samples[0]

    def unchanging(
        name: str,
        arm: Callable[[Specimen, Exposure, str], object],
        shift: bool = False,
        one: bool = False,
        plain: Plain = plain,
    ) -> Setting:
        """Return a setting whose filter stands: only frames change."""
        setting = _filtered(sweep, stage, "filter", name, plain, arm, shift=shift, one=one)
        return replace(setting, run=lambda: plain.follow(first, 1 if one else 2))

    yield _chained(sweep, stage, "filter", "none", replace(usual, restoration="none"))
    yield unchanging("one, in focus (the paper's)", focus, False, True)
    yield unchanging("one, in focus, shifts undone", focus, True, True)
    yield unchanging("one, shift-aligned average", average, True, True)
    yield unchanging("own depth each", own)

    for nsr in (1e-4, 1e-3, 3e-3, 1e-2, 1e-1):

        def constant(specimen: Specimen, _exposure: Exposure, part: str, nsr: float = nsr) -> None:
            plain.set_filter(plain.axes(specimen.blur(part, sweep.mask)), nsr)

        yield replace(unchanging("", constant), knob="nsr", name=f"{nsr:g}")

    def fitted(specimen: Specimen, exposure: Exposure, part: str, plain: Plain = plain) -> None:
        rows, columns = plain.axes(specimen.blur(part, sweep.mask))
        ny, nx = plain.restore.padded_shape
        otf = np.outer(rows, columns[: nx // 2 + 1])
        nsr = noise_to_signal(exposure.pixels, otf, (ny, nx))
        plain.restore.set_filter_axes(rows, columns, nsr)

    stored = Plain(sweep.device, sweep.optics, sweep.shape)
    kept = unchanging("", partial(fitted, plain=stored), plain=stored)
    yield replace(kept, knob="nsr", name="of each frequency, filter kept")
    yield _filtered(sweep, stage, "nsr", "of each frequency, fitted anew", plain, fitted)

    for padding in (0, 16, 32, 64, 100):
        other = Plain(sweep.device, sweep.optics, sweep.shape, padding=padding)

        def padded(specimen: Specimen, _exposure: Exposure, part: str, other: Plain = other) -> None:
            other.set_filter(other.axes(specimen.blur(part, sweep.mask)), NSR)

        made = _filtered(sweep, stage, "padding", f"{padding} px", other, padded)
        yield replace(made, run=partial(other.follow, first, 2))

    for window in WINDOWS:
        name = f"{window} px windows" if window else "whole region"
        if window and window < 128:  # the hole's features and their search do not fit
            continue
        yield _chained(sweep, stage, "where", name, replace(usual, window_px=window))
    for restoration in RESTORATIONS[1:]:
        if restoration != "float64" or sweep.device.facts.fp64:
            yield _chained(sweep, stage, "precision", restoration, replace(usual, restoration=restoration))


def _aligned_average(plain: Plain, mask: Mask, depth_um: float) -> Axes:
    """Return each axis' transfer averaged over the depths, each depth's shift taken out."""
    axes = []
    for samples in plain.restore.padded_shape:
        u, cycles = plain.optics.frequency_axis(samples), np.fft.fftfreq(samples)
        total = np.zeros(samples, np.complex128)
        depths = np.linspace(0, depth_um, 9)
        for depth in depths:
            psi = mask.psi_rad(plain.optics, float(depth))
            shift = plain.optics.shift_px(mask.alpha_rad, psi)
            total += reference.otf_1d(u, mask.alpha_rad, psi) * np.exp(2j * np.pi * cycles * shift)
        total /= len(depths)
        if samples % 2 == 0:
            total[samples // 2] = total[samples // 2].real
        axes.append(total)
    return axes


def search_knobs(sweep: Sweep) -> Iterator[Setting]:
    """How far a place is refined, the template's and the window's size, and a search from coarse to fine."""
    usual = Chain("float32", 192, "gauss_newton", 20, _SEARCH_PX)
    for refine in REFINES:
        yield _chained(sweep, "search", "refinement", refine.replace("_", "-"), replace(usual, refine=refine))
    for side in (8, 12, 16, 20, 28):
        name = f"{side} x {side} px"
        yield _chained(sweep, "search", "template", name, replace(usual, template_px=side))
    for search in (32, 48, 64, 96):
        name = f"{search} x {search} px"
        yield _chained(
            sweep, "search", "search window", name, replace(usual, search_px=search, window_px=256)
        )
    yield _chained(sweep, "search", "pyramid", "none", replace(usual, window_px=0, search_px=64))
    yield _pyramid(sweep)


def _pyramid(sweep: Sweep) -> Setting:
    """Return a search of the frame restored at half its resolution, then at full in small windows."""
    rows, columns = sweep.shape
    half = replace(sweep.optics, pixel_pitch_um=2 * sweep.optics.pixel_pitch_um)
    coarse = CameraPipeline(
        sweep.device, half, (rows // 2, columns // 2), PARTS, nsr=NSR, search_shape=(32, 32),
        refine="quadratic",
    )  # fmt: skip
    fine = sweep.pipeline(Chain("float32", 192, "gauss_newton", 20, 32))

    def learn(specimen: Specimen) -> None:
        for part in PARTS:
            coarse.set_templates(part, [_halved(t) for t in specimen.templates(part, 20)], LIMITS)
        teach(fine, specimen, 20)

    def track(specimen: Specimen, exposure: Exposure, expected: Places) -> Places:
        halved = _half(exposure.pixels)
        blurs: dict[str, Blur | None] = {part: specimen.blur(part, sweep.mask) for part in PARTS}
        near = {}
        found = coarse(halved, blurs, {part: (expected[part] - 0.5) / 2 for part in PARTS})
        for part in PARTS:
            seen = _found(found[part]) * 2 + 0.5
            near[part] = np.where(np.isfinite(seen), seen, expected[part])
        measured = fine(exposure.pixels, blurs, near)
        return {part: _found(measured[part]) for part in PARTS}

    def places(specimen: Specimen, exposure: Exposure, expected: Places) -> Places:
        learn(specimen)
        return track(specimen, exposure, expected)

    first = sweep.samples[0]
    learn(first.specimen)
    return Setting(
        "search", "pyramid", "half resolution, then full",
        lambda: track(first.specimen, first.exposure, first.expected), places,
    )  # fmt: skip


def _half(pixels: Pixels) -> Pixels:
    rows, columns = pixels.shape
    smaller = cv2.resize(pixels, (columns // 2, rows // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(smaller, dtype=np.uint8)


def _halved(template: Template) -> Template:
    """Return a template at half its resolution."""
    pixels = _half(template.pixels)
    around = np.pad(pixels, 8, mode="edge")
    middle = (np.array(around.shape)[::-1] - 1) / 2
    made = Template.cut(around, middle, pixels.shape, noise=template.noise / 2, sigma_limit_px=10.0)
    return made.anchored((template.anchor_yx - 0.5) / 2)


def refresh_knobs(sweep: Sweep) -> Iterator[Setting]:
    """How often filters, mask and stereo follow a part that moves in depth."""
    speed = max(abs(thing.speed_um_per_s) for thing in sweep.scene.objects) or 100.0
    frame_um = speed / sweep.scene.frame_rate_hz
    first = sweep.samples[0]
    chain = Chain("float32", 192, "gauss_newton", 20, _SEARCH_PX)
    forming = sweep.pipeline(chain)
    blurs = {part: first.specimen.blur(part, sweep.mask) for part in PARTS}
    other = {part: Blur(blur.alpha_rad, blur.psi_rad + 0.05) for part, blur in blurs.items()}
    turn = [0]

    def anew() -> None:
        turn[0] ^= 1
        forming(first.exposure.pixels, other if turn[0] else blurs, first.expected)

    for frames in (1, 2, 4, 8, 16):
        behind_um = (frames - 1) * frame_um

        def stale(specimen: Specimen, behind_um: float = behind_um) -> Mapping[str, Blur | None]:
            found: dict[str, Blur | None] = {PEG: specimen.blur(PEG, sweep.mask)}
            found[HOLE] = specimen.blur(HOLE, sweep.mask, depth_error_um=behind_um)
            return found

        made = _chained(sweep, "refresh", "filters", f"every {frames} frames, {speed:g} um/s", chain, stale)
        still = made.run

        # One frame in `frames` forms both filters; the others do not.
        def run(frames: int = frames, still: Callable[[], object] = still) -> None:
            anew()
            for _ in range(frames - 1):
                still()

        yield replace(made, run=run, frames=frames)

    encoder = SlmEncode(sweep.device, first.specimen.design.panel, sweep.optics)
    for frames in (1, 16, 64):
        late = joint_mask(sweep.optics, max(sweep.depth_um - (frames - 1) * frame_um, 100.0))
        yield _masked(sweep, f"every {frames} frames, {speed:g} um/s", late, encoder, frames)

    pipelines = [sweep.pipeline(chain), sweep.pipeline(chain)]

    def pair(frames: int) -> None:
        for number in range(frames):
            pipelines[0](first.exposure.pixels, blurs, first.expected)
            if number == 0:
                pipelines[1](first.exposure.pixels, blurs, first.expected)

    depth_errors = [e for s in sweep.specimens for e in stereo_depth_error_um(sweep, s, pipelines, chain)]
    plain = _chained(sweep, "refresh", "stereo", "", chain)
    for frames in (1, 2, 4, 8):
        yield replace(
            plain, name=f"every {frames} frames, {speed:g} um/s",
            run=partial(pair, frames), frames=frames,
            depths_um=[abs(error + (frames - 1) * frame_um) for error in depth_errors],
        )  # fmt: skip


def _masked(sweep: Sweep, name: str, mask: Mask, encoder: SlmEncode, frames: int) -> Setting:
    """Return a setting under a mask that was chosen for a nearer hole."""
    chain = Chain("float32", 192, "gauss_newton", 20, _SEARCH_PX)
    pipeline = sweep.pipeline(chain)

    def places(specimen: Specimen, _exposure: Exposure, expected: Places) -> Places:
        exposure = specimen.expose(mask)
        moved = {p: expected[p] - _exposure.corners_px[p] + exposure.corners_px[p] for p in PARTS}
        teach(pipeline, specimen, 20)
        measured = pipeline(exposure.pixels, {p: specimen.blur(p, mask) for p in PARTS}, moved)
        return {p: _found(measured[p]) - exposure.corners_px[p] + _exposure.corners_px[p] for p in PARTS}

    return Setting(
        "refresh", "mask", name, lambda: encoder.codes(mask), places,
        frames=frames, whole_chain=False,
    )  # fmt: skip


def stereo_depth_error_um(
    sweep: Sweep, specimen: Specimen, pipelines: Sequence[WindowedPipeline], chain: Chain
) -> list[float]:
    """Return how far off each part's depth is when both cameras' features meet, signed."""
    exposures = [specimen.expose(sweep.mask, camera=n) for n in (1, 2)]
    middles = []
    for number, (pipeline, exposure) in enumerate(zip(pipelines, exposures, strict=True), start=1):
        teach(pipeline, specimen, chain.template_px, camera=number)
        blurs = {part: specimen.blur(part, sweep.mask, camera=number) for part in PARTS}
        measured = pipeline(exposure.pixels, blurs, expected_places(exposure, sweep.rng))
        middles.append({part: _found(measured[part]).mean(axis=0) for part in PARTS})
    errors = []
    for part in PARTS:
        seen = specimen.depth_seen_um(middles[0][part], middles[1][part])
        error = seen - float(specimen.middle_um(part)[2])
        errors.append(error if math.isfinite(error) else math.inf)
    return errors


KNOBS: Mapping[str, Callable[[Sweep], Iterator[Setting]]] = {
    "optics": optics_knobs,
    "restoration": restoration_knobs,
    "search": search_knobs,
    "refresh": refresh_knobs,
}


def turn_knobs(sweep: Sweep, stage: str, rounds: Rounds, clock: Clock, tell: Tell) -> list[Reading]:
    """Measure every setting of a stage: errors first, then times in turns."""
    settings = []
    for setting in KNOBS[stage](sweep):
        tell(stage, f"{setting.knob}: {setting.name}")
        settings.append(setting)
    measured = [_errors(sweep, setting) for setting in settings]
    tell(stage, "timing in turns")
    times = take_turns([setting.run for setting in settings], rounds, clock)
    readings = []
    for setting, seconds, (error_px, l2, depth_um) in zip(settings, times, measured, strict=True):
        readings.append(
            Reading(
                stage=stage,
                knob=setting.knob,
                setting=setting.name,
                time_s=Spread.of([s / setting.frames for s in seconds]),
                whole_chain=setting.whole_chain,
                error_px=error_px,
                error_um=error_px * sweep.optics.object_pitch_um,
                depth_um=depth_um,
                image_l2=l2,
            )
        )
    return readings


def _errors(sweep: Sweep, setting: Setting) -> tuple[float, float | None, float | None]:
    """Return the feature error (px), the image's L2 distance from exact restoration, the depth error (um)."""
    off: list[float] = []
    apart: list[float] = []
    exact = sweep.exact
    for sample in sweep.samples:
        found = setting.places(sample.specimen, sample.exposure, sample.expected)
        off += [off_px(found[part], sample.exposure.corners_px[part]) for part in PARTS]
    for sample in sweep.samples[:2] if setting.image is not None else ():
        assert setting.image is not None
        for part in PARTS:
            exact.set_filter(exact.axes(sample.specimen.blur(part, sweep.mask)), NSR)
            wanted = exact.image(sample.exposure.pixels).astype(np.float64)
            got = setting.image(sample.specimen, sample.exposure, part).astype(np.float64)
            x, y = np.rint(sample.exposure.corners_px[part].mean(axis=0)).astype(int)
            near = np.s_[max(y - 56, 0) : y + 56, max(x - 56, 0) : x + 56]
            apart.append(float(np.linalg.norm(got[near] - wanted[near]) / np.linalg.norm(wanted[near])))
    depth = highest(setting.depths_um) if setting.depths_um else None
    return highest(off), max(apart) if apart else None, depth


# ---- what plans are made of ------------------------------------------------------------------------------


def chain_times(
    sweep: Sweep, rounds: Rounds, clock: Clock = time.perf_counter
) -> tuple[list[ChainTime], list[FormTime], float]:
    """Time chains of one object, filters formed anew, and what a second object shares with the first.

    Restorations are timed in every window with one search, and searches in one window: their costs add.
    """
    restorations = [r for r in RESTORATIONS if r != "float64" or sweep.device.facts.fp64]
    base = REFERENCE
    chains = [
        (Chain(r, w, base.refine, base.template_px, base.search_px), 1)
        for r, w in product(restorations, WINDOWS)
    ]
    chains += [
        (replace(base, refine=refine, search_px=search), features)
        for refine, search, features in product(REFINES, (SEARCHES[0], SEARCHES[-1]), (1, 4))
    ]
    chains = list(dict.fromkeys(chains))
    sample = sweep.samples[0]
    mask = sweep.mask

    def still(chain: Chain, features: int, parts: Sequence[str] = (PEG,)) -> Callable[[], object]:
        pipeline = sweep.pipeline(chain, parts)
        expected = {}
        for part in parts:
            made = sample.specimen.templates(part, chain.template_px)
            repeated = [made[k % 2] for k in range(features)]
            pipeline.set_templates(part, repeated, LIMITS)
            expected[part] = np.array([sample.expected[part][k % 2] for k in range(features)])
        blurs: dict[str, Blur | None] = {part: sample.specimen.blur(part, mask) for part in parts}
        if chain.restoration == "none":
            blurs = dict.fromkeys(parts)
        return lambda: pipeline(sample.exposure.pixels, blurs, expected)

    def moving(chain: Chain) -> Callable[[], object]:
        pipeline = sweep.pipeline(chain, (PEG,))
        pair = [Blur(mask.alpha_rad, psi) for psi in (0.0, 1.0)]
        count = [0]

        def run() -> None:
            count[0] += 1
            pipeline(sample.exposure.pixels, {PEG: pair[count[0] % 2]}, {PEG: sample.expected[PEG]})

        return run

    formed = [replace(base, restoration=r, window_px=w) for r, w in product(restorations[1:], WINDOWS)]
    runs = [still(*chain) for chain in chains]
    runs += [moving(chain) for chain in formed] + [still(chain, 2) for chain in formed]
    both = replace(base, restoration="half", window_px=192)
    runs += [still(both, 1), still(both, 1, (HOLE,)), still(both, 1, PARTS)]
    times = take_turns(runs, rounds, clock)
    timed = [ChainTime(c, k, Spread.of(s)) for (c, k), s in zip(chains, times, strict=False)]
    after = times[len(chains) :]
    n = len(formed)
    forms = [
        FormTime(c.restoration, c.window_px, Spread.of([max(a - b, 0.0) for a, b in zip(x, y, strict=True)]))
        for c, x, y in zip(formed, after[:n], after[n : 2 * n], strict=True)
    ]
    one, other, together = after[2 * n :]
    shared = float(np.median([a + b - c for a, b, c in zip(one, other, together, strict=True)]))
    return timed, forms, max(shared, 0.0)


def chain_errors(
    device: Device, seeds: Sequence[int], tell: Tell = lambda _a, _b: None
) -> tuple[list[ChainError], list[float]]:
    """Measure every chain's error over masks, defocus and noise.

    Returns the errors and the noises, grey levels.
    """
    specimens = {
        (seed, noise): Specimen(device, seed, noise=noise or 1.0) for seed in seeds for noise in NOISES
    }
    optics, shape = specimens[seeds[0], 0.0].optics, specimens[seeds[0], 0.0].shape
    for specimen in specimens.values():
        for part in PARTS:
            specimen.templates(part, 20)
    pipelines = {
        (r, f, TEMPLATE_PX): WindowedPipeline(
            device,
            optics,
            shape,
            dict.fromkeys(PARTS, Chain(r, 192, f, TEMPLATE_PX, 32).window(shape)),
            nsr=NSR,
        )
        for r, f in product(("none", "half", "float32"), REFINES)
    }
    errors: list[ChainError] = []
    count = 0

    def measure(
        kinds: Sequence[str], alpha: float, share: float, cases: Sequence[tuple[str, float, Mask]]
    ) -> None:
        nonlocal count
        off: dict[tuple[tuple[str, str, int], float], list[float]] = {}
        for seed, (part, depth, mask) in product(seeds, cases):
            count += 1
            for noise in NOISES:
                specimen = specimens[seed, noise]
                rng = np.random.default_rng([1, count])  # every noise at the same place
                place_at_random(specimen, depth, rng)
                exposure = specimen.expose(mask, noise=noise > 0)
                expected = {part: expected_places(exposure, rng)[part]}
                for key, pipeline in pipelines.items():
                    if key[0] not in kinds:
                        continue
                    teach_part(pipeline, specimen, part, key[2])
                    blur = None if key[0] == "none" else specimen.blur(part, mask)
                    found = _found(pipeline(exposure.pixels, {part: blur}, expected)[part])
                    off.setdefault((key, noise), []).append(off_px(found, exposure.corners_px[part]))
        for key in pipelines:
            if key[0] in kinds:
                # Whole pixels may be off by half of one along both axes, whatever a few frames say.
                least = math.sqrt(0.5) if key[1] == "integer" else 0.0
                worst = [max(least, *off[key, noise]) for noise in NOISES]
                errors.append(ChainError(*key, alpha, share, worst))
                if key[0] == "float32":
                    errors.append(ChainError("float64", *key[1:], alpha, share, worst))

    for psi in DEFOCUS_RAD:
        tell("errors", f"no mask, defocus {psi:g} rad")
        cases = [(PEG, 600.0, Mask(0.0, sign * psi)) for sign in (-1, 1)]
        cases.append((HOLE, 600.0, Mask(0.0, psi - optics.psi_rad(600.0))))
        measure(("none",), 0.0, psi, cases)
    per_um = optics.psi_rad(1.0)
    for alpha, share in product(ALPHAS_RAD, SHARES):
        tell("errors", f"alpha {alpha:g}, psi {3 * alpha * share:.1f} rad")
        measure(("half", "float32"), alpha, share, _cases(optics, alpha, share, per_um))
    nominal = nominal_noise_grey(specimens[seeds[0], 1.0])
    return errors, [noise * nominal for noise in NOISES]


def teach_part(pipeline: WindowedPipeline, specimen: Specimen, part: str, side_px: int) -> None:
    """Give a pipeline one part's templates."""
    pipeline.set_templates(part, specimen.templates(part, side_px), LIMITS)


def _cases(optics: OpticalSystem, alpha: float, share: float, per_um: float) -> list[tuple[str, float, Mask]]:
    """Return parts, depths and masks that show a part with this alpha and |psi| = 3 alpha share."""
    psi = 3 * alpha * share
    if share == 0:  # in focus, the other as far out as the planner lets it be
        depth = min(3 * 0.45 * alpha / per_um, FARTHEST_UM)
        return [(PEG, depth, Mask(alpha, 0.0)), (HOLE, depth, Mask(alpha, -optics.psi_rad(depth)))]
    depth = min(optics.depth_um(2 * psi), FARTHEST_UM)
    mask = Mask(alpha, psi - optics.psi_rad(depth))
    # Beyond the middle of the deepest range only the farther part is ever so far out of focus.
    return [(HOLE, depth, mask), *([(PEG, depth, mask)] if depth < FARTHEST_UM else [])]


# ---- all of it -------------------------------------------------------------------------------------------


def measure(
    device: Device,
    scene: Scene | None = None,
    *,
    quick: bool = False,
    stages: Sequence[str] = STAGES,
    clock: Clock = time.perf_counter,
    tell: Tell = lambda _stage, _sentence: None,
) -> DeviceProfile:
    """Turn every knob on a device and return its profile.

    Parameters
    ----------
    scene
        Under which knobs are turned; the parts of plans are measured over all masks and depths.
    quick
        Two specimens and few rounds: whether it works, not how well.
    stages
        Whose knobs are turned.
    """
    began = datetime.now(UTC)
    load = os.getloadavg() if hasattr(os, "getloadavg") else None
    scene = scene or default_scene()
    seeds = range(2) if quick else range(12)
    rounds = Rounds(5, 5, 0.0) if quick else Rounds(15, 61, 8.0)
    tell("specimens", f"{len(seeds)} twins, {scene.noise_grey:.2g} grey levels of noise")
    sweep = Sweep(device, scene, seeds)
    readings = []
    for stage in stages:
        readings += turn_knobs(sweep, stage, rounds, clock, tell)
    tell("chains", "timing in turns")
    times, forms, shared = chain_times(sweep, rounds if quick else Rounds(15, 41, 20.0), clock)
    errors, noises = chain_errors(device, seeds, tell)
    encoder = SlmEncode(device, sweep.specimens[0].design.panel, sweep.optics)
    mask_s = Spread.of(take_turns([lambda: encoder.codes(sweep.mask)], Rounds(5, 11, 1.0), clock)[0])
    return DeviceProfile(
        schema_version=SCHEMA,
        version=__version__,
        when=began.isoformat(timespec="seconds"),
        device=device.facts.as_dict(),
        machine={
            "cores": os.cpu_count(),
            "system": platform.platform(),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "load_at_start": None if load is None else [round(value, 2) for value in load],
        },
        settings={
            "quick": quick,
            "rounds": [rounds.fewest, rounds.most, rounds.budget_s],
            "seeds": len(seeds),
            "depth_um": sweep.depth_um,
            "noise_grey": scene.noise_grey,
        },
        noises_grey=noises,
        nsr=NSR,
        blur_px=sweep.optics.wavelength_um * sweep.optics.f_number / sweep.optics.object_pitch_um,
        shape=sweep.shape,
        readings=readings,
        times=times,
        forms=forms,
        errors=errors,
        shared_s=shared,
        mask_s=mask_s.median,
    )


# ---- what the readings say -------------------------------------------------------------------------------


def pareto(readings: Sequence[Reading]) -> list[Reading]:
    """Return the readings that no other beats in both time and error, quickest first.

    Errors within a tenth of each other count as one: a dozen specimens do not tell them apart. Times of whole
    chains and of a knob's own part are not compared with each other.
    """
    fronts: list[Reading] = []
    for whole in (False, True):
        least = math.inf
        mine = [r for r in readings if r.whole_chain == whole]
        for reading in sorted(mine, key=lambda r: (r.time_s.median, r.worst_um)):
            if reading.worst_um < least / _ALIKE:
                least = reading.worst_um
                fronts.append(reading)
    return fronts


@dataclass(frozen=True)
class Verdict:
    """Whether a knob is worth turning, and why, in a sentence."""

    stage: str
    knob: str
    worth: bool
    sentence: str


_LEAST_SAVING = 0.1  # of the chain's time
_UNFELT = 0.03
_ALIKE = 1.1  # errors within this factor are alike: what a dozen frames can tell


def verdicts(readings: Sequence[Reading]) -> list[Verdict]:
    """Say of each knob whether it buys time, derived from its readings.

    A knob is worth turning when a setting saves at least a tenth of the chain's time over the most accurate
    one, and costs accuracy. Where one setting is as accurate as any and as quick, the knob stays there.
    """
    chains = [r.time_s.median for r in readings if r.whole_chain and math.isfinite(r.error_um)]
    chain_s = float(np.median(chains)) if chains else math.inf
    found = []
    for stage, knob in dict.fromkeys((r.stage, r.knob) for r in readings):
        mine = [r for r in readings if (r.stage, r.knob) == (stage, knob)]
        found.append(_verdict(stage, knob, mine, chain_s))
    return found


def _verdict(stage: str, knob: str, mine: Sequence[Reading], chain_s: float) -> Verdict:
    usable = [r for r in mine if math.isfinite(r.worst_um)]
    if not usable:
        return Verdict(stage, knob, False, "no setting follows the features in this scene")
    least = min(r.worst_um for r in usable)
    alike = [r for r in usable if r.worst_um <= _ALIKE * least]
    quickest = min(alike, key=lambda r: r.time_s.median)
    whole = quickest.time_s.median if quickest.whole_chain else chain_s
    # Of settings that the chain's time cannot tell apart, the most accurate.
    near = [r for r in alike if r.time_s.median - quickest.time_s.median < _UNFELT * whole]
    best = min(near, key=lambda r: (r.worst_um, r.image_l2 or 0.0))
    cheapest = min(usable, key=lambda r: r.time_s.median)
    saving = (best.time_s.median - cheapest.time_s.median) / whole

    def at(reading: Reading) -> str:
        return f"{reading.setting} ({1e3 * reading.time_s.median:.3g} ms, {reading.worst_um:.2g} um)"

    if saving >= _LEAST_SAVING and best.time_s.apart_from(cheapest.time_s):
        return Verdict(
            stage, knob, True,
            f"worth turning: from {at(best)} to {at(cheapest)} it saves {100 * saving:.0f} % of the chain",
        )  # fmt: skip
    dearest = max(alike, key=lambda r: r.time_s.median)
    quicker = (dearest.time_s.median - best.time_s.median) / (
        dearest.time_s.median if dearest.whole_chain else chain_s
    )
    beside = ""
    if quicker >= _LEAST_SAVING:
        beside = f", as accurate as {at(dearest)} and {100 * quicker:.0f} % of the chain quicker"
    return Verdict(
        stage, knob, False,
        f"leave it at {at(best)}{beside}: no setting that is less accurate saves a tenth of the chain",
    )  # fmt: skip
