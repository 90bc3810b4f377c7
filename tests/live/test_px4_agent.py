"""A real agent behind a simulated PX4, over UDP in real time: frozen, it is not flown again by PX4 alone."""

import asyncio
import math
import os
import signal
import sys
import time

from support.patience import PATIENCE
from swarmtrack.benchmarks.guard import CONFIG, ORIGIN, START, Heard, Sky
from swarmtrack.benchmarks.lone_agent import free_udp_port
from swarmtrack.simulation.firmware import PX4, FlightMode
from swarmtrack.simulation.guided import GuidedDrone
from swarmtrack.simulation.pilot import GuidedPilot
from swarmtrack.simulation.px4 import SimulatedPx4
from swarmtrack.simulation.senses import DroneSenses
from swarmtrack.simulation.trajectory import wander
from swarmtrack.simulation.world import World

FROZEN_S = 3.0
# s after it has gone on: zeros would take PX4 back within one.
AFTER_S = 6.0


class FlownPx4(SimulatedPx4):
    """Keeps what it was told to fly."""

    def understand(self, message, now, channel):
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            self.heard.append(Heard(now, math.hypot(message.vx, message.vy, message.vz)))
        super().understand(message, now, channel)


class Px4Sky(Sky):
    def __post_init__(self):
        drift = wander(World(self.seed, {}).chance("wander", 2), 0.1)
        self.drone = GuidedDrone(START, 0.0, PX4.response, drift, hovers=True)
        senses = DroneSenses(World(self.seed, {2: self.drone}), 2, self.epoch, earth=ORIGIN)
        self.pilot = GuidedPilot(
            self.drone, PX4, epoch=self.epoch, origin=ORIGIN, located=lambda t: True,
            errors=senses.lasting_errors,
        )  # fmt: skip
        self.autopilot = FlownPx4(senses, pilot=self.pilot, boot_at=self.epoch - 40.0)
        self.autopilot.heard = []

    def since(self, t):
        return [heard for heard in self.heard if heard.t > t]

    @property
    def flies_by_hand(self):
        return self.pilot.mode == PX4.modes[FlightMode.POSITION]


async def until(condition):
    async with asyncio.timeout(PATIENCE):
        while not condition():  # noqa: ASYNC110 (what is waited for happens in another process)
            await asyncio.sleep(0.02)


async def engage(sky):
    """The pilot leaves the mode, and comes again as soon as the agent streams."""
    sky.pilot.switch_to(FlightMode.HOLD, time.monotonic())
    left = time.monotonic()
    await until(lambda: sky.since(left))
    await until(lambda: sky.pilot.switch_to(FlightMode.GUIDED, time.monotonic()))
    await until(lambda: any(heard.speed > 0.9 for heard in sky.since(left)))


async def test_an_agent_that_was_frozen_is_not_taken_back_into_the_mode_by_px4_itself(tmp_path):
    sky = Px4Sky(free_udp_port(), seed=1)
    config = tmp_path / "drone.toml"
    config.write_text(CONFIG.format(port=sky.port))
    async with sky.served():
        agent = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "swarmtrack.benchmarks.guarded_agent", str(config), "1.0",
            stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        try:
            await engage(sky)
            os.kill(agent.pid, signal.SIGSTOP)
            await asyncio.sleep(FROZEN_S)
            assert sky.flies_by_hand
            woken = time.monotonic()
            os.kill(agent.pid, signal.SIGCONT)
            await asyncio.sleep(AFTER_S)
            assert sky.since(woken) == []
            assert sky.flies_by_hand
            # Its pilot can have it flown again.
            await engage(sky)
        finally:
            agent.kill()
            await agent.wait()
