"""Topics of one drone, from its messages as they are on the wire."""

from __future__ import annotations

import math
from functools import partial
from typing import Final

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.outputs.ros2 import mapping
from swarmtrack.outputs.ros2.cdr import Leaves
from swarmtrack.outputs.ros2.mapping import DroneFrames, DronePlace, Row
from swarmtrack.outputs.ros2.node import QOS_FRAMES, QOS_SENSOR, RosPublisher
from swarmtrack.wire.camera import CameraMessage
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.lens import camera_from
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage

ROS_ODOMETRY: Final = "nav_msgs/msg/Odometry"
ROS_POSES: Final = "geometry_msgs/msg/PoseArray"
ROS_TEAMMATE_POSE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
ROS_TEAMMATE_TWIST: Final = "geometry_msgs/msg/TwistWithCovarianceStamped"
ROS_TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
ROS_MARKERS: Final = "visualization_msgs/msg/MarkerArray"
ROS_DIAGNOSTICS: Final = "diagnostic_msgs/msg/DiagnosticArray"
ROS_LENS: Final = "sensor_msgs/msg/CameraInfo"
ROS_PICTURE: Final = "sensor_msgs/msg/CompressedImage"
ROS_BOXES: Final = "vision_msgs/msg/Detection2DArray"

PICTURES_AGE_S: Final = 1.5
"""s without a picture, after which `camera_info` is of the calibrated image again."""
RATE_JITTER_S: Final = 0.002
"""How much earlier than due a message may be: a timer's jitter must not halve the rate."""
CLOCK_SET_BACK_S: Final = 1.0
"""Earlier by more than this, and the clock was set."""
MARKERS_HZ: Final = 5.0
"""For eyes; they cost more than everything else."""


class Pace:
    """At most so many messages per second, on average."""

    def __init__(self, hz: float) -> None:
        self._period = 1.0 / hz
        self._due = -math.inf

    def is_due(self, t: float) -> bool:
        """Whether to send what holds at t [s]; one that is sent moves the next."""
        early = self._due - t
        if RATE_JITTER_S < early < self._period + CLOCK_SET_BACK_S:
            return False
        self._due = (self._due if abs(early) < self._period else t) + self._period
        return True


class DroneTopics:
    """Offers each message to ROS 2; whatever is not subscribed to costs a question.

    The caller asks `is_due` before `on_tracks`; hz: how often that says yes. t_utc_s: UTC of the drone, or where its
    clock is far off, ours.
    """

    def __init__(self, node: RosPublisher, frames: DroneFrames, hz: float) -> None:
        self._node = node
        self._frames = frames
        self._camera: CameraMessage | None = None
        self._lenses: list[PinholeCamera] = []
        self._place: DronePlace | None = None
        self._tracks_pace, self._markers_pace = Pace(hz), Pace(min(hz, MARKERS_HZ))
        self._pictured_t = dict[int, float]()
        self._markers_topic = f"/{frames.namespace}/markers"
        node.declare(frames.topic("odometry"), ROS_ODOMETRY)
        node.declare(frames.topic("teammates"), ROS_POSES)
        node.declare("/tf", ROS_TRANSFORMS, QOS_FRAMES)
        node.declare("/tf_static", ROS_TRANSFORMS, QOS_FRAMES)
        node.declare("/diagnostics", ROS_DIAGNOSTICS)
        node.declare(self._markers_topic, ROS_MARKERS)

    def on_camera(self, camera: CameraMessage) -> None:
        """Lenses and mountings of the drone's cameras."""
        self._camera = camera
        self._lenses = [camera_from(one.lens) for one in mapping.cameras_of(camera)]
        for k in range(len(self._lenses)):
            self._node.declare(self._frames.camera_topic(k, "camera_info"), ROS_LENS, QOS_SENSOR)
            self._node.declare(self.picture_topic(k), ROS_PICTURE, QOS_SENSOR)
            self._node.declare(self._frames.camera_topic(k, "detections"), ROS_BOXES, QOS_SENSOR)

    def is_due(self, t_utc_s: float) -> bool:
        """Whether tracks of this instant are to be sent."""
        return self._tracks_pace.is_due(t_utc_s)

    @property
    def wants_place(self) -> bool:
        """Whether anything that depends on the drone's place is subscribed to."""
        topics = (self._frames.topic("odometry"), "/tf", self._markers_topic)
        return any(map(self._node.has_listener, topics))

    def on_place(self, place: DronePlace) -> None:
        """Odometry and transforms."""
        self._place = place
        if not self.wants_place:
            return
        pose = mapping.map_pose(place)
        self._offer("odometry", ROS_ODOMETRY, partial(mapping.odometry, place, pose, self._frames))
        moving = partial(mapping.transforms, place, pose, self._camera, self._frames)
        self._node.offer("/tf", ROS_TRANSFORMS, moving, QOS_FRAMES)

    def on_tracks(self, tracks: TracksMessage, t_utc_s: float) -> None:
        """Teammates, markers and detections."""
        at = (t_utc_s, self._frames)
        known = mapping.named(tracks)
        self._offer("teammates", ROS_POSES, partial(mapping.teammates, known, *at))
        for drone_id, relative in known.items():
            name = f"teammate{drone_id}"
            self._offer(f"{name}/pose", ROS_TEAMMATE_POSE, partial(mapping.teammate_pose, relative, *at))
            self._offer(f"{name}/twist", ROS_TEAMMATE_TWIST, partial(mapping.teammate_twist, relative, *at))
        if self._markers_pace.is_due(t_utc_s):
            self._node.offer(self._markers_topic, ROS_MARKERS, partial(self._markers, tracks, t_utc_s))
        for k in range(len(self._lenses)):
            boxes = partial(self._detections, tracks, k, t_utc_s)
            self._node.offer(self._frames.camera_topic(k, "detections"), ROS_BOXES, boxes, QOS_SENSOR)

    def on_health(self, health: HealthMessage, t_utc_s: float) -> None:
        """Once per second: diagnostics, and what late subscribers need of the cameras."""
        words = partial(mapping.diagnostics, health, t_utc_s, self._frames.drone_id)
        self._node.offer("/diagnostics", ROS_DIAGNOSTICS, words)
        if self._camera is None:
            return
        mountings = partial(mapping.static_transforms, self._camera, t_utc_s, self._frames)
        self._node.offer("/tf_static", ROS_TRANSFORMS, mountings, QOS_FRAMES)
        for k, lens in enumerate(self._lenses):
            if not 0.0 <= t_utc_s - self._pictured_t.get(k, -math.inf) < PICTURES_AGE_S:
                self._offer_lens(k, lens.width, lens.height, t_utc_s)

    def on_video(self, video: VideoMessage, camera: int, t_utc_s: float) -> None:
        """A picture, and with the same stamp the lens scaled to it."""
        if not video.jpeg:
            return
        self._pictured_t[camera] = t_utc_s
        picture = partial(mapping.compressed_image, video.jpeg, t_utc_s, self._frames.optical(camera))
        self._node.offer(self.picture_topic(camera), ROS_PICTURE, picture, QOS_SENSOR)
        if camera < len(self._lenses):
            self._offer_lens(camera, video.width, video.height, t_utc_s)

    def picture_topic(self, camera: int) -> str:
        """Topic of a camera's pictures."""
        return self._frames.camera_topic(camera, "image/compressed")

    @property
    def wanted_pictures(self) -> tuple[int, ...]:
        """Cameras, counted from 0, whose pictures are subscribed to in ROS 2."""
        return tuple(k for k in range(len(self._lenses)) if self._node.has_listener(self.picture_topic(k)))

    def _offer(self, name: str, kind: str, make: partial[Row]) -> None:
        self._node.offer(self._frames.topic(name), kind, make)

    def _offer_lens(self, camera: int, width: int, height: int, t_utc_s: float) -> None:
        info = partial(
            mapping.camera_info, self._lenses[camera], width, height, t_utc_s, self._frames.optical(camera)
        )
        topic = self._frames.camera_topic(camera, "camera_info")
        self._node.offer(topic, ROS_LENS, info, QOS_SENSOR)

    def _markers(self, tracks: TracksMessage, t_utc_s: float) -> Leaves:
        place = self._place
        rays = {}
        if place is not None and place.world_from_body is not None:
            rays = dict(mapping.track_rays(tracks, self._lenses))
        return mapping.markers(tracks, rays, t_utc_s, self._frames)

    def _detections(self, tracks: TracksMessage, camera: int, t_utc_s: float) -> Leaves:
        """Tracks that are being detected, in pixels of the image."""
        seen = [
            track
            for i, track in enumerate(tracks.tracks)
            if tracks.camera_of(i) == camera and track.coasting_s is None
        ]
        ideal = np.array([(track.u_px, track.v_px) for track in seen]).reshape(-1, 2)
        centres = self._lenses[camera].distort(ideal).tolist()
        shown = [each for each in zip(seen, centres, strict=True) if all(map(math.isfinite, each[1]))]
        return mapping.detections(shown, t_utc_s, self._frames.optical(camera))
