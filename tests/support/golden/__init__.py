"""What swarmtrack computes, kept: recorded flights replayed, benchmark tables, wire bytes, help texts.

`python tests/golden` compares a checkout with what is kept there, and says what moved and by how much. A change that
moves something on purpose runs `python tests/golden --accept` and says so in its commit.

Each part is a function without arguments that computes a dictionary of results, and one that compares two of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from support.places import ROOT

FOLDER = ROOT / "tests" / "golden"


class Moved(NamedTuple):
    """One result that is not as it was. beyond_rounding: more than the last bits of another processor."""

    name: str
    how: str
    beyond_rounding: bool = True


class Part(NamedTuple):
    """A kind of results. compute: all of them by name; load, save: as kept; compare: what moved, kept against new.

    What is kept and cannot be computed here, because its input is absent, is left out of the comparison.
    """

    compute: Callable[[], dict[str, Any]]
    load: Callable[[], dict[str, Any]]
    save: Callable[[dict[str, Any]], None]
    compare: Callable[[str, Any, Any], list[Moved]]
    absent: Callable[[], set[str]] = set


def differences(part: Part) -> list[Moved]:
    """What moved in a part, nothing where it is as it was."""
    kept, found, absent = part.load(), part.compute(), part.absent()
    moved = [Moved(name, "is new: not kept yet") for name in found if name not in kept]
    moved += [
        Moved(name, "is kept, but no longer there")
        for name in kept
        if name not in found and name not in absent
    ]
    for name in kept.keys() & found.keys():
        moved += part.compare(name, kept[name], found[name])
    return sorted(moved)
