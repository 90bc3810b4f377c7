"""Bridge from Zenoh's threads to the event loop, with bounds on queued samples and on the work per turn.

Zenoh calls back on threads of its own. A callback notes the time, copies the bytes into a `Bridge` and returns;
decoding and all state live on the event loop. A sender that floods only replaces its own messages: the keys take
turns, each keeps its newest, and between two batches the loop does everything else it has to do.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import zenoh

from swarmtrack.clock import Clock
from swarmtrack.transport import keys
from swarmtrack.transport.base import Sample
from swarmtrack.transport.limits import BRIDGE_CAPACITY, BRIDGE_HANDFUL, BRIDGE_REST_S, BRIDGE_ROUND_S
from swarmtrack.wire.fields import MAX_MESSAGE_BYTES


class Bridge:
    """Passes samples from Zenoh's threads to the event loop, in order, holding at most `capacity` of them.

    When full, the oldest is dropped, counted in `dropped`. With `newest_per_key` only the last so many of each key
    wait, replaced ones are counted in `superseded`, and the loop rests between two batches, and longer before the next
    round.
    """

    def __init__(
        self,
        receive: Callable[[Sample], None],
        capacity: int = BRIDGE_CAPACITY,
        newest_per_key: int = 0,
        *,
        clock: Clock,
    ) -> None:
        self._receive = receive
        self._capacity = capacity
        self._newest_per_key = newest_per_key
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        # Samples by key, the keys in order of arrival; in order of arrival altogether under the one key "".
        self._waiting: dict[str, deque[Sample]] = {}
        self._count = 0
        self._round = 0  # of those waiting, how many are still to be taken before the longer rest
        self._scheduled = False
        self.dropped = 0
        self.superseded = 0

    def handler(self) -> Any:
        """Callback for Zenoh's `declare_*`: runs in Zenoh's thread, without a further queue and thread."""
        return zenoh.handlers.Callback(self._on_sample, indirect=False)

    def replies(self, on_answer: Callable[[bytes], object] | None = None) -> Any:
        """Callback for Zenoh's `get`. on_answer: called on the event loop for each answer, with what it says instead of
        a pose (`keys.IS_HERE`, `keys.NOTHING_YET`), or empty.
        A timeout arrives as a reply too, and is ignored.
        """

        def on_reply(reply: zenoh.Reply) -> None:
            word = b"" if reply.err is None else reply.err.payload.to_bytes()
            is_answer = reply.ok is not None or word in (keys.NOTHING_YET, keys.IS_HERE)
            if on_answer is not None and is_answer:
                self._schedule(self._loop.call_soon_threadsafe, on_answer, word)
            if reply.ok is not None:
                self._on_sample(reply.ok)

        return zenoh.handlers.Callback(on_reply, indirect=False)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()[: MAX_MESSAGE_BYTES + 1]  # one too many is enough to be refused
        alive = sample.kind == zenoh.SampleKind.PUT
        self.enqueue(Sample(str(sample.key_expr), payload, alive, self._clock.now()))

    def enqueue(self, sample: Sample) -> None:
        """Add a sample, from any thread."""
        slot = sample.key if self._newest_per_key else ""
        with self._lock:
            queue = self._waiting.setdefault(slot, deque())
            queue.append(sample)
            self._count += 1
            if self._newest_per_key and len(queue) > self._newest_per_key:
                queue.popleft()
                self._count -= 1
                self.superseded += 1
            elif self._count > self._capacity:
                self._take()
                self.dropped += 1
            wake = not self._scheduled
            self._scheduled = True
        if wake:
            self._schedule(self._loop.call_soon_threadsafe, self._drain)

    def _drain(self) -> None:
        with self._lock:
            self._round = self._round or self._count
        try:
            self.hand_over()
        finally:
            self._schedule(self._loop.call_later, self._rest, self._rested)

    def hand_over(self) -> None:
        """Deliver a batch now, on the loop and out of turn; for samples that those of another bridge refer to."""
        with self._lock:
            handful = [self._take() for _ in range(min(BRIDGE_HANDFUL, self._count))]
            self._round = max(0, self._round - len(handful))
        for sample in handful:
            self._receive(sample)

    @property
    def _rest(self) -> float:
        if not self._newest_per_key:
            return 0.0
        return BRIDGE_REST_S if self._round else BRIDGE_ROUND_S

    def _rested(self) -> None:
        with self._lock:
            self._scheduled = self._count > 0
        if self._scheduled:
            self._drain()

    def _take(self) -> Sample:
        """The oldest sample of the key whose turn it is, which then goes to the back."""
        slot = next(iter(self._waiting))
        queue = self._waiting.pop(slot)
        sample = queue.popleft()
        self._count -= 1
        if queue:
            self._waiting[slot] = queue
        return sample

    def _schedule(self, call: Callable[..., object], *arguments: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: nothing listens any more
            call(*arguments)
