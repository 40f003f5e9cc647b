"""`adof dof`: how much mask a depth range needs, by the paper and by the optics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from adof_cl.cli.tables import print_table

if TYPE_CHECKING:
    from adof_cl.mask import ModelCalibration, PaperCalibration


def dof(
    near_um: Annotated[
        float | None, typer.Option("--near-um", help="With --far-um: choose a mask for this range.")
    ] = None,
    far_um: Annotated[float | None, typer.Option("--far-um", help="The range's far end.")] = None,
    criterion: Annotated[
        float, typer.Option("--lp-per-mm", help="Line pairs per mm that must stay visible.")
    ] = 20.0,
    threshold: Annotated[float, typer.Option("--threshold", help="Contrast at which they are.")] = 0.09,
    f_number: Annotated[float, typer.Option("--f-number", help="Working f-number, object side.")] = 6.5,
    wavelength_um: Annotated[float, typer.Option("--wavelength-um", help="Wavelength.")] = 0.55,
    plot: Annotated[Path | None, typer.Option("--plot", metavar="DOF.png", help="Picture to write.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Compare both calibrations of mask strength with the paper's points (its Figs 3, 4 and 11).

    `paper` is the quadratic through its five points; `model` comes from the optics, the contrast threshold
    and its last crossing. Depths are one-sided, from the plane in focus; those of B to E are inferred.

    Example: adof dof --near-um 0 --far-um 4000 --plot dof.png
    """
    from adof_cl.errors import InputError
    from adof_cl.files import whole_file
    from adof_cl.mask import (
        PAPER_POINTS,
        PAPER_RESOLUTION,
        ModelCalibration,
        PaperCalibration,
        choose_mask,
        depth_to_cover_um,
    )
    from adof_cl.optics import OpticalSystem

    if (near_um is None) != (far_um is None):
        raise InputError("one of --near-um and --far-um came: give both ends of the range")
    if plot is not None and plot.suffix.lower() != ".png":
        raise InputError(f"{plot} has the wrong ending: name it *.png")
    optics = OpticalSystem(wavelength_um=wavelength_um, f_number=f_number)
    paper, model = PaperCalibration(), ModelCalibration(optics, criterion, threshold)
    report: dict[str, Any] = {
        "criterion_lp_per_mm": criterion,
        "threshold": threshold,
        "f_number": f_number,
        "wavelength_um": wavelength_um,
        "native_depth_um": {"paper": paper.shallowest_um, "model": model.depth_um(0.0)},
        "points": [
            {
                "position": name,
                "depth_um": depth,
                "alpha_published": alpha,
                "alpha_paper": paper.alpha_rad(depth),
                "alpha_model": model.alpha_rad(depth),
                "depth_model_um": model.depth_um(alpha),
            }
            for name, depth, alpha in PAPER_POINTS
        ],
        "resolution": [
            {"alpha": alpha, "lp_per_mm_published": lp, "lp_per_mm_model": model.resolution_lp_per_mm(alpha)}
            for alpha, lp in PAPER_RESOLUTION
        ],
    }
    if near_um is not None and far_um is not None:
        report["chosen"] = []
        for calibration in (paper, model):
            for joint in (False, True):
                mask = choose_mask(near_um, far_um, calibration, optics, joint=joint)
                report["chosen"].append(
                    {
                        "calibration": calibration.name,
                        "joint": joint,
                        "alpha": mask.alpha_rad,
                        "focus_psi": mask.focus_psi_rad,
                        "focus_um": optics.depth_um(0.0 - mask.focus_psi_rad),
                        "covered": calibration.covers(
                            depth_to_cover_um(near_um, far_um, optics, joint=joint)
                        ),
                    }
                )
    if plot is not None:
        with whole_file(plot) as temporary:
            _draw(temporary, paper, model)
    if as_json:
        print(json.dumps(report, indent=2))
    else:
        _print(report, plot)


def _print(report: dict[str, Any], plot: Path | None) -> None:
    from rich.table import Table

    print(
        f"Mask strength for a depth range ({report['criterion_lp_per_mm']:g} lp/mm, contrast "
        f"{report['threshold']:g}, f/{report['f_number']:g}):"
    )
    table = Table(box=None, header_style="bold")
    for heading in ("", "depth mm", "published", "paper", "model", "model's depth mm"):
        table.add_column(heading, justify="right")
    for point in report["points"]:
        table.add_row(
            point["position"],
            f"{point['depth_um'] / 1000:.3f}",
            f"{point['alpha_published']:.2f}",
            f"{point['alpha_paper']:.2f}",
            f"{point['alpha_model']:.2f}",
            f"{point['depth_model_um'] / 1000:.2f}",
        )
    native = report["native_depth_um"]
    table.add_row(
        "none", "", "", f"to {native['paper'] / 1000:.3f} mm", f"to {native['model'] / 1000:.3f} mm", ""
    )
    print_table(table)
    print("\nResolution in focus, lp/mm:")
    table = Table(box=None, header_style="bold")
    for heading in ("alpha", "published", "model"):
        table.add_column(heading, justify="right")
    for row in report["resolution"]:
        table.add_row(f"{row['alpha']:g}", f"{row['lp_per_mm_published']:g}", f"{row['lp_per_mm_model']:.1f}")
    print_table(table)
    if "chosen" in report:
        print("\nMask for the range:")
    for chosen in report.get("chosen", []):
        print(
            f"{chosen['calibration']:>5}{', focus moved' if chosen['joint'] else ''}: alpha "
            f"{chosen['alpha']:.2f}, focus {chosen['focus_psi']:.2f} rad ({chosen['focus_um']:.0f} um)"
            f"{'' if chosen['covered'] else ', the strongest it knows: the range is deeper than it covers'}",
        )
    if plot is not None:
        print(plot)


def _draw(path: Path, paper: PaperCalibration, model: ModelCalibration) -> None:
    import numpy as np
    from matplotlib.figure import Figure

    from adof_cl.mask import PAPER_POINTS, PAPER_RESOLUTION

    figure = Figure(figsize=(10, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    depth_um = np.linspace(0, 5000, 501)
    for calibration, style in ((paper, "C0-"), (model, "C1-")):
        inside = np.array([calibration.covers(d) for d in depth_um])
        alpha = np.array([calibration.alpha_rad(d) for d in depth_um])
        left.plot(depth_um[inside] / 1000, alpha[inside], style, label=calibration.name)
        if not inside.all():
            left.plot(
                depth_um[~inside] / 1000,
                alpha[~inside],
                style[:2] + ":",
                label=f"{calibration.name}, clamped",
            )
    left.plot(
        [d / 1000 for _, d, _ in PAPER_POINTS], [a for _, _, a in PAPER_POINTS], "ko", label="published"
    )
    for name, d, a in PAPER_POINTS:
        left.annotate(name, (d / 1000, a), xytext=(-12, 4), textcoords="offset points")
    left.set(
        xlabel="depth range from the plane in focus, mm",
        ylabel="mask strength alpha, rad",
        title=f"Fig. 3: depth of field at {model.criterion_lp_per_mm:g} lp/mm",
    )
    alpha = np.linspace(0, 110, 331)
    right.plot(alpha, [model.resolution_lp_per_mm(float(a)) for a in alpha], "C1-", label="model")
    right.plot(*zip(*PAPER_RESOLUTION, strict=True), "ko", label="published ends")
    right.set(
        xlabel="mask strength alpha, rad",
        ylabel="resolution in focus, lp/mm",
        title="Fig. 4: resolution in the plane in focus",
        ylim=(0, 60),
    )
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=120)
