"""The paper's detector: CenterNet on a ResNet-34, to train and export for faithfulness; no net for a CPU board.

He, Zhang, Ren & Sun 2016 (the net), Zhou, Wang & Krähenbühl 2019, section 5 and figure 6 (the way back up: three
transposed convolutions of 256 channels, then one 3x3 convolution a head). Trained from scratch: weights of others
have licences of their own.
"""

from __future__ import annotations

from typing import cast

from torch import Tensor, nn
from torch.nn import functional

from swarmtrack.training.layers import RARE, convolution

STAGES = ((64, 3), (128, 4), (256, 6), (512, 3))  # channels, blocks
UP = 256
HEAD_CHANNELS = 64


class BasicBlock(nn.Module):
    """Two 3x3 convolutions that learn the difference to their input."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.first = convolution(inputs, outputs, stride=stride)
        self.second = convolution(outputs, outputs)
        same = stride == 1 and inputs == outputs
        self.shortcut = nn.Identity() if same else convolution(inputs, outputs, kernel=1, stride=stride)

    def forward(self, x: Tensor) -> Tensor:
        y = self.second(functional.relu(self.first(x)))
        return functional.relu(y + self.shortcut(x))


class ResNet34CenterNet(nn.Module):
    """forward: as of `plain.CenterNet`, images (n, 3, h, w) in 0…1 → heat as logits, offset, log_size at stride 4."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(convolution(3, 64, kernel=7, stride=2), nn.ReLU(), nn.MaxPool2d(3, 2, 1))
        blocks: list[nn.Module] = []
        inputs = 64
        for number, (width, depth) in enumerate(STAGES):
            blocks.append(BasicBlock(inputs, width, stride=1 if number == 0 else 2))
            blocks += [BasicBlock(width, width) for _ in range(depth - 1)]
            inputs = width
        self.stages = nn.Sequential(*blocks)
        ups: list[nn.Module] = []
        for _ in range(3):
            up = nn.ConvTranspose2d(inputs, UP, 4, stride=2, padding=1, bias=False)
            ups += [up, nn.BatchNorm2d(UP), nn.ReLU()]
            inputs = UP
        self.up = nn.Sequential(*ups)
        self.heat, self.offset, self.log_size = (
            nn.Sequential(
                nn.Conv2d(UP, HEAD_CHANNELS, 3, padding=1), nn.ReLU(), nn.Conv2d(HEAD_CHANNELS, 2, 1)
            )
            for _ in range(3)
        )
        nn.init.constant_(cast(Tensor, self.heat[-1].bias), RARE)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        y = self.up(self.stages(self.stem(images)))
        return self.heat(y), self.offset(y), self.log_size(y)
