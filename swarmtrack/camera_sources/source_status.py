"""Status of a source: one line for people, counters for the health message, rates and ages of its frames."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass

import numpy as np

from swarmtrack.camera_sources.limits import CAMERA_RATE_WINDOW_S
from swarmtrack.camera_sources.stamp_clock import StampClock
from swarmtrack.clock import Clock
from swarmtrack.messages import LinkStatus
from swarmtrack.plain_text import hide_logins, plain

log = logging.getLogger(__name__)


@dataclass(slots=True)
class Counts:
    """Numbers of frames since the start, by outcome."""

    frames: int = 0  # given to the consumer
    dropped: int = 0  # gave way to a newer one, because the consumer was busy
    lost: int = 0  # never reached us: gaps of the camera's own sequence
    stale: int = 0  # waited in the camera's buffers until they were worthless
    corrupt: int = 0
    wrong_size: int = 0
    reconnects: int = 0


class SourceStatus:
    """Status of one source, which reports each frame's outcome; all on the event loop.

    stamps: judges those of the present connection, None where a source has none.
    """

    def __init__(self, name: str, clock: Clock) -> None:
        self.counts = Counts()
        self.stamps: StampClock | None = None
        self._bad_stamps = 0
        self.name = plain(name)
        self._clock = clock
        self._ok, self._text = False, "not opened yet"
        self._trouble = ""
        self._last_given: float | None = None
        self._came: deque[float] = deque(maxlen=512)
        # (now, age) of what was given to the consumer
        self._given: deque[tuple[float, float]] = deque(maxlen=256)
        self._t_sigma = 0.0

    def came(self) -> None:
        """Count an arrived frame."""
        self._came.append(self._clock.now())

    def report(self, ok: bool, text: str) -> None:
        """Set the one line about this source; logged when it changes, not when it is repeated."""
        text = plain(hide_logins(text))
        if (ok, text) != (self._ok, self._text):
            log.log(logging.INFO if ok else logging.WARNING, "camera %s: %s", self.name, text)
        self._ok, self._text = ok, text

    def exposure(self, stamp: float, arrived: float) -> tuple[float, float] | None:
        """As of `stamps`, which must be set. Counts the stamps that are not used, and logs the reason of the first."""
        assert self.stamps is not None
        known = self.stamps.problem
        found = self.stamps.exposure(stamp, arrived)
        if found is None:
            self._bad_stamps += 1
            if not known:
                log.warning("camera %s: stamps are not used: %s", self.name, self.stamps.problem)
        return found

    def given(self, t: float, t_sigma: float) -> None:
        """Count a frame delivered to the consumer. t: its exposure, t_sigma: that time's uncertainty."""
        now = self._clock.now()
        self._given.append((now, now - t))
        self._t_sigma = t_sigma
        self.counts.frames += 1
        self._last_given = now
        self._trouble = ""

    def refuse(self, text: str) -> None:
        """Report the reason of a rejected frame until one is accepted."""
        text = plain(hide_logins(text))
        if text != self._trouble:
            log.warning("camera %s: %s", self.name, text)
        self._trouble = text

    def damaged(self, reason: str, what: str = "frames come, but no picture can be read from them") -> None:
        """Count a frame that cannot be read. Where no other was good for a while, that is the source's state."""
        self.counts.corrupt += 1
        now = self._clock.now()
        if self._last_given is None or now - self._last_given > CAMERA_RATE_WINDOW_S:
            text = plain(hide_logins(f"{what}; the last: {reason}"))
            if not self._trouble:
                log.warning("camera %s: %s", self.name, text)
            self._trouble = text

    def status(self) -> LinkStatus:
        now = self._clock.now()
        fps = _rate(self._came, now)
        text = self._trouble or self._text
        if self._ok and self._came:
            text += f"; {fps:.1f} fps"
        ages: tuple[tuple[str, float], ...] = ()
        if self._given:
            p50, p95 = (float(age) for age in np.percentile([1e3 * age for _, age in self._given], (50, 95)))
            ages = (("age_p50_ms", p50), ("age_p95_ms", p95), ("t_sigma_ms", 1e3 * self._t_sigma))
            if self._ok and p50 >= 0.0:  # below: the frames of a recording set the clock, and have no age
                text += f", age {p50:.0f} ms"
        stamps: tuple[tuple[str, float], ...] = ()
        if self.stamps is not None:
            stamps = (("bad_stamps", self._bad_stamps),)
            doubt = f"; {self.stamps.doubt}" if self.stamps.doubt else ""
            text += f"; stamps are not used: {self.stamps.problem}" if self.stamps.problem else doubt
        counts = self.counts
        numbers = (
            ("fps", fps),
            ("used_fps", _rate(deque(now for now, _ in self._given), now)),
            ("frames", counts.frames),
            ("dropped", counts.dropped),
            ("lost", counts.lost),
            ("stale", counts.stale),
            ("corrupt", counts.corrupt),
            ("wrong_size", counts.wrong_size),
            ("reconnects", counts.reconnects),
            *ages,
            *stamps,
        )
        return LinkStatus(name=self.name, ok=self._ok and not self._trouble, text=text, counters=numbers)


def _rate(times: deque[float], now: float) -> float:
    """Events a second over the last CAMERA_RATE_WINDOW_S; before it has passed, over the time since the first event."""
    recent = [t for t in times if t > now - CAMERA_RATE_WINDOW_S]
    if len(recent) < 2:
        return 0.0
    if len(recent) == len(times):
        span = recent[-1] - recent[0]
        return (len(recent) - 1) / span if span > 0 else 0.0
    return len(recent) / CAMERA_RATE_WINDOW_S
