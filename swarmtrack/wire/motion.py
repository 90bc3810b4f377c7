"""`motion/<id>`: how a drone moves, for teammates that want to know it by that."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from swarmtrack.messages import MotionReport
from swarmtrack.wire.checks import check_covariances, symmetric, upper_triangle
from swarmtrack.wire.fields import Moment, PeerMessage, Position, Seconds, Velocity, peer_fields

Upper3 = Annotated[tuple[Moment, ...], Meta(min_length=6, max_length=6)]


class MotionMessage(PeerMessage, frozen=True):
    """`motion/<id>`: how one drone's body moved, `age_s` before these bytes were made, along the team's NED axes.

    displacement_m: from where it was when its process first knew its place, which says nothing of where that was.
    *_cov_*: upper triangle, row by row. sequence counts what this boot published.
    """

    what: ClassVar[str] = "motion"
    age_s: Seconds
    displacement_m: Position
    displacement_cov_m2: Upper3
    velocity_m_s: Velocity
    velocity_cov_m2_s2: Upper3


def motion_message(report: MotionReport, utc_offset: float, now: float) -> MotionMessage:
    """Ours as it goes on the wire at `now`."""
    r = report
    return MotionMessage(
        *peer_fields(r.drone_id, r, utc_offset),
        age_s=max(0.0, float(now - r.t)),
        displacement_m=tuple(r.displacement.tolist()),
        displacement_cov_m2=upper_triangle(r.displacement_cov),
        velocity_m_s=tuple(r.velocity.tolist()),
        velocity_cov_m2_s2=upper_triangle(r.velocity_cov),
    )


def check(message: MotionMessage) -> None:
    """Raises DecodeError."""
    check_covariances("motion: displacement_cov_m2", [message.displacement_cov_m2], 3)
    check_covariances("motion: velocity_cov_m2_s2", [message.velocity_cov_m2_s2], 3)


def motion_from(message: MotionMessage, t: float, t_sigma: float) -> MotionReport:
    """A teammate's report for us. t: when it moved so, on our monotonic clock."""
    m = message
    return MotionReport(
        drone_id=m.drone_id,
        boot=m.boot,
        sequence=m.sequence,
        t=t,
        t_sigma=t_sigma,
        displacement=np.array(m.displacement_m),
        displacement_cov=symmetric(np.array([m.displacement_cov_m2]), 3)[0],
        velocity=np.array(m.velocity_m_s),
        velocity_cov=symmetric(np.array([m.velocity_cov_m2_s2]), 3)[0],
    )
