"""Rotation between two cameras of a drone, estimated from tracks at the seam between them.

Theory of operation. A mounting is known to a degree or so, and its error lasts. The rotation from one camera's axes to
another's is exp(δ) R, with R as it was told and δ (3,) rad in the second one's axes, N(0, 2 σ² I) before the flight. A
track that goes over was foretold by the one camera alone and is detected by the other: the residual is the flow of δ at
that pixel, and noise. Two of the three angles show at each crossing, the third by crossings elsewhere in the picture.
All is linear, so what is known of δ is a Gaussian in information form, and each seam is used as well as it is known.

Of a crossing only the first detection counts, of a track that had been with the other camera for a while: where two
pictures overlap a track goes back and forth, and what is foretold then is half the second camera's own.

There the *detections* of the two cameras are compared, and no state: two of the one, with one of the other between them
in time, each turned by the gyro to the instant of the middle one. Interpolated, a constant motion drops out, and no
detection is used twice, so that the noise of each comparison is its own. What is not its own is what lasts for as long
as the target stays: half the parallax, for the size of a drone is a guess, and the middle of its box. A *stay* is
therefore a least squares of its own for six numbers, δ, how wrong the parallax is (a factor 1 + s), and a shift e of
two pixels; the latter three have priors that never get better from one target to the next, and are integrated out. So a
drone that hovers for an hour tells δ no better than its box is centred. And what is known of all six is what a track of
this target is moved by, and made less certain, when it goes over: its two pictures agree before the mounting is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from swarmtrack.cameras.priors import (
    COMPARISONS_PER_CROSSING,
    SEAM_DISTANCE_SIGMA,
    SEAM_LASTING_PX2,
    SEAM_LEAST_SIGMA_RAD,
    SEAM_LOST_PER_CROSSING,
    SEAM_LOST_TARGETS,
    SEAM_RESIDUAL_GATE,
    SEAM_TURN_GATE,
    SEAM_TURN_LEAST_CROSSINGS,
    SEAM_TURN_LEAST_RAD,
    STAY_ENDS_AFTER_S,
    STAY_REACH_PX,
)
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking.motion_model import optical_flow

_OF_A_STAY = np.diag([1.0 / SEAM_DISTANCE_SIGMA**2, 1.0 / SEAM_LASTING_PX2, 1.0 / SEAM_LASTING_PX2])


class FoundTurn(NamedTuple):
    """Rotation of a camera relative to another, on top of the configured one: angle (3,) rad in its axes; sigma
    rad, of the angle that is known worst; crossings that told it; comparisons of detections, where two pictures
    overlap.
    """

    angle: Array
    sigma: float
    crossings: int
    compared: int = 0


class SeamNews(NamedTuple):
    """Mounting of the second of two cameras relative to the first, by crossings: turned by so much from the
    configured one, so that body_from_second (3, 3) would fit; both None: targets that leave one do not come into
    the other, so that cables may be swapped, or a mounting is far off.
    """

    first: int
    second: int
    turn: FoundTurn | None
    body_from_second: Array | None


@dataclass(slots=True)
class _Stay:
    """Of one track where two pictures overlap: where it began (2,) px of the second camera, when it was last compared,
    and the information (6, 6) and its sum (6,) about δ, s and e, by its comparisons alone."""

    pixel: Array
    t: float
    information: Array = field(default_factory=lambda: np.zeros((6, 6)))
    sum: Array = field(default_factory=lambda: np.zeros(6))

    def about_the_turn(self) -> tuple[Array, Array]:
        """Information (3, 3) and its sum (3,) about δ alone."""
        kept = np.linalg.solve(self.information[3:, 3:] + _OF_A_STAY, self.information[3:])
        told = np.linalg.solve(self.information[3:, 3:] + _OF_A_STAY, self.sum[3:])
        across = self.information[:3, 3:]
        return self.information[:3, :3] - across @ kept[:, :3], self.sum[:3] - across @ told


class SeamDisagreement(NamedTuple):
    """Disagreement of the two pictures about one target, relative to the δ in use: the parallax is off by a factor
    1 + s, and the second picture shows it shifted (2,) px; cov (6, 6) of δ, s and that shift.
    """

    s: float
    shift: Array
    cov: Array


class SeamComparison(NamedTuple):
    """At t [s] the first camera's detections put a target at a pixel (2,) of the second one, with a parallax of `by`
    (2,) px in it, and its own put it at z (2,); noise (2, 2) px²: of both."""

    t: float
    foretold: Array
    z: Array
    noise: Array
    by: Array


class Seam:
    """Seam between two cameras; `second_from_first` (3, 3) as configured, ± mounting_sigma [rad] per axis."""

    def __init__(self, second_from_first: Array, mounting_sigma: float) -> None:
        self._told = second_from_first
        self._prior = np.eye(3) / max(mounting_sigma, SEAM_LEAST_SIGMA_RAD) ** 2
        self._information = self._prior
        self._sum = np.zeros(3)
        self._stays: dict[int, _Stay] = {}
        """By track."""
        self.crossings = 0
        self.compared = 0
        self.refused = 0
        self.lost = 0
        """Targets that should have been seen after they crossed, and were not."""
        self._settle()

    def _settle(self) -> None:
        information, weighted = self._of_all()
        self._cov = np.linalg.inv(information)
        self._angle = self._cov @ weighted
        self.second_from_first: Array = rotation.exp(self._angle) @ self._told
        """(3, 3): as it is known by now."""

    @property
    def found(self) -> FoundTurn:
        worst = float(np.linalg.eigvalsh(self._cov)[-1])
        return FoundTurn(self._angle, math.sqrt(worst), self.crossings, self.compared)

    @property
    def _told_by(self) -> int:
        """Crossings, and what is worth as many."""
        return self.crossings + self.compared // COMPARISONS_PER_CROSSING

    @property
    def is_turned(self) -> bool:
        """Whether the second camera's rotation certainly and noticeably differs from the configured one."""
        learned = self._of_all()[0] - self._prior
        sure = float(self._angle @ learned @ self._angle) > SEAM_TURN_GATE
        return (
            sure
            and self._told_by >= SEAM_TURN_LEAST_CROSSINGS
            and float(np.linalg.norm(self._angle)) > SEAM_TURN_LEAST_RAD
        )

    @property
    def fits(self) -> bool:
        """Whether what leaves one camera comes into the other, as far as is known."""
        return self.lost < max(SEAM_LOST_TARGETS, SEAM_LOST_PER_CROSSING * self._told_by)

    def flow_cov(self, pixel: Array, camera: PinholeCamera, *, to_second: bool) -> Array:
        """(n, 2, 2) px² that the seam adds to tracks at pixels (n, 2) of the camera that they go to."""
        flow = self.flow(pixel, camera, to_second=to_second)
        return np.asarray(flow @ (self._cov + SEAM_LEAST_SIGMA_RAD**2 * np.eye(3)) @ flow.swapaxes(1, 2))

    @property
    def angle(self) -> Array:
        """(3,) rad: δ as it is used now."""
        return self._angle

    def update(
        self, foretold: Array, cov: Array, z: Array, camera: PinholeCamera, *, to_second: bool, by: Array
    ) -> None:
        """Update with a track predicted at a pixel (2,) and detected at z (2,), `by` the rotation (3,) since its
        handover; cov (2, 2) px²: of both, without the seam's.
        """
        flow = self.flow(foretold[None], camera, to_second=to_second)[0]
        value, axes = np.linalg.eigh(cov)
        # Of a difference of two covariances only the positive part is one.
        S = (axes * np.maximum(value, 0.0)) @ axes.T + SEAM_LASTING_PX2 * np.eye(2)
        # Others may have told of the angle since.
        residual = z - foretold
        surprise = residual - flow @ (self._angle - by)
        expected = S + flow @ self._cov @ flow.T
        if float(surprise @ np.linalg.solve(expected, surprise)) > SEAM_RESIDUAL_GATE:
            self.refused += 1
            return
        weighed = np.linalg.solve(S, flow)
        self._information = self._information + flow.T @ weighed
        self._sum = self._sum + weighed.T @ (residual + flow @ by)
        self.crossings += 1
        self._settle()

    def compare(self, track_id: int, compared: SeamComparison, camera: PinholeCamera) -> None:
        """What both cameras detected of a track's target; camera: the second one."""
        t, foretold, z, noise, by = compared
        stay = self._stays.get(track_id)
        if stay is not None and float(np.linalg.norm(z - stay.pixel)) > STAY_REACH_PX:
            self._end(track_id)
            stay = None
        flow = self.flow(foretold[None], camera, to_second=True)[0]
        H = np.column_stack([flow, by, np.eye(2)])
        residual = z - foretold
        known = self._disagreement(stay or _Stay(z, t))
        surprise = residual - by * known.s - known.shift
        expected = noise + H @ known.cov @ H.T
        if float(surprise @ np.linalg.solve(expected, surprise)) > SEAM_RESIDUAL_GATE:
            self.refused += 1
            return
        if stay is None:
            stay = self._stays[track_id] = _Stay(z, t)
        weighed = np.linalg.solve(noise, H)
        stay.t = t
        stay.information = stay.information + H.T @ weighed
        stay.sum = stay.sum + weighed.T @ (residual + flow @ self._angle)
        self.compared += 1
        self._settle()

    def disagreement(self, track_id: int, t: float) -> SeamDisagreement | None:
        """About the target of a track that stays where both pictures show it; None: it does not, or not yet."""
        stay = self._stays.get(track_id)
        return None if stay is None or t - stay.t > STAY_ENDS_AFTER_S else self._disagreement(stay)

    def end_stays(self, t: float) -> None:
        """End the comparison of targets that were not detected in both cameras for a while."""
        for track_id in [id for id, stay in self._stays.items() if t - stay.t > STAY_ENDS_AFTER_S]:
            self._end(track_id)

    def _end(self, track_id: int) -> None:
        information, weighted = self._stays.pop(track_id).about_the_turn()
        self._information = self._information + information
        self._sum = self._sum + weighted

    def _of_all(self, but: _Stay | None = None) -> tuple[Array, Array]:
        """Information (3, 3) and its sum (3,) by crossings and by all stays, but one."""
        information, weighted = self._information, self._sum
        for stay in self._stays.values():
            if stay is not but:
                more, of_it = stay.about_the_turn()
                information, weighted = information + more, weighted + of_it
        return information, weighted

    def _disagreement(self, stay: _Stay) -> SeamDisagreement:
        information, weighted = stay.information.copy(), stay.sum.copy()
        by_others, of_others = self._of_all(but=stay)
        information[:3, :3] += by_others
        information[3:, 3:] += _OF_A_STAY
        weighted[:3] += of_others
        cov = np.asarray(np.linalg.inv(information), dtype=float)
        mean = cov @ weighted
        return SeamDisagreement(float(mean[3]), mean[4:], cov)

    def flow(self, pixel: Array, camera: PinholeCamera, *, to_second: bool) -> Array:
        """(n, 2, 3) px/rad: by δ in the second camera's axes. A ray that turns one way is a camera that turns the
        other."""
        flow = optical_flow(pixel, camera)
        return -flow if to_second else flow @ self.second_from_first.T
