"""`swarmtrack sim --record`: beside what the agents record, what was heard of them, the truth, and the verdict."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from swarmtrack.clock import Clock
from swarmtrack.errors import RecordingError
from swarmtrack.evaluation.swarm_verdict import SwarmReport
from swarmtrack.localswarm.watch import HeldClock
from swarmtrack.recording.reader import FLIGHT_PLAN
from swarmtrack.scenario_file import read_scenario
from swarmtrack.simulation.scenarios import Scenario
from swarmtrack.transport.base import Sample

if TYPE_CHECKING:
    from swarmtrack.runtime.swarm_recorder import SwarmRecorder

TRUTH_HZ = 10.0


@dataclass(slots=True, eq=False)
class FlightRecording:
    """Does nothing where no recording is asked for. epoch: of world time, on `clock`; seconds: of the flight."""

    folder: Path | None
    scenario: Scenario
    clock: Clock
    team: str
    epoch: float
    seconds: float
    hearing: HeldClock = field(default_factory=HeldClock)
    """When the sample was heard that was handed over last."""
    _recorder: SwarmRecorder | None = None

    def begin(self, source: str, drones: int | None, tracker: str, detector: str) -> None:
        """source: name or file of the scenario; drones: how many were asked for."""
        if self.folder is None:
            return
        from swarmtrack.recording.writer import Attachment
        from swarmtrack.runtime.swarm_recorder import SwarmRecorder

        plan = {
            "scenario": self.scenario.name,
            "files": read_scenario(source).table,
            "seed": self.scenario.seed,
            "drones": drones,
            "seconds": self.seconds,
            "epoch_s": self.epoch,
            "tracker": tracker,
            "detector": detector,
        }
        self._recorder = SwarmRecorder(self.clock, self.team)
        self._recorder.open(
            self.folder,
            bounds={"max_bytes": 10**12},  # a flight of minutes
            metadata={"scenario": self.scenario.name},
            attachments=[Attachment(FLIGHT_PLAN, "application/json", json.dumps(plan, default=str).encode())],
        )

    async def heard(self, samples: AsyncIterator[Sample]) -> AsyncIterator[Sample]:
        """The same samples, each recorded before it is looked at."""
        async for sample in samples:
            now, utc = self.clock.now(), self.clock.utc()
            self.hearing.set(now, utc)
            if self._recorder is not None:
                self._recorder.heard(sample, now, utc)
            yield sample

    def flown(self, event: str, drone_id: int) -> None:
        """event: "started" or "ended", of an agent's process, by plan."""
        if self._recorder is not None:
            self._recorder.flown(event, drone_id)

    def end(self, report: SwarmReport) -> None:
        """The truth, which would only have cost the agents time in flight, and the verdict."""
        if self._recorder is None:
            return
        from swarmtrack.runtime.swarm_recorder import TruePose

        self._recorder.landed()
        world = self.scenario.world
        for k in range(int(self.seconds * TRUTH_HZ) + 1):
            for drone_id in world.drones:
                t = k / TRUTH_HZ
                self._recorder.truth(self.epoch, TruePose(t, drone_id, world.pose(drone_id, t)))
        self._recorder.verdict(report.as_record())
        self._recorder.close()


def check_empty(folder: Path) -> None:
    """Raises RecordingError where other recordings would be taken for parts of this flight."""
    if folder.is_dir() and any(folder.rglob("*.mcap*")):
        raise RecordingError(f"--record {folder}: holds recordings already, expected a new or empty folder")
    if folder.exists() and not folder.is_dir():
        raise RecordingError(f"--record {folder}: is no folder, expected a new or empty one")
