"""Send many frames through the whole chain and show that the process does not grow.

python benchmarks/endurance.py                          200,000 frames of 128 x 96
python benchmarks/endurance.py --frames 1000000 --json curve.json --png curve.png

Each frame is uploaded, restored for two parts, one of them through a filter formed anew, searched for two
features of each, and measured to a fraction of a pixel. Resident memory is read every so many frames; once
warm, the curve may not rise by `BOUND_BYTES`, or the exit code is 1.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from adof_cl.device import Device
from adof_cl.optics import OpticalSystem
from adof_cl.pipeline import Blur, CameraPipeline, Shot
from adof_cl.stream import Stream
from adof_cl.tracking import Template

BOUND_BYTES = 1_000_000
PLACES = {"peg": np.array([(40.0, 36.0), (88.0, 36.0)]), "hole": np.array([(40.0, 70.0), (88.0, 70.0)])}


def resident_bytes() -> int:
    """Resident memory of this process; Linux only."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def scene(shape: tuple[int, int], seed: int) -> np.ndarray:
    """Blocks of many brightnesses: a corner wherever one looks."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(30, 226, (-(-shape[0] // 6), -(-shape[1] // 6)))
    blocks = np.kron(coarse, np.ones((6, 6)))[: shape[0], : shape[1]]
    return np.clip(np.rint(blocks + rng.normal(0, 1, shape)), 0, 255).astype(np.uint8)


def chain(device: Device, shape: tuple[int, int], buffers: int = 2) -> tuple[CameraPipeline, np.ndarray]:
    """Return a pipeline that follows two features of each part, and the frame they were cut from."""
    pipeline = CameraPipeline(
        device, OpticalSystem(), shape, tuple(PLACES), padding=16, search_shape=(32, 32), buffers=buffers
    )
    sharp = scene(shape, 1)
    for part, places in PLACES.items():
        pipeline.set_templates(part, [Template.cut(sharp, place, (16, 16)) for place in places])
    return pipeline, sharp


def shots(frame: np.ndarray, count: int) -> Iterator[Shot]:
    """Yield frames whose second part's depth changes every time, so that its filter is formed anew."""
    steady = Blur(1.0, 0.0)
    for k in range(count):
        places = {part: at + (k % 5) * 0.25 for part, at in PLACES.items()}
        yield Shot(frame, {"peg": steady, "hole": Blur(1.0, 0.02 * (k % 17))}, places)


def curve(
    device: Device, shape: tuple[int, int], frames: int, every: int
) -> Iterator[tuple[int, int, float]]:
    """Yield (frames so far, resident bytes, seconds) every so many frames."""
    pipeline, frame = chain(device, shape)
    began = time.perf_counter()
    for result in Stream(pipeline).run(shots(frame, frames)):
        done = result.numbers[0] + 1
        if done % every == 0:
            gc.collect()
            yield done, resident_bytes(), time.perf_counter() - began


def growth(points: list[tuple[int, int, float]], warm: int) -> int:
    """Return by how many bytes the curve's end lies above the first point after `warm` frames."""
    after = [memory for done, memory, _ in points if done >= warm]
    return after[-1] - after[0]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--shape", default="128x96", help="columns x rows")
    parser.add_argument("--device", default=None)
    parser.add_argument("--copies-apart", action="store_true", help="copies on queues of their own")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--png", type=Path)
    options = parser.parse_args()
    columns, rows = (int(n) for n in options.shape.split("x"))
    every, warm = max(options.frames // 100, 1), options.frames // 20
    device = Device.open(options.device, copies_apart=options.copies_apart or None)
    points = []
    for point in curve(device, (rows, columns), options.frames, every):
        points.append(point)
        done, memory, seconds = point
        if len(points) % 5 == 0:
            print(f"{done:9d} frames  {memory / 1e6:8.3f} MB  {seconds:7.1f} s", flush=True)
    grown = growth(points, warm)
    print(
        f"{options.frames} frames of {columns} x {rows} on {device.facts}: {grown / 1e6:+.3f} MB after the "
        f"first {warm}, {options.frames / points[-1][2]:.0f} frames a second"
    )
    if options.json:
        options.json.write_text(json.dumps({"device": device.facts.as_dict(), "points": points}, indent=1))
    if options.png:
        _plot(points, warm, options.png)
    return int(grown >= BOUND_BYTES)


def _plot(points: list[tuple[int, int, float]], warm: int, path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    done, memory, _ = np.array(points).T
    figure, axes = plt.subplots(figsize=(7, 3), layout="constrained")
    axes.plot(done, memory / 1e6, color="black")
    axes.axvspan(0, warm, color="0.9")
    level = memory[-1] / 1e6
    axes.set(
        xlabel="frames",
        ylabel="resident memory, MB",
        xlim=(0, done[-1]),
        ylim=(min(memory.min() / 1e6, level - 1) - 0.1, max(memory.max() / 1e6, level + 1) + 0.1),
    )
    figure.savefig(path, dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
