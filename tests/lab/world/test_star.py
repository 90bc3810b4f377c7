"""Stars: followers that somebody flies, a leader that flies as its sticks say, and files that are refused."""

import math

import numpy as np
import pytest

from swarmtrack.errors import ConfigError
from swarmtrack.formation.plan import FormationPlan, plan_faults
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.world.guided import GuidedDrone

STAR = """about = "x"
seconds = 30
[formation]
drones = 3
[formation.star]
takes_off_s = 4.0
engages_s = 14.0
judged_from_s = 20.0
sticks = [
  { at_s = 15.0, velocity_m_s = [0.0, 0.0, 0.0] },
  { at_s = 17.0, velocity_m_s = [2.0, 0.0, 0.0] },
  { at_s = 25.0, velocity_m_s = [0.0, 0.0, 0.0] },
]
"""


def problems(folder, text, **wanted):
    path = folder / "star.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_scenario(path, **wanted)
    return [problem.removeprefix(f"{folder}/") for problem in caught.value.problems]


def test_a_leader_climbs_flies_as_its_sticks_say_and_stands_where_they_are_let_go(tmp_path):
    path = tmp_path / "star.toml"
    path.write_text(STAR, encoding="utf-8")
    scenario = load_scenario(path)
    leader, star = scenario.world.flown(1), scenario.star
    assert star.velocity(16.0) == pytest.approx((1.0, 0.0, 0.0))
    assert star.velocity(14.0) == star.velocity(99.0) == (0.0, 0.0, 0.0)
    for t in (-10.0, 3.9):
        assert leader.position(t) == pytest.approx((0.0, 0.0, -0.09))
    assert leader.position(14.0) == pytest.approx((0.0, 0.0, -6.0), abs=0.3)
    assert leader.motion(17.5).velocity[0] == pytest.approx(2.0, abs=0.4)
    # A triangle of 10 s and 2 m/s.
    assert leader.position(33.0) == pytest.approx((10.0, 0.0, -6.0), abs=0.5)
    assert leader.takes_off_s == 4.0


@pytest.mark.parametrize("hovers", [True, False])
def test_followers_begin_in_or_below_their_slots_and_look_at_their_leader(tmp_path, hovers):
    path = tmp_path / "star.toml"
    path.write_text(STAR.replace("takes_off_s = 4.0", "") if hovers else STAR, encoding="utf-8")
    scenario = load_scenario(path)
    for drone_id in scenario.star.followers:
        drone = scenario.world.drones[drone_id]
        assert isinstance(drone, GuidedDrone)
        north, east, down = scenario.star.slots[drone_id]
        assert drone.start[2] == pytest.approx(down - 6.0 if hovers else -0.09)
        assert math.dist(drone.start[:2], (north, east)) < 1.5
        assert drone.yaw(0.0) == pytest.approx(math.atan2(-east, -north))
        assert drone.airborne is hovers
    heights = [scenario.world.pose(1, t).position[2] for t in (-9.0, 3.0)]
    assert heights == pytest.approx(np.full(2, -6.0 if hovers else -0.09), abs=0.15)


@pytest.mark.parametrize("drones", range(2, 15))
def test_every_star_that_is_flown_is_one_that_its_agents_accept(drones):
    star = load_scenario("formation-3", drones=drones).star
    plan = FormationPlan(
        leader=1,
        slots=star.slots,
        references=dict.fromkeys(star.followers, (1,)),
        height=star.height_m,
        least_height=2.0,
    )
    assert len(star.slots) == drones
    assert plan_faults(plan, 0.5) == []


def test_who_was_put_on_each_others_places_says_the_others_start():
    scenario = load_scenario("swapped-id")
    truth = {drone_id: pose.position for drone_id, pose in scenario.initial_poses.items()}
    for drone_id, stands_at in ((1, 3), (2, 2), (3, 1), (4, 4)):
        assert np.linalg.norm(scenario.announced[drone_id].position_m - truth[stands_at]) < 2.0


def test_the_intruder_flies_through_the_first_followers_slot_at_two_metres_per_second():
    scenario = load_scenario("intruder-crosses")
    intruder, star = scenario.world.flown(999), scenario.star
    slot = np.array(star.slots[2]) - (0.0, 0.0, star.height_m)
    assert np.linalg.norm(intruder.position(22.0) - slot) < 0.3
    speeds = [np.linalg.norm(intruder.motion(t).velocity) for t in np.arange(15.0, 29.0, 0.5)]
    assert speeds == pytest.approx(np.full(28, 2.0), abs=0.2)


@pytest.mark.parametrize(
    ("text", "line", "complaint"),
    [
        (STAR.replace("judged_from_s", "judge_from_s"), 8, ".judge_from_s: unknown key, did you mean"),
        (STAR.replace("star]", "star]\ngap_m = 2"), 6, ".gap_m: 2, expected greater than or equal to 3"),
        (
            STAR.replace("engages_s = 14", "engages_s = 5"),
            5,
            ": engages_s 5, expected takes_off_s + 8 or later",
        ),
        (STAR.replace("17.0", "14.0"), 5, ": sticks at_s [15.0, 14.0, 25.0], expected each later"),
        (
            STAR.replace("15.0, velocity_m_s = [0.0", "15.0, velocity_m_s = [1.0"),
            5,
            ": sticks: the first and",
        ),
        (STAR.replace("[2.0", "[7.0"), 5, ": sticks: 7 m/s, expected 5 m/s or less"),
        (STAR.replace("drones = 3", "drones = 1"), 5, ": one drone, expected a leader and a follower"),
        (
            STAR.replace("drones = 3", "drones = 16"),
            5,
            ": 16 drones, slots.4: 1.8 m from the slot of drone 2",
        ),
    ],
)
def test_what_cannot_be_flown_is_named_with_its_file_and_line(tmp_path, text, line, complaint):
    found = problems(tmp_path, text)
    assert any(problem.startswith(f"star.toml:{line}: formation.star{complaint}") for problem in found), found


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (STAR + "[agents]\nswapped = [1, 9]\n", "15: agents.swapped: drone 9, expected some of [1, 2, 3]"),
        (STAR + "[agents]\nswapped = [1, 1]\n", "15: agents.swapped: drone 1, expected some of [1, 2, 3]"),
        (
            STAR.replace("= 3\n", '= 3\nautopilots = ["px4"]\n'),
            "3: formation: star with autopilots, expected",
        ),
        (
            STAR.replace("= 3\n", "= 3\nring = { radius_m = 3 }\n"),
            "3: formation: 2 of ring, lanes, errand and",
        ),
        (
            STAR + "[formation.swing]\npeak_rad_s = 1\nperiod_s = [5, 9]\n",
            "3: formation: star with swing, expec",
        ),
        ("codes_s = [3.0]\n" + STAR, "1: codes_s: with guided drones, errands or a star, expected"),
        (STAR + "[[drone]]\nid = 9\nposition_m = [0, 0, -9]\n", "14: drone: of the team beside a star"),
    ],
)
def test_what_does_not_go_with_a_star_is_named(tmp_path, text, complaint):
    found = problems(tmp_path, text)
    assert any(problem.startswith(f"star.toml:{complaint}") for problem in found), found
