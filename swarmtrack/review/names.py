"""Names that each observer gave over a flight, and the reasons for missing ones. Pure."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from swarmtrack.diagnosis.readiness import SELF_DOUBT
from swarmtrack.review.directions import place, predicted
from swarmtrack.review.flight import (
    ConfirmedLook,
    DroneFlight,
    NameSpan,
    Naming,
    ReviewedFlight,
    ReviewedScan,
)

SCAN_LASTS_S = 0.6  # s after a scan from which on nothing is known
IN_VIEW_SHARE = 0.92  # of half the field of view: a drone at the border is half seen
SAME_DRONE_DEG, OTHER_DRONE_DEG = 6.0, 15.0  # from a true direction: it is that one, or it is not


def namings(flight: ReviewedFlight, drone: DroneFlight) -> list[Naming]:
    """One for every teammate; made once for each flight."""
    if drone.drone_id not in flight.namings:
        flight.namings[drone.drone_id] = _namings(flight, drone)
    return flight.namings[drone.drone_id]


def _namings(flight: ReviewedFlight, drone: DroneFlight) -> list[Naming]:
    everybody = flight.drones.keys() | flight.truth.keys() | {who for _, who in drone.announced}
    return [
        Naming(drone.drone_id, teammate, _spans(flight, drone, teammate))
        for teammate in sorted(everybody - {drone.drone_id})
    ]


def _spans(flight: ReviewedFlight, drone: DroneFlight, teammate: int) -> tuple[NameSpan, ...]:
    spans: list[NameSpan] = []

    def add(begin: float, end: float, state: str, why: str) -> None:
        if spans and spans[-1].state == state and spans[-1].why == why and begin - spans[-1].end < 1e-3:
            spans[-1] = spans[-1]._replace(end=end)
        elif end > begin:
            spans.append(NameSpan(begin, end, state, why))

    if not drone.scans:
        return (NameSpan(drone.begin, drone.end, "blind", "no scan was recorded"),)
    add(drone.begin, drone.scans[0].t, "blind", "no frame was processed yet")
    ends = [scan.t for scan in drone.scans[1:]] + [drone.end]
    for scan, end in zip(drone.scans, ends, strict=True):
        state, why = _state(flight, drone, scan, teammate)
        until = min(end, scan.t + SCAN_LASTS_S)
        add(scan.t, until, state, why)
        if end > until:
            add(until, end, "blind", _why_blind(drone, until))
    return tuple(spans)


def _state(flight: ReviewedFlight, drone: DroneFlight, scan: ReviewedScan, teammate: int) -> tuple[str, str]:
    named = next((look for look in scan.looks if look.identity == teammate), None)
    if named is not None:
        whom = _true_one(flight, drone, scan, named)
        if whom is not None and whom != teammate:
            return "wrong", f"it is drone {whom}"
        return "named", ""
    free = [look for look in scan.looks if look.identity is None]
    where = place(drone, teammate, scan.t)
    if where is None:
        if not any(who == teammate and t <= scan.t for t, who in drone.announced) and drone.recorded:
            return ("unnamed" if free else "away"), "it has not announced itself yet"
        gone = [there for t, who, there in drone.alive if who == teammate and t <= scan.t]
        if gone and not gone[-1]:
            return "away", "it is gone"
        return ("unnamed" if free else "away"), "no report of its position arrives"
    if not _in_view(drone, scan, where):
        return "away", "out of view"
    if not free:
        return "undetected", "in view by its report, and no track"
    return "unnamed", _why_unnamed(drone, scan.t, free)


def _in_view(drone: DroneFlight, scan: ReviewedScan, where: object) -> bool:
    for camera, lens in enumerate(drone.lenses):
        at = predicted(drone, scan, np.asarray(where), camera)
        if at is not None and all(
            abs(angle) < IN_VIEW_SHARE * math.atan(half)
            for angle, half in zip(at, lens.half_field, strict=True)
        ):
            return True
    return False


def _why_unnamed(drone: DroneFlight, t: float, free: list[ConfirmedLook]) -> str:
    """The reason that the drone's health states at t, else what the track lacks."""
    message = next((message for at, message in reversed(drone.health) if at <= t + 1.0), None)
    if message is not None:
        reasons = message.readiness.reasons if message.readiness is not None else ()
        if any(reason.startswith(SELF_DOUBT) for reason in reasons):
            return SELF_DOUBT.replace("our own", "its own")
        if message.readiness is not None and not message.readiness.ready and reasons:
            return reasons[0]
    if any(at <= t for at, _, _ in drone.clashes):
        return "two agents have one ID"
    return f"its track is not sure enough of any name (p = {max(look.probability for look in free):.2f})"


def _why_blind(drone: DroneFlight, t: float) -> str:
    for (a, message), (b, _) in pairwise([*drone.health, (math.inf, None)]):
        if message is not None and a <= t + 1.5 and t < b + 1.5:
            bad = next((link for link in message.links if not link.ok), None)
            if bad is not None:
                return f"{bad.name}: {bad.text}"
    return "no frame was processed"


def _true_one(
    flight: ReviewedFlight, drone: DroneFlight, scan: ReviewedScan, look: ConfirmedLook
) -> int | None:
    """Whom a named track shows by the truth; None where that is not clear."""
    here = flight.true_place(drone.drone_id, scan.t)
    if here is None or look.position is None:
        return None
    towards = look.position / max(float(np.linalg.norm(look.position)), 1e-6)
    off: dict[int, float] = {}
    for other in flight.truth:
        there = flight.true_place(other, scan.t)
        if other != drone.drone_id and there is not None:
            ray = (there - here) / max(float(np.linalg.norm(there - here)), 1e-6)
            off[other] = math.degrees(math.acos(min(1.0, max(-1.0, float(ray @ towards)))))
    nearest = min(off, key=lambda other: off[other], default=None)
    called = off.get(look.identity, math.inf) if isinstance(look.identity, int) else math.inf
    if nearest is None or off[nearest] > SAME_DRONE_DEG or called < OTHER_DRONE_DEG:
        return None
    return nearest
