"""Labels for training from flights: where in a recorded picture must each teammate have been?

Theory of operation. Every drone of a team knows its own pose in the frame that they share, and recordings hold it. So
the place of each teammate at the exposure of a picture is projected into that picture, as the box around a body of
known size: a label without manual work. Times of several recordings are brought together as `swarmtrack log merge`
does. A teammate without a recording of its own is where it said it was, once a second, in what it told its team.

A picture with a drone in it that has no label teaches the wrong thing. So a picture is left out whenever a teammate
that may be in it is not known well enough: its pose is missing, or its pixel is less sure than a share of its box.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec
import numpy as np

from swarmtrack.config.drone import MountedCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import Announcement, Array, AutopilotRebooted, EgoPose, FlightState, SightingReport
from swarmtrack.motion.ego import EgoHistory, TeamPose
from swarmtrack.recording import inputs
from swarmtrack.recording.merge import shifts
from swarmtrack.recording.outputs import FRAMES_TOPIC, image_topic
from swarmtrack.recording.reader import Recording
from swarmtrack.recording.settings import FlightSettings, read_settings
from swarmtrack.replay.recorded_frames import jpeg_of
from swarmtrack.runtime.perception import make_ego_history

LABEL_TOPICS = {
    inputs.FORM_OF_KIND[kind].topic
    for kind in (EgoPose, FlightState, AutopilotRebooted, Announcement, SightingReport)
}
FOREVER = 1e9  # s of history
REPORT_GAP = 1.5  # s between two places that a teammate told of, to be somewhere on the line between them
POSE_GAP = 0.3  # s from the nearest pose of a recording
UNSURE_PX, UNSURE_SHARE = 2.0, 0.2  # a pixel less sure than this plus this share of the box is no label
NEAREST_LABELLED_M = 0.2  # m


class Body(NamedTuple):
    """Cuboid around which a box is drawn: span x span x height, level with the drone. m"""

    span: float
    height: float

    @property
    def corners(self) -> Array:
        """(8, 3) in body axes."""
        signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        return np.asarray(signs * np.array([self.span, self.span, self.height]) / 2)


class Label(NamedTuple):
    """drone_id; box (4,) px: left, top, width, height, in the picture as the camera gave it."""

    drone_id: int
    box: Array


class LabelledPicture(NamedTuple):
    """One picture of a flight, as its JPEG. t: exposure on the observer's clock; camera: which of the observer's, by
    its place in the config."""

    observer: int
    sequence: int
    t: float
    jpeg: bytes
    labels: list[Label]
    camera: int = 0


@dataclass(slots=True)
class ReportedPath:
    """Positions reported by a teammate, on the receiver's clock."""

    t: list[float] = field(default_factory=list)
    position: list[Array] = field(default_factory=list)
    sigma: list[float] = field(default_factory=list)

    def add(self, t: float, position: Array, sigma: float) -> None:
        if not self.t or t > self.t[-1]:
            self.t.append(t)
            self.position.append(position)
            self.sigma.append(sigma)

    def at(self, t: float) -> TeamPose | None:
        """Interpolation between two reports; the attitude is not reported, and taken to be level."""
        k = bisect_left(self.t, t)
        if k in (0, len(self.t)) or self.t[k] - self.t[k - 1] > REPORT_GAP:
            return None
        share = (t - self.t[k - 1]) / (self.t[k] - self.t[k - 1])
        position = (1 - share) * self.position[k - 1] + share * self.position[k]
        # On a curve it was off the line between two reports, by a part of the way from one to the other.
        off = 0.1 * float(np.linalg.norm(self.position[k] - self.position[k - 1]))
        variance = max(self.sigma[k - 1 : k + 1]) ** 2 + off**2
        return TeamPose(t, position, np.eye(3), variance * np.eye(3), np.zeros((3, 3)))


@dataclass(slots=True)
class RecordedDrone:
    """A recording's data on its drone and the others. clock_offset: common time minus the drone's clock, s."""

    recording: Recording
    settings: FlightSettings
    ego: EgoHistory
    clock_offset: float
    newest: float = -math.inf
    reported: dict[int, ReportedPath] = field(default_factory=dict)
    teammates: set[int] = field(default_factory=set)

    @property
    def drone_id(self) -> int:
        return self.recording.drone_id

    def pose_at(self, common: float) -> TeamPose | None:
        """Pose of this drone at a time common to all."""
        t = common - self.clock_offset
        return self.ego.at(t) if t < self.newest + POSE_GAP else None


class FlightLabels:
    """Labelled pictures from recordings. skipped: number of pictures left out, by reason."""

    def __init__(self, recordings: Sequence[Recording], body: Body) -> None:
        self._body = body
        self.skipped: Counter[str] = Counter()
        self._flown = read_drones(recordings)

    @property
    def observers(self) -> list[int]:
        return [flown.drone_id for flown in self._flown]

    def pictures(self, every: int = 1) -> Iterator[LabelledPicture]:
        """Every n-th picture of each camera of each recording that can be labelled."""
        for observer in self._flown:
            cameras = observer.settings.cameras
            seen: Counter[int] = Counter()
            for camera, t, sequence, jpeg in _pictures(observer.recording, len(cameras)):
                number = seen[camera]
                seen[camera] += 1
                if number % every:
                    continue
                labels = self._labels(observer, cameras[camera], t + cameras[camera].time_offset_s)
                if labels is not None:
                    yield LabelledPicture(observer.drone_id, sequence, t, jpeg, labels, camera)

    def _labels(self, observer: RecordedDrone, mounted: MountedCamera, exposed: float) -> list[Label] | None:
        """None where somebody who may be in the picture cannot be labelled; exposed: on the observer's clock."""
        common = exposed + observer.clock_offset
        here = observer.pose_at(common)
        if here is None:
            self.skipped["the observer's own pose is not known"] += 1
            return None
        labels = []
        for drone_id in sorted(observer.teammates):
            there = pose_of(drone_id, observer, self._flown, common)
            if there is None:
                self.skipped["a teammate's pose is not known"] += 1
                return None
            found = self._project(mounted, here, there)
            if found is None:
                continue
            box, sigma = found
            if sigma > UNSURE_PX + UNSURE_SHARE * float(max(box[2:])):
                self.skipped["a teammate's position in it is too uncertain"] += 1
                return None
            labels.append(Label(drone_id, box))
        return labels

    def _project(self, mounted: MountedCamera, here: TeamPose, there: TeamPose) -> tuple[Array, float] | None:
        """The box (4,) clipped to the picture, and the sigma of its centre, px; None where it is not in the picture."""
        camera, mount = mounted.camera, mounted.body_from_camera
        team_from_camera = Pose(here.world_from_body, here.position) @ mount
        body = Pose(there.world_from_body, there.position).transform(self._body.corners)
        points = team_from_camera.inverse().transform(np.vstack([there.position[None], body]))
        pixels, _, valid = camera.project(points)
        depth = float(camera.depth(points[:1])[0])
        if depth < NEAREST_LABELLED_M or not valid.all():
            return None
        u, v = pixels[0]
        if not (0 <= u <= camera.width - 1 and 0 <= v <= camera.height - 1):
            return None
        low = np.maximum(pixels[1:].min(axis=0), 0.0)
        high = np.minimum(pixels[1:].max(axis=0), [camera.width - 1.0, camera.height - 1.0])
        focal = max(camera.fx, camera.fy)
        apart = math.hypot(here.position_sigma, there.position_sigma) / depth
        return np.concatenate([low, high - low]), focal * math.hypot(apart, here.attitude_sigma)


def read_drones(recordings: Sequence[Recording]) -> list[RecordedDrone]:
    """The drones among recordings of one flight, their clocks brought together. Raises RecordingError."""
    flights = [recording for recording in recordings if recording.kind == "drone"]
    return [_read(flight, shift.seconds) for flight, shift in zip(flights, shifts(flights), strict=True)]


def pose_of(
    drone_id: int, observer: RecordedDrone, flown: Sequence[RecordedDrone], common: float
) -> TeamPose | None:
    """Pose of a teammate: from its own recording, else from its reports to the observer. None without either."""
    for one in flown:
        if one.drone_id == drone_id and (pose := one.pose_at(common)) is not None:
            return pose
    told = observer.reported.get(drone_id)
    return told.at(common - observer.clock_offset) if told else None


def _read(recording: Recording, shift: float) -> RecordedDrone:
    """All poses of one recording. Raises RecordingError."""
    settings, _ = read_settings(recording)
    ego = make_ego_history(settings.config, settings.start, history_s=FOREVER)
    begin = float(recording.preface["utc_s"]) - float(recording.preface["monotonic_s"])
    flown = RecordedDrone(recording, settings, ego, begin + shift)
    for message in recording.messages(LABEL_TOPICS):
        _, event = inputs.decode(message.topic, message.data)
        match event:
            case EgoPose():
                ego.append(event)
                flown.newest = max(flown.newest, event.t)
            case FlightState():
                ego.fly(event)
            case AutopilotRebooted():
                ego.restart()
            case Announcement():
                flown.teammates.add(event.drone_id)
                flown.reported.setdefault(event.drone_id, ReportedPath()).add(
                    event.t, event.position, math.sqrt(float(np.trace(event.position_cov)) / 3)
                )
            case SightingReport():
                told = flown.reported.setdefault(event.observer, ReportedPath())
                told.add(event.t, event.position, event.position_sigma)
    return flown


def _pictures(recording: Recording, cameras: int) -> Iterator[tuple[int, float, int, bytes]]:
    """Camera, time on the drone's clock, number and JPEG of every recorded picture."""
    exact = None
    topics = {image_topic(k): k for k in range(cameras)}
    for message in recording.messages({FRAMES_TOPIC, *topics}):
        if message.topic == FRAMES_TOPIC:
            exact = msgspec.json.decode(message.data)
            continue
        camera, told, exact = topics[message.topic], exact, None
        jpeg = jpeg_of(message.data)
        if told is not None and told.get("camera", 0) == camera and jpeg is not None:
            yield camera, float(told["t_s"]), int(told["sequence"]), jpeg
