"""Addresses that can never link a team are refused before flight, and what the refusal says helps."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Collection
from pathlib import Path

import pytest

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from support.network_of_keys import Team
from swarmtrack.agents import main as swarmtrack
from swarmtrack.config.drone import NetworkSection
from swarmtrack.errors import TransportError
from swarmtrack.transport.addresses import check_addresses, look_up

HOSTS = {
    "alpha": ("127.0.1.1",),
    "bravo": ("10.77.0.2",),
    "charlie": ("::1", "127.0.0.1"),
    "delta": ("127.0.1.1", "10.77.0.4"),  # both lines are there: the second is dialled
    "bravo.local": ("fd00::2", "10.77.0.2"),
    "echo": ("::ffff:127.0.1.1",),
}


def in_these_hosts(names: Collection[str]) -> dict[str, tuple[str, ...]]:
    return {name: HOSTS[name] for name in names if name in HOSTS}


def refusal(section: NetworkSection, drone_id: int | None = 1, *, secured: bool = False) -> str:
    try:
        check_addresses(section, secured=secured, drone_id=drone_id, look_up=in_these_hosts)
    except TransportError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("peers", "says"),
    [
        (
            {"1": "alpha", "2": "bravo"},
            "network.peers: 1: found alpha, which means 127.0.1.1 on this machine",
        ),
        ({"1": "charlie:7500", "2": "10.77.0.2"}, "network.peers: 1: found charlie:7500, which means ::1 on"),
        (
            {"1": "127.0.0.1", "2": "10.77.0.2"},
            "network.peers: 1: found 127.0.0.1, where no other drone can dial",
        ),
        ({"1": "[::1]", "2": "nobody-knows"}, "network.peers: 1: found [::1], where no other drone can dial"),
        (
            {"1": "tcp/alpha:7447", "2": "bravo"},
            "network.peers: 1: found tcp/alpha:7447, which means 127.0.1.1",
        ),
        (
            {"1": "10.77.0.1", "2": "alpha"},
            "network.peers: 2: found alpha, which means 127.0.1.1 on this machine",
        ),
        (
            {"1": "10.77.0.1", "2": "bravo", "3": "bravo:7447"},
            "drones 2 and 3 both have the address bravo:7447",
        ),
        ({"1": "alpha", "2": "charlie"}, ""),  # a team on one machine
        ({"1": "127.0.0.1:7447", "2": "127.0.0.1:7450"}, ""),
        ({"1": "delta", "2": "bravo"}, ""),
        ({"1": "nobody-knows", "2": "bravo"}, ""),  # at a desk, where the field's names mean nothing
        ({"1": "10.77.0.1", "2": "[fe80::1%3]"}, ""),
        ({"1": "echo", "2": "bravo"}, "network.peers: 1: found echo, which means 127.0.1.1 on this machine"),
        (
            {"1": "[::ffff:127.0.0.1]", "2": "bravo"},
            "network.peers: 1: found [::ffff:127.0.0.1], where no other",
        ),
        (
            {"1": "10.77.0.1", "2": "bravo", "3": "bravo.local"},
            "drones 2 and 3 both have the address 10.77.0.2",
        ),
        (
            {"1": "10.77.0.1", "2": "bravo", "3": "10.77.0.2"},
            "drones 2 and 3 both have the address 10.77.0.2",
        ),
        ({"1": "10.77.0.1", "2": "bravo", "3": "10.77.0.2:7500"}, ""),
    ],
)
def test_whoever_is_on_loopback_while_others_are_elsewhere_is_named(peers: dict[str, str], says: str) -> None:
    found = refusal(NetworkSection(peers=peers, insecure=True))
    assert (says in found) if says else found == ""


@pytest.mark.parametrize(
    "address", ["0.0.0.0", "[::]:7500", "255.255.255.255", "224.0.0.224", "tcp/[ff02::1]:7447"]
)
@pytest.mark.parametrize("network", ["mesh", "routers"])
def test_what_is_no_machines_address_is_refused_wherever_it_is_dialled(network: str, address: str) -> None:
    if network == "mesh":
        peers = {"1": "10.77.0.1", "2": "10.77.0.2"}
        for i in peers:
            section = NetworkSection(peers=peers | {i: address}, insecure=True)
            assert refusal(section).startswith(f"network.peers: {i}: found {address}, which is no machine's")
            assert 'listen = ["0.0.0.0"]' in refusal(section)
        section = NetworkSection(peers=peers, connect=(address,), insecure=True)
        assert refusal(section).startswith(f"network.connect: 1: found {address}, which is no machine's")
    else:
        section = NetworkSection(topology="routers", routers=("10.77.0.9", address), insecure=True)
        for drone_id in (1, None):
            assert refusal(section, drone_id).startswith(f"network.routers: 2: found {address}")
        assert "listen" not in refusal(section)
        check_addresses(section, secured=False, router=address, look_up=in_these_hosts)


def test_a_router_by_a_name_that_is_its_machines_own_is_refused_and_one_on_loopback_for_all_is_not() -> None:
    named = NetworkSection(topology="routers", routers=("10.77.0.9", "alpha:17447"))
    for drone_id in (1, None):
        found = refusal(named, drone_id)
        assert found.startswith(
            "network.routers: 2: found alpha:17447, which means 127.0.1.1 on this machine"
        )
    here = NetworkSection(topology="routers", routers=("127.0.0.1:17447", "localhost:17448"))
    assert refusal(here) == refusal(here, None) == ""


def test_a_drone_that_dials_its_own_name_is_refused_and_a_monitor_beside_an_agent_is_not() -> None:
    section = NetworkSection(connect=("tcp/alpha:7447",))
    assert refusal(section).startswith("network.connect: 1: found tcp/alpha:7447, which means 127.0.1.1")
    assert refusal(section, None) == ""


def test_an_own_name_on_loopback_does_no_harm_where_the_drone_listens_elsewhere() -> None:
    section = NetworkSection(peers={"1": "alpha", "2": "bravo"}, listen=("0.0.0.0",), insecure=True)
    assert refusal(section) == ""
    inward = section.model_copy(update={"listen": ("127.0.0.1:7447",)})
    assert refusal(inward).startswith("network.listen: found 127.0.0.1:7447, where no other drone can dial")


@pytest.mark.parametrize(
    ("network", "entry"),
    [
        ({"peers": {"1": "10.0.0.1", "3": "[fd00::3]:7500"}}, "network.peers: 3: found [fd00::3]:7500"),
        (
            {"topology": "routers", "routers": ("10.0.0.1", "[fd00::2]")},
            "network.routers: 2: found [fd00::2]",
        ),
        ({"connect": ("tls/[fd00::9]:7447",)}, "network.connect: 1: found tls/[fd00::9]:7447"),
    ],
)
def test_with_keys_an_ipv6_address_is_refused_for_drones_and_listeners_and_without_it_is_fine(
    network: dict[str, object], entry: str
) -> None:
    section = NetworkSection.model_validate(network)
    for drone_id in (1, None):
        found = refusal(section, drone_id, secured=True)
        assert found.startswith(entry)
        assert "a name that means this address" in found
    assert refusal(section, 1) == ""


def test_the_system_is_asked_and_a_name_that_nobody_knows_is_left_out() -> None:
    found = look_up(["localhost", "no-such-host.invalid", "\udcff", ""])
    assert found["localhost"] <= ("127.0.0.1", "::1")
    assert found.keys() <= {"localhost", ""}


def test_a_router_with_its_own_name_says_so_instead_of_relaying_for_nobody(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        socket, "getaddrinfo", lambda *_, **__: [(socket.AF_INET, 1, 6, "", ("127.0.1.1", 0))]
    )
    path = tmp_path / "team.toml"
    path.write_text('[network]\ntopology = "routers"\nrouters = ["vm:17447"]\ninsecure = true\n')
    assert swarmtrack.main(["router", "--config", str(path), "--listen", "vm:17447", "--seconds", "0.1"]) == 2
    assert "network.routers: 1: found vm:17447, which means 127.0.1.1 on this" in capsys.readouterr().err


# --- the advice, followed ------------------------------------------------------------------------


def drone(folder: Path, network: str) -> Path:
    path = folder / "drone-1.toml"
    path.write_text(
        "[drone]\nid = 1\nstart = { position_m = [0.0, 0.0, 0.0], yaw_deg = 0.0, position_sigma_m = 0.1 }\n"
        '[camera]\nsource = "sim://hover-triangle?seed=1"\n[autopilot]\nlink = "sim"\n'
        f"[network]\n{network}\n"
    )
    return path


def checked(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    code = swarmtrack.main(["config", "check", str(path)])
    said = capsys.readouterr()
    return code, said.out + said.err


def test_config_check_refuses_an_own_name_on_loopback_and_both_its_remedies_help(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = 'insecure = true\npeers = { 1 = "localhost", 2 = "10.77.0.2" }'
    code, said = checked(drone(tmp_path, network), capsys)
    assert code == 2
    assert re.search(r"drone-1\.toml:\d+: network\.peers: 1: found localhost, which means (127\.|::1)", said)
    remedy = re.search(r"add `(listen = .*)` under \[network\]", said)
    assert remedy is not None
    code, said = checked(drone(tmp_path, f"{network}\n{remedy[1]}"), capsys)
    assert code == 0
    assert "listens on 0.0.0.0" in said
    code, said = checked(drone(tmp_path, network.replace("localhost", "192.0.2.1")), capsys)
    assert code == 0
    assert "listens on 192.0.2.1 (not an address of this machine now)" in said


def test_config_check_refuses_ipv6_with_keys_and_a_name_helps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    team = Team(tmp_path / "keys", "1", "2", name="red")
    keys = json.dumps(str(team.folder / "drone-1"))
    network = f'team = "red"\nkeys = {keys}\npeers = {{ 1 = "[fd00:78::1]", 2 = "[fd00:78::2]" }}'
    code, said = checked(drone(tmp_path, network), capsys)
    assert code == 2
    assert "network.peers: 1: found [fd00:78::1], but with keys an IPv6 address cannot be dialled" in said
    by_name = network.replace("[fd00:78::1]", socket.gethostname() + "-1.invalid").replace(
        "[fd00:78::2]", "bravo.invalid"
    )
    code, said = checked(drone(tmp_path, by_name), capsys)
    assert code == 0, said
