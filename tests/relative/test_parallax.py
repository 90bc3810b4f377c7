"""What looks like a near drone and stands far off. Worlds are made by hand: rays and widths, with their noise."""

import math
from dataclasses import replace

import numpy as np
import pytest

from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parallax import FarOff
from swarmtrack.relative.priors import PARALLAX_REACH_M

FPS, SIGMA, WHITE = 20.0 / 3.0, 0.008, 0.1
DRONE_M = 0.57
TRACK = 5
SWAYS_M = 0.05


def sway(seed, rms=SWAYS_M):
    """As a drone that holds its place."""
    chance = np.random.default_rng(seed)
    rates, phases = chance.uniform(0.3, 3.0, (6, 3)), chance.uniform(0.0, 2.0 * math.pi, (6, 3))
    return lambda t: rms * math.sqrt(2.0 / 6.0) * np.sin(rates * t + phases).sum(axis=0)


def to_and_fro(t):
    """A follower's way about its slot, and in the square by which its leader is known."""
    return np.array([1.2 * math.sin(0.7 * t), 1.2 * math.cos(0.5 * t), 0.0])


def straight_on(t):
    return np.array([1.5 * t, 0.0, 0.0])


def still(t):
    return np.zeros(3)


def seen(t, here, there, width_m, chance, track=TRACK):
    r = there - here
    distance = np.linalg.norm(r)
    ray = r / distance + SIGMA * chance.standard_normal(3)
    ray /= np.linalg.norm(ray)
    cov = SIGMA**2 * (np.eye(3) - np.outer(ray, ray))
    width = width_m / distance * math.exp(WHITE * chance.standard_normal())
    return TeamLook(t, here, np.zeros(3), ((0, track),), ray[None], cov[None], np.array([width]), np.ones(1))


def nobody(t, here):
    return TeamLook(t, here, np.zeros(3), (), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0), np.empty(0))


def watched(far, own, other, width_m, seconds, *, begins=0.0, seed=0, track=TRACK, sways=SWAYS_M):
    """Both sway, unless it is a ghost. By look: its time, its true distance, and whether it was far off then."""
    chance, mine, its = np.random.default_rng(seed), sway(2 * seed), sway(2 * seed + 1, sways)
    told = []
    for k in range(round(seconds * FPS)):
        t = begins + k / FPS
        here, there = own(t) + mine(t), other(t) + its(t)
        far.observe(seen(t, here, there, width_m, chance, track))
        told.append((t, float(np.linalg.norm(there - here)), track in far.tracks))
    return told


def hovers_near(t):
    return np.array([6.0, 1.0, 0.0])


def house(distance, aside=3.0):
    """Something of that size, m, so far north, that looks like a drone at 5 m; and where it is."""
    return DRONE_M * distance / 5.0, lambda t: np.array([distance, aside, 3.0])


@pytest.mark.parametrize("distance", [14.0, 20.0, 40.0])
@pytest.mark.parametrize("seed", range(5))
def test_what_looks_near_and_is_not_is_found_out_by_whoever_flies_to_and_fro(distance, seed):
    width, where = house(distance)
    told = watched(FarOff(), to_and_fro, where, width, 25.0, seed=seed, sways=0.0)
    assert all(far for t, _, far in told if t > 15.0)


@pytest.mark.parametrize("own", [to_and_fro, straight_on, still])
@pytest.mark.parametrize("seed", range(5))
def test_a_drone_that_hovers_near_is_near(own, seed):
    told = watched(FarOff(), own, hovers_near, DRONE_M, 4.0, seed=seed)
    told += watched(FarOff(), to_and_fro, hovers_near, DRONE_M, 30.0, seed=seed)
    assert not any(far for *_, far in told)


@pytest.mark.parametrize("sways", [0.0, 0.03, 0.2])
@pytest.mark.parametrize("seed", range(5))
def test_a_drone_that_flies_along_straight_on_could_be_near(sways, seed):
    """From it alone the same is seen as of a house: its ray stands still."""
    told = watched(
        FarOff(),
        straight_on,
        lambda t: np.add(straight_on(t), (4.0, 3.0, 0.0)),
        DRONE_M,
        30.0,
        seed=seed,
        sways=sways,
    )
    assert not any(far for *_, far in told)


@pytest.mark.parametrize("seed", range(5))
def test_a_drone_that_is_always_as_far_behind_a_retreat_could_be_near(seed):
    def chased(t):
        return np.array([-t, 0.0, 0.0])

    told = watched(FarOff(), chased, lambda t: np.add(chased(t), (5.0, 0.5, 0.0)), DRONE_M, 40.0, seed=seed)
    assert not any(far for *_, far in told)


@pytest.mark.parametrize("seed", range(5))
def test_a_drone_that_hovered_far_off_and_then_comes_is_far_no_more_before_it_matters(seed):
    def comes(t):
        return np.array([14.0 - 2.0 * max(t - 20.0, 0.0), 3.0, 0.0])

    told = watched(FarOff(), to_and_fro, comes, DRONE_M, 26.0, seed=seed)
    assert any(far for t, _, far in told if t < 20.0)
    assert min(distance for _, distance, far in told if far) > PARALLAX_REACH_M


def test_who_hovers_tells_nothing_from_it():
    width, where = house(30.0)
    assert not any(far for *_, far in watched(FarOff(), still, where, width, 30.0, sways=0.0))


def test_a_track_that_begins_where_a_house_is_known_to_be_is_that_house():
    width, where = house(30.0)
    far = FarOff()
    watched(far, to_and_fro, where, width, 20.0, sways=0.0)
    far.observe(nobody(20.0, to_and_fro(20.0)))
    assert far.tracks == frozenset()
    told = watched(far, to_and_fro, where, width, 1.0, begins=21.0, track=9, sways=0.0)
    assert all(is_far for *_, is_far in told)


@pytest.mark.parametrize("seed", range(5))
def test_a_house_that_is_lost_every_second_is_found_out_all_the_same(seed):
    width, where = house(30.0)
    far, told = FarOff(), []
    for k in range(25):
        told += watched(far, to_and_fro, where, width, 0.8, begins=float(k), seed=seed, track=k, sways=0.0)
        far.observe(nobody(k + 0.8, to_and_fro(k + 0.8)))
    assert sum(is_far for t, _, is_far in told if t > 15.0) > 0.8 * sum(t > 15.0 for t, *_ in told)


@pytest.mark.parametrize("seed", range(5))
def test_a_near_drone_that_is_lost_every_second_is_near(seed):
    far, told = FarOff(), []
    for k in range(25):
        told += watched(far, to_and_fro, hovers_near, DRONE_M, 0.8, begins=float(k), seed=seed, track=k)
        far.observe(nobody(k + 0.8, to_and_fro(k + 0.8)))
    assert not any(is_far for *_, is_far in told)


def test_a_track_that_begins_beside_a_known_house_or_is_larger_is_not_that_house():
    width, where = house(30.0)
    for other, size in (
        (lambda t: np.add(where(t), (0.0, 3.0, 0.0)), width),
        (where, 1.5 * width),
    ):
        far = FarOff()
        watched(far, to_and_fro, where, width, 20.0, sways=0.0)
        far.observe(nobody(20.0, to_and_fro(20.0)))
        told = watched(far, to_and_fro, other, size, 1.0, begins=20.3, track=9, sways=0.0)
        assert not any(is_far for *_, is_far in told)


@pytest.mark.parametrize("leap", [2.0, 10.0])
def test_a_leap_of_the_own_place_that_was_not_flown_makes_nobody_far(leap):
    """A GPS glitch: by what it believes the drone went aside, and somebody near was seen on the same ray all along."""
    chance, mine = np.random.default_rng(1), sway(3)
    far = FarOff()
    for k in range(round(20.0 * FPS)):
        t = k / FPS
        here = np.add(mine(t), (0.0, leap * (5.0 < t < 10.0), 0.0))
        truly_seen = seen(t, mine(t), np.array([5.0, 0.5, 0.0]), DRONE_M, chance)
        far.observe(replace(truly_seen, camera=here))
        assert far.tracks == frozenset()


@pytest.mark.parametrize("late", [0.0, 0.08, 0.2])
def test_a_house_stays_far_off_where_another_camera_is_late(late):
    """Its looks come after those that were exposed later, and show the same tracks, but do not detect them."""
    width, where = house(30.0)
    far, chance = FarOff(), np.random.default_rng(0)
    told = []
    for k in range(160):
        t = k / FPS
        far.observe(seen(t, to_and_fro(t), where(t), width, chance))
        told.append(TRACK in far.tracks)
        beside = to_and_fro(t - late) + np.array([0.1, 0.1, 0.0])
        back = seen(t - late, beside, where(t), width, chance)
        unseen = np.full_like(back.ray, np.nan)
        far.observe(replace(back, ray=unseen, ray_cov=np.full((1, 3, 3), np.nan), width=unseen[:, 0]))
    assert all(told[100:])


@pytest.mark.parametrize("seed", range(3))
def test_a_house_that_goes_to_a_late_camera_and_back_stays_far_off(seed):
    width, where = house(30.0)
    far, chance = FarOff(), np.random.default_rng(seed)
    told = []
    for k in range(240):
        t = k / FPS - (0.2 if k % 2 else 0.0)
        far.observe(seen(t, to_and_fro(t), where(t), width, chance))
        told.append(TRACK in far.tracks)
    assert all(told[120:])


def test_what_is_not_detected_for_a_while_stays_what_it_was():
    width, where = house(30.0)
    far = FarOff()
    watched(far, to_and_fro, where, width, 20.0, sways=0.0)
    here = to_and_fro(20.1)
    look = seen(20.1, here, where(0.0), width, np.random.default_rng(0))
    unseen = TeamLook(
        look.t, here, look.velocity, look.keys, np.full((1, 3), np.nan), look.ray_cov, look.width, look.gain
    )
    far.observe(unseen)
    assert far.tracks == {TRACK}


def test_a_look_without_some_tracks_is_that_of_the_others():
    chance = np.random.default_rng(0)
    one, other = (seen(0.0, np.zeros(3), np.array([9.0, k, 0.0]), DRONE_M, chance, track=k) for k in (1, 2))
    both = TeamLook(
        0.0,
        np.zeros(3),
        np.zeros(3),
        one.keys + other.keys,
        *(
            np.concatenate([getattr(one, name), getattr(other, name)])
            for name in ("ray", "ray_cov", "width", "gain")
        ),
    )
    left = both.without({1})
    assert left.keys == other.keys
    assert (left.ray == other.ray).all()
    assert (left.width == other.width).all()
    assert both.without({7}) is both
