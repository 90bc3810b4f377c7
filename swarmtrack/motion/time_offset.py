"""How far the camera's clock is from the gyro's, found while flying: exposure on the IMU's clock = stamp + offset.

Theory of operation. Turned by the gyro's orientation at their exposure into a frame that does not turn, the bearings of
a target change smoothly, whatever the camera does. Turned by the orientation of another instant they shake with the
camera's own rate. So for each offset of a grid one small Kalman filter per target follows the turned bearings, and the
offset whose filters are surprised least is the likeliest: the likelihood of the innovations, which are white and need
no correction for overlap. All filters of a target share one covariance, which does not know of the offset; only their
means differ.

How agile targets are is not told but found: each filter comes in a few densities of acceleration, in units of the
measurement's variance. It differs from manoeuvre to manoeuvre, and so does how well the model fits. So evidence is kept
in blocks of two seconds, each with the scale of its own innovations and its agility summed over. Quiet time, in which
any offset is as good as any other, teaches nothing about the time in which the camera turns.

Within a block targets may accelerate in step with the camera's turn: so they seem to when the own drone rolls into a
go-to. Then the block is sure of a wrong offset. So no block is believed alone. Block b says offset o_b with variance
v_b, the inverse of its cost's curvature, less what the gyro's noise puts into that; its error is normal of variance
v_b + τ². The τ is common to all blocks and unknown, and is integrated over (random effects; DerSimonian & Laird
(1986), here with a prior). One block leaves τ as wide as before the flight, which is much wider than what is good
enough to be used. Blocks that agree make it small; blocks that do not keep it large. Old evidence fades within a
minute, since clocks and exposure times do change.

Which detections are one target's is judged here and not taken from the tracker: one that flies by a wrong offset keeps
the detections that agree with it. A target goes on with a detection that is alone in its gate, the gate being open for
all offsets that are still likely; where there is a choice, nothing is learned.

Only changes of the rate count: a constant rate turns all bearings by the same angle, at any offset.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Scan
from swarmtrack.motion.bearing_filters import BearingFilters, bearings_of, is_lapse, likelihoods
from swarmtrack.motion.gyro import GyroHistory, Orientation, Orientations
from swarmtrack.motion.priors import (
    BEARING_AGILITIES,
    BEARING_ESTABLISHED_HITS,
    OFFSET_BLOCK_ERRORS_S,
    OFFSET_BLOCK_LEAST_COMPONENTS,
    OFFSET_BLOCK_S,
    OFFSET_EDGE_POINTS,
    OFFSET_ESTIMATE_PERIOD_S,
    OFFSET_EVIDENCE_FADES_S,
    OFFSET_EVIDENCE_FORGOTTEN_S,
    OFFSET_GRID_STEP_S,
    OFFSET_GYRO_WAIT_S,
    OFFSET_LEAST_INFORMATION,
    OFFSET_LIKELY_LOG_RATIO,
    OFFSET_MAX_WAITING_SCANS,
    OFFSET_REACH_S,
    OFFSET_SLEW,
    OFFSET_SLOPE_STEPS,
    OFFSET_UNKNOWN_SIGMA_S,
    OFFSET_USED_SIGMA_S,
)

_GRID: Array = np.linspace(
    -OFFSET_REACH_S, OFFSET_REACH_S, 2 * round(OFFSET_REACH_S / OFFSET_GRID_STEP_S) + 1
)
_INNER = slice(OFFSET_SLOPE_STEPS, len(_GRID) - OFFSET_SLOPE_STEPS)
_SPAN = 2 * OFFSET_SLOPE_STEPS * OFFSET_GRID_STEP_S
# Of the parabola through the points about the least: coefficients of x² and x by least squares, x in s.
_PARABOLA = np.linalg.pinv(
    np.vander(_GRID[len(_GRID) // 2 - OFFSET_SLOPE_STEPS : len(_GRID) // 2 + OFFSET_SLOPE_STEPS + 1], 3)
)[:2]


class OffsetEstimate(NamedTuple):
    """exposure on the IMU's clock = stamp + offset_s; sigma_s: its standard deviation."""

    offset_s: float
    sigma_s: float


def to_use(found: OffsetEstimate, used_s: float, start_s: float) -> float:
    """The offset to use from now on: what was found, what is used already, or what was told at the start."""

    def off(offset_s: float) -> float:
        return abs(found.offset_s - offset_s) / found.sigma_s

    if found.sigma_s < OFFSET_USED_SIGMA_S:
        return found.offset_s if off(used_s) > 2.0 else used_s
    # What was taken up and is contradicted since is given back, however little is known by now.
    return min(used_s, start_s, key=off) if off(used_s) > 3.0 else used_s


class CameraClock:
    """Map from stamps to exposures on the IMU's clock, by the configured offset and, once it is certain, the
    estimated one.

    Moved towards what was found no faster than `OFFSET_SLEW`, so that exposures stay in order and no scan comes out
    late; and only where the two differ by more than the estimate's own error, so that a good calibration is left alone.
    """

    def __init__(self, start_s: float, *, estimates: bool = True) -> None:
        self.used_s = self._start_s = self._aim_s = start_s
        self._evidence = TimeOffset(start_s) if estimates else None
        self._found: OffsetEstimate | None = None
        self._newest = -math.inf
        self._judged = -math.inf

    @property
    def found(self) -> OffsetEstimate | None:
        """Estimate so far; None without one."""
        return self._found

    def exposure(self, stamp: float, gyro: GyroHistory) -> float:
        """When a scan was exposed; to be asked once for each scan, in the order in which they are tracked."""
        if self._evidence is None or stamp <= self._newest:
            return stamp + self.used_s
        self._evidence.advance(gyro, stamp)
        if stamp - self._judged >= OFFSET_ESTIMATE_PERIOD_S:
            self._judged = stamp
            self._found = found = self._evidence.estimate
            if found:
                self._aim_s = to_use(found, self._aim_s, self._start_s)
        # Unbounded for the first scan, but then nothing has been found yet.
        most = OFFSET_SLEW * (stamp - self._newest)
        self.used_s += min(max(self._aim_s - self.used_s, -most), most)
        self._newest = stamp
        return stamp + self.used_s

    def add_scan(self, stamp: float, scan: Scan, camera: PinholeCamera) -> None:
        """Add the detections of a scan with that stamp."""
        if self._evidence is None:
            return
        self._evidence.add_bearings(stamp, *bearings_of(scan, camera))


class _Bearings(NamedTuple):
    """What one scan saw: unit vectors (m, 3), their variance (m,) rad² per axis."""

    t: float
    bearings: Array
    variance: Array


class TimeOffset:
    """Likelihood of each offset of a grid about `start_s`. Its times are stamps as the camera gives them."""

    def __init__(self, start_s: float = 0.0) -> None:
        self.start_s = start_s
        self._waiting: deque[_Bearings] = deque(maxlen=OFFSET_MAX_WAITING_SCANS)
        self._last: tuple[float, Orientation] | None = None
        self._targets = BearingFilters(len(_GRID))
        self._block: _Block | None = None
        self._blocks: deque[_Block] = deque()
        self._agility = len(BEARING_AGILITIES) // 2  # the likeliest
        self._likely = np.ones(len(_GRID), dtype=bool)
        self._judged = -math.inf
        self._now = -math.inf
        self.estimate: OffsetEstimate | None = None
        """The likeliest offset; None while nothing was learned of it, or it lies at the end of what is searched."""

    def add_bearings(self, t: float, bearings: Array, variance: Array) -> None:
        """Add a scan stamped t with bearings (m, 3), unit vectors, of variance (m,) rad² per axis."""
        if self._waiting and t <= self._waiting[-1].t:
            return
        self._waiting.append(_Bearings(t, bearings, variance))

    def advance(self, gyro: GyroHistory, t: float) -> None:
        """Take what is old enough at the stamp t. It depends on t alone, not on who arrived first."""
        while self._waiting and self._waiting[0].t + OFFSET_GYRO_WAIT_S <= t:
            scan = self._waiting.popleft()
            self._take(scan, gyro)
            if scan.t >= self._judged + OFFSET_ESTIMATE_PERIOD_S:
                self._judged = scan.t
                self.estimate = self._judge()

    def _judge(self) -> OffsetEstimate | None:
        blocks = [block for block in self._blocks if block.components >= OFFSET_BLOCK_LEAST_COMPONENTS]
        if not blocks:
            return None
        weight = np.exp([(block.end - self._now) / OFFSET_EVIDENCE_FADES_S for block in blocks])
        likelihood, scale = likelihoods(
            np.array([block.cost for block in blocks]),
            np.array([block.log_det for block in blocks]),
            np.array([block.components for block in blocks]),
        )
        surprise = -weight @ np.logaddexp.reduce(likelihood, axis=1)
        k = int(surprise.argmin())
        agility = softmax(likelihood[:, :, k], axis=1)
        self._agility = int((weight @ agility).argmax())
        curvature, slope = np.zeros(0), np.zeros(0)
        if OFFSET_EDGE_POINTS <= k < len(_GRID) - OFFSET_EDGE_POINTS:
            curvature, slope = _parabolas(blocks, agility / scale[:, :, k], k)
        if not curvature.any():
            self._likely = surprise < surprise[k] + OFFSET_LIKELY_LOG_RATIO
            return None
        offset, variance = _agreed(curvature, slope, weight)
        # All blocks together are as sure as that, and not as sure as the sum of what each says.
        surprise = (surprise - surprise[k]) * min(1.0 / (variance * float(weight @ curvature)), 1.0)
        self._likely = surprise < OFFSET_LIKELY_LOG_RATIO
        # Where the evidence has several hills, how far they lie apart.
        odds = softmax(-surprise)
        spread = math.sqrt(float(odds @ (_GRID - odds @ _GRID) ** 2))
        sigma = max(math.sqrt(variance), spread)
        if sigma > OFFSET_UNKNOWN_SIGMA_S or abs(_GRID[k] + offset) > OFFSET_REACH_S:
            return None
        return OffsetEstimate(float(self.start_s + _GRID[k] + offset), float(sigma))

    def _take(self, scan: _Bearings, gyro: GyroHistory) -> None:
        at_stamps = scan.t + self.start_s
        orientations = gyro.orientations(at_stamps + _GRID)
        if orientations is None:
            self._last = None
            return
        orientation = gyro.orientation(at_stamps)
        if self._last is None or is_lapse(self._last, (scan.t, orientation)):
            self._targets.restart()
            self._block = None
        self._last = (scan.t, orientation)
        self._now = scan.t
        if self._block is None or scan.t > self._block.end:
            self._block = _Block(scan.t + OFFSET_BLOCK_S)
            self._blocks.append(self._block)
            while self._blocks[0].end < scan.t - OFFSET_EVIDENCE_FORGOTTEN_S:
                self._blocks.popleft()
        self._learn(scan, orientations)

    def _learn(self, scan: _Bearings, orientations: Orientations) -> None:
        of_axes = orientations.matrices.transpose(2, 1, 0).reshape(3, -1)
        turned = (scan.bearings @ of_axes).reshape(-1, 3, len(_GRID))
        y, S, variance = self._targets.follow(
            scan.t,
            turned,
            scan.variance,
            agility=self._agility,
            likely=self._likely,
            least_hits=BEARING_ESTABLISHED_HITS,
        )
        if len(y):
            self._add(y, S, variance, orientations.noise)

    def _add(self, y: Array, S: Array, variance: Array, gyro_noise: float) -> None:
        """Learn from innovations y (n, q, 3, g) of variance S (n, q), of bearings of the given variance (n,)."""
        d = (y * y).sum(axis=2) / S[:, :, None]  # (n, q, g)
        slopes = (y[..., 2 * OFFSET_SLOPE_STEPS :] - y[..., : -2 * OFFSET_SLOPE_STEPS]) / _SPAN
        block = self._block
        assert block is not None
        block.cost += d.sum(axis=0)
        block.log_det += 2.0 * np.log(S).sum(axis=0)
        block.components += 2.0 * len(y)
        block.information[:, _INNER] += ((slopes * slopes).sum(axis=2) / S[:, :, None]).sum(axis=0)
        # White noise, summed over the span; the innovations' filter raises it by no more than S over the variance.
        block.noise += float((2.0 * gyro_noise / _SPAN / variance).sum())
        self._targets.learn_gate(d[:, self._agility].min(axis=1))


class _Block:
    """What some seconds say, for each agility q and offset g: sums over the innovations of all targets."""

    def __init__(self, end: float) -> None:
        models = (len(BEARING_AGILITIES), len(_GRID))
        self.end = end
        # Squared innovations over their variance; logarithms of that; and how many.
        self.cost = np.zeros(models)
        self.log_det = np.zeros(len(BEARING_AGILITIES))
        self.components = 0.0
        # Squared slopes of the innovations over the offset, over the same variance, and what the gyro's noise puts
        # into them, s⁻².
        self.information = np.zeros(models)
        self.noise = 0.0


def _parabolas(blocks: list[_Block], weight: Array, k: int) -> tuple[Array, Array]:
    """Curvature and slope (b,) of each block's surprise at the grid's k-th offset, s⁻² and s⁻¹; weight (b, q) of each
    agility's cost. What the gyro's noise adds to the curvature is taken off."""
    cost = np.array([block.cost[:, k - OFFSET_SLOPE_STEPS : k + OFFSET_SLOPE_STEPS + 1] for block in blocks])
    half_curvature, slope = 0.5 * _PARABOLA @ (weight[:, :, None] * cost).sum(axis=1).T
    information = (weight * np.array([block.information[:, k] for block in blocks])).sum(axis=1)
    noise = weight.sum(axis=1) * np.array([block.noise for block in blocks])
    signal = np.maximum(1.0 - noise / np.maximum(information, OFFSET_LEAST_INFORMATION), 0.0)
    return 2.0 * signal * np.maximum(half_curvature, 0.0), slope


def _agreed(curvature: Array, slope: Array, weight: Array) -> tuple[float, float]:
    """The offset that blocks agree on, in s from where their surprise was expanded, and its variance.

    curvature, slope (b,): of each block's surprise, s⁻² and s⁻¹; a block whose curvature is zero says nothing.
    weight (b,): of its log-likelihood, 1 where it has not faded.
    """
    informed = curvature > 0.0
    weight, own, variance = (
        weight[informed],
        -slope[informed] / curvature[informed],
        1.0 / curvature[informed],
    )
    precision = 1.0 / (variance + OFFSET_BLOCK_ERRORS_S[:, None] ** 2)  # (τ, b)
    total = precision @ weight
    mean = precision @ (weight * own) / total
    misfit = (precision * (own - mean[:, None]) ** 2) @ weight
    # The likelihood of each τ, the offset integrated over.
    odds = softmax(0.5 * (np.log(precision) @ weight - np.log(total) - misfit))
    offset = float(odds @ mean)
    return offset, float(odds @ (1.0 / total + (mean - offset) ** 2))


def softmax(log_odds: Array, axis: int = -1) -> Array:
    """Probabilities of these log-odds. NumPy's own: an agent does not load SciPy for two lines."""
    return np.asarray(np.exp(log_odds - np.logaddexp.reduce(log_odds, axis=axis, keepdims=True)))
