"""A second stage is trained on a detector's candidates, and its scores are fitted beside the detector's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from support.labelled_pictures import data_directory
from swarmtrack.agents.main import main
from swarmtrack.detection.detector import Detector
from swarmtrack.messages import Frame, StampKind
from swarmtrack.training.candidates import (
    DRONE_CLASS,
    KEPT_AROUND,
    KEPT_SIDE_PX,
    OTHER,
    Candidate,
    CandidateSource,
)
from swarmtrack.training.dataset import Recipe, SampleSource
from swarmtrack.training.labelled_images import LabelledFrame, load_frames
from swarmtrack.training.simulated_pictures import simulated_pictures

pytest.importorskip("torch", reason="trains: needs torch, of the extra train")
pytest.importorskip("onnx")
fit = pytest.importorskip("swarmtrack.training.second_stage").fit


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return data_directory(tmp_path_factory.mktemp("training") / "data")


def source(seed=0):
    net = Detector(look="whole", second_stage="none").net
    return CandidateSource(net, np.random.default_rng(seed))


def test_candidates_are_named_by_the_labels_and_shown_in_the_middle(data):
    found = list(source().of_whole_frames(load_frames(data)))
    drones = [candidate for candidate in found if candidate.kind == DRONE_CLASS]
    assert len(drones) >= 3
    assert all(candidate.picture.shape == (KEPT_SIDE_PX, KEPT_SIDE_PX, 3) for candidate in found)
    for candidate in drones:
        grey = candidate.picture.astype(float).mean(axis=2)
        middle = grey[KEPT_SIDE_PX // 3 : -KEPT_SIDE_PX // 3, KEPT_SIDE_PX // 3 : -KEPT_SIDE_PX // 3]
        assert middle.std() > 5.0


def test_what_the_detector_overlooks_is_a_candidate_too():
    grey = np.full((200, 240, 3), 128, np.uint8)
    box = np.array([[100.0, 90.0, 30.0, 20.0]])
    none = np.empty((0, 4))
    found = [
        candidate
        for frame in (
            LabelledFrame("a", "clip", "scene", grey, box, none),
            LabelledFrame("b", "gulls", "negative", grey, none, box, ("bird",)),
        )
        for candidate in source().of_whole_frames([frame])
    ]
    assert [candidate[1:4] for candidate in found] == [(DRONE_CLASS, "clip", 0.0), ("bird", "gulls", 0.0)]
    assert all(np.isnan(candidate.span) for candidate in found)


def test_spans_are_those_of_the_simulated_world_or_of_what_is_visible_in_front_of_the_sky():
    simulated = [each for each in source().of_frames(simulated_pictures(6, 0)) if each.kind == DRONE_CLASS]
    assert len(simulated) >= 3
    for drone in simulated:
        # Boxes are 1.2 to 2 spans wide, or less where the drone banks; a picture shows 2.4 of them.
        assert KEPT_SIDE_PX / KEPT_AROUND / 3.0 < drone.span < KEPT_SIDE_PX / KEPT_AROUND * 1.5
    sky = np.full((200, 240, 3), 200, np.uint8)
    sky[80:90, 100:157] = 40
    frame = LabelledFrame("a", "clip", "scene", sky, np.array([[128.0, 84.5, 80.0, 40.0]]), np.empty((0, 4)))
    (drone,) = (each for each in source().of_whole_frames([frame]) if each.kind == DRONE_CLASS)
    visible = (drone.picture[:, :, 0].min(axis=0) < 120).sum()
    assert drone.span == pytest.approx(visible / 1.14, rel=0.06)


def test_drawn_candidates_come_by_seed_and_are_of_both_kinds():
    def some(seed):
        samples = SampleSource([], Recipe(), np.random.default_rng(seed))
        return list(source(seed).of_drawn(samples.sample() for _ in range(12)))

    first, again = some(4), some(4)
    assert {candidate.kind for candidate in first} == {DRONE_CLASS, OTHER}
    assert all(np.array_equal(a.picture, b.picture) for a, b in zip(first, again, strict=True))


def test_the_fit_finds_the_weight_that_the_candidates_were_made_with():
    rng = np.random.default_rng(0)
    drone = rng.random(20_000) < 0.3
    odds, log_odds = rng.normal(np.where(drone, 1.0, -1.0), 1.0), rng.normal(np.where(drone, 2.0, -1.0), 1.5)
    # Gaussians of one width: the log odds of being a drone are a sum of both, 2 · odds + 3 / 1.5² · log_odds + …
    empty = np.zeros((0, 0, 3), np.uint8)
    held_out = [
        Candidate(empty, DRONE_CLASS if is_drone else OTHER, "clip", float(expit(odd)))
        for is_drone, odd in zip(drone.tolist(), odds, strict=True)
    ]
    found = fit(held_out, log_odds)
    assert found.weight == pytest.approx(3.0 / 1.5**2 / 2.0, rel=0.1)
    # … and a ghost counts as much as four drones.
    assert found.offset == pytest.approx((-0.5 * 3.0 / 1.5**2 - np.log(4.0)) / 2.0, abs=0.1)
    assert fit(held_out[:30], log_odds[:30]) == (0.7, -1.0)


def train(*options):
    few = ["--drawn", "12", "--simulated", "2", "--iterations", "3", "--batch", "8"]
    return main(["train-second-stage", *few, *map(str, options)])


def weights(path):
    onnx = pytest.importorskip("onnx")
    return [tensor.raw_data for tensor in onnx.load(str(path)).graph.initializer]


def test_a_training_of_a_few_steps_writes_a_stage_that_flies_and_is_the_same_twice(tmp_path, data, capsys):
    out = [tmp_path / "a.onnx", tmp_path / "b.onnx"]
    for path in out:
        assert train("--data", data, "--out", path, "--licence", "CC0-1.0") == 0
    assert weights(out[0]) == weights(out[1])
    assert "candidates to train on" in capsys.readouterr().err
    detector = Detector(second_stage=out[0], score_threshold=0.01)
    image = load_frames(data)[0].image
    seen = detector.detect(detector.plan(Frame(0.0, 0.0, 0, image, StampKind.MEDIA)))
    alone = Detector(second_stage="none", score_threshold=0.01)
    assert len(seen.likeness) >= 1
    assert seen.score[0] != alone.detect(alone.plan(Frame(0.0, 0.0, 0, image, StampKind.MEDIA))).score[0]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--detector", "nowhere.onnx"], "nowhere.onnx: no such model file"),
        (["--out", "/nowhere/m.onnx"], "its folder does not exist"),
        (["--hold-out", "moon"], "--hold-out moon: expected one of --data, which is missing"),
    ],
)
def test_wrong_options_are_refused_before_any_work(tmp_path, capsys, arguments, sentence):
    assert train("--out", tmp_path / "m.onnx", *arguments) == 2
    assert sentence in capsys.readouterr().err
