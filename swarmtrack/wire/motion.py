"""`motion/<id>`: velocity and displacement of a drone, for teammates that identify it by motion."""

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

    displacement_m: from the first known position of its process, which itself is not stated. *_cov_*: upper triangle,
    row by row. sequence counts what this boot published.
    """

    what: ClassVar[str] = "motion"
    age_s: Seconds
    displacement_m: Position
    displacement_cov_m2: Upper3
    velocity_m_s: Velocity
    velocity_cov_m2_s2: Upper3


def motion_message(report: MotionReport, utc_offset: float, now: float) -> MotionMessage:
    """The own motion report as sent at `now`."""
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
    """Raise DecodeError for an invalid message."""
    check_covariances("motion: displacement_cov_m2", [message.displacement_cov_m2], 3)
    check_covariances("motion: velocity_cov_m2_s2", [message.velocity_cov_m2_s2], 3)


def motion_from(message: MotionMessage, t: float, t_sigma: float) -> MotionReport:
    """A teammate's motion report as the core takes it. t: time of the motion, on our monotonic clock."""
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
