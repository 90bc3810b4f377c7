"""A recording of a drone with two cameras, made by the recorder of an agent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.config.drone import load_config, mount_camera
from swarmtrack.geometry.pose import Pose
from swarmtrack.messages import (
    Announcement,
    Array,
    Detections,
    EgoPose,
    Frame,
    SightingReport,
    StampKind,
)
from swarmtrack.recording.reader import Recording, recordings_below
from swarmtrack.recording.settings import FlightSettings
from swarmtrack.runtime.door import Door
from swarmtrack.runtime.flight_recorder import FlightRecorder
from swarmtrack.runtime.perception import make_onboard

NUMBERS = "{ fx = 300.0, fy = 300.0, cx = 159.5, cy = 119.5, width = 320, height = 240 }"


SOURCES = ("detections://127.0.0.1:9/0", "detections://127.0.0.1:9/1")


def settings_of(folder: Path, *cameras: str, sources: Sequence[str] = SOURCES) -> FlightSettings:
    path = folder / "drone.toml"
    tables = "".join(
        f'[[camera]]\nsource = "{source}"\nintrinsics = {NUMBERS}\n{more}'
        for source, more in zip(sources, cameras, strict=False)
    )
    path.write_text(
        f'drone.id = 3\nnetwork.transport = "memory"\n[recording]\ndir = "{folder}/rec"\nframes = "jpeg"\n{tables}'
    )
    config = load_config(path)
    return FlightSettings(config, tuple(map(mount_camera, config.cameras)), None)


TURNED = (
    "body_from_camera = { rpy_deg = [0.0, 0.0, 90.0], position_m = [0.0, 0.1, 0.0] }\ntime_offset_s = 0.01\n"
)


def recorded(folder: Path, *, teammate: Array | None = None) -> Recording:
    """A second of two cameras, of which either sees one target. teammate: where drone 5 says it stands, of one that
    stands in the team's origin and looks north."""
    start = None if teammate is None else Pose.identity()
    settings = settings_of(folder, "", TURNED)
    settings = FlightSettings(settings.config, settings.cameras, start)
    clock = ManualClock(100.0, 1.8e9)
    recorder = FlightRecorder(settings, "0123abcd", clock, SystemClock(), waits=True)
    recorder.open()
    door = Door(make_onboard(settings.config, settings.cameras, start))
    door.listener = recorder
    one = np.ones((1, 2))
    for k in range(30):
        camera, t = k % 2, 100.0 + k / 30.0
        clock.set(t)
        if teammate is not None:
            door.tell(EgoPose(t, np.zeros(3), np.eye(3), 0.01, 0.001))
            if not k:
                door.tell(Announcement(5, "00000005", 1, t, 0.0, teammate, np.eye(3), 1e-4 * np.eye(3)))
            door.tell(SightingReport(5, "00000005", k, t, 0.0, teammate, 0.01, (), ()))
        picture = np.full((240, 320), 40 + 60 * camera, np.uint8)
        recorder.frame(Frame(t, 0.0, k // 2, picture, StampKind.EXPOSURE, camera))
        centre = np.array([[100.0 + 50.0 * camera, 120.0]])
        door.tell(Detections(t, k // 2, centre, 12.0 * one, np.array([0.95]), camera=camera))
        door.events()
        door.tracks(t)
    recorder.close()
    (recording,) = recordings_below(folder / "rec")
    return recording
