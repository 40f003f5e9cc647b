"""`adof emulate hid`: an operator's devices on /dev/hidraw*, for a program that is run among them."""

from __future__ import annotations

import subprocess
from typing import Annotated

import typer


def hid(
    kinds: Annotated[
        str,
        typer.Argument(
            metavar="KINDS",
            help="spacemouse, pedal, keyboard-pedal, relay, dlpc900; several separated by commas.",
            show_default=False,
        ),
    ],
    program: Annotated[
        list[str],
        typer.Argument(metavar="-- PROGRAM...", help="What to run, after two dashes.", show_default=False),
    ],
    script: Annotated[
        str | None, typer.Option("--script", metavar="FILE", help="What happens to them; - reads from here.")
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="Draw somebody who uses them, and cables that come out."),
    ] = None,
) -> None:
    """Run a program that finds these devices plugged in, opens them with hidapi, and may lose them.

    No kernel takes part: umockdev answers for the device nodes, for that program alone. Where they are, and
    what the program makes of them, is said on standard error; its exit code is passed on. A script has one
    command a line:

    \b
    wait SECONDS                        spacemouse deflect X Y Z [AX AY AZ]
    KIND unplug                         spacemouse press [BUTTON...]
    KIND plug                           spacemouse silence
    KIND report HEX                     pedal press, pedal release
                                        relay stick [CHANNEL...]

    For example:

    \b
    adof emulate hid spacemouse --seed 1 -- python my_jog.py
    echo 'pedal press' | adof emulate hid pedal,relay --script - -- python my_stop.py
    """  # noqa: D301  (\b is click's mark for lines to be left as they are)
    from adof_drivers.emulators.hid_nodes import command

    line = command(kinds.split(","), program, script=script, seed=seed)
    raise typer.Exit(subprocess.run(line, check=False).returncode)  # noqa: S603  (the user's own program)
