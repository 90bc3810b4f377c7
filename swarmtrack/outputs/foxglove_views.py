"""What a recording holds for the eye: pictures, boxes, poses and events as Foxglove's own messages, which Foxglove,
Lichtblick and rerun show without being told how. A replay reads none of it but the pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import msgspec
from foxglove.messages import (
    Color,
    CompressedImage,
    ImageAnnotations,
    Log,
    LogLevel,
    Point2,
    PointsAnnotation,
    PointsAnnotationType,
    Pose,
    PoseInFrame,
    Quaternion,
    TextAnnotation,
    Timestamp,
    Vector3,
)

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.rotation import to_quaternion
from swarmtrack.messages import MOST_CAMERAS, EgoPose, Frame, Input, ScanReport
from swarmtrack.outputs.destinations import SeenTrack, as_seen
from swarmtrack.outputs.foxglove_scene import camera_frame, colour_of_name
from swarmtrack.recording import schemas
from swarmtrack.recording.outputs import FRAMES_TOPIC, image_topic
from swarmtrack.recording.writer import Topic
from swarmtrack.relative.read_out import read_out

IMAGES = [Topic.well_known(image_topic(k), CompressedImage) for k in range(MOST_CAMERAS)]
FRAME = Topic.of_json(FRAMES_TOPIC, schemas.FRAME)
BOXES = [
    Topic.well_known(image_topic(k).replace("image", "annotations"), ImageAnnotations)
    for k in range(MOST_CAMERAS)
]
POSE = Topic.well_known("/pose", PoseInFrame)
EVENTS = Topic.well_known("/log", Log)

JPEG_QUALITY = 90
UNKNOWN_BOX = 24.0  # px

Written = tuple[Topic, bytes]


class FoxgloveViews:
    """Makes them of what is recorded."""

    def __init__(self, drone_id: int, lenses: Sequence[PinholeCamera]) -> None:
        """lenses: of all cameras of the drone."""
        self._drone_id = drone_id
        self._lenses = lenses
        self._told: tuple[str, ...] = ()

    def of_input(self, event: Input, log_time_ns: int) -> Iterator[Written]:
        """Where the drone is, by its own autopilot."""
        if not isinstance(event, EgoPose) or event.position is None:
            return
        x, y, z = event.position.tolist()
        qw, qx, qy, qz = to_quaternion(event.world_from_body).tolist()
        pose = Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
        yield POSE, PoseInFrame(timestamp=stamp(log_time_ns), frame_id="local_ned", pose=pose).encode()

    def of_report(self, report: ScanReport, exposed_ns: int) -> Written:
        """Boxes and names in the image of the camera that was looked through."""
        every = as_seen(report, *self._lenses)
        seen = [track for track in every if track.entry.track.camera == report.camera]
        when = stamp(exposed_ns)
        annotations = ImageAnnotations(
            points=[_box(track, when) for track in seen], texts=[_label(track, when) for track in seen]
        )
        return BOXES[report.camera], annotations.encode()

    def of_events(self, events: tuple[str, ...], log_time_ns: int) -> Iterator[Written]:
        """Those of the health that are new. It repeats the last ones, oldest first."""
        new = events
        for k in range(len(self._told) + 1):
            if events[: len(self._told) - k] == self._told[k:]:
                new = events[len(self._told) - k :]
                break
        self._told = events
        for line in new:
            message = Log(timestamp=stamp(log_time_ns), level=LogLevel.Info, message=line, name="agent")
            yield EVENTS, message.encode()

    def of_frame(self, frame: Frame, exposed_ns: int) -> Iterator[Written]:
        """The picture, and its exact time."""
        import cv2  # noqa: PLC0415

        ok, jpeg = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not ok:
            return
        exact = {"sequence": int(frame.sequence), "t_s": float(frame.t), "t_sigma_s": float(frame.t_sigma)}
        if frame.camera:
            exact["camera"] = frame.camera
        yield FRAME, msgspec.json.encode(exact)
        image = CompressedImage(
            timestamp=stamp(exposed_ns),
            frame_id=camera_frame(self._drone_id, frame.camera),
            data=jpeg.tobytes(),
            format="jpeg",
        )
        yield IMAGES[frame.camera], image.encode()


def stamp(ns: int) -> Timestamp:
    """UTC in nanoseconds, as Foxglove has it."""
    return Timestamp(sec=ns // 1_000_000_000, nsec=ns % 1_000_000_000)


def _box(track: SeenTrack, when: Timestamp) -> PointsAnnotation:
    u, v = track.centre.tolist()
    w, h = (UNKNOWN_BOX if math.isnan(side) else side for side in track.size.tolist())
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return PointsAnnotation(
        timestamp=when,
        type=PointsAnnotationType.LineLoop,
        points=[Point2(x=u + 0.5 * sx * w, y=v + 0.5 * sy * h) for sx, sy in corners],
        outline_color=colour_of_name(track.entry.identity, 1.0),
        thickness=2.0,
    )


def _away(track: SeenTrack) -> str:
    state = track.entry.relative
    if state is None:
        return ""
    return f" {read_out(state.position, state.velocity, state.cov).distance:.1f} m"


def _label(track: SeenTrack, when: Timestamp) -> TextAnnotation:
    identity = track.entry.identity
    name = "?" if identity is None else str(identity)
    u, v = track.centre.tolist()
    return TextAnnotation(
        timestamp=when,
        position=Point2(x=u, y=v),
        text=f"{name}{_away(track)}  (track {track.entry.track.id}, {track.entry.track.status})",
        font_size=12.0,
        text_color=colour_of_name(identity, 1.0),
        background_color=Color(r=0.0, g=0.0, b=0.0, a=0.5),
    )
