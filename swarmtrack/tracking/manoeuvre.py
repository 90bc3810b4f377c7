"""Targets that mostly keep their velocity and sometimes manoeuvre: an interacting mix of M = 2 motion models or
more.

Calm: constant velocity, next to no noise. Agile: Singer's model, an acceleration that is correlated in time with
variance σ² = acceleration_psd / (2 τ) and lasts about τ seconds. An observer decides between them by how well each
predicted what was measured: the interacting multiple model filter, Blom & Bar-Shalom (1988); Bar-Shalom, Li &
Kirubarajan (2001), section 11.6.6. Where the strength of manoeuvres in this image is unknown, there is an agile model
for each of some levels.

State [u, vu, v, vv, au, av]: that of motion_model.py and the target's own acceleration, px/s². In the calm model the
acceleration moves nothing: it is what the target would start to manoeuvre with, N(0, σ²).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking.gaussian import variances
from swarmtrack.tracking.motion_model import Turn, add_flow_of_error, turn_exactly
from swarmtrack.tracking.noise import SurePairs, whitened
from swarmtrack.tracking.priors import MANOEUVRE_LEAST_MODE, MANOEUVRE_SHORT_STEP

CALM, AGILE = 0, 1
KINEMATIC = slice(0, 4)
ACCELERATION_OF_AGILE = slice(4, 6)
PLACE_OF_AGILE = slice(0, 4, 2)  # u, v
VELOCITY_OF_AGILE = slice(1, 4, 2)
# Which of the nine entries of an axis' matrix over position, velocity and acceleration each of all 36 is; 9 between the
# axes.
ENTRY = np.full((6, 6), 9)
for _axis in ((0, 1, 4), (2, 3, 5)):
    ENTRY[np.ix_(_axis, _axis)] = np.arange(9).reshape(3, 3)
# signs: the inverse of a 2 × 2 is turned round, over its determinant
ADJUGATE = np.array([[1.0, -1.0], [-1.0, 1.0]])
# Gauss-Legendre nodes and weights on 0…1: with five, exact to 2e-12 for such steps.
NODES, WEIGHTS = (0.5 * np.array(np.polynomial.legendre.leggauss(5)) + [[0.5], [0.0]]).tolist()


class AgileLevel(NamedTuple):
    """How hard targets manoeuvre, as far as a camera sees: near ones more than far ones. scale: factor on the density
    of their acceleration and the variance of their speed; share: of all manoeuvres; lasts: factor on the time that an
    acceleration lasts. The same density in a shorter time is a stronger acceleration."""

    scale: float
    share: float
    lasts: float = 1.0

    @property
    def variance(self) -> float:
        """Factor on the variance of the acceleration."""
        return self.scale / self.lasts


AS_TOLD = (AgileLevel(1.0, 1.0),)


@dataclass(frozen=True, slots=True, kw_only=True)
class Manoeuvres:
    """Manoeuvre model of targets."""

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
    levels: tuple[AgileLevel, ...] = AS_TOLD
    """How hard manoeuvres are, the gentlest first."""

    @property
    def acceleration_variance(self) -> float:
        """px²/s⁴, per axis."""
        return self.agile_psd / (2.0 * self.lasting_s)

    @property
    def scales(self) -> Array:
        """(M - 1,) of the levels."""
        return np.array([level.scale for level in self.levels])

    @property
    def variances(self) -> Array:
        """(M,) px²/s⁴, of the acceleration in each mode; in the calm one that of the gentlest manoeuvre."""
        factors = [level.variance for level in self.levels]
        return self.acceleration_variance * np.array([factors[0], *factors])

    @property
    def rates(self) -> list[float]:
        """1/s, at which accelerations fade at each level."""
        return [1.0 / (self.lasting_s * level.lasts) for level in self.levels]

    @property
    def gained(self) -> Array:
        """(M, M) px²/s⁴: by how much a mode's accelerations (row) are harder than another's (column)."""
        gained: Array = _gained(self.levels) * self.acceleration_variance
        return gained

    @property
    def psd(self) -> Array:
        """(M,) px²/s³, of each mode."""
        return np.array([self.calm_psd, *(self.agile_psd * self.scales)])

    @property
    def usual(self) -> Array:
        """(M,) shares of the time spent calm and at each level of agility."""
        return _usual(self.levels, self.calm_s, self.agile_s)

    def calmed(self, scale: float) -> Manoeuvres:
        """The calm model's noise times a scale. How hard drones can manoeuvre, a calm one does not tell."""
        return self if scale == 1.0 else replace(self, calm_psd=scale * self.calm_psd)


# Asked for in each scan, and always the same.


@cache
def _usual(levels: tuple[AgileLevel, ...], calm_s: float, agile_s: float) -> Array:
    usual = np.array([calm_s, *(level.share * agile_s for level in levels)]) / (calm_s + agile_s)
    usual.setflags(write=False)
    return usual


@cache
def _gained(levels: tuple[AgileLevel, ...]) -> Array:
    variance = np.array([levels[0].variance, *(level.variance for level in levels)])
    gained: Array = np.maximum(variance[:, None] - variance, 0.0)
    gained.setflags(write=False)
    return gained


@cache
def _same_mode(modes: int) -> Array:
    same = np.eye(modes)
    same.setflags(write=False)
    return same


class ModeMixture(NamedTuple):
    """n targets, each with a Gaussian for each of M modes: mean (n, M, 6), cov (n, M, 6, 6), mode (n, M) their
    probabilities."""

    mean: Array
    cov: Array
    mode: Array

    def select(self, rows: NDArray[np.intp]) -> ModeMixture:
        # Of few rows, `take` costs a quarter of what indices in brackets do.
        return ModeMixture(
            self.mean.take(rows, axis=0), self.cov.take(rows, axis=0), self.mode.take(rows, axis=0)
        )


class ModeInnovations(NamedTuple):
    """Innovations of k updates: calm (k, 2), those of the calm mode, whitened; share (k,): of R in their
    covariance; weight (k,): that the target was calm; nis (k,): the squared Mahalanobis distances in all modes,
    weighed by how likely each is after the update. If the mixture is right its mean is 2, as exactly as with a
    single Gaussian.
    """

    calm: Array
    share: Array
    weight: Array
    nis: Array

    def pairs(
        self, track: NDArray[np.int64], detection: NDArray[np.intp], rows: NDArray[np.intp]
    ) -> SurePairs:
        """Pairs of some rows (…,); track (k,) ids, detection (k,) rows of the scan."""
        return SurePairs(
            track[rows], detection[rows], self.calm[rows], self.share[rows], self.weight[rows], self.nis[rows]
        )


def joined(first: ModeMixture, second: ModeMixture) -> ModeMixture:
    return ModeMixture(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


def begun(mean: Array, cov: Array, manoeuvres: Manoeuvres) -> ModeMixture:
    """Targets known by mean (n, 4) and cov (n, 4, 4) alone: in each mode as often as usual, the slower the gentler."""
    n, usual, scales = len(mean), manoeuvres.usual, manoeuvres.scales
    means, covs = np.zeros((n, len(usual), 6)), np.zeros((n, len(usual), 6, 6))
    means[:, :, KINEMATIC] = mean[:, None]
    covs[:, :, KINEMATIC, KINEMATIC] = cov[:, None]
    # A calm target is of any level.
    slower = np.sqrt([usual[AGILE:] @ scales / usual[AGILE:].sum(), *scales])[:, None]
    covs[:, :, VELOCITY_OF_AGILE] *= slower[:, :, None]
    covs[:, :, :, VELOCITY_OF_AGILE] *= slower[:, None]
    covs[:, :, [4, 5], [4, 5]] = manoeuvres.variances[:, None]
    return ModeMixture(means, covs, np.tile(usual, (n, 1)))


def merged(mixture: ModeMixture) -> tuple[Array, Array]:
    """One Gaussian for each target: mean (n, 4), cov (n, 4, 4) with the spread between the modes."""
    return _one_gaussian(mixture.mode, mixture.mean[:, :, KINEMATIC], mixture.cov[:, :, KINEMATIC, KINEMATIC])


def _one_gaussian(mode: Array, mean: Array, cov: Array) -> tuple[Array, Array]:
    """Of mode (n, M), mean (n, M, d) and cov (n, M, d, d): the mean (n, d) and covariance (n, d, d) of the mix."""
    centre = (mode[:, None] @ mean)[:, 0]
    apart = mean - centre[:, None]
    weighed = mode[:, :, None] * apart
    d = mean.shape[2]
    within = (mode[:, None] @ cov.reshape(*mode.shape, d * d)).reshape(-1, d, d)
    return centre, within + weighed.swapaxes(1, 2) @ apart


def mean_acceleration(mixture: ModeMixture) -> Array:
    """Mean acceleration (M - 1, n, 2) px/s², as far as each agile mode accounts for it: zero in the calm mode."""
    weighed: Array = mixture.mode[:, AGILE:, None] * mixture.mean[:, AGILE:, ACCELERATION_OF_AGILE]
    return weighed.swapaxes(0, 1)


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
    """dt seconds later: some have changed their mode, all have moved, and the camera has turned (see
    `motion_model.propagate`). Back, for some hundredths of a second, all move as they do."""
    if not len(mixture.mean):
        return mixture
    F, Q = transitions(dt, manoeuvres)
    if dt < 0.0:
        (mean, cov, mode), Q = mixture, np.zeros_like(Q)
    else:
        mean, cov, mode = _interact(mixture, dt, manoeuvres)
    mean = (F @ mean[:, :, :, None])[..., 0]
    # `matmul` takes twice as long for a transposed view.
    cov = F @ cov @ np.ascontiguousarray(F.swapaxes(1, 2)) + Q
    if rotation is not None:
        mean, cov = turned(mean, cov, rotation, camera, turn)
    if rotation_variance > 0.0:
        add_flow_of_error(cov.reshape(-1, 6, 6), mean.reshape(-1, 6), rotation_variance, camera)
    return ModeMixture(mean, cov, mode)


def update(mixture: ModeMixture, z: Array, R: Array) -> tuple[ModeMixture, ModeInnovations]:
    """Fold measurement z (n, 2) with R (n, 2, 2) into target n; also how well it fitted.

    Each mode's Kalman update is in Joseph form, (I − K H) P (I − K H)ᵀ + K R Kᵀ, which H, two rows of the identity,
    makes two products of rank two: B = P − K H P, then B + (K R − B Hᵀ) Kᵀ.
    """
    R = R[:, None]
    y = z[:, None] - mixture.mean[:, :, PLACE_OF_AGILE]
    PHt = mixture.cov[:, :, :, PLACE_OF_AGILE]
    S = PHt[:, :, PLACE_OF_AGILE] + R
    determinant = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] ** 2
    S_inverse = ADJUGATE * S[..., ::-1, ::-1] / determinant[..., None, None]
    K = PHt @ S_inverse
    explained = S_inverse @ y[..., None]
    step = (PHt @ explained)[..., 0]
    B = mixture.cov - K @ mixture.cov[:, :, PLACE_OF_AGILE]
    cov = B + (K @ R - B[..., PLACE_OF_AGILE]) @ K.swapaxes(2, 3)
    cov = 0.5 * (cov + cov.swapaxes(2, 3))
    distance = (y * explained[..., 0]).sum(axis=2)
    log_likelihood = -0.5 * (distance + np.log(determinant))
    fitted = mixture.mode * np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
    mode = fitted / fitted.sum(axis=1, keepdims=True)
    mode = MANOEUVRE_LEAST_MODE + (1.0 - mode.shape[1] * MANOEUVRE_LEAST_MODE) * mode
    of_R = 0.5 * (R[:, 0].diagonal(axis1=1, axis2=2) / S[:, CALM].diagonal(axis1=1, axis2=2)).sum(axis=1)
    fit = ModeInnovations(
        whitened(y[:, CALM], S[:, CALM]), of_R, mode[:, CALM], (mode * distance).sum(axis=1)
    )
    return ModeMixture(mixture.mean + step, cov, mode), fit


def _interact(mixture: ModeMixture, dt: float, manoeuvres: Manoeuvres) -> ModeMixture:
    """The modes' change within dt: what each begins with is a mix of what both ended with."""
    change = mode_changes(dt, manoeuvres)  # (M, M), from row to column
    mode, M = mixture.mode @ change, len(change)
    # (n, M, M): share of the column's in the row's new one
    share = change.T * mixture.mode[:, None] / mode[:, :, None]
    mean = share @ mixture.mean
    # Nothing is subtracted: after long coasting the modes of a vague track are far apart, and would cancel.
    apart = mixture.mean[:, None] - mean[:, :, None]
    cov = (share @ mixture.cov.reshape(-1, M, 36)).reshape(-1, M, 6, 6)
    cov += (share[..., None] * apart).swapaxes(2, 3) @ apart
    if len(manoeuvres.levels) > 1:  # who begins a harder manoeuvre does so with its acceleration
        of_acceleration = variances(cov)[..., ACCELERATION_OF_AGILE]
        of_acceleration += (share * manoeuvres.gained).sum(axis=2)[:, :, None]
    return ModeMixture(mean, cov, mode)


def mode_changes(dt: float, manoeuvres: Manoeuvres) -> Array:
    """(M, M) probability of being in the column's mode dt after the row's: a Markov chain in continuous time, so that
    two short steps are one long one. Who leaves a mode draws the next as often as usual."""
    usual = manoeuvres.usual
    forgotten = -math.expm1(-dt * (1.0 / manoeuvres.calm_s + 1.0 / manoeuvres.agile_s))
    return np.asarray((1.0 - forgotten) * _same_mode(len(usual)) + forgotten * usual)


def transitions(dt: float, manoeuvres: Manoeuvres) -> tuple[Array, Array]:
    """F (M, 6, 6) and Q (M, 6, 6) of all modes over dt. Singer (1970); Bar-Shalom et al. (2001), section 8.2.3."""
    variance, q, rates = manoeuvres.acceleration_variance, manoeuvres.calm_psd, manoeuvres.rates
    across, gentlest = q * dt**2 / 2.0, manoeuvres.levels[0].variance * variance
    # One flat list, of F for all modes and then of Q: nested ones take twice as long.
    axes = [1.0, dt, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    for rate in rates:
        p, v, a = _reach(dt, rate)
        axes += [1.0, dt, p, 0.0, 1.0, v, 0.0, 0.0, a, 0.0]
    axes += [q * dt**3 / 3.0, across, 0.0, across, q * dt, 0.0, 0.0, 0.0, gentlest, 0.0]
    for level, rate in zip(manoeuvres.levels, rates, strict=True):
        pp, pv, pa, vv, va, aa = _singer_noise(dt, rate, level.variance * variance)
        axes += [pp, pv, pa, pv, vv, va, pa, va, aa, 0.0]
    F, Q = np.array(axes).reshape(2, -1, 10).take(ENTRY, axis=2)
    return F, Q


def _singer_noise(dt: float, rate: float, variance: float) -> tuple[float, ...]:
    """Covariance of position, velocity and acceleration after dt, of what began within it: pp, pv, pa, vv, va, aa."""
    x = rate * dt
    if x < MANOEUVRE_SHORT_STEP:
        pp = pv = pa = vv = va = aa = 0.0
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            p, v, a = _reach(node * dt, rate)  # what an impulse that long ago has done
            pp += weight * p * p
            pv += weight * p * v
            pa += weight * p * a
            vv += weight * v * v
            va += weight * v * a
            aa += weight * a * a
        scale = 2.0 * rate * variance * dt
        return scale * pp, scale * pv, scale * pa, scale * vv, scale * va, scale * aa
    e, e2 = math.exp(-x), math.exp(-2.0 * x)
    pp = (1.0 - e2 + 2.0 * x + 2.0 / 3.0 * x**3 - 2.0 * x**2 - 4.0 * x * e) / rate**4
    pv = (1.0 + e2 - 2.0 * e + 2.0 * x * e - 2.0 * x + x**2) / rate**3
    pa = (1.0 - e2 - 2.0 * x * e) / rate**2
    vv = (4.0 * e - 3.0 - e2 + 2.0 * x) / rate**2
    va = (1.0 + e2 - 2.0 * e) / rate
    return variance * pp, variance * pv, variance * pa, variance * vv, variance * va, variance * (1.0 - e2)


def _reach(t: float, rate: float) -> tuple[float, float, float]:
    """What an acceleration of one, that decays at `rate`, has done to position, velocity and itself after t."""
    gone = math.expm1(-rate * t)
    return (rate * t + gone) / rate**2, -gone / rate, 1.0 + gone


def acceleration_reach(dt: float, manoeuvres: Manoeuvres) -> list[float]:
    """By how much an acceleration of one moves position and velocity within dt, while it decays: of each level."""
    return [reached for rate in manoeuvres.rates for reached in _reach(dt, rate)[:2]]


def turned(
    mean: Array, cov: Array, rotation: Array, camera: PinholeCamera, turn: Turn
) -> tuple[Array, Array]:
    """Rotate all modes with the camera; the acceleration rotates like the velocity."""
    kinematic, F4 = turn(mean[..., KINEMATIC].reshape(-1, 4), rotation, camera)
    J = F4[:, 1::2, 1::2]
    F = np.zeros((len(F4), 6, 6))
    F[:, KINEMATIC, KINEMATIC] = F4
    F[:, ACCELERATION_OF_AGILE, ACCELERATION_OF_AGILE] = J
    found = np.empty((len(F4), 6))
    found[:, KINEMATIC] = kinematic
    found[:, ACCELERATION_OF_AGILE] = (J @ mean[..., ACCELERATION_OF_AGILE].reshape(-1, 2, 1))[..., 0]
    cov = F @ cov.reshape(-1, 6, 6) @ np.ascontiguousarray(F.swapaxes(1, 2))
    return found.reshape(mean.shape), cov.reshape(*mean.shape, 6)
