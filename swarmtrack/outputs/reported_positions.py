"""Where teammates say they are, for as long as our own camera sees them there."""

from __future__ import annotations

from typing import NamedTuple

from swarmtrack.geometry.geodesy import Geodetic, from_ned
from swarmtrack.identity.consensus import stands_there
from swarmtrack.messages import SightingReport
from swarmtrack.outputs import periods

FRESH = 2.5 * periods.IDENTITIES
MANY_TEAMMATES = 256  # teammates remembered: more is a flood


class ReportedPosition(NamedTuple):
    """age: s since it held."""

    drone_id: int
    position: Geodetic
    age: float


class ReportedPositions:
    """Takes teammates' reports. One camera measures no range: a position is the drone's own report, and our ray the
    check.

    origin: of the team frame on the Earth.
    """

    def __init__(self, origin: Geodetic) -> None:
        self._origin = origin
        self._reports: dict[int, SightingReport] = {}

    def on_report(self, report: SightingReport) -> None:
        """A teammate says where it stands."""
        if report.observer in self._reports or len(self._reports) < MANY_TEAMMATES:
            self._reports[report.observer] = report

    def in_view(self, own: SightingReport | None, now: float) -> list[ReportedPosition]:
        """Reported positions of the teammates seen there; own: what this drone sees and where it stands."""
        self._reports = {i: report for i, report in self._reports.items() if now - report.t < FRESH}
        if own is None or now - own.t > FRESH:
            return []
        return [
            ReportedPosition(ray.drone_id, from_ned(report.position, self._origin), max(now - report.t, 0.0))
            for ray in own.sightings
            if (report := self._reports.get(ray.drone_id)) is not None and stands_there(own, ray, report)
        ]
