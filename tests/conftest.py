"""The device under test: what ADOF_DEVICE names, else the default one."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from adof_cl.device import Device
from loopback import control_packets_elsewhere

hypothesis.settings.register_profile(
    "seeded", derandomize=True, deadline=None, max_examples=25, print_blob=True
)
hypothesis.settings.load_profile("seeded")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what runs on the device, so that another runtime can be asked for just that: -m kernel."""
    for item in items:
        if "device" in getattr(item, "fixturenames", ()):
            item.add_marker("kernel")


@pytest.fixture(scope="session", autouse=True)
def _kernel_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the tests' compiled kernels apart from the user's, unless the environment says where."""
    if "ADOF_CACHE_DIR" in os.environ:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ADOF_CACHE_DIR", str(tmp_path_factory.getbasetemp().parent / "adof-kernels"))
        yield


@pytest.fixture(scope="session")
def device(_kernel_cache: None) -> Device:
    return Device.open()


@pytest.fixture(params=["float32", "float64"])
def precision(request: pytest.FixtureRequest, device: Device) -> str:
    if request.param == "float64" and not device.facts.fp64:
        pytest.skip(f"{device.facts} has no float64")
    return str(request.param)


@pytest.fixture
def loopback_cameras() -> Iterator[None]:
    """Let one test at a time have the cameras' address and port, and see that it asks nobody elsewhere."""
    with (Path(tempfile.gettempdir()) / "adof-loopback-cameras.lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with control_packets_elsewhere() as seen:
            yield
        assert not seen, f"GigE Vision control packets left the machine: {seen}"


@pytest.fixture(scope="session")
def shared_folder() -> Path:
    folder = Path(__file__).parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("the shared data folder is absent")
    return folder
