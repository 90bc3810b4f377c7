"""Faults of camera and autopilot from their status lines, counters and samples. Pure.

Sources name their own faults in a sentence (`LinkStatus.text`); here the sentence finds its entry, and so its remedy.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from swarmtrack.autopilot.address import parse_address
from swarmtrack.autopilot.limits import SLOWEST_USEFUL_GYRO_HZ
from swarmtrack.diagnosis.findings import Finding, fault, ok, skipped
from swarmtrack.errors import SourceError
from swarmtrack.geometry import rotation
from swarmtrack.geometry.geodesy import STANDARD_GRAVITY_M_S2
from swarmtrack.messages import Array, LinkStatus, StampKind

FRAME_LATE_MS = 150.0  # of a frame at arrival
DAMAGED = 0.02  # share of frames
BLANK = 2.0  # standard deviation of brightness, of 255
RATE_ENOUGH_SHARE = 0.8  # of a rate asked for
LOST_GYRO_SHARE = 0.01  # share of gyro samples
CLOCK_SIGMA_MS = 10.0
UNSTEADY_RESTARTS = 3  # of the map of the autopilot's clock: one is a clock that was set
AUTOPILOTS = {3.0: "ArduPilot", 12.0: "PX4"}  # by MAVLink's MAV_AUTOPILOT
UPSIDE_DOWN_DEG, TILTED_DEG = 120.0, 10.0
GRAVITY_OFF = 1.0  # m/s²
STILL_ACCELERATION = 0.5  # m/s², standard deviation: more is a drone in somebody's hands
BIASED = 0.02  # rad/s
STILL_TURN = 0.003  # rad/s: the attitude's own drift

# The first that matches, of what a camera says when it does not work.
CAMERA_TROUBLES = (
    ("camera.size", r"^frames are \d+x\d+, the calibration"),
    ("camera.garbled", r"but no picture|but none is understood"),
    ("camera.missing", r"is not there|unplugged"),
    ("camera.forbidden", r"permission denied"),
    ("camera.busy", r": busy, held by"),
    ("camera.login", r"(HTTP|RTSP) 40[13]\b"),
    (
        "camera.unreachable",
        r"cannot connect|(HTTP|RTSP) \d+|answers, but gives no video|ended the stream|^lost: ",
    ),
    ("camera.silent", r"waiting for the first frame|no frame for|no frame yet|nothing for|not opened yet"),
)
AUTOPILOT_TROUBLES = (
    ("autopilot.shared", r"two autopilots send (as system|under one ID)"),
    ("autopilot.second", r"autopilots send, "),
    ("autopilot.too_slow", r"the gyro is too slow"),
    ("autopilot.thrown_away", r": faulty: "),
    ("autopilot.no_pose", r": no pose: "),
    ("autopilot.missing", r"no such device|unplugged|went away while"),
    ("autopilot.forbidden", r"searching: permission"),
    ("autopilot.busy", r"busy, (port \d+ is )?held by"),
    (
        "autopilot.unreachable",
        r"nothing listens|is unknown here|no answer from|not an address of this machine|no name server|"
        r"other end closed|connection broke|unreachable",
    ),
    ("autopilot.silent", r"port open, 0 bytes"),
    ("autopilot.garbage", r"bytes but no valid frame"),
    ("autopilot.foreign", r"no autopilot heartbeat"),
    ("autopilot.signature", r"signing key|signs with another key"),
    ("autopilot.no_imu", r"heartbeat, no IMU"),
    ("autopilot.no_position", r"but no position"),
    ("autopilot.lost", r": (lost|stale): "),
)


@dataclass(frozen=True, slots=True)
class CameraFacts:
    """What was seen of a camera in `seconds`.

    refused: why its address can never work, or empty; status: its own; asked_hz: by the config, None where nothing was;
    frames: that came; size (width, height) px of the last; stamps: kinds seen; shade: mean and standard deviation of
    the last frame's brightness, 0…255; live: no recording; kind: the scheme of its address.
    """

    seconds: float
    max_age_s: float
    status: LinkStatus | None = None
    refused: str = ""
    asked_hz: float | None = None
    frames: int = 0
    size: tuple[int, int] | None = None
    stamps: frozenset[StampKind] = frozenset()
    shade: tuple[float, float] | None = None
    live: bool = True
    kind: str = ""


@dataclass(frozen=True, slots=True)
class AutopilotFacts:
    """What was heard of an autopilot in `seconds`. wanted: one is in the config; got_hz: gyro samples by their stamps,
    None: what the status says; the rest as of a camera."""

    seconds: float
    wanted: bool = True
    status: LinkStatus | None = None
    refused: str = ""
    live: bool = True
    got_hz: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ImuFacts:
    """Samples of gyro and accelerometer, and attitudes. gyro, accel (n, 3) rad/s, m/s², body FRD, NaN where not
    measured; attitudes (m, 3, 3) world_from_body at times (m,) s."""

    gyro: Array
    accel: Array
    attitude_t: Array
    attitudes: Array


@dataclass(frozen=True, slots=True)
class PoseFacts:
    """How well the autopilot knows its pose. Headings in degrees, as the config says; position_sigma [m] north and east
    and vertical_sigma [m] down of its last pose, None where no position came. unmeasured_m: the sigma that a start is
    given of which the config does not say how well it is known, None where it does."""

    heading_ground_deg: float
    heading_flight_deg: float
    position_sigma: float | None = None
    vertical_sigma: float | None = None
    unmeasured_m: float | None = None


def check_pose(facts: PoseFacts) -> list[Finding]:
    """Check the pose, which names depend on."""
    words = f"heading taken as ±{facts.heading_ground_deg:g}° on the ground, ±{facts.heading_flight_deg:g}° in flight"
    if facts.position_sigma is not None:
        vertical = facts.position_sigma if facts.vertical_sigma is None else facts.vertical_sigma
        words += f"; position ±{facts.position_sigma:.2g} m, height ±{vertical:.2g} m"
    known = ok("pose", f"{words} (autopilot.heading_sigma_deg, drone.start)")
    if facts.unmeasured_m is None:
        return [known]
    return [known, fault("pose.unmeasured", sigma_m=facts.unmeasured_m)]


def check_camera(facts: CameraFacts) -> list[Finding]:
    """One failure, or warnings, or a line that all is well."""
    kind = ("http" if facts.kind == "https" else facts.kind,)
    if facts.refused:
        name = "camera.size" if "the calibration is for" in facts.refused else "camera.address"
        return [fault(name, setting=kind, reason=facts.refused)]
    assert facts.status is not None
    numbers = dict(facts.status.counters)
    age_ms = numbers.get("age_p50_ms", 0.0)
    text = facts.status.text
    if not facts.status.ok or (facts.frames == 0 and facts.live):
        name = _named(CAMERA_TROUBLES, text, "camera.silent" if facts.status.ok else "camera.broken")
        return [fault(name, setting=kind, reason=_reason(text), seconds=facts.seconds)]
    if facts.live and age_ms > 1e3 * facts.max_age_s:
        return [fault("camera.stale", age_ms=age_ms, limit_s=facts.max_age_s)]
    findings = []
    if facts.live and age_ms > FRAME_LATE_MS:
        why = re.search(r": the stream is late, or .*", text)
        findings.append(fault("camera.late", setting=kind, age_ms=age_ms, why=why[0] if why else ""))
    got_hz = numbers.get("fps", 0.0)
    if facts.live and facts.asked_hz and 0.0 < got_hz < RATE_ENOUGH_SHARE * facts.asked_hz:
        findings.append(fault("camera.slow", got_hz=got_hz, asked_hz=facts.asked_hz))
    corrupt = numbers.get("corrupt", 0.0)
    if corrupt > DAMAGED * (corrupt + numbers.get("frames", 0.0)):
        share = corrupt / (corrupt + numbers.get("frames", 0.0))
        findings.append(fault("camera.damaged", setting=kind, share=share))
    if StampKind.ARRIVAL in facts.stamps:
        why = re.search(r"; stamps are not used: .*", text)
        findings.append(
            fault(
                "camera.stamps",
                setting=kind,
                sigma_ms=numbers.get("t_sigma_ms", math.nan),
                why=why[0] if why else "",
            )
        )
    if facts.shade is not None and facts.shade[1] < BLANK:
        findings.append(fault("camera.blank", mean=facts.shade[0], spread=facts.shade[1]))
    return findings or [ok("camera", _camera_in_words(facts, got_hz, age_ms))]


def _camera_in_words(facts: CameraFacts, got_hz: float, age_ms: float) -> str:
    kinds = {
        StampKind.EXPOSURE: "stamped at exposure",
        StampKind.READOUT: "stamped at the end of the frame",
        StampKind.MEDIA: "stamped by the recording",
    }
    words = [f"{facts.size[0]}x{facts.size[1]}"] if facts.size else []
    words.append(f"{got_hz:.1f} frames per second")
    words += [kinds[kind] for kind in sorted(facts.stamps, key=str) if kind in kinds]
    if facts.live and age_ms > 0.0:
        words.append(f"{age_ms:.0f} ms old when they arrive")
    return ", ".join(words)


def check_autopilot(facts: AutopilotFacts) -> list[Finding]:
    """Check the link: messages, rates, and the uncertainty of its clock."""
    if facts.refused:
        exposed = re.search(r"\bmode (is )?0?\d{3}\b", facts.refused)
        return [fault("keys.mode" if exposed else "autopilot.address", reason=facts.refused)]
    if not facts.wanted:
        return [fault("autopilot.none")]
    assert facts.status is not None
    numbers, text = dict(facts.status.counters), facts.status.text
    setting = _setting(facts.status)
    asked_hz = numbers.get("imu_rate_asked_hz", 0.0)
    got_hz = numbers.get("imu_rate_hz", 0.0) if facts.got_hz is None else facts.got_hz
    if not facts.status.ok:
        name = _named(AUTOPILOT_TROUBLES, text, "autopilot.broken")
        return [
            fault(
                name,
                setting=setting,
                reason=_reason(text),
                seconds=facts.seconds,
                got_hz=got_hz,
                asked_hz=asked_hz,
            )
        ]
    findings = []
    if facts.live and 0.0 < got_hz < RATE_ENOUGH_SHARE * asked_hz:
        slow = (
            "autopilot.too_slow"
            if got_hz < min(SLOWEST_USEFUL_GYRO_HZ, asked_hz) * 0.95
            else "autopilot.slow"
        )
        findings.append(fault(slow, setting=setting, got_hz=got_hz, asked_hz=asked_hz))
    samples, lost = numbers.get("imu_samples", 0.0), numbers.get("imu_lost", 0.0)
    if lost > LOST_GYRO_SHARE * (samples + lost):
        findings.append(fault("autopilot.losing", setting=setting, share=lost / (samples + lost)))
    if foreign := numbers.get("foreign_datagrams", 0.0):
        findings.append(fault("autopilot.strangers", count=foreign))
    if facts.live:
        findings += _check_clock(numbers, setting)
    if findings and (beside := re.search(r"also on the link: .*", text)):
        findings.append(ok("autopilot", beside[0]))
    return findings or [ok("autopilot", text)]


def check_door(link: str, *, signed: bool) -> list[Finding]:
    """Check whether other senders than the autopilot can reach the listening port. link: an address as in
    autopilot.link, which may be invalid; signed: by a configured key.
    """
    try:
        address = parse_address(link)
    except SourceError:
        return []
    if signed or not address.reachable_from_outside:
        return []
    return [fault("autopilot.open", address=address)]


def _check_clock(numbers: Mapping[str, float], setting: Sequence[str]) -> list[Finding]:
    """Its worst trouble: a clock that does not keep time is no fault of the link's."""
    skew, restarts = 1e-6 * numbers.get("clock_skew_ppm", 0.0), numbers.get("clock_restarts", 0.0)
    sigma_ms = 1e3 * numbers.get("clock_sigma_s", 0.0)
    if numbers.get("clock_drift_ppm", 0.0):
        percent = 100 * skew / (1 + skew)
        way = "slow" if percent > 0 else "fast"
        return [fault("autopilot.drift", setting=setting, percent=abs(percent), way=way)]
    if restarts >= UNSTEADY_RESTARTS:
        return [fault("autopilot.unsteady", setting=setting, restarts=restarts)]
    if math.isfinite(sigma_ms) and sigma_ms > CLOCK_SIGMA_MS:
        return [fault("autopilot.clock", setting=setting, sigma_ms=sigma_ms)]
    return []


def _setting(status: LinkStatus) -> tuple[str, ...]:
    """Whose words of advice apply, best first: the autopilot's on such a link, the autopilot's, the link's."""
    autopilot = AUTOPILOTS.get(dict(status.counters).get("autopilot_kind", -1.0), "")
    link = "serial" if status.text.startswith("serial:") else ""
    return (f"{autopilot} {link}", autopilot, link)


def check_imu(facts: ImuFacts) -> list[Finding]:
    """Check axes: direction of gravity, and gyro of a drone at rest."""
    accel = facts.accel[np.isfinite(facts.accel).all(axis=1)]
    if len(facts.gyro) == 0:
        return [skipped("imu", "no samples to look at")]
    if len(accel) < 10:
        return [skipped("imu", "this message has no accelerations: where gravity is was not checked")]
    felt = accel.mean(axis=0)
    norm = float(np.linalg.norm(felt))
    still = float(accel.std(axis=0).max()) < STILL_ACCELERATION
    if norm < 1.0:
        return [fault("imu.gravity", norm=norm)]
    up = felt / norm  # at rest the accelerometer feels what holds it up
    from_level = _angle_deg(up, np.array([0.0, 0.0, -1.0]))
    if from_level > UPSIDE_DOWN_DEG:
        return [fault("imu.upside_down", angle_deg=from_level)]
    findings = []
    if still and abs(norm - STANDARD_GRAVITY_M_S2) > GRAVITY_OFF:
        findings.append(fault("imu.gravity", norm=norm))
    if len(facts.attitudes):
        told = -facts.attitudes[:, 2, :].mean(axis=0)  # the world's up, in body axes
        off = _angle_deg(up, told / np.linalg.norm(told))
        if still and off > TILTED_DEG:
            findings.append(fault("imu.tilted", angle_deg=off))
        findings += _bias(facts)
    words = f"gravity is down ({from_level:.0f}° from level, {norm:.1f} m/s²)"
    if not still:
        words += "; the drone moves, so the rest was not checked"
    return findings or [ok("imu", words)]


def _bias(facts: ImuFacts) -> list[Finding]:
    """The gyro's mean against how the attitude moved meanwhile."""
    span = float(facts.attitude_t[-1] - facts.attitude_t[0])
    if span < 1.0:
        return []
    angle = float(rotation.angle(facts.attitudes[0].T @ facts.attitudes[-1]))
    steady = float(facts.gyro.std(axis=0).max()) < BIASED
    rate = float(np.linalg.norm(facts.gyro.mean(axis=0)))
    if steady and angle / span < STILL_TURN and rate > BIASED:
        return [fault("imu.bias", rate_deg_s=math.degrees(rate))]
    return []


def _angle_deg(a: Array, b: Array) -> float:
    return math.degrees(math.acos(min(max(float(a @ b), -1.0), 1.0)))


def _reason(text: str) -> str:
    """Without what only a program that goes on would do about it."""
    return re.sub(r"; (waiting for it|trying again|opening it again)$", "", text)


def _named(troubles: tuple[tuple[str, str], ...], text: str, otherwise: str) -> str:
    return next((name for name, pattern in troubles if re.search(pattern, text)), otherwise)
