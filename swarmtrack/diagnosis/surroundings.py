"""Detector, network, keys, disk and temperature: facts, judged. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from swarmtrack.diagnosis.findings import Finding, Level, fault, ok, skipped

CLOCKS_APART = 2.0  # s: more than announcements take on their way
EXPIRES_SOON_DAYS = 14.0  # days
FULL_MB, LOW_MB = 50.0, 1000.0
HOT = 80.0  # °C
# Bits of the Raspberry Pi's get_throttled: what holds now, and what held since it was switched on.
THROTTLED = {
    0: "under-voltage",
    1: "capped frequency",
    2: "throttled",
    3: "soft temperature limit",
    16: "under-voltage since boot",
    17: "capped frequency since boot",
    18: "throttled since boot",
    19: "soft temperature limit since boot",
}
KEY_TROUBLES = (
    ("keys.expired", r": expired on"),
    ("keys.early", r"is not valid before"),
    ("keys.mode", r"lets others on this machine read"),
)


@dataclass(frozen=True, slots=True)
class DetectorFacts:
    """refused: why it cannot be loaded, or empty; ms: median time of a frame; fps: of frames that come, if known."""

    wanted: bool = True
    refused: str = ""
    name: str = ""
    providers: tuple[str, ...] = ()
    runs_on: tuple[str, ...] = ()
    ms: float = 0.0
    fps: float | None = None


@dataclass(frozen=True, slots=True)
class NetworkFacts:
    """refused: why the network does not open; wrong_address: which entry can never link the team; keys_refused: why the
    keys do not open; each empty where all is well.

    alive: boots by ID; apart_s: our clock minus each teammate's; missing, strangers: names; absent_hosts: addresses to
    listen on that are not this machine's; multicast: (interface, what is wrong with it); expires_days: of the
    certificate; tracks_say: by drone, what its tracks misjudge of themselves and the remedy.
    """

    drone_id: int
    team: str
    refused: str = ""
    wrong_address: str = ""
    keys_refused: str = ""
    in_process: bool = False
    alive: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    apart_s: Mapping[int, float] = field(default_factory=dict)
    missing: tuple[str, ...] = ()
    strangers: tuple[str, ...] = ()
    absent_hosts: tuple[str, ...] = ()
    multicast: tuple[str, str] | None = None
    expires_days: float | None = None
    expires: str = ""
    tracks_say: Mapping[int, tuple[str, str]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DiskFacts:
    """One thing that is written: path, why it cannot be (or empty), bytes free there."""

    what: str
    path: Path
    refused: str
    free_bytes: float


@dataclass(frozen=True, slots=True)
class HeatFacts:
    """celsius by sensor; throttled: the Raspberry Pi's bits, None where there are none."""

    celsius: Mapping[str, float]
    throttled: int | None = None


def check_detector(facts: DetectorFacts) -> list[Finding]:
    if not facts.wanted:
        return [ok("detector", "none: the camera detects by itself")]
    if facts.refused:
        provider = "detector providers" in facts.refused
        return [fault("detector.provider" if provider else "detector.model", reason=facts.refused)]
    findings = []
    if facts.runs_on and facts.providers and facts.runs_on[0] != facts.providers[0]:
        findings.append(fault("detector.fallback", wanted=facts.providers[0], runs_on=facts.runs_on[0]))
    if facts.fps and facts.ms > 1e3 / facts.fps:
        findings.append(fault("detector.slow", ms=facts.ms, period_ms=1e3 / facts.fps))
    return findings or [
        ok("detector", f"{facts.name} on {', '.join(facts.runs_on)}, {facts.ms:.1f} ms per frame")
    ]


def check_network(facts: NetworkFacts) -> list[Finding]:
    """Check keys first: without them nothing else can be checked."""
    if facts.keys_refused:
        name = next(
            (n for n, pattern in KEY_TROUBLES if re.search(pattern, facts.keys_refused)), "keys.broken"
        )
        return [fault(name, reason=facts.keys_refused)]
    findings = []
    if facts.expires_days is not None and facts.expires_days < EXPIRES_SOON_DAYS:
        findings.append(fault("keys.soon", days=facts.expires_days, date=facts.expires))
    if facts.multicast and facts.multicast[1]:
        interface, reason = facts.multicast
        findings.append(fault("network.multicast", interface=interface, reason=reason))
    if facts.wrong_address:
        return [*findings, fault("network.wrong_address", reason=facts.wrong_address)]
    findings += [fault("network.address", host=host) for host in facts.absent_hosts]
    if facts.refused:
        name = "network.router" if "no router answers" in facts.refused else "network.closed"
        return [*findings, fault(name, reason=facts.refused)]
    ours = facts.alive.get(facts.drone_id, ())
    if len(ours) == 1:
        findings.append(fault("network.running", id=facts.drone_id, boot=ours[0]))
    findings += [
        fault("network.id_clash", id=i, count=len(boots), boots=", ".join(sorted(boots)))
        for i, boots in sorted(facts.alive.items())
        if len(boots) > 1
    ]
    if facts.missing:
        findings.append(fault("network.absent", names=", ".join(facts.missing)))
    if facts.strangers:
        findings.append(fault("network.stranger", names=", ".join(facts.strangers)))
    findings += [
        fault(
            "network.clock", id=i, off=in_words(abs(apart)), direction="ahead of" if apart > 0.0 else "behind"
        )
        for i, apart in sorted(facts.apart_s.items())
        if abs(apart) > CLOCKS_APART
    ]
    return findings or [ok("network", _answers(facts))]


def check_tracks(facts: NetworkFacts) -> list[Finding]:
    """Findings of running agents on their own tracks: see `tracking.check_tracking`."""
    return [
        Finding(
            "tracking",
            Level.WARNING,
            found if i == facts.drone_id else f"drone {i}: {found}",
            remedy,
        )
        for i, (found, remedy) in sorted(facts.tracks_say.items())
    ]


def _answers(facts: NetworkFacts) -> str:
    if facts.in_process:
        return "none: teammates are simulated within this process"
    others = sorted(i for i in facts.alive if i != facts.drone_id)
    told = ", ".join(
        f"drone {i} ({facts.apart_s[i]:+.1f} s)" if i in facts.apart_s else f"drone {i}" for i in others
    )
    certificate = (
        "" if facts.expires_days is None else f"; certificate valid for {facts.expires_days:.0f} days"
    )
    return f"team {facts.team}: {f'{told} answer' if others else 'no other agent answers (alone so far?)'}{certificate}"


def check_disk(facts: tuple[DiskFacts, ...]) -> list[Finding]:
    if not facts:
        return [skipped("disk", "nothing is written: there is no [output] and no [recording]")]
    findings = []
    for each in facts:
        free_mb = each.free_bytes / 1e6
        if each.refused:
            findings.append(fault("disk.unwritable", what=each.what, reason=each.refused))
        elif free_mb < LOW_MB:
            name = "disk.full" if free_mb < FULL_MB else "disk.low"
            findings.append(fault(name, what=each.what, path=each.path, free_mb=free_mb))
    least = min(each.free_bytes for each in facts)
    return findings or [ok("disk", f"{least / 1e9:.1f} GB are left for {', '.join(f.what for f in facts)}")]


def check_heat(facts: HeatFacts) -> list[Finding]:
    findings = []
    if facts.throttled:
        reasons = [text for bit, text in THROTTLED.items() if facts.throttled >> bit & 1]
        findings.append(fault("heat.throttled", reasons=", ".join(reasons) or f"bits {facts.throttled:#x}"))
    where = max(facts.celsius, key=lambda name: facts.celsius[name], default="")
    if where and facts.celsius[where] >= HOT:
        findings.append(fault("heat.hot", celsius=facts.celsius[where], where=where))
    if findings:
        return findings
    if not where:
        return [skipped("heat", "this machine reports no temperatures")]
    return [ok("heat", f"{facts.celsius[where]:.0f} °C at {where}")]


def in_words(seconds: float) -> str:
    """A duration for people: 4.2 s, 3 min, 2.1 h, 5 days."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size or (unit == "h" and seconds >= size):
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.1f} s"
