"""The detector's network: plain 3x3 convolutions, because on a CPU they cost least for what they can learn.

A CenterNet (Zhou, Wang & Krähenbühl 2019): instead of boxes it answers, for each cell of `stride` pixels, how much
this cell is the centre of a drone, where exactly the centre lies, and how large the drone is.
"""

from __future__ import annotations

from typing import cast

from torch import Tensor, nn
from torch.nn import functional

STRIDE = 4
COARSEST = 32  # px: images must be a multiple of this


def _convolution(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(outputs)
    )


class Block(nn.Module):
    """One 3x3 convolution; where it changes neither size nor depth, it learns the difference to its input."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.convolution = _convolution(inputs, outputs, stride=stride)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y = self.convolution(x)
        return functional.relu(y + x if self.residual else y)


class CenterNet(nn.Module):
    """Four stages at strides 4, 8, 16, 32 and a thin way back up to stride 4.

    forward: images (n, 3, h, w) in 0…1, h and w multiples of 32 → heat (n, 1, h/4, w/4) as logits,
    offset (n, 2, …) in cells, log_size (n, 2, …).
    """

    def __init__(
        self,
        stem: int = 16,
        widths: tuple[int, ...] = (24, 48, 80, 96),
        depths: tuple[int, ...] = (2, 3, 4, 3),
        neck: int = 32,
        head: int = 64,
    ) -> None:
        super().__init__()
        self.stem = nn.Sequential(_convolution(3, stem, stride=2), nn.ReLU())
        stages, inputs = [], stem
        for width, depth in zip(widths, depths, strict=True):
            first = Block(inputs, width, stride=2)
            stages.append(nn.Sequential(first, *(Block(width, width) for _ in range(depth - 1))))
            inputs = width
        self.stages = nn.ModuleList(stages)
        self.lateral = nn.ModuleList([_convolution(width, neck, kernel=1) for width in widths])
        self.smooth = nn.ModuleList([_convolution(neck, neck) for _ in widths[1:]])
        self.shared = nn.Sequential(_convolution(neck, head), nn.ReLU())
        self.heat, self.offset, self.log_size = (nn.Conv2d(head, n, 1) for n in (1, 2, 2))
        nn.init.constant_(
            cast(Tensor, self.heat.bias), -4.6
        )  # starts at "1 % of cells": or the first steps explode

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x = self.stem(images)
        features = []
        for stage, lateral in zip(self.stages, self.lateral, strict=True):
            x = stage(x)
            features.append(lateral(x))
        y = features[-1]
        for finer, smooth in zip(reversed(features[:-1]), self.smooth, strict=True):
            y = finer + functional.interpolate(y, scale_factor=2.0, mode="nearest")
            y = functional.relu(smooth(functional.relu(y)))
        y = self.shared(y)
        return self.heat(y), self.offset(y), self.log_size(y)


NETWORKS: dict[str, dict[str, object]] = {
    "plain": {},
    "nano": {"stem": 8, "widths": (16, 32, 48, 64), "depths": (1, 2, 3, 2), "neck": 24, "head": 48},
}


def create_network(name: str) -> CenterNet:
    return CenterNet(**NETWORKS[name])  # type: ignore[arg-type]


def loss(answers: tuple[Tensor, Tensor, Tensor], wanted: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Penalty-reduced focal loss of the heat map, weighted L1 of offset and log size; each per drone.

    answers as from `CenterNet.forward`; wanted: the fields of `dataset.Targets`, batched. CenterNet, equation 1.
    """
    logits, offset, log_size = (answer.float() for answer in answers)
    heat, true_offset, true_log_size, weight = wanted
    peak = (heat > 0.999).float()
    p = logits.sigmoid()
    positive = peak * (1 - p) ** 2 * functional.logsigmoid(logits)
    negative = (1 - peak) * (1 - heat) ** 4 * p**2 * functional.logsigmoid(-logits)
    drones = peak.sum().clamp(min=1)
    return (
        -(positive.sum() + negative.sum()) / drones,
        (weight * (offset - true_offset).abs()).sum() / drones,
        (weight * (log_size - true_log_size).abs()).sum() / drones,
    )
