"""What an autopilot senses and estimates: of a drone in a simulated world, with a real one's errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.lab.autopilots.external_position import ExternalPosition
from swarmtrack.lab.world.response import Triple
from swarmtrack.lab.world.sensors import Ego, Imu, ImuParameters
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array

FINDS_ITSELF_S = 8.0  # s from a reboot to a position, as ArduCopter needs with GPS
SENSE_NOISE_BLOCK = 1024  # ms of noise drawn at once: a generator costs as much as a hundred of its numbers


class GpsFix(NamedTuple):
    """Where a GPS receiver believes itself to be, height above mean sea level.

    sigma: m north and east, as it says; vertical_sigma: m of the height, None: the same.
    """

    place: Geodetic
    sigma: float
    vertical_sigma: float | None = None


class Inertial(NamedTuple):
    """gyro (3,) rad/s and accel (3,) m/s², body FRD."""

    gyro: Array
    accel: Array


class SensedState(NamedTuple):
    """gyro (3,) rad/s and accel (3,) m/s², body FRD; q (w, x, y, z) world_from_body; position (3,) m, None while it
    knows none, and velocity (3,) m/s in the autopilot's local frame, NED; gps: None while there is no fix; globe: where
    its estimator believes to be on the Earth, by whatever it goes, None where it knows nothing; ground [m]: along the
    downward beam of its range finder, None where it has none or finds nothing."""

    gyro: Array
    accel: Array
    q: Array
    position: Array | None
    velocity: Array
    gps: GpsFix | None = None
    globe: Geodetic | None = None
    ground: float | None = None


class LastingErrors(NamedTuple):
    """By how much an autopilot is off in what it believes of itself, for minutes. It flies by what it believes.

    heading: clockwise, rad, at a world time; local (3,) m, NED: of its position in its local frame; earth (3,) m, NED:
    of the place on the Earth that its GPS says.
    """

    heading: Callable[[float], float]
    local: Triple
    earth: Triple


NO_ERRORS = LastingErrors(lambda t: 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


class Senses(Protocol):
    """What an autopilot measures and estimates at any time. position_lost: its receiver finds nothing now;
    goes_by_receiver: whether its estimator would use what that finds."""

    position_lost: bool
    goes_by_receiver: bool

    def at(self, t: float) -> SensedState: ...

    def inertial(self, t: float) -> Inertial:
        """A part of that, which is streamed most often and costs half."""
        ...

    def rebooted(self, t: float) -> None:
        """The autopilot that uses them starts again at t."""
        ...

    def take_position(self, t: float, position: Array, var: Array, *, is_reset: bool) -> None:
        """An external position (3,) m in the local frame at t, with variances (3,) m²."""
        ...


class DroneSenses:
    """The senses of one drone of a world. epoch: world time 0 on the caller's clock; ego: its estimate, None: an
    ArduPilot's.

    earth: where the world's origin lies on the Earth, None for a drone without GPS. GPS has one error for the whole
    flight, as it hardly changes within minutes: gps_sigma m north and east, gps_vertical_sigma m in height. The local
    frame has the axes of the world and its origin where the drone is at world time 0, as ArduPilot sets it at arming.
    range_finder_m: how far a range finder that looks down sees, None: there is none; the ground is at world height 0.
    Noise is a function of the seed and of the time in milliseconds.
    """

    def __init__(
        self,
        world: World,
        drone_id: int,
        epoch: float,
        *,
        imu: ImuParameters | None = None,
        ego: Ego | None = None,
        earth: Geodetic | None = None,
        gps_sigma: float = 0.8,
        gps_vertical_sigma: float | None = None,
        range_finder_m: float | None = None,
    ) -> None:
        self._world = world
        self._drone = world.flown(drone_id)
        self._drone_id = drone_id
        self._epoch = epoch
        self._imu = Imu(world, drone_id, imu)
        self._ego = ego or Ego(world, drone_id)
        self._earth = earth
        self._gps_sigma = gps_sigma
        self._gps_vertical_sigma = gps_sigma if gps_vertical_sigma is None else gps_vertical_sigma
        sigmas = np.array((gps_sigma, gps_sigma, self._gps_vertical_sigma))
        self._gps_error = sigmas * world.chance("gps", drone_id).standard_normal(3)
        self._gps_error[2] += self._ego.height_error
        self.lasting_errors = LastingErrors(
            self._ego.heading_error, (0.0, 0.0, self._ego.height_error), tuple(self._gps_error.tolist())
        )
        self._range_finder_m = range_finder_m
        self.position_lost = False
        """Whether its receiver finds nothing now. May be changed while it runs."""
        self.goes_by_receiver = True
        self._external = ExternalPosition()
        self._position_from = -math.inf
        if self._drone.takes_off_s > -math.inf:
            # On the ground it has to find itself; who flies has done so.
            self._position_from = epoch + self._ego.on_since + FINDS_ITSELF_S
        self._block: int | None = None
        self._noise = np.zeros((0, 4, 3))

    def rebooted(self, t: float) -> None:
        """The autopilot began anew at t: it knows no position until it has found itself again, and on the ground it has
        to wake as well."""
        self._position_from = t + FINDS_ITSELF_S
        if t - self._epoch < self._drone.takes_off_s:
            self._ego.on_since = t - self._epoch

    def is_located(self, t: float) -> bool:
        """Whether the autopilot knows where it is."""
        return self._is_own(t) or self._external.off(t) is not None

    def _has_fix(self, t: float) -> bool:
        return t >= self._position_from and not self.position_lost

    def _is_own(self, t: float) -> bool:
        return self._has_fix(t) and self.goes_by_receiver

    def take_position(self, t: float, position: Array, var: Array, *, is_reset: bool) -> None:
        """While it goes by its receiver it needs none."""
        if self._is_own(t):
            return
        world_t = t - self._epoch
        own, _ = self._ego.estimate(self._drone.motion(world_t), world_t, np.zeros((2, 3)))
        self._external.take(t, position - own, var, is_reset=is_reset)

    def is_ready(self, t: float) -> bool:
        """Whether it knows itself well enough to arm."""
        return self.is_located(t) and self._ego.is_awake(t - self._epoch)

    def at(self, t: float) -> SensedState:
        world_t = t - self._epoch
        motion = self._drone.motion(world_t)
        white = self._white(round(world_t * 1e3))
        gyro, accel = self._imu.measure(world_t, white[:2])
        position, attitude = self._ego.estimate(motion, world_t, white[2:])
        is_own = self._is_own(t)
        off = np.zeros(3) if is_own else self._external.off(t)
        walk, walking = self._ego.walk(world_t)
        gps = self._fix(motion.position + walk) if self._has_fix(t) else None
        believed = gps if is_own or off is None else self._fix(motion.position + walk + off)
        return SensedState(
            gyro=gyro,
            accel=accel,
            q=np.array(_quaternion(attitude)),
            position=None if off is None else position + off,
            velocity=motion.velocity + walking,
            gps=gps,
            globe=believed.place if believed else None,
            ground=self._below(-float(motion.position[2]), float(motion.attitude[2, 2])),
        )

    def inertial(self, t: float) -> Inertial:
        world_t = t - self._epoch
        return Inertial(*self._imu.measure(world_t, self._white(round(world_t * 1e3))[:2]))

    def _fix(self, position: Array) -> GpsFix | None:
        if self._earth is None:
            return None
        place = from_ned(position + self._gps_error, self._earth)
        return GpsFix(place, self._gps_sigma, self._gps_vertical_sigma)

    def _below(self, height: float, upright: float) -> float | None:
        """m along a beam that is as tilted as the drone; upright: cosine of that."""
        if self._range_finder_m is None or upright <= 0.0:
            return None
        distance = max(height, 0.0) / upright
        return distance if distance < self._range_finder_m else None

    def _white(self, ms: int) -> Array:
        """White noise of unit variance, (4, 3), of that millisecond of world time."""
        block, row = divmod(ms, SENSE_NOISE_BLOCK)
        if block != self._block:
            rng = self._world.chance("autopilot", self._drone_id, block)
            self._block, self._noise = block, rng.standard_normal((SENSE_NOISE_BLOCK, 4, 3))
        return np.asarray(self._noise[row])


def _quaternion(R: Array) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a rotation (3, 3), of unit length: `rotation.to_quaternion` for one, in a tenth of its time.

    Shepperd (1978): from the largest of the trace and the diagonal.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    trace = xx + yy + zz
    largest = max(trace, xx, yy, zz)
    if largest == trace:
        q = (1.0 + trace, zy - yz, xz - zx, yx - xy)
    elif largest == xx:
        q = (zy - yz, 1.0 + xx - yy - zz, xy + yx, xz + zx)
    elif largest == yy:
        q = (xz - zx, xy + yx, 1.0 - xx + yy - zz, yz + zy)
    else:
        q = (yx - xy, xz + zx, yz + zy, 1.0 - xx - yy + zz)
    length = math.hypot(*q)
    return q[0] / length, q[1] / length, q[2] / length, q[3] / length
