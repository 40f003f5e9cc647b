"""`adof plan`: the cheapest way to see a scene precisely enough, and why."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adof_cl.cli.devices import DeviceOption

if TYPE_CHECKING:
    from adof_cl.planner import Plan


def plan(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE", help="JSON file: objects, depths, noise, accuracies.")
    ],
    max_error_um: Annotated[
        float | None,
        typer.Option("--max-error-um", metavar="E", help="No feature may be farther off, at the object."),
    ] = None,
    max_ms: Annotated[
        float | None, typer.Option("--max-ms", metavar="T", help="No frame may take longer to compute.")
    ] = None,
    phase: Annotated[
        str | None, typer.Option("--phase", help="Whose accuracies count; default: the scene's.")
    ] = None,
    profile: Annotated[
        Path | None,
        typer.Option("--profile", metavar="FILE", help="Of adof tradeoff --json; default: the device's own."),
    ] = None,
    now: Annotated[
        bool, typer.Option("--now", help="Time the device first; state times at the machine's pace now.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the plan as JSON.")] = False,
    device: DeviceOption = None,
) -> None:
    """Choose mask, restoration, windows and search for a scene on this device: the cheapest precise enough.

    Says for each choice what it costs and how far off it is, and what is left out and why that is safe. Exits
    2 when no plan meets the budget, and says what the nearest possible one is. Times are those of the machine
    when it was profiled; with --now, of the machine as busy as it is.

    Examples: adof plan scene.json --max-error-um 2 | adof plan scene.json --max-ms 3 --phase approach --json
    """
    from dataclasses import replace

    from adof_cl.cli.profiles import planner_for, profile_for
    from adof_cl.planner import Planner
    from adof_cl.scene import Scene

    stated = Scene.read(scene)
    if phase is not None:
        stated = replace(stated, phase=phase)
    planner = planner_for(profile, device) if now else Planner(profile_for(profile, device))
    chosen = planner.plan(stated, max_error_um=max_error_um, max_ms=max_ms)
    if as_json:
        print(json.dumps(as_dict(chosen), indent=1))
    else:
        _print(chosen)


def as_dict(plan: Plan) -> dict[str, object]:
    """Return a plan as JSON-ready values."""
    from dataclasses import asdict

    return {**asdict(plan), "error_um": plan.error_um}


def _print(plan: Plan) -> None:
    print(f"{1e3 * plan.time_s:.3g} ms a frame, errors up to {plan.error_um:.2g} um")
    for sentence in plan.reasons:
        print(f"  {sentence}")
    print("left out:")
    for sentence in plan.left_out:
        print(f"  {sentence}")
