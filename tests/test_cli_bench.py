"""The command `adof bench`: quick runs, files, refusals and exit codes."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from adof_cl import bench as timing
from adof_cl import reference
from adof_cl.bench_cases import OPERATIONS
from adof_cl.cli import main
from adof_cl.device import Device


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["bench", *map(str, arguments)])
    return int(ended.value.code or 0)


def test_a_quick_run_without_peers_times_every_operation_and_fails_nothing(
    device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "r.json"
    assert run("--quick", "--peers", "none", "--json", path, "--device", device.facts.index) == 0
    report = timing.Report.read(path)
    assert not report.failures
    assert {result.operation for result in report.results} == set(OPERATIONS)
    assert all(result.wall_s.low > 0 and result.per_s > 0 for result in report.results)
    assert all(result.error <= result.bound for result in report.results)
    assert report.device == device.facts.as_dict()
    assert report.version
    assert report.machine["python"]
    assert report.settings["peers"] == {}
    said = capsys.readouterr()
    assert all(result.name in said.out for result in report.results)
    assert "checking and timing" in said.err
    # The same file is what --compare takes.
    options = ("--ops", "image_prep", "--peers", "none", "--device", device.facts.index)
    assert run("--quick", *options, "--compare", path) == 0
    out = capsys.readouterr().out
    assert "moved by more than the noise" in out
    assert "only in the old run: restore uint8 128x96" in out


def test_ratios_are_drawn_and_written(device: Device, tmp_path: Path) -> None:
    plot, path = tmp_path / "ratios.png", tmp_path / "r.json"
    options = ("--ops", "restore", "--sizes", "128x96", "--peers", "scipy,opencv", "--json", path)
    assert run("--quick", *options, "--plot", plot, "--device", device.facts.index) == 0
    assert plot.read_bytes().startswith(b"\x89PNG")
    written = json.loads(path.read_text())
    ratios = {(r["form"], p["name"]) for r in written["results"] for p in r["peers"]}
    assert {("float32", "scipy"), ("float32", "opencv"), ("uint8", "own float32")} <= ratios
    assert written["settings"]["peers"].keys() == {"scipy", "opencv"}
    assert sorted(file.name for file in tmp_path.iterdir()) == ["r.json", "ratios.png"]


def test_a_wrong_result_is_said_and_exits_1_and_is_no_row(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = reference.image_prep
    monkeypatch.setattr(reference, "image_prep", lambda *a, **k: truth(*a, **k) + np.float64(0.01))
    path = tmp_path / "r.json"
    options = ("--ops", "image_prep,pupil_phase", "--peers", "none", "--json", path)
    assert run("--quick", *options, "--device", device.facts.index) == 1
    said = capsys.readouterr()
    assert "FAILED image_prep maps 128x96, adof-cl: wrong result" in said.err
    report = timing.Report.read(path)
    assert [result.operation for result in report.results] == ["pupil_phase"]
    assert [failure.who for failure in report.failures] == ["adof-cl"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--ops", "knitting"), "operation is 'knitting'"),
        (("--peers", "abacus"), "peer is 'abacus'"),
        (("--sizes", "12"), "size is '12'"),
        (("--ops", "psf", "--sizes", "300x200"), "psf cannot take 300x200"),
        (("--plot", "ratios.txt"), "the plot's name is 'ratios.txt'"),
        (("--compare", "nowhere.json"), "nowhere.json cannot be read"),
        (("--device", "abacus"), "no OpenCL device fits 'abacus'"),
        (("--peers", "none", "--ops", "image_prep", "--plot", "ratios.png"), "no ratio to draw"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence_before_anything_is_timed(
    arguments: tuple[str, ...],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("--quick", *arguments) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert said.startswith("adof: ")
    assert len(said.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_not_ours_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "r.json").write_text('{"schema_version": 1}')
    assert run("--quick", "--compare", tmp_path / "r.json") == 2
    assert "is not a results file: give one that adof bench" in capsys.readouterr().err


def test_a_place_that_cannot_be_written_is_refused_before_anything_is_timed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--quick", "--json", tmp_path / "no" / "r.json") == 2
    assert "no/r.json" in capsys.readouterr().err


def test_readme_holds_the_table_of_the_results_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    script = Path(__file__).parents[1] / "benchmarks" / "headline.py"
    monkeypatch.setattr("sys.argv", [str(script), "--check"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    assert ended.value.code == 0


def test_every_result_kept_is_right_and_says_where_it_was_measured() -> None:
    kept = sorted((Path(__file__).parents[1] / "benchmarks" / "results").glob("*.json"))
    assert kept
    for path in kept:
        report = timing.Report.read(path)
        assert not report.failures
        assert not report.settings["quick"]
        assert report.device["driver_version"]
        assert report.machine["load_at_start"]
