"""What is believed of where teammates are: a direction, the logarithm of the range, the velocity over the range.

Theory of operation. In team axes (NED) r = teammate − own camera = exp(l) d, with d on the unit sphere, and the
teammate's own velocity is v = exp(l) s. A bearing measures d, and the width of a box measures l up to errors that last:
all of it is linear in this state, so what a camera cannot see, the range, is never touched by a linearization of what
it can. A Cartesian extended filter makes up range out of bearings, an iterated one runs towards the observer.

The errors that last are states too, because whatever lasts and is taken for noise makes a confident wrong range: of
the size, one part for good and one that wanders within a second; of a place that the teammate says, f; of its north
against ours, ψ. The error state of a row is

    α (2) across d on the axes E, l, s (3), size (2: lasting, wandering), f (3) m, ψ rad

Motion between two exposures, exact in the mean, with u the own camera's way between them and e, φ from `decay`:

    y = d + φ s − u exp(−l),   d' = y / |y|,   l' = l + ln |y|,   s' = e s / |y|

A batch is n teammates, a row each. Nothing here writes into its arguments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.relative.priors import (
    OWN_WAY_LEVER,
    RELATIVE_FARTHEST_M,
    RELATIVE_NEAREST_M,
    WANDER_SHORT_STEP,
)

STATE_SIZE: Final = 12
ACROSS_RAY, LOG_RANGE, SCALED_SPEED = slice(0, 2), 2, slice(3, 6)
LASTING_SIZE, WANDERING_SIZE, PLACE_ERROR, HEADING_OFFSET = 6, 7, slice(8, 11), 11
_MOVING: Final = slice(0, 6)
_LOG_NEAREST, _LOG_FARTHEST = math.log(RELATIVE_NEAREST_M), math.log(RELATIVE_FARTHEST_M)
_IDENTITY: Final = np.eye(STATE_SIZE)
_IDENTITY.setflags(write=False)


class VelocityPrior(NamedTuple):
    """How a teammate's velocity changes: it forgets itself within forget_s, around zero ± speed_sigma m/s per axis."""

    speed_sigma: Array
    """(n,)"""
    forget_s: float


class SizeErrors(NamedTuple):
    """Errors of ln(width): wandering, one sigma, within wander_s; what lasts is told when a row begins."""

    wandering: float
    wander_s: float


class OwnWay(NamedTuple):
    """Path of the own camera during a step: u (3,) m; walked, jitter m² per axis: how much of its noise stays, and
    how much is of the two places at its ends only; turned rad² per axis: how far the error of its attitude went.
    """

    u: Array
    walked: float
    jitter: float
    turned: float


class Drift(NamedTuple):
    """How fast what a teammate says of itself leaves what we say: m/√s and rad/√s."""

    place: float
    turn: float


class Decay(NamedTuple):
    """Transition of an integrated Ornstein-Uhlenbeck process over one step: way from velocity φ, velocity left e,
    and Q per axis of way and velocity, (n,) each: pp m², pv m²/s, vv m²/s².
    """

    phi: float
    left: float
    pp: Array
    pv: Array
    vv: Array


class UnitDecay(NamedTuple):
    """The same for a velocity whose change has the density of 1 m²/s³."""

    phi: float
    left: float
    pp: float
    pv: float
    vv: float


def decay(dt: float, wander: VelocityPrior) -> Decay:
    """Over dt s."""
    unit = unit_decay(dt, wander.forget_s)
    q = density(wander)
    return Decay(unit.phi, unit.left, q * unit.pp, q * unit.pv, q * unit.vv)


def decay_back(dt: float, wander: VelocityPrior) -> Decay:
    """To dt s ago: what it was then, by what it is now, and all that may have come to it in between."""
    back, unit = unit_decay(-dt, wander.forget_s), unit_decay(dt, wander.forget_s)
    q = density(wander)
    return Decay(back.phi, back.left, q * unit.pp, -q * unit.pv, q * unit.vv)


def density(wander: VelocityPrior) -> Array:
    """(n,) m²/s³ of the white noise that keeps velocities as fast as they are."""
    return np.asarray(2.0 * wander.speed_sigma**2 / wander.forget_s)


def unit_decay(dt: float, tau: float) -> UnitDecay:
    """Over dt s, of a velocity that forgets itself within tau s. Bar-Shalom, Li & Kirubarajan (2001), section 8.2,
    without the acceleration."""
    left = math.exp(-dt / tau)
    phi = -tau * math.expm1(-dt / tau)
    x = dt / tau
    # Of short steps the closed form is a difference of nearly equal numbers.
    way = dt**3 * (1.0 / 3.0 - x / 4.0 + 7.0 * x * x / 60.0)
    if x > WANDER_SHORT_STEP:
        way = tau**2 * (dt - 2.0 * phi + 0.5 * tau * (1.0 - left * left))
    return UnitDecay(phi, left, way, phi * phi / 2.0, -0.5 * tau * math.expm1(-2.0 * x))


@dataclass(frozen=True, slots=True, eq=False)
class Beliefs:
    """States of n teammates at one instant: d (n, 3), axes E (n, 3, 2) across it, log_range (n,), s (n, 3) 1/s,
    size (n, 2), place (n, 3) m, turn (n,) rad, and the covariance P (n, 12, 12) of the error state.
    """

    d: Array
    E: Array
    log_range: Array
    s: Array
    size: Array
    place: Array
    turn: Array
    P: Array

    @property
    def n(self) -> int:
        return len(self.log_range)

    def rows(self, index: Array | slice | list[int]) -> Beliefs:
        """These rows only, in this order."""
        return Beliefs(*(getattr(self, name)[index] for name in self.__slots__))

    def row(self, i: int) -> Beliefs:
        """One row, as a batch of one."""
        return self.rows(slice(i, i + 1))

    def with_row(self, i: int, one: Beliefs) -> Beliefs:
        """The same but for a row, which is that of another batch of one."""
        columns = [getattr(self, name).copy() for name in self.__slots__]
        for column, name in zip(columns, self.__slots__, strict=True):
            column[i] = getattr(one, name)[0]
        return Beliefs(*columns)

    def joined(self, other: Beliefs) -> Beliefs:
        """The rows of both."""
        return Beliefs(
            *(np.concatenate([getattr(self, name), getattr(other, name)]) for name in self.__slots__)
        )


def nobody() -> Beliefs:
    """No rows."""
    return Beliefs(
        np.empty((0, 3)), np.empty((0, 3, 2)), np.empty(0), np.empty((0, 3)), np.empty((0, 2)),
        np.empty((0, 3)), np.empty(0), np.empty((0, STATE_SIZE, STATE_SIZE)),
    )  # fmt: skip


def across(d: Array) -> Array:
    """(n, 3, 2): two unit vectors across each of d (n, 3) and each other.

    Duff et al., "Building an orthonormal basis, revisited" (2017): without a cross product or a square root.
    """
    x, y, z = d[:, 0], d[:, 1], d[:, 2]
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    E = np.empty((len(d), 3, 2))
    E[:, 0, 0], E[:, 1, 0], E[:, 2, 0] = 1.0 + sign * x * x * a, sign * b, -sign * x
    E[:, 0, 1], E[:, 1, 1], E[:, 2, 1] = b, sign + y * y * a, -y
    return E


def predicted(
    now: Beliefs, step: Decay, own: OwnWay, *, dt: float, errors: SizeErrors, drift: Drift
) -> tuple[Beliefs, Array]:
    """One step on, and F (n, 12, 12), by which the error state moved.

    The lever of the own way on the range is shrunk by its noise: that is in the innovation too (errors in variables),
    and would drive the range outwards step by step. The mean has the whole of it.
    """
    u = own.u
    near = np.exp(-now.log_range)
    y = now.d + step.phi * now.s - u * near[:, None]
    length = np.maximum(np.sqrt((y * y).sum(axis=1)), 1e-6)
    shorter = 1.0 / length
    d = y * shorter[:, None]
    E = across(d)
    s = now.s * (step.left * shorter)[:, None]
    onto = np.concatenate([E, d[:, :, None]], axis=2).swapaxes(1, 2) * shorter[:, None, None]
    lever = max(0.0, 1.0 - OWN_WAY_LEVER * (own.walked + 2.0 * own.jitter) / max(float(u @ u), 1e-12))
    by_state = np.zeros((now.n, 3, 6))
    by_state[:, :, ACROSS_RAY] = now.E
    by_state[:, :, LOG_RANGE] = u * (lever * near)[:, None]
    by_state[:, 0, 3] = by_state[:, 1, 4] = by_state[:, 2, 5] = step.phi
    moved = onto @ by_state
    F = np.zeros((now.n, STATE_SIZE, STATE_SIZE))
    F[:, :3, _MOVING] = moved
    F[:, LOG_RANGE, LOG_RANGE] += 1.0
    F[:, SCALED_SPEED, _MOVING] = -s[:, :, None] * moved[:, 2, None, :]
    for i in (3, 4, 5):
        F[:, i, i] += step.left * shorter
    kept = math.exp(-dt / errors.wander_s)
    F[:, WANDERING_SIZE, WANDERING_SIZE] = kept
    for i in (LASTING_SIZE, 8, 9, 10, HEADING_OFFSET):
        F[:, i, i] = 1.0
    P = F @ now.P @ F.swapaxes(1, 2)
    P[:, _MOVING, _MOVING] += _shaken(onto * near[:, None, None], s, near * shorter, step, own.walked)
    P[:, WANDERING_SIZE, WANDERING_SIZE] += errors.wandering**2 * (1.0 - kept * kept)
    P[:, 0, 0] += own.turned
    P[:, 1, 1] += own.turned
    for i in (8, 9, 10):
        P[:, i, i] += drift.place**2 * dt
    P[:, HEADING_OFFSET, HEADING_OFFSET] += drift.turn**2 * dt
    size = now.size * (1.0, kept)
    log_range = np.clip(now.log_range + np.log(length), _LOG_NEAREST, _LOG_FARTHEST)
    return replace(now, d=d, E=E, log_range=log_range, s=s, size=size, P=0.5 * (P + P.swapaxes(1, 2))), F


def _shaken(onto: Array, s: Array, scale: Array, step: Decay, walked: float) -> Array:
    """(n, 6, 6): what the noise of one step adds to (α, l, s). onto (n, 3, 3): from metres to (α, l); scale (n,): from
    m/s to s."""
    G = np.zeros((len(s), 6, 6))
    G[:, :3, :3] = onto
    G[:, SCALED_SPEED, :3] = -s[:, :, None] * G[:, 2, None, :3]
    Q = np.zeros((len(s), 6, 6))
    for i in (0, 1, 2):
        G[:, 3 + i, 3 + i] = scale
        Q[:, i, i] = step.pp + walked
        Q[:, i, 3 + i] = Q[:, 3 + i, i] = step.pv
        Q[:, 3 + i, 3 + i] = step.vv
    shaken: Array = G @ Q @ G.swapaxes(1, 2)
    return shaken


def corrected(prior: Beliefs, H: Array, nu: Array, R: Array) -> tuple[Beliefs, Array]:
    """Fold in one measurement of each row: H (n, m, 12), innovation nu (n, m), R (n, m, m). Also returns A (n, 12, 12),
    by which the error of the prior is left. A row of H that is zero measures nothing.

    Joseph form: stays symmetric and positive when R is tiny.
    """
    PHt = prior.P @ H.swapaxes(1, 2)
    S = H @ PHt + R
    K = np.linalg.solve(S, PHt.swapaxes(1, 2)).swapaxes(1, 2)
    A = _IDENTITY - K @ H
    P = A @ prior.P @ A.swapaxes(1, 2) + K @ R @ K.swapaxes(1, 2)
    moved, T = _moved(prior, (K @ nu[:, :, None])[:, :, 0])
    return replace(moved, P=_turned(0.5 * (P + P.swapaxes(1, 2)), T)), T @ A


def corrected_late(now: Beliefs, covariance: Array, nu: Array, V: Array) -> Beliefs:
    """Fold in what was measured of an earlier state of one row: its innovation nu (m,) against that state, V (m, m) its
    covariance, and covariance (12, m): of the error now with that innovation's. n = 1.

    Bar-Shalom, "Update with out-of-sequence measurements" (2002), with the estimate of then as it was then: a linear
    update whose second moments are all known, so that what it claims is what it has.
    """
    K = np.linalg.solve(V, covariance.T).T
    P = now.P - (K @ covariance.T)[None]
    moved, T = _moved(now, (K @ nu)[None])
    return replace(moved, P=_turned(0.5 * (P + P.swapaxes(1, 2)), T))


def _moved(prior: Beliefs, dx: Array) -> tuple[Beliefs, Array]:
    """The means moved by dx (n, 12), P as it was; and T (n, 12, 12), from the old axes to the new."""
    way = (prior.E @ dx[:, ACROSS_RAY, None])[:, :, 0]
    angle = np.sqrt((way * way).sum(axis=1))[:, None]
    d = prior.d * np.cos(angle) + way * np.sinc(angle / math.pi)
    d /= np.sqrt((d * d).sum(axis=1))[:, None]
    E = across(d)
    T = np.zeros((prior.n, STATE_SIZE, STATE_SIZE)) + _IDENTITY
    T[:, ACROSS_RAY, ACROSS_RAY] = E.swapaxes(1, 2) @ prior.E
    moved = Beliefs(
        d,
        E,
        np.clip(prior.log_range + dx[:, LOG_RANGE], _LOG_NEAREST, _LOG_FARTHEST),
        prior.s + dx[:, SCALED_SPEED],
        prior.size + dx[:, LASTING_SIZE : WANDERING_SIZE + 1],
        prior.place + dx[:, PLACE_ERROR],
        prior.turn + dx[:, HEADING_OFFSET],
        prior.P,
    )
    return moved, T


def _turned(P: Array, T: Array) -> Array:
    turned: Array = T @ P @ T.swapaxes(1, 2)
    return turned


class Cartesian(NamedTuple):
    """r (n, 3) m: teammate minus own camera; v (n, 3) m/s: the teammate's own velocity; both along the team's axes;
    cov (n, 6, 6) of both; range_sigma_log (n,)."""

    r: Array
    v: Array
    cov: Array
    range_sigma_log: Array


def cartesian(now: Beliefs, step: Decay | None = None) -> Cartesian:
    """In metres, and a step on where there is one. dr = exp(l) (E α + d dl), dv = v dl + exp(l) ds."""
    rho = np.exp(now.log_range)
    r, v = rho[:, None] * now.d, rho[:, None] * now.s
    J = np.zeros((now.n, 6, 6))
    J[:, :3, ACROSS_RAY] = rho[:, None, None] * now.E
    J[:, :3, LOG_RANGE] = r
    J[:, 3:, LOG_RANGE] = v
    J[:, 3, 3] = J[:, 4, 4] = J[:, 5, 5] = rho
    if step is not None:
        J[:, :3] += step.phi * J[:, 3:]
        J[:, 3:] *= step.left
        r, v = r + step.phi * v, step.left * v
    cov = J @ now.P[:, _MOVING, _MOVING] @ J.swapaxes(1, 2)
    if step is not None:
        for i in (0, 1, 2):
            cov[:, i, i] += step.pp
            cov[:, i, 3 + i] += step.pv
            cov[:, 3 + i, i] += step.pv
            cov[:, 3 + i, 3 + i] += step.vv
    return Cartesian(r, v, cov, np.sqrt(now.P[:, LOG_RANGE, LOG_RANGE]))
