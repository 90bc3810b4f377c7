"""A trained net in fewer bits: half precision, or 8-bit integers calibrated on pictures.

8 bits: static quantisation as pairs of QuantizeLinear and DequantizeLinear, weights per channel (Jacob et al. 2018).
The last layers stay in full precision: they are a hundredth of the work, and what they answer is what is read.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnxruntime import quantization

from swarmtrack.detection.detector import Detector
from swarmtrack.detection.net import Net
from swarmtrack.errors import ModelError
from swarmtrack.messages import Image

FEWEST_PICTURES = 16  # whose activations tell the ranges


def half(model: Path, out: Path) -> None:
    """Write `model` in half precision; it takes and answers single precision as before."""
    from onnxruntime.transformers.float16 import convert_float_to_float16  # noqa: PLC0415  # slow to import

    whole = onnx.load(str(model))
    converted = convert_float_to_float16(whole, keep_io_types=True)
    _write(converted, whole, out, "fp16")


def eight_bits(model: Path, out: Path, pictures: Sequence[Image]) -> None:
    """Write `model` with 8-bit weights and activations, calibrated on pictures (h, w, 3) BGR."""
    if len(pictures) < FEWEST_PICTURES:
        raise ModelError(
            f"{model}: found {len(pictures)} pictures to calibrate 8 bits on, expected {FEWEST_PICTURES} at least"
        )
    net = Detector(model, look="whole").net
    whole = onnx.load(str(model))
    with tempfile.TemporaryDirectory() as folder:
        prepared, quantised = Path(folder) / "prepared.onnx", Path(folder) / "quantised.onnx"
        quantization.quant_pre_process(str(model), str(prepared), skip_symbolic_shape=True)
        level = logging.getLogger().level
        logging.getLogger().setLevel(logging.ERROR)  # it warns of its own preprocessing, which was just done
        try:
            quantization.quantize_static(
                str(prepared),
                str(quantised),
                _Pictures(net, pictures),
                quant_format=quantization.QuantFormat.QDQ,
                per_channel=True,
                # Without VNNI, x86 adds pairs of products in 16 bits, which overflow with weights of 8 bits.
                reduce_range=True,
                activation_type=quantization.QuantType.QUInt8,
                weight_type=quantization.QuantType.QInt8,
                nodes_to_exclude=_last_layers(onnx.load(str(prepared))),
            )
        finally:
            logging.getLogger().setLevel(level)
        _write(onnx.load(str(quantised)), whole, out, "int8")


class _Pictures(quantization.CalibrationDataReader):  # type: ignore[misc]
    """The net's inputs, one picture after the other."""

    def __init__(self, net: Net, pictures: Sequence[Image]) -> None:
        self._inputs: Iterator[NDArray[Any]] = (net.input_of(picture) for picture in pictures)
        self._name = net.input_name

    def get_next(self) -> dict[str, NDArray[Any]] | None:
        blob = next(self._inputs, None)
        return None if blob is None else {self._name: np.asarray(blob)}


def _last_layers(model: Any) -> list[str]:
    """Names of the nodes from the last convolutions on, to the outputs."""
    maker = {name: node for node in model.graph.node for name in node.output}
    excluded: list[str] = []
    ahead = [output.name for output in model.graph.output]
    while ahead:
        node = maker.get(ahead.pop())
        if node is None or node.name in excluded:
            continue
        excluded.append(node.name)
        if node.op_type != "Conv":
            ahead += node.input
    return excluded


def _write(model: Any, whole: Any, out: Path, precision: str) -> None:
    """With the metadata of the whole one, and in one piece or not at all."""
    del model.metadata_props[:]
    model.metadata_props.extend(
        entry for entry in whole.metadata_props if entry.key != "swarmtrack.precision"
    )
    model.metadata_props.append(onnx.StringStringEntryProto(key="swarmtrack.precision", value=precision))
    partial = out.with_suffix(".partial")
    onnx.save(model, str(partial))
    partial.replace(out)
