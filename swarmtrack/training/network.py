"""The nets that can be trained, and what they learn from.

Each is a CenterNet (Zhou, Wang & Krähenbühl 2019): instead of boxes it answers, for each cell of `STRIDE` pixels, how
much this cell is the centre of a drone, where exactly the centre lies, and how large the drone is.
"""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from swarmtrack.training.plain import CenterNet
from swarmtrack.training.resnet import ResNet34CenterNet

OTHERS = 0.3  # weight of telling apart what flies and is no drone


def create_network(name: str) -> nn.Module:
    """`plain`, `nano` or `resnet34`; all answer alike."""
    if name == "resnet34":
        return ResNet34CenterNet()
    if name == "nano":
        return CenterNet(stem=8, widths=(16, 32, 48, 64), depths=(1, 2, 3, 2), neck=24, head=48)
    return CenterNet()


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
    drones, others = peak.sum(dim=(0, 2, 3)).clamp(min=1)
    of_drones, of_others = -(positive + negative).sum(dim=(0, 2, 3))
    return (
        of_drones / drones + OTHERS * of_others / others,
        (weight * (offset - true_offset).abs()).sum() / drones,
        (weight * (log_size - true_log_size).abs()).sum() / drones,
    )
