"""Our messages as ROS 2's: axes, frames and covariances against plain arithmetic. No network, no ROS."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.seen_swarm import COV, FORWARD, LENS, UTC, healthy, seen
from swarmtrack.geometry.camera import Equidistant, PinholeCamera
from swarmtrack.geometry.rotation import from_euler, from_quaternion
from swarmtrack.outputs.ros2 import cdr, mapping
from swarmtrack.outputs.ros2.drone_topics import DroneTopics, Pace
from swarmtrack.outputs.ros2.mapping import UNKNOWN_VARIANCE, DroneFrames, DronePlace
from swarmtrack.wire.camera import camera_message

FRAMES = DroneFrames("swarm", 1)
CAMERA = camera_message(1, "0123abcd", [LENS], [FORWARD])
T = UTC + 0.25
FULL = np.array([[2.0, 0.3, -0.1], [0.3, 1.0, 0.2], [-0.1, 0.2, 0.5]])


def place(attitude=None, **more):
    return DronePlace(T, np.array([1.0, 2.0, -3.0]), FULL, attitude, **more)


def odometry(here, frames):
    return mapping.odometry(here, mapping.map_pose(here), frames)


def transforms(here, camera, frames):
    return mapping.transforms(here, mapping.map_pose(here), camera, frames)


def pose_of(leaves):
    x, y, z, qx, qy, qz, qw = leaves
    return np.array([x, y, z]), from_quaternion(np.array([qw, qx, qy, qz]))


def test_a_drone_that_flies_north_and_looks_east_is_so_in_ros_axes():
    """Yaw 90° clockwise from north looks east: x of ENU. It flies north, which is to its left: y of FLU."""
    east = from_euler(0.0, 0.0, math.pi / 2)
    leaves = odometry(place(east, velocity=np.array([3.0, 0.0, 0.0]), velocity_cov=np.eye(3)), FRAMES)
    assert leaves[:4] == (int(T), 250_000_000, "map", "swarm/d1/base_link")
    position, attitude = pose_of(leaves[4:11])
    np.testing.assert_allclose(position, [2.0, 1.0, 3.0])
    np.testing.assert_allclose(attitude, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(leaves[47:53], [0.0, 3.0, 0.0, 0.0, 0.0, 0.0], atol=1e-12)


@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_a_point_on_the_body_lands_at_the_same_place_by_both_conventions(angles, point):
    attitude = from_euler(*angles)
    position, turn = pose_of(odometry(place(attitude), FRAMES)[4:11])
    there = np.array([1.0, 2.0, -3.0]) + attitude @ point  # forward, right, down to north, east, down
    forward, right, down = point
    north, east, below = there
    np.testing.assert_allclose(position + turn @ [forward, -right, -down], [east, north, -below], atol=1e-9)


def test_without_an_attitude_the_frame_has_the_axes_of_the_map():
    leaves = odometry(place(velocity=np.array([3.0, 0.0, 0.0]), velocity_cov=np.eye(3)), FRAMES)
    assert leaves[3] == "swarm/d1/camera_enu"
    np.testing.assert_allclose(pose_of(leaves[4:11])[1], np.eye(3))
    np.testing.assert_allclose(leaves[47:50], [0.0, 3.0, 0.0])
    cov = np.reshape(leaves[11:47], (6, 6))
    north, east, down = np.eye(3)
    for (i, a), (j, b) in [((0, east), (1, north)), ((0, east), (2, -down)), ((1, north), (1, north))]:
        assert cov[i, j] == pytest.approx(a @ FULL @ b)


def test_what_is_unknown_has_the_variance_that_says_so():
    twist_cov = np.reshape(odometry(place(np.eye(3)), FRAMES)[53:], (6, 6))
    np.testing.assert_array_equal(twist_cov, UNKNOWN_VARIANCE * np.eye(6))


def test_a_teammate_keeps_its_place_and_the_directions_of_its_uncertainty():
    message = seen()
    (relative,) = mapping.named(message).values()
    leaves = mapping.teammate_pose(relative, T, FRAMES)
    assert leaves[2] == "swarm/d1/camera_enu"
    np.testing.assert_allclose(leaves[3:6], [6.0, 8.0, 1.0])
    variances = np.reshape(leaves[10:], (6, 6)).diagonal()
    np.testing.assert_allclose(variances[:3], COV.diagonal()[[1, 0, 2]])
    twist = mapping.teammate_twist(relative, T, FRAMES)
    np.testing.assert_allclose(twist[3:6], [0.0, 0.5, 0.25])
    np.testing.assert_allclose(np.reshape(twist[9:], (6, 6)).diagonal()[:3], COV.diagonal()[[4, 3, 5]])


@given(st.lists(st.floats(-1.0, 1.0), min_size=36, max_size=36))
def test_a_full_covariance_is_turned_as_a_matrix_is(entries):
    root = np.reshape(entries, (6, 6))
    whole, turn = root @ root.T, np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    triangle = whole[np.triu_indices(6)].tolist()
    for begin in (0, 3):
        block = slice(begin, begin + 3)
        found = np.reshape(mapping._six_of_triangle(triangle, begin), (6, 6))[:3, :3]
        np.testing.assert_allclose(found, turn @ whole[block, block] @ turn.T, atol=1e-12)


def test_of_two_tracks_with_one_name_the_more_probable_counts():
    message = seen()
    two = message.tracks[0]
    twin = type(two)(
        **{**{f: getattr(two, f) for f in two.__struct_fields__}, "id": 9, "identity_probability": 0.6}
    )
    relative = message.relatives[0]
    far = type(relative)(9, (1e3, 0.0, 0.0), *(getattr(relative, f) for f in relative.__struct_fields__[2:]))
    both = type(message)(1, UTC, 0.01, 1, 0.0, (twin, two), relatives=(far, relative))
    assert mapping.named(both) == {2: relative}


def test_the_camera_looks_forward_in_the_body_of_ros():
    (row,) = mapping.static_transforms(CAMERA, T, FRAMES)[0]
    assert row[2:4] == ("swarm/d1/base_link", "swarm/d1/camera_optical")
    position, turn = pose_of(row[4:])
    np.testing.assert_allclose(position, [0.1, 0.0, 0.0])
    np.testing.assert_allclose(turn @ [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], atol=1e-12)  # z ahead
    np.testing.assert_allclose(turn @ [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], atol=1e-12)  # x right


def test_the_level_frame_is_at_the_camera_whether_the_attitude_is_known_or_not():
    attitude = from_euler(0.1, -0.2, 2.0)
    body, level = transforms(place(attitude), CAMERA, FRAMES)[0]
    assert (body[3], level[3]) == ("swarm/d1/base_link", "swarm/d1/camera_enu")
    (static,) = mapping.static_transforms(CAMERA, T, FRAMES)[0]
    at, turn = pose_of(body[4:])
    np.testing.assert_allclose(level[4:7], at + turn @ static[4:7])
    (alone,) = transforms(place(), CAMERA, FRAMES)[0]
    assert alone[3] == "swarm/d1/camera_enu"


@pytest.mark.parametrize(
    ("distortion", "model", "count"),
    [(None, "plumb_bob", 5), (Equidistant((0.1, 0.0, 0.0, 0.0)), "equidistant", 4)],
)
def test_the_lens_is_scaled_to_the_picture(distortion, model, count):
    lens = PinholeCamera(400.0, 500.0, 320.0, 240.0, 640, 480, distortion)
    leaves = mapping.camera_info(lens, 320, 240, T, "f")
    assert leaves[3:6] == (240, 320, model)
    assert len(leaves[6]) == count
    np.testing.assert_allclose(leaves[7:16], [200.0, 0.0, 159.75, 0.0, 250.0, 119.75, 0.0, 0.0, 1.0])


def test_a_drone_that_is_not_ready_warns_with_its_reasons():
    (row,) = mapping.diagnostics(healthy("0123abcd"), T, 1)[3]
    assert row[:4] == (mapping.LEVEL_WARN, "swarmtrack: drone 1", "no gyro", "drone 1")


def test_markers_stand_at_the_places_that_poses_say():
    balls, own_name, name, ellipsoid, rays, other = mapping.markers(
        seen(), {1: np.array([0.0, 0.0, 1.0])}, T, FRAMES
    )[0]
    points = slice(24, 26)  # and their colours
    assert [len(each) for each in balls[points]] == [2, 2]
    np.testing.assert_allclose(balls[24], [[0.0, 0.0, 0.0], [6.0, 8.0, 1.0]])
    assert (own_name[3:6], name[3:6]) == (("swarm/d1/names", 1, 9), ("swarm/d1/names", 2, 9))
    np.testing.assert_allclose(name[7:10], [6.0, 8.0, 1.0 + mapping.ROS_NAME_ABOVE_M])
    _, turn = pose_of(ellipsoid[7:14])
    half = np.array(ellipsoid[14:17]) / 2.0 / mapping.ELLIPSE_SIGMAS
    np.testing.assert_allclose(
        turn @ np.diag(half**2) @ turn.T, np.diag(COV.diagonal()[[1, 0, 2]]), atol=1e-9
    )
    np.testing.assert_allclose(rays[24], [[0.0, 0.0, 0.0], [6.0, 8.0, 1.0]])
    assert other[2] == "swarm/d1/camera_optical"
    np.testing.assert_allclose(other[24][1], [0.0, 0.0, mapping.ROS_RAY_M])


class Listener:
    """A node to whose topics somebody subscribes, or not."""

    def __init__(self, wanted):
        self.wanted, self.declared, self.made = wanted, set(), {}

    def declare(self, topic, kind, qos=""):
        self.declared.add(topic)

    def offer(self, topic, kind, make, qos=""):
        self.declared.add(topic)
        if self.wanted(topic):
            self.made[topic] = cdr.encode(kind, make())

    def has_listener(self, topic):
        return self.wanted(topic)


def say_all(node):
    topics = DroneTopics(node, FRAMES, 20.0)
    topics.on_camera(CAMERA)
    topics.on_place(place(np.eye(3)))
    topics.on_tracks(seen(), T)
    topics.on_health(healthy("0123abcd"), T)
    return topics


def test_nothing_is_made_while_nobody_subscribes_and_all_topics_are_shown():
    node = Listener(lambda topic: False)
    say_all(node)
    assert node.made == {}
    assert {
        "/tf",
        "/tf_static",
        "/diagnostics",
        "/swarm/markers",
        "/swarm/d1/image/compressed",
    } < node.declared


def test_each_topic_is_made_for_its_subscriber():
    node = Listener(lambda topic: True)
    topics = say_all(node)
    assert node.declared - set(node.made) == {"/swarm/d1/image/compressed"}  # no picture has come
    assert topics.wanted_pictures == (0,)


def test_a_rate_is_kept_on_average_from_a_faster_one_and_after_a_clock_was_set_back():
    pace = Pace(20.0)
    assert sum(pace.is_due(T + k / 50) for k in range(500)) == pytest.approx(200, abs=2)
    assert sum(pace.is_due(T - 3600.0 + k / 50) for k in range(500)) == pytest.approx(200, abs=2)
