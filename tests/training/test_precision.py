"""A detector in fewer bits finds the same drones."""

from __future__ import annotations

import csv

import cv2
import numpy as np
import pytest

pytest.importorskip("onnx", reason="needs onnx, of the extra train")

from swarmtrack.agents.main import main
from swarmtrack.detection.detector import Detector
from swarmtrack.messages import Frame, StampKind
from swarmtrack.training import render


def skies(count, seed):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        sky = np.full((192, 256, 3), rng.uniform([200, 150, 100], [250, 200, 160]), np.float32)
        centre = rng.uniform([60, 60], [190, 130])
        render.paste_into(rng, sky, render.multirotor(rng), centre, rng.uniform(25, 50))
        yield sky.astype(np.uint8)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    (root / "images").mkdir()
    rows = [["image", "source", "scene"]]
    for i, image in enumerate(skies(20, 1)):
        cv2.imwrite(str(root / "images" / f"{i}.png"), image)
        rows.append([f"{i}.png", "drawn", "sky"])
    for name, table in (("images", rows), ("labels", [["image", "x", "y", "w", "h", "label"]])):
        with (root / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows(table)
    return root


@pytest.mark.parametrize(("precision", "size", "off"), [("fp16", 0.55, 0.3), ("int8", 0.35, 1.5)])
def test_fewer_bits_find_the_same_drones_in_a_smaller_file(data, tmp_path, capsys, precision, size, off):
    out = tmp_path / "small.onnx"
    arguments = ["export", "default", "--out", str(out), "--precision", precision, "--data", str(data)]
    assert main(arguments) == 0
    assert "2.25 MB in full precision" in capsys.readouterr().out
    whole, small = Detector(), Detector(out)
    assert out.stat().st_size < size * whole.path.stat().st_size
    assert small.description.entries["precision"] == precision
    assert small.description.entries["licence"] == whole.description.entries["licence"]
    compared = 0
    for image in skies(12, 2):
        a, b = (
            detector.detect(detector.plan(Frame(0.0, 0.0, 0, image, StampKind.MEDIA)))
            for detector in (whole, small)
        )
        if len(a.score) == len(b.score) == 1:
            compared += 1
            assert b.centre == pytest.approx(a.centre, abs=off)
            assert b.score == pytest.approx(a.score, abs=0.15)
    assert compared >= 8


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere.onnx"], "nowhere.onnx: no such model file"),
        (["default"], "--data is missing: 8 bits and scores are calibrated on pictures"),
        (["default", "--data", "nowhere"], "nowhere: no labelled images"),
        (["default", "--out", "/nowhere/a.onnx"], "its folder does not exist"),
        (
            ["default", "--data", "DATA", "--pictures", "4"],
            "found 4 pictures to calibrate 8 bits on, expected 16",
        ),
    ],
)
def test_what_is_missing_is_said(data, tmp_path, capsys, arguments, sentence):
    told = [str(data) if argument == "DATA" else argument for argument in arguments]
    if "--out" not in told:
        told += ["--out", str(tmp_path / "small.onnx")]
    assert main(["export", *told]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "small.onnx").exists()
