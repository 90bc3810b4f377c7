"""The page and the plot of `swarmtrack bench mot`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.trackers.plots import COLOURS, DPI, MARKERS

METRICS = ("HOTA", "AssA", "IDF1", "MOTA", "switches")
DRAWN = ("IDF1", "HOTA")
PEER_COLOURS = ("tab:red", "tab:brown", "tab:pink", "tab:olive", "tab:cyan")

Figures = Mapping[str, float]


def better_boxes(row: Mapping[str, Figures]) -> dict[str, Figures]:
    """A tracker's figures once: where it was given its boxes in several sizes, those of the highest IDF1."""
    found: dict[str, Figures] = {}
    for name, figures in row.items():
        tracker = name.partition(",")[0]
        if tracker not in found or figures["IDF1"] > found[tracker]["IDF1"]:
            found[tracker] = figures
    return found


def page(result: dict[str, Any]) -> str:
    parts = [
        "# Trackers of others, the same detections",
        "A tenth of the boxes missed, σ of the centre 1 px and 5 % of the side, of the size 5 %, 0.3 false boxes per "
        "frame, scores from beta distributions (8, 2) and (3, 4).",
        "HOTA / IDF1 (× 100), the best in bold:",
        _summary(result["tables"]),
        "![IDF1 and HOTA against the frame rate](mot.png)",
    ]
    columns = (
        ("", "{name}"),
        *((name, f"{{{name}:.3f}}") for name in METRICS[:-1]),
        ("switches", "{switches:.0f}"),
        ("ms per frame", "{ms:.2f}"),
    )
    for source, rows in result["tables"].items():
        about = result["about"][source]
        parts.append(
            f"## {source}: {about['sequences']} sequences, {about['frames']} frames, {about['boxes']} boxes"
        )
        for rate, row in rows.items():
            parts += [f"{rate}:", report.table_by_name(columns, row)]
    return report.page(*parts)


def _summary(tables: Mapping[str, Mapping[str, Mapping[str, Figures]]]) -> str:
    """A row for each source and rate, a column for each tracker."""
    rows = {
        f"{source}, {rate}": better_boxes(row)
        for source, table in tables.items()
        for rate, row in table.items()
    }
    names = list(next(iter(rows.values())))
    lines = []
    for title, row in rows.items():
        cells = [[f"{100.0 * row[name][metric]:.1f}" for metric in ("HOTA", "IDF1")] for name in names]
        best = [max(column, key=float) for column in zip(*cells, strict=True)]
        bold = [
            [f"**{cell}**" if cell == most else cell for cell, most in zip(pair, best, strict=True)]
            for pair in cells
        ]
        lines.append([title, *(" / ".join(pair) for pair in bold)])
    return report.table(["", *names], lines)


def draw(file: Path, tables: Mapping[str, Mapping[str, Mapping[str, Figures]]]) -> None:
    """IDF1 and HOTA against the rate, a column of panels for each source; ours drawn through, peers dashed."""
    figure, grid = report.pyplot().subplots(
        2, len(tables), figsize=(4.8 * len(tables), 7.0), squeeze=False, sharex=True, layout="constrained"
    )
    for (source, rows), panels in zip(tables.items(), grid.T, strict=True):
        best = [better_boxes(row) for row in rows.values()]
        rates = [float(rate.split()[0]) for rate in rows]
        peers = [name for name in best[0] if name not in COLOURS]
        for metric, panel in zip(DRAWN, panels, strict=True):
            for name in best[0]:
                style = {"color": COLOURS.get(name), "marker": MARKERS.get(name, "."), "linewidth": 1.6}
                if name in peers:
                    colour = PEER_COLOURS[peers.index(name) % len(PEER_COLOURS)]
                    style |= {"color": colour, "linestyle": "--", "linewidth": 1.1}
                panel.plot(
                    rates, [100.0 * row[name][metric] for row in best], label=name, markersize=4, **style
                )
            panel.set(xscale="log", title=source if metric == DRAWN[0] else None, ylim=(20.0, 101.0))
            panel.set_xticks(rates, [f"{rate:g}" for rate in rates])
            panel.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
            panel.grid(alpha=0.25)
        panels[-1].set_xlabel("frames per second")
    for metric, panel in zip(DRAWN, grid[:, 0], strict=True):
        panel.set_ylabel(f"{metric}, %")
    figure.legend(
        *grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize="small"
    )
    report.save(figure, file, DPI)
