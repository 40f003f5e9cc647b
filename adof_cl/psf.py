"""Point-spread and transfer functions by two-dimensional transforms on the device (kernels/psf.cl).

For stops and phases that do not separate: a round stop, cross terms, a panel's pixels, a measured map. The
square stop with a cubic mask needs none of this: see `otf.Otf1d`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError, LimitError
from adof_cl.finite import checked_shape
from adof_cl.optics import OpticalSystem, PupilGrid, SlmPanel, require_whole
from adof_cl.program import Launch, Program

_DARKEST = 1e-6  # stop, at its clearest
LARGEST_SAMPLES = 4096
"""Cells across the stop; 8192 x 8192 complex numbers are half a gigabyte twice."""


def samples_for(alpha_rad: float, psi_rad: float) -> int:
    """Return a power of two of cells that samples the phase twice as finely as eq. O9 asks, 128 at least.

    Raises
    ------
    LimitError
        More than `LARGEST_SAMPLES` would be needed.
    """
    wanted = PupilGrid.nyquist_samples(alpha_rad, psi_rad)
    if wanted > LARGEST_SAMPLES:
        raise LimitError(
            f"alpha {alpha_rad:g} and psi {psi_rad:g} need {wanted:.0f} cells across the stop, at most "
            f"{LARGEST_SAMPLES} are possible in two dimensions: use the separable route or a weaker phase"
        )
    return min(max(128, 1 << math.ceil(math.log2(max(2 * wanted, 1)))), LARGEST_SAMPLES)


def require_sampling(samples: int, alpha_rad: float, psi_rad: float) -> None:
    """Refuse a pupil too coarse for its phase: the result would be wrong, not rough.

    Raises
    ------
    LimitError
        Fewer cells than eq. O9 asks.
    InputError
        Not finite.
    """
    require_whole(samples=samples)
    wanted = PupilGrid.nyquist_samples(alpha_rad, psi_rad)
    if samples < wanted:
        raise LimitError(
            f"{samples} cells across the stop are too few for alpha {alpha_rad:g} and psi {psi_rad:g}: "
            f"at least {wanted:.0f} are needed"
        )


def stop_amplitude(kind: str, samples: int) -> NDArray[np.float64]:
    """Return the stop's transmission at its cells, (samples, samples): 1 where a cell's centre lies inside.

    Parameters
    ----------
    kind
        "square" or "round".

    Raises
    ------
    InputError
        Another word.
    """
    if kind == "square":
        return np.ones((samples, samples))
    if kind != "round":
        raise InputError(f"stop is '{kind}': choose 'square' or 'round'")
    # Not the share of each rim cell: its square would enter the power, its plain value every overlap.
    x = PupilGrid(samples).x
    return (x**2 + x[:, None] ** 2 <= 1).astype(np.float64)


class Psf:
    """Transform a sampled pupil to its point-spread function and transfer function.

    Built once: compiles, allocates, uploads the stop. A call enqueues only. Both results are (m, m) with
    their centre at [0, 0], m = padding * samples:
    the transfer function at u = 2 j/samples, the point-spread function at steps of `pitch_um` at the object.

    Parameters
    ----------
    device
        The opened device.
    samples
        Cells across the stop, a power of two.
    stop
        "square", "round", or the amplitude (samples, samples), 0 to 1.
    padding
        2 or another power of two; 2 is enough, more interpolates the point-spread function.
    precision
        "float32" or "float64".

    Raises
    ------
    InputError
        Not powers of two, or an amplitude of another shape, not finite or dark.
    LimitError
        More than `LARGEST_SAMPLES`.

    Source
    ------
    docs/maths.md, eq. O11. Grid error of the transfer function about 0.2 (3 alpha + 2 psi)/samples^2.
    """

    def __init__(
        self,
        device: Device,
        samples: int,
        *,
        stop: str | NDArray[np.float64] = "square",
        padding: int = 2,
        precision: str = "float32",
    ) -> None:
        PupilGrid(samples)
        whole = isinstance(padding, (int, np.integer)) and padding >= 2
        if samples & (samples - 1) or not whole or padding & (padding - 1):
            raise InputError(f"samples is {samples}, padding {padding}: powers of two from 2 were wanted")
        if samples > LARGEST_SAMPLES:
            raise LimitError(
                f"samples is {samples}: at most {LARGEST_SAMPLES} are possible in two dimensions"
            )
        amplitude = (
            stop_amplitude(stop, samples) if isinstance(stop, str) else np.asarray(stop, dtype=np.float64)
        )
        if amplitude.shape != (samples, samples):
            raise InputError(f"stop has shape {amplitude.shape}: ({samples}, {samples}) was wanted")
        power = float((amplitude**2).sum())
        if not (amplitude.min() >= 0 and _DARKEST <= amplitude.max() <= 1):
            raise InputError(
                "stop holds NaN, lets no light through, or amplitudes beyond 0 to 1: only those were wanted"
            )
        self.samples = samples
        self.size = m = padding * samples
        self._device = device
        self._real = device.real_type(precision)
        kind = np.result_type(self._real, np.complex64)
        here, there = device.empty((m, m), kind), device.empty((m, m), kind)
        self.psf = device.empty((m, m), self._real)
        roots = device.upload(np.exp(-2j * np.pi * np.arange(m // 2) / m).astype(kind))
        self._amplitude = device.upload(amplitude.astype(self._real))
        self._program = Program(device, "psf.cl", {"REAL_IS_DOUBLE": precision == "float64"})
        self._field = self._program.launch(
            "psf_field", (m, m), None, self._amplitude, self._amplitude, here, np.int32(samples), np.int32(m)
        )
        self._launches: list[Launch] = [self._field]
        for sign in (1, -1):
            for along_rows in (1, 0):
                for s in 2 ** np.arange(m.bit_length() - 1):
                    size = (m // 2, m) if along_rows else (m, m // 2)
                    numbers = [np.int32(v) for v in (m, s, along_rows, sign)]
                    self._launches.append(
                        self._program.launch("psf_fft", size, None, here, roots, there, *numbers)
                    )
                    here, there = there, here
            if sign > 0:
                scale = self._real.type(1 / (float(m) ** 2 * power))
                self._launches.append(
                    self._program.launch("psf_intensity", (m, m), None, here, self.psf, np.int32(m), scale)
                )
        self.otf = here

    @property
    def u(self) -> NDArray[np.float64]:
        """Frequency of each bin of `otf` along either axis, DC first."""
        return np.asarray(np.fft.fftfreq(self.size) * 2 * self.size / self.samples, dtype=np.float64)

    def pitch_um(self, optics: OpticalSystem) -> float:
        """Return the step of `psf` at the object."""
        return optics.wavelength_um * optics.f_number * self.samples / self.size

    def __call__(
        self, turns: DeviceArray, *, alpha_rad: float = 0.0, psi_rad: float = 0.0
    ) -> tuple[DeviceArray, DeviceArray]:
        """Enqueue both transforms of a pupil phase; return `self.psf` and `self.otf`.

        Parameters
        ----------
        turns : (samples, samples) real
            Phase over the stop in turns, as `pupil_phase.PupilPhase` or `panel_turns` gives it. It must be
            finite: it lies on the device and is not checked.
        alpha_rad, psi_rad
            The strength it stands for, so that a stop too coarse for it is refused.

        Raises
        ------
        LimitError
            Too few cells for that strength.
        InputError
            `turns` has another shape or type.
        """
        require_sampling(self.samples, alpha_rad, psi_rad)
        self._require_turns(turns)
        self._field.set(0, turns)
        for launch in self._launches:
            launch()
        return self.psf, self.otf

    def panel_turns(
        self, codes: DeviceArray, smooth: DeviceArray, panel: SlmPanel, optics: OpticalSystem
    ) -> DeviceArray:
        """Return the phase a panel shows with `codes`, pixel by pixel, plus a smooth one; for the call above.

        Parameters
        ----------
        codes : (panel.rows, panel.columns) uint8
            As `slm_encode.SlmEncode` gives them.
        smooth : (samples, samples) real
            Turns that do not come from the panel, such as the object's defocus.

        Raises
        ------
        LimitError
            Fewer cells than panel pixels across the stop.
        InputError
            Another shape or type.
        """
        across = panel.stop_px(optics.aperture_um)
        if self.samples < across:
            raise LimitError(
                f"{self.samples} cells across the stop are too few for {across:.0f} pixels of {panel.name}: "
                "use at least one cell per pixel"
            )
        self._require_turns(smooth)
        if codes.shape != (panel.rows, panel.columns) or codes.dtype != np.uint8:
            raise InputError(
                f"codes are {codes.shape} {codes.dtype}: ({panel.rows}, {panel.columns}) uint8 was wanted"
            )
        x = PupilGrid(self.samples).x
        pixel_of = [
            self._device.upload(np.rint(x * across / 2 + (n - 1) / 2).clip(0, n - 1).astype(np.int32))
            for n in codes.shape
        ]
        turns = self._device.empty((self.samples, self.samples), self._real)
        # Kept until the next call: a device may still be at work on it when this returns.
        self._panel = self._program.launch(
            "psf_panel",
            (self.samples, self.samples),
            None,
            codes,
            smooth,
            *pixel_of,
            turns,
            np.int32(self.samples),
            np.int32(panel.columns),
            self._real.type(panel.stroke_rad / (2 * math.pi) / 255),
        )
        self._panel()
        return turns

    def camera_otf(self, optics: OpticalSystem, shape: tuple[int, int]) -> NDArray[np.complex128]:
        """Return the last call's transfer function at a camera's frequencies, pixel aperture included.

        A matrix transform of the point-spread function on the host, for set-up: it interpolates within the
        grid's own error. Nyquist bins of even lengths are real, as a real image needs.

        Parameters
        ----------
        shape
            Camera pixels (rows, columns).

        Returns
        -------
        shape complex128, DC at [0, 0].

        Raises
        ------
        InputError
            Not two whole numbers of 1 or more.
        """
        shape = checked_shape("shape", shape)
        psf = self.psf.download().astype(np.float64)
        step = np.asarray(np.fft.fftfreq(self.size) * self.samples, dtype=np.float64)  # s of each sample
        rows, columns = (_transform(optics, n, step) for n in shape)
        return np.asarray(rows @ psf @ columns.T)

    def _require_turns(self, turns: DeviceArray) -> None:
        wanted = (self.samples, self.samples)
        if turns.shape != wanted or turns.dtype != self._real:
            raise InputError(
                f"turns are {turns.shape} {turns.dtype}: {wanted} {self._real} was wanted, as planned"
            )


def _transform(optics: OpticalSystem, n: int, step: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Map samples at `step` to a camera axis' frequencies through the pixel aperture, (n, samples)."""
    matrix = np.exp(-1j * np.pi * np.outer(optics.frequency_axis(n), step))
    matrix *= optics.pixel_otf_axis(n)[:, None]
    if n % 2 == 0:  # the mean of both Nyquist frequencies: of a real function, the real part
        matrix[n // 2] = matrix[n // 2].real
    return np.asarray(matrix, dtype=np.complex128)
