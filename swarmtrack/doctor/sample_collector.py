"""Collector of an autopilot's samples for later analysis."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from swarmtrack.messages import EgoPose, FlightState, ImuSample, RemoteIdClaim
from swarmtrack.motion.hand_eye import GyroTurns
from swarmtrack.sources import AutopilotListener

MOST_SAMPLES = 400_000


@dataclass
class SampleCollector(AutopilotListener):
    """An autopilot's listener that keeps all samples."""

    samples: list[ImuSample] = field(default_factory=list)
    poses: list[EgoPose] = field(default_factory=list)

    def on_imu(self, sample: ImuSample) -> None:
        if len(self.samples) < MOST_SAMPLES:
            self.samples.append(sample)

    def on_pose(self, pose: EgoPose) -> None:
        if len(self.poses) < MOST_SAMPLES:
            self.poses.append(pose)

    def on_autopilot_reboot(self) -> None:
        """Drop earlier samples: the autopilot's clock has restarted."""
        self.samples.clear()
        self.poses.clear()

    def on_flight_state(self, state: FlightState) -> None:
        """Ignored."""

    def on_found_flying(self) -> None:
        """Ignored."""

    def on_remote_id(self, claim: RemoteIdClaim) -> None:
        """Ignored."""

    def on_switch(self, t: float) -> None:
        """Ignored."""

    def gyro(self) -> GyroTurns:
        """Samples so far. Any thread may call while more come in."""
        samples = self.samples.copy()
        return GyroTurns(
            np.array([sample.t for sample in samples]),
            np.array([sample.gyro for sample in samples]).reshape(-1, 3),
        )
