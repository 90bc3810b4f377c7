"""How two cameras of a drone are turned against each other, learned from tracks that cross the seam between them.

Theory of operation. A mounting is known to a degree or so, and its error lasts. The rotation from one camera's axes to
another's is exp(δ) R, with R as it was told and δ (3,) rad in the second one's axes, N(0, 2 σ² I) before the flight. A
track that goes over was foretold by the one camera alone and is detected by the other: the residual is the flow of δ at
that pixel, and noise. Two of the three angles show at each crossing, the third by crossings elsewhere in the picture.
All is linear, so what is known of δ is a Gaussian in information form, and each seam is used as well as it is known.

Only the first detection counts of a track that had been with the other camera for a while: where two pictures overlap a
track goes back and forth, and what is foretold then is half the second camera's own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking.motion_model import optical_flow

# rad: no seam is known better. What a crossing adds beside noise lasts as well: lenses, parallax, boxes off centre.
LEAST_SIGMA = math.radians(0.15)
# Squared Mahalanobis distance of a residual, in two dimensions: beyond it something else was detected.
GATE = 16.0
# A turn is news once so many crossings tell it, it is so large [rad], and by crossings alone is not zero by so many
# squared sigmas.
TELLING, WORTH_SAYING, SURE = 4, math.radians(0.5), 25.0
# Cameras do not fit together once so many targets that left one did not come into the other, for each that did.
LOST, LOST_FOR_EACH = 4, 4
# px²: of a detection and of what was foretold, beside what they say of themselves.
LASTING_PX2 = 1.0


class FoundTurn(NamedTuple):
    """By how much a camera is turned against another beside what was told: angle (3,) rad in its axes; sigma rad, of
    the angle that is known worst; crossings that told it."""

    angle: Array
    sigma: float
    crossings: int


class SeamNews(NamedTuple):
    """How the second of two cameras sits beside the first, by crossings: turned by so much beside what was told, so
    that body_from_second (3, 3) would fit; both None: targets that leave one do not come into the other, so that cables
    may be swapped, or a mounting is far off."""

    first: int
    second: int
    turn: FoundTurn | None
    body_from_second: Array | None


class Seam:
    """Between two cameras; `second_from_first` (3, 3) as it was told, ± mounting_sigma [rad] per axis."""

    def __init__(self, second_from_first: Array, mounting_sigma: float) -> None:
        self._told = second_from_first
        self._prior = np.eye(3) / max(mounting_sigma, LEAST_SIGMA) ** 2
        self._information = self._prior
        self._sum = np.zeros(3)
        self.crossings = 0
        self.refused = 0
        self.lost = 0
        """Targets that should have been seen after they crossed, and were not."""
        self._settle()

    def _settle(self) -> None:
        self._cov = np.linalg.inv(self._information)
        self._angle = self._cov @ self._sum
        self.second_from_first: Array = rotation.exp(self._angle) @ self._told
        """(3, 3): as it is known by now."""

    @property
    def found(self) -> FoundTurn:
        worst = float(np.linalg.eigvalsh(self._cov)[-1])
        return FoundTurn(self._angle, math.sqrt(worst), self.crossings)

    @property
    def is_turned(self) -> bool:
        """Whether it is sure, and worth a word, that the second camera is turned beside what was told."""
        sure = float(self._angle @ (self._information - self._prior) @ self._angle) > SURE
        return sure and self.crossings >= TELLING and float(np.linalg.norm(self._angle)) > WORTH_SAYING

    @property
    def fits(self) -> bool:
        """Whether what leaves one camera comes into the other, as far as is known."""
        return self.lost < max(LOST, LOST_FOR_EACH * self.crossings)

    def flow_cov(self, pixel: Array, camera: PinholeCamera, *, to_second: bool) -> Array:
        """(n, 2, 2) px² that the seam adds to tracks at pixels (n, 2) of the camera that they go to."""
        flow = self._flow(pixel, camera, to_second=to_second)
        return np.asarray(flow @ (self._cov + LEAST_SIGMA**2 * np.eye(3)) @ flow.swapaxes(1, 2))

    def learn(self, foretold: Array, cov: Array, z: Array, camera: PinholeCamera, *, to_second: bool) -> None:
        """A track was foretold at a pixel (2,) and detected at z (2,); cov (2, 2) px²: of both but for the seam."""
        flow = self._flow(foretold[None], camera, to_second=to_second)[0]
        value, axes = np.linalg.eigh(cov)
        # Of a difference of two covariances only the positive part is one.
        S = (axes * np.maximum(value, 0.0)) @ axes.T + LASTING_PX2 * np.eye(2)
        # Against what is known: the residual of the angle as it is used.
        residual = z - foretold
        expected = S + flow @ self._cov @ flow.T
        if float(residual @ np.linalg.solve(expected, residual)) > GATE:
            self.refused += 1
            return
        weighed = np.linalg.solve(S, flow)
        self._information = self._information + flow.T @ weighed
        self._sum = self._sum + weighed.T @ (residual + flow @ self._angle)
        self.crossings += 1
        self._settle()

    def _flow(self, pixel: Array, camera: PinholeCamera, *, to_second: bool) -> Array:
        """(n, 2, 3) px/rad: by δ in the second camera's axes. A ray that turns one way is a camera that turns the
        other."""
        flow = optical_flow(pixel, camera)
        return -flow if to_second else flow @ self.second_from_first.T
