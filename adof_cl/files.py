"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from adof_cl.errors import InputError


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


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
