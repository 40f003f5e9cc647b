"""What an operator holds, in the rig file: SpaceMouse, stop pedal, relays; and what a check looks at."""

from __future__ import annotations

import time
from typing import Annotated, Any

from pydantic import Field

from adof_drivers.pedal import Form, StopPedal
from adof_drivers.relay import HidRelay
from adof_drivers.rig import Finding, Positive, Section, register
from adof_drivers.spacemouse import SpaceMouse

_WATCHED_S = 0.5


@register("operator", "spacemouse")
class SpaceMouseSection(Section):
    """Enables and jogs: its first button is the enable switch, the second starts a run."""

    path: str | None = None
    dead_zone: Annotated[float, Field(ge=0, lt=1)] = 0.05
    jog_speed_um_per_s: Positive = 200.0
    jog_speed_rad_per_s: Positive = 0.02

    def open(self) -> SpaceMouse:
        """Find it."""
        return SpaceMouse.open(self.path, dead_zone=self.dead_zone)

    def check(self, name: str, device: SpaceMouse, *, move: bool) -> list[Finding]:  # noqa: ARG002
        """Watch it for a while: it should lie at rest and be understood."""
        states = _watched(device)
        deflected = any(any(state.axes) for state in states)
        connected = states[-1].connected
        return [
            Finding(
                name,
                "connected",
                "yes" if connected else "no",
                good=connected,
                mend="check its cable or charge it",
            ),
            Finding(
                name,
                "at rest",
                "no: it asks for motion" if deflected else "yes",
                good=not deflected,
                mend="let go of the puck; if nobody holds it, enlarge dead_zone",
            ),
            Finding(
                name,
                "reports understood",
                f"{device.malformed} were not",
                good=device.malformed == 0,
                mend="this model sends another form of report: use another one",
            ),
        ]


@register("operator", "pedal")
class PedalSection(Section):
    """The pedal that stops."""

    path: str | None = None
    form: Form = "joystick"
    normally_closed: bool = False

    def open(self) -> StopPedal:
        """Find it."""
        return StopPedal.open(self.path, form=self.form, normally_closed=self.normally_closed)

    def check(self, name: str, device: StopPedal, *, move: bool) -> list[Finding]:  # noqa: ARG002
        """Watch it for a while: it should be there and not pressed."""
        state = _watched(device)[-1]
        return [
            Finding(
                name,
                "connected",
                "yes" if state.connected else "no",
                good=state.connected,
                mend="check its cable",
            ),
            Finding(
                name,
                "not pressed",
                "it says stop" if state.stop else "yes",
                good=not state.stop,
                mend="let go of it; if nobody presses, `normally_closed` or `form` is wrong",
            ),
        ]


@register("operator", "relay")
class RelaySection(Section):
    """A board of relays; a check reads it and switches nothing."""

    path: str | None = None

    def open(self) -> HidRelay:
        """Find it."""
        return HidRelay.open(self.path)

    def check(self, name: str, device: HidRelay, *, move: bool) -> list[Finding]:  # noqa: ARG002
        """Read which relays are on."""
        on = [str(channel) for channel, state in enumerate(device.state()) if state]
        return [Finding(name, "relays", f"{device.channels}, on: {', '.join(on) or 'none'}")]


def _watched(device: Any) -> list[Any]:
    """Poll a device for a while."""
    states = [device.poll()]
    until_s = time.monotonic() + _WATCHED_S
    while time.monotonic() < until_s:
        time.sleep(0.005)
        states.append(device.poll())
    return states
