"""A small autopilot with ArduPilot's manners: heartbeats, streams on request, a clock of its own, reboots.

It has no I/O and no clock: `receive` takes a datagram, `step(now)` returns those due by then. `now` and every t here
are seconds on one clock of the caller's. What it senses comes from `Senses`: of a drone in a `World`, `DroneSenses`.

As measured on ArduCopter: nothing but heartbeats until asked; intervals in whole milliseconds; DENIED above 333 Hz and
for messages it does not offer; samples of several streams that are due together share a datagram.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.messages import Array
from swarmtrack.simulation.sensors import EgoParameters, Imu, ImuParameters
from swarmtrack.simulation.trajectory import STANDARD_GRAVITY
from swarmtrack.simulation.world import World

SHORTEST_INTERVAL_US = 3000  # ArduCopter's loop of 400 Hz: 333 Hz is granted, 400 Hz is DENIED
LONGEST_INTERVAL_US = 60e6
HEARTBEAT_EVERY = 1.0  # s
CATCH_UP = 0.5  # s: what was not sent for longer (the process was stopped) is not sent at all
IMU = (
    common.MAVLINK_MSG_ID_HIGHRES_IMU,
    common.MAVLINK_MSG_ID_RAW_IMU,
    common.MAVLINK_MSG_ID_SCALED_IMU,
)
OFFERED: tuple[int, ...] = (
    *IMU,
    common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    common.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    common.MAVLINK_MSG_ID_GPS_RAW_INT,
)
UNKNOWN_HEADING = 65535
LARGEST_DATAGRAM = 1200  # bytes
NOISE_BLOCK = 1024  # ms of noise drawn at once: a generator costs as much as a hundred of its numbers


class GpsFix(NamedTuple):
    """Where a GPS receiver believes itself to be, height above mean sea level; sigma: m per axis, as it says."""

    place: Geodetic
    sigma: float


class SensedState(NamedTuple):
    """gyro (3,) rad/s and accel (3,) m/s², body FRD; q (w, x, y, z) world_from_body; position (3,) m and velocity
    (3,) m/s in the autopilot's local frame, NED; gps: None while there is no fix."""

    gyro: Array
    accel: Array
    q: Array
    position: Array
    velocity: Array
    gps: GpsFix | None = None


class Senses(Protocol):
    """What an autopilot measures and estimates at any time."""

    def at(self, t: float) -> SensedState: ...


class DroneSenses:
    """The senses of one drone of a world. epoch: world time 0 on the caller's clock.

    earth: where the world's origin lies on the Earth, None for a drone without GPS; its error, gps_sigma m per axis, is
    one for the whole flight, as it hardly changes within minutes. The local frame has the axes of the world and its
    origin where the drone is at world time 0, as ArduPilot sets it at arming. Noise is a function of the seed and of
    the time in milliseconds.
    """

    def __init__(
        self,
        world: World,
        drone_id: int,
        epoch: float,
        *,
        imu: ImuParameters | None = None,
        ego: EgoParameters | None = None,
        earth: Geodetic | None = None,
        gps_sigma: float = 0.8,
    ) -> None:
        self._world = world
        self._drone_id = drone_id
        self._epoch = epoch
        self._imu = Imu(world, drone_id, imu)
        self._ego = ego or EgoParameters()
        self._origin = world.pose(drone_id, 0.0).position
        self._earth = earth
        self._gps_sigma = gps_sigma
        self._gps_error = gps_sigma * world.chance("gps", drone_id).standard_normal(3)
        self._block: int | None = None
        self._noise = np.zeros((0, 4, 3))

    def at(self, t: float) -> SensedState:
        motion = self._world.drones[self._drone_id].motion(t - self._epoch)
        white = self._white(round((t - self._epoch) * 1e3))
        gyro, accel = self._imu.measure(motion, white[:2])
        # Of an error this small, the half angle is the vector part of its quaternion.
        x, y, z = (0.5 * self._ego.attitude_sigma * white[2]).tolist()
        return SensedState(
            gyro=gyro,
            accel=accel,
            q=_product(_quaternion(motion.attitude), (1.0, x, y, z)),
            position=motion.position - self._origin + self._ego.position_sigma * white[3],
            velocity=motion.velocity,
            gps=self._fix(motion.position),
        )

    def _fix(self, position: Array) -> GpsFix | None:
        if self._earth is None:
            return None
        return GpsFix(from_ned(position + self._gps_error, self._earth), self._gps_sigma)

    def _white(self, ms: int) -> Array:
        """White noise of unit variance, (4, 3), of that millisecond of world time."""
        block, row = divmod(ms, NOISE_BLOCK)
        if block != self._block:
            rng = self._world.chance("autopilot", self._drone_id, block)
            self._block, self._noise = block, rng.standard_normal((NOISE_BLOCK, 4, 3))
        return np.asarray(self._noise[row])


class _Stream:
    """One message at its interval [s]; the next is due at `due` on the autopilot's own clock, in whole intervals."""

    def __init__(self, interval: float, stamp: float) -> None:
        self.interval = interval
        self.skip_to(stamp)

    def skip_to(self, stamp: float) -> None:
        self._count = math.ceil(stamp / self.interval - 1e-9)

    @property
    def due(self) -> float:
        return self._count * self.interval

    def advance(self) -> None:
        self._count += 1


class SimulatedArduPilot:
    """boot_at: when it was switched on; skew: of its clock against the caller's [s/s]; offered: messages that can be
    asked for. Public attributes may be changed while it runs.

    mute: says nothing at all; imu_gap: sends no IMU messages, as if the sensor had failed.
    """

    def __init__(
        self,
        senses: Senses,
        *,
        system: int = 1,
        component: int = 1,
        boot_at: float = 0.0,
        skew: float = 0.0,
        offered: tuple[int, ...] = OFFERED,
    ) -> None:
        self.senses = senses
        self.boot_at = boot_at
        self.skew = skew
        self.offered = offered
        self.mute, self.imu_gap = False, False
        self.armed, self.status = True, common.MAV_STATE_ACTIVE  # as in the air
        self.system = system
        self.mav = common.MAVLink(None, system, component)
        self.refused_datagrams = 0
        self._streams: dict[int, _Stream] = {}
        self._heartbeat_due = -math.inf
        self._outbox: list[bytes] = []

    def stamp(self, t: float) -> float:
        """Seconds since boot on its own clock."""
        return (t - self.boot_at) * (1.0 + self.skew)

    def time(self, stamp: float) -> float:
        """The inverse of `stamp`."""
        return self.boot_at + stamp / (1.0 + self.skew)

    def reboot(self, now: float) -> None:
        """Time begins again and every stream is forgotten."""
        self.boot_at = now
        self.mav.seq = 0
        self._streams.clear()
        self._outbox.clear()
        self._heartbeat_due = -math.inf

    def frame(self, message: Any) -> bytes:
        data = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    # ── what comes ───────────────────────────────────────────────────────────────────────────────────────────────────

    def receive(self, data: bytes, now: float) -> bool:
        """Take a datagram of the companion's; False if there was no valid message in it, whoever sent it."""
        messages = self.parse(data)
        for message in messages:
            self.understand(message, now)
        self.refused_datagrams += not messages
        return bool(messages)

    def parse(self, data: bytes) -> list[Any]:
        """The valid messages of a datagram. Each is read by itself: a cut one must not spoil the next."""
        parser = self.parser()
        try:
            messages = parser.parse_buffer(data) or []
        except common.MAVError:
            return []
        return [m for m in messages if m.get_type() != "BAD_DATA" and not m.get_type().startswith("UNKNOWN")]

    def parser(self) -> Any:
        parser = common.MAVLink(None)
        parser.robust_parsing = True
        return parser

    def understand(self, message: Any, now: float) -> None:
        """Do what a message asks for."""
        match message.get_type():
            case "COMMAND_LONG":
                self._command(message, now)
            case "TIMESYNC" if message.tc1 == 0:
                answer = common.MAVLink_timesync_message(int(self.stamp(now) * 1e9), message.ts1)
                self._outbox.append(self.frame(answer))

    def _command(self, command: Any, now: float) -> None:
        if command.target_system not in (0, self.system):
            return
        result = common.MAV_RESULT_UNSUPPORTED
        if command.command == common.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self.set_interval(command.param1, command.param2, now)
        elif command.command == common.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
            result = common.MAV_RESULT_DENIED  # as in the air
        ack = common.MAVLink_command_ack_message(
            command.command,
            result,
            target_system=command.get_srcSystem(),
            target_component=command.get_srcComponent(),
        )
        self._outbox.append(self.frame(ack))

    def set_interval(self, message_id: float, interval_us: float, now: float) -> int:
        """SET_MESSAGE_INTERVAL: the MAV_RESULT. Negative stops a stream, 0 is its default, which is not to be sent."""
        asked = math.isfinite(interval_us) and interval_us > 0
        if message_id not in self.offered or not math.isfinite(interval_us):
            return int(common.MAV_RESULT_DENIED)
        if asked and not SHORTEST_INTERVAL_US <= interval_us <= LONGEST_INTERVAL_US:
            return int(common.MAV_RESULT_DENIED)
        self._streams.pop(int(message_id), None)
        if asked:
            interval = (interval_us // 1000) * 1e-3  # whole milliseconds, rounded down
            self._streams[int(message_id)] = _Stream(interval, self.stamp(now))
        return int(common.MAV_RESULT_ACCEPTED)

    # ── what goes ────────────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def next_due(self) -> float:
        """When `step` will have something to say."""
        if self._outbox:
            return -math.inf
        streams = min((stream.due for stream in self._streams.values()), default=math.inf)
        return min(self._heartbeat_due, self.time(streams))

    def step(self, now: float) -> list[bytes]:
        """The datagrams due by `now`, oldest first."""
        frames, self._outbox = self._outbox, []
        if now >= self._heartbeat_due:
            self._heartbeat_due = now + HEARTBEAT_EVERY
            frames.append(self.frame(self._heartbeat()))
        frames.extend(self._due_streams(now))
        return [] if self.mute else list(_datagrams(frames))

    def _heartbeat(self) -> Any:
        return common.MAVLink_heartbeat_message(
            common.MAV_TYPE_QUADROTOR,
            common.MAV_AUTOPILOT_ARDUPILOTMEGA,
            common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            | (common.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0),
            0,
            self.status,
            3,
        )

    def _due_streams(self, now: float) -> Iterator[bytes]:
        stamp = self.stamp(now)
        for stream in self._streams.values():
            if stamp - stream.due > CATCH_UP:
                stream.skip_to(stamp)
        while self._streams:
            due = min(stream.due for stream in self._streams.values())
            if due > stamp:
                return
            sensed = self.senses.at(self.time(due))
            for message_id, stream in self._streams.items():
                if stream.due <= due + 1e-6:
                    stream.advance()
                    if not (self.imu_gap and message_id in IMU):
                        yield self.frame(self.message(message_id, due, sensed))

    def message(self, message_id: int, stamp: float, sensed: SensedState) -> Any:
        """The message of a stream, of what was sensed at `stamp` [s] of its own clock."""
        us, ms = round(stamp * 1e6), round(stamp * 1e3)
        match message_id:
            case common.MAVLINK_MSG_ID_HIGHRES_IMU:
                return common.MAVLink_highres_imu_message(
                    us, *sensed.accel, *sensed.gyro, 0.2, 0.1, 0.4, 1013.0, 0.0, 100.0, 25.0, 0xFFFF
                )
            case common.MAVLINK_MSG_ID_RAW_IMU:
                return common.MAVLink_raw_imu_message(us, *_thousandths(sensed), 0, 0, 0)
            case common.MAVLINK_MSG_ID_SCALED_IMU:
                return common.MAVLink_scaled_imu_message(ms, *_thousandths(sensed), 0, 0, 0)
            case common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
                return common.MAVLink_attitude_quaternion_message(ms, *sensed.q, *sensed.gyro)
            case common.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
                return common.MAVLink_local_position_ned_message(ms, *sensed.position, *sensed.velocity)
            case common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
                return _global_position(ms, sensed)
            case common.MAVLINK_MSG_ID_GPS_RAW_INT:
                return _gps_raw(us, sensed.gps)
        raise AssertionError(f"message {message_id} is offered but not written")


def _global_position(ms: int, sensed: SensedState) -> Any:
    """Without a fix at 0° N 0° E, as ArduPilot."""
    place = sensed.gps.place if sensed.gps else Geodetic(0.0, 0.0, 0.0)
    velocity = [round(1e2 * v) for v in sensed.velocity.tolist()]
    down = -round(1e3 * sensed.position[2])
    return common.MAVLink_global_position_int_message(
        ms, *_degrees_and_millimetres(place), down, *velocity, UNKNOWN_HEADING
    )


def _gps_raw(us: int, gps: GpsFix | None) -> Any:
    fix = common.GPS_FIX_TYPE_3D_FIX if gps else common.GPS_FIX_TYPE_NO_FIX
    place = gps.place if gps else Geodetic(0.0, 0.0, 0.0)
    accuracy = round(1e3 * gps.sigma) if gps else 0
    satellites = 14 if gps else 0
    return common.MAVLink_gps_raw_int_message(
        us, fix, *_degrees_and_millimetres(place), 80, 120, 0, 0, satellites, 0, accuracy, accuracy
    )


def _degrees_and_millimetres(place: Geodetic) -> tuple[int, int, int]:
    latitude, longitude = (round(1e7 * math.degrees(angle)) for angle in place[:2])
    return latitude, longitude, round(1e3 * place.height)


def _thousandths(sensed: SensedState) -> list[int]:
    """Acceleration in mG and angular velocity in mrad/s, as 16 bits hold them."""
    values = np.concatenate([sensed.accel * (1e3 / STANDARD_GRAVITY), sensed.gyro * 1e3])
    return [int(v) for v in np.clip(np.rint(np.nan_to_num(values)), -32768, 32767)]


def _quaternion(R: Array) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a rotation (3, 3): `rotation.to_quaternion` for one, in a tenth of its time.

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
    return q


def _product(a: tuple[float, ...], b: tuple[float, ...]) -> Array:
    """The unit quaternion along a b."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    q = (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
    return np.array(q) / math.hypot(*q)


def _datagrams(frames: list[bytes]) -> Iterator[bytes]:
    """The frames in as few datagrams as hold them."""
    datagram = b""
    for frame in frames:
        if len(datagram) + len(frame) > LARGEST_DATAGRAM:
            yield datagram
            datagram = b""
        datagram += frame
    if datagram:
        yield datagram
