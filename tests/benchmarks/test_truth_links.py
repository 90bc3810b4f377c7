"""Own truth against own judge: what cameras see and the judge knows comes through the truth messages, or does not.

The same flights of the same agents, as fast as they compute: once as the scenario has them, once with every picture and
every judgement from poses that went as SIM_STATE through the simulated autopilot, the wire, a busy machine and the
reader. `tests/live/test_outside_world.py` flies processes.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from swarmtrack.benchmarks.identity.recognition import Flight, judge
from swarmtrack.benchmarks.virtual_swarm import VirtualSwarm, oracle_eyes
from swarmtrack.lab.autopilots.autopilot import SimulatedArduPilot
from swarmtrack.lab.autopilots.senses import DroneSenses
from swarmtrack.lab.autopilots.truth import DroneTruth
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.swarm.truth_messages import SIM_STATE, TRUTH_ATTITUDE_QUATERNION, TruthReader
from swarmtrack.lab.world.followed import FollowedDrone
from swarmtrack.lab.world.world import World

TRUTH_PORT = 2
BEGINS_S = (
    -12.0
)  # world time at which the truth is first asked for: the clock is known when the flight begins
STEP_S = 1e-3
JITTER_S = 2e-3  # mean of what a busy machine adds to a message's way


def followed(scenario: Scenario, drone_id: int, seconds: float) -> FollowedDrone:
    """What truth messages tell of a drone, in world time."""
    world = scenario.world
    pilot = SimulatedArduPilot(
        DroneSenses(world, drone_id, 0.0),
        truth=DroneTruth(world, drone_id, 0.0, scenario.origin),
        boot_at=BEGINS_S - 20.0,
        skew=150e-6,
    )
    for message_id in (SIM_STATE, TRUTH_ATTITUDE_QUATERNION):
        pilot.set_interval(message_id, 20_000.0, BEGINS_S, pilot.channels[TRUTH_PORT])
    drone, reader = FollowedDrone(keep_s=math.inf), TruthReader(scenario.origin)
    parser, chance = common.MAVLink(None), np.random.default_rng(drone_id)
    arrived = BEGINS_S
    for now in np.arange(BEGINS_S, seconds + 0.2, STEP_S).tolist():
        for datagram in pilot.step(now, TRUTH_PORT):
            arrived = max(arrived, now + chance.exponential(JITTER_S))
            for message in parser.parse_buffer(datagram) or []:
                for sample in reader.read(message, arrived):
                    drone.add_pose(sample.t, sample.pose)
    return drone


def flights(name: str, seed: int, seconds: float) -> tuple[Flight, Flight]:
    """Of two drones: by the scenario's own truth, and by what was told."""
    scenario = load_scenario(name, seed=seed, drones=2)
    told = World(
        seed,
        {drone_id: followed(scenario, drone_id, seconds) for drone_id in scenario.members},
        scenario.world.airframes,
    )
    seen = dataclasses.replace(scenario, world=told)
    return (
        judge(VirtualSwarm(scenario), scenario, seconds),
        judge(VirtualSwarm(scenario, eyes=oracle_eyes(seen)), seen, seconds),
    )


def assert_alike(own: Flight, through: Flight) -> None:
    """Within noise: a pixel's tenth of the error, a hundredth of the names."""
    ours, theirs = own.score, through.score
    assert theirs.samples == pytest.approx(ours.samples, rel=0.01)
    assert theirs.wrong == pytest.approx(ours.wrong, abs=0.002)
    assert theirs.correct == pytest.approx(ours.correct, abs=0.02)
    assert theirs.recall == pytest.approx(ours.recall, abs=0.01)
    for observer, rmse in ours.rmse_px.items():
        assert theirs.rmse_px[observer] == pytest.approx(rmse, abs=0.15)


def test_the_verdict_through_the_truth_messages_is_that_of_the_scenario():
    assert_alike(*flights("crossing", 1, 3.0))


@pytest.mark.long("20 s of two more flights; the default run has 3 s of one")
@pytest.mark.parametrize(("name", "seed"), [("crossing", 2), ("fast-yaw", 1)])
def test_over_twenty_seconds_of_several_flights_it_is_so_too(name, seed):
    own, through = flights(name, seed, 20.0)
    for label, flight in (("own", own), ("told", through)):
        s = flight.score
        rmse = " ".join(f"{value:.2f}" for value in s.rmse_px.values())
        print(
            f"{name:9} seed {seed} {label:4} correct {s.correct:.4f} wrong {s.wrong:.4f} recall {s.recall:.4f} "
            f"rmse {rmse} px, named after {max(s.time_to_identify_s.values()):.2f} s"
        )
    assert_alike(own, through)
