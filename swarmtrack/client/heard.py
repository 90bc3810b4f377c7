"""State of a team as a planner receives it: live drones, their cameras, and which messages count."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TypeVar

from swarmtrack.client.axes import Axes
from swarmtrack.client.freshness import Mark, MessageOrder
from swarmtrack.client.sight import (
    DroneCamera,
    DroneHealth,
    Sight,
    Stranger,
    camera_of,
    sight_of,
    strangers_of,
)
from swarmtrack.clock import Clock, SystemClock, utc_offset
from swarmtrack.messages import PeerArrived, PeerDeparted
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.transport.membership import Membership
from swarmtrack.wire import codec
from swarmtrack.wire.camera import CameraMessage
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.motion import MotionMessage
from swarmtrack.wire.sightings import SightingsMessage
from swarmtrack.wire.strangers import StrangersMessage
from swarmtrack.wire.tracks import TracksMessage
from swarmtrack.wire.video import VideoMessage

M = TypeVar(
    "M",
    CameraMessage,
    HealthMessage,
    MotionMessage,
    SightingsMessage,
    StrangersMessage,
    TracksMessage,
    VideoMessage,
)
Timed = TypeVar(
    "Timed", HealthMessage, MotionMessage, SightingsMessage, StrangersMessage, TracksMessage, VideoMessage
)

# An ID that no drone has: we are of no team.
NO_DRONE_ID = 0
# s: whoever has had two boots for longer has not restarted (with the default lease).
CLASH_S = 2.5


class HeardTeam:
    """Takes samples; returns what they contain. Messages of a drone that is not alive do not count, and are
    counted. One that is repeated, out of order or of another time is marked, and counted. clock: ours, by which samples
    are stamped.
    """

    def __init__(self, team: str, axes: Axes, clock: Clock | None = None) -> None:
        self._team = team
        self._axes = axes
        self._membership = Membership(NO_DRONE_ID, "", CLASH_S)
        self._cameras: dict[tuple[int, str], DroneCamera] = {}
        self._clock = clock or SystemClock()
        self._freshness: dict[str, MessageOrder] = {}
        self._counters: Counter[str] = Counter()

    @property
    def drones(self) -> tuple[int, ...]:
        """IDs of all live drones."""
        return tuple(sorted(self._membership.peers))

    @property
    def without_camera(self) -> tuple[int, ...]:
        """Drones whose camera message is to be requested."""
        return tuple(
            i for i in self.drones if any((i, b) not in self._cameras for b in self._membership.speaking(i))
        )

    @property
    def counters(self) -> Counter[str]:
        """Rejected messages, by reason."""
        return self._counters + self._membership.counters

    def camera(self, drone_id: int) -> DroneCamera | None:
        """Camera of a drone; None while it is unknown, or while two processes use this ID."""
        boots = self._membership.speaking(drone_id)
        return self._cameras.get((drone_id, boots[0])) if len(boots) == 1 else None

    def on_token(self, key: str, alive: bool, arrived: float) -> None:
        address = keys.parse(key)
        if (
            address is None
            or address.team != self._team
            or len(address.rest) != 1
            or not keys.is_boot(address.rest[0])
        ):
            self._counters["tokens_malformed"] += 1
            return
        drone_id, boot = address.drone_id, address.rest[0]
        if alive:
            events = self._membership.arrived(drone_id, boot, arrived)
        else:
            events = self._membership.departed(drone_id, boot)
        for event in events:
            if isinstance(event, PeerDeparted):
                self._cameras.pop((drone_id, event.boot), None)
            if isinstance(event, PeerArrived):
                self._forget_order(drone_id)

    def on_camera(self, sample: Sample) -> CameraMessage | None:
        drone_id, message = self._read(CameraMessage, Kind.CAMERA, sample)
        if message is None:
            return None
        if message.drone_id != drone_id:
            self._counters["camera_on_wrong_key"] += 1
            return None
        if message.boot not in self._membership.alive(drone_id):
            self._counters["camera_before_token"] += 1
            return None
        # The first one stays: it is the same for the whole life of a process.
        self._cameras.setdefault((drone_id, message.boot), camera_of(message))
        return message

    def on_tracks(self, sample: Sample) -> Sight | None:
        received = self.receive(TracksMessage, Kind.TRACKS, sample)
        if received is None:
            return None
        drone_id, message, marks = received
        sight = sight_of(drone_id, message, self.camera(drone_id), sample.arrived, self._axes)
        return replace(sight, marks=marks) if marks else sight

    def on_strangers(self, sample: Sample) -> tuple[Stranger, ...]:
        received = self.receive(StrangersMessage, Kind.STRANGER, sample)
        return () if received is None else strangers_of(*received, self._axes)

    def on_health(self, sample: Sample) -> DroneHealth | None:
        received = self.receive(HealthMessage, Kind.HEALTH, sample)
        return None if received is None else DroneHealth(*received)

    def receive(
        self, message: type[Timed], kind: Kind, sample: Sample
    ) -> tuple[int, Timed, frozenset[Mark]] | None:
        """Drone, message, and why it is no news, counted; None for what does not count."""
        drone_id, received = self._read(message, kind, sample)
        if received is None:
            return None
        match received:
            case HealthMessage():
                order = received.uptime_s
            case VideoMessage():
                order = received.frame
            case _:
                order = received.sequence
        freshness = self._freshness.setdefault(sample.key, MessageOrder())
        utc = sample.arrived + utc_offset(self._clock)
        marks = freshness.marks(order, received.t_utc_s, utc)
        self._counters.update(f"{kind}_{mark.replace(' ', '_')}" for mark in marks)
        return drone_id, received, marks

    def _forget_order(self, drone_id: int) -> None:
        for text, order in self._freshness.items():
            address = keys.parse(text)
            if address is not None and address.drone_id == drone_id:
                order.restart()

    def _read(self, message: type[M], kind: Kind, sample: Sample) -> tuple[int, M | None]:
        """Whose it is, by its key; and what it says, if it counts."""
        self._membership.settle(sample.arrived)
        address = keys.parse(sample.key)
        if (
            address is None
            or address.team != self._team
            or address.kind is not kind
            or (address.rest and (kind is not Kind.VIDEO or keys.camera_of(address) is None))
        ):
            self._counters["messages_on_no_key"] += 1
            return NO_DRONE_ID, None
        if not self._membership.alive(address.drone_id):
            self._counters[f"{kind}_before_token"] += 1
            return NO_DRONE_ID, None
        try:
            return address.drone_id, codec.decode(message, sample.payload)
        except DecodeError:
            self._counters[f"{kind}_malformed"] += 1
            return NO_DRONE_ID, None
