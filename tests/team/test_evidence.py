"""The closed form of the evidence beside the same integral by SciPy, drawn and not solved."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from swarmtrack.geometry import rotation
from swarmtrack.team.evidence import (
    AS_STATED,
    DOUBTED,
    Marginal,
    PriorsOfMany,
    TeammatePrior,
    design,
    log_evidence_of_nothing,
    turned_back,
)
from swarmtrack.team.own_errors import OwnErrors, PathTurn
from swarmtrack.team.priors import (
    P_TEAMMATE_HEADING_OFF,
    P_TEAMMATE_START_OFF,
    TEAMMATE_HEADING_SIGMA_RAD,
)

OWN, MATE = 1, 2
PADS = {OWN: np.array([0.0, 0.0, -2.0]), MATE: np.array([6.0, 1.0, -2.0]), 3: np.array([5.0, -4.0, -2.0])}
ERRORS = OwnErrors(OWN, PADS)
SPREADS = np.unique(ERRORS.spread)
COV = 0.1**2 * np.eye(3)
SIGMA_M = 0.15


def index(**wanted):
    """Of the first component that is like that."""
    return next(
        k
        for k, c in enumerate(ERRORS.components)
        if all(getattr(c, name) == pytest.approx(value) for name, value in wanted.items() if name != "pads")
        and wanted.get("pads", c.pads) == c.pads
    )


def bearings(chance, count=5, heading=0.0):
    """Where MATE is by its own word (from its start), the own way, and the direction in which it is seen by a drone
    whose compass is off by heading [rad]."""
    found = []
    for _ in range(count):
        place, way = chance.normal(0.0, 1.0, 3), chance.normal(0.0, 1.0, 3)
        true = PADS[MATE] + place - PADS[OWN] - way
        direction = rotation.from_euler(0.0, 0.0, -heading) @ true + chance.normal(0.0, 0.1, 3)
        found.append((place, way, direction / np.linalg.norm(direction)))
    return found


def matrix(found):
    """(8, 8): what the bearings add up to."""
    total = np.zeros((8, 8))
    for place, way, d in found:
        G = design(place[None], way)[0]
        total += G.T @ (np.eye(3) - np.outer(d, d)) @ G / SIGMA_M**2
    return total


def plane(direction):
    """(2, 3): two axes across it."""
    return np.linalg.svd(direction[None])[2][1:]


def drawn(found, k, cov, heading_sigma, chance, draws=2000):
    """log of the mean over headings of the density of the residuals across all rays, without normalisers."""
    c = ERRORS.components[k]
    sigma = heading_sigma if k == 0 else c.sigma
    apart = ERRORS.stands_at(MATE)[k] - ERRORS.stands_at(OWN)[k] - ERRORS.shift[k]
    places, ways, directions = map(np.array, zip(*found, strict=True))
    planes = np.array([plane(d) for d in directions])
    across = []
    for epsilon, delta in chance.normal(0.0, 1.0, (draws, 2)) * [sigma, TEAMMATE_HEADING_SIGMA_RAD]:
        psi = c.heading + epsilon
        theta = delta + (0.0 if c.path is PathTurn.TEAM else -psi)
        phi = -psi if c.path is PathTurn.NONE else 0.0
        q = rotation.from_euler(0.0, 0.0, -psi) @ apart
        mate, own = rotation.from_euler(0.0, 0.0, theta), rotation.from_euler(0.0, 0.0, phi)
        across.append(np.einsum("bij,bj->bi", planes, places @ mate.T - ways @ own.T + q).ravel())
    H = planes.reshape(-1, 3)
    n = 2 * len(found)
    logs = multivariate_normal.logpdf(across, np.zeros(n), H @ cov @ H.T + SIGMA_M**2 * np.eye(n))
    normalisers = -0.5 * n * math.log(2.0 * math.pi * SIGMA_M**2)
    return float(np.logaddexp.reduce(logs) - math.log(draws) - normalisers)


@pytest.mark.parametrize(
    ("wanted", "heading"),
    [
        ({"heading": 0.0, "ring": 0.0, "pads": ()}, 0.0),
        ({"heading": math.radians(30.0), "path": PathTurn.NONE, "ring": 0.0, "pads": ()}, math.radians(31.0)),
        (
            {"heading": math.radians(-12.0), "path": PathTurn.OWN, "ring": 0.0, "pads": ()},
            math.radians(-12.0),
        ),
        ({"heading": math.radians(6.0), "path": PathTurn.TEAM}, 0.0),
        ({"ring": 1.5, "loose": False}, 0.0),
        ({"pads": ((1, 2), (2, 1)), "heading": 0.0, "ring": 0.0}, 0.0),
    ],
)
def test_each_component_is_the_integral_over_starts_and_headings(wanted, heading):
    chance = np.random.default_rng(7)
    found, k, heading_sigma = bearings(chance, heading=heading), index(**wanted), math.radians(3.0)
    marginal = Marginal(matrix(found)[None], COV, SPREADS)
    prior = TeammatePrior.of(MATE, ERRORS)
    level = np.diag([1.0, 1.0, 0.2**2])
    parts = [
        math.log(p) + drawn(found, k, COV + (off**2 + ERRORS.spread[k] ** 2) * level, heading_sigma, chance)
        for p, off in zip(
            (1.0 - sum(P_TEAMMATE_START_OFF) - P_TEAMMATE_HEADING_OFF, *P_TEAMMATE_START_OFF),
            (0.0, 0.5, 2.5),
            strict=True,
        )
    ]
    log = marginal.log_evidence(PriorsOfMany.of_one(prior, 1), ERRORS, np.array([k]), heading_sigma).item()
    # A teammate whose heading is anywhere adds to the first; the angles are small, and 2000 draws are not many.
    assert log == pytest.approx(float(np.logaddexp.reduce(parts)), abs=0.35)


def test_the_right_component_explains_a_heading_that_is_off():
    found = bearings(np.random.default_rng(3), count=12, heading=math.radians(60.0))
    marginal = Marginal(matrix(found)[None], COV, SPREADS)
    used = np.arange(len(ERRORS))
    log = marginal.log_evidence(
        PriorsOfMany.of_one(TeammatePrior.of(MATE, ERRORS), 1), ERRORS, used, math.radians(3.0)
    )[0]
    best = ERRORS.components[int(log.argmax())]
    assert math.degrees(best.heading) == pytest.approx(60.0, abs=6.1)


def test_bearings_turn_along_with_a_heading_that_steps():
    step = math.radians(8.0)
    found = bearings(np.random.default_rng(5))
    forward = rotation.from_euler(0.0, 0.0, step)
    turned = [(place, way, forward @ d) for place, way, d in found]
    to_old = turned_back(step)
    # The same place, headings and starts: z in the new axes, by the bearings that were turned.
    for z in np.random.default_rng(6).normal(0.0, 1.0, (20, 8)):
        z[4] = 1.0
        old = to_old @ z
        assert z @ matrix(turned) @ z == pytest.approx(old @ matrix(found) @ old)


def test_places_and_frames_follow_what_the_teammate_says():
    found = bearings(np.random.default_rng(11), count=20)
    M = matrix(found)
    marginal = Marginal(M[None], COV, SPREADS)
    place, way = np.array([1.0, -2.0, 0.5]), np.array([-1.0, 0.5, 0.0])
    prior = TeammatePrior.of(MATE, ERRORS)
    found = marginal.solutions(M, prior, ERRORS, k=0, heading_sigma=math.radians(3.0), far=True)
    assert np.exp([one.log_share for one in found]).sum() == pytest.approx(1.0)
    best = max(found, key=lambda one: one.log_share)
    mean, cov = best.place(design(place[None], way)[0])
    error = mean - (PADS[MATE] + place - PADS[OWN] - way)
    assert error @ np.linalg.solve(cov, error) < 16.0
    assert np.sqrt(np.trace(cov)) < 1.0
    mean, cov = best.frame(design(-PADS[MATE][None], way)[0])
    error = mean - np.append(-PADS[OWN] - way, 0.0)
    assert error @ np.linalg.solve(cov, error) < 20.0
    assert math.sqrt(cov[3, 3]) < math.radians(4.0)


@pytest.mark.parametrize("shares", [AS_STATED, DOUBTED, AS_STATED.shown(np.array([0.7, 0.2]))])
def test_what_a_teammate_out_of_view_says_is_known_without_a_sum(shares):
    every = np.arange(len(ERRORS))
    nothing = Marginal(np.zeros((1, 8, 8)), COV, np.unique(ERRORS.spread), shares)
    (found,) = nothing.log_evidence(
        PriorsOfMany.of_one(TeammatePrior.of(MATE, ERRORS), 1), ERRORS, every, 0.05
    )
    assert found == pytest.approx(log_evidence_of_nothing(every, shares.far), abs=1e-12)
