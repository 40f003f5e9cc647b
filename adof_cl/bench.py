"""Time every operation and the frame chain on one device, beside other libraries in the same process.

A result is checked against float64 before it is timed, and again afterwards; a wrong one is a failure, never
a number. What is timed is in `bench_cases`, how in `turns`.
"""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
import scipy

from adof_cl import __version__
from adof_cl.bench_cases import parse_sizes, select
from adof_cl.device import Device
from adof_cl.errors import AdofError
from adof_cl.files import read_versioned
from adof_cl.peers import THREADS, Peer
from adof_cl.program import Program
from adof_cl.turns import (
    QUICK,
    Builder,
    Case,
    Clock,
    Contender,
    Rounds,
    Spread,
    case_name,
    check,
    ratio,
    sentence,
    take_turns,
)

SCHEMA = 1


# ---- what is measured -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class PeerResult:
    """Another library at the same work, or another form of our own.

    Attributes
    ----------
    ratio
        Its time over ours, per unit of work, round by round: above 1, ours is faster.
    wall_s
        Of one call.
    """

    name: str
    version: str
    ratio: Spread
    wall_s: Spread
    error: float
    options: dict[str, Any]


@dataclass(frozen=True)
class FirstCall:
    """From an opened device to the first result, in a process of its own.

    Attributes
    ----------
    cold_s, warm_s
        With no compiled kernel kept anywhere, and with those of the process before.
    """

    cold_s: float
    warm_s: float


@dataclass(frozen=True)
class Result:
    """One operation in one form at one size.

    Attributes
    ----------
    size
        (columns, rows), as cameras are named.
    wall_s
        One call as the host sees it, until it is done.
    event_s
        Kernels alone, by the device's clock; None where it gives none.
    per_s, mpixel_per_s
        From `wall_s`: calls (for otf: pairs), and pixels of frame, panel, stop or transfer function.
    gbyte_per_s, copy_share
        What the kernels must move at least, over `event_s`; and that over the copy bandwidth of the same run.
    error, bound, measure
        Against float64.
    """

    operation: str
    form: str
    size: tuple[int, int]
    wall_s: Spread
    event_s: Spread | None
    per_s: float
    mpixel_per_s: float
    gbyte_per_s: float
    copy_share: float
    error: float
    bound: float
    measure: str
    options: dict[str, Any]
    first_call: FirstCall | None
    peers: list[PeerResult]

    @property
    def name(self) -> str:
        """Operation, form and size."""
        return case_name(self.operation, self.form, self.size[::-1])


@dataclass(frozen=True)
class Failure:
    """What was refused a number, and why."""

    case: str
    who: str
    reason: str


@dataclass(frozen=True)
class Report:
    """One run on one device, with everything its numbers depend on."""

    schema_version: int
    version: str
    when: str
    device: dict[str, Any]
    machine: dict[str, Any]
    settings: dict[str, Any]
    copy_gbyte_per_s: float
    results: list[Result]
    failures: list[Failure]

    def to_json(self) -> str:
        """Return the text of a results file."""
        return _REPORT.dump_json(self, indent=1).decode() + "\n"

    @classmethod
    def read(cls, path: Path) -> Report:
        """Read a results file.

        Raises
        ------
        InputError
            It cannot be read, or is not one of this version's.
        """
        return read_versioned(path, _REPORT, SCHEMA, "a results file", "adof bench --json FILE")


_REPORT = pydantic.TypeAdapter(Report)


# ---- measuring ------------------------------------------------------------------------------------------


def measure(
    case: Case,
    device: Device,
    peers: Sequence[Peer],
    *,
    rounds: Rounds,
    copy_gbyte_per_s: float,
    first_call: FirstCall | None = None,
    clock: Clock = time.perf_counter,
) -> tuple[Result | None, list[Failure]]:
    """Check and time one case; None and a failure when our own result is wrong.

    Source
    ------
    benchmarks/README.md says what each number means.
    """
    failures: list[Failure] = []

    def built(who: str, builder: Builder) -> Contender | None:
        try:
            contender = builder(device)
        except Exception as failure:  # noqa: BLE001 (as in check: it is said, and the others go on)
            failures.append(Failure(case.name, who, sentence(failure)))
            return None
        reason = check(contender)
        if reason:
            failures.append(Failure(case.name, who, reason))
            return None
        return contender

    case.prepare()
    ours = built("adof-cl", case.ours)
    if ours is None:
        return None, failures
    error = ours.error()
    rivals = [built(name, make) for name, make in case.rivals(peers).items()]
    present = [rival for rival in rivals if rival is not None]
    times = take_turns([ours.run, *(rival.run for rival in present)], rounds, clock)
    for contender in (ours, *present):
        after = check(contender)
        if after:
            failures.append(Failure(case.name, contender.name, f"after timing: {after}"))
            if contender is ours:
                return None, failures
    wall = Spread.of(times[0])
    event = _event_time(case, device, min(len(times[0]), 11))
    busy = event or wall
    rate = ours.traffic / busy.median / 1e9
    result = Result(
        operation=case.operation,
        form=case.form,
        size=(case.size[1], case.size[0]),
        wall_s=wall,
        event_s=event,
        per_s=ours.units / wall.median,
        mpixel_per_s=case.pixels * ours.units / wall.median / 1e6,
        gbyte_per_s=rate,
        copy_share=rate / copy_gbyte_per_s,
        error=error,
        bound=ours.bound,
        measure=case.measure,
        options=ours.options,
        first_call=first_call,
        peers=[
            PeerResult(
                rival.name,
                rival.version,
                ratio(times[0], theirs, rival.units / ours.units),
                Spread.of(theirs),
                rival.error(),
                rival.options,
            )
            for rival, theirs in zip(present, times[1:], strict=True)
        ],
    )
    return result, failures


def _event_time(case: Case, device: Device, count: int) -> Spread | None:
    """Time the kernels by the device's own clock, on a queue that keeps it."""
    timed = Device(device.facts, device.handle, profiling=True)
    ours = case.ours(timed)
    ours.run()
    sums = []
    for _ in range(count):
        timed.events = []
        ours.run()
        timed.wait()
        sums.append(1e-9 * sum(event.profile.end - event.profile.start for event in timed.events))
    return Spread.of(sums) if min(sums) > 0 else None


# ---- the device's memory --------------------------------------------------------------------------------

_COPY = """\
__kernel void bench_copy(__global const float16 *from, __global float16 *to, const int run) {
    const int start = get_global_id(0) * run;
    for (int i = start; i < start + run; i++) to[i] = from[i];
}
"""


def copy_bandwidth(device: Device, mebibytes: int, rounds: Rounds) -> float:
    """Return GB/s, read and written, of copying an array of `mebibytes` on the device: best of the rounds.

    Raises
    ------
    DeviceError
        The copy is not like the original.
    """
    size = min(mebibytes << 20, device.facts.max_allocation_bytes // 4) >> 20 << 20
    values = np.arange(size // 4, dtype=np.int32)
    source, target = device.upload(values), device.upload(np.zeros_like(values))
    program = Program(device, "precision.h", generated=("bench_copy.cl", _COPY))
    cells = size // 64
    # A processor's core copies a stretch, a graphics card's work-items stand side by side.
    run = 4096 if device.facts.kind == "cpu" else 1
    copy = program.launch("bench_copy", (cells // run,), None, source, target, np.int32(run))

    def once() -> None:
        copy()
        device.wait()

    once()
    if not np.array_equal(target.download(), values):
        raise AdofError("a copy on the device is not like its original: run adof selftest on this device")
    return 2 * size / min(take_turns([once], rounds)[0]) / 1e9


# ---- all cases ------------------------------------------------------------------------------------------


def run(
    device: Device,
    cases: Iterable[Case],
    peers: Sequence[Peer] = (),
    *,
    quick: bool = False,
    clock: Clock = time.perf_counter,
    tell: Callable[[str, str], None] = lambda _case, _sentence: None,
) -> Report:
    """Measure the cases one after another.

    Parameters
    ----------
    quick
        Few rounds, a small copy, and no processes of their own for first calls.
    clock
        What the turns are timed with, s.
    tell
        Called with each case's name and what is being done.
    """
    rounds = QUICK if quick else Rounds()
    began = datetime.now(UTC)
    load = os.getloadavg() if hasattr(os, "getloadavg") else None
    tell("copy bandwidth", "measuring")
    megabytes = 16 if quick else 256
    copy = copy_bandwidth(device, megabytes, rounds if quick else Rounds(21, 61, 6.0))
    tell("copy bandwidth", f"{copy:.1f} GB/s")
    results, failures, asked = [], [], set()
    for case in cases:
        if case.precision == "float64" and not device.facts.fp64:
            tell(case.name, "left out: no float64 on this device")
            continue
        first = None
        if not quick and (case.operation, case.form) not in asked:
            asked.add((case.operation, case.form))
            tell(case.name, "first call")
            try:
                first = first_call(case, device)
            except AdofError as failure:
                failures.append(Failure(case.name, "first call", str(failure)))
        tell(case.name, "checking and timing")
        result, wrong = measure(
            case, device, peers, rounds=rounds, copy_gbyte_per_s=copy, first_call=first, clock=clock
        )
        failures.extend(wrong)
        if result is not None:
            results.append(result)
            tell(case.name, f"{1e3 * result.wall_s.median:.3f} ms")
        for wrongly in wrong:
            tell(case.name, f"{wrongly.who} FAILED: {wrongly.reason}")
    return Report(
        schema_version=SCHEMA,
        version=__version__,
        when=began.isoformat(timespec="seconds"),
        device=device.facts.as_dict(),
        machine={
            "processor": _processor(),
            "cores": os.cpu_count(),
            "system": platform.platform(),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "load_at_start": None if load is None else [round(value, 2) for value in load],
            "load_at_end": [round(value, 2) for value in os.getloadavg()] if load is not None else None,
        },
        settings={
            "quick": quick,
            "rounds": [rounds.fewest, rounds.most, rounds.budget_s],
            "copy_mebibytes": megabytes,
            "peers": {peer.name: peer.version for peer in peers},
            "peer_threads": THREADS,
            "environment": {
                name: os.environ[name]
                for name in ("POCL_AFFINITY", "KMP_BLOCKTIME", "MKL_NUM_THREADS", "MKL_DYNAMIC")
                if name in os.environ
            },
        },
        copy_gbyte_per_s=copy,
        results=results,
        failures=failures,
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


# ---- first calls ----------------------------------------------------------------------------------------


def first_call(case: Case, device: Device) -> FirstCall:
    """Time a plan's making and first run in two new processes, the first with empty caches.

    Raises
    ------
    AdofError
        The process failed; the message holds its last line.
    """
    with tempfile.TemporaryDirectory() as folder:
        # Ours, and those of runtimes that keep one of their own.
        places = ("ADOF_CACHE_DIR", "POCL_CACHE_DIR", "CUDA_CACHE_PATH")
        environment = {**os.environ, **{name: str(Path(folder) / name.lower()) for name in places}}
        for place in places:
            Path(environment[place]).mkdir()
        command = [sys.executable, "-m", "adof_cl.bench", case.operation, case.form]
        command += [f"{case.size[1]}x{case.size[0]}", str(device.facts.index)]
        times = []
        for _ in range(2):
            done = subprocess.run(  # noqa: S603 (our own module, in our own interpreter)
                command, env=environment, capture_output=True, text=True, check=False
            )
            if done.returncode:
                last = (done.stderr.strip().splitlines() or ["no message"])[-1]
                raise AdofError(f"a new process failed at its first call: {last}")
            times.append(float(json.loads(done.stdout)))
    return FirstCall(*times)


def _first_call_here(operation: str, form: str, size: str, index: str) -> float:
    case = next(case for case in select([operation], parse_sizes(size)) if case.form == form)
    case.prepare()
    device = Device.open(index)
    start = time.perf_counter()
    case.ours(device).run()
    return time.perf_counter() - start


# ---- two runs -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """One number that two runs disagree on by more than their noise.

    Attributes
    ----------
    what
        The case, and the peer if it is a ratio.
    factor
        New median over old: of a time, below 1 is faster; of a ratio, above 1 is better.
    """

    what: str
    is_ratio: bool
    old: Spread
    new: Spread

    @property
    def factor(self) -> float:
        """New over old."""
        return self.new.median / self.old.median


@dataclass(frozen=True)
class Comparison:
    """What moved, what stayed, what only one run has.

    Attributes
    ----------
    drift
        Median over all common cases of new time over old: what the machine itself may have changed by.
    """

    changes: list[Change]
    unchanged: int
    only_old: list[str]
    only_new: list[str]
    drift: float
    same_device: bool


def compare(old: Report, new: Report) -> Comparison:
    """Compare two runs: times and ratios whose quartile ranges do not overlap have moved."""
    before, now = ({result.name: result for result in report.results} for report in (old, new))
    common = [name for name in now if name in before]
    pairs: list[Change] = []
    for name in common:
        pairs.append(Change(name, False, before[name].wall_s, now[name].wall_s))
        earlier = {peer.name: peer for peer in before[name].peers}
        pairs.extend(
            Change(f"{name} against {peer.name}", True, earlier[peer.name].ratio, peer.ratio)
            for peer in now[name].peers
            if peer.name in earlier
        )
    changes = [pair for pair in pairs if pair.new.apart_from(pair.old)]
    times = [pair.factor for pair in pairs if not pair.is_ratio]
    identity = ("name", "platform", "driver_version")
    return Comparison(
        changes=changes,
        unchanged=len(pairs) - len(changes),
        only_old=[name for name in before if name not in now],
        only_new=[name for name in now if name not in before],
        drift=float(np.median(times)) if times else math.nan,
        same_device=all(old.device.get(key) == new.device.get(key) for key in identity),
    )


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_first_call_here(*sys.argv[1:])))
