"""A drone keeps its colour everywhere: in annotated videos, in recordings and, lighter, on the monitor's dark page.

Okabe & Ito's colours (2008), told apart by all eyes, and a light grey.
"""

from __future__ import annotations

COLOURS = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
    (213, 219, 224),
)


def colour_of(drone_id: int) -> tuple[int, int, int]:
    """Red, green, blue, 0…255."""
    return COLOURS[(drone_id - 1) % len(COLOURS)]
