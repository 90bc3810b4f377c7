"""Two drones on the ground whose receivers disagree about what a height is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.messages import Announcement, EgoPose, FlightState
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.motion.ground_heights import GroundHeightNews, GroundHeights
from swarmtrack.motion.gyro import GyroHistory
from swarmtrack.motion.mounting import Mounting
from swarmtrack.onboard import Onboard, OnboardCamera
from swarmtrack.outputs.wording import describe
from swarmtrack.tracking import create_tracker

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
SIGMA = 1.5


def announced(up: float, *, east: float = 4.0, boot: str = "0000000b", sequence: int = 1) -> Announcement:
    place = np.array([0.0, east, -up])
    return Announcement(2, boot, sequence, 1.0, 0.01, place, np.eye(3), SIGMA**2 * np.eye(3))


def drone(*, absolute: bool = True) -> Onboard:
    mounted = OnboardCamera(
        CAMERA,
        Mounting(Pose(rotation.BODY_FROM_FORWARD_CAMERA, np.zeros(3))),
        create_tracker("kalman", camera=CAMERA),
    )
    return Onboard(
        1,
        cameras=[mounted],
        gyro=GyroHistory(),
        ego=EgoHistory(absolute=absolute),
        identity=IdentityParameters(),
    )


def told(onboard: Onboard, *events) -> list[GroundHeightNews]:
    for event in events:
        onboard.tell(event)
    return [event for event in onboard.events() if isinstance(event, GroundHeightNews)]


def standing(t: float) -> EgoPose:
    return EgoPose(t, np.zeros(3), np.eye(3), position_sigma=0.9, vertical_sigma=SIGMA)


GROUND, AIR = FlightState(0.0, None), FlightState(0.0, -math.inf)


@pytest.mark.parametrize("up", [25.0, -25.0, 48.0])
def test_two_drones_on_the_ground_far_apart_in_height_are_said_once(up):
    onboard = drone()
    (news,) = told(onboard, GROUND, announced(up), standing(2.0), standing(2.1))
    assert (news.drone_id, news.above_m) == (2, pytest.approx(up))
    assert f"drone 2 is announced {abs(up):.0f} m {'above' if up > 0 else 'below'} us" in describe(news)
    assert "above the ellipsoid for those above the sea" in describe(news)
    # It flies, and is asked for its pose again; then it starts again.
    assert told(onboard, announced(60.0, sequence=2), standing(3.0)) == []
    assert len(told(onboard, announced(up, boot="0000000c"), standing(4.0))) == 1


def test_whoever_comes_first_waits_for_the_other():
    onboard = drone()
    assert told(onboard, GROUND, announced(25.0)) == []
    assert len(told(onboard, standing(2.0))) == 1


@pytest.mark.parametrize(
    ("onboard", "state", "announcement"),
    [
        (drone(), AIR, announced(25.0)),
        (drone(absolute=False), GROUND, announced(25.0)),
        (drone(), GROUND, announced(7.0)),
        (drone(), GROUND, announced(25.0, east=150.0)),
    ],
    ids=["we fly", "places are local", "within the errors", "a slope"],
)
def test_heights_that_may_be_right_are_not_said(onboard, state, announcement):
    assert told(onboard, state, announcement, standing(2.0)) == []


def test_a_team_that_has_not_found_its_place_keeps_one_announcement_of_each():
    heights = GroundHeights()
    for k in range(1000):
        heights.hear(announced(25.0, sequence=k + 1))
    assert len(heights.stand(1.0, np.zeros(3), np.eye(3))) == 1
    assert not heights.has_waiting
