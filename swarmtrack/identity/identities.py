"""Who is who: gives drones' IDs to tracks, keeps them, and asks again when something changed.

Theory of operation. An announced pose tells where a drone *was*. A track that is assigned its ID carries it from there,
so an ID is kept until its track ends, or until something speaks against it: `standing.py` says what.

Every scan, what is undecided (tracks without an ID, drones without a track, IDs in doubt) is matched again. The
posterior over all one-to-one matchings, of residuals averaged over a short window, assigns an ID where it is likely
enough, and "unknown" elsewhere. An ID that is challenged or doubted has its past as the prior. A drone whose track
ended is expected where it was seen last, moving on. A track that no drone explains for a while is foreign.

Where two drones hide each other, their tracks may change places unseen, so both are asked where they are. While two
processes speak as one drone, that ID is assigned to no track.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.assignment import HELD_LOG_ODDS, HIDDEN_LOG_ODDS, Assignment
from swarmtrack.identity.evidence import Evidence
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.pose_requests import PoseRequests
from swarmtrack.identity.posterior import LOG_ANYWHERE, log_ratios, nearest, residuals
from swarmtrack.identity.reprojection import (
    LastSeen,
    ObserverCamera,
    Predictions,
    joined,
    rays_to,
    reproject,
    retrace,
)
from swarmtrack.identity.standing import Event, Standing, fire
from swarmtrack.messages import (
    FOREIGN,
    Announcement,
    Array,
    IdClash,
    IdentifiedTrack,
    Identity,
    Membership,
    PeerArrived,
    PeerDeparted,
    Track,
    TrackStatus,
)
from swarmtrack.motion.ego import TeamPose
from swarmtrack.tracking.marginals import matching_marginals

# Of these, the track does not show where the drone is.
UNSEEN = (Standing.HIDDEN, Standing.DOUBTED)

# s without a detection: no longer a miss.
HIDDEN_S = 0.25
# Between two boxes, so near that one of them may take the other's detections.
MEETING_PX = 10.0
# Of a box's side, one sigma: between its middle and the drone's. Half hidden drones count, too.
OFF_CENTRE = 0.15
# s between two questions to drones that keep hiding each other.
VERIFY_S = 1.0
# The least probability of a candidate that is worth a question.
LIKELY = 0.01
# How many drones are asked because of one track at a time.
ASKED = 2
# s after which a drone whose process is gone is no candidate any more.
DEPARTED_S = 60.0
# s that an overruled drone stays unnamed, unless it is heard.
DISPUTE_S = 5.0
# s after which it does not matter where somebody was last seen.
FORGET_S = 30.0
# s that a track is nameless before its candidates are asked for their poses.
NAMELESS_S = 1.0


@dataclass(slots=True)
class _Unassigned:
    """A track without an ID."""

    first_t: float
    unexplained_since: float | None = None
    """s: since when it is probably no announced drone."""
    p_none: float = 0.0
    """The probability that it is none."""
    foreign: bool = False
    """Unexplained for long enough."""
    asked: bool = False
    """Whether the drones with an ID near it were asked for their poses because of it."""


class Identities:
    """Announced poses, and the IDs assigned to tracks."""

    def __init__(
        self, drone_id: int, *, camera: PinholeCamera, body_from_camera: Pose, parameters: IdentityParameters
    ) -> None:
        self._drone_id = drone_id
        self._camera = camera
        self._body_from_camera = body_from_camera
        self._parameters = parameters
        self._announced: dict[int, Announcement] = {}
        self._unannounced: set[int] = set()
        """Alive, but with no pose that we know: these may be any track."""
        self._departed: set[int] = set()
        """Whose process is gone."""
        self._clashing: dict[int, set[str]] = {}
        """By drone that several processes speak as: their boots."""
        self._overruled: dict[int, float] = {}
        """By drone: since when."""
        self._assignments: dict[int, Assignment] = {}
        """By track."""
        self._unassigned: dict[int, _Unassigned] = {}
        """By track."""
        self._lost: dict[int, Assignment] = {}
        """By drone: its assignment when its track ended."""
        self._alive: dict[int, Track] = {}
        self._evidence = Evidence(parameters.window_s)
        self._pose_requests = PoseRequests()

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
        self._announced[drone] = announcement
        self._unannounced.discard(drone)
        self._overruled.pop(drone, None)
        held = self._holder(drone)
        if held is not None and known is not None:
            self._fire(held, Event.ANNOUNCED)
            if held.undecided:
                # Of a process that started again, what was believed before says nothing.
                held.weaken(HELD_LOG_ODDS if known.boot == announcement.boot else 0.0)
        return True

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
                self._announced.pop(drone, None)
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
        """Others see it elsewhere: no track is this drone until it announces itself again, or the dispute is old."""
        self._withdraw(drone_id, Event.OVERRULED)
        self._overruled[drone_id] = t
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
            track.id: self._unassigned.get(track.id) or _Unassigned(observer.t)
            for track in undecided
            if track.id not in self._assignments
        }
        predicted = self._predict(view)
        if self._parameters.profile == "paper":
            self._assign_nearest(undecided, predicted)
        else:
            self._assign_by_posterior(undecided, predicted, observer.t)

    def label(self, tracks: Iterable[Track]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with who they are."""
        return tuple(IdentifiedTrack(track, *self._name(track.id)) for track in tracks)

    def sightings(self, t: float) -> list[tuple[LastSeen, float]]:
        """The rays to identified drones that were detected in the scan of t, and how surely it is they."""
        settled = [held for held in self._assignments.values() if held.standing is Standing.SETTLED]
        return [(held.seen, held.probability) for held in settled if held.seen and held.seen.t == t]

    def take_wanted(self) -> tuple[int, ...]:
        """The drones that should announce their pose again; each is returned once."""
        return self._pose_requests.take()

    def _name(self, track_id: int) -> tuple[Identity, float]:
        assignment = self._assignments.get(track_id)
        if assignment is not None and assignment.stated:
            return assignment.drone_id, assignment.probability
        unassigned = self._unassigned.get(track_id)
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
        assignment = self._assignments.get(track.id)
        if assignment is not None:
            return assignment.undecided and track.coasting_since is None
        return track.status is TrackStatus.CONFIRMED

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
                del self._announced[drone]
        self._departed &= self._announced.keys()
        self._overruled = {drone: since for drone, since in self._overruled.items() if t - since < DISPUTE_S}

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
                self._verify(held, t)
            elif held.met:
                still_near = held.met & self._near(id, alive)
                if t - held.verified_t >= VERIFY_S or not still_near:
                    self._verify(held, t)
                    held.met = still_near

    def _near(self, id: int, alive: Mapping[int, Track]) -> set[int]:
        """The drones whose tracks nearly touch this one."""
        others = (held for held in self._assignments.values() if held.track_id != id)
        return {other.drone_id for other in others if _meet(alive[id], alive[other.track_id])}

    def _verify(self, held: Assignment, t: float) -> None:
        """Ask it and those it met while one of them was not seen: their tracks may have changed places."""
        held.verified_t = t
        for drone in {*held.met, held.drone_id} if held.met else ():
            self._pose_requests.put(drone)
            holder = self._holder(drone)
            if holder is not None:
                holder.weaken(HIDDEN_LOG_ODDS)

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
        """Where the drones should be that no track has for certain: by their pose, or by where they were seen
        since."""
        p = self._parameters
        held = self._assignments.values()
        settled = {a.drone_id for a in held if a.standing is Standing.SETTLED}
        free = [a for drone, a in self._announced.items() if drone not in settled | self._clashing.keys()]
        unseen = [*self._lost.values(), *(a for a in held if a.standing in UNSEEN)]
        seen = {a.drone_id: a.seen for a in unseen if a.seen is not None}
        by_sight = [seen[a.drone_id] for a in free if a.drone_id in seen and a.t <= seen[a.drone_id].t]
        found = {ray.drone_id for ray in by_sight}
        by_pose = [a for a in free if a.drone_id not in found]
        return joined(
            reproject(by_pose, view, drift_speed=p.drift_speed, stay_s=p.stay_s),
            retrace(by_sight, view, turn_rate=p.turn_rate),
        )

    def _assign_nearest(self, tracks: Sequence[Track], predicted: Predictions) -> None:
        mean = np.array([track.mean for track in tracks]).reshape(-1, 4)
        for row, drone in nearest(mean, predicted).items():
            id = tracks[row].id
            if id in self._assignments:
                # Replaced in its place: of two tracks with one ID, news is of the first.
                fire(self._assignments[id].standing, Event.REASSIGNED)
            self._assignments[id] = Assignment(id, drone, 1.0)

    def _assign_by_posterior(self, tracks: Sequence[Track], predicted: Predictions, t: float) -> None:
        mean, cov = _of_bodies(tracks)
        self._evidence.add(t, [track.id for track in tracks], predicted.key, residuals(mean, cov, predicted))
        if not tracks:
            return
        probability = matching_marginals(self._log_ratios(tracks, predicted))
        stated = probability[:, : len(predicted.drone_id)]
        for i, track in enumerate(tracks):
            candidates = dict(zip(predicted.drone_id, stated[i].tolist(), strict=True))
            if track.id in self._assignments:
                self._judge(self._assignments[track.id], candidates, t)
            if track.id not in self._assignments and self._evidence.seen_in(i) >= self._parameters.scans:
                self._assign_likeliest(track.id, candidates, t)
            if track.id not in self._assignments:
                self._keep_unassigned(track, candidates, 1.0 - float(probability[i].sum()), t)

    def _log_ratios(self, tracks: Sequence[Track], predicted: Predictions) -> Array:
        """(n, k + u): of the predicted drones, then of those that may be anywhere."""
        ratios = log_ratios(self._evidence.residuals, self._camera)
        for i, track in enumerate(tracks):
            assignment = self._assignments.get(track.id)
            if assignment is not None and assignment.drone_id in predicted.drone_id:
                ratios[i, predicted.drone_id.index(assignment.drone_id)] += assignment.log_odds
        unlocated = len(self._unannounced | self._clashing.keys())
        anywhere = np.full((len(tracks), unlocated), LOG_ANYWHERE)
        return np.concatenate([ratios, anywhere], axis=1)

    def _judge(self, assignment: Assignment, candidates: Mapping[int, float], t: float) -> None:
        """Confirm or refute an ID that is challenged or doubted. candidates: by drone, the probability that the track
        is it."""
        assignment.scans += 1
        if assignment.scans < self._parameters.scans:
            return
        drone, p = assignment.drone_id, candidates.get(assignment.drone_id, 0.0)
        has_rival = any(q > LIKELY for other, q in candidates.items() if other != drone)
        sure = self._parameters.probability if has_rival or assignment.log_odds < HELD_LOG_ODDS else 0.5
        if drone not in candidates:
            self._fire(assignment, Event.OUT_OF_VIEW)
        elif p >= sure:
            self._fire(assignment, Event.CONFIRMED)
            assignment.probability = p
            self._pose_requests.answered(drone)
        elif p < 0.5:
            self._fire(assignment, Event.REFUTED)
        else:
            self._ask(candidates, t)

    def _assign_likeliest(self, track_id: int, candidates: Mapping[int, float], t: float) -> None:
        """Whichever track had this ID loses it: of two tracks of one drone the likelier one is it."""
        drone = max(candidates, key=candidates.__getitem__, default=None)
        if drone is None or drone in self._overruled or candidates[drone] < self._parameters.probability:
            return
        before = self._lost.get(drone) or self._holder(drone)
        self._withdraw(drone, Event.REASSIGNED)
        self._assignments[track_id] = Assignment(track_id, drone, candidates[drone])
        self._unassigned.pop(track_id, None)
        self._pose_requests.answered(drone)
        if before is not None:
            self._verify(before, t)

    def _keep_unassigned(
        self, track: Track, candidates: Mapping[int, float], p_none: float, t: float
    ) -> None:
        """A track stays without an ID: ask the drones that it may be; if it is none of them, ask those near it whether
        all IDs are where they belong."""
        unassigned = self._unassigned.setdefault(track.id, _Unassigned(t))
        unassigned.p_none = p_none
        if p_none < self._parameters.probability:
            unassigned.unexplained_since, unassigned.foreign = None, False
            if t - unassigned.first_t > NAMELESS_S:
                self._ask(candidates, t)
            return
        if unassigned.unexplained_since is None:
            unassigned.unexplained_since = t
        unassigned.foreign = t - unassigned.unexplained_since >= self._parameters.foreign_s
        if not unassigned.asked:
            asked = [self._pose_requests.ask(drone, t) for drone in self._assigned_near(track)]
            unassigned.asked = all(asked)

    def _assigned_near(self, track: Track) -> list[int]:
        """The teammates whose tracks are nearest to it in the image."""

        def distance(held: Assignment) -> float:
            return float(np.linalg.norm(self._alive[held.track_id].mean[::2] - track.mean[::2]))

        return [held.drone_id for held in sorted(self._assignments.values(), key=distance)[:ASKED]]

    def _ask(self, candidates: Mapping[int, float], t: float) -> None:
        """Ask the likeliest; in a large swarm nearly everybody is possible."""
        for drone in sorted(candidates, key=candidates.__getitem__)[-ASKED:]:
            if candidates[drone] > LIKELY and t - self._announced[drone].t > NAMELESS_S:
                self._pose_requests.ask(drone, t)


def _of_bodies(tracks: Sequence[Track]) -> tuple[Array, Array]:
    """Means (n, 4) and covariances (n, 4, 4) of the drones' bodies, which are not quite in the middle of their
    boxes."""
    mean = np.array([track.mean for track in tracks]).reshape(-1, 4)
    cov = np.array([track.cov for track in tracks]).reshape(-1, 4, 4)
    size = np.nan_to_num([track.size for track in tracks], nan=0.0).reshape(-1, 2)
    cov[:, [0, 2], [0, 2]] += (OFF_CENTRE * size) ** 2
    return mean, cov


def _meet(one: Track, other: Track) -> bool:
    """Whether two boxes touch, nearly."""
    size = np.nan_to_num(one.size, nan=0.0) + np.nan_to_num(other.size, nan=0.0)
    return bool((np.abs(one.mean[::2] - other.mean[::2]) < 0.5 * size + MEETING_PX).all())
