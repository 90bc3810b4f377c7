"""How likely all bearings of a track to a teammate are, by each component of the own errors.

A bearing of a track along the unit vector d says that a teammate at p of its own frame, seen from the own place o, has

    (I − d dᵀ) (R(θ) (p − a) + q − R(φ) (o − b)) = n,      n ~ N(0, σ²)

a: where the teammate says that it started, b: where this drone started; q: where a is, from b, in the frame of the own
rays; θ: by how much the teammate's path is turned against that frame, φ: by how much the own path is. That is linear in

    z = (cos θ, sin θ, cos φ, sin φ, 1, q)

so all bearings of a pair add up to one matrix M (8, 8), zᵀ M z. Given a component of the own errors, q has a Gaussian
prior N(μ, Σ) and is integrated out exactly: what is left is yᵀ S y with y = (cos θ, sin θ, cos φ, sin φ, 1, μ). Two
angles remain, both near a centre: ε, by how much the own heading differs from the component's, and δ, the teammate's
own heading error. y is linear in them nearby, and they are integrated out as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.log_sums import log_sum
from swarmtrack.team.own_errors import OwnErrors, PathTurn
from swarmtrack.team.priors import (
    BEARINGS_LAST_S,
    P_DOUBTING_HEADING_OFF,
    P_DOUBTING_START_OFF,
    P_FRAME_LEAST,
    P_LOOSE_START_OFF,
    P_TEAMMATE_HEADING_OFF,
    P_TEAMMATE_START_OFF,
    START_OFF_SIGMA_M,
    START_OFF_VERTICAL,
    TEAMMATE_HEADING_CELL_RAD,
    TEAMMATE_HEADING_CELL_SIGMA_RAD,
    TEAMMATE_HEADING_SIGMA_RAD,
)
from swarmtrack.team.rows import runs

LEVEL = 5
"""Of z: the first of q."""
_HORIZONTAL = np.diag([1.0, 1.0, START_OFF_VERTICAL**2])


def fading(dt: float) -> float:
    """What is left after dt [s] of what bearings said."""
    return math.exp(-dt / BEARINGS_LAST_S)


def design(place: Array, own_way: Array) -> Array:
    """(n, 3, 8): the teammate less the own camera, in the axes of the rays, is this times z.

    place (n, 3) m: of teammates, from where they say they started; own_way (3,) m: of the camera, from the own start.
    """
    G = np.zeros((len(place), 3, 8))
    G[:, 0, 0], G[:, 0, 1] = place[:, 0], -place[:, 1]
    G[:, 1, 0], G[:, 1, 1] = place[:, 1], place[:, 0]
    G[:, 0, 2], G[:, 0, 3] = -own_way[0], own_way[1]
    G[:, 1, 2], G[:, 1, 3] = -own_way[1], -own_way[0]
    G[:, 2, 4] = place[:, 2] - own_way[2]
    G[:, [0, 1, 2], [5, 6, 7]] = 1.0
    return G


def turned_back(angle: float) -> Array:
    """(8, 8): z in the axes of the rays as they were, of z in those that have turned by angle [rad], clockwise from
    above."""
    c, s = math.cos(angle), math.sin(angle)
    to_old = np.eye(8)
    for at in (0, 2, LEVEL):
        to_old[at : at + 2, at : at + 2] = [[c, s], [-s, c]]
    return to_old


@dataclass(frozen=True, slots=True, eq=False)
class TeammatePrior:
    """One teammate's prior, by component of the observer's errors.

    y (8, 3, k): y at the centre, and its derivatives by ε and δ; far (8, 2, c): the same with a heading of its own that
    is anywhere, in the first component only, and its derivative by δ; far_squares (3, 36, c): `_squares` of that.
    """

    y: Array
    far: Array
    far_squares: Array

    @classmethod
    def of(cls, drone_id: int, errors: OwnErrors) -> TeammatePrior:
        apart = errors.stands_at(drone_id) - errors.stands_at(errors.own) - errors.shift
        path, psi = errors.path, errors.heading
        theta = np.where(path == PathTurn.TEAM, 0.0, -psi)
        phi = np.where(path == PathTurn.NONE, -psi, 0.0)
        theta_by = np.where(path == PathTurn.TEAM, 0.0, -1.0)
        phi_by = np.where(path == PathTurn.NONE, -1.0, 0.0)
        y = np.zeros((len(psi), 8, 3))
        y[:, 0, 0], y[:, 1, 0] = np.cos(theta), np.sin(theta)
        y[:, 2, 0], y[:, 3, 0] = np.cos(phi), np.sin(phi)
        y[:, 4, 0] = 1.0
        c, s = np.cos(psi), np.sin(psi)
        north = c * apart[:, 0] + s * apart[:, 1]
        east = -s * apart[:, 0] + c * apart[:, 1]
        y[:, 5, 0], y[:, 6, 0], y[:, 7, 0] = north, east, apart[:, 2]
        y[:, 0, 1], y[:, 1, 1] = -np.sin(theta) * theta_by, np.cos(theta) * theta_by
        y[:, 2, 1], y[:, 3, 1] = -np.sin(phi) * phi_by, np.cos(phi) * phi_by
        y[:, 5, 1], y[:, 6, 1] = east, -north
        y[:, 0, 2], y[:, 1, 2] = -np.sin(theta), np.cos(theta)
        count = round(2.0 * math.pi / TEAMMATE_HEADING_CELL_RAD)
        angle = np.arange(1, count) * TEAMMATE_HEADING_CELL_RAD
        far = np.repeat(y[:1, :, [0, 2]], count - 1, axis=0)
        far[:, 0, 0], far[:, 1, 0] = np.cos(angle), np.sin(angle)
        far[:, 0, 1], far[:, 1, 1] = -np.sin(angle), np.cos(angle)
        y, far = (np.ascontiguousarray(each.transpose(1, 2, 0)) for each in (y, far))
        return cls(y, far, _squares(far))


class PriorsOfMany(NamedTuple):
    """The priors of several teammates, and how many matrices each has: they stand one after the other."""

    priors: Sequence[TeammatePrior]
    counts: Sequence[int]

    @classmethod
    def of_one(cls, prior: TeammatePrior, n: int) -> PriorsOfMany:
        """n matrices of one teammate."""
        return cls([prior], [n])

    def products(self, S: Array, used: NDArray[np.intp]) -> Array:
        """(6, c, n, k): y_iᵀ S y_j of S (36, c, n), by the components used; `_squares` has their order."""
        squares = _squares(np.concatenate([prior.y[:, :, used] for prior in self.priors], axis=2))
        each = runs([len(used)] * len(self.priors))
        return self._by_teammate([squares[:, :, own] for own in each], S)

    def far_products(self, S: Array) -> Array:
        """(3, c, n, far): the same with a heading that is anywhere."""
        return self._by_teammate([prior.far_squares for prior in self.priors], S)

    def _by_teammate(self, squares: Sequence[Array], S: Array) -> Array:
        found = []
        for square, rows in zip(squares, runs(self.counts), strict=True):
            part = S[..., rows]
            product = part.reshape(len(part), -1).T @ square
            found.append(product.reshape(len(square), *part.shape[1:], -1))
        return np.concatenate(found, axis=2) if len(found) > 1 else found[0]


# Of a symmetric (8, 8), the entries on and above the diagonal; and which of them stand twice in it.
_ROW, _COLUMN = np.triu_indices(8)
_TWICE = np.where(_ROW == _COLUMN, 1.0, 2.0)[:, None]


def _squares(y: Array) -> Array:
    """(pairs, 36, k): y_iᵀ S y_j, for i ≤ j, is the sum of these times the entries of S; y (8, i, k)."""
    left, right = y.swapaxes(0, 1)[:, _ROW], y.swapaxes(0, 1)[:, _COLUMN]
    pairs = [(i, j) for j in range(y.shape[1]) for i in range(j + 1)]
    found = np.empty((len(pairs), len(_ROW), y.shape[2]))
    for at, (i, j) in enumerate(pairs):
        square = left[i] * right[j]
        found[at] = _TWICE * (square if i == j else 0.5 * (square + left[j] * right[i]))
    return found


class Solution(NamedTuple):
    """One Gaussian of z = z0 + L (ε, δ, q): mean x (5,) and covariance cov (5, 5) of these; log_share among those of
    its component."""

    log_share: float
    z0: Array
    L: Array
    x: Array
    cov: Array

    def place(self, G: Array) -> tuple[Array, Array]:
        """Mean (3,) m and covariance (3, 3) of G z; G (3, 8): `design`."""
        to_place = G @ self.L
        return G @ (self.z0 + self.L @ self.x), to_place @ self.cov @ to_place.T

    def frame(self, G: Array) -> tuple[Array, Array]:
        """Mean (4,) and covariance (4, 4) of G z [m] and θ [rad]."""
        cos, sin = self.z0[:2]
        to_frame = np.vstack([G @ self.L, cos * self.L[1] - sin * self.L[0]])
        centre = np.append(G @ self.z0, math.atan2(sin, cos))
        return centre + to_frame @ self.x, to_frame @ self.cov @ to_frame.T


def moments(found: Sequence[tuple[float, tuple[Array, Array]]]) -> tuple[Array, Array]:
    """Mean and covariance of a mixture of Gaussians: of each its log weight, its mean and its covariance."""
    log = np.array([log for log, _ in found])
    w = np.exp(log - log.max())
    w /= w.sum()
    mean = w @ np.array([mean for _, (mean, _) in found])
    off = np.array([mean for _, (mean, _) in found]) - mean
    spread = np.array([cov for _, (_, cov) in found]) + off[:, :, None] * off[:, None, :]
    return mean, np.einsum("i,iab->ab", w, spread)


def _inverse(A: Array) -> tuple[Array, Array]:
    """Inverses (3, 3, …) of many symmetric positive definite (3, 3, …), and determinants (…), by cofactors."""
    (a, b, c), (_, d, e), (_, _, f) = A
    cofactors = d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * cofactors[0] + b * cofactors[1] + c * cofactors[2]
    found = np.stack([cofactors[i] for i in (0, 1, 2, 1, 3, 4, 2, 4, 5)]) / determinant
    return found.reshape(3, 3, *determinant.shape), determinant


def _product(a: Array, b: Array) -> Array:
    """(i, j, …): products of many (i, 3, …) and (3, j, …)."""
    return np.asarray(a[:, 0, None] * b[0] + a[:, 1, None] * b[1] + a[:, 2, None] * b[2])


class FrameShares(NamedTuple):
    """How likely a teammate's frame is as it says. start (2, c): that its start is as stated, and off by each of
    `START_OFF_SIGMA_M`, of a team whose starts are as stated, and of one whose are not; far: that it has a heading of
    its own that is anywhere; near: with that, that its start is as stated, or off by the least."""

    start: Array
    far: float
    near: Array

    @classmethod
    def of(cls, off: tuple[float, float], far: float) -> FrameShares:
        """off: that the start is off by each of these; far: that the heading is anywhere."""
        start = np.array([(1.0 - sum(p) - far, *p) for p in (off, P_LOOSE_START_OFF)])
        return cls(start, far, np.array([1.0 - off[0], off[0]]))

    def shown(self, p: Array) -> FrameShares:
        """Where it is known, with probabilities p (2,), that the start is as stated, or off by the least."""
        left = max(1.0 - float(p.sum()), P_FRAME_LEAST)
        near = np.append(p, np.zeros(self.start.shape[1] - len(p)))
        return self._replace(start=near + left * self.start, far=left * self.far)


AS_STATED = FrameShares.of(P_TEAMMATE_START_OFF, P_TEAMMATE_HEADING_OFF)
"""Of a teammate that no other is known to see."""
DOUBTED = FrameShares.of(P_DOUBTING_START_OFF, P_DOUBTING_HEADING_OFF)
"""Of one that says that it doubts itself."""


def log_evidence_of_nothing(used: NDArray[np.intp], far: float) -> Array:
    """(len(used),): what `Marginal.log_evidence` says of M = 0; far: of its `FrameShares`."""
    return np.where(used == 0, 0.0, math.log1p(-far))


class Marginal:
    """Matrices M (n, 8, 8) of pairs with one teammate, or several, with q integrated out for each spread of starts.

    cov (3, 3) m²: of the stated starts, the own and the teammate's; of several (n, 1, 3, 3). spreads (c,) m,
    increasing: `OwnErrors.spread` of the components that will be asked for.
    """

    def __init__(self, M: Array, cov: Array, spreads: Array, shares: FrameShares = AS_STATED) -> None:
        self._log_shares = np.log(shares.start)
        self._log_far_shares = math.log(shares.far) + np.log(shares.near)
        Sigma = cov + np.array(
            [(spread**2 + m**2) * _HORIZONTAL for m in (0.0, *START_OFF_SIGMA_M) for spread in spreads]
        )
        # From here on with matrices first: whole arrays are added and multiplied.
        P, volume = _inverse(
            np.ascontiguousarray(Sigma.reshape(-1, len(spreads) * len(self._log_shares[0]), 3, 3).T)
        )
        m = np.ascontiguousarray(M.transpose(1, 2, 0))[:, :, None]
        A_inv, determinant = _inverse(m[LEVEL:, LEVEL:] + P)
        X = _product(m[:LEVEL, LEVEL:], A_inv)
        S = np.empty((8, 8, *determinant.shape))
        S[:LEVEL, :LEVEL] = m[:LEVEL, :LEVEL] - _product(X, m[LEVEL:, :LEVEL])
        S[:LEVEL, LEVEL:] = _product(X, P)
        S[LEVEL:, LEVEL:] = P - _product(_product(P, A_inv), P)
        self._P = P
        # Only what differs: S is symmetric.
        self._S = S[_ROW, _COLUMN]
        self._log_volume = -0.5 * np.log(volume * determinant)
        self._spreads = spreads

    def log_evidence(
        self,
        prior: PriorsOfMany,
        errors: OwnErrors,
        used: NDArray[np.intp],
        heading_sigma: float,
    ) -> Array:
        """(n, len(used)) of the components used, without the bearings' normalisers. heading_sigma [rad]: of the own
        heading in the first component."""
        found = np.empty((self._S.shape[2], len(used)))
        spread = np.searchsorted(self._spreads, errors.spread[used])
        sigma = errors.heading_sigma(used, heading_sigma)
        loose = errors.loose[used].astype(int)
        for s in np.unique(spread).tolist():
            here = np.flatnonzero(spread == s)
            each = self._of(s, prior, used[here], sigma[here])
            each += self._log_shares[loose[here]].T[:, None]
            found[:, here] = log_sum(each, 0)
        first = np.flatnonzero(used == 0)
        if first.size:
            found[:, first[0]] = np.logaddexp(found[:, first[0]], self._of_far(prior))
        return found

    def by_start(self, prior: TeammatePrior, heading_sigma: float) -> Array:
        """(c, n): the same by how far the teammate's start is off, where nothing is wrong with this drone."""
        every = PriorsOfMany.of_one(prior, self._S.shape[2])
        return self._of(0, every, np.zeros(1, int), np.array([heading_sigma]))[:, :, 0]

    def _of(self, spread: int, prior: PriorsOfMany, used: NDArray[np.intp], sigma: Array) -> Array:
        """(c, n, k): by how far the teammate's start is off, and by the components used."""
        rows = slice(spread, None, len(self._spreads))
        g00, g01, g11, g02, g12, g22 = prior.products(self._S[:, rows], used)
        a11, a22 = g11 * sigma**2 + 1.0, g22 * TEAMMATE_HEADING_SIGMA_RAD**2 + 1.0
        a12 = g12 * (sigma * TEAMMATE_HEADING_SIGMA_RAD)
        b1, b2 = g01 * sigma, g02 * TEAMMATE_HEADING_SIGMA_RAD
        det = a11 * a22 - a12**2
        quad = g00 - (a22 * b1**2 - 2.0 * a12 * b1 * b2 + a11 * b2**2) / det
        return np.asarray(-0.5 * (quad + np.log(det)) + self._log_volume[rows, :, None])

    def _of_far(self, prior: PriorsOfMany) -> Array:
        """(n,): with the teammate's heading anywhere, and its start as stated and off."""
        sigma, step = TEAMMATE_HEADING_CELL_SIGMA_RAD, len(self._spreads)
        rows = slice(None, step * len(self._log_far_shares), step)
        g00, g01, g11 = prior.far_products(self._S[:, rows])
        h = g11 * sigma**2 + 1.0
        log = -0.5 * (g00 - (g01 * sigma) ** 2 / h + np.log(h))
        log = log_sum(log, 2) + self._log_volume[rows] - math.log(g00.shape[2])
        return log_sum(log + self._log_far_shares[:, None], 0)

    def solutions(
        self,
        M: Array,
        prior: TeammatePrior,
        errors: OwnErrors,
        *,
        k: int,
        heading_sigma: float,
        far: bool = False,
    ) -> list[Solution]:
        """The Gaussians of z by one component k, with the teammate's start as stated and off; far: also, by the first
        component, with its heading anywhere. M (8, 8): of the one pair."""
        c = self._log_shares.shape[1]
        s = int(np.searchsorted(self._spreads, errors.spread[k]))
        y = np.repeat(prior.y[None, :, :, k], c, axis=0)
        P = self._P[:, :, s :: len(self._spreads), 0].transpose(2, 0, 1)
        own_sigma = float(errors.heading_sigma(np.array([k]), heading_sigma)[0])
        sigma = np.array([[own_sigma, TEAMMATE_HEADING_SIGMA_RAD]])
        sigma, log_share = np.repeat(sigma, c, axis=0), self._log_shares[int(errors.loose[k])]
        if far and k == 0:
            n, starts = prior.far.shape[2], len(self._log_far_shares)
            turned = np.repeat(prior.y[None, :, :, 0], n, axis=0)
            turned[:, :, [0, 2]] = prior.far.transpose(2, 0, 1)
            turned[:, :2, 1] = -turned[:, :2, 2]
            y = np.concatenate([y, np.tile(turned, (starts, 1, 1))])
            P = np.concatenate([P, np.repeat(P[:starts], n, axis=0)])
            sigma = np.concatenate([sigma, [[own_sigma, TEAMMATE_HEADING_CELL_SIGMA_RAD]] * (n * starts)])
            log_share = np.append(log_share, np.repeat(self._log_far_shares - math.log(n), n))
        return _solved(M, P, y, sigma, log_share)


def _solved(M: Array, P: Array, y: Array, sigma: Array, log_share: Array) -> list[Solution]:
    """y (n, 8, 3): at centres, and its derivatives by ε and δ, of these sigmas (n, 2) rad; P (n, 3, 3): inverse
    covariances of q; log_share (n,): prior."""
    n = len(y)
    L, to_mu = np.zeros((n, 8, 5)), np.zeros((n, 3, 5))
    L[:, :LEVEL, :2], L[:, LEVEL:, 2:] = y[:, :LEVEL, 1:], np.eye(3)
    to_mu[:, :, 0], to_mu[:, :, 2:] = -y[:, LEVEL:, 1], np.eye(3)
    z0, mu = y[:, :, 0].copy(), y[:, LEVEL:, 0]
    z0[:, LEVEL:] = 0.0
    by_prior = to_mu.swapaxes(1, 2) @ P
    by_bearings = L.swapaxes(1, 2) @ M
    A = by_bearings @ L + by_prior @ to_mu
    A[:, [0, 1], [0, 1]] += sigma**-2.0
    x = np.linalg.solve(A, by_prior @ mu[:, :, None] - by_bearings @ z0[:, :, None])[:, :, 0]
    quad = (z0 @ M * z0).sum(axis=1)
    quad += np.einsum("na,nab,nb->n", mu, P, mu) - np.einsum("na,nab,nb->n", x, A, x)
    log_det = np.linalg.slogdet(A)[1] - np.linalg.slogdet(P)[1] + 2.0 * np.log(sigma).sum(axis=1)
    log = log_share - 0.5 * (quad + log_det)
    log -= np.logaddexp.reduce(log)
    return [Solution(*one) for one in zip(log.tolist(), z0, L, x, np.linalg.inv(A), strict=True)]
