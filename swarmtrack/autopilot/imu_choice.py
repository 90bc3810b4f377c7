"""Which message the gyro samples come from, and of several sensors which one: the best of what is coming."""

from __future__ import annotations

import math
from collections.abc import Callable

from swarmtrack.autopilot.boot_clock import StampStep
from swarmtrack.autopilot.contact import Contact
from swarmtrack.autopilot.limits import IMU_PREFERRED_S
from swarmtrack.autopilot.streams import ATTITUDE_MESSAGES, IMU_MESSAGES, ImuMessage, StreamRequests


class ImuChoice:
    """Prefers messages by their rank, their place in IMU_MESSAGES. rank: of the one in use, None before the first.

    recorded: nothing is asked for; changed: called where another message than before comes into use.
    """

    def __init__(
        self, requests: StreamRequests, contact: Contact, *, recorded: bool, changed: Callable[[], None]
    ) -> None:
        self.rank: int | None = None
        self._requests = requests
        self._contact = contact
        self._recorded = recorded
        self._changed = changed
        self._seen = [-math.inf] * len(IMU_MESSAGES)
        self._sensors: dict[int, dict[int, float]] = {}
        """By message, when each number of a sensor was heard."""

    @property
    def source(self) -> ImuMessage:
        """The message in use; before the first, the best one."""
        return IMU_MESSAGES[self.rank or 0]

    def is_sensor(self, t: float, message_id: int, number: int) -> bool:
        """Whether this sensor is the first of those that HIGHRES_IMU or RAW_IMU comes from, by turns."""
        heard = self._sensors.setdefault(message_id, {})
        heard[number] = t
        if number == 0:
            return True
        lower = max((at for other, at in heard.items() if other < number), default=self._contact.known_at)
        return t - lower >= IMU_PREFERRED_S

    def is_source(self, t: float, rank: int, step: StampStep, *, is_possible: bool = True) -> bool:
        """Whether this kind of message is the one to integrate: the best that is coming with possible values."""
        if step is not StampStep.OTHER and is_possible:
            self._seen[rank] = t
        better = max(self._seen[:rank], default=-math.inf)
        asked = self._requests.imu is IMU_MESSAGES[rank]
        # A better one may just have been asked for; or follow, in a log that begins with an attitude.
        lesser = IMU_MESSAGES[rank].id in ATTITUDE_MESSAGES if self._recorded else rank > 0
        waits = lesser and not asked
        if t - better < IMU_PREFERRED_S or (waits and t - self._contact.known_at < IMU_PREFERRED_S):
            return False
        if step is StampStep.OTHER:
            return rank == self.rank
        if not is_possible:
            return self.rank in (None, rank)
        if rank != self.rank:
            is_first, self.rank = self.rank is None, rank
            if not is_first:
                self._changed()
        return True
