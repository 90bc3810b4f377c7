"""Advice on nets is followed: somebody does what a refusal says, and the net is read.

What takes other weights (NaN in the answers, another input, another task) or more memory no test can do.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")

import onnx
from onnx import helper, inliner, numpy_helper

from support.foreign_nets import answering, ultralytics
from swarmtrack.detection.description import Declared
from swarmtrack.detection.detector import Detector
from swarmtrack.errors import ModelError
from swarmtrack.messages import Array

W, H = 160, 128
CELLS = sum((W // s) * (H // s) for s in (8, 16, 32))
CORNERS, SHARES = [68.0, 56.0, 92.0, 72.0], [0.5, 0.5, 24 / W, 16 / H]
Outputs = Mapping[str, Array]


def rows(count: int, first: list[float]) -> Array:
    values = np.zeros((1, count, len(first)), np.float32)
    values[0, 0] = first
    return values


def v8(*scores: float) -> Array:
    return np.ascontiguousarray(rows(CELLS, [80.0, 64.0, 24.0, 16.0, *scores]).transpose(0, 2, 1))


def alike(shape: tuple[int, ...]) -> Array:
    return np.zeros(shape, np.float32)


LABELS = alike((1, 100)).astype(np.int64)
BOXES = np.repeat(np.array([[CORNERS]], np.float32), 100, 1)
SCORES = rows(100, [0.9])[:, :, 0]
MAPS = {f"p{s}": alike((1, 18, H // s, W // s)) for s in (8, 16, 32)}

# Outputs, advice, and the outputs that it asks for.
EXPORTS: dict[str, tuple[Outputs, str, Outputs]] = {
    "transposed": (
        {"o": v8(0.9).transpose(0, 2, 1).copy()}, r"transposed to \(1, 4 \+ classes, cells\)", {"o": v8(0.9)}
    ),
    "transposed, with its suppression": (
        {"o": v8(0.9).transpose(0, 2, 1).copy()}, "with its suppression, as end_to_end",
        {"o": rows(100, [*CORNERS, 0.9, 0.0])},
    ),
    "scores beside corners": (
        {"dets": rows(100, [*CORNERS, 0.9]), "labels": alike((1, 100))},
        r"its corners and scores as two outputs, \(1, n, 4\) and \(1, n\)",
        {"boxes": BOXES, "scores": SCORES, "labels": LABELS},
    ),
    "no batch": (
        {"boxes": BOXES[0], "labels": LABELS[0], "scores": SCORES[0]}, r"without suppression, or with \(1, n, …\)",
        {"boxes": BOXES, "labels": LABELS, "scores": SCORES},
    ),
    "a last axis": (
        {"labels": LABELS[..., None], "boxes": BOXES, "scores": SCORES[..., None]}, "without the last axis",
        {"labels": LABELS, "boxes": BOXES, "scores": SCORES},
    ),
    "classes as integers": (
        {"boxes": BOXES, "a": alike((1, 100)), "b": alike((1, 100))}, "export them as integers, or",
        {"boxes": BOXES, "a": LABELS, "b": alike((1, 100))},
    ),
    "classes with their name": (
        {"boxes": BOXES, "a": alike((1, 100)), "b": alike((1, 100))}, "or with the name labels",
        {"boxes": BOXES, "labels": alike((1, 100)), "b": alike((1, 100))},
    ),
    "a count": (
        {"n": np.ones((1, 1), np.int32), "o": rows(100, [*CORNERS, 0.9, 0.0])}, "without the number of detections",
        {"o": rows(100, [*CORNERS, 0.9, 0.0])},
    ),
    "maps": (MAPS, "export it with the decoding, as one table", {"o": v8(0.9)}),
    "two nets": (
        {"o": v8(0.9), "p": rows(100, [*CORNERS, 0.9, 0.0])}, "in one of these formats, without further outputs",
        {"o": v8(0.9)},
    ),
    "boxes that are not told apart": (
        {"a": rows(9, SHARES), "b": rows(9, [0.1, 0.2, 0.3, 0.4])}, "name them boxes and scores",
        {"boxes": rows(9, SHARES), "scores": rows(9, [0.1, 0.2, 0.3, 0.4])},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", EXPORTS)
def test_a_net_that_is_exported_as_a_refusal_says_is_read(tmp_path: Path, name: str) -> None:
    wrong, advice, right = EXPORTS[name]
    written = {} if name == "boxes that are not told apart" else ultralytics("drone")
    names = () if written else ("drone", "bird", "kite", "plane")
    with pytest.raises(ModelError, match=advice):
        Detector(answering(tmp_path / "net.onnx", wrong, written=written), declared=Declared(names=names))
    Detector(answering(tmp_path / "net.onnx", right, written=written), declared=Declared(names=names))


# Outputs, metadata, what is declared first, advice, and what it says to declare.
DECLARATIONS: dict[str, tuple[Outputs, dict[str, str], Declared, str, Declared]] = {
    "another number of classes": (
        {"o": v8(0.9, 0.1)}, ultralytics("drone"), Declared(),
        "2 as yolo_v8; list them in detector.names", Declared(names=("drone", "bird")),
    ),
    "classes without names": (
        {"o": rows(100, [*CORNERS, 0.9, 3.0])}, {}, Declared(),
        "4 classes at least .* list all of them, in their order, in",
        Declared(names=("bird", "kite", "plane", "drone")),
    ),
    "a head all the same": (
        {"o": rows(100, [*CORNERS[::-1], 0.9, 0.0])}, ultralytics("drone"), Declared(),
        "if it is end_to_end all the same, set detector.head", Declared(head="end_to_end"),
    ),
    "a list that may be a DETR": (
        {"o": rows(100, [*SHARES, 0.93, 0.02])}, {}, Declared(), "if it is a DETR, list its classes in detector.names",
        Declared(names=("drone", "bird")),
    ),
    "no class that is a drone": (
        {"o": v8(0.9, 0.1)}, ultralytics("quad", "bird"), Declared(),
        "they are quad, bird; name the drones' classes in detector.classes", Declared(classes=("quad",)),
    ),
    "a class that is none of its": (
        {"o": v8(0.9, 0.1)}, ultralytics("quad", "bird"), Declared(classes=("uav",)),
        "names uav, but its classes are quad, bird", Declared(classes=("quad",)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DECLARATIONS)
def test_a_net_is_read_with_what_a_refusal_says_to_declare(tmp_path: Path, name: str) -> None:
    outputs, written, wrong, advice, right = DECLARATIONS[name]
    path = answering(tmp_path / "net.onnx", outputs, written=written)
    with pytest.raises(ModelError, match=advice):
        Detector(path, declared=wrong)
    assert Detector(path, declared=right).description.drones


# --- files ------------------------------------------------------------------------------------------------------------


def in_functions(path: Path, edit: Callable[[Any], Any] = lambda model: model) -> Path:
    """A net of a YOLOv8's output whose last node is a function of its own."""
    model = onnx.load(str(answering(path, {"o": v8(0.9)}, written=ultralytics("drone"))))
    last = model.graph.node[-1]
    body = helper.make_node("Add", ["a", "b"], ["c"])
    made = helper.make_function("own", "Sum", ["a", "b"], ["c"], [body], [helper.make_opsetid("", 17)])
    call = helper.make_node("Sum", list(last.input), list(last.output), domain="own")
    model.graph.node[-1].CopyFrom(call)
    model.functions.append(made)
    model.opset_import.append(helper.make_opsetid("own", 1))
    onnx.save(edit(model), str(path))
    return path


def test_functions_that_are_written_out_as_a_refusal_says_are_read(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"write them out with onnx\.inliner\.inline_local_functions$"):
        Detector(in_functions(tmp_path / "net.onnx"))
    assert Detector(in_functions(tmp_path / "net.onnx", inliner.inline_local_functions)).description.drones


def test_a_net_without_sparse_weights_is_read_as_a_refusal_says(tmp_path: Path) -> None:
    path = answering(tmp_path / "net.onnx", {"o": v8(0.9)}, written=ultralytics("drone"))
    dense = path.read_bytes()
    model = onnx.load(str(path))
    for i, tensor in enumerate(model.graph.initializer):
        if tensor.name == "zero":
            continue
        values = numpy_helper.to_array(tensor).ravel()
        at = np.flatnonzero(values)
        sparse = helper.make_sparse_tensor(
            numpy_helper.from_array(values[at], tensor.name), numpy_helper.from_array(at), list(tensor.dims)
        )
        del model.graph.initializer[i]
        model.graph.sparse_initializer.append(sparse)
        break
    onnx.save(model, str(path))
    with pytest.raises(ModelError, match="export it without sparse weights"):
        Detector(path)
    path.write_bytes(dense)
    assert Detector(path).description.drones


def test_what_is_no_file_is_replaced_by_the_shipped_one_as_a_refusal_says(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such model file") as refused:
        Detector(tmp_path / "gone.onnx")
    offered = re.search(r'"(\w+)" for the one that is shipped', str(refused.value))
    assert offered is not None
    assert Detector(offered[1]).description.drones


def test_a_provider_that_is_installed_is_taken_as_a_refusal_says() -> None:
    with pytest.raises(ModelError, match="is installed here, only ") as refused:
        Detector(providers=("qnn",))
    installed = re.search(r"only ([\w, ]+)$", str(refused.value))
    assert installed is not None
    assert Detector(providers=tuple(installed[1].split(", "))).description.drones
