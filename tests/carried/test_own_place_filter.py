"""The own place by teammates: consistent against a simulated truth, and equal to a least squares of another make."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from swarmtrack.carried.filter import (
    AUTOPILOT_OFFSET,
    OWN_PLACE,
    OWN_TURN,
    Moments,
    OwnPlaceFilter,
    OwnRay,
    TheirRay,
)
from swarmtrack.carried.priors import TEAMMATE_TILT_SIGMA_RAD, TEAMMATE_TURN_SIGMA_RAD
from swarmtrack.messages import Array
from swarmtrack.relative.log_range import SizeErrors

EYE = np.eye(3)
ANCHORS = {1: np.array([8.0, -4.0, -5.0]), 2: np.array([9.0, 3.0, -6.0]), 3: np.array([-7.0, 5.0, -4.5])}
PLACE_SIGMA_M, TURN_SIGMA_RAD, WIDTH_SIGMA = 0.15, math.radians(1.5), 0.15
RAY_SIGMA_RAD, RANGE_SIGMA = 0.005, 0.1
WANDER = SizeErrors(0.12, 2.0)
PERIOD_S = 0.25
TILT_SIGMA_RAD = TEAMMATE_TILT_SIGMA_RAD


class Truth:
    """One drone sways; its teammates hover. All lasting errors are drawn as large as the filter takes them to be."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        draw = self.rng.standard_normal
        self.turn = draw(3) * [TILT_SIGMA_RAD, TILT_SIGMA_RAD, TURN_SIGMA_RAD]
        self.offset = PLACE_SIGMA_M * draw(3)
        self.off = {d: PLACE_SIGMA_M * draw(3) for d in ANCHORS}
        self.turns = {d: draw(3) * [TILT_SIGMA_RAD, TILT_SIGMA_RAD, TEAMMATE_TURN_SIGMA_RAD] for d in ANCHORS}
        self.width = {d: WIDTH_SIGMA * draw() for d in ANCHORS}
        self.wander = {d: (0.0, WANDER.wandering * draw()) for d in ANCHORS}
        self.phase = self.rng.uniform(0.0, 6.28, 3)

    def place(self, t: float) -> Array:
        return np.sin(2.0 * math.pi * np.array([0.07, 0.09, 0.05]) * t + self.phase) * [1.2, 1.2, 0.3]

    def ray(self, d: int, t: float) -> OwnRay:
        q = ANCHORS[d] - self.place(t)
        r = float(np.linalg.norm(q))
        u = q / r
        stated = _unit(u - np.cross(self.turn, u) + RAY_SIGMA_RAD * self.rng.standard_normal(3))
        width = self.width[d] + self.wander_at(d, t)
        log_range = math.log(r) + width + RANGE_SIGMA * self.rng.standard_normal()
        cov = RAY_SIGMA_RAD**2 * EYE
        said = ANCHORS[d] + self.off[d]
        return OwnRay(said, 1e-4, stated, cov, np.zeros(3), log_range, range_var=RANGE_SIGMA**2)

    def wander_at(self, d: int, t: float) -> float:
        before, error = self.wander[d]
        kept = math.exp((before - t) / WANDER.wander_s)
        error = kept * error + math.sqrt(1.0 - kept**2) * WANDER.wandering * self.rng.standard_normal()
        self.wander[d] = t, error
        return error

    def their_ray(self, d: int, t: float) -> TheirRay:
        u = _unit(self.place(t) - ANCHORS[d])
        stated = _unit(u - np.cross(self.turns[d], u) + RAY_SIGMA_RAD * self.rng.standard_normal(3))
        return TheirRay(ANCHORS[d] + self.off[d], 1e-4, stated, RAY_SIGMA_RAD, 0.0)

    def begun(self) -> OwnPlaceFilter:
        speed = (self.place(0.01) - self.place(0.0)) / 0.01
        found = OwnPlaceFilter(
            0.0,
            Moments(self.place(0.0) + self.offset, 1e-4 * EYE),
            Moments(speed, 0.1**2 * EYE),
            PLACE_SIGMA_M**2 * EYE,
            np.diag([TILT_SIGMA_RAD**2, TILT_SIGMA_RAD**2, TURN_SIGMA_RAD**2]),
            width=WANDER,
        )
        for d in ANCHORS:
            found.add_teammate(d, PLACE_SIGMA_M**2 * EYE, WIDTH_SIGMA)
        return found


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v))


def flown(truth: Truth, seconds: float, *, placed_s: float, by: tuple[int, ...]) -> OwnPlaceFilter:
    """placed_s: how long the autopilot states a position."""
    found = truth.begun()
    for k in range(1, round(seconds / PERIOD_S)):
        t = k * PERIOD_S
        found.predict(t)
        if t < placed_s:
            noise = 0.04 * truth.rng.standard_normal(3)
            assert found.hear_autopilot(truth.place(t) + truth.offset + noise, 0.04**2)
        for d in by:
            found.see(d, truth.ray(d, t))
            if k % 4 == 0:
                found.hear_ray(d, truth.their_ray(d, t), 0.0)
    return found


@pytest.mark.parametrize("by", [(1, 2, 3), (1, 2), (1,)])
def test_place_and_heading_are_as_uncertain_as_stated(by: tuple[int, ...]) -> None:
    nees, turns, errors = [], [], []
    for seed in range(25):
        truth = Truth(seed)
        found = flown(truth, 20.0, placed_s=5.0, by=by)
        place, turn = found.moments(OWN_PLACE), found.moments(OWN_TURN)
        off = place.mean - truth.place(found.t)
        errors.append(float(np.linalg.norm(off)))
        nees.append(float(off @ np.linalg.solve(place.cov, off)) / 3.0)
        turns.append((turn.mean[2] - truth.turn[2]) ** 2 / turn.cov[2, 2])
    # The own velocity wanders less here than the filter allows for. 25 draws of χ²/3: 99.9 % are below 1.6.
    assert 0.25 < np.mean(nees) < 1.6
    assert np.mean(turns) < 2.0
    assert np.median(errors) < (0.4 if len(by) > 1 else 1.5)


def test_a_static_geometry_is_found_as_by_least_squares() -> None:
    """SciPy's least squares of all rays and priors at once."""
    truth = Truth(1)
    truth.place = lambda t: np.zeros(3)  # type: ignore[method-assign]
    rays = {d: truth.ray(d, 0.0) for d in ANCHORS}
    found = OwnPlaceFilter(
        0.0,
        Moments(np.array([0.12, -0.08, 0.05]), 0.04 * EYE),
        Moments(np.zeros(3), EYE),
        1e-8 * EYE,
        1e-4 * EYE,
        width=SizeErrors(0.0, 1.0),
    )
    for d in ANCHORS:
        found.add_teammate(d, PLACE_SIGMA_M**2 * EYE, WIDTH_SIGMA)
    for d, ray in rays.items():
        assert found.see(d, ray)

    def residuals(x: Array) -> Array:
        p, turn, rows = x[:3], x[3:6], []
        for k, (_, ray) in enumerate(rays.items()):
            f, s = x[6 + 4 * k : 9 + 4 * k], x[9 + 4 * k]
            q = ray.said - f - p
            r = np.linalg.norm(q)
            sigma = math.sqrt(RAY_SIGMA_RAD**2 + ray.said_var / r**2)
            left = (ray.direction + np.cross(turn, ray.direction) - q / r) / sigma
            left -= (left @ ray.direction) * ray.direction
            along = math.sqrt(RANGE_SIGMA**2 + ray.said_var / r**2)
            rows += [*left, (ray.log_range - math.log(r) - s) / along, *(f / PLACE_SIGMA_M), s / WIDTH_SIGMA]
        return np.array([*((p - [0.12, -0.08, 0.05]) / 0.2), *(turn / 0.01), *rows])

    best = least_squares(residuals, np.zeros(6 + 4 * len(rays)))
    cov = np.linalg.inv(best.jac.T @ best.jac)[:3, :3]
    place = found.moments(OWN_PLACE)
    sigma = np.sqrt(np.diagonal(cov))
    assert (np.abs(place.mean - best.x[:3]) < 0.25 * sigma).all()
    assert np.sqrt(np.diagonal(place.cov)) == pytest.approx(sigma, rel=0.1)


def test_an_autopilot_that_drifts_is_found_out_by_its_teammates() -> None:
    truth = Truth(3)
    found = flown(truth, 8.0, placed_s=8.0, by=(1, 2, 3))
    assert found.weights[0] > 0.95
    begin = found.t
    while found.t < begin + 4.0:
        t = found.t + PERIOD_S
        found.predict(t)
        found.hear_autopilot(truth.place(t) + truth.offset + [0.5 * (t - begin), 0.0, 0.0], 0.04**2)
        for d in ANCHORS:
            found.see(d, truth.ray(d, t))
        if found.weights[1] > 0.5:
            break
    assert found.weights[1] > 0.5
    assert found.t - begin < 2.0
    assert found.moments(AUTOPILOT_OFFSET).mean[0] - truth.offset[0] > 0.2


def test_a_teammate_that_leaves_its_stated_place_is_not_followed() -> None:
    truth = Truth(4)
    found = flown(truth, 8.0, placed_s=8.0, by=(1, 2, 3))
    begin = found.t
    while found.t < begin + 8.0:
        t = found.t + PERIOD_S
        found.predict(t)
        for d in ANCHORS:
            ray = truth.ray(d, t)
            lie = np.array([0.0, 0.6 * (t - begin), 0.0]) if d == 2 else np.zeros(3)
            found.see(d, ray._replace(said=ray.said + lie))
    place = found.moments(OWN_PLACE)
    off = place.mean - truth.place(found.t)
    assert float(np.linalg.norm(off)) < 1.2
    assert float(off @ np.linalg.solve(place.cov, off)) < 21.0


def test_a_teammate_whose_rays_are_late_makes_no_drift_of_a_climb() -> None:
    worst = []
    for seed in range(8):
        truth = Truth(seed)
        truth.place = lambda t: np.array([0.0, 0.0, -2.0 * max(t - 5.0, 0.0)])  # type: ignore[method-assign]
        found, suspected = flown(truth, 5.0, placed_s=5.0, by=(1,)), 0.0
        for _ in range(16):
            t = found.t + PERIOD_S
            found.predict(t)
            found.hear_autopilot(truth.place(t) + truth.offset, 0.04**2)
            found.see(1, truth.ray(1, t))
            found.hear_ray(1, truth.their_ray(1, t - 0.25), 0.0)
            suspected = max(suspected, float(found.weights[1]))
        worst.append(suspected)
    assert np.median(worst) < 0.2  # 0.99 if rays were taken to be of their time


def test_with_nobody_the_place_grows_vaguer_as_it_flies() -> None:
    found = flown(Truth(5), 5.0, placed_s=5.0, by=(1, 2, 3))
    sigmas = []
    for _ in range(40):
        found.predict(found.t + 1.0)
        sigmas.append(math.sqrt(found.moments(OWN_PLACE).cov[0, 0]))
    assert (np.diff(sigmas) > 0.0).all()
    assert sigmas[-1] > 10.0


@pytest.mark.parametrize(
    ("alone_s", "by_one_m", "by_two_m"), [(5.0, 3.0, 1.5), (15.0, 4.0, 1.5), (60.0, 7.0, 5.0)]
)
def test_a_place_that_has_become_vague_is_found_again_by_rays_and_a_width(
    alone_s: float, by_one_m: float, by_two_m: float
) -> None:
    """After a minute, either teammate may have drifted off."""
    squares = []
    for seed in range(25):
        truth = Truth(seed)
        found = flown(truth, 5.0, placed_s=5.0, by=(1, 2, 3))
        found.predict(found.t + alone_s)
        assert found.see(1, truth.ray(1, found.t))
        place = found.moments(OWN_PLACE)
        off = place.mean - truth.place(found.t)
        squares.append(float(off @ np.linalg.solve(place.cov, off)) / 3.0)
        assert math.sqrt(np.trace(place.cov)) < by_one_m
        # A teammate's ray to us, and its own place; no width.
        assert found.hear_ray(3, truth.their_ray(3, found.t), 0.0)
        assert math.sqrt(np.trace(found.moments(OWN_PLACE).cov)) < by_two_m
    assert np.mean(squares) < 1.6


def test_without_one_of_its_teammates_the_place_stays_as_it_was() -> None:
    found = flown(Truth(3), 10.0, placed_s=5.0, by=(1, 2, 3))
    before, weight = found.moments(slice(0, 12)), found.weights.copy()
    found.remove_teammate(2)
    after = found.moments(slice(0, 12))
    assert list(found) == [1, 3]
    assert after.mean == pytest.approx(before.mean, abs=1e-12)
    assert after.cov == pytest.approx(before.cov, abs=1e-12)
    assert found.weights == pytest.approx([weight[0] + weight[3], weight[1], weight[2], weight[4]])
    truth = Truth(3)
    assert found.see(3, truth.ray(3, found.t))
    found.add_teammate(2, 0.04 * np.eye(3), 0.2)
    assert found.see(2, truth.ray(2, found.t))
