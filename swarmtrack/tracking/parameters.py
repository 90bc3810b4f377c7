"""Common parameters of all trackers about the sensor and the targets. Each tracker has more of its own."""

from __future__ import annotations

import math
from dataclasses import dataclass

from swarmtrack.tracking.priors import MAX_LAG_S

PROFILES = ("default", "paper")
NOISE_LEARNING = ("no", "upwards", "both")


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonParameters:
    """Every improvement on the paper's filters is a parameter, here or in the tracker's own: a benchmark ablates it."""

    profile: str = "default"
    """`paper`: the paper's motion model (optical flow instead of the exact rotation), without scores, box sizes,
    overlaps or a learned clutter rate."""
    measurement_sigma: float = 2.0
    """px per axis, for scans without an R of their own: of a point, or of the smallest box. From frame to frame the
    shipped detector is ten times better, but a box can stay off the drone for several frames. This value keeps such
    tracks."""
    size_noise: float = 0.008
    """Added for a larger box, as a share of its side. Holds for the shipped detector at high scores. This value and
    the next one are measured by `swarmtrack bench detection-noise`."""
    score_noise: float = 0.022
    """Likewise, times (1 − score) / score: added for a doubtful box."""
    acceleration_psd: float = 10_000.0
    """px²/s³, continuous white noise. The default is 3 m/s² for half a second at 10 m and f = 430 px."""
    p_detection: float = 0.9
    """Probability that a target in view is detected in one scan."""
    p_survival: float = 0.99
    """Probability that a target present now is still present in one second."""
    clutter_per_scan: float = 1.0
    """Expected false detections per image. With `learn_clutter` it is the initial value."""
    learn_clutter: bool = True
    """Learn the rate of false detections, within a factor of ten of `clutter_per_scan`."""
    learn_noise: str = "upwards"
    """`both`: learn from the innovations how much detections scatter per class of box sizes, and how calmly targets
    fly (`tracking/noise.py`). `upwards`: only where detections scatter more than they should, up to ten times R.
    `no`: it is as configured."""
    gate_probability: float = 0.999
    """Probability that a true detection falls inside its target's gate."""
    birth_per_scan: float = 0.02
    """Expected new targets per image."""
    birth_speed_sigma: float = 100.0
    """px/s per axis, of a target just found."""
    birth_score: float = 0.45
    """A track is confirmed only if the scores of its last three seconds, by looks alone, are on average at least this,
    and surely so: the fewer looks, the higher they must be. Weaker look-alikes are followed, so that their detections
    do not disturb other tracks, but they are not reported as drones, unless a teammate should be there."""
    confirm_probability: float = 0.99
    """Existence above which a tentative track is confirmed."""
    max_coast_s: float = 1.0
    """A confirmed track is dropped after so many seconds without a detection, and only once its existence is below a
    tenth: at 3 Hz that takes four misses. After three times as many seconds it is dropped anyway. `mbm`: time in which
    another hides it counts up to three times less."""
    score_weight: float = 1.0
    """How much a detection's score s counts: its clutter intensity is scaled by ((1 − s) / s) to this power."""
    size_sigma: float = 0.2
    """Relative noise of a box's sides from scan to scan. Size separates two drones in the same direction."""
    occlusion: bool = True
    """Expect fewer detections of targets that overlap."""
    resolution_px: float = 0.0
    """Two points nearer than this may come back as one detection between them, in px. Boxes may also do so where they
    overlap by half or more."""
    lag_s: float = 0.0
    """Delay of the smoothed estimates behind their scan, s (`Tracker.smoothed`). 0 turns them off."""

    @property
    def has_calm_model(self) -> bool:
        """Whether the noise of calm flight can be learned, because another model is there for manoeuvres."""
        return False

    def __post_init__(self) -> None:
        for name, known in (("profile", PROFILES), ("learn_noise", NOISE_LEARNING)):
            if getattr(self, name) not in known:
                raise ValueError(
                    f"tracker.{name}: found {getattr(self, name)!r}, expected one of {', '.join(known)}"
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
