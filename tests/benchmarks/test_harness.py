"""What all benchmarks share: options and their quick form, rows that are flown, cells, and the files they leave."""

from __future__ import annotations

import argparse
import json
import operator
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from support.patience import until
from swarmtrack.benchmarks import harness, report
from swarmtrack.benchmarks.figures import Figure, table
from swarmtrack.benchmarks.harness import (
    PROCESSES,
    Benchmark,
    Flights,
    Row,
    amount,
    flag,
    listed,
    option,
    some_of,
)
from swarmtrack.errors import MissingExtraError


def fly(height, seed):
    return height + seed


def mean(flights):
    return {"mean": float(np.mean(flights)), "share": harness.share([1.0, 0.0], [2.0, 2.0])}


def flights(place=lambda height: (), group=lambda height: ""):
    def rows(args):
        return [Row(f"{h} m", partial(fly, h), mean, {"height": h}, place(h), group(h)) for h in args.heights]

    return Flights(
        name="heights",
        title="How high",
        about="{seeds} flights.",
        seeds=harness.seeds(4, quick=2),
        options=(option("--heights", nargs="+", type=int, default=[10, 20]), PROCESSES),
        rows=rows,
        facts=lambda args: {"seeds": args.seeds},
        columns=(("", "{height} m"), ("mean", "{mean:.1f}"), ("share, %", "{share:.0p}")),
    )


def test_every_row_is_flown_once_per_seed_and_written_for_programs_and_people(tmp_path):
    result = flights().publish(tmp_path, processes=1)
    assert [(row["height"], row["mean"]) for row in result["rows"]] == [(10, 12.5), (20, 22.5)]
    assert json.loads((tmp_path / "heights.json").read_text(encoding="utf-8"))["rows"] == result["rows"]
    page = (tmp_path / "heights.md").read_text(encoding="utf-8")
    assert page.startswith("# How high\n\n4 flights.\n\n|  | mean | share, % |\n")
    assert "\n| 20 m | 22.5 | 25 (" in page


def test_rows_of_groups_stand_in_tables_of_their_own_and_by_name_in_the_json(tmp_path):
    by_name = flights(
        place=lambda h: ("teams", "red" if h < 20 else "blue", str(h)), group=lambda h: f"{h} m up"
    )
    result = by_name.publish(tmp_path, processes=1)
    assert result["teams"]["red"]["10"]["mean"] == 12.5
    assert "rows" not in result
    assert "\n## 20 m up\n\n|" in (tmp_path / "heights.md").read_text(encoding="utf-8")


def test_processes_find_what_one_finds():
    parts = [("low", partial(operator.add, 1)), ("high", partial(operator.add, 100))]
    alone, shared = (list(harness.flown("x", parts, range(3), processes=n)) for n in (1, 2))
    assert alone == shared == [[1, 2, 3], [100, 101, 102]]


class Unloadable:
    """Work that another process cannot load."""

    def __reduce__(self):
        return int, ("no number",)

    def __call__(self, seed):
        return seed


def test_work_that_no_process_can_load_is_an_error_and_no_wait():
    with pytest.raises(BrokenProcessPool):
        list(harness.flown("x", [("all", Unloadable())], range(3), processes=2))


SLEEPS = """
import time
from swarmtrack.benchmarks import harness
list(harness.flown("x", [("all", time.sleep)], range(600, 602), processes=2))
"""


def is_at_work(pid):
    status = Path(f"/proc/{pid}/status")
    return status.exists() and "\nState:\tZ" not in status.read_text(encoding="utf-8")


def test_a_benchmark_that_is_killed_leaves_no_worker_at_work():
    benchmark = subprocess.Popen([sys.executable, "-c", SLEEPS], stderr=subprocess.DEVNULL)
    children = Path(f"/proc/{benchmark.pid}/task/{benchmark.pid}/children")
    # Two workers, and what watches their shared resources.
    workers = until(lambda: (found := children.read_text().split())[2:] and found)
    benchmark.kill()
    benchmark.wait()
    until(lambda: not any(map(is_at_work, workers)), "a worker goes on")


def test_a_benchmark_that_draws_looks_for_matplotlib_before_it_begins(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    begun = []
    bench = Benchmark("drawn", begun.append, str, draws=True)
    with pytest.raises(MissingExtraError, match="a plot needs matplotlib"):
        bench.publish(tmp_path)
    assert not begun


def test_with_quick_less_is_done_unless_it_is_said_how_much(tmp_path):
    assert flights().publish(tmp_path, quick=True, processes=1)["seeds"] == 2
    assert flights().publish(tmp_path, quick=True, seeds=3, processes=1)["seeds"] == 3


def test_a_command_line_and_python_say_the_same(tmp_path):
    bench = Benchmark(
        "said",
        lambda args: {name: value for name, value in vars(args).items() if name != "out"},
        lambda result: "# Said",
        options=(
            amount("--runs", 10, 1, "of each"),
            flag("--no-wind", "none"),
            listed("--set", "more", "KEY"),
            some_of("--cases", ("a", "b")),
        ),
    )
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    told = bench.run(parser.parse_args(["--out", str(tmp_path)]))
    assert told == bench.publish(tmp_path)
    assert told == {"quick": False, "runs": 10, "no_wind": False, "set": [], "cases": ["a", "b"]}
    told = bench.run(
        parser.parse_args(["--quick", "--set", "x", "--set", "y", "--cases", "b", "--out", str(tmp_path)])
    )
    assert told == {"quick": True, "runs": 1, "no_wind": False, "set": ["x", "y"], "cases": ["b"]}
    assert "of each (default: 10; with --quick 1)" in parser.format_help()
    with pytest.raises(AssertionError, match="bench said knows runs, no_wind"):
        bench.publish(tmp_path, wind=True)


@pytest.mark.parametrize(
    ("template", "cell"),
    [
        ("{n}", "3"),
        ("{deep[list][1]:.1f}", "2.0"),
        ("{nan:.2f} {none:.2f} {inf}", "– – –"),
        ("{half:.1p} %", "50.0 %"),
        ("{half:.0m} ms", "500 ms"),
        ("{interval:.1f}", "0.5 (0.2 … 0.8)"),
        ("{interval:.0p%}", "50 % (20 … 80)"),
        ("{nowhere:.1p}", "–"),
    ],
)
def test_a_cell_is_a_template_of_its_row(template, cell):
    row = {
        "n": 3,
        "deep": {"list": [1.0, 2.0]},
        "nan": float("nan"),
        "none": None,
        "inf": float("inf"),
        "half": 0.5,
        "interval": {"value": 0.5, "low": 0.2, "high": 0.8},
        "nowhere": None,
    }
    assert report.filled(template, row) == cell


def test_figures_stand_beside_their_budgets():
    text = table([Figure("fast", 1.0, "ms", 2.0), Figure("slow", 3.0, "ms", 2.0), Figure("free", 4.0, "ms")])
    assert "| fast | 1 ms | 2 ms | ok | 0.50 |" in text
    assert "| slow | 3 ms | 2 ms | **over** | 1.50 |" in text
    assert "| free | 4 ms | – |  | – |" in text


def test_the_value_that_a_share_does_not_exceed_may_be_infinite():
    assert harness.quantile([3.0, 1.0, float("inf"), 2.0], 0.5) == 2.0
    assert harness.quantile([1.0, float("inf")], 0.95) == float("inf")
    assert np.isnan(harness.quantile([], 0.5))
