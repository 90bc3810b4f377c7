"""Photographs with boxes around the drones in them, in the three ways that people keep them.

* Tables: `images/`, `images.csv` (image, source, scene) and `labels.csv` (image, x, y, w, h, label; px, top left
  corner, 0-based).
* COCO: `annotations.json`, or the one `*.json` there is, and the images where it says, or in `images/`.
* YOLO: `data.yaml` with `names`, `images/NAME.jpg` and `labels/NAME.txt` (class, then centre and size as shares).

A label called drone (or the like) is a target, every other one a distractor: never to be reported as a drone. Boxes are
(u, v, w, h) with (u, v) the centre, pixel centres at integers; boxes of COCO and YOLO count from the edge of the first
pixel, half a pixel before its centre.
"""

from __future__ import annotations

import csv
import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from swarmtrack.detection.description import DRONE_CLASS_NAMES
from swarmtrack.errors import SwarmtrackError

Boxes = NDArray[np.float64]

NEGATIVE = "negative"  # the scene name of frames that show no drone
LABELLED_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp")


class DataError(SwarmtrackError):
    """A data directory that is missing something, or whose labels do not fit its images."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledFrame:
    """One photograph. image (h, w, 3) BGR uint8; drones (n, 4), distractors (m, 4): boxes (u, v, w, h) px; kinds:
    what each distractor is; is_window: it is cut from a frame, around one of them; spans_px (n,): of each drone,
    as level across the view, None if unknown.
    """

    name: str
    source: str
    scene: str
    image: NDArray[np.uint8]
    drones: Boxes
    distractors: Boxes
    kinds: tuple[str, ...] = ()
    is_window: bool = False
    spans_px: NDArray[np.float64] | None = None


Labels = list[tuple[str, list[float]]]
"""(what it is, [left, top, width, height] px)."""


def load_frames(root: Path) -> list[LabelledFrame]:
    """Read a data directory. A row that names a missing image or holds no number is an error, not a skipped row."""
    tables = sorted(root.glob("*.json"))
    if (root / "images.csv").is_file():
        frames = list(_tables(root))
    elif (root / "data.yaml").is_file():
        frames = list(_yolo(root))
    elif tables:
        frames = list(_coco(root, root / "annotations.json" if len(tables) > 1 else tables[0]))
    else:
        raise DataError(
            f"{root}: no labelled images; expected images.csv with labels.csv, a COCO *.json, or YOLO's data.yaml"
        )
    if not frames:
        raise DataError(f"{root}: holds no images, expected one at least")
    return frames


def held_out(scene: str, source: str) -> bool:
    """Whether something without drones belongs to the third that cross-scene trials keep for validation, by clip."""
    return scene == NEGATIVE and zlib.crc32(source.encode()) % 3 == 0


def _tables(root: Path) -> Iterator[LabelledFrame]:
    labels: dict[str, Labels] = {}
    for line, row in _rows(root / "labels.csv", ("image", "x", "y", "w", "h", "label")):
        box = _numbers(f"{root / 'labels.csv'}:{line}", [row[key] for key in ("x", "y", "w", "h")])
        labels.setdefault(row["image"], []).append((row["label"], box))
    for line, row in _rows(root / "images.csv", ("image", "source", "scene")):
        path = root / "images" / row["image"]
        where = f"{root / 'images.csv'}:{line}"
        found = labels.get(row["image"], [])
        yield _frame(where, path, row["source"], row["scene"], found, from_edge=False)


def _coco(root: Path, path: Path) -> Iterator[LabelledFrame]:
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        names = {int(entry["id"]): str(entry["name"]) for entry in document["categories"]}
        labels: dict[int, Labels] = {}
        for entry in document["annotations"]:
            box = [float(value) for value in entry["bbox"]]
            labels.setdefault(int(entry["image_id"]), []).append((names[int(entry["category_id"])], box))
        images = [(int(entry["id"]), str(entry["file_name"])) for entry in document["images"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path}: not COCO's images, annotations and categories: {type(error).__name__} {error}"
        ) from None
    for number, name in images:
        place = root / name if (root / name).is_file() else root / "images" / name
        yield _frame(
            f"{path}: image {number}", place, place.stem, _scene_of(place, root), labels.get(number, [])
        )


def _yolo(root: Path) -> Iterator[LabelledFrame]:
    try:
        named: Any = yaml.safe_load((root / "data.yaml").read_text(encoding="utf-8"))["names"]
        names = [str(named[i]) for i in range(len(named))]
    except (OSError, yaml.YAMLError, KeyError, TypeError) as error:
        raise DataError(f"{root / 'data.yaml'}: expected names, a list of the classes: {error}") from None
    for path in sorted(
        entry for entry in root.glob("images/**/*") if entry.suffix.lower() in LABELLED_IMAGE_SUFFIXES
    ):
        table = root / "labels" / path.relative_to(root / "images").with_suffix(".txt")
        shares = []
        lines = table.read_text(encoding="utf-8").splitlines() if table.is_file() else []
        for line, text in enumerate(lines, start=1):
            kind, *box = _numbers(f"{table}:{line}", text.split())
            if len(box) != 4 or not 0 <= kind < len(names):
                raise DataError(
                    f"{table}:{line}: found {text!r}, expected a class below {len(names)} and a box"
                )
            shares.append((names[int(kind)], box))
        yield _frame(str(table), path, path.stem, _scene_of(path, root), shares, in_shares=True)


def _scene_of(path: Path, root: Path) -> str:
    """The folder that it lies in, if there are several."""
    folder = path.parent.relative_to(root)
    return folder.name if folder.parts not in ((), ("images",)) else "images"


def _frame(
    where: str,
    path: Path,
    source: str,
    scene: str,
    labels: Labels,
    *,
    in_shares: bool = False,
    from_edge: bool = True,
) -> LabelledFrame:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise DataError(f"{where}: {path} is missing or is not an image")
    if in_shares:
        side = np.array(image.shape[1::-1], float)
        boxes = [np.array(box).reshape(2, 2) * side for _, box in labels]
        boxes = [np.concatenate([centre - 0.5 * size, size]) for centre, size in boxes]
    else:
        boxes = [np.array(box) for _, box in labels]
    drone = np.array([kind.lower() in DRONE_CLASS_NAMES for kind, _ in labels], np.bool_)
    table = np.array(boxes, float).reshape(-1, 4)
    table[:, :2] += table[:, 2:] / 2 - (0.5 if from_edge else 0.0)
    kinds = tuple(kind for (kind, _), is_drone in zip(labels, drone.tolist(), strict=True) if not is_drone)
    return LabelledFrame(
        path.name, source, scene, np.asarray(image, np.uint8), table[drone], table[~drone], kinds
    )


def _numbers(where: str, texts: Sequence[str]) -> list[float]:
    try:
        return [float(text) for text in texts]
    except ValueError as error:
        raise DataError(f"{where}: {error}, expected numbers") from None


def _rows(path: Path, columns: Sequence[str]) -> Iterator[tuple[int, Mapping[str, str]]]:
    if not path.is_file():
        raise DataError(
            f"{path}: no such file; expected labels.csv next to images.csv, and the images in images/"
        )
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        missing = [column for column in columns if column not in (reader.fieldnames or ())]
        if missing:
            raise DataError(f"{path}:1: found columns {reader.fieldnames}, expected also {missing}")
        yield from enumerate(reader, start=2)
