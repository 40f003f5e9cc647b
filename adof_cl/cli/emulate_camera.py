"""`adof emulate camera`: the twin's cameras, or recorded pictures, as GigE Vision cameras on UDP."""

from __future__ import annotations

import ipaddress
import signal
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from adof_cl.cli.devices import DeviceOption

if TYPE_CHECKING:
    from adof_cl.twin import SimulatedCamera, Twin
    from adof_drivers.emulators.gige import Region, Source


def camera(
    twin: Annotated[int, typer.Option("--twin", metavar="SEED", help="Serve the twin of this seed.")] = 0,
    which: Annotated[
        str, typer.Option("--camera", metavar="N", help="1, 2 or both: the second at the next address.")
    ] = "1",
    images: Annotated[
        Path | None,
        typer.Option(
            "--images", metavar="P", help="Serve this stack or folder, over and over, not the twin."
        ),
    ] = None,
    alpha: Annotated[
        float, typer.Option("--alpha", help="Cubic phase on the twin's modulator at the stop's edge, rad.")
    ] = 0.0,
    region: Annotated[bool, typer.Option("--region", help="Only the twin's region of interest.")] = False,
    address: Annotated[str, typer.Option("--address", help="Where to listen.")] = "127.0.0.1",
    rate_hz: Annotated[float, typer.Option("--rate-hz", help="Frames a second, as switched on.")] = 60.0,
    seconds: Annotated[float | None, typer.Option("--seconds", help="End after so long.")] = None,
    fault_seed: Annotated[int, typer.Option("--fault-seed", help="Draws the faults below.")] = 0,
    packet_loss: Annotated[float, typer.Option("--packet-loss", help="Share of packets not sent.")] = 0.0,
    frame_loss: Annotated[float, typer.Option("--frame-loss", help="Share of frames not sent.")] = 0.0,
    swapped: Annotated[float, typer.Option("--swapped", help="Share of frames sent after the next.")] = 0.0,
    garbled: Annotated[float, typer.Option("--garbled", help="Share of packets that are malformed.")] = 0.0,
    delay_s: Annotated[float, typer.Option("--delay-s", help="Frames are late by up to this.")] = 0.0,
    freeze_at: Annotated[
        int | None, typer.Option("--freeze-at", metavar="K", help="From exposure K on, one picture for ever.")
    ] = None,
    stall_at: Annotated[
        int | None, typer.Option("--stall-at", metavar="K", help="No frames from exposure K on.")
    ] = None,
    disconnect_at: Annotated[
        int | None, typer.Option("--disconnect-at", metavar="K", help="Unplugged at exposure K.")
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Serve frames as a GigE Vision camera, to any client that can take one.

    Exposure k shows what the twin's camera sees at its exposure k, noise and all; the same seed gives the
    same frames. UDP port 3956 is the standard's; keep to 127.x.x.x unless others shall see it.

    Examples: adof emulate camera --twin 7 --camera both | adof emulate camera --images run.tif --swapped 0.1
    """
    from adof_cl.errors import InputError
    from adof_drivers.emulators.gige import Faults, GigeCameraEmulator

    if which not in ("1", "2", "both"):
        raise InputError(f"--camera is '{which}': choose 1, 2 or both")
    try:
        first = ipaddress.IPv4Address(address)
    except ValueError:
        raise InputError(f"--address is '{address}': an IPv4 address such as 127.0.0.1 was wanted") from None
    if seconds is not None and not seconds > 0:
        raise InputError(f"--seconds is {seconds:g}: more than 0 was wanted")
    faults = Faults(
        seed=fault_seed,
        packet_loss=packet_loss,
        frame_loss=frame_loss,
        swapped=swapped,
        garbled=garbled,
        delay_s=delay_s,
        freeze_at=freeze_at,
        stall_at=stall_at,
        disconnect_at=disconnect_at,
    )
    numbers = (1, 2) if which == "both" else (int(which),)
    if images is not None:
        served = [_recorded(images) for _ in numbers]
        name = str(images)
    else:
        served = _seen(twin, numbers, alpha, device, region=region)
        name = f"twin {twin}"
    addresses = [str(first + index) for index in range(len(numbers))]
    ended = threading.Event()
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda *_: ended.set())
    with ExitStack() as running:
        emulators = [
            running.enter_context(
                GigeCameraEmulator(
                    source,
                    shape,
                    address=here,
                    siblings=[other for other in addresses if other != here],
                    pixel_format="Mono16" if sixteen_bit else "Mono8",
                    rate_hz=rate_hz,
                    faults=faults,
                )
            )
            for here, (source, shape, sixteen_bit) in zip(addresses, served, strict=True)
        ]
        for number, here, (_, shape, sixteen_bit) in zip(numbers, addresses, served, strict=True):
            print(
                f"camera {number} of {name}: GigE Vision at {here}, {shape[1]} x {shape[0]}, "
                f"{16 if sixteen_bit else 8} bits, {rate_hz:g} Hz; Ctrl-C ends it",
                flush=True,
            )
        left_s = seconds
        while not ended.wait(0.1 if left_s is None else min(0.1, max(left_s, 0.0))):
            left_s = None if left_s is None else left_s - 0.1
            if any(one.failure for one in emulators) or (left_s is not None and left_s <= 0):
                break
    for here, emulator in zip(addresses, emulators, strict=True):
        print(f"{here}: {emulator.sent} frames sent, {emulator.resent} packets sent again")


def _recorded(path: Path) -> tuple[Source, tuple[int, int], bool]:
    """Pictures in a circle."""
    from adof_drivers.errors import EndOfSequenceError
    from adof_drivers.image_sequence import ImageSequenceCamera

    sequence = ImageSequenceCamera(path)
    first = sequence.grab()
    sequence.start()

    def next_picture(_number: int, region: Region) -> Any:
        try:
            frame = sequence.grab()
        except EndOfSequenceError:
            sequence.start()
            frame = sequence.grab()
        (y, x), (rows, columns) = region
        return frame.pixels[y : y + rows, x : x + columns]

    return next_picture, sequence.shape, first.pixels.dtype.itemsize == 2


def _seen(
    seed: int, numbers: tuple[int, ...], alpha: float, device: str | None, *, region: bool
) -> list[tuple[Source, tuple[int, int], bool]]:
    """What cameras of one twin see; they share its world and its clock."""
    from adof_cl import twin as twins

    twin = twins.build(seed)
    if alpha:
        _show_mask(twin, alpha, device)
    shape = (twin.design.rows, twin.design.columns)
    origin_yx = (0, 0)
    if region:
        shape = (twin.design.region_rows, twin.design.region_columns)
        origin_yx = twin.design.region_origin_yx
    one_at_a_time = threading.Lock()

    def source(seeing: SimulatedCamera) -> Source:
        def expose(_number: int, wanted: Region) -> Any:
            (y, x), size = wanted
            with one_at_a_time:
                seeing.set_region((origin_yx[0] + y, origin_yx[1] + x), size)
                return seeing.grab().pixels

        return expose

    cameras = {1: twin.camera_1, 2: twin.camera_2}
    return [(source(cameras[number]), shape, False) for number in numbers]


def _show_mask(twin: Twin, alpha: float, device: str | None) -> None:
    from adof_cl.device import Device
    from adof_cl.optics import Mask
    from adof_cl.slm_encode import SlmEncode

    encode = SlmEncode(Device.open(device), twin.design.panel, twin.design.optics_1)
    twin.slm.show(encode.codes(Mask(alpha)))
    twin.clock.wait(twin.design.settling_s)
