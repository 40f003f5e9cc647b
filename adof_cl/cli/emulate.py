"""`adof emulate`: devices that speak the real wire, for programs that want to be tried without hardware."""

from __future__ import annotations

import typer

from adof_cl.cli.emulate_camera import camera
from adof_cl.cli.emulate_hid import hid
from adof_cl.cli.emulate_rig import rig
from adof_cl.cli.emulate_stage import stage

emulate = typer.Typer(
    help="Start an emulated device that speaks the real wire format; Ctrl-C ends it.\n\n"
    "Examples: adof emulate camera --twin 0, adof emulate stage --tcp 127.0.0.1:50000, "
    "adof emulate hid spacemouse --seed 1 -- python my_jog.py, "
    "adof emulate rig emulated.toml -- adof rig check emulated.toml",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@emulate.callback()
def _group() -> None:
    pass


emulate.command("camera")(camera)
emulate.command("stage")(stage)
emulate.command("hid")(hid)
emulate.command("rig")(rig)
