"""Trajectories as CSV: where each drone is when, one line for each sample.

    id,t_s,north_m,east_m,down_m
    1,0.00,0.000,0.000,0.000

t_s counts from the beginning that all drones agreed on. The places are in the team frame, or from wherever the drone
holds its place: readers take differences. `swarmtrack mission sway` writes such files, and `[team] plan` reads them.
More columns may follow those five; they are for the pilot of the file.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swarmtrack.errors import ConfigError
from swarmtrack.messages import Array

TRAJECTORY_COLUMNS = ("id", "t_s", "north_m", "east_m", "down_m")
MAX_TRAJECTORY_BYTES = 16 * 1024 * 1024
MAX_ID = 65535
MAX_METRES, MAX_SECONDS = 1e5, 1e5


@dataclass(frozen=True, slots=True, eq=False)
class SampledTrajectory:
    """Trajectory of one drone: t (n,) s, increasing, n ≥ 2; position (n, 3) m, NED."""

    t: Array
    position: Array

    def at(self, t: Array) -> Array:
        """(k, 3) m at the times t (k,): linear between samples, at rest outside."""
        return np.stack([np.interp(t, self.t, axis) for axis in self.position.T], axis=1)


def write_trajectories(path: Path, rows: Iterable[Sequence[float]], more_columns: Sequence[str] = ()) -> None:
    """Rows of (id, t_s, north_m, east_m, down_m, then a value for each of more_columns)."""
    with path.open("w", encoding="utf-8", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow((*TRAJECTORY_COLUMNS, *more_columns))
        for drone_id, *values in rows:
            lines.writerow((int(drone_id), *(f"{value:.4f}" for value in values)))


def read_trajectories(path: Path) -> dict[int, SampledTrajectory]:
    """By drone. Raises ConfigError with `FILE:LINE: column: found, expected` for the first thing that is wrong."""
    samples: dict[int, list[tuple[float, ...]]] = {}
    try:
        if path.stat().st_size > MAX_TRAJECTORY_BYTES:
            raise _wrong(
                path, 1, f"larger than {MAX_TRAJECTORY_BYTES // 2**20} MiB, expected a table of trajectories"
            )
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.DictReader(file, strict=True)
            missing = [column for column in TRAJECTORY_COLUMNS if column not in (lines.fieldnames or ())]
            if missing:
                raise _wrong(
                    path,
                    1,
                    f"column {missing[0]}: missing, expected {','.join(TRAJECTORY_COLUMNS)} in line 1",
                )
            for line in lines:
                drone_id, *sample = (
                    _number(path, lines.line_num, line, column) for column in TRAJECTORY_COLUMNS
                )
                own = samples.setdefault(int(drone_id), [])
                if own and sample[0] <= own[-1][0]:
                    text = f"t_s: {sample[0]:g} of drone {int(drone_id)}, expected more than {own[-1][0]:g}"
                    raise _wrong(path, lines.line_num, text)
                own.append(tuple(sample))
    except OSError as error:
        raise _wrong(
            path, 1, f"cannot be read ({error.strerror}), expected a table of trajectories"
        ) from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise _wrong(path, 1, f"{error}, expected CSV in UTF-8") from None
    return _as_arrays(path, samples)


def _as_arrays(
    path: Path, samples: Mapping[int, Sequence[tuple[float, ...]]]
) -> dict[int, SampledTrajectory]:
    if not samples:
        raise _wrong(path, 1, "no samples, expected a line for each drone and time")
    found = {}
    for drone_id, own in sorted(samples.items()):
        if len(own) < 2:
            raise _wrong(path, 1, f"id: drone {drone_id} has one sample, expected two or more")
        table = np.array(own)
        found[drone_id] = SampledTrajectory(table[:, 0], table[:, 1:])
    return found


def _number(path: Path, number: int, line: Mapping[str, Any], column: str) -> float:
    """A cell, checked."""
    text = line[column]
    try:
        value = float(text)
    except (TypeError, ValueError):
        value = math.nan
    if column == "id":
        good, expected = value in range(1, MAX_ID + 1), f"a drone's ID, 1 to {MAX_ID}"
    elif column == "t_s":
        good, expected = abs(value) <= MAX_SECONDS, f"seconds, {MAX_SECONDS:g} at most"
    else:
        good, expected = abs(value) <= MAX_METRES, f"metres, {MAX_METRES:g} at most"
    if not good:
        raise _wrong(path, number, f"{column}: {'nothing' if text is None else text}, expected {expected}")
    return value


def _wrong(path: Path, line: int, text: str) -> ConfigError:
    return ConfigError([f"{path}:{line}: {text}"])
