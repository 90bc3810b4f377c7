"""A world that others fly, in the simulator's process: truth is followed, cameras expose, truth is passed on.

World time 0 comes `lead` seconds after every truth link tells what can be used. An exposure waits until the truth on
both sides of it is there, some 45 ms with truth at 50 Hz; nothing is extrapolated. Where the truth of any drone stays
away, no frame is exposed, which is said once, and frames go on when it is back.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack
from typing import Any

from swarmtrack.clock import Clock
from swarmtrack.errors import SwarmtrackError, ungrouped
from swarmtrack.lab.swarm.hardware import (
    Addresses,
    CameraRenderer,
    OracleCamera,
    OwnTime,
    authority,
    camera_addresses,
    make_cameras,
    serve_cameras,
)
from swarmtrack.lab.swarm.truth_feed import Followers, said, told
from swarmtrack.lab.swarm.truth_link import FATAL, TruthFault, TruthLink
from swarmtrack.lab.swarm.truth_messages import TrueSample
from swarmtrack.lab.swarm.world_file import Outsider, OutsideWorld
from swarmtrack.lab.world.followed import ToldPose
from swarmtrack.lab.world.rendering import Optics
from swarmtrack.lab.world.world import World

log = logging.getLogger(__name__)

OUTSIDE_PATIENCE_S = 20.0  # for every truth link to tell: SITL boots within a few seconds
OUTSIDE_SETTLED_S = 2.5  # of listening: two autopilots on one link show by their heartbeats, one a second
OUTSIDE_PERIOD_S = 0.25


class NoTruth(SwarmtrackError):
    """The truth about a drone cannot be had; one line for each drone."""


class ToldTime:
    """World time as far as it is told. margin: of truth that must follow an exposure's middle, s."""

    def __init__(self, world: World, margin: float) -> None:
        self._world = world
        self._margin = margin
        self._told = asyncio.Event()

    def passed(self) -> None:
        """More has been told."""
        self._told.set()
        self._told = asyncio.Event()

    def now(self) -> float:
        return self._world.told_until - self._margin

    async def until(self, t: float) -> None:
        while self.now() < t:
            await self._told.wait()


class Outside:
    """All truth links of a world. `begin` decides when world time is 0; before it, truth only shows that it flows."""

    def __init__(self, world: OutsideWorld, clock: Clock) -> None:
        self.time = ToldTime(world.scenario.world, margin=0.5 * Optics().exposure_s)
        self.followers = Followers()
        self.links = {
            drone_id: TruthLink(outsider.truth, world.scenario.origin, clock, self._taker(drone_id, outsider))
            for drone_id, outsider in world.outsiders.items()
        }
        self._clock = clock
        self._epoch: float | None = None

    def _taker(self, drone_id: int, outsider: Outsider) -> Callable[[TrueSample], None]:
        def take(truth: TrueSample) -> None:
            if self._epoch is None:
                return
            t = truth.t - self._epoch
            if outsider.drone.add_pose(t, truth.pose):
                self.followers.send(told(drone_id, ToldPose(t, truth.pose)))
                self.time.passed()

        return take

    def begin(self, epoch: float) -> None:
        self._epoch = epoch

    async def ready(self, patience_s: float = OUTSIDE_PATIENCE_S) -> None:
        """Until every link tells what can be used. Raises NoTruth, saying of each that does not why; where one never
        will, the others still have `OUTSIDE_SETTLED_S` to tell."""
        start, hopeless = self._clock.now(), math.inf
        while True:
            await asyncio.sleep(OUTSIDE_PERIOD_S)
            troubles = self.troubles()
            now = self._clock.now()
            if now - start < OUTSIDE_SETTLED_S:
                continue
            if not troubles:
                return
            fatal = [text for fault, text in troubles.values() if fault in FATAL]
            if fatal:
                hopeless = min(hopeless, now)
            all_tell = len(fatal) == len(troubles) or now - hopeless > OUTSIDE_SETTLED_S
            if (fatal and all_tell) or now - start > patience_s:
                raise NoTruth("\n".join(fatal or [text for _, text in troubles.values()]))

    def troubles(self) -> dict[int, tuple[TruthFault, str]]:
        """By drone."""
        found = {drone_id: link.trouble() for drone_id, link in self.links.items()}
        return {drone_id: trouble for drone_id, trouble in found.items() if trouble is not None}

    async def watch(self) -> None:
        """In flight: say once what goes wrong with whom, and when it is well again."""
        known: dict[int, tuple[TruthFault, float]] = {}
        while True:
            await asyncio.sleep(OUTSIDE_PERIOD_S)
            now, troubles = self._clock.now(), self.troubles()
            for drone_id, (fault, text) in troubles.items():
                if drone_id not in known or known[drone_id][0] is not fault:
                    since = known[drone_id][1] if drone_id in known else now
                    known[drone_id] = (fault, since)
                    self._say(text)
            for drone_id in known.keys() - troubles.keys():
                _, since = known.pop(drone_id)
                self._say(f"drone {drone_id}: its truth is back after {now - since:.1f} s; frames go on")

    def _say(self, text: str) -> None:
        log.warning("%s", text)
        self.followers.send(said(text))


async def simulate_outside(
    world: OutsideWorld,
    *,
    oracle: bool,
    lead: float,
    host: str,
    port: int,
    flown: Mapping[str, Any],
    clock: Clock,
    on_ready: Callable[[float, Addresses, str], None],
) -> None:
    """As `hardware.simulate`, without autopilots; on_ready is told the epoch, and where the truth is passed on, too.

    Raises NoTruth before it is ready.
    """
    outside = Outside(world, clock)

    async def follow(stack: AsyncExitStack, tasks: asyncio.TaskGroup) -> None:
        scenario = world.scenario
        for drone_id, link in outside.links.items():
            tasks.create_task(link.run(), name=f"truth {drone_id}")
        await outside.ready()
        epoch = clock.now() + lead
        outside.begin(epoch)
        images = OracleCamera(scenario, epoch) if oracle else CameraRenderer(scenario, epoch)
        stack.callback(images.close)
        cameras = make_cameras(scenario, outside.time, images.make)
        http = await serve_cameras(
            stack,
            cameras,
            images.content_type,
            (host, port),
            time=OwnTime(clock, epoch),
            flown=flown,
            truth=outside.followers.lines,
        )
        for (n, k), camera in cameras.items():
            tasks.create_task(camera.run(), name=f"camera {k} of {n}")
        tasks.create_task(outside.watch(), name="watch")
        addresses: Addresses = {
            n: {
                **camera_addresses(images.scheme, http, scenario, n),
                "autopilot": world.outsiders[n].link,
            }
            for n in scenario.members
        }
        on_ready(epoch, addresses, f"http://{authority(http)}/truth")

    with ungrouped(NoTruth):
        async with AsyncExitStack() as stack, asyncio.TaskGroup() as tasks:
            await follow(stack, tasks)
