"""`adof run`: the whole assembly, on the twin or on a rig."""

from __future__ import annotations

import dataclasses
import html
import json
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from adof_cl.cli.devices import DeviceOption
from adof_cl.errors import AdofError, InputError
from adof_cl.record import RunRecord, finite_json
from adof_drivers.errors import DriverError

if TYPE_CHECKING:
    from adof_cl.cli.emulated_rig import RemoteWorld
    from adof_cl.cli.progress import Live
    from adof_cl.device import Device
    from adof_cl.loop import Options, Rig
    from adof_cl.record import Iteration
    from adof_cl.replan import Budget
    from adof_cl.stereo import StereoRig
    from adof_cl.survey import ArmResult
    from adof_cl.twin import Design, Twin, World


def run(
    seed: Annotated[
        int, typer.Option("--seed", min=0, help="Draws the start, the rig's hidden errors and all noise.")
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Run folder, new or empty; default: runs/TIME-seed-N."),
    ] = None,
    mask: Annotated[
        str, typer.Option("--mask", help="joint: cubic and focus chosen together; paper: Eq. 4; fixed.")
    ] = "joint",
    compare: Annotated[
        bool, typer.Option("--compare", help="First measure every arm of the paper's Tables 2 and 3.")
    ] = False,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            metavar="FILE",
            help="Use the calibration.json of an earlier run of this rig (seed).",
        ),
    ] = None,
    max_error_um: Annotated[
        float | None,
        typer.Option(
            "--max-error-um", metavar="E", help="Plan each frame: no feature farther off when docking."
        ),
    ] = None,
    max_ms: Annotated[
        float | None,
        typer.Option(
            "--max-ms", metavar="T", help="Plan each frame: the most precise within T ms of compute."
        ),
    ] = None,
    profile: Annotated[
        Path | None,
        typer.Option(
            "--profile", metavar="FILE", help="For plans; default: the device's own, of adof tradeoff."
        ),
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option(
            "--rig",
            metavar="FILE",
            help="Run on the rig of this file; 'emulated': on the twin behind real protocols.",
        ),
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option("--rate-hz", help="Frames a second of the emulated cameras; default 60.")
    ] = None,
    press_pedal_at: Annotated[
        int | None,
        typer.Option("--press-pedal-at", metavar="N", min=0, help="Emulated: step on it in iteration N."),
    ] = None,
    home: Annotated[
        bool, typer.Option("--home", help="Let axes that do not know where they are find their references.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="The way is clear: do not ask where no SpaceMouse enables.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print metrics.json at the end.")] = False,
    device: DeviceOption = None,
) -> None:
    """Assemble peg and hole on the twin: autofocus, templates, calibration, coarse, fine, insertion.

    Writes metrics.json, iterations.json, calibration.json, figures and report.html (one file, opens without a
    server). Exits 0 when docked, 1 when the run ended otherwise, 130 on Ctrl-C; the folder is complete up to
    that moment.

    With a budget, mask, windows and search are planned anew for every frame: far, cheap; near, fine.

    With --rig FILE on real devices (docs/rig.md): the SpaceMouse's first button enables, the puck jogs, the
    second button starts; the pedal stops. With --rig emulated every byte crosses a real protocol.

    Examples: adof run | adof run --seed 7 --out seven --compare | adof run --max-error-um 2 --json |
    adof run --rig emulated --rate-hz 30 | adof run --rig rig.toml --home
    """
    from adof_cl.calibration_file import load_rig
    from adof_cl.cli.progress import Live
    from adof_cl.device import Device
    from adof_cl.loop import Options

    emulated = rig == "emulated"
    _require_fitting(rig, emulated=emulated, compare=compare, rate_hz=rate_hz, press_pedal_at=press_pedal_at)
    name = f"twin {seed}" if rig is None else f"emulated rig {seed}" if emulated else str(rig)
    options = Options(mask=mask, rig_name=name, budget=_budget(max_error_um, max_ms, profile, device))
    known = None if calibration is None else load_rig(calibration, camera_ids=options.camera_ids)
    opened = Device.open(device)
    if rig is not None and not emulated:
        from adof_cl.cli.live_rig import TABLES, require_whole
        from adof_drivers.rig import load

        require_whole(load(Path(rig), tables=TABLES))
    folder = _folder(out, name.replace(" ", "-") if rig is None or emulated else Path(name).stem)
    with Live(f"adof run, {name}, {opened.facts}") as live, ExitStack() as stack:
        if rig is None:
            scene = _twin_scene(seed)
        elif emulated:
            scene = stack.enter_context(_emulated_scene(seed, rate_hz or 60.0, press_pedal_at, folder, live))
        else:
            scene = stack.enter_context(_file_scene(Path(rig), live, home=home, yes=yes))
        run = _Run(scene, opened, options, folder)
        refusal = run.carry_out(known, live, compare=compare)
    record = run.record
    if as_json:
        print(json.dumps(finite_json(record.metrics()), indent=2))
    else:
        _print_summary(record, run.arms, folder)
    if refusal:
        print(f"adof: {refusal}", file=sys.stderr)
    if not record.docked:
        raise typer.Exit(1)


def _require_fitting(
    rig: str | None,
    *,
    emulated: bool,
    compare: bool,
    rate_hz: float | None,
    press_pedal_at: int | None,
) -> None:
    """Refuse options that say nothing on this rig."""
    for option, given in (("--rate-hz", rate_hz), ("--press-pedal-at", press_pedal_at)):
        if given is not None and not emulated:
            raise InputError(f"{option} is the emulated rig's: give --rig emulated with it")
    if rate_hz is not None and not 1 <= rate_hz <= 200:
        raise InputError(f"--rate-hz is {rate_hz:g}: 1 to 200 was wanted")
    if compare and rig is not None:
        raise InputError("--compare asks the twin for the truth of every frame: leave --rig out")


@dataclass
class Scene:
    """What is driven, how it was drawn, and the world, where there is one that can be asked.

    `finished` is called when all is said and done, and adds what the rig has to say to the record.
    """

    seed: int | None
    rig: Rig
    design: Design
    world: World | RemoteWorld | None
    real_time: bool = False
    begun: Callable[[RunRecord], None] = lambda _record: None
    observed: Callable[[Iteration], None] = lambda _iteration: None
    finished: Callable[[RunRecord], None] = lambda _record: None


class _Run:
    """One run and what it leaves in its folder."""

    def __init__(self, scene: Scene, device: Device, options: Options, folder: Path) -> None:
        self.record = RunRecord(scene.seed, str(device.facts), real_time=scene.real_time)
        self.arms: list[ArmResult] = []
        self._scene, self._device, self._options, self._folder = scene, device, options, folder
        self._truth = None if scene.world is None else Truth(scene, self.record, options)

    def carry_out(self, known: StereoRig | None, live: Live, *, compare: bool) -> str:
        """Assemble, and write the folder however it ends; returns why it ended early, or nothing."""
        begun = time.perf_counter()
        record, scene = self.record, self._scene
        try:
            self._assemble(known, live, compare=compare)
        except (AdofError, DriverError) as failure:
            record.end_state = f"stopped: {failure}"
            return str(failure)
        finally:
            record.wall_s = time.perf_counter() - begun
            if self._truth is not None:
                self._truth.finish()
            scene.finished(record)
            _write(self._folder, record, self.arms)
        return ""

    def _assemble(self, known: StereoRig | None, live: Live, *, compare: bool) -> None:
        from adof_cl.calibration_file import save_calibration
        from adof_cl.loop import HOLE, PEG, PEG_OVER_HOLE, Assembly
        from adof_cl.survey import survey
        from adof_cl.twin.parts import drawing_of

        live.tell("start", "kernels are compiled once for each device, which takes seconds")
        scene, truth = self._scene, self._truth

        def observe(iteration: Iteration, time_s: float) -> Iteration:
            scene.observed(iteration)
            return iteration if truth is None else truth.observe(iteration, time_s)

        assembly = Assembly(
            self._device,
            scene.rig,
            scene.design,
            {
                PEG: drawing_of(scene.design.peg),
                PEG_OVER_HOLE: drawing_of(scene.design.peg, over_hole=True),
                HOLE: drawing_of(scene.design.hole),
            },
            self.record,
            options=self._options,
            progress=live.tell,
            observer=observe,
            milestone=None if truth is None else truth.reached,
        )
        with assembly.stages_stopped_afterwards():
            scene.begun(self.record)
            assembly.prepare(known)
            assert assembly.stereo is not None
            save_calibration(self._folder / "calibration.json", assembly.stereo)
            if compare:
                assert truth is not None
                self.arms = survey(assembly, truth.hole_px, progress=live.tell)
            assembly.assemble()


def _twin_scene(seed: int) -> Scene:
    from adof_cl import twin as twins

    twin = twins.build(seed)
    for camera in (twin.camera_1, twin.camera_2):
        camera.set_centred_region()
    return Scene(seed, twin, twin.design, twin.world)


@contextmanager
def _emulated_scene(
    seed: int, rate_hz: float, press_pedal_at: int | None, folder: Path, live: Live
) -> Iterator[Scene]:
    """The twin in a process of its own, its operator's hands in this one."""
    from adof_cl.cli import live_rig
    from adof_cl.cli.emulated_rig import emulated
    from adof_drivers.rig import load

    live.tell("rig", "emulated cameras, stages and panel are started")
    with emulated(seed, rate_hz=rate_hz) as there:
        file = folder / "rig.toml"
        file.write_text(there.text, encoding="utf-8")
        hands, sections = there.hands, load(file, tables=live_rig.TABLES)
        instead = {"operator.pedal": hands.pedal, "operator.puck": hands.spacemouse}
        with live_rig.opened(sections, instead=instead) as rig:

            def begun(_record: RunRecord) -> None:
                threading.Thread(target=hands.enable, daemon=True).start()
                jogging = threading.Thread(target=hands.jog_and_start, daemon=True)
                live_rig.start(rig, sections, live.tell, home=True, yes=True, enabled=jogging.start)

            def observed(iteration: Iteration) -> None:
                if iteration.number == press_pedal_at:
                    hands.press_pedal()

            def finished(record: RunRecord) -> None:
                live_rig.account(rig, record)
                if hands.pressed_s is None or rig.operator.stopped_s is None:
                    return
                rig.coarse.wait_until_still()
                rig.fine.wait_until_still()
                record.rig["stop"] = {
                    "pressed_to_sent_ms": 1e3 * (rig.operator.stopped_s - hands.pressed_s),
                    "pressed_to_rest_ms": 1e3 * max(there.world.moved_s - hands.pressed_s, 0.0),
                }

            yield Scene(seed, rig, rig.design, there.world, real_time=True, begun=begun, observed=observed,
                        finished=finished)  # fmt: skip


@contextmanager
def _file_scene(file: Path, live: Live, *, home: bool, yes: bool) -> Iterator[Scene]:
    """A rig as its file names it."""
    from adof_cl.cli import live_rig
    from adof_drivers.rig import load

    sections = load(file, tables=live_rig.TABLES)
    live.tell("rig", f"devices of {file} are opened")
    with live_rig.opened(sections) as rig:
        yield Scene(
            None,
            rig,
            rig.design,
            None,
            real_time=True,
            begun=lambda _record: live_rig.start(rig, sections, live.tell, home=home, yes=yes),
            finished=lambda record: live_rig.account(rig, record),
        )


def _budget(
    max_error_um: float | None, max_ms: float | None, profile: Path | None, device: str | None
) -> Budget | None:
    """Return what the loop's frames may cost, or None where nothing was asked."""
    if max_error_um is None and max_ms is None:
        if profile is not None:
            raise InputError("--profile came without a budget: give --max-error-um or --max-ms with it")
        return None
    from adof_cl.cli.profiles import planner_for
    from adof_cl.optics import require_positive
    from adof_cl.replan import Budget

    for name, value in (("max_error_um", max_error_um), ("max_ms", max_ms)):
        if value is not None:
            require_positive(**{name: value})
    return Budget(planner_for(profile, device), max_error_um, max_ms)


class Truth:
    """Adds to the record what only the twin's world knows; the loop never sees it."""

    def __init__(self, twin: Twin | Scene, record: RunRecord, options: Options) -> None:
        assert twin.world is not None
        self._world = twin.world
        self._options = options
        self._record = record
        self._origin_xy = np.array(twin.design.region_origin_yx[::-1], dtype=np.float64)

    def hole_px(self, time_s: float) -> NDArray[np.float64]:
        """Return where the hole's middle is seen by camera 1, region of interest, (x, y)."""
        corners = self._world.corners_px(1, "hole", time_s)
        return np.asarray(corners.mean(axis=0) - self._origin_xy)

    def observe(self, iteration: Iteration, time_s: float) -> Iteration:
        """Fill in one iteration's truth."""
        truth = self._world.truth(time_s)
        bias = np.array(iteration.hole_xy_px) - self.hole_px(time_s)
        return dataclasses.replace(
            iteration,
            hole_bias_px=(float(bias[0]), float(bias[1])),
            true_error_x_um=truth.offset_um[0],
            true_error_y_um=truth.offset_um[1],
            true_error_theta_rad=truth.offset_rad,
            true_depth_um=truth.depth_um,
            true_hole_xyz_um=(truth.hole.x_um, truth.hole.y_um, truth.hole.z_um),
        )

    def reached(self, stage: str) -> None:
        """Keep the error at the end of a stage."""
        errors = self._errors()
        if stage == "coarse":
            self._record.coarse_error = errors
        elif stage == "fine":
            self._record.fine_error = errors

    def finish(self) -> None:
        """Keep the errors and contacts at the end of the run."""
        self._record.final_error = self._errors()
        self._record.contacts = len(self._world.contacts)
        if self._record.contacts:
            self._record.docked = False
            self._record.end_state += "; the parts touched"

    def _errors(self) -> dict[str, float]:
        truth = self._world.truth()
        stage = self._record.iterations[-1].stage if self._record.iterations else "coarse"
        wanted = self._options.seat_um if stage == "insert" else self._options.stand_off_um
        return {
            "x": truth.offset_um[0],
            "y": truth.offset_um[1],
            "z": truth.depth_um - wanted,
            "theta": truth.offset_rad,
        }


def _folder(out: Path | None, name: str) -> Path:
    folder = out or Path("runs") / f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{name}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise InputError(f"{folder} already holds files: choose a new or empty folder")
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as failure:
        raise InputError(
            f"{folder} cannot be written ({failure.strerror}): choose another folder"
        ) from failure
    return folder


def _write(folder: Path, record: RunRecord, arms: Sequence[ArmResult]) -> None:
    from adof_cl.files import whole_file
    from adof_cl.record import write_metrics
    from adof_cl.report import write_report

    write_metrics(record, folder)
    extra = ""
    if arms:
        with whole_file(folder / "compare.json") as temporary:
            rows = [finite_json(arm.as_dict()) for arm in arms]
            temporary.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
        extra = f"<h2>Tables 2 and 3, every column</h2><pre>{html.escape(comparison(arms))}</pre>"
    write_report(record, folder, extra)


def comparison(arms: Sequence[ArmResult]) -> str:
    """Return the paper's Tables 2 and 3 with all columns, and the error that the score does not show."""
    from adof_cl.survey import ARMS, PAPER_HOLE, PAPER_PEG

    positions = list(dict.fromkeys(arm.position for arm in arms))
    of = {(arm.position, arm.arm.name): arm for arm in arms}
    depth = {arm.position: arm.depth_um for arm in arms}
    heads = [
        "no mask",
        "fixed 80 focus",
        "fixed 80 own",
        "adaptive focus",
        "adaptive own",
        "ours",
    ]

    def table(title: str, cell: str, paper: dict[str, dict[str, float]]) -> list[str]:
        head = f"{'':3}{'depth':>6}" + "".join(f"{h:>16}" for h in heads)
        head += "".join(f"{'paper ' + name:>16}" for name in paper)
        lines = [title, head]
        for p in positions:
            line = f"{p:3}{depth[p]:6.0f}"
            line += "".join(f"{getattr(of[p, arm.name], cell):16.2f}" for arm in ARMS)
            line += "".join(f"{_or_dash(column.get(p)):>16}" for column in paper.values())
            lines.append(line)
        return [*lines, ""]

    lines = table(
        "Table 2. Minimum SSD on the hole (sum over 20 x 20 pixels, grey in [0, 1])",
        "ssd_hole",
        {"adaptive": dict(PAPER_HOLE["adaptive"]), "none": dict(PAPER_HOLE["none"])},
    )
    lines += table(
        "Table 3. Minimum SSD on the peg",
        "ssd_peg",
        {"adaptive": dict(PAPER_PEG["adaptive"]), "fixed": dict(PAPER_PEG["fixed"])},
    )
    lines.append(
        "What the SSD does not show: where the hole was measured less where it is, px along x and y,"
    )
    lines.append("and in brackets the shift predicted for that filter (* : |psi|/(3 alpha) of 0.5 or more)")
    lines.append(f"{'':3}{'depth':>6}" + "".join(f"{h:>24}" for h in heads))
    for p in positions:
        line = f"{p:3}{depth[p]:6.0f}"
        for arm in ARMS:
            result = of[p, arm.name]
            star = "*" if result.defocus_share >= 0.5 else ""
            predicted = f" ({result.predicted_shift_px:.2f}{star})" if arm.filter == "focus" else ""
            line += f"{f'{result.bias_px[0]:.2f} {result.bias_px[1]:.2f}{predicted}':>24}"
        lines.append(line)
    lost = ", ".join(f"{a.position} {a.arm.name}" for a in arms if a.lost)
    lines.append(f"A run would have refused features at: {lost or 'none'}.")
    return "\n".join(lines)


def _or_dash(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _print_summary(record: RunRecord, arms: Sequence[ArmResult], folder: Path) -> None:
    metrics = record.metrics()
    if arms:
        print(comparison(arms) + "\n")
    print(f"{record.end_state} after {len(record.iterations)} iterations, {record.wall_s:.1f} s")
    for title, errors in (
        ("coarse", record.coarse_error),
        ("fine", record.fine_error),
        ("final", record.final_error),
    ):
        if errors:
            print(
                f"{title:>7}: x {errors['x']:+.2f}  y {errors['y']:+.2f}  z {errors['z']:+.2f} µm  "
                f"θ {1e3 * errors['theta']:+.2f} mrad off"
            )
    for p in record.positions:
        known = math.isfinite(p.lateral_bias_um[0])  # to the twin alone
        depth = f"depth {p.depth_um:6.1f} µm, estimated" if known else "depth"
        bias = f", bias {p.lateral_bias_um[0]:+.2f} {p.lateral_bias_um[1]:+.2f} µm" if known else ""
        print(
            f"      {p.name}: {depth} {p.depth_est_um:6.1f} ± {p.depth_sigma_um:.1f} µm, α {p.alpha:5.2f}, "
            f"SSD hole {p.ssd_hole:.2f} peg {p.ssd_peg:.2f}{bias}"
        )
    compute = metrics["compute_ms"]
    if compute["p50"] is not None and math.isfinite(compute["p50"]):
        print(f"compute: {compute['p50']:.1f} ms median, {compute['p99']:.1f} ms p99 per iteration")
    if record.real_time:
        _print_rig(metrics)
    print(f"report: {folder / 'report.html'}")


def _print_rig(metrics: dict[str, Any]) -> None:
    stages = metrics["latency_ms"]
    if stages["total"]["p50"] is not None:
        print(
            f"exposure to command: {stages['total']['p50']:.1f} ms median, {stages['total']['p99']:.1f} p99: "
            + ", ".join(
                f"{n} {took['p50']:.1f} ({took['p99']:.1f})" for n, took in stages.items() if n != "total"
            )
        )
    if cameras := metrics["rig"].get("cameras"):
        print(
            f"cameras: {cameras['rate_hz']:.1f} pairs a second seen, "
            + ", ".join(f"{n}: {cameras[n]}" for n in ("camera 1", "camera 2"))
        )
    if stop := metrics["rig"].get("stop"):
        print(
            f"stop pedal: stop sent {stop['pressed_to_sent_ms']:.1f} ms after the press, "
            f"everything at rest after {stop['pressed_to_rest_ms']:.1f} ms"
        )
