"""Delay of an autopilot's gyro: assumed by its kind, until the autopilot's own parameters are known.

ArduPilot sends its gyro after INS_GYRO_FILTER, a two-pole Butterworth low-pass. It delays motion far below the corner
f by √2/(2πf), 11 ms at 20 Hz. PX4 sends the mean over one interval of integration, stamped at its end, which delays by
half of 1/IMU_INTEG_RATE; the rates next to its attitude have passed IMU_GYRO_CUTOFF, another two poles. An attitude is
the estimator's, which integrates every sample: it has no delay, and is left alone.

A parameter is requested by PARAM_REQUEST_READ, once for each start of the autopilot. Nothing is ever written.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.candidates import AutopilotAddress
from swarmtrack.autopilot.limits import (
    GYRO_DELAY_LONGEST_S,
    GYRO_DELAY_TOLD_SIGMA_S,
    GYRO_DELAY_UNKNOWN_SIGMA_S,
    PARAMETER_REQUEST_PERIOD_S,
    PARAMETER_REQUESTS,
)
from swarmtrack.autopilot.parameters import ParameterReader
from swarmtrack.autopilot.streams import ATTITUDE_MESSAGES

log = logging.getLogger(__package__)


class GyroDelay(NamedTuple):
    """Delay of a gyro: `seconds`, with sigma [s]; cause: its source, for people."""

    seconds: float
    sigma: float
    cause: str

    def __str__(self) -> str:
        return f"{1e3 * self.seconds:.1f} ± {1e3 * self.sigma:.1f} ms"


def low_pass_delay(cutoff_hz: float) -> float:
    """Group delay [s] of a two-pole Butterworth low-pass far below its corner; a corner of 0 Hz is no filter.

    Of H(s) = ω²/(s² + √2 ω s + ω²) the phase falls by √2/ω at zero frequency.
    """
    return math.sqrt(2.0) / (2.0 * math.pi * cutoff_hz) if cutoff_hz else 0.0


def mean_delay(rate_hz: float) -> float:
    """Delay [s] of a mean over one interval of the rate, stamped at its end."""
    return 0.5 / rate_hz if rate_hz else math.inf


@dataclass(frozen=True, slots=True)
class DelayParameter:
    """An autopilot's parameter that sets its gyro's delay.

    delay: s, of the value in Hz; usual_hz: the default; usual_sigma: spread of the delays [s] over customised values.
    """

    name: str
    delay: Callable[[float], float]
    usual_hz: float
    usual_sigma: float


INS_GYRO_FILTER = DelayParameter("INS_GYRO_FILTER", low_pass_delay, 20.0, 4e-3)
IMU_INTEG_RATE = DelayParameter("IMU_INTEG_RATE", mean_delay, 200.0, 2e-3)
IMU_GYRO_CUTOFF = DelayParameter("IMU_GYRO_CUTOFF", low_pass_delay, 40.0, 3e-3)


class _Kind(NamedTuple):
    """of_imu, of_rates: what delays the samples, and the rates next to an attitude."""

    of_imu: DelayParameter
    of_rates: DelayParameter


DELAY_PARAMETERS: dict[int, _Kind] = {
    common.MAV_AUTOPILOT_ARDUPILOTMEGA: _Kind(INS_GYRO_FILTER, INS_GYRO_FILTER),
    common.MAV_AUTOPILOT_PX4: _Kind(IMU_INTEG_RATE, IMU_GYRO_CUTOFF),
}


def _names_of(kind: int) -> tuple[str, ...]:
    return tuple(parameter.name for parameter in DELAY_PARAMETERS.get(kind, ()))


class GyroDelays:
    """Asks one autopilot for its gyro's delay, and logs it.

    told_s: configured by the user; then nothing is requested. asks: False on a link that cannot send. name: of the
    link, for the log.
    """

    def __init__(self, told_s: float | None, *, asks: bool, name: str) -> None:
        self._told_s = told_s
        self._reader = ParameterReader(
            _names_of,
            asks=asks and told_s is None,
            every_s=PARAMETER_REQUEST_PERIOD_S,
            attempts=PARAMETER_REQUESTS,
        )
        self._name = name
        self._said: GyroDelay | None = None
        self._of_imu = self._of_rates = self._judge(None)

    def meet(self, autopilot: int) -> None:
        """The autopilot's first heartbeat has come, with its MAV_AUTOPILOT."""
        self._reader.meet(autopilot)
        self._settle()

    def restart(self) -> None:
        """The autopilot has restarted, perhaps with another filter: request again; meanwhile the earlier value
        holds.
        """
        self._reader.restart()

    def tick(self, now: float, target: AutopilotAddress) -> list[Any]:
        """Requests to send now."""
        return self._reader.tick(now, target)

    def on_value(self, t: float, m: Any) -> None:
        """PARAM_VALUE has come, whichever process asked for it."""
        self._reader.on_value(t, m)
        self._settle()

    def of(self, message_id: int) -> GyroDelay:
        """Delay of the angular velocity in this message."""
        return self._of_rates if message_id in ATTITUDE_MESSAGES else self._of_imu

    def log_delay(self, message_id: int) -> None:
        """Log the gyro's assumed delay, once and on change; not while an answer is due."""
        delay = self.of(message_id)
        if self._reader.waits or delay == self._said:
            return
        self._said = delay
        log.info("%s: gyro taken to be %s late: %s", self._name, delay, delay.cause)

    @property
    def _parameters(self) -> tuple[DelayParameter, ...]:
        kind = self._reader.kind
        return () if kind is None else tuple(DELAY_PARAMETERS.get(kind, ()))

    def _settle(self) -> None:
        self._of_imu, self._of_rates = map(self._judge, self._parameters or (None, None))

    def _judge(self, parameter: DelayParameter | None) -> GyroDelay:
        if self._told_s is not None:
            return GyroDelay(self._told_s, 0.0, "motion.gyro_delay_s")
        if parameter is None:
            return GyroDelay(0.0, GYRO_DELAY_UNKNOWN_SIGMA_S, "the filter of this autopilot is unknown")
        value = self._reader.values.get(parameter.name)
        if value is not None and 0.0 <= parameter.delay(value) <= GYRO_DELAY_LONGEST_S:  # NaN is not
            return GyroDelay(
                parameter.delay(value), GYRO_DELAY_TOLD_SIGMA_S, f"{parameter.name} is {value:g} Hz"
            )
        found = "was not reported" if value is None else f"was reported as {value:g} Hz"
        cause = f"{parameter.name} {found}, and usually is {parameter.usual_hz:g} Hz"
        return GyroDelay(parameter.delay(parameter.usual_hz), parameter.usual_sigma, cause)
