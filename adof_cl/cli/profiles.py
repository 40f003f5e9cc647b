"""The profile that plans are made from: a file's, or the one kept of the chosen device."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from adof_cl.profile import DeviceProfile


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
