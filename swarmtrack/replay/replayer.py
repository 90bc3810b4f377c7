"""A recorded flight through the real `Onboard`, as fast as it goes.

Every input passes the same door in the same order as in flight, and `Onboard` reads no clock: on the same machine and
versions its tracks are the same, bit for bit. Whether they are is told by digests: the recording holds one of every
scan's tracks and of every answer to "where are they now", and each is compared.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

from swarmtrack.detection.expectation import PerceivedExpectation
from swarmtrack.errors import RecordingError
from swarmtrack.follower import LocalSetpoint
from swarmtrack.messages import Detections, Frame, ImuSample, Input, ScanReport, TrackList, VisualTurn
from swarmtrack.recording import inputs, outputs
from swarmtrack.recording.reader import Message, Recording
from swarmtrack.recording.settings import FlightSettings
from swarmtrack.replay.recorded_frames import RecordedFrames
from swarmtrack.runtime.door import Door
from swarmtrack.runtime.perception import make_follower, make_onboard, make_visual_gyro

if TYPE_CHECKING:
    from swarmtrack.detection.detector import Detector
    from swarmtrack.onboard import Output

ANSWER_EVERY = 10
REPLAYED_FRAMES_KEPT = 64  # read, and their detections not met yet

REPLAYED_TOPICS = frozenset(
    {*inputs.FORM_OF_TOPIC, outputs.ASKED_TOPIC, outputs.TRACKS_TOPIC, outputs.SETPOINTS_TOPIC}
)

Watcher = Callable[[TrackList], None]
"""Is given every answer to the question for tracks, in order."""


class Published(NamedTuple):
    """Messages that one run of an agent published in a replay, the k-th as number k + 1; None: bit for bit as in
    flight.
    """

    messages: int
    changed: Sequence[TrackList] | None


class Stream(NamedTuple):
    """How far a kind of results agrees: how many of the recorded ones, and when the first differs [s of flight]."""

    recorded: int
    same: int
    parted_s: float | None


NO_STREAM = Stream(0, 0, None)


@dataclass(slots=True)
class _Compared:
    """A stream of recorded digests beside one of replayed ones; either may run ahead by a few."""

    recorded: list[str] = field(default_factory=list)
    replayed: list[str] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    """Of the replayed ones."""

    def result(self, begin: float) -> Stream:
        parted = next(
            (i for i, (was, now) in enumerate(zip(self.recorded, self.replayed, strict=False)) if was != now),
            None,
        )
        same = sum(was == now for was, now in zip(self.recorded, self.replayed, strict=False))
        return Stream(len(self.recorded), same, None if parted is None else self.times[parted] - begin)


@dataclass(slots=True)
class Replayed:
    """Result of a replay. Times of `scans` and `recorded_scans` are those of the agent's clock, from `begin` on."""

    begin: float = 0.0
    seconds: float = 0.0
    """Of flight."""
    scans: list[ScanReport] = field(default_factory=list)
    recorded_scans: list[ScanReport] = field(default_factory=list)
    inputs: int = 0
    asked: int = 0
    """Of the inputs: how often somebody asked for the tracks."""
    inputs_lost: int = 0
    """Missing in the recording, by their running numbers: from there on nothing need be the same."""
    scans_compared: Stream = NO_STREAM
    answers_compared: Stream = NO_STREAM
    states_compared: Stream = NO_STREAM
    """Of every scan, where teammates are in metres; older recordings hold none."""
    strangers_compared: Stream = NO_STREAM
    """Of every scan at which there were any, where strangers are."""
    setpoints_compared: Stream = NO_STREAM
    """What a drone that flew in formation was told to fly."""
    setpoints: list[LocalSetpoint] = field(default_factory=list)
    news: list[tuple[float, Output]] = field(default_factory=list)
    """Whatever else came of it, each with the seconds of flight until then."""
    digest: str = ""
    """Of all scans replayed: equal digests, equal flights."""
    refused: int = 0
    """Records that could not be read."""

    @property
    def exact(self) -> bool:
        """Whether all recorded results were reproduced bit for bit."""
        streams = (
            self.scans_compared,
            self.answers_compared,
            self.states_compared,
            self.strangers_compared,
            self.setpoints_compared,
        )
        return self.inputs_lost == 0 and all(stream.same == stream.recorded for stream in streams)


class Replayer:
    """One recording, once through an `Onboard` of its own.

    detector: detects in the recorded frames again, instead of the detections in flight; frames that were not recorded
    are then not seen. `motion.gyro_delay_s` of the settings moves the gyro's samples to where it says they belong;
    without it they stay where they were in flight. every_answer: also carry the tracks on to every instant at which
    they were queried, a quarter of the time; else to every tenth, which is as sure to show a difference. A watcher is
    given every one.
    """

    def __init__(
        self,
        recording: Recording,
        settings: FlightSettings,
        *,
        detector: Detector | None = None,
        watcher: Watcher | None = None,
        every_answer: bool = False,
    ) -> None:
        self._recording = recording
        box_width = settings.box_width if detector is None else detector.box_width
        follower = make_follower(settings.config)
        self._follows = follower is not None
        self._door = Door(
            make_onboard(settings.config, settings.cameras, settings.start, box_width), follower
        )
        self._gyro_delay_s = settings.config.motion.gyro_delay_s
        self._detector = detector
        self._visual_gyro = (
            None if detector is None else make_visual_gyro(settings.config, settings.cameras[0].camera)
        )
        perceived = self._door.perceived
        self._expectations = [PerceivedExpectation(perceived, k) for k in range(len(settings.cameras))]
        self._recorded_frames = RecordedFrames(len(settings.cameras))
        self._topics = REPLAYED_TOPICS if detector is None else REPLAYED_TOPICS | self._recorded_frames.topics
        self._watcher = watcher
        self._answer_every = 1 if every_answer or watcher is not None else ANSWER_EVERY
        self._result = Replayed()
        self._scans = _Compared()
        self._answers = _Compared()
        self._states = _Compared()
        self._strangers = _Compared()
        self._setpoints = _Compared()
        self._hash = hashlib.blake2b(digest_size=16)
        self._last_n = 0
        self._elapsed = 0.0
        self._frames: dict[tuple[int, int], Frame] = {}
        """By camera, and by the frame's number."""

    def run(self) -> Replayed:
        """Replay the recording. Raises RecordingError where none of it can be replayed."""
        if self._recording.kind != "drone":
            raise RecordingError(
                f"{self._recording.folder}: is a recording of a swarm, expected an agent's recording"
            )
        result = self._result
        first = last = None
        for message in self._recording.messages(self._topics):
            first = message.log_time_ns if first is None else first
            last = message.log_time_ns
            self._elapsed = (last - first) * 1e-9
            try:
                self._take(message)
            except RecordingError:
                result.refused += 1
        if first is None or last is None:
            raise RecordingError(f"{self._recording.folder}: holds no inputs, expected a recorded flight")
        result.seconds = (last - first) * 1e-9
        result.begin = float(self._recording.preface["monotonic_s"])
        result.scans_compared = self._scans.result(result.begin)
        result.answers_compared = self._answers.result(result.begin)
        result.states_compared = self._states.result(result.begin)
        result.strangers_compared = self._strangers.result(result.begin)
        result.setpoints_compared = self._setpoints.result(result.begin)
        result.digest = self._hash.hexdigest()
        return result

    def _take(self, message: Message) -> None:
        topic = message.topic
        if topic in inputs.FORM_OF_TOPIC:
            n, event = inputs.decode(topic, message.data)
            self._count(n)
            for told in self._instead(event):
                self._door.tell(told)
            self._collect()
        elif topic == outputs.ASKED_TOPIC:
            n, t, digest = outputs.decode_asked(message.data)
            self._count(n)
            self._result.asked += 1
            if self._result.asked % self._answer_every and not self._door.perceived.has_waiting:
                return
            tracks = self._door.tracks(t)
            self._note(self._answers, outputs.digest(tracks), t)
            self._answers.recorded.append(digest)
            if self._watcher is not None:
                self._watcher(tracks)
            self._collect()
        elif topic == outputs.SETPOINTS_TOPIC:
            self._take_command(outputs.decode_command(message.data))
        elif topic == outputs.TRACKS_TOPIC:
            recorded = outputs.decode_report(message.data)
            self._scans.recorded.append(recorded.digest)
            if recorded.relative_digest is not None:
                self._states.recorded.append(recorded.relative_digest)
            if recorded.strangers_digest is not None:
                self._strangers.recorded.append(recorded.strangers_digest)
            self._result.recorded_scans.append(recorded.report)
        elif topic in self._recorded_frames.topics:
            self._take_frame(topic, message.data)

    def _take_command(self, command: outputs.RecordedCommand) -> None:
        """A drone that flew in formation asks again what to fly."""
        self._count(command.n)
        if self._follows:
            told = self._door.command(command.t, command.engagement)
            self._result.setpoints.append(told)
            self._note(self._setpoints, outputs.setpoint_digest(told), command.t)
            self._setpoints.recorded.append(command.digest)
        else:
            # Replayed as one that does not: the scan that may wait was tracked all the same.
            self._door.tracks(command.t)
        self._collect()

    def _count(self, n: int) -> None:
        self._result.inputs += 1
        self._result.inputs_lost += max(0, n - self._last_n - 1)
        self._last_n = n

    def _collect(self) -> None:
        """In flight too the finished scans are taken after every input."""
        for event in self._door.events():
            if isinstance(event, ScanReport):
                self._result.scans.append(event)
                digest = outputs.digest(event.tracks)
                self._note(self._scans, digest, event.tracks.t)
                self._note(self._states, outputs.relative_digest(event.tracks), event.tracks.t)
                if event.strangers:
                    self._note(self._strangers, outputs.strangers_digest(event.strangers), event.tracks.t)
                self._hash.update(digest.encode())
            else:
                self._result.news.append((self._elapsed, event))

    def _note(self, stream: _Compared, digest: str, t: float) -> None:
        stream.replayed.append(digest)
        stream.times.append(t)

    # --- frames, detected anew ----------------------------------------------------------

    def _instead(self, event: Input) -> Iterator[Input]:
        """The event: of the gyro, as late as the config says, and what our detector sees in a frame, if we have one."""
        wanted = self._gyro_delay_s
        if isinstance(event, ImuSample) and wanted is not None and event.gyro_delay != wanted:
            yield replace(event, t=event.t + event.gyro_delay - wanted, gyro_delay=wanted)
            return
        if self._visual_gyro is not None and isinstance(event, VisualTurn):
            return  # as of the recorded frames, below
        if self._detector is None or not isinstance(event, Detections):
            yield event
            return
        frame = self._frames.pop((event.camera, event.sequence), None)
        if frame is None:
            return
        if self._visual_gyro is not None and frame.camera == 0:
            turn = self._visual_gyro.turn_to(frame)
            if turn is not None:
                yield turn
        detections = self._detector.detect(self._detector.plan(frame, self._expectations[frame.camera]))
        if detections is not None:
            yield detections

    def _take_frame(self, topic: str, data: bytes) -> None:
        frame = self._recorded_frames.decode(topic, data)
        if frame is None:
            return
        self._frames[frame.camera, frame.sequence] = frame
        while len(self._frames) > REPLAYED_FRAMES_KEPT:
            # The one that was read first.
            del self._frames[next(iter(self._frames))]
