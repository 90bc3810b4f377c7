"""Place, velocity and attitude error of this drone by rays and sizes, given where its teammates say they are.

Theory of operation. One state holds all that is unknown: the own place p and velocity v; by how much the autopilot's
position is off, o; its attitude's error θ; and of each teammate how far off its stated place is, f, its attitude's
error, and the lasting error s of its boxes. With d a stated direction and u the unit vector of what lies between:

    own ray to j       d + θ × d = u,      u along (said − f) − (p + lever)
    its width          ln(W / w) = ln|(said − f) − (p + lever)| + s
    ray of j to us     d + θⱼ × d = u,     u along p − (stated camera − f)
    own autopilot      z = p + o

All of these are one extended Kalman filter. An error that lasts is a state, so many rays do not make it small.

The source of false positions is a discrete state: none, the own autopilot, or one teammate. The position of that source
walks 25 times as fast, so its positions count little, and its motion still counts. This is an
interacting multiple model estimator (Bar-Shalom, Li & Kirubarajan 2001, section 11.6.6): a filter per mode, all of the
same size, in one batch. What is read is the mixture's mean and covariance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from swarmtrack.carried.priors import (
    ADRIFT_WALK_M_SQRT_S,
    FALSE_PER_S,
    NEAREST_ANCHOR_M,
    OWN_SPEED_LASTS_S,
    OWN_SPEED_SIGMA_M_S,
    PLACE_WALK_M_SQRT_S,
    RIGHT_AGAIN_S,
    TEAMMATE_TILT_SIGMA_RAD,
    TEAMMATE_TURN_SIGMA_RAD,
    TILT_WALK_RAD_SQRT_S,
    TURN_WALK_RAD_SQRT_S,
    VAGUE_SHARE,
    WIDTH_WALK_SQRT_S,
)
from swarmtrack.geometry.rotation import hat
from swarmtrack.messages import Array
from swarmtrack.relative.gates import GATE
from swarmtrack.relative.log_range import across, unit_decay

OWN_PLACE, OWN_SPEED, AUTOPILOT_OFFSET, OWN_TURN = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_OWN: Final = 12
_EACH: Final = 7
_WALKS: Final = np.array([TILT_WALK_RAD_SQRT_S, TILT_WALK_RAD_SQRT_S, TURN_WALK_RAD_SQRT_S]) ** 2
_LOG_2PI: Final = math.log(2.0 * math.pi)
_EYE: Final = np.eye(3)
NO_PUSH: Final = np.zeros(3)


class OwnRay(NamedTuple):
    """A ray of ours to a teammate: its stated place (3,) m and that place's variance [m² per axis]; direction (3,) and
    its covariance (3, 3) rad² in our axes; lever (3,) m: our camera less our body; log_range: by the box's width, NaN
    where that tells none, how many times the width's lasting error is in it, and the variance of the rest."""

    said: Array
    said_var: float
    direction: Array
    cov: Array
    lever: Array
    log_range: float = math.nan
    lasting: float = 1.0
    range_var: float = 1.0


class TheirRay(NamedTuple):
    """A ray of a teammate to us: from its stated camera (3,) m ± var [m² per axis], direction (3,) ± sigma [rad] white,
    dt [s] after the filter's time."""

    camera: Array
    camera_var: float
    direction: Array
    sigma: float
    dt: float


class Moments(NamedTuple):
    """Mean (k,) and covariance (k, k) of a part of the state."""

    mean: Array
    cov: Array


class OwnPlaceFilter:
    """All modes at once: x (m, n), P (m, n, n), weights (m,), at time `t` [s]. Mode 0: positions are sound; 1: not the
    autopilot's; 2 + k: not those of teammate k."""

    def __init__(self, t: float, place: Moments, speed: Moments, offset_cov: Array, turn_cov: Array) -> None:
        """place (3,) m, speed (3,) m/s: of this drone by its autopilot; offset_cov (3, 3) m²: how far off that may be;
        turn_cov (3, 3) rad²: of its attitude."""
        self.t = t
        x, P = np.zeros(_OWN), np.zeros((_OWN, _OWN))
        x[OWN_PLACE], x[OWN_SPEED] = place.mean, speed.mean
        P[OWN_PLACE, OWN_PLACE], P[OWN_SPEED, OWN_SPEED] = place.cov + offset_cov, speed.cov
        P[AUTOPILOT_OFFSET, AUTOPILOT_OFFSET], P[OWN_TURN, OWN_TURN] = offset_cov, turn_cov
        P[OWN_PLACE, AUTOPILOT_OFFSET] = P[AUTOPILOT_OFFSET, OWN_PLACE] = -offset_cov
        self.weights = np.array([1.0, 0.0])
        self._x, self._P = np.stack([x, x]), np.stack([P, P])
        self._columns: dict[int, int] = {}

    def __contains__(self, drone_id: int) -> bool:
        return drone_id in self._columns

    def __len__(self) -> int:
        """How many teammates are in it."""
        return len(self._columns)

    def __iter__(self) -> Iterator[int]:
        return iter(self._columns)

    def add_teammate(self, drone_id: int, place_cov: Array, width_sigma: float) -> None:
        """place_cov (3, 3) m²: of its stated places, what lasts; width_sigma: of ln(width), what lasts."""
        n = self._x.shape[1]
        self._columns[drone_id] = n
        prior = np.zeros((_EACH, _EACH))
        prior[:3, :3] = place_cov
        tilt, turn = TEAMMATE_TILT_SIGMA_RAD**2, TEAMMATE_TURN_SIGMA_RAD**2
        prior[[3, 4, 5], [3, 4, 5]] = tilt, tilt, turn
        prior[6, 6] = width_sigma**2
        x, P = np.zeros((len(self._x) + 1, n + _EACH)), np.zeros((len(self._x) + 1, n + _EACH, n + _EACH))
        x[:-1, :n], P[:-1, :n, :n] = self._x, self._P
        x[-1, :n], P[-1, :n, :n] = self._x[0], self._P[0]
        P[:, n:, n:] = prior
        self._x, self._P = x, P
        self.weights = np.append(self.weights, 0.0)

    def remove_teammate(self, drone_id: int) -> None:
        """Without it, that its positions were false is as good as that all are sound."""
        mode, column = 2 + list(self._columns).index(drone_id), self._columns.pop(drone_id)
        both = [0, mode]
        weight = self.weights[both].sum()
        share = self.weights[both] / weight if weight else np.array([1.0, 0.0])
        mean = share @ self._x[both]
        off = self._x[both] - mean
        self._P[0] = np.tensordot(share, self._P[both], 1) + (share[:, None] * off).T @ off
        self._x[0], self.weights[0] = mean, weight
        gone = np.arange(column, column + _EACH)
        self.weights, x = np.delete(self.weights, mode), np.delete(self._x, mode, 0)
        self._x = np.delete(x, gone, 1)
        self._P = np.delete(np.delete(np.delete(self._P, mode, 0), gone, 1), gone, 2)
        self._columns = {id: at - _EACH * (at > column) for id, at in self._columns.items()}

    def moments(self, part: slice) -> Moments:
        """Mean and covariance of the mixture."""
        x = self._x[:, part]
        mean = self.weights @ x
        off = x - mean
        cov = np.tensordot(self.weights, self._P[:, part, part], 1) + (self.weights[:, None] * off).T @ off
        return Moments(mean, cov)

    # --- time ---

    def predict(self, t: float, push: Array = NO_PUSH) -> None:
        """To t [s], not before the filter's time. push (3,) m/s²: what the velocity has gained per second, by the
        tilt."""
        dt, self.t = t - self.t, t
        if dt <= 0.0:
            return
        self._mix(dt)
        n = self._x.shape[1]
        unit = unit_decay(dt, OWN_SPEED_LASTS_S)
        F = np.eye(n)
        for i in (0, 1, 2):
            F[i, 3 + i], F[3 + i, 3 + i] = unit.phi, unit.left
        self._x = self._x @ F.T
        self._x[:, OWN_PLACE] += 0.5 * dt**2 * push
        self._x[:, OWN_SPEED] += dt * push
        self._P = F @ self._P @ F.T
        self._P += self._noise(dt, unit.pp, unit.pv, unit.vv)

    def _noise(self, dt: float, pp: float, pv: float, vv: float) -> Array:
        """(m, n, n)"""
        modes, n = self._x.shape
        density = 2.0 * OWN_SPEED_SIGMA_M_S**2 / OWN_SPEED_LASTS_S
        Q = np.zeros((modes, n, n))
        i = np.arange(3)
        Q[:, i, i], Q[:, 3 + i, 3 + i] = density * pp, density * vv
        Q[:, i, 3 + i] = Q[:, 3 + i, i] = density * pv
        for mode, column in enumerate((AUTOPILOT_OFFSET.start, *self._columns.values()), start=1):
            at = column + i
            Q[:, at, at] = PLACE_WALK_M_SQRT_S**2 * dt
            Q[mode, at, at] = ADRIFT_WALK_M_SQRT_S**2 * dt
            Q[:, 3 + at, 3 + at] = _WALKS * dt
            if column >= _OWN:
                Q[:, column + 6, column + 6] = WIDTH_WALK_SQRT_S**2 * dt
        return Q

    def _mix(self, dt: float) -> None:
        """A word may become false, and right again."""
        modes = len(self.weights)
        false, right = 1.0 - math.exp(-FALSE_PER_S * dt), 1.0 - math.exp(-dt / RIGHT_AGAIN_S)
        # (from, to)
        T = (1.0 - right) * np.eye(modes)
        T[:, 0] += right
        T[0] = false
        T[0, 0] = 1.0 - (modes - 1) * false
        joint = self.weights[:, None] * T
        self.weights = joint.sum(axis=0)
        share = (joint / self.weights).T
        mean = share @ self._x
        off = self._x[None] - mean[:, None]
        spread = (share[:, :, None] * off).swapaxes(1, 2) @ off
        self._P = (share @ self._P.reshape(modes, -1)).reshape(self._P.shape) + spread
        self._x = mean

    def trust_autopilot(self, offset: Moments) -> None:
        """Take the autopilot's position as sound, and off by so much (3,) m."""
        self.weights = np.eye(len(self.weights))[0]
        self._x[:, AUTOPILOT_OFFSET] = offset.mean
        self._P[:, AUTOPILOT_OFFSET] = self._P[:, :, AUTOPILOT_OFFSET] = 0.0
        self._P[:, AUTOPILOT_OFFSET, AUTOPILOT_OFFSET] = offset.cov

    def let_go(self) -> None:
        """Without any holder, forget the velocity."""
        self._x[:, OWN_SPEED] = 0.0
        self._P[:, OWN_SPEED] = self._P[:, :, OWN_SPEED] = 0.0
        self._P[:, OWN_SPEED, OWN_SPEED] = OWN_SPEED_SIGMA_M_S**2 * _EYE

    # --- measurements: each returns whether it was believed ---

    def is_vague(self, distance: float) -> bool:
        """Whether the own place is known too badly for a ray to something at that distance [m] to be linear."""
        worst = float(self.moments(OWN_PLACE).cov.diagonal().max())
        return worst > (VAGUE_SHARE * distance) ** 2

    def begin_at(self, drone_id: int, ray: OwnRay) -> None:
        """The own place is known by nothing but one ray to a teammate and its width."""
        f = self._columns[drone_id]
        distance = math.exp(ray.log_range)
        u, S = ray.direction, self._P[0, f + 6, f + 6]
        along = (ray.lasting**2 * S + ray.range_var) * distance**2
        cov = along * np.outer(u, u) + ray.said_var * _EYE + distance**2 * ray.cov
        cov = cov + self._P[0, f : f + 3, f : f + 3] + (distance * TEAMMATE_TURN_SIGMA_RAD) ** 2 * _EYE
        self._x[:, OWN_PLACE] = ray.said - ray.lever - distance * u
        self._P[:, :3] = self._P[:, :, :3] = 0.0
        self._P[:, OWN_PLACE, OWN_PLACE] = cov
        self.let_go()

    def hear_autopilot(self, place: Array, var: float) -> bool:
        """The autopilot's position (3,) m ± var [m² per axis] at the filter's time."""
        modes, n = self._x.shape
        H = np.zeros((modes, 3, n))
        H[:, :, OWN_PLACE] = H[:, :, AUTOPILOT_OFFSET] = _EYE
        nu = place - self._x[:, OWN_PLACE] - self._x[:, AUTOPILOT_OFFSET]
        return self._fold(nu, H, var * _EYE)

    def see(self, drone_id: int, ray: OwnRay) -> bool:
        """A ray to a teammate, and its width."""
        f = self._columns[drone_id]
        q = ray.said - ray.lever - self._x[:, f : f + 3] - self._x[:, OWN_PLACE]
        found = self._across(q, ray.direction, OWN_TURN.start)
        if found is None:
            return False
        nu, H, u, r, E = found
        J = (E.T - (u @ E)[:, :, None] * u[:, None, :]) / r[:, None, None]
        H[:, :, OWN_PLACE] = H[:, :, f : f + 3] = -J
        R = (E.T @ ray.cov @ E)[None] + (ray.said_var / r**2 + self._bent(r))[:, None, None] * np.eye(2)
        if math.isfinite(ray.log_range):
            nu, R = (
                np.column_stack([nu, ray.log_range - np.log(r) - ray.lasting * self._x[:, f + 6]]),
                _padded(R),
            )
            H = np.concatenate([H, np.zeros_like(H[:, :1])], axis=1)
            H[:, 2, OWN_PLACE] = H[:, 2, f : f + 3] = -u / r[:, None]
            H[:, 2, f + 6] = ray.lasting
            R[:, 2, 2] = ray.range_var + ray.said_var / r**2 + self._bent(r)
        return self._fold(nu, H, R)

    def hear_ray(self, drone_id: int, ray: TheirRay, jerked: float) -> bool:
        """A ray of a teammate to us. jerked [m² per axis]: by how much the own place then is known worse than by its
        velocity."""
        f = self._columns[drone_id]
        q = self._x[:, OWN_PLACE] + ray.dt * self._x[:, OWN_SPEED] + self._x[:, f : f + 3] - ray.camera
        found = self._across(q, ray.direction, f + 3)
        if found is None:
            return False
        nu, H, u, r, E = found
        J = (E.T - (u @ E)[:, :, None] * u[:, None, :]) / r[:, None, None]
        H[:, :, OWN_PLACE] = H[:, :, f : f + 3] = J
        H[:, :, OWN_SPEED] = ray.dt * J
        white = ray.sigma**2 + (ray.camera_var + jerked) / r**2 + self._bent(r)
        R = white[:, None, None] * np.eye(2)
        return self._fold(nu, H, R)

    def _bent(self, r: Array) -> Array:
        """(m,) rad²: second order of a ray over distances r (m,) m from a place that is known badly."""
        vague = np.trace(self._P[:, OWN_PLACE, OWN_PLACE], axis1=1, axis2=2) / 3.0
        return np.asarray((vague / r**2) ** 2)

    def _across(self, q: Array, d: Array, turn: int) -> tuple[Array, Array, Array, Array, Array] | None:
        """By q (m, 3) m from the one drone to the other, and the stated direction d (3,): innovation (m, 2), H
        (m, 2, n) but for places, u (m, 3), r (m,), and the axes (3, 2) across d. turn: where the observer's attitude
        error stands. None where it leads the other way."""
        r = np.sqrt((q * q).sum(axis=1))
        u = q / np.maximum(r, 1e-6)[:, None]
        if float(self.weights @ (u @ d)) < 0.5 or r.min() < NEAREST_ANCHOR_M:
            return None
        E = across(d[None])[0]
        theta = self._x[:, turn : turn + 3]
        nu = (np.cross(theta, d) - u) @ E
        H = np.zeros((len(q), 2, self._x.shape[1]))
        H[:, :, turn : turn + 3] = E.T @ hat(d)
        return nu, H, u, r, E

    def _fold(self, nu: Array, H: Array, R: Array) -> bool:
        """Innovations (m, k), H (m, k, n), R (k, k) or (m, k, k). A measurement that no mode expects is rejected."""
        PHt = self._P @ H.swapaxes(1, 2)
        S = H @ PHt + R
        K = np.linalg.solve(S, PHt.swapaxes(1, 2)).swapaxes(1, 2)
        d2 = (nu * np.linalg.solve(S, nu[:, :, None])[:, :, 0]).sum(axis=1)
        k = nu.shape[1]
        if not float(d2[self.weights > 1e-6].min()) < GATE[k]:
            return False
        log = -0.5 * (d2 + np.linalg.slogdet(S)[1] + k * _LOG_2PI) + np.log(np.maximum(self.weights, 1e-300))
        weights = np.exp(log - log.max())
        self.weights = weights / weights.sum()
        self._x = self._x + (K @ nu[:, :, None])[:, :, 0]
        A = np.eye(H.shape[2]) - K @ H
        # Joseph form: stays symmetric and positive when R is tiny.
        P = A @ self._P @ A.swapaxes(1, 2) + K @ R @ K.swapaxes(1, 2)
        self._P = 0.5 * (P + P.swapaxes(1, 2))
        return True


def _padded(R: Array) -> Array:
    """(m, 2, 2) in the corner of (m, 3, 3)."""
    padded = np.zeros((len(R), 3, 3))
    padded[:, :2, :2] = R
    return padded
