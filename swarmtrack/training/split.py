"""What a training learns from, and what it keeps back to validate on."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from swarmtrack.errors import SourceError
from swarmtrack.training.labelled_clips import Clip, Origin, find_clips, labelled_frames, origins, window
from swarmtrack.training.labelled_images import LabelledFrame, held_out, load_frames

# Of clips that are held out, a fifth of the frames that would have been learned from.
HELD_OUT_FRAME_STRIDE = 5


class Split(NamedTuple):
    """Labelled images and clips to train on, and those held out; and where each clip was taken."""

    images: list[LabelledFrame]
    held_out_images: list[LabelledFrame]
    clips: list[tuple[Clip, Origin]]
    held_out_clips: list[tuple[Clip, Origin]]


def split(
    data: Path | None,
    clips: Path | None,
    validate: Path | None,
    *,
    hold_out: Collection[str],
    hold_out_negatives: bool,
) -> Split:
    """Labelled images of `data` and videos of `clips`, parted by scenes to hold out, and a third of the clips without
    drones; images of `validate` are held out in any case. Raises `SourceError` for a scene that is nowhere."""
    frames = load_frames(data) if data else []
    videos = find_clips(clips) if clips else []
    places = origins(videos, frames)
    scenes = {frame.scene for frame in frames} | {origin.scene for origin in places.values()}
    for name in hold_out:
        if name not in scenes:
            known = ", ".join(sorted(scenes)) or "--data, which is missing"
            raise SourceError(f"--hold-out {name}: expected one of {known}")

    def is_kept(scene: str, source: str) -> bool:
        return scene in hold_out or (hold_out_negatives and held_out(scene, source))

    parts = Split([], list(load_frames(validate)) if validate else [], [], [])
    for frame in frames:
        kept = is_kept(frame.scene, frame.source)
        (parts.held_out_images if kept else parts.images).append(frame)
    for video in videos:
        origin = places[video.name]
        kept = is_kept(origin.scene, origin.source)
        (parts.held_out_clips if kept else parts.clips).append((video, origin))
    return parts


def what_to_learn(parts: Split, every: int) -> tuple[list[LabelledFrame], list[LabelledFrame]]:
    """What to train on, and what to validate on: of clips windows, and whole frames."""
    training, validation = list(parts.images), list(parts.held_out_images)
    for clip, origin in parts.held_out_clips:
        validation += labelled_frames(clip, origin, HELD_OUT_FRAME_STRIDE * every)
    for clip, origin in parts.clips:
        training += (window(frame) for frame in labelled_frames(clip, origin, every))
    return training, validation
