"""How likely the rays to a track are if it moves in a given way: many Kalman filters side by side.

A filter stands for one model of how a track moves. It begins with a ray: a unit vector d, the place p where the
observer's camera was, and q, the displacement that its model foretells. Later rays are seen in the plane across d,
two coordinates in radians, and of a track that has moved by g = q(t) − q − (p(t) − p) they are

    a = (s + κ Eᵀ(g + c v + ψ z × g) + δ) / (1 + κ dᵀ(g + c v + ψ z × g)) + α + noise

with E (3, 2) the plane's axes and v by how much dq/dt has changed. What is not known is a state, because whatever is
smooth and taken for noise makes confident wrong names: s, where the track was at first; κ, one over its distance then;
κ c, by how much the clocks are apart; κ ψ, by how much the observer's north is turned from that of the one who
foretells; δ and its speed, how far the track flies from what was foretold (a critically damped wander); α, the error
of the observer's attitude (an Ornstein-Uhlenbeck process). Linear in all of them but for the denominator, so an
extended filter serves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry import rotation
from swarmtrack.messages import Array

Rows = NDArray[np.intp]

# rad and s: of an autopilot's attitude, what lasts; and what changes from look to look.
ATTITUDE_SIGMA, ATTITUDE_S = 0.012, 15.0
ATTITUDE_WHITE = 0.003
# rad: of one drone's north against another's.
TURN_SIGMA = 0.2
# One ray in so many is of something else, anywhere within so many rad.
STRAY, STRAY_WIDTH = 0.01, 0.2
_LOG_STRAY: Final = math.log(STRAY / STRAY_WIDTH**2)
_LOG_RAY: Final = math.log((1.0 - STRAY) / (2.0 * math.pi))
# Of the distance at first: no track is foretold nearer than this, behind the camera least of all.
NEAREST_SHARE = 0.2
# States: s (2), α (2), δ and its speed along each axis (2 × 2), κ, κ c, κ ψ.
STATES = 11
_START, _ATTITUDE, _WANDER, _SCALES = slice(0, 2), slice(2, 4), slice(4, 8, 2), slice(8, 11)
_KAPPA, _CLOCK, _TURN = 8, 9, 10


class Model(NamedTuple):
    """kappa, kappa_sigma 1/m; clock [s] one sigma; wander: how far a track flies from what is foretold [rad], one
    sigma, and bandwidth [rad/s], how fast. Each (rows, models)."""

    kappa: Array
    kappa_sigma: Array
    clock: Array
    wander: Array
    bandwidth: Array


class Looks(NamedTuple):
    """One ray of each row: t (n,) s, ray (n, 3) unit vectors and camera (n, 3) m in the team frame; noise (n,) rad², of
    the ray; foretold, speed (n, models, 3) m and m/s: the displacement by each model."""

    t: Array
    ray: Array
    camera: Array
    noise: Array
    foretold: Array
    speed: Array

    def only(self, rows: Rows) -> Looks:
        return Looks(*(values[rows] for values in self))


class RayFilters:
    """One filter per model in each row. Rows are begun, then told of one look after the other, many at a time."""

    def __init__(self, turns: Sequence[float], used: int, rows: int = 64) -> None:
        """turns [rad], by model: how far the observer's north is turned, clockwise seen from above, beside what is a
        state. used: only the first so many models are filtered."""
        models = len(turns)
        self.used = used
        self._turn = np.array([rotation.from_euler(0.0, 0.0, turn) for turn in turns])
        self.log = np.zeros((rows, models))
        """Log likelihood of all looks since a row was first begun."""
        self.t = np.full(rows, np.nan)
        """Of the last look, s."""
        self._x = np.zeros((rows, models, STATES))
        self._P = np.zeros((rows, models, STATES, STATES))
        self._wander = np.zeros((2, rows, models))
        self._axes = np.zeros((rows, 3, 3))
        self._camera = np.zeros((rows, 3))
        self._foretold = np.zeros((rows, models, 3))
        self._speed = np.zeros((rows, models, 3))

    @property
    def rows(self) -> int:
        return len(self.t)

    def grow(self) -> None:
        """Twice as many rows."""
        for name in ("log", "t", "_x", "_P", "_axes", "_camera", "_foretold", "_speed"):
            array = getattr(self, name)
            setattr(self, name, np.concatenate([array, np.zeros_like(array)]))
        self._wander = np.concatenate([self._wander, np.zeros_like(self._wander)], axis=1)

    def begin(self, rows: Rows, looks: Looks, model: Model) -> None:
        """From this look on; `log` goes on from where it is. model: for these rows; looks, model: of those used."""
        used = np.s_[rows, : self.used]
        shape = (len(rows), self.used, STATES)
        x, P = np.zeros(shape), np.zeros((*shape, STATES))
        x[..., _KAPPA] = model.kappa
        for i in range(2):
            P[..., i, i] = looks.noise[:, None] + ATTITUDE_SIGMA**2 + model.wander**2
            # The first ray is where it is with this attitude, and from there.
            for k, variance in ((2 + i, ATTITUDE_SIGMA**2), (4 + 2 * i, model.wander**2)):
                P[..., k, k] = variance
                P[..., i, k] = P[..., k, i] = -variance
            P[..., 5 + 2 * i, 5 + 2 * i] = (model.wander * model.bandwidth) ** 2
        P[..., _KAPPA, _KAPPA] = model.kappa_sigma**2
        P[..., _CLOCK, _CLOCK] = (model.clock * model.kappa) ** 2
        P[..., _TURN, _TURN] = (TURN_SIGMA * model.kappa) ** 2
        self.t[rows], self._x[used], self._P[used] = looks.t, x, P
        self._wander[0][used], self._wander[1][used] = model.wander, model.bandwidth
        self._axes[rows], self._camera[rows] = _axes(looks.ray), looks.camera
        self._foretold[used], self._speed[used] = looks.foretold, looks.speed

    def reaches(self, rows: Rows, rays: Array, most: float) -> NDArray[np.bool_]:
        """(n,): whether rays (n, 3) are within an angle [rad] of those that these rows began with."""
        return np.asarray((self._axes[rows][:, :, 2] * rays).sum(axis=1) > math.cos(most))

    def look(self, rows: Rows, looks: Looks) -> None:
        """Let `log` grow by how likely these rays are by each model. Each row once, and later than before."""
        used = np.s_[rows, : self.used]
        x, P = self._predicted(rows, looks.t)
        axes = self._axes[rows]
        flat = (looks.ray[:, None] @ axes)[:, 0]
        a = flat[:, :2] / flat[:, 2:]
        moved = looks.foretold - self._foretold[used] - (looks.camera - self._camera[rows])[:, None]
        faster = looks.speed - self._speed[used]
        moved, faster = ((self._turn[: self.used] @ way[..., None])[..., 0] for way in (moved, faster))
        turned = np.stack([-moved[..., 1], moved[..., 0], np.zeros(moved.shape[:2])], axis=-1)
        ways = np.stack([moved @ axes, faster @ axes, turned @ axes], axis=-2)
        expected, H = _expected(x, ways)
        miss = a[:, None] - expected
        PHt = P @ H.swapaxes(-1, -2)
        S = H @ PHt
        S[..., 0, 0] += looks.noise[:, None]
        S[..., 1, 1] += looks.noise[:, None]
        determinant = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] ** 2
        inverse = np.stack([S[..., 1, 1], -S[..., 0, 1], -S[..., 0, 1], S[..., 0, 0]], axis=-1).reshape(
            S.shape
        )
        inverse /= determinant[..., None, None]
        K = PHt @ inverse
        squared = (miss * (inverse @ miss[..., None])[..., 0]).sum(axis=-1)
        log = _LOG_RAY - 0.5 * (squared + np.log(determinant))
        self.log[used] += np.logaddexp(log, _LOG_STRAY)
        believed = log > _LOG_STRAY
        K[~believed] = 0.0
        x += (K @ miss[..., None])[..., 0]
        P -= K @ PHt.swapaxes(-1, -2)
        self.t[rows], self._x[used], self._P[used] = looks.t, x, P

    def _predicted(self, rows: Rows, t: Array) -> tuple[Array, Array]:
        used = np.s_[rows, : self.used]
        x, P = self._x[used], self._P[used]
        sigma, w = self._wander[0][used], self._wander[1][used]
        dt = (t - self.t[rows])[:, None]
        fade = np.exp(-dt / ATTITUDE_S)
        decay = np.exp(-w * dt)
        F = np.stack([decay * (1.0 + w * dt), decay * dt, -decay * w * w * dt, decay * (1.0 - w * dt)])
        x[..., _ATTITUDE] *= fade[..., None]
        P[..., _ATTITUDE, :] *= fade[..., None, None]
        P[..., :, _ATTITUDE] *= fade[..., None, None]
        grown = (
            1.0 - F[0] ** 2 - (w * F[1]) ** 2,
            -F[0] * F[2] - w * w * F[1] * F[3],
            w * w - F[2] ** 2 - (w * F[3]) ** 2,
        )
        for i, k in enumerate((4, 6)):
            x[..., k], x[..., k + 1] = _turned(x[..., k], x[..., k + 1], F)
            P[..., :, k], P[..., :, k + 1] = _turned(P[..., :, k], P[..., :, k + 1], F[..., None])
            P[..., k, :], P[..., k + 1, :] = _turned(P[..., k, :], P[..., k + 1, :], F[..., None])
            P[..., 2 + i, 2 + i] += ATTITUDE_SIGMA**2 * (1.0 - fade**2)
            P[..., k, k] += sigma**2 * grown[0]
            P[..., k, k + 1] += sigma**2 * grown[1]
            P[..., k + 1, k] += sigma**2 * grown[1]
            P[..., k + 1, k + 1] += sigma**2 * grown[2]
        return x, P


def _turned(first: Array, second: Array, F: Array) -> tuple[Array, Array]:
    """F (2, 2), row by row, times (first, second)."""
    return F[0] * first + F[1] * second, F[2] * first + F[3] * second


def _axes(rays: Array) -> Array:
    """(n, 3, 3): by column, two axes across each ray, the first of them level, and the ray."""
    level = np.stack([-rays[:, 1], rays[:, 0], np.zeros(len(rays))], axis=1)
    steep = np.linalg.norm(level, axis=1) < 1e-6
    level[steep] = (0.0, 1.0, 0.0)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    return np.stack([level, np.cross(rays, level), rays], axis=2)


def _expected(x: Array, ways: Array) -> tuple[Array, Array]:
    """Where a ray meets its plane (n, models, 2), and by how much each state shifts it, (n, models, 2, STATES).

    ways (n, models, 3, 3): by row g, v and z × g; by column along the axes of the plane and along the first ray.
    """
    shift = (x[..., None, _SCALES] @ ways)[..., 0, :]
    depth = np.maximum(1.0 + shift[..., 2:], NEAREST_SHARE)
    place = (x[..., _START] + x[..., _WANDER] + shift[..., :2]) / depth
    H = np.zeros((*x.shape[:2], 2, STATES))
    for i in range(2):
        H[..., i, i] = H[..., i, _WANDER.start + 2 * i] = 1.0 / depth[..., 0]
        H[..., i, 2 + i] = 1.0
        H[..., i, _SCALES] = (ways[..., i] - place[..., None, i] * ways[..., 2]) / depth
    return place + x[..., _ATTITUDE], H
