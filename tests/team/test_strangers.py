"""Strangers are predicted as sharply as a filter of their kind can."""

import math

import numpy as np
import pytest

from swarmtrack.team.strangers import KINDS, StrangerFilters

VARIANCE, DISTANCE, STEP_S = 1e-4, 10.0, 0.5


def densities(directions, columns=1):
    """(looks, columns, KINDS): log predictive densities of bearings in a row."""
    filters, ones = StrangerFilters(columns), np.ones(columns)
    return np.array(
        [
            filters.predict_and_update(
                np.tile(d / np.linalg.norm(d), (columns, 1)),
                dt=STEP_S * ones * (k > 0),
                parallax=np.zeros((columns, 3)),
                variance=VARIANCE * ones,
                least=0.0 * ones,
                distance=DISTANCE * ones,
            )
            for k, d in enumerate(directions)
        ]
    )


def test_the_first_bearing_says_nothing():
    assert densities([np.array([1.0, 0.0, 0.0])])[0].tolist() == [[0.0] * KINDS]


def test_one_that_stands_is_predicted_as_by_a_mean():
    chance = np.random.default_rng(1)
    looks = [np.array([1.0, *chance.normal(0.0, math.sqrt(VARIANCE), 2)]) for _ in range(30)]
    found = densities(looks)[:, 0, 0]
    across = np.array([look[1:] / np.linalg.norm(look) for look in looks])
    for k in range(1, 30):
        S = VARIANCE * (1.0 + 1.0 / k)
        error = across[k] - across[:k].mean(axis=0)
        expected = -math.log(2.0 * math.pi * S) - 0.5 * float(error @ error) / S
        assert found[k] == pytest.approx(expected, abs=0.05)


def test_each_kind_of_motion_is_best_explained_by_its_own_filter():
    straight = [np.array([1.0, math.tan(0.05 * k), 0.0]) for k in range(12)]
    turning = [np.array([1.0, 0.15 * math.sin(1.2 * k), 0.15 * math.cos(1.2 * k)]) for k in range(12)]
    still = [np.array([1.0, 0.0, 0.0])] * 12
    assert densities(straight)[1:, 0].sum(axis=0).argmax() == 3
    assert densities(turning)[1:, 0].sum(axis=0).argmax() == 2
    assert densities(still)[1:, 0].sum(axis=0).argmax() == 0


def test_filters_turn_along():
    looks = [np.array([1.0, 0.02 * k, 0.0]) for k in range(5)]
    filters = StrangerFilters(1)
    one = np.ones(1)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    def see(direction, k):
        unit = direction / np.linalg.norm(direction)
        return filters.predict_and_update(
            unit[None],
            dt=STEP_S * one * (k > 0),
            parallax=np.zeros((1, 3)),
            variance=VARIANCE * one,
            least=0.0 * one,
            distance=DISTANCE * one,
        )

    for k, look in enumerate(looks[:-1]):
        see(look, k)
    filters.turn(quarter)
    assert see(quarter @ looks[-1], 4) == pytest.approx(densities(looks)[-1])
