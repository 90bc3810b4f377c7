"""The autopilot at the other end of a MAVLink link: found, asked for what we need, watched, and mapped to our clock.

    searching ── heartbeat of an autopilot ──▶ requesting ── first IMU sample ──▶ streaming ◀──▶ stale (0.5 s)
        ▲                                          ▲                                   │
        └──── connection gone, tried again ────────┴──────────── lost (3 s) ◀──────────┘

Every state but streaming names its reason within 3 s: in `status()`, and as one line in the log when it changes.
The autopilot is component 1 of the first system whose HEARTBEAT names an autopilot, or of the system that the user
named. It stays that one: a neighbour's autopilot on the same radio must not take its place while ours is silent.
"""

from __future__ import annotations

import asyncio
import enum
import logging
import math
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common

from swarmtrack.errors import SourceError
from swarmtrack.geometry.rotation import from_quaternion
from swarmtrack.messages import Array, EgoPose, ImuSample, LinkStatus
from swarmtrack.runtime.clock import Clock
from swarmtrack.sensors.base import AutopilotListener
from swarmtrack.sensors.mavlink.clock_map import ClockMap
from swarmtrack.sensors.mavlink.framer import FAST_CRC, FLUSH_AFTER, Frame, Framer
from swarmtrack.sensors.mavlink.links import Link, LinkDown, open_link
from swarmtrack.sensors.mavlink.signing import Codec, read_key
from swarmtrack.sensors.mavlink.streams import (
    ATTITUDE_QUATERNION,
    HIGHRES_IMU,
    IMU_MESSAGES,
    LINE_SHARE,
    LOCAL_POSITION_NED,
    NOT_MEASURED,
    RAW_IMU,
    SCALED_IMU,
    Cadence,
    Step,
    StreamRequests,
)

log = logging.getLogger(__name__)

AUTOPILOT: int = common.MAV_COMP_ID_AUTOPILOT1
HEARTBEAT_EVERY = 1.0  # s: also what makes routers learn us
TICK = 0.05  # s
STALE_AFTER = 0.5  # s without an IMU sample, or three of its periods where it comes slower
LOST_AFTER = 3.0  # s without any message of the autopilot
DIAGNOSE_AFTER = 2.5  # s to wait before a silence is given a name
SILENT_TCP = 5.0  # s without a byte: the other end went without saying so
RETRY_FIRST, RETRY_LAST = 0.5, 5.0  # s between attempts to connect, doubling
PREFER = 2.0  # s a better source of angular velocity must be silent before a lesser one is used
SAY_AGAIN = 10.0  # s before the same trouble is logged again
FASTEST_IMU = 8000.0  # Hz: what the sensors themselves reach
FASTEST_GYRO = 100.0  # rad/s: no sensor measures more; what claims it is corrupt
POSITION_AGE = 0.5  # s that a position is carried on by its velocity
POSE_MISMATCH = 5.0  # s between a pose's mapped time and its arrival: it is stamped by another clock
TIMESYNC_EVERY = 1.0  # s
TIMESYNC_FIRST, TIMESYNC_FIRST_EVERY = 10, 0.2  # the first exchanges come faster, so that sigma is soon known
RANKS = {message.id: rank for rank, message in enumerate(IMU_MESSAGES)}
RATE_WINDOW = 2.0  # s over which the IMU's rate is counted
EARLY_FRAMES = 1000  # kept until a heartbeat tells whose they are: more than a second of a fast link
OPENING = "opening"
NAMED_SOURCES = 8  # other systems remembered by name


class State(enum.StrEnum):
    """Where the link to the autopilot stands."""

    SEARCHING = "searching"
    REQUESTING = "requesting"
    STREAMING = "streaming"
    STALE = "stale"
    LOST = "lost"
    ENDED = "ended"  # a recording has been played to its end


class MavlinkAutopilot:
    """An `Autopilot` (sensors/base.py) at a MAVLink address.

    link: an address such as `udpin:0.0.0.0:14540`, or a link already made; system_id: the vehicle to listen to, None
    for the first one heard; component_id: ours (191 … 194 are onboard computers); signing_key: a file of mode 0600,
    see signing.py. Raises `SourceError` for what can never work.

    Beside `run`, `opened`, `received` and `tick` are all there is to it: told the time, it needs no event loop.
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
    ) -> None:
        if not 0.0 < imu_rate_hz <= FASTEST_IMU:
            raise SourceError(
                f"autopilot imu_rate_hz: found {imu_rate_hz:g}, expected more than 0, at most 8000"
            )
        if system_id is not None and not 1 <= system_id <= 255:
            raise SourceError(f"autopilot system_id: found {system_id}, expected 1 … 255")
        self._clock = clock
        self._link = open_link(link, clock) if isinstance(link, str) else link
        self._expected_system = system_id
        key = None if signing_key is None else read_key(signing_key)
        # Until the vehicle's own system is known we speak as its most likely one.
        self._codec = Codec(clock, system=system_id or 1, component=component_id, key=key)
        self._framer = Framer()
        self._requests = StreamRequests(imu_rate_hz)
        self._cadence = Cadence()
        self._clock_map = ClockMap()
        self._listener: AutopilotListener
        self._readers: dict[int, Callable[[float, Any], None]] = {
            common.MAVLINK_MSG_ID_HEARTBEAT: self._on_heartbeat,
            common.MAVLINK_MSG_ID_COMMAND_ACK: self._on_ack,
            common.MAVLINK_MSG_ID_TIMESYNC: self._on_timesync,
            HIGHRES_IMU: self._on_imu,
            RAW_IMU: self._on_imu,
            SCALED_IMU: self._on_imu,
            ATTITUDE_QUATERNION: self._on_attitude,
            LOCAL_POSITION_NED: self._on_position,
        }

        self._state = State.SEARCHING
        self._down: str | None = OPENING  # why there is no connection; None: there is one
        self._opened_at = 0.0
        self._bytes = 0  # of this connection
        self._frames_before = 0  # good frames of earlier connections
        self._said: dict[str, float] = {}  # trouble by name, and when it was logged last
        self._trouble = "just started"  # the name of the present one, empty while streaming

        self._system: int | None = None
        self._known_at = 0.0
        self._received_at = -math.inf
        self._heard_at = -math.inf
        self._early: deque[tuple[float, Frame]] = deque(maxlen=EARLY_FRAMES)
        self._others: dict[tuple[int, int], str] = {}
        self._signature_trouble = ""

        self._imu_seen = [-math.inf] * len(IMU_MESSAGES)
        self._imu_rank: int | None = None
        self._imu_at = -math.inf
        self._imu_t = -math.inf
        self._imu_rate_hz = 0.0
        self._window_start = -math.inf
        self._window_count = 0
        self._pose_stamp: float | None = None
        self._position: tuple[float, Array, Array] | None = None
        self._asked_time: dict[int, float] = {}
        self._exchanges = 0
        self._next_heartbeat = self._next_timesync = self._next_tick = -math.inf

        self._imu_samples = self._poses = self._foreign = self._invalid = 0
        self._after_resync = self._poses_without_position = self._reboots = self._reconnects = 0

    # ── running ──────────────────────────────────────────────────────────────────────────────────────────────────

    async def run(self, listener: AutopilotListener) -> None:
        """Connect, reconnect and deliver until cancelled; returns only where a recording ends."""
        self._listener = listener
        if not FAST_CRC:
            log.warning("fastcrc is not installed: reading MAVLink costs three times the CPU time")
        if self._link.recording:
            await self._link.run(self)
            self._state = State.ENDED
            return
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._keep_connected(), name="mavlink link")
            tasks.create_task(self._keep_ticking(), name="mavlink tick")

    async def _keep_connected(self) -> None:
        delay = RETRY_FIRST
        while True:
            try:
                await self._link.run(self)
            except LinkDown as down:
                self._down = str(down)
            if self._bytes:
                delay = RETRY_FIRST
            self._bytes = 0
            await asyncio.sleep(delay)
            delay = min(2 * delay, RETRY_LAST)
            self._reconnects += 1

    async def _keep_ticking(self) -> None:
        while True:
            self.tick(self._clock.now())
            await asyncio.sleep(TICK)

    def tick(self, now: float) -> None:
        """What time alone brings about: silence, heartbeats, requests that were not answered."""
        if self._framer.pending and now - self._received_at > FLUSH_AFTER:
            self._take(now, self._framer.flush())
        if self._down is None and not self._link.recording:
            self._speak(now)
            if (
                self._link.address.scheme == "tcp"
                and now - max(self._opened_at, self._received_at) > SILENT_TCP
            ):
                self._link.drop(f"silent for {SILENT_TCP:g} s")
        if now - self._window_start >= RATE_WINDOW:
            self._imu_rate_hz = self._window_count / (now - self._window_start)
            self._window_start, self._window_count = now, 0
        self._judge(now)

    def _speak(self, now: float) -> None:
        if now >= self._next_heartbeat:
            self._next_heartbeat = now + HEARTBEAT_EVERY
            self._send(
                common.MAVLink_heartbeat_message(
                    type=common.MAV_TYPE_ONBOARD_CONTROLLER,
                    autopilot=common.MAV_AUTOPILOT_INVALID,
                    base_mode=0,
                    custom_mode=0,
                    system_status=common.MAV_STATE_ACTIVE,
                    mavlink_version=3,
                )
            )
        if self._system is None or now - self._heard_at > LOST_AFTER:
            return
        for message in self._requests.tick(now, self._system):
            self._send(message)
        if now >= self._next_timesync:
            first = self._exchanges < TIMESYNC_FIRST
            self._next_timesync = now + (TIMESYNC_FIRST_EVERY if first else TIMESYNC_EVERY)
            self._ask_time()

    def _send(self, message: Any) -> None:
        self._link.send(self._codec.encode(message))

    # ── Receiver: called by the link ─────────────────────────────────────────────────────────────────────────────

    def opened(self) -> None:
        """The link stands: everything is asked for anew, and bytes of the last connection mean nothing any more."""
        self._down = None
        self._opened_at = self._now()
        self._bytes = 0
        self._frames_before = self._framer.good
        self._framer.reset()
        self._early.clear()
        self._requests.reset()
        self._next_heartbeat = self._next_timesync = -math.inf

    def received(self, t: float, data: bytes) -> bool:
        """Bytes came at t; True when a valid frame of our autopilot was among them."""
        self._received_at = t
        self._bytes += len(data)
        frames = self._framer.datagram(data) if self._link.datagrams else self._framer.feed(data)
        ours = self._take(t, frames)
        if self._link.recording and t >= self._next_tick:
            self._next_tick = t + TICK
            self.tick(t)
        return ours

    def _take(self, t: float, frames: list[Frame]) -> bool:
        ours = False
        for frame in frames:
            if self._system is None:
                # What came before the first heartbeat is not lost, once it is known whose it was.
                self._early.append((t, frame))
                if self._is_autopilot(t, frame):
                    while self._early:
                        ours |= self._on_frame(*self._early.popleft())
            else:
                ours |= self._on_frame(t, frame)
        return ours

    def _on_frame(self, t: float, frame: Frame) -> bool:
        if frame.component != AUTOPILOT or frame.system != self._system:
            self._foreign += 1
            return False
        reader = self._readers.get(frame.id)
        if reader is None:
            # Not worth decoding; but with a key, what was not verified proves nobody's presence.
            return not self._codec.has_key
        message = self._decode(frame)
        if message is None:
            return False
        self._heard_at = t
        self._requests.arrived(frame.id)
        reader(t, message)
        return True

    def _decode(self, frame: Frame) -> Any | None:
        message = self._codec.decode(frame)
        if message is None and self._codec.has_key:
            fault = "signs with another key or an old time" if frame.signed else "speaks unsigned"
            self._signature_trouble = f"{frame.system}/{frame.component} {fault}, and we hold a signing key"
            self._warn(f"{frame.system}/{frame.component} {fault}", "refused: %s", self._signature_trouble)
        return message

    def _is_autopilot(self, t: float, frame: Frame) -> bool:
        """Whether this frame is the heartbeat of the autopilot we look for; then it is ours from now on."""
        source = (frame.system, frame.component)
        if frame.id != common.MAVLINK_MSG_ID_HEARTBEAT:
            if len(self._others) < NAMED_SOURCES:
                self._others.setdefault(source, "")
            return False
        message = self._decode(frame)
        if message is None:
            return False
        is_autopilot = (
            frame.component == AUTOPILOT
            and message.autopilot != common.MAV_AUTOPILOT_INVALID
            and message.type != common.MAV_TYPE_GCS
        )
        if is_autopilot and self._expected_system in (None, frame.system):
            self._system = self._codec.system = frame.system
            self._known_at = t
            self._signature_trouble = ""
            log.info("%s: found autopilot %d", self._link.address, frame.system)
            self._check_line()
            return True
        if len(self._others) < NAMED_SOURCES:
            self._others[source] = "an autopilot" if is_autopilot else ""
        return False

    def _check_line(self) -> None:
        line = self._link.bytes_per_second
        wanted = self._requests.bytes_per_second(self._codec.has_key)
        if line is not None and wanted > LINE_SHARE * line:
            log.warning(
                "%s: the rates asked for need %.1f kB/s, %.0f %% of what the line carries; ask for a lower IMU rate "
                "or set a faster baud rate",
                self._link.address,
                wanted * 1e-3,
                100 * wanted / line,
            )

    # ── messages of our autopilot ────────────────────────────────────────────────────────────────────────────────

    def _on_heartbeat(self, t: float, m: Any) -> None:
        """Being heard is all that a heartbeat of a known autopilot tells us."""

    def _on_ack(self, t: float, m: Any) -> None:
        for_us = m.target_system in (0, self._codec.system) and m.target_component in (
            0,
            self._codec.component,
        )
        if m.command == common.MAV_CMD_SET_MESSAGE_INTERVAL and for_us and self._system is not None:
            for message in self._requests.acknowledged(m.result, t, self._system):
                self._send(message)

    def _on_imu(self, t: float, m: Any) -> None:
        rank = RANKS[m.get_msgId()]
        source = IMU_MESSAGES[rank]
        # HIGHRES_IMU and RAW_IMU may come from several sensors by turns: the first is the one in use.
        if (source.numbered and m.id) or not self._is_source(t, rank):
            return
        stamp = source.stamp(m)
        gyro, accel = source.read(m)
        if not (np.abs(gyro) < FASTEST_GYRO).all():  # NaN fails this too
            self._invalid += 1
            return
        step = self._cadence.observe(stamp)
        if step is Step.REPEATED:
            return
        if step is Step.REBOOT:
            self._rebooted(stamp)
            self._cadence.observe(stamp)
        self._observe_clock(stamp, t)
        if t - self._imu_at > LOST_AFTER:
            self._imu_rate_hz, self._window_start, self._window_count = 0.0, t, 0
        self._imu_at = t
        self._window_count += 1
        ours = self._clock_map.to_ours(stamp)
        if ours <= self._imu_t:
            self._after_resync += 1  # a correction back in time: wait until it is made up for
            return
        self._imu_t = ours
        self._imu_samples += 1
        self._listener.on_imu(ImuSample(ours, gyro, accel if np.isfinite(accel).all() else NOT_MEASURED))

    def _is_source(self, t: float, rank: int) -> bool:
        """Whether this kind of message is the one to integrate: the best that is coming."""
        self._imu_seen[rank] = t
        better = max(self._imu_seen[:rank], default=-math.inf)
        asked = self._requests.imu is IMU_MESSAGES[rank]
        if t - better < PREFER or (rank and not asked and t - self._known_at < PREFER):
            return False
        if rank != self._imu_rank:
            if self._imu_rank is not None:
                self._warn("imu source", "%s: IMU now from %s", self._link.address, IMU_MESSAGES[rank].name)
            self._imu_rank = rank
            self._cadence.reset()
        return True

    def _observe_clock(self, stamp: float, t: float) -> None:
        resyncs = self._clock_map.resyncs
        self._clock_map.observe(stamp, t)
        if self._clock_map.resyncs > resyncs:
            self._warn("resync", "hard resync of the autopilot's clock, no. %d", self._clock_map.resyncs)

    def _on_position(self, t: float, m: Any) -> None:
        position, velocity = np.array((m.x, m.y, m.z)), np.array((m.vx, m.vy, m.vz))
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            self._invalid += 1
            return
        self._position = (m.time_boot_ms * 1e-3, position, velocity)

    def _on_attitude(self, t: float, m: Any) -> None:
        self._on_imu(t, m)
        stamp = m.time_boot_ms * 1e-3
        if self._pose_stamp is not None and stamp < self._pose_stamp:
            if stamp > self._pose_stamp - Cadence.REBOOT:
                return
            self._rebooted(stamp)
        self._pose_stamp = stamp
        if self._clock_map.offset is None or t - self._imu_at > STALE_AFTER:
            self._observe_clock(stamp, t)  # without an IMU, this is what tells the autopilot's time
        q = np.array((m.q1, m.q2, m.q3, m.q4))
        ours = self._clock_map.to_ours(stamp)
        if not 0.9 < float(q @ q) < 1.1 or abs(ours - t) > POSE_MISMATCH:
            self._invalid += 1
            return
        if self._position is None or abs(stamp - self._position[0]) > POSITION_AGE:
            self._poses_without_position += 1
            where = None
        else:
            at, position, velocity = self._position
            where = position + (stamp - at) * velocity
        self._poses += 1
        self._listener.on_pose(EgoPose(ours, where, from_quaternion(q)))

    def _rebooted(self, stamp: float) -> None:
        self._reboots += 1
        self._warn(
            "reboot",
            "%s: autopilot %s has rebooted (its clock: %.1f s)",
            self._link.address,
            self._system,
            stamp,
        )
        self._clock_map.reset()
        self._cadence.reset()
        self._pose_stamp = self._position = None
        self._asked_time.clear()
        self._exchanges = 0
        self._requests.reset()
        self._listener.on_autopilot_reboot()

    # ── time ─────────────────────────────────────────────────────────────────────────────────────────────────────

    def _ask_time(self) -> None:
        sent = self._clock.now()
        ns = max(1, int(sent * 1e9))  # 0 would make it an answer
        self._asked_time[ns] = sent
        while len(self._asked_time) > TIMESYNC_FIRST:
            del self._asked_time[next(iter(self._asked_time))]
        self._send(common.MAVLink_timesync_message(tc1=0, ts1=ns))

    def _on_timesync(self, t: float, m: Any) -> None:
        if m.tc1 == 0:
            self._send(common.MAVLink_timesync_message(tc1=int(t * 1e9), ts1=m.ts1))
            return
        sent = self._asked_time.pop(m.ts1, None)
        stamp = m.tc1 * 1e-9
        # Some firmwares keep another clock for this than for their sensors.
        if sent is None or self._cadence.newest is None or abs(stamp - self._cadence.newest) > POSE_MISMATCH:
            return
        self._exchanges += 1
        self._clock_map.exchange(sent, stamp, t)

    def _now(self) -> float:
        return self._received_at if self._link.recording and self._bytes else self._clock.now()

    # ── what state it is in, and why ─────────────────────────────────────────────────────────────────────────────

    def _judge(self, now: float) -> None:
        """Set the state; log one line where it, or the reason for it, has changed."""
        self._state = self._state_at(now)
        if self._state is State.STALE or self._down == OPENING:
            return  # a hiccup until it is called lost; nothing to say until the first attempt is over
        if self._state is State.STREAMING:
            if self._trouble and self._imu_rate_hz:  # the line tells the rate, so wait until it is known
                self._trouble = ""
                self._say(
                    logging.INFO, "streaming", "%s: streaming: %s", self._link.address, self._sentence(now)[1]
                )
            return
        name, text = self._sentence(now)
        patient = self._down is None and now - max(self._opened_at, self._known_at) < DIAGNOSE_AFTER
        if name != self._trouble and (not patient or self._state is State.LOST):
            self._trouble = name
            self._warn(name, "%s: %s: %s", self._link.address, self._state, text)

    def _state_at(self, now: float) -> State:
        if self._down is not None or self._system is None:
            return State.SEARCHING
        if now - self._heard_at > LOST_AFTER:
            return State.LOST
        silence = now - self._imu_at
        if silence > LOST_AFTER:
            return State.REQUESTING
        return State.STALE if silence > max(STALE_AFTER, 3 * self._cadence.period) else State.STREAMING

    def _sentence(self, now: float) -> tuple[str, str]:
        """(name, text) of the present state; the name does not change while only a number does."""
        if self._down is not None:
            return self._down, self._down if self._down == OPENING else f"{self._down}; trying again"
        match self._state:
            case State.SEARCHING:
                return self._why_no_autopilot()
            case State.LOST:
                why = self._signature_trouble or f"nothing from autopilot {self._system}"
                return "lost", f"{why} for {now - self._heard_at:.0f} s"
            case State.REQUESTING:
                return "no imu", "heartbeat, no IMU" + (
                    "" if self._link.recording else f" ({self._requests.imu.name} asked for)"
                )
            case State.ENDED:
                return "ended", f"{self._imu_samples} IMU samples and {self._poses} poses played"
            case State.STALE:
                return "stale", f"no IMU sample for {now - self._imu_at:.1f} s"
            case _:
                return "streaming", self._imu_text()

    def _why_no_autopilot(self) -> tuple[str, str]:
        framer = self._framer
        if not self._bytes:
            remark = f" ({self._link.remark})" if self._link.remark else ""
            return f"0 bytes{remark}", f"port open, 0 bytes{remark}"
        if framer.good == self._frames_before:
            guess = "wrong baud?" if self._link.bytes_per_second is not None else "not MAVLink?"
            return "no frame", f"bytes but no valid frame: {guess} ({framer.bad_bytes} bad)"
        if self._signature_trouble:
            return "signature", f"frames, but {self._signature_trouble}"
        others = ", ".join(f"{s}/{c} {what}".strip() for (s, c), what in self._others.items())
        expected = "" if self._expected_system is None else f" of system {self._expected_system}"
        return (
            "no heartbeat",
            f"frames but no autopilot heartbeat{expected} (heard: {others or 'nobody by name'})",
        )

    def _imu_text(self) -> str:
        stream = self._requests.imu_stream
        name = IMU_MESSAGES[self._imu_rank or 0].name
        sigma = self._clock_map.sigma
        clock = f", clock ±{sigma * 1e3:.1f} ms" if math.isfinite(sigma) else ""
        asked = "" if self._link.recording else f"{stream.asked_hz:g} Hz asked, "
        return f"IMU {asked}{self._imu_rate_hz:.0f} Hz got from {name}{clock}"

    def _say(self, level: int, name: str, text: str, *values: object) -> None:
        """Log, but the same news at most every SAY_AGAIN seconds: a flapping link writes no stream of lines."""
        now = self._now()
        if now - self._said.get(name, -math.inf) >= SAY_AGAIN:
            self._said[name] = now
            log.log(level, text, *values)

    def _warn(self, name: str, text: str, *values: object) -> None:
        self._say(logging.WARNING, name, text, *values)

    def status(self) -> LinkStatus:
        """One line for people, and the counters, all since the start."""
        now = self._now()
        if self._link.address.scheme == "none":
            return LinkStatus("autopilot", True, "none: no autopilot asked for")
        text = f"{self._link.address}: {self._state}: {self._sentence(now)[1]}"
        framer, cadence, clock_map = self._framer, self._cadence, self._clock_map
        counters: dict[str, float] = {
            "imu_rate_asked_hz": self._requests.imu_rate_hz,
            "imu_rate_granted_hz": self._requests.imu_stream.target_hz,
            "imu_rate_hz": self._imu_rate_hz,
            "imu_samples": self._imu_samples,
            "imu_lost": cadence.lost,
            "gaps": cadence.gaps,
            "duplicates": cadence.repeated,
            "invalid": self._invalid,
            "after_resync": self._after_resync,
            "poses": self._poses,
            "poses_without_position": self._poses_without_position,
            "frames": framer.good,
            "frames_unknown": framer.unknown,
            "foreign": self._foreign,
            "bad_bytes": framer.bad_bytes,
            "crc_failures": framer.crc_failures,
            "reboots": self._reboots,
            "reconnects": self._reconnects,
            "clock_offset_s": clock_map.offset if clock_map.offset is not None else math.nan,
            "clock_sigma_s": clock_map.sigma,
            "clock_skew_ppm": clock_map.skew * 1e6,
            "clock_resyncs": clock_map.resyncs,
            "timesyncs": self._exchanges,
        }
        if self._codec.has_key:
            counters |= {
                "signed_good": self._codec.signed_good,
                "signed_bad": self._codec.signed_bad,
                "signed_old": self._codec.signed_old,
                "unsigned": self._codec.unsigned,
            }
        ok = self._state in (State.STREAMING, State.ENDED)
        return LinkStatus("autopilot", ok, text, tuple(counters.items()))
