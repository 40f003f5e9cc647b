"""All the mathematics in float64 NumPy: the specification, and what every kernel is tested against.

Read this first. One function per operation, named like its kernel file, its plan, its tests and its case.
Nothing on the run-time path may import this module; an import contract holds it. Equation numbers are those
of docs/maths.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fresnel

# ---- pupil_phase ------------------------------------------------------------------------------------------


def pupil_phase(
    x: ArrayLike,
    y: ArrayLike,
    alpha_rad: float,
    psi_rad: float,
    *,
    tilt_xy_rad: tuple[float, float] = (0.0, 0.0),
    odd_x_rad: ArrayLike = 0.0,
    odd_y_rad: ArrayLike = 0.0,
    map_rad: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Sum the phase over the stop, not wrapped: (rows, columns), radians.

    Parameters
    ----------
    x : (columns,), y : (rows,)
        Coordinates in half apertures.

    Source
    ------
    docs/maths.md, eq. P1.
    """
    t_x, t_y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    along_x = ((alpha_rad * t_x + psi_rad) * t_x + tilt_xy_rad[0]) * t_x + np.asarray(odd_x_rad)
    along_y = ((alpha_rad * t_y + psi_rad) * t_y + tilt_xy_rad[1]) * t_y + np.asarray(odd_y_rad)
    return np.asarray(along_x[None, :] + along_y[:, None] + np.asarray(map_rad), dtype=np.float64)


# ---- slm_encode -------------------------------------------------------------------------------------------


def slm_encode(
    panel_shape: tuple[int, int],
    stop_px: float,
    table: NDArray[np.uint8],
    alpha_rad: float,
    psi_rad: float,
    *,
    tilt_xy_rad: tuple[float, float] = (0.0, 0.0),
    correction_rad: ArrayLike = 0.0,
) -> NDArray[np.uint8]:
    """Return the panel's codes for a mask whose stop is `stop_px` pixels wide, centred; 0 outside.

    Source
    ------
    docs/maths.md, eqs. E1 and E2.
    """
    y, x = ((np.arange(n) - (n - 1) / 2) * 2 / stop_px for n in panel_shape)
    phase = pupil_phase(x, y, alpha_rad, psi_rad, tilt_xy_rad=tilt_xy_rad, map_rad=correction_rad)
    level = np.floor(256 * (phase / (2 * np.pi) % 1) + 0.5).astype(int) % 256
    edge = 1 + 1 / stop_px  # a pixel that straddles the stop's edge still shows the mask
    inside = (np.abs(y) < edge)[:, None] & (np.abs(x) < edge)[None, :]
    return np.where(inside, table[level], 0).astype(np.uint8)


# ---- otf --------------------------------------------------------------------------------------------------


def otf_1d(u: ArrayLike, alpha_rad: float, psi_rad: float) -> NDArray[np.complex128]:
    """Evaluate the exact optical transfer function of the square stop along one axis.

    H(u) = 1/2 int P(x + u/2) conj P(x - u/2) dx with P = exp(i(alpha x^3 + psi x^2)) on [-1, 1]. Closed form
    by Fresnel integrals where that is well conditioned, Gauss-Legendre quadrature on the definition
    elsewhere; either way within 1e-13.

    Parameters
    ----------
    u : any shape
        Normalised frequency; H is 0 beyond the cut-off |u| = 2.
    alpha_rad, psi_rad
        Cubic and quadratic phase at the stop's edge.

    Source
    ------
    docs/maths.md, eqs. O1 and O2.
    """
    frequency = np.asarray(u, dtype=np.float64)
    w = np.abs(frequency).ravel()
    b = np.maximum(1 - w / 2, 0.0)
    out = np.zeros(w.shape, dtype=np.complex128)
    # Both the sign of psi and, up to conjugation, the signs of alpha and u drop out.
    alpha, psi = abs(float(alpha_rad)), abs(float(psi_rad))
    c = 3 * alpha * w
    if alpha == 0:
        out[:] = b * np.sinc(2 * psi * w * b / np.pi)
    else:
        x0 = psi / (3 * alpha)
        k = np.sqrt(2 * c / np.pi)
        eps = np.finfo(np.float64).eps
        with np.errstate(divide="ignore", invalid="ignore"):
            error = eps * (psi**2 * w / (3 * alpha) + c * (b + x0) ** 2) / (2 * k)
        total_phase = 2 * b * (c * b + 2 * psi * w)
        closed = (c * b**2 > 0.5) & ((error < 2e-14) | (total_phase > 2e4))
        out[closed] = _otf_1d_closed(w[closed], alpha, psi)
        out[~closed] = _otf_1d_quadrature(w[~closed], alpha, psi)
    result = np.where(frequency.ravel() * float(alpha_rad) < 0, out.conj(), out)
    return result.reshape(frequency.shape)


def _otf_1d_closed(w: NDArray[np.float64], alpha: float, psi: float) -> NDArray[np.complex128]:
    """Eq. O2 for w > 0, alpha > 0."""
    b, x0 = 1 - w / 2, psi / (3 * alpha)
    k = np.sqrt(6 * alpha * w / np.pi)
    s_high, c_high = fresnel(k * (b + x0))
    s_low, c_low = fresnel(k * (x0 - b))
    phase = alpha * w**3 / 4 - psi**2 * w / (3 * alpha)
    return np.asarray(np.exp(1j * phase) / (2 * k) * (c_high - c_low + 1j * (s_high - s_low)))


def _otf_1d_quadrature(w: NDArray[np.float64], alpha: float, psi: float) -> NDArray[np.complex128]:
    """Eq. O1 by panels of 40 Gauss-Legendre nodes, each spanning at most 20 rad of phase."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    out = np.zeros(w.shape, dtype=np.complex128)
    b = np.maximum(1 - w / 2, 0.0)
    # The phase runs fastest at the ends, at twice its mean rate for a pure square.
    panels = np.maximum(np.ceil(2 * b * (6 * alpha * w * b + 2 * psi * w) / 20), 1).astype(int)
    for count in np.unique(panels):
        chosen = panels == count
        centres = (2 * np.arange(count) + 1 - count) / count
        t = (centres[:, None] + nodes / count).ravel()
        x = b[chosen, None] * t
        v = w[chosen, None]
        phase = 3 * alpha * v * x**2 + 2 * psi * v * x + alpha * v**3 / 4
        out[chosen] = np.exp(1j * phase) @ np.tile(weights / count, count) * b[chosen] / 2
    return out


def otf_of_profile(phase_rad: ArrayLike) -> NDArray[np.complex128]:
    """Autocorrelate any phase profile sampled at n cells: H at u = 0, 2/n .. 2, shape (n + 1,).

    Source
    ------
    docs/maths.md, eq. O10.
    """
    pupil = np.exp(1j * np.asarray(phase_rad, dtype=np.float64))
    n = pupil.size
    full = np.correlate(pupil, pupil, mode="full") / n  # lags -(n - 1) .. n - 1
    return np.asarray(np.append(full[n - 1 :], 0))


# ---- psf --------------------------------------------------------------------------------------------------


def psf_of_pupil(
    phase_rad: ArrayLike, amplitude: ArrayLike, *, padded: int
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Transform a sampled pupil (n, n) to its point-spread and transfer function, (padded, padded) each.

    The point-spread function sums to 1 and is centred on [0, 0]; so is the transfer function, at u = 2 j/n.

    Source
    ------
    docs/maths.md, eq. O11.
    """
    pupil = np.asarray(amplitude) * np.exp(1j * np.asarray(phase_rad, dtype=np.float64))
    intensity = np.abs(np.fft.ifft2(pupil, (padded, padded))) ** 2
    psf = intensity / intensity.sum()
    return psf, np.fft.fft2(psf)


def psf_of_axes(otf_y: NDArray[np.complex128], otf_x: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Transform two axes' transfer functions (DC first, Nyquist bins real) to the point-spread function.

    Source
    ------
    docs/maths.md, eq. O11 read backwards.
    """
    return np.asarray(np.fft.ifft2(np.outer(otf_y, otf_x)).real)


# ---- wiener -----------------------------------------------------------------------------------------------


def wiener(otf: ArrayLike, nsr: ArrayLike) -> NDArray[np.complex128]:
    """Return the filter conj(H) / (|H|^2 + nsr), and 0 where H = 0.

    Source
    ------
    The paper's Eq. 3 as corrected in docs/maths.md, eq. W1.
    """
    h = np.asarray(otf, dtype=np.complex128)
    power = np.abs(h) ** 2 + np.asarray(nsr, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(h == 0, 0, h.conj() / power)


def wiener_of_axes(h_rows: ArrayLike, h_cols: ArrayLike, nsr: ArrayLike) -> NDArray[np.complex128]:
    """Return the filter of a separable blur over the half spectrum, (ny, nx // 2 + 1).

    The Nyquist bin of an even axis is replaced by its real part.

    Source
    ------
    docs/maths.md, eq. W1.
    """
    v, u = np.array(h_rows, dtype=np.complex128), np.array(h_cols, dtype=np.complex128)
    for axis in (v, u):
        if axis.size % 2 == 0:
            axis[axis.size // 2] = axis[axis.size // 2].real
    return wiener(np.outer(v, u[: u.size // 2 + 1]), nsr)


# ---- restore ----------------------------------------------------------------------------------------------


def restore_padding(
    frame: NDArray[np.generic], padded: tuple[int, int], *, taper: bool = True
) -> NDArray[np.float64]:
    """Continue a frame to (ny, nx): the frame at [0, 0], then from its far edge to its near one.

    Source
    ------
    docs/maths.md, eqs. W3 and W4.
    """
    image = np.asarray(frame, dtype=np.float64)
    for axis in (0, 1):
        samples = padded[axis] - image.shape[axis]
        after = [(0, samples if i == axis else 0) for i in (0, 1)]
        before = [(samples if i == axis else 0, 0) for i in (0, 1)]
        far = np.pad(image, after, mode="edge")
        near = np.roll(np.pad(image, before, mode="edge"), -samples, axis)
        t = np.arange(1, samples + 1) / (samples + 1)
        step = np.arange(samples) >= -(-samples // 2)
        share = np.sin(np.pi / 2 * t) ** 2 if taper else step.astype(np.float64)
        w = np.append(np.zeros(image.shape[axis]), share)
        w = w[:, None] if axis == 0 else w[None, :]
        image = (1 - w) * far + w * near
    return image


def restore(
    frame: NDArray[np.generic],
    gain: NDArray[np.complexfloating],
    padded: tuple[int, int],
    *,
    taper: bool = True,
) -> NDArray[np.float64]:
    """Filter a frame by `gain`, (ny, nx // 2 + 1), and crop: not rounded, not clamped.

    Source
    ------
    docs/maths.md, eq. W2.
    """
    spectrum = np.fft.rfft2(restore_padding(frame, padded, taper=taper)) * gain
    return np.asarray(np.fft.irfft2(spectrum, s=padded)[: frame.shape[0], : frame.shape[1]])


# ---- image_prep -------------------------------------------------------------------------------------------


def image_prep(
    frame: NDArray[np.integer],
    dark: ArrayLike,
    gain: ArrayLike,
    *,
    region: tuple[int, int, int, int] | None = None,
    to_bytes: bool = False,
) -> NDArray[np.float64]:
    """Correct a raw frame and crop it.

    Parameters
    ----------
    frame : (rows, columns)
        Raw grey levels.
    dark, gain
        One number, or a map of the frame's shape.
    region
        top, left, rows, columns.
    to_bytes
        Round half up and hold to 0 .. 255.

    Source
    ------
    docs/maths.md, eq. S1.
    """
    image = np.asarray(gain, dtype=np.float64) * (frame - np.asarray(dark, dtype=np.float64))
    if region is not None:
        top, left, rows, columns = region
        image = image[top : top + rows, left : left + columns]
    return np.clip(np.floor(image + 0.5), 0, 255) if to_bytes else image


# ---- ssd_search -------------------------------------------------------------------------------------------


def ssd_search(
    image: NDArray[np.generic],
    template: NDArray[np.generic],
    origin_yx: tuple[int, int],
    search_shape: tuple[int, int],
    *,
    score: str = "ssd",
) -> tuple[tuple[int, int], NDArray[np.float64] | NDArray[np.int64]]:
    """Score one template at every place of one window; return the best place in the image, and all scores.

    Integers in, "ssd": int64 sums, exact. "gain_offset" and float images: float64.

    Source
    ------
    docs/maths.md, eqs. S2 and S5; of equal scores the first in row-major order (S7).
    """
    top, left = origin_yx
    window = image[top : top + search_shape[0], left : left + search_shape[1]]
    exact = score == "ssd" and np.issubdtype(image.dtype, np.integer)
    kind = np.int64 if exact else np.float64
    places = np.lib.stride_tricks.sliding_window_view(window.astype(kind), template.shape)
    wanted = template.astype(kind)
    if score == "ssd":
        scores = ((places - wanted) ** 2).sum(axis=(2, 3))
    else:
        wanted = wanted - wanted.mean()
        centred = places - places.mean(axis=(2, 3), keepdims=True)
        squares = (centred**2).sum(axis=(2, 3))
        cross = (centred * wanted).sum(axis=(2, 3))
        matches = (cross > 0) & (squares > 0)
        rho2 = cross**2 / (np.where(matches, squares, 1) * (wanted**2).sum())
        scores = np.where(matches, np.maximum(1 - rho2, 0), 1.0)
    y, x = np.unravel_index(int(scores.argmin()), scores.shape)
    return (top + int(y), left + int(x)), scores
