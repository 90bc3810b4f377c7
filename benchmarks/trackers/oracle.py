"""Filters that are told which detection came from which target: the limit that no tracker can pass with their model.

A merged detection counts for each target in it, which is all that anybody can know of them.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarmtrack.benchmarks.trackers.scenes import Scene, Take
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array
from swarmtrack.tracking import manoeuvre
from swarmtrack.tracking.gaussian import update
from swarmtrack.tracking.manoeuvre import ModeMixture
from swarmtrack.tracking.mbm import MbmParameters
from swarmtrack.tracking.motion_model import POSITION, propagate
from swarmtrack.tracking.parameters import CommonParameters

SPEED_SIGMA = CommonParameters().birth_speed_sigma  # px/s, per axis, of a target just met, where nobody tells

Rows = NDArray[np.intp]


class OracleFilter(Protocol):
    """n filters side by side, one a target; those not yet begun hold NaN."""

    def begin(self, rows: Rows, z: Array) -> None: ...

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None: ...

    def update(self, rows: Rows, z: Array) -> None: ...

    def position(self, ahead_s: float = 0.0) -> Array:
        """(n, 2) px, carried on by ahead_s."""
        ...


class ConstantVelocity:
    """Kalman filters with white acceleration."""

    def __init__(self, n: int, scene: Scene) -> None:
        parameters = scene.parameters()
        self._psd = parameters["acceleration_psd"]
        self._R = parameters["measurement_sigma"] ** 2 * np.eye(2)
        self._speed_sigma = parameters.get("birth_speed_sigma", SPEED_SIGMA)
        self._camera: PinholeCamera = scene.camera
        self.mean = np.full((n, 4), np.nan)
        self.cov = np.tile(np.eye(4), (n, 1, 1))

    def begin(self, rows: Rows, z: Array) -> None:
        self.mean[rows] = 0.0
        self.mean[rows, POSITION] = z
        self.cov[rows] = 0.0
        self.cov[rows, POSITION, POSITION] = self._R
        self.cov[rows, 1, 1] = self.cov[rows, 3, 3] = self._speed_sigma**2

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None:
        begun = np.flatnonzero(np.isfinite(self.mean[:, 0]))
        self.mean[begun], self.cov[begun] = propagate(
            self.mean[begun],
            self.cov[begun],
            dt,
            psd=self._psd,
            camera=self._camera,
            rotation=rotation,
            rotation_variance=rotation_variance,
        )

    def update(self, rows: Rows, z: Array) -> None:
        R = np.tile(self._R, (len(rows), 1, 1))
        self.mean[rows], self.cov[rows] = update(self.mean[rows], self.cov[rows], z, R)

    def position(self, ahead_s: float = 0.0) -> Array:
        return np.asarray(self.mean[:, 0::2] + ahead_s * self.mean[:, 1::2])


class Interacting:
    """The default tracker's mix of a calm and an agile motion model, with its parameters."""

    def __init__(self, n: int, scene: Scene) -> None:
        told = scene.parameters()
        names = {entry.name for entry in fields(MbmParameters)}
        parameters = MbmParameters(**{name: value for name, value in told.items() if name in names})  # type: ignore[arg-type]
        self._manoeuvres = parameters.manoeuvres
        self._start = ConstantVelocity(n, scene)
        self._R = parameters.measurement_sigma**2 * np.eye(2)
        self._camera = scene.camera
        self._begun = np.zeros(n, np.bool_)
        unknown = np.full((n, 4), np.nan)
        self._mixture = manoeuvre.begun(unknown, np.tile(np.eye(4), (n, 1, 1)), self._manoeuvres)

    def begin(self, rows: Rows, z: Array) -> None:
        self._start.begin(rows, z)
        self._put(rows, manoeuvre.begun(self._start.mean[rows], self._start.cov[rows], self._manoeuvres))
        self._begun[rows] = True

    def predict(self, dt: float, rotation: Array | None, rotation_variance: float) -> None:
        self._put(self._rows, self._carried(dt, rotation, rotation_variance))

    def update(self, rows: Rows, z: Array) -> None:
        R = np.tile(self._R, (len(rows), 1, 1))
        self._put(rows, manoeuvre.update(self._mixture.select(rows), z, R)[0])

    def position(self, ahead_s: float = 0.0) -> Array:
        found = np.full((len(self._begun), 2), np.nan)
        now = self._carried(ahead_s) if ahead_s else self._mixture.select(self._rows)
        found[self._rows] = manoeuvre.merged(now)[0][:, POSITION]
        return found

    @property
    def _rows(self) -> Rows:
        return np.flatnonzero(self._begun)

    def _carried(
        self, dt: float, rotation: Array | None = None, rotation_variance: float = 0.0
    ) -> ModeMixture:
        return manoeuvre.predict(
            self._mixture.select(self._rows),
            dt,
            self._manoeuvres,
            camera=self._camera,
            rotation=rotation,
            rotation_variance=rotation_variance,
        )

    def _put(self, rows: Rows, mixture: ModeMixture) -> None:
        for whole, part in zip(self._mixture, mixture, strict=True):
            whole[rows] = part


def follow(oracle: OracleFilter, take: Take, ahead: tuple[float, ...] = ()) -> dict[float, Array]:
    """Positions (k, n, 2) px at each scan, and carried on by each of `ahead` [s]; the key 0.0 is that of the scan.

    NaN before a target's first detection, where its start was not told, and while it is absent.
    """
    k, n = take.truth.shape[:2]
    found = {seconds: np.full((k, n, 2), np.nan) for seconds in {0.0, *ahead}}
    begun = np.zeros(n, np.bool_)
    t = take.t[0]
    if take.start is not None:
        oracle.begin(np.arange(n), take.start)
        begun[:] = True
        for seconds, positions in found.items():
            positions[0] = oracle.position(seconds)
    first = k - len(take.observations)
    for step, (scan, made, rotation, variance) in enumerate(take.observations, start=first):
        oracle.predict(scan.t - t, rotation, variance)
        t = scan.t
        seen = np.flatnonzero((made >= 0) & begun)
        oracle.update(seen, scan.z[made[seen]])
        new = np.flatnonzero((made >= 0) & ~begun)
        oracle.begin(new, scan.z[made[new]])
        begun[new] = True
        there = begun & np.isfinite(take.truth[step, :, 0])
        for seconds, positions in found.items():
            positions[step, there] = oracle.position(seconds)[there]
    return found


def smooth(scene: Scene, take: Take) -> Array:
    """The Rauch-Tung-Striebel smoother of `ConstantVelocity`, positions (k, n, 2) px: all scans known at once.

    Bar-Shalom, Li & Kirubarajan (2001), section 8.6. For known starts and an observer at rest.
    """
    assert take.start is not None
    k, n = take.truth.shape[:2]
    oracle = ConstantVelocity(n, scene)
    oracle.begin(np.arange(n), take.start)

    def now() -> tuple[Array, Array]:
        return oracle.mean.copy(), oracle.cov.copy()

    prior, posterior = [now()], [now()]
    for step, (scan, made, _, _) in enumerate(take.observations, start=1):
        oracle.predict(take.t[step] - take.t[step - 1], None, 0.0)
        prior.append(now())
        seen = np.flatnonzero(made >= 0)
        oracle.update(seen, scan.z[made[seen]])
        posterior.append(now())
    smoothed = np.empty((k, n, 4))
    smoothed[-1] = posterior[-1][0]
    for step in range(k - 2, -1, -1):
        (mean, P), (ahead, P_ahead) = posterior[step], prior[step + 1]
        F = np.eye(4)
        F[0, 1] = F[2, 3] = take.t[step + 1] - take.t[step]
        gain = np.linalg.solve(P_ahead, F @ P).swapaxes(1, 2)
        smoothed[step] = mean + (gain @ (smoothed[step + 1] - ahead)[:, :, None])[:, :, 0]
    return smoothed[:, :, POSITION]
