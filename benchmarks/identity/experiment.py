"""Who is who from one look: the paper's Algorithm 1, its one-to-one relatives, and the posterior over all matchings.

A layout is one image with N drones whose true projections are uniform in it and independent. The error between track
and projection is Gaussian, `error` px per axis in all, and the observer knows how large it is (docs/swarm.md).

Skies. *complete*: every drone has a track and nobody else flies. In the others some drones are missed and some tracks
are strangers, as many as Poisson draws: *as expected*, as often as an agent's prior has it, and *crowded*, more often.
*complete* and *crowded* also show what a wrong prior costs: there the posterior stands twice, with the prior that every
agent has and *told* the one of the sky.

Methods. *argmin*: every track takes the ID of the nearest projection. *Hungarian*: the matching with the least sum of
distances. *margin*: the likeliest matching, an ID only where the likeliest matching without it is (1 − p) / p as
likely. *posterior*: an ID where it has the probability p in the sum over all matchings. Of all tracks, wrong are those
that were given an ID that is not theirs; unknown those of the team's tracks that were given none.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.identity.paper import nearest
from swarmtrack.lab.score.intervals import Interval, fraction_interval
from swarmtrack.lab.score.reliability import Reliability, Stated
from swarmtrack.messages import Array
from swarmtrack.tracking import marginals
from swarmtrack.tracking.association import gate_threshold
from swarmtrack.tracking.gaussian import LOG_TWO_PI
from swarmtrack.tracking.marginals import matching_marginals, sweep_width
from swarmtrack.tracking.priors import MARGINALS_MOST_OPEN_ROWS

SEED = 1
CAMERA = PinholeCamera(430.0, 430.0, 320.0, 240.0, 640, 480)
TRACK_SIGMA_PX = 1.5
PROBABILITY = 0.95  # above which an ID is given
PAIRED = 2.0  # least design effect of wrong IDs: they come by twos, as swaps
NOBODY = -1
COMPARED_WIDTH = 17
# Prior: that a drone which may be anywhere is in front of this camera.
IN_VIEW = 0.2
GATE_PROBABILITY = 0.9999

Columns = NDArray[np.int64]


class Prior(NamedTuple):
    """What to expect of an image. p_seen: that a drone which should be in view has a confirmed track; strangers:
    how many confirmed tracks are none of the announced drones. Neither is ever certain: p_seen < 1, strangers > 0."""

    p_seen: float = 0.9
    strangers: float = 1.0

    @property
    def log_ratio(self) -> float:
        """Of "this track is that drone" and "a stranger, and the drone is not seen", before looking where they
        are."""
        return math.log(self.p_seen / (1.0 - self.p_seen) / self.strangers)


PRIOR = Prior()


class Sky(NamedTuple):
    """number: of its random layouts; p_seen: of each drone that it has a track; strangers: tracks expected of nobody
    in the team; told: the prior that says so, None where it is the one that agents have."""

    number: int
    name: str
    p_seen: float
    strangers: float
    told: Prior | None


COMPLETE = Sky(0, "complete", 1.0, 0.0, Prior(0.999, 0.001))
AS_EXPECTED = Sky(1, "as expected", PRIOR.p_seen, PRIOR.strangers, None)
CROWDED = Sky(2, "crowded", 0.7, 4.0, Prior(0.7, 4.0))


class Cell(NamedTuple):
    """One condition: N drones under a sky, with an error of so many px per axis."""

    sky: Sky
    drones: int
    error_px: float


class Layout(NamedTuple):
    """tracks (n, 2), projected (k, 2) px; variance px² per axis: of both together; truth (n,): the column of the drone
    each track is, or `NOBODY`."""

    tracks: Array
    projected: Array
    variance: float
    truth: Columns


class Outcome(NamedTuple):
    """One method on some layouts: counts (layouts,)."""

    wrong: Array
    unknown: Array
    duplicate: Array


class Chunk(NamedTuple):
    """Some layouts of a cell: counts (layouts,) of tracks, those of the team, and whether pairs had to be left out
    of the sweep; what came of each method, and what the posterior stated."""

    cell: Cell
    tracks: Array
    team: Array
    left_out: Array
    outcomes: dict[str, Outcome]
    stated: dict[str, Stated]


def draw(cell: Cell, k: int) -> Layout:
    """The k-th layout of a cell, always the same."""
    sky, n = cell.sky, cell.drones
    rng = np.random.default_rng([SEED, sky.number, n, round(10.0 * cell.error_px), k])
    size = np.array([CAMERA.width, CAMERA.height], float)
    variance = cell.error_px**2 - TRACK_SIGMA_PX**2
    true = rng.uniform(0.0, size, (n, 2))
    pixel = true + rng.normal(0.0, math.sqrt(variance), (n, 2))
    seen = np.flatnonzero(rng.random(n) < sky.p_seen)
    strangers = rng.uniform(0.0, size, (rng.poisson(sky.strangers), 2))
    truth = np.concatenate([seen, np.full(len(strangers), NOBODY)])
    places = np.concatenate([true[seen] + rng.normal(0.0, TRACK_SIGMA_PX, (len(seen), 2)), strangers])
    order = rng.permutation(len(truth))
    return Layout(places[order], pixel, variance + TRACK_SIGMA_PX**2, truth[order])


def by_argmin(layout: Layout) -> Columns:
    """Algorithm 1 as printed."""
    return np.array(nearest(layout.tracks, layout.projected), dtype=np.int64)


def by_distance(layout: Layout) -> Columns:
    """The one-to-one matching with the least sum of distances."""
    distance = np.linalg.norm(layout.tracks[:, None] - layout.projected, axis=2)
    given = np.full(len(distance), NOBODY)
    rows, columns = linear_sum_assignment(distance)
    given[rows] = columns
    return given


def by_margin(log_ratio: Array) -> Columns:
    """The pairs of the likeliest matching without which the likeliest matching is much less likely."""
    gain = np.maximum(log_ratio, 0.0)  # a pair that does not gain is left out
    rows, columns = linear_sum_assignment(gain, maximize=True)
    best = gain[rows, columns].sum()
    given = np.full(len(gain), NOBODY)
    for row, column in zip(rows, columns, strict=True):
        here, gain[row, column] = gain[row, column], 0.0
        second = gain[linear_sum_assignment(gain, maximize=True)].sum()
        gain[row, column] = here
        if best - second >= math.log(PROBABILITY / (1.0 - PROBABILITY)):
            given[row] = column
    return given


def by_probability(probability: Array) -> Columns:
    """What is likely enough."""
    return np.where(probability.max(axis=1) >= PROBABILITY, probability.argmax(axis=1), NOBODY)


def log_ratios_of(layout: Layout, prior: Prior) -> Array:
    """log (n, k) of how much more likely "track i is drone j" is than "i is a stranger, and j is not seen"; −inf
    outside the gate.

    Strangers are a Poisson process, uniform over the image. Nobody's density is thinner than that of a drone which is
    in view with probability `IN_VIEW`, and anywhere in it.
    """
    log_area = math.log(CAMERA.width * CAMERA.height)
    distance = ((layout.tracks[:, None] - layout.projected) ** 2).sum(axis=2) / layout.variance
    log_extent = min(LOG_TWO_PI + math.log(layout.variance), log_area - math.log(IN_VIEW))
    log_density = np.where(distance > gate_threshold(GATE_PROBABILITY), -np.inf, -0.5 * distance - log_extent)
    return np.asarray(log_density + log_area + prior.log_ratio)


def priors_of(sky: Sky) -> dict[str, Prior]:
    """What the posterior is tried with, by the method's name."""
    return {"posterior": PRIOR} | ({"posterior, told": sky.told} if sky.told else {})


def play(cell: Cell, first: int, last: int) -> Chunk:
    """All methods on layouts first … last − 1 of a cell."""
    judged: dict[str, list[tuple[int, int, bool]]] = {}
    stated: dict[str, list[Stated]] = {}
    sizes = []
    for k in range(first, last):
        layout = draw(cell, k)
        ratios = {name: log_ratios_of(layout, prior) for name, prior in priors_of(cell.sky).items()}
        given = {
            "argmin": by_argmin(layout),
            "Hungarian": by_distance(layout),
            "margin": by_margin(ratios["posterior"]),
        }
        for name, log_ratio in ratios.items():
            probability = matching_marginals(log_ratio)
            given[name] = by_probability(probability)
            stated.setdefault(name, []).append(_stated(probability, layout.truth, k))
        for name, columns in given.items():
            judged.setdefault(name, []).append(_judged(columns, layout.truth))
        ours, most = ratios["posterior"], MARGINALS_MOST_OPEN_ROWS
        wide = min(ours.shape) > most and sweep_width(ours) > most
        sizes.append((len(layout.truth), int((layout.truth != NOBODY).sum()), wide))
    tracks, team, left_out = np.array(sizes, float).T
    return Chunk(
        cell,
        tracks,
        team,
        left_out,
        {name: Outcome(*np.array(found, float).T) for name, found in judged.items()},
        {name: Stated.joined(parts) for name, parts in stated.items()},
    )


def _stated(probability: Array, truth: Columns, k: int) -> Stated:
    """The pairs of layout k that are likelier than not."""
    rows, columns = np.nonzero(probability >= 0.5)
    return Stated(probability[rows, columns], truth[rows] == columns, np.full(len(rows), k))


def _judged(given: Columns, truth: Columns) -> tuple[int, int, bool]:
    """How many are wrong, how many of the team unknown, and whether somebody's ID was given twice."""
    named = given != NOBODY
    wrong = int((named & (given != truth)).sum())
    unknown = int((~named & (truth != NOBODY)).sum())
    return wrong, unknown, len(np.unique(given[named])) < int(named.sum())


class Method(NamedTuple):
    """Of a cell: wrong of all tracks, unknown of the team's, duplicate of the layouts."""

    wrong: Interval
    unknown: Interval
    duplicate: Interval


def scores(chunks: Sequence[Chunk]) -> dict[str, Method]:
    """Every method on one cell."""
    tracks = np.concatenate([chunk.tracks for chunk in chunks])
    team = np.concatenate([chunk.team for chunk in chunks])
    found = {}
    for name in chunks[0].outcomes:
        outcomes = [chunk.outcomes[name] for chunk in chunks]
        wrong, unknown, duplicate = (
            np.concatenate([getattr(outcome, count) for outcome in outcomes])
            for count in ("wrong", "unknown", "duplicate")
        )
        found[name] = Method(
            fraction_interval(wrong, tracks, PAIRED),
            fraction_interval(unknown, team),
            fraction_interval(duplicate, np.ones(len(duplicate))),
        )
    return found


class Thinned(NamedTuple):
    """Layouts whose sweep is `MARGINALS_MOST_OPEN_ROWS` + 1 … `COMPARED_WIDTH` rows wide: what leaving pairs out and
    what belief propagation alone make of them, beside the exact marginals.

    off: of the layouts, the largest error of a probability, median and worst; given, wrong: IDs, of `tracks`.
    """

    prior: str
    layouts: int
    tracks: int
    off: dict[str, tuple[float, float]]
    given: dict[str, int]
    wrong: dict[str, int]


def thinned(cell: Cell, prior_name: str, layouts: int, limit: int) -> Thinned:
    """The first `limit` of so many layouts of a cell that are too wide, but not by much."""
    prior = priors_of(cell.sky)[prior_name]
    off: dict[str, list[float]] = {"pairs left out": [], "beliefs alone": []}
    given, wrong = (dict.fromkeys(("exact", *off), 0) for _ in range(2))
    tracks = 0
    for k in range(layouts):
        layout = draw(cell, k)
        log_ratio = log_ratios_of(layout, prior)
        if not MARGINALS_MOST_OPEN_ROWS < sweep_width(log_ratio) <= COMPARED_WIDTH:
            continue
        exact = matching_marginals(log_ratio, COMPARED_WIDTH)
        found = {
            "exact": exact,
            "pairs left out": matching_marginals(log_ratio),
            "beliefs alone": marginals.beliefs(log_ratio),
        }
        tracks += len(layout.truth)
        for name, probability in found.items():
            columns = by_probability(probability)
            given[name] += int((columns != NOBODY).sum())
            wrong[name] += _judged(columns, layout.truth)[0]
            if name != "exact":
                off[name].append(float(np.abs(probability - exact).max()))
        if len(off["beliefs alone"]) == limit:
            break
    far = {name: (float(np.median(o)), max(o)) if o else (math.nan, math.nan) for name, o in off.items()}
    return Thinned(prior_name, len(off["beliefs alone"]), tracks, far, given, wrong)


class Cost(NamedTuple):
    """Of one posterior, from tracks and projections to probabilities: milliseconds."""

    drones: int
    error_px: float
    median_ms: float
    p95_ms: float


def cost(drones: int, error_px: float, layouts: int) -> Cost:
    """Alone on one core, by the stopwatch."""
    cell = Cell(COMPLETE, drones, error_px)
    taken = []
    for k in range(layouts):
        layout = draw(cell, k)
        start = time.perf_counter()
        matching_marginals(log_ratios_of(layout, PRIOR))
        taken.append(1e3 * (time.perf_counter() - start))
    return Cost(drones, error_px, float(np.median(taken)), float(np.percentile(taken, 95)))


class Pool(NamedTuple):
    """Whose statements are judged together: of one method under one sky, with one error or (None) with all."""

    sky: str
    method: str
    error_px: float | None


class Result(NamedTuple):
    """What was found. left_out: of a cell's layouts, those whose sweep was too wide."""

    layouts: int
    cells: dict[Cell, dict[str, Method]]
    left_out: dict[Cell, float]
    calibrations: dict[Pool, Reliability]
    thinned: list[Thinned]
    costs: list[Cost]
