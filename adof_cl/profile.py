"""A device's profile: what each way of following a feature costs there, and how far off it is.

`adof tradeoff` measures and writes it; the planner reads it. Times are those of one device, errors those of
the arithmetic and the optics, against the twin's truth.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import platformdirs
import pydantic

from adof_cl.errors import InputError
from adof_cl.files import read_versioned
from adof_cl.pipeline import Window
from adof_cl.program import CACHE_VARIABLE
from adof_cl.turns import Spread

SCHEMA = 2
_INFINITE = pydantic.ConfigDict(ser_json_inf_nan="constants")  # a lost feature's error: written, not null
_IDENTITY = ("name", "platform", "driver_version")

RESTORATIONS = ("none", "half", "float32", "float64")
"""No restoration; or with the object's own filter, its spectrum kept in this precision."""
REFINES = ("integer", "quadratic", "gauss_newton")
WINDOWS = (96, 128, 160, 192, 256, 0)
"""Sides of the square window around an object, pixels; 0 is the whole frame."""
TEMPLATE_PX = 20
SEARCHES = (32, 48, 64)
PADDING = 32
"""Samples added to a window that is restored."""


@dataclass(frozen=True)
class Reading:
    """One setting of one knob.

    Attributes
    ----------
    stage, knob, setting
        Which.
    time_s
        Of what the knob changes: the stage, or the whole chain from frame to features.
    whole_chain
        Which of the two.
    error_px, error_um
        Largest distance of a feature from the truth: 95 % of frames are better. Infinite: features lost.
    depth_um
        Largest error of depth in 95 % of frames, where the knob bears on depth.
    image_l2
        Relative L2 distance of the restored image from the one of float64 and exact optics; None without one.
    """

    __pydantic_config__: ClassVar = _INFINITE
    stage: str
    knob: str
    setting: str
    time_s: Spread
    whole_chain: bool
    error_px: float
    error_um: float
    depth_um: float | None = None
    image_l2: float | None = None

    @property
    def worst_um(self) -> float:
        """The larger of the errors of place and of depth."""
        return self.error_um if self.depth_um is None else max(self.error_um, self.depth_um)


@dataclass(frozen=True)
class Chain:
    """How one object is followed, from frame to features.

    Attributes
    ----------
    restoration
        One of `RESTORATIONS`.
    window_px
        One of `WINDOWS`.
    refine, template_px, search_px
        How its features are found.
    """

    restoration: str
    window_px: int
    refine: str
    template_px: int
    search_px: int

    def window(self, shape: tuple[int, int]) -> Window:
        """Return what `WindowedPipeline` is told, for frames of `shape`."""
        return Window(
            shape=(self.window_px, self.window_px) if self.window_px else shape,
            search_shape=(self.search_px, self.search_px),
            refine=self.refine,
            precision="float64" if self.restoration == "float64" else "float32",
            spectrum_dtype="float16" if self.restoration == "half" else None,
            padding=PADDING,
        )

    def __str__(self) -> str:
        where = f"{self.window_px} px window" if self.window_px else "whole frame"
        return f"{self.restoration}, {where}, {self.refine}, {self.template_px} px in {self.search_px}"


REFERENCE = Chain("float32", 160, "quadratic", TEMPLATE_PX, SEARCHES[0])
"""One object, one feature: other chains' times are this one's and what they add; paces are taken from it."""


@dataclass(frozen=True)
class ChainTime:
    """Time of one object's chain for so many features."""

    chain: Chain
    features: int
    time_s: Spread


@dataclass(frozen=True)
class ChainError:
    """Error of one object's chain at one blur.

    Attributes
    ----------
    alpha_rad, share
        The mask, and |psi|/(3 alpha); without a mask `share` is |psi| itself.
    errors_px
        The farthest that any object's worst feature was off, at each of `DeviceProfile.noises_grey`.
    """

    __pydantic_config__: ClassVar = _INFINITE
    restoration: str
    refine: str
    template_px: int
    alpha_rad: float
    share: float
    errors_px: list[float]


@dataclass(frozen=True)
class FormTime:
    """Time to form an object's filter anew, on top of its chain's."""

    restoration: str
    window_px: int
    time_s: Spread


@dataclass(frozen=True)
class DeviceProfile:
    """One device, measured.

    Attributes
    ----------
    device, machine, version, when, settings
        What it depends on: the device's facts with its driver's version among them.
    readings
        Every knob that was turned.
    times, forms, errors
        What plans are made of.
    shared_s
        What a second object in the same frame does not pay again.
    mask_s
        Time to compute a mask's panel codes.
    noises_grey, nsr
        Noises of the frames on which `errors` were measured, the least first; and of the filters.
    blur_px
        lambda N over the object's pixel pitch, of the optics on which they were measured.
    shape
        Of the whole frame, (rows, columns).
    """

    schema_version: int
    version: str
    when: str
    device: dict[str, Any]
    machine: dict[str, Any]
    settings: dict[str, Any]
    noises_grey: list[float]
    nsr: float
    blur_px: float
    shape: tuple[int, int]
    readings: list[Reading]
    times: list[ChainTime]
    forms: list[FormTime]
    errors: list[ChainError]
    shared_s: float
    mask_s: float

    def to_json(self) -> str:
        """Return the text of a profile file."""
        return _PROFILE.dump_json(self, indent=1).decode() + "\n"

    @classmethod
    def read(cls, path: Path) -> DeviceProfile:
        """Read a profile that `adof tradeoff --json` wrote.

        Raises
        ------
        InputError
            It cannot be read, or is not one of this version's.
        """
        return read_versioned(path, _PROFILE, SCHEMA, "a device profile", "adof tradeoff --json FILE")

    @classmethod
    def of_device(cls, facts: dict[str, Any]) -> DeviceProfile:
        """Read the profile kept of this device.

        Raises
        ------
        InputError
            None is kept: it says how to make one.
        """
        path = kept_at(facts)
        if not path.is_file():
            raise InputError(
                f"no profile of {facts['name']} is kept here: run adof tradeoff once, or give --profile FILE"
            )
        return cls.read(path)

    @property
    def reference_s(self) -> float:
        """Time of `REFERENCE` for one feature.

        Raises
        ------
        InputError
            It was not measured.
        """
        for timed in self.times:
            if timed.chain == REFERENCE and timed.features == 1:
                return timed.time_s.median
        raise InputError("the profile holds no times to plan with: measure it anew with adof tradeoff")

    def fits(self, facts: dict[str, Any]) -> bool:
        """Whether it was measured on the device of these facts, with the same driver."""
        return all(self.device.get(key) == facts.get(key) for key in _IDENTITY)


def kept_at(facts: dict[str, Any]) -> Path:
    """Return where the profile of a device with this driver is kept: beside its compiled kernels."""
    folder = Path(os.environ.get(CACHE_VARIABLE) or platformdirs.user_cache_path("adof-cl"))
    identity = "\n".join([str(SCHEMA), *(str(facts[key]) for key in _IDENTITY)])
    return folder / f"profile-{hashlib.sha256(identity.encode()).hexdigest()[:16]}.json"


_PROFILE = pydantic.TypeAdapter(DeviceProfile)
