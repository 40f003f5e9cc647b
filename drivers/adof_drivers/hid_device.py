"""Open a HID device through hidapi, the kernel's hidraw before libusb."""

from __future__ import annotations

import os
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


class _Held:
    """An opened device with the lock on its node."""

    def __init__(self, device: Any, lock: int | None) -> None:
        self._device = device
        self._lock = lock
        self.read, self.write = device.read, device.write
        self.send_feature_report = device.send_feature_report
        self.get_feature_report = device.get_feature_report

    def close(self) -> None:
        self._device.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def _lock(path: bytes) -> int | None:
    """Hold the node against our own kind: the kernel lets any number of programs open one.

    Without a node, through libusb, whoever comes second is refused by the kernel.
    """
    if not path.startswith(b"/dev/"):
        return None
    import fcntl

    node = os.open(path, os.O_RDONLY | os.O_NOCTTY)
    try:
        fcntl.flock(node, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as failure:
        os.close(node)
        raise DriverError(f"{path.decode()} is held by another program: close that one") from failure
    return node


def choose_hid(
    name: str, identities: Collection[Identity], *, path: str | None = None
) -> tuple[bytes, dict[str, Any]]:
    """Return path and description of the only device with one of `identities`, or of the one at `path`.

    The description is empty if hidapi does not list what is at `path`.

    Raises
    ------
    DriverError
        None, several, or another kind of device.
    """
    known = ", ".join(f"{vendor:04x}:{product:04x}" for vendor, product in sorted(identities))
    listed = {one["path"]: one for one in _backend().enumerate()}
    if path is not None:
        one = listed.get(path.encode(), {})
        if one and (one["vendor_id"], one["product_id"]) not in identities:
            raise DriverError(
                f"at {path} is {one['vendor_id']:04x}:{one['product_id']:04x} "
                f"'{one['product_string'] or ''}', no {name} ({known}): name another path"
            )
        return path.encode(), one
    alike = {at: one for at, one in listed.items() if (one["vendor_id"], one["product_id"]) in identities}
    if len(alike) != 1:
        paths = ", ".join(at.decode(errors="replace") for at in sorted(alike))
        raise DriverError(
            f"several devices are a {name}: {paths}; name one of these paths"
            if paths
            else f"no {name} is connected (looked for {known}): check its cable"
        )
    return next(iter(alike.items()))


def open_path(path: bytes) -> HidDevice:
    """Open what `choose_hid` chose.

    Raises
    ------
    DriverError
        This user may not open it, or another program holds it.
    """
    device = _backend().device()
    lock = None
    try:
        lock = _lock(path)
        device.open_path(path)
        device.set_nonblocking(1)
    except OSError as failure:
        if lock is not None:
            os.close(lock)
        raise DriverError(
            f"{path.decode(errors='replace')} cannot be opened ({failure}): give this user the right to it "
            "with a udev rule, and close the program that holds it"
        ) from failure
    return _Held(device, lock)


def open_hid(name: str, identities: Collection[Identity], *, path: str | None = None) -> HidDevice:
    """Open the only device with one of `identities`, or the one at `path` (such as /dev/hidraw0).

    Raises
    ------
    DriverError
        As `choose_hid` and `open_path`.
    """
    return open_path(choose_hid(name, identities, path=path)[0])


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
