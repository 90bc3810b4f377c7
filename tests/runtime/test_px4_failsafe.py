"""A PX4 goes back into OFFBOARD by itself: whatever becomes of the agent, it does not fly again without its pilot.

The simulated PX4 and its pilot, the real agent's link, engagement, formation pilot and guard, in simulated time.
"""

import asyncio
import math
import re
from collections import deque

import numpy as np
import pytest

from support.autopilot_flight import Flight
from support.fake_autopilot import FakePx4
from support.inline_guard import InlineGuard
from swarmtrack.autopilot.engagement import PilotEngagement
from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.follower import LocalSetpoint
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import Setpoint, Why
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.lab.autopilots.firmware import PX4_FIRMWARE, FlightMode
from swarmtrack.lab.autopilots.pilot import GuidedPilot
from swarmtrack.lab.autopilots.senses import LastingErrors
from swarmtrack.lab.world.guided import GuidedDrone
from swarmtrack.lab.world.response import PX4_RESPONSE as RESPONSE
from swarmtrack.lab.world.trajectory import wander
from swarmtrack.runtime.formation_pilot import FormationPilot

ORIGIN = Geodetic.from_degrees(47.4, 8.5, 400.0)
START = (0.0, 0.0, -10.0)
PLACE = FormationParameters(
    drone_id=2, leader=1, slots={1: (0.0, 0.0, 0.0), 2: (-4.0, 3.0, -1.0)}, references=(1,), height=9.0
)
STEP_S = 0.01


class Door:
    """Flies north."""

    def command(self, now, engagement):
        velocity = (1.0, 0.0, 0.0)
        return LocalSetpoint(velocity, 0.0, Setpoint(now, velocity, 0.0, Why.FOLLOW, "north"), room=8.0)


class Notices:
    def __init__(self):
        self.said = []

    def add(self, severity, text):
        self.said.append(text)


class Sky:
    """A PX4 in the air and its agent; `agent` None: killed."""

    def __init__(self):
        drone = GuidedDrone(START, 0.0, RESPONSE, wander(np.random.default_rng(1), 0.05), hovers=True)
        self.px4 = FakePx4()
        self.flight = Flight(self.px4)
        self.px4.pilot = self.pilot = GuidedPilot(
            drone, PX4_FIRMWARE, epoch=self.now, origin=ORIGIN, located=lambda t: True,
            errors=LastingErrors(lambda t: 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        )  # fmt: skip
        self.px4.position = np.array(START)
        self.notices = Notices()
        self.waiting, self.frozen, self.next_decision = deque(), False, -math.inf
        self.engagements, self.setpoints = 0, 0
        self.agent = None

    @property
    def now(self):
        return self.flight.clock.now()

    async def start(self):
        """An agent, and its guard."""
        engagement = PilotEngagement()
        self.flight.unit = MavlinkAutopilot(self.flight.link, clock=self.flight.clock, engagement=engagement)
        self.task = asyncio.create_task(self.flight.unit.run(self.flight.listener))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        self.guard = InlineGuard(PLACE.limits, self.flight)
        self.guard.start()
        self.agent = FormationPilot(
            Door(),
            self.flight.unit,
            engagement,
            self.guard,
            self.notices,
            clock=self.flight.clock,
            parameters=PLACE,
        )
        self.engagement = engagement

    async def kill(self):
        self.agent = None
        self.task.cancel()
        await asyncio.gather(self.task, return_exceptions=True)

    def fly(self, seconds, *, reads_first=True):
        """reads_first: what an agent does when it wakes up: read, or decide."""
        for _ in range(round(seconds / STEP_S)):
            now = self.now + STEP_S
            self.flight.clock.set(now)
            link = self.flight.link
            sent, link.sent = link.sent, []
            for data in sent:
                self.px4.receive(data, now)
            self.waiting.extend((now, data) for data in self.px4.step(now))
            if self.agent is None:
                self.waiting.clear()
            elif not self.frozen:
                acts = [self._read, self._decide]
                for act in acts if reads_first else acts[::-1]:
                    act()
            if self.guard.alive:
                self.guard.tick()

    def _read(self):
        while self.waiting:
            self.flight.unit.received(*self.waiting.popleft())
        self.flight.unit.tick(self.now)

    def _decide(self):
        if self.now < self.next_decision:
            return
        self.next_decision = self.now + 0.1
        before = self.engagement.number
        self.agent.decide(self.now)
        self.engagements += self.engagement.number - before

    @property
    def flown(self):
        return self.pilot.mode == PX4_FIRMWARE.modes[FlightMode.GUIDED]


async def engaged_sky():
    sky = Sky()
    await sky.start()
    sky.fly(4.0)
    assert sky.pilot.switch_to(FlightMode.GUIDED, sky.now)
    sky.fly(2.0)
    assert sky.flown
    assert sky.engagement.engaged
    return sky


def story(seed):
    chance = np.random.default_rng(seed)
    return {
        "kills": bool(chance.random() < 0.5),
        "seconds": float(chance.uniform(1.3, 12.0)),
        "sticks_s": float(chance.uniform(0.0, 15.0)) if chance.random() < 0.4 else math.inf,
        "reads_first": bool(chance.random() < 0.5),
    }


async def fail(sky, kills, seconds, sticks_s, reads_first):
    """An agent that is frozen, or killed and restarted, while armed; the pilot may move the sticks. What comes of it
    within 15 s: whether anybody is flown again without the pilot."""
    again, left = 0, False
    sky.frozen = not kills
    if kills:
        await sky.kill()
    back_at, moves_at = sky.now + seconds, sky.now + sticks_s
    ends_at = sky.now + seconds + 15.0
    while sky.now < ends_at:
        if sky.now >= moves_at:
            sky.pilot.move_sticks(sky.now)
            moves_at = math.inf
        if sky.now >= back_at:
            if kills:
                await sky.start()
            sky.frozen, back_at = False, math.inf
        before = sky.engagements
        sky.fly(0.1, reads_first=reads_first)
        again += sky.engagements - before
        left = left or not sky.flown
        again += left and sky.flown
    return again


@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, 100), marks=pytest.mark.long("99 stories more"))]
)
async def test_after_a_failsafe_nobody_flies_again_without_a_change_of_the_pilots_intention(seeds):
    for seed in seeds:
        sky = await engaged_sky()
        assert await fail(sky, **story(seed)) == 0, f"seed {seed}: {story(seed)}"
        # A pilot who leaves the mode and comes again is flown again.
        sky.pilot.switch_to(FlightMode.HOLD, sky.now)
        sky.fly(2.0)
        assert sky.pilot.switch_to(FlightMode.GUIDED, sky.now), f"seed {seed}: it was not streamed to"
        sky.fly(1.0)
        assert sky.engagement.engaged, f"seed {seed}"
        await sky.kill()


async def test_the_simulated_px4_would_go_back_if_anybody_streamed():
    sky = await engaged_sky()
    await sky.kill()
    sky.fly(3.0)
    assert sky.pilot.mode == PX4_FIRMWARE.modes[FlightMode.POSITION]
    assert sky.pilot.intended == PX4_FIRMWARE.modes[FlightMode.GUIDED]
    guard = InlineGuard(PLACE.limits, sky.flight)
    guard.start()
    guard._reachable = True
    sky.guard = guard
    for _ in range(12):
        guard.stand()
        sky.fly(0.1)
    assert sky.flown


async def test_what_ended_it_is_said():
    sky = await engaged_sky()
    sky.frozen = True
    sky.fly(8.0)
    sky.frozen = False
    sky.fly(1.0)
    assert re.fullmatch(r"formation released: the agent stalled for 8\.[01] s", sky.notices.said[-1])
    await sky.kill()
