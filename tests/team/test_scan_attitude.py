"""An attitude's error is taken off rays by the others of the scan."""

import numpy as np
import pytest

from swarmtrack.team.priors import BEARING_SIGMA_RAD
from swarmtrack.team.scan_attitude import NamedRay, ScanAttitude

OWN_SIGMA_RAD = 0.002


def scan(n, chance, turn=None):
    """n rays ahead, seen with an attitude that is turned by turn (3,) rad, and where their teammates are."""
    azimuth, up = chance.uniform(-0.6, 0.6, n), chance.uniform(-0.3, 0.3, n)
    expected = np.stack([np.cos(azimuth), np.sin(azimuth), up], axis=1)
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    turn = chance.normal(0.0, BEARING_SIGMA_RAD, 3) if turn is None else turn
    seen = expected - np.cross(turn, expected) + chance.normal(0.0, OWN_SIGMA_RAD, (n, 3))
    seen /= np.linalg.norm(seen, axis=1)[:, None]
    return {k: NamedRay(seen[k], expected[k], 1.0, OWN_SIGMA_RAD**2) for k in range(n)}


def test_what_is_left_of_many_rays_is_their_own_error():
    chance, before, after = np.random.default_rng(1), [], []
    for _ in range(200):
        rays = scan(20, chance)
        found = ScanAttitude(rays).turned_back({track: ray.direction for track, ray in rays.items()})
        for track, ray in rays.items():
            turned, left = found[track]
            before.append(np.sum((ray.direction - ray.expected) ** 2) / 2.0)
            after.append(np.sum((turned - ray.expected) ** 2) / 2.0)
            assert 0.0 < left < 0.1
    assert np.mean(before) == pytest.approx(OWN_SIGMA_RAD**2 + BEARING_SIGMA_RAD**2, rel=0.1)
    assert np.mean(after) == pytest.approx(OWN_SIGMA_RAD**2, rel=0.2)


def test_one_ray_says_nothing_of_itself():
    rays = scan(1, np.random.default_rng(2), turn=np.array([0.0, 0.0, 0.01]))
    turned, left = ScanAttitude(rays).turned_back({0: rays[0].direction})[0]
    assert turned == pytest.approx(rays[0].direction)
    assert left == pytest.approx(1.0)


def test_a_ray_without_a_name_is_turned_by_all_others():
    chance, turn = np.random.default_rng(3), np.array([0.008, -0.006, 0.012])
    rays = scan(21, chance, turn=turn)
    ray = rays.pop(0)
    turned, _ = ScanAttitude(rays).turned_back({0: ray.direction})[0]
    assert np.linalg.norm(turned - ray.expected) < 3.0 * OWN_SIGMA_RAD
    assert np.linalg.norm(ray.direction - ray.expected) > 3.0 * OWN_SIGMA_RAD


def test_a_teammate_that_is_elsewhere_turns_nobody():
    """Five metres at twenty, and said with a name."""
    rays = scan(9, np.random.default_rng(4), turn=np.zeros(3))
    elsewhere = rays[0].expected + np.array([0.0, 0.25, 0.0])
    rays[0] = rays[0]._replace(expected=elsewhere / np.linalg.norm(elsewhere))
    turned, _ = ScanAttitude(rays).turned_back({1: rays[1].direction})[1]
    assert np.linalg.norm(turned - rays[1].expected) < 4.0 * OWN_SIGMA_RAD
