"""`adof emulate stage`: a controller that speaks the wire, for other programs to open."""

from __future__ import annotations

import json
import threading
import time
from enum import StrEnum
from typing import Annotated

import typer

from adof_cl.errors import InputError


class _Protocol(StrEnum):
    GCS = "gcs"
    PICOMOTOR = "picomotor"
    GCODE = "gcode"


def stage(
    protocol: Annotated[_Protocol, typer.Option("--protocol", help="What it speaks.")] = _Protocol.GCS,
    tcp: Annotated[
        str, typer.Option("--tcp", metavar="HOST:PORT", help="Loopback only; port 0 takes a free one.")
    ] = "127.0.0.1:0",
    pty: Annotated[bool, typer.Option("--pty", help="A pseudo terminal instead.")] = False,
    axes: Annotated[int, typer.Option("--axes", min=1, max=16, help="Axes of a GCS controller.")] = 3,
    faults: Annotated[
        int, typer.Option("--faults", min=0, help="So many faults within the first 1000 lines.")
    ] = 0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Draws the faults.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print where it is as JSON.")] = False,
) -> None:
    """Run an emulated controller until Ctrl-C: byte-true, with finite acceleration, one client at a time.

    The first line printed says where it is.

    Examples: adof emulate stage --tcp 127.0.0.1:50000, adof emulate stage --protocol picomotor --pty,
    adof emulate stage --faults 20 --seed 3
    """
    from adof_drivers.emulators.engine import Engine
    from adof_drivers.emulators.faults import FaultSchedule
    from adof_drivers.emulators.gcode import GcodeEngine
    from adof_drivers.emulators.gcs import GcsEngine
    from adof_drivers.emulators.picomotor import PicomotorEngine
    from adof_drivers.emulators.serve import Served

    host, colon, number = tcp.rpartition(":")
    if not (colon and number.isascii() and number.isdigit() and int(number) < 65536):
        raise InputError(f"--tcp is {tcp!r}: HOST:PORT was wanted, as 127.0.0.1:50000")
    schedule = FaultSchedule.seeded(seed, count=faults, lines=1000)
    engine: Engine
    match protocol:
        case _Protocol.GCS:
            engine = GcsEngine([str(i + 1) for i in range(axes)], now_s=time.monotonic, faults=schedule)
        case _Protocol.PICOMOTOR:
            engine = PicomotorEngine(now_s=time.monotonic, faults=schedule)
        case _Protocol.GCODE:
            engine = GcodeEngine(now_s=time.monotonic, faults=schedule)
    with Served.pty(engine) if pty else Served.tcp(engine, host, int(number)) as served:
        where = {
            "device": "stage",
            "protocol": protocol.value,
            "wire": "pty" if pty else "tcp",
            "address": served.address,
        }
        print(
            json.dumps(where) if as_json else f"{where['device']}, {where['protocol']}: {where['address']}",
            flush=True,
        )
        threading.Event().wait()
