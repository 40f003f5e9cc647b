"""`adof devices`: what OpenCL finds on this machine."""

from __future__ import annotations

import json
import os
from typing import Annotated

import typer
from rich.console import JustifyMethod
from rich.table import Table

from adof_cl.cli.tables import print_table

DeviceOption = Annotated[
    str | None,
    typer.Option(
        "--device",
        metavar="D",
        help="Index, type (cpu, gpu) or part of a name; default: ADOF_DEVICE, else GPU before CPU.",
    ),
]
"""The option every computing command shares."""


def devices(
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead of a table.")] = False,
) -> None:
    """List the OpenCL devices; the default one is marked with a star.

    Example: adof devices --json
    """
    from adof_cl.device import SELECTOR_VARIABLE, choose, list_devices
    from adof_cl.errors import DeviceError

    found = list_devices()
    try:
        default = choose(found, os.environ.get(SELECTOR_VARIABLE)).index
    except DeviceError:
        default = -1
    if as_json:
        print(
            json.dumps([{**facts.as_dict(), "default": facts.index == default} for facts in found], indent=2)
        )
        return
    table = Table(box=None, header_style="bold")
    for heading in ("", "#", "device", "platform", "type", "fp64", "local memory", "units", "driver"):
        justify: JustifyMethod = "right" if heading in ("#", "units", "local memory") else "left"
        table.add_column(heading, justify=justify, overflow="fold")
    for facts in found:
        table.add_row(
            "*" if facts.index == default else "",
            str(facts.index),
            facts.name,
            facts.platform,
            facts.kind + (" (simulated)" if facts.simulated else ""),
            "yes" if facts.fp64 else "no",
            f"{facts.local_memory_bytes // 1024} KiB",
            str(facts.compute_units),
            facts.driver_version,
        )
    print_table(table)
