"""What the bridge to ROS 2 makes of a team's messages: places, stamps and what is no news. No ROS."""

import secrets
import struct

import numpy as np
import pytest

from support.patience import eventually
from support.ros2_command import bridge
from support.seen_swarm import FORWARD, LENS, UTC, healthy, seen

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.network_of_keys import free_addresses
from swarmtrack.benchmarks.scripted_team import scripted_team
from swarmtrack.client.ros2_bridge import SpokenPlace, TeamBridge
from swarmtrack.clock import ManualClock
from swarmtrack.geometry.rotation import from_euler, to_quaternion
from swarmtrack.outputs.ros2.connection import ros2_network
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.zenoh_session import close_session, open_session
from swarmtrack.wire import codec
from swarmtrack.wire.camera import camera_message
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.motion import MotionMessage
from swarmtrack.wire.sightings import NOWHERE_SIGMA_M, SightingsMessage
from swarmtrack.wire.video import VideoMessage

BOOT = "0123abcd"
TRIANGLE = (0.04, 0.0, 0.0, 0.04, 0.0, 0.04)


def sightings(position, sigma=0.5, sequence=1, t=UTC):
    return SightingsMessage(1, 1, BOOT, sequence, t, 0.01, 0.0, position, sigma, (), ())


def motion(displacement, velocity, boot=BOOT, sequence=1, t=UTC):
    return MotionMessage(1, 1, boot, sequence, t, 0.01, 0.0, displacement, TRIANGLE, velocity, TRIANGLE)


def test_between_sightings_a_drone_is_carried_on_by_its_displacement():
    spoken = SpokenPlace()
    assert spoken.on_motion(motion((5.0, 0.0, 0.0), (2.0, 0.0, 0.0)), UTC) is None  # from where?
    place = spoken.on_sightings(sightings((10.0, 3.0, -2.0)), UTC + 0.1)
    np.testing.assert_allclose(place.position, [10.0, 3.0, -2.0])
    np.testing.assert_allclose(place.velocity, [2.0, 0.0, 0.0])
    np.testing.assert_allclose(place.position_cov, 0.25 * np.eye(3))
    place = spoken.on_motion(motion((5.6, 0.0, 0.0), (2.0, 0.0, 0.0)), UTC + 0.3)
    np.testing.assert_allclose(place.position, [10.4, 3.0, -2.0])  # 0.2 s later at 2 m/s


def test_another_boot_and_a_drone_that_is_nowhere_have_no_place():
    spoken = SpokenPlace()
    spoken.on_motion(motion((5.0, 0.0, 0.0), (0.0, 0.0, 0.0)), UTC)
    spoken.on_sightings(sightings((10.0, 3.0, -2.0)), UTC)
    assert spoken.on_motion(motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), boot="89abcdef"), UTC + 0.2) is None
    assert spoken.on_sightings(sightings((0.0, 0.0, 0.0), NOWHERE_SIGMA_M), UTC + 0.3) is None


def test_a_picture_says_where_the_body_is_and_is_better_than_sightings():
    spoken, attitude = SpokenPlace(), from_euler(0.1, 0.2, 0.3)
    camera = attitude @ FORWARD.rotation, np.array([1.0, 2.0, -3.0]) + attitude @ FORWARD.position
    view = VideoMessage(
        1, UTC, 0.01, 1, 640, 480, b"\xff", lens_message(LENS),
        tuple(camera[1].tolist()), tuple(to_quaternion(camera[0]).tolist()),
    )  # fmt: skip
    place = spoken.on_video(view, FORWARD, UTC)
    np.testing.assert_allclose(place.position, [1.0, 2.0, -3.0])
    np.testing.assert_allclose(place.world_from_body, attitude, atol=1e-12)
    assert spoken.on_sightings(sightings((9.0, 9.0, 9.0)), UTC + 0.1) is None
    assert spoken.on_sightings(sightings((9.0, 9.0, 9.0)), UTC + 1.0).world_from_body is None


class Node:
    """Somebody subscribes to everything."""

    def __init__(self):
        self.topics, self.said = set(), []

    def declare(self, topic, kind, qos=""):
        self.topics.add(topic)

    def offer(self, topic, kind, make, qos=""):
        self.topics.add(topic)
        self.said.append((topic, make()))

    def has_listener(self, topic):
        return True

    async def forget(self, prefix):
        self.topics = {topic for topic in self.topics if not topic.startswith(prefix)}

    def stamps(self, topic):
        return [leaves[0] + 1e-9 * leaves[1] for name, leaves in self.said if name == topic]


class Listener:
    def __init__(self):
        self.keys = set()

    async def listen_to(self, key):
        self.keys.add(key)

    async def leave(self, key):
        self.keys.discard(key)


@pytest.fixture
def bridged():
    node, clock = Node(), ManualClock(12.5, UTC)
    bridge = TeamBridge("red", node, namespace="swarm", hz=50.0, clock=clock)
    bridge.on_sample(Sample(keys.key("red", Kind.ALIVE, 1, BOOT), b"", True, 0.0))
    return bridge, node, clock


def say(bridge, clock, kind, message):
    bridge.on_sample(Sample(keys.key("red", kind, 1), codec.encode(message), True, clock.now()))


def test_what_is_repeated_is_not_said_again(bridged):
    bridge, node, clock = bridged
    for sequence in (1, 1, 2, 1, 3):
        say(bridge, clock, Kind.TRACKS, seen(sequence))
    assert node.stamps("/swarm/d1/teammates") == pytest.approx([UTC + k / 50 for k in (1, 2, 3)], abs=1e-6)


def test_a_drone_whose_clock_is_hours_off_is_stamped_with_our_time(bridged):
    bridge, node, clock = bridged
    clock.set(3600.0 + 12.5)
    say(bridge, clock, Kind.TRACKS, seen(1))
    assert node.stamps("/swarm/d1/teammates") == pytest.approx([UTC + 3600.0], abs=1e-6)


async def test_pictures_are_asked_for_while_wanted_and_a_drone_that_is_gone_has_no_topics(bridged):
    bridge, node, clock = bridged
    listener = Listener()
    await bridge.follow(listener)
    assert listener.keys == set()  # its cameras are unknown
    say(bridge, clock, Kind.CAMERA, camera_message(1, BOOT, [LENS, LENS], [FORWARD, FORWARD]))
    say(bridge, clock, Kind.HEALTH, healthy(BOOT))
    await bridge.follow(listener)
    assert listener.keys == {keys.video_key("red", 1), keys.video_key("red", 1, 1)}
    assert "/swarm/d1/camera2/camera_info" in node.topics
    bridge.on_sample(Sample(keys.key("red", Kind.ALIVE, 1, BOOT), b"", False, clock.now()))
    await bridge.follow(listener)
    assert not any(topic.startswith("/swarm/d1/") for topic in node.topics)
    assert listener.keys == set()


@pytest.mark.parametrize("payload", [b"", b"\x93\x01\x02\x03", struct.pack("<d", 1.0)])
def test_what_cannot_be_read_and_strangers_are_ignored(bridged, payload):
    bridge, node, clock = bridged
    for kind in (Kind.TRACKS, Kind.HEALTH, Kind.IDENTITIES, Kind.MOTION, Kind.VIDEO, Kind.CAMERA):
        bridge.on_sample(Sample(keys.key("red", kind, 1), payload, True, clock.now()))
        bridge.on_sample(Sample(keys.key("red", kind, 9), payload, True, clock.now()))
        bridge.on_sample(Sample(keys.key("blue", kind, 1), payload, True, clock.now()))
    assert node.said == []


@pytest.mark.live
async def test_the_command_shows_a_team_its_pictures_included_and_ends_cleanly():
    team, (address,) = f"test-{secrets.token_hex(4)}", free_addresses(1)
    async with scripted_team(team, 2), bridge(team, "--serve", address) as line:
        assert f"is the router at tcp/{address}" in line
        client = await open_session(ros2_network(address, "router", serve=False, insecure=False))
        heard = set()
        client.declare_subscriber("0/**", lambda sample: heard.add(str(sample.key_expr).split("/", 1)[1]))
        for name in (
            "tf_static",
            "swarm/markers",
            "swarm/d2/odometry",
            "swarm/d1/image/compressed",
            "diagnostics",
        ):
            await eventually(lambda name=name: any(each.startswith(f"{name}/") for each in heard), name)
        await close_session(client, [])
