"""Whatever it is told: numbers within the limits, the same again for the same, and nobody is closed in on in need."""

import itertools

import pytest

from swarmtrack.benchmarks.formation.any_states import Squeezes, Stories, closes_in, wrong_with
from swarmtrack.formation.formation import Formation


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.long("a thousand stories more")) for k in range(1, 4))]
)
def test_a_command_is_always_finite_within_its_limits_and_the_same_again(seed):
    stories = Stories(seed)
    one, again = Formation(stories.parameters), Formation(stories.parameters)
    before = None
    for story in itertools.islice(stories, 1000):
        setpoint = one.command(*story)
        assert wrong_with(setpoint, stories.parameters.limits, before) == ""
        assert again.command(*story) == setpoint
        before = setpoint


@pytest.mark.parametrize("seed", range(4))
def test_who_is_squeezed_closes_in_on_nobody_faster_than_standing_or_flying_on_would(seed):
    stories = Squeezes(seed)
    formation = Formation(stories.parameters)
    before = None
    for story in itertools.islice(stories, 500):
        setpoint = formation.command(*story)
        assert closes_in(setpoint, before, story) <= 1e-6
        assert wrong_with(setpoint, stories.parameters.limits, before) == ""
        before = setpoint
