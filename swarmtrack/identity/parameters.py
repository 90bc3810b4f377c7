"""What decides when a track is given a drone's ID."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentityParameters:
    """Beside the model itself, when it is sure enough."""

    profile: str = "default"
    """`paper`: Algorithm 1 as printed, in one shot; `default`: the posterior, with "unknown"."""
    probability: float = 0.95
    """An ID is stated only above it."""
    scans: int = 3
    """A track must have been seen in so many."""
    window_s: float = 0.5
    """s over which residuals are averaged."""
    foreign_s: float = 3.0
    """s after which a track that nothing explains is foreign."""
    drift_speed: float = 0.5
    """m/s: how fast an announced drone that has left its pose may be moving."""
    stay_s: float = 30.0
    """s after which half of the announced drones have left their pose: they wait for take-off."""
    turn_rate: float = 0.1
    """rad/s: how far the bearing of a drone out of sight may leave its course, for each second."""

    def __post_init__(self) -> None:
        if self.profile not in ("default", "paper"):
            raise ValueError(f"identity.profile: found {self.profile!r}, expected one of default, paper")
        if not 0.5 <= self.probability < 1.0:
            raise ValueError(
                f"identity.probability: found {self.probability!r}, expected 0.5 or more, below 1"
            )
        if self.scans < 1:
            raise ValueError(f"identity.scans: found {self.scans!r}, expected 1 or more")
        if not self.drift_speed >= 0.0:
            raise ValueError(f"identity.drift_speed: found {self.drift_speed!r}, expected 0 or more")
        for name in ("window_s", "foreign_s", "stay_s", "turn_rate"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"identity.{name}: found {getattr(self, name)!r}, expected a number above 0")
