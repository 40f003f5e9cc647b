"""What is to be seen, and how precisely: objects, depths, places, noise, the accuracy of each phase.

The planner's input. Read from a JSON file, or made by the loop as the scene changes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import pydantic

from adof_cl.errors import InputError
from adof_cl.finite import checked_shape
from adof_cl.optics import Mask, OpticalSystem, require_finite, require_positive, require_whole

_NOTHING_ELSE = pydantic.ConfigDict(extra="forbid")  # a misspelt name is said, not passed over


@dataclass(frozen=True)
class SceneObject:
    """One object to follow.

    Attributes
    ----------
    name
        What it is called.
    depth_um, depth_sigma_um
        Distance beyond the plane in focus without a mask, and its standard deviation.
    extent_px
        Side of the square about its features' middle that holds the middles of their templates.
    features
        How many are followed.
    place_sigma_px
        How well it is known where a feature will appear, before the frame: standard deviation.
    speed_um_per_s
        How fast its depth changes.
    accuracy_um
        By phase: how far off a feature may be measured, at the object.
    depth_accuracy_um
        By phase: how far off its depth may be measured. A phase that is missing needs no depth.
    """

    __pydantic_config__: ClassVar = _NOTHING_ELSE
    name: str
    depth_um: float
    depth_sigma_um: float = 0.0
    extent_px: float = 90.0
    features: int = 2
    place_sigma_px: float = 1.0
    speed_um_per_s: float = 0.0
    accuracy_um: Mapping[str, float] = field(default_factory=dict)
    depth_accuracy_um: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_finite(depth_um=self.depth_um, speed_um_per_s=self.speed_um_per_s)
        for name in ("depth_sigma_um", "extent_px", "place_sigma_px"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"{name} of '{self.name}' is {value}: a number of 0 or more was wanted")
        require_whole(**{f"features of '{self.name}'": self.features})
        for values in (self.accuracy_um, self.depth_accuracy_um):
            for phase, value in values.items():
                require_positive(**{f"accuracy of '{self.name}' in phase '{phase}'": value})


@dataclass(frozen=True)
class Scene:
    """Everything a plan depends on.

    Attributes
    ----------
    phase
        Which of the objects' accuracies count now.
    noise_grey
        Standard deviation of a frame's noise, of 255.
    shape
        Region of interest, (rows, columns).
    mask_2, tilt_deg
        Camera 2's fixed mask, and how far it looks aside; None: there is no second camera, and no depth.
    """

    __pydantic_config__: ClassVar = _NOTHING_ELSE
    objects: tuple[SceneObject, ...]
    phase: str = "dock"
    noise_grey: float = 1.3
    frame_rate_hz: float = 60.0
    shape: tuple[int, int] = (400, 512)
    mask_2: Mask | None = None
    tilt_deg: float = 30.0
    optics: OpticalSystem = field(default_factory=OpticalSystem)

    def __post_init__(self) -> None:
        if not self.objects:
            raise InputError("the scene holds no object: state at least one")
        names = [thing.name for thing in self.objects]
        if len(set(names)) < len(names):
            raise InputError(f"objects are called {', '.join(names)}: give each its own name")
        require_positive(frame_rate_hz=self.frame_rate_hz, noise_grey=self.noise_grey)
        checked_shape("shape", self.shape, 96)
        for thing in self.objects:
            if thing.extent_px > max(self.shape):
                raise InputError(
                    f"extent_px of '{thing.name}' is {thing.extent_px:g}: the frame has {self.shape[1]} x "
                    f"{self.shape[0]} pixels, so follow features that lie closer together"
                )
        if not 1 <= self.tilt_deg <= 90:
            raise InputError(f"tilt_deg is {self.tilt_deg}: 1 to 90 was wanted")

    @classmethod
    def read(cls, path: Path) -> Scene:
        """Read a scene from a JSON file with these attributes' names.

        Raises
        ------
        InputError
            It cannot be read, or states something that no scene has; the message names the first.
        """
        try:
            return _SCENE.validate_json(path.read_bytes())
        except OSError as failure:
            raise InputError(f"{path} cannot be read ({failure.strerror}): give a scene file") from failure
        except pydantic.ValidationError as failure:
            first = failure.errors()[0]
            place = ".".join(str(step) for step in first["loc"]) or "the file"
            raise InputError(
                f"{path} is no scene: {place}: {first['msg'].removeprefix('Value error, ')}"
            ) from failure

    def to_json(self) -> str:
        """Return the text of a scene file."""
        return _SCENE.dump_json(self, indent=1).decode() + "\n"


_SCENE = pydantic.TypeAdapter(Scene)
