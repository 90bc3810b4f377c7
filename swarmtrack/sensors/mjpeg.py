"""`http:` a stream of JPEGs (`multipart/x-mixed-replace`), as IP cameras, phones and mjpg-streamer send it.

A stream rarely says when its images were exposed. If a part carries `X-Timestamp`, seconds as a decimal number, it
is taken as the time of exposure: on our monotonic clock if it lies within a minute of it (a sender on the same
machine), else as UTC of a sender whose clock is synchronised with ours. A stamp that fits neither, or lies in the
future, is counted as `bad_stamps` and the time of arrival is used instead, with `latency_ms` taken off and
`sigma_ms` as its uncertainty.
"""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import AsyncIterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from swarmtrack.messages import Frame, LinkStatus, StampKind
from swarmtrack.runtime.clock import Clock
from swarmtrack.sensors.camera_address import CameraAddress, in_range, read_options, server_url
from swarmtrack.sensors.decode import decode_jpeg
from swarmtrack.sensors.frame_slot import (
    BACKOFF_FIRST,
    BACKOFF_LONGEST,
    FrameSlot,
    Freshness,
    RawFrame,
    start,
    stop,
)
from swarmtrack.sensors.multipart import MultipartReader, Part

if TYPE_CHECKING:
    import aiohttp

STAMP_WINDOW = 2.0  # s: a stamp further from a clock is not of that clock, and no tracker looks back so far
FUTURE = 0.005  # s: a stamp this much after the arrival shows that the two clocks disagree
MONOTONIC_SIGMA = 1e-3  # s
UTC_SIGMA = 5e-3  # s: two machines synchronised over a radio link


@dataclass(frozen=True, slots=True)
class NetworkOptions:
    """Of streams without a time of exposure; shared with `rtsp:`."""

    latency_ms: float = 0.0  # from exposure to arrival, where only the arrival is known
    sigma_ms: float = 50.0  # of the same
    timeout_s: float = 3.0  # without a byte, then the stream is opened anew
    resize: bool = False

    def __post_init__(self) -> None:
        in_range("latency_ms", self.latency_ms, 0, 10_000)
        in_range("sigma_ms", self.sigma_ms, 0.1, 10_000)
        in_range("timeout_s", self.timeout_s, 0.5, 60)


class StreamEnded(Exception):
    """The text says why; the stream is opened again."""


class MjpegCamera:
    """An MJPEG stream over HTTP."""

    def __init__(
        self, address: CameraAddress, *, clock: Clock, size: tuple[int, int] | None, base: Path | None
    ) -> None:
        del base  # a URL is never relative to the config
        self._options = read_options(address, NetworkOptions)
        self._url = server_url(address, NetworkOptions)
        self._clock = clock
        self._slot = FrameSlot(str(address), clock, size, self._options.resize)
        self._task: asyncio.Task[None] | None = None
        self._sequence = 0
        self._bad_stamps = 0
        self._freshness = Freshness(period=1 / 30, depth=30)  # a second in the sockets' buffers

    def frames(self) -> AsyncIterator[Frame]:
        self._task = self._task or start(self._run, self._slot)
        return self._slot.frames()

    def status(self) -> LinkStatus:
        status = self._slot.status()
        return replace(status, counters=(*status.counters, ("bad_stamps", self._bad_stamps)))

    async def close(self) -> None:
        await stop(self._task, self._slot)

    async def _run(self) -> None:
        # Here, not above: 20 MB and 0.2 s that only this camera needs.
        import aiohttp  # noqa: PLC0415

        backoff = BACKOFF_FIRST
        timeout = aiohttp.ClientTimeout(
            total=None, sock_connect=self._options.timeout_s, sock_read=self._options.timeout_s
        )
        async with aiohttp.ClientSession(timeout=timeout, read_bufsize=1 << 20) as session:
            while True:
                sequence = self._sequence
                try:
                    await self._stream(session)
                except StreamEnded as ended:
                    reason = str(ended)
                except TimeoutError:  # before ClientError: aiohttp's own are both
                    reason = f"nothing for {self._options.timeout_s:g} s"
                except aiohttp.ClientConnectorError as error:
                    why = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
                    reason = f"cannot connect to {error.host} port {error.port}: {why}"
                except aiohttp.ClientError as error:
                    reason = f"lost: {error}"
                self._slot.say(False, f"{reason}; trying again")
                if self._sequence > sequence:
                    backoff = BACKOFF_FIRST
                await asyncio.sleep(backoff)
                backoff = min(2 * backoff, BACKOFF_LONGEST)

    async def _stream(self, session: aiohttp.ClientSession) -> None:
        """Feed the slot until the stream breaks."""
        async with session.get(self._url) as response:
            reader = MultipartReader(_boundary(response))
            self._slot.counts.reconnects += self._sequence > 0
            oversized = 0
            async for data in response.content.iter_any():
                for part in reader.feed(data, self._clock.now()):
                    self._receive(part)
                self._slot.counts.corrupt += reader.oversized - oversized
                oversized = reader.oversized
                if reader.ended:
                    break
        raise StreamEnded("the server ended the stream")

    def _receive(self, part: Part) -> None:
        if not part.body:
            return
        self._slot.say(True, "streaming")
        self._sequence += 1
        stamp, t, t_sigma = self._exposure_time(part)
        if stamp is StampKind.EXPOSURE and self._freshness.is_stale(t, self._sequence, part.arrived):
            self._slot.counts.stale += 1
            return
        self._slot.put(RawFrame(t, t_sigma, self._sequence, stamp, decode=lambda: decode_jpeg(part.body)))

    def _exposure_time(self, part: Part) -> tuple[StampKind, float, float]:
        """(kind of stamp, time of exposure [s], its sigma [s])."""
        text = part.headers.get("x-timestamp")
        if text is not None:
            now = self._clock.now()
            for clock_now, sigma in ((now, MONOTONIC_SIGMA), (self._clock.utc(), UTC_SIGMA)):
                t = now + _number(text) - clock_now
                if abs(t - now) < STAMP_WINDOW and t < part.arrived + FUTURE:
                    return StampKind.EXPOSURE, t, sigma
            self._bad_stamps += 1
        options = self._options
        return StampKind.ARRIVAL, part.arrived - 1e-3 * options.latency_ms, 1e-3 * options.sigma_ms


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _boundary(response: aiohttp.ClientResponse) -> str:
    """The boundary of a stream, or StreamEnded with what it is instead."""
    if response.status != 200:
        hint = {401: ": give user and password, http://USER:PASSWORD@HOST/…", 404: ": check the path"}
        raise StreamEnded(f"HTTP {response.status} {response.reason}{hint.get(response.status, '')}")
    if response.content_type != "multipart/x-mixed-replace":
        raise StreamEnded(
            f"is {response.content_type}, expected a stream of JPEGs, multipart/x-mixed-replace"
        )
    found = response.headers.get("Content-Type", "").partition("boundary=")[2].partition(";")[0]
    if not found.strip(' "-'):
        raise StreamEnded("announces no boundary between its images")
    return found
