"""A recording of a swarm as `swarmtrack record` makes it, of three drones that say what a test wants them to say."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from swarmtrack.clock import ManualClock
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Sighting, SightingReport
from swarmtrack.runtime.swarm_recorder import SwarmRecorder
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.fields import WIRE_VERSION
from swarmtrack.wire.lens import lens_message
from swarmtrack.wire.sightings import sightings_message
from swarmtrack.wire.tracks import TrackMessage, TracksMessage
from swarmtrack.wire.video import VideoMessage

TEAM = "red"
UTC = 1.8e9
PLACES = {1: np.array([0.0, 0.0, -2.0]), 2: np.array([8.0, 0.0, -2.0]), 3: np.array([0.0, 8.0, -2.0])}
CAMERA = PinholeCamera(400.0, 400.0, 320.0, 240.0, 640, 480)
SWAPPED = (10.0, 20.0)  # s: drone 2 calls 1 drone 3 and 3 drone 1
DEPARTED = 30.0  # s: drone 3 ends


def record_swarm(folder: Path, seconds: float = 40.0, *, tracks_hz: float = 5.0, video: bool = True) -> None:
    """Into folder/swarm; begins at UTC."""
    clock = ManualClock(100.0, UTC)
    recorder = SwarmRecorder(clock, TEAM)
    recorder.open(folder)

    def say(t: float, kind: Kind, drone: int, payload: bytes, *rest: str, alive: bool = True) -> None:
        clock.set(100.0 + t)
        sample = Sample(keys.key(TEAM, kind, drone, *rest), payload, alive, clock.now())
        recorder.record_sample(sample, clock.now(), clock.utc())

    for drone in PLACES:
        say(0.0, Kind.ALIVE, drone, b"", f"{drone:08x}")
    steps = int(seconds * tracks_hz)
    for k in range(1, steps + 1):
        t = k / tracks_hz
        for drone in PLACES:
            if drone == 3 and t >= DEPARTED:
                if t - DEPARTED < 1.0 / tracks_hz:
                    say(t, Kind.ALIVE, 3, b"", "00000003", alive=False)
                continue
            say(t, Kind.TRACKS, drone, _tracks(t, k))
            if video:
                say(t, Kind.VIDEO, drone, _view(t, k))
            if k % int(tracks_hz) == 0:
                say(t, Kind.IDENTITIES, drone, sightings(drone, t, k))
    recorder.close()


def sightings(observer: int, t: float, k: int) -> bytes:
    swapped = observer == 2 and SWAPPED[0] <= t < SWAPPED[1]
    names = {1: 3, 3: 1} if swapped else {}
    rays = {whom: place - PLACES[observer] for whom, place in PLACES.items() if whom != observer}
    report = SightingReport(
        observer,
        f"{observer:08x}",
        k,
        t - 0.05,
        0.0,
        PLACES[observer],
        0.1,
        (),
        tuple(Sighting(names.get(w, w), 0.99, ray / np.linalg.norm(ray), 0.01) for w, ray in rays.items()),
    )
    return codec.encode(sightings_message(report, UTC, t))


def _tracks(t: float, k: int) -> bytes:
    cov = (4.0, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 4.0, 0.0, 9.0)
    one = TrackMessage(1, 2, 0.99, 100.0 + 5.0 * t, 5.0, 200.0, 0.0, cov, 30.0, 20.0, "confirmed", 0.99, None)
    return codec.encode(TracksMessage(WIRE_VERSION, UTC + t, 0.05, k, 0.0, (one,)))


def _view(t: float, k: int) -> bytes:
    _, jpeg = cv2.imencode(".jpg", np.full((120, 160, 3), k % 256, np.uint8))
    lens = lens_message(CAMERA)
    return codec.encode(
        VideoMessage(WIRE_VERSION, UTC + t, 0.05, k, 160, 120, jpeg.tobytes(), lens, None, None)
    )
