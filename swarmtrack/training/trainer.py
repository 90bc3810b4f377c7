"""Trains a net on samples that are drawn while it learns: no sample is ever seen twice.

Theory of operation. Generator processes draw batches (`feeding`); on a CPU one thread computes: for so small a net a
second one costs more than it brings, and its core is better spent on drawing. Weights are averaged (exponential moving
average), and the average is what is written, looked at on the validation images, and exported. Every few minutes a
checkpoint is written from which an interrupted training goes on.
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
import math
import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from swarmtrack.clock import SystemClock
from swarmtrack.training import dataset
from swarmtrack.training.dataset import Recipe
from swarmtrack.training.export import export
from swarmtrack.training.feeding import TrainingError, generators
from swarmtrack.training.labelled_images import LabelledFrame
from swarmtrack.training.network import create_network, loss
from swarmtrack.training.validation import look, scores
from swarmtrack.training.warm_start import adopt

DETECTOR_AVERAGING = 0.9995  # per step, of the exported weights: a memory of about 2000 steps
DETECTOR_WARM_UP = 300  # steps until the full learning rate
MEASURED = 4  # batches on which the normalisations of a model to start with are measured
REPORT_PERIOD = 20.0  # s
LOSS_NAMES = ("heat", "offset", "size")


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
    device: str = "cpu"
    checkpoint_minutes: float = 5.0


@dataclass(slots=True)
class TrainingProgress:
    """Where a training stands; what a checkpoint holds in addition to the weights."""

    steps: int = 0
    images: int = 0
    seconds: float = 0.0
    resumed: int = 0
    history: list[dict[str, float]] = field(default_factory=list)


def train(
    frames: Sequence[LabelledFrame],
    recipe: Recipe,
    settings: Settings,
    out: Path,
    *,
    licence: str,
    validation: Sequence[LabelledFrame] = (),
    start: Path | None = None,
    resume: bool = False,
) -> TrainingProgress:
    """Train, write `out` (ONNX) and next to it the checkpoint (`.pt`, to go on from); returns how it went.

    validation: images that are not trained on; the history tells how well each checkpoint does on them.
    """
    training = _Training(frames, recipe, settings, out, licence=licence, validation=validation)
    return training.run(start, resume)


class _Training:
    def __init__(
        self,
        frames: Sequence[LabelledFrame],
        recipe: Recipe,
        settings: Settings,
        out: Path,
        *,
        licence: str,
        validation: Sequence[LabelledFrame],
    ) -> None:
        if (settings.minutes is None) == (settings.iterations is None):
            raise TrainingError("give either minutes or iterations")
        self._frames, self._recipe, self._settings, self._out = frames, recipe, settings, out
        self._validation = validation
        torch.manual_seed(settings.seed)
        torch.set_num_threads(1)
        self._network = create_network(settings.network).to(settings.device)
        self._metadata = {
            "recipe": json.dumps({**dataclasses.asdict(recipe), **dataclasses.asdict(settings)}),
            "seed": str(settings.seed),
            "data_sha256": dataset.data_hash(frames),
            "data_frames": str(len(frames)),
            "licence": licence,
        }
        self._run = TrainingProgress()
        self._clock = SystemClock()

    def run(self, start: Path | None, resume: bool) -> TrainingProgress:
        network, settings, run = self._network, self._settings, self._run
        self._average = copy.deepcopy(network).eval()
        network.to(memory_format=torch.channels_last).train()  # type: ignore[call-overload]
        self._optimizer = torch.optim.AdamW(network.parameters(), settings.learning_rate, weight_decay=1e-4)
        if resume:
            self._restore()
        recent: deque[list[float]] = deque(maxlen=100)
        # A resumed training draws other samples than those that it has seen.
        seed = (settings.seed, run.resumed) if run.resumed else (settings.seed,)
        with generators(self._frames, self._recipe, settings.batch, seed, settings.generators) as batches:
            batch = next(batches)  # the generators draw their first sprites: no time to learn in
            if start is not None:
                self._begin_with(start, [batch, *(next(batches) for _ in range(MEASURED - 1))])
            before, began = run.seconds, self._clock.now()
            reported = saved = began
            while (done := self._done()) < 1.0:
                recent.append(self._step(batch, done))
                batch = next(batches)
                now = self._clock.now()
                run.seconds = before + now - began
                if now - reported > REPORT_PERIOD:
                    reported = now
                    self._report(done, np.mean(recent, axis=0))
                if now - saved > 60 * settings.checkpoint_minutes:
                    self._save(np.mean(recent, axis=0))
                    saved = self._clock.now()
        self._save(np.mean(recent, axis=0) if recent else np.full(len(LOSS_NAMES), math.nan))
        return run

    def _begin_with(self, start: Path, batches: Sequence[tuple[Any, ...]]) -> None:
        """The weights of a checkpoint, or of an exported model, whose normalisations are measured on the batches."""
        if start.suffix == ".onnx":
            usual = [batch[0] for batch in batches if batch[0].shape[1] == self._recipe.crop]
            adopt(self._network, start, _pictures(torch.from_numpy(np.concatenate(usual or [batches[0][0]]))))
        else:
            self._network.load_state_dict(read_checkpoint(start)["average"])
        self._average.load_state_dict(self._network.state_dict())
        self._metadata["warm_start"] = start.name
        self._metadata["warm_start_sha256"] = hashlib.sha256(start.read_bytes()).hexdigest()

    def _done(self) -> float:
        if self._settings.iterations is not None:
            return self._run.steps / self._settings.iterations
        assert self._settings.minutes is not None
        return self._run.seconds / (60 * self._settings.minutes)

    def _step(self, batch: tuple[Any, ...], done: float) -> list[float]:
        """One batch; returns the losses."""
        settings, run = self._settings, self._run
        images, *wanted = (torch.from_numpy(array).to(settings.device) for array in batch)
        rate = (
            settings.learning_rate
            * min(1.0, (run.steps + 1) / DETECTOR_WARM_UP)
            * (0.5 + 0.5 * math.cos(math.pi * done))
        )
        for group in self._optimizer.param_groups:
            group["lr"] = rate + 1e-5
        pictures = _pictures(images)
        with torch.autocast(settings.device, dtype=torch.bfloat16):
            answers = self._network(pictures)
        heat, offset, size = loss(answers, tuple(wanted))
        total = heat + offset + 0.5 * size
        if not torch.isfinite(total):
            raise TrainingError(f"step {run.steps}: the loss is {total.item()}; lower --learning-rate")
        self._optimizer.zero_grad()
        total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), 10.0)
        self._optimizer.step()
        average_into(
            self._average, self._network, min(DETECTOR_AVERAGING, (1 + run.steps) / (10 + run.steps))
        )
        run.steps += 1
        run.images += len(images)
        return [heat.item(), offset.item(), size.item()]

    def _report(self, done: float, losses: Any) -> None:
        run = self._run
        values = " ".join(f"{name} {value:.3f}" for name, value in zip(LOSS_NAMES, losses, strict=True))
        speed = run.images / run.seconds
        print(
            f"{run.seconds / 60:5.1f} min  {done:4.0%}  step {run.steps}  {speed:.0f} images/s  {values}",
            file=sys.stderr,
            flush=True,
        )

    def _save(self, losses: Any) -> None:
        """The model, what it does on the validation images, and the checkpoint; each appears whole or not at all."""
        run = self._run
        self._metadata["images_seen"] = str(run.images)
        self._metadata["training_minutes"] = f"{run.seconds / 60:.1f}"
        export(copy.deepcopy(self._average).cpu(), self._out, self._metadata)
        entry = {"minutes": run.seconds / 60, "images": float(run.images)}
        entry |= dict(zip(LOSS_NAMES, (float(value) for value in losses), strict=True))
        if self._validation:
            entry |= scores(look(self._out, self._validation))
            told = "  ".join(f"{name} {value:.3f}" for name, value in entry.items() if name not in LOSS_NAMES)
            print(f"checkpoint: {told}", file=sys.stderr, flush=True)
        run.history.append(entry)
        document = {
            "architecture": self._settings.network,
            "network": self._network.state_dict(),
            "average": self._average.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "run": dataclasses.asdict(run),
            "metadata": dict(self._metadata),
        }
        partial = self._out.with_suffix(".pt.partial")
        torch.save(document, partial)
        partial.replace(self._out.with_suffix(".pt"))

    def _restore(self) -> None:
        """Go on where the checkpoint stands."""
        path = self._out.with_suffix(".pt")
        found = read_checkpoint(path)
        for key in ("data_sha256", "seed"):
            if found["metadata"][key] != self._metadata[key]:
                raise TrainingError(
                    f"{path}: {key} {found['metadata'][key]}, expected {self._metadata[key]}: another training"
                )
        if found["architecture"] != self._settings.network:
            raise TrainingError(
                f"{path}: network {found['architecture']}, expected {self._settings.network}: another training"
            )
        self._network.load_state_dict(found["network"])
        self._average.load_state_dict(found["average"])
        self._optimizer.load_state_dict(found["optimizer"])
        for name, value in found["run"].items():
            setattr(self._run, name, value)
        self._run.resumed += 1


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a `.pt` that `train` wrote: architecture, network, average, optimizer, run, metadata."""
    try:
        found: Any = torch.load(path, weights_only=True, map_location="cpu")
    except Exception as error:  # torch raises whatever its archive reader and unpickler happen to meet
        raise TrainingError(f"{path}: not a checkpoint: {type(error).__name__}") from None
    wanted = {"architecture", "network", "average", "optimizer", "run", "metadata"}
    if not isinstance(found, dict) or not wanted <= found.keys():
        raise TrainingError(f"{path}: not a checkpoint of swarmtrack train")
    return found


def averaged_network(checkpoint: dict[str, Any]) -> torch.nn.Module:
    network = create_network(checkpoint["architecture"])
    network.load_state_dict(checkpoint["average"])
    return network.eval()


def _pictures(images: torch.Tensor) -> torch.Tensor:
    """(n, h, w, 3) BGR 0…255, as drawn → (n, 3, h, w) 0…1, as a net takes them."""
    return (images.permute(0, 3, 1, 2).float() / 255).contiguous(memory_format=torch.channels_last)


@torch.no_grad()
def average_into(average: torch.nn.Module, network: torch.nn.Module, memory: float) -> None:
    """average ← memory · average + (1 − memory) · network, running statistics of batch norm included."""
    theirs = network.state_dict()
    for name, value in average.state_dict().items():
        if value.is_floating_point():
            value.lerp_(theirs[name], 1 - memory)
        else:
            value.copy_(theirs[name])
