"""A MAVLink link that tells where a drone truly is: kept open, asked for truth, and judged in words.

The link is none of the agent's: a second port of the same SITL. What is wrong with it is a sentence, `trouble`, that
names the drone, the address and what to check; while there is none, truth flows.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.autopilot.contact import heartbeat
from swarmtrack.autopilot.datagrams import Address
from swarmtrack.autopilot.framer import Framer, MavlinkFrame
from swarmtrack.autopilot.links import LinkDown, open_link
from swarmtrack.autopilot.signing import Codec
from swarmtrack.clock import Clock
from swarmtrack.geometry.geodesy import Geodetic
from swarmtrack.lab.swarm.truth_messages import TRUTH_MESSAGES, TrueSample, TruthReader
from swarmtrack.lab.world.followed import LONGEST_GAP

ASKED_TRUTH_HZ = 50.0
SLOWEST_TRUTH_HZ = 1.0 / LONGEST_GAP
OUR_SYSTEM, OUR_COMPONENT = 254, 190  # a ground station's, but not 255, whose silence is a failsafe
ASK_EVERY = 1.0  # s
TRUTH_LINK_RETRY_S = 0.5
COUNTED_S = 1.0  # over which the rate is counted
TRUTH_STALE_S = 0.5  # without truth: the simulator stands still, or is gone
FARTHEST_TRUTH_M = 1000.0  # from the origin: farther away a drone is in another town, or the origin is
SILENT_TCP_S = 5.0  # a connection this silent is dead: try another
TRUTH_AUTOPILOT_COMPONENT = common.MAV_COMP_ID_AUTOPILOT1
NO_AUTOPILOT = (common.MAV_TYPE_GCS, common.MAV_TYPE_GIMBAL, common.MAV_TYPE_ONBOARD_CONTROLLER)


class TruthFault(Enum):
    """What can be wrong with a truth link. Those that no patience heals are `FATAL`."""

    SILENT = "silent"
    MIXED = "mixed"
    STRANGER = "stranger"
    FAR = "far"


FATAL = frozenset({TruthFault.MIXED, TruthFault.STRANGER, TruthFault.FAR})


@dataclass(frozen=True, slots=True)
class TruthAddress:
    """Where one drone's truth is. system_id: its autopilot's, None for whichever is heard."""

    drone_id: int
    address: str
    system_id: int | None = None


class TruthLink:
    """on_truth: told of every sample, in the order of their times."""

    def __init__(
        self, where: TruthAddress, origin: Geodetic, clock: Clock, on_truth: Callable[[TrueSample], None]
    ) -> None:
        self.where = where
        self._link = open_link(where.address, clock)
        self._origin = origin
        self._clock = clock
        self._on_truth = on_truth
        self._codec = Codec(clock, OUR_SYSTEM, OUR_COMPONENT)
        self._framer = Framer()
        self._reader = TruthReader(origin)
        self._systems: dict[int, int] = {}
        """Heard autopilots: of which kind (MAV_AUTOPILOT) each is."""
        self._down: str | None = "opening"
        self._bytes = 0
        self._heard_at = -math.inf
        self._opened_at = clock.now()
        self._refused = False
        self._arrivals: deque[float] = deque()
        self._newest: TrueSample | None = None

    # --- running ------------------------------------------------------------------------

    async def run(self) -> None:
        """Connect, and again; until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._ask(), name="truth requests")
            while True:
                try:
                    await self._link.run(self)
                except LinkDown as down:
                    self._down = str(down)
                await asyncio.sleep(TRUTH_LINK_RETRY_S)

    async def _ask(self) -> None:
        """Say that we are there, and ask for what does not come: a simulator may start after us, and start again."""
        while True:
            if self._down is None:
                self._send(heartbeat(common.MAV_TYPE_GCS))
                if self.rate_hz < 0.8 * ASKED_TRUTH_HZ:
                    for system, kind in self._systems.items():
                        for message_id in TRUTH_MESSAGES.get(kind, ()):
                            self._send(_request(system, message_id))
                silent = self._clock.now() - max(self._opened_at, self._heard_at)
                if self._link.address.scheme == "tcp" and silent > SILENT_TCP_S:
                    self._link.drop(f"silent for {SILENT_TCP_S:g} s")
            await asyncio.sleep(ASK_EVERY)

    def _send(self, message: object) -> None:
        self._link.send(self._codec.encode(message))

    # --- Receiver: called by the link -----------------------------------------------------

    def opened(self) -> None:
        self._down = None
        self._bytes = 0
        self._opened_at = self._clock.now()
        self._framer.reset()

    def received(self, t: float, data: bytes, sender: Address | None = None) -> bool:
        """Bytes came at t; True when an autopilot's frame was among them."""
        self._bytes += len(data)
        self._heard_at = t
        frames = self._framer.feed_from(sender, data) if self._link.datagrams else self._framer.feed(data)
        ours = False
        for frame in frames:
            ours |= self._on_frame(t, frame)
        return ours

    def overheard(self, t: float, data: bytes) -> None:
        """Other senders are of no interest."""

    def _on_frame(self, t: float, frame: MavlinkFrame) -> bool:
        if frame.component != TRUTH_AUTOPILOT_COMPONENT:
            return False
        message = self._codec.decode(frame)
        if message is None:
            return False
        if frame.id == common.MAVLINK_MSG_ID_HEARTBEAT:
            if message.autopilot == common.MAV_AUTOPILOT_INVALID or message.type in NO_AUTOPILOT:
                return False
            self._systems[frame.system] = message.autopilot
        elif frame.id == common.MAVLINK_MSG_ID_COMMAND_ACK:
            asked = message.command == common.MAV_CMD_SET_MESSAGE_INTERVAL
            self._refused |= asked and message.result not in (
                common.MAV_RESULT_ACCEPTED,
                common.MAV_RESULT_IN_PROGRESS,
            )
        elif frame.system in self._systems and self._is_followed(frame.system):
            for truth in self._reader.read(message, t):
                self._take(truth, t)
        return frame.system in self._systems

    def _is_ours(self, system: int) -> bool:
        return self.where.system_id in (None, system)

    def _is_followed(self, system: int) -> bool:
        """Of two autopilots on one link, only one that was asked for by its ID: the truths of both are no flight."""
        return self._is_ours(system) and (self.where.system_id is not None or len(self._systems) == 1)

    def _take(self, truth: TrueSample, arrival: float) -> None:
        self._newest = truth
        self._arrivals.append(arrival)
        while arrival - self._arrivals[0] > COUNTED_S:
            self._arrivals.popleft()
        self._on_truth(truth)

    # --- judgement ------------------------------------------------------------------------

    @property
    def rate_hz(self) -> float:
        """Of truth, over the last second."""
        now = self._clock.now()
        return sum(now - arrival <= COUNTED_S for arrival in self._arrivals) / COUNTED_S

    @property
    def age_s(self) -> float:
        """Since truth came last; inf before the first."""
        return self._clock.now() - self._arrivals[-1] if self._arrivals else math.inf

    def trouble(self) -> tuple[TruthFault, str] | None:
        """Why its truth cannot be used; None where it can."""
        if len(self._systems) > 1:
            return TruthFault.MIXED, self._mixed()
        strangers = [system for system in self._systems if not self._is_ours(system)]
        if strangers:
            return TruthFault.STRANGER, self._sentence(
                f"is of system {strangers[0]}, expected system_id {self.where.system_id}"
            )
        if self.age_s > TRUTH_STALE_S:
            return TruthFault.SILENT, self._sentence(self._silence())
        if self.rate_hz < SLOWEST_TRUTH_HZ:
            return TruthFault.SILENT, self._sentence(
                f"sends {self.rate_hz:.0f} times a second, expected {ASKED_TRUTH_HZ:.0f}, "
                f"{SLOWEST_TRUTH_HZ:.0f} at least: is the simulator too slow, or another program asking for less?"
            )
        assert self._newest is not None
        away = float(np.linalg.norm(self._newest.pose.position))
        if away > FARTHEST_TRUTH_M:
            return TruthFault.FAR, self._sentence(self._far(away))
        return None

    def _sentence(self, text: str) -> str:
        return f"drone {self.where.drone_id}: truth link {self._link.address} {text}"

    def _mixed(self) -> str:
        systems = ", ".join(map(str, sorted(self._systems)))
        return self._sentence(
            f"carries the autopilots {systems}, expected one: give each drone a link of its own, not one that "
            "forwards them all"
        )

    def _silence(self) -> str:
        """In words, from the connection up."""
        if self._reader.refused is not None:
            refused_at, why = self._reader.refused
            if self._clock.now() - refused_at < TRUTH_STALE_S:
                since = f" for {self.age_s:.1f} s" if self._arrivals else ""
                return f"brings nothing of use{since}: {why}. No frame is exposed meanwhile"
        if self._arrivals:
            return (
                f"sent nothing for {self.age_s:.1f} s: is its simulator paused, slow or gone? No frame is exposed "
                "meanwhile"
            )
        remark = self._down or self._link.remark
        if remark:
            return f"is silent: {remark}; is SITL running, with this port?"
        if self._bytes == 0:
            return "is silent: open, 0 bytes; is it a port of SITL, and does no other program use it?"
        if self._framer.good == 0:
            return f"brought {self._bytes} bytes and no MAVLink frame, expected a MAVLink port of SITL"
        if not self._systems:
            return "brought MAVLink and no autopilot's heartbeat, expected a port of SITL"
        kind = next(iter(self._systems.values()))
        asked = TRUTH_MESSAGES.get(kind)
        if asked is None:
            return f"is of an autopilot of kind {kind} (MAV_AUTOPILOT), expected ArduPilot or PX4"
        name = common.mavlink_map[asked[0]].msgname
        end = "and refuses it" if self._refused else "and no answer"
        return f"brought heartbeats, {end}: {name} was asked for, which simulators send and real autopilots do not"

    def _far(self, away: float) -> str:
        assert self._newest is not None
        north, east, down = self._newest.pose.position.tolist()
        place = self._newest.place
        latitude, longitude = math.degrees(place.latitude), math.degrees(place.longitude)
        return (
            f"puts it {away / 1e3:.1f} km from world.origin ({north:.0f} m north, {east:.0f} m east, {-down:.0f} m "
            f"up), expected less than {FARTHEST_TRUTH_M / 1e3:g} km. It is at lat_deg = {latitude:.6f}, lon_deg = "
            f"{longitude:.6f}, alt_m = {place.height:.1f}"
        )


def _request(system: int, message_id: int) -> object:
    return common.MAVLink_command_long_message(
        system,
        TRUTH_AUTOPILOT_COMPONENT,
        common.MAV_CMD_SET_MESSAGE_INTERVAL,
        0,
        message_id,
        round(1e6 / ASKED_TRUTH_HZ),
        *(0.0,) * 5,
    )
