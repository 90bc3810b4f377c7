"""The plots of `swarmtrack bench trackers`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.trackers.play import SMOOTHER, record
from swarmtrack.benchmarks.trackers.results import Result, by_cell
from swarmtrack.benchmarks.trackers.scenes import SCENES, film
from swarmtrack.lab.score.paper_scenario import CONDITIONS, PUBLISHED_RMSE_PX
from swarmtrack.tracking import DEFAULT_TRACKER

COLOURS = {
    "kalman": "tab:orange",
    "jpdaf": "tab:green",
    "gmphd": "tab:purple",
    "mbm": "tab:blue",
    "oracle_cv": "0.35",
    "oracle_imm": "0.35",
    SMOOTHER: "0.6",
}
STYLES = {"oracle_cv": "--", "oracle_imm": ":", SMOOTHER: "-."}
MARKERS = {"kalman": "s", "jpdaf": "^", "gmphd": "D", "mbm": "o"}
WIDTHS = {"kalman": 3.6, "jpdaf": 2.4, "gmphd": 1.5, "mbm": 1.4}  # lines that coincide show as stripes
IDENTITIES = ("tab:red", "tab:blue", "tab:green")  # as in the paper's figure
DPI = 140


def draw(out: Path, result: Result) -> list[tuple[str, str]]:
    """Draws what the run has figures for; (file name, caption) of each."""
    drawn = []
    for name, plot, caption in (
        (
            "conditions",
            _conditions,
            "Error against clutter, noise and missed detections; crosses: the paper's figures",
        ),
        ("trajectories", _trajectories, "One run of slow_merged: what two trackers make of the same scans"),
        ("latency", _latency, "Error of `at(now)` against how late detections arrive"),
        ("cost", _cost, "Processor time of a scan against the number of targets"),
    ):
        if (figure := plot(result)) is not None:
            report.save(figure, out / f"trackers_{name}.png", DPI)
            drawn.append((f"trackers_{name}.png", caption))
    return drawn


def _panels(n: int, width: float, height: float, **more: Any) -> tuple[Any, Any]:
    size = (width, height)
    figure, axes = report.pyplot().subplots(1, n, figsize=size, squeeze=False, layout="constrained", **more)
    return figure, axes[0]


def _style(tracker: str) -> dict[str, Any]:
    style = {"color": COLOURS.get(tracker), "linestyle": STYLES.get(tracker, "-"), "label": tracker}
    return {**style, "linewidth": WIDTHS.get(tracker, 1.1), "marker": MARKERS.get(tracker), "markersize": 4}


def _conditions(result: Result) -> Any:
    sweeps = (
        ("false detections a scan", {"control": 0.0, "clutter1": 1.0, "clutter5": 5.0, "clutter10": 10.0}),
        ("noise σ, px", {"control": 0.0, "noise.25": 0.5, "noise.50": 1.0, "noise.75": 1.5}),
        ("P_D", {"control": 1.0, "pd.97": 0.97, "pd.95": 0.95, "pd.90": 0.9, "pd.80": 0.8}),
    )
    if not all(_has(result, name) for name in CONDITIONS):
        return None
    cells = by_cell(result.rows)
    figure, axes = _panels(3, 11.0, 4.0, sharey=True)
    for panel, (label, sweep) in zip(axes, sweeps, strict=True):
        x = list(sweep.values())
        for tracker in _trackers(result, "control"):
            y = [cells[name, tracker]["rmse_px"]["mean"] for name in sweep]
            panel.plot(x, y, **_style(tracker))
        for tracker, figures in PUBLISHED_RMSE_PX.items():
            places = [(value, figures[name]) for name, value in sweep.items() if name in figures]
            style = {"color": COLOURS[tracker], "markersize": 7, "label": f"{tracker}, paper"}
            panel.plot(*np.array(places).reshape(-1, 2).T, "x", **style)
        panel.set(xlabel=label, yscale="log")
        panel.set_xticks(x, [f"{value:g}" for value in x], fontsize="small")
        panel.grid(alpha=0.25)
    axes[0].set_ylabel("RMSE, px")
    axes[2].invert_xaxis()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize="small")
    return figure


def _trajectories(result: Result) -> Any:
    scene = "slow_merged"
    good, other = DEFAULT_TRACKER, "kalman"
    if not (_has(result, scene) and (scene, good) in result.played and (scene, other) in result.played):
        return None
    pairs = list(zip(result.played[scene, good], result.played[scene, other], strict=True))
    kept = [k for k, (ours, _) in enumerate(pairs) if not (ours.swapped or ours.lost)]
    swapped = [k for k in kept if pairs[k][1].swapped and not pairs[k][1].lost]
    run = (swapped or kept or [0])[0]
    take = film(SCENES[scene], run)
    z = np.concatenate([observation.scan.z for observation in take.observations])
    figure, axes = _panels(2, 11.0, 5.4, sharey=True)
    for panel, tracker in zip(axes, (good, other), strict=True):
        named = record(SCENES[scene], take, tracker).named
        assert named is not None
        panel.plot(z[:, 0], z[:, 1], ".", color="0.8", markersize=2.5, label="detections")
        for drone, colour in enumerate(IDENTITIES):
            truth, track = take.truth[:, drone], named[:, drone]
            panel.plot(truth[:, 0], truth[:, 1], color="0.2", linewidth=0.8, linestyle="--")
            panel.plot(track[:, 0], track[:, 1], color=colour, linewidth=1.6, alpha=0.85)
            panel.plot(*truth[0], "o", color=colour, markersize=8, markeredgecolor="k")
            panel.plot(*truth[-1], "s", color=colour, markersize=8, markeredgecolor="k")
        panel.set(xlim=(80.0, 280.0), ylim=(60.0, 215.0), xlabel="u, px", title=tracker, aspect="equal")
    axes[0].set_ylabel("v, px")
    lines = report.pyplot().Line2D
    handles = [
        lines([], [], color="0.2", linestyle="--", linewidth=0.8, label="truth"),
        lines([], [], color="0.5", linewidth=1.6, label="track, in the colour of the drone it began on"),
        lines([], [], color="0.5", marker="o", linestyle="", label="where that drone begins"),
        lines([], [], color="0.5", marker="s", linestyle="", label="where it ends"),
        lines([], [], color="0.8", marker=".", linestyle="", label="detections"),
    ]
    figure.suptitle(f"slow_merged, run {run}", fontsize="medium")
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize="small")
    return figure


def _latency(result: Result) -> Any:
    cells = by_cell(result.rows)
    shown = [name for name in SCENES if SCENES[name].family == "latency" and _has(result, name)]
    if not shown:
        return None
    figure, axes = _panels(len(shown), 3.9 * len(shown), 3.9)
    for name, panel in zip(shown, axes, strict=True):
        for tracker in _trackers(result, name):
            at = cells[name, tracker].get("at_rmse_px", {})
            if len(at) > 1:
                panel.plot([float(ms) for ms in at], list(at.values()), **_style(tracker))
        panel.set(xlabel="latency, ms", title=name)
        panel.set_ylim(bottom=0.0)
        panel.grid(alpha=0.25)
    axes[0].set_ylabel("error of at(now), px RMSE")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, fontsize="small")
    return figure


def _cost(result: Result) -> Any:
    layouts = {"crowded": "all in one gate", "spread": "each alone, 100 px apart"}
    if not any(cost.layout in layouts for cost in result.costs):
        return None
    figure, axes = _panels(2, 10.0, 4.4, sharey=True)
    names = list(dict.fromkeys(cost.tracker for cost in result.costs))
    peers = [name for name in names if name not in COLOURS]
    for panel, (layout, label) in zip(axes, layouts.items(), strict=True):
        for name in names:
            own = [cost for cost in result.costs if cost.tracker == name and cost.layout == layout]
            style = _style(name)
            if name in peers:
                style |= {"color": f"C{3 + 2 * peers.index(name)}", "linestyle": "--"}
            style["marker"] = MARKERS.get(name, ".")
            panel.plot([cost.targets for cost in own], [cost.ms for cost in own], **style)
        panel.set(xscale="log", yscale="log", xlabel="targets N (and detections)", title=label)
        ticks = sorted({cost.targets for cost in result.costs if cost.layout == layout})
        panel.set_xticks(ticks, [str(tick) for tick in ticks])
        panel.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
        panel.grid(alpha=0.25, which="both")
    axes[0].set_ylabel("a scan, ms of one core")
    axes[0].legend(fontsize="small")
    return figure


def _has(result: Result, scene: str) -> bool:
    return any(name == scene for name, _ in result.played)


def _trackers(result: Result, scene: str) -> Sequence[str]:
    """Those with a colour of their own: peers would crowd the plots."""
    return [tracker for tracker in COLOURS if (scene, tracker) in result.played]
