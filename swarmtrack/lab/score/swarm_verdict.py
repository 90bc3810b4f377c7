"""What a swarm's flight comes to: the report, what is expected of it, and where it falls short."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from swarmtrack.lab.score.formation_score import NEAR_MISS_M, FormationScore
from swarmtrack.lab.score.relative_score import NO_PLACES, RelativeScore
from swarmtrack.lab.score.swarm_score import SwarmScore

REFERENCE_WIDTH = 640  # px: RMSE limits are for images of this width
BUSY = 0.9  # of a machine's cores: from here on it has no time left, and what takes time is not judged


class Verdict(enum.StrEnum):
    """What a flight comes to."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_JUDGED = "not judged"
    """Nothing is wrong, but the flight was cut off, or something came late or not at all on a machine without time."""


class Shortfall(NamedTuple):
    """A figure that is not as expected. key: its name in the JSON; drones: those concerned, the worst first."""

    key: str
    found: str
    expected: str = ""
    drones: tuple[int, ...] = ()

    def __str__(self) -> str:
        match self.drones:
            case ():
                whose = ""
            case (drone_id,):
                whose = f" of drone {drone_id}"
            case (worst, *_):
                whose = f" of {len(self.drones)} drones, worst of drone {worst}"
        return f"{self.key}{whose}: {self.found}" + (f", expected {self.expected}" if self.expected else "")


@dataclass(frozen=True, slots=True)
class Limits:
    """What is expected of a flight, unless its scenario says otherwise in [expected]."""

    correct: float = 0.97
    """Minimum share of correct names."""
    proved: float = 0.0
    """Minimum share of correct names that are confirmed by motion; 0 where no drone shares its velocity."""
    wrong: float = 0.001
    """Maximum share of wrong names."""
    agreement: float = 0.99
    """Minimum share of equal names where two observers name the same drone."""
    time_to_identify_s: float = 2.0
    """Maximum time from a drone's appearance to its name, s."""
    rmse_px: float = 2.5
    """Maximum RMSE of the tracks, in an image 640 px wide."""
    all_known_s: float = 5.0
    """Maximum time from the last start of an agent until each has all announcements, s."""
    rate: float = 0.95
    """Minimum rate of tracks and of IMU samples, as a share of the configured one."""
    false_tracks_per_s: float = 0.2
    """Maximum number of false tracks of one observer, per second."""
    announcement_bytes: int = 300
    """Maximum size of one announcement as it is received, bytes."""
    first_tracks_s: float = 5.0
    """Maximum time from the beginning of the flight, or from a late agent's start, to its first tracks, s."""
    slot_p50_m: float = 1.0
    """In formation: maximum median distance from the slots, m."""
    slot_p95_m: float = 2.5
    """In formation: maximum 95 % quantile of the distance from the slots, m."""
    slot_end_p95_m: float = 1.5
    """In formation: maximum 95 % quantile of the followers' mean distances at the end, m."""
    separation_m: float = NEAR_MISS_M
    """In formation: minimum distance between any two drones at any time, m."""
    lost: int = 0
    """In formation: maximum number of followers far off their slots at the end."""
    leader_gone_m_s: float = 0.5
    """In formation: maximum speed of any follower 4 s after the leader has left every view, m/s."""
    leader_gone_m: float = 6.0
    """In formation: maximum distance that any follower then flies on, m."""


@dataclass(frozen=True, slots=True)
class AgentFigures:
    """How one agent did, by its own health messages; NaN where it never said.

    latency: from a frame's exposure to the first message with tracks of it, s; p50 and p95. announcement_bytes: of
    one announcement as heard; announcements_sent: puts and answers to whoever asked. first_tracks_s: world time of its
    first tracks.
    """

    drone_id: int
    start_s: float
    first_tracks_s: float
    track_rate_hz: float
    imu_rate_hz: float
    detection_rate_hz: float
    latency_p50_s: float
    latency_p95_s: float
    cpu_percent: float
    rss_mb: float
    announcement_bytes: int | None
    announcements_sent: int


@dataclass(frozen=True, slots=True)
class SwarmReport:
    """All numbers of one flight, and what they should have been. machine_busy, others_busy: the share of all cores'
    time that was spent, and by other programs, while something was late, else over the whole flight; NaN where nobody
    knows. detail: how much of the scenario was simulated. cut_off_s: when the flight was cut off, NaN: it was not."""

    scenario: str
    drones: int
    seconds: float
    seed: int
    tracker: str
    detector: str
    score: SwarmScore
    all_known_s: float
    agents: tuple[AgentFigures, ...]
    asked_tracks_hz: float
    asked_imu_hz: float
    image_width: int
    limits: Limits
    relative: RelativeScore = NO_PLACES
    formation: FormationScore | None = None
    machine_busy: float = math.nan
    others_busy: float = math.nan
    detail: str = "full"
    cut_off_s: float = math.nan

    @property
    def shortfalls(self) -> list[Shortfall]:
        """One for every number that is not as expected, what is wrong first; none: passed."""
        return [*self.wrongs, *self.shortfalls_of_timing]

    @property
    def passed(self) -> bool:
        return self.verdict is Verdict.PASSED

    @property
    def is_cut_off(self) -> bool:
        return not math.isnan(self.cut_off_s)

    @property
    def verdict(self) -> Verdict:
        if self.is_cut_off and not self.wrongs:
            return Verdict.NOT_JUDGED
        if not self.shortfalls:
            return Verdict.PASSED
        excused = not self.wrongs and self.machine_busy > BUSY
        return Verdict.NOT_JUDGED if excused else Verdict.FAILED

    @property
    def wrongs(self) -> list[Shortfall]:
        """What is wrong, and not only late or missing: no busy machine is an excuse."""
        score, limits = self.score, self.limits
        short = self._too_much_said()
        if not score.samples:
            return short
        # Written so that NaN fails, where not said otherwise.
        if not score.wrong <= limits.wrong:
            short.append(Shortfall("identity.wrong", f"{score.wrong:.4f}", f"{limits.wrong:g} at most"))
        if score.agreement < limits.agreement:  # NaN: nobody shared a view, which is no disagreement
            found = f"{score.agreement:.4f}"
            short.append(Shortfall("identity.agreement", found, f"{limits.agreement:g} at least"))
        if score.false_tracks_per_s > limits.false_tracks_per_s:
            found = f"{score.false_tracks_per_s:.3f}"
            short.append(
                Shortfall("tracking.false_tracks_per_s", found, f"{limits.false_tracks_per_s:g} at most")
            )
        apart = math.inf if self.formation is None else self.formation.min_separation_m
        if not apart >= limits.separation_m:
            short.append(
                Shortfall("formation.min_separation_m", f"{apart:.2f}", f"{limits.separation_m:g} at least")
            )
        return short

    @property
    def shortfalls_of_timing(self) -> list[Shortfall]:
        """What a machine without time spoils: correct names are fewer where tracks come late, and who gets no time at
        all says nothing."""
        score, limits, short = self.score, self.limits, self._unheard()
        if not score.samples:
            return [
                Shortfall("identity", "nothing to judge", "a teammate in view for a second"),
                *short,
            ]
        if not score.correct >= limits.correct:
            short.append(
                Shortfall("identity.correct", f"{score.correct:.4f}", f"{limits.correct:g} at least")
            )
        if limits.proved > 0.0 and not score.proved >= limits.proved:
            short.append(Shortfall("identity.proved", f"{score.proved:.4f}", f"{limits.proved:g} at least"))
        if not self.all_known_s <= limits.all_known_s:
            took = (
                "never complete"
                if math.isnan(self.all_known_s)
                else f"complete after {self.all_known_s:.1f} s"
            )
            expected = f"{limits.all_known_s:g} s after the last start at most"
            short.append(Shortfall("announcements", took, expected))
        late = {a.drone_id: a.first_tracks_s - a.start_s for a in self._heard}
        tracks = {a.drone_id: a.track_rate_hz for a in self._heard}
        imu = {a.drone_id: a.imu_rate_hz for a in self._heard}
        named = score.time_to_identify_s
        rmse_px = limits.rmse_px * self.image_width / REFERENCE_WIDTH
        return [
            *_above("identity.time_to_identify_s", named, limits.time_to_identify_s, digits=1),
            *_above("tracking.rmse_px", score.rmse_px, rmse_px, digits=2),
            *short,
            *_above("delay of the first tracks, s,", late, limits.first_tracks_s, digits=1),
            *_below("track_rate_hz", tracks, limits.rate * self.asked_tracks_hz, digits=1),
            *_below("imu_rate_hz", imu, limits.rate * self.asked_imu_hz, digits=1),
            *self._shortfalls_of_slots(),
        ]

    def _shortfalls_of_slots(self) -> list[Shortfall]:
        """Who follows by sight needs a computer that looks."""
        formation, limits = self.formation, self.limits
        if formation is None:
            return []
        found = [
            ("error_m.p50", formation.error_p50_m, limits.slot_p50_m),
            ("error_m.p95", formation.error_p95_m, limits.slot_p95_m),
            ("error_m.end_p95", formation.end_p95_m, limits.slot_end_p95_m),
            ("lost", formation.lost, limits.lost),
        ]
        if formation.gone is not None:
            found += [
                ("leader_gone.speed_m_s, after 4 s", formation.gone.speeds[-1], limits.leader_gone_m_s),
                ("leader_gone.flown_on_m", formation.gone.flown_on_m, limits.leader_gone_m),
            ]
        return [
            Shortfall(f"formation.{name}", _said(value), f"{most:g} at most")
            for name, value, most in found
            if not value <= most
        ]

    @property
    def _heard(self) -> list[AgentFigures]:
        return [agent for agent in self.agents if not math.isnan(agent.first_tracks_s)]

    def _unheard(self) -> list[Shortfall]:
        """Who says nothing."""
        short = []
        unheard = [agent.drone_id for agent in self.agents if math.isnan(agent.first_tracks_s)]
        if unheard:
            short.append(Shortfall(_drones(unheard), "no tracks were received"))
        silent = [agent.drone_id for agent in self._heard if agent.announcement_bytes is None]
        if silent:
            short.append(Shortfall(_drones(silent), "never announced itself"))
        return short

    def _too_much_said(self) -> list[Shortfall]:
        """In one announcement."""
        size = {
            a.drone_id: float(a.announcement_bytes) for a in self._heard if a.announcement_bytes is not None
        }
        most = self.limits.announcement_bytes - 1
        return _above("announcement_bytes", size, most, digits=0)

    def as_record(self) -> dict[str, Any]:
        """For JSON. What cannot be said (NaN) is null."""
        score = self.score
        return {
            "scenario": self.scenario,
            "drones": self.drones,
            "seconds": self.seconds,
            "seed": self.seed,
            "tracker": self.tracker,
            "detector": self.detector,
            "identity": {
                "time_to_identify_s": {
                    str(observer): _rounded(seconds, 3) for observer, seconds in score.time_to_identify_s.items()
                },
                "correct": _rounded(score.correct),
                "proved": _rounded(score.proved),
                "wrong": _rounded(score.wrong),
                "wrong_max_probability": _rounded(score.wrong_max_probability),
                "unknown": _rounded(score.unknown),
                "agreement": _rounded(score.agreement),
            },
            "tracking": {
                "rmse_px": {str(observer): _rounded(rmse, 3) for observer, rmse in score.rmse_px.items()},
                "recall": _rounded(score.recall),
                "false_tracks_per_s": _rounded(score.false_tracks_per_s),
                "switches": score.switches,
            },
            "relative": {
                "rmse_m": _rounded(self.relative.rmse_m),
                "range_error": {
                    "p50": _rounded(self.relative.range_p50),
                    "p95": _rounded(self.relative.range_p95),
                },
                "nees6": {
                    "median": _rounded(self.relative.nees6_median),
                    "mean": _rounded(self.relative.nees6_mean),
                },
                "samples": self.relative.samples,
            },
            "agents": [_agent_record(agent) for agent in self.agents],
            **({} if self.formation is None else {"formation": _formation_record(self.formation)}),
            "detail": self.detail,
            "machine_busy": _rounded(self.machine_busy, 3),
            "others_busy": _rounded(self.others_busy, 3),
            "cut_off_s": _rounded(self.cut_off_s, 1),
            "shortfalls": [str(short) for short in self.shortfalls],
            "verdict": self.verdict,
            "passed": self.passed,
        }  # fmt: skip


def _agent_record(agent: AgentFigures) -> dict[str, Any]:
    return {
        "id": agent.drone_id,
        "track_rate_hz": _rounded(agent.track_rate_hz, 2),
        "imu_rate_hz": _rounded(agent.imu_rate_hz, 2),
        "detection_rate_hz": _rounded(agent.detection_rate_hz, 2),
        "latency_ms": {
            "p50": _rounded(1e3 * agent.latency_p50_s, 2),
            "p95": _rounded(1e3 * agent.latency_p95_s, 2),
        },
        "cpu_percent": _rounded(agent.cpu_percent, 1),
        "rss_mb": _rounded(agent.rss_mb, 1),
        "announcement_bytes": agent.announcement_bytes,
    }


def _formation_record(formation: FormationScore) -> dict[str, Any]:
    record: dict[str, Any] = {
        "error_m": {
            "p50": _rounded(formation.error_p50_m, 3),
            "p95": _rounded(formation.error_p95_m, 3),
            "end_p95": _rounded(formation.end_p95_m, 3),
        },
        "min_separation_m": _rounded(formation.min_separation_m, 3),
        "followers": formation.followers,
        "lost": formation.lost,
        "holds": formation.holds,
    }
    if formation.gone is not None:
        speeds = [_rounded(speed, 3) for speed in formation.gone.speeds]
        record["leader_gone"] = {
            "speed_m_s_after_1_2_3_4_s": speeds,
            "flown_on_m": _rounded(formation.gone.flown_on_m, 3),
        }
    return record


def _said(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.2f}"


def _above(key: str, values: Mapping[int, float], most: float, *, digits: int) -> list[Shortfall]:
    """Of the drones whose value is above `most`, if any; NaN is."""
    over = {drone_id: value for drone_id, value in values.items() if not value <= most}
    return _short(key, over, f"{most:g} at most", digits, badness=lambda value: value)


def _below(key: str, values: Mapping[int, float], least: float, *, digits: int) -> list[Shortfall]:
    under = {drone_id: value for drone_id, value in values.items() if not value >= least}
    return _short(key, under, f"{least:g} at least", digits, badness=lambda value: -value)


def _short(
    key: str, values: Mapping[int, float], expected: str, digits: int, badness: Callable[[float], float]
) -> list[Shortfall]:
    if not values:
        return []
    drones = sorted(values, key=lambda d: -math.inf if math.isnan(values[d]) else -badness(values[d]))
    return [Shortfall(key, f"{values[drones[0]]:.{digits}f}", expected, tuple(drones))]


def _drones(ids: Sequence[int]) -> str:
    return f"drone{'s' if len(ids) > 1 else ''} {', '.join(map(str, ids))}"


def _rounded(value: float, digits: int = 6) -> float | None:
    return round(value, digits) if math.isfinite(value) else None
