"""What an autopilot's simulator says is true, made into poses in the world frame, stamped on our clock.

ArduPilot's SITL has SIM_STATE: the quaternion, and where on the Earth in 1e-7 degrees and metres above the sea. It has
no stamp. TRUTH_ATTITUDE_QUATERNION, asked for at the same interval, is sent in the same turn of the main loop; its
stamp counts for both, where the two arrive together. Where they do not, the time of arrival does. PX4's simulators have
HIL_STATE_QUATERNION. It has a field for a stamp, which PX4 leaves at 0: a stamp that has never moved is none, and the
message is dated as SIM_STATE is. Stamps come to our clock by a `ClockMap`; those of a clock that does not keep time are
given up, and arrivals count.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.clock_map import ClockMap
from swarmtrack.geometry import rotation
from swarmtrack.geometry.geodesy import Geodetic, to_ned
from swarmtrack.geometry.pose import Pose

SIM_STATE = common.MAVLINK_MSG_ID_SIM_STATE
TRUTH_ATTITUDE_QUATERNION = common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
HIL_STATE_QUATERNION = common.MAVLINK_MSG_ID_HIL_STATE_QUATERNION
# By kind of autopilot (MAV_AUTOPILOT): what to ask of its simulator.
TRUTH_MESSAGES: dict[int, tuple[int, ...]] = {
    common.MAV_AUTOPILOT_ARDUPILOTMEGA: (SIM_STATE, TRUTH_ATTITUDE_QUATERNION),
    common.MAV_AUTOPILOT_PX4: (HIL_STATE_QUATERNION, TRUTH_ATTITUDE_QUATERNION),
}
TOGETHER = 0.005  # s between arrivals that belong to one turn of the main loop, of at least 400 Hz
STAMPLESS = 1.0  # s without a stamp: none is waited for
# A clock that stood still, or runs slow, makes every message late by this much for this long: learn it anew.
TRUTH_LATE_S, TRUTH_LATE_LASTS_S = 0.02, 0.25  # s
# Twice within this time: the clock does not keep time (PX4 in lockstep runs per cent slow), and arrivals are better.
UNSTEADY_S = 5.0
REBOOTED = 1.0  # s by which a stamp must fall back


class TrueSample(NamedTuple):
    """t: on our clock [s]; pose: world_from_body; place: the same on the Earth."""

    t: float
    pose: Pose
    place: Geodetic


class TruthReader:
    """Takes the messages of one autopilot in the order of their arrival. origin: of the world frame.

    restarts: how often its clock had to be learned anew, after a reboot or a pause.
    """

    def __init__(self, origin: Geodetic) -> None:
        self.restarts = 0
        self.refused: tuple[float, str] | None = None
        """When the newest message with truth came, and why it is of no use; None where it is."""
        self._origin = origin
        self._clock_map = ClockMap()
        self._stamp = -math.inf
        self._stamp_arrival = -math.inf
        self._stamp_used = True
        self._on_time = -math.inf
        self._restarted = -math.inf
        self._by_arrival = False
        self._pending: tuple[float, Any] | None = None
        self._hil_stamp = math.inf
        self._hil_is_stamped = False

    def read(self, message: Any, arrival: float) -> list[TrueSample]:
        """What the message says, or lets be said of an earlier one; arrival: on our clock [s]."""
        match message.get_msgId():
            case common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION if not self._hil_is_stamped:
                return self._on_stamp(message.time_boot_ms * 1e-3, arrival)
            case common.MAVLINK_MSG_ID_SIM_STATE:
                return self._on_state(message, arrival)
            case common.MAVLINK_MSG_ID_HIL_STATE_QUATERNION:
                return self._on_hil(message, message.time_usec * 1e-6, arrival)
        return []

    def _on_hil(self, state: Any, stamp: float, arrival: float) -> list[TrueSample]:
        moved, self._hil_stamp = stamp > self._hil_stamp, stamp
        if moved and not self._hil_is_stamped:
            self._hil_is_stamped = True
            # What ATTITUDE_QUATERNION said meanwhile may be of another clock.
            self._clock_map.reset()
            self._stamp = -math.inf
        if not self._hil_is_stamped:
            return self._on_state(state, arrival)
        if self._learn(stamp, arrival):
            return self._dated(state, self._our_time(arrival), arrival)
        self.refused = arrival, f"its stamp stands still at {stamp:.3f} s"
        return []

    def _on_stamp(self, stamp: float, arrival: float) -> list[TrueSample]:
        self._stamp_used = not self._learn(stamp, arrival)
        self._stamp_arrival = arrival
        if self._pending is None:
            return []
        arrived, state = self._pending
        if self._stamp_used or arrival - arrived > TOGETHER:
            return self._dated(state, arrived, arrived)
        return self._dated(state, self._our_time(arrived), arrived)

    def _on_state(self, state: Any, arrival: float) -> list[TrueSample]:
        said = []
        if self._pending is not None:
            arrived, earlier = self._pending
            said = self._dated(earlier, arrived, arrived)
        if not self._stamp_used and arrival - self._stamp_arrival <= TOGETHER:
            said += self._dated(state, self._our_time(arrival), arrival)
        elif arrival - self._stamp_arrival > STAMPLESS:
            said += self._dated(state, arrival, arrival)
        else:
            self._pending = (arrival, state)
        return said

    def _learn(self, stamp: float, arrival: float) -> bool:
        """Take note of a stamp; False where it is not newer than the last one."""
        if self._stamp - REBOOTED < stamp <= self._stamp:
            return False
        if stamp < self._stamp:
            self._restart()
            self._by_arrival = False
        self._stamp = stamp
        self._clock_map.observe(stamp, arrival)
        if arrival - self._clock_map.to_ours(stamp) < TRUTH_LATE_S:
            self._on_time = arrival
        elif arrival - self._on_time > TRUTH_LATE_LASTS_S:
            self._restart()
            self._clock_map.observe(stamp, arrival)
            self._by_arrival |= arrival - self._restarted < UNSTEADY_S
            self._on_time = self._restarted = arrival
        return True

    def _restart(self) -> None:
        self._clock_map.reset()
        self.restarts += 1

    def _our_time(self, arrival: float) -> float:
        """Of the newest stamp, whose message, or the one that it counts for, came at `arrival`."""
        self._stamp_used = True
        return arrival if self._by_arrival else self._clock_map.to_ours(self._stamp)

    def _dated(self, state: Any, t: float, arrival: float) -> list[TrueSample]:
        """The sample that a state says, true at t. None where a number is no number: bits may fall."""
        self._pending = None
        q, latitude_deg, longitude_deg, height_m = (
            _of_hil(state) if state.get_msgId() == HIL_STATE_QUATERNION else _of_sim_state(state)
        )
        if not (
            all(map(math.isfinite, (*q, latitude_deg, longitude_deg, height_m)))
            and 0.9 < math.hypot(*q) < 1.1
            and abs(latitude_deg) <= 90.0
        ):
            self.refused = arrival, "its attitude or its position is no number"
            return []
        self.refused = None
        place = Geodetic.from_degrees(latitude_deg, longitude_deg, height_m)
        return [TrueSample(t, Pose(rotation.from_quaternion(q), to_ned(place, self._origin)), place)]


def _of_sim_state(state: Any) -> tuple[tuple[float, ...], float, float, float]:
    """Quaternion, latitude [deg], longitude [deg], height [m]."""
    # The whole numbers are an extension; as floats, degrees are known to a metre only.
    latitude, longitude = (
        (1e-7 * state.lat_int, 1e-7 * state.lon_int)
        if state.lat_int or state.lon_int
        else (state.lat, state.lon)
    )
    return (state.q1, state.q2, state.q3, state.q4), latitude, longitude, state.alt


def _of_hil(state: Any) -> tuple[tuple[float, ...], float, float, float]:
    """The same of HIL_STATE_QUATERNION."""
    return tuple(state.attitude_quaternion), 1e-7 * state.lat, 1e-7 * state.lon, 1e-3 * state.alt
