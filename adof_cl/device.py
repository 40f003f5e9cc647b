"""Choose and open one OpenCL device; its facts; arrays on it, and copies that hide behind kernels; waiting.

`pyopencl` enters the package here and in `program`, nowhere else.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from adof_cl.errors import DeviceError, InputError

# PoCL's sleeping workers wake too late for sub-millisecond kernels unless they are pinned; it reads this
# when the platform loads. The user's own value stands.
os.environ.setdefault("POCL_AFFINITY", "1")
# `program` keeps its own binary cache: pyopencl's stores a second, generic compilation of every kernel.
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")

import pyopencl as cl

SELECTOR_VARIABLE = "ADOF_DEVICE"

_TYPE_NAMES = ("gpu", "cpu", "accelerator")


@dataclass(frozen=True)
class DeviceFacts:
    """What decides how kernels are built and launched; never a vendor's name.

    Attributes
    ----------
    index
        Position in `list_devices()`; a valid selector.
    kind
        "gpu", "cpu" or "accelerator".
    simulated
        A simulator or an FPGA emulator: correct, slow, and never chosen unless asked for by name or index.
    vector_bytes
        Width of the device's native float vector.
    cache_bytes
        The device's largest cache for global memory; 0: none it would tell of.
    """

    index: int
    name: str
    platform: str
    kind: str
    version: str
    driver_version: str
    fp64: bool
    compute_units: int
    local_memory_bytes: int
    global_memory_bytes: int
    max_allocation_bytes: int
    max_work_group_size: int
    vector_bytes: int
    cache_bytes: int
    simulated: bool

    def as_dict(self) -> dict[str, Any]:
        """Return the facts as JSON-ready values."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.name} ({self.platform})"


def _kind(device: cl.Device, simulated: bool) -> str:
    flags = int(device.type)
    # Oclgrind claims to be every type at once.
    if simulated and flags & int(cl.device_type.CPU):
        return "cpu"
    for name, flag in (("gpu", cl.device_type.GPU), ("cpu", cl.device_type.CPU)):
        if flags & int(flag):
            return name
    return "accelerator"


def _facts(index: int, platform: cl.Platform, device: cl.Device) -> DeviceFacts:
    name = " ".join(str(device.name).split())
    platform_name = str(platform.name)
    text = f"{name} {platform_name}".lower()
    simulated = "oclgrind" in text or "simulator" in text or "emulat" in text
    return DeviceFacts(
        index=index,
        name=name,
        platform=platform_name,
        kind=_kind(device, simulated),
        version=str(device.version),
        driver_version=str(device.driver_version),
        fp64="cl_khr_fp64" in str(device.extensions).split(),
        compute_units=int(device.max_compute_units),
        local_memory_bytes=int(device.local_mem_size),
        global_memory_bytes=int(device.global_mem_size),
        max_allocation_bytes=int(device.max_mem_alloc_size),
        max_work_group_size=int(device.max_work_group_size),
        vector_bytes=4 * max(1, int(device.native_vector_width_float)),
        cache_bytes=int(device.global_mem_cache_size),
        simulated=simulated,
    )


def _found() -> list[tuple[DeviceFacts, cl.Device]]:
    try:
        platforms = cl.get_platforms()
    except cl.Error as failure:  # the loader answers -1001 when it knows no platform at all
        raise DeviceError(
            "no OpenCL platform was found: install a runtime, for example `pip install "
            "pocl-binary-distribution`"
        ) from failure
    found: list[tuple[DeviceFacts, cl.Device]] = []
    for platform in platforms:
        try:
            devices = platform.get_devices()
        except cl.Error:  # a platform whose hardware is absent; the others still count
            continue
        found.extend((_facts(len(found) + i, platform, device), device) for i, device in enumerate(devices))
    if not found:
        raise DeviceError(
            "no OpenCL device was found: install a runtime, for example `pip install "
            "pocl-binary-distribution`"
        )
    return found


def list_devices() -> list[DeviceFacts]:
    """List every OpenCL device on this machine, in the order their indices name them.

    Raises
    ------
    DeviceError
        No OpenCL platform or device at all.
    """
    return [facts for facts, _ in _found()]


def choose(devices: Sequence[DeviceFacts], selector: str | None = None) -> DeviceFacts:
    """Pick one device: by selector if given, else GPU before CPU and never a simulator.

    Parameters
    ----------
    devices
        As `list_devices` gives them.
    selector
        An index ("1"), a type ("cpu", "gpu", "accelerator"), or part of a device's or platform's name, in
        any case. A type never picks a simulator; a name or an index may.

    Raises
    ------
    DeviceError
        Nothing fits; the message lists what there is.
    """
    real = [d for d in devices if not d.simulated]
    wanted = (selector or "").strip().lower()
    if not wanted:
        for kind in _TYPE_NAMES:
            for device in real:
                if device.kind == kind:
                    return device
        fits: list[DeviceFacts] = []
    elif wanted.isdecimal():
        fits = [d for d in devices if d.index == int(wanted)]
    elif wanted in _TYPE_NAMES:
        fits = [d for d in real if d.kind == wanted]
    else:
        # PoCL's platform spells its name out; only its version string says "PoCL".
        fits = [d for d in devices if wanted in f"{d.name} {d.platform} {d.version}".lower()]
        # A CPU's own name may hold its maker's: the platform of that name comes first.
        fits.sort(key=lambda d: (d.simulated, wanted not in d.platform.lower()))
    if fits:
        return fits[0]
    listing = "; ".join(f"{d.index}: {d}" for d in devices) or "none"
    asked = f"no OpenCL device fits '{selector}'" if wanted else "no OpenCL device but simulators was found"
    raise DeviceError(f"{asked}: choose an index, a type or a part of a name from [{listing}]")


# Copying so little twice costs less than one wait for the queue.
_SMALL_BYTES = 1 << 14


class DeviceArray:
    """A C-ordered array in the device's memory.

    `shape` and `dtype` are NumPy's. `upload` and `download` keep their place among the kernels of the queue.
    For streams, where copies hide behind kernels, the same comes in two halves: `stage` and `send`,
    `begin_download` and `download`.
    """

    def __init__(self, device: Device, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self.device = device
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self.size = int(np.prod(shape, dtype=np.int64))
        self.nbytes = self.size * self.dtype.itemsize
        if self.nbytes > device.facts.max_allocation_bytes:
            raise DeviceError(
                f"an array of {self.nbytes} bytes was asked for, {device.facts} allocates at most "
                f"{device.facts.max_allocation_bytes}: use a smaller frame or another device"
            )
        self.buffer = self._allocated()
        self._leaving: NDArray[Any] | None = None  # on the host, as long as the array lives
        self._left: cl.Event | None = None
        self._host: NDArray[Any] | None = None
        self._arrival: tuple[cl.Event, NDArray[Any]] | None = None

    def upload(self, values: NDArray[Any]) -> DeviceArray:
        """Copy `values` (same shape and dtype) to the device; returns when the host may reuse them."""
        self.require_alike(values)
        if self.nbytes <= _SMALL_BYTES:
            self._leave(self.device.queue, self._put(values))
        else:
            cl.enqueue_copy(self.device.queue, self.buffer, np.ascontiguousarray(values), is_blocking=True)
        return self

    def stage(self, values: NDArray[Any]) -> None:
        """Take a copy of `values` (same shape and dtype) for `send`; waits for no kernel. The last counts.

        Where copies have a queue of their own this one starts now: nothing enqueued may still use the array.
        """
        self.require_alike(values)
        staged = self._put(values)
        if self.device.copies_apart:
            self._leave(self.device.upload_queue, staged)
            self.device.upload_queue.flush()

    def send(self) -> DeviceArray:
        """Enqueue the arrival of what was staged; does not wait.

        Raises
        ------
        InputError
            Nothing was ever staged.
        """
        if self._leaving is None:
            raise InputError("nothing was staged: call stage with the values first")
        if self.device.copies_apart and self._left is not None:
            cl.enqueue_barrier(self.device.queue, wait_for=[self._left])
        else:
            self._leave(self.device.queue, self._leaving)
        return self

    def begin_download(self, written: cl.Event | None = None) -> None:
        """Start the copy that the next `download` returns, after everything enqueued before.

        Until it is downloaded nothing may be enqueued that writes the array. `written`: the event of the last
        launch, where the caller has it; it saves a command.
        """
        host, self._host = self._host, None
        if host is None:
            host = self.device.host_array(self.shape, self.dtype)
        computed = None
        if self.device.copies_apart:
            computed = [written or cl.enqueue_marker(self.device.queue)]
            self.device.queue.flush()
        queue = self.device.download_queue
        self._arrival = cl.enqueue_copy(queue, host, self.buffer, is_blocking=False, wait_for=computed), host
        queue.flush()

    @property
    def arrived(self) -> bool:
        """Whether `download` would return at once what `begin_download` began to copy."""
        done = cl.command_execution_status.COMPLETE
        return self._arrival is not None and self._arrival[0].command_execution_status <= done

    def download(self, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Copy to the host, after everything enqueued before; into `out` if given (same shape, dtype)."""
        self._require_room(out)
        if self._arrival is None:
            out = np.empty(self.shape, self.dtype) if out is None else out
            cl.enqueue_copy(self.device.queue, out, self.buffer, is_blocking=True)
            return out
        (event, host), self._arrival = self._arrival, None
        event.wait()
        if out is None and not self.device.copies_apart:
            return host  # the caller's own from now on
        self._host = host
        if out is None:
            return host.copy()
        np.copyto(out, host)
        return out

    def require_alike(self, values: NDArray[Any]) -> None:
        """Refuse, with InputError, what is not of this array's shape and dtype."""
        if values.shape != self.shape or values.dtype != self.dtype:
            raise InputError(
                f"an array of shape {values.shape} and type {values.dtype} came, {self.shape} and "
                f"{self.dtype} was wanted: convert it first"
            )

    def _require_room(self, out: NDArray[Any] | None) -> None:
        if out is not None and (
            out.shape != self.shape or out.dtype != self.dtype or not out.flags.c_contiguous
        ):
            raise InputError(
                f"out is {out.shape} {out.dtype}, a C-ordered {self.shape} {self.dtype} was wanted: "
                "allocate it like the device array"
            )

    def _allocated(self) -> Any:
        buffer = cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, max(self.nbytes, 1))
        self.device.made(buffer)
        return buffer

    def _put(self, values: NDArray[Any]) -> NDArray[Any]:
        if self._leaving is None:
            self._leaving = self.device.host_array(self.shape, self.dtype)
        if self._left is not None:
            self._left.wait()  # the copy before still reads from there
        np.copyto(self._leaving, values)
        return self._leaving

    def _leave(self, queue: cl.CommandQueue, values: NDArray[Any]) -> None:
        self._left = cl.enqueue_copy(queue, self.buffer, values, is_blocking=False)


class SharedArray(DeviceArray):
    """An array in memory that a CPU's kernels share with the host: a download is a wait and no command more.

    Some runtimes wake a worker anew for such a command, which takes longer than a small kernel.
    """

    def upload(self, values: NDArray[Any]) -> DeviceArray:
        """Write `values` (same shape and dtype) once everything enqueued before is done."""
        self.require_alike(values)
        self.device.queue.finish()
        np.copyto(self._shared, values)
        return self

    def begin_download(self, written: cl.Event | None = None) -> None:
        """Mark what the next `download` waits for: everything enqueued before, or `written`."""
        self._arrival = written or cl.enqueue_marker(self.device.queue), self._shared
        self.device.queue.flush()

    def download(self, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Copy to the host's own memory, after everything enqueued before; into `out` if given."""
        self._require_room(out)
        if self._arrival is None:
            self.device.queue.finish()
        else:
            self._arrival[0].wait()
            self._arrival = None
        if out is None:
            return self._shared.copy()
        np.copyto(out, self._shared)
        return out

    def _allocated(self) -> Any:
        self._shared: NDArray[Any] = cl.fsvm_empty(self.device.context, self.shape, self.dtype)
        return cl.SVM(self._shared)


class Device:
    """One opened OpenCL device: a context and one in-order queue of kernels.

    Make it with `Device.open()`. Plans take it, keep it, and enqueue on its queue.

    Attributes
    ----------
    copies_apart
        Whether a stream's copies go through queues of their own, beside the kernels, from and to pinned host
        memory. By default everywhere but on a CPU, which copies with the cores that compute.
    events
        None, or a list to which every launch adds its event: set one on a profiling device to time kernels.
    vector_bytes
        What `program.vector_bytes` found, once it was asked.
    build_options
        Compiler options of every program made from now on, such as "-cl-denorms-are-zero".
    """

    def __init__(
        self,
        facts: DeviceFacts,
        handle: cl.Device,
        *,
        profiling: bool = False,
        copies_apart: bool | None = None,
    ) -> None:
        self.facts = facts
        self.handle = handle
        self.events: list[cl.Event] | None = None
        self.vector_bytes: int | None = None
        self.build_options: tuple[str, ...] = ()
        self.context = cl.Context([handle])
        self._kept: list[cl.Buffer] = []
        self._shares_memory = facts.kind == "cpu" and not facts.simulated and _shares_memory(handle)
        if profiling:
            properties = cl.command_queue_properties.PROFILING_ENABLE
            self.queue = cl.CommandQueue(self.context, handle, properties=properties)
        else:
            self.queue = cl.CommandQueue(self.context, handle)
        self.copies_apart = facts.kind != "cpu" if copies_apart is None else copies_apart
        # One for each direction: a download waits for its kernels, and the next upload must not wait with it.
        self.upload_queue, self.download_queue = (
            cl.CommandQueue(self.context, handle) if self.copies_apart else self.queue for _ in range(2)
        )

    @classmethod
    def open(
        cls, selector: str | None = None, *, profiling: bool = False, copies_apart: bool | None = None
    ) -> Device:
        """Open the device `selector` names, else the one `ADOF_DEVICE` names, else the best real one.

        Raises
        ------
        DeviceError
            No device fits, or the driver cannot open it.
        """
        found = _found()
        facts = choose([f for f, _ in found], selector or os.environ.get(SELECTOR_VARIABLE))
        try:
            return cls(facts, found[facts.index][1], profiling=profiling, copies_apart=copies_apart)
        except cl.Error as failure:
            raise DeviceError(f"{facts} was found but could not be opened: {failure}") from failure

    def made(self, buffer: cl.Buffer) -> None:
        """Keep a simulator's buffers alive: it forgets what was written where an address is used again."""
        if self.facts.simulated:
            self._kept.append(buffer)

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike) -> DeviceArray:
        """Allocate an uninitialised array."""
        return DeviceArray(self, shape, dtype)

    def shared(self, shape: tuple[int, ...], dtype: DTypeLike) -> DeviceArray:
        """Allocate an uninitialised array for small results: where the device can, one that needs no copy."""
        return SharedArray(self, shape, dtype) if self._shares_memory else self.empty(shape, dtype)

    def upload(self, values: NDArray[Any]) -> DeviceArray:
        """Allocate an array like `values` and copy them to it."""
        return DeviceArray(self, values.shape, values.dtype).upload(values)

    def host_array(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Allocate an uninitialised array on the host; pinned where that lets copies run beside kernels."""
        if not self.copies_apart:
            return np.empty(shape, dtype)
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
        kind = np.dtype(dtype)
        pinned = cl.Buffer(self.context, flags, max(int(np.prod(shape, dtype=np.int64)), 1) * kind.itemsize)
        both: Any = cl.map_flags.READ | cl.map_flags.WRITE
        mapped: Any = cl.enqueue_map_buffer(self.queue, pinned, both, 0, shape, kind, is_blocking=True)
        array: NDArray[Any] = mapped[0]  # and mapped it stays for as long as it lives
        return array

    def wait(self) -> None:
        """Return when everything enqueued so far is done."""
        self.upload_queue.finish()
        self.queue.finish()
        self.download_queue.finish()

    def real_type(self, precision: str) -> np.dtype[Any]:
        """Return the NumPy type of "float32" or "float64" arithmetic on this device.

        Raises
        ------
        InputError
            Another name.
        DeviceError
            "float64" on a device without it.
        """
        if precision not in ("float32", "float64"):
            raise InputError(f"precision is '{precision}': choose 'float32' or 'float64'")
        if precision == "float64" and not self.facts.fp64:
            raise DeviceError(f"{self.facts} has no float64 arithmetic: use precision 'float32'")
        return np.dtype(precision)


def _shares_memory(device: cl.Device) -> bool:
    try:
        return bool(int(device.svm_capabilities) & int(cl.device_svm_capabilities.FINE_GRAIN_BUFFER))
    except cl.Error:  # OpenCL 1.2 knows no such memory
        return False
