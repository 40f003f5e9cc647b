"""Laws of error bars: as often inside as they say, over specimens, depths, masks, parts and cameras."""

from __future__ import annotations

import json
import math
import runpy
from pathlib import Path

import pytest

from adof_cl.device import Device
from adof_cl.loop import Options

TREE = Path(__file__).parents[1]
SLACK = 0.02
"""How far from 95 % the share of truths inside may lie."""


def test_the_truth_lies_in_95_of_100_bars_of_features_and_of_depths(device: Device) -> None:
    script = runpy.run_path(str(TREE / "benchmarks" / "error_bars.py"))
    rows = script["draw"](device, range(100, 112), 60, Options().nsr)
    groups = script["groups"](rows)
    for name in ("features, all", "depths, all"):
        share, _, count = script["share_inside"](groups[name])
        # Features of a frame share its filter and its neighbours' leaks: as good as half as many are free.
        scatter = math.sqrt(0.95 * 0.05 / (count / 2))
        assert count >= 0.95 * len(groups[name])
        assert abs(share - 0.95) <= SLACK + 3 * scatter, (name, share)


@pytest.mark.parametrize("name", ["features, all", "depths, all"])
def test_the_bars_that_were_counted_over_2000_draws_hold(name: str) -> None:
    counted = json.loads((TREE / "benchmarks" / "error_bars.json").read_text())[name]
    assert counted["count"] >= 1900 * (8 if name.startswith("features") else 1)
    assert abs(counted["inside"] - 0.95) <= SLACK + counted["scatter"]
