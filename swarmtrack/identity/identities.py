"""Who is who: gives drones' IDs to tracks, keeps them, and asks again when something changed.

Theory of operation. An announced pose tells where a drone *was*; a track that was given its ID carries it from there,
so an ID is kept until its track ends. Every scan, what is undecided (tracks without an ID, drones without a track) is
matched anew: the posterior over all one-to-one matchings, of residuals averaged over a short window, gives an ID
where it is likely enough, and "unknown" else. A drone whose track ended is expected where it was seen last, moving
on.

What speaks against an ID opens its case again, with the past as prior: a new announcement, another track that fits it
better, observers who see that drone elsewhere. A case is closed by the same posterior. A track that no drone explains
for a while is foreign. While two processes speak as one drone, that ID is given to nobody.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.evidence import Evidence
from swarmtrack.identity.posterior import LOG_ANYWHERE, log_ratios, nearest, residuals
from swarmtrack.identity.reprojection import LastSeen, Predictions, View, joined, reproject, retrace
from swarmtrack.messages import FOREIGN, Announcement, Array, IdentifiedTrack, Identity, Track, TrackStatus
from swarmtrack.motion.ego import TeamPose
from swarmtrack.tracking.marginals import matching_marginals

HELD_LOG_ODDS = math.log(1e3)  # of an ID that was given: how rarely a track jumps from one drone to another
FORGET_S = 30.0  # s after which it does not matter where somebody was last seen
AHEAD_S = 0.1  # s: over which a track's velocity becomes a turn of its ray
ASK_AFTER_S = 1.0  # s that a track is nameless before its candidates are asked for their poses
ASK_AGAIN_S = 3.0  # s between two questions to one drone, doubled with each


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentityParameters:
    """profile `paper`: Algorithm 1 as printed, in one shot; `default`: the posterior, with "unknown"."""

    profile: str = "default"
    probability: float = 0.95
    """An ID is stated only above it."""
    scans: int = 3
    """A track must have been seen in so many."""
    window_s: float = 0.5
    """s over which residuals are averaged."""
    foreign_s: float = 3.0
    """s after which a track that nothing explains is foreign."""
    drift_speed: float = 0.5
    """m/s: how fast an announced drone that has left its pose may be moving."""
    stay_s: float = 30.0
    """s after which half of the announced drones have left their pose: they wait for take-off."""
    turn_rate: float = 0.1
    """rad/s: how far the bearing of a drone out of sight may leave its course, for each second."""

    def __post_init__(self) -> None:
        if self.profile not in ("default", "paper"):
            raise ValueError(f"identity.profile: found {self.profile!r}, expected one of default, paper")
        if not 0.5 <= self.probability < 1.0:
            raise ValueError(
                f"identity.probability: found {self.probability!r}, expected 0.5 or more, below 1"
            )
        if self.scans < 1:
            raise ValueError(f"identity.scans: found {self.scans!r}, expected 1 or more")
        if not self.drift_speed >= 0.0:
            raise ValueError(f"identity.drift_speed: found {self.drift_speed!r}, expected 0 or more")
        for name in ("window_s", "foreign_s", "stay_s", "turn_rate"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"identity.{name}: found {getattr(self, name)!r}, expected a number above 0")


@dataclass(slots=True)
class Given:
    """An ID that a track holds. open: its case is being tried again, since `scans_open` scans, with log odds `held` in its favour; seen: where the drone
    was when it was last detected."""

    drone_id: int
    probability: float
    open: bool = False
    scans_open: int = 0
    held: float = HELD_LOG_ODDS
    seen: LastSeen | None = None


@dataclass(slots=True)
class _Stranger:
    """A nameless track. unexplained_since [s]: since when no drone is likely to be it, with probability p_none;
    asked: whether those who have a name were asked for their poses because of it."""

    first_t: float
    unexplained_since: float | None = None
    p_none: float = 0.0
    foreign: bool = False
    asked: bool = False


@dataclass(slots=True)
class _Question:
    """When a drone was last asked for its pose, and how long to wait with the next time."""

    asked_t: float
    wait_s: float = field(default=ASK_AGAIN_S)


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
        self._suspended: set[int] = set()
        self._given: dict[int, Given] = {}
        self._nameless: dict[int, _Stranger] = {}
        self._last_seen: dict[int, LastSeen] = {}
        self._evidence = Evidence(parameters.window_s)
        self._questions: dict[int, _Question] = {}
        self._wanted: set[int] = set()
        self._view: View | None = None

    @property
    def announced(self) -> dict[int, Announcement]:
        """The latest announcement of every teammate."""
        return dict(self._announced)

    @property
    def given(self) -> dict[int, Given]:
        """The IDs that tracks hold, by track ID."""
        return self._given

    def announce(self, announcement: Announcement) -> bool:
        """Take in a teammate's pose. Returns False for our own ID, or for one that is not newer."""
        drone = announcement.drone_id
        known = self._announced.get(drone)
        repeated = known and known.boot == announcement.boot and known.sequence >= announcement.sequence
        if drone == self._drone_id or drone in self._suspended or repeated:
            return False
        self._announced[drone] = announcement
        self._unannounced.discard(drone)
        seen = self._last_seen.get(drone)
        if seen is not None and seen.t < announcement.t:
            del self._last_seen[drone]
        if known is not None:
            self._reopen(drone, HELD_LOG_ODDS if known.boot == announcement.boot else 0.0)
        return True

    def arrived(self, drone_id: int) -> None:
        """A teammate is alive; until it announces itself it may be any track."""
        if drone_id != self._drone_id and drone_id not in self._announced:
            self._unannounced.add(drone_id)

    def departed(self, drone_id: int) -> None:
        """A teammate's process is gone; the drone is still where it is, and so is its pose."""
        self._unannounced.discard(drone_id)

    def suspend(self, drone_id: int) -> None:
        """Two processes speak as this drone: nobody can tell which pose is its own."""
        self._suspended.add(drone_id)
        self._announced.pop(drone_id, None)
        self.withdraw(drone_id)

    def resume(self, drone_id: int) -> None:
        """One process speaks as this drone again; its pose is yet to be heard."""
        self._suspended.discard(drone_id)
        self._unannounced.add(drone_id)

    def withdraw(self, drone_id: int) -> None:
        """No track is this drone any more, nor is it where it was last seen."""
        self._last_seen.pop(drone_id, None)
        self._given = {track: given for track, given in self._given.items() if given.drone_id != drone_id}

    def ask_for(self, drone_id: int) -> None:
        """Its pose is wanted anew."""
        self._wanted.add(drone_id)

    def observe(self, tracks: Iterable[Track], observer: TeamPose) -> None:
        """Look at the tracks of a scan, with this drone's own pose at its exposure."""
        alive = {track.id: track for track in tracks}
        view = self._view = View.of(observer, self._camera, self._body_from_camera)
        self._bury(alive, view)
        undecided = [
            track
            for id, track in alive.items()
            if (id in self._given and self._given[id].open)
            or (id not in self._given and track.status is TrackStatus.CONFIRMED)
        ]
        self._nameless = {
            track.id: self._nameless.get(track.id) or _Stranger(observer.t)
            for track in undecided
            if track.id not in self._given
        }
        predicted = self._predict(view)
        if self._parameters.profile == "paper":
            self._give_nearest(undecided, predicted)
        else:
            self._give_by_posterior(undecided, predicted, observer.t)
        self._ask(predicted, observer.t)

    def label(self, tracks: Iterable[Track]) -> tuple[IdentifiedTrack, ...]:
        """The same tracks, with who they are."""
        return tuple(IdentifiedTrack(track, *self._name(track.id)) for track in tracks)

    def sightings(self, t: float) -> list[tuple[LastSeen, float]]:
        """The rays to identified drones that were detected in the scan of t, and how surely it is they."""
        held = self._given.values()
        return [(g.seen, g.probability) for g in held if g.seen is not None and g.seen.t == t and not g.open]

    def take_wanted(self) -> tuple[int, ...]:
        """The drones whose pose is wanted anew; each is told once."""
        wanted, self._wanted = tuple(self._wanted), set()
        return wanted

    def _reopen(self, drone_id: int, held: float) -> None:
        """There is news of the drone that a track was named after: try whether it still is, with log odds `held`."""
        for given in self._given.values():
            if given.drone_id == drone_id:
                given.open, given.scans_open, given.held = True, 0, held

    def _name(self, track_id: int) -> tuple[Identity, float]:
        given = self._given.get(track_id)
        if given is not None:
            return given.drone_id, given.probability
        stranger = self._nameless.get(track_id)
        if stranger is not None and stranger.foreign:
            return FOREIGN, stranger.p_none
        return None, 0.0

    def _bury(self, alive: dict[int, Track], view: View) -> None:
        """Take the IDs from tracks that ended; remember where their drones were seen last."""
        ended = [id for id in self._given if id not in alive]
        for id in ended:
            given = self._given.pop(id)
            if given.seen is not None and not given.open:
                self._last_seen[given.drone_id] = given.seen
        detected = [id for id in self._given if alive[id].coasting_since is None]
        rays = _seen([(self._given[id].drone_id, alive[id]) for id in detected], view)
        for id, seen in zip(detected, rays, strict=True):
            self._given[id].seen = seen

    def _predict(self, view: View) -> Predictions:
        """Where the drones that no track has for certain should be."""
        p, t = self._parameters, view.observer.t
        taken = {given.drone_id for given in self._given.values() if not given.open} | self._suspended
        self._last_seen = {
            drone: seen
            for drone, seen in self._last_seen.items()
            if t - seen.t < FORGET_S and drone not in taken
        }
        free = [a for drone, a in self._announced.items() if drone not in taken]
        waiting = [a for a in free if a.drone_id not in self._last_seen]
        by_pose = reproject(waiting, view, drift_speed=p.drift_speed, stay_s=p.stay_s)
        if not self._last_seen:
            return by_pose
        return joined(by_pose, retrace(list(self._last_seen.values()), view, turn_rate=p.turn_rate))

    def _give_nearest(self, tracks: Sequence[Track], predicted: Predictions) -> None:
        mean = np.array([track.mean for track in tracks]).reshape(-1, 4)
        for row, drone in nearest(mean, predicted).items():
            self._given[tracks[row].id] = Given(drone, 1.0)

    def _give_by_posterior(self, tracks: Sequence[Track], predicted: Predictions, t: float) -> None:
        mean = np.array([track.mean for track in tracks]).reshape(-1, 4)
        cov = np.array([track.cov for track in tracks]).reshape(-1, 4, 4)
        self._evidence.add(t, [track.id for track in tracks], predicted.key, residuals(mean, cov, predicted))
        if not tracks:
            return
        probability = matching_marginals(self._log_ratios(tracks, predicted))
        stated = probability[:, : len(predicted.drone_id)]
        for i, track in enumerate(tracks):
            self._judge(track.id, stated[i], predicted.drone_id, self._evidence.scans[i])
        for i, track in enumerate(tracks):
            if track.id not in self._given:
                self._mistrust(track.id, 1.0 - float(probability[i].sum()), t)

    def _log_ratios(self, tracks: Sequence[Track], predicted: Predictions) -> Array:
        """(n, k + u): of the predicted drones, then of those that may be anywhere."""
        ratios = log_ratios(self._evidence.residuals, self._camera)
        for i, track in enumerate(tracks):
            given = self._given.get(track.id)
            if given is not None and given.drone_id in predicted.drone_id:
                ratios[i, predicted.drone_id.index(given.drone_id)] += given.held
        unlocated = len(self._unannounced | self._suspended)
        anywhere = np.full((len(tracks), unlocated), LOG_ANYWHERE)
        return np.concatenate([ratios, anywhere], axis=1)

    def _judge(self, track_id: int, probability: Array, drones: list[int], scans: Array) -> None:
        """Give, confirm or take back the ID of one track, whose drone it is with probability (k,)."""
        given = self._given.get(track_id)
        if given is not None:
            given.scans_open += 1
            if given.scans_open < self._parameters.scans:
                return
            held = float(probability[drones.index(given.drone_id)]) if given.drone_id in drones else None
            if held is None or held >= 0.5:  # whom the camera cannot see, it cannot judge
                given.open = False
                given.probability = given.probability if held is None else held
                return
            del self._given[track_id]
            self._nameless[track_id] = _Stranger(self._view.observer.t if self._view else 0.0)
        if not drones:
            return
        best = int(probability.argmax())
        if probability[best] >= self._parameters.probability and scans[best] >= self._parameters.scans:
            self._give(track_id, drones[best], float(probability[best]))

    def _give(self, track_id: int, drone_id: int, probability: float) -> None:
        """Whoever had this ID loses it: of two tracks of one drone the likelier one is it."""
        self.withdraw(drone_id)
        self._given[track_id] = Given(drone_id, probability)
        self._nameless.pop(track_id, None)
        self._questions.pop(drone_id, None)

    def _mistrust(self, track_id: int, p_none: float, t: float) -> None:
        """Count how long nothing has explained a track; a first time, ask whether all names are where they belong."""
        stranger = self._nameless.setdefault(track_id, _Stranger(t))
        stranger.p_none = p_none
        if p_none < self._parameters.probability:
            stranger.unexplained_since, stranger.foreign = None, False
        elif stranger.unexplained_since is not None:
            stranger.foreign = t - stranger.unexplained_since >= self._parameters.foreign_s
        else:
            stranger.unexplained_since = t
            if not stranger.asked:
                self._wanted |= {
                    given.drone_id
                    for given in self._given.values()
                    if t - self._announced[given.drone_id].t > ASK_AGAIN_S
                }
                stranger.asked = True

    def _ask(self, predicted: Predictions, t: float) -> None:
        """Ask the drones that a track, nameless for a while, may be."""
        waiting = [s for s in self._nameless.values() if s.unexplained_since is None]
        if not any(t - stranger.first_t > ASK_AFTER_S for stranger in waiting):
            return
        for drone in predicted.drone_id:
            question = self._questions.get(drone)
            fresh = t - self._announced[drone].t < ASK_AFTER_S
            if fresh or (question is not None and t - question.asked_t < question.wait_s):
                continue
            self._questions[drone] = _Question(t, 2.0 * question.wait_s if question else ASK_AGAIN_S)
            self._wanted.add(drone)


def _seen(named: Sequence[tuple[int, Track]], view: View) -> list[LastSeen]:
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
