"""The monitor's web side: one page, and one WebSocket to each viewer.

Theory of operation. A viewer is sent the state STATE_HZ times a second, and the pictures of the cameras it watches as
they come. Each has one slot for the state and one for each picture: what is newer takes the place of what still waits.
The page acknowledges each message once it is drawn, and gets the next handful only then, so that a slow phone sees
fewer pictures and never older ones; no buffer on the way can fill. A camera's pictures are subscribed to while at least
one viewer watches them.

To the page: text, the state (`Team.state`); binary, a header's length (uint32, little endian), the header in JSON
(`drone`, `camera` from 0, `width`, `height`, `boxes`) and the JPEG. From the page: `{"watch": [[ID, camera]]}`, `"+"`
for each message drawn, and of a recording `{"seek": s}`, `{"play": true}` and `{"speed": 2}`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from aiohttp import WSCloseCode, WSMsgType, web

from swarmtrack.monitor.access import AccessGuard
from swarmtrack.monitor.drone_cameras import ViewKey
from swarmtrack.wire.video import VideoMessage

if TYPE_CHECKING:
    from foxglove.messages import Timestamp

    from swarmtrack.monitor.foxglove_scenes import Written

PAGE = Path(__file__).parent / "page" / "index.html"
STATE_HZ = 5.0
MAX_VIEWERS = 32
MAX_WATCHED = 64  # cameras, by one viewer
MAX_WORD = 2048  # bytes that a page may say at a time
HEARTBEAT_S = 5.0


class Audience(Protocol):
    """Viewers of a feed."""

    @property
    def is_there(self) -> bool:
        """Whether there is a viewer."""

    @property
    def watched(self) -> frozenset[ViewKey]:
        """Cameras shown on at least one page."""

    def broadcast(self, state: dict[str, Any]) -> None: ...
    def show(self, key: ViewKey, view: VideoMessage, boxes: list[dict[str, Any]]) -> None: ...


class Feed(Protocol):
    """Source of states and pictures: a running swarm, or a recording."""

    @property
    def cameras(self) -> tuple[ViewKey, ...]:
        """Cameras that can be watched."""

    async def run(self, audience: Audience) -> None:
        """Run until cancelled, or to its end."""

    def on_watched(self) -> None:
        """The viewers, or what they watch, may have changed."""

    def on_wish(self, wish: dict[str, Any]) -> bool:
        """Another request of a page; returns whether it is known."""

    def scene(self, stamp: Timestamp) -> list[Written]:
        """For Foxglove: all drones, now."""


class Audiences:
    """Several as one."""

    def __init__(self, *audiences: Audience) -> None:
        self._audiences = audiences

    @property
    def is_there(self) -> bool:
        return any(audience.is_there for audience in self._audiences)

    @property
    def watched(self) -> frozenset[ViewKey]:
        return frozenset().union(*(audience.watched for audience in self._audiences))

    def broadcast(self, state: dict[str, Any]) -> None:
        for audience in self._audiences:
            audience.broadcast(state)

    def show(self, key: ViewKey, view: VideoMessage, boxes: list[dict[str, Any]]) -> None:
        for audience in self._audiences:
            audience.show(key, view, boxes)


class OpenPage:
    """One open page."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.watched: frozenset[ViewKey] = frozenset()
        self.replaced = 0
        """Messages that a newer one overtook."""
        self._socket = socket
        self._waiting: dict[str | ViewKey, str | bytes] = {}
        self._news = asyncio.Event()
        self._drawn = asyncio.Event()
        self._unacknowledged = 0

    def offer(self, slot: str | ViewKey, message: str | bytes) -> None:
        """Replace the message of a slot; it is sent once the viewer has drawn the earlier ones."""
        self.replaced += slot in self._waiting
        self._waiting[slot] = message
        self._news.set()

    async def close(self) -> None:
        await self._socket.close(code=WSCloseCode.GOING_AWAY)

    def on_drawn(self) -> None:
        self._unacknowledged = max(0, self._unacknowledged - 1)
        if not self._unacknowledged:
            self._drawn.set()

    async def send(self) -> None:
        """Send until the socket closes."""
        while not self._socket.closed:
            await self._news.wait()
            self._news.clear()
            waiting, self._waiting = self._waiting, {}
            self._drawn.clear()
            self._unacknowledged = len(waiting)
            for message in waiting.values():
                if isinstance(message, str):
                    await self._socket.send_str(message)
                else:
                    await self._socket.send_bytes(message)
            if waiting:
                await self._drawn.wait()


class MonitorServer:
    """Passes the feed's state and pictures to every viewer."""

    def __init__(self, feed: Feed, guard: AccessGuard) -> None:
        self._feed = feed
        self._guard = guard
        self._viewers: set[OpenPage] = set()

    def application(self) -> web.Application:
        application = web.Application(client_max_size=4096)
        application.router.add_get("/", self._serve_page)
        application.router.add_get("/ws", self._serve_viewer)
        application.on_shutdown.append(self._close_viewers)
        return application

    async def run(self, *others: Audience) -> None:
        """Run until cancelled, or until the feed ends. others: further audiences of the feed."""
        await self._feed.run(Audiences(self, *others) if others else self)

    # --- for the feed -------------------------------------------------------------------

    @property
    def is_there(self) -> bool:
        return bool(self._viewers)

    @property
    def watched(self) -> frozenset[ViewKey]:
        return frozenset().union(*(viewer.watched for viewer in self._viewers))

    def broadcast(self, state: dict[str, Any]) -> None:
        text = json.dumps(state, allow_nan=False, separators=(",", ":"))
        for viewer in self._viewers:
            viewer.offer("state", text)

    def show(self, key: ViewKey, view: VideoMessage, boxes: list[dict[str, Any]]) -> None:
        drone_id, camera = key
        header = {
            "drone": drone_id,
            "camera": camera,
            "width": view.width,
            "height": view.height,
            "boxes": boxes,
        }
        text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode()
        message = struct.pack("<I", len(text)) + text + view.jpeg
        for viewer in self._viewers:
            if key in viewer.watched:
                viewer.offer(key, message)

    # --- serving ------------------------------------------------------------------------

    async def _serve_page(self, request: web.Request) -> web.Response:
        reason = self._guard.refuse(request)
        if reason is not None:
            return _refused(403, reason)
        return web.Response(
            text=self._guard.page, content_type="text/html", headers=self._guard.headers(request)
        )

    async def _serve_viewer(self, request: web.Request) -> web.StreamResponse:
        reason = self._guard.refuse(request)
        if reason is not None:
            return _refused(403, reason)
        if len(self._viewers) >= MAX_VIEWERS:
            return _refused(503, f"{MAX_VIEWERS} pages are open already")
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, max_msg_size=MAX_WORD, compress=False)
        await socket.prepare(request)
        viewer = OpenPage(socket)
        self._viewers.add(viewer)
        self._feed.on_watched()
        sending = asyncio.create_task(viewer.send(), name="viewer")
        try:
            async for word in socket:
                if word.type is not WSMsgType.TEXT or not self._on_word(viewer, word.data):
                    break
        finally:
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await sending
            self._viewers.discard(viewer)
            self._feed.on_watched()
        return socket

    def _on_word(self, viewer: OpenPage, word: str) -> bool:
        """Whether it was one that our page says."""
        if word == "+":
            viewer.on_drawn()
            return True
        try:
            wish: Any = json.loads(word)
            if not isinstance(wish, dict) or "watch" not in wish:
                return isinstance(wish, dict) and self._feed.on_wish(wish)
            wished = frozenset((d, k) for d, k in wish["watch"] if type(d) is int and type(k) is int)
        except (ValueError, TypeError, RecursionError):
            return False
        # Only of those that are there: nobody makes us subscribe to a thousand drones that are not.
        viewer.watched = frozenset(sorted(wished.intersection(self._feed.cameras))[:MAX_WATCHED])
        self._feed.on_watched()
        return True

    async def _close_viewers(self, application: web.Application) -> None:
        await asyncio.gather(*(viewer.close() for viewer in list(self._viewers)))


def _refused(status: int, reason: str) -> web.Response:
    """Who is refused gets the connection closed."""
    response = web.Response(status=status, text=f"{status}: {reason}\n")
    response.force_close()
    return response
