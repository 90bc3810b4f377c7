"""Names with several cameras per drone, as the benchmark flies them."""

import dataclasses

import numpy as np
import pytest

from swarmtrack.benchmarks import all_round, report
from swarmtrack.benchmarks.virtual_swarm import VirtualSwarm, oracle_eyes
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.score.swarm_score import Glance, NamedTrack


def box(u: float) -> np.ndarray:
    return np.array([u, 240.0, 60.0, 20.0])


def crossing(names: list[int | None]) -> all_round.SeamWatch:
    """Drone 2 crosses from the first camera of drone 1 to the second, named so at each tenth of a second."""
    watch = all_round.SeamWatch(load_scenario("two-cameras"))
    for k, name in enumerate(names):
        u = 300.0 + 15.0 * k
        ahead = ({2: box(u)}, {2: box(u - 550.0)})
        track = NamedTrack(7, name, 0.97, u, 240.0)
        watch.add_glance(Glance(1, "boot", 10 + k, 1.0 + 0.1 * k, {2: box(u)}, {}, (track,), ahead))
    return watch


def test_a_drone_that_leaves_one_picture_for_the_next_has_crossed_once_and_is_at_the_seam_until_a_second_later():
    watch = crossing([2] * 40)
    assert watch.crossings == 1
    # In both pictures from 550 px on, in the first one until 639: six tenths; then ten more. The first second is grace.
    assert watch.samples == {True: 16, False: 14}
    assert watch.nameless == {True: 0, False: 0}


def test_who_has_no_name_is_counted_at_the_seam_or_elsewhere():
    assert crossing([2] * 20 + [None] * 2 + [2] * 18).nameless == {True: 2, False: 0}
    assert crossing([2] * 12 + [3] * 2 + [2] * 26).nameless == {True: 0, False: 2}


def test_every_camera_exposes_at_its_own_phase_and_its_detections_come_with_its_number():
    scenario = load_scenario("all-round", seed=3)
    seen = []
    oracle = oracle_eyes(scenario)

    def eyes(exposure):
        found = oracle(exposure)
        seen.append((exposure, found))
        return found

    swarm = VirtualSwarm(scenario, eyes=eyes, observers=[1])
    scans = list(swarm.fly(0.5))
    assert {exposure.camera for exposure, _ in seen} == {scan.camera for scan in scans} == {0, 1, 2, 3}
    for exposure, found in seen:
        assert found.camera == 0, "a detector does not know which camera it looks through"
        assert exposure.t * 10.0 % 1.0 == pytest.approx(exposure.camera / 4.0, abs=1e-6)
    for scan in scans:
        ((_, found),) = [(e, f) for e, f in seen if e.t == scan.exposed_t]
        np.testing.assert_array_equal(found.centre, scan.centres)
    assert {entry.track.camera for scan in scans for entry in scan.tracks.tracks} >= {0, 1, 2, 3}


@pytest.mark.long("flies for 9 s; cameras/test_several_cameras.py crosses seams in the default run")
def test_with_two_cameras_the_neighbours_keep_their_names_across_the_seam():
    flight = all_round.fly("two-cameras", 9.0, "mbm", 1)
    assert flight.score.wrong == 0.0
    assert flight.score.correct > 0.99
    assert flight.crossings >= 2
    assert flight.at_seams[0] > 50
    assert flight.at_seams[1] <= 1
    assert flight.score.switches == 0


@pytest.mark.long("15 s of four cameras; the default run has 9 s of two")
def test_all_around_hardly_anybody_is_unknown_because_of_a_seam():
    flight = all_round.fly("all-round", 15.0, "mbm", 1)
    assert flight.score.wrong == 0.0
    assert flight.score.correct > 0.99
    assert flight.crossings > 10
    assert flight.at_seams[1] <= 0.01 * flight.at_seams[0]


def test_a_summary_weighs_flights_by_what_was_seen_in_them():
    one = all_round.fly("two-cameras", 1.5, "mbm", 1)
    assert one.score.samples > 0
    worse = dataclasses.replace(
        one, score=dataclasses.replace(one.score, correct=0.5, unknown=0.5), at_seams=(30, 15)
    )
    found = all_round.summary([one, worse])
    assert found["correct"]["value"] == pytest.approx(0.5 * one.score.correct + 0.25)
    assert found["nameless_at_seams"]["value"] == pytest.approx(
        (one.at_seams[1] + 15) / (one.at_seams[0] + 30)
    )
    assert found["samples"] == 2 * one.score.samples
    assert "| two | " in report.table_of(all_round.BENCH.columns, [{"name": "two", **found}])
