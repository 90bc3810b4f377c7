"""A real agent whose law flies north at a steady speed, and that breaks when it is asked to.

    python -m swarmtrack.benchmarks.guarded_agent CONFIG SPEED

SIGUSR1: a task raises. SIGUSR2: the event loop stands still for `BLOCKED_S`.
"""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from pathlib import Path

from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.follower import Engagement, LocalSetpoint
from swarmtrack.formation.setpoint import Setpoint, Why
from swarmtrack.log_lines import AGENT_FORMAT, log_to_stderr
from swarmtrack.outputs.console import Console
from swarmtrack.runtime.agent import Agent
from swarmtrack.runtime.assembly import assemble
from swarmtrack.runtime.door import Door

BLOCKED_S = 2.0
# m down to the least height.
ROOM_M = 10.0


class SteadyDoor(Door):
    """As it stands in a config, but for what the law says."""

    speed = 0.0
    breaks = False

    def command(self, now: float, engagement: Engagement) -> LocalSetpoint:
        if self.breaks:
            raise RuntimeError("a task raises, as it was asked to")
        velocity = (self.speed, 0.0, 0.0)
        setpoint = Setpoint(now, velocity, 0.0, Why.FOLLOW, "flies north")
        return LocalSetpoint(velocity, 0.0, setpoint, ROOM_M)


def main(config: str, speed: float) -> None:
    """Until it is stopped, or breaks."""
    log_to_stderr(30, AGENT_FORMAT)
    parts = assemble(load_config(Path(config)), SystemClock())
    parts.door.__class__ = SteadyDoor
    door = parts.door
    assert isinstance(door, SteadyDoor)
    door.speed = speed

    async def fly() -> None:
        agent = Agent(parts, console=Console(*parts.lenses, quiet=True))
        loop = asyncio.get_running_loop()
        loop.add_signal_handler(signal.SIGTERM, agent.stop)
        loop.add_signal_handler(signal.SIGUSR1, setattr, door, "breaks", True)
        # What must not be in an event loop is what is tried here.
        loop.add_signal_handler(signal.SIGUSR2, time.sleep, BLOCKED_S)
        await agent.run()

    asyncio.run(fly())


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
