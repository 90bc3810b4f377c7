"""Drones that say what they are told to, over real Zenoh on loopback: no camera, no tracker, no agent process.

All speak through one session, as thirty of their own would cost more than what is to be tested.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

import cv2
import numpy as np
import zenoh

from swarmtrack.clock import SystemClock
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA, exp, to_quaternion
from swarmtrack.messages import (
    Announcement,
    IdentifiedTrack,
    RelativeState,
    Sighting,
    SightingReport,
    Track,
    TrackList,
    TrackStatus,
)
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_session import close_session, open_session
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import announcement_message
from swarmtrack.wire.camera import camera_message
from swarmtrack.wire.health import HealthMessage, LatencyHealth, LinkHealth, RateHealth
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.sightings import sightings_message
from swarmtrack.wire.tracks import tracks_message
from swarmtrack.wire.video import VideoMessage

CLOCK = SystemClock()
FOCAL = 180.0  # px: 83 degrees, so that three on a circle see each other
CAMERA = PinholeCamera(FOCAL, FOCAL, 160.0, 128.0, 320, 256)
DOWN = np.array([0.0, 0.0, 1.0])
SPIN = 0.15  # rad/s of a drone with several cameras: who it sees goes from one to the next


class InView(NamedTuple):
    """A teammate in one of the cameras: number, and vector in its frame (3,)."""

    camera: int
    vector: np.ndarray


class ScriptedDrone:
    """One on a circle, looking at its middle; with several cameras, which look all around, it turns.

    calls: by which name it calls whom; imu_hz: what it gets; pictures: how many it has sent, of each camera; told: UTC
    of its messages, and what its clock showed then, s.
    """

    def __init__(
        self,
        session: zenoh.Session,
        team: str,
        drone_id: int,
        *,
        angle: float,
        radius: float,
        cameras: int = 1,
    ) -> None:
        self.drone_id = drone_id
        self.calls: dict[int, int] = {}
        self.imu_hz = 200.0
        self.pictures: list[int] = []
        self.told: deque[tuple[float, float]] = deque(maxlen=1000)
        self._mountings: list[Pose] = []
        self._pictures: list[zenoh.Publisher] = []
        self._angle = angle
        self._radius = radius
        self._boot = keys.new_boot()
        self._session = session
        self._name = team
        self._token: zenoh.LivelinessToken | None = None
        self._publishers = {
            kind: session.declare_publisher(keys.key(team, kind, drone_id))
            for kind in (Kind.POSE, Kind.CAMERA, Kind.IDENTITIES, Kind.TRACKS, Kind.HEALTH)
        }
        self.look_around(cameras)
        self._sequence = 0
        self.team: list[ScriptedDrone] = []
        rng = np.random.default_rng(drone_id)
        row = np.linspace(0.0, 1.0, CAMERA.height)[:, None, None]
        sky, ground = (
            np.array([225.0, 195.0, 165.0]) - 50.0 * row,
            np.array([85.0, 125.0, 105.0]) - 20.0 * row,
        )
        scene = np.where(row < 0.6, sky, ground) + rng.normal(0.0, 3.0, (CAMERA.height, CAMERA.width, 3))
        self._scene = np.clip(scene, 0, 255).astype(np.uint8)

    def look_around(self, cameras: int) -> None:
        """With so many cameras from now on."""
        self._mountings = [
            Pose(exp(2.0 * math.pi * k / cameras * DOWN) @ BODY_FROM_FORWARD_CAMERA, np.zeros(3))
            for k in range(cameras)
        ]
        for k in range(len(self._pictures), cameras):
            key = keys.video_key(self._name, self.drone_id, k)
            self._pictures.append(self._session.declare_publisher(key))
            self.pictures.append(0)

    def position(self, t: float) -> np.ndarray:
        turn = self._angle + 0.05 * t
        return np.array([self._radius * math.cos(turn), self._radius * math.sin(turn), -2.0])

    def body(self, t: float) -> np.ndarray:
        """world_from_body (3, 3), level."""
        ahead = self._angle + 0.05 * t + math.pi  # to the middle of the circle
        if len(self._mountings) > 1:
            ahead += SPIN * t
        north, east = math.cos(ahead), math.sin(ahead)
        return np.array([[north, -east, 0.0], [east, north, 0.0], [0.0, 0.0, 1.0]])

    def camera(self, t: float, number: int = 0) -> np.ndarray:
        """world_from_camera (3, 3)."""
        return self.body(t) @ self._mountings[number].rotation

    def start(self) -> None:
        token = keys.key(self._name, Kind.ALIVE, self.drone_id, self._boot)
        self._token = self._session.liveliness().declare_token(token)
        self._speaking = asyncio.create_task(self._speak(), name=f"scripted {self.drone_id}")

    def fall_silent(self) -> None:
        """As one whose radio died: its token stays until the lease ends."""
        self._speaking.cancel()

    def die(self) -> None:
        """As after kill -9: the token goes at once."""
        self.fall_silent()
        if self._token is not None:
            self._token.undeclare()  # type: ignore[no-untyped-call]

    @property
    def is_watched(self) -> bool:
        return bool(self.watched)

    @property
    def watched(self) -> list[int]:
        """Cameras whose pictures somebody listens to."""
        status: list[Any] = [one.matching_status for one in self._pictures]  # Zenoh's stubs call it a bool
        return [number for number, one in enumerate(status) if one.matching]

    def _say(self, kind: Kind, payload: bytes) -> None:
        self._publishers[kind].put(payload)

    async def _speak(self) -> None:
        tick = 0
        while True:
            now = CLOCK.now()
            offset = CLOCK.utc() - now
            self.told.append((now + offset, now))
            seen = self._in_view(now)
            self._sequence += 1
            if tick % 5 == self.drone_id % 5:
                self._say_sightings(now, offset, seen)
            if tick % 10 == 0:
                self._announce(now, offset)
                self._say(Kind.HEALTH, codec.encode(self._health()))
                lenses = [CAMERA] * len(self._mountings)
                told = camera_message(self.drone_id, self._boot, lenses, self._mountings)
                self._say(Kind.CAMERA, codec.encode(told))
            self._say_tracks(now, offset, seen)
            for number in self.watched:
                self._say_video(now, offset, seen, number)
            tick += 1
            await asyncio.sleep(0.1)

    def _announce(self, now: float, offset: float) -> None:
        place, cov = self.position(now), 0.01 * np.eye(3)
        pose = Announcement(self.drone_id, self._boot, 1, now, 0.05, place, np.eye(3), cov)
        self._say(Kind.POSE, codec.encode(announcement_message(pose, offset, now)))

    def _in_view(self, now: float) -> dict[int, InView]:
        """By true ID."""
        others = [other for other in self.team if other is not self]
        from_here = np.array([other.position(now) for other in others]).reshape(-1, 3) - self.position(now)
        return {
            other.drone_id: InView(number, there)
            for number in range(len(self._mountings))
            for other, there in zip(others, from_here @ self.camera(now, number), strict=True)
            if there[2] > 0.5 and abs(there[0]) < 0.85 * there[2]
        }

    def _say_sightings(self, now: float, offset: float, seen: dict[int, InView]) -> None:
        sightings = [
            Sighting(self.calls.get(who, who), 0.99, self.camera(now, k) @ (v / np.linalg.norm(v)), 0.01)
            for who, (k, v) in seen.items()
        ]
        named = tuple({s.drone_id: s for s in sightings}.values())  # of each name one
        sent = self.drone_id, self._boot, self._sequence, now, 0.0
        report = SightingReport(*sent, self.position(now), 0.1, (), named)
        self._say(Kind.IDENTITIES, codec.encode(sightings_message(report, offset, now)))

    def _say_tracks(self, now: float, offset: float, seen: dict[int, InView]) -> None:
        tracks = []
        for who, (number, v) in seen.items():
            u, w = FOCAL * v[0] / v[2] + 160.0, FOCAL * v[1] / v[2] + 128.0
            size = np.array([FOCAL, 0.4 * FOCAL]) * 0.9 / v[2]
            mean, cov = np.array([u, 12.0, w, 3.0]), np.diag([4.0, 9.0, 2.0, 9.0])
            track = Track(who, now, mean, cov, TrackStatus.CONFIRMED, 1.0, size, camera=number)
            called = self.calls.get(who, who)
            tracks.append(IdentifiedTrack(track, called, 0.99, relative=self._relative(who, called, now)))
        message = tracks_message(TrackList(now, now - 0.02, tuple(tracks)), self._sequence, offset, 0.05)
        self._say(Kind.TRACKS, codec.encode(message))

    def _relative(self, who: int, called: int, now: float) -> RelativeState:
        """The truth, known to 5 % of the distance and 1 % across."""
        there, then = (self.team[who - 1].position(t) - self.position(t) for t in (now, now - 0.1))
        distance = float(np.linalg.norm(there))
        towards = np.outer(there, there) / distance**2
        spread = distance**2 * (0.05**2 * towards + 0.01**2 * (np.eye(3) - towards))
        cov = np.block([[spread, np.zeros((3, 3))], [np.zeros((3, 3)), 0.01 * np.eye(3)]])
        return RelativeState(called, now, there, (there - then) / 0.1, cov, 0.05, ("announcement",))

    def _say_video(self, now: float, offset: float, seen: dict[int, InView], number: int) -> None:
        picture = self._scene.copy()
        for v in (one.vector for one in seen.values() if one.camera == number):
            centre = (round(FOCAL * v[0] / v[2] + 160.0), round(FOCAL * v[1] / v[2] + 128.0))
            axes = round(0.4 * FOCAL / v[2]), round(0.13 * FOCAL / v[2])
            cv2.ellipse(picture, centre, axes, 0, 0, 360, (40, 40, 44), -1)
        jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
        camera = self.camera(now, number)
        view = VideoMessage(
            1, now + offset, 0.05, self._sequence, CAMERA.width, CAMERA.height, jpeg, lens_message(CAMERA),
            tuple(self.position(now).tolist()), tuple(to_quaternion(camera).tolist()),
        )  # fmt: skip
        self._pictures[number].put(codec.encode(view))
        self.pictures[number] += 1

    def _health(self) -> HealthMessage:
        rng = np.random.default_rng(self._sequence)
        return HealthMessage(
            1, CLOCK.utc(), self._boot, 60.0 + 0.1 * self._sequence, 12.0 + rng.normal(), 90.0,
            {
                "imu": RateHealth(200.0, self.imu_hz), "detections": RateHealth(None, 15.0 + rng.normal()),
                "tracks": RateHealth(50.0, 49.8),
            },
            {
                "detector": LatencyHealth(0.012, 0.019, 0.03),
                "exposure_to_detector": LatencyHealth(0.01, 0.02, 0.03),
            },
            0.0123, 0.0004, (LinkHealth("autopilot", True, "ArduPilot, 200 Hz", {}),), {"stale_frames": 2},
            ("drone 1 announced itself",),
        )  # fmt: skip


@asynccontextmanager
async def scripted_team(team: str, n: int, cameras: int = 1) -> AsyncIterator[list[ScriptedDrone]]:
    """n of them, 1 … n, on one circle, each with so many cameras."""
    radius = 4.0 + 0.6 * n

    def made(session: zenoh.Session, drone_id: int) -> ScriptedDrone:
        angle = 2.0 * math.pi * (drone_id - 1) / n
        return ScriptedDrone(session, team, drone_id, angle=angle, radius=radius, cameras=cameras)

    async with speaking(team, n, made) as drones:
        yield drones


@asynccontextmanager
async def speaking(
    team: str, n: int, made: Callable[[zenoh.Session, int], ScriptedDrone], *, first: int = 1
) -> AsyncIterator[list[ScriptedDrone]]:
    """n drones, 1 … n, of which those from `first` on speak; made: makes one of an ID, in a session."""
    session = await open_session(NetworkSettings(team=team))
    drones = [made(session, drone_id) for drone_id in range(1, n + 1)]
    try:
        for drone in drones:
            drone.team = drones
        for drone in drones[first - 1 :]:
            drone.start()
        yield drones
    finally:
        for drone in drones[first - 1 :]:
            drone.fall_silent()
        await close_session(session, [])
