"""One network that looks at one image: fitted into its input, run, and read in pixels of the image."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from swarmtrack.clock import Clock
from swarmtrack.detection import letterbox
from swarmtrack.detection.description import Declared, Description, describe
from swarmtrack.detection.heads import Candidates, Output, read, suppress
from swarmtrack.detection.letterbox import Letterbox
from swarmtrack.detection.model import check_input, first_answer, trial_limit
from swarmtrack.detection.odds import logit, probability
from swarmtrack.detection.readings import Trial
from swarmtrack.errors import ModelError
from swarmtrack.messages import Image

TRIAL_SIZE = (256, 128)  # px, where the net's input may have any size: multiples of the coarsest stride


class Seconds(NamedTuple):
    """pre: letterbox and layout; infer: the net; post: decoding and suppression."""

    pre: float
    infer: float
    post: float


class Net:
    """An ONNX session with its pre- and postprocessing. Raises `ModelError` for an unsupported net."""

    def __init__(self, path: Path, session: ort.InferenceSession, declared: Declared, clock: Clock) -> None:
        self._path = path
        self._session = session
        self._clock = clock
        self._input = check_input(path, session)
        self.fixed_size = self._input.fixed_size
        """(width, height) px of the only input that it takes; None: any."""
        self.input_name = self._input.name
        written = session.get_modelmeta().custom_metadata_map
        self.description: Description = describe(str(path), written, self._try_out(), declared)

    def infer(self, image: Image, scale: float, threshold: float, limit: int) -> tuple[Candidates, Seconds]:
        """Drones in (h, w) grey or (h, w, 3) BGR, in pixels of it, best first; at most `limit`, of at least the score
        `threshold`. scale: input px per image px, where the input's size is free."""
        started = self._clock.now()
        height, width = image.shape[:2]
        box = self._letterbox(width, height, scale)
        blob = self._blob(box.to_input(image, self.description.pad_value))
        prepared = self._clock.now()
        outputs = self._answer(blob)
        answered = self._clock.now()
        size = (box.input_width, box.input_height)
        found = read(outputs, self.description, self._raw(threshold), size)
        centre, sizes = box.points_to_image(found.centre), box.sizes_to_image(found.size)
        # The padding is not part of the image, and what is found there is not in the world.
        inside = np.asarray(((centre > -0.5) & (centre < [width - 0.5, height - 0.5])).all(axis=1))
        found = found._replace(centre=centre, size=sizes, score=self._calibrated(found.score)).select(inside)
        found = self._drones(found, limit)
        return found, Seconds(prepared - started, answered - prepared, self._clock.now() - answered)

    def input_of(self, image: Image, scale: float = 1.0) -> Output:
        """Network input (1, 3, h, w) of an image."""
        height, width = image.shape[:2]
        return self._blob(self._letterbox(width, height, scale).to_input(image, self.description.pad_value))

    def scale_of(self, width: int, height: int, wanted: float) -> float:
        """Input px per px of an image of this size: as configured, where the net takes any size."""
        return self._letterbox(width, height, wanted).scale_x

    def _drones(self, found: Candidates, limit: int) -> Candidates:
        """Those of the classes we look for, where nothing that looks alike is seen more surely."""
        net = self.description
        rivals = np.isin(found.label, [*net.drones, *net.vetoes])
        kept = suppress(found.select(rivals), limit=limit)
        return kept.select(np.isin(kept.label, [*net.drones]))

    def _blob(self, image: NDArray[np.uint8]) -> Output:
        """(1, 3 or 1, h, w) as the net wants it, of its own input's size. One channel is luma."""
        net = self.description
        if self._input.channels == 1:
            grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
            return np.asarray((grey - net.mean[0]) * np.float32(net.scale[0]), self._input.element)[
                None, None
            ]
        blob = np.asarray(
            cv2.dnn.blobFromImage(image, mean=net.mean, swapRB=net.channel_order == "RGB"), np.float32
        )
        blob *= np.array(net.scale, np.float32)[:, None, None]
        return np.asarray(blob, self._input.element)

    def _answer(self, blob: Output, options: ort.RunOptions | None = None) -> list[Output]:
        height, width = blob.shape[2:]
        fed = {self.input_name: blob}
        if self._input.size_name is not None:
            fed[self._input.size_name] = np.array([[width, height]], self._input.size_element)
        outputs: list[Output] = self._session.run(None, fed, options)
        if not all(np.isfinite(output).all() for output in outputs):
            raise ModelError(
                f"{self._path}: the net answered NaN or infinity for an input of {width}x{height}"
            )
        return outputs

    def _try_out(self) -> Trial:
        """An image of noise, in which most nets find something, before anything is known of the net but its input."""
        width, height = self.fixed_size or TRIAL_SIZE
        noise = np.random.default_rng(0).random((1, self._input.channels, height, width), np.float32)
        noise = noise.astype(self._input.element, copy=False)
        outputs = first_answer(
            self._path,
            lambda options: self._answer(noise, options),
            limit_s=trial_limit(self._session),
            what=f"a trial image of {width}x{height}",
        )
        return Trial(
            (width, height),
            tuple(tuple(output.shape) for output in outputs),
            tuple(output.name for output in self._session.get_outputs()),
            tuple(outputs),
        )

    def _letterbox(self, width: int, height: int, scale: float) -> Letterbox:
        if self.fixed_size is not None:
            w, h = self.fixed_size
            return letterbox.fit_fixed(width, height, input_width=w, input_height=h)
        return letterbox.fit(width, height, scale=scale, multiple=self.description.multiple)

    def _calibrated(self, score: NDArray[np.float64]) -> NDArray[np.float64]:
        """Probabilities of the net's scores: Platt's sigmoid of their logits."""
        a, b = self.description.calibration
        if (a, b) == (1.0, 0.0):
            return score
        return probability(a * logit(score) + b)

    def _raw(self, threshold: float) -> float:
        """The net's score that is calibrated to this threshold."""
        a, b = self.description.calibration
        if (a, b) == (1.0, 0.0):
            return threshold
        return float(probability((logit(threshold) - b) / a))
