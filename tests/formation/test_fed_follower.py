"""A follower whose autopilot loses its position is carried, fed, and flies on: the loop closed, over its link."""

import dataclasses

import numpy as np
import pytest

from swarmtrack.benchmarks.formation.benchmark import FLIGHTS, VICTIM
from swarmtrack.benchmarks.formation.flights import FormationFlight
from swarmtrack.formation.setpoint import Why
from swarmtrack.lab.autopilots.senses import DroneSenses

LOST_S, ENDS_S = 13.0, 20.0


def flown(*, feeds=True):
    plan = FLIGHTS["carried-follower"]
    failure = dataclasses.replace(plan.failure, begins_s=LOST_S, feeds=feeds)
    flight = FormationFlight(dataclasses.replace(plan, failure=failure, ends_s=ENDS_S), seed=1)
    flight.run()
    return flight


@pytest.fixture(scope="module")
def fed():
    return flown()


def test_it_flies_on_without_a_failsafe(fed):
    assert fed.fed.pilot.mode.name == "GUIDED"
    assert fed.fed.pilot.take_texts() == []
    assert fed.samples[-1].whys[VICTIM - 2] is Why.FOLLOW
    ((t, text),) = fed.fed.texts
    assert LOST_S < t < LOST_S + 1.0
    assert text.startswith("place feed begins: held by 1")


def test_its_estimator_goes_by_the_fed_place(fed):
    place = np.array(fed.fed.unit.place[1])
    drone = fed.scenario.world.flown(VICTIM)
    assert np.linalg.norm(place - drone.position(ENDS_S) + drone.position(0.0)) < 0.8
    assert fed.fed.vehicle.parameters.written == 0


def test_without_the_feed_it_lands(fed):
    flight = flown(feeds=False)
    assert flight.fed.pilot.mode.name == "LAND"
    assert flight.samples[-1].positions[VICTIM - 1][2] > fed.samples[-1].positions[VICTIM - 1][2] + 0.3


def test_an_echo_of_the_fed_place_makes_nobody_surer(fed, monkeypatch):
    """An autopilot that states what it makes of the fed place, and one that states nothing: the same flight to the last
    bit."""
    sensed = DroneSenses.at

    def silent(senses, t):
        found = sensed(senses, t)
        return found._replace(position=None) if senses.position_lost else found

    monkeypatch.setattr(DroneSenses, "at", silent)
    mute = flown()
    assert mute.fed.unit.place[0] < fed.fed.unit.place[0] - 5.0, "it was silent"
    np.testing.assert_array_equal(
        [sample.positions for sample in mute.samples], [sample.positions for sample in fed.samples]
    )
    ours, theirs = (flight.onboard(VICTIM).carried for flight in (mute, fed))
    assert ours.sigma_m == theirs.sigma_m
    assert ours.sigma_m > 0.1
