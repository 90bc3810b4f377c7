"""A ROS 2 node in the form of rmw_zenoh, on a Zenoh session of its own that has nothing to do with the team's.

A topic is a publisher and a liveliness token, by which `ros2 topic list` shows it. A message is encoded and put only
while Zenoh reports a subscriber to exactly this topic, type and hash. Declarations may block, so they are made on
another thread. Nothing is subscribed to: ROS 2 cannot command the swarm.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Protocol

import zenoh

from swarmtrack.clock import Clock
from swarmtrack.config.ros2 import Ros2Section
from swarmtrack.errors import SwarmtrackError, TransportError
from swarmtrack.outputs.ros2.cdr import TYPE_HASHES, Leaves, encode
from swarmtrack.outputs.ros2.connection import open_ros2_session
from swarmtrack.transport.limits import SESSION_OPEN_S
from swarmtrack.transport.settings import NetworkSettings
from swarmtrack.transport.zenoh_session import bounded, close_session

log = logging.getLogger(__name__)

QOS_DEFAULT: Final = "::,10:,:,:,,"
"""Reliable, volatile, the last ten: what a subscriber of ROS 2 asks for by default."""
QOS_FRAMES: Final = "::,100:,:,:,,"
QOS_SENSOR: Final = "2::,5:,:,:,,"
"""Best effort, the last five, as camera drivers have it."""
MOST_ROS_TOPICS: Final = 4096
"""A hundred drones have some 30 each; more is an attack or a mistake."""

_UNHASHED: Final = "TypeHashNotSupported"  # in Humble's keys
_GID_BYTES: Final = 16


class RosPublisher(Protocol):
    """Where messages go."""

    def declare(self, topic: str, kind: str, qos: str = QOS_DEFAULT) -> None:
        """Show a topic to ROS 2. kind: its type, such as `nav_msgs/msg/Odometry`."""
        ...

    def offer(self, topic: str, kind: str, make: Callable[[], Leaves], qos: str = QOS_DEFAULT) -> None:
        """Publish what `make` returns, which is called only if there is a subscriber; declares the topic first."""
        ...

    def has_listener(self, topic: str) -> bool:
        """Whether a node subscribes to a topic."""
        ...

    async def forget(self, prefix: str) -> None:
        """Take back all topics below a name, such as those of a drone that is gone."""
        ...


@dataclass(slots=True)
class _Topic:
    kind: str
    qos: str
    gid: bytes = field(default_factory=lambda: secrets.token_bytes(_GID_BYTES))
    declared: tuple[zenoh.Publisher, zenoh.LivelinessToken] | None = None
    listened: bool = False
    sequence: int = 0


class RosNode:
    """One node. network: of its session, as `connection` makes it. name: of the node."""

    def __init__(self, network: NetworkSettings, section: Ros2Section, name: str, clock: Clock) -> None:
        self._network = network
        self._name = name
        self._clock = clock
        self._domain_id = section.domain
        self._distro = section.distro
        self._session: zenoh.Session | None = None
        self._token: zenoh.LivelinessToken | None = None
        self._topics: dict[str, _Topic] = {}
        self._undeclared: asyncio.Queue[str] = asyncio.Queue(MOST_ROS_TOPICS)
        self._declaring: asyncio.Task[None] | None = None
        self.unsent = 0
        """Messages that the link did not take, or that could not be encoded."""

    async def open(self) -> None:
        """Raises TransportError: no router answers, or the port of a router is taken."""
        session = await open_ros2_session(self._network)
        node = f"@ros2_lv/{self._domain_id}/{session.info.zid()}/0/0/NN/%/%/{self._name}"
        self._token = await bounded(
            lambda: session.liveliness().declare_token(node), SESSION_OPEN_S, "declare"
        )
        self._session = session
        self._declaring = asyncio.create_task(self._declare_topics(session), name="ROS 2 topics")

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of all topics."""
        return tuple(self._topics)

    def has_listener(self, topic: str) -> bool:
        """As `RosPublisher`."""
        entry = self._topics.get(topic)
        return entry is not None and entry.listened

    def declare(self, topic: str, kind: str, qos: str = QOS_DEFAULT) -> None:
        """As `RosPublisher`; returns at once. Raises ValueError for a type that is not in the table."""
        if topic in self._topics:
            return
        if kind not in TYPE_HASHES:
            raise ValueError(f"{topic}: found type {kind}, expected of {', '.join(TYPE_HASHES)}")
        if len(self._topics) < MOST_ROS_TOPICS and not self._undeclared.full():
            self._topics[topic] = _Topic(kind, qos)
            self._undeclared.put_nowait(topic)

    def offer(self, topic: str, kind: str, make: Callable[[], Leaves], qos: str = QOS_DEFAULT) -> None:
        """As `RosPublisher`; returns at once."""
        entry = self._topics.get(topic)
        if entry is None:
            self.declare(topic, kind, qos)
        elif entry.listened and entry.declared is not None:
            self._put(topic, entry, make)

    def _put(self, name: str, topic: _Topic, make: Callable[[], Leaves]) -> None:
        assert topic.declared is not None
        try:
            payload = encode(topic.kind, make())
            topic.sequence += 1
            stamp = round(self._clock.utc() * 1e9)
            attachment = struct.pack("<qqB16s", topic.sequence, stamp, _GID_BYTES, topic.gid)
            topic.declared[0].put(payload, attachment=attachment)
        except (zenoh.ZError, SwarmtrackError, ValueError, struct.error) as error:
            self.unsent += 1
            log.log(logging.DEBUG if self.unsent > 1 else logging.WARNING, "%s is not sent: %s", name, error)

    async def forget(self, prefix: str) -> None:
        """As `RosPublisher`. Raises TransportError."""
        gone = [name for name in self._topics if name.startswith(prefix)]
        for topic in [self._topics.pop(name) for name in gone]:
            for entity in reversed(topic.declared or ()):
                await bounded(entity.undeclare, SESSION_OPEN_S, "undeclare")

    async def close(self) -> None:
        if self._declaring is not None:
            self._declaring.cancel()
        session, self._session = self._session, None
        if session is not None:
            tokens = [topic.declared[1] for topic in self._topics.values() if topic.declared]
            await close_session(session, [*tokens, self._token], self._network.listen)

    async def _declare_topics(self, session: zenoh.Session) -> None:
        for eid in range(1, 2**31):
            name = await self._undeclared.get()
            topic = self._topics.get(name)
            if topic is None:  # forgotten meanwhile
                continue
            try:
                declare = partial(self._declare, session, name, topic, eid)
                topic.declared = await bounded(declare, SESSION_OPEN_S, "declare")
            except TransportError as error:
                log.warning("ROS 2 topic %s: %s", name, error)
                self._topics.pop(name, None)  # it is offered again

    def _declare(
        self, session: zenoh.Session, name: str, topic: _Topic, eid: int
    ) -> tuple[zenoh.Publisher, zenoh.LivelinessToken]:
        """The publisher, and then what announces it; on a thread of its own."""
        package, _, short = topic.kind.split("/")
        type_name = f"{package}::msg::dds_::{short}_"
        type_hash = _UNHASHED if self._distro == "humble" else TYPE_HASHES[topic.kind]
        publisher = session.declare_publisher(
            f"{self._domain_id}/{name.removeprefix('/')}/{type_name}/{type_hash}",
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.BEST_EFFORT
            if topic.qos == QOS_SENSOR
            else zenoh.Reliability.RELIABLE,
        )

        def on_listeners(status: zenoh.MatchingStatus) -> None:
            topic.listened = status.matching

        publisher.declare_matching_listener(zenoh.handlers.Callback(on_listeners, indirect=False))
        mangled = name.replace("/", "%")
        token = session.liveliness().declare_token(
            f"@ros2_lv/{self._domain_id}/{session.info.zid()}/0/{eid}/MP/%/%/{self._name}/"
            f"{mangled}/{type_name}/{type_hash}/{topic.qos}"
        )
        return publisher, token
