"""3Dconnexion's SpaceMouse: six axes to jog with."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass

from adof_drivers.errors import DeviceLostError, DriverError
from adof_drivers.hid_device import HidDevice, Identity, open_hid, reports

IDENTITIES: frozenset[Identity] = frozenset(
    [(0x046D, product) for product in (0xC603, 0xC605, 0xC606, 0xC621, 0xC623, 0xC625, 0xC626, 0xC627)]
    + [(0x046D, product) for product in (0xC628, 0xC629, 0xC62B)]
    + [(0x256F, product) for product in (0xC62E, 0xC62F, 0xC631, 0xC632, 0xC633, 0xC635, 0xC638, 0xC63A)]
    + [(0x256F, product) for product in (0xC641, 0xC652)]
)
_FULL = 350.0  # what a puck pushed all the way sends
_AXES = 6


@dataclass(frozen=True)
class JogState:
    """What the operator asks for.

    Attributes
    ----------
    time_s
        When it was asked, monotonic.
    axes
        x, y, z, and about x, y, z: each from -1 to 1; all 0 if the device is gone, silent or in doubt.
    buttons
        Numbers of those held, from 0.
    connected
        Whether the device is there.
    """

    time_s: float
    axes: tuple[float, float, float, float, float, float]
    buttons: frozenset[int]
    connected: bool


class SpaceMouse:
    """Jog wishes that fall to zero whenever there is doubt.

    Zero if it was unplugged; if it said nothing for `silence_s` while deflected (it speaks every 16 ms then);
    after a report of unknown form; and after opening, until the puck was seen at rest: nothing moves because
    something was plugged in.

    Parameters
    ----------
    device
        Opened HID device; `SpaceMouse.open()` finds it.
    dead_zone
        Share of the full way in which the puck counts as at rest.
    silence_s
        See above.
    clock
        Monotonic seconds.

    Attributes
    ----------
    malformed
        Reports of unknown form so far.
    """

    def __init__(
        self,
        device: HidDevice,
        *,
        dead_zone: float = 0.05,
        silence_s: float = 0.2,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not 0 <= dead_zone < 1 or not 0 < silence_s < math.inf:
            raise DriverError(
                f"dead_zone is {dead_zone}, silence_s {silence_s}: 0 to 1, and above 0, were wanted"
            )
        self.malformed = 0
        self._device = device
        self._dead_zone = dead_zone
        self._silence_s = silence_s
        self._clock = clock
        self._axes = [0.0] * _AXES
        self._buttons: frozenset[int] = frozenset()
        self._connected = True
        self._rested = False
        self._pushed: list[bool | None] = [None, None]  # the first three axes, the last three, as last heard
        opened_s = clock()
        self._heard_s = [opened_s, opened_s]  # of the first three axes, of the last three

    @classmethod
    def open(cls, path: str | None = None, *, dead_zone: float = 0.05) -> SpaceMouse:
        """Find and open the only one, or the one at `path`."""
        return cls(open_hid("SpaceMouse", IDENTITIES, path=path), dead_zone=dead_zone)

    def poll(self) -> JogState:
        """Return the wish of now; never waits, never raises."""
        now_s = self._clock()
        try:
            for report in reports(self._device, "SpaceMouse") if self._connected else []:
                self._take(report, now_s)
        except DeviceLostError:
            self._connected = False
        if not self._connected:
            self._axes, self._buttons = [0.0] * _AXES, frozenset()
        silent = [now_s - heard_s >= self._silence_s for heard_s in self._heard_s]
        for half in (0, 1):
            if silent[half]:
                self._axes[3 * half : 3 * half + 3] = [0.0] * 3
        # A wireless puck out of reach is silent too: one that was heard deflected has to be heard at rest.
        untouched = all(silent) and not any(self._pushed)
        self._rested = self._rested or (untouched and self._connected)
        axes = self._axes if self._rested else [0.0] * _AXES
        x, y, z, about_x, about_y, about_z = axes
        return JogState(now_s, (x, y, z, about_x, about_y, about_z), self._buttons, self._connected)

    def _take(self, report: bytes, now_s: float) -> None:
        kind, body = report[0], report[1:]
        if kind == 1 and len(body) == 12:
            self._axes = self._scaled(body)
            self._heard_s = [now_s, now_s]
            self._pushed = [any(self._axes[:3]), any(self._axes[3:])]
            self._rested = self._rested or not any(self._pushed)
        elif kind in (1, 2) and len(body) == 6:
            half = kind - 1
            self._axes[3 * half : 3 * half + 3] = axes = self._scaled(body)
            self._heard_s[half] = now_s
            self._pushed[half] = any(axes)
            # The second half follows the first; two at rest the other way round are of two moments.
            self._rested = self._rested or (half == 1 and self._pushed == [False, False])
        elif kind == 3 and 1 <= len(body) <= 6:
            bits = int.from_bytes(body, "little")
            self._buttons = frozenset(n for n in range(8 * len(body)) if bits >> n & 1)
        elif not (kind in (0x17, 0x19) and len(body) <= 3):  # battery of the wireless ones
            self.malformed += 1
            self._axes = [0.0] * _AXES

    def _scaled(self, body: bytes) -> list[float]:
        """Axes from -1 to 1, without a jump at the rim of the dead zone."""
        scaled = []
        for (value,) in struct.iter_unpack("<h", body):
            share = min(abs(value) / _FULL, 1.0)
            beyond = max(share - self._dead_zone, 0.0) / (1 - self._dead_zone)
            scaled.append(math.copysign(beyond, value) if beyond else 0.0)
        return scaled

    def set_light(self, *, on: bool) -> None:
        """Switch the ring of light.

        Raises
        ------
        DeviceLostError
            It was unplugged.
        """
        try:
            written = self._device.write(bytes([4, on]))
        except (OSError, ValueError) as failure:
            raise DeviceLostError(f"the SpaceMouse was unplugged ({failure})") from failure
        if written < 0:
            raise DeviceLostError("the SpaceMouse was unplugged")

    def close(self) -> None:
        """Give the device back."""
        self._connected = False
        self._device.close()
