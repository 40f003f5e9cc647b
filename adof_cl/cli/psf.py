"""`adof psf`: point-spread and transfer function as arrays, and a picture of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from adof_cl.cli.devices import DeviceOption
from adof_cl.cli.otf import PrecisionOption, best_precision

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from adof_cl.device import Device
    from adof_cl.optics import Mask, OpticalSystem


def psf(
    out: Annotated[Path, typer.Option("-o", "--out", metavar="PSF.npz", help="Arrays to write.")],
    alpha: Annotated[float, typer.Option("--alpha", help="Cubic phase at the stop's edge, rad.")] = 0.0,
    depth_um: Annotated[float, typer.Option("--depth-um", help="Depth beyond the plane in focus.")] = 0.0,
    focus_um: Annotated[float, typer.Option("--focus-um", help="Depth the modulator focuses on.")] = 0.0,
    stop: Annotated[str, typer.Option("--stop", help="square or round.")] = "square",
    panel: Annotated[
        str | None, typer.Option("--panel", help="Show the mask through this panel's pixels and codes.")
    ] = None,
    size: Annotated[
        int | None,
        typer.Option("--size", help="Samples: camera pixels (square stop), or cells across the stop."),
    ] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Picture; default: beside the arrays.")] = None,
    aperture_um: Annotated[float, typer.Option("--aperture-um", help="Width of the stop.")] = 10_000.0,
    f_number: Annotated[float, typer.Option("--f-number", help="Working f-number, object side.")] = 6.5,
    wavelength_um: Annotated[float, typer.Option("--wavelength-um", help="Wavelength.")] = 0.55,
    pixel_um: Annotated[float, typer.Option("--pixel-um", help="Camera pixel pitch.")] = 7.4,
    precision: PrecisionOption = None,
    device: DeviceOption = None,
) -> None:
    """Write psf, otf and their axes for one depth seen through a mask.

    Both include the pixel's aperture and have their centre at [0, 0]; otf is the transform of psf, which sums
    to 1. A square stop is computed exactly at the camera's pixels; a round stop or a panel by two-dimensional
    transforms at finer steps.

    Example: adof psf --alpha 53.5 --depth-um 4000 -o psf.npz
    """
    import numpy as np

    from adof_cl.device import Device
    from adof_cl.errors import InputError
    from adof_cl.files import whole_file
    from adof_cl.optics import Mask, OpticalSystem

    picture = plot or out.with_suffix(".png")
    for path, suffix in ((out, ".npz"), (picture, ".png")):
        if path.suffix.lower() != suffix:
            raise InputError(f"{path} has the wrong ending: name it *{suffix}")
    optics = OpticalSystem(wavelength_um, aperture_um, f_number, pixel_pitch_um=pixel_um)
    mask = Mask(alpha_rad=alpha, focus_psi_rad=0.0 - optics.psi_rad(focus_um))
    opened = Device.open(device)
    chosen = precision or best_precision(opened.facts.fp64)
    if stop == "square" and panel is None:
        arrays = _at_the_camera(opened, optics, mask, depth_um, size, chosen)
    else:
        arrays = _fine(opened, optics, mask, depth_um, stop, panel, size, chosen)
    psi = mask.psi_rad(optics, depth_um)
    with whole_file(out) as temporary, whole_file(picture) as drawn:
        values: dict[str, Any] = {"alpha_rad": alpha, "psi_rad": psi, **arrays}
        np.savez(temporary, **values)
        _draw(drawn, arrays, f"alpha {alpha:g}, depth {depth_um:g} um (psi {psi:.1f}), {panel or stop} stop")
    print(f"{out}: psf and otf {arrays['psf'].shape}, steps of {arrays['x_um'][1]:.3g} um; {picture}")


def _at_the_camera(
    device: Device, optics: OpticalSystem, mask: Mask, depth_um: float, size: int | None, precision: str
) -> dict[str, NDArray[Any]]:
    import math

    import numpy as np

    from adof_cl.errors import LimitError
    from adof_cl.otf_table import OtfTable

    support = optics.support_px(mask.alpha_rad or 1e-9, mask.psi_rad(optics, depth_um))
    n = size or max(64, 1 << math.ceil(math.log2(2 * support + 16)))
    if not max(8, support) <= n <= 8192:
        raise LimitError(
            f"a point is spread over {support:.0f} pixels, --size is {n}: choose one from "
            f"{max(8, math.ceil(support))} to 8192"
        )
    table = OtfTable(device, optics, (n, n), precision=precision)
    table.update_depths(mask, [depth_um])
    otf = table.otf(0)
    x_um = np.fft.fftfreq(n, 1 / n) * optics.object_pitch_um
    u = optics.frequency_axis(n)
    return {"psf": np.fft.ifft2(otf).real, "otf": otf, "x_um": x_um, "y_um": x_um, "u_x": u, "u_y": u}


def _fine(
    device: Device,
    optics: OpticalSystem,
    mask: Mask,
    depth_um: float,
    stop: str,
    panel: str | None,
    size: int | None,
    precision: str,
) -> dict[str, NDArray[Any]]:
    import numpy as np

    from adof_cl.optics import Mask, PupilGrid
    from adof_cl.psf import Psf, samples_for
    from adof_cl.pupil_phase import PupilPhase
    from adof_cl.slm_encode import SlmEncode, panel_named

    psi = mask.psi_rad(optics, depth_um)
    samples = size or samples_for(mask.alpha_rad, psi)
    if panel is not None and size is None:
        samples = max(samples, 1024)  # at least three cells a pixel on the panels known
    PupilGrid(samples)
    transform = Psf(device, samples, stop=stop, precision=precision)
    pupil = PupilPhase(device, samples, samples, precision=precision)
    if panel is None:
        turns = pupil(Mask(mask.alpha_rad, psi))
    else:
        shown = panel_named(panel)
        codes = SlmEncode(device, shown, optics)(mask)
        turns = transform.panel_turns(codes, pupil(Mask(0.0, optics.psi_rad(depth_um))), shown, optics)
    _, raw = transform(turns, alpha_rad=mask.alpha_rad, psi_rad=psi)
    # u = 2 nu lambda N, so the pixel's sinc(nu p) in terms of u:
    pixel = np.sinc(transform.u * optics.object_pitch_um / (2 * optics.wavelength_um * optics.f_number))
    otf = raw.download() * (pixel * pixel[:, None]).astype(transform.psf.dtype)
    x_um = np.fft.fftfreq(transform.size, 1 / transform.size) * transform.pitch_um(optics)
    u = transform.u
    return {"psf": np.fft.ifft2(otf).real, "otf": otf, "x_um": x_um, "y_um": x_um, "u_x": u, "u_y": u}


def _draw(path: Path, arrays: dict[str, NDArray[Any]], title: str) -> None:
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.4), layout="constrained")
    figure.suptitle(title)
    left, right = figure.subplots(1, 2)
    spread = np.fft.fftshift(arrays["psf"])
    x = np.fft.fftshift(arrays["x_um"])
    # What holds all but a hundredth of the light, and a margin.
    outside = [np.cumsum(spread.sum(axis=axis)) for axis in (0, 1)]
    held = [np.flatnonzero((total > 5e-3) & (total < 1 - 5e-3)) for total in outside]
    first = max(min(int(h[0]) for h in held) - 6, 0)
    last = min(max(int(h[-1]) for h in held) + 7, x.size - 1)
    seen = slice(first, last + 1)
    half = (x[1] - x[0]) / 2
    image = left.imshow(
        np.sqrt(np.maximum(spread[seen, seen], 0) / spread.max()),
        extent=(x[first] - half, x[last] + half, x[last] + half, x[first] - half),
        cmap="magma",
    )
    left.set(title="point-spread function (square root)", xlabel="x at the object, um", ylabel="y, um")
    figure.colorbar(image, ax=left, shrink=0.9)
    n = arrays["otf"].shape[1] // 2
    u = arrays["u_x"][:n]
    for label, line in (("along u", arrays["otf"][0, :n]), ("diagonal", np.diagonal(arrays["otf"])[:n])):
        right.plot(u, np.abs(line), label=label)
    right.set(title="transfer function, modulus", xlabel="u (cut-off 2)", ylim=(0, 1.02), xlim=(0, u[-1]))
    right.grid(alpha=0.3)
    right.legend()
    figure.savefig(path, dpi=120)
