"""Where teammates see this drone, by what they report: a start that is wrong shows from outside, a heading does not.

A drone whose start is off sees all others shifted, and so does one whose compass is off. But of the first everybody
else says that it is not where it says, each on another ray. Each report may be wrong by itself: in its sender's heading
or start, because it took another for this drone, or because it lies. Where several agree, it is this drone; so it must
hold without any one of them. Only rays that miss it count: a name is given by place, so who stands
where this drone should be, and is taken for it, agrees with whatever it says.

A ray misses the place where this drone thought that it was. When the own place leaps, as a receiver's does that loses
its satellites for a while and finds them again, what was told before is forgotten.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.identity.reprojection import NEAREST
from swarmtrack.messages import Array, Sighting, SightingReport
from swarmtrack.motion.leap import has_leapt

# s of its own way that a drone remembers, and how far a report may be from what it knows of it.
MEMORY_S, SIMULTANEOUS_S = 2.0, 0.3
# s that a report counts; and while the drone doubts itself, when teammates no longer know whom they see.
COUNTS_S, COUNTS_IN_DOUBT_S = 3.0, 60.0
# s, m and rad: a report that knows less tells nothing.
VAGUE_T, VAGUE_PLACE, VAGUE_RAY = 0.5, 3.0, 0.3
# Of reports: those as good as they say, those off by some of it, and those by much; these in rad and m.
SHARES, OFF = (0.8, 0.14, 0.06), ((0.0, 0.0), (math.radians(6.0), 0.3), (math.radians(20.0), 1.5))
# Of reports: those that are simply wrong, on a ray anywhere around.
WRONG = 1e-4
# rad: how well two autopilots agree on north.
NORTH_SIGMA = 0.03
# Sigmas: so far from where it should be, a sight is worth a thought.
PUZZLING = 2.0


class Onlook(NamedTuple):
    """One teammate's ray: towards (2,) m, from where it stood to where this drone thought that it was, north and east;
    bearing [rad] of the ray; sigma [rad], with the sender's heading; place_sigma [m] of both ends."""

    t: float
    towards: Array
    bearing: float
    sigma: float
    place_sigma: float


class Onlookers:
    """By teammate, the last ray on which it said that it sees this drone."""

    def __init__(self, drone_id: int) -> None:
        self._drone_id = drone_id
        self._path: deque[tuple[float, Array, float]] = deque()
        self._rays: dict[int, Onlook] = {}

    def follow(self, t: float, position: Array, sigma: float, *, in_doubt: bool) -> None:
        """Where this drone thinks that it is (3,) m at a scan. in_doubt: whether it doubts that."""
        if self._path:
            before, there, _ = self._path[-1]
            if has_leapt(there, position, t - before):
                self._path.clear()
                self._rays.clear()
        self._path.append((t, position, sigma))
        while self._path[0][0] < t - MEMORY_S:
            self._path.popleft()
        counts_s = COUNTS_IN_DOUBT_S if in_doubt else COUNTS_S
        self._rays = {drone: ray for drone, ray in self._rays.items() if t - ray.t < counts_s}

    def tell(self, report: SightingReport) -> None:
        """A teammate reports whom it sees."""
        seen = next((seen for seen in report.sightings if seen.drone_id == self._drone_id), None)
        if seen is None or not self._path or _is_vague(report, seen):
            return
        t, position, sigma = min(self._path, key=lambda known: abs(known[0] - report.t))
        if abs(t - report.t) <= SIMULTANEOUS_S:
            north, east, _ = seen.direction.tolist()
            self._rays[report.observer] = Onlook(
                t,
                (position - report.position)[:2],
                math.atan2(east, north),
                math.hypot(seen.sigma, NORTH_SIGMA),
                math.hypot(sigma, report.position_sigma),
            )

    @property
    def are_puzzled(self) -> bool:
        """Whether anybody sees this drone elsewhere than it thinks."""
        return bool(np.any(self._is_puzzling))

    @property
    def _is_puzzling(self) -> NDArray[np.bool_]:
        miss, variance = self._misses(np.zeros((1, 3)), np.zeros(1))
        return np.asarray(miss[0] ** 2 > PUZZLING**2 * variance[0])

    def log_ratios(self, shift: Array, sigma: Array) -> Array:
        """(1 + m, h): of what they say if this drone is by shift (h, 3) m, ± sigma (h,) m, from where it thinks, and if
        it is there; then the same without each of the m who miss it, as any one may lie."""
        speaks = self._log_density(shift, sigma) - self._log_density(np.zeros((1, 3)), np.zeros(1))
        speaks = speaks[:, self._is_puzzling]
        together = speaks.sum(axis=1)
        return np.vstack([together, together - speaks.T])

    def _log_density(self, shift: Array, sigma: Array) -> Array:
        """(h, m): of each ray, if this drone is there."""
        miss, variance = self._misses(shift, sigma)
        distance = np.array([_length(ray.towards) for ray in self._rays.values()])
        total = np.full_like(miss, WRONG / (2.0 * math.pi))
        for share, (turn, metres) in zip(SHARES, OFF, strict=True):
            wide = variance + turn**2 + (metres / distance) ** 2
            total += share * np.exp(-0.5 * miss**2 / wide) / np.sqrt(2.0 * math.pi * wide)
        return np.asarray(np.log(total))

    def _misses(self, shift: Array, sigma: Array) -> tuple[Array, Array]:
        """(h, m) rad, and rad²: by how much each ray passes by this drone there."""
        rays = list(self._rays.values())
        towards = np.array([ray.towards for ray in rays]).reshape(-1, 2) + shift[:, None, :2]
        bearing = np.array([ray.bearing for ray in rays])
        miss = np.arctan2(towards[..., 1], towards[..., 0]) - bearing
        distance = np.maximum(np.linalg.norm(towards, axis=2), NEAREST)
        place = np.array([ray.place_sigma for ray in rays]) ** 2 + sigma[:, None] ** 2
        variance = np.array([ray.sigma for ray in rays]) ** 2 + place / distance**2
        return (miss + math.pi) % (2.0 * math.pi) - math.pi, variance


def _length(towards: Array) -> float:
    return max(float(np.linalg.norm(towards)), NEAREST)


def _is_vague(report: SightingReport, seen: Sighting) -> bool:
    return report.t_sigma > VAGUE_T or report.position_sigma > VAGUE_PLACE or seen.sigma > VAGUE_RAY
