"""What Foxglove shows of teammates in metres, read from the file as a viewer reads it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from foxglove.messages import Timestamp

from support.protobuf_topics import decoded, message_class
from support.recorded_flight import fly
from swarmtrack.geometry.camera import Equidistant, PinholeCamera, RadTan
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA, from_euler, from_quaternion
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.messages import IdentifiedTrack, RelativeState, ScanReport, Track, TrackList, TrackStatus
from swarmtrack.outputs.foxglove_scene import CALIBRATIONS, FoxgloveScene, calibration


@pytest.fixture(scope="module")
def topics(tmp_path_factory) -> dict:
    folder: Path = tmp_path_factory.mktemp("flown")
    fly(folder, 4.0, faults=False)
    return decoded(folder / "rec" / "drone-1")


def xyz(v) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def rotation(q) -> np.ndarray:
    return from_quaternion((q.w, q.x, q.y, q.z))


def in_map(message, frame: str) -> Pose:
    """map_from_frame by the transforms of one message, as a viewer chains them."""
    by_child = {t.child_frame_id: t for t in message.transforms}
    pose = Pose.identity()
    while frame != "map":
        t = by_child[frame]
        pose = Pose(rotation(t.rotation), xyz(t.translation)) @ pose
        frame = t.parent_frame_id
    return pose


def test_teammates_stand_where_they_are_in_a_map_of_east_north_up(topics):
    truth = {d: pose.position for d, pose in load_scenario("hover-triangle").initial_poses.items()}
    scene, frames = topics["/scene"][-1], topics["/tf"][-1]
    assert {entity.id for entity in scene.entities} == {"2", "3"}
    for entity in scene.entities:
        north, east, down = truth[int(entity.id)]
        ellipsoid, ball = entity.spheres
        assert xyz(ellipsoid.pose.position) == pytest.approx(xyz(ball.pose.position))
        found = in_map(frames, entity.frame_id).transform(xyz(ball.pose.position)[None])[0]
        assert found == pytest.approx([east, north, -down], abs=0.8)
        assert entity.frame_id == "drone-1/ned"
        assert str(entity.timestamp) == str(frames.transforms[0].timestamp)


def test_labels_say_who_and_how_far(topics):
    for entity in topics["/scene"][-1].entities:
        (text,) = entity.texts
        distance = np.linalg.norm(xyz(entity.spheres[0].pose.position))
        assert text.text.startswith(f"drone {entity.id} {distance:.1f} m ± ")
        assert text.billboard


def test_boxes_in_the_picture_say_how_far_too(topics):
    names = [text.text for text in topics["/camera/annotations"][-1].texts]
    assert all(re.fullmatch(r"drone [23] \d\.\d m", name) for name in names), names


def test_the_camera_stands_in_the_map_as_it_is_mounted(topics):
    scenario = load_scenario("hover-triangle")
    start, mount = scenario.initial_poses[1], scenario.body_from_camera
    camera = in_map(topics["/tf"][0], "drone-1/camera")
    forward = (start.rotation @ mount.rotation)[:, 2]
    assert camera.rotation[:, 2] == pytest.approx(forward[[1, 0, 2]] * (1.0, 1.0, -1.0), abs=0.05)
    origin = in_map(topics["/tf"][0], "drone-1/ned").position
    assert camera.position == pytest.approx(origin, abs=1e-9)


def test_each_teammate_has_poses_with_covariance_to_plot(topics):
    scene, last = topics["/scene"][-1], topics["/teammates/2"][-1]
    assert last.frame_id == "drone-1/ned"
    (two,) = (entity for entity in scene.entities if entity.id == "2")
    assert xyz(last.pose.position) == pytest.approx(xyz(two.spheres[0].pose.position))
    cov = np.array(last.pose_covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(cov[:3, :3]).min() > 0.0
    assert not cov[3:].any()
    assert len(last.velocity_covariance) == 36


LENS = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480)  # 90° wide


def made(state: RelativeState | None, *, camera: int = 0, cameras: int = 1) -> dict:
    """By topic, decoded. cameras: how many, each 90° right of the one before."""
    mean = np.array([319.5, 0.0, 239.5, 0.0])
    track = Track(1, 0.0, mean, np.eye(4), TrackStatus.CONFIRMED, 1.0, np.array([9.0, 9.0]), camera=camera)
    entry = IdentifiedTrack(track, 2, 0.99, relative=state)
    report = ScanReport(0, TrackList(0.0, 0.0, (entry,)), camera)
    mountings = [
        Pose(from_euler(0.0, 0.0, 0.5 * np.pi * k) @ BODY_FROM_FORWARD_CAMERA, np.array([0.0, 0.1 * k, 0.0]))
        for k in range(cameras)
    ]
    scene = FoxgloveScene(1, [LENS] * cameras, mountings)
    here = Pose(BODY_FROM_FORWARD_CAMERA, np.zeros(3)) if cameras > 1 else None
    return {
        topic.name: message_class(topic.schema_name, topic.schema).FromString(data)
        for topic, data in scene.of_report(report, here, Timestamp(sec=1, nsec=0))
    }


def test_each_camera_has_a_frame_the_lines_around_its_view_and_a_calibration():
    told = made(None, camera=1, cameras=2)
    second = in_map(told["/tf"], "drone-1/camera-2")
    # The drone looks north; its second camera looks east, and sits 0.1 m there.
    assert second.rotation[:, 2] == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert second.position == pytest.approx([0.1, 0.0, 0.0], abs=1e-9)
    first_view, second_view = told["/cameras"].entities
    assert (first_view.frame_id, second_view.frame_id) == ("drone-1/camera", "drone-1/camera-2")
    border = np.array([xyz(point) for point in second_view.lines[0].points])
    assert np.abs(border[:, 0] / border[:, 2]).max() == pytest.approx(1.0)
    for topic, frame in (
        ("/camera/calibration", "drone-1/camera"),
        ("/camera/2/calibration", "drone-1/camera-2"),
    ):
        assert told[topic].frame_id == frame
        assert (told[topic].width, told[topic].K[0], told[topic].distortion_model) == (640, 320, "plumb_bob")


def test_a_ray_leaves_the_camera_that_sees_its_target():
    (ray,) = made(None, camera=1, cameras=2)["/rays"].entities
    assert ray.frame_id == "drone-1/camera-2"
    begin, end = (xyz(point) for point in ray.lines[0].points)
    assert begin == pytest.approx([0.0, 0.0, 0.0])
    assert end == pytest.approx([0.0, 0.0, 30.0])


def test_a_lens_is_told_by_the_name_that_viewers_know():
    for distortion, name, n in (
        (Equidistant((0.1, 0.0, 0.0, 0.0)), "kannala_brandt", 4),
        (RadTan((0.1, 0.0, 0.0, 0.0)), "plumb_bob", 5),
        (RadTan((0.1,) + (0.0,) * 7), "rational_polynomial", 8),
    ):
        lens = PinholeCamera(320.0, 320.0, 319.5, 239.5, 640, 480, distortion)
        topic = CALIBRATIONS[0]
        data = calibration(lens, "x", Timestamp(sec=1, nsec=0)).encode()
        told = message_class(topic.schema_name, topic.schema).FromString(data)
        assert (told.distortion_model, len(told.D), told.D[0]) == (name, n, 0.1)


def test_the_ellipsoid_is_three_sigmas_along_the_axes_of_the_covariance():
    """Known to 0.1, 0.2 and 2 m along axes that are turned."""
    turn = from_quaternion((0.8, 0.2, -0.4, 0.4))
    cov = np.eye(6)
    cov[:3, :3] = turn @ np.diag([0.01, 0.04, 4.0]) @ turn.T
    state = RelativeState(2, 0.0, np.array([8.0, 1.0, 0.0]), np.zeros(3), cov, 0.2, ("size",))
    (entity,) = made(state)["/scene"].entities
    ellipsoid = entity.spheres[0]
    axes, diameters = rotation(ellipsoid.pose.orientation), xyz(ellipsoid.size)
    assert sorted(diameters) == pytest.approx([0.6, 1.2, 12.0])
    assert axes @ np.diag((diameters / 6.0) ** 2) @ axes.T == pytest.approx(cov[:3, :3], abs=1e-9)


def test_a_teammate_without_a_place_is_not_in_the_scene():
    assert "/scene" not in made(None)
