"""What the cameras see now, for people: `video/<id>`, sent only while there is a subscriber.

The newest frame only, at most ten times a second, made smaller and encoded in a thread of its own. While that is busy,
frames pass by. Unwatched it costs one question per frame. Of several cameras each is listened to by itself. Those ten
are for all pictures of a drone together: who looks at one camera pays for one, and who looks at four sees each more
rarely.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Protocol

import numpy as np

from swarmtrack.clock import UTC_SIGMA, Clock, utc_offset
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.rotation import to_quaternion
from swarmtrack.messages import Image
from swarmtrack.outputs import periods
from swarmtrack.perceived import VideoView
from swarmtrack.transport.base import Kind, Transport
from swarmtrack.wire import codec
from swarmtrack.wire.fields import MAX_JPEG, WIRE_VERSION
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.video import VideoMessage

# How early a frame may come and still be on time. Without it 10 frames per second would give 5 pictures.
LIVE_FRAME_JITTER_S = 0.01
PICTURE_WIDTH = 480  # px, at most: a quarter of a laptop's screen
# Tried in turn until the picture fits into a message: JPEG quality, and the share of the width.
JPEG_ATTEMPTS = ((70, 1.0), (45, 1.0), (45, 0.5), (25, 0.25))


class PictureSink(Protocol):
    """Another way out for pictures."""

    @property
    def wanted_pictures(self) -> Sequence[int]:
        """Cameras, counted from 0, whose pictures are looked at there."""
        ...

    def on_video(self, message: VideoMessage, camera: int) -> None: ...


class LiveVideo:
    """Offered every frame; only the event loop may call.

    clock: the flight's; wall: the machine's, for how often. drops: where what no reader would accept is counted. also:
    takes pictures, too.
    """

    def __init__(
        self,
        transport: Transport,
        perceived: VideoView,
        lenses: Sequence[PinholeCamera],
        drops: Counter[str],
        *,
        clock: Clock,
        wall: Clock,
        also: PictureSink | None = None,
    ) -> None:
        self._also = also
        self._transport = transport
        self._perceived = perceived
        self._lenses = [lens_message(lens) for lens in lenses]
        self._drops = drops
        self._clock = clock
        self._wall = wall
        self._last = [-math.inf] * len(lenses)
        self._worker: ThreadPoolExecutor | None = None
        self._encoding: asyncio.Future[VideoMessage | None] | None = None

    def offer(self, t: float, frame: int, image: Image | None, camera: int = 0) -> None:
        """A frame with its stamp; image None: of a camera that sends no pictures. Returns at once."""
        if self._encoding is not None or not self._is_watched(camera):
            return
        now = self._wall.now()
        # What has no picture costs nothing worth sharing.
        period = periods.VIDEO * (1 if image is None else self._watched())
        if now - self._last[camera] < period - LIVE_FRAME_JITTER_S:
            return
        self._last[camera] = now
        exposed = t + self._perceived.cameras[camera].clock.used_s
        pose = self._perceived.camera_pose(exposed, camera)
        lens = self._lenses[camera]
        view = VideoMessage(
            version=WIRE_VERSION,
            t_utc_s=float(exposed + utc_offset(self._clock)),
            t_sigma_s=UTC_SIGMA,
            frame=frame,
            width=lens.width,
            height=lens.height,
            jpeg=b"",
            lens=lens,
            position_m=tuple(pose.position.tolist()) if pose else None,
            quaternion_wxyz=tuple(to_quaternion(pose.rotation).tolist()) if pose else None,
        )
        if image is None:
            self._publish(view, camera)
            return
        self._worker = self._worker or ThreadPoolExecutor(1, thread_name_prefix="live video")
        loop = asyncio.get_running_loop()
        self._encoding = loop.run_in_executor(self._worker, with_picture, view, image)
        self._encoding.add_done_callback(partial(self._on_encoded, camera))

    def close(self) -> None:
        if self._worker is not None:
            self._worker.shutdown(wait=False, cancel_futures=True)

    def _watched(self) -> int:
        """How many cameras somebody looks at."""
        return sum(map(self._is_watched, range(len(self._lenses))))

    def _is_watched(self, camera: int) -> bool:
        wanted = self._also is not None and camera in self._also.wanted_pictures
        return wanted or self._transport.has_listener(Kind.VIDEO, camera)

    def _on_encoded(self, camera: int, done: asyncio.Future[VideoMessage | None]) -> None:
        self._encoding = None
        if done.cancelled():
            return
        view = done.result()
        if view is None:
            self._drops["unsendable_video"] += 1
        else:
            self._publish(view, camera)

    def _publish(self, view: VideoMessage, camera: int) -> None:
        if self._also is not None:
            self._also.on_video(view, camera)
        if not self._transport.has_listener(Kind.VIDEO, camera):
            return
        try:
            self._transport.publish(Kind.VIDEO, codec.encode(view), camera)
        except ValueError:  # what no reader would accept is not sent, and must not end the flight
            self._drops["unsendable_video"] += 1


def with_picture(view: VideoMessage, image: Image) -> VideoMessage | None:
    """The view with its image, small enough for one message; None where it cannot be. In a thread of its own."""
    import cv2  # noqa: PLC0415 - not above: an agent without pictures does not pay for it

    height, width = image.shape[:2]
    for quality, share in JPEG_ATTEMPTS:
        w = max(1, round(min(width, PICTURE_WIDTH) * share))
        h = max(1, round(w * height / width))
        # Area averaging costs three times as much, and nearest neighbour loses small drones.
        small = image if w == width else cv2.resize(image, (w, h), interpolation=cv2.INTER_LINEAR)
        good, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(small), [cv2.IMWRITE_JPEG_QUALITY, quality])
        if good and jpeg.size <= MAX_JPEG:
            return VideoMessage(
                view.version, view.t_utc_s, view.t_sigma_s, view.frame, w, h, jpeg.tobytes(),
                view.lens, view.position_m, view.quaternion_wxyz,
            )  # fmt: skip
    return None
