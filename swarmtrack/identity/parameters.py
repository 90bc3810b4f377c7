"""What decides when a track is assigned a drone's ID."""

from __future__ import annotations

from dataclasses import dataclass

IDENTITY_MODELS = ("matching", "joint")


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentityParameters:
    """Parameters of the identity model, and when it is certain enough."""

    profile: str = "default"
    """`paper`: Algorithm 1 as printed, in one shot. `default`: the posterior, which includes "unknown"."""
    model: str = "matching"
    """What names tracks in the profile `default`. `matching`: a matching of each scan, joined with motion. `joint`: one
    posterior of names, headings and starts, in trial ([joint.md](joint.md))."""
    probability: float = 0.95
    """An ID is stated only above this probability."""
    scans: int = 3
    """A track must have been seen in this many scans."""
    window_s: float = 0.5
    """Residuals are averaged over this time, s."""
    foreign_s: float = 3.0
    """A track that nothing explains is foreign after this time, s."""
    drift_speed: float = 0.5
    """Speed that an announced drone may have once it has left its announced pose, m/s."""
    stay_s: float = 30.0
    """Time after which half of the announced drones have left their pose, s. Drones wait for take-off."""
    turn_rate: float = 0.1
    """How far the bearing of an unseen drone may leave its course per second, rad/s."""

    def __post_init__(self) -> None:
        if self.profile not in ("default", "paper"):
            raise ValueError(f"identity.profile: found {self.profile!r}, expected one of default, paper")
        if self.model not in IDENTITY_MODELS:
            raise ValueError(
                f"identity.model: found {self.model!r}, expected one of {', '.join(IDENTITY_MODELS)}"
            )
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
