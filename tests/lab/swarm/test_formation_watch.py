"""What counts of a flight in formation: slots by the truth, holds by the agents' word, strangers once seen."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario, as_told
from swarmtrack.lab.swarm.formation_watch import FormationWatch
from swarmtrack.lab.world.followed import FollowedDrone


def flown(name: str, seconds: float, late_s: float = 0.0) -> Scenario:
    """A scenario whose followers are where their slots were so long ago, told until then."""
    scenario, followed = as_told(load_scenario(name))
    star = scenario.star
    assert star is not None
    leader = scenario.world.drones[star.leader]
    for drone_id, drone in followed.items():
        for t in np.arange(0.0, seconds + 0.3, 0.05):
            drone.add_pose(t, Pose(np.eye(3), leader.position(t - late_s) + np.array(star.slots[drone_id])))
    return scenario


def health(boot: str, holds: float) -> Any:
    link = SimpleNamespace(name="formation", counters={"holds": holds})
    return SimpleNamespace(boot=boot, links=[link])


def score(scenario: Scenario, seconds: float, said: Any = None, saw: Any = ()) -> Any:
    assert scenario.star is not None
    watch = FormationWatch(scenario, scenario.star)
    for glance in saw:
        watch.saw(*glance)
    return watch.score(said or {}, seconds)


def test_where_times_count_from_a_take_off_the_judgement_begins_as_much_later() -> None:
    scenario = flown("formation-3", 22.0, late_s=1.0)
    star = scenario.star
    assert star is not None
    watch = FormationWatch(scenario, star)
    assert watch.score({}, 22.0).error_p95_m == pytest.approx(1.5, abs=0.1)
    # Nothing is judged of a flight that ends before.
    assert watch.score({}, 22.0, counts_from=22.0 - star.judged_from_s).error_p95_m != pytest.approx(
        1.5, abs=0.1
    )


def test_who_is_a_second_late_is_as_far_off_as_the_leader_flies_in_a_second() -> None:
    scenario = flown("formation-3", 22.0, late_s=1.0)
    found = score(scenario, 22.0)
    assert found.followers == 2
    assert found.error_p95_m == pytest.approx(1.5, abs=0.1)
    assert found.lost == 0
    assert found.gone is None


def test_holds_are_counted_from_when_slots_are_judged_also_over_a_restart() -> None:
    scenario = flown("formation-3", 30.0)
    said = [
        (12.0, health("a", 3.0)),
        (25.0, health("a", 4.0)),
        (27.0, health("b", 0.0)),
        (29.0, health("b", 2.0)),
    ]
    assert score(scenario, 30.0, {2: said, 1: said}).holds == 3


def test_a_stranger_is_to_be_kept_clear_of_once_it_was_in_view_for_a_second() -> None:
    scenario = flown("intruder-crosses", 29.0)
    unseen, seen = (
        score(scenario, 29.0, saw=[(2, begins + k / 10, {1, 999}) for k in range(11)])
        for begins in (23.5, 19.0)
    )
    assert unseen.min_separation_m > 1.5
    # The follower of this test evades nobody, and the stranger flies through its slot.
    assert seen.min_separation_m < 0.3


def test_where_the_leader_leaves_its_followers_are_judged_by_how_they_stop() -> None:
    scenario = flown("leader-lost", 35.0)
    found = score(scenario, 35.0, saw=[(2, 23.0, {1}), (3, 22.0, {1}), (1, 29.0, {2})])
    assert found.error_p95_m < 0.1
    assert found.gone is not None
    # These climb after it.
    assert found.gone.speeds[-1] == pytest.approx(np.hypot(1.5, 2.5), abs=0.1)


def test_what_nobody_told_is_left_out() -> None:
    scenario = flown("formation-3", 30.0)
    world = scenario.world
    gap = FollowedDrone(keep_s=np.inf)
    told = world.drones[2]
    assert isinstance(told, FollowedDrone)
    for sample in told.samples:
        if not 25.0 < sample.t < 27.0:
            gap.add_pose(*sample)
    scenario = replace(scenario, world=replace(world, drones={**world.drones, 2: gap}))
    assert score(scenario, 30.0).error_p95_m < 0.1
