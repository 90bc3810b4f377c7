"""One posterior of everything that lasts and is unknown about a team, as one drone sees it.

Theory of operation. Discrete are the component of the own errors (`own_errors.py`) and which track is which teammate;
given both, headings and starts are Gaussian (`evidence.py`). All tracks are compared with all teammates in rounds, in
the same scans, as soon as everybody who speaks has said where it was then: a drone whose report comes earlier must not
explain a climb for a moment in which others cannot. Whatever has just come into view is compared at once.

Then, by component, each pair has a ratio: of all bearings if the track is the teammate, over those of a stranger that
stands, hovers or flies. The weight of a component is its prior times the weight of all one-to-one matchings; names are
the mixture over components, and what is wrong with this drone is the weight of the components that say so.

Where a track ends, what it said of its teammate's frame stays with the teammate, and what it said of the own errors
with the components. Components without weight sleep, and are looked at again in turn.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry import rotation
from swarmtrack.messages import AgreedMotion, Announcement, Array
from swarmtrack.team.evidence import Marginal, TeammatePrior, design, turned_back
from swarmtrack.team.own_errors import OwnErrors
from swarmtrack.team.priors import (
    BELIEVED_ENDED_S,
    BOX_LEARNED_EVERY_S,
    BOX_SIZE_SIGMA_LN,
    BOX_SPAN_LEAST_SIGMA_LN,
    DOUBTING_PADS_RATIO,
    HANDOVER_MET,
    HANDOVER_MISSED_PER_S,
    HANDOVER_MOST,
    HANDOVER_PER_S,
    HEADING_LEAST_SIGMA_RAD,
    LOG_RATIO_LEAST,
    LOG_RATIO_MOST,
    LOG_SEEN,
    LOG_SLEEPS,
    LOG_WEAK,
    OWN_ERRORS_LAST_S,
    P_BELIEVED,
    P_FRAME_KEPT,
    P_SETTLED,
    P_SIZE_LEARNED,
    P_SUPPOSED,
    REPORT_WAIT_S,
    ROUND_NEAR_S,
    ROUND_S,
    SEGMENT_AFTER_MISS_S,
    SEGMENT_LEAST_S,
    SEGMENT_MISSED_S,
    SLEEPERS_PARTS,
    SLEEPERS_PARTS_DOUBTFUL,
    START_LEAST_SIGMA_M,
    TRACKS_MEET_PX,
)
from swarmtrack.team.teammates import Teammate
from swarmtrack.team.track_evidence import Bearing, TrackEvidence
from swarmtrack.tracking.marginals_of_each import matched_of_each

# s of scans that wait for reports of their time.
_SCANS_KEPT_S = 2.5


class BearingScan(NamedTuple):
    """The tracks that one camera detected at t [s], from origin (3,) m: bearings and pixels (2,) by track; missed: those
    it shows and did not detect, by since when [s]."""

    t: float
    camera: int
    origin: Array
    bearings: Mapping[int, Bearing]
    pixels: Mapping[int, Array]
    missed: Mapping[int, float]

    def turned(self, rotation: Array) -> BearingScan:
        """The same in axes that have turned: rotation (3, 3) takes directions along."""
        turned = {id: one._replace(direction=rotation @ one.direction) for id, one in self.bearings.items()}
        return self._replace(bearings=turned)


class Named(NamedTuple):
    """Of one track: probability by drone, and of none of them."""

    p: Mapping[int, float]
    p_none: float

    @property
    def likeliest(self) -> tuple[int, float]:
        """A drone and its probability; 0 and 0 where nobody is known."""
        return max(self.p.items(), key=lambda item: item[1], default=(0, 0.0))


class TeamPosterior:
    """Told of reports and scans; `named` and `p_fault` are read after each."""

    def __init__(self, own: int, *, cameras: int, start_sigma_m: float) -> None:
        self.own = own
        self.teammates: dict[int, Teammate] = {}
        self.named: dict[int, Named] = {}
        self.p_fault = 0.0
        """The probability that the own heading or start is wrong."""
        self._start: Array | None = None
        self._start_sigma = max(start_sigma_m, START_LEAST_SIGMA_M)
        self._heading_sigma = HEADING_LEAST_SIGMA_RAD
        self._errors = OwnErrors(own, {own: np.zeros(3)})
        self._priors: dict[int, TeammatePrior] = {}
        self._tracks: dict[int, TrackEvidence] = {}
        self._whole: dict[int, Array] = {}
        """By track, (k,): log evidence of all its bearings, whoever it is."""
        self._scans: list[deque[BearingScan]] = [deque() for _ in range(cameras)]
        self._round: list[float] = [-math.inf] * cameras
        self._missed: dict[int, float] = {}
        self._watched: list[float] = [math.nan] * cameras
        self._sure_t: dict[int, float] = {}
        self._told = np.zeros(len(self._errors))
        self._told_t = 0.0
        self._log_weight = np.zeros(len(self._errors))
        self.weight = np.zeros(len(self._errors))
        """(k,) of the components."""
        self._part = 0
        self._is_settled = False
        self._judged = -math.inf
        self._news = False

    # --- what teammates say ---

    def announce(self, announcement: Announcement) -> None:
        """A teammate says where it is."""
        known = self.teammates.get(announcement.drone_id)
        self._news = True
        if known is not None and known.boot == announcement.boot:
            known.announce(announcement)
            return
        column = len(self.teammates) if known is None else known.column
        if known is not None:
            self._forget_column(column)
        self.teammates[announcement.drone_id] = Teammate.of(announcement, column)
        for track in self._tracks.values():
            track.grow(len(self.teammates))
        self._rebuild()

    def agree(self, motion: AgreedMotion) -> None:
        """A teammate moves like that, as was agreed before the flight."""
        mate = self.teammates.get(motion.drone_id)
        if mate is not None:
            mate.agree(motion)

    def turn_rays(self, angle: float) -> None:
        """The own heading has stepped by angle [rad], clockwise from above, and the drone has not: every ray is turned
        from now on, and what was seen before turns along."""
        to_old, forward = turned_back(angle), rotation.from_euler(0.0, 0.0, angle)
        for track in self._tracks.values():
            track.turn(to_old, forward)
            for segment in track.segments:
                if segment.base is not None:
                    segment.base = self._errors.turned(segment.base, angle)
        for mate in self.teammates.values():
            mate.turn(to_old)
        self._whole = {id: self._errors.turned(whole, angle) for id, whole in self._whole.items()}
        self._told = self._errors.turned(self._told, angle)
        self._log_weight = np.zeros(len(self._errors))
        for scans in self._scans:
            scans.extend([scans.popleft().turned(forward) for _ in range(len(scans))])
        self._news = True

    def lose_place(self) -> None:
        """This drone may be elsewhere than it thinks: all that was said of places is of another start."""
        self._restart(self.named)

    def turn_unmeasured(self) -> None:
        """Each track may have taken up another's detections."""
        self._restart({})

    def _restart(self, named: Mapping[int, Named]) -> None:
        """Bearings begin anew. named: the tracks whose names stay what they were."""
        self._tracks, self._whole, self.named = {}, {}, {}

    def expel(self, drone_id: int) -> None:
        """No track is this drone any more."""
        gone = self.teammates.pop(drone_id, None)
        if gone is None:
            return
        for mate in self.teammates.values():
            mate.column -= mate.column > gone.column
        for track in self._tracks.values():
            track.remove(gone.column)
        for id, named in self.named.items():
            self.named[id] = Named({other: p for other, p in named.p.items() if other != drone_id}, named.p_none)
        self._rebuild()

    def _forget_column(self, column: int) -> None:
        for track in self._tracks.values():
            track.forget(column)

    def _rebuild(self) -> None:
        if self._start is None:
            return
        pads = {
            mate.drone_id: mate.start if mate.knows_start else self._start for mate in self.teammates.values()
        }
        before, self._errors = self._errors, OwnErrors(self.own, {self.own: self._start, **pads})
        self._told = self._errors.mapped_from(before, self._told)
        self._log_weight = np.zeros(len(self._errors))
        self.weight = np.zeros(len(self._errors))
        self._whole = {id: self._errors.mapped_from(before, whole) for id, whole in self._whole.items()}
        for track in self._tracks.values():
            for segment in track.segments:
                if segment.base is not None:
                    segment.base = self._errors.mapped_from(before, segment.base)
        self._priors = {id: TeammatePrior.of(id, self._errors) for id in self.teammates}

    # --- what this drone sees ---

    def observe(
        self, scan: BearingScan, alive: Collection[int], own_place: Array, own_sigma: float, heading_sigma: float
    ) -> None:
        """alive: the tracks of all cameras; own_place (3,) m, team frame, and its sigma per axis; heading_sigma [rad]:
        as the autopilot knows its heading."""
        if self._start is None:
            self._start = own_place.copy()
            self._start_sigma = math.hypot(self._start_sigma, own_sigma)
            self._rebuild()
        self._heading_sigma = max(heading_sigma, HEADING_LEAST_SIGMA_RAD)
        t, number = scan.t, scan.camera
        if not math.isfinite(self._round[number]):
            self._round[number] = ROUND_S * math.floor(t / ROUND_S)
        scans = self._scans[number]
        scans.append(scan)
        while scans[0].t < t - _SCANS_KEPT_S:
            scans.popleft()
        self._end([id for id in self._tracks if id not in alive], t)
        self._watch(scan)
        self._compare_rounds(number, t)
        for id, bearing in scan.bearings.items():
            if id in self._tracks:
                self._tracks[id].weak = bearing.weak
        new = [id for id, bearing in scan.bearings.items() if id not in self._tracks and not bearing.weak]
        self._compare(scan, new)
        if self._news or t - self._judged > ROUND_S:
            self._judge(t)

    def _compare_rounds(self, number: int, t: float) -> None:
        speaking = [mate for mate in self.teammates.values() if mate.speaks(t, REPORT_WAIT_S)]
        while (due := self._round[number] + ROUND_S) <= t:
            if due >= t - REPORT_WAIT_S and not all(mate.has_said(due) for mate in speaking):
                return
            self._round[number] = due
            nearest = min(self._scans[number], key=lambda scan: abs(scan.t - due))
            if abs(nearest.t - due) < ROUND_NEAR_S:
                here = self._scans[number][-1].bearings
                self._compare(nearest, [id for id in nearest.bearings if id in self._tracks or id in here])

    def _compare(self, scan: BearingScan, ids: Iterable[int]) -> None:
        """Tracks with all teammates, in one scan."""
        mates = [mate for mate in self.teammates.values() if mate.path]
        ids = list(ids)
        if not ids or not mates:
            return
        assert self._start is not None
        said = [mate.at(scan.t) for mate in mates]
        place = np.array([p - mate.start for mate, (p, _) in zip(mates, said, strict=True)])
        sigma = np.array([s for _, s in said])
        log_span = np.array([mate.log_span for mate in mates])
        variance = np.array([mate.span_variance for mate in mates])
        columns = np.array([mate.column for mate in mates])
        knows = np.array([mate.knows(scan.t) for mate in mates])
        for id in ids:
            track = self._tracks.get(id)
            if track is None:
                track = self._tracks[id] = TrackEvidence(len(self.teammates), scan.camera)
                track.weak = scan.bearings[id].weak
            bearing = scan.bearings[id]
            of = np.flatnonzero(knows | ~track.compared[columns])
            way = bearing.camera - self._start
            track.add(bearing, columns[of], place[of], way, sigma[of], log_span[of], variance[of])
        self._news = True

    def _watch(self, scan: BearingScan) -> None:
        """Which tracks may have gone over to another target: always a little; where two meet, or one comes back."""
        t, number = scan.t, scan.camera
        passed = 0.0 if math.isnan(self._watched[number]) else t - self._watched[number]
        self._watched[number] = t
        ids = list(scan.pixels)
        at = np.array([scan.pixels[id] for id in ids]).reshape(-1, 2)
        gap = np.linalg.norm(at[:, None] - at, axis=2) + np.diag(np.full(len(ids), np.inf))
        for id, near in zip(ids, gap, strict=True):
            track = self._tracks.get(id)
            missed = t - self._missed.pop(id, t)
            if track is None or id not in self._whole:
                continue
            track.hazard += HANDOVER_PER_S * passed + HANDOVER_MISSED_PER_S * missed
            track.hazard += HANDOVER_MET * bool((near < TRACKS_MEET_PX).any())
            newest = track.segments[-1].since
            age = t - (newest if math.isfinite(newest) else track.begun)
            if age < SEGMENT_LEAST_S and not (missed > SEGMENT_MISSED_S and age > SEGMENT_AFTER_MISS_S):
                continue
            hazard, track.hazard = min(track.hazard, HANDOVER_MOST), 0.0
            track.begin_segment(t, math.log(hazard), self._whole[id].copy())
        self._missed |= scan.missed

    def _end(self, gone: Sequence[int], t: float) -> None:
        """What an ended track said stays: the frame of whom it was, and which component that speaks for. Of a track that
        was nobody, nothing: a ghost that fits a wrong component comes again and again at its place."""
        for id in gone:
            track = self._tracks.pop(id)
            self._missed.pop(id, None)
            whole, named = self._whole.pop(id, None), self.named.pop(id, None)
            sure_t = self._sure_t.pop(id, -math.inf)
            if whole is None:
                continue
            best = max(range(len(track.segments)), key=lambda s: track.segments[s].weight)
            drone, p = named.likeliest if named else (0, 0.0)
            mate = self.teammates.get(drone)
            if mate is not None and P_SUPPOSED < p <= P_FRAME_KEPT:
                mate.suppose(track.told(t).M[best, mate.column], p, t)
            if t - sure_t > BELIEVED_ENDED_S:
                continue
            if mate is not None and p > P_FRAME_KEPT:
                mate.keep(track.told(t).M[best, mate.column], t)
                whole = track.base(track.segments[best], len(self._errors), t)
            self._told = self._told_at(t) + whole - whole.max()
            self._told_t = t

    def _told_at(self, t: float) -> Array:
        return math.exp(-(t - self._told_t) / OWN_ERRORS_LAST_S) * self._told

    # --- the posterior ---

    def _judge(self, t: float) -> None:
        self._judged, self._news = t, False
        rows = [id for id, track in self._tracks.items() if not math.isnan(track.begun)]
        mates = list(self.teammates.values())
        if not mates or self._start is None:
            self.named = {}
            return
        log_prior, off_share = self._errors.log_prior(self._heading_sigma)
        used = self._awake()
        log_w = log_prior[used] + self._told_at(t)[used]
        for mate in self.teammates.values():
            if mate.doubting:
                log_w = log_w + math.log(DOUBTING_PADS_RATIO) * self._errors.permuted(mate.drone_id)[used]
        told = [self._tracks[id].told(t) for id in rows]
        base = [
            np.array([self._tracks[id].base(s, len(self._errors), t)[used] for s in self._tracks[id].segments])
            for id in rows
        ]
        weak = [self._tracks[id].weak for id in rows]
        ratio = np.full((len(rows), len(used), len(mates)), -np.inf)
        whole_of = [np.logaddexp.reduce(b, axis=0) for b in base]
        each: list[Array] = [np.full((len(b), len(used), len(mates)), -np.inf) for b in base]
        for c, mate in enumerate(mates):
            old = mate.told(t)
            new = np.concatenate([np.zeros((1, 8, 8))] + [found.M[:, mate.column] for found in told])
            cov = self._start_cov(mate)
            E = self._evidence(mate, old + new, cov, used)
            log_w = log_w + E[0] - E[0].max()
            E = E - E[0]
            if mate.p_supposed:
                other = self._evidence(mate, mate.supposed(t) + new, cov, used)
                E = np.logaddexp(
                    math.log(1.0 - mate.p_supposed) + E, math.log(mate.p_supposed) + other - other[0]
                )
            at = 1
            for r, found in enumerate(told):
                s = len(found.M)
                if found.known[mate.column]:
                    news = E[at : at + s] + found.log[:, mate.column, None]
                    news[0] += LOG_SEEN + weak[r] * LOG_WEAK
                    news[1:] -= math.log(len(mates))
                    each[r][:, :, c] = np.minimum(news, LOG_RATIO_MOST)
                at += s
        for r, b in enumerate(base):
            none = whole_of[r]
            ratio[r] = np.logaddexp.reduce(b[:, :, None] + each[r], axis=0) - none[:, None]
            log_w = log_w + none
        R = np.minimum(ratio.swapaxes(0, 1), LOG_RATIO_MOST)
        R[R <= LOG_RATIO_LEAST] = -np.inf
        kept = self._worth_matching(R, log_w)
        found_of = matched_of_each(R[kept])
        log_w = log_w[kept] + found_of.log_total
        self._settle(used[kept], log_w)
        weight = self.weight[used[kept]]
        P = np.tensordot(weight, found_of.probability, axes=1)
        wrong = np.where(self._errors.mine, 1.0, off_share)[used[kept]]
        self.p_fault = float(weight @ wrong)
        self._read_names(rows, mates, P, t)
        for r, id in enumerate(rows):
            before = self._whole.get(id)
            whole = np.zeros(len(self._errors)) if before is None else before
            now = whole_of[r] + np.logaddexp.reduce(
                np.concatenate([np.zeros((len(used), 1)), ratio[r]], axis=1), axis=1
            )
            whole[used] = now
            self._whole[id] = whole
            for s, segment in enumerate(self._tracks[id].segments):
                mine = base[r][s] + np.logaddexp(0.0, np.logaddexp.reduce(each[r][s], axis=1))
                segment.weight = float(weight @ np.exp(np.minimum(mine - now, 0.0))[kept])
        self._learn_sizes(t)

    def _start_cov(self, mate: Teammate) -> Array:
        """(3, 3) m²: of where a teammate started, from where this drone did."""
        return np.asarray(mate.start_cov + (self._start_sigma**2 + START_LEAST_SIGMA_M**2) * np.eye(3))

    def _evidence(self, mate: Teammate, M: Array, cov: Array, used: NDArray[np.intp]) -> Array:
        """(n, k): `Marginal.log_evidence` of matrices M (n, 8, 8)."""
        marginal = Marginal(M, cov, self._errors.spreads, doubting=mate.doubting)
        return marginal.log_evidence(self._priors[mate.drone_id], self._errors, used, self._heading_sigma)

    def _awake(self) -> NDArray[np.intp]:
        """The components to work out now: those with weight, and a share of the sleepers."""
        parts = 1 if self._is_settled else SLEEPERS_PARTS_DOUBTFUL
        looked_at = (self._errors.part - self._part) % SLEEPERS_PARTS < parts
        self._part = (self._part + parts) % SLEEPERS_PARTS
        awake = (self._log_weight > LOG_SLEEPS) | looked_at
        awake[0] = True
        return np.flatnonzero(awake)

    def _settle(self, used: NDArray[np.intp], log_w: Array) -> None:
        """New weights of the components used; the others have none."""
        self.weight[:] = 0.0
        log_w = log_w - log_w.max()
        weight = np.exp(log_w)
        self.weight[used] = weight / weight.sum()
        self._log_weight[:] = -np.inf
        self._log_weight[used] = log_w

    def _worth_matching(self, R: Array, log_w: Array) -> NDArray[np.intp]:
        """The components that may have weight, by bounds: of (k, n, m) log ratios, and (k,) log weights without."""
        if not R.shape[1]:
            return np.flatnonzero(log_w > log_w.max() + LOG_SLEEPS)
        by_row = np.logaddexp(0.0, np.logaddexp.reduce(R, axis=2)).sum(axis=1)
        by_column = np.logaddexp(0.0, np.logaddexp.reduce(R, axis=1)).sum(axis=1)
        upper = log_w + np.minimum(by_row, by_column)
        left, lower = R.copy(), log_w.copy()
        k = np.arange(len(R))
        for _ in range(min(R.shape[1:])):
            best = left.reshape(len(R), -1).argmax(axis=1)
            n, m = np.divmod(best, R.shape[2])
            gain = left[k, n, m]
            lower += np.maximum(gain, 0.0)
            left[k, n, :] = -np.inf
            left[k, :, m] = -np.inf
        return np.flatnonzero(upper > lower.max() + LOG_SLEEPS)

    def _read_names(self, rows: Sequence[int], mates: Sequence[Teammate], P: Array, t: float) -> None:
        for r, id in enumerate(rows):
            p = {mate.drone_id: float(P[r, c]) for c, mate in enumerate(mates)}
            self.named[id] = named = Named(p, max(1.0 - float(P[r].sum()), 0.0))
            if named.likeliest[1] >= P_BELIEVED:
                self._sure_t[id] = t
        sure = (max(self.named[id].p_none, self.named[id].likeliest[1]) > P_SETTLED for id in rows)
        self._is_settled = bool(self.weight.max() > P_SETTLED) and all(sure)

    def _learn_sizes(self, t: float) -> None:
        """How large a named drone is, by where it is: a box a second; all its boxes share a part of their error."""
        for id, named in self.named.items():
            drone, p = named.likeliest
            mate = self.teammates.get(drone)
            scans = self._scans[self._tracks[id].camera]
            if p < P_SIZE_LEARNED or mate is None or t - mate.sized_t < BOX_LEARNED_EVERY_S:
                continue
            bearing = scans[-1].bearings.get(id) if scans else None
            if bearing is None:
                continue
            position, cov = self.place(id, drone, bearing.t)
            distance = float(np.linalg.norm(position))
            variance = float(position @ cov @ position) / distance**4 + BOX_SIZE_SIGMA_LN**2
            gain = mate.span_variance / (mate.span_variance + variance)
            mate.log_span += gain * (math.log(distance / bearing.distance) - mate.log_span)
            mate.span_variance = max((1.0 - gain) * mate.span_variance, BOX_SPAN_LEAST_SIGMA_LN**2)
            mate.sized_t = t

    def place(self, track_id: int, drone_id: int, t: float) -> tuple[Array, Array]:
        """Where a teammate is that is that track, at t: mean (3,) m from the own camera and covariance (3, 3), in the
        axes of the own rays: moments of the mixture."""
        mate, track = self.teammates[drone_id], self._tracks[track_id]
        best = max(range(len(track.segments)), key=lambda s: track.segments[s].weight)
        M = mate.told(t) + track.told(track.t).M[best, mate.column]
        assert self._start is not None
        place, sigma = mate.at(t)
        G = design((place - mate.start)[None], self._scans[track.camera][-1].origin - self._start)[0]
        marginal = Marginal(M[None], self._start_cov(mate), self._errors.spreads, doubting=mate.doubting)
        likely = np.argsort(-self.weight)[:3]
        log, mean, spread = [], [], []
        for k in likely[self.weight[likely] > 1e-3].tolist():
            for one in marginal.places(M, G, self._priors[drone_id], self._errors, k, self._heading_sigma):
                log.append(one.log_share + math.log(self.weight[k]))
                mean.append(one.mean)
                spread.append(one.cov)
        w = np.exp(np.array(log) - max(log))
        w /= w.sum()
        m = w @ np.array(mean)
        off = np.array(mean) - m
        cov = np.einsum("i,iab->ab", w, np.array(spread) + off[:, :, None] * off[:, None, :])
        return m, cov + sigma**2 * np.eye(3)
