"""What a camera sees, for people: only while somebody listens, and small enough for one message."""

from __future__ import annotations

import asyncio
import secrets
import time

import cv2
import numpy as np
import pytest

from support.patience import PATIENCE, eventually

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from swarmtrack.benchmarks.lone_agent import agent_process
from swarmtrack.clock import SystemClock
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.rotation import from_quaternion
from swarmtrack.outputs.live_video import PICTURE_WIDTH, with_picture
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_listener import ZenohListener
from swarmtrack.wire import codec
from swarmtrack.wire.fields import MAX_MESSAGE_BYTES
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.video import VideoMessage

LENS = PinholeCamera(600.0, 600.0, 320.0, 256.0, 640, 512)
VIEW = VideoMessage(1, 1.7e9, 0.05, 1, 640, 512, b"", lens_message(LENS), None, None)


ENTRIES = {"drone.id": 1, "autopilot.link": "none", "drone.start.position_m": [1.0, 2.0, -3.0]}
CAMERA = {
    "source": "http://127.0.0.1:9/",  # never opened: the scripted camera takes its place
    **{f"intrinsics.{name}": getattr(LENS, name) for name in ("fx", "fy", "cx", "cy", "width", "height")},
}


@pytest.mark.parametrize("size", [(480, 640, 3), (3000, 4000, 3), (100, 4000), (1, 1), (480, 100, 3)])
def test_any_image_fits_into_one_message(size):
    noise = np.random.default_rng(1).integers(0, 256, size, dtype=np.uint8)  # what JPEG shrinks least
    sent = with_picture(VIEW, noise)
    assert sent is not None
    assert len(codec.encode(sent)) <= MAX_MESSAGE_BYTES
    picture = cv2.imdecode(np.frombuffer(sent.jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape[:2] == (sent.height, sent.width)
    assert sent.width <= PICTURE_WIDTH


@pytest.mark.long("of one camera; the default run has four")
async def test_an_agent_says_video_only_while_somebody_listens() -> None:
    team = f"test-{secrets.token_hex(4)}"
    entries = {**ENTRIES, "network.team": team, **{f"camera.{key}": value for key, value in CAMERA.items()}}
    listener = ZenohListener(NetworkSettings(team=team), keys.all_but_video(team), SystemClock())
    await listener.open()
    sent: list[float] = []
    frames: list[int] = []

    async def hear() -> None:
        async for sample in listener.samples():
            address = keys.parse(sample.key)
            assert address is not None
            if address.kind is Kind.VIDEO:
                frames.append(codec.decode(VideoMessage, sample.payload).frame)
            elif address.kind is Kind.HEALTH:
                counters = codec.decode(HealthMessage, sample.payload).links[-1].counters
                sent.append(counters.get("video_sent", 0.0))

    async def until(what: object) -> None:
        deadline = time.monotonic() + PATIENCE
        while not what():  # type: ignore[operator]
            assert time.monotonic() < deadline
            await asyncio.sleep(0.05)

    hearing = asyncio.create_task(hear())
    with agent_process(["swarmtrack.benchmarks.scripted_agent", "--fps", "20"], entries):
        await until(lambda: len(sent) >= 2)
        assert sent[-1] == 0  # though somebody hears everything else
        await listener.listen_to(keys.key(team, Kind.VIDEO, 1))
        await until(lambda: len(frames) >= 5)
        assert frames == sorted(set(frames))
        await listener.leave(keys.key(team, Kind.VIDEO, 1))
        await until(lambda: len(sent) >= 4 and sent[-1] == sent[-2] > 0)
    await listener.close()
    await hearing


async def test_of_four_cameras_an_agent_says_the_pictures_of_those_that_are_listened_to() -> None:
    """Each looks another way, which its picture says."""
    team = f"test-{secrets.token_hex(4)}"
    cameras = [
        {**CAMERA, "source": f"http://127.0.0.1:{9 + k}/", "body_from_camera.rpy_deg": [0.0, 0.0, 90.0 * k]}
        for k in range(4)
    ]
    entries = {**ENTRIES, "network.team": team, "camera": cameras}
    listener = ZenohListener(NetworkSettings(team=team), keys.all_but_video(team), SystemClock())
    await listener.open()
    sent: list[float] = []
    views: dict[int, list[VideoMessage]] = {k: [] for k in range(4)}

    async def hear() -> None:
        async for sample in listener.samples():
            address = keys.parse(sample.key)
            assert address is not None
            if address.kind is Kind.VIDEO:
                views[keys.camera_of(address)].append(codec.decode(VideoMessage, sample.payload))  # type: ignore[index]
            elif address.kind is Kind.HEALTH:
                (zenoh,) = (
                    one for one in codec.decode(HealthMessage, sample.payload).links if one.name == "zenoh"
                )
                sent.append(zenoh.counters.get("video_sent", 0.0))

    hearing = asyncio.create_task(hear())
    with agent_process(["swarmtrack.benchmarks.scripted_agent", "--fps", "20"], entries):
        await eventually(lambda: len(sent) >= 2)
        assert sent[-1] == 0
        await listener.listen_to(keys.video_key(team, 1, 2))
        await eventually(lambda: len(views[2]) >= 5)
        assert [len(views[k]) for k in (0, 1, 3)] == [0, 0, 0]
        first = views[2][0]
        assert first.jpeg
        assert first.position_m is not None
        # Backwards.
        assert from_quaternion(first.quaternion_wxyz)[:, 2] == pytest.approx([-1.0, 0.0, 0.0], abs=1e-6)
        await listener.listen_to(keys.video_key(team, 1))
        await eventually(lambda: len(views[0]) >= 3)
        assert [len(views[k]) for k in (1, 3)] == [0, 0]
        for k in (0, 2):
            await listener.leave(keys.video_key(team, 1, k))
        await eventually(lambda: len(sent) >= 6 and sent[-1] == sent[-2] > 0)
    await listener.close()
    await hearing
