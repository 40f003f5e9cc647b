from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_cl.device import Device, DeviceFacts, choose, list_devices
from adof_cl.errors import DeviceError, InputError
from adof_cl.program import Program

_ADD = "__kernel void add(__global int *values) { values[get_global_id(0)] += 1; }\n"


def facts(index: int, name: str, platform: str, kind: str, *, simulated: bool = False) -> DeviceFacts:
    return DeviceFacts(
        index, name, platform, kind, "OpenCL 3.0", "1", True, 2, 32768, 2**30, 2**28, 256, 64, 0, simulated
    )


FOUND = [
    facts(0, "Oclgrind Simulator", "Oclgrind", "cpu", simulated=True),
    facts(1, "Some CPU", "Portable Computing Language", "cpu"),
    facts(2, "Some GPU", "Vendor", "gpu"),
    facts(3, "FPGA Emulation Device", "Vendor FPGA", "accelerator", simulated=True),
]


def test_a_gpu_is_chosen_before_a_cpu() -> None:
    assert choose(FOUND).name == "Some GPU"


def test_a_cpu_is_chosen_where_there_is_no_gpu() -> None:
    assert choose(FOUND[:2] + FOUND[3:]).name == "Some CPU"


def test_a_simulator_is_never_chosen_by_itself_nor_by_type() -> None:
    only_simulators = [FOUND[0], FOUND[3]]
    with pytest.raises(DeviceError, match="but simulators"):
        choose(only_simulators)
    with pytest.raises(DeviceError, match="no OpenCL device fits 'cpu'"):
        choose(only_simulators, "cpu")


@pytest.mark.parametrize(
    ("selector", "index"), [("0", 0), ("oclgrind", 0), ("GPU", 2), ("cpu", 1), ("some c", 1), ("portable", 1)]
)
def test_a_selector_names_an_index_a_type_or_part_of_a_name(selector: str, index: int) -> None:
    assert choose(FOUND, selector).index == index


def test_pocl_is_found_by_the_name_people_know() -> None:
    pocl = dataclasses.replace(FOUND[1], version="OpenCL 3.0 PoCL HSTR")
    assert choose([pocl], "pocl") == pocl


@given(st.text(alphabet=st.characters(codec="ascii", categories=("L", "N", "P")), min_size=1, max_size=12))
def test_a_selector_picks_what_it_names_or_is_refused_with_the_list(selector: str) -> None:
    word = selector.lower()
    named = [d for d in FOUND if word in f"{d.name} {d.platform} {d.version}".lower()]
    fits = {d.index for d in named} | {d.index for d in FOUND if word == d.kind}
    if word.isdecimal():
        fits = {int(word)} & {d.index for d in FOUND}
    if fits:
        assert choose(FOUND, selector).index in fits
    else:
        with pytest.raises(DeviceError, match="Some GPU"):
            choose(FOUND, selector)


def test_a_platforms_name_counts_before_a_processors() -> None:
    pocl_on_a_vendors_cpu = facts(0, "pthread-Vendor Xeon", "Portable Computing Language", "cpu")
    the_vendors = facts(1, "Xeon", "Vendor OpenCL", "cpu")
    assert choose([pocl_on_a_vendors_cpu, the_vendors], "vendor") == the_vendors


def test_every_index_of_the_listing_names_its_own_device() -> None:
    devices = list_devices()
    assert [choose(devices, str(d.index)).index for d in devices] == list(range(len(devices)))


def test_facts_survive_json(device: Device) -> None:
    assert json.loads(json.dumps(device.facts.as_dict())) == device.facts.as_dict()


def test_what_is_uploaded_comes_back(device: Device) -> None:
    values = np.random.default_rng(1).normal(size=(7, 13)).astype(np.float32)
    assert np.array_equal(device.upload(values).download(), values)


@pytest.mark.parametrize("shape", [(7, 13), (301, 403)], ids=["small", "large"])
@pytest.mark.parametrize("copies_apart", [False, True])
def test_a_copy_in_two_halves_is_the_one_begun_whatever_is_uploaded_since(
    device: Device, shape: tuple[int, int], copies_apart: bool
) -> None:
    opened = Device(device.facts, device.handle, copies_apart=copies_apart)
    array = opened.empty(shape, np.float32)
    assert not array.arrived
    with pytest.raises(InputError, match="nothing was staged"):
        array.send()
    first, second, third = np.random.default_rng(1).normal(size=(3, *shape)).astype(np.float32)
    staged = second.copy()
    array.stage(first)
    array.stage(staged)
    staged[:] = 0  # the host's own again
    array.send().begin_download()
    opened.wait()
    assert array.arrived
    array.upload(third)
    assert np.array_equal(array.download(), second)
    assert not array.arrived
    out = np.empty(shape, np.float32)
    assert array.download(out) is out
    assert np.array_equal(out, third)


@pytest.mark.parametrize("shares", [True, False])
def test_a_shared_array_holds_what_kernels_wrote_and_keeps_what_came_before(
    device: Device, monkeypatch: pytest.MonkeyPatch, shares: bool
) -> None:
    monkeypatch.setattr(device, "_shares_memory", shares and device._shares_memory)
    array = device.shared((1000,), np.int32)
    add = Program(device, "precision.h", generated=("add.cl", _ADD)).launch("add", (1000,), (1,), array)
    array.upload(np.arange(1000, dtype=np.int32))
    earlier = []
    for _ in range(3):
        add()
        earlier.append(array.download())
    add()
    array.begin_download()
    device.wait()
    assert array.arrived
    earlier.append(array.download())
    assert not array.arrived
    for n, values in enumerate(earlier):
        assert np.array_equal(values, np.arange(1000) + n + 1)


@pytest.mark.parametrize("shape", [(2, 3), (301, 403)], ids=["small", "large"])
def test_what_was_uploaded_is_the_hosts_own_again(device: Device, shape: tuple[int, int]) -> None:
    array = device.empty(shape, np.int32)
    values = np.empty(shape, np.int32)
    found = []
    for k in range(20):
        values[:] = k
        array.upload(values)
        values[:] = -1
        found.append(array.download())
    for k, seen in enumerate(found):
        assert (seen == k).all()


def test_an_array_of_another_shape_or_type_is_refused_and_nothing_changed(device: Device) -> None:
    array = device.upload(np.arange(6, dtype=np.float32).reshape(2, 3))
    for wrong in (np.zeros((3, 2), np.float32), np.zeros((2, 3), np.float64)):
        for refused in (array.upload, array.stage):
            with pytest.raises(InputError, match="was wanted"):
                refused(wrong)
    with pytest.raises(InputError, match="out is"):
        array.download(np.zeros((2, 3), np.float64))
    assert np.array_equal(array.download(), np.arange(6, dtype=np.float32).reshape(2, 3))


def test_an_array_larger_than_the_device_allows_is_refused(device: Device) -> None:
    too_many = device.facts.max_allocation_bytes // 4 + 1
    with pytest.raises(DeviceError, match="allocates at most"):
        device.empty((too_many,), np.float32)


def test_an_unknown_precision_is_refused(device: Device) -> None:
    with pytest.raises(InputError, match="float16"):
        device.real_type("float16")


def _python(code: str, **environment: str) -> str:
    import os

    merged = {k: v for k, v in os.environ.items() if k != "POCL_AFFINITY"} | environment
    return subprocess.run(
        [sys.executable, "-c", code], env=merged, capture_output=True, text=True, check=True
    ).stdout.strip()


def test_pocl_workers_are_pinned_unless_the_user_said_otherwise() -> None:
    code = "import adof_cl.device, os; print(os.environ['POCL_AFFINITY'])"
    assert _python(code) == "1"
    assert _python(code, POCL_AFFINITY="0") == "0"


def test_without_any_opencl_the_refusal_says_what_to_install() -> None:
    code = """
import pyopencl as cl
def none(): raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")
cl.get_platforms = none
from adof_cl.cli import main
main(["devices"])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert "pip install pocl-binary-distribution" in run.stderr
    assert "Traceback" not in run.stderr


def test_optics_and_reference_work_without_opencl() -> None:
    code = "import sys; sys.modules['pyopencl'] = None; import adof_cl.optics, adof_cl.reference; print('ok')"
    assert _python(code) == "ok"
