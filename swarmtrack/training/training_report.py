"""What a training leaves for people to look at: curves, and a contact sheet of the worst errors."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from swarmtrack.lab.score.detector_score import ScoredImage, by_centre, match
from swarmtrack.training.labelled_images import LabelledFrame
from swarmtrack.training.validation import SURE_RECALL, look, scores

CELL = 160  # px: side of a picture on the sheet
REPORT_COLUMNS, REPORT_ROWS = 6, 4
DRONE_COLOUR, FALSE_COLOUR = (80, 220, 80), (60, 60, 255)  # BGR
REPORTED_LOSSES = ("heat", "offset", "size")


class Error(NamedTuple):
    """A false alarm or a miss, at box (4,) of frame number `frame`; how bad: the score, or one less what was found."""

    badness: float
    frame: int
    box: NDArray[np.float64]
    text: str
    colour: tuple[int, int, int]


def write(
    model: Path, history: Sequence[dict[str, float]], frames: Sequence[LabelledFrame], *, seen: bool
) -> Path:
    """Look at `frames` with the model; write train.json, train.md, curves.png and worst.jpg. Returns their folder.

    seen: whether these frames were trained on, for want of others. Without matplotlib there are no curves.
    """
    folder = model.with_suffix(".report")
    folder.mkdir(exist_ok=True)
    looks = look(model, frames)
    found = scores(looks) if frames else {}
    document = {"model": model.name, "images_were_trained_on": seen, "final": found, "history": list(history)}
    (folder / "train.json").write_text(json.dumps(document, indent=1, allow_nan=True), encoding="utf-8")
    (folder / "train.md").write_text(_markdown(model, history, found, seen), encoding="utf-8")
    if frames:
        cv2.imwrite(str(folder / "worst.jpg"), contact_sheet(frames, looks))
    _plot(history, folder / "curves.png")
    return folder


def _markdown(model: Path, history: Sequence[dict[str, float]], found: dict[str, float], seen: bool) -> str:
    which = "images that were trained on: there were no others" if seen else "validation images"
    lines = [f"# {model.name}", "", f"On {which}:", ""]
    lines += [f"- {name}: {value:.3f}" for name, value in found.items()]
    if history:
        names = list(history[-1])
        lines += ["", "| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
        for entry in history:
            cells = [
                f"{entry[name]:.{0 if name == 'images' else 3}f}" if name in entry else "" for name in names
            ]
            lines.append("| " + " | ".join(cells) + " |")
    lines += [
        "",
        "`worst.jpg`: red: false detections, with their scores; green: missed drones.",
    ]
    return "\n".join(lines) + "\n"


def contact_sheet(frames: Sequence[LabelledFrame], looks: Sequence[ScoredImage]) -> NDArray[np.uint8]:
    """The strongest false alarms, then the most clearly missed drones, each in the middle of its surroundings."""
    errors = worst_errors(looks)
    sheet = np.full((REPORT_ROWS * CELL, REPORT_COLUMNS * CELL, 3), 40, np.uint8)
    for k, error in enumerate(errors[: REPORT_ROWS * REPORT_COLUMNS]):
        top, left = k // REPORT_COLUMNS * CELL, k % REPORT_COLUMNS * CELL
        sheet[top : top + CELL, left : left + CELL] = _close_look(frames[error.frame].image, error)
    return sheet


def worst_errors(looks: Sequence[ScoredImage]) -> list[Error]:
    """False alarms by score, as many as half the sheet, and drones missed at the threshold of `SURE_RECALL`."""
    threshold = max(match(looks, by_centre).threshold_of(SURE_RECALL), 0.02)
    alarms, misses = [], []
    for number, seen in enumerate(looks):
        boxes = np.concatenate([seen.found.centre, seen.found.size], axis=1)
        fits = np.zeros((len(boxes), len(seen.drones)), bool)
        for row, box in zip(fits, boxes, strict=True):
            row[:] = by_centre(box, seen.drones) > 0
        for box, score, fit in zip(boxes, seen.found.score, fits, strict=True):
            if not fit.any() and score >= threshold:
                alarms.append(Error(float(score), number, box, f"{score:.2f}", FALSE_COLOUR))
        sure = fits & (seen.found.score >= threshold)[:, None]
        for box, hits, sure_hits in zip(seen.drones, fits.T, sure.T, strict=True):
            if not sure_hits.any():
                best = float(seen.found.score[hits].max(initial=0.0))
                misses.append(Error(1.0 - best, number, box, f"missed, {best:.2f}", DRONE_COLOUR))
    alarms.sort(key=lambda error: -error.badness)
    misses.sort(key=lambda error: -error.badness)
    half = REPORT_ROWS * REPORT_COLUMNS // 2
    room = REPORT_ROWS * REPORT_COLUMNS - min(len(misses), half)
    return alarms[:room] + misses[: REPORT_ROWS * REPORT_COLUMNS - min(len(alarms), room)]


def _close_look(image: NDArray[np.uint8], error: Error) -> NDArray[np.uint8]:
    """(CELL, CELL, 3): the box in the middle, three times as much around it, the text below."""
    u, v, w, h = error.box
    side = float(np.clip(3 * max(w, h), 48, max(image.shape[:2])))
    zoom = CELL / side
    shift = np.array([[zoom, 0, CELL / 2 - zoom * u], [0, zoom, CELL / 2 - zoom * v]])
    cell: Any = cv2.warpAffine(image, shift, (CELL, CELL), flags=cv2.INTER_LINEAR, borderValue=(40, 40, 40))
    half = np.array([w, h]) * zoom / 2
    a, b = (np.round(CELL / 2 + sign * half).astype(int).tolist() for sign in (-1, 1))
    cv2.rectangle(cell, a, b, error.colour, 1, cv2.LINE_AA)
    cv2.putText(cell, error.text, (4, CELL - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(cell, error.text, (4, CELL - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.42, error.colour, 1, cv2.LINE_AA)
    return np.asarray(cell, np.uint8)


def _plot(history: Sequence[dict[str, float]], path: Path) -> None:
    try:
        import matplotlib as mpl  # noqa: PLC0415 - an extra
    except ImportError:
        return
    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    millions = [entry["images"] / 1e6 for entry in history]
    for name in REPORTED_LOSSES:
        left.plot(millions, [entry[name] for entry in history], marker=".", label=name)
    left.set(xlabel="million samples", ylabel="loss", title="Losses", yscale="log")
    for name in ("centre_ap", "recall_1fppi", "recall_01fppi", "distractors_fired"):
        values = [entry.get(name, np.nan) for entry in history]
        if np.isfinite(values).any():
            right.plot(millions, values, marker=".", label=name)
    right.set(xlabel="million samples", ylim=(0, 1), title="On validation images")
    for axis in (left, right):
        axis.grid(alpha=0.3)
        if axis.lines:
            axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
