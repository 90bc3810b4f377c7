"""What a drone and its team tell each other: where it is, who lives, and whom each sees as whom."""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from swarmtrack.autopilot.notices import Severity
from swarmtrack.carried.own_place import CarriedNews
from swarmtrack.clock import UTC_SIGMA, Clock, utc_offset
from swarmtrack.geometry.pose import Pose
from swarmtrack.identity.consensus import Disagreement
from swarmtrack.identity.neighbours import is_far
from swarmtrack.identity.news import Astray
from swarmtrack.messages import (
    AgreedMotion,
    Announcement,
    AnnouncementRequested,
    Array,
    DoubtNews,
    HeadingNews,
    IdClash,
    Input,
    LeapNews,
    MotionReport,
    PeerArrived,
    PeerDeparted,
    PeerExpelled,
    RangeReport,
    SightingReport,
    StrangerReport,
)
from swarmtrack.motion.ground_heights import GroundHeightNews
from swarmtrack.motion.sway import next_begin, possible_begins
from swarmtrack.outputs import periods
from swarmtrack.outputs.pilot_notices import PilotNotices
from swarmtrack.outputs.wording import describe, describe_filed, teammate_carried_in_words
from swarmtrack.perceived import TeamView
from swarmtrack.relative.frames import FrameNews
from swarmtrack.relative.range_watch import RangeNews
from swarmtrack.runtime.filed import coded_motion
from swarmtrack.runtime.health import Health
from swarmtrack.strangers.claims import RemoteIdNews
from swarmtrack.transport.base import Kind, Transport
from swarmtrack.wire import codec
from swarmtrack.wire.camera import camera_message
from swarmtrack.wire.motion import motion_message
from swarmtrack.wire.sightings import report_from_nowhere, sightings_message
from swarmtrack.wire.strangers import strangers_message

log = logging.getLogger(__name__)

# Lines about one teammate, in so many s: nobody may fill our log, or hide others in it.
LOG_LINES_PER_PERIOD, LOG_LINES_PERIOD_S = 16, 10.0


class Teamwork:
    """Carries events from the transport into Onboard, and Onboard's wishes and findings to the team.

    tell: the way into Onboard; what comes out there comes back by `ask_for_pose` and `on_disagreement`. start: in the
    team frame; None: wherever the autopilot says it is. start_sigma_m: how well this drone knows that frame. silent:
    nothing is told to the team, and nothing asked. filed: what is known of teammates before they say it, and agreed:
    how they move without saying it. coded: all drones that sway by a code when the pilot says so. share_hz: how often
    the team is told how this drone moves; None: never. on_report: told of each report to the team. simulated:
    teammates without agents, spoken for here. needed: teammates whose reports are received in a team however large.
    """

    def __init__(
        self,
        tell: Callable[[Input], None],
        perceived: TeamView,
        transport: Transport,
        health: Health,
        notices: PilotNotices,
        *,
        drone_id: int,
        boot: str,
        clock: Clock,
        start: Pose | None,
        start_sigma_m: float,
        silent: bool = False,
        filed: Sequence[Announcement] = (),
        agreed: Sequence[AgreedMotion] = (),
        coded: Collection[int] = (),
        share_hz: float | None = None,
        on_report: Callable[[SightingReport], None] | None = None,
        simulated: Sequence[tuple[Transport, Announcement]] = (),
        needed: Collection[int] = (),
    ) -> None:
        self._drone_id = drone_id
        self._boot = boot
        self._start = start
        self._start_sigma_m = start_sigma_m
        self._silent = silent
        self._filed = filed
        self._agreed = agreed
        self._coded = coded
        self._tell = tell
        self._perceived = perceived
        self._transport = transport
        self._health = health
        self._notices = notices
        self._clock = clock
        self._share_hz = share_hz
        self._on_report = on_report
        self._simulated = simulated
        self._needed = needed
        self._posed = asyncio.Event()
        self._asked = asyncio.Event()
        self._announced = 0
        self._announced_place: Array | None = None
        self._reports = 0
        self._reported: tuple[object, ...] = ()
        self._reported_at = -math.inf
        self._disputed: set[tuple[int, int]] = set()
        self._carried: set[int] = set()
        """Teammates whose position rests on others'."""
        self._lines: Counter[int] = Counter()  # by the teammate they are about
        self._lines_since = -math.inf

    def on_position(self) -> None:
        """The autopilot knows where the drone is."""
        self._posed.set()

    def on_switch(self, t: float) -> None:
        """The pilot has thrown the switch at t [s]: every drone sways by the code from the next full 10 s of UTC
        on.
        """
        utc = utc_offset(self._clock)
        for begin in possible_begins(t + utc):
            for drone_id in self._coded:
                # When others begin is known less well than when we do.
                if drone_id != self._drone_id or begin == next_begin(t + utc):
                    self._tell(coded_motion(drone_id, self._coded, begin - utc, tried=True))
        when = f"{datetime.fromtimestamp(next_begin(t + utc), UTC):%H:%M:%S} UTC"
        self._note(self._drone_id, f"the pilot's switch: codes are flown from {when} on", logging.INFO)
        self._notices.add(Severity.INFO, f"codes from {when} on")

    def describe_camera(self) -> None:
        """Publish our camera, for directions from the pixels of our tracks; before the network opens."""
        lenses = [each.lens for each in self._perceived.cameras]
        mountings = [each.body_from_camera for each in self._perceived.cameras]
        try:
            self._transport.describe(
                codec.encode(camera_message(self._drone_id, self._boot, lenses, mountings))
            )
        except ValueError:  # what no reader would accept is not sent, and must not end the flight
            self._health.drops["unsendable_camera"] += 1

    async def listen(self) -> None:
        """Every event of the transport into Onboard, and a line of it into health and log; first what is filed."""
        for announcement in self._filed:
            self._tell(replace(announcement, t=self._clock.now()))
            self._note(announcement.drone_id, describe_filed(announcement), logging.INFO)
        for motion in self._agreed:
            self._tell(motion)
        async for event in self._transport.events():
            match event:
                case Announcement():
                    self._tell(event)
                case PeerArrived() | PeerDeparted() | IdClash() | PeerExpelled():
                    self._tell(event)
                    self._health.on_membership(event)
                case SightingReport():
                    self._tell(event)
                    self._notices.on_peer(event)
                    self._look_for_carried(event)
                    continue  # one a second from everybody: no news
                case MotionReport() | RangeReport() | StrangerReport():
                    self._tell(event)
                    continue
                case AnnouncementRequested():
                    self._asked.set()
            about = 0 if isinstance(event, AnnouncementRequested) else event.drone_id  # who asks is not told
            level = logging.WARNING if isinstance(event, IdClash | PeerExpelled) else logging.INFO
            self._note(about, describe(event), level)
            self._notices.on_peer(event)

    def _look_for_carried(self, report: SightingReport) -> None:
        """Has a teammate lost its position, or found it again? Those that follow it should know."""
        drone, is_carried = report.observer, bool(report.leans_on)
        if is_carried == (drone in self._carried):
            return
        self._carried ^= {drone}
        line = teammate_carried_in_words(drone, report.leans_on)
        self._note(drone, line, logging.WARNING)
        self._notices.add(Severity.WARNING, line)

    async def announce(self) -> None:
        """The one broadcast, as soon as this drone knows where it is, and those of simulated teammates; then again
        on request, until cancelled. Nothing of a silent drone.
        """
        if self._silent:
            return
        if self._start is None:
            await self._posed.wait()
        await self._announce(first=True)
        for transport, announcement in self._simulated:
            await _speak_for(transport, announcement)
        while True:  # again whenever somebody asks; those who ask meanwhile get the same answer
            await self._asked.wait()
            self._asked.clear()
            await self._announce(first=False)

    async def receive(self) -> None:
        """Until cancelled, in a large team: receive the reports of teammates nearby, and announce this drone again
        where it is far from its last announcement, by which others know where it is."""
        while True:
            await asyncio.sleep(periods.NEIGHBOURS)
            now = self._clock.now()
            neighbours = self._perceived.neighbours(now, self._needed)
            self._transport.receive_only(neighbours)
            own = None if neighbours is None else self._perceived.ego_pose(now)
            if own is not None and is_far(own.position, self._announced_place):
                self._asked.set()

    async def report(self) -> None:
        """Until cancelled: whom this drone sees as whom, once a second and when it changed. Nothing of a silent one."""
        while not self._silent:
            await asyncio.sleep(periods.IDENTITIES_CHANGED)
            self._report()

    def _report(self) -> None:
        now = self._clock.now()
        report = self._perceived.sighting_report(self._boot, self._reports + 1)
        knows_where = report is not None
        if report is None:
            report = report_from_nowhere(self._drone_id, self._boot, self._reports + 1, now)
        whom = (report.known, frozenset(sighting.drone_id for sighting in report.sightings))
        if whom == self._reported and now - self._reported_at < periods.IDENTITIES:
            return
        self._reports += 1
        self._reported, self._reported_at = whom, now
        try:
            payload = codec.encode(sightings_message(report, utc_offset(self._clock), now))
        except ValueError:  # what no reader would accept is not sent, and must not end the flight
            self._health.drops["unsendable_identities"] += 1
            return
        self._transport.publish(Kind.IDENTITIES, payload)
        if self._on_report is not None and knows_where:
            self._on_report(report)

    async def report_strangers(self) -> None:
        """Until cancelled: on which rays this drone sees strangers, while it sees any. Nothing of a silent one."""
        reported_t = -math.inf
        for sequence in itertools.count():
            await asyncio.sleep(periods.STRANGERS)
            report, now = self._perceived.stranger_report(self._boot, sequence), self._clock.now()
            if report is None or report.t <= reported_t or self._silent:
                continue
            reported_t = report.t
            try:
                payload = codec.encode(strangers_message(report, utc_offset(self._clock), now))
            except ValueError:
                self._health.drops["unsendable_strangers"] += 1
                continue
            self._transport.publish(Kind.STRANGER, payload)

    async def share(self) -> None:
        """Until cancelled, where that is asked for: how this drone moves, as soon as its autopilot knows."""
        if self._share_hz is None:
            return
        said_t = -math.inf
        for sequence in itertools.count():
            await asyncio.sleep(1.0 / self._share_hz)
            report, now = self._perceived.motion_report(self._boot, sequence), self._clock.now()
            if report is None or report.t <= said_t:
                continue
            said_t = report.t
            try:
                payload = codec.encode(motion_message(report, utc_offset(self._clock), now))
            except ValueError:
                self._health.drops["unsendable_motion"] += 1
                continue
            self._transport.publish(Kind.MOTION, payload)

    async def _announce(self, *, first: bool) -> None:
        """first: from where the config says that it starts; else from where the autopilot says it is."""
        now = self._clock.now()
        pose = self._perceived.announced_pose(now)
        assert pose is not None
        start, sigma = self._start if first else None, self._start_sigma_m
        self._announced += 1
        self._announced_place = pose.position
        await self._transport.announce(
            Announcement(
                drone_id=self._drone_id,
                boot=self._boot,
                sequence=self._announced,
                t=now,
                t_sigma=UTC_SIGMA,
                position=start.position if start else pose.position,
                world_from_body=start.rotation if start else pose.world_from_body,
                position_cov=sigma**2 * np.eye(3) + (0.0 if start else pose.position_cov),
            )
        )

    def ask_for_pose(self, drone_id: int) -> None:
        """Ask a teammate for its pose at once."""
        if not self._silent:
            self._transport.request_announcement(drone_id)

    def on_heading(self, news: HeadingNews) -> None:
        """What the team was told of our pose was told with another heading: announce it again."""
        if news.doubt or self._announced:
            level = logging.WARNING if news.doubt else logging.INFO
            self._note(self._drone_id, describe(news), level)
        if self._announced:
            self._asked.set()

    def on_leap(self, news: LeapNews) -> None:
        """Our autopilot's position has jumped."""
        self._note(self._drone_id, describe(news), logging.WARNING)

    def on_ground_height(self, news: GroundHeightNews) -> None:
        """A teammate's height is not one of our field, although we stand on the ground."""
        self._note(news.drone_id, describe(news), logging.WARNING)

    def on_astray(self, found: Astray) -> None:
        """A teammate is not where it says, by how it moves."""
        self._note(found.drone_id, describe(found), logging.WARNING)

    def on_frame(self, news: FrameNews) -> None:
        """A teammate's start is not where it was announced, or is after all."""
        self._note(news.drone_id, describe(news), logging.WARNING)

    def on_remote_id(self, news: RemoteIdNews) -> None:
        """A claim by Remote ID fits a stranger, or is false."""
        self._note(0, describe(news), logging.WARNING if news.number is None else logging.INFO)

    def on_carried(self, news: CarriedNews) -> None:
        """Our autopilot has no position, or a wrong one: who holds us, if anybody does; or it counts again."""
        self._note(self._drone_id, describe(news), logging.WARNING)

    def on_range_news(self, news: RangeNews) -> None:
        """The distances that our ranging radio measures do not fit what we see, or do again."""
        self._note(news.drone_id, describe(news), logging.WARNING)

    def on_doubt(self, news: DoubtNews) -> None:
        """Where this drone is, it does not know, or knows again: the team must hear of it."""
        self._note(self._drone_id, describe(news), logging.WARNING)
        self._notices.on_doubt(news)
        if self._announced:
            self._asked.set()

    def on_disagreement(self, found: Disagreement) -> None:
        """Another drone sees it otherwise: said once per pair."""
        pair = (found.observer, found.drone_id)
        if pair not in self._disputed:
            self._note(found.observer, describe(found), logging.WARNING)
            self._notices.on_disagreement(found)
        self._disputed.add(pair)

    def _note(self, about: int, line: str, level: int) -> None:
        now = self._clock.now()
        if now - self._lines_since >= LOG_LINES_PERIOD_S:
            self._lines.clear()
            self._lines_since = now
        self._lines[about] += 1
        if self._lines[about] > LOG_LINES_PER_PERIOD:
            self._health.drops["events_untold"] += 1
            return
        self._health.events.append(line)
        log.log(level, line)


async def _speak_for(transport: Transport, announcement: Announcement) -> None:
    await transport.open()
    await transport.announce(announcement)
