"""The verdict on places in metres: against closed forms, and against what the simulated drones fly."""

import math

import numpy as np
import pytest

from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.score.relative_score import error_of, relative_score
from swarmtrack.lab.score.swarm_truth import SwarmTruth

TRUTH = np.array([8.0, -2.0, 1.0, 0.5, 0.0, -0.1])


def test_without_places_nothing_is_said():
    score = relative_score([])
    assert score.samples == 0
    assert math.isnan(score.rmse_m)
    assert math.isnan(score.nees6_median)


def test_one_place_by_hand():
    longer = TRUTH * np.array([1.1, 1.1, 1.1, 1.0, 1.0, 1.0])
    score = relative_score([error_of(longer, 0.04 * np.eye(6), TRUTH)])
    assert score.range_p50 == score.range_p95 == pytest.approx(0.1)
    assert score.rmse_m == pytest.approx(0.1 * math.sqrt(69.0))
    assert score.nees6_mean == pytest.approx(0.69 / 0.04 / 6.0)


@pytest.mark.parametrize("too_small", [1.0, 4.0])
def test_honest_covariances_have_a_mean_of_one(too_small):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6))
    cov = root @ root.T + 0.1 * np.eye(6)
    errors = rng.multivariate_normal(np.zeros(6), cov, size=2000)
    score = relative_score([error_of(TRUTH + error, cov / too_small, TRUTH) for error in errors])
    assert score.nees6_mean == pytest.approx(too_small, rel=0.06)


def test_the_truth_is_what_the_drones_fly():
    scenario = load_scenario("crossing", seed=1)
    truth = SwarmTruth(scenario.world, scenario.cameras)
    for t in (3.0, 7.3, 12.9):
        own, other = (scenario.world.flown(drone).motion(t) for drone in (1, 2))
        camera = own.position + own.attitude @ scenario.body_from_camera.position
        found = truth.relative(1, 2, t)
        assert found[:3] == pytest.approx(other.position - camera, abs=1e-9)
        assert found[3:] == pytest.approx(other.velocity - own.velocity, abs=0.01)
