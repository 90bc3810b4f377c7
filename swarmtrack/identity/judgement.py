"""What becomes of a name once the posterior has spoken: it is given, kept, doubted, or asked about.

Every scan the posterior weighs what is undecided. A track without an ID gets one where that is likely enough. One that
is challenged or doubted has its past as the prior. A settled one is judged again when a nameless track comes where its
drone should be: then its past counts only as far as it was earned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set

import numpy as np

from swarmtrack.identity.assignment import HELD_LOG_ODDS, Assignment
from swarmtrack.identity.boxes import coincide
from swarmtrack.identity.disputes import Disputes
from swarmtrack.identity.names import Names
from swarmtrack.identity.occlusion import OcclusionWatch
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.pose_requests import PoseRequests
from swarmtrack.identity.posterior import LOG_ANYWHERE
from swarmtrack.identity.proof import Astray
from swarmtrack.identity.reprojection import ObserverCamera, Predictions, is_vague
from swarmtrack.identity.self_doubt import SelfDoubt
from swarmtrack.identity.standing import Event, Standing
from swarmtrack.identity.team_fit import TeamFit
from swarmtrack.identity.teammates import Teammates
from swarmtrack.identity.weighing import Match, Weighing
from swarmtrack.messages import Announcement, Array, Track, TrackStatus

# The least probability of a candidate that is worth a question.
LIKELY = 0.01
# How many drones are asked because of one track at a time.
ASKED = 2
# s that a track is nameless before its candidates are asked for their poses.
NAMELESS_S = 1.0
# s: so old a place still tells where its drone is, and how far.
FRESH_S = 1.5


class Judgement:
    """Changes names by what the posterior says of their tracks."""

    def __init__(
        self,
        parameters: IdentityParameters,
        *,
        teammates: Teammates,
        names: Names,
        weighing: Weighing,
        disputes: Disputes,
        pose_requests: PoseRequests,
        occlusion: OcclusionWatch,
        team_fit: TeamFit,
        self_doubt: SelfDoubt,
    ) -> None:
        self._parameters = parameters
        self._teammates = teammates
        self._names = names
        self._weighing = weighing
        self._disputes = disputes
        self._pose_requests = pose_requests
        self._occlusion = occlusion
        self._team_fit = team_fit
        self._self_doubt = self_doubt

    def call_out(self, view: ObserverCamera, places: Mapping[int, Announcement]) -> list[Astray]:
        """The drones that motion finds elsewhere than they report: from now on they are not placed by that."""
        astray = self._weighing.proofs.astray(self._names.shown, view, places)
        for found in astray:
            self._teammates.whereabouts.doubt(found.drone_id, found.miss_m or 0.0)
        return astray

    # --- what the past of a name says, before the posterior is made ---

    def with_history(self, ratios: Array, tracks: Sequence[Track], predicted: Predictions) -> Array:
        """(c, n, k + u): log ratios (c, n, k) by c hypotheses on the own pose with what speaks for the IDs that tracks
        have; then of drones that may be anywhere."""
        judged = ratios.copy()
        column = {drone: j for j, drone in enumerate(predicted.drone_id)}
        for i, track in enumerate(tracks):
            held = self._names.of(track.id)
            if held is None or held.drone_id not in column:
                continue
            j = column[held.drone_id]
            if held.standing is Standing.SETTLED and not self._weighing.is_contradicted(held):
                # Its own place is as old as its announcement; the track has carried it on from where it was judged.
                judged[:, i, j] = np.maximum(
                    ratios[:, i, j], held.evidence + self._weighing.moved_since(held)
                )
            judged[:, i, j] += self._history(held, track, tracks, ratios[:, :, j])
        unlocated = np.full((*ratios.shape[:2], self._teammates.unlocated), LOG_ANYWHERE)
        return np.concatenate([judged, unlocated], axis=2)

    def _history(self, held: Assignment, track: Track, tracks: Sequence[Track], ratios: Array) -> Array:
        """(c,): log odds in favour of an ID beside where its drone should be; ratios (c, n) of all tracks and that
        drone. Named tracks hardly ever change places, but that a newcomer is no rival has yet to be shown: only that
        the drone was not missed before the newcomer came."""
        begun = np.array([self._newcomer_since(other, track) for other in tracks])
        newest = np.where(ratios > 0.0, begun, np.inf).min(axis=1)
        judged_anew = np.isfinite(newest) | self._weighing.is_contradicted(held)
        earned = np.where(newest > held.since, self._weighing.log_missed(held.drone_id), 0.0)
        return np.where(judged_anew, np.minimum(held.log_odds, earned), held.log_odds)

    def _newcomer_since(self, other: Track, track: Track) -> float:
        """s: since when it is nameless and beside that track; infinite where it is no rival of its."""
        if self._names.of(other.id) is not None or coincide(other, track):
            return math.inf
        return self._names.unassigned[other.id].first_t

    # --- what the posterior says ---

    def judge(self, held: Assignment, matches: Mapping[int, Match], t: float) -> Astray | None:
        """Confirm, doubt or refute an ID that is undecided, or that a newcomer contests. Returns its drone where motion
        disproves the ID."""
        match = matches.get(held.drone_id)
        if held.standing is not Standing.SETTLED:
            held.scans += 1
            if held.scans >= self._parameters.scans:
                self._judge_undecided(held, match, matches, t)
            return None
        if match is None or match.probability >= self._parameters.probability:
            return None
        disproved = self._weighing.disproves(held.track_id, held.drone_id)
        self._doubt(held, matches, t)
        return Astray(held.drone_id, held.track_id, None) if disproved else None

    def _judge_undecided(
        self, held: Assignment, match: Match | None, matches: Mapping[int, Match], t: float
    ) -> None:
        drone, p = held.drone_id, self._parameters.probability
        has_rival = any(other.probability > LIKELY for id, other in matches.items() if id != drone)
        sure = p if has_rival or held.log_odds < HELD_LOG_ODDS else 0.5
        if match is None:
            self._names.fire(held, Event.OUT_OF_VIEW)
        elif match.probability >= (p if match.elsewhere > LIKELY else sure):
            self._names.fire(held, Event.CONFIRMED)
            self._believe(held, match, t)
        elif match.probability < 0.5:
            self._names.fire(held, Event.REFUTED)
        elif held.standing is Standing.CHALLENGED and match.elsewhere > LIKELY:
            self._doubt(held, matches, t)
        else:
            self._ask(matches, t)

    def assign_likeliest(self, track: Track, matches: Mapping[int, Match], t: float) -> bool:
        """Whichever track had this ID loses it: of two tracks of one drone the likelier one is it. Returns whether it
        is likely enough, but looks too weak for a track: it is to be vouched for, and named once the tracker agrees."""
        drone = max(matches, key=lambda drone: matches[drone].probability, default=None)
        if drone is None or not self._may_be_named(track, drone, t):
            return False
        match = matches[drone]
        if match.probability < self._weighing.sure(drone, self._parameters.probability):
            return False
        if track.status is TrackStatus.TENTATIVE:
            return True
        before = self._names.lost.get(drone) or self._names.holder(drone)
        self._names.withdraw(drone, Event.REASSIGNED)
        held = Assignment(track.id, drone, match.probability)
        self._names.assign(held)
        self._believe(held, match, t)
        if before is not None:
            self._occlusion.verify(before, t)
        return False

    def located(self, t: float) -> set[int]:
        """The drones that have just said where they are."""
        latest = self._teammates.whereabouts.latest
        places = [latest(drone) for drone in self._teammates.announced]
        return {place.drone_id for place in places if t - place.t <= FRESH_S and not is_vague(place)}

    def leave_unassigned(
        self,
        track: Track,
        matches: Mapping[int, Match],
        p_none: float,
        t: float,
        *,
        may_be_foreign: bool,
        located: Set[int],
    ) -> None:
        """A track stays without an ID: ask the drones that it may be. One that is none of them asks nobody.
        may_be_foreign: whether "none of them" tells anything yet; located: by `located`."""
        unassigned = self._names.leave_unassigned(track.id, t)
        explained = unassigned.weigh(p_none, t, self._parameters, located)
        unassigned.foreign &= may_be_foreign
        if explained and t - unassigned.first_t > NAMELESS_S:
            self._ask(matches, t)

    def _may_be_named(self, track: Track, drone: int, t: float) -> bool:
        """Whether any probability is enough: who is disputed, or knows no place, is named by motion alone, and so is
        whoever tells how it moves where the own place, or the team's, may be wrong. No place turns a stranger into a
        teammate that was elsewhere."""
        if drone in self._disputes:
            return False
        tells_motion = self._weighing.tells_motion(drone)
        if is_vague(self._teammates.whereabouts.latest(drone)) and not tells_motion:
            return False
        if self._weighing.proofs.lasts(track.id, drone, t):
            return True
        if self._disputes.needs_proof(drone) or not self._team_fit.tells(drone):
            return False
        unassigned = self._names.unassigned.get(track.id)
        if unassigned is not None and unassigned.was_strange_to(drone, t):
            return False
        return self._self_doubt.trusts_place(track.id, drone, self._weighing)

    def _doubt(self, held: Assignment, matches: Mapping[int, Match], t: float) -> None:
        """Another track may be the drone: where this one was seen says nothing of where the drone is."""
        self._names.fire(held, Event.RIVALLED)
        held.weaken(self._weighing.log_missed(held.drone_id))
        held.seen = None
        self._ask(matches, t)

    def _believe(self, held: Assignment, match: Match, t: float) -> None:
        """The posterior is sure: what it went by is remembered."""
        place = self._teammates.whereabouts.latest(held.drone_id)
        is_fresh = t - place.t <= FRESH_S
        stays = is_fresh or held.drone_id in self._teammates.whereabouts.on_pad
        held.probability = self._weighing.claimed(held, match, t) if stays else match.probability
        held.evidence = match.log_ratio
        held.motion = self._weighing.motion(held.track_id, held.drone_id)
        held.since = t
        if is_fresh:
            track = self._names.alive[held.track_id]
            self._weighing.recognise(held.drone_id, track, match.distance, match.probability)
        self._pose_requests.answered(held.drone_id)

    def _ask(self, matches: Mapping[int, Match], t: float) -> None:
        """Ask the likeliest; in a large swarm nearly everybody is possible."""
        for drone in sorted(matches, key=lambda drone: matches[drone].probability)[-ASKED:]:
            if matches[drone].probability > LIKELY:
                self._pose_requests.ask_again(self._teammates.whereabouts.latest(drone), t)
