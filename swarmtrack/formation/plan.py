"""Checks of a formation's plan without a drone.

Simulated flights paid for each rule: a drone to the side is out of sight; heights must fit the view; straight lines
hide the leader; chains amplify.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

from swarmtrack.formation.margins import (
    LARGEST_SIZE_ERROR,
    LEADER_GAP_S,
    LEAST_MEAN_DIRECTION,
    LONGEST_CHAIN_LINKS,
    ONE_HEIGHT_M,
    REFERENCE_VIEW_SHARE,
    SLOTS_LEAST_APART_M,
    TILT_GRAVITY_M_S2,
    UNSEEN_NEIGHBOURS_M,
)
from swarmtrack.formation.parameters import Place
from swarmtrack.relative.box_width import BoxWidth


class HalfView(NamedTuple):
    """Half of a camera's field of view, horizontal and vertical; elevation of its axis, its azimuth right of the
    drone's first camera, and its roll, clockwise about that axis; rad.
    """

    half_width: float
    half_height: float
    up: float
    right: float = 0.0
    roll: float = 0.0

    def where(self, look: LookAt) -> tuple[float, float]:
        """Angles right and up of this camera's axis [rad] of a direction right and up of the first camera's level
        axis.
        """
        right, level = look.right - self.right, math.cos(look.up)
        x, y, up = level * math.cos(right), level * math.sin(right), math.sin(look.up)
        ahead = x * math.cos(self.up) + up * math.sin(self.up)
        up = up * math.cos(self.up) - x * math.sin(self.up)
        y, up = (
            y * math.cos(self.roll) - up * math.sin(self.roll),
            up * math.cos(self.roll) + y * math.sin(self.roll),
        )
        return math.atan2(y, ahead), math.atan2(up, math.hypot(ahead, y))


class PlanFault(NamedTuple):
    """key: of the entry below [formation] that is wrong."""

    key: tuple[str, ...]
    text: str


class LookAt(NamedTuple):
    """A reference as seen from a slot: range [m], azimuth right of the first camera's axis, and elevation [rad]."""

    reference: int
    distance: float
    right: float
    up: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FormationPlan:
    """slots: by drone, [north, east, down] m from the leader, the leader's own included; references: of each
    follower; height [m]: of the leader's slot above the team frame's origin; least_height [m]: the floor for
    all.
    """

    leader: int
    slots: Mapping[int, Place]
    references: Mapping[int, tuple[int, ...]]
    height: float
    least_height: float

    @property
    def followers(self) -> list[int]:
        return [drone for drone in sorted(self.slots) if drone != self.leader]

    def height_of(self, drone: int) -> float:
        """Height of a slot, m above the team frame's origin."""
        return self.height - self.slots[drone][2]

    def middle(self, drone: int) -> tuple[float, float]:
        """The mean of the level directions from a follower's slot to its references: north and east, shorter than 1."""
        here = self.slots[drone]
        ways = [_minus(self.slots[other], here) for other in self.references[drone]]
        units = [(n / level, e / level) for n, e, _ in ways if (level := math.hypot(n, e)) > 1e-3]
        count = max(len(units), 1)
        return sum(n for n, _ in units) / count, sum(e for _, e in units) / count

    def looks(self, drone: int) -> list[LookAt]:
        """References as seen from a follower's slot, its first camera towards their middle, as in flight."""
        here = self.slots[drone]
        ways = [_minus(self.slots[other], here) for other in self.references[drone]]
        north, east = self.middle(drone)
        middle = math.atan2(east, north)
        return [
            LookAt(
                other,
                math.hypot(n, e, d),
                math.remainder(math.atan2(e, n) - middle, 2.0 * math.pi),
                math.atan2(-d, math.hypot(n, e)),
            )
            for other, (n, e, d) in zip(self.references[drone], ways, strict=True)
        ]

    def links_from_leader(self) -> dict[int, int]:
        """Number of links from the leader to each drone; a drone without a path is missing."""
        links = {self.leader: 0}
        for _ in self.slots:
            for drone in self.followers:
                known = [links.get(other) for other in self.references[drone]]
                if None not in known:
                    links[drone] = 1 + max(n for n in known if n is not None)
        return links

    def most_speed(self) -> float:
        """Highest speed of the leader, m/s."""
        gaps = [look.distance for drone in self.followers for look in self.looks(drone)]
        return min(gaps, default=math.inf) / LEADER_GAP_S


def plan_faults(plan: FormationPlan, span: float) -> list[PlanFault]:
    """Faults of a plan, independent of cameras. span [m]: of the team's drones."""
    return [*_slot_faults(plan), *_chain_faults(plan), *_hidden_faults(plan, span)]


def view_faults(
    plan: FormationPlan, drone: int, views: Sequence[HalfView], acceleration: float = 0.0
) -> list[PlanFault]:
    """References that are near the border of each of this drone's views, or beyond it. acceleration [m/s²]: with
    which it flies, and for which it tilts.
    """
    faults = []
    tilt = math.atan(acceleration / TILT_GRAVITY_M_S2)
    if len(views) > 1 and math.hypot(*plan.middle(drone)) < LEAST_MEAN_DIRECTION:
        text = (
            "its references lie in opposite directions, expected a middle to which its first camera can turn"
        )
        faults.append(PlanFault(("references", str(drone)), text))
    for look in plan.looks(drone):
        share, number = min((share_of_view(look, view, tilt), number) for number, view in enumerate(views))
        if share > 1.0:
            axis = "the camera's axis" if len(views) == 1 else f"the axis of camera {number + 1}, the nearest"
            texts = _off_view(look, views[number], tilt, axis)
            faults += [PlanFault(("slots", str(drone)), text) for text in texts]
    return faults


def share_of_view(look: LookAt, view: HalfView, tilt: float = 0.0) -> float:
    """Angle of a reference off the axis, as a share of the allowed one."""
    right, up = view.where(look)
    return max(
        abs(right) / (REFERENCE_VIEW_SHARE * view.half_width), abs(up) / max(_most_up(view, tilt), 1e-3)
    )


def nearest_view(look: LookAt, views: Sequence[HalfView]) -> tuple[int, float]:
    """The view that has a reference nearest to its axis, and its share of the half view."""
    return min(
        ((number, REFERENCE_VIEW_SHARE * share_of_view(look, view)) for number, view in enumerate(views)),
        key=lambda one: one[1],
    )


def _most_up(view: HalfView, tilt: float) -> float:
    return min(REFERENCE_VIEW_SHARE * view.half_height, view.half_height - tilt)


def _off_view(look: LookAt, view: HalfView, tilt: float, axis: str) -> Iterator[str]:
    right, up = view.where(look)
    sense = "above" if up > 0.0 else "below"
    for off, most, side, name in (
        (
            right,
            REFERENCE_VIEW_SHARE * view.half_width,
            "beside",
            f"{REFERENCE_VIEW_SHARE:.0%} of half the view's width",
        ),
        (
            up,
            _most_up(view, tilt),
            sense,
            f"of half the view's height, {math.degrees(tilt):.0f}° are for its tilt",
        ),
    ):
        if abs(off) > most:
            yield (
                f"drone {look.reference} is {math.degrees(abs(off)):.0f}° {side} {axis}, expected at most "
                f"{math.degrees(most):.0f}°: {name}"
            )


def range_faults(box_width: BoxWidth, *, told: bool) -> list[PlanFault]:
    """told: whether velocities or measured ranges are shared. Without them, the size must determine the range well
    enough.
    """
    error = math.hypot(box_width.drone_sigma, box_width.wander_sigma)
    if told or error <= LARGEST_SIZE_ERROR:
        return []
    text = (
        f"the detector's boxes give a range to {error:.0%}, expected {LARGEST_SIZE_ERROR:.0%} or better "
        '([detector.box_width]), or [team] share = "velocity", or ranging = true where drones have ranging radios'
    )
    return [PlanFault(("leader",), text)]


def neighbours_at_one_height(plan: FormationPlan) -> Iterator[tuple[int, int, float]]:
    """Pairs of followers at one height, and how far apart they are [m], that no camera keeps apart."""
    for one, other in combinations(plan.followers, 2):
        north, east, down = _minus(plan.slots[one], plan.slots[other])
        sees = other in plan.references[one] or one in plan.references[other]
        if abs(down) < ONE_HEIGHT_M and math.hypot(north, east) < UNSEEN_NEIGHBOURS_M and not sees:
            yield one, other, math.hypot(north, east)


def _slot_faults(plan: FormationPlan) -> Iterator[PlanFault]:
    for one, other in combinations(sorted(plan.slots), 2):
        apart = math.dist(plan.slots[one], plan.slots[other])
        if apart < SLOTS_LEAST_APART_M:
            text = f"{apart:.1f} m from the slot of drone {one}, expected {SLOTS_LEAST_APART_M:g} m or more"
            yield PlanFault(("slots", str(other if other != plan.leader else one)), text)
    for drone in plan.slots:
        if plan.height_of(drone) < plan.least_height:
            text = (
                f"{plan.height_of(drone):.1f} m high, expected limits.least_height_m = {plan.least_height:g} "
                "or more above the team frame's origin"
            )
            yield PlanFault(("height_m",) if drone == plan.leader else ("slots", str(drone)), text)


def _chain_faults(plan: FormationPlan) -> Iterator[PlanFault]:
    links = plan.links_from_leader()
    for drone in plan.followers:
        key = ("references", str(drone))
        if drone not in links:
            yield PlanFault(
                key, f"drone {drone} does not depend on the leader {plan.leader}, expected that all do"
            )
        elif links[drone] >= LONGEST_CHAIN_LINKS:
            place = f"drone {drone} is the {links[drone] + 1}th of a chain"
            text = f"{place}, expected {LONGEST_CHAIN_LINKS} with the leader"
            yield PlanFault(key, text)


def _hidden_faults(plan: FormationPlan, span: float) -> Iterator[PlanFault]:
    for drone in plan.followers:
        here = plan.slots[drone]
        for reference in plan.references[drone]:
            way = _minus(plan.slots[reference], here)
            length = math.hypot(*way)
            for other in plan.slots:
                if other in (drone, reference) or length < 1e-3:
                    continue
                there = _minus(plan.slots[other], here)
                along = sum(a * b for a, b in zip(way, there, strict=True)) / length
                aside = math.sqrt(max(sum(x * x for x in there) - along * along, 0.0))
                if 0.0 < along < length and aside < span:
                    text = (
                        f"drone {other} hides drone {reference}: {aside:.2f} m off the line of sight, expected "
                        f"{span:g} m or more"
                    )
                    yield PlanFault(("slots", str(drone)), text)


def _minus(a: Place, b: Place) -> Place:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]
