"""Targets that mostly keep their velocity and sometimes manoeuvre: an interacting mix of two motion models.

Calm: constant velocity, next to no noise. Agile: Singer's model, an acceleration that is correlated in time with
variance σ² = acceleration_psd / (2 τ) and lasts about τ seconds. Whoever sees a target decides between them by how
well each predicted what was measured: the interacting multiple model filter, Blom & Bar-Shalom (1988); Bar-Shalom, Li
& Kirubarajan (2001), section 11.6.6.

State [u, vu, v, vv, au, av]: that of motion_model.py and the target's own acceleration, px/s². In the calm model the
acceleration moves nothing: it is what the target would start to manoeuvre with, N(0, σ²).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking.motion_model import POSITION, Turn, optical_flow, turn_exactly

CALM, AGILE = 0, 1
KINEMATIC = slice(0, 4)
ACCELERATION = slice(4, 6)
AXES = ((0, 1, 4), (2, 3, 5))  # position, velocity, acceleration of u and of v
LEAST_MODE = 1e-12  # a mode's probability never underflows: nothing would bring it back, and 0 / 0 is next
SHORT = 0.5  # share of an acceleration's time, up to which the process noise is integrated: its closed form cancels
# Gauss-Legendre nodes and weights on 0…1: with five, exact to 2e-12 for such steps.
NODES, WEIGHTS = (
    0.5 * (np.polynomial.legendre.leggauss(5)[0] + 1.0),
    0.5 * np.polynomial.legendre.leggauss(5)[1],
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Manoeuvres:
    """What is known of how targets manoeuvre."""

    agile_psd: float
    """px²/s³, of the agile model's acceleration over times longer than `lasting_s`."""
    calm_psd: float
    """px²/s³, white acceleration of a target that keeps its velocity."""
    lasting_s: float
    """s: correlation time τ of an acceleration."""
    calm_s: float
    """s: how long a target stays calm, on average."""
    agile_s: float
    """s: how long it manoeuvres, on average."""

    @property
    def acceleration_variance(self) -> float:
        """px²/s⁴, per axis."""
        return self.agile_psd / (2.0 * self.lasting_s)

    @property
    def usual(self) -> Array:
        """(2,) shares of the time spent calm and agile."""
        total = self.calm_s + self.agile_s
        return np.array([self.calm_s / total, self.agile_s / total])


class ModeMixture(NamedTuple):
    """n targets, each with a Gaussian for each of two modes: mean (n, 2, 6), cov (n, 2, 6, 6), mode (n, 2) their
    probabilities."""

    mean: Array
    cov: Array
    mode: Array

    def take(self, rows: NDArray[np.intp]) -> ModeMixture:
        return ModeMixture(self.mean[rows], self.cov[rows], self.mode[rows])


NOBODY = ModeMixture(np.empty((0, 2, 6)), np.empty((0, 2, 6, 6)), np.empty((0, 2)))


def joined(first: ModeMixture, second: ModeMixture) -> ModeMixture:
    return ModeMixture(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


def begun(mean: Array, cov: Array, manoeuvres: Manoeuvres) -> ModeMixture:
    """Targets known by mean (n, 4) and cov (n, 4, 4) alone: in either mode as often as usual."""
    n = len(mean)
    means, covs = np.zeros((n, 2, 6)), np.zeros((n, 2, 6, 6))
    means[:, :, KINEMATIC] = mean[:, None]
    covs[:, :, KINEMATIC, KINEMATIC] = cov[:, None]
    covs[:, :, [4, 5], [4, 5]] = manoeuvres.acceleration_variance
    return ModeMixture(means, covs, np.tile(manoeuvres.usual, (n, 1)))


def merged(mixture: ModeMixture) -> tuple[Array, Array]:
    """One Gaussian for each target: mean (n, 4), cov (n, 4, 4) with the spread between the modes."""
    mean, cov = mixture.mean[:, :, KINEMATIC], mixture.cov[:, :, KINEMATIC, KINEMATIC]
    calm, agile = mixture.mode[:, CALM, None], mixture.mode[:, AGILE, None]
    apart = mean[:, AGILE] - mean[:, CALM]
    spread = (calm * agile)[:, :, None] * (apart[:, :, None] * apart[:, None, :])
    return (
        mean[:, CALM] + agile * apart,
        calm[:, :, None] * cov[:, CALM] + agile[:, :, None] * cov[:, AGILE] + spread,
    )


def mean_acceleration(mixture: ModeMixture) -> Array:
    """(n, 2) px/s²: nobody accelerates while calm."""
    return mixture.mode[:, AGILE, None] * mixture.mean[:, AGILE, ACCELERATION]


def predict(
    mixture: ModeMixture,
    dt: float,
    manoeuvres: Manoeuvres,
    *,
    camera: PinholeCamera,
    rotation: Array | None = None,
    rotation_variance: float = 0.0,
    turn: Turn = turn_exactly,
) -> ModeMixture:
    """dt ≥ 0 seconds later: some have changed their mode, all have moved, and the camera has turned (see
    `motion_model.propagate`)."""
    if not len(mixture.mean):
        return mixture
    mean, cov, mode = _interact(mixture, dt, manoeuvres)
    F, Q = _transitions(dt, manoeuvres)
    mean = (F @ mean[:, :, :, None])[..., 0]
    cov = F @ cov @ F.swapaxes(1, 2) + Q
    if rotation is not None:
        mean, cov = _turned(mean, cov, rotation, camera, turn)
    if rotation_variance > 0.0:
        flow = optical_flow(mean[..., 0:4:2].reshape(-1, 2), camera)
        spread = rotation_variance * (flow @ flow.swapaxes(1, 2))
        cov[:, :, 0:4:2, 0:4:2] += spread.reshape(-1, 2, 2, 2)
    return ModeMixture(mean, cov, mode)


def update(mixture: ModeMixture, z: Array, R: Array) -> tuple[ModeMixture, Array]:
    """Fold measurement z (n, 2) with R (n, 2, 2) into target n; also the innovations' distances (n,), squared
    Mahalanobis, by the merged prediction. Each mode's Kalman update is in Joseph form."""
    n = len(z)
    y = z[:, None] - mixture.mean[:, :, 0:4:2]
    PHt = mixture.cov[:, :, :, 0:4:2]
    S = PHt[:, :, 0:4:2] + R[:, None]
    a, b, c = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    determinant = a * c - b * b
    inverse = np.stack([c, -b, -b, a], axis=-1).reshape(n, 2, 2, 2) / determinant[..., None, None]
    K = PHt @ inverse
    weighted = (inverse @ y[..., None])[..., 0]
    mean = mixture.mean + (PHt @ weighted[..., None])[..., 0]
    A = np.zeros((n, 2, 6, 6)) + np.eye(6)
    A[..., 0:4:2] -= K
    cov = A @ mixture.cov @ A.swapaxes(2, 3) + K @ R[:, None] @ K.swapaxes(2, 3)
    cov = 0.5 * (cov + cov.swapaxes(2, 3))
    log_likelihood = -0.5 * ((y * weighted).sum(axis=2) + np.log(determinant))
    fitted = mixture.mode * np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
    mode = fitted / fitted.sum(axis=1, keepdims=True)
    mode = LEAST_MODE + (1.0 - 2.0 * LEAST_MODE) * mode
    return ModeMixture(mean, cov, mode), _distance(mixture, z, R)


def _distance(mixture: ModeMixture, z: Array, R: Array) -> Array:
    mean, cov = merged(mixture)
    y, S = z - mean[:, POSITION], cov[:, POSITION, POSITION] + R
    a, b, c = S[:, 0, 0], S[:, 0, 1], S[:, 1, 1]
    return np.asarray((c * y[:, 0] ** 2 - 2.0 * b * y[:, 0] * y[:, 1] + a * y[:, 1] ** 2) / (a * c - b * b))


def _interact(mixture: ModeMixture, dt: float, manoeuvres: Manoeuvres) -> ModeMixture:
    """The modes' change within dt: what each begins with is a mix of what both ended with."""
    change = _mode_changes(dt, manoeuvres)  # (2, 2), from row to column
    mode = mixture.mode @ change
    came_over = mixture.mode[:, ::-1] * np.array([change[AGILE, CALM], change[CALM, AGILE]]) / mode
    apart = mixture.mean[:, ::-1] - mixture.mean
    mean = mixture.mean + came_over[:, :, None] * apart
    stayed = 1.0 - came_over
    d = apart[:, CALM]
    spread = d[:, :, None] * d[:, None, :]
    cov = (
        stayed[:, :, None, None] * mixture.cov
        + came_over[:, :, None, None] * mixture.cov[:, ::-1]
        + (stayed * came_over)[:, :, None, None] * spread[:, None]
    )
    return ModeMixture(mean, cov, mode)


def _mode_changes(dt: float, manoeuvres: Manoeuvres) -> Array:
    """(2, 2) probability of being in the column's mode dt after the row's: a Markov chain in continuous time, so that
    two short steps are one long one."""
    calm, agile = manoeuvres.usual.tolist()
    forgotten = -math.expm1(-dt * (1.0 / manoeuvres.calm_s + 1.0 / manoeuvres.agile_s))
    return np.array(
        [[1.0 - agile * forgotten, agile * forgotten], [calm * forgotten, 1.0 - calm * forgotten]]
    )


def _transitions(dt: float, manoeuvres: Manoeuvres) -> tuple[Array, Array]:
    """F (2, 6, 6) and Q (2, 6, 6) of both modes over dt. Singer (1970); Bar-Shalom et al. (2001), section 8.2.3."""
    rate, variance = 1.0 / manoeuvres.lasting_s, manoeuvres.acceleration_variance
    F, Q = np.zeros((2, 6, 6)), np.zeros((2, 6, 6))
    reach = _reach(np.array([dt]), rate)[0]
    agile, q = _singer_noise(dt, rate, variance), manoeuvres.calm_psd
    calm = np.array(
        [[q * dt**3 / 3.0, q * dt**2 / 2.0, 0.0], [q * dt**2 / 2.0, q * dt, 0.0], [0.0, 0.0, variance]]
    )
    for p, v, a in AXES:
        axis = np.ix_((p, v, a), (p, v, a))
        F[CALM][axis] = [[1.0, dt, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
        F[AGILE][axis] = [[1.0, dt, reach[0]], [0.0, 1.0, reach[1]], [0.0, 0.0, reach[2]]]
        Q[CALM][axis], Q[AGILE][axis] = calm, agile
    return F, Q


def _singer_noise(dt: float, rate: float, variance: float) -> Array:
    """(3, 3) covariance of position, velocity and acceleration after dt, of what began within it."""
    x = rate * dt
    if x < SHORT:
        steps = _reach(NODES * dt, rate)  # (5, 3): what an impulse that long ago has done to p, v, a
        return np.asarray(2.0 * rate * variance * dt * (steps * WEIGHTS[:, None]).T @ steps)
    e, e2 = math.exp(-x), math.exp(-2.0 * x)
    pp = (1.0 - e2 + 2.0 * x + 2.0 / 3.0 * x**3 - 2.0 * x**2 - 4.0 * x * e) / rate**4
    pv = (1.0 + e2 - 2.0 * e + 2.0 * x * e - 2.0 * x + x**2) / rate**3
    pa = (1.0 - e2 - 2.0 * x * e) / rate**2
    vv = (4.0 * e - 3.0 - e2 + 2.0 * x) / rate**2
    va = (1.0 + e2 - 2.0 * e) / rate
    return variance * np.array([[pp, pv, pa], [pv, vv, va], [pa, va, 1.0 - e2]])


def _reach(t: Array, rate: float) -> Array:
    """(k, 3) what an acceleration of one, that decays at `rate`, has done to position, velocity, itself after t
    (k,)."""
    gone = np.expm1(-rate * t)
    return np.stack([(rate * t + gone) / rate**2, -gone / rate, 1.0 + gone], axis=1)


def acceleration_reach(dt: float, manoeuvres: Manoeuvres) -> tuple[float, float]:
    """By how much an acceleration of one moves position and velocity within dt, while it decays."""
    position, velocity, _ = _reach(np.array([dt]), 1.0 / manoeuvres.lasting_s)[0].tolist()
    return position, velocity


def _turned(
    mean: Array, cov: Array, rotation: Array, camera: PinholeCamera, turn: Turn
) -> tuple[Array, Array]:
    """Both modes with the camera; the acceleration turns as the velocity does."""
    kinematic, F4 = turn(mean[..., KINEMATIC].reshape(-1, 4), rotation, camera)
    J = F4[:, 1::2, 1::2]
    F = np.zeros((len(F4), 6, 6))
    F[:, KINEMATIC, KINEMATIC] = F4
    F[:, ACCELERATION, ACCELERATION] = J
    F = F.reshape(-1, 2, 6, 6)
    turned = np.empty_like(mean)
    turned[..., KINEMATIC] = kinematic.reshape(-1, 2, 4)
    turned[..., ACCELERATION] = (F[..., ACCELERATION, ACCELERATION] @ mean[..., ACCELERATION, None])[..., 0]
    return turned, F @ cov @ F.swapaxes(2, 3)
