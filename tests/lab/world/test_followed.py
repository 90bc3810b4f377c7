"""Drones that others fly: what lies between two samples of truth is found, and nothing is made up."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.scenarios.scenario import BODY_FROM_CAMERA, CAMERA
from swarmtrack.lab.world.followed import LONGEST_GAP, FollowedDrone, NotTold
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.lab.world.trajectory import Lissajous, SwingingYaw, Trajectory
from swarmtrack.lab.world.world import World

TRUTH_HZ = 50.0


def followed(*samples: tuple[float, Pose]) -> FollowedDrone:
    drone = FollowedDrone(keep_s=math.inf)
    for t, pose in samples:
        assert drone.add_pose(t, pose)
    return drone


def turned(yaw: float, north: float = 0.0) -> Pose:
    return Pose(rotation.from_euler(0.0, 0.0, yaw), np.array([north, 0.0, -5.0]))


def at_height(height: float) -> Pose:
    return Pose(np.eye(3), np.array([0.0, 0.0, -height]))


def test_a_take_off_is_a_metre_above_the_first_sample_and_kept_when_that_is_forgotten():
    drone = FollowedDrone(keep_s=1.0)
    world = World(1, {1: drone, 2: FollowedDrone()})
    # Its estimate of the ground is 3 m off, and wanders.
    for k in range(100):
        drone.add_pose(0.1 * k, at_height(3.0 + 0.1 * (k % 5)))
    assert math.isinf(world.took_off_at)
    for k in range(100, 150):
        drone.add_pose(0.1 * k, at_height(3.0 + 0.2 * (k - 100)))
    assert world.took_off_at == pytest.approx(10.6)


@given(st.floats(0.0, 1.0), st.floats(-3.0, 3.0))
def test_between_two_samples_the_position_is_linear_and_the_attitude_turns_evenly(share, turn):
    drone = followed((10.0, turned(0.2)), (10.05, turned(0.2 + turn, north=2.0)))
    t = 10.0 + share * 0.05
    assert drone.pose(t).position == pytest.approx([2.0 * share, 0.0, -5.0], abs=1e-9)
    assert drone.position(t) == pytest.approx(drone.pose(t).position)
    assert rotation.to_euler(drone.pose(t).rotation)[2] == pytest.approx(
        math.remainder(0.2 + share * turn, 2.0 * math.pi), abs=1e-6
    )


def test_a_hard_flight_told_at_50_hz_is_followed_to_half_a_pixel():
    flight = Trajectory(
        Lissajous((0.0, 0.0, -5.0), (2.0, 2.0, 0.5), (0.25, 0.2, 0.3)),
        SwingingYaw(0.0, 1.2, 4.0, start=-20.0),
    )
    drone = followed(*((k / TRUTH_HZ, flight.pose(k / TRUTH_HZ)) for k in range(501)))
    times = np.linspace(0.0, 10.0, 3001)
    turns = [rotation.log(flight.pose(t).rotation.T @ drone.pose(t).rotation) for t in times]
    assert 430.0 * np.linalg.norm(turns, axis=1).max() < 0.5
    assert max(np.linalg.norm(flight.position(t) - drone.position(t)) for t in times) < 1e-3


@pytest.mark.parametrize("t", [9.999, 10.021, -1.0])
def test_nothing_is_extrapolated(t):
    drone = followed((10.0, turned(0.0)), (10.02, turned(0.1)))
    with pytest.raises(NotTold):
        drone.pose(t)
    with pytest.raises(NotTold):
        drone.position(t)


def test_both_ends_of_what_was_told_are_known():
    drone = followed((10.0, turned(0.0)), (10.02, turned(0.1)))
    assert drone.pose(10.0).rotation == pytest.approx(turned(0.0).rotation)
    assert drone.pose(10.02).rotation == pytest.approx(turned(0.1).rotation)


def test_a_gap_is_not_bridged():
    drone = followed((1.0, turned(0.0)), (1.0 + 1.01 * LONGEST_GAP, turned(0.1)))
    with pytest.raises(NotTold, match=r"told are 1\.000 s and then 1\.101 s"):
        drone.pose(1.05)


def test_a_sample_that_is_not_newer_is_refused():
    drone = followed((1.0, turned(0.0)))
    assert not drone.add_pose(1.0, turned(1.0))
    assert not drone.add_pose(0.9, turned(1.0))
    assert drone.newest == 1.0
    assert drone.pose(1.0).rotation == pytest.approx(turned(0.0).rotation)


def test_what_is_older_than_is_to_be_kept_is_forgotten():
    drone = FollowedDrone(keep_s=1.0)
    for k in range(10 * int(TRUTH_HZ)):
        drone.add_pose(k / TRUTH_HZ, turned(0.0))
    assert len(drone.samples) <= 2 * TRUTH_HZ + 1
    drone.pose(drone.newest - 1.0)
    with pytest.raises(NotTold):
        drone.pose(drone.newest - 3.0)


def test_a_world_is_told_as_far_as_the_slowest_of_its_links():
    early, late = followed((1.0, turned(0.0))), followed((1.3, turned(0.0)))
    assert World(1, {1: early, 2: late}).told_until == 1.0
    assert World(1, {1: early, 2: FollowedDrone()}).told_until == -math.inf
    own = Trajectory(Lissajous((0, 0, -5), (0, 0, 0), (0, 0, 0)), SwingingYaw(0.0, 0.1, 1.0))
    assert World(1, {1: own}).told_until == math.inf


def test_an_imu_of_ours_cannot_be_carried_by_a_drone_that_others_fly():
    with pytest.raises(TypeError, match="drone 1: is flown by another simulator"):
        World(1, {1: followed((1.0, turned(0.0)))}).flown(1)


def test_a_picture_of_followed_drones_is_that_of_the_same_drones_on_their_trajectories():
    """Nothing moves, so that the samples lose nothing: every pixel must then be the same."""
    poses = {1: turned(0.0), 2: turned(math.pi, north=6.0)}
    still = {d: followed(*((0.9 + k / TRUTH_HZ, pose) for k in range(11))) for d, pose in poses.items()}
    own = {
        d: Trajectory(
            Lissajous(pose.position, (0, 0, 0), (0, 0, 0)),
            SwingingYaw(rotation.to_euler(pose.rotation)[2], 0.0, 1.0),
        )
        for d, pose in poses.items()
    }
    images = [
        Renderer(World(3, drones), CAMERA, BODY_FROM_CAMERA).image(1, 1.0, 15) for drones in (still, own)
    ]
    assert np.array_equal(*images)
