"""USB relays that call themselves USBRelay1 to USBRelay8 (16c0:05df): drive enable, shutter, lamp."""

from __future__ import annotations

from adof_drivers.errors import DeviceLostError, DriverError
from adof_drivers.hid_device import HidDevice, Identity, choose_hid, open_path

IDENTITIES: frozenset[Identity] = frozenset([(0x16C0, 0x05DF)])
_ON, _OFF, _ALL_OFF = 0xFF, 0xFD, 0xFC


class HidRelay:
    """Up to 8 relays; each switching is read back. All go off when it closes.

    Parameters
    ----------
    device
        Opened HID device; `HidRelay.open()` finds it.
    channels
        How many relays the board has, 1 to 8.

    Raises
    ------
    DriverError
        An impossible number of channels; or the board did not do what it was told.
    """

    def __init__(self, device: HidDevice, channels: int) -> None:
        if not 1 <= channels <= 8:
            raise DriverError(f"channels is {channels}: 1 to 8 was wanted")
        self.channels = channels
        self._device: HidDevice | None = device

    @classmethod
    def open(cls, path: str | None = None) -> HidRelay:
        """Find and open the only one, or the one at `path`; other devices share its USB identity.

        Raises
        ------
        DriverError
            None, several, or one that does not call itself USBRelay and a number.
        """
        at, listed = choose_hid("USB relay", IDENTITIES, path=path)
        product = listed.get("product_string") or ""
        number = product.removeprefix("USBRelay")
        if not (product.startswith("USBRelay") and number.isdecimal()):
            raise DriverError(f"{at.decode()} calls itself '{product}': 'USBRelay' and a number was wanted")
        return cls(open_path(at), int(number))

    def state(self) -> tuple[bool, ...]:
        """Return which relays are on, read from the board.

        Raises
        ------
        DeviceLostError
            It was unplugged.
        """
        device = self._require_open()
        try:
            reply = bytes(device.get_feature_report(0, 9))
        except (OSError, ValueError) as failure:
            raise DeviceLostError(f"the USB relay was unplugged ({failure})") from failure
        if len(reply) not in (8, 9):  # with the report's number before it or not
            raise DriverError(f"the USB relay answered {len(reply)} bytes: 8 or 9 were wanted")
        bits = reply[-1]
        return tuple(bool(bits >> channel & 1) for channel in range(self.channels))

    def switch(self, channel: int, *, on: bool) -> None:
        """Switch one relay, from 0, and see that it did.

        Raises
        ------
        DriverError
            No such relay; nothing is sent then. Or it did not switch.
        DeviceLostError
            It was unplugged.
        """
        if not 0 <= channel < self.channels:
            raise DriverError(f"relay {channel} is not there: 0 to {self.channels - 1} was wanted")
        self._send(_ON if on else _OFF, channel + 1)
        if self.state()[channel] is not on:
            raise DriverError(f"relay {channel} did not switch {'on' if on else 'off'}: replace the board")

    def _send(self, command: int, channel: int) -> None:
        device = self._require_open()
        try:
            sent = device.send_feature_report(bytes([0, command, channel, 0, 0, 0, 0, 0, 0]))
        except (OSError, ValueError) as failure:
            raise DeviceLostError(f"the USB relay was unplugged ({failure})") from failure
        if sent < 0:
            raise DeviceLostError("the USB relay was unplugged")

    def _require_open(self) -> HidDevice:
        if self._device is None:
            raise DeviceLostError("the USB relay is closed: open it again")
        return self._device

    def close(self) -> None:
        """Switch all off and give the board back; may be called twice, never raises."""
        device = self._device
        if device is None:
            return
        try:
            self._send(_ALL_OFF, 0)
        except DeviceLostError:
            pass  # without its cable it has no power to hold a relay either
        finally:
            self._device = None
            device.close()
