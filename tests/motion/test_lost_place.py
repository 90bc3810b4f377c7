"""A drone whose autopilot states no place any more: where it may be, and where a sound autopilot would have it."""

import dataclasses

import numpy as np
import pytest

from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import from_euler
from swarmtrack.messages import EgoPose
from swarmtrack.motion.carried_place import CarriedPlace
from swarmtrack.motion.ego import EgoHistory

HZ, LOST_S = 50.0, 2.0
VELOCITY = np.array([1.6, -0.4, 0.0])
EYE = np.eye(3)


def lost(seconds, ego=None, velocity=VELOCITY, attitude=EYE):
    """Flies for LOST_S, and then its poses have no position."""
    ego = ego or EgoHistory(origin=np.zeros(3))
    for k in range(1, int((LOST_S + seconds) * HZ) + 1):
        t = k / HZ
        place = t * velocity if t <= LOST_S else None
        ego.append(EgoPose(t, place, attitude))
    return ego


def test_it_flies_on_for_a_moment_and_no_still_poses_make_its_velocity_small():
    ego = lost(0.6)
    t = LOST_S + 0.6
    assert ego.at(t).position == pytest.approx(t * VELOCITY, abs=0.3)
    velocity, cov = ego.velocity(t)
    assert velocity == pytest.approx(VELOCITY)
    assert np.trace(cov) > 5.0 * np.trace(ego.velocity(LOST_S)[1])
    assert not ego.at(t).is_stated


def test_later_it_may_be_anywhere_about_where_it_would_have_stopped():
    ego = lost(8.0)
    pose = ego.at(LOST_S + 8.0)
    assert pose.position == pytest.approx((LOST_S + 1.0) * VELOCITY, abs=0.1)
    assert pose.position_sigma > 5.0


def test_that_the_autopilot_states_no_place_is_known_with_its_first_pose_without_one():
    assert lost(0.0).stated_t == LOST_S
    assert lost(0.02).stated_t is None


def carried(t, place, offset, *, is_lost=True):
    cov = np.kron(np.diag([0.04, 0.01]), EYE)
    return CarriedPlace(
        t, np.array(place), np.array([1.0, 0.0, 0.0]), cov, 0.5, 0.0, 0.01, (2,), (2,), None, t, np.array(offset),
        0.25 * cov, is_lost,
    )  # fmt: skip


def test_the_place_for_its_autopilot_is_in_the_frame_and_as_off_as_its_positions_were():
    """Its frame is turned by 90°, begins elsewhere, and its positions were 0.3 m too far north."""
    start = Pose(from_euler(0.0, 0.0, np.pi / 2.0), np.array([10.0, 20.0, 0.0]))
    ego = lost(0.5, EgoHistory(start=start), np.zeros(3))
    t = LOST_S + 0.5
    ego.carried = carried(t, (10.0, 25.0, -3.0), (0.3, 0.0, 0.0))
    found = ego.for_autopilot
    # East of its start by five metres is north of it to its autopilot, and north by 0.3 m is west.
    assert found.position == pytest.approx((5.0, -0.3, -3.0), abs=1e-6)
    assert found.velocity == pytest.approx((0.0, -1.0, 0.0), abs=1e-6)
    assert found.world_from_body == pytest.approx(EYE)
    assert found.position_cov[0, 0] == pytest.approx(0.01, rel=1e-3)


def test_there_is_none_where_the_autopilot_has_a_position_or_never_had_one():
    ego = lost(0.5)
    assert ego.for_autopilot is None
    ego.carried = dataclasses.replace(carried(2.5, (3.0, 0.0, 0.0), (0.0, 0.0, 0.0)), is_lost=False)
    assert ego.for_autopilot is None
    never = EgoHistory(start=Pose(EYE, np.zeros(3)))
    never.append(EgoPose(1.0, None, EYE))
    never.carried = carried(1.0, (3.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert never.for_autopilot is None


def test_to_the_team_it_stays_as_off_as_its_start():
    ego = lost(0.5)
    t = LOST_S + 0.5
    ego.carried = carried(t, t * VELOCITY - (0.3, 0.0, 0.0), (0.3, 0.0, 0.0))
    pose = ego.from_start(ego.at(t))
    assert pose.position == pytest.approx(t * VELOCITY)
    assert pose.position_sigma < ego.at(t).position_sigma
