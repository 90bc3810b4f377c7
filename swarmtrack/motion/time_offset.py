"""How far the camera's clock is from the gyro's, found while flying: exposure on the IMU's clock = stamp + offset.

Theory of operation. Turned by the gyro's orientation at their exposure into a frame that does not turn, the bearings of
a target change smoothly, whatever the camera does. Turned by the orientation of another instant they shake with the
camera's own rate. So for each offset of a grid one small Kalman filter a track follows the turned bearings, and the
offset whose filters are surprised least is the likeliest: the likelihood of the innovations, which are white and need
no correction for overlap. All filters of a track share one covariance, which does not know of the offset; only their
means differ. How agile targets are is not told but found: each filter comes in a few densities of acceleration, in
units of the measurement's variance, and the scale of both is what the innovations say.

How sure it is comes from three sums. The information is that of the innovations' slope over the offset, less what the
gyro's own noise puts into it (the camera that stands still has nothing else, and says nothing). The scatter of the
score is summed over blocks of seconds, which takes in whatever the model has wrong and whatever the tracks have in
common; the larger of it and the information is used (White (1982), the sandwich; Newey & West (1987) for the blocks).
Old evidence fades within a minute, since clocks and exposure times do change.

Only changes of the rate count: a constant rate turns all bearings by the same angle, at any offset.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Scan, Track, TrackStatus
from swarmtrack.motion.gyro import GyroHistory, Orientation, Orientations

REACH = 0.15  # s about the start value that are searched
STEP = 0.01  # s: a rotation of 5 Hz still is a parabola about its minimum
HALF = 2  # steps to either side over which slopes are taken: fewer let the gyro's noise in
AGILITIES = 430.0**2 * np.array([1e-4, 1e-3, 1e-2, 1e-1])  # rad²/s³ by rad² of a bearing's variance
SPEED_SIGMA = 0.5  # rad/s of a target that is new
FADES = 60.0  # s in which evidence loses all but 1/e of its weight
BLOCK = 2.0  # s over which scores may be correlated
MIN_EVIDENCE = 5.0  # s: with less, three blocks cannot say how they scatter
MIN_COMPONENTS = 60.0  # of innovations, likewise
GATE = 16.0  # squared innovations over their variance, at the best offset: beyond, it was another thing's detection
SCALE_STEP = 0.05  # of the gate's own scale, for each innovation
MAX_LAPSE = 1.0  # s without a detection: the target is followed anew
MAX_TURN_VARIANCE = 3e-3**2  # rad²: a gap in the gyro's samples, and nothing is known across it
MAX_TRACKS = 8
NEAR = 4.0  # sigmas of a track's position after the scan, within which its detection lies
WAITS = (
    0.05 + 2.0 * REACH
)  # s: by then the gyro has passed whatever may be asked of it, early stamps included
MAX_WAITING = 64  # scans; more wait only where the stamps jump
SURE = 3e-3  # s, one sigma: an offset that is known so well is used
SLEW = 0.1  # s of correction for each second
JUDGED_EVERY = 0.5  # s
EDGE = HALF + 1  # grid points at either end where a minimum is none

_GRID: Array = np.linspace(-REACH, REACH, 2 * round(REACH / STEP) + 1)
_INNER = slice(HALF, len(_GRID) - HALF)
_SPAN = 2 * HALF * STEP
# Of the parabola through the points about the least: coefficients of x² and x by least squares, x in s.
_PARABOLA = np.linalg.pinv(np.vander(_GRID[len(_GRID) // 2 - HALF : len(_GRID) // 2 + HALF + 1], 3))[:2]


class OffsetEstimate(NamedTuple):
    """exposure on the IMU's clock = stamp + offset_s; sigma_s: its standard deviation."""

    offset_s: float
    sigma_s: float


class CameraClock:
    """Stamps to exposures on the IMU's clock, by the offset that was told and, once it is sure, by the one found.

    Moved towards what was found no faster than `SLEW`, so that exposures stay in order and no scan comes out late;
    and only where the two differ by more than the estimate's own error, so that a good calibration is left alone.
    """

    def __init__(self, start_s: float, *, estimates: bool = True) -> None:
        self.used_s = start_s
        self._aim_s = start_s
        self._evidence = TimeOffset(start_s) if estimates else None
        self._found: OffsetEstimate | None = None
        self._newest = -math.inf
        self._judged = -math.inf

    @property
    def found(self) -> OffsetEstimate | None:
        """What the flight so far says; None while it says nothing."""
        return self._found

    def exposure(self, stamp: float, gyro: GyroHistory) -> float:
        """When a scan was exposed; to be asked once for each scan, in the order in which they are tracked."""
        if self._evidence is None or stamp <= self._newest:
            return stamp + self.used_s
        self._evidence.advance(gyro, stamp)
        if stamp - self._judged >= JUDGED_EVERY:
            self._judged = stamp
            self._found = found = self._evidence.estimate()
            if found and found.sigma_s < SURE and abs(found.offset_s - self._aim_s) > 2.0 * found.sigma_s:
                self._aim_s = found.offset_s
        most = SLEW * (
            stamp - self._newest
        )  # of the first scan without bound, but then nothing was found yet
        self.used_s += min(max(self._aim_s - self.used_s, -most), most)
        self._newest = stamp
        return stamp + self.used_s

    def see(self, stamp: float, scan: Scan, tracks: Sequence[Track], camera: PinholeCamera) -> None:
        """A scan with that stamp, and the tracks it led to: which of its measurements are whose, raw."""
        if self._evidence is None:
            return
        rows, ids = _whose(scan, tracks)
        z = scan.z[rows]
        bearings = camera.bearing_undistorted(z)
        # A pixel at the border covers less of an angle, by cos² along the radius and by cos across it.
        variance = bearings[:, 2] ** 3 / (camera.fx * camera.fy)
        if scan.R is not None:
            variance *= np.sqrt(np.linalg.det(scan.R[rows]))
        sound = np.isfinite(variance) & (variance > 0.0)
        known = tuple(i for i, good in zip(ids, sound, strict=True) if good)
        self._evidence.see(stamp, known, bearings[sound], variance[sound])


def _whose(scan: Scan, tracks: Sequence[Track]) -> tuple[list[int], tuple[int, ...]]:
    """Rows of the measurements that surely are a track's, and of which.

    The nearest to a track that this scan confirmed, if near, and of no other track; a rare mistake is for the gate.
    """
    seen = [k for k in tracks if k.status is TrackStatus.CONFIRMED and k.coasting_since is None]
    if not seen or not len(scan.z):
        return [], ()
    means = np.array([k.mean[::2] for k in seen])
    distance = ((scan.z[None] - means[:, None]) ** 2).sum(axis=2)
    reach = NEAR**2 * np.array([k.cov[0, 0] + k.cov[2, 2] for k in seen])
    nearest = distance.argmin(axis=1)
    pairs = {
        int(row): k.id
        for row, k, d, limit in zip(nearest, seen, distance.min(axis=1), reach, strict=True)
        if d <= limit and (nearest == row).sum() == 1
    }
    return list(pairs), tuple(pairs.values())


class _Bearings(NamedTuple):
    """What one scan saw of known targets: ids (n,), unit vectors (n, 3), their variance (n,) rad² per axis."""

    t: float
    ids: tuple[int, ...]
    bearings: Array
    variance: Array


class TimeOffset:
    """Evidence for each offset of a grid about `start_s`. Its times are stamps as the camera gives them."""

    def __init__(self, start_s: float = 0.0) -> None:
        self.start_s = start_s
        self._waiting: deque[_Bearings] = deque(maxlen=MAX_WAITING)
        self._last: tuple[float, Orientation] | None = None
        self._targets = _Targets()
        models = (len(AGILITIES), len(_GRID))
        self._cost = np.zeros(models)  # sum of squared normalised innovations
        self._log_det = np.zeros(len(AGILITIES))
        self._information = np.zeros(models)
        self._noise = 0.0  # what the gyro's noise puts into the information
        self._score, self._scatter = np.zeros(models), np.zeros(models)
        self._block_ends = -math.inf
        self._components = 0.0
        self._seconds = 0.0
        self._best = (len(AGILITIES) // 2, len(_GRID) // 2)
        self._gate_scale = 1.0

    def see(self, t: float, ids: tuple[int, ...], bearings: Array, variance: Array) -> None:
        """A scan stamped t saw the targets `ids` (n,) on bearings (n, 3), unit, of variance (n,) rad² per axis."""
        if self._waiting and t <= self._waiting[-1].t:
            return
        n = MAX_TRACKS
        self._waiting.append(_Bearings(t, ids[:n], bearings[:n], variance[:n]))

    def advance(self, gyro: GyroHistory, t: float) -> None:
        """Take what is old enough at the stamp t. It depends on t alone, not on who arrived first."""
        while self._waiting and self._waiting[0].t + WAITS <= t:
            self._take(self._waiting.popleft(), gyro)

    def estimate(self) -> OffsetEstimate | None:
        """The likeliest offset; None while nothing was learned of it, or it lies at the end of what is searched."""
        if self._seconds < MIN_EVIDENCE or self._components < MIN_COMPONENTS:
            return None
        # The likelihood with the best common scale of all variances put in.
        scale = self._cost / self._components
        surprise = 0.5 * (self._components * np.log(scale) + self._log_det[:, None])
        q, k = self._best = divmod(int(surprise.argmin()), len(_GRID))
        if not EDGE <= k < len(_GRID) - EDGE:
            return None
        s2 = scale[q, k]
        around = 0.5 * self._cost[q, k - HALF : k + HALF + 1] / s2
        curvature, slope = _PARABOLA @ around
        information = self._information[q, k] / s2
        signal = information - self._noise / s2
        if curvature <= 0.0 or signal <= 0.0:
            return None
        scatter = max(self._scatter[q, k] / s2**2, information)
        # Where the evidence has several hills, how far they lie apart.
        weight = np.exp(signal**2 / (scatter * information) * (surprise[q, k] - surprise[q]))
        weight /= weight.sum()
        spread = math.sqrt(float(weight @ (_GRID - weight @ _GRID) ** 2))
        sigma = max(math.sqrt(scatter) / signal, spread)
        return OffsetEstimate(float(self.start_s + _GRID[k] - 0.5 * slope / curvature), float(sigma))

    def _take(self, scan: _Bearings, gyro: GyroHistory) -> None:
        at_stamps = scan.t + self.start_s
        orientations = gyro.orientations(at_stamps + _GRID)
        if orientations is None:
            self._last = None
            return
        orientation = gyro.orientation(at_stamps)
        if self._last is None or self._lost(orientation, scan.t):
            self._targets = _Targets()
        else:
            self._fade(scan.t - self._last[0])
        self._last = (scan.t, orientation)
        if scan.t > self._block_ends:
            self._scatter += self._score**2
            self._score = np.zeros_like(self._score)
            self._block_ends = scan.t + BLOCK
        if scan.ids:
            self._learn(scan, orientations)

    def _lost(self, orientation: Orientation, t: float) -> bool:
        assert self._last is not None
        then, before = self._last
        return t - then > MAX_LAPSE or abs(orientation.variance - before.variance) > MAX_TURN_VARIANCE

    def _fade(self, dt: float) -> None:
        kept = math.exp(-dt / FADES)
        self._cost *= kept
        self._log_det *= kept
        self._information *= kept
        self._scatter *= kept
        self._noise *= kept
        self._components *= kept
        self._seconds = kept * self._seconds + dt

    def _learn(self, scan: _Bearings, orientations: Orientations) -> None:
        of_axes = orientations.matrices.transpose(2, 1, 0).reshape(3, -1)
        turned = (scan.bearings @ of_axes).reshape(-1, 3, len(_GRID))
        slots, known = self._targets.slots(scan.t, scan.ids)
        y, S = self._targets.innovations(scan.t, slots[known], turned[known], scan.variance[known])
        theirs = self._accept(y, S)
        followed = known.copy()
        followed[known] = theirs
        y, S = y[theirs], S[theirs]
        self._targets.correct(slots[followed], y, S)
        self._targets.begin(scan.t, slots[~followed], turned[~followed], scan.variance[~followed])
        if not len(y):
            return
        d = (y * y).sum(axis=2) / S[:, :, None]  # (n, q, g)
        slopes = (y[..., 2 * HALF :] - y[..., : -2 * HALF]) / _SPAN
        self._cost += d.sum(axis=0)
        self._log_det += 2.0 * np.log(S).sum(axis=0)
        self._components += 2.0 * len(y)
        self._information[:, _INNER] += ((slopes * slopes).sum(axis=2) / S[:, :, None]).sum(axis=0)
        # White noise, summed over the span; the innovations' filter raises it by no more than S over the variance.
        self._noise += float((2.0 * orientations.noise / _SPAN / scan.variance[followed]).sum())
        self._score[:, _INNER] += 0.5 * (d[:, :, 2 * HALF :] - d[:, :, : -2 * HALF]).sum(axis=0) / _SPAN

    def _accept(self, y: Array, S: Array) -> NDArray[np.bool_]:
        """Which innovations y (n, q, 3, g) of variance S (n, q) are their target's, (n,).

        Judged at the best agility and whichever offset suits best, by a scale of its own: one that follows the median
        finds its way even from where nothing is accepted.
        """
        q = self._best[0]
        least = (y[:, q] ** 2).sum(axis=1).min(axis=1) / S[:, q]
        accepted: NDArray[np.bool_] = least < GATE * self._gate_scale
        above = float(np.sign(least - 2.0 * math.log(2.0) * self._gate_scale).sum())
        self._gate_scale *= math.exp(SCALE_STEP * above)
        return accepted


class _Targets:
    """The filters: each target's bearing in a frame that does not turn, and its speed, as of each offset.

    mean (slot, q, 2, 3, g) rad, rad/s; cov (slot, q, 3): variance of the bearing, covariance, variance of the speed.
    """

    def __init__(self) -> None:
        self._slot_of: dict[int, int] = {}
        self._seen = np.full(MAX_TRACKS, -math.inf)
        self._mean = np.zeros((MAX_TRACKS, len(AGILITIES), 2, 3, len(_GRID)))
        self._cov = np.zeros((MAX_TRACKS, len(AGILITIES), 3))

    def slots(self, t: float, ids: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Where each target has its filters, (n,), and whether it had them before; who is new takes the oldest's."""
        known = np.array([i in self._slot_of and t - self._seen[self._slot_of[i]] <= MAX_LAPSE for i in ids])
        for i in ids:
            if i not in self._slot_of:
                kept = {slot for other, slot in self._slot_of.items() if other in ids}
                slot = min(set(range(MAX_TRACKS)) - kept, key=lambda free: self._seen[free])
                self._slot_of = {other: s for other, s in self._slot_of.items() if s != slot} | {i: slot}
        return np.array([self._slot_of[i] for i in ids]), known

    def innovations(
        self, t: float, slots: NDArray[np.intp], turned: Array, variance: Array
    ) -> tuple[Array, Array]:
        """Carry these targets on to t. Returns y (n, q, 3, g) of the bearings turned (n, 3, g), and S (n, q)."""
        dt = (t - self._seen[slots])[:, None]
        psd = AGILITIES * variance[:, None]
        self._mean[slots, :, 0] += dt[:, :, None, None] * self._mean[slots, :, 1]
        p, c, v = self._cov[slots].transpose(2, 0, 1)
        p = p + dt * (2.0 * c + dt * v) + psd * dt**3 / 3.0
        self._cov[slots] = np.array([p, c + dt * v + psd * dt**2 / 2.0, v + psd * dt]).transpose(1, 2, 0)
        self._seen[slots] = t
        return turned[:, None] - self._mean[slots, :, 0], p + variance[:, None]

    def correct(self, slots: NDArray[np.intp], y: Array, S: Array) -> None:
        p, c, v = self._cov[slots].transpose(2, 0, 1)
        self._mean[slots, :, 0] += (p / S)[:, :, None, None] * y
        self._mean[slots, :, 1] += (c / S)[:, :, None, None] * y
        self._cov[slots] = np.array([p - p * p / S, c - p * c / S, v - c * c / S]).transpose(1, 2, 0)

    def begin(self, t: float, slots: NDArray[np.intp], turned: Array, variance: Array) -> None:
        self._seen[slots] = t
        self._mean[slots, :, 0] = turned[:, None]
        self._mean[slots, :, 1] = 0.0
        self._cov[slots] = np.array([1.0, 0.0, 0.0]) * variance[:, None, None]
        self._cov[slots, :, 2] = SPEED_SIGMA**2
