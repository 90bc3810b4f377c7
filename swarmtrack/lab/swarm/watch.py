"""Hears a flying swarm and keeps what the judge and the spectator need of it.

Each agent's tracks are sampled at SCORE_HZ: of every tenth of a second its first message, at the exact instant that it
speaks of, beside the truth of that instant. A tenth in which a running agent said nothing is a glance without tracks.

Truths cost time that the agents want. So samples wait, and are judged in a share of one core; the rest after landing.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import numpy as np

from swarmtrack.clock import Clock
from swarmtrack.lab.scenarios.scenario import Scenario, ScenarioFault
from swarmtrack.lab.score.formation_score import FormationScore
from swarmtrack.lab.score.relative_score import PlaceError, StatedPlace, error_of, relative_score
from swarmtrack.lab.score.swarm_score import SCORE_HZ, Glance, JudgedTrack, NamedTrack, SwarmScorer
from swarmtrack.lab.score.swarm_truth import KNOTS_HZ, SwarmTruth
from swarmtrack.lab.score.swarm_verdict import AgentFigures, Limits, SwarmReport
from swarmtrack.lab.swarm.formation_watch import FormationWatch
from swarmtrack.lab.world.followed import NotTold
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind, Sample
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import AnnouncementMessage
from swarmtrack.wire.checks import DecodeError, symmetric
from swarmtrack.wire.codec import Message
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.sightings import SightingsMessage
from swarmtrack.wire.tracks import TracksMessage

JUDGING_SHARE = 0.15  # of one core, in flight
MAX_JUDGED_IN_FLIGHT = 10  # drones: of more the judge would be behind anyway
HEALTH_S = 1.0  # that a health message looks back upon
WATCH_SETTLED_S = (
    3.0  # s of an agent's life: the second that its health message looks back upon is an ordinary one
)
TRUTH_AHEAD_S = 1.0 / KNOTS_HZ  # of what is judged: the truth is interpolated between knots
NEW_SCAN_S = 1e-3  # s: exposures nearer to each other than this are one


@dataclass(frozen=True, slots=True)
class Statement:
    """What one agent said in one tenth of a second, before it is judged; tracks None: nothing."""

    observer: int
    boot: str
    index: int
    t: float
    tracks: tuple[NamedTrack, ...] | None
    places: tuple[StatedPlace, ...] = ()


@dataclass(slots=True)
class AgentView:
    """One agent, as heard."""

    boot: str | None = None
    """Of its living process; None while there is none."""
    announcement_bytes: int | None = None
    first_tracks_t: float = math.nan
    last_index: int | None = None
    scan_t: float = math.nan
    sequence: int = -1
    latencies: list[float] = field(default_factory=list)
    health: list[tuple[float, HealthMessage]] = field(default_factory=list)
    seen: list[JudgedTrack] = field(default_factory=list)
    """Its tracks when last judged."""
    judged_t: float = math.nan


class HeldClock:
    """Both clocks as they stood at one moment: when a sample was heard, now or in a recorded flight."""

    def __init__(self) -> None:
        self._now = self._utc = 0.0

    def set(self, now: float, utc: float) -> None:
        self._now, self._utc = now, utc

    def now(self) -> float:
        return self._now

    def utc(self) -> float:
        return self._utc


class Watch:
    """All that is heard of the team, in world time (0 at `epoch` of the clock's `now`).

    hearing: set by whoever hands over the samples, to when each was heard, so that a recorded flight is judged alike.
    """

    def __init__(
        self, scenario: Scenario, clock: Clock, hearing: Clock, *, epoch: float, seconds: float
    ) -> None:
        """Judged is from world time 0 on, for so many seconds, unless `count_from` says otherwise. Where the scenario
        counts from take-off, that long after it."""
        self.agents = {drone_id: AgentView() for drone_id in scenario.members}
        self._seconds = seconds
        self._start, self._end = 0.0, math.inf if scenario.from_take_off else seconds
        self.scorer = SwarmScorer(scenario.members, start=self._start, end=self._end)
        self._place_errors: list[PlaceError] = []
        self.unreadable = 0
        self.unjudged = 0
        """Of what was said: the truth of that time was not told."""
        self._scenario = scenario
        self._clock = clock
        self._hearing = hearing
        self._epoch = epoch
        self._pause = math.ceil(2.0 * SCORE_HZ / scenario.tracks_hz) - 1
        """Tenths of a second that an agent may pass over, publishing at its rate."""
        self._truth = SwarmTruth(scenario.world, scenario.cameras)
        formation = scenario.formation
        self._formation = None if formation is None else FormationWatch(scenario, formation)
        self._last_start = math.nan
        self._known: dict[int, dict[int, float]] = {drone_id: {} for drone_id in scenario.members}
        self._waiting: deque[Statement] = deque()
        self._news = asyncio.Event()
        self._arrivals = asyncio.Condition()

    @property
    def t(self) -> float:
        """World time now [s]."""
        return self._clock.now() - self._epoch

    @property
    def _heard_t(self) -> float:
        """World time of the sample that is being looked at [s]."""
        return self._hearing.now() - self._epoch

    @property
    def team(self) -> list[int]:
        """Who has announced itself: before, a drone is a stranger to all."""
        return [drone_id for drone_id, agent in self.agents.items() if agent.announcement_bytes is not None]

    @property
    def missing(self) -> list[int]:
        """Who has not announced itself yet, or says nothing of what it tracks."""
        return [
            drone_id
            for drone_id, agent in self.agents.items()
            if agent.announcement_bytes is None or math.isnan(agent.first_tracks_t)
        ]

    @property
    def faults(self) -> list[ScenarioFault]:
        """What is going wrong by plan; a moment is shown for a second."""
        t = self.t
        return [f for f in self._scenario.faults if f.at_s <= t < f.at_s + max(f.seconds, 1.0)]

    @property
    def ends_at(self) -> float:
        """World time up to which is judged [s]; inf: that counts from a take-off that has not come yet."""
        if math.isinf(self._end):
            self._end = self._scenario.world.took_off_at + self._seconds
            self.scorer.count_between(self._start, self._end)
        return self._end

    def cut_off(self, t: float) -> None:
        """Judge what was flown until this world time only."""
        self._end = min(t, self.ends_at)
        self.scorer.count_between(self._start, self._end)

    def count_from(self, start: float, seconds: float) -> None:
        """Judge what is flown from this world time on, for so long; before anything was counted."""
        self._start, self._end = start, start + seconds
        self.scorer.count_between(self._start, self._end)

    # --- hearing ------------------------------------------------------------------------

    async def listen(self, samples: AsyncIterator[Sample]) -> None:
        """Until the listener is closed."""
        async for sample in samples:
            address = keys.parse(sample.key)
            if address is None or address.drone_id not in self.agents:
                continue
            agent = self.agents[address.drone_id]
            if address.kind is Kind.ALIVE:
                if sample.alive and len(address.rest) == 1:
                    await self._on_boot(agent, address.rest[0])
                    if not self._scenario.announces:
                        self._on_silent(address.drone_id, agent, address.rest[0])
                continue
            kind = keys.MESSAGES.get(address.kind)
            if kind is None:
                continue
            try:
                message = codec.decode(kind, sample.payload)
            except DecodeError:
                self.unreadable += 1
                continue
            self._on_message(address.drone_id, agent, message, len(sample.payload))

    async def until_alive(self, drone_id: int) -> None:
        """Until its agent is on the network."""
        async with self._arrivals:
            await self._arrivals.wait_for(lambda: self.agents[drone_id].boot is not None)

    def started(self, drone_id: int) -> None:
        """A process of its own begins now, and knows nobody."""
        self._last_start = self.t
        self._known[drone_id].clear()

    def ended(self, drone_id: int) -> None:
        """Its process was ended on purpose: its silence means nothing."""
        self.agents[drone_id].boot = None
        self.agents[drone_id].last_index = None

    async def _on_boot(self, agent: AgentView, boot: str) -> None:
        """A liveliness token came. That one goes again is no matter: who hangs is silent, and silence is judged."""
        if agent.boot != boot:
            agent.boot, agent.last_index, agent.sequence = boot, None, -1
        async with self._arrivals:
            self._arrivals.notify_all()

    def _on_silent(self, drone_id: int, agent: AgentView, boot: str) -> None:
        """Of a team that tells each other nothing, whoever lives is known by the file that all have."""
        t = self._heard_t
        agent.announcement_bytes = agent.announcement_bytes or 0
        self.scorer.announced(drone_id, t)
        for teammate in self.agents.keys() - {drone_id}:
            self.scorer.knows(drone_id, boot, teammate, t)
            self._known[drone_id].setdefault(teammate, t)

    def _on_message(self, drone_id: int, agent: AgentView, message: Message, size: int) -> None:
        match message:
            case TracksMessage():
                self._on_tracks(drone_id, agent, message)
            case HealthMessage():
                agent.health.append((self._heard_t, message))
            case AnnouncementMessage():
                agent.announcement_bytes = size
                self.scorer.announced(drone_id, self._heard_t)
            case SightingsMessage():
                for teammate in message.known:
                    self.scorer.knows(drone_id, message.boot, teammate, self._heard_t)
                    if message.boot == agent.boot:
                        self._known[drone_id].setdefault(teammate, self._heard_t)

    def _on_tracks(self, drone_id: int, agent: AgentView, message: TracksMessage) -> None:
        if agent.boot is None or message.scan_age_s == 0.0:
            return  # before its first frame, or the last words of a process that was ended
        t = self._world_time(drone_id, message.t_utc_s)
        if math.isnan(agent.first_tracks_t):
            agent.first_tracks_t = t
        scan_t = t - message.scan_age_s
        if scan_t - agent.scan_t > NEW_SCAN_S and message.sequence == agent.sequence + 1 and t >= self._start:
            agent.latencies.append(message.scan_age_s)
        agent.scan_t, agent.sequence = scan_t, message.sequence
        index = math.floor(t * SCORE_HZ)
        if agent.last_index is not None and index <= agent.last_index:
            return
        self._fill(drone_id, agent, index)
        proved = {proof.track_id for proof in message.proofs}
        tracks = tuple(
            NamedTrack(
                track.id,
                track.identity,
                track.identity_probability,
                track.u_px,
                track.v_px,
                track.id in proved,
                message.camera_of(row),
            )
            for row, track in enumerate(message.tracks)
            if track.status == "confirmed"
        )
        self._say(drone_id, agent, index, t, tracks, places=_places(message))

    def _world_time(self, drone_id: int, t_utc: float) -> float:
        """Of a time on the drone's own wall clock, whose error the scenario knows."""
        ours = t_utc - self._scenario.utc_offset_s.get(drone_id, 0.0)
        return ours - (self._hearing.utc() - self._hearing.now()) - self._epoch

    def _fill(self, drone_id: int, agent: AgentView, index: int) -> None:
        """Tenths of a second before `index` in which the agent should have spoken and did not."""
        if agent.last_index is not None:
            for missed in range(agent.last_index + 1 + self._pause, index):
                self._say(drone_id, agent, missed, (missed + 0.5) / SCORE_HZ, None)

    def _say(
        self,
        drone_id: int,
        agent: AgentView,
        index: int,
        t: float,
        tracks: tuple[NamedTrack, ...] | None,
        *,
        places: tuple[StatedPlace, ...] = (),
    ) -> None:
        assert agent.boot is not None
        agent.last_index = index
        self._waiting.append(Statement(drone_id, agent.boot, index, t, tracks, places))
        self._news.set()

    # --- judging ------------------------------------------------------------------------

    @property
    def waiting(self) -> int:
        """Statements that are still to be judged."""
        return len(self._waiting)

    async def evaluate(self) -> None:
        """In flight, until cancelled: as statements come, in a share of one core."""
        while len(self.agents) <= MAX_JUDGED_IN_FLIGHT:
            while self._waiting and self._waiting[0].t + TRUTH_AHEAD_S <= self._scenario.world.told_until:
                began = self._clock.now()
                self._judge_next()
                await asyncio.sleep((self._clock.now() - began) * (1.0 / JUDGING_SHARE - 1.0))
            self._news.clear()
            await self._news.wait()

    async def judge_the_rest(self) -> None:
        """After landing: whoever fell silent is asked for the tenths until the end, then all is judged."""
        if math.isinf(self.ends_at):
            # Nobody took off: the flight is what was told of it.
            self.count_from(self._start, self._scenario.world.told_until - self._start)
        for drone_id, agent in self.agents.items():
            if agent.boot is not None:
                self._fill(drone_id, agent, math.floor(self.ends_at * SCORE_HZ))
        while self._waiting:
            self._judge_next()
            await asyncio.sleep(0)

    def _judge_next(self) -> None:
        statement = self._waiting.popleft()
        try:
            view = self._truth.view(statement.observer, statement.t)
            self._judge_places(statement)
        except NotTold:
            self.unjudged += 1
            return
        if self._formation is not None:
            self._formation.saw(statement.observer, statement.t, view.in_view)
        agent = self.agents[statement.observer]
        agent.judged_t = statement.t
        agent.seen = self.scorer.add(
            Glance(
                statement.observer,
                statement.boot,
                statement.index,
                statement.t,
                view.in_view,
                view.hidden,
                statement.tracks,
                view.cameras,
            )
        )

    def _judge_places(self, statement: Statement) -> None:
        """Of the team; where somebody is who only says that he is of it, nobody knows."""
        if not self._start <= statement.t < self.ends_at:
            return
        for place in statement.places:
            if place.drone_id in self.agents:
                truth = self._truth.relative(statement.observer, place.drone_id, statement.t)
                self._place_errors.append(error_of(place.state, place.cov, truth))

    # --- figures ------------------------------------------------------------------------

    @property
    def all_known_s(self) -> float:
        """From the last start of an agent until each had told that it has everybody's announcement; NaN: not yet."""
        team = self.agents.keys()
        if any(team - known.keys() - {drone_id} for drone_id, known in self._known.items()):
            return math.nan
        times = (t for known in self._known.values() for t in known.values())
        return max(times, default=self._last_start) - self._last_start

    def report(
        self,
        *,
        seconds: float,
        seed: int,
        tracker: str,
        detector: str,
        limits: Limits,
        machine_busy: float = math.nan,
        others_busy: float = math.nan,
        detail: str = "full",
        cut_off_s: float = math.nan,
    ) -> SwarmReport:
        """All numbers of the flight; the arguments are what was flown, and how busy the machine was."""
        scenario = self._scenario
        return SwarmReport(
            scenario=scenario.name,
            drones=len(scenario.members),
            seconds=seconds,
            seed=seed,
            tracker=tracker,
            detector=detector,
            score=self.scorer.score(),
            all_known_s=self.all_known_s,
            agents=self.figures(),
            asked_tracks_hz=scenario.tracks_hz,
            asked_imu_hz=scenario.imu_rate_hz,
            image_width=scenario.camera.width,
            limits=limits,
            relative=relative_score(self._place_errors),
            formation=self._formation_score(),
            machine_busy=machine_busy,
            others_busy=others_busy,
            detail=detail,
            cut_off_s=cut_off_s,
        )

    def _formation_score(self) -> FormationScore | None:
        if self._formation is None:
            return None
        health = {drone_id: agent.health for drone_id, agent in self.agents.items()}
        took_off_at = self._scenario.world.took_off_at if self._scenario.from_take_off else 0.0
        return self._formation.score(health, self.ends_at, counts_from=took_off_at)

    def late(self, limits: Limits) -> list[tuple[float, float]]:
        """Spans of world time (from, to) [s] in which something took longer than it may: each second of which an agent
        told too low a rate, and the time until all was known and named where that was too long."""
        asked = {"tracks": self._scenario.tracks_hz, "imu": self._scenario.imu_rate_hz}
        spans = [
            (t - HEALTH_S, t)
            for agent in self.agents.values()
            for t, message in agent.health
            if t >= self._start + HEALTH_S
            and message.uptime_s >= WATCH_SETTLED_S
            and any(
                message.rates[name].got_hz < limits.rate * hz
                for name, hz in asked.items()
                if name in message.rates
            )
        ]
        if not self.all_known_s <= limits.all_known_s:
            known_s = self.ends_at - self._last_start if math.isnan(self.all_known_s) else self.all_known_s
            spans.append((self._last_start, self._last_start + known_s))
        slowest = max(self.scorer.score().time_to_identify_s.values(), default=0.0)
        if not slowest <= limits.time_to_identify_s:
            spans.append((self._start, self.ends_at if math.isnan(slowest) else self._start + slowest))
        return spans

    def figures(self) -> tuple[AgentFigures, ...]:
        """Of every agent, over the flight so far."""
        return tuple(self._figures(drone_id, agent) for drone_id, agent in self.agents.items())

    def _figures(self, drone_id: int, agent: AgentView) -> AgentFigures:
        health = [
            message
            for t, message in agent.health
            if t >= self._start + 1.0 and message.uptime_s >= WATCH_SETTLED_S
        ] or [message for _, message in agent.health]
        p50, p95 = np.percentile(agent.latencies, [50, 95]) if agent.latencies else (math.nan, math.nan)

        def rate(name: str) -> float:
            return _mean([message.rates[name].got_hz for message in health if name in message.rates])

        return AgentFigures(
            drone_id=drone_id,
            start_s=max(self._start, self._scenario.starts_s.get(drone_id, 0.0)),
            first_tracks_s=agent.first_tracks_t,
            track_rate_hz=rate("tracks"),
            imu_rate_hz=rate("imu"),
            detection_rate_hz=rate("detections"),
            latency_p50_s=float(p50),
            latency_p95_s=float(p95),
            cpu_percent=_mean([message.cpu_percent for message in health]),
            rss_mb=max((message.rss_mb for message in health), default=math.nan),
            announcement_bytes=agent.announcement_bytes,
            announcements_sent=_announcements_sent(agent.health),
        )


def _places(message: TracksMessage) -> tuple[StatedPlace, ...]:
    """Of the named confirmed tracks."""
    names = {track.id: track.identity for track in message.tracks if track.status == "confirmed"}
    return tuple(
        StatedPlace(
            name,
            np.array([*relative.position_m, *relative.velocity_m_s]),
            symmetric(np.array([relative.cov]), 6)[0],
        )
        for relative in message.relatives
        if isinstance(name := names.get(relative.track_id), int)
    )


def _announcements_sent(health: list[tuple[float, HealthMessage]]) -> int:
    """Over all lives of the agent: the counter starts again with each."""
    by_boot = {
        message.boot: int(link.counters["announcements_sent"])
        for _, message in health
        for link in message.links
        if "announcements_sent" in link.counters
    }
    return sum(by_boot.values())


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan
