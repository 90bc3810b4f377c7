"""The Gaussian-mixture PHD filter: one intensity over the image, whose integral is the expected number of targets.

Vo & Ma, "The Gaussian mixture probability hypothesis density filter", IEEE Trans. SP 54(11), 2006. The intensity is a
sum of weighted Gaussians; each carries the label of the track it tells of. A detection at z turns every component into
a new one,

    w_j(z) = p_D w_j N(z; H m_j, S_j) / (κ(z) + b(z) + Σ_l p_D w_l N(z; H m_l, S_l)),

leaves (1 − p_D) w_j of the old one, and starts a label of weight b(z) over the same sum: where a track explains the
detection next to nothing, else the odds of a newcomer to clutter. So a detection adds one to Σw, clutter included.

The sum knows that a detection has one source, but not that a target makes one detection: of two targets that pass each
other each label soon has half its weight on either, and stays so (their first moment is right, only the names are
lost); and what a missed target gives up goes to whoever is seen beside it. `one_to_one` makes the detections compete
for the labels as the labels do for the detections.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.tracking import lifecycle
from swarmtrack.tracking.base import Explained
from swarmtrack.tracking.gaussian import update
from swarmtrack.tracking.marginals import SMALL, beliefs, matching_marginals
from swarmtrack.tracking.motion_model import POSITION
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.population import FADED, Population, blend_sizes
from swarmtrack.tracking.sensor_model import Measurements, SensorModel
from swarmtrack.tracking.table import TrackTable
from swarmtrack.tracking.target_motion import TargetMotion

SURELY = 0.9  # weight of a component on one detection, above which it tells whether the filter is consistent
LARGEST_LOG_RATIO = 300.0  # of a detection as a target's: nothing is as certain, and doubles end at 709


@dataclass(frozen=True, slots=True, kw_only=True)
class GmPhdParameters(CommonParameters):
    one_to_one: bool = True
    """A label has one detection at most, as a detection has one label: the weights are those of one-to-one
    associations, by loopy belief propagation. A penalised PHD filter (Yazdian-Dehkordi, Azimifar & Masnadi-Shirazi,
    Signal Processing 92, 2012) with a penalty that is derived. Not in the profile `paper`."""
    prune_below: float = 1e-4
    """Weight of a component that is given up, unless it is the heaviest of its label."""
    merge_distance: float = 4.0
    """Squared Mahalanobis distance up to which components of a label become one."""
    components_per_label: int = 5
    """The heaviest are kept."""

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


@dataclass(slots=True)
class Mixture:
    """k components, sorted by label. label, weight (k,), mean (k, 4), cov (k, 4, 4)."""

    label: NDArray[np.int64]
    weight: Array
    mean: Array
    cov: Array

    @classmethod
    def empty(cls) -> Mixture:
        return cls(np.empty(0, np.int64), np.empty(0), np.empty((0, 4)), np.empty((0, 4, 4)))

    def __len__(self) -> int:
        return len(self.label)

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Mixture:
        return Mixture(self.label[rows], self.weight[rows], self.mean[rows], self.cov[rows])

    def starts(self) -> NDArray[np.intp]:
        """(n,) where each label's components begin."""
        is_first = np.ones(len(self), np.bool_)
        is_first[1:] = self.label[1:] != self.label[:-1]
        return np.flatnonzero(is_first)


class Shares(NamedTuple):
    """Who made which of m detections, of n labels. taken (n, m): the weight of each label on each detection; kept (n,):
    the factor on the weight of what was not detected; free (m,): the share of each detection that no label takes."""

    taken: Array
    kept: Array
    free: Array


class GmPhd:
    """One intensity, labelled components, births from detections, an estimate for each label."""

    Parameters: ClassVar[type[CommonParameters]] = GmPhdParameters

    def __init__(self, sensor: SensorModel, parameters: GmPhdParameters) -> None:
        self.mixture = Mixture.empty()
        self._sensor = sensor
        self._parameters = parameters
        self._motion = TargetMotion(sensor.camera, parameters)
        self._population = Population(sensor, parameters)
        self._one_to_one = parameters.one_to_one and parameters.profile != "paper"
        self.counters = {"components_over_cap": 0}

    @property
    def table(self) -> TrackTable:
        return self._population.table

    @property
    def expected_targets(self) -> float:
        """Σw, the integral of the intensity."""
        return float(self.mixture.weight.sum())

    def initiate(self, t: float, points: Array) -> list[int]:
        ids = self._population.initiate(t, points)
        self._add_newest(len(ids))
        return ids

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None:
        mixture = self.mixture
        mean, cov = self._motion.carried(mixture.mean, mixture.cov, dt, rotation, rotation_variance)
        weight = lifecycle.survive(mixture.weight, dt, self._parameters.p_survival)
        self.mixture = Mixture(mixture.label, weight, mean, cov)
        self.table.mean, self.table.cov = moments(self.mixture)
        self._population.survive(dt)

    def extrapolated(
        self, dt: float, rotation: Array | None, rotation_variance: float
    ) -> tuple[Array, Array]:
        """The moments of each label, carried on as if it were one Gaussian: exact but for the curvature of a turn."""
        return self._motion.carried(self.table.mean, self.table.cov, dt, rotation, rotation_variance)

    def update(self, t: float, measured: Measurements) -> Explained:
        self._drop(t)  # before the weights: after a long silence a label could take whatever comes next
        newcomers, explained = self._reweigh(t, measured)
        self._drop(t)
        born = newcomers > FADED * self._sensor.birth_existence(np.ones(1))
        self.table.append(self._population.born(t, measured.select(born), newcomers[born]))
        self._add_newest(int(born.sum()))
        return explained

    def _add_newest(self, n: int) -> None:
        """A component for each of the last n rows of the table."""
        table, mixture = self.table, self.mixture
        new = slice(len(table) - n, None)
        self.mixture = Mixture(
            np.concatenate([mixture.label, table.id[new]]),
            np.concatenate([mixture.weight, table.existence[new]]),
            np.concatenate([mixture.mean, table.mean[new]]),
            np.concatenate([mixture.cov, table.cov[new]]),
        )

    def _drop(self, t: float) -> None:
        self._population.drop(t)
        kept = np.isin(self.mixture.label, self.table.id)
        if not kept.all():
            self.mixture = self.mixture.select(kept)

    def _reweigh(self, t: float, measured: Measurements) -> tuple[Array, Explained]:
        """Fold a scan into the mixture and the table; returns the weight (m,) of a newcomer at each detection."""
        table, prior, starts = self.table, self.mixture, self.mixture.starts()
        row = np.searchsorted(table.id, prior.label)
        visibility = self._sensor.visibility(table.mean, table.cov, table.size, table.existence)
        p_detection = visibility.p_detection[row]
        distance, log_ratio = self._sensor.likelihoods(prior.mean, prior.cov, table.size[row], measured)
        newcomer = np.where(measured.fit, self._sensor.birth_existence(measured.odds), 0.0)

        # Over κ + b instead of κ, as the share of b in both is that of newcomers.
        claim = np.exp(np.minimum(log_ratio, LARGEST_LOG_RATIO)) * (1.0 - newcomer)
        claim *= (p_detection * prior.weight)[:, None]
        of_label = sums(claim, starts)
        if self._one_to_one:
            shares = share_one_to_one(of_label, sums(p_detection * prior.weight, starts))
        else:
            shares = share(of_label)
        each = np.divide(shares.taken, of_label, out=np.zeros_like(of_label), where=of_label > 0.0)
        weight = np.column_stack([prior.weight * (1.0 - p_detection) * shares.kept[row], claim * each[row]])

        missed, detected = sums(weight[:, 0], starts), shares.taken.sum(axis=1)
        seen = detected > missed
        if seen.any():
            best = shares.taken[seen].argmax(axis=1)
            table.size[seen] = blend_sizes(table.size[seen], measured.size[best])
        table.existence = np.minimum(missed + detected, lifecycle.MAX_EXISTENCE)
        self._population.judge(t, seen, visibility)
        # A confirmed label that was missed for long keeps a remainder, so that one clear detection brings it back.
        weight *= np.maximum(1.0, table.existence / (missed + detected))[row, None]

        self.mixture = self._merged(updated(prior, weight, measured, self._parameters.prune_below))
        table.mean, table.cov = moments(self.mixture)
        nis = distance[(weight[:, 1:] > SURELY) & table.confirmed[row, None]]
        births = np.where(self._population.shadowed(measured.z, seen), 0.0, shares.free * newcomer)
        return births, Explained(nis, float((shares.free * (1.0 - newcomer)).sum()))

    def _merged(self, mixture: Mixture) -> Mixture:
        merged, over_cap = merge(
            mixture, self._parameters.merge_distance, self._parameters.components_per_label
        )
        self.counters["components_over_cap"] += over_cap
        return merged


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
    absent = np.maximum(1.0 - detectable, 1.0 - lifecycle.MAX_EXISTENCE)
    with np.errstate(divide="ignore"):
        taken = matching_marginals(np.log(claims / absent[:, None]), widest=SMALL, beyond=beliefs)
    nowhere = np.maximum(1.0 - taken.sum(axis=1), 0.0)
    return Shares(taken, nowhere / absent, np.maximum(1.0 - taken.sum(axis=0), 0.0))


def updated(prior: Mixture, weight: Array, measured: Measurements, prune_below: float) -> Mixture:
    """The components of weight (k, 1 + m) that stay: column 0 is component i as it was, column j that of detection j.

    Each label stays, with its heaviest component at least and with all its weight.
    """
    starts = prior.starts()
    row = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(prior)))
    heaviest = np.maximum.reduceat(weight.max(axis=1), starts) if len(prior) else np.empty(0)
    stays = (weight >= prune_below) | (weight >= heaviest[row, None])
    kept = sums(np.where(stays, weight, 0.0).sum(axis=1), starts)
    weight = weight * (sums(weight.sum(axis=1), starts) / kept)[row, None]

    i, j = np.nonzero(stays)
    mean, cov = prior.mean[i], prior.cov[i]
    hits = np.flatnonzero(j > 0)
    mean[hits], cov[hits] = _corrected(prior, i[hits], measured, j[hits] - 1)
    return Mixture(prior.label[i], weight[i, j], mean, cov)


def _corrected(
    prior: Mixture, i: NDArray[np.intp], measured: Measurements, j: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Means and covariances of components i (p,) by detections j (p,)."""
    z, R = measured.z, measured.R
    if not len(i) or (R[0] != R).any():
        return update(prior.mean[i], prior.cov[i], z[j], R[j])
    # The covariance does not depend on z: once for each component. K = P Hᵀ R⁻¹ with the posterior P.
    at_rest = prior.mean[:, POSITION]
    _, cov = update(prior.mean, prior.cov, at_rest, np.broadcast_to(R[0], (len(prior), 2, 2)))
    gain = cov[:, :, POSITION] @ np.linalg.inv(R[0])
    shift = gain[i] @ (z[j] - at_rest[i])[:, :, None]
    return prior.mean[i] + shift[:, :, 0], cov[i]


def merge(mixture: Mixture, within: float, most: int) -> tuple[Mixture, int]:
    """Components of a label within a squared Mahalanobis distance of its heaviest one become one with it, moments and
    all; then of those left, until `most` are found. Those over are counted, and their weight goes to the others.

    Vo & Ma (2006), table II, for all labels at once.
    """
    if len(mixture.starts()) == len(mixture):
        return mixture, 0
    order = np.lexsort((-mixture.weight, mixture.label))
    left = mixture.select(order)
    precision = np.linalg.inv(left.cov)
    found: list[Mixture] = []
    while len(left) and len(found) < most:
        starts = left.starts()
        row = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(left)))
        d = left.mean - left.mean[starts][row]
        near = (d[:, None] @ precision @ d[:, :, None])[:, 0, 0] <= within
        group = left.select(near)
        mean, cov = moments(group)
        found.append(Mixture(left.label[starts], sums(group.weight, group.starts()), mean, cov))
        left, precision = left.select(~near), precision[~near]
    parts = zip(*((part.label, part.weight, part.mean, part.cov) for part in found), strict=True)
    merged = Mixture(*(np.concatenate(part) for part in parts))
    merged = merged.select(np.argsort(merged.label, kind="stable"))
    if len(left):
        kept, starts = sums(merged.weight, merged.starts()), merged.starts()
        total = sums(mixture.weight, mixture.starts())
        merged.weight = merged.weight * np.repeat(total / kept, np.diff(starts, append=len(merged)))
    return merged, len(left)


def moments(mixture: Mixture) -> tuple[Array, Array]:
    """Mean (n, 4) and covariance (n, 4, 4) of each label's components together, with their spread."""
    starts = mixture.starts()
    if len(starts) == len(mixture):
        return mixture.mean, mixture.cov
    sizes = np.diff(starts, append=len(mixture))
    share = mixture.weight / np.repeat(sums(mixture.weight, starts), sizes)
    mean = sums(share[:, None] * mixture.mean, starts)
    d = mixture.mean - np.repeat(mean, sizes, axis=0)
    return mean, sums(share[:, None, None] * (mixture.cov + d[:, :, None] * d[:, None]), starts)


def sums(values: Array, starts: NDArray[np.intp]) -> Array:
    """Of values (k, …) over each label's components (n, …)."""
    if len(starts) == len(values):
        return values
    return np.asarray(np.add.reduceat(values, starts, axis=0))
