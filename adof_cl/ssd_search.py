"""Search many templates in one image on the device: sums of squared differences, exact on uint8."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError, TrackingError
from adof_cl.finite import checked_shape
from adof_cl.optics import require_whole
from adof_cl.program import Launch, Program, require_local_memory, vector_bytes

LARGEST_TEMPLATE = 64
"""Longest side of a template: up to here uint8 sums are exact in every family (docs/maths.md, eq. S3)."""
LARGEST_LEVEL = 1e16
"""Largest level of a template: the squares of its 4096 differences from as bright an image fit float32."""
_LEAST_VARIANCE = 1e-30  # as in kernels/ssd_search.cl

_IMAGE_KINDS = {np.dtype(np.uint8): 0, np.dtype(np.uint16): 1, np.dtype(np.float32): 2}
# Offset rows x vectors that a work-item of the lanes family computes at once: their sums stay in registers.
_BLOCKS = ((3, 3), (5, 2), (9, 1), (2, 3), (3, 2), (2, 2), (4, 1))
# A work-item's tile of a window: below so many taps times offsets one tile costs less than a second launch,
# and up to so many offsets, and so many in a row, its pixels and sums stay in the cache.
_TILE_TAPS, _TILE_OFFSETS, _TILE_COLUMNS = 2**20, 4096, 128
_GROUP_TILE = (16, 32)
_GROUP_SIZE = (32, 4)
_BEST_ITEMS = 64
_SCORE_NONE = 0x7FFFFFFF


@dataclass(frozen=True)
class SearchResult:
    """What one search found, template by template.

    Attributes
    ----------
    best_yx : (count, 2) int64
        Image row and column of the template's top-left pixel at the best match; of equal scores the first in
        row-major order.
    score : (count,) float64
        The smallest score. "ssd": squared grey levels; an exact integer for uint8. "gain_offset": 0 to 1.
        Infinite where the image holds NaN, infinity or levels beyond 1e16 in every footprint of the window,
        which match nothing.
    neighbourhood : (count, 3, 3) float64
        Scores around the best place; infinite where the search window ends.
    patches : (count, rows, columns) float32, or None
        The image under the best match and `patch_margin` pixels around it, its edge pixels repeated beyond
        it.
    """

    best_yx: NDArray[np.int64]
    score: NDArray[np.float64]
    neighbourhood: NDArray[np.float64]
    patches: NDArray[np.float32] | None


class SsdSearch:
    """Find `count` templates of one shape, each within its own window of one image on the device.

    Built once: compiles and allocates. Called often: enqueues, allocates nothing, does not wait. Templates
    and windows may change between calls.

    Parameters
    ----------
    device
        The opened device.
    image_shape, template_shape, search_shape
        (rows, columns) of the image, of every template (1 to 64 pixels a side) and of the window each
        template is searched in. A template takes `search_shape - template_shape + 1` places in its window.
    count
        Number of templates.
    dtype
        Of image and templates: uint8, uint16 or float32.
    score
        "ssd": sum of squared differences. "gain_offset": what remains of the template after the best gain
        (not negative) and offset of the image, over the template's own variation; 0 is a perfect match, 1
        none.
    patch_margin
        When given, results carry the image's pixels under each match and so many pixels around it.
    family
        "lanes" or "groups"; None chooses lanes on a CPU and groups elsewhere.

    Raises
    ------
    InputError
        A shape, type or name outside the above.
    DeviceError
        The device lacks memory.

    Source
    ------
    docs/maths.md, eqs. S2 to S7; the paper's section 3.3 (templates matched by SSD).
    """

    def __init__(
        self,
        device: Device,
        image_shape: tuple[int, int],
        template_shape: tuple[int, int],
        search_shape: tuple[int, int],
        count: int,
        *,
        dtype: DTypeLike = np.uint8,
        score: str = "ssd",
        patch_margin: int | None = None,
        family: str | None = None,
    ) -> None:
        self.device = device
        self.image_shape = checked_shape("image_shape", image_shape)
        self.template_shape = checked_shape("template_shape", template_shape)
        self.search_shape = checked_shape("search_shape", search_shape)
        self.count = count
        self.dtype = np.dtype(dtype)
        self.score = score
        self.patch_margin = patch_margin
        self.family = family or ("lanes" if device.facts.kind == "cpu" else "groups")
        self._check()

        rows, columns = self.template_shape
        self.offsets_shape = (self.search_shape[0] - rows + 1, self.search_shape[1] - columns + 1)
        defines: dict[str, int]
        if self.family == "lanes":
            # Bytes are taken as shorts, and no vector of OpenCL C holds more than 16.
            width = min(vector_bytes(device), 32) if self.dtype == np.uint8 else vector_bytes(device)
            centred = score == "gain_offset" and self.dtype != np.uint8  # two sums an offset, and its mean
            fitting = (4 if centred else 9) * (2 if width == 64 else 1)
            block, tile = _lanes_tile(width // 4, fitting, self.template_shape, self.offsets_shape)
            defines = {
                "VECTOR_BYTES": width,
                "BLOCK_ROWS": block[0],
                "VECTORS": block[1],
                "TILE_ROWS": tile[0],
                "TILE_COLUMNS": tile[1],
            }
        else:
            tile, defines = _GROUP_TILE, {"VECTOR_BYTES": 0}
            window = (tile[0] + rows - 1) * (tile[1] + columns - 1) * self.dtype.itemsize
            require_local_memory(
                device, window + 8 * tile[0] * tile[1] // 4, f"a search for {rows} x {columns} templates"
            )
        tiles_y, tiles_x = (-(-n // t) for n, t in zip(self.offsets_shape, tile, strict=True))
        map_columns = tiles_x * tile[1]

        self._values = np.zeros((count, rows, columns), np.float32)
        self._sums = np.zeros((count, 2), np.int32)
        self._origins = np.zeros((count, 2), np.int32)
        self._missing = set(range(count))
        patch = 0
        if patch_margin is not None:
            self.patch_shape = (rows + 2 * patch_margin, columns + 2 * patch_margin)
            patch = self.patch_shape[0] * self.patch_shape[1]
        self._templates_on_device = device.upload(self._values)
        self._sums_on_device = device.upload(self._sums)
        self._origins_on_device = device.upload(self._origins)
        self._scores = device.empty((count, self.offsets_shape[0], map_columns), np.int32)
        tile_best = device.empty((count, tiles_y * tiles_x, 2), np.int32)
        self._records = device.shared((count, 11 + patch), np.int32)
        self._fetched = np.empty(self._records.shape, np.int32)
        self._image: DeviceArray | None = None

        program = Program(
            device,
            "ssd_search.cl",
            {
                "IMAGE_KIND": _IMAGE_KINDS[self.dtype],
                "GAIN_OFFSET": score == "gain_offset",
                "TEMPLATE_ROWS": rows,
                "TEMPLATE_COLUMNS": columns,
                **defines,
                "PATCH_MARGIN": -1 if patch_margin is None else patch_margin,
            },
        )
        sizes = [np.int32(n) for n in (*self.image_shape, *self.offsets_shape, map_columns)]
        lanes = self.family == "lanes"
        group = (1, 1) if lanes else _GROUP_SIZE
        best_items = 1 if lanes else _BEST_ITEMS
        self._search = program.launch(
            "ssd_search",
            (tiles_x * group[0], tiles_y * group[1], count),
            (*group, 1),
            None,
            self._templates_on_device,
            self._sums_on_device,
            self._origins_on_device,
            self._scores,
            tile_best,
            self._records,
            *sizes,
        )
        self._best: Launch | None = None
        if not lanes or tiles_y * tiles_x > 1:
            self._best = program.launch(
                "ssd_search_best",
                (count * best_items,),
                (best_items,),
                None,
                self._origins_on_device,
                self._scores,
                tile_best,
                self._records,
                *sizes,
                np.int32(tiles_y * tiles_x),
            )

    def _check(self) -> None:
        require_whole(count=self.count)
        if self.patch_margin is not None:
            require_whole(0, patch_margin=self.patch_margin)
        if self.dtype not in _IMAGE_KINDS:
            raise InputError(f"dtype is {self.dtype}: choose uint8, uint16 or float32")
        if self.score not in ("ssd", "gain_offset"):
            raise InputError(f"score is '{self.score}': choose 'ssd' or 'gain_offset'")
        if self.family not in ("lanes", "groups"):
            raise InputError(f"family is '{self.family}': choose 'lanes' or 'groups'")
        if self.patch_margin is not None and not 0 <= self.patch_margin <= LARGEST_TEMPLATE:
            raise InputError(
                f"patch_margin is {self.patch_margin}: 0 to {LARGEST_TEMPLATE} pixels were wanted"
            )
        if max(self.template_shape) > LARGEST_TEMPLATE:
            raise InputError(
                f"template_shape is {self.template_shape}: at most {LARGEST_TEMPLATE} pixels a side can be "
                "searched"
            )
        for side in (0, 1):
            if not self.template_shape[side] <= self.search_shape[side] <= self.image_shape[side]:
                raise InputError(
                    f"template {self.template_shape}, window {self.search_shape} and image "
                    f"{self.image_shape} do not nest: a template must fit its window and a window the image"
                )
        if self.score == "gain_offset" and self.template_shape == (1, 1):
            raise InputError("a template of one pixel has no contrast: use score 'ssd' or a larger template")

    def set_templates(self, templates: NDArray[Any]) -> None:
        """Replace all templates: (count, rows, columns) of the plan's dtype.

        Raises
        ------
        InputError
            Another shape or type, or a value that is not finite or beyond `LARGEST_LEVEL`.
        TrackingError
            A template without contrast under score "gain_offset": of one grey level, or squared differences
            from its mean that sum to less than 1e-30. No template is changed then.
        """
        wanted = (self.count, *self.template_shape)
        if templates.shape != wanted or templates.dtype != self.dtype:
            raise InputError(
                f"templates of shape {templates.shape} and type {templates.dtype} came, {wanted} "
                f"{self.dtype} was wanted: convert them first"
            )
        for index, pixels in enumerate(templates):
            self._require_template(index, pixels)
        for index, pixels in enumerate(templates):
            self._prepare(index, pixels)
        self._templates_on_device.upload(self._values)
        self._sums_on_device.upload(self._sums)

    def set_template(self, index: int, pixels: NDArray[Any]) -> None:
        """Replace one template: (rows, columns) of the plan's dtype; raises as `set_templates`."""
        if not 0 <= index < self.count:
            raise InputError(f"template index is {index}: 0 to {self.count - 1} was wanted")
        if pixels.shape != self.template_shape or pixels.dtype != self.dtype:
            raise InputError(
                f"a template of shape {pixels.shape} and type {pixels.dtype} came, {self.template_shape} "
                f"{self.dtype} was wanted: convert it first"
            )
        self._require_template(index, pixels)
        self._prepare(index, pixels)
        self._templates_on_device.upload(self._values)
        self._sums_on_device.upload(self._sums)

    def _require_template(self, index: int, pixels: NDArray[Any]) -> None:
        values = pixels.astype(np.float64)
        largest = float(np.abs(values).max())
        if not largest <= LARGEST_LEVEL:  # NaN neither
            raise InputError(
                f"template {index} holds a value of {largest:g}: finite levels of at most {LARGEST_LEVEL:g} "
                "were wanted, whose squares a search can sum"
            )
        if self.score == "gain_offset" and float(((values - values.mean()) ** 2).sum()) < _LEAST_VARIANCE:
            raise TrackingError(
                f"template {index} is one grey level, {values.flat[0]:g}: choose one with texture"
            )

    def _prepare(self, index: int, pixels: NDArray[Any]) -> None:
        values = pixels.astype(np.float64)
        if self.dtype == np.uint8:
            self._sums[index] = int(values.sum()), int((values * values).sum())
        elif self.score == "gain_offset":
            values -= values.mean()
            self._sums[index] = np.array([(values * values).sum(), 0], np.float32).view(np.int32)
        self._values[index] = values
        self._missing.discard(index)

    def set_windows(self, origins_yx: ArrayLike, *, clamp: bool = False) -> NDArray[np.int64]:
        """Place the windows; return their origins as used.

        Parameters
        ----------
        origins_yx : (count, 2)
            Image row and column of each window's top-left pixel, integers.
        clamp
            A window that would leave the image is moved inside by the smallest move; otherwise it is refused.

        Raises
        ------
        InputError
            Another shape, not integers, or a window outside the image.
        """
        origins = np.asarray(origins_yx)
        if origins.shape != (self.count, 2) or not np.issubdtype(origins.dtype, np.integer):
            raise InputError(
                f"origins of shape {origins.shape} and type {origins.dtype} came, ({self.count}, 2) integers "
                "were wanted: one row and column for each template"
            )
        last = np.subtract(self.image_shape, self.search_shape)
        inside: NDArray[np.int64] = np.clip(origins, 0, last).astype(np.int64)
        if not clamp and (inside != origins).any():
            worst = int(np.abs(inside - origins).max(axis=1).argmax())
            raise InputError(
                f"window {worst} at {tuple(origins[worst].tolist())} leaves the image: its corner must lie "
                f"within (0, 0) and {tuple(last.tolist())}"
            )
        if not np.array_equal(inside, self._origins):
            self._origins[:] = inside
            self._origins_on_device.upload(self._origins)
        return inside

    def __call__(self, image: DeviceArray) -> None:
        """Enqueue one search of `image` (`image_shape`, `dtype`); fetch the result before the next.

        NaN, infinity and levels beyond 1e16 need no check: a footprint that holds one matches nothing.

        Raises
        ------
        InputError
            Another image shape or type, or a template was never set.
        """
        if image is not self._image:
            if image.shape != self.image_shape or image.dtype != self.dtype:
                raise InputError(
                    f"an image of shape {image.shape} and type {image.dtype} came, {self.image_shape} "
                    f"{self.dtype} was wanted: build the search for this image"
                )
            self._search.set(0, image)
            if self._best:
                self._best.set(0, image)
            self._image = image
        if self._missing:
            raise InputError(
                f"template {min(self._missing)} was never set: call set_templates before the search"
            )
        done = self._search()
        if self._best:
            done = self._best()
        self._records.begin_download(done)

    @property
    def found(self) -> bool:
        """Whether `fetch` would return at once."""
        return self._records.arrived

    def fetch(self) -> SearchResult:
        """Wait for the last search and return what it found."""
        records = self._records.download(self._fetched)
        neighbourhood = self._decoded(records[:, 2:11]).reshape(self.count, 3, 3)
        patches = None
        if self.patch_margin is not None:
            patches = records[:, 11:].view(np.float32).reshape(self.count, *self.patch_shape).copy()
        return SearchResult(
            best_yx=records[:, :2].astype(np.int64),
            score=neighbourhood[:, 1, 1].copy(),
            neighbourhood=neighbourhood,
            patches=patches,
        )

    def score_maps(self) -> NDArray[np.float64]:
        """Wait for the last search and return every score, (count, rows, columns) of `offsets_shape`."""
        return self._decoded(self._scores.download()[:, :, : self.offsets_shape[1]])

    def search(self, image: NDArray[Any]) -> SearchResult:
        """Upload `image`, search it and return the result: the short way, when speed does not matter."""
        if image.shape != self.image_shape or image.dtype != self.dtype:
            raise InputError(
                f"an image of shape {image.shape} and type {image.dtype} came, {self.image_shape} "
                f"{self.dtype} was wanted: convert it first"
            )
        self(self.device.upload(image))
        return self.fetch()

    def _decoded(self, bits: NDArray[np.int32]) -> NDArray[np.float64]:
        integers = self.dtype == np.uint8 and self.score == "ssd"
        values = (bits if integers else bits.view(np.float32)).astype(np.float64)
        np.copyto(values, np.inf, where=bits == _SCORE_NONE)
        return values


def _lanes_tile(
    lanes: int, fitting: int, template: tuple[int, int], offsets: tuple[int, int]
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Choose the block, of at most `fitting` vectors, that wastes least, and how many offsets make a tile."""

    def covered(block: tuple[int, int]) -> tuple[int, int]:
        return _multiple(offsets[0], block[0]), _multiple(offsets[1], block[1] * lanes)

    # A tap is loaded once for its block, a row of the window once for each of its vectors.
    block = min(
        (b for b in _BLOCKS if math.prod(b) <= fitting),
        key=lambda b: math.prod(covered(b)) * (1 + 1 / b[0] + 1 / b[1]),
    )
    rows, columns = covered(block)
    most = max(min(_TILE_TAPS // math.prod(template), _TILE_OFFSETS), math.prod(block) * lanes)
    if rows * columns > most or columns > _TILE_COLUMNS:
        columns = _share(columns, min(_TILE_COLUMNS, most // block[0]), block[1] * lanes)
        rows = _share(rows, most // columns, block[0])
    return block, (rows, columns)


def _multiple(n: int, unit: int) -> int:
    return -(-n // unit) * unit


def _share(total: int, most: int, unit: int) -> int:
    """Return the size of equal parts of `total`, the fewest of at most `most`, in whole units."""
    parts = -(-total // max(most // unit * unit, unit))
    return _multiple(-(-total // parts), unit)
