"""One camera's frame, from raw region of interest to features, with every buffer made once.

Per frame: one upload, for each part a filter of its own depth and a restoration, one search launch a part,
one small download. Nothing else crosses to the host. A frame at a time, or as the work of a stream.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError, TrackingError
from adof_cl.optics import Mask, OpticalSystem, require_finite
from adof_cl.otf_table import OtfTable
from adof_cl.phase_terms import require_envelope
from adof_cl.restore import Restore
from adof_cl.tracking import Measurement, Template, TemplateTracker, TrackingLimits

Pixels = NDArray[np.uint8]


# A filter is formed anew when alpha or psi moved by more: within |psi| < 3 |alpha| the image shifts by at
# most 2 x 0.154 px per radian of either (docs/maths.md, eq. O7), here 0.003 px.
_SAME_RAD = 0.01


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

    def near(self, other: Blur | None) -> bool:
        """Whether the other's filter serves this blur as well."""
        return (
            other is not None
            and abs(self.alpha_rad - other.alpha_rad) <= _SAME_RAD
            and abs(self.psi_rad - other.psi_rad) <= _SAME_RAD
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
        buffers: int = 1,
    ) -> None:
        if buffers < 1:
            raise InputError(f"buffers is {buffers}: at least 1 was wanted")
        self.device = device
        self.optics = optics
        self.shape = shape
        self.parts = tuple(parts)
        self.nsr = nsr
        self.buffers = buffers
        self._search_shape = search_shape
        self._restore = Restore(device, shape, in_dtype=np.uint8, out_dtype=np.uint8, padding=padding)
        # The pixel's own transfer stays in the image, as it is in the templates.
        self._otf = {
            part: OtfTable(device, optics, self._restore.padded_shape, pixel=False) for part in self.parts
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
        if trackers and len(trackers[0].templates) == len(templates):
            for index, template in enumerate(templates):
                for tracker in trackers:
                    tracker.replace(index, template)
            for tracker in trackers:
                tracker.limits = limits or tracker.limits
            return
        made = [
            TemplateTracker(self.device, self.shape, templates, self._search_shape, limits=limits)
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
            if not blur.near(self._blurs.get(part)):
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
