"""Place, velocity and attitude error of this drone by rays and sizes, given where its teammates say they are.

Theory of operation. One state holds all that is unknown: the own place p and velocity v; by how much the autopilot's
position is off, o; its attitude's error θ; and of each teammate how far off its stated place is, f, its attitude's
error, the errors of the width of its boxes, s that lasts and w that wanders, and by how much its rays are late, τ. With
d a stated direction and u the unit vector of what lies between:

    own ray to j       d + θ × d = u,      u along (said − f) − (p + lever)
    its width          ln(W / w) = ln|(said − f) − (p + lever)| + s + w
    ray of j to us     d + θⱼ × d = u,     u along p − τ v − (stated camera − f)
    own autopilot      z = p + o

All of these are one extended Kalman filter. An error that lasts is a state, so many rays do not make it small.

The source of false positions is a discrete state: none, the own autopilot, or one teammate. The position of that source
drifts at an unknown rate, which is a state as well, so its positions count little, and its motion still counts. This is
an interacting multiple model estimator (Bar-Shalom, Li & Kirubarajan 2001, section 11.6.6): a filter per mode, all of
the same size, in one batch. What is read is the mixture's mean and covariance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from swarmtrack.carried.priors import (
    ADRIFT_WALK_M_SQRT_S,
    DRIFT_LASTS_S,
    DRIFT_SIGMA_M_S,
    FALSE_PER_S,
    NEAREST_ANCHOR_M,
    OWN_SPEED_LASTS_S,
    OWN_SPEED_SIGMA_M_S,
    PLACE_WALK_M_SQRT_S,
    RAY_LATE_SIGMA_S,
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
from swarmtrack.relative.log_range import SizeErrors, across, unit_decay

OWN_PLACE, OWN_SPEED, AUTOPILOT_OFFSET, OWN_TURN = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_DRIFT, _OWN = slice(12, 15), 15
_EACH: Final = 9
_LASTING_WIDTH, _WANDERING_WIDTH, _LATE = 6, 7, 8
"""Columns of a teammate."""
_WALKS: Final = np.array([TILT_WALK_RAD_SQRT_S, TILT_WALK_RAD_SQRT_S, TURN_WALK_RAD_SQRT_S]) ** 2
_LOG_2PI: Final = math.log(2.0 * math.pi)
_EYE: Final = np.eye(3)
NO_PUSH: Final = np.zeros(3)


class OwnRay(NamedTuple):
    """A ray of ours to a teammate: its stated place (3,) m and that place's variance [m² per axis]; direction (3,) and
    its covariance (3, 3) rad² in our axes; lever (3,) m: our camera less our body; log_range: by the box's width, NaN
    where that tells none, how many times the width's lasting error is in it and its wandering one, and the variance of
    the rest."""

    said: Array
    said_var: float
    direction: Array
    cov: Array
    lever: Array
    log_range: float = math.nan
    lasting: float = 1.0
    wandering: float = 1.0
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


class _ExpectedRay(NamedTuple):
    """What is expected of a ray by each mode. axes (3, 2) across the stated direction; aside (m, 2): the direction on
    them, and across (m, 2, 3) per metre of what lies between; log_range (m,), and along (m, 3) per metre; r (m,) m;
    bent (m,) rad²: second order of a place that is known badly."""

    axes: Array
    aside: Array
    across: Array
    log_range: Array
    along: Array
    r: Array
    bent: Array

    @classmethod
    def as_angles(cls, q: Array, d: Array, r: Array, bent: Array) -> _ExpectedRay:
        """Between places that are known well; q (m, 3) m from the one to the other, r (m,) m apart."""
        axes, u = across(d[None])[0], q / r[:, None]
        turned = (axes.T - (u @ axes)[:, :, None] * u[:, None, :]) / r[:, None, None]
        return cls(axes, u @ axes, turned, np.log(r), u / r[:, None], r, bent)

    @classmethod
    def in_metres(cls, q: Array, d: Array, r: Array) -> _ExpectedRay:
        """Across a ray, and along it at the distance r (m,) m: linear, however badly places are known."""
        axes, scaled = across(d[None])[0], q / r[:, None]
        turned, along = axes.T / r[:, None, None], d / r[:, None]
        return cls(axes, scaled @ axes, turned, np.log(r) + scaled @ d - 1.0, along, r, np.zeros(len(r)))


class OwnPlaceFilter:
    """All modes at once: x (m, n), P (m, n, n), weights (m,), at time `t` [s]. Mode 0: positions are sound; 1: not the
    autopilot's; 2 + k: not those of teammate k."""

    def __init__(
        self,
        t: float,
        place: Moments,
        speed: Moments,
        offset_cov: Array,
        turn_cov: Array,
        *,
        width: SizeErrors,
    ) -> None:
        """place (3,) m, speed (3,) m/s: of this drone by its autopilot; offset_cov (3, 3) m²: how far off that may be;
        turn_cov (3, 3) rad²: of its attitude."""
        self.t = t
        self._width = width
        x, P = np.zeros(_OWN), np.zeros((_OWN, _OWN))
        x[OWN_PLACE], x[OWN_SPEED] = place.mean, speed.mean
        P[OWN_PLACE, OWN_PLACE], P[OWN_SPEED, OWN_SPEED] = place.cov + offset_cov, speed.cov
        P[AUTOPILOT_OFFSET, AUTOPILOT_OFFSET], P[OWN_TURN, OWN_TURN] = offset_cov, turn_cov
        P[_DRIFT, _DRIFT] = DRIFT_SIGMA_M_S**2 * _EYE
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
        prior[_LASTING_WIDTH, _LASTING_WIDTH] = width_sigma**2
        prior[_WANDERING_WIDTH, _WANDERING_WIDTH] = self._width.wandering**2
        prior[_LATE, _LATE] = RAY_LATE_SIGMA_S**2
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
        for moved in (self._x[:, :, None], self._P, self._P.swapaxes(1, 2)):
            self._move(moved, dt)
        self._x[:, OWN_PLACE] += 0.5 * dt**2 * push
        self._x[:, OWN_SPEED] += dt * push
        self._P += self._noise(dt)

    def _move(self, of: Array, dt: float) -> None:
        """In place: the transition times of (m, n, k)."""
        unit = unit_decay(dt, OWN_SPEED_LASTS_S)
        of[:, OWN_PLACE] += unit.phi * of[:, OWN_SPEED]
        of[:, OWN_SPEED] *= unit.left
        for mode, column in self._sources():
            of[mode, column : column + 3] += dt * of[mode, _DRIFT]
        # Where all is sound, how fast a false position would drift is unknown, whatever it did before.
        of[0, _DRIFT] = 0.0
        of[1:, _DRIFT] *= math.exp(-dt / DRIFT_LASTS_S)
        of[:, self._wandering] *= math.exp(-dt / self._width.wander_s)

    def _sources(self) -> Iterator[tuple[int, int]]:
        """Each mode but the first, and the column of whose positions are false in it."""
        return enumerate((AUTOPILOT_OFFSET.start, *self._columns.values()), start=1)

    @property
    def _wandering(self) -> list[int]:
        """Where the wandering errors of widths stand."""
        return [column + _WANDERING_WIDTH for column in self._columns.values()]

    def _noise(self, dt: float) -> Array:
        """(m, n, n)"""
        modes, n = self._x.shape
        unit, density = unit_decay(dt, OWN_SPEED_LASTS_S), 2.0 * OWN_SPEED_SIGMA_M_S**2 / OWN_SPEED_LASTS_S
        Q = np.zeros((modes, n, n))
        i = np.arange(3)
        Q[:, i, i], Q[:, 3 + i, 3 + i] = density * unit.pp, density * unit.vv
        Q[:, i, 3 + i] = Q[:, 3 + i, i] = density * unit.pv
        drift = _DRIFT.start + i
        Q[0, drift, drift] = DRIFT_SIGMA_M_S**2
        Q[1:, drift, drift] = -math.expm1(-2.0 * dt / DRIFT_LASTS_S) * DRIFT_SIGMA_M_S**2
        wanders = -math.expm1(-2.0 * dt / self._width.wander_s)
        Q[:, self._wandering, self._wandering] = wanders * self._width.wandering**2
        for mode, column in self._sources():
            at = column + i
            Q[:, at, at] = PLACE_WALK_M_SQRT_S**2 * dt
            Q[mode, at, at] = ADRIFT_WALK_M_SQRT_S**2 * dt
            Q[:, 3 + at, 3 + at] = _WALKS * dt
            if column >= _OWN:
                Q[:, column + _LASTING_WIDTH, column + _LASTING_WIDTH] = WIDTH_WALK_SQRT_S**2 * dt
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

    # --- measurements: each returns whether it was believed ---

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
        width, gain = slice(f + _LASTING_WIDTH, f + _LATE), np.array([ray.lasting, ray.wandering])
        log_range = ray.log_range - self._x[:, width] @ gain
        expected = self._expected(q, ray.direction, np.exp(log_range))
        if expected is None:
            return False
        nu, H = self._across(expected, ray.direction, OWN_TURN.start)
        H[:, :, OWN_PLACE] = H[:, :, f : f + 3] = -expected.across
        white = ray.said_var / expected.r**2 + expected.bent
        R = (expected.axes.T @ ray.cov @ expected.axes)[None] + white[:, None, None] * np.eye(2)
        if math.isfinite(ray.log_range):
            nu, R = np.column_stack([nu, log_range - expected.log_range]), _padded(R)
            H = np.concatenate([H, np.zeros_like(H[:, :1])], axis=1)
            H[:, 2, OWN_PLACE] = H[:, 2, f : f + 3] = -expected.along
            H[:, 2, width] = gain
            R[:, 2, 2] = ray.range_var + white
        return self._fold(nu, H, R)

    def hear_ray(self, drone_id: int, ray: TheirRay, jerked: float) -> bool:
        """A ray of a teammate to us. jerked [m² per axis]: by how much the own place then is known worse than by its
        velocity."""
        f = self._columns[drone_id]
        dt, speed = ray.dt - self._x[:, f + _LATE, None], self._x[:, OWN_SPEED]
        q = self._x[:, OWN_PLACE] + dt * speed + self._x[:, f : f + 3] - ray.camera
        expected = self._expected(q, ray.direction)
        if expected is None:
            return False
        nu, H = self._across(expected, ray.direction, f + 3)
        H[:, :, OWN_PLACE] = H[:, :, f : f + 3] = expected.across
        H[:, :, OWN_SPEED] = dt[:, None] * expected.across
        H[:, :, f + _LATE] = -(expected.across @ speed[:, :, None])[:, :, 0]
        white = ray.sigma**2 + (ray.camera_var + jerked) / expected.r**2 + expected.bent
        return self._fold(nu, H, white[:, None, None] * np.eye(2))

    def _expected(self, q: Array, d: Array, measured: Array | float = math.nan) -> _ExpectedRay | None:
        """From one drone to the other, q (m, 3) m as expected, along the stated direction d (3,); measured (m,) m: the
        distance by a width, NaN where that tells none. None where d leads the other way."""
        distance, has_width = np.sqrt((q * q).sum(axis=1)), np.isfinite(measured)
        vague = np.trace(self._P[:, OWN_PLACE, OWN_PLACE], axis1=1, axis2=2) / 3.0
        worst = float(self.moments(OWN_PLACE).cov.diagonal().max())
        if worst > (VAGUE_SHARE * float(self.weights @ np.where(has_width, measured, distance))) ** 2:
            supposed = np.hypot(np.maximum(q @ d, NEAREST_ANCHOR_M), np.sqrt(vague))
            return _ExpectedRay.in_metres(q, d, np.where(has_width, measured, supposed))
        if (
            float(self.weights @ (q @ d / np.maximum(distance, 1e-6))) < 0.5
            or distance.min() < NEAREST_ANCHOR_M
        ):
            return None
        return _ExpectedRay.as_angles(q, d, distance, (vague / distance**2) ** 2)

    def _across(self, expected: _ExpectedRay, d: Array, turn: int) -> tuple[Array, Array]:
        """Innovation (m, 2) and H (m, 2, n), but for places, of a stated direction d (3,) of an observer whose
        attitude error stands at turn."""
        theta = self._x[:, turn : turn + 3]
        H = np.zeros((len(theta), 2, self._x.shape[1]))
        H[:, :, turn : turn + 3] = expected.axes.T @ hat(d)
        return np.cross(theta, d) @ expected.axes - expected.aside, H

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
        # Joseph form, multiplied out: symmetric, and of second order in the rounding of K.
        P = self._P - 2.0 * (PHt @ K.swapaxes(1, 2)) + K @ S @ K.swapaxes(1, 2)
        self._P = 0.5 * (P + P.swapaxes(1, 2))
        return True


def _padded(R: Array) -> Array:
    """(m, 2, 2) in the corner of (m, 3, 3)."""
    padded = np.zeros((len(R), 3, 3))
    padded[:, :2, :2] = R
    return padded
