"""Half an hour in the air: does anything grow, fall behind or get lost?

    swarmtrack bench endurance --minutes 30 --out DIR

`swarmtrack sim` flies three drones that look at each other, with monitor and recording and with a viewer who looks at
all of them. Every ten seconds every process' memory and CPU are read, and with them what the agents say of themselves:
how late their event loops were, how many IMU samples came and how many should have, how often they saw and spoke.

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swarmtrack.arguments import positive
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_common, add_tracker
from swarmtrack.benchmarks.endurance import flight, verdict
from swarmtrack.benchmarks.endurance.plot import draw
from swarmtrack.benchmarks.endurance.verdict import JUDGE, Claim, Window

NAME = "endurance"
MINUTES, QUICK_MINUTES = 30.0, 0.5
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    add_tracker(parser)
    parser.add_argument(
        "--minutes",
        type=positive,
        metavar="M",
        help=f"of flight (default: {MINUTES:g}; with --quick {QUICK_MINUTES:g})",
    )


def run(args: argparse.Namespace) -> None:
    usual = QUICK_MINUTES if args.quick else MINUTES
    publish(args.out, minutes=args.minutes or usual, tracker=args.tracker)


def publish(out: Path, *, minutes: float, tracker: str) -> dict[str, Any]:
    """Fly, write endurance.json, endurance.md and endurance.png into `out`, and return what is in the JSON."""
    report.pyplot()  # now, not when half an hour of results cannot be drawn
    seconds = 60.0 * minutes
    window_s = min(WINDOW_S, seconds / MIN_WINDOWS)
    with report.progress(NAME, round(seconds / window_s)) as advance:
        found = asyncio.run(_fly(out, seconds, window_s, tracker, _teller(advance)))
    claims = verdict.judge(found.judged)
    result = {
        "seconds": seconds,
        "window_s": window_s,
        "settled_s": found.settled_s,
        "tracker": tracker,
        "ok": bool(claims) and all(claim.ok for claim in claims),
        "claims": [claim._asdict() for claim in claims],
        "recorded_mb": found.recorded_mb,
        "sim": found.flown,
        "windows": [_record(window) for window in found.windows],
    }
    draw(out / f"{NAME}.png", found.windows, found.settled_s)
    report.write(out, NAME, result, _markdown(found, claims, seconds, window_s, tracker))
    return result


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
        recorded = sum(
            file.stat().st_size for file in (folder / flight.RECORDING).rglob("*") if file.is_file()
        )
    return Found(windows, verdict.settled_s(seconds), 1e-6 * recorded, flown)


def _teller(advance: Callable[[str], None]) -> Callable[[Window], None]:
    """Advances the line of progress, with what is worst in the window."""

    def tell(window: Window) -> None:
        lag = max((agent.lag_max_s for agent in window.agents.values()), default=math.nan)
        agents = [size for name, size in window.rss_mb.items() if name.startswith("drone")]
        advance(f"agents {max(agents):.0f} MB, loop {1e3 * lag:.0f} ms late at most")

    return tell


def _record(window: Window) -> dict[str, Any]:
    return {
        "t_s": window.t_s,
        "seconds": window.seconds,
        "rss_mb": dict(window.rss_mb),
        "cpu_percent": dict(window.cpu_percent),
        "elsewhere_percent": window.elsewhere_percent,
        "agents": {str(drone_id): agent._asdict() for drone_id, agent in window.agents.items()},
        "viewer": window.viewer._asdict(),
    }


# --- for people --------------------------------------------------------------------------------------


def _markdown(found: Found, claims: Sequence[Claim], seconds: float, window_s: float, tracker: str) -> str:
    windows = found.judged
    broken = [claim for claim in claims if not claim.ok]
    sim = "passed" if found.flown["passed"] else f"failed ({'; '.join(found.flown['shortfalls'])})"
    return "\n\n".join(
        [
            "# Endurance",
            f"{DRONES} drones of `{flight.SCENARIO}`, `--detector oracle`, tracker `{tracker}`, monitor with one"
            f" viewer, recording; {seconds / 60.0:g} min in windows of {window_s:g} s, judged from"
            f" {found.settled_s:g} s on.",
            f"**{_sentence(claims, broken)}**",
            report.table(["what", "who", "found", "at most", ""], [_claim(claim) for claim in _worst(claims, broken)]),
            "Of each process, over the judged time:",
            report.table(
                ["process", "memory settled → end, MB", "grown", "CPU, % of a core: mean", "busiest window"],
                [_process(windows, name) for name in verdict.processes(windows)],
            ),
            f"`{JUDGE}` is `swarmtrack sim` itself, which keeps what it heard until it has judged it."
            f" Whatever else ran on the machine took {_mean([w.elsewhere_percent for w in windows]):.0f} % of a core.",
            "Of each agent, over the judged time; lag is of the event loop, looked at twenty times a second:",
            report.table(
                [
                    "agent", "tracks, Hz", "detections, Hz", "IMU, Hz", "IMU samples", "expected by the rate", "lost",
                    "gaps", "lag: median of p95, ms", "largest, ms", "frames dropped", "recorded", "not recorded",
                ],
                [_agent(windows, drone_id) for drone_id in sorted({i for w in windows for i in w.agents})],
            ),
            _viewer(windows),
            f"Recording: {found.recorded_mb:.0f} MB. Verdict of `swarmtrack sim`: {sim}.",
            f"![memory, lag and rates over time]({NAME}.png)",
        ]
    )  # fmt: skip


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


def _claim(claim: Claim) -> list[str]:
    unit = f" {claim.unit}" if claim.unit else ""
    return [
        claim.what,
        claim.who,
        f"{report.number(claim.found, 1 if claim.unit else 0)}{unit}",
        f"{claim.limit:g}{unit}",
        "holds" if claim.ok else "**fails**",
    ]


def _process(windows: Sequence[Window], name: str) -> list[str]:
    sizes = [window.rss_mb[name] for window in windows]
    cpu = [window.cpu_percent[name] for window in windows]
    return [
        name,
        f"{sizes[0]:.1f} → {sizes[-1]:.1f}",
        f"{100.0 * verdict.growth(windows, name):+.1f} %",
        f"{_mean(cpu):.1f}",
        f"{max(cpu):.1f}",
    ]


def _agent(windows: Sequence[Window], drone_id: int) -> list[str]:
    agents = [window.agents[drone_id] for window in windows if drone_id in window.agents]
    lags = sorted(agent.lag_p95_s for agent in agents)
    return [
        f"drone {drone_id}",
        *(report.number(_mean([agent.rates_hz[name] for agent in agents]), 1) for name in verdict.RATES),
        str(sum(agent.imu_samples for agent in agents)),
        report.number(sum(agent.imu_expected for agent in agents), 0),
        str(sum(agent.imu_lost for agent in agents)),
        str(sum(agent.imu_gaps for agent in agents)),
        report.number(1e3 * lags[len(lags) // 2], 1),
        report.number(1e3 * max(agent.lag_max_s for agent in agents), 1),
        str(sum(agent.frames_dropped for agent in agents)),
        str(sum(agent.recorded for agent in agents)),
        str(sum(agent.unrecorded for agent in agents)),
    ]


def _viewer(windows: Sequence[Window]) -> str:
    if not windows:
        return ""
    viewers = [window.viewer for window in windows]
    return (
        f"Viewer: {_mean([v.states_hz for v in viewers]):.2f} states and {_mean([v.views_hz for v in viewers]):.1f}"
        f" views a second ({_mean([v.kilobytes_per_s for v in viewers]):.0f} kB/s; views of a swarm that detects by"
        f" itself have boxes and no picture); at most {max(v.longest_wait_s for v in viewers):.2f} s without a state."
    )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan
