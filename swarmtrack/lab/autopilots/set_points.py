"""Where a ground station sends a drone: MAVLink's set points as those of `lab.world.response`, in the world's NED."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common

from swarmtrack.geometry.geodesy import Geodetic, to_ned
from swarmtrack.lab.world.response import Flown, SetPoint, Triple

POSITION_IGNORED = 0b111
VELOCITY_IGNORED = 0b111 << 3
FORCE = common.POSITION_TARGET_TYPEMASK_FORCE_SET
YAW_IGNORED = common.POSITION_TARGET_TYPEMASK_YAW_IGNORE
YAW_RATE_IGNORED = common.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
LOCAL = common.MAV_FRAME_LOCAL_NED
OFFSET = common.MAV_FRAME_LOCAL_OFFSET_NED  # from where the drone is, axes north and east
BODY = common.MAV_FRAME_BODY_NED  # from where it is, axes ahead and to the right
BODY_OFFSET = common.MAV_FRAME_BODY_OFFSET_NED  # the same to ArduPilot
ABOVE_SEA = (common.MAV_FRAME_GLOBAL, common.MAV_FRAME_GLOBAL_INT)
ABOVE_HOME = (common.MAV_FRAME_GLOBAL_RELATIVE_ALT, common.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)


def local_set_point(message: Any, t: float, state: Flown, local_origin: Triple) -> SetPoint | None:
    """Of SET_POSITION_TARGET_LOCAL_NED. t: world time; local_origin: that of the autopilot's local frame.

    As in ArduPilot a position and a velocity together go to the position, and a set point with neither holds. None: in
    a frame that is not understood, a force, or not a number.
    """
    mask = message.type_mask
    turned = message.coordinate_frame in (BODY, BODY_OFFSET)
    if message.coordinate_frame not in (LOCAL, OFFSET, BODY, BODY_OFFSET) or mask & FORCE:
        return None
    position = velocity = None
    if not mask & POSITION_IGNORED:
        origin = local_origin if message.coordinate_frame == LOCAL else state.position
        position = _sum(origin, _level((message.x, message.y, message.z), state.yaw if turned else 0.0))
    if not mask & VELOCITY_IGNORED:
        velocity = _level((message.vx, message.vy, message.vz), state.yaw if turned else 0.0)
    return _finite(_with_yaw(message, SetPoint(t, position, velocity), state.yaw if turned else 0.0))


def global_set_point(message: Any, t: float, state: Flown, origin: Geodetic, home: Triple) -> SetPoint | None:
    """Of SET_POSITION_TARGET_GLOBAL_INT. origin: the world's on the Earth; home: where heights above home begin."""
    mask = message.type_mask
    if message.coordinate_frame not in (*ABOVE_SEA, *ABOVE_HOME) or mask & FORCE:
        return None
    position = velocity = None
    if not mask & POSITION_IGNORED:
        above_home = message.coordinate_frame in ABOVE_HOME
        position = place_in_world(
            message.lat_int, message.lon_int, message.alt, origin, home if above_home else None
        )
    if not mask & VELOCITY_IGNORED:
        velocity = (message.vx, message.vy, message.vz)
    return _finite(_with_yaw(message, SetPoint(t, position, velocity), 0.0))


def place_in_world(
    latitude: int, longitude: int, height: float, origin: Geodetic, home: Triple | None
) -> Triple:
    """NED [m] of a place in degrees × 10⁷; height [m] above home, or above the sea if that is None."""
    north, east, down = to_ned(
        Geodetic.from_degrees(1e-7 * latitude, 1e-7 * longitude, height if home is None else origin.height),
        origin,
    ).tolist()
    return north, east, down if home is None else home[2] - height


def _with_yaw(message: Any, point: SetPoint, relative_to: float) -> SetPoint:
    """A heading rules out a rate of turn: ArduPilot takes both together for how fast to get there."""
    if not message.type_mask & YAW_IGNORED:
        return point._replace(yaw=relative_to + message.yaw)
    return point._replace(yaw_rate=None if message.type_mask & YAW_RATE_IGNORED else message.yaw_rate)


def _level(vector: Triple, yaw: float) -> Triple:
    """Ahead, right and down of a drone with that heading, as north, east and down."""
    ahead, right, down = vector
    c, s = math.cos(yaw), math.sin(yaw)
    return c * ahead - s * right, s * ahead + c * right, down


def _sum(a: Sequence[float], b: Sequence[float]) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _finite(point: SetPoint) -> SetPoint | None:
    numbers = [*(point.position or ()), *(point.velocity or ()), point.yaw or 0.0, point.yaw_rate or 0.0]
    return point if all(map(math.isfinite, numbers)) else None
