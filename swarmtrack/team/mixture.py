"""The weights of the components, and by each of them which track is which teammate.

By component, each pair of a track and a teammate has a ratio: of all bearings if the track is the teammate, over those
of a stranger. The weight of a component is its prior times the weight of all one-to-one matchings; what is said of
tracks is the average over components. What ended tracks said of the components stays, and fades slowly.

Components without weight sleep, and are looked at again in turn: more of them while anything is doubtful.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array, OwnFault
from swarmtrack.team.evidence import (
    AS_STATED,
    DOUBTED,
    FrameShares,
    Marginal,
    PriorsOfMany,
    Solution,
    TeammatePrior,
    log_evidence_of_nothing,
    moments,
)
from swarmtrack.team.log_sums import log_sum
from swarmtrack.team.matchings import match_all, worth_matching
from swarmtrack.team.own_errors import ConfigFault, OwnErrors
from swarmtrack.team.pasts import any_or_none, each_past_once, log_ratios, pasts_from_now
from swarmtrack.team.priors import (
    DOUBTING_PADS_RATIO,
    HEADING_LEAST_SIGMA_RAD,
    LOG_ANYWHERE,
    LOG_NONSENSE,
    LOG_PAIR_SLEEPS,
    LOG_RATIO_LEAST,
    LOG_SEEN,
    LOG_SLEEPS,
    NAMES_TELL,
    OWN_ERRORS_LAST_S,
    P_HELD,
    P_SETTLED,
    P_UNLOCATED_SEEN,
    PAIRS_AT_ONCE,
    PLACE_COMPONENTS,
    PROOF_COMPONENTS,
    RAYS_WEIGHED_EVERY_S,
    SLEEPERS_PARTS,
    SLEEPERS_PARTS_DOUBTFUL,
    SMALL_TEAM,
    SOMEWHERE_SIGMA_M,
    START_LEAST_SIGMA_M,
    STRANGERS_SEEN,
)
from swarmtrack.team.rows import runs
from swarmtrack.team.teammates import Teammate
from swarmtrack.team.track_evidence import Told, TrackEvidence
from swarmtrack.team.unheard import UnheardTrack, by_chance


class OwnKnowledge(NamedTuple):
    """How well this drone knows its start, m per axis, and its heading [rad], by what it was told."""

    start_sigma_m: float
    heading_sigma: float = HEADING_LEAST_SIGMA_RAD


class _Weighing(NamedTuple):
    """What one weighing is of: n tracks, what each says, and m teammates; looked_at (n, m): the pairs that do not
    sleep; used: the components. Log ratios are filled into `each`, by track (s, k, m): of its segments."""

    tracks: Sequence[TrackEvidence]
    told: Sequence[Told]
    mates: Sequence[Teammate]
    each: Sequence[Array]
    looked_at: NDArray[np.bool_]
    used: NDArray[np.intp]
    t: float
    known: OwnKnowledge


class JointMixture:
    """`weight` (k,) of the components; `p_fault`: the probability that the own heading or start is wrong; `is_settled`:
    whether one component, and each track's name, is sure, or in a large team the own pose; `unlocated`: how many
    teammates live and have not said where, each of which may be any track; `looks_at_all`: whether the last weighing
    looked at all pairs."""

    def __init__(self, own: int) -> None:
        """own: our ID."""
        self.errors = OwnErrors(own, {own: np.zeros(3)})
        self.p_fault = 0.0
        self.unlocated = 0
        self._priors: dict[int, TeammatePrior] = {}
        self._shares: dict[int, FrameShares] = {}
        self._told = np.zeros(len(self.errors))
        self._told_t = 0.0
        self._begin()

    def _begin(self) -> None:
        """All components are awake."""
        self.weight = np.eye(len(self.errors))[0]
        self._log_weight = np.zeros(len(self.errors))
        self._p_heading_off = np.zeros(len(self.errors))
        self._rays_t = -math.inf
        self._seen_by_team = np.zeros(len(self.errors))
        self._part = 0
        self.is_settled = self._is_right = False
        self.looks_at_all = True

    @property
    def is_large(self) -> bool:
        """Whether the team is so large that what is settled rests."""
        return len(self._priors) > SMALL_TEAM

    @property
    def log_seen(self) -> float:
        """Prior log odds that a track is a teammate which says where it is, and no other drone or ghost."""
        return LOG_SEEN - math.log1p(self.unlocated * P_UNLOCATED_SEEN / STRANGERS_SEEN)

    def set_team(
        self, drones: Collection[int], pads: Mapping[int, Array], tracks: Sequence[TrackEvidence]
    ) -> None:
        """drones: the teammates; pads (3,) m: by drone, ours too, where each that knows it says that it started. What
        was learned goes over."""
        before, own = self.errors, self.errors.own
        self.errors = OwnErrors(own, pads)
        self._told = self.errors.mapped_from(before, self._told)
        for track in tracks:
            track.map_components(lambda value: self.errors.mapped_from(before, value))
        self._priors = {drone: TeammatePrior.of(drone, self.errors) for drone in drones}
        self._begin()

    def turn(self, angle: float, tracks: Sequence[TrackEvidence]) -> None:
        """The own heading has stepped by angle [rad], clockwise from above."""
        self._told = self.errors.turned(self._told, angle)
        for track in tracks:
            track.map_components(lambda value: self.errors.turned(value, angle))
        self._begin()

    def forget(self) -> None:
        """What ended tracks said was of another start, or another heading."""
        self._told = np.zeros(len(self.errors))
        self._begin()

    def keep(self, told: Array, t: float) -> None:
        """A track has ended that said this of the components: log evidence (k,)."""
        self._told, self._told_t = self._told_at(t) + told - told.max(), t

    def _told_at(self, t: float) -> Array:
        return math.exp(-(t - self._told_t) / OWN_ERRORS_LAST_S) * self._told

    # --- who is who ---

    def weigh(
        self, tracks: Sequence[TrackEvidence], mates: Sequence[Teammate], t: float, known: OwnKnowledge
    ) -> Array:
        """(n, m): the probability that each track is each teammate. Each track remembers what it says of the
        components, and the weights of its segments."""
        used = self._awake(tracks)
        self._look_at_rays(mates, t, known)
        log_prior, off = self.errors.log_prior(known.heading_sigma)
        log_w = (log_prior + self._told_at(t) + self._seen_by_team)[used]
        pasts = [track.pasts(len(self.errors)).of((slice(None), used)) for track in tracks]
        base = [past.log for past in pasts]
        told = [track.told() for track in tracks]
        each, looked_at = self._pairs(tracks, mates, base)
        weighing = _Weighing(tracks, told, mates, each, looked_at, used, t, known)
        many = self._of_one_kind(mates, t) if self.is_large else []
        if many:
            log_w = log_w + self._of_many(many, weighing)
        for c in sorted(set(range(len(mates))) - set(many)):
            log_w = log_w + self._of_teammate(c, weighing)
        # Before any past is kept: it would be one without what is by chance.
        for i, b in enumerate(base):
            self._hold_back(i, b, weighing)
        waiting = [i for i, track in enumerate(tracks) if track.waits]
        worth = self._log_weight[used] > LOG_SLEEPS
        for i, past in pasts_from_now(waiting, pasts, each, worth).items():
            for rows, last in zip(pasts[i], tracks[i].begin_waiting_on(past, used), strict=True):
                rows[-1] = last
        nobody, ratio = log_ratios(base, each)
        ratio = ratio.reshape(len(tracks), len(used), len(mates))
        log_w = log_w + sum(nobody, np.zeros(len(used)))
        once = each_past_once(ratio, nobody, pasts, each, [track.since for track in tracks])
        kept, P = self._match(once.swapaxes(0, 1), log_w, used, off)
        self._let_pairs_sleep(tracks, mates, ratio[:, self._log_weight[used] > LOG_SLEEPS], P)
        for track, p in zip(tracks, P, strict=True):
            if p.max(initial=0.0) > P_HELD:
                track.held = mates[int(p.argmax())].drone_id
        self._p_heading_off = off
        for track, b, e, none, r in zip(tracks, base, each, nobody, ratio, strict=True):
            whole = none + np.logaddexp(0.0, log_sum(r, 1))
            track.learn(whole, used, len(self.errors))
            alone = b + any_or_none(e) - whole
            track.weigh_segments(np.exp(np.minimum(alone[:, kept], 0.0)) @ self.weight[used[kept]])
        return P

    @property
    def fault(self) -> OwnFault | None:
        """The likeliest fault of this drone's own pose; None: there is none."""
        errors, w = self.errors, self.weight
        by_kind = {
            "heading": w * self._p_heading_off,
            "start": w * (errors.ring > 0.0),
            "pads": w * errors.permuted(errors.own),
        }
        kind, w = max(by_kind.items(), key=lambda item: float(item[1].sum()))
        total = float(w.sum())
        if not total:
            return None
        if kind == "heading":
            return OwnFault(heading=float(np.angle(w @ np.exp(1j * errors.heading))))
        if kind == "start":
            north, east, _ = (w @ errors.shift / total).tolist()
            return OwnFault(start=(north, east))
        return OwnFault(pad_of=dict(errors.components[int(w.argmax())].pads)[errors.own])

    def by_fault(self) -> dict[ConfigFault, float]:
        """The probability of each kind of fault."""
        heading = self.errors.fault_is(ConfigFault.HEADING)
        as_stated = float(self.weight[heading] @ (1.0 - self._p_heading_off[heading]))
        found = {fault: float(self.weight[self.errors.fault_is(fault)].sum()) for fault in ConfigFault}
        found[ConfigFault.HEADING] -= as_stated
        found[ConfigFault.NONE] += as_stated
        return found

    def _of_teammate(self, c: int, weighing: _Weighing) -> Array:
        """(k,): what is known of one teammate says of the components used; its log ratios go into column c."""
        tracks, told, mates, each, looked_at, used, t, known = weighing
        mate = mates[c]
        before, at_tracks = mate.told(t), np.flatnonzero(looked_at[:, c]).tolist()
        if before.any() or mate.p_supposed or any(told[i].known[mate.column] for i in at_tracks):
            cases = [told[i].of(mate.column) for i in at_tracks]
            new = np.concatenate([np.zeros((1, 8, 8)), *(M for M, _, _ in cases)])
            E = self._evidence(mate, before + new, used, known)
        else:
            # Out of view, as most of a large team.
            cases, E = [], log_evidence_of_nothing(used, self._shares[mate.drone_id].far)[None]
        log_w = E[0] - E[0].max()
        if mate.doubting:
            log_w = log_w + math.log(DOUBTING_PADS_RATIO) * self.errors.permuted(mate.drone_id)[used]
        if not cases:
            return np.asarray(log_w)
        E = E - E[0]
        other = E
        if mate.p_supposed:
            other = self._evidence(mate, mate.supposed(t) + new, used, known)
            other = other - other[0]
            E = np.logaddexp(math.log(1.0 - mate.p_supposed) + E, math.log(mate.p_supposed) + other)
        at = 1
        for i, (M, weight, whole) in zip(at_tracks, cases, strict=True):
            if told[i].known[mate.column]:
                track, back = tracks[i], 0.0
                if mate.p_supposed and track.may_return(mate.drone_id, mate.supposed_t):
                    fit = float((other[at : at + whole] + weight[:whole, None]).max())
                    # The track that ended may have been a stranger, which comes back as readily.
                    back = float(np.logaddexp(0.0, self.log_seen + math.log(1.0 - mate.p_supposed) + fit))
                    track.hold_back([mate.column], back)
                log = E[at : at + len(M)] + weight[:, None] - back
                log[:whole] += self.log_seen + (0.0 if mate.knows_start else LOG_ANYWHERE) + track.log_weak(t)
                # Whoever takes over a track may be any of the team.
                log[whole:] -= math.log(len(self._priors))
                if whole > 1:
                    log = np.concatenate([log_sum(log[:whole], 0)[None], log[whole:]])
                each[i][:, :, c] = log
            at += len(M)
        return np.asarray(log_w)

    def _pairs(
        self, tracks: Sequence[TrackEvidence], mates: Sequence[Teammate], base: Sequence[Array]
    ) -> tuple[list[Array], NDArray[np.bool_]]:
        """Log ratios (s, k, m) by track to be filled in, with those of pairs that sleep; and the others (n, m)."""
        each = [np.full((*b.shape, len(mates)), -np.inf) for b in base]
        looked_at = np.ones((len(tracks), len(mates)), bool)
        if self.looks_at_all:
            return each, looked_at
        columns = [mate.column for mate in mates]
        sleeps = np.array([not mate.p_supposed for mate in mates])
        for i, track in enumerate(tracks):
            faint = np.where(sleeps, track.faint[columns], np.nan)
            looked_at[i] = np.isnan(faint)
            each[i][:] = np.where(looked_at[i], -np.inf, faint)
        return each, looked_at

    @staticmethod
    def _of_one_kind(mates: Sequence[Teammate], t: float) -> list[int]:
        """The teammates of whose frame nothing is known but what they state."""
        return [
            c for c, mate in enumerate(mates) if not (mate.doubting or mate.p_supposed or mate.told(t).any())
        ]

    def _of_many(self, many: Sequence[int], weighing: _Weighing) -> Array:
        """What `_of_teammate` does for one, for many `_of_one_kind` at once."""
        tracks, told, mates, each, looked_at, used, t, known = weighing
        column = np.array([mate.column for mate in mates])
        anywhere = np.array([0.0 if mate.knows_start else LOG_ANYWHERE for mate in mates])
        is_one = np.isin(np.arange(len(mates)), many)
        pairs = [
            np.flatnonzero(at & is_one & one.known[column]) for at, one in zip(looked_at, told, strict=True)
        ]
        rows = [one.of_many(column[at]) for at, one in zip(pairs, told, strict=True)]
        start_cov = np.array([self._start_cov(mate, known) for mate in mates])
        E = self._of_pairs(pairs, [row.M for row in rows], mates, start_cov, used, known=known)
        for into, track, at, row, evidence in zip(each, tracks, pairs, rows, E, strict=True):
            row.log[: row.whole] += self.log_seen + anywhere[at] + track.log_weak(t)
            row.log[row.whole :] -= math.log(len(self._priors))
            log = evidence + row.log[:, :, None]
            log = np.concatenate([log_sum(log[: row.whole], 0)[None], log[row.whole :]])
            into[:, :, at] = log.swapaxes(1, 2)
        nothing = log_evidence_of_nothing(used, AS_STATED.far)
        return np.asarray(len(many) * (nothing - nothing.max()))

    def _of_pairs(
        self,
        pairs: Sequence[NDArray[np.intp]],
        M: Sequence[Array],
        mates: Sequence[Teammate],
        start_cov: Array,
        used: NDArray[np.intp],
        *,
        known: OwnKnowledge,
    ) -> list[Array]:
        """By track, log evidence (c, m', k) of matrices M (c, m', 8, 8) over that of nothing, by the components used;
        pairs (m',): the teammates that they are of, none of which doubts itself. start_cov (m, 3, 3) m²: of the
        teammates' starts and the own."""
        if not M:
            return []
        shapes = [matrices.shape[:2] for matrices in M]
        of = np.concatenate([np.tile(at, c) for at, (c, _) in zip(pairs, shapes, strict=True)])
        flat = np.concatenate([matrices.reshape(-1, 8, 8) for matrices in M])
        found = np.empty((len(of), len(used)))
        # By teammate, and as many at once as the cache holds.
        order, spreads = np.argsort(of, kind="stable"), np.unique(self.errors.spread[used])
        at_once = max(1, round(PAIRS_AT_ONCE / (len(used) + 20)))
        for part in (order[begin : begin + at_once] for begin in range(0, len(order), at_once)):
            some, counts = np.unique(of[part], return_counts=True)
            priors = PriorsOfMany([self._priors[mates[c].drone_id] for c in some], counts.tolist())
            marginal = Marginal(flat[part], start_cov[of[part], None], spreads)
            found[part] = _sense(marginal.log_evidence(priors, self.errors, used, known.heading_sigma))
        found -= log_evidence_of_nothing(used, AS_STATED.far)
        parts = runs(c * m for c, m in shapes)
        return [found[part].reshape(*shape, len(used)) for part, shape in zip(parts, shapes, strict=True)]

    def _let_pairs_sleep(
        self, tracks: Sequence[TrackEvidence], mates: Sequence[Teammate], ratio: Array, P: Array
    ) -> None:
        """Of a large team, while the own pose is right: of tracks that have a name, the pairs that are far from it by
        all components of weight. ratio (n, k, m): of these components."""
        if not self.is_large:
            return
        columns = [mate.column for mate in mates]
        for track, log_ratio, p in zip(tracks, ratio, P, strict=True):
            track.faint[:] = np.nan
            if self._is_right and p.max() > P_HELD and track.unheard is None:
                top = log_ratio.max(axis=0)
                track.faint[columns] = np.where((top < LOG_PAIR_SLEEPS) & (top > -np.inf), top, np.nan)

    def _hold_back(self, i: int, base: Array, weighing: _Weighing) -> None:
        """While the teammate that a track was says nothing, others explain it no better than chance would: in the log
        ratios of track i, and in what it remembers. base (s, k): log evidence of all before each segment."""
        track, each, mates, t = weighing.tracks[i], weighing.each[i], weighing.mates, weighing.t
        silent = next((mate for mate in mates if mate.drone_id == track.held and not mate.knows(t)), None)
        if silent is None:
            track.unheard = None
            return
        if track.unheard is None or track.unheard.drone_id != silent.drone_id:
            track.unheard = UnheardTrack(silent.drone_id, t, components=len(self.errors), mates=len(mates))
        elif track.t <= track.unheard.since:
            return  # It was compared with nobody since.
        since = [segment.since for segment in track.segments]
        speak = np.array([mate.knows(t) for mate in mates])
        more = track.unheard.held_back(t, since, base, each, used=weighing.used, speak=speak)
        track.hold_back([mate.column for mate in mates], more)
        each -= more
        for s, begun in enumerate(since):
            gains = np.flatnonzero(speak & (each[s].max(axis=0, initial=-np.inf) > 0.0))
            if begun > track.unheard.since and gains.size:
                alike = self._moves_alike(
                    weighing.told[i], s, [mates[c] for c in gains.tolist()], weighing.known
                )
                each[s] -= by_chance(alike) * speak

    def _moves_alike(self, told: Told, segment: int, mates: Sequence[Teammate], known: OwnKnowledge) -> float:
        """Log ratio of the teammate whose motion explains a segment best, wherever it started."""
        used = self._likeliest(PROOF_COMPONENTS)
        (R,) = self._motion_ratios([told], [segment], [np.arange(len(mates))], mates, used, known=known)
        return float(np.logaddexp.reduce(np.log(self.weight[used])[:, None] + R, axis=0).max()) + LOG_ANYWHERE

    def _evidence(self, mate: Teammate, M: Array, used: NDArray[np.intp], known: OwnKnowledge) -> Array:
        """(n, k): `Marginal.log_evidence` of matrices M (n, 8, 8)."""
        prior = PriorsOfMany.of_one(self._priors[mate.drone_id], len(M))
        log = self._marginal(mate, M, used, known).log_evidence(prior, self.errors, used, known.heading_sigma)
        return _sense(log)

    def _look_at_rays(self, mates: Sequence[Teammate], t: float, known: OwnKnowledge) -> None:
        """What teammates see of each other, and of this drone."""
        due, before = t - self._rays_t >= RAYS_WEIGHED_EVERY_S, self._shares
        self._shares = {
            mate.drone_id: self._shares_of(mate, t, known)
            if due or mate.doubting or mate.drone_id not in before
            else before[mate.drone_id]
            for mate in mates
        }
        if due:
            self._rays_t = t
            seen = [mate.rays.seen_by_it(t, mate.drone_id, self.errors) for mate in mates]
            self._seen_by_team = sum((one for one in seen if one is not None), np.zeros(len(self.errors)))

    def _shares_of(self, mate: Teammate, t: float, known: OwnKnowledge) -> FrameShares:
        """How likely its frame is as it says."""
        if mate.doubting or not mate.rays:
            return DOUBTED if mate.doubting else AS_STATED
        cases = mate.rays.cases(t)
        marginal = Marginal(cases.matrices, self._start_cov(mate, known), np.zeros(1))
        log = _sense(marginal.by_start(self._priors[mate.drone_id], known.heading_sigma))
        return AS_STATED.shown(cases.p_near(log, np.log(AS_STATED.start[0])))

    @staticmethod
    def _start_cov(mate: Teammate, known: OwnKnowledge) -> Array:
        return mate.start_cov + (known.start_sigma_m**2 + START_LEAST_SIGMA_M**2) * np.eye(3)

    def _marginal(self, mate: Teammate, M: Array, used: NDArray[np.intp], known: OwnKnowledge) -> Marginal:
        cov = self._start_cov(mate, known)
        shares = self._shares.get(mate.drone_id, AS_STATED)
        return Marginal(M, cov, np.unique(self.errors.spread[used]), shares)

    def _awake(self, tracks: Sequence[TrackEvidence]) -> NDArray[np.intp]:
        """The components to work out now: those with weight, and a part of the sleepers, which need all pairs."""
        self.looks_at_all = not self._is_right or not any(np.isfinite(track.faint).any() for track in tracks)
        parts = 1 if self.is_settled or self._is_right else SLEEPERS_PARTS_DOUBTFUL
        if not self.looks_at_all:
            parts = 0
        looked_at = (self.errors.part - self._part) % SLEEPERS_PARTS < parts
        self._part = (self._part + parts) % SLEEPERS_PARTS
        awake = (self._log_weight > LOG_SLEEPS) | looked_at
        awake[0] = True
        return np.flatnonzero(awake)

    def _match(
        self, log_ratio: Array, log_w: Array, used: NDArray[np.intp], off: Array
    ) -> tuple[NDArray[np.intp], Array]:
        """Match tracks and teammates by each component that may have weight, and weigh these. log_ratio (k, n, m);
        log_w (k,) without matchings; off: by component of all, that the heading is off. Returns which of `used` were
        matched, and the probability (n, m) of each pair."""
        R = np.where(log_ratio <= LOG_RATIO_LEAST, -np.inf, log_ratio)
        kept = worth_matching(R, log_w) if self.looks_at_all else np.arange(len(used))
        found = match_all(R[kept])
        log_w = log_w[kept] + found.log_total
        log_w = log_w - log_w.max()
        weight = np.exp(log_w)
        weight /= weight.sum()
        self.weight[:], self._log_weight[:] = 0.0, -np.inf
        self.weight[used[kept]], self._log_weight[used[kept]] = weight, log_w
        P = np.tensordot(weight, found.probability, axes=1)
        none = 1.0 - P.sum(axis=1)
        sure = np.maximum(P.max(axis=1, initial=0.0), none) > P_SETTLED
        self.p_fault = float(self.weight @ np.where(self.errors.mine, 1.0, off))
        # That this drone is as it says; whether two that are not in view have mixed up their pads, no track can say.
        named = P.max(axis=1, initial=0.0)
        is_told = sure.all() or named[named > P_HELD].sum() >= NAMES_TELL
        self._is_right = bool(1.0 - self.p_fault > P_SETTLED and is_told)
        is_known = weight.max() > P_SETTLED and sure.all()
        self.is_settled = bool(is_known or (self._is_right and self.is_large))
        return kept, P

    def by_motion(
        self, tracks: Sequence[TrackEvidence], mates: Sequence[Teammate], known: OwnKnowledge
    ) -> Array:
        """Probability (n, m) of each track and teammate if all starts were unknown, by the likeliest components."""
        used = self._likeliest(PROOF_COMPONENTS)
        columns = [mate.column for mate in mates]
        pairs = [np.flatnonzero(track.compared[columns]) for track in tracks]
        segments = [track.likeliest_segment for track in tracks]
        found = self._motion_ratios(
            [track.told() for track in tracks], segments, pairs, mates, used, known=known
        )
        R = np.full((len(used), len(tracks), len(mates)), -np.inf)
        for i, (at, ratios) in enumerate(zip(pairs, found, strict=True)):
            R[:, i, at] = ratios
        w = self.weight[used] / float(self.weight[used].sum())
        return np.asarray(np.tensordot(w, match_all(R + self.log_seen + LOG_ANYWHERE).probability, axes=1))

    def _motion_ratios(
        self,
        told: Sequence[Told],
        segments: Sequence[int],
        pairs: Sequence[NDArray[np.intp]],
        mates: Sequence[Teammate],
        used: NDArray[np.intp],
        *,
        known: OwnKnowledge,
    ) -> list[Array]:
        """By track, (len(used), m'): log evidence of what its segment says of the motion of each teammate in `pairs`,
        over that of nothing, if all starts were unknown."""
        column = np.array([mate.column for mate in mates])
        anywhere = np.broadcast_to(SOMEWHERE_SIGMA_M**2 * np.eye(3), (len(mates), 3, 3))
        said = [
            one.by_motion(segment, column[at]) for one, segment, at in zip(told, segments, pairs, strict=True)
        ]
        E = self._of_pairs(pairs, [M for M, _ in said], mates, anywhere, used, known=known)
        return [log_sum(e + log[:, :, None], 0).T for e, (_, log) in zip(E, said, strict=True)]

    def _likeliest(self, n: int) -> NDArray[np.intp]:
        """Up to n components, in order of their indices."""
        likely = np.argsort(-self.weight)[:n]
        return np.sort(likely[self.weight[likely] > 0.0])

    # --- where they are ---

    def expected_places(self, drones: Sequence[int], design: Array) -> Array:
        """(m, 3) m from the own camera, in the axes of the own rays: where teammates are by the likeliest component,
        and by no bearing; NaN of one that is new. design (m, 3, 8): `evidence.design` of where they say that they
        are."""
        k, new = int(self.weight.argmax()), np.full(8, math.nan)
        y = np.array([self._priors[drone].y[:, 0, k] if drone in self._priors else new for drone in drones])
        return np.asarray((design @ y[:, :, None])[:, :, 0])

    def stated_place(self, mate: Teammate, design: Array, known: OwnKnowledge) -> tuple[Array, Array]:
        """As `place`, with all starts as stated."""
        M = np.zeros((8, 8))
        marginal = self._marginal(mate, M[None], np.zeros(1, int), known)
        return self._solutions(marginal, mate, M, 0, known)[0].place(design)

    def place(
        self, track: TrackEvidence, mate: Teammate, design: Array, t: float, known: OwnKnowledge
    ) -> tuple[Array, Array]:
        """Where a teammate is that is that track: mean (3,) m from the own camera and covariance (3, 3), in the axes of
        the own rays. design (3, 8): `evidence.design` of where it says that it is."""
        found = self._likely(track, mate, t, known, far=False)
        return moments([(log, one.place(design)) for log, one in found])

    def frame(
        self, track: TrackEvidence, mate: Teammate, design: Array, t: float, known: OwnKnowledge
    ) -> tuple[Array, Array]:
        """How the frame of a teammate that is that track stands to the axes of the own rays: mean (4,) and covariance
        (4, 4) of where it has its origin, m from the own camera, and by how much it is turned, rad, clockwise from
        above. design (3, 8): `evidence.design` of its origin."""
        found = self._likely(track, mate, t, known, far=True)
        return moments([(log, one.frame(design)) for log, one in found])

    def _likely(
        self, track: TrackEvidence, mate: Teammate, t: float, known: OwnKnowledge, *, far: bool
    ) -> list[tuple[float, Solution]]:
        """By the likeliest components, with their log weights."""
        cases, weight = track.told().since(track.likeliest_segment, mate.column)
        M = mate.told(t) + cases[int(weight.argmax())]
        likely = np.argsort(-self.weight)[:PLACE_COMPONENTS]
        marginal = self._marginal(mate, M[None], likely, known)
        return [
            (one.log_share + math.log(self.weight[k]), one)
            for k in likely.tolist()
            if self.weight[k] > 0.0
            for one in self._solutions(marginal, mate, M, k, known, far=far)
        ]

    def _solutions(
        self, marginal: Marginal, mate: Teammate, M: Array, k: int, known: OwnKnowledge, *, far: bool = False
    ) -> list[Solution]:
        prior = self._priors[mate.drone_id]
        return marginal.solutions(M, prior, self.errors, k=k, heading_sigma=known.heading_sigma, far=far)


def _sense(log: Array) -> Array:
    """Nonsense from a peer explains nothing."""
    return np.nan_to_num(log, nan=LOG_NONSENSE, neginf=LOG_NONSENSE)
