"""Nets that others trained: recognised or refused in a sentence, and read to a hundredth of a pixel."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")

from onnx import TensorProto

from support.foreign_nets import BOX, ours, spot_net, ultralytics
from swarmtrack.detection.description import Declared
from swarmtrack.detection.detector import Detector
from swarmtrack.detection.model import cache_folder
from swarmtrack.errors import ModelError
from swarmtrack.messages import Frame, StampKind

HEADS = ("yolo_v8", "yolo_v5", "end_to_end", "detr")


def picture(centre, *, width=640, height=512, sigma=6.0, colour=(1.0, 1.0, 1.0)):
    """A smooth spot on black, (h, w, 3) BGR."""
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    spot = np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * sigma**2))
    return (255 * spot[:, :, None] * np.array(colour)).round().astype(np.uint8)


def look(detector, image):
    found = detector.detect(detector.plan(Frame(1.0, 0.0, 1, image, StampKind.MEDIA)))
    assert found is not None, detector.status().text
    return found


@pytest.mark.parametrize("head", HEADS)
def test_a_net_of_ultralytics_is_understood_and_read_exactly(tmp_path, head):
    """A frame of 640x512 in an input of 160x128: a fourth in scale, so that half a pixel forgotten would be two."""
    path = spot_net(tmp_path / "net.onnx", head, written=ultralytics("drone"))
    detector = Detector(path, declared=Declared(head="detr") if head == "detr" else Declared())
    assert detector.description.head == head
    assert detector.description.source.startswith("Ultralytics' metadata")
    errors = []
    for centre in np.random.default_rng(0).uniform([200, 150], [440, 360], (8, 2)):
        found = look(detector, picture(centre, sigma=24.0))
        assert len(found.centre) == 1
        assert found.size[0] == pytest.approx(np.multiply(BOX, 4.0))
        errors.append(found.centre[0] - centre)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.01


@pytest.mark.parametrize("head", [*HEADS[:3], "detr_of_two_outputs"])
def test_a_net_without_metadata_is_recognised_by_its_outputs(tmp_path, head):
    two = head == "detr_of_two_outputs"
    path = spot_net(tmp_path / "net.onnx", "detr" if two else head, logits=two)
    detector = Detector(path, declared=Declared(names=("drone",)))
    assert detector.description.head == ("detr" if two else head)
    assert look(detector, picture((300.0, 200.0))).centre[0] == pytest.approx([300.0, 200.0], abs=0.3)


def test_our_own_metadata_say_more_than_shapes_do(tmp_path):
    path = spot_net(
        tmp_path / "net.onnx", "yolo_v8", written=ours("yolo_v8", "drone", score_threshold="0.95")
    )
    detector = Detector(path)
    assert detector.score_threshold == 0.95
    assert len(look(detector, picture((300.0, 200.0))).centre) == 0


def test_the_channels_are_in_the_order_that_the_net_wants(tmp_path):
    """The net looks for the spot in its first channel; the picture is BGR, with a red spot and a blue one."""
    red, blue = (200.0, 150.0), (450.0, 350.0)
    image = picture(red, colour=(0, 0, 1)) + picture(blue, colour=(1, 0, 0))
    for order, where in (("RGB", red), ("BGR", blue)):
        path = spot_net(tmp_path / "net.onnx", "yolo_v8", written=ultralytics("drone"))
        detector = Detector(path, declared=Declared(channel_order=order))
        assert look(detector, image).centre[0] == pytest.approx(where, abs=0.5)


def test_scale_and_mean_are_of_each_channel(tmp_path):
    """Minus the whole of the second channel, and a third that does not count, leave a spot in the first alone."""
    path = spot_net(tmp_path / "net.onnx", "yolo_v8", channel=2, written=ultralytics("drone"))
    declared = Declared(channel_order="RGB", scale=(0.0, 0.0, 1 / 255), mean=(0.0, 0.0, 0.0))
    image = picture((200.0, 150.0), colour=(0, 0, 1)) + picture((450.0, 350.0), colour=(1, 0, 0))
    assert look(Detector(path, declared=declared), image).centre[0] == pytest.approx([450.0, 350.0], abs=0.5)


def test_a_net_of_half_precision_is_fed_so(tmp_path):
    path = spot_net(
        tmp_path / "net.onnx", "yolo_v8", element=TensorProto.FLOAT16, written=ultralytics("drone")
    )
    assert look(Detector(path), picture((300.0, 200.0))).centre[0] == pytest.approx([300.0, 200.0], abs=0.5)


COCO = ("person", "airplane", "bird", "drone")


@pytest.mark.parametrize(
    ("scores", "declared", "found"),
    [
        ((0.1, 0.1, 0.1, 0.8), Declared(), 1),
        ((0.1, 0.1, 0.9, 0.8), Declared(), 0),  # rather a bird
        ((0.9, 0.1, 0.1, 0.8), Declared(), 0),  # rather a person: not looked for either
        ((0.1, 0.8, 0.1, 0.1), Declared(classes=("airplane",)), 1),
        ((0.1, 0.8, 0.1, 0.1), Declared(classes=("AirPlane", "drone")), 1),
    ],
)
def test_only_what_is_a_drone_and_nothing_that_looks_alike_is_found(tmp_path, scores, declared, found):
    path = spot_net(tmp_path / "net.onnx", "yolo_v8", scores=scores, written=ultralytics(*COCO))
    assert len(look(Detector(path, declared=declared), picture((300.0, 200.0))).centre) == found


def test_a_look_alike_in_the_same_place_vetoes_a_fainter_drone():
    from swarmtrack.detection.heads import Candidates, suppress  # noqa: PLC0415

    both = Candidates(
        np.array([[50.0, 50], [53, 51]]), np.full((2, 2), 30.0), np.array([0.9, 0.6]), np.array([1, 0])
    )
    assert suppress(both, limit=5).label.tolist() == [1]


def test_a_score_is_calibrated_to_a_probability(tmp_path):
    written = ours("yolo_v8", "drone", calibration="[2.0, -1.0]", score_threshold="0.5")
    path = spot_net(tmp_path / "net.onnx", "yolo_v8", scores=(0.9,), written=written)
    expected = 1.0 / (1.0 + np.exp(-(2.0 * np.log(0.9 / 0.1) - 1.0)))
    assert look(Detector(path), picture((300.0, 200.0))).score[0] == pytest.approx(expected, rel=1e-4)
    faint = spot_net(tmp_path / "net.onnx", "yolo_v8", scores=(0.6,), written=written)  # calibrated: 0.45
    assert len(look(Detector(faint), picture((300.0, 200.0))).centre) == 0


@pytest.mark.parametrize(
    ("written", "declared", "sentence"),
    [
        (
            ultralytics("cat", "dog"),
            Declared(),
            r"none of its classes is called drone; they are cat, dog; .*classes",
        ),
        (
            ultralytics("cat"),
            Declared(classes=("uav",)),
            r"detector\.classes names uav, but its classes are cat",
        ),
        (ultralytics("drone"), Declared(veto=("bird",)), r"detector\.veto names bird"),
        (ultralytics("drone", task="segment"), Declared(), r"task 'segment', expected one for 'detect'"),
        (ultralytics("drone", names="drone"), Declared(), r"expected names like \{0: 'drone'\}"),
        (
            ours("yolo_v8", "drone", calibration="1"),
            Declared(),
            r"calibration is '1', expected a JSON list of two",
        ),
        ({}, Declared(head="centernet"), r"as head centernet they make no sense"),
        (
            ultralytics("drone"),
            Declared(head="end_to_end"),
            r"and 1 class; as head end_to_end they make no sense; they fit yolo_v8",
        ),
    ],
)
def test_what_cannot_be_is_said_in_a_sentence(tmp_path, written, declared, sentence):
    scores = (0.9,) * max(1, written.get("names", "").count(":"))
    path = spot_net(tmp_path / "net.onnx", "yolo_v8", written=written, scores=scores)
    with pytest.raises(ModelError, match=sentence):
        Detector(path, declared=declared)


def test_outputs_of_no_known_head_are_shown_with_what_is_known(tmp_path):
    path = spot_net(tmp_path / "net.onnx", "detr", size=(96, 64))  # (1, 300, 5), of how many classes?
    with pytest.raises(
        ModelError,
        match=r"net\.onnx: its outputs have no known format: \(1, 300, 5\) for an input of 96x64; known are",
    ):
        Detector(path)


def test_what_runs_is_reported_and_what_is_missing_is_skipped(tmp_path):
    detector = Detector(providers=("tensorrt", "cuda", "cpu"), cache=tmp_path / "engines")
    assert detector.status().text.startswith("default.onnx, second_stage.onnx on cpu")
    with pytest.raises(ModelError, match=r"none of cuda is installed here, only cpu"):
        Detector(providers=("cuda",))


def test_compiled_engines_are_kept_in_the_user_s_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "swarmtrack" / "engines"
