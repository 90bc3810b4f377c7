"""In what ArduCopter and PX4 differ as pilots: numbers of modes, refusals, and when they disarm by themselves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

from pymavlink.dialects.v20 import common

from swarmtrack.lab.autopilots.vehicle_parameters import ARDUPILOT_PARAMETERS, PX4_PARAMETERS, ParameterValue
from swarmtrack.lab.world.response import ARDUPILOT_RESPONSE, PX4_RESPONSE, Response


class FlightMode(Enum):
    """What a mode is for; each firmware has its own word."""

    BY_HAND = auto()
    GUIDED = auto()
    HOLD = auto()
    POSITION = auto()
    BRAKE = auto()
    TAKE_OFF = auto()
    LAND = auto()
    RETURN = auto()


class ModeNumbers(NamedTuple):
    """As in a heartbeat: flags of base_mode, and custom_mode."""

    name: str
    flags: int
    custom: int


@dataclass(frozen=True, slots=True)
class Firmware:
    """refused: the MAV_RESULT of what is possible at another time; takes_off_in: the mode that climbs to a height.

    stream_s: guided flight needs set points at least this often [s], and lifts off by them; inf: it does not, and
    needs a take-off. Without them it falls into POSITION, and goes back once they come again: its intention stays.
    return_m: above the ground, on its way home, unless it is higher.
    nose: a go-to without a heading turns the nose to the way point. above_sea: a take-off's height
    is; take_off_m: above the ground, if no height is asked for; NaN: one must be. idle_s, landed_s: the motors stop by
    themselves so long after arming without a take-off, and after landing. armed_state: MAV_STATE on the ground with the
    motors on. parameters: by name, what can be read; bytewise: whole numbers among them are sent as bits. not_offered:
    the MAV_RESULT to who asks for a message that there is not; acknowledges_set_mode: answers the old SET_MODE;
    no_channel: in RC_CHANNELS, of a channel that its receiver lacks.
    """

    autopilot: int
    response: Response
    modes: Mapping[FlightMode, ModeNumbers]
    refused: int
    takes_off_in: FlightMode
    stream_s: float
    return_m: float
    nose: bool
    above_sea: bool
    take_off_m: float
    idle_s: float
    landed_s: float
    armed_state: int
    parameters: Mapping[str, ParameterValue]
    bytewise: bool
    not_offered: int
    acknowledges_set_mode: bool
    no_channel: int


_BY_HAND = common.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | common.MAV_MODE_FLAG_STABILIZE_ENABLED
_BY_ITSELF = common.MAV_MODE_FLAG_STABILIZE_ENABLED | common.MAV_MODE_FLAG_GUIDED_ENABLED


def _px4_mode(main: int, sub: int = 0) -> int:
    """custom_mode of PX4: the main mode in its third byte, the sub-mode in its fourth."""
    return main << 16 | sub << 24


ARDUCOPTER = Firmware(
    autopilot=common.MAV_AUTOPILOT_ARDUPILOTMEGA,
    response=ARDUPILOT_RESPONSE,
    modes={
        FlightMode.BY_HAND: ModeNumbers("STABILIZE", _BY_HAND, 0),
        FlightMode.GUIDED: ModeNumbers("GUIDED", _BY_HAND | _BY_ITSELF, 4),
        FlightMode.HOLD: ModeNumbers("LOITER", _BY_HAND, 5),
        FlightMode.RETURN: ModeNumbers("RTL", _BY_HAND, 6),
        FlightMode.LAND: ModeNumbers("LAND", _BY_HAND, 9),
        FlightMode.BRAKE: ModeNumbers("BRAKE", _BY_HAND, 17),
    },
    refused=common.MAV_RESULT_FAILED,
    takes_off_in=FlightMode.GUIDED,
    stream_s=math.inf,
    return_m=15.0,
    nose=True,
    above_sea=False,
    take_off_m=math.nan,
    idle_s=10.0,
    landed_s=1.0,
    armed_state=common.MAV_STATE_STANDBY,
    parameters=ARDUPILOT_PARAMETERS,
    bytewise=False,
    not_offered=common.MAV_RESULT_DENIED,
    acknowledges_set_mode=True,
    no_channel=0,
)
PX4_FIRMWARE = Firmware(
    autopilot=common.MAV_AUTOPILOT_PX4,
    response=PX4_RESPONSE,
    modes={
        FlightMode.BY_HAND: ModeNumbers("MANUAL", _BY_HAND, _px4_mode(1)),
        FlightMode.GUIDED: ModeNumbers(
            "OFFBOARD", _BY_ITSELF | common.MAV_MODE_FLAG_AUTO_ENABLED, _px4_mode(6)
        ),
        FlightMode.TAKE_OFF: ModeNumbers(
            "TAKEOFF", _BY_ITSELF | common.MAV_MODE_FLAG_AUTO_ENABLED, _px4_mode(4, 2)
        ),
        FlightMode.POSITION: ModeNumbers("POSCTL", _BY_HAND, _px4_mode(3)),
        FlightMode.HOLD: ModeNumbers("HOLD", _BY_ITSELF | common.MAV_MODE_FLAG_AUTO_ENABLED, _px4_mode(4, 3)),
        FlightMode.RETURN: ModeNumbers(
            "RTL", _BY_ITSELF | common.MAV_MODE_FLAG_AUTO_ENABLED, _px4_mode(4, 5)
        ),
        FlightMode.LAND: ModeNumbers("LAND", _BY_ITSELF | common.MAV_MODE_FLAG_AUTO_ENABLED, _px4_mode(4, 6)),
    },
    refused=common.MAV_RESULT_TEMPORARILY_REJECTED,
    takes_off_in=FlightMode.TAKE_OFF,
    stream_s=1.0,
    return_m=30.0,
    nose=False,
    above_sea=True,
    take_off_m=2.5,
    idle_s=10.0,
    landed_s=2.0,
    armed_state=common.MAV_STATE_ACTIVE,
    parameters=PX4_PARAMETERS,
    bytewise=True,
    not_offered=common.MAV_RESULT_FAILED,
    acknowledges_set_mode=False,
    no_channel=65535,
)
