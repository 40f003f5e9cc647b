"""Files that appear whole or not at all, and files of ours that are read as what they are or refused."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import pydantic

from adof_cl.errors import InputError

T = TypeVar("T")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` (same suffix); move it into place when the block succeeds.

    When the block raises, nothing is left behind and an older file at `path` stays as it was.

    Raises
    ------
    InputError
        The place cannot be written.
    """
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=path.suffix)
        os.close(handle)
    except OSError as failure:
        raise InputError(f"{path} cannot be written ({failure.strerror}): choose another place") from failure
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    except OSError as failure:
        raise InputError(f"{path} cannot be written ({failure.strerror}): choose another place") from failure
    finally:
        temporary.unlink(missing_ok=True)


def read_versioned(path: Path, adapter: pydantic.TypeAdapter[T], version: int, kind: str, maker: str) -> T:
    """Read a JSON file that states its `schema_version`.

    Parameters
    ----------
    kind, maker
        What the file is, and what writes one: for the refusal.

    Raises
    ------
    InputError
        It cannot be read, is something else, or is of another version.
    """
    other = f"{path} is not {kind}: give one that {maker} wrote"
    try:
        values = json.loads(path.read_bytes())
    except OSError as failure:
        raise InputError(f"{path} cannot be read ({failure.strerror}): {maker} writes {kind}") from failure
    except ValueError as failure:
        raise InputError(other) from failure
    found = values.get("schema_version") if isinstance(values, dict) else None
    if isinstance(found, int) and found != version:
        raise InputError(f"{path} has schema version {found}, {version} was wanted: {maker} writes it anew")
    try:
        return adapter.validate_python(values)
    except pydantic.ValidationError as failure:
        raise InputError(other) from failure


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
