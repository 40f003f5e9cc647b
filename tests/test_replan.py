"""Laws of plans made anew: far is cheap, near is precise, and nothing is made on the device on the way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from adof_cl.cli import main
from adof_cl.device import Device
from adof_cl.errors import InputError
from adof_cl.optics import Mask, OpticalSystem
from adof_cl.pipeline import Window, WindowedPipeline
from adof_cl.planner import Planner
from adof_cl.profile import DeviceProfile
from adof_cl.program import Program
from adof_cl.replan import Budget, Replanner
from assemblies import Rehearsal

OPTICS = OpticalSystem()
PROFILE = Path(__file__).parents[1] / "benchmarks" / "profiles" / "pocl.json"
EXTENT = {"peg": 40.0, "hole": 104.0}


def replanner(device: Device, **budget: float) -> Replanner:
    planner = Planner(DeviceProfile.read(PROFILE))
    return Replanner(
        device, OPTICS, (400, 512), ("peg", "hole"), Budget(planner, **budget), frame_rate_hz=60.0
    )


@pytest.fixture(scope="module")
def two_um(device: Device) -> Replanner:
    return replanner(device, max_error_um=2.0)


def test_far_is_cheap_and_near_is_precise(two_um: Replanner) -> None:
    def planned(depth_um: float) -> tuple[float, float, float]:
        scene = two_um.scene({"peg": 0.0, "hole": depth_um}, EXTENT, 0.0)
        plan = two_um.plan(scene, depth_um)
        assert plan is not None
        return plan.time_s, plan.error_um, plan.mask.alpha_rad

    far, near = planned(3500.0), planned(150.0)
    assert near[1] <= 2.0 < far[1] <= 35.0
    assert near[2] == 0  # nothing left to code for
    assert far[2] > 0


def test_a_plan_stands_until_depths_or_the_mask_change(two_um: Replanner) -> None:
    def planned(depth_um: float, mask: Mask | None = None) -> object:
        return two_um.plan(two_um.scene({"peg": 0.0, "hole": depth_um}, EXTENT, 0.0), depth_um, mask)

    first = planned(2000.0)
    assert planned(2015.0) is first
    assert planned(1900.0) is not first
    coded = planned(1900.0, Mask(40.0, -32.0))
    assert planned(1900.0, Mask(40.0, -32.0)) is coded
    assert planned(1900.0, Mask(30.0, -32.0)) is not coded


def test_switching_plans_makes_no_buffer_and_compiles_nothing(
    two_um: Replanner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_arguments: object, **_options: object) -> None:
        raise AssertionError("made on the way")

    scenes = [two_um.scene({"peg": 0.0, "hole": d}, EXTENT, 0.0) for d in (3800.0, 2000.0, 900.0, 150.0)]
    with monkeypatch.context() as patch:
        for name in ("empty", "upload", "shared"):
            patch.setattr(Device, name, refused)
        patch.setattr(Program, "__init__", refused)
        plans = [two_um.plan(scene, scene.objects[1].depth_um) for scene in scenes]
        for plan in (*plans, None):
            two_um.choose(plan)
    assert len({id(plan) for plan in plans}) == len(scenes)


def test_a_part_that_no_plan_sees_is_followed_as_carefully_as_can_be(two_um: Replanner) -> None:
    scene = two_um.scene({"peg": 0.0, "hole": 3000.0}, EXTENT, 0.0)
    plan = two_um.plan(scene, 3000.0, Mask(0.0, 0.0))  # in focus on the peg: the hole is 100 rad out
    assert plan is None
    two_um.choose(plan)
    assert not two_um.unrestored


def test_a_window_that_was_not_made_is_refused_and_the_last_one_stands(device: Device) -> None:
    made = [Window((96, 96)), Window((128, 128))]
    pipeline = WindowedPipeline(device, OPTICS, (200, 200), {"a": made})
    pipeline.use("a", Window((128, 128), refine="integer", tolerance_rad=0.3))
    inside = pipeline._pipelines["a"]
    assert inside.shape == (128, 128)
    assert inside.tolerance_rad == 0.3
    with pytest.raises(InputError, match="state it when the pipeline is made"):
        pipeline.use("a", Window((160, 160)))
    with pytest.raises(InputError, match="refine is 'guess'"):
        pipeline.use("a", Window((96, 96), refine="guess"))
    with pytest.raises(InputError, match="follows a"):
        pipeline.use("b", Window((96, 96)))
    assert pipeline._pipelines["a"] is inside


def test_a_budget_is_one_of_two() -> None:
    planner = Planner(DeviceProfile.read(PROFILE))
    for wrong in ({}, {"max_error_um": 1.0, "max_ms": 1.0}):
        with pytest.raises(InputError, match="give one"):
            Budget(planner, **wrong)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--profile", "p.json"), "came without a budget"),
        (("--max-error-um", "0", "--profile", str(PROFILE)), "max_error_um is 0"),
        (("--max-ms", "2", "--max-error-um", "2", "--profile", str(PROFILE)), "give one"),
        (("--max-ms", "2", "--profile", "nowhere.json"), "nowhere.json cannot be read"),
    ],
)
def test_a_run_with_a_budget_that_cannot_be_is_refused_before_anything_is_written(
    arguments: tuple[str, ...], sentence: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["run", *arguments])
    assert ended.value.code == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_budgeted_loop_sees_as_planned_and_comes_as_near(device: Device) -> None:
    planner = Planner(DeviceProfile.read(PROFILE))
    made = Rehearsal.new(device, 3, Budget(planner, max_error_um=2.0))
    made.assembly.run()
    record = made.record
    assert record.docked
    error = made.truth._errors()
    # What is planned for each feature, and the mean of a part's two features is no worse.
    assert np.hypot(error["x"], error["y"]) <= 2.0
    eye = made.assembly.eyes[0]
    assert eye.replanner is not None
    assert eye.mask.alpha_rad == 0  # seated, both lie within what an unrestored search bears
    assert eye.replanner.unrestored == {"peg", "hole"}
