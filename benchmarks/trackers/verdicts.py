"""What must hold of the trackers, beside what was found."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from swarmtrack.benchmarks.trackers.results import Played, Result, Row, by_cell, paired_ratio
from swarmtrack.benchmarks.trackers.scenes import SCENES
from swarmtrack.benchmarks.trackers.timing import AT_BUDGET_MS, BUDGET_MS, Cost, Enumeration
from swarmtrack.lab.score.intervals import Interval
from swarmtrack.lab.score.paper_scenario import CONDITIONS, PUBLISHED_RMSE_PX

Cells = Mapping[tuple[str, str], Row]

CLOSE_PX = 0.3  # an error below this is as good as any: without noise it only tells which σ was assumed
ORACLE_OF = {"mbm": "oracle_imm"}  # of the same motion model; of all others the constant-velocity one
WITHIN = {"jpdaf": 1.05, "mbm": 1.05, "gmphd": 1.10, "kalman": 1.10}
FAILURES = {"crossing": 0.01, "crossing_merged": 0.01, "slow": 0.01, "slow_merged": 0.02}
WRONGLY_TOLD_RATIO = 1.5
ALL = 0.99  # "all", where chance decides: at P_D 0.9 a target may be missed five times on end
LATE_MS, LATE_RATIO = "300", 1.10
SAME = 1e-9
PEER_RATIO = 10.0
ENUMERATION_RATIO = 5000.0
PEER_OF = {"kalman": "ss_gnn", "jpdaf": "ss_jpda", "gmphd": "ss_gmphd"}


class Verdict(NamedTuple):
    """number: of the claim; holds: None where the run does not tell."""

    number: int
    claim: str
    tracker: str
    found: str
    holds: bool | None


def oracle_of(tracker: str) -> str:
    return ORACLE_OF.get(tracker, "oracle_cv")


Said = Iterator[tuple[int, str, str, bool]]
"""As a `Verdict`, of one tracker."""


def verdicts(result: Result) -> list[Verdict]:
    cells, played = by_cell(result.rows), result.played
    found = [
        Verdict(number, claim, tracker, text, holds)
        for tracker in result.programme.own
        for said in (
            _paper(tracker, cells, played),
            _crossings(tracker, cells, played),
            _births(tracker, cells),
            _motion(tracker, cells, played, result.late_difference),
            _told_wrong(tracker, cells, played),
            _speed(tracker, result.costs, result.enumeration),
        )
        for number, claim, text, holds in said
    ]
    return sorted(found, key=lambda verdict: verdict.number)


def _in_words(ratio: Interval) -> str:
    return f"{ratio.value:.3f} ({ratio.low:.3f} … {ratio.high:.3f})"


def _counts(cells: Cells, tracker: str, scenes: Sequence[str]) -> tuple[int, int, int]:
    """Runs in these scenes, swaps and losses."""
    own = [(cells[name, tracker], cells[name, tracker]["runs"]) for name in scenes]
    swaps, lost = (sum(round(c[of] * runs) for c, runs in own) for of in ("swap_fraction", "lost_fraction"))
    return sum(runs for _, runs in own), swaps, lost


def _worst(ratios: Mapping[str, Interval]) -> str:
    return max(ratios, key=lambda name: ratios[name].value, default="")


def _paper(tracker: str, cells: Cells, played: Played) -> Said:
    conditions = [name for name in CONDITIONS if (name, tracker) in cells]
    if tracker in WITHIN and conditions:
        oracle, limit = oracle_of(tracker), WITHIN[tracker]
        ratios = {
            name: paired_ratio(played[name, tracker], played[name, oracle])
            for name in conditions
            if cells[name, tracker]["rmse_px"]["mean"] >= CLOSE_PX and (name, oracle) in played
        }
        worst = _worst(ratios)
        text = f"{_in_words(ratios[worst])} at worst, in {worst}" if worst else f"all below {CLOSE_PX:g} px"
        claim = f"paper's conditions: RMSE ≤ {limit:g} of its oracle, or below {CLOSE_PX:g} px"
        yield 1, claim, text, not worst or ratios[worst].value <= limit
        runs, swaps, lost = _counts(cells, tracker, conditions)
        yield 1, "paper's conditions: no swap", f"{swaps} swaps, {lost} losses in {runs} runs", swaps == 0
    for name, published in _published(tracker).items():
        if (name, tracker) in cells:
            rmse = cells[name, tracker]["rmse_px"]["mean"]
            yield 1, f"{name}: better than the paper's {published:g} px", f"{rmse:.3f} px", rmse < published


def _published(tracker: str) -> dict[str, float]:
    """Of the filter of the same name; the default tracker has to beat the best of each."""
    if tracker != "mbm":
        return PUBLISHED_RMSE_PX.get(tracker, {})
    named = dict.fromkeys(name for figures in PUBLISHED_RMSE_PX.values() for name in figures)
    return {n: min(figures[n] for figures in PUBLISHED_RMSE_PX.values() if n in figures) for n in named}


def _crossings(tracker: str, cells: Cells, played: Played) -> Said:
    for name, limit in FAILURES.items():
        if (name, tracker) not in cells:
            continue
        cell = cells[name, tracker]
        if tracker == "mbm":
            failed = cell["failed_fraction"]
            value, low, high = (100 * share for share in (failed["value"], *failed["ci95"]))
            text = f"{value:.1f} % ({low:.1f} … {high:.1f}) of {cell['runs']}"
            yield 2, f"{name}: loses or swaps in ≤ {100 * limit:g} % of runs", text, failed["value"] <= limit
            ratio = paired_ratio(played[name, tracker], played[name, "oracle_imm"], median=True)
            yield 2, f"{name}: median RMSE ≤ 1.05 of the IMM oracle", _in_words(ratio), ratio.value <= 1.05
        elif tracker == "jpdaf" and not name.endswith("merged"):
            swapped, lost = 100 * cell["swap_fraction"], 100 * cell["lost_fraction"]
            text = f"{swapped:.1f} % of {cell['runs']} (lost in {lost:.1f} %)"
            yield 2, f"{name}: swaps in ≤ 1 % of runs", text, cell["swap_fraction"] <= 0.01


def _births(tracker: str, cells: Cells) -> Said:
    for name in ("births", "births_8hz"):
        if (name, tracker) not in cells:
            continue
        cell = cells[name, tracker]
        share, find = cell["found_in_half_a_second_fraction"], cell["find_s"]
        text = f"{100 * share:.1f} % of {cell['targets']}; median {find['median']:.2f} s, 95 % in {find['p95']:.2f} s"
        yield 3, f"{name}: all (≥ {100 * ALL:g} %) found within 0.5 s", text, share >= ALL
        false = cell["false_tracks_per_min"]
        text = f"{false['mean']:.2f} ({false['ci95'][0]:.2f} … {false['ci95'][1]:.2f})"
        yield 3, f"{name}: false confirmed tracks below 1 per minute", text, false["mean"] < 1.0
        share, drop = cell["dropped_in_a_second_fraction"], cell["drop_s"]
        latest = "never" if math.isinf(drop["max"]) else f"{drop['max']:.2f} s"
        text = f"{100 * share:.1f} %; median {drop['median']:.2f} s, latest {latest}"
        yield 3, f"{name}: gone targets dropped in 1 s and a scan", text, share >= ALL


def _motion(tracker: str, cells: Cells, played: Played, late_difference: Mapping[str, float]) -> Said:
    if ("rotating", tracker) in played and ("rotating_still", tracker) in played:
        ratio = paired_ratio(played["rotating", tracker], played["rotating_still", tracker])
        claim = "observer yaws and rolls: RMSE ≤ 1.1 of the still one's"
        yield 4, claim, _in_words(ratio), ratio.value <= 1.1
    if tracker in late_difference:
        off = late_difference[tracker]
        claim = "read late or not, the state at the exposure is the same to 1e-9"
        yield 4, claim, f"{off:.1e}", off <= SAME
    if ("latency_steady", tracker) in cells:
        at = cells["latency_steady", tracker]["at_rmse_px"]
        late = at[LATE_MS] / at["0"]
        claim = f"`at(now)` {LATE_MS} ms late, steady targets: RMSE ≤ {LATE_RATIO:g} of prompt"
        yield 4, claim, f"{late:.3f}", late <= LATE_RATIO


def _told_wrong(tracker: str, cells: Cells, played: Played) -> Said:
    wrongs = {scene.name: scene.draws for scene in SCENES.values() if scene.family == "told_wrong"}
    wrong = {n: right for n, right in wrongs.items() if (n, tracker) in cells and (right, tracker) in played}
    if not wrong:
        return
    ratios = {
        name: paired_ratio(played[name, tracker], played[right, tracker])
        for name, right in wrong.items()
        if cells[name, tracker]["rmse_px"]["mean"] >= CLOSE_PX
    }
    runs, swaps, _ = _counts(cells, tracker, list(wrong))
    worst = _worst(ratios)
    text = f"{swaps} swaps in {runs} runs"
    if worst:
        text += f"; RMSE × {ratios[worst].value:.2f} at worst, in {worst}"
    holds = swaps == 0 and (not worst or ratios[worst].value <= WRONGLY_TOLD_RATIO)
    yield 5, "told wrong numbers: no swap, RMSE ≤ 1.5 of rightly told", text, holds


def _speed(tracker: str, costs: Sequence[Cost], enumeration: Enumeration | None) -> Said:
    own = [cost for cost in costs if cost.tracker == tracker]
    for cost in own:
        budgeted = cost.layout == "budget"
        budget = BUDGET_MS.get((tracker, cost.targets)) if budgeted else None
        if budget is not None:
            claim = f"{cost.targets} targets × {cost.detections} detections in one gate: under {budget:g} ms"
            yield 6, claim, f"{cost.ms:.2f} ms (least {cost.least_ms:.2f})", cost.ms < budget
        if cost.layout == "at":
            limit = AT_BUDGET_MS[cost.targets]
            text = f"{1e3 * cost.ms:.0f} µs (least {1e3 * cost.least_ms:.0f})"
            yield 6, f"`at` for {cost.targets} tracks: under {1e3 * limit:.0f} µs", text, cost.ms < limit
        if tracker == "jpdaf" and budgeted and enumeration and cost.targets == enumeration.targets:
            ratio = enumeration.ms / cost.ms
            claim = f"at least {ENUMERATION_RATIO:g} times faster than enumeration"
            yield 6, claim, f"{ratio:.3g} times", ratio >= ENUMERATION_RATIO
    peer = PEER_OF.get(tracker)
    theirs = {(c.layout, c.targets): c.ms for c in costs if peer and c.tracker.startswith(peer)}
    mine = {(c.layout, c.targets): c.ms for c in own}
    ratios = {size: theirs[size] / ms for size, ms in mine.items() if size in theirs}
    if ratios:
        (layout, n), least = min(ratios.items(), key=lambda item: item[1])
        claim = f"{PEER_RATIO:g} times faster than Stone Soup's counterpart at every N"
        yield 6, claim, f"{least:.1f} times at least ({layout}, N = {n})", least >= PEER_RATIO
