"""Tracks that go over from one camera's filter to another's: all that is known of them, in the pixels of the new one.

Two images of one drone differ by a turn, by their intrinsics, and by how far apart the cameras sit. The filter that
gives a track away carries it on and turns it (`Filter.release`), as it does from scan to scan; what is left is linear
in pixels. Only between an ordinary and a wide lens, whose undistorted pixels are of two kinds, the turn is part of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking.manoeuvre import PLACE_OF_AGILE, ModeMixture, turned
from swarmtrack.tracking.motion_model import POSITION, turn_into
from swarmtrack.tracking.table import TrackTable


class Passage(NamedTuple):
    """n tracks on their way. motion: what a filter with two models knows of them; None: `table` is all."""

    table: TrackTable
    motion: ModeMixture | None

    def select(self, mask: NDArray[np.bool_]) -> Passage:
        """Those whose mask (n,) is True."""
        motion = None if self.motion is None else self.motion.select(np.flatnonzero(mask))
        return Passage(self.table.select(mask), motion)

    def turned_into(self, camera: PinholeCamera, before: PinholeCamera, rotation: Array) -> Passage:
        """The same tracks for a camera that looks another way through a lens of the other kind; rotation (3, 3): its
        axes from those of the camera before."""
        turn = turn_into(before)
        table = self.table
        per_radian = before.box_per_radian(table.mean[:, POSITION])
        mean, F = turn(table.mean, rotation, camera)
        table = replace(
            table,
            mean=mean,
            cov=F @ table.cov @ F.swapaxes(1, 2),
            size=table.size * camera.box_per_radian(mean[:, POSITION]) / per_radian,
        )
        if self.motion is None:
            return Passage(table, None)
        mean, cov, mode = self.motion
        return Passage(table, ModeMixture(*turned(mean, cov, rotation, camera, turn), mode))

    def in_pixels_of(self, camera: PinholeCamera, before: PinholeCamera) -> Passage:
        """The same tracks for a camera that looks the same way through another lens of the same kind."""
        scale = np.array([camera.fx / before.fx, camera.fy / before.fy])
        shift = np.array([camera.cx, camera.cy]) - scale * (before.cx, before.cy)
        by_axis = np.repeat(scale, 2)
        placed = self.table.mean * by_axis
        placed[:, POSITION] += shift
        table = replace(
            self.table,
            mean=placed,
            cov=self.table.cov * (by_axis[:, None] * by_axis),
            size=self.table.size * scale,
        )
        if self.motion is None:
            return Passage(table, None)
        mean, cov, mode = self.motion
        by_axis = np.concatenate([by_axis, scale])
        mean = mean * by_axis
        mean[..., PLACE_OF_AGILE] += shift
        return Passage(table, ModeMixture(mean, cov * (by_axis[:, None] * by_axis), mode))

    def moved(self, by: Array, cov: Array) -> Passage:
        """The same tracks moved by (n, 2) px, and as much less certain; cov (n, 2, 2) px²."""
        mean, spread = self.table.mean.copy(), self.table.cov.copy()
        mean[:, POSITION] += by
        spread[:, POSITION, POSITION] += cov
        table = replace(self.table, mean=mean, cov=spread)
        if self.motion is None:
            return Passage(table, None)
        means, covs = self.motion.mean.copy(), self.motion.cov.copy()
        means[..., PLACE_OF_AGILE] += by[:, None]
        covs[..., PLACE_OF_AGILE, PLACE_OF_AGILE] += cov[:, None]
        return Passage(table, ModeMixture(means, covs, self.motion.mode))
