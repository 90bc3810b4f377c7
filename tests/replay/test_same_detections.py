"""The agent, `swarmtrack import` and `swarmtrack replay --detect` see the same in the same frames."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import replace

import cv2
import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk has no wheel here")

from support.drone_on_the_bench import written
from swarmtrack.agents.import_flight import BEGIN_S, DETECTOR_S, import_flight
from swarmtrack.clock import ManualClock, SystemClock
from swarmtrack.config.drone import load_config
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.lab.world.sensors import Imu, ImuParameters
from swarmtrack.messages import Frame, LinkStatus, StampKind
from swarmtrack.outputs.console import Console
from swarmtrack.recording.reader import recordings_below
from swarmtrack.recording.settings import read_settings
from swarmtrack.replay.replayer import Replayer
from swarmtrack.runtime.agent import Agent
from swarmtrack.runtime.assembly import assemble
from swarmtrack.runtime.perception import make_detector

FRAMES, FPS, IMU_HZ = 24, 15.0, 200.0
FROM_S = 5.0  # of the scenario, where the swing is at its full


class Flight:
    """What drone 1 of a scenario sees and feels while it turns at up to 2 rad/s; pictures as JPEG keeps them."""

    def __init__(self) -> None:
        scenario = load_scenario("yawing-observer")
        self.scenario, self.jpegs, self.frames = scenario, {}, []
        renderer = Renderer(scenario.world, scenario.camera, scenario.body_from_camera)
        for k in range(FRAMES):
            drawn = renderer.image(1, FROM_S + k / FPS, k)
            jpeg = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
            image = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
            self.jpegs[image.tobytes()] = jpeg
            self.frames.append(Frame(BEGIN_S + k / FPS, 1e-3, k, image, StampKind.MEDIA))
        imu = Imu(scenario.world, 1, ImuParameters(rate_hz=IMU_HZ))
        first, count = int(IMU_HZ * FROM_S) - 20, 20 + int(IMU_HZ * (FRAMES + 2) / FPS)
        samples = map(imu.sample, range(first, first + count))
        self.samples = [replace(sample, t=BEGIN_S - FROM_S + sample.t) for sample in samples]


class Reel:
    """A camera that delivers a flight's frames, in order, `DETECTOR_S` after their exposure; `feel` is then told what
    the gyro measured until then."""

    def __init__(self, flight: Flight) -> None:
        self._flight = flight
        self.feel = lambda sample: None

    async def frames(self) -> AsyncIterator[Frame]:
        samples = iter(self._flight.samples)
        sample = next(samples)
        for frame in self._flight.frames:
            while sample.t <= frame.t + DETECTOR_S:
                self.feel(sample)
                sample = next(samples)
            yield frame

    def status(self) -> LinkStatus:
        return LinkStatus("camera", True, "a reel")

    async def close(self) -> None:
        pass


class Log:
    """An autopilot of a flight that is over."""

    def __init__(self, flight: Flight) -> None:
        self._flight = flight

    async def run(self, listener) -> None:
        for sample in self._flight.samples:
            listener.on_imu(sample)

    def status(self) -> LinkStatus:
        return LinkStatus("autopilot", True, "a log")


class Noted:
    """A detector of which every look is noted, and what it found."""

    def __init__(self, detector) -> None:
        self._detector = detector
        self.looks, self.found = [], []

    def __getattr__(self, name):
        return getattr(self._detector, name)

    def detect(self, look):
        found = self._detector.detect(look)
        self.looks.append(look)
        self.found.append(
            (found.t, found.sequence, found.coverage, *map(bytes, (found.centre, found.size, found.score)))
        )
        return found


@pytest.fixture(scope="module")
def flight():
    return Flight()


@pytest.fixture
def parts_of(flight, tmp_path, monkeypatch):
    """The parts of an agent that records into a folder."""
    encode = cv2.imencode

    def encode_again(kind, image, options):
        """A picture that was a JPEG is the same one: what a replay sees is what flew, to the bit."""
        jpeg = flight.jpegs.get(image.tobytes())
        return encode(kind, image, options) if jpeg is None else (True, jpeg)

    monkeypatch.setattr(cv2, "imencode", encode_again)
    c = flight.scenario.camera
    lens = f"fx = {c.fx}, fy = {c.fy}, cx = {c.cx}, cy = {c.cy}, width = {c.width}, height = {c.height}"
    assert c.distortion is None

    def parts(name: str):
        config = written(
            tmp_path / f"config of {name}",
            autopilot='link = "none"',
            detector='look = "guided"\nmotion = true',
            camera=f'source = "http://127.0.0.1:9/"\nmax_age_s = 60.0\nintrinsics = {{ {lens} }}',
            recording=f'dir = "{tmp_path / name}"\nframes = "jpeg"\nframes_hz = 1000.0',
        )
        clock = ManualClock(BEGIN_S, 1.8e9)
        made = assemble(load_config(config), SystemClock(), clock)
        return replace(made, detector=Noted(made.detector)), clock

    return parts


def fly(flight: Flight, parts) -> Noted:
    """Through a whole agent."""
    parts.camera = reel = Reel(flight)
    agent = Agent(parts, console=Console(parts.lens, quiet=True))
    reel.feel = agent.on_imu
    asyncio.run(agent.run())
    return parts.detector


def see_again(folder) -> Noted:
    """What replay --detect finds in a recording."""
    recording = recordings_below(folder)[0]
    settings, _ = read_settings(recording)
    detector = Noted(make_detector(settings.config, SystemClock()))
    Replayer(recording, settings, detector=detector).run()
    return detector


def test_agent_import_and_replay_detect_the_same_frame_by_frame(flight, parts_of, tmp_path):
    parts, _ = parts_of("flown")
    flown = fly(flight, parts)
    parts, clock = parts_of("imported")
    parts.camera, parts.autopilot = Reel(flight), Log(flight)
    assert asyncio.run(import_flight(parts, clock, 0.0)) == 0
    imported = parts.detector
    assert len(flown.found) == FRAMES
    assert imported.found == flown.found
    assert see_again(tmp_path / "flown").found == flown.found
    assert see_again(tmp_path / "imported").found == flown.found
    # And there was something to differ in: windows around tracks, and frames to compare with through a turn.
    assert sum(len(look.windows) > 1 for look in flown.looks) > FRAMES / 2
    compared = [look.comparison for look in flown.looks if look.comparison is not None]
    assert len(compared) > FRAMES / 2
    middle = np.array([[320.0, 256.0]])
    assert max(np.abs(each.pixels_then(middle) - middle).max() for each in compared) > 50.0
