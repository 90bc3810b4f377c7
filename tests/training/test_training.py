"""Procedural pictures, targets, the numbers of an evaluation, and a training of a few steps."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from support.labelled_pictures import data_directory
from swarmtrack.agents.main import main
from swarmtrack.detection.detector import Detector
from swarmtrack.detection.heads import centernet
from swarmtrack.lab.score import detector_score
from swarmtrack.messages import Detections, Frame, StampKind
from swarmtrack.training import dataset, render
from swarmtrack.training.dataset import Recipe, SampleSource
from swarmtrack.training.labelled_images import DataError, load_frames


def test_a_seed_names_a_picture():
    first, again, other = (SampleSource([], Recipe(), np.random.default_rng(seed)) for seed in (4, 4, 5))
    for _ in range(1):
        sample, same, different = first.sample(), again.sample(), other.sample()
        assert all(np.array_equal(a, b) for a, b in zip(sample, same, strict=True))
        assert not np.array_equal(sample.image, different.image)


@pytest.mark.parametrize("name", ["multirotor", *render.DISTRACTORS])
def test_every_sprite_is_visible_and_its_colour_is_within_its_alpha(name):
    draw = {"multirotor": render.multirotor, **render.DISTRACTORS}[name]
    for seed in range(10):
        sprite = draw(np.random.default_rng(seed))
        assert sprite.alpha.max() > 0.04
        assert sprite.alpha.min() >= 0
        assert sprite.alpha.max() <= 1.001
        assert (sprite.colour <= 255 * sprite.alpha[..., None] + 0.5).all()


def test_a_pasted_sprite_is_where_its_box_says():
    image = np.full((120, 160, 3), 255, np.float32)
    black = render.Sprite(np.zeros((64, 64, 3), np.float32), np.ones((64, 64), np.float32))
    box = render.paste_into(np.random.default_rng(0), image, black, np.array([60.0, 50.0]), 33)
    assert box is not None
    rows, columns = np.mgrid[0:120, 0:160]
    dark = 255 - image[..., 0]
    assert (dark * columns).sum() / dark.sum() == pytest.approx(box[0], abs=0.05)
    assert (dark * rows).sum() / dark.sum() == pytest.approx(box[1], abs=0.05)
    assert box[2:].tolist() == [33, 33]


def test_targets_decode_to_the_boxes_they_were_made_of():
    """The trainer's encoding and the detector's decoding are written apart; they must be inverses."""
    boxes = np.array([[30.3, 41.8, 24.0, 15.0], [101.2, 90.5, 60.0, 33.0]])
    wanted = dataset.targets(boxes, 160, 4)
    description = Detector("default").description
    found = centernet(
        [wanted.heat[None, :1], wanted.offset[None], wanted.log_size[None]], description, 0.9, (160, 160)
    )
    order = np.argsort(found.centre[:, 0])
    assert found.centre[order] == pytest.approx(boxes[:, :2], abs=1e-4)
    assert found.size[order] == pytest.approx(boxes[:, 2:], rel=1e-4)


def test_a_cut_out_pasted_onto_its_own_sky_gives_the_photograph_back():
    rng = np.random.default_rng(3)
    sky = np.full((120, 160, 3), (220, 170, 120), np.float32) + np.linspace(0, 20, 160)[None, :, None]
    scene = sky.astype(np.float32).copy()
    box = render.paste_into(rng, scene, render.multirotor(rng), np.array([80.0, 60.0]), 36)
    assert box is not None
    photograph = (scene + rng.normal(0, 1, scene.shape)).clip(0, 255).astype(np.uint8)
    label = np.array([*box[:2], *(box[2:] + 12)])
    cut = dataset.cut_out(photograph, label)
    assert cut is not None
    assert cut.tight[:2] == pytest.approx(box[:2], abs=3)
    h, w = cut.sprite.alpha.shape
    left, top = (round(cut.tight[0] - (w - 1) / 2), round(cut.tight[1] - (h - 1) / 2))
    window = np.s_[top : top + h, left : left + w]
    pasted = sky[window] * (1 - cut.sprite.alpha[..., None]) + cut.sprite.colour
    assert np.abs(pasted - photograph[window]).mean() < 4


def test_a_label_on_clutter_gives_no_cut_out():
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (100, 100, 3)).astype(np.uint8)
    assert dataset.cut_out(noise, np.array([50.0, 50.0, 20.0, 20.0])) is None


# --- data directories


def test_the_hash_of_data_changes_with_a_single_label(tmp_path):
    frames = load_frames(data_directory(tmp_path))
    before = dataset.data_hash(frames)
    assert dataset.data_hash(frames[::-1]) == before
    frames[0].drones[0, 0] += 0.1
    assert dataset.data_hash(frames) != before


def test_wrong_data_is_named_by_file_and_line(tmp_path):
    with pytest.raises(DataError, match=r"no labelled images; expected images\.csv"):
        load_frames(tmp_path)
    root = data_directory(tmp_path / "a")
    (root / "images" / "1.png").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"images\.csv:3: .*1\.png"):
        load_frames(root)
    root = data_directory(tmp_path / "b")
    (root / "labels.csv").write_text("image,x,y,w,h,label\n0.png,1,2,three,4,drone\n")
    with pytest.raises(DataError, match=r"labels\.csv:2: .*three"):
        load_frames(root)


# --- evaluation


def looked(centres: list[tuple[float, float]], scores: list[float], drones: list[tuple[float, float]]):
    n = len(scores)
    found = Detections(
        0.0, 0, np.array(centres, float).reshape(n, 2), np.full((n, 2), 20.0), np.array(scores)
    )
    boxes = np.array([(*drone, 20.0, 20.0) for drone in drones], float).reshape(-1, 4)
    return detector_score.ScoredImage(found, boxes)


def test_average_precision_of_a_worked_example():
    """Two drones; detections by score: hit, false, hit. Precision 1 up to recall 0.5, then 2/3."""
    looks = [looked([(50, 50), (150, 150)], [0.9, 0.5], [(52, 50)]), looked([(10, 10)], [0.3], [(10, 12)])]
    matches = detector_score.match(looks, detector_score.by_centre)
    assert matches.hit.tolist() == [True, False, True]
    assert matches.average_precision() == pytest.approx((51 * 1 + 50 * 2 / 3) / 101)
    assert matches.recall_at(0.1) == 0.5
    assert matches.recall_at(0.5) == 1.0


def test_a_label_is_hit_once():
    matches = detector_score.match(
        [looked([(50, 50), (51, 50)], [0.9, 0.8], [(50, 50)])], detector_score.by_centre
    )
    assert matches.hit.tolist() == [True, False]


def test_nothing_found_is_zero_and_not_an_error():
    report = detector_score.summary([looked([], [], [(5, 5)])], 0.3)
    assert (report["centre_ap"], report["recall"], report["false_per_image"]) == (0.0, 0.0, 0.0)


# --- training


def train(*options):
    return main(["train", "--batch", "4", "--network", "nano", "--crop", "96", *map(str, options)])


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return data_directory(tmp_path_factory.mktemp("training") / "data")


def test_a_training_of_a_few_steps_writes_a_model_that_loads_and_is_the_same_twice(tmp_path, data, capsys):
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    out = [tmp_path / "a.onnx", tmp_path / "b.onnx"]
    for path in out:
        assert train("--data", data, "--out", path, "--licence", "CC0-1.0", "--iterations", "3") == 0
    entries = [Detector(path).description.entries for path in out]
    assert entries[0]["licence"] == "CC0-1.0"
    assert entries[0]["data_sha256"] == dataset.data_hash(load_frames(data))
    for entry in entries:
        del entry["training_minutes"]
    assert entries[0] == entries[1]
    assert weights(out[0]) == weights(out[1])
    assert "report:" in capsys.readouterr().out


def weights(path):
    onnx = pytest.importorskip("onnx")
    return [tensor.raw_data for tensor in onnx.load(str(path)).graph.initializer]


def test_the_report_has_curves_and_the_worst_errors(tmp_path, data):
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    out = tmp_path / "a.onnx"
    assert train("--data", data, "--out", out, "--hold-out", "scene", "--iterations", "2") == 0
    report = json.loads((tmp_path / "a.report" / "train.json").read_text())
    assert not report["images_were_trained_on"]
    assert report["history"][-1]["images"] >= 2
    assert set(report["final"]) >= {"centre_ap", "recall_1fppi", "recall_01fppi"}
    assert cv2.imread(str(tmp_path / "a.report" / "worst.jpg")).shape[1] == 6 * 160


def test_a_training_goes_on_where_it_stopped(tmp_path, data, capsys):
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    out = tmp_path / "a.onnx"
    assert train("--data", data, "--out", out, "--iterations", "2") == 0
    before = weights(out)
    assert train("--data", data, "--out", out, "--iterations", "4", "--resume") == 0
    assert len(json.loads((tmp_path / "a.report" / "train.json").read_text())["history"]) == 2
    assert weights(out) != before
    assert train("--data", data, "--out", out, "--iterations", "6", "--resume", "--seed", "9") == 2
    assert "another training" in capsys.readouterr().err


def test_a_checkpoint_is_exported_as_the_model_that_was_written_beside_it(tmp_path, data):
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    out = tmp_path / "a.onnx"
    assert train("--data", data, "--out", out, "--iterations", "2") == 0
    again = tmp_path / "again.onnx"
    assert main(["export", str(tmp_path / "a.pt"), "--precision", "fp32", "--out", str(again)]) == 0
    assert weights(again) == weights(out)


def test_the_papers_network_is_trained_and_exported_too(tmp_path):
    pytest.importorskip("torch")
    pytest.importorskip("onnx")
    out = tmp_path / "paper.onnx"
    options = ["train", "--network", "resnet34", "--batch", "2", "--crop", "64", "--iterations", "1"]
    assert main([*options, "--out", str(out)]) == 0
    detector = Detector(out)
    found = detector.detect(
        detector.plan(Frame(0.0, 0.0, 0, np.zeros((64, 96, 3), np.uint8), StampKind.MEDIA))
    )
    assert found is not None
    assert 95 < out.stat().st_size / 1e6 < 130


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--crop", "100"], "found 100, expected a multiple of 32"),
        (["--network", "vgg"], "expected a value: plain, nano, resnet34"),
        (["--start", "nowhere.pt"], "nowhere.pt: no such file"),
        (["--resume"], "no such checkpoint"),
        (["--batch", "0"], "found 0, expected a whole number above 0"),
        (["--hold-out", "moon"], "--hold-out moon: expected one of --data, which is missing"),
        (["--out", "/nowhere/m.onnx"], "its folder does not exist"),
    ],
)
def test_wrong_options_are_refused_before_any_work(tmp_path, capsys, arguments, sentence):
    pytest.importorskip("torch")
    try:
        code = main(["train", "--out", str(tmp_path / "m.onnx"), "--iterations", "1", *arguments])
    except SystemExit as exit:
        code = exit.code
    assert code == 2
    assert sentence in capsys.readouterr().err


def test_a_file_that_is_no_checkpoint_is_named(tmp_path, capsys):
    pytest.importorskip("torch")
    (tmp_path / "junk.pt").write_bytes(b"junk")
    code = main(["train", "--out", str(tmp_path / "m.onnx"), "--start", str(tmp_path / "junk.pt")])
    assert code == 2
    assert "junk.pt: not a checkpoint" in capsys.readouterr().err


def test_missing_data_is_said_in_one_line(tmp_path, capsys):
    pytest.importorskip("torch")
    code = main(["train", "--data", str(tmp_path), "--out", str(tmp_path / "m.onnx"), "--iterations", "1"])
    assert code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_what_flies_and_is_no_drone_is_labelled_as_that():
    source = SampleSource(
        [], Recipe(empty=1.0, real_frame=0.0, real_background=0.0), np.random.default_rng(2)
    )
    others = [sample.others for sample in (source.sample() for _ in range(80))]
    assert sum(map(len, others)) > 10
    for boxes in others:
        heat = dataset.targets(np.empty((0, 4)), 160, 4, others=boxes).heat
        assert heat[0].max() == 0.0
        assert len(boxes) == 0 or heat[1].max() == 1.0


def test_close_ups_show_drones_as_near_as_they_come():
    recipe = Recipe().of_close_ups()
    source = SampleSource([], recipe, np.random.default_rng(0))
    sizes = [max(box[2:]) for _ in range(6) for box in source.sample().drones]
    assert max(sizes) > 200
    assert recipe.crop == 320
