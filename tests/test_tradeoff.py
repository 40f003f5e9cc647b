"""Laws of the sweep: errors are distances from the truth, times are in turns, verdicts follow the figures."""

from __future__ import annotations

import itertools
import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from adof_cl import reference, tradeoff
from adof_cl.cli import main
from adof_cl.cli.labels import label_points
from adof_cl.device import Device
from adof_cl.errors import InputError
from adof_cl.loop import HOLE, PEG
from adof_cl.profile import DeviceProfile, Reading, kept_at
from adof_cl.scene import Scene, SceneObject
from adof_cl.specimen import Specimen
from adof_cl.tracking import extent_px
from adof_cl.turns import Spread


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


@cache
def specimen(device: Device) -> Specimen:
    return Specimen(device, 3)


def reading(knob: str, setting: str, ms: float, um: float, depth_um: float | None = None) -> Reading:
    spread = Spread(ms / 1e3, 0.99 * ms / 1e3, 1.01 * ms / 1e3, 11)
    return Reading("search", knob, setting, spread, True, um / 7.4, um, depth_um)


def test_a_specimen_moves_by_fractions_of_a_pixel_and_says_where_its_corners_are(device: Device) -> None:
    made = specimen(device)
    made.place(1500.0)
    mask = tradeoff.joint_mask(made.optics, 1500.0)
    before = made.expose(mask).corners_px
    made.place(1500.0, hole_um=(30.0, 0.0), peg_um=(0.0, -20.0))
    after = made.expose(mask).corners_px
    np.testing.assert_allclose(after[HOLE] - before[HOLE], [[30 / 7.4, 0]] * 2, atol=0.01)
    np.testing.assert_allclose(after[PEG] - before[PEG], [[0, -20 / 7.4]] * 2, atol=0.01)
    assert made.depth_um(HOLE) == pytest.approx(1500.0, abs=0.1)


def test_a_specimens_noise_is_the_scenes(device: Device) -> None:
    noisy = Specimen(device, 3, noise=2.0)
    assert tradeoff.nominal_noise_grey(noisy) == pytest.approx(
        2 * tradeoff.nominal_noise_grey(specimen(device)), rel=1e-6
    )
    frames = [noisy.expose(tradeoff.joint_mask(noisy.optics, 1000.0)).pixels.astype(float) for _ in range(2)]
    # Two frames differ by the noise alone, sqrt(2) of it, a little less where the picture is darker.
    bright = frames[0] > 0.5 * frames[0].max()
    seen = float(np.std((frames[1] - frames[0])[bright])) / math.sqrt(2)
    assert seen == pytest.approx(tradeoff.nominal_noise_grey(noisy), rel=0.15)


def test_depth_from_both_cameras_true_features_is_the_true_depth(device: Device) -> None:
    made = specimen(device)
    made.place(2200.0)
    mask = tradeoff.joint_mask(made.optics, 2200.0)
    first, second = (made.expose(mask, camera=n).corners_px[HOLE].mean(axis=0) for n in (1, 2))
    assert made.depth_seen_um(first, second) == pytest.approx(2200.0, abs=0.1)


def test_the_window_of_a_part_holds_its_templates(device: Device) -> None:
    made = specimen(device)
    corners = made.expose(tradeoff.joint_mask(made.optics, 2200.0)).corners_px
    # The peg is 61 x 54 px with templates 12 px inside its corners, the hole 88 x 68 with them 8 px outside.
    assert extent_px(made.templates(PEG, 20), corners[PEG]) == pytest.approx(61 - 24, abs=2)
    assert extent_px(made.templates(HOLE, 20), corners[HOLE]) == pytest.approx(88 + 16, abs=3)


def test_enough_nodes_and_small_steps_reach_the_exact_transfer_and_few_do_not() -> None:
    u = np.linspace(-1.9, 1.9, 201)

    def off(values: object, alpha: float = 20.0, psi: float = 15.0) -> float:
        return float(np.abs(np.asarray(values) - reference.otf_1d(u, alpha, psi)).max())

    assert off(tradeoff.quadrature_otf(u, 20.0, 15.0, 256)) < 1e-12
    assert off(tradeoff.quadrature_otf(u, 20.0, 15.0, 8)) > 1e-2
    # A line between two values a step apart errs by step^2/8 of the second derivative: of H less than 1, the
    # mean over the overlap of (2 u x)^2 for psi and of (3 u x^2 + u^3/4)^2 for alpha.
    for step in (0.5, 0.25):
        assert off(tradeoff.InterpolatedOtf(u, 0.0, step)(20.0, 15.1), psi=15.1) < step**2 / 8
        assert off(tradeoff.InterpolatedOtf(u, step, 0.0)(20.1, 15.0), alpha=20.1) < step**2 / 8
    assert off(tradeoff.InterpolatedOtf(u, 0.0, 0.5)(20.0, 15.0)) < 1e-12
    assert off(tradeoff.InterpolatedOtf(u, 0.0, 8.0)(20.0, 12.0), psi=12.0) > 1e-2


def test_the_front_holds_what_nothing_beats_and_nothing_else() -> None:
    a, b = reading("k", "a", 1, 5), reading("k", "b", 2, 3)
    beaten, lost = reading("k", "c", 2.5, 4), reading("k", "d", 0.5, math.inf)
    untold = reading("k", "e", 3, 2.8)  # no frames tell it from b
    assert tradeoff.pareto([beaten, b, lost, a, untold]) == [a, b]


def test_a_knob_pays_when_less_accuracy_saves_a_tenth_and_not_otherwise() -> None:
    pays = [reading("refinement", "fine", 2.0, 1.0), reading("refinement", "rough", 1.2, 4.0)]
    same = [reading("window", "small", 2.0, 1.0), reading("window", "large", 2.5, 1.02)]
    dear = [reading("filter", "own", 2.0, 1.0), reading("filter", "one", 1.95, 30.0)]
    late = [reading("stereo", "1", 4.0, 1.0, 2.0), reading("stereo", "4", 2.5, 1.0, 30.0)]
    gone = [reading("pyramid", "coarse", 1.0, math.inf)]
    found = {v.knob: v for v in tradeoff.verdicts([*pays, *same, *dear, *late, *gone])}
    assert {knob: v.worth for knob, v in found.items()} == {
        "refinement": True, "window": False, "filter": False, "stereo": True, "pyramid": False,
    }  # fmt: skip
    assert "40 % of the chain" in found["refinement"].sentence
    assert "leave it at small" in found["window"].sentence
    assert "as accurate as large (2.5 ms, 1 um) and 20 % of the chain quicker" in found["window"].sentence
    assert "as accurate" not in found["filter"].sentence
    assert "no setting follows" in found["pyramid"].sentence


def test_the_scene_of_a_file_is_the_scene_that_wrote_it(tmp_path: Path) -> None:
    scene = tradeoff.default_scene()
    path = tmp_path / "scene.json"
    path.write_text(scene.to_json())
    assert Scene.read(path) == scene


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{"objects": []}', "the scene holds no object"),
        ('{"objects": [{"name": "a", "depth_um": 1, "depht_sigma_um": 1}]}', "objects.0.depht_sigma_um"),
        ('{"objects": [{"name": "a", "depth_um": NaN}]}', "depth_um"),
        ('{"objects": [{"name": "a", "depth_um": 1, "accuracy_um": {"dock": -1}}]}', "accuracy of 'a'"),
        ('{"objects": [{"name": "a", "depth_um": 1}, {"name": "a", "depth_um": 2}]}', "its own name"),
        ("peg", "no scene"),
    ],
)
def test_what_is_no_scene_is_refused_by_name(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "scene.json"
    path.write_text(text)
    with pytest.raises(InputError, match=sentence):
        Scene.read(path)


def test_a_scene_refuses_what_no_scene_has() -> None:
    with pytest.raises(InputError, match="features of 'a'"):
        SceneObject("a", 1.0, features=0)
    with pytest.raises(InputError, match="depth_sigma_um of 'a'"):
        SceneObject("a", 1.0, depth_sigma_um=-1.0)
    with pytest.raises(InputError, match="tilt_deg"):
        Scene((SceneObject("a", 1.0),), tilt_deg=0.1)
    with pytest.raises(InputError, match="shape"):
        Scene((SceneObject("a", 1.0),), shape=(40, 40))


def test_a_quick_sweep_measures_every_stage_writes_a_profile_and_draws_it(
    device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, plots, table = tmp_path / "p.json", tmp_path / "plots", tmp_path / "table.md"
    arguments = ("--quick", "--json", path, "--plots", plots, "--table", table)
    arguments = (*arguments, "--device", device.facts.index)
    assert run("tradeoff", *arguments) == 0
    profile = DeviceProfile.read(path)
    said = capsys.readouterr()
    assert {r.stage for r in profile.readings} == set(tradeoff.STAGES)
    assert all(r.time_s.low > 0 and r.error_um > 0 for r in profile.readings)
    assert all(r.setting in said.out for r in profile.readings)
    written = table.read_text().splitlines()
    assert all(any(f"| {r.setting} |" in line for line in written) for r in profile.readings)
    assert profile.fits(device.facts.as_dict())
    assert not profile.fits({**device.facts.as_dict(), "driver_version": "another"})
    assert "timing in turns" in said.err
    assert {p.name for p in plots.iterdir()} == {f"{s}.png" for s in (*tradeoff.STAGES, "combined")}
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in plots.iterdir())

    # What physics promises, whatever the device: Eq. (2) misses, one filter for two depths displaces by the
    # predicted shift, and half storage is no worse in place than the noise.
    by = {(r.knob, r.setting): r for r in profile.readings}
    own = by["filter", "own depth each"].error_px
    assert by["transfer", "Eq. (2) as printed"].error_px > 5 * own
    optics = tradeoff.default_scene().optics
    mask = tradeoff.joint_mask(optics, 2000.0)
    shift = math.sqrt(2) * optics.shift_px(mask.alpha_rad, mask.psi_rad(optics, 2000.0))
    assert by["filter", "one, in focus (the paper's)"].error_px == pytest.approx(shift, rel=0.2)
    assert by["precision", "half"].error_px < 1.5 * own
    assert by["filter", "none"].error_px == math.inf
    # Old files and others are refused.
    values = json.loads(path.read_text())
    path.write_text(json.dumps({**values, "schema_version": 0}))
    with pytest.raises(InputError, match="schema version 0"):
        DeviceProfile.read(path)
    path.write_text("{}")
    with pytest.raises(InputError, match="not a device profile"):
        DeviceProfile.read(path)


@pytest.mark.parametrize("crowd", [1.0, 0.1, 0.001])
def test_names_of_points_never_lie_over_each_other_nor_outside(crowd: float) -> None:
    rng = np.random.default_rng(4)
    figure = Figure(figsize=(5.0, 3.5))
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(xscale="log", yscale="log", xlim=(0.005, 200.0), ylim=(0.005, 200.0))
    points = [tuple(np.exp(crowd * rng.normal(0.0, 3.0, 2)).clip(0.01, 100).tolist()) for _ in range(25)]
    label_points(axes, points, ["mW i" * int(rng.integers(1, 6)) for _ in points])
    figure.draw_without_rendering()
    boxes = [Text.get_window_extent(text) for text in axes.texts]  # without lines
    frame = axes.get_window_extent()
    assert all(not a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in boxes)
    assert len(boxes) >= 10


def test_a_profile_that_was_never_made_is_asked_for(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ADOF_CACHE_DIR", str(tmp_path))
    facts = device.facts.as_dict()
    assert kept_at(facts) != kept_at({**facts, "driver_version": "another"})
    with pytest.raises(InputError, match="run adof tradeoff once"):
        DeviceProfile.of_device(facts)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--json", "no/p.json"), "no such folder"),
        (("--plots", "no/plots"), "no such folder"),
        (("--scene", "nowhere.json"), "nowhere.json cannot be read"),
        (("--device", "abacus"), "no OpenCL device fits 'abacus'"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_measured(
    arguments: tuple[str, ...], sentence: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert run("tradeoff", *arguments) == 2
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
