"""Parameters by which an autopilot takes the place that `autopilot.feed` sends, or does not.

Facts in, findings out. The meanings of numbers are those of the firmwares' parameter references.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from swarmtrack.diagnosis.autopilot_limits import ARDUPILOT_KIND, PX4_KIND
from swarmtrack.diagnosis.findings import Finding, fault, ok

# EK3_SRCn_POSXY and _YAW: external navigation; bits of EKF2_EV_CTRL: horizontal position, yaw.
EXTERNAL_NAVIGATION, EV_POSITION, EV_YAW = 6, 0b1, 0b1000
SOURCE_SETS = (1, 2, 3)


class FeedDemand(NamedTuple):
    """name: the parameter; is_met: of its value; wanted: in words; name_of_fault: in `FAULTS`."""

    name: str
    is_met: Callable[[int], bool]
    wanted: str
    name_of_fault: str = "feed.ignored"


def _of_set(number: int) -> tuple[str, str]:
    return f"EK3_SRC{number}_POSXY", f"EK3_SRC{number}_YAW"


FEED_DEMANDS: dict[int, tuple[FeedDemand, ...]] = {
    ARDUPILOT_KIND: (
        FeedDemand("VISO_TYPE", lambda value: value == 1, "1 (MAVLink)"),
        FeedDemand("VISO_QUAL_MIN", lambda value: value >= 0, "0", "feed.unusable"),
    ),
    PX4_KIND: (
        FeedDemand("EKF2_EV_CTRL", lambda value: bool(value & EV_POSITION), "1 (horizontal position)"),
        FeedDemand("EKF2_EV_CTRL", lambda value: not value & EV_YAW, "1 (no yaw)", "feed.circle"),
        FeedDemand("EKF2_EV_NOISE_MD", lambda value: value == 0, "0", "feed.covariance"),
    ),
}


def asked_of_feed(kind: int) -> tuple[str, ...]:
    """Relevant parameters of a MAV_AUTOPILOT."""
    names = dict.fromkeys(demand.name for demand in FEED_DEMANDS.get(kind, ()))
    if kind == ARDUPILOT_KIND:
        names |= dict.fromkeys(name for number in SOURCE_SETS for name in _of_set(number))
    return tuple(names)


def check_feed(kind: int | None, values: Mapping[str, float]) -> list[Finding]:
    """kind: MAV_AUTOPILOT, None without an autopilot; values: by name, as read."""
    demands = FEED_DEMANDS.get(kind, ()) if kind is not None else ()
    if kind is None or not demands:
        return []
    silent = [name for name in asked_of_feed(kind) if name not in values]
    findings = [
        fault(one.name_of_fault, parameter=one.name, value=f"{values[one.name]:g}", wanted=one.wanted)
        for one in demands
        if one.name in values and not one.is_met(int(values[one.name]))
    ]
    if kind == ARDUPILOT_KIND:
        findings += _sets(values)
    if silent:
        findings.append(fault("feed.unknown", names=", ".join(silent)))
    return findings or [ok("feed", "the autopilot's parameters take the place that we feed")]


def _sets(values: Mapping[str, float]) -> list[Finding]:
    """Of ArduPilot's sets of sources: one goes by us, and takes no heading from us."""
    known = [(_of_set(number), values.get(_of_set(number)[0])) for number in SOURCE_SETS]
    takers = [names for names, source in known if source == EXTERNAL_NAVIGATION]
    if takers:
        return [
            fault("feed.circle", parameter=yaw, value=f"{values[yaw]:g}", wanted="1 (compass)")
            for _, yaw in takers
            if values.get(yaw) == EXTERNAL_NAVIGATION
        ]
    told = [(name, source) for (name, _), source in known if source is not None]
    if not told:
        return []
    parameter, said = ", ".join(name for name, _ in told), ", ".join(f"{source:g}" for _, source in told)
    return [
        fault("feed.ignored", parameter=parameter, value=said, wanted="6 in one set, such as EK3_SRC2_POSXY")
    ]
