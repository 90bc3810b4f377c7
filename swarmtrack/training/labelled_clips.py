"""Videos with a box around what they show: pairs NAME.mp4 and NAME_gt.csv (`frame,id,x,y,w,h`: frames from 0, the box's
top left corner and size in pixels).

What is labelled is a word of the name: V_BIRD_001 shows birds, and no drone. A name without such a word shows drones.
"""

from __future__ import annotations

import csv
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.camera_sources.video import open_path
from swarmtrack.detection.description import LOOK_ALIKES
from swarmtrack.lab.score.clip_score import TruthBoxes
from swarmtrack.training.labelled_images import NEGATIVE, DataError, LabelledFrame

VIDEOS = (".mp4", ".avi", ".mkv")
DRONE_LABEL = "drone"
# px: side of what is kept around an object, the largest piece of a frame that becomes a usual sample.
CLIP_WINDOW_PX = 320


class Clip(NamedTuple):
    """A video, its labels, and what a look at the file tells."""

    name: str
    video: Path
    truth: Path
    frames: int
    fps: float
    width: int
    height: int

    @property
    def kind(self) -> str:
        """What is labelled: a look-alike that its name tells, else drones."""
        words = re.split(r"[^a-z]+", self.name.lower())
        return next((word for word in words if word in LOOK_ALIKES), DRONE_LABEL)


def find_clips(folder: Path) -> list[Clip]:
    """All labelled clips below a folder, by name."""
    clips = []
    for truth in sorted(folder.rglob("*_gt.csv")):
        name = truth.name.removesuffix("_gt.csv")
        videos = [path for suffix in VIDEOS if (path := truth.with_name(name + suffix)).exists()]
        if videos:
            clips.append(_look_at(name, videos[0], truth))
    if not clips:
        raise DataError(f"{folder}: no pair of NAME.mp4 and NAME_gt.csv found in it or below")
    return clips


def drone_clips(folder: Path) -> list[Clip]:
    """Those that show drones."""
    return [clip for clip in find_clips(folder) if clip.kind == DRONE_LABEL]


def _look_at(name: str, video: Path, truth: Path) -> Clip:
    capture = open_path(video)
    try:
        frames, fps, width, height = (
            capture.get(field)
            for field in (
                cv2.CAP_PROP_FRAME_COUNT,
                cv2.CAP_PROP_FPS,
                cv2.CAP_PROP_FRAME_WIDTH,
                cv2.CAP_PROP_FRAME_HEIGHT,
            )
        )
    finally:
        capture.release()
    if frames < 1 or fps <= 0.0:
        raise DataError(f"{video}: {frames:g} frames at {fps:g} Hz, expected a video that can be decoded")
    return Clip(name, video, truth, int(frames), fps, int(width), int(height))


def read_truth(path: Path) -> dict[int, TruthBoxes]:
    """The labelled boxes by frame."""
    rows: dict[int, list[tuple[float, ...]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                box = tuple(float(row[key]) for key in ("id", "x", "y", "w", "h"))
                rows.setdefault(int(row["frame"]), []).append(box)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: {error!r}, expected a table frame,id,x,y,w,h of numbers") from error
    truth = {}
    for frame, boxes in rows.items():
        table = np.array(boxes)
        corner, size = table[:, 1:3], table[:, 3:5]
        truth[frame] = TruthBoxes(table[:, 0].astype(np.int64), corner + 0.5 * size, size)
    return truth


class Origin(NamedTuple):
    """Where a clip was taken: as `LabelledFrame` names it."""

    source: str
    scene: str


def origins(clips: Sequence[Clip], frames: Sequence[LabelledFrame]) -> dict[str, Origin]:
    """Source and scene by name of the clip: those of labelled images of the same clip, whose source ends with its name.
    So the images and the clip are held out together. A clip with drones that is of no image is a scene of its own."""
    known = {frame.source.rsplit(maxsplit=1)[-1]: frame for frame in frames if frame.source.strip()}
    found = {}
    for clip in clips:
        frame = known.get(clip.name)
        usual = Origin(clip.name, clip.name if clip.kind == DRONE_LABEL else NEGATIVE)
        found[clip.name] = usual if frame is None else Origin(frame.source, frame.scene)
    return found


def labelled_frames(clip: Clip, origin: Origin, every: int) -> Iterator[LabelledFrame]:
    """Each `every`-th frame of a clip that has a label, whole. Others may show unlabelled drones."""
    truth = read_truth(clip.truth)
    video = open_path(clip.video)
    try:
        for index in range(clip.frames):
            if not video.grab():
                break
            if index % every or index not in truth:
                continue
            decoded, image = video.retrieve()
            if not decoded:
                break
            boxes = np.concatenate([truth[index].centre, truth[index].size], axis=1)
            drone = clip.kind == DRONE_LABEL
            yield LabelledFrame(
                f"{clip.name}_{index:04d}",
                origin.source,
                origin.scene,
                np.asarray(image, np.uint8),
                boxes if drone else np.empty((0, 4)),
                np.empty((0, 4)) if drone else boxes,
                () if drone else (clip.kind,) * len(boxes),
            )
    finally:
        video.release()


def window(frame: LabelledFrame, side: int = CLIP_WINDOW_PX) -> LabelledFrame:
    """What lies around one of the labelled objects, not always in the middle: a third of the memory of the frame.

    Which object, and where it lies in the window, follow from the name of the frame.
    """
    rng = np.random.default_rng(zlib.crc32(frame.name.encode()))
    boxes = np.concatenate([frame.drones, frame.distractors])
    aim = boxes[rng.integers(len(boxes))]
    shown = np.minimum(frame.image.shape[1::-1], side)
    room = np.array(frame.image.shape[1::-1]) - shown
    corner = np.clip(np.round(aim[:2] - rng.uniform(0.2, 0.8, 2) * shown), 0, room).astype(int)

    def inside(of: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(((of[:, :2] >= corner) & (of[:, :2] < corner + shown)).all(axis=1))

    shift = np.array([*corner, 0, 0])
    kept = inside(frame.distractors)
    x, y = corner.tolist()
    return replace(
        frame,
        image=frame.image[y : y + int(shown[1]), x : x + int(shown[0])].copy(),
        drones=frame.drones[inside(frame.drones)] - shift,
        distractors=frame.distractors[kept] - shift,
        kinds=tuple(kind for kind, keep in zip(frame.kinds, kept.tolist(), strict=True) if keep),
        is_window=True,
    )
