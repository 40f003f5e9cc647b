"""Kernel sources, headers and defines to callable kernels, with a binary cache on disk.

A cache entry is keyed by everything that changes the binary: the joined sources, the options, the platform,
the device and its driver's version. Entries are written to a temporary name and moved into place, so two
processes may build at once; each carries its own checksum, so a damaged one is rebuilt. `ADOF_CACHE_DIR`
moves the cache; set it to an empty string to have none.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import platformdirs
import pyopencl as cl

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import BuildError, DeviceError, InputError

CACHE_VARIABLE = "ADOF_CACHE_DIR"

_MAGIC = b"adof-cl program 1\n"
_INCLUDE = re.compile(r'^[ \t]*#[ \t]*include[ \t]+"([^"]+)"[^\n]*$', re.MULTILINE)

# Kept alive: a simulator forgets what was written where an address is used again, and constants have some.
_simulated: list[cl.Program] = []

Argument = DeviceArray | np.generic | None
"""What a kernel takes: an array on the device, a NumPy scalar of the exact type, or None for no buffer."""


def kernel_folder() -> Path:
    """Return where the .cl files lie: inside an installed package, or beside it in the source tree."""
    installed = Path(__file__).parent / "kernels"
    return installed if installed.is_dir() else Path(__file__).parent.parent / "kernels"


def cache_folder() -> Path | None:
    """Return where compiled programs are kept, or None when the cache is switched off."""
    chosen = os.environ.get(CACHE_VARIABLE)
    if chosen is None:
        return Path(platformdirs.user_cache_dir("adof-cl", appauthor=False))
    return Path(chosen) if chosen else None


def _expand(name: str, text: str, included: set[str]) -> str:
    """Inline our own headers, each once, keeping every line's file and number for error messages."""
    pieces = [f'#line 1 "{name}"\n']
    start = 0
    for match in _INCLUDE.finditer(text):
        header = match.group(1)
        pieces.append(text[start : match.start()])
        start = match.end() + 1
        if header not in included:
            included.add(header)
            pieces.append(_expand(header, _read(header), included))
        line = text.count("\n", 0, start) + 1
        pieces.append(f'#line {line} "{name}"\n')
    pieces.append(text[start:])
    if not text.endswith("\n"):
        pieces.append("\n")
    return "".join(pieces)


def _read(name: str) -> str:
    path = kernel_folder() / name
    try:
        return path.read_text(encoding="utf-8")
    except OSError as failure:
        raise BuildError(
            f"kernel source {name} is missing from {path.parent}: reinstall adof-cl"
        ) from failure


def _define(name: str, value: bool | int | float | str) -> str:
    if isinstance(value, bool):
        value = int(value)
    return f"-D{name}={value!r}" if isinstance(value, float) else f"-D{name}={value}"


class Launch:
    """One kernel with its arguments and sizes fixed; call it to enqueue it. It never waits.

    Setting arguments once and enqueuing many times is what keeps the host out of the frame loop.
    """

    def __init__(
        self,
        device: Device,
        kernel: cl.Kernel,
        global_size: tuple[int, ...],
        local_size: tuple[int, ...] | None,
        arguments: Sequence[Argument],
    ) -> None:
        self._device = device
        self._kernel = kernel
        self._global_size = global_size
        self._local_size = local_size
        self._arguments = list(arguments)  # holds the arrays, so that they outlive the launch
        for index, argument in enumerate(arguments):
            self._pass(index, argument)

    def set(self, index: int, argument: Argument) -> None:
        """Replace one argument from the next call on; costs next to nothing where it is the same object."""
        if argument is not self._arguments[index]:
            self._pass(index, argument)

    def _pass(self, index: int, argument: Argument) -> None:
        self._arguments[index] = argument
        if isinstance(argument, np.generic):
            # The public way tries everything else that a number could be first: 10 us instead of 0.1.
            self._kernel._set_arg_buf(index, argument)  # type: ignore[attr-defined]  # noqa: SLF001
        else:
            self._kernel.set_arg(index, None if argument is None else argument.buffer)

    def update(self, arguments: Mapping[int, Argument]) -> None:
        """Replace several arguments, by index, from the next call on."""
        for index, argument in arguments.items():
            self.set(index, argument)

    def __call__(self) -> cl.Event:
        """Enqueue on the device's in-order queue and return the event."""
        event = cl.enqueue_nd_range_kernel(
            self._device.queue, self._kernel, self._global_size, self._local_size
        )
        if self._device.events is not None:
            self._device.events.append(event)
        return event


class Program:
    """Kernels of one source, built for one device with one set of defines.

    Parameters
    ----------
    device
        The opened device.
    source
        Name of a file in `kernels/`, such as "ssd_search.cl".
    defines
        Specialisation: name to number or token. `REAL_IS_DOUBLE` is the convention for precision.
    generated
        Source text written by the host (a name for error messages, and the text), placed before the file:
        only for what OpenCL C cannot say itself.
    options
        Compiler options beyond `-cl-std=CL1.2`.

    Raises
    ------
    BuildError
        The source does not compile; the message holds the compiler's own lines, with file and line number.
    """

    def __init__(
        self,
        device: Device,
        source: str,
        defines: Mapping[str, bool | int | float | str] | None = None,
        *,
        generated: tuple[str, str] | None = None,
        options: Sequence[str] = (),
    ) -> None:
        self.device = device
        included: set[str] = set()
        text = "" if generated is None else _expand(generated[0], generated[1], included)
        self.source = text + _expand(source, _read(source), included)
        self.options = [
            "-cl-std=CL1.2",
            # Oclgrind stops at an instruction its own optimiser writes.
            *(["-cl-opt-disable"] if device.facts.simulated else []),
            *device.build_options,
            *options,
            *(_define(name, value) for name, value in sorted((defines or {}).items())),
        ]
        self._name = source
        self._program = self._cached_or_built()
        if device.facts.simulated:
            _simulated.append(self._program)

    def launch(
        self,
        kernel: str,
        global_size: tuple[int, ...],
        local_size: tuple[int, ...] | None,
        *arguments: Argument,
    ) -> Launch:
        """Bind a kernel to its arguments; each launch owns its own kernel object."""
        handle = cl.Kernel(self._program, kernel)
        if handle.num_args != len(arguments):
            raise InputError(
                f"kernel {kernel} takes {handle.num_args} arguments, {len(arguments)} came: give one for each"
            )
        return Launch(self.device, handle, global_size, local_size, arguments)

    def _key(self) -> str:
        facts = self.device.facts
        parts = (self.source, *self.options, facts.platform, facts.name, facts.version, facts.driver_version)
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()

    def _cached_or_built(self) -> cl.Program:
        folder = cache_folder()
        if folder is None or self.device.facts.simulated:  # a simulator's binary is of no use to anyone
            return self._built_from_source()
        path = folder / f"{self._key()}.bin"
        binary = _load(path)
        if binary is not None:
            program = self._built_from_binary(binary)
            if program is not None:
                return program
        program = self._built_from_source()
        binaries = cast("list[bytes]", program.get_info(cl.program_info.BINARIES))
        if not binaries or not binaries[0]:
            return program
        _store(path, binaries[0])
        # PoCL compiles source builds anew in every process; only a program made from its binary finds
        # its own cache again. So the first run already uses the binary, as every later one will.
        return self._built_from_binary(binaries[0]) or program

    def _built_from_binary(self, binary: bytes) -> cl.Program | None:
        try:
            program = cl.Program(self.device.context, [self.device.handle], [binary])
            return _build(program, self.options)
        except cl.Error:  # written by a driver that no longer takes it
            return None

    def _built_from_source(self) -> cl.Program:
        program = cl.Program(self.device.context, self.source)
        try:
            return _build(program, self.options)
        except cl.Error as failure:
            lines = [line for line in str(failure).splitlines() if "error" in line.lower()]
            shown = "; ".join(line.strip() for line in lines[:4]) or str(failure)
            raise BuildError(
                f"{self._name} does not compile on {self.device.facts} with {' '.join(self.options)}: {shown}"
            ) from failure


def _build(program: cl.Program, options: list[str]) -> cl.Program:
    with warnings.catch_warnings():
        # pyopencl warns of any compiler output, a driver's "compilation done" included; real errors raise.
        warnings.simplefilter("ignore")
        return cast("cl.Program", program.build(options=options))


def _load(path: Path) -> bytes | None:
    """Return the binary of an intact entry; None when there is none or it is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    head = len(_MAGIC) + 32
    checksum, binary = content[len(_MAGIC) : head], content[head:]
    if content[: len(_MAGIC)] != _MAGIC or hashlib.sha256(binary).digest() != checksum:
        return None
    return binary


def _store(path: Path, binary: bytes) -> None:
    """Write an entry so that no reader ever sees half of it; a full or read-only disk is no failure."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_MAGIC + hashlib.sha256(binary).digest() + binary)
            Path(temporary).replace(path)
        except OSError:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as failure:
        warnings.warn(f"compiled kernels could not be kept in {path.parent}: {failure}", stacklevel=2)


_VECTOR_BYTES = """\
__kernel void vector_bytes(__global int *bytes)
{
#if defined(__AVX512F__)
    bytes[0] = 64;
#elif defined(__AVX__)
    bytes[0] = 32;
#elif defined(__SSE2__) || defined(__ARM_NEON)
    bytes[0] = 16;
#else
    bytes[0] = 0;
#endif
}
"""


def vector_bytes(device: Device) -> int:
    """Return the width of the vectors a lanes kernel should use on this device: 16, 32 or 64 bytes.

    A device reports what its processor has; its compiler may be older and use half of it, and then vectors
    of the full width do not fit the registers. The compiler's own word goes before the device's.
    """
    if device.vector_bytes is None:
        program = Program(device, "precision.h", generated=("vector_bytes.cl", _VECTOR_BYTES))
        said = device.empty((1,), np.int32)
        program.launch("vector_bytes", (1,), (1,), said)()
        widest = int(said.download()[0]) or device.facts.vector_bytes
        device.vector_bytes = max(size for size in (16, 32, 64) if size <= max(widest, 16))
    return device.vector_bytes


def require_local_memory(device: Device, wanted_bytes: int, what: str) -> None:
    """Refuse a launch that needs more local memory than the device has.

    Raises
    ------
    DeviceError
        Names what was wanted and what there is.
    """
    have = device.facts.local_memory_bytes
    if wanted_bytes > have:
        raise DeviceError(
            f"{what} needs {wanted_bytes} bytes of local memory, {device.facts} has {have}: "
            "use a smaller size"
        )
