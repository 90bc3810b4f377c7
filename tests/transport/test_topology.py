"""What each process of a team listens on and dials, and what a wrong [network] is told."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import secrets
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from support.patience import PATIENCE, eventually
from support.places import ROOT

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.network_of_keys import Drone, Team, free_addresses
from swarmtrack.config.drone import NetworkSection, load_team_config
from swarmtrack.errors import ConfigError, TransportError
from swarmtrack.security.roster import Roster
from swarmtrack.transport import topology
from swarmtrack.transport.access_control import access_control
from swarmtrack.transport.limits import DATAGRAM_LINK_CHECKS
from swarmtrack.transport.link_watch import LinksUp, LinkWatch
from swarmtrack.transport.ports import wait_for_ports
from swarmtrack.transport.settings import Mode, NetworkSettings, check
from swarmtrack.transport.zenoh_session import close_session, open_session

PEERS = {"1": "10.0.0.11", "2": "10.0.0.12:7500", "3": "[fd00::3]:7500"}
ROUTERS = ("10.0.0.1", "10.0.0.2:7500", "10.0.0.3")


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> Team:
    return Team(tmp_path_factory.mktemp("keys"), "1", "2", "3", "monitor", "router-a", "router-b", name="red")


# --- who dials whom ---------------------------------------------------------------------


def test_in_a_mesh_each_listens_on_its_own_address_and_dials_the_lower(team: Team) -> None:
    network = topology.of_drone(NetworkSection(team="red", peers=PEERS), 2, team.credentials("2"))
    check(network)
    assert network.mode == Mode.PEER
    assert network.listen == ("tls/10.0.0.12:7500?rel=1", "quic/10.0.0.12:7501?mixed_rel=1")
    assert network.connect == ("tls/10.0.0.11:7447?rel=1", "quic/10.0.0.11:7448?mixed_rel=1")
    assert network.expected == ("drone-1", "drone-3")


def test_without_keys_it_is_tcp_and_off_loopback_refused_unless_insecure() -> None:
    section = NetworkSection(peers=PEERS)
    network = topology.of_drone(section, 3, None)
    assert network.listen == ("tcp/[fd00::3]:7500",)
    assert network.connect == ("tcp/10.0.0.11:7447", "tcp/10.0.0.12:7500")
    with pytest.raises(
        TransportError, match=r"without keys anyone there can pose.*swarmtrack keys.*insecure = true"
    ):
        check(network)
    check(topology.of_drone(section.model_copy(update={"insecure": True}), 3, None))


def test_an_address_to_listen_on_goes_before_ones_own_in_the_list() -> None:
    section = NetworkSection(peers=PEERS, listen=("0.0.0.0",), connect=("tcp/10.9.9.9:1",), insecure=True)
    network = topology.of_drone(section, 1, None)
    assert network.listen == ("tcp/0.0.0.0:7447",)
    assert network.connect == ("tcp/10.9.9.9:1",)


def test_a_monitor_dials_every_drone_because_peers_relay_nothing(team: Team) -> None:
    network = topology.of_monitor(NetworkSection(team="red", peers=PEERS), team.credentials("monitor"))
    assert (network.mode, network.listen, len(network.connect)) == (Mode.PEER, (), 6)


def test_with_routers_drones_and_monitors_are_clients_of_all_of_them(team: Team) -> None:
    section = NetworkSection(team="red", topology="routers", routers=ROUTERS, peers=PEERS)
    expected = tuple(
        f"quic/{address}?mixed_rel=1" for address in ("10.0.0.1:7447", "10.0.0.2:7500", "10.0.0.3:7447")
    )
    for network in (
        topology.of_drone(section, 9, team.credentials("1")),
        topology.of_monitor(section, team.credentials("monitor")),
    ):
        check(network)
        assert (network.mode, network.listen, network.connect) == (Mode.CLIENT, (), expected)


def test_a_router_dials_those_before_it_in_the_list(team: Team) -> None:
    section = NetworkSection(team="red", topology="routers", routers=ROUTERS)
    network = topology.of_router(section, "10.0.0.2:7500", team.credentials("router-a"))
    check(network)
    assert network.mode == Mode.ROUTER
    assert network.listen == ("quic/10.0.0.2:7500?mixed_rel=1",)
    assert network.connect == ("quic/10.0.0.1:7447?mixed_rel=1",)


def test_a_router_finds_itself_by_its_address_where_that_is_plain() -> None:
    here = NetworkSection(topology="routers", routers=("192.0.2.1", "127.0.0.1:7500"))
    assert topology.of_router(here, None, None).listen == ("tcp/127.0.0.1:7500",)
    for routers, says in (
        (("192.0.2.1",), "none is an address"),
        (("127.0.0.1", "127.0.0.1:7500"), "2 of them"),
    ):
        with pytest.raises(TransportError, match=rf"{says}.*as --listen"):
            topology.of_router(NetworkSection(topology="routers", routers=routers), None, None)


# --- what is refused --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("network", "says"),
    [
        ("peers = { x = '10.0.0.1' }", '2: network.peers: found the key "x", expected drone IDs'),
        ("peers = { 0 = '10.0.0.1' }", '2: network.peers: found the key "0"'),
        ("peers = { 65536 = '10.0.0.1' }", '2: network.peers: found the key "65536"'),
        ("peers = ['10.0.0.1']", "2: network.peers: "),
        ("topology = 'routers'", 'topology = "routers" without routers'),
        ("topology = 'ring'", "2: network.topology: "),
        ("topology = 'routers'\nrouters = ['a']\nlisten = ['b']", "listen or connect together with topology"),
        ("topologie = 'mesh'", 'did you mean "topology"?'),
        ("keys = 7", "2: network.keys: "),
    ],
)
def test_a_wrong_network_is_named_at_its_file_and_line(tmp_path: Path, network: str, says: str) -> None:
    path = tmp_path / "team.toml"
    path.write_text(f"[network]\n{network}\n[camera]\nwhatever = true  # of another's concern\n")
    with pytest.raises(ConfigError) as caught:
        load_team_config(path)
    assert says in str(caught.value)
    assert str(caught.value).startswith(f"{path}:")


@pytest.mark.parametrize("address", ["10.0.0.1:0", "10.0.0.1:65535", "10.0.0.1:x", "a b", "fd00::1", ""])
def test_an_address_that_is_none_is_named(address: str) -> None:
    section = NetworkSection().model_copy(update={"peers": {"1": address}})
    with pytest.raises(TransportError, match=r"network\.peers: found .* expected HOST or HOST:PORT"):
        topology.of_drone(section, 1, None)


def test_a_drone_that_is_not_in_the_list_is_told() -> None:
    with pytest.raises(TransportError, match=r"network\.peers: has no address for drone 4"):
        topology.of_drone(NetworkSection(peers=PEERS), 4, None)


def test_keys_and_endpoints_must_agree(team: Team) -> None:
    with pytest.raises(TransportError, match="is not encrypted, and there are keys"):
        check(NetworkSettings("red", listen=("tcp/127.0.0.1:7447",), credentials=team.credentials("1")))
    with pytest.raises(TransportError, match="needs keys"):
        check(NetworkSettings("red", listen=("tls/127.0.0.1:7447",)))
    with pytest.raises(TransportError, match=r"network\.team: found 'blue', expected 'red'"):
        check(NetworkSettings("blue", credentials=team.credentials("1")))


# --- who may say what -------------------------------------------------------------------


def test_only_the_roster_has_rights_and_drones_only_below_their_own_id() -> None:
    rules = access_control(Roster("red", 1, {3: bytes(32)}, ("monitor",), ("router-a",)))
    assert rules["default_permission"] == "deny"
    allowed = {policy["subjects"][0]: policy["rules"] for policy in rules["policies"]}
    assert allowed == {
        "drone-3": ["send", "ask", "drone-3"],
        "monitor": ["send", "ask"],
        "router-a": ["send", "ask", "relay"],
    }
    (own,) = (rule for rule in rules["rules"] if rule["id"] == "drone-3")
    assert own["key_exprs"] == ["swarmtrack/red/v1/*/3/**"]
    assert own["flows"] == ["ingress"]


# --- what is said of links --------------------------------------------------------------


def test_who_never_comes_up_and_who_is_a_stranger_is_said_once(team: Team) -> None:
    network = topology.of_drone(NetworkSection(team="red", peers=PEERS), 1, team.credentials("1"))
    watch = LinkWatch(network)
    two = LinksUp(frozenset({"drone-2"}), 2)
    assert watch.news(two, patient=True) == []
    (line,) = watch.news(two, patient=False)
    assert line.startswith(
        "network: no link to drone-3 yet: not started, not in reach, or without a certificate"
    )
    assert watch.news(LinksUp(), patient=False) == []  # a link that was lost is told as a departure

    stranger = LinksUp(frozenset({"drone-2", "drone-9"}), 4)
    (line,) = watch.news(stranger, patient=False)
    assert "drone-9 has a certificate of our CA but is not in our roster" in line
    assert watch.news(stranger, patient=False) == []
    assert watch.strangers(stranger) == {"drone-9"}
    assert watch.describe(two) == "linked to drone-2; not to drone-3; no datagrams with drone-2"


def test_a_peer_without_a_link_for_datagrams_is_said_to_be_once_it_lasts(team: Team) -> None:
    network = topology.of_drone(NetworkSection(team="red", peers=PEERS), 1, team.credentials("1"))
    watch, both = LinkWatch(network), frozenset({"drone-2", "drone-3"})
    whole, half = LinksUp(both, 4, both), LinksUp(both, 3, frozenset({"drone-3"}))
    assert watch.describe(whole) == "linked to drone-2, drone-3"
    assert watch.describe(half) == "linked to drone-2, drone-3; no datagrams with drone-2"
    for up in [half] * (DATAGRAM_LINK_CHECKS - 1) + [whole] + [half] * (DATAGRAM_LINK_CHECKS - 1):
        assert watch.news(up, patient=False) == []
    (line,) = watch.news(half, patient=False)
    assert line.startswith("network: no datagrams with drone-2: is UDP let through")
    assert watch.news(half, patient=False) == []


def test_where_streams_are_all_that_was_asked_for_datagrams_are_not_missed(team: Team) -> None:
    streams = {i: f"tls/10.0.0.1{i}:7447?rel=1" for i in PEERS}
    network = topology.of_drone(NetworkSection(team="red", peers=streams), 1, team.credentials("1"))
    assert LinkWatch(network).streams_only(LinksUp(frozenset({"drone-2"}), 1)) == frozenset()


# --- ports ------------------------------------------------------------------------------


@pytest.mark.parametrize(("protocol", "kind"), [("tls", socket.SOCK_STREAM), ("quic", socket.SOCK_DGRAM)])
async def test_a_port_that_stays_taken_is_an_error(protocol: str, kind: socket.SocketKind) -> None:
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        if kind == socket.SOCK_STREAM:
            taken.listen()
        endpoint = f"{protocol}/127.0.0.1:{taken.getsockname()[1]}?rel=1"
        with pytest.raises(TransportError, match="Address already in use; does another agent run here"):
            await wait_for_ports((endpoint,))


async def test_a_port_that_is_left_meanwhile_is_taken() -> None:
    with socket.socket() as predecessor:
        predecessor.bind(("127.0.0.1", 0))
        predecessor.listen()
        port = predecessor.getsockname()[1]
        waiting = asyncio.create_task(wait_for_ports((f"tcp/127.0.0.1:{port}",)))
        await asyncio.sleep(0)
    await asyncio.wait_for(waiting, PATIENCE)


async def test_an_interface_that_is_not_up_yet_is_waited_for(
    team: Team, caplog: pytest.LogCaptureFixture
) -> None:
    """192.0.2.1 is nobody's. The agent flies; it is deaf to those who would dial it, and says so."""
    section = NetworkSection(team="red", peers={"1": "192.0.2.1"})
    drone = Drone(topology.of_drone(section, 1, team.credentials("1")), 1)
    with caplog.at_level(logging.WARNING):
        await drone.start()
    assert "192.0.2.1 is not an address of this machine now" in caplog.text
    assert drone.transport.status().ok
    await drone.stop()


# --- as processes -----------------------------------------------------------------------


def program(*arguments: str) -> subprocess.Popen[str]:
    """`swarmtrack` as a user starts it."""
    root = ROOT
    return subprocess.Popen(
        [sys.executable, "-m", "swarmtrack.agents.main", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
    )


async def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit code, what it printed, and its complaint."""
    out, err = await asyncio.to_thread(process.communicate, timeout=PATIENCE)
    return process.returncode, out, err


def team_file(folder: Path, team: Team, network: str) -> Path:
    path = folder / "team.toml"
    path.write_text(f'[network]\nteam = "red"\nkeys = "{team.folder}/drone-{{id}}"\n{network}\n')
    return path


async def test_echo_hears_a_team_with_keys_by_the_certificate_of_a_monitor(
    team: Team, tmp_path: Path
) -> None:
    addresses = free_addresses(2)
    path = team_file(tmp_path, team, f'peers = {{ 1 = "{addresses[0]}", 2 = "{addresses[1]}" }}')
    section = load_team_config(path).network
    drones = [await Drone(topology.of_drone(section, i, team.credentials(str(i))), i).start() for i in (1, 2)]
    hear = ("echo", "pose/2", "--config", str(path), "--count", "1", "--seconds", str(PATIENCE))
    code, said, _ = await ended(program(*hear, "--keys", str(team.folder / "monitor")))
    assert code == 0
    assert json.loads(said)["boot"] == drones[1].boot
    for drone in drones:
        await drone.stop()

    code, _, complaint = await ended(program(*hear))
    assert code == 2
    assert "this team has keys, expected the folder with those of a monitor (--keys, keys=)" in complaint
    code, _, complaint = await ended(program(*hear, "--keys", str(team.folder / "drone-1")))
    assert code == 2
    assert "holds keys of drone-1, expected those of one monitor" in complaint


async def test_without_keys_a_router_relays_on_loopback() -> None:
    section = NetworkSection(
        team=f"test-{secrets.token_hex(4)}", topology="routers", routers=tuple(free_addresses(1))
    )
    session = await open_session(topology.of_router(section, section.routers[0], None))
    one, two = [await Drone(topology.of_drone(section, i, None), i).start() for i in (1, 2)]
    await one.knows(two)
    await two.knows(one)
    for drone in (one, two):
        await drone.stop()
    await close_session(session, [])


async def test_a_router_relays_nobody_any_more_who_left_the_roster(tmp_path: Path) -> None:
    """It looks at its folder, and starts again. The drones of this test keep the roster that they began with."""
    team = Team(tmp_path / "ca", "1", "2", "3", "router-a", name="red")
    [address] = free_addresses(1)
    path = team_file(tmp_path, team, f'topology = "routers"\nrouters = ["{address}"]')
    section = load_team_config(path).network
    words = ("--config", str(path), "--listen", address, "--keys", str(team.folder / "router-a"))
    router = program("router", *words)
    try:
        one, two, three = [
            await Drone(topology.of_drone(section, i, team.credentials(str(i))), i).start() for i in (1, 2, 3)
        ]
        await one.knows(two, three)
        team.authority.revoke("drone-2")
        await eventually(lambda: not one.transport.status().ok)
        await three.announce(2)
        await one.knows(three, sequence=2)
        await eventually(lambda: two.transport.status().ok)  # its certificate is good yet
        await two.announce(2)
        await three.announce(3)
        await one.knows(three, sequence=3)
        await asyncio.sleep(1.0)
        assert dict(one.transport.status().counters)["peers"] == 1
        for drone in (one, two, three):
            await drone.stop()
        router.send_signal(signal.SIGTERM)
        code, said, complaints = await ended(router)
        assert code == 0
        assert said.count("relaying for team red") == 2
        assert "roster number 2: starts again" in complaints
    finally:
        router.kill()
        await ended(router)


async def test_two_router_processes_join_drones_and_one_may_die(team: Team, tmp_path: Path) -> None:
    addresses = free_addresses(2)
    routers = f'topology = "routers"\nrouters = ["{addresses[0]}", "{addresses[1]}"]'
    path = team_file(tmp_path, team, routers)
    section = load_team_config(path).network

    a, b = (
        program("router", "--config", str(path), "--listen", address, "--keys", str(team.folder / name))
        for name, address in zip(("router-a", "router-b"), addresses, strict=True)
    )
    try:
        # One through each: they meet only if the routers do.
        via_a, via_b = (section.model_copy(update={"routers": (address,)}) for address in addresses)
        one = await Drone(topology.of_drone(via_a, 1, team.credentials("1")), 1).start()
        two = await Drone(topology.of_drone(via_b, 2, team.credentials("2")), 2).start()
        three = await Drone(topology.of_drone(section, 3, team.credentials("3")), 3).start()
        await one.knows(two, three)
        await two.knows(one, three)
        await three.knows(one, two)
        a.send_signal(signal.SIGKILL)
        await three.announce(2)
        await two.knows(three, sequence=2)  # by the other router
        await eventually(lambda: "linked to router-b" in three.transport.status().text)
        await eventually(lambda: not one.transport.status().ok)  # who listed one router only is cut off
        for drone in (one, two, three):
            await drone.stop()
        b.send_signal(signal.SIGTERM)
        code, said, _ = await ended(b)
        assert code == 0
        assert f"relaying for team red on quic/{addresses[1]}" in said
        assert "router-a" in said
    finally:
        for router in (a, b):
            router.kill()
            await ended(router)
