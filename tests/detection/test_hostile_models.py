"""Models from elsewhere: whatever their metadata hold, a sentence comes of it; who never answers is given up."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings

import numpy as np
import pytest

from support.mutants import MUTANTS, mutants
from swarmtrack.detection import model as model_file
from swarmtrack.detection import onnx_file
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


N = 10**10
HUGE_NODES = {
    "ConstantOfShape": ({"s": [N]}, [("ConstantOfShape", "s", "big")]),
    "Expand": ({"one": 1.0, "s": [N]}, [("Expand", "one s", "big")]),
    "Tile": ({"one": [1.0], "s": [N]}, [("Tile", "one s", "big")]),
    "Range": ({"zero": 0, "n": N, "one": 1}, [("Range", "zero n one", "r"), ("Neg", "r", "big")]),
    "Add": (
        {"s": [100_000, 1], "t": [1, 100_000]},
        [("ConstantOfShape", "s", "x"), ("ConstantOfShape", "t", "y"), ("Add", "x y", "big")],
    ),
    # No constant: of the image.
    "Expand at run time": ({"s": [N]}, [("Expand", "most s", "big")]),
    # What is computed from it is small: a size that only folding finds out.
    "ConstantOfShape of a sum": (
        {"s": [N // 2]},
        [("Add", "s s", "twice"), ("ConstantOfShape", "twice", "big")],
    ),
    "Constants that are many": (
        {"s": [15_000_000]},
        [
            each
            for k in range(60)
            for each in (
                ("ConstantOfShape", "s", f"b{k}"),
                ("Add", f"b{k} {'most' if k == 0 else f'm{k - 1}'}", f"a{k}"),
                ("ReduceMax", f"a{k}", f"m{k}"),
            )
        ]
        + [("Identity", "m59", "big")],
    ),
}
"""Constants, and (kind, inputs, output) of nodes: a few hundred bytes that ask for 40 GB."""


def save(path, nodes, constants=None, **of_model):
    """nodes: as in HUGE_NODES, or those of the library."""
    onnx = pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")
    helper, real = onnx.helper, onnx.TensorProto.FLOAT
    made = [
        each
        if not isinstance(each, tuple)
        else helper.make_node(
            each[0], each[1].split(), [each[2]], **({"keepdims": 0} if each[0] == "ReduceMax" else {})
        )
        for each in nodes
    ]
    values = {
        name: np.asarray(value, np.float32 if isinstance(np.ravel(value)[0], np.floating) else np.int64)
        for name, value in (constants or {}).items()
    }
    graph = helper.make_graph(
        [helper.make_node("ReduceMax", ["images"], ["most"], keepdims=0), *made],
        "net",
        [helper.make_tensor_value_info("images", real, (1, 3, 64, 96))],
        [helper.make_tensor_value_info("out", real, None)],
        [onnx.numpy_helper.from_array(value, name) for name, value in values.items()],
        sparse_initializer=of_model.pop("sparse", []),
    )
    imports = [helper.make_opsetid("", 17), *of_model.pop("imports", [])]
    model = helper.make_model(graph, opset_imports=imports, ir_version=9, **of_model)
    path.write_bytes(model.SerializeToString())
    return path


LOADS = """
import resource, sys
from pathlib import Path
resource.setrlimit(resource.RLIMIT_AS, (16 << 30, 16 << 30))  # whatever fails, this machine lives
from swarmtrack.detection.detector import Detector
from swarmtrack.errors import ModelError
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sys.argv[1:]:
    try:
        Detector(Path(path))
        print("LOADED")
    except ModelError as error:
        print(str(error).replace("\\n", "NEWLINE"))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before >> 10)
"""


def test_nets_that_ask_for_more_memory_than_there_is_are_refused_in_a_sentence_and_little_memory(tmp_path):
    paths = []
    for name, (constants, nodes) in HUGE_NODES.items():
        ends = [("Cast", "big", "real"), ("ReduceMax", "real", "small"), ("Add", "most small", "out")]
        onnx = pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")
        ends[0] = onnx.helper.make_node("Cast", ["big"], ["real"], to=onnx.TensorProto.FLOAT)
        paths.append(save(tmp_path / f"{name}.onnx", [*nodes, *ends], constants))
    ran = subprocess.run(
        [sys.executable, "-c", LOADS, *map(str, paths)], capture_output=True, text=True, check=True
    )
    *said, megabytes = ran.stdout.splitlines()
    assert len(said) == len(paths)
    for sentence, path in zip(said, paths, strict=True):
        kind, _, more = path.stem.partition(" ")
        assert sentence.startswith(f"{path}: ")
        assert more == "that are many" or f": its {kind} asks for " in sentence, sentence
        assert more == "that are many" or "GB at most for all of a net" in sentence
    assert int(megabytes) < 200


def test_sparse_tensors_are_refused_before_they_are_spread_out(tmp_path):
    onnx = pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")
    helper = onnx.helper
    values = helper.make_tensor("sparse", onnx.TensorProto.FLOAT, [1], [1.0])
    places = helper.make_tensor("at", onnx.TensorProto.INT64, [1], [0])
    sparse = helper.make_sparse_tensor(values, places, [400_000_000])
    ends = [("ReduceMax", "sparse", "small"), ("Add", "most small", "out")]
    constant = helper.make_node("Constant", [], ["sparse"], sparse_value=sparse)
    inner = helper.make_graph([constant], "g", [], [helper.make_tensor_value_info("sparse", 1, None)])
    branches = helper.make_node("If", ["yes"], ["sparse"], then_branch=inner, else_branch=inner)
    for path in (
        save(tmp_path / "initializer.onnx", ends, sparse=[sparse]),
        save(tmp_path / "constant.onnx", [constant, *ends]),
        save(tmp_path / "branch.onnx", [branches, *ends]),
    ):
        with pytest.raises(ModelError, match=r"holds a sparse tensor, .* expected dense ones"):
            Detector(path)


def test_functions_that_call_each_other_twice_are_refused_before_they_unfold(tmp_path):
    onnx = pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")
    helper = onnx.helper
    own, theirs = helper.make_opsetid("own", 1), helper.make_opsetid("", 17)
    functions = [
        helper.make_function("own", "F0", ["x"], ["z"], [helper.make_node("Sin", ["x"], ["z"])], [theirs])
    ]
    for k in range(1, 60):
        calls = [helper.make_node(f"F{k - 1}", [a], [b], domain="own") for a, b in (("x", "y"), ("y", "z"))]
        functions.append(helper.make_function("own", f"F{k}", ["x"], ["z"], calls, [theirs, own]))
    call = helper.make_node("F59", ["most"], ["out"], domain="own")
    path = save(tmp_path / "laughs.onnx", [call], functions=functions, imports=[own])
    with pytest.raises(ModelError, match=r"holds functions of its own, .* onnx\.inliner"):
        Detector(path)


def test_the_fields_that_are_looked_at_are_those_of_onnx():
    onnx = pytest.importorskip("onnx", reason="knows the numbers: needs onnx, of the extra dev")
    named = {
        onnx_file._OnnxMessage.MODEL: (onnx.ModelProto, {"graph", "functions"}),
        onnx_file._OnnxMessage.GRAPH: (onnx.GraphProto, {"node", "sparse_initializer"}),
        onnx_file._OnnxMessage.NODE: (onnx.NodeProto, {"attribute"}),
        onnx_file._OnnxMessage.ATTRIBUTE: (
            onnx.AttributeProto,
            {"g", "graphs", "sparse_tensor", "sparse_tensors"},
        ),
    }
    for kind, numbers in onnx_file.INSIDE.items():
        message, names = named[kind]
        assert {message.DESCRIPTOR.fields_by_number[number].name for number in numbers} == names


@pytest.mark.parametrize("name", ["default", "second_stage"])
def test_the_nodes_of_a_net_are_counted(name):
    onnx = pytest.importorskip("onnx", reason="counts as well: needs onnx, of the extra dev")
    path = model_path("default").with_name(f"{name}.onnx")
    assert onnx_file.count_nodes(path) == len(onnx.load(str(path)).graph.node)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"half of a model",
        b"\x3a\x05ab",
        b"\x08" + b"\xff" * 20,
        b"\xfa\x80\x80\x80\x10\x00",
        b"\x08\x01" * 600_000,
    ],
    ids=["empty", "text", "cut", "endless number", "field number that parsers disagree about", "many fields"],
)
def test_what_is_no_onnx_file_is_said_to_be_none(tmp_path, data):
    path = tmp_path / "m.onnx"
    path.write_bytes(data)
    with pytest.raises(ModelError, match=r"m\.onnx: is no ONNX file, or a damaged one"):
        Detector(path)


@pytest.mark.parametrize(
    "count",
    [40, pytest.param(MUTANTS // 10, marks=pytest.mark.long("hundreds of mutants, not 40"))],
    ids=["short", "long"],
)
def test_any_mutation_of_a_file_is_counted_or_refused(count, tmp_path):
    path, refused = tmp_path / "m.onnx", []
    for mutant in mutants(model_path("default").with_name("second_stage.onnx").read_bytes(), count, seed=6):
        path.write_bytes(mutant)
        try:
            assert onnx_file.count_nodes(path) >= 0
        except ModelError as error:
            refused.append(str(error))
    assert refused
    assert all(said.isprintable() for said in refused)


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
