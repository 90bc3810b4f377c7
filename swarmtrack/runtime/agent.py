"""The agent of one drone: the tasks that feed Onboard and carry off what it says."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING

from swarmtrack.clock import UTC_SIGMA, ManualClock, SystemClock
from swarmtrack.detection.expectation import OnboardExpectation
from swarmtrack.messages import (
    AutopilotRebooted,
    Detections,
    EgoPose,
    ImuSample,
)
from swarmtrack.runtime.assembly import Parts
from swarmtrack.runtime.console import Console
from swarmtrack.runtime.health import LAG_PERIOD, PERIOD, Health
from swarmtrack.runtime.health_file import HealthFile, health_path
from swarmtrack.runtime.live_video import LiveVideo
from swarmtrack.runtime.outputs import JsonLines, as_seen
from swarmtrack.runtime.systemd import Notifier
from swarmtrack.runtime.teamwork import Teamwork
from swarmtrack.runtime.telling import Teller
from swarmtrack.sensors.base import Camera, DetectionSource
from swarmtrack.sensors.mavlink.notices import Severity
from swarmtrack.transport.base import Kind
from swarmtrack.wire import codec
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.records import as_record
from swarmtrack.wire.tracks import tracks_message

if TYPE_CHECKING:
    from swarmtrack.detection.detector import Detector
    from swarmtrack.runtime.annotated_video import AnnotatedVideo

log = logging.getLogger(__name__)

CLOSE_TIMEOUT = 1.5  # s for everything together
STUCK_DETECTOR = 10.0  # s on one frame: no longer slow but stuck, and the supervisor should know


class Agent:
    """Runs until stopped, or until a recording ends."""

    def __init__(self, parts: Parts, *, console: Console) -> None:
        self.health = Health(parts)
        self._teller = Teller(parts)
        self._team = Teamwork(parts, self.health, self._teller)
        self._parts = parts
        self._console = console
        self._notifier = Notifier()
        self._wall = SystemClock()  # of durations, also where the parts' own clock is paced by the frames
        output = parts.config.output
        with parts.config.blamed("output"):
            self._jsonl = JsonLines(output.jsonl) if output.jsonl else None
            self._video = _open_video(parts)
        health_file = health_path(output.health)
        self._health_file = HealthFile(health_file) if health_file else None
        self._live = LiveVideo(parts, self.health)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="detector")
        self._stop = asyncio.Event()
        self._fresh = asyncio.Event()
        self._detecting_since: float | None = None
        self._scanned_at: float | None = None
        self._tracked_at: float | None = None
        self._all_stale = False
        self._sequence = 0

    def stop(self) -> None:
        """Ask for a clean end."""
        self._stop.set()

    async def run(self, seconds: float | None = None) -> None:
        """Run all tasks; if a bug kills one, all stop and its exception comes out. seconds: stop after so long."""
        parts = self._parts
        # The first job of the detector's thread: the team hears of us meanwhile, the first frame waits for it.
        warm = self._worker.submit(self._warm_up)
        try:
            self._begin_recording()
            await parts.transport.open()
            async with asyncio.TaskGroup() as tasks:
                camera = tasks.create_task(self._feed_camera(warm), name="camera")
                others = [
                    tasks.create_task(self._feed_autopilot(), name="autopilot"),
                    tasks.create_task(self._team.listen(), name="peers"),
                    tasks.create_task(self._team.announce(), name="announce"),
                    tasks.create_task(self._team.report(), name="identities"),
                    tasks.create_task(self._publish_tracks(warm), name="tracks"),
                    tasks.create_task(self._publish_health(), name="health"),
                    tasks.create_task(self._feel_lag(), name="lag"),
                    tasks.create_task(self._teller.run(), name="tell"),
                ]
                stop = tasks.create_task(self._stop.wait(), name="stop")
                await asyncio.wait({camera, stop}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
                for task in (camera, stop, *others):
                    task.cancel()
        finally:
            self._notifier.stopping()
            await self._close()

    def _begin_recording(self) -> None:
        recorder = self._parts.recorder
        if recorder is not None:
            with self._parts.config.blamed("recording", "dir"):
                recorder.open()
            self._parts.door.listener = recorder

    async def _feed_autopilot(self) -> None:
        if self._parts.autopilot is not None:
            await self._parts.autopilot.run(self)

    def on_imu(self, sample: ImuSample) -> None:
        """From the autopilot, on the event loop."""
        self.health.imu.tick()
        self._parts.door.tell(sample)
        self._report()  # a scan may have waited for this very sample

    def on_pose(self, pose: EgoPose) -> None:
        """From the autopilot, on the event loop."""
        self._parts.door.tell(pose)
        if pose.position is not None:
            self._team.on_position()

    def on_autopilot_reboot(self) -> None:
        """From the autopilot, on the event loop."""
        self._parts.door.tell(AutopilotRebooted())

    def on_found_flying(self) -> None:
        """From the autopilot, on the event loop."""
        if self._parts.start is not None:
            line = (
                'in the air already, but announced at its fixed drone.start: expected from = "local" or "gps"'
            )
            self.health.events.append(line)
            self._teller.add(Severity.WARNING, "in the air, start not known")
            log.warning("drone %d is %s", self._parts.config.drone.id, line)

    def _warm_up(self) -> None:
        if self._parts.detector is not None:
            self._parts.detector.warm_up(self._parts.lens.width, self._parts.lens.height)

    async def _feed_camera(self, warm: Future[None]) -> None:
        """Everything that was detected into Onboard; returns where a recording ends."""
        parts = self._parts
        await asyncio.wrap_future(warm)
        async for detections in self._detections():
            self._scanned_at = self._wall.now()
            parts.door.tell(detections)
            self._report()
            if self._video:
                await self._video.drain()
        # Nothing more will come: what still waits for a gyro sample is tracked now.
        parts.door.tracks(parts.clock.now() + 1.0)
        self._report()

    def _detections(self) -> AsyncIterator[Detections]:
        """From a source that detects by itself, or from a camera and our detector."""
        camera, detector = self._parts.camera, self._parts.detector
        if isinstance(camera, DetectionSource):
            return self._receive(camera)
        assert detector is not None
        return self._detect(camera, detector)

    async def _receive(self, source: DetectionSource) -> AsyncIterator[Detections]:
        async for detections in source.detections():
            if self._is_fresh(detections.t):
                self._live.offer(detections.t, detections.sequence, None)
                yield detections

    async def _detect(self, camera: Camera, detector: Detector) -> AsyncIterator[Detections]:
        """Every frame through the detector, in its thread."""
        clock, loop = self._parts.clock, asyncio.get_running_loop()
        expectation = OnboardExpectation(self._parts.onboard)
        async for frame in camera.frames():
            if isinstance(clock, ManualClock):
                clock.set(frame.t)
            if not self._is_fresh(frame.t):
                continue
            if self._parts.recorder:
                self._parts.recorder.frame(frame)
            self._live.offer(frame.t, frame.sequence, frame.image)
            began = self._detecting_since = self._wall.now()
            look = detector.plan(frame, expectation)
            detections = await loop.run_in_executor(self._worker, detector.look, look)
            self._detecting_since = None
            self.health.detector.add(self._wall.now() - began)
            if detections is None:
                continue
            if self._video:
                self._video.keep(frame)
            yield detections

    def _is_fresh(self, exposed: float) -> bool:
        """Whether what was exposed then is young enough to be used now; what is not is counted."""
        age, limit = self._parts.clock.now() - exposed, self._parts.config.camera.max_age_s
        if age <= limit:
            self.health.exposure_to_detector.add(age)
            self._all_stale = False
            return True
        self.health.drops["stale_frames"] += 1
        if not self._all_stale:
            log.warning("camera: skipped what is %.2f s old, expected camera.max_age_s = %g", age, limit)
        self._all_stale = True
        return False

    def _report(self) -> None:
        """Hand the finished scans to whoever writes or shows them, and wake the publisher."""
        for report in self._parts.door.take_reports():
            self.health.scans.tick()
            self._tracked_at = self._wall.now()
            self._console.see(report)
            self._teller.see(report)
            written = self._jsonl or self._video
            seen = as_seen(report, self._parts.lens) if written else []
            if self._jsonl:
                self._jsonl.write(report, seen)
                self.health.drops["jsonl_lines"] = self._jsonl.failed
            if self._video:
                self._video.write(report, seen)
                self.health.drops["video_frames"] = self._video.dropped
            self._fresh.set()

    async def _publish_tracks(self, warm: Future[None]) -> None:
        """At `tracks_hz`, and at once when a scan was tracked."""
        await asyncio.wrap_future(warm)
        self._notifier.ready()
        period = 1.0 / self._parts.config.output.tracks_hz
        due = self._wall.now() + period
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(due - self._wall.now()):
                    await self._fresh.wait()
            now = self._wall.now()
            due = now + period if self._fresh.is_set() else max(due + period, now)
            self._fresh.clear()
            self._publish_once()

    def _publish_once(self) -> None:
        parts, now = self._parts, self._parts.clock.now()
        tracks = parts.door.tracks(now)
        self._sequence += 1
        message = tracks_message(tracks, self._sequence, parts.clock.utc() - now, UTC_SIGMA)
        try:
            parts.transport.publish(Kind.TRACKS, codec.encode(message))
            self.health.published.tick()
        except ValueError:  # what no reader would accept is not sent, and must not end the flight
            self.health.drops["unsendable_tracks"] += 1
        if self._scanned_at is not None:
            self.health.detections_to_published.add(self._wall.now() - self._scanned_at)
            self._scanned_at = None
        if self._detecting_since is None or self._wall.now() - self._detecting_since < STUCK_DETECTOR:
            self._notifier.alive()

    async def _feel_lag(self) -> None:
        """How late the event loop comes to what is due, in a task that waits for nothing else."""
        while True:
            due = self._wall.now() + LAG_PERIOD
            await asyncio.sleep(LAG_PERIOD)
            self.health.loop_lag.add(self._wall.now() - due)

    async def _publish_health(self) -> None:
        self.health.message()  # starts the meters
        while True:
            await asyncio.sleep(PERIOD)
            self._tell_of_recording()
            self.health.drops["status_texts_untold"] = self._teller.lines.untold
            message = self.health.message()
            if self._parts.recorder:
                self._parts.recorder.health(message)
            self._teller.see_links(message.links)
            try:
                self._parts.transport.publish(Kind.HEALTH, codec.encode(message))
            except ValueError:
                self.health.drops["unsendable_health"] += 1
            self._write_health(message)
            self._console.line(self._footnotes())
            assert message.readiness is not None
            self._notifier.status("; ".join(message.readiness.reasons) or "ready")

    def _tell_of_recording(self) -> None:
        news = self._parts.recorder.take_news() if self._parts.recorder else None
        if news is not None:
            self.health.events.append(news)
            log.warning(news)

    def _write_health(self, message: HealthMessage) -> None:
        if self._health_file is None:
            return
        now = self._wall.now()
        age = None if self._tracked_at is None else now - self._tracked_at
        self._health_file.write(
            as_record(message), drone_id=self._parts.config.drone.id, now=now, frame_age_s=age
        )
        self.health.drops["health_files"] = self._health_file.failed

    def _footnotes(self) -> list[str]:
        """How the agent is doing, for a line of the console."""
        rates = self.health.rates
        notes = [f"tracks {rates['tracks'].got_hz:.0f} Hz", f"camera {rates['detections'].got_hz:.0f} Hz"]
        if self._parts.autopilot is not None:
            notes.append(f"gyro {rates['imu'].got_hz:.0f} Hz")
        return notes + [f"{link.name}: {link.text}" for link in self.health.links() if not link.ok]

    def summarise(self) -> None:
        """Print what came of it all."""
        facts = [f"{link.name}: {link.text}" for link in self.health.links()]
        teammates = ", ".join(map(str, sorted(self._parts.onboard.teammates))) or "none"
        facts.append(f"announced teammates: {teammates}")
        output = self._parts.config.output
        facts += [f"written: {path}" for path in (output.jsonl, output.video) if path]
        self._console.summary(facts)

    async def _close(self) -> None:
        """Within CLOSE_TIMEOUT, whatever hangs."""
        closing = [self._parts.transport.close(), self._parts.camera.close()]
        closing += [transport.close() for transport, _ in self._parts.simulated_teammates]
        with suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT):
                for result in await asyncio.gather(*closing, return_exceptions=True):
                    if isinstance(result, BaseException):
                        log.warning("while closing: %s", result)
        self._worker.shutdown(wait=False, cancel_futures=True)
        if self._parts.recorder:
            self._parts.recorder.close()
        self._live.close()
        if self._jsonl:
            self._jsonl.close()
        if self._video:
            self._video.close()
        if self._health_file:
            self._health_file.close()


def _open_video(parts: Parts) -> AnnotatedVideo | None:
    path = parts.config.output.video
    if path is None:
        return None
    # Here, not above: OpenCV is nothing that an agent without pictures should pay for.
    from swarmtrack.runtime.annotated_video import AnnotatedVideo  # noqa: PLC0415

    return AnnotatedVideo(path, lossless=parts.paced_by_frames)
