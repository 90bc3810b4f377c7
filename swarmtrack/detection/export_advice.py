"""Advice on a net whose outputs have no known format: what to set, or how to export it again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from swarmtrack.detection.readings import HeadReading, Trial, class_count, is_map, readings

HOW_TO_SET_HEAD = "detector.head, or --head of swarmtrack video"
HOW_TO_SET_NAMES = "detector.names, or --names of swarmtrack video"


def next_step(trial: Trial, classes: int | None, fitting: Sequence[HeadReading]) -> str:
    """Next step for a refused net. classes: how many it is said to distinguish; fitting: readings of its outputs by
    their shapes. A head is advised only where it would be accepted.
    """
    steps = []
    if classes is None and _is_wide_list(trial):
        steps.append(f"if it is a DETR, list its classes in {HOW_TO_SET_NAMES}")
    if fitting:
        heads = " or ".join(dict.fromkeys(reading.head for reading in fitting))
        steps.append(
            f"export it in one of these formats or, if it is {heads} all the same, set {HOW_TO_SET_HEAD}"
        )
        return "; ".join(steps)
    steps = [step for look, step in _STEPS if look(trial)][:1] + steps
    others = [reading for reading in readings(trial, None) if reading.classes is not None]
    if others:
        counts = " or ".join(f"{reading.classes} as {reading.head}" for reading in others)
        steps.append(
            f"the outputs are of another number of classes, {counts}; list them in {HOW_TO_SET_NAMES}"
        )
    return "; ".join(steps) or "export it in one of these formats, without further outputs"


def _has_no_batch(trial: Trial) -> bool:
    return max(map(len, trial.shapes), default=0) == 2 and len({shape[0] for shape in trial.shapes}) == 1


def _is_raw(trial: Trial) -> bool:
    return len(trial.shapes) > 1 and all(len(shape) >= 4 for shape in trial.shapes)


def _has_rows_of_cells(trial: Trial) -> bool:
    return len(trial.shapes) == 1 and len(trial.shapes[0]) == 3 and is_map(trial, trial.shapes[0][1])


def _is_wide_list(trial: Trial) -> bool:
    """A single list of boxes, with as many columns more as it may have classes."""
    return (
        len(trial.shapes) == 1
        and class_count("detr", trial.shapes) is not None
        and not _has_rows_of_cells(trial)
    )


def _has_scores_among_corners(trial: Trial) -> bool:
    return sorted(shape[2:] for shape in trial.shapes) == [(), (5,)]


def _has_single_columns(trial: Trial) -> bool:
    return [shape[2:] for shape in trial.shapes].count((1,)) > 1


def _has_unnamed_classes(trial: Trial) -> bool:
    return sorted(shape[2:] for shape in trial.shapes if max(shape, default=1) > 1) == [(), (), (4,)]


def _has_a_count(trial: Trial) -> bool:
    counts = [shape for shape in trial.shapes if max(shape, default=1) == 1]
    return (len(trial.shapes), len(counts)) == (2, 1)


_STEPS: tuple[tuple[Callable[[Trial], bool], str], ...] = (
    (_has_no_batch, "its outputs have no batch axis: export it without suppression, or with (1, n, …)"),
    (_is_raw, "these are maps before decoding: export it with the decoding, as one table"),
    (
        _has_rows_of_cells,
        "its rows are cells: if it is like YOLOv8, export it transposed to (1, 4 + classes, cells); else with its "
        "suppression, as end_to_end",
    ),
    (_has_scores_among_corners, "export its corners and scores as two outputs, (1, n, 4) and (1, n)"),
    (_has_single_columns, "export its scores and classes as (1, n), without the last axis"),
    (
        _has_unnamed_classes,
        "nothing shows which of them are the classes: export them as integers, or with the name labels",
    ),
    (_has_a_count, "export it without the number of detections"),
)  # fmt: skip
