"""Transform from a teammate's frame to ours: a translation and a rotation about the vertical, in closed form, from
sightings.

Theory of operation. Drone i at p (in its frame I) sees drone j on a ray d; j says that it is at s (in its own frame J).
Both frames are level, so that I_from_J is a turn ψ about the vertical and a shift t. With x = (cos ψ, sin ψ) and
R(ψ) s = G x + z everything is linear:

    across the ray    (I − d dᵀ)(G x + z + t − p) = 0           one sigma: that of the ray, times the range ρ
    along the ray     dᵀ(G x + z + t − p) = ρ (1 + b)           by the size; b is its lasting error
    seen by it, too   −sin(ψₘ) c + cos(ψₘ) s = 0                ψₘ: azimuth of −d less that of its ray to us

The normal equations of (x, t, b) are reduced to x, and solved on the circle. No first guess and no linearization, so
nothing is believed twice; an extended filter of (t, ψ) makes up information from every step while nothing moves.

Noise in d is multiplied by all of q = G x + z + t − p. Its expectation is taken off, or the squares would shrink q.

While no drone moves, turn and shift trade off, and the solution says nothing of it. So it is stated only where the
teammate moved across the rays, in its own frame and against us, by far more than the noise. And where the rays fit
less well than their noise says, as frames drift, the covariance grows by as much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.messages import Array
from swarmtrack.relative.log_range import across

# s: so old a sighting counts a third; one three times as old does not.
FORGET_S, WINDOW_S = 30.0, 60.0
# m, rms: a teammate that moved less, in its frame or against us, tells nothing of its frame.
EXCITED_M = 0.5
FEWEST = 8
_STARTS = np.linspace(-math.pi, math.pi, 73)[:-1]
_NEWTON_STEPS = 6


class FrameSight(NamedTuple):
    """eye (3,) m: our camera, in our frame; said (3,) m: the teammate, in its frame; ray (3,): unit, in our frame;
    log_range: by the size, NaN where that says nothing; seen_back (3,): its ray to us, in its frame, or None; gain: how
    many times the errors of the size are in log_range."""

    t: float
    eye: Array
    said: Array
    ray: Array
    log_range: float
    seen_back: Array | None = None
    gain: float = 1.0


class SightErrors(NamedTuple):
    """One sigma: ray rad; place m, of where both say they are at the same time; size, its share that changes, and
    lasting; drift m/√s, turn_drift rad/√s: of the frames against each other."""

    ray: float
    place: float
    size: float
    lasting: float
    drift: float
    turn_drift: float


class FrameTransform(NamedTuple):
    """ours_from_theirs: turn rad, clockwise seen from above; shift (3,) m; cov (4, 4) of (shift, turn)."""

    turn: float
    shift: Array
    cov: Array

    def place(self, said: Array) -> tuple[Array, Array]:
        """What it calls said (3,) m, in our frame, and the covariance (3, 3) that the transform's error gives it."""
        moved = self.rotation @ said
        J = np.zeros((3, 4))
        J[:, :3] = np.eye(3)
        J[0, 3], J[1, 3] = -moved[1], moved[0]
        return moved + self.shift, J @ self.cov @ J.T

    @property
    def rotation(self) -> Array:
        """(3, 3)"""
        return rotation.from_euler(0.0, 0.0, self.turn)


class _Window(NamedTuple):
    """Sightings as arrays: eye, said, ray (n, 3), log_range, gain (n,), weight (n,) by their age, and place_var (n,)
    m², of the frames' drift since, too."""

    eye: Array
    said: Array
    ray: Array
    log_range: Array
    gain: Array
    weight: Array
    place_var: Array

    def spread(self, places: Array) -> float:
        """m: how far places (n, 3) are from their mean, level and across the rays, rms."""
        off = places - self.weight @ places / self.weight.sum()
        length = np.maximum(np.hypot(self.ray[:, 0], self.ray[:, 1]), 1e-6)
        side = (off[:, 1] * self.ray[:, 0] - off[:, 0] * self.ray[:, 1]) / length
        return math.sqrt(float(self.weight @ (side * side)) / float(self.weight.sum()))


def align(sights: Sequence[FrameSight], now: float, errors: SightErrors) -> FrameTransform | None:
    """None where they do not determine it."""
    if len(sights) < FEWEST:
        return None
    t = np.array([sight.t for sight in sights])
    said = np.array([sight.said for sight in sights])
    per_second = errors.drift**2 + errors.turn_drift**2 * (said * said).sum(axis=1)
    seen = _Window(
        np.array([sight.eye for sight in sights]),
        said,
        np.array([sight.ray for sight in sights]),
        np.array([sight.log_range for sight in sights]),
        np.array([sight.gain for sight in sights]),
        np.exp((t - now) / FORGET_S),
        errors.place**2 + per_second * (now - t),
    )
    if float(np.ptp(seen.said[:, :2], axis=0).max()) < EXCITED_M:
        return None
    N, m = _normal_equations(seen, errors)
    mutual = [i for i, sight in enumerate(sights) if sight.seen_back is not None]
    if mutual:
        back = np.array([sights[i].seen_back for i in mutual])
        N[:2, :2] += _of_mutual(seen.ray[mutual], back, seen.weight[mutual], errors.ray)
    solved = _on_the_circle(N, m)
    if solved is None:
        return None
    turn, shift, cov = solved
    moved = seen.said @ rotation.from_euler(0.0, 0.0, turn).T
    if min(seen.spread(moved - seen.eye), seen.spread(moved)) < EXCITED_M:
        return None
    cov *= max(1.0, _misfit(seen, moved + shift - seen.eye, errors))
    # What drifted since the mean sighting.
    age = now - float(seen.weight @ t) / float(seen.weight.sum())
    cov += np.diag([errors.drift**2] * 3 + [errors.turn_drift**2]) * age
    return FrameTransform(turn, shift, cov)


def _misfit(seen: _Window, away: Array, errors: SightErrors) -> float:
    """The mean square by which the rays miss, over what their noise says. away (n, 3) m: from eye to teammate."""
    along = (seen.ray * away).sum(axis=1)
    across2 = (away * away).sum(axis=1) - along * along
    expected = 2.0 * ((errors.ray * along) ** 2 + seen.place_var)
    return float(seen.weight @ (across2 / expected)) / float(seen.weight.sum())


def _normal_equations(seen: _Window, errors: SightErrors) -> tuple[Array, Array]:
    """(6, 6) and (6,) of the unknowns c, s, t (3), b."""
    said, weight = seen.said, seen.weight
    n = len(said)
    sized = np.isfinite(seen.log_range)
    told = np.linalg.norm(said - seen.eye, axis=1)
    rho = np.where(sized, np.exp(np.where(sized, seen.log_range, 0.0)), told)
    G = np.zeros((n, 3, 6))
    G[:, 0, 0], G[:, 0, 1], G[:, 1, 0], G[:, 1, 1] = said[:, 0], -said[:, 1], said[:, 1], said[:, 0]
    G[:, 0, 2] = G[:, 1, 3] = G[:, 2, 4] = 1.0
    off = seen.eye - said * (0.0, 0.0, 1.0)
    E = across(seen.ray).swapaxes(1, 2)
    H, r = E @ G, (E @ off[:, :, None])[:, :, 0]
    by_ray = weight / ((errors.ray * rho) ** 2 + seen.place_var)
    # One product of matrices: a sum over three indices is ten times as slow.
    rows, both = H.reshape(2 * n, 6), np.repeat(by_ray, 2)
    weighed = rows.T * both
    N, m = weighed @ rows, weighed @ r.reshape(2 * n)
    along, r = (seen.ray[:, None] @ G)[:, 0], (seen.ray * off).sum(axis=1)
    shrunk = 2.0 * errors.ray**2 * by_ray
    N -= along.T @ (shrunk[:, None] * along)
    m -= along.T @ (shrunk * r)
    by_size = np.where(sized, weight / ((errors.size * seen.gain * rho) ** 2 + seen.place_var), 0.0)
    along[:, 5] = -rho * seen.gain
    N += along.T @ (by_size[:, None] * along)
    m += along.T @ (by_size * (r + rho))
    N[5, 5] += 1.0 / errors.lasting**2
    return N, m


def _of_mutual(ray: Array, back: Array, weight: Array, sigma: float) -> Array:
    """(2, 2): what n sightings of each other, ray and back (n, 3), say of (c, s). weight (n,): of each."""
    turn = np.arctan2(-ray[:, 1], -ray[:, 0]) - np.arctan2(back[:, 1], back[:, 0])
    level = np.maximum(np.hypot(ray[:, 0], ray[:, 1]), 0.1)
    row = np.column_stack([-np.sin(turn), np.cos(turn)])
    # The other half of the circle fits as well: the rays themselves decide.
    return np.asarray(row.T @ (row * (weight * level**2 / (2.0 * sigma**2))[:, None]))


def _on_the_circle(N: Array, m: Array) -> tuple[float, Array, Array] | None:
    """Turn, shift and covariance (4, 4) of (shift, turn), of the least squares with |x| = 1."""
    A, B, C = N[:2, :2], N[:2, 2:], N[2:, 2:]
    if float(np.linalg.eigvalsh(C)[0]) < 1e-3:
        return None
    back = np.linalg.solve(C, np.column_stack([B.T, m[2:]]))
    M, v = A - B @ back[:, :2], m[:2] - B @ back[:, 2]
    x = np.stack([np.cos(_STARTS), np.sin(_STARTS)])
    turn = float(_STARTS[(np.einsum("ik,ij,jk->k", x, M, x) - 2.0 * v @ x).argmin()])
    for _ in range(_NEWTON_STEPS):
        x, dx = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
        bend = float(dx @ M @ dx - x @ (M @ x - v))
        if bend <= 0.0:
            return None
        turn -= min(max(float(dx @ (M @ x - v)) / bend, -0.1), 0.1)
    x, dx = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    bend = float(dx @ M @ dx - x @ (M @ x - v))
    if bend <= 0.0:
        return None
    shift = back[:3, 2] - back[:3, :2] @ x
    information = np.zeros((5, 5))
    information[:4, :4] = C
    information[:4, 4] = information[4, :4] = dx @ B
    information[4, 4] = bend + dx @ B @ back[:, :2] @ dx
    keep = [0, 1, 2, 4]
    cov = np.asarray(np.linalg.inv(information)[np.ix_(keep, keep)], dtype=float)
    return math.remainder(turn, 2.0 * math.pi), shift, cov
