"""Listening socket for viewers: a bounded number of connections, each with a time limit for its request.

Theory of operation. Every connection is accepted, so the queue in front of us cannot fill. At most MAX_CONNECTIONS
stand at a time: one more replaces the one that has owed us a request for the longest, or, if none does, the one whose
last request is the oldest. An open page (a WebSocket; the server allows some dozens) is never replaced. So connections
of a flood that send nothing push each other out, and a browser, which asks at once, gets in.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from swarmtrack.errors import SwarmtrackError
from swarmtrack.plain_text import plain

log = logging.getLogger(__name__)

MAX_CONNECTIONS = 100
HEADERS_S = 5.0  # from a connection, or from an answer on it, to all headers of a request
REQUEST_ANSWER_S = 30.0  # from there to the end of the answer, over a slow radio
WAITING_CONNECTIONS = (
    4096  # waiting to be accepted, or what the kernel allows: who comes on top tries again after a second
)
SWEEP_S = 0.5
# s between two lines about the same kind of trouble; a flood of it is a number in the next line.
SAY_AGAIN_S = 10.0


Serve = Callable[[], asyncio.BaseProtocol]
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class CertificateError(SwarmtrackError):
    """A certificate or key that TLS cannot use."""


def tls_context(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    """To serve with; None: without TLS. Raises CertificateError."""
    if certificate is None and key is None:
        return None
    if certificate is None or key is None:
        raise CertificateError(
            f"{'--key' if key else '--certificate'} alone, expected --certificate FILE and --key FILE"
        )
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        reason = error.strerror or str(error)
        raise CertificateError(
            f"--certificate {certificate} --key {key}: {reason}, expected a certificate and its own key, both PEM"
        ) from None
    return context


class SparingLog(logging.LoggerAdapter[logging.Logger]):
    """Log of aiohttp and of the monitor: one line per kind of fault, at most every SAY_AGAIN_S."""

    def __init__(self, now: Callable[[], float]) -> None:
        super().__init__(log, None)
        self._now = now
        self._said: dict[str, float] = {}
        self._unsaid: dict[str, int] = {}

    def log_limited(self, kind: str, text: str, *, bug: BaseException | None = None) -> None:
        """bug: logged with its traceback."""
        now = self._now()
        if now - self._said.get(kind, -SAY_AGAIN_S) < SAY_AGAIN_S:
            self._unsaid[kind] = self._unsaid.get(kind, 0) + 1
            return
        self._said[kind] = now
        more = self._unsaid.pop(kind, 0)
        counted = f" ({more} more like it since the last line)" if more else ""
        log.warning("monitor: %s%s", text, counted, exc_info=bug)

    def exception(self, msg: object, *args: object, **more: Any) -> None:
        """aiohttp's word for a request that is none, and for a bug in answering one."""
        error = more.get("exc_info")
        sentence = str(msg) % args
        if isinstance(error, HttpProcessingError):
            reason = plain(error.message.split("\n", maxsplit=1)[0], 120)
            self.log_limited("malformed", f"a malformed request was refused ({sentence}: {reason})")
        else:
            self.log_limited("bug", sentence, bug=error if isinstance(error, BaseException) else None)

    def on_loop_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """For the event loop: a connection that breaks is its own affair, all else is shown."""
        error = context.get("exception")
        if isinstance(error, OSError):
            self.log_limited("broken", f"a connection broke: {plain(str(error))}")
        else:
            loop.default_exception_handler(context)


@dataclass(slots=True, eq=False)
class Connection:
    """One connection. since [s]: when it came, or last asked; is_page: it is an open page now."""

    since: float
    has_asked: bool = False
    is_page: bool = False
    transport: asyncio.Transport | None = None
    task: asyncio.Task[None] | None = None
    """Which opens the transport; TLS takes its time."""

    @property
    def is_gone(self) -> bool:
        if self.transport is not None:
            return self.transport.is_closing()
        return self.task is not None and self.task.done()

    def is_overdue(self, now: float) -> bool:
        return not self.is_page and now - self.since > (REQUEST_ANSWER_S if self.has_asked else HEADERS_S)

    def end(self) -> None:
        if self.transport is not None:
            self.transport.abort()
        elif self.task is not None:
            self.task.cancel()


class Entrance:
    """Listens for an application. `prepare` it before it is set up; then `open`, and at the end `close`."""

    def __init__(self, tls: ssl.SSLContext | None, trouble: SparingLog) -> None:
        self.address: tuple[str, int] = ("", 0)
        """host and port, once it is open."""
        self._tls = tls
        self._trouble = trouble
        self._connections: dict[object, Connection] = {}
        """By the protocol that speaks on it."""
        self._tasks: list[asyncio.Task[None]] = []
        self._sockets: list[socket.socket] = []

    def prepare(self, application: web.Application) -> None:
        """Have it say who has asked, and who is an open page."""
        application.middlewares.append(self._note_request)
        application.on_response_prepare.append(self._note_page)

    async def open(self, host: str, port: int, serve: Serve) -> None:
        """serve: makes the protocol of one connection. Raises OSError where it cannot listen there."""
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, _, _, _, address in dict.fromkeys(found):
            listening = socket.socket(family, socket.SOCK_STREAM)
            self._sockets.append(listening)
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                listening.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            # Of several addresses all get the port that the first one found free.
            listening.bind((address[0], self.address[1] or port, *address[2:]))
            listening.listen(WAITING_CONNECTIONS)
            listening.setblocking(False)
            self.address = self.address if self.address[1] else listening.getsockname()[:2]
            self._tasks.append(asyncio.create_task(self._accept(listening, serve), name="entrance"))
        self._tasks.append(asyncio.create_task(self._sweep(), name="sweep"))

    async def close(self) -> None:
        """Accept no more connections. Closing the open ones is left to the application."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for listening in self._sockets:
            listening.close()

    @web.middleware
    async def _note_request(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        connection = self._connections.get(request.protocol)
        if connection is not None:
            connection.has_asked, connection.since = True, asyncio.get_running_loop().time()
        return await handler(request)

    async def _note_page(self, request: web.Request, response: web.StreamResponse) -> None:
        connection = self._connections.get(request.protocol)
        if connection is not None and isinstance(response, web.WebSocketResponse):
            connection.is_page = True

    async def _accept(self, listening: socket.socket, serve: Serve) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                accepted, _ = await loop.sock_accept(listening)
            except ConnectionError:  # it left while it waited
                continue
            except OSError as error:
                self._trouble.log_limited(
                    "full", f"no viewer can connect: {error.strerror} (see ulimit -n); trying again"
                )
                self._make_room(MAX_CONNECTIONS // 2)
                await asyncio.sleep(SWEEP_S)
                continue
            self._make_room(MAX_CONNECTIONS - 1)
            protocol, connection = serve(), Connection(loop.time())
            self._connections[protocol] = connection
            connection.task = asyncio.create_task(self._let_in(connection, protocol, accepted))
            # While others wait to be accepted, nothing else would have its turn.
            await asyncio.sleep(0)

    async def _let_in(
        self, connection: Connection, protocol: asyncio.BaseProtocol, accepted: socket.socket
    ) -> None:
        loop, limit = asyncio.get_running_loop(), HEADERS_S if self._tls else None
        # Who cannot do TLS, or hangs up meanwhile, is gone.
        with contextlib.suppress(OSError):
            connection.transport, _ = await loop.connect_accepted_socket(
                lambda: protocol, accepted, ssl=self._tls, ssl_handshake_timeout=limit
            )

    def _make_room(self, most: int) -> None:
        """Let at most `most` connections stand. Those go first that have kept us waiting for the longest."""
        self._connections = {key: one for key, one in self._connections.items() if not one.is_gone}
        excess = len(self._connections) - most
        if excess <= 0:
            return
        guests = [one for one in self._connections.values() if not one.is_page]
        for one in sorted(guests, key=lambda one: (one.has_asked, one.since))[:excess]:
            one.end()

    async def _sweep(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(SWEEP_S)
            for one in self._connections.values():
                if one.is_overdue(loop.time()):
                    one.end()
