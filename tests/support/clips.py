"""Real video, shortened."""

from pathlib import Path

import cv2


def shorten(source: Path, target: Path, frames: int) -> None:
    """The first frames of a clip of 640 x 512 at 30 Hz, as MJPEG."""
    capture = cv2.VideoCapture(str(source))
    writer = cv2.VideoWriter(str(target), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 512))
    for _ in range(frames):
        writer.write(capture.read()[1])
    writer.release()
