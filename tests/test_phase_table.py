from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_cl.slm_encode import stroke_table
from adof_drivers.errors import DriverError
from adof_drivers.phase_table import code_table, read_correction_rad, read_phase_csv

TURN = 2 * math.pi


@given(st.floats(math.pi, 3 * TURN), st.floats(0.4, 2.5), st.floats(-50, 50), st.sampled_from([-1, 1]))
def test_every_code_shows_the_phase_wanted_to_half_the_panels_steps(
    stroke_rad: float, gamma: float, offset_rad: float, way: int
) -> None:
    phase = offset_rad + way * stroke_rad * (np.arange(256) / 255) ** gamma
    shown = phase[code_table(phase)] - phase[0]
    off = shown - np.arange(256) * TURN / 256
    off = np.abs(off - TURN * np.rint(off / TURN))
    # Within reach: half the widest step. Beyond a stroke of less than a turn: half of what is missing.
    bound = max(np.abs(np.diff(phase)).max() / 2, (TURN - stroke_rad) / 2)
    assert off.max() <= bound + 1e-9


@given(st.floats(0.9 * TURN, 1.5 * TURN))
def test_a_straight_measurement_gives_phases_as_near_as_the_linear_table(stroke_rad: float) -> None:
    phase = stroke_rad * np.arange(256) / 255
    wanted = np.arange(256) * TURN / 256
    ours, linear = (
        np.abs((d := phase[table] - wanted) - TURN * np.rint(d / TURN))
        for table in (code_table(phase), stroke_table(stroke_rad))
    )
    assert (ours <= linear + 1e-9).all()


@pytest.mark.parametrize(
    ("phase", "said"),
    [
        (np.zeros(255), "256 finite numbers"),
        (np.full(256, np.nan), "256 finite numbers"),
        (np.sin(np.arange(256.0)), "up and down"),
        (np.zeros(256), "up and down"),
    ],
)
def test_a_measurement_that_is_no_curve_is_refused(phase: np.ndarray, said: str) -> None:
    with pytest.raises(DriverError, match=said):
        code_table(phase)


def test_a_measurement_is_read_from_csv_and_a_broken_one_refused(tmp_path: Path) -> None:
    path = tmp_path / "phase.csv"
    lines = [f"{code},{code / 40}" for code in range(256)]
    for text in ("\n".join(["code,phase_rad", *lines]), "\n".join(reversed(lines))):
        path.write_text(text, encoding="utf-8")
        assert read_phase_csv(path) == pytest.approx(np.arange(256) / 40)
    for broken, said in (
        (lines[:-1], "lacks 1 codes"),
        ([*lines, "3,1.0"], "wanted once"),
        ([*lines, "256,1.0"], "wanted once"),
        ([*lines[:-1], "255,nan"], "wanted once"),
        ([*lines, "many words"], "is not"),
    ):
        path.write_text("\n".join(broken), encoding="utf-8")
        with pytest.raises(DriverError, match=said):
            read_phase_csv(path)
    with pytest.raises(DriverError, match="cannot be read"):
        read_phase_csv(tmp_path / "none.csv")


def test_the_correction_of_the_wavelength_in_use_is_read_grey_for_grey(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    greys = {nm: rng.integers(0, 256, (6, 9), dtype=np.uint8) for nm in (532.0, 633.0)}
    paths = {}
    for nm, grey in greys.items():
        paths[nm] = tmp_path / f"{nm:g}.bmp"
        assert cv2.imwrite(str(paths[nm]), grey if nm == 532.0 else cv2.merge([grey] * 3))
    for nm, made_for in ((532.0, 532.0), (530.0, 532.0), (635.0, 633.0)):
        correction = read_correction_rad(paths, nm, (6, 9))
        assert np.array_equal(correction, greys[made_for] * (TURN / 256))


def test_a_correction_of_another_wavelength_size_or_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.bmp"
    assert cv2.imwrite(str(path), np.zeros((6, 9), np.uint8))
    for pictures, nm, shape, said in (
        ({532.0: path}, 550.0, (6, 9), "no correction for 550 nm"),
        ({}, 550.0, (6, 9), "there are: none"),
        ({532.0: path}, 532.0, (9, 6), "was wanted"),
        ({532.0: path}, -1.0, (6, 9), "wavelength"),
        ({532.0: tmp_path / "none.bmp"}, 532.0, (6, 9), "not a readable"),
    ):
        with pytest.raises(DriverError, match=said):
            read_correction_rad(pictures, nm, shape)
    colours = np.zeros((6, 9, 3), np.uint8)
    colours[..., 1] = 7
    assert cv2.imwrite(str(path), colours)
    with pytest.raises(DriverError, match="colours"):
        read_correction_rad({532.0: path}, 532.0, (6, 9))
