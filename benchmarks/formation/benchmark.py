"""Flying in formation by what each drone sees, the loop closed: how far off slots, how near to each other, who is lost.

Whole flights in one process (`flights.py`): real trackers, names, places in metres, law and barrier; an ArduPilot's
measured response; oracle detections at 6.7 Hz, 150 ms late, with misses, noise and clutter. The leader flies a
square, then off, a quarter turn, and stops.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.formation.faults import GOING_DOWN, Failure, Fault
from swarmtrack.benchmarks.formation.flights import (
    COMMAND_HZ,
    DEPARTS_S,
    ENGAGED_S,
    LEADER,
    FlightPlan,
    FormationFlight,
)
from swarmtrack.benchmarks.formation.meetings import meet, meetings_row
from swarmtrack.benchmarks.harness import PROCESSES, Benchmark, flown, seeds, some_of
from swarmtrack.formation.setpoint import Why
from swarmtrack.lab.score.formation_score import (
    LOST_SLOT_M,
    NEAR_MISS_M,
    LeaderGone,
    SlotErrors,
    after_it_vanished,
    formation_score,
    slot_errors,
)
from swarmtrack.messages import Array

NAME = "formation"
# Of the law alone, without pictures (`meetings.py`).
MEETINGS = "meetings"
# s that an intruder is in view before it counts.
SEEN_S = 1.0
GONE_S, GONE_ENDS_S = 22.0, 32.0
INTRUDED_ENDS_S = 32.0
# m/s, of who steers at the first follower; and s.
HOMING_M_S, HOMED_ENDS_S = (1, 2, 3, 4, 5), 36.0
FAILED_ENDS_S = 52.0
# A leader that steers by way points turns at once.
SHARP_TURN_S = 1.0
# A follower, the first.
VICTIM = LEADER + 1
FAULTS = (
    ("swapped-id", Failure(fault=Fault.SWAPPED, victim=VICTIM)),
    ("stuck-camera", Failure(fault=Fault.STUCK_CAMERA, victim=VICTIM, ends_s=30.0)),
    ("agent-killed", Failure(fault=Fault.KILLED, victim=VICTIM)),
    ("leaders-agent-killed", Failure(fault=Fault.KILLED, victim=LEADER)),
    ("partition", Failure(fault=Fault.PARTITION, victim=LEADER, begins_s=16.0, ends_s=46.0)),
    ("reboot", Failure(fault=Fault.REBOOT, victim=VICTIM)),
    ("clock-2-h", Failure(fault=Fault.CLOCK, victim=VICTIM, begins_s=-math.inf)),
    ("leaders-clock-2-h", Failure(fault=Fault.CLOCK, victim=LEADER, begins_s=-math.inf)),
    ("gps-glitch", Failure(fault=Fault.GLITCH, victim=VICTIM, ends_s=34.0)),
    ("leaders-gps-glitch", Failure(fault=Fault.GLITCH, victim=LEADER, ends_s=34.0)),
    ("failsafe-rtl", Failure(fault=Fault.RETURNS, victim=VICTIM)),
    ("failsafe-land", Failure(fault=Fault.LANDS, victim=VICTIM)),
    ("leader-denied", Failure(fault=Fault.DENIED, victim=LEADER)),
    ("carried-follower", Failure(fault=Fault.FED, victim=VICTIM, ends_s=80.0)),
    ("drift-height-0.1", Failure(fault=Fault.HEIGHT_DRIFT, victim=VICTIM, speed_m_s=0.1)),
    ("drift-height-0.3", Failure(fault=Fault.HEIGHT_DRIFT, victim=VICTIM, speed_m_s=0.3)),
    ("not-obeyed", Failure(fault=Fault.PUSHED, victim=VICTIM, speed_m_s=1.0)),
)
# Which fault is to be found, and as what.
WATCHED = {Fault.HEIGHT_DRIFT: Why.HEIGHT_DOUBT, Fault.PUSHED: Why.DIVERGES}


def _hovering(name: str, ends_s: float, **more: Any) -> FlightPlan:
    """The leader stays where it is."""
    return FlightPlan(name=name, speed_m_s=0.0, ends_s=ends_s, **more)


def _failing(name: str, failure: Failure, **more: Any) -> FlightPlan:
    return FlightPlan(name=name, failure=failure, ends_s=FAILED_ENDS_S, **more)


FLIGHTS = {
    plan.name: plan
    for plan in (
        FlightPlan(name="star-3", drones=3),
        FlightPlan(name="star-5", drones=5),
        FlightPlan(name="star-8", drones=8, gap_m=7.0),
        FlightPlan(name="star-3-size", drones=3, share_hz=0.0, size_drone=0.10, sure=0.95),
        FlightPlan(name="star-5-size", drones=5, share_hz=0.0, size_drone=0.10, sure=0.95),
        FlightPlan(name="star-5-late", drones=5, latency_s=0.3),
        FlightPlan(name="star-5-flat", drones=5, layer_m=0.0),
        FlightPlan(name="quarter-turn", turn_s=SHARP_TURN_S),
        FlightPlan(name="wind", wind=True),
        FlightPlan(name="quarter-turn-wind", turn_s=SHARP_TURN_S, wind=True),
        FlightPlan(name="ordinary-gps", receivers=3),
        FlightPlan(name="ordinary-gps-mixed", receivers=2),
        FlightPlan(name="leader-lost", drones=4, gone_s=GONE_S, ends_s=GONE_ENDS_S),
        _hovering("intruder-1", INTRUDED_ENDS_S + 8.0, intruder_m_s=1.0),
        _hovering("intruder-2", INTRUDED_ENDS_S, intruder_m_s=2.0),
        *(_hovering(f"homing-{speed}", HOMED_ENDS_S, intruder_m_s=speed, homes=True) for speed in HOMING_M_S),
        *(_hovering(f"homing-leader-{speed}", HOMED_ENDS_S, leader_homes_m_s=speed) for speed in HOMING_M_S),
        FlightPlan(name="ghosts", drones=3, ghosts=3),
        _hovering("ghosts-hover", 40.0, ghosts=3),
        _failing("drift-height-0.3-ranged", dict(FAULTS)["drift-height-0.3"], range_finders=True),
        *(_failing(name, failure) for name, failure in FAULTS),
    )
}


class Noticed(NamedTuple):
    """after_s: from the beginning of a fault until its victim held by it, inf: never; drift_m: by how much its height
    was wrong by then, of one that never noticed at the end; lowest_m: the least height of the victim."""

    after_s: float
    drift_m: float
    lowest_m: float


@dataclass(frozen=True, slots=True)
class FlownFormation:
    """One flight. slots: how they were held, while the leader flew; following: m, the errors of whoever followed
    then, and did not hold; held: share of that time in which a follower held; farthest: m, that any was off its
    slot from being engaged on; gone: where the leader vanished; noticed: by whom something broke, and what became
    of it; alarmed: share of the time since they were engaged in which those that nothing is wrong with found their
    height or their flight wrong."""

    seed: int
    slots: SlotErrors
    following: Array
    held: float
    farthest: float
    gone: LeaderGone | None = None
    noticed: Noticed | None = None
    alarmed: float = 0.0


def fly(name: str, seed: int) -> FlownFormation:
    """One flight, from its name in `FLIGHTS`."""
    plan = FLIGHTS[name]
    flight = FormationFlight(plan, seed)
    samples = flight.run()
    positions, t = np.array([sample.positions for sample in samples]), np.array([s.t for s in samples])
    team = positions[:, : plan.drones]
    beside = np.array(list(flight.slots.values()))
    slots, since_engaged = (
        _of_those_that_follow(plan, slot_errors(t, team, beside, begins, plan.gone_s))
        for begins in (DEPARTS_S, ENGAGED_S)
    )
    if plan.intruder_m_s:
        # It meets the first follower. Who has not seen it for a second, because somebody hid it, cannot keep clear.
        met = np.linalg.norm(positions[:, 1] - positions[:, plan.drones], axis=1)
        seen = np.cumsum([sample.intruder_seen for sample in samples]) > SEEN_S * COMMAND_HZ
        slots = slots._replace(nearest=min(slots.nearest, float(met[seen].min(initial=math.inf))))
    flying = (t >= DEPARTS_S) & (t < plan.gone_s)
    follows = np.array([[why is Why.FOLLOW for why in sample.whys] for sample in samples])[flying]
    returning = _returning(plan)
    if returning is not None:
        follows = np.delete(follows, returning, axis=1)
    return FlownFormation(
        seed,
        slots,
        slots.errors[follows],
        1.0 - float(follows.mean()) if follows.size else 0.0,
        float(since_engaged.errors.max(initial=0.0)),
        after_it_vanished(t, team[:, 1:], plan.gone_s) if math.isfinite(plan.gone_s) else None,
        _noticed(flight) if plan.failure is not None and plan.failure.fault in WATCHED else None,
        _alarmed(flight),
    )


def _returning(plan: FlightPlan) -> int | None:
    """Of the followers, from 0, the one that a failsafe takes home or down: it keeps no slot, and comes near to
    others."""
    failure = plan.failure
    return failure.victim - LEADER - 1 if failure is not None and failure.fault in GOING_DOWN else None


def _of_those_that_follow(plan: FlightPlan, slots: SlotErrors) -> SlotErrors:
    k = _returning(plan)
    if k is None:
        return slots
    return slots._replace(errors=np.delete(slots.errors, k, axis=1), last=np.delete(slots.last, k))


def _noticed(flight: FormationFlight) -> Noticed:
    failure = flight.plan.failure
    assert failure is not None
    why, k = WATCHED[failure.fault], failure.victim - LEADER
    t = next(
        (one.t for one in flight.samples if one.t >= failure.begins_s and one.whys[k - 1] is why), math.inf
    )
    lowest = min(-float(one.positions[k, 2]) for one in flight.samples)
    return Noticed(
        t - failure.begins_s, flight.height_drift(failure.victim, min(t, flight.plan.ends_s)), lowest
    )


def _alarmed(flight: FormationFlight) -> float:
    failure = flight.plan.failure
    wrong = failure.victim - LEADER - 1 if failure is not None and failure.fault in WATCHED else None
    whys = [
        why
        for one in flight.samples
        if one.t >= ENGAGED_S
        for k, why in enumerate(one.whys)
        if k != wrong or (failure is not None and one.t < failure.begins_s)
    ]
    return sum(why in WATCHED.values() for why in whys) / max(len(whys), 1)


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    """As far as it has come it is written after each row: hours of flights are not lost with the last of them."""
    result: dict[str, Any] = {"rows": []}
    parts = [(name, meet if name == MEETINGS else partial(fly, name)) for name in args.flights]
    flown_parts = flown(NAME, parts, range(args.seeds), processes=args.processes)
    for name, flights in zip(args.flights, flown_parts, strict=True):
        if name == MEETINGS:
            result[MEETINGS] = meetings_row(flights)
        else:
            result["rows"].append(_row(name, flights))
        report.write(args.out, NAME, result, _page(result))
    return result


def _row(name: str, flown: Sequence[FlownFormation]) -> dict[str, Any]:
    score = formation_score([flight.slots for flight in flown])
    row: dict[str, Any] = {
        "flight": name,
        "drones": FLIGHTS[name].drones,
        "runs": len(flown),
        "error_m": {"p50": score.error_p50_m, "p95": score.error_p95_m, "end_p95": score.end_p95_m},
        "error_following_p95_m": float(np.percentile(np.concatenate([one.following for one in flown]), 95)),
        "min_separation_m": score.min_separation_m,
        "runs_below_1.5_m": sum(flight.slots.nearest < NEAR_MISS_M for flight in flown),
        "runs_with_a_lost_follower": sum(bool((flight.slots.last > LOST_SLOT_M).any()) for flight in flown),
        "farthest_off_m": _middle_and_most([flight.farthest for flight in flown]),
        "held_share": float(np.mean([flight.held for flight in flown])),
        "false_alarms": float(np.mean([flight.alarmed for flight in flown])),
    }
    noticed = [flight.noticed for flight in flown if flight.noticed is not None]
    if noticed:
        row["noticed"] = {
            "never": sum(math.isinf(one.after_s) for one in noticed),
            "after_s": _middle_and_most([one.after_s for one in noticed]),
            "drift_m": _middle_and_most([one.drift_m for one in noticed]),
            "lowest_m": min(one.lowest_m for one in noticed),
        }
    gone = [flight.gone for flight in flown if flight.gone is not None]
    if gone:
        row["leader_gone"] = {
            "worst_speed_m_s_after_1_2_3_4_s": np.array([one.speeds for one in gone]).max(axis=0).tolist(),
            "flown_on_m": _middle_and_most([one.flown_on_m for one in gone]),
        }
    return row


def _middle_and_most(values: Sequence[float]) -> dict[str, float]:
    return {"p50": float(np.median(values)), "max": max(values)}


COLUMNS: report.Columns = (
    ("flight", "{flight}"),
    ("runs", "{runs}"),
    ("error p50, p95 m", "{error_m[p50]:.2f}, {error_m[p95]:.2f}"),
    ("of those that follow p95 m", "{error_following_p95_m:.2f}"),
    ("end p95 m", "{error_m[end_p95]:.2f}"),
    ("smallest separation m", "{min_separation_m:.2f}"),
    ("runs below 1.5 m", lambda row: str(row["runs_below_1.5_m"])),
    ("farthest off m, p50, max", "{farthest_off_m[p50]:.1f}, {farthest_off_m[max]:.1f}"),
    ("runs with a lost follower", "{runs_with_a_lost_follower}"),
    ("held", "{held_share:.1%}"),
    ("false alarms", "{false_alarms:.2%}"),
)
GONE = (
    "{flight}: the fastest follower after 1, 2, 3, 4 s: {speeds} m/s; flown on {leader_gone[flown_on_m][p50]:.1f} m, "
    "at most {leader_gone[flown_on_m][max]:.1f} m."
)
NOTICED = (
    "{flight}: noticed after {noticed[after_s][p50]:.1f} s, at most {noticed[after_s][max]:.1f} s{height}; never in "
    "{noticed[never]} of {runs}; lowest {noticed[lowest_m]:.1f} m."
)
HEIGHT = ", {p50:.2f} m off in height by then, at most {max:.2f} m"
MET = (
    "{runs} meetings of 2 to 5: longest wait {waited_s[max]:.1f} s, the smallest separation {min_separation_m:.2f} m; "
    "in {runs_with_one_not_arrived} somebody did not arrive."
)


def _page(result: dict[str, Any]) -> str:
    rows = result["rows"]
    lines = []
    for row in rows:
        if "leader_gone" in row:
            fastest = row["leader_gone"]["worst_speed_m_s_after_1_2_3_4_s"]
            lines.append(
                report.filled(GONE, {**row, "speeds": ", ".join(f"{speed:.2f}" for speed in fastest)})
            )
    for row in rows:
        if "noticed" in row:
            drift = row["noticed"]["drift_m"]
            lines.append(
                report.filled(
                    NOTICED, {**row, "height": report.filled(HEIGHT, drift) if drift["max"] else ""}
                )
            )
    if MEETINGS in result:
        lines.append(report.filled(MET, result[MEETINGS]))
    return report.page("# Formation by sight", report.table_of(COLUMNS, rows), *lines)


BENCH = Benchmark(
    NAME,
    _measured,
    _page,
    options=(seeds(100, quick=2), PROCESSES, some_of("--flights", [*FLIGHTS, MEETINGS])),
)
add_arguments, run = BENCH.add_arguments, BENCH.run
