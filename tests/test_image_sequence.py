from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from adof_drivers.errors import DriverError, EndOfSequenceError
from adof_drivers.image_sequence import ImageSequenceCamera

FRAMES = np.random.default_rng(3).integers(0, 65536, (3, 5, 7), dtype=np.uint16)


def served(camera: ImageSequenceCamera) -> list[np.ndarray]:
    frames = []
    while True:
        try:
            frames.append(camera.grab().pixels)
        except EndOfSequenceError:
            return frames


def test_a_stack_and_a_folder_of_its_pages_serve_the_same_frames_in_order(tmp_path: Path) -> None:
    stack = tmp_path / "stack.tif"
    tifffile.imwrite(stack, FRAMES, photometric="minisblack")
    folder = tmp_path / "pages"
    folder.mkdir()
    for number, frame in enumerate(FRAMES):
        assert cv2.imwrite(str(folder / f"{number:03}.png"), frame)
    for source in (stack, folder):
        assert np.array_equal(served(ImageSequenceCamera(source)), FRAMES)


def test_frames_are_numbered_and_timed_at_the_stated_rate(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "s.tif", FRAMES, photometric="minisblack")
    camera = ImageSequenceCamera(tmp_path / "s.tif", rate_hz=50.0)
    stamps = [(f.number, f.time_s) for f in (camera.grab(), camera.grab(), camera.grab())]
    assert stamps == [(0, 0.0), (1, 0.02), (2, 0.04)]


def test_a_frame_of_another_size_or_kind_is_refused(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "a.png"), FRAMES[0])
    assert cv2.imwrite(str(tmp_path / "b.png"), FRAMES[0][:4])
    camera = ImageSequenceCamera(tmp_path)
    camera.grab()
    with pytest.raises(DriverError, match="keep one size"):
        camera.grab()
    assert cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(DriverError, match="grey picture"):
        ImageSequenceCamera(tmp_path).grab()


@pytest.mark.parametrize("name", ["broken.png", "broken.tif"])
def test_a_file_that_is_no_picture_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"not a picture")
    with pytest.raises(DriverError, match="not a readable"):
        ImageSequenceCamera(tmp_path / name).grab()


def test_nothing_to_replay_or_a_rate_of_zero_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DriverError, match="holds no PNG or TIFF"):
        ImageSequenceCamera(tmp_path)
    with pytest.raises(DriverError, match="rate above 0"):
        ImageSequenceCamera(tmp_path, rate_hz=0)
