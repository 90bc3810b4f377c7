"""A second stage looks at each candidate alone, and its log odds are added to the detector's."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.special import expit, logit

from support.places import SHARED
from swarmtrack.detection import second_stage
from swarmtrack.detection.detector import Detector
from swarmtrack.detection.heads import Candidates
from swarmtrack.detection.second_stage import SecondStage, square
from swarmtrack.errors import ModelError
from swarmtrack.messages import Frame, StampKind
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.training import render
from swarmtrack.training.labelled_images import held_out, load_frames

SIDE = 16


def stage_net(path, *, rows="n", side=SIDE, gain=1.0, spans=False, written=None):
    """An ONNX file that answers how bright each square is above 128, in units of 100 / gain grey levels. With
    spans, how bright it is as a share of 255, too."""
    onnx = pytest.importorskip("onnx", reason="makes nets: needs onnx, of the extra dev")
    helper, single = onnx.helper, onnx.TensorProto.FLOAT
    scale = np.float32(gain / 100)
    graph = helper.make_graph(
        [
            helper.make_node("ReduceMean", ["squares"], ["mean"], axes=[1, 2, 3], keepdims=0),
            helper.make_node("Sub", ["mean", "middle"], ["above"]),
            helper.make_node("Mul", ["above", "gain"], ["log_odds"]),
            *([helper.make_node("Div", ["mean", "white"], ["span"])] if spans else []),
        ],
        "stage",
        [helper.make_tensor_value_info("squares", single, (rows, 3, side, side))],
        [
            helper.make_tensor_value_info(name, single, (rows,))
            for name in (["log_odds", "span"] if spans else ["log_odds"])
        ],
        [
            helper.make_tensor("white", single, (), [255.0]),
            helper.make_tensor("middle", single, (), [128.0]),
            helper.make_tensor("gain", single, (), [scale]),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    entries = {"head": "second_stage", "around": "1.0", "fusion": "[2.0, 0.5]", "score_threshold": "0.4"}
    entries |= {"doubt": "1.5"} | (written or {})
    for key, value in entries.items():
        if value is not None:
            entry = model.metadata_props.add()
            entry.key, entry.value = f"swarmtrack.{key}", value
    onnx.save(model, str(path))
    return path


def candidates(*rows):
    """Of (u, v, side, score)."""
    table = np.array(rows, float).reshape(-1, 4)
    return Candidates(table[:, :2], table[:, [2, 2]], table[:, 3], np.zeros(len(table), np.intp))


LOOSE = BoxWidth(factor=1.5, padding_px=4.0)


def test_log_odds_are_added_weighted(tmp_path):
    stage = SecondStage(stage_net(tmp_path / "stage.onnx"))
    image = np.full((100, 200, 3), 128, np.uint8)
    image[30:70, 130:170] = 228
    score, resize = stage.classify(image, candidates((50, 50, 20, 0.6), (150, 50, 20, 0.4)), LOOSE)
    assert score == pytest.approx(expit([logit(0.6) + 0.5, logit(0.4) + 2.0 + 0.5]), abs=1e-6)
    assert resize.tolist() == [1.0, 1.0]
    assert [len(each) for each in stage.classify(image, candidates(), LOOSE)] == [0, 0]


def test_boxes_become_as_wide_as_the_detector_draws_drones_of_the_spans_that_it_tells(tmp_path):
    written = {"around": "2.0", "box_width": '{"factor": 0.5, "padding_px": 1.0}'}
    stage = SecondStage(stage_net(tmp_path / "stage.onnx", spans=True, written=written))
    image = np.full((100, 200), 51, np.uint8)
    image[:, 100:] = 102
    image[:, 170:] = 0
    found = candidates((50, 50, 20, 0.6), (130, 50, 20, 0.4), (195, 50, 12, 0.4))
    found = found._replace(size=np.array([[20.0, 10.0], [20.0, 20.0], [12.0, 12.0]]))
    resize = stage.classify(image, found, LOOSE).resize
    # Of squares of 40 px it answers 0.2 and 0.4, which are spans of 14 and 30 px; what it says of the last is absurd.
    assert found.size[:2, 0] * resize[:2] == pytest.approx([25.0, 49.0], rel=1e-5)
    assert resize[2] == pytest.approx(1.0 / second_stage.RESIZED)


def test_a_detector_answers_such_boxes_and_says_how_far_they_are_off(tmp_path):
    frame = sky_with_a_drone()
    alone = look(Detector(second_stage="none"), frame)
    telling = {"fusion": "[0.0, 0.0]", "box_width": '{"factor": 0.9, "drone_sigma": 0.07}'}
    detector = Detector(second_stage=stage_net(tmp_path / "telling.onnx", spans=True, written=telling))
    (size,) = look(detector, frame).size
    drawn = detector.description.box_width
    span = frame.image[90:150, 130:190].mean() / 255 * alone.size[0].max() / 0.9
    assert size[0] == pytest.approx(drawn.factor * span + drawn.padding_px, rel=0.1)
    assert size[1] / size[0] == pytest.approx(alone.size[0, 1] / alone.size[0, 0])
    assert (detector.box_width.factor, detector.box_width.drone_sigma) == (drawn.factor, 0.07)
    silent = Detector(second_stage=stage_net(tmp_path / "silent.onnx"))
    assert silent.box_width == drawn


@pytest.mark.parametrize("side", [10.0, 32.0, 150.0])
@pytest.mark.parametrize("centre", [(100.0, 80.0), (101.3, 79.6), (6.0, 150.5)])
def test_a_square_shows_what_lies_around_its_centre_in_its_scale(side, centre):
    """By a picture whose grey levels tell the place: u and v in two channels."""
    v, u = np.mgrid[0:160, 0:200]
    picture = np.stack([u, v, np.zeros_like(u)], axis=2).astype(np.uint8)
    seen = square(picture, np.array(centre), side, 64).astype(float)
    steps = (np.arange(64) - 31.5) * side / 64
    wanted = [np.clip(centre[axis] + steps, 0, (199, 159)[axis]) for axis in (0, 1)]
    inner = np.s_[4:60]
    assert np.abs(seen[32, inner, 0] - wanted[0][inner]).max() < 2.1 + 0.03 * side
    assert np.abs(seen[inner, 32, 1] - wanted[1][inner]).max() < 2.1 + 0.03 * side


def test_grey_pictures_are_shown_as_grey():
    grey = np.random.default_rng(0).integers(0, 255, (60, 80), np.uint8)
    one = square(grey, np.array([40.0, 30.0]), 30.0, 64)
    assert one.shape == (64, 64, 3)
    assert np.array_equal(one, square(grey[..., None], np.array([40.0, 30.0]), 30.0, 64))
    assert np.array_equal(one, square(np.dstack([grey] * 3), np.array([40.0, 30.0]), 30.0, 64))


def sky_with_a_drone():
    rng = np.random.default_rng(2)
    sky = np.full((256, 320, 3), (230, 180, 130), np.float32)
    render.paste_into(rng, sky, render.multirotor(rng), np.array([160.0, 120.0]), 40)
    return Frame(0.0, 0.0, 0, sky.astype(np.uint8), StampKind.MEDIA)


def look(detector, frame):
    return detector.detect(detector.plan(frame))


def test_a_detector_asks_it_and_what_it_makes_unlikely_is_not_shown(tmp_path):
    frame = sky_with_a_drone()
    (alone,) = look(Detector(second_stage="none"), frame).score
    surer = stage_net(tmp_path / "surer.onnx", gain=0.0, written={"fusion": "[1.0, 1.0]"})
    (score,) = look(Detector(second_stage=surer), frame).score
    assert score == pytest.approx(expit(logit(alone) + 1.0), abs=1e-6)
    assert look(Detector(second_stage=surer), frame).likeness == pytest.approx(expit(logit(score) - 1.5))
    never = stage_net(tmp_path / "never.onnx", gain=0.0, written={"fusion": "[1.0, -20.0]"})
    assert len(look(Detector(second_stage=never), frame)) == 0


class Tracks:
    def __init__(self, *boxes):
        self._boxes = np.array(boxes, float).reshape(-1, 6)

    def boxes(self, exposed):
        return self._boxes

    def pixels_at(self, then, now):
        return None


def test_what_is_followed_is_shown_as_before_and_looks_no_more_like_a_drone(tmp_path):
    frame = sky_with_a_drone()
    alone = look(Detector(second_stage="none"), frame)
    never = stage_net(tmp_path / "never.onnx", gain=0.0, written={"fusion": "[1.0, -20.0]"})
    detector = Detector(second_stage=never, look="whole")
    (u, v) = alone.centre[0]
    there, elsewhere = [u + 8.0, v, 9.0, 9.0, np.nan, np.nan], [u + 80.0, v, 9.0, 9.0, 30.0, 30.0]
    seen = detector.detect(detector.plan(frame, Tracks(there, elsewhere)))
    assert seen.score == pytest.approx(alone.score)
    assert seen.likeness[0] < 1e-6
    assert len(detector.detect(detector.plan(frame, Tracks(elsewhere)))) == 0


def test_of_a_crowd_the_last_are_not_asked_about_and_not_lost(tmp_path):
    stage = SecondStage(stage_net(tmp_path / "stage.onnx"))
    bright = np.full((100, 200), 228, np.uint8)
    crowd = candidates(*((5 * i, 50, 8, 0.6) for i in range(second_stage.SECOND_STAGE_MOST_BOXES + 3)))
    score = stage.classify(bright, crowd, LOOSE).score
    assert score[: second_stage.SECOND_STAGE_MOST_BOXES] == pytest.approx(expit(logit(0.6) + 2.0 + 0.5))
    assert score[second_stage.SECOND_STAGE_MOST_BOXES :] == pytest.approx(expit(logit(0.6) + 0.5))


def test_the_shipped_stage_goes_with_the_shipped_model_and_with_no_other_unless_told(tmp_path):
    frame = sky_with_a_drone()
    shipped, again, alone = (
        look(Detector(**how), frame).score
        for how in ({}, {"second_stage": "default"}, {"second_stage": "none"})
    )
    assert np.array_equal(shipped, again)
    assert not np.array_equal(shipped, alone)
    assert not Detector(bare_copy(tmp_path)).description.second_stage


def bare_copy(folder):
    """The shipped model without a word about itself."""
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(Detector().path))
    model.ClearField("metadata_props")
    onnx.save(model, str(folder / "bare.onnx"))
    return folder / "bare.onnx"


@pytest.mark.parametrize(
    ("how", "sentence"),
    [
        ({"written": {"head": "centernet"}}, r"swarmtrack\.head is .*expected second_stage"),
        ({"written": {"head": None}}, r"swarmtrack\.head is missing"),
        ({"written": {"around": "nan"}}, r"swarmtrack\.around is .*expected a positive number"),
        ({"written": {"around": "0"}}, r"swarmtrack\.around is .*expected a positive number"),
        ({"written": {"fusion": "[1.0]"}}, r"swarmtrack\.fusion is .*expected a JSON list of two numbers"),
        ({"written": {"fusion": json.dumps([1e9, 0.0])}}, r"swarmtrack\.fusion is"),
        ({"written": {"score_threshold": "2"}}, r"swarmtrack\.score_threshold is .*expected a number in 0…1"),
        ({"written": {"doubt": "inf"}}, r"swarmtrack\.doubt is .*expected a number"),
        ({"rows": 1}, r"inputs are .*expected one of shape \[n, 3, side, side\]"),
        ({"side": 1024}, r"inputs are .*expected one of shape \[n, 3, side, side\]"),
        ({"gain": float("nan")}, "answered NaN"),
        ({"spans": True, "written": {"box_width": '{"factor": 0}'}}, r"swarmtrack\.box_width is .*factor"),
    ],
)
def test_a_stage_that_cannot_work_is_refused_in_a_sentence(tmp_path, how, sentence):
    path = stage_net(tmp_path / "stage.onnx", **how)
    with pytest.raises(ModelError, match=sentence):
        Detector(second_stage=path)


def test_a_detector_is_no_second_stage_and_a_second_stage_no_detector(tmp_path):
    with pytest.raises(ModelError, match="expected second_stage"):
        SecondStage(Detector().path)
    with pytest.raises(ModelError, match=r"second_stage'?, expected one of centernet|inputs are"):
        Detector(stage_net(tmp_path / "stage.onnx"))
    with pytest.raises(ModelError, match="no such model file"):
        Detector(second_stage=tmp_path / "nowhere.onnx")


@pytest.mark.shared
def test_pictures_without_drones_that_nobody_trained_on_look_like_drones_no_more():
    frames = load_frames(SHARED / "drones_real")
    drones = [frame for frame in frames if frame.scene == "C_blue_sky_forest"][::4]
    others = [frame for frame in frames if held_out(frame.scene, frame.source)][::6]
    share = {}
    for stage in ("none", "default"):
        detector = Detector(second_stage=stage, look="whole")
        confirms = [
            [_looks_like_a_drone(detector, frame.image) for frame in some] for some in (drones, others)
        ]
        share[stage] = [float(np.mean(some)) for some in confirms]
    assert share["default"][0] > 0.9
    assert share["default"][1] < 0.1 < share["none"][1]


def _looks_like_a_drone(detector, image):
    """Whether a track of such looks would be confirmed."""
    seen = look(detector, Frame(0.0, 0.0, 0, image, StampKind.MEDIA))
    likeness = seen.score if seen.likeness is None else seen.likeness
    return bool((likeness > 0.45).any())
