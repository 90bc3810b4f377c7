"""What is drawn over a camera's picture for each track: box, arrow, ellipse, trail, label and colour.

Pure: tracks and lenses in, pixels and words out, for the annotated video, recordings and the monitor's page to render.
A lost track has a thin or dashed box, a tentative one is a dot. Pixels are those of the image as the camera gave it:
the tracker's undistorted ones are distorted again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import FOREIGN, Array, IdentifiedTrack, Identity, ScanReport, TrackStatus
from swarmtrack.outputs.palette import Rgb, colour_of
from swarmtrack.relative.read_out import read_out

ARROW_AHEAD_S = 0.25  # s: how far an arrow shows where a track goes
ELLIPSE_SIGMAS = 3.0  # of an ellipse
TRAIL_S = 1.0  # s: how much of its path a track trails behind it
UNKNOWN_BOX_PX = 20.0  # side of a box whose size is unknown
LETTER_PX = 9  # width of a letter of a label
LABEL_PX = 40  # height above a box that a label needs, beneath the line at the image's top


class SeenTrack(NamedTuple):
    """A track in the pixels of the image: centre (2,), velocity (2,), covariance (2, 2) of the centre, size (2,)."""

    entry: IdentifiedTrack
    centre: Array
    velocity: Array
    cov: Array
    size: Array


def as_seen(report: ScanReport, *lenses: PinholeCamera) -> list[SeenTrack]:
    """The tracks of a scan, each back in the image as its camera gave it. lenses: of all cameras of the drone."""
    entries = report.tracks.tracks
    if len(lenses) == 1:
        return _as_seen(entries, lenses[0])
    seen = {
        track.entry.track.id: track
        for camera, lens in enumerate(lenses)
        for track in _as_seen([entry for entry in entries if entry.track.camera == camera], lens)
    }
    return [seen[entry.track.id] for entry in entries if entry.track.id in seen]


def _as_seen(entries: Sequence[IdentifiedTrack], lens: PinholeCamera) -> list[SeenTrack]:
    """Those of one camera."""
    ideal = np.array([entry.track.mean[::2] for entry in entries]).reshape(-1, 2)
    seen = []
    for k, uv, by_ideal in in_picture(lens, ideal):
        track = entries[k].track
        cov = by_ideal @ track.cov[::2, ::2] @ by_ideal.T
        seen.append(SeenTrack(entries[k], uv, by_ideal @ track.mean[1::2], cov, track.size))
    return seen


def in_picture(lens: PinholeCamera, ideal: Array) -> Iterator[tuple[int, Array, Array]]:
    """Index, pixel (2,) and d pixel / d undistorted pixel (2, 2), of those undistorted pixels (n, 2) that the lens can
    show."""
    centre = lens.distort(ideal)
    for k, (uv, J) in enumerate(zip(centre, lens.undistort_jacobian(centre), strict=True)):
        if np.isfinite(uv).all() and np.isfinite(J).all():
            yield k, uv, np.linalg.inv(J)


class DrawnTrack(NamedTuple):
    """A track over a picture, px and px/s: centre (2,), velocity (2,), covariance (2, 2) of the centre, size (2,).

    alone: there is no team, so that each track has a colour of its own.
    """

    track_id: int
    identity: Identity
    status: TrackStatus
    distance_m: float | None
    centre: Array
    velocity: Array
    cov: Array
    size: Array
    alone: bool = False

    @property
    def is_dot(self) -> bool:
        return self.status is TrackStatus.TENTATIVE

    @property
    def is_lost(self) -> bool:
        return self.status is TrackStatus.LOST

    @property
    def colour(self) -> Rgb:
        return colour_of(self.track_id if self.alone and self.identity is None else self.identity)

    @property
    def label(self) -> str:
        """Name, distance where that is known, and whether it is lost: `drone 2 8.4 m`."""
        names = [] if self.identity is None else [name_of(self.identity)]
        if not isinstance(self.identity, int):
            names.append(f"track {self.track_id}")
        words = [", ".join(names)]
        if self.distance_m is not None:
            words.append(f"{self.distance_m:.1f} m")
        if self.is_lost:
            words.append("(lost)")
        return " ".join(words)

    def label_at(self, width: int) -> tuple[float, float]:
        """Left end of the label's baseline in an image of so many px: above the box, or below where there is no room
        between the image's edge and the line at its top."""
        (left, top), (_, bottom) = self.box.tolist()
        at = max(0.0, min(left, width - LETTER_PX * len(self.label)))
        return at, top - 5.0 if top > LABEL_PX else bottom + 17.0

    @property
    def box(self) -> Array:
        """Top left and bottom right, (2, 2)."""
        half = 0.5 * np.where(np.isnan(self.size), UNKNOWN_BOX_PX, self.size)
        return np.array((self.centre - half, self.centre + half))

    @property
    def corners(self) -> Array:
        """(4, 2) px: the corners of the box in the order around it."""
        (left, top), (right, bottom) = self.box
        return np.array(((left, top), (right, top), (right, bottom), (left, bottom)))

    @property
    def arrow(self) -> Array:
        """From the centre to where the track will be a moment later, (2, 2)."""
        return np.array((self.centre, self.centre + ARROW_AHEAD_S * self.velocity))

    @property
    def ellipse(self) -> tuple[float, float, float]:
        """Long and short radius, and the angle of the long one from u to v, rad."""
        variances, axes = np.linalg.eigh(self.cov)
        short, long = ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
        return float(long), float(short), float(np.arctan2(axes[1, 1], axes[0, 1]))


def drawn(seen: Iterable[SeenTrack], camera: int = 0, *, alone: bool = False) -> list[DrawnTrack]:
    """What is in the picture of a camera."""
    return [
        DrawnTrack(
            track.entry.track.id,
            track.entry.identity,
            track.entry.track.status,
            _distance(track.entry),
            *track[1:],
            alone=alone,
        )
        for track in seen
        if track.entry.track.camera == camera
    ]


def _distance(entry: IdentifiedTrack) -> float | None:
    state = entry.relative
    return None if state is None else read_out(state.position, state.velocity, state.cov).distance


def name_of(identity: Identity) -> str:
    """An identity as people call it."""
    return "unknown" if identity is None else "stranger" if identity == FOREIGN else f"drone {identity}"


Rectangle = tuple[float, float, float, float]
"""Left, top, right, bottom, px."""


def place_tags(
    boxes: Sequence[Array], sizes: Sequence[tuple[float, float]], width: float, height: float
) -> list[Rectangle]:
    """A tag of its size (width, height) for each box (2, 2): at its box, in the picture, and on no other tag where
    there is room."""
    taken: list[Rectangle] = []
    for ((left, top), (right, bottom)), (w, h) in zip(boxes, sizes, strict=True):
        places = [
            (left, top - h), (left, bottom), (right - w, top - h), (right - w, bottom), (right, top), (left - w, top),
            *((left, top - k * h) for k in (2, 3)), *((left, bottom + k * h) for k in (1, 2)),
        ]  # fmt: skip
        inside = [(min(max(x, 0.0), width - w), min(max(y, 0.0), height - h)) for x, y in places]
        free = [
            (x, y) for x, y in inside if not any(_overlap((x, y, x + w, y + h), other) for other in taken)
        ]
        x, y = (free or inside)[0]
        taken.append((x, y, x + w, y + h))
    return taken


def _overlap(one: Rectangle, other: Rectangle) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


class Trails:
    """Where each track was in the last second."""

    def __init__(self) -> None:
        self._of: dict[int, deque[tuple[float, int, int]]] = {}

    def follow(self, t_s: float, tracks: Iterable[DrawnTrack]) -> None:
        """Tracks that have ended are forgotten."""
        kept = {track.track_id: track for track in tracks}
        self._of = {id: trail for id, trail in self._of.items() if id in kept}
        for id, track in kept.items():
            trail = self._of.setdefault(id, deque())
            trail.append((t_s, round(track.centre[0]), round(track.centre[1])))
            while trail[0][0] < t_s - TRAIL_S:
                trail.popleft()

    def of(self, track_id: int) -> NDArray[np.int32]:
        """(n, 2) px, oldest first."""
        return np.array([(u, v) for _, u, v in self._of.get(track_id, ())], dtype=np.int32).reshape(-1, 2)
