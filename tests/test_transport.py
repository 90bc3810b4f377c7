"""What every transport promises, memory and Zenoh alike, and what `Membership` makes of what it hears."""

from __future__ import annotations

import asyncio
import os
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any, Protocol

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmtrack import codec
from swarmtrack.errors import TransportError
from swarmtrack.messages import Announcement, IdClash, PeerArrived, PeerDeparted, PeerEvent
from swarmtrack.runtime.clock import ManualClock
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Transport
from swarmtrack.transport.membership import MAX_BOOTS, MAX_PEERS, Membership
from swarmtrack.transport.memory import MemoryHub, MemoryTransport
from swarmtrack.transport.settings import NetworkSettings, check

PATIENCE = 10.0  # s: far beyond what any of this takes; only a broken promise waits it out


def announcement(drone_id: int, boot: str, sequence: int = 0, t: float = 0.0) -> Announcement:
    position = np.array([drone_id, sequence, -1.5])
    return Announcement(drone_id, boot, sequence, t, 0.01, position, np.eye(3), 0.01 * np.eye(3))


# --- the list that every transport passes -----------------------------------------------


class Agent:
    """One drone: its transport, and all it was ever told."""

    def __init__(self, transport: Transport, drone_id: int, boot: str) -> None:
        self.transport, self.drone_id, self.boot = transport, drone_id, boot
        self.told: list[PeerEvent] = []
        self._news = asyncio.Condition()
        self._listening = asyncio.create_task(self._listen())

    async def _listen(self) -> None:
        async for event in self.transport.events():
            async with self._news:
                self.told.append(event)
                self._news.notify_all()

    async def announce(self, sequence: int = 0, t: float = 0.0) -> None:
        await self.transport.announce(announcement(self.drone_id, self.boot, sequence, t))

    async def until(self, holds: Callable[[list[PeerEvent]], bool]) -> None:
        async with self._news:
            await asyncio.wait_for(self._news.wait_for(lambda: holds(self.told)), PATIENCE)

    async def hears(self, drone_id: int, boot: str, sequence: int = 0) -> None:
        await self.until(lambda told: (drone_id, boot, sequence) in heard(told))

    def counter(self, name: str) -> float:
        return dict(self.transport.status().counters).get(name, 0)

    async def leave(self) -> None:
        await self.transport.close()
        await asyncio.wait_for(self._listening, PATIENCE)  # `events` ends by itself


def heard(told: list[PeerEvent]) -> list[tuple[int, str, int]]:
    return [(e.drone_id, e.boot, e.sequence) for e in told if isinstance(e, Announcement)]


class World(Protocol):
    """A network and the agents on it."""

    def transport(self, team: str, drone_id: int, boot: str, clock: ManualClock) -> Transport: ...
    async def put(self, key: str, payload: bytes) -> None: ...
    async def close(self) -> None: ...


class MemoryWorld:
    def __init__(self) -> None:
        self.hub = MemoryHub()

    def transport(self, team: str, drone_id: int, boot: str, clock: ManualClock) -> Transport:
        return MemoryTransport(self.hub, team, drone_id, boot, clock)

    async def put(self, key: str, payload: bytes) -> None:
        self.hub.put(key, payload)

    async def close(self) -> None: ...


class ZenohWorld:
    """Real sockets on loopback, at the ports that all agents of this machine share."""

    def __init__(self) -> None:
        self.intruder: Any = None

    def transport(self, team: str, drone_id: int, boot: str, clock: ManualClock) -> Transport:
        from swarmtrack.transport.zenoh_transport import ZenohTransport  # noqa: PLC0415

        return ZenohTransport(NetworkSettings(team=team), drone_id, boot, clock)

    async def put(self, key: str, payload: bytes) -> None:
        from swarmtrack.transport.zenoh_session import open_session  # noqa: PLC0415

        if self.intruder is None:
            self.intruder = await open_session(NetworkSettings())
        await asyncio.to_thread(self.intruder.put, key, payload)

    async def close(self) -> None:
        if self.intruder is not None:
            await asyncio.to_thread(self.intruder.close)


Start = Callable[..., Awaitable[Agent]]


@pytest.fixture(params=["memory", "zenoh"])
async def world(request: pytest.FixtureRequest) -> AsyncIterator[World]:
    if request.param == "zenoh":
        pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
    world: World = MemoryWorld() if request.param == "memory" else ZenohWorld()
    yield world
    await world.close()


@pytest.fixture
def team() -> str:
    return f"test-{secrets.token_hex(4)}"  # others may run the same tests on this machine


@pytest.fixture
async def start(world: World, team: str) -> AsyncIterator[Start]:
    agents: list[Agent] = []

    async def start_agent(
        drone_id: int, *, boot: str = "", team: str = team, clock: ManualClock | None = None
    ) -> Agent:
        boot = boot or keys.new_boot()
        transport = world.transport(team, drone_id, boot, clock or ManualClock())
        await transport.open()
        agents.append(Agent(transport, drone_id, boot))
        return agents[-1]

    yield start_agent
    for agent in agents:
        await agent.leave()


async def test_agents_know_each_other_whoever_came_first(start: Start) -> None:
    first = await start(1)
    await first.announce()
    late = await start(65535)
    await late.announce()
    await late.hears(1, first.boot)
    await first.hears(65535, late.boot)
    assert first.told[0] == PeerArrived(65535, late.boot)  # alive before it is believed


async def test_what_was_announced_before_opening_is_known_too(start: Start, world: World, team: str) -> None:
    listener = await start(1)
    boot = keys.new_boot()
    eager = world.transport(team, 2, boot, ManualClock())
    await eager.announce(announcement(2, boot))
    await eager.open()
    await listener.hears(2, boot)
    await eager.close()


async def test_ten_agents_that_start_at_once_all_know_all(start: Start) -> None:
    agents = await asyncio.gather(*[start(i) for i in range(1, 11)])
    await asyncio.gather(*[agent.announce() for agent in agents])
    everyone = {(a.drone_id, a.boot, 0) for a in agents}
    for agent in agents:
        others = everyone - {(agent.drone_id, agent.boot, 0)}
        await agent.until(lambda told, others=others: others <= set(heard(told)))  # type: ignore[misc]


async def test_an_announcement_is_told_once_and_replaced_by_a_later_one_only(start: Start) -> None:
    listener, speaker = await start(1), await start(2)
    await speaker.announce(sequence=0)
    await listener.hears(2, speaker.boot, 0)
    await speaker.announce(sequence=5)
    await listener.hears(2, speaker.boot, 5)
    assert heard(listener.told) == [(2, speaker.boot, 0), (2, speaker.boot, 5)]
    with pytest.raises(ValueError, match="expected a higher one"):
        await speaker.announce(sequence=5)
    with pytest.raises(ValueError, match="expected our own"):
        await speaker.transport.announce(announcement(1, speaker.boot, 6))


async def test_an_announcement_keeps_its_time_across_clocks(start: Start) -> None:
    """The sender's monotonic clock stands 100 s before the receiver's; both know UTC."""
    speaker = await start(1, clock=ManualClock(now=50.0, utc=1.7e9))
    listener = await start(2, clock=ManualClock(now=150.0, utc=1.7e9))
    await speaker.announce(t=48.0)
    await listener.until(lambda told: len(heard(told)) == 1)
    (got,) = (e for e in listener.told if isinstance(e, Announcement))
    assert got.t == pytest.approx(148.0, abs=1e-6)


async def test_a_departure_is_told_and_a_restart_is_a_new_boot(start: Start) -> None:
    witness, drone = await start(1), await start(2)
    await drone.announce()
    await witness.hears(2, drone.boot)
    await drone.leave()
    await witness.until(lambda told: told[-1:] == [PeerDeparted(2, drone.boot)])
    again = await start(2)
    await again.announce()
    await witness.hears(2, again.boot)
    assert again.boot != drone.boot
    assert not any(isinstance(e, IdClash) for e in witness.told)


async def test_a_clone_is_reported_by_all_three(start: Start) -> None:
    witness, drone, clone = await start(1), await start(2), await start(2)
    await drone.announce()
    await clone.announce()
    both = {drone.boot, clone.boot}

    def clash(told: list[PeerEvent], ours: bool) -> bool:
        return any(isinstance(e, IdClash) and (set(e.boots), e.ours) == (both, ours) for e in told)

    await drone.until(lambda told: clash(told, ours=True))
    await clone.until(lambda told: clash(told, ours=True))
    await witness.until(lambda told: clash(told, ours=False))
    await witness.hears(2, drone.boot)  # both poses are known: which to believe is not the network's to say
    await witness.hears(2, clone.boot)
    assert not heard([e for e in drone.told if e.drone_id == 2])  # we have no teammate of our own name


async def test_teams_do_not_hear_each_other(start: Start, team: str) -> None:
    red, blue, red_friend = await start(1), await start(2, team=f"{team}-blue"), await start(3)
    for agent in (red, blue, red_friend):
        await agent.announce()
    await red.hears(3, red_friend.boot)
    await red_friend.hears(1, red.boot)
    assert blue.told == []
    assert {e.drone_id for e in red.told} == {3}


async def test_random_bytes_on_every_key_are_counted_and_nothing_stops(
    start: Start, world: World, team: str
) -> None:
    victim, friend = await start(1), await start(2)
    await friend.announce(sequence=0)
    await victim.hears(2, friend.boot)
    noise = os.urandom(64 * 1024)
    stolen = codec.encode_announcement(announcement(3, friend.boot), 0.0)
    async with asyncio.timeout(PATIENCE):
        # Again until counted: what the intruder puts before its own links stand is lost.
        while (
            victim.counter("announcements_malformed") < 2 or victim.counter("announcements_on_wrong_key") < 1
        ):
            for kind in Kind:
                for rest in ((1,), (2,), (2, "0123abcd"), ("x",), (0,), (2, 2, 2)):
                    await world.put(keys.key(team, kind, *rest), noise)
            await world.put(keys.key(team, Kind.POSE, 2), stolen)
    await friend.announce(sequence=1)
    await victim.hears(2, friend.boot, 1)
    assert heard(victim.told) == [(2, friend.boot, 0), (2, friend.boot, 1)]


async def test_only_tracks_and_health_are_published(start: Start) -> None:
    agent = await start(1)
    agent.transport.publish(Kind.TRACKS, b"tracks")
    agent.transport.publish(Kind.HEALTH, b"health")
    assert agent.counter("tracks_sent") == agent.counter("health_sent") == 1
    with pytest.raises(ValueError, match="expected one of tracks, health"):
        agent.transport.publish(Kind.POSE, b"pose")


# --- scripted faults, in memory ---------------------------------------------------------


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


async def in_memory(hub: MemoryHub, drone_id: int) -> Agent:
    boot = keys.new_boot()
    transport = MemoryTransport(hub, "team", drone_id, boot, ManualClock())
    await transport.open()
    return Agent(transport, drone_id, boot)


async def test_an_announcement_lost_on_the_air_is_asked_for_until_it_comes(hub: MemoryHub) -> None:
    lost: list[str] = []

    def lose_the_first_four(sender: int, receiver: int, key: str) -> bool:
        lost.append(key)
        return len(lost) <= 4

    hub.lose = lose_the_first_four
    listener, speaker = await in_memory(hub, 1), await in_memory(hub, 2)
    await speaker.announce()
    await listener.hears(2, speaker.boot)
    assert len(lost) > 4
    await listener.leave()
    await speaker.leave()


async def test_a_healed_partition_tells_what_was_announced_meanwhile(hub: MemoryHub) -> None:
    listener, speaker = await in_memory(hub, 1), await in_memory(hub, 2)
    await speaker.announce(sequence=0)
    await listener.hears(2, speaker.boot, 0)
    hub.partition([1], [2])
    await listener.until(lambda told: told[-1:] == [PeerDeparted(2, speaker.boot)])
    await speaker.announce(sequence=1)
    hub.heal()
    await listener.hears(2, speaker.boot, 1)
    assert heard(listener.told) == [(2, speaker.boot, 0), (2, speaker.boot, 1)]
    await listener.leave()
    await speaker.leave()


async def test_the_killed_are_missed_by_the_living(hub: MemoryHub) -> None:
    witness, victim = await in_memory(hub, 1), await in_memory(hub, 2)
    assert isinstance(victim.transport, MemoryTransport)
    hub.kill(victim.transport)
    await witness.until(lambda told: told[-1:] == [PeerDeparted(2, victim.boot)])
    await witness.leave()


# --- membership, pure -------------------------------------------------------------------

boots = st.sampled_from(["0000000a", "0000000b", "0000000c"])
happenings = st.lists(
    st.tuples(st.sampled_from(["arrived", "departed", "heard"]), st.integers(1, 3), boots, st.integers(0, 3))
)


@settings(deadline=None)
@given(happenings)
def test_whatever_happens_events_tell_a_consistent_story(story: list[tuple[str, int, str, int]]) -> None:
    """A listener who only believes the events knows exactly who is alive, and never hears old news."""
    membership = Membership(drone_id=1, boot="0000000a")
    alive: dict[tuple[int, str], int] = {}
    tokens: set[tuple[int, str]] = set()
    for what, drone_id, boot, sequence in story:
        if what == "heard":
            events = membership.heard(drone_id, announcement(drone_id, boot, sequence))
        else:
            events = getattr(membership, what)(drone_id, boot)
            (tokens.add if what == "arrived" else tokens.discard)((drone_id, boot))
        for event in events:
            if isinstance(event, PeerArrived):
                assert (event.drone_id, event.boot) not in alive
                alive[event.drone_id, event.boot] = -1
            elif isinstance(event, PeerDeparted):
                alive.pop((event.drone_id, event.boot), None)
            elif isinstance(event, Announcement):
                assert event.sequence > alive[event.drone_id, event.boot]
                alive[event.drone_id, event.boot] = event.sequence
            else:
                assert len(event.boots) > 1
                assert event.ours == (event.drone_id == 1)
    assert set(alive) == {(i, b) for i, b in tokens if i != 1}
    assert set(membership.missing) == {i for (i, _), sequence in alive.items() if sequence < 0}


def test_a_flood_of_names_is_bounded_and_counted() -> None:
    membership = Membership(1, "0000000a")
    for drone_id in range(2, 2 + MAX_PEERS + 10):
        membership.arrived(drone_id, "0000000b")
    for i in range(MAX_BOOTS + 10):
        membership.arrived(2, f"{100 + i:08x}")
    assert len(membership.peers) == MAX_PEERS
    assert len(membership.alive(2)) == MAX_BOOTS
    assert membership.counters["tokens_beyond_limit"] == 10 + 11


def test_refused_announcements_are_counted_by_reason() -> None:
    membership = Membership(1, "0000000a")
    membership.heard(2, announcement(3, "0000000b"))
    membership.heard(2, announcement(2, "0000000b"))
    membership.heard(1, announcement(1, "0000000b"))
    membership.arrived(2, "0000000b")
    membership.heard(2, announcement(2, "0000000b"))
    membership.heard(2, announcement(2, "0000000b"))
    assert membership.counters == {
        "announcements_on_wrong_key": 1,
        "announcements_before_token": 1,
        "announcements_of_own_id": 1,
        "announcements_repeated": 1,
    }


# --- keys and settings ------------------------------------------------------------------


@pytest.mark.parametrize(
    "key",
    [
        "",
        "swarmtrack/red/v1/pose",
        "swarmtrack/red/v2/pose/1",
        "swarmtrack/red/v1/pose/0",
        "swarmtrack/red/v1/pose/01",
        "swarmtrack/red/v1/pose/65536",
        "swarmtrack/red/v1/pose/-1",
        "swarmtrack/red/v1/pose/１",  # a full-width digit
        "swarmtrack/red/v1/pose/1\n",
        "swarmtrack//v1/pose/1",
        "swarmtrack/red/v1/gossip/1",
        "other/red/v1/pose/1",
    ],
)
def test_a_key_that_is_not_ours_is_none(key: str) -> None:
    assert keys.parse(key) is None


def test_a_key_is_taken_apart_as_it_was_made() -> None:
    assert keys.parse(keys.key("red", Kind.ALIVE, 3, "0123abcd")) == ("red", Kind.ALIVE, 3, ("0123abcd",))


@pytest.mark.parametrize(
    ("network", "says"),
    [
        (NetworkSettings(listen=("tcp/192.168.1.5:7447",)), "insecure = true"),
        (NetworkSettings(listen=("tcp/0.0.0.0:7447",)), "insecure = true"),
        (NetworkSettings(connect=("tcp/[::]:7447",)), "insecure = true"),
        (NetworkSettings(connect=("udp/drone-2.local:7447",)), "insecure = true"),
        (NetworkSettings(multicast=True), "insecure = true"),
        (NetworkSettings(multicast=True, insecure=True), r"network\.listen"),
        (NetworkSettings(listen=("192.168.1.5:7447",)), "PROTOCOL/HOST:PORT"),
        (NetworkSettings(listen=("tcp/127.0.0.1",)), "no port"),
        (NetworkSettings(team="a/b"), r"network\.team"),
        (NetworkSettings(team="*"), r"network\.team"),
        (NetworkSettings(lease_s=0.0), r"network\.lease_s"),
    ],
)
def test_settings_that_are_wrong_or_unsafe_are_refused_with_what_to_write(
    network: NetworkSettings, says: str
) -> None:
    with pytest.raises(TransportError, match=says):
        check(network)


@pytest.mark.parametrize(
    "network",
    [
        NetworkSettings(),
        NetworkSettings(listen=("tcp/127.0.0.1:7447",), connect=("tcp/[::1]:7448", "tcp/localhost:1")),
        NetworkSettings(listen=("tcp/192.168.1.5:7447",), insecure=True),
        NetworkSettings(multicast=True, interface="lo"),
    ],
)
def test_loopback_needs_no_keys_and_the_rest_only_a_word(network: NetworkSettings) -> None:
    check(network)
