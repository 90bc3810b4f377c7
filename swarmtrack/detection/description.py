"""Description of a net: read from the file's own metadata, else recognised, else configured.

Four sources, by priority: what a config declares, our own `swarmtrack.*` metadata, those that Ultralytics writes, and
the shapes of the outputs. A net that none of them explains is refused in a sentence that names what was found.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from swarmtrack.detection import metadata
from swarmtrack.errors import ModelError
from swarmtrack.plain_text import plain
from swarmtrack.relative.box_width import BoxWidth

HEADS = ("centernet", "yolo_v5", "yolo_v8", "end_to_end", "detr")
STRIDES = (8, 16, 32)  # of YOLO's three maps
ANCHORS_V5 = 3  # boxes that YOLOv5 proposes in each cell
FOREIGN_THRESHOLD = 0.25  # of nets that tell none: what Ultralytics' own predictor takes
DRONE_CLASS_NAMES = ("drone", "uav", "quadcopter", "quadrotor", "multirotor", "multicopter")
LOOK_ALIKES = ("bird", "airplane", "aeroplane", "plane", "helicopter", "kite", "balloon")

Shape = tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Declared:
    """A config's description of a net, which overrides the net's own. None or empty: not declared."""

    head: str | None = None
    classes: tuple[str, ...] = ()
    veto: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    scale: tuple[float, float, float] | None = None
    mean: tuple[float, float, float] | None = None
    channel_order: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Description:
    """head: how its outputs are to be read, one of `HEADS`; stride: input px per cell of a CenterNet; multiple: input
    sides are multiples of this; names: of its classes, in their order; drones, vetoes: which of them are what we look
    for, and which speak against it where both are seen.

    The net is fed scale · (pixel − mean), both in the order of its channels; pad_value 0…255. calibration (a, b): the
    probability that a detection is a drone is σ(a logit(score) + b). box_width: how wide its boxes are, where it says
    so. second_stage: whether the shipped one (`second_stage`) was fitted to its scores. source: who said all this;
    entries: our metadata as written.
    """

    head: str
    stride: int = 1
    multiple: int = 32
    names: tuple[str, ...] = ("drone",)
    drones: frozenset[int] = frozenset({0})
    vetoes: frozenset[int] = frozenset()
    score_threshold: float = FOREIGN_THRESHOLD
    scale: tuple[float, float, float] = (1 / 255, 1 / 255, 1 / 255)
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    channel_order: str = "RGB"
    pad_value: int = 114
    calibration: tuple[float, float] = (1.0, 0.0)
    box_width: BoxWidth | None = None
    second_stage: bool = False
    source: str
    entries: Mapping[str, str]


class Trial(NamedTuple):
    """The net's answer to an empty image: input (width, height) px, and the shapes of its outputs, in order."""

    input_size: tuple[int, int]
    shapes: tuple[Shape, ...]


def describe(path: str, written: Mapping[str, str], trial: Trial, declared: Declared) -> Description:
    """written: the file's metadata. Raises `ModelError` where something is missing or wrong, naming it."""
    if any(key.startswith(metadata.PREFIX) for key in written):
        description = _ours(path, written)
    elif written.get("author") == "Ultralytics" or {"names", "stride"} <= written.keys():
        description = _ultralytics(path, written, trial, declared)
    else:
        description = _recognised(path, trial, declared)
    return _with_classes(path, _with_declared(description, declared), declared)


# --- our own metadata ---------------------------------------------------------------------------------


def _ours(path: str, written: Mapping[str, str]) -> Description:
    ours = metadata.Metadata(path, written)
    entry = ours.entry
    head = entry("head", metadata.one_of(HEADS), f"one of {', '.join(HEADS)}")
    if head == "centernet":
        entry("size_encoding", metadata.one_of(["log_cells"]), "log_cells")
    fitted = entry("second_stage", metadata.one_of(["default", "none"]), "default or none", "none")
    return Description(
        head=head,
        stride=entry(
            "stride",
            metadata.pixels,
            f"a positive whole number of pixels, {metadata.COARSEST_STRIDE_PX} at most",
        ),
        multiple=entry(
            "multiple",
            metadata.pixels,
            f"a positive whole number of pixels, {metadata.COARSEST_STRIDE_PX} at most",
        ),
        names=entry("names", metadata.names, "a JSON list of class names"),
        score_threshold=entry("score_threshold", metadata.fraction, "a number in 0…1"),
        scale=entry("scale", metadata.scale, "a number other than 0, or a JSON list of three"),
        mean=entry(
            "mean",
            metadata.three,
            f"a JSON list of three numbers, none beyond {metadata.LARGEST_METADATA_NUMBER:g}",
        ),
        channel_order=entry("channel_order", metadata.one_of(["BGR", "RGB"]), "BGR or RGB"),
        pad_value=entry("pad_value", metadata.byte, "a whole number in 0…255"),
        calibration=entry(
            "calibration", metadata.sigmoid, "a JSON list of two numbers, the first above 0", (1.0, 0.0)
        ),
        box_width=metadata.box_width_of(path, written),
        second_stage=fitted == "default",
        source="its metadata",
        entries=ours.entries,
    )


# --- other people's nets ------------------------------------------------------------------------------


def _ultralytics(path: str, written: Mapping[str, str], trial: Trial, declared: Declared) -> Description:
    """Their exporter writes `task`, `stride` and `names`, as Python literals; their nets eat RGB / 255, padded with
    114."""
    task = written.get("task", "detect")
    if task != "detect":
        raise ModelError(
            f"{path}: an Ultralytics net for task {metadata.quoted(task)}, expected one for 'detect'"
        )
    try:
        named: Any = ast.literal_eval(metadata.bounded(written["names"]))
        names = tuple(plain(str(named[i]), metadata.LONGEST_CLASS_NAME) for i in range(len(named)))
        if not names:
            raise ValueError("no names")
        multiple = metadata.pixels(str(int(float(written["stride"]))))
    except metadata.UNREADABLE:
        found = {key: metadata.quoted(written.get(key, "")) for key in ("names", "stride")}
        raise ModelError(
            f"{path}: Ultralytics metadata are {found}, expected names like {{0: 'drone'}} and a stride"
        ) from None
    head = declared.head or _head_of(trial, len(names))
    if head is None:
        raise _unknown(path, trial)
    return Description(
        head=head, multiple=multiple, names=names, source="Ultralytics' metadata", entries=dict(written)
    )


def _recognised(path: str, trial: Trial, declared: Declared) -> Description:
    head = declared.head or _head_of(trial, len(declared.names) or None)
    if head is None:
        raise _unknown(path, trial)
    classes = class_count(head, trial.shapes)
    if classes is None:
        raise _unknown(path, trial, f"; as head {head} they make no sense")
    names = declared.names or (("drone",) if classes == 1 else tuple(f"class_{i}" for i in range(classes)))
    stride = trial.input_size[0] // trial.shapes[0][-1] if head == "centernet" else 1
    return Description(head=head, stride=stride, names=names, source="the shapes of its outputs", entries={})


def _head_of(trial: Trial, classes: int | None) -> str | None:
    """By the outputs' shapes: a YOLO has as many rows as its input has cells, which no other has."""
    shapes = trial.shapes
    if _is_centernet(shapes):
        return "centernet"
    if any(len(shape) != 3 or shape[0] != 1 for shape in shapes):
        return None
    if len(shapes) == 2 and shapes[0][1] == shapes[1][1] and 4 in (shapes[0][2], shapes[1][2]):
        return "detr"
    if len(shapes) != 1:
        return None
    rows, columns = shapes[0][1:]
    cells = sum((trial.input_size[0] // stride) * (trial.input_size[1] // stride) for stride in STRIDES)
    if columns == cells and rows > 4:
        return "yolo_v8"
    if rows == ANCHORS_V5 * cells and columns > 5:
        return "yolo_v5"
    if columns == 6 and rows != cells:
        return "end_to_end"
    return "detr" if classes is not None and columns == 4 + classes and rows != cells else None


def _is_centernet(shapes: Sequence[Shape]) -> bool:
    if len(shapes) != 3 or any(len(shape) != 4 for shape in shapes):
        return False
    h, w = shapes[0][2:]
    return list(shapes) == [(1, 1, h, w), (1, 2, h, w), (1, 2, h, w)]


def class_count(head: str, shapes: Sequence[Shape]) -> int | None:
    """Number of classes that a net with this head and outputs of these shapes distinguishes; None: they do not fit
    the head.
    """
    if head == "centernet":
        return 1 if _is_centernet(shapes) else None
    if not shapes or any(len(shape) != 3 or shape[0] != 1 for shape in shapes):
        return None
    count: int | None = None
    if head == "detr":
        if len(shapes) == 2 and shapes[0][1] == shapes[1][1] and 4 in (shapes[0][2], shapes[1][2]):
            count = shapes[0][2] if shapes[1][2] == 4 else shapes[1][2]
        elif len(shapes) == 1:
            count = shapes[0][2] - 4
    elif len(shapes) == 1:
        rows, columns = shapes[0][1:]
        of_head = {"yolo_v8": rows - 4, "yolo_v5": columns - 5, "end_to_end": 1 if columns == 6 else 0}
        count = of_head[head]
    return count if count is not None and count >= 1 else None


def _unknown(path: str, trial: Trial, more: str = "") -> ModelError:
    width, height = trial.input_size
    shapes = ", ".join(str(shape) for shape in trial.shapes) or "none"
    return ModelError(
        f"{path}: its outputs have no known format: {shapes} for an input of {width}x{height}{more}; "
        f"known are (1, 4 + classes, cells) as of YOLOv8, (1, 3 cells, 5 + classes) as of YOLOv5, (1, n, 6), two of "
        f"(1, n, 4) and (1, n, classes), and a CenterNet's three maps; set detector.head to one of {', '.join(HEADS)}"
    )


# --- what the config says -----------------------------------------------------------------------------


def _with_declared(description: Description, declared: Declared) -> Description:
    told = {
        key: value
        for key in ("head", "names", "scale", "mean", "channel_order")
        if (value := getattr(declared, key))
    }
    return (
        replace(description, **told, source=f"{description.source} and the config") if told else description
    )


def _with_classes(path: str, description: Description, declared: Declared) -> Description:
    """Which classes are drones and which veto: those declared, else by their names, else the only one there is."""
    names = [name.lower() for name in description.names]
    for key, asked in (("classes", declared.classes), ("veto", declared.veto)):
        missing = [name for name in asked if name.lower() not in names]
        if missing:
            raise ModelError(
                f"{path}: detector.{key} names {', '.join(missing)}, but its classes are {_listed(description.names)}"
            )
    wanted = [name.lower() for name in declared.classes] or [
        name for name in names if name in DRONE_CLASS_NAMES
    ]
    drones = frozenset(i for i, name in enumerate(names) if name in wanted)
    if not drones and len(names) == 1:
        drones = frozenset({0})
    if not drones:
        raise ModelError(
            f"{path}: none of its classes is called drone; they are {_listed(description.names)}; name the drones' "
            "classes in detector.classes"
        )
    against: list[str] = [name.lower() for name in declared.veto] or [*LOOK_ALIKES]
    vetoes = frozenset(i for i, name in enumerate(names) if name in against) - drones
    return replace(description, drones=drones, vetoes=vetoes)


def _listed(names: Sequence[str], most: int = 12) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
