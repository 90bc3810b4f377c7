"""Where two drones hide each other, or the camera turns unmeasured, tracks may change places unseen."""

from __future__ import annotations

from collections.abc import Iterable

from swarmtrack.identity.assignment import HIDDEN_LOG_ODDS, Assignment
from swarmtrack.identity.boxes import meet
from swarmtrack.identity.names import Names
from swarmtrack.identity.pose_requests import PoseRequests
from swarmtrack.identity.standing import Event, Standing
from swarmtrack.identity.weighing import Weighing

# s without a detection: no longer a miss.
HIDDEN_S = 0.25
# s without a detection: after longer a track may have taken up anything.
ALONE_S = 1.0
# s between two questions to drones that keep hiding each other.
VERIFY_S = 1.0


class OcclusionWatch:
    """Told of every scan."""

    def __init__(self, names: Names, weighing: Weighing, pose_requests: PoseRequests) -> None:
        self._names = names
        self._weighing = weighing
        self._pose_requests = pose_requests

    def look(self, t: float) -> None:
        """A drone that is not detected may be taken for one near it. If that lasts, its ID is doubted once the track
        is detected again. Where nothing came near, how it moved before still tells who it is."""
        for held in self._names:
            since = self._names.alive[held.track_id].coasting_since
            if since is not None:
                near = self._touching(held)
                held.met |= self._drones(near)
                held.missed_alone &= t - since < ALONE_S and not near
                if t - since >= HIDDEN_S:
                    self._names.fire(held, Event.UNDETECTED)
                continue
            alone, held.missed_alone = held.missed_alone, True
            if held.standing is Standing.HIDDEN:
                self._names.fire(held, Event.DETECTED_AGAIN)
                if not alone or self._touching(held):
                    self._weaken(held)
                self.verify(held, t)
            elif held.met:
                still_near = held.met & self._drones(self._touching(held))
                if t - held.verified_t >= VERIFY_S or not still_near:
                    self.verify(held, t)
                    held.met = still_near

    def turn_unmeasured(self) -> None:
        """Each track may have taken up another's detections: what was believed of it says nothing any more."""
        for held in self._names:
            if held.standing in (Standing.SETTLED, Standing.CHALLENGED):
                self._names.fire(held, Event.RIVALLED)
            held.weaken(0.0)
            self._weighing.hide(held.track_id, 0.0)

    def verify(self, held: Assignment, t: float) -> None:
        """Ask it and those it met while one of them was not seen: their tracks may have changed places."""
        held.verified_t = t
        for drone in {*held.met, held.drone_id} if held.met else ():
            self._pose_requests.put(drone)
            holder = self._names.holder(drone)
            if holder is not None:
                self._weaken(holder)

    def _weaken(self, held: Assignment) -> None:
        held.weaken(HIDDEN_LOG_ODDS)
        self._weighing.hide(held.track_id, HIDDEN_LOG_ODDS)

    def _touching(self, held: Assignment) -> list[int]:
        """The other tracks, named or not, that nearly touch this one."""
        own = self._names.alive[held.track_id]
        others = (track for track in self._names.alive.values() if track.camera == own.camera)
        return [track.id for track in others if track.id != own.id and meet(own, track)]

    def _drones(self, tracks: Iterable[int]) -> set[int]:
        """Those that are named."""
        return {name.drone_id for track in tracks if (name := self._names.of(track)) is not None}
