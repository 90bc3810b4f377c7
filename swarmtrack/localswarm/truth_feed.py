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
from swarmtrack.simulation.followed import FollowedDrone, ToldPose

# lines that wait for a follower: tens of seconds of truth about a few drones
BACKLOG = 4096


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

    def put(self, record: dict[str, Any]) -> None:
        line = json.dumps(record).encode() + b"\n"
        for queue in list(self._queues):
            if queue.qsize() >= BACKLOG:
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


async def follow_truth(url: str, drones: Mapping[int, FollowedDrone], on_said: Callable[[str], None]) -> None:
    """Tell the drones what comes from a simulator's /truth, until it closes. Raises aiohttp.ClientError."""
    import aiohttp

    timeout = aiohttp.ClientTimeout(total=None)
    async with aiohttp.ClientSession(timeout=timeout) as session, session.get(url) as response:
        response.raise_for_status()
        async for line in response.content:
            record = json.loads(line)
            if "said" in record:
                on_said(record["said"])
                continue
            pose = Pose(rotation.from_quaternion(record["quaternion_wxyz"]), np.array(record["position_m"]))
            drones[record["id"]].tell(record["t_s"], pose)
