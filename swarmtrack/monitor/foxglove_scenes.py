"""A team for Foxglove: the scene of each drone's recording, made of what the drones tell, all drones in one.

Topics and frames are those of a recording (`outputs.foxglove_scene`), except for those of one camera, which begin with
`/drone-ID`, and for `/drones`: where each drone says it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np
from foxglove.messages import (
    CameraCalibration,
    CompressedImage,
    FrameTransforms,
    ImageAnnotations,
    Log,
    LogLevel,
    Point2,
    PointsAnnotation,
    PointsAnnotationType,
    SceneEntity,
    SceneUpdate,
    TextAnnotation,
    Timestamp,
)

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import from_quaternion
from swarmtrack.messages import Array, IdentifiedTrack, RelativeSource, RelativeState, Track, TrackStatus
from swarmtrack.monitor.drone_cameras import ViewKey
from swarmtrack.monitor.team import MonitoredTeam, SeenDrone
from swarmtrack.outputs.drawing import name_of
from swarmtrack.outputs.foxglove_scene import (
    CAMERAS_SCENE,
    FRAMES,
    LIFETIME,
    RAYS,
    SCENE,
    ball,
    calibration,
    camera_frame,
    label,
    map_from_team,
    rays_of,
    shade,
    teammate_of,
    transform,
    view_of,
)
from swarmtrack.outputs.foxglove_views import EVENTS_LOG
from swarmtrack.outputs.palette import colour_of
from swarmtrack.plain_text import plain
from swarmtrack.recording.outputs import image_topic
from swarmtrack.recording.writer import Topic
from swarmtrack.wire.checks import symmetric
from swarmtrack.wire.lens import camera_from
from swarmtrack.wire.tracks import RelativeMessage, TracksMessage, track_cov
from swarmtrack.wire.video import VideoMessage

DRONES = Topic.well_known("/drones", SceneUpdate)
SCENES = (DRONES, SCENE, RAYS, CAMERAS_SCENE)
SHARED = (FRAMES, *SCENES, EVENTS_LOG)
LOG_LEVELS = {"bad": LogLevel.Error, "warn": LogLevel.Warning}

Written = tuple[Topic, bytes]
TracksOf = Callable[[int], TracksMessage | None]


def image_topics(key: ViewKey) -> tuple[Topic, Topic, Topic]:
    """Topics of one camera: its picture, the boxes in it, its calibration."""
    drone_id, camera = key
    name = f"/drone-{drone_id}{image_topic(camera)}"
    return (
        Topic.well_known(name, CompressedImage),
        Topic.well_known(name.replace("image", "annotations"), ImageAnnotations),
        Topic.well_known(name.replace("image", "calibration"), CameraCalibration),
    )


def scene_of(team: MonitoredTeam, stamp: Timestamp, tracks_of: TracksOf | None = None) -> list[Written]:
    """All drones at once. What of a drone cannot be shown is left out. tracks_of: where the team is told none."""
    frames = [map_from_team(stamp)]
    entities: dict[str, list[SceneEntity]] = {topic.name: [] for topic in SCENES}
    for seen in team.seen(tracks_of):
        with team.leaves_out("a scene for Foxglove", seen.drone_id):
            own = _OneDrone(seen, stamp)
            # All of it is made before any of it is shown.
            made = list(own.entities())
            frames += own.transforms()
            for topic, entity in made:
                entities[topic.name].append(entity)
    return [
        (FRAMES, FrameTransforms(transforms=frames).encode()),
        *((topic, SceneUpdate(entities=entities[topic.name]).encode()) for topic in SCENES),
    ]


class _OneDrone:
    def __init__(self, seen: SeenDrone, stamp: Timestamp) -> None:
        self._seen = seen
        self._stamp = stamp
        self._owner = f"{seen.drone_id}/"
        self._level = f"drone-{seen.drone_id}/ned"
        self._tracks = [] if seen.tracks is None else identified_tracks(seen.tracks)

    def transforms(self) -> list[Any]:
        """The level frame where the drone is, and its cameras where their poses are known."""
        seen, frames = self._seen, []
        if seen.position is not None:
            place = Pose(np.eye(3), np.array(seen.position))
            frames.append(transform("team", self._level, place, self._stamp))
        for camera, _, pose in self._posed():
            frames.append(transform("team", camera_frame(seen.drone_id, camera), pose, self._stamp))
        return frames

    def entities(self) -> Iterator[tuple[Topic, SceneEntity]]:
        seen, owner = self._seen, self._owner
        if seen.position is not None:
            yield DRONES, self._drone(np.array(seen.position))
            for entry in self._tracks:
                if entry.relative is not None:
                    yield SCENE, teammate_of(entry.relative, self._level, self._stamp, owner=owner)
        for camera, lens, _ in self._posed():
            frame = camera_frame(seen.drone_id, camera)
            yield CAMERAS_SCENE, view_of(frame, lens, self._stamp)
            for ray in rays_of(self._tracks, camera, lens, frame, self._stamp, owner=owner):
                yield RAYS, ray

    def _posed(self) -> Iterator[tuple[int, PinholeCamera, Pose]]:
        """Cameras with their poses in the team's frame."""
        for camera, view in self._seen.views.items():
            if view.position_m is not None and view.quaternion_wxyz is not None:
                pose = Pose(from_quaternion(view.quaternion_wxyz), np.array(view.position_m))
                yield camera, camera_from(view.lens), pose

    def _drone(self, position: Array) -> SceneEntity:
        drone_id, colour = self._seen.drone_id, colour_of(self._seen.drone_id)
        return SceneEntity(
            timestamp=self._stamp,
            frame_id="team",
            id=str(drone_id),
            lifetime=LIFETIME,
            spheres=[ball(position, colour)],
            texts=[label(position, name_of(drone_id), colour)],
        )


def identified_tracks(tracks: TracksMessage) -> list[IdentifiedTrack]:
    """Tracks as their drone has them, at the time of the message."""
    relatives = {one.track_id: one for one in tracks.relatives}
    return [
        IdentifiedTrack(
            Track(
                track.id,
                tracks.t_utc_s,
                np.array((track.u_px, track.vu_px_s, track.v_px, track.vv_px_s)),
                track_cov(track),
                TrackStatus(track.status),
                track.probability,
                np.array((track.w_px, track.h_px)),
                camera=tracks.camera_of(index),
            ),
            track.identity,
            track.identity_probability,
            relative=_relative(track.identity, relatives.get(track.id), tracks.t_utc_s),
        )
        for index, track in enumerate(tracks.tracks)
    ]


def _relative(identity: object, said: RelativeMessage | None, t: float) -> RelativeState | None:
    if said is None or not isinstance(identity, int):
        return None
    return RelativeState(
        identity,
        t,
        np.array(said.position_m),
        np.array(said.velocity_m_s),
        symmetric(np.array([said.cov]), 6)[0],
        said.range_sigma_log,
        cast("tuple[RelativeSource, ...]", said.sources),
    )


def picture_of(
    key: ViewKey, view: VideoMessage, boxes: list[dict[str, Any]], stamp: Timestamp
) -> Iterator[Written]:
    """One camera's picture with its boxes (`overlay.boxes`) and its calibration."""
    image, annotations, lens = image_topics(key)
    frame = camera_frame(*key)
    yield (
        image,
        CompressedImage(timestamp=stamp, frame_id=frame, data=view.jpeg, format="jpeg").encode(),
    )
    marks = ImageAnnotations(
        points=[_box(box, stamp) for box in boxes], texts=[_box_label(box, stamp) for box in boxes]
    )
    yield annotations, marks.encode()
    scaled = camera_from(view.lens).scaled(view.width, view.height)
    yield lens, calibration(scaled, frame, stamp).encode()


def _box(box: dict[str, Any], stamp: Timestamp) -> PointsAnnotation:
    u, v, w, h = box["box"]
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return PointsAnnotation(
        timestamp=stamp,
        type=PointsAnnotationType.LineLoop,
        points=[Point2(x=u + 0.5 * i * w, y=v + 0.5 * j * h) for i, j in corners],
        outline_color=shade(colour_of(box["identity"])),
        thickness=1.0 if box["lost"] else 2.0,
    )


def _box_label(box: dict[str, Any], stamp: Timestamp) -> TextAnnotation:
    u, v, w, h = box["box"]
    away = "" if box["distance_m"] is None else f" {box['distance_m']:.1f} m"
    return TextAnnotation(
        timestamp=stamp,
        position=Point2(x=u - 0.5 * w, y=v - 0.5 * h),
        text=f"{name_of(box['identity'])}{away}",
        font_size=12.0,
        text_color=shade(colour_of(box["identity"])),
        background_color=shade((0, 0, 0), 0.5),
    )


def log_of(event: dict[str, Any], stamp: Timestamp) -> Written:
    """An event of the page; its text may be a drone's own."""
    who = "monitor" if event["drone"] is None else f"drone {event['drone']}"
    level = LOG_LEVELS.get(event["kind"], LogLevel.Info)
    return EVENTS_LOG, Log(timestamp=stamp, level=level, message=plain(event["text"]), name=who).encode()
