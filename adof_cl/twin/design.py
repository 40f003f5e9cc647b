"""What the rig was built to be: sizes, optics and stages as drawn. No world's secrets are here."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError
from adof_cl.optics import Mask, OpticalSystem, SlmPanel, require_finite, require_positive

# How far from alignment the hole may start, along x and along y.
START_REACH_UM = 300.0


@dataclass(frozen=True)
class Peg:
    """The part to insert; its top face carries the features. Its own origin is the top face's centre."""

    width_um: float = 450.0
    depth_um: float = 400.0
    height_um: float = 300.0

    @property
    def corners_um(self) -> NDArray[np.float64]:
        """Corners of the top face (4, 2) as (x, y): -x -y, +x -y, +x +y, -x +y."""
        return _corners(self.width_um, self.depth_um)


@dataclass(frozen=True)
class HolePlate:
    """The plate with the hole in its middle. Its own origin is the hole's centre on the top face."""

    width_um: float = 650.0
    depth_um: float = 500.0
    thickness_um: float = 350.0
    plate_width_um: float = 2400.0
    plate_depth_um: float = 2000.0

    @property
    def corners_um(self) -> NDArray[np.float64]:
        """Corners of the hole (4, 2) as (x, y): -x -y, +x -y, +x +y, -x +y."""
        return _corners(self.width_um, self.depth_um)


def _corners(width_um: float, depth_um: float) -> NDArray[np.float64]:
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    return np.asarray(signs * np.array([width_um, depth_um]) / 2)


@dataclass(frozen=True)
class AxisDesign:
    """One motor: smallest step, fastest speed, first and last position; um or rad."""

    resolution: float
    speed_limit: float
    low: float
    high: float

    def __post_init__(self) -> None:
        require_positive(resolution=self.resolution, speed_limit=self.speed_limit)
        require_finite(low=self.low, high=self.high)
        if not self.low < self.high:
            raise InputError(
                f"axis limits are {self.low} to {self.high}: the first must lie below the second"
            )


def _coarse_axes() -> dict[str, AxisDesign]:
    return {
        "x": AxisDesign(3.0, 1000.0, -2500.0, 2500.0),
        "y": AxisDesign(3.0, 1000.0, -2500.0, 2500.0),
        "theta": AxisDesign(32e-6, 0.2, -0.2, 0.2),
        "z": AxisDesign(0.03, 1000.0, -4300.0, 500.0),
    }


def _fine_axes() -> dict[str, AxisDesign]:
    return {"x": AxisDesign(0.03, 200.0, -250.0, 250.0), "y": AxisDesign(0.03, 200.0, -250.0, 250.0)}


@dataclass(frozen=True)
class Design:
    """The rig as drawn; the composition root may know all of it.

    World axes are camera 1's: x to the image's right, y down the image, z away from the lens; um. The plane
    camera 1 focuses on with nothing on the modulator is z = 0. Camera 2 is turned about y by `tilt_rad`: it
    sees x' = x cos t + z sin t, y' = y, and its depth is z cos t - x sin t (docs/maths.md, T1).

    Attributes
    ----------
    optics_1, optics_2
        Both cameras' optics.
    rows, columns, frame_rate_hz, exposure_s
        Both cameras' sensor and timing; exposures start together.
    full_well_e, read_noise_e, exposure_level
        Electrons at code 255; noise of reading; share of the full well that radiance 1 fills.
    panel, settling_s
        Camera 1's modulator; the time it takes to change.
    tilt_rad
        Angle between the two optical axes.
    depth_range_um
        Farthest the hole starts from the peg; camera 2's mask and aim are derived from it.
    """

    optics_1: OpticalSystem = field(default_factory=OpticalSystem)
    optics_2: OpticalSystem = field(default_factory=OpticalSystem)
    rows: int = 494
    columns: int = 659
    region_rows: int = 400
    region_columns: int = 512
    frame_rate_hz: float = 60.0
    exposure_s: float = 0.004
    full_well_e: float = 20_000.0
    read_noise_e: float = 12.0
    exposure_level: float = 0.9
    panel: SlmPanel = field(
        default_factory=lambda: SlmPanel("LC2002", 600, 800, 32.0, 0.55, 60.0, source="docs/maths.md, T2")
    )
    settling_s: float = 0.03
    tilt_rad: float = math.radians(30)
    depth_range_um: float = 4000.0
    command_latency_s: float = 0.01
    peg: Peg = field(default_factory=Peg)
    hole: HolePlate = field(default_factory=HolePlate)
    coarse: dict[str, AxisDesign] = field(default_factory=_coarse_axes)
    fine: dict[str, AxisDesign] = field(default_factory=_fine_axes)

    def __post_init__(self) -> None:
        require_positive(
            frame_rate_hz=self.frame_rate_hz,
            exposure_s=self.exposure_s,
            full_well_e=self.full_well_e,
            exposure_level=self.exposure_level,
            settling_s=self.settling_s,
            depth_range_um=self.depth_range_um,
        )
        if not math.radians(5) <= self.tilt_rad <= math.radians(48):
            raise InputError(
                f"tilt_rad is {self.tilt_rad}: 0.088 to 0.837 (5 to 48 degrees) was wanted, "
                "less cannot see depth and more leaves the frame"
            )
        if self.exposure_s * self.frame_rate_hz >= 1:
            raise InputError(
                f"exposure_s is {self.exposure_s}: at most the frame time was wanted, "
                f"{1 / self.frame_rate_hz:.4f} s"
            )
        if not (self.region_rows <= self.rows and self.region_columns <= self.columns):
            raise InputError(
                f"region is {self.region_rows} x {self.region_columns}: it must fit the sensor, "
                f"{self.rows} x {self.columns}"
            )

    @property
    def centre_xy_px(self) -> NDArray[np.float64]:
        """Sensor centre; pixel centres lie at integers."""
        return np.array([(self.columns - 1) / 2, (self.rows - 1) / 2])

    @property
    def region_origin_yx(self) -> tuple[int, int]:
        """First row and column of the centred region of interest."""
        return (self.rows - self.region_rows) // 2, (self.columns - self.region_columns) // 2

    @property
    def aim_um(self) -> float:
        """Where camera 2's centre looks, as x': midway between the hole docked and farthest (T3)."""
        far = self.depth_range_um * math.sin(self.tilt_rad) + START_REACH_UM * math.cos(self.tilt_rad)
        return far / 2

    @property
    def mask_2(self) -> Mask:
        """Camera 2's fixed cubic plate: focus at mid-range, just strong enough for both ends (T4)."""
        half_range = self.optics_2.psi_rad(self.depth_range_um * math.cos(self.tilt_rad)) / 2
        sideways = self.optics_2.psi_rad(START_REACH_UM * math.sin(self.tilt_rad))
        return Mask(alpha_rad=(half_range + sideways) / 1.5, focus_psi_rad=-half_range)

    def projection(self, camera: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the drawn camera: px = matrix (2, 3) @ world_um + origin (2,)."""
        return camera_matrix(self, camera)


def camera_matrix(
    design: Design,
    camera: int,
    *,
    tilt_error_rad: float = 0.0,
    roll_rad: float = 0.0,
    scale_error: float = 0.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Project the world onto a camera's pixels: px = matrix (2, 3) @ world_um + origin (2,) (T1)."""
    if camera == 1:
        optics, across, aim_um = design.optics_1, (1.0, 0.0, 0.0), 0.0
    elif camera == 2:
        tilt = design.tilt_rad + tilt_error_rad
        optics, across, aim_um = design.optics_2, (math.cos(tilt), 0.0, math.sin(tilt)), design.aim_um
    else:
        raise InputError(f"camera is {camera}: 1 or 2 was wanted")
    c, s = math.cos(roll_rad), math.sin(roll_rad)
    turn = (1 + scale_error) / optics.object_pitch_um * np.array([[c, -s], [s, c]])
    return turn @ np.array([across, (0.0, 1.0, 0.0)]), design.centre_xy_px - turn @ np.array([aim_um, 0.0])
