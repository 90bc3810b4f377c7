"""A drone keeps its colour everywhere: in annotated videos, in recordings and, lighter, on the monitor's dark page.

Okabe & Ito's colours (2008), told apart by all eyes, and a light grey.
"""

from __future__ import annotations

from swarmtrack.messages import FOREIGN, Identity

Rgb = tuple[int, int, int]
"""Red, green, blue, 0…255."""

DRONE_COLOURS: tuple[Rgb, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 158, 115),
    (240, 228, 66),
    (0, 114, 178),
    (213, 94, 0),
    (204, 121, 167),
    (213, 219, 224),
)
STRANGER_COLOUR: Rgb = (255, 60, 60)
UNKNOWN_COLOUR: Rgb = (200, 200, 200)


def colour_of(identity: Identity) -> Rgb:
    if identity is None:
        return UNKNOWN_COLOUR
    return STRANGER_COLOUR if identity == FOREIGN else DRONE_COLOURS[(identity - 1) % len(DRONE_COLOURS)]
