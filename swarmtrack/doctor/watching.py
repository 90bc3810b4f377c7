"""Observation of a drone's cameras and autopilot for some seconds."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from swarmtrack.autopilot.address import is_recording
from swarmtrack.calibration.image_motion import ImageMotion
from swarmtrack.camera_sources.address import parse_address
from swarmtrack.clock import Clock
from swarmtrack.config.drone import CameraSection, DroneConfig, MountedCamera
from swarmtrack.diagnosis.mounting import MotionFacts
from swarmtrack.diagnosis.sources import AutopilotFacts, CameraFacts, ImuFacts, PoseFacts
from swarmtrack.doctor.limits import limits_reader
from swarmtrack.doctor.sample_collector import SampleCollector
from swarmtrack.errors import SwarmtrackError
from swarmtrack.messages import Frame, StampKind
from swarmtrack.motion.hand_eye import compare, solve
from swarmtrack.runtime.assembly import make_autopilot, make_camera
from swarmtrack.sources import Autopilot, Camera, DetectionSource, SimulatedSources

RECORDED_SOURCES = ("file", "images")
RATE_OVER = 2.0  # s: the last samples, by which a rate is told
LEAST_GYRO_SAMPLES = 50


class WatchedCamera(NamedTuple):
    """Facts on one camera. newest: its last frame."""

    facts: CameraFacts
    motion: MotionFacts
    newest: Frame | None


class WatchedSensors(NamedTuple):
    """Facts on all sensors. cameras: in the order of the config."""

    cameras: tuple[WatchedCamera, ...]
    autopilot: AutopilotFacts
    imu: ImuFacts
    pose: PoseFacts


class CameraWatch:
    """One camera of a config; it may be missing or broken."""

    def __init__(
        self,
        section: CameraSection,
        mounted: MountedCamera | None,
        clock: Clock,
        simulation: SimulatedSources | None,
    ) -> None:
        self._section = section
        self._mounted = mounted
        self._refused = ""
        self._camera: Camera | DetectionSource | None = None
        if mounted is not None:
            try:
                self._camera = make_camera(section, mounted, clock, simulation)
            except SwarmtrackError as error:
                self._refused = str(error)
        self.motion = None if mounted is None else ImageMotion(mounted.camera)
        self._frames = 0
        self._stamps: set[StampKind] = set()
        self._newest: Frame | None = None

    async def run(self, *, beside_gyro: bool) -> None:
        """Run until cancelled, or until a recording ends. beside_gyro: compare its motion with a gyro's."""
        if isinstance(self._camera, DetectionSource):
            async for _ in self._camera.detections():
                self._frames += 1
        elif self._camera is not None:
            async for frame in self._camera.frames():
                self._frames += 1
                self._stamps.add(frame.stamp)
                self._newest = frame
                if beside_gyro and self.motion is not None:
                    await asyncio.to_thread(self.motion.add_frame, frame.t, frame.image)

    async def close(self) -> None:
        if self._camera is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.5):
                    await self._camera.close()

    async def watched(self, seconds: float, heard: SampleCollector) -> WatchedCamera:
        """Facts after so many seconds, combined with the autopilot's."""
        section, frame = self._section, self._newest
        address = None if section.simulated else parse_address(section.source)
        facts = CameraFacts(
            seconds=seconds,
            max_age_s=section.max_age_s,
            status=None if self._camera is None else self._camera.status(),
            refused=self._refused,
            asked_hz=_asked_hz(section.source) if address and address.scheme == "v4l2" else None,
            frames=self._frames,
            size=None if frame is None else (frame.image.shape[1], frame.image.shape[0]),
            stamps=frozenset(self._stamps),
            shade=None if frame is None else _shade(frame),
            live=address is None or address.scheme not in RECORDED_SOURCES,
            kind="" if address is None else address.scheme,
        )
        return WatchedCamera(facts, await asyncio.to_thread(self._compared, heard), frame)

    def _compared(self, heard: SampleCollector) -> MotionFacts:
        """Image against gyro."""
        if self.motion is None or self._mounted is None:
            return MotionFacts("without a calibration the image gives no angles")
        if len(heard.samples) < LEAST_GYRO_SAMPLES:
            return MotionFacts("no gyro")
        if not self.motion.found:
            return MotionFacts("nothing in the picture could be followed" if self._frames else "no frames")
        turns, gyro = self.motion.turns(), heard.gyro()
        agreement = compare(
            turns,
            gyro,
            self._mounted.body_from_camera.rotation.T,
            reach=0.2,
            centre=self._mounted.time_offset_s,
        )
        if agreement is None:
            return MotionFacts("too few frames with the gyro around them")
        found = solve(turns, gyro, reach=0.2, centre=self._mounted.time_offset_s)
        return MotionFacts("", agreement, found)


class SensorWatch:
    """Cameras and autopilot of a config, opened together; any may be missing or broken."""

    def __init__(
        self,
        config: DroneConfig,
        mounted: Sequence[MountedCamera | None],
        clock: Clock,
        simulation: SimulatedSources | None = None,
    ) -> None:
        """mounted: of each camera of the config; None where it is not known."""
        self._config = config
        self._cameras = [
            CameraWatch(section, one, clock, simulation)
            for section, one in zip(config.cameras, mounted, strict=True)
        ]
        self._autopilot_refused = ""
        self._autopilot: Autopilot | None = None
        try:
            self._autopilot = make_autopilot(config, clock, simulation)
        except SwarmtrackError as error:
            self._autopilot_refused = str(error)
        self.heard = SampleCollector()
        self.limits = limits_reader(config, self._autopilot)
        """Of the autopilot, where the agent may fly the drone."""

    def motion(self, camera: int) -> ImageMotion | None:
        """Rotation of a camera's images so far."""
        return self._cameras[camera].motion

    async def run(self, seconds: float) -> WatchedSensors:
        """Observe for so long, or until recordings end."""
        beside_gyro = self._autopilot is not None
        tasks = [asyncio.create_task(camera.run(beside_gyro=beside_gyro)) for camera in self._cameras]
        tasks.append(asyncio.create_task(self._listen()))
        try:
            # A recording's end ends neither the other sources nor, by itself, the look at it.
            await asyncio.wait(tasks, timeout=seconds)
            return await self._facts(seconds)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.gather(*(camera.close() for camera in self._cameras))

    async def _listen(self) -> None:
        if self._autopilot is not None:
            await self._autopilot.run(self.heard)

    async def _facts(self, seconds: float) -> WatchedSensors:
        heard = self.heard
        link = self._config.autopilot.link
        autopilot = AutopilotFacts(
            seconds=seconds,
            wanted=link != "none",
            status=None if self._autopilot is None else self._autopilot.status(),
            refused=self._autopilot_refused,
            live=not is_recording(link),
            got_hz=_rate([sample.t for sample in heard.samples]),
        )
        imu = ImuFacts(
            np.array([sample.gyro for sample in heard.samples]).reshape(-1, 3),
            np.array([sample.accel for sample in heard.samples]).reshape(-1, 3),
            np.array([pose.t for pose in heard.poses]),
            np.array([pose.world_from_body for pose in heard.poses]).reshape(-1, 3, 3),
        )
        cameras = [await camera.watched(seconds, heard) for camera in self._cameras]
        return WatchedSensors(tuple(cameras), autopilot, imu, self._pose_facts())

    def _pose_facts(self) -> PoseFacts:
        heading = self._config.autopilot.heading_sigma_deg
        last = next((pose for pose in reversed(self.heard.poses) if pose.position is not None), None)
        start = self._config.drone.start
        known = PoseFacts(
            heading.ground,
            heading.flight,
            unmeasured_m=start.position_sigma_m if start.has_unknown_sigma else None,
        )
        if last is None:
            return known
        return replace(known, position_sigma=last.position_sigma, vertical_sigma=last.vertical_sigma)


def _asked_hz(source: str) -> float | None:
    for key, value in parse_address(source).query:
        if key == "fps":
            with contextlib.suppress(ValueError):
                return float(value)
    return None


def _rate(times: list[float]) -> float | None:
    """Hz over the last RATE_OVER s; None before there are two."""
    recent = [t for t in times if t > times[-1] - RATE_OVER]
    if len(recent) < 2:
        return None
    span = recent[-1] - recent[0]
    return (len(recent) - 1) / span if span > 0.0 else None


def _shade(frame: Frame) -> tuple[float, float]:
    mean, spread = cv2.meanStdDev(frame.image)
    return float(np.mean(mean)), float(np.mean(spread))
