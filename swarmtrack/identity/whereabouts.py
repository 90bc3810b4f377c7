"""Where teammates said last that they are: by announcements, and by the position in whatever they report since.

The announcement is all that a drone must say. Whoever also reports whom it sees says with it where it stands, once a
second: then nobody has to ask it.
"""

from __future__ import annotations

from dataclasses import replace

from swarmtrack.messages import Announcement, SightingReport

# m and s: a report that knows less is no place.
VAGUE_POSITION_M, VAGUE_T_S = 3.0, 0.5


class Whereabouts:
    """By drone, the announcement that was heard last, and the latest place."""

    def __init__(self) -> None:
        self.announced: dict[int, Announcement] = {}
        self._reported: dict[int, Announcement] = {}

    def announce(self, announcement: Announcement) -> None:
        """A drone's announcement, newer than the one before."""
        self.announced[announcement.drone_id] = announcement
        self._reported.pop(announcement.drone_id, None)

    def report(self, report: SightingReport) -> None:
        """Where a drone reports itself. Of a life that has not announced itself, nothing is known of the frame."""
        said = self.announced.get(report.observer)
        if said is None or said.boot != report.boot:
            return
        if report.position_sigma > VAGUE_POSITION_M or report.t_sigma > VAGUE_T_S:
            return
        if report.t > self.latest(report.observer).t:
            self._reported[report.observer] = replace(
                said, t=report.t, t_sigma=report.t_sigma, position=report.position
            )

    def forget(self, drone_id: int) -> None:
        """Nobody knows where it is."""
        self.announced.pop(drone_id, None)
        self._reported.pop(drone_id, None)

    def latest(self, drone_id: int) -> Announcement:
        """The newest that is known of the place of a drone that has announced itself."""
        return self._reported.get(drone_id) or self.announced[drone_id]
