"""HOLOEYE panels through HOLOEYE's own SLM Display SDK, 4.x or 3.x, where its installer has put it.

The SDK is not on the package index and has a licence of its own; it is imported when a panel is opened.
Written from its public use, not run on hardware. No table is uploaded: the panel stays linear.
"""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_drivers.errors import DeviceLostError, DriverError
from adof_drivers.slm import Shown, require_codes


class HoloeyeSlm:
    """A panel opened by HOLOEYE's SDK.

    Parameters
    ----------
    shape
        Rows and columns; a panel of another size is refused.
    preselect
        Which one, in the SDK's own words, such as "name:leto" or "index:0"; empty: the SDK asks.

    Raises
    ------
    DriverError
        No SDK, none of a version known here, no panel, or one of another size.
    """

    def __init__(self, shape: tuple[int, int], *, preselect: str = "") -> None:
        self.shape = shape
        self._number = 0
        self._sdk: _Sdk4 | _Sdk3 = _load()
        try:
            self._sdk.open(preselect)
            found = self._sdk.shape
            if found != shape:
                raise DriverError(
                    f"the SDK opened a panel of {found[1]} x {found[0]} pixels, {shape[1]} x {shape[0]} was "
                    "wanted: preselect another one"
                )
        except BaseException:
            self.close()
            raise

    def show(self, codes: NDArray[np.uint8]) -> Shown:
        """Show codes (rows, columns); see `Slm.show`. The SDK returns when the panel's window has them."""
        require_codes(codes, self.shape)
        self._sdk.show(np.ascontiguousarray(codes))
        self._number += 1
        return Shown(self._number, time.monotonic())

    def close(self) -> None:
        """Give the panel back."""
        self._sdk.close()


def _load() -> _Sdk4 | _Sdk3:
    for name, adapter in (("HEDS", _Sdk4), ("holoeye.slmdisplaysdk", _Sdk3)):
        try:
            return adapter(import_module(name))
        except ImportError:
            continue
    raise DriverError(
        "HOLOEYE's SLM Display SDK is not found: install it and put its Python folder on PYTHONPATH, or "
        "drive the panel as a monitor (slm_window)"
    )


class _Sdk4:
    def __init__(self, heds: Any) -> None:
        self._heds = heds
        self._slm: Any = None

    def _require(self, error: int, doing: str, kind: type[DriverError] = DriverError) -> None:
        if error != 0:  # HEDSERR_NoError
            raise kind(f"HOLOEYE's SDK cannot {doing}: {self._heds.SDK.ErrorString(error)}")

    def open(self, preselect: str) -> None:
        self._require(self._heds.SDK.Init(4, 0), "start as version 4.0")
        slm = self._heds.SLM.Init(preselect)
        self._require(slm.errorCode(), "open a panel: check its cable and power")
        self._slm = slm

    @property
    def shape(self) -> tuple[int, int]:
        return int(self._slm.height_px()), int(self._slm.width_px())

    def show(self, codes: NDArray[np.uint8]) -> None:
        if self._slm is None:
            raise DeviceLostError("the panel is closed: open it again")
        error, handle = self._slm.loadImageData(codes)
        self._require(error, "take the codes", DeviceLostError)
        self._require(handle.show(), "show the codes", DeviceLostError)

    def close(self) -> None:
        slm, self._slm = self._slm, None
        if slm is not None:
            slm.window().close()


class _Sdk3:
    def __init__(self, sdk: Any) -> None:
        self._sdk = sdk
        self._slm: Any = None

    def _require(self, error: int, doing: str, slm: Any, kind: type[DriverError] = DriverError) -> None:
        if error != self._sdk.ErrorCode.NoError:
            raise kind(f"HOLOEYE's SDK cannot {doing}: {slm.errorString(error)}")

    def open(self, preselect: str) -> None:
        slm = self._sdk.SLMInstance()
        if not slm.requiresVersion(3):
            raise DriverError("HOLOEYE's SDK is older than version 3: install 3.x or 4.x")
        self._require(slm.open(preselect), "open a panel: check its cable and power", slm)
        self._slm = slm

    @property
    def shape(self) -> tuple[int, int]:
        return int(self._slm.height_px), int(self._slm.width_px)

    def show(self, codes: NDArray[np.uint8]) -> None:
        if self._slm is None:
            raise DeviceLostError("the panel is closed: open it again")
        self._require(self._slm.showData(codes), "show the codes", self._slm, DeviceLostError)

    def close(self) -> None:
        slm, self._slm = self._slm, None
        if slm is not None:
            slm.close()
