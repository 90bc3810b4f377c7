"""How a camera sits on its gyro, and how far their clocks are apart, from a minute of turning both by hand.

Theory of operation. Between two frames the camera turned by what its image says, φ in camera axes; the gyro, integrated
over the same time, says ψ in body axes. At the right offset of the clocks one rotation C takes all ψ to their φ:
φ = C (ψ − b dt), b being the gyro's bias. The offset is searched on a grid: for each, the best C is Wahba's problem,
solved by the singular values of Σ φ ψᵀ (Kabsch (1976), Markley (1988)), and what is left over is the grid's cost.
From the least of it Gauss-Newton goes on over C, offset and bias together, with weights that let go of frames whose
image was not understood (Cauchy's; Holland & Welsch (1977)).

How sure it is comes from drawing blocks of a second, again and again, and solving the linearised problem for each draw
(Efron & Tibshirani (1993)): errors of neighbouring frames go together, and no model of the noise is needed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.messages import Array
from swarmtrack.motion.priors import (
    HAND_EYE_BLOCK_DRAWS,
    HAND_EYE_BLOCK_S,
    HAND_EYE_CAUCHY,
    HAND_EYE_COARSE_STEP_S,
    HAND_EYE_FINE_STEP_S,
    HAND_EYE_ITERATIONS,
    HAND_EYE_LEAST_SCALE_RAD,
    HAND_EYE_LEAST_TURNS,
    HAND_EYE_REACH_S,
    HAND_EYE_SLOPE_STEP_S,
)


class Turns(NamedTuple):
    """Rotations of the camera between pairs of frames, from its own images.

    start, end (n,) s: stamps of the frames, ascending; vector (n, 3) rad: about which axis and how far the camera
    itself turned, camera axes: exp(vector) takes coordinates in the later camera to those in the earlier one.
    """

    start: Array
    end: Array
    vector: Array


class HandEye(NamedTuple):
    """Result of hand-eye calibration.

    camera_from_body (3, 3); time_offset_s: exposure on the gyro's clock = stamp + this; bias (3,) rad/s, body axes;
    rotation_sigma (3,) rad about the camera's axes; time_offset_sigma_s; excitation (3,) rad/s: root mean square
    of the rate about the least, the middle and the most excited axis; rates (3,) rad/s: likewise about the body's x, y
    and z; residual rad: root mean square of the robust
    rest, per axis and turn; outliers: share of turns that were let go; at_edge: the offset lies at the end of what was
    searched, and is none.
    """

    camera_from_body: Array
    time_offset_s: float
    bias: Array
    rotation_sigma: Array
    time_offset_sigma_s: float
    excitation: Array
    rates: Array
    residual: float
    outliers: float
    turns: int
    at_edge: bool


class Agreement(NamedTuple):
    """Agreement of the images' rotations with those from the gyro and a known mounting.

    gain (3,): image over gyro about each axis of the camera, 1 where both agree, −1 where one has the wrong sign;
    rate (3,) rad/s: root mean square of the gyro's rate about these axes; time_offset_s as in `HandEye`.
    """

    gain: Array
    rate: Array
    time_offset_s: float


class GyroTurns:
    """Gyro samples t (n,) s, rates (n, 3) rad/s, body axes, integrated over any interval within them."""

    def __init__(self, t: Array, rates: Array) -> None:
        ahead = (
            np.concatenate([[True], np.diff(np.maximum.accumulate(t)) > 0.0]) if len(t) else np.zeros(0, bool)
        )
        self._t, self._rates = t[ahead], rates[ahead]
        self.first, self.last = (float(self._t[0]), float(self._t[-1])) if len(self._t) else (0.0, 0.0)
        dt = np.diff(self._t)[:, None]
        # As of `GyroHistory`: the rate is linear between samples; exact to the fifth order of the step.
        before, after = self._rates[:-1], self._rates[1:]
        steps = rotation.exp(0.5 * dt * (before + after) + dt**2 / 12.0 * np.cross(before, after))
        self._start_from_body = _running_products(steps)

    def between(self, start: Array, end: Array) -> Array:
        """Rotation vectors (n, 3) rad of the body from start (n,) to end (n,), in the body's axes."""
        before, after = self._at(start), self._at(end)
        turned: Array = rotation.log(np.swapaxes(before, 1, 2) @ after)
        return turned

    def _at(self, times: Array) -> Array:
        """start_from_body (n, 3, 3)."""
        t, rates = self._t, self._rates
        if len(times) and not (t[0] <= times.min() and times.max() <= t[-1]):
            raise ValueError("GyroTurns: asked for times outside its samples")
        k = np.minimum(np.searchsorted(t, times, side="right") - 1, len(t) - 2)
        dt = (times - t[k])[:, None]
        fraction = dt / (t[k + 1] - t[k])[:, None]
        phi = dt * (rates[k] + 0.5 * fraction * (rates[k + 1] - rates[k]))
        oriented: Array = self._start_from_body[k] @ rotation.exp(phi)
        return oriented

    def covered(self, turns: Turns, reach: float) -> Turns:
        """Those turns that lie within the samples at every offset up to `reach` s."""
        margin = reach + 2 * HAND_EYE_SLOPE_STEP_S
        inside = (turns.start - margin > self.first) & (turns.end + margin < self.last)
        return Turns(turns.start[inside], turns.end[inside], turns.vector[inside])


def solve(
    turns: Turns, gyro: GyroTurns, *, reach: float = HAND_EYE_REACH_S, centre: float = 0.0
) -> HandEye | None:
    """Mounting, offset and bias; None with too few turns to say anything. centre ± reach [s]: offsets searched."""
    turns = _shifted(gyro.covered(_shifted(turns, centre), reach), -centre)
    if len(turns.start) < HAND_EYE_LEAST_TURNS:
        return None
    offset, at_edge = _search(turns, gyro, reach, centre, mirrored=False)
    dt = turns.end - turns.start
    psi = gyro.between(turns.start + offset, turns.end + offset)
    C, bias = _kabsch(turns.vector - turns.vector.mean(axis=0), psi - psi.mean(axis=0)), np.zeros(3)
    weight = np.ones(len(dt))
    for _ in range(HAND_EYE_ITERATIONS):
        rest, J, psi = _linearised(turns, gyro, C, offset, bias)
        weight, scale = _weights(rest)
        step = _solved(*_normal(rest, J, weight))
        C, bias = rotation.exp(step[:3]) @ C, bias + step[4:]
        offset = float(
            np.clip(
                offset + np.clip(step[3], -HAND_EYE_FINE_STEP_S, HAND_EYE_FINE_STEP_S),
                centre - reach,
                centre + reach,
            )
        )
    rest, J, psi = _linearised(turns, gyro, C, offset, bias)
    weight, scale = _weights(rest)
    sigmas = _bootstrapped(turns, rest, J, weight)
    rates = psi / dt[:, None]
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(rates.T @ rates / len(rates)), 0.0))
    return HandEye(
        camera_from_body=C,
        time_offset_s=offset,
        bias=bias,
        rotation_sigma=sigmas[:3],
        time_offset_sigma_s=float(sigmas[3]),
        excitation=spread,
        rates=np.sqrt((rates**2).mean(axis=0)),
        residual=scale,
        outliers=float((weight < 0.2).mean()),
        turns=len(dt),
        at_edge=at_edge,
    )


def compare(
    turns: Turns,
    gyro: GyroTurns,
    camera_from_body: Array,
    *,
    reach: float = HAND_EYE_REACH_S,
    centre: float = 0.0,
) -> Agreement | None:
    """Image against gyro for a mounting that is said to be known; None with too few turns."""
    turns = _shifted(gyro.covered(_shifted(turns, centre), reach), -centre)
    if len(turns.start) < HAND_EYE_LEAST_TURNS:
        return None
    # The offset must be found with wrong signs, too: a mirrored gyro keeps step just as well.
    offset, _ = _search(turns, gyro, reach, centre, mirrored=True)
    told = gyro.between(turns.start + offset, turns.end + offset) @ camera_from_body.T
    dt = (turns.end - turns.start)[:, None]
    power = (told * told).sum(axis=0)
    gain = (turns.vector * told).sum(axis=0) / np.maximum(power, 1e-12)
    return Agreement(gain, np.sqrt(((told / dt) ** 2).mean(axis=0)), offset)


def _running_products(steps: Array) -> Array:
    """1, S₀, S₀ S₁, … (n + 1, 3, 3) of steps (n, 3, 3), by doubling spans (Hillis & Steele (1986))."""
    products = np.concatenate([np.eye(3)[None], steps])
    span = 1
    while span < len(products):
        products = np.concatenate([products[:span], products[:-span] @ products[span:]])
        span *= 2
    return products


def _shifted(turns: Turns, by: float) -> Turns:
    return Turns(turns.start + by, turns.end + by, turns.vector)


def _search(
    turns: Turns, gyro: GyroTurns, reach: float, centre: float, *, mirrored: bool
) -> tuple[float, bool]:
    """The offset on the grid that leaves least, and whether that is its end. mirrored: reflections count as well."""
    phi: Array = turns.vector - turns.vector.mean(axis=0)
    scale = np.sqrt((phi * phi).sum(axis=1))
    tame: Array = np.maximum(1.0, scale / max(4.0 * float(np.median(scale)), 1e-6))
    phi = phi / tame[:, None]  # no wild one rules

    def cost(offset: float) -> float:
        psi = gyro.between(turns.start + offset, turns.end + offset)
        psi -= psi.mean(axis=0)
        U, s, Vt = np.linalg.svd(phi.T @ psi)
        if not mirrored and np.linalg.det(U @ Vt) < 0.0:
            s = s * np.array([1.0, 1.0, -1.0])
        return float((psi * psi).sum()) - 2.0 * float(s.sum())

    coarse = centre + np.linspace(-reach, reach, 2 * math.ceil(reach / HAND_EYE_COARSE_STEP_S) + 1)
    costs = np.array([cost(offset) for offset in coarse])
    best = int(costs.argmin())
    if not 0 < best < len(coarse) - 1:
        return float(coarse[best]), True
    grid = np.arange(coarse[best - 1], coarse[best + 1] + 0.5 * HAND_EYE_FINE_STEP_S, HAND_EYE_FINE_STEP_S)
    costs = np.array([cost(offset) for offset in grid])
    best = min(max(int(costs.argmin()), 1), len(grid) - 2)
    below, least, above = costs[best - 1 : best + 2]
    bend = below - 2.0 * least + above
    return float(
        grid[best] + (0.5 * HAND_EYE_FINE_STEP_S * (below - above) / bend if bend > 0.0 else 0.0)
    ), False


def _kabsch(phi: Array, psi: Array) -> Array:
    """The rotation that takes psi (n, 3) nearest to phi (n, 3)."""
    U, _, Vt = np.linalg.svd(phi.T @ psi)
    C: Array = U @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(U @ Vt)))]) @ Vt
    return C


def _linearised(
    turns: Turns, gyro: GyroTurns, C: Array, offset: float, bias: Array
) -> tuple[Array, Array, Array]:
    """What is left (n, 3), its slope (n, 3, 7) by rotation, offset and bias (to be explained by a step), and ψ."""
    dt = turns.end - turns.start
    psi = gyro.between(turns.start + offset, turns.end + offset)
    later = gyro.between(
        turns.start + offset + HAND_EYE_SLOPE_STEP_S, turns.end + offset + HAND_EYE_SLOPE_STEP_S
    )
    earlier = gyro.between(
        turns.start + offset - HAND_EYE_SLOPE_STEP_S, turns.end + offset - HAND_EYE_SLOPE_STEP_S
    )
    told = (psi - bias * dt[:, None]) @ C.T
    J = np.empty((len(dt), 3, 7))
    J[:, :, :3] = -rotation.hat(told)
    J[:, :, 3] = (later - earlier) @ C.T / (2.0 * HAND_EYE_SLOPE_STEP_S)
    J[:, :, 4:] = -C * dt[:, None, None]
    return turns.vector - told, J, psi


def _weights(rest: Array) -> tuple[Array, float]:
    """Weights (n,) of the turns, and the scale of what is left [rad per axis]."""
    size = np.sqrt((rest * rest).mean(axis=1))
    scale = max(float(np.median(size)) / 0.888, HAND_EYE_LEAST_SCALE_RAD)  # the median of sqrt(χ²₃ / 3)
    weight: Array = 1.0 / (1.0 + (size / (HAND_EYE_CAUCHY * scale)) ** 2)
    return weight, scale


def _normal(rest: Array, J: Array, weight: Array) -> tuple[Array, Array]:
    H = np.einsum("n,nij,nik->jk", weight, J, J)
    g = np.einsum("n,nij,ni->j", weight, J, rest)
    return H, g


def _solved(H: Array, g: Array) -> Array:
    """A step; what was not excited stays where it is."""
    return np.asarray(np.linalg.lstsq(H, g, rcond=1e-12)[0], dtype=float)


def _bootstrapped(turns: Turns, rest: Array, J: Array, weight: Array) -> Array:
    """Standard deviations (7,) of rotation, offset and bias."""
    block = ((turns.start - turns.start[0]) // HAND_EYE_BLOCK_S).astype(int)
    _, block = np.unique(block, return_inverse=True)
    count = int(block.max()) + 1
    H, g = np.zeros((count, 7, 7)), np.zeros((count, 7))
    np.add.at(H, block, np.einsum("n,nij,nik->njk", weight, J, J))
    np.add.at(g, block, np.einsum("n,nij,ni->nj", weight, J, rest))
    rng = np.random.default_rng(0)  # a measure of spread, the same for the same turns
    drawn = rng.integers(0, count, (HAND_EYE_BLOCK_DRAWS, count))
    ridge = 1e-12 * np.trace(H.sum(axis=0)) * np.eye(7)
    steps = np.linalg.solve(H[drawn].sum(axis=1) + ridge, g[drawn].sum(axis=1)[:, :, None])[:, :, 0]
    sigmas: Array = steps.std(axis=0) * np.sqrt(count / max(count - 1.0, 1.0))
    return sigmas
