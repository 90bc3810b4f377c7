"""Whatever it is told: numbers within the limits, and the same again for the same."""

import itertools

import pytest

from swarmtrack.benchmarks.formation.any_states import Stories, wrong_with
from swarmtrack.formation.formation import Formation


@pytest.mark.parametrize("seed", range(4))
def test_a_command_is_always_finite_within_its_limits_and_the_same_again(seed):
    stories = Stories(seed)
    one, again = Formation(stories.parameters), Formation(stories.parameters)
    for story in itertools.islice(stories, 1000):
        setpoint = one.command(*story)
        assert wrong_with(setpoint, stories.parameters.limits) == ""
        assert again.command(*story) == setpoint
