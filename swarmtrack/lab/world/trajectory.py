"""Flights as functions of time, and the attitude that a quadrotor must have to fly them.

A `Path` says where a drone is, with three derivatives; a `YawProfile` where it points. Together they make a
`Trajectory`. Multirotors are differentially flat (Mellinger & Kumar, "Minimum snap trajectory generation and
control for quadrotors", ICRA 2011): position and yaw as functions of time determine attitude and body rate.
Both follow in closed form, so there is no step size, and states can be asked for in any order.

World is NED, body FRD; metres, seconds, radians. Every path is C3 or better: the body rate has no jumps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from swarmtrack.geometry.geodesy import STANDARD_GRAVITY_M_S2
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Array
from swarmtrack.motion.smooth import DERIVATIVES, scaled, sinusoid, smooth_step
from swarmtrack.motion.sway import sway

GRAVITY = np.array([0.0, 0.0, STANDARD_GRAVITY_M_S2])  # m/s², NED: down is positive
SWAY_BAND_HZ = (0.05, 1.0)
# s: a way over ground is added up so far from the take-off, in such steps.
WAY_SEARCHED_S, WAY_STEP_S = 300.0, 0.1
WIND_AFTER_S = 3.0  # from take-off
NO_LEAN = np.zeros((2, 3))
FREE_FALL_THRUST = 0.5  # m/s²: below it the thrust has no direction, and flatness no attitude


class Path(Protocol):
    """Where, as a function of time."""

    def derivatives(self, t: float) -> Array:
        """Position, velocity, acceleration and jerk, (4, 3), in m, m/s, m/s², m/s³, NED."""
        ...


class YawProfile(Protocol):
    """Which way, as a function of time."""

    def yaw(self, t: float, flat: Array) -> tuple[float, float]:
        """Yaw [rad] and yaw rate [rad/s] at t, where the drone's path has the derivatives `flat` (4, 3)."""
        ...


class Motion(NamedTuple):
    """Everything about one drone at one instant.

    position (3,) m and velocity (3,) m/s, NED; attitude world_from_body (3, 3); body_rate (3,) rad/s, what a perfect
    gyro reads, and specific_force (3,) m/s², what a perfect accelerometer reads, in body axes.
    """

    position: Array
    velocity: Array
    attitude: Array
    body_rate: Array
    specific_force: Array


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """A path and a yaw profile: everything about one drone's motion. takes_off_s: −inf of one that was in the air.
    against_wind (3,) m/s²: the thrust that a steady wind's drag takes in the air."""

    path: Path
    yaw_profile: YawProfile
    takes_off_s: float = -math.inf
    against_wind: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def flown_from(self, way_m: float) -> float:
        """See `OwnDrone`: of the first `WAY_SEARCHED_S`."""
        return -math.inf if math.isinf(self.takes_off_s) else _flown_from(self, way_m)

    def _lean(self, t: float) -> Array:
        """The thrust against the wind and its derivative, (2, 3): after a take-off it grows."""
        if not any(self.against_wind):
            return NO_LEAN
        share = smooth_step((t - self.takes_off_s) / WIND_AFTER_S)[:2] * (1.0, 1.0 / WIND_AFTER_S)
        return np.multiply.outer(share, self.against_wind)

    def position(self, t: float) -> Array:
        """(3,) m, NED."""
        return np.asarray(self.path.derivatives(t)[0])

    def velocity(self, t: float) -> Array:
        """(3,) m/s, NED."""
        return np.asarray(self.path.derivatives(t)[1])

    def acceleration(self, t: float) -> Array:
        """(3,) m/s², NED, without gravity (zero in hover)."""
        return np.asarray(self.path.derivatives(t)[2])

    def yaw(self, t: float) -> float:
        """Rad, from north, clockwise seen from above."""
        return self.yaw_profile.yaw(t, self.path.derivatives(t))[0]

    def yaw_rate(self, t: float) -> float:
        """Rad/s, about the vertical."""
        return self.yaw_profile.yaw(t, self.path.derivatives(t))[1]

    def attitude(self, t: float) -> Array:
        """world_from_body, (3, 3)."""
        return self.pose(t).rotation

    def pose(self, t: float) -> Pose:
        """world_from_body."""
        flat = self.path.derivatives(t)
        yaw, _ = self.yaw_profile.yaw(t, flat)
        return Pose(_flat_attitude(flat[2] + self._lean(t)[0], yaw).attitude, flat[0])

    def body_rate(self, t: float) -> Array:
        """Angular velocity against the world, (3,) rad/s in body axes: what a perfect gyro reads."""
        return self.motion(t).body_rate

    def specific_force(self, t: float) -> Array:
        """Acceleration minus gravity, (3,) m/s² in body axes: what a perfect accelerometer reads."""
        return self.inertial(t)[1]

    def inertial(self, t: float) -> tuple[Array, Array]:
        """`body_rate` and `specific_force` at once, as an IMU needs them, for the price of one."""
        motion = self.motion(t)
        return motion.body_rate, motion.specific_force

    def motion(self, t: float) -> Motion:
        """Everything at once, for the price of one."""
        flat = self.path.derivatives(t)
        yaw, yaw_rate = self.yaw_profile.yaw(t, flat)
        lean = self._lean(t)
        attitude, rate = attitude_and_rate(flat[2] + lean[0], flat[3] + lean[1], yaw, yaw_rate)
        return Motion(flat[0], flat[1], attitude, rate, attitude.T @ (flat[2] - GRAVITY))


@lru_cache(maxsize=256)
def _flown_from(flight: Trajectory, way_m: float) -> float:
    flown, here = 0.0, flight.position(flight.takes_off_s)
    for k in range(1, round(WAY_SEARCHED_S / WAY_STEP_S)):
        t = flight.takes_off_s + WAY_STEP_S * k
        before, here = here, flight.position(t)
        flown += math.hypot(*(here - before)[:2].tolist())
        if flown >= way_m:
            return t
    return math.inf


def attitude_and_rate(acceleration: Array, jerk: Array, yaw: float, yaw_rate: float) -> tuple[Array, Array]:
    """Attitude world_from_body (3, 3) and body rate (3,) rad/s that differential flatness demands.

    The rotors push along -z of the body, so z is the direction of g - a. Of the rotations about z, the one is
    taken whose x axis lies in the vertical plane of the heading: yaw is that of the autopilots' Euler angles
    (roll, pitch, yaw). Mellinger & Kumar 2011, section III, take another plane, as their angles are Z-X-Y.
    The rate is the derivative of exactly this construction, hence good to rounding.
    """
    attitude, thrust, right, length = _flat_attitude(acceleration, yaw)
    x, y, z = attitude.T
    z_dot = -(jerk - z * (z @ jerk)) / thrust
    right_dot = -yaw_rate * np.array([math.cos(yaw), math.sin(yaw), 0.0])
    ahead_dot = _cross(right_dot, z) + _cross(right, z_dot)
    x_dot = (ahead_dot - x * (x @ ahead_dot)) / length

    # R' = R [ω]×, so the components of ω are the products of one axis with the derivative of another.
    rate = np.array([-float(y @ z_dot), float(x @ z_dot), float(y @ x_dot)])
    return attitude, rate


class _FlatAttitude(NamedTuple):
    """attitude world_from_body (3, 3), and what it was made of: thrust [m/s²], right (3,) of the heading's vertical
    plane, and the length of right × z."""

    attitude: Array
    thrust: float
    right: Array
    length: float


def _flat_attitude(acceleration: Array, yaw: float) -> _FlatAttitude:
    down = GRAVITY - acceleration
    thrust = math.sqrt(down @ down)
    if thrust < FREE_FALL_THRUST:
        raise ValueError(
            f"trajectory: acceleration {acceleration} m/s² is free fall, expected one that needs thrust"
        )
    z = down / thrust
    right = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    ahead = _cross(right, z)
    length = math.sqrt(ahead @ ahead)
    x = ahead / length
    return _FlatAttitude(np.array([x, _cross(z, x), z]).T.copy(), thrust, right, length)


def _cross(a: Array, b: Array) -> Array:
    """a × b of two (3,). Plain products of Python's numbers: ten times quicker than np.cross on single vectors."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


# --- paths ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Hover:
    """Stay at `point` (3,) m, NED."""

    point: ArrayLike

    def derivatives(self, t: float) -> Array:
        flat = np.zeros((DERIVATIVES, 3))
        flat[0] = self.point
        return flat


@dataclass(frozen=True, slots=True, eq=False)
class Lissajous:
    """centre + amplitude sin(2π frequency t + phase), each (3,), in m, m, Hz, rad.

    A circle is the case of equal frequencies in two axes, a quarter turn apart.
    """

    centre: ArrayLike
    amplitude: ArrayLike
    frequency: ArrayLike
    phase: ArrayLike = (0.0, 0.0, 0.0)

    def derivatives(self, t: float) -> Array:
        omega = 2.0 * math.pi * np.asarray(self.frequency, dtype=float)
        angle = omega * t + np.asarray(self.phase, dtype=float)
        flat = sinusoid(np.asarray(self.amplitude, dtype=float), omega, angle)
        flat[0] += self.centre
        return flat


def circle(centre: ArrayLike, radius: float, period: float, phase: float = 0.0) -> Lissajous:
    """A level circle about `centre` (3,) m, clockwise seen from above for a positive period [s]."""
    return Lissajous(
        centre, (radius, radius, 0.0), (1 / period, 1 / period, 0.0), (phase + math.pi / 2, phase, 0.0)
    )


@dataclass(frozen=True, slots=True, eq=False)
class Wander:
    """The sway of a drone that holds its position in the wind: sinusoids per axis, about zero.

    amplitudes, frequencies, phases (n, 3) in m, Hz, rad. Build it with `wander`.
    """

    amplitudes: Array
    frequencies: Array
    phases: Array

    def derivatives(self, t: float) -> Array:
        omega = 2.0 * math.pi * self.frequencies
        return np.asarray(sinusoid(self.amplitudes, omega, omega * t + self.phases).sum(axis=1))


def wander(
    rng: np.random.Generator,
    amplitude: float = 0.03,
    terms: int = 6,
    *,
    band_hz: tuple[float, float] = SWAY_BAND_HZ,
) -> Wander:
    """A `Wander` with RMS `amplitude` [m] an axis, from slow gusts to the trembling of the controller.

    One sinusoid in each of the equal bands (by logarithm) that make up band_hz. Its variance falls with the square of
    the frequency: a multirotor tilts by a degree or so for all of them, and does not shake.
    """
    slowest, fastest = band_hz
    band = (np.arange(terms)[:, None] + rng.uniform(0.0, 1.0, (terms, 3))) / terms
    frequencies = slowest * (fastest / slowest) ** band
    share = rng.exponential(size=(terms, 3)) / frequencies**2
    share /= share.sum(axis=0)
    return Wander(
        amplitudes=amplitude * np.sqrt(2.0 * share),
        frequencies=frequencies,
        phases=rng.uniform(0.0, 2.0 * math.pi, size=(terms, 3)),
    )


def _hermite(derivatives: int) -> Array:
    """Coefficients, highest last, of the polynomial on 0…1 with so many derivatives given at 0 and then at 1."""
    n = 2 * derivatives
    conditions = np.zeros((n, n))
    for order in range(derivatives):
        conditions[order, order] = math.factorial(order)
        conditions[derivatives + order, order:] = [math.perm(k, order) for k in range(order, n)]
    return np.asarray(np.linalg.inv(conditions))


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """Numbers that were computed ahead, and as many derivatives as were computed with them, continuous at the samples.

    samples (n, d, m): value and derivatives at begins + k · every [s]. At rest before the first and after the last.
    """

    begins: float
    every: float
    samples: Array
    _coefficients: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        d = self.samples.shape[1]
        scaled = self.samples * self.every ** np.arange(d)[:, None]
        ends = np.concatenate([scaled[:-1], scaled[1:]], axis=1)
        object.__setattr__(self, "_coefficients", np.einsum("ij,njm->nim", _hermite(d), ends))

    def at(self, t: float) -> Array:
        """(d, m)."""
        d = self.samples.shape[1]
        place = (t - self.begins) / self.every
        k = math.floor(place)
        if not 0 <= k < len(self._coefficients):
            still = np.zeros(self.samples.shape[1:])
            still[0] = self.samples[0 if k < 0 else -1, 0]
            return still
        factors, exponents = _DIFFERENTIATE[d]
        powers = factors * (place - k) ** exponents / self.every ** np.arange(d)[:, None]
        return np.asarray(powers @ self._coefficients[k])


# By number of derivatives: (d, 2 d) factors and exponents that a polynomial's terms have after so many of them.
_DIFFERENTIATE = {
    d: (
        np.array([[math.perm(k, order) for k in range(2 * d)] for order in range(d)], dtype=float),
        np.array([[max(k - order, 0) for k in range(2 * d)] for order in range(d)]),
    )
    for d in (3, DERIVATIVES)
}


@dataclass(frozen=True, slots=True, eq=False)
class SampledPath:
    """A `Path` that was computed ahead: position, velocity, acceleration and jerk, (n, 4, 3)."""

    samples: Sampled

    def derivatives(self, t: float) -> Array:
        return self.samples.at(t)


@dataclass(frozen=True, slots=True, eq=False)
class SampledYaw:
    """A `YawProfile` that was computed ahead: yaw, its rate and its acceleration, (n, 3, 1)."""

    samples: Sampled

    def yaw(self, t: float, flat: Array) -> tuple[float, float]:
        yaw, rate, _ = self.samples.at(t)[:, 0].tolist()
        return yaw, rate


@dataclass(frozen=True, slots=True, eq=False)
class MinimumSnap:
    """From rest through waypoints at given times to rest, with the least integral of squared snap.

    times (n,) s, increasing; waypoints (n, 3) m. The minimiser is the spline of degree 7 through the points,
    C6 at each, with velocity, acceleration and jerk zero at both ends. Before and after, the drone rests.
    """

    times: Sequence[float]
    waypoints: ArrayLike
    _splines: tuple[Any, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        from scipy.interpolate import make_interp_spline  # noqa: PLC0415  (0.3 s of import: few paths need it)

        rest = [(order, np.zeros(3)) for order in range(1, DERIVATIVES)]
        spline = make_interp_spline(self.times, np.asarray(self.waypoints, float), k=7, bc_type=(rest, rest))
        object.__setattr__(self, "_splines", tuple(spline.derivative(n) for n in range(DERIVATIVES)))

    def derivatives(self, t: float) -> Array:
        inside = min(max(t, self.times[0]), self.times[-1])
        flat = np.stack([spline(inside) for spline in self._splines])
        if inside != t:
            flat[1:] = 0.0  # exactly at rest; the spline's ends are so to rounding
        return flat


@dataclass(frozen=True, slots=True, eq=False)
class Together:
    """The sum of paths: a flight with a drone's own drift on top."""

    paths: Sequence[Path]

    def derivatives(self, t: float) -> Array:
        total = np.zeros((DERIVATIVES, 3))
        for path in self.paths:
            total += path.derivatives(t)
        return total


@dataclass(frozen=True, slots=True)
class Coded:
    """The sway by which its team recognises a drone (`motion.sway`), about zero, from each of begins_s [s] on."""

    drone_id: int
    team: tuple[int, ...]
    begins_s: tuple[float, ...]

    def derivatives(self, t: float) -> Array:
        flat = np.zeros((DERIVATIVES, 3))
        for begin in self.begins_s:
            flat += sway(self.drone_id, self.team, t - begin)
        return flat


@dataclass(frozen=True, slots=True, eq=False)
class Handover:
    """`before` until `start`, `after` from `start + duration` [s] on, blended smoothly (C3) in between."""

    before: Path
    after: Path
    start: float
    duration: float

    def derivatives(self, t: float) -> Array:
        if t <= self.start:
            return self.before.derivatives(t)
        if t >= self.start + self.duration:
            return self.after.derivatives(t)
        s = smooth_step((t - self.start) / self.duration) / self.duration ** np.arange(DERIVATIVES)
        old = self.before.derivatives(t)
        return np.asarray(old + scaled(s, self.after.derivatives(t) - old))


# --- yaw ------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SteadyYaw:
    """A heading [rad] at t = 0, turning at a constant rate [rad/s]."""

    heading: float = 0.0
    rate: float = 0.0

    def yaw(self, t: float, flat: Array) -> tuple[float, float]:
        return self.heading + self.rate * t, self.rate


@dataclass(frozen=True, slots=True)
class SwingingYaw:
    """Look left and right about `heading` [rad] sinusoidally, up to ±`peak_rate` [rad/s], with `period` [s].

    Still until `start`; the swing then grows to its full size within `ramp` seconds.
    """

    heading: float
    peak_rate: float
    period: float
    start: float = 0.0
    ramp: float = 1.0

    def yaw(self, t: float, flat: Array) -> tuple[float, float]:
        omega = 2.0 * math.pi / self.period
        amplitude = self.peak_rate / omega
        angle = omega * (t - self.start)
        s = smooth_step((t - self.start) / self.ramp)
        yaw = self.heading + amplitude * s[0] * math.sin(angle)
        return yaw, amplitude * (s[1] / self.ramp * math.sin(angle) + s[0] * omega * math.cos(angle))


@dataclass(frozen=True, slots=True, eq=False)
class Facing:
    """Look at `point` (3,) m, NED, from wherever the path leads; it must not lead over the point."""

    point: ArrayLike

    def yaw(self, t: float, flat: Array) -> tuple[float, float]:
        north, east, _ = np.asarray(self.point, dtype=float) - flat[0]
        v_north, v_east, _ = flat[1]
        return math.atan2(east, north), float((v_north * east - v_east * north) / (north**2 + east**2))
