"""Joint probabilistic data association: each track takes its share of every detection it may have made.

The shares are exact: they sum over all joint events, of which none is written out (see marginals.py), in clusters of
tracks that compete. A track may also not exist, so the filter begins and ends tracks by itself: Musicki & Evans, "Joint
integrated probabilistic data association: JIPDA", IEEE Trans. AES 40(3), 2004. With existence r and detection
probability p_D, "track i made detection j" weighs

    r p_D N(y; 0, S) / κ_j / (1 − r p_D)

against "track i made none, and j is clutter or new". A scan then leaves existence at Σ_j β_j + β_0 r (1 − p_D) /
(1 − r p_D), and each track at the moments of its explanations: the combined innovation, and a covariance that knows
how far the explanations lie apart (Fortmann, Bar-Shalom & Scheffe, IEEE J. Oceanic Eng. 8(3), 1983). What nobody
explains, 1 − Σ_i β_ij, begins a tentative track.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.tracking import lifecycle
from swarmtrack.tracking.base import Explained
from swarmtrack.tracking.marginals import beliefs, matching_marginals
from swarmtrack.tracking.motion_model import POSITION
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.population import FADED, Population, blend_sizes
from swarmtrack.tracking.sensor_model import Measurements, SensorModel
from swarmtrack.tracking.table import TrackTable
from swarmtrack.tracking.target_motion import TargetMotion

SEEN = 0.5  # share of all detections, from which on a scan counts as having detected a track
SURELY = 0.9  # share of one detection, above which it tells whether the filter is consistent


@dataclass(frozen=True, slots=True, kw_only=True)
class JpdafParameters(CommonParameters):
    exact_width: int = 10
    """Tracks that compete at once: up to so many, shares are exact; beyond, they are beliefs (some of them off by 0.1),
    and the scan is counted. Each one more doubles the time of the exact ones: half a millisecond at 10."""

    def __post_init__(self) -> None:
        CommonParameters.__post_init__(self)
        if self.exact_width < 1:
            raise ValueError(f"tracker.exact_width: found {self.exact_width!r}, expected 1 or more")


class Jpdaf:
    """Exact JIPDA up to a stated width, loopy belief propagation beyond it."""

    Parameters: ClassVar[type[CommonParameters]] = JpdafParameters

    def __init__(self, sensor: SensorModel, parameters: JpdafParameters) -> None:
        self._sensor = sensor
        self._parameters = parameters
        self._motion = TargetMotion(sensor.camera, parameters)
        self._population = Population(sensor, parameters)
        self.counters = {"scans_approximated": 0}

    @property
    def table(self) -> TrackTable:
        return self._population.table

    def initiate(self, t: float, points: Array) -> list[int]:
        return self._population.initiate(t, points)

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None:
        self.table.mean, self.table.cov = self.extrapolated(dt, rotation, rotation_variance)
        self._population.survive(dt)

    def extrapolated(
        self, dt: float, rotation: Array | None, rotation_variance: float
    ) -> tuple[Array, Array]:
        return self._motion.carried(self.table.mean, self.table.cov, dt, rotation, rotation_variance)

    def update(self, t: float, measured: Measurements) -> Explained:
        # Before the association: after a long silence a track could take whatever comes next, and its name with it.
        self._population.drop(t)
        newcomers, explained = self._associate(t, measured)
        self._population.drop(t)
        born = newcomers > FADED * self._sensor.birth_existence(np.ones(1))
        self.table.append(self._population.born(t, measured.select(born), newcomers[born]))
        return explained

    def _associate(self, t: float, measured: Measurements) -> tuple[Array, Explained]:
        """Give each track its shares, and update; returns the probability (m,) of a new target at each detection."""
        table = self.table
        visibility = self._sensor.visibility(table.mean, table.cov, table.size, table.existence)
        distance, log_ratio = self._sensor.likelihoods(table.mean, table.cov, table.size, measured)
        newcomer = np.where(measured.fit, self._sensor.birth_existence(measured.odds), 0.0)
        detectable = table.existence * visibility.p_detection
        with np.errstate(divide="ignore"):
            odds = np.log(detectable / (1.0 - detectable))
        # Over clutter and newcomers, instead of over clutter alone.
        share = self._shares(log_ratio + odds[:, None] + np.log1p(-newcomer))

        detected = np.minimum(share.sum(axis=1), 1.0)
        missed = (1.0 - detected) * (table.existence - detectable) / (1.0 - detectable)
        existence = detected + missed
        table.mean, table.cov = combined(
            table.mean, table.cov, measured.z, measured.R, share / np.maximum(existence, 1e-300)[:, None]
        )
        table.existence = np.minimum(existence, lifecycle.MAX_EXISTENCE)
        seen = detected >= SEEN
        if seen.any():
            best = share[seen].argmax(axis=1)
            table.size[seen] = blend_sizes(table.size[seen], measured.size[best])
        self._population.judge(t, seen, visibility)
        nis = distance[(share > SURELY) & table.confirmed[:, None]]
        unexplained = np.maximum(1.0 - share.sum(axis=0), 0.0)
        births = np.where(self._population.shadowed(measured.z, seen), 0.0, unexplained * newcomer)
        return births, Explained(nis, float((unexplained * (1.0 - newcomer)).sum()))

    def _shares(self, log_ratio: Array) -> Array:
        """β (n, m) without "none"; log_ratio (n, m) of the weights above."""
        too_wide = []

        def believed(cluster: Array, width: int) -> Array:
            too_wide.append(width)
            return beliefs(cluster)

        share = matching_marginals(log_ratio, self._parameters.exact_width, believed)
        self.counters["scans_approximated"] += bool(too_wide)
        return share


def combined(mean: Array, cov: Array, z: Array, R: Array, share: Array) -> tuple[Array, Array]:
    """Means (n, 4) and covariances (n, 4, 4) over all explanations: measurement j has share (n, m), none has the rest.

    z (m, 2), R (m, 2, 2). With S = P + R of the position, M = S⁻¹ R and the step x = P S⁻¹ y of each explanation, the
    position moves by x̄ = Σ β x, and its covariance becomes P (1 − Σ β + Σ β M) + Σ β x xᵀ − x̄ x̄ᵀ: no difference of
    large numbers, however small R is. The velocity follows as far as the two are correlated, by L = P Hᵀ P⁻¹.
    """
    i, j = np.nonzero(share)
    if not i.size:
        return mean, cov
    weight = share[i, j][:, None, None]
    rows = np.flatnonzero(np.diff(i, prepend=-1))
    P = cov[:, POSITION, POSITION]
    inverse = _inverse(P[i] + R[j])
    x = P[i] @ (inverse @ (z[j] - mean[i][:, POSITION])[:, :, None])
    moments = np.concatenate([x, x * x.swapaxes(1, 2), inverse @ R[j], np.ones_like(x)], axis=2) * weight
    moments = np.add.reduceat(moments, rows, axis=0)

    updated = i[rows]
    step, missed = moments[:, :, 0], 1.0 - moments[:, :1, 5:]
    prior = P[updated]
    posterior = prior @ (missed * np.eye(2) + moments[:, :, 3:5]) + moments[:, :, 1:3]
    posterior -= step[:, :, None] * step[:, None]
    posterior = 0.5 * (posterior + posterior.swapaxes(1, 2))
    L = cov[updated][:, :, POSITION] @ _inverse(prior)
    rest = np.tile(np.eye(4), (len(updated), 1, 1))
    rest[:, :, POSITION] -= L
    new_mean, new_cov = mean.copy(), cov.copy()
    new_mean[updated] += (L @ step[:, :, None])[:, :, 0]
    new_cov[updated] = rest @ cov[updated] @ rest.swapaxes(1, 2) + L @ posterior @ L.swapaxes(1, 2)
    return new_mean, 0.5 * (new_cov + new_cov.swapaxes(1, 2))


def _inverse(S: Array) -> Array:
    """Of symmetric positive (k, 2, 2)."""
    a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    adjugate = np.stack([c, -b, -b, a], axis=1).reshape(-1, 2, 2)
    return np.asarray(adjugate / (a * c - b * b)[:, None, None])
