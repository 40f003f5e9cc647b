"""The twin behind real protocols: what it is made of, and a run through the wire that a pedal ends."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_cl.calibration_file import save_calibration
from adof_cl.cli import main
from adof_cl.cli.emulated_rig import FrameBuffer, rig_text
from adof_cl.cli.live_rig import TABLES, design_of, require_whole
from adof_cl.device import Device
from adof_cl.errors import InputError
from adof_cl.loop import Options
from adof_cl.stereo import StereoRig, calibrate_camera
from adof_cl.twin import Design, RecordedStage, build
from adof_cl.twin.recorded import RecordedAxis
from adof_drivers.emulators.gige import TriggerLine
from adof_drivers.rig import load
from adof_drivers.slm_window import SlmWindow
from test_cli_run import COMPLETE
from test_loop import BIAS_PX, COARSE_RAD, COARSE_UM, DEPTH_UM, FINE_UM
from test_record import strict
from test_slm_window import needs_gl, server
from umockdev_there import umockdev_is_there

SEED = 3
ADOF = (sys.executable, "-c", "from adof_cl.cli import main; main()")
needs_wire = pytest.mark.skipif(
    shutil.which("Xvfb") is None
    or any(find_spec(name) is None for name in ("viva_genicam", "glfw", "OpenGL")),
    reason="Xvfb, viva-genicam, glfw or PyOpenGL is not installed",
)

needs_umockdev = pytest.mark.skipif(
    not umockdev_is_there(), reason="umockdev with its Python bindings is not installed"
)


# ---- what it is made of -----------------------------------------------------------------------------------


SLM = """driver = "window"
monitor = 0
rows = 1
columns = 1
pitch_um = 1.0
settling_s = 1.0
"""


def text() -> str:
    return rig_text(Design(), {"coarse": "127.0.0.1:1", "fine": "127.0.0.1:2"}, 60.0)


def test_its_file_is_a_whole_rig_and_says_all_that_the_drawing_says(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(text())
    sections = load(path, tables=TABLES)
    require_whole(sections)
    drawn, read = Design(), design_of(sections, (494, 659))
    for name in ("optics_1", "optics_2", "mask_2", "tilt_rad", "peg", "hole", "exposure_s", "frame_rate_hz"):
        assert getattr(read, name) == getattr(drawn, name), name
    for name in ("rows", "columns", "region_rows", "region_columns", "region_origin_yx"):
        assert getattr(read, name) == getattr(drawn, name), name
    for name in ("rows", "columns", "pitch_um", "stroke_rad"):
        assert getattr(read.panel, name) == getattr(drawn.panel, name), name
    assert read.settling_s >= drawn.settling_s


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[camera.2]", "[camera.3]", "lacks camera.2"),
        ("[slm.LC2002]", "[slm.one]\n" + SLM + "[slm.LC2002]", "one slm instead of 2"),
        ("[stage.fine.axes.y]", "[stage.fine.axes.z]", "stage.fine lacks the axis y"),
        ("exposure_s = 0.004\n", "", "camera.1 has to state"),
        ("rate_hz = 60.0\n", "rate_hz = 30.0\n", "rate_hz of camera.1 and camera.2 differ"),
        ("first_row = 47", "first_row = 46", "region of camera.1 and camera.2 differ"),
    ],
)
def test_a_rig_that_cannot_be_run_on_is_refused_before_it_is_opened(
    old: str, new: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "rig.toml"
    assert old in text()
    path.write_text(text().replace(old, new, 1))

    def compose() -> None:
        sections = load(path, tables=TABLES)
        require_whole(sections)
        design_of(sections, (494, 659))

    with pytest.raises(InputError, match=said):
        compose()


@needs_gl
def test_the_light_passes_exactly_the_codes_that_the_window_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shape = (120, 161)
    rng = np.random.default_rng(0)
    with server("Xvfb", "-screen", "0", "161x120x24", "-fbdir", str(tmp_path)) as display:
        monkeypatch.setenv("DISPLAY", display)
        with SlmWindow(shape, monitor=0) as window:
            buffer = FrameBuffer(tmp_path / "Xvfb_screen0")
            for _ in range(3):
                codes = rng.integers(0, 256, shape, dtype=np.uint8)
                window.show(codes)
                while not np.array_equal(buffer.codes() if buffer.changed() else None, codes):
                    pass  # the server draws when it gets to it
                assert not buffer.changed()


@given(
    st.lists(st.floats(-1e4, 1e4), min_size=2, max_size=30),
    st.floats(0, 1),
    st.integers(1, 6000),
)
def test_a_recorded_axis_is_where_it_was_sampled_and_straight_between(
    positions: list[float], share: float, earlier: int
) -> None:
    axis = RecordedAxis(0.0, 0.0)
    for number in range(earlier):  # more than is kept
        axis.add(1e-3 * (number + 1), 0.0)
    times = [10.0 + number for number in range(len(positions))]
    for time_s, position in zip(times, positions, strict=True):
        axis.add(time_s, position)
    np.testing.assert_array_equal(axis.at(np.array(times)), positions)
    between = positions[-2] + share * (positions[-1] - positions[-2])
    assert float(axis.at(times[-2] + share)) == pytest.approx(between, abs=1e-9)
    assert float(axis.at(1e9)) == positions[-1]
    changed = [t for t, a, b in zip(times, [0.0, *positions], positions, strict=False) if a != b]
    assert axis.moved_s == (changed[-1] if changed else 0.0)


def test_a_world_on_recorded_axes_shows_what_it_shows_on_its_own(device: Device) -> None:  # noqa: ARG001
    rig = build(3)
    rig.coarse.move_to({"x": 120.0, "theta": 0.01, "z": -900.0})
    rig.coarse.wait_until_still()
    from adof_cl.twin import Clock, SimulatedCamera, SimulatedSlm, lit

    clock, design = Clock(), rig.design
    coarse, fine = RecordedStage(design.coarse, 0.0), RecordedStage(design.fine, 0.0)
    coarse.add(0.5, rig.coarse.position())
    slm = SimulatedSlm(design.panel, design.optics_1.aperture_um, clock, design.settling_s)
    world = lit(3, design, clock, coarse, fine, slm)
    camera = SimulatedCamera(1, world, clock, 3)
    frame = rig.camera_1.grab()
    np.testing.assert_array_equal(
        camera.expose(frame.number, frame.time_s - design.exposure_s / 2), frame.pixels
    )


def test_cameras_on_one_line_expose_at_the_same_moments_however_busy_one_is() -> None:
    line = TriggerLine()
    moments: dict[str, list[float]] = {"quick": [], "slow": []}
    picture = np.random.default_rng(0).random(100_000)

    def expose(name: str) -> None:
        while len(moments[name]) < 20:
            if (moment := line.wait(name, 0.001, 0.5)) is not None:
                moments[name].append(moment)
                if name == "slow":
                    np.sort(picture)
        line.leave(name)

    line.wait("slow", 0.001, 0.0)  # alone on the line, and busy from then on
    threads = [threading.Thread(target=expose, args=(name,)) for name in moments]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert moments["quick"] == moments["slow"]
    assert all(late > early for early, late in pairwise(moments["slow"]))


# ---- through the wire -------------------------------------------------------------------------------------


def run(folder: Path, *options: object) -> tuple[subprocess.CompletedProcess[str], dict[str, Any]]:
    done = subprocess.run(
        [*ADOF, "run", "--rig", "emulated", "--seed", str(SEED), "--out", str(folder), *map(str, options)],
        capture_output=True,
        text=True,
        check=False,
        env={name: value for name, value in os.environ.items() if name != "DISPLAY"},
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done, strict(folder / "metrics.json")


def calibration(path: Path) -> Path:
    """Write what a calibration of this seed's rig finds, without the half minute of travel it takes."""
    rig, rng = build(SEED), np.random.default_rng(0)
    origin, sigma_px = np.array(rig.design.region_origin_yx[::-1]), 0.02
    readings, seen = [], ([], [])
    for z in np.linspace(0.0, -3000.0, 4):
        for x, y in ((0, 0), (600, -300), (600, 300), (-400, 300), (-400, -300)):
            rig.coarse.move_to({"x": x, "y": y, "z": z})
            rig.coarse.wait_until_still()
            readings.append([rig.coarse.position()[axis] for axis in ("x", "y", "z")])
            for number, places in enumerate(seen, start=1):
                middle = rig.world.corners_px(number, "hole").mean(axis=0) - origin
                places.append(middle + sigma_px * rng.standard_normal(2))
    cameras = [
        calibrate_camera(
            np.array(readings),
            np.array(places),
            covariance_px2=np.broadcast_to(sigma_px**2 * np.eye(2), (len(places), 2, 2)),
            work_volume_um=np.array([[-600, -600, -4000], [600, 600, 200]]),
            camera_id=name,
        )
        for places, name in zip(seen, Options(rig_name=f"emulated rig {SEED}").camera_ids, strict=True)
    ]
    save_calibration(path, StereoRig(*cameras))
    return path


@needs_wire
@pytest.mark.usefixtures("loopback_cameras")
@pytest.mark.timeout(600)
def test_the_pedal_pressed_in_mid_run_brings_all_to_rest_and_leaves_a_complete_folder(
    device: Device, tmp_path: Path
) -> None:
    folder = tmp_path / "out"
    known = calibration(tmp_path / "known.json")
    done, metrics = run(
        folder, "--rate-hz", 20, "--press-pedal-at", 4, "--calibration", known, "--device", device.facts.index
    )
    assert done.returncode == 1
    assert "adof: the stage is not armed, the stop pedal was pressed" in done.stderr
    assert "release the enable switch and press it anew" in done.stderr
    assert not metrics["docked"]
    assert metrics["end_state"].startswith("stopped: ")
    # Sent before the next command could have been, and everything at rest.
    assert metrics["rig"]["stop"]["pressed_to_sent_ms"] > 0
    assert metrics["rig"]["fault"].startswith("the stop pedal was pressed")
    assert metrics["contacts_before_alignment"] == 0
    rows = strict(folder / "iterations.json")
    assert [row["number"] for row in rows] == list(range(metrics["iterations"]))
    assert metrics["iterations"] in (5, 6)  # one may have been under way
    names = {path.name for path in folder.iterdir()}
    assert names >= COMPLETE | {"rig.toml", "latency.png", "calibration.json"}
    assert "stop sent" in (folder / "report.html").read_text(encoding="utf-8")
    # Up to there it saw what the twin shows: at A, at the project's bounds.
    (first, *_) = metrics["positions"]
    assert abs(first["depth_est_um"] - first["depth_um"]) <= DEPTH_UM
    assert np.abs(first["lateral_bias_um"]).max() <= BIAS_PX * Design().optics_1.object_pitch_um
    for stage in ("frame", "features", "law", "command", "total"):
        assert 0 < metrics["latency_ms"][stage]["p50"] <= metrics["latency_ms"][stage]["p99"]


@needs_wire
@pytest.mark.slow
@pytest.mark.usefixtures("loopback_cameras")
@pytest.mark.timeout(600)
def test_it_docks_with_every_byte_through_the_wire_within_every_bound(device: Device, tmp_path: Path) -> None:
    done, metrics = run(tmp_path / "out", "--rate-hz", 30, "--device", device.facts.index, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == metrics
    assert metrics["docked"]
    assert metrics["contacts_before_alignment"] == 0
    coarse, fine, final = (metrics[f"{stage}_error_um"] for stage in ("coarse", "fine", "final"))
    assert max(map(abs, coarse.values())) <= COARSE_UM
    assert abs(metrics["coarse_error_rad"]) <= COARSE_RAD
    assert max(abs(fine["x"]), abs(fine["y"]), abs(final["x"]), abs(final["y"])) <= FINE_UM
    assert abs(final["z"]) <= COARSE_UM
    assert abs(metrics["positions"][0]["depth_est_um"] - metrics["positions"][0]["depth_um"]) <= DEPTH_UM


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--rate-hz", "30"), "--rate-hz is the emulated rig's"),
        (("--press-pedal-at", "3"), "--press-pedal-at is the emulated rig's"),
        (("--rig", "emulated", "--rate-hz", "1000"), "1 to 200 was wanted"),
        (("--rig", "emulated", "--compare"), "leave --rig out"),
        (("--rig", "absent.toml"), "absent.toml cannot be read"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_options_that_do_not_fit_are_refused_before_anything_is_made(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["run", *options, "--out", "out"])
    assert ended.value.code == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_machine_without_a_virtual_display_is_told_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SystemExit) as ended:
        main(["run", "--rig", "emulated", "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert "Xvfb: install it" in capsys.readouterr().err


@needs_wire
@pytest.mark.usefixtures("loopback_cameras")
@pytest.mark.timeout(300)
def test_another_program_finds_the_whole_emulated_rig_by_its_file(tmp_path: Path) -> None:
    file = tmp_path / "emulated.toml"
    check = (*ADOF, "rig", "check", str(file), "--json")
    done = subprocess.run(
        (*ADOF, "emulate", "rig", str(file), "--rate-hz", "20", "--", *check),
        capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip
    findings = json.loads(done.stdout)
    who = {f["device"]: f["found"] for f in findings if f["what"] in ("identity", "panel")}
    assert set(who) == {"camera.1", "camera.2", "slm.LC2002", "stage.coarse", "stage.fine"}
    assert "Emulated GigE camera" in who["camera.1"]
    assert "Emulated C-863" in who["stage.fine"]
    # Nobody homed the axes, and nothing moved; all else but a busy machine's frame rate is well.
    wrong = {f["what"] for f in findings if not f["good"]}
    assert {f"axis {name}" for name in ("x", "y", "z", "theta")} <= wrong
    assert all(what.startswith(("axis", "frame", "losses")) for what in wrong)
    assert done.returncode == 1  # the program's own


@needs_wire
@needs_umockdev
@pytest.mark.usefixtures("loopback_cameras")
@pytest.mark.timeout(300)
def test_the_whole_rig_is_opened_through_the_systems_own_hidapi_too(tmp_path: Path) -> None:
    file = tmp_path / "emulated.toml"
    still = tmp_path / "hands.txt"
    still.write_text("wait 100\n")
    hands = (*ADOF, "emulate", "hid", "spacemouse,pedal", "--script", str(still), "--")
    done = subprocess.run(
        (*ADOF, "emulate", "rig", str(file), "--operators", "--rate-hz", "20", "--", *hands,
         *ADOF, "rig", "check", str(file), "--json"),
        capture_output=True, text=True, check=False, timeout=200,
    )  # fmt: skip
    findings = json.loads(done.stdout)
    assert {"camera.1", "slm.LC2002", "stage.fine", "operator.pedal", "operator.puck"} <= {
        f["device"] for f in findings if f["good"]
    }


def test_a_rig_file_that_cannot_be_written_is_refused_before_anything_is_started(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["emulate", "rig", str(tmp_path / "none" / "rig.toml")])
    assert ended.value.code == 2
    assert "no such folder" in capsys.readouterr().err
