"""Takes the weights of an exported model back into a net that can be trained.

An export folds each normalisation into the convolution before it, and what a normalisation had measured is lost. So it
is measured again, on pictures: each normalisation gets their mean and variance as its statistics, and the scale and the
shift with which it then changes nothing. In training and in flight the net begins with the answers of the file.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from swarmtrack.errors import ModelError


@torch.no_grad()
def adopt(network: nn.Module, model: Path, pictures: Tensor) -> None:
    """Write the weights of `model`, a file of `export`, into `network`. pictures (n, 3, h, w) in 0…1: some tens."""
    folded = _convolutions(model)
    shift: dict[str, Tensor] = {}

    def fill(layer: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        """Before a layer runs; the file has the convolutions in the order in which they run."""
        if isinstance(layer, nn.Conv2d):
            weight, bias = folded.popleft() if folded else (torch.empty(0), torch.empty(0))
            if weight.shape != layer.weight.shape:
                raise ModelError(
                    f"{model}: found a convolution of shape {tuple(weight.shape)},"
                    f" expected {tuple(layer.weight.shape)}: another network"
                )
            layer.weight.copy_(weight)
            if layer.bias is not None:
                layer.bias.copy_(bias)
            shift["last"] = bias
        elif isinstance(layer, nn.BatchNorm2d):
            assert layer.running_mean is not None
            assert layer.running_var is not None
            variance, mean = torch.var_mean(inputs[0], dim=(0, 2, 3))
            layer.running_mean.copy_(mean)
            layer.running_var.copy_(variance)
            layer.weight.copy_((variance + layer.eps).sqrt())
            layer.bias.copy_(shift["last"] + mean)

    hooks = [layer.register_forward_pre_hook(fill) for layer in network.modules()]
    was_training = network.training
    try:
        network.eval()(pictures)
    finally:
        network.train(was_training)
        for hook in hooks:
            hook.remove()
    if folded:
        raise ModelError(f"{model}: has {len(folded)} convolutions more than expected: another network")


def _convolutions(model: Path) -> deque[tuple[Tensor, Tensor]]:
    """Weight and bias of each, in the order of the file."""
    try:
        graph: Any = onnx.load(str(model)).graph
    except Exception as error:  # onnx raises whatever its parser happens to meet
        raise ModelError(f"{model}: not an ONNX file: {type(error).__name__}") from None
    held = {tensor.name: tensor for tensor in graph.initializer}
    found: deque[tuple[Tensor, Tensor]] = deque()
    for node in graph.node:
        if node.op_type == "Conv":
            if len(node.input) != 3 or not all(name in held for name in node.input[1:]):
                raise ModelError(
                    f"{model}: {node.name} has no weight and bias of its own, expected an fp32 export"
                )
            weight, bias = (
                torch.from_numpy(numpy_helper.to_array(held[name]).copy()).float() for name in node.input[1:]
            )
            found.append((weight, bias))
    return found
