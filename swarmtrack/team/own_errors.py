"""What may be wrong with this drone, and with the pads of its team: the components of the posterior.

A component states the own heading's error, whether the own path is turned with it, how far the own start is off, and
who stands on whose pad. Within it the heading is Gaussian around the component's, and starts are around theirs.
Single faults are worked out finely, two at once coarsely. A component says nothing about tracks.

Within a component each pair of a track and a teammate integrates the heading out by itself, although it is the same of
all. Where few are in view, that is enough. In a large team neighbours stand a degree apart, less than a heading is
known, and each track alone fits its neighbours as well; so there the heading that is as stated has fine cells, one of
which explains all tracks at once.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmtrack.messages import Array
from swarmtrack.team.priors import (
    COUPLED_HEADING_CELL_RAD,
    COUPLED_HEADING_SIGMA_RAD,
    COUPLED_PADS_ALL,
    COUPLED_START_RING_M,
    HEADING_CELL_RAD,
    HEADING_CELL_SIGMA_RAD,
    P_HEADING_OFF,
    P_PADS_PERMUTED,
    P_PATH_TRUE,
    P_PATH_TURNED,
    P_START_OFF,
    P_STARTS_LOOSE,
    P_TEAM_TURNED,
    PADS_SWAPPED_WITH,
    SHARED_HEADING_CELL_RAD,
    SHARED_HEADING_SIGMA_RAD,
    SHARED_HEADING_WITHIN_RAD,
    SINGLE_FAULTS_FROM,
    SLEEPERS_PARTS,
    START_RING_DIRECTIONS,
    START_RING_SIGMA,
    START_RINGS_M,
)

Permutation = tuple[tuple[int, int], ...]
"""Who stands on whose pad, by drone; empty: each on its own."""


class PathTurn(enum.IntEnum):
    """What a heading that is off turns besides the rays."""

    NONE = 0
    """Nothing: a receiver carries the place, of everybody."""
    OWN = 1
    """The own path, because the autopilot integrates along its heading."""
    TEAM = 2
    """All paths of the team, as much as the own."""


class ConfigFault(enum.Enum):
    """Kinds of components."""

    NONE = "as configured"
    HEADING = "own heading"
    START = "own start"
    STARTS = "all starts"
    PADS = "mixed-up pads"
    TWO = "two faults"


@dataclass(frozen=True, slots=True)
class Component:
    """heading [rad]: the true one less the autopilot's, and its sigma within the component; off: whether that is a
    fault. shift (north, east) m: where this drone started less where it says, within ring [m] times `START_RING_SIGMA`;
    pads: who stands on whose. prior: of its kind of fault. loose: whether all starts of the team are worse than
    stated."""

    heading: float
    sigma: float
    path: PathTurn
    shift: tuple[float, float]
    ring: float
    pads: Permutation
    prior: float
    loose: bool = False

    @property
    def fault(self) -> ConfigFault:
        """Its kind; of a heading, also where the heading is within what the autopilot states."""
        start = ConfigFault.STARTS if self.loose else ConfigFault.START
        found = [
            fault
            for fault, there in (
                (ConfigFault.HEADING, self.heading != 0.0),
                (start, self.ring > 0.0),
                (ConfigFault.PADS, bool(self.pads)),
            )
            if there
        ]
        return ConfigFault.TWO if len(found) > 1 else (*found, ConfigFault.NONE)[0]


def components(own: int, pads: Mapping[int, Array]) -> list[Component]:
    """All of them, first "as configured". own: our ID; pads (3,) m: by drone, ours too, where each says it started."""
    headings = _headings(HEADING_CELL_RAD, HEADING_CELL_SIGMA_RAD, P_HEADING_OFF)
    rings = [ring for radius in START_RINGS_M for ring in _ring(radius, len(START_RINGS_M))]
    nominal = Component(0.0, HEADING_CELL_SIGMA_RAD, PathTurn.NONE, (0.0, 0.0), 0.0, (), 0.0)
    loose = [
        dataclasses.replace(one, prior=one.prior * P_STARTS_LOOSE / P_START_OFF, loose=True) for one in rings
    ]
    if len(pads) < 2:
        # By nobody's start an own one that is off is not seen.
        return [nominal, *headings]
    if len(pads) > SINGLE_FAULTS_FROM:
        shared = _shared_headings()
        beyond = [one for one in headings if abs(one.heading) > SHARED_HEADING_WITHIN_RAD]
        return [*shared, *beyond, *rings, *loose]
    permutations = [
        Component(0.0, HEADING_CELL_SIGMA_RAD, PathTurn.NONE, (0.0, 0.0), 0.0, pads, prior)
        for pads, prior in _permutations(pads)
    ]
    coarse = [
        one
        for one in _headings(COUPLED_HEADING_CELL_RAD, COUPLED_HEADING_SIGMA_RAD, P_HEADING_OFF)
        if one.path is not PathTurn.TEAM
    ]
    few = len(pads) <= COUPLED_PADS_ALL
    swapped = [one for one in permutations if few or own in dict(one.pads)]
    seconds = [*_ring(COUPLED_START_RING_M, 1), *swapped]
    coupled = [
        Component(h.heading, h.sigma, h.path, s.shift, s.ring, s.pads, h.prior * s.prior)
        for h in coarse
        for s in seconds
    ]
    coupled += [
        Component(0.0, p.sigma, PathTurn.NONE, r.shift, r.ring, p.pads, p.prior * r.prior)
        for p in swapped
        for r in _ring(COUPLED_START_RING_M, 1)
    ]
    return [nominal, *headings, *rings, *loose, *permutations, *coupled]


def _shared_headings() -> list[Component]:
    """The heading as stated, in fine cells; the one without any error first."""
    most = round(SHARED_HEADING_WITHIN_RAD / SHARED_HEADING_CELL_RAD - 0.5)
    prior = P_HEADING_OFF * SHARED_HEADING_CELL_RAD / (2.0 * math.pi)
    return [
        Component(
            k * SHARED_HEADING_CELL_RAD,
            SHARED_HEADING_SIGMA_RAD,
            PathTurn.NONE,
            (0.0, 0.0),
            0.0,
            (),
            prior if k else 0.0,
        )
        for k in sorted(range(-most, most + 1), key=abs)
    ]


def _headings(cell: float, sigma: float, prior: float) -> list[Component]:
    count = round(2.0 * math.pi / cell)
    angles = [math.remainder(k * cell, 2.0 * math.pi) for k in range(1, count)]
    shares = {PathTurn.NONE: P_PATH_TRUE, PathTurn.OWN: P_PATH_TURNED, PathTurn.TEAM: P_TEAM_TURNED}
    return [
        Component(angle, sigma, path, (0.0, 0.0), 0.0, (), prior * share / len(angles))
        for angle in angles
        for path, share in shares.items()
    ]


def _ring(radius: float, rings: int) -> list[Component]:
    bearings = np.arange(START_RING_DIRECTIONS) * (2.0 * math.pi / START_RING_DIRECTIONS)
    prior = P_START_OFF / rings / START_RING_DIRECTIONS
    return [
        Component(
            0.0,
            HEADING_CELL_SIGMA_RAD,
            PathTurn.NONE,
            (radius * math.cos(b), radius * math.sin(b)),
            radius,
            (),
            prior,
        )
        for b in bearings.tolist()
    ]


def _permutations(pads: Mapping[int, Array]) -> list[tuple[Permutation, float]]:
    """With their priors: two drones on each other's pads, or everybody on the next one's, in the order of IDs."""
    ids = sorted(pads)
    near = {i: _by_distance(i, pads) for i in ids}
    found: list[Permutation] = [
        ((i, j), (j, i))
        for i, j in combinations(ids, 2)
        if j in near[i][:PADS_SWAPPED_WITH] or i in near[j][:PADS_SWAPPED_WITH]
    ]
    if len(ids) > 2:
        found += [
            tuple(zip(ids, ids[1:] + ids[:1], strict=True)),
            tuple(zip(ids, ids[-1:] + ids[:-1], strict=True)),
        ]
    return [(one, P_PADS_PERMUTED / len(found)) for one in found]


_CELL_OF_SIGMA = {
    HEADING_CELL_SIGMA_RAD: HEADING_CELL_RAD,
    COUPLED_HEADING_SIGMA_RAD: COUPLED_HEADING_CELL_RAD,
    SHARED_HEADING_SIGMA_RAD: SHARED_HEADING_CELL_RAD,
}


def _key(c: Component, angle: float = 0.0) -> tuple[object, ...]:
    """What a component is known by in any team: one like c with a heading that is off by angle [rad] more."""
    cell = _CELL_OF_SIGMA[c.sigma]
    heading = (round(c.heading / cell) + round(angle / cell)) % round(2.0 * math.pi / cell)
    if not heading:
        return (0, HEADING_CELL_RAD, PathTurn.NONE, c.shift, c.pads, c.loose)
    return (heading, cell, c.path, c.shift, c.pads, c.loose)


def _by_distance(drone_id: int, pads: Mapping[int, Array]) -> list[int]:
    """The others, the nearest pad first."""
    away = {other: float(np.linalg.norm(pads[drone_id] - pad)) for other, pad in pads.items()}
    return sorted(away.keys() - {drone_id}, key=away.__getitem__)


class OwnErrors:
    """The components as arrays of k rows.

    heading, sigma (k,) rad; shift (k, 3) m; spread (k,) m per axis: of the starts within the component;
    path (k,): `PathTurn`; mine (k,): whether it is this drone that is wrong, its heading apart;
    part (k,): of `SLEEPERS_PARTS`, those that are alike together.
    """

    def __init__(self, own: int, pads: Mapping[int, Array]) -> None:
        """As `components`; a drone that is not in pads started somewhere around this one."""
        self.own = own
        self.pads = dict(pads)
        self.components = each = components(own, pads)
        self.heading = np.array([c.heading for c in each])
        self.sigma = np.array([c.sigma for c in each])
        self.path = np.array([c.path for c in each])
        self.shift = np.array([(*c.shift, 0.0) for c in each])
        self.spread = START_RING_SIGMA * np.array([c.ring for c in each])
        self.part = np.argsort(np.argsort(self.spread, kind="stable")) * SLEEPERS_PARTS // len(each)
        self._prior = np.array([c.prior for c in each])
        self.ring = np.array([c.ring for c in each])
        self.loose = np.array([c.loose for c in each])
        self.mine = np.array([c.ring > 0.0 or own in dict(c.pads) for c in each])
        self._faults = np.array([c.fault.value for c in each])
        shared = np.flatnonzero(self.sigma == SHARED_HEADING_SIGMA_RAD)
        self._as_stated = shared if shared.size else np.zeros(1, int)
        self._within = SHARED_HEADING_WITHIN_RAD if shared.size else 0.5 * HEADING_CELL_RAD
        # The cells that a heading which is not off may be in as well.
        single = [
            c.heading != 0.0 and not c.ring and not c.pads and c.path is not PathTurn.TEAM for c in each
        ]
        self._may_be_right = np.array(single)
        self._may_be_right[self._as_stated] = False

    def __len__(self) -> int:
        return len(self.components)

    def log_prior(self, heading_sigma: float) -> tuple[Array, Array]:
        """Log prior (k,), and the share (k,) of it in which the own heading is a fault. heading_sigma [rad]: how well
        the autopilot says that it knows its heading."""
        mass = math.erf(self._within / (heading_sigma * math.sqrt(2.0)))
        density = np.exp(-0.5 * (self.heading / heading_sigma) ** 2)
        other = density * self._may_be_right
        # Two paths of each cell.
        right = (1.0 - mass) * other / max(float(other.sum()), 1e-300)
        stated = self._as_stated
        right[stated] = mass * density[stated] / float(density[stated].sum())
        right *= 1.0 - float(self._prior.sum())
        off = np.where(self.heading != 0.0, self._prior, 0.0)
        prior = self._prior + right
        return np.log(np.maximum(prior, 1e-300)), off / np.maximum(prior, 1e-300)

    def heading_sigma(self, used: NDArray[np.intp], stated: float) -> Array:
        """(len(used),) rad: within the components used. stated [rad]: how well the autopilot says that it knows its
        heading."""
        is_one = len(self._as_stated) == 1
        return np.where((used == 0) & is_one, stated, self.sigma[used])

    def mapped_from(self, before: OwnErrors, value: NDArray[Any]) -> NDArray[Any]:
        """(k,) of these components from (k,) of those before; what is new has the first one's."""
        at = {_key(c): i for i, c in enumerate(before.components)}
        return np.asarray(value[[at.get(_key(c), 0) for c in self.components]])

    def turned(self, value: NDArray[Any], angle: float) -> NDArray[Any]:
        """(k,) of the components after the own heading has stepped by angle [rad]: each has what was of its heading
        before, or the first one's where no component had that."""
        at = {_key(c): i for i, c in enumerate(self.components)}
        return np.asarray(value[[at.get(_key(c, angle), 0) for c in self.components]])

    def stands_at(self, drone_id: int) -> Array:
        """(k, 3) m: the stated start of the pad on which that drone stands."""
        around = self.pads[self.own]
        on = [dict(c.pads).get(drone_id, drone_id) for c in self.components]
        return np.array([self.pads.get(pad, around) for pad in on])

    def fault_is(self, fault: ConfigFault) -> NDArray[np.bool_]:
        """(k,): the components of that kind."""
        return np.asarray(self._faults == fault.value)

    def permuted(self, drone_id: int) -> NDArray[np.bool_]:
        """(k,): the components in which that drone stands on another's pad."""
        return np.array([drone_id in dict(c.pads) for c in self.components])
