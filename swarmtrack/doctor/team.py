"""Network check as a listener, not as a drone: this drone's agent may run meanwhile, and must not see a clone."""

from __future__ import annotations

import asyncio
import contextlib
import errno
from collections import defaultdict
from dataclasses import replace

from swarmtrack.clock import Clock, utc_offset
from swarmtrack.config.drone import DroneConfig
from swarmtrack.diagnosis.surroundings import NetworkFacts
from swarmtrack.errors import TransportError
from swarmtrack.runtime.network_facts import network_facts
from swarmtrack.security import names
from swarmtrack.security.credentials import Credentials
from swarmtrack.transport import keys, topology
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.ports import obstacle
from swarmtrack.transport.sender_clock import SenderClock
from swarmtrack.transport.settings import Mode, parse_endpoint
from swarmtrack.transport.zenoh_listener import ZenohListener
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import AnnouncementMessage
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.health import HealthMessage

CLOCKS_AGREE = 2.0  # s


async def ask(config: DroneConfig, clock: Clock, seconds: float) -> NetworkFacts:
    """Agents that answer within `seconds`, with their health."""
    facts, credentials = network_facts(config, clock)
    if facts.in_process or facts.keys_refused or facts.wrong_address:
        return facts
    try:
        return await _listen(config, credentials, clock, seconds, facts)
    except TransportError as error:
        return replace(facts, refused=str(error))


async def _listen(
    config: DroneConfig, credentials: Credentials | None, clock: Clock, seconds: float, facts: NetworkFacts
) -> NetworkFacts:
    as_drone = topology.of_drone(config.network, config.drone.id, credentials)
    absent, taken = await _own_addresses(as_drone.listen)
    facts = replace(facts, absent_hosts=absent)
    listener = ZenohListener(
        topology.of_monitor(config.network, credentials), keys.all_but_video(config.network.team), clock
    )
    alive: dict[int, set[str]] = defaultdict(set)
    clocks: dict[int, SenderClock] = defaultdict(SenderClock)
    told: dict[int, HealthMessage] = {}
    try:
        await listener.open()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                async for sample in listener.samples():
                    _note(sample, clock, alive, clocks, told)
        linked = listener.links().names
    finally:
        await listener.close()
    if taken and config.drone.id not in alive:
        raise TransportError(f"{taken}; does another agent run here?")
    wanted = [name for name in as_drone.expected if _id_of(name) not in alive]
    strangers = () if credentials is None else tuple(sorted(linked - set(credentials.roster.names)))
    return replace(
        facts,
        alive={i: tuple(boots) for i, boots in alive.items()},
        apart_s={i: clock.apart_s for i, clock in clocks.items() if i != config.drone.id},
        missing=tuple(wanted) if as_drone.mode != Mode.CLIENT else (),
        strangers=strangers,
        tracks_say={
            i: (health.noise.found, health.noise.remedy)
            for i, health in told.items()
            if health.noise is not None and health.noise.found
        },
    )


def _note(
    sample: Sample,
    clock: Clock,
    alive: dict[int, set[str]],
    clocks: dict[int, SenderClock],
    told: dict[int, HealthMessage],
) -> None:
    address = keys.parse(sample.key)
    if address is None:
        return
    if address.kind == Kind.ALIVE and address.rest:
        (alive[address.drone_id].add if sample.alive else alive[address.drone_id].discard)(address.rest[0])
        if not alive[address.drone_id]:
            del alive[address.drone_id]
    elif address.kind == Kind.HEALTH:
        with contextlib.suppress(DecodeError):
            told[address.drone_id] = codec.decode(HealthMessage, sample.payload)
    elif address.kind == Kind.POSE:
        with contextlib.suppress(DecodeError):
            clocks[address.drone_id].time_of(
                codec.decode(AnnouncementMessage, sample.payload),
                arrived=sample.arrived,
                utc_offset=utc_offset(clock),
                tolerance=CLOCKS_AGREE,
            )


async def _own_addresses(endpoints: tuple[str, ...]) -> tuple[tuple[str, ...], str]:
    """Hosts to listen on that are not this machine's, and what is against listening where it is ours."""
    absent, taken = [], ""
    for text in endpoints:
        endpoint = parse_endpoint(text, "network.listen")
        error = await obstacle(endpoint)
        if error is None:
            continue
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            taken = taken or f"network: cannot listen on {text}: {error.strerror}"
        elif endpoint.host not in absent:
            absent.append(endpoint.host)
    return tuple(absent), taken


def _id_of(name: str) -> int | None:
    return names.drone_id(name) if names.role(name) == names.Role.DRONE else None
