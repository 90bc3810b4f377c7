"""Where teammates said last that they are: by announcements, and by the position in whatever they report since.

The announcement is all that a drone must say. Whoever also reports whom it sees says with it where it stands, once a
second; then its place is known when it comes into view, and nobody has to ask. Where sightings have shown how its frame
stands to ours, and otherwise than it announced, its places are those in our frame: the frame in which we see, however
our own heading is off.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import replace

import numpy as np

from swarmtrack.messages import Announcement, Array, SightingReport
from swarmtrack.relative.alignment import FrameTransform

# m: between the camera, whose position is reported, and the middle of its drone.
CAMERA_ARM = 0.1
# m and s: a report that knows less is no place.
VAGUE_POSITION, VAGUE_T = 3.0, 0.5
# A drone that says that it is so far from its pad has left it: of the sigma of a difference; and in m, however vague
# its place is: from one minute to the next a receiver wanders less, and no take-off ends lower.
LEFT_PAD, OFF_GROUND = 2.0, 1.0


class Whereabouts:
    """By drone, the announcement that was heard last, and the latest place.

    on_pad: who is still where its life announced itself first, on the ground. A drone may announce itself again there,
    because its heading made a step. Whoever has been elsewhere flies until it starts again, and so does one whose first
    announcement nobody heard.
    """

    def __init__(self) -> None:
        self.announced: dict[int, Announcement] = {}
        self.on_pad: set[int] = set()
        self._pads: dict[int, Announcement] = {}
        self._reported: dict[int, Announcement] = {}
        self._frames: dict[int, FrameTransform] = {}
        self._off: dict[int, float] = {}
        """By drone that was found elsewhere than it says: how far from there, m."""

    def announce(self, announcement: Announcement) -> None:
        """A drone's announcement, newer than the one before."""
        drone = announcement.drone_id
        if announcement.sequence <= 1:
            self._off.pop(drone, None)
            self._pads[drone] = announcement
            self.on_pad.add(drone)
        else:
            self._follow(drone, announcement.boot, announcement.position)
        self.announced[drone] = announcement
        self._reported.pop(drone, None)

    def report(self, report: SightingReport) -> None:
        """Where a drone reports itself. Of a life that has not announced itself, nothing is known of the frame."""
        said = self.announced.get(report.observer)
        if said is None or said.boot != report.boot:
            return
        vague = report.position_sigma > VAGUE_POSITION and report.observer not in self._frames
        if vague or report.t_sigma > VAGUE_T:
            return
        before = self.said(report.observer)
        if report.t <= before.t:
            return
        # The announcement tells how well the drone's frame is the team's, which no report can know better.
        variance = float(np.trace(said.position_cov)) / 3.0
        more = max(report.position_sigma**2 - variance, 0.0) + CAMERA_ARM**2
        cov = said.position_cov + more * np.eye(3)
        self._follow(report.observer, report.boot, report.position)
        self._reported[report.observer] = replace(
            said,
            t=report.t,
            t_sigma=report.t_sigma,
            position=report.position,
            position_cov=cov,
        )

    def forget(self, drone_id: int) -> None:
        """Nobody knows where it is."""
        self.announced.pop(drone_id, None)
        self._reported.pop(drone_id, None)
        self._off.pop(drone_id, None)
        self._frames.pop(drone_id, None)
        self.on_pad.discard(drone_id)

    def align(self, drone_id: int, frame: FrameTransform | None) -> None:
        """How the frame in which it says where it is stands to ours; None: as it says."""
        if frame is None:
            self._frames.pop(drone_id, None)
        else:
            self._frames[drone_id] = frame

    @property
    def aligned(self) -> Set[int]:
        """Whose places are those that its frame has in ours."""
        return self._frames.keys()

    @property
    def pads(self) -> dict[int, Array]:
        """(3,) m: where drones began, also those that know it no more."""
        return {drone: pad.position for drone, pad in self._pads.items()}

    def _follow(self, drone: int, boot: str, position: Array) -> None:
        """position (3,) m, team frame: where that life of the drone says that it is now."""
        if drone not in self.on_pad:
            return
        pad = self._pads[drone]
        sigma = (2.0 * float(np.trace(pad.position_cov)) / 3.0) ** 0.5
        moved = float(np.linalg.norm(position - pad.position))
        if pad.boot != boot or moved > min(LEFT_PAD * sigma, OFF_GROUND):
            self.on_pad.discard(drone)

    def latest(self, drone_id: int) -> Announcement:
        """The newest that is known of the place of a drone that has announced itself."""
        place = self.said(drone_id)
        frame = self._frames.get(drone_id)
        if frame is not None:
            position, cov = frame.place(place.position)
            return replace(
                place,
                position=position,
                world_from_body=frame.rotation @ place.world_from_body,
                position_cov=cov + CAMERA_ARM**2 * np.eye(3),
            )
        off = self._off.get(drone_id)
        return place if off is None else replace(place, position_cov=place.position_cov + off**2 * np.eye(3))

    def said(self, drone_id: int) -> Announcement:
        """The same by its own word alone, wherever it was found."""
        return self._reported.get(drone_id) or self.announced[drone_id]

    def doubt(self, drone_id: int, off_m: float) -> None:
        """It was found that far from where it says that it is; whatever it says of its place is wrong by as much."""
        self._off[drone_id] = max(off_m, self._off.get(drone_id, 0.0))
