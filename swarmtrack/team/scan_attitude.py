"""The error of this drone's attitude in one scan, by the tracks that have names.

An attitude's error turns all rays of a scan alike. Where many tracks have names it is seen in all of them at once, and
the rest of a ray's error is a third of it. Each ray is turned back by what the others say, not by itself: it is to be
compared with teammates without having been fitted to one. A ray that is farther off than any attitude turns it says
nothing: its teammate is elsewhere, or another.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.team.priors import ATTITUDE_LASTING_SIGMA_RAD, BEARING_SIGMA_RAD

_PRIOR_VARIANCE = BEARING_SIGMA_RAD**2 + ATTITUDE_LASTING_SIGMA_RAD**2
_GATE = 16.0
"""Squared sigmas, of a ray less what is expected."""


class NamedRay(NamedTuple):
    """A track's direction (3,), unit, and where its teammate is by what is known of it (3,), unit; probability of that
    name; variance [rad²]: of the one less the other, without the attitude."""

    direction: Array
    expected: Array
    probability: float
    variance: float


class ScanAttitude:
    """Error of one scan's attitude: what is turned back, and by how much rays are still wrong."""

    def __init__(self, rays: Mapping[int, NamedRay]) -> None:
        """rays: by track."""
        self._rows = {track: i for i, track in enumerate(rays)}
        d, expected, probability, variance = map(np.array, zip(*rays.values(), strict=True))
        off = expected - d
        fits = (off**2).sum(axis=1) < _GATE * (variance + _PRIOR_VARIANCE)
        weight = fits * probability / variance
        # expected = d + θ × d: information of each ray on θ.
        self._each = weight[:, None, None] * (np.eye(3) - d[:, :, None] * d[:, None, :])
        self._said = weight[:, None] * np.cross(d, off)
        self._information = np.eye(3) / _PRIOR_VARIANCE + self._each.sum(axis=0)
        self._sum = self._said.sum(axis=0)

    def turned_back(self, directions: Mapping[int, Array]) -> dict[int, tuple[Array, float]]:
        """Directions (3,) by track, without this error; and what is left of the error's variance, as a share. A track's
        own ray does not count."""
        d = np.array(list(directions.values()))
        at = [(i, self._rows[track]) for i, track in enumerate(directions) if track in self._rows]
        of, rows = np.array(at, int).reshape(-1, 2).T
        information = np.tile(self._information, (len(d), 1, 1))
        said = np.tile(self._sum, (len(d), 1))
        information[of] -= self._each[rows]
        said[of] -= self._said[rows]
        cov = np.linalg.inv(information)
        turned = d + np.cross((cov @ said[:, :, None])[:, :, 0], d)
        turned /= np.linalg.norm(turned, axis=1)[:, None]
        along = (d[:, None] @ cov @ d[:, :, None])[:, 0, 0]
        left = 0.5 * (np.trace(cov, axis1=1, axis2=2) - along) / _PRIOR_VARIANCE
        return dict(zip(directions, zip(turned, left.tolist(), strict=True), strict=True))
