"""How many frames at a time fill the device: restorations on several queues, until frames/s stop growing.

python benchmarks/batch.py [--device D] [--size 512x400] [--most 64]

One in-order queue restores one frame after the other, and a frame of a few thousand work-items leaves a large
device idle. Each queue here has a plan, a frame and an image of its own in one context.
"""

from __future__ import annotations

import argparse
import copy

import numpy as np
import pyopencl as cl

from adof_cl.bench_cases import parse_sizes
from adof_cl.device import Device
from adof_cl.restore import Restore
from adof_cl.turns import Rounds, take_turns


def main() -> None:
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("--device", help="index, type or part of a name")
    parser.add_argument("--size", default="512x400", help="columns x rows")
    parser.add_argument("--most", type=int, default=64, help="frames at a time, at most")
    options = parser.parse_args()
    (shape,) = parse_sizes(options.size)
    device = Device.open(options.device)
    rng = np.random.default_rng(1)
    queues = []
    for _ in range(options.most):
        apart = copy.copy(device)
        apart.queue = cl.CommandQueue(device.context)
        plan = Restore(apart, shape, in_dtype=np.uint8, out_dtype=np.uint8)
        plan.set_filter_axes(*(np.exp(-3 * np.abs(np.fft.fftfreq(n))) for n in plan.padded_shape), nsr=0.01)
        frame = apart.upload(rng.integers(0, 255, shape, dtype=np.uint8))
        queues.append((apart.queue, plan, frame, apart.empty(shape, np.uint8)))
        apart.queue.finish()

    def batch(frames: int) -> None:
        for queue, plan, frame, image in queues[:frames]:
            plan(frame, image)
            queue.flush()
        for queue, *_ in queues[:frames]:
            queue.finish()

    sizes = [1 << k for k in range(options.most.bit_length()) if 1 << k <= options.most]
    times = take_turns([lambda n=n: batch(n) for n in sizes], Rounds(11, 41, 20.0))
    print(f"{device.facts}, {options.size}, uint8\n{'at a time':>10}{'ms':>10}{'frames/s':>10}")
    for frames, seconds in zip(sizes, times, strict=True):
        median = float(np.median(seconds))
        print(f"{frames:10}{1e3 * median:10.3f}{frames / median:10.0f}")


if __name__ == "__main__":
    main()
