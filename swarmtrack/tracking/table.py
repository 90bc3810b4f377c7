"""All tracks of one tracker as arrays, one row per track: no object per track in the hot path."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from itertools import repeat
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array, Track, TrackStatus

TENTATIVE, CONFIRMED, LOST = TrackStatus.TENTATIVE, TrackStatus.CONFIRMED, TrackStatus.LOST

_track = partial(tuple.__new__, Track)  # Track(*row), without the two Python frames that Track._make takes


@dataclass(slots=True)
class TrackTable:
    """n tracks. mean (n, 4), cov (n, 4, 4), existence (n,), size (n, 2) px NaN while unknown, confirmed (n,): ever was;
    lost (n,): missed, and rather hidden, out of view or gone than there;
    last_seen (n,) s: the last scan that detected it; missed_since (n,) s: the first scan after it, NaN while detected;
    likeness (n,): the mean log odds that it is a drone, by the looks of its last detections; looks (n,): how many;
    looked (n,) s: when the last one was.
    """

    id: NDArray[np.int64]
    mean: Array
    cov: Array
    existence: Array
    size: Array
    confirmed: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    last_seen: Array
    missed_since: Array
    likeness: Array
    looks: Array
    looked: Array

    @classmethod
    def empty(cls) -> TrackTable:
        return cls(
            np.empty(0, np.int64),
            np.empty((0, 4)),
            np.empty((0, 4, 4)),
            np.empty(0),
            np.empty((0, 2)),
            np.empty(0, np.bool_),
            np.empty(0, np.bool_),
            np.empty(0),
            np.empty(0),
            np.empty(0),
            np.empty(0),
            np.empty(0),
        )

    def __len__(self) -> int:
        return len(self.id)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Drop every track whose mask (n,) is False."""
        if mask.all():
            return
        for column in fields(self):
            setattr(self, column.name, getattr(self, column.name)[mask])

    def arrange(self, rows: NDArray[np.intp]) -> None:
        """Put the rows into this order (n,)."""
        for column in fields(self):
            setattr(self, column.name, getattr(self, column.name)[rows])

    def append(self, other: TrackTable) -> None:
        if not len(other):
            return
        for column in fields(self):
            joined = np.concatenate([getattr(self, column.name), getattr(other, column.name)])
            setattr(self, column.name, joined)

    def select(self, mask: NDArray[np.bool_]) -> TrackTable:
        """A table of those whose mask (n,) is True."""
        return TrackTable(*(getattr(self, column.name)[mask] for column in fields(self)))

    def shown(self, camera: int = 0) -> TrackColumns:
        """What does not change from scan to scan, to make tracks of for any time between. camera: in whose pixels."""
        n = len(self.id)
        status: list[TrackStatus] = [CONFIRMED] * n  # most are, and detected: only the others cost anything
        missed: list[float | None] = [None] * n
        for i in self.lost.nonzero()[0].tolist():
            status[i] = LOST
        for i in (~self.confirmed).nonzero()[0].tolist():
            status[i] = TENTATIVE
        for i in np.isfinite(self.missed_since).nonzero()[0].tolist():
            missed[i] = self.missed_since.item(i)
        size = self.size.copy()  # what was handed out does not change with the next scan
        return TrackColumns(self.id.tolist(), status, self.existence.tolist(), list(size), missed, camera)

    def tracks(self, t: float, mean: Array, cov: Array) -> tuple[Track, ...]:
        """As messages, with means (n, 4) and covariances (n, 4, 4) that hold at t."""
        return self.shown().tracks(t, mean, cov)


class TrackIds:
    """The numbers of tracks: never used twice, by all trackers of a drone."""

    def __init__(self) -> None:
        self._next = 1

    def allocate(self, n: int) -> NDArray[np.int64]:
        """The next n."""
        ids = np.arange(self._next, self._next + n)
        self._next += n
        return ids


class TrackColumns(NamedTuple):
    """Columns of n tracks as messages have them."""

    id: list[int]
    status: list[TrackStatus]
    probability: list[float]
    size: list[Array]
    coasting_since: list[float | None]
    camera: int

    def tracks(self, t: float, mean: Array, cov: Array) -> tuple[Track, ...]:
        """As messages, with means (n, 4) and covariances (n, 4, 4) that hold at t."""
        columns = (
            self.id, repeat(t, len(self.id)), mean, cov, self.status, self.probability, self.size,
            self.coasting_since, repeat(self.camera),
        )  # fmt: skip
        return tuple(map(_track, zip(*columns, strict=False)))  # strict costs a fifth, and all have n
