"""Several explanations at once: a mixture of multi-Bernoullis, the K best global hypotheses over all tracks.

Theory of operation. Where two drones cross, one scan does not show which is which; a few scans later it is clear. So a
decision is put off: each scan continues every global hypothesis (what each track has made until now) in the most
likely ways, the K best of all are kept, and what is published is the best one. A target exists with a probability of
its own under each hypothesis (Bernoulli), new ones appear anywhere (Poisson): the filter of Williams, "Marginal
multi-Bernoulli filters" (IEEE T-AES 51(3), 2015) and García-Fernández et al. (2018), with three economies:

* Hypotheses are kept for *clusters* of tracks in dispute. A track whose detection no other track wants, and of which
  there is no doubt, is settled: it has one leaf, and all of these are updated in one stroke.
* Tentative tracks have one leaf each. They choose after the confirmed ones among what those left, so a false start
  neither multiplies the hypotheses nor takes a drone's detection away.
* Leaves of one track that have come to say the same are one.

It is no full Poisson multi-Bernoulli mixture (PMBM): the intensity of targets that were never detected is not carried
on from scan to scan, births have a constant rate.

Each leaf moves by an interacting mix of a calm model and one or two agile ones (manoeuvre.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking import clusters, lifecycle, manoeuvre
from swarmtrack.tracking.association import most_likely_matching
from swarmtrack.tracking.base import Explained, Filter
from swarmtrack.tracking.clusters import Cluster
from swarmtrack.tracking.hypotheses import UNDETECTED, best_matchings
from swarmtrack.tracking.manoeuvre import (
    AS_TOLD,
    PLACE_OF_AGILE,
    AgileLevel,
    Manoeuvres,
    ModeInnovations,
    ModeMixture,
)
from swarmtrack.tracking.motion_model import POSITION, Course, FadingAcceleration
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.passage import Passage
from swarmtrack.tracking.population import Population, blend_sizes
from swarmtrack.tracking.priors import (
    LARGEST_CLAIM_LOG_RATIO,
    LONE_DETECTION_EXISTENCE,
    MAX_EXISTENCE,
    MBM_GENTLE_MANOEUVRE_SHARE,
    MBM_LEAST_AVAILABLE,
    MBM_LEAST_OVERLAP,
    MBM_ORDINARY_FLOW_PX,
    MBM_SAME_LEAF_SIGMAS,
    MIN_CONFIRMED_EXISTENCE,
)
from swarmtrack.tracking.sensor_model import Measurements, SensorModel, Visibility
from swarmtrack.tracking.table import TrackIds, TrackTable
from swarmtrack.tracking.target_motion import TURNS

Indices = NDArray[np.intp]


@dataclass(frozen=True, slots=True, kw_only=True)
class MbmParameters(CommonParameters):
    """In addition to the common ones: how many hypotheses, and how targets manoeuvre."""

    gate_probability: float = 0.99999
    """Probability that a true detection falls inside its target's gate. Wide on purpose: at the onset of a manoeuvre a
    target is where no model expects it, and the hypotheses weigh what fits badly."""
    hypotheses: int = 20
    """Hypotheses kept per cluster of disputed tracks. 1 keeps only the most likely one."""
    least_weight: float = 1e-4
    """A hypothesis whose weight relative to the best is below this is dropped."""
    changeover: float = 10.0
    """Another hypothesis is published only once it is this many times as likely as the published one."""
    doubt_s: float = 10.0
    """Time constant with which hypotheses other than the published one fade, s. After two drones have met and parted,
    no later detection separates them. Without fading they would stay disputed for the rest of the
    flight."""
    interacting: bool = True
    """Use two motion models. If false: constant velocity with `acceleration_psd`, as in the other trackers."""
    calm_share: float = 0.1
    """Factor on `acceleration_psd` while a target keeps its velocity."""
    agile_share: float = 15.0
    """Factor on `acceleration_psd` while it manoeuvres."""
    gentle_share: float = 0.06
    """With `learn_noise = "both"`, nine manoeuvres in ten are gentle: their `acceleration_psd` is that of hard ones
    times this, and so is the variance of their targets' speed at birth. 1: all are hard."""
    lasting_s: float = 2.0
    """How long an acceleration lasts, s."""
    hard_s: float = 0.5
    """Likewise in a hard manoeuvre, where there are gentle ones too (`gentle_share`). Harder accelerations last less
    long: 9 m/s² for two seconds is no flight of a drone that stays in view."""
    calm_s: float = 4.0
    """How long a target keeps its velocity on average, s."""
    agile_s: float = 3.0
    """How long it manoeuvres on average, s."""

    def __post_init__(self) -> None:
        # Not super(): dataclass(slots=True) makes a new class, and zero-argument super() would look for the old one.
        CommonParameters.__post_init__(self)
        if self.profile == "paper":
            raise ValueError("tracker.profile: found 'paper', expected 'default': the paper has no mbm")
        if not (isinstance(self.hypotheses, int) and self.hypotheses >= 1):
            raise ValueError(
                f"tracker.hypotheses: found {self.hypotheses!r}, expected a whole number from 1 on"
            )
        for name in ("least_weight", "calm_share", "gentle_share"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(
                    f"tracker.{name}: found {getattr(self, name)!r}, expected a number in 0…1, not 0"
                )
        if not self.changeover >= 1.0:
            raise ValueError(f"tracker.changeover: found {self.changeover!r}, expected a number from 1 on")
        for name in ("doubt_s", "agile_share", "lasting_s", "hard_s", "calm_s", "agile_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(
                    f"tracker.{name}: found {getattr(self, name)!r}, expected a finite number above 0"
                )

    @property
    def has_calm_model(self) -> bool:
        return self.interacting

    @property
    def _levels(self) -> tuple[AgileLevel, ...]:
        if self.learn_noise != "both" or self.gentle_share == 1.0:
            return AS_TOLD
        gentle = MBM_GENTLE_MANOEUVRE_SHARE
        hard = AgileLevel(1.0, 1.0 - gentle, self.hard_s / self.lasting_s)
        return AgileLevel(self.gentle_share, gentle), hard

    @property
    def manoeuvres(self) -> Manoeuvres:
        if not self.interacting:
            return Manoeuvres(
                agile_psd=self.acceleration_psd,
                calm_psd=self.acceleration_psd,
                lasting_s=self.lasting_s,
                calm_s=1e9,
                agile_s=1e-3,
            )
        return Manoeuvres(
            agile_psd=self.agile_share * self.acceleration_psd,
            calm_psd=self.calm_share * self.acceleration_psd,
            levels=self._levels,
            lasting_s=self.lasting_s,
            calm_s=self.calm_s,
            agile_s=self.agile_s,
        )


class Leaves(NamedTuple):
    """Single-target hypotheses, a row each, those of a track together. owner (n,): row of its track in the table;
    existence (n,); size (n, 2) px."""

    owner: Indices
    motion: ModeMixture
    existence: Array
    size: Array

    def select(self, rows: Indices) -> Leaves:
        return Leaves(
            self.owner.take(rows),
            self.motion.select(rows),
            self.existence.take(rows),
            self.size.take(rows, axis=0),
        )


class Merging(NamedTuple):
    """Merged detections for L leaves of n tracks and m detections: p (L, m), that a detection is one of two
    targets; shift (n, 2, 2) px²: how far it then lies off.
    """

    p: Array
    shift: Array


class Weighed(NamedTuple):
    """A scan of m detections as L leaves of n tracks see it.

    visibility: of the tracks; merging: None where all are resolved; misdrawn (L, m): that a detection, as the leaf's,
    was drawn round something else as well, None if unknown; ratio (L, m): log-likelihood of a detection as the leaf's
    over its being clutter; gain (L, m): of having made it, over having made none; missed (L,): log-probability of
    having made none.
    """

    visibility: Visibility
    merging: Merging | None
    misdrawn: Array | None
    ratio: Array
    gain: Array
    missed: Array


class Association(NamedTuple):
    """Associations of one scan: row (…,) of each leaf, and column (…,) of its detection or `UNDETECTED`."""

    leaf: Indices
    column: Indices


class Explanation(NamedTuple):
    """How confirmed tracks explain a scan. settled: the association of those beyond doubt; disputed: the clusters
    of the others, with the columns (h, k) of their leaves; taken (m,): how surely one of them made each
    detection.
    """

    settled: Association
    disputed: list[tuple[Cluster, Indices]]
    taken: Array


class Mbm(Filter):
    """K best global hypotheses over confirmed tracks, in clusters; one for tentative ones."""

    Parameters: ClassVar[type[CommonParameters]] = MbmParameters

    def __init__(self, sensor: SensorModel, parameters: MbmParameters, ids: TrackIds) -> None:
        self._sensor = sensor
        self._parameters = parameters
        self._manoeuvres = parameters.manoeuvres
        self._turn = TURNS[parameters.profile]
        self._ordinary = (MBM_ORDINARY_FLOW_PX / sensor.camera.fx) ** 2
        self._depth = -math.log(parameters.least_weight)
        self._population = Population(sensor, parameters, ids)
        nobody = manoeuvre.begun(np.empty((0, 4)), np.empty((0, 4, 4)), self._manoeuvres)
        self.leaves = Leaves(np.empty(0, np.intp), nobody, np.empty(0), np.empty((0, 2)))
        self.best: Indices = np.empty(0, np.intp)  # of each track, its leaf in the best hypothesis
        self.clusters: list[Cluster] = []
        self.counters: dict[str, int] = {"hypotheses_cut": 0}

    @property
    def table(self) -> TrackTable:
        return self._population.table

    def initiate(self, t: float, points: Array) -> list[int]:
        ids = self._population.initiate(t, points)
        self._grow_leaves()
        return ids

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None:
        leaves, scale = self.leaves, self._sensor.noise.motion
        motion = manoeuvre.predict(
            leaves.motion,
            dt,
            self._manoeuvres.calmed(scale),
            camera=self._sensor.camera,
            rotation=rotation,
            rotation_variance=self._learned(rotation_variance),
            turn=self._turn,
        )
        existence = lifecycle.survive(leaves.existence, dt, self._parameters.p_survival)
        self.leaves = leaves._replace(motion=motion, existence=existence)
        self.clusters = [clusters.faded(cluster, dt / self._parameters.doubt_s) for cluster in self.clusters]
        self._population.survive(dt)
        self._show_best()

    def course(self) -> Course:
        published, manoeuvres = self._published(), self._manoeuvres
        return Course(
            self.table.mean,
            self.table.cov,
            psd=published.mode @ manoeuvres.calmed(self._sensor.noise.motion).psd,
            camera=self._sensor.camera,
            turn=self._turn,
            drift=FadingAcceleration(
                manoeuvre.mean_acceleration(published),
                partial(manoeuvre.acceleration_reach, manoeuvres=manoeuvres),
            ),
            gyro_error=self._learned,
        )

    def release(
        self, rows: NDArray[np.bool_], dt: float, rotation: Array | None, rotation_variance: float
    ) -> Passage:
        """Replace a disputed track's hypotheses by its published one; the other tracks keep theirs."""
        motion = manoeuvre.predict(
            self._published().select(np.flatnonzero(rows)),
            dt,
            self._manoeuvres.calmed(self._sensor.noise.motion),
            camera=self._sensor.camera,
            rotation=rotation,
            rotation_variance=self._learned(rotation_variance),
            turn=self._turn,
        )
        leaving = self._population.release(rows, dt)
        leaving.mean, leaving.cov = manoeuvre.merged(motion)
        self._keep_rows(~rows)
        return Passage(leaving, motion)

    def copied(self, rows: NDArray[np.bool_]) -> Passage:
        """The published hypothesis of disputed tracks."""
        return Passage(self.table.select(rows), self._published().select(np.flatnonzero(rows)))

    def adopt(self, arriving: Passage) -> None:
        self.table.append(arriving.table)
        self._grow_leaves(arriving.motion)

    def _learned(self, rotation_variance: float) -> float:
        """What the gyro ordinarily does not know of a turn is learned with the motion's noise; a gap in it is not."""
        ordinary = min(rotation_variance, self._ordinary)
        return self._sensor.noise.motion * ordinary + rotation_variance - ordinary

    def update(self, t: float, measured: Measurements) -> Explained:
        self._drop(t)
        weighed = self._weigh(measured)
        column = self._undoubted(weighed)
        if column is not None:
            explained = self._go_on_settled(t, measured, weighed, column)
        else:
            explanation = self._explain_confirmed(weighed)
            started = self._explain_tentative(weighed, explanation.taken)
            explained = self._go_on(t, measured, weighed, explanation, started)
        self._drop(t)
        return explained

    # --- what the scan says -------------------------------------------------------------------------

    def _weigh(self, measured: Measurements) -> Weighed:
        table, leaves = self.table, self.leaves
        visibility = self._sensor.visibility(table.mean, table.cov, table.size, table.existence)
        boxes = self._sensor.box_likelihoods(leaves.size, measured)
        ratio, misdrawn = self._with_outliers(boxes, measured)
        merging = None
        if ratio.size and visibility.overlap is not None:
            ratio, merging = self._with_merged(ratio, boxes, visibility.overlap, measured)
        p_detected = leaves.existence * visibility.p_detection.take(leaves.owner)
        missed = np.log1p(-p_detected)
        with np.errstate(divide="ignore"):
            gain = ratio + (np.log(p_detected) - missed)[:, None]
        # To confirmed tracks the tentative ones are more clutter, as much as they claim: else a track that was lost
        # would sooner or later be found in whatever looks a little like a drone, again and again.
        confirmed = table.confirmed[leaves.owner]
        if not confirmed.all():
            claim = np.exp(np.minimum(ratio[~confirmed], LARGEST_CLAIM_LOG_RATIO))
            gain[confirmed] -= np.log1p(p_detected[~confirmed] @ claim)
        gain[gain < -self._depth] = -np.inf  # to have made none is likelier by more than what is kept
        return Weighed(visibility, merging, misdrawn, ratio, gain, missed)

    def _log_ratio(self, boxes: Array, measured: Measurements, shift: Array | None = None) -> Array:
        """(…, L, m) by all modes, … that of measured.R; boxes (L, m): see `SensorModel.box_likelihoods`; shift (n, 2,
        2) px² of each track's detections."""
        mean, cov, mode = self.leaves.motion
        if shift is not None:
            cov = cov.copy()
            cov[:, :, PLACE_OF_AGILE, PLACE_OF_AGILE] += shift[self.leaves.owner][:, None]
        by_mode = self._sensor.likelihoods(
            mean.reshape(-1, 6), cov.reshape(-1, 6, 6), boxes.repeat(mode.shape[1], axis=0), measured
        ).log_ratio
        by_mode = (
            by_mode.reshape(*by_mode.shape[:-2], *mode.shape, len(measured.z)) + np.log(mode)[:, :, None]
        )
        return np.asarray(np.logaddexp.reduce(by_mode, axis=-2))

    def _with_outliers(self, boxes: Array, measured: Measurements) -> tuple[Array, Array | None]:
        """The log-ratios (L, m) where some detections are off by more than their noise; and how likely each is
        misdrawn, where that is known (L, m).

        Else only who made what is so asked: a box that jumps is still the target's. The update follows it, as it would
        with the noise that was told, whose gain is no smaller.
        """
        outliers = measured.outliers
        if outliers is None:
            return self._log_ratio(boxes, measured), None
        both = np.concatenate([measured.R[None], outliers.R[None]])
        ratio, wide = self._log_ratio(boxes, measured._replace(R=both))
        wide += np.log(outliers.share)
        total = np.logaddexp(np.log1p(-outliers.share) + ratio, wide)
        if not outliers.misdrawn:
            return total, None
        with np.errstate(invalid="ignore"):
            return total, np.where(total > -np.inf, np.exp(wide - total), 0.0)

    def _with_merged(
        self, ratio: Array, boxes: Array, overlap: Array, measured: Measurements
    ) -> tuple[Array, Merging]:
        """Where a detection may also be one of two targets: the log-ratios (L, m), and how they may merge.

        Two explanations stay two. As one wide noise they would tell a sharp track to ignore a sharp detection, because
        of a neighbour that it is merged with once in twenty scans.
        """
        overlap = overlap * self.table.existence
        shift = self._shift_of_merged(overlap)
        p = (1.0 - (1.0 - self._alone_in_scan(ratio)[None] * overlap[:, :, None]).prod(axis=1))[
            self.leaves.owner
        ]
        p[p < self._parameters.least_weight] = 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            merged = np.log(p) + self._log_ratio(boxes, measured, shift)
            total = np.logaddexp(np.log1p(-p) + ratio, merged)
            return total, Merging(np.where(total > -np.inf, np.exp(merged - total), 0.0), shift)

    def _alone_in_scan(self, ratio: Array) -> NDArray[np.bool_]:
        """(n, m) whether a track has no other detection that is rather its own than clutter: who has, was not merged
        into this one."""
        first = np.searchsorted(self.leaves.owner, np.arange(len(self.table)))
        own = np.maximum.reduceat(ratio, first, axis=0) > 0.0
        return np.asarray(own.sum(axis=1, keepdims=True) - own == 0)

    def _shift_of_merged(self, overlap: Array) -> Array:
        """(n, 2, 2) px²: a detection of two targets lies between them, half their distance off. They are no further
        apart than what is not resolved, whatever the tracks say, which may have been lost."""
        position = self.table.mean[:, POSITION]
        resolution = self._sensor.resolutions(self.table.mean, self.table.size)
        reach = 0.25 * (resolution[None] + resolution[:, None])
        half = np.clip(0.5 * (position[None] - position[:, None]), -reach, reach)
        share = overlap / np.maximum(overlap.sum(axis=1, keepdims=True), MBM_LEAST_OVERLAP)
        return np.asarray((share[:, :, None] * half).swapaxes(1, 2) @ half)

    # --- who made what ------------------------------------------------------------------------------

    def _explain_confirmed(self, weighed: Weighed) -> Explanation:
        (confirmed,) = self.table.confirmed.nonzero()
        taken = np.zeros(weighed.gain.shape[1])
        if not len(confirmed):
            return Explanation(Association(confirmed, confirmed), [], taken)
        alone, groups = self._groups(confirmed, weighed)
        settled, doubtful = self._settle(self.best.take(alone), weighed)
        taken[settled.column[settled.column >= 0]] = 1.0

        disputed = []
        for tracks in [*groups, *self.leaves.owner[doubtful][:, None]]:
            cluster, column = self._explain_cluster(self._cluster_of(tracks), weighed)
            disputed.append((cluster, column))
            for track in range(column.shape[1]):
                made = column[:, track] >= 0
                np.add.at(taken, column[made, track], cluster.weight[made])
        return Explanation(settled, disputed, taken)

    def _groups(self, confirmed: Indices, weighed: Weighed) -> tuple[Indices, list[Indices]]:
        """Tracks with one leaf whose detections nobody else wants; and the others, by what they have to do with each
        other."""
        wanted = self._wanted(weighed).take(confirmed, axis=0)
        by_several = wanted.sum(axis=0) > 1
        if not (self.clusters or by_several.any()):
            return confirmed, []
        shared = wanted[:, by_several]
        label = clusters.components(self._related(confirmed, shared))
        alone = np.bincount(label, minlength=len(label))[label] == 1
        for cluster in self.clusters:
            alone[np.searchsorted(confirmed, cluster.tracks)] = False
        others, label = confirmed[~alone], label[~alone]
        return confirmed[alone], [others[label == first] for first in np.unique(label)]

    def _wanted(self, weighed: Weighed) -> NDArray[np.bool_]:
        """(n, m) detections that some leaf of a track may have made."""
        wanted = weighed.gain > -np.inf
        if not self.clusters:
            return wanted
        first = np.searchsorted(self.leaves.owner, np.arange(len(self.table)))
        return np.asarray(np.logical_or.reduceat(wanted, first, axis=0))

    def _related(self, confirmed: Indices, shared: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(n, n) confirmed tracks that want the same of the shared detections (n, s), or that are in dispute
        already."""
        related = np.eye(len(confirmed), dtype=np.bool_)
        if shared.shape[1]:
            related |= shared @ shared.T
        for cluster in self.clusters:
            rows = np.searchsorted(confirmed, cluster.tracks)
            related[np.ix_(rows, rows)] = True
        return related

    def _settle(self, leaves: Indices, weighed: Weighed) -> tuple[Association, Indices]:
        """Of tracks with one leaf (k,) whose detections nobody else wants: the association of those where one
        explanation is beyond doubt, and the leaves of the others."""
        m = weighed.gain.shape[1]
        options = np.zeros((len(leaves), m + 1))
        options[:, :m] = weighed.gain.take(leaves, axis=0)
        choice = options.argmax(axis=1)
        best = options.max(axis=1)
        clear = (options > (best - self._depth)[:, None]).sum(axis=1) == 1
        column = np.where(choice < m, choice, UNDETECTED)
        if clear.all():
            return Association(leaves, column), leaves[:0]
        return Association(leaves[clear], column[clear]), leaves[~clear]

    def _cluster_of(self, tracks: Indices) -> Cluster:
        """One cluster of all that is known about these tracks."""
        involved = [cluster for cluster in self.clusters if cluster.tracks[0] in tracks]
        known = {int(track) for cluster in involved for track in cluster.tracks}
        settled = np.array([track for track in tracks if track not in known], dtype=np.intp)
        if len(settled):
            involved.append(Cluster(settled, self.best[settled][None], np.zeros(1)))
        whole = involved[0]
        for cluster in involved[1:]:
            whole = clusters.product(whole, cluster, self._parameters.hypotheses)
        return whole

    def _explain_cluster(self, cluster: Cluster, weighed: Weighed) -> tuple[Cluster, Indices]:
        """Its hypotheses continued by this scan, still with the leaves they come from; and those leaves' columns (h,
        k)."""
        gain = weighed.gain[cluster.leaf]
        columns = np.flatnonzero((gain > -np.inf).any(axis=(0, 1)))
        prior_weight = cluster.log_weight + weighed.missed[cluster.leaf].sum(axis=1)
        best = best_matchings(
            prior_weight, gain[:, :, columns], self._parameters.hypotheses, self._parameters.least_weight
        )
        self.counters["hypotheses_cut"] += not best.complete
        column = np.where(best.column >= 0, np.append(columns, UNDETECTED)[best.column], UNDETECTED)
        # Where two stories are as likely, the one that was told goes on: who is who must not change from scan to scan.
        told_so_far = best.prior == cluster.shown
        likely = best.log_weight >= best.log_weight[0] - math.log(self._parameters.changeover)
        continued = Cluster(
            cluster.tracks,
            cluster.leaf[best.prior],
            clusters.normalised(best.log_weight),
            int((told_so_far & likely).argmax()),
        )
        return continued, column

    def _explain_tentative(self, weighed: Weighed, taken: Array) -> Association:
        """Each makes the detection, or none, that together is most likely of what the confirmed ones left."""
        leaves = self.best[~self.table.confirmed]
        if not len(leaves):
            return Association(leaves, leaves)
        left = np.flatnonzero(taken < 1.0 - MBM_LEAST_AVAILABLE)
        p_detection = weighed.visibility.p_detection[self.leaves.owner[leaves]]
        with np.errstate(divide="ignore"):
            odds = np.log(p_detection / (1.0 - p_detection))
        ratio = weighed.ratio[leaves[:, None], left] + odds[:, None] + np.log(1.0 - taken[left])
        rows, columns = most_likely_matching(ratio)
        column = np.full(len(leaves), UNDETECTED)
        column[rows] = left[columns]
        return Association(leaves, column)

    def _undoubted(self, weighed: Weighed) -> Indices | None:
        """(n,) the detection of each track, where all are confirmed, each has the only one in its gate, nobody else
        wants it, and to have made it is beyond doubt; else None. Most scans of a settled flight are so."""
        n, m = weighed.ratio.shape
        if self.clusters or m != n or not n or not self.table.confirmed.all():
            return None
        gated = weighed.ratio > -np.inf
        if np.count_nonzero(gated) != n:
            return None
        column: Indices = gated.argmax(axis=1)
        if len(set(column.tolist())) != n or weighed.gain[np.arange(n), column].min() < self._depth:
            return None
        return column

    # --- what becomes of it -------------------------------------------------------------------------

    def _go_on(
        self,
        t: float,
        measured: Measurements,
        weighed: Weighed,
        explanation: Explanation,
        started: Association,
    ) -> Explained:
        """The leaves, hypotheses and tracks after the scan; births from what nobody made."""
        _, disputed, taken = explanation
        associations = [Association(cluster.leaf, column) for cluster, column in disputed]
        told, rows = _distinct([explanation.settled, started, *associations], *weighed.gain.shape)
        leaves, fit = self._continued(told, measured, weighed, taken)
        undisputed = np.concatenate(rows[:2])
        continued = [
            cluster._replace(leaf=leaf) for (cluster, _), leaf in zip(disputed, rows[2:], strict=True)
        ]
        alone = self._alone(weighed)
        if self._parameters.learn_noise == "both" and self.clusters:
            alone |= self._alone_in_dispute(weighed) & np.isnan(measured.size[:, 0])
        (hit,) = (told.column >= 0).nonzero()
        owner, column = leaves.owner.take(hit), told.column.take(hit)
        (sure,) = alone[told.leaf.take(hit), column].nonzero()
        pairs = fit.pairs(self.table.id.take(owner), column, sure)
        tentative = ~self.table.confirmed.take(owner)
        free = 1.0 - taken
        clutter = free.sum()
        if tentative.any():
            free[column[tentative]] = 0.0
            clutter = free.sum() + (1.0 - leaves.existence[hit[tentative]]).sum()

        shown = self._keep(leaves, undisputed, continued)
        published = Association(told.leaf.take(shown), told.column.take(shown))
        self._show_best()
        self._weigh_existence(published, weighed, taken)
        seen = published.column >= 0
        self._population.learn_likeness(t, seen, measured.likeness.take(published.column[seen]))
        self._population.update_status(t, seen, weighed.visibility)
        made = _made(seen, disputed)
        if self._parameters.learn_noise == "both":  # else what was told of survival and clutter is known
            self._population.credit(t, made)
        self._population.excuse(t, made, weighed.visibility)
        if (free > 0.5).any():
            free[self._population.shadowed(t, measured, seen)] = 0.0
            self._population.give_birth(t, measured.select(free > 0.5))
            self._grow_leaves()
        return Explained(pairs, float(clutter))

    def _go_on_settled(
        self, t: float, measured: Measurements, weighed: Weighed, column: Indices
    ) -> Explained:
        """As `_go_on` where each track has made its detection: there is one leaf of each, no other explanation, and
        nothing is left to be born."""
        n, leaves, table = len(column), self.leaves, self.table
        every = np.arange(n)
        told = Association(every, column)
        (sure,) = (leaves.existence > LONE_DETECTION_EXISTENCE).nonzero()
        motion, size, fit = self._updated(told, leaves.motion, leaves.size, measured, weighed)
        self.leaves = Leaves(every, motion, np.full(n, MAX_EXISTENCE), size)
        self._show_best()
        p_detection, ratio = weighed.visibility.p_detection, weighed.ratio[every, column]
        likelihood = 1.0 - p_detection + p_detection * np.exp(np.minimum(ratio, LARGEST_CLAIM_LOG_RATIO))
        table.existence = lifecycle.reweigh(table.existence, likelihood)
        population = self._population
        population.learn_likeness(t, slice(None), measured.likeness.take(column))
        population.update_status(t, np.ones(n, np.bool_), weighed.visibility)
        if self._parameters.learn_noise == "both":
            # As `credit` says of who surely made one.
            table.last_seen = np.full(n, t)
        population.excuse(t, np.ones(n), weighed.visibility)
        return Explained(fit.pairs(table.id, column, sure), 0.0)

    def _alone(self, weighed: Weighed) -> NDArray[np.bool_]:
        """(L, m) detections in the gate of one confirmed track only, which has one leaf, and no other in it: it
        surely made them, however badly they fit."""
        gated = weighed.ratio > -np.inf
        gated &= self.table.confirmed[self.leaves.owner][:, None]
        gated &= (gated.sum(axis=1, keepdims=True) == 1) & (gated.sum(axis=0) == 1)
        gated[self.leaves.existence <= LONE_DETECTION_EXISTENCE] = False
        return gated

    def _alone_in_dispute(self, weighed: Weighed) -> NDArray[np.bool_]:
        """(L, m) detections that by all hypotheses are in the gate of one confirmed track only, and no other in it;
        of its leaves the published one says how well they fit. In clutter every track has a leaf that was missed, and
        nothing would ever be learned. Only of points: the box of a track in dispute may be one around two drones, or
        around a part of one, and from such boxes a noise is learned that loses names in rendered flights.
        """
        table, leaves = self.table, self.leaves
        gated = self._gated(weighed) & table.confirmed[:, None]
        gated &= (gated.sum(axis=1, keepdims=True) == 1) & (gated.sum(axis=0) == 1)
        alone = np.zeros_like(weighed.ratio, np.bool_)
        alone[self.best] = gated & (weighed.ratio[self.best] > -np.inf)
        alone[leaves.existence <= LONE_DETECTION_EXISTENCE] = False
        return alone

    def _gated(self, weighed: Weighed) -> NDArray[np.bool_]:
        """(n, m) detections in the gate of some leaf of a track."""
        first = np.searchsorted(self.leaves.owner, np.arange(len(self.table)))
        return np.asarray(np.logical_or.reduceat(weighed.ratio > -np.inf, first, axis=0))

    def _continued(
        self, told: Association, measured: Measurements, weighed: Weighed, taken: Array
    ) -> tuple[Leaves, ModeInnovations]:
        """The leaves after the scan, and of those that made a detection how well it fitted."""
        before = self.leaves.select(told.leaf)
        (hit,) = (told.column >= 0).nonzero()
        leaf, column, owner = told.leaf.take(hit), told.column.take(hit), before.owner
        motion, size = before.motion, before.size
        updated, seen_size, fit = self._updated(
            Association(leaf, column), motion.select(hit), size.take(hit, axis=0), measured, weighed
        )
        for old, new in zip((*motion, size), (*updated, seen_size), strict=True):
            old[hit] = new  # `select` made copies

        p_detection = weighed.visibility.p_detection.take(owner)
        likelihood = 1.0 - p_detection
        likelihood[hit] += (
            p_detection.take(hit) * np.exp(weighed.ratio[leaf, column]) * (1.0 - taken.take(column))
        )
        existence = lifecycle.reweigh(before.existence, likelihood)
        confirmed = self.table.confirmed.take(owner)
        existence = np.maximum(existence, np.where(confirmed, MIN_CONFIRMED_EXISTENCE, 0.0))
        # The hypotheses' weights tell whether it made it.
        existence[hit[confirmed.take(hit)]] = MAX_EXISTENCE
        return Leaves(owner, motion, existence, size), fit

    def _updated(
        self,
        made: Association,
        motion: ModeMixture,
        size: Array,
        measured: Measurements,
        weighed: Weighed,
    ) -> tuple[ModeMixture, Array, ModeInnovations]:
        """Leaves (k,) of these motions and box sizes (k, 2) px after the detections that they made: motion and sizes,
        and how well it fitted."""
        leaf, column = made
        R = measured.R.take(column, axis=0)
        drawn_well: float | Array = 1.0
        if weighed.misdrawn is not None and measured.outliers is not None:
            # A mixture of two noises that differ in scale, as one: by their information (West, "On scale mixtures of
            # normal distributions", 1987), which is what an outlier has little of.
            drawn_well = 1.0 - weighed.misdrawn[leaf, column][:, None]
            wide, share = np.linalg.inv(measured.outliers.R.take(column, axis=0)), drawn_well[:, :, None]
            R = np.linalg.inv(share * np.linalg.inv(R) + (1.0 - share) * wide)
        if weighed.merging is not None:
            p, shift = weighed.merging
            owner = self.leaves.owner.take(leaf)
            R += p[leaf, column][:, None, None] * shift.take(owner, axis=0)
        updated, fit = manoeuvre.update(motion, measured.z.take(column, axis=0), R)
        return updated, blend_sizes(size, measured.size.take(column, axis=0), drawn_well), fit

    def _weigh_existence(self, shown: Association, weighed: Weighed, taken: Array) -> None:
        """Of each track, as its published association tells it; under other hypotheses its target may be another's.
        Tentative ones have what confirmed ones left of a detection."""
        p_detection = weighed.visibility.p_detection
        likelihood = 1.0 - p_detection
        (hit,) = (shown.column >= 0).nonzero()
        leaf, column = shown.leaf.take(hit), shown.column.take(hit)
        ratio = weighed.ratio[leaf, column]
        left = np.where(self.table.confirmed.take(hit), 1.0, 1.0 - taken.take(column))
        likelihood[hit] += p_detection.take(hit) * np.exp(np.minimum(ratio, LARGEST_CLAIM_LOG_RATIO)) * left
        self.table.existence = lifecycle.reweigh(self.table.existence, likelihood)

    def _keep(self, leaves: Leaves, settled: Indices, continued: list[Cluster]) -> Indices:
        """From now on: these leaves as far as somebody refers to them, and what is still in dispute. Returns of each
        track the row of the leaf that is published, among those given."""
        best = np.full(len(self.table), UNDETECTED)
        best[leaves.owner[settled]] = settled
        if not continued:  # one leaf a track, in the table's order
            self.leaves, self.best, self.clusters = leaves, best, []
            return best
        disputed = []
        for cluster in continued:
            unique = clusters.merged(_without_doubles(cluster, leaves))
            best[unique.tracks] = unique.leaf[unique.shown]
            left = clusters.in_dispute(unique)
            if left is not None:
                disputed.append(left)
        kept = np.unique(np.concatenate([best, *(cluster.leaf.ravel() for cluster in disputed)]))
        self.leaves = leaves.select(kept)
        self.best = np.searchsorted(kept, best)
        self.clusters = [cluster._replace(leaf=np.searchsorted(kept, cluster.leaf)) for cluster in disputed]
        return best

    def _show_best(self) -> None:
        """The table's rows are the leaves of the best hypothesis."""
        table = self.table
        table.mean, table.cov = manoeuvre.merged(self._published())
        table.size = self.leaves.size.take(self.best, axis=0)

    def _published(self) -> ModeMixture:
        """Of each track, the leaf of the best hypothesis; the only one where nothing is in dispute."""
        motion = self.leaves.motion
        return motion.select(self.best) if self.clusters else motion

    def _grow_leaves(self, motion: ModeMixture | None = None) -> None:
        """One for each row that the table has gained; motion: what is known of these beside what the table says."""
        table, leaves = self.table, self.leaves
        new = np.arange(len(self.best), len(table))
        if not len(new):
            return
        if motion is None:
            motion = manoeuvre.begun(table.mean[new], table.cov[new], self._manoeuvres)
            table.mean[new], table.cov[new] = manoeuvre.merged(motion)
        born = Leaves(
            new,
            motion,
            table.existence[new],
            table.size[new],
        )
        self.best = np.concatenate([self.best, len(leaves.owner) + np.arange(len(new))])
        self.leaves = Leaves(
            np.concatenate([leaves.owner, born.owner]),
            manoeuvre.joined(leaves.motion, born.motion),
            np.concatenate([leaves.existence, born.existence]),
            np.concatenate([leaves.size, born.size]),
        )

    def _drop(self, t: float) -> None:
        """Tracks end."""
        kept = self._population.drop(t)
        if kept is not None:
            self._keep_rows(kept)
        if self.clusters and self.table.lost.any():
            self._settle_lost()

    def _settle_lost(self) -> None:
        """A lost track goes on as published, where the image plane no longer holds one of its other hypotheses."""
        held = self._population.holds(*manoeuvre.merged(self.leaves.motion))
        disputed = self.table.lost & (np.bincount(self.leaves.owner[~held], minlength=len(self.table)) > 0)
        if disputed.any():
            self.adopt(self.release(disputed, 0.0, None, 0.0))

    def _keep_rows(self, kept: NDArray[np.bool_]) -> None:
        """The table's other rows (n,) have gone: with them their leaves go, and their part in hypotheses."""
        row = np.cumsum(kept) - 1  # of each track that stays
        staying = kept[self.leaves.owner]
        leaves = self.leaves.select(np.flatnonzero(staying))
        leaf = np.cumsum(staying) - 1
        best = leaf[self.best[kept]]
        remaining = []
        for cluster in self.clusters:
            stay = kept[cluster.tracks]
            if stay.any():
                remaining.append(
                    cluster._replace(tracks=row[cluster.tracks[stay]], leaf=leaf[cluster.leaf[:, stay]])
                )
        self._keep(leaves._replace(owner=row[leaves.owner]), best, remaining)


def _distinct(associations: list[Association], count: int, m: int) -> tuple[Association, list[Indices]]:
    """What `count` leaves make of m detections in any of these associations, once each and ordered by leaf; and for
    each of the given ones its rows among them."""
    if len(associations) == 2:  # nothing is in dispute: each leaf is the only one of its track
        settled, started = associations
        column = np.empty(count, np.intp)
        column[settled.leaf], column[started.leaf] = settled.column, started.column
        return Association(np.arange(count), column), [settled.leaf, started.leaf]
    told = np.zeros((count, m + 1), np.bool_)
    for leaf, column in associations:
        told[leaf, column + 1] = True
    row = told.cumsum().reshape(told.shape) - 1
    leaf, column = told.nonzero()
    return Association(leaf, column - 1), [row[leaf, column + 1] for leaf, column in associations]


def _made(seen: NDArray[np.bool_], disputed: list[tuple[Cluster, Indices]]) -> Array:
    """(n,) how surely each track made a detection: by all hypotheses where it is in dispute, else whether it did."""
    made = seen.astype(float)
    for cluster, column in disputed:
        made[cluster.tracks] = cluster.weight @ (column >= 0)
    return made


def _without_doubles(cluster: Cluster, leaves: Leaves) -> Cluster:
    """Leaves of a track that say the same become the one that is published, or else the likeliest of them."""
    rows, inverse = np.unique(cluster.leaf, return_inverse=True)
    weight = np.bincount(inverse.ravel(), np.repeat(cluster.weight, len(cluster.tracks)))
    weight[np.searchsorted(rows, cluster.leaf[cluster.shown])] += 1.0
    likeliest = np.argsort(-weight, kind="stable")
    mean, cov = manoeuvre.merged(leaves.motion.select(rows[likeliest]))
    apart = np.abs(mean[:, None] - mean[None]) / np.sqrt(np.einsum("nii->ni", cov))[None]
    owner = leaves.owner[rows[likeliest]]
    same = (owner[:, None] == owner[None]) & (apart.max(axis=2) < MBM_SAME_LEAF_SIGMAS)
    double_of = same.argmax(axis=1)  # the first, which is the likeliest; of itself if there is none before
    double_of = double_of[double_of]
    representative = np.empty_like(rows)
    representative[likeliest] = rows[likeliest[double_of]]
    return cluster._replace(leaf=representative[inverse].reshape(cluster.leaf.shape))
