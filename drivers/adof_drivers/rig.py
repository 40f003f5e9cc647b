"""The rig file: which device is on which port, strict, with units in names; and the check of what it names.

    [camera.1]
    driver = "gige"
    address = "192.168.0.11"

    [stage.coarse]
    driver = "gcs"
    tcp = "192.168.0.20:50000"
    [stage.coarse.axes.x]
    wire = "1"
    um_per_unit = 1000.0
    speed_limit_um_per_s = 2000.0
    resolution_um = 0.1

A section is a kind, a name and a driver. A driver joins by `register`, its module by a line in `_MODULES`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from adof_drivers.errors import DriverError, RequestError

_MODULES = (
    "adof_drivers.camera_sections",
    "adof_drivers.slm_sections",
    "adof_drivers.stage_sections",
    "adof_drivers.operator_sections",
)

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
"""A finite number above 0."""


@dataclass(frozen=True)
class Finding:
    """One row of a check: `good` is whether it is as it should be, `mend` what to do where it is not."""

    device: str
    what: str
    found: str
    good: bool = True
    mend: str = ""


class Section(BaseModel):
    """What a rig file says of one device. An unknown key is refused, and so is a number given as text."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    driver: str

    def open(self) -> Any:
        """Open the device; moves nothing.

        Raises
        ------
        DriverError
            It cannot be opened; the message says what to do.
        """
        raise NotImplementedError

    def check(self, name: str, device: Any, *, move: bool) -> list[Finding]:
        """Look at an open device; `move` allows small motions, which the operator has agreed to."""
        raise NotImplementedError


_Class = TypeVar("_Class", bound=type[Section])
_SECTIONS: dict[tuple[str, str], type[Section]] = {}


def register(kind: str, driver: str) -> Callable[[_Class], _Class]:
    """Have sections `[kind.NAME]` with this driver read by the class."""

    def join(section: _Class) -> _Class:
        _SECTIONS[kind, driver] = section
        return section

    return join


def load(path: Path, *, tables: Mapping[str, type[BaseModel]] | None = None) -> dict[str, Any]:
    """Read a rig file: sections by "kind.name", in the file's order.

    Parameters
    ----------
    tables
        What else may stand in it, by name: one table each, read by its class and returned under that name.

    Raises
    ------
    RequestError
        No file, no TOML, no device, or anything in it that is not known or not of its kind.
    """
    for module in _MODULES:
        import_module(module)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as failure:
        raise RequestError(f"{path} cannot be read ({failure}): give a rig file") from None
    except tomllib.TOMLDecodeError as failure:
        raise RequestError(f"{path} is no TOML ({failure}): mend that line") from None
    tables = tables or {}
    sections: dict[str, Any] = {}
    for kind, devices in content.items():
        if kind in tables:
            sections[kind] = _read(path, kind, tables[kind], devices)
            continue
        known = sorted(driver for of, driver in _SECTIONS if of == kind)
        if not known or not isinstance(devices, dict):
            kinds = ", ".join(sorted({of for of, _ in _SECTIONS} | set(tables)))
            raise RequestError(f"{path}: {kind!r} is no kind of device: {kinds} was wanted")
        for name, entry in devices.items():
            place = f"{kind}.{name}"
            driver = entry.get("driver") if isinstance(entry, dict) else None
            if driver not in known:
                raise RequestError(
                    f"{path}: {place} has driver {driver!r}: one of {', '.join(known)} was wanted"
                )
            sections[place] = _read(path, place, _SECTIONS[kind, driver], entry)
    if not sections.keys() - tables.keys():
        raise RequestError(f"{path} names no device: begin with a section like [stage.coarse]")
    return sections


def _read(path: Path, place: str, model: type[BaseModel], entry: Any) -> BaseModel:
    try:
        return model.model_validate(entry)
    except ValidationError as failure:
        raise RequestError(f"{path}: {_first(place, failure)}") from None


def _first(place: str, failure: ValidationError) -> str:
    error = failure.errors()[0]
    key = ".".join((place, *map(str, error["loc"])))
    if error["type"] == "extra_forbidden":
        return f"{key} is not known: check its spelling and its unit"
    if error["type"] == "missing":
        return f"{key} is missing: add it"
    return f"{key}: {error['msg'].removeprefix('Value error, ')}"


def check(sections: dict[str, Section], *, move: bool = False) -> list[Finding]:
    """Open everything, look, close in reverse order whatever happens; moves nothing unless `move`."""
    findings = []
    with ExitStack() as stack:
        for name, section in sections.items():
            try:
                device = section.open()
                stack.callback(device.close)
                findings += section.check(name, device, move=move)
            except DriverError as failure:
                said, _, mend = str(failure).rpartition(": ")
                findings.append(Finding(name, "works", said or str(failure), good=False, mend=mend))
    return findings
