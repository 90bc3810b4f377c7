"""The few parameters that a simulated autopilot has, and how it tells them: by name, by number, or all.

They can be read and not written: nothing of ours ever sends PARAM_SET, and tests hold that none comes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import Any

from pymavlink.dialects.v20 import common

ParameterValue = int | float

# Values as a fresh ArduCopter 4.7 and a fresh PX4 1.15 have them; IMU_INTEG_RATE as its simulators do.
ARDUPILOT_PARAMETERS: Mapping[str, ParameterValue] = {
    "EK3_SRC1_POSXY": 3,
    "EK3_SRC1_YAW": 1,
    "EK3_SRC2_POSXY": 0,
    "EK3_SRC2_YAW": 0,
    "EK3_SRC3_POSXY": 0,
    "EK3_SRC3_YAW": 0,
    "FENCE_ACTION": 1,
    "FENCE_ALT_MAX": 100.0,
    "FENCE_ENABLE": 0,
    "FENCE_RADIUS": 300.0,
    "FENCE_TYPE": 7,
    "FRAME_CLASS": 1,
    "GUID_TIMEOUT": 3.0,
    "INS_GYRO_FILTER": 20,
    "SCHED_LOOP_RATE": 400,
    "VISO_QUAL_MIN": 0,
    "VISO_TYPE": 0,
    "WP_SPD": 10.0,
    "WP_YAW_BEHAVIOR": 2,
}
PX4_PARAMETERS: Mapping[str, ParameterValue] = {
    "COM_OBL_RC_ACT": 0,
    "COM_OF_LOSS_T": 1.0,
    "COM_RC_OVERRIDE": 1,
    "EKF2_EV_CTRL": 15,
    "EKF2_EV_NOISE_MD": 0,
    "GF_ACTION": 2,
    "GF_MAX_HOR_DIST": 0.0,
    "GF_MAX_VER_DIST": 0.0,
    "IMU_GYRO_CUTOFF": 40.0,
    "IMU_GYRO_RATEMAX": 400,
    "IMU_INTEG_RATE": 250,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
}
ASKED_BY_NAME = -1
NO_NUMBER = 0xFFFF  # ArduPilot's in the answer to a question by name


class VehicleParameters:
    """values: by name, in the order of their numbers; int or float tells the type.

    bytewise: integers are sent as the bits of the float field, as PX4 does; otherwise as its value, as ArduPilot.
    """

    def __init__(self, values: Mapping[str, ParameterValue], *, bytewise: bool) -> None:
        self.values = dict(values)
        self.written = 0
        """PARAM_SET that came, each of them ignored."""
        self._bytewise = bytewise

    def answers(self, message: Any) -> Iterator[Any]:
        """What is said to a PARAM_ message. A parameter that does not exist is passed over in silence, as PX4 does."""
        names = list(self.values)
        match message.get_type():
            case "PARAM_REQUEST_READ" if message.param_index == ASKED_BY_NAME:
                if message.param_id in self.values:
                    yield self._value(
                        message.param_id, names.index(message.param_id) if self._bytewise else NO_NUMBER
                    )
            case "PARAM_REQUEST_READ" if 0 <= message.param_index < len(names):
                yield self._value(names[message.param_index], message.param_index)
            case "PARAM_REQUEST_LIST":
                for index, name in enumerate(names):
                    yield self._value(name, index)
            case "PARAM_SET":
                self.written += 1

    def _value(self, name: str, index: int) -> Any:
        value = self.values[name]
        kind = common.MAV_PARAM_TYPE_INT32 if isinstance(value, int) else common.MAV_PARAM_TYPE_REAL32
        if isinstance(value, int) and self._bytewise:
            (value,) = struct.unpack("<f", struct.pack("<i", value))
        return common.MAVLink_param_value_message(name.encode(), value, kind, len(self.values), index)
