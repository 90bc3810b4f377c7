"""Directions in which a drone sees its teammates, against where these report to be. Pure.

Theory of operation. The own pose and a teammate's reported place predict the azimuth and the elevation at which the
camera sees it. Over a flight measured = scale · predicted + offset. A scale other than 1 is a wrong focal length, an
offset a turned camera, or a turned heading.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from swarmtrack.messages import Array
from swarmtrack.review.flight import ConfirmedLook, DroneFlight, ReviewedScan

PLACE_AGE_S = 1.5  # s of a teammate's newest report
FARTHEST_MATCH_DEG = 40.0  # of a track without a name from the teammate that it may be
FEWEST_DIRECTIONS = 20
LEAST_SPAN_DEG = 15.0  # of azimuths, for a scale
SCALE_OFF = 0.08
TRIMMED_SIGMAS = 3.0
SCATTER_DEG = 3.0  # a fit that scatters more says nothing
FARTHEST_SIDE_DEG = 85.0  # beyond it a direction has no place in the image of a pinhole camera


class Misalignment(NamedTuple):
    """scale: of angles from the image's centre; wrong_scale: it is known to be off; angle_deg: of the offset."""

    scale: float
    wrong_scale: bool
    angle_deg: float


def place(drone: DroneFlight, teammate: int, t: float) -> Array | None:
    """Where a teammate reported to be at t, (3,) m; None where that is too long ago."""
    said = drone.reports_of(teammate)
    k = bisect_right(said, t, key=lambda one: one.sent_t)
    near = [one for one in said[max(0, k - 1) : k + 1] if abs(one.sent_t - t) <= PLACE_AGE_S]
    if len(near) < 2:
        return near[0].position if near else None
    before, after = near
    share = (t - before.sent_t) / max(after.sent_t - before.sent_t, 1e-9)
    return before.position + share * (after.position - before.position)


def predicted(
    drone: DroneFlight, scan: ReviewedScan, where: Array, camera: int | None = None
) -> Array | None:
    """Azimuth and elevation (2,) rad in a camera of a place in the team frame; None without a pose, or behind it."""
    if scan.stand is None or not drone.lenses:
        return None
    lens = drone.lenses[scan.camera if camera is None else camera]
    ray = lens.body_from_camera.T @ scan.stand.world_from_body.T @ (where - scan.stand.position)
    return angles(ray) if np.linalg.norm(ray) > 0.5 else None


def angles(ray: Array) -> Array | None:
    """Azimuth and elevation (2,) rad of a ray in camera axes; None where the camera cannot see."""
    azimuth, elevation = math.atan2(ray[0], ray[2]), math.atan2(ray[1], math.hypot(ray[0], ray[2]))
    if abs(azimuth) > math.radians(FARTHEST_SIDE_DEG):
        return None
    return np.array([azimuth, elevation])


def misaligned(drone: DroneFlight) -> Misalignment | None:
    """None where too little is known."""
    if len(drone.lenses) != 1:
        return None
    rows = [row for scan in drone.scans for row in _pairs(drone, scan)]
    if len(rows) < FEWEST_DIRECTIONS:
        return None
    measured, expected = (np.array(part) for part in zip(*rows, strict=True))
    keep = np.ones(len(rows), dtype=bool)
    for _ in range(4):
        scale, offset = _fit(measured[keep], expected[keep])
        miss = np.linalg.norm(measured - scale * expected - offset, axis=1)
        sigma = 1.4826 * float(np.median(miss[keep]))
        keep = miss <= max(TRIMMED_SIGMAS * sigma, 1e-3)
        if keep.sum() < FEWEST_DIRECTIONS:
            return None
    if math.degrees(float(np.median(miss[keep]))) > SCATTER_DEG or keep.mean() < 0.5:
        return None
    spans = math.degrees(float(np.ptp(expected[keep, 0]))) >= LEAST_SPAN_DEG
    if not spans:
        scale, offset = 1.0, np.median(measured[keep] - expected[keep], axis=0)
    wrong = spans and abs(scale - 1.0) > SCALE_OFF
    return Misalignment(scale, wrong, math.degrees(float(np.linalg.norm(offset))))


def _fit(measured: Array, expected: Array) -> tuple[float, Array]:
    """Least squares of one scale and an offset (2,)."""
    x, y = expected - expected.mean(axis=0), measured - measured.mean(axis=0)
    spread = float((x * x).sum())
    scale = float((x * y).sum()) / spread if spread > 1e-6 else 1.0
    return scale, measured.mean(axis=0) - scale * expected.mean(axis=0)


def _pairs(drone: DroneFlight, scan: ReviewedScan) -> Iterator[tuple[Array, Array]]:
    """Measured and expected angles of each teammate: by its name, else by which fits best."""
    looks = [look for look in scan.looks if look.bearing is not None]
    expected = {}
    for teammate in {one.observer for one in drone.heard}:
        where = place(drone, teammate, scan.t)
        found = None if where is None else predicted(drone, scan, where)
        if found is not None:
            expected[teammate] = found
    free: list[ConfirmedLook] = []
    for look in looks:
        at = angles(look.bearing) if look.bearing is not None else None
        if at is None:
            continue
        if isinstance(look.identity, int) and look.identity in expected:
            yield at, expected.pop(look.identity)
        elif look.identity is None:
            free.append(look)
    if not free or not expected:
        return
    seen = [angles(look.bearing) for look in free if look.bearing is not None]
    there = list(expected.values())
    cost = np.array([[np.linalg.norm(a - b) if a is not None else math.pi for b in there] for a in seen])
    for i, j in zip(*linear_sum_assignment(cost), strict=True):
        at = seen[i]
        if at is not None and cost[i, j] < math.radians(FARTHEST_MATCH_DEG):
            yield at, there[j]
