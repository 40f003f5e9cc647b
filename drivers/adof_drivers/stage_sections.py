"""Stages in the rig file, and what a check of them looks at."""

from __future__ import annotations

import time
from collections.abc import Collection
from statistics import quantiles
from typing import Annotated, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

from adof_drivers.gcode import GcodeController
from adof_drivers.gcs import GcsController
from adof_drivers.link import (
    FtdiTransport,
    Link,
    SerialTransport,
    TcpTransport,
    Transport,
    UsbTransport,
)
from adof_drivers.picomotor import PicomotorController
from adof_drivers.rig import Finding, Section, register
from adof_drivers.safety import StageAxis
from adof_drivers.stage import Controller, Stage

_READS = 50
_SLOWEST_READ_S = 1 / 60
"""A frame at 60 Hz: a position that takes longer holds up the loop."""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


_USB = r"^[0-9a-fA-F]{4}(:[0-9a-fA-F]{4})?$"


class _Axis(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    wire: str
    lag_s: Positive = 0.5


class LinearAxis(_Axis):
    """An axis in um."""

    um_per_unit: Annotated[float, Field(allow_inf_nan=False)]
    speed_limit_um_per_s: Positive
    resolution_um: Positive
    low_um: Finite | None = None
    high_um: Finite | None = None
    following_um: Positive = 50.0

    def axis(self) -> StageAxis:
        """Return it as the driver takes it."""
        return StageAxis(
            self.wire, "um", self.um_per_unit, self.speed_limit_um_per_s, self.resolution_um,
            self.low_um, self.high_um, self.following_um, self.lag_s,
        )  # fmt: skip


class RotaryAxis(_Axis):
    """An axis in rad."""

    rad_per_unit: Annotated[float, Field(allow_inf_nan=False)]
    speed_limit_rad_per_s: Positive
    resolution_rad: Positive
    low_rad: Finite | None = None
    high_rad: Finite | None = None
    following_rad: Positive = 0.01

    def axis(self) -> StageAxis:
        """Return it as the driver takes it."""
        return StageAxis(
            self.wire, "rad", self.rad_per_unit, self.speed_limit_rad_per_s, self.resolution_rad,
            self.low_rad, self.high_rad, self.following_rad, self.lag_s,
        )  # fmt: skip


def _kind(entry: Any) -> str:
    return "rotary" if isinstance(entry, dict) and "rad_per_unit" in entry else "linear"


class StageSection(Section):
    """A stage: one of `tcp`, `usb`, `ftdi`, `serial`, and its axes."""

    ports: ClassVar[Collection[str]] = ("tcp", "usb", "ftdi", "serial")

    tcp: Annotated[str, Field(pattern=r"^[^:]+:\d{1,5}$")] | None = None
    usb: Annotated[str, Field(pattern=_USB)] | None = None
    ftdi: Annotated[str, Field(pattern=_USB)] | None = None
    usb_serial_number: str | None = None
    serial: str | None = None
    baud: Annotated[int, Field(gt=0)] = 115200
    timeout_s: Annotated[float, Field(gt=0, le=10)] = 1.0
    axes: Annotated[
        dict[
            str,
            Annotated[
                Annotated[LinearAxis, Tag("linear")] | Annotated[RotaryAxis, Tag("rotary")],
                Discriminator(_kind),
            ],
        ],
        Field(min_length=1),
    ]

    @model_validator(mode="after")
    def _one_port(self) -> StageSection:
        given = [port for port in ("tcp", "usb", "ftdi", "serial") if getattr(self, port) is not None]
        if len(given) != 1 or given[0] not in self.ports:
            raise ValueError(
                f"{' and '.join(given) or 'no port'} is given: one of {', '.join(self.ports)} was wanted"
            )
        return self

    def controller(self, link: Link) -> Controller:
        """Return the dialect on a link."""
        raise NotImplementedError

    def open(self) -> Stage:
        """Connect and read; nothing moves."""
        return Stage(
            self.controller(Link(self._transport(), timeout_s=self.timeout_s)),
            {name: axis.axis() for name, axis in self.axes.items()},
        )

    def _transport(self) -> Transport:
        if self.tcp is not None:
            host, _, port = self.tcp.rpartition(":")
            return TcpTransport(host, int(port), timeout_s=max(self.timeout_s, 1.0))
        if (identity := self.usb or self.ftdi) is not None:
            vendor, _, product = identity.partition(":")
            ids = int(vendor, 16), int(product, 16) if product else None
            if self.usb is not None:
                return UsbTransport(*ids, serial_number=self.usb_serial_number)
            return FtdiTransport(*ids, baud=self.baud, serial_number=self.usb_serial_number)
        assert self.serial is not None
        return SerialTransport(self.serial, baud=self.baud)

    def check(self, name: str, device: Stage, *, move: bool) -> list[Finding]:
        """Read identity, limits, references and the time of a position; with `move` jog the axes a little."""
        findings = [Finding(name, "identity", device.identity)]
        took_ms, resting = [], True
        before = device.position()
        for _ in range(_READS):
            began = time.perf_counter()
            position = device.position()
            took_ms.append((time.perf_counter() - began) * 1e3)
            resting &= all(
                abs(position[axis] - before[axis]) <= 3 * device.resolution[axis] for axis in position
            )
        middle, slow = quantiles(took_ms, n=100)[49], quantiles(took_ms, n=100, method="inclusive")[98]
        findings.append(
            Finding(
                name,
                "position read",
                f"{middle:.2f} ms median, {slow:.2f} ms p99, {1e3 / middle:.0f} /s",
                good=slow < _SLOWEST_READ_S * 1e3,
                mend="raise the baud rate, or the FTDI latency timer is not 1 ms",
            )
        )
        findings.append(
            Finding(
                name,
                "at rest",
                "yes" if resting else "no: it moves unasked",
                good=resting,
                mend="look for a joystick or another program",
            )
        )
        homed = device.homed()
        for axis, (low, high) in device.limits.items():
            unit = device.axes[axis].unit
            findings.append(
                Finding(
                    name,
                    f"axis {axis}",
                    f"at {position[axis]:.6g} {unit}, limits {low:.6g} to {high:.6g}, "
                    + ("homed" if homed[axis] else "not homed"),
                    good=homed[axis],
                    mend="home it, the way being clear",
                )
            )
        if move:
            findings += [self._jog(name, device, axis) for axis in device.axes if homed[axis]]
        return findings

    @staticmethod
    def _jog(name: str, device: Stage, axis: str) -> Finding:
        start, step = device.position()[axis], 20 * device.resolution[axis]
        low, high = device.limits[axis]
        step = step if start + step <= high else -step
        device.latch.operator(False)  # who asked for a moving check has pressed
        device.latch.operator(True)
        device.enable()
        worst = 0.0
        for target in (start + step, min(max(start, low), high)):
            device.move_to({axis: target})
            device.wait_until_still(timeout_s=10.0)
            worst = max(worst, abs(device.position()[axis] - target))
        return Finding(
            name,
            f"axis {axis} moves",
            f"{abs(step):.4g} {device.axes[axis].unit} and back, {worst:.2g} off",
            good=worst <= 3 * device.resolution[axis],
            mend="check its unit, its servo's tuning and that it is free",
        )


@register("stage", "gcs")
class GcsSection(StageSection):
    """A PI controller; units are mm or degrees."""

    def controller(self, link: Link) -> Controller:
        """GCS 2.0."""
        return GcsController(link, [axis.wire for axis in self.axes.values()])


@register("stage", "picomotor")
class PicomotorSection(StageSection):
    """A Picomotor 8742; units are steps. Its axes state low and high."""

    ports: ClassVar[Collection[str]] = ("tcp", "usb")

    def controller(self, link: Link) -> Controller:
        """Steps."""
        return PicomotorController(link)


@register("stage", "gcode")
class GcodeSection(StageSection):
    """A MicroManipulatorStepper; units are mm, axes X, Y and Z. They state low and high."""

    ports: ClassVar[Collection[str]] = ("serial", "tcp")

    def controller(self, link: Link) -> Controller:
        """G-code."""
        return GcodeController(link)
