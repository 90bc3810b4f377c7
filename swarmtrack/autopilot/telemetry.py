"""An autopilot's messages as gyro samples and ego poses on our clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.boot_clock import MICROSECONDS_WRAP_S, MILLISECONDS_WRAP_S, BootClock, StampStep
from swarmtrack.autopilot.clock_map import ClockMap
from swarmtrack.autopilot.contact import Contact, RepeatLimiter
from swarmtrack.autopilot.fed_position import FedPosition
from swarmtrack.autopilot.framer import Framer
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.gyro_delay import GyroDelay, GyroDelays
from swarmtrack.autopilot.imu_choice import ImuChoice
from swarmtrack.autopilot.intake import FrameLoss, Intake
from swarmtrack.autopilot.limits import (
    COPIES_SAID,
    DIVERGED_LOCAL_POSE,
    FASTEST_GYRO_RAD_S,
    GROUND_FRESH_S,
    GROUND_LEAST_UPRIGHT_COSINE,
    GYRO_RATE_SHARE,
    IMU_FORGOTTEN_AFTER_S,
    IMU_RATE_WINDOW_S,
    IMU_STALE_AFTER_S,
    LOCAL_ORIGIN_GAP_S,
    LOCAL_POSITION_AGE_S,
    LOCAL_POSITION_SIGMA_M,
    NUMBERED_GAP_S,
    OTHER_BASE_STAMPS,
    POSE_CLOCK_MISMATCH_S,
    POSE_MISSED_S,
    QUATERNION_PREFERRED_S,
    SECOND_CLOCK_SHARE,
    SLOWEST_USEFUL_GYRO_HZ,
    TIMESYNC_FIRST_EXCHANGES,
    TIMESYNC_FIRST_PERIOD_S,
    TIMESYNC_PERIOD_S,
)
from swarmtrack.autopilot.links import Link
from swarmtrack.autopilot.senders import (
    SenderWatch,
    StampedAttitude,
    StampedPlace,
    attitudes_apart,
    places_apart,
)
from swarmtrack.autopilot.stamps import AutopilotStamps
from swarmtrack.autopilot.streams import (
    ATTITUDE,
    ATTITUDE_MESSAGES,
    ATTITUDE_QUATERNION,
    DISTANCE_SENSOR,
    GLOBAL_POSITION_INT,
    GPS2_RAW,
    GPS_RAW_INT,
    HIGHRES_IMU,
    IMU_MESSAGES,
    LOCAL_POSITION_NED,
    NOT_MEASURED,
    ODOMETRY,
    RAW_IMU,
    SCALED_IMU,
    SCALED_IMU2,
    SCALED_IMU3,
    Cadence,
    ImuMessage,
    StreamRequests,
)
from swarmtrack.geometry.rotation import from_euler, from_quaternion
from swarmtrack.messages import Array, EgoPose, ImuSample
from swarmtrack.sources import AutopilotListener

DOWNWARD = common.MAV_SENSOR_ROTATION_PITCH_270
BODY_FRAMES = (common.MAV_FRAME_BODY_NED, common.MAV_FRAME_BODY_FRD)
INVALID_SIGNAL = 1  # of a DISTANCE_SENSOR's quality; 0 is one that tells none
NEW_STAMPS = (StampStep.NEXT, StampStep.REBOOT, StampStep.REPLACED)
RANKS = {message.id: rank for rank, message in enumerate(IMU_MESSAGES)}

# Why something is thrown away.
IMPOSSIBLE, OTHER_CLOCK, STANDING_CLOCK = (
    "impossible values",
    "stamps of another clock",
    "stamps that stand still",
)
SECOND_CLOCK = "late, or of a second clock"
STEPPED_BACK = "stamps before the last one, after the clock was corrected"
# And why something is passed over.
OTHER_SENSOR = "of another sensor than the first"
NO_FIX = "without a usable GPS fix, or far from the team's origin"
NOT_NEEDED = "impossible values, and another message is used"


class Telemetry:
    """Turns our autopilot's messages into events for the listener. `readers`: by message id, handlers of (arrival,
    message); `stamped`: those that are read by their stamps.

    link: nothing can be requested of a recording; framer: counts what is damaged; gps: computes positions in the team
    frame; None: they are the autopilot's local ones; send: sends a message to the autopilot; gyro_delays: delay of its
    gyro; fed: whether its position rests on ours, None: it is fed none.
    """

    def __init__(
        self,
        link: Link,
        requests: StreamRequests,
        contact: Contact,
        news: RepeatLimiter,
        *,
        framer: Framer,
        gps: GlobalPosition | None,
        send: Callable[[Any], None],
        gyro_delays: GyroDelays,
        fed: FedPosition | None = None,
    ) -> None:
        self._requests, self._contact, self._news = requests, contact, news
        self._gps, self._fed = gps, fed
        self.local_origin: Array | None = np.zeros(3) if gps is None else None
        """(3,) m: positions in the autopilot's local frame less those that it is read by; None: not known."""
        self._recorded, self._name = link.recording, str(link.address)
        self._send, self._gyro_delays = send, gyro_delays
        self.listener: AutopilotListener
        self.stamped = frozenset(
            {*RANKS, ATTITUDE_QUATERNION, ATTITUDE, ODOMETRY, LOCAL_POSITION_NED, GLOBAL_POSITION_INT}
        )
        self.readers = self._make_readers()

        self.clock_map = ClockMap()
        """Of the gyro's stamps."""
        self._pose_map = ClockMap()
        self._other_stamps = 0
        self.senders = SenderWatch()
        self.stamps = AutopilotStamps(self.senders, wrapped=self._wrapped, begun_again=self._begin_again)
        self.second_clock: float | None = None
        """How far apart [s] the clock is of a second autopilot that speaks under the same ID; None: there is none."""
        self._asked_time: dict[int, float] = {}
        self._copies_before = self._exchanges = 0
        self._next_timesync = -math.inf

        self.gyro = Intake("gyro samples")
        self.attitudes = Intake("attitudes")
        self.positions = Intake("positions")
        self._frame_loss = FrameLoss(framer, self.senders)
        self._poses_without_position = self._poses_fed = 0
        self._reboots = self._replaced = self._breaks_before = 0

        self.cadence = Cadence()
        self.imu_at = -math.inf  # when the last sample came
        self.imu_rate_hz = 0.0
        self.slow_gyro = False
        """Whether the gyro comes too seldom to be of use."""
        self._imu = ImuChoice(requests, contact, recorded=link.recording, changed=self._imu_changed)
        self._imu_t = self._imu_since = self._window_start = -math.inf
        self._window_count = 0

        self._pose_at = self._placed_at = -math.inf
        self._pose_from = ATTITUDE_QUATERNION
        self._quaternion_at = self._euler_at = self._local_at = -math.inf
        self._position: StampedPlace | None = None
        self._below: tuple[float, float] | None = None

    def _make_readers(self) -> dict[int, Callable[[float, Any], None]]:
        """By message."""
        readers: dict[int, Callable[[float, Any], None]] = {
            common.MAVLINK_MSG_ID_TIMESYNC: self._on_timesync,
            common.MAVLINK_MSG_ID_PARAM_VALUE: self._gyro_delays.on_value,
            HIGHRES_IMU: self._on_imu,
            RAW_IMU: self._on_imu,
            SCALED_IMU: self._on_imu,
            SCALED_IMU2: self._on_imu,
            SCALED_IMU3: self._on_imu,
            ATTITUDE_QUATERNION: self._on_quaternion,
            ATTITUDE: self._on_euler_angles,
            ODOMETRY: self._on_odometry,
            DISTANCE_SENSOR: self._on_distance,
        }
        if self._gps is None:
            readers[LOCAL_POSITION_NED] = self._on_local_position
        else:
            readers[GPS2_RAW] = self._gps.on_second_fix
            readers[GLOBAL_POSITION_INT] = self._on_global_position
            if self._fed is not None:
                readers[LOCAL_POSITION_NED] = self._learn_local_origin
        if self._gps is not None or self._fed is not None:
            readers[GPS_RAW_INT] = self._on_fix
        return readers

    @property
    def imu_source(self) -> ImuMessage:
        """The message that the samples come from."""
        return self._imu.source

    @property
    def gyro_delay(self) -> GyroDelay:
        """Delay of the samples that is compensated."""
        return self._gyro_delays.of(self.imu_source.id)

    @property
    def place(self) -> tuple[float, tuple[float, float, float]] | None:
        """Arrival of the newest position, and the position itself, NED [m], from the autopilot or its GPS; also of one
        that rests on ours: it is the one by which the autopilot flies."""
        if self._position is None:
            return None
        north, east, down = self._position.position.tolist()
        return self._placed_at, (north, east, down)

    def lack(self, now: float) -> str:
        """Why there is no position although a start by GPS needs one; empty otherwise."""
        return "" if self._gps is None else self._gps.lack(now)

    @property
    def intakes(self) -> tuple[Intake, ...]:
        return self.gyro, self.attitudes, self.positions

    @property
    def fault(self) -> str:
        """What is wrong with most of what came in the last window, in words; empty where most was used."""
        return next((intake.fault for intake in (self._frame_loss.intake, *self.intakes) if intake.fault), "")

    def has_no_place(self, now: float) -> bool:
        """Whether gyro samples come without a local position. A start by GPS says more, see `lack`."""
        return self._gps is None and now - max(self._placed_at, self._imu_since) > POSE_MISSED_S

    def has_no_pose(self, now: float) -> bool:
        """Whether gyro samples come without an attitude."""
        return now - max(self._pose_at, self._imu_since) > POSE_MISSED_S

    @property
    def counters(self) -> dict[str, float]:
        """All since the start."""
        clock_map, cadence, gyro_delay = self.clock_map, self.cadence, self.gyro_delay
        return {
            "imu_rate_hz": self.imu_rate_hz,
            "imu_samples": self.gyro.used,
            "imu_lost": cadence.lost,
            "gaps": cadence.gaps,
            "duplicates": cadence.repeated,
            "copies": self.stamps.copies,
            "out_of_step": sum(each.thrown[SECOND_CLOCK] for each in self.intakes),
            "invalid": sum(each.thrown[why] for each in self.intakes for why in (IMPOSSIBLE, OTHER_CLOCK))
            + self.gyro.spare[NOT_NEEDED]
            + self.attitudes.spare[NOT_NEEDED],
            "after_resync": self.gyro.thrown[STEPPED_BACK],
            "poses": self.attitudes.used,
            "poses_without_position": self._poses_without_position,
            **({} if self._fed is None else {"poses_fed": self._poses_fed}),
            "reboots": self._reboots,
            "clocks_replaced": self._replaced,
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

    def end(self, now: float) -> None:
        """A recording has ended: what its last window holds is judged if it is long enough."""
        if now - self._window_start >= 0.5 * IMU_RATE_WINDOW_S:
            self._judge(now)

    def measure(self, now: float) -> None:
        """Once per window: note the IMU's rate, and what was thrown away."""
        if now - self._window_start >= IMU_RATE_WINDOW_S:
            self._judge(now)

    def _judge(self, now: float) -> None:
        self.imu_rate_hz = self._window_count / (now - self._window_start)
        asked = math.inf if self._recorded else self._requests.imu_rate_hz
        enough = GYRO_RATE_SHARE * min(SLOWEST_USEFUL_GYRO_HZ, asked)
        self.slow_gyro = 0.0 < self.imu_rate_hz < enough and self._imu_since <= self._window_start
        self._window_start = now
        self._window_count = 0
        if self._imu.rank is not None:
            self._gyro_delays.log_delay(self.imu_source.id)
        copies, self._copies_before = self.stamps.copies - self._copies_before, self.stamps.copies
        if copies >= COPIES_SAID:
            text = (
                "%s: messages of autopilot %s come again by a second way, %d in %g s: the copies are dropped"
            )
            self._news.warn("copies", text, self._name, self._who, copies, IMU_RATE_WINDOW_S)
        for intake in self.intakes:
            intake.judge()
        self._frame_loss.judge()
        shared = [
            clock
            for intake, clock in self._stamped()
            if clock.is_shared and intake.shares.get(SECOND_CLOCK, 0.0) >= SECOND_CLOCK_SHARE
        ]
        self.second_clock = shared[0].apart if shared else None

    # ── gyro ─────────────────────────────────────────────────────────────────────────────────────────────────────

    def _on_imu(self, t: float, m: Any) -> None:
        source = IMU_MESSAGES[RANKS[m.get_msgId()]]
        if source.numbered and not self._imu.is_sensor(t, source.id, m.id):
            self.gyro.pass_over(OTHER_SENSOR)
            return
        step, stamp = self.stamps.step(t, m, source.stamp(m), source.wrap_s)
        self._take_rates(t, m, step, stamp)

    def _take_rates(self, t: float, m: Any, step: StampStep | None, stamp: float) -> None:
        """step: of the stamp, None: a copy."""
        rank = RANKS[m.get_msgId()]
        source = IMU_MESSAGES[rank]
        gyro, accel = source.read(m)
        # NaN fails this too.
        x, y, z = gyro
        is_possible = (
            abs(x) < FASTEST_GYRO_RAD_S and abs(y) < FASTEST_GYRO_RAD_S and abs(z) < FASTEST_GYRO_RAD_S
        )
        if not is_possible and source is self._requests.imu:
            self._requests.useless(source.id)
        if step is None and rank == self._imu.rank and stamp == self.cadence.newest:
            self.cadence.observe(stamp)
        if step is None:
            return
        if not self._imu.is_source(t, rank, step, is_possible=is_possible):
            if source.id not in ATTITUDE_MESSAGES:
                better = f"{source.name}: a better message is used"
                self.gyro.pass_over(better if is_possible else NOT_NEEDED)
            return
        if step is StampStep.OTHER:
            self.gyro.throw(SECOND_CLOCK)
            return
        if not is_possible:
            self.gyro.throw(IMPOSSIBLE)
            return
        if not self.cadence.observe(stamp, is_whole=self._is_whole(t)):
            self.gyro.throw(STANDING_CLOCK)
            return
        self._observe_clock(stamp, t)
        if t - self.imu_at > IMU_FORGOTTEN_AFTER_S:
            self.imu_rate_hz, self._window_start, self._window_count = 0.0, t, 0
            self._imu_since = t
        self.imu_at = t
        self._window_count += 1
        delay = self._gyro_delays.of(source.id).seconds
        ours = self.clock_map.to_ours(stamp) - delay
        if ours <= self._imu_t:
            # A correction back in time, or a gyro that turns out to be later: wait until it is made up for.
            self.gyro.throw(STEPPED_BACK)
            return
        self._imu_t = ours
        self.gyro.used += 1
        accel = accel if all(map(math.isfinite, accel)) else NOT_MEASURED
        self.listener.on_imu(ImuSample(ours, np.array(gyro), np.array(accel), delay))

    def _is_whole(self, t: float) -> bool:
        """Whether no number of a frame is missing since the last sample. Across a longer gap they may have begun again,
        and a recording has none."""
        before, self._breaks_before = self._breaks_before, self.senders.breaks
        return self.senders.came > 0 and before == self.senders.breaks and t - self.imu_at < NUMBERED_GAP_S

    def _imu_changed(self) -> None:
        self._news.warn("imu source", "%s: IMU now from %s", self._name, self.imu_source.name)
        self.cadence.reset()

    # ── pose ─────────────────────────────────────────────────────────────────────────────────────────────────────

    def _on_global_position(self, t: float, m: Any) -> None:
        assert self._gps is not None
        step, stamp = self._position_step(t, m)
        if step in (None, StampStep.OTHER):
            return
        # It flies by one that rests on ours without a fix, too.
        rests = self._fed is not None and self._fed.rests(t)
        place = self._gps.stated(t, m) if rests else self._gps.place(t, m)
        if place is not None:
            self._take_place(t, step, StampedPlace(stamp, *place))
        elif step in NEW_STAMPS:
            self.positions.pass_over(NO_FIX)

    def _on_fix(self, t: float, m: Any) -> None:
        for each in (self._gps, self._fed):
            if each is not None:
                each.on_fix(t, m)

    def _learn_local_origin(self, t: float, m: Any) -> None:
        """Of a drone whose positions are GPS's: where its autopilot's local frame begins in that."""
        step, stamp = self.stamps.step(t, m, m.time_boot_ms * 1e-3, MILLISECONDS_WRAP_S)
        gps, fed = self._position, self._fed
        if step not in NEW_STAMPS or gps is None or fed is None or fed.rests(t):
            return
        local = np.array((m.x, m.y, m.z))
        if abs(stamp - gps.stamp) <= LOCAL_ORIGIN_GAP_S and np.isfinite(local).all():
            self.local_origin = local - gps.position - (stamp - gps.stamp) * gps.velocity

    def _on_local_position(self, t: float, m: Any) -> None:
        step, stamp = self._position_step(t, m)
        place = StampedPlace(stamp, np.array((m.x, m.y, m.z)), np.array((m.vx, m.vy, m.vz)))
        if self._take_local_place(t, step, place):
            self._local_at = t

    def _take_local_place(self, t: float, step: StampStep | None, place: StampedPlace) -> bool:
        """Whether it is new and possible."""
        numbers = (*place.position.tolist(), *place.velocity.tolist())
        # NaN compares as False.
        is_possible = all(abs(number) < DIVERGED_LOCAL_POSE for number in numbers)
        if is_possible:
            self._take_place(t, step, place)
        elif step in NEW_STAMPS:
            self.positions.throw(IMPOSSIBLE)
        return is_possible and step in NEW_STAMPS

    def _position_step(self, t: float, m: Any) -> tuple[StampStep | None, float]:
        step, stamp = self.stamps.step(t, m, m.time_boot_ms * 1e-3, MILLISECONDS_WRAP_S)
        self._throw_old(self.positions, step)
        return step, stamp

    def _take_place(self, t: float, step: StampStep | None, place: StampedPlace) -> None:
        if step not in (None, StampStep.OTHER):
            self.senders.compare(t, places_apart, place, places_apart)
        if step in NEW_STAMPS:
            self.positions.used += 1
            self._position, self._placed_at = place, t

    def _on_quaternion(self, t: float, m: Any) -> None:
        attitude = _from_quaternion((m.q1, m.q2, m.q3, m.q4))
        if attitude is None:
            self._requests.useless(ATTITUDE_QUATERNION)
        step, stamp = self._attitude_step(t, m, attitude)
        if step in NEW_STAMPS:
            if attitude is not None:
                self._quaternion_at = t
            self._take_attitude(t, stamp, attitude, ATTITUDE_QUATERNION)

    def _on_euler_angles(self, t: float, m: Any) -> None:
        angles = m.roll, m.pitch, m.yaw
        is_possible = all(map(math.isfinite, angles))
        if not is_possible:
            self._requests.useless(ATTITUDE)
        is_spare = t - self._quaternion_at <= QUATERNION_PREFERRED_S
        attitude = from_euler(*angles) if is_possible and not is_spare else None
        step, stamp = self._attitude_step(t, m, attitude)
        if step not in NEW_STAMPS:
            return
        if is_spare:
            self.attitudes.pass_over("ATTITUDE: a better message is used")
            return
        if attitude is not None:
            self._euler_at = t
        self._take_attitude(t, stamp, attitude, ATTITUDE)

    def _on_odometry(self, t: float, m: Any) -> None:
        """Attitude and local position in one message: each is used where it does not come by a message of its own."""
        if m.frame_id != common.MAV_FRAME_LOCAL_NED or m.child_frame_id not in BODY_FRAMES:
            return
        step, stamp = self.stamps.step(t, m, m.time_usec * 1e-6, MICROSECONDS_WRAP_S)
        attitude = _from_quaternion(m.q)
        if self._gps is None and attitude is not None and t - self._local_at > QUATERNION_PREFERRED_S:
            self._throw_old(self.positions, step)
            position, velocity = np.array((m.x, m.y, m.z)), attitude @ (m.vx, m.vy, m.vz)
            self._take_local_place(t, step, StampedPlace(stamp, position, velocity))
        is_spare = t - max(self._quaternion_at, self._euler_at) <= QUATERNION_PREFERRED_S
        if not is_spare:
            self._throw_old(self.attitudes, step)
        if step not in NEW_STAMPS:
            return
        if is_spare:
            self.attitudes.pass_over("ODOMETRY: a better message is used")
            return
        self._take_attitude(t, stamp, attitude, ODOMETRY)

    def _attitude_step(self, t: float, m: Any, attitude: Array | None) -> tuple[StampStep | None, float]:
        """What its stamp is, see `AutopilotStamps.step`; its rates are taken."""
        message_id = m.get_msgId()
        step, stamp = self.stamps.step(t, m, m.time_boot_ms * 1e-3, MILLISECONDS_WRAP_S)
        self._take_rates(t, m, step, stamp)
        if attitude is not None and step not in (None, StampStep.OTHER):
            said = StampedAttitude(stamp, attitude, math.hypot(m.rollspeed, m.pitchspeed, m.yawspeed))
            self.senders.compare(t, (attitudes_apart, message_id), said, attitudes_apart)
        if message_id == ATTITUDE_QUATERNION or t - self._quaternion_at > QUATERNION_PREFERRED_S:
            self._throw_old(self.attitudes, step)
        return step, stamp

    def _throw_old(self, intake: Intake, step: StampStep | None) -> None:
        if step is StampStep.OTHER:
            intake.throw(SECOND_CLOCK)
        elif step is StampStep.SAME:
            intake.throw(STANDING_CLOCK)

    def _take_attitude(self, t: float, stamp: float, attitude: Array | None, message_id: int) -> None:
        """attitude: (3, 3) world_from_body; None: none that is possible."""
        clock_map = self._map_of_poses(stamp, t)
        if clock_map is self.clock_map and (clock_map.offset is None or t - self.imu_at > IMU_STALE_AFTER_S):
            self._observe_clock(stamp, t)  # without an IMU, this is what tells the autopilot's time
        if attitude is None:
            self._refuse_attitude(t, message_id)
            return
        if clock_map is None:
            self.attitudes.throw(OTHER_CLOCK)
            return
        ours = clock_map.to_ours(stamp)
        rests = self._fed is not None and self._fed.rests(t)
        self._poses_fed += rests
        if rests or self._position is None or abs(stamp - self._position.stamp) > LOCAL_POSITION_AGE_S:
            self._poses_without_position += 1
            where = None
        else:
            at, position, velocity = self._position
            where = position + (stamp - at) * velocity
        self._pose_at, self._pose_from = t, message_id
        self.attitudes.used += 1
        gps = self._gps
        sigma, vertical = (LOCAL_POSITION_SIGMA_M, None) if gps is None else (gps.sigma, gps.vertical_sigma)
        ground = self._ground(t, float(attitude[2, 2]))
        self.listener.on_pose(
            EgoPose(
                ours,
                where,
                attitude,
                position_sigma=sigma,
                vertical_sigma=vertical,
                ground=ground,
                t_sigma=clock_map.sigma,
            )
        )

    def _refuse_attitude(self, t: float, message_id: int) -> None:
        """Its values are impossible: no fault where another message brings the attitude."""
        if self._pose_from == message_id or t - self._pose_at > QUATERNION_PREFERRED_S:
            self.attitudes.throw(IMPOSSIBLE)
            return
        self.attitudes.pass_over(NOT_NEEDED)
        text = "%s: the attitude is that of %s, for %s has impossible values"
        used, refused = (str(common.mavlink_map[each].msgname) for each in (self._pose_from, message_id))
        self._news.warn(f"useless {refused}", text, self._name, used, refused)

    def _map_of_poses(self, stamp: float, t: float) -> ClockMap | None:
        """Of the time base of an attitude's stamp [s] that came at t: that of the gyro. In a log, which nobody can
        mend, one of its own where milliseconds count from another instant than microseconds. None: not known."""
        gyro = self.clock_map
        if gyro.offset is None or abs(gyro.to_ours(stamp) - t) <= POSE_CLOCK_MISMATCH_S:
            self._other_stamps = 0
            return gyro
        if not self._recorded:
            return None
        self._other_stamps += 1
        self._pose_map.observe(stamp, t)
        agrees = abs(self._pose_map.to_ours(stamp) - t) <= POSE_CLOCK_MISMATCH_S
        return self._pose_map if agrees and self._other_stamps >= OTHER_BASE_STAMPS else None

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

    # ── stamps ───────────────────────────────────────────────────────────────────────────────────────────────────

    def _wrapped(self) -> None:
        text = "%s: the 32-bit clock of autopilot %s begins again from 0, and is followed"
        self._news.warn("wrap", text, self._name, self._who)

    @property
    def _who(self) -> object:
        return self._contact.system

    def _stamped(self) -> Iterator[tuple[Intake, BootClock]]:
        """By which messages each thing came."""
        kinds = (
            (self.gyro, (self.imu_source.id,)),
            (self.attitudes, (ATTITUDE_QUATERNION, ATTITUDE, ODOMETRY)),
            (self.positions, (LOCAL_POSITION_NED, GLOBAL_POSITION_INT, ODOMETRY)),
        )
        for intake, message_ids in kinds:
            for message_id in message_ids:
                if (clock := self.stamps.clock(message_id)) is not None:
                    yield intake, clock

    def _begin_again(self, step: StampStep, stamp: float, apart: float) -> None:
        """The autopilot's clock is another one from now on."""
        if step is StampStep.REBOOT:
            self._reboots += 1
            self._news.warn(
                "reboot", "%s: autopilot %s has rebooted (its clock: %.1f s)", self._name, self._who, stamp
            )
        else:
            self._replaced += 1
            self._news.warn(
                "replaced",
                "%s: the clock of autopilot %s goes on %+.1f s from where it was, without a reboot: a simulator that "
                "was started again, or another vehicle?",
                self._name,
                self._who,
                apart,
            )
        self.clock_map.reset()
        self._pose_map.reset()
        self._other_stamps = 0
        self.cadence.reset()
        self._position = self._below = None
        if self._fed is not None:
            self._fed.restart()
        if self._gps is not None:
            self.local_origin = None
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


def _from_quaternion(numbers: Sequence[float]) -> Array | None:
    """(3, 3) world_from_body of w, x, y, z as sent; None where they are none."""
    q = np.array(numbers)
    return from_quaternion(q) if 0.9 < float(q @ q) < 1.1 else None
