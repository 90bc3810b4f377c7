"""`detections:` a camera that detects by itself, or a detector in another process. No picture reaches the agent.

    detections://127.0.0.1:8091/front

Asked by HTTP GET, the source answers with a stream that does not end: a line of JSON for each frame, also for those in
which nothing was found.

    {"t_s": 123.456789, "sequence": 7, "detections": [[320.5, 240.0, 31.0, 18.5, 0.87]]}

Each detection is centre u, v and size w, h in pixels of the image as the camera gave it (its calibration is needed as
for any camera), and a score in 0 … 1. `t_s` is the middle of the exposure, on CLOCK_MONOTONIC of this machine or in
UTC (`http_stream` says how it is told apart); without it the time of arrival is used. `sequence` counts the camera's
frames, and is the line's own number where it is missing. Empty lines keep the connection.

A Sony IMX500 or a Luxonis OAK becomes such a source by a script on top of the maker's library (docs/examples), and an
agent that has one imports neither OpenCV nor ONNX Runtime.

A line may come late: its detections still hold at their exposure, so unlike a picture it is not weighed against the
freshest. `camera.max_age_s` is the only bound.
"""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, Annotated, NamedTuple

import msgspec
import numpy as np

from swarmtrack.camera_sources.address import CameraAddress, read_options, server_url
from swarmtrack.camera_sources.http_stream import HttpStream, StreamEnded, StreamOptions
from swarmtrack.camera_sources.limits import MAX_DETECTION_LINE_BYTES, MAX_STREAMED_DETECTIONS
from swarmtrack.camera_sources.newest_slot import NewestSlot
from swarmtrack.clock import Clock
from swarmtrack.messages import Detections, LinkStatus

if TYPE_CHECKING:
    import aiohttp


class BadLine(Exception):
    """The text says what was found and what was expected."""


class StreamLine(msgspec.Struct):
    """A parsed line of the stream."""

    detections: list[tuple[float, float, float, float, float]]
    t_s: float | None = None
    sequence: Annotated[int, msgspec.Meta(ge=0, le=2**62)] | None = None


class TimedDetections(NamedTuple):
    """Detections, and the standard deviation of their time [s]."""

    detections: Detections
    t_sigma: float


_DECODER = msgspec.json.Decoder(StreamLine)


class DetectionStream:
    """Implements `DetectionSource`."""

    def __init__(self, address: CameraAddress, *, clock: Clock) -> None:
        options = read_options(address, StreamOptions)
        url = server_url(address, StreamOptions).replace(f"{address.scheme}:", "http:", 1)
        self._clock = clock
        self._slot: NewestSlot[TimedDetections] = NewestSlot(str(address), clock)
        self._stream = HttpStream(url, options, clock, self._slot, address.login)
        self._last_sequence: int | None = None

    async def detections(self) -> AsyncIterator[Detections]:
        self._stream.start(self._read)
        while (timed := await self._slot.get()) is not None:
            self._slot.source.given(timed.detections.t, timed.t_sigma)
            yield timed.detections

    def status(self) -> LinkStatus:
        return self._stream.status()

    async def close(self) -> None:
        await self._stream.stop()

    async def _read(self, response: aiohttp.ClientResponse) -> None:
        """Feed the slot until the stream breaks."""
        if response.content_type.startswith(("text/html", "image/", "video/", "multipart/")):
            raise StreamEnded(
                f"is {response.content_type}, expected a stream of JSON lines, application/x-ndjson"
            )
        reader = LineReader()
        async for data in response.content.iter_any():
            arrived = self._clock.now()
            for line in reader.feed(data):
                self._receive(line, arrived)

    def _receive(self, line: bytes | None, arrived: float) -> None:
        try:
            sent = parse_line(line)
        except BadLine as error:
            self._slot.source.damaged(str(error), "lines come, but none is understood")
            return
        self._stream.received += 1
        sequence = self._stream.received if sent.sequence is None else sent.sequence
        self._count_lost(sequence)
        _, t, t_sigma = self._stream.exposure(sent.t_s, arrived)
        self._slot.source.report(True, "streaming")
        self._slot.put(TimedDetections(_as_detections(sent, t, sequence), t_sigma))

    def _count_lost(self, sequence: int) -> None:
        last, self._last_sequence = self._last_sequence, sequence
        if last is not None and sequence > last:  # back: the source was started anew
            self._slot.source.counts.lost += sequence - last - 1


class LineReader:
    """Splits bytes into lines of at most MAX_DETECTION_LINE_BYTES. No I/O; empty lines are left out."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self._skipping = False  # the rest of a line that was too long

    def feed(self, data: bytes) -> list[bytes | None]:
        """Lines that are now complete; None for one that is too long, once."""
        lines: list[bytes | None] = []
        *ends, rest = data.split(b"\n")
        for end in ends:
            line, self._rest = bytes(self._rest) + end, bytearray()
            if self._skipping:
                self._skipping = False
            elif len(line) > MAX_DETECTION_LINE_BYTES:
                lines.append(None)
            elif line.strip():
                lines.append(line)
        if self._skipping:
            return lines
        self._rest += rest
        if len(self._rest) > MAX_DETECTION_LINE_BYTES:
            self._rest.clear()
            self._skipping = True
            lines.append(None)
        return lines


def parse_line(line: bytes | None) -> StreamLine:
    """Parse and check a line: finite numbers, sizes from 0, scores in 0 … 1. Raises BadLine."""
    if line is None:
        raise BadLine(f"longer than {MAX_DETECTION_LINE_BYTES} bytes")
    try:
        sent = _DECODER.decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadLine(str(error)) from None
    for u, v, w, h, score in sent.detections:
        if not all(map(math.isfinite, (u, v, w, h))) or w < 0.0 or h < 0.0 or not 0.0 <= score <= 1.0:
            found = ", ".join(f"{value:g}" for value in (u, v, w, h, score))
            raise BadLine(f"detection [{found}], expected u, v, w >= 0, h >= 0, score in 0 … 1")
    return sent


def _as_detections(sent: StreamLine, t: float, sequence: int) -> Detections:
    best = sorted(sent.detections, key=lambda detection: -detection[4])[:MAX_STREAMED_DETECTIONS]
    table = np.array(best, dtype=float).reshape(-1, 5)
    return Detections(t, sequence, centre=table[:, :2], size=table[:, 2:4], score=table[:, 4])
