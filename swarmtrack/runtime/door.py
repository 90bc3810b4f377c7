"""The one door to Onboard: whatever changes it comes through here, so whoever listens can repeat the flight.

`docs/decisions/0012-the-door.md` tells why a recording holds these inputs and nothing else.
"""

from __future__ import annotations

from typing import Protocol

from swarmtrack.messages import (
    Announcement,
    AutopilotRebooted,
    Detections,
    EgoPose,
    IdClash,
    ImuSample,
    Input,
    PeerArrived,
    PeerDeparted,
    SightingReport,
    TrackList,
)
from swarmtrack.onboard import Onboard, ScanReport


class DoorListener(Protocol):
    """Hears everything in the order in which it happens; must return at once."""

    def told(self, event: Input) -> None:
        """Before it is delivered."""
        ...

    def asked(self, tracks: TrackList) -> None:
        """Somebody asked for the tracks as of `tracks.t`, and got these."""
        ...

    def scanned(self, report: ScanReport) -> None:
        """A scan was tracked."""
        ...


class Door:
    """Delivers to Onboard and takes from it; reading what changes nothing needs no door."""

    def __init__(self, onboard: Onboard) -> None:
        self.listener: DoorListener | None = None
        self._onboard = onboard

    def tell(self, event: Input) -> None:
        """Something happened."""
        if self.listener is not None:
            self.listener.told(event)
        onboard = self._onboard
        match event:
            case ImuSample():
                onboard.on_imu(event)
            case EgoPose():
                onboard.on_pose(event)
            case Detections():
                onboard.on_detections(event)
            case SightingReport():
                onboard.on_sightings(event)
            case Announcement():
                onboard.on_announcement(event)
            case PeerArrived() | PeerDeparted() | IdClash():
                onboard.on_membership(event)
            case AutopilotRebooted():
                onboard.on_autopilot_reboot()

    def tracks(self, now: float) -> TrackList:
        """`Onboard.tracks`, which may first track a scan that has waited for the gyro in vain."""
        tracks = self._onboard.tracks(now)
        if self.listener is not None:
            self.listener.asked(tracks)
        return tracks

    def take_reports(self) -> list[ScanReport]:
        """`Onboard.take_reports`."""
        reports = self._onboard.take_reports()
        if self.listener is not None:
            for report in reports:
                self.listener.scanned(report)
        return reports
