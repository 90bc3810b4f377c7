"""A code is a motion that an autopilot can fly, and no two of a team have the same."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmtrack.motion.priors import SWAY_AMPLITUDE_M, SWAY_FASTEST_HZ, SWAY_LASTS_S, SWAY_SLOWEST_HZ
from swarmtrack.motion.sway import frequency, next_begin, possible_begins, sway

TEAM = (3, 7, 12, 40)


def heights(drone_id: int, team: tuple[int, ...] = TEAM) -> np.ndarray:
    """Upwards, m, every 10 ms."""
    return np.array([-sway(drone_id, team, t)[0, 2] for t in np.arange(0.0, SWAY_LASTS_S, 0.01)])


def test_the_frequencies_are_spread_evenly_in_the_order_of_the_ids():
    found = [frequency(drone_id, (40, 3, 12, 7)) for drone_id in TEAM]
    assert found == pytest.approx(np.linspace(SWAY_SLOWEST_HZ, SWAY_FASTEST_HZ, 4))


@pytest.mark.parametrize(("team", "first"), [(TEAM, [1, 1, 1, 1]), ((*TEAM, 50), [1, -1, 1, -1, 1])])
def test_it_sways_up_first_and_in_a_large_team_every_second_one_down(team, first):
    found = [heights(drone_id, team) for drone_id in team]
    assert [np.sign(height[np.flatnonzero(np.abs(height) > 0.02)[0]]) for height in found] == first
    for height in found:
        assert np.abs(height).max() == pytest.approx(SWAY_AMPLITUDE_M, rel=0.03)


@pytest.mark.parametrize("n", [5, 10])
def test_neighbours_in_a_large_team_are_unlike_before_half_the_code_is_over(n):
    team, half = tuple(range(1, n + 1)), slice(0, round(50 * SWAY_LASTS_S))
    for one in team[:-1]:
        own, other = heights(one, team)[half], heights(one + 1, team)[half]
        assert np.corrcoef(own, other)[0, 1] < 0.0


def test_it_is_vertical_and_before_and_after_it_is_still():
    assert np.array([sway(7, TEAM, t)[:, :2] for t in (0.5, 3.0, 7.9)]) == pytest.approx(0.0)
    for t in (-1.0, 0.0, SWAY_LASTS_S, 100.0):
        assert not sway(7, TEAM, t).any()


@given(t=st.floats(0.01, SWAY_LASTS_S - 0.01), drone_id=st.sampled_from(TEAM))
def test_each_derivative_is_that_of_the_one_before(t, drone_id):
    h = 1e-4
    slope = (sway(drone_id, TEAM, t + h) - sway(drone_id, TEAM, t - h)) / (2.0 * h)
    assert slope[:3] == pytest.approx(sway(drone_id, TEAM, t)[1:], rel=1e-3, abs=2e-3)


def test_the_quickest_asks_for_no_more_than_a_third_of_gravity_and_a_bit():
    fastest = np.array([sway(40, TEAM, t) for t in np.arange(0.0, SWAY_LASTS_S, 0.005)])
    _, speed, acceleration, _ = np.abs(fastest[:, :, 2]).max(axis=0)
    assert speed < 0.9
    assert acceleration < 3.7


@pytest.mark.parametrize("n", [3, 5, 10])
def test_neighbours_in_a_team_are_unlike_even_for_who_knows_neither_size_nor_start(n):
    """What is left of one code once another one, its slope (a clock that is off) and a constant are taken out."""
    team = tuple(range(1, n + 1))
    for one in team[:-1]:
        own, other = heights(one, team), heights(one + 1, team)
        others = np.stack([other, np.gradient(other), np.ones_like(other)], axis=1)
        left = own - others @ np.linalg.lstsq(others, own, rcond=None)[0]
        assert left.std() > 0.25 * own.std()


@pytest.mark.parametrize(("utc", "begin"), [(1000.0, 1000.0), (1000.1, 1010.0), (1009.99, 1010.0)])
def test_it_begins_at_the_next_full_ten_seconds(utc, begin):
    assert next_begin(utc) == begin


@pytest.mark.parametrize(
    ("thrown", "begins"), [(13.0, [20.0]), (19.5, [20.0, 30.0]), (20.0, [20.0, 30.0]), (20.7, [20.0, 30.0])]
)
def test_near_a_full_ten_seconds_others_may_have_seen_the_switch_on_its_other_side(thrown, begins):
    assert possible_begins(thrown) == begins
    assert next_begin(thrown) in begins


def test_a_drone_that_is_not_of_the_team_has_no_code():
    with pytest.raises(ValueError, match="5"):
        sway(5, TEAM, 1.0)
