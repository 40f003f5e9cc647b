"""Laws of `adof run`: what it prints and leaves behind, what it refuses, and how it takes Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from adof_cl.cli import main
from adof_cl.device import Device
from adof_cl.record import finite_json
from assemblies import full_run
from test_record import REQUIRED, REQUIRED_AT_A_POSITION, strict
from test_report import FIGURES, outside

pytestmark = pytest.mark.timeout(600)

SEED = 3
ADOF = (sys.executable, "-c", "from adof_cl.cli import main; main()")
COMPLETE = FIGURES | {"metrics.json", "iterations.json", "report.html"}


def adof_run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["run", *map(str, arguments)])
    return int(ended.value.code or 0)


@pytest.fixture(scope="module")
def finished(device: Device, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, int]:
    """One whole run by the command: its folder, what it printed, its exit code."""
    folder = tmp_path_factory.mktemp("run") / "out"
    command = [*ADOF, "run", "--seed", SEED, "--out", folder, "--json", "--device",
               device.facts.index]  # fmt: skip
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    return folder, done.stdout, done.returncode


def test_the_printed_json_is_metrics_json_and_has_every_key(finished: tuple[Path, str, int]) -> None:
    folder, printed, code = finished
    assert code == 0
    metrics = strict(folder / "metrics.json")
    assert json.loads(printed) == metrics
    assert metrics.keys() >= REQUIRED
    assert metrics["final_error_um"].keys() == {"x", "y", "z"}
    assert metrics["compute_ms"].keys() == {"p50", "p99"}
    assert all(p.keys() >= REQUIRED_AT_A_POSITION for p in metrics["positions"])
    assert (metrics["docked"], metrics["end_state"], metrics["seed"]) == (True, "docked", SEED)
    assert len(strict(folder / "iterations.json")) == metrics["iterations"]


def test_the_folder_holds_the_figures_and_a_report_that_needs_nothing_else(
    finished: tuple[Path, str, int],
) -> None:
    folder = finished[0]
    assert {path.name for path in folder.iterdir()} >= COMPLETE
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == len(FIGURES)
    assert not outside(page)


def timeless(metrics: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in metrics.items() if name not in ("compute_ms", "run_time_s")}


def test_the_same_seed_gives_the_same_run_but_for_its_times(
    finished: tuple[Path, str, int], device: Device
) -> None:
    again = finite_json(full_run(device, SEED).record.metrics())
    assert timeless(strict(finished[0] / "metrics.json")) == timeless(json.loads(json.dumps(again)))


def test_a_folder_that_holds_files_is_refused_and_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    assert adof_run("--out", tmp_path) == 2
    assert one_sentence(capsys) == f"adof: {tmp_path} already holds files: choose a new or empty folder"
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    assert (tmp_path / "mine.txt").read_text() == "keep"


def one_sentence(capsys: pytest.CaptureFixture[str]) -> str:
    shown = capsys.readouterr()
    assert shown.out == ""
    lines = shown.err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


@pytest.mark.parametrize("place", ["file", "file/deeper"])
def test_a_place_that_cannot_be_written_is_refused_in_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], place: str
) -> None:
    (tmp_path / "file").write_text("in the way")
    assert adof_run("--out", tmp_path / place) == 2
    sentence = one_sentence(capsys)
    assert sentence.startswith(f"adof: {tmp_path / place} cannot be written (")
    assert sentence.endswith("): choose another folder")
    assert (tmp_path / "file").read_text() == "in the way"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--mask", "square"), "mask is 'square': choose one of joint, paper, fixed"),
        (("--device", "no such device"), "no such device"),
        (("--calibration", "absent.json"), "absent.json"),
        (("--speed", "9"), "--speed"),
        (("--seed", "-1"), "--seed"),
        (("--seed", "many"), "--seed"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_a_wrong_option_is_refused_before_anything_is_made(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert adof_run(*options, "--out", tmp_path / "out") == 2
    shown = capsys.readouterr()
    assert said in shown.err
    assert "Traceback" not in shown.err
    assert shown.out == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("after", ["autofocus", "coarse"])
def test_ctrl_c_exits_130_and_leaves_a_folder_complete_up_to_then(
    device: Device, tmp_path: Path, after: str
) -> None:
    folder = tmp_path / "out"
    command = [*ADOF, "run", "--seed", SEED, "--out", folder, "--device",
               device.facts.index]  # fmt: skip
    words = [str(word) for word in command]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stderr is not None
        assert any(line.strip().startswith(f"{after}:") for line in process.stderr)
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
        code = process.wait(timeout=120)
    assert code == 130
    assert "Traceback" not in rest
    metrics = strict(folder / "metrics.json")
    assert (metrics["docked"], metrics["end_state"]) == (False, "interrupted")
    rows = strict(folder / "iterations.json")
    assert [row["number"] for row in rows] == list(range(metrics["iterations"]))
    assert (metrics["iterations"] > 0) == (after == "coarse")
    names = {path.name for path in folder.iterdir()}
    assert names >= (COMPLETE if after == "coarse" else COMPLETE - FIGURES)
    assert not [name for name in names if name.startswith(".")]
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "interrupted" in page
    assert not outside(page)
