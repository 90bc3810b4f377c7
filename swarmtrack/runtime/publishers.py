"""The two messages that an agent sends by the clock: its tracks, and how it is."""

from __future__ import annotations

import asyncio
import logging
import math
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING

from swarmtrack.clock import UTC_SIGMA, Clock, utc_offset
from swarmtrack.messages import LinkStatus
from swarmtrack.outputs import periods
from swarmtrack.outputs.console import Console
from swarmtrack.outputs.pilot_notices import PilotNotices
from swarmtrack.outputs.wording import held_in_words
from swarmtrack.runtime.door import Door
from swarmtrack.runtime.health import Health
from swarmtrack.runtime.health_file import HealthFile
from swarmtrack.runtime.systemd import Notifier, Watchdog
from swarmtrack.transport.base import Kind, Transport
from swarmtrack.wire import codec
from swarmtrack.wire.health import HealthMessage
from swarmtrack.wire.records import as_record
from swarmtrack.wire.tracks import TracksMessage, tracks_message

if TYPE_CHECKING:
    from swarmtrack.runtime.flight_recorder import FlightRecorder

log = logging.getLogger(__name__)


class TracksPublisher:
    """`tracks/<id>`: `hz` times a second, and at once when a scan was tracked, while anybody listens. Each time the
    watchdog is fed."""

    def __init__(
        self,
        door: Door,
        transport: Transport,
        health: Health,
        watchdog: Watchdog,
        *,
        clock: Clock,
        wall: Clock,
        hz: float,
        also: Callable[[TracksMessage, float], None] | None = None,
    ) -> None:
        """also: takes each message, and the time of its tracks on the flight's clock."""
        self._door = door
        self._transport = transport
        self._health = health
        self._watchdog = watchdog
        self._clock = clock
        self._wall = wall
        self._period = 1.0 / hz
        self._also = also
        self._tracked = asyncio.Event()
        self._detected_at: float | None = None
        self._asked_at = -math.inf
        self._sequence = 0

    def on_detections(self) -> None:
        """A scan has come: how long until it is published is measured from now."""
        self._detected_at = self._wall.now()

    def on_scan(self) -> None:
        """A scan was tracked."""
        self._tracked.set()

    async def run(self) -> None:
        """Until cancelled."""
        due = self._wall.now() + self._period
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(due - self._wall.now()):
                    await self._tracked.wait()
            now = self._wall.now()
            # What is sent before it is due is the next one; what a scan held up is not put off as well.
            due = max(min(due, now) + self._period, now)
            self._tracked.clear()
            self._publish()

    def _publish(self) -> None:
        now = self._clock.now()
        if self._is_awaited or now - self._asked_at >= periods.UNHEARD_TRACKS_PERIOD_S:
            self._asked_at = now
            self._send(now)
        else:
            self._health.published.tick()
            self._detected_at = None
        self._watchdog.feed(self._wall.now())

    @property
    def _is_awaited(self) -> bool:
        """Whether there is a subscriber, a recording or a further output."""
        return (
            self._also is not None
            or self._door.listener is not None
            or self._transport.has_listener(Kind.TRACKS)
        )

    def _send(self, now: float) -> None:
        """The tracks as of now."""
        tracks = self._door.tracks(now)
        message = tracks_message(tracks, self._sequence + 1, utc_offset(self._clock), UTC_SIGMA)
        try:
            payload = codec.encode(message, short=self._transport.is_narrow)
            if self._transport.publish(Kind.TRACKS, payload):
                self._sequence += 1
                self._health.published.tick()
        except ValueError:  # what no reader would accept is not sent, and must not end the flight
            self._health.drops["unsendable_tracks"] += 1
        if self._also is not None:
            self._also(message, now)
        if self._detected_at is not None:
            self._health.detections_to_published.add(self._wall.now() - self._detected_at)
            self._detected_at = None


class Troubles:
    """What does not work, for a line that comes each second: each reason once, then only who is waited for."""

    def __init__(self) -> None:
        self._told: dict[str, str] = {}
        self._since: dict[str, float] = {}

    def notes(self, links: Iterable[LinkStatus], now: float) -> list[str]:
        """now [s]: of the machine's clock."""
        notes, waiting = [], []
        for link in links:
            if link.ok:
                self._told.pop(link.name, None)
                self._since.pop(link.name, None)
                continue
            # "for 4 s" is the same reason a second later.
            reason = re.sub(r"\d+", "#", link.text)
            since = self._since.setdefault(link.name, now)
            if self._told.get(link.name) != reason:
                self._told[link.name] = reason
                notes.append(f"{link.name}: {link.text}")
            else:
                waiting.append(f"{link.name} {now - since:.0f} s")
        return [*notes, f"waiting for {', '.join(waiting)}"] if waiting else notes


class HealthPublisher:
    """`health/<id>` once a second, and the same to all who look after this agent: files, the console, systemd."""

    def __init__(
        self,
        health: Health,
        transport: Transport,
        notices: PilotNotices,
        console: Console,
        supervisor: Notifier,
        *,
        drone_id: int,
        wall: Clock,
        recorder: FlightRecorder | None,
        file: HealthFile | None,
        also: Callable[[HealthMessage], None] | None = None,
    ) -> None:
        self._drone_id = drone_id
        self._health = health
        self._transport = transport
        self._notices = notices
        self._console = console
        self._supervisor = supervisor
        self._wall = wall
        self._recorder = recorder
        self._file = file
        self._also = also
        self._troubles = Troubles()

    async def run(self) -> None:
        """Until cancelled."""
        self._health.message()  # starts the meters
        while True:
            await asyncio.sleep(periods.HEALTH_PERIOD_S)
            self._publish()

    def _publish(self) -> None:
        self._note_trouble_of_the_disk()
        self._health.drops["status_texts_untold"] = self._notices.lines.untold
        message = self._health.message()
        if self._recorder is not None:
            self._recorder.health(message)
        self._notices.see_links(message.links)
        try:
            self._transport.publish(Kind.HEALTH, codec.encode(message))
        except ValueError:
            self._health.drops["unsendable_health"] += 1
        if self._also is not None:
            self._also(message)
        self._write(message)
        self._console.line(self._footnotes())
        assert message.readiness is not None
        readiness = message.readiness
        self._supervisor.status("ready" if readiness.ready else "; ".join(readiness.reasons))

    def _note_trouble_of_the_disk(self) -> None:
        news = self._recorder.take_news() if self._recorder is not None else None
        if news is not None:
            self._health.events.append(news)
            log.warning(news)

    def _write(self, message: HealthMessage) -> None:
        if self._file is None:
            return
        now, tracked_at = self._wall.now(), self._health.tracked_at
        age = None if tracked_at is None else now - tracked_at
        self._file.write(as_record(message), drone_id=self._drone_id, now=now, frame_age_s=age)
        self._health.drops["health_files"] = self._file.failed

    def _footnotes(self) -> list[str]:
        """How the agent is doing, for a line of the console."""
        rates = self._health.rates
        each = [rate.got_hz for name, rate in rates.items() if name.startswith("detections_")]
        seen = " + ".join(f"{hz:.0f}" for hz in each or [rates["detections"].got_hz])
        notes = [f"tracks {rates['tracks'].got_hz:.0f} Hz", f"camera{'s' * bool(each)} {seen} Hz"]
        if rates["imu"].asked_hz is not None:
            notes.append(f"gyro {rates['imu'].got_hz:.0f} Hz")
        if (carried := self._health.carried) is not None:
            notes.append(held_in_words(carried.by, carried.sigma_m))
        return notes + self._troubles.notes(self._health.links(), self._wall.now())
