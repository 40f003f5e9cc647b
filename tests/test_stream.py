"""Laws of a stream: order, nothing lost but what is counted, and the same bits as one frame at a time."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from adof_cl.device import Device
from adof_cl.errors import AdofError, InputError, LimitError, StreamError, TrackingError
from adof_cl.optics import OpticalSystem
from adof_cl.pipeline import Blur, CameraPipeline, Shot
from adof_cl.restore import Restore
from adof_cl.stream import RestoredFrames, Stream
from adof_cl.tracking import Template

SHAPE = (9, 14)
PARTS = {"peg": [(40.0, 36.0), (88.0, 36.0)], "hole": [(40.0, 70.0), (88.0, 70.0)]}
TREE = Path(__file__).parents[1]


@pytest.fixture(scope="module", params=[False, True], ids=["one queue", "copies apart"])
def opened(request: pytest.FixtureRequest, device: Device) -> Device:
    return Device(device.facts, device.handle, copies_apart=request.param)


def restoration(device: Device, shape: tuple[int, int] = SHAPE, dtype: type = np.uint8) -> Restore:
    plan = Restore(device, shape, in_dtype=dtype, padding=4)
    rng = np.random.default_rng(3)
    axes = [np.exp(-rng.random() * np.fft.fftfreq(n) ** 2) for n in plan.padded_shape]
    plan.set_filter_axes(*axes, nsr=0.01)
    return plan


def frames(amount: int, seed: int = 0, shape: tuple[int, int] = SHAPE) -> list[NDArray[np.uint8]]:
    return list(np.random.default_rng(seed).integers(0, 256, (amount, *shape), dtype=np.uint8))


def images(results: Any) -> list[NDArray[Any]]:
    return [result.values[0] for result in results]


# ---- lossless -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("buffers", [1, 2, 5])
@pytest.mark.parametrize("amount", [0, 1, 2, 11])
def test_every_frame_gives_the_image_it_gives_alone_in_order(
    opened: Device, buffers: int, amount: int
) -> None:
    plan = restoration(opened)
    taken = frames(amount)
    ticks = itertools.count()
    stream = Stream(RestoredFrames(plan, buffers=buffers), clock=lambda: float(next(ticks)))
    results = list(stream.run(taken))
    assert [result.numbers for result in results] == [(k,) for k in range(amount)]
    for image, frame in zip(images(results), taken, strict=True):
        np.testing.assert_array_equal(image, plan.restore(frame))
    times = [result.times_s[0] for result in results]
    assert times == sorted(times)
    assert all(result.done_s > result.times_s[0] for result in results)
    assert stream.dropped == [0]
    assert stream.in_flight == 0


def test_frames_larger_than_a_cache_come_out_as_alone(opened: Device) -> None:
    shape = (601, 799)
    plan = restoration(opened, shape, np.uint16)
    taken = [frame.astype(np.uint16) << 4 for frame in frames(6, 1, shape)]
    for image, frame in zip(images(Stream(RestoredFrames(plan)).run(taken)), taken, strict=True):
        np.testing.assert_array_equal(image, plan.restore(frame))


def test_no_more_frames_are_under_way_than_there_are_buffers_and_as_many_are(device: Device) -> None:
    work = RestoredFrames(restoration(device), buffers=3)
    stream = Stream(work)
    at_arrival = []

    def source() -> Iterator[NDArray[np.uint8]]:
        for frame in frames(9):
            at_arrival.append(stream.in_flight)
            yield frame

    at_result = [stream.in_flight for _ in stream.run(source())]
    assert max(at_arrival) == 2  # the one arriving is the third
    assert at_result == [2] * 7 + [1, 0]


def test_the_caller_may_use_its_array_again_at_once(opened: Device) -> None:
    plan = restoration(opened)
    taken = frames(12)
    reused = np.empty(SHAPE, np.uint8)

    def source() -> Iterator[NDArray[np.uint8]]:
        for frame in taken:
            reused[:] = frame
            yield reused
            reused[:] = 255

    found = images(list(Stream(RestoredFrames(plan, buffers=3)).run(source())))
    for image, frame in zip(found, taken, strict=True):
        np.testing.assert_array_equal(image, plan.restore(frame))


def test_a_filter_changed_between_frames_counts_for_the_frames_after_it(opened: Device) -> None:
    plan = restoration(opened)
    taken = frames(8)
    gains = [1.0, 0.5, 2.0, 0.25]

    def set_gain(k: int) -> None:
        plan.set_filter(np.full((plan.padded_shape[0], plan.padded_shape[1] // 2 + 1), gains[k // 2 % 4]))

    def source() -> Iterator[NDArray[np.uint8]]:
        for k, frame in enumerate(taken):
            set_gain(k)
            yield frame

    found = images(list(Stream(RestoredFrames(plan)).run(source())))
    for k, frame in enumerate(taken):
        set_gain(k)
        np.testing.assert_array_equal(found[k], plan.restore(frame))


def test_a_caller_who_stops_early_drops_what_is_under_way_and_may_begin_again(opened: Device) -> None:
    plan = restoration(opened)
    stream = Stream(RestoredFrames(plan, buffers=3))
    taken = frames(9)
    results = stream.run(taken)
    next(results)
    results.close()
    assert stream.dropped == [2]
    assert stream.in_flight == 0
    again = list(stream.run(taken))
    assert [result.numbers for result in again] == [(k,) for k in range(3, 12)]
    np.testing.assert_array_equal(again[0].values[0], plan.restore(taken[0]))


# ---- newest -----------------------------------------------------------------------------------------------


@given(
    cameras=st.integers(1, 2),
    buffers=st.integers(2, 4),
    steps=st.lists(st.sampled_from(["camera 0", "camera 1", "take"]), max_size=40),
)
def test_the_newest_frame_waits_and_every_drop_is_counted(
    device: Device, cameras: int, buffers: int, steps: list[str]
) -> None:
    """Against a model in which frames are their numbers."""
    plan = restoration(device)
    stream = Stream(*(RestoredFrames(plan, buffers=buffers) for _ in range(cameras)), policy="newest")
    pictures = frames(7)
    number, dropped = [0] * cameras, [0] * cameras
    waiting: list[int | None] = [None] * cameras
    under_way: deque[tuple[int, ...]] = deque()

    def start() -> None:
        if None not in waiting and len(under_way) < buffers - 1:
            under_way.append(tuple(waiting))
            waiting[:] = [None] * cameras

    for step in [*steps, *["take"] * buffers]:
        if step == "take":
            if not under_way:
                assert stream.poll() is None
                continue
            result = stream.take()
            assert result.numbers == under_way.popleft()
            assert result.times_s == tuple(10.0 * k for k in result.numbers)
            for k, image in zip(result.numbers, result.values, strict=True):
                np.testing.assert_array_equal(image, plan.restore(pictures[k % 7]))
        elif (camera := int(step[-1])) < cameras:
            k = number[camera]
            assert stream.submit(pictures[k % 7], camera, time_s=10.0 * k) == k
            dropped[camera] += waiting[camera] is not None
            waiting[camera] = k
            number[camera] += 1
        start()
        assert stream.in_flight == len(under_way) < buffers
        assert stream.dropped == dropped
    stream.close()
    lost = [None in waiting and frame is not None for frame in waiting]
    assert stream.dropped == [d + gone for d, gone in zip(dropped, lost, strict=True)]


def test_a_result_is_polled_once_it_is_there_and_none_before_a_frame_came(opened: Device) -> None:
    plan = restoration(opened)
    stream = Stream(RestoredFrames(plan), policy="newest")
    assert stream.poll() is None
    frame = frames(1)[0]
    stream.submit(frame)
    opened.wait()
    result = stream.poll()
    assert result is not None
    np.testing.assert_array_equal(result.values[0], plan.restore(frame))
    assert stream.poll() is None


# ---- threads ----------------------------------------------------------------------------------------------


def started(*targets: Any) -> list[threading.Thread]:
    threads = [threading.Thread(target=target) for target in targets]
    for thread in threads:
        thread.start()
    return threads


def test_two_cameras_of_their_own_threads_are_paired_and_lose_nothing(opened: Device) -> None:
    plans = restoration(opened), restoration(opened)
    stream = Stream(*(RestoredFrames(plan) for plan in plans))
    taken = frames(60, 1), frames(60, 2)
    threads = started(
        *(
            lambda camera=camera: [stream.submit(frame, camera) for frame in taken[camera]]
            for camera in (0, 1)
        )
    )
    results = [stream.take() for _ in range(60)]
    for thread in threads:
        thread.join()
    stream.close()
    assert stream.take() is None
    for k, result in enumerate(results):
        assert result.numbers == (k, k)
        for camera in (0, 1):
            np.testing.assert_array_equal(result.values[camera], plans[camera].restore(taken[camera][k]))


def test_a_camera_that_is_faster_than_its_reader_never_waits_and_each_frame_is_a_result_or_a_drop(
    opened: Device,
) -> None:
    plan = restoration(opened)
    taken = frames(500)
    wanted = [plan.restore(frame) for frame in taken]
    stream = Stream(RestoredFrames(plan, buffers=3), policy="newest")

    def camera() -> None:
        for frame in taken:
            stream.submit(frame)
        stream.close()

    threads = started(camera)
    results = list(stream)
    threads[0].join()
    numbers = [result.numbers[0] for result in results]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 499  # the newest is never dropped
    assert len(numbers) + stream.dropped[0] == 500
    for k, image in zip(numbers, images(results), strict=True):
        np.testing.assert_array_equal(image, wanted[k])


def test_who_waits_for_room_is_refused_when_the_stream_closes_and_what_is_under_way_comes_out(
    device: Device,
) -> None:
    stream = Stream(RestoredFrames(restoration(device)))
    said: list[str] = []

    def camera() -> None:
        try:
            for frame in frames(5):
                stream.submit(frame)
        except StreamError as refusal:
            said.append(str(refusal))

    threads = started(camera)
    assert stream.take().numbers == (0,)
    while stream.in_flight < 2:  # until the camera has filled both buffers
        pass
    stream.close()
    threads[0].join()
    assert said == ["the stream is closed: open a new one"]
    assert [result.numbers for result in stream] == [(1,), (2,)]
    with pytest.raises(StreamError, match="closed"):
        stream.submit(frames(1)[0])


# ---- what fails -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.zeros((9, 13), np.float32), "frame 3: .*9, 13"),
        (np.zeros(SHAPE, np.uint8), "frame 3: .*uint8"),
        (np.full(SHAPE, np.nan, np.float32), "frame 3: .*NaN"),
    ],
    ids=["shape", "type", "value"],
)
def test_a_refused_frame_is_named_after_the_results_under_way_and_the_stream_goes_on(
    opened: Device, bad: NDArray[Any], message: str
) -> None:
    plan = restoration(opened, dtype=np.float32)
    taken = [frame.astype(np.float32) for frame in frames(6)]
    stream = Stream(RestoredFrames(plan, buffers=3))
    results = []
    with pytest.raises(InputError, match=message):
        results.extend(stream.run([*taken[:3], bad, *taken[3:]]))
    # `extend` keeps what came before the failure.
    assert [result.numbers[0] for result in results] == [0, 1, 2]
    assert stream.dropped == [0]
    again = list(stream.run(taken))
    assert [result.numbers[0] for result in again] == [3, 4, 5, 6, 7, 8]
    np.testing.assert_array_equal(again[5].values[0], plan.restore(taken[5]))


def test_a_refused_frame_leaves_the_one_waiting_in_its_place(opened: Device) -> None:
    plan = restoration(opened)
    stream = Stream(RestoredFrames(plan), policy="newest")
    one, other = frames(2)
    stream.submit(one)
    stream.submit(other)
    with pytest.raises(InputError, match="frame 2: "):
        stream.submit(np.zeros((1, 1), np.uint8))
    with pytest.raises(InputError, match="camera is 1"):
        stream.submit(one, 1)
    assert stream.dropped == [0]
    assert [stream.take().numbers[0] for _ in range(2)] == [0, 1]
    assert stream.submit(one) == 2
    np.testing.assert_array_equal(stream.take().values[0], plan.restore(one))


def test_a_failing_source_is_heard_after_the_results_under_way(device: Device) -> None:
    def source() -> Iterator[NDArray[np.uint8]]:
        yield from frames(4)
        raise OSError("the camera was unplugged")

    stream = Stream(RestoredFrames(restoration(device), buffers=3))
    results = []
    with pytest.raises(OSError, match="unplugged"):
        results.extend(stream.run(source()))
    assert [result.numbers[0] for result in results] == [0, 1, 2, 3]


class _Failing(RestoredFrames):
    """The real work, on a device that fails one frame's copy to the host: that cannot be had on demand."""

    fail_on = 2
    collected = 0

    def collect(self, buffer: int) -> NDArray[Any]:
        image = super().collect(buffer)
        self.collected += 1
        if self.collected == self.fail_on + 1:
            raise MemoryError("out of host memory")
        return image


@pytest.mark.parametrize("step", ["enqueue", "collect"])
def test_a_frame_that_fails_under_way_is_named_and_the_others_come_out(opened: Device, step: str) -> None:
    plan = restoration(opened)
    taken = frames(7)
    work = RestoredFrames(plan) if step == "enqueue" else _Failing(plan)

    def source() -> Iterator[NDArray[np.uint8]]:
        for k, frame in enumerate(taken):
            if step == "enqueue":
                work.slot = 5 if k == 2 else 0  # a slot without a filter
            yield frame

    stream = Stream(work)
    results = []
    with pytest.raises(StreamError, match="frame 2 failed: ") as said:
        results.extend(stream.run(source()))
    assert isinstance(said.value.__cause__, InputError if step == "enqueue" else MemoryError)
    assert [result.numbers[0] for result in results] == [0, 1, 3]
    np.testing.assert_array_equal(results[2].values[0], plan.restore(taken[3]))
    assert stream.in_flight == 0
    again = list(stream.run(taken))
    assert [result.numbers[0] for result in again] == list(range(4, 11))


def test_of_a_pair_that_fails_nothing_is_left_behind(device: Device) -> None:
    plan = restoration(device)
    works = RestoredFrames(plan), RestoredFrames(plan)
    stream = Stream(*works, policy="newest")
    frame = frames(1)[0]
    works[1].slot = 5
    for camera in (0, 1):
        stream.submit(frame, camera)
    works[1].slot = 0
    with pytest.raises(StreamError, match="the pair of frames 0 and 0 failed: slot 5"):
        stream.take()
    for camera in (0, 1):
        stream.submit(frame, camera)
    for image in stream.take().values:
        np.testing.assert_array_equal(image, plan.restore(frame))


def test_two_sources_of_unlike_length_are_refused_after_the_pairs(device: Device) -> None:
    plan = restoration(device)
    stream = Stream(RestoredFrames(plan), RestoredFrames(plan))
    results = []
    with pytest.raises(InputError, match="camera 1 ended after 3 frames"):
        results.extend(stream.run(frames(5), frames(3)))
    assert [result.numbers for result in results] == [(0, 0), (1, 1), (2, 2)]
    assert stream.dropped == [1, 0]  # the frame without its partner


def test_leaving_a_stream_drops_what_is_under_way(opened: Device) -> None:
    with Stream(RestoredFrames(restoration(opened))) as stream:
        for frame in frames(2):
            stream.submit(frame)
    assert stream.dropped == [2]
    assert stream.in_flight == 0
    assert stream.take() is None


def test_a_stream_that_cannot_be_is_refused(device: Device) -> None:
    plan = restoration(device)
    two, three = RestoredFrames(plan), RestoredFrames(plan, buffers=3)
    for made, message in (
        (lambda: Stream(), "no work came"),
        (lambda: Stream(two, three), r"\[2, 3\] buffers"),
        (lambda: Stream(two, policy="oldest"), "policy is 'oldest'"),  # type: ignore[arg-type]
        (lambda: Stream(RestoredFrames(plan, buffers=1), policy="newest"), "a second one was wanted"),
        (lambda: RestoredFrames(plan, buffers=0), "buffers is 0"),
        (lambda: Stream(two, policy="newest").run([]), "run loses no frame"),
        (lambda: Stream(two).run([], []), "2 sources came: 1"),
    ):
        with pytest.raises(InputError, match=message):
            made()
    busy = Stream(two)
    busy.submit(frames(1)[0])
    with pytest.raises(InputError, match="under way"):
        busy.run([])
    assert busy.take().numbers == (0,)


# ---- features ---------------------------------------------------------------------------------------------


def picture(seed: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    blocks = np.kron(rng.integers(30, 226, (17, 22)), np.ones((6, 6)))[:97, :129]
    return np.clip(np.rint(blocks + rng.normal(0, 1, (97, 129))), 0, 255).astype(np.uint8)


def taught(device: Device, seed: int, buffers: int) -> CameraPipeline:
    pipeline = CameraPipeline(
        device, OpticalSystem(), (97, 129), tuple(PARTS), padding=16, search_shape=(32, 32), buffers=buffers
    )
    for part, places in PARTS.items():
        pipeline.set_templates(part, [Template.cut(picture(seed), place, (16, 16)) for place in places])
    return pipeline


def shots(seed: int, amount: int) -> list[Shot]:
    """Frames that move, and blurs that change often enough to form filters while frames are under way."""
    taken = []
    for k in range(amount):
        frame = np.roll(picture(seed), (k % 3, -(k % 4)), axis=(0, 1))
        blurs = {"peg": Blur(1.0, 0.0) if k % 4 else None, "hole": Blur(1.0 + 0.1 * (k % 3), 0.2 * (k % 2))}
        places = {part: np.array(at) + k % 2 for part, at in PARTS.items()}
        if k % 5 == 4:
            del blurs["peg"]
        taken.append(Shot(frame, blurs, places))
    return taken


def assert_alike(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one.keys() == other.keys()
    for part, measured in one.items():
        for here, there in zip(measured, other[part], strict=True):
            np.testing.assert_array_equal(here.feature_xy_px, there.feature_xy_px)
            np.testing.assert_array_equal(here.covariance, there.covariance)
            assert (here.ssd, here.mismatch, here.gain, here.reason) == (
                there.ssd, there.mismatch, there.gain, there.reason,
            )  # fmt: skip


def test_features_of_two_cameras_are_those_of_each_frame_alone_to_the_last_bit(opened: Device) -> None:
    taken = [shots(seed, 14) for seed in (1, 2)]
    wanted = []
    for seed in (1, 2):
        single = taught(opened, seed, 1)
        wanted.append([single(s.frame, s.blurs, s.expected_xy_px) for s in taken[seed - 1]])
    assert not all(m.lost for found in wanted[0] for measured in found.values() for m in measured)
    stream = Stream(*(taught(opened, seed, 3) for seed in (1, 2)))
    results = list(stream.run(*taken))
    assert [result.numbers for result in results] == [(k, k) for k in range(14)]
    for k, result in enumerate(results):
        for camera in (0, 1):
            assert_alike(result.values[camera], wanted[camera][k])


def test_the_last_images_are_those_of_the_frame_last_collected(opened: Device) -> None:
    streamed, single = taught(opened, 1, 2), taught(opened, 1, 1)
    taken = shots(1, 6)
    for shot, _ in zip(taken, Stream(streamed).run(taken), strict=True):
        single(shot.frame, shot.blurs, shot.expected_xy_px)
        found, wanted = streamed.last_images(), single.last_images()
        assert found.keys() == wanted.keys()
        for part, image in found.items():
            np.testing.assert_array_equal(image, wanted[part])


@pytest.mark.parametrize(
    ("blurs", "places", "error"),
    [
        ({"nut": None}, {"nut": PARTS["peg"]}, InputError),
        ({"peg": None}, {}, InputError),
        ({"peg": None}, {"peg": [(1.0, 2.0)]}, InputError),
        ({"peg": None}, {"peg": [(1.0, 2.0), (np.nan, 2.0)]}, InputError),
        ({"peg": Blur(np.inf, 0.0)}, {"peg": PARTS["peg"]}, InputError),
        ({"peg": Blur(1.0, 1e9)}, {"peg": PARTS["peg"]}, LimitError),
    ],
    ids=["unknown part", "no place", "one place", "no number", "infinite", "beyond"],
)
def test_a_refused_shot_leaves_the_one_waiting_in_its_place(
    device: Device, blurs: dict[str, Blur | None], places: dict[str, Any], error: type[AdofError]
) -> None:
    stream = Stream(taught(device, 1, 2), policy="newest")
    taken = shots(1, 2)
    for shot in taken:
        stream.submit(shot)
    with pytest.raises(error, match="frame 2: "):
        stream.submit(Shot(taken[0].frame, blurs, places))
    single = taught(device, 1, 1)
    for shot in taken:
        assert_alike(stream.take().values[0], single(shot.frame, shot.blurs, shot.expected_xy_px))


def test_templates_and_single_frames_wait_until_no_frame_is_under_way(device: Device) -> None:
    pipeline = taught(device, 1, 2)
    shot = shots(1, 1)[0]
    stream = Stream(pipeline)
    stream.submit(shot)
    with pytest.raises(InputError, match="frames are under way"):
        pipeline.set_templates("peg", pipeline.templates("peg"))
    with pytest.raises(InputError, match="buffer 0 is under way"):
        pipeline(shot.frame, shot.blurs, shot.expected_xy_px)
    with pytest.raises(InputError, match="buffer 0 is under way"):
        pipeline.restored(shot.frame, {"peg": Blur(1.0, 0.0)})
    found = stream.take().values[0]
    assert_alike(found, pipeline(shot.frame, shot.blurs, shot.expected_xy_px))
    with pytest.raises(InputError, match="nothing is under way in buffer 1"):
        pipeline.collect(1)
    pipeline.set_templates("peg", pipeline.templates("peg"))


def test_templates_set_again_are_followed_in_every_buffer(device: Device) -> None:
    pipeline = taught(device, 1, 3)
    shot = Shot(picture(1), {"peg": None}, PARTS)
    pipeline.set_templates("peg", [t.anchored(t.anchor_yx + 1.5) for t in pipeline.templates("peg")])
    for result in Stream(pipeline).run([shot] * 6):
        found = [m.feature_xy_px for m in result.values[0]["peg"]]
        np.testing.assert_allclose(found, np.array(PARTS["peg"]) + 1.5, atol=0.02)


def test_a_pipeline_needs_a_buffer_and_templates(device: Device) -> None:
    with pytest.raises(InputError, match="buffers is 0"):
        CameraPipeline(device, OpticalSystem(), (64, 80), ("peg",), buffers=0)
    empty = CameraPipeline(device, OpticalSystem(), (64, 80), ("peg",), buffers=2)
    with pytest.raises(TrackingError, match="frame 0: part 'peg' has no templates"):
        Stream(empty).submit(Shot(np.zeros((64, 80), np.uint8), {"peg": None}, PARTS))


# ---- memory -----------------------------------------------------------------------------------------------


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_thousands_of_frames_take_no_memory(device: Device, tmp_path: Path) -> None:
    """Whatever were kept of a frame, an event or an array's header, takes more than 64 bytes, every time."""
    curve = tmp_path / "curve.json"
    script = [sys.executable, TREE / "benchmarks" / "endurance.py", "--frames", "3000", "--json", curve]
    run = subprocess.run(
        [*script, "--device", str(device.facts.index)], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stdout + run.stderr
    points = json.loads(curve.read_text())["points"]
    # An allocator may take a few pages once; a leak takes them again.
    thirds = [points[len(points) * k // 3 - 1] for k in (1, 2, 3)]
    grown = [(here[1] - there[1]) / (here[0] - there[0]) for there, here in itertools.pairwise(thirds)]
    assert min(grown) < 64
