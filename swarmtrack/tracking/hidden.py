"""Tracks on the part of the sphere that a camera's tangent plane does not hold.

Theory of operation. A track whose direction is known is not lost when the camera turns away. Until 70 degrees off the
axis a track out of view goes on in the tangent plane, like any other. From there on it is a row of a second filter of
the same kind, for a lens that sees nothing: its plane is stereographic and holds all directions but the one straight
behind. Once the camera has turned back, the track returns with its number, its motion and its doubts, and is matched
where it should be.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import Equidistant, PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking.motion_model import POSITION
from swarmtrack.tracking.passage import Passage
from swarmtrack.tracking.population import is_gone
from swarmtrack.tracking.priors import HIDDEN_FROM_RAD, HIDDEN_MOST_SIGMA_RAD, HIDDEN_UNTIL_RAD
from swarmtrack.tracking.table import TrackTable

_EYE = np.eye(3)


class Carrier(Protocol):
    """The parts of a `Filter` that carry tracks."""

    @property
    def table(self) -> TrackTable: ...

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None: ...

    def release(
        self, rows: NDArray[np.bool_], dt: float, rotation: Array | None, rotation_variance: float
    ) -> Passage: ...

    def adopt(self, arriving: Passage) -> None: ...


def all_around(camera: PinholeCamera) -> PinholeCamera:
    """A lens that looks the same way, with as many pixels per radian on its axis, and a stereographic plane."""
    width, height = (round(2.0 * math.pi * focal) for focal in (camera.fx, camera.fy))
    return PinholeCamera(
        camera.fx,
        camera.fy,
        0.5 * (width - 1),
        0.5 * (height - 1),
        width,
        height,
        Equidistant((0.0, 0.0, 0.0, 0.0)),
    )


class HiddenTracks:
    """Hidden tracks of one camera with an ordinary lens. around: a filter for the lens `all_around`."""

    def __init__(self, camera: PinholeCamera, lens: PinholeCamera, around: Carrier) -> None:
        self._camera, self._lens, self._filter = camera, lens, around

    def __len__(self) -> int:
        return len(self._filter.table)

    def carry(self, filter: Carrier, dt: float, rotation: Array, rotation_variance: float) -> Passage | None:
        """Carry them on by dt, with those that the rotation takes out of the camera's plane. Returns those that come
        back, in its pixels; None where there are none. The arguments are those of `Filter.predict`.
        """
        gone = is_gone(filter.table)
        if gone.any():
            depth = self._camera.bearing_undistorted(filter.table.mean[:, POSITION]) @ rotation[2]
            leaving = gone & (depth < math.cos(HIDDEN_FROM_RAD))
            if leaving.any():
                away = filter.release(leaving, 0.0, None, 0.0)
                self._filter.adopt(away.turned_into(self._lens, self._camera, _EYE))
        if not len(self):
            return None
        self._filter.predict(dt, rotation, rotation_variance)
        table = self._filter.table
        table.last_seen += dt
        self._release(~self._placed())
        ahead = self._lens.bearing_undistorted(table.mean[:, POSITION])[:, 2] > math.cos(HIDDEN_UNTIL_RAD)
        back = self._release(ahead)
        return None if back is None else back.turned_into(self._camera, self._lens, _EYE)

    def _placed(self) -> NDArray[np.bool_]:
        """(n,) those whose direction is known."""
        table = self._filter.table
        focal = self._lens.per_radian(table.mean[:, POSITION])
        sigma = np.sqrt(table.cov.diagonal(axis1=1, axis2=2)[:, POSITION]) / focal
        return np.asarray(sigma.max(axis=1) < HIDDEN_MOST_SIGMA_RAD)

    def _release(self, rows: NDArray[np.bool_]) -> Passage | None:
        return self._filter.release(rows, 0.0, None, 0.0) if rows.any() else None
