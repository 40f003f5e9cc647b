"""What `adof bench` times: each operation and the frame chain, their inputs and their float64 answers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_cl import __version__, reference
from adof_cl.device import Device
from adof_cl.errors import InputError
from adof_cl.image_prep import ImagePrep
from adof_cl.optics import Mask, OpticalSystem, PupilGrid, SlmPanel
from adof_cl.otf import Otf1d
from adof_cl.otf_table import OtfTable
from adof_cl.padding import padded_shape
from adof_cl.peers import THREADS, Filter, Peer, good_lengths
from adof_cl.psf import Psf
from adof_cl.pupil_phase import PupilPhase
from adof_cl.restore import Restore
from adof_cl.slm_encode import SlmEncode, stroke_table
from adof_cl.ssd_search import SearchResult, SsdSearch
from adof_cl.turns import Builder, Case, Contender, Rounds, Shape, take_turns
from adof_cl.wiener import WienerFilter

Array = NDArray[Any]

NSR = 0.01
ALPHA_RAD, PSI_RAD = 20.0, 10.0
_TEMPLATE, _WINDOW = (20, 20), (64, 64)
_PAIRS = 512


# ---- inputs and answers ---------------------------------------------------------------------------------


@cache
def _axis(n: int) -> NDArray[np.complex64]:
    """A coded camera's transfer along an axis, as float32 holds it, for every precision alike."""
    optics = OpticalSystem()
    return reference.otf_1d(optics.frequency_axis(n), ALPHA_RAD, PSI_RAD).astype(np.complex64)


@lru_cache(maxsize=4)
def _gain(padded: Shape) -> NDArray[np.complex128]:
    return reference.wiener_of_axes(_axis(padded[0]), _axis(padded[1]), NSR)


@lru_cache(maxsize=4)
def _frame(size: Shape) -> NDArray[np.uint8]:
    """A scene of bright blocks, blurred by the mask (circularly), with noise, as a camera gives it."""
    rng = np.random.default_rng(5)
    scene = np.full(size, 40.0)
    for y, x, level in zip(
        rng.integers(0, size[0], 400), rng.integers(0, size[1], 400), rng.uniform(20, 230, 400), strict=True
    ):
        scene[y : y + 9, x : x + 13] = level
    rows, columns = (np.array(_axis(n), dtype=np.complex128) for n in size)
    for axis in (rows, columns):
        if axis.size % 2 == 0:
            axis[axis.size // 2] = axis[axis.size // 2].real
    half = np.outer(rows, columns[: size[1] // 2 + 1])
    blurred = np.fft.irfft2(np.fft.rfft2(scene) * half, s=size) + rng.normal(0, 1, size)
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8)


@lru_cache(maxsize=4)
def _restored(size: Shape, padded: Shape) -> NDArray[np.float64]:
    return reference.restore(_frame(size), _gain(padded), padded)


@lru_cache(maxsize=4)
def _restored_zero_padded(size: Shape, padded: Shape) -> NDArray[np.float64]:
    """What the peers compute: the easier task of a frame with zeros around it."""
    spectrum = np.fft.rfft2(_frame(size).astype(np.float64), s=padded) * _gain(padded)
    return np.asarray(np.fft.irfft2(spectrum, s=padded)[: size[0], : size[1]])


def _bytes(image: Array) -> NDArray[np.uint8]:
    return np.clip(np.floor(image + 0.5), 0, 255).astype(np.uint8)


def _eps(precision: str) -> float:
    return float(np.finfo(precision).eps)


def _transforms(precision: str, size: int) -> float:
    """Bound of a transform there and back: rounding errors add like a random walk over its stages."""
    return _eps(precision) * (2 + 0.5 * math.log2(size))


def _relative(found: Array, wanted: Array) -> float:
    error = float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))
    return error if math.isfinite(error) else math.inf


def _levels(found: Array, wanted: NDArray[np.uint8]) -> float:
    """Largest difference in grey levels; infinite when more differ than rounding ties explain."""
    apart = np.abs(found.astype(int) - wanted.astype(int))
    return float(apart.max()) if np.mean(apart > 0) < 5e-3 else math.inf


def _levels_of_halves(found: Array, wanted: NDArray[np.float64]) -> float:
    """Largest difference in grey levels; infinite when the whole is off by more than halves promise."""
    apart = found - np.clip(wanted, 0, 255)
    beyond_rounding = max(float(np.mean(apart**2)) - 1 / 12, 0.0)
    fits = math.sqrt(beyond_rounding) <= 3e-3 * math.sqrt(float(np.mean(wanted**2)))
    return float(np.abs(apart).max()) if fits else math.inf


def _family(device: Device) -> str:
    return "lanes" if device.facts.kind == "cpu" else "groups"


# ---- restore --------------------------------------------------------------------------------------------


def _spectrum_bytes(size: Shape, padded: Shape, real: int, io: int) -> int:
    """Frame in, image out, the spectrum of the held rows four times, the filter once."""
    half = 2 * real * (padded[1] // 2 + 1)
    return size[0] * size[1] * io + half * (4 * size[0] + padded[0])


def _restore_plan(device: Device, size: Shape, kind: str) -> Restore:
    dtype = np.dtype(kind.split()[0])
    precision = "float64" if kind == "float64" else "float32"
    halves = np.float16 if kind == "uint8 halves" else None
    plan = Restore(device, size, precision=precision, in_dtype=dtype, out_dtype=dtype, spectrum_dtype=halves)
    plan.set_filter_axes(_axis(plan.padded_shape[0]), _axis(plan.padded_shape[1]), NSR)
    return plan


def _restore_ours(device: Device, size: Shape, kind: str, name: str = "adof-cl") -> Contender:
    plan = _restore_plan(device, size, kind)
    frame = device.upload(_frame(size).astype(plan.in_dtype))
    out = device.empty(size, plan.out_dtype)
    precision = "float64" if kind == "float64" else "float32"

    def run() -> None:
        plan(frame, out)
        device.wait()

    def error() -> float:
        wanted = _restored(size, plan.padded_shape)
        if kind == "uint8":
            return _levels(out.download(), _bytes(wanted))
        if kind == "uint8 halves":
            return _levels_of_halves(out.download(), wanted)
        return _relative(out.download(), wanted)

    padded = plan.padded_shape
    levels = {"uint8": 1.0, "uint8 halves": 3.0}
    return Contender(
        name,
        run,
        error,
        levels.get(kind, _transforms(precision, padded[0] * padded[1])),
        traffic=_spectrum_bytes(size, padded, plan.spectrum_dtype.itemsize, 2 * plan.in_dtype.itemsize),
        version=__version__,
        options={
            "in_dtype": plan.in_dtype.name,
            "out_dtype": plan.out_dtype.name,
            "precision": precision,
            "family": _family(device),
            "padded": [padded[1], padded[0]],
        },
    )


class _Filters:
    """The peers' filters, each at the padded size it is quickest at; kept, for planning takes long."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, Shape], tuple[Filter, Shape]] = {}

    def best(self, peer: Peer, size: Shape, device: Device) -> tuple[Filter, Shape]:
        key = (peer.name, size)
        if key not in self._kept:
            found: list[tuple[float, Filter, Shape]] = []
            for ny in good_lengths(size[0]):
                for nx in good_lengths(size[1]):
                    made = peer.make(size, (ny, nx), _gain((ny, nx)), device.queue)
                    made.load(_frame(size))
                    times = take_turns([made.run], Rounds(3, 3))[0]
                    found.append((min(times), made, (ny, nx)))
            _, made, padded = min(found, key=lambda entry: entry[0])
            self._kept = {old: value for old, value in self._kept.items() if old[1] == size}
            self._kept[key] = made, padded
        return self._kept[key]


_FILTERS = _Filters()


def _restore_peer(peer: Peer, size: Shape, device: Device) -> Contender:
    made, padded = _FILTERS.best(peer, size, device)
    made.load(_frame(size))
    return Contender(
        peer.name,
        made.run,
        lambda: _relative(made.image, _restored_zero_padded(size, padded)),
        _transforms("float32", padded[0] * padded[1]),
        version=peer.version,
        options={"precision": "float32", "padded": [padded[1], padded[0]]},
    )


def _restore_cases(size: Shape) -> Iterator[Case]:
    def prepare() -> None:
        _frame(size)
        for n in padded_shape(size, 0):
            _axis(n)

    def peers_of(peers: Sequence[Peer]) -> dict[str, Builder]:
        return {peer.name: partial(_restore_peer, peer, size) for peer in peers}

    def own(_peers: Sequence[Peer]) -> dict[str, Builder]:
        return {"own float32": partial(_restore_ours, size=size, kind="float32", name="own float32")}

    for kind, rivals in (
        ("uint8", own),
        ("uint8 halves", own),
        ("float32", peers_of),
        ("float64", peers_of),
    ):
        yield Case(
            "restore",
            kind,
            size,
            size[0] * size[1],
            "grey levels" if kind.startswith("uint8") else "relative L2",
            prepare,
            partial(_restore_ours, size=size, kind=kind),
            rivals,
            "float64" if kind == "float64" else "float32",
        )


# ---- wiener ---------------------------------------------------------------------------------------------


def _wiener_cases(size: Shape) -> Iterator[Case]:
    def prepare() -> None:
        _frame(size)
        for n in (*size, *padded_shape(size, 0)):
            _axis(n)

    def axes(device: Device) -> Contender:
        plan = WienerFilter(device, size)
        out = device.empty(plan.filter_shape, np.complex64)

        def run() -> None:
            plan.from_otf_axes(_axis(size[0]), _axis(size[1]), NSR, out=out)
            device.wait()

        return Contender(
            "adof-cl",
            run,
            lambda: _relative(out.download(), _gain(size)),
            8 * _eps("float32"),  # some eight roundings of H, |H|^2 and the quotient
            traffic=out.nbytes,
            options={"precision": "float32"},
        )

    def switch(device: Device) -> Contender:
        plan = _restore_plan(device, size, "uint8")
        table = OtfTable(device, OpticalSystem(), plan.padded_shape, pixel=False)
        frame, out = device.upload(_frame(size)), device.empty(size, np.uint8)

        def run() -> None:
            table.update([(ALPHA_RAD, PSI_RAD)])
            plan.set_filter_table(table.out, NSR)
            plan(frame, out)
            device.wait()

        padded = plan.padded_shape
        return Contender(
            "adof-cl",
            run,
            lambda: _levels(out.download(), _bytes(_restored(size, padded))),
            1.0,
            traffic=_spectrum_bytes(size, padded, 4, 2),
            options={"precision": "float32", "family": _family(device), "padded": [padded[1], padded[0]]},
        )

    def frame_alone(_peers: Sequence[Peer]) -> dict[str, Builder]:
        return {"own frame": partial(_restore_ours, size=size, kind="uint8", name="own frame")}

    pixels = size[0] * size[1]
    yield Case("wiener", "from axes", size, pixels, "relative L2", prepare, axes)
    yield Case("wiener", "new mask + frame", size, pixels, "grey levels", prepare, switch, frame_alone)


# ---- otf and psf ----------------------------------------------------------------------------------------


def _scipy_two_dimensional(
    samples: Shape, phase: Array, padded: int, peer: Peer, _device: Device
) -> Contender:
    """A pupil's PSF and OTF by two 2-D transforms in float32, two workers."""
    turned = phase.astype(np.float32)
    result: list[Array] = []

    def run() -> None:
        import scipy.fft

        pupil = np.empty(samples, np.complex64)
        np.cos(turned, out=pupil.real)
        np.sin(turned, out=pupil.imag)
        amplitude = scipy.fft.ifft2(pupil, (padded, padded), workers=THREADS, overwrite_x=True)
        psf = amplitude.real**2 + amplitude.imag**2
        psf *= np.float32(1 / psf.sum())
        result[:] = [psf, scipy.fft.fft2(psf, workers=THREADS)]

    def error() -> float:
        wanted = reference.psf_of_pupil(phase, np.ones(samples), padded=padded)
        return max(_relative(found, value) for found, value in zip(result, wanted, strict=True))

    # The phase is rounded to float32 before its cosine is taken.
    bound = _transforms("float32", padded**2) + _eps("float32") * float(np.abs(phase).max())
    return Contender("scipy 2-D", run, error, bound, version=peer.version, options={"padded": [padded] * 2})


def _phase(samples: int) -> NDArray[np.float64]:
    x = PupilGrid(samples).x
    return reference.pupil_phase(x, x, 0.15 * samples, -0.1 * samples)


def _otf_cases(size: Shape) -> Iterator[Case]:
    optics = OpticalSystem()
    pairs = [(ALPHA_RAD + k / 7, PSI_RAD - k / 3) for k in range(_PAIRS)]

    def ours(device: Device) -> Contender:
        plans = [Otf1d.for_camera(device, optics, n, pairs=_PAIRS) for n in sorted(set(size))]

        def run() -> None:
            for plan in plans:
                plan(pairs)
            device.wait()

        def error() -> float:
            worst = 0.0
            for plan in plans:
                n = plan.u.size
                for found, (alpha, psi) in zip(plan.out.download(), pairs, strict=True):
                    wanted = reference.otf_1d(plan.u, alpha, psi) * optics.pixel_otf_axis(n)
                    if n % 2 == 0:
                        wanted[n // 2] = wanted[n // 2].real
                    apart = np.abs(found - wanted)
                    worst = max(worst, float(np.nan_to_num(apart, nan=math.inf).max()))
            return worst

        return Contender(
            "adof-cl",
            run,
            error,
            3e-6,  # terms of at most 3.5 in all, each with some ten roundings
            units=_PAIRS,
            traffic=_PAIRS * sum(8 * n for n in set(size)),
            options={"precision": "float32", "pairs": _PAIRS},
        )

    def rivals(peers: Sequence[Peer]) -> dict[str, Builder]:
        n = size[0]
        if size[0] != size[1] or n % 2:
            return {}
        return {
            f"{peer.name} 2-D": partial(_scipy_two_dimensional, (n // 2, n // 2), _phase(n // 2), n, peer)
            for peer in peers
            if peer.name == "scipy"
        }

    yield Case("otf", "pairs", size, size[0] * size[1], "|dH|", lambda: None, ours, rivals)


def _psf_cases(size: Shape) -> Iterator[Case]:
    samples = size[0]

    def ours(device: Device) -> Contender:
        plan = Psf(device, samples)
        turns = device.upload((_phase(samples) / (2 * math.pi) % 1).astype(np.float32))

        def run() -> None:
            plan(turns, alpha_rad=0.15 * samples, psi_rad=-0.1 * samples)
            device.wait()

        def error() -> float:
            wanted = reference.psf_of_pupil(_phase(samples), np.ones(size), padded=plan.size)
            found = plan.psf.download(), plan.otf.download()
            return max(_relative(f, w) for f, w in zip(found, wanted, strict=True))

        cells = plan.size**2
        return Contender(
            "adof-cl",
            run,
            error,
            _transforms("float32", cells),
            traffic=4 * samples**2 + cells * (4 + 8),
            options={"precision": "float32", "padded": [plan.size] * 2},
        )

    def rivals(peers: Sequence[Peer]) -> dict[str, Builder]:
        return {
            f"{peer.name} 2-D": partial(_scipy_two_dimensional, size, _phase(samples), 2 * samples, peer)
            for peer in peers
            if peer.name == "scipy"
        }

    yield Case("psf", "square stop", size, 4 * samples**2, "relative L2", lambda: None, ours, rivals)


# ---- the modulator --------------------------------------------------------------------------------------


def _pupil_phase_cases(size: Shape) -> Iterator[Case]:
    def ours(device: Device) -> Contender:
        plan = PupilPhase(device, *size)

        def run() -> None:
            plan(Mask(53.5, -20.0), tilt_xy_rad=(3.0, -7.0))
            device.wait()

        def error() -> float:
            x, y = PupilGrid(size[1]).x, PupilGrid(size[0]).x
            wanted = reference.pupil_phase(x, y, 53.5, -20.0, tilt_xy_rad=(3.0, -7.0)) / (2 * math.pi)
            apart = plan.out.download() - wanted
            return float(np.nan_to_num(np.abs(apart - np.rint(apart)), nan=math.inf).max())

        # Each axis rounds by half an eps of a turn, and so do their sum and its wrapping.
        bound = 2 * _eps("float32")
        traffic = 4 * size[0] * size[1]
        return Contender("adof-cl", run, error, bound, traffic=traffic, options={"precision": "float32"})

    yield Case("pupil_phase", "mask", size, size[0] * size[1], "turns", lambda: None, ours)


def _slm_encode_cases(size: Shape) -> Iterator[Case]:
    panel = SlmPanel("bench", size[0], size[1], pitch_um=8.0, fill_factor=1.0, frame_rate_hz=60.0)
    optics = OpticalSystem(aperture_um=8.0 * (min(size) - 3.5))
    across = panel.stop_px(optics.aperture_um)
    mask = Mask(min(53.5, 0.2 * across), -min(20.0, 0.1 * across))

    def ours(device: Device) -> Contender:
        plan = SlmEncode(device, panel, optics)

        def run() -> None:
            plan(mask)
            device.wait()

        def error() -> float:
            table = stroke_table(panel.stroke_rad)
            wanted = reference.slm_encode(size, across, table, mask.alpha_rad, mask.focus_psi_rad)
            return float(np.mean(plan.out.download() != wanted))

        # Of 256 levels to a turn, those may round otherwise that lie within four eps of a turn of the edge.
        bound = 256 * 8 * _eps("float32")
        traffic = size[0] * size[1]
        return Contender("adof-cl", run, error, bound, traffic=traffic, options={"precision": "float32"})

    yield Case("slm_encode", "mask", size, size[0] * size[1], "share of pixels", lambda: None, ours)


# ---- image_prep, ssd_search and the chain ---------------------------------------------------------------


def _image_prep_cases(size: Shape) -> Iterator[Case]:
    rng = np.random.default_rng(6)

    @cache
    def maps() -> tuple[Array, Array]:
        return rng.uniform(2, 6, size).astype(np.float32), rng.uniform(0.8, 1.2, size).astype(np.float32)

    def ours(device: Device) -> Contender:
        dark, gain = maps()
        plan = ImagePrep(device, size, dark=dark, gain=gain)
        frame, out = device.upload(_frame(size)), device.empty(size, np.float32)

        def run() -> None:
            plan(frame, out)
            device.wait()

        def error() -> float:
            return _relative(out.download(), reference.image_prep(_frame(size), dark, gain))

        bound = _eps("float32")  # a difference and a product, half an eps each
        traffic = size[0] * size[1] * 13
        options = {"in_dtype": "uint8", "out_dtype": "float32", "maps": True}
        return Contender("adof-cl", run, error, bound, traffic=traffic, options=options)

    def prepare() -> None:
        _frame(size)
        maps()

    yield Case("image_prep", "maps", size, size[0] * size[1], "relative L2", prepare, ours)


def _templates(image: NDArray[np.uint8], count: int) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Cut `count` noisy templates from all over an image; return them and their windows' origins."""
    rng = np.random.default_rng(7)
    last = np.subtract(image.shape, _WINDOW)
    origins = np.stack([rng.integers(0, last[0] + 1, count), rng.integers(0, last[1] + 1, count)], axis=1)
    inside = rng.integers(0, _WINDOW[0] - _TEMPLATE[0] + 1, (count, 2))
    cut = [image[y : y + _TEMPLATE[0], x : x + _TEMPLATE[1]] for y, x in origins + inside]
    noisy = np.stack(cut) + rng.normal(0, 4, (count, *_TEMPLATE))
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), origins


def _wanted_places(
    image: NDArray[np.uint8], templates: NDArray[np.uint8], origins: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    places, scores = [], []
    for template, (y, x) in zip(templates, origins.tolist(), strict=True):
        best, found = reference.ssd_search(image, template, (y, x), _WINDOW)
        places.append(best)
        scores.append(float(found.min()))
    return np.array(places, dtype=np.int64), np.array(scores)


class _OpencvSearch:
    """TM_SQDIFF and minMaxLoc, template by template, into arrays made beforehand."""

    def __init__(self, templates: NDArray[np.uint8], origins: NDArray[np.int64]) -> None:
        self._templates, self._origins = templates, origins.tolist()
        self._scores = np.empty((_WINDOW[0] - _TEMPLATE[0] + 1, _WINDOW[1] - _TEMPLATE[1] + 1), np.float32)
        self.places = np.zeros((len(templates), 2), np.int64)
        self.found = np.zeros(len(templates))

    def __call__(self, image: NDArray[np.uint8]) -> None:
        import cv2

        for k, (y, x) in enumerate(self._origins):
            window = image[y : y + _WINDOW[0], x : x + _WINDOW[1]]
            cv2.matchTemplate(window, self._templates[k], cv2.TM_SQDIFF, self._scores)
            least, _, (column, row), _ = cv2.minMaxLoc(self._scores)
            self.places[k] = y + row, x + column
            self.found[k] = least


def _search_error(
    places: Array, scores: Array, wanted: tuple[NDArray[np.int64], NDArray[np.float64]]
) -> float:
    """Largest relative error of the best scores; infinite when a place is wrong."""
    if not np.array_equal(places, wanted[0]):
        return math.inf
    return float(np.max(np.abs(scores - wanted[1]) / wanted[1]))


def _ssd_search_cases(size: Shape) -> Iterator[Case]:
    for count in (4, 16):

        def ours(device: Device, count: int = count) -> Contender:
            templates, origins = _templates(_frame(size), count)
            plan = SsdSearch(device, size, _TEMPLATE, _WINDOW, count)
            plan.set_templates(templates)
            plan.set_windows(origins)
            image = device.upload(_frame(size))
            result: list[SearchResult] = []

            def run() -> None:
                plan(image)
                result[:] = [plan.fetch()]

            def error() -> float:
                wanted = _wanted_places(_frame(size), templates, origins)
                return _search_error(result[0].best_yx, result[0].score, wanted)

            offsets = plan.offsets_shape[0] * plan.offsets_shape[1]
            traffic = count * (_WINDOW[0] * _WINDOW[1] + 4 * _TEMPLATE[0] * _TEMPLATE[1] + 8 * offsets)
            options = {"templates": count, "dtype": "uint8", "score": "ssd", "family": plan.family}
            return Contender("adof-cl", run, error, 0.0, traffic=traffic, options=options)

        def rivals(peers: Sequence[Peer], count: int = count) -> dict[str, Builder]:
            def opencv(peer: Peer, _device: Device) -> Contender:
                templates, origins = _templates(_frame(size), count)
                search = _OpencvSearch(templates, origins)
                wanted = _wanted_places(_frame(size), templates, origins)
                # It subtracts sums of squares in float32: an eps of those for each stage of their transform.
                lost = _eps("float32") * 13 * 2 * 255**2 * templates[0].size / wanted[1].min()
                return Contender(
                    "opencv",
                    lambda: search(_frame(size)),
                    lambda: _search_error(search.places, search.found, wanted),
                    float(lost),
                    version=peer.version,
                )

            return {peer.name: partial(opencv, peer) for peer in peers if peer.name == "opencv"}

        yield Case(
            "ssd_search",
            f"{count} templates",
            size,
            count * _WINDOW[0] * _WINDOW[1],
            "relative score",
            lambda: _frame(size),
            ours,
            rivals,
        )


_CHAIN_BOUND = 0.02
"""Of a best score: a grey level may round otherwise here and there, of a noise of four levels."""


def _chain_cases(size: Shape) -> Iterator[Case]:
    padded = padded_shape(size, 0)

    def templates() -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        return _templates(_bytes(_restored(size, padded)), 4)

    def ours(device: Device) -> Contender:
        plan = _restore_plan(device, size, "uint8")
        frame, image = device.empty(size, np.uint8), device.empty(size, np.uint8)
        cut, origins = templates()
        search = SsdSearch(device, size, _TEMPLATE, _WINDOW, 4)
        search.set_templates(cut)
        search.set_windows(origins)
        result: list[SearchResult] = []

        def run() -> None:
            search(plan(frame.upload(_frame(size)), image))
            result[:] = [search.fetch()]

        def error() -> float:
            wanted = _wanted_places(_bytes(_restored(size, padded)), cut, origins)
            return _search_error(result[0].best_yx, result[0].score, wanted)

        return Contender(
            "adof-cl",
            run,
            error,
            _CHAIN_BOUND,
            traffic=_spectrum_bytes(size, padded, 4, 2),
            options={"dtype": "uint8", "precision": "float32", "family": _family(device), "templates": 4},
        )

    def rivals(peers: Sequence[Peer]) -> dict[str, Builder]:
        opencv = any(peer.name == "opencv" for peer in peers)

        def chain(peer: Peer, device: Device) -> Contender:
            import cv2

            made, chosen = _FILTERS.best(peer, size, device)
            cut, origins = templates()
            search = _OpencvSearch(cut, origins)
            image = np.empty(size, np.uint8)
            nothing = np.zeros(1, np.float32)

            def run() -> None:
                made.load(_frame(size))
                made.run()
                cv2.add(made.image, nothing, image, None, cv2.CV_8U)  # rounds and clamps
                search(image)

            def error() -> float:
                wanted = _wanted_places(_bytes(_restored_zero_padded(size, chosen)), cut, origins)
                return _search_error(search.places, search.found, wanted)

            options = {"padded": [chosen[1], chosen[0]], "search": "opencv"}
            return Contender(peer.name, run, error, _CHAIN_BOUND, version=peer.version, options=options)

        return {peer.name: partial(chain, peer) for peer in peers} if opencv else {}

    def prepare() -> None:
        _frame(size)
        templates()
        for n in padded:
            _axis(n)

    yield Case("chain", "4 searches", size, size[0] * size[1], "relative score", prepare, ours, rivals)


# ---- all of them ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Operation:
    """What can be timed.

    Attributes
    ----------
    sizes, quick
        (rows, columns) by default and in quick runs.
    fits
        What a size must be, in words, and whether one is.
    """

    cases: Callable[[Shape], Iterator[Case]]
    sizes: tuple[Shape, ...]
    quick: Shape
    wanted: str
    fits: Callable[[Shape], bool]


def _within(least: int, most: int) -> Callable[[Shape], bool]:
    return lambda size: all(least <= side <= most for side in size)


_ROI, _CAMERA = (400, 512), (494, 659)
_SMALL = (96, 128)
_FRAME = "sides of 64 to 4096"
OPERATIONS: dict[str, Operation] = {
    "restore": Operation(
        _restore_cases,
        (_ROI, (512, 512), _CAMERA, (1024, 1024), (2048, 2048)),
        _SMALL,
        "sides of 8 to 4096",
        _within(8, 4096),
    ),
    "wiener": Operation(_wiener_cases, (_ROI, (1024, 1024)), _SMALL, "sides of 8 to 4096", _within(8, 4096)),
    "otf": Operation(_otf_cases, ((512, 512),), (64, 64), "sides of 8 to 4096", _within(8, 4096)),
    "ssd_search": Operation(_ssd_search_cases, (_ROI,), _SMALL, _FRAME, _within(64, 4096)),
    "image_prep": Operation(_image_prep_cases, (_CAMERA, (2048, 2048)), _SMALL, _FRAME, _within(64, 4096)),
    "pupil_phase": Operation(
        _pupil_phase_cases, ((1024, 1024),), _SMALL, "sides of 64 to 4096", _within(64, 4096)
    ),
    "slm_encode": Operation(
        _slm_encode_cases, ((1080, 1920),), _SMALL, "sides of 64 to 4096", _within(64, 4096)
    ),
    "psf": Operation(
        _psf_cases,
        ((256, 256),),
        (64, 64),
        "a square of a power of two, 64 to 2048",
        lambda size: size[0] == size[1] and size[0] & (size[0] - 1) == 0 and 64 <= size[0] <= 2048,
    ),
    "chain": Operation(_chain_cases, (_ROI, _CAMERA), _SMALL, "sides of 64 to 4096", _within(64, 4096)),
}


def parse_sizes(text: str) -> list[Shape]:
    """Read "512x400,1024x1024", columns x rows, as (rows, columns).

    Raises
    ------
    InputError
        Something else.
    """
    sizes = []
    for part in text.split(","):
        sides = part.strip().lower().split("x")
        if len(sides) != 2 or not all(side.isascii() and side.isdecimal() and int(side) for side in sides):
            raise InputError(f"size is '{part.strip()}': columns x rows, such as 512x400, was wanted")
        sizes.append((int(sides[1]), int(sides[0])))
    return sizes


def select(
    ops: Sequence[str] | None = None, sizes: Sequence[Shape] | None = None, *, quick: bool = False
) -> list[Case]:
    """Return the cases of these operations (all by default) at these sizes (each one's own by default).

    A size an operation cannot take is left out, unless the operation was asked for by name.

    Raises
    ------
    InputError
        An unknown operation, or a size that cannot be.
    """
    for name in ops or ():
        if name not in OPERATIONS:
            raise InputError(f"operation is '{name}': choose some of {', '.join(OPERATIONS)}")
    cases: list[Case] = []
    for name in ops or OPERATIONS:
        operation = OPERATIONS[name]
        for size in sizes or ((operation.quick,) if quick else operation.sizes):
            if operation.fits(size):
                cases.extend(operation.cases(size))
            elif ops:
                raise InputError(f"{name} cannot take {size[1]}x{size[0]}: {operation.wanted} were wanted")
    if not cases:
        raise InputError("no operation takes any of these sizes: use sides of 64 to 4096")
    return cases
