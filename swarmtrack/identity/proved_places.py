"""Names that motion leaves open between teammates that fly alike, and that their places decide.

A team in formation flies as one. A track that is new to its observer then moves as any of them, and motion proves that
it is one of them, but not which. Place alone names it, and is believed no more than a swapped pad allows
(`weighing.PLACE_ALONE`). But whose place once was where motion had proved it to be stands on no other's pad, as long as
neither frame begins anew: how far a track is beside such a place counts as any measurement does. It only ever counts
against a pair, and for no more than `MOST_AGAINST`.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence

import numpy as np

from swarmtrack.identity.motion_evidence import MotionEvidence
from swarmtrack.identity.proof import LASTS_S, Proofs, matched_surely, proof_after
from swarmtrack.identity.reprojection import NEAREST, ObserverCamera
from swarmtrack.messages import Announcement, Array, MotionProof, Track

# Of a place's sigma in two dimensions: within so many it fits; and s for which it must have done so without a break.
FITS_SIGMAS, FITS_S = 2.5, 3.0
# Log odds: a place that was right is wrong since as often as once in ten thousand.
MOST_AGAINST = math.log(1e4)
# m/s²: by which a drone's velocity may have changed since it said where it is.
ACCELERATES = 1.0


class ProvedPlaces:
    """Told after every scan, when motion has been."""

    def __init__(self) -> None:
        self._fits_since: dict[int, float] = {}
        """s: since when motion proves a drone where it says that it is."""
        self._right: set[int] = set()
        """The drones whose places are known to be right."""
        self._decided: dict[tuple[int, int], MotionProof] = {}
        """By track and drone."""

    def keep(self, tracks: Container[int], drones: Container[int]) -> None:
        """drones: those that say how they move. Who falls silent may come back with another frame."""
        self._decided = {pair: one for pair, one in self._decided.items() if pair[0] in tracks}
        for drone in [drone for drone in {*self._right, *self._fits_since} if drone not in drones]:
            self.forget(drone)

    def forget(self, drone_id: int) -> None:
        """It may be elsewhere than it says."""
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
        self,
        tracks: Sequence[Track],
        view: ObserverCamera,
        places: Mapping[int, Announcement],
        motion: MotionEvidence,
        proofs: Proofs,
    ) -> None:
        """tracks: those that are detected; places: where drones that say how they move are."""
        t = view.observer.t
        proved = dict(pair[::-1] for pair in proofs.lasting(t))
        if motion.turns > 1 or not (self._right or proved):
            # Who may look to another side than it thinks knows nobody by place.
            self._decided.clear()
            return
        drones = [drone for drone in motion.exact if drone in places]
        off = np.array([_sigmas_beside(tracks, view, places[drone], motion) for drone in drones])
        row = {track.id: i for i, track in enumerate(tracks)}
        by_place = {drone: track for track, drone in self._decided if self.probability(track, drone, t)}
        self._check({**by_place, **proved}, row, dict(zip(drones, off, strict=True)), t)
        if self._right <= proved.keys() or not tracks:
            return
        against = np.zeros((len(tracks), len(motion.exact)))
        for drone, sigmas in zip(drones, off, strict=True):
            if drone in self._right:
                against[:, motion.exact.index(drone)] = np.minimum(0.5 * sigmas**2, MOST_AGAINST)
        ratios = motion.log_ratios(list(row), motion.exact)
        probability = matched_surely(ratios - against)[0]
        for drone, sigmas in zip(drones, off, strict=True):
            for track, i in row.items():
                before = self._decided.pop((track, drone), None)
                if drone in self._right and sigmas[i] <= FITS_SIGMAS:
                    p = float(probability[i, motion.exact.index(drone)])
                    proof = proof_after(before, p, t)
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


def _sigmas_beside(
    tracks: Sequence[Track], view: ObserverCamera, place: Announcement, motion: MotionEvidence
) -> Array:
    """(n,): how far tracks are beside where a drone says that it is, carried on to now by how it says that it moves."""
    age = view.observer.t - place.t
    said = motion.last_said(place.drone_id)
    velocity = np.zeros(3) if said is None else said.velocity
    towards = place.position + age * velocity - view.team_from_camera.position
    distance = max(float(np.linalg.norm(towards)), NEAREST)
    rays = view.rays(np.array([track.mean[::2] for track in tracks]).reshape(-1, 2))
    variance = (np.trace(place.position_cov) + np.trace(view.observer.position_cov)) / 3.0
    variance += (distance * view.observer.attitude_sigma) ** 2
    variance += (0.5 * ACCELERATES * age**2) ** 2
    return np.asarray(np.linalg.norm(distance * rays - towards, axis=1) / math.sqrt(variance))
