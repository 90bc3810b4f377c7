"""A real agent behind a simulated PX4, over UDP in real time: frozen, it is not flown again by PX4 alone."""

import asyncio
import os
import signal
import time

from support.patience import PATIENCE
from swarmtrack.benchmarks.guard import FlownPx4, Sky, flying_agent
from swarmtrack.benchmarks.processes import free_port
from swarmtrack.lab.autopilots.firmware import PX4_FIRMWARE, FlightMode

FROZEN_S = 3.0
# s after it has gone on: zeros would take PX4 back within one.
AFTER_S = 3.0


def since(sky, t):
    return [heard for heard in sky.messages if heard.t > t]


def flies_by_hand(sky):
    return sky.pilot.mode == PX4_FIRMWARE.modes[FlightMode.POSITION]


async def until(condition):
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110 (what is waited for happens in another process)
            await asyncio.sleep(0.02)


async def engage(sky):
    """The pilot leaves the mode, and comes again as soon as the agent streams."""
    sky.pilot.switch_to(FlightMode.HOLD, time.monotonic())
    left = time.monotonic()
    await until(lambda: since(sky, left))
    await until(lambda: sky.pilot.switch_to(FlightMode.GUIDED, time.monotonic()))
    await until(lambda: any(heard.speed > 0.9 for heard in since(sky, left)))


async def test_an_agent_that_was_frozen_is_not_taken_back_into_the_mode_by_px4_itself():
    sky = Sky(free_port(), seed=1, kind=FlownPx4)
    async with flying_agent(sky, 1.0) as agent:
        await engage(sky)
        os.kill(agent.pid, signal.SIGSTOP)
        await asyncio.sleep(FROZEN_S)
        assert flies_by_hand(sky)
        woken = time.monotonic()
        os.kill(agent.pid, signal.SIGCONT)
        await asyncio.sleep(AFTER_S)
        assert since(sky, woken) == []
        assert flies_by_hand(sky)
        # Its pilot can have it flown again.
        await engage(sky)
