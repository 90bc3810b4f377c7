"""Slot between a source and its one consumer: holds only the newest item.

Old images are worth less than new ones, so an item that was not taken yet gives way to the next. All of it happens on
the event loop; a producing thread hands over with `loop.call_soon_threadsafe(slot.put, …)`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Generic, TypeVar

from swarmtrack.camera_sources.limits import CAMERA_CLOSE_TIMEOUT_S
from swarmtrack.camera_sources.source_status import SourceStatus
from swarmtrack.clock import Clock

T = TypeVar("T")


class NewestSlot(Generic[T]):
    """Slot for one T, with one producer and one consumer. `source` counts what becomes of the frames.

    discard: called, once, with each item that was replaced before it was taken.
    """

    def __init__(self, name: str, clock: Clock, discard: Callable[[T], None] = lambda _: None) -> None:
        self.source = SourceStatus(name, clock)
        self._discard = discard
        self._newest: T | None = None
        self._changed = asyncio.Event()
        self._ended = False
        self._error: BaseException | None = None

    # the producer's side ------------------------------------------------------------------------------------------

    def put(self, item: T) -> None:
        if self._ended:
            self._discard(item)
            return
        if self._newest is not None:
            self.source.counts.dropped += 1
            self._discard(self._newest)
        self._newest = item
        self.source.came()
        self._changed.set()

    def end(self, error: BaseException | None = None) -> None:
        """End the sequence. The consumer still gets a waiting item, then `error` or the end."""
        self._ended = True
        self._error = self._error or error
        self._changed.set()

    @property
    def ended(self) -> bool:
        return self._ended

    def clear(self) -> None:
        """Discard the waiting item, whose camera is gone."""
        if self._newest is not None:
            self._discard(self._newest)
            self._newest = None

    # the consumer's side ------------------------------------------------------------------------------------------

    async def arrived(self) -> None:
        """Wait for an item or the end."""
        while self._newest is None and not self._ended:
            self._changed.clear()
            await self._changed.wait()

    async def get(self) -> T | None:
        """Wait for the newest item; None after the end."""
        await self.arrived()
        if self._newest is None:
            if self._error is not None:
                raise self._error
            return None
        item, self._newest = self._newest, None
        return item


def start(run: Callable[[], Coroutine[Any, Any, None]], slot: NewestSlot[Any]) -> asyncio.Task[None] | None:
    """Run a producer as a task; its end or failure ends the slot's frames. Does nothing after the end."""
    if slot.ended:
        return None
    task = asyncio.create_task(run(), name="camera")
    task.add_done_callback(lambda task: slot.end(None if task.cancelled() else task.exception()))
    return task


async def stop(task: asyncio.Task[None] | None, slot: NewestSlot[Any]) -> None:
    """Stop a producer and its consumer's iteration; always returns within CAMERA_CLOSE_TIMEOUT_S."""
    slot.clear()
    slot.end()
    if task is not None and not task.done():
        task.cancel()
        await asyncio.wait([task], timeout=CAMERA_CLOSE_TIMEOUT_S)
