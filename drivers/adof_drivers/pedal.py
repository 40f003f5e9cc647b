"""A foot pedal that stops: pressed, unplugged or not understood, it means stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from adof_drivers.errors import DeviceLostError, DriverError
from adof_drivers.hid_device import HidDevice, Identity, open_hid, reports

JOYSTICK_IDENTITIES: frozenset[Identity] = frozenset([(0x05F3, 0x00FF)])  # VEC
KEYBOARD_IDENTITIES: frozenset[Identity] = frozenset(
    [
        (0x0C45, 0x7403),  # PCsensor
        (0x0C45, 0x7404),
        (0x413D, 0x2107),
        (0x1A86, 0xE026),
        (0x1A86, 0xE02D),
        (0x0426, 0x3011),  # Scythe
    ]
)
Form = Literal["joystick", "keyboard"]


@dataclass(frozen=True)
class PedalState:
    """What the pedal says.

    Attributes
    ----------
    time_s
        When it was asked, monotonic.
    stop
        Pressed at any time since it was last asked, still held, gone, or not understood.
    connected
        Whether it is there.
    tested
        Whether it was pressed and released since it was opened: only then is it known to work.
    """

    time_s: float
    stop: bool
    connected: bool
    tested: bool


class StopPedal:
    """A pedal whose every doubt is a stop. It observes; the emergency stop that cuts the power is another.

    Parameters
    ----------
    device
        Opened HID device; `StopPedal.open()` finds it.
    form
        "joystick": the first byte's bits are contacts. "keyboard": the 8 bytes of a boot keyboard, any key
        counts, with a report number before them or not; such a pedal also types into the desktop.
    normally_closed
        The contact opens when pressed, so that a torn wire stops too; a joystick's only.
    clock
        Monotonic seconds.
    """

    def __init__(
        self,
        device: HidDevice,
        *,
        form: Form = "joystick",
        normally_closed: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if form not in ("joystick", "keyboard"):
            raise DriverError(f"form is '{form}': choose 'joystick' or 'keyboard'")
        if normally_closed and form == "keyboard":
            raise DriverError(
                "a keyboard pedal sends nothing while it is not pressed: it cannot be normally closed"
            )
        self._device = device
        self._form = form
        self._normally_closed = normally_closed
        self._clock = clock
        self._connected = True
        # A closed contact has to be seen first.
        self._held = normally_closed
        self._was_pressed = False
        self._tested = False

    @classmethod
    def open(
        cls, path: str | None = None, *, form: Form = "joystick", normally_closed: bool = False
    ) -> StopPedal:
        """Find and open the only one, or the one at `path`."""
        identities = JOYSTICK_IDENTITIES if form == "joystick" else KEYBOARD_IDENTITIES
        return cls(open_hid("foot pedal", identities, path=path), form=form, normally_closed=normally_closed)

    def poll(self) -> PedalState:
        """Return what it says now; never waits, never raises. A press between two polls is not missed."""
        now_s = self._clock()
        stop = self._held
        try:
            for report in reports(self._device, "foot pedal") if self._connected else []:
                pressed = self._pressed(report)
                self._held = pressed is not False
                stop = stop or self._held
                self._tested = self._tested or (self._was_pressed and pressed is False)
                self._was_pressed = self._was_pressed or pressed is True
        except DeviceLostError:
            self._connected = False
        return PedalState(
            now_s, stop or not self._connected, self._connected, self._tested and self._connected
        )

    def _pressed(self, report: bytes) -> bool | None:
        """Whether pressed; None if the report is not understood."""
        if self._form == "joystick":
            return (report[0] == 0) == self._normally_closed if 1 <= len(report) <= 8 else None
        if len(report) == 9:
            report = report[1:]
        return any(report) if len(report) == 8 else None

    def close(self) -> None:
        """Give the device back; it then says stop."""
        self._connected = False
        self._device.close()
