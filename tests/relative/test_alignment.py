"""How two frames stand to each other: exact without noise, honest with it, and silent where nobody moved."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from swarmtrack.geometry import rotation
from swarmtrack.relative.alignment import FrameSight, SightErrors, align
from swarmtrack.relative.log_range import across

ERRORS = SightErrors(ray=4.3e-3, place=0.03, size=0.11, lasting=0.1, drift=0.02, turn_drift=0.002)
EXACT = SightErrors(ray=1e-5, place=1e-3, size=0.01, lasting=0.1, drift=0.0, turn_drift=0.0)
HERE, THERE = np.zeros(3), np.array([6.0, 2.0, -1.0])


def circle(centre, t, phase=0.0):
    return centre + np.array(
        [1.5 * math.cos(0.6 * t + phase), 1.5 * math.sin(0.6 * t + phase), 0.3 * math.sin(0.5 * t + phase)]
    )


MOTIONS = {
    "it circles": lambda t: (HERE, circle(THERE, t, 1.0)),
    "both circle": lambda t: (circle(HERE, t), circle(THERE, t, 2.0)),
    "it flies across": lambda t: (HERE, THERE + np.array([0.1, 0.6, 0.0]) * t),
    "both still": lambda t: (HERE, THERE),
    "only we circle": lambda t: (circle(HERE, t), THERE),
    "formation": lambda t: (np.array([0.8, 0.0, 0.0]) * t, THERE + np.array([0.8, 0.0, 0.0]) * t),
    "it flies along the ray": lambda t: (HERE, THERE * (1.0 + 0.05 * t)),
}


class Pair:
    """Two drones whose frames drift: what one sees and the other says, twice a second."""

    def __init__(self, motion, seed, *, noise=1.0, mutual=False):
        self.rng = np.random.default_rng(seed)
        self.motion, self.noise, self.mutual = MOTIONS[motion], noise, mutual
        self.shift, self.turn = self.rng.uniform(-5.0, 5.0, 3), self.rng.uniform(-math.pi, math.pi)
        self.bias = 0.1 * noise * self.rng.normal()
        self.sights = []

    def see(self, seconds):
        rng, noise = self.rng, self.noise
        for t in np.arange(0.0, seconds + 0.01, 0.5):
            self.shift = self.shift + noise * 0.02 * math.sqrt(0.5) * rng.normal(size=3)
            self.turn += noise * 0.002 * math.sqrt(0.5) * rng.normal()
            eye, place = self.motion(t)
            back = rotation.from_euler(0.0, 0.0, self.turn).T
            away = place - eye
            rho = np.linalg.norm(away)
            d = away / rho
            ray = d + across(d[None])[0] @ (4.3e-3 * noise * rng.normal(size=2))
            ray /= np.linalg.norm(ray)
            seen_back = back @ -d + 4.3e-3 * noise * rng.normal(size=3) if self.mutual else None
            log_range = math.log(rho) + self.bias + 0.11 * noise * rng.normal()
            self.said, self.place = back @ (place - self.shift), place
            self.sights.append(FrameSight(t, eye, self.said, ray, log_range, seen_back))
        return self

    def error(self, found):
        turn = math.remainder(found.turn - self.turn, 2.0 * math.pi)
        return np.append(found.shift - self.shift, turn)


@pytest.mark.parametrize("motion", ["it circles", "both circle", "it flies across"])
@pytest.mark.parametrize("mutual", [False, True])
def test_without_noise_the_frames_are_found_exactly_from_any_turn(motion, mutual):
    for seed in range(6):
        pair = Pair(motion, seed, noise=0.0, mutual=mutual).see(10.0)
        found = align(pair.sights, 10.0, EXACT)
        assert pair.error(found) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("motion", ["both still", "only we circle", "formation", "it flies along the ray"])
def test_where_the_teammate_does_not_move_across_nothing_is_stated(motion):
    for seed in range(5):
        pair = Pair(motion, seed).see(20.0)
        assert align(pair.sights, 20.0, ERRORS) is None


@pytest.mark.parametrize("motion", ["it circles", "both circle"])
def test_after_ten_seconds_it_is_known_within_15_cm_and_a_degree(motion):
    place, turn, nees = [], [], []
    for seed in range(24):
        pair = Pair(motion, seed).see(10.0)
        found = align(pair.sights, 10.0, ERRORS)
        where, _ = found.place(pair.said)
        place.append(np.linalg.norm(where - pair.place))
        error = pair.error(found)
        turn.append(abs(math.degrees(error[3])))
        nees.append(error @ np.linalg.solve(found.cov, error) / 4.0)
    assert np.median(place) < 0.15
    assert np.median(turn) < 1.0
    assert 0.2 < np.mean(nees) < 1.5


def test_it_is_the_least_squares_that_an_iterative_solver_finds():
    """The same residuals to SciPy, from the truth; at small noise, where what is taken off for bias is nothing."""
    errors = ERRORS._replace(ray=5e-4, drift=0.0, turn_drift=0.0)
    pair = Pair("it circles", 3, noise=0.1).see(12.0)
    found = align(pair.sights, 12.0, errors)

    def misses(x):
        turned = rotation.from_euler(0.0, 0.0, x[3])
        out = [x[4] / errors.lasting]
        for sight in pair.sights:
            rho, weight = math.exp(sight.log_range), math.exp((sight.t - 12.0) / 60.0)
            q = turned @ sight.said + x[:3] - sight.eye
            E = across(sight.ray[None])[0]
            out += (weight * E.T @ q / math.hypot(errors.ray * rho, errors.place)).tolist()
            along = sight.ray @ q - rho * (1.0 + x[4])
            out.append(weight * along / math.hypot(errors.size * rho, errors.place))
        return np.array(out)

    solved = least_squares(misses, np.array([*pair.shift, pair.turn, 0.0])).x
    assert found.shift == pytest.approx(solved[:3], abs=2e-3)
    assert math.remainder(found.turn - solved[3], 2.0 * math.pi) == pytest.approx(0.0, abs=5e-4)


def test_being_seen_back_tells_the_turn_sooner():
    def turn_error(mutual):
        off = []
        for seed in range(12):
            pair = Pair("it circles", seed, mutual=mutual).see(5.0)
            off.append(abs(pair.error(align(pair.sights, 5.0, ERRORS))[3]))
        return np.median(off)

    assert turn_error(True) < 0.5 * turn_error(False)


def test_a_few_sightings_are_none():
    pair = Pair("it circles", 1).see(2.0)
    assert align(pair.sights, 2.0, ERRORS) is None
    assert align([], 0.0, ERRORS) is None
