"""The rig file, strict, and the check of what it names; `adof rig` and `adof emulate` as commands."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from adof_cl.cli import main
from adof_drivers.emulators.faults import Fault, FaultSchedule
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.serve import Served
from adof_drivers.errors import RequestError
from adof_drivers.rig import Finding, check, load

GOOD = """
[stage.coarse]
driver = "gcs"
tcp = "127.0.0.1:50000"
[stage.coarse.axes.x]
wire = "1"
um_per_unit = 1000.0
speed_limit_um_per_s = 2000.0
resolution_um = 1.0
[stage.coarse.axes.theta]
wire = "2"
rad_per_unit = 0.0174533
speed_limit_rad_per_s = 0.05
resolution_rad = 0.0001
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(text)
    return path


@contextmanager
def emulated(*options: str) -> Iterator[dict[str, str]]:
    """Run `adof emulate stage` and give what it says of itself."""
    code = "from adof_cl.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, "emulate", "stage", "--json", *options],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())
    finally:
        process.kill()
        process.communicate()


def wrong(findings: list[Finding]) -> list[Finding]:
    """What is to be mended, but for how long a position took: this machine may be busy."""
    return [finding for finding in findings if not finding.good and finding.what != "position read"]


def rig(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as exit_:
        main(["rig", "check", *arguments])
    printed = capsys.readouterr()
    return int(exit_.value.code or 0), printed.out, printed.err


def test_a_good_file_is_read_in_its_order_and_its_own_units(tmp_path: Path) -> None:
    sections = load(written(tmp_path, GOOD))
    assert list(sections) == ["stage.coarse"]
    axes = sections["stage.coarse"].axes  # type: ignore[attr-defined]
    assert {name: axis.axis().unit for name, axis in axes.items()} == {"x": "um", "theta": "rad"}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("resolution_um = 1.0", "resolution_mm = 1.0", "resolution_mm is not known|resolution_um is missing"),
        ("resolution_um = 1.0", "resolution_um = 1.0\nspeeed = 3", "speeed is not known"),
        ('wire = "1"', 'wire = "1"\nhigh_rad = 2.0', "high_rad is not known"),
        ("resolution_um = 1.0", "", "resolution_um is missing"),
        ("um_per_unit = 1000.0", 'um_per_unit = "1000"', "um_per_unit"),
        ("speed_limit_um_per_s = 2000.0", "speed_limit_um_per_s = inf", "speed_limit_um_per_s"),
        ("speed_limit_um_per_s = 2000.0", "speed_limit_um_per_s = -1.0", "speed_limit_um_per_s"),
        ('driver = "gcs"', 'driver = "gsc"', "one of gcode, gcs, picomotor"),
        ('driver = "gcs"\n', "", "driver None"),
        ("[stage.coarse]", "[stages.coarse]", "'stages' is no kind"),
        ('tcp = "127.0.0.1:50000"', "", "no port"),
        ('tcp = "127.0.0.1:50000"', 'tcp = "127.0.0.1"', "tcp"),
        ('tcp = "127.0.0.1:50000"', 'ftdi = "C-863"', "ftdi"),
        ('tcp = "127.0.0.1:50000"', 'usb = "1a72"\nftdi = "1a72:1007"', "usb and ftdi"),
        ('tcp = "127.0.0.1:50000"', 'tcp = "127.0.0.1:5"\nserial = "/dev/x"', "tcp and serial"),
        ("[stage.coarse]", "[stage.coarse", "no TOML"),
    ],
)
def test_whatever_is_not_known_or_not_of_its_kind_is_refused_by_name(
    old: str, new: str, said: str, tmp_path: Path
) -> None:
    assert old in GOOD
    with pytest.raises(RequestError, match=said):
        load(written(tmp_path, GOOD.replace(old, new, 1)))


def test_a_file_that_is_not_there_and_an_empty_one_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="cannot be read"):
        load(tmp_path / "none.toml")
    with pytest.raises(RequestError, match="names no device"):
        load(written(tmp_path, ""))


@contextmanager
def served(tmp_path: Path, *, homed: bool) -> Iterator[tuple[GcsEngine, Path]]:
    import time

    engine = GcsEngine(("1", "2"), now_s=time.monotonic)
    if homed:
        engine.feed(b"SVO 1 1 2 1\nFRF\nERR?\n")
    with Served.tcp(engine) as on:
        yield engine, written(tmp_path, GOOD.replace("127.0.0.1:50000", on.address))


def test_a_check_moves_nothing_and_says_what_is_to_be_mended(tmp_path: Path) -> None:
    with served(tmp_path, homed=False) as (engine, path):
        before = engine.position
        findings = check(load(path))
        assert engine.position == before
        assert not [
            line for line in engine.received if line.startswith((b"MOV", b"SVO ", b"FRF ", b"JOG", b"VEL "))
        ]
    assert {finding.what for finding in wrong(findings)} == {"axis x", "axis theta"}
    assert all("home" in finding.mend for finding in wrong(findings))


def test_a_check_that_may_move_jogs_every_homed_axis_and_brings_it_back(tmp_path: Path) -> None:
    with served(tmp_path, homed=True) as (engine, path):
        before = engine.position
        findings = check(load(path), move=True)
        assert engine.position == pytest.approx(before, abs=2e-6)
    assert [f.what for f in findings if f.what.endswith("moves")] == ["axis x moves", "axis theta moves"]
    assert not wrong(findings)


def test_a_stuck_axis_is_found_by_a_check_that_may_move(tmp_path: Path) -> None:
    with served(tmp_path, homed=True) as (engine, path):
        text = path.read_text().replace("resolution_um = 1.0", "resolution_um = 1.0\nfollowing_um = 5.0")
        engine.motors["1"].stuck = True
        findings = check(load(written(tmp_path, text)), move=True)
    assert not findings[-1].good
    assert "x stands at" in findings[-1].found
    assert "stalled" in findings[-1].mend


def test_a_device_that_fails_does_not_keep_the_next_from_being_checked_and_all_are_closed(
    tmp_path: Path,
) -> None:
    with served(tmp_path, homed=True) as (engine, path):
        two = path.read_text() + path.read_text().replace("coarse", "fine")
        engine.faults = FaultSchedule([Fault("disconnect", at=12)])
        first, second = load(written(tmp_path, two)).items()
        assert wrong(check(dict([first])))
        assert not wrong(check(dict([second])))  # the port was let go


def test_the_command_line_from_emulator_to_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with emulated("--axes", "2") as where:
        path = written(tmp_path, GOOD.replace("127.0.0.1:50000", where["address"]))
        code, out, _ = rig([str(path), "--json"], capsys)
        assert code == 1  # not homed
        assert {"device", "what", "found", "good", "mend"} == set(json.loads(out)[0])
        code, out, _ = rig([str(path)], capsys)
        assert code == 1
        assert "home it" in out
        assert re.search("[23] of 5 are not as they should be", out)
    code, out, _ = rig([str(path)], capsys)
    assert code == 1
    assert "does not answer" in out


def test_a_refused_file_is_one_sentence_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, said = rig([str(written(tmp_path, "[camera]\n"))], capsys)
    assert (code, out) == (2, "")
    assert said.startswith("adof: ")
    assert said.count("\n") == 1


@pytest.mark.parametrize("where", ["0.0.0.0:5000", "127.0.0.1", "127.0.0.1:99999", "nowhere:x"])
def test_an_emulator_is_refused_where_others_could_reach_it(
    where: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["emulate", "stage", "--tcp", where])
    assert exit_.value.code == 2
    assert capsys.readouterr().err.startswith("adof: ")


def test_a_micromanipulator_on_a_terminal_is_opened_by_its_name(tmp_path: Path) -> None:
    pytest.importorskip("serial")
    with emulated("--pty", "--protocol", "gcode") as where:
        text = f"""
[stage.fine]
driver = "gcode"
serial = "{where["address"]}"
[stage.fine.axes.x]
wire = "X"
um_per_unit = 1000.0
speed_limit_um_per_s = 500.0
resolution_um = 0.05
low_um = -3000.0
high_um = 3000.0
"""
        findings = check(load(written(tmp_path, text)), move=True)
    assert findings[0].found == "micromanipulator v1.0.5"
    assert [finding.what for finding in wrong(findings)] == ["axis x"]  # not homed, so not moved


def test_an_emulated_stage_on_a_terminal_is_opened_by_its_name(tmp_path: Path) -> None:
    pytest.importorskip("serial")
    with emulated("--pty", "--axes", "2") as where:
        text = GOOD.replace('tcp = "127.0.0.1:50000"', f'serial = "{where["address"]}"')
        findings = check(load(written(tmp_path, text)))
    assert "Emulated" in findings[0].found
