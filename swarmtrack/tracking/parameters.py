"""What every tracker is told about the sensor and the targets; each has more of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass

PROFILES = ("default", "paper")
MAX_LAG_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonParameters:
    """Every improvement on the paper's filters is a parameter, here or in the tracker's own: a benchmark ablates it."""

    profile: str = "default"
    """`paper`: its motion model (optical flow instead of the exact rotation), and no use of scores, box sizes, overlaps
    or a learned clutter rate."""
    measurement_sigma: float = 2.0
    """px, per axis, where a scan brings no R of its own: of a point, or of the smallest box. From frame to frame the
    shipped detector is ten times better, but only this much keeps tracks whose boxes stay beside the drone."""
    size_noise: float = 0.008
    """What comes to it for a larger box, as a share of its side: of the shipped detector, surely seen. Measured by
    `swarmtrack bench detection-noise`, as is the next one."""
    score_noise: float = 0.022
    """Likewise, times (1 − score) / score: of a box that is doubtful."""
    acceleration_psd: float = 10_000.0
    """px²/s³, continuous white noise: 3 m/s² for half a second at 10 m and f = 430 px."""
    p_detection: float = 0.9
    """That a target in view is detected in one scan."""
    p_survival: float = 0.99
    """That a target present now is still present in one second."""
    clutter_per_scan: float = 1.0
    """Expected false detections in one image; where `learn_clutter`, to begin with."""
    learn_clutter: bool = True
    """Follow the rate of false detections, within a factor of ten of the one told."""
    learn_noise: bool = True
    """Where detections lie further off than they should, take their noise for larger, by up to ten times R."""
    gate_probability: float = 0.999
    """That a true detection falls inside its target's gate."""
    birth_per_scan: float = 0.02
    """Expected new targets in one image."""
    birth_speed_sigma: float = 100.0
    """px/s, per axis, of a target just found."""
    birth_score: float = 0.55
    """A track is confirmed only with a detection of this score: what looks a little like a drone is followed, so that
    it tempts nobody, but not believed."""
    confirm_probability: float = 0.99
    """Existence above which a tentative track is confirmed."""
    max_coast_s: float = 1.0
    """s: a confirmed track is dropped when it has not been detected for so long."""
    score_weight: float = 1.0
    """How far a detection's score is believed: its clutter intensity is scaled by ((1 − s) / s) to this power."""
    size_sigma: float = 0.2
    """Relative, of a box's sides from scan to scan: of two drones in one place the size tells the nearer one."""
    occlusion: bool = True
    """Expect fewer detections of targets that overlap."""
    resolution_px: float = 0.0
    """Two points that are nearer may come back as one detection between them; boxes, also where they overlap by half
    or more."""
    lag_s: float = 0.0
    """s: how much later than its scan a smoothed estimate comes (`Tracker.smoothed`); 0: none does."""

    def __post_init__(self) -> None:
        if self.profile not in PROFILES:
            raise ValueError(
                f"tracker.profile: found {self.profile!r}, expected one of {', '.join(PROFILES)}"
            )
        above_zero = (
            "measurement_sigma", "acceleration_psd", "clutter_per_scan", "birth_per_scan", "birth_speed_sigma",
            "max_coast_s", "size_sigma",
        )  # fmt: skip
        for name in above_zero:
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(
                    f"tracker.{name}: found {getattr(self, name)!r}, expected a finite number above 0"
                )
        for name in ("p_detection", "p_survival", "gate_probability", "confirm_probability"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(
                    f"tracker.{name}: found {getattr(self, name)!r}, expected a probability between 0 and 1"
                )
        for name in ("size_noise", "score_noise"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"tracker.{name}: found {getattr(self, name)!r}, expected a share in 0…1")
        if not 0.0 <= self.resolution_px < math.inf:
            raise ValueError(
                f"tracker.resolution_px: found {self.resolution_px!r}, expected pixels, or 0 for points never merged"
            )
        if not 0.0 <= self.lag_s <= MAX_LAG_S:
            raise ValueError(f"tracker.lag_s: found {self.lag_s!r}, expected seconds in 0…{MAX_LAG_S:g}")
        if not math.isfinite(self.score_weight):
            raise ValueError(f"tracker.score_weight: found {self.score_weight!r}, expected a finite number")
        if not 0.0 <= self.birth_score <= 1.0:
            raise ValueError(f"tracker.birth_score: found {self.birth_score!r}, expected a score in 0…1")
