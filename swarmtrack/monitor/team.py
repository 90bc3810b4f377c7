"""State of a team from its messages, as the page shows it: live drones, their health, and events."""

from __future__ import annotations

import json
import logging
import math
import re
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.cameras.field_of_view import half_angles
from swarmtrack.clock import Clock, utc_offset
from swarmtrack.geometry.rotation import from_quaternion
from swarmtrack.messages import FOREIGN
from swarmtrack.monitor.drone_cameras import CameraView, DroneCameras, ViewKey
from swarmtrack.monitor.metres import MAPPED, metres, strangers
from swarmtrack.monitor.verdict import Reports, TeamVerdict
from swarmtrack.outputs.flight_end import FlightEnd
from swarmtrack.outputs.wording import held_in_words
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.limits import REPORTED_CLOCKS_AGREE_S
from swarmtrack.transport.sender_clock import SenderClock
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import AnnouncementMessage
from swarmtrack.wire.camera import CameraMessage
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.codec import Message
from swarmtrack.wire.health import HealthMessage, LatencyHealth, RateHealth
from swarmtrack.wire.lens import LensMessage, camera_from
from swarmtrack.wire.sightings import SightingsMessage, report_from
from swarmtrack.wire.strangers import StrangersMessage
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage

log = logging.getLogger(__name__)

START_ONE = "start one: swarmtrack sim --monitor; another team: --team"
STARTING = "its agents are starting"
MAX_MONITORED_DRONES = 1024  # beyond it is an attack or a mistake
DRONE_SILENT_S = 2.0  # s without a word: gone, whatever its token says
DRONE_FORGOTTEN_S = 600.0  # s after which a drone that went is listed no more
STRANGERS_SHOWN_S = 1.5  # s after the last report: four were due
VIEW_S = 2.0  # s that a view says where a camera looks
HISTORY = 60  # health messages, for the lines: a minute
TRACKS_KEPT = 64  # messages, to find those of a frame's instant among: a second and more
TEAM_EVENTS_KEPT = 200
EVENTS_SHOWN = 60
JUDGING_S = 0.5  # s: reports come once a second, and thirty drones' cost 20 ms to judge
PLACED = {"leader", "slot_north_m", "slot_east_m", "engaged"}  # what a follower tells of itself
COURSE_S = 1.0  # between two entries of a drone's course
COURSE_KEPT = 60  # entries: a minute, as of the lines of its health
NAMED_OVER = 3  # entries, over which it is judged how many are named
SLOW = 0.7  # of the rate that was asked for
TEAM_SETTLED_S = 5.0  # s of an agent's life, after which it is judged by its rates
STEEP = 0.2  # length of a camera's axis seen from above, below which it looks up or down


class Moment(NamedTuple):
    """One entry of a drone's course. place: north and east, m; named, wrong: of those in view."""

    place: tuple[float, float] | None
    named: int
    in_view: int
    wrong: int


class SeenDrone(NamedTuple):
    """What a drone says of where it is and what it sees. position: of its camera, m in the team's frame; views: the
    fresh ones by camera."""

    drone_id: int
    position: tuple[float, ...] | None
    tracks: TracksMessage | None
    views: dict[int, VideoMessage]


@dataclass(slots=True)
class Drone:
    """State of one drone. Times are on our monotonic clock."""

    boots: set[str] = field(default_factory=set)
    boot: str = ""
    heard: float = -math.inf
    gone_since: float | None = None
    clock: SenderClock = field(default_factory=SenderClock)
    announcement: AnnouncementMessage | None = None
    tracks: deque[TracksMessage] = field(default_factory=lambda: deque(maxlen=TRACKS_KEPT))
    unread: bytes | None = None
    """The newest tracks, where they are not among those."""
    tracked_at: float = -math.inf
    health: HealthMessage | None = None
    history: deque[tuple[float, ...]] = field(default_factory=lambda: deque(maxlen=HISTORY))
    in_view: tuple[int, int] = (0, 0)
    """How many teammates it names, and how many drones it tracks that nobody calls a stranger."""
    course: deque[Moment] = field(default_factory=lambda: deque(maxlen=COURSE_KEPT))
    rig: DroneCameras | None = None
    """Of a drone with several cameras that told of them."""
    views: dict[int, tuple[float, VideoMessage]] = field(default_factory=dict)
    """The newest of each camera, and when it came."""
    view_at: float = -math.inf
    told_events: tuple[str, ...] = ()
    strangers: StrangersMessage | None = None
    strangers_at: float = -math.inf
    """The newest, and when it came."""

    def forget_what_it_said(self) -> None:
        """Reset to a drone that is alive and has sent nothing yet."""
        self.announcement = self.unread = self.health = self.rig = None
        self.in_view = (0, 0)
        self.tracks.clear()
        self.course.clear()
        self.history.clear()
        self.views.clear()
        self.told_events = ()
        self.strangers = None


class MonitoredTeam:
    """Takes samples; returns the state. Only the event loop may call.

    Messages are not trusted. Content that passes the wire's checks and still cannot be shown is left out, counted and
    logged once (`leaves_out`): a message of one drone never ends the page.
    """

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self.unreadable = 0
        self._odd: Counter[str] = Counter()
        """How often something readable could not be shown, by what it was."""
        self.starting = False
        """Whether somebody is starting drones."""
        self.hint = ""
        """Whom one could hear instead, while nobody of this team is there."""
        self._clock = clock
        self._drones: dict[int, Drone] = {}
        self._reports = Reports()
        self._events: deque[dict[str, Any]] = deque(maxlen=TEAM_EVENTS_KEPT)
        self._event_count = 0
        self._light = ""
        self._verdict = TeamVerdict((), ())
        self._judged_at = self._coursed_at = -math.inf

    def on_sample(self, sample: Sample) -> CameraView | None:
        """Add a sample; a view is also returned."""
        address = keys.parse(sample.key)
        if address is None or address.team != self.name:
            return None
        with self.leaves_out(f"a message ({address.kind.value})", address.drone_id):
            return self._take_in(address, sample)
        return None

    @contextmanager
    def leaves_out(self, what: str, drone_id: int | None = None) -> Iterator[None]:
        """Around what shows the words of drones: whatever it raises is counted, and said once for each `what`."""
        try:
            yield
        except Exception as error:  # whatever an odd word leads to, which nobody thought of
            self._odd[what] += 1
            if self._odd[what] == 1:
                whose = "" if drone_id is None else f" of drone {drone_id}"
                log.warning("%s%s is left out, it cannot be shown: %r", what, whose, error)

    def _take_in(self, address: keys.Address, sample: Sample) -> CameraView | None:
        drone = self._drones.get(address.drone_id)
        if drone is None:
            if len(self._drones) >= MAX_MONITORED_DRONES or (address.kind is Kind.ALIVE and not sample.alive):
                return None
            drone = Drone()  # listed once it is understood
        if address.kind is Kind.ALIVE:
            self._on_token(address.drone_id, drone, address.rest, sample)
            return None
        if address.kind is Kind.TRACKS and sample.arrived - drone.view_at > VIEW_S:
            # Nobody looks at its pictures: thirty drones' tracks are dear to read, so they wait to be shown.
            drone.unread, drone.tracked_at = sample.payload, sample.arrived
            self._on_word(address.drone_id, drone, sample.arrived)
            return None
        try:
            message = codec.decode(keys.MESSAGES[address.kind], sample.payload)
        except DecodeError:
            self.unreadable += 1
            return None
        self._on_word(address.drone_id, drone, sample.arrived)
        if isinstance(message, VideoMessage):
            camera = keys.camera_of(address)
            return (
                None if camera is None else self._on_view((address.drone_id, camera), drone, message, sample)
            )
        self._on_message(address.drone_id, drone, message, sample.arrived)
        return None

    def on_sign_of_life(self, drone_id: int, arrived: float) -> None:
        """A drone sent a message whose content does not matter."""
        drone = self._drones.get(drone_id)
        if drone is not None:
            self._on_word(drone_id, drone, arrived)

    def on_tracks(self, drone_id: int, tracks: TracksMessage | None) -> None:
        """What a drone tracks now, where its tracks are not among the samples."""
        drone = self._drones.get(drone_id)
        if drone is not None:
            drone.in_view = _in_view(tracks)

    def tracks_at(self, drone_id: int, t_utc_s: float) -> TracksMessage | None:
        """What a drone tracked at the instant of a frame, by its own clock, or nearest to it."""
        drone = self._drones.get(drone_id)
        if drone is None:
            return None
        return min(drone.tracks, key=lambda message: abs(message.t_utc_s - t_utc_s), default=None)

    def utc_of(self, t: float) -> float:
        """t: on our monotonic clock, s."""
        return t + utc_offset(self._clock)

    @property
    def drones(self) -> tuple[int, ...]:
        return tuple(self._drones)

    @property
    def cameras(self) -> tuple[ViewKey, ...]:
        """Cameras of all drones."""
        return tuple(
            (drone_id, k) for drone_id, drone in self._drones.items() for k in range(_cameras_of(drone))
        )

    def rig(self, drone_id: int) -> DroneCameras | None:
        """The cameras of a drone with several; None where it has one, or has not told of them."""
        drone = self._drones.get(drone_id)
        return None if drone is None else drone.rig

    def is_alive(self, drone_id: int) -> bool:
        drone = self._drones.get(drone_id)
        return drone is not None and drone.gone_since is None

    def state(self) -> dict[str, Any]:
        """Everything the page shows but pictures; JSON, units in the names where they are not plain."""
        self.refresh()
        now = self._clock.now()
        kind, text, also = self._sentence(self._verdict)
        return {
            "team": self.name,
            "light": {"kind": kind, "text": text, "also": also},
            "starting": self.starting,
            "drones": [self._drone_state(drone_id, now) for drone_id in sorted(self._drones)],
            "looks": [
                [look.observer, look.called, look.whom, look.right, round(look.probability, 3)]
                for look in self._verdict.looks
            ],
            "strangers": strangers(
                drone.strangers
                for drone in self._drones.values()
                if drone.strangers is not None and now - drone.strangers_at < STRANGERS_SHOWN_S
            ),
            "events": list(self._events)[-EVENTS_SHOWN:],
            "unreadable": self.unreadable + self._odd.total(),
        }

    def seen(self, tracks_of: Callable[[int], TracksMessage | None] | None = None) -> Iterator[SeenDrone]:
        """All drones that are here. tracks_of: newest tracks by drone, where they are not among the samples."""
        now = self._clock.now()
        for drone_id, drone in sorted(self._drones.items()):
            if drone.gone_since is None:
                tracks = self._newest_tracks(drone, now) if tracks_of is None else tracks_of(drone_id)
                views = {k: view for k, (at, view) in sorted(drone.views.items()) if now - at < VIEW_S}
                yield SeenDrone(drone_id, self._place(drone_id, now), tracks, views)

    def forget_untellable(self) -> None:
        """Forget all words of each drone of which there is no state in JSON, and what follows from all their words."""
        now = self._clock.now()
        for drone_id, drone in self._drones.items():
            with self.leaves_out("the state", drone_id):
                json.dumps(self._drone_state(drone_id, now), allow_nan=False)
                continue
            drone.forget_what_it_said()
        self._reports, self._verdict = Reports(), TeamVerdict((), ())

    def state_at_end(self, end: FlightEnd) -> dict[str, Any]:
        """State of the page after the end of a flight."""
        self._note(None, end.text, end.kind)
        return {**self._state_for_good(), **told_end(end)}

    def _state_for_good(self) -> dict[str, Any]:
        """One that can be told."""
        with self.leaves_out("the team's state"):
            state = self.state()
            json.dumps(state, allow_nan=False)
            return state
        self.forget_untellable()
        return self.state()

    def last_view(self, key: ViewKey) -> VideoMessage | None:
        drone_id, camera = key
        drone = self._drones.get(drone_id)
        return None if drone is None or camera not in drone.views else drone.views[camera][1]

    def refresh(self) -> None:
        """Update departures and the verdict: to be called a few times per second, also without viewers."""
        with self.leaves_out("the table of identities"):
            self._look(self._clock.now())
            return
        self.forget_untellable()

    def _look(self, now: float) -> None:
        self._find_the_gone(now)
        if now - self._judged_at >= JUDGING_S:
            self._judged_at = now
            self._verdict = self._reports.evaluate(filter(self.is_alive, self._drones), now)
            self._count_in_view(now)
        kind, text, _ = self._sentence(self._verdict)
        subject = (
            re.sub(r"\d+", "", text) if kind == "idle" else text
        )  # how many are named changes all the time
        if subject != self._light:
            self._light = subject
            self._note(None, text, kind)

    def _count_in_view(self, now: float) -> None:
        for drone in self._drones.values():
            if drone.tracked_at > -math.inf:
                drone.in_view = _in_view(self._newest_tracks(drone, now))
        if now - self._coursed_at < COURSE_S:
            return
        self._coursed_at = now
        wrong = Counter(look.observer for look in self._verdict.looks if look.right is False)
        for drone_id, drone in self._drones.items():
            if drone.gone_since is None:
                place = self._place(drone_id, now)
                flat = None if place is None else (round(place[0], 1), round(place[1], 1))
                drone.course.append(Moment(flat, *drone.in_view, wrong[drone_id]))

    # --- hearing ------------------------------------------------------------------------

    def _on_token(self, drone_id: int, drone: Drone, rest: tuple[str, ...], sample: Sample) -> None:
        if len(rest) != 1 or not keys.is_boot(rest[0]):
            return
        if sample.alive:
            self._drones.setdefault(drone_id, drone)
            drone.boots.add(rest[0])
            drone.heard = sample.arrived
            if drone.gone_since is not None or len(drone.boots) == 1:
                self._note(drone_id, "is back" if drone.gone_since is not None else "is here", "ok")
            drone.gone_since = None
        else:
            drone.boots.discard(rest[0])
            if not drone.boots:
                self._gone(drone_id, drone, sample.arrived)

    def _on_word(self, drone_id: int, drone: Drone, arrived: float) -> None:
        self._drones.setdefault(drone_id, drone)
        drone.heard = arrived
        if drone.gone_since is not None and drone.boots:  # it was silent for a while
            drone.gone_since = None
            self._note(drone_id, "is back", "ok")

    def _on_view(self, key: ViewKey, drone: Drone, message: VideoMessage, sample: Sample) -> CameraView:
        drone.views[key[1]] = sample.arrived, message
        drone.view_at = sample.arrived
        return CameraView(key, message)

    def _on_message(self, drone_id: int, drone: Drone, message: Message, arrived: float) -> None:
        match message:
            case AnnouncementMessage() if message.drone_id == drone_id:
                drone.announcement = message
            case StrangersMessage() if message.drone_id == drone_id:
                drone.strangers, drone.strangers_at = message, arrived
            case SightingsMessage() if message.drone_id == drone_id:
                self._on_sightings(drone, message, arrived)
            case TracksMessage():
                drone.tracks.append(message)
                drone.unread, drone.tracked_at = None, arrived
            case HealthMessage():
                self._on_health(drone_id, drone, message)
            case CameraMessage() if message.drone_id == drone_id:
                drone.rig = DroneCameras.of(message) if message.others else None
                drone.views = {k: view for k, view in drone.views.items() if k <= len(message.others)}

    def _on_sightings(self, drone: Drone, message: SightingsMessage, arrived: float) -> None:
        if message.boot != drone.boot:
            drone.boot, drone.clock = message.boot, SenderClock()
        offset = utc_offset(self._clock)
        t, t_sigma = drone.clock.time_of(
            message, arrived=arrived, utc_offset=offset, tolerance=REPORTED_CLOCKS_AGREE_S
        )
        self._reports.add(report_from(message, t, t_sigma))

    def _on_health(self, drone_id: int, drone: Drone, message: HealthMessage) -> None:
        old = drone.told_events if drone.health and drone.health.boot == message.boot else ()
        for line in _new_lines(old, message.events):
            self._note(drone_id, line, "note")
        drone.told_events = message.events
        drone.health = message
        detector = message.latencies.get("detector")
        drone.history.append(
            (
                round(message.cpu_percent, 1),
                round(1e3 * detector.p50_s, 1) if detector else math.nan,
                *(round(rate.got_hz, 1) for rate in _rates(message)),
            )
        )

    def _find_the_gone(self, now: float) -> None:
        for drone_id, drone in list(self._drones.items()):
            # A token outlives the radio by the lease.
            if drone.gone_since is None and now - drone.heard > DRONE_SILENT_S:
                self._gone(drone_id, drone, drone.heard)
            elif drone.gone_since is not None and now - drone.gone_since > DRONE_FORGOTTEN_S:
                del self._drones[drone_id]

    def _gone(self, drone_id: int, drone: Drone, since: float) -> None:
        if drone.gone_since is None:
            drone.gone_since = since
            self._reports.remove(drone_id)
            self._note(drone_id, "is gone", "warn")

    def _note(self, drone_id: int | None, text: str, kind: str) -> None:
        self._event_count += 1
        self._events.append(
            {
                "n": self._event_count,
                "t_utc_s": round(self._clock.utc(), 1),
                "drone": drone_id,
                "text": text,
                "kind": kind,
            }
        )

    # --- the one sentence ---------------------------------------------------------------

    def _sentence(self, verdict: TeamVerdict) -> tuple[str, str, list[str]]:
        """Its kind (bad, warn, ok, idle), itself, and what else there would be to say."""
        bad = [
            f"{len(drone.boots)} processes use ID {drone_id}"
            for drone_id, drone in self._drones.items()
            if len(drone.boots) > 1
        ]
        bad += verdict.disagreements
        warn = self._not_flown()
        for drone_id, drone in sorted(self._drones.items()):
            if drone.gone_since is not None:
                warn.append(f"drone {drone_id} is gone")
            else:
                warn += [f"drone {drone_id} {trouble}" for trouble in troubles(drone.health)]
        said = bad + warn
        if said:
            return "bad" if bad else "warn", said[0], said[1:]
        here = len(self._drones)
        if not here:
            return (
                "idle",
                f"no drone of team {self.name} is found",
                [STARTING if self.starting else self.hint or START_ONE],
            )
        drones = "1 drone" if here == 1 else f"{here} drones"
        if not any(look.right for look in verdict.looks):
            return "idle", f"{drones} here, no names to compare yet", []
        return self._agreement(drones)

    def _not_flown(self) -> list[str]:
        """Followers that are configured to fly in formation and do not: that is the news."""
        followers = {
            drone_id: state
            for drone_id, drone in sorted(self._drones.items())
            if drone.gone_since is None and (state := _formation_state(drone.health))
        }
        away = {drone_id: state["text"] for drone_id, state in followers.items() if not state["engaged"]}
        if len(away) < len(followers):
            return [f"drone {drone_id} is not in formation: it {text}" for drone_id, text in away.items()]
        words = {text: drone_id for drone_id, text in reversed(away.items())}
        return [f"formation not flown: drone {drone_id} {text}" for text, drone_id in reversed(words.items())]

    def _agreement(self, drones: str) -> tuple[str, str, list[str]]:
        """Nobody contradicts. That is worth a tick only where most of what is in view is named."""
        alive = [drone for drone in self._drones.values() if drone.gone_since is None]
        named, in_view = (sum(drone.in_view[k] for drone in alive) for k in (0, 1))
        lately = [moment for drone in alive for moment in list(drone.course)[-NAMED_OVER:]]
        most = 2 * sum(moment.named for moment in lately) > sum(moment.in_view for moment in lately)
        counted = f"{named} of {in_view} drones in view are named"
        if most or not any(moment.in_view for moment in lately):
            followers = [state for drone in alive if (state := _formation_state(drone.health))]
            flown = [f"{len(followers)} in formation"] if followers else []
            return "ok", f"{drones} agree", ([counted] if in_view else []) + flown
        return "idle", counted, ["no name contradicts another"]

    # --- one drone ----------------------------------------------------------------------

    def _drone_state(self, drone_id: int, now: float) -> dict[str, Any]:
        drone = self._drones[drone_id]
        report = self._reports.newest(drone_id)
        position = self._place(drone_id, now)
        fresh = _fresh_views(drone, now)
        few = len(self._drones) <= MAPPED
        # Of a large team they are too much to tell, but for those that somebody looks at.
        tracks = self._newest_tracks(drone, now) if few or now - drone.view_at < VIEW_S else None
        return {
            "id": drone_id,
            "gone_s": None if drone.gone_since is None else round(now - drone.gone_since, 1),
            "position_m": None if position is None else [round(p, 2) for p in position],
            "wedges": [wedge for view in fresh if (wedge := _wedge(view))],
            "cameras": _cameras_of(drone),
            "around": around_state(drone.rig, tracks, few=few),
            "course": [[*moment] for moment in drone.course] if few else [],
            "rays": []
            if report is None
            else [[s.drone_id, *np.round(s.direction, 3).tolist()] for s in report.sightings],
            "link_age_s": round(max(0.0, now - drone.heard), 2),
            "metres": metres(tracks),
            "formation": _formation_state(drone.health),
            "troubles": troubles(drone.health),
            "health": None if drone.health is None else _health_state(drone.health),
            "history": [[None if math.isnan(v) else v for v in row] for row in drone.history],
        }

    def _place(self, drone_id: int, now: float) -> tuple[float, ...] | None:
        """Where a drone is by its own words, m in the team's frame."""
        drone = self._drones[drone_id]
        for view in _fresh_views(drone, now):
            if view.position_m:
                return view.position_m
        report = self._reports.newest(drone_id)
        if report is not None:
            return tuple(report.position.tolist())
        return None if drone.announcement is None else drone.announcement.position_m

    def _newest_tracks(self, drone: Drone, now: float) -> TracksMessage | None:
        """None where they are old."""
        if now - drone.tracked_at > VIEW_S:
            return None
        if drone.unread is not None:
            payload, drone.unread = drone.unread, None
            try:
                drone.tracks.append(codec.decode(TracksMessage, payload))
            except DecodeError:
                self.unreadable += 1
        return drone.tracks[-1] if drone.tracks else None


def _in_view(tracks: TracksMessage | None) -> tuple[int, int]:
    """Named teammates, and all that are tracked but strangers."""
    known = [
        track.identity
        for track in (tracks.tracks if tracks is not None else ())
        if track.status == "confirmed" and track.identity != FOREIGN
    ]
    return sum(identity is not None for identity in known), len(known)


def _fresh_views(drone: Drone, now: float) -> list[VideoMessage]:
    return [view for _, (at, view) in sorted(drone.views.items()) if now - at < VIEW_S]


def _cameras_of(drone: Drone) -> int:
    if drone.rig is not None:
        return len(drone.rig.lenses)
    # A recording may hold pictures, and not what was told of cameras before it began.
    return max(drone.views, default=0) + 1


def told_end(end: FlightEnd) -> dict[str, Any]:
    """What is different on the page once the flight is over."""
    light = {"kind": end.kind, "text": end.text, "also": end.also}
    return {"light": light, "over": {"rows": end.rows, "again": end.again}}


def around_state(
    rig: DroneCameras | None, tracks: TracksMessage | None, *, few: bool
) -> dict[str, Any] | None:
    """All directions around a drone with several cameras: its fields of view, and its tracks; None while unknown,
    or, in a large team, without a viewer.
    """
    if rig is None or (tracks is None and not few):
        return None
    return {"outlines": rig.outlines, "tracks": [] if tracks is None else rig.around(tracks)}


def _wedge(view: VideoMessage) -> list[float] | None:
    """Of a camera's view, from above: where its axis points north and east, and how wide it sees [rad]; None where it
    looks up or down, or nobody knows."""
    if view.quaternion_wxyz is None:
        return None
    north, east = from_quaternion(view.quaternion_wxyz)[:2, 2].tolist()
    if math.hypot(north, east) <= STEEP:
        return None
    return [round(north, 4), round(east, 4), _width_of(view.lens)]


@lru_cache(maxsize=256)
def _width_of(lens: LensMessage) -> float:
    return round(2.0 * half_angles(camera_from(lens))[0], 3)


def troubles(health: HealthMessage | None) -> list[str]:
    """Faults in a drone's own health message, worded to follow its name."""
    if health is None:
        return []
    names = {"autopilot": "its autopilot", "camera": "its camera", "zenoh": "the network"}
    verb = "lost" if health.uptime_s >= TEAM_SETTLED_S else "waits for"
    others = {link.name: f"has trouble with its {link.name}" for link in health.links}
    others |= {link.name: f"holds: {link.text}" for link in health.links if link.name == "formation"}
    found = [
        f"{verb} {names[link.name]}" if link.name in names else others[link.name]
        for link in health.links
        if not link.ok
    ]
    autopilot_is_up = any(link.name == "autopilot" and link.ok for link in health.links)
    if health.uptime_s < TEAM_SETTLED_S:
        return found
    imu = health.rates.get("imu")
    if imu is not None and imu.asked_hz and autopilot_is_up:
        if imu.got_hz == 0.0:
            found.insert(0, "lost its IMU")
        elif imu.got_hz < SLOW * imu.asked_hz:
            # How many is in the table: a line of events for each number would be too much.
            found.append("gets too few IMU samples")
    if health.carried is not None:
        # How well it is known is no line of events for each number.
        found.append(f"is {held_in_words(health.carried.by, math.ceil(health.carried.sigma_m))}")
    if health.noise is not None and health.noise.found:
        found.append(f"reports: {health.noise.found}")
    detections = health.rates.get("detections")
    if detections is not None and detections.got_hz == 0.0 and "lost its camera" not in found:
        found.append("gets no frames")
    return found


def _rates(health: HealthMessage) -> list[RateHealth]:
    none = RateHealth(None, 0.0)
    return [health.rates.get(name, none) for name in ("imu", "detections", "tracks")]


def _health_state(health: HealthMessage) -> dict[str, Any]:
    latency = health.latencies.get("exposure_to_detector")
    detector = health.latencies.get("detector")
    published = health.latencies.get("detections_to_published")
    return {
        "rates": [[rate.asked_hz, round(rate.got_hz, 1)] for rate in _rates(health)],
        "latency_ms": _ms(latency, detector, published),
        "detector_ms": _ms(detector),
        "clock_offset_s": health.clock_offset_s,
        "clock_sigma_s": health.clock_offset_sigma_s,
        "cpu_percent": round(health.cpu_percent, 1),
        "rss_mb": round(health.rss_mb),
        "uptime_s": round(health.uptime_s),
        "drops": {name: count for name, count in health.drops.items() if count and _is_loss(name)},
        "links": [[link.name, link.ok, link.text] for link in health.links],
    }


def _formation_state(health: HealthMessage | None) -> dict[str, Any] | None:
    """Of a follower: whom it follows, where its slot is from there [m, north and east], whether its agent flies it, and
    how it goes."""
    link = next((link for link in health.links if link.name == "formation"), None) if health else None
    if link is None or PLACED - link.counters.keys():
        return None
    error = link.counters.get("error_m")
    return {
        "leader": int(link.counters["leader"]),
        "slot_m": [round(link.counters[name], 2) for name in ("slot_north_m", "slot_east_m")],
        "engaged": bool(link.counters["engaged"]),
        "holds": not link.ok,
        "text": link.text,
        "error_m": None if error is None else round(error, 2),
    }


def _ms(*spreads: LatencyHealth | None) -> float | None:
    """The 95th percentiles, one after the other."""
    known = [spread.p95_s for spread in spreads if spread is not None]
    return round(1e3 * sum(known), 1) if known else None


def _is_loss(name: str) -> bool:
    """Health counts under `drops` also what simply happened."""
    return name not in ("scans", "detections", "sightings_agreed", "sightings_disagreed")


def _new_lines(old: tuple[str, ...], new: tuple[str, ...]) -> tuple[str, ...]:
    """What a list that loses its oldest lines has gained."""
    for kept in range(min(len(old), len(new)), 0, -1):
        if old[-kept:] == new[:kept]:
            return new[kept:]
    return new
