"""What was wrong in a flight, most important first. Pure: a flight in, findings out.

Theory of operation. Each drone's health says once a second how its links are; the checks of `swarmtrack doctor` judge
each of these messages, and what lasts becomes one finding with its time. The rest is found in what was recorded: gaps,
messages that did not arrive, and directions to teammates that do not fit where these report to be. Findings of one
fault are one line, of all the drones that have it. Lines are ordered by severity times duration.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from swarmtrack.diagnosis.findings import Finding, Level, fault
from swarmtrack.diagnosis.mounting import ROTATION_OFF_DEG
from swarmtrack.diagnosis.readiness import SELF_DOUBT
from swarmtrack.diagnosis.sources import AutopilotFacts, CameraFacts, check_autopilot, check_camera
from swarmtrack.diagnosis.surroundings import CLOCKS_APART, in_words
from swarmtrack.messages import Array, LinkStatus
from swarmtrack.review.directions import misaligned
from swarmtrack.review.faults import flight_fault
from swarmtrack.review.flight import DroneFlight, FollowerCommand, Naming, ReviewedFlight
from swarmtrack.review.names import namings
from swarmtrack.wire.health import HealthMessage, LinkHealth

LINK_OPENING_S = 5.0  # s from an agent's start, in which links may still be opening
LASTING_S = 2.0  # s that a warning must last
MOMENT_S = 10.0  # s: what happens in an instant counts as long as its consequences take
FAILURE_WEIGHT = 100.0  # of a second of failure, in seconds of warning
HEALTH_GAP_S = 3.0  # s between two health messages, at most, that belong together
CAMERA_GAP_S, GYRO_GAP_S, PLACE_GAP_S = 2.0, 0.5, 1.0
FEWEST_FRAMES_HZ = 4.0
DRONE_GONE_S = 3.0  # s of silence before the flight's end, from which on a drone is gone
DROPPED_S = 4.0  # s without any of a teammate's messages, which are sent once a second
LOSS_SHARE, LOSS_LEAST = 0.1, 10
WALL_STEP_S = 1.0
CLUTTER_PER_TEAMMATE, CLUTTER_FREE = 1.0, 3.0  # detections per frame, beyond which a frame is cluttered
BUSY_LAG_S, BUSY_CPU_PERCENT = 0.1, 95.0
UNNAMED_S, WRONG_S = 5.0, 0.5
NOT_CAMERAS = frozenset({"autopilot", "detector", "zenoh", "memory", "recording", "formation"})

# What an agent says in its events; the words of its sentences that are needed are the groups.
EVENT_FAULTS: tuple[tuple[str, str, str], ...] = (
    ("pose.heading", r"our heading is off by about (?P<degrees>\d+)°", r"our start and heading fit"),
    ("pose.heading", r"our heading was reset by [+-]?(?P<degrees>\d+)", r"our start and heading fit"),
    ("pose.start", r"(?P<reason>we started about .*? of the stated start)", r"our start and heading fit"),
    ("pose.pads", r"we stand where drone (?P<other>\d+) is stated", r"our start and heading fit"),
    ("pose.teammate", r"drone (?P<other>\d+)'s start is .* off", r"drone \d+'s start fits what we see"),
    ("pose.teammate", r"drone (?P<other>\d+) moves like track \d+, .* stated position", r"^$"),
)
# A finding that another one of the same drone explains, if both are at the same time.
EXPLAINED_BY: Mapping[str, str] = {
    "camera.gap": r"camera\.(?!gap|rate)|team\.(gone|restarted)",
    "camera.rate": r"camera\.(?!rate)",
    "autopilot.gap": r"autopilot\.(rebooted|silent|lost|no_imu|unreachable|missing|signature)",
    "pose.doubt": r"pose\.(pads|heading|start)|mount\.direction|calibration\.scale",
    "team.loss": r"team\.(deaf|dropped|restarted)",
    "team.dropped": r"team\.restarted",
}


# Directions say nothing where any drone of the team is known not to be where it reports to be.
DIRECTIONS = frozenset({"mount.direction", "calibration.scale"})
MISPLACED = re.compile(r"pose\.(pads|heading|start)")


@dataclass(frozen=True, slots=True)
class FlightFinding:
    """A finding, of which drone, and from when to when [s]. seconds: how long of that it was so."""

    drone_id: int | None
    finding: Finding
    begin: float
    end: float
    seconds: float

    @property
    def weight(self) -> float:
        """Severity times duration, in seconds of a warning."""
        factor = FAILURE_WEIGHT if self.finding.level is Level.FAILURE else 1.0
        return factor * max(self.seconds, MOMENT_S if self.finding.level is Level.FAILURE else 0.0)


class ReviewLine(NamedTuple):
    """All findings of one fault, the weightiest first."""

    findings: tuple[FlightFinding, ...]

    @property
    def first(self) -> FlightFinding:
        return self.findings[0]

    @property
    def drones(self) -> tuple[int, ...]:
        return tuple(sorted({one.drone_id for one in self.findings if one.drone_id is not None}))

    @property
    def weight(self) -> float:
        return sum(one.weight for one in self.findings)


def review(flight: ReviewedFlight) -> list[ReviewLine]:
    """The lines, most important first."""
    found: list[FlightFinding] = []
    for drone in flight.drones.values():
        for check in _OF_A_DRONE:
            found += check(drone)
        for team_check in _OF_THE_TEAM:
            found += team_check(flight, drone)
    found += _of_strangers(flight)
    found += _whole(None, flight, (flight_fault("recording.cut", damage=one) for one in flight.swarm_damage))
    found = _unexplained(found)
    by_fault: defaultdict[str, list[FlightFinding]] = defaultdict(list)
    for one in found:
        by_fault[one.finding.fault or f"{one.finding.check} {one.finding.found}"].append(one)
    lines = [ReviewLine(tuple(sorted(of, key=lambda one: -one.weight))) for of in by_fault.values()]
    return sorted(lines, key=lambda line: (-line.weight, line.first.begin))


def _unexplained(found: list[FlightFinding]) -> list[FlightFinding]:
    misplaced = any(MISPLACED.match(one.finding.fault) for one in found)

    def explained(one: FlightFinding) -> bool:
        if misplaced and one.finding.fault in DIRECTIONS:
            return True
        causes = EXPLAINED_BY.get(one.finding.fault)
        return causes is not None and any(
            other.drone_id == one.drone_id
            and other is not one
            and re.match(causes, other.finding.fault) is not None
            and other.begin <= one.end + LINK_OPENING_S
            and one.begin <= other.end + LINK_OPENING_S
            for other in found
        )

    return [one for one in found if not explained(one)]


def _whole(
    drone_id: int | None, of: DroneFlight | ReviewedFlight, findings: Iterable[Finding]
) -> list[FlightFinding]:
    """Findings that hold from the beginning to the end."""
    begin, end = (of.begin, of.end) if isinstance(of, DroneFlight) else (0.0, of.seconds)
    return [FlightFinding(drone_id, one, begin, end, end - begin) for one in findings]


# --- health ---------------------------------------------------------------------------


def _of_health(drone: DroneFlight) -> list[FlightFinding]:
    """What the doctor says of each health message, and how long it says so."""
    said: defaultdict[str, list[tuple[float, float, Finding]]] = defaultdict(list)
    frames: dict[str, tuple[float, float]] = {}
    for k, (t, message) in enumerate(drone.health):
        if any(t < life.begin + LINK_OPENING_S for life in drone.lives if life.begin <= t):
            continue
        after = drone.health[k + 1][0] if k + 1 < len(drone.health) else t + 1.0
        lasts = min(after - t, HEALTH_GAP_S)
        for finding in _judged(drone, t, message, frames):
            if finding.level in (Level.WARNING, Level.FAILURE):
                said[finding.fault or finding.check].append((t, lasts, finding))
    found = []
    for several in said.values():
        seconds = sum(lasts for _, lasts, _ in several)
        finding = several[len(several) // 2][2]
        if seconds < LASTING_S and finding.level is Level.WARNING:
            continue
        begin, end = several[0][0], several[-1][0] + several[-1][1]
        found.append(FlightFinding(drone.drone_id, finding, begin, end, seconds))
    return found


def _judged(
    drone: DroneFlight, t: float, message: HealthMessage, frames: dict[str, tuple[float, float]]
) -> Iterator[Finding]:
    """frames: by camera, how many had come, and since when it is this number."""
    for link in message.links:
        status = LinkStatus(link.name, link.ok, link.text, tuple(link.counters.items()))
        if link.name == "autopilot":
            yield from check_autopilot(AutopilotFacts(HEALTH_GAP_S, status=status))
        elif link.name not in NOT_CAMERAS:
            yield from _judged_camera(drone, t, status, frames)
        elif not link.ok and link.name in _LINK_FAULTS:
            yield _LINK_FAULTS[link.name](link)
        elif link.name == "recording" and link.counters.get("lost", 0.0) > 0.0:
            yield _LINK_FAULTS["recording"](link)
    if message.noise is not None and message.noise.found:
        yield Finding("tracking", Level.WARNING, message.noise.found, message.noise.remedy)
    reasons = message.readiness.reasons if message.readiness is not None else ()
    if any(reason.startswith(SELF_DOUBT) for reason in reasons):
        yield flight_fault("pose.doubt")
    lag = message.latencies.get("loop_lag")
    if (lag is not None and lag.p95_s > BUSY_LAG_S) or message.cpu_percent > BUSY_CPU_PERCENT:
        lag_ms = 1e3 * lag.p95_s if lag is not None else 0.0
        yield flight_fault("machine.busy", lag_ms=lag_ms, cpu=message.cpu_percent)
    detector = message.latencies.get("detector")
    fps = max((link.counters.get("fps", 0.0) for link in message.links), default=0.0)
    if detector is not None and fps > 0.0 and detector.p50_s > 1.0 / fps:
        yield fault("detector.slow", ms=1e3 * detector.p50_s, period_ms=1e3 / fps)


def _judged_camera(
    drone: DroneFlight, t: float, status: LinkStatus, frames: dict[str, tuple[float, float]]
) -> list[Finding]:
    count = dict(status.counters).get("frames", 0.0)
    known, since = frames.get(status.name, (-1.0, t))
    if count != known:
        frames[status.name] = count, t
        since = t
    silent_s = t - since
    facts = CameraFacts(
        max(silent_s, LASTING_S),
        drone.max_age_s,
        status,
        asked_hz=drone.asked_fps,
        frames=0 if silent_s >= CAMERA_GAP_S else int(count) or 1,
        kind=status.name.partition("://")[0],
    )
    return check_camera(facts)


_LINK_FAULTS: Mapping[str, Callable[[LinkHealth], Finding]] = {
    "detector": lambda link: fault("detector.model", reason=link.text),
    "zenoh": lambda link: fault("network.router" if "router" in link.text else "network.closed", reason=link.text),
    "recording": lambda link: flight_fault(
        "recording.lost", count=link.counters.get("lost", 0.0), reason=link.text
    ),
}  # fmt: skip


def _of_events(drone: DroneFlight) -> list[FlightFinding]:
    """What the agent found out by itself, from when it said so until it said that all is well again."""
    first: dict[str, float] = {}
    for t, message in drone.health:
        for text in message.events:
            first.setdefault(text, t)
    found: dict[tuple[str, str], FlightFinding] = {}
    for name, pattern, ends in EVENT_FAULTS:
        for text, t in first.items():
            if (match := re.search(pattern, text)) is None:
                continue
            until = min(
                (s for other, s in first.items() if s > t and re.search(ends, other)), default=drone.end
            )
            words = match.groupdict()
            finding = flight_fault(name, **{k: float(v) if k == "degrees" else v for k, v in words.items()})
            found.setdefault(
                (name, words.get("other", "")),
                FlightFinding(drone.drone_id, finding, t, until, until - t),
            )
    return list(found.values())


def _of_counters(drone: DroneFlight) -> list[FlightFinding]:
    """Counters of the last health message that should be 0."""
    if not drone.health:
        return []
    links = {link.name: link.counters for link in drone.health[-1][1].links}
    drops = drone.health[-1][1].drops
    count = {
        "autopilot.invalid": links.get("autopilot", {}).get("invalid", 0.0)
        + drops.get("attitudes_refused", 0),
        "detector.unusable": float(drops.get("unusable_detections", 0)),
    }
    return _whole(drone.drone_id, drone, (flight_fault(k, count=n) for k, n in count.items() if n > 0))


def _of_clock(drone: DroneFlight) -> list[FlightFinding]:
    off = np.array([(t, message.t_utc_s - t) for t, message in drone.health]).reshape(-1, 2)
    steps = np.diff(off[:, 1])
    if not len(steps) or np.abs(steps).max() < WALL_STEP_S:
        return []
    k = int(np.abs(steps).argmax())
    finding = flight_fault("clock.step", step_s=float(steps[k]))
    return [FlightFinding(drone.drone_id, finding, float(off[k, 0]), drone.end, drone.end - float(off[k, 0]))]


# --- what was recorded ----------------------------------------------------------------


def _gaps(times: Array, longest_s: float, drone: DroneFlight) -> list[tuple[float, float]]:
    """Longer pauses within each life, and between the last one and its end."""
    found = []
    for life in drone.lives:
        inside = times[(times >= life.begin) & (times <= life.end)]
        if len(inside):
            edges = np.concatenate([inside, [life.end]])
            found += [(a, b) for a, b in pairwise(edges.tolist()) if b - a > longest_s]
    return found


def _of_gaps(drone: DroneFlight) -> list[FlightFinding]:
    found = []
    for name, times, longest_s in (
        ("camera.gap", drone.frames[:, 0], CAMERA_GAP_S),
        ("autopilot.gap", drone.imu, GYRO_GAP_S),
    ):
        gaps = _gaps(times, longest_s, drone)
        if gaps:
            longest = max(gaps, key=lambda gap: gap[1] - gap[0])
            seconds = sum(b - a for a, b in gaps)
            finding = flight_fault(name, seconds=longest[1] - longest[0])
            found.append(FlightFinding(drone.drone_id, finding, gaps[0][0], gaps[-1][1], seconds))
    lost = _gaps(drone.placed, PLACE_GAP_S, drone)
    lost = [(a, b) for a, b in lost if ((drone.placeless > a) & (drone.placeless < b)).any()]
    if lost:
        seconds = sum(b - a for a, b in lost)
        finding = flight_fault("autopilot.place_lost", seconds=seconds)
        found.append(FlightFinding(drone.drone_id, finding, lost[0][0], lost[-1][1], seconds))
    lasted = drone.end - drone.begin
    if drone.recorded and lasted > LINK_OPENING_S and 0 < len(drone.frames) < FEWEST_FRAMES_HZ * lasted:
        finding = flight_fault("camera.rate", got_hz=len(drone.frames) / lasted)
        found += _whole(drone.drone_id, drone, [finding])
    return found


def _of_moments(drone: DroneFlight) -> list[FlightFinding]:
    found = []
    if drone.reboots:
        finding = flight_fault("autopilot.rebooted", count=len(drone.reboots))
        found.append(FlightFinding(drone.drone_id, finding, drone.reboots[0], drone.reboots[-1], 0.0))
    for t, whom, boots in drone.clashes[:1]:
        finding = fault("network.id_clash", count=len(boots), id=whom, boots=", ".join(boots))
        found.append(FlightFinding(whom, finding, t, drone.end, drone.end - t))
    lives = sorted(drone.lives, key=lambda life: life.begin)
    overlaps = [b for a, b in pairwise(lives) if b.begin < a.end - 1.0]
    if overlaps:
        words = ", ".join(life.boot for life in lives)
        finding = fault("network.id_clash", count=len(lives), id=drone.drone_id, boots=words)
        found += _whole(drone.drone_id, drone, [finding])
    elif len(lives) > 1:
        finding = flight_fault("team.restarted", count=len(lives) - 1)
        found.append(FlightFinding(drone.drone_id, finding, lives[0].end, lives[-1].begin, 0.0))
    return found


def _of_files(drone: DroneFlight) -> list[FlightFinding]:
    findings = [flight_fault("recording.cut", damage=damage) for damage in drone.damage[:1]]
    if drone.refused:
        findings.append(flight_fault("recording.refused", count=drone.refused))
    return _whole(drone.drone_id, drone, findings)


def _of_commands(drone: DroneFlight) -> list[FlightFinding]:
    holds: defaultdict[str, list[tuple[FollowerCommand, float]]] = defaultdict(list)
    for one, following in pairwise(drone.commands):
        if one.holds and one.why not in ("not_engaged", "entry"):
            holds[one.why].append((one, min(following.t - one.t, 1.0)))
    found = []
    for several in holds.values():
        seconds = sum(lasts for _, lasts in several)
        if seconds >= LASTING_S:
            finding = flight_fault("formation.hold", seconds=seconds, reason=several[0][0].text)
            begin, end = several[0][0].t, several[-1][0].t
            found.append(FlightFinding(drone.drone_id, finding, begin, end, seconds))
    return found


# --- one drone among the others -------------------------------------------------------


def _of_clutter(flight: ReviewedFlight, drone: DroneFlight) -> list[FlightFinding]:
    teammates = len((flight.drones.keys() | {who for _, who in drone.announced}) - {drone.drone_id})
    if not len(drone.frames):
        return []
    full = drone.frames[drone.frames[:, 1] > CLUTTER_FREE + CLUTTER_PER_TEAMMATE * teammates]
    period_s = float(np.median(np.diff(drone.frames[:, 0]))) if len(drone.frames) > 1 else 0.0
    seconds = len(full) * period_s
    if seconds < LASTING_S:
        return []
    finding = flight_fault("detector.clutter", count=float(np.median(full[:, 1])), teammates=teammates)
    return [FlightFinding(drone.drone_id, finding, float(full[0, 0]), float(full[-1, 0]), seconds)]


def _of_silence(flight: ReviewedFlight, drone: DroneFlight) -> list[FlightFinding]:
    """Its recording ended before the others', and they heard nothing any more."""
    heard_last = max(
        (one.t for other in flight.drones.values() for one in other.heard if one.observer == drone.drone_id),
        default=drone.end,
    )
    silent_s = flight.seconds - max(drone.end, heard_last)
    if silent_s < DRONE_GONE_S:
        return []
    finding = flight_fault("team.gone", seconds=silent_s)
    return [FlightFinding(drone.drone_id, finding, flight.seconds - silent_s, flight.seconds, silent_s)]


def _of_strangers(flight: ReviewedFlight) -> list[FlightFinding]:
    """Teammates of whom there is no recording, and who left."""
    left: dict[int, float] = {}
    for drone in flight.drones.values():
        for t, whom, there in drone.alive:
            if whom not in flight.drones:
                if there:
                    left.pop(whom, None)
                else:
                    left[whom] = t
    return [
        FlightFinding(
            whom, flight_fault("team.gone", seconds=flight.seconds - t), t, flight.seconds, flight.seconds - t
        )
        for whom, t in left.items()
        if flight.seconds - t >= DRONE_GONE_S
    ]


def _of_messages(flight: ReviewedFlight, drone: DroneFlight) -> list[FlightFinding]:
    """The reports that a drone received of those that each teammate recorded as sent."""
    found = []
    for other in flight.drones.values():
        begin = max(drone.begin, other.begin) + LINK_OPENING_S
        end = min(drone.end, other.end) - 1.0
        sent = {key: t for key, t in other.sent.items() if begin <= t <= end}
        if other is drone or not drone.recorded or len(sent) < 5:
            continue
        arrived = {one.key for one in drone.heard}
        if not arrived & other.sent.keys():
            finding = flight_fault("team.deaf", other=other.drone_id)
            found.append(FlightFinding(drone.drone_id, finding, begin, end, end - begin))
            continue
        times = np.array([begin, *sorted(sent[key] for key in sent.keys() & arrived), end])
        k = int(np.diff(times).argmax())
        a, b = float(times[k]), float(times[k + 1])
        if b - a > DROPPED_S and sum(a < t < b for t in sent.values()) >= 3:
            finding = flight_fault("team.dropped", other=other.drone_id, seconds=b - a)
            found.append(FlightFinding(drone.drone_id, finding, a, b, b - a))
        share = 1.0 - len(sent.keys() & arrived) / len(sent)
        if share > LOSS_SHARE and len(sent) >= LOSS_LEAST:
            finding = flight_fault("team.loss", other=other.drone_id, share=share)
            found.append(FlightFinding(drone.drone_id, finding, begin, end, end - begin))
    return found


def _of_other_clocks(flight: ReviewedFlight, drone: DroneFlight) -> list[FlightFinding]:
    shifts = flight.clock_shifts
    if drone.drone_id not in shifts or len(shifts) < 2:
        return []
    other = min(shifts, key=lambda i: (abs(shifts[i] - float(np.median(list(shifts.values())))), i))
    apart = shifts[drone.drone_id] - shifts[other]
    if abs(apart) <= CLOCKS_APART:
        return []
    way = "ahead of" if apart > 0.0 else "behind"
    return _whole(
        drone.drone_id, drone, [fault("network.clock", off=in_words(abs(apart)), direction=way, id=other)]
    )


def _of_directions(flight: ReviewedFlight, drone: DroneFlight) -> list[FlightFinding]:
    found = misaligned(drone)
    if found is None:
        return []
    if found.wrong_scale:
        return _whole(drone.drone_id, drone, [flight_fault("calibration.scale", factor=found.scale)])
    if found.angle_deg > ROTATION_OFF_DEG:
        return _whole(drone.drone_id, drone, [flight_fault("mount.direction", degrees=found.angle_deg)])
    return []


def _of_names(flight: ReviewedFlight, drone: DroneFlight) -> list[FlightFinding]:
    found = []
    for naming in namings(flight, drone):
        wrong = [span for span in naming.spans if span.state == "wrong"]
        if (seconds := sum(span.end - span.begin for span in wrong)) > WRONG_S:
            finding = flight_fault("names.wrong", other=naming.teammate, seconds=seconds)
            found.append(FlightFinding(drone.drone_id, finding, wrong[0].begin, wrong[-1].end, seconds))
        found += _unnamed(drone, naming)
    return found


def _unnamed(drone: DroneFlight, naming: Naming) -> list[FlightFinding]:
    spans = [
        span
        for span in naming.spans
        if span.state in ("unnamed", "undetected") and span.begin > drone.begin + LINK_OPENING_S
    ]
    seconds = sum(span.end - span.begin for span in spans)
    if seconds < UNNAMED_S:
        return []
    reasons: defaultdict[str, float] = defaultdict(float)
    for span in spans:
        reasons[span.why] += span.end - span.begin
    why = max(reasons, key=lambda reason: reasons[reason])
    finding = flight_fault("names.unknown", other=naming.teammate, seconds=seconds, why=why)
    return [FlightFinding(drone.drone_id, finding, spans[0].begin, spans[-1].end, seconds)]


_OF_A_DRONE: tuple[Callable[[DroneFlight], list[FlightFinding]], ...] = (
    _of_health, _of_events, _of_counters, _of_clock, _of_gaps, _of_moments, _of_files, _of_commands,
)  # fmt: skip
_OF_THE_TEAM: tuple[Callable[[ReviewedFlight, DroneFlight], list[FlightFinding]], ...] = (
    _of_clutter, _of_silence, _of_messages, _of_other_clocks, _of_directions, _of_names,
)  # fmt: skip
