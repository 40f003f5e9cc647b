from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adof_cl.record import Iteration, Position, RunRecord, finite_json, write_metrics

REQUIRED = {
    "docked", "end_state", "final_error_um", "final_error_rad", "iterations", "compute_ms", "lost_features",
    "positions", "device", "seed",
}  # fmt: skip
REQUIRED_AT_A_POSITION = {
    "name", "depth_um", "depth_est_um", "alpha", "ssd_hole", "ssd_peg", "lateral_bias_um"
}  # fmt: skip


def iteration(number: int, *, lost: int = 0, compute_ms: float = 1.0, depth_um: float = 4000.0) -> Iteration:
    """One as a rig without a twin leaves it: truth unknown."""
    return Iteration(
        number=number, time_s=number / 60, stage="coarse", alpha_rad=30.0, focus_psi_rad=-50.0,
        depth_margin_um=40.0 - number, hole_sigma_px=0.04, peg_sigma_px=0.03,
        hole_depth_um=depth_um, hole_depth_sigma_um=1.0, error_x_um=1.0, error_y_um=-1.0,
        error_theta_rad=1e-3, error_z_um=100.0, velocity=(1.0, 2.0, 3.0, 0.0), ssd_hole=1.0, ssd_peg=2.0,
        epipolar_residual_px=math.inf, lost_features=lost, compute_ms=compute_ms,
    )  # fmt: skip


def position(name: str) -> Position:
    picture = np.full((4, 4), 7, dtype=np.uint8)
    return Position(
        name, 4000.0, 3999.0, 30.0, -50.0, 1.0, 2.0, (math.nan, math.nan), raw=picture, restored_hole=picture
    )


def strict(path: Path) -> Any:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def test_metrics_of_a_run_that_never_began_have_every_key_and_null_for_what_was_not_measured(
    tmp_path: Path,
) -> None:
    metrics = strict(write_metrics(RunRecord(3, "a device"), tmp_path))
    assert metrics.keys() >= REQUIRED
    assert metrics["final_error_um"] == {"x": None, "y": None, "z": None}
    assert metrics["compute_ms"] == {"p50": None, "p99": None}
    assert (metrics["docked"], metrics["iterations"], metrics["seed"]) == (False, 0, 3)
    assert strict(tmp_path / "iterations.json") == []


def test_what_is_not_finite_is_written_as_null_everywhere(tmp_path: Path) -> None:
    record = RunRecord(0, "a device", [iteration(0)], [position("A")])
    record.final_error = {"x": math.nan, "y": np.float64(-math.inf), "z": np.float32(2.5), "theta": math.inf}
    metrics = strict(write_metrics(record, tmp_path))
    assert metrics["final_error_um"] == {"x": None, "y": None, "z": 2.5}
    assert metrics["final_error_rad"] is None
    assert metrics["run_time_s"] is None
    assert metrics["positions"][0]["lateral_bias_um"] == [None, None]
    rows = strict(tmp_path / "iterations.json")
    assert rows[0]["epipolar_residual_px"] is None
    assert rows[0]["true_hole_xyz_um"] == [None, None, None]
    assert rows[0]["hole_depth_um"] == 4000.0


def test_a_position_in_the_metrics_has_its_numbers_and_no_pictures(tmp_path: Path) -> None:
    record = RunRecord(0, "a device", positions=[position("A"), position("B")])
    shown = strict(write_metrics(record, tmp_path))["positions"]
    assert [p["name"] for p in shown] == ["A", "B"]
    assert all(p.keys() >= REQUIRED_AT_A_POSITION for p in shown)
    assert all(not isinstance(value, list) or len(value) == 2 for p in shown for value in p.values())


def test_iterations_are_counted_their_lost_features_summed_and_their_times_ranked() -> None:
    times = [5.0, 1.0, 2.0, 4.0, 3.0]
    record = RunRecord(0, "", [iteration(k, lost=k, compute_ms=t) for k, t in enumerate(times)])
    metrics = record.metrics()
    assert metrics["iterations"] == len(times)
    assert metrics["lost_features"] == sum(range(len(times)))
    assert metrics["compute_ms"]["p50"] == 3.0
    assert 4.0 < metrics["compute_ms"]["p99"] <= 5.0


@pytest.mark.parametrize(
    ("value", "wanted"),
    [
        (np.float32(math.nan), None),
        (np.int64(3), 3),
        (np.bool_(True), True),
        ({1: (math.inf, "inf")}, {"1": [None, "inf"]}),
        (None, None),
        (True, True),
    ],
)
def test_every_value_becomes_one_that_json_can_say(value: object, wanted: object) -> None:
    found = finite_json(value)
    assert found == wanted
    assert type(found) is type(wanted)


def test_metrics_are_not_written_by_halves(tmp_path: Path) -> None:
    write_metrics(RunRecord(1, "a device"), tmp_path)
    before = (tmp_path / "metrics.json").read_text()
    broken = RunRecord(2, "a device")
    broken.notes = [object()]  # type: ignore[list-item]  # what no JSON can say
    with pytest.raises(TypeError):
        write_metrics(broken, tmp_path)
    assert (tmp_path / "metrics.json").read_text() == before
    assert {path.name for path in tmp_path.iterdir()} == {"metrics.json", "iterations.json"}
