"""What the monitor's page is told when a flight is over: its verdict, which stays there."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FlightEnd:
    """kind: of the light (bad, warn, ok); rows: what was judged, found, expected, and
    whether it falls short; again: how to see it once more."""

    kind: str
    text: str
    also: list[str]
    rows: list[tuple[str, str, str, bool]]
    again: str = ""
