"""From the autopilot's clock to ours.

A message stamped s by the autopilot arrives at a = s + offset + latency, latency > 0, so every arrival bounds the
offset from above: offset < a − s. The tightest line under all these points, with the clocks' skew as its slope, is an
edge of their lower convex hull: of all lines below the points the one nearest to them on average passes through the
edge that spans their mean abscissa (Moon, Skelly & Towsley, "Estimation and removal of clock skew from network delay
measurements", INFOCOM 1999). An average of the arrivals would follow the jitter, which is one-sided.

That line still holds the smallest latency. TIMESYNC adds bounds from below: what the autopilot stamped after we sent
our request cannot have happened before it, offset > sent − s. The truth lies between both envelopes, and we take the
middle. A single exchange is biased (the autopilot answers only in its loop); the envelopes of a minute of them hardly
are. ArduPilot dates a request back by the time its bytes would take on a UART of the configured speed, also where there
is no UART: 6.5 ms on UDP. So the bounds may cross a little; the difference is owned up to in sigma. If they cross by
more, the autopilot's clock has stepped, and all that was learned is dropped.

Or it does not keep time at all: a simulator that waits for each of its steps runs per cent slow, and the bounds cross
again and again. A step leaves no straight line through the exchanges on both sides of it; a wrong rate does. So where
one line passes through the exchanges of some seconds, and no crystal is that steep, its slope is taken out of all
stamps as the clock's drift, and what remains is treated as any other clock.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

from swarmtrack.autopilot.limits import (
    CLOCK_BUCKET_S,
    CLOCK_CROSSING_S,
    CLOCK_DRIFT_BASELINE_S,
    CLOCK_EXCHANGES_KEPT,
    CLOCK_LEAST_EXCHANGES,
    CLOCK_LINE_SLACKS_S,
    CLOCK_MAX_SKEW,
    CLOCK_MAX_SLEW,
    CLOCK_RESYNC_S,
    CLOCK_SKEW_BASELINE_S,
    CLOCK_STEPS_LAST_S,
    CLOCK_UNKNOWN_LATENCY_S,
    CLOCK_UNSTEADY_RESTARTS,
    CLOCK_WINDOW_BUCKETS,
)

Point = tuple[float, float]


class Envelope:
    """The extreme of y in each bucket of x, over the window. sign +1: smallest, −1: largest."""

    def __init__(self, sign: int) -> None:
        self.points: deque[Point] = deque(maxlen=CLOCK_WINDOW_BUCKETS)
        self._sign = sign

    def add(self, x: float, y: float) -> bool:
        """Add a point; returns whether it begins a new bucket."""
        if self.points:
            x = max(x, self.points[-1][0])  # one stream's stamps may lag a little behind another's
        new = not self.points or math.floor(x / CLOCK_BUCKET_S) > math.floor(
            self.points[-1][0] / CLOCK_BUCKET_S
        )
        if new:
            self.points.append((x, y))
        elif self._sign * y < self._sign * self.points[-1][1]:
            self.points[-1] = (x, y)
        return new


def supporting_line(points: list[Point]) -> Point:
    """(slope, value at x = 0) of the line below all points that is nearest to them on average.

    points: ascending in x, at least two. Andrew's monotone chain for the hull, then the edge over the mean x.
    """
    hull: list[Point] = []
    for x, y in points:
        while len(hull) >= 2:
            (x1, y1), (x2, y2) = hull[-2:]
            if (x2 - x1) * (y - y1) > (y2 - y1) * (x - x1):
                break
            hull.pop()
        hull.append((x, y))
    mean = sum(x for x, _ in points) / len(points)
    i = next(i for i in range(1, len(hull)) if hull[i][0] >= mean)
    (x1, y1), (x2, y2) = hull[i - 1 : i + 1]
    slope = (y2 - y1) / (x2 - x1)
    return slope, y1 - slope * x1


class Exchange(NamedTuple):
    """One TIMESYNC stamped `stamp`: the offset was between `earliest` and `latest` [s]."""

    stamp: float
    earliest: float
    latest: float


def slopes_through(exchanges: Sequence[Exchange], slack: float) -> tuple[float, float] | None:
    """(least, greatest) slope of the lines that miss no exchange by more than slack [s]; None where there is no line.

    exchanges: ascending in stamp. For a slope s there is an intercept if and only if every lower end, carried along s,
    stays below every upper end; that is one inequality for s per pair.
    """
    least, greatest = -math.inf, math.inf
    for a, b in combinations(exchanges, 2):
        elapsed = b.stamp - a.stamp
        if elapsed <= 0.0:
            continue
        least = max(least, (b.earliest - a.latest - 2 * slack) / elapsed)
        greatest = min(greatest, (b.latest - a.earliest + 2 * slack) / elapsed)
    return (least, greatest) if least <= greatest else None


class ClockMap:
    """Maps the autopilot's time stamps [s since its boot] to our monotonic clock [s].

    offset: what is added to a stamp now; skew: of their clock against ours [s/s], positive where it runs slow; drift:
    the part of it that no crystal has, 0 for a clock that keeps time; resyncs: corrections too large to be brought in
    slowly; restarts: how often bounds crossed.
    """

    def __init__(self) -> None:
        self.resyncs = 0
        self.restarts = 0
        self.reset()

    def reset(self) -> None:
        """Drop all state: the autopilot has rebooted."""
        self.offset: float | None = None
        self._line_sigma = math.inf
        self.skew = self.drift = 0.0
        self._newest = -math.inf
        self._past: deque[Exchange] = deque(maxlen=CLOCK_EXCHANGES_KEPT)
        self._restarted: deque[float] = deque(maxlen=CLOCK_UNSTEADY_RESTARTS)
        self._step_variance, self._stepped_at = 0.0, 0.0
        self._restart()

    def _restart(self) -> None:
        self._upper = Envelope(+1)
        self._lower = Envelope(-1)
        self._exchanges = 0
        self._reference = 0.0  # x = stamp − reference keeps products small
        self._intercept = math.inf
        self._latency = 0.0

    def observe(self, stamp: float, arrival: float) -> None:
        """Add a message stamped `stamp` by the autopilot that came at `arrival` on our clock."""
        self._bound_above(stamp, arrival)
        self._slew(stamp)

    def exchange(self, sent: float, stamp: float, received: float) -> None:
        """Add one TIMESYNC: our request left at `sent`, was stamped `stamp`, and its answer came at `received`."""
        exchange = Exchange(stamp, sent - stamp, received - stamp)
        self._bound_above(stamp, received)
        self._past.append(exchange)
        crossing = self._crossing(exchange)
        if crossing > CLOCK_CROSSING_S:
            self.restarts += 1
            self._restarted.append(stamp)
            explained = self._explain()
            self._restart()
            for known in tuple(self._past) if explained else (exchange,):
                self._bound_above(known.stamp, known.stamp + known.latest)
                self._bound_below(known)
            if explained:
                self._step_variance = 0.0
            else:
                # At least by so much; and it may step again before an exchange shows it.
                self._step_variance = self._step_variance_at(stamp) + crossing**2
                self._stepped_at = stamp
        else:
            self._bound_below(exchange)
        if self._exchanges >= CLOCK_LEAST_EXCHANGES:
            width = self._width(stamp - self._reference)
            self._latency = max(0.0, width) / 2
            # Uniform between the bounds, plus how far the envelope itself is uncertain.
            self._line_sigma = self._sigma(width / math.sqrt(12))

    def _step_variance_at(self, stamp: float) -> float:
        return self._step_variance * math.exp(-max(stamp - self._stepped_at, 0.0) / CLOCK_STEPS_LAST_S)

    @property
    def sigma(self) -> float:
        """One standard deviation of the offset [s]: of the line, constant part included, and what the offset still has
        to go to it."""
        left = 0.0 if self.offset is None else self._target(self._newest) - self.offset
        return math.hypot(self._line_sigma, left)

    @property
    def in_words(self) -> str:
        """Description of a fault of the autopilot's clock; empty where it keeps time."""
        if self.drift:
            percent = 100 * self.skew / (1 + self.skew)
            return f"runs {abs(percent):.1f} % {'slow' if percent > 0 else 'fast'}: a simulator?"
        if self._is_unsteady:
            return "jumps against ours: a simulator, or is this machine too busy?"
        return ""

    @property
    def _is_unsteady(self) -> bool:
        """Whether the bounds keep crossing, and no drift explains it."""
        often = (
            len(self._restarted) == CLOCK_UNSTEADY_RESTARTS
            and self._newest - self._restarted[0] < CLOCK_WINDOW_BUCKETS * CLOCK_BUCKET_S
        )
        return often and not self.drift

    def _crossing(self, new: Exchange) -> float:
        """By how much [s] this exchange began after the line allows, or ended before an earlier one does, for a clock
        that keeps its drift: the least by which the clock has stepped."""
        fastest = self.drift - CLOCK_MAX_SKEW
        ahead = (old.earliest + fastest * (new.stamp - old.stamp) - new.latest for old in self._past)
        return max(new.earliest - self._line(new.stamp), *ahead)

    def _explain(self) -> bool:
        """After bounds have crossed: find the drift that explains it. False where it was a step, or is not known."""
        fits = [
            slopes
            for slack in CLOCK_LINE_SLACKS_S
            if (slopes := slopes_through(self._past, slack)) is not None
        ]
        if not fits:
            while len(self._past) > 1:
                self._past.popleft()
            return False
        if self._past[-1].stamp - self._past[0].stamp < CLOCK_DRIFT_BASELINE_S:
            return False
        # The tightest fit is the best guess, the next one says how wrong it may be.
        best, doubtful = fits[0], fits[min(1, len(fits) - 1)]
        crystal = doubtful[0] <= CLOCK_MAX_SKEW and doubtful[1] >= -CLOCK_MAX_SKEW
        self.drift = 0.0 if crystal else sum(best) / 2
        return not crystal

    def to_ours(self, stamp: float) -> float:
        """Our time of the autopilot's `stamp`. Strictly increasing in the stamp, between hard resyncs."""
        if self.offset is None:
            raise ValueError("ClockMap.to_ours: nothing has been observed yet")
        return stamp + self.offset

    def _line(self, stamp: float) -> float:
        return self._intercept + self.skew * (stamp - self._reference)

    def _target(self, stamp: float) -> float:
        """Where the offset had better be: amid both envelopes."""
        return self._line(stamp) - self._latency

    def _bound_above(self, stamp: float, arrival: float) -> None:
        if not self._upper.points:
            self._reference = stamp
        delay = arrival - stamp
        x = stamp - self._reference
        if self._upper.add(x, delay - self.drift * x):
            self._fit()
        self._intercept -= max(0.0, self._line(stamp) - delay)

    def _bound_below(self, exchange: Exchange) -> None:
        x = exchange.stamp - self._reference
        self._lower.add(x, exchange.earliest - self.drift * x)
        self._exchanges += 1

    @property
    def _slope(self) -> float:
        """Of the envelopes [s/s]: their points are kept without the drift."""
        return self.skew - self.drift

    def _fit(self) -> None:
        points = list(self._upper.points)
        if len(points) < 3 or points[-1][0] - points[0][0] < CLOCK_SKEW_BASELINE_S:
            slope = 0.0
        else:
            # The bucket that has just begun holds one sample, hardly the fastest of its second.
            slope, _ = supporting_line(points[:-1])
            slope = min(max(slope, -CLOCK_MAX_SKEW), CLOCK_MAX_SKEW)
        self.skew = self.drift + slope
        self._intercept = min(y - slope * x for x, y in points)
        if self._exchanges < CLOCK_LEAST_EXCHANGES:
            self._line_sigma = self._sigma(CLOCK_UNKNOWN_LATENCY_S)

    def _sigma(self, latency: float) -> float:
        """latency: standard deviation of what it may be wrong by."""
        stepped = math.sqrt(self._step_variance_at(self._newest))
        return math.hypot(latency, self._scatter(), stepped, CLOCK_CROSSING_S if self._is_unsteady else 0.0)

    def _scatter(self) -> float:
        """Median height of the seconds' fastest messages above the line [s]: what is left of the jitter."""
        heights = sorted(y - self._intercept - self._slope * x for x, y in self._upper.points)
        return heights[len(heights) // 2]

    def _width(self, x: float) -> float:
        """Distance of the two envelopes at x, the lower one carried there along their slope."""
        upper = self._intercept + self._slope * x
        return upper - max(y + self._slope * (x - xi) for xi, y in self._lower.points)

    def _slew(self, stamp: float) -> None:
        target = self._target(stamp)
        elapsed = max(0.0, stamp - self._newest)
        self._newest = max(self._newest, stamp)
        if self.offset is None:
            self.offset = target
            return
        self.offset += self.drift * elapsed
        error = target - self.offset
        if abs(error) > CLOCK_RESYNC_S:
            self.offset = target
            self.resyncs += 1
        else:
            self.offset += min(max(error, -CLOCK_MAX_SLEW * elapsed), CLOCK_MAX_SLEW * elapsed)
