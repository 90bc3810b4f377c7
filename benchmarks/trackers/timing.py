"""What a scan costs each tracker: against the number of targets, crowded and spread, and beside the budgets.

All in one process, one after the other, in processor time of the thread. An update changes a tracker, so each is timed
on a fresh copy of the same state: a crowd that has been followed for `WARM_UP` scans. Figures of different machines
compare as multiples of `reference_ms`, a fixed piece of arithmetic.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from swarmtrack.benchmarks.figures import spent_s
from swarmtrack.benchmarks.trackers.play import MakePlayer, Player, make_tracker
from swarmtrack.benchmarks.trackers.scenes import Scene, Sensor
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.lab.score.paper_scenario import PAPER_STEP_S
from swarmtrack.messages import Array, Scan

SIZES = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
QUICK_SIZES = (2, 8, 32)
BUDGETED = ((8, 18), (32, 40))  # targets × detections, all in one gate
BUDGET_MS = {("jpdaf", 8): 0.6, ("jpdaf", 32): 8.0, ("gmphd", 32): 5.0, ("mbm", 8): 2.0, ("mbm", 32): 15.0}
AT_BUDGET_MS = {10: 0.050, 200: 0.150}
ROUNDS = 5  # of what has a budget: the best counts, for others share the machine
WARM_UP = 4  # scans
TOO_SLOW_MS = 5e3  # a scan that takes longer ends a tracker's row: larger crowds are not tried
CROWD_RADIUS_PX = 1.5  # around one point: an rms distance of 1.1 px
NOISE_PX = 1.0  # detections lie within one sigma, so that every gate holds every one
PSEUDO_TURN = np.eye(3)  # a rotation is always given in flight


class Cost(NamedTuple):
    """ms: median, least_ms: least of `repeats` scans, in the best of `ROUNDS` where there is a budget; tracks: held at
    the end, tentative ones left out."""

    tracker: str
    layout: str
    targets: int
    detections: int
    ms: float
    least_ms: float
    repeats: int
    tracks: int


class Enumeration(NamedTuple):
    """Visiting every joint event of so many targets and detections, at the rate of those that were timed."""

    targets: int
    detections: int
    events: int
    timed_events: int
    ms: float


def reference_ms(repeats: int = 30) -> float:
    """A fixed piece of NumPy arithmetic on small arrays, as trackers do it; least of the repeats, ms."""
    rng = np.random.default_rng(0)
    A, x = rng.normal(size=(32, 6, 6)), rng.normal(size=(32, 6, 1))
    least = math.inf
    for _ in range(repeats):
        begin = time.thread_time()
        for _ in range(100):
            y = A @ x
            y = np.exp(-0.5 * (y * y).sum(axis=1))
        least = min(least, time.thread_time() - begin)
    return 1e3 * least


def crowd_costs(
    tracker: str,
    layout: str,
    sizes: Sequence[int] = SIZES,
    *,
    repeats: int = 30,
    peers: Mapping[str, MakePlayer] | None = None,
) -> Iterator[Cost]:
    """layout: "crowded", all targets within CROWD_RADIUS_PX, or "spread", on a grid of 100 px; as many detections."""
    for n in sizes:
        cost = cost_of(tracker, layout, n, n, repeats=repeats, peers=peers)
        yield cost
        if cost.least_ms > TOO_SLOW_MS:
            return


def cost_of(
    tracker: str,
    layout: str,
    targets: int,
    detections: int,
    *,
    repeats: int = 30,
    longest_s: float = 3.0,
    peers: Mapping[str, MakePlayer] | None = None,
) -> Cost:
    """Of predict and update, `repeats` times or for longest_s, whichever ends first; three times at least unless a
    single scan is too slow."""
    scene, points = laid_out(layout, targets)
    make = peers[tracker] if peers and tracker in peers else None
    player: Player = make(scene, {}) if make else make_tracker(scene, tracker)
    rng = np.random.default_rng(targets)
    player.initiate(0.0, points)
    for k in range(1, WARM_UP + 1):
        begin = time.thread_time()
        _show(player, PAPER_STEP_S * k, detect(points, detections, rng))
        if 1e3 * (time.thread_time() - begin) > TOO_SLOW_MS:
            slow = 1e3 * (time.thread_time() - begin)
            return Cost(tracker, layout, targets, detections, slow, slow, 1, len(player.tracks))
    spent: list[float] = []
    began = time.thread_time()
    held = 0
    while len(spent) < repeats and (time.thread_time() - began < longest_s or len(spent) < 3):
        fresh, z = copy.deepcopy(player), detect(points, detections, rng)
        begin = time.thread_time()
        _show(fresh, PAPER_STEP_S * (WARM_UP + 1), z)
        spent.append(1e3 * (time.thread_time() - begin))
        held = sum(track.status != "tentative" for track in fresh.tracks)
        if spent[-1] > TOO_SLOW_MS:
            break
    return Cost(tracker, layout, targets, detections, float(np.median(spent)), min(spent), len(spent), held)


def _show(player: Player, t: float, z: Array) -> None:
    player.predict(t)
    player.update(Scan(t, z))


def laid_out(layout: str, n: int) -> tuple[Scene, Array]:
    """The scene that tells the parameters, and where the n targets hover (n, 2) px."""
    if layout in ("crowded", "budget"):
        turn = np.arange(n) * math.pi * (3.0 - math.sqrt(5.0))  # a sunflower's seeds fill a disc evenly
        radius = CROWD_RADIUS_PX * np.sqrt((np.arange(n) + 0.5) / n)
        points = 500.0 + radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    else:
        side = math.ceil(math.sqrt(n))
        points = 100.0 + 100.0 * np.stack(np.divmod(np.arange(n), side), axis=1)
    scene = Scene(
        name=f"{layout}_{n}",
        family="timing",
        about="",
        motion=lambda rng: lambda t: np.tile(points, (len(t), 1, 1)),
        sensor=Sensor(sigma_px=NOISE_PX, p_detection=0.95),
        camera=PinholeCamera(800.0, 800.0, 500.0, 500.0, 1000, 1000),
    )
    return scene, points


def detect(points: Array, detections: int, rng: np.random.Generator) -> Array:
    """(detections, 2) px: one of each target, and the rest false, in the middle of the crowd."""
    noise = rng.uniform(-NOISE_PX, NOISE_PX, points.shape)
    false = points.mean(axis=0) + rng.uniform(-1.0, 1.0, (detections - len(points), 2))
    return rng.permutation(np.concatenate([points + noise, false]))


def at_cost(tracker: str, tracks: int, *, repeats: int = 200) -> Cost:
    """Of `at(now)` with a rotation."""
    scene, points = laid_out("spread", tracks)
    points = points * 900.0 / points.max()
    player = make_tracker(scene, tracker)
    player.initiate(0.0, points)
    _show(player, PAPER_STEP_S, points)
    read = partial(player.at, PAPER_STEP_S + 0.05, PSEUDO_TURN, 1e-6)
    spent = [1e3 * s for s in spent_s(read, repeats, time.thread_time)]
    return Cost(tracker, "at", tracks, 0, float(np.median(spent)), min(spent), repeats, tracks)


def events_of(targets: int, detections: int) -> int:
    """Joint events where every gate holds every detection: Σ_k C(n, k) C(m, k) k!."""
    ks = range(min(targets, detections) + 1)
    return sum(math.comb(targets, k) * math.comb(detections, k) * math.factorial(k) for k in ks)


def enumeration(targets: int, detections: int, timed: tuple[int, int] = (6, 8)) -> Enumeration:
    """A textbook JPDAF at targets × detections, by the rate at which it gets through the events of `timed`."""
    weights = np.random.default_rng(0).uniform(0.1, 1.0, (timed[0], timed[1] + 1))
    begin = time.thread_time()
    enumerated_marginals(weights)
    spent = 1e3 * (time.thread_time() - begin)
    events, timed_events = events_of(targets, detections), events_of(*timed)
    return Enumeration(targets, detections, events, timed_events, spent * events / timed_events)


def enumerated_marginals(weights: Array) -> Array:
    """Association probabilities (n, m + 1) by visiting every joint event, as textbooks have it.

    weights (n, m + 1): of target i being missed (column 0) or having made detection j (column 1 + j).
    """
    rows: list[list[float]] = weights.tolist()
    total = [[0.0] * weights.shape[1] for _ in rows]
    pick = [0] * len(rows)

    def assign(i: int, taken: int, weight: float) -> None:
        if i == len(rows):
            for target, column in enumerate(pick):
                total[target][column] += weight
            return
        for column, factor in enumerate(rows[i]):
            bit = 1 << column if column else 0
            if factor > 0.0 and not taken & bit:
                pick[i] = column
                assign(i + 1, taken | bit, weight * factor)

    assign(0, 0, 1.0)
    found = np.array(total)
    return np.asarray(found / found.sum(axis=1, keepdims=True))


class Step(NamedTuple):
    """One part of the run: what a tracker costs in one layout."""

    tracker: str
    layout: str

    def measure(self, peers: Mapping[str, MakePlayer], *, quick: bool) -> list[Cost]:
        if self.layout == "budget":
            return _budgeted(self.tracker, quick)
        sizes, repeats = (QUICK_SIZES, 5) if quick else (SIZES, 30)
        return list(crowd_costs(self.tracker, self.layout, sizes, repeats=repeats, peers=peers))


def plan(trackers: Sequence[str], peers: Mapping[str, MakePlayer]) -> list[Step]:
    crowds = [Step(name, layout) for name in [*trackers, *peers] for layout in ("crowded", "spread")]
    return [*crowds, *(Step(tracker, "budget") for tracker in trackers)]


def _budgeted(tracker: str, quick: bool) -> list[Cost]:
    repeats = 10 if quick else 100
    rounds = [_budgeted_once(tracker, repeats) for _ in range(1 if quick else ROUNDS)]
    return [min(same, key=lambda cost: cost.ms) for same in zip(*rounds, strict=True)]


def _budgeted_once(tracker: str, repeats: int) -> list[Cost]:
    crowds = [cost_of(tracker, "budget", n, m, repeats=repeats) for n, m in BUDGETED]
    return [*crowds, *(at_cost(tracker, n, repeats=repeats) for n in AT_BUDGET_MS)]
