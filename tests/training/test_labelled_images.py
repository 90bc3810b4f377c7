"""Labelled images in the three forms that people keep them, and what is said where they are broken."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from swarmtrack.training.labelled_images import DataError, load_frames

WIDTH, HEIGHT = 200, 100
DRONE, BIRD = [40.0, 20.0, 30.0, 10.0], [120.0, 60.0, 8.0, 6.0]  # left, top, width, height, from the edge


def picture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))


def coco(root, **changes):
    picture(root / "images" / "a.png")
    picture(root / "images" / "b.png")
    document = {
        "images": [{"id": 1, "file_name": "a.png"}, {"id": 2, "file_name": "b.png"}],
        "categories": [{"id": 7, "name": "Drone"}, {"id": 8, "name": "bird"}],
        "annotations": [
            {"image_id": 1, "category_id": 7, "bbox": DRONE},
            {"image_id": 1, "category_id": 8, "bbox": BIRD},
        ],
    }
    (root / "annotations.json").write_text(json.dumps(document | changes))
    return root


def yolo(root, names="[bird, drone]"):
    picture(root / "images" / "train" / "a.png")
    picture(root / "images" / "train" / "b.png")
    (root / "data.yaml").write_text(f"path: .\nnames: {names}\n")
    (root / "labels" / "train").mkdir(parents=True)
    lines = []
    for kind, (x, y, w, h) in ((1, DRONE), (0, BIRD)):
        lines.append(f"{kind} {(x + w / 2) / WIDTH} {(y + h / 2) / HEIGHT} {w / WIDTH} {h / HEIGHT}")
    (root / "labels" / "train" / "a.txt").write_text("\n".join(lines))
    return root


@pytest.mark.parametrize("form", [coco, yolo])
def test_both_say_the_same_of_the_same_boxes(tmp_path, form):
    first, second = load_frames(form(tmp_path))
    assert (first.name, second.name) == ("a.png", "b.png")
    # Half a pixel before the edge's count.
    assert first.drones == pytest.approx(np.array([[54.5, 24.5, 30.0, 10.0]]))
    assert first.distractors == pytest.approx(np.array([[123.5, 62.5, 8.0, 6.0]]))
    assert first.kinds == ("bird",)
    assert second.drones.shape == second.distractors.shape == (0, 4)


def test_yolo_may_name_its_classes_by_number(tmp_path):
    assert len(load_frames(yolo(tmp_path, names="{0: bird, 1: uav}"))[0].drones) == 1


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda root: coco(root, categories=[]), r"annotations\.json: not COCO's .*KeyError 7"),
        (lambda root: coco(root, images=[{"id": 1, "file_name": "c.png"}]), r"image 1: .*c\.png is missing"),
        (lambda root: yolo(root, names="[bird]"), r"a\.txt:1: found '1 .*expected a class below 1"),
        (lambda root: yolo(root, names="3"), r"data\.yaml: expected names"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(tmp_path, make, sentence):
    with pytest.raises(DataError, match=sentence):
        load_frames(make(tmp_path))


def test_a_half_written_table_is_no_data(tmp_path):
    (coco(tmp_path) / "annotations.json").write_text('{"images": [')
    with pytest.raises(DataError, match=r"annotations\.json: not COCO's"):
        load_frames(tmp_path)
