"""Feed of a running swarm: samples as they arrive; once a flight is over, its verdict, and the flight again."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TYPE_CHECKING, Any, Protocol

from swarmtrack.errors import TransportError
from swarmtrack.monitor.drone_cameras import ViewKey
from swarmtrack.monitor.overlay import boxes
from swarmtrack.monitor.player import Playback, RecordingPlayer
from swarmtrack.monitor.server import STATE_HZ, Audience
from swarmtrack.monitor.team import MonitoredTeam, told_end
from swarmtrack.monitor.timeline import SeenFlight
from swarmtrack.outputs.flight_end import FlightEnd
from swarmtrack.transport import keys
from swarmtrack.transport.base import Sample
from swarmtrack.transport.listening import hint_at, other_teams
from swarmtrack.wire.video import VideoMessage

if TYPE_CHECKING:
    from foxglove.messages import Timestamp

    from swarmtrack.monitor.foxglove_scenes import Written

log = logging.getLogger(__name__)

LIVE_PEERS_PERIOD_S = 3.0  # between two looks at who else is there


class Listener(Protocol):
    """The used part of a `ZenohListener`."""

    def samples(self) -> AsyncIterator[Sample]: ...
    async def listen_to(self, key_expression: str) -> None: ...
    async def leave(self, key_expression: str) -> None: ...
    async def teams(self) -> set[str]: ...


class LiveFeed:
    """A camera's pictures are subscribed to while at least one viewer watches them."""

    def __init__(
        self,
        team: MonitoredTeam,
        listener: Listener,
        ending: Callable[[], Awaitable[FlightEnd | None]] | None = None,
    ) -> None:
        """ending: returns at the end of the flight, from when on the page stays as it is, and again with its verdict;
        then None."""
        self._team = team
        self._listener = listener
        self._ending = ending
        team.starting = ending is not None
        self._last: dict[str, Any] | None = None
        self._seen = SeenFlight(team.name) if ending is not None else None
        self._again: RecordingPlayer | None = None
        self._replays = asyncio.Event()
        self._subscribed: set[ViewKey] = set()
        self._wishes = asyncio.Event()

    @property
    def cameras(self) -> tuple[ViewKey, ...]:
        return self._team.cameras if self._again is None else self._again.cameras

    async def run(self, audience: Audience) -> None:
        """Run until cancelled, or until the listener is closed."""
        async with asyncio.TaskGroup() as tasks:
            others = [
                tasks.create_task(self._tell_state(audience), name="state"),
                tasks.create_task(self._follow_wishes(audience), name="wishes"),
                tasks.create_task(self._look_around(), name="others"),
            ]
            if self._ending is not None:
                others.append(tasks.create_task(self._keep_the_end(self._ending), name="ending"))
                others.append(tasks.create_task(self._play_again(audience), name="again"))
            await self._hear(audience)
            for task in others:
                task.cancel()

    def on_watched(self) -> None:
        self._wishes.set()
        if self._again is not None:
            self._again.on_watched()

    def on_wish(self, wish: dict[str, Any]) -> bool:
        """`{"again": true}` plays a flight that is over, `{"again": false}` goes back to its verdict. What is live is
        neither paused nor wound back."""
        match wish:
            case {"again": True} if self._last is not None:
                self._replays.set()
                return True
            case {"again": False} if self._last is not None:
                self._again = None
                self._replays.clear()
                self._wishes.set()
                return True
        return self._again is not None and self._again.on_wish(wish)

    def scene(self, stamp: Timestamp) -> list[Written]:
        # Here, not above: only `--foxglove` needs the SDK.
        from swarmtrack.monitor.foxglove_scenes import scene_of  # noqa: PLC0415

        return scene_of(self._team, stamp) if self._again is None else self._again.scene(stamp)

    async def _keep_the_end(self, ending: Callable[[], Awaitable[FlightEnd | None]]) -> None:
        while (end := await ending()) is not None:
            if self._last is None:
                self._last = self._team.state_at_end(end)
            else:
                self._last |= told_end(end)
            self._last["again"] = self._seen is not None and self._seen.timeline is not None
            self._wishes.set()

    async def _play_again(self, audience: Audience) -> None:
        """What this monitor heard of the flight, with the pictures that somebody looked at, while that is wanted."""
        while True:
            await self._replays.wait()
            timeline = None if self._seen is None else self._seen.timeline
            if timeline is None:
                return
            playback = await asyncio.to_thread(Playback, timeline)
            if not self._replays.is_set():
                continue
            self._again = RecordingPlayer(playback, "of this flight", {"again": True})
            playing = asyncio.create_task(self._again.run(audience))
            while self._again is not None:  # noqa: ASYNC110 (until somebody asks for the verdict)
                await asyncio.sleep(1.0 / STATE_HZ)
            playing.cancel()

    async def _hear(self, audience: Audience) -> None:
        async for sample in self._listener.samples():
            if self._last is not None:
                continue
            if self._seen is not None:
                self._seen.add(sample, self._team.utc_of(sample.arrived))
            view = self._team.on_sample(sample)
            # Else it is a last one, after the last viewer went.
            if view is not None and view.key in audience.watched:
                self._show(audience, view.key, view.message)

    async def _tell_state(self, audience: Audience) -> None:
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            if self._last is None:
                self._team.refresh()  # unwatched, too: events have their times, and the gone their age
            if audience.is_there and self._again is None:
                self._tell(audience)
            due = max(due + 1.0 / STATE_HZ, loop.time())
            await asyncio.sleep(due - loop.time())

    def _tell(self, audience: Audience) -> None:
        with self._team.leaves_out("the team's state"):
            audience.broadcast(self._last or self._team.state())
            return
        self._team.forget_untellable()  # and the next one is told

    async def _look_around(self) -> None:
        """While nobody of the team is there, find out who is; said on the page, and once on the terminal."""
        said = False
        while True:
            await asyncio.sleep(LIVE_PEERS_PERIOD_S)
            if self._team.drones or self._team.starting:
                continue
            self._team.hint = hint = hint_at(await other_teams(self._listener, self._team.name))
            if hint and not said:
                said = True
                log.warning("no drone of team %s is found; %s", self._team.name, hint)

    async def _follow_wishes(self, audience: Audience) -> None:
        """Subscribe to the video that somebody watches, and to no other."""
        while True:
            await self._wishes.wait()
            self._wishes.clear()
            wanted = audience.watched
            if self._last is not None:
                if self._again is None:
                    self._show_last_pictures(audience, wanted)
                continue
            try:
                for one in wanted - self._subscribed:
                    await self._listener.listen_to(keys.video_key(self._team.name, *one))
                    self._subscribed.add(one)
                for one in self._subscribed - wanted:
                    self._subscribed.discard(one)
                    await self._listener.leave(keys.video_key(self._team.name, *one))
            except TransportError as error:
                log.warning("video: %s", error)

    def _show_last_pictures(self, audience: Audience, watched: frozenset[ViewKey]) -> None:
        """After the flight: those that somebody looked at in it."""
        for key in watched:
            view = self._team.last_view(key)
            if view is not None:
                self._show(audience, key, view)

    def _show(self, audience: Audience, key: ViewKey, view: VideoMessage) -> None:
        drone_id, camera = key
        with self._team.leaves_out("a picture", drone_id):
            tracks = self._team.tracks_at(drone_id, view.t_utc_s)
            audience.show(key, view, boxes(view, tracks, camera, self._team.rig(drone_id)))
