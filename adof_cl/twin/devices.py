"""Camera and modulator, as the loop meets them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError
from adof_cl.optics import SlmPanel
from adof_cl.twin.clock import Clock
from adof_cl.twin.pupil import Pupil, read_codes
from adof_cl.twin.world import Time, World


@dataclass(frozen=True)
class Frame:
    """One exposure.

    Attributes
    ----------
    pixels
        uint8 (rows, columns).
    number
        Counts exposures since the rig was switched on; both cameras count alike.
    time_s
        Middle of the exposure.
    origin_yx
        Sensor (row, column) of the first pixel.
    """

    pixels: NDArray[np.uint8]
    number: int
    time_s: float
    origin_yx: tuple[int, int] = (0, 0)


class SimulatedSlm:
    """A phase panel that shows 8-bit codes and takes its time to change."""

    def __init__(
        self, panel: SlmPanel, aperture_um: float, clock: Time, settling_s: float, *, pixels: bool = True
    ) -> None:
        self.panel = panel
        self.settling_s = settling_s
        self._aperture_um = aperture_um
        self._clock = clock
        self._pixels = pixels
        flat = self._read(np.zeros((panel.rows, panel.columns), dtype=np.uint8))
        self._loaded = flat
        self._shown = [(-math.inf, flat)]

    @property
    def settled(self) -> bool:
        """Whether the last pattern is fully there."""
        return self._clock.now_s >= self._shown[-1][0] + self.settling_s

    @property
    def pupil(self) -> Pupil:
        """The pattern shown last, as the light finds it; truth, not for the loop."""
        return self._shown[-1][1]

    def load(self, codes: NDArray[np.uint8]) -> None:
        """Check a pattern and keep it ready; nothing changes yet.

        Raises
        ------
        InputError
            Wrong shape or type, or a pattern that does not separate.
        """
        self._loaded = self._read(codes)

    def show(self, codes: NDArray[np.uint8] | None = None, *, since_s: float | None = None) -> None:
        """Show the loaded pattern, or load and show this one; it is there `settling_s` later.

        `since_s`: it has been shown since then, though it is told only now.
        """
        if codes is not None:
            self.load(codes)
        self._shown.append((self._clock.now_s if since_s is None else since_s, self._loaded))

    def acting(self, from_s: float, to_s: float) -> list[tuple[float, Pupil]]:
        """Return the patterns that act between two times with their shares: two while it settles."""
        index = max(i for i, (shown_s, _) in enumerate(self._shown) if shown_s <= max(to_s, 0.0))
        shown_s, new = self._shown[index]
        share = self._progress(from_s, to_s, shown_s)
        if index == 0 or share >= 1:
            return [(1.0, new)]
        old = self._shown[index - 1][1]
        return [(1 - share, old), (share, new)] if share > 0 else [(1.0, old)]

    def _read(self, codes: NDArray[np.uint8]) -> Pupil:
        return read_codes(codes, self.panel, self._aperture_um, pixels=self._pixels)

    def _progress(self, from_s: float, to_s: float, shown_s: float) -> float:
        """Mean over the exposure of a change that runs linearly."""
        if not math.isfinite(shown_s):
            return 1.0
        times = np.linspace(from_s, to_s, 9)
        return float(np.clip((times - shown_s) / self.settling_s, 0, 1).mean())


class SimulatedCamera:
    """A free-running camera: photon noise, read noise, 8 bits; no time but the clock's."""

    def __init__(self, number: int, world: World, clock: Clock, seed: int, *, noise: bool = True) -> None:
        self.number = number
        self._world = world
        self._clock = clock
        self._seed = seed
        self._noise = noise
        self._last = -1
        self._origin_yx = (0, 0)
        self._shape = (world.design.rows, world.design.columns)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        return self._shape

    @property
    def origin_yx(self) -> tuple[int, int]:
        """Sensor (row, column) of a frame's first pixel."""
        return self._origin_yx

    def set_region(self, origin_yx: tuple[int, int], shape: tuple[int, int]) -> None:
        """Read only part of the sensor from now on.

        Raises
        ------
        InputError
            The region does not lie on the sensor.
        """
        design = self._world.design
        for first, count, size in zip(origin_yx, shape, (design.rows, design.columns), strict=True):
            if first < 0 or count < 1 or first + count > size:
                raise InputError(
                    f"region {shape[0]} x {shape[1]} at {origin_yx} leaves the sensor: it has "
                    f"{design.rows} x {design.columns} pixels"
                )
        self._origin_yx, self._shape = origin_yx, shape

    def set_centred_region(self) -> None:
        """Read the drawn region of interest."""
        design = self._world.design
        self.set_region(design.region_origin_yx, (design.region_rows, design.region_columns))

    def grab(self) -> Frame:
        """Wait for the end of the next exposure not yet read and return it.

        Exposure k runs from k/rate to k/rate + exposure. An exposure that ends just now counts, so that two
        cameras asked one after the other give the same moment.
        """
        design = self._world.design
        period_s = 1 / design.frame_rate_hz
        soonest = math.ceil((self._clock.now_s - design.exposure_s) / period_s - 1e-9)
        number = max(soonest, self._last + 1, 0)
        start_s = number * period_s
        self._clock.wait_until(start_s + design.exposure_s)
        self._last = number
        return Frame(self.expose(number, start_s), number, start_s + design.exposure_s / 2, self._origin_yx)

    def expose(self, number: int, start_s: float) -> NDArray[np.uint8]:
        """Return exposure `number`, begun at `start_s`; waits for nothing."""
        design = self._world.design
        image = self._world.radiance(
            self.number, start_s, start_s + design.exposure_s, self._origin_yx, self._shape
        )
        electrons = image * np.float32(design.exposure_level * design.full_well_e)
        if self._noise:
            rng = np.random.default_rng([self._seed, self.number, number])
            noise = rng.standard_normal(self._shape, dtype=np.float32)
            # Photon noise of the background, 900 electrons, is Gaussian to better than its own rounding.
            electrons += noise * np.sqrt(np.maximum(electrons, 0) + np.float32(design.read_noise_e**2))
        levels = np.rint(electrons * np.float32(255 / design.full_well_e))
        return np.asarray(np.clip(levels, 0, 255), dtype=np.uint8)
