"""Batches, drawn by processes of their own while the trainer computes.

Each generator draws from its own seed into a queue of its own, and the trainer takes one batch from each in turn: so
the order of samples does not depend on which process is quicker.
"""

from __future__ import annotations

import multiprocessing
import queue
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.queues import Queue
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.errors import SwarmtrackError
from swarmtrack.training import dataset
from swarmtrack.training.dataset import STRIDE, Recipe, SampleSource
from swarmtrack.training.labelled_images import LabelledFrame

Batch = tuple[NDArray[Any], ...]
"""Images (size, crop, crop, 3) uint8 BGR, then the fields of `Targets`, each with a leading batch axis."""

BATCHES_AHEAD = 6  # batches that a generator may be ahead of the trainer
# s without a batch: the generator is dead or the machine is; the first waits for all cut-outs.
TIMEOUT = 300.0


class TrainingError(SwarmtrackError):
    """Training that cannot go on."""


class BatchSource:
    """Draws batches by a recipe: `batch` crops, or now and then a quarter as many close-ups, as many pixels."""

    def __init__(self, frames: Sequence[LabelledFrame], recipe: Recipe, batch: int, rng: np.random.Generator):
        self._rng, self._batch, self._recipe = rng, batch, recipe
        self._usual = SampleSource(frames, recipe, rng)
        self._near = SampleSource(frames, recipe.of_close_ups(), rng) if recipe.close_up > 0 else None

    def draw(self) -> Batch:
        if self._near is not None and self._rng.random() < self._recipe.close_up:
            return _batch(self._near, 2 * self._recipe.crop, max(1, self._batch // 4))
        return _batch(self._usual, self._recipe.crop, self._batch)


def _batch(source: SampleSource, crop: int, size: int) -> Batch:
    samples = [source.sample() for _ in range(size)]
    wanted = [dataset.targets(s.drones, crop, STRIDE, s.doubtful, s.others) for s in samples]
    images = np.stack([sample.image for sample in samples])
    return (images, *(np.stack(field) for field in zip(*wanted, strict=True)))


def _generate(
    out: Queue[Batch], frames: Sequence[LabelledFrame], recipe: Recipe, batch: int, seed: tuple[int, ...]
) -> None:
    cv2.setNumThreads(1)
    source = BatchSource(frames, recipe, batch, np.random.default_rng(seed))
    trainer = multiprocessing.parent_process()
    drawn = source.draw()
    while trainer is not None and trainer.is_alive():  # a killed trainer cannot end its generators
        try:
            out.put(drawn, timeout=5.0)
        except queue.Full:
            continue
        drawn = source.draw()
    out.cancel_join_thread()


@contextmanager
def generators(
    frames: Sequence[LabelledFrame], recipe: Recipe, batch: int, seed: tuple[int, ...], processes: int
) -> Iterator[Iterator[Batch]]:
    """Generator processes, and an endless iterator over their batches in a fixed order."""
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    queues: list[Queue[Batch]] = [context.Queue(BATCHES_AHEAD) for _ in range(processes)]
    children = [
        context.Process(target=_generate, args=(out, frames, recipe, batch, (*seed, i)), daemon=True)
        for i, out in enumerate(queues)
    ]
    for child in children:
        child.start()

    def batches() -> Iterator[Batch]:
        while True:
            for out in queues:
                try:
                    yield out.get(timeout=TIMEOUT)
                except queue.Empty:
                    raise TrainingError(f"no batch came for {TIMEOUT:.0f} s: a generator died") from None

    try:
        yield batches()
    finally:
        for child in children:
            child.terminate()
            child.join()
