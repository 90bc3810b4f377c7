"""The monitor's entrance: floods of connections, of nonsense and of silence, and TLS."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import re
import ssl
from collections.abc import AsyncIterator

import aiohttp
import pytest
from aiohttp import web

from support.certificates import certificate
from support.patience import PATIENCE, eventually
from swarmtrack.log_lines import PlainFormatter
from swarmtrack.monitor import entrance as entrances
from swarmtrack.monitor.access import AccessGuard
from swarmtrack.monitor.entrance import (
    MAX_CONNECTIONS,
    CertificateError,
    Entrance,
    SparingLog,
    tls_context,
)
from swarmtrack.monitor.server import MAX_VIEWERS, PAGE, MonitorServer

HALF_OPEN = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Never-"


class NoFeed:
    """Nobody to watch."""

    drones = ()

    def on_watched(self) -> None:
        """Nothing changes."""


class Served:
    """A monitor's page, without a swarm."""

    def __init__(self, tls: ssl.SSLContext | None = None) -> None:
        self.trouble = SparingLog(asyncio.get_running_loop().time)
        self.entrance = Entrance(tls, self.trouble)
        self.server = MonitorServer(NoFeed(), AccessGuard(None, PAGE.read_text(encoding="utf-8")))
        self._secure = tls is not None

    @property
    def url(self) -> str:
        return f"http{'s' if self._secure else ''}://127.0.0.1:{self.entrance.address[1]}/"

    async def connect(self, say: bytes = b"") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection("127.0.0.1", self.entrance.address[1])
        writer.write(say)
        return reader, writer


@contextlib.asynccontextmanager
async def served(tls: ssl.SSLContext | None = None) -> AsyncIterator[Served]:
    one = Served(tls)
    application = one.server.application()
    one.entrance.prepare(application)
    runner = web.AppRunner(application, access_log=None, shutdown_timeout=0.1, logger=one.trouble)
    await runner.setup()
    await one.entrance.open("127.0.0.1", 0, runner.server)
    try:
        yield one
    finally:
        await one.entrance.close()
        await runner.cleanup()


async def is_open(reader: asyncio.StreamReader) -> bool:
    """Whether the other end has neither answered nor hung up by now."""
    try:
        async with asyncio.timeout(0.01):
            await reader.read(1)
    except TimeoutError:
        return True
    except ConnectionError:
        pass
    return False


async def status_of(url: str, http: aiohttp.ClientSession) -> int:
    async with asyncio.timeout(PATIENCE), http.get(url) as response:
        await response.read()
        return response.status


async def test_the_page_answers_beside_hundreds_of_half_open_connections_and_an_open_page_stays():
    async with served() as one, aiohttp.ClientSession() as http:
        async with http.ws_connect(f"{one.url}ws") as page:
            guests = [await one.connect(HALF_OPEN) for _ in range(4 * MAX_CONNECTIONS)]
            assert await status_of(one.url, http) == 200
            first, last = guests[: len(guests) // 2], guests[-MAX_CONNECTIONS // 2 :]
            assert not any([await is_open(reader) for reader, _ in first])
            assert all([await is_open(reader) for reader, _ in last])  # nobody is turned out without need
            await page.send_str("+")
            assert not page.closed
            one.server.broadcast({"anything": 1})
            async with asyncio.timeout(PATIENCE):
                assert (await page.receive()).json() == {"anything": 1}
        for _, writer in guests:
            writer.close()


async def test_who_does_not_say_what_it_wants_is_sent_away_in_time(monkeypatch):
    monkeypatch.setattr(entrances, "HEADERS_S", 0.3)
    monkeypatch.setattr(entrances, "SWEEP_S", 0.05)
    async with served() as one, aiohttp.ClientSession() as http, http.ws_connect(f"{one.url}ws") as page:
        for said in (b"", HALF_OPEN):
            reader, writer = await one.connect(said)
            async with asyncio.timeout(PATIENCE):
                with contextlib.suppress(ConnectionError):
                    assert await reader.read() == b""
            writer.close()
        await page.send_str("+")
        assert not page.closed


async def test_who_has_its_answer_and_asks_no_more_is_sent_away_too(monkeypatch):
    monkeypatch.setattr(entrances, "REQUEST_ANSWER_S", 0.3)
    monkeypatch.setattr(entrances, "SWEEP_S", 0.05)
    async with served() as one:
        reader, writer = await one.connect(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        async with asyncio.timeout(PATIENCE):
            with contextlib.suppress(ConnectionError):
                await reader.read()
        writer.close()


async def test_more_open_pages_than_anybody_needs_are_refused():
    async with served() as one, aiohttp.ClientSession() as http, contextlib.AsyncExitStack() as pages:
        for _ in range(MAX_VIEWERS):
            await pages.enter_async_context(http.ws_connect(f"{one.url}ws"))
        with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
            await http.ws_connect(f"{one.url}ws")


async def test_running_out_of_descriptors_is_said_once_and_heals(monkeypatch, caplog):
    monkeypatch.setattr(entrances, "SWEEP_S", 0.01)
    loop, failures = asyncio.get_running_loop(), 0
    accept = loop.sock_accept

    async def out_of_descriptors(listening):
        nonlocal failures
        failures += 1
        if failures <= 50:
            raise OSError(errno.EMFILE, "Too many open files")
        return await accept(listening)

    monkeypatch.setattr(loop, "sock_accept", out_of_descriptors)
    async with served() as one, aiohttp.ClientSession() as http:
        assert await status_of(one.url, http) == 200
    assert caplog.messages == [
        "monitor: no viewer can connect: Too many open files (see ulimit -n); trying again"
    ]


@pytest.mark.parametrize(
    "nonsense",
    [
        b"POST / HTTP/1.1\r\nHost: a\r\nContent-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\nabc",
        b"GET /?token=\xff\xfe HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\x1b[2J: 1\r\n\r\n",
    ],
    ids=["smuggling", "no text", "a header that commands the terminal"],
)
async def test_malformed_requests_are_a_line_and_no_traceback(nonsense, caplog):
    shown = PlainFormatter("%(message)s")
    async with served() as one, aiohttp.ClientSession() as http:
        for _ in range(20):
            reader, writer = await one.connect(nonsense)
            async with asyncio.timeout(PATIENCE):
                assert b" 400 " in await reader.readline()
            writer.close()
        assert await status_of(one.url, http) == 200
    (line,) = (shown.format(record) for record in caplog.records if record.levelno >= logging.WARNING)
    assert line.startswith("monitor: a malformed request was refused")
    assert "\n" not in line


async def test_a_token_in_no_encoding_is_a_wrong_token():
    guard = AccessGuard("right-token", PAGE.read_text(encoding="utf-8"))
    server = MonitorServer(NoFeed(), guard)
    runner = web.AppRunner(server.application(), access_log=None)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    reader, writer = await asyncio.open_connection(*runner.addresses[0][:2])
    writer.write(b"GET /?token=%ff%ed%a0%80 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    async with asyncio.timeout(PATIENCE):
        answer = await reader.read()
    assert b" 403 " in answer.split(b"\r\n")[0]
    assert b"Connection: close" in answer
    writer.close()
    await runner.cleanup()


def test_a_bug_is_shown_with_where_it_came_from_and_a_flood_of_it_is_counted(caplog):
    now = 0.0
    trouble = SparingLog(lambda: now)
    for _ in range(1000):
        trouble.exception("Error handling request from %s", "127.0.0.1", exc_info=ZeroDivisionError("x"))
    assert len(caplog.records) == 1
    assert caplog.records[0].exc_info is not None
    now = 11.0
    trouble.exception("Error handling request from %s", "127.0.0.1", exc_info=ZeroDivisionError("x"))
    assert caplog.messages[1] == (
        "monitor: Error handling request from 127.0.0.1 (999 more like it since the last line)"
    )


# --- TLS ------------------------------------------------------------------------------------------


async def test_with_a_certificate_the_page_comes_by_tls_and_in_no_other_way(tmp_path, caplog):
    pem, key = certificate(tmp_path)
    trusted = ssl.create_default_context(cafile=str(pem))
    async with served(tls_context(pem, key)) as one, aiohttp.ClientSession() as http:
        url = one.url.replace("127.0.0.1", "localhost")
        async with http.get(url, ssl=trusted) as response:
            assert response.status == 200
            assert "wss://localhost" in response.headers["Content-Security-Policy"]
        async with http.ws_connect(f"{url}ws", ssl=trusted) as page:
            one.server.broadcast({"anything": 1})
            async with asyncio.timeout(PATIENCE):
                assert (await page.receive()).json() == {"anything": 1}
        for said in (b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", b"\x16\x03\x01\x00\x05junk!"):
            reader, writer = await one.connect(said)
            async with asyncio.timeout(PATIENCE):
                with contextlib.suppress(ConnectionError):
                    assert b"HTTP" not in await reader.read()
            writer.close()
    assert not caplog.messages


async def test_who_begins_no_tls_takes_no_place_either(tmp_path, monkeypatch):
    monkeypatch.setattr(entrances, "HEADERS_S", 0.3)
    monkeypatch.setattr(entrances, "SWEEP_S", 0.05)
    async with served(tls_context(*certificate(tmp_path))) as one:
        guests = [await one.connect() for _ in range(2 * MAX_CONNECTIONS)]
        await eventually(lambda: all(reader.at_eof() or reader.exception() for reader, _ in guests))
        for _, writer in guests:
            writer.close()


def test_what_tls_cannot_use_is_said(tmp_path):
    pem, key = certificate(tmp_path / "a")
    _, other = certificate(tmp_path / "b")
    assert tls_context(None, None) is None
    for arguments, said in (
        ((pem, None), "--certificate alone, expected --certificate FILE and --key FILE"),
        ((None, key), "--key alone"),
        ((pem, tmp_path / "none"), "No such file"),
        ((pem, other), "expected a certificate and its own key"),
        ((key, key), "expected a certificate"),
    ):
        with pytest.raises(CertificateError, match=re.escape(said)):
            tls_context(*arguments)
