"""What a recording holds for the eye: pictures, boxes, poses and events as Foxglove's own messages, which Foxglove,
Lichtblick and rerun show without being told how. A replay reads none of it but the pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec
from foxglove.messages import (
    CompressedImage,
    ImageAnnotations,
    Log,
    LogLevel,
    Point2,
    PointsAnnotation,
    PointsAnnotationType,
    PoseInFrame,
    TextAnnotation,
    Timestamp,
)

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import MOST_CAMERAS, EgoPose, Frame, Input, ScanReport
from swarmtrack.outputs.drawing import DrawnTrack, as_seen, drawn
from swarmtrack.outputs.foxglove_scene import camera_frame, pose_of, shade
from swarmtrack.recording import schemas
from swarmtrack.recording.outputs import FRAMES_TOPIC, image_topic
from swarmtrack.recording.writer import Topic

IMAGES = [Topic.well_known(image_topic(k), CompressedImage) for k in range(MOST_CAMERAS)]
FRAME_RECORDS = Topic.of_json(FRAMES_TOPIC, schemas.FRAME_SCHEMA)
BOXES = [
    Topic.well_known(image_topic(k).replace("image", "annotations"), ImageAnnotations)
    for k in range(MOST_CAMERAS)
]
POSE = Topic.well_known("/pose", PoseInFrame)
EVENTS_LOG = Topic.well_known("/log", Log)

FOXGLOVE_JPEG_QUALITY = 90
BLACK = (0, 0, 0)

Written = tuple[Topic, bytes]


class FoxgloveViews:
    """Makes them of what is recorded."""

    def __init__(self, drone_id: int, lenses: Sequence[PinholeCamera], *, alone: bool) -> None:
        """lenses: of all cameras of the drone. alone: there is no team."""
        self._drone_id = drone_id
        self._lenses = lenses
        self._alone = alone
        self._told: tuple[str, ...] = ()

    def of_input(self, event: Input, log_time_ns: int) -> Iterator[Written]:
        """Where the drone is, by its own autopilot."""
        if not isinstance(event, EgoPose) or event.position is None:
            return
        pose = pose_of(event.position, event.world_from_body)
        yield POSE, PoseInFrame(timestamp=stamp(log_time_ns), frame_id="local_ned", pose=pose).encode()

    def of_report(self, report: ScanReport, exposed_ns: int) -> Written:
        """Boxes and names in the image of the camera that was looked through."""
        tracks = drawn(as_seen(report, *self._lenses), report.camera, alone=self._alone)
        when, width = stamp(exposed_ns), self._lenses[report.camera].width
        annotations = ImageAnnotations(
            points=[mark for track in tracks for mark in _marks(track, when)],
            texts=[_label(track, width, when) for track in tracks if not track.is_dot],
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
            yield EVENTS_LOG, message.encode()

    def of_frame(self, frame: Frame, exposed_ns: int) -> Iterator[Written]:
        """The picture, and its exact time."""
        import cv2  # noqa: PLC0415

        ok, jpeg = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, FOXGLOVE_JPEG_QUALITY])
        if not ok:
            return
        exact = {"sequence": int(frame.sequence), "t_s": float(frame.t), "t_sigma_s": float(frame.t_sigma)}
        if frame.camera:
            exact["camera"] = frame.camera
        yield FRAME_RECORDS, msgspec.json.encode(exact)
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


def _marks(track: DrawnTrack, when: Timestamp) -> Iterator[PointsAnnotation]:
    """A box and an arrow, or a dot."""
    shapes = [(PointsAnnotationType.LineLoop, track.corners), (PointsAnnotationType.LineList, track.arrow)]
    if track.is_dot:
        shapes = [(PointsAnnotationType.Points, track.arrow[:1])]
    for kind, points in shapes:
        yield PointsAnnotation(
            timestamp=when,
            type=kind,
            points=[Point2(x=u, y=v) for u, v in points.tolist()],
            outline_color=shade(track.colour),
            thickness=1.0 if track.is_lost else 2.0,
        )


def _label(track: DrawnTrack, width: int, when: Timestamp) -> TextAnnotation:
    u, v = track.label_at(width)
    return TextAnnotation(
        timestamp=when,
        position=Point2(x=u, y=v),
        text=track.label,
        font_size=12.0,
        text_color=shade(track.colour),
        background_color=shade(BLACK, 0.5),
    )
