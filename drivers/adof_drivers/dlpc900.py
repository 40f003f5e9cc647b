"""TI's DLPC900 controller (phase-light modulators, micromirrors) over USB HID; the pattern comes by video.

The codes are shown as a monitor (`slm_window`); this switches the controller to show that video as patterns.

Source
------
TI, DLPC900 Programmer's Guide, DLPU018: USB protocol, status, display modes. Written from what public drivers
use of it, not run on hardware.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from adof_drivers.errors import DeviceLostError, DriverError
from adof_drivers.hid_device import HidDevice, Identity, open_hid

IDENTITIES: frozenset[Identity] = frozenset([(0x0451, 0xC900)])
_READ, _REPLY, _FAILED = 0x80, 0x40, 0x20
_REPORT_BYTES = 64
_HEADER_BYTES = 4  # flags, sequence, length
_VERSION, _HARDWARE, _MODE, _PATTERNS = 0x0205, 0x1A0A, 0x1A1B, 0x1A24
_STOP, _START = 0, 2
_HARDWARE_FAULTS = {
    1: "an incompatible controller or mirror chip",
    2: "an error of the mirror chip's reset",
    3: "a forced swap of patterns",
    6: "a mismatch of the second controller",
    7: "an error of the sequencer",
}


class DisplayMode(IntEnum):
    """Where the pattern comes from."""

    VIDEO = 0
    STORED_PATTERNS = 1
    VIDEO_PATTERNS = 2
    LOADED_PATTERNS = 3


@dataclass(frozen=True)
class HardwareStatus:
    """What the controller says of itself."""

    ready: bool
    faults: tuple[str, ...]


class Dlpc900:
    """One controller.

    Parameters
    ----------
    device
        Opened HID device; `Dlpc900.open()` finds it.
    timeout_s
        How long an answer may take.
    clock, wait
        Monotonic seconds, and how to let some pass.
    """

    def __init__(
        self,
        device: HidDevice,
        *,
        timeout_s: float = 0.5,
        clock: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._device = device
        self._timeout_s = timeout_s
        self._clock = clock
        self._wait = wait
        self._sequence = 0

    @classmethod
    def open(cls, path: str | None = None) -> Dlpc900:
        """Find and open the only one, or the one at `path`."""
        return cls(open_hid("DLPC900", IDENTITIES, path=path))

    def version(self) -> str:
        """Return the version of the application in its firmware.

        Raises
        ------
        DriverError
            It refuses, answers something else, or not in time.
        DeviceLostError
            It was unplugged.
        """
        patch, _, minor, major = self._ask(_VERSION, 4)
        return f"{major}.{minor}.{patch}"

    def status(self) -> HardwareStatus:
        """Return what the controller says of itself; raises as `version`."""
        bits = self._ask(_HARDWARE, 1)[0]
        faults = tuple(name for bit, name in _HARDWARE_FAULTS.items() if bits >> bit & 1)
        return HardwareStatus(ready=bool(bits & 1), faults=faults)

    def mode(self) -> DisplayMode:
        """Return where the pattern comes from; raises as `version`."""
        value = self._ask(_MODE, 1)[0] & 3
        return DisplayMode(value)

    def set_mode(self, mode: DisplayMode) -> None:
        """Stop patterns, change where they come from, and see that it did; raises as `version`."""
        self._tell(_PATTERNS, bytes([_STOP]))
        self._tell(_MODE, bytes([mode]))
        if (there := self.mode()) is not mode:
            raise DriverError(
                f"the DLPC900 stays in mode {there.name} instead of {mode.name}: patterns from video need a "
                "locked video signal first; see that its monitor is on"
            )

    def start(self) -> None:
        """Show patterns; raises as `version`."""
        self._tell(_PATTERNS, bytes([_START]))

    def stop(self) -> None:
        """Show no further pattern; raises as `version`."""
        self._tell(_PATTERNS, bytes([_STOP]))

    def _ask(self, command: int, count: int) -> bytes:
        data = self._exchange(_READ | _REPLY, command, b"")
        if len(data) < count:
            raise DriverError(
                f"the DLPC900 answered {len(data)} bytes to {command:#06x}: {count} were wanted"
            )
        return data[:count]

    def _tell(self, command: int, data: bytes) -> None:
        self._exchange(_REPLY, command, data)

    def _exchange(self, flags: int, command: int, data: bytes) -> bytes:
        self._sequence = (self._sequence + 1) % 256
        body = command.to_bytes(2, "little") + data
        packet = bytes([flags, self._sequence]) + len(body).to_bytes(2, "little") + body
        try:
            # The first 0 says that reports have no number.
            if self._device.write(b"\x00" + packet.ljust(_REPORT_BYTES, b"\x00")) < 0:
                raise DeviceLostError("the DLPC900 was unplugged: plug it in and open it again")
            return self._answer(command)
        except (OSError, ValueError) as failure:
            raise DeviceLostError(f"the DLPC900 was unplugged ({failure})") from failure

    def _answer(self, command: int) -> bytes:
        deadline_s = self._clock() + self._timeout_s
        while True:
            report = bytes(self._device.read(_REPORT_BYTES))
            # Answers to what was given up on before carry another number.
            if len(report) >= _HEADER_BYTES and report[1] == self._sequence:
                break
            if self._clock() >= deadline_s:
                raise DriverError(f"the DLPC900 did not answer {command:#06x} within {self._timeout_s:g} s")
            if not report:
                self._wait(0.001)
        if report[0] & _FAILED:
            raise DriverError(f"the DLPC900 refuses command {command:#06x}: see which mode it is in")
        count = int.from_bytes(report[2:4], "little")
        if count > len(report) - _HEADER_BYTES:
            raise DriverError(
                f"the DLPC900 announces {count} bytes and sends {len(report) - _HEADER_BYTES}: open it again"
            )
        return report[_HEADER_BYTES : _HEADER_BYTES + count]

    def close(self) -> None:
        """Stop patterns and give the controller back; never raises."""
        try:
            self.stop()
        except DriverError:
            pass  # it is gone, or shows none
        finally:
            self._device.close()
