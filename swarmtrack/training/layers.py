"""What the nets are made of."""

from __future__ import annotations

from torch import nn

RARE = -4.6  # where the heat starts, as a logit: "1 % of cells", or the first steps explode


def convolution(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Without a bias, which the normalisation after it has."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(outputs)
    )
