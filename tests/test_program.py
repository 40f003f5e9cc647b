from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adof_cl import program as program_module
from adof_cl.device import Device
from adof_cl.errors import BuildError, InputError
from adof_cl.program import Program

SQUARE = """
#include "complex.h"   // a comment here must not hide the header
__kernel void square(__global cplx *values)
{
    const int i = get_global_id(0);
    values[i] = cplx_mul(values[i], values[i]) * (real)SCALE;
}
"""


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with our headers and one kernel, and a cache of its own."""
    folder = tmp_path / "kernels"
    folder.mkdir()
    for header in program_module.kernel_folder().glob("*.h"):
        (folder / header.name).write_text(header.read_text())
    (folder / "square.cl").write_text(SQUARE)
    monkeypatch.setattr(program_module, "kernel_folder", lambda: folder)
    monkeypatch.setenv("ADOF_CACHE_DIR", str(tmp_path / "cache"))
    return folder


def run(device: Device, scale: int = 3) -> list[complex]:
    values = device.upload(np.array([1j, 2], np.complex64))
    Program(device, "square.cl", {"SCALE": scale}).launch("square", (2,), None, values)()
    return [complex(v) for v in values.download()]


def entries(kernels: Path) -> list[Path]:
    return sorted((kernels.parent / "cache").glob("*.bin"))


def needs_cache(device: Device) -> None:
    if device.facts.simulated:
        pytest.skip("a simulator's programs are not cached")


@pytest.mark.usefixtures("kernels")
def test_defines_and_headers_reach_the_kernel(device: Device) -> None:
    assert run(device, 3) == [-3, 12]
    assert run(device, 5) == [-5, 20]


def test_a_devices_own_build_options_reach_every_program_and_its_cache_entry(
    device: Device, kernels: Path
) -> None:
    needs_cache(device)
    assert run(device) == [-3, 12]
    own = Device(device.facts, device.handle)
    own.build_options = ("-cl-denorms-are-zero",)
    assert run(own) == [-3, 12]
    assert len(entries(kernels)) == 2
    assert "-cl-denorms-are-zero" in Program(own, "square.cl", {"SCALE": 3}).options


def test_a_second_build_comes_from_the_cache_and_gives_the_same(device: Device, kernels: Path) -> None:
    needs_cache(device)
    first = run(device)
    (entry,) = entries(kernels)
    written = entry.stat().st_mtime_ns
    assert run(device) == first
    assert entry.stat().st_mtime_ns == written


def test_a_changed_header_is_another_entry(device: Device, kernels: Path) -> None:
    needs_cache(device)
    run(device)
    header = kernels / "complex.h"
    header.write_text(
        header.read_text().replace("a.x * b.y + a.y * b.x", "a.x * b.y + a.y * b.x + REAL_C(0.0)")
    )
    run(device)
    assert len(entries(kernels)) == 2


@pytest.mark.parametrize("damage", [b"", b"adof-cl program 1\n", b"\x00" * 4096])
def test_a_corrupt_entry_is_rebuilt(device: Device, kernels: Path, damage: bytes) -> None:
    needs_cache(device)
    run(device)
    (entry,) = entries(kernels)
    entry.write_bytes(damage)
    assert run(device) == [-3, 12]
    assert entry.read_bytes() != damage


def test_an_entry_cut_short_is_rebuilt(device: Device, kernels: Path) -> None:
    needs_cache(device)
    run(device)
    (entry,) = entries(kernels)
    entry.write_bytes(entry.read_bytes()[:-100])
    assert run(device) == [-3, 12]


def test_an_intact_entry_the_driver_refuses_is_rebuilt(device: Device, kernels: Path) -> None:
    needs_cache(device)
    run(device)
    (entry,) = entries(kernels)
    entry.unlink()
    program_module._store(entry, b"not a program of any driver")
    assert run(device) == [-3, 12]


@pytest.mark.usefixtures("kernels")
def test_a_cache_that_cannot_be_written_warns_and_works(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs_cache(device)
    blocked = tmp_path / "a file, not a folder"
    blocked.write_text("")
    monkeypatch.setenv("ADOF_CACHE_DIR", str(blocked / "cache"))
    with pytest.warns(UserWarning, match="could not be kept"):
        assert run(device) == [-3, 12]


def test_an_empty_cache_variable_means_no_cache(
    device: Device, kernels: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ADOF_CACHE_DIR", "")
    assert run(device) == [-3, 12]
    assert entries(kernels) == []


def test_two_processes_may_build_the_same_program_at_once(device: Device, kernels: Path) -> None:
    needs_cache(device)
    code = f"""
import pathlib, numpy as np
from adof_cl import program
from adof_cl.device import Device
program.kernel_folder = lambda: pathlib.Path({str(kernels)!r})
device = Device.open({str(device.facts.index)!r})
values = device.upload(np.array([1j, 2], np.complex64))
program.Program(device, "square.cl", {{"SCALE": 3}}).launch("square", (2,), None, values)()
print(values.download().real.tolist())
"""
    both = [
        subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    answers = [process.communicate(timeout=120) for process in both]
    assert [out.strip() for out, _ in answers] == ["[-3.0, 12.0]"] * 2, answers
    assert len(entries(kernels)) == 1
    assert not list((kernels.parent / "cache").glob("*.part"))


def test_a_compile_error_names_the_file_and_the_line(device: Device, kernels: Path) -> None:
    (kernels / "square.cl").write_text(SQUARE.replace("values[i] = cplx_mul", "values[i] = no_such_function"))
    with pytest.raises(BuildError, match=r"(square\.cl|input\.cl):\d+") as refusal:
        run(device)
    if not device.facts.simulated:  # the simulator's front end ignores #line in the file's name
        assert "square.cl:6" in str(refusal.value)


@pytest.mark.usefixtures("kernels")
def test_a_missing_source_is_refused(device: Device) -> None:
    with pytest.raises(BuildError, match=r"absent\.cl is missing"):
        Program(device, "absent.cl")


@pytest.mark.usefixtures("kernels")
def test_the_wrong_number_of_arguments_is_refused(device: Device) -> None:
    built = Program(device, "square.cl", {"SCALE": 1})
    with pytest.raises(InputError, match="takes 1 arguments, 0 came"):
        built.launch("square", (1,), None)


def test_vectors_are_no_wider_than_the_registers_the_compiler_uses(device: Device) -> None:
    width = program_module.vector_bytes(device)
    assert width in (16, 32, 64)
    probe = """
    #if (VECTOR_BYTES > 32 && defined(__AVX__) && !defined(__AVX512F__)) \\
        || (VECTOR_BYTES > 16 && defined(__SSE2__) && !defined(__AVX__))
    #error "this width does not fit the registers"
    #endif
    """
    Program(device, "precision.h", {"VECTOR_BYTES": width}, generated=("probe.cl", probe))
    assert width <= max(16, device.facts.vector_bytes)
