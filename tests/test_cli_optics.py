from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

import tolerances
from adof_cl import reference
from adof_cl.cli import main
from adof_cl.optics import OpticalSystem
from adof_cl.slm_encode import stroke_table

OPTICS = OpticalSystem()


def run(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    return int(exit_.value.code or 0)


@pytest.mark.parametrize("precision", ["float32", None])
def test_otf_prints_exactly_the_asked_frequencies_as_json(
    capsys: pytest.CaptureFixture[str], precision: str | None
) -> None:
    options = [] if precision is None else ["--precision", precision]
    frequencies = [0.44, -0.77, 0.0, 2.5]
    asked = [word for u in frequencies for word in ("--u", str(u))]
    assert run(["otf", "--alpha", "53.5", "--psi", "-15", *asked, "--json", *options]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [set(row) for row in printed] == [{"u", "re", "im"}] * 4
    assert [row["u"] for row in printed] == frequencies
    values = np.array([row["re"] + 1j * row["im"] for row in printed])
    error = np.abs(values - reference.otf_1d(frequencies, 53.5, -15.0)).max()
    assert error <= tolerances.otf_error("float32", 53.5)


def test_otf_prints_a_table_as_well(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["otf", "--u", "0.5", "--alpha", "0"]) == 0
    assert "0.75" in capsys.readouterr().out


def test_phase_writes_the_references_codes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mask.png"
    assert run(["phase", "--alpha", "30", "--focus-um", "2000", "--panel", "LC2002", "-o", str(out)]) == 0
    codes = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert codes is not None
    assert codes.dtype == np.uint8
    expected = reference.slm_encode(
        (600, 800), 312.5, stroke_table(2 * math.pi), 30.0, -OPTICS.psi_rad(2000.0)
    )
    difference = np.abs(codes.astype(int) - expected.astype(int))
    assert np.minimum(difference, 255 - difference).max() <= 1
    assert "HOLOEYE" in capsys.readouterr().out


@pytest.mark.parametrize("extra", [[], ["--stop", "round"], ["--panel", "LC2002", "--size", "512"]])
def test_psf_writes_a_transform_pair_with_axes_and_a_picture(tmp_path: Path, extra: list[str]) -> None:
    out = tmp_path / "psf.npz"
    assert run(["psf", "--alpha", "20", "--depth-um", "300", "-o", str(out), *extra]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"psf.npz", "psf.png"}
    with np.load(out) as arrays:
        psf, otf = arrays["psf"], arrays["otf"]
        assert np.abs(np.fft.fft2(psf) - otf).max() <= tolerances.fft_relative_l2("float32", psf.size)
        assert psf.sum() == pytest.approx(1, abs=tolerances.fft_relative_l2("float32", psf.size))
        assert arrays["x_um"].shape == arrays["u_x"].shape == (psf.shape[1],)
        assert arrays["y_um"].shape == arrays["u_y"].shape == (psf.shape[0],)
        assert float(arrays["psi_rad"]) == pytest.approx(OPTICS.psi_rad(300.0))
        u = arrays["u_x"]
        # On the axis, at a frequency u: H(u) times sinc(nu p), nu = u/(2 lambda N).
        if not extra:
            n = u.size // 2
            nu = u[:n] / (2 * OPTICS.wavelength_um * OPTICS.f_number)
            expected = reference.otf_1d(u[:n], 20.0, OPTICS.psi_rad(300.0)) * np.sinc(nu * 7.4)
            assert np.abs(otf[0, :n] - expected).max() <= tolerances.otf_error("float32", 20.0)


def test_dof_compares_both_calibrations_with_the_paper(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "dof.png"
    assert run(["dof", "--json", "--near-um", "0", "--far-um", "4000", "--plot", str(picture)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [point["position"] for point in report["points"]] == list("ABCDE")
    assert report["points"][0]["alpha_published"] == 53.5
    assert report["points"][0]["alpha_paper"] == pytest.approx(53.5, abs=0.0125)
    assert [row["lp_per_mm_published"] for row in report["resolution"]] == [53.0, 35.0]
    assert [(row["calibration"], row["joint"]) for row in report["chosen"]] == [
        ("paper", False),
        ("paper", True),
        ("model", False),
        ("model", True),
    ]
    assert cv2.imread(str(picture)) is not None
    assert run(["dof", "--near-um", "0", "--far-um", "30000"]) == 0
    printed = capsys.readouterr().out
    assert "published" in printed
    assert "deeper than it covers" in printed


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["otf", "--alpha", "nan", "--u", "1"], "alpha is nan"),
        (["otf", "--psi", "inf", "--u", "1"], "psi is inf"),
        (["otf", "--u", "nan"], "NaN"),
        (["otf", "--alpha", "1e9", "--u", "1"], "at most 100000"),
        (["otf", "--u", "1", "--precision", "half"], "choose 'float32' or 'float64'"),
        (["otf", "--u", "1", "--device", "no such thing"], "no OpenCL device fits"),
        (["phase", "--alpha", "200", "-o", "OUT.png"], "more than pi"),
        (["phase", "--panel", "PLUTO", "-o", "OUT.png"], "use a stop of at most 8640 um"),
        (["phase", "--panel", "none", "-o", "OUT.png"], "choose one of LC2002"),
        (["phase", "--alpha", "nan", "-o", "OUT.png"], "alpha_rad is nan"),
        (["phase", "--focus-um", "-65000", "-o", "OUT.png"], "the lens itself"),
        (["phase", "--stroke-rad", "7", "-o", "OUT.png"], "at most 2 pi"),
        (["phase", "-o", "OUT.jpg"], "name the output *.png"),
        (["phase", "-o", "absent/OUT.png"], "cannot be written"),
        (["psf", "--alpha", "1e4", "--stop", "round", "-o", "OUT.npz"], "at most 4096"),
        (["psf", "--alpha", "1e4", "-o", "OUT.npz", "--size", "64"], "choose one from"),
        (["psf", "--alpha", "100", "--stop", "round", "--size", "64", "-o", "OUT.npz"], "at least 191"),
        (["psf", "--stop", "oval", "-o", "OUT.npz"], "choose 'square' or 'round'"),
        (["psf", "--depth-um", "inf", "-o", "OUT.npz"], "depth_um is inf"),
        (["psf", "-o", "OUT.txt"], "wrong ending"),
        (["psf", "-o", "absent/OUT.npz"], "cannot be written"),
        (["psf", "-o", "OUT.npz", "--plot", "absent/OUT.png"], "cannot be written"),
        (["dof", "--near-um", "3"], "give both ends"),
        (["dof", "--threshold", "2"], "even in focus"),
        (["dof", "--plot", "absent/OUT.png"], "cannot be written"),
    ],
)
def test_bad_input_gets_one_sentence_exit_2_and_no_file(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert words in printed.err
    assert printed.err.startswith("adof: ")
    assert printed.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_option_exits_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["otf", "--bogus"]) == 2
    assert "--bogus" in capsys.readouterr().err
