"""Open a HID device through hidapi, the kernel's hidraw before libusb."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from importlib import import_module
from typing import Any, Protocol

from adof_drivers.errors import DeviceLostError, DriverError

Identity = tuple[int, int]
"""USB vendor and product."""

_MOST_REPORTS = 1000  # of one poll; a device that sends more is not one of ours


class HidDevice(Protocol):
    """As hidapi's `device`, opened and set not to block: reading gives [] if nothing came."""

    def read(self, max_length: int) -> Sequence[int]: ...  # noqa: D102  (hidapi's own names)
    def write(self, buff: bytes) -> int: ...  # noqa: D102
    def send_feature_report(self, buff: bytes) -> int: ...  # noqa: D102
    def get_feature_report(self, report_num: int, max_length: int) -> Sequence[int]: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


def _backend() -> Any:
    """The module that goes through the kernel, else the one that takes the device away from it."""
    for name in ("hidraw", "hid"):
        try:
            module = import_module(name)
        except ImportError:
            continue
        # Another package is called hid too, and is made otherwise.
        if hasattr(module, "device"):
            return module
    raise DriverError(
        "hidapi is not installed, or hidden by the package `hid`: pip uninstall hid; pip install hidapi"
    )


def find(identities: Collection[Identity]) -> list[dict[str, Any]]:
    """Return what hidapi lists of the devices with one of these vendors and products."""
    listed = _backend().enumerate()
    return [one for one in listed if (one["vendor_id"], one["product_id"]) in identities]


def open_hid(name: str, identities: Collection[Identity], *, path: str | None = None) -> HidDevice:
    """Open the only device with one of `identities`, or the one at `path` (such as /dev/hidraw0).

    Raises
    ------
    DriverError
        None, several, or one that this user may not open.
    """
    if path is None:
        paths = sorted({one["path"] for one in find(identities)})
        if len(paths) != 1:
            listed = ", ".join(p.decode(errors="replace") for p in paths)
            known = ", ".join(f"{vendor:04x}:{product:04x}" for vendor, product in sorted(identities))
            raise DriverError(
                f"several devices are a {name}: {listed}; name one of these paths"
                if paths
                else f"no {name} is connected (looked for {known}): check its cable"
            )
        chosen = paths[0]
    else:
        chosen = path.encode()
    device = _backend().device()
    try:
        device.open_path(chosen)
        device.set_nonblocking(1)
    except OSError as failure:
        raise DriverError(
            f"{chosen.decode(errors='replace')} cannot be opened ({failure}): give this user the right to it "
            "with a udev rule, and close the program that holds it"
        ) from failure
    opened: HidDevice = device
    return opened


def reports(device: HidDevice, name: str) -> list[bytes]:
    """Return every report that came since the last call; does not wait.

    Raises
    ------
    DeviceLostError
        It was unplugged.
    """
    came: list[bytes] = []
    try:
        while len(came) < _MOST_REPORTS:
            report = bytes(device.read(64))
            if not report:
                break
            came.append(report)
    except (OSError, ValueError) as failure:  # ValueError: closed
        raise DeviceLostError(
            f"the {name} was unplugged ({failure}): plug it in and open it again"
        ) from failure
    return came
