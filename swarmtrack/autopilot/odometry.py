"""ODOMETRY: where a drone is by its teammates, for an autopilot whose own position is gone.

What autopilots make of it, read in ArduPilot's `GCS_Common.cpp` and `AP_VisualOdom_MAV.cpp` and in PX4's
`mavlink_receiver.cpp` and `ev_pos_control.cpp`:

* Frames. ArduPilot takes MAV_FRAME_LOCAL_FRD with MAV_FRAME_BODY_FRD, and drops all else without a word; its axes are
  those of its own NED. PX4 turns LOCAL_FRD by the difference of the headings, and takes LOCAL_NED as it is.
* Stamps. PX4 maps them by its TIMESYNC, which our own clock answers, and else counts from their arrival; ArduPilot by
  the quickest arrival. So they are of our own clock, and no map of ours is applied twice.
* Covariance. Both read the diagonal alone; one that is NaN at the first place is unknown to both. ArduPilot limits the
  attitude's by a function that takes no NaN.
* Velocity is in the body's axes. Attitude and rates are the autopilot's own: it must not take its heading from here.
* Quality. ArduPilot uses nothing below VISO_QUAL_MIN, by default 0, but arms only while messages come.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.geometry.rotation import to_quaternion
from swarmtrack.messages import Array
from swarmtrack.motion.ego import AutopilotPlace

FAILED_QUALITY, WORST_QUALITY, BEST_QUALITY = -1, 1, 100
RESETS_WRAP = 256
_UNKNOWN = 3 * (math.nan,)
_UNKNOWN_COV = np.full((6, 6), math.nan)
_UPPER = np.triu_indices(6)


def odometry(place: AutopilotPlace, *, kind: int, origin: Array, quality: int, resets: int) -> Any:
    """The place as a message for a MAV_AUTOPILOT. origin (3,) m: of the autopilot's local frame less that of its
    positions; resets: steps of the place until now."""
    to_body = place.world_from_body.T
    pose_cov, velocity_cov = _UNKNOWN_COV.copy(), _UNKNOWN_COV.copy()
    pose_cov[:3, :3], pose_cov[3:, 3:] = place.position_cov, place.attitude_cov
    velocity_cov[:3, :3] = to_body @ place.velocity_cov @ to_body.T
    is_px4 = kind == common.MAV_AUTOPILOT_PX4
    return common.MAVLink_odometry_message(
        round(1e6 * place.t),
        common.MAV_FRAME_LOCAL_NED if is_px4 else common.MAV_FRAME_LOCAL_FRD,
        common.MAV_FRAME_BODY_FRD,
        *(place.position + origin).tolist(),
        to_quaternion(place.world_from_body).tolist(),
        *(to_body @ place.velocity).tolist(),
        *_UNKNOWN,
        pose_cov[_UPPER].tolist(),
        velocity_cov[_UPPER].tolist(),
        resets % RESETS_WRAP,
        common.MAV_ESTIMATOR_TYPE_VISION,
        quality,
    )


def no_odometry(t: float, *, resets: int) -> Any:
    """A message without a place at t [s]: ArduPilot arms only while ODOMETRY comes."""
    unknown = _UNKNOWN_COV[_UPPER].tolist()
    return common.MAVLink_odometry_message(
        round(1e6 * t),
        common.MAV_FRAME_LOCAL_FRD,
        common.MAV_FRAME_BODY_FRD,
        *_UNKNOWN,
        (1.0, 0.0, 0.0, 0.0),
        *_UNKNOWN,
        *_UNKNOWN,
        unknown,
        unknown,
        resets % RESETS_WRAP,
        common.MAV_ESTIMATOR_TYPE_VISION,
        FAILED_QUALITY,
    )


def quality_of(sigma_m: float, vaguest_m: float) -> int:
    """100 of what is exact, 1 of what is as vague as allowed."""
    share = 1.0 - sigma_m / vaguest_m
    return min(max(round(BEST_QUALITY * share), WORST_QUALITY), BEST_QUALITY)
