"""The monitor's second door: Foxglove and Lichtblick connect to the team as to a robot (`foxglove_scenes`).

Theory of operation. The server is one more viewer of the feed, next to the pages. It is there while a client subscribes
to a topic, and watches the cameras whose pictures a client subscribes to. The SDK serves in threads of its own: what
its clients ask for is handed to the event loop. A recording can be played, paused and sought by the app's own bar.

The SDK knows no tokens and no origins, so the server listens on this machine only.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Any

import foxglove
from foxglove import Channel, Context
from foxglove.websocket import (
    Capability,
    ChannelView,
    Client,
    PlaybackCommand,
    PlaybackControlRequest,
    PlaybackState,
    PlaybackStatus,
    ServerListener,
    WebSocketServer,
)

from swarmtrack.clock import Clock
from swarmtrack.errors import TransportError
from swarmtrack.monitor.drone_cameras import ViewKey
from swarmtrack.monitor.foxglove_scenes import SHARED, Written, image_topics, log_of, picture_of
from swarmtrack.monitor.player import SPEEDS
from swarmtrack.monitor.server import Feed
from swarmtrack.outputs.foxglove_views import stamp
from swarmtrack.recording.writer import Topic
from swarmtrack.wire.video import VideoMessage

HOST = "127.0.0.1"
BACKLOG_PER_CLIENT = 64  # messages that wait for one client; beyond it the oldest are dropped
NS_PER_S = 1e9
ADVERTISED_S = 1.0  # s between two looks for new cameras


class FoxgloveServer:
    """Implements `Audience`. clock: of a running swarm; a recording has its own time.

    played: begin of a recording, UTC [s], and its length [s]; None for a running swarm.
    """

    def __init__(
        self, feed: Feed, name: str, clock: Clock, played: tuple[float, float] | None = None
    ) -> None:
        self._feed = feed
        self._name = name
        self._clock = clock
        self._played = played
        self._context = Context()
        self._channels: dict[str, Channel] = {}
        self._pictures: dict[str, ViewKey] = {}
        """By the topic of their images."""
        self._subscribed: Counter[str] = Counter()
        self._server: WebSocketServer | None = None
        self._told_events = 0
        self._now_ns = round(NS_PER_S * (played[0] if played else clock.utc()))
        self._playback: PlaybackState | None = None
        self._advertising: asyncio.Task[None] | None = None

    @property
    def port(self) -> int:
        """Where it listens, once it is open."""
        assert self._server is not None
        return self._server.port

    def open(self, port: int) -> None:
        """Listen. Raises TransportError. To be called in the event loop."""
        foxglove.set_log_level("ERROR")
        for topic in SHARED:
            self._channel(topic)
        self._advertise_cameras()
        span = None
        if self._played is not None:
            begin, seconds = self._played
            span = round(NS_PER_S * begin), round(NS_PER_S * (begin + seconds))
        listener = _Listener(self, asyncio.get_running_loop())
        try:
            self._server = foxglove.start_server(
                name=self._name,
                host=HOST,
                port=port,
                capabilities=[Capability.Time] if span else [],
                server_listener=listener,
                context=self._context,
                playback_time_range=span,
                message_backlog_size=BACKLOG_PER_CLIENT,
            )
        except RuntimeError as error:
            raise TransportError(f"--foxglove {port}: {error}, expected a free port") from None

        self._advertising = asyncio.create_task(self._keep_advertised(), name="foxglove topics")

    def close(self) -> None:
        """Disconnect all clients."""
        if self._advertising is not None:
            self._advertising.cancel()
        if self._server is not None:
            self._server.stop()

    # --- for the feed -------------------------------------------------------------------

    @property
    def is_there(self) -> bool:
        return bool(self._subscribed)

    @property
    def watched(self) -> frozenset[ViewKey]:
        return frozenset(key for topic, key in self._pictures.items() if topic in self._subscribed)

    def broadcast(self, state: dict[str, Any]) -> None:
        """state: as of a page, of which only the time and the events count."""
        if not self.is_there:
            return
        self._follow(state.get("playback"))
        for written in self._feed.scene(stamp(self._now_ns)):
            self._log(written)
        for event in state["events"]:
            if event["n"] > self._told_events:
                self._log(log_of(event, stamp(round(NS_PER_S * event["t_utc_s"]))))
        self._told_events = max((event["n"] for event in state["events"]), default=0)

    def show(self, key: ViewKey, view: VideoMessage, boxes: list[dict[str, Any]]) -> None:
        # A drone that recorded no pictures has boxes all the same, which Foxglove cannot lay on nothing.
        if view.jpeg and key in self.watched:
            for written in picture_of(key, view, boxes, stamp(self._now_ns)):
                self._log(written)

    def _follow(self, playback: dict[str, Any] | None) -> None:
        """The time, and how a recording is played."""
        if playback is None or self._server is None:
            self._now_ns = round(NS_PER_S * self._clock.utc())
            return
        before, self._now_ns = self._now_ns, round(NS_PER_S * (playback["begin_utc_s"] + playback["t_s"]))
        ended = playback["t_s"] >= playback["seconds"]
        status = PlaybackStatus.Playing if playback["playing"] else PlaybackStatus.Paused
        status = PlaybackStatus.Ended if ended else status
        back = self._now_ns < before
        if back:
            self._told_events = 0
        self._server.broadcast_time(self._now_ns)
        state = PlaybackState(status, self._now_ns, playback["speed"], back, None)
        if self._playback is None or back or _differ(state, self._playback):
            self._server.broadcast_playback_state(state)
        self._playback = state

    async def _keep_advertised(self) -> None:
        """So that a client finds the pictures before it subscribes to anything."""
        while True:
            self._advertise_cameras()
            await asyncio.sleep(ADVERTISED_S)

    def _advertise_cameras(self) -> None:
        for key in self._feed.cameras:
            topics = image_topics(key)
            if topics[0].name not in self._channels:
                self._pictures[topics[0].name] = key
                for topic in topics:
                    self._channel(topic)

    def _channel(self, topic: Topic) -> Channel:
        channel = self._channels.get(topic.name)
        if channel is None:
            channel = self._channels[topic.name] = topic.channel(self._context)
        return channel

    def _log(self, written: Written) -> None:
        topic, data = written
        self._channel(topic).log(data, log_time=self._now_ns)

    # --- for its clients ----------------------------------------------------------------

    def on_subscribed(self, topic: str, count: int) -> None:
        """A client subscribed to a topic, or (-1) to it no more."""
        self._subscribed[topic] += count
        self._subscribed = +self._subscribed
        if count > 0:
            self._told_events = 0  # Log panels that open get the last events
        self._feed.on_watched()

    def on_control(self, request: PlaybackControlRequest) -> PlaybackState:
        """Called in the SDK's thread: how it will be played, which `on_wanted` then brings about."""
        now = self._now_ns if request.seek_time is None else request.seek_time
        plays = request.playback_command == PlaybackCommand.Play
        status = PlaybackStatus.Playing if plays else PlaybackStatus.Paused
        speed = min(SPEEDS, key=lambda known: abs(known - request.playback_speed))
        return PlaybackState(status, now, speed, request.seek_time is not None, request.request_id)

    def on_wanted(self, state: PlaybackState) -> None:
        """Play as a client wants it."""
        if self._played is None:
            return
        if state.did_seek and self._feed.on_wish({"seek": state.current_time / NS_PER_S - self._played[0]}):
            # The answer to the client says that it sought: going back is no news.
            self._now_ns, self._told_events = state.current_time, 0
        self._feed.on_wish({"speed": state.playback_speed})
        self._feed.on_wish({"play": state.status == PlaybackStatus.Playing})


def _differ(one: PlaybackState, other: PlaybackState) -> bool:
    return (one.status, one.playback_speed) != (other.status, other.playback_speed)


class _Listener(ServerListener):
    """Hands over from the SDK's threads."""

    def __init__(self, server: FoxgloveServer, loop: asyncio.AbstractEventLoop) -> None:
        self._server = server
        self._loop = loop

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        self._loop.call_soon_threadsafe(self._server.on_subscribed, channel.topic, 1)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        self._loop.call_soon_threadsafe(self._server.on_subscribed, channel.topic, -1)

    def on_playback_control_request(self, playback_control_request: PlaybackControlRequest) -> PlaybackState:
        state = self._server.on_control(playback_control_request)
        self._loop.call_soon_threadsafe(self._server.on_wanted, state)
        return state
