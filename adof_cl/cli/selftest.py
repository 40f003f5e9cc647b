"""`adof selftest`: a known answer for every kernel on the chosen device."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from adof_cl.cli.devices import DeviceOption


def selftest(
    small: Annotated[
        bool, typer.Option("--small", help="Small sizes, for a simulator that checks every access.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON object instead of lines.")] = False,
    device: DeviceOption = None,
) -> None:
    """Compare every kernel with the float64 reference; exits 1 if one is off.

    Example: adof selftest --device cpu
    """
    import sys
    from dataclasses import asdict

    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from adof_cl import selftest as known
    from adof_cl.device import Device

    opened = Device.open(device)
    outcomes = []
    if not as_json:
        print(opened.facts)
        print(f"{'':6}{'error':>9}{'bound':>10}  in")
    from rich.console import Console

    with Progress(
        SpinnerColumn(),
        TextColumn("{task.completed} answers, last: {task.description}"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
        disable=not (as_json and sys.stderr.isatty()),  # lines of text are progress enough
    ) as progress:
        task = progress.add_task("none", total=None)
        for outcome in known.run(opened, small=small):
            outcomes.append(outcome)
            progress.update(task, advance=1, description=outcome.name)
            if not as_json:
                word = "ok" if outcome.ok else "FAILED"
                line = (
                    f"{word:6}{outcome.error:9.1e}{outcome.bound:10.1e}  {outcome.measure:12} {outcome.name}"
                )
                print(f"{line}: {outcome.failure}" if outcome.failure else line, flush=True)
    failed = [outcome for outcome in outcomes if not outcome.ok]
    if as_json:
        answers = [{**asdict(outcome), "ok": outcome.ok} for outcome in outcomes]
        print(json.dumps({"device": opened.facts.as_dict(), "ok": not failed, "answers": answers}, indent=2))
    else:
        without = "" if opened.facts.fp64 else "; no float64 on this device"
        print(f"{len(outcomes)} known answers, {len(failed)} failed{without}")
    if failed:
        raise typer.Exit(1)
