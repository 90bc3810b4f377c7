"""The default detector: plain 3x3 convolutions, because on a CPU they cost least for what they can learn."""

from __future__ import annotations

from typing import cast

from torch import Tensor, nn
from torch.nn import functional

from swarmtrack.training.layers import RARE, convolution


class ConvBlock(nn.Module):
    """One 3x3 convolution; where it changes neither size nor depth, it learns the difference to its input."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.convolution = convolution(inputs, outputs, stride=stride)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y = self.convolution(x)
        return functional.relu(y + x if self.residual else y)


class CenterNet(nn.Module):
    """Four stages at strides 4, 8, 16, 32 and a thin way back up to stride 4.

    forward: images (n, 3, h, w) in 0…1, h and w multiples of 32 → heat (n, 2, h/4, w/4) as logits: of drones, and
    of what flies and is none, which is only there to learn from; offset (n, 2, …) in cells, log_size (n, 2, …).
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
        self.stem = nn.Sequential(convolution(3, stem, stride=2), nn.ReLU())
        stages, inputs = [], stem
        for width, depth in zip(widths, depths, strict=True):
            first = ConvBlock(inputs, width, stride=2)
            stages.append(nn.Sequential(first, *(ConvBlock(width, width) for _ in range(depth - 1))))
            inputs = width
        self.stages = nn.ModuleList(stages)
        self.lateral = nn.ModuleList([convolution(width, neck, kernel=1) for width in widths])
        self.smooth = nn.ModuleList([convolution(neck, neck) for _ in widths[1:]])
        self.shared = nn.Sequential(convolution(neck, head), nn.ReLU())
        self.heat, self.offset, self.log_size = (nn.Conv2d(head, n, 1) for n in (2, 2, 2))
        nn.init.constant_(cast(Tensor, self.heat.bias), RARE)

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
