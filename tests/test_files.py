from __future__ import annotations

import json
import os
import stat
import tempfile
from pathlib import Path

import pydantic
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_cl.errors import InputError
from adof_cl.files import read_versioned, whole_file


def written(path: Path, text: str) -> None:
    with whole_file(path) as temporary:
        temporary.write_text(text)


def test_a_block_that_succeeds_replaces_the_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    for text in ("first", "second"):
        written(path, text)
        assert path.read_text() == text
        assert list(tmp_path.iterdir()) == [path]


def test_until_the_block_ends_the_old_file_stands(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with whole_file(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt])
def test_a_block_that_raises_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, failure: type[BaseException]
) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def broken() -> None:
        with whole_file(path) as temporary:
            temporary.write_text("half")
            raise failure

    with pytest.raises(failure):
        broken()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_temporary_file_has_the_suffix_that_writers_choose_their_format_by(tmp_path: Path) -> None:
    with whole_file(tmp_path / "a.png") as temporary:
        assert temporary.suffix == ".png"
        assert temporary.parent == tmp_path


def test_the_file_has_the_permissions_of_any_other_new_file(tmp_path: Path) -> None:
    written(tmp_path / "ours", "")
    (tmp_path / "plain").touch()
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("ours", "plain")]
    assert modes[0] == modes[1]


@pytest.mark.parametrize("place", ["absent/a.txt", "file/a.txt"])
def test_a_place_that_cannot_be_written_is_refused_before_the_block_runs(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("in the way")
    ran = []
    with pytest.raises(InputError, match=r"a\.txt cannot be written .*: choose another place$"):
        ran.extend(_ran(tmp_path / place))
    assert not ran
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def _ran(path: Path) -> list[Path]:
    with whole_file(path) as temporary:
        return [temporary]


def test_a_folder_in_the_files_place_is_refused_and_stays(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        written(path, "text")
    assert os.listdir(tmp_path) == ["a.txt"]  # noqa: PTH208  (hidden leftovers count as well)
    assert path.is_dir()


class Kept(pydantic.BaseModel):
    schema_version: int
    values: list[float]


KEPT = pydantic.TypeAdapter(Kept)


@given(st.lists(st.floats(allow_nan=False)))
def test_what_is_written_is_read_infinities_too(values: list[float]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kept.json"
        path.write_text(json.dumps({"schema_version": 3, "values": values}))
        assert read_versioned(path, KEPT, 3, "a list", "adof list").values == values


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is not a list: give one that adof list wrote"),
        ("\xff", "is not a list"),
        ("[]", "is not a list"),
        ("{}", "is not a list"),
        ('{"schema_version": 3}', "is not a list"),
        ('{"schema_version": "3", "values": "x"}', "is not a list"),
        ('{"schema_version": 2}', "has schema version 2, 3 was wanted: adof list writes it anew"),
    ],
)
def test_what_is_something_else_or_of_another_version_is_refused(
    tmp_path: Path, text: str, sentence: str
) -> None:
    path = tmp_path / "kept.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=sentence):
        read_versioned(path, KEPT, 3, "a list", "adof list")


def test_a_file_that_is_not_there_says_who_writes_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be read .*: adof list writes a list"):
        read_versioned(tmp_path / "none.json", KEPT, 3, "a list", "adof list")
