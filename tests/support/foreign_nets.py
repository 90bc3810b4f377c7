"""Small networks as other people export them: real ONNX files that find one bright spot, each with its own head.

Each takes the brightest pixel's neighbourhood apart by its centre of mass, in the graph, and says what it found in its
head's layout; the rest of its rows are empty. So a test sees the whole way from a picture to a detection.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

OPSET = 17
BOX = (24.0, 16.0)  # px of the input: the size that all of them claim


def cells(width: int, height: int) -> int:
    return sum((width // s) * (height // s) for s in (8, 16, 32))


def spot_net(
    path: Path,
    head: str,
    *,
    size: tuple[int, int] = (160, 128),
    scores: Sequence[float] = (0.9,),
    channel: int = 0,
    written: Mapping[str, str] | None = None,
    logits: bool = False,
    element: int = TensorProto.FLOAT,
) -> Path:
    """Writes a net of input `size` (width, height) that finds the spot in `channel` of its input, and claims `scores`
    of its classes. logits: of a DETR, with one class more, "nothing". Returns the path."""
    width, height = size
    made: list[onnx.NodeProto] = []
    values: dict[str, NDArray[Any]] = {}

    def constant(name: str, value: Any) -> str:
        values[name] = np.asarray(value)
        return name

    def node(kind: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        made.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    f32 = np.float32
    image = node("Cast", ["images"], "image", to=TensorProto.FLOAT)
    one = node("Gather", [image, constant("channel", np.int64(channel))], "one", axis=1)  # (1, h, w)
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)  # from the edge, as YOLO counts
    axes = constant("axes", np.array([1, 2], np.int64))
    total = node("ReduceSum", [one, axes], "total", keepdims=1)
    safe = node("Add", [total, constant("epsilon", f32(1e-6))], "safe")
    centre = []
    for name, grid in (("u", u), ("v", v)):
        weighed = node("Mul", [one, constant(f"grid_{name}", grid[None].astype(f32))], f"weighed_{name}")
        moment = node("ReduceSum", [weighed, axes], f"moment_{name}", keepdims=1)
        centre.append(node("Div", [moment, safe], f"centre_{name}"))  # (1, 1, 1)

    def row(parts: Sequence[str | float], name: str) -> str:
        entries = [
            part
            if part in centre or str(part).startswith("x_")
            else constant(f"{name}_{i}", np.full((1, 1, 1), part, f32))
            for i, part in enumerate(parts)
        ]
        return node("Concat", entries, name, axis=2)

    def shifted(by: float, which: int, name: str) -> str:
        return node("Add", [centre[which], constant(f"by_{name}", f32(by))], f"x_{name}")

    def padded(first: str, rows: int, columns: int, name: str) -> str:
        empty = constant(f"empty_{name}", np.zeros((1, rows - 1, columns), f32))
        return node("Concat", [first, empty], name, axis=1)

    count = len(scores)
    outputs: list[str]
    if head == "yolo_v8":
        table = padded(row([*centre, *BOX, *scores], "row"), cells(width, height), 4 + count, "rows")
        outputs = [node("Transpose", [table], "output0", perm=[0, 2, 1])]
    elif head == "yolo_v5":
        outputs = [
            padded(row([*centre, *BOX, 0.95, *scores], "row"), 3 * cells(width, height), 5 + count, "output0")
        ]
    elif head == "end_to_end":
        corners = [
            shifted(sign * side / 2, axis, f"{sign}_{axis}")
            for sign in (-1, 1)
            for axis, side in enumerate(BOX)
        ]
        best = int(np.argmax(scores))
        outputs = [padded(row([*corners, scores[best], float(best)], "row"), 300, 6, "output0")]
    else:  # detr
        shares = [
            node("Div", [centre[axis], constant(f"side_{axis}", f32(side))], f"x_share_{axis}")
            for axis, side in enumerate(size)
        ]
        box = row([*shares, BOX[0] / width, BOX[1] / height], "box")
        if logits:
            odds = [float(np.log(s / (1.0 - s))) for s in scores]
            told = row([*odds, 0.0], "told")
            labels = node(
                "Concat",
                [told, constant("nothing", np.tile(f32([*[-9.0] * count, 9.0]), (1, 99, 1)))],
                "logits",
                axis=1,
            )
            outputs = [labels, padded(box, 100, 4, "pred_boxes")]
        else:
            both = node("Concat", [box, row(list(scores), "told")], "both", axis=2)
            outputs = [padded(both, 300, 4 + count, "output0")]

    graph = helper.make_graph(
        made,
        "spot",
        [helper.make_tensor_value_info("images", element, [1, 3, height, width])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [None, None, None]) for name in outputs],
        [numpy_helper.from_array(value, name) for name, value in values.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8)
    helper.set_model_props(model, dict(written or {}))
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def ultralytics(*names: str, **more: str) -> dict[str, str]:
    """Metadata as their exporter writes them: Python literals."""
    return {
        "author": "Ultralytics",
        "task": "detect",
        "stride": "32",
        "names": repr(dict(enumerate(names))),
        **more,
    }


def ours(head: str, *names: str, **more: str) -> dict[str, str]:
    entries = {
        "head": head,
        "stride": "1",
        "multiple": "32",
        "names": json.dumps(names),
        "scale": repr(1 / 255),
        "mean": "[0, 0, 0]",
        "channel_order": "RGB",
        "pad_value": "0",
        "score_threshold": "0.3",
        **more,
    }
    return {f"swarmtrack.{key}": text for key, text in entries.items()}


def answering(
    path: Path,
    outputs: Mapping[str, NDArray[Any]],
    *,
    size: tuple[int, int] = (160, 128),
    channels: int = 3,
    sizes: str | None = None,
    written: Mapping[str, str] | None = None,
    shape: Sequence[int] | None = None,
) -> Path:
    """Writes a net that answers the same to every image. sizes: name of a second input, the image's size; shape: of the
    image, instead of (1, channels, height, width) of `size`."""
    width, height = size
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, shape or [1, channels, height, width])
    inputs, nodes = [image], [helper.make_node("ReduceMax", ["images"], ["most"], keepdims=0)]
    if sizes is not None:
        inputs.append(helper.make_tensor_value_info(sizes, TensorProto.INT64, [1, 2]))
        nodes.append(helper.make_node("Identity", [sizes], ["unused"]))
    constants = [numpy_helper.from_array(np.float32(0.0), "zero")]
    nodes.append(helper.make_node("Mul", ["most", "zero"], ["nothing"]))
    infos = []
    for name, values in outputs.items():
        constants.append(numpy_helper.from_array(values, f"{name}_is"))
        real = values.dtype.kind == "f"
        nodes.append(
            helper.make_node(
                "Add" if real else "Identity", [f"{name}_is", "nothing"] if real else [f"{name}_is"], [name]
            )
        )
        infos.append(
            helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(values.dtype), values.shape)
        )
    model = helper.make_model(
        helper.make_graph(nodes, "answer", inputs, infos, constants),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=8,
    )
    helper.set_model_props(model, dict(written or {}))
    path.write_bytes(model.SerializeToString())
    return path
