"""`swarmtrack bench relative`: what its table says is what was flown."""

import json
import math

import numpy as np
import pytest

from swarmtrack.benchmarks import relative, relative_flights
from swarmtrack.benchmarks.virtual_swarm import Mistake, VirtualSwarm
from swarmtrack.geometry import rotation
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.world.sensors import EgoParameters
from swarmtrack.lab.world.world import World
from swarmtrack.messages import RelativeState
from swarmtrack.motion.heading import HeadingSigma
from swarmtrack.relative.parameters import RelativeParameters


def test_the_table_has_a_row_for_each_kind_and_range(tmp_path):
    result = relative.BENCH.publish(tmp_path, seeds=2, ranges=[10.0], only=[1, 2], processes=1)
    assert [row["mode"] for row in result["rows"]] == [mode.words for mode in relative.MODES[:2]]
    written = json.loads((tmp_path / "relative.json").read_text(encoding="utf-8"))
    assert written["rows"][0]["rmse_m"] == result["rows"][0]["rmse_m"]
    assert relative.MODES[1].words in (tmp_path / "relative.md").read_text(encoding="utf-8")


def test_a_summary_is_of_the_second_half_and_settles_where_it_stays_below_a_tenth():
    share = np.full((105, 1), 0.05)
    share[:21] = 0.3
    ones = np.ones((105, 1))
    flight = relative.Judged(4.0 * ones, ones, 0.01 * ones, 6.0 * ones, share, ones, 2.25 * ones)
    found = relative.summary([flight, flight])
    assert (found["rmse_m"], found["bound_m"], found["range_error"]) == pytest.approx((2.0, 1.0, 0.1))
    assert found["bound_speeds_unknown_m"] == pytest.approx(1.5)
    assert found["nees6"]["value"] == pytest.approx(1.0)
    assert found["to_10_percent_s"] == pytest.approx(3.0)


def test_the_simulated_teammates_wander_as_the_bound_and_the_filter_are_told():
    """Speeds have the stationary sigma, and after 1.5 s keep exp(−1.5 / 3) of themselves."""
    truths = [relative.wandering(40.0, relative.MODES[0], np.random.default_rng(seed)) for seed in range(20)]
    speed = np.concatenate([truth.speed for truth in truths], axis=1)
    assert speed.std() == pytest.approx(1.0, rel=0.1)
    lag = round(1.5 / relative.DT)
    correlation = (speed[lag:] * speed[:-lag]).mean() / (speed**2).mean()
    assert correlation == pytest.approx(math.exp(-lag * relative.DT / relative.WANDER_S), abs=0.1)
    step = (speed[1:] + speed[:-1]) / 2.0 * relative.DT
    place = np.concatenate([truth.place for truth in truths], axis=1)
    assert np.abs(np.diff(place, axis=0) - step).max() < 0.1


def test_a_state_is_compared_with_the_truth_along_and_across_the_ray():
    truth = np.array([10.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    cov = np.diag([0.25, 0.01, 0.04, 1.0, 0.25, 0.25])
    state = RelativeState(2, 0.0, np.array([11.0, 0.1, 0.0]), np.array([2.0, 1.0, 0.5]), cov, 0.05, ("size",))
    found = relative_flights.compared(state, truth)
    assert found.place.range == pytest.approx(0.1, abs=1e-3)
    assert found.velocity_m_s == pytest.approx(math.hypot(2.0, 0.5))
    assert found.parts == pytest.approx([4.0, 0.5, 4.0, 0.5])
    assert found.place.nees == pytest.approx(4.0 + 1.0 + 4.0 + 1.0)


@pytest.mark.parametrize(
    "seconds",
    [
        pytest.param(10.0, marks=pytest.mark.long("whole flights; relative/test_states.py judges states")),
        pytest.param(25.0, marks=pytest.mark.long("the whole flight of the table")),
    ],
)
def test_in_a_flight_the_range_is_within_a_tenth_whatever_is_known(tmp_path, monkeypatch, seconds):
    monkeypatch.setitem(relative_flights.SECONDS, "crossing", seconds)
    monkeypatch.setattr(relative_flights, "KINDS", relative_flights.KINDS[:1])
    result = relative_flights.BENCH.publish(tmp_path, seeds=1, processes=1)
    (row,) = result["rows"]
    assert row["states"] > 20 * seconds
    assert row["range_error"]["p50"] < 0.1
    assert row["nees6"]["median"] < 1.4
    assert "crossing" in (tmp_path / "relative-flights.md").read_text(encoding="utf-8")


def test_errors_as_stated_are_with_those_of_the_simulation_as_large_as_agents_are_told():
    worlds = [World(seed, {}) for seed in range(400)]
    drawn = [relative_flights.as_stated(world, drone) for world in worlds for drone in (1, 2, 3)]
    compass = np.array([mistake.compass for mistake in drawn])
    tilt = np.array([mistake.tilt for mistake in drawn])
    place = np.array([mistake.place_m for mistake in drawn])
    flown = EgoParameters()
    heading = math.radians(flown.aligned_error_deg) / math.sqrt(3.0)
    assert math.hypot(compass.std(), heading) == pytest.approx(HeadingSigma().flight, rel=0.06)
    assert math.hypot(tilt.std(), flown.attitude_sigma) == pytest.approx(
        RelativeParameters().tilt_sigma, rel=0.05
    )
    assert math.hypot(place.std(), flown.position_sigma) == pytest.approx(0.1, rel=0.05)
    assert abs(np.corrcoef(np.column_stack([compass, tilt, place]).T) - np.eye(6)).max() < 0.1


def test_an_autopilot_that_is_wrong_says_another_tilt_and_place_for_the_whole_flight():
    scenario = load_scenario("crossing", seed=1, drones=2)
    tilt, place = (0.02, -0.01), (0.3, -0.2, 0.1)
    true, wrong = (
        VirtualSwarm(scenario, observers=[1], mistakes=mistakes)
        for mistakes in (None, {1: Mistake(tilt=tilt, place_m=place)})
    )
    for swarm in (true, wrong):
        next(iter(swarm.fly(1.0)))
    poses = [swarm.onboard(1).ego_pose(-0.5) for swarm in (true, wrong)]
    assert all(pose is not None for pose in poses)
    assert poses[1].position - poses[0].position == pytest.approx(np.array(place))
    turn = poses[1].world_from_body @ poses[0].world_from_body.T
    assert rotation.log(turn) == pytest.approx(np.array([*tilt, 0.0]), abs=1e-9)


def test_who_does_not_know_how_fast_teammates_fly_knows_less_of_where_they_are():
    """At 40 m, where rays hardly turn, the filter is near that bound."""
    flights = [relative.fly(40.0, relative.MODES[2], seed) for seed in range(1, 6)]
    found = relative.summary(flights)
    assert found["bound_m"] < found["bound_speeds_unknown_m"]
    assert found["rmse_m"] < 1.4 * found["bound_speeds_unknown_m"]
