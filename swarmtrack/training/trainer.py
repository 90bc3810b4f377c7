"""Trains a net on samples that are drawn while it learns: no sample is ever seen twice.

Theory of operation. Generator processes draw batches, each from its own seed, into queues of its own; the trainer takes
one from each in turn, so the order of samples does not depend on which process is quicker. One thread computes: for so
small a net a second one costs more than it brings, and its core is better spent on drawing. Weights are averaged
(exponential moving average) and the average is what is exported.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import multiprocessing
import queue
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from swarmtrack.errors import SwarmtrackError
from swarmtrack.runtime.clock import SystemClock
from swarmtrack.training import dataset
from swarmtrack.training.dataset import Recipe, SampleSource
from swarmtrack.training.export import export
from swarmtrack.training.labelled_images import LabelledFrame
from swarmtrack.training.network import STRIDE, CenterNet, create_network, loss

Batch = tuple[NDArray[Any], ...]

AVERAGING = 0.9995  # per step, of the exported weights: a memory of about 2000 steps
WARM_UP = 300  # steps until the full learning rate
GENERATOR_TIMEOUT = 120.0  # s without a batch: the generator is dead or the machine is


class TrainingError(SwarmtrackError):
    """Training that cannot go on."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How long and how. Either `minutes` or `iterations` ends it; only the latter gives the same weights twice."""

    minutes: float | None = None
    iterations: int | None = None
    seed: int = 0
    batch: int = 32
    learning_rate: float = 2.5e-3
    network: str = "plain"
    generators: int = 1
    checkpoint_minutes: float = 5.0


def train(
    frames: Sequence[LabelledFrame],
    recipe: Recipe,
    settings: Settings,
    out: Path,
    *,
    licence: str,
    start: Path | None = None,
) -> CenterNet:
    """Train, write `out` (ONNX) and beside it the weights (`.pt`, to go on from); returns the averaged net."""
    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)
    network = create_network(settings.network)
    if start is not None:
        network.load_state_dict(torch.load(start, weights_only=True))
    average = copy.deepcopy(network).eval()
    network = network.to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), settings.learning_rate, weight_decay=1e-4)
    metadata = {
        "recipe": json.dumps({**dataclasses.asdict(recipe), **dataclasses.asdict(settings)}),
        "seed": str(settings.seed),
        "data_sha256": dataset.data_hash(frames),
        "data_frames": str(len(frames)),
        "warm_start": start.name if start is not None else "",
        "licence": licence,
    }

    def save() -> None:
        torch.save(average.state_dict(), out.with_suffix(".pt"))
        export(copy.deepcopy(average), out, metadata)

    clock = _Progress(settings)
    recent: deque[list[float]] = deque(maxlen=100)
    with _generators(frames, recipe, settings) as batches:
        while (done := clock.fraction()) < 1.0:
            images, *wanted = (torch.from_numpy(array) for array in next(batches))
            rate = (
                settings.learning_rate
                * min(1.0, (clock.steps + 1) / WARM_UP)
                * (0.5 + 0.5 * np.cos(np.pi * done))
            )
            for group in optimizer.param_groups:
                group["lr"] = rate + 1e-5
            pictures = (images.permute(0, 3, 1, 2).float() / 255).contiguous(
                memory_format=torch.channels_last
            )
            with torch.autocast("cpu", dtype=torch.bfloat16):
                answers = network(pictures)
            heat, offset, size = loss(answers, tuple(wanted))
            total = heat + offset + 0.5 * size
            if not torch.isfinite(total):
                raise TrainingError(f"step {clock.steps}: the loss is {total.item()}; lower --learning-rate")
            optimizer.zero_grad()
            total.backward()  # type: ignore[no-untyped-call]
            torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
            optimizer.step()
            _average_into(average, network, min(AVERAGING, (1 + clock.steps) / (10 + clock.steps)))
            recent.append([heat.item(), offset.item(), size.item()])
            clock.steps += 1
            if clock.report_due():
                values = " ".join(
                    f"{name} {v:.3f}" for name, v in zip(_LOSSES, np.mean(recent, 0), strict=True)
                )
                speed = clock.steps * settings.batch / clock.elapsed()
                print(
                    f"{clock.elapsed() / 60:5.1f} min  {done:4.0%}  step {clock.steps}  {speed:.0f} images/s  {values}",
                    file=sys.stderr,
                    flush=True,
                )
            if clock.checkpoint_due():
                save()
    metadata["images_seen"] = str(clock.steps * settings.batch)
    save()
    return average


_LOSSES = ("heat", "offset", "size")


class _Progress:
    """How far training is, and when to say so."""

    def __init__(self, settings: Settings) -> None:
        if (settings.minutes is None) == (settings.iterations is None):
            raise TrainingError("give either minutes or iterations")
        self.steps = 0
        self._settings = settings
        self._clock = SystemClock()
        self._start = self._reported = self._saved = self._clock.now()

    def elapsed(self) -> float:
        return self._clock.now() - self._start

    def fraction(self) -> float:
        if self._settings.iterations is not None:
            return self.steps / self._settings.iterations
        assert self._settings.minutes is not None
        return self.elapsed() / (60 * self._settings.minutes)

    def report_due(self) -> bool:
        if self._clock.now() - self._reported < 20:
            return False
        self._reported = self._clock.now()
        return True

    def checkpoint_due(self) -> bool:
        if self._clock.now() - self._saved < 60 * self._settings.checkpoint_minutes:
            return False
        self._saved = self._clock.now()
        return True


@torch.no_grad()
def _average_into(average: CenterNet, network: CenterNet, memory: float) -> None:
    """average ← memory · average + (1 − memory) · network, running statistics of batch norm included."""
    theirs = network.state_dict()
    for name, value in average.state_dict().items():
        if value.is_floating_point():
            value.lerp_(theirs[name], 1 - memory)
        else:
            value.copy_(theirs[name])


def draw_batch(source: SampleSource, recipe: Recipe, size: int) -> Batch:
    """Images (size, crop, crop, 3) uint8 BGR, then the fields of `Targets`, each with a leading batch axis."""
    samples = [source.sample() for _ in range(size)]
    wanted = [dataset.targets(sample.drones, recipe.crop, STRIDE, sample.doubtful) for sample in samples]
    images = np.stack([sample.image for sample in samples])
    return (images, *(np.stack(field) for field in zip(*wanted, strict=True)))


def _generate(
    out: Queue[Batch], frames: Sequence[LabelledFrame], recipe: Recipe, batch: int, seed: tuple[int, int]
) -> None:
    cv2.setNumThreads(1)
    source = SampleSource(frames, recipe, np.random.default_rng(seed))
    trainer = multiprocessing.parent_process()
    drawn = draw_batch(source, recipe, batch)
    while trainer is not None and trainer.is_alive():  # a killed trainer cannot end its generators
        try:
            out.put(drawn, timeout=5.0)
        except queue.Full:
            continue
        drawn = draw_batch(source, recipe, batch)
    out.cancel_join_thread()


@contextmanager
def _generators(
    frames: Sequence[LabelledFrame], recipe: Recipe, settings: Settings
) -> Iterator[Iterator[Batch]]:
    """Generator processes, and an endless iterator over their batches in a fixed order."""
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    queues: list[Queue[Batch]] = [context.Queue(6) for _ in range(settings.generators)]
    processes = [
        context.Process(
            target=_generate, args=(out, frames, recipe, settings.batch, (settings.seed, i)), daemon=True
        )
        for i, out in enumerate(queues)
    ]
    for process in processes:
        process.start()

    def batches() -> Iterator[Batch]:
        while True:
            for out in queues:
                try:
                    yield out.get(timeout=GENERATOR_TIMEOUT)
                except queue.Empty:
                    raise TrainingError(
                        f"no batch came for {GENERATOR_TIMEOUT:.0f} s: a generator died"
                    ) from None

    try:
        yield batches()
    finally:
        for process in processes:
            process.terminate()
            process.join()
