"""How well drones hold their slots around a leader, how near they come to each other, and who is lost: by the truth.

An error is how far a follower is from its slot beside where the leader truly is, in three dimensions. Errors count
from when the leader flies off until it leaves everybody's view, or the end; *last* is the mean of the last LAST_S of
that. A follower is lost that is more than LOST_SLOT_M off then. Separations count from beginning to end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array

LOST_SLOT_M, LAST_S = 3.0, 3.0
# m: nobody comes nearer to anybody.
NEAR_MISS_M = 1.5
# s after the leader has gone, at which the followers' speeds are told.
STOPS_AFTER_S = (1.0, 2.0, 3.0, 4.0)


class SlotErrors(NamedTuple):
    """Of one flight with k followers. errors (m, k) m, at m instants; last (k,) m; nearest: of all pairs [m]."""

    errors: Array
    last: Array
    nearest: float


class LeaderGone(NamedTuple):
    """speeds: of the fastest follower [m/s] at `STOPS_AFTER_S`; flown_on_m: by the farthest."""

    speeds: tuple[float, ...]
    flown_on_m: float


@dataclass(frozen=True, slots=True)
class FormationScore:
    """Of one flight or several. held: how often a follower held; gone: where the leader has left. NaN: nothing said."""

    followers: int
    error_p50_m: float
    error_p95_m: float
    end_p95_m: float
    min_separation_m: float
    lost: int
    holds: int = 0
    gone: LeaderGone | None = None


def slot_errors(t: Array, positions: Array, slots: Array, begins: float, ends: float) -> SlotErrors:
    """t (m,) s; positions (m, n, 3) m, the leader's first; slots (n, 3) m; judged from `begins` to `ends` [s]."""
    off = positions - slots
    errors = np.linalg.norm(off[:, 1:] - off[:, :1], axis=2)
    judged = (t >= begins) & (t < ends)
    last = judged & (t > min(ends, float(t[-1])) - LAST_S) if t.size else judged
    mean = errors[last].mean(axis=0) if last.any() else np.full(errors.shape[1], math.nan)
    return SlotErrors(errors[judged], mean, nearest_pair(positions))


def nearest_pair(positions: Array) -> float:
    """m, of positions (m, n, 3) at m instants; inf of nobody."""
    pairs = combinations(range(positions.shape[1]), 2)
    apart = (
        np.linalg.norm(positions[:, i] - positions[:, j], axis=1).min(initial=math.inf) for i, j in pairs
    )
    return float(min(apart, default=math.inf))


def after_it_vanished(t: Array, positions: Array, gone_s: float) -> LeaderGone:
    """positions (m, k, 3) m of the followers at t (m,) s, until which the flight goes on."""
    if not t.size or t[-1] < gone_s:
        return LeaderGone(len(STOPS_AFTER_S) * (math.nan,), math.nan)
    speeds = np.linalg.norm(np.gradient(positions, t, axis=0), axis=2).max(axis=1)
    begun = positions[int(np.searchsorted(t, gone_s))]
    told = (gone_s + later for later in STOPS_AFTER_S)
    return LeaderGone(
        tuple(float(np.interp(at, t, speeds, right=math.nan)) for at in told),
        float(np.linalg.norm(positions[-1] - begun, axis=1).max(initial=0.0)),
    )


def formation_score(
    flights: Sequence[SlotErrors], *, holds: int = 0, gone: LeaderGone | None = None
) -> FormationScore:
    """Over all errors of all flights."""
    errors = np.concatenate([flight.errors.ravel() for flight in flights])
    last = np.concatenate([flight.last for flight in flights])
    p50, p95 = np.percentile(errors, [50, 95]).tolist() if errors.size else (math.nan, math.nan)
    return FormationScore(
        followers=len(last),
        error_p50_m=p50,
        error_p95_m=p95,
        end_p95_m=float(np.percentile(last, 95)) if last.size else math.nan,
        min_separation_m=min((flight.nearest for flight in flights), default=math.inf),
        lost=int((last > LOST_SLOT_M).sum()),
        holds=holds,
        gone=gone,
    )
