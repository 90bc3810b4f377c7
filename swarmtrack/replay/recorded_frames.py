"""Frames of a recording, with their pictures."""

from __future__ import annotations

from typing import Any

import msgspec

from swarmtrack.errors import RecordingError
from swarmtrack.messages import Frame, StampKind
from swarmtrack.recording.outputs import FRAMES_TOPIC, image_topic


class RecordedFrames:
    """Takes messages of `topics`, in order. cameras: number of the drone's."""

    def __init__(self, cameras: int) -> None:
        self.topics = frozenset({FRAMES_TOPIC, *(image_topic(k) for k in range(cameras))})
        self._exact_times: dict[str, Any] | None = None

    def decode(self, topic: str, data: bytes) -> Frame | None:
        """The frame of a picture message, after the message of its exact times; None for other messages. Raises
        RecordingError.
        """
        try:
            return self._take(topic, data)
        except (msgspec.MsgspecError, KeyError, TypeError, ValueError) as error:
            raise RecordingError(f"{topic}: not a swarmtrack frame: {error}") from None

    def _take(self, topic: str, data: bytes) -> Frame | None:
        import cv2  # noqa: PLC0415
        import numpy as np  # noqa: PLC0415

        from swarmtrack.camera_sources.decode import check_pixels  # noqa: PLC0415
        from swarmtrack.camera_sources.frame_slot import BadImage  # noqa: PLC0415

        if topic == FRAMES_TOPIC:
            self._exact_times = msgspec.json.decode(data)
            return None
        exact, self._exact_times = self._exact_times, None
        jpeg = jpeg_of(data)
        if exact is None or jpeg is None or topic != image_topic(int(exact.get("camera", 0))):
            return None
        try:
            check_pixels(jpeg)
        except BadImage:
            return None
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            return None
        return Frame(
            float(exact["t_s"]),
            float(exact["t_sigma_s"]),
            int(exact["sequence"]),
            np.asarray(image, np.uint8),
            StampKind.MEDIA,
            int(exact.get("camera", 0)),
        )


def jpeg_of(data: bytes) -> bytes | None:
    """The picture in a recorded CompressedImage, from its first marker to its last; None where there is none."""
    start, end = data.find(b"\xff\xd8"), data.rfind(b"\xff\xd9")
    return data[start : end + 2] if 0 <= start < end else None
