"""Stories that no flight tells: whatever a formation may be told, its answers are numbers within the limits, and no
command closes in on anybody who is too near, where standing would not.

`Stories`: states are NaN, huge or tiny; covariances singular, of no shape a covariance has, or infinite; names come and
go, 0 to 20 tracks at once; poses are old; time stands, leaps and runs back. `RelativeState` refuses some of this at its
birth; here it gets past. `Squeezes`: everybody is nearer than the clearance, around this drone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from swarmtrack.formation.margins import LONGEST_TIME_STEP_S
from swarmtrack.formation.parameters import FlightLimits, FormationParameters
from swarmtrack.formation.setpoint import STANDSTILL, OwnFlight, Setpoint, Velocity
from swarmtrack.messages import Array, IdentifiedTrack, RelativeState, Track, TrackStatus
from swarmtrack.relative.heights import HeightSight

Story = tuple[dict[int, RelativeState], OwnFlight, list[IdentifiedTrack], float]

MOST_TRACKS = 20
ODD = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1e-300, 0.0, 1e12)
SLOTS = {1: (0.0, 0.0, 0.0), 2: (-4.0, 3.0, -1.0), 3: (-4.0, -3.0, 1.0)}
HEIGHT_M = 6.0
# Of the numbers that are told, this share is one of `ODD`; of stories, this share has any.
ODD_SHARE, ODD_STORIES = 0.05, 0.5
# Rounding, of m/s and rad/s.
SLACK = 1e-9
STATUSES = tuple(TrackStatus)
# px: where tracks are in the image tells a formation nothing.
SEEN_AT, SEEN_COV, SEEN_SIZE = np.zeros(4), np.eye(4), np.full(2, 20.0)


class Stories:
    """Endless; `parameters` of whom they are told."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        rng = self._rng
        limits = FlightLimits(
            speed=float(rng.uniform(0.1, 5.0)),
            climb=float(rng.uniform(0.1, 2.0)),
            yaw_rate=float(rng.uniform(0.05, 1.5)),
            acceleration=float(rng.uniform(0.2, 5.0)),
        )
        references = (1,) if rng.random() < 0.5 else (1, 3)
        self.parameters = FormationParameters(
            drone_id=2, leader=1, slots=SLOTS, references=references, height=HEIGHT_M, limits=limits
        )
        self._t = 0.0

    def __iter__(self) -> Iterator[Story]:
        while True:
            yield self._next()

    def _next(self) -> Story:
        rng = self._rng
        odd = rng.random() < ODD_STORIES
        self._t += float(rng.choice([0.1, 0.1, 0.1, 0.1, 0.0, -5.0, 30.0, 1e-9]))
        drones = rng.integers(0, 5, int(rng.integers(MOST_TRACKS + 1))).tolist()
        states = enumerate(self._states(drones, odd=odd))
        is_told = (rng.random(len(drones)) < 0.9).tolist()
        known = {k: state for k, state in states if is_told[k]}
        return known, self._own(odd=odd), self._tracks(drones), self._t

    def _numbers(self, n: int, scale: float, *, odd: bool) -> Array:
        values = scale * self._rng.standard_normal(n)
        if odd:
            some = self._rng.random(n) < ODD_SHARE
            values[some] = self._rng.choice(ODD, int(some.sum()))
        return values

    def _own(self, *, odd: bool) -> OwnFlight:
        rng = self._rng
        ages = np.abs(self._numbers(5, 0.1, odd=odd)).tolist()
        flags = (rng.random(3) < 0.02).tolist()
        return OwnFlight(
            self._triple(10.0, odd=odd),
            self._triple(1.0, odd=odd),
            float(self._numbers(1, 3.0, odd=odd)[0]),
            position_sigma=float(abs(self._numbers(1, 0.3, odd=odd)[0])),
            pose_age=ages[0],
            gyro_age=ages[1],
            scan_ages=(ages[2],),
            heading_step_age=100.0 * ages[3],
            leap_age=100.0 * ages[4],
            clash=flags[0],
            doubted=flags[1],
            clock_known=not flags[2],
            ground=float(self._numbers(1, 5.0, odd=odd)[0]) if rng.random() < 0.5 else None,
            height_sights=self._sights(odd=odd),
        )

    def _sights(self, *, odd: bool) -> tuple[HeightSight, ...]:
        """Of drone 1, mostly of now."""
        if self._rng.random() < 0.3:
            return ()
        off, late, *lengths = self._numbers(5, 1.0, odd=odd).tolist()
        sigma, level, lever = map(abs, lengths)
        return (HeightSight(1, "a moved", self._t + 0.01 * late, off, sigma, 5.0 * level, lever),)

    def _triple(self, scale: float, *, odd: bool) -> Velocity:
        north, east, down = self._numbers(3, scale, odd=odd).tolist()
        return north, east, down

    def _states(self, drones: Sequence[int], *, odd: bool) -> list[RelativeState]:
        rng, n = self._rng, len(drones)
        numbers = self._numbers(43 * n, 1.0, odd=odd).reshape(n, 43)
        far, kinds = rng.choice([0.01, 1.0, 5.0, 50.0], n), rng.random(n)
        roots = 0.3 * numbers[:, 6:42].reshape(n, 6, 6)
        with np.errstate(all="ignore"):
            full, line = roots @ roots.swapaxes(1, 2), roots[:, 0, :, None] * roots[:, 0, None, :]
        cov = np.where(kinds[:, None, None] < 0.1, line, full)
        # No covariance at all.
        cov = np.where(kinds[:, None, None] > 0.8, roots, cov)
        return [
            _born(
                drone_id=drone,
                t=self._t,
                position=far[k] * numbers[k, :3],
                velocity=numbers[k, 3:6],
                cov=cov[k],
                range_sigma_log=0.2 * abs(float(numbers[k, 42])),
                sources=(),
            )
            for k, drone in enumerate(drones)
        ]

    def _tracks(self, drones: Sequence[int]) -> list[IdentifiedTrack]:
        rng, n = self._rng, len(drones)
        statuses = rng.choice(len(STATUSES), n, p=[0.1, 0.8, 0.1]).tolist()
        unseen = np.where(rng.random(n) < 0.7, np.nan, rng.uniform(0.0, 3.0, n)).tolist()
        probabilities = rng.choice([0.2, 0.95, 0.999, 1.0], n).tolist()
        tracks = []
        for k, drone in enumerate(drones):
            coasting = None if math.isnan(unseen[k]) else self._t - unseen[k]
            seen = Track(k, self._t, SEEN_AT, SEEN_COV, STATUSES[statuses[k]], 1.0, SEEN_SIZE, coasting)
            tracks.append(IdentifiedTrack(seen, drone or None, probabilities[k] if drone else 0.0))
        return tracks


def _born(**values: Any) -> RelativeState:
    """One that was never checked."""
    state: RelativeState = object.__new__(RelativeState)
    for name, value in values.items():
        object.__setattr__(state, name, value)
    return state


class Squeezes:
    """Endless; the same one to five others, nearer than the clearance, each time elsewhere around this drone, which
    is at its height; in half of the states all are at rest."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self.parameters = FormationParameters(
            drone_id=2, leader=1, slots=SLOTS, references=(1,), height=HEIGHT_M
        )
        self._others = int(self._rng.integers(1, 6))
        self._t = 0.0

    def __iter__(self) -> Iterator[Story]:
        while True:
            yield self._next()

    def _next(self) -> Story:
        rng = self._rng
        self._t += 0.1
        n, rests = self._others, rng.random() < 0.5
        north, east = (SLOTS[2][:2] + rng.normal(0.0, 1.0, 2)).tolist()
        flies = STANDSTILL if rests else self._velocity()
        heading = float(rng.uniform(-math.pi, math.pi))
        own = OwnFlight((north, east, self.parameters.down), flies, heading)
        ways = rng.standard_normal((n, 3))
        ways *= rng.uniform(0.2, self.parameters.clearance, (n, 1)) / np.linalg.norm(ways, axis=1)[:, None]
        speeds = rng.normal(0.0, 0.0 if rests else 1.0, (n, 3))
        states = {
            k: RelativeState(
                0,
                self._t,
                ways[k],
                speeds[k] - flies,
                rng.uniform(0.01, 0.3) ** 2 * np.eye(6),
                0.1,
                ("size",),
            )
            for k in range(n)
        }
        return states, own, [seen_track(k, self._t) for k in range(n)], self._t

    def _velocity(self) -> Velocity:
        north, east, down = self._rng.normal(0.0, 1.0, 3).tolist()
        return north, east, down


def seen_track(number: int, t: float, drone: int | None = None) -> IdentifiedTrack:
    """Confirmed, and surely called so, if anything; where it is in the image tells a formation nothing."""
    track = Track(number, t, SEEN_AT, SEEN_COV, TrackStatus.CONFIRMED, 1.0, SEEN_SIZE, coasting_since=None)
    return IdentifiedTrack(track, drone, 0.0 if drone is None else 0.999)


def closing(velocity: Velocity, story: Story) -> float:
    """m/s: as fast this closes in on any of those in the story; negative where it does so on nobody."""
    states, own, _, _ = story
    return max(
        float(state.position @ (velocity - state.velocity - own.velocity)) / math.hypot(*state.position)
        for state in states.values()
    )


def closes_in(setpoint: Setpoint, before: Setpoint | None, story: Story) -> float:
    """m/s: how much faster a command closes in on somebody who is too near than if the drone stood, or flew on."""
    flown = STANDSTILL if before is None else before.velocity
    least = max(closing(STANDSTILL, story), closing(flown, story), 0.0)
    return closing(setpoint.velocity, story) - least


def wrong_with(setpoint: Setpoint, limits: FlightLimits, before: Setpoint | None = None) -> str:
    """What a setpoint breaks, after the last one; nothing where it is sound."""
    numbers = (*setpoint.velocity, setpoint.yaw_rate)
    if not all(map(math.isfinite, numbers)):
        return f"no numbers: {numbers}"
    if math.hypot(*setpoint.velocity) > limits.speed + SLACK:
        return f"faster than {limits.speed} m/s: {setpoint.velocity}"
    if abs(setpoint.velocity[2]) > limits.climb + SLACK:
        return f"climbs faster than {limits.climb} m/s: {setpoint.velocity}"
    if abs(setpoint.yaw_rate) > limits.yaw_rate + SLACK:
        return f"turns faster than {limits.yaw_rate} rad/s: {setpoint.yaw_rate}"
    last, since = (STANDSTILL, 0.0) if before is None else (before.velocity, setpoint.t - before.t)
    most = limits.evasion * min(max(since, 0.0), LONGEST_TIME_STEP_S)
    if math.dist(setpoint.velocity, last) > most + SLACK:
        return f"changes by more than {most} m/s: {last} to {setpoint.velocity}"
    return ""
