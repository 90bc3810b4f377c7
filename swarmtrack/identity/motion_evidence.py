"""Does a track move as its drone says that it does, as something else would, or does it stand?

A drone that says how it moves can be told from another by the ray on which it is seen, wherever it started: a proof
that no wrong pad and no wrong compass spoils. Whenever something is said (`Saying`), the rays of the scan of that time
are compared with what these models foretell, by the filters of `ray_filters.py`:

* the track is the drone, and moves as it says;
* it is a stranger that hovers and sways, or one that flies;
* it is a thing that stands, near or far: its ray turns by the observer's own way alone.

The last three are "none of them", and as good models as the first: else that would win or lose for the wrong reason.
The log ratio of the two is what motion says of a pair. A team that hovers without a sway moves by no more than the
noise, and then the drone and the standing thing foretell the same: nothing is learned, however long it lasts.

An observer that doubts its heading has its rays compared as if its north were turned by each of `TURNS`: then a pair
has one log ratio for each, and whoever matches pairs weighs the turns, which all pairs have in common.

Three kinds of sources say how a drone moves, and `Trust` is how closely it then flies: its own messages, the places in
its reports, a code or plan that all know. While one of them speaks, those that tell less are not heard. What comes
late counts at its own time: rays are kept for `MEMORY_S`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Container, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.identity.ray_filters import ATTITUDE_WHITE, Looks, Model, RayFilters
from swarmtrack.identity.reprojection import NEAREST, ObserverCamera
from swarmtrack.identity.spans import SPAN, SPAN_SIGMA
from swarmtrack.messages import Array, Track

# s of scans in which the time of a saying is looked up, and how far from it a scan may be.
MEMORY_S, SIMULTANEOUS_S = 2.0, 0.12
# s: less lies not between two sayings of a drone that are compared, and more is too long.
SHORTEST_S, LONGEST_S = 0.11, 5.0
# s and rad: a filter begins again after so long, or so far from the ray that it began with.
LIFE_S, REACH = 20.0, 0.5
# s: a source that has said nothing for so long speaks no more.
SILENT_S = 3.0
# m: a displacement that leaves its own speed by so much was set, not flown.
JUMP = 1.0
# px: of a track's centre, beside what its tracker knows.
CENTRE_SIGMA_PX = 1.0
# m and rad/s: how a stranger sways, and how one flies; it may be anywhere around the first.
SWAY, FLIGHT = (0.15, 1.5), (2.0, 0.5)
# 1/m and one sigma: how far things are that stand near, and far.
STANDS = ((0.08, 0.05), (0.0, 0.02))
# 1/m: of a track without a size.
KAPPA = 0.1
# Of a distance by a place that was said, relative; and of a place, m.
PLACED_SHARE, PLACED_M = 0.2, 2.0
# s before it was found: a step of the own heading may be so old, and what was compared since is worth nothing.
STEP_FOUND_S = 1.0
# Sayings that wait for their scan; who is told more is flooded.
MANY = 256
# Log odds that are remembered: a track may after all have changed over to another target.
MOST = math.log(1e6)
_MODELS = 5
_NONE = math.log(1.0 / (_MODELS - 1))
# rad, clockwise seen from above: by how much the observer's north may be turned, each within the filters' own sigma.
TURNS = np.radians([0.0, 36.0, -36.0, 72.0, -72.0, 108.0, -108.0, 144.0, -144.0, 180.0])


class Trust(NamedTuple):
    """How closely a drone flies what a source says: smoothly off by `wander` m, at `bandwidth` rad/s, and by `white` m
    from one saying to the next; clock [s]: by how much its time may be off. most: the log odds that it may give, either
    way. placed: its displacement is a place in the team frame, which tells its distance too. tried: as likely as not it
    flies nothing of the kind, so that what speaks against it says little."""

    wander: float
    bandwidth: float
    white: float
    clock: float
    most: float
    placed: bool = False
    tried: bool = False


PUBLISHED = Trust(wander=0.03, bandwidth=0.5, white=0.02, clock=0.1, most=MOST)
REPORTED = Trust(wander=0.15, bandwidth=0.5, white=0.1, clock=0.1, most=math.log(1e3), placed=True)
# Two codes of a large team may both be far likelier than a stranger: which of them, only uncut odds tell.
CODED = Trust(wander=0.1, bandwidth=1.5, white=0.02, clock=0.1, most=5.0 * MOST)
TRIED = CODED._replace(tried=True)
PLANNED = Trust(wander=0.3, bandwidth=1.0, white=0.02, clock=0.25, most=math.log(1e3))


class Saying(NamedTuple):
    """Where a drone is at t, from wherever its source counts: displacement (3,) m and velocity (3,) m/s in the team
    frame's axes. source: names the place from which it is counted, such as a boot; of two nothing can be compared."""

    drone_id: int
    source: tuple[object, ...]
    t: float
    displacement: Array
    velocity: Array
    trust: Trust


class _Scan:
    """Of one exposure: the tracks that were detected, and from where; their rays once somebody asks."""

    def __init__(self, tracks: Sequence[Track], view: ObserverCamera) -> None:
        self.t = view.observer.t
        self.camera = view.team_from_camera.position
        self.row = {track.id: row for row, track in enumerate(tracks)}
        self._tracks = tracks
        self._view = view

    @cached_property
    def rays(self) -> Array:
        """(n, 3): unit vectors, team frame."""
        return self._view.rays(self._pixels)

    @cached_property
    def _pixels(self) -> Array:
        """(n, 2) px, undistorted."""
        return np.array([track.mean[::2] for track in self._tracks]).reshape(-1, 2)

    @cached_property
    def noise(self) -> Array:
        """(n,) rad²: of each ray."""
        own = np.array([track.cov[0, 0] + track.cov[2, 2] for track in self._tracks]) / 2.0
        focal = self._view.camera.per_radian(self._pixels)[..., 0]
        return np.asarray((own + CENTRE_SIGMA_PX**2) / focal**2 + ATTITUDE_WHITE**2)

    @cached_property
    def kappa(self) -> Array:
        """(n,) 1/m: one over the distance of a drone that looks as large."""
        focal = self._view.camera.box_per_radian(self._pixels)[..., 0]
        side = np.array([track.size.max() for track in self._tracks]) / (focal * SPAN)
        return np.clip(np.where(side > 0.0, side, KAPPA), 1e-3, 1.0 / NEAREST)


class _Snapshot(NamedTuple):
    """What was known at t [s]: the row of each pair, and the log likelihoods (rows, models)."""

    t: float
    row: dict[tuple[int, int], int]
    log: Array


class MotionEvidence:
    """Told of every scan, and of all that is said of how drones move."""

    def __init__(self) -> None:
        self._scans: deque[_Scan] = deque()
        self._waiting: list[Saying] = []
        self._last: dict[int, Saying] = {}
        self._filters = RayFilters([0.0] * _MODELS + TURNS[1:].tolist(), used=_MODELS)
        self._free: list[int] = list(range(self._filters.rows))
        self._row: dict[tuple[int, int], int] = {}
        self._begun: dict[tuple[int, int], float] = {}
        """s: when the filters of a pair began; not there: they are to begin."""
        self._ratio: dict[tuple[int, int], Array] = {}
        """By each turn that is thought of."""
        self._log_turned = np.zeros(1)
        self._stepped_t = -math.inf
        """s: no ray from before this is compared any more."""
        self._before: deque[_Snapshot] = deque()
        """Before each comparison of the last `STEP_FOUND_S`, s."""

    @property
    def turns(self) -> int:
        """How many of `TURNS` are thought of: the first, or all."""
        return len(self._log_turned)

    @property
    def turn_weight(self) -> Array:
        """(turns,): how likely each is."""
        return np.exp(self._log_turned)

    def think_of_turns(self, weight: Array | None) -> None:
        """weight (turns,): how likely the observer's north is turned by each; None: it is not. What was seen before
        anybody thought of it tells nothing of it."""
        if weight is not None and self.turns == 1:
            self._filters.used = _MODELS + len(TURNS) - 1
            self._filters.log[:, _MODELS:] = _of_none(self._filters.log)[:, None]
            self._ratio = {pair: _ratios(self._filters.log[row]) for pair, row in self._row.items()}
            self._begun.clear()
            self._before.clear()
        elif weight is None and self.turns > 1:
            self._filters.used = _MODELS
            self._ratio = {pair: ratio[:1] for pair, ratio in self._ratio.items()}
        self._log_turned = np.zeros(1) if weight is None else np.log(np.maximum(weight, 1e-12))

    @property
    def pairs(self) -> set[tuple[int, int]]:
        """Of tracks and drones, those that were compared."""
        return set(self._row)

    @property
    def exact(self) -> tuple[int, ...]:
        """The drones whose motion is known well enough to prove a name."""
        return tuple(drone for drone, last in self._last.items() if last.trust.most >= MOST)

    def hear(self, saying: Saying) -> None:
        """It counts with the first scan that is no older."""
        if len(self._waiting) < MANY:
            self._waiting.append(saying)

    def observe(self, tracks: Sequence[Track], view: ObserverCamera) -> None:
        """tracks: those that are detected."""
        self._scans.append(_Scan(tracks, view))
        now = self._scans[-1].t
        while self._scans[0].t < now - MEMORY_S:
            self._scans.popleft()
        due = sorted((s for s in self._waiting if s.t <= now), key=lambda s: s.t)
        self._waiting = [s for s in self._waiting if now < s.t < now + MEMORY_S]
        while due:
            # Each drone once: a filter takes one look after the other.
            first = {saying.drone_id: saying for saying in reversed(due)}
            self._compare(list(first.values()))
            due = [saying for saying in due if saying is not first[saying.drone_id]]

    def keep(self, tracks: Container[int]) -> None:
        """Tracks that have ended are forgotten."""
        for pair in [pair for pair in self._row if pair[0] not in tracks]:
            self._free.append(self._row.pop(pair))
            self._begun.pop(pair, None)
            self._ratio.pop(pair, None)

    def weaken(self, track_id: int, log_odds: float) -> None:
        """It was not seen for a while, or met another: what it did before speaks for no more than this, nor than half
        of what it did, and it may not be where it was."""
        for scan in self._scans:
            scan.row.pop(track_id, None)
        for pair, row in self._row.items():
            if pair[0] == track_id:
                log = self._filters.log[row, : self._filters.used]
                self._filters.log[row, : self._filters.used] = np.maximum(0.5 * (log - log.max()), -log_odds)
                self._begun.pop(pair, None)
                self._ratio[pair] = self._ratios(row)

    def begin_again(self, t: float) -> None:
        """By t the own heading has stepped: rays before cannot be compared with those since."""
        before = next((snapshot for snapshot in self._before if snapshot.t > t - STEP_FOUND_S), None)
        if before is not None:
            for pair, row in self._row.items():
                self._filters.log[row] = before.log[before.row[pair]] if pair in before.row else 0.0
                self._ratio[pair] = self._ratios(row)
        self._begun.clear()
        self._before.clear()
        self._stepped_t = t

    def log_ratio(self, track_id: int, drone_id: int) -> float:
        """How much more likely the track is the drone than another thing, by how both moved."""
        pair = track_id, drone_id
        if pair not in self._ratio:
            return 0.0
        if self.turns == 1:
            return self._log_ratio_unturned(pair)
        by_turn = self.log_ratios([track_id], [drone_id])[:, 0, 0]
        is_it = np.logaddexp.reduce(self._log_turned - np.logaddexp(0.0, -by_turn))
        is_not = np.logaddexp.reduce(self._log_turned - np.logaddexp(0.0, by_turn))
        return float(is_it - is_not)

    def _log_ratio_unturned(self, pair: tuple[int, int]) -> float:
        """What `log_ratios` says of this pair alone, of one turn, in plain numbers: it is asked of every name, twice
        per scan."""
        ratio, last = float(self._ratio[pair][0]), self._last.get(pair[1])
        if last is None:
            return ratio
        if last.trust.tried:
            ratio = float(_if_flown(ratio))
        return max(min(ratio, last.trust.most), -last.trust.most)

    def log_ratios(self, tracks: Sequence[int], drones: Sequence[int]) -> Array:
        """(turns, n, m): the same of all pairs, if the observer's north is turned by each."""
        nothing = np.zeros(self.turns)
        found = [[self._ratio.get((track, drone), nothing) for drone in drones] for track in tracks]
        ratio = np.reshape(found, (len(tracks), len(drones), self.turns))
        trust = [self._last[drone].trust if drone in self._last else None for drone in drones]
        most = np.array([math.inf if one is None else one.most for one in trust])
        tried = np.array([one is not None and one.tried for one in trust], dtype=bool)
        if tried.any():
            ratio[:, tried] = _if_flown(ratio[:, tried])
        # What is more than it may give is taken off all turns alike: which of them is likelier stays what it is.
        over = np.maximum((ratio.max(axis=2) - most).max(axis=1, initial=0.0, keepdims=True), 0.0)
        return np.moveaxis(np.maximum(ratio - over[..., None], -most[:, None]), 2, 0)

    def _compare(self, sayings: Sequence[Saying]) -> None:
        """sayings: one of each drone, in order. The rays of the scan nearest to each are weighed by all models."""
        self._remember(self._scans[-1].t)
        pairs, looks, begins = [], [], []
        for saying in sayings:
            before = self._last.get(saying.drone_id)
            if before is not None and not _is_news(before, saying):
                continue
            scan = min(self._scans, key=lambda scan: abs(scan.t - saying.t))
            if abs(scan.t - saying.t) > SIMULTANEOUS_S or scan.t <= self._stepped_t:
                continue
            self._last[saying.drone_id] = saying
            if before is not None and not follows(before, saying):
                self._begin_again(before)
            here = [(track, saying.drone_id) for track in scan.row]
            pairs += here
            looks += [_Look(saying, scan, row) for row in scan.row.values()]
            begins += [scan.t - self._begun.get(pair, -math.inf) > LIFE_S for pair in here]
        if pairs:
            self._weigh(pairs, looks, np.array(begins))

    def _remember(self, now: float) -> None:
        while self._before and self._before[0].t <= now - STEP_FOUND_S:
            self._before.popleft()
        self._before.append(_Snapshot(now, dict(self._row), self._filters.log.copy()))

    def _begin_again(self, last: Saying) -> None:
        """Where a drone is counted from has changed since `last`, also for the tracks that this scan lacks."""
        for pair, row in self._row.items():
            if pair[1] != last.drone_id:
                continue
            self._begun.pop(pair, None)
            if last.trust.tried:
                turned = [0, *range(_MODELS, self._filters.used)]
                self._filters.log[row, turned] += _if_flown(self._ratio[pair]) - self._ratio[pair]
                self._ratio[pair] = self._ratios(row)

    def _weigh(
        self, pairs: Sequence[tuple[int, int]], found: Sequence[_Look], begins: NDArray[np.bool_]
    ) -> None:
        rows = np.array([self._row_of(pair) for pair in pairs])
        looks = _looks(found, self.turns)
        later = looks.t > self._filters.t[rows]
        begins |= ~self._filters.reaches(rows, looks.ray, REACH)
        goes_on, starts = np.flatnonzero(later & ~begins), np.flatnonzero(begins)
        if goes_on.size:
            self._filters.look(rows[goes_on], looks.only(goes_on))
        if starts.size:
            self._filters.begin(
                rows[starts], looks.only(starts), _models([found[i] for i in starts.tolist()], self.turns)
            )
            self._begun |= {pairs[i]: float(looks.t[i]) for i in starts.tolist()}
        log = self._filters.log[rows, : self._filters.used]
        most = np.array([[max(look.saying.trust.most, MOST)] for look in found])
        log = np.maximum(log - log.max(axis=1, keepdims=True), -2.0 * most)
        self._filters.log[rows, : self._filters.used] = log
        self._ratio |= dict(zip(pairs, _ratios(log), strict=True))

    def _ratios(self, row: int) -> Array:
        return _ratios(self._filters.log[row, : self._filters.used])

    def _row_of(self, pair: tuple[int, int]) -> int:
        row = self._row.get(pair)
        if row is None:
            if not self._free:
                self._free = list(range(self._filters.rows, 2 * self._filters.rows))
                self._filters.grow()
            row = self._row[pair] = self._free.pop()
            self._filters.log[row] = 0.0
        return row


class _Look(NamedTuple):
    """What was said of a drone, and the track of this row in the scan of that time."""

    saying: Saying
    scan: _Scan
    row: int


def _is_news(before: Saying, saying: Saying) -> bool:
    """Whether it can be compared with what a drone said before, or is by who tells more, or after a silence."""
    since = saying.t - before.t
    if saying.source == before.source:
        return since >= SHORTEST_S
    return saying.trust.wander <= before.trust.wander or since >= SILENT_S


def follows(before: Saying, saying: Saying) -> bool:
    """Whether a drone may have flown from the one to the other."""
    dt = saying.t - before.t
    if saying.source != before.source or dt > LONGEST_S:
        return False
    flown = 0.5 * dt * (before.velocity + saying.velocity)
    off = float(np.linalg.norm(saying.displacement - before.displacement - flown))
    return off < JUMP * max(dt, 1.0)


def _looks(found: Sequence[_Look], turns: int) -> Looks:
    """turns: how many are thought of."""
    said = np.array(
        [look.saying.displacement + (look.scan.t - look.saying.t) * look.saying.velocity for look in found]
    )
    white = np.array([look.saying.trust.white * _inverse_distance(look)[0] for look in found])
    foretold, speed = np.zeros((2, len(found), _MODELS + turns - 1, 3))
    it = [0, *range(_MODELS, _MODELS + turns - 1)]
    foretold[:, it] = said[:, None]
    speed[:, it] = np.array([look.saying.velocity for look in found])[:, None]
    return Looks(
        np.array([look.scan.t for look in found]),
        np.array([look.scan.rays[look.row] for look in found]),
        np.array([look.scan.camera for look in found]),
        np.array([look.scan.noise[look.row] for look in found]) + white**2,
        foretold,
        speed,
    )


def _models(found: Sequence[_Look], turns: int) -> Model:
    """The drone as it says, one that sways, one that flies, and things that stand: none of them more exact than the
    first, which would make them win by that alone. Then the drone again, by each further turn."""
    kappa = np.array([look.scan.kappa[look.row] for look in found])[:, None]
    its, its_share = np.array([_inverse_distance(look) for look in found]).T[..., None]
    trust = np.array([look.saying.trust for look in found], dtype=float)
    n = len(found)
    wander, bandwidth, clock = trust[:, :1], trust[:, 1:2], trust[:, 3:4]
    stands = np.broadcast_to(np.array(STANDS), (n, 2, 2))
    once = Model(
        np.hstack([its, kappa, kappa, stands[..., 0]]),
        np.hstack([its_share * its, SPAN_SIGMA * kappa, SPAN_SIGMA * kappa, stands[..., 1]]),
        np.repeat(clock, _MODELS, axis=1),
        np.hstack([its * wander, kappa * SWAY[0], kappa * FLIGHT[0], its * wander, its * wander]),
        np.hstack([bandwidth, np.tile([SWAY[1], FLIGHT[1]], (n, 1)), bandwidth, bandwidth]),
    )
    return Model(*(np.hstack([values, np.repeat(values[:, :1], turns - 1, axis=1)]) for values in once))


def _inverse_distance(look: _Look) -> tuple[float, float]:
    """Of the drone if the track is it [1/m], and its relative sigma: by the place that it says, or by its size."""
    if not look.saying.trust.placed:
        return float(look.scan.kappa[look.row]), SPAN_SIGMA
    distance = max(float(np.linalg.norm(look.saying.displacement - look.scan.camera)), NEAREST)
    return 1.0 / distance, math.hypot(PLACED_SHARE, PLACED_M / distance)


def _if_flown(ratio: Array | float) -> Array:
    """The log ratio of a drone that as likely as not moves in another way than was compared."""
    return np.logaddexp(ratio, 0.0) - math.log(2.0)


def _ratios(log: Array) -> Array:
    """Of log likelihoods (..., models): of the drone, by each turn, against the mean of the others."""
    is_it = np.concatenate([log[..., :1], log[..., _MODELS:]], axis=-1)
    return np.asarray(is_it - _of_none(log)[..., None])


def _of_none(log: Array) -> Array:
    return np.asarray(np.logaddexp.reduce(log[..., 1:_MODELS], axis=-1) + _NONE)
