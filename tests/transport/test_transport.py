"""What every transport promises, memory and Zenoh alike, and what `Membership` makes of what it hears."""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import math
import os
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace
from typing import Any, Protocol

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from support.patience import PATIENCE, eventually
from swarmtrack.clock import ManualClock
from swarmtrack.errors import TransportError
from swarmtrack.messages import (
    Announcement,
    AnnouncementRequested,
    IdClash,
    MotionReport,
    PeerArrived,
    PeerDeparted,
    PeerEvent,
    RangeReport,
    Sighting,
    SightingReport,
)
from swarmtrack.transport import keys, silence
from swarmtrack.transport.base import Kind, Transport
from swarmtrack.transport.limits import (
    ANSWERS_PER_S,
    ANSWERS_TOGETHER_S,
    MAX_ANSWERS_TOGETHER_S,
    MAX_BOOTS_PER_ID,
    MAX_PEERS,
)
from swarmtrack.transport.membership import Membership
from swarmtrack.transport.memory import MemoryHub, MemoryTransport
from swarmtrack.transport.outgoing import JointAnswers, Outgoing
from swarmtrack.transport.peers import Peers
from swarmtrack.transport.sender_clock import SenderClock
from swarmtrack.transport.settings import NetworkSettings, check
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import AnnouncementMessage, announcement_message
from swarmtrack.wire.motion import motion_message
from swarmtrack.wire.ranging import range_message
from swarmtrack.wire.sightings import SightingsMessage, report_from_nowhere, sightings_message


def announcement(drone_id: int, boot: str, sequence: int = 0, t: float = 0.0) -> Announcement:
    position = np.array([drone_id, sequence, -1.5])
    return Announcement(drone_id, boot, sequence, t, 0.01, position, np.eye(3), 0.01 * np.eye(3))


def report(observer: int, boot: str, sequence: int = 0, t: float = 0.0) -> SightingReport:
    sighting = Sighting(9, 0.99, np.array([0.0, 0.6, 0.8]), 0.01)
    return SightingReport(
        observer, boot, sequence, t, 0.05, np.array([observer, 0, -1.5]), 0.1, (9,), (sighting,)
    )


def motion(drone_id: int, boot: str, sequence: int) -> MotionReport:
    return MotionReport(drone_id, boot, sequence, 0.0, 0.05, np.ones(3), np.eye(3), np.zeros(3), np.eye(3))


# --- the list that every transport passes -----------------------------------------------


class Agent:
    """One drone: its transport, and all it was ever told."""

    def __init__(self, transport: Transport, drone_id: int, boot: str, clock: ManualClock) -> None:
        self.transport, self.drone_id, self.boot, self.clock = transport, drone_id, boot, clock
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

    def report(self, sequence: int = 0, t: float = 0.0) -> None:
        payload = codec.encode(
            sightings_message(
                report(self.drone_id, self.boot, sequence, t),
                self.clock.utc() - self.clock.now(),
                self.clock.now(),
            )
        )
        self.transport.publish(Kind.IDENTITIES, payload)

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


def reports(told: list[PeerEvent]) -> list[SightingReport]:
    return [e for e in told if isinstance(e, SightingReport)]


class World(Protocol):
    """A network and the agents on it."""

    def transport(
        self, team: str, drone_id: int, boot: str, clock: ManualClock, **signing: Any
    ) -> Transport: ...
    async def put(self, key: str, payload: bytes) -> None: ...
    async def close(self) -> None: ...


class MemoryWorld:
    def __init__(self) -> None:
        self.hub = MemoryHub()

    def transport(self, team: str, drone_id: int, boot: str, clock: ManualClock, **signing: Any) -> Transport:
        return MemoryTransport(self.hub, team, drone_id, boot, clock, **signing)

    async def put(self, key: str, payload: bytes) -> None:
        self.hub.put(key, payload)

    async def close(self) -> None: ...


class ZenohWorld:
    """Real sockets on loopback, at the ports that all agents of this machine share."""

    def __init__(self) -> None:
        self.intruder: Any = None

    def transport(self, team: str, drone_id: int, boot: str, clock: ManualClock, **signing: Any) -> Transport:
        from swarmtrack.transport.zenoh_transport import ZenohTransport  # noqa: PLC0415

        return ZenohTransport(NetworkSettings(team=team), drone_id, boot, clock, **signing)

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
        drone_id: int, *, team: str = team, clock: ManualClock | None = None, **signing: Any
    ) -> Agent:
        boot, clock = keys.new_boot(), clock or ManualClock()
        transport = world.transport(team, drone_id, boot, clock, **signing)
        await transport.open()
        agents.append(Agent(transport, drone_id, boot, clock))
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
    listener = await start(2, clock=ManualClock(now=150.0, utc=1.7e9 + 1.5))
    await speaker.announce(t=48.0)
    await listener.until(lambda told: len(heard(told)) == 1)
    (got,) = (e for e in listener.told if isinstance(e, Announcement))
    assert got.t == pytest.approx(146.5, abs=1e-6)  # UTC is believed to 2 s
    assert got.t_sigma == 0.01
    assert listener.counter("clocks_off") == 0


@pytest.mark.parametrize("off_by", [-7200.0, 7200.0])
async def test_a_wall_clock_that_is_hours_off_does_not_move_a_pose_in_time(
    start: Start, off_by: float
) -> None:
    speaker = await start(1, clock=ManualClock(now=50.0, utc=1.7e9 + off_by))
    listener = await start(2, clock=ManualClock(now=150.0, utc=1.7e9))
    await speaker.until(lambda told: PeerArrived(2, listener.boot) in told)  # its links stand
    await speaker.announce(t=48.0)
    speaker.report(t=49.5)
    await listener.until(lambda told: bool(heard(told) and reports(told)))
    (got,) = (e for e in listener.told if isinstance(e, Announcement))
    assert got.t == pytest.approx(148.0, abs=1e-6)  # by its age: two seconds before it arrived
    assert got.t_sigma == 0.2
    assert reports(listener.told)[0].t == pytest.approx(149.5, abs=1e-6)
    assert listener.counter("clocks_off") == 1


async def test_who_comes_late_is_told_the_age_of_the_pose_as_of_now(start: Start) -> None:
    early = await start(1, clock=ManualClock(now=50.0, utc=0.5e9))  # its wall clock is years off
    await early.announce(t=50.0)
    early.clock.set(110.0)
    late = await start(2, clock=ManualClock(now=1000.0, utc=1.7e9))
    await late.hears(1, early.boot)
    (got,) = (e for e in late.told if isinstance(e, Announcement))
    assert got.t == pytest.approx(940.0, abs=1e-6)


async def test_a_request_brings_the_next_announcement(start: Start) -> None:
    curious, drone = await start(1), await start(2)
    await drone.announce(sequence=1)
    await curious.hears(2, drone.boot, 1)
    curious.transport.request_announcement(2)
    await drone.until(lambda told: AnnouncementRequested() in told)
    await drone.announce(sequence=2)
    await curious.hears(2, drone.boot, 2)
    assert (curious.counter("requests"), drone.counter("requests_received")) == (1, 1)


async def test_requests_pass_once_a_second_at_both_ends(start: Start) -> None:
    curious, curious_too, drone = await start(1), await start(3), await start(2)
    await drone.announce()
    for asker in (curious, curious_too):
        await asker.hears(2, drone.boot)
    curious.transport.request_announcement(2)
    curious.transport.request_announcement(2)  # held back by ourselves
    await drone.until(lambda told: AnnouncementRequested() in told)
    curious_too.transport.request_announcement(2)  # ignored by the drone: answered, but not renewed for it
    await eventually(lambda: drone.counter("requests_ignored") == 1)
    assert (curious.counter("requests"), curious.counter("requests_withheld")) == (1, 1)
    for agent in (curious, drone):
        agent.clock.set(agent.clock.now() + 1.0)
    curious.transport.request_announcement(2)
    await drone.until(lambda told: told.count(AnnouncementRequested()) == 2)


async def test_nobody_is_asked_who_does_not_live(start: Start) -> None:
    curious = await start(1)
    curious.transport.request_announcement(7)
    assert (curious.counter("requests"), curious.counter("requests_withheld")) == (0, 1)


async def test_reports_of_sightings_are_told_in_order_and_once(start: Start) -> None:
    listener, observer = await start(1), await start(2)
    await listener.until(lambda told: PeerArrived(2, observer.boot) in told)
    await observer.until(lambda told: PeerArrived(1, listener.boot) in told)
    for sequence in (0, 3, 3, 2, 4):
        observer.report(sequence)
        # One at a time: of several at once a transport may tell the newest only.
        last = max(sequence, 3) if sequence else 0
        await listener.until(
            lambda told, last=last: last in [r.sequence for r in reports(told)]  # type: ignore[misc]
        )
    await eventually(lambda: listener.counter("sightings_repeated") == 2)
    assert [r.sequence for r in reports(listener.told)] == [0, 3, 4]
    assert reports(listener.told)[0].sightings[0].drone_id == 9


async def test_the_reports_of_some_teammates_are_received_and_announcements_of_all(start: Start) -> None:
    listener, near, far = await start(1), await start(2), await start(3)
    for other in (near, far):
        await listener.until(lambda told, other=other: PeerArrived(other.drone_id, other.boot) in told)  # type: ignore[misc]
        await other.until(lambda told: PeerArrived(1, listener.boot) in told)
    sequences = itertools.count()

    async def all_report_until(holds: Callable[[set[int]], bool]) -> None:
        """By whom the reports are that come from now on."""
        for _ in range(200):
            listener.told.clear()
            near.report(number := next(sequences))
            far.report(number)
            await asyncio.sleep(0.1)
            if holds({told.observer for told in reports(listener.told)}):
                return
        raise AssertionError("never")

    await all_report_until(lambda whose: whose == {2, 3})
    listener.transport.receive_only(frozenset({2}))
    await all_report_until(lambda whose: whose == {2})
    await far.announce()
    await listener.hears(3, far.boot)
    listener.transport.receive_only(None)
    await all_report_until(lambda whose: whose == {2, 3})


async def test_who_is_not_received_is_not_missed(team: str) -> None:
    peers = Peers(team, 1, "0000000a", ManualClock(), None, clash_s=1.0, lease_s=1.0)
    for drone in (2, 3):
        peers.on_token(keys.key(team, Kind.ALIVE, drone, f"0000000{drone}"), True)
    # Of several that owe no word the first is asked first.
    peers.reports_of = frozenset({3})
    asked: list[int] = []
    async with asyncio.timeout(PATIENCE):
        while not asked:
            peers.listen_for_silence((2, 3), asked.append, queued=False)
            await asyncio.sleep(0.2)
    assert asked == [3]


async def test_a_report_from_nowhere_is_a_sign_of_life_and_says_nothing_else(start: Start) -> None:
    listener, lost = await start(1), await start(2)
    await lost.announce()
    await listener.hears(2, lost.boot)
    for sequence in (1, 2):
        said = report_from_nowhere(2, lost.boot, sequence, lost.clock.now())
        payload = codec.encode(sightings_message(said, lost.clock.utc() - lost.clock.now(), lost.clock.now()))
        lost.transport.publish(Kind.IDENTITIES, payload)
    lost.report(3)
    await listener.until(lambda told: bool(reports(told)))
    assert [each.sequence for each in reports(listener.told)] == [3]
    assert listener.counter("sightings_malformed") == 0


async def test_a_report_on_a_key_or_of_a_boot_that_is_not_its_own_is_refused(
    start: Start, world: World, team: str
) -> None:
    listener, observer = await start(1), await start(2)
    await listener.until(lambda told: PeerArrived(2, observer.boot) in told)

    async def put_until_counted(counter: str, key_id: int, said: SightingReport) -> None:
        async with asyncio.timeout(PATIENCE):
            while listener.counter(counter) == 0:  # again: what is put before the links stand is lost
                await world.put(
                    keys.key(team, Kind.IDENTITIES, key_id), codec.encode(sightings_message(said, 1.7e9, 0.0))
                )
                await asyncio.sleep(0.01)

    await put_until_counted("sightings_on_wrong_key", 2, report(3, observer.boot))
    await put_until_counted("sightings_before_token", 2, report(2, "00000000"))
    await put_until_counted("sightings_of_own_id", 1, report(1, observer.boot))
    assert reports(listener.told) == []


async def test_motions_are_told_in_order_once_and_only_of_their_own_drone(
    start: Start, world: World, team: str
) -> None:
    listener, drone = await start(1), await start(2)
    await listener.until(lambda told: PeerArrived(2, drone.boot) in told)

    def motions() -> list[MotionReport]:
        return [event for event in listener.told if isinstance(event, MotionReport)]

    async def put(key_id: int, said: MotionReport) -> None:
        payload = codec.encode(motion_message(said, 1.7e9, 0.0))
        await world.put(keys.key(team, Kind.MOTION, key_id), payload)

    async def put_until(said: Callable[[], bool], key_id: int, what: MotionReport) -> None:
        async with asyncio.timeout(PATIENCE):
            while not said():  # again: what is put before the links stand is lost
                await put(key_id, what)
                await asyncio.sleep(0.01)

    await put_until(lambda: bool(motions()), 2, motion(2, drone.boot, 3))
    await put_until(lambda: listener.counter("motion_repeated") > 0, 2, motion(2, drone.boot, 2))
    await put_until(lambda: listener.counter("motion_on_wrong_key") > 0, 2, motion(3, drone.boot, 4))
    await put_until(lambda: listener.counter("motion_before_token") > 0, 2, motion(2, "00000000", 5))
    await put_until(lambda: listener.counter("motion_of_own_id") > 0, 1, motion(1, drone.boot, 6))
    assert [(said.drone_id, said.sequence) for said in motions()] == [(2, 3)]


async def test_the_distances_of_its_own_radio_reach_a_drone_and_no_other_and_lies_are_counted(
    start: Start, world: World, team: str
) -> None:
    listener, other = await start(1), await start(2)
    await listener.until(lambda told: PeerArrived(2, other.boot) in told)
    await other.until(lambda told: PeerArrived(1, listener.boot) in told)

    def ranges(agent: Agent) -> list[RangeReport]:
        return [event for event in agent.told if isinstance(event, RangeReport)]

    async def put_until(said: Callable[[], bool], payload: bytes, *key: int, kind: Kind = Kind.RANGE) -> None:
        async with asyncio.timeout(PATIENCE):
            while not said():  # again: what is put before the links stand is lost
                await world.put(keys.key(team, kind, *key), payload)
                await asyncio.sleep(0.01)

    good = RangeReport(1, 2, 0.0, 0.05, 8.5, 0.1)
    payload = codec.encode(range_message(good, "0123abcd", 3, 1.7e9, 0.0))
    fields = msgspec.msgpack.decode(payload)
    await put_until(lambda: bool(ranges(listener)), payload, 1, 2)
    await put_until(lambda: listener.counter("ranges_repeated") > 0, payload, 1, 2)
    await put_until(lambda: listener.counter("ranges_on_wrong_key") > 0, payload, 1, 3)
    await put_until(lambda: listener.counter("ranges_malformed") > 0, b"\xc1", 1, 2)
    for lie in (math.nan, 0.0, 1e9, -8.5):
        before = listener.counter("ranges_malformed")
        fields[8] = lie
        await put_until(
            lambda before=before: listener.counter("ranges_malformed") > before,
            msgspec.msgpack.encode(fields),
            1,
            2,
        )
    assert [(said.other, said.distance, said.sigma) for said in ranges(listener)] == [(2, 8.5, 0.1)]
    assert ranges(other) == []
    assert other.counter("ranges_malformed") == 0


def sign(text: bytes) -> bytes:
    """No cryptography: a transport asks for a signature and for a verdict, whose they are is not its business."""
    return hashlib.sha512(text).digest()


def verify(drone_id: int, text: bytes, signature: bytes) -> bool:
    return sign(text) == signature


async def test_with_keys_only_genuine_announcements_count(start: Start) -> None:
    listener = await start(1, sign=sign, verify=verify)
    genuine, unsigned = await start(2, sign=sign), await start(3)
    forger = await start(4, sign=lambda text: bytes(64))
    for agent in (unsigned, forger, genuine):
        await agent.announce()
    await listener.hears(2, genuine.boot)
    await eventually(
        lambda: listener.counter("announcements_unsigned") > 0 < listener.counter("announcements_forged")
    )
    assert {drone_id for drone_id, _, _ in heard(listener.told)} == {2}
    assert genuine.counter("announcement_bytes") < 300


async def test_what_announcing_costs_is_counted(start: Start) -> None:
    drone = await start(1)
    await drone.announce()
    assert drone.counter("announcements_sent") == 1
    late = await start(2)
    await late.hears(1, drone.boot)
    sent, size = drone.counter("announcements_sent"), drone.counter("announcement_bytes")
    assert sent == 2
    assert drone.counter("announcement_bytes_total") == sent * size


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
    assert not heard(drone.told)  # we have no teammate of our own name


async def test_when_a_clash_ends_the_one_that_is_left_is_told_again(start: Start) -> None:
    witness, drone, clone = await start(1), await start(2), await start(2)
    await drone.announce()
    await clone.announce()
    await witness.hears(2, drone.boot)
    await witness.hears(2, clone.boot)
    await witness.until(lambda told: any(isinstance(e, IdClash) for e in told))
    await clone.leave()
    await witness.until(lambda told: heard(told[-1:]) == [(2, drone.boot, 0)])
    assert witness.told[-2] == PeerDeparted(2, clone.boot)
    assert [type(e) for e in witness.told].count(IdClash) == 1


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
    stolen = codec.encode(announcement_message(announcement(3, friend.boot), 1.7e9, 0.0))
    async with asyncio.timeout(PATIENCE):
        # Again until counted: what the intruder puts before its own links stand is lost.
        while (
            victim.counter("announcements_malformed") < 2
            or victim.counter("sightings_malformed") < 2
            or victim.counter("announcements_on_wrong_key") < 1
        ):
            for kind in Kind:
                for rest in ((1,), (2,), (2, "0123abcd"), ("x",), (0,), (2, 2, 2)):
                    await world.put(keys.key(team, kind, *rest), noise)
            await world.put(keys.key(team, Kind.POSE, 2), stolen)
    await friend.announce(sequence=1)
    await victim.hears(2, friend.boot, 1)
    assert heard(victim.told) == [(2, friend.boot, 0), (2, friend.boot, 1)]


async def test_who_reports_without_having_our_announcement_is_told_of_us_again_over_the_same_links(
    team: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Part of what we declared was lost with a link; others, who have it, see us neither go nor come."""
    zenoh = pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
    monkeypatch.setattr(silence, "REOPEN_LEASES", 0.5)
    world = ZenohWorld()
    us, witness = [
        Agent(
            world.transport(team, drone_id, f"0000000{drone_id}", clock),
            drone_id,
            f"0000000{drone_id}",
            clock,
        )
        for drone_id, clock in ((1, ManualClock()), (2, ManualClock()))
    ]
    for agent in (us, witness):
        await agent.transport.open()
    await us.announce()
    await witness.hears(1, us.boot)
    await world.put("hello", b"")
    assert isinstance(world, ZenohWorld)
    changes: list[tuple[str, bool]] = []
    session = world.intruder
    token = session.liveliness().declare_token(keys.key(team, Kind.ALIVE, 3, "0000000c"))
    tokens = session.liveliness().declare_subscriber(
        keys.key(team, Kind.ALIVE, 1, "**"),
        lambda sample: changes.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)),
    )
    sequences = itertools.count(1)
    async with asyncio.timeout(PATIENCE):
        while not any(key.endswith(f"{us.boot}/1") for key, _ in changes):
            said = report(3, "0000000c", next(sequences), 0.0)
            payload = codec.encode(sightings_message(replace(said, known=(2,)), us.clock.utc(), 0.0))
            await world.put(keys.key(team, Kind.IDENTITIES, 3), payload)
            await asyncio.sleep(0.2)
    assert all(alive for _, alive in changes)  # the first token stays
    us.report(1)
    await witness.until(lambda told: bool(reports(told)))
    assert not any(isinstance(event, PeerDeparted) and event.drone_id == 1 for event in witness.told)
    curious = Agent(world.transport(team, 4, "0000000d", ManualClock()), 4, "0000000d", ManualClock())
    await curious.transport.open()
    await curious.hears(1, us.boot)  # its queryable answers again, too
    tokens.undeclare()
    token.undeclare()
    for agent in (us, witness, curious):
        await agent.leave()
    await world.close()


@pytest.mark.parametrize("question", ["lost on its way", "kept without an answer"])
async def test_where_a_teammate_neither_reports_nor_answers_though_its_link_stands_links_are_made_again(
    team: str, caplog: pytest.LogCaptureFixture, question: str
) -> None:
    zenoh = pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
    world = ZenohWorld()
    agents = []
    for drone_id in (1, 2):
        boot, clock = keys.new_boot(), ManualClock()
        transport = world.transport(team, drone_id, boot, clock)
        await transport.open()
        agents.append(Agent(transport, drone_id, boot, clock))
    listener, silent = agents
    await silent.announce()
    await listener.hears(2, silent.boot)
    for entity in silent.transport._declared:
        if isinstance(entity, zenoh.Queryable):
            entity.undeclare()
    kept: list[Any] = []
    if question == "kept without an answer":
        session = silent.transport._session
        assert session is not None
        session.declare_queryable(
            keys.key(team, Kind.POSE, 2), zenoh.handlers.Callback(kept.append, indirect=False)
        )
    await eventually(lambda: listener.counter("silent") == 1)
    assert "silent: drone 2" in listener.transport.status().text
    await listener.until(lambda told: PeerDeparted(2, silent.boot) in told)
    await listener.until(lambda told: told.count(PeerArrived(2, silent.boot)) == 2)
    assert listener.counter("silent") == 0
    sequences = itertools.count(1)

    def is_heard() -> bool:
        silent.report(next(sequences))
        return bool(reports(listener.told))

    await eventually(is_heard)
    said = [record.getMessage() for record in caplog.records]
    assert sum("drone 2 is linked but silent" in line for line in said) >= 1
    assert said.count("network: drone 2 is still silent, though linked: links are renewed") == 1
    for agent in agents:
        await agent.leave()


async def test_a_camera_is_told_to_whoever_comes_and_asks(team: str) -> None:
    """By Zenoh; in memory nobody asks."""
    pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
    from swarmtrack.transport.zenoh_listener import ZenohListener  # noqa: PLC0415

    drone = ZenohWorld().transport(team, 2, keys.new_boot(), ManualClock())
    drone.describe(b"a lens")
    await drone.open()
    for _ in range(2):  # each newcomer anew
        listener = ZenohListener(NetworkSettings(team=team), keys.key(team, Kind.CAMERA, "*"), ManualClock())
        await listener.open()
        async with asyncio.timeout(PATIENCE):
            sample = await anext(listener.samples())
        assert (sample.key, sample.payload) == (keys.key(team, Kind.CAMERA, 2), b"a lens")
        await listener.close()
    await drone.close()


async def test_who_is_told_of_before_a_listener_has_declared_all_is_asked(
    team: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("zenoh", reason="Zenoh has no wheel here")
    from swarmtrack.transport import zenoh_listener  # noqa: PLC0415

    bounded = zenoh_listener.bounded

    async def slowly(function: Any, *rest: Any) -> Any:
        done = await bounded(function, *rest)
        await asyncio.sleep(0.5)
        return done

    monkeypatch.setattr(zenoh_listener, "bounded", slowly)
    drone = ZenohWorld().transport(team, 2, keys.new_boot(), ManualClock())
    drone.describe(b"a lens")
    await drone.open()
    camera = keys.key(team, Kind.CAMERA, "*")
    listener = zenoh_listener.ZenohListener(NetworkSettings(team=team), camera, ManualClock())
    await listener.open()
    async with asyncio.timeout(PATIENCE):
        assert (await anext(listener.samples())).payload == b"a lens"
    await listener.close()
    await drone.close()


async def test_a_camera_is_told_once_when_the_network_opens() -> None:
    hub, told = MemoryHub(), []
    hub.listeners.append(lambda key, payload: told.append((key, payload)))
    transport = MemoryTransport(hub, "red", 2, keys.new_boot(), ManualClock())
    transport.describe(b"a lens")
    await transport.open()
    assert told == [("swarmtrack/red/v1/camera/2", b"a lens")]
    await transport.close()


def test_a_flood_of_questions_for_the_camera_gets_so_many_answers_and_costs_the_pose_none() -> None:
    clock = ManualClock()
    outgoing = Outgoing("red", 2, "0123abcd", clock, None)
    outgoing.replace(announcement(2, "0123abcd"))
    assert outgoing.camera_answer() is None
    outgoing.camera = b"a lens"
    answers = [outgoing.camera_answer() for _ in range(300)]
    assert (answers.count(b"a lens"), answers.count(None)) == (256, 44)
    assert outgoing.counters["camera_answers_refused"] == 44
    assert outgoing.answer() is not None
    clock.set(clock.now() + 1.0)
    assert outgoing.camera_answer() == b"a lens"


async def test_only_what_is_repeated_is_published(start: Start) -> None:
    agent = await start(1)
    agent.transport.publish(Kind.TRACKS, b"tracks")
    agent.transport.publish(Kind.HEALTH, b"health")
    assert agent.counter("tracks_sent") == agent.counter("health_sent") == 1
    with pytest.raises(ValueError, match="expected one of identities, motion, stranger, tracks, health"):
        agent.transport.publish(Kind.POSE, b"pose")


# --- scripted faults, in memory ---------------------------------------------------------


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


async def in_memory(hub: MemoryHub, drone_id: int) -> Agent:
    boot, clock = keys.new_boot(), ManualClock()
    transport = MemoryTransport(hub, "team", drone_id, boot, clock)
    await transport.open()
    return Agent(transport, drone_id, boot, clock)


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


# --- our own announcement, pure ---------------------------------------------------------


def test_a_flood_of_questions_is_answered_within_bounds_and_signed_once() -> None:
    signed: list[bytes] = []

    def count_and_sign(text: bytes) -> bytes:
        signed.append(text)
        return sign(text)

    clock = ManualClock(now=50.0)
    outgoing = Outgoing("team", 1, "0000000a", clock, count_and_sign)
    assert outgoing.answer() is None
    assert not outgoing.accept_request()  # there is nothing to renew
    outgoing.replace(announcement(1, "0000000a", t=48.0))
    answers = [outgoing.answer() for _ in range(10_000)]
    told = [answer for answer in answers if answer is not None]
    assert 100 < len(told) < 1000
    assert outgoing.counters["answers_refused"] == len(answers) - len(told)
    assert len(signed) == 1
    clock.set(60.0)  # a later second: answered again, with the age as of then
    later = outgoing.answer()
    assert later is not None
    assert codec.decode(AnnouncementMessage, later).age_s == pytest.approx(12.0)


def test_questions_of_one_moment_wait_for_one_answer_and_longer_while_they_go_on() -> None:
    together = JointAnswers[int]()
    assert together.add(1) == ANSWERS_TOGETHER_S
    assert together.take() == [1]
    waits = []
    for _ in range(8):
        waits.append(together.add(1))
        assert together.add(2) is None
        assert together.take() == [1, 2]
    assert waits == [min(ANSWERS_TOGETHER_S * 2**k, MAX_ANSWERS_TOGETHER_S) for k in range(8)]
    together.add(3)
    assert together.take() == [3]
    assert together.add(4) == ANSWERS_TOGETHER_S
    for question in range(10_000):
        together.add(question)
    assert len(together.take()) == ANSWERS_PER_S


# --- the sender's clock, pure ---


def message(sent_utc: float, age: float = 0.5) -> SightingsMessage:
    said = report(2, "0000000b", t=sent_utc - age)
    return codec.decode(SightingsMessage, codec.encode(sightings_message(said, 0.0, sent_utc)))


def tell_time(clock: SenderClock, sent_utc: float, arrived: float) -> float:
    """When the pose held, on our monotonic clock, which is our UTC less 1000 s."""
    at = clock.time_of(message(sent_utc), arrived=arrived, utc_offset=1000.0, tolerance=1.0)
    return at.t


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 4.0), min_size=1, max_size=40), st.floats(-1e6, 1e6))
def test_the_quickest_message_tells_how_far_a_clock_is_off(ways: list[float], ahead: float) -> None:
    """A pose is never dated before it held, nor later than it is by the quickest message's way."""
    assume(abs(ahead) > 10.0)
    clock = SenderClock()
    sent = [2e6 + i for i in range(len(ways))]
    dated = [tell_time(clock, s + ahead, s + way - 1000.0) for s, way in zip(sent, ways, strict=True)]
    for i, (s, t) in enumerate(zip(sent, dated, strict=True)):
        late = t - (s - 0.5 - 1000.0)
        assert -1e-3 <= late <= min(ways[max(0, i - 15) : i + 1]) + 1e-3


def test_clocks_that_agree_are_believed_whatever_the_way_took() -> None:
    clock = SenderClock()
    assert tell_time(clock, sent_utc=5000.0, arrived=4000.3) == pytest.approx(3999.5)
    assert tell_time(clock, sent_utc=5001.0, arrived=4003.9) == pytest.approx(4000.5)


def test_a_wall_clock_that_is_set_in_flight_is_followed_at_once() -> None:
    clock = SenderClock()
    tell_time(clock, sent_utc=100.0, arrived=4000.0)  # no battery behind its clock
    assert tell_time(clock, sent_utc=5001.0, arrived=4001.0) == pytest.approx(4000.5)  # set by GPS
    assert tell_time(clock, sent_utc=102.0, arrived=4002.0) == pytest.approx(4001.5)  # and set back


# --- membership, pure -------------------------------------------------------------------

CLASH_S = 2.5
boots = st.sampled_from(["0000000a", "0000000b", "0000000c"])
happenings = st.lists(
    st.tuples(
        st.sampled_from(["arrived", "departed", "heard", "settle"]),
        st.integers(1, 3),
        boots,
        st.integers(0, 3),
    )
)


def hear(membership: Membership, key_id: int, said: Announcement, t: float = 0.0) -> list[PeerEvent]:
    """As the transport does once an announcement is decoded."""
    message = codec.decode(AnnouncementMessage, codec.encode(announcement_message(said, 1.7e9, 0.0)))
    life = membership.life(key_id, message, t)
    if life is None:
        return []
    life.announcement = said
    return [said]


@settings(deadline=None)
@given(happenings)
def test_whatever_happens_events_tell_a_consistent_story(story: list[tuple[str, int, str, int]]) -> None:
    """A listener who only believes the events knows who is alive, as which boot, and never hears old news."""
    membership = Membership(drone_id=1, boot="0000000a", clash_s=CLASH_S)
    believed: dict[int, set[str]] = {}
    tokens: dict[tuple[int, str], int] = {}  # the sequence that was told of each
    for t, (what, drone_id, boot, number) in enumerate(story):
        match what:
            case "heard":
                events = hear(membership, drone_id, announcement(drone_id, boot, number), t)
            case "settle":
                events = membership.settle(t)
            case "arrived":
                events = membership.arrived(drone_id, boot, t)
                tokens.setdefault((drone_id, boot), -1)
            case _:
                events = membership.departed(drone_id, boot)
                tokens.pop((drone_id, boot), None)
        for event in events:
            match event:
                case PeerArrived():
                    assert event.boot not in believed.get(event.drone_id, set())
                    believed.setdefault(event.drone_id, set()).add(event.boot)
                case PeerDeparted():
                    believed.get(event.drone_id, set()).discard(event.boot)
                case Announcement():
                    told = tokens[event.drone_id, event.boot]
                    # Told again where another boot went.
                    assert event.sequence == told if what == "departed" else event.sequence > told
                    tokens[event.drone_id, event.boot] = event.sequence
                case IdClash():
                    assert len(event.boots) > 1
                    assert event.ours == (event.drone_id == 1)
                    if not event.ours:
                        believed[event.drone_id] = set(event.boots)
    for drone_id in (2, 3):
        alive = {b for i, b in tokens if i == drone_id}
        told = believed.get(drone_id, set())
        # One that came last, or all once they clash; never none of those who live, and nobody else.
        assert told <= alive
        assert bool(told) == bool(alive)
        assert len(told) in (0, 1, len(alive))
    assert set(membership.missing) == {i for (i, _), sequence in tokens.items() if i != 1 and sequence < 0}


def test_a_boot_that_comes_while_the_last_one_s_token_stands_is_a_restart() -> None:
    membership = Membership(1, "0000000a", CLASH_S)
    assert membership.arrived(2, "0000000b", 0.0) == [PeerArrived(2, "0000000b")]
    restarted = [PeerDeparted(2, "0000000b"), PeerArrived(2, "0000000c")]
    assert membership.arrived(2, "0000000c", 10.0) == restarted
    assert membership.departed(2, "0000000b") == []
    assert membership.settles_at is None
    assert membership.settle(99.0) == []


def test_two_boots_that_live_on_beside_each_other_are_two_processes() -> None:
    membership = Membership(1, "0000000a", CLASH_S)
    membership.arrived(2, "0000000b", 0.0)
    membership.arrived(2, "0000000c", 10.0)
    assert membership.settle(10.0 + CLASH_S - 0.1) == []
    assert membership.settles_at == 10.0 + CLASH_S
    assert membership.settle(10.0 + CLASH_S) == [IdClash(2, ("0000000b", "0000000c"), ours=False)]
    assert membership.settle(99.0) == []
    assert membership.departed(2, "0000000b") == [PeerDeparted(2, "0000000b")]


def test_a_boot_that_is_heard_again_after_a_newer_one_came_has_not_restarted() -> None:
    membership = Membership(1, "0000000a", CLASH_S)
    membership.arrived(2, "0000000b", 0.0)
    membership.arrived(2, "0000000c", 10.0)
    hear(membership, 2, announcement(2, "0000000b", 1), 10.3)  # it may have been on its way
    hear(membership, 2, announcement(2, "0000000c", 1), 11.0)
    assert membership.settle(11.0) == []
    hear(membership, 2, announcement(2, "0000000b", 2), 11.0)
    assert membership.settle(11.0) == [IdClash(2, ("0000000b", "0000000c"), ours=False)]


def test_a_process_that_restarts_again_and_again_is_no_clone_however_long_it_goes_on() -> None:
    membership, told = Membership(1, "0000000a", CLASH_S), list[PeerEvent]()
    boots = [f"{k:08x}" for k in range(1, 8)]
    for k, boot in enumerate(boots):
        told += membership.arrived(2, boot, 1.6 * k)
        if k > 0:  # it goes a lease after its process was killed
            told += membership.departed(2, boots[k - 1])
        told += membership.settle(1.6 * k + 1.5)
    assert not [event for event in told if isinstance(event, IdClash)]
    assert told[-1] == PeerArrived(2, boots[-1])


def test_the_boot_that_was_there_first_is_believed_again_when_the_newer_one_goes() -> None:
    membership = Membership(1, "0000000a", CLASH_S)
    membership.arrived(2, "0000000b", 0.0)
    hear(membership, 2, announcement(2, "0000000b"))
    membership.arrived(2, "0000000c", 1.0)
    gone, back, said = membership.departed(2, "0000000c")
    assert (gone, back) == (PeerDeparted(2, "0000000c"), PeerArrived(2, "0000000b"))
    assert isinstance(said, Announcement)
    assert said.boot == "0000000b"


def test_a_process_that_restarts_does_not_call_its_own_last_life_a_clone() -> None:
    membership = Membership(1, "0000000a", CLASH_S)
    assert membership.arrived(1, "0000000b", 0.0) == []
    assert membership.departed(1, "0000000b") == []
    membership.arrived(1, "0000000c", 3.0)
    assert membership.settle(3.0 + CLASH_S) == [IdClash(1, ("0000000a", "0000000c"), ours=True)]
    assert membership.departed(1, "0000000c") == [PeerDeparted(1, "0000000c")]


def test_a_flood_of_names_is_bounded_and_counted() -> None:
    membership = Membership(1, "0000000a", CLASH_S)
    for drone_id in range(2, 2 + MAX_PEERS + 10):
        membership.arrived(drone_id, "0000000b", 0.0)
    for i in range(MAX_BOOTS_PER_ID + 10):
        membership.arrived(2, f"{100 + i:08x}", 0.0)
    assert len(membership.peers) == MAX_PEERS
    assert len(membership.alive(2)) == MAX_BOOTS_PER_ID
    assert membership.counters["tokens_beyond_limit"] == 10 + 11


def test_refused_announcements_are_counted_by_reason() -> None:
    membership = Membership(1, "0000000a", CLASH_S)
    hear(membership, 2, announcement(3, "0000000b"))
    hear(membership, 2, announcement(2, "0000000b"))
    hear(membership, 1, announcement(1, "0000000b"))
    membership.arrived(2, "0000000b", 0.0)
    hear(membership, 2, announcement(2, "0000000b"))
    hear(membership, 2, announcement(2, "0000000b"))
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
