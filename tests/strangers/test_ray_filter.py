"""Strangers by the rays of several observers, against simulated truth and against a solver that shares no code."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from support.stranger_world import ERRORS, SCAN_S, SIGMA, World
from swarmtrack.strangers.ray_filter import RayFilter

NUMBER = 101


def flown(seed, observers=3, seconds=10.0, sees=None):
    """The filter at the end of a flight, its squared errors over time, and the world."""
    world, known, nees = World(seed, observers), RayFilter(), []
    for k in range(int(seconds / SCAN_S)):
        t = k * SCAN_S
        for i in sees or range(observers):
            if not known.numbers:
                known.begin(NUMBER, world.ray(i, t))
            elif world.rng.random() < 0.8:
                known.fold(NUMBER, world.ray(i, t))
        if k % 7 == 0:
            calibrate(known, world, t)
        if t > 1.0:
            at = known.place(NUMBER, t)
            off = np.append(at.position - world.place, at.velocity - world.velocity)
            nees.append(
                (
                    off[:3] @ np.linalg.solve(at.cov[:3, :3], off[:3]) / 3.0,
                    off @ np.linalg.solve(at.cov, off) / 6.0,
                )
            )
        world.fly()
    return known, np.array(nees), world


def calibrate(known, world, t):
    n = len(world.camera)
    for i in range(n):
        for j in range(n):
            if i != j:
                sigma = math.hypot(SIGMA, 0.1 / np.linalg.norm(world.camera[i] - world.camera[j]))
                there = world.camera[j] + world.off[j]
                known.calibrate(world.ray(i, t, there, sigma), j, world.camera[j], ERRORS)


def test_three_observers_are_as_sure_as_they_are_right():
    nees = np.concatenate([flown(seed)[1] for seed in range(24)])
    assert 0.5 < np.median(nees[:, 0]) < 1.1
    assert 0.8 < nees[:, 1].mean() < 1.25


def test_one_observers_guess_is_wide_and_honest():
    nees = [flown(seed, observers=1, seconds=6.0)[1] for seed in range(24)]
    assert 0.3 < np.median(np.concatenate(nees)[:, 0]) < 1.2
    known, _, world = flown(3, observers=1, seconds=3.0)
    at = known.place(NUMBER, known.t)
    spread = math.sqrt(np.linalg.eigvalsh(at.cov[:3, :3])[-1])
    assert spread > 0.3 * np.linalg.norm(at.position - world.camera[0])


def test_a_second_observer_makes_the_guess_a_place():
    alone, _, _ = flown(5, observers=2, seconds=3.0, sees=[0])
    both, _, world = flown(5, observers=2, seconds=3.0)
    spread = [np.sqrt(np.trace(one.place(NUMBER, one.t).cov[:3, :3])) for one in (alone, both)]
    assert spread[1] < 0.25 * spread[0]
    assert np.linalg.norm(both.place(NUMBER, both.t).position - world.place) < 2.0


@pytest.mark.parametrize("seed", range(6))
def test_of_a_stranger_that_stands_it_finds_what_least_squares_find(seed):
    """One ray of each observer at one time, and nothing before: the mode is the minimum of the same cost."""
    world = World(seed)
    rays = [world.ray(i, 0.0)._replace(range_ln=math.nan) for i in range(3)]
    known = RayFilter()
    known.begin(NUMBER, rays[0])
    assert all(known.fold(NUMBER, ray) for ray in rays[1:])
    sigmas = np.concatenate([[e.tilt, e.tilt, e.heading, *[e.place] * 3] for e in [ERRORS] * 3])

    def cost(x):
        parts = [x[3:] / sigmas, [math.log(np.linalg.norm(x[:3] - rays[0].camera - x[6:9]) / 12.0) / 0.8]]
        for i, ray in enumerate(rays):
            turn, off = x[3 + 6 * i : 6 + 6 * i], x[6 + 6 * i : 9 + 6 * i]
            u = x[:3] - ray.camera - off
            u = u / np.linalg.norm(u)
            expected = u - np.cross(turn, u)
            parts.append((expected - (expected @ ray.direction) * ray.direction) / SIGMA)
        return np.concatenate(parts)

    start = np.concatenate([rays[0].camera + 12.0 * rays[0].direction, np.zeros(18)])
    solved = least_squares(cost, start, xtol=1e-12, ftol=1e-12)
    at = known.place(NUMBER, 0.0)
    off = at.position - solved.x[:3]
    # Rays one after another, each linearised where the ones before have led: within a third of a sigma.
    assert math.sqrt(off @ np.linalg.solve(at.cov[:3, :3], off)) < 0.35


def test_a_ray_to_another_target_is_refused_and_changes_nothing():
    known, _, world = flown(1)
    before = known.place(NUMBER, known.t)
    elsewhere = world.place + np.array([0.0, 0.0, 6.0])
    assert not known.fold(NUMBER, world.ray(1, known.t, elsewhere))
    after = known.place(NUMBER, known.t)
    assert np.array_equal(before.position, after.position)
    assert np.array_equal(before.cov, after.cov)


def test_late_rays_count_for_their_own_time():
    """Two of three observers are heard 0.3 s late, of a stranger at 4 m/s: 1.2 m by which they would drag it behind."""
    nees, along = [], []
    for seed in range(12):
        world, known, late = World(seed), RayFilter(), []
        world.velocity = np.array([4.0, 0.0, 0.0])
        for k in range(40):
            t = k * SCAN_S
            if not known.numbers:
                known.begin(NUMBER, world.ray(0, t))
            else:
                known.fold(NUMBER, world.ray(0, t))
            late += [world.ray(i, t) for i in (1, 2)]
            while late[0].t < t - 0.3:
                known.fold(NUMBER, late.pop(0))
            world.place = world.place + SCAN_S * world.velocity
        at = known.place(NUMBER, known.t)
        off = at.position - (world.place - SCAN_S * world.velocity)
        nees.append(off @ np.linalg.solve(at.cov[:3, :3], off) / 3.0)
        along.append(off[0])
    assert np.mean(nees) < 2.0
    assert abs(np.mean(along)) < 0.5


def test_an_observer_that_is_forgotten_takes_its_strangers_along():
    known, _, world = flown(4)
    known.forget(1)
    assert known.observers == (0, 2)
    assert known.numbers == (NUMBER,)
    known.forget(0)
    assert known.numbers == ()
    known.begin(NUMBER, world.ray(2, known.t))
    assert known.numbers == (NUMBER,)
