"""Result of turning a drone by hand: its plausibility, and the lines for the config."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

import numpy as np

from swarmtrack.config.drone import load_config
from swarmtrack.errors import ConfigError, SourceError
from swarmtrack.geometry import rotation
from swarmtrack.messages import Array
from swarmtrack.motion.hand_eye import Agreement, HandEye

CALIBRATED_SIGMA_DEG, CALIBRATED_SIGMA_S = 0.3, 3e-3  # one sigma
LEAST_RATE = 0.12  # rad/s about the axis that was turned about the least
MOST_OUTLIERS = 0.3  # share of frames
LEAST_SECONDS = 15.0
FIT_RATIO_BOUNDS = (0.7, 1.3)  # image over gyro, with the mounting that was found
BODY_AXES = ("roll (about the nose)", "pitch (about the wings)", "yaw (about the vertical)")


def rpy_deg(found: HandEye) -> Array:
    """Camera angles (3,) as in `camera.body_from_camera.rpy_deg`: of the camera as if it were a body."""
    body_from_aimed = found.camera_from_body.T @ rotation.BODY_FROM_FORWARD_CAMERA.T
    return np.degrees(rotation.to_euler(body_from_aimed))


def doubts(found: HandEye, agreement: Agreement | None, *, seconds: float, reach: float) -> list[str]:
    """Reasons against the result, with remedies; empty for a plausible one."""
    lines = []
    if found.at_edge:
        lines.append(f"the clocks are more than {reach:g} s apart: search farther with --reach")
    if (
        agreement is not None
        and not (
            (FIT_RATIO_BOUNDS[0] < agreement.gain) & (agreement.gain < FIT_RATIO_BOUNDS[1])
            | (agreement.rate < LEAST_RATE)
        ).all()
    ):
        gains = ", ".join(f"{gain:.2f}" for gain in agreement.gain)
        lines.append(
            f"image and gyro do not fit by any rotation (image over gyro about the camera's axes: {gains}): a flipped "
            "axis of the IMU, wrong focal lengths, or things close by"
        )
    if seconds < LEAST_SECONDS:
        lines.append(
            f"{seconds:.0f} s of frames with a gyro, expected {LEAST_SECONDS:.0f} at least: turn longer"
        )
    weak = [name for name, rate in zip(BODY_AXES, found.rates, strict=True) if rate < LEAST_RATE]
    if weak:
        lines.append(f"hardly turned in {' and '.join(weak)}: turn about all three axes")
    elif found.excitation[0] < LEAST_RATE:
        lines.append("all turns were about two axes or fewer: also turn about each axis on its own")
    sigma = math.degrees(float(found.rotation_sigma.max()))
    if sigma > CALIBRATED_SIGMA_DEG:
        lines.append(f"the rotation is known only to ± {sigma:.2f}°: turn longer, and about all axes")
    if found.time_offset_sigma_s > CALIBRATED_SIGMA_S:
        lines.append(
            f"the offset is known only to ± {1e3 * found.time_offset_sigma_s:.1f} ms: turn to and fro, faster"
        )
    if found.outliers > MOST_OUTLIERS:
        lines.append(
            f"{found.outliers:.0%} of the frames do not fit: keep people and near things out of view, in good light"
        )
    return lines


def toml_lines(found: HandEye, position_m: Array) -> list[str]:
    """Lines for the config's [camera]."""
    angles = ", ".join(f"{angle:.2f}" for angle in rpy_deg(found))
    place = ", ".join(f"{x:g}" for x in np.round(position_m, 4))
    return [
        f"body_from_camera = {{ rpy_deg = [{angles}], position_m = [{place}] }}",
        f"time_offset_s = {found.time_offset_s:.4f}",
    ]


def for_the_config(lines: list[str], number: int, count: int) -> str:
    """Lines to put into a config by hand, for the camera of this index among its `count`."""
    head = "[camera]" if count == 1 else f"[[camera]]  # into that of camera {number + 1} of {count}"
    return "\n".join([head, *lines])


def write_into(path: Path, lines: list[str], number: int = 0) -> None:
    """Write lines `key = …` into the [camera] of a config, over those of the same keys; of several cameras, into
    the one of this index. Leaves the file unchanged where the result would be invalid: SourceError.
    """
    try:
        before = path.read_text(encoding="utf-8")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}, expected a config to write into") from None
    after = with_lines(before, lines, number)
    unfinished = path.with_name(f".{path.name}.new.toml")
    try:
        unfinished.write_text(after, encoding="utf-8")
        load_config(unfinished)
        unfinished.replace(path)
    except ConfigError as error:
        reason = str(error).replace(str(unfinished), str(path))
        raise SourceError(f"{path}: left as it was, paste the lines yourself: {reason}") from None
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}, left as it was") from None
    finally:
        if unfinished.exists():
            os.unlink(unfinished)


def with_lines(text: str, lines: list[str], number: int = 0) -> str:
    """A config's text with lines `key = …` in its [camera], or in the [[camera]] of this index."""
    rows = text.splitlines()
    heads = [i for i, row in enumerate(rows) if re.match(r"\s*(\[\s*camera\s*\]|\[\[\s*camera\s*\]\])", row)]
    if number >= len(heads):
        return "\n".join([*rows, "", "[[camera]]" if number else "[camera]", *lines, ""])
    begin = heads[number] + 1
    end = next((i for i in range(begin, len(rows)) if rows[i].lstrip().startswith("[")), len(rows))
    body = rows[begin:end]
    for line in lines:
        key = line.partition("=")[0].strip()
        there = [i for i, row in enumerate(body) if re.match(rf"\s*{key}\s*=", row)]
        if there:
            body[there[0]] = line
        else:
            last = max((i for i, row in enumerate(body) if row.strip()), default=-1)
            body.insert(last + 1, line)
    return "\n".join([*rows[:begin], *body, *rows[end:], ""])
