"""What must hold of the trackers, beside what was found."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from swarmtrack.benchmarks.trackers.play import Score
from swarmtrack.benchmarks.trackers.results import Row, by_cell, paired_ratio
from swarmtrack.benchmarks.trackers.scenes import SCENES
from swarmtrack.benchmarks.trackers.timing import AT_BUDGET_MS, BUDGET_MS, Cost, Enumeration
from swarmtrack.lab.score.paper_scenario import CONDITIONS, PUBLISHED_RMSE_PX

Played = Mapping[tuple[str, str], list[Score]]

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


class Verdict(NamedTuple):
    """number: of the claim; holds: None where the run does not tell."""

    number: int
    claim: str
    tracker: str
    found: str
    holds: bool | None


def oracle_of(tracker: str) -> str:
    return ORACLE_OF.get(tracker, "oracle_cv")


def verdicts(
    rows: Sequence[Row],
    *,
    played: Played,
    costs: Sequence[Cost],
    enumeration: Enumeration | None,
    late_difference: Mapping[str, float],
    trackers: Sequence[str],
) -> list[Verdict]:
    cells = by_cell(rows)
    found: list[Verdict] = []
    for tracker in trackers:
        found += _paper(tracker, cells, played)
        found += _crossings(tracker, cells, played)
        found += _births(tracker, cells)
        found += _motion(tracker, cells, played, late_difference)
        found += _told_wrong(tracker, cells, played)
        found += _speed(tracker, costs, enumeration)
    return sorted(found, key=lambda verdict: verdict.number)


def _paper(tracker: str, cells: Mapping[tuple[str, str], Row], played: Played) -> Iterator[Verdict]:
    conditions = [name for name in CONDITIONS if (name, tracker) in cells]
    if tracker in WITHIN and conditions:
        ratios = {}
        for name in conditions:
            if cells[name, tracker]["rmse_px"]["mean"] >= CLOSE_PX and (name, oracle_of(tracker)) in played:
                ratios[name] = paired_ratio(played[name, tracker], played[name, oracle_of(tracker)])
        worst = max(ratios, key=lambda name: ratios[name].value, default="")
        limit = WITHIN[tracker]
        text = f"all below {CLOSE_PX:g} px"
        if worst:
            ratio = ratios[worst]
            text = f"{ratio.value:.3f} ({ratio.low:.3f} … {ratio.high:.3f}) at worst, in {worst}"
        claim = f"paper's conditions: RMSE ≤ {limit:g} of its oracle, or below {CLOSE_PX:g} px"
        yield Verdict(1, claim, tracker, text, not worst or ratios[worst].value <= limit)
        runs = sum(cells[name, tracker]["runs"] for name in conditions)
        swaps = sum(
            round(cells[name, tracker]["swap_fraction"] * cells[name, tracker]["runs"]) for name in conditions
        )
        lost = sum(
            round(cells[name, tracker]["lost_fraction"] * cells[name, tracker]["runs"]) for name in conditions
        )
        yield Verdict(
            1,
            "paper's conditions: no swap",
            tracker,
            f"{swaps} swaps, {lost} losses in {runs} runs",
            swaps == 0,
        )
    for name, published in _published(tracker).items():
        if (name, tracker) in cells:
            rmse = cells[name, tracker]["rmse_px"]["mean"]
            yield Verdict(
                1,
                f"{name}: better than the paper's {published:g} px",
                tracker,
                f"{rmse:.3f} px",
                rmse < published,
            )


def _published(tracker: str) -> dict[str, float]:
    """Of the filter of the same name; the default tracker has to beat the best of each."""
    if tracker != "mbm":
        return PUBLISHED_RMSE_PX.get(tracker, {})
    best: dict[str, float] = {}
    for figures in PUBLISHED_RMSE_PX.values():
        for name, value in figures.items():
            best[name] = min(value, best.get(name, math.inf))
    return best


def _crossings(tracker: str, cells: Mapping[tuple[str, str], Row], played: Played) -> Iterator[Verdict]:
    for name, limit in FAILURES.items():
        if (name, tracker) not in cells:
            continue
        cell = cells[name, tracker]
        failed = cell["failed_fraction"]
        if tracker == "mbm":
            text = f"{100 * failed['value']:.1f} % ({100 * failed['ci95'][0]:.1f} … {100 * failed['ci95'][1]:.1f})"
            yield Verdict(
                2,
                f"{name}: loses or swaps in ≤ {100 * limit:g} % of runs",
                tracker,
                f"{text} of {cell['runs']}",
                failed["value"] <= limit,
            )
            ratio = paired_ratio(played[name, tracker], played[name, "oracle_imm"], median=True)
            text = f"{ratio.value:.3f} ({ratio.low:.3f} … {ratio.high:.3f})"
            yield Verdict(
                2, f"{name}: median RMSE ≤ 1.05 of the IMM oracle", tracker, text, ratio.value <= 1.05
            )
        elif tracker == "jpdaf" and not name.endswith("merged"):
            swapped, lost = 100 * cell["swap_fraction"], 100 * cell["lost_fraction"]
            text = f"{swapped:.1f} % of {cell['runs']} (lost in {lost:.1f} %)"
            yield Verdict(2, f"{name}: swaps in ≤ 1 % of runs", tracker, text, cell["swap_fraction"] <= 0.01)


def _births(tracker: str, cells: Mapping[tuple[str, str], Row]) -> Iterator[Verdict]:
    for name in ("births", "births_8hz"):
        if (name, tracker) not in cells:
            continue
        cell = cells[name, tracker]
        share, find = cell["found_in_half_a_second_fraction"], cell["find_s"]
        text = f"{100 * share:.1f} % of {cell['targets']}; median {find['median']:.2f} s, 95 % in {find['p95']:.2f} s"
        yield Verdict(3, f"{name}: all (≥ {100 * ALL:g} %) found within 0.5 s", tracker, text, share >= ALL)
        false = cell["false_tracks_per_min"]
        text = f"{false['mean']:.2f} ({false['ci95'][0]:.2f} … {false['ci95'][1]:.2f})"
        yield Verdict(
            3, f"{name}: false confirmed tracks below 1 per minute", tracker, text, false["mean"] < 1.0
        )
        share, drop = cell["dropped_in_a_second_fraction"], cell["drop_s"]
        latest = "never" if math.isinf(drop["max"]) else f"{drop['max']:.2f} s"
        text = f"{100 * share:.1f} %; median {drop['median']:.2f} s, latest {latest}"
        yield Verdict(3, f"{name}: gone targets dropped in 1 s and a scan", tracker, text, share >= ALL)


def _motion(
    tracker: str, cells: Mapping[tuple[str, str], Row], played: Played, late_difference: Mapping[str, float]
) -> Iterator[Verdict]:
    if ("rotating", tracker) in played and ("rotating_still", tracker) in played:
        ratio = paired_ratio(played["rotating", tracker], played["rotating_still", tracker])
        text = f"{ratio.value:.3f} ({ratio.low:.3f} … {ratio.high:.3f})"
        yield Verdict(
            4, "observer yaws and rolls: RMSE ≤ 1.1 of the still one's", tracker, text, ratio.value <= 1.1
        )
    if tracker in late_difference:
        text = f"{late_difference[tracker]:.1e}"
        yield Verdict(
            4,
            "read late or not, the state at the exposure is the same to 1e-9",
            tracker,
            text,
            late_difference[tracker] <= SAME,
        )
    if ("latency_steady", tracker) in cells:
        at = cells["latency_steady", tracker]["at_rmse_px"]
        ratio_late = at[LATE_MS] / at["0"]
        yield Verdict(
            4,
            f"`at(now)` {LATE_MS} ms late, steady targets: RMSE ≤ {LATE_RATIO:g} of prompt",
            tracker,
            f"{ratio_late:.3f}",
            ratio_late <= LATE_RATIO,
        )


def _told_wrong(tracker: str, cells: Mapping[tuple[str, str], Row], played: Played) -> Iterator[Verdict]:
    scenes = [
        scene
        for scene in SCENES.values()
        if scene.family == "told_wrong"
        and (scene.name, tracker) in cells
        and (scene.draws, tracker) in played
    ]
    if not scenes:
        return
    ratios = {
        scene.name: paired_ratio(played[scene.name, tracker], played[scene.draws, tracker])
        for scene in scenes
        if cells[scene.name, tracker]["rmse_px"]["mean"] >= CLOSE_PX
    }
    runs = sum(cells[scene.name, tracker]["runs"] for scene in scenes)
    swaps = sum(
        round(cells[scene.name, tracker]["swap_fraction"] * cells[scene.name, tracker]["runs"])
        for scene in scenes
    )
    worst = max(ratios, key=lambda name: ratios[name].value, default="")
    text = f"{swaps} swaps in {runs} runs"
    if worst:
        text += f"; RMSE × {ratios[worst].value:.2f} at worst, in {worst}"
    holds = swaps == 0 and (not worst or ratios[worst].value <= WRONGLY_TOLD_RATIO)
    yield Verdict(5, "told wrong numbers: no swap, RMSE ≤ 1.5 of rightly told", tracker, text, holds)


def _speed(tracker: str, costs: Sequence[Cost], enumeration: Enumeration | None) -> Iterator[Verdict]:
    own = [cost for cost in costs if cost.tracker == tracker]
    for cost in own:
        budget = BUDGET_MS.get((tracker, cost.targets)) if cost.layout == "budget" else None
        if budget is not None:
            claim = f"{cost.targets} targets × {cost.detections} detections in one gate: under {budget:g} ms"
            yield Verdict(
                6, claim, tracker, f"{cost.ms:.2f} ms (least {cost.least_ms:.2f})", cost.ms < budget
            )
        if cost.layout == "at":
            limit = AT_BUDGET_MS[cost.targets]
            text = f"{1e3 * cost.ms:.0f} µs (least {1e3 * cost.least_ms:.0f})"
            yield Verdict(
                6,
                f"`at` for {cost.targets} tracks: under {1e3 * limit:.0f} µs",
                tracker,
                text,
                cost.ms < limit,
            )
        if (
            tracker == "jpdaf"
            and cost.layout == "budget"
            and enumeration
            and cost.targets == enumeration.targets
        ):
            ratio = enumeration.ms / cost.ms
            claim = f"at least {ENUMERATION_RATIO:g} times faster than enumeration"
            yield Verdict(6, claim, tracker, f"{ratio:.3g} times", ratio >= ENUMERATION_RATIO)
    peer = PEER_OF.get(tracker)
    theirs = {(c.layout, c.targets): c for c in costs if peer and c.tracker.startswith(peer)}
    ratios = {
        (c.layout, c.targets): theirs[c.layout, c.targets].ms / c.ms
        for c in own
        if (c.layout, c.targets) in theirs
    }
    if ratios:
        (layout, n), least = min(ratios.items(), key=lambda item: item[1])
        claim = f"{PEER_RATIO:g} times faster than Stone Soup's counterpart at every N"
        yield Verdict(
            6, claim, tracker, f"{least:.1f} times at least ({layout}, N = {n})", least >= PEER_RATIO
        )


PEER_OF = {"kalman": "ss_gnn", "jpdaf": "ss_jpda", "gmphd": "ss_gmphd"}
