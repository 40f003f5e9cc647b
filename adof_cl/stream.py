"""Streams of frames from one or two cameras, several under way: copies and host work hide behind kernels.

A stream knows nothing of what is done to a frame. Its `Work` does: `pipeline.CameraPipeline` turns shots
into features, `RestoredFrames` frames into images. The stream keeps order, decides who waits or is dropped,
and has no thread of its own: everything happens in the calls of the caller's threads.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, TypeVar

from numpy.typing import NDArray

from adof_cl.errors import AdofError, InputError, StreamError
from adof_cl.optics import require_whole
from adof_cl.restore import Restore, require_finite_image

Item = TypeVar("Item")
Value = TypeVar("Value")
_Item = TypeVar("_Item", contravariant=True)
_Value = TypeVar("_Value", covariant=True)


class Work(Protocol[_Item, _Value]):
    """What is done to one camera's frames, each in one of `buffers` buffers of its own.

    A buffer is staged, enqueued and collected in turn. The stream never calls `stage` and `enqueue` of one
    work at the same time, but `collect` of one buffer may run beside `stage` and `enqueue` of another.
    """

    @property
    def buffers(self) -> int:
        """How many frames can be under way."""

    def stage(self, buffer: int, item: _Item) -> None:
        """Take a copy of `item`, in place of what was staged there before; refuse it and change nothing."""

    def enqueue(self, buffer: int) -> None:
        """Enqueue everything that makes a result of what is staged; does not wait."""

    def ready(self, buffer: int) -> bool:
        """Whether `collect` would not have to wait for the device."""

    def collect(self, buffer: int) -> _Value:
        """Wait for this buffer alone and return its result, which no later frame touches."""


@dataclass(frozen=True, slots=True)
class Result(Generic[Value]):
    """What came of one frame of each camera, in the order of the cameras.

    Attributes
    ----------
    numbers
        Which frame it was, counted from 0 for each camera; where numbers are missing, frames were dropped.
    times_s
        As handed in with the frames, else the stream's clock when they came.
    done_s
        The stream's clock when the result was taken.
    values
        What the work made of the frames.
    """

    numbers: tuple[int, ...]
    times_s: tuple[float, ...]
    done_s: float
    values: tuple[Value, ...]


@dataclass(slots=True)
class _Flight:
    """Frames under way in one buffer; `enqueued` works have begun on them."""

    buffer: int
    numbers: tuple[int, ...]
    times_s: tuple[float, ...]
    enqueued: int = 0
    failure: Exception | None = None


class Stream(Generic[Item, Value]):
    """Send frames through a work for each camera; results come in the order of the frames.

    `run` is all that a loop needs that has its frames at hand. Where a camera has a thread of its own, that
    thread calls `submit` and another one `poll` or `take`; every method may be called from any thread. With
    two cameras, frames are paired as they come.

    Parameters
    ----------
    works
        One for each camera, all with as many buffers. At most so many frames (pairs) are held.
    policy
        "lossless": every frame gives a result; `submit` waits for room. "newest": `submit` never waits; one
        buffer holds the frame that is next, and a newer one takes its place.
    clock
        Seconds, for frames that come without a time.

    Attributes
    ----------
    dropped
        For each camera, how many frames were taken and gave neither a result nor an error.

    Raises
    ------
    InputError
        No work, works of unlike `buffers`, an unknown policy, or "newest" with a single buffer.
    """

    def __init__(
        self,
        *works: Work[Item, Value],
        policy: Literal["lossless", "newest"] = "lossless",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not works:
            raise InputError("no work came: give one for each camera")
        counts = {work.buffers for work in works}
        if len(counts) > 1:
            raise InputError(f"works of {sorted(counts)} buffers came: give all as many")
        if policy not in ("lossless", "newest"):
            raise InputError(f"policy is '{policy}': choose 'lossless' or 'newest'")
        self.works = works
        self.policy = policy
        self.clock = clock
        self.most = counts.pop() - (policy == "newest")
        if self.most < 1:
            raise InputError("policy 'newest' with 1 buffer: a second one was wanted, for the frame waiting")
        self.dropped = [0] * len(works)
        self._next_numbers = [0] * len(works)
        self._free = deque(range(self.most + (policy == "newest")))
        self._filling: int | None = self._free.popleft()
        self._staged: list[tuple[int, float] | None] = [None] * len(works)
        self._flights: deque[_Flight] = deque()
        self._closed = False
        self._changed = threading.Condition()
        self._taking = threading.Lock()

    # ---- frames in ----------------------------------------------------------------------------------------

    def submit(self, item: Item, camera: int = 0, *, time_s: float | None = None) -> int:
        """Take a copy of a frame and start on it as soon as there is room; return its number.

        Lossless, this waits while there is no room, so another thread must take results.

        Raises
        ------
        InputError
            What the work refuses; the message says which frame. Nothing changes, and its number is free.
        StreamError
            The stream was closed.
        """
        if not 0 <= camera < len(self.works):
            raise InputError(f"camera is {camera}: this stream has {len(self.works)}, counted from 0")
        time_s = self.clock() if time_s is None else time_s
        with self._changed:
            while self.policy == "lossless" and not self._room(camera) and not self._closed:
                self._changed.wait()
            if self._closed:
                raise StreamError("the stream is closed: open a new one")
            assert self._filling is not None  # "newest" keeps a buffer for it
            number = self._next_numbers[camera]
            try:
                self.works[camera].stage(self._filling, item)
            except AdofError as refusal:
                raise type(refusal)(f"{self._name(camera, number)}: {refusal}") from refusal
            self.dropped[camera] += self._staged[camera] is not None
            self._staged[camera] = number, time_s
            self._next_numbers[camera] += 1
            self._start()
            return number

    def close(self) -> None:
        """Take no more frames: who waits in `submit` is refused; results under way can still be taken."""
        with self._changed:
            self._closed = True
            if None in self._staged:  # a frame without its partner
                self._drop_staged()
            self._changed.notify_all()

    def __enter__(self) -> Stream[Item, Value]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
        self._discard()

    # ---- results out --------------------------------------------------------------------------------------

    @property
    def in_flight(self) -> int:
        """How many frames (pairs) are enqueued whose results were not taken yet."""
        return len(self._flights)

    def poll(self) -> Result[Value] | None:
        """Return the next result if it is ready, else None; raises as `take`."""
        with self._taking:
            with self._changed:
                flight = self._flights[0] if self._flights else None
            if flight is None:
                return None
            begun = self.works[: flight.enqueued]
            return self._collect(flight) if all(work.ready(flight.buffer) for work in begun) else None

    def take(self) -> Result[Value] | None:
        """Wait for the next result; None once the stream is closed and nothing is under way.

        Raises
        ------
        StreamError
            This frame failed; the message says which, its cause is kept. Its buffer is free, and the results
            of the frames after it can be taken.
        """
        with self._taking:
            with self._changed:
                while not self._flights and not self._closed:
                    self._changed.wait()
                flight = self._flights[0] if self._flights else None
            return None if flight is None else self._collect(flight)

    def __iter__(self) -> Iterator[Result[Value]]:
        """Yield results until the stream is closed and nothing is under way; raises as `take`."""
        while (result := self.take()) is not None:
            yield result

    # ---- both in one thread -------------------------------------------------------------------------------

    def run(self, *sources: Iterable[Item]) -> Iterator[Result[Value]]:
        """Send every frame of the sources, one for each camera, and yield the results in order; loses none.

        When a source or a frame fails, no more frames are read, the results under way are yielded, and then
        the failure is raised. A caller who stops early drops what is under way.

        Raises
        ------
        InputError
            Not a source for each camera, one that ends before the other, a stream that may drop frames or has
            some under way, or a frame that is refused.
        StreamError
            As `take`.
        """
        if self.policy != "lossless":
            raise InputError("run loses no frame: make the stream lossless, or submit and poll")
        if len(sources) != len(self.works):
            raise InputError(f"{len(sources)} sources came: {len(self.works)} were wanted, one a camera")
        if self._flights or any(self._staged):
            raise InputError("frames are under way: take their results before run")
        return self._run([iter(source) for source in sources])

    def _run(self, sources: list[Iterator[Item]]) -> Iterator[Result[Value]]:
        failures: list[Exception] = []
        more = True
        try:
            while more or self._flights:
                if more:
                    try:
                        more = self._submit_next(sources)
                    except Exception as failure:  # noqa: BLE001 (whatever a source throws: raised below)
                        failures.append(failure)
                        more = False
                if self._flights and (not more or len(self._flights) == self.most):
                    try:
                        result = self.take()
                    except StreamError as failure:
                        failures.append(failure)
                        more = False
                        continue
                    assert result is not None
                    yield result
        finally:
            self._discard()
        for other in failures[1:]:
            failures[0].add_note(f"then also {other}")
        if failures:
            raise failures[0]

    def _submit_next(self, sources: list[Iterator[Item]]) -> bool:
        """Submit the next frame of each source; False at their end."""
        ended: list[int] = []
        for camera, source in enumerate(sources):
            for item in source:
                if ended:
                    break
                self.submit(item, camera)
                break
            else:
                ended.append(camera)
        if ended and len(ended) < len(sources):
            raise InputError(
                f"camera {ended[0]} ended after {self._next_numbers[ended[0]]} frames and another goes on: "
                "give as many of each"
            )
        return not ended

    # ---- inside; the lock is held where frames or flights change -------------------------------------------

    def _room(self, camera: int) -> bool:
        return self._filling is not None and self._staged[camera] is None

    def _start(self) -> None:
        """Enqueue what is staged, if it is complete and there is room."""
        staged = [frame for frame in self._staged if frame is not None]
        if len(staged) < len(self.works) or len(self._flights) == self.most or self._filling is None:
            return
        numbers, times_s = zip(*staged, strict=True)
        flight = _Flight(self._filling, numbers, times_s)
        try:
            for work in self.works:
                work.enqueue(flight.buffer)
                flight.enqueued += 1
        except Exception as failure:  # noqa: BLE001 (kept for who takes this frame's result)
            flight.failure = failure
        self._flights.append(flight)
        self._staged = [None] * len(self.works)
        self._filling = self._free.popleft() if self._free else None
        self._changed.notify_all()

    def _collect(self, flight: _Flight) -> Result[Value]:
        """Wait for the oldest flight; then its buffer is free, and what waited for room starts."""
        values: list[Value] = []
        failure = flight.failure
        for work in self.works[: flight.enqueued]:
            try:
                values.append(work.collect(flight.buffer))
            except Exception as found:  # noqa: BLE001 (raised below, once the buffer is free)
                failure = failure or found
        with self._changed:
            self._flights.popleft()
            self._free.append(flight.buffer)
            if self._filling is None:
                self._filling = self._free.popleft()
            self._start()
            self._changed.notify_all()
        if failure is not None:
            raise StreamError(f"{self._name(0, *flight.numbers)} failed: {failure}") from failure
        return Result(flight.numbers, flight.times_s, self.clock(), tuple(values))

    def _discard(self) -> None:
        """Drop everything under way and free its buffers; errors of frames nobody wants are nobody's."""
        with self._taking:
            while True:
                with self._changed:
                    if not self._flights:
                        self._drop_staged()
                        return
                    flight = self._flights[0]
                    self._drop_staged()
                    for camera in range(len(self.works)):
                        self.dropped[camera] += 1
                try:
                    self._collect(flight)
                except StreamError:
                    continue

    def _drop_staged(self) -> None:
        for camera, frame in enumerate(self._staged):
            self.dropped[camera] += frame is not None
        self._staged = [None] * len(self.works)

    def _name(self, camera: int, *numbers: int) -> str:
        if len(self.works) == 1:
            return f"frame {numbers[0]}"
        if len(numbers) == 1:
            return f"frame {numbers[0]} of camera {camera}"
        return "the pair of frames " + " and ".join(map(str, numbers))


class RestoredFrames:
    """Restore frames into images on the host, as the work of a stream.

    Parameters
    ----------
    plan
        With a filter in `slot`. Nobody else may use it from another thread while the stream runs.
    slot
        Which of the plan's filters to apply; another may be chosen, or the filter be changed, between frames.
    buffers
        Frames that can be under way at once, each with a frame and an image on the device and the host.
    """

    def __init__(self, plan: Restore, *, slot: int = 0, buffers: int = 2) -> None:
        require_whole(buffers=buffers)
        self.plan = plan
        self.slot = slot
        self.buffers = buffers
        device = plan.device
        self._frames = [device.empty(plan.shape, plan.in_dtype) for _ in range(buffers)]
        self._images = [device.empty(plan.shape, plan.out_dtype) for _ in range(buffers)]

    def stage(self, buffer: int, frame: NDArray[Any]) -> None:
        """Take a copy of a frame, (rows, columns) of the plan's `in_dtype`.

        Raises
        ------
        InputError
            Another shape or type, NaN or infinity.
        LimitError
            A frame of reals too large for an image of integers.
        """
        self._frames[buffer].require_alike(frame)
        self.plan.require_frame(frame)
        self._frames[buffer].stage(frame)

    def enqueue(self, buffer: int) -> None:
        """Enqueue the restoration of what is staged; does not wait."""
        self.plan(self._frames[buffer].send(), self._images[buffer], self.slot)
        self._images[buffer].begin_download()

    def ready(self, buffer: int) -> bool:
        """Whether the image has come."""
        return self._images[buffer].arrived

    def collect(self, buffer: int) -> NDArray[Any]:
        """Wait for the image and return it, (rows, columns) of the plan's `out_dtype`, the caller's own.

        Raises
        ------
        LimitError
            The image does not fit its type.
        """
        image = self._images[buffer].download()
        require_finite_image(image)
        return image
