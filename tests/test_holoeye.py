"""The adapter against stand-ins with the calls HOLOEYE's SDKs are known to have; the SDKs are not free."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from adof_drivers.errors import DeviceLostError, DriverError
from adof_drivers.holoeye import HoloeyeSlm

CODES = np.random.default_rng(0).integers(0, 256, (4, 6), dtype=np.uint8)


class Panel:
    """What both SDKs do to a panel of 4 x 6."""

    def __init__(self) -> None:
        self.shown: list[Any] = []
        self.is_open = False
        self.error = 0

    def install(self, monkeypatch: pytest.MonkeyPatch, version: int) -> None:
        for name in ("HEDS", "holoeye", "holoeye.slmdisplaysdk"):
            monkeypatch.setitem(sys.modules, name, None)
        if version == 4:
            heds = ModuleType("HEDS")
            heds.SDK = SimpleNamespace(Init=lambda *_: 0, ErrorString=lambda e: f"error {e}")  # type: ignore[attr-defined]
            heds.SLM = SimpleNamespace(Init=self._open_4)  # type: ignore[attr-defined]
            monkeypatch.setitem(sys.modules, "HEDS", heds)
        else:
            sdk = ModuleType("holoeye.slmdisplaysdk")
            sdk.ErrorCode = SimpleNamespace(NoError=0)  # type: ignore[attr-defined]
            sdk.SLMInstance = lambda: self  # type: ignore[attr-defined]
            monkeypatch.setitem(sys.modules, "holoeye", ModuleType("holoeye"))
            monkeypatch.setitem(sys.modules, "holoeye.slmdisplaysdk", sdk)

    def _take(self, codes: Any) -> int:
        if not self.error:
            self.shown.append(codes.copy())
        return self.error

    # version 4
    def _open_4(self, _preselect: str) -> SimpleNamespace:
        self.is_open = not self.error
        return SimpleNamespace(
            errorCode=lambda: self.error,
            width_px=lambda: 6,
            height_px=lambda: 4,
            loadImageData=lambda codes: (0, SimpleNamespace(show=lambda: self._take(codes))),
            window=lambda: self,
        )

    # version 3
    width_px, height_px = 6, 4

    def requiresVersion(self, wanted: int) -> bool:
        return wanted <= 3

    def open(self, _preselect: str) -> int:
        self.is_open = not self.error
        return self.error

    def errorString(self, error: int) -> str:
        return f"error {error}"

    def showData(self, codes: Any) -> int:
        return self._take(codes)

    def close(self) -> None:
        self.is_open = False


@pytest.fixture(params=[3, 4])
def panel(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Panel:
    panel = Panel()
    panel.install(monkeypatch, request.param)
    return panel


def test_codes_reach_the_panel_unchanged_and_it_is_given_back(panel: Panel) -> None:
    slm = HoloeyeSlm((4, 6))
    assert slm.show(CODES).number == 1
    with pytest.raises(DriverError, match="uint8 was wanted"):
        slm.show(CODES.T)
    np.testing.assert_array_equal(panel.shown, [CODES])
    slm.close()
    slm.close()
    assert not panel.is_open
    with pytest.raises(DeviceLostError, match="closed"):
        slm.show(CODES)


def test_what_the_sdk_says_is_passed_on(panel: Panel) -> None:
    slm = HoloeyeSlm((4, 6))
    panel.error = 7
    with pytest.raises(DeviceLostError, match="error 7"):
        slm.show(CODES)
    with pytest.raises(DriverError, match=r"open a panel.*error 7"):
        HoloeyeSlm((4, 6))


def test_a_panel_of_another_size_is_refused_and_given_back(panel: Panel) -> None:
    with pytest.raises(DriverError, match="6 x 4 pixels, 1920 x 1080 was wanted"):
        HoloeyeSlm((1080, 1920))
    assert not panel.is_open


def test_without_an_sdk_it_is_said_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HEDS", "holoeye", "holoeye.slmdisplaysdk"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(DriverError, match="PYTHONPATH"):
        HoloeyeSlm((4, 6))
