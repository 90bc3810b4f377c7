"""What a scan shows of identities, besides the names."""

from __future__ import annotations

from typing import NamedTuple


class Astray(NamedTuple):
    """A drone that is a track by its motion, miss_m [m] from where it says that it is; None: the track, which had its
    name, does not move as it says, and is no teammate."""

    drone_id: int
    track_id: int
    miss_m: float | None


class IdentityNews(NamedTuple):
    """vouched: the tracks that are a teammate although they look weak; astray: the drones that motion finds elsewhere
    than they report; wanted: those that should announce their pose again."""

    vouched: tuple[int, ...]
    astray: tuple[Astray, ...]
    wanted: tuple[int, ...]


NO_NEWS = IdentityNews((), (), ())
