"""Does a track move as its drone says that it does, or does it stand?

A house near a drone fits the announced place nearly as well as the drone, and most of what is wrong with that place
(heading, start, mounting) stays wrong in the same way. What it does not do is follow. Whenever a drone says anew where
it is, the ray to each track is compared with the ray to that place, in the scan of that time, and both with what they
were the time before. Three models foretell the difference (Δ of rays, rad):

* the track is the drone: it keeps its distance from the reported direction;
* it is a thing that stands, at one of the distances `STANDS_M`: its ray turns only by what the observer's own way does;
* it is a stranger in flight: its ray goes anywhere, at `STRANGER_RATE`.

Their likelihoods multiply over the reports of a track's life. A team that hovers moves by no more than the noise, and
then the drone and the standing thing foretell the same: nothing is learned, however long it lasts.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Container, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from swarmtrack.identity.reprojection import NEAREST, ObserverCamera
from swarmtrack.messages import Announcement, Array, Track

# s of scans in which the time of a report is looked up, and how far from it a scan may be.
MEMORY_S, SIMULTANEOUS = 2.0, 0.12
# s between two reports that are compared.
LONGEST_S = 5.0
# rad: by which an autopilot's attitude and a track's jitter change from one report to the next.
ATTITUDE_SIGMA = 0.012
# m: likewise of a reported position, both ends together.
POSITION_SIGMA = 0.15
# m: of things that stand; their rays turn by less than the noise between two of these.
STANDS_M = (10.0, 15.0, 25.0, 50.0, 100.0, math.inf)
# rad/s: of strangers that fly.
STRANGER_RATE = 0.1
# Log odds that motion alone may give, either way: a track may after all have changed over to another target.
MOST = math.log(1e3)


class _Scan:
    """Of one exposure: the tracks that were detected, and from where; their rays once somebody asks."""

    def __init__(self, tracks: Sequence[Track], view: ObserverCamera) -> None:
        self.t = view.observer.t
        self.origin = view.team_from_camera.position
        self.row = {track.id: row for row, track in enumerate(tracks)}
        self.gone: set[int] = set()
        """Tracks that may have changed places since."""
        self._mean = [track.mean for track in tracks]
        self._view = view

    @cached_property
    def rays(self) -> Array:
        """(n, 3): unit vectors, team frame."""
        return self._view.rays(np.array(self._mean).reshape(-1, 4)[:, ::2])


class _SaidPlace(NamedTuple):
    """Of a drone: when it was where it said, in which direction (3,) that was, and the scan of that time."""

    t: float
    towards: Array
    scan: _Scan


class _Pair(NamedTuple):
    """Log likelihoods so far: of the drone, of a stranger in flight, and of a standing thing at each distance; and the
    log ratio that they make."""

    log: Array
    ratio: float


class Displacements:
    """Told of every scan and where the drones say that they are."""

    def __init__(self) -> None:
        self._scans: deque[_Scan] = deque()
        self._said: dict[int, _SaidPlace] = {}
        self._pairs: dict[tuple[int, int], _Pair] = {}

    def observe(
        self, tracks: Sequence[Track], view: ObserverCamera, places: Mapping[int, Announcement]
    ) -> None:
        """tracks: those that are detected. places: the latest of each drone."""
        self._scans.append(_Scan(tracks, view))
        while self._scans[0].t < view.observer.t - MEMORY_S:
            self._scans.popleft()
        for drone, place in places.items():
            before = self._said.get(drone)
            if before is None or place.t > before.t:
                self._compare(drone, place, before)

    def keep(self, tracks: Container[int]) -> None:
        """Tracks that have ended are forgotten."""
        for pair in [pair for pair in self._pairs if pair[0] not in tracks]:
            del self._pairs[pair]

    def weaken(self, track_id: int, log_odds: float) -> None:
        """It was not seen for a while, or met another: what it did before speaks for no more than this, and it may not
        be where it was."""
        for scan in (*self._scans, *(said.scan for said in self._said.values())):
            scan.gone.add(track_id)
        for (track, drone), pair in self._pairs.items():
            if track == track_id:
                self._pairs[track, drone] = _judged(np.maximum(pair.log, -log_odds))

    def log_ratio(self, track_id: int, drone_id: int) -> float:
        """How much more likely the track is the drone than another thing, by how both moved."""
        pair = self._pairs.get((track_id, drone_id))
        return 0.0 if pair is None else pair.ratio

    def _compare(self, drone: int, place: Announcement, before: _SaidPlace | None) -> None:
        scan = min(self._scans, key=lambda scan: abs(scan.t - place.t))
        if abs(scan.t - place.t) > SIMULTANEOUS:
            return
        towards = place.position - scan.origin
        distance = max(float(np.linalg.norm(towards)), NEAREST)
        self._said[drone] = now = _SaidPlace(place.t, towards / distance, scan)
        if before is None or now.t - before.t > LONGEST_S:
            return
        both = [track for track in scan.row if track in before.scan.row.keys() - before.scan.gone]
        was = before.scan.rays[[before.scan.row[track] for track in both]]
        ray = scan.rays[[scan.row[track] for track in both]]
        noise = ATTITUDE_SIGMA**2 + (POSITION_SIGMA / distance) ** 2
        flown = (STRANGER_RATE * (now.t - before.t)) ** 2
        variance = noise + np.array([0.0, flown, *(0.0 for _ in STANDS_M)])
        way = scan.origin - before.scan.origin
        # What each model adds to the former ray: (models, 3).
        turns = np.array([now.towards - before.towards, np.zeros(3), *(-way / metres for metres in STANDS_M)])
        foretold = was[:, None] + turns
        foretold /= np.linalg.norm(foretold, axis=2, keepdims=True)
        squared = ((ray[:, None] - foretold) ** 2).sum(axis=2)
        gain = -0.5 * squared / variance - np.log(variance)
        for track, found in zip(both, gain, strict=True):
            pair = self._pairs.get((track, drone))
            log = found if pair is None else pair.log + found
            self._pairs[track, drone] = _judged(log - log.max())


def _judged(log: Array) -> _Pair:
    drone, flies, *stands = log.tolist()
    thing = math.exp(flies) + math.fsum(map(math.exp, stands)) / len(stands)
    other = math.log(max(0.5 * thing, 1e-300))
    return _Pair(log, min(max(drone - other, -MOST), MOST))
