"""An estimator that goes by external positions, as EKF3 and EKF2 do: by ODOMETRY, where the parameters let it.

What an inertial estimator knows by itself over seconds is how it moves. So the state is how far it is off, and an
external position measures that.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.lab.autopilots.vehicle_parameters import ParameterValue
from swarmtrack.messages import Array

# s without an external position, after which the position is gone.
EXTERNAL_LASTS_S = 1.0
# How an inertial position walks, and the variance [m²] of a measured one at least, as by VISO_POS_M_NSE.
INERTIAL_WALK_M_SQRT_S, LEAST_EXTERNAL_VAR_M2 = 0.15, 0.2**2
# EK3_SRCn_POSXY: GPS, external navigation; EKF2_EV_CTRL: its horizontal position.
RECEIVER_SOURCE, EXTERNAL_SOURCE, HORIZONTAL_BIT = 3, 6, 0b1


class ExternalPosition:
    """off (3,) m: by how much the estimate is off from what the estimator would have without errors; None: it has no
    position. Times are the caller's [s]."""

    def __init__(self) -> None:
        self._off, self._var = np.zeros(3), 0.0
        self._t = -math.inf

    def take(self, t: float, off: Array, var: Array, *, is_reset: bool) -> None:
        """A position that is off by so much (3,) m, with variances (3,) m²."""
        R = np.maximum(var, LEAST_EXTERNAL_VAR_M2)
        if is_reset or t - self._t > EXTERNAL_LASTS_S:
            self._off, self._var = off, float(R.max())
        else:
            P = self._var + INERTIAL_WALK_M_SQRT_S**2 * max(t - self._t, 0.0)
            gain = P / (P + R)
            self._off = self._off + gain * (off - self._off)
            self._var = float(((1.0 - gain) * P).max())
        self._t = max(t, self._t)

    def off(self, t: float) -> Array | None:
        """At t."""
        return self._off if t - self._t <= EXTERNAL_LASTS_S else None


def ardupilot_takes(m: Any, parameters: dict[str, ParameterValue], source_set: int) -> bool:
    """Whether ArduPilot gives this ODOMETRY to its filter: all else it drops without a word."""
    is_source = parameters.get(f"EK3_SRC{source_set}_POSXY") == EXTERNAL_SOURCE
    frames = (m.frame_id, m.child_frame_id)
    return (
        parameters.get("VISO_TYPE") == 1
        and is_source
        and frames == (common.MAV_FRAME_LOCAL_FRD, common.MAV_FRAME_BODY_FRD)
        and m.quality >= parameters.get("VISO_QUAL_MIN", 0)
        and all(map(math.isfinite, (m.x, m.y, m.z)))
    )


def px4_takes(m: Any, parameters: dict[str, ParameterValue]) -> bool:
    """Whether PX4 gives this ODOMETRY to its filter."""
    return (
        bool(int(parameters.get("EKF2_EV_CTRL", 0)) & HORIZONTAL_BIT)
        and m.frame_id in (common.MAV_FRAME_LOCAL_NED, common.MAV_FRAME_LOCAL_FRD)
        and m.estimator_type in (common.MAV_ESTIMATOR_TYPE_UNKNOWN, common.MAV_ESTIMATOR_TYPE_VISION)
        and all(map(math.isfinite, (m.x, m.y, m.z)))
    )
