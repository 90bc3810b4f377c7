"""`swarmtrack bench carried`: a short flight of each kind of loss, and its replay bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from swarmtrack.benchmarks import carried
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.messages import Input
from swarmtrack.recording import inputs


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(carried, "LOST_S", 4.0)
    monkeypatch.setattr(carried, "FOUND_S", 8.0)
    monkeypatch.setattr(carried, "BEGIN_S", 1.0)


def test_a_drone_without_a_position_is_carried_by_its_teammates() -> None:
    flight = carried.fly(carried.KINDS[0], 1)
    assert flight.said_after < 1.0
    assert np.median(flight.places) < 0.5
    assert flight.falsely == 0
    row = carried.summary([flight])
    assert row["said"] == row["flights"] == 1


def test_a_replay_of_what_it_was_told_carries_it_to_the_same_bit() -> None:
    kind, scenario = carried.KINDS[0], load_scenario("gps-denied", seed=2)
    swarm, again = (carried.CarriedSwarm(scenario, kind, 2) for _ in range(2))
    flown, replayed = swarm.onboard(carried.VICTIM), again.onboard(carried.VICTIM)
    told: list[Input] = []
    tell = flown.tell
    flown.tell = lambda event: (told.append(event), tell(event))[1]  # type: ignore[method-assign]
    for _ in swarm.fly(6.5):
        pass
    for number, event in enumerate(told):
        topic = inputs.FORM_OF_KIND[type(event)].topic
        replayed.tell(inputs.decode(topic, inputs.encode(number, event))[1])
    assert flown.carried is not None
    assert replayed.carried is not None
    assert flown.carried.by == replayed.carried.by
    assert np.array_equal(flown.carried.position, replayed.carried.position)
    assert np.array_equal(flown.carried.cov, replayed.carried.cov)
