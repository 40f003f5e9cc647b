"""Restore frames on the device: transform, filter, transform back.

One plan holds everything for one frame size: programs, tables, spectra, and as many filters as the caller
keeps in slots. A call only enqueues. Two kernel families do the same arithmetic (docs/maths.md, section 4):
*lanes* for CPUs, where a work-item owns one row or column per SIMD lane and one launch does the three steps,
and *groups* for GPUs, where a work-group shares a pair of rows or a block of columns in local memory and each
step is a launch. Lanes transforms columns, rows, columns; groups rows, columns, rows: the outer axis twice,
the inner one once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError, LimitError
from adof_cl.fft_passes import Passes, pass_lists
from adof_cl.finite import require_transfer
from adof_cl.noise import NSR_LIMIT, checked_nsr
from adof_cl.optics import require_whole
from adof_cl.padding import checked_frame_shape, padded_shape, padding_weights
from adof_cl.program import Argument, Launch, Program, vector_bytes

FAMILIES = ("lanes", "groups")
GAIN_LIMIT = 1e15
"""Largest gain of a filter: what no 16-bit frame of 16384 x 16384 can carry beyond float32."""
FRAME_LIMIT = 1e15
"""Largest level of a frame of reals for an image of integers: its sum, times `GAIN_LIMIT`, fits float32."""

_HALF_LARGEST = 65504.0

_C_TYPES = {"uint8": "uchar", "uint16": "ushort", "float32": "float", "float64": "double"}


@dataclass(frozen=True)
class _Cut:
    """How a family divides the work.

    Attributes
    ----------
    half_rows
        Which axis of a frame is transformed first, so that half of its frequencies are held: the columns' (so
        that rows of the spectrum are), or the rows'.
    block, shorts
        Frequencies of that axis in a block, and in all blocks.
    spectrum
        Shape of the spectrum, in reals.
    outer, outer_items, inner_items
        Tasks or work-groups of the outer steps, and work-items in each group; the middle one has a group
        for each block.
    outer_scratch, inner_scratch
        Extra buffers a family's steps take, in reals; 0: none is needed.
    """

    half_rows: bool
    block: int
    shorts: int
    spectrum: tuple[int, ...]
    outer: int
    outer_items: int
    inner_items: int
    defines: dict[str, int]
    outer_scratch: tuple[int, ...] = ()
    inner_scratch: tuple[int, ...] = ()


_NUMBERS = tuple(np.int32(step) for step in range(4))  # the same objects: a launch sees that nothing changed


class _Steps:
    """The three steps of a frame: a launch each, or one launch told which of them to do.

    Parameters
    ----------
    places
        By name, the launches that take an argument, and at which index.
    launches
        Three, one a step; or one for all.
    told
        Where the one launch is told its first step and the one after its last.
    apart
        Whether the one launch is made anew for each step: where work-items cannot wait for each other.
    """

    def __init__(
        self,
        places: dict[str, list[tuple[Launch, int]]],
        *launches: Launch,
        told: tuple[int, int] = (0, 0),
        apart: bool = True,
    ) -> None:
        self._places = places
        self._launches = launches
        self._told = told
        self._apart = apart
        self._values: dict[str, Argument] = {}

    def set(self, **values: Argument) -> None:
        for name, value in values.items():
            if value is not self._values.get(name, self):
                self._values[name] = value
                for launch, index in self._places[name]:
                    launch.set(index, value)

    def run(self, first: int, end: int) -> None:
        if len(self._launches) > 1:
            for launch in self._launches[first:end]:
                launch()
            return
        (launch,) = self._launches
        edges = (*range(first, end), end) if self._apart else (first, end)
        for start, stop in pairwise(edges):
            launch.set(self._told[0], _NUMBERS[start])
            launch.set(self._told[1], _NUMBERS[stop])
            launch()


@dataclass
class _Filter:
    """A slot: a filter formed as it is applied, from two axes and one level of noise, or a stored one."""

    formed: bool = False
    noise: np.generic | None = None
    axes: DeviceArray | None = None
    entry: np.int32 | None = None
    own_axes: DeviceArray | None = None
    stored: DeviceArray | None = None


def _lanes(
    shape: tuple[int, int], padded: tuple[int, int], real_bytes: int, vector: int, moved: float, line: int
) -> _Cut:
    """Divide for SIMD lanes: two vectors of columns, or one of their frequencies, to a work-item.

    `moved` is the memory a frame goes through, in caches; `line` the bytes of a row of the image.
    """
    lanes = vector // real_bytes
    strips, held = -(-shape[1] // (2 * lanes)), padded[0] // 2 + 1
    slots = -(-held // lanes) * lanes
    whole_lines = line % 64 == 0 and line // strips % 64 == 0 and shape[1] == strips * 2 * lanes
    return _Cut(
        True, lanes, slots, (strips, slots, 4, lanes), strips, 1, 1,
        {
            "VECTOR_BYTES": vector, "STRIPS": strips, "HELD": held, "SLOTS": slots,
            "STREAM_SPECTRUM": int(moved > 1), "STREAM_IMAGE": int(moved > 1 and whole_lines),
        },
    )  # fmt: skip


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
    pairs, blocks = -(-rows // 2), -(-(nx // 2 + 1) // block)
    return _Cut(
        False, block, blocks * block, (blocks, 2 * pairs, 2, block), pairs, items, items,
        {
            "HELD": 2 * pairs, "BLOCKS": blocks,
            "BLOCK": block, "ROW_ITEMS": items, "COLUMN_ITEMS": items,
            "ROW_LOCAL": int(row_local), "COLUMN_LOCAL": int(column_local),
        },
        outer_scratch=(0 if row_local else pairs * 2 * nx,),
        inner_scratch=(0 if column_local else blocks * 2 * ny * block,),
    )  # fmt: skip


class Restore:
    """Restore frames of one size: pad, transform, multiply by a filter, transform back, crop.

    Built once: compiles and allocates. Called often: enqueues one launch or three, allocates nothing, never
    waits.

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
        must not reach across the wrap. The padded size is a product of 2, 3, 5 and 7 (`good_size`).
    taper
        True: the padding passes smoothly from the far edge to the near one. False: it replicates them, half
        each, and steps in the middle.
    spectrum_dtype
        What the spectrum is kept in between the steps: the precision's own type, or float16 for uint8 and
        uint16 frames in float32. Half the memory to move, relative L2 errors below 3e-3 instead of 5e-7 and
        at most three of 255 grey levels at an nsr of 0.01; less noise means more gain, which enlarges the
        rounding of halves: docs/envelope.md.
    family
        "lanes" or "groups"; by default lanes on a CPU, groups elsewhere.

    Attributes
    ----------
    padded_shape
        (ny, nx): the lengths of the OTF axes; filters are (ny, nx // 2 + 1).
    half_gain_limit
        Largest `line_gain` of a filter where the spectrum is kept in float16: beyond, a frame could overflow.

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
        spectrum_dtype: DTypeLike | None = None,
        family: str | None = None,
    ) -> None:
        self.device = device
        self.shape = checked_frame_shape(shape)
        self.padded_shape = padded_shape(shape, padding)
        self._real = device.real_type(precision)
        self.spectrum_dtype = np.dtype(spectrum_dtype or self._real)
        if self.spectrum_dtype != self._real and (
            self.spectrum_dtype != np.float16 or self._real == np.float64
        ):
            raise InputError(
                f"spectrum_dtype is {self.spectrum_dtype}: {self._real}, or float16 with float32, was wanted"
            )
        self._complex = np.dtype(np.result_type(self._real, np.complex64))
        self.in_dtype = _checked_dtype("in_dtype", in_dtype, self._real)
        self.out_dtype = _checked_dtype("out_dtype", out_dtype, self._real)
        if self.spectrum_dtype == np.float16 and self.in_dtype.kind != "u":
            raise InputError(
                f"spectrum_dtype is float16 and in_dtype {self.in_dtype}: half numbers end at 65504, so "
                "uint8 or uint16 frames were wanted"
            )
        self.family = family or ("lanes" if device.facts.kind == "cpu" else "groups")
        if self.family not in FAMILIES:
            raise InputError(f"family is '{family}': choose 'lanes' or 'groups'")

        ny, nx = self.padded_shape
        facts, real_bytes = device.facts, self._real.itemsize
        vector = vector_bytes(device) if self.family == "lanes" else 0
        registers = {0: 0, 64: 32}.get(vector, 16)
        rows, columns = Passes.of(nx, registers), Passes.of(ny, registers)
        if self.family == "lanes":
            pixel_bytes = self.in_dtype.itemsize + self.out_dtype.itemsize + self.spectrum_dtype.itemsize
            moved = pixel_bytes * self.shape[0] * self.shape[1] / max(facts.cache_bytes, 1)
            line = self.out_dtype.itemsize * self.shape[1]
            cut = _lanes(self.shape, self.padded_shape, real_bytes, vector, moved, line)
            outer, inner = columns, rows
        else:
            local, most = facts.local_memory_bytes, facts.max_work_group_size
            cut = _groups(self.shape[0], self.padded_shape, real_bytes, local, most)
            outer, inner = rows, columns
        program = Program(
            device,
            f"restore_{self.family}.cl",
            {
                "REAL_IS_DOUBLE": self._real == np.float64,
                "ROWS": self.shape[0],
                "COLS": self.shape[1],
                "NX": nx,
                "NY": ny,
                "HALF_SPECTRUM": self.spectrum_dtype == np.float16,
                "STORED_LEVEL": 256
                if self.spectrum_dtype == np.float16 and self.in_dtype == np.uint16
                else 1,
                **_io_defines(self.in_dtype, self.out_dtype),
                # A simulator checks every value's origin, and loses it in a compiler's own shuffles.
                "PORTABLE": facts.simulated,
                **cut.defines,
            },
            generated=("restore_passes.h", pass_lists(rows, columns)),
        )

        # Frequencies stand in the order the outer passes leave them in.
        held, place = outer.length // 2 + 1, outer.position()
        frequency = np.full(cut.shorts, -1, dtype=np.int32)
        frequency[:held] = np.argsort(place[:held])
        known = np.maximum(frequency, 0)
        places = device.upload(np.stack([place[known], place[(outer.length - known) % outer.length]]))
        # Where an H is in a table of both axes, rows' first; places to spare take any.
        along, across = (ny, 0) if cut.half_rows else (0, ny)
        bins = device.upload(np.concatenate([along + inner.order(), across + known]).astype(np.int32))
        self._spectrum = device.empty(cut.spectrum, self.spectrum_dtype)
        blends = [
            self._table(padding_weights(p - n, taper)) for p, n in zip((ny, nx), self.shape, strict=True)
        ]
        outer_blend, inner_blend = blends if cut.half_rows else blends[::-1]
        outer_turns, inner_turns = self._table(outer.turns()), self._table(inner.turns())
        i32, zero = np.int32, self._real.type(0)
        if self.family == "lanes":
            workers = min(facts.compute_units, max(cut.outer, cut.shorts // cut.block))
            tasks = device.upload(np.zeros(16 * (4 + 3 * workers), np.int32))
            frame = program.launch(
                "restore_frame", (workers,), (1,),
                None, self._spectrum, self._spectrum, None, None, None, bins, places, outer_turns,
                outer_blend, inner_turns, inner_blend, tasks, i32(0), i32(3), i32(0), zero, zero,
            )  # fmt: skip
            self._steps = _Steps(
                {
                    "frame": [(frame, 0)], "filtered": [(frame, 2)], "image": [(frame, 3)],
                    "filter": [(frame, 4)], "otf": [(frame, 5)], "otf_from": [(frame, 15)],
                    "noise": [(frame, 16)], "scale": [(frame, 17)],
                },
                frame,
                told=(13, 14),
                apart=facts.simulated or facts.kind != "cpu",
            )  # fmt: skip
        else:
            outer_size, outer_group = (cut.outer * cut.outer_items,), (cut.outer_items,)
            inner_size, inner_group = (cut.shorts // cut.block * cut.inner_items,), (cut.inner_items,)
            outer_scratch = [self._scratch(n) for n in cut.outer_scratch]
            inner_scratch = [self._scratch(n) for n in cut.inner_scratch]
            first = program.launch(
                "restore_rows_forward", outer_size, outer_group,
                None, self._spectrum, places, outer_turns, outer_blend, *outer_scratch,
            )  # fmt: skip
            middle = program.launch(
                "restore_columns", inner_size, inner_group,
                self._spectrum, self._spectrum, None, None, bins, inner_turns, inner_blend, *inner_scratch,
                i32(0), zero, zero,
            )  # fmt: skip
            last = program.launch(
                "restore_rows_inverse", outer_size, outer_group,
                self._spectrum, None, places, outer_turns, *outer_scratch,
            )  # fmt: skip
            after = 7 + len(inner_scratch)
            self._steps = _Steps(
                {
                    "frame": [(first, 0)], "filtered": [(middle, 1), (last, 0)], "image": [(last, 1)],
                    "filter": [(middle, 2)], "otf": [(middle, 3)], "otf_from": [(middle, after)],
                    "noise": [(middle, after + 1)], "scale": [(middle, after + 2)],
                },
                first,
                middle,
                last,
            )  # fmt: skip

        wiener = Program(
            device,
            "wiener.cl",
            {
                "REAL_IS_DOUBLE": self._real == np.float64,
                "WIENER_BLOCK": cut.block,
                "WIENER_HALF_ROWS": cut.half_rows,
            },
        )
        # What the transforms leave undone: 1/2 of two that share one, and 1/n of each axis.
        # A line of n stored numbers, each at most a pixel's 256 levels, leaves a filter with at most root n
        # times its rms gain in one of them.
        self._half_rows = cut.half_rows
        self.half_gain_limit = _HALF_LARGEST / (256 * math.sqrt(inner.length))
        self._scale = (1.0 if self.spectrum_dtype == np.float16 else 0.5 / outer.length) / inner.length
        self._lift = 2.0 ** (300 if self._real == np.float64 else 40)  # both factors of H are lifted, so H is
        self._lifted_scale = self._real.type(self._lift * self._scale)
        self._filter_shape = (cut.shorts // cut.block, inner.length, 2, cut.block)
        self._filters: dict[int, _Filter] = {}
        size = (cut.shorts, inner.length)
        tables, sides = (device.upload(inner.order()), device.upload(frequency)), (i32(ny), i32(nx))
        self._form = wiener.launch(
            "wiener_axes", size, None,
            None, None, None, *tables, None, *sides, i32(0), i32(0), zero, self._real.type(self._scale),
        )  # fmt: skip
        self._arrange = wiener.launch(
            "wiener_arrange", size, None, None, *tables, None, *sides, self._real.type(self._scale)
        )
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
        axes = [_checked_axis("h_rows", h_rows, ny), _checked_axis("h_cols", h_cols, nx)]
        noise = checked_nsr(nsr, (ny, nx // 2 + 1))
        slot = _checked_slot(slot)
        if self.spectrum_dtype == np.float16:
            self._require_half_gain(self.line_gain(_wiener_modulus(axes[0], axes[1], noise)))
        level: float | DeviceArray
        if noise.ndim == 0:
            level = float(noise)
        else:
            if self._noise is None:
                self._noise = self.device.empty(noise.shape, self._real)
            level = self._noise.upload(noise.astype(self._real))
        kept = self._filters.setdefault(slot, _Filter())
        if kept.own_axes is None:
            kept.own_axes = self.device.empty((ny + nx,), self._complex)
        own = kept.own_axes.upload(np.concatenate(axes).astype(self._complex))
        self._set_table(own, level, slot, 0)

    def set_filter_table(
        self, table: DeviceArray, nsr: float | DeviceArray, slot: int = 0, *, entry: int = 0
    ) -> None:
        """Set a separable filter from 1-D OTFs that are on the device already.

        With one level of noise nothing is enqueued and no filter is ever stored: the middle step of every
        frame forms it in registers from the table as it then is. Update the table, and the next frame has a
        new filter.

        Parameters
        ----------
        table
            (ny + nx,) or (k, ny + nx), complex of this plan's precision: h_rows, then h_cols, with real
            Nyquist bins, as `OtfTable.out` holds them; its values are not checked.
        nsr
            A number, or (ny, nx // 2 + 1) real on the device, not checked either.
        entry
            Which row of a (k, n) table to take.

        Raises
        ------
        InputError
            Another shape or type, no such entry, or a negative nsr; the slot keeps what it had.
        LimitError
            The spectrum is kept in half numbers and the filter's gain, which without noise has no bound,
            could leave them.
        """
        slot = _checked_slot(slot)
        if self.spectrum_dtype == np.float16:
            level = 0.0 if isinstance(nsr, DeviceArray) else float(nsr)
            self._require_half_gain(0.5 / math.sqrt(level) if level > 0 else math.inf)
        self._set_table(table, nsr, slot, entry)

    def _set_table(self, table: DeviceArray, nsr: float | DeviceArray, slot: int, entry: int) -> None:
        ny, nx = self.padded_shape
        if table.dtype != self._complex or table.shape[-1] != ny + nx or len(table.shape) > 2:
            raise InputError(
                f"the table is {table.shape} {table.dtype}, ({ny + nx},) or (k, {ny + nx}) {self._complex} "
                "was wanted: sample the OTF of rows, then of columns, at the padded size"
            )
        require_whole(0, entry=entry)
        entries = table.size // (ny + nx)
        if not 0 <= entry < entries:
            raise InputError(f"entry {entry} of the table was asked for: it has {entries}, counted from 0")
        first = np.int32(entry * (ny + nx))
        if isinstance(nsr, DeviceArray):
            if nsr.shape != (ny, nx // 2 + 1) or nsr.dtype != self._real:
                raise InputError(
                    f"nsr is {nsr.shape} {nsr.dtype}, {(ny, nx // 2 + 1)} {self._real} was wanted: give one "
                    "value for each frequency of the padded half spectrum"
                )
            stored = self._stored_filter(slot)
            self._form.update({0: table, 1: table, 2: nsr, 5: stored, 8: first, 9: first + np.int32(ny)})
            self._form()
            return
        level = float(nsr)
        if not 0 <= level <= NSR_LIMIT:
            checked_nsr(level, (ny, nx // 2 + 1))  # says what is wrong
        kept = self._filters.setdefault(slot, _Filter())
        kept.formed, kept.axes, kept.entry = True, table, first
        kept.noise = self._real.type(self._lift * self._lift * level)

    def set_filter(self, gain: ArrayLike | DeviceArray, slot: int = 0) -> None:
        """Set any restoration filter: what each frequency of the padded frame is multiplied by.

        Parameters
        ----------
        gain
            (ny, nx // 2 + 1) complex, DC at [0, 0]: what `numpy.fft.rfft2` of the padded frame is multiplied
            by. On the host, or on the device already, where its values are not checked.

        Raises
        ------
        InputError
            Wrong shape or type, not finite, or above `GAIN_LIMIT`; the slot keeps what it had.
        LimitError
            The spectrum is kept in half numbers, and the gain could leave them or lies on the device.
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
            if self.spectrum_dtype == np.float16:
                self._require_half_gain(math.inf)
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
            largest = float(np.abs(values).max())
            if largest > GAIN_LIMIT:
                raise InputError(f"the filter's gain reaches {largest:g}: at most {GAIN_LIMIT:g} was wanted")
            if self.spectrum_dtype == np.float16:
                self._require_half_gain(self.line_gain(values))
            if self._gain is None:
                self._gain = self.device.empty(wanted, self._complex)
            source = self._gain.upload(values.astype(self._complex))
        self._arrange.set(0, source)
        self._arrange.set(3, self._stored_filter(slot))
        self._arrange()

    def line_gain(self, gain: NDArray[Any]) -> float:
        """Return the largest root mean square of a filter, (ny, nx // 2 + 1), along the inner axis.

        Lines of the outer axis' other frequencies than 0 count half: the mean of a line of pixels from 0 to p
        times a turning unit is at most p/2. A filter's largest gain bounds the result from above.

        Raises
        ------
        InputError
            Another shape, or not finite.
        """
        ny, nx = self.padded_shape
        if np.shape(gain) != (ny, nx // 2 + 1) or np.asarray(gain).dtype.kind not in "fciu":
            raise InputError(f"the filter is {np.shape(gain)}: {(ny, nx // 2 + 1)} numbers were wanted")
        modulus = np.abs(gain).astype(np.float64)
        largest = float(modulus.max())
        if not math.isfinite(largest):
            raise InputError("the filter holds NaN or infinity: only finite gains can be applied")
        power = (modulus / (largest or 1.0)) ** 2  # no square overflows
        if self._half_rows:
            counted = np.where((np.arange(nx // 2 + 1) % nx == 0) | (2 * np.arange(nx // 2 + 1) == nx), 1, 2)
            lines = power @ counted / nx
        else:
            lines = power.mean(axis=0)
        lines[1:] /= 4
        return largest * math.sqrt(float(lines.max()))

    # ---- frames -------------------------------------------------------------------------------------------

    def __call__(self, frame: DeviceArray, out: DeviceArray, slot: int = 0) -> DeviceArray:
        """Enqueue the restoration of `frame` into `out` with the filter of `slot`; returns `out`.

        Parameters
        ----------
        frame, out
            (rows, columns) of the plan's `in_dtype` and `out_dtype`; `out` may be `frame` if these agree.
            A frame of reals must hold finite ones: one NaN or infinity makes every pixel of a real image NaN,
            and an image of integers black. `restore` checks, this does not: it never waits for the device.

        Raises
        ------
        InputError
            Another shape or type, or an empty slot; nothing is enqueued.
        """
        self._require_array("out", out, self.out_dtype)
        self._require_filter(slot)
        self._require_array("frame", frame, self.in_dtype)
        self._transformed = False  # the rows overwrite it
        self._steps.set(frame=frame)
        self._set_end(self._spectrum, out, slot)
        self._steps.run(0, 3)
        return out

    def transform(self, frame: DeviceArray) -> None:
        """Enqueue the first third alone, to `apply` several filters to one frame afterwards.

        What a frame must hold: as for the call.

        Raises
        ------
        InputError
            Another shape or type.
        """
        self._require_array("frame", frame, self.in_dtype)
        self._steps.set(frame=frame)
        self._steps.run(0, 1)
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
            self._filtered = self.device.empty(self._spectrum.shape, self._spectrum.dtype)
        self._set_end(self._filtered, out, slot)
        self._steps.run(1, 3)
        return out

    def restore(self, frame: NDArray[Any], slot: int = 0) -> NDArray[Any]:
        """Upload a frame, restore it, wait, and return the image.

        Raises
        ------
        InputError
            Another shape or type than the plan's, NaN or infinity, or an empty slot.
        LimitError
            The image does not fit its type: frame and gain are together too large.
        """
        if frame.shape != self.shape or frame.dtype != self.in_dtype:
            raise InputError(
                f"the frame is {frame.shape} {frame.dtype}, this plan restores {self.shape} {self.in_dtype}: "
                "convert it or make a plan for it"
            )
        self.require_frame(frame)
        if self._frame is None or self._image is None:
            self._frame = self.device.empty(self.shape, self.in_dtype)
            self._image = self.device.empty(self.shape, self.out_dtype)
        image = self(self._frame.upload(frame), self._image, slot).download()
        require_finite_image(image)
        return image

    def require_frame(self, frame: NDArray[Any]) -> None:
        """Refuse a frame on the host, of the plan's `in_dtype`, that would spoil its image.

        Raises
        ------
        InputError
            NaN or infinity in it.
        LimitError
            Levels beyond `FRAME_LIMIT` where the image is of integers, which could not say it overflowed.
        """
        if frame.dtype.kind != "f":
            return
        largest = max(float(frame.max()), -float(frame.min()))
        if not math.isfinite(largest):
            raise InputError("the frame holds NaN or infinity: replace those pixels first")
        if self.out_dtype.kind == "u" and largest > FRAME_LIMIT:
            raise LimitError(
                f"the frame reaches {largest:g}: an image of {self.out_dtype} wants levels of at most "
                f"{FRAME_LIMIT:g}, so scale the frame down"
            )

    # ---- inside -------------------------------------------------------------------------------------------

    def _set_end(self, filtered: DeviceArray, out: DeviceArray, slot: int) -> None:
        kept = self._filters[slot]
        self._steps.set(filtered=filtered, image=out)
        if kept.formed:
            self._steps.set(
                filter=None,
                otf=kept.axes,
                otf_from=kept.entry,
                noise=kept.noise,
                scale=self._lifted_scale,
            )
        else:
            self._steps.set(filter=kept.stored)

    def _require_half_gain(self, largest: float) -> None:
        if largest > self.half_gain_limit:
            said = f"may reach {largest:.3g}" if math.isfinite(largest) else "is not bounded on the host"
            raise LimitError(
                f"the filter's gain {said}: a spectrum in half numbers holds {self.half_gain_limit:.3g} at "
                f"this size, so use an nsr of {0.25 / self.half_gain_limit**2:.2g} or more, or float32"
            )

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

    def _stored_filter(self, slot: int) -> DeviceArray:
        kept = self._filters.setdefault(slot, _Filter())
        if kept.stored is None:
            kept.stored = self.device.empty(self._filter_shape, self._real)
        kept.formed = False
        return kept.stored


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
    require_transfer(name, axis)
    if length % 2 == 0:  # the half spectrum of a real image has no room for a sign there
        axis = axis.copy()
        axis[length // 2] = axis[length // 2].real
    return axis


def _wiener_modulus(
    h_rows: NDArray[Any], h_cols: NDArray[Any], nsr: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return |H| / (|H|^2 + nsr), (ny, nx // 2 + 1); Nyquist bins are real, as in the kernel."""
    held = []
    for axis in (h_rows, h_cols):
        values = np.array(axis, dtype=np.complex128)
        if values.size % 2 == 0:
            values[values.size // 2] = values[values.size // 2].real
        held.append(np.abs(values))
    modulus = np.outer(held[0], held[1][: h_cols.size // 2 + 1])
    power = modulus**2 + nsr
    return np.asarray(np.divide(modulus, power, out=np.zeros_like(modulus), where=power > 0))


def require_finite_image(image: NDArray[Any]) -> None:
    """Refuse an image that left its type's range on the way.

    Raises
    ------
    LimitError
        NaN or infinity in it.
    """
    if image.dtype.kind == "f" and not np.isfinite(image).all():
        raise LimitError(
            f"the restored image does not fit {image.dtype}: frame and gain are together too large, so scale "
            "the frame down or give more noise"
        )


def _checked_slot(slot: int) -> int:
    require_whole(0, slot=slot)
    return int(slot)
