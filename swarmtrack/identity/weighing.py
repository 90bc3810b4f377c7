"""What speaks for a track being a drone, beside its past: where it is, how large it looks, how it moves, and what the
scene is like. The four are independent given who is who, so their log ratios add."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.identity.agreed import AgreedMotions
from swarmtrack.identity.assignment import Assignment
from swarmtrack.identity.evidence import Evidence
from swarmtrack.identity.motion_evidence import PUBLISHED, REPORTED, MotionEvidence, Saying
from swarmtrack.identity.own_pose import OwnPose, ScanEvidence, shifted
from swarmtrack.identity.posterior import (
    IN_VIEW,
    LOG_ANYWHERE,
    PRIOR,
    ReprojectionResiduals,
    log_ratios,
    log_ratios_of_each,
    residuals,
    squared_sigmas,
)
from swarmtrack.identity.proof import PROVED, Proofs
from swarmtrack.identity.proved_places import ProvedPlaces
from swarmtrack.identity.reprojection import (
    ASTRAY,
    NOBODY,
    ObserverCamera,
    Predictions,
    anywhere,
    is_vague,
    key_of,
)
from swarmtrack.identity.scene import Scene
from swarmtrack.identity.spans import Spans
from swarmtrack.messages import AgreedMotion, Announcement, Array, MotionReport, Track, TrackStatus
from swarmtrack.tracking.lifecycle import probability_in_view

# Of a box's side, one sigma: between its middle and the drone's. Half hidden drones count, too.
OFF_CENTRE = 0.15
# Existence of a track that is not confirmed, and yet may be the drone whose name another one wants.
RIVAL = 0.5
LEAST_EXISTENCE = 1e-6
# However well a place fits: as often is a start not what was said, or another drone's. Only motion proves a name.
PLACE_ALONE = 0.97
# Whose place is off by more of its sigmas than this has a start, or its observer has one, that is worse than it says:
# then its place gives no name more than so much. In two dimensions, as rare as three sigmas in one.
OFF_SIGMAS, OFF_ALONE = 3.44, 0.9
# Of the image's size: as far as metres carry a teammate that is not far away.
BESIDE = 0.5
# Of a probability, from zero or one: what is further from both is not known yet.
DOUBT = 0.05


# Log ratio of a drone that is not where it says, and so anywhere, and a stranger; and the log odds by motion from which
# on it may be that.
LOG_ASTRAY = LOG_ANYWHERE + math.log(ASTRAY)
MOVES_AS = math.log(20.0)
# Log odds: a name whose track does not move as its drone does is judged again.
CONTRADICTED = -math.log(10.0)
# Of a position's sigma: by how much its error changes in some seconds.
DRIFT_SHARE = 0.1
# How many drones the guess is worth that one which is anywhere is in view.
TEAMS = 5.0
# s after which a drone that said how it moves says it no more.
SILENT_S = 3.0


class Match(NamedTuple):
    """That a track is a drone: probability; elsewhere, that another track is the drone; log_ratio, by all evidence
    but its past; distance m of the drone, NaN where nobody knows; off: by how many sigmas the track is beside where the
    drone should be if it is still there, whatever the observer's heading."""

    probability: float
    elsewhere: float
    log_ratio: float
    distance: float
    off: float


class _Eye(NamedTuple):
    """What is kept of each camera: its residuals, and what its scene is like."""

    camera: PinholeCamera
    evidence: Evidence
    scene: Scene

    @classmethod
    def of(cls, camera: PinholeCamera, window_s: float) -> _Eye:
        return cls(camera, Evidence(window_s), Scene(camera.field[1]))


class Weighing:
    """Log ratios of "the track is that drone" and "it is a stranger, and the drone is not seen"."""

    def __init__(self, cameras: Sequence[PinholeCamera], window_s: float) -> None:
        self._eyes = [_Eye.of(camera, window_s) for camera in cameras]
        self._eye = self._eyes[0]
        """That of the last scan."""
        self._spans = Spans()
        self._motion = MotionEvidence()
        self.proofs = Proofs()
        self.proved_places = ProvedPlaces()
        self._agreed = AgreedMotions()
        self._named: list[int] = []
        self._placed: dict[int, Announcement] = {}
        """By drone: the last place that it said."""
        self._off = np.zeros((0, 0))
        """(n, k): of the last scan, see `Match`."""
        self._published: dict[int, float] = {}
        """By drone: of when its last word on its motion was, s."""

    def hear(self, report: MotionReport) -> None:
        """How a drone moves, by its own word: as long as it says so, its places are no news of that."""
        self._published[report.drone_id] = report.t
        sigma = math.sqrt(float(report.displacement_cov.diagonal().max()))
        trust = PUBLISHED._replace(
            wander=max(PUBLISHED.wander, DRIFT_SHARE * sigma), clock=max(PUBLISHED.clock, report.t_sigma)
        )
        source = ("motion", report.boot)
        saying = Saying(report.drone_id, source, report.t, report.displacement, report.velocity, trust)
        self._motion.hear(saying)
        self.proved_places.hear(saying)

    def step_heading(self, t: float) -> None:
        """By t the observer's heading has stepped."""
        self._motion.begin_again(t)

    def agree(self, motion: AgreedMotion) -> None:
        """A drone moves like that, as was agreed."""
        self._agreed.agree(motion)

    def look(
        self,
        tracks: Sequence[Track],
        view: ObserverCamera,
        predicted: Predictions,
        drones: Sequence[int],
        vague: Sequence[int],
    ) -> ScanEvidence:
        """What a scan tells of the observer's own pose. tracks: those that are confirmed; predicted: of all `drones`
        whose place is known those ahead, whatever has their names; vague: those of whom only the motion is known."""
        mean = np.array([track.mean for track in tracks]).reshape(-1, 4)
        cov = _of_bodies(tracks)
        predicted = predicted.without_heading(view)
        return ScanEvidence(
            mean[:, ::2],
            0.5 * (cov[:, 0, 0] + cov[:, 2, 2]),
            residuals(mean, cov, predicted),
            predicted,
            [drones.index(drone) for drone in predicted.drone_id],
            self.seen(predicted.drone_id),
            np.array([self._eye.scene.strangers(angle) for angle in _elevations(tracks, view)]),
            self.told_motion(tracks, [*drones, *vague]),
            np.repeat([False, True], [len(drones), len(vague)]),
        )

    def told_motion(self, tracks: Sequence[Track], drones: Sequence[int]) -> Array:
        """(b, n, m): the log ratios by motion, of those that tell how they move, by each turn that is thought of."""
        told = np.array([self.tells_motion(drone) for drone in drones], dtype=bool)
        return np.where(told, self._motion.log_ratios([track.id for track in tracks], drones), 0.0)

    def think_of_turns(self, own: OwnPose | None) -> None:
        """Motion is compared with the observer's north turned by anything, which is as likely as `own` says; None: with
        what it is."""
        self._motion.think_of_turns(own and own.by_turn())

    def seen(self, drones: Iterable[int]) -> Array:
        """(k,) that each has a track while it is in view."""
        return np.array([self._eye.scene.seen(drone) for drone in drones])

    def watch(
        self, alive: Mapping[int, Track], view: ObserverCamera, places: Mapping[int, Announcement]
    ) -> None:
        """All tracks after a scan, named or not, and the latest places: who moves with a drone is likely that drone.
        From here on it is the scan's camera of which everything is asked."""
        self._eye = self._eyes[view.number]
        detected = [
            track
            for track in alive.values()
            if track.camera == view.number
            and track.coasting_since is None
            and (track.status is TrackStatus.CONFIRMED or track.probability >= RIVAL)
        ]
        self._motion.keep(alive)
        for drone, place in places.items():
            before = self._placed.get(drone)
            if before is None or place.t > before.t:
                self._placed[drone] = place
                if not self._says_motion(drone, place.t):
                    self._motion.hear(_said_by(place, before))
        for saying in self._agreed.at(view.observer.t):
            self._motion.hear(saying)
        self._motion.observe(detected, view)
        self.proofs.keep(alive)
        self.proofs.judge(view.observer.t, [track.id for track in detected], self._motion)
        said = {
            drone: place
            for drone, place in places.items()
            if self._says_motion(drone, view.observer.t) and not is_vague(place)
        }
        self.proved_places.follow(alive, said)
        self.proved_places.judge(detected, view, self._motion, self.proofs)

    def weigh(
        self, tracks: Sequence[Track], predicted: Predictions, view: ObserverCamera, own: OwnPose
    ) -> Array:
        """(c + 1, n, k) by likely component of the own pose, −inf outside every gate; in the last the observer may be
        anywhere, and only motion speaks, and where drones were seen. Averages over the scans in which it was asked of
        the same pair."""
        self._off = np.zeros((len(tracks), len(predicted.drone_id)))
        if not tracks:
            self._eye.evidence.forget()
            return np.zeros((len(own.likely) + 1, 0, len(predicted.drone_id)))
        found = _residuals(tracks, predicted.without_heading(view))
        self._eye.evidence.add(view.observer.t, [track.id for track in tracks], predicted.key, found)
        if not found.mean.size:
            return np.zeros((len(own.likely) + 1, *found.mean.shape[:2]))
        parts = shifted(self._eye.evidence.residuals, predicted, view, own.components.only(own.likely))
        self._off = _sigmas_off(parts)
        # What does not depend on the own pose is as good as ever for who is lost.
        places = np.concatenate(
            [
                log_ratios_of_each(parts, self._eye.camera),
                log_ratios(self._eye.evidence.residuals, self._eye.camera)[None],
            ]
        )
        places[-1][:, np.any(predicted.turn, axis=1)] = -np.inf
        of_each = [*own.components.only(own.likely).turns(self._motion.turns), 0]
        motion = self._motion.log_ratios([track.id for track in tracks], predicted.drone_id)[of_each]
        # A drone that may be anywhere is no likelier than others that tell how they move, and have no place either.
        told = np.array([self.tells_motion(drone) for drone in predicted.drone_id], dtype=bool)
        moves = told & (motion > MOVES_AS)
        rivals = told & (moves[-1].any(axis=1, keepdims=True) | moves[-1].any(axis=0))
        places[-1] = np.where(rivals, LOG_ANYWHERE, places[-1])
        every = np.logaddexp(places, np.where(moves, LOG_ASTRAY, -np.inf))
        by_place = every.max(axis=0)
        allowed = np.isfinite(by_place)
        ratios = np.where(allowed, 0.0, -np.inf)
        in_view, elevation = self._in_view(predicted), _elevations(tracks, view)
        here = self._somewhere_in_view()
        for j in self._somewhere(predicted):
            ratios[:, j] += math.log(here / IN_VIEW)
            in_view[j] = here
        for j, drone in enumerate(predicted.drone_id):
            distance, sigma = predicted.distance[j].tolist()
            for i in np.flatnonzero(allowed[:, j]).tolist():
                track = tracks[i]
                weak = track.status is TrackStatus.TENTATIVE
                prior = self._eye.scene.log_ratio(drone, elevation[i], weak=weak, in_view=in_view[j])
                ratios[i, j] += prior - PRIOR.log_ratio
                if weak or track.coasting_since is not None:
                    ratios[i, j] += math.log(max(track.probability, LEAST_EXISTENCE))
                if by_place[i, j] > LOG_ASTRAY:
                    ratios[i, j] += self._spans.log_ratio(
                        drone, track.size, distance, sigma, focal_px=self._box_focal(track)
                    )
        return np.asarray(every + ratios + motion)

    def _says_motion(self, drone_id: int, t: float) -> bool:
        """Whether a drone has said how it moves, and has not fallen silent by t."""
        return t - self._published.get(drone_id, -math.inf) <= SILENT_S

    def tells_motion(self, drone_id: int) -> bool:
        """Whether it is known how the drone moves, and not only where it is once in a while."""
        return drone_id in self._motion.exact

    def trust(self, track_id: int, drone_id: int, t: float) -> float:
        """The highest probability that may be stated: that of a place, until motion has proved it for a while. No
        moment is lucky enough for a code."""
        lasts = self.is_agreed(drone_id) or self.proofs.lasts(track_id, drone_id, t)
        proof = max(self.motion(track_id, drone_id), 0.0) if lasts else 0.0
        return 1.0 / (1.0 + math.exp(-proof) * (1.0 - PLACE_ALONE) / PLACE_ALONE)

    def claimed(self, held: Assignment, match: Match, t: float) -> float:
        """The probability to state of a name whose drone is where it said, or should be."""
        proved = self.is_agreed(held.drone_id) or self.proofs.lasts(held.track_id, held.drone_id, t)
        off = match.off > OFF_SIGMAS and not proved
        return min(match.probability, OFF_ALONE) if off else match.probability

    def sure(self, drone_id: int, probability: float) -> float:
        """How sure a name must be: of a drone that moves as was agreed, as sure as a proof."""
        return max(probability, PROVED) if self.is_agreed(drone_id) else probability

    def is_agreed(self, drone_id: int) -> bool:
        """Whether it is moving as was agreed."""
        return drone_id in self._agreed.begun

    def disproves(self, track_id: int, drone_id: int) -> bool:
        """Whether motion alone says that a track is not a drone, as surely as it ever proves one."""
        surely = math.log((1.0 - PROVED) / PROVED)
        return drone_id in self._motion.exact and self.motion(track_id, drone_id) < surely

    def astray(self, tracks: Sequence[Track], drones: Iterable[int]) -> Predictions:
        """Of drones that should not be in the image, those that tell how they move, where a track moves as any of
        them: they may be anywhere in it."""
        known = [drone for drone in drones if self.tells_motion(drone)]
        return anywhere(known) if self._moves_as(tracks, known).any() else NOBODY

    def _moves_as(self, tracks: Sequence[Track], drones: Sequence[int]) -> NDArray[np.bool_]:
        """(n, k): whether its motion speaks for the drone, so that the drone's place may be wrong."""
        return np.array((self.told_motion(tracks, drones) > MOVES_AS).any(axis=0))

    def _in_view(self, predicted: Predictions) -> list[float]:
        """(k,) that each is in the image if it has not left its place. Of one that has, hardly anything is known, and a
        drone that waits on its pad must be named however long it has waited."""
        k = len(predicted.drone_id)
        mean, cov = np.zeros((k, 4)), np.zeros((k, 4, 4))
        mean[:, ::2] = predicted.pixel
        cov[:, ::2, ::2] = predicted.cov[0]
        found: list[float] = probability_in_view(mean, cov, self._eye.camera).tolist()
        return found

    def _somewhere(self, predicted: Predictions) -> list[int]:
        """The columns of drones of which nobody ever knew where they are."""
        return [
            j
            for j, drone in enumerate(predicted.drone_id)
            if drone in self._placed
            and is_vague(self._placed[drone])
            and predicted.key[j] == key_of(self._placed[drone])
        ]

    def _somewhere_in_view(self) -> float:
        """The probability that such a drone is in view: of a team, more likely so the more of it are."""
        found = sum(drone in self._placed and is_vague(self._placed[drone]) for drone in self._named)
        return (IN_VIEW * TEAMS + found) / (TEAMS + found)

    def near(self, tracks: Sequence[Track], predicted: Predictions) -> NDArray[np.bool_]:
        """(n, k): by where they are now alone, is a track rather the drone than a stranger?"""
        return np.asarray(log_ratios(_residuals(tracks, predicted), self._eye.camera) > 0.0)

    def seen_in(self, row: int) -> int:
        """In how many scans the track of this row was weighed."""
        return self._eye.evidence.seen_in(row)

    def motion(self, track_id: int, drone_id: int) -> float:
        """The part of a log ratio that tells how both moved."""
        return self._motion.log_ratio(track_id, drone_id)

    def moves_as_another(self, track_id: int, drone_id: int) -> bool:
        """Whether the track moves about as another drone that tells how it moves, and is not proved to be elsewhere."""
        least = self.motion(track_id, drone_id) - MOVES_AS
        return any(
            self.motion(track_id, other) > least and self.proofs.track_of(other) in (None, track_id)
            for other in self._motion.exact
            if other != drone_id
        )

    def leaves_only(self, track_id: int, drone_id: int) -> bool:
        """Whether motion proves of all other teammates that they are other tracks."""
        others = self._placed.keys() - {drone_id}
        return all(self.proofs.track_of(other) not in (None, track_id) for other in others)

    def moved_since(self, held: Assignment) -> float:
        """Log ratio: what motion says of an ID since it was last judged."""
        return self.motion(held.track_id, held.drone_id) - held.motion

    def is_contradicted(self, held: Assignment) -> bool:
        """Whether the track has ceased to move as its drone says."""
        return self.moved_since(held) < CONTRADICTED

    def matches(
        self,
        row: int,
        track: Track,
        predicted: Predictions,
        t: float,
        *,
        p_drone: Array,
        p_seen: Array,
        ratios: Array,
    ) -> dict[int, Match]:
        """By drone, what speaks for it as the track of that row. p_drone, ratios (k,) of the track, p_seen (k,) of all
        tracks."""
        return {
            drone: Match(
                min(float(p_drone[j]), self.trust(track.id, drone, t)),
                float(p_seen[j] - p_drone[j]),
                float(ratios[j]),
                float(predicted.distance[j, 0]),
                float(self._off[row, j]),
            )
            for j, drone in enumerate(predicted.drone_id)
        }

    def log_missed(self, drone_id: int) -> float:
        """Log odds for a track that was named when a newcomer had no track yet: the drone would have been missed."""
        return self._eye.scene.log_missed(drone_id)

    def learn(
        self,
        view: ObserverCamera,
        nameless: Sequence[tuple[Track, float]],
        predicted: Predictions,
        p_drone: Array,
        named: Iterable[int],
    ) -> None:
        """What the scene is like, by what the posterior made of a scan. What is in doubt teaches nothing: else every
        doubt would make itself larger. nameless: tracks, and the probability of each
        that it is a stranger; p_drone (n, k); named: the drones whose ID is stated."""
        inside = self._is_inside(predicted).tolist()
        self._named = list(named)
        found = zip(predicted.drone_id, p_drone.sum(axis=0).tolist(), inside, strict=True)
        sure = {drone: float(round(p)) for drone, p, shown in found if shown and min(p, 1.0 - p) < DOUBT}
        seen = dict.fromkeys(self._named, 1.0) | sure
        weak, strong = [], []
        elevations = _elevations([track for track, _ in nameless], view)
        for (track, p_stranger), elevation in zip(nameless, elevations, strict=True):
            if p_stranger < 1.0 - DOUBT:
                continue
            if track.status is TrackStatus.TENTATIVE:
                weak.append((elevation, p_stranger * track.probability))
            else:
                strong.append((elevation, p_stranger))
        self._eye.scene.learn(view.observer.t, strong, weak, seen)

    def misses_somebody(self, predicted: Predictions, p_drone: Array) -> bool:
        """Whether one of them should be in the image or beside it, and is none of its tracks, by p_drone (n, k). Then a
        stranger may be that teammate, whose start or whose idea of it here is wrong by metres."""
        return bool(np.any(self._is_inside(predicted, BESIDE) & (p_drone.sum(axis=0) < 0.5)))

    def _is_inside(self, predicted: Predictions, beside: float = 0.0) -> NDArray[np.bool_]:
        """(k,); beside: how far out counts as well, of the image's size."""
        camera = self._eye.camera
        at, size = camera.framed(predicted.pixel).at, np.array([camera.width, camera.height])
        inside = (np.abs(at / size - 0.5) < 0.5 + beside).all(axis=1)
        reached = camera.within_reach(at) > -beside * (size / (camera.fx, camera.fy)).min()
        return np.asarray(inside & reached)

    def recognise(self, drone_id: int, track: Track, distance: float, probability: float) -> None:
        """The posterior is sure that the track is the drone, which is `distance` m away now."""
        self._spans.learn(drone_id, track.size, distance, probability, focal_px=self._box_focal(track))

    def _box_focal(self, track: Track) -> float:
        """px that a radian is where the track's box is."""
        return float(self._eye.camera.box_per_radian(track.mean[None, ::2])[..., 0].item())

    def hide(self, track_id: int, log_odds: float) -> None:
        """The track was not seen for a while, or met another: how it moved before speaks for no more than this."""
        self._motion.weaken(track_id, log_odds)

    def forget(self, drone_id: int) -> None:
        """Another life of the drone: it may be another airframe."""
        self._spans.forget(drone_id)


def _residuals(tracks: Sequence[Track], predicted: Predictions) -> ReprojectionResiduals:
    """Of the drones' bodies, which are not quite in the middle of their boxes."""
    mean = np.array([track.mean for track in tracks]).reshape(-1, 4)
    return residuals(mean, _of_bodies(tracks), predicted)


def _sigmas_off(found: ReprojectionResiduals) -> Array:
    """(n, k): the least of all headings, of residuals mean (c, n, k, 2) and cov (g, c, n, k, 2, 2), of drones that are
    still where they said."""
    squared, _ = squared_sigmas(found.mean, found.cov[0])
    return np.asarray(np.sqrt(squared.min(axis=0, initial=np.inf)))


def _of_bodies(tracks: Sequence[Track]) -> Array:
    """(n, 4, 4): covariance of the drones' states."""
    cov = np.array([track.cov for track in tracks]).reshape(-1, 4, 4)
    size = np.nan_to_num([track.size for track in tracks], nan=0.0).reshape(-1, 2)
    cov[:, [0, 2], [0, 2]] += (OFF_CENTRE * size) ** 2
    return cov


def _said_by(place: Announcement, before: Announcement | None) -> Saying:
    """How a drone moves, by two places that it said."""
    velocity = np.zeros(3)
    if before is not None and before.boot == place.boot:
        velocity = (place.position - before.position) / (place.t - before.t)
    return Saying(place.drone_id, ("place", place.boot), place.t, place.position, velocity, REPORTED)


def _elevations(tracks: Sequence[Track], view: ObserverCamera) -> list[float]:
    """rad above the horizon."""
    if not tracks:
        return []
    rays = view.rays(np.array([track.mean for track in tracks]).reshape(-1, 4)[:, ::2])
    found: list[float] = np.arcsin(np.clip(-rays[:, 2], -1.0, 1.0)).tolist()
    return found
