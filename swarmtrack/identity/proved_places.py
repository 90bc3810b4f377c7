"""Names that motion leaves open between teammates that fly alike, and that their places decide.

A team in formation flies as one. A track that is new to its observer then moves as any of them, and motion proves that
it is one of them, but not which. Place alone names it, and is believed no more than a swapped pad allows
(`weighing.PLACE_ALONE`). But whoever once was where it says, when motion proved that it is it, stands on no other's
pad, as long as neither frame begins anew: how far a track is beside its place, carried on by how it says that it moves,
counts as any measurement does. It only ever counts against a pair, and for no more than `MOST_AGAINST`. Who it cannot
be also tells who it is, as in all matchings.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.identity.motion_evidence import MotionEvidence, Saying, follows
from swarmtrack.identity.proof import LASTS_S, Proofs, matched_surely, proof_after
from swarmtrack.identity.reprojection import NEAREST, ObserverCamera
from swarmtrack.messages import Announcement, Array, MotionProof, Track

# Of a place's sigma in two dimensions: within so many it fits; and s for which it must have done so without a break.
FITS_SIGMAS, FITS_S = 2.5, 3.0
# m: a place that is known no better tells nothing here.
VAGUEST_M = 1.5
# Log odds: a place that was right is wrong since as often as once in ten thousand.
MOST_AGAINST = math.log(1e4)
# m/s²: by which a drone's velocity may have changed since it said how it moves.
ACCELERATES = 1.0


class _Carried(NamedTuple):
    """The last place that a drone said; displacement (3,) m: that of its motion at that time, known by a saying that is
    `apart` s older or newer."""

    place: Announcement
    displacement: Array
    apart: float

    def at(self, t: float, said: Saying) -> tuple[Array, float]:
        """Where it is at t (3,) m; and m², per axis, of what it flew since it said where it is. said: its last."""
        ahead = t - said.t
        flown = said.displacement + ahead * said.velocity - self.displacement
        off = (0.5 * ACCELERATES * np.square([ahead, self.apart])).tolist()
        return self.place.position + flown, math.hypot(*off, said.trust.wander) ** 2


class ProvedPlaces:
    """Told of all that drones say of their motion; and of every scan, when motion has been."""

    def __init__(self) -> None:
        self._said: dict[int, Saying] = {}
        """By drone, the last."""
        self._carried: dict[int, _Carried] = {}
        self._fits_since: dict[int, float] = {}
        """s: since when motion proves a drone where it says that it is."""
        self._right: set[int] = set()
        """The drones whose places are known to be right."""
        self._decided: dict[tuple[int, int], MotionProof] = {}
        """By track and drone."""

    def hear(self, saying: Saying) -> None:
        """Who was silent, or counts from elsewhere, may have another frame."""
        before = self._said.get(saying.drone_id)
        if before is not None:
            if saying.t <= before.t:
                return
            if not follows(before, saying):
                self.forget(saying.drone_id)
        self._said[saying.drone_id] = saying

    def follow(self, tracks: Container[int], places: Mapping[int, Announcement]) -> None:
        """Tracks that have ended are forgotten. places: of the drones that say how they move, the last that each
        said."""
        self._decided = {pair: one for pair, one in self._decided.items() if pair[0] in tracks}
        for drone in [drone for drone in self._carried if drone not in places]:
            self.forget(drone)
        for drone, place in places.items():
            before, said = self._carried.get(drone), self._said[drone]
            if before is None or before.place.t != place.t:
                apart = place.t - said.t
                self._carried[drone] = _Carried(place, said.displacement + apart * said.velocity, apart)

    def forget(self, drone_id: int) -> None:
        """It may be elsewhere than it says."""
        self._carried.pop(drone_id, None)
        self._right.discard(drone_id)
        self._fits_since.pop(drone_id, None)
        self._decided = {pair: one for pair, one in self._decided.items() if pair[1] != drone_id}

    def forget_all(self) -> None:
        """The observer may be elsewhere than it thinks."""
        self._right.clear()
        self._fits_since.clear()
        self._decided.clear()

    def probability(self, track_id: int, drone_id: int, t: float) -> float:
        """That a track is a drone, by how both move and by places that are right; 0 where that proves nothing, or has
        not for a while."""
        proof = self._decided.get((track_id, drone_id))
        return proof.probability if proof is not None and t - proof.since >= LASTS_S else 0.0

    def judge(
        self, tracks: Sequence[Track], view: ObserverCamera, motion: MotionEvidence, proofs: Proofs
    ) -> None:
        """tracks: those that are detected."""
        t = view.observer.t
        proved = dict(pair[::-1] for pair in proofs.lasting(t))
        if not tracks or not (self._right or proved):
            return
        row = {track.id: i for i, track in enumerate(tracks)}
        off = self._sigmas_beside(tracks, view)
        by_place = {drone: track for track, drone in self._decided if self.probability(track, drone, t)}
        self._check({**by_place, **proved}, row, off, t)
        if self._right <= proved.keys():
            return
        drones = motion.exact
        against = np.zeros((len(tracks), len(drones)))
        for j, drone in enumerate(drones):
            if drone in self._right and drone in off:
                against[:, j] = np.minimum(0.5 * off[drone] ** 2, MOST_AGAINST)
        # While its north may be turned, its places tell something only if it is not.
        unturned = motion.log_ratios(list(row), drones)[:1] - against
        probability = motion.turn_weight[0] * matched_surely(unturned)[0]
        for j, drone in enumerate(drones):
            for track, i in row.items():
                before = self._decided.pop((track, drone), None)
                is_beside = drone in off and off[drone][i] > FITS_SIGMAS
                proof = None if is_beside else proof_after(before, float(probability[i, j]), t)
                if proof is not None:
                    self._decided[track, drone] = proof

    def _check(
        self, known: Mapping[int, int], row: Mapping[int, int], off: Mapping[int, Array], t: float
    ) -> None:
        """Whether drones whose tracks are known, by drone, are where they say. row: of the tracks that are detected;
        off: by drone, of all rows [sigmas]."""
        self._fits_since = {drone: t0 for drone, t0 in self._fits_since.items() if drone in known}
        for drone, track in known.items():
            if track not in row or drone not in off:
                continue
            if off[drone][row[track]] > FITS_SIGMAS:
                self.forget(drone)
            elif t - self._fits_since.setdefault(drone, t) >= FITS_S:
                self._right.add(drone)

    def _sigmas_beside(self, tracks: Sequence[Track], view: ObserverCamera) -> dict[int, Array]:
        """(n,) by drone whose place is known well enough: how far the tracks are beside it."""
        rays = view.rays(np.array([track.mean[::2] for track in tracks]).reshape(-1, 2))
        own = float(np.trace(view.observer.position_cov)) / 3.0
        found = {}
        for drone, carried in self._carried.items():
            position, flown = carried.at(view.observer.t, self._said[drone])
            towards = position - view.team_from_camera.position
            distance = max(float(np.linalg.norm(towards)), NEAREST)
            variance = float(np.trace(carried.place.position_cov)) / 3.0 + own + flown
            variance += (distance * view.observer.attitude_sigma) ** 2
            if variance < VAGUEST_M**2:
                found[drone] = np.linalg.norm(distance * rays - towards, axis=1) / math.sqrt(variance)
        return found
