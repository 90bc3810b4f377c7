"""State of the link to an autopilot, and in one sentence why it is not streaming.

    searching ── ours among the autopilots ──▶ requesting ── first IMU sample ──▶ streaming ◀──▶ stale (0.5 s)
        ▲                                          ▲                                 │  ◀──▶ no pose (3 s)
        │                                          │                                 │  ◀──▶ faulty
        └──── connection gone, tried again ────────┴──────────── lost (3 s) ◀────────┘

Faulty is what streams and is of no use: two autopilots under one ID, or one too many; more thrown away than used; a
gyro that is too slow. Every state but streaming names its reason within 3 s: in `status`, and as one line in the log
when it changes.
"""

from __future__ import annotations

import enum
import logging
import math
from dataclasses import dataclass

from swarmtrack.autopilot.candidates import vehicle_name, with_article
from swarmtrack.autopilot.contact import OPENING, Contact, RepeatLimiter
from swarmtrack.autopilot.framer import Framer
from swarmtrack.autopilot.limits import (
    AUTOPILOT_LOST_AFTER_S,
    CANDIDATE_GONE_S,
    IMU_STALE_AFTER_S,
    SILENCE_DIAGNOSED_AFTER_S,
    SLOWEST_USEFUL_GYRO_HZ,
)
from swarmtrack.autopilot.links import Link
from swarmtrack.autopilot.pilot_switch import PilotSwitch
from swarmtrack.autopilot.signing import Codec
from swarmtrack.autopilot.streams import StreamRequests
from swarmtrack.autopilot.telemetry import Telemetry
from swarmtrack.messages import LinkStatus

SET_OWN_ID = "give each vehicle an ID of its own (ArduPilot SYSID_THISMAV or MAV_SYSID, PX4 MAV_SYS_ID)"
SET_SYSTEM = "set autopilot.system_id to that of this drone"


class State(enum.StrEnum):
    """State of the link to an autopilot."""

    SEARCHING = "searching"
    REQUESTING = "requesting"
    STREAMING = "streaming"
    STALE = "stale"
    NO_POSE = "no pose"
    FAULTY = "faulty"
    LOST = "lost"
    ENDED = "ended"  # a recording has been played to its end


@dataclass(slots=True, kw_only=True, eq=False)
class LinkState:
    """Reads all parts of a `MavlinkAutopilot` and changes none of them."""

    link: Link
    contact: Contact
    framer: Framer
    codec: Codec
    requests: StreamRequests
    telemetry: Telemetry
    news: RepeatLimiter
    switch: PilotSwitch | None = None
    state: State = State.SEARCHING
    _trouble: str = "just started"
    """The name of the present one, empty while streaming."""

    def update(self, now: float) -> None:
        """Set the state; log one line where it, or its reason, has changed."""
        self.state = self._state_at(now)
        contact, telemetry, address = self.contact, self.telemetry, self.link.address
        if self.state is State.STALE or contact.down == OPENING:
            return  # a hiccup until it is called lost; nothing to say until the first attempt is over
        if self.state is State.SEARCHING and contact.candidates.listens(now):
            return
        if self.state is State.STREAMING and not telemetry.lack(now):
            if self._trouble and telemetry.imu_rate_hz:  # the line tells the rate, so wait until it is known
                self._trouble = ""
                text = self._sentence(now)[1]
                self.news.log(logging.INFO, "streaming", "%s: streaming: %s", address, text)
            return
        name, text = self._sentence(now)
        patient = (
            contact.down is None
            and now - max(contact.opened_at, contact.known_at) < SILENCE_DIAGNOSED_AFTER_S
        )
        if name != self._trouble and (not patient or self.state is State.LOST):
            self._trouble = name
            self.news.warn(name, "%s: %s: %s", address, self.state, text)

    def _state_at(self, now: float) -> State:
        contact, telemetry = self.contact, self.telemetry
        if contact.down is not None or contact.system is None:
            return State.SEARCHING
        if now - contact.heard_at > AUTOPILOT_LOST_AFTER_S:
            return State.LOST
        if self._fault(now) is not None:
            return State.FAULTY
        silence = now - telemetry.imu_at
        if silence > AUTOPILOT_LOST_AFTER_S:
            return State.REQUESTING
        if silence > max(IMU_STALE_AFTER_S, 3 * telemetry.cadence.period):
            return State.STALE
        return State.NO_POSE if telemetry.has_no_pose(now) else State.STREAMING

    def contest(self, now: float) -> str:
        """Why ours may not be the only autopilot that is flown, in a few words; empty where it is."""
        contact = self.contact
        if contact.system is None:
            return ""
        if self._sharing(now):
            return f"two autopilots send as system {contact.system}"
        rivals = contact.candidates.rivals(contact.address, now)
        return f"two autopilots send, {contact.address} and {rivals[0].address}" if rivals else ""

    def _sharing(self, now: float) -> str:
        """By what two autopilots under our ID are told apart, in words; empty where there is one."""
        contact, apart = self.contact, self.telemetry.second_clock
        if contact.vehicle is not None and now - contact.shared_at < CANDIDATE_GONE_S:
            return f"{with_article(vehicle_name(contact.vehicle))} and {with_article(contact.changeling)}"
        if apart is not None:
            return f"their clocks are {abs(apart):.3g} s apart"
        return self.telemetry.senders.contradiction(now)

    def _fault(self, now: float) -> tuple[str, str, str] | None:
        """(name, text, trouble for a pilot) of what streams and is of no use; None where all is well."""
        contact, telemetry = self.contact, self.telemetry
        if sharing := self._sharing(now):
            text = (
                f"two autopilots send as system {contact.system} component {contact.component}, {sharing}: "
                f"{SET_OWN_ID}"
            )
            return "shared", text, "no single autopilot"
        if rivals := contact.candidates.rivals(contact.address, now):
            names = " and ".join(map(str, rivals))
            text = f"two autopilots send, {contact.address} is used and {names} came later: {SET_SYSTEM}"
            return "rival", text, "no single autopilot"
        if telemetry.fault:
            return telemetry.fault.partition(": ")[2], telemetry.fault, "no sound data"
        if telemetry.slow_gyro:
            text = f"the gyro is too slow, at least {SLOWEST_USEFUL_GYRO_HZ:g} Hz are needed: {self._imu_text(now)}"
            return "slow", text, "no fast IMU"
        return None

    def _sentence(self, now: float) -> tuple[str, str]:
        """(name, text) of the present state; the name does not change while only a number does."""
        contact, telemetry = self.contact, self.telemetry
        if contact.down is not None:
            return contact.down, contact.down if contact.down == OPENING else f"{contact.down}; trying again"
        match self.state:
            case State.SEARCHING:
                return self._why_no_autopilot(now)
            case State.LOST:
                why, valid = (
                    (f": {contact.signature_trouble}", " valid") if contact.signature_trouble else ("", "")
                )
                silence = f"nothing{valid} from autopilot {contact.system} for {now - contact.heard_at:.0f} s"
                return "lost", silence + why
            case State.REQUESTING:
                return "no imu", "heartbeat, no IMU" + (
                    "" if self.link.recording else f" ({self.requests.imu.name} asked for)"
                )
            case State.ENDED if contact.system is None:
                return self._why_no_autopilot(now)
            case State.ENDED:
                return (
                    "ended",
                    f"{telemetry.gyro.used} IMU samples and {telemetry.attitudes.used} poses played",
                )
            case State.NO_POSE:
                lack = "neither ATTITUDE_QUATERNION nor ATTITUDE comes"
                if thrown := str(telemetry.attitudes):
                    lack = f"no attitude is usable: {thrown}"
                return "no pose", f"{self._imu_text(now)}, but {lack}"
            case State.FAULTY:
                name, text, _ = self._fault(now) or ("faulty", "just now", "")
                return name, text
            case State.STALE:
                return "stale", f"no IMU sample for {now - telemetry.imu_at:.1f} s"
            case State.STREAMING if lack := telemetry.lack(now):
                return "no position", f"{self._imu_text(now)}, but no position: {lack}"
            case State.STREAMING:
                return "streaming", self._imu_text(now)

    def _why_no_autopilot(self, now: float) -> tuple[str, str]:
        framer, contact = self.framer, self.contact
        if not contact.bytes:
            remark = f" ({self.link.remark})" if self.link.remark else ""
            return f"0 bytes{remark}", f"port open, 0 bytes{remark}"
        if framer.good == contact.frames_before:
            guess = "wrong baud?" if self.link.bytes_per_second is not None else "not MAVLink?"
            return "no frame", f"bytes but no valid frame: {guess} ({framer.bad_bytes} bad)"
        if contact.signature_trouble:
            return "signature", f"frames, but {contact.signature_trouble}"
        if contact.candidates.listens(now):
            return "listening", "an autopilot is there, listening for others"
        if ambiguous := contact.candidates.ambiguous():
            names = " and ".join(map(str, ambiguous))
            number = "two" if len(ambiguous) == 2 else len(ambiguous)
            return "ambiguous", f"{number} autopilots send, {names}: {SET_SYSTEM}"
        if contact.twins:
            ports = " and ".join(f"{host} port {port}" for host, port, *_ in contact.twins)
            return "twins", f"two autopilots send under one ID, from {ports}: {SET_OWN_ID}"
        others = ", ".join(f"{at} {what}".strip() for at, what in contact.others.items())
        expected = "" if contact.expected_system is None else f" of system {contact.expected_system}"
        return (
            "no heartbeat",
            f"frames but no autopilot heartbeat{expected} (heard: {others or 'no autopilot by name'})",
        )

    def _imu_text(self, now: float) -> str:
        telemetry = self.telemetry
        sigma = telemetry.clock_map.sigma
        clock = f", clock ±{sigma * 1e3:.1f} ms" if math.isfinite(sigma) else ""
        if wrong := telemetry.clock_map.in_words:
            clock += f" (it {wrong})"
        gyro = f", gyro {telemetry.gyro_delay} late"
        asked = "" if self.link.recording else f"{self.requests.imu_stream.asked_hz:g} Hz asked, "
        switch = f", {self.switch.in_words(now)}" if self.switch else ""
        source = telemetry.imu_source.name
        place = ", no LOCAL_POSITION_NED comes" if telemetry.has_no_place(now) else ""
        copies = f", {telemetry.stamps.copies} copies dropped" if telemetry.stamps.copies else ""
        beside = ", ".join(map(str, self.contact.candidates.beside(self.contact.address, now)))
        heard = f", also on the link: {beside}" if beside else ""
        return f"IMU {asked}{telemetry.imu_rate_hz:.0f} Hz got from {source}{clock}{gyro}{switch}{place}{copies}{heard}"

    def trouble(self, now: float) -> str:
        """What is missing, in a few words for a pilot; empty for a short gap."""
        if self.state in (State.STREAMING, State.STALE, State.ENDED):
            return "no position" if self.telemetry.lack(now) else ""
        if self.state is State.NO_POSE:
            return "no attitude"
        if self.state is State.FAULTY:
            fault = self._fault(now)
            return "" if fault is None else fault[2]
        return "no IMU" if self.state is State.REQUESTING else "no autopilot"

    def status(self, now: float) -> LinkStatus:
        """One line for people, and the counters, all since the start."""
        if self.link.address.scheme == "none":
            return LinkStatus("autopilot", True, "none: no autopilot configured")
        text = f"{self.link.address}: {self.state}: {self._sentence(now)[1]}"
        framer, requests, codec = self.framer, self.requests, self.codec
        counters: dict[str, float] = {
            "imu_rate_asked_hz": requests.imu_rate_hz,
            "imu_rate_granted_hz": requests.imu_stream.target_hz,
            **self.telemetry.counters,
            "frames": framer.good,
            "frames_unknown": framer.unknown,
            "foreign": self.contact.foreign,
            "foreign_datagrams": self.link.foreign,
            "bad_bytes": framer.bad_bytes,
            "crc_failures": framer.crc_failures,
            "reconnects": self.contact.reconnects,
        }
        if self.contact.kind is not None:
            counters["autopilot_kind"] = self.contact.kind
        if codec.has_key:
            counters |= {
                "signed_good": codec.signed_good,
                "signed_bad": codec.signed_bad,
                "signed_old": codec.signed_old,
                "unsigned": codec.unsigned,
            }
        ended = self.state is State.ENDED and self.contact.system is not None
        ok = ended or (self.state is State.STREAMING and not self.telemetry.lack(now))
        return LinkStatus("autopilot", ok, text, tuple(counters.items()))
