"""What cameras see, as directions: against closed forms, and for lenses that have no border where the picture has."""

from __future__ import annotations

import math

import numpy as np
import pytest

from swarmtrack.cameras.field_of_view import _all_but, around, half_angles, outline, outline_around
from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA, from_euler

STRAIGHT = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480)  # 90° wide
FISHEYE = PinholeCamera(200.0, 200.0, 319.5, 239.5, 640, 480, Equidistant((0.0, 0.0, 0.0, 0.0)))


def turned(roll=0.0, pitch=0.0, yaw=0.0) -> Pose:
    rotation = from_euler(*np.radians([roll, pitch, yaw])) @ BODY_FROM_FORWARD_CAMERA
    return Pose(rotation, np.zeros(3))


def test_a_straight_lens_sees_as_far_as_its_focal_length_says():
    width, height = half_angles(STRAIGHT)
    assert width == pytest.approx(math.atan(320 / 320), abs=1e-12)
    assert height == pytest.approx(math.atan(240 / 320), abs=1e-12)


def test_a_fisheyes_view_grows_with_the_angle_itself():
    _, height = half_angles(FISHEYE)
    assert height == pytest.approx(240 / 200, abs=1e-3)


def test_a_lens_that_ends_inside_the_picture_sees_to_its_own_end():
    small = PinholeCamera(100.0, 100.0, 319.5, 239.5, 640, 480, Equidistant((0.0, 0.0, 0.0, 0.0)))
    rays = outline(small)
    assert np.isfinite(rays).all()
    off = np.degrees(np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2]))
    # Of each direction the same, as far as the model reaches, and no pixel beyond is taken for seen.
    assert off.max() - off.min() < 0.5
    assert off.min() > 88.0


@pytest.mark.parametrize(
    ("lens", "angle"),
    [(None, math.atan), (Equidistant((0.0, 0.0, 0.0, 0.0)), lambda focals: focals)],
)
def test_of_a_picture_beside_the_axis_the_view_is_from_its_near_border_to_its_far_one(lens, angle):
    beside = PinholeCamera(640.0, 640.0, -100.5, 239.5, 640, 480, lens)
    width, _ = half_angles(beside)
    assert width == pytest.approx(0.5 * (angle(740 / 640) - angle(100 / 640)), abs=1e-6)
    rays = outline(beside)
    assert np.isfinite(rays).all()
    assert (rays[:, 0] > 0.0).all()


@pytest.mark.parametrize(
    "lens", [Equidistant((0.0, 0.0, 0.0, 0.0)), RadTan((-0.3, 0.0, 0.0, 0.0))], ids=lambda lens: lens.name
)
def test_a_lens_that_reaches_no_part_of_its_picture_is_none(lens):
    """319.5, and a slip of the decimal point: nothing that is seen would have a direction."""
    with pytest.raises(
        ValueError, match=r"cx, cy: \(3195, 239\.5\), expected them in the image of 640 x 480"
    ):
        PinholeCamera(193.0, 193.0, 3195.0, 239.5, 640, 480, lens)


def test_of_a_lens_that_is_none_what_is_seen_still_has_a_border():
    """Newton's iteration finds a pixel's ray in one company, and does not in another."""
    none = PinholeCamera(600.0, 600.0, 320.0, 256.0, 640, 512, RadTan((-0.25, 0.125, 0.0, -8589934592.0)))
    assert np.isfinite(half_angles(none)).all()
    assert np.isfinite(outline(none)).all()


def test_the_outline_goes_once_around_the_corners():
    rays = outline(STRAIGHT, per_side=2)
    corners = rays[::2, :2] / rays[::2, 2:]
    assert corners == pytest.approx(np.array([(-1, -0.75), (1, -0.75), (1, 0.75), (-1, 0.75)]))


@pytest.mark.parametrize(("yaw", "middle"), [(0, 0), (90, 90), (-90, -90), (180, 180)])
def test_around_the_body_right_is_right_of_the_nose_and_up_is_up(yaw, middle):
    (where,) = np.degrees(around(turned(pitch=10, yaw=yaw), np.array([[0.0, 0.0, 1.0]])))
    assert (abs(where[0]) if yaw == 180 else where[0]) == pytest.approx(middle)
    assert where[1] == pytest.approx(10.0)


def test_behind_the_outline_goes_on_and_does_not_jump():
    line = np.degrees(outline_around(STRAIGHT, turned(yaw=180)))
    assert np.abs(np.diff(line[:, 0])).max() < 30.0
    assert np.ptp(line[:, 0]) == pytest.approx(90.0, abs=0.5)
    assert line[0] == pytest.approx(line[-1])


@pytest.mark.parametrize(("pitch", "pole"), [(90, 90), (-90, -90)])
def test_of_a_camera_that_looks_straight_up_or_down_the_outline_closes_along_the_pole(pitch, pole):
    line = np.degrees(outline_around(STRAIGHT, turned(pitch=pitch)))
    assert np.ptp(line[:, 0]) == pytest.approx(360.0)
    assert (line[-3:-1, 1] == pole).all()
    assert line[0] == pytest.approx(line[-1])


def test_of_a_camera_that_sees_above_and_below_the_outline_leaves_out_what_is_behind():
    """A lens of 190° that looks ahead: it does not see a ring of 85° around the back."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    off = np.radians(95.0)
    rays = np.column_stack(
        [np.sin(off) * np.cos(angle), np.sin(off) * np.sin(angle), np.full(48, np.cos(off))]
    )
    line = np.degrees(_all_but(around(turned(), rays), 0.0))
    assert line[0] == pytest.approx(line[-1])
    assert (line[:, 0].min(), line[:, 0].max()) == pytest.approx((-180.0, 180.0), abs=0.1)
    inside = lambda az, up: is_within(line, az, up)  # noqa: E731
    assert inside(0.0, 0.0)
    assert inside(90.0, 0.0)
    assert inside(0.0, 89.0)
    assert inside(170.0, 88.0)
    assert not inside(179.0, 0.0)
    assert not inside(-179.0, 0.0)
    assert not inside(120.0, 0.0)


def is_within(line: np.ndarray, x: float, y: float) -> bool:
    """By how often a ray crosses the line."""
    x1, y1 = line[:-1].T
    x2, y2 = line[1:].T
    crosses = (y1 > y) != (y2 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x1 + (y - y1) / (y2 - y1) * (x2 - x1)
    return bool((crosses & (at > x)).sum() % 2)
