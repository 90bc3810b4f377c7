"""Scores become probabilities, and a model carries how."""

import json

import numpy as np
import pytest
from scipy.special import expit, logit

from support.labelled_pictures import data_directory
from swarmtrack.agents.main import main
from swarmtrack.detection.detector import Detector
from swarmtrack.lab.score.detector_score import Matches
from swarmtrack.lab.score.score_calibration import expected_error, fit

NONE = np.empty(0)


def matches(score, hit):
    return Matches(score, hit, NONE, NONE, NONE, 1)


def test_a_sigmoid_that_was_put_in_is_found_again():
    rng = np.random.default_rng(0)
    score = rng.uniform(0.02, 0.98, 20_000)
    truth = expit(2.0 * logit(score) - 1.0)
    hit = rng.random(len(score)) < truth
    platt = fit(matches(score, hit))
    assert platt.slope == pytest.approx(2.0, abs=0.1)
    assert platt.offset == pytest.approx(-1.0, abs=0.1)
    assert expected_error(score, hit) > 0.1
    assert expected_error(platt(score), hit) < 0.02


def test_too_little_to_go_by_changes_nothing():
    assert fit(matches(np.full(30, 0.7), np.ones(30, bool))) == (1.0, 0.0)
    assert fit(matches(NONE, np.empty(0, bool))) == (1.0, 0.0)


def test_scores_that_tell_all_stay_finite():
    score = np.concatenate([np.full(50, 0.01), np.full(50, 0.99)])
    platt = fit(matches(score, score > 0.5))
    assert np.isfinite(platt).all()
    assert platt.slope > 0


def test_export_writes_it_and_lets_through_what_it_let_through(tmp_path):
    pytest.importorskip("torch")
    out, pictures = tmp_path / "model.onnx", data_directory(tmp_path / "data", frames=24)
    options = ["--precision", "fp32", "--data", str(pictures), "--out", str(out), "--calibrate"]
    assert main(["export", "default", *options]) == 0
    before, after = Detector("default").description, Detector(str(out)).description
    slope, offset = json.loads(after.entries["calibration"])
    expected = expit(slope * logit(before.score_threshold) + offset)
    assert after.score_threshold == pytest.approx(expected, abs=1e-3)
    assert main(["export", "default", "--precision", "fp32", "--out", str(out), "--calibrate"]) == 2
