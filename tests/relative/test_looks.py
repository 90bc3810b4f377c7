"""From boxes to ranges: what a level segment of known width looks like, anywhere in the image and with any bank."""

import math

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.relative.looks import NamedBox, TeamLook, camera_roll, widths

CAMERA = PinholeCamera(430.0, 440.0, 320.0, 240.0, 640, 480)


def team_from_camera(roll=0.0, pitch=0.0, yaw=0.0):
    return rotation.from_euler(roll, pitch, yaw) @ rotation.BODY_FROM_FORWARD_CAMERA


def box_of(points, turned):
    """The upright box (centre, size) around points (n, 3) m in team axes."""
    pixel, _, valid = CAMERA.project_undistorted(points @ turned)
    assert valid.all()
    low, high = pixel.min(axis=0), pixel.max(axis=0)
    return (low + high) / 2.0, high - low


def ellipse(centre, width, height):
    """Points of an upright, level ellipse that faces the camera, (n, 3) m in team axes."""
    ray = centre / np.linalg.norm(centre)
    level = np.cross([0.0, 0.0, 1.0], ray)
    level /= np.linalg.norm(level)
    a = np.linspace(0.0, 2.0 * math.pi, 720, endpoint=False)[:, None]
    return centre + 0.5 * width * np.cos(a) * level + 0.5 * height * np.sin(a) * np.cross(ray, level)


@pytest.mark.parametrize("roll_deg", [0, 12, -12, 25, -25])
@pytest.mark.parametrize("azimuth_deg", [0, 20, -30])
def test_the_width_is_that_of_the_level_drone_whatever_the_bank(roll_deg, azimuth_deg):
    """Turned upright a box is right within 2 % near the middle, and 5 % towards the side, where ellipses shear."""
    turned = team_from_camera(roll=math.radians(roll_deg), pitch=0.1)
    azimuth = math.radians(azimuth_deg)
    centre = 10.0 * np.array([math.cos(azimuth), math.sin(azimuth), -0.05])
    z, size = box_of(ellipse(centre, 0.5, 0.15), turned)
    (width,) = widths(z[None], size[None], CAMERA, turned)
    assert width == pytest.approx(
        0.5 / np.linalg.norm(centre), rel=0.05 if azimuth_deg and roll_deg else 0.01
    )


def test_a_camera_that_hangs_on_its_side_sees_no_width():
    turned = team_from_camera(roll=math.radians(50.0))
    assert np.isnan(widths(np.array([[320.0, 240.0]]), np.array([[20.0, 10.0]]), CAMERA, turned)).all()


@pytest.mark.parametrize(
    ("z", "size"),
    [
        ((5.0, 240.0), (20.0, 10.0)),
        ((320.0, 474.0), (20.0, 20.0)),
        ((320.0, 240.0), (math.nan, math.nan)),
        ((320.0, 240.0), (0.0, 0.0)),
    ],
)
def test_a_box_that_may_be_cut_off_or_is_none_has_no_width(z, size):
    assert np.isnan(widths(np.array([z]), np.array([size]), CAMERA, team_from_camera())).all()


@pytest.mark.parametrize("roll_deg", [0, 20])
def test_the_padding_of_a_box_is_no_drone(roll_deg):
    turned = team_from_camera(roll=math.radians(roll_deg))
    centre = np.array([10.0, 0.0, 0.0])
    z, size = box_of(ellipse(centre, 0.5, 0.15), turned)
    named = NamedBox(2, 7, z, np.eye(2), size + 15.0)
    look = TeamLook.of(0.0, [named], CAMERA, Pose(turned, np.zeros(3)), np.zeros(3), padding_px=15.0)
    assert look.width == pytest.approx([0.05], rel=0.01)
    assert look.gain == pytest.approx((size[0] + 15.0) / size[0])


@pytest.mark.parametrize("size", [(18.0, 18.0), (10.0, 10.0), (math.nan, math.nan)])
def test_a_box_that_is_nearly_all_padding_has_no_width(size):
    named = NamedBox(2, 7, np.array([320.0, 240.0]), np.eye(2), np.array(size))
    look = TeamLook.of(
        0.0, [named], CAMERA, Pose(team_from_camera(), np.zeros(3)), np.zeros(3), padding_px=15.0
    )
    assert np.isnan(look.width).all()
    assert (look.gain == 1.0).all()


@pytest.mark.parametrize("roll", [0.0, 0.3, -0.4])
@pytest.mark.parametrize("pitch", [0.0, 0.5])
def test_the_camera_s_roll_is_that_of_the_horizon(roll, pitch):
    turned = team_from_camera(roll=roll, pitch=pitch, yaw=1.0)
    assert camera_roll(turned) == pytest.approx(roll, abs=1e-9)
    ahead = turned @ np.array([0.0, 0.0, 1.0])
    level = np.cross([0.0, 0.0, 1.0], ahead)
    pixel, _, _ = CAMERA.project_undistorted(np.array([ahead, ahead + 0.01 * level]) @ turned)
    du, dv = (pixel[1] - pixel[0]) / [CAMERA.fx, CAMERA.fy]
    assert math.atan2(-dv, du) == pytest.approx(roll, abs=0.02)


def test_straight_up_there_is_no_horizon():
    assert camera_roll(team_from_camera(pitch=math.pi / 2)) == 0.0


def test_a_ray_s_covariance_is_that_of_scattered_pixels():
    rng = np.random.default_rng(2)
    R = np.array([[4.0, 1.0], [1.0, 2.0]])
    z = np.array([560.0, 100.0])
    pose = Pose(team_from_camera(0.2, 0.1, 2.0), np.array([1.0, 2.0, -3.0]))

    def look(pixels):
        boxes = [NamedBox(2, i, one, R, np.array([20.0, 10.0])) for i, one in enumerate(pixels)]
        return TeamLook.of(0.0, boxes, CAMERA, pose, np.zeros(3))

    many = look(rng.multivariate_normal(z, R, 4000)).ray
    (want,) = look([z]).ray_cov
    got = np.cov(many.T)
    np.testing.assert_allclose(got, want, atol=0.08 * np.abs(want).max())


def test_nobody_named_is_an_ordinary_look():
    look = TeamLook.of(0.0, [], CAMERA, Pose(team_from_camera(), np.zeros(3)), np.zeros(3))
    assert look.ray.shape == (0, 3)
    assert look.ray_cov.shape == (0, 3, 3)
    assert look.keys == ()
