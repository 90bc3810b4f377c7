"""Queue and thread that write a recording: producers never wait for the disk.

The thread takes the queue every `RECORDING_THREAD_PERIOD_S`, writes it down and flushes the file. If the disk is slow
the queue grows, up to `MAX_QUEUED`; what comes then is lost and counted. If the disk is full the writer says so and
tries again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from swarmtrack.clock import Clock
from swarmtrack.messages import LinkStatus
from swarmtrack.recording.writer import Bounds, Preface, RecordingWriter, Topic, WriterCounters

log = logging.getLogger(__name__)

RECORDING_THREAD_PERIOD_S = (
    0.05  # s between two looks into the queue: to be woken by every sample costs more than to write it
)
MAX_QUEUED = 8192  # entries, twenty seconds of flight: a memory card that is cleaning up takes ten
RECORDING_THREAD_CLOSE_S = 1.0  # s for what is still queued, and the last segment

Write = Callable[[Topic, int, bytes], None]
"""Topic, time [ns, UTC], data."""
Job = Callable[[Write, int], None]
"""Writes one entry, given its time."""


class RecordingThread:
    """wall: the machine's clock. waits: a full queue holds up who puts, instead of losing what is put."""

    def __init__(self, wall: Clock, *, waits: bool = False) -> None:
        self.waits = waits
        self._queue: deque[tuple[int, Job]] = deque()
        self._overrun = 0
        self._wall = wall
        self._writer: RecordingWriter | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._trouble: str | None = None

    def open(self, folder: Path, preface: Preface, bounds: Bounds) -> None:
        """Begin. Raises RecordingError where the folder cannot be made."""
        self._writer = RecordingWriter(folder, preface, bounds)
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def enqueue(self, log_time_ns: int, job: Job) -> None:
        while len(self._queue) >= MAX_QUEUED:
            if not self.waits or self._thread is None or not self._thread.is_alive():
                self._overrun += 1
                return
            time.sleep(RECORDING_THREAD_PERIOD_S)
        self._queue.append((log_time_ns, job))

    def close(self, seconds: float = RECORDING_THREAD_CLOSE_S) -> None:
        """Write what is queued and complete the last segment; gives up on a disk that hangs."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(None if self.waits else seconds)
            if self._thread.is_alive():
                log.warning("recording: the disk is too slow to end in order; `swarmtrack log repair` helps")

    @property
    def folder(self) -> Path | None:
        return None if self._writer is None else self._writer.folder

    @property
    def counters(self) -> WriterCounters:
        """Numbers of messages by outcome; `lost` is the writer's part of `lost` below."""
        return self._writer.counters if self._writer else WriterCounters()

    @property
    def lost(self) -> int:
        """Messages that are not in the file and should be."""
        return self.counters.lost + self._overrun

    @property
    def trouble(self) -> str | None:
        """Why nothing is being written; None: all is well."""
        return self._writer.trouble if self._writer else None

    def take_news(self) -> str | None:
        """What changed since the last call, in one line: the disk takes nothing more, or does again."""
        before, self._trouble = self._trouble, self.trouble
        if (self._trouble is None) == (before is None):
            return None
        return "recording goes on" if self._trouble is None else f"recording: {self._trouble}"

    def status(self) -> LinkStatus:
        """The folder, or why nothing is being written."""
        counters = self.counters
        return LinkStatus(
            "recording",
            self.trouble is None,
            self.trouble or f"into {self.folder}",
            (
                ("written", counters.written),
                ("lost", self.lost),
                ("segments", counters.segments),
                ("segments_dropped", counters.segments_dropped),
                ("queued", len(self._queue)),
            ),
        )

    def _run(self) -> None:
        writer = self._writer
        assert writer is not None

        def write(topic: Topic, log_time_ns: int, data: bytes) -> None:
            writer.write(topic, log_time_ns, data, self._wall.now())

        ended = False
        while not ended:
            ended = self._stop.wait(RECORDING_THREAD_PERIOD_S)
            for _ in range(len(self._queue)):
                log_time_ns, job = self._queue.popleft()
                job(write, log_time_ns)
            writer.tick(self._wall.now())
        writer.close(self._wall.now())


def folder_name(utc: float, boot: str) -> str:
    """Name of a recording's folder: sorts by time."""
    return f"{datetime.fromtimestamp(utc, UTC):%Y%m%dT%H%M%SZ}-{boot}"
