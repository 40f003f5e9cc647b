"""One camera's frame, from raw region of interest to features, with every buffer made once.

Per frame: one upload, for each part a filter of its own depth and a restoration, one search launch a part,
one small download. Nothing else crosses to the host.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adof_cl.device import Device
from adof_cl.errors import InputError, TrackingError
from adof_cl.optics import Mask, OpticalSystem, require_finite
from adof_cl.otf import Otf1d
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


class CameraPipeline:
    """Restore and search the frames of one camera, each part with the filter of its own depth.

    Built once: compiles and allocates. Each frame only sets numbers and enqueues, then waits once.

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
    ) -> None:
        self.device = device
        self.optics = optics
        self.shape = shape
        self.parts = tuple(parts)
        self.nsr = nsr
        self._search_shape = search_shape
        self._restore = Restore(device, shape, in_dtype=np.uint8, out_dtype=np.uint8, padding=padding)
        # The pixel's own transfer stays in the image, as it is in the templates.
        axes = np.concatenate([optics.frequency_axis(n) for n in self._restore.padded_shape])
        self._otf = {part: Otf1d(device, axes) for part in self.parts}
        self._frame = device.empty(shape, np.uint8)
        self._images = {part: device.empty(shape, np.uint8) for part in self.parts}
        self._trackers: dict[str, TemplateTracker] = {}
        self._blurs: dict[str, Blur] = {}
        self._restored: list[str] = []

    def set_templates(
        self, part: str, templates: Sequence[Template], limits: TrackingLimits | None = None
    ) -> None:
        """Follow these features of `part` from now on."""
        self._require_part(part)
        tracker = self._trackers.get(part)
        if tracker is not None and len(tracker.templates) == len(templates):
            for index, template in enumerate(templates):
                tracker.replace(index, template)
            if limits is not None:
                tracker.limits = limits
            return
        self._trackers[part] = TemplateTracker(
            self.device, self.shape, templates, self._search_shape, limits=limits
        )

    def templates(self, part: str) -> list[Template]:
        """Return the features of `part` that are followed now.

        Raises
        ------
        TrackingError
            None have been set.
        """
        self._require_part(part)
        if part not in self._trackers:
            raise TrackingError(f"part '{part}' has no templates: set_templates first")
        return list(self._trackers[part].templates)

    def __call__(
        self,
        frame: Pixels,
        blurs: Mapping[str, Blur | None],
        expected_xy_px: Mapping[str, ArrayLike],
    ) -> dict[str, list[Measurement]]:
        """Restore one frame and measure every part's features.

        Parameters
        ----------
        frame : (rows, columns) uint8
        blurs
            For each part to measure, the blur its filter undoes; None leaves the frame as it is.
        expected_xy_px : (k, 2) each
            Where the features are expected.

        Raises
        ------
        InputError
            Another shape or type, an unknown part, or one without an expected place; nothing is enqueued.
        TrackingError
            A part without templates.
        """
        for part in blurs:
            self.templates(part)
            if part not in expected_xy_px:
                raise InputError(f"part '{part}' has no expected place: give one for every part of blurs")
        self._enqueue(frame, blurs)
        for part, blur in blurs.items():
            tracker = self._trackers[part]
            tracker.aim(expected_xy_px[part])
            tracker.enqueue(self._frame if blur is None else self._images[part])
        return {part: self._trackers[part].collect() for part in blurs}

    def restored(self, frame: Pixels, blurs: Mapping[str, Blur]) -> dict[str, Pixels]:
        """Return the frame restored for each part, on the host: to look at, or to cut templates from."""
        self._enqueue(frame, blurs)
        return {part: self._images[part].download() for part in blurs}

    def last_images(self) -> dict[str, Pixels]:
        """Return what the last frame was restored to, for each part it was restored for."""
        return {part: self._images[part].download() for part in self._restored}

    def _enqueue(self, frame: Pixels, blurs: Mapping[str, Blur | None]) -> None:
        for part in blurs:
            self._require_part(part)
        self._frame.upload(frame)
        self._restored = [part for part, blur in blurs.items() if blur is not None]
        if self._restored:
            self._restore.transform(self._frame)  # once for all parts
        for part, blur in blurs.items():
            if blur is None:
                continue
            slot = self.parts.index(part)
            if not blur.near(self._blurs.get(part)):
                table = self._otf[part]([(blur.alpha_rad, blur.psi_rad)])
                self._restore.set_filter_table(table, self.nsr, slot)
                self._blurs[part] = blur
            self._restore.apply(self._images[part], slot)

    def _require_part(self, part: str) -> None:
        if part not in self.parts:
            raise InputError(f"part '{part}' came: this pipeline follows {', '.join(self.parts)}")
