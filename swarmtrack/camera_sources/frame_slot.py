"""Slot between a camera and its one consumer: holds the newest frame, decoded only when taken, in a worker thread."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass

import cv2
import numpy as np

from swarmtrack.camera_sources.newest_slot import NewestSlot
from swarmtrack.clock import Clock
from swarmtrack.messages import Frame, Image, StampKind

log = logging.getLogger(__name__)


class BadImage(Exception):
    """Bytes that are not an image, or only a part of one."""


class WrongSize(Exception):
    """An image of another size than the calibration's."""


def _nothing() -> None:
    pass


@dataclass(frozen=True, slots=True)
class RawFrame:
    """A frame as the camera delivered it. `decode` may be slow and runs in a thread; raises BadImage.

    `header_size` returns (width, height) without decoding; None: it is known or cheap; raises BadImage. `release`
    returns the buffer to the camera; it is called on the event loop, once, whatever happened to the frame.
    """

    t: float
    t_sigma: float
    sequence: int
    stamp: StampKind
    decode: Callable[[], Image]
    release: Callable[[], None] = _nothing
    header_size: Callable[[], tuple[int, int]] | None = None


def already(image: Image) -> Callable[[], Image]:
    """`decode` for a frame that is already decoded."""
    return lambda: image


class FrameSlot(NewestSlot[RawFrame]):
    """Room for one frame. One producer puts, one consumer iterates `frames()`."""

    def __init__(self, name: str, clock: Clock, size: tuple[int, int] | None, resize: bool) -> None:
        """size: (width, height) in pixels of the calibration, None: any; resize: scale to it instead of refusing."""
        super().__init__(name, clock, discard=lambda raw: raw.release())
        self._size = size
        self._resize = resize

    async def frames(self) -> AsyncIterator[Frame]:
        while (raw := await self.get()) is not None:
            try:
                image = await asyncio.to_thread(self._develop, raw)
            except BadImage as error:
                self.source.damaged(str(error))
                log.debug("camera %s: frame %d dropped: %s", self.source.name, raw.sequence, error)
                continue
            except WrongSize as error:
                self.source.counts.wrong_size += 1
                self.source.refuse(str(error))
                continue
            finally:
                raw.release()
            self.source.given(raw.t, raw.t_sigma)
            yield Frame(raw.t, raw.t_sigma, raw.sequence, image, raw.stamp)

    def _develop(self, raw: RawFrame) -> Image:
        if raw.header_size is not None:  # a picture of 700 bytes may take a second and 200 MB to decode
            check_size(raw.header_size(), self._size, self._resize)
        return fit(raw.decode(), self._size, self._resize)


def check_size(found: tuple[int, int], size: tuple[int, int] | None, resize: bool) -> None:
    """Raise WrongSize where images of (width, height) `found` do not fit a calibration for `size`."""
    if size is not None and found != size and not resize:
        raise WrongSize(
            f"frames are {found[0]}x{found[1]}, the calibration is for {size[0]}x{size[1]}: set the camera to that "
            "size, calibrate again, or add resize=1 if it shows the same field of view"
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
    """Distinguishes a frame that waited in a queue from one with a long latency.

    A camera's latency at arrival (readout, transfer) is constant; a queued frame is older by whole periods. So the
    reference is the smallest age of the last frames, not zero: a camera with 70 ms of constant latency is never stale.
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
