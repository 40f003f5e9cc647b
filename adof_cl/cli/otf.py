"""`adof otf`: the exact transfer function at given frequencies, computed on the device."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from adof_cl.cli.devices import DeviceOption

PrecisionOption = Annotated[
    str | None,
    typer.Option("--precision", help="float32 or float64; default: float64 where the device has it."),
]
"""The option every command shares that can compute in either precision."""


def otf(
    u: Annotated[list[float], typer.Option("--u", help="Normalised frequency, cut-off 2; repeat for more.")],
    alpha: Annotated[float, typer.Option("--alpha", help="Cubic phase at the stop's edge, rad.")] = 0.0,
    psi: Annotated[float, typer.Option("--psi", help="Defocus phase at the stop's edge, rad.")] = 0.0,
    paper: Annotated[
        bool, typer.Option("--paper", help="Show the paper's Eq. 2 beside it, as printed and completed.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead of a table.")] = False,
    precision: PrecisionOption = None,
    device: DeviceOption = None,
) -> None:
    """Evaluate H(u; alpha, psi) of the square stop along one axis.

    Example: adof otf --alpha 53.5 --psi 15 --u 0.44 --u 0.77 --json
    """
    import numpy as np
    from rich.table import Table

    from adof_cl.cli.tables import print_table
    from adof_cl.device import Device
    from adof_cl.otf import Otf1d, stationary_phase_otf

    opened = Device.open(device)
    chosen = precision or best_precision(opened.facts.fp64)
    values = Otf1d(opened, np.array(u), precision=chosen).evaluate(alpha, psi)
    approximations = {}
    if paper:
        at_u = np.array(u)
        approximations = {
            "eq2": stationary_phase_otf(at_u, alpha, psi, as_printed=True),
            "eq2_completed": stationary_phase_otf(at_u, alpha, psi),
        }
    if as_json:
        rows = []
        for k, (at, value) in enumerate(zip(u, values, strict=True)):
            row = {"u": at, "re": float(value.real), "im": float(value.imag)}
            for name, found in approximations.items():
                row |= {f"{name}_re": float(found[k].real), f"{name}_im": float(found[k].imag)}
            rows.append(row)
        print(json.dumps(rows))
        return
    print(f"alpha {alpha:g} rad, psi {psi:g} rad; {opened.facts}, {chosen}")
    table = Table(box=None, header_style="bold")
    for heading in ("u", "Re H", "Im H", "|H|", *(f"{name} is off by" for name in approximations)):
        table.add_column(heading, justify="right")
    digits = 13 if chosen == "float64" else 7
    for k, (at, value) in enumerate(zip(u, values, strict=True)):
        size = abs(complex(value))
        off = (100 * abs(found[k] - value) / max(size, 1e-300) for found in approximations.values())
        shown = (f"{part:.{digits}f}" for part in (value.real, value.imag, size))
        table.add_row(f"{at:g}", *shown, *(f"{share:.0f} %" for share in off))
    print_table(table)


def best_precision(fp64: bool) -> str:
    """Return the finest precision a device has."""
    return "float64" if fp64 else "float32"
