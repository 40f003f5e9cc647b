"""`adof phase`: a mask as the picture to show on a modulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from adof_cl.cli.devices import DeviceOption


def phase(
    out: Annotated[Path, typer.Option("-o", "--out", metavar="MASK.png", help="8-bit PNG to write.")],
    panel: Annotated[str, typer.Option("--panel", help="LC2002, LC2012, PLUTO or LETO.")] = "LC2002",
    alpha: Annotated[float, typer.Option("--alpha", help="Cubic phase at the stop's edge, rad.")] = 0.0,
    focus_um: Annotated[
        float, typer.Option("--focus-um", metavar="Z", help="Depth to bring into focus, um beyond the plane.")
    ] = 0.0,
    tilt_x: Annotated[float, typer.Option("--tilt-x", help="Tilt along x at the stop's edge, rad.")] = 0.0,
    tilt_y: Annotated[float, typer.Option("--tilt-y", help="Tilt along y at the stop's edge, rad.")] = 0.0,
    stroke_rad: Annotated[
        float | None, typer.Option("--stroke-rad", help="Phase between codes 0 and 255; default 2 pi.")
    ] = None,
    aperture_um: Annotated[float, typer.Option("--aperture-um", help="Width of the square stop.")] = 10_000.0,
    f_number: Annotated[float, typer.Option("--f-number", help="Working f-number, object side.")] = 6.5,
    wavelength_um: Annotated[float, typer.Option("--wavelength-um", help="Wavelength.")] = 0.55,
    device: DeviceOption = None,
) -> None:
    """Write the codes that show a mask, the stop centred on the panel and 0 outside it.

    Example: adof phase --alpha 53.5 --focus-um 2000 --panel LC2002 -o mask.png
    """
    import cv2

    from adof_cl.device import Device
    from adof_cl.errors import InputError
    from adof_cl.files import whole_file
    from adof_cl.optics import Mask, OpticalSystem
    from adof_cl.slm_encode import SlmEncode, panel_named

    if out.suffix.lower() != ".png":
        raise InputError(f"{out} is no PNG: name the output *.png, which keeps every code as it is")
    optics = OpticalSystem(wavelength_um=wavelength_um, aperture_um=aperture_um, f_number=f_number)
    chosen = panel_named(panel)
    if stroke_rad is not None:
        chosen = chosen.with_stroke(stroke_rad)
    mask = Mask(alpha_rad=alpha, focus_psi_rad=0.0 - optics.psi_rad(focus_um))
    encode = SlmEncode(Device.open(device), chosen, optics)
    codes = encode.codes(mask, tilt_xy_rad=(tilt_x, tilt_y))
    with whole_file(out) as temporary:
        if not cv2.imwrite(str(temporary), codes):
            raise InputError(f"{out} cannot be written: choose another place")
    print(
        f"{out}: {chosen.columns} x {chosen.rows}, alpha {alpha:g}, focus {mask.focus_psi_rad:.2f} rad, "
        f"stop {chosen.stop_px(aperture_um):g} px wide, largest step "
        f"{encode.step_rad(mask, (tilt_x, tilt_y)):.2f} rad per pixel"
    )
    print(chosen.source)
