"""[output] ros2: one drone's own topics of ROS 2, from the messages that its agent makes anyway and its own pose."""

from __future__ import annotations

from collections.abc import Sequence

from swarmtrack.clock import Clock
from swarmtrack.config.ros2 import Ros2Section
from swarmtrack.outputs.ros2.connection import ros2_network
from swarmtrack.outputs.ros2.drone_topics import DroneTopics
from swarmtrack.outputs.ros2.mapping import DroneFrames, DronePlace
from swarmtrack.outputs.ros2.node import RosNode
from swarmtrack.perceived import TeamView
from swarmtrack.transport.joining import keep_joining
from swarmtrack.wire.camera import camera_message
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage


class Ros2Output:
    """Topics of this drone. Without a router of ROS 2 the agent flies on, and joins it when it comes.

    clock: the flight's. Raises TransportError for an address that is refused.
    """

    def __init__(
        self, section: Ros2Section, perceived: TeamView, clock: Clock, *, drone_id: int, boot: str
    ) -> None:
        network = ros2_network(section.router, "output.ros2.router", serve=False, insecure=section.insecure)
        self._perceived = perceived
        self._clock = clock
        self._drone_id = drone_id
        self._boot = boot
        self._node = RosNode(network, section, f"swarmtrack_d{drone_id}", clock)
        self._topics = DroneTopics(self._node, DroneFrames(section.namespace, drone_id), section.hz)

    async def run(self) -> None:
        """Join the router; ends once it is joined."""
        cameras = self._perceived.cameras
        lenses, mountings = [one.lens for one in cameras], [one.body_from_camera for one in cameras]
        self._topics.on_camera(camera_message(self._drone_id, self._boot, lenses, mountings))
        await keep_joining(self._node.open)

    def on_tracks(self, message: TracksMessage, now: float) -> None:
        """Tracks as of now [s], on the flight's clock."""
        if not self._topics.is_due(message.t_utc_s):
            return
        if self._topics.wants_place and (place := self._place(message.t_utc_s, now)) is not None:
            self._topics.on_place(place)
        self._topics.on_tracks(message, message.t_utc_s)

    def on_health(self, message: HealthMessage) -> None:
        """Health, once per second."""
        self._topics.on_health(message, message.t_utc_s)

    @property
    def wanted_pictures(self) -> Sequence[int]:
        """Cameras whose pictures are looked at."""
        return self._topics.wanted_pictures

    def on_video(self, message: VideoMessage, camera: int) -> None:
        """A picture."""
        self._topics.on_video(message, camera, message.t_utc_s)

    async def close(self) -> None:
        await self._node.close()

    def _place(self, t_utc_s: float, now: float) -> DronePlace | None:
        pose = self._perceived.ego_pose(now)
        if pose is None:
            return None
        motion = self._perceived.motion_report(self._boot, 0)
        return DronePlace(
            t_utc_s,
            pose.position,
            pose.position_cov,
            pose.world_from_body,
            pose.attitude_cov,
            velocity=None if motion is None else motion.velocity,
            velocity_cov=None if motion is None else motion.velocity_cov,
        )
