"""Who is who: gives drones' IDs to tracks, keeps them, and asks again when something changed.

Theory of operation. An announced pose tells where a drone *was*; a track that was given its ID carries it from there,
so an ID is kept until its track ends. Every scan, what is undecided (tracks without an ID, drones without a track) is
matched anew: the posterior over all one-to-one matchings, of residuals averaged over a short window, gives an ID
where it is likely enough, and "unknown" else. A drone whose track ended is expected where it was seen last, moving
on.

An ID that was given stands until something speaks against it (`Standing`). News of the drone, from itself or from
observers who see it elsewhere, lets the same posterior try the case again, with the past as prior. A track that was
not detected for a while may have come back as another drone: its ID is withheld until the posterior is sure again,
and if it was hidden by a teammate, both are asked where they are. A track that no drone explains for a while is
foreign. While two processes speak as one drone, that ID is given to nobody.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.evidence import Evidence
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.posterior import LOG_ANYWHERE, log_ratios, nearest, residuals
from swarmtrack.identity.questions import Questions
from swarmtrack.identity.reprojection import LastSeen, Predictions, View, joined, reproject, retrace
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

HELD_LOG_ODDS = math.log(1e3)  # of an ID that was given: how rarely a track jumps from one drone to another
HIDDEN_LOG_ODDS = math.log(3.0)  # of one whose track met another, or came back from where it was not seen
HIDDEN_S = 0.25  # s without a detection: no longer a miss
MEETING_PX = 10.0  # between two boxes, so near that one of them may take the other's detections
# Of a box's side, one sigma: between its middle and the drone's. Half hidden drones count, too.
OFF_CENTRE = 0.15
VERIFY_S = 1.0  # s between two questions to drones that keep hiding each other
LIKELY = 0.01  # of a candidate that is worth a question
ASKED = 2  # drones because of one track at a time
DEPARTED_S = 60.0  # s after which a drone whose process is gone is no candidate any more
DISPUTE_S = 5.0  # s that an overruled drone stays unnamed, unless it is heard
FORGET_S = 30.0  # s after which it does not matter where somebody was last seen
NAMELESS_S = 1.0  # s that a track is nameless before its candidates are asked for their poses
AHEAD_S = 0.1  # s: over which a track's velocity becomes a turn of its ray


class Standing(enum.Enum):
    """How an ID stands that a track holds."""

    SETTLED = enum.auto()
    TRIED = enum.auto()  # there is news of the drone; the ID is stated until it is refuted
    HIDDEN = enum.auto()  # the track is not detected: the drone may come back as another one
    DOUBTED = enum.auto()  # it is detected again; the ID is not stated until it is sure


UNSEEN = (Standing.HIDDEN, Standing.DOUBTED)


@dataclass(slots=True)
class Given:
    """An ID that a track holds. scans: since it is tried or doubted; held: log odds in its favour; seen: where the
    drone was when it was last detected beyond doubt; met: the teammates that may have been taken for it meanwhile,
    last asked at verified_t."""

    drone_id: int
    probability: float
    standing: Standing = Standing.SETTLED
    scans: int = 0
    held: float = HELD_LOG_ODDS
    seen: LastSeen | None = None
    met: set[int] = field(default_factory=set)
    verified_t: float = -math.inf

    @property
    def stated(self) -> bool:
        return self.standing is not Standing.DOUBTED

    @property
    def undecided(self) -> bool:
        return self.standing in (Standing.TRIED, Standing.DOUBTED)

    def settle(self, probability: float) -> None:
        self.standing, self.held, self.probability = Standing.SETTLED, HELD_LOG_ODDS, probability

    def reopen(self, standing: Standing, held: float) -> None:
        self.standing, self.scans, self.held = standing, 0, min(held, self.held)


@dataclass(slots=True)
class _Stranger:
    """A nameless track. unexplained_since [s]: since when no drone is likely to be it, with probability p_none;
    foreign: for long enough; asked: whether those who have a name were asked for their poses because of it."""

    first_t: float
    unexplained_since: float | None = None
    p_none: float = 0.0
    foreign: bool = False
    asked: bool = False


class Identities:
    """Announced poses and the identities given to tracks."""

    def __init__(
        self, drone_id: int, *, camera: PinholeCamera, body_from_camera: Pose, parameters: IdentityParameters
    ) -> None:
        self._drone_id = drone_id
        self._camera = camera
        self._body_from_camera = body_from_camera
        self._parameters = parameters
        self._announced: dict[int, Announcement] = {}
        self._unannounced: set[int] = set()
        self._departed: set[int] = set()
        self._clashing: dict[int, set[str]] = {}
        """By drone that two processes or more speak as: their boots."""
        self._overruled: dict[int, float] = {}
        """By drone: since when."""
        self._given: dict[int, Given] = {}
        self._strangers: dict[int, _Stranger] = {}
        self._lost: dict[int, Given] = {}
        """By drone: what its track held when it ended."""
        self._alive: dict[int, Track] = {}
        self._evidence = Evidence(parameters.window_s)
        self._questions = Questions()

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
        given = self._holder(drone)
        if given is not None and known is not None and given.standing is not Standing.HIDDEN:
            given.reopen(
                Standing.TRIED if given.stated else Standing.DOUBTED,
                HELD_LOG_ODDS if known.boot == announcement.boot else 0.0,
            )
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
                self.withdraw(drone)
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
        """Others see it elsewhere: no track is this drone until it says anew where it is, or the dispute is old."""
        self.withdraw(drone_id)
        self._overruled[drone_id] = t
        self._questions.put(drone_id)

    def withdraw(self, drone_id: int) -> None:
        """No track is this drone any more, nor is it where it was last seen."""
        self._lost.pop(drone_id, None)
        self._given = {track: given for track, given in self._given.items() if given.drone_id != drone_id}

    def observe(self, tracks: Iterable[Track], observer: TeamPose) -> None:
        """Look at the tracks of a scan, with this drone's own pose at its exposure."""
        alive = self._alive = {track.id: track for track in tracks}
        view = View.of(observer, self._camera, self._body_from_camera)
        self._end(alive, observer.t)
        self._forget(observer.t)
        if self._parameters.profile != "paper":
            self._watch_for_hiding(alive, observer.t)
        self._remember_rays(alive, view)
        undecided = [track for track in alive.values() if self._is_undecided(track)]
        self._strangers = {
            track.id: self._strangers.get(track.id) or _Stranger(observer.t)
            for track in undecided
            if track.id not in self._given
        }
        predicted = self._predict(view)
        if self._parameters.profile == "paper":
            self._give_nearest(undecided, predicted)
        else:
            self._give_by_posterior(undecided, predicted, observer.t)

    def label(self, tracks: Iterable[Track]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with who they are."""
        return tuple(IdentifiedTrack(track, *self._name(track.id)) for track in tracks)

    def sightings(self, t: float) -> list[tuple[LastSeen, float]]:
        """The rays to identified drones that were detected in the scan of t, and how surely it is they."""
        held = [given for given in self._given.values() if given.standing is Standing.SETTLED]
        return [(given.seen, given.probability) for given in held if given.seen and given.seen.t == t]

    def take_wanted(self) -> tuple[int, ...]:
        """The drones whose pose is wanted anew; each is told once."""
        return self._questions.take()

    def _name(self, track_id: int) -> tuple[Identity, float]:
        given = self._given.get(track_id)
        if given is not None and given.stated:
            return given.drone_id, given.probability
        stranger = self._strangers.get(track_id)
        if stranger is not None and stranger.foreign:
            return FOREIGN, stranger.p_none
        return None, 0.0

    def _holder(self, drone_id: int) -> Given | None:
        return next((given for given in self._given.values() if given.drone_id == drone_id), None)

    def _is_undecided(self, track: Track) -> bool:
        given = self._given.get(track.id)
        if given is not None:
            return given.undecided and track.coasting_since is None
        return track.status is TrackStatus.CONFIRMED

    # --- what becomes of the tracks that have an ID ---

    def _end(self, alive: Mapping[int, Track], t: float) -> None:
        """Take the IDs from tracks that ended."""
        for id in [id for id in self._given if id not in alive]:
            given = self._given.pop(id)
            if given.seen is not None:
                self._lost[given.drone_id] = given
        self._lost = {
            drone: given
            for drone, given in self._lost.items()
            if given.seen is not None and t - given.seen.t < FORGET_S
        }

    def _forget(self, t: float) -> None:
        """Drop the poses of drones that are long gone, and disputes that nobody settled."""
        held = {given.drone_id for given in self._given.values()}
        for drone in self._departed - held:
            if drone in self._announced and t - self._announced[drone].t > DEPARTED_S:
                del self._announced[drone]
        self._departed &= self._announced.keys()
        self._overruled = {drone: since for drone, since in self._overruled.items() if t - since < DISPUTE_S}

    def _watch_for_hiding(self, alive: Mapping[int, Track], t: float) -> None:
        """Who is not detected may be taken for whoever is near; who was not for a while is doubted when it comes
        back."""
        for id, given in self._given.items():
            since = alive[id].coasting_since
            if since is not None:
                given.met |= self._near(id, alive)
                if t - since >= HIDDEN_S:
                    given.standing = Standing.HIDDEN
            elif given.standing is Standing.HIDDEN:
                given.reopen(Standing.DOUBTED, HIDDEN_LOG_ODDS)
                self._verify(given, t)
            elif given.met:
                still_near = given.met & self._near(id, alive)
                if t - given.verified_t >= VERIFY_S or not still_near:
                    self._verify(given, t)
                    given.met = still_near

    def _near(self, id: int, alive: Mapping[int, Track]) -> set[int]:
        """The drones whose tracks nearly touch this one."""
        others = (other for other in self._given if other != id)
        return {self._given[other].drone_id for other in others if _meet(alive[id], alive[other])}

    def _verify(self, given: Given, t: float) -> None:
        """Ask it and those it met while one of them was not seen: their tracks may have changed places."""
        given.verified_t = t
        for drone in {*given.met, given.drone_id} if given.met else ():
            self._questions.put(drone)
            holder = self._holder(drone)
            if holder is not None:
                holder.held = min(holder.held, HIDDEN_LOG_ODDS)

    def _remember_rays(self, alive: Mapping[int, Track], view: View) -> None:
        seen = [id for id, given in self._given.items() if given.stated and alive[id].coasting_since is None]
        rays = _rays([(self._given[id].drone_id, alive[id]) for id in seen], view)
        for id, ray in zip(seen, rays, strict=True):
            self._given[id].seen = ray

    # --- what is undecided ---

    def _predict(self, view: View) -> Predictions:
        """Where the drones should be that no track has for certain: by their pose, or by where they were seen
        since."""
        p = self._parameters
        settled = {g.drone_id for g in self._given.values() if g.standing is Standing.SETTLED}
        free = [a for drone, a in self._announced.items() if drone not in settled | self._clashing.keys()]
        unseen = [*self._lost.values(), *(g for g in self._given.values() if g.standing in UNSEEN)]
        seen = {g.drone_id: g.seen for g in unseen if g.seen is not None}
        by_sight = [seen[a.drone_id] for a in free if a.drone_id in seen and a.t <= seen[a.drone_id].t]
        found = {ray.drone_id for ray in by_sight}
        by_pose = [a for a in free if a.drone_id not in found]
        return joined(
            reproject(by_pose, view, drift_speed=p.drift_speed, stay_s=p.stay_s),
            retrace(by_sight, view, turn_rate=p.turn_rate),
        )

    def _give_nearest(self, tracks: Sequence[Track], predicted: Predictions) -> None:
        mean = np.array([track.mean for track in tracks]).reshape(-1, 4)
        for row, drone in nearest(mean, predicted).items():
            self._given[tracks[row].id] = Given(drone, 1.0)

    def _give_by_posterior(self, tracks: Sequence[Track], predicted: Predictions, t: float) -> None:
        mean, cov = _of_bodies(tracks)
        self._evidence.add(t, [track.id for track in tracks], predicted.key, residuals(mean, cov, predicted))
        if not tracks:
            return
        probability = matching_marginals(self._log_ratios(tracks, predicted))
        stated = probability[:, : len(predicted.drone_id)]
        for i, track in enumerate(tracks):
            candidates = dict(zip(predicted.drone_id, stated[i].tolist(), strict=True))
            given = self._given.get(track.id)
            if given is not None and self._try(track.id, given, candidates, t):
                continue
            if self._evidence.seen_in(i) >= self._parameters.scans:
                self._name_likeliest(track.id, candidates, t)
            if track.id not in self._given:
                self._wonder(track, candidates, 1.0 - float(probability[i].sum()), t)

    def _log_ratios(self, tracks: Sequence[Track], predicted: Predictions) -> Array:
        """(n, k + u): of the predicted drones, then of those that may be anywhere."""
        ratios = log_ratios(self._evidence.residuals, self._camera)
        for i, track in enumerate(tracks):
            given = self._given.get(track.id)
            if given is not None and given.drone_id in predicted.drone_id:
                ratios[i, predicted.drone_id.index(given.drone_id)] += given.held
        unlocated = len(self._unannounced | self._clashing.keys())
        anywhere = np.full((len(tracks), unlocated), LOG_ANYWHERE)
        return np.concatenate([ratios, anywhere], axis=1)

    def _try(self, track_id: int, given: Given, candidates: Mapping[int, float], t: float) -> bool:
        """Judge an ID that is held, whose drone it is with the probabilities of `candidates`; whether it is kept."""
        given.scans += 1
        if given.scans < self._parameters.scans:
            return True
        if given.drone_id not in candidates and given.stated:
            given.settle(given.probability)  # whom the camera cannot see, it cannot judge
            return True
        p = candidates.get(given.drone_id, 0.0)
        has_rival = any(q > LIKELY for drone, q in candidates.items() if drone != given.drone_id)
        if p >= (self._parameters.probability if has_rival or given.held < HELD_LOG_ODDS else 0.5):
            given.settle(p)
            self._questions.answered(given.drone_id)
            return True
        if p < 0.5:
            del self._given[track_id]
            return False
        self._ask(candidates, t)
        return True

    def _name_likeliest(self, track_id: int, candidates: Mapping[int, float], t: float) -> None:
        """Whoever had this ID loses it: of two tracks of one drone the likelier one is it."""
        drone = max(candidates, key=candidates.__getitem__, default=None)
        if drone is None or drone in self._overruled or candidates[drone] < self._parameters.probability:
            return
        before = self._lost.get(drone) or self._holder(drone)
        self.withdraw(drone)
        self._given[track_id] = Given(drone, candidates[drone])
        self._strangers.pop(track_id, None)
        self._questions.answered(drone)
        if before is not None:
            self._verify(before, t)

    def _wonder(self, track: Track, candidates: Mapping[int, float], p_none: float, t: float) -> None:
        """A track stays nameless: ask those that it may be; if it is nobody, whether all names are where they
        belong."""
        stranger = self._strangers.setdefault(track.id, _Stranger(t))
        stranger.p_none = p_none
        if p_none < self._parameters.probability:
            stranger.unexplained_since, stranger.foreign = None, False
            if t - stranger.first_t > NAMELESS_S:
                self._ask(candidates, t)
            return
        if stranger.unexplained_since is None:
            stranger.unexplained_since = t
        stranger.foreign = t - stranger.unexplained_since >= self._parameters.foreign_s
        if not stranger.asked:
            asked = [self._questions.ask(drone, t) for drone in self._named_near(track)]
            stranger.asked = all(asked)

    def _named_near(self, track: Track) -> list[int]:
        """The teammates whose tracks are nearest to it in the image."""

        def distance(id: int) -> float:
            return float(np.linalg.norm(self._alive[id].mean[::2] - track.mean[::2]))

        return [self._given[id].drone_id for id in sorted(self._given, key=distance)[:ASKED]]

    def _ask(self, candidates: Mapping[int, float], t: float) -> None:
        """Ask the likeliest; in a large swarm nearly everybody is possible."""
        for drone in sorted(candidates, key=candidates.__getitem__)[-ASKED:]:
            if candidates[drone] > LIKELY and t - self._announced[drone].t > NAMELESS_S:
                self._questions.ask(drone, t)


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


def _rays(named: Sequence[tuple[int, Track]], view: View) -> list[LastSeen]:
    """The rays to tracks that are drones, and how these turn."""
    if not named:
        return []
    mean = np.array([track.mean for _, track in named])
    here = view.rays(mean[:, ::2])
    there = view.rays(mean[:, ::2] + AHEAD_S * mean[:, 1::2])
    sigma = np.sqrt([np.trace(track.cov[::2, ::2]) / 2.0 for _, track in named]) / view.camera.fx
    origin = view.team_from_camera.position
    return [
        LastSeen(drone, track.t, here[i], (there[i] - here[i]) / AHEAD_S, float(sigma[i]), origin)
        for i, (drone, track) in enumerate(named)
    ]
