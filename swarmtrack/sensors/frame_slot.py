"""Between a camera and its one consumer: room for the newest frame, and the account of all the others.

A late video frame is worthless, so a frame that nobody took yet gives way to the next. Images are decoded only when
they are taken, in a worker thread. All of it but the decoding happens on the event loop; a thread that produces
frames hands them over with `loop.call_soon_threadsafe(slot.put, raw)`.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from swarmtrack.messages import Frame, Image, LinkStatus, StampKind
from swarmtrack.runtime.clock import Clock

log = logging.getLogger(__name__)

RATE_WINDOW = 2.0  # s over which rates are counted
BACKOFF_FIRST, BACKOFF_LONGEST = 0.5, 5.0  # s between two attempts to open a camera that is away
CLOSE_TIMEOUT = 0.8  # s: a read in progress ends by its own timeout, which may be longer than anybody waits


class BadImage(Exception):
    """Bytes that are no image, or only a part of one."""


class WrongSize(Exception):
    """An image that the calibration does not speak about."""


def _nothing() -> None:
    pass


@dataclass(frozen=True, slots=True)
class RawFrame:
    """A frame as it left the camera. `decode` may be slow and runs in a thread; raises BadImage.

    `release` gives the camera its buffer back; it is called on the event loop, once, whatever happened to the frame.
    """

    t: float
    t_sigma: float
    sequence: int
    stamp: StampKind
    decode: Callable[[], Image]
    release: Callable[[], None] = _nothing


def already(image: Image) -> Callable[[], Image]:
    """The `decode` of a frame that came decoded."""
    return lambda: image


@dataclass(slots=True)
class Counts:
    """What became of all frames since the start."""

    frames: int = 0  # given to the consumer
    dropped: int = 0  # gave way to a newer one, because the consumer was busy
    lost: int = 0  # never reached us: gaps of the camera's own sequence
    stale: int = 0  # waited in the camera's buffers until they were worthless
    corrupt: int = 0
    wrong_size: int = 0
    reconnects: int = 0


class FrameSlot:
    """Room for one frame. One producer puts, one consumer iterates `frames()`."""

    def __init__(self, name: str, clock: Clock, size: tuple[int, int] | None, resize: bool) -> None:
        """size: (width, height) in pixels of the calibration, None: any; resize: scale to it instead of refusing."""
        self.counts = Counts()
        self._name = name
        self._clock = clock
        self._size = size
        self._resize = resize
        self._newest: RawFrame | None = None
        self._changed = asyncio.Event()
        self._ended = False
        self._error: BaseException | None = None
        self._ok, self._text = False, "not opened yet"
        self._wrong_size_said = ""
        self._put_times: deque[float] = deque(maxlen=512)
        # (now, age) of the frames given to the consumer
        self._taken: deque[tuple[float, float]] = deque(maxlen=256)
        self._t_sigma = 0.0

    # the producer's side ------------------------------------------------------------------------------------------

    def put(self, raw: RawFrame) -> None:
        if self._ended:
            raw.release()
            return
        if self._newest is not None:
            self.counts.dropped += 1
            self._newest.release()
        self._newest = raw
        self._put_times.append(self._clock.now())
        self._changed.set()

    def say(self, ok: bool, text: str) -> None:
        """Set the one line about this camera; logged when it changes, not when it is said again."""
        if (ok, text) != (self._ok, self._text):
            log.log(logging.INFO if ok else logging.WARNING, "camera %s: %s", self._name, text)
        self._ok, self._text = ok, text

    def end(self, error: BaseException | None = None) -> None:
        """No more frames will come. The consumer still gets the one that waits, then `error` or the end."""
        self._ended = True
        self._error = self._error or error
        self._changed.set()

    @property
    def ended(self) -> bool:
        return self._ended

    def clear(self) -> None:
        """Give back the frame that waits, unseen: its camera is gone."""
        if self._newest is not None:
            self._newest.release()
            self._newest = None

    # the consumer's side ------------------------------------------------------------------------------------------

    async def frames(self) -> AsyncIterator[Frame]:
        while (raw := await self._take()) is not None:
            try:
                image = await asyncio.to_thread(self._develop, raw)
            except BadImage as error:
                self.counts.corrupt += 1
                log.debug("camera %s: frame %d dropped: %s", self._name, raw.sequence, error)
                continue
            except WrongSize as error:
                self.counts.wrong_size += 1
                self._say_wrong_size(str(error))
                continue
            finally:
                raw.release()
            self._wrong_size_said = ""
            now = self._clock.now()
            self._taken.append((now, now - raw.t))
            self._t_sigma = raw.t_sigma
            self.counts.frames += 1
            yield Frame(raw.t, raw.t_sigma, raw.sequence, image, raw.stamp)

    async def _take(self) -> RawFrame | None:
        while self._newest is None:
            if self._ended:
                if self._error is not None:
                    raise self._error
                return None
            self._changed.clear()
            await self._changed.wait()
        raw, self._newest = self._newest, None
        return raw

    def _develop(self, raw: RawFrame) -> Image:
        return fit(raw.decode(), self._size, self._resize)

    def _say_wrong_size(self, text: str) -> None:
        if text != self._wrong_size_said:
            log.warning("camera %s: %s", self._name, text)
        self._wrong_size_said = text

    # for people and the health message ----------------------------------------------------------------------------

    def status(self) -> LinkStatus:
        now = self._clock.now()
        fps = _rate(self._put_times, now)
        text = self._wrong_size_said or self._text
        if self._ok and self._put_times:
            text += f"; {fps:.1f} fps"
        ages: tuple[tuple[str, float], ...] = ()
        if self._taken:
            p50, p95 = (float(age) for age in np.percentile([1e3 * age for _, age in self._taken], (50, 95)))
            ages = (("age_p50_ms", p50), ("age_p95_ms", p95), ("t_sigma_ms", 1e3 * self._t_sigma))
            if self._ok and p50 >= 0.0:  # below: the frames of a recording set the clock, and have no age
                text += f", age {p50:.0f} ms"
        counts = self.counts
        numbers = (
            ("fps", fps),
            ("used_fps", _rate(deque(now for now, _ in self._taken), now)),
            ("frames", counts.frames),
            ("dropped", counts.dropped),
            ("lost", counts.lost),
            ("stale", counts.stale),
            ("corrupt", counts.corrupt),
            ("wrong_size", counts.wrong_size),
            ("reconnects", counts.reconnects),
            *ages,
        )
        ok = self._ok and not self._wrong_size_said
        return LinkStatus(name=self._name, ok=ok, text=text, counters=numbers)


def start(run: Callable[[], Coroutine[Any, Any, None]], slot: FrameSlot) -> asyncio.Task[None] | None:
    """Run a producer as a task; its end, or its failure, is the end of the slot's frames. Not after the end."""
    if slot.ended:
        return None
    task = asyncio.create_task(run(), name="camera")
    task.add_done_callback(lambda task: slot.end(None if task.cancelled() else task.exception()))
    return task


async def stop(task: asyncio.Task[None] | None, slot: FrameSlot) -> None:
    """End a producer and the iteration of its consumer; returns within CLOSE_TIMEOUT, come what may."""
    slot.clear()
    slot.end()
    if task is not None and not task.done():
        task.cancel()
        await asyncio.wait([task], timeout=CLOSE_TIMEOUT)


def _rate(times: deque[float], now: float) -> float:
    """Events a second over the last RATE_WINDOW; before it has passed, over the time since the first event."""
    recent = [t for t in times if t > now - RATE_WINDOW]
    if len(recent) < 2:
        return 0.0
    if len(recent) == len(times):
        span = recent[-1] - recent[0]
        return (len(recent) - 1) / span if span > 0 else 0.0
    return len(recent) / RATE_WINDOW


def check_size(found: tuple[int, int], size: tuple[int, int] | None, resize: bool) -> None:
    """Raise WrongSize where images of (width, height) `found` must not meet a calibration for `size`."""
    if size is not None and found != size and not resize:
        raise WrongSize(
            f"frames are {found[0]}x{found[1]}, the calibration is for {size[0]}x{size[1]}: set the camera to that "
            "size, calibrate anew, or write resize=1 if it shows the same field of view"
        )


def fit(image: Image, size: tuple[int, int] | None, resize: bool) -> Image:
    """The image in the calibrated `size` (width, height): as it is, scaled if `resize`, else WrongSize."""
    height, width = image.shape[:2]
    check_size((width, height), size, resize)
    if size is None or (width, height) == size:
        return image
    smaller = size[0] * size[1] < width * height
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)


class Freshness:
    """Tells a frame that waited in a queue from one that merely took its time.

    A camera's age at arrival (readout, transfer) is its own; what waited is older than that by periods. So the
    yardstick is the youngest of the last frames, not zero: a camera with 70 ms of honest latency is never stale.
    """

    LIMIT = 1.5  # periods older than the youngest
    MEMORY = 32  # frames; after so many, a latency that grew for good is the new normal

    def __init__(self, period: float, depth: int) -> None:
        """period [s]: between frames, measured once they come; depth: frames that the queue can hold."""
        self._period = period
        self._depth = depth
        self._in_a_row = 0
        self._ages: deque[float] = deque(maxlen=self.MEMORY)
        self._last: tuple[float, int] | None = None

    def is_stale(self, t: float, sequence: int, now: float) -> bool:
        """Call for every frame in order; t: its exposure, sequence: the camera's count."""
        if self._last is not None and sequence > self._last[1] and t > self._last[0]:
            measured = (t - self._last[0]) / (sequence - self._last[1])
            self._period += 0.1 * (measured - self._period)
        self._last = (t, sequence)
        self._ages.append(now - t)
        late = now - t > min(self._ages) + self.LIMIT * self._period
        # More in a row than can have waited: not the queue is late but we are, and an old frame is better than none.
        self._in_a_row = self._in_a_row + 1 if late and self._in_a_row < self._depth else 0
        return self._in_a_row > 0
