"""The page and the files of `swarmtrack bench trackers`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.report import number
from swarmtrack.benchmarks.trackers.results import Result, Row, by_cell
from swarmtrack.benchmarks.trackers.scenes import SCENES, SEED
from swarmtrack.benchmarks.trackers.verdicts import verdicts
from swarmtrack.lab.score.paper_scenario import CONDITIONS, PUBLISHED_RMSE_PX

STONE_SOUP_RMSE_PX = {  # 50 runs each, measured when this project began; `--peers` measures anew
    "ss_gnn": (0.08, 0.08, 0.08, 0.08, 0.62, 1.16, 1.66, 0.12, 0.16, 0.25, 0.48, 1.18, 0.65),
    "ss_jpda_ehm2": (0.08, 0.08, 0.08, 0.08, 0.62, 1.16, 1.66, 0.12, 0.16, 0.25, 0.48, 1.18, 0.65),
    "ss_gmphd": (0.08, 0.08, 0.08, 0.08, 0.62, 1.16, 1.66, 0.16, 0.21, 0.61, 0.73, 1.18, 0.65),
}
FAMILIES = {
    "paper": "The paper's conditions",
    "crossing": "Drones that meet",
    "untold": "Drones that meet, and trackers that are told nothing",
    "crowd": "Crowds, and bursts of misses",
    "births": "Targets that nobody announces",
    "rotating": "An observer that turns",
    "latency": "Late detections",
    "told_wrong": "Trackers that are told wrong numbers",
}
FEW_FAILURES = 0.01


def as_json(result: Result) -> dict[str, Any]:
    return {
        "seed": SEED,
        "quick": result.programme.quick,
        "jobs": result.programme.jobs,
        "wall_s": result.wall_s,
        "reference_ms": result.reference_ms,
        "rows": result.rows,
        "verdicts": [verdict._asdict() for verdict in verdicts(result)],
        "costs": [cost._asdict() for cost in result.costs],
        "enumeration": result.enumeration._asdict() if result.enumeration else None,
        "ablation": result.ablation,
    }


def markdown(result: Result) -> str:
    by_family = {
        title: _family(family, rows)
        for family, title in FAMILIES.items()
        if (rows := [row for row in result.rows if SCENES[row["scene"]].family == family])
    }
    sections = {
        "What must hold": report.table_of(VERDICT_COLUMNS, verdicts(result), numbers=False),
        "Which tracker when": _choice(result),
        **by_family,
        "The default tracker without its parts": _ablation(result) if result.ablation else "",
        "Cost": _costs(result) if result.costs else "",
    }
    return report.page(
        "# The trackers",
        _preface(result),
        *(f"## {title}\n\n{text}" for title, text in sections.items() if text),
        *(f"![{caption}]({file})\n*{caption}.*" for file, caption in result.plots),
    )


VERDICT_COLUMNS: report.Columns = (
    ("", "{number}"),
    ("claim", "{claim}"),
    ("tracker", "{tracker}"),
    ("found", "{found}"),
    ("", lambda row: "not measured" if row.holds is None else report.verdict(row.holds)),
)


def _preface(result: Result) -> str:
    return (
        "RMSE: root of the mean squared 2-D error over targets and scans of a run, mean over runs with a 95 % interval;"
        " a track stays with the drone it began on, so a swap counts as error, and one that is gone counts as standing"
        " where it was last. *swap*: share of runs that end with a track on another's target; *lost*: with a track"
        " gone, or further than 20 px from every target. Where nobody told the starts, tracks are matched to targets"
        " scan by scan (CLEAR-MOT): *swap* is a run with an identity switch, *lost* one that ends with a target"
        " untracked. GOSPA: c = 20 px, p = 2, mean over scans. ms: median processor time of predict and update, taken"
        " while other runs were played beside it; *Cost* below is taken alone.\n\n"
        "Trackers are told the numbers that hold (σ at least 0.5 px, P_D at most 0.999, false detections at least 0.01,"
        " acceleration 600 px²/s³), where they start, and that they start nearly at rest. *oracle_cv*: a Kalman filter"
        " that is told which detection is whose; *oracle_cv_rts*: its smoother, which knows the future too;"
        " *oracle_imm*: told as well, with the default tracker's mix of motion models.\n\n"
        f"Seed {SEED}; the same run shows every tracker the same scans. Took {result.wall_s / 60.0:.0f} min."
    )


def _choice(result: Result) -> str:
    """For each situation the tracker that fails least, then errs least; and the cheapest that is nearly as good."""
    situations = {
        "few false detections, little noise": "mixedB",
        "noise σ 1.5 px": "noise.75",
        "a fifth of the detections missing": "pd.80",
        "drones meet at speed": "crossing",
        "… and their detections merge": "crossing_merged",
        "drones meet slowly": "slow",
        "… and their detections merge ": "slow_merged",
        "eight in a ball": "ball",
        "thirty in a flock": "flock",
        "bursts of misses": "misses",
        "nobody tells the starts": "births",
        "an observer that turns": "rotating",
    }
    cells = by_cell(result.rows)
    rows = []
    for situation, scene in situations.items():
        own = [cells[scene, tracker] for tracker in result.programme.own if (scene, tracker) in cells]
        if own:
            best = min(own, key=lambda cell: (round(_failed(cell), 2), cell["rmse_px"]["median"]))
            most, worst = _failed(best) + FEW_FAILURES, 1.1 * best["rmse_px"]["median"]
            enough = [cell for cell in own if _failed(cell) <= most and cell["rmse_px"]["median"] <= worst]
            cheapest = min(enough, key=lambda cell: cell["ms_per_scan"])
            rows.append([situation, scene, _in_short(best), _in_short(cheapest)])
    header = ["situation", "scene", "best", "cheapest within 10 % and 1 % more failures"]
    table = report.table(header, rows, numbers=False)
    return f"{table}\n\nmedian RMSE; share of runs with a swap or a loss; ms of a scan."


def _failed(cell: Row) -> float:
    return float(cell["failed_fraction"]["value"])


def _in_short(cell: Row) -> str:
    return (
        f"`{cell['tracker']}` {cell['rmse_px']['median']:.2f} px, {100 * _failed(cell):.0f} %,"
        f" {cell['ms_per_scan']:.1f} ms"
    )


def _family(family: str, rows: Sequence[Row]) -> str:
    if family == "paper":
        return report.page(_paper(rows), _paper_failures(rows))
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    return report.page(
        "\n".join(f"* `{scene}`: {SCENES[scene].about}" for scene in scenes),
        report.table_of(COLUMNS, rows),
        report.table_of(FOUND_COLUMNS, rows) if family == "births" else "",
        _late(rows) if family == "latency" else "",
    )


def _paper(rows: Sequence[Row]) -> str:
    cells = by_cell(rows)
    trackers = list(dict.fromkeys(row["tracker"] for row in rows))
    conditions = [name for name in CONDITIONS if any(row["scene"] == name for row in rows)]
    lines = [[tracker, *(_rmse(cells.get((name, tracker))) for name in conditions)] for tracker in trackers]
    for tracker, figures in PUBLISHED_RMSE_PX.items():
        published = (f"{figures[name]:g}" if name in figures else "" for name in conditions)
        lines.append([f"paper: {tracker}", *published])
    for peer, values in STONE_SOUP_RMSE_PX.items():
        if peer not in trackers:
            at = dict(zip(CONDITIONS, values, strict=True))
            lines.append([f"Stone Soup: {peer}", *(f"{at[name]:.2f}" for name in conditions)])
    counts = sorted({row["runs"] for row in rows})
    runs = str(counts[0]) if len(counts) == 1 else " or ".join(map(str, counts))
    return f"Mean RMSE, px, {runs} runs:\n\n{report.table(['', *conditions], lines)}"


def _rmse(row: Row | None) -> str:
    if row is None:
        return ""
    low, high = row["rmse_px"]["ci95"]
    return f"{number(row['rmse_px']['mean'])} ± {number(0.5 * (high - low))}"


def _when(quantile: str, of: str) -> Callable[[Row], str]:
    return lambda row: "never" if math.isinf(row[of][quantile]) else number(row[of][quantile])


FAILURE_COLUMNS = (
    ("condition", "{scene}"),
    ("tracker", "{tracker}"),
    ("runs", "{runs}"),
    ("swap", "{swap_fraction:.1p} %"),
    ("lost", "{lost_fraction:.1p} %"),
)
COLUMNS: report.Columns = (
    ("scene", "{scene}"),
    *FAILURE_COLUMNS[1:3],
    ("mean RMSE, px", _rmse),
    ("median", "{rmse_px[median]:.2f}"),
    *FAILURE_COLUMNS[3:],
    ("GOSPA, px", "{gospa_px:.2f}"),
    ("ms", "{ms_per_scan:.2f}"),
)
FOUND_COLUMNS: report.Columns = (
    ("scene", "{scene}"),
    ("tracker", "{tracker}"),
    ("tracked", "{tracked_fraction:.1p} %"),
    ("found in 0.5 s", "{found_in_half_a_second_fraction:.1p} %"),
    ("median, s", _when("median", "find_s")),
    ("95 %, s", _when("p95", "find_s")),
    ("false a minute", "{false_tracks_per_min[mean]:.2f}"),
    ("dropped in 1 s", "{dropped_in_a_second_fraction:.1p} %"),
    ("latest, s", _when("max", "drop_s")),
    ("switches a run", "{switches_per_run:.2f}"),
)


def _paper_failures(rows: Sequence[Row]) -> str:
    failed = [row for row in rows if row["swap_fraction"] or row["lost_fraction"]]
    if not failed:
        return "No swap and no loss in any of these runs."
    return f"Swaps and losses:\n\n{report.table_of(FAILURE_COLUMNS, failed)}"


def _late(rows: Sequence[Row]) -> str:
    late = [row for row in rows if len(row.get("at_rmse_px", {})) > 1]
    latencies = list(late[0]["at_rmse_px"]) if late else []
    return "Error of `at(now)`, px RMSE, in the second half of a run, by latency:\n\n" + report.table(
        ["scene", "tracker", *(f"{latency} ms" for latency in latencies)],
        [[row["scene"], row["tracker"], *(number(v) for v in row["at_rmse_px"].values())] for row in late],
    )


def _ablation(result: Result) -> str:
    scenes, variants = (
        list(dict.fromkeys(row[of] for row in result.ablation)) for of in ("scene", "tracker")
    )
    cells = by_cell(result.ablation)

    def cell(scene: str, variant: str) -> str:
        row = cells[scene, variant]
        return f"{number(row['rmse_px']['median'])} ({100 * _failed(row):.0f} %, {row['ms_per_scan']:.1f} ms)"

    lines = [[variant, *(cell(scene, variant) for scene in scenes)] for variant in variants]
    return report.page(
        "Median RMSE, px (share of runs with a swap or a loss, ms of a scan), "
        f"{result.ablation[0]['runs']} runs:",
        report.table(["", *scenes], lines),
    )


BUDGET_COLUMNS = (
    ("", "{tracker}"),
    ("targets × detections", "{targets} × {detections}"),
    ("median", "{ms:.3f}"),
    ("least", "{least_ms:.3f}"),
    ("repeats", "{repeats}"),
)


def _costs(result: Result) -> str:
    parts = []
    for layout, words in (("crowded", "all targets in one gate"), ("spread", "each alone, 100 px apart")):
        own = [cost for cost in result.costs if cost.layout == layout]
        sizes = sorted({cost.targets for cost in own})
        at = {(cost.tracker, cost.targets): f"{cost.ms:.3g}" for cost in own}
        lines = [
            [tracker, *(at.get((tracker, n), "") for n in sizes)]
            for tracker in dict.fromkeys(cost.tracker for cost in own)
        ]
        parts.append(f"Median ms of a scan, {words}, N targets and N detections:")
        parts.append(report.table(["", *(f"N = {n}" for n in sizes)], lines))
    budgeted = [cost for cost in result.costs if cost.layout == "budget"]
    if budgeted:
        parts.append("Beside the budgets (all in one gate), ms, median and least:")
        parts.append(report.table_of(BUDGET_COLUMNS, budgeted))
    if result.enumeration is not None:
        e = result.enumeration
        parts.append(
            f"Enumerating the {e.events:,} joint events of {e.targets} × {e.detections} would take {e.ms / 1e3:,.0f} s"
            f" in Python, at the rate of the {e.timed_events:,} that were timed."
        )
    parts.append(
        f"A fixed piece of NumPy arithmetic takes {result.reference_ms:.3f} ms here: divide by it to compare machines."
    )
    return report.page(*parts)
