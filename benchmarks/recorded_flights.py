"""What a recording is worth: how much a killed agent loses of it, and how fast it is flown again, bit for bit.

Lost is what lies between SIGKILL and the last record that can be read. Times of replays are those of the whole command,
from its start to its end (docs/recording.md).
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark
from swarmtrack.benchmarks.lone_agent import scripted_agent
from swarmtrack.benchmarks.processes import our_command
from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.recording.reader import files_below, recordings_below
from swarmtrack.recording.repair import repair

NAME = "recording"
KILLS, QUICK_KILLS = 10, 2
FLIGHT_S, QUICK_FLIGHT_S = 60.0, 10.0
TURNS = 3  # of each replay; told is the median
SEED = 11
REPLAYED = {
    "one drone": ["drone-1"],
    "three drones": ["drone-*"],
    "three with their verdict": ["drone-*", "swarm"],
}
LOST_MOST_S, SPEED_LEAST = 1.0, 20.0


class Killed(NamedTuple):
    """flown_s: after its first track; lost_s: of the recording's end; readable: every file, after `log repair`."""

    flown_s: float
    lost_s: float
    readable: bool


class Replays(NamedTuple):
    """what: was flown again; seconds: of the command; exact: all of it, bit for bit."""

    what: str
    flight_s: float
    seconds: list[float]
    exact: bool

    @property
    def speed(self) -> float:
        return self.flight_s / statistics.median(self.seconds)


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    """Fly, kill, replay."""
    kills = QUICK_KILLS if args.quick else KILLS
    rng = np.random.default_rng(SEED)
    with tempfile.TemporaryDirectory(prefix=f"{NAME}-") as name:
        folder = Path(name)
        with report.progress(NAME, kills + 1 + len(REPLAYED)) as advance:
            killed = []
            for k in range(kills):
                advance(f"kill -9, {k + 1} of {kills}")
                killed.append(asyncio.run(_kill(folder / f"killed-{k}", rng.uniform(1.0, 6.0))))
            replays = _replays(folder / "flight", QUICK_FLIGHT_S if args.quick else FLIGHT_S, advance)
    return {
        "killed": [one._asdict() for one in killed],
        "replays": [{**one._asdict(), "speed": one.speed} for one in replays],
    }


async def _kill(folder: Path, seconds: float) -> Killed:
    """An agent that records into `folder` is ended `seconds` after its first track."""
    async with scripted_agent(entries={"recording.dir": str(folder)}) as agent:
        await asyncio.sleep(seconds)
        agent.process.kill()
        at = time.time()
        agent.process.wait()
    for file in files_below(folder):
        repair(file)
    (recording,) = recordings_below(folder)
    last = max(message.log_time_ns for message in recording.messages())
    return Killed(seconds, at - 1e-9 * last, not recording.damage)


def _replays(folder: Path, seconds: float, advance: Callable[[str], None]) -> list[Replays]:
    advance("sim --record")
    flown = our_command("sim", "--detector", "oracle", "--seconds", str(seconds), "--record", str(folder))
    if not folder.is_dir():
        raise BenchmarkError(f"{NAME}: `swarmtrack sim --record` left no recording:\n{flown}")
    found = []
    for what, parts in REPLAYED.items():
        advance(f"replay of {what}")
        paths = [str(path) for part in parts for path in sorted(folder.glob(part))]
        answer = folder.parent / "replay.json"
        times = []
        for _ in range(TURNS):
            began = time.monotonic()
            said = our_command("replay", *paths, "--json", str(answer))
            times.append(time.monotonic() - began)
            if not answer.is_file():
                raise BenchmarkError(f"{NAME}: `swarmtrack replay` wrote no result:\n{said}")
        drones = json.loads(answer.read_text(encoding="utf-8"))["drones"]
        answer.unlink()
        shortest = min(drone["flight_s"] for drone in drones)
        found.append(Replays(what, shortest, times, all(drone["exact"] for drone in drones)))
    return found


COLUMNS: report.Columns = (
    ("replayed", "{what}"),
    ("flight, s", "{flight_s:.1f}"),
    (
        "took, s",
        lambda row: (
            f"{statistics.median(row['seconds']):.2f} ({min(row['seconds']):.2f} to {max(row['seconds']):.2f})"
        ),
    ),
    ("times real time", "{speed:.1f}"),
    ("bit for bit", lambda row: "yes" if row["exact"] else "**no**"),
)


def _page(result: dict[str, Any]) -> str:
    lost = [one["lost_s"] for one in result["killed"]]
    readable = sum(one["readable"] for one in result["killed"])
    return report.page(
        "# Recording and replay",
        f"SIGKILL at {len(lost)} moments: {min(lost):.2f} to {max(lost):.2f} s lost (median "
        f"{statistics.median(lost):.2f}; at most {LOST_MOST_S:g} is wanted), {readable} of {len(lost)} "
        "recordings readable to the end after `swarmtrack log repair`.",
        f"`swarmtrack replay`, the whole command, median of {TURNS} ({SPEED_LEAST:g} times real time are wanted):",
        report.table_of(COLUMNS, result["replays"]),
    )


BENCH = Benchmark(NAME, _measured, _page)
