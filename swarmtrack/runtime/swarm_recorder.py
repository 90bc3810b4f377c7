"""Records what a swarm says, for `swarmtrack record` and `swarmtrack sim --record`.

Every message stands twice in the file: as it was heard, byte for byte (`/heard`, MessagePack), from which the verdict
of a simulated flight is judged again; and decoded, in JSON, one topic a drone and kind, for viewers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
from foxglove.messages import CompressedImage, Pose, PoseInFrame, Quaternion, Timestamp, Vector3

from swarmtrack.clock import Clock, utc_offset
from swarmtrack.errors import RecordingError
from swarmtrack.geometry import pose as geometry
from swarmtrack.geometry.rotation import to_quaternion
from swarmtrack.recording.reader import RECORDING_FORMAT, Message
from swarmtrack.recording.settings import versions
from swarmtrack.recording.writer import Attachment, Bounds, Preface, Topic
from swarmtrack.runtime.recording_thread import RecordingThread, Write, folder_name
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.records import as_record
from swarmtrack.wire.video import VideoMessage

HEARD_TOPIC, FLIGHT_TOPIC, TRUTH_TOPIC, VERDICT_TOPIC = "/heard", "/flight", "/truth", "/verdict"
HEARD = Topic(HEARD_TOPIC, "swarmtrack.Heard", b"", "msgpack", "")
FLIGHT = Topic.of_json(FLIGHT_TOPIC, {"title": "swarmtrack.Flight", "type": "object"})
TRUTH = Topic.of_json(TRUTH_TOPIC, {"title": "swarmtrack.Truth", "type": "object"})
VERDICT = Topic.of_json(VERDICT_TOPIC, {"title": "swarmtrack.Verdict", "type": "object"})
SWARM_RECORDER_CLOSE_S = 10.0  # nobody waits for us to end

T = TypeVar("T")


class Heard(msgspec.Struct, array_like=True, frozen=True):
    """A sample, and when it was heard by the listener's clocks [s]."""

    t: float
    utc: float
    key: str
    alive: bool
    payload: bytes

    @property
    def sample(self) -> Sample:
        return Sample(self.key, self.payload, self.alive, self.t)


class FlightEvent(msgspec.Struct, frozen=True):
    """A process was started or ended by plan, by the clocks of the process that did [s]."""

    event: str
    drone_id: int
    t_s: float
    utc_s: float


class TrueRecord(msgspec.Struct, frozen=True):
    """True state of a drone, as recorded. t_s: world time; position and quaternion: world_from_body."""

    t_s: float
    drone_id: int
    position_m: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]


class TruePose(NamedTuple):
    """A drone in truth. t: world time [s]; pose: world_from_body."""

    t: float
    drone_id: int
    pose: geometry.Pose


class SwarmRecorder:
    """Heard samples, and what only the simulation knows, into `folder/swarm`. clock: the machine's."""

    def __init__(self, clock: Clock, team: str) -> None:
        self._clock = clock
        self._team = team
        self._utc_offset = utc_offset(clock)
        self._thread = RecordingThread(clock)
        self._topics: dict[tuple[int, Kind], Topic] = {}

    def open(
        self,
        folder: Path,
        *,
        bounds: Mapping[str, Any] | None = None,
        metadata: Mapping[str, str] | None = None,
        attachments: Sequence[Attachment] = (),
    ) -> None:
        """bounds: of `Bounds`, other than usual. Raises RecordingError where nothing can be written."""
        now, utc = self._clock.now(), self._clock.utc()
        self._utc_offset = utc - now
        root = folder / "swarm"
        known = {"monotonic_s": repr(now), "utc_s": repr(utc), "team": self._team}
        self._thread.open(
            root / folder_name(utc, self._team),
            Preface(
                {"format": RECORDING_FORMAT, "kind": "swarm", **known, **(metadata or {}), **versions()},
                tuple(attachments),
            ),
            Bounds(root, **{"drop_oldest": False, **(bounds or {})}),
        )

    def close(self) -> None:
        self._thread.close(SWARM_RECORDER_CLOSE_S)

    @property
    def thread(self) -> RecordingThread:
        """Its counters and troubles."""
        return self._thread

    def record_sample(self, sample: Sample, t: float, utc: float) -> None:
        """t, utc: when, by our clocks [s]."""
        self._thread.enqueue(
            self._ns(t), partial(self._write_heard, Heard(t, utc, sample.key, sample.alive, sample.payload))
        )

    def flown(self, event: str, drone_id: int) -> None:
        """event: "started" or "ended", of a process."""
        t, utc = self._clock.now(), self._clock.utc()
        data = msgspec.json.encode(FlightEvent(event, drone_id, t, utc))
        self._thread.enqueue(self._ns(t), lambda write, ns: write(FLIGHT, ns, data))

    def landed(self) -> None:
        """Nothing more will be heard: from now on a full queue holds up who puts, instead of losing what is put."""
        self._thread.waits = True

    def truth(self, epoch: float, true: TruePose) -> None:
        """epoch: of world time, on our clock."""
        self._thread.enqueue(self._ns(epoch + true.t), partial(_write_truth, true))

    def verdict(self, record: Mapping[str, Any]) -> None:
        data = msgspec.json.encode(record)
        self._thread.enqueue(self._ns(self._clock.now()), lambda write, ns: write(VERDICT, ns, data))

    def _ns(self, t: float) -> int:
        return round((t + self._utc_offset) * 1e9)

    def _write_heard(self, heard: Heard, write: Write, log_time: int) -> None:
        write(HEARD, log_time, msgspec.msgpack.encode(heard))
        address = keys.parse(heard.key)
        if address is None:
            return
        record: Mapping[str, Any] = {"key": heard.key, "alive": heard.alive}
        kind = keys.MESSAGES.get(address.kind)
        if kind is not None and heard.alive:
            try:
                message = codec.decode(kind, heard.payload)
                if isinstance(message, VideoMessage):
                    camera = keys.camera_of(address)
                    if camera is not None:
                        _write_picture(address.drone_id, camera, message, write, log_time)
                    return
                record = as_record(message)
            except DecodeError as error:
                record = {"key": heard.key, "error": str(error), "bytes": len(heard.payload)}
        write(self._topic(address.drone_id, address.kind), log_time, msgspec.json.encode(record))

    def _topic(self, drone_id: int, kind: Kind) -> Topic:
        topic = self._topics.get((drone_id, kind))
        if topic is None:
            schema = {"title": f"swarmtrack.{kind.capitalize()}Message", "type": "object"}
            topic = self._topics[drone_id, kind] = Topic.of_json(f"/drone-{drone_id}/{kind}", schema)
        return topic


def _write_picture(drone_id: int, camera: int, view: VideoMessage, write: Write, log_time: int) -> None:
    """As viewers show pictures; one without is in `/heard` only."""
    if view.jpeg:
        exposed = round(view.t_utc_s * 1e9)
        stamp = Timestamp(sec=exposed // 10**9, nsec=exposed % 10**9)
        # People count cameras from 1.
        which = f"/{camera + 1}" if camera else ""
        frame = f"camera-{drone_id}{which}"
        image = CompressedImage(timestamp=stamp, frame_id=frame, data=view.jpeg, format="jpeg")
        topic = Topic.well_known(f"/drone-{drone_id}/video{which}", CompressedImage)
        write(topic, log_time, image.encode())


def _write_truth(true: TruePose, write: Write, log_time: int) -> None:
    x, y, z = true.pose.position.tolist()
    qw, qx, qy, qz = to_quaternion(true.pose.rotation).tolist()
    record = TrueRecord(true.t, true.drone_id, (x, y, z), (qw, qx, qy, qz))
    write(TRUTH, log_time, msgspec.json.encode(record))
    pose = Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
    stamp = Timestamp(sec=log_time // 10**9, nsec=log_time % 10**9)
    topic = Topic.well_known(f"/drone-{true.drone_id}/truth", PoseInFrame)
    write(topic, log_time, PoseInFrame(timestamp=stamp, frame_id="team_ned", pose=pose).encode())


_READ_HEARD = msgspec.msgpack.Decoder(Heard)
_READ_FLIGHT = msgspec.json.Decoder(FlightEvent)
_READ_TRUTH = msgspec.json.Decoder(TrueRecord)


def read_heard(message: Message) -> Heard:
    """Records of `/heard`. Raises RecordingError."""
    return _read(_READ_HEARD, message, "swarmtrack.Heard")


def read_flight(message: Message) -> FlightEvent:
    """Records of `/flight`. Raises RecordingError."""
    return _read(_READ_FLIGHT, message, "swarmtrack.Flight")


def read_truth(message: Message) -> TrueRecord:
    """Records of `/truth`. Raises RecordingError."""
    return _read(_READ_TRUTH, message, "swarmtrack.Truth")


def _read(decoder: msgspec.msgpack.Decoder[T] | msgspec.json.Decoder[T], message: Message, kind: str) -> T:
    try:
        return decoder.decode(message.data)
    except msgspec.MsgspecError as error:
        raise RecordingError(f"{message.topic}: a record that is not {kind}: {error}") from None
