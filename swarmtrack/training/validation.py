"""How a net does on images it was not trained on, looked at while it learns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from swarmtrack.detection.detector import Detector
from swarmtrack.lab.score import detector_score
from swarmtrack.lab.score.detector_score import ScoredImage, by_centre, match
from swarmtrack.messages import Frame, StampKind
from swarmtrack.training.feeding import TrainingError
from swarmtrack.training.labelled_images import LabelledFrame

LOWEST_SCORE = 0.02  # score from which on detections count for the average precision
SURE_RECALL = 0.9  # at whose threshold the images without drones are counted that fire


def look(model: Path, frames: Sequence[LabelledFrame]) -> list[ScoredImage]:
    """What the exported net finds in each image, whole, by itself."""
    detector = Detector(str(model), score_threshold=LOWEST_SCORE, second_stage="none", look="whole")
    looks = []
    for frame in frames:
        found = detector.detect(detector.plan(Frame(0.0, 0.0, 0, frame.image, StampKind.MEDIA)))
        if found is None:
            raise TrainingError(detector.status().text)
        looks.append(ScoredImage(found, frame.drones, frame.distractors, frame.kinds))
    return looks


def scores(looks: Sequence[ScoredImage]) -> dict[str, float]:
    """centre_ap, recall at 1 and at 0.1 false detections an image, and the share of drone-free images that fire."""
    matches = match(looks, by_centre)
    found = {
        "centre_ap": matches.average_precision(),
        "recall_1fppi": matches.recall_at(1.0),
        "recall_01fppi": matches.recall_at(0.1),
    }
    fired = detector_score.fired_on(looks, matches.threshold_of(SURE_RECALL)).get("anything")
    if fired is not None:
        hits, images = fired
        found["distractors_fired"] = hits / max(images, 1)
    return found
