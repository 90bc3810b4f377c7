"""A recorded flight on one page: the map, distances, who was named when, and errors where the truth is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from swarmtrack.errors import RecordingError
from swarmtrack.messages import FOREIGN, Array, Identity
from swarmtrack.monitor.flight_course import LOOKS_HZ, FlightCourse, SeenTeammate
from swarmtrack.outputs.palette import colour_of

mpl.use("Agg")

import matplotlib.pyplot as plt

MOST_DRAWN = 8  # observers with rows and lines of their own
STYLES = ("-", "--", "-.")  # of lines, by observer
GAP_S = 1.0  # s without a measurement: the line is broken


def plot_flight(course: FlightCourse, path: Path) -> None:
    """Raises RecordingError where the file cannot be written."""
    rows = 3 if course.truth else 2
    figure = plt.figure(figsize=(13.0, 2.7 * rows), layout="constrained")
    grid = figure.add_gridspec(rows, 2, width_ratios=(1.0, 1.35), height_ratios=(1.2, 1.2, 1.0)[:rows])
    every = [drone_id for drone_id, seen in course.seen.items() if seen]
    observers = every[:MOST_DRAWN]
    _draw_map(figure.add_subplot(grid[:, 0]), course)
    below = [figure.add_subplot(grid[k, 1]) for k in range(rows)]
    _draw_distances(below[0], course, observers)
    _draw_names(below[1], course, observers)
    if course.truth:
        _draw_errors(below[2], course, observers)
    for axis in below:
        axis.set_xlim(0.0, course.seconds)
        axis.grid(alpha=0.25)
    below[-1].set_xlabel("time, s")
    drones = len(course.places | course.seen)
    some = f", the first {MOST_DRAWN} observers of {len(every)}" if len(every) > MOST_DRAWN else ""
    figure.suptitle(f"team {course.team}: {drones} drones, {course.seconds:.0f} s{some}", x=0.01, ha="left")
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"--out {path}: {error}, expected a .png, .svg or .pdf that can be written"
        ) from error
    finally:
        plt.close(figure)


def _shade(identity: Identity) -> tuple[float, ...]:
    return tuple(0.9 * part / 255.0 for part in colour_of(identity))


def _name(identity: Identity) -> str:
    return "no name" if identity is None else "stranger" if identity == FOREIGN else f"drone {identity}"


def _draw_map(axis: Any, course: FlightCourse) -> None:
    for drone_id, told in course.places.items():
        rows = course.truth.get(drone_id, told)
        rows = rows[(rows[:, 0] >= 0.0) & (rows[:, 0] <= course.seconds)]
        if not len(rows):
            continue
        axis.plot(rows[:, 2], rows[:, 1], color=_shade(drone_id), lw=1.8)
        axis.plot(rows[0, 2], rows[0, 1], "o", mfc="white", mec=_shade(drone_id), ms=7)
        axis.plot(rows[-1, 2], rows[-1, 1], "o", color=_shade(drone_id), ms=9)
        axis.annotate(
            f"drone {drone_id}", (rows[-1, 2], rows[-1, 1]), xytext=(8, 6), textcoords="offset points"
        )
    axis.set_aspect("equal", adjustable="datalim")
    axis.margins(0.15)
    axis.grid(alpha=0.25)
    axis.set_xlabel("east, m")
    axis.set_ylabel("north, m")
    source = "true paths" if course.truth else "reported paths"
    axis.set_title(f"From above: {source}, from ○ to ●", loc="left")


def _draw_distances(axis: Any, course: FlightCourse, observers: list[int]) -> None:
    """A line for each pair, in the colour of the one that is seen, in the style of its observer; dotted: the truth."""
    known: list[float] = []
    for k, observer in enumerate(observers):
        for identity, seen in _by_name(course.seen[observer]).items():
            rows = [
                (one.t, np.linalg.norm(one.position), one.sigma, _length(course.true_offset(observer, one)))
                for one in seen
                if one.position is not None
            ]
            if not rows:
                continue
            t, measured, sigma, true = _broken(np.array(rows, dtype=float)).T
            colour = _shade(identity)
            axis.plot(
                t, measured, color=colour, lw=1.4, ls=STYLES[k % len(STYLES)], label=f"{observer}→{identity}"
            )
            axis.fill_between(
                t, measured - 2.0 * sigma, measured + 2.0 * sigma, color=colour, alpha=0.13, lw=0
            )
            axis.plot(t, true, color="black", lw=0.9, ls=":")
            known += [float(row[1]) for row in rows]
    axis.set_ylabel("distance, m")
    axis.set_ylim(bottom=0.0)
    if known:
        axis.legend(fontsize=8, ncols=8, loc="lower right")
    dotted = "; dotted: true" if course.truth else ""
    span = f"{min(known):.1f} … {max(known):.1f} m" if known else "none was measured"
    axis.set_title(f"Distances, observer→teammate: {span} (band: ± 2σ{dotted})", loc="left")


def _length(offset: Array | None) -> float:
    return np.nan if offset is None else float(np.linalg.norm(offset))


def _draw_names(axis: Any, course: FlightCourse, observers: list[int]) -> None:
    """A row for each observer and name, filled while it is given."""
    labels: list[str] = []
    named = total = 0
    for observer in observers:
        for identity, seen in _by_name(course.seen[observer]).items():
            times = sorted({one.t for one in seen})
            axis.broken_barh(
                [(t, 1.3 / LOOKS_HZ) for t in times], (len(labels) - 0.4, 0.8), color=_shade(identity), lw=0
            )
            labels.append(f"{observer} sees {_name(identity)}")
            named += len(seen) if identity is not None else 0
            total += len(seen)
    axis.set_yticks(range(len(labels)), labels, fontsize=8)
    axis.set_ylim(len(labels) - 0.5, -0.5)
    share = f"{named / total:.0%} of the time that a drone was tracked" if total else "no drone was tracked"
    axis.set_title(f"Names: given {share}", loc="left")


def _draw_errors(axis: Any, course: FlightCourse, observers: list[int]) -> None:
    every: list[float] = []
    for k, observer in enumerate(observers):
        for identity, seen in _by_name(course.seen[observer]).items():
            found = [
                (one.t, float(np.linalg.norm(one.position - off)))
                for one in seen
                if one.position is not None and (off := course.true_offset(observer, one)) is not None
            ]
            if found:
                t, error = _broken(np.array(found)).T
                axis.plot(t, error, color=_shade(identity), lw=1.2, ls=STYLES[k % len(STYLES)])
                every += [length for _, length in found]
    axis.set_ylabel("error, m")
    axis.set_ylim(bottom=0.0)
    said = (
        f"half below {np.median(every):.2f} m, 95 % below {np.percentile(every, 95):.2f} m"
        if every
        else "none was measured"
    )
    axis.set_title(f"Errors of the teammates' positions: {said}", loc="left")


def _by_name(seen: list[SeenTeammate]) -> dict[Identity, list[SeenTeammate]]:
    """Drones in their order, then strangers, then those without a name."""
    found: dict[Identity, list[SeenTeammate]] = {}
    for one in seen:
        found.setdefault(one.identity, []).append(one)
    order = sorted(found, key=lambda who: (who is None, not isinstance(who, int), str(who).zfill(5)))
    return {identity: found[identity] for identity in order}


def _broken(rows: Array) -> Array:
    """Rows of (t, ...) with one of NaN in each gap, which breaks the line."""
    gaps = np.flatnonzero(np.diff(rows[:, 0]) > GAP_S) + 1
    return np.insert(rows, gaps, np.nan, axis=0)
