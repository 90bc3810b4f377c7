"""`swarmtrack bench identity`: who is who from one look, over 3 to 30 drones and 2 to 40 px of projection error."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import PROCESSES, Benchmark, amount, pool
from swarmtrack.benchmarks.identity import page
from swarmtrack.benchmarks.identity.experiment import (
    AS_EXPECTED,
    COMPLETE,
    CROWDED,
    Cell,
    Chunk,
    Pool,
    Result,
    cost,
    play,
    priors_of,
    scores,
    thinned,
)
from swarmtrack.lab.score.reliability import Reliability, Stated, reliability_of

NAME = "identity"
DRONES = (3, 5, 8, 12, 16, 20, 25, 30)
ERRORS_PX = (2.0, 5.0, 10.0, 20.0, 30.0, 40.0)
FEWER_DRONES, FEWER_ERRORS_PX = (8, 16, 30), (10.0, 20.0, 40.0)  # of the skies that are not complete
CHUNK = 50  # layouts a task
WIDEST_CELL = Cell(COMPLETE, DRONES[-1], ERRORS_PX[-1])
COMPARED = 0.1  # of the layouts: so many that are too wide to sweep are swept nevertheless
TIMED_DRONES, TIMED_ERRORS_PX = (8, 16, 30), (10.0, 20.0, 40.0)


def _measured(args: argparse.Namespace) -> Result:
    """Two plots into `args.out`, too."""
    result = found(args.layouts, args.processes)
    page.plot_cells(args.out / f"{NAME}.png", result)
    page.plot_calibration(args.out / f"{NAME}_calibration.png", result)
    return result


def found(layouts: int, processes: int | None) -> Result:
    """Of all cells."""
    chunks = play_all(tasks(layouts), processes)
    return Result(
        layouts=layouts,
        cells={cell: scores(of_cell) for cell, of_cell in chunks.items()},
        left_out={
            cell: float(np.mean(np.concatenate([chunk.left_out for chunk in of_cell])))
            for cell, of_cell in chunks.items()
        },
        calibrations=calibrations(chunks),
        thinned=[
            thinned(WIDEST_CELL, name, layouts, max(round(COMPARED * layouts), 1))
            for name in priors_of(COMPLETE)
        ],
        costs=[cost(n, error, min(layouts, 200)) for n in TIMED_DRONES for error in TIMED_ERRORS_PX],
    )


def calibrations(chunks: dict[Cell, list[Chunk]]) -> dict[Pool, Reliability]:
    """By sky and method, of all cells and of those with one error."""
    parts: dict[Pool, list[Stated]] = {}
    for cell in sorted(chunks, key=lambda cell: (cell.sky.number, cell.drones, cell.error_px)):
        for chunk in chunks[cell]:
            for method, stated in chunk.stated.items():
                for error_px in (None, cell.error_px):
                    parts.setdefault(Pool(cell.sky.name, method, error_px), []).append(stated)
    return {pool: reliability_of(Stated.joined(found)) for pool, found in parts.items()}


def tasks(layouts: int) -> list[tuple[Cell, int, int]]:
    """All cells in pieces, the costly ones first, so that no process is left alone with one at the end."""
    cells = [Cell(COMPLETE, n, error) for n in DRONES for error in ERRORS_PX]
    cells += [
        Cell(sky, n, error)
        for sky in (AS_EXPECTED, CROWDED)
        for n in FEWER_DRONES
        for error in FEWER_ERRORS_PX
    ]
    cells.sort(key=lambda cell: cell.drones * cell.error_px, reverse=True)
    return [
        (cell, first, min(first + CHUNK, layouts)) for cell in cells for first in range(0, layouts, CHUNK)
    ]


def _play_task(task: tuple[Cell, int, int]) -> Chunk:
    return play(*task)


def play_all(todo: Sequence[tuple[Cell, int, int]], processes: int | None) -> dict[Cell, list[Chunk]]:
    """Every task, over some processes, by cell."""
    chunks: dict[Cell, list[Chunk]] = {}
    with pool(processes) as play_each, report.progress("identity layouts", len(todo)) as advance:
        for chunk in play_each(_play_task, todo):
            chunks.setdefault(chunk.cell, []).append(chunk)
            advance(f"{chunk.cell.drones} drones, {chunk.cell.error_px:g} px")
    return chunks


BENCH = Benchmark(
    NAME,
    _measured,
    page.markdown,
    options=(amount("--layouts", 1000, 50, "random ones of each cell"), PROCESSES),
    record=page.as_json,
    draws=True,
)
add_arguments, run = BENCH.add_arguments, BENCH.run
