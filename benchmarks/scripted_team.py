"""Drones that say what they are told to, over real Zenoh on loopback: no camera, no tracker, no agent process.

All speak through one session, as thirty of their own would cost more than what is to be tested.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import cv2
import numpy as np
import zenoh

from swarmtrack.clock import SystemClock
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.rotation import to_quaternion
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
from swarmtrack.wire.health import HealthMessage, LatencyHealth, LinkHealth, RateHealth
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.sightings import sightings_message
from swarmtrack.wire.tracks import tracks_message
from swarmtrack.wire.video import VideoMessage

CLOCK = SystemClock()
FOCAL = 180.0  # px: 83 degrees, so that three on a circle see each other
CAMERA = PinholeCamera(FOCAL, FOCAL, 160.0, 128.0, 320, 256)


class ScriptedDrone:
    """One on a circle, looking at its middle. calls: by what name it calls whom; imu_hz: what it gets."""

    def __init__(
        self, session: zenoh.Session, team: str, drone_id: int, *, angle: float, radius: float
    ) -> None:
        self.drone_id = drone_id
        self.calls: dict[int, int] = {}
        self.imu_hz = 200.0
        self.pictures = 0
        self._angle = angle
        self._radius = radius
        self._boot = keys.new_boot()
        self._session = session
        self._name = team
        self._token: zenoh.LivelinessToken | None = None
        self._publishers = {
            kind: session.declare_publisher(keys.key(team, kind, drone_id))
            for kind in (Kind.POSE, Kind.IDENTITIES, Kind.TRACKS, Kind.HEALTH, Kind.VIDEO)
        }
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

    def position(self, t: float) -> np.ndarray:
        turn = self._angle + 0.05 * t
        return np.array([self._radius * math.cos(turn), self._radius * math.sin(turn), -2.0])

    def camera(self, t: float) -> np.ndarray:
        """world_from_camera (3, 3): level, right, down and ahead."""
        turn = self._angle + 0.05 * t
        north, east = -math.cos(turn), -math.sin(turn)
        return np.array([[-east, 0.0, north], [north, 0.0, east], [0.0, 1.0, 0.0]])

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
        status: Any = self._publishers[Kind.VIDEO].matching_status  # Zenoh's stubs call it a bool
        return bool(status.matching)

    def _say(self, kind: Kind, payload: bytes) -> None:
        self._publishers[kind].put(payload)

    async def _speak(self) -> None:
        tick = 0
        while True:
            now = CLOCK.now()
            seen = self._in_view(now)
            self._sequence += 1
            offset = CLOCK.utc() - now
            if tick % 5 == self.drone_id % 5:
                self._say_sightings(now, offset, seen)
            if tick % 10 == 0:
                self._announce(now, offset)
                self._say(Kind.HEALTH, codec.encode(self._health()))
            self._say_tracks(now, offset, seen)
            if self.is_watched:
                self._say_video(now, offset, seen)
            tick += 1
            await asyncio.sleep(0.1)

    def _announce(self, now: float, offset: float) -> None:
        pose = Announcement(
            self.drone_id, self._boot, 1, now, 0.05, self.position(now), np.eye(3), 0.01 * np.eye(3)
        )
        self._say(Kind.POSE, codec.encode(announcement_message(pose, offset, now)))

    def _in_view(self, now: float) -> dict[int, np.ndarray]:
        """Vectors in the camera's frame, by true ID."""
        others = [other for other in self.team if other is not self]
        from_here = np.array([other.position(now) for other in others]).reshape(-1, 3) - self.position(now)
        return {
            other.drone_id: there
            for other, there in zip(others, from_here @ self.camera(now), strict=True)
            if there[2] > 0.5 and abs(there[0]) < 0.85 * there[2]
        }

    def _say_sightings(self, now: float, offset: float, seen: dict[int, np.ndarray]) -> None:
        sightings = [
            Sighting(self.calls.get(who, who), 0.99, self.camera(now) @ (v / np.linalg.norm(v)), 0.01)
            for who, v in seen.items()
        ]
        named = {s.drone_id: s for s in sightings}  # of each name one
        report = SightingReport(
            self.drone_id,
            self._boot,
            self._sequence,
            now,
            0.0,
            self.position(now),
            0.1,
            (),
            tuple(named.values()),
        )
        self._say(Kind.IDENTITIES, codec.encode(sightings_message(report, offset, now)))

    def _say_tracks(self, now: float, offset: float, seen: dict[int, np.ndarray]) -> None:
        tracks = []
        for who, v in seen.items():
            u, w = FOCAL * v[0] / v[2] + 160.0, FOCAL * v[1] / v[2] + 128.0
            size = np.array([FOCAL, 0.4 * FOCAL]) * 0.9 / v[2]
            track = Track(
                who,
                now,
                np.array([u, 12.0, w, 3.0]),
                np.diag([4.0, 9.0, 2.0, 9.0]),
                TrackStatus.CONFIRMED,
                1.0,
                size,
            )
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

    def _say_video(self, now: float, offset: float, seen: dict[int, np.ndarray]) -> None:
        picture = self._scene.copy()
        for v in seen.values():
            centre = (round(FOCAL * v[0] / v[2] + 160.0), round(FOCAL * v[1] / v[2] + 128.0))
            cv2.ellipse(
                picture,
                centre,
                (round(0.4 * FOCAL / v[2]), round(0.13 * FOCAL / v[2])),
                0,
                0,
                360,
                (40, 40, 44),
                -1,
            )
        jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
        camera = self.camera(now)
        view = VideoMessage(
            1, now + offset, 0.05, self._sequence, CAMERA.width, CAMERA.height, jpeg, lens_message(CAMERA),
            tuple(self.position(now).tolist()), tuple(to_quaternion(camera).tolist()),
        )  # fmt: skip
        self._say(Kind.VIDEO, codec.encode(view))
        self.pictures += 1

    def _health(self) -> HealthMessage:
        rng = np.random.default_rng(self._sequence)
        return HealthMessage(
            1, CLOCK.utc(), self._boot, 60.0, 12.0 + rng.normal(), 90.0,
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
async def scripted_team(team: str, n: int) -> AsyncIterator[list[ScriptedDrone]]:
    """n of them, 1 … n, on one circle."""
    session = await open_session(NetworkSettings(team=team))
    drones = [
        ScriptedDrone(session, team, i + 1, angle=2.0 * math.pi * i / n, radius=4.0 + 0.6 * n)
        for i in range(n)
    ]
    try:
        for drone in drones:
            drone.team = drones
            drone.start()
        yield drones
    finally:
        for drone in drones:
            drone.fall_silent()
        await close_session(session, [])
