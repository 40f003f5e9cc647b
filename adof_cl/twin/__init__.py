"""The simulated rig: one hidden world with exact optics, and devices that act on it.

Shares nothing with the pipeline but `optics`, `errors` and `reference`. Time is the clock's alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adof_cl.errors import InputError
from adof_cl.twin.clock import Clock
from adof_cl.twin.design import AxisDesign, Design, HolePlate, Peg
from adof_cl.twin.devices import Frame, SimulatedCamera, SimulatedSlm
from adof_cl.twin.recorded import RecordedStage
from adof_cl.twin.stages import SimulatedStage
from adof_cl.twin.world import Axes, Contact, Misalignment, Pose, Start, Time, Truth, World

__all__ = [
    "AxisDesign",
    "Clock",
    "Contact",
    "Design",
    "Frame",
    "HolePlate",
    "Misalignment",
    "Peg",
    "Pose",
    "RecordedStage",
    "SimulatedCamera",
    "SimulatedSlm",
    "SimulatedStage",
    "Start",
    "Truth",
    "Twin",
    "World",
    "build",
    "lit",
]


@dataclass(frozen=True)
class Twin:
    """Every part of one simulated rig. `world` is the truth: the loop must never be given it."""

    seed: int
    design: Design
    clock: Clock
    world: World
    camera_1: SimulatedCamera
    camera_2: SimulatedCamera
    slm: SimulatedSlm
    coarse: SimulatedStage
    fine: SimulatedStage


def build(
    seed: int,
    *,
    design: Design | None = None,
    start: Start | None = None,
    misalignment: Misalignment | None = None,
    noise: bool = True,
    slm_pixels: bool = True,
) -> Twin:
    """Build one rig; the same seed gives the same frames, bit for bit.

    Parameters
    ----------
    seed
        Draws start, misalignment, grain of the parts and camera noise; 0 or more.
    start, misalignment
        Instead of those the seed draws.
    noise
        Photon and read noise; the 8 bits stay.
    slm_pixels
        Let the panel's steps and 256 levels act, not the polynomial they stand for.

    Raises
    ------
    InputError
        A negative seed, or a stop that does not fit the panel.
    """
    design = design or Design()
    clock = Clock()
    coarse = SimulatedStage(design.coarse, clock, design.command_latency_s)
    fine = SimulatedStage(design.fine, clock, design.command_latency_s)
    slm = SimulatedSlm(design.panel, design.optics_1.aperture_um, clock, design.settling_s, pixels=slm_pixels)
    world = lit(seed, design, clock, coarse, fine, slm, start=start, misalignment=misalignment)
    return Twin(
        seed=seed,
        design=design,
        clock=clock,
        world=world,
        camera_1=SimulatedCamera(1, world, clock, seed, noise=noise),
        camera_2=SimulatedCamera(2, world, clock, seed, noise=noise),
        slm=slm,
        coarse=coarse,
        fine=fine,
    )


def lit(
    seed: int,
    design: Design,
    clock: Time,
    coarse: Axes,
    fine: Axes,
    slm: SimulatedSlm,
    *,
    start: Start | None = None,
    misalignment: Misalignment | None = None,
) -> World:
    """Return the world that `build` makes of a seed, on these stages and through this modulator."""
    if seed < 0:
        raise InputError(f"seed is {seed}: 0 or more was wanted")
    rng = np.random.default_rng([seed, 100])
    drawn_start, drawn_misalignment = Start.drawn(rng, design), Misalignment.drawn(rng)
    return World(
        design,
        misalignment or drawn_misalignment,
        start or drawn_start,
        clock,
        coarse,
        fine,
        slm.acting,
        seed,
    )
