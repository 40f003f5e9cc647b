"""Time frames one at a time and streamed, in turns.

python benchmarks/streaming.py [--device NAME] [--sizes 512x400,659x494] [--buffers 1,2,3]

places    upload, restore, 4 searches of 20 x 20 in 64 x 64, whole-pixel places down
features  the same through `CameraPipeline`: to a fraction of a pixel, on the host
images    upload, restore, image down

A ratio is the median of the rounds' ratios, in brackets its quartiles; above 1 the stream is faster.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from itertools import repeat
from typing import Any

import numpy as np

from adof_cl import reference
from adof_cl.device import Device, DeviceArray
from adof_cl.optics import OpticalSystem
from adof_cl.pipeline import Blur, CameraPipeline, Shot
from adof_cl.restore import Restore
from adof_cl.ssd_search import SearchResult, SsdSearch
from adof_cl.stream import RestoredFrames, Stream
from adof_cl.tracking import Template
from adof_cl.turns import Rounds, Spread, ratio, take_turns

FRAMES = 40
BLUR = Blur(20.0, 10.0)


class _Search(SsdSearch):
    def begin(self, image: DeviceArray) -> None:
        self(image)
        self._records.begin_download()

    @property
    def found(self) -> bool:
        return self._records.arrived


class Places:
    """The bare chain as the work of a stream."""

    def __init__(self, plan: Restore, templates: np.ndarray, origins: np.ndarray, buffers: int) -> None:
        self.buffers = buffers
        self._plan = plan
        self._frames = [plan.device.empty(plan.shape, np.uint8) for _ in range(buffers)]
        self._image = plan.device.empty(plan.shape, np.uint8)
        self._searches = [_Search(plan.device, plan.shape, (20, 20), (64, 64), 4) for _ in range(buffers)]
        for search in self._searches:
            search.set_templates(templates)
            search.set_windows(origins)

    def stage(self, buffer: int, frame: np.ndarray) -> None:
        self._frames[buffer].stage(frame)

    def enqueue(self, buffer: int) -> None:
        self._searches[buffer].begin(self._plan(self._frames[buffer].send(), self._image))

    def ready(self, buffer: int) -> bool:
        return self._searches[buffer].found

    def collect(self, buffer: int) -> SearchResult:
        return self._searches[buffer].fetch()


def coded(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return a scene of blocks, sharp and as the mask blurs it."""
    rng = np.random.default_rng(5)
    coarse = rng.integers(30, 226, (-(-shape[0] // 12), -(-shape[1] // 12)))
    sharp = np.kron(coarse, np.ones((12, 12)))[: shape[0], : shape[1]]
    optics = OpticalSystem()
    rows, columns = (reference.otf_1d(optics.frequency_axis(n), BLUR.alpha_rad, BLUR.psi_rad) for n in shape)
    half = np.outer(rows, columns[: shape[1] // 2 + 1])
    blurred = np.fft.irfft2(np.fft.rfft2(sharp) * half, s=shape) + rng.normal(0, 1, shape)
    return tuple(np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in (sharp, blurred))


def contenders(
    device: Device, shape: tuple[int, int], kind: str, buffers: list[int]
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield what sends `FRAMES` frames through one at a time, then streamed with so many buffers."""
    sharp, frame = coded(shape)
    xy = np.array([(x * shape[1] // 4, y * shape[0] // 4) for x in (1, 3) for y in (1, 3)]) // 12 * 12 - 0.5
    if kind == "features":
        templates = [Template.cut(sharp, place) for place in xy]
        shot = Shot(frame, {"part": BLUR}, {"part": xy})

        def pipeline(count: int) -> CameraPipeline:
            made = CameraPipeline(device, OpticalSystem(), shape, ("part",), buffers=count)
            made.set_templates("part", templates)
            return made

        single = pipeline(1)
        lost = [m.reason for m in single(frame, shot.blurs, shot.expected_xy_px)["part"] if m.lost]
        assert not lost, lost
        yield "single", lambda: [single(frame, shot.blurs, shot.expected_xy_px) for _ in range(FRAMES)]
        works: list[Any] = [pipeline(count) for count in buffers]
        item: Any = shot
    else:
        plan = Restore(device, shape, in_dtype=np.uint8, out_dtype=np.uint8)
        optics = OpticalSystem()
        axes = [
            reference.otf_1d(optics.frequency_axis(n), BLUR.alpha_rad, BLUR.psi_rad)
            for n in plan.padded_shape
        ]
        plan.set_filter_axes(*axes, 0.01)
        item = frame
        if kind == "images":
            yield "single", lambda: [plan.restore(frame) for _ in range(FRAMES)]
            works = [RestoredFrames(plan, buffers=count) for count in buffers]
        else:
            corners = np.rint(xy[:, ::-1] - 9.5).astype(int)
            cut = np.stack([sharp[y : y + 20, x : x + 20] for y, x in corners])
            search = SsdSearch(device, shape, (20, 20), (64, 64), 4)
            search.set_templates(cut)
            search.set_windows(corners - 22)
            here, image = device.empty(shape, np.uint8), device.empty(shape, np.uint8)

            def one() -> SearchResult:
                search(plan(here.upload(frame), image))
                return search.fetch()

            assert (one().best_yx == corners).all()
            yield "single", lambda: [one() for _ in range(FRAMES)]
            works = [Places(plan, cut, corners - 22, count) for count in buffers]
    for count, work in zip(buffers, works, strict=True):
        stream = Stream(work)
        yield f"{count} buffers", lambda stream=stream: list(stream.run(repeat(item, FRAMES)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default=None)
    parser.add_argument("--sizes", default="512x400,659x494", help="columns x rows, several")
    parser.add_argument("--kinds", default="places,features,images")
    parser.add_argument("--buffers", default="1,2,3")
    parser.add_argument("--copies-apart", action="store_true", help="copies on queues of their own")
    parser.add_argument("--rounds", type=int, default=21)
    options = parser.parse_args()
    device = Device.open(options.device, copies_apart=options.copies_apart or None)
    print(device.facts, "copies apart" if device.copies_apart else "one queue")
    for size in options.sizes.split(","):
        columns, rows = (int(n) for n in size.split("x"))
        for kind in options.kinds.split(","):
            named = list(
                contenders(device, (rows, columns), kind, [int(n) for n in options.buffers.split(",")])
            )
            times = take_turns([run for _, run in named], Rounds(options.rounds, options.rounds, 0.0))
            for (name, _), taken in zip(named, times, strict=True):
                against = ratio(taken, times[0])
                ms = Spread.of([1e3 * t / FRAMES for t in taken])
                print(
                    f"{kind:9s} {columns:4d} x {rows:<4d} {name:10s} {1e3 / ms.median:6.0f} frames/s  "
                    f"{ms.median:6.3f} ms, least {1e3 * min(taken) / FRAMES:6.3f}  "
                    f"x {against.median:.2f} ({against.low:.2f}-{against.high:.2f})"
                )


if __name__ == "__main__":
    main()
