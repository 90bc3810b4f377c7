"""What tells of a teammate's place and motion, each as innovation, H and R of the state in `log_range.py`.

What a camera sees is measured at the scan, of all teammates at once. What is said or ranged comes with a time of its
own: it is compared with the belief of the last scan before, carried on to that time (`Carried`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array
from swarmtrack.relative.log_range import (
    ACROSS_RAY,
    HEADING_OFFSET,
    LASTING_SIZE,
    LOG_RANGE,
    PLACE_ERROR,
    SCALED_SPEED,
    STATE_SIZE,
    WANDERING_SIZE,
    Beliefs,
    Decay,
    across,
)
from swarmtrack.relative.priors import RELATIVE_NEAREST_M

_ABOUT_DOWN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
"""(3, 3): by how much a turn about the vertical moves a vector, per rad."""


class Measured(NamedTuple):
    """nu (…, m), H (…, m, 12), R (…, m, m)."""

    nu: Array
    H: Array
    R: Array


class SizedRange(NamedTuple):
    """By the widths of boxes, (n,) each: ln(range), NaN where they tell none; how many times the lasting and the
    wandering error are in it, and the variance of what is neither."""

    log_range: Array
    lasting: Array
    wandering: Array
    variance: Array


def seen(now: Beliefs, ray: Array, ray_cov: Array, size: SizedRange) -> Measured:
    """By the camera, of n teammates. ray (n, 3) unit vectors in team axes, ray_cov (n, 3, 3) rad²; what was not seen is
    NaN."""
    n = now.n
    nu, H, R = np.zeros((n, 3)), np.zeros((n, 3, STATE_SIZE)), np.zeros((n, 3, 3))
    got = np.isfinite(ray[:, 0])
    sized = got & np.isfinite(size.log_range)
    lasting, wandering = (np.where(sized, times, 0.0) for times in (size.lasting, size.wandering))
    by_size = now.log_range + lasting * now.size[:, 0] + wandering * now.size[:, 1]
    ahead = (ray * now.d).sum(axis=1)
    got &= ahead > 0.5
    axes = now.E.swapaxes(1, 2)
    with np.errstate(invalid="ignore"):
        nu[:, :2] = np.where(got[:, None], (axes @ ray[:, :, None])[:, :, 0] / ahead[:, None], 0.0)
        nu[:, 2] = np.where(sized, size.log_range - by_size, 0.0)
    H[:, 0, 0] = H[:, 1, 1] = got
    H[:, 2, LOG_RANGE], H[:, 2, LASTING_SIZE], H[:, 2, WANDERING_SIZE] = sized, lasting, wandering
    R[:, :2, :2] = np.where(got[:, None, None], axes @ ray_cov @ now.E, np.eye(2))
    R[:, 2, 2] = size.variance
    return Measured(nu, H, R)


class Carried(NamedTuple):
    """One teammate at the time of a message: x (3,) m from where the camera was at the scan, velocity v (3,) m/s, and
    their derivatives by the error state, (3, 12) each; noise_x m² and noise_v m²/s² of each axis since the scan. turn
    rad, place (3,) m: the errors of what it says, as they are believed.

    Metres are exp(l) times what the state holds. While l is hardly known that bends: bent_x, bent_v (3,) are the second
    order of the means, and more_x, more_v (3, 3) of the covariances. Without them a velocity that is said by a teammate
    of unknown range makes a sure wrong range.
    """

    x: Array
    v: Array
    by_x: Array
    by_v: Array
    noise_x: float
    noise_v: float
    bent_x: Array
    bent_v: Array
    more_x: Array
    more_v: Array
    place: Array
    turn: float

    @classmethod
    def of(cls, then: Beliefs, step: Decay) -> Carried:
        """then: of one row, at the scan; step: from there on."""
        rho = float(np.exp(then.log_range[0]))
        r, v = rho * then.d[0], rho * then.s[0]
        by_r, by_v = np.zeros((3, STATE_SIZE)), np.zeros((3, STATE_SIZE))
        by_r[:, ACROSS_RAY] = rho * then.E[0]
        by_r[:, LOG_RANGE] = r
        by_v[:, LOG_RANGE] = v
        by_v[:, SCALED_SPEED] = rho * np.eye(3)
        P = then.P[0]
        vague, shared = float(P[LOG_RANGE, LOG_RANGE]), rho * P[LOG_RANGE, SCALED_SPEED]
        bent_v = 0.5 * vague * v + shared
        more_v = 0.5 * vague**2 * np.outer(v, v) + vague * (np.outer(v, shared) + np.outer(shared, v))
        more_v += rho**2 * vague * P[SCALED_SPEED, SCALED_SPEED] + np.outer(shared, shared)
        return cls(
            r + step.phi * v,
            step.left * v,
            by_r + step.phi * by_v,
            step.left * by_v,
            float(step.pp[0]),
            float(step.vv[0]),
            0.5 * vague * r + step.phi * bent_v,
            step.left * bent_v,
            0.5 * vague**2 * np.outer(r, r) + step.phi**2 * more_v,
            step.left**2 * more_v,
            then.place[0],
            float(then.turn[0]),
        )


def said_velocity(at: Carried, velocity: Array, cov: Array) -> Measured:
    """The teammate's own velocity (3,) m/s, by its own north; cov (3, 3)."""
    turned = _ABOUT_DOWN @ at.v
    H = at.by_v + at.turn * _ABOUT_DOWN @ at.by_v
    H[:, HEADING_OFFSET] += turned
    nu = velocity - at.v - at.bent_v - at.turn * turned
    return Measured(nu, H, cov + at.more_v + at.noise_v * np.eye(3))


def said_place(at: Carried, place: Array, cov: Array) -> Measured:
    """Where the teammate says it is, (3,) m from where the camera was at the scan; cov (3, 3): of what does not last,
    as what lasts is a state."""
    H = at.by_x.copy()
    H[:, PLACE_ERROR] += np.eye(3)
    return Measured(place - at.x - at.bent_x - at.place, H, cov + at.more_x + at.noise_x * np.eye(3))


def ranged(at: Carried, distance: float, sigma: float, own_way: Array) -> Measured:
    """A distance [m]; its logarithm, in which the state is linear. own_way (3,) m: of the camera since the scan."""
    x = at.x - own_way
    rho = float(np.sqrt(x @ x))
    # Of a distance that is none, the logarithm would be as vague as it is wrong.
    variance = (sigma**2 + at.noise_x) / max(distance, RELATIVE_NEAREST_M) ** 2
    return Measured(
        np.array([math.log(distance / rho)]), (x / rho**2 @ at.by_x)[None], np.array([[variance]])
    )


def ray_of_another(
    at: Carried, origin: Array, direction: Array, sigma: float, origin_sigma: float
) -> Measured:
    """A ray on which another drone sees the teammate. origin (3,) m from where our camera was at the scan; direction
    (3,) unit; sigma rad, of frames that differ too; origin_sigma m per axis."""
    x = at.x - origin
    axes = across(direction[None])[0].T
    along = float(direction @ x)
    if along < RELATIVE_NEAREST_M:
        # It leads the other way: where the teammate is on its line, but behind, that is half a turn off.
        along = max(float(np.sqrt(x @ x)), RELATIVE_NEAREST_M)
        x = x + math.pi * along * axes[0]
    variance = sigma**2 + (origin_sigma**2 + at.noise_x) / along**2
    R = variance * np.eye(2) + axes @ at.more_x @ axes.T / along**2
    return Measured(-(axes @ (x + at.bent_x)) / along, axes @ at.by_x / along, R)
