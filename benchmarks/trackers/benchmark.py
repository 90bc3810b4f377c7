"""`swarmtrack bench trackers`: every tracker in every scene, beside the oracles and, where asked for, other libraries.

Each run of a scene is filmed once and shown to every tracker. Runs are spread over processes; what comes out depends
on the scene, the tracker and the number of the run alone, so on neither `--jobs` nor the order. Times are taken
afterwards, in one process.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

from swarmtrack.arguments import require_extra
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import Benchmark, flag, option, pool
from swarmtrack.benchmarks.trackers import page, plots, timing
from swarmtrack.benchmarks.trackers.play import MakePlayer, Score, applies, late_difference, record, score
from swarmtrack.benchmarks.trackers.results import Played, Programme, Result, row
from swarmtrack.benchmarks.trackers.scenes import SCENES, film
from swarmtrack.tracking import DEFAULT_TRACKER, TRACKERS

NAME = "trackers"
PEER_RUNS = 25  # they cost a hundred times as much
PEER_PREFIX = "ss_"
BLOCK = 5  # runs that one process does at a time
PEER_FAMILIES = ("paper", "crossing")
ABLATION_SCENES = ("slow", "slow_merged", "pd.80", "crossing", "told_wrong_R_quarter_noise.50")
QUICK_ABLATION_SCENES = ("slow_merged",)
ABLATION_RUNS = 100
ABLATIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("as it is", {}),
    ("one hypothesis", {"hypotheses": 1}),
    ("five hypotheses", {"hypotheses": 5}),
    ("hundred hypotheses", {"hypotheses": 100}),
    ("one motion model", {"interacting": False}),
    ("as soon as likelier", {"changeover": 1.0}),
    ("doubts do not fade", {"doubt_s": 1e9}),
    ("narrow gate", {"gate_probability": 0.999}),
    ("no resolution model", {"resolution_px": 0.0}),
    ("clutter rate as told", {"learn_clutter": False}),
    ("noise as told", {"learn_noise": "no"}),
    ("no occlusion", {"occlusion": False}),
)
"""Improvements of the default tracker, switched off one at a time; what it has no parameter for is left out."""

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Entrant(NamedTuple):
    """A tracker under a name of its own, with parameters over those that the scene tells."""

    label: str
    tracker: str
    parameters: tuple[tuple[str, Any], ...] = ()


class Block(NamedTuple):
    """Some runs of one scene, for one process."""

    scene: str
    entrants: tuple[Entrant, ...]
    runs: range


def _measured(args: argparse.Namespace) -> Result:
    """Plots into `args.out`, too."""
    programme = Programme(
        trackers=tuple(args.tracker), scenes=tuple(args.scene), runs=args.runs, quick=args.quick,
        peers=args.peers, jobs=args.jobs,
    )  # fmt: skip
    result = found(programme)
    return result._replace(plots=plots.draw(args.out, result))


BENCH = Benchmark(
    NAME,
    _measured,
    page.markdown,
    options=(
        option("--runs", "of every scene (default: its own, 100 or 300)", type=int, metavar="N"),
        option("--tracker", "(default: all)", action="extend", nargs="+", default=[], metavar="NAME"),
        option("--scene", "(default: all)", action="extend", nargs="+", default=[], metavar="NAME"),
        flag("--peers", "Stone Soup's, too (needs stonesoup and pyehm)"),
        option("--jobs", "processes (default: one a core)", type=int, default=os.cpu_count(), metavar="N"),
    ),
    record=page.as_json,
    draws=True,
)


def found(programme: Programme) -> Result:
    """Play and time."""
    began = time.monotonic()
    peers = load_peers() if programme.peers else {}
    blocks = [*_blocks(programme, tuple(peers)), *_ablation_blocks(programme)]
    played = play_all(blocks, programme.jobs)
    costs, enumerated, reference = _time(programme, peers)
    ablation = [
        row(SCENES[scene], label.removeprefix(ABLATED), scores)
        for (scene, label), scores in played.items()
        if label.startswith(ABLATED)
    ]
    compared = {cell: scores for cell, scores in played.items() if not cell[1].startswith(ABLATED)}
    rows = [row(SCENES[scene], label, scores) for (scene, label), scores in compared.items()]
    wall = time.monotonic() - began
    difference = {tracker: late_difference(tracker) for tracker in programme.own}
    return Result(programme, rows, compared, ablation, costs, enumerated, reference, difference, wall, [])


def load_peers() -> Mapping[str, MakePlayer]:
    """By name; raises MissingExtraError where Stone Soup is not installed."""
    require_extra("peers", "stonesoup", of="--peers")
    from swarmtrack.benchmarks.trackers.peers import PEERS  # noqa: PLC0415  # an extra

    return PEERS


def play_all(blocks: Sequence[Block], jobs: int) -> Played:
    """All blocks, in `jobs` processes; the result is in the order of the blocks."""
    if jobs > 1:
        os.environ.update({name: "1" for name in _ONE_THREAD if name not in os.environ})  # of the children
    played: Played = {}
    with pool(jobs) as play_each, report.progress("trackers", len(blocks)) as advance:
        for block, scores in zip(blocks, play_each(play_block, blocks), strict=True):
            for entrant, own in zip(block.entrants, scores, strict=True):
                played.setdefault((block.scene, entrant.label), []).extend(own)
            advance(block.scene)
    return played


def play_block(block: Block) -> list[list[Score]]:
    """The scores of each entrant, run by run."""
    scene = SCENES[block.scene]
    peers: Mapping[str, MakePlayer] = {}
    if any(entrant.tracker.startswith(PEER_PREFIX) for entrant in block.entrants):
        peers = load_peers()
    scores: list[list[Score]] = [[] for _ in block.entrants]
    for number in block.runs:
        take = film(scene, number)
        for entrant, own in zip(block.entrants, scores, strict=True):
            parameters = dict(entrant.parameters)
            own.append(score(scene, take, record(scene, take, entrant.tracker, parameters, peers=peers)))
    return scores


def _blocks(programme: Programme, peers: tuple[str, ...]) -> Iterator[Block]:
    for name in programme.scenes_to_play():
        scene = SCENES[name]
        entrants = tuple(
            Entrant(tracker, tracker) for tracker in programme.entrants if applies(tracker, scene)
        )
        runs = programme.runs_of(name)
        yield from _cut(name, entrants, runs)
        if peers and scene.family in PEER_FAMILIES:
            yield from _cut(name, tuple(Entrant(peer, peer) for peer in peers), min(runs, PEER_RUNS))


def _cut(scene: str, entrants: tuple[Entrant, ...], runs: int) -> Iterator[Block]:
    for begin in range(0, runs, BLOCK):
        yield Block(scene, entrants, range(begin, min(begin + BLOCK, runs)))


ABLATED = "ablated: "


def ablations_of(tracker: str) -> Iterator[Entrant]:
    known = {entry.name for entry in fields(TRACKERS[tracker].Parameters)}
    for label, parameters in ABLATIONS:
        if known.issuperset(parameters):
            yield Entrant(f"{ABLATED}{label}", tracker, tuple(parameters.items()))


def _ablation_blocks(programme: Programme) -> Iterator[Block]:
    if DEFAULT_TRACKER not in programme.own:
        return
    entrants = tuple(ablations_of(DEFAULT_TRACKER))
    wanted = QUICK_ABLATION_SCENES if programme.quick else ABLATION_SCENES
    for name in (name for name in wanted if name in programme.scenes_to_play()):
        yield from _cut(name, entrants, min(programme.runs_of(name), ABLATION_RUNS))


def _time(
    programme: Programme, peers: Mapping[str, MakePlayer]
) -> tuple[list[timing.Cost], timing.Enumeration | None, float]:
    """Not where some scenes only were asked for."""
    if programme.scenes:
        return [], None, timing.reference_ms()
    steps = timing.plan(programme.own, peers)
    costs: list[timing.Cost] = []
    with report.progress("cost", len(steps) + 1) as advance:
        for step in steps:
            costs += step.measure(peers, quick=programme.quick)
            advance(f"{step.tracker}, {step.layout}")
        timed = (5, 8) if programme.quick else (7, 8)
        enumerated = timing.enumeration(8, 18, timed)
        advance("enumeration")
    return costs, enumerated, timing.reference_ms()
