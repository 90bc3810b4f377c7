"""Where strangers are and how they move, by the rays of several observers: one Gaussian of all of them together.

Theory of operation. A ray is off by what changes from scan to scan, and by what lasts: its observer's heading, tilt and
place. What lasts is taken for a state of the observer, because a filter that takes it for noise is soon too sure. All
observers and all strangers are in one state, so that what one stranger shows of an observer's heading counts for the
others, and so do the observers' rays to each other.

A stranger is at a + b + exp(l) d, where a is the place at which its first observer stated that it was and b that
observer's error, and has the velocity exp(l) s: with one observer its range is a guess, and the posterior is a Gaussian
in the logarithm of the range (`relative/log_range.py`). Were a place counted without b, the first observer's own rays
would seem to show its b, and by that a range. The size of its boxes shows the range but for e, by which the stranger is
larger than drones usually are. Error states:

    stranger: α (2) across d, l, s (3), e          observer: ϑ (3) rad, b (3) m

An observer at c + b sees the direction m = u − ϑ × u of what is in the direction u. A ray is folded in by Gauss-Newton
steps (Bell and Cathey, 1993, "The iterated Kalman filter update as a Gauss-Newton method"): where the range is a guess,
one step is not enough. The cost at the end is the gate, which holds also where the prior is wide.

A ray that is late is compared with where the stranger was then by its present velocity; how it may have flown otherwise
is noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from swarmtrack.geometry.rotation import hat
from swarmtrack.messages import Array
from swarmtrack.relative import log_range
from swarmtrack.relative.priors import RELATIVE_FARTHEST_M, RELATIVE_NEAREST_M
from swarmtrack.strangers.priors import (
    ANCHOR_LEAST_M,
    ANCHOR_SIGMA_LN,
    ANCHOR_STEP_M,
    OBSERVER_ATTITUDE_LASTS_S,
    OBSERVER_PLACE_LASTS_S,
    RAY_GATE,
    RAY_LEAST_COSINE,
    RAY_STEP_MOST_LN,
    RAY_STEP_SMALL,
    RAY_STEPS,
    SIZE_GATE,
    SIZE_SHOWS_SIGMA_LN,
    VISITOR_ACCELERATION_PSD_M2_S3,
    VISITOR_BOX_SIGMA_LN,
    VISITOR_CLIMB_M_S,
    VISITOR_DISTANCE_M,
    VISITOR_DISTANCE_SIGMA_LN,
    VISITOR_SIZE_SIGMA_LN,
    VISITOR_SPEED_M_S,
)

_STRANGER_STATES, _OBSERVER_STATES = 7, 6
_ACROSS, _RANGE, _SPEED, _MOVING, _SIZE = slice(0, 2), 2, slice(3, 6), slice(0, 6), 6
_LOG_NEAREST, _LOG_FARTHEST = math.log(RELATIVE_NEAREST_M), math.log(RELATIVE_FARTHEST_M)
_TURN, _PLACE = slice(0, 3), slice(3, 6)
_EYE: Final = np.eye(3)


class Errors(NamedTuple):
    """What lasts of an observer's errors, one sigma: its place, m per axis, its tilt and its heading, rad."""

    place: float
    tilt: float
    heading: float


class Ray(NamedTuple):
    """At t [s] an observer whose camera it states at (3,) m sees something in the direction (3,), team axes; sigma rad
    per axis, without what lasts. range_ln: ln of its distance [m] if it is as large as drones usually are; NaN where
    its box does not tell. t_sigma s."""

    observer: int
    t: float
    camera: Array
    direction: Array
    sigma: float
    errors: Errors
    range_ln: float = math.nan
    t_sigma: float = 0.0


class RayFit(NamedTuple):
    """How a ray fits a stranger: cost, as a squared Mahalanobis distance with two degrees of freedom, and log_density
    of the ray per rad²."""

    cost: float
    log_density: float


class StrangerPlace(NamedTuple):
    """position (3,) m and velocity (3,) m/s in team axes, cov (6, 6) of both."""

    position: Array
    velocity: Array
    cov: Array


@dataclass(slots=True)
class _Stranger:
    first: int
    anchor: Array
    d: Array
    E: Array
    log_range: float
    s: Array
    size: float = 0.0

    def moved(self, x: Array) -> _Stranger:
        """By an error state (7,); E stays."""
        way = self.E @ x[_ACROSS]
        angle = float(np.linalg.norm(way))
        d = self.d * math.cos(angle) + way * float(np.sinc(angle / math.pi))
        log_range = min(max(self.log_range + float(x[_RANGE]), _LOG_NEAREST), _LOG_FARTHEST)
        return replace(self, d=d, log_range=log_range, s=self.s + x[_SPEED], size=self.size + float(x[_SIZE]))

    def at(self, before: float) -> tuple[Array, Array]:
        """StrangerPlace (3,) m, `before` s ago, without its first observer's error, and its derivatives (3, 7)."""
        rho = math.exp(self.log_range)
        flown = self.d - before * self.s
        J = np.zeros((3, _STRANGER_STATES))
        J[:, _ACROSS] = rho * (self.E - np.outer(self.d, self.d @ self.E))
        J[:, _RANGE] = rho * flown
        J[:, _SPEED] = -before * rho * _EYE
        return self.anchor + rho * flown, J


@dataclass(slots=True)
class _Observer:
    turn: Array
    place: Array
    errors: Errors

    def moved(self, x: Array) -> _Observer:
        return _Observer(self.turn + x[_TURN], self.place + x[_PLACE], self.errors)

    @property
    def variances(self) -> Array:
        e = self.errors
        return np.array([e.tilt, e.tilt, e.heading, e.place, e.place, e.place]) ** 2


_Key = tuple[str, int]
_Model = Callable[["_State"], tuple[Array, Array]]
"""ν (m,) of a measurement, and H (m, n)."""


class _State(NamedTuple):
    strangers: dict[int, _Stranger]
    observers: dict[int, _Observer]


class _RaySolution(NamedTuple):
    x: Array
    H: Array
    S: Array
    cost: float


class RayFilter:
    """Stands at `t`, the newest ray's; None before the first. Rays come in about the order of their times."""

    def __init__(self) -> None:
        self.t: float | None = None
        self._state = _State({}, {})
        self._offset: dict[_Key, int] = {}
        self._P = np.zeros((0, 0))

    @property
    def numbers(self) -> tuple[int, ...]:
        """The strangers' numbers."""
        return tuple(self._state.strangers)

    @property
    def observers(self) -> tuple[int, ...]:
        return tuple(self._state.observers)

    # --- what there is ---

    def observe_from(self, observer: int, errors: Errors) -> None:
        """An observer takes part, and what lasts of its errors is as large as it states now."""
        known = self._state.observers.get(observer)
        if known is not None:
            known.errors = errors
            return
        made = _Observer(np.zeros(3), np.zeros(3), errors)
        self._state.observers[observer] = made
        self._append(
            ("observer", observer), np.diag(made.variances), np.zeros((_OBSERVER_STATES, len(self._P)))
        )

    def begin(self, number: int, ray: Ray) -> None:
        """A new stranger is on this ray, at the distance that its box tells. Its observer takes part."""
        self.predict(ray.t)
        self.observe_from(ray.observer, ray.errors)
        seen_by = self._state.observers[ray.observer]
        d = ray.direction + np.cross(seen_by.turn, ray.direction)
        d /= np.linalg.norm(d)
        E = log_range.across(d[None])[0]
        told = math.isfinite(ray.range_ln)
        distance_ln = ray.range_ln if told else math.log(VISITOR_DISTANCE_M)
        self._state.strangers[number] = _Stranger(ray.observer, ray.camera, d, E, distance_ln, np.zeros(3))
        J = np.zeros((_STRANGER_STATES, _OBSERVER_STATES))
        J[_ACROSS, _TURN] = -E.T @ hat(d)
        cross = J @ self._P[self._slice("observer", ray.observer)]
        speed = np.array([VISITOR_SPEED_M_S, VISITOR_SPEED_M_S, VISITOR_CLIMB_M_S]) / math.exp(distance_ln)
        size = VISITOR_SIZE_SIGMA_LN**2
        R = np.diag([ray.sigma**2, ray.sigma**2, VISITOR_DISTANCE_SIGMA_LN**2, *speed**2, size])
        if told:
            R[_RANGE, _RANGE], R[_RANGE, _SIZE], R[_SIZE, _RANGE] = (
                size + VISITOR_BOX_SIGMA_LN**2,
                -size,
                -size,
            )
        block = cross[:, self._slice("observer", ray.observer)] @ J.T + R
        self._append(("stranger", number), block, cross)

    def end(self, number: int) -> None:
        """A stranger is no more; unknown numbers are ignored."""
        if self._state.strangers.pop(number, None) is not None:
            self._remove(("stranger", number))

    def forget(self, observer: int) -> None:
        """An observer takes part no more, and nothing is known of the strangers that it saw first."""
        for number in [n for n, one in self._state.strangers.items() if one.first == observer]:
            self.end(number)
        if self._state.observers.pop(observer, None) is not None:
            self._remove(("observer", observer))

    # --- what is measured ---

    def predict(self, t: float) -> None:
        """To t [s]; backwards nothing happens."""
        if self.t is None or t <= self.t:
            self.t = t if self.t is None else self.t
            return
        dt, self.t = t - self.t, t
        n = len(self._P)
        F, Q = np.eye(n), np.zeros((n, n))
        for number, stranger in self._state.strangers.items():
            at = self._slice("stranger", number)
            F[at, at][_MOVING, _MOVING], Q[at, at][_MOVING, _MOVING] = _flown(stranger, dt)
        for observer, known in self._state.observers.items():
            at = self._slice("observer", observer)
            left = np.repeat(
                [math.exp(-dt / OBSERVER_ATTITUDE_LASTS_S), math.exp(-dt / OBSERVER_PLACE_LASTS_S)], 3
            )
            known.turn, known.place = left[_TURN] * known.turn, left[_PLACE] * known.place
            F[at, at], Q[at, at] = np.diag(left), np.diag((1.0 - left**2) * known.variances)
        self._P = F @ self._P @ F.T + Q
        for number, stranger in self._state.strangers.items():
            k = self._offset["stranger", number] + _RANGE
            if math.exp(stranger.log_range) < ANCHOR_LEAST_M and self._P[k, k] < ANCHOR_SIGMA_LN**2:
                self._move_anchor(number, stranger)

    def fit(self, number: int, ray: Ray) -> RayFit:
        """How well a ray fits a stranger; nothing changes but that its observer takes part."""
        self.observe_from(ray.observer, ray.errors)
        solved = self._solve(self._seen(number, ray), ray.sigma**2 + self._late(number, ray))
        if solved is None:
            return RayFit(math.inf, -math.inf)
        log_density = -0.5 * (solved.cost + math.log(float(np.linalg.det(solved.S)))) - math.log(
            2.0 * math.pi
        )
        return RayFit(solved.cost, log_density)

    def fold(self, number: int, ray: Ray) -> bool:
        """A ray to a stranger corrects all; False where it does not fit, and nothing changes."""
        self.predict(ray.t)
        self.observe_from(ray.observer, ray.errors)
        fits = self._fold(self._seen(number, ray), ray.sigma**2 + self._late(number, ray), RAY_GATE)
        k = self._offset["stranger", number] + _RANGE
        if fits and math.isfinite(ray.range_ln) and self._P[k, k] > SIZE_SHOWS_SIGMA_LN**2:
            self._fold(self._sized(number, ray), VISITOR_BOX_SIGMA_LN**2, SIZE_GATE)
        return fits

    def calibrate(self, ray: Ray, mate: int, place: Array, errors: Errors) -> bool:
        """A ray to another observer, whose place (3,) m it states; False where it does not fit."""
        self.observe_from(ray.observer, ray.errors)
        self.observe_from(mate, errors)

        def model(state: _State) -> tuple[Array, Array]:
            there = place + state.observers[mate].place
            nu, H, by_place = self._looked(state.observers[ray.observer], ray, there)
            H[:, self._slice("observer", mate)][:, _PLACE] += by_place
            return nu, H

        return self._fold(model, ray.sigma**2, RAY_GATE)

    # --- what is known ---

    def place(self, number: int, t: float) -> StrangerPlace:
        """The place of a stranger, carried on to t."""
        assert self.t is not None
        one, first = (
            self._state.strangers[number],
            self._slice("observer", self._state.strangers[number].first),
        )
        dt = max(t - self.t, 0.0)
        rho = math.exp(one.log_range)
        there, by_state = one.at(-dt)
        velocity = rho * one.s
        J = np.zeros((6, len(self._P)))
        J[:3, self._slice("stranger", number)], J[:3, first][:, _PLACE] = by_state, _EYE
        J[3:, self._slice("stranger", number)][:, _RANGE] = velocity
        J[3:, self._slice("stranger", number)][:, _SPEED] = rho * _EYE
        cov = J @ self._P @ J.T + _walk(dt)
        return StrangerPlace(there + self._state.observers[one.first].place, velocity, 0.5 * (cov + cov.T))

    def turn(self, observer: int) -> Array:
        """(3,) rad: estimate of what lasts of an observer's attitude error."""
        return self._state.observers[observer].turn.copy()

    # --- inside ---

    def _slice(self, kind: str, key: int) -> slice:
        k = self._offset[kind, key]
        return slice(k, k + (_STRANGER_STATES if kind == "stranger" else _OBSERVER_STATES))

    def _append(self, key: _Key, block: Array, cross: Array) -> None:
        n, more = len(self._P), len(block)
        P = np.empty((n + more, n + more))
        P[:n, :n], P[n:, :n], P[:n, n:], P[n:, n:] = self._P, cross, cross.T, block
        self._offset[key], self._P = n, P

    def _remove(self, key: _Key) -> None:
        gone = self._slice(*key)
        del self._offset[key]
        stay = np.r_[0 : gone.start, gone.stop : len(self._P)]
        self._P = self._P[np.ix_(stay, stay)]
        fewer = gone.stop - gone.start
        self._offset = {one: at - fewer * (at > gone.start) for one, at in self._offset.items()}

    def _late(self, number: int, ray: Ray) -> float:
        """Variance [rad²] of a late ray by how the stranger may have flown since, and of one whose time is vague."""
        assert self.t is not None
        one, before = self._state.strangers[number], max(self.t - ray.t, 0.0)
        rho = max(float(np.linalg.norm(one.at(before)[0] - ray.camera)), 1.0)
        flown = VISITOR_ACCELERATION_PSD_M2_S3 * before**3 / 3.0 + (
            math.exp(2.0 * one.log_range) * float(one.s @ one.s) * ray.t_sigma**2
        )
        return flown / rho**2

    def _seen(self, number: int, ray: Ray) -> _Model:
        assert self.t is not None
        before = max(self.t - ray.t, 0.0)

        def model(state: _State) -> tuple[Array, Array]:
            one = state.strangers[number]
            there, J = one.at(before)
            there = there + state.observers[one.first].place
            nu, H, by_place = self._looked(state.observers[ray.observer], ray, there)
            H[:, self._slice("stranger", number)] += by_place @ J
            H[:, self._slice("observer", one.first)][:, _PLACE] += by_place
            return nu, H

        return model

    def _sized(self, number: int, ray: Ray) -> _Model:
        """The distance by the size of the box: ln |r| + e."""

        def model(state: _State) -> tuple[Array, Array]:
            one, seen_by = state.strangers[number], state.observers[ray.observer]
            there, J = one.at(0.0)
            r = there + state.observers[one.first].place - ray.camera - seen_by.place
            square = max(float(r @ r), 1e-6)
            H = np.zeros((1, len(self._P)))
            H[0, self._slice("stranger", number)] = r @ J / square
            H[0, self._slice("stranger", number)][_SIZE] = 1.0
            H[0, self._slice("observer", one.first)][_PLACE] += r / square
            H[0, self._slice("observer", ray.observer)][_PLACE] -= r / square
            return np.array([ray.range_ln - 0.5 * math.log(square) - one.size]), H

        return model

    def _looked(self, observer: _Observer, ray: Ray, there: Array) -> tuple[Array, Array, Array]:
        """ν (2,), H (2, n) by the observer's errors alone, and (2, 3) by the place (3,) that is looked at."""
        r = there - ray.camera - observer.place
        distance = max(float(np.linalg.norm(r)), 1e-3)
        u = r / distance
        expected = u - np.cross(observer.turn, u)
        across = log_range.across(ray.direction[None])[0].T
        if float(ray.direction @ expected) < RAY_LEAST_COSINE:
            return np.full(2, math.inf), np.zeros((2, len(self._P))), np.zeros((2, 3))
        by_u = across @ (_EYE - hat(observer.turn))
        by_place = by_u @ (_EYE - np.outer(u, u)) / distance
        H = np.zeros((2, len(self._P)))
        at = self._slice("observer", ray.observer)
        H[:, at][:, _TURN] = across @ hat(u)
        H[:, at][:, _PLACE] = -by_place
        return -across @ expected, H, by_place

    def _moved(self, x: Array) -> _State:
        strangers = {
            number: one.moved(x[self._slice("stranger", number)])
            for number, one in self._state.strangers.items()
        }
        observers = {
            key: one.moved(x[self._slice("observer", key)]) for key, one in self._state.observers.items()
        }
        return _State(strangers, observers)

    def _solve(self, model: _Model, variance: float) -> _RaySolution | None:
        """The most likely state, by Gauss-Newton steps from the prior; None where the ray is of another target."""
        x, state = np.zeros(len(self._P)), self._state
        ranges = [self._offset["stranger", number] + _RANGE for number in self._state.strangers]
        for _ in range(RAY_STEPS):
            nu, H = model(state)
            if not math.isfinite(float(nu[0])):
                return None
            PHt = self._P @ H.T
            S = H @ PHt + variance * np.eye(len(nu))
            nu = nu + H @ x
            w = np.linalg.solve(S, nu)
            step = PHt @ w - x
            farthest = max((abs(float(step[k])) for k in ranges), default=0.0)
            if farthest > RAY_STEP_MOST_LN:
                x = x + step * (RAY_STEP_MOST_LN / farthest)
            else:
                x = x + step
                if farthest < RAY_STEP_SMALL:
                    break
            state = self._moved(x)
        return _RaySolution(x, H, S, float(nu @ w))

    def _fold(self, model: _Model, variance: float, gate: float) -> bool:
        solved = self._solve(model, variance)
        if solved is None or solved.cost > gate:
            return False
        H, R = solved.H, variance * np.eye(len(solved.S))
        K = np.linalg.solve(solved.S, H @ self._P).T
        A = np.eye(len(self._P)) - K @ H
        P = A @ self._P @ A.T + K @ R @ K.T
        self._state, T = self._moved(solved.x), np.eye(len(P))
        for number, one in self._state.strangers.items():
            E = log_range.across(one.d[None])[0]
            at = self._offset["stranger", number]
            T[at : at + 2, at : at + 2] = E.T @ one.E
            one.E = E
        P = T @ P @ T.T
        self._P = 0.5 * (P + P.T)
        return True

    def _move_anchor(self, number: int, one: _Stranger) -> None:
        """Back along the ray: the same place, farther from where directions are counted from. Of a range that is a
        guess the observer is the natural centre, by which all of it scales."""
        rho = math.exp(one.log_range)
        share = rho / (rho + ANCHOR_STEP_M)
        one.anchor = one.anchor - ANCHOR_STEP_M * one.d
        T = np.eye(_STRANGER_STATES)
        T[:3, :3] *= share
        # v = exp(l) s is the same: δs' = share (δs + (1 − share) s δl).
        T[_SPEED, _RANGE] = share * (1.0 - share) * one.s
        T[_SPEED, _SPEED] *= share
        one.log_range, one.s = math.log(rho + ANCHOR_STEP_M), share * one.s
        at = self._slice("stranger", number)
        self._P[at] = T @ self._P[at]
        self._P[:, at] = self._P[:, at] @ T.T


def _flown(one: _Stranger, dt: float) -> tuple[Array, Array]:
    """A stranger flies on by dt, in place; F and Q (6, 6). As in `relative/log_range.py`, without an own way."""
    near = math.exp(-one.log_range)
    y = one.d + dt * one.s
    length = max(float(np.linalg.norm(y)), 1e-6)
    d, s = y / length, one.s / length
    E = log_range.across(d[None])[0]
    onto = np.vstack([E.T, d]) / length
    by_state = np.zeros((3, 6))
    by_state[:, _ACROSS], by_state[:, _SPEED] = one.E, dt * _EYE
    F = np.zeros((6, 6))
    F[:3] = onto @ by_state
    F[_SPEED] = -np.outer(s, F[_RANGE])
    F[_SPEED, _SPEED] += _EYE / length
    F[_RANGE, _RANGE] += 1.0
    G = np.zeros((6, 6))
    G[:3, :3] = onto * near
    G[_SPEED, :3] = -np.outer(s, G[_RANGE, :3])
    G[_SPEED, 3:] = near / length * _EYE
    one.d, one.E, one.s = d, E, s
    one.log_range = min(max(one.log_range + math.log(length), _LOG_NEAREST), _LOG_FARTHEST)
    return F, G @ _walk(dt) @ G.T


def _walk(dt: float) -> Array:
    """(6, 6): what may come to place and velocity within dt, by white acceleration."""
    q = VISITOR_ACCELERATION_PSD_M2_S3
    Q = np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    return q * np.kron(Q, _EYE)
