"""What decides when a track is assigned a drone's ID."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentityParameters:
    """How tracks are named, and when a name is certain enough."""

    profile: str = "default"
    """`paper`: Algorithm 1 as printed, in one shot. `default`: one posterior of names, headings and starts, which
    includes "unknown"."""
    probability: float = 0.95
    """An ID is stated only above this probability."""
    foreign_s: float = 3.0
    """A track that nothing explains is foreign after this time, s."""

    def __post_init__(self) -> None:
        if self.profile not in ("default", "paper"):
            raise ValueError(f"identity.profile: found {self.profile!r}, expected one of default, paper")
        if not 0.5 <= self.probability < 1.0:
            raise ValueError(
                f"identity.probability: found {self.probability!r}, expected 0.5 or more, below 1"
            )
        if not self.foreign_s > 0.0:
            raise ValueError(f"identity.foreign_s: found {self.foreign_s!r}, expected a number above 0")
