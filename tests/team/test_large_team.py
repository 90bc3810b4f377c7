"""A large team's posterior is what it is without sleep: pairs that are far sleep, and wake when they are needed."""

import numpy as np
import pytest

from swarmtrack.messages import AgreedMotion, Announcement
from swarmtrack.team import mixture
from swarmtrack.team.mixture import OwnKnowledge
from swarmtrack.team.posterior import BearingScan, TeamPosterior
from swarmtrack.team.priors import SMALL_TEAM
from swarmtrack.team.track_evidence import Bearing

MATES, SEEN, SCAN_S = 14, 11, 0.2
IDS = range(2, 2 + MATES)
T = np.arange(0.0, 40.0, 0.1)
SIGMA_RAD, ATTITUDE_SIGMA_RAD = 0.003, 0.004
VARIANCE = SIGMA_RAD**2 + ATTITUDE_SIGMA_RAD**2


def start(drone):
    """On an arc ahead."""
    angle = np.radians(-45.0 + 90.0 * (drone - 2) / (MATES - 1))
    return np.array([12.0 * np.cos(angle), 12.0 * np.sin(angle), 0.0])


def moved(drone, t):
    """(n, 3) m: each about its start, and no two alike."""
    rate = 0.7 + 0.11 * drone
    return np.stack([np.zeros_like(t), 0.6 * np.sin(rate * t), 0.5 * np.sin(1.3 * rate * t + drone)], axis=-1)


def flight(seconds, handed_over=None):
    """A drone that sees SEEN of its MATES, by name or by track; handed_over: since when [s] track 2 is another."""
    posterior, chance = TeamPosterior(1, cameras=1, start_sigma_m=0.1), np.random.default_rng(4)
    for drone in IDS:
        cov = 0.01 * np.eye(3)
        posterior.announce(Announcement(drone, "0000000a", 1, 0.0, 0.0, start(drone), np.eye(3), cov))
        posterior.agree(AgreedMotion(drone, T, moved(drone, T) - moved(drone, T[:1]), planned=False))
    for t in np.arange(SCAN_S, seconds, SCAN_S).tolist():
        bearings, turn = {}, chance.normal(0.0, ATTITUDE_SIGMA_RAD, 3)
        for id in range(2, 2 + SEEN):
            drone = 2 + SEEN if id == 2 and handed_over is not None and t >= handed_over else id
            place = start(drone) + moved(drone, np.array([t]))[0] - moved(drone, T[:1])[0]
            ray = place / np.linalg.norm(place)
            ray = ray + np.cross(turn, ray) + chance.normal(0.0, SIGMA_RAD, 3)
            pixel = 1000.0 * ray[1:]
            bearings[id] = Bearing(
                t, np.zeros(3), pixel, ray / np.linalg.norm(ray), VARIANCE, float(np.linalg.norm(place))
            )
        scan = BearingScan(t, 0, np.zeros(3), bearings, {})
        posterior.observe(scan, bearings.keys(), np.zeros(3), OwnKnowledge(0.1, 0.02))
    return posterior


@pytest.fixture(scope="module")
def slept():
    return flight(14.0)


def asleep(posterior):
    return sum(int(np.isfinite(track.faint).sum()) for track in posterior._tracks.values())


def test_many_teammates_at_once_are_what_each_is_alone(monkeypatch):
    at_once = flight(4.0)
    monkeypatch.setattr(mixture.JointMixture, "_of_one_kind", lambda *_: [])
    alone = flight(4.0)
    for id, named in alone.named.items():
        assert at_once.named[id].p == pytest.approx(named.p, abs=1e-6)
    assert at_once.mixture.weight == pytest.approx(alone.mixture.weight, abs=1e-6)


def test_most_pairs_sleep_once_names_are_sure(slept):
    assert asleep(slept) > 0.5 * MATES * SEEN


def test_names_are_those_of_a_posterior_that_looks_at_all_pairs(slept, monkeypatch):
    monkeypatch.setattr(mixture, "LOG_PAIR_SLEEPS", -np.inf)
    awake = flight(14.0)
    assert asleep(awake) == 0
    for id, named in awake.named.items():
        assert named.likeliest[0] == id
        assert slept.named[id].p == pytest.approx(named.p, abs=0.01)
        assert slept.named[id].p_none == pytest.approx(named.p_none, abs=0.01)
        assert slept.named[id].by_motion[id] == pytest.approx(named.by_motion[id], abs=0.05)


def test_a_teammate_near_a_track_is_compared_with_it_though_it_slept(slept):
    """All others are compared every four seconds."""
    for id, track in slept._tracks.items():
        away = [start(drone) @ start(id) / 144.0 for drone in slept.teammates]
        apart = np.degrees(np.arccos(np.clip(away, -1.0, 1.0)))
        columns = np.array([mate.column for mate in slept.teammates.values()])
        age = 14.0 - track.last_compared(columns)[0]
        assert age[apart < 8.0].max() < 1.5
        assert age[apart > 20.0].min() > 1.5


def test_whoever_takes_over_a_track_is_found_though_it_slept(slept):
    assert np.isfinite(slept._tracks[2].faint[slept.teammates[2 + SEEN].column])
    changed = flight(26.0, handed_over=14.0)
    assert changed.named[2].likeliest[0] == 2 + SEEN
    assert changed.named[3].likeliest[0] == 3


def test_a_new_life_of_a_teammate_wakes_it(slept):
    column = slept.teammates[2 + SEEN].column
    for track in slept._tracks.values():
        track.forget(column)
        assert np.isnan(track.faint[column])


def test_where_few_of_many_are_in_view_most_pairs_sleep_as_well(monkeypatch):
    monkeypatch.setitem(globals(), "SEEN", 7)
    few = flight(10.0)
    assert asleep(few) > 0.5 * MATES * SEEN
    assert [few.named[id].likeliest[0] for id in range(2, 2 + SEEN)] == list(range(2, 2 + SEEN))


def test_while_nothing_is_in_view_nothing_is_compared(monkeypatch):
    monkeypatch.setitem(globals(), "SEEN", 0)
    assert flight(3.0).named == {}


def test_in_a_small_team_nothing_sleeps(monkeypatch):
    monkeypatch.setitem(globals(), "SEEN", 7)
    monkeypatch.setitem(globals(), "IDS", range(2, 2 + SMALL_TEAM))
    small = flight(6.0)
    assert asleep(small) == 0
    assert small.mixture.looks_at_all
