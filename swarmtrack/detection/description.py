"""Description of a net: read from the file's own metadata, else recognised, else configured.

Four sources, by priority: what a config declares, our own `swarmtrack.*` metadata, those that Ultralytics writes, and
the outputs' shapes and values (`readings`). A net that none of them explains, or whose outputs can be read in two ways,
is refused in a sentence that names what was found.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from swarmtrack.detection import metadata
from swarmtrack.detection.export_advice import HOW_TO_SET_HEAD, HOW_TO_SET_NAMES, next_step
from swarmtrack.detection.readings import (
    HEAD_FORMATS,
    HEADS,
    HeadReading,
    Trial,
    contradiction,
    most_label,
    readings,
)
from swarmtrack.errors import ModelError
from swarmtrack.plain_text import plain
from swarmtrack.relative.box_width import BoxWidth

FOREIGN_THRESHOLD = 0.25  # of nets that tell none: what Ultralytics' own predictor takes
DRONE_CLASS_NAMES = ("drone", "uav", "quadcopter", "quadrotor", "multirotor", "multicopter")
LOOK_ALIKES = ("bird", "airplane", "aeroplane", "plane", "helicopter", "kite", "balloon")


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
    """head: how its outputs are to be read, one of `HEADS`; outputs: which of them, in the head's order, empty for all;
    stride: input px per cell of a CenterNet; multiple: input
    sides are multiples of this; names: of its classes, in their order; drones, vetoes: which of them are what we look
    for, and which speak against it where both are seen.

    The net is fed scale · (pixel − mean), both in the order of its channels; pad_value 0…255. calibration (a, b): the
    probability that a detection is a drone is σ(a logit(score) + b). box_width: how wide its boxes are, where it says
    so. second_stage: whether the shipped one (`second_stage`) was fitted to its scores. source: who said all this;
    entries: our metadata as written.
    """

    head: str
    outputs: tuple[int, ...] = ()
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
    reading = _reading(path, trial, len(declared.names or names), declared)
    return Description(
        head=reading.head,
        outputs=reading.outputs,
        multiple=multiple,
        names=names,
        source="Ultralytics' metadata",
        entries=dict(written),
    )


def _recognised(path: str, trial: Trial, declared: Declared) -> Description:
    reading = _reading(path, trial, len(declared.names) or None, declared)
    classes = reading.classes or 1
    if not declared.names and (last := most_label(reading, trial)) > 0:
        raise ModelError(
            f"{path}: distinguishes {last + 1} classes at least and does not name them; list all of them, in their "
            f"order, in {HOW_TO_SET_NAMES}"
        )
    names = declared.names or (("drone",) if classes == 1 else tuple(f"class_{i}" for i in range(classes)))
    stride = trial.input_size[0] // trial.shapes[0][-1] if reading.head == "centernet" else 1
    return Description(
        head=reading.head,
        outputs=reading.outputs,
        stride=stride,
        names=names,
        source="the shapes of its outputs",
        entries={},
    )


def _reading(path: str, trial: Trial, classes: int | None, declared: Declared) -> HeadReading:
    """The one reading of the outputs that fits. Raises `ModelError` where none does, or more than one."""
    fitting = readings(trial, classes)
    if declared.head is not None:
        asked = [reading for reading in fitting if reading.head == declared.head]
        if len(asked) == 1:
            return asked[0]
        if not asked:
            others = f"; they fit {', '.join(reading.head for reading in fitting)}" if fitting else ""
            raise _unknown(
                path, trial, classes, fitting, f"; as head {declared.head} they make no sense{others}"
            )
        fitting = asked
    against = {reading: contradiction(reading, trial, classes) for reading in fitting}
    good = [reading for reading, reason in against.items() if not reason]
    if len(good) == 1:
        return good[0]
    if len({reading.head for reading in good}) == 1:
        raise ModelError(
            f"{path}: either of its outputs, {_shapes(trial)}, may hold the boxes; name them boxes and scores when you "
            "export it (output_names of torch.onnx.export)"
        )
    if good:
        ways = " or ".join(f"{reading.head} ({HEAD_FORMATS[reading.head]})" for reading in good)
        raise ModelError(
            f"{path}: its outputs, {_shapes(trial)}, can be read in more than one way: as {ways}; set "
            f"{HOW_TO_SET_HEAD}"
        )
    reasons = dict.fromkeys(f"; it is not {reading.head}: {reason}" for reading, reason in against.items())
    raise _unknown(path, trial, classes, fitting, "".join(reasons))


def _shapes(trial: Trial) -> str:
    return ", ".join(str(shape) for shape in trial.shapes[:8]) or "none"


def _unknown(
    path: str, trial: Trial, classes: int | None, fitting: Sequence[HeadReading], reasons: str
) -> ModelError:
    width, height = trial.input_size
    known = "" if classes is None else f" and {classes} class{'es' if classes > 1 else ''}"
    return ModelError(
        f"{path}: its outputs have no known format: {_shapes(trial)} for an input of {width}x{height}{known}{reasons}; "
        f"known are {', '.join(f'{head} {form}' for head, form in HEAD_FORMATS.items())}; "
        f"{next_step(trial, classes, fitting)}"
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
            "classes in detector.classes, or --classes of swarmtrack video"
        )
    against: list[str] = [name.lower() for name in declared.veto] or [*LOOK_ALIKES]
    vetoes = frozenset(i for i, name in enumerate(names) if name in against) - drones
    return replace(description, drones=drones, vetoes=vetoes)


def _listed(names: Sequence[str], most: int = 12) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
