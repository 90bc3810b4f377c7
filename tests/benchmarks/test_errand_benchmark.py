"""What `swarmtrack bench errand` counts, and that a flight in which all cameras stamp wrong is judged."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from swarmtrack.benchmarks import rendered_eyes
from swarmtrack.benchmarks.errands import benchmark
from swarmtrack.benchmarks.errands.benchmark import Programme, fly, scenario_of_seed, summary
from swarmtrack.benchmarks.errands.judge import ClockRecord, FlightJudge
from swarmtrack.benchmarks.virtual_swarm import Exposure, ObservedScan, VirtualSwarm
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.swarm_truth import SwarmTruth
from swarmtrack.messages import Array, IdentifiedTrack, Track, TrackList, TrackStatus
from swarmtrack.motion.time_offset import OffsetEstimate


def clock(used_s: float, found: tuple[float, float] | None = None) -> SimpleNamespace:
    return SimpleNamespace(used_s=used_s, found=found and OffsetEstimate(*found))


def test_what_a_clock_settles_on_is_adopted_and_what_it_passes_is_not() -> None:
    record = ClockRecord(true_s=0.050, turns_from=10.0)
    for k, used in enumerate((0.0, 0.0, 0.02, 0.04, 0.051, 0.051, 0.051)):
        record.add_sample(12.0 + k, clock(used, (0.051, 0.002)))
    (adopted,) = record.adopted
    assert (adopted.error_s, adopted.sigma_s) == (pytest.approx(0.001), 0.002)
    assert not adopted.off
    assert record.found_after_s == pytest.approx(6.0)


def test_a_wrong_claim_is_off_and_what_is_given_back_was_not_found() -> None:
    record = ClockRecord(true_s=0.0, turns_from=10.0)
    for k, used in enumerate((0.0, 0.06, 0.06, 0.0, 0.0)):
        record.add_sample(20.0 + k, clock(used, (0.06, 0.002) if k < 3 else (0.01, 0.006)))
    assert [adopted.off for adopted in record.adopted] == [True]
    assert record.found_after_s == pytest.approx(13.0)


def test_every_seed_has_offsets_a_team_and_a_rate_of_its_own() -> None:
    scenarios = [scenario_of_seed(Programme(), seed) for seed in (1, 2, 3)]
    assert [len(s.members) for s in scenarios] == [3, 4, 2]
    late = [value for s in scenarios for value in s.camera_offset_s.values()]
    assert len(set(late)) == 9
    assert np.abs(late).max() <= 0.080
    assert all(6.0 <= s.fps <= 15.0 and s.ghosts for s in scenarios)
    assert scenario_of_seed(Programme(ghosts=False), 1).ghosts == ()


def scans_of(judge: FlightJudge, truth: SwarmTruth, stays: list[tuple[float, float, float]]) -> None:
    """Drone 1's scans, ten per second; stays: in view from … to, named from …; detected from the start."""
    for k in range(300):
        t = 0.1 * k
        box = truth.view(1, 0.0).in_view[2]
        stay = next((s for s in stays if s[0] <= t < s[1]), None)
        centres = box[None, :2] if stay else np.empty((0, 2))
        name = 2 if stay and t >= stay[2] else None
        state = Track(
            7, t, np.array([box[0], 0.0, box[1], 0.0]), np.eye(4), TrackStatus.CONFIRMED, 1.0, box[2:]
        )
        tracks = (IdentifiedTrack(state, name, 0.9 if name else 0.0),) if stay else ()
        view = truth.view(1, 0.0)
        judge._meet(
            ObservedScan(1, t, TrackList(t, t, tracks), centres, t),
            2,
            view if stay else view._replace(in_view={}),
        )


def test_named_again_counts_from_the_detection_and_only_after_a_time_away() -> None:
    scenario = scenario_of_seed(Programme(drones=(2,)), 1)
    judge = FlightJudge(scenario, VirtualSwarm(scenario))
    truth = SwarmTruth(scenario.world, scenario.cameras)
    stays = [
        (0.0, 5.0, 1.0),
        (6.0, 9.0, 8.0),
        (12.0, 15.0, 12.5),
        (18.0, 21.0, math.inf),
        (24.0, 24.5, math.inf),
    ]
    scans_of(judge, truth, stays)
    # The first is no return, the second was away for too short, the last stayed for too short.
    assert judge.named_again == [pytest.approx(0.5), math.inf]


def test_a_name_on_a_house_is_told_with_its_probability_even_while_its_drone_has_no_track() -> None:
    scenario = scenario_of_seed(Programme(drones=(2,)), 1)
    judge = FlightJudge(scenario, VirtualSwarm(scenario))
    view = SwarmTruth(scenario.world, scenario.cameras).view(1, 0.0)
    u, v, *size = view.in_view[2]
    for off_px, probability, coasting_since in ((0.0, 1.0, None), (90.0, 0.97, None), (90.0, 0.99, -0.5)):
        track = Track(
            7, 0.0, np.array([u + off_px, 0.0, v, 0.0]), np.eye(4), TrackStatus.CONFIRMED, 1.0, np.array(size),
            coasting_since,
        )  # fmt: skip
        tracks = TrackList(0.0, 0.0, (IdentifiedTrack(track, 2, probability),))
        judge._names_elsewhere(ObservedScan(1, 0.0, tracks, np.empty((0, 2)), 0.0), view)
    flight = judge.record(1, 8.0)
    assert (flight.names, flight.names_elsewhere, flight.names_on_others) == (3, 2, 1)
    assert flight.surest_on_others == 0.97


def test_in_drawn_pictures_the_agents_detector_looks_where_its_drone_expects_a_teammate(monkeypatch) -> None:
    scenario = scenario_of_seed(Programme(drones=(2,), rendered=True), 4)
    in_the_air = 15.0
    box = SwarmTruth(scenario.world, scenario.cameras).view(1, in_the_air).in_view[2]
    expected = np.array([[*box[:2], 5.0, 5.0, *box[2:]]])
    monkeypatch.setattr(rendered_eyes, "PerceivedExpectation", Expects)
    eyes = rendered_eyes.rendered_eyes(scenario)
    whole, near = (
        eyes(Exposure(1, k, in_the_air, in_the_air + 0.05, boxes))
        for k, boxes in enumerate((np.empty((0, 6)), expected))
    )
    for found in (whole, near):
        assert np.hypot(*(found.centre - box[:2]).T).min() < 5.0
        assert found.t == in_the_air + 0.05, "by the camera's own clock"
    assert near.coverage < 0.5 < whole.coverage


class Expects:
    """These boxes (n, 6), whenever; and nobody knows of turns."""

    def __init__(self, boxes: Array, camera: int) -> None:
        self._boxes = boxes

    def boxes(self, exposed: float) -> Array:
        return self._boxes

    def pixels_at(self, then: float, now: float) -> None:
        return None


@pytest.mark.long("a rendered flight; the default run flies the others")
def test_a_rendered_flight_is_flown_once_and_not_compared(monkeypatch) -> None:
    def short(p: Programme, seed: int) -> Scenario:
        scenario = scenario_of_seed(p, seed)
        slow = tuple(dataclasses.replace(camera, fps=5.0) for camera in scenario.cameras)
        return dataclasses.replace(scenario, seconds=2.0, cameras=slow)

    monkeypatch.setattr(benchmark, "scenario_of_seed", short)
    programme = Programme(drones=(2,), rendered=True)
    assert not benchmark.twins_of(programme)
    assert list(benchmark.twins_of(Programme(seeds=9))) == [1, 5, 9]
    flight = dataclasses.replace(fly(programme, False, 1), nis=[1.0])  # which is judged after the first turns
    found = summary([flight], [])
    page = benchmark._page(dataclasses.asdict(programme) | found)
    assert "drawn pictures, shipped detector" in page
    assert "highest probability of a wrong name" in page
    assert "turning" not in page


@pytest.mark.long("a whole errand of cameras that stamp wrong")
def test_a_flight_whose_cameras_stamp_wrong_finds_by_how_much_and_names_nobody_wrong(monkeypatch) -> None:
    monkeypatch.setattr(benchmark, "FPS", (8.0, 8.0))
    programme = Programme(drones=(2,))
    flight, twin = fly(programme, False, 1), fly(programme, True, 1)
    found = summary([flight], [twin])
    assert found["offset"]["adopted"] >= 1
    assert found["offset"]["largest_error_ms"] < 15.0
    assert found["names"]["right"] > 0.7
    assert found["named_again"]["times"] >= 1
    assert found["turning"]["turning"]["told_px"] < 4.0
    assert twin.clocks[1].adopted == []
