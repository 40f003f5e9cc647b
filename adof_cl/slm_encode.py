"""The mask as a modulator's 8-bit codes, formed on the device (kernels/slm_encode.cl); panel presets."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError, LimitError
from adof_cl.optics import Mask, OpticalSystem, SlmPanel
from adof_cl.phase_terms import require_envelope, require_tilt, split, split_turns, wrapped_turns
from adof_cl.program import Program

_RECALLED = "from memory, not checked against a data sheet"
_LARGEST_STROKE_RAD = 20 * math.pi
_STROKE = "a full turn of stroke is assumed: measure yours at your wavelength and use with_stroke()"

PANELS: dict[str, SlmPanel] = {
    panel.name: panel
    for panel in (
        SlmPanel(
            "LC2002",
            rows=600,
            columns=800,
            pitch_um=32.0,
            fill_factor=0.55,
            frame_rate_hz=60.0,
            source=f"HOLOEYE LC2002, transmissive: all numbers {_RECALLED}; {_STROKE}",
        ),
        SlmPanel(
            "LC2012",
            rows=768,
            columns=1024,
            pitch_um=36.0,
            fill_factor=0.58,
            frame_rate_hz=60.0,
            source="HOLOEYE LC 2012, transmissive: pixels, pitch, fill and rate from the public driver "
            f"ebezzam/slm-controller, hardware.py; {_STROKE}",
        ),
        SlmPanel(
            "PLUTO",
            rows=1080,
            columns=1920,
            pitch_um=8.0,
            fill_factor=0.87,
            frame_rate_hz=60.0,
            source="HOLOEYE PLUTO, reflective: pixels and size (15.36 x 8.64 mm) from public driver sources; "
            f"fill (87 to 93 % by model) and rate {_RECALLED}; {_STROKE}",
        ),
        SlmPanel(
            "LETO",
            rows=1080,
            columns=1920,
            pitch_um=6.4,
            fill_factor=0.93,
            frame_rate_hz=60.0,
            source=f"HOLOEYE LETO, reflective: all numbers {_RECALLED}; {_STROKE}",
        ),
    )
}
"""Known modulators by name; `source` says where each number comes from."""


def panel_named(name: str) -> SlmPanel:
    """Return a preset, in any case and with or without spaces.

    Raises
    ------
    InputError
        No such panel.
    """
    panel = PANELS.get(name.upper().replace(" ", "").replace("-", ""))
    if panel is None:
        raise InputError(f"panel is '{name}': choose one of {', '.join(PANELS)}")
    return panel


def stroke_table(stroke_rad: float) -> NDArray[np.uint8]:
    """Return the code for each of 256 phase levels: the nearest phase the panel's stroke can show.

    Parameters
    ----------
    stroke_rad
        Phase between code 0 and code 255.

    Raises
    ------
    InputError
        Not above 0, or more than ten turns.

    Source
    ------
    docs/maths.md, eq. E3.
    """
    if not 0 < stroke_rad <= _LARGEST_STROKE_RAD:
        raise InputError(f"stroke_rad is {stroke_rad}: above 0 and at most ten turns was wanted")
    phase = 2 * math.pi * np.arange(256) / 256
    codes = np.rint(255 * phase / stroke_rad)
    beyond = np.where(phase - stroke_rad <= 2 * math.pi - phase, 255.0, 0.0)
    return np.where(phase <= stroke_rad, codes, beyond).astype(np.uint8)


class SlmEncode:
    """Turn a mask into the codes of one panel, centred on it; 0 outside the stop.

    Built once; a call enqueues and returns the plan's own array.

    Parameters
    ----------
    device
        The opened device.
    panel
        The modulator.
    optics
        Its stop: `aperture_um` wide.
    table : (256,) uint8, optional
        Code for each 256th of a turn, as measured; by default the panel's stroke, taken as linear.
    correction_rad : (rows, columns), optional
        The panel's flatness correction, added modulo a turn.
    precision
        "float32", which every panel can do with, or "float64".

    Raises
    ------
    LimitError
        The stop is wider than the panel, or a correction beyond 1e6 rad.
    InputError
        Table or correction of another shape, or not finite.

    Source
    ------
    docs/maths.md, eqs. E1 to E4.
    """

    def __init__(
        self,
        device: Device,
        panel: SlmPanel,
        optics: OpticalSystem,
        *,
        table: NDArray[np.uint8] | None = None,
        correction_rad: NDArray[np.float64] | None = None,
        precision: str = "float32",
    ) -> None:
        real = device.real_type(precision)
        shape = (panel.rows, panel.columns)
        across = panel.stop_px(optics.aperture_um)
        if across > min(shape):
            raise LimitError(
                f"a stop of {optics.aperture_um:g} um is {across:.1f} pixels of {panel.name}, which has "
                f"{panel.rows} x {panel.columns}: use a stop of at most {min(shape) * panel.pitch_um:g} um"
            )
        codes = stroke_table(panel.stroke_rad) if table is None else np.asarray(table)
        if codes.shape != (256,) or codes.dtype != np.uint8:
            raise InputError(f"table is {codes.shape} {codes.dtype}: (256,) uint8 was wanted")
        correction = np.zeros((1, 1)) if correction_rad is None else np.asarray(correction_rad, np.float64)
        if correction_rad is not None and correction.shape != shape:
            raise InputError(f"correction_rad has shape {correction.shape}: {shape} was wanted, the panel's")
        if not np.isfinite(correction).all():
            raise InputError("correction_rad holds NaN or infinity: finite radians were wanted")
        self.panel = panel
        self.optics = optics
        self.out = device.empty(shape, np.uint8)
        self._across = across
        self._real = real
        self._correction_step = _largest_step(correction)

        program = Program(device, "slm_encode.cl", {"REAL_IS_DOUBLE": precision == "float64"})
        turns, inside = [], []
        self._axis_launches = []
        for n in (panel.columns, panel.rows):
            t = np.asarray((np.arange(n) - (n - 1) / 2) * (2 / across), dtype=np.float64)
            # A pixel that straddles the stop's edge still shows the mask: part of it transmits.
            held = np.flatnonzero(np.abs(t) * across < across + 1)
            inside += [np.int32(held[0]), np.int32(held[-1])]
            turns.append(device.empty((n,), real))
            self._axis_launches.append(
                program.launch(
                    "slm_encode_axis",
                    (n,),
                    None,
                    device.upload(split(t, real)),
                    turns[-1],
                    np.int32(n),
                    *[real.type(0)] * 6,
                )
            )
        self._launch = program.launch(
            "slm_encode",
            (panel.columns, panel.rows),
            None,
            *turns,
            device.upload(wrapped_turns(correction, real)),
            device.upload(codes),
            self.out,
            np.int32(panel.rows),
            np.int32(panel.columns),
            np.int32(correction_rad is not None),
            *inside[2:],
            *inside[:2],
        )

    def step_rad(self, mask: Mask, tilt_xy_rad: tuple[float, float] = (0.0, 0.0)) -> float:
        """Return the largest phase step from one pixel to the next (eq. E4)."""
        tilt = max(abs(t) for t in require_tilt(tilt_xy_rad))
        slope = 3 * abs(mask.alpha_rad) + 2 * abs(mask.focus_psi_rad) + tilt
        return slope * 2 / self._across + self._correction_step

    def __call__(self, mask: Mask, *, tilt_xy_rad: tuple[float, float] = (0.0, 0.0)) -> DeviceArray:
        """Enqueue the codes of `mask`; return `self.out`, (rows, columns) uint8.

        A tilt of pi radians at the stop's edge moves the image by -lambda N along that axis.

        Raises
        ------
        LimitError
            The phase changes by more than pi from one pixel to the next, or lies beyond the measured range.
        InputError
            Not finite.
        """
        alpha, psi = require_envelope(mask.alpha_rad, mask.focus_psi_rad)
        step = self.step_rad(mask, tilt_xy_rad)
        if step > math.pi:
            strongest = math.pi * self._across / 6
            raise LimitError(
                f"alpha {alpha:g} with a focus of {psi:g} rad steps by {step:.2f} rad per pixel of "
                f"{self.panel.name}, more than pi: the cubic alone may reach {strongest:.0f} there, use less"
            )
        for launch, tilt in zip(self._axis_launches, tilt_xy_rad, strict=True):
            numbers = [part for value in (tilt, psi, alpha) for part in split_turns(value, self._real)]
            for index, number in enumerate(numbers, start=3):
                launch.set(index, number)
            launch()
        self._launch()
        return self.out

    def codes(self, mask: Mask, *, tilt_xy_rad: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.uint8]:
        """Return the codes of `mask` on the host, (rows, columns) uint8; raises as the call does."""
        return cast("NDArray[np.uint8]", self(mask, tilt_xy_rad=tilt_xy_rad).download())


def _largest_step(phase_rad: NDArray[Any]) -> float:
    """The largest difference between neighbours, modulo a turn."""
    largest = 0.0
    for axis in (0, 1):
        difference = np.diff(phase_rad, axis=axis)
        difference -= 2 * math.pi * np.rint(difference / (2 * math.pi))
        largest = max(largest, float(np.abs(difference).max(initial=0.0)))
    return largest
