"""`swarmtrack bench detector`: what it counts, and what it writes."""

from __future__ import annotations

import csv
import json

import cv2
import numpy as np
import pytest

from swarmtrack.agents.main import main
from swarmtrack.lab.score import detector_score
from swarmtrack.lab.score.detector_score import ScoredImage
from swarmtrack.messages import Detections
from swarmtrack.training import render


def looked(found, drones, distractors=(), kinds=()):
    """found (u, v, score); drones, distractors (u, v, w, h)."""
    table = np.array(found, float).reshape(-1, 3)
    detections = Detections(0.0, 0, table[:, :2], np.full((len(table), 2), 20.0), table[:, 2])
    boxes = [np.array(each, float).reshape(-1, 4) for each in (drones, distractors)]
    return ScoredImage(detections, *boxes, tuple(kinds))


def test_recall_is_told_by_the_size_of_what_was_labelled():
    looks = [looked([(50, 50, 0.9), (150, 50, 0.8)], [(50, 50, 10, 8), (150, 50, 40, 20), (90, 90, 12, 12)])]
    small, large = detector_score.by_size(detector_score.match(looks, detector_score.by_centre), 0.5)
    assert (small.drones, small.recall, small.high) == (2, 0.5, 16.0)
    assert (large.drones, large.recall, large.low) == (1, 1.0, 32.0)
    (small, _) = detector_score.by_size(detector_score.match(looks, detector_score.by_centre), 0.95)
    assert small.recall == 0.0


def test_a_bird_taken_for_a_drone_is_counted_by_its_kind():
    bird, plane = (50, 50, 20, 20), (150, 150, 30, 30)
    looks = [
        looked([(51, 50, 0.9)], [], [bird], ["bird"]),
        looked([(152, 150, 0.3)], [], [plane], ["airplane"]),
        looked([(10, 10, 0.9)], [(10, 10, 20, 20)], [bird], ["bird"]),
        looked([], []),
    ]
    fired = detector_score.fired_on(looks, 0.5)
    assert fired == {"bird": (1, 2), "airplane": (0, 1), "anything": (1, 3)}


def test_the_threshold_of_a_recall_is_the_highest_that_reaches_it():
    scores = [0.9, 0.8, 0.7, 0.6]
    looks = [
        looked(
            [(50 * i, 50, s) for i, s in enumerate(scores, 1)], [(50 * i, 50, 20, 20) for i in range(1, 6)]
        )
    ]
    matches = detector_score.match(looks, detector_score.by_centre)
    assert matches.threshold_of(0.6) == 0.7
    assert matches.threshold_of(0.9) == 0.0


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Twelve pictures of one drone, and six of a bird only."""
    root = tmp_path_factory.mktemp("data")
    (root / "images").mkdir()
    rng = np.random.default_rng(1)
    images, labels = [], []
    for i in range(18):
        sky = np.full((256, 320, 3), (220, 180, 140), np.float32)
        draw, kind = (render.multirotor, "drone") if i < 12 else (render.DISTRACTORS["bird"], "bird")
        u, v, w, h = render.paste_into(rng, sky, draw(rng), np.array([160.0, 120.0]), 40)
        labels.append([f"{i}.png", u - w / 2, v - h / 2, w, h, kind])
        images.append([f"{i}.png", "drawn", "sky" if i < 12 else "negative"])
        cv2.imwrite(str(root / "images" / f"{i}.png"), sky.astype(np.uint8))
    tables = {"images": [["image", "source", "scene"], *images]}
    tables["labels"] = [["image", "x", "y", "w", "h", "label"], *labels]
    for name, rows in tables.items():
        with (root / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows(rows)
    return root


def test_it_writes_numbers_for_programs_and_a_page_for_people(data, tmp_path, capsys):
    assert main(["bench", "detector", "default", str(data), "--quick", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "detector.json").read_text())
    assert found["images"] == 18
    assert found["centre_ap"] > 0.8
    assert found["recall_1fppi"] > 0.8
    assert {"ap50", "recall_01fppi", "centre_error_median_px", "distractor_images_fired"} <= found.keys()
    assert set(found["by_scene"]) == {"sky", "negative", "all"}
    assert {row["kind"] for row in found["by_distractor"]} == {"bird", "anything"}
    assert set(found["ms_per_frame"]) == {"320x256", "640x480"}
    assert "## By size" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere.onnx", "DATA"], "nowhere.onnx: no such model file"),
        (["default", "nowhere"], "nowhere: no labelled images; expected images.csv"),
        (["default", "DATA", "--scene", "moon"], "--scene moon: expected some of negative, sky"),
        (["default", "DATA", "--input-scale", "99"], "input_scale: found 99.0, expected a number in 0.1…8"),
    ],
)
def test_what_it_cannot_use_is_said_in_one_line(data, tmp_path, capsys, arguments, sentence):
    pytest.importorskip("matplotlib")
    told = [str(data) if argument == "DATA" else argument for argument in arguments]
    assert main(["bench", "detector", *told, "--out", str(tmp_path)]) != 0
    assert sentence in capsys.readouterr().err
