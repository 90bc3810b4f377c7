"""Real video, shortened."""

from pathlib import Path

import cv2


def shorten(source: Path, target: Path, frames: int) -> None:
    """The first frames of a clip at 30 Hz, as MJPEG; as MPEG-4 where the target is an .mp4."""
    capture = cv2.VideoCapture(str(source))
    size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
    codec = cv2.VideoWriter.fourcc(*("mp4v" if target.suffix == ".mp4" else "MJPG"))
    writer = cv2.VideoWriter(str(target), codec, 30.0, size)
    for _ in range(frames):
        found, image = capture.read()
        assert found
        writer.write(image)
    writer.release()
