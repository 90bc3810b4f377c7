"""Figures that have a budget, and how functions are timed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks import report

# Calls before those that count.
UNCOUNTED = 3


class Figure(NamedTuple):
    """One that was measured, and the budget that the design gives it; None: it gives none."""

    what: str
    value: float
    unit: str
    budget: float | None = None

    @property
    def ok(self) -> bool | None:
        return None if self.budget is None else self.value <= self.budget

    def record(self) -> dict[str, Any]:
        return {**self._asdict(), "ok": self.ok}


COLUMNS: report.Columns = (
    ("what", "{what}"),
    ("found", "{value:.3g} {unit}"),
    ("budget", lambda figure: "–" if figure.budget is None else f"{figure.budget:g} {figure.unit}"),
    ("", lambda figure: {None: "", True: "ok", False: "**over**"}[figure.ok]),
    ("found / budget", lambda figure: f"{figure.value / figure.budget:.2f}" if figure.budget else "–"),
)


def table(figures: Sequence[Figure]) -> str:
    return report.table_of(COLUMNS, figures)


def median_s(
    function: Callable[[], object], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Median duration of a call [s], the first ones not counted; clock: `time.process_time` for processor time."""
    return float(np.median(spent_s(function, repeats, clock)))


def spent_s(function: Callable[[], object], repeats: int, clock: Callable[[], float]) -> list[float]:
    """Duration of each call [s], the first ones not counted."""
    spent = []
    for _ in range(UNCOUNTED + repeats):
        began = clock()
        function()
        spent.append(clock() - began)
    return spent[UNCOUNTED:]
