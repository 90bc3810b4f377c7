"""Model of a detector's box widths around an airframe of known span, with their errors."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxWidth:
    """Width of the box = factor · width of the span [px] + padding_px. Sigmas are of the logarithm of that width.

    The default is a detector whose boxes are tight, with the errors of the shipped one on real drones.
    """

    factor: float = 1.14
    """The outline of a quadrotor over all yaws is 1.14 spans wide."""
    padding_px: float = 0.0
    """Fixed, both sides together: detectors draw as people do, who label loosely."""
    drone_sigma: float = 0.19
    """From drone to drone: aspect, model, light. It lasts."""
    wander_sigma: float = 0.13
    """Within one flight, over `wander_s`."""
    wander_s: float = 2.1
    white_sigma: float = 0.06
    """From frame to frame."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            low, high = BOX_WIDTH_BOUNDS[field.name]
            if not low <= value <= high:
                raise ValueError(
                    f"box_width.{field.name}: found {value!r}, expected a number from {low:g} to {high:g}"
                )


BOX_WIDTH_BOUNDS = {
    "factor": (0.2, 5.0),
    "padding_px": (-20.0, 100.0),
    "drone_sigma": (0.0, 1.0),
    "wander_sigma": (0.0, 1.0),
    "wander_s": (0.01, 60.0),
    "white_sigma": (0.001, 1.0),
}
"""Of each number, least and most."""
