"""Which of the autopilots on a link is ours.

Several may speak there: a neighbour's over the same radio or router, an antenna tracker's, a second one in the same
vehicle. Heartbeats come once per second, so everyone is heard for a little longer than that. Of those, what flies is
preferred, and within one vehicle component 1. Two vehicles are never decided between: only their owner knows which is
which, so none is chosen until `autopilot.system_id` says it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.limits import CANDIDATE_GONE_S, CANDIDATES_HEARD_S, NAMED_SOURCES

FLYING_TYPES = {
    common.MAV_TYPE_GENERIC: "aircraft",
    common.MAV_TYPE_FIXED_WING: "plane",
    common.MAV_TYPE_QUADROTOR: "quadrotor",
    common.MAV_TYPE_COAXIAL: "coaxial helicopter",
    common.MAV_TYPE_HELICOPTER: "helicopter",
    common.MAV_TYPE_AIRSHIP: "airship",
    common.MAV_TYPE_FREE_BALLOON: "balloon",
    common.MAV_TYPE_ROCKET: "rocket",
    common.MAV_TYPE_HEXAROTOR: "hexarotor",
    common.MAV_TYPE_OCTOROTOR: "octorotor",
    common.MAV_TYPE_TRICOPTER: "tricopter",
    common.MAV_TYPE_FLAPPING_WING: "ornithopter",
    common.MAV_TYPE_KITE: "kite",
    common.MAV_TYPE_VTOL_DUOROTOR: "VTOL",
    common.MAV_TYPE_VTOL_QUADROTOR: "VTOL",
    common.MAV_TYPE_VTOL_TILTROTOR: "VTOL",
    common.MAV_TYPE_VTOL_RESERVED2: "VTOL",
    common.MAV_TYPE_VTOL_RESERVED3: "VTOL",
    common.MAV_TYPE_VTOL_RESERVED4: "VTOL",
    common.MAV_TYPE_VTOL_RESERVED5: "VTOL",
    common.MAV_TYPE_PARAFOIL: "parafoil",
    common.MAV_TYPE_DODECAROTOR: "dodecarotor",
    common.MAV_TYPE_DECAROTOR: "decarotor",
    common.MAV_TYPE_GENERIC_MULTIROTOR: "multirotor",
}
GROUND_TYPES = {
    common.MAV_TYPE_GROUND_ROVER: "rover",
    common.MAV_TYPE_SURFACE_BOAT: "boat",
    common.MAV_TYPE_SUBMARINE: "submarine",
}
# What speaks as an autopilot and is none of a vehicle.
OTHER_TYPES = {
    common.MAV_TYPE_ANTENNA_TRACKER: "antenna tracker",
    common.MAV_TYPE_GCS: "ground station",
    common.MAV_TYPE_ONBOARD_CONTROLLER: "companion computer",
    common.MAV_TYPE_GIMBAL: "gimbal",
    common.MAV_TYPE_ADSB: "ADS-B receiver",
    common.MAV_TYPE_CAMERA: "camera",
    common.MAV_TYPE_CHARGING_STATION: "charging station",
    common.MAV_TYPE_FLARM: "FLARM receiver",
    common.MAV_TYPE_SERVO: "servo",
    common.MAV_TYPE_ODID: "remote ID",
    common.MAV_TYPE_BATTERY: "battery",
    common.MAV_TYPE_PARACHUTE: "parachute",
    common.MAV_TYPE_LOG: "log",
    common.MAV_TYPE_OSD: "OSD",
    common.MAV_TYPE_IMU: "IMU",
    common.MAV_TYPE_GPS: "GPS",
    common.MAV_TYPE_WINCH: "winch",
}


def vehicle_name(kind: int) -> str:
    """For people; kind: MAV_TYPE."""
    name = FLYING_TYPES.get(kind) or GROUND_TYPES.get(kind) or OTHER_TYPES.get(kind)
    return name or f"vehicle of type {kind}"


def with_article(name: str) -> str:
    """A vehicle's name, see `vehicle_name`, behind `a` or `an`."""
    return f"{'an' if name[0] in 'aeioAEIO' else 'a'} {name}"


class AutopilotAddress(NamedTuple):
    """MAVLink's system and component ID, 1 … 255 each."""

    system: int
    component: int

    def __str__(self) -> str:
        return f"{self.system}/{self.component}"


@dataclass(slots=True)
class AutopilotCandidate:
    """A sender of heartbeats that names an autopilot. kind: MAV_TYPE; firmware: MAV_AUTOPILOT; heard_at [s]."""

    address: AutopilotAddress
    kind: int
    firmware: int
    heard_at: float

    @property
    def flies(self) -> bool:
        return self.kind in FLYING_TYPES

    @property
    def is_vehicle(self) -> bool:
        return self.kind not in OTHER_TYPES

    @property
    def name(self) -> str:
        return vehicle_name(self.kind)

    def __str__(self) -> str:
        return f"{self.address} ({self.name})"


class AutopilotCandidates:
    """Autopilots by their heartbeats. expected_system: the configured one, or None."""

    def __init__(self, expected_system: int | None) -> None:
        self._expected = expected_system
        self._heard: dict[AutopilotAddress, AutopilotCandidate] = {}
        self.first_at = math.inf
        """When the first one was heard that may be ours [s]."""

    def on_heartbeat(self, t: float, address: AutopilotAddress, m: Any) -> AutopilotCandidate | None:
        """HEARTBEAT from there at t [s]; None where no autopilot sends it."""
        if m.autopilot == common.MAV_AUTOPILOT_INVALID or m.type == common.MAV_TYPE_GCS:
            return None
        candidate = AutopilotCandidate(address, m.type, m.autopilot, t)
        # Nobody keeps ours out by speaking under many names: one more vehicle only makes it no clearer.
        is_wanted = candidate.is_vehicle and self._expected in (None, address.system)
        if address in self._heard or is_wanted or len(self._heard) < NAMED_SOURCES:
            self._heard[address] = candidate
        if is_wanted:
            self.first_at = min(self.first_at, t)
        return candidate

    def choose(self, now: float, *, final: bool = False) -> AutopilotCandidate | None:
        """Ours, if that is clear by now. final: no other will be heard."""
        vehicles = self._preferred()
        if len({each.address.system for each in vehicles}) != 1:
            return None
        best = vehicles[0]
        # Asked for by its ID, and the best that there can be.
        certain = self._expected is not None and best.flies and best.address.component == 1
        return best if certain or final or now - self.first_at >= CANDIDATES_HEARD_S else None

    def listens(self, now: float) -> bool:
        """Whether one is heard, and others may follow."""
        return 0.0 <= now - self.first_at < CANDIDATES_HEARD_S

    def ambiguous(self) -> list[AutopilotCandidate]:
        """Those that cannot be decided between, one per vehicle; empty where one is to be chosen, or none."""
        best: dict[int, AutopilotCandidate] = {}
        for each in self._preferred():
            best.setdefault(each.address.system, each)
        return list(best.values()) if len(best) > 1 else []

    def beside(self, ours: AutopilotAddress, now: float) -> list[AutopilotCandidate]:
        """Those that are heard as well as ours."""
        others = (each for at, each in self._heard.items() if at != ours)
        return [each for each in others if now - each.heard_at < CANDIDATE_GONE_S]

    def rivals(self, ours: AutopilotAddress, now: float) -> list[AutopilotCandidate]:
        """Others than ours that may be our vehicle; none where the system is configured."""
        if self._expected is not None:
            return []
        return [each for each in self.beside(ours, now) if each.flies and each.address.system != ours.system]

    def _vehicles(self) -> list[AutopilotCandidate]:
        return [
            each
            for each in self._heard.values()
            if each.is_vehicle and self._expected in (None, each.address.system)
        ]

    def _preferred(self) -> list[AutopilotCandidate]:
        """What flies, else all vehicles; by system and component."""
        vehicles = sorted(self._vehicles(), key=lambda each: each.address)
        return [each for each in vehicles if each.flies] or vehicles
