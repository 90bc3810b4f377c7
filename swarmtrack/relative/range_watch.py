"""Whether a ranging radio's distances fit what is seen: said once when they do not, and once when they do again."""

from __future__ import annotations

from typing import NamedTuple

from swarmtrack.messages import RangeReport
from swarmtrack.relative.priors import RANGES_IN_A_ROW, RANGES_IN_A_ROW_S


class RangeNews(NamedTuple):
    """The radio's ranges to a teammate do not fit: distance m, the last; None: they do again."""

    t: float
    drone_id: int
    distance: float | None


class _Run(NamedTuple):
    """Since when, and how many times in a row."""

    believed: bool
    since: float
    times: int


class RangeWatch:
    """Takes every measured range to a teammate in view, and whether it was accepted."""

    def __init__(self) -> None:
        self._runs: dict[int, _Run] = {}
        self._told: set[int] = set()

    def add_range(self, said: RangeReport, *, believed: bool) -> RangeNews | None:
        """Add a range; returns news, if any."""
        run = self._runs.get(said.other)
        if run is None or run.believed != believed:
            run = _Run(believed, said.t, 0)
        run = self._runs[said.other] = run._replace(times=run.times + 1)
        if (
            run.times < RANGES_IN_A_ROW
            or said.t - run.since < RANGES_IN_A_ROW_S
            or (said.other in self._told) != believed
        ):
            return None
        if believed:
            self._told.discard(said.other)
            return RangeNews(said.t, said.other, None)
        self._told.add(said.other)
        return RangeNews(said.t, said.other, said.distance)
