"""What the page gets of a drone with several cameras: a picture of each, and all directions around it."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.seen_swarm import LENS, UTC, seen, teammate
from swarmtrack.clock import ManualClock
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA, from_euler, to_quaternion
from swarmtrack.monitor.drone_cameras import DroneCameras, SeenAround
from swarmtrack.monitor.overlay import boxes
from swarmtrack.monitor.team import MonitoredTeam
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.camera import camera_message
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.video import VideoMessage

HALF_DEG = math.degrees(math.atan(320.0 / 400.0))  # of LENS: 38.7


def mounting(yaw_deg: float, *position: float) -> Pose:
    turn = from_euler(0.0, 0.0, math.radians(yaw_deg))
    return Pose(turn @ BODY_FROM_FORWARD_CAMERA, np.array(position or (0.0, 0.0, 0.0)))


def told(*yaws_deg: float) -> bytes:
    mountings = [mounting(yaw) for yaw in yaws_deg]
    return codec.encode(camera_message(1, "00000001", [LENS] * len(yaws_deg), mountings))


def view() -> VideoMessage:
    return VideoMessage(1, UTC, 0.05, 1, 320, 240, b"", lens_message(LENS), (0.0, 0.0, -2.0), None)


def in_camera(number: int, *, u: float = 320.0, metres: bool = True):
    one = teammate()
    mean = np.array([u, 0.0, 240.0, 0.0])
    one = replace(one, track=one.track._replace(camera=number, mean=mean))
    return one if metres else replace(one, relative=None)


class Heard:
    """A monitored team that hears drone 1."""

    def __init__(self) -> None:
        self.clock = ManualClock(100.0, UTC)
        self.team = MonitoredTeam("red", self.clock)
        self.say(Kind.ALIVE, b"", "00000001")

    def say(self, kind: Kind, payload: bytes, *rest: str):
        return self.team.on_sample(Sample(keys.key("red", kind, 1, *rest), payload, True, self.clock.now()))

    @property
    def drone(self) -> dict:
        (drone,) = json.loads(json.dumps(self.team.state(), allow_nan=False))["drones"]
        return drone


def test_of_one_camera_there_is_nothing_around():
    heard = Heard()
    heard.say(Kind.CAMERA, told(0.0))
    heard.say(Kind.TRACKS, codec.encode(seen()))
    assert heard.drone["cameras"] == 1
    assert heard.drone["around"] is None
    assert heard.team.cameras == ((1, 0),)


def test_each_track_is_where_its_own_camera_sees_it():
    """In the middle of each of four; the last is a degree left of its camera's axis."""
    heard = Heard()
    heard.say(Kind.CAMERA, told(0.0, 90.0, 180.0, -90.0))
    off = 400.0 * math.tan(math.radians(1.0))
    for number, right_deg in enumerate((0.0, 90.0, 180.0, -91.0)):
        one = in_camera(number, u=320.0 - off if number == 3 else 320.0)
        heard.say(Kind.TRACKS, codec.encode(seen(1, one)))
        (track,) = (SeenAround(*fields) for fields in heard.drone["around"]["tracks"])
        assert (abs(track.right_deg) if number == 2 else track.right_deg) == pytest.approx(right_deg)
        assert (track.identity, track.camera, track.up_deg) == (2, number, 0.0)
        assert track.width_deg == pytest.approx(math.degrees(20.0 / 400.0), rel=0.01)
        assert track.height_deg == pytest.approx(math.degrees(10.0 / 500.0), rel=0.01)
        assert track.distance_m == pytest.approx(math.sqrt(101.0), abs=0.01)


def test_the_fields_of_view_are_drawn_where_the_cameras_look():
    heard = Heard()
    heard.say(Kind.CAMERA, told(0.0, 90.0))
    heard.say(Kind.TRACKS, codec.encode(seen(1, in_camera(0))))
    ahead, right = (np.array(line) for line in heard.drone["around"]["outlines"])
    assert (ahead[:, 0].min(), ahead[:, 0].max()) == pytest.approx((-HALF_DEG, HALF_DEG), abs=0.2)
    assert (right[:, 0].min(), right[:, 0].max()) == pytest.approx((90 - HALF_DEG, 90 + HALF_DEG), abs=0.2)


def test_a_view_is_of_the_camera_in_its_key_and_nonsense_in_a_key_is_nobodys():
    heard = Heard()
    payload = codec.encode(view())
    assert heard.say(Kind.VIDEO, payload).key == (1, 0)
    assert heard.say(Kind.VIDEO, payload, "3").key == (1, 3)
    for rest in (("8",), ("0",), ("x",), ("1", "2"), ("-1",), ("01",)):
        assert heard.say(Kind.VIDEO, payload, *rest) is None, rest
    assert heard.team.cameras == tuple((1, k) for k in range(4))
    heard.say(Kind.CAMERA, told(0.0, 90.0))
    assert heard.team.cameras == ((1, 0), (1, 1))
    assert heard.team.last_view((1, 3)) is None


def test_the_map_has_a_wedge_for_each_camera_that_is_looked_at_but_none_for_one_that_looks_down():
    heard = Heard()
    for number, rotation in enumerate(
        (mounting(0.0).rotation, mounting(90.0).rotation, np.eye(3))  # NED axes: along down
    ):
        quaternion = tuple(to_quaternion(rotation).tolist())
        message = msgspec.structs.replace(view(), quaternion_wxyz=quaternion)
        heard.say(Kind.VIDEO, codec.encode(message), *([str(number)] if number else []))
    north, east = heard.drone["wedges"]
    assert north == pytest.approx([1.0, 0.0, 2.0 * math.radians(HALF_DEG)], abs=1e-3)
    assert east == pytest.approx([0.0, 1.0, 2.0 * math.radians(HALF_DEG)], abs=1e-3)


# --- boxes in the pictures ------------------------------------------------------------------------


def rig(*mountings: Pose) -> DroneCameras:
    return DroneCameras((LENS,) * len(mountings), mountings)


def test_a_picture_has_the_boxes_of_its_own_camera():
    two = rig(mounting(0.0), mounting(90.0))
    tracks = seen(1, in_camera(1))
    assert boxes(view(), tracks, 0, two) == []
    (box,) = boxes(view(), tracks, 1, two)
    assert box["box"] == [160.0, 120.0, 10.0, 5.0]
    assert boxes(view(), tracks, 1) == [box]  # nobody need have told of the cameras


def test_where_pictures_overlap_both_have_the_box():
    """60° apart: 30° right in one is 30° left in the other, and so wide as a track is there."""
    two = rig(mounting(0.0), mounting(60.0))
    off = 400.0 * math.tan(math.radians(30.0))
    tracks = seen(1, in_camera(0, u=320.0 + off, metres=False))
    (own,), (other,) = (boxes(view(), tracks, number, two) for number in (0, 1))
    assert own["box"][:2] == pytest.approx([0.5 * (320.0 + off), 120.0], abs=0.1)
    assert other["box"][:2] == pytest.approx([0.5 * (320.0 - off), 120.0], abs=0.1)
    assert other["box"][2:] == pytest.approx(own["box"][2:], rel=0.05)
    assert other["ellipse"] == pytest.approx(own["ellipse"], abs=0.2)
    assert (own["track"], own["identity"]) == (other["track"], other["identity"])


def test_how_far_cameras_sit_apart_is_in_the_box_where_the_distance_is_known():
    """The other camera is 1 m to the right, the teammate ten metres ahead."""
    two = rig(mounting(0.0), mounting(0.0, 0.0, 1.0, 0.0))
    (near,) = boxes(view(), seen(1, in_camera(0)), 1, two)
    (far,) = boxes(view(), seen(1, in_camera(0, metres=False)), 1, two)
    assert near["box"][0] == pytest.approx(160.0 - 0.5 * 400.0 / math.sqrt(101.0), abs=0.1)
    assert far["box"][0] == pytest.approx(160.0, abs=0.1)
