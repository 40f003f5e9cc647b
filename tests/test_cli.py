"""What every command shares: help, one sentence for a refusal, exit codes."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.table import Table

from adof_cl import __version__
from adof_cl.cli import COMMANDS, main
from adof_cl.cli.tables import print_table
from adof_cl.device import SELECTOR_VARIABLE, list_devices


def run(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    return int(exit_.value.code or 0)


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    printed = capsys.readouterr().out
    assert all(f" {name} " in printed for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself_with_an_example(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([command, "--help"]) == 0
    printed = capsys.readouterr().out
    assert f"{command} [OPTIONS]" in printed
    assert re.search(rf"Examples?:\s+adof {command}", printed)
    assert "--help" in printed


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.strip() == __version__


@pytest.mark.parametrize(
    "arguments",
    [["assemble"], ["--quickly"], *([name, "--no-such-option"] for name in COMMANDS)],
    ids=" ".join,
)
def test_an_unknown_word_exits_2_and_says_so(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == 2
    printed = capsys.readouterr()
    assert not printed.out
    assert "No such" in printed.err
    assert "Traceback" not in printed.err


@pytest.mark.parametrize(
    "arguments",
    [
        ["selftest"],
        ["otf", "--u", "0.5"],
        ["psf", "--alpha", "20", "-o", "psf.npz"],
        ["phase", "--alpha", "20", "--panel", "LC2002", "-o", "mask.png"],
        ["run"],
    ],
    ids=lambda words: words[0],
)
def test_an_unknown_device_exits_2_in_one_sentence_and_leaves_no_file(
    arguments: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run([*arguments, "--device", "abacus"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if line.startswith("adof: no OpenCL device fits 'abacus'")] == lines[-1:]
    assert list(tmp_path.iterdir()) == []


def test_devices_are_a_table_with_one_default(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(SELECTOR_VARIABLE, raising=False)
    assert run(["devices"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for heading in ("device", "platform", "type", "fp64", "local memory", "units", "driver"):
        assert heading in lines[0]
    assert sum(line.strip().startswith("*") for line in lines) == 1
    assert all(any(facts.name in line for line in lines) for facts in list_devices())


def test_devices_as_json_hold_every_fact(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = list_devices()
    monkeypatch.setenv(SELECTOR_VARIABLE, str(found[-1].index))
    assert run(["devices", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == [{**f.as_dict(), "default": f.index == found[-1].index} for f in found]


def test_without_any_opencl_platform_the_cure_is_named(tmp_path: Path) -> None:
    """The loader reads its folder once a process, so this needs one of its own."""
    none = str(tmp_path / "none")
    environment = {**os.environ, "OCL_ICD_VENDORS": none, "OPENCL_VENDOR_PATH": none}
    program = "import sys; from adof_cl.cli import main; main(sys.argv[1:])"
    done = subprocess.run(
        [sys.executable, "-c", program, "devices"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "pip install pocl-binary-distribution" in done.stderr


def test_brackets_in_a_table_stand_for_themselves(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("to mend [first]")
    table.add_row("pip install 'adof-cl[gige]'")
    print_table(table)
    said = capsys.readouterr().out
    assert "adof-cl[gige]" in said
    assert "to mend [first]" in said
