from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import tifffile

from adof_cl import reference
from adof_cl.cli import main
from adof_cl.device import Device
from adof_cl.image_files import read_image, read_stack, write_image
from adof_cl.optics import OpticalSystem
from adof_cl.otf import Otf1d
from adof_cl.restore import Restore


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["restore", *map(str, arguments)])
    return int(ended.value.code or 0)


def scene(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.full(shape, 30.0)
    for y, x in rng.integers(0, min(shape) - 8, (40, 2)):
        image[y : y + 7, x : x + 9] = rng.integers(30, 220)
    return image


def coded(image: np.ndarray, alpha: float, depth_um: float) -> np.ndarray:
    """Blur circularly by the exact OTF of a mask and a depth."""
    optics = OpticalSystem()
    axes = [reference.otf_1d(optics.frequency_axis(n), alpha, optics.psi_rad(depth_um)) for n in image.shape]
    for axis in axes:
        if axis.size % 2 == 0:
            axis[axis.size // 2] = axis[axis.size // 2].real
    return np.fft.ifft2(np.fft.fft2(image) * np.outer(*axes)).real


def rms(found: np.ndarray, wanted: np.ndarray, edge: int = 24) -> float:
    inside = np.s_[edge:-edge, edge:-edge]
    return float(np.sqrt(np.mean((found.astype(float) - wanted)[inside] ** 2)))


@pytest.mark.parametrize(("dtype", "unit"), [(np.uint8, 1), (np.uint16, 256)])
def test_a_coded_picture_of_known_depth_is_sharpened_in_its_own_depth_of_code(
    device: Device, tmp_path: Path, dtype: type, unit: int
) -> None:
    sharp = scene((120, 136))
    blurred = np.clip(np.round(unit * coded(sharp, 20, 1000)), 0, np.iinfo(dtype).max).astype(dtype)
    write_image(tmp_path / "in.tif", blurred)
    options = ("--alpha", 20, "--depth-um", 1000, "--device", device.facts.index)
    assert run(tmp_path / "in.tif", tmp_path / "out.png", *options) == 0
    restored = read_image(tmp_path / "out.png")
    assert restored.dtype == dtype
    assert rms(restored / unit, sharp) < 0.5 * rms(blurred / unit, sharp)
    wrong = ("--alpha", 20, "--depth-um", -3000, "--device", device.facts.index)
    assert run(tmp_path / "in.tif", tmp_path / "wrong.png", *wrong) == 0
    assert rms(read_image(tmp_path / "wrong.png") / unit, sharp) > rms(restored / unit, sharp)


def test_a_measured_psf_offset_and_a_hot_pixel_are_undone(device: Device, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    sharp = np.zeros((90, 100))
    sharp[40:50, 30:42] = 200.0
    sharp[45:52, 50:60] = 120.0
    psf = np.zeros((90, 100))
    for y, x in rng.integers((30, 35), (60, 65), (60, 2)):
        psf[y : y + 3, x : x + 3] += rng.random()
    otf = np.fft.rfft2(np.fft.ifftshift(psf / psf.sum()))
    picture = (
        400 + 50 * np.fft.irfft2(np.fft.rfft2(sharp) * otf, s=sharp.shape) + rng.normal(0, 3, sharp.shape)
    )
    picture[0, 0] = 60_000
    write_image(tmp_path / "raw.tif", np.clip(picture, 0, 65535).astype(np.uint16))
    write_image(tmp_path / "psf.tif", (500 + 3000 * psf).astype(np.uint16))
    options = ("--psf", tmp_path / "psf.tif", "--device", device.facts.index)
    assert run(tmp_path / "raw.tif", tmp_path / "out.tif", *options) == 0
    found = read_image(tmp_path / "out.tif").astype(float)
    assert np.corrcoef(found.ravel(), sharp.ravel())[0, 1] > 0.9
    assert np.corrcoef(picture.ravel(), sharp.ravel())[0, 1] < 0.6
    assert found.max() == 65535
    assert np.median(found[sharp == 0]) < 0.02 * 65535


def test_a_stack_is_restored_page_by_page_and_each_colour_by_itself(device: Device, tmp_path: Path) -> None:
    pages = np.stack([np.round(coded(scene((64, 80), seed), 10, 0)) for seed in range(3)])
    pages = np.clip(pages, 0, 255).astype(np.uint8)
    tifffile.imwrite(tmp_path / "stack.tif", pages, photometric="minisblack")
    write_image(tmp_path / "colour.png", np.ascontiguousarray(np.moveaxis(pages, 0, -1)))
    options = ("--alpha", 10, "--depth-um", 0, "--nsr", "0.01", "--device", device.facts.index)
    assert run(tmp_path / "stack.tif", tmp_path / "out.tif", *options) == 0
    assert run(tmp_path / "colour.png", tmp_path / "out.png", *options) == 0
    stack = np.stack(list(read_stack(tmp_path / "out.tif")))
    np.testing.assert_array_equal(np.moveaxis(read_image(tmp_path / "out.png"), -1, 0), stack)
    write_image(tmp_path / "one.png", pages[1])
    assert run(tmp_path / "one.png", tmp_path / "one.tif", *options) == 0
    np.testing.assert_array_equal(read_image(tmp_path / "one.tif"), stack[1])


@pytest.mark.parametrize("colours", [1, 3])
def test_a_stack_is_to_the_last_bit_what_its_pages_are_one_at_a_time(
    device: Device, tmp_path: Path, colours: int
) -> None:
    shape = (67, 81, 3) if colours == 3 else (67, 81)
    pages = np.random.default_rng(4).integers(0, 65536, (7, *shape), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "in.tif", pages, photometric="rgb" if colours == 3 else "minisblack")
    options = ("--alpha", 10, "--depth-um", 500, "--nsr", "0.01", "--white", 99, "--offset", 100)
    assert run(tmp_path / "in.tif", tmp_path / "out.tif", *options, "--device", device.facts.index) == 0

    optics = OpticalSystem()
    psi = optics.psi_rad(500)
    plan = Restore(device, shape[:2], padding=16 + math.ceil(optics.support_px(10, psi)))
    axes = [Otf1d(device, optics.frequency_axis(n)).evaluate(10, psi) for n in plan.padded_shape]
    plan.set_filter_axes(*axes, 0.01)
    planes = pages.astype(np.float32).reshape(7, 67, 81, colours) - np.float32(100)
    images = np.array(
        [[plan.restore(np.ascontiguousarray(p[..., c])) for c in range(colours)] for p in planes]
    )
    images = np.moveaxis(images, 1, -1).reshape(pages.shape)
    scale = 65535 / float(np.percentile(images[0], 99))
    wanted = np.clip(np.floor(images * scale + 0.5), 0, 65535).astype(np.uint16)
    np.testing.assert_array_equal(np.stack(list(read_stack(tmp_path / "out.tif"))), wanted)


def test_a_page_of_another_kind_is_named_and_leaves_no_file(
    device: Device, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with tifffile.TiffWriter(tmp_path / "in.tif") as writer:
        for columns in (40, 40, 40, 41, 40):
            writer.write(np.ones((32, columns), np.uint8), contiguous=False, metadata=None)
    options = (*CODED, "--device", device.facts.index)
    assert run(tmp_path / "in.tif", tmp_path / "out.tif", *options) == 2
    said = capsys.readouterr()
    assert "page 4 is (32, 41) uint8" in said.err
    assert not said.out
    assert [path.name for path in tmp_path.iterdir()] == ["in.tif"]


def test_the_hand_in_a_real_diffuser_capture_comes_out(
    device: Device, tmp_path: Path, shared_folder: Path
) -> None:
    folder = shared_folder / "data" / "coded_capture"
    options = ("--psf", folder / "psf.tif", "--device", device.facts.index)
    assert run(folder / "raw.tif", tmp_path / "hand.tif", *options) == 0
    hand = read_image(tmp_path / "hand.tif").astype(float)
    assert hand.shape == (1200, 1600)
    palm, background = hand[530:740, 760:1080], hand[900:1150, 100:700]
    assert palm.mean() > 8 * background.mean()
    # Fingers: three bright bands apart, from top to bottom, right of the palm.
    bands = hand[460:720, 1180:1290].mean(axis=1)
    smooth = np.convolve(bands, np.ones(9) / 9, mode="same")
    above = smooth > 0.5 * smooth.max()
    assert np.count_nonzero(np.diff(above.astype(int)) == 1) >= 2
    raw = tifffile.imread(folder / "raw.tif").astype(float)
    assert raw[530:740, 760:1080].mean() < 4 * raw[900:1150, 100:700].mean()


@pytest.fixture
def files(tmp_path: Path) -> Path:
    write_image(tmp_path / "in.tif", scene((40, 48)).astype(np.uint8))
    write_image(tmp_path / "psf.tif", np.eye(9, dtype=np.uint8) * 9)
    write_image(tmp_path / "wide.tif", np.ones((9, 49), dtype=np.uint8))
    write_image(tmp_path / "dark.tif", np.zeros((9, 9), dtype=np.uint8))
    write_image(tmp_path / "colour.tif", np.ones((9, 9, 3), dtype=np.uint8))
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    return tmp_path


CODED = ("--alpha", "20", "--depth-um", "0")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("in.tif", "out.tif"), "give either"),
        (("in.tif", "out.tif", *CODED, "--psf", "psf.tif"), "give either"),
        (("in.tif", "out.tif", "--alpha", "20"), "--depth-um"),
        (("in.tif", "out.tif", "--psf", "psf.tif", "--depth-um", "3"), "has no depth"),
        (("absent.tif", "out.tif", *CODED), "not there"),
        (("broken.tif", "out.tif", *CODED), "cannot be read"),
        (("in.tif", "out.jpg", *CODED), ".png or .tif"),
        (("in.tif", "nowhere/out.tif", *CODED), "cannot be written"),
        (("in.tif", "out.tif", *CODED, "--nsr", "-1"), "0 or more"),
        (("in.tif", "out.tif", *CODED, "--nsr", "nan"), "finite"),
        (("in.tif", "out.tif", *CODED, "--nsr", "low"), "finite"),
        (("in.tif", "out.tif", *CODED, "--white", "101"), "percentile"),
        (("in.tif", "out.tif", *CODED, "--precision", "half"), "precision"),
        (("in.tif", "out.tif", "--alpha", "nan", "--depth-um", "0"), "nan"),
        (("in.tif", "out.tif", "--alpha", "20", "--depth-um", "inf"), "inf"),
        (("in.tif", "out.tif", "--alpha", "20", "--depth-um", "-65000"), "lens"),
        (("in.tif", "out.tif", *CODED, "--device", "no such device"), "no OpenCL device fits"),
        (("in.tif", "out.tif", "--psf", "absent.tif"), "not there"),
        (("in.tif", "out.tif", "--psf", "wide.tif"), "crop the PSF"),
        (("in.tif", "out.tif", "--psf", "dark.tif"), "sums to 0"),
        (("in.tif", "out.tif", "--psf", "colour.tif"), "grey PSF"),
    ],
)
def test_bad_input_gets_one_sentence_and_leaves_no_file(
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    said: str,
) -> None:
    monkeypatch.chdir(files)
    before = sorted(p.name for p in files.iterdir())
    assert run(*arguments) == 2
    captured = capsys.readouterr()
    assert said in captured.err
    assert "Traceback" not in captured.err
    assert not captured.out
    assert sorted(p.name for p in files.iterdir()) == before
