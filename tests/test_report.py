from __future__ import annotations

import dataclasses
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from adof_cl.errors import InputError
from adof_cl.record import RunRecord
from adof_cl.report import write_report
from test_record import iteration, position

FIGURES = {"trajectory.png", "mask_and_depth.png", "servo_errors.png", "frames.png"}
PNG = b"\x89PNG\r\n\x1a\n"


class Addresses(HTMLParser):
    """Everything a page would load or lead to."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]
        if tag in ("script", "link", "iframe", "object"):
            self.found.append(tag)


def outside(page: str) -> list[str]:
    """What a page needs from beyond its own file."""
    loaded = [
        address for address in Addresses(page).found if not address.startswith("data:image/png;base64,")
    ]
    return loaded + re.findall(r"https?://\S+|@import\b|url\((?!['\"]?data:)", page)


def with_truth(record: RunRecord) -> RunRecord:
    record.iterations = [
        dataclasses.replace(
            i, true_depth_um=i.hole_depth_um - 2, true_hole_xyz_um=(1.0, 2.0, 3.0), true_error_x_um=0.5,
            true_error_y_um=0.5, true_error_theta_rad=1e-3,
        )
        for i in record.iterations
    ]  # fmt: skip
    return record


def cut_short(count: int) -> RunRecord:
    record = RunRecord(4, "a device", [iteration(k, depth_um=4000.0 - 9 * k) for k in range(count)])
    record.end_state = "interrupted"
    return record


def test_a_run_interrupted_before_its_first_iteration_still_gives_a_report(tmp_path: Path) -> None:
    page = write_report(cut_short(0), tmp_path).read_text(encoding="utf-8")
    assert "interrupted" in page
    assert not outside(page)
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.parametrize(("count", "known"), [(1, False), (2, True), (30, False)])
def test_a_run_cut_short_is_drawn_up_to_where_it_came(tmp_path: Path, count: int, known: bool) -> None:
    record = with_truth(cut_short(count)) if known else cut_short(count)
    record.positions = [position("A")]
    page = write_report(record, tmp_path).read_text(encoding="utf-8")
    assert {path.name for path in tmp_path.iterdir()} == FIGURES | {"report.html"}
    assert all((tmp_path / name).read_bytes().startswith(PNG) for name in FIGURES)
    assert page.count("data:image/png;base64,") == len(FIGURES)
    assert not outside(page)


def test_the_page_shows_what_is_in_the_metrics_and_dashes_for_what_is_not_known(tmp_path: Path) -> None:
    record = cut_short(2)
    record.final_error = {"x": 0.123, "y": math.nan, "z": -4.56, "theta": 0.00789}
    page = write_report(record, tmp_path, "<h2>one more section</h2>").read_text(encoding="utf-8")
    assert "<h2>one more section</h2>" in page
    row = page.split("at the end</td>")[1].split("</tr>")[0]
    assert re.findall(r"<td>(.*?)</td>", row) == ["0.123", "–", "-4.56", "7.89"]


def test_text_from_outside_cannot_become_markup(tmp_path: Path) -> None:
    record = RunRecord(0, "<script>device</script>", end_state="<b>stopped</b>", notes=["<i>note</i>"])
    page = write_report(record, tmp_path).read_text(encoding="utf-8")
    assert not re.search(r"<script>|<b>stopped|<i>note", page)


@pytest.mark.parametrize(("docked", "verdict"), [(True, "good"), (False, "bad")])
def test_the_verdict_is_the_records(tmp_path: Path, docked: bool, verdict: str) -> None:
    record = RunRecord(0, "", docked=docked, end_state="as it ended")
    page = write_report(record, tmp_path).read_text(encoding="utf-8")
    assert f"<span class='{verdict}'>as it ended</span>" in page


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        write_report(cut_short(0), tmp_path / "absent")
