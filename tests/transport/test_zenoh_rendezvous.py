"""How agents of one machine find each other, whatever is at the ports where they meet."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import secrets
import socket
from collections.abc import AsyncIterator

import numpy as np
import pytest

from support.patience import PATIENCE

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

from swarmtrack.clock import ManualClock
from swarmtrack.errors import TransportError
from swarmtrack.messages import Announcement, PeerArrived, PeerDeparted
from swarmtrack.transport import keys, zenoh_session
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.membership import Membership
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_bridge import Bridge
from swarmtrack.transport.zenoh_session import bounded, close_session, open_session
from swarmtrack.transport.zenoh_transport import ZenohTransport


def free_ports(n: int) -> range:
    """n ports in a row, free a moment ago, below the ephemeral ones."""
    for first in range(20000 + secrets.randbelow(5000), 32000, n):
        try:
            for port in range(first, first + n):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return range(first, first + n)
    raise AssertionError("no free ports")


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> range:
    """Two meeting points of our own."""
    ports = free_ports(2)
    monkeypatch.setattr(zenoh_session, "RENDEZVOUS_PORTS", ports)
    return ports


class Swarm:
    """Transports of one team, by ID."""

    def __init__(self) -> None:
        self.team = f"test-{secrets.token_hex(4)}"
        self.agents: dict[int, ZenohTransport] = {}

    async def start(self, *drone_ids: int) -> None:
        for drone_id in drone_ids:
            boot = keys.new_boot()
            self.agents[drone_id] = ZenohTransport(
                NetworkSettings(team=self.team), drone_id, boot, ManualClock()
            )
            await self.agents[drone_id].open()
            await self.agents[drone_id].announce(
                Announcement(drone_id, boot, 0, 0.0, 0.01, np.zeros(3), np.eye(3), np.eye(3))
            )

    async def stop(self, *drone_ids: int) -> None:
        for drone_id in drone_ids:
            await self.agents.pop(drone_id).close()

    async def all_know_all(self) -> None:
        async with asyncio.timeout(PATIENCE):
            for agent in self.agents.values():
                heard: set[int] = set()
                async for event in agent.events():
                    if isinstance(event, Announcement):
                        heard.add(event.drone_id)
                    if len(heard) == len(self.agents) - 1:
                        break


@pytest.fixture
async def swarm(ports: range) -> AsyncIterator[Swarm]:
    swarm = Swarm()
    yield swarm
    await swarm.stop(*swarm.agents)


async def test_more_agents_than_meeting_points_all_meet(swarm: Swarm) -> None:
    await swarm.start(5, 4, 3, 2, 1)
    await swarm.all_know_all()


async def test_when_all_at_the_meeting_points_are_gone_the_rest_meets_whoever_comes(swarm: Swarm) -> None:
    await swarm.start(1, 2, 3, 4)  # 1 and 2 hold the two ports
    await swarm.all_know_all()
    await swarm.stop(1, 2)
    await swarm.start(5)
    for drone_id in (3, 4):
        async with asyncio.timeout(PATIENCE):
            async for event in swarm.agents[drone_id].events():
                if isinstance(event, Announcement) and event.drone_id == 5:
                    break


async def test_a_stranger_at_a_meeting_point_who_never_answers_stops_nobody(
    swarm: Swarm, ports: range
) -> None:
    with socket.socket() as stranger:
        stranger.bind(("127.0.0.1", ports[0]))
        stranger.listen()
        await swarm.start(1, 2)
        await swarm.all_know_all()
        await swarm.stop(1, 2)  # bounded too, though Zenoh still waits for the stranger


async def test_garbage_at_the_port_itself_stops_nobody(swarm: Swarm, ports: range) -> None:
    await swarm.start(1)
    for size in (1, 64, 64 * 1024):
        _, writer = await asyncio.open_connection("127.0.0.1", ports[0])
        writer.write(os.urandom(size))
        with contextlib.suppress(ConnectionError):
            await writer.drain()
        writer.close()
    await swarm.start(2)
    await swarm.all_know_all()


async def test_tokens_that_name_nobody_are_counted(swarm: Swarm) -> None:
    await swarm.start(1)
    intruder = await open_session(NetworkSettings())
    names = ["2/xyz", "0/0123abcd", "99999/0123abcd", "2/0123ABCD", *(f"3/{i:08x}" for i in range(50))]
    tokens = [
        intruder.liveliness().declare_token(keys.key(swarm.team, Kind.ALIVE, *name.split("/")))
        for name in names
    ]
    async with asyncio.timeout(PATIENCE):
        counters: dict[str, float] = {}
        while counters.get("tokens_malformed", 0) < 4 or counters.get("tokens_beyond_limit", 0) < 46:
            await asyncio.sleep(0.01)
            counters = dict(swarm.agents[1].status().counters)
    assert counters["peers"] == 1
    await close_session(intruder, tokens)


async def test_a_port_that_is_taken_is_an_error_with_a_reason(ports: range) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", ports[0]))
        taken.listen()
        network = NetworkSettings(listen=(f"tcp/127.0.0.1:{ports[0]}",))
        transport = ZenohTransport(network, 1, keys.new_boot(), ManualClock())
        with pytest.raises(TransportError, match=r"cannot open: .*Address already in use") as error:
            await transport.open()
        assert ".rs" not in str(error.value)
        await transport.close()


async def test_explicit_endpoints_meet_whoever_starts_first(ports: range) -> None:
    """The one that dials starts before the one that listens, and dials again until it is there."""
    team = f"test-{secrets.token_hex(4)}"
    endpoint = f"tcp/127.0.0.1:{ports[0]}"
    dialler = ZenohTransport(
        NetworkSettings(team=team, connect=(endpoint,)), 1, keys.new_boot(), ManualClock()
    )
    listener = ZenohTransport(
        NetworkSettings(team=team, listen=(endpoint,)), 2, keys.new_boot(), ManualClock()
    )
    await dialler.open()
    await listener.open()
    async with asyncio.timeout(PATIENCE):
        assert (await anext(aiter(dialler.events()))).drone_id == 2
        assert (await anext(aiter(listener.events()))).drone_id == 1
    await dialler.close()
    await listener.close()


# --- the bridge -------------------------------------------------------------------------


async def test_a_bridge_keeps_order_and_drops_the_oldest_when_full() -> None:
    got: list[Sample] = []
    bridge = Bridge(got.append, capacity=3, clock=ManualClock())
    samples = [Sample(f"key/{i}", b"", True, 0.0) for i in range(5)]
    for sample in samples:
        bridge.enqueue(sample)
    await asyncio.sleep(0)
    assert got == samples[2:]
    assert bridge.dropped == 2


async def test_a_bridge_of_newest_keeps_the_last_word_on_each_key() -> None:
    got: list[Sample] = []
    bridge = Bridge(got.append, capacity=3, newest_per_key=1, clock=ManualClock())
    for alive in (True, False, True, False):
        bridge.enqueue(Sample("alive/1", b"", alive, 0.0))
        bridge.enqueue(Sample("alive/2", b"", not alive, 0.0))
    await asyncio.sleep(0)
    assert got == [Sample("alive/1", b"", False, 0.0), Sample("alive/2", b"", True, 0.0)]
    assert (bridge.dropped, bridge.superseded) == (0, 6)


async def test_a_link_lost_and_found_within_a_moment_does_not_look_as_if_it_had_stood() -> None:
    membership, told = Membership(1, "0000000a", 2.5), list[object]()

    def on_token(sample: Sample) -> None:
        boot = "0000000b"
        told.extend(membership.arrived(2, boot, 0.0) if sample.alive else membership.departed(2, boot))

    bridge = Bridge(on_token, newest_per_key=2, clock=ManualClock())
    for moment, expected in (([True], 1), ([False, True], 3), ([False, True, False, True], 5)):
        for alive in moment:
            bridge.enqueue(Sample("alive/2/0000000b", b"", alive, 0.0))
        async with asyncio.timeout(PATIENCE):
            while len(told) < expected:  # noqa: ASYNC110
                await asyncio.sleep(0)
    arrived, departed = PeerArrived(2, "0000000b"), PeerDeparted(2, "0000000b")
    assert told == [arrived, departed, arrived, departed, arrived]


async def test_whoever_floods_a_bridge_replaces_only_its_own_and_waits_its_turn() -> None:
    got: list[Sample] = []
    bridge = Bridge(got.append, newest_per_key=2, clock=ManualClock())
    for i in range(10_000):
        bridge.enqueue(Sample("flood", b"%d" % i, True, 0.0))
    bridge.enqueue(Sample("quiet", b"", True, 0.0))
    await asyncio.sleep(0)
    assert [sample.payload for sample in got] == [b"9998", b"", b"9999"]
    assert (bridge.dropped, bridge.superseded) == (0, 9998)


async def test_a_bridge_lets_the_loop_turn_between_two_handfuls() -> None:
    """Between any two samples that another task could count, only a bounded number is taken."""
    got: list[Sample] = []
    bridge = Bridge(got.append, clock=ManualClock())
    for i in range(1000):
        bridge.enqueue(Sample(f"key/{i}", b"", True, 0.0))
    taken = [0]
    async with asyncio.timeout(PATIENCE):
        while len(got) < 1000:
            await asyncio.sleep(0)
            taken.append(len(got))
    assert max(after - before for before, after in itertools.pairwise(taken)) <= 64


async def test_a_sample_that_cannot_be_taken_does_not_stop_the_next() -> None:
    good = asyncio.Event()
    reported: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: reported.append(context))

    def receive(sample: Sample) -> None:
        if sample.key == "bad":
            raise ValueError("a bug of ours")
        good.set()

    bridge = Bridge(receive, clock=ManualClock())
    bridge.enqueue(Sample("bad", b"", True, 0.0))
    await asyncio.sleep(0)
    bridge.enqueue(Sample("good", b"", True, 0.0))
    await asyncio.wait_for(good.wait(), PATIENCE)
    assert len(reported) == 1


async def test_a_call_that_hangs_is_given_up_and_its_late_result_disposed_of() -> None:
    release, disposed = asyncio.Event(), asyncio.Event()
    loop = asyncio.get_running_loop()

    def hang() -> str:
        asyncio.run_coroutine_threadsafe(release.wait(), loop).result()
        return "late"

    def dispose(result: str) -> None:
        loop.call_soon_threadsafe(disposed.set)

    with pytest.raises(TransportError, match=r"cannot open: no answer from Zenoh within 0\.01 s"):
        await bounded(hang, 0.01, "open", too_late=dispose)
    release.set()
    await asyncio.wait_for(disposed.wait(), PATIENCE)
