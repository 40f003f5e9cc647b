"""Where a frame's time goes: copies, each kernel and what is between them, apart.

python benchmarks/chain_parts.py [--device D] [--size 512x400] [--frames 300]

The frame chain of `adof bench` (upload, restore, four searches, places down) on a queue that keeps the
device's own clock; medians. "between" is the host's wall time less all of them: enqueuing, waking, waiting.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from adof_cl.bench_cases import parse_sizes
from adof_cl.device import Device
from adof_cl.restore import Restore
from adof_cl.ssd_search import SsdSearch


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("--device", help="index, type or part of a name")
    parser.add_argument("--size", default="512x400", help="columns x rows")
    parser.add_argument("--frames", type=int, default=300)
    options = parser.parse_args()
    (shape,) = parse_sizes(options.size)
    opened = Device.open(options.device)
    device = Device(opened.facts, opened.handle, profiling=True)
    plan = Restore(device, shape, in_dtype=np.uint8, out_dtype=np.uint8)
    axes = [np.exp(-3 * np.abs(np.fft.fftfreq(n))) for n in plan.padded_shape]
    plan.set_filter_axes(*axes, 0.01)
    rng = np.random.default_rng(1)
    frame = rng.integers(0, 255, shape, dtype=np.uint8)
    search = SsdSearch(device, shape, (20, 20), (64, 64), 4)
    search.set_templates(rng.integers(0, 255, (4, 20, 20), dtype=np.uint8))
    search.set_windows(rng.integers(0, np.subtract(shape, 64), (4, 2)))
    there, image = device.empty(shape, np.uint8), device.empty(shape, np.uint8)

    device.events = []
    search(image)
    searches = len(device.events)
    parts: dict[str, list[float]] = {"upload": [], "places down": [], "whole": []}
    for turn in range(options.frames + 10):
        device.wait()
        device.events = []
        start = time.perf_counter()
        there.upload(frame)
        uploaded = time.perf_counter()
        search(plan(there, image))
        device.wait()
        finished = time.perf_counter()
        search.fetch()
        fetched = time.perf_counter()
        if turn < 10:  # the first calls compile and warm
            continue
        parts["upload"].append(uploaded - start)
        parts["places down"].append(fetched - finished)
        parts["whole"].append(fetched - start)
        restores = len(device.events) - searches
        names = (
            *(f"restore {k}" for k in range(1, restores + 1)),
            *(f"search {k}" for k in range(1, searches + 1)),
        )
        for name, event in zip(names, device.events, strict=False):
            parts.setdefault(name, []).append(1e-9 * (event.profile.end - event.profile.start))
    medians = {name: 1e6 * float(np.median(values)) for name, values in parts.items()}
    whole = medians.pop("whole")
    print(f"{device.facts}, {options.size}: {len(device.events)} launches, {whole:.0f} us a frame")
    medians["between"] = whole - sum(medians.values())
    for name, microseconds in medians.items():
        print(f"  {name:12} {microseconds:8.1f} us {100 * microseconds / whole:5.1f} %")


if __name__ == "__main__":
    main()
