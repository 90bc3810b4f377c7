"""A ROS 2 user sees the swarm: judged by rclpy and others, in another process, over real Zenoh."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import secrets
import sys
from contextlib import asynccontextmanager, nullcontext

import numpy as np
import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.network_of_keys import free_addresses
from support.patience import PATIENCE
from support.places import ROOT
from support.ros2_command import ENVIRONMENT, bridge
from swarmtrack.benchmarks.scripted_team import CAMERA, CLOCK, scripted_team
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA, from_quaternion
from swarmtrack.transport.settings import Mode, NetworkSettings
from swarmtrack.transport.zenoh_session import close_session, open_session

JUDGES = ("rclpy", "rosbags", "zenoh_ros2_sdk", "pamoja")
MISSING = [name for name in JUDGES if importlib.util.find_spec(name) is None]
pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(
        bool(MISSING), reason=f"{', '.join(MISSING)}: not installed (`pip install '.[ros2-test]'`)"
    ),
]

NED, FRD = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1.0, -1, -1])
EXACT = {"rtol": 0.0, "atol": 1e-6}
OF_EACH = {
    "odometry": "nav_msgs/msg/Odometry",
    "teammates": "geometry_msgs/msg/PoseArray",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "image/compressed": "sensor_msgs/msg/CompressedImage",
    "detections": "vision_msgs/msg/Detection2DArray",
}
OF_EACH_TEAMMATE = {
    "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "twist": "geometry_msgs/msg/TwistWithCovarianceStamped",
}
EXPECTED = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/swarm/markers": "visualization_msgs/msg/MarkerArray",
    **{f"/swarm/d{i}/{name}": kind for i in (1, 2, 3) for name, kind in OF_EACH.items()},
    **{
        f"/swarm/d{i}/teammate{j}/{name}": kind
        for i in (1, 2, 3)
        for j in (1, 2, 3)
        if i != j
        for name, kind in OF_EACH_TEAMMATE.items()
    },
}


async def judged(port, topics):
    process = await asyncio.create_subprocess_exec(
        sys.executable, ROOT / "tests" / "support" / "ros2_judge.py", str(port), *topics,
        cwd=ROOT, env=ENVIRONMENT | {"ROS_DOMAIN_ID": "77"}, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    out, _ = await asyncio.wait_for(process.communicate(), PATIENCE)
    return json.loads(out.splitlines()[-1])


@asynccontextmanager
async def plain_router(address):
    """As rmw_zenohd is one, in this process."""
    endpoint = f"tcp/{address}"
    session = await open_session(NetworkSettings(mode=Mode.ROUTER, listen=(endpoint,)))
    try:
        yield
    finally:
        await close_session(session, [], (endpoint,))


@pytest.fixture(scope="module", params=["--serve", "--router"])
def heard(request):
    """All that the judge found of three drones, and the drones, which know the truth. Either the bridge is the router
    of ROS 2, or it joins another one."""

    async def fly():
        team, address = f"test-{secrets.token_hex(4)}", free_addresses(1)[0]
        router = plain_router(address) if request.param == "--router" else nullcontext()
        async with router, scripted_team(team, 3) as drones, bridge(team, request.param, address):
            return await judged(address.rpartition(":")[2], EXPECTED), drones

    return asyncio.run(fly())


def stamp(drone, header):
    """What the drone's clock showed."""
    utc = header["stamp"]["sec"] + 1e-9 * header["stamp"]["nanosec"]
    told, t = min(drone.told, key=lambda each: abs(each[0] - utc))
    assert abs(told - utc) < 1e-6
    return t


def vector(said):
    return np.array([said[axis] for axis in "xyz"])


def rotation(said):
    return from_quaternion(np.array([said[axis] for axis in "wxyz"]))


def test_all_topics_are_listed_and_decoded_within_five_seconds(heard):
    found, _ = heard
    assert {name: found["topics"].get(name) for name in EXPECTED} == EXPECTED
    assert {name: len(found["messages"][name]) >= 2 for name in EXPECTED} == dict.fromkeys(EXPECTED, True)
    assert found["seconds"] < 5.0


def test_every_message_has_its_number_time_and_sender(heard):
    found, _ = heard
    for topic in EXPECTED:
        numbers, times, lengths = zip(*found["attachments"][topic], strict=True)
        assert list(numbers) == list(range(numbers[0], numbers[0] + len(numbers))), topic
        assert set(lengths) == {16}
        assert abs(times[0] - CLOCK.utc()) < PATIENCE


def test_teammates_are_where_the_truth_is_in_enu(heard):
    found, drones = heard
    for i in (1, 2, 3):
        for j in {1, 2, 3} - {i}:
            for message in found["messages"][f"/swarm/d{i}/teammate{j}/pose"]:
                t = stamp(drones[i - 1], message["header"])
                truth = NED @ (drones[j - 1].position(t) - drones[i - 1].position(t))
                assert message["header"]["frame_id"] == f"swarm/d{i}/camera_enu"
                np.testing.assert_allclose(vector(message["pose"]["pose"]["position"]), truth, **EXACT)
                towards = truth / np.linalg.norm(truth)
                cov = np.array(message["pose"]["covariance"]).reshape(6, 6)[:3, :3]
                assert towards @ cov @ towards == pytest.approx((0.05 * np.linalg.norm(truth)) ** 2)
            for message in found["messages"][f"/swarm/d{i}/teammate{j}/twist"]:
                t = stamp(drones[i - 1], message["header"])
                now, then = (
                    NED @ (drones[j - 1].position(s) - drones[i - 1].position(s)) for s in (t, t - 0.1)
                )
                np.testing.assert_allclose(
                    vector(message["twist"]["twist"]["linear"]), (now - then) / 0.1, atol=1e-5
                )
        for message in found["messages"][f"/swarm/d{i}/teammates"]:
            t = stamp(drones[i - 1], message["header"])
            truth = [
                NED @ (drones[j - 1].position(t) - drones[i - 1].position(t)) for j in (1, 2, 3) if j != i
            ]
            np.testing.assert_allclose(
                [vector(pose["position"]) for pose in message["poses"]], truth, **EXACT
            )


def test_odometry_is_where_the_truth_is_in_enu_and_flu(heard):
    found, drones = heard
    bodies = 0
    for drone in drones:
        for message in found["messages"][f"/swarm/d{drone.drone_id}/odometry"]:
            t, pose = stamp(drone, message["header"]), message["pose"]["pose"]
            assert message["header"]["frame_id"] == "map"
            np.testing.assert_allclose(vector(pose["position"]), NED @ drone.position(t), **EXACT)
            if message["child_frame_id"].endswith("/base_link"):
                bodies += 1
                np.testing.assert_allclose(rotation(pose["orientation"]), NED @ drone.body(t) @ FRD, **EXACT)
            else:
                assert message["child_frame_id"] == f"swarm/d{drone.drone_id}/camera_enu"
    assert bodies  # pictures were looked at, so attitudes were heard


def test_the_tree_of_frames_has_no_loop_and_leads_to_what_cameras_see(heard):
    found, drones = heard
    parents: dict[str, set[str]] = {}
    placed = {}
    for topic in ("/tf", "/tf_static"):
        for message in found["messages"][topic]:
            for transform in message["transforms"]:
                child, parent = transform["child_frame_id"], transform["header"]["frame_id"]
                parents.setdefault(child, set()).add(parent)
                placed[child] = transform
    assert all(len(each) == 1 for each in parents.values())
    tree = {child: next(iter(each)) for child, each in parents.items()}
    for child in tree:
        seen = [child]
        while seen[-1] in tree:
            seen.append(tree[seen[-1]])
            assert len(seen) == len(set(seen)), seen
    optical = [child for child in placed if child.endswith("/camera_optical")]
    assert optical
    for child in optical:
        mounted = rotation(placed[child]["transform"]["rotation"])
        np.testing.assert_allclose(mounted, FRD @ BODY_FROM_FORWARD_CAMERA, **EXACT)  # z ahead: x of FLU
    bodies = [child for child in placed if child.endswith("/base_link")]
    for child in bodies:
        drone, transform = drones[int(child.split("/")[1][1:]) - 1], placed[child]
        t = stamp(drone, transform["header"])
        np.testing.assert_allclose(
            vector(transform["transform"]["translation"]), NED @ drone.position(t), **EXACT
        )
        np.testing.assert_allclose(
            rotation(transform["transform"]["rotation"]), NED @ drone.body(t) @ FRD, **EXACT
        )


def test_boxes_pictures_and_lenses_fit_together(heard):
    found, drones = heard
    for drone in drones:
        prefix = f"/swarm/d{drone.drone_id}"
        picture, info = (
            found["messages"][f"{prefix}/{name}"][-1] for name in ("image/compressed", "camera_info")
        )
        assert (picture["format"], picture["data"] > 1000) == ("jpeg", True)
        assert (
            picture["header"]["frame_id"]
            == info["header"]["frame_id"]
            == f"swarm/d{drone.drone_id}/camera_optical"
        )
        assert (info["width"], info["height"], info["k"][0]) == (CAMERA.width, CAMERA.height, CAMERA.fx)
        for message in found["messages"][f"{prefix}/detections"]:
            t = stamp(drone, message["header"])
            assert {box["results"][0]["hypothesis"]["class_id"] for box in message["detections"]} == {
                str(other.drone_id) for other in drones if other is not drone
            }
            for box in message["detections"]:
                other = drones[int(box["id"]) - 1]
                x, y, z = drone.camera(t).T @ (other.position(t) - drone.position(t))
                centre = box["bbox"]["center"]["position"]
                expected = [CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy]
                np.testing.assert_allclose([centre["x"], centre["y"]], expected, atol=1e-3)


def test_diagnostics_and_markers_speak_of_every_drone(heard):
    found, _ = heard
    names = {status["name"] for message in found["messages"]["/diagnostics"] for status in message["status"]}
    assert names & {"swarmtrack: drone 1", "swarmtrack: drone 2", "swarmtrack: drone 3"}
    assert any(name.endswith(": autopilot") for name in names)
    for message in found["messages"]["/swarm/markers"]:
        kinds = {marker["ns"].split("/")[-1] for marker in message["markers"]}
        assert {"balls", "names", "ellipsoids", "rays"} <= kinds


def test_another_implementation_mangles_topics_and_types_in_the_same_way(heard):
    from pamoja import ros2  # noqa: PLC0415 - an extra

    found, _ = heard
    tokens = [token.split("/") for token in found["tokens"] if "/MP/" in token]
    assert any("/NN/%/%/swarmtrack" in token for token in found["tokens"])
    said = {token[9]: token for token in tokens if token[8] == "swarmtrack"}
    for name, kind in EXPECTED.items():
        token = said[ros2.percent_mangle(name)]
        assert token[10] == ros2.dds_type_name(kind)
        assert ros2.entity_key(0, name, kind, token[11]) == f"0{name}/{token[10]}/{token[11]}"
