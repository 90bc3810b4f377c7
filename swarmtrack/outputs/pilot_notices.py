"""What the autopilot is told, and by way of it the ground station: `[autopilot] tell` (docs/telling.md).

These messages are for people, and for programs that only look. One can make a vehicle evade, ADSB_VEHICLE: it is sent
only where the config asks for it.
"""

from __future__ import annotations

import asyncio
import math
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.notices import (
    LONGEST_CALLSIGN,
    MOST_DEVICES,
    Severity,
    adsb_vehicle,
    image_status,
    named_value,
    status_text,
)
from swarmtrack.clock import Clock
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.identity.consensus import Disagreement
from swarmtrack.messages import (
    Array,
    DoubtNews,
    IdClash,
    IdentifiedTrack,
    PeerDeparted,
    PeerEvent,
    PeerExpelled,
    ScanReport,
    SightingReport,
    TrackStatus,
)
from swarmtrack.outputs import periods
from swarmtrack.outputs.drawing import SeenTrack, as_seen
from swarmtrack.outputs.status_lines import Debounced, StatusLines
from swarmtrack.outputs.teammates_on_earth import TeammatesOnEarth
from swarmtrack.outputs.wording import place_in_words
from swarmtrack.perceived import PilotView
from swarmtrack.wire.health import LinkHealth

NETWORKS = ("zenoh", "memory")  # names of links to the team
# Name of the number of teammates in view.
TRACK_COUNT_NAME = "trk_n"
BLIND_AFTER = 1.0  # s without a scan: what was seen then is not seen now
NOTICE_HOLD_S = 3.0  # s that a source must be away, or back, to be news
# s likewise for how many teammates are seen; drones fly in and out of view, so not more often than every REST.
SIGHT_HOLD, SIGHT_REST = 2.0, 10.0


class PilotNotices:
    """Sends notices on scans and events to the autopilot.

    autopilot: None where there is none that can be spoken to. tell: what of, as in the config. origin: of the team
    frame on the Earth. clock: the flight's, of reports; wall: the machine's, of what is said how often.
    """

    def __init__(
        self,
        autopilot: MavlinkAutopilot | None,
        tell: Collection[str],
        perceived: PilotView,
        lenses: Sequence[PinholeCamera],
        *,
        drone_id: int,
        boot: str,
        team: str,
        origin: Geodetic | None,
        clock: Clock,
        wall: Clock,
    ) -> None:
        self.lines = StatusLines()
        self._autopilot = autopilot if tell else None
        self._drone_id = drone_id
        self._boot = boot
        self._team = team
        self._perceived = perceived
        self._lenses = lenses
        self._clock = clock
        self._wall = wall
        self._texts, self._boxes = "status" in tell, "camera_tracking" in tell
        self._tells_places = "teammates" in tell
        self._place_at = -math.inf
        self._place_of = 0
        """Drone whose position was in the last text."""
        self._scan: ScanReport | None = None
        self._scan_at = -math.inf
        self._links: Mapping[str, bool] = {}
        self._ready = False
        self._camera = Debounced(True, hold=NOTICE_HOLD_S)
        self._each_camera: dict[str, Debounced[bool]] = {}
        """Of several, by the names of their links."""
        self._network = Debounced(True, hold=NOTICE_HOLD_S)
        self._trouble = Debounced("", hold=NOTICE_HOLD_S)
        self._sight = Debounced((0, 0), hold=SIGHT_HOLD, rest=SIGHT_REST)
        self._number_at = -math.inf
        self._texts_sent = 0
        # Of each camera: the track whose box is told, and when it was last said that there is none.
        self._shown: dict[int, int | None] = {}
        self._idle_at: dict[int, float] = {}
        self._told_of = 0
        # A config that asks for "adsb" has an origin.
        self._positions = TeammatesOnEarth(origin) if origin is not None and "adsb" in tell else None
        self._positions_at = -math.inf

    # ── what happens ─────────────────────────────────────────────────────────────────────────────────────────────

    def on_scan(self, report: ScanReport) -> None:
        """A scan was tracked."""
        self._scan, self._scan_at = report, self._wall.now()

    def see_links(self, links: Iterable[LinkHealth]) -> None:
        """How everything is that this agent is connected to, as in the health."""
        self._links = {link.name: link.ok for link in links}

    def on_peer(self, event: PeerEvent) -> None:
        """Something about a teammate."""
        match event:
            case PeerDeparted(drone_id=drone_id):
                self.add(Severity.WARNING, f"drone {drone_id} is gone")
            case PeerExpelled(drone_id=drone_id):
                self.add(Severity.WARNING, f"drone {drone_id} left the roster")
            case IdClash(drone_id=drone_id, ours=True):
                self.add(Severity.ERROR, f"another agent is drone {drone_id} too")
            case IdClash(drone_id=drone_id):
                self.add(Severity.WARNING, f"two agents are drone {drone_id}")
            case SightingReport() if self._positions is not None:
                self._positions.on_report(event)

    def on_doubt(self, news: DoubtNews) -> None:
        """What the drone sees does not fit where it thinks it is, or does again."""
        if news.doubted:
            self.add(Severity.WARNING, "own start or heading is wrong")
        else:
            self.add(Severity.INFO, "own start and heading fit again")

    def on_disagreement(self, found: Disagreement) -> None:
        """A teammate sees a drone elsewhere than we do."""
        self.add(Severity.WARNING, f"drone {found.observer} disputes drone {found.drone_id}")

    def add(self, severity: Severity, text: str) -> None:
        """A line for the pilot."""
        if self._autopilot is not None and self._texts:
            self._add(severity, text)

    def _add(self, severity: Severity, text: str) -> None:
        self.lines.add(severity, f"swarmtrack: {text}", self._wall.now())

    # ── what is said ─────────────────────────────────────────────────────────────────────────────────────────────

    async def run(self) -> None:
        """Until cancelled; returns without a recipient."""
        while self._autopilot is not None:
            await asyncio.sleep(periods.BOX)
            self.tick(self._wall.now())

    def tick(self, now: float) -> None:
        """Say what is due."""
        if self._autopilot is None:
            return
        if self._texts and now - self._number_at >= periods.TEAMMATES_IN_VIEW:
            self._number_at = now
            named = len({entry.identity for entry in self._named(now)})
            self._look_for_news(named, now)
            self._autopilot.send_message(named_value(now, TRACK_COUNT_NAME, named))
        if self._tells_places and now - self._place_at >= periods.PLACE_TEXTS:
            self._place_at = now
            self._tell_next_place(now)
        self._say_line(now)
        if self._boxes:
            self._show(now)
        if self._positions is not None and now - self._positions_at >= periods.REPORTED_POSITIONS:
            self._positions_at = now
            self._tell_positions(self._positions, now)

    def _named(self, now: float) -> tuple[IdentifiedTrack, ...]:
        """The teammates in view that have a name."""
        if self._scan is None or now - self._scan_at > BLIND_AFTER:
            return ()
        return tuple(
            entry
            for entry in self._scan.tracks.tracks
            if entry.track.status is TrackStatus.CONFIRMED and isinstance(entry.identity, int)
        )

    def _look_for_news(self, named: int, now: float) -> None:
        assert self._autopilot is not None
        trouble = self._autopilot.trouble
        if not self._links or trouble == "no autopilot":
            return  # not looked at yet; or it would not hear us
        cameras = {
            name: ok for name, ok in self._links.items() if name == "camera" or name.startswith("camera ")
        }
        camera = not cameras or any(cameras.values())
        network = all(ok for name, ok in self._links.items() if name in NETWORKS)
        if not self._ready:
            self._ready = self._scan is not None and camera and not trouble
            if self._ready:
                self.add(Severity.INFO, f"ready, drone {self._drone_id}")
        if self._camera.is_news(camera, now):
            self._say_of("" if camera else "no camera", "camera")
        # Of none at all that was all there is to say.
        if camera and len(cameras) > 1:
            for name, ok in cameras.items():
                each = self._each_camera.setdefault(name, Debounced(True, hold=NOTICE_HOLD_S))
                if each.is_news(ok, now):
                    self._say_of("" if ok else f"{name} gone", name)
        if self._network.is_news(network, now):
            self._say_of("" if network else "no network", "network")
        before = self._trouble.told
        if self._trouble.is_news(trouble, now):
            self._say_of(trouble, before.removeprefix("no "))
        team = len(self._perceived.teammates)
        if self._sight.is_news((named, team), now):
            self.add(Severity.INFO, f"sees {named} of {team}")

    def _say_of(self, trouble: str, what: str) -> None:
        if trouble:
            self.add(Severity.WARNING, trouble)
        else:
            self.add(Severity.INFO, f"{what} is there")

    def _say_line(self, now: float) -> None:
        line = self.lines.next(now)
        if line is None or self._autopilot is None:
            return
        number = self._texts_sent % 65535 + 1
        if all(self._autopilot.send_message(m) for m in status_text(line.severity, line.text, number)):
            self._texts_sent += 1
            self.lines.mark_sent()

    def _tell_positions(self, positions: TeammatesOnEarth, now: float) -> None:
        """Teammates on the map: each where we measure it, else where it says that it is and our camera sees it."""
        assert self._autopilot is not None
        own = self._perceived.sighting_report(self._boot, 0)
        motion = self._perceived.motion_report(self._boot, 0)
        for found in positions.in_view(self._named(now), own, motion, self._clock.now()):
            address = _address(self._team, found.drone_id)
            callsign = _callsign(found.drone_id, found.sigma)
            self._autopilot.send_message(
                adsb_vehicle(callsign, found.place, found.age, address, found.velocity)
            )

    def _tell_next_place(self, now: float) -> None:
        """Where one teammate is, as a text: they take turns."""
        places = {
            entry.relative.drone_id: words
            for entry in self._named(now)
            if entry.relative is not None and (words := place_in_words(entry.relative))
        }
        if places:
            self._place_of = min(places, key=lambda drone_id: (drone_id <= self._place_of, drone_id))
            self._add(Severity.INFO, places[self._place_of])

    def _show(self, now: float) -> None:
        """The box of one teammate in one camera's image: the message has room for one. Of each camera the largest, for
        as long as it has a name. Cameras that have something to say take turns."""
        assert self._autopilot is not None
        count = min(len(self._lenses), MOST_DEVICES)
        boxed: list[dict[int, IdentifiedTrack]] = [{} for _ in range(count)]
        for entry in self._named(now):
            if entry.track.camera < count and np.isfinite(entry.track.size).all():
                boxed[entry.track.camera][entry.track.id] = entry
        in_turn = [(self._told_of + 1 + k) % count for k in range(count)]
        idle = [now - self._idle_at.get(k, -math.inf) >= periods.TEAMMATES_IN_VIEW for k in range(count)]
        camera = next((k for k in in_turn if boxed[k] or idle[k]), None)
        if camera is None:
            return
        self._told_of = camera
        device = camera + 1 if len(self._lenses) > 1 else 0
        seen = boxed[camera]
        shown = self._shown.get(camera)
        if shown not in seen:
            shown = max(seen, key=lambda i: float(seen[i].track.size.prod()), default=None)
        self._shown[camera] = shown
        if shown is None or self._scan is None:
            self._idle_at[camera] = now
            self._autopilot.send_message(image_status(None, device))
            return
        self._idle_at[camera] = -math.inf
        one = self._scan._replace(tracks=replace(self._scan.tracks, tracks=(seen[shown],)))
        for track in as_seen(one, *self._lenses):
            self._autopilot.send_message(image_status(_corners(track, self._lenses[camera]), device))


def _address(team: str, drone_id: int) -> int:
    """24 bits that are the same on every drone and in every flight, as an ICAO address is; 0 is nobody's."""
    return zlib.crc32(f"{team}/{drone_id}".encode()) % 0xFFFFFF + 1


def _callsign(drone_id: int, sigma: float | None) -> str:
    """Name on the map, with the quality of the position: `ST2 1m` is measured to 1 m, `ST2?` the drone's own report.

    sigma: m, or None. A name too long for the metres goes without.
    """
    name = f"ST{drone_id}"
    if sigma is None:
        return f"{name}?"
    measured = f"{name} {math.ceil(sigma)}m"
    return measured if len(measured) <= LONGEST_CALLSIGN else name


def _corners(track: SeenTrack, lens: PinholeCamera) -> Array:
    """Top left and bottom right of a box, (2, 2), as shares of the image's width and height."""
    half = 0.5 * track.size
    # Pixel centres are whole numbers: the image begins half a pixel before the first.
    corners = np.array((track.centre - half, track.centre + half)) + 0.5
    return np.asarray(corners / (lens.width, lens.height))
