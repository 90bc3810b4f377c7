"""All tracks of one tracker as arrays, a row a track: no object per track in the hot path."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array, Track, TrackStatus

TENTATIVE, CONFIRMED, LOST = TrackStatus.TENTATIVE, TrackStatus.CONFIRMED, TrackStatus.LOST


@dataclass(slots=True)
class TrackTable:
    """n tracks. mean (n, 4), cov (n, 4, 4), existence (n,), size (n, 2) px NaN while unknown, confirmed (n,): ever was;
    lost (n,): missed, and rather hidden, out of view or gone than there;
    last_seen (n,) s: the last scan that detected it; missed_since (n,) s: the first scan after it, NaN while detected.
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
        )

    def __len__(self) -> int:
        return len(self.id)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Drop every track whose mask (n,) is False."""
        for column in fields(self):
            setattr(self, column.name, getattr(self, column.name)[mask])

    def append(self, other: TrackTable) -> None:
        for column in fields(self):
            joined = np.concatenate([getattr(self, column.name), getattr(other, column.name)])
            setattr(self, column.name, joined)

    def tracks(self, t: float, mean: Array, cov: Array) -> tuple[Track, ...]:
        """As messages, with means (n, 4) and covariances (n, 4, 4) that hold at t."""
        status = [
            TENTATIVE if not ever else LOST if lost else CONFIRMED
            for ever, lost in zip(self.confirmed.tolist(), self.lost.tolist(), strict=True)
        ]
        missed = [None if math.isnan(since) else since for since in self.missed_since.tolist()]
        ids, existence, instant = self.id.tolist(), self.existence.tolist(), repeat(t, len(self))
        return tuple(map(Track, ids, instant, mean, cov, status, existence, self.size, missed))
