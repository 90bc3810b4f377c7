"""Names that motion alone proves: since when, how surely, and which of them stand where their drone should not be."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.identity.motion_evidence import MotionEvidence
from swarmtrack.identity.reprojection import NEAREST, ObserverCamera
from swarmtrack.messages import Announcement, Array, MotionProof, Track
from swarmtrack.tracking.marginals_of_each import matched_of_each

# Of a probability: from where on it is a proof, and below which it is one no more. Looking at every scan is a
# sequential test, which stops at a lucky moment: hence so high.
PROVED, KEPT = 0.999, 0.99
# Odds from which on a pair may be proved.
DECISIVE = PROVED / (1.0 - PROVED)
# s: by then it has outlasted most lucky moments, and counts for more than a place.
LASTS_S = 1.0
# m/s: a drone that said where it is may have flown on since.
FLIES_ON = 1.0
# Of a place's sigma: a drone that is so far from it is not where it says.
ELSEWHERE_SIGMAS = 3.0


class Astray(NamedTuple):
    """A drone whose motion says that it is a track which is miss_m from where the drone says that it is [m]; None: that
    the track, which had its name, is another thing."""

    drone_id: int
    track_id: int
    miss_m: float | None


class Proofs:
    """By track and drone; told after every scan."""

    def __init__(self) -> None:
        self._proofs: dict[tuple[int, int], MotionProof] = {}
        self._told: set[int] = set()

    def judge(self, t: float, tracks: Sequence[int], motion: MotionEvidence) -> None:
        """tracks: those that are detected. Any of them may be none of the drones, with even odds."""
        drones = motion.exact
        if not drones:
            return
        by_turn = matched_surely(motion.log_ratios(tracks, drones))
        probability = np.tensordot(motion.turn_weight, by_turn, axes=1)
        for i, track in enumerate(tracks):
            for j, drone in enumerate(drones):
                self._note((track, drone), float(probability[i, j]), t)

    def keep(self, tracks: Container[int]) -> None:
        """Tracks that have ended are forgotten."""
        self._proofs = {pair: proof for pair, proof in self._proofs.items() if pair[0] in tracks}

    def of(self, track_id: int, drone_id: int) -> MotionProof | None:
        """None where motion does not prove it."""
        return self._proofs.get((track_id, drone_id))

    def lasts(self, track_id: int, drone_id: int, t: float) -> bool:
        """Whether motion has proved it for a while."""
        proof = self.of(track_id, drone_id)
        return proof is not None and t - proof.since >= LASTS_S

    def lasting(self, t: float) -> Iterator[tuple[int, int]]:
        """Tracks, and the drones that motion has proved for a while that they are."""
        return (pair for pair in self._proofs if self.lasts(*pair, t))

    def track_of(self, drone_id: int) -> int | None:
        """The track that is proved to be a drone."""
        return next((track for track, drone in self._proofs if drone == drone_id), None)

    def astray(
        self, tracks: Mapping[int, Track], view: ObserverCamera, places: Mapping[int, Announcement]
    ) -> list[Astray]:
        """Drones that are seen elsewhere than they say, once each; tracks: of this scan."""
        found = []
        for track, drone in self._proofs:
            if drone in self._told or track not in tracks or drone not in places:
                continue
            place = places[drone]
            towards = place.position - view.team_from_camera.position
            distance = max(float(np.linalg.norm(towards)), NEAREST)
            ray = view.rays(tracks[track].mean[None, ::2])[0]
            miss = float(np.linalg.norm(distance * ray - towards))
            variance = (np.trace(place.position_cov) + np.trace(view.observer.position_cov)) / 3.0
            variance += (distance * view.observer.attitude_sigma) ** 2
            variance += (FLIES_ON * (view.observer.t - place.t)) ** 2
            if miss > ELSEWHERE_SIGMAS * variance**0.5:
                self._told.add(drone)
                found.append(Astray(drone, track, miss))
        return found

    def forget(self, drone_id: int) -> None:
        """It has said anew where it is."""
        self._told.discard(drone_id)

    def _note(self, pair: tuple[int, int], probability: float, t: float) -> None:
        proof = proof_after(self._proofs.pop(pair, None), probability, t)
        if proof is not None:
            self._proofs[pair] = proof


def proof_after(before: MotionProof | None, probability: float, t: float) -> MotionProof | None:
    """What is proved once the pair has that probability; before: what was until then."""
    if probability > PROVED or (before is not None and probability >= KEPT):
        return MotionProof(probability, t if before is None else before.since)
    return None


def matched_surely(ratios: Array) -> Array:
    """(c, n, m) of each track and drone, by log ratios (c, n, m): exactly where it may be a proof, else at least."""
    # The probability over all matchings is at least this: what else the track, or the drone, could be.
    odds = np.exp(ratios)
    rivals = odds.sum(axis=1, keepdims=True) + odds.sum(axis=2, keepdims=True) - odds
    by_turn = odds / (1.0 + rivals)
    # Where a rival may as well be another drone, only all matchings tell: they cost more, and are asked then.
    if ((by_turn < PROVED) & (odds > DECISIVE)).any():
        return matched_of_each(ratios).probability
    return np.asarray(by_turn)
