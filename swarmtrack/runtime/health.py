"""The agent's health: what it counts, and the message it makes of it once a second."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Protocol

from swarmtrack.clock import Clock
from swarmtrack.diagnosis.readiness import Readiness, judge
from swarmtrack.diagnosis.sources import AutopilotFacts, CameraFacts
from swarmtrack.diagnosis.tracking import check_tracking, ratio_of, worst
from swarmtrack.messages import Array, IdClash, LinkStatus, Membership, PeerDeparted
from swarmtrack.outputs import periods
from swarmtrack.perceived import HealthView
from swarmtrack.runtime.meters import LatencyMeter, ProcessMeter, RateMeter
from swarmtrack.wire.fields import WIRE_VERSION
from swarmtrack.wire.health import (
    CarriedHealth,
    ConsistencyHealth,
    GyroBiasHealth,
    HealthMessage,
    LatencyHealth,
    NoiseHealth,
    RateHealth,
    ReadinessHealth,
    TimeOffsetHealth,
    health_line,
    link_health,
)
from swarmtrack.wire.sightings import NOWHERE_SIGMA_M

HEALTH_EVENTS_KEPT = 16
# Messages in a row, one a second, in which the tracks misjudge themselves, from which on it is said.
MISFITS_SAID = 20
# s between two looks at how late the event loop is.
LAG_PERIOD = 0.05


class HasStatus(Protocol):
    """Something that this agent is connected to."""

    def status(self) -> LinkStatus: ...


@dataclass(frozen=True, slots=True)
class Connections:
    """All of them; None: there is none."""

    cameras: Sequence[HasStatus]
    network: HasStatus
    autopilot: HasStatus | None = None
    detector: HasStatus | None = None
    recorder: HasStatus | None = None
    formation: HasStatus | None = None
    feed: HasStatus | None = None

    def statuses(self) -> list[LinkStatus]:
        before = [] if self.autopilot is None else [self.autopilot.status()]
        sources = (self.detector, self.network, self.recorder, self.formation, self.feed)
        after = [source.status() for source in sources if source is not None]
        return [*before, *self.camera_statuses(), *after]

    def camera_statuses(self) -> list[LinkStatus]:
        """Statuses of the cameras; several are named by their numbers, from 1, with the address in the text."""
        statuses = [camera.status() for camera in self.cameras]
        if len(statuses) == 1:
            return statuses
        return [
            replace(status, name=camera_name(k), text=f"{status.name}: {status.text}")
            for k, status in enumerate(statuses)
        ]


def camera_name(number: int) -> str:
    """Name of one of several cameras for people, who count from 1."""
    return f"camera {number + 1}"


@dataclass(frozen=True, slots=True)
class Expected:
    """What the config asks for. imu_hz None: of no autopilot. frame_age_s: of each camera. unmeasured_m: the
    assumed sigma of a start configured without one; else None.
    """

    imu_hz: float | None
    tracks_hz: float
    frame_age_s: tuple[float, ...]
    unmeasured_m: float | None = None


class Health:
    """Meters that the agent's tasks tick, and the message of what they show.

    clock: the flight's, of the message's stamp; wall: the machine's, of rates and ages. live: frames come when they
    come, and can stay away.
    """

    def __init__(
        self,
        drone_id: int,
        boot: str,
        links: Connections,
        perceived: HealthView,
        expected: Expected,
        *,
        clock: Clock,
        wall: Clock,
        live: bool,
    ) -> None:
        self.imu = RateMeter()
        self.scans = RateMeter()
        self.published = RateMeter()
        self.exposure_to_detector = LatencyMeter()
        self.detector = LatencyMeter()
        self.detections_to_published = LatencyMeter()
        self.loop_lag = LatencyMeter(round(periods.HEALTH_PERIOD_S / LAG_PERIOD))
        self.events: deque[str] = deque(maxlen=HEALTH_EVENTS_KEPT)
        self.drops: Counter[str] = Counter()
        self.tracked_at: float | None = None
        """When a scan was tracked last, by the wall; None: none yet."""
        self._drone_id = drone_id
        self._boot = boot
        self._links = links
        self._perceived = perceived
        self._expected = expected
        self._clock = clock
        self._wall = wall
        self._live = live
        self._started = self._wall.now()
        self._process = ProcessMeter(self._wall.now)
        self.rates: dict[str, RateHealth] = {}
        self._misfits = 0
        self._clones: set[str] = set()
        count = len(links.cameras)
        self._frames, self._frame_at = [0.0] * count, [self._started] * count
        self._scans_of = [RateMeter() for _ in range(count)]
        self._stale_of = [0] * count

    def links(self) -> list[LinkStatus]:
        """State of everything this agent is connected to; of several cameras with what became of their frames, what
        their clocks are known to be late, and how wrong their trackers are about themselves."""
        statuses = self._links.statuses()
        count = len(self._links.cameras)
        if count == 1:
            return statuses
        numbers = {camera_name(k): k for k in range(count)}
        return [
            replace(status, counters=(*status.counters, *self._camera_counters(numbers[status.name])))
            if status.name in numbers
            else status
            for status in statuses
        ]

    def _camera_counters(self, number: int) -> list[tuple[str, float]]:
        camera = self._perceived.cameras[number]
        clock, found = camera.clock, camera.clock.found
        known = [("time_offset_s", found.offset_s), ("time_offset_sigma_s", found.sigma_s)] if found else []
        consistency, noise = camera.tracker.consistency, camera.tracker.measured_noise
        known += [("nis", ratio_of(consistency))] if consistency else []
        known += [("noise", noise.detections)] if noise else []
        return [("stale_frames", self._stale_of[number]), ("time_offset_used_s", clock.used_s), *known]

    @property
    def carried(self) -> CarriedHealth | None:
        """Holders of this drone's position where its autopilot does not know it; else None."""
        return _carried(self._perceived)

    def on_detections(self, camera: int) -> None:
        """A frame of a camera went through the detector."""
        self._scans_of[camera].tick()

    def on_stale_frame(self, camera: int) -> None:
        """A frame was too old when its turn came."""
        self.drops["stale_frames"] += 1
        self._stale_of[camera] += 1

    def on_scan(self) -> None:
        """A scan was tracked."""
        self.scans.tick()
        self.tracked_at = self._wall.now()

    def on_membership(self, event: Membership) -> None:
        """Other processes with this drone's ID."""
        if event.drone_id != self._drone_id:
            return
        if isinstance(event, IdClash):
            self._clones |= set(event.boots) - {self._boot}
        elif isinstance(event, PeerDeparted):
            self._clones.discard(event.boot)

    def readiness(self) -> Readiness:
        """Whether the drone could fly now, by what is counted anyway."""
        links, now = self._links, self._wall.now()
        autopilot, detector, live = links.autopilot, links.detector, self._live
        cameras = []
        for k, camera in enumerate(one.status() for one in links.cameras):
            numbers = dict(camera.counters)
            frames = numbers.get("frames", float(numbers.get("fps", 0.0) > 0.0))
            if frames != self._frames[k]:
                self._frames[k], self._frame_at[k] = frames, now
            age, limit = now - self._frame_at[k], self._expected.frame_age_s[k]
            cameras.append(CameraFacts(age, limit, camera, frames=int(frames), live=live))
        return judge(
            cameras=cameras,
            autopilot=AutopilotFacts(
                now - self._started,
                wanted=autopilot is not None,
                status=None if autopilot is None else autopilot.status(),
                live=live,
            ),
            detector=None if detector is None else detector.status(),
            network=links.network.status(),
            clones=tuple(sorted(self._clones)),
            doubts_itself=self._perceived.self_doubt,
            unmeasured_m=self._expected.unmeasured_m,
        )

    def message(self) -> HealthMessage:
        """Everything since the last call."""
        perceived, now = self._perceived, self._wall.now()
        self.rates = {
            "imu": RateHealth(self._expected.imu_hz, self.imu.read(now)),
            "detections": RateHealth(None, self.scans.read(now)),
            "tracks": RateHealth(self._expected.tracks_hz, self.published.read(now)),
        }
        if len(self._scans_of) > 1:
            for k, meter in enumerate(self._scans_of):
                self.rates[f"detections_{k + 1}"] = RateHealth(None, meter.read(now))
        meters = {
            "exposure_to_detector": self.exposure_to_detector,
            "detector": self.detector,
            "detections_to_published": self.detections_to_published,
            "loop_lag": self.loop_lag,
        }
        spreads = {name: meter.read() for name, meter in meters.items()}
        links = self.links()
        clock = {
            name: value
            for link in links
            for name, value in link.counters
            if link.name == "autopilot" and math.isfinite(value)  # NaN until the autopilot's clock is known
        }
        consistency = worst([each.tracker.consistency for each in perceived.cameras])
        readiness = self.readiness()
        drops: Counter[str] = Counter()
        for counts in (asdict(perceived.counters), perceived.part_counters, self.drops):
            drops.update(counts)  # adds: Onboard and its tracker both refuse late scans
        return HealthMessage(
            version=WIRE_VERSION,
            t_utc_s=self._clock.utc(),
            boot=self._boot,
            uptime_s=now - self._started,
            cpu_percent=self._process.cpu_percent(),
            rss_mb=self._process.rss_mb(),
            rates=self.rates,
            latencies={name: LatencyHealth(*spread) for name, spread in spreads.items() if spread},
            clock_offset_s=clock.get("clock_offset_s"),
            clock_offset_sigma_s=clock.get("clock_sigma_s"),
            links=tuple(link_health(link) for link in links),
            drops=dict(drops),
            events=tuple(map(health_line, self.events)),
            time_offset=_time_offset(perceived),
            gyro_bias=_gyro_bias(perceived),
            consistency=consistency and ConsistencyHealth(*consistency),
            readiness=ReadinessHealth(readiness.ready, tuple(map(health_line, readiness.reasons))),
            noise=self._noise(),
            carried=_carried(perceived),
        )

    def _noise(self) -> NoiseHealth | None:
        """What was learned of the noise; and in words, once it has lasted, what the tracks do not know of it. Of
        several cameras that of the first with which something is wrong, else of the noisiest."""
        trackers = [each.tracker for each in self._perceived.cameras]
        told = [(each.consistency, each.measured_noise) for each in trackers]
        known = [k for k, one in enumerate(told) if one != (None, None)]
        if not known:
            return None
        noisiest = max(known, key=lambda k: noise.detections if (noise := told[k][1]) is not None else 0.0)
        number = next((k for k in known if check_tracking(*told[k])), noisiest)
        noise, findings = told[number][1], check_tracking(*told[number])
        # A manoeuvre passes, and so does the time in which the noise is learned.
        self._misfits = self._misfits + 1 if findings else 0
        if self._misfits < MISFITS_SAID:
            return NoiseHealth(noise and noise.detections, noise and noise.motion, "", "")
        found, remedy = findings[0].found, findings[0].remedy
        if len(told) > 1:
            found = f"{camera_name(number)}: {found}"
        if self._misfits == MISFITS_SAID:
            self.events.append(f"{found}: {remedy}")
        return NoiseHealth(
            noise and noise.detections, noise and noise.motion, health_line(found), health_line(remedy)
        )


def _carried(perceived: HealthView) -> CarriedHealth | None:
    found = perceived.carried
    if found is None:
        return None
    return CarriedHealth(found.by, min(found.sigma_m, NOWHERE_SIGMA_M), found.off_m)


def _time_offset(perceived: HealthView) -> TimeOffsetHealth:
    clock = perceived.cameras[0].clock
    found = clock.found
    return TimeOffsetHealth(found and found.offset_s, found and found.sigma_s, clock.used_s)


def _gyro_bias(perceived: HealthView) -> GyroBiasHealth:
    found, used = perceived.gyro_bias
    return GyroBiasHealth(found and _three(found.bias), found and found.sigma, _three(used))


def _three(vector: Array) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z
