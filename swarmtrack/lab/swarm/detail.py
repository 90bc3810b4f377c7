"""How much of a flight is simulated, where a machine has no time for all of it.

The same drones fly the same paths and are called by the same names; pictures, gyro samples and tracks come more
rarely. `docs/swarm.md` has what that costs.
"""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from typing import NamedTuple

from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.swarm_verdict import Limits


class Detail(StrEnum):
    FULL = "full"
    REDUCED = "reduced"
    LOW = "low"

    def of(self, scenario: Scenario) -> Scenario:
        """The scenario with so much detail."""
        most = _MOST.get(self)
        if most is None:
            return scenario
        return replace(
            scenario,
            cameras=tuple(replace(camera, fps=min(camera.fps, most.fps)) for camera in scenario.cameras),
            imu_rate_hz=min(scenario.imu_rate_hz, most.imu_hz),
            tracks_hz=min(scenario.tracks_hz, most.tracks_hz),
        )

    def expected(self, scenario: Scenario, limits: Limits) -> Limits:
        """What is expected of it then, of `limits` for the whole scenario: tracks are carried on for longer, and to
        know each other drones need as many pictures as before."""
        times = scenario.fps / self.of(scenario).fps
        return replace(
            limits,
            rmse_px=limits.rmse_px * times,
            time_to_identify_s=limits.time_to_identify_s * times,
        )


class _Most(NamedTuple):
    """Rates at most, Hz."""

    fps: float
    imu_hz: float
    tracks_hz: float


_MOST = {
    Detail.REDUCED: _Most(fps=7.0, imu_hz=100.0, tracks_hz=25.0),
    Detail.LOW: _Most(fps=3.0, imu_hz=50.0, tracks_hz=20.0),
}
