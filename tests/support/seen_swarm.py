"""A drone on the network that says what it sees, again and again: real wire messages on a real Zenoh session."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import numpy as np

from swarmtrack.clock import SystemClock
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.messages import IdentifiedTrack, RelativeState, Track, TrackList, TrackStatus
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_transport import ZenohTransport
from swarmtrack.wire import codec
from swarmtrack.wire.camera import camera_message
from swarmtrack.wire.health import HealthMessage, ReadinessHealth
from swarmtrack.wire.tracks import TracksMessage, tracks_message

LENS = PinholeCamera(400.0, 500.0, 320.0, 240.0, 640, 480)
FORWARD = Pose(BODY_FROM_FORWARD_CAMERA, np.array([0.1, 0.0, 0.0]))
COV = np.diag([0.04, 0.09, 0.01, 0.1, 0.2, 0.3])
UTC = 1.7e9


def teammate(drone_id: int = 2) -> IdentifiedTrack:
    """8 m north, 6 m east, 1 m up; seen right of the middle by 0.75 of the focal length, so north is ahead."""
    mean = np.array([320.0 + 300.0, 4.0, 240.0 - 62.5, -2.0])
    track = Track(5, 0.0, mean, 4.0 * np.eye(4), TrackStatus.CONFIRMED, 0.9, np.array([20.0, 10.0]))
    place = RelativeState(
        drone_id, 0.0, np.array([8.0, 6.0, -1.0]), np.array([0.5, 0.0, -0.25]), COV, 0.05, ("size", "pose")
    )
    return IdentifiedTrack(track, drone_id, 0.99, relative=place)


def stranger() -> IdentifiedTrack:
    """In the middle of the image."""
    mean = np.array([320.0, 0.0, 240.0, 0.0])
    track = Track(6, 0.0, mean, np.eye(4), TrackStatus.TENTATIVE, 0.5, np.array([8.0, 8.0]))
    return IdentifiedTrack(track, None, 0.0)


def seen(sequence: int = 1, *tracks: IdentifiedTrack) -> TracksMessage:
    return tracks_message(
        TrackList(0.0, -0.05, tracks or (teammate(), stranger())), sequence, UTC + sequence / 50, 0.01
    )


def healthy(boot: str) -> HealthMessage:
    return HealthMessage(
        1, UTC, boot, 60.0, 5.0, 90.0, {}, {}, None, None, (), {}, (), readiness=ReadinessHealth(False, ("no gyro",))
    )  # fmt: skip


@contextlib.asynccontextmanager
async def speaking(network: NetworkSettings, drone_id: int = 1) -> AsyncIterator[ZenohTransport]:
    """An agent's end of the network, that says its camera, tracks and health."""
    boot = keys.new_boot()
    transport = ZenohTransport(network, drone_id, boot, SystemClock())
    transport.describe(codec.encode(camera_message(drone_id, boot, [LENS], [FORWARD])))
    await transport.open()

    async def keep_speaking() -> None:
        sequence = 0
        while True:
            sequence += 1
            transport.publish(Kind.TRACKS, codec.encode(seen(sequence)))
            transport.publish(Kind.HEALTH, codec.encode(healthy(boot)))
            await asyncio.sleep(0.02)

    task = asyncio.create_task(keep_speaking())
    try:
        yield transport
    finally:
        task.cancel()
        await transport.close()
