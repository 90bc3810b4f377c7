"""Recordings of a team into one flight.

Each drone's recording is read once, and only what a review needs of it. Its clock is laid on the first recording's as
`swarmtrack log merge` does. Of drones that did not record themselves there is what the team's recording heard.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from swarmtrack.errors import RecordingError, SwarmtrackError
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import (
    Announcement,
    Array,
    AutopilotRebooted,
    EgoPose,
    FlightState,
    IdClash,
    Input,
    PeerArrived,
    PeerDeparted,
    ScanReport,
    SightingReport,
    TrackStatus,
)
from swarmtrack.monitor.own_recording import DECODE_SCAN_HEAD, EGO_HISTORY_S, HEEDED_INPUTS, UNREADABLE_RECORD
from swarmtrack.recording import inputs, outputs
from swarmtrack.recording.merge import SAID_TOPIC, Shift, SightingTimes, shifts_by, utc_offset
from swarmtrack.recording.reader import FLIGHT_PLAN, Message, Recording, recordings_below
from swarmtrack.recording.settings import read_settings
from swarmtrack.review.flight import (
    ConfirmedLook,
    DroneFlight,
    FollowerCommand,
    Life,
    ReportedPlace,
    ReviewedFlight,
    ReviewedLens,
    ReviewedScan,
    Stand,
)
from swarmtrack.runtime.flight_recorder import HEALTH_RECORDS
from swarmtrack.runtime.perception import make_ego_history
from swarmtrack.runtime.swarm_recorder import HEARD_TOPIC, TRUTH_TOPIC, read_heard, read_truth
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.wire import codec
from swarmtrack.wire.checks import symmetric
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.records import from_record
from swarmtrack.wire.sightings import SightingsMessage
from swarmtrack.wire.tracks import TracksMessage

SCAN_PERIOD_S = 0.2  # s between two scans that are kept: what a page can show
IMU_TOPIC = "/imu"
DETECTIONS_TOPIC = "/detections"
_OWN_TOPICS = HEEDED_INPUTS | {
    HEALTH_RECORDS.name,
    IMU_TOPIC,
    DETECTIONS_TOPIC,
    SAID_TOPIC,
    outputs.TRACKS_TOPIC,
    outputs.SETPOINTS_TOPIC,
}
Progress = Callable[[str, int, int], None]
"""What is read now, the how manieth it is, and of how many."""


class _Frame(msgspec.Struct):
    """As much of detections as a review needs."""

    score: list[float | str]


_DECODE_FRAME = msgspec.json.Decoder(_Frame).decode


def read_flight(paths: Sequence[Path], progress: Progress | None = None) -> ReviewedFlight:
    """Raises RecordingError where nothing of it can be reviewed, and ConfigError for the config of another version."""
    recordings = recordings_below(*paths)
    recordings.sort(key=lambda recording: recording.kind == "drone")  # a swarm's clock is everybody's
    where = ", ".join(map(str, paths))
    teams = sorted({recording.preface["team"] for recording in recordings})
    if len(teams) > 1:
        raise RecordingError(
            f"{where}: holds recordings of the teams {', '.join(teams)}, expected those of one"
        )
    sources: list[_Own | _Swarm] = [
        _Own(recording) if recording.kind == "drone" else _Swarm(recording) for recording in recordings
    ]
    for number, (source, recording) in enumerate(zip(sources, recordings, strict=True), start=1):
        if progress is not None:
            progress(str(recording.folder), number, len(recordings))
        source.read()
    moved = shifts_by([source.times for source in sources], [utc_offset(one) for one in recordings])
    begins = [source.first + shift.seconds for source, shift in zip(sources, moved, strict=True)]
    begin = min((t for t in begins if math.isfinite(t)), default=math.nan)
    if math.isnan(begin):
        raise RecordingError(f"{where}: holds no message of any drone, expected the recording of a flight")
    return _joined(teams[0], sources, moved, begin)


def _joined(
    team: str, sources: Sequence[_Own | _Swarm], moved: Sequence[Shift], begin: float
) -> ReviewedFlight:
    drones: dict[int, DroneFlight] = {}
    truth: Mapping[int, Array] = {}
    clocks: dict[int, float] = {}
    damage: list[str] = []
    for source, shift in zip(sources, moved, strict=True):
        offset = shift.seconds - begin
        if isinstance(source, _Own):
            if math.isfinite(source.first):
                _add(drones, source.flight(offset))
            if shift.by == "messages":
                clocks[source.drone_id] = -shift.seconds
    for source, shift in zip(sources, moved, strict=True):
        if isinstance(source, _Swarm):
            damage += source.recording.damage
            truth = truth or source.truth(shift.seconds - begin)
            for heard in source.flights(shift.seconds - begin):
                drones.setdefault(heard.drone_id, heard)
    seconds = max((drone.end for drone in drones.values()), default=0.0)
    return ReviewedFlight(team, begin, seconds, dict(sorted(drones.items())), truth, clocks, damage)


def _add(drones: dict[int, DroneFlight], flight: DroneFlight) -> None:
    """Another life of the same drone goes on where the first one ended."""
    known = drones.setdefault(flight.drone_id, flight)
    if known is flight:
        return
    first, second = (known, flight) if known.begin <= flight.begin else (flight, known)
    joined = DroneFlight(
        first.drone_id,
        asked_fps=first.asked_fps,
        lenses=first.lenses,
        sent=first.sent | second.sent,
        refused=first.refused + second.refused,
    )
    for name in ("frames", "imu", "placeless", "placed"):
        setattr(joined, name, np.concatenate([getattr(first, name), getattr(second, name)]))
    for name in _LISTS:
        getattr(joined, name).extend(getattr(first, name) + getattr(second, name))
    drones[flight.drone_id] = joined


_LISTS = (
    "lives", "health", "scans", "heard", "alive", "reboots", "clashes", "announced", "commands", "damage",
)  # fmt: skip


class _Own:
    """A drone's own recording. Times are its UTC until `flight` shifts them."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.drone_id = recording.drone_id
        self.times = SightingTimes()
        self.first = self._last = math.nan
        self._offset = utc_offset(recording)
        self._flight = DroneFlight(self.drone_id)
        self._frames: list[tuple[float, float]] = []
        self._imu: list[float] = []
        self._placed: dict[bool, list[float]] = {True: [], False: []}
        self._cameras: tuple[PinholeCamera, ...] = ()
        self._next_scan: dict[int, float] = {}
        settings, _ = read_settings(recording)
        self._cameras = tuple(one.camera for one in settings.cameras)
        self._flight.lenses = tuple(
            _lens(one.camera, one.body_from_camera.rotation) for one in settings.cameras
        )
        self._flight.max_age_s = settings.config.cameras[0].max_age_s
        self._flight.asked_fps = _asked_fps(settings.config.cameras[0].source)
        self._ego = make_ego_history(settings.config, settings.start, history_s=EGO_HISTORY_S)

    def read(self) -> None:
        for message in self.recording.messages(_OWN_TOPICS):
            t = message.log_time_ns * 1e-9
            if math.isnan(self.first):
                self.first = t
            self._last = t
            try:
                self.times.note(message)
                self._take(message, t)
            except UNREADABLE_RECORD:
                self._flight.refused += 1

    def _take(self, message: Message, t: float) -> None:
        topic = message.topic
        if topic == IMU_TOPIC:
            self._imu.append(t)
        elif topic in HEEDED_INPUTS:
            self._on_input(inputs.decode(topic, message.data)[1], t)
        elif topic == DETECTIONS_TOPIC:
            self._frames.append((t, float(len(_DECODE_FRAME(message.data).score))))
        elif topic == outputs.TRACKS_TOPIC:
            head = DECODE_SCAN_HEAD(message.data)
            if head.t_s >= self._next_scan.get(head.camera, -math.inf):
                self._next_scan[head.camera] = head.t_s + SCAN_PERIOD_S - 0.01
                self._on_scan(outputs.decode_report(message.data).report)
        elif topic == HEALTH_RECORDS.name:
            self._flight.health.append((t, from_record(HealthMessage, msgspec.json.decode(message.data))))
        elif topic == outputs.SETPOINTS_TOPIC:
            record = msgspec.json.decode(message.data)
            why, text = str(record["why"]), str(record["text"])
            self._flight.commands.append(FollowerCommand(t, why not in ("follow", "height"), why, text))

    def _on_input(self, event: Input, t: float) -> None:
        flight = self._flight
        match event:
            case EgoPose():
                self._placed[event.position is not None].append(t)
                self._ego.append(event)
            case FlightState():
                self._ego.fly(event)
            case AutopilotRebooted():
                self._ego.restart()
                flight.reboots.append(t)
            case SightingReport():
                key = (event.observer, event.boot, event.sequence)
                flight.heard.append(
                    ReportedPlace(t, event.t + self._offset, event.observer, event.position, key)
                )
            case Announcement():
                flight.announced.append((t, event.drone_id))
            case PeerArrived() | PeerDeparted():
                flight.alive.append((t, event.drone_id, isinstance(event, PeerArrived)))
            case IdClash():
                flight.clashes.append((t, event.drone_id, event.boots))

    def _on_scan(self, report: ScanReport) -> None:
        exposed = report.tracks.t
        pose = self._ego.at(exposed)
        stand = None if pose is None else Stand(pose.position, pose.world_from_body)
        looks = []
        for entry in report.tracks.tracks:
            track, relative = entry.track, entry.relative
            if track.status is not TrackStatus.CONFIRMED:
                continue
            pixel = np.array([[track.mean[0], track.mean[2]]])
            bearing = self._cameras[track.camera].bearing_undistorted(pixel)[0]
            looks.append(
                ConfirmedLook(
                    entry.identity,
                    entry.identity_probability,
                    bearing if np.isfinite(bearing).all() else None,
                    None if relative is None else relative.position,
                    None if relative is None else relative.cov[:3, :3],
                    track.camera,
                )
            )
        self._flight.scans.append(ReviewedScan(exposed + self._offset, stand, tuple(looks), report.camera))

    def flight(self, offset: float) -> DroneFlight:
        """Times moved by offset [s]."""
        flight = self._flight
        flight.lives = [Life(self.recording.preface["boot"], self.first + offset, self._last + offset)]
        flight.damage = self.recording.damage
        flight.frames = np.array(self._frames, dtype=float).reshape(-1, 2) + np.array([offset, 0.0])
        flight.imu = np.array(self._imu) + offset
        flight.placed, flight.placeless = (np.array(self._placed[one]) + offset for one in (True, False))
        flight.sent = {key: t + self._offset + offset for key, t in self.times.sent.items()}
        flight.health = [(t + offset, message) for t, message in flight.health]
        flight.scans = [scan._replace(t=scan.t + offset) for scan in flight.scans]
        flight.heard = [one._replace(t=one.t + offset, sent_t=one.sent_t + offset) for one in flight.heard]
        flight.alive = [(t + offset, who, there) for t, who, there in flight.alive]
        flight.reboots = [t + offset for t in flight.reboots]
        flight.clashes = [(t + offset, who, boots) for t, who, boots in flight.clashes]
        flight.announced = [(t + offset, who) for t, who in flight.announced]
        flight.commands = [one._replace(t=one.t + offset) for one in flight.commands]
        return flight


def _lens(camera: PinholeCamera, body_from_camera: Array) -> ReviewedLens:
    half = (camera.width / (2.0 * camera.fx), camera.height / (2.0 * camera.fy))
    return ReviewedLens(body_from_camera, half)


def _asked_fps(source: str) -> float | None:
    found = re.search(r"[?&]fps=([\d.]{1,8})", source)
    try:
        return float(found[1]) if found else None
    except ValueError:
        return None


class _Swarm:
    """What was heard of a team, and of a simulated flight its truth."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.times = SightingTimes()
        self.first = math.nan
        self._flights: dict[int, DroneFlight] = {}
        self._truth: dict[int, list[tuple[float, ...]]] = {}

    def read(self) -> None:
        offset = utc_offset(self.recording)
        for message in self.recording.messages({HEARD_TOPIC, TRUTH_TOPIC}):
            try:
                if message.topic == TRUTH_TOPIC:
                    true = read_truth(message)
                    self._truth.setdefault(true.drone_id, []).append((true.t_s, *true.position_m))
                    continue
                heard = read_heard(message)
                address = keys.parse(heard.key)
                if address is not None:
                    self._take(address, heard.payload, heard.t + offset)
            except UNREADABLE_RECORD:
                continue

    def _take(self, address: keys.Address, payload: bytes, t: float) -> None:
        if address.kind not in (Kind.HEALTH, Kind.TRACKS, Kind.IDENTITIES):
            return
        if address.kind is Kind.IDENTITIES:
            said = codec.decode(SightingsMessage, payload)
            self.times.received[said.drone_id, said.boot, said.sequence] = (
                t - utc_offset(self.recording) - said.age_s
            )
        if math.isnan(self.first):
            self.first = t
        flight = self._flights.setdefault(address.drone_id, DroneFlight(address.drone_id, recorded=False))
        begin = flight.lives[0].begin if flight.lives else t
        flight.lives = [Life("", begin, t)]
        if address.kind is Kind.HEALTH:
            flight.health.append((t, codec.decode(HealthMessage, payload)))
        elif address.kind is Kind.TRACKS and (not flight.scans or t - flight.scans[-1].t >= SCAN_PERIOD_S):
            flight.scans.append(ReviewedScan(t, None, _looks(codec.decode(TracksMessage, payload))))

    def flights(self, offset: float) -> list[DroneFlight]:
        """Of all that were heard, moved by offset [s]."""
        for flight in self._flights.values():
            flight.lives = [
                one._replace(begin=one.begin + offset, end=one.end + offset) for one in flight.lives
            ]
            flight.health = [(t + offset, message) for t, message in flight.health]
            flight.scans = [scan._replace(t=scan.t + offset) for scan in flight.scans]
        return list(self._flights.values())

    def truth(self, offset: float) -> Mapping[int, Array]:
        """Rows of t, north, east, down by drone, moved by offset [s]."""
        if not self._truth or FLIGHT_PLAN not in self.recording.attachments:
            return {}
        plan: Any = self.recording.attached(FLIGHT_PLAN)
        try:
            epoch = float(plan["epoch_s"]) + utc_offset(self.recording) + offset
        except (KeyError, TypeError, ValueError) as error:
            raise SwarmtrackError(
                f"{self.recording.folder}: {FLIGHT_PLAN}: epoch_s: {error!r}, expected s"
            ) from None
        return {
            drone_id: np.array(sorted(rows)) + np.array([epoch, 0.0, 0.0, 0.0])
            for drone_id, rows in sorted(self._truth.items())
        }


def _looks(message: TracksMessage) -> tuple[ConfirmedLook, ...]:
    relatives = {relative.track_id: relative for relative in message.relatives}
    looks = []
    for number, track in enumerate(message.tracks):
        if track.status != "confirmed":
            continue
        relative = relatives.get(track.id)
        cov = None if relative is None else symmetric(np.array([relative.cov]), 6)[0, :3, :3]
        position = None if relative is None else np.array(relative.position_m)
        camera = message.camera_of(number)
        looks.append(ConfirmedLook(track.identity, track.identity_probability, None, position, cov, camera))
    return tuple(looks)
