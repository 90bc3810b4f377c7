"""The agent of one drone: the tasks that feed Onboard and carry off what it says."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from swarmtrack.autopilot.mavlink_autopilot import MavlinkAutopilot
from swarmtrack.autopilot.notices import Severity
from swarmtrack.cameras.picture_turn import MountingNews
from swarmtrack.cameras.seams import SeamNews
from swarmtrack.carried.own_place import CarriedNews
from swarmtrack.config.toml.sections import key_text
from swarmtrack.detection.expectation import PerceivedExpectation
from swarmtrack.identity.consensus import Disagreement
from swarmtrack.identity.news import Astray
from swarmtrack.messages import (
    AutopilotRebooted,
    Detections,
    DoubtNews,
    EgoPose,
    FlightState,
    Frame,
    HeadingNews,
    ImuSample,
    Input,
    LeapNews,
    PoseWanted,
    RemoteIdClaim,
    ScanReport,
)
from swarmtrack.motion.ground_heights import GroundHeightNews
from swarmtrack.outputs.console import Console
from swarmtrack.outputs.destinations import JsonLines, video_paths
from swarmtrack.outputs.drawing import as_seen, drawn
from swarmtrack.outputs.live_video import LiveVideo
from swarmtrack.outputs.pilot_notices import PilotNotices
from swarmtrack.outputs.wording import describe
from swarmtrack.relative.frames import FrameNews
from swarmtrack.relative.range_watch import RangeNews
from swarmtrack.runtime.assembly import Parts
from swarmtrack.runtime.formation_pilot import FormationPilot
from swarmtrack.runtime.guard_process import GuardProcess
from swarmtrack.runtime.health import LAG_PERIOD, Connections, Expected, Health
from swarmtrack.runtime.health_file import HealthFile, health_path
from swarmtrack.runtime.perception import make_visual_gyro
from swarmtrack.runtime.place_feed import FeedParameters, PlaceFeed
from swarmtrack.runtime.publishers import HealthPublisher, TracksPublisher
from swarmtrack.runtime.systemd import Notifier, Watchdog
from swarmtrack.runtime.teamwork import Teamwork
from swarmtrack.runtime.turns import FairTurns, NewestFrames, in_order
from swarmtrack.sources import Camera, DetectionSource
from swarmtrack.strangers.claims import RemoteIdNews

if TYPE_CHECKING:
    from swarmtrack.outputs.annotated_video import AnnotatedVideo

log = logging.getLogger(__name__)

CLOSE_TIMEOUT = 1.5  # s for everything together


class Agent:
    """Runs until stopped, or until a recording ends."""

    def __init__(self, parts: Parts, *, console: Console, supervisor: Notifier | None = None) -> None:
        """supervisor: told how we are; None: systemd, where it has started us."""
        config, output = parts.config, parts.config.output
        self._config = config
        self._clock, self._wall, self._paced = parts.clock, parts.wall, parts.paced
        self._cameras, self._detector, self._autopilot = parts.cameras, parts.detector, parts.autopilot
        self._lenses, self._start = parts.lenses, parts.start
        self._door, self._recorder, self._ros2 = parts.door, parts.recorder, parts.ros2
        self._transport, self._renewal = parts.transport, parts.renewal
        self._simulated = parts.simulated_teammates
        self._console = console
        self._supervisor = supervisor or Notifier()
        self._watchdog = Watchdog(self._supervisor)
        with config.blamed("output"):
            self._jsonl = JsonLines(output.jsonl, cameras=len(parts.cameras)) if output.jsonl else None
            self._videos = _open_videos(parts)
        health_file = health_path(output.health)
        self._health_file = HealthFile(health_file) if health_file else None
        self._notices = make_notices(parts)
        self._formation = make_formation_pilot(parts, self._notices)
        self._place_feed = make_place_feed(parts, self._notices)
        self.health = make_health(parts, self._formation, self._place_feed)
        self._team = make_teamwork(parts, self.health, self._notices, self.deliver)
        self._live = LiveVideo(
            parts.transport,
            parts.door.perceived,
            parts.lenses,
            self.health.drops,
            clock=parts.clock,
            wall=parts.wall,
            also=parts.ros2,
        )
        self._tracks = TracksPublisher(
            parts.door,
            parts.transport,
            self.health,
            self._watchdog,
            clock=parts.clock,
            wall=parts.wall,
            hz=output.tracks_hz,
            also=None if parts.ros2 is None else parts.ros2.on_tracks,
        )
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="detector")
        self._visual_gyro = make_visual_gyro(config, parts.lens)
        perceived = parts.door.perceived
        self._expectations = [PerceivedExpectation(perceived, k) for k in range(len(parts.cameras))]
        self._turns = FairTurns()
        self._stop = asyncio.Event()
        self._all_stale = [False] * len(parts.cameras)

    def stop(self) -> None:
        """Ask for a clean end."""
        self._stop.set()

    async def run(self, seconds: float | None = None) -> None:
        """Run all tasks; if a bug kills one, all stop and its exception comes out. seconds: stop after so long."""
        # The first job of the detector's thread: the team hears of us meanwhile, the first frame waits for it.
        warm = asyncio.get_running_loop().run_in_executor(self._worker, self._warm_up)
        try:
            self._begin_recording()
            self._team.describe_camera()
            await self._transport.open()
            async with asyncio.TaskGroup() as tasks:
                cameras = tasks.create_task(self._feed_cameras(warm), name="cameras")
                others = [
                    tasks.create_task(self._feed_autopilot(), name="autopilot"),
                    tasks.create_task(self._team.listen(), name="peers"),
                    tasks.create_task(self._team.announce(), name="announce"),
                    tasks.create_task(self._team.report(), name="identities"),
                    tasks.create_task(self._team.receive(), name="neighbours"),
                    tasks.create_task(self._team.share(), name="motion"),
                    tasks.create_task(self._team.report_strangers(), name="strangers"),
                    tasks.create_task(self._publish_tracks(warm), name="tracks"),
                    tasks.create_task(self._publish_health(), name="health"),
                    tasks.create_task(self._feel_lag(), name="lag"),
                    tasks.create_task(self._notices.run(), name="tell"),
                    tasks.create_task(self._renew_keys(), name="keys"),
                    tasks.create_task(self._show_to_ros2(), name="ROS 2"),
                    tasks.create_task(self._feed_place(), name="feed"),
                ]
                formation = tasks.create_task(self._fly_in_formation(), name="formation")
                stop = tasks.create_task(self._stop.wait(), name="stop")
                await asyncio.wait({cameras, stop}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
                # First who flies the drone, while everything that this needs still stands.
                formation.cancel()
                await asyncio.wait({formation})
                for task in (cameras, stop, *others):
                    task.cancel()
        finally:
            self._supervisor.stopping()
            await self._close()

    def look_at_keys(self) -> None:
        """A newer roster may have been copied here."""
        if self._renewal is not None:
            self._renewal.look_now()

    async def _renew_keys(self) -> None:
        if self._renewal is not None:
            await self._renewal.run()

    async def _show_to_ros2(self) -> None:
        if self._ros2 is not None:
            await self._ros2.run()

    async def _fly_in_formation(self) -> None:
        if self._formation is not None:
            await self._formation.run()

    async def _feed_place(self) -> None:
        if self._place_feed is not None:
            await self._place_feed.run()

    def _begin_recording(self) -> None:
        if self._recorder is not None:
            with self._config.blamed("recording", "dir"):
                self._recorder.open()
            self._door.listener = self._recorder

    async def _feed_autopilot(self) -> None:
        if self._autopilot is not None:
            await self._autopilot.run(self)

    def on_imu(self, sample: ImuSample) -> None:
        """Sample from the autopilot, on the event loop."""
        self.health.imu.tick()
        self.deliver(sample)

    def on_pose(self, pose: EgoPose) -> None:
        """Pose from the autopilot, on the event loop."""
        self.deliver(pose)
        if pose.position is not None:
            self._team.on_position()

    def on_autopilot_reboot(self) -> None:
        """Reboot of the autopilot, on the event loop."""
        self.deliver(AutopilotRebooted())
        if self._formation is not None:
            self._formation.on_reboot()

    def on_switch(self, t: float) -> None:
        """Pilot's switch from the autopilot, on the event loop."""
        self._team.on_switch(t)

    def on_flight_state(self, state: FlightState) -> None:
        """Flight state from the autopilot, on the event loop."""
        self.deliver(state)

    def on_remote_id(self, claim: RemoteIdClaim) -> None:
        """Remote ID of another aircraft from the autopilot's link, on the event loop."""
        self.deliver(claim)

    def on_found_flying(self) -> None:
        """From the autopilot, on the event loop."""
        if self._start is not None:
            line = (
                'in the air already, but announced at its fixed drone.start: expected from = "local" or "gps"'
            )
            self.health.events.append(line)
            self._notices.add(Severity.WARNING, "in the air, start unknown")
            log.warning("drone %d is %s", self._config.drone.id, line)

    def _warm_up(self) -> None:
        if self._detector is not None:
            for width, height in sorted({(lens.width, lens.height) for lens in self._lenses}):
                self._detector.warm_up(width, height)

    async def _feed_cameras(self, warm: asyncio.Future[None]) -> None:
        """Everything that was detected into Onboard; returns where recordings end, all of them."""
        await asyncio.shield(warm)
        feeds = self._detections()
        if len(feeds) == 1:
            await self._feed(feeds[0])
        else:
            async with asyncio.TaskGroup() as tasks:
                for number, feed in enumerate(feeds, start=1):
                    tasks.create_task(self._feed(feed), name=f"camera {number}")
        # Nothing more will come: what still waits for a gyro sample is tracked now.
        self._door.tracks(self._clock.now() + 1.0)
        self._carry_off()

    async def _feed(self, detected: AsyncIterator[Detections]) -> None:
        async for detections in detected:
            self._tracks.on_detections()
            self.health.on_detections(detections.camera)
            self.deliver(detections)
            for video in self._videos:
                await video.drain()

    def _detections(self) -> list[AsyncIterator[Detections]]:
        """From sources that detect by themselves, or from cameras and our detector: what comes side by side."""
        sources = [camera for camera in self._cameras if isinstance(camera, DetectionSource)]
        if sources:
            return [self._receive(number, source) for number, source in enumerate(sources)]
        cameras = [camera for camera in self._cameras if not isinstance(camera, DetectionSource)]
        if len(cameras) == 1:
            return [self._detect(cameras[0].frames())]
        if self._paced is not None:
            return [self._detect(in_order(cameras))]
        return [self._detect_in_turn(number, camera) for number, camera in enumerate(cameras)]

    async def _receive(self, number: int, source: DetectionSource) -> AsyncIterator[Detections]:
        async for detections in source.detections():
            if self._is_fresh(detections.t, number):
                self._live.offer(detections.t, detections.sequence, None, number)
                yield replace(detections, camera=number) if number else detections

    async def _detect(self, frames: AsyncIterator[Frame]) -> AsyncIterator[Detections]:
        """Every frame through the detector."""
        async for frame in frames:
            if self._paced is not None:
                self._paced.set(frame.t)
            detections = await self._look_at(frame)
            if detections is not None:
                yield detections

    async def _detect_in_turn(self, number: int, camera: Camera) -> AsyncIterator[Detections]:
        """The frames of one of several live cameras, as often as its turn comes."""
        frames = NewestFrames(camera)
        try:
            while not frames.ended:
                await frames.arrived()
                async with self._turns.turn(number):
                    frame = await frames.get()
                    seen = None if frame is None else await self._look_at(replace(frame, camera=number))
                if seen is not None:
                    yield seen
        finally:
            frames.close()

    async def _look_at(self, frame: Frame) -> Detections | None:
        """A frame through the detector, in its thread; None where that came to nothing."""
        detector = self._detector
        assert detector is not None
        if not self._is_fresh(frame.t, frame.camera):
            return None
        if self._recorder is not None:
            self._recorder.frame(frame)
        self._live.offer(frame.t, frame.sequence, frame.image, frame.camera)
        began = self._wall.now()
        self._watchdog.look_began(began)
        await self._see_turn(frame)
        look = detector.plan(frame, self._expectations[frame.camera])
        detections = await asyncio.get_running_loop().run_in_executor(self._worker, detector.detect, look)
        self._watchdog.look_ended()
        self.health.detector.add(self._wall.now() - began)
        if detections is not None and self._videos:
            self._videos[frame.camera].add_frame(frame)
        return detections

    async def _see_turn(self, frame: Frame) -> None:
        """How the first camera has turned since its last frame, by its images; known before the detector looks."""
        if self._visual_gyro is None or frame.camera:
            return
        loop = asyncio.get_running_loop()
        turn = await loop.run_in_executor(self._worker, self._visual_gyro.turn_to, frame)
        if turn is not None:
            self.deliver(turn)

    def _is_fresh(self, exposed: float, number: int) -> bool:
        """Whether what a camera exposed then is young enough to be used now; what is not is counted."""
        age, limit = self._clock.now() - exposed, self._config.cameras[number].max_age_s
        if age <= limit:
            self.health.exposure_to_detector.add(age)
            self._all_stale[number] = False
            return True
        self.health.on_stale_frame(number)
        if not self._all_stale[number]:
            name = key_text(self._config.camera_key(number))
            log.warning("%s: skipped what is %.2f s old, expected %s.max_age_s = %g", name, age, name, limit)
        self._all_stale[number] = True
        return False

    def deliver(self, event: Input) -> None:
        """Pass an event to Onboard and publish the results: a scan may have waited for this very sample."""
        self._door.tell(event)
        self._carry_off()

    def _carry_off(self) -> None:
        for event in self._door.events():
            match event:
                case ScanReport():
                    self._on_scan(event)
                case PoseWanted(drone_id):
                    self._team.ask_for_pose(drone_id)
                case Disagreement():
                    self._team.on_disagreement(event)
                case Astray():
                    self._team.on_astray(event)
                case FrameNews():
                    self._team.on_frame(event)
                case RemoteIdNews():
                    self._team.on_remote_id(event)
                case RangeNews():
                    self._team.on_range_news(event)
                case HeadingNews():
                    self._team.on_heading(event)
                case LeapNews():
                    self._team.on_leap(event)
                case GroundHeightNews():
                    self._team.on_ground_height(event)
                case DoubtNews():
                    self._team.on_doubt(event)
                case CarriedNews():
                    self._team.on_carried(event)
                case SeamNews():
                    self._warn(describe(event))
                case MountingNews():
                    self._warn(describe(event))

    def _warn(self, line: str) -> None:
        """In the log, and for whoever reads the health."""
        self.health.events.append(line)
        log.warning("%s", line)

    def _on_scan(self, report: ScanReport) -> None:
        """To whoever writes or shows it; and the publisher wakes."""
        self.health.on_scan()
        self._console.on_scan(report)
        self._notices.on_scan(report)
        written = self._jsonl or self._videos
        seen = as_seen(report, *self._lenses) if written else []
        if self._jsonl:
            self._jsonl.write(report, seen)
            self.health.drops["jsonl_lines"] = self._jsonl.failed
        if self._videos:
            tracks = drawn(seen, report.camera, alone=self._config.is_alone)
            self._videos[report.camera].write(report, tracks)
            self.health.drops["video_frames"] = sum(video.dropped for video in self._videos)
        self._tracks.on_scan()

    async def _publish_tracks(self, warm: asyncio.Future[None]) -> None:
        await asyncio.shield(warm)
        self._supervisor.ready()
        await self._tracks.run()

    async def _publish_health(self) -> None:
        publisher = HealthPublisher(
            self.health,
            self._transport,
            self._notices,
            self._console,
            self._supervisor,
            drone_id=self._config.drone.id,
            wall=self._wall,
            recorder=self._recorder,
            file=self._health_file,
            also=None if self._ros2 is None else self._ros2.on_health,
        )
        await publisher.run()

    async def _feel_lag(self) -> None:
        """How late the event loop comes to what is due, in a task that waits for nothing else."""
        while True:
            due = self._wall.now() + LAG_PERIOD
            await asyncio.sleep(LAG_PERIOD)
            self.health.loop_lag.add(self._wall.now() - due)

    def summarise(self) -> None:
        """Print what came of it all."""
        facts = [f"{link.name}: {link.text}" for link in self.health.links()]
        teammates = ", ".join(map(str, sorted(self._door.perceived.teammates))) or "none"
        facts.append(f"announced teammates: {teammates}")
        output = self._config.output
        videos = video_paths(output.video, len(self._cameras)) if output.video else []
        facts += [f"written: {path}" for path in (output.jsonl, *videos) if path]
        self._console.summary(facts)

    async def _close(self) -> None:
        """Within CLOSE_TIMEOUT, whatever hangs."""
        closing = [self._transport.close(), *(camera.close() for camera in self._cameras)]
        closing += [transport.close() for transport, _ in self._simulated]
        closing += [] if self._ros2 is None else [self._ros2.close()]
        with suppress(TimeoutError):
            async with asyncio.timeout(CLOSE_TIMEOUT):
                for result in await asyncio.gather(*closing, return_exceptions=True):
                    if isinstance(result, BaseException):
                        log.warning("while closing: %s", result)
        self._worker.shutdown(wait=False, cancel_futures=True)
        if self._recorder is not None:
            self._recorder.close()
        self._live.close()
        if self._jsonl:
            self._jsonl.close()
        for video in self._videos:
            video.close()
        if self._health_file:
            self._health_file.close()


def make_health(
    parts: Parts, formation: FormationPilot | None = None, feed: PlaceFeed | None = None
) -> Health:
    """The meters of an agent of these parts."""
    config, autopilot = parts.config, parts.autopilot
    return Health(
        config.drone.id,
        parts.boot,
        Connections(
            parts.cameras, parts.transport, autopilot, parts.detector, parts.recorder, formation, feed
        ),
        parts.door.perceived,
        Expected(
            config.autopilot.imu_rate_hz if autopilot else None,
            config.output.tracks_hz,
            tuple(camera.max_age_s for camera in config.cameras),
            config.drone.start.position_sigma_m if config.drone.start.has_unknown_sigma else None,
        ),
        clock=parts.clock,
        wall=parts.wall,
        live=parts.paced is None,
    )


def make_formation_pilot(parts: Parts, notices: PilotNotices) -> FormationPilot | None:
    """What flies the drone of these parts; None where it must not be flown."""
    place = parts.config.formation.parameters(parts.config.drone.id)
    if parts.engagement is None or place is None or not isinstance(parts.autopilot, MavlinkAutopilot):
        return None
    guard = GuardProcess(place.limits, parts.autopilot.signing_key)
    return FormationPilot(
        parts.door, parts.autopilot, parts.engagement, guard, notices, clock=parts.clock, parameters=place
    )


def make_place_feed(parts: Parts, notices: PilotNotices) -> PlaceFeed | None:
    """What feeds the autopilot of these parts; None where it is fed nothing."""
    if parts.fed is None or not isinstance(parts.autopilot, MavlinkAutopilot):
        return None
    said = parts.config.autopilot
    parameters = FeedParameters(said.feed_hz, said.feed_max_sigma_m, said.feed_max_age_s)
    perceived = parts.door.perceived
    return PlaceFeed(perceived, parts.autopilot, parts.fed, notices, clock=parts.clock, parameters=parameters)


def make_notices(parts: Parts) -> PilotNotices:
    """What speaks to the autopilot of these parts, where that is one that can be spoken to."""
    config, autopilot, origin = parts.config, parts.autopilot, parts.config.team.origin
    return PilotNotices(
        autopilot if isinstance(autopilot, MavlinkAutopilot) else None,
        config.autopilot.tell,
        parts.door.perceived,
        parts.lenses,
        drone_id=config.drone.id,
        boot=parts.boot,
        team=config.network.team,
        origin=None if origin is None else origin.place(),
        clock=parts.clock,
        wall=parts.wall,
    )


def make_teamwork(
    parts: Parts, health: Health, notices: PilotNotices, tell: Callable[[Input], None]
) -> Teamwork:
    """What speaks and listens to the team for these parts; tell: the way into their Onboard."""
    config = parts.config
    drone, team = config.drone, config.team
    return Teamwork(
        tell,
        parts.door.perceived,
        parts.transport,
        health,
        notices,
        drone_id=drone.id,
        boot=parts.boot,
        clock=parts.clock,
        start=parts.start,
        start_sigma_m=drone.start.frame_sigma_m,
        silent=not team.announce,
        filed=parts.filed,
        agreed=parts.agreed,
        coded=tuple(map(int, team.drones)),
        share_hz=team.share_hz if team.share == "velocity" else None,
        on_report=None if parts.recorder is None else parts.recorder.record_sighting,
        simulated=parts.simulated_teammates,
        needed=() if (plan := config.formation.plan()) is None else plan.slots.keys(),
    )


def _open_videos(parts: Parts) -> list[AnnotatedVideo]:
    """One for each camera, or none."""
    path = parts.config.output.video
    if path is None:
        return []
    # Here, not above: OpenCV is nothing that an agent without pictures should pay for.
    from swarmtrack.outputs.annotated_video import AnnotatedVideo  # noqa: PLC0415

    paths = video_paths(path, len(parts.cameras))
    return [AnnotatedVideo(one, lossless=parts.paced is not None) for one in paths]
