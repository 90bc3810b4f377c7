"""The command that a newcomer runs first: its verdicts, its time, and what it costs (docs/swarm.md).

Each run is a process of its own, with a mark in its environment by which every process that it starts is found. CPU
time is counted in flight (between the first and the last line with a world time) and from the start to the end. The
processes of `--busy` are of the same session: to Linux, others as a whole would get no more than this one.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import secrets
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark, amount, option, scenarios
from swarmtrack.benchmarks.processes import OURS, cpu_seconds, module_process
from swarmtrack.benchmarks.report import BenchmarkError

NAME = "first-command"
SCENARIOS = ("hover-triangle", "formation-3", "crossing")
STOP_S = 20.0  # s that a flight which is broken off has to end
LOOK_S = 0.2  # s between two looks at what the processes have used
IN_FLIGHT = re.compile(r"^ *\d+ s  ")
# What the command line of each kind of process holds, the first that fits.
KINDS = {
    "agents": "swarmtrack.agents.vehicle",
    "guards": "swarmtrack/guard.py",
    "simulator": "swarmtrack.agents.simulator",
    "judge": "swarmtrack.agents.main",
}
MARK = "SWARMTRACK_FIRST_COMMAND"
RECORDED = ("code", "words", "took_s", "cores", "whole_cores", "figures")
"""Of each run, beside its summary."""
MOST_CORES = 1.2  # in flight, of all processes together: the claim


@dataclass(slots=True)
class Usage:
    """CPU seconds of the processes that have a mark in their environment, by kind."""

    mark: bytes
    kinds: dict[int, str] = field(default_factory=dict)
    seconds: dict[int, float] = field(default_factory=dict)
    strangers: set[str] = field(default_factory=set)

    def sample(self) -> None:
        """What they have used by now; who has ended keeps what was last seen."""
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit() or entry.name in self.strangers:
                continue
            pid = int(entry.name)
            with suppress(OSError):
                if pid not in self.kinds:
                    environ = (entry / "environ").read_bytes()
                    if self.mark not in environ:
                        if environ:  # empty, it may just be about to become a program
                            self.strangers.add(entry.name)
                        continue
                if self.kinds.get(pid) in (None, "others"):  # it may just be about to become another program
                    self.kinds[pid] = _kind((entry / "cmdline").read_bytes())
                self.seconds[pid] = cpu_seconds(pid)

    def by_kind(self) -> dict[str, float]:
        """Of all that were ever seen."""
        found: dict[str, float] = defaultdict(float)
        for pid, seconds in self.seconds.items():
            found[self.kinds[pid]] += seconds
        return found


def _kind(cmdline: bytes) -> str:
    words = cmdline.replace(b"\0", b" ").decode(errors="replace")
    return next((kind for kind, part in KINDS.items() if part in words), "others")


@dataclass(frozen=True, slots=True)
class Run:
    """One run. code: its exit code; words: its verdict's first line; figures: its JSON; took_s: from start to end;
    silent_s: longest time without a line; flown_s: between the first and last line of the flight; cores: used in
    flight, by kind of process; whole_cores: by all of them, from start to end."""

    code: int
    words: str
    figures: Mapping[str, Any]
    took_s: float
    silent_s: float
    flown_s: float
    cores: Mapping[str, float]
    whole_cores: float

    @property
    def passed(self) -> bool:
        return self.code == 0


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    found = asyncio.run(_run_all(args))
    return {
        "busy": args.busy,
        "words": list(args.words),
        "scenarios": {name: _summary(many) for name, many in found.items()},
        "runs": {
            name: [{of: getattr(one, of) for of in RECORDED} for one in many] for name, many in found.items()
        },
    }


async def _run_all(args: argparse.Namespace) -> dict[str, list[Run]]:
    found: dict[str, list[Run]] = {name: [] for name in args.scenarios}
    with report.progress(NAME, len(found) * args.runs) as advance:
        async with others_busy(args.busy):
            for name, runs in found.items():
                for _ in range(args.runs):
                    runs.append(await fly_once(name, *args.words))
                    advance(f"{name}: {runs[-1].words}")
    return found


@asynccontextmanager
async def others_busy(many: int) -> AsyncIterator[list[asyncio.subprocess.Process]]:
    """So many processes of no use, each of which would like a whole core."""
    loop = "while True: pass"
    processes = [await asyncio.create_subprocess_exec(sys.executable, "-c", loop) for _ in range(many)]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            await process.wait()


async def fly_once(scenario: str, *words: str) -> Run:
    """`swarmtrack sim` with this scenario, and what came of it."""
    with tempfile.TemporaryDirectory() as folder:
        figures = Path(folder) / "verdict.json"
        began, mark = time.monotonic(), secrets.token_hex(8)
        words = (OURS, "sim", scenario, "--json", str(figures), *words)
        async with module_process(
            *words, stderr=asyncio.subprocess.STDOUT, environment={MARK: mark}, patience_s=STOP_S
        ) as process:
            usage = Usage(f"{MARK}={mark}".encode())
            watching = asyncio.create_task(_watch(usage))
            heard = _Heard(usage, began)
            try:
                assert process.stdout is not None
                async for line in process.stdout:
                    heard.line(line.decode(errors="replace").rstrip())
                code = await process.wait()
            finally:
                watching.cancel()
                await asyncio.gather(watching, return_exceptions=True)
        if not figures.exists():
            raise BenchmarkError(f"swarmtrack sim {scenario} ended with {code}:\n{heard.last}")
        took = time.monotonic() - began
        told, whole = json.loads(figures.read_text(encoding="utf-8")), sum(usage.by_kind().values()) / took
        return Run(code, heard.verdict, told, took, heard.silent_s, heard.flown_s, heard.cores, whole)


async def _watch(usage: Usage) -> None:
    while True:
        usage.sample()
        await asyncio.sleep(LOOK_S)


class _Heard:
    """What a run prints, and what was used by then."""

    def __init__(self, usage: Usage, began: float) -> None:
        self.verdict = ""
        self.last = ""
        self.silent_s = 0.0
        self._usage = usage
        self._newest = began
        self._span: list[tuple[float, dict[str, float]]] = []

    def line(self, text: str) -> None:
        now = time.monotonic()
        self.silent_s, self._newest = max(self.silent_s, now - self._newest), now
        self.last = text or self.last
        if IN_FLIGHT.match(text):
            self._usage.sample()
            self._span = [*self._span[:1], (now, self._usage.by_kind())]
        elif text.startswith(("PASSED", "FAILED", "NOT JUDGED")):
            self.verdict = text

    @property
    def flown_s(self) -> float:
        return self._span[-1][0] - self._span[0][0] if self._span else 0.0

    @property
    def cores(self) -> dict[str, float]:
        if self.flown_s <= 0.0:
            return {}
        (_, before), (_, after) = self._span
        return {kind: (after[kind] - before.get(kind, 0.0)) / self.flown_s for kind in after}


def _summary(many: Sequence[Run]) -> dict[str, Any]:
    by_run = [one.figures["tracking"]["rmse_px"].values() for one in many]
    rmse = [max((x for x in values if x is not None), default=np.nan) for values in by_run]
    kinds = sorted({kind for one in many for kind in one.cores})
    cores = [sum(one.cores.values()) for one in many]
    took = [one.took_s for one in many]
    return {
        "runs": len(many),
        "passed": sum(one.passed for one in many),
        "verdicts": Counter(one.words for one in many),
        "cores": {"mean": float(np.mean(cores)), "max": max(cores)},
        "whole_cores": float(np.mean([one.whole_cores for one in many])),
        "cores_by_kind": {kind: float(np.mean([one.cores.get(kind, 0.0) for one in many])) for kind in kinds},
        "took_s": {"mean": float(np.mean(took)), "max": max(took)},
        "silent_s": max(one.silent_s for one in many),
        "rmse_px": {"p50": float(np.median(rmse)), "max": max(rmse)},
        "range_error": max(one.figures["relative"]["range_error"]["p95"] or np.nan for one in many),
        "correct": min(one.figures["identity"]["correct"] or 0.0 for one in many),
        "wrong": max(one.figures["identity"]["wrong"] or 0.0 for one in many),
        "ok": all(one.passed for one in many) and max(cores) <= MOST_CORES,
    }


COLUMNS: report.Columns = (
    ("scenario", "{name}"),
    ("passed", "{passed} of {runs}"),
    ("cores in flight, mean, max", "{cores[mean]:.2f}, {cores[max]:.2f}"),
    ("from start to end", "{whole_cores:.2f}"),
    ("took s, mean, max", "{took_s[mean]:.1f}, {took_s[max]:.1f}"),
    ("longest silence s", "{silent_s:.1f}"),
    ("worst RMSE px, p50, max", "{rmse_px[p50]:.2f}, {rmse_px[max]:.2f}"),
    ("least right names", "{correct:.4f}"),
    ("wrong", "{wrong:.4f}"),
    ("error of ranges, 95 %", "{range_error:.1%}"),
)


def _page(result: dict[str, Any]) -> str:
    rows = [{"name": name, **found} for name, found in result["scenarios"].items()]
    kinds = sorted({kind for row in rows for kind in row["cores_by_kind"]})
    spent = [[row["name"], *(f"{row['cores_by_kind'].get(kind, 0.0):.2f}" for kind in kinds)] for row in rows]
    busy = f" Beside {result['busy']} other processes that keep a core busy each." if result["busy"] else ""
    return report.page(
        f"# The first command\n\nCores: CPU seconds of all processes per second.{busy}",
        report.table_of(COLUMNS, rows),
        "Cores in flight, by process:",
        report.table(["scenario", *kinds], spent),
        *(
            f"{row['name']}: {'; '.join(f'{w}: {many}' for w, many in row['verdicts'].items())}."
            for row in rows
        ),
    )


BENCH = Benchmark(
    NAME,
    _measured,
    _page,
    options=(
        scenarios(SCENARIOS),
        amount("--runs", 10, 1, "of each scenario"),
        option("--busy", "other processes that keep a core busy each", type=int, default=0, metavar="N"),
        option("--words", "more arguments of the command", nargs="+", default=[], metavar="WORD"),
    ),
)
