"""Is the detector's noise told from the labels' jitter and the drones' shaking?"""

import numpy as np
import pytest

from swarmtrack.benchmarks.detection_noise import (
    BENCH,
    Sightings,
    by_distance,
    fit,
    jitter,
    measure,
    pair,
    separated,
    told_apart,
)
from swarmtrack.lab.score.clip_score import TruthBoxes
from swarmtrack.messages import Detections

FLOOR, SIZE_NOISE, SCORE_NOISE = 0.3, 0.012, 0.03


def filmed(seed, side, frames=400):
    """A drone that flies a curve and shakes, its boxes biased and noisy as the trackers' formula says, its labels
    loose: jitter, and a slow error."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames)[:, None] / 30.0
    shaking = rng.normal(0.0, 0.5, (frames, 2))
    truth = 200.0 + 80.0 * np.sin([0.6, 0.9] * t) + shaking
    score = rng.choice([0.36, 0.42, 0.47, 0.52, 0.57, 0.65, 0.75, 0.85, 0.95], frames)
    score[frames // 2 :] = 0.9
    doubt = SCORE_NOISE * (1.0 - score) / score
    sigma = np.sqrt(FLOOR**2 + side**2 * (SIZE_NOISE**2 + doubt**2))[:, None]
    box = truth + [1.5, -1.0] + sigma * rng.normal(size=(frames, 2))
    label = truth + 2.0 * np.sin(t) + rng.normal(0.0, 0.4, (frames, 2))
    return Sightings(np.arange(frames), box, label, np.full((frames, 2), side), score, 30.0)


def test_noise_labels_and_shaking_are_told_apart():
    box, label, shaking = separated(jitter(filmed(0, 50.0, frames=8000)))
    sure = FLOOR**2 + 50.0**2 * (SIZE_NOISE**2 + (SCORE_NOISE / 9.0) ** 2)
    assert box == pytest.approx(sure, rel=0.15)
    assert label == pytest.approx(0.4**2, rel=0.15)
    assert shaking == pytest.approx(0.5**2, rel=0.15)


def test_the_formula_that_made_the_boxes_is_found():
    drones = [filmed(k, side) for k, side in enumerate(np.repeat([15.0, 24.0, 32.0, 40.0, 55.0, 75.0], 4))]
    result = measure(drones)
    assert result["size_noise"]["value"] == pytest.approx(SIZE_NOISE, rel=0.25)
    assert result["floor_px"]["value"] == pytest.approx(FLOOR, abs=0.12)
    assert result["score_noise"]["value"] == pytest.approx(SCORE_NOISE, rel=0.2)
    for name in ("size_noise", "score_noise"):
        assert result[name]["low"] <= result[name]["value"] <= result[name]["high"]
    page = BENCH.page({"clips": ["one"], "drones": len(drones), "apart": [], **result})
    assert f"| size_noise | {result['size_noise']['value']:.4f} |" in page


def test_what_does_not_depend_on_the_score_has_no_score_noise():
    sides = [{"side_px": side, "box_px": 0.5, "pairs": 100} for side in (20.0, 60.0)]
    scores = [{"score": score, "share_of_side": 0.01, "pairs": 100} for score in (0.4, 0.6, 0.9)]
    found = fit(sides, scores)
    assert found["floor_px"] == pytest.approx(0.5)
    assert found["size_noise"] == pytest.approx(0.0, abs=1e-6)
    assert found["score_noise"] == pytest.approx(0.0, abs=1e-6)


def test_boxes_are_paired_with_the_labels_they_hit_frame_by_frame():
    truth = {
        k: TruthBoxes(np.array([7]), np.array([[100.0 + k, 50.0]]), np.full((1, 2), 20.0)) for k in range(5)
    }
    seen = [
        Detections(
            k / 30,
            k,
            np.array([[100.5 + k, 50.0], [400.0, 300.0]]),
            np.full((2, 2), 18.0),
            np.array([0.9, 0.4]),
        )
        for k in range(6)
    ]
    (drone,) = pair(seen, truth, 30.0)
    assert drone.frame.tolist() == [0, 1, 2, 3, 4]
    assert drone.box - drone.label == pytest.approx(np.tile([0.5, 0.0], (5, 1)))
    assert drone.score == pytest.approx(np.full(5, 0.9))


def test_two_are_told_apart_where_both_labels_are_hit():
    size = np.full((2, 2), [20.0, 10.0])
    truth = {
        k: TruthBoxes(np.array([1, 2]), np.array([[100.0, 50.0], [105.0, 50.0]]), size) for k in range(2)
    }
    seen = [
        Detections(0.0, 0, np.array([[100.0, 50.0], [105.0, 50.0]]), size, np.full(2, 0.9)),
        Detections(0.1, 1, np.array([[102.0, 50.0]]), size[:1], np.full(1, 0.9)),
    ]
    assert told_apart(seen, truth) == pytest.approx(np.array([[0.25, 1.0], [0.25, 0.0]]))
    (row,) = by_distance(told_apart(seen, truth))
    assert row == {"pairs": 2, "sides_apart": pytest.approx(0.25), "both_found": pytest.approx(0.5)}
