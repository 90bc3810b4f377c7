"""Followers that meet on their ways: random slots, each starts on the other side of the middle, all at one height.

The law alone, told where everybody truly is, 0.2 s late and with noise, by drones that follow a command with a lag. So
what is measured is who yields, not who is seen: how near any two came, and how long anybody waited on its way.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks.formation.any_states import seen_track
from swarmtrack.formation.formation import Formation
from swarmtrack.formation.parameters import FlightLimits, FormationParameters, Place
from swarmtrack.formation.setpoint import OwnFlight
from swarmtrack.messages import Array, IdentifiedTrack, RelativeState

LEADER = 1
# s: of a step, and of the whole; and of steps, what is told is late.
STEP_S, ENDS_S, LATE_STEPS = 0.1, 90.0, 2
# s: with which a drone follows a command; and m and m/s, one sigma, of what is told.
LAG_S, SIGMA_M, SIGMA_M_S = 0.3, 0.1, 0.2
# m: slots are within so far of the middle, and so far apart at least; starts are so far off the other side.
WITHIN_M, APART_M, OFF_M = 8.0, 3.0, 0.3
# m above the leader's slots: nobody keeps clear of it.
LEADER_ABOVE_M, HEIGHT_M = 12.0, 30.0
MOST_DRONES = 5
# m and m/s: who is farther off its slot and slower waits; who is nearer at the end has arrived.
OFF_SLOT_M, STANDS_M_S, ARRIVED_M = 1.0, 0.2, 1.0


class Meeting(NamedTuple):
    """drones: followers that met; waited [s]: the longest that any stood on its way; nearest [m]: any two; off [m]: who
    was farthest off its slot at the end."""

    seed: int
    drones: int
    waited: float
    nearest: float
    off: float


def meet(seed: int) -> Meeting:
    """One meeting of two to five."""
    chance = np.random.default_rng(seed)
    n = int(chance.integers(2, MOST_DRONES + 1))
    slots = _slots(chance, n)
    formations = [_formation(number, slots) for number in range(n)]
    place = -slots + chance.normal(0.0, OFF_M, slots.shape) * (1.0, 1.0, 0.0)
    velocity = np.zeros_like(place)
    past: deque[tuple[Array, Array]] = deque([(place, velocity)] * (LATE_STEPS + 1), LATE_STEPS + 1)
    waits, longest, nearest = np.zeros(n), 0.0, math.inf
    for k in range(round(ENDS_S / STEP_S)):
        past.append((place, velocity))
        noise = chance.normal(0.0, 1.0, (n, n, 2, 3)) * ((SIGMA_M,), (SIGMA_M_S,))
        told = np.array(
            [
                formation.command(
                    *_told(number, past[0], (place, velocity), noise[number], k * STEP_S)
                ).velocity
                for number, formation in enumerate(formations)
            ]
        )
        velocity = velocity + STEP_S / LAG_S * (told - velocity)
        place = place + STEP_S * velocity
        apart = np.linalg.norm(place[:, None] - place[None], axis=2)[~np.eye(n, dtype=bool)]
        nearest = min(nearest, float(apart.min()))
        off = np.linalg.norm(place - slots, axis=1)
        stands = (off > OFF_SLOT_M) & (np.linalg.norm(velocity, axis=1) < STANDS_M_S)
        waits = np.where(stands, waits + STEP_S, 0.0)
        longest = max(longest, float(waits.max()))
    return Meeting(seed, n, longest, nearest, float(off.max()))


def _slots(chance: np.random.Generator, n: int) -> Array:
    """(n, 3) m, about the middle below the leader."""
    slots: list[Array] = []
    while len(slots) < n:
        slot = np.array([*chance.uniform(-WITHIN_M, WITHIN_M, 2), 0.0])
        if math.hypot(*slot) > APART_M and all(math.dist(slot, other) > APART_M for other in slots):
            slots.append(slot)
    return np.array(slots)


def _formation(number: int, slots: Array) -> Formation:
    places: dict[int, Place] = {LEADER: (0.0, 0.0, 0.0)}
    places |= {
        LEADER + 1 + k: (north, east, LEADER_ABOVE_M) for k, (north, east, _) in enumerate(slots.tolist())
    }
    return Formation(
        FormationParameters(
            drone_id=LEADER + 1 + number,
            leader=LEADER,
            slots=places,
            references=(LEADER,),
            height=HEIGHT_M + LEADER_ABOVE_M,
            limits=FlightLimits(fence_radius=100.0),
        )
    )


def _told(
    number: int, late: tuple[Array, Array], now: tuple[Array, Array], noise: Array, t: float
) -> tuple[dict[int, RelativeState], OwnFlight, list[IdentifiedTrack], float]:
    """What a drone knows: of itself now, of the others as they were, flown on at their velocity. late, now: places and
    velocities, (n, 3) each; noise (n, 2, 3)."""
    here, flies = now[0][number], now[1][number]
    cov = np.diag([SIGMA_M**2] * 3 + [SIGMA_M_S**2] * 3)
    where, moves = late
    where = where + LATE_STEPS * STEP_S * moves
    states, tracks = {}, []
    for other in range(len(where)):
        if other == number:
            continue
        states[other] = RelativeState(
            LEADER + 1 + other,
            t,
            where[other] - here + noise[other, 0],
            moves[other] - flies + noise[other, 1],
            cov,
            0.05,
            ("size",),
        )
        tracks.append(seen_track(other, t, LEADER + 1 + other))
    leader = len(where)
    states[leader] = RelativeState(
        LEADER, t, np.array([0.0, 0.0, -LEADER_ABOVE_M]) - here, -flies, cov, 0.05, ("size",)
    )
    tracks.append(seen_track(leader, t, LEADER))
    north, east, down = here.tolist()
    vn, ve, vd = flies.tolist()
    return states, OwnFlight((north, east, down - HEIGHT_M), (vn, ve, vd), 0.0), tracks, t


def meetings_row(met: Sequence[Meeting]) -> dict[str, Any]:
    """What all of them came to."""
    return {
        "runs": len(met),
        "waited_s": {
            "p50": float(np.median([one.waited for one in met])),
            "max": max(one.waited for one in met),
        },
        "min_separation_m": min(one.nearest for one in met),
        "runs_with_one_not_arrived": sum(one.off > ARRIVED_M for one in met),
    }
