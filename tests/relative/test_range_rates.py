"""A ranging radio measures far more often than a camera, at times of its own: that must not make anybody too sure."""

from __future__ import annotations

import heapq
from itertools import count

import numpy as np
import pytest

from swarmtrack.messages import Array, RangeReport
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.states import OwnMotion, RelativeStates

STILL = OwnMotion(np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))
SCAN_HZ, SCAN_LATE_S, STEP_S, SECONDS = 7.0, 0.1, 0.01, 12.0
RAY_SIGMA, RADIO_SIGMA = 2e-3, 0.1
WANDER_S, SPEED = 3.0, 1.0


def flown(rng: np.random.Generator) -> tuple[Array, Array]:
    """(n, 3) m and m/s every STEP_S: a teammate that wanders, from 10 m ahead on."""
    keep = np.exp(-STEP_S / WANDER_S)
    velocity = [SPEED * rng.standard_normal(3)]
    for _ in range(round(SECONDS / STEP_S)):
        velocity.append(keep * velocity[-1] + SPEED * np.sqrt(1.0 - keep**2) * rng.standard_normal(3))
    v = np.array(velocity)
    return np.array([12.0, 0.0, 0.0]) + np.cumsum(v, axis=0) * STEP_S, v


def errors(range_hz: float, late: float, seed: int) -> list[tuple[float, float]]:
    """NEES of place and velocity over 6, and the squared error of the distance over its variance, five per second."""
    rng = np.random.default_rng(seed)
    place, velocity = flown(rng)
    states = RelativeStates(RelativeParameters(airframe_span_m=0.5))
    size = 0.5 * np.exp(0.18 * rng.standard_normal())
    number = count()
    queue: list[tuple[float, int, TeamLook | RangeReport]] = []
    for t in np.arange(0.0, SECONDS, 1.0 / SCAN_HZ):
        x = place[round(t / STEP_S)]
        distance = np.linalg.norm(x)
        ray = x / distance + RAY_SIGMA * rng.standard_normal(3)
        width = size / distance * np.exp(0.06 * rng.standard_normal())
        look = TeamLook(
            float(t), np.zeros(3), np.zeros(3), ((2, 7),), (ray / np.linalg.norm(ray))[None],
            RAY_SIGMA**2 * np.eye(3)[None], np.array([width]), np.ones(1),
        )  # fmt: skip
        heapq.heappush(queue, (float(t) + SCAN_LATE_S, next(number), look))
    for t in np.arange(0.0, SECONDS, 1.0 / range_hz):
        measured = np.linalg.norm(place[round(t / STEP_S)]) + RADIO_SIGMA * rng.standard_normal()
        said = RangeReport(1, 2, float(t), 0.005, float(max(measured, 0.3)), RADIO_SIGMA)
        heapq.heappush(queue, (float(t) + late, next(number), said))
    found = []
    for t in np.arange(4.0, SECONDS, 0.2):
        while queue and queue[0][0] <= t:
            word = heapq.heappop(queue)[2]
            if isinstance(word, TeamLook):
                states.observe(word)
            else:
                states.hear_range(word)
        state = states.at(float(t), STILL)[7]
        x, v = place[round(t / STEP_S)], velocity[round(t / STEP_S)]
        off = np.concatenate([state.position - x, state.velocity - v])
        towards = x / np.linalg.norm(x)
        along = float(towards @ off[:3]) ** 2 / float(towards @ state.cov[:3, :3] @ towards)
        found.append((float(off @ np.linalg.solve(state.cov, off)) / 6.0, along))
    assert states.refused <= 3
    return found


@pytest.mark.parametrize(
    ("range_hz", "late"),
    [
        (10.0, 0.01),
        (10.0, 0.2),
        pytest.param(50.0, 0.01, marks=pytest.mark.long("five times as many distances")),
    ],
)
def test_distances_at_any_rate_and_late_leave_honest_covariances(range_hz, late):
    nees, along = np.array([one for seed in range(6) for one in errors(range_hz, late, seed)]).mean(axis=0)
    assert 0.5 < nees < 1.3
    assert 0.3 < along < 1.5
