"""Trains a second stage (`swarmtrack.detection.second_stage`): a classifier of a detector's candidates.

Theory of operation. A training first collects candidates, in labelled pictures, clips and drawn pictures
(`candidates`), then learns to tell their kinds apart: drones, each kind of look-alike, and all else. Half of a batch
are drones. What is no drone is taken by kind, then by clip, and only then by frame, so that no long clip outweighs
others. Each is turned, enlarged, and photographed again each time. Last, what the stage says of candidates that were
held out is fitted together with the detector's own scores by logistic regression.

With them it learns how wide drones are: from simulated ones, whose span is known, and less from real ones, of which
only what is visible is known.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor, nn
from torch.nn import functional

from swarmtrack.clock import SystemClock
from swarmtrack.detection.odds import logit, probability
from swarmtrack.detection.second_stage import SECOND_STAGE_HEAD, square
from swarmtrack.lab.score.detector_score import Matches
from swarmtrack.training import render
from swarmtrack.training.candidates import DRAWN, DRONE_CLASS, KEPT_AROUND, KEPT_SIDE_PX, OTHER, Candidate
from swarmtrack.training.export import write_onnx
from swarmtrack.training.feeding import TrainingError
from swarmtrack.training.layers import convolution
from swarmtrack.training.simulated_pictures import SIMULATED
from swarmtrack.training.trainer import REPORT_PERIOD, average_into

SIDE = 64  # px of its input
AROUND = 1.6  # longer sides of the box that it is shown
SECOND_STAGE_AVERAGING = 0.998  # per step
SPAN_MAPS, SPAN_HIDDEN = 24, 48
SECOND_STAGE_WARM_UP = 200  # steps until the full learning rate
WEIGHT_DECAY = 0.05
SMOOTHING = 0.02  # of the labels: some are wrong
FEWEST_CANDIDATES = 20  # held-out candidates of drones, and of what is none, that scores can be fitted to
UNFITTED = (0.7, -1.0)  # weight and offset where nothing was held out
GHOST = 4.0  # drones overlooked that are as bad as one ghost
SECOND_STAGE_DOUBT_LOG_ODDS = 0.3  # log odds by which what confirms a track is below the score
KEEPS = 0.99  # of the held-out drones that the detector found: how many pass the threshold
SECOND_STAGE_THRESHOLDS = (0.1, 0.4)  # at least, and at most
HALF_SIDE = SIDE / 2  # px: spans are answered as multiples of that, by their logarithm
LINEAR = 0.1  # error of that logarithm from which on it counts linearly, not by its square
OF_THE_LOSS = 4.0  # what that error counts, beside the kinds
VISIBLE = 0.3  # what a real drone counts beside a simulated one


@dataclass(frozen=True, slots=True)
class StageSettings:
    """How it is trained. drawn, simulated: shares of a kind's candidates that are of such pictures, if it has any;
    measured: drones of known span that are added to a batch."""

    iterations: int = 4500
    seed: int = 0
    batch: int = 96
    learning_rate: float = 2e-3
    drawn: float = 0.3
    simulated: float = 0.15
    measured: int = 32


Chances = NDArray[np.float64]


class Fusion(NamedTuple):
    """logit(score') = logit(score) + weight · log_odds + offset."""

    weight: float
    offset: float


class Trained(NamedTuple):
    """fusion; alone, together: average precision of the detector's scores on candidates that were held out, and of both
    stages' scores; None where none were."""

    fusion: Fusion
    alone: float | None
    together: float | None


class Network(nn.Module):
    """forward: squares (n, 3, SIDE, SIDE), 0…255 → logits (n, kinds), drones first; log of span over `HALF_SIDE`
    (n,)."""

    def __init__(self, kinds: int, widths: tuple[int, ...] = (16, 32, 56, 80)) -> None:
        super().__init__()
        layers: list[nn.Module] = [convolution(3, widths[0], stride=2), nn.ReLU()]
        for inputs, width in pairwise(widths):
            layers += [convolution(inputs, width, stride=2), nn.ReLU(), convolution(width, width), nn.ReLU()]
        self.features = nn.Sequential(*layers)
        self.dropout = nn.Dropout(0.3)
        self.kinds = nn.Linear(2 * widths[-1], kinds)
        # Where something is tells how wide it is: no pooling.
        cells = (SIDE >> len(widths)) ** 2
        self.span = nn.Sequential(
            nn.Conv2d(widths[-1], SPAN_MAPS, 1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(SPAN_MAPS * cells, SPAN_HIDDEN),
            nn.ReLU(),
            nn.Linear(SPAN_HIDDEN, 1),
        )

    def forward(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        y = self.features(squares / 255 - 0.5)
        pooled = torch.cat([y.mean(dim=(2, 3)), y.amax(dim=(2, 3))], dim=1)
        return self.kinds(self.dropout(pooled)), self.span(y)[:, 0]


class _InFlight(nn.Module):
    """As it flies: log odds (n,) of being a drone, and the span (n,) as a share of the square's side; means of looks at
    each square and at its mirror image."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, squares: Tensor) -> tuple[Tensor, Tensor]:
        logits, log_span = self.network(torch.cat([squares, squares.flip(3)]))
        log_odds = logits[:, 0] - torch.logsumexp(logits[:, 1:], dim=1)
        span = torch.exp(log_span.reshape(2, -1).mean(dim=0)) * (HALF_SIDE / SIDE)
        return log_odds.reshape(2, -1).mean(dim=0), span


class _Batch(NamedTuple):
    """squares (n, 3, SIDE, SIDE); kinds (m,) of the first m ≤ n, by their place among the kinds; log_spans (n,) over
    `HALF_SIDE`, and what each counts (n,), zero where nobody knows."""

    squares: Tensor
    kinds: Tensor
    log_spans: Tensor
    trust: Tensor


class _Pools:
    """Candidates by kind and source, and batches of them."""

    def __init__(
        self, candidates: Iterable[Candidate], settings: StageSettings, rng: np.random.Generator
    ) -> None:
        self._settings, self._rng = settings, rng
        self._pools: dict[str, dict[str, list[Candidate]]] = {}
        for candidate in candidates:
            self._pools.setdefault(candidate.kind, {}).setdefault(candidate.source, []).append(candidate)
        self.kinds = [DRONE_CLASS, *sorted(self._pools.keys() - {DRONE_CLASS})]
        if len(self.kinds) < 2 or DRONE_CLASS not in self._pools:
            raise TrainingError(
                f"candidates are {', '.join(self._pools) or 'none'}, expected drones and non-drones"
            )
        others = max(len(self.kinds) - 2, 1)
        weights = np.array([{DRONE_CLASS: 4.0, OTHER: 2.0}.get(kind, 2.0 / others) for kind in self.kinds])
        self._shares = weights / weights.sum()
        """Of the kinds: half are drones, a quarter is nothing that flies."""
        self._groups = {kind: self._grouped(pool) for kind, pool in self._pools.items()}
        self._measured = [
            each for each in self._pools[DRONE_CLASS].get(SIMULATED, ()) if math.isfinite(each.span)
        ]

    def batch(self) -> _Batch:
        rng, told = self._rng, self._settings
        kinds = rng.choice(len(self.kinds), told.batch, p=self._shares)
        picked = [self._pick(self.kinds[kind]) for kind in kinds]
        if self._measured:
            picked += [self._measured[k] for k in rng.integers(len(self._measured), size=told.measured)]
        shown = [augmented(rng, each.picture) for each in picked]
        spans = [each.span * scale for each, (_, scale) in zip(picked, shown, strict=True)]
        trust = [1.0 if each.source == SIMULATED else VISIBLE for each in picked]
        known = np.isfinite(spans)
        return _Batch(
            _as_input([square for square, _ in shown]),
            torch.from_numpy(kinds),
            torch.tensor(np.log(np.where(known, spans, HALF_SIDE) / HALF_SIDE), dtype=torch.float32),
            torch.tensor(np.where(known, trust, 0.0), dtype=torch.float32),
        )

    def _pick(self, kind: str) -> Candidate:
        rng, pool = self._rng, self._pools[kind]
        groups, chances = self._groups[kind]
        sources = groups[rng.choice(len(groups), p=chances)]
        some = pool[sources[rng.integers(len(sources))]]
        return some[rng.integers(len(some))]

    def _grouped(self, sources: Iterable[str]) -> tuple[list[list[str]], Chances]:
        """The clips, what is drawn and what is simulated, as far as there are any, and how often each is taken."""
        told = self._settings
        shares = {DRAWN: told.drawn, SIMULATED: told.simulated}
        clips = [source for source in sources if source not in shares]
        groups = [([made], share) for made, share in shares.items() if made in sources]
        if clips:
            groups.append((clips, 1.0 - told.drawn - told.simulated))
        chances = np.array([share for _, share in groups])
        return [names for names, _ in groups], chances / chances.sum()


def train(
    candidates: Iterable[Candidate],
    validation: Sequence[Candidate],
    settings: StageSettings,
    out: Path,
    metadata: dict[str, str],
) -> Trained:
    """Train on candidates, fit the scores on those held out, and write `out` (ONNX)."""
    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    pools = _Pools(candidates, settings, np.random.default_rng(settings.seed))
    network, average = (Network(len(pools.kinds)) for _ in range(2))
    average.load_state_dict(network.state_dict())
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=WEIGHT_DECAY)
    clock = SystemClock()
    began = reported = clock.now()
    for step in range(settings.iterations):
        fall = 0.5 + 0.5 * math.cos(math.pi * step / settings.iterations)
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * min(1.0, (step + 1) / SECOND_STAGE_WARM_UP) * fall
        loss = _loss(network, pools.batch())
        if not torch.isfinite(loss):
            raise TrainingError(f"step {step}: the loss is {loss.item()}; lower --learning-rate")
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        average_into(average, network, min(SECOND_STAGE_AVERAGING, (1 + step) / (10 + step)))
        if clock.now() - reported > REPORT_PERIOD:
            reported = clock.now()
            minutes, done = (reported - began) / 60, (step + 1) / settings.iterations
            print(f"{minutes:5.1f} min  {done:4.0%}  loss {loss.item():.3f}", file=sys.stderr, flush=True)
    deployed = _InFlight(average).eval()
    held_out = _held_out(validation)
    log_odds = _log_odds(deployed, validation)
    fusion = fit(validation, log_odds)
    together = held_out.odds + fusion.weight * log_odds + fusion.offset
    told = {
        "head": SECOND_STAGE_HEAD,
        "around": str(AROUND),
        "fusion": json.dumps([round(number, 4) for number in fusion]),
        "doubt": str(SECOND_STAGE_DOUBT_LOG_ODDS),
        "score_threshold": f"{_threshold(held_out, together):.3f}",
        "kinds": json.dumps(pools.kinds),
        "recipe": json.dumps(asdict(settings)),
    }
    free = {name: {0: "candidates"} for name in ("squares", "log_odds", "span")}
    write_onnx(deployed, torch.zeros(2, 3, SIDE, SIDE), out, free, {**told, **metadata})
    if not validation:
        return Trained(fusion, None, None)
    return Trained(fusion, *(_average_precision(held_out, odds) for odds in (held_out.odds, together)))


def _loss(network: nn.Module, batch: _Batch) -> Tensor:
    logits, log_spans = network(batch.squares)
    by_kind = functional.cross_entropy(logits[: len(batch.kinds)], batch.kinds, label_smoothing=SMOOTHING)
    errors = functional.smooth_l1_loss(log_spans, batch.log_spans, beta=LINEAR, reduction="none")
    by_span = (batch.trust * errors).sum() / batch.trust.sum().clamp(min=1.0)
    return by_kind + OF_THE_LOSS * by_span


def fit(validation: Sequence[Candidate], log_odds: NDArray[np.float64]) -> Fusion:
    """Weight and offset by maximum likelihood, what is no drone counting `GHOST` times as much as drones; of candidates
    (n) that the detector found, and what the stage says of them (n,)."""
    seen, drone, odds = _held_out(validation)
    if min((seen & drone).sum(), (seen & ~drone).sum()) < FEWEST_CANDIDATES:
        return Fusion(*UNFITTED)
    odds, x, y = odds[seen], log_odds[seen], drone[seen]
    weights = np.where(y, 1.0 / y.sum(), GHOST / (~y).sum())

    def surprise(p: NDArray[np.float64]) -> float:
        z = p[0] * (odds + p[1] * x + p[2])
        return float((weights * (np.logaddexp(0.0, z) - y * z)).sum())

    bounds = [(1e-3, 1e3), (0.0, 1e2), (None, None)]
    _, weight, offset = minimize(surprise, np.array([1.0, *UNFITTED]), bounds=bounds).x.tolist()
    return Fusion(weight, offset)


class _HeldOut(NamedTuple):
    """Of n candidates: whether the detector found them, whether they are drones, and the logits of its scores."""

    seen: NDArray[np.bool_]
    drone: NDArray[np.bool_]
    odds: NDArray[np.float64]


def _held_out(candidates: Sequence[Candidate]) -> _HeldOut:
    score = np.array([candidate.score for candidate in candidates])
    drone = np.array([candidate.kind == DRONE_CLASS for candidate in candidates], np.bool_)
    return _HeldOut(score > 0.0, drone, logit(score))


def _threshold(held_out: _HeldOut, odds: NDArray[np.float64]) -> float:
    """The score from which on a detection is shown; odds (n,): of both stages."""
    drones = odds[held_out.seen & held_out.drone]
    if len(drones) < FEWEST_CANDIDATES:
        return SECOND_STAGE_THRESHOLDS[1]
    return float(np.clip(probability(float(np.quantile(drones, 1.0 - KEEPS))), *SECOND_STAGE_THRESHOLDS))


def _average_precision(held_out: _HeldOut, odds: NDArray[np.float64]) -> float:
    """By odds (n,); drones that the detector overlooked are missed."""
    seen, drone, _ = held_out
    order = np.flatnonzero(seen)[np.argsort(-odds[seen], kind="stable")]
    unknown = np.full(len(order), np.nan)
    return Matches(odds[order], drone[order], unknown, unknown, np.zeros(drone.sum()), 1).average_precision()


def augmented(rng: np.random.Generator, picture: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """(SIDE, SIDE, 3): the middle of a candidate's picture as another camera might have shown it; and how much larger
    things are in it."""
    scale = SIDE / KEPT_SIDE_PX * KEPT_AROUND / AROUND * math.exp(rng.uniform(math.log(0.8), math.log(1.25)))
    middle = (KEPT_SIDE_PX - 1) / 2
    turn = cv2.getRotationMatrix2D((middle, middle), rng.normal(0.0, 8.0), scale)
    shift = (SIDE - 1) / 2 - middle + rng.normal(0.0, 2.5, 2)
    turn = turn + np.column_stack([np.zeros((2, 2)), shift])
    seen = cv2.warpAffine(picture, turn, (SIDE, SIDE), borderMode=cv2.BORDER_REPLICATE)
    if rng.random() < 0.5:
        seen = seen[:, ::-1]
    if rng.random() < 0.2:
        few = int(rng.integers(SIDE // 4, SIDE * 3 // 4))
        fewer = cv2.resize(seen, (few, few), interpolation=cv2.INTER_AREA)
        seen = cv2.resize(fewer, (SIDE, SIDE), interpolation=cv2.INTER_LINEAR)
    return render.photograph(rng, np.asarray(seen, np.float32)), scale


def _as_input(squares: Sequence[NDArray[np.uint8]]) -> Tensor:
    return torch.from_numpy(np.stack(squares)).permute(0, 3, 1, 2).float()


@torch.no_grad()
def _log_odds(deployed: nn.Module, candidates: Sequence[Candidate]) -> NDArray[np.float64]:
    """(n,) of these, as the agent will see them."""
    middle, side = np.full(2, (KEPT_SIDE_PX - 1) / 2), KEPT_SIDE_PX * AROUND / KEPT_AROUND
    squares = [square(candidate.picture, middle, side, SIDE) for candidate in candidates]
    parts = [deployed(_as_input(squares[i : i + 256]))[0] for i in range(0, len(squares), 256)]
    return torch.cat(parts).double().numpy() if parts else np.empty(0)
