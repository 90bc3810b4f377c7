"""`range/<id>/<other>`: range to drone <other>, measured by a ranging radio on drone <id>."""

from __future__ import annotations

from typing import Annotated, ClassVar

from msgspec import Meta

from swarmtrack.messages import RangeReport
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.fields import WIRE_VERSION, DroneId, PeerMessage, Seconds

Distance = Annotated[float, Meta(gt=0.0, le=1e4)]
"""m."""


class RangeMessage(PeerMessage, frozen=True):
    """`range/<id>/<other>`: a range, `age_s` before these bytes were made, with its standard deviation.

    boot: of the process that reads the radio, which need not be an agent. sequence counts its messages about this
    teammate.
    """

    what: ClassVar[str] = "range"
    age_s: Seconds
    other: DroneId
    distance_m: Distance
    sigma_m: Distance


def range_message(
    report: RangeReport, boot: str, sequence: int, utc_offset: float, now: float
) -> RangeMessage:
    """The own range message as sent at `now`."""
    r = report
    return RangeMessage(
        WIRE_VERSION,
        r.drone_id,
        boot,
        sequence,
        float(r.t + utc_offset),
        float(r.t_sigma),
        age_s=max(0.0, float(now - r.t)),
        other=r.other,
        distance_m=float(r.distance),
        sigma_m=float(r.sigma),
    )


def check(message: RangeMessage) -> None:
    """Raise DecodeError for an invalid message."""
    if message.other == message.drone_id:
        raise DecodeError(f"range: other: found {message.other}, expected another drone than drone_id")


def range_from(message: RangeMessage, t: float, t_sigma: float) -> RangeReport:
    """The measured range as the core takes it. t: time of the measurement, on our monotonic clock."""
    m = message
    return RangeReport(m.drone_id, m.other, t, t_sigma, m.distance_m, m.sigma_m)
