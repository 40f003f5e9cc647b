"""Follow features from frame to frame to a fraction of a pixel, each with its covariance.

The device finds every template's best whole-pixel place in one launch; the host refines it on small patches
in float64 and says when a feature is lost. Equation numbers are those of docs/maths.md, section 5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from scipy import ndimage, special
from scipy.fft import next_fast_len

from adof_cl.device import Device, DeviceArray
from adof_cl.errors import InputError, TrackingError
from adof_cl.finite import checked_shape, finite_array
from adof_cl.optics import OpticalSystem, require_positive, require_whole
from adof_cl.ssd_search import LARGEST_LEVEL, SsdSearch

Array = NDArray[np.float64]

_CONTEXT = 8  # pixels around a patch: a spline's memory of its end fades as 0.27 a pixel
# What each step of the ladder leaves of its own, px^2: whole pixels spread evenly, the quadratic's pull.
_LEFT_PX2 = {"integer": 1 / 12, "quadratic": 0.03**2, "gauss_newton": 0.0}
_SIGMA_LIMITS_PX = (1e-9, 1e9)  # that a template can be asked for
_REACH_PX = 1.5  # a refinement that goes farther has left the match it started from
# White noise of variance 1 has a spline derivative of this variance: 9 (2/sqrt(3) - 1), eq. S11.
_DERIVATIVE_NOISE = 9 * (2 / math.sqrt(3) - 1)


@dataclass(frozen=True)
class Measurement:
    """Where one feature is in one frame.

    Attributes
    ----------
    feature_xy_px : (2,)
        Column and row of the feature; pixel centres at integers. The prediction, when lost.
    covariance : (2, 2)
        Of `feature_xy_px`, px^2 (eq. S10); infinite on the diagonal when lost.
    ssd
        The paper's score at the best whole-pixel place: squared differences with grey in [0, 1], summed over
        the template (eq. S12).
    mismatch
        What of the image under the template the template does not explain, 0 to 1 (eq. S5).
    gain
        The image's contrast over the template's.
    lost
        The measurement must not be used.
    reason
        Why it is lost; empty otherwise.
    """

    feature_xy_px: Array
    covariance: Array
    ssd: float
    mismatch: float
    gain: float
    lost: bool
    reason: str


@dataclass(frozen=True)
class TrackingLimits:
    """When a feature counts as lost.

    Attributes
    ----------
    mismatch
        Largest share of the image's variation left unexplained.
    sigma_px
        Largest standard deviation along the weakest direction.
    gain
        Smallest and largest contrast over the template's.
    displacement_px
        Largest distance from the prediction; None leaves it to the search window.
    """

    mismatch: float = 0.5
    sigma_px: float = 0.5
    gain: tuple[float, float] = (0.1, 10.0)
    displacement_px: float | None = None

    def __post_init__(self) -> None:
        require_positive(mismatch=self.mismatch, sigma_px=self.sigma_px)
        if len(self.gain) != 2:
            raise InputError(f"gain limits are {self.gain}: the smallest and the largest were wanted")
        require_positive(gain_min=self.gain[0], gain_max=self.gain[1])
        if self.gain[0] >= self.gain[1]:
            raise InputError(f"gain limits are {self.gain}: the smaller first was wanted")
        if self.displacement_px is not None:
            require_positive(displacement_px=self.displacement_px)


@dataclass(frozen=True)
class Template:
    """A small picture of a feature, and where in it the feature is. Make it with `Template.cut`.

    Attributes
    ----------
    pixels : (rows, columns) uint8, uint16 or float32
        As cut from the image.
    anchor_yx : (2,)
        The feature's place from the top-left pixel's centre, sub-pixel.
    gradient_yx : (2, rows, columns)
        Slopes of the interpolating cubic spline, grey levels a pixel.
    noise
        Standard deviation of the image noise, grey levels.
    hessian_yx : (2, 2)
        sum grad grad^T once gain and offset have taken their share and noise its own (eq. S11).
    sampling_yx : (2, 2)
        What of the place depends on where the pixels fell when this picture was taken, px^2 (eq. S16).
    """

    pixels: NDArray[Any]
    anchor_yx: Array
    gradient_yx: Array
    noise: float
    hessian_yx: Array
    sampling_yx: Array = field(default_factory=lambda: np.zeros((2, 2)))

    @property
    def sigma_px(self) -> float:
        """Predicted standard deviation of a measurement along the template's weak direction (eq. S10)."""
        return float(self.noise * math.sqrt(2 / np.linalg.eigvalsh(self.hessian_yx)[0]))

    @classmethod
    def cut(
        cls,
        image: NDArray[Any],
        feature_xy_px: ArrayLike,
        shape: tuple[int, int] = (20, 20),
        *,
        noise: float | None = None,
        sigma_limit_px: float = 0.1,
        optics: OpticalSystem | None = None,
    ) -> Template:
        """Cut a template around a feature of an image taken in focus.

        Parameters
        ----------
        image : (rows, columns) uint8, uint16 or float32
        feature_xy_px : (2,)
            Column and row of the feature, as precisely as it is known; it keeps its fraction.
        shape
            Rows and columns of the template; the feature lies in its middle to half a pixel.
        noise
            Standard deviation of the image noise in grey levels; None estimates it around the feature, where
            fine texture counts as noise.
        sigma_limit_px
            The template is refused when it cannot place a feature better than this along every direction.
        optics
            The camera's: how much detail finer than its pixels the picture holds. None: none, so that what
            sampling does to a place is not stated.

        Raises
        ------
        InputError
            Image, shape or place do not fit each other, or are not finite.
        TrackingError
            Too little texture, or only along one direction.

        Source
        ------
        docs/maths.md, eqs. S10, S11 and S16; the paper's section 3.3 (templates are taken in focus).
        """
        feature_yx = np.atleast_1d(np.asarray(feature_xy_px, dtype=np.float64))[::-1]
        if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16, np.float32):
            raise InputError(
                f"an image of {image.ndim} axes and type {image.dtype} came, (rows, columns) of uint8, "
                "uint16 or float32 was wanted: convert it first"
            )
        if feature_yx.shape != (2,) or not np.isfinite(feature_yx).all():
            raise InputError(
                f"feature_xy_px is {feature_yx[::-1].tolist()}: a finite column and row were wanted"
            )
        size = np.array(checked_shape("a template's shape", shape, 4))
        require_positive(sigma_limit_px=sigma_limit_px)
        if not _SIGMA_LIMITS_PX[0] <= sigma_limit_px <= _SIGMA_LIMITS_PX[1]:
            raise InputError(f"sigma_limit_px is {sigma_limit_px:g}: 1e-9 to 1e9 was wanted")
        corner = np.rint(feature_yx - (size - 1) / 2).astype(np.int64)
        if (corner < 0).any() or (corner + size > image.shape).any():
            raise InputError(
                f"a template of {tuple(shape)} around {tuple(feature_yx[::-1].tolist())} leaves the image "
                f"of {image.shape}: choose a feature farther inside or a smaller template"
            )
        low = np.maximum(corner - _CONTEXT, 0)
        high = np.minimum(corner + size + _CONTEXT, image.shape)
        around = image[low[0] : high[0], low[1] : high[1]].astype(np.float64)
        if not np.abs(around).max() <= LARGEST_LEVEL:  # NaN neither
            raise InputError(
                f"the image holds values that are not finite or beyond {LARGEST_LEVEL:g} around the feature: "
                "restore it anew"
            )
        if noise is None:
            noise = estimate_noise(around)
        if not 0 <= noise <= LARGEST_LEVEL:
            raise InputError(f"noise is {noise}: 0 to {LARGEST_LEVEL:g} grey levels were wanted")
        quantum = 1 / math.sqrt(12) if image.dtype != np.float32 else float(np.finfo(np.float32).eps)
        noise = max(noise, quantum)

        y, x = corner - low
        rows, columns = slice(y, y + shape[0]), slice(x, x + shape[1])
        gradient = np.stack([_spline_slope(around, axis)[rows, columns] for axis in (0, 1)])
        pixels = image[corner[0] : corner[0] + shape[0], corner[1] : corner[1] + shape[1]].copy()
        template = cls(
            pixels=pixels,
            anchor_yx=feature_yx - corner,
            gradient_yx=gradient,
            noise=noise,
            hessian_yx=_texture(gradient, pixels.astype(np.float64), noise),
        )
        template._require_texture(sigma_limit_px)
        if optics is None:
            return template
        grid = _grid(template.pixels.shape)
        detail = _power(pixels.astype(np.float64) - pixels.mean(), grid) * _folded(optics, grid)
        return replace(template, sampling_yx=_symmetric(_place_response(template) @ detail.ravel()))

    def _require_texture(self, sigma_limit_px: float) -> None:
        weakest, axes = np.linalg.eigh(self.hessian_yx)
        count = self.pixels.size
        # What noise alone feigns scatters by this much; five times it is texture.
        feigned = 5 * _DERIVATIVE_NOISE * self.noise**2 * math.sqrt(2 * count)
        wanted = max(2 * self.noise**2 / sigma_limit_px**2, feigned)
        if weakest[0] >= wanted:
            return
        if weakest[1] < wanted:
            raise TrackingError(
                f"the template has no texture above the noise of {self.noise:.3g} grey levels: choose a "
                "feature with contrast"
            )
        angle = math.degrees(math.atan2(axes[0, 0], axes[1, 0])) % 180
        raise TrackingError(
            f"the template shows an edge only and could slide along {angle:.0f} degrees from the x axis: "
            "choose a corner or a larger template"
        )

    def anchored(self, anchor_yx: ArrayLike) -> Template:
        """Return the same picture with the feature at another place in it, two finite numbers."""
        return replace(self, anchor_yx=finite_array("anchor_yx", anchor_yx, (2,)))


def extent_px(templates: Sequence[Template], corners_px: Array) -> float:
    """Return the side of the square about the features' middle that holds their templates' middles."""
    corners_px = finite_array("corners_px", corners_px, (len(templates), 2))
    middle = (corners_px.min(axis=0) + corners_px.max(axis=0)) / 2
    shape = np.array(templates[0].pixels.shape)
    offsets = [
        corner - middle + ((shape - 1) / 2 - template.anchor_yx)[::-1]
        for corner, template in zip(corners_px, templates, strict=False)
    ]
    return float(2 * np.abs(offsets).max())


def estimate_noise(image: NDArray[Any]) -> float:
    """Estimate the standard deviation of white noise, blind to planes and to edges along an axis.

    Source
    ------
    Immerkaer, Computer Vision and Image Understanding 64 (1996) 300, with the median in place of the mean.

    Raises
    ------
    InputError
        Smaller than 3 x 3, NaN or infinity.
    """
    if image.ndim != 2 or min(image.shape) < 3:
        raise InputError(f"an image of shape {image.shape} came: at least 3 x 3 pixels were wanted")
    if image.dtype.kind not in "fiu" or not np.isfinite(image).all():
        raise InputError("the image holds NaN, infinity or no numbers: replace those pixels first")
    second = np.diff(image.astype(np.float64), 2, axis=0)
    mixed = np.diff(second, 2, axis=1)
    # The mask's weights have squares that sum to 36; 0.6745 is the median of |N(0, 1)|.
    return float(np.median(np.abs(mixed))) / (6 * 0.6744897501960817)


def _spline_slope(values: Array, axis: int) -> Array:
    coefficients = ndimage.spline_filter1d(values, 3, axis, mode="mirror")
    padded = np.pad(coefficients, [(1, 1) if a == axis else (0, 0) for a in (0, 1)], mode="reflect")
    moved = np.moveaxis(padded, axis, 0)
    return np.moveaxis((moved[2:] - moved[:-2]) / 2, 0, axis)


def _texture(gradient_yx: Array, pixels: Array, noise: float) -> Array:
    slopes = _beside_gain_and_offset(gradient_yx.reshape(2, -1), pixels)
    return np.asarray(slopes @ slopes.T - pixels.size * _DERIVATIVE_NOISE * noise**2 * np.eye(2))


def _beside_gain_and_offset(slopes: Array, pixels: Array) -> Array:
    nuisance, _ = np.linalg.qr(_gain_and_offset(pixels))
    return np.asarray(slopes - (slopes @ nuisance) @ nuisance.T)


def _gain_and_offset(pixels: Array) -> Array:
    flat = pixels.ravel()
    return np.stack([flat - flat.mean(), np.ones_like(flat)], axis=1)


def _grid(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return a grid on which a patch's autocovariance does not wrap."""
    rows, columns = (int(next_fast_len(2 * n - 1, real=True)) for n in shape)
    return rows, columns


def _power(values: Array, size: tuple[int, int]) -> Array:
    """Return the periodogram of patches (..., rows, columns), whose mean over a whole grid is their power."""
    spectrum = np.fft.rfft2(values, size)
    return np.asarray((spectrum.real**2 + spectrum.imag**2) / (values.shape[-2] * values.shape[-1]))


def _whole(size: tuple[int, int]) -> Array:
    """Return how many frequencies of the whole grid each column of the half spectrum stands for."""
    twice = np.full(size[1] // 2 + 1, 2.0)
    twice[0] = 1.0
    if size[1] % 2 == 0:
        twice[-1] = 1.0
    return twice


def _place_response(template: Template) -> Array:
    """Return what noise of unit power at each frequency does to the place: yy, yx and xx, px^2 (eq. S10)."""
    pixels = template.pixels.astype(np.float64)
    size = _grid(pixels.shape)
    slopes = _beside_gain_and_offset(template.gradient_yx.reshape(2, -1), pixels)
    weights = np.linalg.solve(template.hessian_yx, slopes).reshape(2, *pixels.shape)
    y, x = np.fft.rfft2(weights, size) / math.sqrt(math.prod(size))
    response = np.stack([np.abs(y) ** 2, (y.conj() * x).real, np.abs(x) ** 2]) * _whole(size)
    return np.asarray(response.reshape(3, -1))


def _left_by_fit(model: Array, shape: tuple[int, int]) -> Array:
    """Return the share of white noise's power at each frequency that a fit of `model` leaves."""
    fitted, _ = np.linalg.qr(model)
    return np.asarray(1 - _power(fitted.T.reshape(-1, *shape), _grid(shape)).sum(axis=0))


def _symmetric(entries: Array) -> Array:
    """Return (..., 2, 2) of (..., 3): yy, yx, xx."""
    return np.asarray(entries[..., [[0, 1], [1, 2]]])


def _folded(optics: OpticalSystem, size: tuple[int, int]) -> Array:
    """Return, at each frequency, the power of finer detail that pixels fold there over its own (eq. S16).

    In focus, for a scene of edges, whose spectrum falls as 1/f.
    """

    def passed(cycles_a_pixel: Array) -> Array:
        u = optics.normalised_frequency(1 / optics.object_pitch_um) * cycles_a_pixel
        return np.asarray(np.maximum(1 - u / 2, 0) * np.abs(np.sinc(cycles_a_pixel)))

    def along(frequency: Array) -> Array:
        own = passed(frequency)
        seen = (frequency > 0) & (own > 0)
        ratio = passed(1 - frequency) * frequency / (1 - frequency)
        return np.asarray(np.divide(ratio, own, out=np.zeros_like(own), where=seen) ** 2)

    rows = along(np.asarray(np.abs(np.fft.fftfreq(size[0])), dtype=np.float64))
    columns = along(np.asarray(np.fft.rfftfreq(size[1]), dtype=np.float64))
    return np.asarray(rows[:, None] + columns)


def quadratic_minimum(neighbourhood: Array) -> Array:
    """Return where a quadratic surface through 3 x 3 scores is smallest, (..., 2) yx from the centre.

    Least squares over the nine scores (eq. S8), held to one pixel; zero where the scores are not finite or
    curve downwards.

    Parameters
    ----------
    neighbourhood : (..., 3, 3)
    """
    s = np.asarray(neighbourhood, dtype=np.float64)
    if s.shape[-2:] != (3, 3):
        raise InputError(f"neighbourhood is {s.shape}: (..., 3, 3) scores were wanted")
    finite = np.asarray(np.isfinite(s).all(axis=(-2, -1)))
    s = np.where(finite[..., None, None], s, 0.0)
    gy = (s[..., 2, :] - s[..., 0, :]).sum(-1) / 6
    gx = (s[..., :, 2] - s[..., :, 0]).sum(-1) / 6
    hyy = (s[..., 2, :] + s[..., 0, :] - 2 * s[..., 1, :]).sum(-1) / 3
    hxx = (s[..., :, 2] + s[..., :, 0] - 2 * s[..., :, 1]).sum(-1) / 3
    hxy = (s[..., 2, 2] + s[..., 0, 0] - s[..., 2, 0] - s[..., 0, 2]) / 4
    determinant = hyy * hxx - hxy * hxy
    convex = np.asarray(finite & (determinant > 0) & (hyy > 0))
    divisor = np.where(convex, determinant, 1.0)
    shift = np.stack([hxy * gx - hxx * gy, hxy * gy - hyy * gx], axis=-1) / divisor[..., None]
    return np.where(convex[..., None], np.clip(shift, -1, 1), 0.0)


@dataclass(frozen=True)
class Refinement:
    """How templates lie on their patches, (k,) each.

    Attributes
    ----------
    shift_yx : (k, 2)
        From the patch's whole-pixel place.
    covariance_yx : (k, 2, 2)
        Of `shift_yx` (eq. S10).
    gain, offset
        image = gain * template + offset.
    mismatch
        Share of the image's variation that this leaves unexplained.
    """

    shift_yx: Array
    covariance_yx: Array
    gain: Array
    offset: Array
    mismatch: Array


class GaussNewton:
    """Refine the places of k templates of one shape at once, with gain and offset (eq. S9).

    Host, float64, cubic spline; everything that depends on the templates alone is solved beforehand.
    """

    def __init__(self, templates: Sequence[Template]) -> None:
        self.shape: tuple[int, int] = templates[0].pixels.shape
        self._inverses = [_spline_inverse(n + 2 * _CONTEXT) for n in self.shape]
        count = len(templates)
        taps = self.shape[0] * self.shape[1]
        self._model = np.empty((count, taps, 4))
        self._solve = np.empty((count, 4, taps))
        self._grid = _grid(self.shape)
        self._response = np.empty((count, 3, self._grid[0] * (self._grid[1] // 2 + 1)))
        self._sampling = np.empty((count, 2, 2))
        self._means = np.empty(count)
        for index, template in enumerate(templates):
            self.replace(index, template)

    def replace(self, index: int, template: Template) -> None:
        """Put another template of the same shape in place of number `index`."""
        values = template.pixels.astype(np.float64)
        slopes = template.gradient_yx.reshape(2, -1).T
        model = np.concatenate([slopes, _gain_and_offset(values)], axis=1)
        normal = model.T @ model
        self._model[index] = model
        self._solve[index] = np.linalg.solve(normal, model.T)
        response = _place_response(template)
        # What the fit took from the residual it took where it is sensitive: this much more was there.
        left = _left_by_fit(model, self.shape).ravel()
        along = response[0] + response[2]
        self._response[index] = response * float(along.sum() / (along @ left))
        self._sampling[index] = 2 * template.sampling_yx  # the template's own, and the frame's
        self._means[index] = values.mean()

    def __call__(self, patches: NDArray[Any], start_yx: Array, iterations: int = 20) -> Refinement:
        """Refine from `start_yx` (k, 2); `iterations` 0 only judges the start.

        Parameters
        ----------
        patches : (k, rows + 16, columns + 16)
            The image under each template at its whole-pixel place, and 8 pixels around.

        Raises
        ------
        InputError
            Other shapes, not finite, or a start farther than 1.5 px.
        """
        wanted = (len(self._means), *(n + 2 * _CONTEXT for n in self.shape))
        if patches.shape != wanted or patches.dtype.kind not in "fiu" or not math.isfinite(patches.sum()):
            raise InputError(f"patches are {patches.shape}: finite levels of shape {wanted} were wanted")
        if start_yx.shape != (wanted[0], 2) or start_yx.dtype.kind not in "fiu":
            raise InputError(f"start_yx is {start_yx.shape} {start_yx.dtype}: {(wanted[0], 2)} was wanted")
        if not -_REACH_PX <= start_yx.min() <= start_yx.max() <= _REACH_PX:
            raise InputError(f"start_yx is {start_yx.tolist()}: at most {_REACH_PX} px either way was wanted")
        require_whole(0, iterations=iterations)
        return self.refined(patches, start_yx, iterations)

    def refined(self, patches: NDArray[Any], start_yx: Array, iterations: int) -> Refinement:
        """Refine as the call does, unchecked: for patches and starts that are known to fit."""
        coefficients = self._inverses[0] @ patches.astype(np.float64) @ self._inverses[1].T
        shift = start_yx.astype(np.float64)
        image, fit = self._fit(coefficients, shift)
        for _ in range(iterations):
            gain = fit[:, 2:3]
            step = fit[:, :2] / np.where(np.abs(gain) > 1e-3, gain, 1e-3)
            shift = np.clip(shift - np.clip(step, -1, 1), -_REACH_PX, _REACH_PX)
            image, fit = self._fit(coefficients, shift)
            if np.abs(step).max() < 1e-4:
                break

        gain, offset = fit[:, 2], fit[:, 3] - fit[:, 2] * self._means
        # What the slopes fit is the last step's rest and its noise; gain and offset alone explain the image.
        unexplained = image - (self._model @ fit[:, :, None])[:, :, 0]
        power = _power(unexplained.reshape(-1, *self.shape), self._grid).reshape(len(shift), -1, 1)
        spread = _symmetric((self._response @ power)[:, :, 0]) / np.maximum(gain**2, 1e-12)[:, None, None]
        plain = image - (self._model[:, :, 2:] @ fit[:, 2:, None])[:, :, 0]
        varied = ((image - image.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
        mismatch = np.where(varied > 0, (plain**2).sum(axis=1) / np.where(varied > 0, varied, 1), 1.0)
        return Refinement(
            shift_yx=shift,
            covariance_yx=spread + self._sampling,
            gain=gain,
            offset=offset,
            mismatch=np.where(gain > 0, np.minimum(mismatch, 1.0), 1.0),
        )

    def _fit(self, coefficients: Array, shift: Array) -> tuple[Array, Array]:
        whole = np.floor(shift)
        weights = _spline_weights(shift - whole)
        rises = whole.astype(np.int64) + (_CONTEXT - 1)
        along = [_spline_rows(weights[:, a], rises[:, a], n) for a, n in enumerate(self.shape)]
        image = (along[0] @ coefficients @ along[1].transpose(0, 2, 1)).reshape(len(shift), -1)
        return image, (self._solve @ image[:, :, None])[:, :, 0]


def _spline_inverse(n: int) -> Array:
    """Return the matrix from samples to cubic B-spline coefficients, mirrored ends."""
    matrix = np.diag(np.full(n, 4.0)) + np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)
    matrix[0, 1] = matrix[-1, -2] = 2
    return np.asarray(np.linalg.inv(matrix / 6))


# Rows: powers 0 to 3 of the fraction; columns: the four cubic B-splines that reach it.
_BASIS = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6


def _spline_weights(fraction: Array) -> Array:
    """Return the four cubic B-spline weights at a fraction of a pixel, (..., 4)."""
    return np.asarray(fraction[..., None] ** np.arange(4) @ _BASIS)


def _spline_rows(weights: Array, rises: NDArray[np.int64], n: int) -> Array:
    """Return the (k, n, n + 16) matrices whose row r holds its four weights from column r + rise on."""
    count, width = len(weights), n + 2 * _CONTEXT
    line = np.zeros((count, n + width))
    line[np.arange(count)[:, None], n + rises[:, None] + np.arange(4)] = weights
    step = line.strides[1]
    # Row r is the same line, r columns later: a view, not a copy.
    return np.lib.stride_tricks.as_strided(
        line[:, n:], (count, n, width), (line.strides[0], -step, step), writeable=False
    )


class TemplateTracker:
    """Follow k features through frames that lie on the device.

    Built once: compiles and allocates. Each frame: `aim` places the windows, `enqueue` searches without
    waiting, `collect` waits for this search alone and refines; `track` does all three.

    Parameters
    ----------
    device
        The opened device.
    image_shape
        (rows, columns) of every frame.
    templates
        One for each feature, of one shape and type; frames have the same type.
    search_shape
        (rows, columns) of the window each template is searched in.
    score
        "gain_offset" is unmoved by brightness and contrast; "ssd" is the paper's.
    refine
        "gauss_newton", "quadratic" or "integer": from the most precise to the fastest.
    limits
        When a feature is lost.
    full_scale
        The grey level that counts as 1 in `Measurement.ssd`; None: 255, 65535, or 1 for float32.

    Raises
    ------
    InputError
        Templates of several shapes or types, none at all, or sizes that do not nest.
    """

    def __init__(
        self,
        device: Device,
        image_shape: tuple[int, int],
        templates: Sequence[Template],
        search_shape: tuple[int, int] = (64, 64),
        *,
        score: str = "gain_offset",
        refine: str = "gauss_newton",
        limits: TrackingLimits | None = None,
        full_scale: float | None = None,
    ) -> None:
        if not templates:
            raise InputError("no template came: give at least one")
        kinds = {(t.pixels.shape, t.pixels.dtype.name) for t in templates}
        if len(kinds) > 1:
            raise InputError(f"templates of several kinds came, {sorted(kinds)}: cut all alike")
        self.templates = list(templates)
        self.refine = checked_refine(refine)
        self.limits = limits or TrackingLimits()
        self.dtype = templates[0].pixels.dtype
        self.full_scale = _full_scale(self.dtype) if full_scale is None else full_scale
        require_positive(full_scale=self.full_scale)
        self.search = SsdSearch(
            device,
            image_shape,
            templates[0].pixels.shape,
            search_shape,
            len(templates),
            dtype=self.dtype,
            score=score,
            patch_margin=_CONTEXT,
        )
        self.search.set_templates(np.stack([t.pixels for t in templates]))
        self._refiner = GaussNewton(templates)
        self._anchors = np.stack([t.anchor_yx for t in templates])
        self._pixels = np.stack([t.pixels for t in templates]).astype(np.float64)
        self._last = np.zeros((len(templates), 2))
        self._seen = np.zeros(len(templates), np.bool_)
        self._placed = False
        self._step = np.zeros((len(templates), 2))
        self._aimed = np.zeros((len(templates), 2))

    def replace(self, index: int, template: Template) -> None:
        """Follow another template of the same shape and type in place of number `index`."""
        self.search.set_template(index, template.pixels)
        self.templates[index] = template
        self._refiner.replace(index, template)
        self._anchors[index] = template.anchor_yx
        self._pixels[index] = template.pixels

    def aim(self, feature_xy_px: ArrayLike | None = None, *, displacement_xy_px: ArrayLike = (0, 0)) -> None:
        """Centre the windows where the features are expected; one that would leave the image moves inside.

        Parameters
        ----------
        feature_xy_px : (k, 2)
            Expected places. None: the last measured ones, carried on by their last displacement.
        displacement_xy_px : (2,) or (k, 2)
            Motion known from elsewhere, such as the stage's, added to either.

        Raises
        ------
        TrackingError
            No place was ever given or measured.
        InputError
            Another shape, or values that are not finite.
        """
        if feature_xy_px is not None:
            places = self.checked_places(feature_xy_px)
            self._last, self._placed = places, True
            self._step[:] = 0
            self._seen[:] = False
        elif not self._placed:
            raise TrackingError(
                "the tracker has no place to start from: give feature_xy_px at the first frame"
            )
        else:
            places = self._last + self._step
        moved = np.asarray(displacement_xy_px, dtype=np.float64)
        if moved.shape not in ((2,), self._aimed.shape) or not np.isfinite(moved).all():
            raise InputError(
                f"displacement_xy_px of shape {moved.shape} came: (2,) or {self._aimed.shape} finite "
                "pixels were wanted"
            )
        self._aimed = places + moved
        slack = np.subtract(self.search.search_shape, self.search.template_shape) / 2
        edge = float(max(self.search.image_shape)) * 2
        corner = np.rint(np.clip(self._aimed[:, ::-1], -edge, edge) - self._anchors - slack).astype(np.int64)
        self.search.set_windows(corner, clamp=True)

    def checked_places(self, feature_xy_px: ArrayLike) -> Array:
        """Return a copy of expected places, (k, 2); InputError for another shape or what is not finite."""
        places = np.array(feature_xy_px, dtype=np.float64)
        if places.shape != self._aimed.shape or not np.isfinite(places).all():
            raise InputError(
                f"feature_xy_px of shape {places.shape} came: {self._aimed.shape} finite pixels were wanted"
            )
        return places

    def enqueue(self, image: DeviceArray) -> None:
        """Search one frame; does not wait."""
        self.search(image)

    @property
    def ready(self) -> bool:
        """Whether `collect` would not have to wait."""
        return self.search.found

    def collect(self) -> list[Measurement]:
        """Wait for the frame's search and return one measurement for each template."""
        found = self.search.fetch()
        assert found.patches is not None
        start = np.zeros((len(self.templates), 2))
        if self.refine != "integer":
            start = quadratic_minimum(found.neighbourhood)
        patches = np.where(np.isfinite(found.patches), found.patches, 0.0)
        refined = self._refiner.refined(patches, start, 20 if self.refine == "gauss_newton" else 0)
        inner = patches[:, _CONTEXT:-_CONTEXT, _CONTEXT:-_CONTEXT]
        ssd = ((inner - self._pixels) ** 2).sum(axis=(1, 2)) / self.full_scale**2
        feature_yx = found.best_yx + self._anchors + refined.shift_yx

        measured: list[Measurement] = []
        for k in range(len(self.templates)):
            xy = feature_yx[k, ::-1].copy()
            covariance = refined.covariance_yx[k, ::-1, ::-1] + _LEFT_PX2[self.refine] * np.eye(2)
            reason = self._why_lost(refined, k, xy, covariance, found.neighbourhood[k])
            if reason:
                xy = self._aimed[k].copy()
                covariance = np.diag([np.inf, np.inf])
            measured.append(
                Measurement(
                    feature_xy_px=xy,
                    covariance=covariance,
                    ssd=float(ssd[k]),
                    mismatch=float(refined.mismatch[k]),
                    gain=float(refined.gain[k]),
                    lost=bool(reason),
                    reason=reason,
                )
            )
        self._remember(measured)
        return measured

    def _remember(self, measured: Sequence[Measurement]) -> None:
        """Keep places and last displacements; a lost feature waits where it was last expected."""
        for k, measurement in enumerate(measured):
            self._step[k] = (
                0 if measurement.lost or not self._seen[k] else (measurement.feature_xy_px - self._last[k])
            )
            self._last[k] = measurement.feature_xy_px
            self._seen[k] = not measurement.lost

    def track(
        self,
        image: DeviceArray,
        feature_xy_px: ArrayLike | None = None,
        *,
        displacement_xy_px: ArrayLike = (0, 0),
    ) -> list[Measurement]:
        """Aim, search one frame and return its measurements."""
        self.aim(feature_xy_px, displacement_xy_px=displacement_xy_px)
        self.enqueue(image)
        return self.collect()

    def _why_lost(
        self, refined: Refinement, k: int, xy: Array, covariance: Array, neighbourhood: Array
    ) -> str:
        limits = self.limits
        if not np.isfinite(neighbourhood[1, 1]):
            return "the image is not finite under the window"
        if not np.isfinite(neighbourhood).all():
            return "the best match lies at the edge of its search window"
        if np.abs(refined.shift_yx[k]).max() >= _REACH_PX:
            return "the sub-pixel fit left the best match"
        if refined.mismatch[k] > limits.mismatch:
            return f"the image does not look like the template: mismatch {refined.mismatch[k]:.2f}"
        if not limits.gain[0] <= refined.gain[k] <= limits.gain[1]:
            return f"contrast is {refined.gain[k]:.2g} of the template's"
        sigma = math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
        if sigma > limits.sigma_px:
            return f"the place is uncertain by {sigma:.2g} px"
        distance = float(np.hypot(*(xy - self._aimed[k])))
        if limits.displacement_px is not None and distance > limits.displacement_px:
            return f"it moved {distance:.1f} px from where it was expected"
        return ""


def checked_refine(refine: str) -> str:
    """Return `refine`; InputError unless it is "gauss_newton", "quadratic" or "integer"."""
    if refine not in _LEFT_PX2:
        raise InputError(f"refine is '{refine}': choose 'gauss_newton', 'quadratic' or 'integer'")
    return refine


def _full_scale(dtype: DTypeLike) -> float:
    kind = np.dtype(dtype)
    return 1.0 if kind == np.float32 else float(np.iinfo(kind).max)


@dataclass(frozen=True)
class Corner:
    """Where two straight edges meet.

    Attributes
    ----------
    xy_px : (2,)
        Column and row; pixel centres at integers.
    covariance : (2, 2)
        Of `xy_px`, px^2.
    edges_rad : (2,)
        Angle of each edge from the x axis, towards y: the one nearer the rows, the one nearer the columns.
    """

    xy_px: Array
    covariance: Array
    edges_rad: Array


@dataclass(frozen=True)
class _Edge:
    """across = offset + slope * along, from the guess; covariance of (offset, slope)."""

    offset: float
    slope: float
    blur: float
    covariance: Array


_STEEPEST = math.tan(math.radians(15))
_STRIP_PX = 2.5  # half width of the strip an edge is fitted in: the step and no more
_LONGEST_ARM_PX = 1e4
_STRETCH_PX = 4  # of the edge share one pair of grey levels


def locate_corner(
    image: NDArray[Any],
    guess_xy_px: ArrayLike,
    *,
    reach_px: float = 4.0,
    arm_px: float = 30.0,
    sigma_limit_px: float = 0.1,
) -> Corner:
    """Locate the corner of a part, to a few hundredths of a pixel, in an image taken in focus.

    An edge near the rows and one near the columns are found on whichever side of the guess they run, each is
    fitted as a blurred step in a strip of pixels along it, robustly, and the two lines are intersected.

    Parameters
    ----------
    image : (rows, columns)
        In focus; any real type.
    guess_xy_px : (2,)
        Column and row of the corner.
    reach_px
        How far the guess may be off along either axis.
    arm_px
        Length of each edge to use; the part's edges must be at least this long.
    sigma_limit_px
        The corner is refused when its standard deviation exceeds this.

    Raises
    ------
    InputError
        The image has another shape, or is not finite, or the guess is too near its border.
    TrackingError
        No corner: no edge, an edge that runs on through the guess, or one too uncertain.

    Source
    ------
    docs/maths.md, eq. S13.
    """
    if image.ndim != 2:
        raise InputError(f"an image of {image.ndim} axes came: (rows, columns) was wanted")
    require_positive(reach_px=reach_px, arm_px=arm_px, sigma_limit_px=sigma_limit_px)
    if max(reach_px, arm_px) > _LONGEST_ARM_PX:
        raise InputError(
            f"reach_px is {reach_px:g}, arm_px {arm_px:g}: at most {_LONGEST_ARM_PX:g} was wanted"
        )
    guess = np.asarray(guess_xy_px, dtype=np.float64)
    if guess.shape != (2,) or not np.isfinite(guess).all():
        raise InputError(f"guess_xy_px is {guess.tolist()}: a finite column and row were wanted")
    reach = math.ceil(reach_px + arm_px * (1 + _STEEPEST) + _STRIP_PX)
    origin = np.rint(guess).astype(np.int64)
    low = np.maximum(origin - reach, 0)
    values = image[low[1] : max(origin[1] + reach + 1, 0), low[0] : max(origin[0] + reach + 1, 0)]
    if min(values.shape) < 10:
        raise InputError(
            f"the guess {guess.tolist()} lies at the border of an image of {image.shape}: choose a corner "
            "inside"
        )
    values = values.astype(np.float64)
    if not np.isfinite(values).all():
        raise InputError("the image holds values that are not finite around the guess: restore it anew")

    x, y = guess - low
    row_side, row_slope, row_offset = _find_edge(values, x, y, reach_px, arm_px)
    column_side, column_slope, column_offset = _find_edge(values.T, y, x, reach_px, arm_px)
    along_rows = _Edge(row_offset, row_slope, 0.5, np.zeros((2, 2)))
    along_columns = _Edge(column_offset, column_slope, 0.5, np.zeros((2, 2)))
    for _ in range(2):  # where each edge begins depends on where the other is
        (dx, dy), _ = _meet(along_rows, along_columns)
        blur = max(along_rows.blur, along_columns.blur)
        skip = 1.5 + 2 * blur + _STRIP_PX * max(abs(along_rows.slope), abs(along_columns.slope))
        along_rows, along_columns = (
            _fit_edge(values, x, y, along_rows, row_side, row_side * dx + skip, arm_px),
            _fit_edge(values.T, y, x, along_columns, column_side, column_side * dy + skip, arm_px),
        )
    (dx, dy), covariance = _meet(along_rows, along_columns)
    sigma = math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))
    if sigma > sigma_limit_px or max(abs(dx), abs(dy)) > reach_px + 1:
        raise TrackingError(
            f"no corner lies within {reach_px:g} px of {guess.tolist()}: its place came out {dx:+.1f}, "
            f"{dy:+.1f} px off and uncertain by {sigma:.2g} px, so give a nearer guess or a sharper image"
        )
    return Corner(
        xy_px=guess + np.array([dx, dy]),
        covariance=covariance,
        edges_rad=np.array([math.atan(along_rows.slope), math.pi / 2 - math.atan(along_columns.slope)]),
    )


def _find_edge(
    values: Array, along: float, across: float, reach: float, arm: float
) -> tuple[int, float, float]:
    """Find the straight edge along axis 1 that is strongest on one side: (side, slope, offset)."""
    rise = ndimage.gaussian_filter(values, (1.5, 1.0), order=(1, 0))
    slopes = np.linspace(-_STEEPEST, _STEEPEST, 31)
    offsets = np.arange(-reach, reach + 0.25, 0.5)
    found: list[tuple[float, int, float, float, float]] = []
    for side in (1, -1):
        t = side * np.arange(reach + 2, max(arm, reach + 10))
        t = t[(along + t >= 1) & (along + t <= values.shape[1] - 2)]
        if t.size < 8:
            continue

        def strength(t: Array) -> Array:
            rows = across + offsets[None, :, None] + slopes[:, None, None] * t
            columns = np.broadcast_to(along + t, rows.shape)
            grey = ndimage.map_coordinates(rise, [rows, columns], order=1, mode="nearest")
            return np.asarray(grey.mean(axis=-1), dtype=np.float64)

        here = strength(t)
        i, j = np.unravel_index(int(np.abs(here).argmax()), here.shape)
        beyond = float(strength(-t)[i, j])  # the same line on the other side
        found.append((float(abs(here[i, j])), side, slopes[i], offsets[j], beyond * np.sign(here[i, j])))
    if not found:
        raise TrackingError("the image ends too near the guess on both sides: choose a corner farther inside")
    best, side, slope, offset, beyond = max(found)
    if best <= 0 or beyond > 0.5 * best:
        raise TrackingError(
            "no corner is there: an edge runs straight through the guess, so choose the end of an edge"
            if best > 0
            else "no corner is there: the image is flat around the guess, so choose a place with contrast"
        )
    return side, float(slope), float(offset)


def _fit_edge(
    values: Array, along: float, across: float, edge: _Edge, side: int, start: float, arm: float
) -> _Edge:
    """Fit a blurred step to the pixels along an edge: Gauss-Newton with Huber's weights."""
    columns = np.arange(values.shape[1])
    t = columns - along
    columns = columns[(side * t >= start) & (side * t <= start + arm)]
    rows = np.arange(values.shape[0])[:, None]
    t = np.broadcast_to(columns - along, (values.shape[0], columns.size))
    distance = rows - across - edge.offset - edge.slope * t
    strip = np.abs(distance) <= _STRIP_PX
    t, d, grey = t[strip], (rows - across + 0 * t)[strip], values[:, columns][strip]
    if np.unique(t).size < 8:
        raise TrackingError(
            "the image ends too near the guess: choose a corner farther inside or shorter arms"
        )

    # Levels are free every few columns: texture that brightens a stretch of the edge must not bend it.
    stretch = np.asarray((side * t - start) // _STRETCH_PX, dtype=np.int64)
    stretch = np.minimum(stretch, max(int(side * t[-1] - start + 1) // _STRETCH_PX - 1, 0))
    count = int(stretch.max()) + 1
    member = np.eye(count)[stretch]
    p = np.array([edge.offset, edge.slope, edge.blur])
    most = np.array([1, 0.1, 0.5])
    weights = np.ones_like(grey)
    for _ in range(25):
        # A blurred step averaged over a pixel, its slope across and by the blur.
        middle = d - p[0] - p[1] * t
        above, under = (middle + 0.5) / p[2], (middle - 0.5) / p[2]
        cover = special.ndtr(above) - special.ndtr(under)
        bells = (np.exp(-above * above / 2) - np.exp(-under * under / 2)) / math.sqrt(2 * math.pi)
        shape = p[2] * bells + (middle + 0.5) * special.ndtr(above) - (middle - 0.5) * special.ndtr(under)
        levels = np.concatenate([member * (1 - shape)[:, None], member * shape[:, None]], axis=1)
        weighted = levels * weights[:, None]
        fitted = np.linalg.solve(weighted.T @ levels + 1e-9 * np.eye(2 * count), weighted.T @ grey)
        contrast = (fitted[count:] - fitted[:count])[stretch]
        left = grey - levels @ fitted
        slopes = np.stack([-cover, -cover * t, bells], axis=1) * contrast[:, None]
        slopes -= levels @ np.linalg.solve(
            weighted.T @ levels + 1e-9 * np.eye(2 * count), weighted.T @ slopes
        )
        scale = 1.4826 * float(np.median(np.abs(left))) + 1e-12
        weights = np.minimum(1, 1.5 * scale / np.maximum(np.abs(left), 1e-300))
        normal = (slopes * weights[:, None]).T @ slopes + 1e-12 * np.eye(3)
        step = np.linalg.solve(normal, slopes.T @ (weights * left))
        p = p + np.clip(step, -most, most)
        p[2] = min(max(p[2], 0.1), _STRIP_PX / 2)
        if abs(step[0]) < 1e-4 and abs(step[1]) < 1e-5:
            break
    variance = float((weights * left * left).sum() / max(weights.sum() - 3 - 2 * count, 1))
    # Texture is alike in neighbouring columns; what their scores share makes them worth less.
    order = np.unique(t, return_inverse=True)[1]
    scores = np.bincount(order, slopes[:, 0] * weights * left)
    power = max(float(scores @ scores), 1e-300)
    shared = sum(float(scores[lag:] @ scores[:-lag]) for lag in (1, 2, 3)) / power
    inflation = min(max(1 + 2 * shared, 1.0), 6.0)
    covariance = np.linalg.pinv(normal)[:2, :2] * variance * inflation
    rise = float(np.median(np.abs(fitted[count:] - fitted[:count])))
    if not np.isfinite(p).all() or rise < 3 * math.sqrt(variance):
        raise TrackingError(
            f"no corner is there: an edge of {rise:.3g} grey levels does not rise above "
            f"{math.sqrt(variance):.3g} of noise and texture, so choose a place with contrast"
        )
    return _Edge(float(p[0]), float(p[1]), float(p[2]), covariance)


def _meet(along_rows: _Edge, along_columns: _Edge) -> tuple[tuple[float, float], Array]:
    """Intersect y = a + b x with x = c + d y; return (x, y) and its covariance."""
    a, b = along_rows.offset, along_rows.slope
    c, d = along_columns.offset, along_columns.slope
    divisor = 1 - b * d
    x, y = (c + d * a) / divisor, (a + b * c) / divisor
    by_rows = np.array([[d, d * x], [1, x]]) / divisor
    by_columns = np.array([[1, y], [b, b * y]]) / divisor
    covariance = by_rows @ along_rows.covariance @ by_rows.T
    return (x, y), covariance + by_columns @ along_columns.covariance @ by_columns.T
