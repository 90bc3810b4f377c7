"""`swarmtrack bench identity`: who is who from one look, over 3 to 30 drones and 2 to 40 px of projection error."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import PROCESSES, Benchmark, amount, pool
from swarmtrack.benchmarks.identity.experiment import (
    AS_EXPECTED,
    CAMERA,
    COMPARED_WIDTH,
    COMPLETE,
    CROWDED,
    PROBABILITY,
    SEED,
    TRACK_SIGMA_PX,
    Cell,
    Chunk,
    Method,
    Pool,
    Result,
    cost,
    play,
    priors_of,
    scores,
    thinned,
)
from swarmtrack.lab.score.intervals import Interval
from swarmtrack.lab.score.reliability import Reliability, ReliabilityBin, Stated, reliability_of
from swarmtrack.tracking.priors import MARGINALS_MOST_OPEN_ROWS

NAME = "identity"
DRONES = (3, 5, 8, 12, 16, 20, 25, 30)
ERRORS_PX = (2.0, 5.0, 10.0, 20.0, 30.0, 40.0)
FEWER_DRONES, FEWER_ERRORS_PX = (8, 16, 30), (10.0, 20.0, 40.0)  # of the skies that are not complete
CHUNK = 50  # layouts a task
WIDEST_CELL = Cell(COMPLETE, DRONES[-1], ERRORS_PX[-1])
COMPARED = 0.1  # of the layouts: so many that are too wide to sweep are swept nevertheless
TIMED_DRONES, TIMED_ERRORS_PX = (8, 16, 30), (10.0, 20.0, 40.0)
FEWEST = 100  # statements in a bin that is drawn
FLOOR = 1e-5  # of a logarithmic axis
# What a first trial of the posterior found: drones, error, percent wrong and unknown.
AIMS = ((8, 10.0, "0.06", "3.3"), (16, 20.0, "0.20", "19.0"))


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    """Two plots into `args.out`, too."""
    result = found(args.layouts, args.processes)
    plot_cells(args.out / f"{NAME}.png", result)
    plot_calibration(args.out / f"{NAME}_calibration.png", result)
    return as_json(result)


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


def play_all(todo: Sequence[tuple[Cell, int, int]], processes: int | None) -> dict[Cell, list[Chunk]]:
    """Every task, over some processes, by cell."""
    chunks: dict[Cell, list[Chunk]] = {}
    with pool(processes) as play_each, report.progress("identity layouts", len(todo)) as advance:
        for chunk in play_each(play, *zip(*todo, strict=True)):
            chunks.setdefault(chunk.cell, []).append(chunk)
            advance(f"{chunk.cell.drones} drones, {chunk.cell.error_px:g} px")
    return chunks


# --- for programs and people ---------------------------------------------------------------------------


def as_json(result: Result) -> dict[str, Any]:
    return {
        "seed": SEED,
        "layouts": result.layouts,
        "image_px": [CAMERA.width, CAMERA.height],
        "track_sigma_px": TRACK_SIGMA_PX,
        "probability": PROBABILITY,
        "skies": [
            {"name": sky.name, "p_seen": sky.p_seen, "strangers": sky.strangers}
            for sky in (COMPLETE, AS_EXPECTED, CROWDED)
        ],
        "cells": [
            {
                "sky": cell.sky.name,
                "drones": cell.drones,
                "error_px": cell.error_px,
                "left_out": result.left_out[cell],
                "methods": {name: _method_json(method) for name, method in result.cells[cell].items()},
            }
            for cell in sorted(result.cells, key=_place)
        ],
        "calibration": [
            {
                **pool._asdict(),
                **_agreement_json(found.overall),
                "expected_error": found.expected_error,
                "bins": [_agreement_json(entry) for entry in found.bins],
                "thresholds": [_agreement_json(entry) for entry in found.thresholds],
            }
            for pool, found in result.calibrations.items()
        ],
        "thinned": [entry._asdict() for entry in result.thinned],
        "cost": [entry._asdict() for entry in result.costs],
    }


def _place(cell: Cell) -> tuple[int, int, float]:
    return cell.sky.number, cell.drones, cell.error_px


def _method_json(method: Method) -> dict[str, Any]:
    return {name: value._asdict() for name, value in method._asdict().items()}


def _agreement_json(entry: ReliabilityBin) -> dict[str, Any]:
    return {**entry._asdict(), "right": entry.right._asdict()}


AIM_COLUMNS: report.Columns = (
    ("beside a first trial", "{drones} drones, {error_px:g} px, {method}"),
    ("wrong", "{wrong:?p}"),
    ("then", "{then_wrong}"),
    ("unknown", "{unknown:?p}"),
    ("then", "{then_unknown}"),
)
CELL_COLUMNS: report.Columns = (
    ("drones, error", "{sky}{drones}, {error_px:g} px"),
    ("argmin: wrong", "{argmin[wrong]:?p}"),
    ("twice", "{argmin[duplicate]:?p}"),
    ("Hungarian: wrong", "{Hungarian[wrong]:?p}"),
    ("margin: wrong", "{margin[wrong]:?p}"),
    ("unknown", "{margin[unknown]:?p}"),
    ("posterior: wrong", "{posterior[wrong]:?p}"),
    ("unknown", "{posterior[unknown]:?p}"),
    ("told: wrong", "{told[wrong]:?p}"),
    ("unknown", "{told[unknown]:?p}"),
    ("too wide", "{left_out:.1p}"),
)
CALIBRATION_COLUMNS: report.Columns = (
    ("sky, method, error", "{sky}, {method}, {error}"),
    ("statements", "{statements}"),
    ("stated", "{stated:.2p}"),
    ("right", "{right:?p}"),
    ("expected error", "{expected_error:.2p}"),
)
THINNED_COLUMNS: report.Columns = (
    ("prior: marginals", "{prior}: {name}"),
    ("layouts", "{layouts}"),
    ("off", lambda row: report.filled("{off[0]:.4f}, {off[1]:.3f}", row) if row["off"] else "0"),
    ("IDs given", "{given} of {tracks}"),
    ("of them wrong", "{wrong}"),
)
COST_COLUMNS = (
    ("drones", "{drones}"),
    ("error, px", "{error_px:g}"),
    ("median, ms", "{median_ms:.2f}"),
    ("95 %, ms", "{p95_ms:.2f}"),
)


def markdown(result: dict[str, Any]) -> str:
    """Tables in percent, with 95 % intervals."""
    posteriors = [
        (cell, name, method)
        for cell in result["cells"]
        for name, method in cell["methods"].items()
        if name.startswith("posterior")
    ]
    duplicates = sum(method["duplicate"]["value"] * result["layouts"] for _, _, method in posteriors)
    aims = [
        {**cell, "method": name, **method, "then_wrong": wrong, "then_unknown": unknown}
        for drones, error_px, wrong, unknown in AIMS
        for cell, name, method in posteriors
        if (cell["sky"], cell["drones"], cell["error_px"]) == (COMPLETE.name, drones, error_px)
    ]
    calibrations = sorted(
        (
            {**entry, "error": "all" if (px := entry["error_px"]) is None else f"{px:g} px"}
            for entry in result["calibration"]
        ),
        key=lambda entry: (entry["sky"], entry["method"], entry["error_px"] or 0.0),
    )
    thinned = [
        {**entry, "name": name, "given": given, "off": entry["off"].get(name), "wrong": entry["wrong"][name]}
        for entry in result["thinned"]
        for name, given in entry["given"].items()
    ]
    return report.page(
        "# Who is who from one look",
        f"{result['layouts']} random layouts a cell, {CAMERA.width}×{CAMERA.height} px, true projections uniform in"
        f" the image and as near to each other as they fall; error σ per axis between track and projection, in all"
        f" (of it the track's own {TRACK_SIGMA_PX:g} px), known to the observer; one look; IDs at {PROBABILITY:g}."
        " In percent with 95 % intervals over layouts: *wrong* of all tracks, *unknown* of the team's tracks,"
        ' *twice* of layouts in which an ID was given twice. argmin and Hungarian know no "unknown".',
        "*posterior*: with the prior that agents have (a drone in view has a track with 0.9; one stranger in an"
        " image). *told*: with the prior that holds under this sky.",
        f"Layouts in which the posterior gave an ID twice: {round(duplicates)}.",
        report.table_of(AIM_COLUMNS, aims),
        "## Every drone has a track, nobody else flies",
        _cells(result, COMPLETE.name),
        f"*too wide*: layouts whose sweep would have more than {MARGINALS_MOST_OPEN_ROWS} rows open, so that pairs"
        " were left out.",
        "## Strangers and missed drones",
        f"*{AS_EXPECTED.name}*: a drone has a track with {AS_EXPECTED.p_seen:g}, strangers are Poisson with mean"
        f" {AS_EXPECTED.strangers:g}: the prior that agents have. *{CROWDED.name}*: {CROWDED.p_seen:g} and"
        f" {CROWDED.strangers:g}.",
        _cells(result, AS_EXPECTED.name, CROWDED.name),
        "## Calibration",
        "Of all pairs with p ≥ 0.5: how likely they were said to be, and the share that is right. *expected"
        " error*: how far the two are apart in a bin of p, mean over statements.",
        report.table_of(CALIBRATION_COLUMNS, calibrations),
        "Of the IDs given at or above a threshold (all cells): stated → right.",
        _thresholds(calibrations),
        "## Sweeps that are too wide",
        f"Layouts of the widest cell with {MARGINALS_MOST_OPEN_ROWS + 1} to {COMPARED_WIDTH} rows open, beside the"
        " exact marginals."
        " *off*: the largest error of a probability in a layout, median and worst.",
        report.table_of(THINNED_COLUMNS, thinned),
        "## Time of one posterior",
        report.table_of(COST_COLUMNS, result["cost"]),
    )


def _cells(result: dict[str, Any], *skies: str) -> str:
    rows = []
    for cell in result["cells"]:
        if cell["sky"] in skies:
            told = cell["methods"].get("posterior, told", cell["methods"]["posterior"])
            sky = "" if len(skies) == 1 else f"{cell['sky']}: "
            rows.append({**cell, **cell["methods"], "told": told, "sky": sky})
    return report.table_of(CELL_COLUMNS, rows)


def _thresholds(calibrations: Sequence[dict[str, Any]]) -> str:
    pooled = [entry for entry in calibrations if entry["error_px"] is None]
    rows = [
        [f"p ≥ {entries[0]['low']:g}", *(report.filled("{stated:.2p} → {right:?p}", e) for e in entries)]
        for entries in zip(*(entry["thresholds"] for entry in pooled), strict=True)
    ]
    return report.table(["IDs given at", *(f"{entry['sky']}, {entry['method']}" for entry in pooled)], rows)


def plot_cells(path: Path, result: Result) -> None:
    """Heat maps over drones and error; in each cell the figure and its interval."""
    figure, axes = report.pyplot().subplots(2, 3, figsize=(18.0, 10.0), layout="constrained")
    ours, twice = f"posterior ≥ {PROBABILITY:g}", "layouts with an ID given twice"
    panels = [
        ("argmin (Algorithm 1): wrong", "argmin", "wrong"),
        ("Hungarian: wrong", "Hungarian", "wrong"),
        (f"{ours}: wrong", "posterior", "wrong"),
        (f"argmin: {twice}", "argmin", "duplicate"),
        (f"{ours}: {twice}", "posterior", "duplicate"),
        (f"{ours}: unknown", "posterior", "unknown"),
    ]
    complete = {cell: methods for cell, methods in result.cells.items() if cell.sky == COMPLETE}
    for axis, (title, method, count) in zip(axes.flat, panels, strict=True):
        cells = {(c.drones, c.error_px): getattr(m[method], count) for c, m in complete.items()}
        image = _heat_map(axis, cells)
        axis.set(title=title, xlabel="drones", ylabel="projection error, px per axis")
    figure.colorbar(image, ax=axes, label="%", shrink=0.5)
    report.save(figure, path, dpi=110)


def _heat_map(axis: Any, cells: dict[tuple[int, float], Interval]) -> Any:
    from matplotlib.colors import SymLogNorm  # noqa: PLC0415  # an extra

    drones, errors = sorted({n for n, _ in cells}), sorted({e for _, e in cells})
    percent = np.array([[100.0 * cells[n, e].value for n in drones] for e in errors])
    image = axis.imshow(
        percent, origin="lower", aspect="auto", cmap="cividis", norm=SymLogNorm(0.1, vmin=0.0, vmax=100.0)
    )
    axis.set_xticks(range(len(drones)), drones)
    axis.set_yticks(range(len(errors)), [f"{e:g}" for e in errors])
    for row, e in enumerate(errors):
        for column, n in enumerate(drones):
            found = cells[n, e]
            colour = "black" if percent[row, column] > 3.0 else "white"
            place = {"ha": "center", "va": "center", "color": colour}
            axis.text(column, row + 0.15, _short(found.value), fontsize=10, **place)
            axis.text(column, row - 0.2, f"{_short(found.low)}–{_short(found.high)}", fontsize=7, **place)
    return image


def _short(fraction: float) -> str:
    """In percent."""
    percent = 100.0 * fraction
    return "0" if percent < 0.005 else f"{percent:.2f}" if percent < 1.0 else f"{percent:.1f}"


def plot_calibration(path: Path, result: Result) -> None:
    """The share that is wrong over the share that should be, pooled and for every error."""
    pyplot = report.pyplot()
    panels = list(dict.fromkeys((pool.sky, pool.method) for pool in result.calibrations))
    figure, axes = pyplot.subplots(2, 3, figsize=(14.0, 9.5), layout="constrained", sharex=True, sharey=True)
    errors = sorted({pool.error_px for pool in result.calibrations if pool.error_px is not None})
    colours = dict(zip(errors, pyplot.get_cmap("viridis")(np.linspace(0.0, 0.9, len(errors))), strict=True))
    for axis, (sky, method) in zip(axes.flat, panels, strict=False):
        axis.plot([FLOOR, 0.5], [FLOOR, 0.5], color="0.6", linestyle="--", label="stated = found")
        for error in errors:
            found = result.calibrations.get(Pool(sky, method, error))
            if found:
                _draw_bins(axis, found, colours[error], f"{error:g} px", size=4.0)
        _draw_bins(axis, result.calibrations[Pool(sky, method, None)], "black", "all", size=7.0)
        axis.set(title=f"{sky}: {method}", xlabel="stated: 1 − p", ylabel="found: share that is wrong")
        axis.set(xscale="log", yscale="log", xlim=(FLOOR, 0.6), ylim=(FLOOR, 0.6))
        axis.tick_params(labelbottom=True, labelleft=True)
    spare = axes.flat[len(panels)]
    for axis in axes.flat[len(panels) :]:
        axis.set_axis_off()
    spare.legend(*axes.flat[0].get_legend_handles_labels(), loc="center")
    spare.text(
        0.5, 0.1, "▽: none wrong; the interval ends there", ha="center", transform=axes.flat[-1].transAxes
    )
    report.save(figure, path, dpi=120)


def _draw_bins(axis: Any, found: Reliability, colour: Any, label: str, *, size: float) -> None:
    """Bins with their intervals; of one in which nothing was wrong only the upper end has a place on this axis."""
    drawn = [entry for entry in found.bins if entry.statements >= FEWEST]
    stated, wrong, low, high = np.array([_wrong(entry) for entry in drawn]).reshape(-1, 4).T
    some = wrong > 0.0
    look = {"color": colour, "markersize": size}
    ends = [wrong[some] - low[some], high[some] - wrong[some]]
    lines = {"linewidth": 0.3 * size, "elinewidth": 0.2 * size}
    axis.errorbar(stated[some], wrong[some], yerr=ends, marker="o", label=label, **lines, **look)
    axis.plot(stated[~some], high[~some], marker="v", fillstyle="none", linestyle="", **look)


def _wrong(entry: ReliabilityBin) -> tuple[float, float, float, float]:
    """1 − p, the share that is wrong, and its interval."""
    right = entry.right
    return max(1.0 - entry.stated, FLOOR), 1.0 - right.value, 1.0 - right.high, 1.0 - right.low


BENCH = Benchmark(
    NAME,
    _measured,
    markdown,
    options=(amount("--layouts", 1000, 50, "random ones of each cell"), PROCESSES),
    draws=True,
)
