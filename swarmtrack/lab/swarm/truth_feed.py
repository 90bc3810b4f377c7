"""The truth of a world from outside on its way from the simulator, which hears it, to the judge: JSON, a line a sample.

{"id": 1, "t_s": 12.34, "position_m": [n, e, d], "quaternion_wxyz": [w, x, y, z]}
{"said": "drone 1: its truth is back after 3.4 s; frames go on"}
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.world.followed import FollowedDrone, ToldPose

# lines that wait for a follower: tens of seconds of truth about a few drones
TRUTH_SAMPLES_KEPT = 4096
TRUTH_FEED_RETRY_S = 0.5


def told(drone_id: int, sample: ToldPose) -> dict[str, Any]:
    """The record of a sample."""
    return {
        "id": drone_id,
        "t_s": sample.t,
        "position_m": sample.pose.position.tolist(),
        "quaternion_wxyz": rotation.to_quaternion(sample.pose.rotation).tolist(),
    }


def said(text: str) -> dict[str, Any]:
    """The record of a sentence for people."""
    return {"said": text}


class Followers:
    """Who is passed the truth on, line by line; one that does not keep up is let go."""

    def __init__(self) -> None:
        self._queues: set[asyncio.Queue[bytes | None]] = set()

    def send(self, record: dict[str, Any]) -> None:
        line = json.dumps(record).encode() + b"\n"
        for queue in list(self._queues):
            if queue.qsize() >= TRUTH_SAMPLES_KEPT:
                self._queues.discard(queue)
                queue.put_nowait(None)
            else:
                queue.put_nowait(line)

    async def lines(self) -> AsyncIterator[bytes]:
        queue: asyncio.Queue[bytes | None] = asyncio.Queue()
        self._queues.add(queue)
        try:
            while (line := await queue.get()) is not None:
                yield line
        finally:
            self._queues.discard(queue)


async def follow_truth(
    url: str,
    drones: Mapping[int, FollowedDrone],
    on_said: Callable[[str], None],
    on_pose: Callable[[int, ToldPose], None] = lambda drone_id, sample: None,
) -> None:
    """Tell the drones what comes from a simulator's /truth, until cancelled. A connection that is lost is made again;
    what was told meanwhile is not repeated. on_said: is given what the simulator says, and that the connection is lost
    or back. on_pose: is given each sample that a drone has taken in."""
    from aiohttp import ClientError, ClientPayloadError

    lost = False
    while True:
        try:
            async for record in _records(url):
                if lost:
                    on_said("the simulator sends the truth again")
                    lost = False
                if "said" in record:
                    on_said(record["said"])
                else:
                    drone_id, sample = record["id"], ToldPose(record["t_s"], _pose(record))
                    if drones[drone_id].add_pose(*sample):
                        on_pose(drone_id, sample)
            reason = "it closed the connection"
        except ClientPayloadError:
            reason = "the connection broke off"
        except ClientError as error:
            reason = str(error) or type(error).__name__
        # Where the simulator has died, the flight ends meanwhile, and says that instead.
        await asyncio.sleep(TRUTH_FEED_RETRY_S)
        if not lost:
            lost = True
            on_said(
                f"the simulator's truth at {url} is lost: {reason}; trying again, messages meanwhile are not judged"
            )


async def _records(url: str) -> AsyncIterator[dict[str, Any]]:
    """What comes through one connection. Raises aiohttp.ClientError."""
    import aiohttp

    timeout = aiohttp.ClientTimeout(total=None)
    async with aiohttp.ClientSession(timeout=timeout) as session, session.get(url) as response:
        response.raise_for_status()
        async for line in response.content:
            yield json.loads(line)


def _pose(record: dict[str, Any]) -> Pose:
    return Pose(rotation.from_quaternion(record["quaternion_wxyz"]), np.array(record["position_m"]))
