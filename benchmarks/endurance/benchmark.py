"""Half an hour in the air: does anything grow, fall behind or get lost (docs/swarm.md)?

From the fifth minute on (of a short flight: after a fifth of it) no process may grow by more than 5 %, no event loop be
100 ms late, no IMU sample be lost, and no rate be more than 5 % off its median in any window. The process that judges
the flight keeps all of it and grows by that; it is shown, and not held to it.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from swarmtrack.arguments import positive
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.endurance import flight, verdict
from swarmtrack.benchmarks.endurance.plot import draw
from swarmtrack.benchmarks.endurance.verdict import JUDGE, Claim, Window
from swarmtrack.benchmarks.harness import TRACKER, Benchmark, amount

NAME = "endurance"
WINDOW_S, MIN_WINDOWS = 10.0, 10  # a window is shorter where the flight would not have so many
DRONES = 3
AFTER_S = 2.0  # that the swarm flies longer than is measured: nobody is measured while it ends


@dataclass(frozen=True, slots=True)
class Found:
    """What a flight left: its windows, from when on they are judged, the size of its recording [10⁶ bytes] and the
    verdict of `swarmtrack sim`."""

    windows: list[Window]
    settled_s: float
    recorded_mb: float
    flown: Mapping[str, Any]

    @property
    def judged(self) -> list[Window]:
        return verdict.judged(self.windows, self.settled_s)


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    """Fly; endurance.png into `args.out`, too."""
    seconds = 60.0 * args.minutes
    window_s = min(WINDOW_S, seconds / MIN_WINDOWS)
    with report.progress(NAME, round(seconds / window_s)) as advance:

        def tell(window: Window) -> None:
            """What is worst in it."""
            lag = max((agent.lag_max_s for agent in window.agents.values()), default=math.nan)
            size = max(size for name, size in window.rss_mb.items() if name.startswith("drone"))
            advance(f"agents {size:.0f} MB, loop {1e3 * lag:.0f} ms late at most")

        found = asyncio.run(_fly(args.out, seconds, window_s, args.tracker, tell))
    draw(args.out / f"{NAME}.png", found.windows, found.settled_s)
    return {"seconds": seconds, "window_s": window_s, "tracker": args.tracker, "found": found}


async def _fly(
    out: Path, seconds: float, window_s: float, tracker: str, on_window: Callable[[Window], None]
) -> Found:
    # Beside the results, not in /tmp: that may be memory, and a long recording would be some of it.
    with tempfile.TemporaryDirectory(prefix=f"{NAME}-", dir=out) as name:
        folder = Path(name)
        async with flight.flying(folder, seconds + AFTER_S, tracker) as swarm:
            await flight.until_standing(swarm, folder, DRONES)
            windows = await flight.measure(swarm, seconds + 0.5 * AFTER_S, window_s, on_window)
            flown = await flight.landed(swarm, folder)
        files = [file for file in (folder / flight.RECORDING).rglob("*") if file.is_file()]
        recorded_mb = 1e-6 * sum(file.stat().st_size for file in files)
    return Found(windows, verdict.settled_s(seconds), recorded_mb, flown)


def _record(measured: dict[str, Any]) -> dict[str, Any]:
    found: Found = measured["found"]
    claims = verdict.judge(found.judged)
    return {
        **{name: value for name, value in measured.items() if name != "found"},
        "settled_s": found.settled_s,
        "ok": bool(claims) and all(claim.ok for claim in claims),
        "claims": [claim._asdict() for claim in claims],
        "recorded_mb": found.recorded_mb,
        "sim": found.flown,
        "windows": [_window(window) for window in found.windows],
    }


def _window(window: Window) -> dict[str, Any]:
    return {
        **{field.name: getattr(window, field.name) for field in fields(window)},
        "agents": {str(drone_id): agent._asdict() for drone_id, agent in window.agents.items()},
        "viewer": window.viewer._asdict(),
    }


# --- for people --------------------------------------------------------------------------------------


CLAIM_COLUMNS: report.Columns = (
    ("what", "{what}"),
    ("who", "{who}"),
    ("found", lambda claim: f"{report.number(claim.found, 1 if claim.unit else 0)}{_unit(claim)}"),
    ("at most", lambda claim: f"{claim.limit:g}{_unit(claim)}"),
    ("", lambda claim: report.verdict(claim.ok)),
)
PROCESS_COLUMNS: report.Columns = (
    ("process", "{name}"),
    ("memory settled → end, MB", "{sizes[0]:.1f} → {sizes[1]:.1f}"),
    ("grown", "{grown:+.1p} %"),
    ("CPU, % of a core: mean", "{cpu:.1f}"),
    ("busiest window", "{busiest:.1f}"),
)
AGENT_COLUMNS: report.Columns = (
    ("agent", "{name}"),
    *((f"{name if name != 'imu' else 'IMU'}, Hz", f"{{{name}:.1f}}") for name in verdict.RATES),
    ("IMU samples", "{imu_samples}"),
    ("expected by the rate", "{imu_expected:.0f}"),
    ("lost", "{imu_lost}"),
    ("gaps", "{imu_gaps}"),
    ("lag: median of p95, ms", "{lag_p95_s:.1m}"),
    ("largest, ms", "{lag_max_s:.1m}"),
    ("frames dropped", "{frames_dropped}"),
    ("recorded", "{recorded}"),
    ("not recorded", "{unrecorded}"),
)


def _unit(claim: Claim) -> str:
    return f" {claim.unit}" if claim.unit else ""


def _page(measured: dict[str, Any]) -> str:
    found: Found = measured["found"]
    windows = found.judged
    claims = verdict.judge(windows)
    broken = [claim for claim in claims if not claim.ok]
    sim = "passed" if found.flown["passed"] else f"failed ({'; '.join(found.flown['shortfalls'])})"
    agents = sorted({drone_id for window in windows for drone_id in window.agents})
    return report.page(
        "# Endurance",
        f"{DRONES} drones of `{flight.SCENARIO}`, `--detector oracle`, tracker `{measured['tracker']}`, monitor with"
        f" one viewer, recording; {measured['seconds'] / 60.0:g} min in windows of {measured['window_s']:g} s, judged"
        f" from {found.settled_s:g} s on.",
        f"**{_sentence(claims, broken)}**",
        report.table_of(CLAIM_COLUMNS, _worst(claims, broken)),
        "Of each process, over the judged time:",
        report.table_of(PROCESS_COLUMNS, [_process(windows, name) for name in verdict.processes(windows)]),
        f"`{JUDGE}` is `swarmtrack sim` itself, which keeps what it heard until it has judged it."
        f" Whatever else ran on the machine took {_mean([w.elsewhere_percent for w in windows]):.0f} % of a core.",
        "Of each agent, over the judged time; lag is of the event loop, looked at twenty times a second:",
        report.table_of(AGENT_COLUMNS, [_agent(windows, drone_id) for drone_id in agents]),
        _viewer(windows),
        f"Recording: {found.recorded_mb:.0f} MB. Verdict of `swarmtrack sim`: {sim}.",
        f"![memory, lag and rates over time]({NAME}.png)",
    )


def _sentence(claims: Sequence[Claim], broken: Sequence[Claim]) -> str:
    if not claims:
        return "Nothing to judge: no window was measured."
    return f"{len(broken)} of {len(claims)} claims fail." if broken else f"All {len(claims)} claims hold."


def _worst(claims: Sequence[Claim], broken: Sequence[Claim]) -> list[Claim]:
    """Of every kind the claim that is nearest to failing, and all that fail."""
    kinds = dict.fromkeys(claim.what for claim in claims)
    nearest = [
        max((c for c in claims if c.what == kind), key=lambda c: (not c.ok, c.found)) for kind in kinds
    ]
    return [claim for claim in claims if claim in nearest or claim in broken]


def _process(windows: Sequence[Window], name: str) -> dict[str, Any]:
    sizes = [window.rss_mb[name] for window in windows]
    cpu = [window.cpu_percent[name] for window in windows]
    grown = verdict.growth(windows, name)
    return {
        "name": name,
        "sizes": (sizes[0], sizes[-1]),
        "grown": grown,
        "cpu": _mean(cpu),
        "busiest": max(cpu),
    }


def _agent(windows: Sequence[Window], drone_id: int) -> dict[str, Any]:
    agents = [window.agents[drone_id] for window in windows if drone_id in window.agents]
    counted = (
        "imu_samples", "imu_expected", "imu_lost", "imu_gaps", "frames_dropped", "recorded", "unrecorded"
    )  # fmt: skip
    return {
        "name": f"drone {drone_id}",
        **{name: _mean([agent.rates_hz[name] for agent in agents]) for name in verdict.RATES},
        **{name: sum(getattr(agent, name) for agent in agents) for name in counted},
        "lag_p95_s": sorted(agent.lag_p95_s for agent in agents)[len(agents) // 2],
        "lag_max_s": max(agent.lag_max_s for agent in agents),
    }


def _viewer(windows: Sequence[Window]) -> str:
    if not windows:
        return ""
    states, views, kilobytes, waits = zip(*(window.viewer for window in windows), strict=True)
    return (
        f"Viewer: {_mean(states):.2f} states and {_mean(views):.1f} views a second ({_mean(kilobytes):.0f} kB/s; views"
        " of a swarm that detects by itself have boxes and no picture); at most"
        f" {max(waits):.2f} s without a state."
    )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan


BENCH = Benchmark(
    NAME,
    _measured,
    _page,
    options=(TRACKER, amount("--minutes", 30.0, 0.5, "of flight", type=positive, metavar="M")),
    record=_record,
    draws=True,
)
