"""Consistency of the tracker from its innovations, in words for the pilot. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable

from swarmtrack.diagnosis.findings import Finding, fault
from swarmtrack.tracking.consistency import Consistency
from swarmtrack.tracking.noise import MeasuredNoise

NOISY = 2.0  # times the standard deviation that was told, from which on a camera or its detector is not as they should
# Of the normalised innovation squared over its expectation. Twice too sure, or three times too careful, in sigmas: then
# a planner that trusts the covariance is misled.
NIS_OVERCONFIDENT_RATIO, NIS_CAUTIOUS_RATIO = 4.0, 1.0 / 9.0


def ratio_of(consistency: Consistency) -> float:
    """Normalised innovation squared over its expectation: above 1 covariances are too small, below too large."""
    return consistency.nis / (0.5 * (consistency.low + consistency.high))


def worst(consistencies: Iterable[Consistency | None]) -> Consistency | None:
    """The least consistent of several trackers; None without data."""
    known = (one for one in consistencies if one is not None)
    return max(known, key=lambda one: abs(math.log(max(ratio_of(one), 1e-9))), default=None)


def check_tracking(consistency: Consistency | None, noise: MeasuredNoise | None) -> list[Finding]:
    """Findings; empty where all is well, or with too few data."""
    findings = []
    if noise is not None and noise.detections >= NOISY:
        findings.append(fault("tracking.noisy", times=noise.detections))
    if consistency is None:
        return findings
    ratio = ratio_of(consistency)
    if ratio >= NIS_OVERCONFIDENT_RATIO:
        findings.append(fault("tracking.sure", times=ratio**0.5))
    elif ratio <= NIS_CAUTIOUS_RATIO:
        findings.append(fault("tracking.careful", times=max(ratio, 1e-4) ** -0.5))
    return findings
