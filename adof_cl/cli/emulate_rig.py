"""`adof emulate rig`: the twin behind real protocols, with a rig file that any program can be given."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path
from typing import Annotated

import typer


def rig(
    file: Annotated[
        Path, typer.Argument(metavar="RIG.TOML", help="Where to write its rig file.", show_default=False)
    ],
    program: Annotated[
        list[str] | None,
        typer.Argument(metavar="[-- PROGRAM...]", help="What to run beside it, after two dashes."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Draws the start and all noise.")] = 0,
    rate_hz: Annotated[float, typer.Option("--rate-hz", help="Frames a second of its cameras.")] = 60.0,
    operators: Annotated[
        bool,
        typer.Option("--operators", help="Name a pedal and a SpaceMouse too: adof emulate hid has them."),
    ] = False,
) -> None:
    """Start two cameras, two stages and a panel whose world is the twin's; write a rig file that names them.

    With a program: runs it with DISPLAY set to the panel's, then ends; its exit code is passed on. Without:
    stays until Ctrl-C. Operator devices need device nodes, which adof emulate hid makes for one program.

    Examples: adof emulate rig rig.toml -- adof rig check rig.toml | adof emulate rig rig.toml --operators --
    adof emulate hid spacemouse,pedal --script hands.txt -- adof run --rig rig.toml --home
    """
    from adof_cl.cli.emulated_rig import emulated
    from adof_cl.errors import InputError
    from adof_cl.files import whole_file
    from adof_cl.optics import require_positive

    require_positive(rate_hz=rate_hz)
    if not file.parent.is_dir():
        raise InputError(f"{file} cannot be written (no such folder): choose another place")
    code = 0
    with emulated(seed, rate_hz=rate_hz, operators=operators) as there:
        with whole_file(file) as path:
            path.write_text(there.text, encoding="utf-8")
        if program:
            code = subprocess.run(program, check=False).returncode  # noqa: S603  (the user's own program)
        else:
            print(f"{file} names it; its panel's display: DISPLAY={os.environ['DISPLAY']}; Ctrl-C ends it")
            while True:
                time.sleep(1.0)
    raise typer.Exit(code)
