"""Restore frames on the device: transform, filter, transform back, in three kernels.

One plan holds everything for one frame size: programs, tables, spectra, and as many filters as the caller
keeps in slots. A call only enqueues. Two kernel families do the same arithmetic (docs/maths.md, section 4):
*lanes* for CPUs, where a work-item owns one row or column per SIMD lane and nothing waits for anything, and
*groups* for GPUs, where a work-group shares a pair of rows or a block of columns in local memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError
from adof_cl.fft_passes import Passes, pass_lists
from adof_cl.noise import checked_nsr
from adof_cl.padding import checked_frame_shape, padded_shape, padding_weights
from adof_cl.program import Program

FAMILIES = ("lanes", "groups")

_C_TYPES = {"uint8": "uchar", "uint16": "ushort", "float32": "float", "float64": "double"}


@dataclass(frozen=True)
class _Cut:
    """How a family divides the work.

    Attributes
    ----------
    block, blocks
        Columns per block of the spectrum, and blocks.
    held
        Rows of the spectrum.
    row_groups, row_items, column_items
        Work-groups for the rows, and work-items in each group; columns have one group per block.
    run
        Columns a work-item of the filter kernels forms.
    row_scratch, column_scratch
        Extra buffers a family's kernels take, in reals; 0: none is needed.
    """

    block: int
    blocks: int
    held: int
    row_groups: int
    row_items: int
    column_items: int
    run: int
    defines: dict[str, int]
    row_scratch: tuple[int, ...] = ()
    column_scratch: tuple[int, ...] = ()


def _lanes(rows: int, nx: int, real_bytes: int) -> _Cut:
    """Divide for SIMD lanes: 64 bytes of columns, or of pairs of rows, to a work-item."""
    lanes = 64 // real_bytes
    row_groups = -(-rows // (2 * lanes))
    blocks = -(-(nx // 2 + 1) // lanes)
    return _Cut(lanes, blocks, row_groups * 2 * lanes, row_groups, 1, 1, lanes, {})


def _groups(rows: int, padded: tuple[int, int], real_bytes: int, local_bytes: int, most_items: int) -> _Cut:
    """Divide for work-groups, within local memory and the largest group.

    Columns: the widest block of up to 64 bytes that fits local memory, down to one column. An axis of which
    not even one row or column fits works in a scratch buffer in global memory instead.
    """
    ny, nx = padded
    block = widest = 64 // real_bytes
    while block > 1 and 2 * ny * block * real_bytes > local_bytes:
        block //= 2
    column_local = 2 * ny * block * real_bytes <= local_bytes
    row_local = 2 * nx * real_bytes <= local_bytes
    if not column_local:
        block = widest
    items = 1
    while 2 * items <= min(256, most_items, max(nx, ny) // 4):
        items *= 2
    block = min(block, items)
    row_groups, blocks = -(-rows // 2), -(-(nx // 2 + 1) // block)
    return _Cut(
        block, blocks, 2 * row_groups, row_groups, items, items, 1,
        {
            "BLOCK": block, "ROW_ITEMS": items, "COLUMN_ITEMS": items,
            "ROW_LOCAL": int(row_local), "COLUMN_LOCAL": int(column_local),
        },
        row_scratch=(0 if row_local else row_groups * 2 * nx,),
        column_scratch=(0 if column_local else blocks * 2 * ny * block,),
    )  # fmt: skip


class Restore:
    """Restore frames of one size: pad, transform, multiply by a filter, transform back, crop.

    Built once: compiles and allocates. Called often: enqueues three kernels, allocates nothing, never waits.

    Parameters
    ----------
    device
        The opened device.
    shape
        Frame, (rows, columns), 8 to 4096 each.
    precision
        "float32" or "float64": the arithmetic of transforms and filter.
    in_dtype, out_dtype
        Frame and image: uint8, uint16, float32, or float64 with that precision. Integers are rounded and
        clamped on the way out.
    padding
        Samples to add at least to each axis, one number or (rows, columns): the support of the blur, which
        must not reach across the wrap. The padded size is the next product of 2, 3, 5 and 7.
    taper
        True: the padding passes smoothly from the far edge to the near one. False: it replicates them, half
        each, and steps in the middle.
    family
        "lanes" or "groups"; by default lanes on a CPU, groups elsewhere.

    Attributes
    ----------
    padded_shape
        (ny, nx): the lengths of the OTF axes; filters are (ny, nx // 2 + 1).

    Raises
    ------
    InputError
        A shape, type, padding or family outside these.
    DeviceError
        float64 on a device without it, or too little memory.

    Source
    ------
    Paper eq. (3) as corrected in docs/maths.md, eqs. W1 to W5.
    """

    def __init__(
        self,
        device: Device,
        shape: tuple[int, int],
        *,
        precision: str = "float32",
        in_dtype: DTypeLike = np.float32,
        out_dtype: DTypeLike = np.float32,
        padding: int | tuple[int, int] = 0,
        taper: bool = True,
        family: str | None = None,
    ) -> None:
        self.device = device
        self.shape = checked_frame_shape(shape)
        self.padded_shape = padded_shape(shape, padding)
        self._real = device.real_type(precision)
        self._complex = np.dtype(np.result_type(self._real, np.complex64))
        self.in_dtype = _checked_dtype("in_dtype", in_dtype, self._real)
        self.out_dtype = _checked_dtype("out_dtype", out_dtype, self._real)
        self.family = family or ("lanes" if device.facts.kind == "cpu" else "groups")
        if self.family not in FAMILIES:
            raise InputError(f"family is '{family}': choose 'lanes' or 'groups'")

        ny, nx = self.padded_shape
        row, column = Passes.of(nx), Passes.of(ny)
        facts, real_bytes = device.facts, self._real.itemsize
        if self.family == "lanes":
            cut = _lanes(self.shape[0], nx, real_bytes)
        else:
            cut = _groups(
                self.shape[0],
                self.padded_shape,
                real_bytes,
                facts.local_memory_bytes,
                facts.max_work_group_size,
            )
        program = Program(
            device,
            f"restore_{self.family}.cl",
            {
                "REAL_IS_DOUBLE": self._real == np.float64,
                "ROWS": self.shape[0],
                "COLS": self.shape[1],
                "NX": nx,
                "NY": ny,
                "HELD": cut.held,
                "BLOCKS": cut.blocks,
                **_io_defines(self.in_dtype, self.out_dtype),
                # A simulator checks every value's origin, and loses it in a compiler's own shuffles.
                "RESTORE_PORTABLE": facts.simulated,
                **cut.defines,
            },
            generated=("restore_passes.h", pass_lists(row, column)),
        )

        frequency = np.arange(cut.blocks * cut.block)
        frequency[frequency > nx // 2] = 0
        place = row.position()
        places = device.upload(np.stack([place[frequency], place[(nx - frequency) % nx]]))
        self._order = device.upload(column.order())
        self._spectrum = device.empty((cut.blocks, cut.held, 2, cut.block), self._real)
        row_turns, column_turns = self._table(row.turns()), self._table(column.turns())
        row_blend = self._table(padding_weights(nx - self.shape[1], taper))
        column_blend = self._table(padding_weights(ny - self.shape[0], taper))
        self._filter_shape = (cut.blocks, ny, 2, cut.block)
        self._filters: dict[int, DeviceArray] = {}

        rows, columns = (cut.row_groups * cut.row_items,), (cut.blocks * cut.column_items,)
        row_items, column_items = (cut.row_items,), (cut.column_items,)
        row_scratch = [self._scratch(n) for n in cut.row_scratch]
        column_scratch = [self._scratch(n) for n in cut.column_scratch]
        self._rows_forward = program.launch(
            "restore_rows_forward", rows, row_items,
            None, self._spectrum, places, row_turns, row_blend, *row_scratch,
        )  # fmt: skip
        self._columns = program.launch(
            "restore_columns", columns, column_items,
            self._spectrum, self._spectrum, None, column_turns, column_blend, *column_scratch,
        )  # fmt: skip
        self._rows_inverse = program.launch(
            "restore_rows_inverse", rows, row_items,
            self._spectrum, None, places, row_turns, *row_scratch,
        )  # fmt: skip

        wiener = Program(
            device,
            "wiener.cl",
            {"REAL_IS_DOUBLE": self._real == np.float64, "WIENER_BLOCK": cut.block, "WIENER_RUN": cut.run},
        )
        size = (cut.blocks * cut.block // cut.run, 4 if cut.run > 1 else ny)
        i32, scale, zero = np.int32, self._real.type(0.5 / (nx * ny)), self._real.type(0)
        self._form = wiener.launch(
            "wiener_axes", size, None, None, None, None, self._order, None,
            i32(ny), i32(nx), i32(0), i32(0), zero, scale,
        )  # fmt: skip
        self._arrange = wiener.launch(
            "wiener_arrange", size, None, None, self._order, None, i32(ny), i32(nx), scale
        )
        self._h_rows = device.empty((ny,), self._complex)
        self._h_cols = device.empty((nx,), self._complex)
        self._noise: DeviceArray | None = None
        self._gain: DeviceArray | None = None
        self._filtered: DeviceArray | None = None
        self._transformed = False
        self._frame: DeviceArray | None = None
        self._image: DeviceArray | None = None

    # ---- filters ------------------------------------------------------------------------------------------

    def set_filter_axes(self, h_rows: ArrayLike, h_cols: ArrayLike, nsr: ArrayLike, slot: int = 0) -> None:
        """Set the Wiener filter of a separable blur, H[j, i] = h_rows[j] h_cols[i].

        Parameters
        ----------
        h_rows, h_cols
            (ny,) and (nx,) complex, of the padded shape, DC first; the Nyquist bins are made real here.
        nsr
            Noise to signal power: a number, or (ny, nx // 2 + 1) for each frequency; 0 or more.
        slot
            Where to keep the filter.

        Raises
        ------
        InputError
            Wrong length, not finite, negative; the slot keeps what it had.
        """
        ny, nx = self.padded_shape
        rows = _checked_axis("h_rows", h_rows, ny).astype(self._complex)
        cols = _checked_axis("h_cols", h_cols, nx).astype(self._complex)
        noise = checked_nsr(nsr, (ny, nx // 2 + 1))
        slot = _checked_slot(slot)
        level: float | DeviceArray
        if noise.ndim == 0:
            level = float(noise)
        else:
            if self._noise is None:
                self._noise = self.device.empty(noise.shape, self._real)
            level = self._noise.upload(noise.astype(self._real))
        self.set_filter_axes_device(self._h_rows.upload(rows), self._h_cols.upload(cols), level, slot)

    def set_filter_axes_device(
        self,
        h_rows: DeviceArray,
        h_cols: DeviceArray,
        nsr: float | DeviceArray,
        slot: int = 0,
        *,
        row_entry: int = 0,
        col_entry: int = 0,
    ) -> None:
        """Set a separable filter from 1-D OTFs that are on the device already; enqueues one kernel.

        Parameters
        ----------
        h_rows, h_cols
            (ny,) or (k, ny), and (nx,) or (k, nx), complex of this plan's precision; their values are not
            checked.
        nsr
            A number, or (ny, nx // 2 + 1) real on the device.
        row_entry, col_entry
            Which row of a (k, n) table to take.

        Raises
        ------
        InputError
            Another shape or type, no such entry, or a negative nsr; the slot keeps what it had.
        """
        ny, nx = self.padded_shape
        slot = _checked_slot(slot)
        for name, table, length, entry in (
            ("h_rows", h_rows, ny, row_entry),
            ("h_cols", h_cols, nx, col_entry),
        ):
            if table.dtype != self._complex or table.shape[-1] != length or len(table.shape) > 2:
                raise InputError(
                    f"{name} is {table.shape} {table.dtype}, ({length},) or (k, {length}) {self._complex} "
                    "was wanted: sample the OTF at the padded size"
                )
            entries = table.size // length
            if not 0 <= entry < entries:
                raise InputError(f"entry {entry} of {name} was asked for: it has {entries}, counted from 0")
        if isinstance(nsr, DeviceArray):
            if nsr.shape != (ny, nx // 2 + 1) or nsr.dtype != self._real:
                raise InputError(
                    f"nsr is {nsr.shape} {nsr.dtype}, {(ny, nx // 2 + 1)} {self._real} was wanted: give one "
                    "value for each frequency of the padded half spectrum"
                )
            self._form.set(2, nsr)
        else:
            self._form.set(2, None)
            self._form.set(9, self._real.type(checked_nsr(float(nsr), (ny, nx // 2 + 1))))
        self._form.set(0, h_rows)
        self._form.set(1, h_cols)
        self._form.set(4, self._slot(slot))
        self._form.set(7, np.int32(row_entry))
        self._form.set(8, np.int32(col_entry))
        self._form()

    def set_filter(self, gain: ArrayLike | DeviceArray, slot: int = 0) -> None:
        """Set any restoration filter: what each frequency of the padded frame is multiplied by.

        Parameters
        ----------
        gain
            (ny, nx // 2 + 1) complex, DC at [0, 0]: what `numpy.fft.rfft2` of the padded frame is multiplied
            by. On the device already, or on the host.

        Raises
        ------
        InputError
            Wrong shape or type, or not finite; the slot keeps what it had.
        """
        ny, nx = self.padded_shape
        wanted = (ny, nx // 2 + 1)
        slot = _checked_slot(slot)
        if isinstance(gain, DeviceArray):
            if gain.shape != wanted or gain.dtype != self._complex:
                raise InputError(
                    f"the filter is {gain.shape} {gain.dtype}, {wanted} {self._complex} was wanted: form it "
                    "for the padded half spectrum"
                )
            source = gain
        else:
            values = np.asarray(gain)
            if values.shape != wanted or values.dtype.kind not in "fciu":
                raise InputError(
                    f"the filter is {values.shape} {values.dtype}, {wanted} complex was wanted: form it for "
                    "the padded half spectrum"
                )
            if not np.isfinite(values).all():
                raise InputError("the filter holds NaN or infinity: only finite gains can be applied")
            if self._gain is None:
                self._gain = self.device.empty(wanted, self._complex)
            source = self._gain.upload(values.astype(self._complex))
        self._arrange.set(0, source)
        self._arrange.set(2, self._slot(slot))
        self._arrange()

    # ---- frames -------------------------------------------------------------------------------------------

    def __call__(self, frame: DeviceArray, out: DeviceArray, slot: int = 0) -> DeviceArray:
        """Enqueue the restoration of `frame` into `out` with the filter of `slot`; returns `out`.

        Parameters
        ----------
        frame, out
            (rows, columns) of the plan's `in_dtype` and `out_dtype`; `out` may be `frame` if these agree.

        Raises
        ------
        InputError
            Another shape or type, or an empty slot; nothing is enqueued.
        """
        self._require_array("out", out, self.out_dtype)
        self._require_filter(slot)
        self.transform(frame)
        self._transformed = False  # the columns overwrite it
        return self._finish(self._spectrum, out, slot)

    def transform(self, frame: DeviceArray) -> None:
        """Enqueue the first third alone, to `apply` several filters to one frame afterwards.

        Raises
        ------
        InputError
            Another shape or type.
        """
        self._require_array("frame", frame, self.in_dtype)
        self._rows_forward.set(0, frame)
        self._rows_forward()
        self._transformed = True

    def apply(self, out: DeviceArray, slot: int = 0) -> DeviceArray:
        """Enqueue the rest for the frame last transformed, which stays for another filter; returns `out`.

        Raises
        ------
        InputError
            Another shape or type, an empty slot, or no frame transformed.
        """
        self._require_array("out", out, self.out_dtype)
        self._require_filter(slot)
        if not self._transformed:
            raise InputError("no frame has been transformed since the last restoration: call transform first")
        if self._filtered is None:
            self._filtered = self.device.empty(self._spectrum.shape, self._real)
        return self._finish(self._filtered, out, slot)

    def restore(self, frame: NDArray[Any], slot: int = 0) -> NDArray[Any]:
        """Upload a frame, restore it, wait, and return the image.

        Raises
        ------
        InputError
            Another shape or type than the plan's, NaN or infinity, or an empty slot.
        """
        if frame.shape != self.shape or frame.dtype != self.in_dtype:
            raise InputError(
                f"the frame is {frame.shape} {frame.dtype}, this plan restores {self.shape} {self.in_dtype}: "
                "convert it or make a plan for it"
            )
        if frame.dtype.kind == "f" and not np.isfinite(frame).all():
            raise InputError("the frame holds NaN or infinity: replace those pixels first")
        if self._frame is None or self._image is None:
            self._frame = self.device.empty(self.shape, self.in_dtype)
            self._image = self.device.empty(self.shape, self.out_dtype)
        return self(self._frame.upload(frame), self._image, slot).download()

    # ---- inside -------------------------------------------------------------------------------------------

    def _finish(self, filtered: DeviceArray, out: DeviceArray, slot: int) -> DeviceArray:
        self._columns.set(1, filtered)
        self._columns.set(2, self._filters[slot])
        self._rows_inverse.set(0, filtered)
        self._rows_inverse.set(1, out)
        self._columns()
        self._rows_inverse()
        return out

    def _require_array(self, name: str, array: DeviceArray, dtype: np.dtype[Any]) -> None:
        if array.shape != self.shape or array.dtype != dtype:
            raise InputError(
                f"{name} is {array.shape} {array.dtype}, this plan restores {self.shape} {dtype}: make a "
                "plan for it"
            )

    def _require_filter(self, slot: int) -> None:
        if slot not in self._filters:
            raise InputError(f"slot {slot} holds no filter: call set_filter or set_filter_axes first")

    def _table(self, values: NDArray[np.float64]) -> DeviceArray:
        """Upload a table, never empty: a kernel's argument must name some memory."""
        return self.device.upload(np.append(values, 0.0).astype(self._real))

    def _scratch(self, reals: int) -> DeviceArray | None:
        return self.device.empty((reals,), self._real) if reals else None

    def _slot(self, slot: int) -> DeviceArray:
        if slot not in self._filters:
            self._filters[slot] = self.device.empty(self._filter_shape, self._real)
        return self._filters[slot]


def _io_defines(in_dtype: np.dtype[Any], out_dtype: np.dtype[Any]) -> dict[str, int | str]:
    limit = int(np.iinfo(out_dtype).max) if out_dtype.kind == "u" else 0
    return {
        "IN_TYPE": _C_TYPES[in_dtype.name],
        "IN_BYTES": in_dtype.itemsize,
        "OUT_TYPE": _C_TYPES[out_dtype.name],
        "OUT_BYTES": out_dtype.itemsize,
        "OUT_LIMIT": limit,
    }


def _checked_dtype(name: str, dtype: DTypeLike, real: np.dtype[Any]) -> np.dtype[Any]:
    wanted = ["uint8", "uint16", "float32"] + (["float64"] if real == np.float64 else [])
    found = np.dtype(dtype)
    if found.name not in wanted:
        raise InputError(f"{name} is {found}: choose one of {', '.join(wanted)}")
    return found


def _checked_axis(name: str, values: ArrayLike, length: int) -> NDArray[Any]:
    axis = np.asarray(values)
    if axis.shape != (length,) or axis.dtype.kind not in "fciu":
        raise InputError(
            f"{name} is {axis.shape} {axis.dtype}, ({length},) complex was wanted: sample the OTF at the "
            "padded size"
        )
    if not np.isfinite(axis).all():
        raise InputError(f"{name} holds NaN or infinity: a finite OTF was wanted")
    return axis


def _checked_slot(slot: int) -> int:
    if slot != int(slot) or slot < 0:
        raise InputError(f"slot is {slot}: a whole number from 0 on was wanted")
    return int(slot)
