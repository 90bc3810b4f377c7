"""Failsafe parameters of an autopilot, for when its agent fails: fence, time-outs, speed limits.

Facts in, findings out. All demands are in one table: parameter per firmware, expected value given the formation's
limits, and reason. The meanings of numbers are those of the firmwares' parameter references.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from pymavlink.dialects.v20 import common

from swarmtrack.diagnosis.findings import Finding, fault, ok
from swarmtrack.formation.parameters import FlightLimits

ARDUPILOT_KIND, PX4_KIND = common.MAV_AUTOPILOT_ARDUPILOTMEGA, common.MAV_AUTOPILOT_PX4
# s: longer nobody shall fly on after its agent.
LONGEST_FLIES_ON_S = 1.0
# Times our own limit: a runaway shall not be much faster.
RATE_LIMIT_FACTOR = 2.0
# m beyond the formation's fence, and above it, that the autopilot's own may stand: it is there for what goes wrong.
WIDER_M = 20.0
# bits of FENCE_TYPE: highest altitude, circle; of COM_RC_OVERRIDE: sticks end OFFBOARD.
ALTITUDE_AND_CIRCLE, STICKS_END_OFFBOARD = 0b11, 0b10
OFFBOARD_LOST = {
    0: "Position", 1: "Altitude", 2: "Stabilized", 3: "Return", 4: "Land", 5: "Hold", 6: "Terminate", 7: "Disarm",
}  # fmt: skip


class Asked(NamedTuple):
    """Requirements of the formation: its limits, and the slot's height [m] above the team frame's origin."""

    limits: FlightLimits
    height: float


@dataclass(frozen=True, slots=True)
class Demand:
    """names: with the unit [SI] of each; they change with versions, and the first that the firmware has counts.

    is_met: of a value in SI; wanted: the value to set, likewise; why: what happens otherwise; unit: as people read it.
    """

    names: Mapping[str, float]
    is_met: Callable[[float, Asked], bool]
    wanted: Callable[[Asked], float]
    why: str
    unit: str = ""


def _at_most(most: Callable[[Asked], float]) -> Callable[[float, Asked], bool]:
    return lambda value, asked: 0.0 < value <= most(asked) + 1e-6


def _one_of(*choices: int) -> Callable[[float, Asked], bool]:
    return lambda value, asked: value in choices


def _has_bits(bits: int) -> Callable[[float, Asked], bool]:
    """Of a whole number; what is none, or below zero, has none of them."""
    return lambda value, asked: value >= 0.0 and value == int(value) and int(value) & bits == bits


def _speed(asked: Asked) -> float:
    return RATE_LIMIT_FACTOR * asked.limits.speed


def _climb(asked: Asked) -> float:
    return RATE_LIMIT_FACTOR * asked.limits.climb


def _radius(asked: Asked) -> float:
    return math.ceil(asked.limits.fence_radius + WIDER_M)


def _ceiling(asked: Asked) -> float:
    return math.ceil(asked.height + asked.limits.fence_height + WIDER_M)


FLIES_ON = "a drone whose agent and guard have died flies on for as long"
DEMANDS: dict[int, tuple[Demand, ...]] = {
    ARDUPILOT_KIND: (
        Demand(
            {"GUID_TIMEOUT": 1.0},
            _at_most(lambda asked: LONGEST_FLIES_ON_S),
            lambda asked: LONGEST_FLIES_ON_S,
            FLIES_ON,
            " s",
        ),
        Demand({"FENCE_ENABLE": 1.0}, _one_of(1), lambda asked: 1.0, "no fence of its own is on"),
        Demand({"FENCE_ACTION": 1.0}, _one_of(*range(1, 9)), lambda asked: 1.0, "its fence only reports"),
        Demand(
            {"FENCE_TYPE": 1.0},
            _has_bits(ALTITUDE_AND_CIRCLE),
            lambda asked: float(ALTITUDE_AND_CIRCLE),
            "its fence lacks the circle or the highest altitude",
        ),
        Demand({"FENCE_RADIUS": 1.0}, _at_most(_radius), _radius, "far outside the formation's fence", " m"),
        Demand({"FENCE_ALT_MAX": 1.0}, _at_most(_ceiling), _ceiling, "far above the formation's fence", " m"),
        Demand(
            {"WP_SPD": 1.0, "WPNAV_SPEED": 0.01},
            _at_most(_speed),
            _speed,
            "much faster than the formation flies",
            " m/s",
        ),
    ),
    PX4_KIND: (
        Demand(
            {"COM_OF_LOSS_T": 1.0},
            _at_most(lambda asked: LONGEST_FLIES_ON_S),
            lambda asked: LONGEST_FLIES_ON_S,
            FLIES_ON,
            " s",
        ),
        Demand(
            {"COM_OBL_RC_ACT": 1.0},
            _one_of(0, 4, 5),
            lambda asked: 0.0,
            "what it does without set points: 0 Position, 5 Hold and 4 Land keep it where it is",
        ),
        Demand(
            {"COM_RC_OVERRIDE": 1.0},
            _has_bits(STICKS_END_OFFBOARD),
            lambda asked: 3.0,
            "moving the sticks does not end OFFBOARD",
        ),
        Demand(
            {"GF_ACTION": 1.0},
            _one_of(2, 3, 5),
            lambda asked: 2.0,
            "its geofence is off, only warns, or drops the drone",
        ),
        Demand(
            {"GF_MAX_HOR_DIST": 1.0},
            _at_most(_radius),
            _radius,
            "0, or far beyond the formation's fence",
            " m",
        ),
        Demand(
            {"GF_MAX_VER_DIST": 1.0},
            _at_most(_ceiling),
            _ceiling,
            "0, or far above the formation's fence",
            " m",
        ),
        Demand(
            {"MPC_XY_VEL_MAX": 1.0}, _at_most(_speed), _speed, "much faster than the formation flies", " m/s"
        ),
        Demand(
            {"MPC_Z_VEL_MAX_UP": 1.0},
            _at_most(_climb),
            _climb,
            "much faster than the formation climbs",
            " m/s",
        ),
        Demand(
            {"MPC_Z_VEL_MAX_DN": 1.0},
            _at_most(_climb),
            _climb,
            "much faster than the formation sinks",
            " m/s",
        ),
    ),
}


def asked_of(kind: int) -> tuple[str, ...]:
    """Relevant parameters of a MAV_AUTOPILOT."""
    return tuple(name for demand in DEMANDS.get(kind, ()) for name in demand.names)


def check_limits(kind: int | None, values: Mapping[str, float], asked: Asked) -> list[Finding]:
    """kind: MAV_AUTOPILOT, None without an autopilot; values: by name, as read."""
    demands = DEMANDS.get(kind, ()) if kind is not None else ()
    if not demands:
        return []
    findings, silent = [], []
    for demand in demands:
        name = next((name for name in demand.names if name in values), None)
        if name is None:
            silent.append(" or ".join(demand.names))
            continue
        scale = demand.names[name]
        if not demand.is_met(scale * values[name], asked):
            in_si = f"{scale * values[name]:g}{demand.unit}"
            value = in_si if scale == 1.0 else f"{values[name]:g} ({in_si})"
            findings.append(
                fault(
                    "limits.unsafe",
                    parameter=name,
                    value=value + _meaning(name, values[name]),
                    why=demand.why,
                    wanted=f"{demand.wanted(asked) / scale:g}",
                )
            )
    if silent:
        findings.append(fault("limits.unknown", names=", ".join(silent)))
    return findings or [ok("limits", f"{len(demands)} of the autopilot's own limits are as they should be")]


def unheard(reason: str) -> list[Finding]:
    """Finding for an autopilot that did not answer."""
    return [fault("limits.silent", reason=reason)]


def _meaning(name: str, value: float) -> str:
    word = OFFBOARD_LOST.get(int(value)) if name == "COM_OBL_RC_ACT" else None
    return f" ({word})" if word else ""
