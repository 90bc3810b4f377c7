"""What a team's keys keep out, with real certificates on loopback. `docs/security.md` is the table of these claims.

Nothing here waits for something not to happen. After an attack its author says something that it may say, on the same
link; when that has arrived, so would the attack have.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from support.patience import PATIENCE, eventually

pytest.importorskip("zenoh", reason="Zenoh has no wheel here")

import zenoh

from support.network_of_keys import (
    CLOCK,
    Drone,
    Team,
    announcement,
    announcements,
    free_addresses,
    now,
)
from swarmtrack.clock import SystemClock
from swarmtrack.config.drone import NetworkSection
from swarmtrack.messages import IdClash, PeerArrived, PeerDeparted, PeerEvent, PeerExpelled
from swarmtrack.security.credentials import Credentials
from swarmtrack.transport import keys, topology
from swarmtrack.transport.base import Kind
from swarmtrack.transport.link_watch import links_up
from swarmtrack.transport.links import EndpointTemplate
from swarmtrack.transport.settings import Mode, NetworkSettings
from swarmtrack.transport.zenoh_config import zenoh_config
from swarmtrack.transport.zenoh_listener import ZenohListener
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import AnnouncementMessage, announcement_message, sign_announcement

GHOST_BOOT = "0badc0de"
RANDOM = os.urandom(64 * 1024)


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> Team:
    return Team(tmp_path_factory.mktemp("keys"), "1", "2", "3", "monitor", "router-a")


class Intruder:
    """A Zenoh session with nobody's rules but its own: any certificate, any key, any bytes."""

    def __init__(self, session: zenoh.Session, team: str) -> None:
        self.session = session
        self.team = team
        self.tokens: list[Any] = []

    def key(self, kind: Kind | str, *rest: int | str) -> str:
        return keys.key(self.team, kind, *rest)

    async def put(self, kind: Kind | str, *rest: int | str, payload: bytes) -> None:
        key = self.key(kind, *rest)
        # Zenoh's default drops what a busy machine does not take within 1 ms.
        block = zenoh.CongestionControl.BLOCK
        await asyncio.to_thread(self.session.put, key, payload, congestion_control=block)

    def token(self, drone_id: int, boot: str) -> None:
        self.tokens.append(self.session.liveliness().declare_token(self.key(Kind.ALIVE, drone_id, boot)))

    def answer(self, drone_id: int, payload: bytes) -> None:
        """A queryable on a drone's pose."""
        key = self.key(Kind.POSE, drone_id)
        reply = zenoh.handlers.Callback(lambda query: query.reply(key, payload), indirect=False)
        self.tokens.append(self.session.declare_queryable(key, reply))

    async def ask(self, drone_id: int) -> list[bytes]:
        """All answers to who drone_id is."""

        def get() -> list[bytes]:
            replies = self.session.get(
                self.key(Kind.POSE, drone_id),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=2.0,
            )
            return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

        return await asyncio.to_thread(get)

    async def ask_until_answered(self, drone_id: int) -> list[bytes]:
        """The first answers: a question that comes before what was declared finds nobody who could answer."""
        async with asyncio.timeout(PATIENCE):
            while True:
                answers = await self.ask(drone_id)
                if answers:
                    return answers
                await asyncio.sleep(0.05)

    async def is_linked_to(self, name: str) -> None:
        await eventually(lambda: name in links_up(self.session).names)

    async def knows_subscribers_of(self, *drone_ids: int) -> None:
        """Drones declare their tokens last. Until their subscribers are known, nothing that is put goes to them."""
        tokens = zenoh.KeyExpr(self.key(Kind.ALIVE, "*", "**"))

        def alive() -> set[int]:
            replies = self.session.liveliness().get(tokens, timeout=2.0)
            found = (keys.parse(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None)
            return {address.drone_id for address in found if address is not None}

        async with asyncio.timeout(PATIENCE):
            while True:
                if (await asyncio.to_thread(alive)).issuperset(drone_ids):
                    return
                await asyncio.sleep(0.05)


def lawless(network: NetworkSettings, **changes: Any) -> zenoh.Config:
    """A config that keeps no rules at its own end. changes: of entries, by path."""
    config = zenoh_config(network, network.listen, network.connect)
    config.insert_json5("access_control/enabled", "false")
    for path, value in changes.items():
        config.insert_json5(path, json.dumps(value))
    return config


class Field:
    """Drones 1 and 2 of the team, who know each other, and whoever else a test lets in."""

    def __init__(self, team: Team) -> None:
        self.team = team
        self.addresses = dict(zip((1, 2, 3), free_addresses(3), strict=True))
        peers = {str(i): address for i, address in self.addresses.items()}
        self.section = NetworkSection(team=team.name, peers=peers)
        self.drones: list[Drone] = []
        self.sessions: list[zenoh.Session] = []

    async def drone(self, drone_id: int, sequence: int = 1, boot: str = "") -> Drone:
        network = topology.of_drone(self.section, drone_id, self.team.credentials(str(drone_id)))
        self.drones.append(await Drone(network, drone_id, boot).start(sequence))
        return self.drones[-1]

    async def intruder(self, credentials: Credentials, listen: tuple[str, ...] = ()) -> Intruder:
        """Linked to drones 1 and 2."""
        connect = EndpointTemplate.PAIR.at_all((self.addresses[1], self.addresses[2]), "test")
        network = NetworkSettings(
            self.team.name, listen, connect, credentials=credentials, expected=("drone-1", "drone-2")
        )
        session = await asyncio.to_thread(zenoh.open, lawless(network))
        self.sessions.append(session)
        intruder = Intruder(session, self.team.name)
        await intruder.is_linked_to("drone-1")
        await intruder.is_linked_to("drone-2")
        return intruder

    async def close(self) -> None:
        for session in self.sessions:
            await asyncio.to_thread(session.close)
        for drone in self.drones:
            await drone.stop()


@pytest.fixture
async def field(team: Team) -> AsyncIterator[Field]:
    field = Field(team)
    yield field
    await field.close()


@pytest.fixture
async def pair(field: Field) -> tuple[Drone, Drone]:
    one, two = await field.drone(1), await field.drone(2)
    await one.knows(two)
    await two.knows(one)
    return one, two


def signed(credentials: Credentials, team: str, drone_id: int, boot: str, sequence: int = 1) -> bytes:
    """The bytes of an announcement by drone_id, signed by whoever's credentials these are."""
    assert credentials.sign is not None
    return sign_announcement(
        unsigned(drone_id, boot, sequence), keys.key(team, Kind.POSE, drone_id), credentials.sign
    )


def unsigned(drone_id: int, boot: str, sequence: int = 1) -> bytes:
    made = announcement(drone_id, boot, sequence)
    return codec.encode(announcement_message(made, CLOCK.utc() - CLOCK.now(), CLOCK.now()))


async def counted(drone: Drone, counter: str, times: int = 1) -> None:
    await eventually(lambda: drone.counter(counter) >= times)


def of(told: list[PeerEvent], drone_id: int) -> list[PeerEvent]:
    return [event for event in told if event.drone_id == drone_id]


# --- who is let in ----------------------------------------------------------------------


async def test_with_keys_the_team_knows_each_other_over_named_links(field: Field) -> None:
    three, one, two = await field.drone(3), await field.drone(1), await field.drone(2)
    for drone, others in ((one, (two, three)), (two, (one, three)), (three, (one, two))):
        await drone.knows(*others)
    assert "linked to drone-1, drone-2" in three.transport.status().text
    assert three.counter("strangers") == 0


@pytest.mark.parametrize("protocol", ["tls", "quic"])
@pytest.mark.parametrize("shows", ["no certificate", "a certificate of another CA of the same name"])
async def test_whoever_has_no_certificate_of_the_team_gets_no_link(
    field: Field, pair: tuple[Drone, Drone], tmp_path: Path, protocol: str, shows: str
) -> None:
    one, two = pair
    endpoint = next(e for e in EndpointTemplate.PAIR.at(field.addresses[1], "test") if e.startswith(protocol))
    foreign = Team(tmp_path / "foreign", "3", name=field.team.name).credentials("3")
    trusting = replace(foreign, ca=field.team.credentials("3").ca)  # it believes us; we do not believe it
    network = NetworkSettings(field.team.name, connect=(endpoint,), credentials=trusting, mode=Mode.CLIENT)
    changes: dict[str, Any] = {"connect/timeout_ms": 3000}
    if shows == "no certificate":
        changes |= {
            "transport/link/tls/enable_mtls": False,
            "transport/link/tls/connect_private_key": None,
            "transport/link/tls/connect_certificate": None,
        }
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        await asyncio.to_thread(zenoh.open, lawless(network, **changes))
    await one.announce(2)  # life goes on
    await two.knows(one, sequence=2)
    assert "linked to drone-2; not to drone-3" in one.transport.status().text


async def test_without_tls_nobody_gets_in(field: Field, pair: tuple[Drone, Drone]) -> None:
    one, _ = pair
    network = NetworkSettings(field.team.name, connect=(f"tcp/{field.addresses[1]}",), mode=Mode.CLIENT)
    config = zenoh_config(network, (), network.connect)
    config.insert_json5("connect/timeout_ms", "3000")
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        await asyncio.to_thread(zenoh.open, config)
    assert "linked to drone-2; not to drone-3" in one.transport.status().text


async def test_a_certificate_that_is_not_in_our_roster_is_counted_and_not_heard(tmp_path: Path) -> None:
    """Issued after we got our keys, or revoked since: the roster decides, not the certificate alone."""
    team = Team(tmp_path / "keys", "1", "2")
    field = Field(team)
    try:
        one = await field.drone(1)
        two = await field.drone(2)
        await one.knows(two)
        team.issue("3")
        newcomer = await field.intruder(team.credentials("3"))
        newcomer.token(3, GHOST_BOOT)
        await newcomer.put(Kind.POSE, 3, payload=signed(team.credentials("3"), team.name, 3, GHOST_BOOT))
        await counted(one, "strangers")
        await two.announce(2)
        await one.knows(two, sequence=2)
        assert of(one.told, 3) == []
        assert await newcomer.ask(1) == []  # nor is it answered
    finally:
        await field.close()


async def test_whoever_is_revoked_in_flight_is_dropped_where_the_roster_is_copied_to(tmp_path: Path) -> None:
    """The links of those who stay are made anew, and they know each other again."""
    field = Field(Team(tmp_path / "ca", "1", "2", "3"))
    one, two, three = [await field.drone(drone) for drone in (1, 2, 3)]
    await one.knows(two, three)
    await two.knows(one, three)
    field.team.authority.revoke("drone-3")
    for drone in (one, two):
        await drone.transport.renew(field.team.credentials(str(drone.drone_id)))
        await drone.until(lambda told: PeerExpelled(3) in told)
    since = {drone: len(drone.told) for drone in (one, two)}
    for drone, other in ((one, two), (two, one)):
        known = (other.drone_id, other.boot, 1)
        await drone.until(
            lambda told, begin=since[drone], known=known: (
                known in announcements(told[begin:])  # type: ignore[misc]
                or announcements(told).count(known) > 1
            )
        )
    await three.announce(2)
    await two.announce(2)
    await one.knows(two, sequence=2)
    assert (3, three.boot, 2) not in announcements(one.told)
    assert PeerArrived(3, three.boot) not in one.told[one.told.index(PeerExpelled(3)) :]
    await field.close()


async def test_a_listener_hears_whoever_is_revoked_no_more(tmp_path: Path) -> None:
    """It looks at its folder by itself, as monitors, recorders and clients do."""
    field = Field(Team(tmp_path / "ca", "1", "2", "3", "monitor"))
    drones = [await field.drone(drone) for drone in (1, 2, 3)]
    network = topology.of_monitor(field.section, field.team.credentials("monitor"))
    listener = ZenohListener(network, keys.key(field.team.name, Kind.HEALTH, "*"), SystemClock())
    await listener.open()
    heard: Counter[int] = Counter()

    async def listen() -> None:
        async for sample in listener.samples():
            address = keys.parse(sample.key)
            assert address is not None
            if address.kind is Kind.HEALTH:
                heard[address.drone_id] += 1

    def speak() -> None:
        for drone in drones:
            drone.transport.publish(Kind.HEALTH, b"?")

    def all_are_heard() -> bool:
        speak()
        return set(heard) == {1, 2, 3}

    listening = asyncio.create_task(listen())
    await eventually(all_are_heard)
    field.team.authority.revoke("drone-3")
    before = listener.links()
    await eventually(lambda: listener.links() != before)
    await eventually(lambda: {"drone-1", "drone-2"} <= listener.links().names)
    heard.clear()

    def others_are_heard() -> bool:
        speak()
        return heard[1] > 3 and heard[2] > 3

    await eventually(others_are_heard)
    assert heard[3] == 0
    await listener.close()
    await listening
    await field.close()


async def test_a_link_ends_with_the_certificate(tmp_path: Path) -> None:
    team = Team(tmp_path / "keys", "1")
    soon = timedelta(seconds=10)
    team.authority.issue(["drone-2"], now() - timedelta(days=1) + soon, days=1)
    field = Field(team)
    try:
        one, two = await field.drone(1), await field.drone(2)
        await one.knows(two)
        await one.until(lambda told: PeerDeparted(2, two.boot) in told)
        assert now() >= two.network.credentials.expires  # type: ignore[union-attr]
    finally:
        await field.close()


# --- who may speak as whom --------------------------------------------------------------

Attack = Callable[[Intruder, bytes], Awaitable[None]]


async def put(intruder: Intruder, forged: bytes) -> None:
    await intruder.put(Kind.POSE, 2, payload=forged)


async def put_with_a_wildcard(intruder: Intruder, forged: bytes) -> None:
    for key in (("pose", "*"), ("*", "2"), ("**",)):
        await intruder.put(*key, payload=forged)


async def delete(intruder: Intruder, forged: bytes) -> None:
    await asyncio.to_thread(intruder.session.delete, intruder.key(Kind.POSE, 2))


async def token(intruder: Intruder, forged: bytes) -> None:
    intruder.token(2, GHOST_BOOT)


async def reply(intruder: Intruder, forged: bytes) -> None:
    intruder.answer(2, forged)


@pytest.mark.parametrize("attack", [put, put_with_a_wildcard, delete, token, reply])
async def test_a_member_cannot_speak_as_another(
    field: Field, pair: tuple[Drone, Drone], attack: Attack
) -> None:
    one, two = pair
    three = field.team.credentials("3")
    intruder = await field.intruder(three)
    before = list(of(one.told, 2))
    await attack(intruder, signed(three, field.team.name, 2, two.boot, 9))
    own_boot = keys.new_boot()
    intruder.token(3, own_boot)
    await one.until(lambda told: PeerArrived(3, own_boot) in told)
    # What was asked for is answered by the drone itself, and by nobody else.
    asking = await field.intruder(field.team.credentials("monitor"))
    answers = [codec.decode(AnnouncementMessage, data) for data in await asking.ask_until_answered(2)]
    assert [(a.boot, a.sequence) for a in answers] == [(two.boot, 1)]
    assert of(one.told, 2) == before
    refused = (
        "announcements_forged",
        "announcements_unsigned",
        "announcements_malformed",
        "tokens_malformed",
    )
    assert not any(map(one.counter, refused)), "it was stopped before a byte of it was read"


async def test_tracks_of_a_member_reach_others_under_its_own_id_only(
    field: Field, pair: tuple[Drone, Drone]
) -> None:
    intruder = await field.intruder(
        field.team.credentials("3"), listen=EndpointTemplate.PAIR.at(field.addresses[3], "test")
    )
    monitor = ZenohListener(
        topology.of_monitor(field.section, field.team.credentials("monitor")),
        intruder.key(Kind.TRACKS, "*"),
        SystemClock(),
    )
    await monitor.open()
    await intruder.is_linked_to("monitor")
    heard: list[str] = []
    async with asyncio.timeout(PATIENCE):
        while not heard:  # again: what is put before its subscription has arrived is lost
            for drone_id in (1, 2, "*", 3):
                await intruder.put(Kind.TRACKS, drone_id, payload=b"forged")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.1):
                    heard += [(await anext(monitor.samples())).key]
    assert set(heard) == {intruder.key(Kind.TRACKS, 3)}
    await monitor.close()


async def test_a_monitor_may_watch_video_which_a_drone_then_knows(
    field: Field, pair: tuple[Drone, Drone]
) -> None:
    one, two = pair
    listener = ZenohListener(
        topology.of_monitor(field.section, field.team.credentials("monitor")),
        keys.all_but_video(field.team.name),
        SystemClock(),
    )
    await listener.open()
    await listener.listen_to(keys.key(field.team.name, Kind.VIDEO, 1))
    await eventually(lambda: one.transport.has_listener(Kind.VIDEO))
    assert not two.transport.has_listener(Kind.VIDEO)
    async with asyncio.timeout(PATIENCE):
        async for sample in listener.samples():
            one.transport.publish(Kind.VIDEO, b"a picture")
            if sample.payload == b"a picture":
                break
            two.transport.publish(Kind.HEALTH, b"for the next sample")
    await listener.close()
    await eventually(lambda: not one.transport.has_listener(Kind.VIDEO))


async def test_a_monitor_may_ask_but_not_speak(field: Field, pair: tuple[Drone, Drone]) -> None:
    one, two = pair
    monitor = await field.intruder(field.team.credentials("monitor"))
    for drone_id in (2, 3):
        monitor.token(drone_id, GHOST_BOOT)
        monitor.answer(drone_id, unsigned(drone_id, GHOST_BOOT))
        await monitor.put(Kind.POSE, drone_id, payload=unsigned(drone_id, GHOST_BOOT))
    answers = [codec.decode(AnnouncementMessage, data) for data in await monitor.ask_until_answered(1)]
    assert [a.boot for a in answers] == [one.boot]
    await two.announce(2)
    await one.knows(two, sequence=2)
    assert announcements(one.told) == [(2, two.boot, 1), (2, two.boot, 2)]
    assert not [event for event in one.told if isinstance(event, IdClash)]
    assert of(one.told, 3) == []


# --- what is signed ---------------------------------------------------------------------
# Now the intruder holds drone 3's certificate, but not its signing key: as a router in between would.


async def test_announcements_unsigned_or_wrongly_signed_are_counted_and_not_told(
    field: Field, pair: tuple[Drone, Drone]
) -> None:
    one, _ = pair
    thief = await field.intruder(field.team.credentials("3"))
    thief.token(3, GHOST_BOOT)
    await one.until(lambda told: PeerArrived(3, GHOST_BOOT) in told)

    await thief.put(Kind.POSE, 3, payload=unsigned(3, GHOST_BOOT))
    await counted(one, "announcements_unsigned")

    genuine = signed(field.team.credentials("3"), field.team.name, 3, GHOST_BOOT)
    by_another = signed(field.team.credentials("2"), field.team.name, 3, GHOST_BOOT)
    for_another_team = signed(field.team.credentials("3"), "blue", 3, GHOST_BOOT)
    tampered = genuine[:-1] + bytes([genuine[-1] ^ 1])
    forged = [by_another, for_another_team, tampered]
    for payload in forged:
        await thief.put(Kind.POSE, 3, payload=payload)
    await counted(one, "announcements_forged", len(forged))
    assert announcements(of(one.told, 3)) == []

    await thief.put(Kind.POSE, 3, payload=genuine)  # the test can fail: this one is believed
    await one.until(lambda told: (3, GHOST_BOOT, 1) in announcements(told))


async def test_an_announcement_of_an_earlier_boot_is_not_believed_again(
    field: Field, pair: tuple[Drone, Drone]
) -> None:
    """Recorded yesterday, played today; nor by who has just restarted and remembers nothing."""
    one, two = pair
    recorded = signed(field.team.credentials("3"), field.team.name, 3, GHOST_BOOT)
    three = await field.drone(3)
    await one.knows(three)
    thief = await field.intruder(field.team.credentials("3"))
    await thief.put(Kind.POSE, 3, payload=recorded)
    await counted(one, "announcements_before_token")
    assert announcements(of(one.told, 3)) == [(3, three.boot, 1)]

    await one.stop()
    field.drones.remove(one)
    again = await field.drone(1)
    await again.knows(two, three)
    await thief.is_linked_to("drone-1")
    async with asyncio.timeout(PATIENCE):
        while again.counter("announcements_before_token") < 1:  # its link comes up at its own pace
            await thief.put(Kind.POSE, 3, payload=recorded)
            await asyncio.sleep(0.05)
    assert announcements(of(again.told, 3)) == [(3, three.boot, 1)]


async def test_an_announcement_that_was_replaced_is_not_believed_again(
    field: Field, pair: tuple[Drone, Drone]
) -> None:
    one, _ = pair
    three = await field.drone(3)
    await one.knows(three)
    recorded = signed(field.team.credentials("3"), field.team.name, 3, three.boot, 1)
    await three.announce(2)
    await one.knows(three, sequence=2)
    thief = await field.intruder(field.team.credentials("3"))
    await thief.put(Kind.POSE, 3, payload=recorded)
    await counted(one, "announcements_repeated")
    assert announcements(of(one.told, 3))[-1] == (3, three.boot, 2)


# --- bytes ------------------------------------------------------------------------------


async def test_random_bytes_on_every_key_are_counted_and_nothing_stops(
    field: Field, pair: tuple[Drone, Drone]
) -> None:
    one, two = pair
    intruder = await field.intruder(field.team.credentials("3"))
    await intruder.knows_subscribers_of(1, 2)
    for kind in Kind:
        for rest in ((1,), (2,), (3,), (3, GHOST_BOOT), ("x",), (0,), (3, 3, 3), ("*",)):
            await intruder.put(kind, *rest, payload=RANDOM)
    await counted(one, "announcements_malformed")
    await counted(one, "sightings_malformed")
    # On its own keys only.
    assert one.counter("announcements_malformed") == one.counter("sightings_malformed") == 1
    await two.announce(2)
    await one.knows(two, sequence=2)
    assert of(one.told, 3) == []


# --- a router in between ----------------------------------------------------------------


class Relayed:
    """Drones as clients of one router, which a test holds in its hands."""

    def __init__(self, team: Team) -> None:
        self.section = NetworkSection(team=team.name, topology="routers", routers=tuple(free_addresses(1)))
        self.team = team
        self.drones: list[Drone] = []
        self.router: Intruder | None = None

    async def open_router(self) -> Intruder:
        network = topology.of_router(self.section, self.section.routers[0], self.team.credentials("router-a"))
        session = await asyncio.to_thread(zenoh.open, zenoh_config(network, network.listen, network.connect))
        self.router = Intruder(session, self.team.name)
        return self.router

    async def drone(self, drone_id: int) -> Drone:
        network = topology.of_drone(self.section, drone_id, self.team.credentials(str(drone_id)))
        self.drones.append(await Drone(network, drone_id).start())
        return self.drones[-1]

    async def close(self) -> None:
        for drone in self.drones:
            await drone.stop()
        if self.router is not None:
            await asyncio.to_thread(self.router.session.close)


@pytest.fixture
async def relayed(team: Team) -> AsyncIterator[Relayed]:
    relayed = Relayed(team)
    yield relayed
    await relayed.close()


async def test_drones_behind_a_router_know_each_other_whoever_started_first(relayed: Relayed) -> None:
    early = await relayed.drone(1)  # before there is a router
    assert not early.transport.status().ok
    await relayed.open_router()
    late = await relayed.drone(2)
    await early.knows(late)
    await late.knows(early)
    assert "linked to router-a" in early.transport.status().text


async def test_a_router_that_tampers_changes_no_announcement(relayed: Relayed) -> None:
    router = await relayed.open_router()
    one, two = await relayed.drone(1), await relayed.drone(2)
    await one.knows(two)
    (genuine,) = await router.ask_until_answered(2)
    tampered = bytearray(genuine)
    tampered[genuine.index(two.boot.encode()) + len(two.boot)] += 1  # the sequence, so that it is news
    await router.put(Kind.POSE, 2, payload=bytes(tampered))
    await counted(one, "announcements_forged")
    assert announcements(one.told) == [(2, two.boot, 1)]


async def test_a_router_can_invent_a_presence_but_not_a_pose(relayed: Relayed) -> None:
    """What is not signed rests on the router: tokens, tracks, health and identities."""
    router = await relayed.open_router()
    one = await relayed.drone(1)
    router.token(3, GHOST_BOOT)
    await one.until(lambda told: PeerArrived(3, GHOST_BOOT) in told)
    await router.put(Kind.POSE, 3, payload=unsigned(3, GHOST_BOOT))
    await counted(one, "announcements_unsigned")
    assert announcements(one.told) == []


async def test_a_drone_behind_a_router_cannot_speak_as_another(relayed: Relayed) -> None:
    await relayed.open_router()
    one, two = await relayed.drone(1), await relayed.drone(2)
    await one.knows(two)
    three = relayed.team.credentials("3")
    network = topology.of_drone(relayed.section, 3, three)
    session = await asyncio.to_thread(zenoh.open, lawless(network))
    intruder = Intruder(session, relayed.team.name)
    try:
        intruder.token(2, GHOST_BOOT)
        await intruder.put(Kind.POSE, 2, payload=signed(three, relayed.team.name, 2, two.boot, 9))
        own_boot = keys.new_boot()
        intruder.token(3, own_boot)
        await one.until(lambda told: PeerArrived(3, own_boot) in told)
        assert announcements(one.told) == [(2, two.boot, 1)]
        assert not [event for event in one.told if isinstance(event, IdClash)]
        assert one.counter("announcements_forged") == 0  # the router stopped it
    finally:
        await asyncio.to_thread(session.close)


async def test_one_that_is_linked_and_does_not_answer_is_not_heard_and_costs_the_others_no_link(
    field: Field, pair: tuple[Drone, Drone]
) -> None:
    """As a drone whose token was lost on its way, or a program that holds its keys and is no agent."""
    one, two = pair
    await field.intruder(field.team.credentials("3"))
    await eventually(lambda: "silent: drone 3" in one.transport.status().text)
    # It may never have heard of us: that is said again, once, over the links that stand.
    await eventually(lambda: one.counter("declared_again") and two.counter("declared_again"))
    await asyncio.sleep(5.0)  # longer than it took the first time
    assert one.counter("declared_again") == two.counter("declared_again") == 1
    assert one.counter("links_renewed") == two.counter("links_renewed") == 0
    assert not any(isinstance(event, PeerDeparted) for event in one.told + two.told)


async def test_one_that_has_nothing_to_announce_yet_and_reports_nothing_is_heard(field: Field) -> None:
    one = await field.drone(1)
    network = topology.of_drone(field.section, 2, field.team.credentials("2"))
    two = Drone(network, 2)
    field.drones.append(two)
    await two.transport.open()
    await one.until(lambda told: any(isinstance(event, PeerArrived) for event in told))
    await asyncio.sleep(5.0)  # two leases and more
    assert one.counter("links_renewed") == two.counter("links_renewed") == 0
    assert "silent: drone" not in one.transport.status().text + two.transport.status().text
