"""Divergence of the flown velocity from the commanded one, through a model of the autopilot.

    du/dt = sat((told − u) / T, a)    dm/dt = ((flown − u) − m) / 2 s

The velocity is over ground, so that wind does not matter while the autopilot has the authority to fly against it. An
autopilot that is slow, or limited in speed by its drag, falls short along the command; one that is pushed, frozen, or
commanded by another program does not, or not only.

A second check: a drone that comes no nearer to its slot although its autopilot reports that it flies there has a false
velocity, its own or that of its reference.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from swarmtrack.formation.law import saturated
from swarmtrack.formation.margins import (
    DIVERGENCE_AGREES_M_S,
    DIVERGENCE_AGREES_S,
    DIVERGENCE_DEMAND_SHARE,
    DIVERGENCE_FARTHER_M,
    DIVERGENCE_HOLDS_S,
    DIVERGENCE_MEAN_S,
    DIVERGENCE_NEARER_M,
    DIVERGENCE_REPORTED_M_S,
    DIVERGENCE_SHORTFALL_SHARE,
    DIVERGENCE_WITHIN_S,
    LONGEST_TIME_STEP_S,
    MODEL_LAG_S,
    MODEL_LEVEL_M_S2,
    MODEL_VERTICAL_M_S2,
)
from swarmtrack.formation.setpoint import STANDSTILL, Velocity


class _Off(NamedTuple):
    """How far it is off its slot [m] at t [s], and by how much [m] it should have come nearer since the first."""

    t: float
    error: float
    nearer: float


class DivergenceWatch:
    """Takes each command with the flown velocity; `doubt` reports a difference that lasts for seconds."""

    def __init__(self) -> None:
        self.difference: Velocity = STANDSTILL
        """m/s: flown less told, averaged."""
        self._t: float | None = None
        self._expected: Velocity = STANDSTILL
        self._demand = 0.0
        self._said = False
        self._agrees_since: float | None = None
        self._way: deque[_Off] = deque()
        self._parts: tuple[float, float] | None = None

    def add_sample(self, t: float, told: Velocity, flown: Velocity, *, usable: bool = True) -> None:
        """told [m/s]: command since the last call; flown [m/s]: over ground, by the own autopilot; usable: that is
        known.
        """
        dt = 0.0 if self._t is None else t - self._t
        begins = self._t is None or not usable or not 0.0 <= dt <= LONGEST_TIME_STEP_S
        self._t = t
        if begins:
            # From here on it has to become what is told.
            self._expected = flown
            return
        self._expected = _lagged(self._expected, told, dt)
        off = _beyond_short(_minus(flown, self._expected), self._expected)
        share = min(dt / DIVERGENCE_MEAN_S, 1.0)
        self.difference = _plus(self.difference, _minus(off, self.difference), share)
        self._demand += share * (math.hypot(*_minus(told, self._expected)) - self._demand)
        self._judge(t)

    def follow(self, t: float, error: Velocity, along: Velocity) -> None:
        """The drone flies to its slot. error [m]: vector to the slot; along [m/s]: the slot's velocity."""
        size = math.hypot(*error)
        closing = 0.0
        if size > 0.0:
            closing = sum(e * v for e, v in zip(error, _minus(self._expected, along), strict=True)) / size
        before = self._way[-1] if self._way else None
        if before is None or not 0.0 < t - before.t <= LONGEST_TIME_STEP_S:
            self._way.clear()
            self._way.append(_Off(t, size, 0.0))
            return
        self._way.append(_Off(t, size, before.nearer + (t - before.t) * closing))
        while t - self._way[0].t > DIVERGENCE_WITHIN_S:
            first = self._way.popleft()
            farther, nearer = size - first.error, self._way[-1].nearer - first.nearer
            if farther > DIVERGENCE_FARTHER_M and nearer > DIVERGENCE_NEARER_M:
                self._parts = t, farther
                self._way.clear()
                return

    def doubt(self, t: float) -> str | None:
        """The divergence at t in words; None while the drone flies as commanded."""
        if self._said:
            return f"flies {math.hypot(*self.difference):.1f} m/s off its command"
        if self._parts is not None and 0.0 <= t - self._parts[0] < DIVERGENCE_HOLDS_S:
            return f"{self._parts[1]:.1f} m farther off its slot, against its command"
        return None

    def _judge(self, t: float) -> None:
        size = math.hypot(*self.difference)
        if size > DIVERGENCE_AGREES_M_S:
            self._agrees_since = None
            self._said = self._said or size > DIVERGENCE_REPORTED_M_S + DIVERGENCE_DEMAND_SHARE * self._demand
            return
        if self._agrees_since is None:
            self._agrees_since = t
        if t - self._agrees_since >= DIVERGENCE_AGREES_S:
            self._said = False


def _lagged(now: Velocity, told: Velocity, dt: float) -> Velocity:
    """How an autopilot flies dt [s] later."""
    rate = saturated(
        ((told[0] - now[0]) / MODEL_LAG_S, (told[1] - now[1]) / MODEL_LAG_S, 0.0), MODEL_LEVEL_M_S2
    )
    climb = min(max((told[2] - now[2]) / MODEL_LAG_S, -MODEL_VERTICAL_M_S2), MODEL_VERTICAL_M_S2)
    return now[0] + dt * rate[0], now[1] + dt * rate[1], now[2] + dt * climb


def _beyond_short(off: Velocity, expected: Velocity) -> Velocity:
    """What is left of a difference once a drone may fall short of the expected velocity by `DIVERGENCE_SHORTFALL_SHARE`
    of it."""
    speed = math.hypot(*expected)
    if speed <= 0.0:
        return off
    along = sum(a * b for a, b in zip(off, expected, strict=True)) / speed
    forgiven = min(max(-along, 0.0), DIVERGENCE_SHORTFALL_SHARE * speed) / speed
    return _plus(off, expected, forgiven)


def _minus(a: Velocity, b: Velocity) -> Velocity:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _plus(a: Velocity, b: Velocity, share: float) -> Velocity:
    return a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2]
