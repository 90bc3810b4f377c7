"""`rtsp:` a network camera, read by OpenCV's FFmpeg in a worker thread.

Such a stream has no exposure times, so a frame's time is that of arrival, less `latency_ms`, with `sigma_ms` as its
uncertainty: fit for watching, poor for tracking from a drone that turns. FFmpeg's own settings can be given in the
environment variable OPENCV_FFMPEG_CAPTURE_OPTIONS, for example `rtsp_transport;udp`.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np

from swarmtrack.camera_sources.address import CameraAddress, read_options, server_url, with_login
from swarmtrack.camera_sources.frame_slot import FrameSlot, RawFrame, already
from swarmtrack.camera_sources.http_stream import NetworkOptions
from swarmtrack.camera_sources.limits import CAMERA_FIRST_BACKOFF_S, CAMERA_LONGEST_BACKOFF_S, RTSP_PORT
from swarmtrack.camera_sources.rtsp_answer import RtspAnswer, describe, why_no_video
from swarmtrack.camera_sources.thread_camera import ThreadCamera
from swarmtrack.camera_sources.video import open_video
from swarmtrack.clock import Clock
from swarmtrack.messages import StampKind


class RtspCamera(ThreadCamera):
    """An RTSP stream."""

    def __init__(
        self, address: CameraAddress, *, clock: Clock, size: tuple[int, int] | None, base: Path | None
    ) -> None:
        del base  # a URL is never relative to the config
        self._options = read_options(address, NetworkOptions)
        self._url = server_url(address, NetworkOptions)
        self._login = address.login
        self._clock = clock
        super().__init__(FrameSlot(str(address), clock, size, self._options.resize))

    # in the thread ------------------------------------------------------------------------------------------------

    def _run(self, loop: asyncio.AbstractEventLoop) -> None:
        def tell(call: Callable[..., None], *arguments: object) -> None:
            loop.call_soon_threadsafe(call, *arguments)

        try:
            self._keep_streaming(tell)
        except Exception as bug:  # not lost with the thread: the consumer raises it
            # The loop may be gone, and with it everybody who could want to know.
            with contextlib.suppress(RuntimeError):
                tell(self._slot.end, bug)

    def _keep_streaming(self, tell: Callable[..., None]) -> None:
        backoff = CAMERA_FIRST_BACKOFF_S
        sequence = 0
        while not self._stop.is_set():
            capture, problem = self._open()
            if capture is None:
                tell(self._slot.source.report, False, f"{problem}; trying again")
            else:
                if sequence:
                    tell(self._count_reconnect)
                before, sequence = sequence, self._stream(capture, sequence, tell)
                if sequence > before:
                    backoff = CAMERA_FIRST_BACKOFF_S
            self._stop.wait(backoff)
            backoff = min(2 * backoff, CAMERA_LONGEST_BACKOFF_S)

    def _open(self) -> tuple[cv2.VideoCapture | None, str]:
        """The opened stream, or None and why not."""
        parts = urlsplit(self._url)
        where = (parts.hostname or "", parts.port or RTSP_PORT)
        # OpenCV reports only that it failed. Whether the machine is there at all can be asked first, and whether it
        # takes the login: a wrong one is sent once per attempt, for cameras count those and lock the user out.
        try:
            connection = self._connect(where)
        except OSError as error:
            return None, f"cannot connect to {where[0]} port {where[1]}: {error.strerror or error}"
        with connection:
            answer = None if self._login is None else self._describe(connection)
        if self._stop.is_set():
            return None, "closed"
        if answer is not None and answer.refuses_login:
            return None, why_no_video(where, answer, self._login)
        limit_ms = int(1e3 * self._options.timeout_s)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
        capture = open_video(with_login(self._url, self._login), limits)
        if capture.isOpened():
            return capture, ""
        capture.release()
        if self._login is None:
            with contextlib.suppress(OSError), self._connect(where) as connection:
                answer = self._describe(connection)
        return None, why_no_video(where, answer, self._login)

    def _connect(self, where: tuple[str, int]) -> socket.socket:
        return socket.create_connection(where, timeout=self._options.timeout_s)

    def _describe(self, connection: socket.socket) -> RtspAnswer | None:
        """The whole takes `timeout_s` at most, however slowly its bytes come."""
        end = self._clock.now() + self._options.timeout_s
        return describe(connection, self._url, self._login, lambda: end - self._clock.now())

    def _stream(self, capture: cv2.VideoCapture, sequence: int, tell: Callable[..., None]) -> int:
        """Feed the slot until the stream breaks; returns the next sequence."""
        options = self._options
        try:
            while not self._stop.is_set():
                found, image = capture.read()
                if not found:
                    tell(
                        self._slot.source.report,
                        False,
                        f"lost, or nothing for {options.timeout_s:g} s; trying again",
                    )
                    break
                t = self._clock.now() - 1e-3 * options.latency_ms
                decode = already(np.asarray(image, np.uint8))
                raw = RawFrame(t, 1e-3 * options.sigma_ms, sequence, StampKind.ARRIVAL, decode)
                tell(self._slot.source.report, True, "streaming")
                tell(self._slot.put, raw)
                sequence += 1
        finally:
            capture.release()
        return sequence

    def _count_reconnect(self) -> None:
        self._slot.source.counts.reconnects += 1
