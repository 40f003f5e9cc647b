from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from adof_cl.errors import InputError
from adof_cl.files import whole_file


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
