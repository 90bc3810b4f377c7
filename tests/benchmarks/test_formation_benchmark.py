"""`swarmtrack bench formation`: the loop is closed, and what is counted is what happened."""

import numpy as np
import pytest

from swarmtrack.benchmarks.formation import benchmark, flights
from swarmtrack.benchmarks.formation.flights import FlightPlan, FormationFlight
from swarmtrack.formation.plan import FormationPlan, neighbours_at_one_height, plan_faults
from swarmtrack.formation.setpoint import Why
from swarmtrack.lab.score.formation_score import SlotErrors
from swarmtrack.lab.world.star import arc


@pytest.mark.parametrize(("n", "gap_m"), [(3, 5.0), (5, 5.0), (8, 7.0)])
def test_the_slots_that_are_flown_are_a_sound_plan(n, gap_m):
    slots = arc(range(1, n + 1), gap_m)
    references = {drone: (1,) for drone in slots if drone != 1}
    plan = FormationPlan(
        leader=1, slots=slots, references=references, height=flights.HEIGHT_M, least_height=2.0
    )
    assert len(slots) == n
    assert plan_faults(plan, flights.SPAN_M) == []
    assert list(neighbours_at_one_height(plan)) == [] or n > 5


def test_the_leader_is_known_by_its_motion_before_it_flies_off():
    assert flights.leader_velocity(2.0, 1.5) == (0.0, 0.0, 0.0)
    square = [flights.leader_velocity(5.0 + 2.0 * side, 1.5) for side in range(4)]
    assert [v[:2] for v in square] == [(0.8, 0.0), (0.0, 0.8), (-0.8, 0.0), (0.0, -0.8)]
    assert flights.leader_velocity(20.0, 1.5) == pytest.approx((1.5, 0.0, 0.0))
    assert flights.leader_velocity(35.0, 1.5) == pytest.approx((0.0, 1.5, 0.0))


def test_ghosts_stand_far_in_front_of_each_follower_and_look_near():
    flight = FormationFlight(FlightPlan(name="haunted", drones=3, ghosts=4), seed=2)
    scenario = flight.scenario
    assert len(scenario.ghosts) == 8
    for k, ghost in enumerate(scenario.ghosts):
        follower = scenario.world.flown(2 + k // 4).position(0.0)
        away = ghost.position_m[:2] - follower[:2]
        ahead = (scenario.world.flown(1).position(0.0) - follower)[:2]
        assert away @ ahead > 0.85 * np.linalg.norm(away) * np.linalg.norm(ahead)
        assert 15.0 < np.linalg.norm(away) < 50.0
        assert 3.0 < flights.SPAN_M * np.linalg.norm(away) / ghost.size_m < 7.0


@pytest.fixture(scope="module")
def flown():
    """Two drones until the leader is lost in flight, and the follower holds."""
    flight = FormationFlight(FlightPlan(name="pair", drones=2, gone_s=20.0, ends_s=26.0), seed=3)
    return flight, flight.run()


def test_a_follower_flies_after_its_leader_by_sight_and_holds_when_that_is_gone(flown):
    flight, samples = flown
    assert samples[0].whys == (Why.NOT_ENGAGED,)
    before = next(sample for sample in samples if sample.t >= 19.9)
    assert before.whys == (Why.FOLLOW,)
    slot = np.array(flight.slots[2])
    off = before.positions[1] - before.positions[0] - slot
    assert np.linalg.norm(off) < 1.5
    assert before.speeds[1] > 1.0
    assert samples[-1].whys == (Why.NO_REFERENCE,)
    assert samples[-1].speeds[1] < 0.2


@pytest.mark.long("flies twice; the golden table of formations is compared in CI")
def test_a_flight_is_the_same_again_to_the_last_bit():
    plan = FlightPlan(name="pair", drones=2, ends_s=5.0)
    one, again = (FormationFlight(plan, seed=5).run() for _ in range(2))
    assert all((a.positions == b.positions).all() for a, b in zip(one, again, strict=True))


def test_rows_count_what_flights_say():
    def flight(seed, last, nearest):
        errors = SlotErrors(np.array([[0.5], [1.0]]), np.array([last]), nearest)
        return benchmark.FlownFormation(seed, errors, errors.errors[0], 0.1, farthest=last)

    row = benchmark._row("star-3", [flight(0, 0.4, 2.0), flight(1, 3.5, 1.4), flight(2, 0.6, 1.6)])
    assert (row["runs"], row["runs_below_1.5_m"], row["runs_with_a_lost_follower"]) == (3, 1, 1)
    assert row["min_separation_m"] == 1.4
    assert row["error_m"]["p50"] == pytest.approx(0.75)
    assert "| star-3 | 3 | 0.75, 1.00 | 0.50 |" in benchmark._page({"rows": [row]})
