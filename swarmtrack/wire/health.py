"""`health/<id>`: the state of an agent."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from swarmtrack.messages import LinkStatus
from swarmtrack.plain_text import plain
from swarmtrack.wire.fields import (
    LONGEST_LINE,
    LONGEST_NAME,
    MAX_KNOWN,
    Boot,
    Count,
    DroneId,
    Length,
    Line,
    Name,
    Quantity,
    Rate,
    Record,
    Seconds,
    SignedSeconds,
    UtcSeconds,
)

MOST_COUNTERS = 64  # of one link


class RateHealth(Record, frozen=True):
    """Requested rate (null: none requested) and measured rate."""

    asked_hz: Quantity | None
    got_hz: Quantity


class LatencyHealth(Record, frozen=True):
    """Durations of one step over the last reporting interval."""

    p50_s: Seconds
    p95_s: Seconds
    max_s: Seconds


class LinkHealth(Record, frozen=True):
    """`LinkStatus` of one camera, autopilot or network."""

    name: Name
    ok: bool
    text: Line
    counters: Annotated[dict[Name, Quantity], Meta(max_length=MOST_COUNTERS)]


class TimeOffsetHealth(Record, frozen=True):
    """Time offset of a camera: exposure on the IMU's clock = stamp + offset. Estimated in flight (null: not yet), and
    in use.
    """

    found_s: SignedSeconds | None
    sigma_s: Seconds | None
    used_s: SignedSeconds


class GyroBiasHealth(Record, frozen=True):
    """Gyro bias, body FRD: estimated in flight (null: not yet), and subtracted."""

    found_rad_s: tuple[Rate, Rate, Rate] | None
    sigma_rad_s: Annotated[float, Meta(ge=0.0, le=1e3)] | None
    used_rad_s: tuple[Rate, Rate, Rate]


class ConsistencyHealth(Record, frozen=True):
    """Mean normalised innovation squared of the last detections, and the band that contains it for a consistent
    tracker.
    """

    nis: Quantity
    low: Quantity
    high: Quantity


class NoiseHealth(Record, frozen=True):
    """Measured noise relative to the configured noise, as factors on standard deviations; null: not (yet) known.

    found, remedy: for people, where the tracks' covariances are not consistent; empty where they are.
    """

    detections: Quantity | None
    motion: Quantity | None
    found: Line
    remedy: Line


class ReadinessHealth(Record, frozen=True):
    """Whether the drone could fly now, and the reason if not."""

    ready: bool
    reasons: Annotated[tuple[Line, ...], Meta(max_length=16)]


class CarriedHealth(Record, frozen=True):
    """Position by teammates: holders, sigma of the worst axis, and the error of the autopilot's position (null: it has
    none).
    """

    by: Annotated[tuple[DroneId, ...], Meta(max_length=MAX_KNOWN)]
    sigma_m: Length
    off_m: Length | None


class HealthMessage(Record, frozen=True, forbid_unknown_fields=False):
    """`health/<id>`: the state of an agent. clock_offset_s: ours minus the autopilot's, null without one.

    drops counts what was thrown away since the start, by place; events holds the last lines worth reading. It
    may grow: what a reader misses at its end is null, and what it does not know there it leaves (decision 10). Without
    `carried` that field is not on the wire.
    """

    what: ClassVar[str] = "health"
    version: Literal[1]
    t_utc_s: UtcSeconds
    boot: Boot
    uptime_s: Seconds
    cpu_percent: Quantity
    rss_mb: Quantity
    rates: Annotated[dict[Name, RateHealth], Meta(max_length=32)]
    latencies: Annotated[dict[Name, LatencyHealth], Meta(max_length=32)]
    clock_offset_s: SignedSeconds | None
    clock_offset_sigma_s: Seconds | None
    links: Annotated[tuple[LinkHealth, ...], Meta(max_length=32)]
    drops: Annotated[dict[Name, Count], Meta(max_length=64)]
    events: Annotated[tuple[Line, ...], Meta(max_length=32)]
    time_offset: TimeOffsetHealth | None = None
    gyro_bias: GyroBiasHealth | None = None
    consistency: ConsistencyHealth | None = None
    readiness: ReadinessHealth | None = None
    noise: NoiseHealth | None = None
    carried: CarriedHealth | None = None


def link_health(status: LinkStatus) -> LinkHealth:
    """A link's state, cut to what fits on the wire; a counter that is not (yet) a number is left out."""
    counters = {
        plain(name, LONGEST_NAME): float(value)
        for name, value in status.counters[:MOST_COUNTERS]
        if math.isfinite(value)
    }
    return LinkHealth(plain(status.name, LONGEST_NAME), status.ok, health_line(status.text), counters)


def health_line(text: str) -> str:
    """Any text, cut and cleaned for one line of the message."""
    return plain(text, LONGEST_LINE)
