"""The noise of bearings says nothing of a distance; directions that change do."""

import numpy as np
import pytest

from swarmtrack.messages import Announcement, SightingReport
from swarmtrack.team import track_evidence
from swarmtrack.team.bearing_noise import without_noise
from swarmtrack.team.evidence import design
from swarmtrack.team.mixture import OwnKnowledge
from swarmtrack.team.posterior import BearingScan, TeamPosterior
from swarmtrack.team.track_evidence import Bearing

SIGMA_RAD, RANGE_M, SCANS = 0.01, 10.0, 400
SECONDS = 30.0


def log_evidence(ratio, moved_m, seed=0):
    """Of bearings of a teammate at RANGE_M that moves so far to and fro across them, if it were at that times its
    distance: as they are, and without noise."""
    chance, M, distance = np.random.default_rng(seed), np.zeros((8, 8)), np.zeros(8)
    start = np.array([RANGE_M, 0.0, 0.0])
    for k in range(SCANS):
        moved = np.array([0.0, moved_m * np.sin(0.3 * k), 0.0])
        ray = (start + moved) / np.linalg.norm(start + moved) + chance.normal(0.0, SIGMA_RAD, 3)
        ray /= np.linalg.norm(ray)
        G = design(moved[None], np.zeros(3))[0]
        across = G - np.outer(ray, ray @ G)
        M += across.T @ across / (SIGMA_RAD * RANGE_M) ** 2
        distance += ray @ G / RANGE_M
    left, log = without_noise(M, distance, np.array(float(SCANS)))
    z = np.concatenate([[1.0, 0.0, 1.0, 0.0, 1.0], ratio * start])
    return -0.5 * z @ M @ z, float(log) - 0.5 * z @ left @ z


def test_of_one_that_stands_every_distance_is_as_likely():
    at_place = log_evidence(1.0, 0.0)
    for ratio in (0.5, 0.8, 1.25, 2.0):
        found = log_evidence(ratio, 0.0)
        assert found[1] == pytest.approx(at_place[1], abs=3.0)
        assert abs(found[0] - at_place[0]) > 50.0


def test_of_one_that_moves_the_true_distance_is_the_likeliest_and_as_it_is_a_nearer_one():
    ratios = np.linspace(0.6, 1.4, 81)
    as_it_is, without = np.array([log_evidence(ratio, 0.15) for ratio in ratios]).T
    assert ratios[np.argmax(as_it_is)] < 0.8
    assert ratios[np.argmax(without)] == pytest.approx(1.0, abs=0.05)


def test_before_the_first_bearing_and_after_one_there_is_no_noise():
    M, log = without_noise(np.zeros((2, 8, 8)), np.zeros((2, 8)), np.zeros(2))
    assert not M.any()
    assert not log.any()
    ray = np.array([1.0, 0.0, 0.0])
    G = design(np.zeros((1, 3)), np.zeros(3))[0]
    one = (G - np.outer(ray, ray @ G)).T @ (G - np.outer(ray, ray @ G))
    M, log = without_noise(one, ray @ G / RANGE_M, np.array(1.0))
    assert pytest.approx(one, abs=1e-6) == M
    assert log == pytest.approx(0.0, abs=1e-6)


@pytest.mark.filterwarnings("ignore:invalid value encountered")
@pytest.mark.parametrize("nonsense", [np.nan, np.inf])
def test_nonsense_from_a_peer_is_no_noise(nonsense):
    _, log = without_noise(np.full((8, 8), nonsense), np.ones(8), np.array(1.0))
    assert log == 0.0


def hovering(mates, sway_m):
    """Posterior of a drone that hovers 20 m before so many; all errors are as stated, a common one of the attitude
    among them."""
    chance = np.random.default_rng(1)
    starts = {2 + k: np.array([20.0, 4.0 * (k - 0.5 * (mates - 1)), 0.0]) for k in range(mates)}
    posterior = TeamPosterior(1, cameras=1, start_sigma_m=0.1)
    for drone, start in starts.items():
        cov = 0.01 * np.eye(3)
        posterior.announce(Announcement(drone, "0000000a", 1, 0.0, 0.0, start, np.eye(3), cov))
    for k in range(1, round(5 * SECONDS)):
        t, turn, bearings = 0.2 * k, chance.normal(0.0, 0.004, 3), {}
        for drone, start in starts.items():
            sway = np.array([0.0, np.sin((0.6 + 0.05 * drone) * t), np.cos(0.8 * t + drone)])
            place = start + sway_m * sway
            ray = place / np.linalg.norm(place)
            ray = ray + np.cross(turn, ray) + chance.normal(0.0, 0.003, 3)
            variance = 0.003**2 + 0.004**2
            bearings[drone] = Bearing(
                t, np.zeros(3), 1000.0 * ray[1:], ray / np.linalg.norm(ray), variance, float(place[0])
            )
            if k % 5 == 0:
                said = place + chance.normal(0.0, 0.02, 3)
                posterior.teammates[drone].report(
                    SightingReport(drone, "0000000a", k, t, 0.0, said, 0.1, (), ())
                )
        scan = BearingScan(t, 0, np.zeros(3), bearings, {})
        posterior.observe(scan, bearings.keys(), np.zeros(3), OwnKnowledge(0.1, 0.03))
    return posterior


HOVERING = pytest.mark.parametrize(("mates", "sway_m"), [(2, 0.0), (6, 0.1)])


@HOVERING
def test_no_drone_comes_to_doubt_its_start_because_its_bearings_are_noisy(mates, sway_m):
    posterior = hovering(mates, sway_m)
    assert posterior.p_fault < 0.05
    assert [named.likeliest[0] for named in posterior.named.values()] == list(range(2, 2 + mates))


@HOVERING
def test_it_does_while_noise_counts_as_evidence_of_distances(mates, sway_m, monkeypatch):
    monkeypatch.setattr(track_evidence, "without_noise", lambda M, _, count: (M, 0.0 * count))
    assert hovering(mates, sway_m).p_fault > 0.5
