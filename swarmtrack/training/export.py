"""Writes a trained net as ONNX, with everything a detector must know about it inside the file."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn

from swarmtrack.training import IMAGE_MULTIPLE_PX
from swarmtrack.training.dataset import STRIDE

OPSET = 17


class _Deployed(nn.Module):
    """The net as it flies: scores instead of logits, of drones alone."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        heat, offset, log_size = self.network(images)
        return heat[:, :1].sigmoid(), offset, log_size


def export(network: nn.Module, path: Path, metadata: Mapping[str, str]) -> None:
    """Write `network` to `path`; any image size that is a multiple of 32 will do. `metadata` is added to ours.

    The file appears whole or not at all: a reader of `path` sees the old one meanwhile.
    """
    ours = {
        "head": "centernet",
        "stride": str(STRIDE),
        "multiple": str(IMAGE_MULTIPLE_PX),
        "size_encoding": "log_cells",
        "names": json.dumps(["drone"]),
        "scale": repr(1 / 255),
        "mean": json.dumps([0.0, 0.0, 0.0]),
        "channel_order": "BGR",
        "pad_value": "114",
        "score_threshold": "0.3",
    }
    free = {0: "batch", 2: "height", 3: "width"}
    write_onnx(
        _Deployed(network).eval(),
        torch.zeros(1, 3, 2 * IMAGE_MULTIPLE_PX, 3 * IMAGE_MULTIPLE_PX),
        path,
        dict.fromkeys(("images", "heat", "offset", "size"), free),
        {**ours, **metadata},
    )


def write_onnx(
    deployed: nn.Module,
    example: Tensor,
    path: Path,
    free: Mapping[str, Mapping[int, str]],
    metadata: Mapping[str, str],
) -> None:
    """Write a net with one input. free: axes of any length by name of the input, which comes first, and the outputs."""
    partial = path.with_suffix(".partial")
    with warnings.catch_warnings():
        # The newer exporter fixes sizes that must stay free; that the older one is on its way out is known.
        warnings.simplefilter("ignore", DeprecationWarning)
        names = list(free)
        torch.onnx.export(
            deployed,
            (example,),
            str(partial),
            input_names=names[:1],
            output_names=names[1:],
            opset_version=OPSET,
            dynamo=False,
            dynamic_axes=free,
        )
    model = onnx.load(str(partial))
    for key, value in metadata.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = f"swarmtrack.{key}", value
    onnx.save(model, str(partial))
    partial.replace(path)
