"""An autopilot's messages as gyro samples and ego poses on our clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.clock_map import ClockMap
from swarmtrack.autopilot.contact import Contact, RepeatLimiter
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.gyro_delay import GyroDelay, GyroDelays
from swarmtrack.autopilot.limits import (
    DIVERGED_LOCAL_POSE,
    FASTEST_GYRO_RAD_S,
    GROUND_FRESH_S,
    GROUND_LEAST_UPRIGHT_COSINE,
    IMU_FORGOTTEN_AFTER_S,
    IMU_PREFERRED_S,
    IMU_RATE_WINDOW_S,
    IMU_STALE_AFTER_S,
    LOCAL_POSITION_AGE_S,
    LOCAL_POSITION_SIGMA_M,
    POSE_CLOCK_MISMATCH_S,
    TIMESYNC_FIRST_EXCHANGES,
    TIMESYNC_FIRST_PERIOD_S,
    TIMESYNC_PERIOD_S,
)
from swarmtrack.autopilot.streams import (
    ATTITUDE_QUATERNION,
    DISTANCE_SENSOR,
    GLOBAL_POSITION_INT,
    GPS_RAW_INT,
    HIGHRES_IMU,
    IMU_MESSAGES,
    LOCAL_POSITION_NED,
    NOT_MEASURED,
    RAW_IMU,
    SCALED_IMU,
    Cadence,
    ImuMessage,
    StampStep,
    StreamRequests,
)
from swarmtrack.geometry.rotation import from_quaternion
from swarmtrack.messages import Array, EgoPose, ImuSample
from swarmtrack.sources import AutopilotListener

DOWNWARD = common.MAV_SENSOR_ROTATION_PITCH_270
INVALID_SIGNAL = 1  # of a DISTANCE_SENSOR's quality; 0 is one that tells none
RANKS = {message.id: rank for rank, message in enumerate(IMU_MESSAGES)}


class Telemetry:
    """Turns our autopilot's messages into events for the listener. `readers`: by message id, handlers of (arrival,
    message).

    gps: computes positions in the team frame; None: they are the autopilot's local ones; send: sends a message to the
    autopilot; gyro_delays: delay of its gyro; name: of the link, for the log.
    """

    def __init__(
        self,
        requests: StreamRequests,
        contact: Contact,
        news: RepeatLimiter,
        *,
        gps: GlobalPosition | None,
        send: Callable[[Any], None],
        gyro_delays: GyroDelays,
        name: str,
    ) -> None:
        self.clock_map = ClockMap()
        self.cadence = Cadence()
        self.listener: AutopilotListener
        self.readers: dict[int, Callable[[float, Any], None]] = {
            common.MAVLINK_MSG_ID_TIMESYNC: self._on_timesync,
            common.MAVLINK_MSG_ID_PARAM_VALUE: gyro_delays.on_value,
            HIGHRES_IMU: self._on_imu,
            RAW_IMU: self._on_imu,
            SCALED_IMU: self._on_imu,
            ATTITUDE_QUATERNION: self._on_attitude,
            LOCAL_POSITION_NED: self._on_local_position,
            DISTANCE_SENSOR: self._on_distance,
        }
        if gps is not None:
            del self.readers[LOCAL_POSITION_NED]
            self.readers |= {GPS_RAW_INT: gps.on_fix, GLOBAL_POSITION_INT: self._on_global_position}
        self.imu_at = -math.inf  # when the last sample came
        self.imu_rate_hz = 0.0
        self.imu_samples = 0
        self.poses = 0
        self._requests = requests
        self._contact = contact
        self._news = news
        self._gps = gps
        self._send = send
        self._gyro_delays = gyro_delays
        self._name = name

        self._imu_seen = [-math.inf] * len(IMU_MESSAGES)
        self._imu_rank: int | None = None
        self._imu_t = -math.inf
        self._window_start = -math.inf
        self._window_count = 0
        self._pose_stamp: float | None = None
        self._position: tuple[float, Array, Array] | None = None
        self._placed_at = -math.inf
        self._below: tuple[float, float] | None = None
        self._asked_time: dict[int, float] = {}
        self._exchanges = 0
        self._next_timesync = -math.inf
        self._invalid = self._after_resync = self._poses_without_position = self._reboots = 0

    @property
    def imu_source(self) -> ImuMessage:
        """The message that the samples come from."""
        return IMU_MESSAGES[self._imu_rank or 0]

    @property
    def gyro_delay(self) -> GyroDelay:
        """Delay of the samples that is compensated."""
        return self._gyro_delays.of(self.imu_source.id)

    @property
    def place(self) -> tuple[float, tuple[float, float, float]] | None:
        """Arrival of the newest position, and the position itself, NED [m], from the autopilot or its GPS."""
        if self._position is None:
            return None
        north, east, down = self._position[1].tolist()
        return self._placed_at, (north, east, down)

    def lack(self, now: float) -> str:
        """Why there is no position although a start by GPS needs one; empty otherwise."""
        return "" if self._gps is None else self._gps.lack(now)

    @property
    def counters(self) -> dict[str, float]:
        """All since the start."""
        clock_map, cadence, gyro_delay = self.clock_map, self.cadence, self.gyro_delay
        return {
            "imu_rate_hz": self.imu_rate_hz,
            "imu_samples": self.imu_samples,
            "imu_lost": cadence.lost,
            "gaps": cadence.gaps,
            "duplicates": cadence.repeated,
            "invalid": self._invalid,
            "after_resync": self._after_resync,
            "poses": self.poses,
            "poses_without_position": self._poses_without_position,
            "reboots": self._reboots,
            "clock_offset_s": clock_map.offset if clock_map.offset is not None else math.nan,
            "clock_sigma_s": clock_map.sigma,
            "clock_skew_ppm": clock_map.skew * 1e6,
            "clock_drift_ppm": clock_map.drift * 1e6,
            "clock_restarts": clock_map.restarts,
            "clock_resyncs": clock_map.resyncs,
            "timesyncs": self._exchanges,
            "gyro_delay_s": gyro_delay.seconds,
            "gyro_delay_sigma_s": gyro_delay.sigma,
        }

    def measure(self, now: float) -> None:
        """Once per window: note the IMU's rate."""
        if now - self._window_start >= IMU_RATE_WINDOW_S:
            self.imu_rate_hz = self._window_count / (now - self._window_start)
            self._window_start, self._window_count = now, 0
            if self._imu_rank is not None:
                self._gyro_delays.log_delay(self.imu_source.id)

    # ── gyro ─────────────────────────────────────────────────────────────────────────────────────────────────────

    def _on_imu(self, t: float, m: Any) -> None:
        rank = RANKS[m.get_msgId()]
        source = IMU_MESSAGES[rank]
        # HIGHRES_IMU and RAW_IMU may come from several sensors by turns: the first is the one in use.
        if (source.numbered and m.id) or not self._is_source(t, rank):
            return
        stamp = source.stamp(m)
        gyro, accel = source.read(m)
        # Of three numbers Python asks each faster than NumPy asks all. NaN fails this too.
        if not all(abs(rate) < FASTEST_GYRO_RAD_S for rate in gyro.tolist()):
            self._invalid += 1
            return
        step = self.cadence.observe(stamp)
        if step is StampStep.REPEATED:
            return
        if step is StampStep.REBOOT:
            self._rebooted(stamp)
            self.cadence.observe(stamp)
        self._observe_clock(stamp, t)
        if t - self.imu_at > IMU_FORGOTTEN_AFTER_S:
            self.imu_rate_hz, self._window_start, self._window_count = 0.0, t, 0
        self.imu_at = t
        self._window_count += 1
        delay = self._gyro_delays.of(source.id).seconds
        ours = self.clock_map.to_ours(stamp) - delay
        if ours <= self._imu_t:
            # A correction back in time, or a gyro that turns out to be later: wait until it is made up for.
            self._after_resync += 1
            return
        self._imu_t = ours
        self.imu_samples += 1
        accel = accel if all(map(math.isfinite, accel.tolist())) else NOT_MEASURED
        self.listener.on_imu(ImuSample(ours, gyro, accel, delay))

    def _is_source(self, t: float, rank: int) -> bool:
        """Whether this kind of message is the one to integrate: the best that is coming."""
        self._imu_seen[rank] = t
        better = max(self._imu_seen[:rank], default=-math.inf)
        asked = self._requests.imu is IMU_MESSAGES[rank]
        if t - better < IMU_PREFERRED_S or (
            rank and not asked and t - self._contact.known_at < IMU_PREFERRED_S
        ):
            return False
        if rank != self._imu_rank:
            if self._imu_rank is not None:
                self._news.warn("imu source", "%s: IMU now from %s", self._name, IMU_MESSAGES[rank].name)
            self._imu_rank = rank
            self.cadence.reset()
        return True

    # ── pose ─────────────────────────────────────────────────────────────────────────────────────────────────────

    def _on_global_position(self, t: float, m: Any) -> None:
        assert self._gps is not None
        place = self._gps.place(t, m)
        if place is not None:
            self._position, self._placed_at = (m.time_boot_ms * 1e-3, *place), t

    def _on_local_position(self, t: float, m: Any) -> None:
        position, velocity = (m.x, m.y, m.z), (m.vx, m.vy, m.vz)
        if not all(
            abs(number) < DIVERGED_LOCAL_POSE for number in position + velocity
        ):  # NaN compares as False
            self._invalid += 1
            return
        self._position, self._placed_at = (m.time_boot_ms * 1e-3, np.array(position), np.array(velocity)), t

    def _on_attitude(self, t: float, m: Any) -> None:
        self._on_imu(t, m)
        stamp = m.time_boot_ms * 1e-3
        if self._pose_stamp is not None and stamp < self._pose_stamp:
            if stamp > self._pose_stamp - Cadence.REBOOT:
                return
            self._rebooted(stamp)
        self._pose_stamp = stamp
        if self.clock_map.offset is None or t - self.imu_at > IMU_STALE_AFTER_S:
            self._observe_clock(stamp, t)  # without an IMU, this is what tells the autopilot's time
        q = np.array((m.q1, m.q2, m.q3, m.q4))
        ours = self.clock_map.to_ours(stamp)
        if not 0.9 < float(q @ q) < 1.1 or abs(ours - t) > POSE_CLOCK_MISMATCH_S:
            self._invalid += 1
            return
        if self._position is None or abs(stamp - self._position[0]) > LOCAL_POSITION_AGE_S:
            self._poses_without_position += 1
            where = None
        else:
            at, position, velocity = self._position
            where = position + (stamp - at) * velocity
        self.poses += 1
        gps = self._gps
        sigma, vertical = (LOCAL_POSITION_SIGMA_M, None) if gps is None else (gps.sigma, gps.vertical_sigma)
        attitude = from_quaternion(q)
        ground = self._ground(t, float(attitude[2, 2]))
        self.listener.on_pose(
            EgoPose(ours, where, attitude, position_sigma=sigma, vertical_sigma=vertical, ground=ground)
        )

    def _on_distance(self, t: float, m: Any) -> None:
        # In cm. Outside of its limits, and at the farther one, it has found nothing.
        found = m.min_distance <= m.current_distance < m.max_distance and m.current_distance > 0
        if m.orientation == DOWNWARD and found and m.signal_quality != INVALID_SIGNAL:
            self._below = t, 1e-2 * m.current_distance

    def _ground(self, t: float, upright: float) -> float | None:
        """m straight down to what the range finder has measured since the last pose; upright: cosine of the tilt."""
        below, self._below = self._below, None
        if below is None or t - below[0] > GROUND_FRESH_S or upright < GROUND_LEAST_UPRIGHT_COSINE:
            return None
        return below[1] * upright

    def _rebooted(self, stamp: float) -> None:
        self._reboots += 1
        self._news.warn(
            "reboot",
            "%s: autopilot %s has rebooted (its clock: %.1f s)",
            self._name,
            self._contact.system,
            stamp,
        )
        self.clock_map.reset()
        self.cadence.reset()
        self._pose_stamp = self._position = self._below = None
        self._asked_time.clear()
        self._exchanges = 0
        self._requests.reset()
        self._gyro_delays.restart()
        self.listener.on_autopilot_reboot()

    # ── time ─────────────────────────────────────────────────────────────────────────────────────────────────────

    def opened(self) -> None:
        """The connection is new: request the time at once."""
        self._next_timesync = -math.inf

    def ask_time(self, now: float) -> None:
        """Request the time, once in a while."""
        if now < self._next_timesync:
            return
        first = self._exchanges < TIMESYNC_FIRST_EXCHANGES
        self._next_timesync = now + (TIMESYNC_FIRST_PERIOD_S if first else TIMESYNC_PERIOD_S)
        ns = max(1, int(now * 1e9))  # 0 would make it an answer
        self._asked_time[ns] = now
        while len(self._asked_time) > TIMESYNC_FIRST_EXCHANGES:
            del self._asked_time[next(iter(self._asked_time))]
        self._send(common.MAVLink_timesync_message(tc1=0, ts1=ns))

    def _on_timesync(self, t: float, m: Any) -> None:
        if m.tc1 == 0:
            self._send(common.MAVLink_timesync_message(tc1=int(t * 1e9), ts1=m.ts1))
            return
        sent = self._asked_time.pop(m.ts1, None)
        stamp = m.tc1 * 1e-9
        # Some firmwares keep another clock for this than for their sensors.
        if (
            sent is None
            or self.cadence.newest is None
            or abs(stamp - self.cadence.newest) > POSE_CLOCK_MISMATCH_S
        ):
            return
        self._exchanges += 1
        restarts = self.clock_map.restarts
        self.clock_map.exchange(sent, stamp, t)
        if self.clock_map.restarts > restarts and self.clock_map.in_words:
            self._news.warn("clock", "%s: the autopilot's clock %s", self._name, self.clock_map.in_words)

    def _observe_clock(self, stamp: float, t: float) -> None:
        resyncs = self.clock_map.resyncs
        self.clock_map.observe(stamp, t)
        if self.clock_map.resyncs > resyncs:
            self._news.warn("resync", "hard resync of the autopilot's clock, no. %d", self.clock_map.resyncs)
