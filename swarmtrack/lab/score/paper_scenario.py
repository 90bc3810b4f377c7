"""The simulated scenario of the paper that this project began from, by a formula, and its thirteen sensor conditions.

Three drones hover, change places along straight lines, hover, come back, and go again: 160 steps of 0.1205 s in an
image of 400 × 300 px, seen by an observer at rest. The progress along a line is that of least jerk with two terms more,

    f(s) = 10 s³ − 15 s⁴ + 6 s⁵ + s³ (1 − s)³ (a + b (2 s − 1)),

which keeps velocity and acceleration zero at both ends. Begin, duration, a and b are least-squares fits, for each drone
and direction, to the truth digitised from the authors' published figures; the formula stays within 0.4 px of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array

PAPER_STEP_S = 0.1205
PAPER_STEPS = 160
PAPER_WIDTH_PX, PAPER_HEIGHT_PX = 400, 300

# px: where the drones begin; v upward
HERE = np.array([[249.138, 188.857], [131.903, 168.139], [180.0, 99.898]])
THERE = np.array([[111.207, 85.206], [228.365, 95.753], [180.0, 160.157]])


class Leg(NamedTuple):
    """One drone's way from one place to the other: when it begins and how long it takes [steps from 1], a and b."""

    begin: float
    duration: float
    a: float
    b: float


OUT = (
    Leg(11.929, 36.391, -2.126, 7.874),
    Leg(11.561, 36.659, -1.984, 8.016),
    Leg(12.833, 19.181, 0.389, -2.285),
)
BACK = (
    Leg(61.524, 35.454, -5.053, 4.947),
    Leg(62.434, 34.898, -2.412, 4.621),
    Leg(62.713, 19.196, 0.345, -3.407),
)
PAPER_PERIOD_STEPS = 100.0  # steps from the first way out to the second


class PaperCondition(NamedTuple):
    """What the sensor does. sigma_px: noise per axis; clutter: false detections in *every* scan, uniform in the image;
    p_detection: of each drone and step, independently.
    """

    sigma_px: float = 0.0
    clutter: int = 0
    p_detection: float = 1.0


CONDITIONS = {
    "control": PaperCondition(),
    "clutter1": PaperCondition(clutter=1),
    "clutter5": PaperCondition(clutter=5),
    "clutter10": PaperCondition(clutter=10),
    "noise.25": PaperCondition(sigma_px=0.5),
    "noise.50": PaperCondition(sigma_px=1.0),
    "noise.75": PaperCondition(sigma_px=1.5),
    "pd.97": PaperCondition(p_detection=0.97),
    "pd.95": PaperCondition(p_detection=0.95),
    "pd.90": PaperCondition(p_detection=0.90),
    "pd.80": PaperCondition(p_detection=0.80),
    "mixedA": PaperCondition(sigma_px=1.0, clutter=3, p_detection=0.99),
    "mixedB": PaperCondition(sigma_px=0.5, clutter=1, p_detection=0.97),
}

PUBLISHED_RMSE_PX = {  # the paper's text; all else it shows in figures only
    "kalman": {"control": 3.844, "clutter10": 477.63},
    "jpdaf": {"control": 0.302, "clutter10": 4.34, "noise.75": 2.52, "pd.80": 0.62},
    "gmphd": {"control": 0.735, "clutter10": 1.81, "noise.75": 1.74, "pd.80": 0.45},
}


def times() -> Array:
    """(160,) s: of the steps, the first at 0."""
    return np.asarray(PAPER_STEP_S * np.arange(PAPER_STEPS))


def truth(t: Array) -> Array:
    """Where the drones are at t (k,) s: (k, 3, 2) px [u, v], v upward as the paper plots it."""
    step = 1.0 + np.asarray(t, dtype=float) / PAPER_STEP_S
    return np.stack([_way(step, drone) for drone in range(len(HERE))], axis=1)


def progress(s: Array, a: float = 0.0, b: float = 0.0) -> Array:
    """f(s), held at 0 before and at 1 after; s (k,)."""
    s = np.clip(s, 0.0, 1.0)
    least_jerk = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return np.asarray(least_jerk + (s * (1.0 - s)) ** 3 * (a + b * (2.0 * s - 1.0)))


def _way(step: Array, drone: int) -> Array:
    """(k, 2) px."""
    out, back = OUT[drone], BACK[drone]
    again = out._replace(begin=out.begin + PAPER_PERIOD_STEPS)
    share = _gone(step, out) - _gone(step, back) + _gone(step, again)
    return np.asarray(HERE[drone] + share[:, None] * (THERE[drone] - HERE[drone]))


def _gone(step: Array, leg: Leg) -> Array:
    return progress((step - leg.begin) / leg.duration, leg.a, leg.b)
