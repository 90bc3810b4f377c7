"""Several cameras and one detector: who may have the next look, and at which frame.

Live cameras take turns (`FairTurns`): the one that has waited longest since its last look is next, with its newest
frame at that time (`NewestFrames`). A camera that sends nothing does not wait, so it delays no other. Recordings that
are processed as fast as they go are looked at in the order of their exposures instead (`in_order`), every frame of
each.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace

from swarmtrack.messages import Frame
from swarmtrack.sources import AnnouncingCamera, Camera

# s: a frame that was there and still is not decoded is not waited for by the other cameras.
LONGEST_DECODE = 0.2


class FairTurns:
    """Fair turns on the event loop: of several waiting for one resource, the one without it for longest is next."""

    def __init__(self) -> None:
        self._busy = False
        self._turns = itertools.count()
        self._last: dict[int, int] = {}
        """When each had its last turn, by their count."""
        self._waiting: dict[int, asyncio.Future[None]] = {}

    @asynccontextmanager
    async def turn(self, who: int) -> AsyncIterator[None]:
        """Wait for it; it lasts as long as the block."""
        if self._busy:
            granted = asyncio.get_running_loop().create_future()
            self._waiting[who] = granted
            try:
                await granted
            except asyncio.CancelledError:
                if granted.cancelled():
                    self._waiting.pop(who, None)
                else:
                    # It came at the same moment.
                    self._pass_on()
                raise
        self._busy = True
        self._last[who] = next(self._turns)
        try:
            yield
        finally:
            self._pass_on()

    def _pass_on(self) -> None:
        # Who gives up may not have come to say so yet.
        waiting = [who for who, granted in self._waiting.items() if not granted.done()]
        self._busy = bool(waiting)
        if waiting:
            following = min(waiting, key=lambda who: self._last.get(who, -1))
            self._waiting.pop(following).set_result(None)


class NewestFrames:
    """The frames of one of several live cameras, taken when its turn has come."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._frames = camera.frames()
        self._next: asyncio.Task[Frame | None] | None = None
        self.ended = False

    async def arrived(self) -> None:
        """Until there is something to take."""
        if self._next is None and isinstance(self._camera, AnnouncingCamera):
            await self._camera.arrived()
        else:
            self._next = self._next or asyncio.create_task(self._take())
            await asyncio.wait({self._next})

    async def get(self) -> Frame | None:
        """The newest frame; None where it was not an image, and after the camera's end."""
        self._next = self._next or asyncio.create_task(self._take())
        done, _ = await asyncio.wait({self._next}, timeout=LONGEST_DECODE)
        if not done:
            return None
        taken, self._next = self._next, None
        frame = taken.result()
        self.ended = frame is None
        return frame

    def close(self) -> None:
        if self._next is not None:
            self._next.cancel()

    async def _take(self) -> Frame | None:
        return await anext(self._frames, None)


async def in_order(cameras: Sequence[Camera]) -> AsyncIterator[Frame]:
    """All frames of recordings, the one first that was exposed first; each says of which camera it is."""
    frames = [camera.frames() for camera in cameras]
    heads = [await anext(one, None) for one in frames]
    while left := [(head.t, number, head) for number, head in enumerate(heads) if head is not None]:
        _, number, head = min(left, key=lambda one: one[:2])
        yield replace(head, camera=number)
        heads[number] = await anext(frames[number], None)
