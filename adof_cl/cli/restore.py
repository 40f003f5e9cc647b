"""`adof restore`: undo the blur of a mask and a depth, or of a measured point-spread function."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from adof_cl.cli.devices import DeviceOption

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from adof_cl.device import Device
    from adof_cl.image_files import Image, ImageStack
    from adof_cl.optics import Mask, OpticalSystem
    from adof_cl.restoration_quality import RestorationQuality
    from adof_cl.restore import Restore

_OUTLIER_SIGMAS = 10
_OUTLIER_SHARE = 0.25
_WIDE_PX = 25
_OFFSET_PERCENTILE = 0.1


def restore(
    source: Annotated[Path, typer.Argument(metavar="IN", help="PNG or TIFF, 8 or 16 bit, grey or colour.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="PNG or TIFF, of the same depth.")],
    alpha: Annotated[float | None, typer.Option("--alpha", help="Cubic phase of the mask, rad.")] = None,
    depth_um: Annotated[
        float | None, typer.Option("--depth-um", help="Depth of the object beyond the plane in focus.")
    ] = None,
    focus_um: Annotated[float, typer.Option("--focus-um", help="Depth the modulator focuses on.")] = 0.0,
    psf: Annotated[
        Path | None,
        typer.Option("--psf", metavar="FILE", help="Measured PSF, its centre at the array's centre."),
    ] = None,
    nsr: Annotated[
        str, typer.Option("--nsr", metavar="K|auto", help="Noise-to-signal power, or fitted to the image.")
    ] = "auto",
    offset: Annotated[
        str | None,
        typer.Option(
            "--offset",
            metavar="L|auto",
            help="Level the sensor gives in the dark, subtracted first; auto: the lowest thousandth of the "
            "pixels, of image and PSF each. Default: auto with --psf, else 0.",
        ),
    ] = None,
    white: Annotated[
        float | None,
        typer.Option(
            "--white",
            metavar="P",
            help="Percentile of the first restored page to write as the largest code, 0 as black; 0 keeps "
            "the image's own scale. Default: 99.9 with --psf, else 0.",
        ),
    ] = None,
    aperture_um: Annotated[float, typer.Option("--aperture-um", help="Width of the stop.")] = 10_000.0,
    f_number: Annotated[float, typer.Option("--f-number", help="Working f-number, object side.")] = 6.5,
    wavelength_um: Annotated[float, typer.Option("--wavelength-um", help="Wavelength.")] = 0.55,
    pixel_um: Annotated[float, typer.Option("--pixel-um", help="Camera pixel pitch.")] = 7.4,
    precision: Annotated[str, typer.Option("--precision", help="float32 or float64.")] = "float32",
    device: DeviceOption = None,
) -> None:
    """Restore an image or a stack, page by page, each colour by itself.

    The blur is given by the mask and the object's depth (--alpha and --depth-um), or measured (--psf). A PSF
    is normalised to unit sum; with it the image is padded to double size, and if the PSF covers more than 25
    pixels, single pixels that no such blur can leave, a quarter and 10 sigma away from their 5 x 5 median,
    are replaced by it. Values beyond the file's range are clipped.

    Example: adof restore raw.tif hand.tif --psf psf.tif
    """
    import time
    from itertools import islice

    import numpy as np
    from rich.console import Console
    from rich.progress import Progress

    from adof_cl.device import Device
    from adof_cl.errors import InputError
    from adof_cl.image_files import open_writer, read_stack
    from adof_cl.optics import Mask, OpticalSystem
    from adof_cl.stream import RestoredFrames, Stream

    if (psf is None) == (alpha is None):
        raise InputError("the blur is unknown: give either --alpha and --depth-um, or --psf")
    if alpha is not None and depth_um is None:
        raise InputError("--alpha came without --depth-um: give the object's depth, 0 for the plane in focus")
    if psf is not None and depth_um is not None:
        raise InputError("--psf came with --depth-um: a measured blur has no depth, leave it out")
    level = _number("--offset", offset) if offset is not None else (None if psf is not None else 0.0)
    percentile = white if white is not None else (99.9 if psf is not None else 0.0)
    if not 0 <= percentile <= 100:
        raise InputError(f"--white is {percentile:g}: a percentile from 0 to 100 was wanted")
    noise = _number("--nsr", nsr)
    if noise is not None and noise < 0:
        raise InputError(f"--nsr is {noise:g}: a noise-to-signal power of 0 or more was wanted")

    stack = read_stack(source)
    started = time.perf_counter()
    with (
        open_writer(target, stack.pages) as writer,
        Progress(console=Console(stderr=True), transient=True) as progress,
    ):
        task = progress.add_task("compiling kernels", total=stack.pages)
        opened = Device.open(device)
        if psf is not None:
            job = _measured(opened, stack, psf, level, noise, precision)
        else:
            assert alpha is not None
            assert depth_um is not None
            optics = OpticalSystem(wavelength_um, aperture_um, f_number, pixel_pitch_um=pixel_um)
            mask = Mask(alpha_rad=alpha, focus_psi_rad=0.0 - optics.psi_rad(focus_um))
            job = _computed(opened, stack, optics, mask, depth_um, level, noise, precision)
        progress.update(task, description="restoring")
        scale = 0.0
        # The next page is read, and the one before written, while the device restores.
        planes = Stream(RestoredFrames(job.plan)).run(job.planes(stack))
        colours = 1 if len(stack.shape) == 2 else stack.shape[2]
        while page := [result.values[0] for result in islice(planes, colours)]:
            restored = page[0] if len(stack.shape) == 2 else np.stack(page, axis=-1)
            if not scale:
                top = float(np.percentile(restored, percentile)) if percentile else 0.0
                scale = np.iinfo(stack.dtype).max / top if top > 0 else 1.0
            writer.append(_codes(restored * scale, stack.dtype))
            progress.advance(task)
    print(
        f"{target}: {stack.pages} page{'s' * (stack.pages > 1)} of {stack.shape[0]} x {stack.shape[1]} "
        f"{stack.dtype}, padded to {job.plan.padded_shape[0]} x {job.plan.padded_shape[1]}, nsr {job.noise}, "
        f"{job.promise()}, {time.perf_counter() - started:.1f} s on {opened.facts}"
    )


@dataclass(frozen=True)
class _Job:
    """A plan with its filter set, and what is done to a page before it is restored."""

    plan: Restore
    offset: float
    repair: bool
    noise: str
    quality: RestorationQuality
    object_pitch_um: float | None = None

    def promise(self) -> str:
        """Say how loud noise and how fine detail will be."""
        periods = self.quality.half_contrast_period_xy_px
        detail = f"half contrast at lines of {periods.max():.1f} px"
        if self.object_pitch_um is not None:
            detail += f" ({self.quality.half_contrast_period_um(self.object_pitch_um):.1f} µm)"
        return f"noise x {self.quality.noise_gain:.2f}, {detail}"

    def planes(self, stack: ImageStack) -> Iterator[NDArray[np.float32]]:
        for page in stack:
            values = _light(page, self.offset, self.repair)
            yield from [values] if values.ndim == 2 else [values[..., c] for c in range(values.shape[2])]


def _measured(
    device: Device, stack: ImageStack, psf_file: Path, level: float | None, nsr: float | None, precision: str
) -> _Job:
    import numpy as np

    from adof_cl.errors import InputError
    from adof_cl.image_files import read_image
    from adof_cl.restoration_quality import restoration_quality
    from adof_cl.restore import Restore
    from adof_cl.wiener import WienerFilter, psf_otf

    measured = read_image(psf_file)
    if measured.ndim != 2:
        raise InputError(f"{psf_file} is {measured.shape}: a grey PSF was wanted")
    rows, columns = stack.shape[:2]
    if measured.shape[0] > rows or measured.shape[1] > columns:
        raise InputError(
            f"{psf_file} is {measured.shape[0]} x {measured.shape[1]}, the image only {rows} x {columns}: "
            "crop the PSF"
        )
    first = next(iter(stack))
    dark = _dark_level(first) if level is None else level
    light = np.maximum(_light(measured, _dark_level(measured) if level is None else level, repair=False), 0)
    plan = Restore(device, (rows, columns), precision=precision, padding=(rows, columns))
    otf = psf_otf(light, plan.padded_shape)
    wide = float(light.sum(dtype=np.float64)) ** 2 > _WIDE_PX * float((light.astype(np.float64) ** 2).sum())
    ratio = _ratio(nsr, _light(first, dark, wide), otf, plan.padded_shape)
    wiener = WienerFilter(device, plan.padded_shape, precision=precision)
    plan.set_filter(wiener.from_otf(otf, ratio))
    quality = restoration_quality(otf, ratio, plan.padded_shape)
    return _Job(plan, dark, wide, _described(ratio), quality)


def _computed(
    device: Device,
    stack: ImageStack,
    optics: OpticalSystem,
    mask: Mask,
    depth_um: float,
    level: float | None,
    nsr: float | None,
    precision: str,
) -> _Job:
    import math

    import numpy as np

    from adof_cl.optics import require_finite
    from adof_cl.otf import Otf1d
    from adof_cl.restoration_quality import restoration_quality
    from adof_cl.restore import Restore

    require_finite(depth_um=depth_um)
    psi = mask.psi_rad(optics, depth_um)
    padding = 16 + math.ceil(optics.support_px(mask.alpha_rad, psi))
    rows, columns = stack.shape[:2]
    plan = Restore(device, (rows, columns), precision=precision, padding=padding)
    # The pixel's own blur stays in the image, as in a picture taken in focus.
    axes = [
        Otf1d(device, optics.frequency_axis(n), precision=precision).evaluate(mask.alpha_rad, psi)
        for n in plan.padded_shape
    ]
    first = next(iter(stack))
    dark = _dark_level(first) if level is None else level
    otf = np.outer(axes[0], axes[1][: plan.padded_shape[1] // 2 + 1])
    ratio = _ratio(nsr, _light(first, dark, repair=False), otf, plan.padded_shape)
    plan.set_filter_axes(axes[0], axes[1], ratio)
    quality = restoration_quality(otf, ratio, plan.padded_shape)
    return _Job(plan, dark, False, _described(ratio), quality, optics.object_pitch_um)


def _ratio(
    nsr: float | None, light: NDArray[np.float32], otf: NDArray[Any], padded: tuple[int, int]
) -> NDArray[np.float64] | float:
    """Return the noise-to-signal power given, else fit it to the first page."""
    from adof_cl.noise import noise_to_signal

    if nsr is not None:
        return nsr
    return noise_to_signal(light if light.ndim == 2 else light.mean(axis=2), otf, padded)


def _light(page: Image, dark: float, repair: bool) -> NDArray[np.float32]:
    """Return a page without the sensor's offset and, on request, without single wild pixels."""
    import cv2
    import numpy as np

    values = page.astype(np.float32)
    if repair:
        smooth = cv2.medianBlur(np.ascontiguousarray(page), 5).astype(np.float32)
        beyond = np.abs(values - smooth)
        sigma = 1.4826 * max(float(np.median(beyond)), 0.5)
        values = np.where(beyond > _OUTLIER_SIGMAS * sigma + _OUTLIER_SHARE * smooth, smooth, values)
    return np.asarray(values - np.float32(dark), dtype=np.float32)


def _dark_level(page: Image) -> float:
    import numpy as np

    return float(np.percentile(page, _OFFSET_PERCENTILE))


def _codes(values: NDArray[Any], dtype: np.dtype[Any]) -> Image:
    import numpy as np

    codes: Image = np.clip(np.floor(values + 0.5), 0, np.iinfo(dtype).max).astype(dtype)
    return codes


def _described(nsr: NDArray[np.float64] | float) -> str:
    if isinstance(nsr, float):
        return f"{nsr:g}"
    return f"fitted, {nsr.min():.2g} to {nsr.max():.2g}"


def _number(name: str, text: str) -> float | None:
    """Return the number, or None for "auto"."""
    import math

    from adof_cl.errors import InputError

    if text.strip().lower() == "auto":
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{name} is '{text}': a finite number or 'auto' was wanted")
    return value
