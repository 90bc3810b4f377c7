"""Do the tracks fit the team? While a track is nobody and a teammate has no track, a start may be wrong.

Where everybody starts some metres from where it says, one of several tracks fits one of several projections by chance,
more often than a place's probability tells: most teammates fly at one height, so that only their azimuths differ. The
others betray it. A track that nobody explains, while a teammate has none, may be that teammate. Until motion, another
look or time tells otherwise, no place is reason enough for a name, and that track is no stranger.

A teammate whose place once fitted together with another's, or that moved as it says where it should be, has a start
that is right, as long as it lives. It is named by its place whoever else is around, and no stranger is it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from swarmtrack.identity.assignment import Assignment
from swarmtrack.identity.names import Names
from swarmtrack.identity.reprojection import NEAREST, ObserverCamera, Predictions
from swarmtrack.identity.teammates import Teammates
from swarmtrack.identity.weighing import MOVES_AS, Weighing
from swarmtrack.messages import Announcement, Array, Track, TrackStatus

# The probability from which on a track, or a teammate, is accounted for.
ACCOUNTED = 0.5
# m: starts are hardly ever further from where they are said to be.
MISPLACED_M = 6.0
# m/s: how fast who left its place may be further from it.
LEAVES = 1.0
# s that names must stand side by side, or motion speak for one, until their places are known to be right; and how many.
FITS_S, TOGETHER = 1.0, 2
# s that a name is kept which a place gave before the tracks ceased to fit the team.
KEPT_S = 0.5


class TeamFit:
    """Told of every scan."""

    def __init__(self, teammates: Teammates, names: Names, weighing: Weighing) -> None:
        self._teammates = teammates
        self._names = names
        self._weighing = weighing
        self._missing: list[int] = []
        """The teammates without a track of whom it is not known that their places are right."""
        self._puzzling_since = math.inf
        self._most_fit = True
        self._fits_since: dict[int, float] = {}
        """By drone whose place fits: since when, s."""
        self._placed: set[int] = set()
        """The drones whose places are known to be right."""

    def look(self, tracks: Sequence[Track], predicted: Predictions, p_drone: Array, t: float) -> None:
        """tracks (n): those that are matched with the `predicted` (k) in the scan of t; p_drone (n, k): by the
        posterior."""
        likely = (p_drone.sum(axis=0) > ACCOUNTED).tolist()
        found = {drone for drone, is_likely in zip(predicted.drone_id, likely, strict=True) if is_likely}
        known = self._teammates.announced.keys() - self._teammates.clashing
        self._missing = sorted(known - found - set(self._names.stated) - self._placed)
        explained = (p_drone.sum(axis=1) > ACCOUNTED).tolist()
        odd = [
            track.id
            for track, is_explained in zip(tracks, explained, strict=True)
            if track.status is TrackStatus.CONFIRMED
            and not is_explained
            and self._names.stated_of(track)[0] is None
        ]
        odd = [track for track in odd if self._others(track)]
        # Where there are more of them than teammates are missing, the scene is full of such things.
        is_puzzling = 0 < len(odd) <= len(self._missing)
        self._puzzling_since = min(self._puzzling_since, t) if is_puzzling else math.inf
        fits = set(self._names.stated) | found
        self._most_fit = len(fits) >= len(odd)
        self._remember(t)

    def tells(self, drone_id: int) -> bool:
        """Whether its place is reason enough for its name."""
        if not self._is_puzzling or drone_id in self._placed:
            return True
        # Who tells how it moves will prove its name in a moment.
        return self._most_fit and not self._weighing.tells_motion(drone_id)

    def forbids(self, name: Assignment, t: float) -> bool:
        """Whether a name that motion does not prove is given up: its place gave it before it showed that the tracks do
        not fit the team, they have not for a while, and motion will tell."""
        lasts = t - self._puzzling_since >= KEPT_S
        return lasts and not self.tells(name.drone_id) and self._weighing.tells_motion(name.drone_id)

    def may_be_missing(self, track: Track, view: ObserverCamera) -> bool:
        """Whether a track that no place explains may be a teammate whose start is wrong."""
        whereabouts = self._teammates.whereabouts
        return any(
            _is_near(track, whereabouts.latest(drone), view, stays=drone in whereabouts.on_pad)
            for drone in self._others(track.id)
        )

    def forget(self, drone_id: int) -> None:
        """Another life of the drone begins in another place."""
        self._placed.discard(drone_id)
        self._fits_since.pop(drone_id, None)

    @property
    def _is_puzzling(self) -> bool:
        return math.isfinite(self._puzzling_since)

    def _others(self, track_id: int) -> list[int]:
        """The missing that it may be by how it moves."""
        return [drone for drone in self._missing if self._weighing.motion(track_id, drone) > -MOVES_AS]

    def _remember(self, t: float) -> None:
        settled = self._names.settled
        together = len(settled) >= TOGETHER and not self._is_puzzling
        fit = [
            held.drone_id
            for held in settled
            if held.drone_id not in self._placed
            and (together or self._weighing.motion(held.track_id, held.drone_id) > MOVES_AS)
        ]
        self._fits_since = {drone: self._fits_since.get(drone, t) for drone in fit}
        self._placed |= {drone for drone, since in self._fits_since.items() if t - since >= FITS_S}


def _is_near(track: Track, place: Announcement, view: ObserverCamera, *, stays: bool) -> bool:
    """Whether the ray to a track passes the place within what a start may be off."""
    ray = view.rays(track.mean[None, ::2])[0]
    towards = place.position - view.team_from_camera.position
    miss = float(np.linalg.norm(towards - max(float(ray @ towards), NEAREST) * ray))
    left = 0.0 if stays else LEAVES * abs(view.observer.t - place.t)
    return miss < MISPLACED_M + left + math.sqrt(float(np.trace(place.position_cov)))
