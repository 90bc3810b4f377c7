"""The plot of `swarmtrack bench endurance`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.endurance import verdict
from swarmtrack.benchmarks.endurance.verdict import JUDGE, MAX_GROWTH, MAX_LAG_S, MAX_UNSTEADY, RATES, Window
from swarmtrack.messages import Array

DPI = 140
# Of processes in turn; colour-blind safe.
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "0.55")
STYLES = dict(zip(RATES, ("-", "--", ":"), strict=True))


def draw(file: Path, windows: Sequence[Window], settled_s: float) -> None:
    """Four panels over the time of flight: memory, lag, rates, CPU."""
    figure, panels = report.pyplot().subplots(
        4, 1, figsize=(9.0, 10.0), sharex=True, layout="constrained", height_ratios=(3, 3, 3, 2)
    )
    names = verdict.processes(windows)
    colours = {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(names)}
    minutes = np.array([window.t_s for window in windows]) / 60.0
    judged = [k for k, window in enumerate(windows) if window in verdict.judged(windows, settled_s)]
    _memory(panels[0], minutes, windows, judged[0] if judged else 0, colours)
    _lag(panels[1], minutes, windows, colours)
    _rates(panels[2], minutes, windows, colours)
    for name in names:
        panels[3].plot(minutes, [w.cpu_percent[name] for w in windows], color=colours[name], label=name)
    elsewhere = [w.elsewhere_percent for w in windows]
    panels[3].plot(minutes, elsewhere, "k--", linewidth=0.9, label="all else here")
    title = "CPU of each process, and of whatever else ran on the machine"
    panels[3].set(ylabel="% of a core", title=title, xlabel="minutes of flight")
    panels[3].set_ylim(bottom=0.0)
    for panel in panels:
        panel.axvspan(0.0, settled_s / 60.0, color="0.93", zorder=0)
        panel.grid(alpha=0.25)
        panel.title.set_fontsize("medium")
        panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small", frameon=False)
    panels[0].set_xlim(0.0, minutes[-1] if len(minutes) else 1.0)
    report.save(figure, file, DPI)


def _memory(
    panel: Any, minutes: Array, windows: Sequence[Window], settled: int, colours: dict[str, str]
) -> None:
    """settled: the window whose memory is 100 %."""
    for name, colour in colours.items():
        sizes = np.array([window.rss_mb[name] for window in windows])
        label = f"{name}, {sizes[settled]:.0f} MB" + (" (not judged)" if name == JUDGE else "")
        panel.plot(minutes, 100.0 * sizes / sizes[settled], color=colour, label=label)
    _limit(panel, 100.0 * (1.0 + MAX_GROWTH), "limit")
    panel.set(ylabel="% of when settled", title="Memory (resident) of each process")


def _lag(panel: Any, minutes: Array, windows: Sequence[Window], colours: dict[str, str]) -> None:
    for drone_id in _agents(windows):
        colour = colours[f"drone {drone_id}"]
        for label, style, figure in (
            ("largest", "-", lambda agent: 1e3 * agent.lag_max_s),
            ("p95", ":", lambda agent: 1e3 * agent.lag_p95_s),
        ):
            values = verdict.of_agent(windows, drone_id, figure)
            panel.plot(minutes, values, color=colour, linestyle=style, label=f"drone {drone_id}, {label}")
    _limit(panel, 1e3 * MAX_LAG_S, "limit")
    from matplotlib import ticker  # noqa: PLC0415 - an extra, as in `report.pyplot`

    panel.set_yscale("log")
    panel.yaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    panel.yaxis.set_major_formatter("{x:g}")
    panel.yaxis.set_minor_locator(ticker.NullLocator())
    panel.set(ylabel="ms", title="How late the agents' event loops were")


def _rates(panel: Any, minutes: Array, windows: Sequence[Window], colours: dict[str, str]) -> None:
    for drone_id in _agents(windows):
        for name in RATES:
            values = np.array(verdict.rates(windows, drone_id, name))
            median = float(np.nanmedian(values)) if np.isfinite(values).any() else np.nan
            label = f"drone {drone_id}, {name} {median:.1f} Hz"
            colour = colours[f"drone {drone_id}"]
            panel.plot(minutes, 100.0 * values / median, color=colour, linestyle=STYLES[name], label=label)
    _limit(panel, 100.0 * (1.0 + MAX_UNSTEADY), "limits")
    _limit(panel, 100.0 * (1.0 - MAX_UNSTEADY), None)
    panel.set(ylabel="% of the median", title="Rates")


def _agents(windows: Sequence[Window]) -> list[int]:
    return sorted({drone_id for window in windows for drone_id in window.agents})


def _limit(panel: Any, value: float, label: str | None) -> None:
    panel.axhline(value, color="tab:red", linewidth=0.9, linestyle=(0, (6, 3)), label=label)
