"""Whether a camera sits as it was told, by how its picture moves while the drone turns.

Theory of operation. Turned by the gyro into a frame that does not turn, the bearings of a target change smoothly if
the camera sits as it was told (`bearing_filters.py`). Of one that hangs upside down they seem to move twice as fast as
the drone turns. So the same filters follow them for the mounting that was told and for others, and what tells these
apart is how surprised each one's are. A target that keeps a constant speed, as one does that the drone turns after, is
evidence for neither; where the turn begins, ends or changes, the wrong mounting makes all targets jump.

The only teammate in a picture may speed up in step with the drone's own turn, as one does that stands nearer than
what the drone circles. So only what happens while the drone turns fast, or faster and faster, counts: hardly any
teammate's direction changes like that. Evidence is kept in blocks of a second, each with the scale of its own
innovations and its agility summed over, so that one jump in it counts for as much as its logarithm. Another mounting is
said once it leads clearly, and in more than one block.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from swarmtrack.cameras.priors import (
    PICTURE_BLOCK_LEAD,
    PICTURE_BLOCK_LEAST_COMPONENTS,
    PICTURE_BLOCK_S,
    PICTURE_EVIDENCE_FADES_S,
    PICTURE_EVIDENCE_FORGOTTEN_S,
    PICTURE_LEAST_HITS,
    PICTURE_SCAN_SPACING_S,
    PICTURE_SETTLED_LEAD,
    PICTURE_STIRS_S,
    PICTURE_STIRS_SHARE,
    PICTURE_TURN_ACCELERATION_RAD_S2,
    PICTURE_TURN_RATE_RAD_S,
    PICTURE_TURNED_BLOCKS,
    PICTURE_TURNED_LEAD,
    PICTURE_VERDICT_PERIOD_S,
)
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, IdentifiedTrack, Scan, Track
from swarmtrack.motion.bearing_filters import BearingFilters, bearings_of, is_lapse, likelihoods
from swarmtrack.motion.gyro import Orientation, rotation_between
from swarmtrack.motion.priors import BEARING_AGILITIES

# Camera axes of one that is rolled about its optical axis by half a turn.
UPSIDE_DOWN: Array = np.diag([-1.0, -1.0, 1.0])
START = Orientation((1.0, 0.0, 0.0, 0.0), 0.0)
_AGILITY = len(BEARING_AGILITIES) // 2


@dataclass(slots=True)
class _Second:
    """Sums over innovations, up to `end` [s]: see `likelihoods`."""

    end: float
    """When it ends, if it has enough of them."""
    cost: Array
    log_det: Array = field(default_factory=lambda: np.zeros(len(BEARING_AGILITIES)))
    components: float = 0.0


class MountingNews(NamedTuple):
    """At t [s]: a camera's picture turns as if it hung upside down, or as that of another camera should (`like`); or,
    where it `fits`, as it was told after all."""

    t: float
    camera: int
    fits: bool
    like: int | None


class PictureTurns:
    """Mounting evidence for all cameras of a drone."""

    def __init__(self, from_first: Sequence[Array]) -> None:
        """from_first: of each camera, its axes (3, 3) from the first one's, as told."""
        cameras = range(len(from_first))
        self._others = [[j for j in cameras if j != k] for k in cameras]
        self._turns = [
            PictureTurn(told, [UPSIDE_DOWN @ told, *(from_first[j] for j in self._others[k])])
            for k, told in enumerate(from_first)
        ]
        self.wrong: frozenset[int] = frozenset()
        """The cameras that sit otherwise than was told: nothing that they show is where it seems to be."""

    def add_scan(
        self, number: int, scan: Scan, camera: PinholeCamera, orientation: Orientation
    ) -> MountingNews | None:
        """Add a scan of a camera, with the first camera's orientation at its exposure; returns news of that
        camera's mounting.
        """
        turn = self._turns[number]
        before = turn.found
        turn.add_scan(scan, camera, orientation)
        if turn.found == before:
            return None
        fits = turn.found is None
        self.wrong = self.wrong - {number} if fits else self.wrong | {number}
        like = self._others[number][turn.found - 1] if turn.found else None
        return MountingNews(scan.t, number, fits, like)

    def placeable(self, tracks: tuple[Track, ...]) -> tuple[Track, ...]:
        """Those that are where they seem to be."""
        if not self.wrong:
            return tracks
        return tuple(track for track in tracks if track.camera not in self.wrong)

    def without_names(self, tracks: tuple[IdentifiedTrack, ...]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, without the names of those that are not where they seem to be."""
        if not self.wrong:
            return tracks
        return tuple(
            IdentifiedTrack(entry.track, None, 0.0) if entry.track.camera in self.wrong else entry
            for entry in tracks
        )


class PictureTurn:
    """Evidence of one camera's mounting."""

    def __init__(self, told: Array, others: Sequence[Array]) -> None:
        """camera_from_first (3, 3): its axes from the first camera's, in whose axes the gyro counts, as told and as it
        may be as well, upside down at first."""
        self._mountings = np.array([told, *others])
        g = len(self._mountings)
        self._filters = BearingFilters(g)
        self._all = np.ones(g, dtype=bool)
        self._last: tuple[float, Orientation] | None = None
        self._rate = np.zeros(3)
        """rad/s: how the camera turned up to the last scan."""
        self._blocks: deque[_Second] = deque()
        self._judged = self._stirs_until = -math.inf
        self._settled = False
        self.found: int | None = None
        """Which of the others it is instead; None while the told one will do."""

    def add_scan(self, scan: Scan, camera: PinholeCamera, orientation: Orientation) -> None:
        """Add a scan, with the first camera's orientation at its exposure."""
        if self._settled:
            return
        t = scan.t
        if self._last is not None and 0.0 <= t - self._last[0] < PICTURE_SCAN_SPACING_S:
            return
        turns = self._how_fast(t, orientation)
        if turns > PICTURE_STIRS_SHARE:
            self._stirs_until = t + PICTURE_STIRS_S
        elif t > self._stirs_until:
            return
        bearings, variance = bearings_of(scan, camera)
        axes = self._mountings @ rotation_between(START, orientation).matrix
        turned = (bearings @ axes.transpose(1, 2, 0).reshape(3, -1)).reshape(-1, 3, len(axes))
        y, S, _ = self._filters.follow(
            t, turned, variance, agility=_AGILITY, likely=self._all, least_hits=PICTURE_LEAST_HITS
        )
        if not len(y):
            return
        d = (y * y).sum(axis=2) / S[:, :, None]
        self._filters.learn_gate(d[:, _AGILITY].min(axis=1))
        if turns > 1.0:
            block = self._block_of(t)
            block.cost += d.sum(axis=0)
            block.log_det += 2.0 * np.log(S).sum(axis=0)
            block.components += 2.0 * len(y)
            if t > self._judged + PICTURE_VERDICT_PERIOD_S:
                self._judged = t
                self._judge(t)

    def _how_fast(self, t: float, orientation: Orientation) -> float:
        """How fast, or faster and faster, the camera has turned since the last scan: above 1 as hardly any teammate's
        direction changes."""
        now, last = (t, orientation), self._last
        self._last = now
        if last is None or is_lapse(last, now):
            self._filters.restart()
            self._rate = np.zeros(3)
            return 0.0
        dt, before = t - last[0], self._rate
        self._rate = rotation.log(rotation_between(last[1], orientation).matrix) / dt
        faster = np.linalg.norm(self._rate - before) / dt
        return float(
            max(
                np.linalg.norm(self._rate) / PICTURE_TURN_RATE_RAD_S,
                faster / PICTURE_TURN_ACCELERATION_RAD_S2,
            )
        )

    def _block_of(self, t: float) -> _Second:
        newest = self._blocks[-1] if self._blocks else None
        if newest is None or (t > newest.end and newest.components >= PICTURE_BLOCK_LEAST_COMPONENTS):
            newest = _Second(t + PICTURE_BLOCK_S, np.zeros((len(BEARING_AGILITIES), len(self._mountings))))
            self._blocks.append(newest)
        return newest

    def _judge(self, now: float) -> None:
        while self._blocks and self._blocks[0].end < now - PICTURE_EVIDENCE_FORGOTTEN_S:
            self._blocks.popleft()
        blocks = [block for block in self._blocks if block.components >= PICTURE_BLOCK_LEAST_COMPONENTS]
        if not blocks:
            return
        likelihood, _ = likelihoods(
            np.array([block.cost for block in blocks]),
            np.array([block.log_det for block in blocks]),
            np.array([block.components for block in blocks]),
        )
        of_mounting = np.logaddexp.reduce(likelihood, axis=1)
        leads = of_mounting[:, 1:] - of_mounting[:, :1]
        lead = np.exp([(block.end - now) / PICTURE_EVIDENCE_FADES_S for block in blocks]) @ leads
        best = int(lead.argmax())
        if (
            lead[best] > PICTURE_TURNED_LEAD
            and (leads[:, best] > PICTURE_BLOCK_LEAD).sum() >= PICTURE_TURNED_BLOCKS
        ):
            self.found = best
        elif self.found is not None and lead[self.found] <= 0.0:
            self.found = None
        # Whether cables are swapped a drone that only yaws may never tell; if they are, it is likely by now.
        self._settled = bool(lead[0] < -PICTURE_SETTLED_LEAD and (lead < PICTURE_BLOCK_LEAD).all())
