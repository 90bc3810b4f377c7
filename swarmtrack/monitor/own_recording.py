"""One drone's own recording, as the messages that the monitor would have heard of it, and of those it heard."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np

from swarmtrack.clock import UTC_SIGMA
from swarmtrack.errors import RecordingError
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import to_quaternion
from swarmtrack.identity.consensus import OwnSighting, OwnView
from swarmtrack.identity.reprojection import ObserverCamera, rays_to
from swarmtrack.messages import (
    Announcement,
    AutopilotRebooted,
    EgoPose,
    FlightState,
    IdClash,
    Input,
    LocatedStranger,
    PeerArrived,
    PeerDeparted,
    SightingReport,
    StrangerReport,
)
from swarmtrack.monitor.timeline import Blob, BlobFile, TimelineEvent, Tracked
from swarmtrack.motion.ego import TeamPose
from swarmtrack.outputs import periods
from swarmtrack.recording import inputs, outputs
from swarmtrack.recording.merge import SAID_TOPIC, SightingTimes, utc_offset
from swarmtrack.recording.outputs import FRAMES_TOPIC, image_topic
from swarmtrack.recording.reader import Message, Recording
from swarmtrack.recording.settings import read_settings
from swarmtrack.replay.recorded_frames import jpeg_of
from swarmtrack.runtime.perception import make_ego_history
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import announcement_message
from swarmtrack.wire.camera import camera_message
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.fields import WIRE_VERSION
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.records import from_record
from swarmtrack.wire.sightings import sightings_message
from swarmtrack.wire.strangers import MAX_STRANGERS, strangers_message
from swarmtrack.wire.tracks import TracksMessage, tracks_message
from swarmtrack.wire.video import VideoMessage

HEALTH_TOPIC = "/health"
HEEDED_INPUTS = frozenset(
    inputs.FORM_OF_KIND[kind].topic
    for kind in (
        EgoPose,
        FlightState,
        AutopilotRebooted,
        Announcement,
        SightingReport,
        PeerArrived,
        PeerDeparted,
        IdClash,
    )
)
UNREADABLE_RECORD = (RecordingError, DecodeError, msgspec.MsgspecError, ValueError, KeyError, TypeError)
"""What decoding a damaged or foreign record raises."""
EGO_HISTORY_S = 2.0
SPOKE_S = 0.2  # s between two signs of life that are kept: silence counts from 2 s on
SILENT_WORD_S = 1.0  # s between two signs of life of a teammate that did not record itself
RECORDED_FRAME_JITTER_S = 0.01

Heard = Announcement | SightingReport | PeerArrived | PeerDeparted | IdClash


class DroneRecording:
    """To be read once, then asked; times of what is kept are UTC by its own clock until they are shifted."""

    def __init__(self, recording: Recording, blob_file: BlobFile) -> None:
        self.drone_id = recording.drone_id
        self.hearsay = SightingTimes()
        self.refused = 0
        self.observers: set[int] = set()
        """Whose reports it heard."""
        self._recording = recording
        self._blob_file = blob_file
        self._team = recording.preface["team"]
        self.boot = recording.preface["boot"]
        self._offset = utc_offset(recording)
        settings, _ = read_settings(recording)
        self._cameras = settings.cameras
        self._lenses = [lens_message(one.camera) for one in self._cameras]
        self._image_topics = {image_topic(k): k for k in range(len(self._cameras))}
        self._ego = make_ego_history(settings.config, settings.start, history_s=EGO_HISTORY_S)
        self.tracked = Tracked(self._tracks)
        self._first = self._last = math.nan
        self._spoke: list[float] = []
        self._heard: list[tuple[float, Heard]] = []
        self._health: list[tuple[float, bytes]] = []
        self._reports: list[tuple[float, SightingReport]] = []
        self._scans: list[list[_View]] = [[] for _ in self._cameras]
        self._pictures: list[list[_View]] = [[] for _ in self._cameras]
        self._frame: tuple[int, float] | None = None
        """Of which camera the next picture is, and when it was exposed."""
        self._seen: _Seen | None = None
        self._strangers: list[tuple[float, float, tuple[LocatedStranger, ...]]] = []
        """When they were told, and at which exposure it found them there."""
        self._strangers_t = math.nan

    def read(self) -> None:
        for message in self._recording.messages():
            t = message.log_time_ns * 1e-9
            if math.isnan(self._first):
                self._first = t
            self._last = t
            try:
                self.hearsay.note(message)
                self._take(message, t)
            except UNREADABLE_RECORD:
                self.refused += 1

    # --- reading ------------------------------------------------------------------------

    def _take(self, message: Message, t: float) -> None:
        topic = message.topic
        if topic in HEEDED_INPUTS:
            self._on_input(inputs.decode(topic, message.data)[1], t)
        elif topic == outputs.ASKED_TOPIC:
            self._on_sign_of_life(t)
        elif topic == outputs.TRACKS_TOPIC:
            self._on_sign_of_life(t)
            self._on_scan(message.data, t)
        elif topic == SAID_TOPIC:
            self._on_said(message.data, t)
        elif topic == HEALTH_TOPIC:
            health = from_record(HealthMessage, msgspec.json.decode(message.data))
            self._on_sign_of_life(t)
            self._health.append((t, codec.encode(health)))
        elif topic == FRAMES_TOPIC:
            exact = msgspec.json.decode(message.data)
            self._frame = int(exact.get("camera", 0)), float(exact["t_s"])
        elif topic in self._image_topics:
            self._on_picture(self._image_topics[topic], message.data, t)

    def _on_input(self, event: Input, t: float) -> None:
        match event:
            case EgoPose():
                self._ego.append(event)
            case FlightState():
                self._ego.fly(event)
            case AutopilotRebooted():
                self._ego.restart()
            case SightingReport():
                self.observers.add(event.observer)
                self._heard.append((t, event))
            case Announcement() | PeerArrived() | PeerDeparted() | IdClash():
                self._heard.append((t, event))

    def _on_sign_of_life(self, t: float) -> None:
        if not self._spoke or t - self._spoke[-1] >= SPOKE_S:
            self._spoke.append(t)

    def _on_picture(self, camera: int, data: bytes, t: float) -> None:
        frame, self._frame = self._frame, None
        if frame is None or frame[0] != camera:
            return
        jpeg = jpeg_of(data)
        if jpeg is not None and _is_due(self._pictures[camera], t):
            self._pictures[camera].append(
                _View(t, self._view(frame[1], camera), self._blob_file.append(jpeg))
            )

    def _on_scan(self, data: bytes, t: float) -> None:
        scan = DECODE_SCAN_HEAD(data)
        exposed, camera = scan.t_s, scan.camera
        self.tracked.add(exposed + self._offset, self._blob_file.append(data), t)
        if camera < len(self._cameras) and _is_due(self._scans[camera], t):
            self._scans[camera].append(_View(t, self._view(exposed, camera), None))
        observer = self._ego.steady(exposed)
        if observer is not None:
            self._seen = _Seen(data, observer)
        if scan.strangers_digest and not t - self._strangers_t < periods.STRANGERS:
            self._strangers_t = t
            self._strangers.append((t, exposed, outputs.decode_report(data).report.strangers))

    def _on_said(self, data: bytes, t: float) -> None:
        """What it told its team of the last scan in which it knew where it stood."""
        said = _DECODE_SAID(data)
        if self._seen is None or self._seen.observer.t != said.t_s:
            return
        tracks, observer = outputs.decode_report(self._seen.data).report.tracks, self._seen.observer
        named = [
            (entry.identity, entry)
            for entry in tracks.tracks
            if isinstance(entry.identity, int) and entry.track.coasting_since is None
        ]
        seen: list[OwnSighting] = []
        for number, mounted in enumerate(self._cameras):
            in_it = [(drone_id, entry) for drone_id, entry in named if entry.track.camera == number]
            camera = ObserverCamera.of(observer, mounted.camera, mounted.body_from_camera)
            rays = rays_to([(drone_id, entry.track) for drone_id, entry in in_it], camera)
            seen += [
                OwnSighting(ray, entry.identity_probability, entry.proof is not None)
                for ray, (_, entry) in zip(rays, in_it, strict=True)
            ]
        view = OwnView.of(observer, self._cameras[0].body_from_camera, seen)
        self._reports.append((t, view.report(self.drone_id, said.boot, said.sequence, ())))

    def _view(self, exposed: float, camera: int) -> VideoMessage:
        """Without its picture. exposed: on our own clock."""
        ego, lens = self._ego.at(exposed), self._lenses[camera]
        mounting = self._cameras[camera].body_from_camera
        pose = None if ego is None else Pose(ego.world_from_body, ego.position) @ mounting
        return VideoMessage(
            version=WIRE_VERSION,
            t_utc_s=exposed + self._offset,
            t_sigma_s=UTC_SIGMA,
            frame=0,
            width=lens.width,
            height=lens.height,
            jpeg=b"",
            lens=lens,
            position_m=None if pose is None else tuple(pose.position.tolist()),
            quaternion_wxyz=None if pose is None else tuple(to_quaternion(pose.rotation).tolist()),
        )

    def _tracks(self, data: bytes) -> TracksMessage:
        tracks = outputs.decode_report(data).report.tracks
        return tracks_message(tracks, 0, self._offset, UTC_SIGMA)

    # --- telling ------------------------------------------------------------------------

    def views(self, shift: float) -> Iterator[TimelineEvent]:
        """Where its cameras looked, with pictures where it recorded any; and of several, how they are mounted."""
        if len(self._cameras) > 1 and not math.isnan(self._first):
            mountings = [one.body_from_camera for one in self._cameras]
            told = camera_message(self.drone_id, self.boot, [one.camera for one in self._cameras], mountings)
            yield self._message(Kind.CAMERA, self.drone_id, self._first + shift, codec.encode(told))
        for camera in range(len(self._cameras)):
            key = keys.video_key(self._team, self.drone_id, camera)
            for t, view, picture in self._pictures[camera] or self._scans[camera]:
                try:
                    payload = codec.encode(view)
                except ValueError:
                    self.refused += 1
                    continue
                yield TimelineEvent(t + shift, self.drone_id, Sample(key, payload, True, t + shift), picture)

    def events(
        self, shift: float, *, lives: set[tuple[int, str]], says_itself: bool
    ) -> Iterator[TimelineEvent]:
        """lives: drone and boot of those that recorded themselves; says_itself: its sightings, because no recording
        has them as received.
        """
        if math.isnan(self._first):
            return
        yield self._token(self.drone_id, self.boot, self._first + shift)
        for t in self._spoke:
            yield TimelineEvent(t + shift, self.drone_id, None)
        for t, payload in self._health:
            yield self._message(Kind.HEALTH, self.drone_id, t + shift, payload)
        for t, event in [*self._heard, *(self._reports if says_itself else ())]:
            try:
                yield from self._of_event(event, t + shift, self._offset + shift, lives)
            except ValueError:
                self.refused += 1
        if says_itself:
            yield from self._located_strangers(shift)
        yield from self._silent_teammates(shift, lives)

    def _located_strangers(self, shift: float) -> Iterator[TimelineEvent]:
        """Where it found strangers; the rays are in the recordings of those that received them."""
        for n, (t, exposed, located) in enumerate(self._strangers):
            found = StrangerReport(
                self.drone_id,
                self.boot,
                n,
                exposed,
                0.0,
                np.zeros(3),
                0.0,
                0.0,
                0.0,
                (),
                located[:MAX_STRANGERS],
            )
            payload = codec.encode(strangers_message(found, self._offset, t - self._offset))
            yield self._message(Kind.STRANGER, self.drone_id, t + shift, payload)

    def departure(self, shift: float) -> TimelineEvent | None:
        """When it ended; None where it holds nothing."""
        if math.isnan(self._last):
            return None
        return self._token(self.drone_id, self.boot, self._last + shift, alive=False)

    def _of_event(
        self, event: Heard, t: float, offset: float, lives: set[tuple[int, str]]
    ) -> Iterator[TimelineEvent]:
        drone_id = event.observer if isinstance(event, SightingReport) else event.drone_id
        match event:
            case Announcement():
                yield self._message(
                    Kind.POSE, drone_id, t, codec.encode(announcement_message(event, offset, t - offset))
                )
            case SightingReport():
                payload = codec.encode(sightings_message(event, offset, t - offset))
                yield self._message(Kind.IDENTITIES, drone_id, t, payload)
            case PeerArrived(boot=boot) | PeerDeparted(boot=boot) if (drone_id, boot) not in lives:
                yield self._token(drone_id, boot, t, alive=isinstance(event, PeerArrived))
            case IdClash(boots=boots):
                for boot in boots:
                    if (drone_id, boot) not in lives:
                        yield self._token(drone_id, boot, t)

    def _silent_teammates(self, shift: float, lives: set[tuple[int, str]]) -> Iterator[TimelineEvent]:
        """Of those who did not record themselves it is known that they lived while their token stood."""
        since: dict[int, float] = {}
        spans: list[tuple[int, float, float]] = []
        for t, event in self._heard:
            if isinstance(event, PeerArrived) and (event.drone_id, event.boot) not in lives:
                since.setdefault(event.drone_id, t)
            elif isinstance(event, PeerDeparted) and event.drone_id in since:
                spans.append((event.drone_id, since.pop(event.drone_id), t))
        spans += [(drone_id, t, self._last) for drone_id, t in since.items()]
        for drone_id, begin, end in spans:
            for k in range(int((end - begin) / SILENT_WORD_S) + 1):
                yield TimelineEvent(begin + k * SILENT_WORD_S + shift, drone_id, None)

    def _message(self, kind: Kind, drone_id: int, t: float, payload: bytes) -> TimelineEvent:
        return TimelineEvent(t, drone_id, Sample(keys.key(self._team, kind, drone_id), payload, True, t))

    def _token(self, drone_id: int, boot: str, t: float, *, alive: bool = True) -> TimelineEvent:
        return TimelineEvent(
            t, drone_id, Sample(keys.key(self._team, Kind.ALIVE, drone_id, boot), b"", alive, t)
        )


class _View(NamedTuple):
    """When it was recorded, and where its picture lies."""

    t: float
    message: VideoMessage
    picture: Blob | None


class ScanHead(msgspec.Struct):
    """As much of a record as tells its time, whose picture it was, and whether there were strangers."""

    t_s: float
    camera: int = 0
    strangers_digest: str = ""


class _Said(msgspec.Struct):
    """A report that it told its team: of the exposure at t_s."""

    boot: str
    sequence: int
    t_s: float


class _Seen(NamedTuple):
    """A scan as it was recorded, and where the drone stood."""

    data: bytes
    observer: TeamPose


_DECODE_SAID = msgspec.json.Decoder(_Said).decode
DECODE_SCAN_HEAD = msgspec.json.Decoder(ScanHead).decode


def _is_due(views: list[_View], t: float) -> bool:
    return not views or t - views[-1].t >= periods.VIDEO - RECORDED_FRAME_JITTER_S
