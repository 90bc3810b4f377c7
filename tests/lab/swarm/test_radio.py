"""The radio emulator: what the switch decides, and real namespaces that hear each other through it (root only).

This file is also the program of the processes in those namespaces: `python test_air.py echo ADDRESS` answers
datagrams, `python test_air.py ping ADDRESS COUNT WAIT` counts the answers.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, contextmanager
from pathlib import Path

import pytest

from support.patience import PATIENCE
from support.places import PYTHONPATH, ROOT
from swarmtrack.lab.swarm.radio import RadioEmulator, RadioError, mac_address
from swarmtrack.lab.swarm.radio_switch import BUFFER, MAX_WAITING_FRAMES, RadioChannel, Switch

PORT = 9000
EVERYBODY = b"\xff" * 6
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


# --- what the switch decides ----------------------------------------------------------------------


def switch_of(ports: int, seed: int = 1) -> tuple[RadioChannel, Switch]:
    fd = os.memfd_create("test")
    os.ftruncate(fd, RadioChannel.size(ports))
    channel = RadioChannel(fd, ports)
    os.close(fd)
    return channel, Switch(channel, [mac_address(port + 1) for port in range(ports)], seed)


def frame_to(destination: bytes, size: int = 100) -> bytes:
    return destination.ljust(size, b"\0")


def test_a_frame_goes_to_whom_it_is_addressed_and_a_broadcast_to_all_others():
    _, switch = switch_of(3)
    assert switch.send(0, frame_to(mac_address(3)), 0.0) == [2]
    assert switch.send(1, frame_to(EVERYBODY), 0.0) == [0, 2]
    assert switch.send(0, frame_to(mac_address(9)), 0.0) == []
    assert switch.send(0, frame_to(mac_address(1)), 0.0) == []  # its own


def test_a_broadcast_is_on_the_air_once_and_lost_by_each_receiver_for_itself():
    channel, switch = switch_of(3)
    for pair in range(9):
        channel.loss[pair] = 0.5
    heard = [switch.send(0, frame_to(EVERYBODY, 60), 0.0) for _ in range(1000)]
    assert {(), (1,), (2,), (1, 2)} == {tuple(ports) for ports in heard}
    assert (channel.sent_frames[0], channel.sent_bytes[0]) == (1000, 60_000)
    assert channel.lost_frames[0] == 2000 - sum(map(len, heard))


def test_losses_between_two_drones_follow_the_seed_whatever_a_third_one_sends():
    def pattern(seed: int, third_speaks: bool) -> list[bool]:
        channel, switch = switch_of(3, seed)
        for pair in range(9):
            channel.loss[pair] = 0.2
        heard = []
        for _ in range(2000):
            if third_speaks:
                switch.send(2, frame_to(EVERYBODY), 0.0)
            heard.append(bool(switch.send(0, frame_to(mac_address(2)), 0.0)))
        return heard

    alone = pattern(seed=7, third_speaks=False)
    assert alone == pattern(seed=7, third_speaks=True)
    assert alone != pattern(seed=8, third_speaks=False)
    assert abs(alone.count(False) - 400) < 4 * 18  # four standard deviations of a binomial


def test_who_is_cut_off_is_not_heard_and_counted_apart_from_loss():
    channel, switch = switch_of(3)
    channel.blocked[0 * 3 + 1] = 1.0
    assert switch.send(0, frame_to(EVERYBODY), 0.0) == [2]
    assert switch.send(1, frame_to(mac_address(1)), 0.0) == [0]
    assert (channel.blocked_frames[0], channel.lost_frames[0]) == (1, 0)


def test_frames_that_are_repeated_and_disordered_arrive_twice_and_overtake_each_other():
    channel, switch = switch_of(2)
    channel.latency_s[1], channel.jitter_s[1] = 0.05, 0.03
    channel.repeated[1], channel.disordered[1] = 0.3, 1.0
    sent = [frame_to(mac_address(2)) + number.to_bytes(2, "big") for number in range(1000)]
    for number, frame in enumerate(sent):
        assert switch.send(0, frame, 0.001 * number) == []
    heard = [delivery.frame for delivery in switch.deliver(2.0)]
    assert set(heard) == set(sent)
    assert abs(len(heard) - 1300) < 4 * 15  # four standard deviations of a binomial
    first = [heard.index(frame) for frame in sent]
    assert sum(a > b for a, b in itertools.pairwise(first)) > 100


def test_a_radio_without_udp_carries_all_else():
    channel, switch = switch_of(2)
    channel.udp_blocked[0] = 1.0
    ipv4, arp = b"\x08\x00", b"\x08\x06"

    def packet(kind: bytes, protocol: int) -> bytes:
        return (mac_address(2) + mac_address(1) + kind).ljust(23, b"\0") + bytes([protocol])

    assert switch.send(0, packet(ipv4, 17), 0.0) == []
    assert switch.send(0, packet(ipv4, 6), 0.0) == [1]
    assert switch.send(0, packet(arp, 17), 0.0) == [1]
    assert channel.lost_frames[0] == 1
    assert switch.send(1, (mac_address(1) + packet(ipv4, 17)[6:]), 0.0) == [0]  # only that radio


def test_jitter_delays_each_frame_within_its_bounds_and_keeps_the_order_of_a_link():
    channel, switch = switch_of(2)
    for pair in range(4):
        channel.latency_s[pair], channel.jitter_s[pair] = 0.05, 0.03
    sent = [frame_to(mac_address(2)) + number.to_bytes(2, "big") for number in range(500)]
    for number, frame in enumerate(sent):
        assert switch.send(0, frame, 0.001 * number) == []
    assert switch.deliver(0.0) == []
    heard = switch.deliver(1.0)
    assert [delivery.frame for delivery in heard] == sent
    delays = [delivery.due - 0.001 * number for number, delivery in enumerate(heard)]
    # Who is kept in order waits for the slowest before it, so the shortest delays are rare.
    assert 0.02 <= min(delays) < max(delays) <= 0.08
    assert switch.next_due is None


def test_a_frame_does_not_overtake_those_delayed_before_the_latency_fell():
    channel, switch = switch_of(2)
    channel.latency_s[1] = 1.0
    switch.send(0, frame_to(mac_address(2)) + b"first", 0.0)
    channel.latency_s[1] = 0.0
    assert switch.send(0, frame_to(mac_address(2)) + b"second", 0.5) == []
    assert [delivery.frame[-5:] for delivery in switch.deliver(1.0)] == [b"first", b"econd"]
    assert switch.send(0, frame_to(mac_address(2)), 1.1) == [1]


def test_a_narrow_radio_sends_one_frame_after_the_other_and_loses_what_it_has_no_room_for():
    channel, switch = switch_of(3)
    channel.bits_per_s[0] = 64_000.0
    for _ in range(30):
        assert switch.send(0, frame_to(mac_address(2), 800), 0.0) == []
    heard = switch.deliver(10.0)
    assert [delivery.due for delivery in heard] == [
        pytest.approx(0.1 * number) for number in range(1, BUFFER // 800 + 1)
    ]
    assert channel.lost_frames[0] == 30 - len(heard)
    assert switch.send(1, frame_to(mac_address(3), 800), 0.0) == [2]  # only that radio is narrow
    assert switch.send(0, frame_to(EVERYBODY, 800), 20.0) == []
    assert {(delivery.port, delivery.due) for delivery in switch.deliver(30.0)} == {(1, 20.1), (2, 20.1)}


def test_the_air_holds_no_more_than_so_many_delayed_frames():
    channel, switch = switch_of(2)
    channel.latency_s[1] = 1.0
    for _ in range(MAX_WAITING_FRAMES + 10):
        switch.send(0, frame_to(mac_address(2)), 0.0)
    assert channel.lost_frames[0] == 10
    assert len(switch.deliver(2.0)) == MAX_WAITING_FRAMES


@pytest.mark.parametrize("drones", [[], [1, 1], [0], [65535], list(range(1, 300))])
def test_drones_that_have_no_address_are_refused(drones):
    with pytest.raises(RadioError, match="expected"):
        RadioEmulator(drones, seed=1)


# --- namespaces -----------------------------------------------------------------------------------


@pytest.fixture
async def emulator() -> AsyncIterator[RadioEmulator]:
    async with AsyncExitStack() as stack:
        try:
            opened = await stack.enter_async_context(RadioEmulator([1, 2, 300], seed=1))
        except RadioError as error:
            pytest.skip(str(error))
        yield opened


def program(*words: str) -> list[str]:
    return ["env", f"PYTHONPATH={PYTHONPATH}", sys.executable, __file__, *words]


@contextmanager
def echo(emulator: RadioEmulator, drone: int) -> Iterator[None]:
    """While it lasts, this drone answers datagrams."""
    with subprocess.Popen(
        emulator.wrap(drone, program("echo", "0.0.0.0")), stdout=subprocess.PIPE, stdin=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        yield
        process.kill()


async def answers(
    emulator: RadioEmulator, drone: int, address: str, count: int = 1, wait: float = PATIENCE
) -> int:
    """How many of `count` datagrams to `address` this drone got back, waiting at most `wait` for each."""
    words = program("ping", address, str(count), str(wait))
    process = await asyncio.create_subprocess_exec(
        *emulator.wrap(drone, words), stdout=asyncio.subprocess.PIPE
    )
    out, _ = await process.communicate()
    return int(out)


async def test_drones_hear_each_other_over_the_radio_and_it_counts_them(emulator: RadioEmulator):
    with echo(emulator, 1):
        assert await answers(emulator, 2, emulator.radio_address(1)) == 1
        assert await answers(emulator, 300, emulator.radio_address(1)) == 1
    counters = emulator.counters
    assert min(counters[drone].frames for drone in (1, 2, 300)) >= 2  # ARP and the datagram
    assert min(counters[drone].bytes for drone in (1, 2, 300)) >= 42 + 46
    assert sum(count.lost + count.cut for count in counters.values()) == 0


async def test_a_fifth_of_the_frames_is_lost_each_way(emulator: RadioEmulator):
    with echo(emulator, 1):
        assert await answers(emulator, 2, emulator.radio_address(1)) == 1  # addresses are resolved
        emulator.impair(loss=0.2)
        answered = await answers(emulator, 2, emulator.radio_address(1), count=400, wait=0.02)
    assert abs(answered - 400 * 0.8 * 0.8) < 4 * 10
    assert sum(count.lost for count in emulator.counters.values()) >= 400 - answered


async def test_latency_is_paid_each_way(emulator: RadioEmulator):
    emulator.impair(latency_s=0.2, jitter_s=0.05)
    with echo(emulator, 1):
        assert await answers(emulator, 2, emulator.radio_address(1)) == 1
        assert await answers(emulator, 2, emulator.radio_address(1), wait=0.25) == 0
        assert await answers(emulator, 2, emulator.radio_address(1), wait=PATIENCE) == 1


async def test_a_cut_pair_is_silent_until_healed_and_the_third_hears_both_sides_of_its_own(
    emulator: RadioEmulator,
):
    with echo(emulator, 1), echo(emulator, 300):
        emulator.cut({1})
        assert await answers(emulator, 2, emulator.radio_address(1), wait=0.3) == 0
        assert await answers(emulator, 2, emulator.radio_address(300)) == 1
        emulator.heal()
        assert await answers(emulator, 2, emulator.radio_address(1)) == 1
        emulator.silence(2)
        assert await answers(emulator, 2, emulator.radio_address(1), wait=0.3) == 0
        assert await answers(emulator, 300, emulator.radio_address(1)) == 1
    assert emulator.counters[2].cut > 0


async def test_the_impaired_links_are_those_of_the_drones_named(emulator: RadioEmulator):
    emulator.impair({2}, loss=1.0)
    with echo(emulator, 1):
        assert await answers(emulator, 2, emulator.radio_address(1), wait=0.3) == 0
        assert await answers(emulator, 300, emulator.radio_address(1)) == 1


async def test_the_cable_has_no_faults_and_leads_to_no_other_drone(emulator: RadioEmulator):
    emulator.impair(loss=1.0)
    emulator.cut({1, 2})
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as host, echo(emulator, 1):
        host.settimeout(PATIENCE)
        host.bind((emulator.wire_address, 0))
        host.sendto(b"to the drone", (emulator.drone_wire_address(1), PORT))
        assert host.recvfrom(100) == (b"to the drone", (emulator.drone_wire_address(1), PORT))
        assert await answers(emulator, 2, emulator.drone_wire_address(1), wait=0.3) == 0


async def test_two_emulators_do_not_disturb_each_other(emulator: RadioEmulator):
    async with RadioEmulator([1, 2], seed=1) as other:
        assert other.wire_address != emulator.wire_address
        emulator.cut({1})
        with echo(emulator, 1), echo(other, 1):
            assert await answers(emulator, 2, emulator.radio_address(1), wait=0.3) == 0
            assert await answers(other, 2, other.radio_address(1)) == 1


# --- the end --------------------------------------------------------------------------------------


def namespace_files() -> set[Path]:
    """Where `ip netns` keeps namespaces beyond the end of their processes."""
    return set(Path("/run/netns").glob("*"))


def cables(emulator: RadioEmulator) -> list[str]:
    """The interfaces of this machine that lead to the emulator's drones."""
    return [line for line in ip_addresses().splitlines() if emulator.wire_address in line]


def ip_addresses() -> str:
    return subprocess.run(["ip", "-o", "addr"], capture_output=True, text=True, check=True).stdout


def running(pid: str) -> bool:
    return Path(f"/proc/{pid}").exists()


async def test_nothing_is_left_when_it_is_closed(emulator: RadioEmulator):
    assert len(cables(emulator)) == 3
    files = namespace_files()
    async with RadioEmulator([4, 5], seed=1) as other:
        assert len(cables(other)) == 2
    assert cables(other) == []
    assert namespace_files() == files
    assert len(cables(emulator)) == 3


async def test_nothing_is_left_when_its_owner_is_killed(emulator: RadioEmulator):
    """`emulator` is only asked whether one can be made here; the victim is another process with one of its own."""
    victim = await asyncio.create_subprocess_exec(
        *program("own"), stdout=asyncio.subprocess.PIPE, env=ENVIRONMENT
    )
    assert victim.stdout is not None
    wire_address, *pids = (await victim.stdout.readline()).decode().split()
    assert len(pids) == 3  # the switch, and whoever was started through `wrap`
    victim.send_signal(signal.SIGKILL)
    await victim.wait()
    async with asyncio.timeout(PATIENCE):
        # The kernel tells nobody when it is done.
        while any(map(running, pids)) or wire_address in ip_addresses():  # noqa: ASYNC110
            await asyncio.sleep(0.05)


async def test_a_switch_that_dies_is_no_quiet_loss(emulator: RadioEmulator):
    async def lose_the_switch() -> None:
        async with RadioEmulator([1, 2], seed=1) as other:
            switch = other._switch
            assert switch is not None
            switch.kill()
            await switch.wait()

    with pytest.raises(RadioError, match="switch ended by itself"):
        await lose_the_switch()


# --- without root ---------------------------------------------------------------------------------


def test_it_works_as_the_root_of_a_user_namespace(emulator: RadioEmulator):
    """`emulator`: only where it works for us at all. Else a kernel may forbid user
    namespaces, and there is nothing to see."""
    if subprocess.run(["unshare", "-Urn", "true"], check=False, capture_output=True).returncode != 0:
        pytest.skip("this kernel makes no user namespaces for us")
    below = ["unshare", "-Urn", "--", *program("own", "once")]
    found = subprocess.run(below, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert (found.stdout, found.stderr) == ("heard\n", "")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
async def test_whoever_is_not_root_is_told_what_to_do():
    os.seteuid(65534)
    try:
        with pytest.raises(RadioError, match="need root; run as root, or below `unshare -Urn`"):
            async with RadioEmulator([1, 2], seed=1):
                pass
    finally:
        os.seteuid(0)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give up its capabilities")
def test_a_root_without_capabilities_is_told_which_are_missing():
    found = subprocess.run(
        ["setpriv", "--bounding-set=-all", "--inh-caps=-all", "--", *program("own", "once")],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "RadioError: radio: this root may not make network namespaces (no CAP_SYS_ADMIN)" in found.stderr


# --- the processes in the namespaces --------------------------------------------------------------


def answer_datagrams(address: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind((address, PORT))
        print("ready", flush=True)
        while True:
            server.sendto(*server.recvfrom(2048))


def ping(address: str, count: int, wait: float) -> int:
    """Send numbered datagrams one after the other; how many came back, be it late."""
    answered = set()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(wait)
        for number in range(count):
            try:
                client.sendto(number.to_bytes(4, "big"), (address, PORT))
                while number not in answered:
                    answered.add(int.from_bytes(client.recv(4), "big"))
            except OSError:  # no answer in time, or no way to there
                continue
    return len(answered)


async def own(once: bool) -> None:
    """Open an emulator with two processes in it, say so, and wait to be killed; once: let them speak and end."""
    async with RadioEmulator([1, 2], seed=1) as emulator:
        if once:
            with echo(emulator, 1):
                heard = await answers(emulator, 2, emulator.radio_address(1))
            print("heard" if heard else "silent")
            return
        with echo(emulator, 1), echo(emulator, 2):
            print(emulator.wire_address, *children(), flush=True)
            await asyncio.Event().wait()


def children() -> list[str]:
    """PIDs."""
    return Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["echo", address]:
            answer_datagrams(address)
        case ["ping", address, count, wait]:
            print(ping(address, int(count), float(wait)))
        case ["own", *words]:
            asyncio.run(own("once" in words))
