"""A replayed flight as a video: the recorded pictures with what was tracked in them, those of several cameras side by
side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from swarmtrack.errors import RecordingError
from swarmtrack.messages import Frame, Image, ScanReport
from swarmtrack.outputs.annotated_video import TimedVideo, annotate, write_text
from swarmtrack.outputs.drawing import Trails, as_seen, drawn
from swarmtrack.recording.reader import Recording
from swarmtrack.recording.settings import FlightSettings
from swarmtrack.replay.recorded_frames import RecordedFrames

WIDEST_TILED_PX = 1920  # px, of all pictures beside each other
MOST_IN_A_ROW = 3
USUAL_TILED_FPS = 15.0
TILE_WHITE = (255, 255, 255)


def write_video(
    path: Path,
    recording: Recording,
    settings: FlightSettings,
    scans: Sequence[ScanReport],
    camera: int | None = None,
) -> int:
    """Returns how many pictures it shows. camera: only that one, by its place in the config. Raises RecordingError."""
    lenses = [one.camera for one in settings.cameras]
    if camera is not None and camera >= len(lenses):
        raise RecordingError(
            f"{recording.folder}: --camera {camera + 1}: expected 1 to {len(lenses)}, as many cameras as the drone had"
        )
    shown = range(len(lenses)) if camera is None else [camera]
    reports = {(report.camera, report.sequence): report for report in scans}
    times = [report.tracks.t for report in scans if report.camera == shown[0]]
    tiles = Tiles([(lenses[k].width, lenses[k].height) for k in shown])
    trails = {k: Trails() for k in shown}
    frames = RecordedFrames(len(lenses))
    video, begin, count = TimedVideo(path, _fps(times)), math.nan, 0
    try:
        for message in recording.messages(frames.topics):
            frame = frames.decode(message.topic, message.data)
            report = None if frame is None else reports.get((frame.camera, frame.sequence))
            if frame is None or report is None or frame.camera not in shown:
                continue
            begin = frame.t if math.isnan(begin) else begin
            tiles.paste(
                shown.index(frame.camera), _drawn(frame, report, begin, settings, trails[frame.camera])
            )
            video.write(tiles.picture, max(frame.t - begin, 0.0))
            count += 1
    finally:
        video.close()
    return count


def _drawn(frame: Frame, report: ScanReport, begin: float, settings: FlightSettings, trails: Trails) -> Image:
    lenses = [one.camera for one in settings.cameras]
    tracks = drawn(as_seen(report, *lenses), frame.camera, alone=settings.config.is_alone)
    image = annotate(frame, frame.t - begin, tracks, trails)
    if len(lenses) > 1:
        write_text(image, f"camera {frame.camera + 1}", (8, image.shape[0] - 10), TILE_WHITE)
    return image


def _fps(times: list[float]) -> float:
    """Of one camera's frames."""
    steps = np.diff(times)
    return 1.0 / float(np.median(steps)) if len(steps) and np.median(steps) > 0.0 else USUAL_TILED_FPS


class Tiles:
    """Pictures side by side, each the newest of its camera; up to three in a row, else in two rows. sizes: width
    and height of each.
    """

    def __init__(self, sizes: Sequence[tuple[int, int]]) -> None:
        count = len(sizes)
        self._columns = count if count <= MOST_IN_A_ROW else (count + 1) // 2
        width, height = max(w for w, _ in sizes), max(h for _, h in sizes)
        self._share = min(1.0, WIDEST_TILED_PX / (self._columns * width))
        # Encoders want even sides.
        self._width, self._height = (2 * math.ceil(0.5 * self._share * side) for side in (width, height))
        rows = math.ceil(count / self._columns)
        self._whole = np.zeros((rows * self._height, self._columns * self._width, 3), np.uint8)

    @property
    def picture(self) -> Image:
        return self._whole.copy()

    def paste(self, place: int, image: Image) -> None:
        tile = image
        if self._share < 1.0:
            size = (round(self._share * image.shape[1]), round(self._share * image.shape[0]))
            tile = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        row, column = divmod(place, self._columns)
        top, left = row * self._height, column * self._width
        self._whole[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
