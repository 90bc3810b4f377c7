"""Readings of a net's outputs: each head whose outputs could look like these.

Shapes alone may fit two heads: (1, 300, 6) is corners, score and class, and as well a box in shares with two classes.
So all that fit are listed, and the net's answer to a trial image is held against each: classes are whole numbers,
scores and shares lie within 0 … 1, corners are in order. What is left undecided is for the user to say.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

HEADS = ("centernet", "yolo_v5", "yolo_v8", "end_to_end", "detr", "labelled_boxes")
# px per cell of a YOLO's maps P2 … P7. A net has two of them or more, adjacent, the finest P4 at the coarsest.
ALL_STRIDES = (4, 8, 16, 32, 64, 128)
STRIDES = tuple(ALL_STRIDES[i:j] for i in range(3) for j in range(i + 2, len(ALL_STRIDES) + 1))
LIST_ROWS = (
    100,
    300,
    500,
    1000,
)  # usual lengths of a list of candidates: no map, though some input has as many cells
ANCHORS_V5 = 3  # boxes that YOLOv5 proposes in each cell
SHARE_SLACK = 0.02  # beyond 0 … 1: rounding of half precision
WHOLE_NUMBER_SLACK = 1e-3
SMALLEST_PICTURE_PX = 2.0  # coordinates all within it are shares of an image, not pixels
MOST_WRONG_CORNERS = 0.1  # of all scores: a faint box or two may be inside out
SCORE_WORDS = ("score", "logit", "class", "label", "prob", "conf")  # in names of outputs that hold classes

Shape = tuple[int, ...]
Values = NDArray[Any]


class Trial(NamedTuple):
    """The net's answer to a trial image: input (width, height) px, the shapes of its outputs, in order; where known
    also their names and values.
    """

    input_size: tuple[int, int]
    shapes: tuple[Shape, ...]
    names: tuple[str, ...] = ()
    values: tuple[Values, ...] = ()


class HeadReading(NamedTuple):
    """A head whose outputs look so. outputs: which of the net's, in the head's order; classes: how many it
    distinguishes, None where the outputs do not show it.
    """

    head: str
    outputs: tuple[int, ...]
    classes: int | None


HEAD_FORMATS = {
    "centernet": "a CenterNet's three maps",
    "yolo_v5": "(1, 3 cells, 5 + classes) as of YOLOv5",
    "yolo_v8": "(1, 4 + classes, cells) as of YOLOv8",
    "end_to_end": "(1, n, 6): corners, score and class",
    "detr": "(1, n, 4) and (1, n, classes), or both in one: boxes as shares of the image",
    "labelled_boxes": "(1, n, 4), (1, n) and (1, n): corners, scores and classes",
}


def readings(trial: Trial, classes: int | None) -> list[HeadReading]:
    """Every reading of the outputs by their shapes. classes: how many the net distinguishes, where that is known."""
    found = (look(trial, classes) for look in _LOOKS)
    return [reading for reading in found if reading is not None]


def contradiction(reading: HeadReading, trial: Trial, names: int | None) -> str:
    """What in the values speaks against a reading, or empty. names: how many classes have a name."""
    if not trial.values:
        return ""
    return _CHECKS[reading.head]([trial.values[i] for i in reading.outputs], names)


def most_label(reading: HeadReading, trial: Trial) -> int:
    """The largest class number in the trial's answer, of heads that give numbers of classes."""
    if not trial.values or reading.head not in ("end_to_end", "labelled_boxes"):
        return 0
    values = trial.values[reading.outputs[-1]]
    labels = values[..., 5] if reading.head == "end_to_end" else values
    return int(labels.max(initial=0))


def class_count(head: str, shapes: Sequence[Shape]) -> int | None:
    """Number of classes that a net with this head and outputs of these shapes distinguishes, in the head's order; None:
    they do not fit the head.
    """
    if head == "centernet":
        return 1 if _is_centernet(shapes) else None
    if head == "labelled_boxes":
        rows = {shape[:2] for shape in shapes}
        good = [len(shape) for shape in shapes] == [3, 2, 2] and len(rows) == 1 and shapes[0][2] == 4
        return 1 if good and shapes[0][0] == 1 else None
    if not shapes or any(len(shape) != 3 or shape[0] != 1 for shape in shapes):
        return None
    count: int | None = None
    if head == "detr":
        if len(shapes) == 2 and shapes[0][1] == shapes[1][1] and 4 in (shapes[0][2], shapes[1][2]):
            count = shapes[0][2] if shapes[1][2] == 4 else shapes[1][2]
        elif len(shapes) == 1:
            count = shapes[0][2] - 4
    elif len(shapes) == 1:
        rows_, columns = shapes[0][1:]
        of_head = {"yolo_v8": rows_ - 4, "yolo_v5": columns - 5, "end_to_end": 1 if columns == 6 else 0}
        count = of_head[head]
    return count if count is not None and count >= 1 else None


# --- by shapes --------------------------------------------------------------------------------------------------------


def _cell_counts(trial: Trial) -> set[int]:
    width, height = trial.input_size
    return {sum((width // s) * (height // s) for s in strides) for strides in STRIDES}


def _is_centernet(shapes: Sequence[Shape]) -> bool:
    if len(shapes) != 3 or any(len(shape) != 4 for shape in shapes):
        return False
    h, w = shapes[0][2:]
    return list(shapes) == [(1, 1, h, w), (1, 2, h, w), (1, 2, h, w)]


def _centernet(trial: Trial, classes: int | None) -> HeadReading | None:
    fits = _is_centernet(trial.shapes) and classes in (None, 1)
    return HeadReading("centernet", (0, 1, 2), 1) if fits else None


def _table(trial: Trial, others: int) -> tuple[int, Shape] | None:
    """The only table (1, rows, columns) among the outputs; the others are the maps that it was made of."""
    tables = [i for i, shape in enumerate(trial.shapes) if len(shape) == 3 and shape[0] == 1]
    maps = [shape for shape in trial.shapes if len(shape) == others]
    if (
        len(tables) != 1
        or len(maps) != len(trial.shapes) - 1
        or (maps and len(maps) < min(map(len, STRIDES)))
    ):
        return None
    return tables[0], trial.shapes[tables[0]]


def _yolo_v8(trial: Trial, classes: int | None) -> HeadReading | None:
    found = _table(trial, others=4)
    if found is None:
        return None
    at, (_, rows, columns) = found
    fits = columns in _cell_counts(trial) and rows > 4 and classes in (None, rows - 4)
    return HeadReading("yolo_v8", (at,), rows - 4) if fits else None


def _yolo_v5(trial: Trial, classes: int | None) -> HeadReading | None:
    found = _table(trial, others=5)
    if found is None:
        return None
    at, (_, rows, columns) = found
    maps = {ANCHORS_V5 * count for count in _cell_counts(trial)}.difference(LIST_ROWS)
    fits = rows in maps and columns > 5 and classes in (None, columns - 5)
    return HeadReading("yolo_v5", (at,), columns - 5) if fits else None


def is_map(trial: Trial, rows: int) -> bool:
    """Whether so many rows are the cells of a YOLO's maps rather than a list of candidates."""
    counts = _cell_counts(trial)
    return rows not in LIST_ROWS and rows in counts | {ANCHORS_V5 * count for count in counts}


def _end_to_end(trial: Trial, _: int | None) -> HeadReading | None:
    if len(trial.shapes) != 1 or len(trial.shapes[0]) != 3:
        return None
    batch, rows, columns = trial.shapes[0]
    fits = batch == 1 and columns == 6 and not is_map(trial, rows)
    return HeadReading("end_to_end", (0,), None) if fits else None


def _detr(trial: Trial, classes: int | None) -> HeadReading | None:
    """Boxes and classes in one output: any table of five columns and more would fit, so the number of classes tells."""
    count = class_count("detr", trial.shapes) if len(trial.shapes) == 1 else None
    fits = count is not None and classes == count and not is_map(trial, trial.shapes[0][1])
    return HeadReading("detr", (0,), count) if fits else None


def _detr_pair(trial: Trial, classes: int | None, boxes: int) -> HeadReading | None:
    """Boxes in one of two outputs, classes in the other; of four columns each, only their names may show which is
    which. boxes: index of that with the boxes, 0 or 1.
    """
    order = (boxes, 1 - boxes)
    if len(trial.shapes) != 2 or trial.shapes[boxes][2:] != (4,):
        return None
    count = class_count("detr", [trial.shapes[i] for i in order])
    if count is None or (classes is not None and classes > count):
        return None
    swapped = trial.shapes[0] == trial.shapes[1] and (
        _is_named_score(trial, boxes) or _is_named_box(trial, 1 - boxes)
    )
    return None if swapped else HeadReading("detr", order, count)


def _is_named_box(trial: Trial, i: int) -> bool:
    return bool(trial.names) and "box" in trial.names[i].lower() and not _is_named_score(trial, i)


def _is_named_score(trial: Trial, i: int) -> bool:
    return bool(trial.names) and any(word in trial.names[i].lower() for word in SCORE_WORDS)


def _labelled_boxes(trial: Trial, _: int | None) -> HeadReading | None:
    """RT-DETR's own export, D-FINE, and others after suppression: in any order. A number of detections is ignored."""
    tables = [i for i, shape in enumerate(trial.shapes) if len(shape) == 3]
    counts = [i for i, shape in enumerate(trial.shapes) if len(shape) < 3 and np.prod(shape) == 1]
    flat = [i for i, shape in enumerate(trial.shapes) if len(shape) == 2 and i not in counts]
    if len(trial.shapes) - len(counts) != 3 or len(counts) > 1 or len(tables) != 1 or len(flat) != 2:
        return None
    labels = [i for i in flat if _is_label(trial, i)]
    if len(labels) != 1:
        return None
    scores = next(i for i in flat if i != labels[0])
    outputs = (tables[0], scores, labels[0])
    fits = class_count("labelled_boxes", [trial.shapes[i] for i in outputs]) is not None
    return HeadReading("labelled_boxes", outputs, None) if fits else None


def _is_label(trial: Trial, i: int) -> bool:
    if trial.values and trial.values[i].dtype.kind in "iu":
        return True
    name = trial.names[i].lower() if trial.names else ""
    return "label" in name or "class" in name


_LOOKS: tuple[Callable[[Trial, int | None], HeadReading | None], ...] = (
    _centernet, _yolo_v5, _yolo_v8, _end_to_end, _detr, partial(_detr_pair, boxes=0), partial(_detr_pair, boxes=1),
    _labelled_boxes,
)  # fmt: skip

# --- by values --------------------------------------------------------------------------------------------------------


def _within_one(values: Values) -> bool:
    return bool(values.min(initial=0.0) >= -SHARE_SLACK and values.max(initial=0.0) <= 1.0 + SHARE_SLACK)


def _is_whole(values: Values) -> bool:
    values = values.astype(float)
    return bool(
        (np.abs(values - np.rint(values)) <= WHOLE_NUMBER_SLACK).all() and values.min(initial=0.0) >= 0.0
    )


def _about_boxes(boxes: Values) -> str:
    """Of boxes (…, 4) in pixels."""
    largest = float(np.abs(boxes).max(initial=0.0))
    return (
        "its coordinates are shares of the image, not pixels" if 0.0 < largest <= SMALLEST_PICTURE_PX else ""
    )


def _about_corners(corners: Values, scores: Values) -> str:
    used, weights = corners[scores > 0.0].astype(float), scores[scores > 0.0].astype(float)
    wrong = (used[:, 2:] < used[:, :2] - 1.0).any(axis=1)
    if weights[wrong].sum() > MOST_WRONG_CORNERS * weights.sum():
        return "its corners are not in order"
    return _about_boxes(used)


def _about_scores(scores: Values) -> str:
    return "" if _within_one(scores) else "its scores are not within 0 … 1"


def _check_end_to_end(outputs: Sequence[Values], names: int | None) -> str:
    rows = outputs[0][0]
    if not _is_whole(rows[:, 5]):
        return "its classes are no whole numbers"
    if names is not None and rows[:, 5].max(initial=0.0) > names - 0.5:
        return f"it answers class {rows[:, 5].max():.0f}, of {names}"
    return _about_scores(rows[:, 4]) or _about_corners(rows[:, :4], rows[:, 4])


def _check_labelled_boxes(outputs: Sequence[Values], names: int | None) -> str:
    boxes, scores, labels = (values[0] for values in outputs)
    # Behind the last detection there may be anything.
    labels = labels[scores > 0.0]
    if not _is_whole(labels):
        return "its classes are no whole numbers"
    if names is not None and labels.max(initial=0) > names - 0.5:
        return f"it answers class {labels.max():.0f}, of {names}"
    return _about_scores(scores) or _about_corners(boxes, scores)


def _check_detr(outputs: Sequence[Values], _: int | None) -> str:
    return "" if _within_one(outputs[0][0, :, :4]) else "its boxes are no shares of the image"


_CHECKS: dict[str, Callable[[Sequence[Values], int | None], str]] = {
    "centernet": lambda outputs, _: _about_scores(outputs[0]),
    "yolo_v5": lambda outputs, _: _about_scores(outputs[0][0, :, 4:]) or _about_boxes(outputs[0][0, :, :4]),
    "yolo_v8": lambda outputs, _: _about_scores(outputs[0][0, 4:]) or _about_boxes(outputs[0][0, :4]),
    "end_to_end": _check_end_to_end,
    "detr": _check_detr,
    "labelled_boxes": _check_labelled_boxes,
}
