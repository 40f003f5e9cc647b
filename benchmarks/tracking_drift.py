"""Track one feature through very many frames and show that its place does not drift.

python benchmarks/tracking_drift.py                     1,000,000 frames
python benchmarks/tracking_drift.py --frames 10000000 --refine quadratic --json drift.json

Each frame is searched where the two before it let expect the feature, and measured to a fraction of a pixel:
`adof_cl.envelope.walk` says how. A frame that once came out elsewhere than at its first visit, or that was
lost, makes the exit code 1. Interrupted, it keeps what it has.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

from adof_cl.device import Device
from adof_cl.envelope import Walked, walk


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--refine", default="gauss_newton", help="gauss_newton, quadratic or integer")
    parser.add_argument("--device", default=None)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    device = Device.open(options.device)
    began = time.perf_counter()
    every = min(max(options.frames // 200, 1), 20_000)
    reached: Walked | None = None
    try:
        for reached in walk(device, options.frames, every, refine=options.refine):
            seconds = time.perf_counter() - began
            print(
                f"{reached.frames:9d} frames  {reached.apart_px:g} px apart  {reached.lost} lost  "
                f"{reached.unseen} turns unseen  {seconds:7.1f} s",
                flush=True,
            )
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
    if reached is None:
        return 1
    if options.json:
        found = {"device": device.facts.as_dict(), "refine": options.refine, **asdict(reached)}
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return int(reached.apart_px > 0 or reached.lost > 0)


if __name__ == "__main__":
    sys.exit(main())
