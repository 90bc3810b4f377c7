"""Where teammates in view are on the Earth: as measured where that is known well, else as they say themselves."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.messages import Array, IdentifiedTrack, MotionReport, RelativeState, SightingReport
from swarmtrack.outputs.reported_positions import ReportedPositions

# m and m/s, one sigma along the worst axis, own place and motion included: what is known worse is not told as measured.
FIRM_PLACE, FIRM_VELOCITY = 3.0, 1.0
# s: of two times that are one scan's; and between a scan and our own velocity.
SAME_SCAN, SAME_TIME = 1e-3, 0.5


class PlaceOnEarth(NamedTuple):
    """age: s since it held. velocity (3,) m/s north, east, down over the ground; None where it is not known.

    sigma: m, along the worst axis, our own position's included; None: the teammate's own report, on our ray.
    """

    drone_id: int
    place: Geodetic
    age: float
    velocity: Array | None
    sigma: float | None


class TeammatesOnEarth:
    """Takes teammates' reports. origin: of the team frame on the Earth."""

    def __init__(self, origin: Geodetic) -> None:
        self._origin = origin
        self._reported = ReportedPositions(origin)

    def on_report(self, report: SightingReport) -> None:
        """A teammate says where it stands."""
        self._reported.on_report(report)

    def in_view(
        self,
        named: Iterable[IdentifiedTrack],
        own: SightingReport | None,
        motion: MotionReport | None,
        now: float,
    ) -> list[PlaceOnEarth]:
        """Positions of the last scan's named tracks and of the other sightings in own; each teammate once.

        own: from where, at the last scan; motion: how this drone moves; None where it does not know.
        """
        found: dict[int, PlaceOnEarth] = {}
        if own is not None:
            for entry in sorted(named, key=lambda entry: entry.identity_probability):
                state = entry.relative
                if state is not None and abs(state.t - own.t) <= SAME_SCAN:
                    place = self._measured(state, own, motion, now)
                    if place.sigma is not None and place.sigma < FIRM_PLACE:
                        found[state.drone_id] = place
        for said in self._reported.in_view(own, now):
            if said.drone_id not in found:
                found[said.drone_id] = PlaceOnEarth(
                    said.drone_id, said.position, said.age, velocity=None, sigma=None
                )
        return list(found.values())

    def _measured(
        self, state: RelativeState, own: SightingReport, motion: MotionReport | None, now: float
    ) -> PlaceOnEarth:
        velocity = None
        if motion is not None and abs(motion.t - state.t) < SAME_TIME:
            speed_sigma = worst_sigma(state.cov[3:, 3:] + motion.velocity_cov)
            velocity = state.velocity + motion.velocity if speed_sigma < FIRM_VELOCITY else None
        place = from_ned(own.position + state.position, self._origin)
        sigma = math.hypot(worst_sigma(state.cov[:3, :3]), own.position_sigma)
        return PlaceOnEarth(state.drone_id, place, max(now - state.t, 0.0), velocity, sigma)


def worst_sigma(cov: Array) -> float:
    """One sigma along the worst axis of (3, 3)."""
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(cov)[-1])))
