"""Streams that do not end: a small HTTP server that sends them, and what takes the first of one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from typing import TypeVar

import cv2
import numpy as np
import pytest
from aiohttp import web

from support.patience import PATIENCE
from swarmtrack.sources import Camera, DetectionSource

Send = Callable[[bytes], Awaitable[None]]
Script = Callable[[Send], Awaitable[None]]
T = TypeVar("T")


class StreamServer:
    """Runs `script` for each connection; without one, the connection stays open and silent."""

    def __init__(self, content_type: str) -> None:
        self.script: Script = keep_silent
        self.content_type = content_type
        self.status = 200
        self.connections = 0
        self.url = ""

    async def stream(self, request: web.Request) -> web.StreamResponse:
        self.connections += 1
        response = web.StreamResponse(status=self.status, headers={"Content-Type": self.content_type})
        await response.prepare(request)
        await self.script(response.write)
        return response


@asynccontextmanager
async def stream_server(path: str, content_type: str) -> AsyncIterator[StreamServer]:
    server = StreamServer(content_type)
    application = web.Application()
    application.router.add_get(path, server.stream)
    runner = web.AppRunner(application, shutdown_timeout=0.1, handler_cancellation=True)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    server.url = f"http://127.0.0.1:{runner.addresses[0][1]}{path}"
    yield server
    await runner.cleanup()


async def keep_silent(send: Send) -> None:
    await asyncio.Event().wait()


async def hang_up(send: Send) -> None:
    """The connection ends with its script."""


def sending(
    *messages: bytes, then: Script = keep_silent, source: Camera | DetectionSource | None = None
) -> Script:
    """source: each message waits until it has dealt with the one before; newest-only would drop what comes together."""

    async def script(send: Send) -> None:
        for sent, message in enumerate(messages, start=1):
            await send(message)
            while source is not None and dealt_with(source) < sent:  # noqa: ASYNC110
                await asyncio.sleep(0.002)
        await then(send)

    return script


def repeating(message: bytes) -> Script:
    async def script(send: Send) -> None:
        while True:
            await send(message)
            await asyncio.sleep(0.02)

    return script


def dealt_with(source: Camera | DetectionSource) -> float:
    """How many frames were taken or refused."""
    count = counters(source)
    return sum(count[name] for name in ("frames", "corrupt", "wrong_size"))


async def first(count: int, stream: AsyncIterator[T]) -> list[T]:
    """So many of what comes."""
    taken: list[T] = []
    async with asyncio.timeout(PATIENCE):
        async for one in stream:
            taken.append(one)
            if len(taken) == count:
                break
    return taken


async def status_with(source: Camera | DetectionSource, words: str) -> None:
    """Wait until it says so."""
    async with asyncio.timeout(PATIENCE):
        while words not in source.status().text:  # noqa: ASYNC110
            await asyncio.sleep(0.02)


async def nothing_comes_but(
    words: str, source: Camera | DetectionSource, stream: AsyncIterator[object]
) -> None:
    """The source says so, that it is not well, and gives nothing; then it is closed."""
    taking = asyncio.create_task(first(1, stream))
    await status_with(source, words)
    assert not source.status().ok
    async with asyncio.timeout(PATIENCE):
        await source.close()
    assert await taking == []


def assert_two_are_stamped(times: Sequence[float], now: float, after: float) -> None:
    """The first two said that they are of 0.3 s before `now`, on our clock and in UTC; the rest came 40 ms late."""
    assert times[0] == pytest.approx(now - 0.3, abs=1e-6)
    assert times[1] == pytest.approx(now - 0.3, abs=1e-2)
    assert all(now - 0.04 < t < after - 0.04 for t in times[2:])


def counters(source: Camera | DetectionSource) -> dict[str, float]:
    return dict(source.status().counters)


def jpeg(level: int, width: int = 64, height: int = 48) -> bytes:
    """A grey image."""
    encoded: bytes = cv2.imencode(".jpg", np.full((height, width, 3), level, np.uint8))[1].tobytes()
    return encoded


def part(body: bytes, *headers: str, length: bool = True) -> bytes:
    """A part of a stream with the boundary `frame`."""
    lines = ["--frame", "Content-Type: image/jpeg", *headers]
    if length:
        lines.append(f"Content-Length: {len(body)}")
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body + b"\r\n"
