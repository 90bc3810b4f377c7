"""How well a team knows who is who, and where: what every observer says, beside the truth, ten times a second.

A `Glance` is what one observer said at one instant, beside the boxes that were true at that instant. Only confirmed
tracks count. They are matched to the true boxes one to one: within max(15 px, half the longer side of the box), pairs
of the last glance first (Bernardin & Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT
metrics", 2008: two drones that cross within a few pixels must not be swapped by the judge), then as many as possible
at the smallest sum of distances, drones in view before hidden ones. A hidden drone counts nowhere; it may only
explain a track, so that a track carried on behind somebody is not called false.

Counted are the glances of [start, end) s, and in them every drone from `GRACE` after it came into view; coming back
starts that second again, and so do a new life of the observer's process and, for a teammate, its announcement.

* correct, wrong, unknown: of those (observer, drone in view, glance). *Wrong* is another ID, "foreign", or the ID on a
  track that is nobody while the drone's own track has no name; *unknown* is a track without a name, or no track (one
  that has drifted off is no wrong name: recall and false tracks tell of it). "Foreign" is a name only `GRACE` after
  the observer had the drone's announcement: before, "none that I know of" is all it can say. A stranger that is
  tracked and not called by a team's ID is correct; one that is not tracked is not counted.
* proved: of the correct names of teammates, the share that motion alone proves as well.
* wrong, at most: the highest probability that was stated with a wrong name, and with a teammate's name on a track that
  is nobody while that teammate is not even ahead. NaN where no name was wrong.
* agreement: of the (instant, drone) about which two observers or more state a name, those where all names are one.
  "Unknown" is no name: it contradicts nobody, and has its price in `correct` already. NaN where nobody could compare.
* time to identify, of an observer: the longest, over the teammates it saw, from the later of "first in view" and
  "announcement known" to the first right name; up to the end where that never came. A stay in view below `GRACE` in
  which no name was given is no chance missed. It is taken from all glances, also those before `start`.
* RMSE: of the matched tracks against the centres of the true boxes, in the pixels of each track's camera. Recall:
  matched, of the drones in view.
* false tracks: each confirmed track once, that in some glance matched no drone; per second of one observer's time.
* switches: a drone in view is matched to another track than last time by the same process, or named by another name
  than its last name. Both at once are one.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from swarmtrack.lab.score.clip_score import match_distances
from swarmtrack.messages import FOREIGN, Array, Identity, TrackList, TrackStatus

GRACE = 1.0  # s that an observer has to recognise who came into view
SCORE_HZ = 10  # of glances
STATED_BINS = 100  # of probabilities that names are stated with
MIN_SWARM_HIT_RADIUS_PX = (
    15.0  # px: a track further off than this, and than half the box, is of something else
)


class NamedTrack(NamedTuple):
    """A confirmed track as its observer published it; centre in undistorted pixels of its camera. proved: its name, by
    motion."""

    id: int
    identity: Identity
    identity_probability: float
    u: float
    v: float
    proved: bool = False
    camera: int = 0


def confirmed_tracks(tracks: TrackList) -> tuple[NamedTrack, ...]:
    """Those that count, of all that an observer tracks."""
    return tuple(
        NamedTrack(
            named.track.id,
            named.identity,
            named.identity_probability,
            float(named.track.mean[0]),
            float(named.track.mean[2]),
            named.proof is not None,
            named.track.camera,
        )
        for named in tracks.tracks
        if named.track.status is TrackStatus.CONFIRMED
    )


@dataclass(frozen=True, slots=True, eq=False)
class Glance:
    """One observer at one instant.

    index: of the instant, equal for all observers (⌊t · SCORE_HZ⌋); t: the exact world time of what it said [s]; boot:
    one life of its process. in_view, hidden: true boxes (4,) [u, v, w, h] undistorted px of the drones that it can see,
    and of those in front of it that it cannot. tracks: None where it said nothing. cameras: of an observer with
    several, the boxes in the pixels of each, of all that are ahead of it; empty: one camera, whose boxes are those two.
    """

    observer: int
    boot: str
    index: int
    t: float
    in_view: Mapping[int, Array]
    hidden: Mapping[int, Array]
    tracks: tuple[NamedTrack, ...] | None
    cameras: tuple[Mapping[int, Array], ...] = ()

    def box(self, drone_id: int, camera: int) -> Array | None:
        """(4,) of a drone in the pixels of a camera; None where it is not ahead of it."""
        if self.cameras:
            return self.cameras[camera].get(drone_id) if camera < len(self.cameras) else None
        return self.in_view.get(drone_id, self.hidden.get(drone_id))


class JudgedTrack(NamedTuple):
    """One track of a glance, and the drone that it is in truth (None: nobody)."""

    track: NamedTrack
    drone_id: int | None
    error_px: float


@dataclass(frozen=True, slots=True)
class SwarmScore:
    """See the module. What divides by zero is NaN; who saw no teammate is in neither mapping."""

    samples: int
    time_to_identify_s: Mapping[int, float]
    correct: float
    proved: float
    wrong: float
    wrong_max_probability: float
    unknown: float
    agreement: float
    rmse_px: Mapping[int, float]
    recall: float
    false_tracks_per_s: float
    switches: int


@dataclass(slots=True)
class _Acquaintance:
    """One drone and one life of an observer. Times are world seconds."""

    in_view_since: float | None = None
    """None while it is not in view."""
    waiting_since: float | None = None
    """In view, from the stay on in which it could have been named."""
    named_at: float | None = None
    track_id: int | None = None
    name: Identity = None

    def arrive(self, t: float) -> None:
        if self.in_view_since is None:
            self.in_view_since = t
            self.waiting_since = t if self.waiting_since is None else self.waiting_since

    def leave(self, t: float, known: float) -> None:
        """known: when the observer had its announcement."""
        if self.in_view_since is None:
            return
        self.in_view_since = None
        if self.named_at is None and self.waiting_since is not None:
            had = t - max(self.waiting_since, known)
            self.waiting_since = self.waiting_since if had >= GRACE else None

    def follow(self, track: NamedTrack | None) -> bool:
        """Take note of the track it is matched to; whether that is a switch."""
        if track is None:
            return False
        other_track = self.track_id not in (None, track.id)
        other_name = None not in (self.name, track.identity) and self.name != track.identity
        self.track_id = track.id
        self.name = self.name if track.identity is None else track.identity
        return other_track or other_name


class SwarmScorer:
    """Takes glances as they come, each observer's in order, and says the score so far at any time."""

    def __init__(self, members: Collection[int], *, start: float, end: float) -> None:
        """members: the team; every other drone is a stranger. Glances at start ≤ t < end [s] are counted."""
        self._members = frozenset(members)
        self._start, self._end = start, end
        self._announced: dict[int, float] = {}
        self._known: dict[tuple[int, str, int], float] = {}
        self._lives: dict[tuple[int, str], dict[int, _Acquaintance]] = {}
        self._pairs: dict[int, dict[int, int]] = {}  # by observer: drone, track id
        self._last_t = -math.inf
        self._glances = self._drones = self._switches = 0
        self._verdicts: Counter[str] = Counter()
        self._named = self._proved = 0
        self._wrong_max_probability = math.nan
        self.stated = np.zeros((STATED_BINS, 2), int)
        """(bins, 2): of names by their probability, bins of equal width: how many, and how many of them right."""
        self._false_tracks: set[tuple[int, str, int]] = set()
        self._squared_errors: dict[int, list[float]] = defaultdict(list)
        self._names: dict[tuple[int, int], list[int | str]] = defaultdict(list)

    def count_between(self, start: float, end: float) -> None:
        """Other limits than those at the beginning, for glances that are still to come."""
        self._start, self._end = start, end

    def announced(self, drone_id: int, t: float) -> None:
        """The drone's announcement was on the air at t: from the first on it is a teammate."""
        self._announced.setdefault(drone_id, t)

    def knows(self, observer: int, boot: str, drone_id: int, t: float) -> None:
        """This life of the observer had the drone's announcement at t; the first time counts."""
        self._known.setdefault((observer, boot, drone_id), t)

    def add(self, glance: Glance) -> list[JudgedTrack]:
        """Take in one glance; returns its tracks with who they are in truth."""
        life = (glance.observer, glance.boot)
        if life not in self._lives:
            self._lives[life] = {}
            self._pairs[glance.observer] = {}
        tracks = {track.id: track for track in glance.tracks or ()}
        pairs = _match(glance, tracks, self._pairs[glance.observer])
        self._pairs[glance.observer] = pairs
        counted = self._start <= glance.t < self._end
        self._last_t = max(self._last_t, glance.t)
        self._glances += counted
        nobody = set(tracks) - set(pairs.values())
        ghosts = {tracks[track_id].identity: tracks[track_id] for track_id in nobody}
        if counted:
            self._note_wrong(*(ghosts[name] for name in self._not_ahead(glance) & ghosts.keys()))
            self._false_tracks |= {(*life, track_id) for track_id in nobody}

        acquaintances = self._lives[life]
        for drone_id in acquaintances.keys() - glance.in_view.keys():
            acquaintances[drone_id].leave(glance.t, self._known_at(life, drone_id))
        for drone_id in glance.in_view:
            track = tracks[pairs[drone_id]] if drone_id in pairs else None
            acquaintance = acquaintances.setdefault(drone_id, _Acquaintance())
            acquaintance.arrive(glance.t)
            if track is not None and track.identity == drone_id and acquaintance.named_at is None:
                acquaintance.named_at = glance.t
            switched = acquaintance.follow(track)
            if counted and self._is_due(drone_id, acquaintance, glance.t):
                self._switches += switched
                named = self._as_heard(life, drone_id, track, glance.t)
                self._count(glance, drone_id, named, ghosts.get(drone_id))
        return _seen(glance, tracks, pairs)

    def score(self) -> SwarmScore:
        """Of everything so far."""
        verdicts = self._verdicts
        samples = verdicts.total()
        compared = [names for names in self._names.values() if len(names) > 1]
        matched = sum(map(len, self._squared_errors.values()))
        times: dict[int, float] = {}
        for observer, seconds in self._times_to_identify():
            times[observer] = max(seconds, times.get(observer, 0.0))
        return SwarmScore(
            samples=samples,
            time_to_identify_s=dict(sorted(times.items())),
            correct=_ratio(verdicts["correct"], samples),
            proved=_ratio(self._proved, self._named),
            wrong=_ratio(verdicts["wrong"], samples),
            wrong_max_probability=self._wrong_max_probability,
            unknown=_ratio(verdicts["unknown"], samples),
            agreement=_ratio(sum(len(set(names)) == 1 for names in compared), len(compared)),
            rmse_px={o: math.sqrt(np.mean(errors)) for o, errors in sorted(self._squared_errors.items())},
            recall=_ratio(matched, self._drones),
            false_tracks_per_s=_ratio(len(self._false_tracks), self._glances / SCORE_HZ),
            switches=self._switches,
        )

    def _is_due(self, drone_id: int, acquaintance: _Acquaintance, t: float) -> bool:
        """Whether the observer had its second to recognise the drone."""
        assert acquaintance.in_view_since is not None
        since = acquaintance.in_view_since
        if drone_id in self._members:
            since = max(since, self._announced.get(drone_id, math.inf))
        return t - since >= GRACE

    def _as_heard(
        self, life: tuple[int, str], drone_id: int, track: NamedTrack | None, t: float
    ) -> NamedTrack | None:
        """The track, without the "foreign" that an observer says of whom it cannot know yet."""
        if track is None or track.identity != FOREIGN or drone_id not in self._members:
            return track
        return track if t - self._known_at(life, drone_id) >= GRACE else track._replace(identity=None)

    def _count(
        self, glance: Glance, drone_id: int, track: NamedTrack | None, ghost: NamedTrack | None
    ) -> None:
        """ghost: a track that is nobody and bears the drone's ID."""
        self._drones += 1
        if track is not None:
            self._squared_errors[glance.observer].append(_distance(glance, drone_id, track) ** 2)
            if track.identity is not None:
                self._names[glance.index, drone_id].append(track.identity)
            if isinstance(track.identity, int):
                stated = min(int(track.identity_probability * STATED_BINS), STATED_BINS - 1)
                self.stated[stated] += 1, track.identity == drone_id
            if track.identity == drone_id:
                self._named += 1
                self._proved += track.proved
        verdict = self._judge(drone_id, track, ghost is not None)
        if verdict is not None:
            self._verdicts[verdict] += 1
        if verdict == "wrong":
            named = track if track is not None and track.identity is not None else ghost
            assert named is not None, "nothing else is wrong"
            self._note_wrong(named)

    def _note_wrong(self, *named: NamedTrack) -> None:
        for track in named:
            highest = np.fmax(self._wrong_max_probability, track.identity_probability)
            self._wrong_max_probability = float(highest)

    def _not_ahead(self, glance: Glance) -> frozenset[int]:
        """Teammates that are behind or beside the observer."""
        others = self._members - {glance.observer}
        return others - glance.in_view.keys() - glance.hidden.keys()

    def _judge(self, drone_id: int, track: NamedTrack | None, ghost: bool) -> str | None:
        if drone_id not in self._members:
            if track is None:
                return None
            return "correct" if track.identity in (FOREIGN, None) else "wrong"
        if track is None:
            return "unknown"
        if track.identity == drone_id:
            return "correct"
        return "wrong" if ghost or track.identity is not None else "unknown"

    def _known_at(self, life: tuple[int, str], drone_id: int) -> float:
        """Where no report said it: as soon as it could be known to anybody."""
        announced = self._announced.get(drone_id, math.inf)
        return self._known.get((*life, drone_id), announced)

    def _times_to_identify(self) -> Iterator[tuple[int, float]]:
        """(observer, seconds) for each acquaintance with a teammate."""
        for life, acquaintances in self._lives.items():
            for drone_id, acquaintance in acquaintances.items():
                if drone_id not in self._members or acquaintance.waiting_since is None:
                    continue
                begin = max(acquaintance.waiting_since, self._known_at(life, drone_id))
                if acquaintance.named_at is not None:
                    yield life[0], max(0.0, acquaintance.named_at - begin)
                elif self._last_t - begin >= GRACE:
                    yield life[0], self._last_t - begin


def _match(glance: Glance, tracks: Mapping[int, NamedTrack], before: Mapping[int, int]) -> dict[int, int]:
    """Which track (its id) is which drone; before: the same of the last glance."""
    boxes = {**glance.in_view, **glance.hidden}
    pairs = {
        drone_id: track_id
        for drone_id, track_id in before.items()
        if drone_id in boxes and track_id in tracks and _fits(glance, drone_id, tracks[track_id])
    }
    for candidates in (glance.in_view, glance.hidden):
        drones = [drone_id for drone_id in candidates if drone_id not in pairs]
        free = [track for track in tracks.values() if track.id not in pairs.values()]
        pairs.update(_nearest(glance, drones, free))
    return pairs


def _nearest(
    glance: Glance, drones: Sequence[int], tracks: Sequence[NamedTrack]
) -> Iterator[tuple[int, int]]:
    """(drone, track id): as many as possible, then the smallest sum of distances."""
    if not drones or not tracks:
        return
    distance = np.array([[_distance(glance, drone_id, track) for track in tracks] for drone_id in drones])
    radius = np.array([[_radius(glance, drone_id, track) for track in tracks] for drone_id in drones])
    rows, columns, _ = match_distances(distance, radius)
    for row, column in zip(rows, columns, strict=True):
        yield drones[row], tracks[column].id


def _fits(glance: Glance, drone_id: int, track: NamedTrack) -> bool:
    return _distance(glance, drone_id, track) <= _radius(glance, drone_id, track)


def _distance(glance: Glance, drone_id: int, track: NamedTrack) -> float:
    """px, in the track's camera; inf where the drone is not ahead of that."""
    box = glance.box(drone_id, track.camera)
    return math.inf if box is None else math.hypot(track.u - box[0], track.v - box[1])


def _radius(glance: Glance, drone_id: int, track: NamedTrack) -> float:
    """Of a hit, px."""
    box = glance.box(drone_id, track.camera)
    return (
        MIN_SWARM_HIT_RADIUS_PX
        if box is None
        else max(MIN_SWARM_HIT_RADIUS_PX, 0.5 * float(max(box[2], box[3])))
    )


def _seen(glance: Glance, tracks: Mapping[int, NamedTrack], pairs: Mapping[int, int]) -> list[JudgedTrack]:
    drone_of = {track_id: drone_id for drone_id, track_id in pairs.items()}
    seen = []
    for track in tracks.values():
        drone_id = drone_of.get(track.id)
        error = math.nan if drone_id is None else _distance(glance, drone_id, track)
        seen.append(JudgedTrack(track, drone_id, error))
    return seen


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else math.nan
