"""`http:` a stream of JPEGs (`multipart/x-mixed-replace`), as IP cameras, phones and mjpg-streamer send it.

A part may carry `X-Timestamp`, the time of its exposure; `http_stream` defines its form.
"""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from email.message import Message
from pathlib import Path
from typing import TYPE_CHECKING

from swarmtrack.camera_sources.address import CameraAddress, read_options, server_url
from swarmtrack.camera_sources.decode import JPEG_PADDING, check_pixels, decode_jpeg
from swarmtrack.camera_sources.frame_slot import FrameSlot, Freshness, RawFrame
from swarmtrack.camera_sources.http_stream import HttpStream, NetworkOptions, StreamEnded
from swarmtrack.camera_sources.multipart import JPEG_START, MultipartReader, Part
from swarmtrack.clock import Clock
from swarmtrack.messages import Frame, LinkStatus, StampKind

if TYPE_CHECKING:
    import aiohttp


UNNAMED_STREAMS = ("application/octet-stream", "video/x-motion-jpeg", "video/x-mjpeg", "video/mjpeg")


class MjpegCamera:
    """An MJPEG stream over HTTP."""

    def __init__(
        self, address: CameraAddress, *, clock: Clock, size: tuple[int, int] | None, base: Path | None
    ) -> None:
        del base  # a URL is never relative to the config
        options = read_options(address, NetworkOptions)
        self._clock = clock
        self._slot = FrameSlot(str(address), clock, size, options.resize)
        url = server_url(address, NetworkOptions)
        self._stream = HttpStream(url, options, clock, self._slot, address.login)
        self._patience = options.timeout_s
        self._freshness = Freshness(period=1 / 30, depth=30)  # a second in the sockets' buffers

    def frames(self) -> AsyncIterator[Frame]:
        self._stream.start(self._read)
        return self._slot.frames()

    async def arrived(self) -> None:
        await self._slot.arrived()

    def status(self) -> LinkStatus:
        return self._stream.status()

    async def close(self) -> None:
        await self._stream.stop()

    async def _read(self, response: aiohttp.ClientResponse) -> None:
        """Feed the slot until the stream breaks."""
        reader = MultipartReader(_boundary(response))
        oversized, since, other = 0, self._clock.now(), ""
        async for data in response.content.iter_any():
            now = self._clock.now()
            for part in reader.feed(data, now):
                other = _why_no_picture(part)
                if not other:
                    self._receive(part)
                    since = now
            self._slot.source.counts.corrupt += reader.oversized - oversized
            oversized = reader.oversized
            if now - since > self._patience:
                self._slot.source.report(False, f"bytes come, but no picture: {other or reader.missing()}")
            if reader.ended:
                break

    def _receive(self, part: Part) -> None:
        self._slot.source.report(True, "streaming")
        self._stream.received += 1
        sequence = self._stream.received
        text = part.headers.get("x-timestamp")
        stamp, t, t_sigma = self._stream.exposure(None if text is None else _number(text), part.arrived)
        if stamp is StampKind.EXPOSURE and self._freshness.is_stale(t, sequence, part.arrived):
            self._slot.source.counts.stale += 1
            return
        self._slot.put(
            RawFrame(
                t,
                t_sigma,
                sequence,
                stamp,
                decode=lambda: decode_jpeg(part.body),
                header_size=lambda: check_pixels(part.body),
            )
        )


def _why_no_picture(part: Part) -> str:
    """Why a part is not even a damaged picture, or empty."""
    if not part.body.strip():
        return "its parts are empty"
    kind = part.headers.get("content-type", "image/jpeg").partition(";")[0].strip().lower()
    if part.body.lstrip(JPEG_PADDING).startswith(JPEG_START) or kind.startswith("image/"):
        return ""
    return f"a part of the stream is {kind}, expected image/jpeg"


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _boundary(response: aiohttp.ClientResponse) -> str:
    """The boundary of a stream, empty where it announces none, or StreamEnded with what it is instead."""
    kind = response.content_type
    if kind.startswith("image/"):
        raise StreamEnded(
            f"is {kind}, a single picture, expected a stream of JPEGs: look in the camera's manual for the path of "
            "its MJPEG stream"
        )
    # Some servers name the stream after what it holds, or not at all.
    if not kind.startswith("multipart/") and kind not in UNNAMED_STREAMS:
        raise StreamEnded(f"is {kind}, expected a stream of JPEGs, multipart/x-mixed-replace")
    header = Message()
    header["Content-Type"] = response.headers.get("Content-Type", "")
    return header.get_boundary("") or ""
