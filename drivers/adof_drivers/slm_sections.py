"""Modulators in the rig file, and what a check of them looks at: how long showing a pattern takes."""

from __future__ import annotations

import math
import time
from statistics import quantiles
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from adof_drivers.dlpc900 import DisplayMode, Dlpc900
from adof_drivers.errors import DriverError
from adof_drivers.holoeye import HoloeyeSlm
from adof_drivers.rig import Finding, Positive, Section, register
from adof_drivers.slm import Shown, Slm
from adof_drivers.slm_window import SlmWindow

_PATTERNS = 20
_SLOWEST_FLIPS = 3.0  # the wait for one, the flip, and what the driver holds back
Count = Annotated[int, Field(ge=1)]


class SlmSection(Section):
    """A panel whose phase runs straight from 0 to `stroke_rad`.

    `settling_s`: from the return of the call that shows a pattern until all the light is the new one's.
    """

    rows: Count
    columns: Count
    pitch_um: Positive
    settling_s: Positive
    refresh_hz: Positive = 60.0
    fill_factor: Annotated[float, Field(gt=0, le=1)] = 0.9
    stroke_rad: Annotated[float, Field(gt=0, le=2 * math.pi)] = 2 * math.pi

    def check(self, name: str, device: Any, *, move: bool) -> list[Finding]:  # noqa: ARG002
        """Show two patterns in turn."""
        rows, columns = device.shape
        patterns = [np.full((rows, columns), code, np.uint8) for code in (0, 128)]
        took_ms = []
        for number in range(_PATTERNS):
            began_s = time.perf_counter()
            device.show(patterns[number % 2])
            took_ms.append(1e3 * (time.perf_counter() - began_s))
        middle, slow = quantiles(took_ms, n=100)[49], quantiles(took_ms, n=100, method="inclusive")[98]
        return [
            Finding(name, "panel", f"{columns} x {rows}, pitch {self.pitch_um:g} um"),
            Finding(
                name,
                "pattern shown",
                f"{middle:.1f} ms median, {slow:.1f} ms p99",
                good=slow <= _SLOWEST_FLIPS * 1e3 / self.refresh_hz,
                mend=f"a flip takes 1/{self.refresh_hz:g} s: switch the compositor off",
            ),
        ]


@register("slm", "window")
class WindowSection(SlmSection):
    """A monitor, by number or by a part of its name."""

    monitor: int | str
    require_pacing: bool = True

    def open(self) -> Slm:
        """Open the window."""
        return SlmWindow((self.rows, self.columns), monitor=self.monitor, require_pacing=self.require_pacing)


@register("slm", "holoeye")
class HoloeyeSection(SlmSection):
    """HOLOEYE's SDK."""

    preselect: str = ""

    def open(self) -> Slm:
        """Open it by the SDK."""
        return HoloeyeSlm((self.rows, self.columns), preselect=self.preselect)


@register("slm", "dlpc900")
class Dlpc900Section(WindowSection):
    """TI's controller: its monitor, and the HID device that has it show what the monitor gets."""

    hid_path: str | None = None

    def open(self) -> Slm:
        """Open the window, then switch the controller to it."""
        return Dlpc900Slm(super().open(), Dlpc900.open(self.hid_path))


class Dlpc900Slm:
    """A window whose patterns a DLPC900 shows; closed, it shows none."""

    def __init__(self, window: Slm, controller: Dlpc900) -> None:
        self._window, self._controller = window, controller
        try:
            controller.set_mode(DisplayMode.VIDEO_PATTERNS)
            controller.start()
        except DriverError:
            self.close()
            raise

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self._window.shape

    def show(self, codes: NDArray[np.uint8]) -> Shown:
        """Show codes by the window."""
        return self._window.show(codes)

    def close(self) -> None:
        """Stop the patterns and close the window."""
        self._controller.close()
        self._window.close()
