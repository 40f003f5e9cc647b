"""One camera's frame, from raw region of interest to features, with every buffer made once.

Per frame: one upload, for each part a filter of its own depth and a restoration, one search launch a part,
one small download. Nothing else crosses to the host. A frame at a time, or as the work of a stream.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError, TrackingError
from adof_cl.noise import checked_nsr
from adof_cl.optics import Mask, OpticalSystem, require_finite, require_positive, require_whole
from adof_cl.otf_table import OtfTable
from adof_cl.phase_terms import require_envelope
from adof_cl.restore import Restore
from adof_cl.tracking import (
    Measurement,
    Template,
    TemplateTracker,
    TrackingLimits,
    checked_refine,
)

Pixels = NDArray[np.uint8]


# A filter is formed anew when alpha or psi moved by more: within |psi| < 3 |alpha| the image shifts by at
# most 2 x 0.154 px per radian of either (docs/maths.md, eq. O7), here 0.003 px.
SAME_RAD = 0.01


@dataclass(frozen=True)
class Blur:
    """What blurred one part in one frame: its filter is exact for exactly this."""

    alpha_rad: float
    psi_rad: float

    @classmethod
    def of(cls, mask: Mask, optics: OpticalSystem, depth_um: float) -> Blur:
        """Return the blur of a part at `depth_um` seen through `mask`."""
        require_finite(depth_um=depth_um)
        return cls(mask.alpha_rad, mask.psi_rad(optics, depth_um))

    def near(self, other: Blur | None, tolerance_rad: float = SAME_RAD) -> bool:
        """Whether the other's filter serves this blur as well, to a tolerance in alpha and in psi."""
        return (
            other is not None
            and abs(self.alpha_rad - other.alpha_rad) <= tolerance_rad
            and abs(self.psi_rad - other.psi_rad) <= tolerance_rad
        )


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame and what its own exposure decides about it.

    Attributes
    ----------
    frame : (rows, columns) uint8
    blurs
        For each part to measure, the blur its filter undoes; None leaves the frame as it is.
    expected_xy_px : (k, 2) each
        Where the features are expected.
    """

    frame: Pixels
    blurs: Mapping[str, Blur | None]
    expected_xy_px: Mapping[str, ArrayLike]


@dataclass(eq=False)
class _Buffer:
    """What one frame has to itself, from its arrival until its features are collected."""

    frame: DeviceArray
    images: dict[str, DeviceArray]
    trackers: dict[str, TemplateTracker] = field(default_factory=dict)
    blurs: dict[str, Blur | None] = field(default_factory=dict)
    expected: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    in_flight: bool = False

    def restored(self) -> dict[str, DeviceArray]:
        return {part: self.images[part] for part, blur in self.blurs.items() if blur is not None}


class CameraPipeline:
    """Restore and search the frames of one camera, each part with the filter of its own depth.

    Built once: compiles and allocates. Each frame only sets numbers and enqueues, then waits once.

    A call does one frame from upload to features. A stream does the same in steps, `stage`, `enqueue`,
    `collect`, with several frames under way, each in a buffer of its own.

    Parameters
    ----------
    device
        The opened device.
    optics
        The camera's optics.
    shape
        Region of interest, (rows, columns); frames are uint8.
    parts
        Names of what is followed.
    nsr
        Noise-to-signal power ratio of the Wiener filter.
    padding
        Samples added to each axis at least: the widest blur expected.
    search_shape
        Window in which each template is searched.
    refine
        "gauss_newton", "quadratic" or "integer", as in `TemplateTracker`.
    precision, spectrum_dtype
        Of the restoration, as in `Restore`.
    tolerance_rad
        A filter is formed anew when alpha or psi moved by more.
    buffers
        Frames that can be under way at once.
    """

    def __init__(
        self,
        device: Device,
        optics: OpticalSystem,
        shape: tuple[int, int],
        parts: Sequence[str],
        *,
        nsr: float = 0.01,
        padding: int = 64,
        search_shape: tuple[int, int] = (64, 64),
        refine: str = "gauss_newton",
        precision: str = "float32",
        spectrum_dtype: DTypeLike | None = None,
        tolerance_rad: float = SAME_RAD,
        buffers: int = 1,
    ) -> None:
        require_whole(buffers=buffers)
        require_positive(tolerance_rad=tolerance_rad)
        checked_nsr(float(nsr), (1, 1))
        self.device = device
        self.optics = optics
        self.shape = shape
        self.parts = tuple(parts)
        self.nsr = nsr
        self.buffers = buffers
        self.tolerance_rad = tolerance_rad
        self._search_shape = search_shape
        self._refine = checked_refine(refine)
        self._restore = Restore(
            device, shape, precision=precision, in_dtype=np.uint8, out_dtype=np.uint8, padding=padding,
            spectrum_dtype=spectrum_dtype,
        )  # fmt: skip
        # The pixel's own transfer stays in the image, as it is in the templates.
        self._otf = {
            part: OtfTable(device, optics, self._restore.padded_shape, pixel=False, precision=precision)
            for part in self.parts
        }
        self._buffers = [
            _Buffer(
                device.empty(shape, np.uint8), {part: device.empty(shape, np.uint8) for part in self.parts}
            )
            for _ in range(buffers)
        ]
        self._last: dict[str, DeviceArray] = {}
        self._blurs: dict[str, Blur] = {}

    def set_templates(
        self, part: str, templates: Sequence[Template], limits: TrackingLimits | None = None
    ) -> None:
        """Follow these features of `part` from now on.

        Raises
        ------
        InputError
            An unknown part, or frames under way, whose templates these would become.
        """
        self._require_part(part)
        if any(buffer.in_flight for buffer in self._buffers):
            raise InputError("frames are under way: collect them before the templates change")
        trackers = [buffer.trackers[part] for buffer in self._buffers if part in buffer.trackers]
        if trackers and [t.pixels.shape for t in trackers[0].templates] == [
            t.pixels.shape for t in templates
        ]:
            for index, template in enumerate(templates):
                for tracker in trackers:
                    tracker.replace(index, template)
            for tracker in trackers:
                tracker.limits = limits or tracker.limits
            return
        made = [
            TemplateTracker(
                self.device, self.shape, templates, self._search_shape, refine=self._refine, limits=limits
            )
            for _ in self._buffers
        ]
        for buffer, tracker in zip(self._buffers, made, strict=True):
            buffer.trackers[part] = tracker

    def templates(self, part: str) -> list[Template]:
        """Return the features of `part` that are followed now.

        Raises
        ------
        TrackingError
            None have been set.
        """
        return list(self._tracker(part).templates)

    def set_refine(self, refine: str) -> None:
        """Refine places so from the next frame on: "gauss_newton", "quadratic" or "integer".

        Raises
        ------
        InputError
            Another word; nothing changes.
        """
        self._refine = checked_refine(refine)
        for buffer in self._buffers:
            for tracker in buffer.trackers.values():
                tracker.refine = refine

    def __call__(
        self,
        frame: Pixels,
        blurs: Mapping[str, Blur | None],
        expected_xy_px: Mapping[str, ArrayLike],
    ) -> dict[str, list[Measurement]]:
        """Restore one frame and measure every part's features; arguments and errors are those of `stage`."""
        self.stage(0, Shot(frame, blurs, expected_xy_px))
        self.enqueue(0)
        return self.collect(0)

    # ---- a frame in steps, as `stream.Work` ---------------------------------------------------------------

    def stage(self, buffer: int, shot: Shot) -> None:
        """Take a copy of a shot, in place of what was staged there before; waits for no kernel.

        Raises
        ------
        InputError
            Another shape or type, an unknown part, one without an expected place or with a blur that is not
            finite, or a buffer whose frame is under way; nothing changes.
        LimitError
            A blur beyond what can be computed.
        TrackingError
            A part without templates.
        """
        place = self._free(buffer)
        expected = {}
        for part, blur in shot.blurs.items():
            tracker = self._tracker(part)
            if part not in shot.expected_xy_px:
                raise InputError(f"part '{part}' has no expected place: give one for every part of blurs")
            expected[part] = tracker.checked_places(shot.expected_xy_px[part])
            if blur is not None:
                require_envelope(blur.alpha_rad, blur.psi_rad)
        place.frame.stage(shot.frame)
        place.blurs, place.expected = dict(shot.blurs), expected

    def enqueue(self, buffer: int) -> None:
        """Enqueue everything the staged shot needs; does not wait."""
        place = self._free(buffer)
        self._enqueue(place)
        for part, blur in place.blurs.items():
            tracker = place.trackers[part]
            tracker.aim(place.expected[part])
            tracker.enqueue(place.frame if blur is None else place.images[part])
        place.in_flight = True

    def ready(self, buffer: int) -> bool:
        """Whether `collect` would not have to wait for the device."""
        place = self._buffers[buffer]
        return all(place.trackers[part].ready for part in place.blurs)

    def collect(self, buffer: int) -> dict[str, list[Measurement]]:
        """Wait for this buffer's frame and return its measurements; the buffer is free again.

        Raises
        ------
        InputError
            Nothing is under way there.
        """
        place = self._buffers[buffer]
        if not place.in_flight:
            raise InputError(f"nothing is under way in buffer {buffer}: enqueue a frame first")
        place.in_flight = False
        self._last = place.restored()
        return {part: place.trackers[part].collect() for part in place.blurs}

    # ---- images to look at --------------------------------------------------------------------------------

    def restored(self, frame: Pixels, blurs: Mapping[str, Blur]) -> dict[str, Pixels]:
        """Return the frame restored for each part, on the host: to look at, or to cut templates from."""
        for part in blurs:
            self._require_part(part)
        place = self._free(0)
        place.frame.stage(frame)
        place.blurs = dict(blurs)
        self._enqueue(place)
        self._last = place.restored()
        return self.last_images()

    def last_images(self) -> dict[str, Pixels]:
        """Return what the frame last collected was restored to, for each part it was restored for.

        In a stream: only until its buffer is enqueued again.
        """
        return {part: image.download() for part, image in self._last.items()}

    # ---- inside -------------------------------------------------------------------------------------------

    def _enqueue(self, place: _Buffer) -> None:
        place.frame.send()
        blurs = place.blurs
        if place.restored():
            self._restore.transform(place.frame)  # once for all parts
        for part, blur in blurs.items():
            if blur is None:
                continue
            slot = self.parts.index(part)
            if not blur.near(self._blurs.get(part), self.tolerance_rad):
                table = self._otf[part]
                table.update([(blur.alpha_rad, blur.psi_rad)])
                self._restore.set_filter_table(table.out, self.nsr, slot)
                self._blurs[part] = blur
            self._restore.apply(place.images[part], slot)

    def _free(self, buffer: int) -> _Buffer:
        place = self._buffers[buffer]
        if place.in_flight:
            raise InputError(f"the frame in buffer {buffer} is under way: collect it first")
        return place

    def _tracker(self, part: str) -> TemplateTracker:
        self._require_part(part)
        trackers = self._buffers[0].trackers
        if part not in trackers:
            raise TrackingError(f"part '{part}' has no templates: set_templates first")
        return trackers[part]

    def _require_part(self, part: str) -> None:
        if part not in self.parts:
            raise InputError(f"part '{part}' came: this pipeline follows {', '.join(self.parts)}")


@dataclass(frozen=True)
class Window:
    """How one part is followed in a window of its own.

    Attributes
    ----------
    shape
        (rows, columns), no larger than the frame.
    search_shape, refine, precision, spectrum_dtype, padding, tolerance_rad
        As in `CameraPipeline`.
    """

    shape: tuple[int, int]
    search_shape: tuple[int, int] = (64, 64)
    refine: str = "gauss_newton"
    precision: str = "float32"
    spectrum_dtype: str | None = None
    padding: int = 64
    tolerance_rad: float = SAME_RAD


class WindowedPipeline:
    """Restore and search only a window around each part: the frame's other pixels never reach the device.

    Built once; a call cuts each part's window about its expected features, enqueues all of them, then waits.

    Parameters
    ----------
    device, optics
        As in `CameraPipeline`.
    shape
        Region of interest, (rows, columns); frames are uint8.
    windows
        For each part, its window; or several, of which the first is used until `use` names another.
    nsr
        As in `CameraPipeline`.

    Raises
    ------
    InputError
        No part, or a window larger than the frame.
    """

    def __init__(
        self,
        device: Device,
        optics: OpticalSystem,
        shape: tuple[int, int],
        windows: Mapping[str, Window | Sequence[Window]],
        *,
        nsr: float = 0.01,
    ) -> None:
        if not windows:
            raise InputError("no part came: give at least one with its window")
        self.shape = shape
        self.parts = tuple(windows)
        self._made: dict[str, dict[tuple[object, ...], CameraPipeline]] = {}
        self._taught: dict[str, tuple[Sequence[Template], TrackingLimits | None]] = {}
        self._learnt: dict[CameraPipeline, tuple[Sequence[Template], TrackingLimits | None]] = {}
        self._pipelines: dict[str, CameraPipeline] = {}
        for part, given in windows.items():
            several = (given,) if isinstance(given, Window) else tuple(given)
            for window in several:
                if window.shape[0] > shape[0] or window.shape[1] > shape[1]:
                    raise InputError(
                        f"the window of '{part}' is {window.shape}, the frame {shape}: it must fit inside"
                    )
            self._made[part] = {
                _made_for(window): CameraPipeline(
                    device, optics, window.shape, (part,), nsr=nsr, padding=window.padding,
                    search_shape=window.search_shape, refine=window.refine, precision=window.precision,
                    spectrum_dtype=window.spectrum_dtype, tolerance_rad=window.tolerance_rad,
                )
                for window in several
            }  # fmt: skip
            self._pipelines[part] = self._made[part][_made_for(several[0])]
        self._origins: dict[str, tuple[int, int]] = {}

    def set_templates(
        self, part: str, templates: Sequence[Template], limits: TrackingLimits | None = None
    ) -> None:
        """Follow these features of `part` from now on; errors as `CameraPipeline.set_templates`."""
        self._of(part).set_templates(part, templates, limits)
        self._taught[part] = templates, limits
        self._learnt[self._of(part)] = self._taught[part]

    def use(self, part: str, window: Window) -> None:
        """Follow `part` in this window from the next frame on; makes no buffer and compiles nothing.

        `refine` and `tolerance_rad` may be any; the rest is one of the windows the pipeline was made with.

        Raises
        ------
        InputError
            An unknown part, or a window that was not made; nothing changes.
        """
        self._of(part)
        pipeline = self._made[part].get(_made_for(window))
        if pipeline is None:
            raise InputError(f"'{part}' has no window like {window}: state it when the pipeline is made")
        pipeline.set_refine(window.refine)
        pipeline.tolerance_rad = window.tolerance_rad
        if part in self._taught and self._learnt.get(pipeline) is not self._taught[part]:
            pipeline.set_templates(part, *self._taught[part])
            self._learnt[pipeline] = self._taught[part]
        self._pipelines[part] = pipeline

    def templates(self, part: str) -> list[Template]:
        """Return the features of `part` that are followed now."""
        return self._of(part).templates(part)

    def __call__(
        self,
        frame: Pixels,
        blurs: Mapping[str, Blur | None],
        expected_xy_px: Mapping[str, ArrayLike],
    ) -> dict[str, list[Measurement]]:
        """Measure every part's features in one frame; places are those of the whole frame.

        Raises
        ------
        InputError
            Another shape or type, an unknown part, one without an expected place; nothing is enqueued.
        """
        if frame.shape != self.shape:
            raise InputError(f"the frame is {frame.shape}: {self.shape} was wanted")
        for part, blur in blurs.items():
            pipeline = self._of(part)
            if part not in expected_xy_px:
                raise InputError(f"part '{part}' has no expected place: give one for every part of blurs")
            expected = np.array(expected_xy_px[part], dtype=np.float64)
            y, x = self._origin(expected, pipeline.shape)
            rows, columns = pipeline.shape
            cut = np.ascontiguousarray(frame[y : y + rows, x : x + columns])
            pipeline.stage(0, Shot(cut, {part: blur}, {part: expected - (x, y)}))
            self._origins[part] = (y, x)
        for part in blurs:
            self._pipelines[part].enqueue(0)
        measured = {}
        for part in blurs:
            y, x = self._origins[part]
            measured[part] = [
                replace(m, feature_xy_px=m.feature_xy_px + np.array([x, y]))
                for m in self._pipelines[part].collect(0)[part]
            ]
        return measured

    def last_windows(self) -> dict[str, tuple[tuple[int, int], Pixels]]:
        """Return each restored part's window: (row, column) of its first pixel in the frame, and pixels."""
        return {
            part: (self._origins[part], pipeline.last_images()[part])
            for part, pipeline in self._pipelines.items()
            if part in pipeline.last_images()
        }

    def _origin(self, expected: NDArray[np.float64], window: tuple[int, int]) -> tuple[int, int]:
        """Return the (row, column) at which a window about these places begins, inside the frame."""
        if expected.ndim != 2 or not np.isfinite(expected).all():
            raise InputError(f"expected places of shape {expected.shape} came: (k, 2) finite were wanted")
        middle = (expected.min(axis=0) + expected.max(axis=0)) / 2
        first = np.rint(middle[::-1] - (np.array(window) - 1) / 2)
        y, x = np.clip(first, 0, np.subtract(self.shape, window)).astype(int).tolist()
        return y, x

    def _of(self, part: str) -> CameraPipeline:
        if part not in self._pipelines:
            raise InputError(f"part '{part}' came: this pipeline follows {', '.join(self.parts)}")
        return self._pipelines[part]


def _made_for(window: Window) -> tuple[object, ...]:
    """What of a window is decided when its pipeline is made."""
    return window.shape, window.search_shape, window.precision, window.spectrum_dtype, window.padding
