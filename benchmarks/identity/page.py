"""The tables and plots of `swarmtrack bench identity`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks import report
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
    Method,
    Pool,
    Result,
    Thinned,
)
from swarmtrack.lab.score.intervals import Interval
from swarmtrack.lab.score.reliability import Reliability, ReliabilityBin
from swarmtrack.tracking.priors import MARGINALS_MOST_OPEN_ROWS

FEWEST = 100  # statements in a bin that is drawn
FLOOR = 1e-5  # of a logarithmic axis


class Aim(NamedTuple):
    """What a first trial of the posterior found, in fractions."""

    drones: int
    error_px: float
    wrong: float
    unknown: float


AIMS = (Aim(8, 10.0, 0.0006, 0.033), Aim(16, 20.0, 0.002, 0.19))


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
                "methods": {name: _method_json(method) for name, method in methods.items()},
            }
            for cell, methods in sorted(result.cells.items(), key=_by_place)
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


def _method_json(method: Method) -> dict[str, Any]:
    return {name: value._asdict() for name, value in method._asdict().items()}


def _agreement_json(entry: ReliabilityBin) -> dict[str, Any]:
    return {**entry._asdict(), "right": entry.right._asdict()}


def _by_place(item: tuple[Cell, Any]) -> tuple[int, int, float]:
    cell = item[0]
    return cell.sky.number, cell.drones, cell.error_px


def markdown(result: Result) -> str:
    """Tables in percent, with 95 % intervals."""
    duplicates = sum(
        method.duplicate.value * result.layouts
        for methods in result.cells.values()
        for name, method in methods.items()
        if name.startswith("posterior")
    )
    return report.page(
        "# Who is who from one look",
        f"{result.layouts} random layouts a cell, {CAMERA.width}×{CAMERA.height} px, true projections uniform in"
        f" the image and as near to each other as they fall; error σ per axis between track and projection, in all"
        f" (of it the track's own {TRACK_SIGMA_PX:g} px), known to the observer; one look; IDs at {PROBABILITY:g}."
        " In percent with 95 % intervals over layouts: *wrong* of all tracks, *unknown* of the team's tracks,"
        ' *twice* of layouts in which an ID was given twice. argmin and Hungarian know no "unknown".',
        "*posterior*: with the prior that agents have (a drone in view has a track with 0.9; one stranger in an"
        " image). *told*: with the prior that holds under this sky.",
        f"Layouts in which the posterior gave an ID twice: {round(duplicates)}.",
        _aims(result),
        "## Every drone has a track, nobody else flies",
        _cells(result, [COMPLETE.name]),
        f"*too wide*: layouts whose sweep would have more than {MARGINALS_MOST_OPEN_ROWS} rows open, so that pairs"
        " were left out.",
        "## Strangers and missed drones",
        f"*{AS_EXPECTED.name}*: a drone has a track with {AS_EXPECTED.p_seen:g}, strangers are Poisson with mean"
        f" {AS_EXPECTED.strangers:g}: the prior that agents have. *{CROWDED.name}*: {CROWDED.p_seen:g} and"
        f" {CROWDED.strangers:g}.",
        _cells(result, [AS_EXPECTED.name, CROWDED.name]),
        "## Calibration",
        "Of all pairs with p ≥ 0.5: how likely they were said to be, and the share that is right. *expected"
        " error*: how far the two are apart in a bin of p, mean over statements.",
        _calibrations(result),
        "Of the IDs given at or above a threshold (all cells): stated → right.",
        _thresholds(result),
        "## Sweeps that are too wide",
        f"Layouts of the widest cell with {MARGINALS_MOST_OPEN_ROWS + 1} to {COMPARED_WIDTH} rows open, beside the"
        " exact marginals."
        " *off*: the largest error of a probability in a layout, median and worst.",
        _thinned(result.thinned),
        "## Time of one posterior",
        report.table_of(COST_COLUMNS, result.costs),
    )


def _percent(value: Interval) -> str:
    """With two decimals near none and near all."""
    if math.isnan(value.value):
        return "–"
    digits = 2 if value.high < 0.1 or value.low > 0.9 else 1
    low, high = (report.number(100.0 * limit, digits) for limit in (value.low, value.high))
    return f"{report.number(100.0 * value.value, digits)} ({low} … {high})"


def _aims(result: Result) -> str:
    rows = [
        [
            f"{aim.drones} drones, {aim.error_px:g} px, {name}",
            _percent(method.wrong),
            f"{100.0 * aim.wrong:.2f}",
            _percent(method.unknown),
            f"{100.0 * aim.unknown:.1f}",
        ]
        for aim in AIMS
        for name, method in result.cells[Cell(COMPLETE, aim.drones, aim.error_px)].items()
        if name.startswith("posterior")
    ]
    return report.table(["beside a first trial", "wrong", "then", "unknown", "then"], rows)


def _cells(result: Result, skies: list[str]) -> str:
    rows = [
        {**methods, "told": methods.get("posterior, told", methods["posterior"]), "cell": cell}
        for cell, methods in sorted(result.cells.items(), key=_by_place)
        if cell.sky.name in skies
    ]

    def name(row: dict[str, Any]) -> str:
        cell = row["cell"]
        words = f"{cell.drones}, {cell.error_px:g} px"
        return words if len(skies) == 1 else f"{cell.sky.name}: {words}"

    def of(method: str, count: str) -> Callable[[dict[str, Any]], str]:
        return lambda row: _percent(getattr(row[method], count))

    columns: report.Columns = (
        ("drones, error", name),
        ("argmin: wrong", of("argmin", "wrong")),
        ("twice", of("argmin", "duplicate")),
        ("Hungarian: wrong", of("Hungarian", "wrong")),
        ("margin: wrong", of("margin", "wrong")),
        ("unknown", of("margin", "unknown")),
        ("posterior: wrong", of("posterior", "wrong")),
        ("unknown", of("posterior", "unknown")),
        ("told: wrong", of("told", "wrong")),
        ("unknown", of("told", "unknown")),
        ("too wide", lambda row: f"{100.0 * result.left_out[row['cell']]:.1f}"),
    )
    return report.table_of(columns, rows)


def _calibrations(result: Result) -> str:
    rows = [
        [
            f"{pool.sky}, {pool.method}, {'all' if pool.error_px is None else f'{pool.error_px:g} px'}",
            str(found.overall.statements),
            report.number(100.0 * found.overall.stated),
            _percent(found.overall.right),
            report.number(100.0 * found.expected_error),
        ]
        for pool, found in _in_order(result.calibrations)
    ]
    return report.table(["sky, method, error", "statements", "stated", "right", "expected error"], rows)


def _thresholds(result: Result) -> str:
    pooled = [(pool, found) for pool, found in _in_order(result.calibrations) if pool.error_px is None]
    rows = [
        [
            f"p ≥ {entries[0].low:g}",
            *(f"{report.number(100.0 * e.stated)} → {_percent(e.right)}" for e in entries),
        ]
        for entries in zip(*(found.thresholds for _, found in pooled), strict=True)
    ]
    return report.table(["IDs given at", *(f"{pool.sky}, {pool.method}" for pool, _ in pooled)], rows)


def _in_order(found: dict[Pool, Reliability]) -> list[tuple[Pool, Reliability]]:
    """Pools of all errors before those of one."""
    return sorted(found.items(), key=lambda item: (item[0].sky, item[0].method, item[0].error_px or 0.0))


COST_COLUMNS = (
    ("drones", "{drones}"),
    ("error, px", "{error_px:g}"),
    ("median, ms", "{median_ms:.2f}"),
    ("95 %, ms", "{p95_ms:.2f}"),
)


def _thinned(entries: Iterable[Thinned]) -> str:
    rows = []
    for entry in entries:
        for name, given in entry.given.items():
            off = entry.off.get(name)
            rows.append(
                [
                    f"{entry.prior}: {name}",
                    str(entry.layouts),
                    f"{report.number(off[0], 4)}, {report.number(off[1], 3)}" if off else "0",
                    f"{given} of {entry.tracks}",
                    str(entry.wrong[name]),
                ]
            )
    return report.table(["prior: marginals", "layouts", "off", "IDs given", "of them wrong"], rows)


def plot_cells(path: Path, result: Result) -> None:
    """Heat maps over drones and error; in each cell the figure and its interval."""
    pyplot = report.pyplot()
    figure, axes = pyplot.subplots(2, 3, figsize=(18.0, 10.0), layout="constrained")
    panels = [
        ("argmin (Algorithm 1): wrong", "argmin", "wrong"),
        ("Hungarian: wrong", "Hungarian", "wrong"),
        (f"posterior ≥ {PROBABILITY:g}: wrong", "posterior", "wrong"),
        ("argmin: layouts with an ID given twice", "argmin", "duplicate"),
        (f"posterior ≥ {PROBABILITY:g}: layouts with an ID given twice", "posterior", "duplicate"),
        (f"posterior ≥ {PROBABILITY:g}: unknown", "posterior", "unknown"),
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
    for axis in axes.flat[len(panels) :]:
        axis.set_axis_off()
    axes.flat[len(panels)].legend(*axes.flat[0].get_legend_handles_labels(), loc="center")
    axes.flat[len(panels)].text(
        0.5, 0.1, "▽: none wrong; the interval ends there", ha="center", transform=axes.flat[-1].transAxes
    )
    report.save(figure, path, dpi=120)


def _draw_bins(axis: Any, found: Reliability, colour: Any, label: str, *, size: float) -> None:
    """Bins with their intervals; of one in which nothing was wrong only the upper end has a place on this axis."""
    drawn = [entry for entry in found.bins if entry.statements >= FEWEST]
    stated, wrong, low, high = np.array([_wrong(entry) for entry in drawn]).reshape(-1, 4).T
    some = wrong > 0.0
    axis.errorbar(
        stated[some],
        wrong[some],
        yerr=[wrong[some] - low[some], high[some] - wrong[some]],
        color=colour,
        marker="o",
        markersize=size,
        linewidth=0.3 * size,
        elinewidth=0.2 * size,
        label=label,
    )
    axis.plot(
        stated[~some], high[~some], color=colour, marker="v", markersize=size, fillstyle="none", linestyle=""
    )


def _wrong(entry: ReliabilityBin) -> tuple[float, float, float, float]:
    """1 − p, the share that is wrong, and its interval."""
    right = entry.right
    return max(1.0 - entry.stated, FLOOR), 1.0 - right.value, 1.0 - right.high, 1.0 - right.low
