"""Parameters of the relative states: airframes, detectors, autopilots and flight dynamics."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.relative.box_width import BoxWidth
from swarmtrack.relative.priors import USUAL_SPAN_M, USUAL_SPAN_SIGMA


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativeParameters:
    """Parameters of the filter in `log_range.py`. All sizes are relative, as sigmas of a logarithm."""

    airframe_span_m: float | None = None
    """From the outer rim of one rotor disc to that of its neighbour; None: it is not known, and the size tells a range
    only once something else told one."""
    box_width: BoxWidth = field(default_factory=BoxWidth)
    """Of the detector whose boxes these are."""
    speed_sigma: float = 1.0
    """How fast a teammate flies, m/s per axis, before it was watched."""
    fellows: float = 0.7
    """Of the own speed: as fast may a teammate be along each axis then, if that is more."""
    quickens_s: float = 1.0
    """Over which a teammate that is faster counts as one that is fast, and one that is slower as slow."""
    calms_s: float = 4.0
    """In two seconds of hovering a drone's next go-to is forgotten: twice as far off in two of six recorded flights."""
    least_speed: float = 0.2
    """Of the calmest, m/s per axis."""
    forget_s: float = 4.0
    """How long it keeps its velocity."""
    odometry: float = 0.02
    """How the own position drifts, m/√s."""
    jitter_m: float = 0.02
    """How it scatters from one pose to the next."""
    tilt_sigma: float = math.radians(0.5)
    """How well the own autopilot knows its tilt, rad per axis."""
    attitude_walk: float = 0.005
    """How the error of the own attitude moves, rad/√s: 15 mrad that last for 15 s. How large it is, comes with the own
    pose, and only into what is said."""
    turn_sigma: float = 0.06
    """How far a teammate's north is from ours, rad."""
    place_drift: float = 0.02
    """How two drones' frames drift apart, m/√s, and rad/√s."""
    turn_drift: float = 0.002
    ray_sigma: float = 0.035
    """By how much a third drone's ray is off beside what it says, rad; it lasts for `ray_lasts_s`."""
    ray_lasts_s: float = 20.0
    drift_speed: float = 0.5
    """How fast a drone may have left the place it announced, m/s."""

    def __post_init__(self) -> None:
        span = self.airframe_span_m
        if span is not None and not 0.05 <= span <= 10.0:
            raise ValueError(f"relative.airframe_span_m: found {span!r}, expected 0.05 to 10")
        for name in ("speed_sigma", "forget_s", "ray_lasts_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"relative.{name}: found {getattr(self, name)!r}, expected a number above 0")
        for name in ("odometry", "jitter_m", "tilt_sigma", "drift_speed"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"relative.{name}: found {getattr(self, name)!r}, expected 0 or more")

    @property
    def width_m(self) -> float:
        """Width of a teammate's box without padding, at its distance."""
        return (
            USUAL_SPAN_M if self.airframe_span_m is None else self.airframe_span_m
        ) * self.box_width.factor

    @property
    def lasting(self) -> float:
        """What of the size lasts, the span's own error included."""
        return math.hypot(self.box_width.drone_sigma, self._unknown)

    def lasting_by(self, gain: Array) -> Array:
        """(n,) how much of `lasting` is in the range by boxes whose own errors count `gain` times (n,): a span that is
        not known is off by the same in all of them."""
        if self._unknown == 0.0:
            return gain
        return np.asarray(np.hypot(gain * self.box_width.drone_sigma, self._unknown) / self.lasting)

    @property
    def _unknown(self) -> float:
        return USUAL_SPAN_SIGMA if self.airframe_span_m is None else 0.0
