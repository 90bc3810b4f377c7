"""Own messages that are sent once and on request: the announcement and the camera."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Generic, TypeVar

from swarmtrack.clock import Clock, utc_offset
from swarmtrack.messages import Announcement
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.transport.limits import (
    ANNOUNCEMENT_REQUEST_PERIOD_S,
    ANSWER_FRESH_S,
    ANSWERS_PER_S,
    ANSWERS_TOGETHER_S,
    MAX_ANSWERS_TOGETHER_S,
)
from swarmtrack.wire import codec
from swarmtrack.wire.announcement import announcement_message, sign_announcement

Sign = Callable[[bytes], bytes]
"""Bytes to an Ed25519 signature."""

Q = TypeVar("Q")


class _Budget:
    """How many questions of one kind are answered; only under a lock."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since = 0.0
        self._answers = 0

    def allows(self) -> bool:
        now = self._clock.now()
        if now - self._since >= 1.0:
            self._since, self._answers = now, 0
        self._answers += 1
        return self._answers <= ANSWERS_PER_S


class JointAnswers(Generic[Q]):
    """Questions that wait for one answer: those that come within a moment of the first get the same put.

    The moment is short, and twice as long each time that several had come, so in the rush of a start each drone puts
    its announcement a few times instead of answering each question. Any thread may call.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: list[Q] = []
        self._wait_s = ANSWERS_TOGETHER_S

    def add(self, question: Q) -> float | None:
        """Keep a question. Returns after how many seconds to `take` all, None where that is settled already."""
        with self._lock:
            self._waiting.append(question)
            if len(self._waiting) > ANSWERS_PER_S:
                del self._waiting[0]
            return self._wait_s if len(self._waiting) == 1 else None

    def take(self) -> list[Q]:
        """All that wait."""
        with self._lock:
            taken, self._waiting = self._waiting, []
            rush = len(taken) > 1
            self._wait_s = min(2.0 * self._wait_s, MAX_ANSWERS_TOGETHER_S) if rush else ANSWERS_TOGETHER_S
            return taken


class Outgoing:
    """Checked messages, replaced only by later ones, and encoded with the age of the pose at sending.

    camera: our `camera/<id>`, constant for this process. Any thread may call: Zenoh answers queries in threads of its
    own.
    """

    def __init__(self, team: str, drone_id: int, boot: str, clock: Clock, sign: Sign | None) -> None:
        self.key = keys.key(team, Kind.POSE, drone_id)
        self.camera_key = keys.key(team, Kind.CAMERA, drone_id)
        self.camera: bytes | None = None
        self._drone_id = drone_id
        self._boot = boot
        self._clock = clock
        self._sign = sign
        self._lock = threading.Lock()
        self._announcement: Announcement | None = None
        self._encoded = b""
        self._encoded_at = 0.0
        self._answers = _Budget(clock)
        self._camera_answers = _Budget(clock)
        self._requested_at: float | None = None
        self._counters: Counter[str] = Counter()

    def replace(self, announcement: Announcement) -> None:
        """Replace the announcement. Raises ValueError where it is not ours, not newer, or not valid."""
        if (announcement.drone_id, announcement.boot) != (self._drone_id, self._boot):
            raise ValueError(
                f"announcement of drone {announcement.drone_id} boot {announcement.boot}, "
                f"expected our own: {self._drone_id} {self._boot}"
            )
        with self._lock:
            last = self._announcement
            if last is not None and announcement.sequence <= last.sequence:
                raise ValueError(
                    f"announcement {announcement.sequence} follows {last.sequence}, expected a higher one"
                )
            self._encode(announcement)
            self._announcement = announcement

    def encode(self) -> bytes | None:
        """The bytes to send now; None before the first announcement."""
        with self._lock:
            return self._tell()

    def answer(self) -> bytes | None:
        """Bytes for an answer to a query; None before the first announcement and above the rate limit."""
        with self._lock:
            if not self._answers.allows():
                self._counters["answers_refused"] += 1
                return None
            return self._tell()

    @property
    def announced(self) -> bool:
        """Whether there is an announcement."""
        with self._lock:
            return self._announcement is not None

    def camera_answer(self) -> bytes | None:
        """Camera message for an answer to a query; None without one and above the rate limit."""
        with self._lock:
            if self.camera is not None and not self._camera_answers.allows():
                self._counters["camera_answers_refused"] += 1
                return None
            return self.camera

    def accept_request(self) -> bool:
        """Whether to accept a request to announce again: once per second, and if there is something to renew."""
        with self._lock:
            now = self._clock.now()
            soon = self._requested_at is not None and now - self._requested_at < ANNOUNCEMENT_REQUEST_PERIOD_S
            if soon or self._announcement is None:
                self._counters["requests_ignored"] += 1
                return False
            self._requested_at = now
            self._counters["requests_received"] += 1
            return True

    @property
    def counters(self) -> dict[str, int]:
        """announcement_bytes: size of one; announcements_sent: puts and answers."""
        with self._lock:
            return {
                "announcement_bytes": len(self._encoded),
                "announcements_sent": self._counters["announcements_sent"],
                "announcement_bytes_total": self._counters["announcement_bytes_total"],
                **self._counters,
            }

    def _tell(self) -> bytes | None:
        if self._announcement is None:
            return None
        if self._clock.now() - self._encoded_at > ANSWER_FRESH_S:
            self._encode(self._announcement)
        self._counters["announcements_sent"] += 1
        self._counters["announcement_bytes_total"] += len(self._encoded)
        return self._encoded

    def _encode(self, announcement: Announcement) -> None:
        now = self._clock.now()
        data = codec.encode(announcement_message(announcement, utc_offset(self._clock), now))
        self._encoded = data if self._sign is None else sign_announcement(data, self.key, self._sign)
        self._encoded_at = now
