"""`swarmtrack sim --record`: beside what the agents record, what was heard of them, the truth, and the verdict."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from swarmtrack.clock import Clock
from swarmtrack.config.toml.layers import Table
from swarmtrack.errors import RecordingError
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.swarm_verdict import SwarmReport
from swarmtrack.lab.swarm.watch import HeldClock
from swarmtrack.lab.world.followed import FollowedDrone, ToldPose
from swarmtrack.lab.world.world import Drawn
from swarmtrack.recording.reader import FLIGHT_PLAN
from swarmtrack.transport.base import Sample

if TYPE_CHECKING:
    from swarmtrack.runtime.swarm_recorder import SwarmRecorder

RECORDED_TRUTH_HZ = 10.0
EVENTS_FILE = "events.json"


@dataclass(slots=True, eq=False)
class FlightRecording:
    """Does nothing where no recording is asked for. epoch: of world time, on `clock`; seconds: of the flight, as
    planned."""

    folder: Path | None
    scenario: Scenario
    clock: Clock
    team: str
    epoch: float
    seconds: float
    hearing: HeldClock = field(default_factory=HeldClock)
    """When the sample was heard that was handed over last."""
    _recorder: SwarmRecorder | None = None

    def begin(
        self, files: Table, *, drones: int | None, outside: bool, tracker: str, detector: str, detail: str
    ) -> None:
        """files: what the scenario's, or the world's, say; drones: how many were asked for; outside: others fly."""
        if self.folder is None:
            return
        from swarmtrack.recording.writer import Attachment
        from swarmtrack.runtime.swarm_recorder import SwarmRecorder

        plan = {
            "scenario": self.scenario.name,
            "files": files,
            "outside": outside,
            "seed": self.scenario.seed,
            "drones": drones,
            "seconds": self.seconds,
            "epoch_s": self.epoch,
            "tracker": tracker,
            "detector": detector,
            "detail": detail,
        }
        self._recorder = SwarmRecorder(self.clock, self.team)
        self._recorder.open(
            self.folder,
            bounds={"max_bytes": 10**12},  # a flight of minutes
            metadata={"scenario": self.scenario.name},
            attachments=[Attachment(FLIGHT_PLAN, "application/json", json.dumps(plan, default=str).encode())],
        )
        write_events(self.folder / EVENTS_FILE, self.scenario, self.epoch)

    async def tee(self, samples: AsyncIterator[Sample]) -> AsyncIterator[Sample]:
        """The same samples, each recorded before it is looked at."""
        async for sample in samples:
            now, utc = self.clock.now(), self.clock.utc()
            self.hearing.set(now, utc)
            if self._recorder is not None:
                self._recorder.record_sample(sample, now, utc)
            yield sample

    def flown(self, event: str, drone_id: int) -> None:
        """event: "started" or "ended", of an agent's process, by plan."""
        if self._recorder is not None:
            self._recorder.flown(event, drone_id)

    def told(self, drone_id: int, sample: ToldPose) -> None:
        """The truth about a drone that others fly, as it comes: nobody can compute it afterwards."""
        if self._recorder is not None:
            from swarmtrack.runtime.swarm_recorder import TruePose

            self._recorder.truth(self.epoch, TruePose(sample.t, drone_id, sample.pose))

    def end(self, report: SwarmReport, ended_at: float) -> None:
        """The truth about those that flew as planned, which would only have cost the agents time in flight, and the
        verdict. ended_at: world time [s]."""
        if self._recorder is None:
            return
        from swarmtrack.runtime.swarm_recorder import TruePose

        self._recorder.landed()
        for drone_id, drone in self.scenario.world.drones.items():
            # What was told is there already, and as it was told: the judge can then find the same between two samples.
            for sample in () if isinstance(drone, FollowedDrone) else self._planned(drone, ended_at):
                self._recorder.truth(self.epoch, TruePose(sample.t, drone_id, sample.pose))
        if not report.is_cut_off:
            self._recorder.verdict(report.as_record())
        self._recorder.close()

    def abandon(self) -> None:
        """The flight was cut short: what was heard and told is kept, and there is no verdict."""
        if self._recorder is not None:
            self._recorder.close()

    def _planned(self, drone: Drawn, ended_at: float) -> Iterator[ToldPose]:
        times = (k / RECORDED_TRUTH_HZ for k in range(int(ended_at * RECORDED_TRUTH_HZ) + 1))
        return (ToldPose(t, drone.pose(t)) for t in times)


def write_events(path: Path, scenario: Scenario, epoch: float) -> None:
    """What the drones are told and when, [[seconds on the machine's monotonic clock, words], …]; nothing: no file."""
    rows = [[round(epoch + event.t, 3), f"drone {event.drone_id} {event.words}"] for event in scenario.events]
    if rows:
        path.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def check_empty(folder: Path) -> None:
    """Raises RecordingError where other recordings would be taken for parts of this flight."""
    if folder.is_dir() and any(folder.rglob("*.mcap*")):
        raise RecordingError(f"--record {folder}: holds recordings already, expected a new or empty folder")
    if folder.exists() and not folder.is_dir():
        raise RecordingError(f"--record {folder}: is not a folder, expected a new or empty one")
