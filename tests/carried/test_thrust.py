"""A drone's tilt says how it is pushed."""

from __future__ import annotations

import numpy as np
import pytest

from swarmtrack.carried.priors import PUSH_KNOWN_S
from swarmtrack.carried.thrust import TiltedThrust
from swarmtrack.geometry import rotation
from swarmtrack.lab.scenarios.files import load_scenario

STEP_S = 0.15


def test_pushes_add_up_to_what_a_flown_drone_gains_in_speed() -> None:
    """By the attitudes of a simulated quadrotor, which leans as it accelerates."""
    world, thrust = load_scenario("crossing", seed=1).world, TiltedThrust()
    gained, off = [], []
    for t in np.arange(2.0, 12.0, STEP_S).tolist():
        push = thrust.push(t, world.pose(1, t).rotation)
        motion, before = world.flown(1).motion(t), world.flown(1).motion(t - STEP_S)
        change = motion.velocity - before.velocity
        gained.append(float(np.linalg.norm(change[:2])))
        off.append(float(np.linalg.norm((change - STEP_S * push)[:2])))
    assert sum(gained[1:]) > 1.0
    assert sum(off[1:]) < 0.5 * sum(gained[1:])


def test_a_steady_lean_is_wind_and_no_push() -> None:
    thrust, leant = TiltedThrust(), rotation.from_euler(0.1, -0.05, 1.0)
    for k in range(3):
        assert thrust.push(0.1 * k, leant) == pytest.approx(np.zeros(3))
    level = rotation.from_euler(0.0, 0.0, 1.0)
    north, east, down = thrust.push(0.3, level).tolist()
    assert (north**2 + east**2) ** 0.5 == pytest.approx(0.5 * 9.81 * (0.1**2 + 0.05**2) ** 0.5, rel=0.05)
    assert down == 0.0
    later = [thrust.push(0.3 + 0.1 * k, level) for k in range(1, 200)]
    assert float(np.linalg.norm(later[-1])) < 0.05


@pytest.mark.parametrize("gap", [0.0, -1.0, PUSH_KNOWN_S])
def test_across_a_gap_no_push_is_known(gap: float) -> None:
    thrust = TiltedThrust()
    thrust.push(1.0, np.eye(3))
    assert thrust.push(1.0 + gap, rotation.from_euler(0.2, 0.0, 0.0)) == pytest.approx(np.zeros(3))
