"""Where a teammate says that it was, at any time between its reports and shortly after.

Between two reports it is on the parabola through the last three; its place is vaguer there as far as the parabola
bends, because the bend is a guess.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.team.priors import (
    BEND_ERROR,
    CARRIED_BANDWIDTH_RAD_S,
    CARRIED_M_S2,
    CARRIED_MOST_S,
    FLEW_M_S,
    FLEW_ON_M_S,
    MOTION_DEVIATION,
    MOTION_WHITE_M,
    PLACE_LASTS_S,
    REPORTED_DEVIATION,
    REPORTED_WHITE_M,
    WAITING_M_S,
    WAITING_MOST_M,
)

# Reports kept: a few seconds of the quickest sender.
REPORTS_KEPT = 40
# s between two reports that a curve may go through.
_CURVE_LEAST_S, _CURVE_MOST_S = 0.3, 2.5


class Report(NamedTuple):
    """A place (3,) m in the teammate's own frame at t [s], and its velocity (3,) m/s where it is known; measured: that
    it says both of them itself; t_sigma [s]; sigma [m per axis]: of a place that teammates carry."""

    t: float
    place: Array
    velocity: Array | None
    measured: bool = False
    t_sigma: float = 0.0
    sigma: float = 0.0

    @property
    def speed(self) -> float:
        """m/s, 0 where it is not known."""
        return 0.0 if self.velocity is None else math.hypot(*self.velocity.tolist())


class SaidPlace(NamedTuple):
    """A place (3,) m in the teammate's own frame, how far it may be from there, smoothly, sigma [m] and bandwidth
    [rad/s], and the white variance [m²] on top."""

    place: Array
    sigma: float
    bandwidth: float
    white: float


class ReportedPlaces:
    """Grows by every report, in the order in which they were made."""

    def __init__(self) -> None:
        self._reports: deque[Report] = deque(maxlen=REPORTS_KEPT)

    def __bool__(self) -> bool:
        return bool(self._reports)

    @property
    def last(self) -> Report:
        """The newest report; IndexError where there is none."""
        return self._reports[-1]

    def begin_at_last(self) -> None:
        """What was before the newest report was in another frame."""
        while len(self._reports) > 1:
            self._reports.popleft()

    def append(self, report: Report) -> None:
        """One more; one that is not newer than the last is dropped."""
        if not self._reports or report.t > self._reports[-1].t:
            self._reports.append(report)

    def velocity_to(self, place: Array, t: float) -> Array | None:
        """(3,) m/s: to a place (3,) m at t [s], newer than all; None without a report of a moment or two before."""
        before = self._before(t)
        return None if before is None else (place - before.place) / (t - before.t)

    def _before(self, t: float) -> Report | None:
        """The newest report that is so long before t [s] that a slope may be taken, and not too long."""
        found = next((report for report in reversed(self._reports) if t - report.t > _CURVE_LEAST_S), None)
        return found if found is not None and t - found.t < _CURVE_MOST_S else None

    def at(self, t: float) -> SaidPlace:
        """The place at t."""
        reports = self._reports
        k = len(reports) - 1
        while k > 0 and reports[k].t > t:
            k -= 1
        here = reports[k]
        if k + 1 < len(reports) and t >= here.t:
            return self._between(k, t)
        place, since = here.place, abs(t - here.t)
        if here.velocity is not None:
            place = place + min(max(t - here.t, -CARRIED_MOST_S), CARRIED_MOST_S) * here.velocity
        if since <= PLACE_LASTS_S:
            return _said(place, 0.5 * CARRIED_M_S2 * since**2, here)
        if here.speed > FLEW_M_S:
            return _said(place, FLEW_ON_M_S * since, here)
        return _said(place, min(WAITING_M_S * since, WAITING_MOST_M), here)

    def _between(self, k: int, t: float) -> SaidPlace:
        here, there = self._reports[k], self._reports[k + 1]
        step = max(there.t - here.t, 1e-3)
        slope = (there.place - here.place) / step
        bend = np.zeros(3)
        before = self._before(here.t) if step > _CURVE_LEAST_S else None
        if before is not None:
            bend = (slope - (here.place - before.place) / (here.t - before.t)) / (there.t - before.t)
        on, left = min(t - here.t, step), max(there.t - t, 0.0)
        place = here.place + on * slope - on * left * bend
        error = BEND_ERROR * math.hypot(*bend.tolist()) * on * left
        return _said(place, error, here)


def _said(place: Array, white_sigma: float, report: Report) -> SaidPlace:
    late = report.t_sigma * report.speed if report.t_sigma else 0.0
    if report.measured and report.velocity is not None:
        sigma, bandwidth = MOTION_DEVIATION
        return SaidPlace(place, math.hypot(sigma, late), bandwidth, MOTION_WHITE_M**2 + white_sigma**2)
    sigma, bandwidth = REPORTED_DEVIATION
    white = REPORTED_WHITE_M**2 + white_sigma**2 + late**2
    if report.sigma:
        # Where teammates carry it, it deviates within seconds.
        sigma, bandwidth = math.hypot(sigma, report.sigma), CARRIED_BANDWIDTH_RAD_S
    return SaidPlace(place, sigma, bandwidth, white)
