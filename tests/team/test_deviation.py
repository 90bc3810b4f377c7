"""How far a teammate is aside is a state: the innovations have the likelihood of the whole Gaussian process."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from swarmtrack.geometry import rotation
from swarmtrack.team.deviation import Deviation, DeviationFilters

SIGMA, BANDWIDTH, WHITE = 0.3, 0.8, 0.05**2
DEVIATION = Deviation(np.array([SIGMA]), np.array([BANDWIDTH]), np.array([WHITE]))
AHEAD = np.array([1.0, 0.0, 0.0])


def across(chance):
    """(3, 8): where a teammate should be across the bearing, of z."""
    G = chance.normal(size=(3, 8))
    G[0] = 0.0
    return G


def folded_in(times, designs):
    """M (8, 8) of all bearings, and the sum of their normalisers."""
    filters, M, log = DeviationFilters(1), np.zeros((8, 8)), 0.0
    for t, G in zip(times, designs, strict=True):
        left, S = filters.innovations(G[None], AHEAD[None], t, DEVIATION)
        M += left[0].T @ left[0] / S[0]
        log -= math.log(2.0 * math.pi * S[0])
    return M, log


def test_innovations_have_the_likelihood_of_the_process():
    chance = np.random.default_rng(1)
    times = np.cumsum(chance.uniform(0.05, 1.5, 12))
    designs, z = [across(chance) for _ in times], chance.normal(size=8)
    M, log = folded_in(times, designs)
    apart = BANDWIDTH * np.abs(times[:, None] - times)
    cov = SIGMA**2 * (1.0 + apart) * np.exp(-apart) + WHITE * np.eye(len(times))
    miss = np.array([G @ z for G in designs])
    expected = sum(multivariate_normal(np.zeros(len(times)), cov).logpdf(miss[:, axis]) for axis in (1, 2))
    assert log - 0.5 * z @ M @ z == pytest.approx(expected, rel=1e-9)


def test_bearings_in_a_rush_say_hardly_more_than_one():
    chance = np.random.default_rng(2)
    G, z = across(chance), chance.normal(size=8)
    one, _ = folded_in([0.0], [G])
    rush, _ = folded_in(np.arange(10) * 1e-3, [G] * 10)
    assert z @ rush @ z < 1.1 * (z @ one @ z)
    apart, _ = folded_in(np.arange(10) * 100.0, [G] * 10)
    assert z @ apart @ z == pytest.approx(10.0 * (z @ one @ z), rel=1e-6)


def test_filters_turn_along():
    chance = np.random.default_rng(3)
    first, second, z = across(chance), across(chance), chance.normal(size=8)
    turn = rotation.from_euler(0.0, 0.0, 0.7)
    still, turned = DeviationFilters(1), DeviationFilters(1)
    to_old = np.eye(8) + 0.1 * chance.normal(size=(8, 8))
    for filters in (still, turned):
        filters.innovations(first[None], AHEAD[None], 0.0, DEVIATION)
    turned.turn(to_old, turn)
    left, _ = still.innovations(second[None], AHEAD[None], 0.3, DEVIATION)
    same, _ = turned.innovations((turn @ second @ to_old)[None], (turn @ AHEAD)[None], 0.3, DEVIATION)
    assert same[0] @ z == pytest.approx(turn @ left[0] @ to_old @ z)


def test_a_teammate_may_be_added_removed_and_begun_again():
    chance = np.random.default_rng(4)
    filters = DeviationFilters(2)
    G = np.stack([across(chance), across(chance)])
    both = Deviation(*(np.repeat(value, 2) for value in DEVIATION))
    filters.innovations(G, np.tile(AHEAD, (2, 1)), 0.0, both)
    filters.grow(3)
    filters.remove(0)
    filters.restart(0)
    chosen = [(filters, np.array([0]))]
    first = DeviationFilters.joined(chosen)
    left, S = first.innovations(G[:1], AHEAD[None], 0.1, DEVIATION)
    first.return_to(chosen)
    assert left[0] == pytest.approx(G[0])
    assert S[0] == pytest.approx(SIGMA**2 + WHITE)
