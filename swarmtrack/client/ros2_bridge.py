"""Bridge from a team's messages to ROS 2: what each drone says, as topics of `outputs.ros2`."""

from __future__ import annotations

import asyncio
import logging
import math
from contextlib import suppress
from typing import Final, Protocol

import numpy as np

from swarmtrack.client.axes import Axes
from swarmtrack.client.freshness import OFF_TIME_S, Mark
from swarmtrack.client.heard import HeardTeam, Timed
from swarmtrack.client.swarm import ask_for_cameras
from swarmtrack.clock import Clock, utc_offset
from swarmtrack.errors import TransportError
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import from_quaternion
from swarmtrack.messages import Array
from swarmtrack.outputs.ros2.drone_topics import DroneTopics
from swarmtrack.outputs.ros2.mapping import UNKNOWN_VARIANCE, DroneFrames, DronePlace, cameras_of
from swarmtrack.outputs.ros2.node import RosPublisher
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.zenoh_listener import ZenohListener
from swarmtrack.wire.camera import CameraMessage, mounting_from
from swarmtrack.wire.checks import symmetric
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.motion import MotionMessage
from swarmtrack.wire.sightings import NOWHERE_SIGMA_M, SightingsMessage
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage

log = logging.getLogger(__name__)

BRIDGED_KINDS: Final = (Kind.CAMERA, Kind.TRACKS, Kind.HEALTH, Kind.IDENTITIES, Kind.MOTION)
MOTION_FRESH_S: Final = 1.0
"""s: velocity and displacement are sent twice per second at least."""
VIEW_FRESH_S: Final = 0.5
"""s: pictures come at 10 Hz, each with position and attitude; sightings, once per second, are without attitude."""


BRIDGE_LOOK_S: Final = 0.5
"""s between two looks for pictures that are wanted, and for drones that are gone."""


class SpokenPlace:
    """Place of one drone from its messages: its camera's position from sightings, carried on by its displacement; with
    pictures also its attitude. Each method returns a new place, or None. t_utc_s: as in `DroneTopics`.
    """

    def __init__(self) -> None:
        self._anchor: Array | None = None
        """Position minus displacement, m."""
        self._position_cov = np.eye(3) * UNKNOWN_VARIANCE
        self._motion: tuple[float, MotionMessage] | None = None
        self._viewed_t = -math.inf

    def on_sightings(self, message: SightingsMessage, t_utc_s: float) -> DronePlace | None:
        if message.position_sigma_m >= NOWHERE_SIGMA_M:
            self._anchor = None
            return None
        position = np.array(message.position_m)
        self._position_cov = np.eye(3) * message.position_sigma_m**2
        self._anchor = position - self._displacement(t_utc_s)
        return None if self._is_viewed(t_utc_s) else self._place(position, t_utc_s)

    def on_motion(self, message: MotionMessage, t_utc_s: float) -> DronePlace | None:
        if self._motion is None or self._motion[1].boot != message.boot:
            self._anchor = None
        self._motion = t_utc_s, message
        if self._anchor is None or self._is_viewed(t_utc_s):
            return None
        return self._place(self._anchor + np.array(message.displacement_m), t_utc_s)

    def on_video(self, message: VideoMessage, mounting: Pose, t_utc_s: float) -> DronePlace | None:
        """mounting: body from camera."""
        if message.position_m is None or message.quaternion_wxyz is None:
            return None
        self._viewed_t = t_utc_s
        camera = Pose(from_quaternion(message.quaternion_wxyz), np.array(message.position_m))
        body = camera @ mounting.inverse()
        return self._place(body.position, t_utc_s, body.rotation)

    def _place(self, position: Array, t_utc_s: float, attitude: Array | None = None) -> DronePlace:
        velocity = velocity_cov = None
        if self._motion is not None and abs(t_utc_s - self._motion[0]) < MOTION_FRESH_S:
            velocity = np.array(self._motion[1].velocity_m_s)
            velocity_cov = symmetric(np.array([self._motion[1].velocity_cov_m2_s2]), 3)[0]
        return DronePlace(
            t_utc_s, position, self._position_cov, attitude, velocity=velocity, velocity_cov=velocity_cov
        )

    def _displacement(self, t_utc_s: float) -> Array:
        """Since the drone's start, as far as it is told; between two messages at its velocity."""
        if self._motion is None:
            return np.zeros(3)
        t, message = self._motion
        elapsed = t_utc_s - t if abs(t_utc_s - t) < MOTION_FRESH_S else 0.0
        return np.array(message.displacement_m) + elapsed * np.array(message.velocity_m_s)

    def _is_viewed(self, t_utc_s: float) -> bool:
        return abs(t_utc_s - self._viewed_t) < VIEW_FRESH_S


class _BridgedDrone:
    def __init__(self, node: RosPublisher, frames: DroneFrames, hz: float) -> None:
        self.topics = DroneTopics(node, frames, hz)
        self.frames = frames
        self.place = SpokenPlace()
        self.camera: CameraMessage | None = None


class PictureListener(Protocol):
    """Subscriber that can take further keys."""

    async def listen_to(self, key_expression: str) -> None: ...

    async def leave(self, key_expression: str) -> None: ...


class TeamBridge:
    """Carries a team's messages to a node. hz: of each drone's tracks, at most."""

    def __init__(self, team: str, node: RosPublisher, *, namespace: str, hz: float, clock: Clock) -> None:
        self._team = team
        self._node = node
        self._namespace = namespace
        self._hz = hz
        self._clock = clock
        self._heard = HeardTeam(team, Axes.NED, clock)
        self._drones: dict[int, _BridgedDrone] = {}
        self._watched: set[str] = set()

    @property
    def drones(self) -> tuple[int, ...]:
        """IDs of all live drones."""
        return self._heard.drones

    @property
    def key_expressions(self) -> list[str]:
        """What a listener is to subscribe to; pictures only while ROS 2 subscribes to them."""
        return [
            keys.key(self._team, Kind.ALIVE, "*", "*"),
            *(keys.key(self._team, kind, "*") for kind in BRIDGED_KINDS),
        ]

    async def run(self, listener: ZenohListener) -> None:
        """Until cancelled, or until the listener is closed."""
        tasks = [
            asyncio.create_task(self._look(listener), name="bridge"),
            asyncio.create_task(ask_for_cameras(self._heard, listener), name="cameras"),
        ]
        try:
            async for sample in listener.samples():
                self.on_sample(sample)
        finally:
            for task in tasks:
                task.cancel()

    def on_sample(self, sample: Sample) -> None:
        """Publish a message of the team, if it counts and is not old."""
        address = keys.parse(sample.key)
        if address is None or address.team != self._team:
            return
        if address.kind is Kind.ALIVE:
            self._heard.on_token(sample.key, sample.alive, sample.arrived)
            for drone_id in self._heard.drones:
                self._drone(drone_id)
            return
        if address.drone_id not in self._heard.drones:
            return
        drone = self._drone(address.drone_id)
        match address.kind:
            case Kind.CAMERA if (camera := self._heard.on_camera(sample)) is not None:
                drone.camera = camera
                drone.topics.on_camera(camera)
            case Kind.TRACKS if (tracks := self._news(TracksMessage, sample)) is not None:
                if drone.topics.is_due(tracks[1]):
                    drone.topics.on_tracks(*tracks)
            case Kind.HEALTH if (health := self._news(HealthMessage, sample)) is not None:
                drone.topics.on_health(*health)
            case Kind.IDENTITIES if (sightings := self._news(SightingsMessage, sample)) is not None:
                self._put(drone, drone.place.on_sightings(*sightings))
            case Kind.MOTION if (motion := self._news(MotionMessage, sample)) is not None:
                self._put(drone, drone.place.on_motion(*motion))
            case Kind.VIDEO if (video := self._news(VideoMessage, sample)) is not None:
                self._on_video(drone, video[0], keys.camera_of(address) or 0, video[1])

    def _on_video(self, drone: _BridgedDrone, video: VideoMessage, camera: int, t_utc_s: float) -> None:
        mounted = [] if drone.camera is None else cameras_of(drone.camera)
        if camera < len(mounted):
            self._put(drone, drone.place.on_video(video, mounting_from(mounted[camera]), t_utc_s))
        drone.topics.on_video(video, camera, t_utc_s)

    def _put(self, drone: _BridgedDrone, place: DronePlace | None) -> None:
        if place is not None:
            drone.topics.on_place(place)

    def _drone(self, drone_id: int) -> _BridgedDrone:
        if drone_id not in self._drones:
            frames = DroneFrames(self._namespace, drone_id)
            self._drones[drone_id] = _BridgedDrone(self._node, frames, self._hz)
        return self._drones[drone_id]

    def _news(self, message: type[Timed], sample: Sample) -> tuple[Timed, float] | None:
        """A message and its time, UTC [s]: of a drone whose clock is far from ours, the time of its arrival."""
        kind = next(kind for kind, known in keys.MESSAGES.items() if known is message)
        received = self._heard.receive(message, kind, sample)
        if received is None or received[2] & {Mark.REPEATED, Mark.OUT_OF_ORDER}:
            return None
        arrived = sample.arrived + utc_offset(self._clock)
        stated = received[1].t_utc_s
        return received[1], stated if abs(arrived - stated) <= OFF_TIME_S else arrived

    async def _look(self, listener: ZenohListener) -> None:
        while True:
            await asyncio.sleep(BRIDGE_LOOK_S)
            with suppress(TransportError):
                await self.follow(listener)

    async def follow(self, listener: PictureListener) -> None:
        """Ask drones for the pictures that ROS 2 subscribes to, and for no others; take back the topics of drones that
        are gone. Raises TransportError.
        """
        for drone_id in set(self._drones) - set(self._heard.drones):
            await self._node.forget(f"/{self._drones.pop(drone_id).frames.prefix}/")
        wanted = {
            keys.video_key(self._team, drone_id, camera)
            for drone_id, drone in self._drones.items()
            for camera in drone.topics.wanted_pictures
        }
        for key in wanted - self._watched:
            await listener.listen_to(key)
            self._watched.add(key)
        for key in self._watched - wanted:
            await listener.leave(key)
            self._watched.discard(key)
