"""A model file: the ONNX session and what the file says about itself."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import onnxruntime as ort

from swarmtrack.errors import ModelError

PREFIX = "swarmtrack."
SHIPPED = ("default",)

PROVIDERS: dict[str, str] = {
    "cpu": "CPUExecutionProvider",
    "xnnpack": "XnnpackExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "qnn": "QNNExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
}

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Metadata:
    """What a detector must know of a net, read from the `swarmtrack.*` metadata of its file.

    stride: input px per cell; multiple: input sides are multiples of this; scale, mean: the net is fed
    scale · (pixel − mean), mean in the order of the channels; pad_value 0…255; entries: all of it, as written.
    """

    head: str
    stride: int
    multiple: int
    size_encoding: str
    names: tuple[str, ...]
    score_threshold: float
    scale: float
    mean: tuple[float, float, float]
    channel_order: str
    pad_value: int
    entries: Mapping[str, str]


def model_path(model: str | Path) -> Path:
    """The file of a shipped model's name, or the path itself."""
    if str(model) in SHIPPED:
        return Path(str(resources.files("swarmtrack.detection") / "models" / f"{model}.onnx"))
    return Path(model)


def open_session(path: Path, threads: int, providers: Sequence[str]) -> ort.InferenceSession:
    """Load a model on the first of `providers` (names of `PROVIDERS`) that this machine has."""
    unknown = [name for name in providers if name not in PROVIDERS]
    if unknown or not providers:
        raise ModelError(
            f"detector providers: found {list(providers)}, expected some of {', '.join(PROVIDERS)}"
        )
    available = ort.get_available_providers()
    usable = [PROVIDERS[name] for name in providers if PROVIDERS[name] in available]
    if not usable:
        have = ", ".join(name for name, long in PROVIDERS.items() if long in available)
        raise ModelError(f"detector providers: none of {', '.join(providers)} is installed here, only {have}")
    if not path.is_file():
        raise ModelError(
            f'{path}: no such model file; expected an ONNX file, or "default" for the one that is shipped'
        )
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    # Spinning threads burn a core between frames, which the tracker and the links need.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # the exception says it; the C++ log would only repeat it on stderr
    try:
        return ort.InferenceSession(str(path), options, providers=usable)
    except Exception as error:  # ONNX Runtime's exceptions have no common base but this
        raise ModelError(
            f"{path}: not a model that ONNX Runtime {ort.__version__} can load: {error}"
        ) from error


def check_input(path: Path, session: ort.InferenceSession) -> tuple[int, int] | None:
    """The fixed (width, height) of the net's input in px, or None where any size will do."""
    inputs = session.get_inputs()
    shape = inputs[0].shape if inputs else []
    good = len(inputs) == 1 and inputs[0].type == "tensor(float)" and len(shape) == 4 and shape[1] == 3
    if not good or (isinstance(shape[0], int) and shape[0] != 1):
        found = "; ".join(f"{entry.name} {entry.type} {entry.shape}" for entry in inputs) or "none"
        raise ModelError(
            f"{path}: inputs are {found}; expected one of type float and shape [1, 3, height, width]"
        )
    height, width = shape[2], shape[3]
    return (width, height) if isinstance(width, int) and isinstance(height, int) else None


def read_metadata(path: Path, session: ort.InferenceSession, heads: Sequence[str]) -> Metadata:
    """Parse the file's metadata; each missing or wrong entry is named."""
    written = session.get_modelmeta().custom_metadata_map
    entries = {key.removeprefix(PREFIX): text for key, text in written.items() if key.startswith(PREFIX)}

    def entry(key: str, parse: Callable[[str], T], expected: str) -> T:
        if key not in entries:
            found = ", ".join(sorted(written)) or "no metadata at all"
            raise ModelError(
                f"{path}: metadata {PREFIX}{key} is missing (found {found}), expected {expected}"
            )
        try:
            return parse(entries[key])
        except (ValueError, TypeError, KeyError):
            raise ModelError(
                f"{path}: metadata {PREFIX}{key} is {entries[key]!r}, expected {expected}"
            ) from None

    return Metadata(
        head=entry("head", _one_of(heads), f"one of {', '.join(heads)}"),
        stride=entry("stride", _positive, "a positive whole number of pixels"),
        multiple=entry("multiple", _positive, "a positive whole number of pixels"),
        size_encoding=entry("size_encoding", _one_of(["log_cells"]), "log_cells"),
        names=entry("names", _names, "a JSON list of class names"),
        score_threshold=entry("score_threshold", _fraction, "a number in 0…1"),
        scale=entry("scale", float, "a number"),
        mean=entry("mean", _three, "a JSON list of three numbers"),
        channel_order=entry("channel_order", _one_of(["BGR", "RGB"]), "BGR or RGB"),
        pad_value=entry("pad_value", _byte, "a whole number in 0…255"),
        entries=entries,
    )


def _one_of(allowed: Sequence[str]) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if text not in allowed:
            raise ValueError(text)
        return text

    return parse


def _positive(text: str) -> int:
    if (value := int(text)) < 1:
        raise ValueError(text)
    return value


def _byte(text: str) -> int:
    if not 0 <= (value := int(text)) <= 255:
        raise ValueError(text)
    return value


def _fraction(text: str) -> float:
    if not 0 <= (value := float(text)) <= 1:
        raise ValueError(text)
    return value


def _three(text: str) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in json.loads(text))
    return x, y, z


def _names(text: str) -> tuple[str, ...]:
    names: Any = json.loads(text)
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError(text)
    return tuple(names)
