"""The camera's orientation over the last seconds, from every gyro sample.

Theory of operation. Samples are integrated once, on arrival, into an orientation that only ever accumulates; the
rotation between any two instants is the quotient of two of them. Between samples the rate is taken as linear in time,
so the orientation at an exposure depends on the two samples around it and on nothing that comes later: a scan that
arrives late finds the very numbers it would have found at once.

What the samples do not tell is paid for in variance. The rate between two known samples is a Brownian bridge whose
angular acceleration is white with density `angular_acceleration_psd`: its integral over a step dt has variance
q dt³/12, and q dt³/3 where the second sample is missing (beyond the newest). So a gap needs no special case: five
lost samples cost two hundred times one step, and a stopped gyro soon says that it knows nothing.

Without a gyro the turn from exposure to exposure is measured in the images (`add_visual_turn`). It is fused with the
prediction by the last rate, by their variances: an image that shows nothing leaves the prediction, and its variance.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.rotation import log
from swarmtrack.messages import Array, VisualTurn
from swarmtrack.motion.priors import (
    GYRO_GAP_STEPS,
    GYRO_WAIT_S,
    UNKNOWN_ANGLE_VARIANCE_RAD2,
    UNKNOWN_RATE_VARIANCE_RAD2_S2,
    VISUAL_TURN_GATE,
)

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]


class Orientation(NamedTuple):
    """The camera at one instant, in the frame it had when the history began.

    quaternion: start_from_camera (w, x, y, z); variance: accumulated uncertainty of the angle per axis [rad²].
    """

    quaternion: Quaternion
    variance: float


class CameraRotation(NamedTuple):
    """matrix (3, 3): camera axes now from camera axes then; variance [rad²] of its error, per axis."""

    matrix: Array
    variance: float


class Orientations(NamedTuple):
    """The camera at many instants: matrices (n, 3, 3), start_from_camera.

    noise [rad²/s]: density of the gyro's white noise, by what its samples around these instants scatter.
    """

    matrices: Array
    noise: float


def rotation_between(then: Orientation, now: Orientation) -> CameraRotation:
    """How the camera turned from one instant to another; variance is never negative, whichever comes first."""
    w, x, y, z = now.quaternion
    turned = _multiply((w, -x, -y, -z), then.quaternion)
    return CameraRotation(_matrix(turned), abs(now.variance - then.variance))


class GyroHistory:
    """Gyro samples in the camera's axes, integrated on SO(3).

    noise_density rad/s/√Hz, angular_acceleration_psd rad²/s³, bias (3,) rad/s in camera axes, history_s how far back
    an exposure may lie. Samples that do not advance in time are dropped and counted.
    """

    def __init__(
        self,
        *,
        history_s: float = 2.0,
        noise_density: float = 2e-3,
        angular_acceleration_psd: float = 1.0,
        bias: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        self.history_s = history_s
        self.bias = bias
        self.samples = 0
        self.gaps = 0
        self.out_of_order = 0
        self.restarts = 0
        self._noise = noise_density**2
        self._psd = angular_acceleration_psd
        self._usual_step = 0.0
        self._times: list[float] = []
        self._rates: list[Vector] = []
        self._orientations: list[Orientation] = []
        self._rate_variances: list[float] = []
        """rad²/s² per axis: of a rate by images, the mean since the one before; 0: of a gyro's."""
        self.visual_turns = 0
        """Rotations by images that were used, in the absence of a gyro."""
        self.visual_contradictions = 0
        """Rotations by images that the gyro contradicts."""

    @property
    def newest(self) -> float | None:
        """Time of the newest sample."""
        return self._times[-1] if self._times else None

    @property
    def counters(self) -> dict[str, int]:
        """Corrected and rejected samples."""
        return {
            "gyro_gaps": self.gaps,
            "gyro_out_of_order": self.out_of_order,
            "gyro_restarts": self.restarts,
            "visual_turns": self.visual_turns,
            "visual_turns_contradicted": self.visual_contradictions,
        }

    def append(self, t: float, rate: Vector) -> None:
        """Add a sample: rate (3,) rad/s in camera axes."""
        if self._times and t <= self._times[-1]:
            if t > self._times[-1] - self.history_s:
                self.out_of_order += 1
                return
            self._restart()
        rate = (rate[0] - self.bias[0], rate[1] - self.bias[1], rate[2] - self.bias[2])
        if not self._times:
            start = self._orientations[-1] if self._orientations else Orientation((1.0, 0.0, 0.0, 0.0), 0.0)
            self._orientations = [start]
        else:
            self._count_gap(t - self._times[-1])
            self._orientations.append(self._advance(-1, t, rate))
        self._remember(t, rate, 0.0)
        self.samples += 1

    def add_visual_turn(self, seen: VisualTurn) -> None:
        """A rotation between two exposures, by what the images show. Where the gyro was silent in between, it is where
        the camera has turned; else it is only compared."""
        newest = self.newest
        if (
            newest is not None
            and newest > min(seen.since, seen.t - GYRO_WAIT_S)
            and not self._rate_variances[-1]
        ):
            self._compare(seen)
            return
        if newest is not None and newest > seen.since:
            return
        if newest is None:
            start = self.orientation(seen.since)
            self._orientations = [start]
            self._remember(seen.since, (0.0, 0.0, 0.0), UNKNOWN_RATE_VARIANCE_RAD2_S2)
        start, foretold = self.orientation(seen.since), self.orientation(seen.t)
        prior = foretold.variance - start.variance
        believed = prior / (prior + seen.variance)
        a, b, c = self._rates[-1]
        dt = seen.t - seen.since
        x, y, z = seen.turn.tolist()
        turn = (
            a * dt + believed * (x - a * dt),
            b * dt + believed * (y - b * dt),
            c * dt + believed * (z - c * dt),
        )
        variance = believed * seen.variance
        if self._times[-1] < seen.since:
            self._orientations.append(start)
            self._remember(seen.since, self._rates[-1], self._rate_variances[-1])
        self._orientations.append(
            Orientation(_multiply(start.quaternion, _exp(turn)), start.variance + variance)
        )
        rate = (turn[0] / dt, turn[1] / dt, turn[2] / dt)
        self._remember(seen.t, rate, variance / dt**2 + self._psd * dt / 3.0)
        self.visual_turns += 1

    def _compare(self, seen: VisualTurn) -> None:
        turned = self.rotation(seen.since, seen.t)
        off = float(np.sum((log(turned.matrix) + seen.turn) ** 2))
        self.visual_contradictions += off > VISUAL_TURN_GATE * (turned.variance + seen.variance)

    def _remember(self, t: float, rate: Vector, rate_variance: float) -> None:
        """What holds at t, where the orientation has just been appended."""
        self._times.append(t)
        self._rates.append(rate)
        self._rate_variances.append(rate_variance)
        if self._times[0] < t - 2.0 * self.history_s:
            self._forget(t - self.history_s)

    def orientation(self, t: float) -> Orientation:
        """The camera at t. Outside the samples the nearest rate is held, at the price of variance."""
        if not self._times:
            return self._orientations[-1] if self._orientations else Orientation((1.0, 0.0, 0.0, 0.0), 0.0)
        k = bisect_right(self._times, t) - 1
        if 0 <= k < len(self._times) - 1:
            fraction = (t - self._times[k]) / (self._times[k + 1] - self._times[k])
            if self._rate_variances[k + 1]:
                return self._between(k, t, fraction)
            a, b = self._rates[k], self._rates[k + 1]
            rate = (
                a[0] + fraction * (b[0] - a[0]),
                a[1] + fraction * (b[1] - a[1]),
                a[2] + fraction * (b[2] - a[2]),
            )
            return self._advance(k, t, rate)
        return self._hold(max(k, 0), t)

    def orientations(self, times: Array) -> Orientations | None:
        """The camera at ascending times (n,), all at once; None where the samples do not enclose them.

        To 1e-6 rad what `orientation` says of each, at a tenth of the price: the conical term is left out.
        """
        first = bisect_right(self._times, times[0]) - 1
        last = bisect_right(self._times, times[-1])
        if first < 0 or last == len(self._times) or last - first < 4:
            return None
        part = slice(first, last + 1)
        if any(self._rate_variances[part]):
            return None
        t, rates = np.array(self._times[part]), np.array(self._rates[part])
        k = np.searchsorted(t, times, side="right") - 1
        dt = times - t[k]
        fraction = (dt / (t[k + 1] - t[k]))[:, None]
        turn = np.ones((len(times), 4))
        turn[:, 1:] = (0.5 * dt)[:, None] * (rates[k] + 0.5 * fraction * (rates[k + 1] - rates[k]))
        start = np.array([orientation.quaternion for orientation in self._orientations[part]])[k]
        q = _of_pairs(start, turn) @ _PRODUCT
        # Makes (1, φ/2) the turn by φ: a step is a centiradian.
        q /= np.sqrt((q * q).sum(axis=1, keepdims=True))
        matrices = (_of_pairs(q, q) @ _MATRIX).reshape(-1, 3, 3)
        # Third differences: of motion they leave next to nothing at such rates, of white noise 20 times its variance.
        left = rates[3:] - 3.0 * rates[2:-1] + 3.0 * rates[1:-2] - rates[:-3]
        density = float(np.vdot(left, left)) / left.size / 20.0 * float(t[-1] - t[0]) / (len(t) - 1)
        return Orientations(matrices, density)

    def rotation(self, t0: float, t1: float) -> CameraRotation:
        """Camera axes at t1 from camera axes at t0, both within the history."""
        return rotation_between(self.orientation(t0), self.orientation(t1))

    def _advance(self, k: int, t: float, rate: Vector) -> Orientation:
        """From sample k to t, where the rate has changed linearly to `rate`.

        Magnus expansion to second order, exact to O(dt⁵) for a linear rate: φ = mean dt + (ω₀ × ω₁) dt²/12.
        Iserles, Munthe-Kaas, Nørsett & Zanna (2000), section 4.
        """
        dt = t - self._times[k]
        (a, b, c), (d, e, f) = self._rates[k], rate
        half, cone = 0.5 * dt, dt * dt / 12.0
        phi = (
            half * (a + d) + cone * (b * f - c * e),
            half * (b + e) + cone * (c * d - a * f),
            half * (c + f) + cone * (a * e - b * d),
        )
        start = self._orientations[k]
        variance = start.variance + self._noise * dt + self._psd * dt**3 / 12.0
        return Orientation(_multiply(start.quaternion, _exp(phi)), variance)

    def _between(self, k: int, t: float, fraction: float) -> Orientation:
        """At a share of the time from node k to the next one, whose rate is the mean of that time."""
        dt = t - self._times[k]
        x, y, z = self._rates[k + 1]
        start, end = self._orientations[k : k + 2]
        variance = start.variance + fraction * (end.variance - start.variance)
        return Orientation(_multiply(start.quaternion, _exp((x * dt, y * dt, z * dt))), variance)

    def _hold(self, k: int, t: float) -> Orientation:
        dt = t - self._times[k]
        x, y, z = self._rates[k]
        start = self._orientations[k]
        paid = self._noise * abs(dt) + self._psd * abs(dt) ** 3 / 3.0 + self._rate_variances[k] * dt * dt
        variance = start.variance + math.copysign(paid, dt)
        return Orientation(_multiply(start.quaternion, _exp((x * dt, y * dt, z * dt))), variance)

    def _count_gap(self, dt: float) -> None:
        usual = self._usual_step or dt
        self.gaps += dt > GYRO_GAP_STEPS * usual
        # Follows by small bounded steps, so that neither a gap nor a duplicate moves it much.
        self._usual_step = usual + 0.05 * (min(max(dt, 0.5 * usual), 1.5 * usual) - usual)

    def _restart(self) -> None:
        """The stamps jumped back by more than the history: what lies between then and now is unknown."""
        last = self._orientations[-1]
        self._orientations = [last._replace(variance=last.variance + UNKNOWN_ANGLE_VARIANCE_RAD2)]
        self._times, self._rates, self._rate_variances = [], [], []
        self.restarts += 1

    def _forget(self, before: float) -> None:
        keep = max(bisect_right(self._times, before) - 1, 0)
        del self._times[:keep], self._rates[:keep], self._orientations[:keep], self._rate_variances[:keep]


# Four-number quaternions in plain Python: for one product an array costs five times as much as the arithmetic.


def _multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def _exp(phi: Vector) -> Quaternion:
    x, y, z = phi
    angle = math.sqrt(x * x + y * y + z * z)
    k = 0.5 - angle * angle / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
    return math.cos(0.5 * angle), k * x, k * y, k * z


def _matrix(q: Quaternion) -> Array:
    """(3, 3) of a unit quaternion that a hundred thousand products have left a little off one."""
    w, x, y, z = q
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return np.array(
        [
            [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
        ]
    )


# Many quaternions at once: a product, and the matrix of a unit one, are linear in the 16 products of components.


def _of_pairs(p: Array, q: Array) -> Array:
    """p (n, 4), q (n, 4) -> (n, 16)."""
    pairs: Array = (p[:, :, None] * q[:, None, :]).reshape(-1, 16)
    return pairs


def _turned(p: Quaternion, v: Quaternion, q: Quaternion) -> Vector:
    """The vector part of p v q*."""
    w, x, y, z = q
    return _multiply(_multiply(p, v), (w, -x, -y, -z))[1:]


_UNITS: tuple[Quaternion, ...] = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)
_PRODUCT: Array = np.array([_multiply(p, q) for p in _UNITS for q in _UNITS])
_MATRIX: Array = np.array(
    [np.transpose([_turned(p, v, q) for v in _UNITS[1:]]).ravel() for p in _UNITS for q in _UNITS]
)
