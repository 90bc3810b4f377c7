"""Models from elsewhere: whatever their metadata hold, a sentence comes of it; who never answers is given up."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest

from support.mutants import MUTANTS, mutants
from swarmtrack.detection import model as model_file
from swarmtrack.detection.description import Declared, describe
from swarmtrack.detection.detector import Detector
from swarmtrack.detection.metadata import LONGEST_ENTRY
from swarmtrack.detection.model import metadata_of, model_path
from swarmtrack.detection.readings import Trial
from swarmtrack.detection.second_stage import SecondStage
from swarmtrack.errors import ModelError

TRIAL = Trial((96, 64), ((1, 1, 16, 24), (1, 2, 16, 24), (1, 2, 16, 24)))
OURS = dict(metadata_of(model_path("default")))
THEIRS = {"author": "Ultralytics", "task": "detect", "stride": "32", "names": "{0: 'drone', 1: 'bird'}"}
YOLO = Trial((160, 128), ((1, 6, 420),))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("stride", "1" * 5000),
        ("multiple", "1000000000"),
        ("scale", "NaN"),
        ("scale", "[0.0, 1.0, 1.0]"),
        ("scale", "[" * 100_000),
        ("mean", "[1e308, 0, 0]"),
        ("mean", "[NaN, 0, 0]"),
        ("mean", "[1e400, 0, 0]"),
        ("calibration", "[0, 0]"),
        ("calibration", "[-1, 0]"),
        ("calibration", "[NaN, NaN]"),
        ("names", "[" * 60_000),
        ("names", json.dumps(["x" * LONGEST_ENTRY])),
        ("pad_value", "\x1b[2J"),
        ("box_width", "[" * 60_000),
    ],
)
def test_numbers_that_no_detector_has_are_refused(key, value):
    with pytest.raises(ModelError, match=rf"metadata swarmtrack\.{key} is .*expected") as refused:
        describe("m.onnx", OURS | {f"swarmtrack.{key}": value}, TRIAL, Declared())
    assert len(str(refused.value)) < 500
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("names", "[" * 5000),
        ("names", "0" + "-0" * 30_000),
        ("names", "-" * 60_000),
        ("names", "(" * 200 + ")" * 200),
        ("stride", "1e400"),
        ("stride", "nan"),
        ("stride", "-5"),
    ],
)
def test_metadata_of_others_are_read_with_the_same_care(key, value):
    with pytest.raises(ModelError, match="Ultralytics metadata are") as refused:
        describe("m.onnx", THEIRS | {key: value}, YOLO, Declared())
    assert len(str(refused.value)) < 600


def test_names_of_classes_command_no_terminal():
    described = describe(
        "m.onnx", THEIRS | {"names": repr({0: "drone", 1: "\x1b[2J" * 99})}, YOLO, Declared()
    )
    assert described.names[1].isprintable()
    assert len(described.names[1]) <= 64


@pytest.mark.parametrize(
    "count",
    [300, pytest.param(MUTANTS, marks=pytest.mark.long("thousands of mutants, not 300"))],
    ids=["short", "long"],
)
@pytest.mark.parametrize(("good", "trial"), [(OURS, TRIAL), (THEIRS, YOLO)], ids=["ours", "theirs"])
def test_any_mutation_of_good_metadata_is_read_or_refused(count, good, trial):
    assert describe("m.onnx", good, trial, Declared()).drones
    refused = []
    for number, mutant in enumerate(mutants(json.dumps(good).encode(), 4 * count, seed=3, text=True)):
        try:
            written = json.loads(mutant)
        except (ValueError, RecursionError):
            # In the file, metadata are pairs of texts: one of them is spoilt instead.
            key = sorted(good)[number % len(good)]
            written = good | {key: mutant[: len(mutant) // 2].decode(errors="replace")}
        if not isinstance(written, dict):
            continue
        written = {
            str(key): value if isinstance(value, str) else json.dumps(value) for key, value in written.items()
        }
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", SyntaxWarning)
                found = describe("m.onnx", written, trial, Declared())
        except ModelError as error:
            refused.append(str(error))
            continue
        assert np.isfinite([*found.scale, *found.mean, *found.calibration, found.score_threshold]).all()
    assert refused
    assert all(said.isprintable() for said in refused)


def test_a_net_of_a_huge_answer_is_not_run(tmp_path):
    onnx = pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")
    helper, shape = onnx.helper, [1, 6, 10**10]
    graph = helper.make_graph(
        [
            helper.make_node("ReduceMax", ["images"], ["most"], keepdims=0),
            helper.make_node("Expand", ["most", "shape"], ["out"]),
        ],
        "net",
        [helper.make_tensor_value_info("images", onnx.TensorProto.FLOAT, (1, 3, 64, 96))],
        [helper.make_tensor_value_info("out", onnx.TensorProto.FLOAT, shape)],
        [helper.make_tensor("shape", onnx.TensorProto.INT64, [3], shape)],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path = tmp_path / "huge.onnx"
    onnx.save(model, str(path))
    for load in (Detector, SecondStage):
        with pytest.raises(
            ModelError, match=r"its output out has the shape \[1, 6, 10000000000\], expected 50000000"
        ):
            load(path)


def test_a_net_that_never_answers_is_given_up(tmp_path, monkeypatch):
    onnx = pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")
    helper = onnx.helper
    monkeypatch.setattr(model_file, "TRIAL_S", 0.3)

    def value(name, shape=(), kind=onnx.TensorProto.FLOAT):
        return helper.make_tensor_value_info(name, kind, shape)

    go_on = value("go", (), onnx.TensorProto.BOOL)
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["go_on"]),
            helper.make_node("Sin", ["carried"], ["carried_on"]),
        ],
        "body",
        [value("i", (), onnx.TensorProto.INT64), go_on, value("carried", (1, 3, 64, 96))],
        [value("go_on", (), onnx.TensorProto.BOOL), value("carried_on", (1, 3, 64, 96))],
    )
    graph = helper.make_graph(
        [
            helper.make_node("ReduceMax", ["images"], ["most"], keepdims=0),
            helper.make_node("Less", ["most", "one"], ["yes"]),
            helper.make_node("Loop", ["", "yes", "images"], ["out"], body=body),
        ],
        "net",
        [value("images", (1, 3, 64, 96))],
        [value("out", (1, 3, 64, 96))],
        [helper.make_tensor("one", onnx.TensorProto.FLOAT, (), [1.0])],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path = tmp_path / "endless.onnx"
    onnx.save(model, str(path))
    with pytest.raises(ModelError, match=r"no answer within 0\.3 s to a trial image of 96x64"):
        Detector(path)
