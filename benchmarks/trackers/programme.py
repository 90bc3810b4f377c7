"""What `swarmtrack bench trackers` is asked to do, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from swarmtrack.benchmarks.report import BenchmarkError
from swarmtrack.benchmarks.trackers.play import ORACLES, SMOOTHER, Score
from swarmtrack.benchmarks.trackers.results import Row
from swarmtrack.benchmarks.trackers.scenes import SCENES, find_scene
from swarmtrack.benchmarks.trackers.timing import Cost, Enumeration
from swarmtrack.tracking import TRACKERS

QUICK_RUNS = 2
QUICK_SCENES = (
    "control", "clutter10", "noise.75", "pd.80", "crossing", "crossing_merged", "slow", "slow_merged", "births",
    "rotating_still", "rotating", "latency_steady", "latency_manoeuvring", "told_wrong_R_x4_noise.50",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Programme:
    """What to run. runs: in place of each scene's own; jobs: processes."""

    trackers: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    runs: int | None = None
    quick: bool = False
    peers: bool = False
    jobs: int = 1

    def __post_init__(self) -> None:
        for name in self.scenes:
            find_scene(name)
        known = [*TRACKERS, *ORACLES, SMOOTHER]
        for name in self.trackers:
            if name not in known:
                raise BenchmarkError(f"--tracker: found {name!r}, expected one of {', '.join(known)}")
        for name, value in (("runs", self.runs), ("jobs", self.jobs)):
            if value is not None and value < 1:
                raise BenchmarkError(f"--{name}: found {value}, expected a number above 0")

    @property
    def entrants(self) -> tuple[str, ...]:
        """The trackers asked for, else all; the oracles stand beside them in any case."""
        chosen = self.trackers or tuple(TRACKERS)
        limits = [name for name in (*ORACLES, SMOOTHER) if name not in chosen]
        return (*chosen, *limits)

    @property
    def own(self) -> tuple[str, ...]:
        return tuple(name for name in self.entrants if name in TRACKERS)

    def scenes_to_play(self) -> tuple[str, ...]:
        return self.scenes or (QUICK_SCENES if self.quick else tuple(SCENES))

    def runs_of(self, scene: str) -> int:
        return self.runs or (QUICK_RUNS if self.quick else SCENES[scene].runs)


Played = dict[tuple[str, str], list[Score]]
"""By scene and label, in the order of the runs."""


class Result(NamedTuple):
    """Everything that the page is made of."""

    programme: Programme
    rows: list[Row]
    played: Played
    ablation: list[Row]
    costs: list[Cost]
    enumeration: Enumeration | None
    reference_ms: float
    late_difference: dict[str, float]
    """By tracker: how much reading `at(now)` between scans changes the state at the scans."""
    wall_s: float
