"""A camera with a worker thread."""

from __future__ import annotations

import asyncio
import threading
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator

from swarmtrack.camera_sources.frame_slot import FrameSlot
from swarmtrack.camera_sources.limits import CAMERA_CLOSE_TIMEOUT_S
from swarmtrack.messages import Frame, LinkStatus


class ThreadCamera(ABC):
    """The thread starts with the first iteration of `frames`, feeds the slot, and ends once `_stop` is set."""

    def __init__(self, slot: FrameSlot) -> None:
        self._slot = slot
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @abstractmethod
    def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        """In the thread: hand over frames to the slot, on the loop."""

    def frames(self) -> AsyncIterator[Frame]:
        if self._thread is None and not self._stop.is_set():
            loop = asyncio.get_running_loop()
            # A daemon: a read that hangs (a dead network drive) must not keep the process.
            self._thread = threading.Thread(target=self._run, args=(loop,), name="camera", daemon=True)
            self._thread.start()
        return self._slot.frames()

    async def arrived(self) -> None:
        await self._slot.arrived()

    def status(self) -> LinkStatus:
        return self._slot.source.status()

    async def close(self) -> None:
        self._stop.set()
        self._slot.clear()
        self._slot.end()
        if self._thread is not None:
            await asyncio.to_thread(self._thread.join, CAMERA_CLOSE_TIMEOUT_S)
