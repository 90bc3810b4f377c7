"""Who is who: gives drones' IDs to tracks, keeps them, and asks again when something changed.

Theory of operation. An announced pose tells where a drone *was*. A track that is assigned its ID carries it from there,
so an ID is kept until its track ends, or until something speaks against it: `standing.py` says what.

Every scan, what is undecided (tracks without an ID, drones without a track, IDs in doubt) is matched again. The
posterior over all one-to-one matchings assigns an ID where it is likely enough, and "unknown" elsewhere. It goes by
residuals averaged over a short window, by how large tracks look (`spans.py`), by whether they move as their drones
say (`motion_evidence.py`), and by what the scene is like (`scene.py`). An ID that is challenged or doubted has its past
as the prior. A settled one is judged again when a nameless track comes where its drone should be: then its past counts
only as far as it was earned. A drone whose track ended is expected where it was seen last, moving on, or where it
reported itself since (`whereabouts.py`). A track that no drone explains for a while is foreign.

Where two drones hide each other, their tracks may change places unseen, so both are asked where they are. While two
processes speak as one drone, that ID is assigned to no track.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.assignment import HELD_LOG_ODDS, HIDDEN_LOG_ODDS, Assignment, Unassigned
from swarmtrack.identity.boxes import coincide, meet
from swarmtrack.identity.disputes import Disputes
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.pose_requests import PoseRequests
from swarmtrack.identity.posterior import LOG_ANYWHERE, nearest
from swarmtrack.identity.proof import Astray
from swarmtrack.identity.reprojection import (
    NOBODY,
    LastSeen,
    ObserverCamera,
    Predictions,
    is_vague,
    joined,
    rays_to,
    reproject,
    retrace,
)
from swarmtrack.identity.self_doubt import SelfDoubt
from swarmtrack.identity.standing import Event, Standing, fire
from swarmtrack.identity.weighing import RIVAL, Match, Weighing
from swarmtrack.identity.whereabouts import Whereabouts
from swarmtrack.messages import (
    FOREIGN,
    AgreedMotion,
    Announcement,
    Array,
    IdClash,
    IdentifiedTrack,
    Identity,
    Membership,
    MotionReport,
    PeerArrived,
    PeerDeparted,
    SightingReport,
    Track,
    TrackStatus,
)
from swarmtrack.motion.ego import TeamPose

# Of these, the track does not show where the drone is.
UNSEEN = (Standing.HIDDEN, Standing.DOUBTED)

# s without a detection: no longer a miss.
HIDDEN_S = 0.25
# s between two questions to drones that keep hiding each other.
VERIFY_S = 1.0
# The least probability of a candidate that is worth a question.
LIKELY = 0.01
# How many drones are asked because of one track at a time.
ASKED = 2
# s after which a drone whose process is gone is no candidate any more.
DEPARTED_S = 60.0
# s after which it does not matter where somebody was last seen.
FORGET_S = 30.0
# s that a track is nameless before its candidates are asked for their poses.
NAMELESS_S = 1.0
# s since a drone said where it is: beyond, it is worth asking. Who reports, does so once a second.
STALE_S = 1.5
# s: so old a place still tells the distance.
FRESH_S = 1.5
# Of the image's size, on each side: as far as a camera that turns fast sees in half a second.
SOON = 0.5
# Log odds: a name whose track does not move as its drone does is judged again.
CONTRADICTED = -math.log(10.0)


class Identities:
    """Announced poses, and the IDs assigned to tracks."""

    def __init__(
        self, drone_id: int, *, camera: PinholeCamera, body_from_camera: Pose, parameters: IdentityParameters
    ) -> None:
        self._drone_id = drone_id
        self._camera = camera
        self._body_from_camera = body_from_camera
        self._parameters = parameters
        self._whereabouts = Whereabouts()
        self._announced = self._whereabouts.announced
        self._unannounced: set[int] = set()
        """Alive, but with no pose that we know: these may be any track."""
        self._departed: set[int] = set()
        """Whose process is gone."""
        self._clashing: dict[int, set[str]] = {}
        """By drone that several processes speak as: their boots."""
        self._disputes = Disputes()
        self._assignments: dict[int, Assignment] = {}
        """By track."""
        self._unassigned: dict[int, Unassigned] = {}
        """By track."""
        self._lost: dict[int, Assignment] = {}
        """By drone: its assignment when its track ended."""
        self._alive: dict[int, Track] = {}
        self._weighing = Weighing(camera, parameters.window_s)
        self._self_doubt = SelfDoubt(drift_speed=parameters.drift_speed, stay_s=parameters.stay_s)
        self._vouched: set[int] = set()
        self._expected: dict[int, bool] = {}
        """By drone without a settled track: whether it should be in view, or nearly."""
        self._pose_requests = PoseRequests()
        self._astray: list[Astray] = []

    @property
    def self_doubt(self) -> bool:
        """Whether this drone says that its own start or heading is wrong."""
        return self._self_doubt.said

    @property
    def announced(self) -> dict[int, Announcement]:
        """The latest announcement of every teammate."""
        return dict(self._announced)

    def announce(self, announcement: Announcement) -> bool:
        """Take in a teammate's pose. Returns False for our own ID, or for one that is not newer."""
        drone = announcement.drone_id
        known = self._announced.get(drone)
        repeated = known and known.boot == announcement.boot and known.sequence >= announcement.sequence
        if drone == self._drone_id or drone in self._clashing or repeated:
            return False
        self._disputes.settle(drone)
        if is_vague(announcement) and self._weighing.proofs.track_of(drone) is None:
            # It knows no more where it is: neither do we.
            self._withdraw(drone, Event.OVERRULED)
        self._whereabouts.announce(announcement)
        self._unannounced.discard(drone)
        self._weighing.proofs.forget(drone)
        held = self._holder(drone)
        if held is not None and known is not None:
            self._fire(held, Event.ANNOUNCED)
            if held.undecided:
                # Of a process that started again, what was believed before says nothing.
                held.weaken(HELD_LOG_ODDS if known.boot == announcement.boot else 0.0)
        if known is not None and known.boot != announcement.boot:
            self._weighing.forget(drone)
            self._disputes.begin_life(drone)
        return True

    def agree(self, motion: AgreedMotion) -> None:
        """A teammate moves like that, as was agreed before the flight."""
        self._weighing.agree(motion)

    def on_report(self, report: SightingReport) -> None:
        """A teammate says with what it sees where it is: nobody has to ask it."""
        drone = report.observer
        if drone != self._drone_id and drone not in self._clashing:
            self._whereabouts.report(report)

    def on_motion(self, report: MotionReport) -> None:
        """A teammate says how it moves."""
        drone = report.drone_id
        if drone != self._drone_id and drone not in self._clashing:
            self._weighing.hear(report)

    def on_membership(self, event: Membership) -> None:
        """Who lives. While two processes speak as one drone, nobody can tell which pose is its own."""
        drone = event.drone_id
        match event:
            case PeerArrived():
                self._departed.discard(drone)
                if drone != self._drone_id and drone not in self._announced:
                    # Until it announces itself it may be any track.
                    self._unannounced.add(drone)
            case IdClash(boots=boots, ours=False):
                self._clashing[drone] = set(boots)
                self._whereabouts.forget(drone)
                self._withdraw(drone, Event.CLASHED)
            case PeerDeparted(boot=boot):
                clash = self._clashing.get(drone, set())
                clash.discard(boot)
                if len(clash) == 1:
                    del self._clashing[drone]
                    # The pose of the one that remains is yet to be heard.
                    self._unannounced.add(drone)
                elif not clash:
                    # The drone is still where it is, and so, for a while, is its pose.
                    self._unannounced.discard(drone)
                    self._departed.add(drone)

    def overrule(self, drone_id: int, t: float) -> None:
        """Others see it elsewhere: no track is this drone until it announces itself again, or the dispute is old. What
        motion proves is not for them to say."""
        if self._weighing.proofs.track_of(drone_id) is not None:
            return
        self._withdraw(drone_id, Event.OVERRULED)
        self._disputes.overrule(drone_id, t)
        self._pose_requests.put(drone_id)

    def observe(self, tracks: Iterable[Track], observer: TeamPose) -> None:
        """Look at the tracks of a scan, with this drone's own pose at its exposure."""
        alive = self._alive = {track.id: track for track in tracks}
        view = ObserverCamera.of(observer, self._camera, self._body_from_camera)
        self._end(alive, observer.t)
        self._forget(observer.t)
        if self._parameters.profile != "paper":
            self._watch_for_occlusion(alive, observer.t)
        self._remember_rays(alive, view)
        undecided = [track for track in alive.values() if self._is_undecided(track)]
        self._unassigned = {
            track.id: self._unassigned.get(track.id) or Unassigned(observer.t)
            for track in undecided
            if track.id not in self._assignments
        }
        if self._parameters.profile == "paper":
            self._assign_nearest(undecided, self._predict(view))
        else:
            self._assign_by_posterior(undecided, view)

    def label(self, tracks: Iterable[Track]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with who they are."""
        return tuple(self._labelled(track) for track in tracks)

    def sightings(self, t: float) -> list[tuple[LastSeen, float]]:
        """The rays to identified drones that were detected in the scan of t, and how surely it is they."""
        settled = [held for held in self._assignments.values() if held.standing is Standing.SETTLED]
        return [
            (held.seen, held.probability * self._alive[held.track_id].probability)
            for held in settled
            if held.seen and held.seen.t == t
        ]

    def take_vouched(self) -> tuple[int, ...]:
        """The tracks that are a teammate although they look weak; each is returned once."""
        vouched, self._vouched = tuple(sorted(self._vouched)), set()
        return vouched

    def take_astray(self) -> tuple[Astray, ...]:
        """The drones that motion finds elsewhere than they say; each is returned once."""
        astray, self._astray = tuple(self._astray), []
        return astray

    def take_wanted(self) -> tuple[int, ...]:
        """The drones that should announce their pose again; each is returned once."""
        return self._pose_requests.take()

    def _labelled(self, track: Track) -> IdentifiedTrack:
        name, probability = self._name(track)
        proof = self._weighing.proofs.of(track.id, name) if isinstance(name, int) else None
        return IdentifiedTrack(track, name, probability, proof)

    def _name(self, track: Track) -> tuple[Identity, float]:
        """An ID says where its drone is. That is so as surely as the track still has its target."""
        assignment = self._assignments.get(track.id)
        if assignment is not None and assignment.stated:
            probability = assignment.probability * track.probability
            return (assignment.drone_id, probability) if probability > 0.5 else (None, 0.0)
        unassigned = self._unassigned.get(track.id)
        if unassigned is not None and unassigned.foreign:
            return FOREIGN, unassigned.p_none
        return None, 0.0

    def _holder(self, drone_id: int) -> Assignment | None:
        return next((held for held in self._assignments.values() if held.drone_id == drone_id), None)

    def _fire(self, assignment: Assignment, event: Event) -> None:
        """Let something happen to an assignment: its standing changes, or it ends."""
        standing = fire(assignment.standing, event)
        if standing is None:
            del self._assignments[assignment.track_id]
        else:
            assignment.enter(standing)

    def _withdraw(self, drone_id: int, event: Event) -> None:
        """No track is this drone any more, nor is it where it was last seen."""
        self._lost.pop(drone_id, None)
        for held in [held for held in self._assignments.values() if held.drone_id == drone_id]:
            self._fire(held, event)

    def _is_undecided(self, track: Track) -> bool:
        """Whether it takes part in the matching. An ID that is not settled does even while its track is not detected:
        else whoever is near would have no rival for as long."""
        held = self._assignments.get(track.id)
        if self._parameters.profile == "paper":
            judged = held is None or (held.undecided and track.coasting_since is None)
            return judged and (held is not None or track.status is TrackStatus.CONFIRMED)
        if held is not None:
            return held.standing is not Standing.SETTLED
        # One that is not confirmed yet, or lost, may be a rival of one that is named or could be.
        return track.status is not TrackStatus.TENTATIVE or track.probability >= RIVAL

    # --- what becomes of the tracks that have an ID ---

    def _end(self, alive: Mapping[int, Track], t: float) -> None:
        """Take the IDs from tracks that ended."""
        for ended in [held for held in self._assignments.values() if held.track_id not in alive]:
            self._fire(ended, Event.TRACK_ENDED)
            if ended.seen is not None:
                self._lost[ended.drone_id] = ended
        self._lost = {
            drone: ended
            for drone, ended in self._lost.items()
            if ended.seen is not None and t - ended.seen.t < FORGET_S
        }

    def _forget(self, t: float) -> None:
        """Drop the poses of drones that are long gone, and disputes that nobody settled."""
        named = {held.drone_id for held in self._assignments.values()}
        for drone in self._departed - named:
            if drone in self._announced and t - self._announced[drone].t > DEPARTED_S:
                self._whereabouts.forget(drone)
        self._departed &= self._announced.keys()
        self._disputes.forget(t)

    def _watch_for_occlusion(self, alive: Mapping[int, Track], t: float) -> None:
        """A drone that is not detected may be taken for one near it. If that lasts, its ID is doubted once the track
        is detected again."""
        for id, held in self._assignments.items():
            since = alive[id].coasting_since
            if since is not None:
                held.met |= self._near(id, alive)
                if t - since >= HIDDEN_S:
                    self._fire(held, Event.UNDETECTED)
            elif held.standing is Standing.HIDDEN:
                self._fire(held, Event.DETECTED_AGAIN)
                held.weaken(HIDDEN_LOG_ODDS)
                self._weighing.hide(id, HIDDEN_LOG_ODDS)
                self._verify(held, t)
            elif held.met:
                still_near = held.met & self._near(id, alive)
                if t - held.verified_t >= VERIFY_S or not still_near:
                    self._verify(held, t)
                    held.met = still_near

    def _near(self, id: int, alive: Mapping[int, Track]) -> set[int]:
        """The drones whose tracks nearly touch this one."""
        others = (held for held in self._assignments.values() if held.track_id != id)
        return {other.drone_id for other in others if meet(alive[id], alive[other.track_id])}

    def _verify(self, held: Assignment, t: float) -> None:
        """Ask it and those it met while one of them was not seen: their tracks may have changed places."""
        held.verified_t = t
        for drone in {*held.met, held.drone_id} if held.met else ():
            self._pose_requests.put(drone)
            holder = self._holder(drone)
            if holder is not None:
                holder.weaken(HIDDEN_LOG_ODDS)
                self._weighing.hide(holder.track_id, HIDDEN_LOG_ODDS)

    def _remember_rays(self, alive: Mapping[int, Track], view: ObserverCamera) -> None:
        detected = [
            held
            for held in self._assignments.values()
            if held.stated and alive[held.track_id].coasting_since is None
        ]
        rays = rays_to([(held.drone_id, alive[held.track_id]) for held in detected], view)
        for held, ray in zip(detected, rays, strict=True):
            held.seen = ray

    # --- what is undecided ---

    def _predict(self, view: ObserverCamera) -> Predictions:
        """Where the drones should be that no track has for certain: by where they were seen last, or where they said
        that they are since. Of what is newer than the sight, an announcement was asked for and counts; a report
        counts where it tells more."""
        p = self._parameters
        held = self._assignments.values()
        settled = {a.drone_id for a in held if a.standing is Standing.SETTLED}
        free = [drone for drone in self._announced if drone not in settled | self._clashing.keys()]
        unseen = [*self._lost.values(), *(a for a in held if a.standing in UNSEEN)]
        seen = {a.drone_id: a.seen for a in unseen if a.seen is not None}
        by_sight = [seen[d] for d in free if d in seen and self._announced[d].t <= seen[d].t]
        sight = retrace(by_sight, view, turn_rate=p.turn_rate)
        places = [self._whereabouts.latest(drone) for drone in free]
        said = reproject(
            places, view, on_pad=self._whereabouts.on_pad, drift_speed=p.drift_speed, stay_s=p.stay_s
        )
        older = {d for d in free if d in seen and self._whereabouts.latest(d).t <= seen[d].t}
        width = {d: spread for d, spread in zip(said.drone_id, said.spread, strict=True) if d not in older}
        vaguer = [
            j for j, drone in enumerate(sight.drone_id) if drone in width and width[drone] < sight.spread[j]
        ]
        sight = sight.only([j for j in range(len(sight.key)) if j not in vaguer])
        found = set(sight.drone_id) | (older & {ray.drone_id for ray in by_sight})
        return joined(said.only([j for j, drone in enumerate(said.drone_id) if drone not in found]), sight)

    def _assign_nearest(self, tracks: Sequence[Track], predicted: Predictions) -> None:
        mean = np.array([track.mean for track in tracks]).reshape(-1, 4)
        for row, drone in nearest(mean, predicted).items():
            id = tracks[row].id
            if id in self._assignments:
                # Replaced in its place: of two tracks with one ID, news is of the first.
                fire(self._assignments[id].standing, Event.REASSIGNED)
            self._assignments[id] = Assignment(id, drone, 1.0)

    def _assign_by_posterior(self, undecided: Sequence[Track], view: ObserverCamera) -> None:
        t = view.observer.t
        places = {drone: self._whereabouts.latest(drone) for drone in self._announced}
        self._weighing.watch(self._alive, view, places)
        for found in self._weighing.proofs.astray(self._alive, view, places):
            self._astray.append(found)
            self._whereabouts.doubt(found.drone_id, found.miss_m or 0.0)
        names = self._assignments.values()
        self._self_doubt.look(
            self._alive,
            names,
            self._lost.values(),
            view=view,
            whereabouts=self._whereabouts,
            weighing=self._weighing,
        )
        for name in [name for name in names if self._self_doubt.forbids(name, self._weighing)]:
            self._fire(name, Event.OVERRULED)
        contested, held = self._contested(undecided, view)
        tracks, predicted = [*undecided, *held], joined(self._predict(view), contested)
        predicted = joined(predicted, self._unexpected(tracks, predicted))
        self._ask_who_enters(predicted, t)
        own = self._self_doubt.own
        every = self._weighing.weigh(tracks, predicted, view, own)
        judged = [self._with_history(ratios, tracks, predicted) for ratios in every]
        probability, ratios = own.mixed(every, judged)
        p_drone = probability[:, : len(predicted.drone_id)]
        p_none = np.maximum(own.turned - probability.sum(axis=1), 0.0).tolist()
        nameless = [pair for pair in zip(tracks, p_none, strict=True) if pair[0].id in self._unassigned]
        named = [held.drone_id for held in self._assignments.values() if held.stated]
        self._weighing.learn(view, nameless, predicted, p_drone, named)
        for i, track in enumerate(tracks):
            matches = self._weighing.matches(track, predicted, p_drone[i], p_drone.sum(axis=0), ratios[i])
            if track.id in self._assignments and track.coasting_since is None:
                self._judge(self._assignments[track.id], matches, t)
            if track.status is TrackStatus.LOST:
                continue
            if track.id not in self._assignments and self._weighing.seen_in(i) >= self._parameters.scans:
                self._assign_likeliest(track, matches, t)
            if track.id not in self._assignments and track.status is not TrackStatus.TENTATIVE:
                candidates = {drone: match.probability for drone, match in matches.items()}
                self._keep_unassigned(track, candidates, p_none[i], t)

    def _unexpected(self, tracks: Sequence[Track], predicted: Predictions) -> Predictions:
        """Drones that no track has for certain and that should not be in the image, of which a track has the motion."""
        unmoved = {
            held.drone_id
            for held in self._assignments.values()
            if held.standing is Standing.SETTLED and not self._is_contradicted(held)
        }
        known = self._announced.keys() - self._clashing.keys() - unmoved - set(predicted.drone_id)
        return self._weighing.astray(tracks, sorted(known))

    def _contested(self, undecided: Sequence[Track], view: ObserverCamera) -> tuple[Predictions, list[Track]]:
        """Where the settled drones should be in whose gate a nameless track is, or whose track does not move as they
        do; and those tracks."""
        newcomers = [track for track in undecided if track.id not in self._assignments]
        known = [
            held
            for held in self._assignments.values()
            if held.standing is Standing.SETTLED and held.drone_id in self._announced
        ]
        settled = {held.drone_id: self._alive[held.track_id] for held in known}
        contradicted = {held.drone_id for held in known if self._is_contradicted(held)}
        if not settled or not (newcomers or contradicted):
            return NOBODY, []
        p = self._parameters
        places = [self._whereabouts.latest(drone) for drone in settled]
        predicted = reproject(
            places, view, on_pad=self._whereabouts.on_pad, drift_speed=p.drift_speed, stay_s=p.stay_s
        )
        near = self._weighing.near(newcomers, predicted)
        columns = [
            j
            for j, drone in enumerate(predicted.drone_id)
            if drone in contradicted
            or any(not coincide(newcomers[i], settled[drone]) for i in np.flatnonzero(near[:, j]).tolist())
        ]
        return predicted.only(columns), [settled[predicted.drone_id[j]] for j in columns]

    def _moved_since(self, held: Assignment) -> float:
        """Log ratio: what motion says of an ID since it was last judged."""
        return self._weighing.motion(held.track_id, held.drone_id) - held.motion

    def _is_contradicted(self, held: Assignment) -> bool:
        """Whether the track has ceased to move as its drone says."""
        return self._moved_since(held) < CONTRADICTED

    def _with_history(self, ratios: Array, tracks: Sequence[Track], predicted: Predictions) -> Array:
        """(n, k + u): the same with what speaks for the IDs that tracks have; then of drones that may be anywhere."""
        judged = ratios.copy()
        column = {drone: j for j, drone in enumerate(predicted.drone_id)}
        for i, track in enumerate(tracks):
            held = self._assignments.get(track.id)
            if held is None or held.drone_id not in column:
                continue
            j = column[held.drone_id]
            rivals = [
                other
                for other, ratio in zip(tracks, ratios[:, j].tolist(), strict=True)
                if ratio > 0.0 and other.id not in self._assignments and not coincide(other, track)
            ]
            if held.standing is Standing.SETTLED and not self._is_contradicted(held):
                # Its own place is as old as its announcement; the track has carried it on from where it was judged.
                judged[i, j] = max(ratios[i, j], held.evidence + self._moved_since(held))
            judged[i, j] += self._history(held, rivals)
        unlocated = len(self._unannounced | self._clashing.keys())
        return np.concatenate([judged, np.full((len(tracks), unlocated), LOG_ANYWHERE)], axis=1)

    def _history(self, held: Assignment, rivals: Sequence[Track]) -> float:
        """Log odds in favour of an ID beside where its drone should be. Named tracks hardly ever change places, but
        that a newcomer is no rival has yet to be shown: only that the drone was not missed before the newcomer came."""
        if not rivals and not self._is_contradicted(held):
            return held.log_odds
        newest = min((self._unassigned[track.id].first_t for track in rivals), default=math.inf)
        return min(held.log_odds, self._weighing.log_missed(held.drone_id) if newest > held.since else 0.0)

    def _judge(self, held: Assignment, matches: Mapping[int, Match], t: float) -> None:
        """Confirm, doubt or refute an ID that is undecided, or that a newcomer contests."""
        drone, p = held.drone_id, self._parameters.probability
        match = matches.get(drone)
        if held.standing is Standing.SETTLED:
            if match is not None and match.probability < p:
                if self._weighing.disproves(held.track_id, drone):
                    self._astray.append(Astray(drone, held.track_id, None))
                self._doubt(held, matches, t)
            return
        held.scans += 1
        if held.scans < self._parameters.scans:
            return
        has_rival = any(other.probability > LIKELY for id, other in matches.items() if id != drone)
        sure = p if has_rival or held.log_odds < HELD_LOG_ODDS else 0.5
        if match is None:
            self._fire(held, Event.OUT_OF_VIEW)
        elif match.probability >= (p if match.elsewhere > LIKELY else sure):
            self._fire(held, Event.CONFIRMED)
            self._believe(held, match, t)
        elif match.probability < 0.5:
            self._fire(held, Event.REFUTED)
        elif held.standing is Standing.CHALLENGED and match.elsewhere > LIKELY:
            self._doubt(held, matches, t)
        else:
            self._ask({drone: match.probability for drone, match in matches.items()}, t)

    def _doubt(self, held: Assignment, matches: Mapping[int, Match], t: float) -> None:
        """Another track may be the drone: where this one was seen says nothing of where the drone is."""
        self._fire(held, Event.RIVALLED)
        held.weaken(self._weighing.log_missed(held.drone_id))
        held.seen = None
        self._ask({drone: match.probability for drone, match in matches.items()}, t)

    def _believe(self, held: Assignment, match: Match, t: float) -> None:
        """The posterior is sure: what it went by is remembered."""
        held.probability = match.probability
        held.evidence = match.log_ratio
        held.motion = self._weighing.motion(held.track_id, held.drone_id)
        held.since = t
        place = self._whereabouts.latest(held.drone_id)
        if t - place.t <= FRESH_S:
            track = self._alive[held.track_id]
            self._weighing.recognise(held.drone_id, track, match.distance, match.probability)
        self._pose_requests.answered(held.drone_id)

    def _assign_likeliest(self, track: Track, matches: Mapping[int, Match], t: float) -> None:
        """Whichever track had this ID loses it: of two tracks of one drone the likelier one is it. One that looks too
        weak for a track is vouched for, and named once the tracker agrees."""
        drone = max(matches, key=lambda drone: matches[drone].probability, default=None)
        if drone is None or drone in self._disputes:
            return
        if is_vague(self._announced[drone]) and not self._weighing.tells_motion(drone):
            return
        if self._disputes.needs_proof(drone) and self._weighing.proofs.of(track.id, drone) is None:
            return
        match = matches[drone]
        if match.probability < self._weighing.sure(drone, self._parameters.probability):
            return
        if track.status is TrackStatus.TENTATIVE:
            self._vouched.add(track.id)
            return
        before = self._lost.get(drone) or self._holder(drone)
        self._withdraw(drone, Event.REASSIGNED)
        held = self._assignments[track.id] = Assignment(track.id, drone, match.probability)
        self._unassigned.pop(track.id, None)
        self._believe(held, match, t)
        if before is not None:
            self._verify(before, t)

    def _keep_unassigned(
        self, track: Track, candidates: Mapping[int, float], p_none: float, t: float
    ) -> None:
        """A track stays without an ID: ask the drones that it may be. One that is none of them asks nobody."""
        unassigned = self._unassigned.setdefault(track.id, Unassigned(t))
        explained = unassigned.weigh(p_none, t, self._parameters)
        # Of a team that nobody has heard of, anybody may be.
        unassigned.foreign &= bool(self._announced) and not self._self_doubt.said
        if explained and t - unassigned.first_t > NAMELESS_S:
            self._ask(candidates, t)

    def _ask_who_enters(self, predicted: Predictions, t: float) -> None:
        """Whoever should come into view soon is asked where it is, so that the answer is there when its track is."""
        u, v = predicted.pixel.T / np.array([[self._camera.width], [self._camera.height]])
        near = (np.abs(u - 0.5) < 0.5 + SOON) & (np.abs(v - 0.5) < 0.5 + SOON)
        expected = dict(zip(predicted.drone_id, near.tolist(), strict=True))
        for drone, enters in expected.items():
            outside = self._expected.get(drone) is False
            if enters and outside and t - self._whereabouts.latest(drone).t > STALE_S:
                self._pose_requests.ask(drone, t)
        named = (held.drone_id for held in self._assignments.values() if held.stated)
        self._expected = dict.fromkeys(self._announced, False) | dict.fromkeys(named, True) | expected

    def _ask(self, candidates: Mapping[int, float], t: float) -> None:
        """Ask the likeliest; in a large swarm nearly everybody is possible."""
        for drone in sorted(candidates, key=candidates.__getitem__)[-ASKED:]:
            if candidates[drone] > LIKELY and t - self._whereabouts.latest(drone).t > STALE_S:
                self._pose_requests.ask(drone, t)
