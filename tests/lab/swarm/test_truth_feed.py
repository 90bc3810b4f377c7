"""The judge's link to the simulator that tells the truth: what is passed on, and what becomes of a lost connection."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator

import numpy as np

from support.patience import eventually
from support.ports import free_port
from support.streams import Send, hang_up, sending, stream_server
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.swarm.truth_feed import follow_truth, said, told
from swarmtrack.lab.world.followed import FollowedDrone, ToldPose


def line(record: dict[str, object]) -> bytes:
    return json.dumps(record).encode() + b"\n"


def at(t: float) -> bytes:
    return line(told(1, ToldPose(t, Pose(np.eye(3), np.array((t, 0.0, -2.0))))))


@contextlib.asynccontextmanager
async def following(url: str, drone: FollowedDrone) -> AsyncIterator[list[str]]:
    """What is said while the drone is told."""
    heard: list[str] = []
    task = asyncio.create_task(follow_truth(url, {1: drone}, heard.append))
    yield heard
    assert not task.done()
    task.cancel()


async def test_poses_reach_the_drone_and_sentences_the_spectator():
    drone = FollowedDrone()
    async with stream_server("/truth", "application/x-ndjson") as server:
        server.script = sending(at(1.0), line(said("its truth is back")), at(1.05))
        async with following(server.url, drone) as heard:
            await eventually(lambda: drone.newest == 1.05)
    assert heard == ["its truth is back"]
    np.testing.assert_allclose(drone.position(1.025), (1.025, 0.0, -2.0))


async def test_each_pose_that_is_taken_in_is_passed_on_once():
    drone, passed = FollowedDrone(), []
    async with stream_server("/truth", "application/x-ndjson") as server:
        # The second comes again, as after a connection that was lost.
        server.script = sending(at(1.0), at(1.05), at(1.05), at(1.1))
        on_pose = lambda drone_id, sample: passed.append((drone_id, sample.t))  # noqa: E731
        task = asyncio.create_task(follow_truth(server.url, {1: drone}, lambda text: None, on_pose))
        await eventually(lambda: drone.newest == 1.1)
        task.cancel()
    assert passed == [(1, 1.0), (1, 1.05), (1, 1.1)]


async def test_a_connection_that_is_lost_is_said_once_and_made_again():
    drone = FollowedDrone()
    async with stream_server("/truth", "application/x-ndjson") as server:

        async def then_out_of_service(send: Send) -> None:
            server.status, server.script = 503, hang_up

        server.script = sending(at(1.0), then=then_out_of_service)
        async with following(server.url, drone) as heard:
            await eventually(lambda: server.connections > 2)
            server.status = 200
            server.script = sending(at(7.0))
            await eventually(lambda: drone.newest == 7.0)
    lost, back = heard
    assert lost == (
        f"the simulator's truth at {server.url} is lost: it closed the connection; trying again, messages meanwhile "
        "are not judged"
    )
    assert back == "the simulator sends the truth again"


async def test_a_connection_that_breaks_off_is_said():
    async def half_a_chunk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nff\r\n{")
        await writer.drain()
        writer.close()

    async with await asyncio.start_server(half_a_chunk, "127.0.0.1", 0) as server:
        host, port = server.sockets[0].getsockname()
        async with following(f"http://{host}:{port}/truth", FollowedDrone()) as heard:
            await eventually(lambda: bool(heard))
    assert "is lost: the connection broke off;" in heard[0]


async def test_nobody_there_is_said_too():
    url = f"http://127.0.0.1:{free_port(socket.SOCK_STREAM)}/truth"
    async with following(url, FollowedDrone()) as heard:
        await eventually(lambda: bool(heard))
    assert heard[0].startswith(f"the simulator's truth at {url} is lost: Cannot connect to host 127.0.0.1")
