"""The page and the files of `swarmtrack bench trackers`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.report import number
from swarmtrack.benchmarks.trackers import plots as tracker_plots
from swarmtrack.benchmarks.trackers.programme import Result
from swarmtrack.benchmarks.trackers.results import Row, by_cell
from swarmtrack.benchmarks.trackers.scenes import SCENES, SEED
from swarmtrack.benchmarks.trackers.verdicts import Verdict, verdicts
from swarmtrack.lab.score.clip_score import ClipScore
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


def write(out: Path, name: str, result: Result) -> None:
    found = verdicts(
        result.rows,
        played=result.played,
        costs=result.costs,
        enumeration=result.enumeration,
        late_difference=result.late_difference,
        trackers=result.programme.own,
    )
    out.mkdir(parents=True, exist_ok=True)
    plots = tracker_plots.draw(out, result)
    report.write_rows(out, name, result.rows, _markdown(result, found, plots), about=_about(result, found))


def _about(result: Result, found: Sequence[Verdict]) -> dict[str, Any]:
    """What stands beside the rows, in trackers_machine.json."""
    programme = result.programme
    return {
        "seed": SEED,
        "quick": programme.quick,
        "jobs": programme.jobs,
        "wall_s": result.wall_s,
        "reference_ms": result.reference_ms,
        "verdicts": [verdict._asdict() for verdict in found],
        "costs": [cost._asdict() for cost in result.costs],
        "enumeration": result.enumeration._asdict() if result.enumeration else None,
        "ablation": result.ablation,
        "clips": [
            {
                "clip": row.clip,
                "tracker": row.tracker,
                "recall": row.score.recall,
                "precision": row.score.precision,
                "identity_switches": row.score.switches,
                "centre_rmse_px": row.score.centre_rmse_px,
                "ms_per_scan": row.ms,
            }
            for row in result.clips
        ],
    }


def _markdown(result: Result, found: Sequence[Verdict], plots: Sequence[tuple[str, str]]) -> str:
    sections = [
        "# The trackers",
        "",
        _preface(result),
        "",
        "## What must hold",
        "",
        _verdict_table(found),
        "",
        "## Which tracker when",
        "",
        _choice(result),
        "",
    ]
    for family, title in FAMILIES.items():
        rows = [row for row in result.rows if SCENES[row["scene"]].family == family]
        if rows:
            sections += [f"## {title}", "", *_family(family, rows, result), ""]
    if result.clips:
        sections += ["## Real detections", "", _clips(result), ""]
    if result.ablation:
        sections += ["## The default tracker without its parts", "", _ablation(result), ""]
    if result.costs:
        sections += ["## Cost", "", _costs(result), ""]
    for file, caption in plots:
        sections += [f"![{caption}]({file})", f"*{caption}.*", ""]
    return "\n".join(sections)


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


def _verdict_table(found: Sequence[Verdict]) -> str:
    words = {True: "holds", False: "**fails**", None: "not measured"}
    rows = [[str(v.number), v.claim, v.tracker, v.found, words[v.holds]] for v in found]
    return report.table(["", "claim", "tracker", "found", ""], rows, numbers=False)


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
        if not own:
            continue
        best = min(own, key=_badness)
        enough = [
            cell
            for cell in own
            if _failed(cell) <= _failed(best) + FEW_FAILURES
            and cell["rmse_px"]["median"] <= 1.1 * best["rmse_px"]["median"]
        ]
        cheapest = min(enough, key=lambda cell: cell["ms_per_scan"])
        rows.append([situation, scene, _in_short(best), _in_short(cheapest)])
    header = ["situation", "scene", "best", "cheapest within 10 % and 1 % more failures"]
    table = report.table(header, rows, numbers=False)
    return f"{table}\n\nmedian RMSE; share of runs with a swap or a loss; ms of a scan."


def _badness(cell: Row) -> tuple[float, float]:
    return round(_failed(cell), 2), cell["rmse_px"]["median"]


def _failed(cell: Row) -> float:
    return float(cell["failed_fraction"]["value"])


def _in_short(cell: Row) -> str:
    return (
        f"`{cell['tracker']}` {cell['rmse_px']['median']:.2f} px, {100 * _failed(cell):.0f} %,"
        f" {cell['ms_per_scan']:.1f} ms"
    )


def _family(family: str, rows: Sequence[Row], result: Result) -> Iterable[str]:
    if family == "paper":
        yield _paper(rows)
        yield ""
        yield _paper_failures(rows)
        return
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    yield "\n".join(f"* `{scene}`: {SCENES[scene].about}" for scene in scenes)
    yield ""
    yield _plain(rows)
    if family == "births":
        yield ""
        yield _found(rows)
    if family == "latency":
        yield ""
        yield _late(rows)


def _paper(rows: Sequence[Row]) -> str:
    cells = by_cell(rows)
    trackers = list(dict.fromkeys(row["tracker"] for row in rows))
    conditions = [name for name in CONDITIONS if any(row["scene"] == name for row in rows)]
    lines = [[tracker, *(_rmse(cells.get((name, tracker))) for name in conditions)] for tracker in trackers]
    for tracker, figures in PUBLISHED_RMSE_PX.items():
        lines.append(
            [f"paper: {tracker}", *(f"{figures[name]:g}" if name in figures else "" for name in conditions)]
        )
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


def _paper_failures(rows: Sequence[Row]) -> str:
    failed = [row for row in rows if row["swap_fraction"] or row["lost_fraction"]]
    if not failed:
        return "No swap and no loss in any of these runs."
    return "Swaps and losses:\n\n" + report.table(
        ["condition", "tracker", "runs", "swap", "lost"],
        [
            [
                row["scene"],
                row["tracker"],
                str(row["runs"]),
                _percent(row["swap_fraction"]),
                _percent(row["lost_fraction"]),
            ]
            for row in failed
        ],
    )


def _plain(rows: Sequence[Row]) -> str:
    header = ["scene", "tracker", "runs", "mean RMSE, px", "median", "swap", "lost", "GOSPA, px", "ms"]
    return report.table(
        header,
        [
            [
                row["scene"],
                row["tracker"],
                str(row["runs"]),
                _rmse(row),
                number(row["rmse_px"]["median"]),
                _percent(row["swap_fraction"]),
                _percent(row["lost_fraction"]),
                number(row["gospa_px"]),
                number(row["ms_per_scan"]),
            ]
            for row in rows
        ],
    )


def _found(rows: Sequence[Row]) -> str:
    header = ["scene", "tracker", "tracked", "found in 0.5 s", "median, s", "95 %, s", "false a minute"]
    header += ["dropped in 1 s", "latest, s", "switches a run"]
    return report.table(
        header,
        [
            [
                row["scene"],
                row["tracker"],
                _percent(row["tracked_fraction"]),
                _percent(row["found_in_half_a_second_fraction"]),
                _seconds(row["find_s"]["median"]),
                _seconds(row["find_s"]["p95"]),
                number(row["false_tracks_per_min"]["mean"]),
                _percent(row["dropped_in_a_second_fraction"]),
                _seconds(row["drop_s"]["max"]),
                number(row["switches_per_run"]),
            ]
            for row in rows
        ],
    )


def _late(rows: Sequence[Row]) -> str:
    late = [row for row in rows if len(row.get("at_rmse_px", {})) > 1]
    latencies = list(late[0]["at_rmse_px"]) if late else []
    return "Error of `at(now)`, px RMSE, in the second half of a run, by latency:\n\n" + report.table(
        ["scene", "tracker", *(f"{latency} ms" for latency in latencies)],
        [[row["scene"], row["tracker"], *(number(v) for v in row["at_rmse_px"].values())] for row in late],
    )


def _clips(result: Result) -> str:
    trackers = list(dict.fromkeys(row.tracker for row in result.clips))
    lines = []
    for tracker in trackers:
        own = [row for row in result.clips if row.tracker == tracker]
        total = sum((row.score for row in own), ClipScore())
        lines += [_clip_line(row.clip, tracker, row.score, row.ms) for row in own]
        lines.append(_clip_line("total", tracker, total, sum(row.ms for row in own) / len(own)))
    header = ["clip", "tracker", "recall", "precision", "switches", "centre RMSE, px", "ms"]
    return (
        "Each clip was looked at once by the shipped detector; every tracker has the agent's default parameters.\n\n"
        + report.table(header, lines)
    )


def _clip_line(clip: str, tracker: str, score: ClipScore, ms: float) -> list[str]:
    return [
        clip,
        tracker,
        number(score.recall, 3),
        number(score.precision, 3),
        str(score.switches),
        number(score.centre_rmse_px),
        number(ms),
    ]


def _ablation(result: Result) -> str:
    scenes = list(dict.fromkeys(row["scene"] for row in result.ablation))
    variants = list(dict.fromkeys(row["tracker"] for row in result.ablation))
    cells = by_cell(result.ablation)
    lines = []
    for variant in variants:
        line = [variant]
        for scene in scenes:
            cell = cells[scene, variant]
            line.append(
                f"{number(cell['rmse_px']['median'])} ({100 * _failed(cell):.0f} %, {cell['ms_per_scan']:.1f} ms)"
            )
        lines.append(line)
    runs = result.ablation[0]["runs"]
    note = f"Median RMSE, px (share of runs with a swap or a loss, ms of a scan), {runs} runs:"
    return f"{note}\n\n{report.table(['', *scenes], lines)}"


def _costs(result: Result) -> str:
    parts = []
    for layout, words in (("crowded", "all targets in one gate"), ("spread", "each alone, 100 px apart")):
        own = [cost for cost in result.costs if cost.layout == layout]
        sizes = sorted({cost.targets for cost in own})
        at = {(cost.tracker, cost.targets): cost.ms for cost in own}
        trackers = list(dict.fromkeys(cost.tracker for cost in own))
        lines = [
            [tracker, *(f"{at[tracker, n]:.3g}" if (tracker, n) in at else "" for n in sizes)]
            for tracker in trackers
        ]
        parts += [f"Median ms of a scan, {words}, N targets and N detections:", ""]
        parts += [report.table(["", *(f"N = {n}" for n in sizes)], lines), ""]
    budgeted = [cost for cost in result.costs if cost.layout == "budget"]
    if budgeted:
        parts += ["Beside the budgets (all in one gate), ms, median and least:", ""]
        lines = [
            [
                c.tracker,
                f"{c.targets} × {c.detections}",
                number(c.ms, 3),
                number(c.least_ms, 3),
                str(c.repeats),
            ]
            for c in budgeted
        ]
        parts += [report.table(["", "targets × detections", "median", "least", "repeats"], lines), ""]
    if result.enumeration is not None:
        e = result.enumeration
        parts += [
            f"Enumerating the {e.events:,} joint events of {e.targets} × {e.detections} would take {e.ms / 1e3:,.0f} s"
            f" in Python, at the rate of the {e.timed_events:,} that were timed.",
            "",
        ]
    parts.append(
        f"A fixed piece of NumPy arithmetic takes {result.reference_ms:.3f} ms here: divide by it to compare machines."
    )
    return "\n".join(parts)


def _seconds(value: float) -> str:
    return "never" if math.isinf(value) else number(value)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
