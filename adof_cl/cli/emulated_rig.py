"""The twin behind real protocols: a process whose world is moved and seen through the wire alone.

    stages   two emulated GCS controllers on TCP ports; the world stands where their motors are
    cameras  two emulated GigE Vision cameras on 127.0.0.1 and 127.0.0.2; they send what the world looks like
    panel    a virtual X display; the light passes what its frame buffer shows
    hands    pedal and SpaceMouse byte by byte, in the loop's own process, for HID needs a kernel

The loop's process knows the addresses. Only its report may ask the world for the truth.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adof_cl.errors import InputError
from adof_cl.twin import Clock, Contact, Design, RecordedStage, SimulatedCamera, SimulatedSlm, Truth, lit
from adof_drivers.emulators.gcs import GcsEngine
from adof_drivers.emulators.gige import GigeCameraEmulator, Region, TriggerLine
from adof_drivers.emulators.hid import EmulatedHid, EmulatedSpaceMouse
from adof_drivers.emulators.serve import Served
from adof_drivers.errors import DriverError
from adof_drivers.operator import ENABLE, START
from adof_drivers.pedal import StopPedal
from adof_drivers.spacemouse import SpaceMouse

ADDRESSES = ("127.0.0.1", "127.0.0.2")
_SAMPLE_S = 0.002
_ADVANCE_S = 0.02  # between looks for contacts, each of which looks back in steps of 1 ms
_PANEL_S = 0.002
_SEEN_PX = 7  # every so manyth pixel tells that a pattern has changed
_TRAVEL_MM = 12.5
_SPEED_MM_PER_S = 20.0
_ACCELERATION_MM_PER_S2 = 200.0
# Wire units: mm, degrees.
_UNITS = {"theta": math.pi / 180}
_SETTLING_MARGIN_S = 0.02  # the X server's, and what it takes the world to notice
_WORLD_STARTS_S = 60.0
_HELD_S = 0.2  # how long a finger stays on a button


class _Monotonic:
    """The machine's time, for a world that wants to be told of it."""

    def __init__(self) -> None:
        self._listeners: list[Callable[[float, float], None]] = []
        self._told_s = self.now_s

    @property
    def now_s(self) -> float:
        """Monotonic seconds."""
        return time.monotonic()

    def on_advance(self, listener: Callable[[float, float], None]) -> None:
        """Have this called with each interval."""
        self._listeners.append(listener)

    def advance(self) -> None:
        """Tell of the time that has passed."""
        before_s, self._told_s = self._told_s, self.now_s
        for listener in self._listeners:
            listener(before_s, self._told_s)


class _Controller(GcsEngine):
    """A controller whose motors are looked at while it is talked to."""

    def __init__(self, names: list[str]) -> None:
        self._one = threading.Lock()
        super().__init__(
            names,
            now_s=time.monotonic,
            travel=(-_TRAVEL_MM, _TRAVEL_MM),
            speed=_SPEED_MM_PER_S,
            acceleration=_ACCELERATION_MM_PER_S2,
        )

    def feed(self, data: bytes) -> list[Any]:
        """Take bytes."""
        with self._one:
            return super().feed(data)

    def sample(self) -> dict[str, float]:
        """Return where the axes are, um or rad."""
        with self._one:
            return {name: value * _UNITS.get(name, 1000.0) for name, value in self.position.items()}


class FrameBuffer:
    """What a virtual X display shows, from the file it keeps its picture in (X window dump, 32 bits a pixel).

    Raises
    ------
    InputError
        A dump of another kind.
    """

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            head = struct.unpack(">25I", file.read(100))
        header, order, bits, line, colours = head[0], head[7], head[11], head[12], head[19]
        columns, rows = head[4], head[5]
        if bits != 32 or order != 0:
            raise InputError(f"the display has {bits} bits a pixel, order {order}: 32 and 0 were wanted")
        self._pixels = np.memmap(
            path, np.uint8, mode="r", offset=header + 12 * colours, shape=(rows, line // 4, 4)
        )[:, :columns]
        self._coarse = self._glance()

    def _glance(self) -> NDArray[np.uint8]:
        return np.array(self._pixels[::_SEEN_PX, ::_SEEN_PX])

    def changed(self) -> bool:
        """Whether it shows something else than when this was last asked."""
        before, self._coarse = self._coarse, self._glance()
        return not np.array_equal(before, self._coarse)

    def codes(self) -> NDArray[np.uint8] | None:
        """Return what it shows as codes; None where it is no grey, or is being drawn."""
        first = np.array(self._pixels[..., :3])
        grey = first[..., 0]
        if (first != grey[..., None]).any() or not np.array_equal(first, self._pixels[..., :3]):
            return None
        return np.ascontiguousarray(grey)


class _World:
    """The process: engines, cameras, panel and the world between them."""

    def __init__(self, seed: int, buffer: Path, rate_hz: float) -> None:
        self.design = design = Design()
        self.clock = _Monotonic()
        self.engines = {"coarse": _Controller(list(design.coarse)), "fine": _Controller(list(design.fine))}
        now_s = self.clock.now_s
        self.stages = {name: RecordedStage(e.motors, now_s) for name, e in self.engines.items()}
        self.slm = SimulatedSlm(design.panel, design.optics_1.aperture_um, self.clock, design.settling_s)
        self.buffer = FrameBuffer(buffer)
        self.world = lit(seed, design, self.clock, self.stages["coarse"], self.stages["fine"], self.slm)
        self.line = TriggerLine()
        self.cameras = [
            GigeCameraEmulator(
                self._source(SimulatedCamera(number, self.world, Clock(), seed)),
                (design.rows, design.columns),
                address=address,
                siblings=[other for other in ADDRESSES if other != address],
                rate_hz=rate_hz,
                exposure_us=1e6 * design.exposure_s,
                line=self.line,
            )
            for number, address in enumerate(ADDRESSES, start=1)
        ]
        self._looking = threading.Lock()
        self._looked_s, self._pending = now_s, True
        self._sampling = threading.Lock()
        self.closing = threading.Event()
        self.threads = [
            threading.Thread(target=work, daemon=True) for work in (self.record, self.watch_panel)
        ]

    def _source(self, camera: SimulatedCamera) -> Callable[[int, Region], NDArray[np.uint8]]:
        def expose(number: int, region: Region) -> NDArray[np.uint8]:
            start_s = self.line.moment_s
            time.sleep(max(0.0, start_s + self.design.exposure_s - time.monotonic()))
            # However late this is: where everything stood and what was shown meanwhile is known.
            self.sample()
            self.look()
            camera.set_region(*region)
            return camera.expose(number, start_s)

        return expose

    def __enter__(self) -> _World:
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.closing.set()
        for thread in self.threads:
            thread.join()

    def record(self) -> None:
        """Sample every axis, and let the world look for contacts."""
        due_s = 0.0
        while not self.closing.wait(_SAMPLE_S):
            self.sample()
            if (now_s := self.clock.now_s) >= due_s:
                self.clock.advance()
                due_s = now_s + _ADVANCE_S

    def sample(self) -> None:
        """Record where every axis is."""
        with self._sampling:
            for name, engine in self.engines.items():
                self.stages[name].add(self.clock.now_s, engine.sample())

    def watch_panel(self) -> None:
        """Look at the display all the time."""
        while not self.closing.wait(_PANEL_S):
            self.look()

    def look(self) -> None:
        """Pass on to the light what the display shows, if it shows something else than before.

        It does so since the last look: late or not, the panel has its full time to settle.
        """
        with self._looking:
            before_s, self._looked_s = self._looked_s, self.clock.now_s
            self._pending = self.buffer.changed() or self._pending
            if not self._pending or (codes := self.buffer.codes()) is None:
                return
            with suppress(InputError):  # caught between two patterns
                self.slm.show(codes, since_s=before_s)
                self._pending = False

    @property
    def moved_s(self) -> float:
        """When an axis was last seen to move."""
        return max(axis.moved_s for stage in self.stages.values() for axis in stage.axes.values())

    def answer(self, question: str, arguments: tuple[Any, ...]) -> Any:
        """Return a part of the truth."""
        asked = getattr(self if question == "moved_s" else self.world, question)
        return asked(*arguments) if callable(asked) else asked


@contextmanager
def _display(design: Design, folder: Path) -> Iterator[str]:
    """A virtual X display of the panel's size, its frame buffer a file; yields its name."""
    if shutil.which("Xvfb") is None:
        raise InputError("the emulated panel needs Xvfb: install it (Debian: apt-get install xvfb)")
    reading, writing = os.pipe()
    screen = f"{design.panel.columns}x{design.panel.rows}x24"
    with subprocess.Popen(  # noqa: S603  (our own words alone)
        [  # noqa: S607  (wherever this system has it)
            "Xvfb", "-displayfd", str(writing), "-screen", "0", screen, "-fbdir", str(folder),
            "-nolisten", "tcp", "-noreset",
        ],
        pass_fds=[writing],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is not its business
    ) as process:  # fmt: skip
        os.close(writing)
        try:
            with os.fdopen(reading) as told:
                number = told.readline().strip()
            if not number:
                raise InputError("Xvfb does not start here: run it by hand and see what it says")
            yield f":{number}"
        finally:
            process.terminate()


def _serve(seed: int, rate_hz: float, pipe: Connection) -> None:
    """Be the world until the pipe closes, which it does however the other process ends."""
    sys.setswitchinterval(1e-3)  # many threads that each want to be on time
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the loop's: it still has to ask for the truth
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        with ExitStack() as running:
            folder = Path(running.enter_context(TemporaryDirectory(prefix="adof-panel-")))
            display = running.enter_context(_display(Design(), folder))
            world = _World(seed, folder / "Xvfb_screen0", rate_hz)
            ports = {
                name: running.enter_context(Served.tcp(engine)).address
                for name, engine in world.engines.items()
            }
            for camera in world.cameras:
                running.enter_context(camera)
            running.enter_context(world)
            pipe.send((display, ports))
            with suppress(EOFError):
                while True:
                    question, arguments = pipe.recv()
                    pipe.send(world.answer(question, arguments))
    except (InputError, DriverError) as refusal:
        with suppress(OSError):
            pipe.send(refusal)


class RemoteWorld:
    """The truth, asked of the other process; the loop must never be given it."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe

    def _ask(self, question: str, *arguments: object) -> Any:
        self._pipe.send((question, arguments))
        return self._pipe.recv()

    def truth(self, time_s: float | None = None) -> Truth:
        """Return what is so now, or was at `time_s`."""
        answer: Truth = self._ask("truth", time_s)
        return answer

    def corners_px(self, camera: int, part: str, time_s: float | None = None) -> NDArray[np.float64]:
        """Return where the corners of a part fall on a camera's whole sensor (4, 2), (x, y)."""
        return np.asarray(self._ask("corners_px", camera, part, time_s))

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Every moment at which the solids began to overlap."""
        answer: tuple[Contact, ...] = self._ask("contacts")
        return answer

    @property
    def moved_s(self) -> float:
        """When an axis was last seen to move, monotonic."""
        return float(self._ask("moved_s"))


class Hands:
    """An operator's hands on emulated HID devices."""

    def __init__(self) -> None:
        self._pedal, self._mouse = EmulatedHid(), EmulatedSpaceMouse(joined=True)
        self.pedal, self.spacemouse = StopPedal(self._pedal), SpaceMouse(self._mouse)
        self.pressed_s: float | None = None

    def press_pedal(self) -> None:
        """Step on the pedal, and stay on it."""
        self.pressed_s = time.monotonic()
        self._pedal.send(b"\x01")

    def release_pedal(self) -> None:
        """Let go of it."""
        self._pedal.send(b"\x00")

    def enable(self) -> None:
        """Press and release the enable switch."""
        self._mouse.press(ENABLE)
        time.sleep(_HELD_S)
        self._mouse.press()

    def jog_and_start(self) -> None:
        """Jog a little in x and y, let go, and start."""
        for _ in range(20):
            self._mouse.deflect(175, -175, 0)
            time.sleep(0.016)
        self._mouse.deflect(0, 0, 0)
        time.sleep(0.1)
        self._mouse.press(START)
        time.sleep(_HELD_S)
        self._mouse.press()


@dataclass(frozen=True)
class EmulatedRig:
    """Where everything is, the truth, and the operator's hands."""

    text: str
    world: RemoteWorld
    hands: Hands


@contextmanager
def emulated(seed: int, *, rate_hz: float, operators: bool = True) -> Iterator[EmulatedRig]:
    """Run the twin of a seed behind its protocols; DISPLAY is the panel's meanwhile.

    With `operators` its file names the devices that `Hands` hold.

    Raises
    ------
    InputError
        Xvfb is not installed, or does not start.
    DriverError
        The cameras' addresses are taken.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(seed, rate_hz, there), daemon=True)
    process.start()
    there.close()
    before = os.environ.get("DISPLAY")
    try:
        if not here.poll(_WORLD_STARTS_S):
            raise InputError(f"the emulated rig did not start within {_WORLD_STARTS_S:g} s: try again")
        try:
            answer = here.recv()
        except EOFError:
            raise InputError("the emulated rig ended at once: look at what it printed") from None
        if isinstance(answer, Exception):
            raise answer
        os.environ["DISPLAY"], ports = answer
        text = rig_text(Design(), ports, rate_hz, operators=operators)
        yield EmulatedRig(text, RemoteWorld(here), Hands())
    finally:
        os.environ.pop("DISPLAY", None)
        if before is not None:
            os.environ["DISPLAY"] = before
        _end(process, here)


def _end(process: Any, pipe: Connection) -> None:
    pipe.close()
    process.join(5.0)
    if process.is_alive():
        process.kill()
        process.join()


def rig_text(design: Design, ports: dict[str, str], rate_hz: float, *, operators: bool = True) -> str:
    """Return the rig file of the emulated rig."""
    (row, column), panel = design.region_origin_yx, design.panel
    lines = []
    for number, address in enumerate(ADDRESSES, start=1):
        lines += [
            f"[camera.{number}]",
            'driver = "gige"',
            f'address = "{address}"',
            f"rate_hz = {float(rate_hz)}",
            f"exposure_s = {design.exposure_s}",
            f"first_row = {row}",
            f"first_column = {column}",
            f"rows = {design.region_rows}",
            f"columns = {design.region_columns}",
            "",
        ]
    lines += [
        f"[slm.{panel.name}]",
        'driver = "window"',
        "monitor = 0",
        "require_pacing = false",
        f"rows = {panel.rows}",
        f"columns = {panel.columns}",
        f"pitch_um = {panel.pitch_um}",
        f"fill_factor = {panel.fill_factor}",
        f"refresh_hz = {panel.frame_rate_hz}",
        f"settling_s = {design.settling_s + _SETTLING_MARGIN_S}",
        "",
    ]
    if operators:
        lines += ["[operator.pedal]", 'driver = "pedal"', "", "[operator.puck]", 'driver = "spacemouse"', ""]
    for stage, axes in (("coarse", design.coarse), ("fine", design.fine)):
        lines += [f"[stage.{stage}]", 'driver = "gcs"', f'tcp = "{ports[stage]}"']
        for name, axis in axes.items():
            unit = "rad" if name == "theta" else "um"
            lines += [
                f"[stage.{stage}.axes.{name}]",
                f'wire = "{name}"',
                f"{unit}_per_unit = {_UNITS.get(name, 1000.0)!r}",
                f"speed_limit_{unit}_per_s = {axis.speed_limit}",
                f"resolution_{unit} = {axis.resolution}",
                f"low_{unit} = {axis.low}",
                f"high_{unit} = {axis.high}",
            ]
        lines.append("")
    return "\n".join(lines)
