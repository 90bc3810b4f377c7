"""Joint probabilistic data association: each track takes its share of every detection it may have made.

More exactly this is JIPDA: the plain JPDA filter knows how many targets there are.

The shares are exact: they sum over all joint events, of which none is written out (see marginals.py), in clusters of
tracks that compete. A track may also not exist, so the filter begins and ends tracks by itself: Musicki & Evans, "Joint
integrated probabilistic data association: JIPDA", IEEE Trans. AES 40(3), 2004. With existence r and detection
probability p_D, "track i made detection j" weighs

    r p_D N(y; 0, S) / κ_j / (1 − r p_D)

against "track i made none, and j is clutter or new". A scan then leaves existence at Σ_j β_j + β_0 r (1 − p_D) / (1 −
r p_D), and each track at the moments of its explanations: the combined innovation, and a covariance that knows how far
the explanations lie apart (Fortmann, Bar-Shalom & Scheffe, IEEE J. Oceanic Eng. 8(3), 1983). The unexplained part, 1 −
Σ_i β_ij, begins a tentative track.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.tracking.base import Explained
from swarmtrack.tracking.consistency import sure_pairs
from swarmtrack.tracking.gaussian import inverse
from swarmtrack.tracking.gaussian_tracks import GaussianTracks
from swarmtrack.tracking.marginals import beliefs, matching_marginals
from swarmtrack.tracking.motion_model import POSITION, VELOCITY
from swarmtrack.tracking.noise import pairs_of
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.priors import (
    FADED_BIRTH_SHARE,
    JPDAF_DETECTED_SHARE,
    JPDAF_DOUBLE_EXISTENCE,
    JPDAF_DOUBLE_GATE,
    JPDAF_LEAST_EXISTENCE,
    MAX_EXISTENCE,
)
from swarmtrack.tracking.sensor_model import Measurements, SensorModel
from swarmtrack.tracking.table import TrackIds


@dataclass(frozen=True, slots=True, kw_only=True)
class JpdafParameters(CommonParameters):
    gate_probability: float = 0.99999
    """Probability that a true detection falls inside its target's gate. Wide on purpose: a track that clutter pulled
    away must be able to come back, and a detection that fits badly has a small share anyway."""
    end_doubles: bool = True
    """Where two confirmed tracks are in one place and the scans support only one, the older one stays."""
    exact_width: int = 10
    """Shares are exact for up to this many competing tracks. Beyond it they are approximate (belief propagation, some
    off by 0.1), and the scan is counted. Each further track doubles the time of the exact ones, which is half a
    millisecond at 10."""

    def __post_init__(self) -> None:
        CommonParameters.__post_init__(self)
        if self.exact_width < 1:
            raise ValueError(f"tracker.exact_width: found {self.exact_width!r}, expected 1 or more")


class Jpdaf(GaussianTracks):
    """Exact JIPDA up to a stated width, loopy belief propagation beyond it."""

    Parameters: ClassVar[type[CommonParameters]] = JpdafParameters

    def __init__(self, sensor: SensorModel, parameters: JpdafParameters, ids: TrackIds) -> None:
        super().__init__(sensor, parameters, ids)
        self._parameters = parameters
        self.counters: dict[str, int] = {"scans_approximated": 0}

    def update(self, t: float, measured: Measurements) -> Explained:
        # Before the association: after a long silence a track could take whatever comes next, and its name with it.
        self._population.drop(t)
        newcomers, explained = self._associate(t, measured)
        self._population.drop(t)
        born = newcomers > FADED_BIRTH_SHARE * self._sensor.usual_birth
        if born.any():
            self.table.append(self._population.born(t, measured.select(born), newcomers[born]))
        return explained

    def _associate(self, t: float, measured: Measurements) -> tuple[Array, Explained]:
        """Give each track its shares, and update; returns the probability (m,) of a new target at each detection."""
        table = self.table
        visibility = self._sensor.visibility(table.mean, table.cov, table.size, table.existence)
        boxes = self._sensor.box_likelihoods(table.size, measured)
        log_ratio = self._sensor.likelihoods(table.mean, table.cov, boxes, measured).log_ratio
        sure = sure_pairs(log_ratio, table.confirmed * table.existence)
        pairs = pairs_of(table.id, (table.mean, table.cov), (measured.z, measured.R), sure)
        newcomer = self._sensor.birth_existence(measured.odds)
        detectable = table.existence * visibility.p_detection
        share = self._shares(log_ratio + np.log1p(-newcomer), detectable)

        detected = np.minimum(share.sum(axis=1), 1.0)
        missed = (1.0 - detected) * (table.existence - detectable) / (1.0 - detectable)
        existence = np.maximum(detected + missed, JPDAF_LEAST_EXISTENCE)
        table.mean, table.cov = combined(
            table.mean, table.cov, measured.z, measured.R, share / existence[:, None]
        )
        older, younger = self._doubles(existence)
        for of_each in (existence, detected):
            of_each[older] += of_each[younger]
            of_each[younger] = 0.0
        table.existence = np.minimum(existence, MAX_EXISTENCE)
        seen = detected >= JPDAF_DETECTED_SHARE
        if seen.any():
            best = share[seen].argmax(axis=1)
            self._population.learn_looks(t, seen, measured.select(best))
        self._population.update_status(t, seen, visibility)
        unexplained = np.maximum(1.0 - share.sum(axis=0), 0.0)
        births = np.where(self._population.shadowed(t, measured, seen), 0.0, unexplained * newcomer)
        return births, Explained(pairs, float((unexplained * (1.0 - newcomer)).sum()))

    def _doubles(self, existence: Array) -> tuple[list[int], list[int]]:
        """Rows of confirmed tracks, older and younger, that are in one place and share the existence of one target.

        Left alone, chance would decide which of the two dies, or both would live for ever by halves.
        """
        table = self.table
        doubtful = np.flatnonzero(table.confirmed & (existence < JPDAF_DOUBLE_EXISTENCE))
        if len(doubtful) < 2 or not self._parameters.end_doubles:
            return [], []
        together = existence[doubtful, None] + existence[doubtful]
        i, j = np.nonzero(np.triu((together > 0.5) & (together < 1.5), 1))
        i, j = doubtful[i], doubtful[j]
        d = table.mean[i] - table.mean[j]
        distance = (d * np.linalg.solve(table.cov[i] + table.cov[j], d[:, :, None])[:, :, 0]).sum(axis=1)
        older: list[int] = []
        younger: list[int] = []
        for a, b in zip(
            i[distance < JPDAF_DOUBLE_GATE].tolist(), j[distance < JPDAF_DOUBLE_GATE].tolist(), strict=True
        ):
            if not {a, b} & {*older, *younger}:
                older.append(a)
                younger.append(b)
        return older, younger

    def _shares(self, log_ratio: Array, detectable: Array) -> Array:
        """β (n, m) without "none". log_ratio (n, m): N(y; 0, S) over clutter and newcomers; detectable (n,): r p_D.

        Confirmed tracks come first, tentative ones share what they leave: a track that was led astray by clutter must
        not find its target taken by the one that was just born there.
        """
        with np.errstate(divide="ignore"):
            weight = log_ratio + np.log(detectable / (1.0 - detectable))[:, None]
        sure = self.table.confirmed
        if sure.all():
            return self._marginals(weight)
        share = np.empty_like(log_ratio)
        share[sure] = self._marginals(weight[sure])
        with np.errstate(divide="ignore"):
            left = np.log(np.maximum(1.0 - share[sure].sum(axis=0), 0.0))
        share[~sure] = matching_marginals(weight[~sure] + left, self._parameters.exact_width, beliefs)
        return share

    def _marginals(self, log_ratio: Array) -> Array:
        """Exact where they can be; counted where not."""
        too_wide = []

        def believed(cluster: Array, width: int) -> Array:
            too_wide.append(width)
            return beliefs(cluster)

        share = matching_marginals(log_ratio, self._parameters.exact_width, believed)
        self.counters["scans_approximated"] += bool(too_wide)
        return share


def combined(mean: Array, cov: Array, z: Array, R: Array, share: Array) -> tuple[Array, Array]:
    """Means (n, 4) and covariances (n, 4, 4) over all explanations: measurement j has share (n, m), none has the rest.

    z (m, 2), R (m, 2, 2). With the position's covariance P, S = P + R and the step x = P S⁻¹ y that an explanation
    takes, the position moves by x̄ = Σ β x, and its covariance becomes P (1 − Σ β + Σ β S⁻¹ R) + Σ β x xᵀ − x̄ x̄ᵀ: no
    difference of large numbers, however small R is. The velocity follows as far as the two are correlated.
    """
    i, j = np.nonzero(share)
    if not i.size:
        return mean, cov
    P, C = cov[:, POSITION, POSITION], cov[:, VELOCITY, POSITION]
    x, shrinks = _explanations(P[i].reshape(-1, 4).T, R[j].reshape(-1, 4).T, (z[j] - mean[i][:, POSITION]).T)
    terms = np.concatenate([np.ones_like(x[:1]), x, x[:1] * x, x[1:] * x, shrinks]) * share[i, j]
    first = np.concatenate([[True], i[1:] != i[:-1]]).nonzero()[0]
    sums = np.add.reduceat(terms, first, axis=1).T
    rows, step = i[first], sums[:, 1:3]
    prior = P[rows]
    posterior = prior @ ((1.0 - sums[:, :1, None]) * np.eye(2) + sums[:, 7:].reshape(-1, 2, 2))
    posterior += sums[:, 3:7].reshape(-1, 2, 2) - step[:, :, None] * step[:, None]
    posterior = 0.5 * (posterior + posterior.swapaxes(1, 2))
    follows = C[rows] @ inverse(prior)
    change = np.empty((len(rows), 4))
    change[:, POSITION], change[:, VELOCITY] = step, (follows @ step[:, :, None])[:, :, 0]
    across = follows @ posterior
    after = cov[rows]
    V = after[:, VELOCITY, VELOCITY] + follows @ (posterior - prior) @ follows.swapaxes(1, 2)
    after[:, POSITION, POSITION], after[:, VELOCITY, VELOCITY] = posterior, 0.5 * (V + V.swapaxes(1, 2))
    after[:, VELOCITY, POSITION], after[:, POSITION, VELOCITY] = across, across.swapaxes(1, 2)
    mean, cov = mean.copy(), cov.copy()
    mean[rows] += change
    cov[rows] = after
    return mean, cov


def _explanations(P: Array, R: Array, y: Array) -> tuple[Array, Array]:
    """x = P S⁻¹ y (2, k) and S⁻¹ R (4, k) of k pairs; P (4, k), R (4, k), y (2, k). Matrices are row by row."""
    Puu, Puv, _, Pvv = P
    Ruu, Ruv, _, Rvv = R
    a, b, c = Puu + Ruu, Puv + Ruv, Pvv + Rvv
    determinant = a * c - b * b
    a, b, c = a / determinant, b / determinant, c / determinant  # S⁻¹ is [[c, -b], [-b, a]]
    u, v = c * y[0] - b * y[1], a * y[1] - b * y[0]
    x = np.stack([Puu * u + Puv * v, Puv * u + Pvv * v])
    return x, np.stack([c * Ruu - b * Ruv, c * Ruv - b * Rvv, a * Ruv - b * Ruu, a * Rvv - b * Ruv])
