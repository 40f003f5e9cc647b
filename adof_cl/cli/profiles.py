"""What plans are made from: a file's profile, or the one kept of the chosen device; and its pace today."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from adof_cl.planner import Planner
    from adof_cl.profile import DeviceProfile

_FELT = 0.1  # a pace this far from 1 is told


def planner_for(path: Path | None, selector: str | None) -> Planner:
    """Return a planner at the chosen device's pace now; says on standard error when that is another.

    Raises
    ------
    InputError
        As `profile_for`.
    """
    import sys

    from adof_cl.device import Device
    from adof_cl.pace import pace
    from adof_cl.planner import Planner

    profile = profile_for(path, selector)
    now = pace(Device.open(selector), profile)
    if abs(now - 1) > _FELT:
        print(f"adof: this machine takes {now:.2f} times as long as when it was profiled", file=sys.stderr)
    return Planner(profile, now)


def profile_for(path: Path | None, selector: str | None) -> DeviceProfile:
    """Read a profile; says on standard error when it is of another device or driver than the chosen one.

    Raises
    ------
    InputError
        No such file, not a profile, or none kept of the device.
    """
    import os
    import sys

    from adof_cl.device import SELECTOR_VARIABLE, choose, list_devices
    from adof_cl.profile import DeviceProfile

    facts = choose(list_devices(), selector or os.environ.get(SELECTOR_VARIABLE)).as_dict()
    if path is None:
        return DeviceProfile.of_device(facts)
    profile = DeviceProfile.read(path)
    if not profile.fits(facts):
        measured = profile.device
        print(
            f"adof: {path} was measured on {measured['name']}, driver {measured['driver_version']}: times "
            f"on {facts['name']} will differ",
            file=sys.stderr,
        )
    return profile
