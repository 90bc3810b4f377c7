"""What a simulated autopilot streams: what it senses, and what is true of it, as messages of the dialect."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.geometry.geodesy import STANDARD_GRAVITY_M_S2, Geodetic
from swarmtrack.geometry.rotation import from_quaternion, to_euler, to_quaternion
from swarmtrack.lab.autopilots.senses import GpsFix, Inertial, SensedState
from swarmtrack.lab.autopilots.truth import TrueState
from swarmtrack.messages import Array

UNKNOWN_HEADING = 65535
NOT_MEASURED_FIELD = 0.0
# cm: the nearest and the farthest that a range finder says that it measures.
RANGE_FINDER_CM = (20, 5000)


def _highres_imu(stamp: float, sensed: Inertial) -> Any:
    return common.MAVLink_highres_imu_message(
        _us(stamp), *sensed.accel, *sensed.gyro, 0.2, 0.1, 0.4, 1013.0, 0.0, 100.0, 25.0, 0xFFFF
    )


def _raw_imu(stamp: float, sensed: Inertial) -> Any:
    return common.MAVLink_raw_imu_message(_us(stamp), *_thousandths(sensed.accel, sensed.gyro), 0, 0, 0)


def _scaled_imu(stamp: float, sensed: Inertial) -> Any:
    return common.MAVLink_scaled_imu_message(_ms(stamp), *_thousandths(sensed.accel, sensed.gyro), 0, 0, 0)


def _attitude_quaternion(stamp: float, sensed: SensedState) -> Any:
    return common.MAVLink_attitude_quaternion_message(_ms(stamp), *sensed.q, *sensed.gyro)


def _attitude(stamp: float, sensed: SensedState) -> Any:
    angles = to_euler(from_quaternion(sensed.q))
    return common.MAVLink_attitude_message(_ms(stamp), *angles, *sensed.gyro)


def _local_position(stamp: float, sensed: SensedState) -> Any:
    """None until the estimator has found itself, as ArduPilot."""
    if sensed.position is None:
        return None
    return common.MAVLink_local_position_ned_message(_ms(stamp), *sensed.position, *sensed.velocity)


def _global_position(stamp: float, sensed: SensedState) -> Any:
    """Before it knows anything at 0° N 0° E, as ArduPilot."""
    place = sensed.globe or Geodetic(0.0, 0.0, 0.0)
    down = 0 if sensed.position is None else -round(1e3 * sensed.position[2])
    return common.MAVLink_global_position_int_message(
        _ms(stamp), *_degrees_and_millimetres(place), down, *_centimetres(sensed.velocity), UNKNOWN_HEADING
    )


def _gps_raw(stamp: float, sensed: SensedState) -> Any:
    gps: GpsFix | None = sensed.gps
    fix = common.GPS_FIX_TYPE_3D_FIX if gps else common.GPS_FIX_TYPE_NO_FIX
    place = gps.place if gps else Geodetic(0.0, 0.0, 0.0)
    h_acc = round(1e3 * gps.sigma) if gps else 0
    v_acc = round(1e3 * gps.vertical_sigma) if gps and gps.vertical_sigma is not None else h_acc
    satellites = 14 if gps else 0
    return common.MAVLink_gps_raw_int_message(
        _us(stamp), fix, *_degrees_and_millimetres(place), 80, 120, 0, 0, satellites, 0, h_acc, v_acc
    )


def _distance_sensor(stamp: float, sensed: SensedState) -> Any:
    """In cm; a range finder that finds nothing is silent here."""
    if sensed.ground is None:
        return None
    return common.MAVLink_distance_sensor_message(
        _ms(stamp),
        RANGE_FINDER_CM[0],
        RANGE_FINDER_CM[1],
        round(1e2 * sensed.ground),
        common.MAV_DISTANCE_SENSOR_LASER,
        0,
        common.MAV_SENSOR_ROTATION_PITCH_270,
        0,
        signal_quality=100,
    )


def _sim_state(stamp: float, true: TrueState) -> Any:
    """ArduPilot's truth. It has no stamp; latitude and longitude are exact in its integer fields alone."""
    latitude, longitude, _ = _degrees_and_millimetres(true.place)
    return common.MAVLink_sim_state_message(
        *to_quaternion(true.attitude),
        *to_euler(true.attitude),
        *true.accel,
        *true.gyro,
        1e-7 * latitude,
        1e-7 * longitude,
        true.place.height,
        NOT_MEASURED_FIELD,
        NOT_MEASURED_FIELD,
        *true.velocity,
        latitude,
        longitude,
    )


def _hil_state_quaternion(stamp: float, true: TrueState) -> Any:
    """PX4's truth. It has a field for a stamp, which PX4 leaves at 0."""
    return common.MAVLink_hil_state_quaternion_message(
        0,
        to_quaternion(true.attitude),
        *true.gyro,
        *_degrees_and_millimetres(true.place),
        *_centimetres(true.velocity),
        0,
        0,
        *_thousandths(true.accel),
    )


INERTIAL: dict[int, Callable[[float, Inertial], Any]] = {
    common.MAVLINK_MSG_ID_HIGHRES_IMU: _highres_imu,
    common.MAVLINK_MSG_ID_RAW_IMU: _raw_imu,
    common.MAVLINK_MSG_ID_SCALED_IMU: _scaled_imu,
}
SENSED: dict[int, Callable[[float, SensedState], Any]] = {
    common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: _attitude_quaternion,
    common.MAVLINK_MSG_ID_ATTITUDE: _attitude,
    common.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _local_position,
    common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: _global_position,
    common.MAVLINK_MSG_ID_GPS_RAW_INT: _gps_raw,
    common.MAVLINK_MSG_ID_DISTANCE_SENSOR: _distance_sensor,
}
"""By message id, what writes it: of what was sensed at `stamp`, seconds since boot on the autopilot's own clock."""

TRUE: dict[int, Callable[[float, TrueState], Any]] = {
    common.MAVLINK_MSG_ID_SIM_STATE: _sim_state,
    common.MAVLINK_MSG_ID_HIL_STATE_QUATERNION: _hil_state_quaternion,
}
"""The same of what is true."""


def _us(stamp: float) -> int:
    return round(stamp * 1e6)


def _ms(stamp: float) -> int:
    return round(stamp * 1e3)


def _degrees_and_millimetres(place: Geodetic) -> tuple[int, int, int]:
    latitude, longitude = (round(1e7 * math.degrees(angle)) for angle in place[:2])
    return latitude, longitude, round(1e3 * place.height)


def _centimetres(velocity: Array) -> list[int]:
    return [round(1e2 * v) for v in velocity.tolist()]


def _thousandths(accel: Array, gyro: Array | None = None) -> list[int]:
    """Acceleration in mG and angular velocity in mrad/s, as 16 bits hold them."""
    values = accel * (1e3 / STANDARD_GRAVITY_M_S2)
    if gyro is not None:
        values = np.concatenate([values, gyro * 1e3])
    return [int(v) for v in np.clip(np.rint(np.nan_to_num(values)), -32768, 32767)]
