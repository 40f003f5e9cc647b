"""`adof selftest` and the cases it shares with the tests: every kernel is asked, a wrong one is caught."""

from __future__ import annotations

import copy
import json
import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from adof_cl import program, reference, selftest
from adof_cl.cli import main
from adof_cl.device import Device
from adof_cl.program import Launch, Program
from adof_cl.selftest import OPERATIONS, Operation, Outcome
from cases import CASES

KERNELS = {
    (path.name, kernel)
    for path in program.kernel_folder().glob("*.cl")
    for kernel in re.findall(r"__kernel[^;{]*?\b(\w+)\(\s*__global", path.read_text())
}

# One slip in the code of each kernel function, and in each form of those that have several.
SLIPS = [
    ("pupil_phase.cl", "pupil_phase_axis", "has_odd ? f + odd[i] : f", "f"),
    ("pupil_phase.cl", "pupil_phase", "x_turns[column] + y_turns[row]", "x_turns[column] - y_turns[row]"),
    ("slm_encode.cl", "slm_encode_axis", "axis_turns[i] = phase_turns(", "axis_turns[i] = -phase_turns("),
    ("slm_encode.cl", "slm_encode", "+ REAL_C(0.5)) & 255", "+ REAL_C(0.49)) & 255"),
    ("otf.cl", "otf_1d", "side * h.im * TERM", "h.im * TERM"),
    ("otf.cl", "otf_1d", "REVERSED(-im)", "REVERSED(im)"),
    ("otf.cl", "otf_1d", "i < place.z", "i < place.z - 1"),
    ("otf.cl", "otf_1d", "row[place.y] = (cplx)(re, -im)", "row[place.y] = (cplx)(re, im)"),
    ("otf.cl", "otf_1d", "const vec k_low = passed ? -k : k;", "const vec k_low = k;"),
    ("otf.cl", "otf_1d", "p.x < edge.x ?", "p.x < a.x ?"),
    ("otf.cl", "otf_1d", "within ? sum.im : h.im", "h.im"),
    ("otf.cl", "otf_field", "if (i < n) value", "if (i < n - 1) value"),
    ("otf.cl", "otf_fft", "0, 1, m, s, j, sign)", "0, 1, m, s, j, 1)"),
    ("otf.cl", "otf_power", "scale * cplx_mul(f, cplx_conj(f))", "scale * cplx_mul(f, f)"),
    ("otf.cl", "otf_half", "otf[j] = j < n ? field[j]", "otf[j] = j < n - 1 ? field[j]"),
    ("psf.cl", "psf_panel", "codes[row_of[row]", "codes[row_of[column]"),
    ("psf.cl", "psf_field", "amplitude[i] * turns_cis(turns[i])", "turns_cis(turns[i])"),
    ("psf.cl", "psf_fft", "along_rows ? 1 : m, m, s, j, sign", "along_rows ? 1 : m, m, s, j, -sign"),
    ("psf.cl", "psf_intensity", "psf[i] = value.x;", "psf[i] = value.x * REAL_C(1.00001);"),
    ("wiener.cl", "wiener_axes", "wiener_axis(h_cols + cols_from, X, nx)),", "wiener_axis(h_rows, X, nx)),"),
    ("restore_lanes.cl", "restore_frame", "bin + NX,", "bin,"),
    ("restore_groups.cl", "restore_columns", "bin[NY + block", "bin[block"),
    (
        "wiener.cl",
        "wiener_spectrum",
        "otf[WIENER_AT(Y, X)], WIENER_NOISE",
        "otf[WIENER_AT(X, Y)], WIENER_NOISE",
    ),
    ("wiener.cl", "wiener_arrange", "(scale * gain[WIENER_AT(Y, X)])", "(gain[WIENER_AT(Y, X)])"),
    ("restore_lanes.cl", "restore_frame", "SCALED(q[0] - p[0])", "SCALED(q[0])"),
    ("restore_lanes.cl", "restore_frame", "row_blend[x - COLS]", "0"),
    ("restore_lanes.cl", "restore_frame", "p == q ? br :", "p == q ? 0 :"),
    ("restore_groups.cl", "restore_rows_forward", "SCALED(re[q] - re[p])", "SCALED(re[q])"),
    ("restore_groups.cl", "restore_columns", "column_blend[y - ROWS]", "0"),
    ("restore_groups.cl", "restore_rows_inverse", "p == q ? br :", "p == q ? 0 :"),
    ("image_prep.cl", "image_prep", "(top + row) * frame_columns + left", "row * frame_columns + left"),
    # lanes, then groups
    ("ssd_search.cl", "ssd_search", "- 2 * cross[k][j];", "- 2 * cross[k][j] + 1;"),
    ("ssd_search.cl", "ssd_search", "if (c + 1 == TEMPLATE_COLUMNS) value.odd = 0;", ""),
    (
        "ssd_search.cl",
        "ssd_search",
        "along[k] += difference * difference;",
        "along[k] += difference;",
    ),  # groups
    ("ssd_search.cl", "ssd_search_best", "ny <= y + 1", "ny < y + 1"),
]


def run(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    return int(exit_.value.code or 0)


def operation_of(file: str) -> Operation:
    return next(op for name, op in OPERATIONS.items() if file.startswith(name))


@pytest.fixture
def only_otf(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selftest, "OPERATIONS", {"otf": OPERATIONS["otf"]})


@pytest.mark.parametrize(
    ("name", "size", "of_precision"),
    [
        pytest.param(name, size, precision, id=f"{name}-{size[0]}x{size[1]}-{precision}")
        for name, case in CASES.items()
        for size in case.sizes
        for precision in case.precisions
    ],
)
def test_the_device_agrees_with_the_reference(
    device: Device, name: str, size: tuple[int, int], of_precision: str
) -> None:
    if of_precision == "float64" and not device.facts.fp64:
        pytest.skip(f"{device.facts} has no float64")
    outcomes = list(CASES[name].check(device, size, of_precision))
    assert outcomes
    assert [o for o in outcomes if not o.ok] == []


def test_every_kernel_function_is_launched_and_named_by_its_outcome(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    known: list[tuple[Launch, tuple[str, str]]] = []
    launched: set[tuple[str, str]] = set()
    bind, enqueue = Program.launch, Launch.__call__

    def recorded_bind(self: Program, kernel: str, *arguments: Any) -> Launch:
        launch = bind(self, kernel, *arguments)
        known.append((launch, (self._name, kernel)))
        return launch

    def recorded_enqueue(self: Launch) -> Any:
        # What a plan asks of the compiler itself is in no file.
        launched.update(name for launch, name in known if launch is self and name[0].endswith(".cl"))
        return enqueue(self)

    monkeypatch.setattr(Program, "launch", recorded_bind)
    monkeypatch.setattr(Launch, "__call__", recorded_enqueue)
    named = {kernel for o in selftest.run(device, small=True) for kernel in o.kernels}
    assert {(file, kernel) for file, kernel in launched if file.endswith(".cl")} == KERNELS
    assert named == {kernel for _, kernel in KERNELS}


def test_every_kernel_function_has_a_slip_to_catch() -> None:
    assert {(file, kernel) for file, kernel, _, _ in SLIPS} == KERNELS


@pytest.mark.parametrize(
    ("file", "kernel", "right", "wrong"), SLIPS, ids=[f"{s[0][:-3]}-{s[1]}-{i}" for i, s in enumerate(SLIPS)]
)
def test_a_slip_in_any_kernel_is_caught(
    device: Device, monkeypatch: pytest.MonkeyPatch, file: str, kernel: str, right: str, wrong: str
) -> None:
    read = program._read

    def slipped(name: str) -> str:
        text = read(name)
        if name == file:
            assert right in text, f"{file} no longer holds this line: choose another slip"
            text = text.replace(right, wrong)
        return text

    monkeypatch.setattr(program, "_read", slipped)
    operation = operation_of(file)
    outcomes = operation.check(device, operation.small, "float32")
    missed = next((o for o in outcomes if not o.ok), None)
    assert missed is not None
    assert kernel in missed.kernels


@pytest.mark.usefixtures("only_otf")
def test_a_wrong_answer_is_printed_and_exits_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    exact = reference.otf_1d
    monkeypatch.setattr(reference, "otf_1d", lambda *arguments: exact(*arguments) + 1e-5)
    assert run(["selftest", "--small"]) == 1
    lines = capsys.readouterr().out.splitlines()
    failed = [line for line in lines if line.startswith("FAILED")]
    assert failed
    assert all("otf exact" in line and "1.0e-05" in line for line in failed)
    assert lines[-1].startswith(f"{len(lines) - 3} known answers, {len(failed)} failed")


@pytest.mark.usefixtures("only_otf")
def test_what_a_driver_throws_is_that_kernels_failure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lost(*_: object, **__: object) -> None:
        raise RuntimeError("device lost")

    monkeypatch.setattr(selftest, "Otf1d", lost)
    assert run(["selftest", "--small"]) == 1
    assert "otf, float32: RuntimeError: device lost" in capsys.readouterr().out


def test_a_kernel_that_does_not_compile_fails_with_its_file_and_line(
    device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(selftest, "OPERATIONS", {"pupil_phase": OPERATIONS["pupil_phase"]})
    read = program._read

    def broken(name: str) -> str:
        return read(name).replace("turns_wrap(", "turns_warp(") if name.endswith(".cl") else read(name)

    monkeypatch.setattr(program, "_read", broken)
    outcomes = list(selftest.run(device, small=True))
    assert outcomes
    assert not any(o.ok for o in outcomes)
    assert all("pupil_phase.cl:51" in o.failure for o in outcomes)


@pytest.mark.usefixtures("only_otf")
def test_the_json_form_holds_every_answer(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["selftest", "--small", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["ok"] is True
    assert {"name", "index", "fp64"} <= set(printed["device"])
    assert {"name", "kernels", "measure", "error", "bound", "failure", "ok"} == set(printed["answers"][0])


@pytest.mark.usefixtures("only_otf")
def test_a_device_without_float64_is_tested_in_float32(device: Device) -> None:
    plain = copy.copy(device)
    plain.facts = replace(device.facts, fp64=False)
    names = [o.name for o in selftest.run(plain, small=True)]
    assert names
    assert all("float32" in name for name in names)


def test_an_unknown_device_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["selftest", "--device", "abacus"]) == 2
    printed = capsys.readouterr()
    assert not printed.out
    assert printed.err.startswith("adof: no OpenCL device fits 'abacus'")


@pytest.mark.parametrize("error", [math.nan, math.inf, 2.0])
def test_no_answer_and_nan_are_never_ok(error: float) -> None:
    assert not Outcome("x", (), "", error, 1.0).ok


def test_nan_in_an_answer_counts_as_infinite() -> None:
    spoilt = np.array([0.0, np.nan])
    assert selftest._largest(spoilt) == math.inf
    assert selftest._relative(spoilt, np.ones(2)) == math.inf
    assert selftest._wrapped(spoilt, np.zeros(2)) == math.inf
    assert selftest._worst("", (), "", spoilt, np.ones(2)).error == math.inf
