"""A small autopilot with PX4's manners: it streams unasked, at rates that follow its integration of the IMU.

PX4's sender looks now and then, and when a message's interval is over it sends the newest sample there is. An interval
of integration is a whole number of its gyro's: IMU_INTEG_RATE = 250 of 800 Hz makes samples of 3.75 ms. Asked for 250
Hz, steps of 3.75 and 7.5 ms come, by no rule, as its sender looks when it gets its turn. In lockstep with a simulator,
where time itself moves by 4 ms, all steps of 200 Hz are of 8 ms: 124 Hz were measured. Every rate is accepted; none is
higher than that of the samples.
"""

from __future__ import annotations

import math
import zlib
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.lab.autopilots.autopilot import SimulatedVehicle
from swarmtrack.lab.autopilots.channel import Channel
from swarmtrack.lab.autopilots.external_position import px4_takes
from swarmtrack.lab.autopilots.firmware import PX4_FIRMWARE
from swarmtrack.lab.autopilots.reports import SENSED
from swarmtrack.mavlink_dialect import CURRENT_MODE

GYRO_HZ = 800  # of its sensor
LOOKS_EVERY_US = 1000  # main loop of a fast link
LOOKS_LATE_US = 700  # at most: the loop waits for its turn of the processor
EARLY = 0.3  # of the main loop: as much too early is on time
LATE_INTERVALS = 1.5  # intervals: who is later starts again, who is not keeps to the grid
PX4_RATE_PARAMETER = "IMU_INTEG_RATE"
LOCKSTEP_HZ = 250  # IMU_INTEG_RATE in PX4's own simulators, and how often time moves there
# Hz, of messages that come unasked, per port: the companion's, a ground station's, and that for the truth.
DEFAULTS: tuple[dict[int, float], ...] = (
    {
        common.MAVLINK_MSG_ID_HIGHRES_IMU: 50.0,
        common.MAVLINK_MSG_ID_ATTITUDE: 100.0,
        common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
        common.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30.0,
        common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 50.0,
        common.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
        common.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
        CURRENT_MODE: 0.5,
    },
    {
        common.MAVLINK_MSG_ID_ATTITUDE: 20.0,
        common.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 1.0,
        common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5.0,
        common.MAVLINK_MSG_ID_GPS_RAW_INT: 1.0,
        common.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 1.0,
        CURRENT_MODE: 0.5,
    },
    {},
)


class NewestReports:
    """The stream of a message, as PX4's `MavlinkStream::update` sends it.

    interval_us: as asked; sample_us: from sample to sample; look_us: from look to look of the sender; late_us: by which
    it looks late at most. All on the autopilot's own clock, in whole µs as PX4 has them.
    """

    def __init__(
        self, interval_us: int, sample_us: int, look_us: int, stamp: float, *, late_us: int = 0
    ) -> None:
        self._interval = interval_us
        self._sample = sample_us
        self._look = look_us
        self._late = late_us
        self.skip_to(stamp)

    def skip_to(self, stamp: float) -> None:
        now = round(stamp * 1e6)
        self._last = now // self._look * self._look
        self._newest = now // self._sample * self._sample
        self._plan()

    @property
    def due(self) -> float:
        return self._due * 1e-6

    @property
    def sampled(self) -> float:
        return self._due // self._sample * self._sample * 1e-6

    def advance(self) -> None:
        passed = self._due - self._last
        self._newest = self._due // self._sample * self._sample
        self._last = self._last + self._interval if passed < LATE_INTERVALS * self._interval else self._due
        self._plan()

    def _plan(self) -> None:
        """The first look at which the interval is over and there is a sample that was not sent."""
        over = self._last + self._interval - EARLY * LOOKS_EVERY_US
        look = math.floor(over / self._look) + 1
        fresh = -(-(self._newest + self._sample) // self._look)
        look = max(look, fresh)
        # All streams are served by one loop, so each look is late for all of them.
        late = zlib.crc32(look.to_bytes(8, "little")) % self._late if self._late else 0
        self._due = look * self._look + late


class SimulatedPx4(SimulatedVehicle):
    """A PX4 multicopter. lockstep: its time moves from sample to sample, as in its own simulators."""

    firmware = PX4_FIRMWARE
    offers = (
        common.MAVLINK_MSG_ID_HIGHRES_IMU,
        *SENSED,
        common.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        common.MAVLINK_MSG_ID_RC_CHANNELS,
        CURRENT_MODE,
        common.MAVLINK_MSG_ID_HIL_STATE_QUATERNION,
    )

    def __init__(self, *arguments: Any, lockstep: bool = False, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._lockstep = lockstep
        if lockstep:
            self.parameters.values[PX4_RATE_PARAMETER] = LOCKSTEP_HZ
        self._begin(0.0)

    def reboot(self, now: float) -> None:
        super().reboot(now)
        self._begin(0.0)

    def takes_odometry(self, message: Any) -> bool:
        return px4_takes(message, self.parameters.values)

    def _begin(self, stamp: float) -> None:
        for channel, defaults in zip(self.channels, DEFAULTS, strict=False):
            for message_id, hz in defaults.items():
                if message_id in self.offered:
                    self._stream(message_id, 1e6 / hz, stamp, channel)

    def grant(self, message_id: int, interval_us: float, stamp: float, channel: Channel) -> int:
        """Everything, if not as fast. A stream's default is 0, and not to be sent if it has none."""
        channel.streams.pop(message_id, None)
        defaults = DEFAULTS[self.channels.index(channel)]
        if interval_us == 0.0 and message_id in defaults:
            interval_us = 1e6 / defaults[message_id]
        if interval_us > 0.0:
            self._stream(message_id, interval_us, stamp, channel)
        return int(common.MAV_RESULT_ACCEPTED)

    def _stream(self, message_id: int, interval_us: float, stamp: float, channel: Channel) -> None:
        rate = self.parameters.values[PX4_RATE_PARAMETER]
        sample = round(1e6 / rate) if self._lockstep else round(1e6 * integration_s(rate))
        look, late = (sample, 0) if self._lockstep else (LOOKS_EVERY_US, LOOKS_LATE_US)
        channel.streams[message_id] = NewestReports(round(interval_us), sample, look, stamp, late_us=late)


def integration_s(rate_hz: float) -> float:
    """s of an interval of integration that is asked for as a rate: whole samples of the gyro, at least one."""
    return max(math.floor(GYRO_HZ / rate_hz), 1) / GYRO_HZ
