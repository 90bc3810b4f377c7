"""How this drone itself moves, by its autopilot's poses: the same whenever it is asked for, and never an old one."""

import numpy as np
import pytest

from swarmtrack.messages import EgoPose
from swarmtrack.motion.ego import EgoHistory

HZ = 50.0


def flown(velocity, seconds=2.0, ego=None, begin=0.0, at=(0.0, 0.0, 0.0)):
    ego = ego or EgoHistory(origin=np.zeros(3))
    for k in range(1, int(seconds * HZ) + 1):
        t = begin + k / HZ
        place = np.array(at) + (k / HZ) * np.array(velocity)
        ego.append(EgoPose(t=t, position=place, world_from_body=np.eye(3)))
    return ego


def test_it_goes_on_straight_beyond_the_newest_pose():
    ego = flown([1.0, -2.0, 0.5])
    for ahead in (0.01, 0.02, 0.01, 0.3):
        way, velocity, cov = ego.flown_on(2.0 + ahead)
        assert velocity == pytest.approx([1.0, -2.0, 0.5])
        assert way == pytest.approx(ahead * np.array([1.0, -2.0, 0.5]))
        assert np.trace(cov) > np.trace(ego.velocity(2.0)[1])


def test_a_pose_that_comes_changes_it():
    ego = flown([1.0, 0.0, 0.0])
    before = ego.flown_on(2.01)[1]
    flown([0.0, 3.0, 0.0], 1.0, ego, 2.0, (2.0, 0.0, 0.0))
    assert before == pytest.approx([1.0, 0.0, 0.0])
    assert ego.flown_on(3.01)[1] == pytest.approx([0.0, 3.0, 0.0])


def test_within_the_history_there_is_no_way_and_the_velocity_of_then():
    ego = flown([1.0, 0.0, 0.0], 1.0)
    flown([0.0, 1.0, 0.0], 1.0, ego, 1.0, (1.0, 0.0, 0.0))
    way, velocity, _ = ego.flown_on(0.5)
    assert (way == 0.0).all()
    assert velocity == pytest.approx([1.0, 0.0, 0.0])


def jittering(sigma, velocity=(1.0, -2.0, 0.5)):
    rng, ego = np.random.default_rng(1), EgoHistory(origin=np.zeros(3))
    for k in range(101):
        place = k / HZ * np.array(velocity)
        noise = sigma * rng.standard_normal(3) if k else 0.0
        ego.append(EgoPose(t=k / HZ, position=place + noise, world_from_body=np.eye(3)))
    return ego


def test_a_steady_place_jitters_less_than_the_poses_around_it():
    ego = jittering(0.03)
    times = np.arange(0.5, 1.9, 0.013)
    true = times[:, None] * np.array([1.0, -2.0, 0.5])
    steady, at = (np.array([of(t).position for t in times]) - true for of in (ego.steady, ego.at))
    assert np.abs(steady).std() < 0.5 * np.abs(at).std()
    assert steady.std() < 0.012


def test_a_steady_place_goes_on_with_the_drone_between_and_beyond_its_poses():
    ego = jittering(0.0)
    for t in (0.5, 1.003, 1.99, 2.0, 2.1):
        assert ego.steady(t).position == pytest.approx(t * np.array([1.0, -2.0, 0.5]), abs=1e-9)
    assert (ego.steady(2.1).position_cov == ego.at(2.1).position_cov).all()


def test_without_a_place_or_alone_a_pose_is_as_steady_as_it_is():
    ego = EgoHistory(origin=np.zeros(3))
    assert ego.steady(0.0) is None
    ego.append(EgoPose(t=0.0, position=np.array([1.0, 2.0, 3.0]), world_from_body=np.eye(3)))
    assert ego.steady(0.01).position == pytest.approx(ego.at(0.01).position)


def test_what_it_reports_is_as_late_as_its_autopilots_clock_may_be():
    ego = EgoHistory(origin=np.zeros(3))
    for k in range(51):
        ego.append(EgoPose(k / HZ, np.array([k / HZ, 0.0, 0.0]), np.eye(3), t_sigma=0.02 if k < 50 else 0.1))
    assert ego.moved(1, "0000000a", 1).t_sigma == 0.1
    assert [ego.at(t).t_sigma for t in (0.5, 0.505, 0.995, 1.2)] == [0.02, 0.02, 0.1, 0.1]


def test_after_a_gap_a_steady_place_is_not_carried_on_along_a_line_through_a_few_jittering_poses():
    rng, ego = np.random.default_rng(1), EgoHistory(origin=np.zeros(3))
    for t in (*np.arange(0.0, 1.0, 0.02), 2.04, 2.06, 2.08):  # an agent that stood still
        ego.append(EgoPose(t=t, position=rng.normal(0.0, 0.04, 3), world_from_body=np.eye(3)))
    errors = [np.linalg.norm(ego.steady(t).position) for t in np.arange(1.7, 2.08, 0.02)]
    assert max(errors) < 0.2  # 5 sigma of one pose
