"""Cameras, modulators and operator's devices in the rig file, and what a check of each finds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tifffile

from adof_cl.cli.live_rig import TABLES, require_whole
from adof_drivers.emulators.gige import Faults, GigeCameraEmulator
from adof_drivers.emulators.hid import EmulatedHid, EmulatedRelay, EmulatedSpaceMouse
from adof_drivers.errors import RequestError
from adof_drivers.operator_sections import PedalSection, RelaySection, SpaceMouseSection
from adof_drivers.pedal import StopPedal
from adof_drivers.relay import HidRelay
from adof_drivers.rig import Finding, check, load
from adof_drivers.spacemouse import SpaceMouse
from test_slm_window import needs_gl, server

EXAMPLE = Path(__file__).parents[1] / "examples" / "rig.toml"
GIGE = """
[camera.1]
driver = "gige"
address = "127.0.0.1"
rate_hz = 50.0
exposure_s = 0.002
first_row = 4
first_column = 6
rows = 20
columns = 30
"""
SLM = """
[slm.panel]
driver = "window"
monitor = 0
require_pacing = false
rows = 120
columns = 161
pitch_um = 32.0
settling_s = 0.05
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(text)
    return path


def by_what(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.what: finding for finding in findings}


def test_the_example_is_a_whole_rig() -> None:
    sections = load(EXAMPLE, tables=TABLES)
    require_whole(sections)
    kinds = {(place.partition(".")[0], section.driver) for place, section in sections.items() if "." in place}
    assert {kind for kind, _ in kinds} == {"camera", "slm", "stage", "operator"}


@pytest.mark.parametrize(
    ("text", "old", "new", "said"),
    [
        (GIGE, "rows = 20\n", "", "give all four or none"),
        (GIGE, "rate_hz = 50.0", "rate = 50.0", "rate is not known"),
        (GIGE, "rate_hz = 50.0", "rate_hz = 0.0", "rate_hz"),
        (GIGE, "first_row = 4", "first_row = -4", "first_row"),
        (GIGE, '"127.0.0.1"', '"camera"', "address"),
        (GIGE, '"gige"', '"usb"', "basler, gige, image_sequence, video_capture"),
        (SLM, "rows = 120", "rows = 120.5", "rows"),
        (SLM, "pitch_um", "pitch_mm", "pitch_mm is not known|pitch_um is missing"),
        (SLM, "settling_s = 0.05\n", "", "settling_s is missing"),
        (SLM, '"window"', '"monitor"', "dlpc900, holoeye, window"),
        ('[operator.p]\ndriver = "pedal"\n', "pedal", "button", "pedal, relay, spacemouse"),
        ('[operator.p]\ndriver = "pedal"\n', "\n", '\nform = "boot"\n', "driver|form"),
        (
            "[design]\ntilt_rad = 0.5\n" + SLM,
            "tilt_rad = 0.5",
            "tilt_deg = 30.0",
            "design.tilt_deg is not known",
        ),
        ("[design]\ntilt_rad = 0.5\n", "tilt_rad = 0.5", "tilt_rad = 0.4", "names no device"),
    ],
)
def test_whatever_is_not_known_or_not_of_its_kind_is_refused_by_name(
    text: str, old: str, new: str, said: str, tmp_path: Path
) -> None:
    assert old in text
    with pytest.raises(RequestError, match=said):
        load(written(tmp_path, text.replace(old, new, 1)), tables=TABLES)


@contextmanager
def served(faults: Faults | None = None) -> Iterator[None]:
    """A camera of noise at 127.0.0.1."""
    pictures = np.random.default_rng(0).integers(0, 256, (7, 40, 50), dtype=np.uint8)
    with GigeCameraEmulator(
        lambda number, region: pictures[number % 7][
            region[0][0] : region[0][0] + region[1][0], region[0][1] : region[0][1] + region[1][1]
        ],
        (40, 50),
        faults=faults,
    ):
        yield


@pytest.mark.usefixtures("loopback_cameras")
def test_a_camera_is_set_as_the_file_says_and_its_rate_and_losses_are_measured(tmp_path: Path) -> None:
    pytest.importorskip("viva_genicam", reason="viva-genicam is not installed")
    with served():
        found = by_what(check(load(written(tmp_path, GIGE))))
    assert found["identity"].found.endswith("30 x 20")
    assert "50 asked for" in found["frame rate"].found
    assert "median" in found["frame age on arrival"].found
    with served(Faults(seed=1, frame_loss=0.3)):
        lossy = by_what(check(load(written(tmp_path, GIGE))))
    assert not lossy["losses"].good
    assert lossy["losses"].mend


def test_replayed_pictures_are_read_to_their_end(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", np.zeros((5, 8, 9), np.uint8), photometric="minisblack")
    text = f'[camera.1]\ndriver = "image_sequence"\npath = "{tmp_path / "s.tif"}"\n'
    (finding,) = check(load(written(tmp_path, text)))
    assert finding.good
    assert "5 of 9 x 8" in finding.found


@needs_gl
def test_a_panel_is_opened_and_its_flips_are_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with server("Xvfb", "-screen", "0", "161x120x24") as display:
        monkeypatch.setenv("DISPLAY", display)
        found = by_what(check(load(written(tmp_path, SLM))))
        wrong = check(load(written(tmp_path, SLM.replace("rows = 120", "rows = 121"))))
    assert "161 x 120" in found["panel"].found
    assert "median" in found["pattern shown"].found
    assert [finding.good for finding in wrong] == [False]
    assert "DISPLAY" not in os.environ or os.environ["DISPLAY"] == display


def test_a_panel_without_a_display_is_to_be_mended_not_a_crash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":99999")
    (finding,) = check(load(written(tmp_path, SLM)))
    assert not finding.good
    assert finding.mend


def test_what_an_operator_holds_is_watched_and_nothing_is_switched() -> None:
    mouse, pedal, relay = EmulatedSpaceMouse(joined=True), EmulatedHid(), EmulatedRelay()
    puck, foot, board = SpaceMouse(mouse), StopPedal(pedal), HidRelay(relay, 2)
    mouse.deflect(0, 0, 0)
    sections = (
        SpaceMouseSection(driver="spacemouse"),
        PedalSection(driver="pedal"),
        RelaySection(driver="relay"),
    )

    def checked() -> list[bool]:
        return [
            all(finding.good for finding in section.check("it", device, move=False))
            for section, device in zip(sections, (puck, foot, board), strict=True)
        ]

    assert checked() == [True, True, True]
    mouse.deflect(300, 0, 0)
    pedal.send(b"\x01")
    assert checked() == [False, False, True]
    mouse.unplug()
    pedal.unplug()
    assert checked() == [False, False, True]
    assert relay.written == []
