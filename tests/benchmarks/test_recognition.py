"""Whole swarms in one process: every drone's real `Onboard`, from synthetic detections to names."""

import pytest

from swarmtrack.benchmarks.identity.recognition import fly


@pytest.mark.parametrize(
    ("scenario", "drones"), [("hover-triangle", 3), ("crossing", 4), ("fast-yaw", 4), ("late-joiner", 3)]
)
def test_everybody_is_known_and_nobody_taken_for_another(scenario, drones):
    score = fly(scenario, drones, 11.0, "kalman", 1).score
    assert score.wrong == 0.0
    assert score.correct > 0.97
    assert score.agreement == 1.0


def test_who_hides_behind_another_keeps_its_name():
    score = fly("occlusion", 4, 16.0, "kalman", 3).score
    assert score.wrong <= 0.001
    assert score.correct > 0.95


def test_an_intruder_is_nobody_of_the_team():
    score = fly("intruder", 3, 15.0, "kalman", 1).score
    assert score.wrong == 0.0
    assert score.correct > 0.97


def test_a_team_that_can_be_seen_apart_announces_itself_once():
    assert fly("hover-triangle", 3, 10.0, "kalman", 2).announcements_per_drone == 1.0


def test_the_same_seed_flies_the_same_flight():
    one, other = (fly("crossing", 4, 6.0, "kalman", 5) for _ in range(2))
    assert one == other
