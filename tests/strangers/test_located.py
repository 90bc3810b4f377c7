"""What several drones make of the same strangers: one number, one place, and nothing from those that lie."""

import math

import numpy as np
import pytest

from support.observer import CAMERA
from support.stranger_world import ERRORS, World
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.messages import Sighting, SightingReport, StrangerRay, StrangerReport
from swarmtrack.relative.metres import MeasuringCamera
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.strangers.located import Strangers
from swarmtrack.strangers.priors import MOST_STRANGERS, STRANGER_LASTS_S
from swarmtrack.strangers.sights import OwnSight

IDS = (1, 2, 3)
SCAN_S = 0.1


class Team:
    """Three `Strangers`, told of their scans and of each other's reports, without trackers and names."""

    def __init__(self, seed=0):
        self.world = World(seed)
        self.world.velocity = np.array([0.3, -0.2, 0.0])
        camera = MeasuringCamera(CAMERA, Pose(BODY_FROM_FORWARD_CAMERA, np.zeros(3)), None)
        self.drones = {i: Strangers(i, RelativeParameters(), cameras=[camera]) for i in IDS}
        self.t = 0.0

    def fly(self, seconds, sees=IDS, also=None, foreign=True):
        """also: a second stranger's place, seen by all in track 8."""
        for k in range(round(seconds / SCAN_S)):
            self.t += SCAN_S
            for i in IDS:
                tracks = {}
                if i in sees:
                    tracks[7] = self.ray(i, self.world.place)
                    if also is not None:
                        tracks[8] = self.ray(i, also)
                ids = frozenset(tracks)
                sight = OwnSight(
                    self.t,
                    0.0,
                    self.world.camera[i - 1],
                    ERRORS,
                    tracks,
                    ids if foreign else frozenset(),
                    ids,
                )
                self.drones[i].take_sight(sight)
            if k % 4 == 0:
                self.tell()
            self.world.place = self.world.place + SCAN_S * self.world.velocity

    def ray(self, i, place):
        seen = self.world.ray(i - 1, self.t, place)
        return StrangerRay(0, seen.direction, seen.sigma, 0.51 / math.exp(seen.range_ln))

    def tell(self):
        for i in IDS:
            report = self.drones[i].report(f"{i:08x}", 0)
            if report is not None:
                self.hear(report, i)

    def hear(self, report, but=0):
        for j in IDS:
            if j != but:
                self.drones[j].hear(report, self.t)

    def located(self):
        return {i: {one.number: one for one in self.drones[i].located(self.t)} for i in IDS}


@pytest.mark.parametrize("seed", range(4))
def test_all_agree_on_the_lowest_number_and_on_the_place(seed):
    team = Team(seed)
    team.fly(6.0)
    found = team.located()
    assert {tuple(by_number) for by_number in found.values()} == {(101,)}
    places = np.array([by_number[101].position for by_number in found.values()])
    assert np.ptp(places, axis=0).max() < 0.5
    assert np.linalg.norm(places[0] - team.world.place) < 0.1 * np.linalg.norm(places[0])
    assert found[1][101].observers == IDS


def test_one_observers_number_is_kept_by_those_that_see_it_later():
    team = Team()
    team.fly(2.0, sees=(3,))
    assert {tuple(by_number) for by_number in team.located().values()} == {(301,)}
    team.fly(3.0)
    assert {tuple(by_number) for by_number in team.located().values()} == {(301,)}


@pytest.mark.parametrize("seed", range(3))
def test_two_strangers_have_two_numbers_and_each_its_own(seed):
    team = Team(seed)
    other = team.world.place + np.array([-4.0, 3.0, 1.5])
    team.fly(8.0, also=other)
    for by_number in team.located().values():
        assert len(by_number) == 2
        off = [
            min(np.linalg.norm(one.position - there) for one in by_number.values())
            for there in (team.world.place, other)
        ]
        assert max(off) < 1.5


def test_a_track_that_may_be_a_teammate_claims_no_number_and_loses_the_one_it_has():
    team = Team()
    team.fly(3.0, foreign=False)
    assert not any(team.located().values())
    team.fly(2.0)
    assert all(team.located().values())
    for i in IDS:
        sight = OwnSight(
            team.t + SCAN_S, 0.0, team.world.camera[i - 1], ERRORS, {}, frozenset(), frozenset({7})
        )
        team.drones[i].take_sight(sight)
        assert team.drones[i].report("0" * 8, 0) is None
    team.fly(1.0, sees=())
    assert all(one.observers == () for found in team.located().values() for one in found.values())


def test_a_stranger_that_nobody_sees_any_more_ends():
    team = Team()
    team.fly(3.0)
    team.fly(STRANGER_LASTS_S + 1.0, sees=())
    assert not any(team.located().values())
    assert not any(map(bool, team.drones.values()))


def test_a_stranger_at_the_place_of_a_teammate_is_none():
    team = Team()
    team.world.velocity = np.zeros(3)
    team.fly(6.0)
    assert all(team.located().values())
    mate = SightingReport(4, "0" * 8, 0, team.t, 0.0, team.world.place, 0.2, (), ())
    for drone in team.drones.values():
        drone.hear_sightings(mate)
    assert not any(team.located().values())


def liar(team, n=1, t=None, **changed):
    ray = np.array([0.0, 0.6, -0.8])
    fields = {
        "observer": 9,
        "boot": "0" * 8,
        "sequence": 0,
        "t": team.t if t is None else t,
        "t_sigma": 0.0,
        "position": np.array([5.0, 5.0, 0.0]),
        "position_sigma": 0.1,
        "tilt_sigma": 0.01,
        "heading_sigma": 0.03,
        "rays": tuple(StrangerRay(900 + k, ray, 0.005, 0.05) for k in range(n)),
    }
    return StrangerReport(**fields | changed)


def test_a_liars_rays_to_a_stranger_of_ours_are_refused_and_counted():
    team, honest = Team(), Team()
    team.fly(4.0)
    honest.fly(4.0)
    for _ in range(20):
        team.hear(liar(team, rays=(StrangerRay(101, np.array([0.0, 0.6, -0.8]), 0.005, 0.05),)))
    for i in IDS:
        assert team.drones[i].counters["stranger_rays_refused"] == 20
        off = team.located()[i][101].position - honest.located()[i][101].position
        assert np.linalg.norm(off) < 0.2


def test_a_flood_of_strangers_is_bounded_and_leaves_ours_alone():
    team = Team()
    team.fly(3.0)
    for k in range(50):
        team.hear(
            liar(
                team,
                observer=10 + k % 20,
                rays=tuple(
                    StrangerRay(1000 + 10 * k + j, np.array([0.0, 0.6, -0.8]), 0.005, 0.05) for j in range(10)
                ),
            )
        )
    for drone in team.drones.values():
        assert len(drone.located(team.t)) <= MOST_STRANGERS
        assert drone.counters["strangers_crowded"] > 0
    assert all(101 in found for found in team.located().values())


@pytest.mark.parametrize(
    ("changed", "counter"),
    [
        ({"t": 1e9}, "strangers_late"),
        ({"t": -1e9}, "strangers_late"),
        ({"position_sigma": 100.0}, "strangers_vague"),
        ({"heading_sigma": 3.0}, "strangers_vague"),
        ({"t_sigma": 10.0}, "strangers_vague"),
    ],
)
def test_a_report_of_another_time_or_from_nowhere_is_counted(changed, counter):
    team = Team()
    team.fly(1.0)
    team.hear(liar(team, **changed))
    assert all(drone.counters[counter] == 1 for drone in team.drones.values())


def test_one_teammates_guess_is_no_obstacle_and_two_observers_place_is():
    team = Team()
    team.fly(3.0, sees=(2,))
    assert team.drones[1].obstacles(team.t, np.zeros(3), np.zeros(3)) == {}
    team.fly(3.0, sees=(2, 3))
    (track,) = states = team.drones[1].obstacles(team.t, np.zeros(3), np.array([1.0, 0.0, 0.0]))
    number = -track
    assert number in team.located()[1]
    assert np.allclose(states[track].velocity, team.located()[1][number].velocity - [1.0, 0.0, 0.0])


def test_mutual_sightings_make_the_place_surer():
    def spread(calibrated):
        team = Team(2)
        for k in range(5):
            for i in IDS:
                seen = tuple(
                    Sighting(
                        j,
                        0.99,
                        team.world.ray(
                            i - 1, 0.0, team.world.camera[j - 1] + team.world.off[j - 1]
                        ).direction,
                        0.03,
                    )
                    for j in IDS
                    if j != i
                )
                at = team.world.camera[i - 1]
                report = SightingReport(i, "0" * 8, k, 1.0 * k, 0.0, at, 0.1, IDS, seen if calibrated else ())
                for drone in team.drones.values():
                    drone.hear_sightings(report)
        team.t = 5.0
        team.fly(5.0)
        return np.sqrt(np.trace(team.located()[1][101].cov[:3, :3]))

    assert spread(True) < 0.8 * spread(False)
