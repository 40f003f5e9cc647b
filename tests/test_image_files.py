from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from adof_cl.errors import InputError
from adof_cl.image_files import open_writer, read_image, read_stack, write_image


def image_of(dtype: type, shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".TIFF"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(9, 13), (9, 13, 3)], ids=str)
def test_an_image_written_is_read_back_bit_for_bit(
    tmp_path: Path, suffix: str, dtype: type, shape: tuple[int, ...]
) -> None:
    image = image_of(dtype, shape)
    path = tmp_path / f"image{suffix}"
    write_image(path, image)
    found = read_image(path)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, image)


def test_colour_is_red_green_blue_as_other_readers_see_it(tmp_path: Path) -> None:
    red = np.zeros((8, 8, 3), dtype=np.uint8)
    red[..., 0] = 200
    write_image(tmp_path / "red.png", red)
    write_image(tmp_path / "red.tif", red)
    assert cv2.imread(str(tmp_path / "red.png"))[0, 0].tolist() == [0, 0, 200]
    assert tifffile.imread(tmp_path / "red.tif")[0, 0].tolist() == [200, 0, 0]


def test_a_stack_keeps_its_pages_in_order(tmp_path: Path) -> None:
    pages = image_of(np.uint16, (4, 9, 13))
    path = tmp_path / "stack.tif"
    with open_writer(path, 4) as writer:
        for page in pages:
            writer.append(page)
    stack = read_stack(path)
    assert (stack.pages, stack.shape, stack.dtype) == (4, (9, 13), np.uint16)
    np.testing.assert_array_equal(np.stack(list(stack)), pages)
    np.testing.assert_array_equal(tifffile.imread(path), pages)


def test_a_failure_half_way_leaves_the_old_file_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    old = image_of(np.uint8, (9, 13))
    write_image(path, old)

    def write_two() -> None:
        with open_writer(path, 2) as writer:
            writer.append(old)
            writer.append(old.astype(np.float32))

    with pytest.raises(InputError, match="float32"):
        write_two()
    np.testing.assert_array_equal(read_image(path), old)
    assert [p.name for p in tmp_path.iterdir()] == ["stack.tif"]


def test_a_missing_foreign_or_broken_file_is_refused(tmp_path: Path) -> None:
    whole = tmp_path / "whole.tif"
    write_image(whole, image_of(np.uint16, (64, 64)))
    content = whole.read_bytes()
    (tmp_path / "cut.tif").write_bytes(content[: len(content) // 3])
    (tmp_path / "head.tif").write_bytes(content[:6])
    (tmp_path / "empty.tif").write_bytes(b"")
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "image.jpg").write_bytes(b"")
    for name in ("absent.tif", "cut.tif", "head.tif", "empty.tif", "empty.png", "text.png", "image.jpg"):
        with pytest.raises(InputError, match=name):
            read_image(tmp_path / name)


def test_other_depths_and_channels_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "real.tif", np.ones((8, 8), dtype=np.float32))
    cv2.imwrite(str(tmp_path / "alpha.png"), np.ones((8, 8, 4), dtype=np.uint8))
    for name in ("real.tif", "alpha.png"):
        with pytest.raises(InputError, match="8 or 16 bit"):
            read_image(tmp_path / name)
    with pytest.raises(InputError, match="8 or 16 bit"):
        write_image(tmp_path / "out.png", np.ones((8, 8), dtype=np.int32))


def test_a_stack_is_not_one_image_and_its_pages_must_agree(tmp_path: Path) -> None:
    path = tmp_path / "mixed.tif"
    with tifffile.TiffWriter(path) as file:
        file.write(image_of(np.uint8, (9, 13)), photometric="minisblack")
        file.write(image_of(np.uint8, (9, 14)), photometric="minisblack")
    with pytest.raises(InputError, match="2 pages"):
        read_image(path)
    with pytest.raises(InputError, match="page 2"):
        list(read_stack(path))


def test_names_and_places_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    image = image_of(np.uint8, (9, 13))
    with pytest.raises(InputError, match=r"\.png or \.tif"):
        write_image(tmp_path / "image.jpg", image)
    with pytest.raises(InputError, match="holds one"), open_writer(tmp_path / "stack.png", 2):
        pass
    with pytest.raises(InputError, match="cannot be written"):
        write_image(tmp_path / "nowhere" / "image.png", image)
    assert not list(tmp_path.iterdir())
