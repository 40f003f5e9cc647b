"""The hidden world: where the parts are, whether they touch, and what light they send to each camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError
from adof_cl.optics import require_finite
from adof_cl.twin.design import START_REACH_UM, Design, camera_matrix
from adof_cl.twin.parts import BACKGROUND, Painted, paint_peg, paint_plate
from adof_cl.twin.pupil import Pupil
from adof_cl.twin.render import Layer

_CONTACT_STEP_S = 0.001

Blend = Callable[[float, float], list[tuple[float, Pupil]]]


class Course(Protocol):
    """Where an axis is at any time, past or planned."""

    def at(self, time_s: float | NDArray[np.float64]) -> NDArray[np.float64]: ...  # noqa: D102


class Axes(Protocol):
    """A stage as the world sees it."""

    @property
    def axes(self) -> Mapping[str, Course]: ...  # noqa: D102


class Time(Protocol):
    """A clock that tells of every interval that passed."""

    @property
    def now_s(self) -> float: ...  # noqa: D102
    def on_advance(self, listener: Callable[[float, float], None]) -> None: ...  # noqa: D102


@dataclass(frozen=True)
class Start:
    """Where the hole begins, relative to the peg: its centre's offset, its turn, its depth below the peg."""

    x_um: float
    y_um: float
    theta_rad: float
    depth_um: float

    def __post_init__(self) -> None:
        require_finite(x_um=self.x_um, y_um=self.y_um, theta_rad=self.theta_rad, depth_um=self.depth_um)

    @classmethod
    def drawn(cls, rng: np.random.Generator, design: Design) -> Start:
        """Draw a start within +-300 um, +-5 degrees and the farthest eighth of the depth range."""
        x, y = rng.uniform(-START_REACH_UM, START_REACH_UM, 2)
        theta = math.radians(rng.uniform(-5, 5))
        return cls(float(x), float(y), theta, float(rng.uniform(0.875, 1.0) * design.depth_range_um))


@dataclass(frozen=True)
class Misalignment:
    """How this rig differs from its drawing. Hidden from everything but the truth.

    Attributes
    ----------
    coarse_axes : (3, 3)
        World direction of the coarse stage's x, y, z, one per column: turned about z by up to 0.5 degrees, z
        tilted by up to 0.5 degrees.
    fine_axes : (2, 2)
        The same for the fine stage's x, y.
    arm_um
        From the rotation's centre to the hole's centre when the stage is at 0, (x, y).
    scale_error, roll_rad, tilt_error_rad
        Per camera (the tilt for camera 2 only).
    peg_xyz_um, peg_theta_rad
        The peg as gripped.
    """

    coarse_axes: NDArray[np.float64]
    fine_axes: NDArray[np.float64]
    arm_um: NDArray[np.float64]
    scale_error: tuple[float, float]
    roll_rad: tuple[float, float]
    tilt_error_rad: float
    peg_xyz_um: NDArray[np.float64]
    peg_theta_rad: float

    @classmethod
    def none(cls) -> Misalignment:
        """Return a rig exactly as drawn, the peg at the origin."""
        return cls(np.eye(3), np.eye(2), np.zeros(2), (0.0, 0.0), (0.0, 0.0), 0.0, np.zeros(3), 0.0)

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Misalignment:
        """Draw one rig: half a degree and half a percent everywhere."""
        angle = math.radians(0.5)
        coarse_turn, fine_turn, roll_2, tilt = (float(a) for a in rng.uniform(-angle, angle, 4))
        lean, towards = rng.uniform(0, angle), rng.uniform(0, 2 * math.pi)
        coarse = np.eye(3)
        coarse[:2, :2] = _turn(coarse_turn)
        coarse[:, 2] = [
            math.sin(lean) * math.cos(towards),
            math.sin(lean) * math.sin(towards),
            math.cos(lean),
        ]
        scale_1, scale_2 = (float(e) for e in rng.uniform(-0.005, 0.005, 2))
        return cls(
            coarse_axes=coarse,
            fine_axes=_turn(fine_turn),
            arm_um=rng.uniform(-150, 150, 2),
            scale_error=(scale_1, scale_2),
            roll_rad=(0.0, roll_2),
            tilt_error_rad=tilt,
            peg_xyz_um=np.append(rng.uniform(-20, 20, 2), rng.uniform(-80, 80)),
            peg_theta_rad=float(rng.uniform(-angle, angle)),
        )


def _turn(theta_rad: float) -> NDArray[np.float64]:
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    return np.array([[c, -s], [s, c]])


@dataclass(frozen=True)
class Pose:
    """A part's top face: centre in the world, turn about z from x towards y."""

    x_um: float
    y_um: float
    z_um: float
    theta_rad: float

    @property
    def xyz_um(self) -> NDArray[np.float64]:
        """Centre of the top face."""
        return np.array([self.x_um, self.y_um, self.z_um])


@dataclass(frozen=True)
class Truth:
    """What is really so at one moment.

    Attributes
    ----------
    offset_um
        Hole's centre minus peg's centre, (x, y).
    offset_rad
        Hole's turn minus peg's turn.
    depth_um
        Hole's top face below the peg's top face.
    contact
        The solids overlap.
    inserted
        The peg's bottom is below the plate's top face, inside the hole.
    mask_in_transition
        Camera 1's modulator was changing.
    """

    time_s: float
    peg: Pose
    hole: Pose
    offset_um: tuple[float, float]
    offset_rad: float
    depth_um: float
    contact: bool
    inserted: bool
    mask_in_transition: bool


@dataclass(frozen=True)
class Contact:
    """The solids began to overlap."""

    time_s: float
    offset_um: tuple[float, float]
    offset_rad: float
    depth_um: float


class World:
    """Parts on stages, in front of two cameras."""

    def __init__(
        self,
        design: Design,
        misalignment: Misalignment,
        start: Start,
        clock: Time,
        coarse: Axes,
        fine: Axes,
        modulator: Blend,
        seed: int,
    ) -> None:
        self.design = design
        self.clock = clock
        self._secret = misalignment
        self._coarse, self._fine = coarse, fine
        self._modulator = modulator
        self._hole_theta_rad = misalignment.peg_theta_rad + start.theta_rad
        centre = misalignment.peg_xyz_um + np.array([start.x_um, start.y_um, start.depth_um])
        arm = _turn(self._hole_theta_rad) @ misalignment.arm_um
        # Where the rotation's axis meets the plate's top face while every stage stands at 0.
        self._pivot_um = centre - np.append(arm, 0.0)
        self._cameras = {
            number: camera_matrix(
                design,
                number,
                tilt_error_rad=misalignment.tilt_error_rad if number == 2 else 0.0,
                roll_rad=misalignment.roll_rad[number - 1],
                scale_error=misalignment.scale_error[number - 1],
            )
            for number in (1, 2)
        }
        self._glass_2 = Pupil.glass(design.mask_2)
        self._plate = paint_plate(design.hole, np.random.default_rng([seed, 101]))
        self._peg_seed = [seed, 102]
        self._pegs: dict[float, Painted] = {}
        optics = {1: design.optics_1, 2: design.optics_2}
        self._plate_layers = {n: Layer(o) for n, o in optics.items()}
        self._peg_layers = {n: Layer(o) for n, o in optics.items()}
        self._contacts: list[Contact] = []
        self._touching = False
        clock.on_advance(self._watch)

    # ---- where things are ----------------------------------------------------------------------------------

    def hole_pose(self, time_s: float | None = None) -> Pose:
        """Return the hole's pose, now or at any time."""
        x, y, z, theta = (float(v) for v in self._hole_at(np.atleast_1d(self._time(time_s)))[0])
        return Pose(x, y, z, theta)

    def peg_pose(self, time_s: float | None = None) -> Pose:
        """Return the peg's pose, now or at any time."""
        x, y = (float(v) for v in self._peg_at(np.atleast_1d(self._time(time_s)))[0])
        return Pose(x, y, float(self._secret.peg_xyz_um[2]), self._secret.peg_theta_rad)

    def truth(self, time_s: float | None = None) -> Truth:
        """Return what is so now, or was at `time_s`."""
        now_s = self._time(time_s)
        peg, hole = self.peg_pose(now_s), self.hole_pose(now_s)
        depth = hole.z_um - peg.z_um
        contact, inside = (bool(flag[0]) for flag in self._overlap(np.atleast_1d(now_s)))
        return Truth(
            time_s=now_s,
            peg=peg,
            hole=hole,
            offset_um=(hole.x_um - peg.x_um, hole.y_um - peg.y_um),
            offset_rad=hole.theta_rad - peg.theta_rad,
            depth_um=depth,
            contact=contact,
            inserted=inside and -self.design.hole.thickness_um < depth < self.design.peg.height_um,
            mask_in_transition=len(self._modulator(now_s, now_s)) > 1,
        )

    def corners_um(self, part: str, time_s: float | None = None) -> NDArray[np.float64]:
        """Return the corners of "hole" or "peg" in the world (4, 3): -x -y, +x -y, +x +y, -x +y."""
        if part == "hole":
            pose, corners = self.hole_pose(time_s), self.design.hole.corners_um
        elif part == "peg":
            pose, corners = self.peg_pose(time_s), self.design.peg.corners_um
        else:
            raise InputError(f"part is {part!r}: 'hole' or 'peg' was wanted")
        flat = corners @ _turn(pose.theta_rad).T
        return np.asarray(pose.xyz_um + np.concatenate([flat, np.zeros((4, 1))], axis=1))

    def corners_px(self, camera: int, part: str, time_s: float | None = None) -> NDArray[np.float64]:
        """Return where the corners of "hole" or "peg" fall on a camera's whole sensor (4, 2), (x, y)."""
        matrix, origin = self._camera(camera)
        return np.asarray(self.corners_um(part, time_s) @ matrix.T + origin)

    def projection(self, camera: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the true camera: px = matrix (2, 3) @ world_um + origin (2,)."""
        matrix, origin = self._camera(camera)
        return matrix.copy(), origin.copy()

    def psi_rad(self, camera: int, part: str, time_s: float | None = None) -> float:
        """Return the true defocus of "hole" or "peg" at a camera, without the mask's focus term."""
        if part not in ("hole", "peg"):
            raise InputError(f"part is {part!r}: 'hole' or 'peg' was wanted")
        pose = self.hole_pose(time_s) if part == "hole" else self.peg_pose(time_s)
        if camera == 1:
            return self.design.optics_1.psi_rad(pose.z_um)
        self._camera(camera)
        tilt = self.design.tilt_rad + self._secret.tilt_error_rad
        return self.design.optics_2.psi_rad(pose.z_um * math.cos(tilt) - pose.x_um * math.sin(tilt))

    def stage_directions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the world directions of the coarse (3, 3) and fine (2, 2) axes, one per column."""
        return self._secret.coarse_axes.copy(), self._secret.fine_axes.copy()

    def _time(self, time_s: float | None) -> float:
        return self.clock.now_s if time_s is None else time_s

    def _camera(self, number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if number not in self._cameras:
            raise InputError(f"camera is {number}: 1 or 2 was wanted")
        return self._cameras[number]

    def _hole_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hole pose (n, 4) as x, y, z, theta."""
        axes = self._coarse.axes
        travel = np.stack([axes[name].at(times_s) for name in ("x", "y", "z")], axis=1)
        theta = self._hole_theta_rad + axes["theta"].at(times_s)
        arm = self._secret.arm_um
        c, s = np.cos(theta), np.sin(theta)
        out = np.empty((times_s.size, 4))
        out[:, :3] = self._pivot_um + travel @ self._secret.coarse_axes.T
        out[:, 0] += c * arm[0] - s * arm[1]
        out[:, 1] += s * arm[0] + c * arm[1]
        out[:, 3] = theta
        return out

    def _peg_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        travel = np.stack([self._fine.axes[name].at(times_s) for name in ("x", "y")], axis=1)
        return np.asarray(self._secret.peg_xyz_um[:2] + travel @ self._secret.fine_axes.T)

    # ---- touching ------------------------------------------------------------------------------------------

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Every moment at which the solids began to overlap."""
        return tuple(self._contacts)

    def contact(self) -> bool:
        """Return whether the solids overlap now."""
        return bool(self._overlap(np.atleast_1d(self.clock.now_s))[0][0])

    def _overlap(self, times_s: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return whether solids overlap, and whether the peg's outline lies inside the hole's (T9)."""
        hole, peg = self._hole_at(times_s), self._peg_at(times_s)
        depth = hole[:, 2] - self._secret.peg_xyz_um[2]
        level = (depth < self.design.peg.height_um) & (depth > -self.design.hole.thickness_um)
        corners = self.design.peg.corners_um @ _turn(self._secret.peg_theta_rad).T
        from_hole = peg[:, None, :] + corners - hole[:, None, :2]
        c, s = np.cos(hole[:, 3, None]), np.sin(hole[:, 3, None])
        x = c * from_hole[..., 0] + s * from_hole[..., 1]
        y = c * from_hole[..., 1] - s * from_hole[..., 0]
        plate = self.design.hole
        inside = ((np.abs(x) <= plate.width_um / 2) & (np.abs(y) <= plate.depth_um / 2)).all(axis=1)
        # One corner over the plate is enough: the peg is too small to straddle it.
        over = ((np.abs(x) < plate.plate_width_um / 2) & (np.abs(y) < plate.plate_depth_um / 2)).any(axis=1)
        return np.asarray(level & over & ~inside), np.asarray(inside)

    def _watch(self, from_s: float, to_s: float) -> None:
        steps = max(1, math.ceil((to_s - from_s) / _CONTACT_STEP_S))
        times = np.linspace(from_s, to_s, steps + 1)[1:]
        overlap, _ = self._overlap(times)
        before = np.concatenate([[self._touching], overlap[:-1]])
        for time_s in times[overlap & ~before]:
            truth = self.truth(float(time_s))
            self._contacts.append(Contact(truth.time_s, truth.offset_um, truth.offset_rad, truth.depth_um))
        self._touching = bool(overlap[-1])

    # ---- light ---------------------------------------------------------------------------------------------

    def radiance(
        self, camera: int, from_s: float, to_s: float, origin_yx: tuple[int, int], shape: tuple[int, int]
    ) -> NDArray[np.float32]:
        """Return the noiseless image of one exposure on part of the sensor, in [0, 1] (T10).

        The parts stand as they do at mid-exposure.
        """
        self._camera(camera)
        middle_s = (from_s + to_s) / 2
        blend = self._modulator(from_s, to_s) if camera == 1 else [(1.0, self._glass_2)]
        image = np.zeros(shape, dtype=np.float32)
        for weight, pupil in blend:
            image += weight * self._seen(camera, middle_s, pupil, origin_yx, shape)
        return image

    def _seen(
        self, camera: int, time_s: float, pupil: Pupil, origin_yx: tuple[int, int], shape: tuple[int, int]
    ) -> NDArray[np.float32]:
        matrix, origin = self._camera(camera)
        hole, peg = self.hole_pose(time_s), self.peg_pose(time_s)
        image = np.full(shape, BACKGROUND, dtype=np.float32)
        planes, first = self._plate_layers[camera].image(
            self._plate,
            matrix[:, :2] @ _turn(hole.theta_rad),
            matrix @ hole.xyz_um + origin,
            pupil,
            self.psi_rad(camera, "hole", time_s),
        )
        seen, part = _overlapping(image, origin_yx, planes, first)
        seen += part[0]
        planes, first = self._peg_layers[camera].image(
            self._painted_peg(camera, hole, peg),
            matrix[:, :2] @ _turn(peg.theta_rad),
            matrix @ peg.xyz_um + origin,
            pupil,
            self.psi_rad(camera, "peg", time_s),
        )
        seen, part = _overlapping(image, origin_yx, planes, first)
        seen *= 1 - part[1]
        seen += part[0]
        return image

    def _painted_peg(self, camera: int, hole: Pose, peg: Pose) -> Painted:
        """Return the peg as this camera sees it: the tilted one sees its side, down to the plate's rim."""
        side = 0.0
        if camera == 2:
            tangent = math.tan(self.design.tilt_rad)
            gap = (self.design.hole.width_um - self.design.peg.width_um) / 2
            visible = hole.z_um - peg.z_um + gap / tangent
            # In steps of 8 um, so that the peg is not painted anew at every move.
            side = 8.0 * round(min(max(visible, 0.0), self.design.peg.height_um) * tangent / 8.0)
        if side not in self._pegs:
            rng = np.random.default_rng(self._peg_seed)
            self._pegs[side] = paint_peg(self.design.peg, rng, side_um=side)
        return self._pegs[side]


def _overlapping(
    image: NDArray[np.float32],
    origin_yx: tuple[int, int],
    planes: NDArray[np.float32],
    first_yx: tuple[int, int],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the views of image and planes that show the same pixels."""
    here, there = [], []
    for axis in (0, 1):
        offset = first_yx[axis] - origin_yx[axis]
        start = max(0, offset)
        stop = max(start, min(image.shape[axis], offset + planes.shape[axis + 1]))
        here.append(slice(start, stop))
        there.append(slice(start - offset, stop - offset))
    return image[here[0], here[1]], planes[:, there[0], there[1]]
