"""What every benchmark is made of: a name, options, a measurement and a page; or a table whose rows are flown.

    BENCH = Benchmark("flood", measured, page, options=(…,))
    BENCH = Flights(name="silent", title=…, about=…, seeds=…, rows=…, columns=…)

`BENCH` is what `swarmtrack bench` looks for in a module; `BENCH.publish(out, seeds=1)` does the same from Python.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.arguments import count
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.report import Columns
from swarmtrack.lab.score.intervals import fraction_interval
from swarmtrack.lab.score.swarm_score import SwarmScore
from swarmtrack.messages import Array
from swarmtrack.tracking import DEFAULT_TRACKER, TRACKERS

DEFAULT_OUT = Path("bench")

Result = dict[str, Any]
"""What stands in NAME.json."""


# --- options -----------------------------------------------------------------------------------------


class Option(NamedTuple):
    """One argument of a command line; keywords: as `add_argument` takes them; quick: in place of the default with
    --quick."""

    name: str
    keywords: Mapping[str, Any]
    quick: Any = None

    @property
    def key(self) -> str:
        return self.name.lstrip("-").replace("-", "_")

    @property
    def default(self) -> Any:
        """Where nothing is said."""
        without: dict[str | None, Any] = {"store_true": False, "append": []}
        action = self.keywords.get("action")
        return self.keywords.get("default", without.get(action))

    def add_to(self, parser: argparse.ArgumentParser) -> None:
        keywords = {"default": self.default, **self.keywords}
        if self.quick is not None:
            usual, quick = (f"{value:,.10g}" for value in (self.default, self.quick))
            words = f"{keywords['help']} (default: {usual}; with --quick {quick})"
            keywords |= {"default": None, "help": words}
        if keywords.get("action") == "store_true":
            del keywords["default"]
        parser.add_argument(self.name, **keywords)


def option(name: str, help: str = "(default: %(default)s)", **keywords: Any) -> Option:
    return Option(name, {"help": help, **keywords})


def flag(name: str, help: str) -> Option:
    """False unless it is given."""
    return Option(name, {"action": "store_true", "help": help})


def path(name: str, help: str, metavar: str = "DIR", **keywords: Any) -> Option:
    return Option(name, {"type": Path, "metavar": metavar, "help": help, **keywords})


def listed(name: str, help: str, metavar: str) -> Option:
    """May be given several times."""
    return Option(name, {"action": "append", "metavar": metavar, "help": help})


def amount(
    name: str,
    usual: float,
    quick: float,
    help: str,
    *,
    type: Callable[[str], Any] = count,
    metavar: str = "N",
) -> Option:
    """How much is done; less with --quick."""
    return Option(name, {"type": type, "metavar": metavar, "default": usual, "help": help}, quick)


def seeds(usual: int, quick: int) -> Option:
    return amount("--seeds", usual, quick, "flights of each kind")


def scenarios(usual: Sequence[str]) -> Option:
    """Which are flown, one after the other: any."""
    words = f"names from sim --list, or files (default: {' '.join(usual)})"
    return option("--scenarios", words, nargs="+", default=list(usual), metavar="NAME")


def several(name: str, help: str, usual: Sequence[float], **keywords: Any) -> Option:
    """Numbers, at least one."""
    return option(name, help, nargs="+", default=list(usual), **{"type": count, "metavar": "N", **keywords})


def some_of(name: str, choices: Iterable[str]) -> Option:
    """Some of these, or all."""
    known = list(choices)
    words = f"one or more of {', '.join(known)} (default: all)"
    return option(name, words, nargs="+", choices=known, default=known, metavar="NAME")


TRACKER = option("--tracker", default=DEFAULT_TRACKER, choices=list(TRACKERS))
PROCESSES = option("--processes", "flights at once (default: one per core)", type=count, metavar="N")
SECOND_STAGE = option(
    "--second-stage",
    'second stage of the detector: "auto", "none", "default", or an .onnx file (default: %(default)s)',
    default="auto",
    metavar="STAGE",
)
CLIPS = path("data", "a folder with pairs of NAME.mp4 and NAME_gt.csv", "DATA")

COMMON = (
    path("--out", "folder for the results (default: %(default)s)", default=DEFAULT_OUT),
    flag("--quick", "a fraction of the work, for a first look"),
)


# --- benchmarks --------------------------------------------------------------------------------------


class Command:
    """A benchmark as `swarmtrack bench` finds it. `_measure` writes what it finds, and returns what is in NAME.json."""

    name: str
    options: Sequence[Option]
    draws: bool = False
    """Whether it ends with a plot: then matplotlib is looked for before the work, not after it."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        for one in (*COMMON, *self._all_options()):
            one.add_to(parser)

    def run(self, args: argparse.Namespace) -> Result:
        """As a command line says; NAME.json and NAME.md into `args.out`."""
        for one in self._all_options():
            if one.quick is not None and getattr(args, one.key) is None:
                setattr(args, one.key, one.quick if args.quick else one.default)
        if self.draws:
            report.pyplot()
        args.out.mkdir(parents=True, exist_ok=True)
        return self._measure(args)

    def publish(self, out: Path, *, quick: bool = False, **options: Any) -> Result:
        """As a command line with these options does."""
        usual = {one.key: None if one.quick is not None else one.default for one in self._all_options()}
        assert options.keys() <= usual.keys(), f"bench {self.name} knows {', '.join(usual)}"
        return self.run(argparse.Namespace(out=out, quick=quick, **{**usual, **options}))

    def _all_options(self) -> Sequence[Option]:
        return self.options

    def _measure(self, args: argparse.Namespace) -> Result:
        raise NotImplementedError


@dataclass(frozen=True)
class Benchmark(Command):
    """measure: what is found, of the options; page: the same for people, and record: for programs, if that is no
    dictionary already."""

    name: str
    measure: Callable[[argparse.Namespace], Any]
    page: Callable[[Any], str]
    options: Sequence[Option] = ()
    record: Callable[[Any], Result] = dict
    draws: bool = False

    def _measure(self, args: argparse.Namespace) -> Result:
        found = self.measure(args)
        result = self.record(found)
        report.write(args.out, self.name, result, self.page(found))
        return result


# --- many flights ------------------------------------------------------------------------------------


class Row(NamedTuple):
    """One row of a table: `fly` flies a seed, `summarise` makes of all flights what stands in the row, after `facts`.

    `fly` goes to other processes, so it is a function of a module, or a `partial` of one. place: in the JSON, the list
    "rows" or by names; group: the heading of the table that it stands in.
    """

    words: str
    fly: Callable[[int], Any]
    summarise: Callable[[list[Any]], Mapping[str, Any]]
    facts: Mapping[str, Any]
    place: tuple[str, ...] = ()
    group: str = ""


@dataclass(frozen=True, kw_only=True)
class Flights(Command):
    """Every row is flown once per seed; what is known by then is written after each row.

    about: of what stands in the JSON, a template or a function; facts: what does beside the rows; seeds_from: the first
    seed; finish: what else is made of the flights of all rows (by their words), such as a plot.
    """

    name: str
    title: str
    about: str | Callable[[Result], str]
    seeds: Option
    rows: Callable[[argparse.Namespace], Sequence[Row]]
    columns: Columns
    facts: Callable[[argparse.Namespace], Result]
    options: Sequence[Option] = ()
    seeds_from: int = 1
    finish: Callable[[argparse.Namespace, dict[str, list[Any]]], None] | None = None
    draws: bool = False

    def _all_options(self) -> Sequence[Option]:
        return (self.seeds, *self.options)

    def _measure(self, args: argparse.Namespace) -> Result:
        many = getattr(args, self.seeds.key)
        rows = self.rows(args)
        result = self.facts(args) | ({} if any(row.place for row in rows) else {"rows": []})
        tables: dict[str, list[Mapping[str, Any]]] = {}
        flights: dict[str, list[Any]] = {}
        seeds = range(self.seeds_from, self.seeds_from + many)
        parts = [(row.words, row.fly) for row in rows]
        flown_rows = flown(self.name, parts, seeds, processes=getattr(args, "processes", 1))
        for row, found in zip(rows, flown_rows, strict=True):
            summary = row.summarise(found)
            _put(result, row, summary)
            tables.setdefault(row.group, []).append({**row.facts, **summary})
            if self.finish is not None:
                flights[row.words] = found
            report.write(args.out, self.name, result, self._page(result, tables))
        if self.finish is not None:
            self.finish(args, flights)
        return result

    def _page(self, result: Result, tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
        about = report.filled(self.about, result) if isinstance(self.about, str) else self.about(result)
        parts = [f"# {self.title}", about]
        for group, rows in tables.items():
            parts += [f"## {group}" if group else "", report.table_of(self.columns, rows)]
        return report.page(*parts)


def _put(result: Result, row: Row, summary: Mapping[str, Any]) -> None:
    if not row.place:
        result["rows"].append({**row.facts, **summary})
        return
    within = result
    for name in row.place[:-1]:
        within = within.setdefault(name, {})
    within[row.place[-1]] = dict(summary)


def flown(
    name: str,
    parts: Sequence[tuple[str, Callable[[int], Any]]],
    seeds: Sequence[int],
    *,
    processes: int | None = None,
) -> Iterator[list[Any]]:
    """The flights of each part, in the order of the seeds, once all are flown. parts: words, and what flies a seed;
    processes: see `pool`."""
    with pool(processes) as fly_all, report.progress(name, len(parts) * len(seeds)) as advance:
        for words, fly in parts:
            flights = []
            for flight in fly_all(fly, seeds):
                flights.append(flight)
                advance(words)
            yield flights


@contextmanager
def pool(processes: int | None) -> Iterator[Callable[..., Iterator[Any]]]:
    """A `map` that spreads calls over so many processes, None: one per core; 1: over none but this one."""
    if (processes or os.cpu_count()) == 1:
        yield map
        return
    # Spawned, not forked: the line of progress is a thread. An executor, not a pool: a process that cannot load its
    # work breaks it, where a pool would wait for ever.
    workers = ProcessPoolExecutor(
        processes, mp_context=multiprocessing.get_context("spawn"), initializer=_end_with_the_benchmark
    )
    try:
        yield workers.map
    finally:
        workers.shutdown(cancel_futures=True)


def _end_with_the_benchmark() -> None:
    """In a worker: end when the benchmark does, however that ended. Killed, it would leave its workers at work."""
    benchmark = multiprocessing.parent_process()
    assert benchmark is not None, "this is a worker"

    def wait() -> None:
        connection.wait([benchmark.sentinel])
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


# --- what summaries are made of ----------------------------------------------------------------------


def share(hits: Sequence[float] | Array, trials: Sequence[float] | Array) -> dict[str, float]:
    """Of all trials together, with its 95 % interval over flights; a hit that is NaN is none."""
    return fraction_interval(np.nan_to_num(np.asarray(hits, float)), np.asarray(trials, float))._asdict()


def shares(scores: Sequence[SwarmScore], *names: str) -> dict[str, dict[str, float]]:
    """Of (observer, drone in view, tenth of a second), by the names of a score's fields."""
    samples = np.array([score.samples for score in scores], float)
    return {
        name: share(np.array([getattr(score, name) for score in scores]) * samples, samples) for name in names
    }


def quantile(values: Iterable[float], of: float) -> float:
    """The value that this share of them does not exceed; may be infinite; NaN of none."""
    known = np.sort(np.fromiter(values, float))
    return float(known[max(math.ceil(of * len(known)), 1) - 1]) if len(known) else math.nan
