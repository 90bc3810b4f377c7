"""[output] ros2: an agent's own topics, on a real router; and what is refused."""

from __future__ import annotations

import asyncio
import secrets
import struct

import pytest

from support.patience import eventually

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.network_of_keys import free_addresses
from swarmtrack.agents.main import main
from swarmtrack.benchmarks.lone_agent import agent_process
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import OutputSection
from swarmtrack.config.ros2 import Ros2Section
from swarmtrack.errors import TransportError
from swarmtrack.outputs.ros2.connection import ros2_network
from swarmtrack.outputs.ros2.node import RosNode
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_session import close_session, open_session

CAMERA = {"fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 256.0, "width": 640, "height": 512}
ENTRIES = {
    "drone.id": 7,
    "autopilot.link": "none",
    "drone.start.position_m": [1.0, 2.0, -3.0],
    "camera.source": "http://127.0.0.1:9/",  # never opened: the scripted camera takes its place
    **{f"camera.intrinsics.{name}": value for name, value in CAMERA.items()},
    "output.ros2.domain": 5,
    "output.ros2.namespace": "red",
}
HUMBLE = "TypeHashNotSupported"


def settings(address: str, serve: bool) -> NetworkSettings:
    return ros2_network(address, "router", serve=serve, insecure=False)


async def test_an_agent_joins_a_router_that_comes_later_and_says_only_what_is_subscribed_to():
    (address,) = free_addresses(1)
    entries = {**ENTRIES, "network.team": f"test-{secrets.token_hex(4)}", "output.ros2.router": address}
    heard: dict[str, bytes] = {}
    with agent_process(["swarmtrack.benchmarks.scripted_agent", "--fps", "20"], entries):
        await asyncio.sleep(2.0)  # it looks for a router in vain
        router = await open_session(settings(address, serve=True))
        client = await open_session(settings(address, serve=False))
        try:
            tokens: set[str] = set()
            client.liveliness().declare_subscriber(
                "@ros2_lv/5/**", lambda token: tokens.add(str(token.key_expr)), history=True
            )
            await eventually(lambda: any("%red%d7%odometry" in token for token in tokens))
            client.declare_subscriber(
                "5/red/d7/**", lambda sample: heard.update({str(sample.key_expr): sample.payload.to_bytes()})
            )
            await eventually(
                lambda: {key.split("/")[3] for key in heard} >= {"odometry", "teammates", "image"}
            )
        finally:
            await close_session(client, [])
            await close_session(router, [], (f"tcp/{address}",))
    (odometry,) = [payload for key, payload in heard.items() if "/odometry/" in key]
    assert struct.pack("<3d", 2.0, 1.0, 3.0) in odometry  # of the start, north 1, east 2, 3 m up
    assert b"red/d7/base_link\0" in odometry
    (picture,) = [payload for key, payload in heard.items() if "/image/" in key]
    assert b"jpeg\0" in picture
    assert b"\xff\xd8" in picture


async def test_humble_has_no_hashes_and_topics_of_one_drone_can_be_taken_back():
    (address,) = free_addresses(1)
    node = RosNode(settings(address, serve=True), Ros2Section(distro="humble"), "n", SystemClock())
    await node.open()
    client = await open_session(settings(address, serve=False))
    try:
        for drone in (1, 12):
            node.declare(f"/swarm/d{drone}/odometry", "nav_msgs/msg/Odometry")

        def listed() -> list[str]:
            replies = client.liveliness().get("@ros2_lv/0/*/0/*/MP/**", timeout=1.0)
            return [
                str(reply.ok.key_expr).split("/")[9] for reply in replies if HUMBLE in str(reply.ok.key_expr)
            ]

        await eventually(lambda: sorted(listed()) == ["%swarm%d1%odometry", "%swarm%d12%odometry"])
        await node.forget("/swarm/d1/")
        await eventually(lambda: listed() == ["%swarm%d12%odometry"])
    finally:
        await close_session(client, [])
        await node.close()


async def test_a_type_without_a_hash_is_refused_by_name():
    node = RosNode(settings("127.0.0.1:7447", serve=False), Ros2Section(), "n", SystemClock())
    with pytest.raises(
        ValueError, match=r"/x: found type px4_msgs/msg/SensorGps, expected of diagnostic_msgs"
    ):
        node.declare("/x", "px4_msgs/msg/SensorGps")


async def test_clashes_on_the_port_of_ros_2_say_what_to_do():
    (address,) = free_addresses(1)
    agent = await open_session(NetworkSettings(listen=(f"tcp/{address}",)))
    try:
        for serve, words in ((False, "is no router: agents with"), (True, "cannot be its router at")):
            node = RosNode(settings(address, serve=serve), Ros2Section(), "n", SystemClock())
            with pytest.raises(TransportError, match=words) as raised:
                await node.open()
            assert "ZENOH_CONFIG_OVERRIDE" in str(raised.value)
    finally:
        await close_session(agent, [], (f"tcp/{address}",))


def test_another_machine_needs_consent():
    with pytest.raises(TransportError, match=r"10\.0\.0\.1 is not on this machine, and ROS 2 has no keys"):
        ros2_network("10.0.0.1", "--router", serve=False, insecure=False)
    assert ros2_network("10.0.0.1", "--router", serve=False, insecure=True).connect == ("tcp/10.0.0.1:7447",)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--router", "10.0.0.1"], "expected 127.0.0.1, or insecure"),
        (["--domain", "999"], "domain: 999, expected less than or equal to 232"),
        (["--namespace", "9x"], 'namespace: "9x", expected first part of topics'),
        (["--distro", "foxy"], "distro: \"foxy\", expected 'jazzy', 'kilted' or 'humble'"),
    ],
)
def test_wrong_options_are_wrong_usage(options, words, capsys):
    assert main(["ros2", *options]) == 2
    assert words in capsys.readouterr().err


def test_true_in_a_config_means_all_defaults():
    assert OutputSection(ros2=True).ros2 == Ros2Section()
    assert OutputSection(ros2=False).ros2 is None
    assert OutputSection(ros2={"hz": 5.0}).ros2 == Ros2Section(hz=5.0)
