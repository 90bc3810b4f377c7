"""Between a source and its one consumer: room for the newest thing it sent, and the account of all the others.

What a camera saw a moment ago is worth less than what it sees now, so what nobody took yet gives way to the next.
All of it happens on the event loop; a thread that produces hands over with `loop.call_soon_threadsafe(slot.put, …)`.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from swarmtrack.clock import Clock
from swarmtrack.messages import LinkStatus

log = logging.getLogger(__name__)

RATE_WINDOW = 2.0  # s over which rates are counted
BACKOFF_FIRST, BACKOFF_LONGEST = 0.5, 5.0  # s between two attempts to open a camera that is away
CLOSE_TIMEOUT = 0.8  # s: a read in progress ends by its own timeout, which may be longer than anybody waits

T = TypeVar("T")


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


class NewestSlot(Generic[T]):
    """Room for one T. One producer puts, one consumer takes.

    discard: called, once, with what gave way and was never taken.
    """

    def __init__(self, name: str, clock: Clock, discard: Callable[[T], None] = lambda _: None) -> None:
        self.counts = Counts()
        self.name = name
        self._clock = clock
        self._discard = discard
        self._newest: T | None = None
        self._changed = asyncio.Event()
        self._ended = False
        self._error: BaseException | None = None
        self._ok, self._text = False, "not opened yet"
        self._trouble = ""
        self._put_times: deque[float] = deque(maxlen=512)
        # (now, age) of what was given to the consumer
        self._given: deque[tuple[float, float]] = deque(maxlen=256)
        self._t_sigma = 0.0

    # the producer's side ------------------------------------------------------------------------------------------

    def put(self, item: T) -> None:
        if self._ended:
            self._discard(item)
            return
        if self._newest is not None:
            self.counts.dropped += 1
            self._discard(self._newest)
        self._newest = item
        self._put_times.append(self._clock.now())
        self._changed.set()

    def say(self, ok: bool, text: str) -> None:
        """Set the one line about this source; logged when it changes, not when it is said again."""
        if (ok, text) != (self._ok, self._text):
            log.log(logging.INFO if ok else logging.WARNING, "camera %s: %s", self.name, text)
        self._ok, self._text = ok, text

    def end(self, error: BaseException | None = None) -> None:
        """Nothing more will come. The consumer still gets what waits, then `error` or the end."""
        self._ended = True
        self._error = self._error or error
        self._changed.set()

    @property
    def ended(self) -> bool:
        return self._ended

    def clear(self) -> None:
        """Give back what waits, unseen: its camera is gone."""
        if self._newest is not None:
            self._discard(self._newest)
            self._newest = None

    # the consumer's side ------------------------------------------------------------------------------------------

    async def take(self) -> T | None:
        """The newest, as soon as there is one; None after the end."""
        while self._newest is None:
            if self._ended:
                if self._error is not None:
                    raise self._error
                return None
            self._changed.clear()
            await self._changed.wait()
        item, self._newest = self._newest, None
        return item

    def given(self, t: float, t_sigma: float) -> None:
        """What was taken was of use, and goes to the consumer. t: its exposure, t_sigma: that time's uncertainty."""
        now = self._clock.now()
        self._given.append((now, now - t))
        self._t_sigma = t_sigma
        self.counts.frames += 1
        self._trouble = ""

    def refuse(self, text: str) -> None:
        """What was taken is of no use, and why; said until something is."""
        if text != self._trouble:
            log.warning("camera %s: %s", self.name, text)
        self._trouble = text

    # for people and the health message ----------------------------------------------------------------------------

    def status(self) -> LinkStatus:
        now = self._clock.now()
        fps = _rate(self._put_times, now)
        text = self._trouble or self._text
        if self._ok and self._put_times:
            text += f"; {fps:.1f} fps"
        ages: tuple[tuple[str, float], ...] = ()
        if self._given:
            p50, p95 = (float(age) for age in np.percentile([1e3 * age for _, age in self._given], (50, 95)))
            ages = (("age_p50_ms", p50), ("age_p95_ms", p95), ("t_sigma_ms", 1e3 * self._t_sigma))
            if self._ok and p50 >= 0.0:  # below: the frames of a recording set the clock, and have no age
                text += f", age {p50:.0f} ms"
        counts = self.counts
        numbers = (
            ("fps", fps),
            ("used_fps", _rate(deque(now for now, _ in self._given), now)),
            ("frames", counts.frames),
            ("dropped", counts.dropped),
            ("lost", counts.lost),
            ("stale", counts.stale),
            ("corrupt", counts.corrupt),
            ("wrong_size", counts.wrong_size),
            ("reconnects", counts.reconnects),
            *ages,
        )
        return LinkStatus(name=self.name, ok=self._ok and not self._trouble, text=text, counters=numbers)


def start(run: Callable[[], Coroutine[Any, Any, None]], slot: NewestSlot[Any]) -> asyncio.Task[None] | None:
    """Run a producer as a task; its end, or its failure, is the end of the slot's frames. Not after the end."""
    if slot.ended:
        return None
    task = asyncio.create_task(run(), name="camera")
    task.add_done_callback(lambda task: slot.end(None if task.cancelled() else task.exception()))
    return task


async def stop(task: asyncio.Task[None] | None, slot: NewestSlot[Any]) -> None:
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
