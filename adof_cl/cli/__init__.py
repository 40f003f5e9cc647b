"""The command line `adof`: the only place where compute, twin and drivers meet.

One module per command; each defines the function named after it. Every error of ours becomes one sentence on
standard error and exit code 2; Ctrl-C exits 130.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Annotated

import typer

from adof_cl import __version__
from adof_cl.errors import AdofError
from adof_drivers.errors import DriverError

COMMANDS: tuple[str, ...] = (
    "run",
    "plan",
    "tradeoff",
    "devices",
    "phase",
    "otf",
    "psf",
    "dof",
    "restore",
    "rig",
    "emulate",
    "selftest",
    "envelope",
    "bench",
)
"""Modules of this package, in the order `adof --help` lists them."""


def _print_version(wanted: bool) -> None:
    if wanted:
        print(__version__)
        raise typer.Exit


def application() -> typer.Typer:
    """Build the command tree."""
    app = typer.Typer(
        name="adof",
        help="Adaptive depth-of-field imaging for micromanipulation, on any OpenCL device.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    @app.callback()
    def _root(
        _version: Annotated[
            bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
        ] = False,
    ) -> None:
        pass

    for name in COMMANDS:
        command: Callable[..., None] | typer.Typer = getattr(import_module(f"adof_cl.cli.{name}"), name)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name=name)(command)
    return app


def main(arguments: list[str] | None = None) -> None:
    """Run `adof`; exits with 0, 1 (a check failed), 2 (refused input) or 130 (interrupted)."""
    try:
        application()(args=arguments, standalone_mode=True)
    except (AdofError, DriverError) as refusal:
        print(f"adof: {refusal}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("adof: interrupted", file=sys.stderr)
        sys.exit(130)
