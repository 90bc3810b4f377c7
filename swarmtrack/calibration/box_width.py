"""Fit of `BoxWidth`: widths of a detector's boxes around airframes of known span and distance.

The logarithm of a box's width is compared with that of factor · x + padding, x the width of the span at that distance
[px], by robust least squares. What the residuals of a drone have in common is its lasting error. The rest is split by
its autocovariance: what two boxes a moment apart share wanders, what they do not is white.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from swarmtrack.errors import CalibrationError
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.relative.box_width import BoxWidth

# Boxes without which nothing is said; and how many times the narrowest the widest must be for a padding to be told.
FEWEST_BOXES, FEWEST_BOXES_OF_DRONE, PADDING_WIDTH_RATIO = 200, 30, 1.6
# Drones whose lasting errors differ by a figure; of fewer the usual one stays.
FEWEST_DRONES = 3
# Of ln(width): whatever is farther off than this is a box around something else.
OTHER_THING = 0.7
# Robust standard deviations at which a residual counts no more.
CLIPPED = 3.0
MAD = 1.4826
# s: lags at which the residuals are compared, and memories that are tried.
LAGS, MEMORIES = np.array([0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0]), np.geomspace(0.1, 10.0, 60)


class Widths(NamedTuple):
    """One drone in one flight, (n,) each: t s, span_px of the span at its distance, box_px of the box, both level."""

    t: Array
    span_px: Array
    box_px: Array


class WidthFit(NamedTuple):
    """Result of the fit. padded: whether the distances separate padding from factor; drones_told: whether
    drone_sigma was measured; residuals: by drone, of ln(width).
    """

    width: BoxWidth
    boxes: int
    drones: int
    padded: bool
    drones_told: bool
    residuals: tuple[Array, ...]


def fit_box_width(drones: Sequence[Widths]) -> WidthFit:
    """Fit the model. Raises CalibrationError for too few or too similar boxes."""
    drones = [drone for drone in drones if len(drone.t) >= FEWEST_BOXES_OF_DRONE]
    boxes = sum(len(drone.t) for drone in drones)
    if boxes < FEWEST_BOXES:
        raise CalibrationError(
            f"found {boxes} boxes of drones at a known distance, expected {FEWEST_BOXES} or more, at least "
            f"{FEWEST_BOXES_OF_DRONE} of each drone: record a longer flight, nearer to each other"
        )
    x = np.concatenate([drone.span_px for drone in drones])
    log_w = np.log(np.concatenate([drone.box_px for drone in drones]))
    low, high = np.quantile(x, [0.05, 0.95]).tolist()
    padded = high > PADDING_WIDTH_RATIO * low
    factor, padding = _line(x, log_w, padded)
    off = [np.log(drone.box_px) - np.log(factor * drone.span_px + padding) for drone in drones]
    good = [np.abs(e) < OTHER_THING for e in off]
    lasting = np.array([np.median(e[g]) for e, g in zip(off, good, strict=True) if g.any()])
    usual = BoxWidth()
    drones_told = len(lasting) >= FEWEST_DRONES
    wander, memory, white = _split(
        [
            (drone.t[g], e[g] - np.median(e[g]))
            for drone, e, g in zip(drones, off, good, strict=True)
            if g.any()
        ]
    )
    width = BoxWidth(
        factor=round(factor, 3),
        padding_px=round(padding, 1),
        drone_sigma=round(float(lasting.std(ddof=1)), 3) if drones_told else usual.drone_sigma,
        wander_sigma=round(wander, 3),
        wander_s=round(memory, 2),
        white_sigma=round(max(white, 0.01), 3),
    )
    return WidthFit(width, boxes, len(drones), padded, drones_told, tuple(off))


def _line(x: Array, log_w: Array, padded: bool) -> tuple[float, float]:
    """factor and padding, by Gauss-Newton with weights that fall with the residual (Cauchy's)."""
    factor, padding = math.exp(float(np.median(log_w - np.log(x)))), 0.0
    for _ in range(100):
        line = factor * x + padding
        e = log_w - np.log(line)
        scale = max(MAD * float(np.median(np.abs(e))), 1e-3)
        weight = 1.0 / (1.0 + (e / (2.0 * scale)) ** 2)
        by = np.column_stack([x, np.ones_like(x)]) / line[:, None]
        if not padded:
            by = by[:, :1]
        step = np.linalg.solve(by.T @ (weight[:, None] * by), by.T @ (weight * e))
        factor += float(step[0])
        padding += float(step[1]) if padded else 0.0
        # No box is narrower than nothing.
        factor, padding = max(factor, 0.05), max(padding, -0.9 * factor * float(x.min()))
    return factor, padding


def _split(drones: Sequence[tuple[Array, Array]]) -> tuple[float, float, float]:
    """Wandering sigma, its memory [s] and white sigma, of the residuals (t, e) of each drone."""
    spread = MAD * float(np.median(np.abs(np.concatenate([e for _, e in drones]))))
    clipped = [(t, np.clip(e, -CLIPPED * spread, CLIPPED * spread)) for t, e in drones]
    whole = float(np.mean(np.concatenate([e * e for _, e in clipped])))
    sums, counts = np.zeros(len(LAGS)), np.zeros(len(LAGS))
    for t, e in clipped:
        for k, lag in enumerate(LAGS.tolist()):
            later = np.searchsorted(t, t + 0.9 * lag)
            later = np.minimum(later, len(t) - 1)
            pair = np.abs(t[later] - t - lag) < 0.25 * lag
            sums[k] += float((e[pair] * e[later[pair]]).sum())
            counts[k] += int(pair.sum())
    told = counts >= FEWEST_BOXES_OF_DRONE
    if not told.any():
        usual = BoxWidth()
        return 0.0, usual.wander_s, math.sqrt(whole)
    shared = sums[told] / counts[told]
    best = (math.inf, 0.0, 1.0)
    for memory in MEMORIES.tolist():
        shape = np.exp(-LAGS[told] / memory)
        variance = max(float(shape @ (counts[told] * shared)) / float(shape @ (counts[told] * shape)), 0.0)
        variance = min(variance, whole)
        miss = float(counts[told] @ (shared - variance * shape) ** 2)
        best = min(best, (miss, variance, memory))
    _, variance, memory = best
    return math.sqrt(variance), memory, math.sqrt(max(whole - variance, 0.0))


def level_width(away: Array, span: float, camera: PinholeCamera, team_from_camera: Array) -> float:
    """Width of a level line of `span` m across the view at away (3,) m from the camera, team axes: px, undistorted,
    or in the image of a wide lens.
    """
    ray = away / np.linalg.norm(away)
    level = np.array([-ray[1], ray[0], 0.0])
    level *= 0.5 * span / max(float(np.linalg.norm(level)), 1e-9)
    ends, _, valid = camera.project_undistorted(np.stack([away - level, away + level]) @ team_from_camera)
    ends = camera.framed(ends).at
    return float(np.linalg.norm(ends[1] - ends[0])) if valid.all() else math.nan
