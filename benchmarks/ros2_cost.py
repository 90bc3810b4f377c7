"""What `[output] ros2 = true` costs a drone that has five named teammates in view.

`swarmtrack bench cost --of ros2`. A process of its own makes the calls of an agent: tracks at 50 Hz, of which 20 are
published, and health once per second, from a pose with a velocity. Its CPU (all threads, Zenoh's too) is read from
/proc in turns: alone, joined to a router without a subscriber, and with everything subscribed to (there are no
pictures). What the loop itself takes is subtracted. The least of each
counts, among the turns with all messages.

    python -m swarmtrack.benchmarks.ros2_cost [ROUTER]      # the process that is measured
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections import Counter
from types import SimpleNamespace
from typing import NamedTuple, cast

import numpy as np

from swarmtrack.benchmarks.figures import Figure
from swarmtrack.benchmarks.processes import cpu_seconds, module_process
from swarmtrack.clock import UTC_SIGMA, SystemClock
from swarmtrack.config.ros2 import Ros2Section
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.messages import IdentifiedTrack, MotionReport, RelativeState, Track, TrackList, TrackStatus
from swarmtrack.motion.ego import TeamPose
from swarmtrack.outputs.ros2.connection import ros2_network
from swarmtrack.perceived import TeamView
from swarmtrack.runtime.ros2_output import Ros2Output
from swarmtrack.transport.zenoh_session import close_session, open_session
from swarmtrack.wire.health import HealthMessage, LinkHealth
from swarmtrack.wire.tracks import TracksMessage, tracks_message

ROS2_ROUTER_HERE = "127.0.0.1:27647"
AGENT_TRACKS_HZ, TEAMMATES = 50.0, 5
ROS2_TURNS, ROS2_SETTLE_S = 4, 4.0
ROS2_FULL_SHARE = 0.95  # of the messages of the best turn
ROS2_BUDGET_PERCENT = 2.0
LENS = PinholeCamera(600.0, 600.0, 320.0, 256.0, 640, 512)


class ScriptedView:
    """Pose and velocity of a drone that flies north, as `perceived.TeamView`."""

    cameras = (SimpleNamespace(lens=LENS, body_from_camera=Pose(BODY_FROM_FORWARD_CAMERA, np.zeros(3))),)

    def ego_pose(self, t: float) -> TeamPose:
        return TeamPose(t, np.array([t, 0.0, -5.0]), np.eye(3), 0.01 * np.eye(3), 1e-4 * np.eye(3))

    def motion_report(self, boot: str, sequence: int) -> MotionReport:
        there, cov = np.array([1.0, 0.0, 0.0]), 0.01 * np.eye(3)
        return MotionReport(1, boot, sequence, 0.0, 0.01, there, cov, there, cov)


def scripted_tracks(now: float, sequence: int, utc_offset: float) -> TracksMessage:
    """Five named teammates with places."""
    tracks = []
    for k in range(TEAMMATES):
        mean = np.array([200.0 + 50.0 * k, 1.0, 250.0, 0.0])
        track = Track(k, now, mean, np.eye(4), TrackStatus.CONFIRMED, 1.0, np.array([20.0, 8.0]))
        place = RelativeState(
            k + 2, now, np.array([20.0, 2.0 * k, 0.0]), np.zeros(3), 0.1 * np.eye(6), 0.05, ("size",)
        )
        tracks.append(IdentifiedTrack(track, k + 2, 0.99, relative=place))
    return tracks_message(TrackList(now, now, tuple(tracks)), sequence, utc_offset, UTC_SIGMA)


async def fly(router: str | None) -> None:
    """The process that is measured, until killed."""
    clock, output = SystemClock(), None
    if router is not None:
        section, view = Ros2Section(router=router), cast(TeamView, ScriptedView())
        output = Ros2Output(section, view, clock, drone_id=1, boot="0123abcd")
        await output.run()
    sequence = 0
    while True:
        sequence += 1
        now = clock.now()
        message = scripted_tracks(now, sequence, clock.utc() - now)
        if output is not None:
            output.on_tracks(message, now)
            if sequence % AGENT_TRACKS_HZ == 0:
                links = (LinkHealth("autopilot", True, "ArduPilot, 200 Hz", {"lost": 0.0}),)
                output.on_health(
                    HealthMessage(
                        1, clock.utc(), "0123abcd", now, 5.0, 90.0, {}, {}, None, None, links, {}, ()
                    )
                )
        await asyncio.sleep(1.0 / AGENT_TRACKS_HZ)


class Ros2Turn(NamedTuple):
    """CPU in % of a core, and messages per second that a subscriber to everything received."""

    alone: float
    joined: float
    subscribed: float
    rate_hz: float


async def turns(seconds: float) -> list[Ros2Turn]:
    """Each of three times so many seconds."""
    router = await open_session(ros2_network(ROS2_ROUTER_HERE, "router", serve=True, insecure=False))
    found, name = [], "swarmtrack.benchmarks.ros2_cost"
    received: Counter[str] = Counter()

    async def share(process: asyncio.subprocess.Process) -> float:
        began, used = time.monotonic(), cpu_seconds(process.pid)
        await asyncio.sleep(seconds)
        return 100.0 * (cpu_seconds(process.pid) - used) / (time.monotonic() - began)

    async with module_process(name) as alone, module_process(name, ROS2_ROUTER_HERE) as joined:
        await asyncio.sleep(ROS2_SETTLE_S)
        for _ in range(ROS2_TURNS):
            idle = await share(alone), await share(joined)
            subscriber = router.declare_subscriber("0/**", lambda _: received.update("m"))
            await asyncio.sleep(0.5)
            received.clear()
            found.append(Ros2Turn(*idle, await share(joined), received["m"] / seconds))
            subscriber.undeclare()  # type: ignore[no-untyped-call]
            await asyncio.sleep(0.5)
    await close_session(router, [], (f"tcp/{ROS2_ROUTER_HERE}",))
    return found


def measured(args: argparse.Namespace) -> list[Figure]:
    """With --quick three seconds per turn."""
    found = asyncio.run(turns(3.0 if args.quick else 15.0))
    rate = max(turn.rate_hz for turn in found)
    # Other work only adds to a figure; but a process that gets no time says less.
    full = [turn for turn in found if turn.rate_hz > ROS2_FULL_SHARE * rate]
    alone, joined, subscribed, _ = (min(each) for each in zip(*full, strict=True))
    budget = ROS2_BUDGET_PERCENT
    return [
        Figure("messages to ROS 2, everything subscribed to", rate, "Hz"),
        Figure("added CPU, nothing subscribed to", joined - alone, "% of a core"),
        Figure("added CPU, everything subscribed to", subscribed - alone, "% of a core", budget),
    ]


if __name__ == "__main__":
    asyncio.run(fly(sys.argv[1] if sys.argv[1:] else None))
