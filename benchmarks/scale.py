"""What a scan costs in teams of 3 to 100: real `Onboard`s of all drones in one process, processor time by rooms.

The scenario is `thirty` with that many drones: all stand on a circle and look across it. All announce and report, and
receive what a drone of such a team receives, by `virtual_swarm`. In large teams only some of them, evenly spread, are
shown a picture; the others' are empty, so that a flight of a hundred takes minutes and not hours. Scans of the first
seconds, in which everybody is new, count apart. Transports with as many drones are those of `swarmtrack bench clients`.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark, amount, flag, option, several
from swarmtrack.benchmarks.identity.recognition import SwarmJudge
from swarmtrack.benchmarks.processes import rss_mb
from swarmtrack.benchmarks.virtual_swarm import LEAD_S, AllReports, Exposure, VirtualSwarm, oracle_eyes
from swarmtrack.cameras.rig import Rig
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.messages import Detections
from swarmtrack.onboard import Onboard
from swarmtrack.relative.metres import Metres
from swarmtrack.team.identities import Identities

NAME = "scale"
SCENARIO = "thirty"
TEAMS = (3, 10, 30, 100)
SECONDS, QUICK_SECONDS = 10.0, 5.0
# s from take-off: before, everybody is new.
START_S = 3.0
MOST_SEEING = 10
BUDGET_MS = 25.0
# By room, what of it is timed; a room's time is without that of rooms within it.
REPORTS = "reports heard"
ROOMS: tuple[tuple[str, type, tuple[str, ...]], ...] = (
    ("the rest", Onboard, ("_track",)),
    ("tracker", Rig, ("update", "tracks")),
    ("names", Identities, ("observe",)),
    ("metres", Metres, ("observe",)),
    (REPORTS, Identities, ("on_report",)),
    (REPORTS, Onboard, ("_compare",)),
)


class Stopwatch:
    """Processor time of the drones `seeing`. scans: (t [s], ms); rooms: ms from START_S on, by room; reports: how many
    were heard, by anybody, in how many ms."""

    def __init__(self, seeing: Collection[int]) -> None:
        self.scans: list[tuple[float, float]] = []
        self.rooms: defaultdict[str, float] = defaultdict(float)
        self.reports = 0
        self._seeing = seeing
        self._inside = [0.0]
        self._counts = False

    @contextmanager
    def installed(self) -> Iterator[None]:
        kept = [(owner, name, getattr(owner, name)) for _, owner, names in ROOMS for name in names]
        for (room, _, _), (owner, name, method) in zip(
            [row for row in ROOMS for _ in row[2]], kept, strict=True
        ):
            setattr(owner, name, self._timed(room, method, is_scan=name == "_track"))
        try:
            yield
        finally:
            for owner, name, method in kept:
                setattr(owner, name, method)

    def _timed(self, room: str, method: Callable[..., Any], *, is_scan: bool) -> Callable[..., Any]:
        def timed(*args: Any) -> Any:
            if is_scan:
                sees = args[0]._drone_id in self._seeing
                self._counts = sees and args[-1] >= START_S
            self._inside.append(0.0)
            began = time.thread_time()
            found = method(*args)
            spent = 1e3 * (time.thread_time() - began)
            within = self._inside.pop()
            self._inside[-1] += spent
            if room == REPORTS:
                self.reports += not is_scan and method.__name__ == "_compare"
                self.rooms[room] += spent
            elif self._counts:
                self.rooms[room] += spent - within
            if is_scan and sees:
                self.scans.append((args[-1], spent))
            return found

        return timed


def measure(
    drones: int, seconds: float, *, scenario: str = SCENARIO, all_reports: bool = False, seed: int = 1
) -> dict[str, Any]:
    """One flight. all_reports: everybody receives those of the whole team."""
    flown = load_scenario(scenario, seed=seed, drones=drones)
    seeing = frozenset(flown.members[:: max(1, drones // MOST_SEEING)][:MOST_SEEING])
    oracle = oracle_eyes(flown)

    def eyes(seen: Exposure) -> Detections:
        if seen.drone_id in seeing:
            return oracle(seen)
        return Detections(seen.stamp, seen.sequence, np.empty((0, 2)), np.empty((0, 2)), np.empty(0))

    before, watch = rss_mb(), Stopwatch(seeing)
    swarm = (AllReports if all_reports else VirtualSwarm)(flown, eyes=eyes)
    judge = SwarmJudge(swarm, flown, seconds)
    tracks = []
    with watch.installed():
        for scan in swarm.fly(seconds):
            if scan.observer not in seeing:
                continue
            judge.add_scan(scan, scan.t)
            if scan.t >= START_S:
                tracks.append(len(scan.tracks.tracks))
    heard = float(np.mean([swarm.received(drone) for drone in flown.members]))
    return _summary(watch, judge, tracks, drones) | {
        "mb_per_drone": (rss_mb() - before) / drones,
        "reports_hz": heard / (seconds + LEAD_S),
    }


def _summary(watch: Stopwatch, judge: SwarmJudge, tracks: list[int], drones: int) -> dict[str, Any]:
    t, ms = np.array(watch.scans).T
    late, score = ms[t >= START_S], judge.scorer.score()
    reports_ms = watch.rooms.pop(REPORTS, 0.0)
    return {
        "drones": drones,
        "tracks": float(np.mean(tracks)),
        "scan_ms": float(late.mean()),
        "scan_p95_ms": float(np.percentile(late, 95)),
        "start_ms": float(ms[t < START_S].mean()),
        "rooms_ms": {room: spent / len(late) for room, spent in watch.rooms.items()},
        "report_us": 1e3 * reports_ms / max(1, watch.reports),
        "correct": score.correct,
        "wrong": score.wrong,
        "unknown": score.unknown,
    }


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    seconds, rows = args.seconds, []
    with report.progress(NAME, total=len(args.drones)) as advance:
        for drones in args.drones:
            advance(f"{drones} drones")
            rows.append(measure(int(drones), seconds, scenario=args.scenario, all_reports=args.all_reports))
    return {"scenario": args.scenario, "seconds": seconds, "teams": rows}


COLUMNS: report.Columns = (
    ("drones", "{drones}"),
    ("tracks", "{tracks:.1f}"),
    ("scan, ms", "{scan_ms:.1f}"),
    ("p95", "{scan_p95_ms:.1f}"),
    ("at the start", "{start_ms:.1f}"),
    *((f"{room}, ms", f"{{rooms_ms[{room}]:.1f}}") for room in ("names", "metres", "tracker", "the rest")),
    ("a report heard, µs", "{report_us:.0f}"),
    ("reports per s", "{reports_hz:.0f}"),
    ("MB per drone", "{mb_per_drone:.1f}"),
    *(
        (f"{share}, %", lambda row, share=share: f"{100.0 * row[share]:.2f}")
        for share in ("correct", "wrong", "unknown")
    ),
)
BENCH = Benchmark(
    NAME,
    _measured,
    lambda result: report.page(
        "# Teams of many",
        "All drones' real `Onboard`s in one process; processor time per scan of a drone that sees, from 3 s on.",
        report.table_of(COLUMNS, result["teams"]),
    ),
    options=(
        several("--drones", "in the team (default: %(default)s)", TEAMS),
        option("--scenario", "name or file (default: %(default)s)", default=SCENARIO, metavar="NAME"),
        flag("--all-reports", "every drone receives the reports of the whole team"),
        amount("--seconds", SECONDS, QUICK_SECONDS, "of flight", type=float, metavar="S"),
    ),
)
