"""Where teammates said last that they are: by announcements, and by the position in whatever they report since.

The announcement is all that a drone must say. Whoever also reports whom it sees says with it where it stands, once a
second; then its place is known when it comes into view, and nobody has to ask.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from swarmtrack.messages import Announcement, SightingReport

# m: between the camera, whose position is reported, and the middle of its drone.
CAMERA_ARM = 0.1
# m and s: a report that knows less is no place.
VAGUE_POSITION, VAGUE_T = 3.0, 0.5
# Of the sigma of a difference: a drone that reports itself so far from its pad has left it.
LEFT_PAD = 2.0


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
        if report.position_sigma > VAGUE_POSITION or report.t_sigma > VAGUE_T:
            return
        before = self.latest(report.observer)
        if report.t <= before.t:
            return
        # The announcement tells how well the drone's frame is the team's, which no report can know better.
        variance = float(np.trace(said.position_cov)) / 3.0
        more = max(report.position_sigma**2 - variance, 0.0) + CAMERA_ARM**2
        cov = said.position_cov + more * np.eye(3)
        moved = float(np.linalg.norm(report.position - before.position))
        left = before.sequence > 1 or moved > LEFT_PAD * (2.0 * variance) ** 0.5
        self._reported[report.observer] = replace(
            said,
            sequence=max(said.sequence, 2) if left else said.sequence,
            t=report.t,
            t_sigma=report.t_sigma,
            position=report.position,
            position_cov=cov,
        )

    def forget(self, drone_id: int) -> None:
        """Nobody knows where it is."""
        self.announced.pop(drone_id, None)
        self._reported.pop(drone_id, None)

    def latest(self, drone_id: int) -> Announcement:
        """The newest that is known of the place of a drone that has announced itself."""
        return self._reported.get(drone_id) or self.announced[drone_id]
