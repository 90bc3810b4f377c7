"""Records what the agent is told and what it makes of it; costs the event loop an entry in a queue.

Whatever passes the door is queued as it is, with the time: the messages are frozen, so nothing is copied. Every input
has a running number, so that a replay sees a gap. How it is written and bounded: `runtime/recording_thread.py`.
"""

from __future__ import annotations

import math
from functools import partial

import msgspec

from swarmtrack.clock import Clock, utc_offset
from swarmtrack.follower import Engagement, LocalSetpoint
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Frame, Input, LinkStatus, ScanReport, SightingReport, TrackList
from swarmtrack.outputs.foxglove_scene import FoxgloveScene
from swarmtrack.outputs.foxglove_views import FoxgloveViews, stamp
from swarmtrack.recording import inputs, outputs, schemas
from swarmtrack.recording.settings import FlightSettings, attachments, preface
from swarmtrack.recording.writer import Bounds, Preface, Topic
from swarmtrack.runtime.recording_thread import Job, RecordingThread, Write, folder_name
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.records import as_record

_INPUTS = {form.kind: Topic.of_json(form.topic, schemas.of_form(form)) for form in inputs.FORMS}
TRACKS_RECORDS = Topic.of_json(outputs.TRACKS_TOPIC, schemas.TRACKS_SCHEMA)
ASKED_RECORDS = Topic.of_json(outputs.ASKED_TOPIC, schemas.ASKED_SCHEMA)
SETPOINTS_RECORDS = Topic.of_json(outputs.SETPOINTS_TOPIC, schemas.SETPOINTS_SCHEMA)
SAID_RECORDS = Topic.of_json("/said", schemas.SAID_SCHEMA)
HEALTH_RECORDS = Topic.of_json("/health", schemas.HEALTH_SCHEMA)


class FlightRecorder:
    """Implements `DoorListener`, and also records what viewers want to see.

    clock: the flight's; wall: the machine's, by which the file is flushed. waits: nothing is lost, the flight waits for
    the disk: for what is as fast as it goes.
    """

    def __init__(
        self, settings: FlightSettings, boot: str, clock: Clock, wall: Clock, *, waits: bool
    ) -> None:
        self._settings = settings
        self._boot = boot
        self._clock = clock
        self._utc_offset = utc_offset(clock)
        """As it is now, for the whole recording: a wall clock that is set must not fold the time axis."""
        self._thread = RecordingThread(wall, waits=waits)
        self._n = 0
        self._next_frame = [-math.inf] * len(settings.cameras)
        drone_id, lenses = settings.config.drone.id, [one.camera for one in settings.cameras]
        self._views = FoxgloveViews(drone_id, lenses, alone=settings.config.is_alone)
        self._scene = FoxgloveScene(drone_id, lenses, [one.body_from_camera for one in settings.cameras])

    def open(self) -> None:
        """Begin. Raises RecordingError where the folder cannot be made."""
        section, drone_id = self._settings.config.recording, self._settings.config.drone.id
        assert section.dir is not None, "no recording was asked for"
        now, utc = self._clock.now(), self._clock.utc()
        self._utc_offset = utc - now
        root = section.dir / f"drone-{drone_id}"
        self._thread.open(
            root / folder_name(utc, self._boot),
            Preface(preface(self._settings, self._boot, now, utc), attachments(self._settings)),
            Bounds(root, section.segment_s, int(section.max_mb * 1e6), section.when_full == "oldest"),
        )

    def close(self) -> None:
        self._thread.close()

    def status(self) -> LinkStatus:
        return self._thread.status()

    def take_news(self) -> str | None:
        return self._thread.take_news()

    # --- on the event loop --------------------------------------------------------------

    def told(self, event: Input) -> None:
        self._n += 1
        self._put(partial(self._write_input, self._n, event))

    def asked(self, tracks: TrackList) -> None:
        self._n += 1
        self._put(partial(self._write_asked, self._n, tracks))

    def commanded(self, engagement: Engagement, told: LocalSetpoint) -> None:
        self._n += 1
        self._put(partial(self._write_command, self._n, engagement, told))

    def scanned(self, report: ScanReport, world_from_camera: Pose | None) -> None:
        self._put(partial(self._write_report, report, world_from_camera))

    def record_sighting(self, report: SightingReport) -> None:
        """Record a sighting sent to the team; its number aligns the clocks of two recordings."""
        self._put(partial(self._write_said, report))

    def health(self, message: HealthMessage) -> None:
        self._put(partial(self._write_health, message))

    def frame(self, frame: Frame) -> None:
        """A frame that the detector is about to see; of these, as many as were asked for are kept."""
        section = self._settings.config.recording
        due = self._next_frame[frame.camera]
        if section.frames == "none" or frame.t < due:
            return
        period = 1.0 / section.frames_hz
        self._next_frame[frame.camera] = max(due + period, frame.t + 0.5 * period)
        self._put(partial(self._write_frame, frame))

    def _put(self, job: Job) -> None:
        self._thread.enqueue(self._ns(self._clock.now()), job)

    def _ns(self, t: float) -> int:
        """Our time t as UTC."""
        return round((t + self._utc_offset) * 1e9)

    # --- in the thread ------------------------------------------------------------------

    def _write_input(self, n: int, event: Input, write: Write, log_time: int) -> None:
        write(_INPUTS[type(event)], log_time, inputs.encode(n, event))
        for topic, data in self._views.of_input(event, log_time):
            write(topic, log_time, data)

    def _write_asked(self, n: int, tracks: TrackList, write: Write, log_time: int) -> None:
        write(ASKED_RECORDS, log_time, outputs.encode_asked(n, tracks))

    def _write_command(
        self, n: int, engagement: Engagement, told: LocalSetpoint, write: Write, log_time: int
    ) -> None:
        write(SETPOINTS_RECORDS, log_time, outputs.encode_command(n, engagement, told))

    def _write_report(
        self, report: ScanReport, world_from_camera: Pose | None, write: Write, log_time: int
    ) -> None:
        write(TRACKS_RECORDS, log_time, outputs.encode_report(report))
        exposed_ns = self._ns(report.tracks.t)
        topic, data = self._views.of_report(report, exposed_ns)
        write(topic, log_time, data)
        for topic, data in self._scene.of_report(report, world_from_camera, stamp(exposed_ns)):
            write(topic, log_time, data)

    def _write_said(self, report: SightingReport, write: Write, log_time: int) -> None:
        record = {
            "drone_id": report.observer,
            "boot": report.boot,
            "sequence": report.sequence,
            "t_s": report.t,
        }
        write(SAID_RECORDS, log_time, msgspec.json.encode(record))

    def _write_health(self, message: HealthMessage, write: Write, log_time: int) -> None:
        write(HEALTH_RECORDS, log_time, msgspec.json.encode(as_record(message)))
        for topic, data in self._views.of_events(message.events, log_time):
            write(topic, log_time, data)

    def _write_frame(self, frame: Frame, write: Write, log_time: int) -> None:
        for topic, data in self._views.of_frame(frame, self._ns(frame.t)):
            write(topic, log_time, data)
