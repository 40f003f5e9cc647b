"""Whole runs on the twin, each made once and shared; its rig is wound back for what comes after."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from adof_cl import twin as twins
from adof_cl.cli.run import Truth
from adof_cl.device import Device
from adof_cl.loop import HOLE, PEG, PEG_OVER_HOLE, Assembly, Options
from adof_cl.record import RunRecord
from adof_cl.replan import Budget
from adof_cl.twin.parts import drawing_of


@dataclass
class Rehearsal:
    """One rig with its assembly; `events` tells in order what was said and which stage was sent where."""

    rig: twins.Twin
    assembly: Assembly
    record: RunRecord
    truth: Truth
    events: list[tuple[str, Any]] = field(default_factory=list)
    at: dict[str, twins.Truth] = field(default_factory=dict)
    _state: list[dict[str, Any]] = field(default_factory=list)
    _stood: dict[str, dict[str, float]] = field(default_factory=dict)

    @classmethod
    def new(cls, device: Device, seed: int, budget: Budget | None = None) -> Rehearsal:
        rig = twins.build(seed)
        for camera in (rig.camera_1, rig.camera_2):
            camera.set_centred_region()
        drawings = {
            PEG: drawing_of(rig.design.peg),
            PEG_OVER_HOLE: drawing_of(rig.design.peg, over_hole=True),
            HOLE: drawing_of(rig.design.hole),
        }
        record = RunRecord(seed, str(device.facts))
        options = Options(rig_name=f"twin {seed}", budget=budget)
        truth = Truth(rig, record, options)
        assembly = Assembly(device, rig, rig.design, drawings, record, options=options)
        made = cls(rig, assembly, record, truth)
        made.listen()
        for name in ("coarse", "fine"):
            made._overhear(name)
        return made

    def listen(self) -> None:
        """Hear what the assembly says, with nothing in its way."""
        self.assembly._tell = lambda stage, sentence: self.events.append(("said", (stage, sentence)))
        self.assembly._observe = self.truth.observe
        self.assembly._reached = self._reached

    def _reached(self, stage: str) -> None:
        self.at[stage] = self.rig.world.truth()
        self.truth.reached(stage)

    def _overhear(self, name: str) -> None:
        stage = getattr(self.rig, name)
        move = stage.move_to

        def move_to(targets: Mapping[str, float], *, speed: float | None = None) -> None:
            self.events.append((name, dict(targets)))
            move(targets, speed=speed)

        stage.move_to = move_to

    def positions(self) -> dict[str, dict[str, float]]:
        return {"coarse": self.rig.coarse.position(), "fine": self.rig.fine.position()}

    def keep(self) -> None:
        """Remember this moment for `wind_back`."""
        assembly = self.assembly
        self._stood = self.positions()
        self._state = [_shallow(vars(thing)) for thing in (assembly, *assembly.eyes)]

    def wind_back(self) -> RunRecord:
        """Bring parts and assembly back to the moment kept, out of the hole first; returns a new record."""
        self.rig.coarse.move_to({"z": self._stood["coarse"]["z"]})
        self.rig.coarse.wait_until_still()
        self.rig.coarse.move_to(self._stood["coarse"])
        self.rig.fine.move_to(self._stood["fine"])
        self.rig.coarse.wait_until_still()
        self.rig.fine.wait_until_still()
        assembly = self.assembly
        for thing, state in zip((assembly, *assembly.eyes), self._state, strict=True):
            vars(thing).clear()
            vars(thing).update(_shallow(state))
        for eye in assembly.eyes:
            eye._learnt.clear()  # the pipelines have learnt other templates since
        assembly._shown = False
        record = RunRecord(self.record.seed, self.record.device)
        assembly.record = record
        self.truth = Truth(self.rig, record, assembly.options)
        self.events.clear()
        self.listen()
        return record


def _shallow(state: Mapping[str, Any]) -> dict[str, Any]:
    """Copy containers and arrays, share the rest."""
    return {
        name: copy.copy(value) if isinstance(value, dict | list | np.ndarray) else value
        for name, value in state.items()
    }


@dataclass(frozen=True)
class FullRun:
    """One finished run, as it came out; `rehearsal` may since have been wound back."""

    rehearsal: Rehearsal
    record: RunRecord
    events: list[tuple[str, Any]]
    at: dict[str, twins.Truth]
    contacts: tuple[twins.Contact, ...]


@cache
def full_run(device: Device, seed: int) -> FullRun:
    """Run one seed from start to docked, as `adof run` does; a second call returns the same run."""
    made = Rehearsal.new(device, seed)
    assembly = made.assembly
    with assembly.stages_stopped_afterwards():
        assembly.prepare()
        made.keep()
        assembly.assemble()
    made.truth.finish()
    contacts = made.rig.world.contacts
    return FullRun(made, made.record, list(made.events), dict(made.at), contacts)
