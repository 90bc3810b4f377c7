"""Whole swarms in one process: every drone's real `Onboard`, from synthetic detections to names."""

import functools

import pytest

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.identity import recognition


@functools.cache
def fly(scenario, drones, seconds, seed):
    return recognition.fly(scenario, drones, seconds, "kalman", seed)


@pytest.mark.parametrize(
    ("scenario", "drones", "seconds"),
    [
        ("hover-triangle", 3, 6.0),
        ("crossing", 4, 6.0),
        *(
            pytest.param(*flight, marks=pytest.mark.long("other scenarios than the two of the default run"))
            for flight in [("fast-yaw", 4, 6.0), ("late-joiner", 3, 11.0)]
        ),
    ],
)
def test_everybody_is_known_and_nobody_taken_for_another(scenario, drones, seconds):
    score = fly(scenario, drones, seconds, 1).score
    assert score.wrong == 0.0
    assert score.correct > 0.97
    assert score.agreement == 1.0


@pytest.mark.parametrize(
    "seconds", [8.0, pytest.param(12.0, marks=pytest.mark.long("twelve seconds, not eight"))]
)
def test_who_hides_behind_another_keeps_its_name(seconds):
    score = fly("occlusion", 4, seconds, 3).score
    assert score.wrong <= 0.001
    assert score.correct > 0.95


@pytest.mark.long("another flight of 10 s; team/test_strangers.py has strangers in the default run")
def test_an_intruder_is_nobody_of_the_team():
    score = fly("intruder", 3, 10.0, 1).score
    assert score.wrong == 0.0
    assert score.correct > 0.97


@pytest.mark.long("another flight of 16 s; live/test_proof.py has proofs in the default run")
def test_motion_proves_the_names_of_a_team_that_tells_how_it_moves():
    score = recognition.fly("proof", 3, 16.0, "mbm", 1).score
    assert score.wrong == 0.0
    assert score.proved > 0.4
    assert fly("hover-triangle", 3, 6.0, 1).score.proved == 0.0


def test_a_team_that_can_be_seen_apart_announces_itself_once():
    assert fly("hover-triangle", 3, 6.0, 1).announcements_per_drone == 1.0


@pytest.mark.long("flies again; test_identity_layouts.py compares flights in the default run")
def test_the_same_seed_flies_the_same_flight():
    one, other = (recognition.fly("crossing", 3, 1.5, "kalman", 5) for _ in range(2))
    assert one == other


def test_the_page_has_a_line_for_each_scenario():
    row = recognition.summary([fly("hover-triangle", 3, 6.0, 1)])
    page = report.table_of(recognition.BENCH.columns, [{"name": "hover-triangle", **row}])
    assert "| hover-triangle | 100.00 (" in page
