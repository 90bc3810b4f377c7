"""Playback of a recording as a camera, in real time or as fast as possible.

A worker thread reads ahead by one picture. At pace `realtime` it shows each picture at its time, and one that was not
taken gives way to the next, as with a camera. At pace `fast` it waits until the last one was taken, so every picture
is seen, in order. The media time of the first picture is `clock.now()` at the start.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from typing import Protocol

from swarmtrack.camera_sources.address import CameraAddress
from swarmtrack.camera_sources.frame_slot import BadImage, FrameSlot, RawFrame, WrongSize, already, check_size
from swarmtrack.camera_sources.thread_camera import ThreadCamera
from swarmtrack.clock import Clock
from swarmtrack.errors import SourceError
from swarmtrack.messages import Frame, Image, StampKind

PACES = ("realtime", "fast")


@dataclass(frozen=True, slots=True)
class Picture:
    """One image of a recording. t: media time [s] from its first picture; image None: unreadable."""

    t: float
    sequence: int
    image: Image | None


class Playable(Protocol):
    """A playable recording. `play` reads from the start, in one thread, and closes its files when it is left."""

    period: float  # s between pictures, for the pause between two loops
    note: str  # what a user should know of how it is played, or empty

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) px."""
        ...

    def play(self) -> Iterator[Picture]: ...

    def ending(self, pictures: int) -> tuple[bool, str]:
        """Whether the end after this many pictures is regular, and a sentence about it."""
        ...


class PlaybackOptions(Protocol):
    """Options common to all recordings."""

    @property
    def pace(self) -> str: ...
    @property
    def loop(self) -> bool: ...
    @property
    def resize(self) -> bool: ...


class PlaybackCamera(ThreadCamera):
    """A recording as a camera."""

    def __init__(self, recording: Playable, *, clock: Clock, slot: FrameSlot, pace: str, loop: bool) -> None:
        super().__init__(slot)
        self._recording = recording
        self._clock = clock
        self._realtime = pace == "realtime"
        self._loop = loop
        self._start = 0.0
        self._room = threading.Semaphore(1)  # pace `fast`: free when the last frame was taken

    def frames(self) -> AsyncIterator[Frame]:
        if self._thread is None and not self._stop.is_set():
            note = self._recording.note
            self._slot.source.report(True, f"playing; {note}" if note else "playing")
            self._start = self._clock.now()
        return super().frames()

    async def close(self) -> None:
        self._stop.set()
        self._room.release()
        await super().close()

    def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        error: BaseException | None = None
        ok, text = True, "closed"
        try:
            count = self._play(loop, self._start)
            if not self._stop.is_set():
                ok, text = self._recording.ending(count)
        except Exception as bug:  # not lost with the thread: the consumer raises it
            error, ok, text = bug, False, f"failed: {bug}"
        try:
            loop.call_soon_threadsafe(self._slot.source.report, ok, text)
            loop.call_soon_threadsafe(self._slot.end, error)
        except RuntimeError:
            return  # the loop is gone, and with it everybody who could want to know

    def _play(self, loop: asyncio.AbstractEventLoop, start: float) -> int:
        """Hand over all pictures; returns how many were read. Ends early when stopped."""
        count, sequence, t = 0, 0, 0.0
        while True:
            first, count_before = sequence, count
            for picture in self._recording.play():
                t, sequence = start + picture.t, first + picture.sequence
                if not self._wait_for_turn(t):
                    return count
                count += 1
                decode = _unreadable if picture.image is None else already(picture.image)
                raw = RawFrame(t, 0.0, sequence, StampKind.MEDIA, decode, self._room.release)
                loop.call_soon_threadsafe(self._slot.put, raw)
            if not self._loop or count == count_before:
                return count
            start = t + self._recording.period
            sequence += 1

    def _wait_for_turn(self, t: float) -> bool:
        """Block until the picture of time t may be shown; False when stopped."""
        if not self._realtime:
            self._room.acquire()
            return not self._stop.is_set()
        while (ahead := t - self._clock.now()) > 0 and not self._stop.is_set():
            self._stop.wait(min(ahead, 0.1))  # in steps, for a clock that is set by hand
        return not self._stop.is_set()


def _unreadable() -> Image:
    raise BadImage("cannot be read")


def play(
    recording: Playable,
    address: CameraAddress,
    options: PlaybackOptions,
    *,
    clock: Clock,
    size: tuple[int, int] | None,
) -> PlaybackCamera:
    """The recording as a camera. Raises SourceError where it does not fit the calibration, see `check_size`."""
    try:
        check_size(recording.size, size, options.resize)
    except WrongSize as error:
        raise SourceError(f"camera source {address}: {error}") from None
    slot = FrameSlot(str(address), clock, size, options.resize)
    return PlaybackCamera(recording, clock=clock, slot=slot, pace=options.pace, loop=options.loop)
