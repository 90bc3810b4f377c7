"""What an autopilot is to do by itself, where the agent that flies it fails: fence, time-outs, speed limits.

Facts in, findings out. Each demand stands in one table: which parameter, of which firmware, what is expected in the
light of the formation's limits, and why. The meanings of numbers are those of the firmwares' parameter references.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pymavlink.dialects.v20 import common

from swarmtrack.diagnosis.findings import Finding, fault, ok
from swarmtrack.formation.parameters import FlightLimits

ARDUPILOT, PX4 = common.MAV_AUTOPILOT_ARDUPILOTMEGA, common.MAV_AUTOPILOT_PX4
# s: longer nobody shall fly on after its agent.
LONGEST_S = 1.0
# Times our own limit: a runaway shall not be much faster.
FASTER = 2.0
# m beyond the formation's fence that the autopilot's own may stand: it is there for what goes wrong.
WIDER_M = 20.0
# bits of FENCE_TYPE: highest altitude, circle; of COM_RC_OVERRIDE: sticks end OFFBOARD.
ALTITUDE_AND_CIRCLE, STICKS_END_OFFBOARD = 0b11, 0b10
OFFBOARD_LOST = {
    0: "Position", 1: "Altitude", 2: "Stabilized", 3: "Return", 4: "Land", 5: "Hold", 6: "Terminate", 7: "Disarm",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Demand:
    """is_met: of a value, with the formation's limits; wanted: the value to set; why: what happens otherwise.

    names: the first that the firmware has counts: they change with versions.
    """

    names: tuple[str, ...]
    is_met: Callable[[float, FlightLimits], bool]
    wanted: Callable[[FlightLimits], float]
    why: str


def _at_most(most: Callable[[FlightLimits], float]) -> Callable[[float, FlightLimits], bool]:
    return lambda value, limits: 0.0 < value <= most(limits) + 1e-6


def _speed(limits: FlightLimits) -> float:
    return FASTER * limits.speed


def _climb(limits: FlightLimits) -> float:
    return FASTER * limits.climb


def _radius(limits: FlightLimits) -> float:
    return math.ceil(limits.fence_radius + WIDER_M)


DEMANDS: dict[int, tuple[Demand, ...]] = {
    ARDUPILOT: (
        Demand(
            ("GUID_TIMEOUT",),
            _at_most(lambda limits: LONGEST_S),
            lambda limits: LONGEST_S,
            "a drone whose agent and guard have died flies on for so many seconds",
        ),
        Demand(
            ("FENCE_ENABLE",),
            lambda value, limits: value >= 1.0,
            lambda limits: 1.0,
            "no fence of its own is on",
        ),
        Demand(
            ("FENCE_ACTION",),
            lambda value, limits: value >= 1.0,
            lambda limits: 1.0,
            "its fence only reports",
        ),
        Demand(
            ("FENCE_TYPE",),
            lambda value, limits: int(value) & ALTITUDE_AND_CIRCLE == ALTITUDE_AND_CIRCLE,
            lambda limits: float(ALTITUDE_AND_CIRCLE),
            "its fence lacks the circle or the highest altitude",
        ),
        Demand(
            ("FENCE_RADIUS",), _at_most(_radius), _radius, "its circle is far outside the formation's fence"
        ),
        Demand(
            ("WPNAV_SPEED",),
            lambda value, limits: 0.0 < value <= 100.0 * _speed(limits),
            lambda limits: 100.0 * _speed(limits),
            "cm/s, much faster than the formation flies",
        ),
    ),
    PX4: (
        Demand(
            ("COM_OF_LOSS_T",),
            _at_most(lambda limits: LONGEST_S),
            lambda limits: LONGEST_S,
            "a drone whose agent and guard have died flies on for so many seconds",
        ),
        Demand(
            ("COM_OBL_RC_ACT",),
            lambda value, limits: int(value) in (0, 4, 5),
            lambda limits: 0.0,
            "what it does without set points: 0 Position, 5 Hold and 4 Land keep it where it is",
        ),
        Demand(
            ("COM_RC_OVERRIDE",),
            lambda value, limits: bool(int(value) & STICKS_END_OFFBOARD),
            lambda limits: 3.0,
            "moving the sticks does not end OFFBOARD",
        ),
        Demand(
            ("GF_ACTION",),
            lambda value, limits: int(value) in (2, 3, 5),
            lambda limits: 2.0,
            "its geofence is off, only warns, or drops the drone",
        ),
        Demand(
            ("GF_MAX_HOR_DIST",),
            _at_most(_radius),
            _radius,
            "0 is no fence; this is far outside the formation's",
        ),
        Demand(
            ("MPC_XY_VEL_MAX",),
            _at_most(_speed),
            _speed,
            "m/s, much faster than the formation flies",
        ),
        Demand(("MPC_Z_VEL_MAX_UP",), _at_most(_climb), _climb, "m/s, much faster than the formation climbs"),
        Demand(("MPC_Z_VEL_MAX_DN",), _at_most(_climb), _climb, "m/s, much faster than the formation sinks"),
    ),
}


def asked_of(kind: int) -> tuple[str, ...]:
    """The parameters that are of interest, of a MAV_AUTOPILOT."""
    return tuple(name for demand in DEMANDS.get(kind, ()) for name in demand.names)


def check_limits(kind: int | None, values: Mapping[str, float], limits: FlightLimits) -> list[Finding]:
    """kind: MAV_AUTOPILOT, None: none was heard; values: by name, what it told."""
    demands = DEMANDS.get(kind, ()) if kind is not None else ()
    if not demands:
        return []
    findings, silent = [], []
    for demand in demands:
        name = next((name for name in demand.names if name in values), None)
        if name is None:
            silent.append(demand.names[0])
        elif not demand.is_met(values[name], limits):
            findings.append(
                fault(
                    "limits.unsafe",
                    parameter=name,
                    value=f"{values[name]:g}{_meaning(name, values[name])}",
                    why=demand.why,
                    wanted=f"{demand.wanted(limits):g}",
                )
            )
    if silent:
        findings.append(fault("limits.unknown", names=", ".join(silent)))
    return findings or [ok("limits", f"{len(demands)} of the autopilot's own limits are as they should be")]


def unheard(reason: str) -> list[Finding]:
    """There was nobody to be asked."""
    return [fault("limits.silent", reason=reason)]


def _meaning(name: str, value: float) -> str:
    word = OFFBOARD_LOST.get(int(value)) if name == "COM_OBL_RC_ACT" else None
    return f" ({word})" if word else ""
