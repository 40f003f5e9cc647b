"""Peg and hole on the twin with everything known: frames through any mask, and where the features really are.

What is measured against it is off by so much, not by an estimate. Both cameras; templates taken in focus.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adof_cl import twin
from adof_cl.device import Device
from adof_cl.loop import HOLE, PEG, cut_templates
from adof_cl.optics import Mask
from adof_cl.pipeline import Blur, CameraPipeline
from adof_cl.slm_encode import SlmEncode
from adof_cl.tracking import Template
from adof_cl.twin.devices import SimulatedCamera

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

PARTS = (PEG, HOLE)
FARTHEST_UM = 4000.0
_DIAGONAL = [0, 2]


@dataclass(frozen=True, eq=False)
class Exposure:
    """One frame, and the truth about it.

    Attributes
    ----------
    corners_px : (2, 2) each
        Where both followed corners of each part are in the region of interest, (x, y).
    """

    pixels: Pixels
    corners_px: Mapping[str, Array]


class Specimen:
    """Peg and hole of one seed; the hole aside, so that the peg hides neither followed corner.

    Parameters
    ----------
    device
        Forms the panel's codes.
    seed
        Draws the parts' grain and the noise.
    offset_um
        Where the hole's middle lies from the peg's: x above 0, y below.
    turn_rad
        How far the hole is turned.
    noise
        The camera's noise over that of the design.
    """

    def __init__(
        self,
        device: Device,
        seed: int,
        *,
        offset_um: tuple[float, float] = (150.0, -120.0),
        turn_rad: float = 0.03,
        noise: float = 1.0,
    ) -> None:
        drawn = twin.Design()
        # Both noises over the signal grow alike.
        self.design = twin.Design(
            full_well_e=drawn.full_well_e / noise**2, read_noise_e=drawn.read_noise_e / noise
        )
        start = twin.Start(*offset_um, turn_rad, FARTHEST_UM)
        self.rig = twin.build(seed, design=self.design, start=start, misalignment=twin.Misalignment.none())
        quiet = (SimulatedCamera(n, self.rig.world, self.rig.clock, seed, noise=False) for n in (1, 2))
        self._cameras = {False: tuple(quiet), True: (self.rig.camera_1, self.rig.camera_2)}
        for cameras in self._cameras.values():
            for camera in cameras:
                camera.set_centred_region()
        self.optics = self.design.optics_1
        self.shape = (self.design.region_rows, self.design.region_columns)
        self._device = device
        self._encoder = SlmEncode(device, self.design.panel, self.optics)
        self._origin_xy = np.array(self.design.region_origin_yx[::-1], dtype=np.float64)
        self._home = dict(self.rig.coarse.position())
        self._mask: Mask | None = None
        self._pictures: dict[tuple[str, int], Exposure] = {}

    def place(
        self,
        depth_um: float,
        hole_um: tuple[float, float] = (0.0, 0.0),
        peg_um: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Bring the hole to a depth below the peg's face, at most `FARTHEST_UM`, and both aside by (x, y)."""
        home = self._home
        there = {"x": home["x"] + hole_um[0], "y": home["y"] + hole_um[1]}
        self.rig.coarse.move_to({**there, "z": home["z"] + depth_um - FARTHEST_UM})
        self.rig.fine.move_to({"x": peg_um[0], "y": peg_um[1]})
        self.rig.coarse.wait_until_still()
        self.rig.fine.wait_until_still()

    def depth_um(self, part: str) -> float:
        """Return a part's true depth from camera 1's plane in focus."""
        world = self.rig.world
        return world.peg_pose().z_um if part == PEG else world.hole_pose().z_um

    def middle_um(self, part: str) -> Array:
        """Return the true middle of a part's followed corners in the world, (3,)."""
        return np.asarray(self.rig.world.corners_um(part)[_DIAGONAL].mean(axis=0))

    def expose(self, mask: Mask, *, camera: int = 1, noise: bool = True) -> Exposure:
        """Take a frame; camera 1 looks through `mask`, camera 2 through its own."""
        if mask != self._mask:
            self.rig.slm.show(self._encoder.codes(mask))
            self.rig.clock.wait(2 * self.design.settling_s)
            self._mask = mask
        frame = self._cameras[noise][camera - 1].grab()
        corners = {
            part: self.rig.world.corners_px(camera, part, frame.time_s)[_DIAGONAL] - self._origin_xy
            for part in PARTS
        }
        return Exposure(frame.pixels, corners)

    def blur(self, part: str, mask: Mask, *, camera: int = 1, depth_error_um: float = 0.0) -> Blur:
        """Return what blurs a part: exact, but for an error of its depth."""
        if camera == 1:
            return Blur.of(mask, self.optics, self.depth_um(part) + depth_error_um)
        tilt = self.design.tilt_rad
        x_um = self.rig.world.hole_pose().x_um if part == HOLE else self.rig.world.peg_pose().x_um
        depth_um = (self.depth_um(part) + depth_error_um) * math.cos(tilt) - x_um * math.sin(tilt)
        return Blur.of(self.design.mask_2, self.design.optics_2, depth_um)

    def templates(self, part: str, side_px: int, *, camera: int = 1, features: int = 2) -> list[Template]:
        """Return a part's templates, anchored at its true corners; the pictures are taken once, in focus."""
        if (part, camera) not in self._pictures:
            focused = Mask(0.0, -self.optics.psi_rad(self.depth_um(part)))
            taken = self.expose(focused, camera=camera)
            if camera == 2:
                pipeline = CameraPipeline(self._device, self.design.optics_2, self.shape, (part,))
                sharp = pipeline.restored(taken.pixels, {part: self.blur(part, focused, camera=2)})[part]
                taken = Exposure(sharp, taken.corners_px)
            self._pictures[part, camera] = taken
        taken = self._pictures[part, camera]
        shape = (side_px, side_px)
        corners = taken.corners_px[part]
        return cut_templates(taken.pixels, corners, part, shape=shape, optics=self.optics)[:features]

    def depth_seen_um(self, first: Array, second: Array) -> float:
        """Return the depth of a place seen at `first` by camera 1 and at `second` by camera 2, (x, y)."""
        matrices, origins = zip(*(self.rig.world.projection(n) for n in (1, 2)), strict=True)
        seen = np.concatenate([first + self._origin_xy - origins[0], second + self._origin_xy - origins[1]])
        return float((np.linalg.pinv(np.vstack(matrices)) @ seen)[2])
