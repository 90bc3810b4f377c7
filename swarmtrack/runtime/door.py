"""The door to Onboard: whoever listens at it hears all that is needed to repeat the flight.

`docs/decisions/0012-the-door.md` tells why a recording holds these inputs and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from swarmtrack.follower import Engagement, Follower, LocalSetpoint
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Input, ScanReport, TrackList
from swarmtrack.onboard import Onboard, Output
from swarmtrack.perceived import Perceived


class DoorListener(Protocol):
    """Hears everything in the order in which it happens; must return at once."""

    def told(self, event: Input) -> None:
        """Before it is delivered."""
        ...

    def asked(self, tracks: TrackList) -> None:
        """Somebody asked for the tracks as of `tracks.t`, and got these."""
        ...

    def commanded(self, engagement: Engagement, told: LocalSetpoint) -> None:
        """A setpoint was asked for as of `told.setpoint.t`, and this is it."""
        ...

    def scanned(self, report: ScanReport, world_from_camera: Pose | None) -> None:
        """A scan was tracked; from there, in the team frame, where the drone knows that."""
        ...


class Door:
    """Onboard with a listener. What `perceived` shows may be read by anyone; what changes it comes through here."""

    def __init__(self, onboard: Onboard, follower: Follower | None = None) -> None:
        """follower: where the drone flies in formation."""
        self.listener: DoorListener | None = None
        self.perceived: Perceived = onboard
        self._onboard = onboard
        self._follower = follower

    def tell(self, event: Input) -> None:
        """`Onboard.tell`."""
        if self.listener is not None:
            self.listener.told(event)
        self._onboard.tell(event)

    def events(self) -> Sequence[Output]:
        """`Onboard.events`."""
        events = self._onboard.events()
        if self.listener is not None:
            for event in events:
                if isinstance(event, ScanReport):
                    self.listener.scanned(event, self._onboard.camera_pose(event.tracks.t))
        return events

    def tracks(self, now: float) -> TrackList:
        """`Onboard.tracks`, which may first track a scan that has waited for the gyro in vain."""
        tracks = self._onboard.tracks(now)
        if self.listener is not None:
            self.listener.asked(tracks)
        return tracks

    def command(self, now: float, engagement: Engagement) -> LocalSetpoint:
        """What a follower is to fly from now on; for that, too, a scan may be tracked that has waited in vain."""
        assert self._follower is not None, "flies in no formation"
        told = self._follower.command(self._onboard, self._onboard.tracks(now), engagement)
        if self.listener is not None:
            self.listener.commanded(engagement, told)
        return told
