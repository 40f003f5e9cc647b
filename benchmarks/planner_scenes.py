"""Is the planner right? Random scenes that no profile was made from, planned and then measured.

    python benchmarks/planner_scenes.py                      200 scenes, 24 of them searched exhaustively
    python benchmarks/planner_scenes.py --profile mine.json --scenes 50 --json planner.json

For each scene: a plan is asked for, carried out once on the twin, and its features' errors compared with what
was allowed; its time with what was predicted, at the pace of a reference chain that takes turns with it. In
some scenes every mask and every chain is measured, and the plan's time compared with the quickest that keeps
to the budget in 95 % of frames. At 1 um, plans are compared with everything exact: whole frame, float64.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adof_cl.device import Device
from adof_cl.errors import BudgetError
from adof_cl.optics import Mask
from adof_cl.pace import ReferenceChain
from adof_cl.pipeline import Blur, CameraPipeline, WindowedPipeline
from adof_cl.planner import Choice, Plan, Planner
from adof_cl.profile import Chain, DeviceProfile
from adof_cl.scene import Scene, SceneObject
from adof_cl.specimen import PARTS, Exposure, Specimen
from adof_cl.tracking import TrackingLimits, extent_px
from adof_cl.tradeoff import NSR, Sweep, chain_times, default_scene, nominal_noise_grey, off_px
from adof_cl.turns import Rounds, Spread, take_turns

Array = NDArray[np.float64]

FIRST_SEED = 1000  # profiles are made with the first few
LIMITS = TrackingLimits(mismatch=0.7)
FRAMES = 8
DRIFTS = 5
JUDGED = 40
KEPT = 0.95
_ASIDE_UM = 4.0  # half a pixel and more


@dataclass
class Drawn:
    """One random scene, and the specimen that shows it."""

    specimen: Specimen
    scene: Scene
    hole_um: tuple[float, float]
    peg_um: tuple[float, float]


def draw(device: Device, number: int, cache: dict[int, Specimen], *, depth: bool = True) -> Drawn:
    """Draw scene `number`: depths, how well they are known, noise, places, accuracies, speeds."""
    rng = np.random.default_rng([number, FIRST_SEED])
    group = number // 5
    if group not in cache:
        drawn = np.random.default_rng([group, FIRST_SEED + 1])
        cache.clear()
        cache[group] = Specimen(
            device,
            FIRST_SEED + group,
            offset_um=(float(drawn.uniform(90, 190)), float(-drawn.uniform(80, 160))),
            turn_rad=float(drawn.uniform(-0.05, 0.05)),
            noise=float(drawn.uniform(0.6, 1.8)),
        )
        for part in PARTS:
            cache[group].templates(part, 20)
            cache[group].templates(part, 20, camera=2)
    specimen = cache[group]
    depth_um = float(np.exp(rng.uniform(np.log(60), np.log(4000))))
    hole_um, peg_um = (tuple(rng.uniform(-33, 33, 2).tolist()) for _ in range(2))
    specimen.place(depth_um, hole_um, peg_um)
    features = int(rng.integers(1, 3))
    objects = []
    for part in PARTS:
        corners = specimen.expose(Mask(), noise=False).corners_px[part]
        templates = specimen.templates(part, 20, features=features)
        wants_depth = depth and rng.random() < 0.4
        objects.append(
            SceneObject(
                part,
                specimen.depth_um(part),
                depth_sigma_um=float(rng.choice([0.0, rng.uniform(0, 15)])),
                extent_px=extent_px(templates, corners[:features]),
                features=features,
                place_sigma_px=float(rng.uniform(0.3, 2.0)),
                speed_um_per_s=float(rng.choice([0.0, rng.uniform(50, 800)])),
                accuracy_um={"dock": float(np.exp(rng.uniform(np.log(0.8), np.log(15))))},
                depth_accuracy_um={"dock": float(np.exp(rng.uniform(np.log(4), np.log(200))))}
                if wants_depth
                else {},
            )
        )
    scene = Scene(
        tuple(objects),
        noise_grey=nominal_noise_grey(specimen),
        mask_2=specimen.design.mask_2,
        tilt_deg=math.degrees(specimen.design.tilt_rad),
    )
    return Drawn(specimen, scene, hole_um, peg_um)


def taught(device: Device, drawn: Drawn, windows: Mapping[str, object], camera: int) -> WindowedPipeline:
    """Build the pipeline of a plan, with the specimen's templates."""
    specimen = drawn.specimen
    made = WindowedPipeline(device, specimen.optics, specimen.shape, windows, nsr=NSR)
    for thing in drawn.scene.objects:
        if thing.name in made.parts:
            templates = specimen.templates(thing.name, 20, camera=camera, features=thing.features)
            made.set_templates(thing.name, templates, LIMITS)
    return made


def misjudged(drawn: Drawn, rng: np.random.Generator) -> dict[str, float]:
    """Draw by how much each depth is misjudged, as the scene says."""
    return {thing.name: float(rng.normal(0, thing.depth_sigma_um)) for thing in drawn.scene.objects}


def expected(drawn: Drawn, exposure: Exposure, rng: np.random.Generator) -> dict[str, Array]:
    """Draw where features are expected, as the scene says."""
    return {
        thing.name: exposure.corners_px[thing.name][: thing.features]
        + np.clip(rng.normal(0, thing.place_sigma_px, 2), -3 * thing.place_sigma_px, 3 * thing.place_sigma_px)
        for thing in drawn.scene.objects
    }


def found(measured: Sequence[object]) -> Array:
    return np.array([np.full(2, np.nan) if m.lost else m.feature_xy_px for m in measured])  # type: ignore[attr-defined]


def in_turns(run: Callable[[int], object], reference: Callable[[], object]) -> tuple[float, float]:
    """Time a drift of frames some times, the reference after each frame; return both per frame.

    Each frame's median counts, so that filters which are formed only now and then are in it and whatever
    disturbed one drift is not.
    """
    times = np.empty((DRIFTS, 2 * FRAMES, 2))
    for drift, step in np.ndindex(DRIFTS, 2 * FRAMES):
        begun = time.perf_counter()
        run(step)
        between = time.perf_counter()
        reference()
        times[drift, step] = between - begun, time.perf_counter() - between
    mine, its = np.median(times, axis=0).mean(axis=0)
    return float(mine), float(its)


def carry_out(
    device: Device, drawn: Drawn, plan: Plan, rng: np.random.Generator, reference: Callable[[], object]
) -> dict[str, object]:
    """Carry a plan out: the error of one frame over what was allowed, and the time of some."""
    specimen, scene = drawn.specimen, drawn.scene
    shape, pitch = specimen.shape, scene.optics.object_pitch_um
    first = taught(device, drawn, plan.windows(shape), 1)
    exposure = specimen.expose(plan.mask)
    off = misjudged(drawn, rng)
    plans = {thing.name: thing for thing in plan.objects}

    def blurs(step: int = 0) -> dict[str, Blur | None]:
        values: dict[str, Blur | None] = {}
        for thing in scene.objects:
            drift = step * thing.speed_um_per_s / scene.frame_rate_hz
            blur = specimen.blur(thing.name, plan.mask, depth_error_um=off[thing.name] + drift)
            values[thing.name] = None if plans[thing.name].chain.restoration == "none" else blur
        return values

    where = expected(drawn, exposure, rng)
    now = first(exposure.pixels, blurs(), where)
    excess, errors = 0.0, {}
    for thing in scene.objects:
        error_um = off_px(found(now[thing.name]), exposure.corners_px[thing.name]) * pitch
        errors[thing.name] = error_um
        excess = max(excess, error_um / plans[thing.name].wanted_um)

    steps = [blurs(step) for step in range(2 * FRAMES)]
    seconds, reference_s = in_turns(lambda step: first(exposure.pixels, steps[step], where), reference)

    depths = {}
    for name, window in plan.windows(shape, 2).items():
        second = taught(device, drawn, {name: window}, 2)
        other = specimen.expose(plan.mask, camera=2)
        there = {name: expected(drawn, other, rng)[name]}
        blur = {name: specimen.blur(name, plan.mask, camera=2, depth_error_um=off[name])}
        seen = found(second(other.pixels, blur, there)[name])
        thing = next(o for o in scene.objects if o.name == name)
        z = specimen.depth_seen_um(found(now[name]).mean(axis=0), seen.mean(axis=0))
        truth = float(specimen.rig.world.corners_um(name)[[0, 2]][: thing.features].mean(axis=0)[2])
        drift = (plans[name].every - 1) * abs(thing.speed_um_per_s) / scene.frame_rate_hz
        error = abs(z - truth) + drift if math.isfinite(z) else math.inf
        depths[name] = error
        excess = max(excess, error / plans[name].depth_wanted_um)
        more, its = in_turns(
            lambda _step, p=second, o=other, b=blur, t=there: p(o.pixels, b, t),  # type: ignore[misc]
            reference,
        )
        seconds += more * (reference_s / its) / plans[name].every
    return {
        "excess": excess,
        "errors_um": errors,
        "depths_um": depths,
        "time_s": seconds,
        "reference_s": reference_s,
    }


Shot = tuple[Exposure, dict[str, Array], dict[str, float]]
"""A frame, where features are expected in it, and by how much depths are misjudged."""


@dataclass
class Shots:
    """Frames of a scene through one mask, and what a loop would expect there; taken as asked for."""

    drawn: Drawn
    mask: Mask
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self._taken: list[Shot] = []

    def first(self, count: int) -> list[Shot]:
        """Return the first so many; parts stand elsewhere among the pixels each time, as in a run."""
        while len(self._taken) < count:
            aside = self.rng.uniform(-_ASIDE_UM, _ASIDE_UM, (2, 2))
            hole, peg = aside + np.array([self.drawn.hole_um, self.drawn.peg_um])
            depth_um = self.drawn.scene.objects[1].depth_um - self.drawn.scene.objects[0].depth_um
            self.drawn.specimen.place(depth_um, tuple(hole.tolist()), tuple(peg.tolist()))
            exposure = self.drawn.specimen.expose(self.mask)
            self._taken.append(
                (exposure, expected(self.drawn, exposure, self.rng), misjudged(self.drawn, self.rng))
            )
        return self._taken[:count]


def exhaust(
    device: Device, planner: Planner, drawn: Drawn, plan: Plan, rng: np.random.Generator
) -> dict[str, float]:
    """Measure every mask and chain of a scene; return how the plan's time compares with the best one's.

    The best is the quickest that keeps to the budget in 95 % of `JUDGED` frames, object by object. It and the
    plan are then timed anew, in turns: the least of many medians is partly luck.
    """
    specimen, scene = drawn.specimen, drawn.scene
    shape, pitch = specimen.shape, scene.optics.object_pitch_um
    wanted = {thing.name: thing.wanted_um for thing in plan.objects}
    chains: dict[tuple[str, Chain], WindowedPipeline] = {}
    masks = list(planner.masks(scene))
    shots = {mask: Shots(drawn, mask, rng) for mask in masks}
    choices: dict[tuple[Mask, str], list[Choice]] = {
        (mask, o.name): planner.choices(scene, mask, o, wanted[o.name])
        for mask in masks
        for o in scene.objects
    }

    def seen(name: str, chain: Chain, mask: Mask, shot: Shot) -> Callable[[], Array]:
        exposure, where, off = shot
        pipeline = chains[name, chain]
        blur = specimen.blur(name, mask, depth_error_um=off[name])
        values = {name: None if chain.restoration == "none" else blur}
        return lambda: found(pipeline(exposure.pixels, values, {name: where[name]})[name])

    def kept(name: str, chain: Chain, mask: Mask, frames: int) -> float:
        """Return the share of frames in which an object's features are within what is wanted."""
        within = [
            off_px(seen(name, chain, mask, shot)(), shot[0].corners_px[name]) * pitch <= wanted[name]
            for shot in shots[mask].first(frames)
        ]
        return float(np.mean(within))

    runs: dict[tuple[str, Chain], Callable[[], Array]] = {}
    for (mask, name), given in choices.items():
        for choice in given:
            key = (name, choice.chain)
            if key not in chains:
                chains[key] = taught(device, drawn, {name: choice.chain.window(shape)}, 1)
                runs[key] = seen(name, choice.chain, mask, shots[mask].first(1)[0])
    keys = list(runs)
    times = take_turns([runs[key] for key in keys], Rounds(9, 15, 3.0))
    took = {key: Spread.of(t).median for key, t in zip(keys, times, strict=True)}

    mine = [(thing.name, thing.chain) for thing in plan.objects]
    best, least = mine, sum(took[key] for key in mine)
    for mask in masks:
        chosen: list[tuple[str, Chain]] = []
        for thing in scene.objects:
            ways = sorted({c.chain for c in choices[mask, thing.name]}, key=lambda c: took[thing.name, c])
            quickest = next(
                (
                    chain
                    for chain in ways
                    if sum(took[key] for key in chosen) + took[thing.name, chain] < least
                    and kept(thing.name, chain, mask, FRAMES) == 1
                    and kept(thing.name, chain, mask, JUDGED) >= KEPT
                ),
                None,
            )
            if quickest is None:
                break
            chosen.append((thing.name, quickest))
        else:
            best, least = chosen, sum(took[key] for key in chosen)
    if best == mine:
        return {"ratio": 1.0}
    again = take_turns([runs[key] for key in [*mine, *best]], Rounds(31, 61, 3.0))
    rounds = [sum(now[: len(mine)]) / sum(now[len(mine) :]) for now in zip(*again, strict=True)]
    return {"ratio": max(float(np.median(rounds)), 1.0)}


def exactly(
    specimen: Specimen, mask: Mask, pipelines: Sequence[CameraPipeline], shots: Sequence[Exposure]
) -> Callable[[], None]:
    """Return what follows every part in both cameras' whole frames, every filter formed anew each time."""
    turn = itertools.cycle((0.0, 0.1))

    def run() -> None:
        aside = next(turn)
        for camera, (pipeline, shot) in enumerate(zip(pipelines, shots, strict=True), start=1):
            blurs = {part: specimen.blur(part, mask, camera=camera) for part in PARTS}
            moved = {p: Blur(b.alpha_rad, b.psi_rad + aside) for p, b in blurs.items()}
            pipeline(shot.pixels, moved, shot.corners_px)

    return run


def against_exact(device: Device, planner: Planner, depths_um: Sequence[float]) -> list[dict[str, float]]:
    """Time plans at 1 um beside everything exact, whole frame, float64, both cameras, in turns."""
    results = []
    specimen = Specimen(device, FIRST_SEED + 500)
    for depth_um in depths_um:
        specimen.place(depth_um)
        objects = []
        for part in PARTS:
            corners = specimen.expose(Mask(), noise=False).corners_px[part]
            extent = extent_px(specimen.templates(part, 20), corners)
            objects.append(SceneObject(part, specimen.depth_um(part), extent_px=extent))
        scene = Scene(tuple(objects), noise_grey=nominal_noise_grey(specimen), mask_2=specimen.design.mask_2)
        drawn = Drawn(specimen, scene, (0, 0), (0, 0))
        try:
            plan = planner.plan(scene, max_error_um=1.0)
        except BudgetError:
            results.append({"depth_um": depth_um, "ratio": math.nan})
            continue
        mine = taught(device, drawn, plan.windows(specimen.shape), 1)
        shots = [specimen.expose(plan.mask, camera=n) for n in (1, 2)]
        plain = all(thing.chain.restoration == "none" for thing in plan.objects)
        own = {part: specimen.blur(part, plan.mask) for part in PARTS}
        mine_blurs = dict.fromkeys(PARTS) if plain else own
        exact = []
        for camera in (1, 2):
            made = CameraPipeline(
                device, specimen.optics, specimen.shape, PARTS, nsr=NSR, precision="float64"
            )
            for part in PARTS:
                made.set_templates(part, specimen.templates(part, 20, camera=camera), LIMITS)
            exact.append(made)
        everything = exactly(specimen, plan.mask, exact, shots)
        times = take_turns(
            [partial(mine, shots[0].pixels, mine_blurs, shots[0].corners_px), everything], Rounds(11, 31, 4.0)
        )
        ratio = Spread.of([b / a for a, b in zip(*times, strict=True)])
        results.append(
            {"depth_um": depth_um, "ratio": ratio.median, "plan_ms": 1e3 * Spread.of(times[0]).median}
        )
    return results


def check(
    device: Device, planner: Planner, scenes: range, searched: int, tell: bool = False
) -> dict[str, object]:
    """Plan and measure scenes; return the figures."""
    cache: dict[int, Specimen] = {}
    rows, refused, regrets = [], [], []
    reference = ReferenceChain(device, planner.profile.nsr)
    for number in scenes:
        drawn = draw(device, number, cache)
        rng = np.random.default_rng([number, 7])
        try:
            plan = planner.plan(drawn.scene)
        except BudgetError as refusal:
            refused.append({"scene": number, "why": str(refusal)})
            continue
        row = {"scene": number, "predicted_s": plan.time_s, "predicted_excess": plan.excess}
        rows.append({**row, **carry_out(device, drawn, plan, rng, reference)})
        if len(regrets) < searched:
            bare = replace(
                drawn.scene,
                objects=tuple(
                    replace(o, depth_accuracy_um={}, speed_um_per_s=0.0) for o in drawn.scene.objects
                ),
            )
            alone = Drawn(drawn.specimen, bare, drawn.hole_um, drawn.peg_um)
            searched_for = exhaust(device, planner, alone, planner.plan(bare), rng)
            regrets.append({"scene": number, **searched_for})
        if tell and number % 50 == 0:
            print(f"scene {number}", file=sys.stderr, flush=True)
    raw = [float(r["time_s"]) / float(r["predicted_s"]) for r in rows]  # type: ignore[arg-type]
    paces = [float(r["reference_s"]) / planner.profile.reference_s for r in rows]  # type: ignore[arg-type]
    off = [abs(r / pace - 1) for r, pace in zip(raw, paces, strict=True)]
    ratios = [r["ratio"] for r in regrets]
    return {
        "planned": len(rows),
        "refused": len(refused),
        "kept": float(np.mean([float(r["excess"]) <= 1 for r in rows])),  # type: ignore[arg-type]
        "time_off_median": float(np.median(off)),
        "time_off_95": float(np.quantile(off, 0.95)),
        "time_within_quarter": float(np.mean(np.array(off) <= 0.25)),
        "pace_median": float(np.median(paces)),
        "pace_range": [float(min(paces)), float(max(paces))],
        "time_within_quarter_without_pace": float(np.mean(np.abs(np.array(raw) - 1) <= 0.25)),
        "regret_median": float(np.median(ratios)) - 1 if ratios else None,
        "regret_worst": float(max(ratios)) - 1 if ratios else None,
        "regret_within_tenth": float(np.mean(np.array(ratios) <= 1.1)) if ratios else None,
        "rows": rows,
        "refusals": refused,
        "regrets": regrets,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--profile", type=Path)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--searched", type=int, default=24)
    parser.add_argument(
        "--retime", action="store_true", help="measure the profile's times anew, and keep them"
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--device")
    arguments = parser.parse_args()
    device = Device.open(arguments.device)
    facts = device.facts.as_dict()
    profile = DeviceProfile.read(arguments.profile) if arguments.profile else DeviceProfile.of_device(facts)
    if arguments.retime:
        sweep = Sweep(device, default_scene(), range(2))
        times, forms, shared_s = chain_times(sweep, Rounds(15, 41, 20.0))
        profile = replace(profile, times=times, forms=forms, shared_s=shared_s)
        if arguments.profile:
            arguments.profile.write_text(profile.to_json())
    planner = Planner(profile)
    scenes = range(arguments.first, arguments.first + arguments.scenes)
    figures = check(device, planner, scenes, arguments.searched, tell=True)
    figures["against_exact"] = against_exact(device, planner, (80.0, 150.0, 250.0, 400.0, 700.0, 1000.0))
    figures["device"] = str(device.facts)
    for name, value in figures.items():
        if name not in ("rows", "refusals", "regrets"):
            print(f"{name}: {value}")
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
