"""The Gaussian-mixture PHD filter: one intensity over the image, whose integral is the expected number of targets.

Vo & Ma, "The Gaussian mixture probability hypothesis density filter", IEEE Trans. SP 54(11), 2006. The intensity is a
sum of weighted Gaussians; each carries the label of the track it tells of. A detection at z turns every component into
a new one,

    w_j(z) = p_D w_j N(z; H m_j, S_j) / (κ(z) + b(z) + Σ_l p_D w_l N(z; H m_l, S_l)),

leaves (1 − p_D) w_j of the old one, and starts a label of weight b(z) over the same sum: next to nothing where a track
explains the detection, else the odds of a newcomer to clutter. So Σw stays the expected number of targets.

The sum knows that a detection has one source, but not that a target makes one detection. A track that was surely
detected keeps (1 − p_D) of its prediction as well, which pulls its estimate back; and of two targets that pass each
other slowly each label soon has half its weight on either, for good: the intensity is right, the names are lost.
`one_to_one` makes the detections compete for a label as the labels do for a detection. Each label is then a target
that exists with probability Σw. With it, which is the default, this filter is nearer to the labelled multi-Bernoulli
filter, LMB (Reuter, Vo, Vo & Dietmayer, IEEE Trans. SP 62(12), 2014), than to the PHD filter of Vo & Ma.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking import lifecycle
from swarmtrack.tracking.association import Indices
from swarmtrack.tracking.base import Explained
from swarmtrack.tracking.consistency import sure_pairs
from swarmtrack.tracking.gaussian_tracks import GaussianTracks
from swarmtrack.tracking.marginals import beliefs, matching_marginals
from swarmtrack.tracking.motion_model import POSITION, VELOCITY
from swarmtrack.tracking.noise import pairs_of
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.passage import Passage
from swarmtrack.tracking.priors import (
    FADED_BIRTH_SHARE,
    GMPHD_CORRELATION_ROUNDING,
    LARGEST_CLAIM_LOG_RATIO,
    MARGINALS_SMALL,
    MAX_EXISTENCE,
)
from swarmtrack.tracking.sensor_model import Measurements, SensorModel
from swarmtrack.tracking.table import TrackIds


@dataclass(frozen=True, slots=True, kw_only=True)
class GmPhdParameters(CommonParameters):
    gate_probability: float = 0.99999
    """Probability that a true detection falls inside its target's gate. Wide on purpose: the weights express what is
    unlikely. With a narrow gate, a target that brakes out of it would lose its label to a new one."""
    one_to_one: bool = True
    """A label has at most one detection, and a detection at most one label. The weights are those of one-to-one
    associations, by loopy belief propagation where many compete. Penalised PHD filters have the same aim
    (Yazdian-Dehkordi, Azimifar & Masnadi-Shirazi, Signal Processing 92, 2012). Off in the profile `paper`."""
    prune_below: float = 1e-4
    """A component below this weight is dropped, unless it is the heaviest of its label."""
    merge_distance: float = 4.0
    """Squared Mahalanobis distance up to which components of a label are merged."""
    components_per_label: int = 5
    """Components kept per label: the heaviest."""

    def __post_init__(self) -> None:
        CommonParameters.__post_init__(self)
        if not 0.0 <= self.prune_below < 1.0:
            raise ValueError(f"tracker.prune_below: found {self.prune_below!r}, expected a weight in 0…1")
        if not self.merge_distance >= 0.0:
            raise ValueError(f"tracker.merge_distance: found {self.merge_distance!r}, expected 0 or more")
        if self.components_per_label < 1:
            raise ValueError(
                f"tracker.components_per_label: found {self.components_per_label!r}, expected 1 or more"
            )


class Mixture(NamedTuple):
    """k components, sorted by label. label, weight (k,), mean (k, 4), cov (k, 4, 4)."""

    label: NDArray[np.int64]
    weight: Array
    mean: Array
    cov: Array

    @classmethod
    def empty(cls) -> Mixture:
        return cls(np.empty(0, np.int64), np.empty(0), np.empty((0, 4)), np.empty((0, 4, 4)))

    def select(self, chosen: Indices) -> Mixture:
        cov = self.cov.reshape(-1, 16).take(chosen, axis=0).reshape(-1, 4, 4)
        return Mixture(self.label[chosen], self.weight[chosen], self.mean.take(chosen, axis=0), cov)

    def joined(self, other: Mixture) -> Mixture:
        return Mixture(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


class Shares(NamedTuple):
    """Association of m detections with n labels. taken (n, m): the weight of each label on each detection; kept
    (n,): the factor on the weight of what was not detected; free (m,): the share of each detection that no label
    takes.
    """

    taken: Array
    kept: Array
    free: Array


class GmPhd(GaussianTracks):
    """One intensity, labelled components, births from detections, an estimate for each label.

    Between scans the moments of each label are carried on as if it were one Gaussian: exact but for the curvature of a
    turn.
    """

    Parameters: ClassVar[type[CommonParameters]] = GmPhdParameters

    def __init__(self, sensor: SensorModel, parameters: GmPhdParameters, ids: TrackIds) -> None:
        super().__init__(sensor, parameters, ids)
        self.mixture = Mixture.empty()
        self._parameters = parameters
        self._one_to_one = parameters.one_to_one and parameters.profile != "paper"
        self.counters: dict[str, int] = {"components_over_cap": 0}

    @property
    def expected_targets(self) -> float:
        """Σw, the integral of the intensity."""
        return float(self.mixture.weight.sum())

    def initiate(self, t: float, points: Array) -> list[int]:
        ids = super().initiate(t, points)
        self._add_newest(len(ids))
        return ids

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None:
        label, weight, mean, cov = self.mixture
        mean, cov = self._motion.carried(mean, cov, dt, rotation, rotation_variance)
        weight = lifecycle.survive(weight, dt, self._parameters.p_survival)
        self.mixture = Mixture(label, weight, mean, cov)
        self.table.mean, self.table.cov = moments(self.mixture, blocks(label))
        self._population.survive(dt)

    def update(self, t: float, measured: Measurements) -> Explained:
        self._drop(t)  # before the weights: after a long silence a label could take whatever comes next
        newcomers, explained = self._fold_in(t, measured)
        self._drop(t)
        born = newcomers > FADED_BIRTH_SHARE * self._sensor.usual_birth
        if born.any():
            self.table.append(self._population.born(t, measured.select(born), newcomers[born]))
            self._add_newest(int(born.sum()))
        return explained

    def release(
        self, rows: NDArray[np.bool_], dt: float, rotation: Array | None, rotation_variance: float
    ) -> Passage:
        """Each label as the one Gaussian that it is shown as."""
        self.mixture = self.mixture.select(np.flatnonzero(~rows[blocks(self.mixture.label).row]))
        return super().release(rows, dt, rotation, rotation_variance)

    def adopt(self, arriving: Passage) -> None:
        super().adopt(arriving)
        self._add_newest(len(arriving.table))
        self.table.arrange(np.argsort(self.table.id, kind="stable"))
        self.mixture = self.mixture.select(np.argsort(self.mixture.label, kind="stable"))

    def _add_newest(self, n: int) -> None:
        """A component for each of the last n rows of the table."""
        table, new = self.table, slice(len(self.table) - n, None)
        newest = Mixture(table.id[new], table.existence[new], table.mean[new], table.cov[new])
        self.mixture = self.mixture.joined(newest)

    def _drop(self, t: float) -> None:
        stay = self._population.drop(t)
        if stay is not None:
            self.mixture = self.mixture.select(np.flatnonzero(stay[blocks(self.mixture.label).row]))

    def _fold_in(self, t: float, measured: Measurements) -> tuple[Array, Explained]:
        """Mixture and table after a scan; returns the weight (m,) of a newcomer at each detection."""
        table, prior, labels = self.table, self.mixture, blocks(self.mixture.label)
        visibility = self._sensor.visibility(table.mean, table.cov, table.size, table.existence)
        size = table.size.take(labels.row, axis=0)
        boxes = self._sensor.box_likelihoods(size, measured)
        log_ratio = self._sensor.likelihoods(prior.mean, prior.cov, boxes, measured).log_ratio
        is_gaussian = np.bincount(labels.row) == 1
        rows = sure_pairs(log_ratio, (is_gaussian * table.existence)[labels.row])
        pairs = pairs_of(prior.label, (prior.mean, prior.cov), (measured.z, measured.R), rows)
        newcomer = self._sensor.birth_existence(measured.odds)
        weight, shares = self._reweighed(labels, visibility.p_detection, log_ratio, newcomer)

        missed, detected = sums(weight[:, 0], labels.starts), shares.taken.sum(axis=1)
        seen = detected > missed
        if seen.any():
            self._population.learn_looks(t, seen, measured.select(shares.taken[seen].argmax(axis=1)))
        table.existence = np.minimum(missed + detected, MAX_EXISTENCE)
        self._population.update_status(t, seen, visibility)
        # A confirmed label that is missed for long keeps a remainder, so that one clear detection brings it back.
        weight *= np.maximum(1.0, table.existence / (missed + detected))[labels.row, None]

        candidates = updated(prior, labels, weight, measured, self._parameters.prune_below)
        self.mixture, over_cap = merge(
            candidates, self._parameters.merge_distance, self._parameters.components_per_label
        )
        self.counters["components_over_cap"] += over_cap
        table.mean, table.cov = moments(self.mixture, blocks(self.mixture.label))
        births = np.where(self._population.shadowed(t, measured, seen), 0.0, shares.free * newcomer)
        self._join_twins(seen)
        return births, Explained(pairs, float((shares.free * (1.0 - newcomer)).sum()))

    def _reweighed(
        self, labels: Blocks, p_detection: Array, log_ratio: Array, newcomer: Array
    ) -> tuple[Array, Shares]:
        """Weights (k, 1 + m) of each component undetected and by each detection; p_detection (n,) of each label,
        newcomer (m,) the probability b / (κ + b) that a detection which no label takes is of a new target."""
        row, starts = labels
        prior, p_detection = self.mixture.weight, p_detection[row]
        claim = np.exp(np.minimum(log_ratio, LARGEST_CLAIM_LOG_RATIO)) * (
            1.0 - newcomer
        )  # over κ + b instead of κ
        claim *= (p_detection * prior)[:, None]
        of_label = sums(claim, starts)
        detectable = sums(p_detection * prior, starts)
        shares = share_one_to_one(of_label, detectable) if self._one_to_one else share(of_label)
        each = np.divide(shares.taken, of_label, out=np.zeros_like(of_label), where=of_label > 0.0)
        weight = np.empty((len(row), 1 + len(newcomer)))
        weight[:, 0] = prior * (1.0 - p_detection) * shares.kept[row]
        weight[:, 1:] = claim * each.take(row, axis=0)
        return weight, shares

    def _join_twins(self, seen: NDArray[np.bool_]) -> None:
        """A tentative label that was seen where another one is joins that one: a confirmed one, or the heavier."""
        table = self.table
        tentative = np.flatnonzero(seen & ~table.confirmed)
        if not tentative.size or len(table) == 1:
            return
        d = table.mean[tentative, None] - table.mean
        distance = np.einsum("tni,tij,tnj->tn", d, np.linalg.inv(table.cov[tentative]), d)
        rank = np.empty(len(table), np.intp)
        rank[np.lexsort((-table.id, table.existence, table.confirmed))] = np.arange(len(table))
        outranked = (distance <= self._parameters.merge_distance) & (rank > rank[tentative, None])
        joins = outranked.any(axis=1)
        if not joins.any():
            return
        into = np.arange(len(table))
        into[tentative[joins]] = np.where(outranked[joins], rank, -1).argmax(axis=1)
        while (into != into[into]).any():
            into = into[into]
        twins, joined = tentative[joins], into[tentative[joins]]
        np.maximum.at(table.last_seen, joined, table.last_seen[twins])
        np.maximum.at(table.likeness, joined, table.likeness[twins])
        table.missed_since[joined], table.lost[joined] = np.nan, False
        self._relabel(into)

    def _relabel(self, into: Indices) -> None:
        """Give each row's components to the row `into` (n,)."""
        table, mixture = self.table, self.mixture
        label = table.id[into[blocks(mixture.label).row]]
        mixture = mixture._replace(label=label).select(np.argsort(label, kind="stable"))
        table.keep(into == np.arange(len(into)))
        labels = blocks(mixture.label)
        weight = sums(mixture.weight, labels.starts)
        table.existence = np.minimum(weight, MAX_EXISTENCE)
        if self._one_to_one:  # what both claimed was one target
            mixture = mixture._replace(weight=mixture.weight * (table.existence / weight)[labels.row])
        self.mixture = mixture
        table.mean, table.cov = moments(mixture, labels)


def share(claims: Array) -> Shares:
    """Vo & Ma: the labels share each detection, and each keeps what it would if it was missed.

    claims (n, m): p_D Σ w N(z; H m, S) of each label over κ(z) + b(z).
    """
    free = 1.0 / (1.0 + claims.sum(axis=0))
    return Shares(claims * free, np.ones(len(claims)), free)


def share_one_to_one(claims: Array, detectable: Array) -> Shares:
    """A label takes one detection at most: then a label of weight r ≤ 1 is a target that exists with probability r.

    It is in the scan with odds claims / (1 − r p_D) for each detection, and missed with probability
    r (1 − p_D) / (1 − r p_D) if it has none. claims (n, m) as in `share`; detectable (n,): Σ w p_D of each label.
    """
    absent = np.maximum(1.0 - detectable, 1.0 - MAX_EXISTENCE)
    with np.errstate(divide="ignore"):
        taken = matching_marginals(np.log(claims / absent[:, None]), widest=MARGINALS_SMALL, beyond=beliefs)
    nowhere = np.maximum(1.0 - taken.sum(axis=1), 0.0)
    return Shares(taken, nowhere / absent, np.maximum(1.0 - taken.sum(axis=0), 0.0))


def updated(
    prior: Mixture, labels: Blocks, weight: Array, measured: Measurements, prune_below: float
) -> Mixture:
    """The components of weight (k, 1 + m) that stay: column 0 is component i as it was, column j that of detection j.

    Each label stays, with its heaviest component at least and with all its weight.
    """
    row, starts = labels
    stays = weight > prune_below
    if len(row):
        stays |= weight >= np.maximum.reduceat(weight.max(axis=1), starts)[row, None]
    kept = sums((weight * stays).sum(axis=1), starts)
    weight = weight * (sums(weight.sum(axis=1), starts) / kept)[row, None]
    i, j = np.nonzero(stays)
    mean, cov = _corrected(prior, measured, i, j - 1)
    return Mixture(prior.label[i], weight[i, j], mean, cov)


def _corrected(prior: Mixture, measured: Measurements, i: Indices, j: Indices) -> tuple[Array, Array]:
    """Means (p, 4) and covariances (p, 4, 4) of components i (p,) by detections j (p,); as they were where j is −1.

    The velocity follows the position by B = C P⁻¹ and keeps what does not depend on it, V − B Cᵀ. So only P S⁻¹ R, the
    position's covariance, differs from pair to pair; and it is no difference of large numbers, however small R is.
    """
    if not len(measured.z):
        return prior.mean[i], prior.cov[i]
    P, C = prior.cov[:, POSITION, POSITION], prior.cov[:, VELOCITY, POSITION]
    B = C @ np.linalg.inv(P)
    rest = prior.cov[:, VELOCITY, VELOCITY] - B @ C.swapaxes(1, 2)
    mean, hit = prior.mean.take(i, axis=0), j >= 0
    P, B, rest, R = _last(P, i), _last(B, i), _last(rest, i), _last(measured.R, j)
    y = np.where(hit, (measured.z.take(j, axis=0) - mean[:, POSITION]).T, 0.0)

    S = P + R
    inverse = np.array([[S[1, 1], -S[0, 1]], [-S[1, 0], S[0, 0]]]) / (S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0])
    step = _product(P, _product(inverse, y[:, None]))
    mean[:, POSITION] += step[:, 0].T
    mean[:, VELOCITY] += _product(B, step)[:, 0].T
    P = np.where(hit, _product(P, _product(inverse, R)), P)
    P[0, 1] = P[1, 0] = 0.5 * (P[0, 1] + P[1, 0])
    C = _product(B, P)
    V = rest + _product(C, B.swapaxes(0, 1))
    V[0, 1] = V[1, 0] = 0.5 * (V[0, 1] + V[1, 0])
    cov = np.empty((len(i), 4, 4))
    cov[:, POSITION, POSITION], cov[:, VELOCITY, VELOCITY] = P.transpose(2, 0, 1), V.transpose(2, 0, 1)
    cov[:, VELOCITY, POSITION], cov[:, POSITION, VELOCITY] = C.transpose(2, 0, 1), C.transpose(2, 1, 0)
    return mean, cov


def _last(matrices: Array, at: Indices) -> Array:
    """(2, 2, p) of matrices (k, 2, 2): small ones are multiplied fastest with their number last."""
    return matrices.reshape(-1, 4).T.copy().take(at, axis=1).reshape(2, 2, -1)


def _product(a: Array, b: Array) -> Array:
    """Of p matrices each: (2, 2, p), (2, c, p) -> (2, c, p)."""
    return np.asarray(np.einsum("ijp,jkp->ikp", a, b))


def merge(mixture: Mixture, within: float, most: int) -> tuple[Mixture, int]:
    """Components of a label within a squared Mahalanobis distance of its heaviest one become one with it, moments and
    all; then of those left, until `most` are found. Those over are counted, and their weight goes to the others.

    Vo & Ma (2006), table II, for all labels at once. The distance is in terms of the sharpest component of the label:
    in their own, wide ones, such as that of a missed detection, would be at home with every hypothesis they cover.
    """
    row, starts = blocks(mixture.label)
    if len(starts) == len(row):
        return mixture, 0
    place = _in_sigmas_of_the_sharpest(mixture, row, starts)
    group = np.full(len(row), len(starts) * most)
    leader = np.empty(len(starts), np.intp)
    left, found = np.argsort(-mixture.weight), 0
    while left.size and found < most:
        of_label = row[left]
        leader[of_label[::-1]] = left[::-1]  # of what is written to one place, the last stays: the heaviest
        d = place.take(left, axis=0) - place.take(leader[of_label], axis=0)
        near = np.einsum("ki,ki->k", d, d) <= within
        group[left[near]] = of_label[near] * most + found
        left, found = left[~near], found + 1
    order = np.argsort(group, kind="stable")[: len(row) - left.size]
    gathered, groups = mixture.select(order), blocks(group[order])
    weight = sums(gathered.weight, groups.starts)
    merged = Mixture(gathered.label[groups.starts], weight, *moments(gathered, groups))
    if left.size:
        labels = blocks(merged.label)
        more = sums(mixture.weight, starts) / sums(weight, labels.starts)
        merged = merged._replace(weight=weight * more[labels.row])
    return merged, left.size


def _in_sigmas_of_the_sharpest(mixture: Mixture, row: Indices, starts: Indices) -> Array:
    """(k, 4) means in coordinates in which the sharpest component of their label has the covariance I."""
    size = mixture.cov[:, 0, 0] + mixture.cov[:, 2, 2]
    is_sharpest = np.flatnonzero(size == np.minimum.reduceat(size, starts)[row])
    sharpest = np.empty(len(starts), np.intp)
    sharpest[row[is_sharpest]] = is_sharpest
    P = mixture.cov[sharpest]
    sigma = np.sqrt(P[:, [0, 1, 2, 3], [0, 1, 2, 3]])
    correlation = P / (sigma[:, :, None] * sigma[:, None]) + GMPHD_CORRELATION_ROUNDING * np.eye(4)
    whitening = np.linalg.inv(np.linalg.cholesky(correlation)) / sigma[:, None]
    return np.asarray(np.einsum("ki,kji->kj", mixture.mean, whitening.take(row, axis=0)))


def moments(mixture: Mixture, of: Blocks) -> tuple[Array, Array]:
    """Mean (n, 4) and covariance (n, 4, 4) of each block of components together, with their spread."""
    row, starts = of
    if len(starts) == len(row):
        return mixture.mean, mixture.cov
    share = mixture.weight / sums(mixture.weight, starts).take(row)
    mean = sums(share[:, None] * mixture.mean, starts)
    d = (mixture.mean - mean.take(row, axis=0)).T.copy()  # (4, k): ten times faster in what follows
    spread = np.add.reduceat((share * d)[:, None] * d, starts, axis=2)
    cov = sums(share[:, None] * mixture.cov.reshape(-1, 16), starts).reshape(-1, 4, 4)
    return mean, cov + spread.transpose(2, 0, 1)


class Blocks(NamedTuple):
    """Runs of k sorted keys: row (k,), the number of the run of equal ones that each is in; starts (n,) of the
    runs.
    """

    row: Indices
    starts: Indices


def blocks(key: NDArray[np.integer]) -> Blocks:
    is_first = np.ones(len(key), np.bool_)
    np.not_equal(key[1:], key[:-1], out=is_first[1:])
    return Blocks(np.cumsum(is_first) - 1, np.flatnonzero(is_first))


def sums(values: Array, starts: Indices) -> Array:
    """Sums of values (k, …) over each block (n, …)."""
    if len(starts) == len(values):
        return values
    return np.asarray(np.add.reduceat(values, starts, axis=0))
