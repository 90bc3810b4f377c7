"""What a net's outputs can mean: all readings by shapes, one by values, and a question where two are left."""

from __future__ import annotations

import typing

import numpy as np
import pytest

pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")

from support.foreign_nets import answering, ultralytics
from support.mutants import MUTANTS
from swarmtrack.agents.video import HEADS as HEADS_OF_VIDEO
from swarmtrack.config.drone import DetectorSection
from swarmtrack.detection.description import Declared, describe
from swarmtrack.detection.detector import Detector
from swarmtrack.detection.heads import READ as READ_BY_HEAD
from swarmtrack.detection.model import open_session
from swarmtrack.detection.readings import HEAD_FORMATS, HEADS, Trial, readings
from swarmtrack.errors import ModelError
from swarmtrack.messages import Frame, StampKind

W, H = 160, 128
IMAGE = np.zeros((H, W, 3), np.uint8)
CENTRE, SIZE = (80.0, 64.0), (24.0, 16.0)


def cells(*strides):
    return sum((W // s) * (H // s) for s in strides)


def rows(count, columns, first):
    values = np.zeros((1, count, columns), np.float32)
    values[0, 0] = first
    return values


def v8(count, *scores):
    return np.ascontiguousarray(rows(count, 4 + len(scores), [*CENTRE, *SIZE, *scores]).transpose(0, 2, 1))


def v5(count, *scores):
    return rows(count, 5 + len(scores), [*CENTRE, *SIZE, 0.95, *scores])


CORNERS = [68.0, 56.0, 92.0, 72.0]
SHARES = [0.5, 0.5, 24 / W, 16 / H]
TWO = ultralytics("drone", "bird")


def found(path, declared=None):
    detector = Detector(path, declared=declared or Declared())
    result = detector.detect(detector.plan(Frame(1.0, 0.0, 1, IMAGE, StampKind.MEDIA)))
    assert result is not None, detector.status().text
    return detector.description.head, result


MAPS = {f"p{s}": np.zeros((1, 3, H // s, W // s, 7), np.float32) for s in (8, 16, 32)}
FEATURES = {f"f{s}": np.zeros((1, 65, H // s, W // s), np.float32) for s in (8, 16, 32)}
LABELS = {
    "labels": np.zeros((1, 300), np.int64),
    "boxes": np.repeat(np.array([[CORNERS]], np.float32), 300, 1),
    "scores": rows(300, 1, [0.93])[:, :, 0],
}
READ = {
    "RT-DETR of Ultralytics, two classes": ("detr", {"output0": rows(300, 6, [*SHARES, 0.93, 0.02])}, TWO),
    "RT-DETR of Ultralytics, one class": ("detr", {"output0": rows(300, 5, [*SHARES, 0.93])}, ultralytics("drone")),
    "end to end, two classes": ("end_to_end", {"output0": rows(300, 6, [*CORNERS, 0.93, 0.0])}, TWO),
    "end to end, the second class": ("end_to_end", {"output0": rows(300, 6, [*CORNERS, 0.93, 1.0])},
                                     ultralytics("bird", "drone")),
    "P2": ("yolo_v8", {"output0": v8(cells(4, 8, 16, 32), 0.93)}, ultralytics("drone")),
    "P2 without P5": ("yolo_v8", {"output0": v8(cells(4, 8, 16), 0.93)}, ultralytics("drone", stride="16")),
    "YOLOv3-tiny": ("yolo_v8", {"output0": v8(cells(16, 32), 0.93)}, ultralytics("drone")),
    "YOLOv5 of P3 and P4": ("yolo_v5", {"output0": v5(3 * cells(8, 16), 0.98, 0.01)}, TWO),
    "end to end, as many rows as a tiny YOLO's cells": (
        "end_to_end", {"output0": rows(cells(16, 32), 6, [*CORNERS, 0.93, 0.0])}, TWO
    ),
    "P6": ("yolo_v8", {"output0": v8(cells(8, 16, 32, 64), 0.93)}, ultralytics("drone")),
    "YOLOv8 with its maps": ("yolo_v8", {"output0": v8(cells(8, 16, 32), 0.93), **FEATURES}, ultralytics("drone")),
    "YOLOv5 of 2021, four outputs": ("yolo_v5", {"output": v5(3 * cells(8, 16, 32), 0.98, 0.01), **MAPS}, {}),
    "D-FINE": ("labelled_boxes", LABELS, {}),
    "suppressed by TensorRT's plugin": (
        "labelled_boxes",
        {
            "num_dets": np.array([[1]], np.int32),
            "boxes": rows(100, 4, CORNERS),
            "scores": rows(100, 1, [0.93])[:, :, 0],
            "labels": np.array([[0, *[-1] * 99]], np.int32),
        },
        ultralytics("drone", "bird"),
    ),
    "D-FINE, labels as floats": ("labelled_boxes", LABELS | {"labels": np.zeros((1, 300), np.float32)}, {}),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_an_export_is_read_as_what_it_is(tmp_path, name):
    expected, outputs, written = READ[name]
    sizes = "orig_target_sizes" if name.startswith("D-FINE") else None
    declared = Declared(names=("drone", "bird")) if name.startswith("YOLOv5") else Declared()
    head, result = found(answering(tmp_path / "net.onnx", outputs, written=written, sizes=sizes), declared)
    assert head == expected
    assert result.centre[0] == pytest.approx(np.array(CENTRE) - 0.5, abs=1e-3)
    assert result.size[0] == pytest.approx(SIZE, rel=1e-3)
    assert len(result.centre) == 1


def test_outputs_that_two_heads_could_have_made_are_asked_about(tmp_path):
    """Nothing was found in the trial image: all is zero."""
    path = answering(tmp_path / "net.onnx", {"output0": np.zeros((1, 300, 6), np.float32)}, written=TWO)
    with pytest.raises(
        ModelError, match=r"can be read in more than one way: as end_to_end .* or detr .*--head"
    ):
        Detector(path)
    for head in ("end_to_end", "detr"):
        assert found(path, Declared(head=head))[0] == head


FOUR = Declared(names=("a", "b", "c", "drone"))
BOXES, LOGITS = rows(300, 4, SHARES), rows(300, 4, [-5.0, -5.0, -5.0, 2.6])
SCORES = rows(300, 4, [0.01, 0.01, 0.01, 0.93])


@pytest.mark.parametrize(
    "outputs",
    [
        {"scores": SCORES, "pred_boxes": BOXES},
        {"pred_boxes": BOXES, "box_scores": SCORES},
        {"output0": SCORES, "boxes": BOXES},
        {"logits": LOGITS, "output1": BOXES},
        {"output0": LOGITS, "output1": BOXES},
        {"output0": BOXES, "output1": LOGITS},
    ],
)
@pytest.mark.parametrize("head", [None, "detr"])
def test_boxes_and_four_classes_are_told_apart_by_name_or_value(tmp_path, outputs, head):
    head, result = found(answering(tmp_path / "net.onnx", outputs), Declared(names=FOUR.names, head=head))
    assert head == "detr"
    assert result.centre[0] == pytest.approx(np.array(CENTRE) - 0.5, abs=1e-3)
    assert len(result.centre) == 1


@pytest.mark.parametrize("head", [None, "detr"])
def test_boxes_and_four_classes_that_nothing_tells_apart_are_refused(tmp_path, head):
    path = answering(tmp_path / "net.onnx", {"output0": SCORES, "output1": BOXES})
    with pytest.raises(
        ModelError, match=r"either of its outputs, .*may hold the boxes; name them boxes and scores"
    ):
        Detector(path, declared=Declared(names=FOUR.names, head=head))


@pytest.mark.parametrize(
    ("outputs", "written", "words"),
    [
        (
            {"output0": rows(300, 6, [0.1, 0.1, 0.3, 0.3, 0.9, 0.0])},
            ultralytics("drone"),
            "it is not end_to_end: its coordinates are shares",
        ),
        (
            {"output0": rows(300, 6, [*CORNERS, 0.9, 0.5])},
            ultralytics("drone"),
            "its classes are no whole numbers",
        ),
        (
            {"output0": rows(300, 6, [*CORNERS[::-1], 0.9, 0.0])},
            ultralytics("drone"),
            "its corners are not in order",
        ),
        (
            {"output0": rows(300, 6, [*CORNERS, 0.9, 7.0])},
            ultralytics("drone"),
            "it answers class 7, of 1",
        ),
        (
            {"output0": v8(cells(8, 16, 32), 3.0)},
            ultralytics("drone"),
            "it is not yolo_v8: its scores are not within",
        ),
        (
            {name: np.full((1, n, 32, 40), -2.0, np.float32) for name, n in (("hm", 1), ("wh", 2), ("reg", 2))},
            {},
            "it is not centernet: its scores are not within",
        ),
        ({"output0": v8(cells(8, 16, 32), 0.9)}, TWO, r"for an input of 160x128 and 2 classes; known are"),
        (
            {"output0": rows(300, 6, [*CORNERS, 0.9, 7.0])},
            {},
            r"distinguishes 8 classes at least .*detector.names, or --names",
        ),
        (
            {"boxes": rows(9, 4, SHARES), "scores": rows(9, 1, [0.9]), "aux": rows(9, 4, SHARES)},
            {},
            r"no known format: \(1, 9, 4\), \(1, 9, 1\), \(1, 9, 4\)",
        ),
        (
            {"output0": np.zeros((1, 37, cells(8, 16, 32)), np.float32), "p": np.zeros((1, 32, 32, 40), np.float32)},
            {},
            "no known format",
        ),
    ],
)  # fmt: skip
def test_what_no_head_made_is_refused_with_the_reason(tmp_path, outputs, written, words):
    with pytest.raises(ModelError, match=words):
        Detector(answering(tmp_path / "net.onnx", outputs, written=written))


CANDIDATES = np.zeros((1, 100), np.float32)
NEXT_STEPS = {
    "YOLOv8, transposed": ({"o": rows(cells(8, 16, 32), 5, [*CENTRE, *SIZE, 0.9])}, "its rows are cells: .*transposed"),
    "mmdet": ({"dets": rows(100, 5, [*CORNERS, 0.9]), "labels": CANDIDATES}, r"as two outputs, \(1, n, 4\) and"),
    "torchvision": (
        {"boxes": LABELS["boxes"][0], "labels": LABELS["labels"][0], "scores": LABELS["scores"][0]}, "no batch axis"
    ),
    "YOLOv7, suppressed": ({"o": np.zeros((3, 7), np.float32)}, "no batch axis"),
    "a column of scores": (
        {"labels": LABELS["labels"][..., None], "boxes": LABELS["boxes"], "scores": LABELS["scores"][..., None]},
        "without the last axis",
    ),
    "classes without a name": (
        {"boxes": rows(100, 4, CORNERS), "a": CANDIDATES, "b": CANDIDATES}, "as integers, or with the name labels"
    ),
    "a number of detections": (
        {"n": np.ones((1, 1), np.int32), "o": rows(100, 6, [*CORNERS, 0.9, 0.0])}, "without the number of detections"
    ),
    "maps": ({f"p{s}": np.zeros((1, 18, H // s, W // s), np.float32) for s in (8, 16, 32)}, "with the decoding"),
    "classes of another number": (
        {"o": v8(cells(8, 16, 32), 0.9, 0.1)}, "2 as yolo_v8; list them in detector.names, or --names"
    ),
    "two nets in one": (
        {"o": v8(cells(8, 16, 32), 0.9), "p": rows(300, 6, [*CORNERS, 0.9, 0.0])}, "without further outputs"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NEXT_STEPS)
def test_a_refusal_says_how_to_export_and_no_head_that_would_be_refused(tmp_path, name):
    outputs, words = NEXT_STEPS[name]
    path = answering(tmp_path / "net.onnx", outputs, written=ultralytics("drone"))
    with pytest.raises(ModelError, match=rf"known are .*; .*{words}") as refused:
        Detector(path)
    assert "--head" not in str(refused.value)


def test_a_refusal_names_a_head_that_then_is_taken(tmp_path):
    wrong = rows(300, 6, [*CORNERS[::-1], 0.9, 0.0])
    path = answering(tmp_path / "net.onnx", {"output0": wrong}, written=ultralytics("drone"))
    with pytest.raises(ModelError, match=r"if it is end_to_end all the same, set detector\.head, or --head"):
        Detector(path)
    assert Detector(path, declared=Declared(head="end_to_end")).description.head == "end_to_end"


def test_a_list_that_may_be_a_detr_is_asked_for_its_classes(tmp_path):
    path = answering(tmp_path / "net.onnx", {"output0": rows(300, 6, [*SHARES, 0.93, 0.02])})
    with pytest.raises(ModelError, match=r"if it is a DETR, list its classes in detector\.names"):
        Detector(path)
    assert found(path, Declared(names=("drone", "bird")))[0] == "detr"


def test_one_faint_box_that_is_inside_out_refuses_no_net(tmp_path):
    outputs = rows(300, 6, [*CORNERS, 0.93, 0.0])
    outputs[0, 200] = [90.0, 70.0, 80.0, 60.0, 0.001, 0.0]
    assert found(answering(tmp_path / "net.onnx", {"output0": outputs}, written=TWO))[0] == "end_to_end"


def test_one_channel_is_fed_with_luma(tmp_path):
    path = answering(
        tmp_path / "net.onnx",
        {"output0": v8(cells(8, 16, 32), 0.93)},
        channels=1,
        written=ultralytics("drone"),
    )
    assert found(path)[1].centre[0] == pytest.approx(np.array(CENTRE) - 0.5)
    net = Detector(path)._net
    blue = np.zeros((H, W, 3), np.uint8)
    blue[..., 0] = 255
    assert net.input_of(blue).shape == (1, 1, H, W)
    assert net.input_of(blue).max() == pytest.approx(29 / 255)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ([1, H, W, 3], "its channels are last"),
        ([1, 4, H, W], r"expected one image of type"),
        ([8, 3, H, W], r"\[8, 3, 128, 160\]; expected one image"),
        ([3, H, W], "expected one image"),
        ([1, 3, 2, 2], "its input is 2x2 px, expected a detector's"),
        ([1, 3, 100_000, 100_000], r"its input is 100000x100000 px, .*8\.3 megapixels at most"),
        ([1, 3, 2**40, 2**20], "megapixels at most"),
    ],
)
def test_inputs_that_no_frame_fits_are_refused_at_once(tmp_path, shape, words):
    path = answering(tmp_path / "net.onnx", {"output0": v8(cells(8, 16, 32), 0.93)}, shape=shape)
    with pytest.raises(ModelError, match=words):
        Detector(path)


def test_a_second_input_that_is_no_size_is_refused(tmp_path):
    outputs = {"output0": v8(cells(8, 16, 32), 0.93)}
    path = answering(tmp_path / "net.onnx", outputs, sizes="orig_target_sizes")
    assert [entry.name for entry in open_session(path, 1, ("cpu",)).get_inputs()] == [
        "images",
        "orig_target_sizes",
    ]
    assert found(path, Declared(names=("drone",)))[0] == "yolo_v8"


@pytest.mark.parametrize(
    "count", [300, pytest.param(MUTANTS, marks=pytest.mark.long("thousands of shapes, not 300"))]
)
def test_any_outputs_whatever_are_read_or_refused(count):
    chance = np.random.default_rng(6)
    sides = [0, 1, 2, 3, 4, 5, 6, 7, 80, 300, cells(8, 16, 32), 3 * cells(8, 16, 32)]
    kinds = [np.float32, np.float16, np.int64]
    refused = []
    for _ in range(count):
        shapes = [
            (1, *chance.choice(sides, chance.integers(0, 4)).tolist()) for _ in range(chance.integers(0, 5))
        ]
        values = [
            (
                chance.choice([0.0, 0.5, 1e4]) * chance.random(shape if np.prod(shape) < 1e5 else (1, 1))
            ).astype(chance.choice(kinds))
            for shape in shapes
        ]
        shapes = [value.shape for value in values]
        trial = Trial((W, H), tuple(shapes), tuple(f"o{i}" for i in range(len(shapes))), tuple(values))
        assert {reading.head for reading in readings(trial, None)} <= set(HEADS)
        try:
            describe("m.onnx", ultralytics("drone") if chance.random() < 0.5 else {}, trial, Declared())
        except ModelError as error:
            refused.append(str(error))
    assert len(refused) > count // 2
    assert max(map(len, refused)) < 1200


def test_each_head_can_be_named_in_a_config_and_on_the_command_line():
    named = typing.get_args(DetectorSection.model_fields["head"].annotation)
    assert set(named) == {"auto", *HEADS}
    assert HEADS_OF_VIDEO == HEADS
    assert set(READ_BY_HEAD) == set(HEAD_FORMATS) == set(HEADS)
