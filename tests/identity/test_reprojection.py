"""How sure a teammate's place in the image is: against errors that are drawn."""

import numpy as np
import pytest

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.reprojection import LastSeen, ObserverCamera, reproject, retrace
from swarmtrack.messages import Announcement
from swarmtrack.motion.ego import TeamPose

CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
MOUNT = Pose(rotation.BODY_FROM_FORWARD_CAMERA, np.array([0.1, 0.0, 0.0]))
TEAMMATE = np.array([9.0, 5.0, -4.0])


def announced(cov):
    return Announcement(2, "0000000a", 1, 0.0, 0.0, TEAMMATE, np.eye(3), cov)


def observer(heading, tilt, position=(0.0, 0.0, 0.0), attitude=None):
    attitude = rotation.from_euler(0.2, -0.15, 0.5) if attitude is None else attitude
    return TeamPose(
        0.0,
        np.array([0.0, 0.0, -2.0]),
        attitude,
        np.diag(np.square(position)),
        np.diag(np.square([tilt, tilt, heading])),
    )


def place(seen_by):
    view = ObserverCamera.of(seen_by, CAMERA, MOUNT)
    return reproject([announced(np.zeros((3, 3)))], view, on_pad={2}, drift_speed=0.5, stay_s=30.0)


@pytest.mark.parametrize(
    ("heading", "tilt", "position"),
    [
        (0.03, 0.0, (0.0, 0.0, 0.0)),
        (0.0, 0.02, (0.0, 0.0, 0.0)),
        (0.0, 0.0, (0.1, 0.1, 0.3)),
        (0.03, 0.01, (0.1, 0.1, 0.2)),
    ],
    ids=["heading", "tilt", "position", "all"],
)
def test_the_covariance_is_that_of_the_errors_of_heading_tilt_and_position(heading, tilt, position):
    rng = np.random.default_rng(3)
    known = observer(heading, tilt, position)
    told = place(known).cov[0, 0]
    errors = rng.standard_normal((4000, 6)) * [tilt, tilt, heading, *position]
    pixels = []
    for turn, off in zip(errors[:, :3], errors[:, 3:], strict=True):
        pose = Pose(rotation.exp(turn) @ known.world_from_body, known.position + off) @ MOUNT
        pixels.append(CAMERA.project_undistorted(pose.inverse().transform(TEAMMATE[None]))[0][0])
    drawn = np.cov(np.array(pixels).T)
    # With 4000 draws a variance is known to 2 %; what is left is the camera's curvature.
    assert np.abs(drawn - told).max() < 0.08 * told.max()


def test_of_a_level_camera_an_unsure_heading_moves_teammates_along_the_rows_only():
    cov = place(observer(0.05, 0.0, attitude=np.eye(3))).cov[0, 0]
    angle = np.arctan2(TEAMMATE[1], TEAMMATE[0] - 0.1)
    assert np.sqrt(cov[0, 0]) == pytest.approx(0.05 * 430.0 / np.cos(angle) ** 2, rel=1e-3)
    # A teammate on the horizon would not move along the columns at all; this one is above it.
    assert cov[1, 1] < 0.05 * cov[0, 0]


def test_a_drone_that_was_seen_is_expected_there_again_whatever_the_heading_is():
    """A heading that is off was off when the ray was seen, so it moves nothing."""
    seen = LastSeen(2, 0.0, np.array([1.0, 0.0, 0.0]), np.zeros(3), 1e-3, np.zeros(3))
    sure, unsure = (
        retrace([seen], ObserverCamera.of(observer(h, 0.01), CAMERA, MOUNT), turn_rate=0.1).cov
        for h in (0.01, 0.2)
    )
    np.testing.assert_array_equal(sure, unsure)
