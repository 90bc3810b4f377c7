"""Whether a camera sits as it was told, by how its picture turns (cameras/picture_turn.py)."""

import math

import numpy as np
import pytest

from swarmtrack.cameras.picture_turn import UPSIDE_DOWN, PictureTurns
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Scan
from swarmtrack.motion.gyro import GyroHistory

CAMERA = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480)
FPS, HZ = 15, 195
AHEAD, RIGHT = (
    rotation.from_euler(0.0, 0.0, math.radians(azimuth)) @ rotation.BODY_FROM_FORWARD_CAMERA
    for azimuth in (0.0, 90.0)
)


def flying(t):
    """rad/s of a drone that flies here and there, and looks around."""
    return (
        0.25 * math.cos(2.1 * t) + 0.1 * math.cos(5.0 * t),
        0.25 * math.sin(1.7 * t),
        0.4 * math.sin(0.8 * t),
    )


def yawing(t):
    return 0.0, 0.0, 0.7 * math.copysign(1.0, math.sin(t)) if t > 1.0 else 0.0


def hovering(t):
    return 0.05 * math.cos(4.1 * t), 0.05 * math.sin(3.7 * t), 0.03 * math.sin(0.8 * t)


def fly(rates, true, seconds, *, told=(AHEAD, RIGHT), seed=1, late=0.0, moving=0.5, teammates=6):
    """The news while drones fly around the own one. true, told: body_from_camera (3, 3) of the cameras; rates: of the
    own body, by time; late s: by which the stamps are; moving m/s."""
    chance = np.random.default_rng(seed)
    from_first = [body_from_camera.T @ told[0] for body_from_camera in told]
    turns, gyro, news = PictureTurns(from_first), GyroHistory(), []
    azimuth = chance.uniform(-0.6, 2.1, teammates)
    places = chance.uniform(3.0, 9.0, (teammates, 1)) * np.column_stack(
        [np.cos(azimuth), np.sin(azimuth), 0.2 * chance.normal(size=teammates)]
    )
    velocity, turned, t = moving * chance.normal(size=(teammates, 3)), np.eye(3), 0.0
    gyro.append(0.0, (0.0, 0.0, 0.0))
    for _ in range(round(seconds * FPS)):
        for _ in range(HZ // FPS):
            t += 1.0 / HZ
            rate = np.array(rates(t))
            turned = turned @ rotation.exp(rate / HZ)
            gyro.append(t, tuple((told[0].T @ (rate + 2e-3 * chance.normal(size=3))).tolist()))
        velocity += (moving * chance.normal(size=(teammates, 3)) - velocity / 4.0) / FPS
        places = places + velocity / FPS
        for number, body_from_camera in enumerate(true):
            pixel, _, ahead = CAMERA.project_undistorted(places @ turned @ body_from_camera)
            inside = ahead & (pixel > 0.0).all(axis=1) & (pixel < [639.0, 479.0]).all(axis=1)
            shown = inside & (chance.random(teammates) < 0.93)
            z = pixel[shown] + 1.5 * chance.normal(size=(int(shown.sum()), 2))
            false = chance.uniform([0.0, 0.0], [640.0, 480.0], (chance.poisson(0.3), 2))
            if t > late:
                scan = Scan(t, np.concatenate([z, false]))
                found = turns.add_scan(number, scan, CAMERA, gyro.orientation(t - late))
                news += [found] if found else []
    return news


@pytest.mark.parametrize("rates", [flying, yawing])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_camera_that_is_upside_down_is_found_within_six_seconds(rates, seed):
    ((t, camera, fits, like),) = fly(rates, (AHEAD, RIGHT @ UPSIDE_DOWN), 8.0, seed=seed)
    assert (camera, fits, like) == (1, False, None)
    assert t < 6.0


def test_cameras_whose_cables_are_swapped_are_found_by_how_the_drone_tilts():
    news = fly(flying, (RIGHT, AHEAD), 8.0)
    assert {(one.camera, one.fits, one.like) for one in news} == {(0, False, 1), (1, False, 0)}
    assert len(news) == 2


@pytest.mark.parametrize("rates", [flying, yawing, hovering])
@pytest.mark.parametrize("moving", [0.3, 2.0])
def test_of_cameras_that_sit_as_they_were_told_nothing_is_said(rates, moving):
    for seed in range(2):
        assert fly(rates, (AHEAD, RIGHT), 12.0, seed=seed, moving=moving) == []


def test_a_clock_that_is_100_ms_off_is_no_wrong_mounting():
    assert fly(flying, (AHEAD, RIGHT), 12.0, late=0.1) == []


@pytest.mark.parametrize("share", [0.6, 1.0])
def test_the_only_teammate_may_change_its_direction_in_step_with_the_own_turn(share):
    """As one does that stands nearer than what the drone circles, or just there."""
    turns, gyro, chance = PictureTurns([np.eye(3)]), GyroHistory(), np.random.default_rng(1)
    gyro.append(0.0, (0.0, 0.0, 0.0))
    bearing = yaw = t = 0.0
    for k in range(60 * HZ):
        t += 1.0 / HZ
        rate = 0.2 * math.sin(0.8 * t)
        bearing, yaw = bearing + rate / share / HZ, yaw + rate / HZ
        gyro.append(t, tuple((AHEAD.T @ [0.0, 0.0, rate + 2e-3 * chance.normal()]).tolist()))
        if k % (HZ // FPS) == 0:
            z = np.array([[319.5 + 320.0 * math.tan(bearing - yaw), 239.5]])
            scan = Scan(t, z + 1.5 * chance.normal(size=(1, 2)))
            assert turns.add_scan(0, scan, CAMERA, gyro.orientation(t)) is None
