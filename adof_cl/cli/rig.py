"""`adof rig`: what a rig file names, looked at."""

from __future__ import annotations

import dataclasses
import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from adof_cl.cli.progress import Live
from adof_cl.cli.tables import print_table


class _Action(StrEnum):
    CHECK = "check"


def rig(
    action: Annotated[_Action, typer.Argument(help="What to do.", show_default=False)],  # noqa: ARG001
    file: Annotated[Path, typer.Argument(metavar="RIG.TOML", help="The rig file.", show_default=False)],
    move: Annotated[
        bool, typer.Option("--move", help="Also jog every homed axis by 20 steps and back, after asking.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="With --move: the way is clear, do not ask.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list instead of a table.")] = False,
) -> None:
    """Open every device of a rig, read who it is, measure it, and say what is wrong and what mends it.

    Nothing moves without --move. Exits 0 when all is well, 1 when something is not, 2 when the file is
    refused.

    Examples: adof rig check rig.toml, adof rig check rig.toml --move, adof rig check rig.toml --json
    """
    from adof_cl.cli.live_rig import TABLES
    from adof_drivers.rig import Section, check, load

    named = load(file, tables=TABLES)
    sections = {name: section for name, section in named.items() if isinstance(section, Section)}
    if move and not yes:
        typer.confirm("Stages will move by 20 steps. Is the way clear?", abort=True, err=True)
    with Live(f"{file}: {len(sections)} devices") as live:
        findings = []
        for name, section in sections.items():
            live.tell(name, f"driver {section.driver}")
            found = check({name: section}, move=move)
            bad = sum(not finding.good for finding in found)
            live.tell(name, f"{bad} of {len(found)} to mend" if bad else "well")
            findings += found
    wrong = sum(not finding.good for finding in findings)
    if as_json:
        print(json.dumps([dataclasses.asdict(finding) for finding in findings], indent=2))
    else:
        table = Table(box=None, header_style="bold")
        for heading in ("", "device", "what", "found", "to mend"):
            table.add_column(heading, overflow="fold")
        for finding in findings:
            table.add_row(
                "" if finding.good else "!",
                finding.device,
                finding.what,
                finding.found,
                "" if finding.good else finding.mend,
            )
        print_table(table)
        print(f"{wrong} of {len(findings)} are not as they should be" if wrong else "all is well")
    if wrong:
        raise typer.Exit(1)
