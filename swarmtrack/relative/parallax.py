"""What looks like a near drone and stands far off in the world: told by parallax.

A detector takes a part of a house at 40 m for a drone at 5 m, and the size of its box says so again in every frame.
What tells the two apart is the own way. A point that stands still, seen first along m from c₀, is seen from c₀ + u
along m − q u, with q the inverse of its range (Civera, Davison & Montiel, 2008). With E across m, the ray d and z =
Eᵀd / (m·d), that is linear in where it stands across m, a, and in q. But a near drone that flies along with us is seen
like that, too. So the fit leaves room for what flies at any steady velocity, b, and only the bends of the own way tell
of ranges: no stranger flies our bends.

    z = a + b t − q (Eᵀu − z m·u)

Theory of operation. Each track without a name has such a fit, which forgets within `PARALLAX_FORGET_S`. It is far off
once

* the fit says so by two sigmas, from bends that are long compared with a hovering drone's sway: else a near drone that
  happens to sway along with us would be far off as well;
* and it does not grow: the slope of ln(width) shows that it takes 16 s at least to come.

It is so no longer, and has to be shown again,

* when it is not where the fit expects it: it does not stand still, or the track is another thing by now; * when it has
grown: what was beyond `PARALLAX_FAR_M` is beyond `PARALLAX_REACH_M` until it appears larger by their quotient. That
needs
  no range, and no drone approaches without growing;
* when the own place has leapt: a leap that was not flown is a bend in which nothing moved, so that all were far off.

A track that begins where one that has ended is expected, and as large, goes on with its fit: who turns to and fro loses
the same house again and again, and a detector that is not sure of it does so every second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.motion.leap import has_leapt
from swarmtrack.relative.log_range import across
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.priors import (
    PARALLAX_ATTITUDE_SIGMA_RAD,
    PARALLAX_FAR_M,
    PARALLAX_FORGET_S,
    PARALLAX_GROWN_LOG_WIDTH,
    PARALLAX_GROWTH_PER_S,
    PARALLAX_LEAST_ACROSS_M,
    PARALLAX_LEAST_LOOKS,
    PARALLAX_LEAST_S,
    PARALLAX_LOG_WIDTH_SIGMA,
    PARALLAX_MISFIT,
    PARALLAX_NEARER_SIGMAS,
    PARALLAX_REACH_M,
    PARALLAX_RECENT_MISFIT,
    PARALLAX_RECENT_S,
    PARALLAX_REMEMBERED_LOOKS,
    PARALLAX_REMEMBERED_S,
    PARALLAX_SAME_PLACE_GATE,
    PARALLAX_TURNED_COSINE,
)


class _Sight(NamedTuple):
    """Of one track at t [s]: from camera (3,) m along ray (3,), variance rad² per axis; ln(width), NaN: not known."""

    t: float
    camera: Array
    ray: Array
    variance: float
    log_width: float


class _Projected(NamedTuple):
    """A sight as a fit has it: z (2,) and H (2, 5); along: the own way towards it, m."""

    z: Array
    H: Array
    along: float

    def closer(self, x: Array) -> float:
        """Its range over that from c₀, by the fit's x; not below a tenth."""
        return max(1.0 - min(max(float(x[4]), 0.0), 1.0 / PARALLAX_REACH_M) * self.along, 0.1)


class _Solved(NamedTuple):
    """a, b and q: x (5,) with its cov (5, 5); bends: of the own way across the ray, m RMS."""

    x: Array
    cov: Array
    bends: float


@dataclass(slots=True)
class _Fit:
    """Of one track, since it was seen from `camera` (3,) m along m (3,) at `begun` [s].

    information (5, 5) and vector (5,): of a, b and q. sizing (2, 2) and sized (2,): of ln(width), as it would be from
    c₀, as a line over time. weight and sizes: of all looks and of all widths; misfit, width: means over the fit, of
    squared residuals and of ln(width); misfit_now, width_now: the same of late.
    """

    begun: float
    t: float
    camera: Array
    m: Array
    E: Array
    information: Array = field(default_factory=lambda: np.zeros((5, 5)))
    vector: Array = field(default_factory=lambda: np.zeros(5))
    sizing: Array = field(default_factory=lambda: np.zeros((2, 2)))
    sized: Array = field(default_factory=lambda: np.zeros(2))
    looks: int = 0
    weight: float = 0.0
    misfit: float = 0.0
    misfit_now: float = 0.0
    sizes: float = 0.0
    width: float = 0.0
    width_now: float = 0.0
    far: bool = False

    @classmethod
    def begin(cls, sight: _Sight) -> _Fit:
        fit = cls(sight.t, sight.t, sight.camera, sight.ray, across(sight.ray[None])[0])
        fit.take_in(sight)
        return fit

    def projected(self, sight: _Sight) -> _Projected | None:
        """None where it is turned too far from where it was seen first."""
        ahead = float(self.m @ sight.ray)
        if ahead < PARALLAX_TURNED_COSINE:
            return None
        u = sight.camera - self.camera
        along, z = float(self.m @ u), self.E.T @ sight.ray / ahead
        H = np.zeros((2, 5))
        H[0, 0] = H[1, 1] = 1.0
        H[0, 2] = H[1, 3] = sight.t - self.begun
        H[:, 4] = along * z - self.E.T @ u
        return _Projected(z, H, along)

    def solved(self) -> _Solved:
        # A sigma of 1 each: nothing is known in front of the first looks.
        cov = np.asarray(np.linalg.inv(self.information + np.eye(5)), np.float64)
        weight = max(0.5 * float(self.information[0, 0] + self.information[1, 1]), 1e-9)
        lever = max(1.0 / float(cov[4, 4]) - 1.0, 0.0)
        return _Solved(cov @ self.vector, cov, math.sqrt(lever / weight))

    def take_in(self, sight: _Sight) -> bool:
        """False where the fit is at its end: it has been contradicted."""
        seen = self.projected(sight)
        if seen is None:
            return False
        z, H, along = seen
        # A sight of another camera may be a little older than the last one.
        newest = max(sight.t, self.t)
        dt, self.t = newest - self.t, newest
        kept = math.exp(-dt / PARALLAX_FORGET_S)
        self.information = kept * self.information + H.T @ H / sight.variance
        self.vector = kept * self.vector + H.T @ z / sight.variance
        # The noise of z is in H as well, times the way along the ray: it must not count as a bend of the way.
        self.information[4, 4] -= 2.0 * along * along
        self.vector[4] -= 2.0 * along
        self.looks += 1
        self.weight = kept * self.weight + 1.0
        solved = self.solved()
        residual = z - H @ solved.x
        misfit = float(residual @ residual) / (2.0 * sight.variance)
        self.misfit += (misfit - self.misfit) / self.weight
        self.misfit_now += (misfit - self.misfit_now) * max(
            -math.expm1(-dt / PARALLAX_RECENT_S), 1.0 / self.looks
        )
        if math.isfinite(sight.log_width):
            self._take_in_width(sight.log_width + math.log(seen.closer(solved.x)), dt)
        known = sight.t - self.begun > PARALLAX_LEAST_S and self.looks > PARALLAX_LEAST_LOOKS
        grown = self.width_now - self.width > PARALLAX_GROWN_LOG_WIDTH
        if known and (grown or self.misfit_now > PARALLAX_RECENT_MISFIT):
            return False
        most_q = float(solved.x[4]) + PARALLAX_NEARER_SIGMAS * math.sqrt(
            max(float(solved.cov[4, 4]), 0.0) * max(self.misfit, 1.0)
        )
        nearest = (1.0 - most_q * along) / most_q if most_q > 0.0 else math.inf
        stays = self.far or self._fastest_growth() < PARALLAX_GROWTH_PER_S
        fits = self.misfit < PARALLAX_MISFIT and solved.bends > PARALLAX_LEAST_ACROSS_M
        self.far = known and stays and fits and nearest > PARALLAX_FAR_M
        return True

    def _take_in_width(self, width: float, dt: float) -> None:
        kept = math.exp(-dt / PARALLAX_FORGET_S)
        self.sizes = kept * self.sizes + 1.0
        self.width += (width - self.width) / self.sizes
        at = np.array([1.0, self.t - self.begun])
        self.sizing = kept * self.sizing + np.outer(at, at)
        self.sized = kept * self.sized + width * at
        self.width_now += (width - self.width_now) * max(
            -math.expm1(-dt / PARALLAX_RECENT_S), 1.0 / self.sizes
        )

    def _fastest_growth(self) -> float:
        """1/s, of the width, one sigma above what the boxes say."""
        # A sigma of 1/s: boxes that tell no slope tell that nothing is known.
        cov = np.linalg.inv(self.sizing / PARALLAX_LOG_WIDTH_SIGMA**2 + np.diag([1e-6, 1.0]))
        line = cov @ self.sized / PARALLAX_LOG_WIDTH_SIGMA**2
        return float(line[1] + math.sqrt(cov[1, 1]))


class FarOff:
    """`observe` every scan; `tracks` are those that are far off, as of the last one."""

    def __init__(self) -> None:
        self._fits: dict[int, _Fit] = {}
        self._last: tuple[float, Array] | None = None
        """The last look's time [s] and own place."""
        self._gone: list[_Fit] = []
        """Of tracks that have ended."""

    @property
    def tracks(self) -> frozenset[int]:
        return frozenset(track for track, fit in self._fits.items() if fit.far)

    def observe(self, look: TeamLook) -> None:
        """look: of the tracks that have no name. Who is not in it has ended, or has a name by now."""
        if self._last is not None:
            t, camera = self._last
            if has_leapt(camera, look.camera, look.t - t):
                self._fits, self._gone = {}, []
        self._last = look.t, look.camera
        seen = {key[1] for key in look.keys}
        ended = [fit for track, fit in self._fits.items() if track not in seen]
        self._gone += [fit for fit in ended if fit.looks >= PARALLAX_REMEMBERED_LOOKS]
        self._gone = [fit for fit in self._gone if look.t - fit.t < PARALLAX_REMEMBERED_S]
        self._fits = {track: fit for track, fit in self._fits.items() if track in seen}
        variances = 0.5 * np.trace(look.ray_cov, axis1=1, axis2=2) + PARALLAX_ATTITUDE_SIGMA_RAD**2
        rows = zip(look.keys, look.ray, variances.tolist(), np.log(look.width).tolist(), strict=True)
        for (_, track), ray, variance, log_width in rows:
            if not math.isfinite(float(ray[0])):
                continue
            sight = _Sight(look.t, look.camera, ray, variance, log_width)
            fit = self._fits.get(track) or self._taken_up(sight)
            if fit is None or not fit.take_in(sight):
                fit = _Fit.begin(sight)
            self._fits[track] = fit

    def _taken_up(self, sight: _Sight) -> _Fit | None:
        """What was seen where a new track begins; it is remembered no more."""
        for k, fit in enumerate(self._gone):
            seen = fit.projected(sight)
            if seen is None:
                continue
            x, cov, _ = fit.solved()
            residual = seen.z - seen.H @ x
            S = seen.H @ cov @ seen.H.T + sight.variance * np.eye(2)
            alike = abs(sight.log_width + math.log(seen.closer(x)) - fit.width) < PARALLAX_GROWN_LOG_WIDTH
            if alike and float(residual @ np.linalg.solve(S, residual)) < PARALLAX_SAME_PLACE_GATE:
                return self._gone.pop(k)
        return None
