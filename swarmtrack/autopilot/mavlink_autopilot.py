"""The autopilot at the other end of a MAVLink link: found, configured to send what we need, and read.

Which of the autopilots on the link is ours, candidates.py says after a little more than a second. It stays that one: a
neighbour's autopilot on the same radio must not take its place while ours is silent.

telemetry.py turns its messages into samples and poses; streams.py decides which streams to request; link_state.py
reports the link's state and why nothing comes.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common

from swarmtrack.arguments import page
from swarmtrack.autopilot.account import Account
from swarmtrack.autopilot.candidates import AutopilotAddress, AutopilotCandidate, vehicle_name
from swarmtrack.autopilot.contact import Contact, RepeatLimiter, heartbeat
from swarmtrack.autopilot.datagrams import Address
from swarmtrack.autopilot.engagement import PilotEngagement
from swarmtrack.autopilot.fed_position import FedPosition
from swarmtrack.autopilot.flight import FlightWatch
from swarmtrack.autopilot.framer import FAST_CRC, HEARTBEAT, HEARTBEAT_HEADER, V2, Framer, MavlinkFrame
from swarmtrack.autopilot.global_position import GlobalPosition
from swarmtrack.autopilot.gyro_delay import GyroDelays
from swarmtrack.autopilot.limits import (
    AGENT_HEARTBEAT_PERIOD_S,
    AUTOPILOT_LOST_AFTER_S,
    CANDIDATE_GONE_S,
    CURRENT_MODE_HZ,
    EARLY_FRAMES_KEPT,
    FASTEST_IMU_HZ,
    FED_FIX_HZ,
    FIRST_RETRY_S,
    FRAME_FLUSH_AFTER_S,
    LINE_SHARE,
    LINK_TICK_S,
    LOCAL_ORIGIN_HZ,
    LONGEST_RETRY_S,
    MAVLINK_1_AFTER_S,
    NAMED_SOURCES,
    OVERHEARD_HZ,
    PILOT_SWITCH_HZ,
    TCP_SILENT_S,
)
from swarmtrack.autopilot.link_state import LinkState, State
from swarmtrack.autopilot.links import Link, LinkDown, TlogLink, UdpLink, Wire, open_link
from swarmtrack.autopilot.parameters import ParameterReader
from swarmtrack.autopilot.pilot_switch import RC_CHANNELS, PilotSwitch
from swarmtrack.autopilot.remote_id import RemoteIdReader
from swarmtrack.autopilot.senders import flight_states_apart
from swarmtrack.autopilot.signing import Codec, read_key
from swarmtrack.autopilot.streams import (
    GLOBAL_POSE,
    GPS_RAW_INT,
    LOCAL_POSE,
    LOCAL_POSITION_NED,
    Answer,
    StreamRequests,
)
from swarmtrack.autopilot.telemetry import Telemetry
from swarmtrack.clock import Clock
from swarmtrack.errors import SourceError
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.mavlink_dialect import CURRENT_MODE
from swarmtrack.messages import Array, LinkStatus, RemoteIdClaim
from swarmtrack.sources import AutopilotListener

log = logging.getLogger(__name__)

# When somebody was heard whose part of a log is still to be played.
NOT_YET = -math.inf


def _check(imu_rate_hz: float, system_id: int | None) -> None:
    if not 0.0 < imu_rate_hz <= FASTEST_IMU_HZ:
        raise SourceError(
            f"autopilot imu_rate_hz: found {imu_rate_hz:g}, expected more than 0, at most {FASTEST_IMU_HZ:g}"
        )
    if system_id is not None and not 1 <= system_id <= 255:
        raise SourceError(f"autopilot system_id: found {system_id}, expected 1 … 255")


def _flight_state(m: Any) -> tuple[int, ...]:
    """All that a heartbeat says."""
    return m.type, m.autopilot, m.base_mode, m.custom_mode, m.system_status


class WayToAutopilot(NamedTuple):
    """wire: an open link; opened_at [s]: since when, so that another connection is another one; system: the
    vehicle's; component: ours; target: the autopilot's component; version_1: it hears MAVLink 1 only.
    """

    wire: Wire
    opened_at: float
    system: int
    component: int
    target: int
    version_1: bool


class _EarlyFrame(NamedTuple):
    """A frame that came at t [s], before our autopilot was known; message: decoded, None if refused; sender: of its
    datagram."""

    t: float
    frame: MavlinkFrame
    message: Any | None
    sender: Address | None

    @property
    def address(self) -> AutopilotAddress:
        return AutopilotAddress(self.frame.system, self.frame.component)


class MavlinkAutopilot:
    """An `Autopilot` (sources.py) at a MAVLink address.

    link: an address such as `udpin:127.0.0.1:14540`, or a link already made; system_id: the vehicle to listen to,
    None for the only one on the link; component_id: ours (191 … 194 are onboard computers); signing_key: a file of mode
    0600, see signing.py; gps: makes positions of the team frame by GPS, None: they are of the autopilot's local frame;
    gyro_delay_s: how late its gyro is, None: as it says itself; switch: the pilot's that is watched; engagement:
    is told of the flight mode; origin: of the team frame, by which Remote ID of others is read, None: it is not; fed:
    it is fed our place, and what it makes of that is none of its own. Raises `SourceError` for what can never work.

    Apart from `run`, its interface is `opened`, `received` and `tick`, which take the time and need no event loop.
    """

    def __init__(
        self,
        link: str | Link,
        *,
        clock: Clock,
        imu_rate_hz: float = 200.0,
        system_id: int | None = None,
        component_id: int = 191,
        signing_key: Path | None = None,
        gps: GlobalPosition | None = None,
        gyro_delay_s: float | None = None,
        switch: PilotSwitch | None = None,
        engagement: PilotEngagement | None = None,
        origin: Geodetic | None = None,
        fed: FedPosition | None = None,
    ) -> None:
        _check(imu_rate_hz, system_id)
        self._clock = clock
        self._link = open_link(link, clock) if isinstance(link, str) else link
        key = None if signing_key is None else read_key(signing_key)
        # Until the vehicle's own system is known we speak as its most likely one.
        self._codec = Codec(clock, system=system_id or 1, component=component_id, key=key)
        self._framer, self._contact, self._flight = Framer(), Contact(system_id), FlightWatch()
        self._news = RepeatLimiter(self._now)
        self._switch, self._engagement, self._fed = switch, engagement, fed
        name, recording, line = str(self._link.address), self._link.recording, self._link.bytes_per_second
        rates = self._rates(by_gps=gps is not None)
        self._requests = StreamRequests(imu_rate_hz, rates, line=line, signed=key is not None)
        self._gyro_delays = GyroDelays(gyro_delay_s, asks=not recording, name=name)
        self._telemetry = Telemetry(
            self._link,
            self._requests,
            self._contact,
            self._news,
            framer=self._framer,
            gps=gps,
            send=self._send,
            gyro_delays=self._gyro_delays,
            fed=fed,
        )
        self._link_state = LinkState(
            link=self._link,
            contact=self._contact,
            framer=self._framer,
            codec=self._codec,
            requests=self._requests,
            telemetry=self._telemetry,
            news=self._news,
            switch=switch,
        )
        self._remote_ids = None if origin is None else RemoteIdReader(origin, self._on_remote_id)
        self._readers = self._make_readers()
        self._parameters: ParameterReader | None = None
        self._account = Account(self._link.address.scheme)
        self._early: deque[_EarlyFrame] = deque(maxlen=EARLY_FRAMES_KEPT)
        self._next_heartbeat = self._next_tick = self._next_choice = -math.inf
        self._met_at = math.inf  # when our autopilot was chosen
        self._greeted, self._overheard, self._overheard_since = False, 0, -math.inf

    def _rates(self, *, by_gps: bool) -> dict[int, float]:
        """Hz by message, beside gyro and attitude: of places; of the transmitter's channels and the mode, where these
        are watched; and of what else an autopilot says that is fed our place."""
        rates = dict(GLOBAL_POSE if by_gps else LOCAL_POSE)
        if self._fed is not None:
            rates = {GPS_RAW_INT: FED_FIX_HZ, LOCAL_POSITION_NED: LOCAL_ORIGIN_HZ} | rates
        if self._reads_channels:
            rates[RC_CHANNELS] = PILOT_SWITCH_HZ
        if self._engagement is not None:
            rates[CURRENT_MODE] = CURRENT_MODE_HZ
        return rates

    @property
    def _reads_channels(self) -> bool:
        """Whether the transmitter's channels are asked for."""
        return self._switch is not None or (self._engagement is not None and self._engagement.asks_for_switch)

    def _make_readers(self) -> dict[int, Callable[[float, Any], None]]:
        """By message."""
        readers: dict[int, Callable[[float, Any], None]] = {
            HEARTBEAT: self._on_heartbeat,
            common.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._flight.on_landed_state,
            common.MAVLINK_MSG_ID_COMMAND_ACK: self._on_ack,
            **self._telemetry.readers,
        }
        if self._remote_ids is not None:
            readers |= self._remote_ids.readers
        if self._reads_channels:
            readers[RC_CHANNELS] = self._on_channels
        if self._engagement is not None:
            readers[CURRENT_MODE] = self._engagement.on_current_mode
        if self._engagement is not None or self._fed is not None:
            readers[common.MAVLINK_MSG_ID_STATUSTEXT] = self._on_text
        return readers

    def _on_remote_id(self, claim: RemoteIdClaim) -> None:
        self._telemetry.listener.on_remote_id(claim)

    def read_parameters(self, reader: ParameterReader) -> None:
        """Request further parameters; to be called before `run`."""
        self._parameters = reader
        before = self._readers[common.MAVLINK_MSG_ID_PARAM_VALUE]

        def on_value(t: float, m: Any) -> None:
            before(t, m)
            reader.on_value(t, m)

        self._readers[common.MAVLINK_MSG_ID_PARAM_VALUE] = on_value

    def deliver_to(self, listener: AutopilotListener) -> None:
        """Set the listener; `run` does it."""
        self._telemetry.listener = listener

    # ── running ──────────────────────────────────────────────────────────────────────────────────────────────────

    async def run(self, listener: AutopilotListener) -> None:
        """Connect, reconnect and deliver until cancelled; returns only where a recording ends."""
        self.deliver_to(listener)
        if not FAST_CRC:
            log.warning("fastcrc is not installed: reading MAVLink costs three times the CPU time")
        if self._link.address.reachable_from_outside and not self._codec.has_key:
            log.warning(
                "%s: any host that reaches this address can send first and be taken for the autopilot: listen on "
                "127.0.0.1, or set autopilot.signing_key (%s)",
                self._link.address,
                page("security.md"),
            )
        if self._link.recording:
            if isinstance(self._link, TlogLink):
                await self._survey(self._link)
            await self._link.run(self)
            now = self._now()
            self._look_for_autopilot(now, final=True)
            self._telemetry.end(now)
            self._link_state.state = State.ENDED
            return
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._keep_connected(), name="mavlink link")
            tasks.create_task(self._keep_ticking(), name="mavlink tick")

    async def _keep_connected(self) -> None:
        delay = FIRST_RETRY_S
        while True:
            try:
                await self._link.run(self)
            except LinkDown as down:
                self._contact.down = str(down)
            if self._contact.bytes:
                delay = FIRST_RETRY_S
            self._contact.bytes = 0
            await asyncio.sleep(delay)
            delay = min(2 * delay, LONGEST_RETRY_S)
            self._contact.reconnects += 1

    async def _keep_ticking(self) -> None:
        while True:
            self.tick(self._clock.now())
            await asyncio.sleep(LINK_TICK_S)

    def tick(self, now: float) -> None:
        """Handle the passage of time: silence, heartbeats, unanswered requests."""
        contact = self._contact
        self._look_for_autopilot(now)
        if self._framer.pending and now - contact.received_at > FRAME_FLUSH_AFTER_S:
            self._take(now, self._framer.flush())
        if contact.down is None and not self._link.recording:
            self._speak(now)
            silent = now - max(contact.opened_at, contact.received_at)
            if self._link.address.scheme == "tcp" and silent > TCP_SILENT_S:
                self._link.drop(f"silent for {TCP_SILENT_S:g} s")
        self._telemetry.measure(now)
        self._link_state.update(now)
        if self._engagement is not None and (contest := self._link_state.contest(now)):
            self._engagement.fail(contest)

    def _speak(self, now: float) -> None:
        if now >= self._next_heartbeat:
            self._next_heartbeat = now + AGENT_HEARTBEAT_PERIOD_S
            beat = heartbeat(common.MAV_TYPE_ONBOARD_CONTROLLER)
            self._send(beat)
            if self._codec.speaks_version_1:
                # Who understands it speaks it from then on.
                self._link.send(self._codec.encode(beat, version_2=True))
        contact = self._contact
        if contact.system is None or now - contact.heard_at > AUTOPILOT_LOST_AFTER_S:
            return
        self._choose_version(now)
        target = contact.address
        asked = self._requests.tick(now, target) + self._gyro_delays.tick(now, target)
        if self._parameters is not None:
            asked += self._parameters.tick(now, target)
        for message in asked:
            self._send(message)
        self._telemetry.ask_time(now)

    def _choose_version(self, now: float) -> None:
        """MAVLink 2, which most autopilots send once they hear it; else what this one speaks."""
        contact, codec = self._contact, self._codec
        waited = now - max(self._met_at, contact.opened_at) > MAVLINK_1_AFTER_S
        version_1 = waited and not codec.has_key and contact.version_2_at < contact.opened_at
        if version_1 and not codec.speaks_version_1:
            log.info(
                "%s: autopilot %s speaks MAVLink 1 only, and so do we", self._link.address, contact.system
            )
            self._requests.reset()
        codec.speaks_version_1 = version_1

    def _send(self, message: Any) -> None:
        self._link.send(self._codec.encode(message))

    def _now(self) -> float:
        """A recording's time is that of its bytes."""
        contact = self._contact
        return contact.received_at if self._link.recording and contact.bytes else self._clock.now()

    def status(self) -> LinkStatus:
        """One line for people, and the counters, all since the start."""
        return self._link_state.status(self._now())

    def account(self) -> list[str]:
        """What came of our autopilot, what was used, and why not the rest, one sentence each. Raises SourceError where
        several may be ours.
        """
        contact = self._contact
        if contact.system is None:
            raise SourceError(self.status().text)
        unread = frozenset(common.mavlink_map) - self._readers.keys()
        sentences = self._account.lines(
            contact, self._framer, self._telemetry, unread, left_out=self._link.left_out
        )
        return list(sentences)

    @property
    def trouble(self) -> str:
        """What the autopilot does not deliver, in a few words for a pilot; empty while gyro and position come."""
        return self._link_state.trouble(self._now())

    @property
    def system(self) -> int:
        """System ID of the autopilot's vehicle; 0 before its first heartbeat."""
        return self._contact.system or 0

    @property
    def clock_known(self) -> bool:
        """Whether its times can be mapped to our clock."""
        return self._telemetry.clock_map.offset is not None

    @property
    def place(self) -> tuple[float, tuple[float, float, float]] | None:
        """Arrival of its newest position, and the position itself: NED [m] in the axes of its local frame."""
        return self._telemetry.place

    @property
    def local_origin(self) -> Array | None:
        """(3,) m: positions in its local frame less those that it is read by; None: not known."""
        return self._telemetry.local_origin

    @property
    def kind(self) -> int | None:
        """MAV_AUTOPILOT; None before its first heartbeat."""
        return self._contact.kind

    @property
    def signing_key(self) -> bytes | None:
        """32 bytes; None where nothing is signed."""
        return self._codec.key

    def way(self) -> WayToAutopilot | None:
        """The path by which another process can send to it; None where `send_message` cannot."""
        wire = None if self._is_deaf() else self._link.wire()
        if wire is None:
            return None
        contact, codec = self._contact, self._codec
        return WayToAutopilot(
            wire,
            contact.opened_at,
            codec.system,
            codec.component,
            target=contact.component,
            version_1=codec.speaks_version_1,
        )

    def send_message(self, message: Any) -> bool:
        """Send a message of the dialect to the autopilot, and through it to ground stations. Never blocks.

        Returns False, and sends nothing, into a recording or while the autopilot is silent.
        """
        if self._is_deaf():
            return False
        self._send(message)
        return True

    def _is_deaf(self) -> bool:
        contact = self._contact
        deaf = contact.system is None or contact.down is not None or self._link.recording
        return deaf or self._now() - contact.heard_at > AUTOPILOT_LOST_AFTER_S

    # ── Receiver: called by the link ─────────────────────────────────────────────────────────────────────────────

    def opened(self) -> None:
        """The link is up: everything is requested again, and pending bytes of the last connection are dropped."""
        contact = self._contact
        contact.down = None
        contact.opened_at = self._now()
        contact.bytes = 0
        contact.frames_before = self._framer.good
        self._framer.reset()
        self._early.clear()
        self._requests.reset()
        self._telemetry.opened()
        self._next_heartbeat = -math.inf

    def received(self, t: float, data: bytes, sender: Address | None = None) -> bool:
        """Bytes came at t; True when a valid frame of our autopilot was among them."""
        self._contact.received_at = t
        self._contact.bytes += len(data)
        if not self._link.datagrams:
            frames = self._framer.feed(data)
        elif self._link.recording:
            frames = self._framer.datagram(data)
        else:
            frames = self._framer.feed_from(sender, data)
        ours = self._take(t, frames, sender)
        if self._link.recording and t >= self._next_tick:
            self._next_tick = t + LINK_TICK_S
            self.tick(t)
        return ours

    def overheard(self, t: float, data: bytes) -> None:
        """Read the heartbeats of another sender's datagram, and nothing else: it may be an autopilot. With a key no
        other sender is verified, so none counts.
        """
        if self._codec.has_key or HEARTBEAT_HEADER.search(data) is None:
            return
        if t - self._overheard_since >= 1.0:
            self._overheard_since, self._overheard = t, 0
        self._overheard += 1
        if self._overheard > OVERHEARD_HZ:
            return
        for frame in Framer().datagram(data):
            if frame.id == HEARTBEAT and (message := self._codec.decode(frame)) is not None:
                self._on_other_heartbeat(t, frame, message)

    def _on_other_heartbeat(self, t: float, frame: MavlinkFrame, m: Any) -> None:
        contact, senders = self._contact, self._telemetry.senders
        address = AutopilotAddress(frame.system, frame.component)
        if address != contact.address:
            contact.candidates.on_heartbeat(t, address, m)
            return
        # A copy of ours agrees with it.
        senders.on_frame(frame.sequence)
        senders.compare(t, HEARTBEAT, _flight_state(m), flight_states_apart)

    def _take(self, t: float, frames: list[MavlinkFrame], sender: Address | None = None) -> bool:
        ours = False
        for frame in frames:
            # Decoded once, in the order of arrival: a signed frame that is decoded again counts as replayed.
            message = self._decode(frame) if self._is_read(frame) else None
            if self._contact.system is not None:
                ours |= self._on_frame(t, frame, message)
                continue
            # What came before it is known whose it was is not lost.
            self._contact.early_lost += len(self._early) == EARLY_FRAMES_KEPT
            self._early.append(_EarlyFrame(t, frame, message, sender))
            self._note_source(t, frame, message)
            ours |= self._look_for_autopilot(t)
        return ours

    def _is_read(self, frame: MavlinkFrame) -> bool:
        """Whether the frame is worth decoding: it is our autopilot's, or may turn out to be."""
        contact = self._contact
        if contact.system is None:
            return frame.id == HEARTBEAT or (
                frame.id in self._readers and contact.expected_system in (None, frame.system)
            )
        if contact.is_of_ours(frame):
            return frame.id in self._readers
        # Of others, whether they are autopilots, and what a receiver of Remote ID aboard hears; but with a key, what
        # they say is not for us to verify.
        return (frame.id == HEARTBEAT or self._is_of_receiver(frame)) and not self._codec.has_key

    def _is_of_receiver(self, frame: MavlinkFrame) -> bool:
        """Whether it is of a receiver of Remote ID aboard."""
        known = self._remote_ids is not None and frame.id in self._remote_ids.readers
        return known and frame.system == self._contact.system

    def _on_frame(self, t: float, frame: MavlinkFrame, message: Any | None) -> bool:
        """Take a frame once the autopilot is known; message: what it decodes to, None where it was refused."""
        contact = self._contact
        if not contact.is_of_ours(frame):
            contact.foreign += 1
            self._note_source(t, frame, message)
            if message is not None and self._is_of_receiver(frame):
                self._readers[frame.id](t, message)
            return False
        if frame.data[0] == V2:
            contact.version_2_at = t
        self._account.add(t, frame.id)
        if self._link.numbered:
            self._telemetry.senders.on_frame(frame.sequence)
        reader = self._readers.get(frame.id)
        if reader is None:
            # Not worth decoding; but with a key, what was not verified proves nobody's presence.
            return not self._codec.has_key
        if message is None:
            return False
        if frame.id not in self._telemetry.stamped and self._telemetry.stamps.is_late(t, message):
            return False
        contact.heard_at = t
        contact.signature_trouble = ""
        self._requests.arrived(frame.id)
        reader(t, message)
        return True

    def _decode(self, frame: MavlinkFrame) -> Any | None:
        message = self._codec.decode(frame)
        if message is None and self._codec.has_key:
            who = f"{frame.system}/{frame.component}"
            fault = "signs with another key or an old time" if frame.signed else "sends unsigned messages"
            trouble = f"{who} {fault}, and we hold a signing key"
            self._contact.signature_trouble = trouble
            self._news.warn(f"{who} {fault}", "refused: %s", trouble)
        return message

    # ── who it is ────────────────────────────────────────────────────────────────────────────────────────────────

    def _note_source(self, t: float, frame: MavlinkFrame, message: Any | None) -> None:
        """Who speaks beside our autopilot, or as long as that is not known."""
        contact = self._contact
        address = AutopilotAddress(frame.system, frame.component)
        candidate = None
        if frame.id == HEARTBEAT and message is not None:
            candidate = contact.candidates.on_heartbeat(t, address, message)
        if address in contact.others or len(contact.others) < NAMED_SOURCES:
            named = "" if candidate is None else candidate.name
            contact.others[address] = named or contact.others.get(address, "")

    async def _survey(self, log: TlogLink) -> None:
        """Note who speaks in a log before it is played: those who are late count as well."""
        # What is decoded once more with this one is no replay to the other.
        codec, candidates = self._codec.again(), self._contact.candidates
        for frames in log.heartbeats():
            await asyncio.sleep(0)
            for frame in frames:
                if (message := codec.decode(frame)) is not None:
                    candidates.on_heartbeat(NOT_YET, AutopilotAddress(frame.system, frame.component), message)
        candidates.first_at = math.inf

    def _look_for_autopilot(self, now: float, *, final: bool = False) -> bool:
        """Once it is clear which one is ours, deliver what it has said; True where a frame of it was among that. final:
        no other will be heard.
        """
        contact = self._contact
        if contact.system is not None or now < self._next_choice:
            return False
        candidate = contact.candidates.choose(now, final=final or self._link.recording)
        if candidate is None or candidate.heard_at == NOT_YET:
            return False
        contact.twins = self._twins(candidate.address, now)
        if contact.twins:
            self._next_choice = now + LINK_TICK_S
            return False
        self._meet(candidate, now)
        last = next((early for early in reversed(self._early) if early.address == contact.address), None)
        if last is not None and last.sender is not None and isinstance(self._link, UdpLink):
            self._link.meet(last.sender, last.t)
        ours = False
        while self._early:
            early = self._early.popleft()
            ours |= self._on_frame(early.t, early.frame, early.message)
        return ours

    def _twins(self, address: AutopilotAddress, now: float) -> tuple[Address, ...]:
        """Senders of datagrams with frames of that address, if two of them have less than half of their frames in
        common: what a router sends twice is one autopilot's.
        """
        frames: dict[Address, set[bytes]] = {}
        for early in self._early:
            is_recent = now - early.t < CANDIDATE_GONE_S and early.message is not None
            if early.address == address and early.sender is not None and is_recent:
                frames.setdefault(early.sender, set()).add(early.frame.data)
        pairs = itertools.combinations(frames.values(), 2)
        apart = any(2 * len(one & other) < min(len(one), len(other)) for one, other in pairs)
        return tuple(frames) if apart else ()

    def _meet(self, ours: AutopilotCandidate, now: float) -> None:
        contact = self._contact
        contact.system, contact.component = ours.address
        self._codec.system = ours.address.system
        contact.kind, contact.vehicle = ours.firmware, ours.kind
        contact.known_at, self._met_at = contact.candidates.first_at, now
        log.info("%s: found autopilot %s", self._link.address, ours)
        self._gyro_delays.meet(ours.firmware)
        if self._parameters is not None:
            self._parameters.meet(ours.firmware)
        self._check_line()

    def _check_line(self) -> None:
        share = self._requests.line_share
        if share > LINE_SHARE:
            log.warning(
                "%s: the rates asked for need %.1f kB/s, %.0f %% of what the line carries; ask for a lower IMU rate "
                "or set a faster baud rate",
                self._link.address,
                self._requests.bytes_per_second * 1e-3,
                100 * share,
            )

    def _on_heartbeat(self, t: float, m: Any) -> None:
        """Each tells that the autopilot is there, and whether the drone flies."""
        self._look_for_changeling(t, m)
        self._telemetry.senders.compare(t, HEARTBEAT, _flight_state(m), flight_states_apart)
        state = self._flight.on_heartbeat(t, m)
        self._telemetry.listener.on_flight_state(state)
        if self._engagement is not None:
            airborne = state.airborne_since is not None
            self._engagement.on_heartbeat(t, m, self._contact.kind, airborne=airborne)
        if not self._greeted and state.airborne_since is not None:
            self._telemetry.listener.on_found_flying()
        self._greeted = True

    def _look_for_changeling(self, t: float, m: Any) -> None:
        """Whether another kind of vehicle or firmware speaks under our autopilot's ID, by turns with ours."""
        contact = self._contact
        if (m.type, m.autopilot) != (contact.vehicle, contact.kind):
            contact.changeling = vehicle_name(m.type)
            contact.changeling_at = t
        elif t - contact.changeling_at < CANDIDATE_GONE_S:
            contact.shared_at = t

    def _on_text(self, t: float, m: Any) -> None:
        if self._engagement is not None:
            self._engagement.on_text(t, m.text)
        if self._fed is not None:
            self._fed.on_text(t, m)

    def _on_channels(self, t: float, m: Any) -> None:
        if self._engagement is not None:
            self._engagement.on_channels(t, m)
        if self._switch is not None and self._switch.on_channels(t, m):
            self._telemetry.listener.on_switch(t)

    def _on_ack(self, t: float, m: Any) -> None:
        codec, contact = self._codec, self._contact
        for_us = m.target_system in (0, codec.system) and m.target_component in (0, codec.component)
        if m.command == common.MAV_CMD_SET_MESSAGE_INTERVAL and for_us:
            for message in self._requests.acknowledged(m.result, t, contact.address):
                self._send(message)
            imu = self._requests.imu_stream
            if imu.answered_at == t and imu.answer is Answer.ACCEPTED:
                self._telemetry.cadence.learn_again()
