"""Is the observer itself where it thinks it is, and does it look where it thinks it looks?

Theory of operation. A heading that is off, a camera mounted askew and a start that was measured wrongly last for the
whole flight, and they shift all projections of an observer together. So they are no noise of each projection but one
state, and what is known of it is a mixture:

* turned: the azimuth is off by about one of `AZIMUTHS_DEG`. The prior is that of the autopilot's heading, with a tail,
  because some compasses are simply wrong. Where motion is compared by every heading, one of `FAR_DEG` may be it, too.
* elsewhere: the drone stands on a teammate's pad, or some metres from its own (`Elsewhere`).
* lost: projections tell nothing.

All confirmed tracks are matched to all teammates whose place is known, once per component, whatever names the tracks
have by now. The weight of all matchings, of teammates that should be in view and have no track, and of tracks that are
nobody is the likelihood of the component. It is taken from one scan at a time: the errors of the teammates' own places
last as well, so that a second look adds nothing.

Names are then those of each turned component, by its weight. A shift that two or more teammates reveal is found; one
that makes a drone appear where its neighbour should be makes both unknown. Who is elsewhere names nobody.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.identity.motion_evidence import TURNS
from swarmtrack.identity.onlookers import Onlookers
from swarmtrack.identity.posterior import (
    GATE_PROBABILITY,
    IN_VIEW,
    PRIOR,
    ReprojectionResiduals,
    log_ratios_of_each,
)
from swarmtrack.identity.reprojection import NEAREST, ObserverCamera, Predictions
from swarmtrack.messages import Array
from swarmtrack.tracking.association import gate_threshold
from swarmtrack.tracking.gaussian import LOG_TWO_PI
from swarmtrack.tracking.marginals_of_each import matched_of_each

# The middle of each component and its own sigma: denser where headings usually are.
AZIMUTHS_DEG = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 15.0, 18.0, 22.0, 26.0, 30.0)
WIDTHS_DEG = (1.2, 1.2, 1.2, 1.2, 1.2, 1.2, 1.5, 1.8, 1.8, 2.2, 2.2, 2.2)
# The same beyond, where only motion finds the azimuth; and of compasses those that point anywhere.
FAR_DEG, FAR_WIDTH_DEG = (42.0, 60.0, 80.0, 100.0, 120.0, 140.0, 160.0, 180.0), 7.0
ANYWHERE = 0.05
# rad: components that are no further apart tell the same.
NEIGHBOURS = math.radians(25.0)
# Of compasses and mountings: those that are off by more than the autopilot says, and by how much (one sigma, rad).
ASKEW, ASKEW_SIGMA = 0.05, math.radians(8.0)
# Of starts: those that are a teammate's, and those that are off by metres.
ON_ANOTHERS_PAD, MISPLACED = 0.03, 0.03
# m by which these are off, in so many directions, and the sigma of each as a share of it.
MISPLACED_M, DIRECTIONS, MISPLACED_SIGMA = (1.0, 1.7, 2.9, 4.9), 8, 0.35
# Of drones: those that know neither.
LOST = 0.03
# Of teammates: those that are elsewhere than they say, by whatever is wrong with them; and the log odds by motion from
# which on that is thought of.
ASTRAY, MOVES_AS = 0.05, math.log(20.0)
# m: as far from where it thinks is a drone that is lost.
LOST_M = 5.0
# Nats below the best: a component that is no likelier is not worth a thought.
NEGLIGIBLE = math.log(1e3)
# rad: no heading is known better.
LEAST_SIGMA = 1e-3
# px: so far outside the image is whoever is behind the camera.
OUTSIDE_PX = 1e5
# Of the logistic curve that is the normal distribution's, to one percent.
LOGISTIC = 1.702


class Components(NamedTuple):
    """By how much the heading may be off, (c,) each: azimuth [rad], its sigma, and the logarithm of its prior."""

    azimuth: Array
    sigma: Array
    log_prior: Array

    def only(self, chosen: Sequence[int]) -> Components:
        """These of them."""
        return Components(self.azimuth[chosen], self.sigma[chosen], self.log_prior[chosen])

    def turns(self, thought_of: int) -> list[int]:
        """(c,): which of the first `thought_of` `TURNS` is nearest to each."""
        away = _wrapped(self.azimuth[:, None] - TURNS[:thought_of])
        found: list[int] = np.abs(away).argmin(axis=1).tolist()
        return found


class Elsewhere(NamedTuple):
    """Where the drone may be instead, (h,) each: shift (h, 3) m from where it thinks, sigma [m], and the logarithm of
    the prior. places (h, m, 3) m: where all m teammates are then; who has changed pads with it is on its own.
    place_sigma (m,) m, p_seen (m,): that one in view has a track."""

    shift: Array
    sigma: Array
    log_prior: Array
    places: Array
    place_sigma: Array
    p_seen: Array


class OwnPose(NamedTuple):
    """What is known of it: of a heading with that sigma [rad] the components and their weights (c,); of h other places,
    each by shift (h, 3) ± shift_sigma (h,) m from where it thinks, the weights other_weight (h,); lost: the probability
    that it knows neither. All weights sum to one."""

    heading_sigma: float
    components: Components
    weight: Array
    lost: float
    shift: Array
    shift_sigma: Array
    other_weight: Array

    @property
    def elsewhere(self) -> float:
        """The probability that it is in another place."""
        return float(self.other_weight.sum())

    @property
    def likely(self) -> list[int]:
        """The components that are worth a thought."""
        found: list[int] = np.flatnonzero(self.weight > math.exp(-NEGLIGIBLE)).tolist()
        return found

    def by_turn(self) -> Array:
        """(b,): how likely the heading is off by each of `TURNS`; that of who is elsewhere or lost is right."""
        weight = np.bincount(self.components.turns(len(TURNS)), self.weight, len(TURNS))
        weight[0] += self.elsewhere + self.lost
        return np.asarray(weight / weight.sum())

    @property
    def beside(self) -> float:
        """The probability that the heading is off by another angle than the likeliest, and by far."""
        azimuth = self.components.azimuth
        far = np.abs(azimuth) > math.radians(AZIMUTHS_DEG[-1] + 1.0)
        off = _wrapped(azimuth - azimuth[self.weight.argmax()])
        return float(self.weight[far & (np.abs(off) > NEIGHBOURS)].sum())

    @property
    def turned(self) -> float:
        """The probability that projections tell who is who, turned or not."""
        return 1.0 - self.elsewhere - self.lost

    def mixed(self, ratios: Array, judged: Array) -> tuple[Array, Array]:
        """Of likely components and then of who is elsewhere or lost, log ratios (c + 1, n, k) and what they become with
        the past (c + 1, n, m): probabilities (n, m) of all pairs, and log ratios (n, k), by the components' weights."""
        if not judged.shape[1]:
            return np.zeros(judged.shape[1:]), np.zeros(ratios.shape[1:])
        weight = np.array([*self.weight[self.likely], max(self.elsewhere + self.lost, 1e-12)])
        weight /= weight.sum()
        probability = np.tensordot(weight, matched_of_each(judged).probability, axes=1)
        mean = np.logaddexp.reduce(ratios + np.log(weight)[:, None, None], axis=0, initial=-np.inf)
        return np.asarray(probability), np.asarray(mean)

    def off_by(self, azimuth: float, metres: float) -> float:
        """The probability that it is lost, turned by more than so much [rad], or elsewhere by more than so much."""
        turned = np.abs(self.components.azimuth) > azimuth
        moved = np.linalg.norm(self.shift, axis=1) > metres
        return float(self.weight[turned].sum() + self.other_weight[moved].sum()) + self.lost

    def seen_by(self, onlookers: Onlookers) -> list[OwnPose]:
        """The same with what teammates say of where they see this drone, which no heading of its own changes; then
        without each of them."""
        shift, sigma = np.vstack([np.zeros(3), self.shift]), np.append(LOST_M, self.shift_sigma)
        return [self._weighed(ratio[0], ratio[1:]) for ratio in onlookers.log_ratios(shift, sigma)]

    def _weighed(self, lost: float, there: Array) -> OwnPose:
        """With these log ratios of being lost and of other places (h,) and of being where it thinks."""
        most = max(0.0, lost, *there.tolist())
        weight, other_weight = self.weight * math.exp(-most), self.other_weight * np.exp(there - most)
        p_lost = self.lost * math.exp(lost - most)
        total = float(weight.sum() + other_weight.sum()) + p_lost
        return self._replace(weight=weight / total, other_weight=other_weight / total, lost=p_lost / total)


# Other places, while nobody thinks of any: shift, its sigma and weight.
NOWHERE_ELSE = np.zeros((0, 3)), np.zeros(0), np.zeros(0)


@lru_cache(maxsize=16)
def components(heading_sigma: float, *, all_around: bool = False) -> Components:
    """The prior. heading_sigma [rad]: of the autopilot's heading; all_around: with those which only motion finds."""
    heading_sigma = max(heading_sigma, LEAST_SIGMA)
    # Of an autopilot that has been silent nothing is known; then the components are as much wider.
    scale = max(heading_sigma / ASKEW_SIGMA, 1.0)
    half, wide = scale * np.radians(AZIMUTHS_DEG), scale * np.radians(WIDTHS_DEG)
    azimuth = np.concatenate([-half[:0:-1], half])
    edges = [-math.inf, *(0.5 * (azimuth[1:] + azimuth[:-1])).tolist(), math.inf]

    def shares(sigma: float) -> Array:
        """How often it is nearest to each."""
        below = [0.5 * math.erfc(-edge / (math.sqrt(2.0) * sigma)) for edge in edges]
        return np.diff(below)

    turned = (1.0 - ASKEW) * shares(heading_sigma) + ASKEW * shares(ASKEW_SIGMA)
    sigma = np.minimum(np.concatenate([wide[:0:-1], wide]), heading_sigma)
    far = np.radians([*(-deg for deg in FAR_DEG[:-1]), *FAR_DEG])
    far = far[np.abs(far) > azimuth[-1]]
    if all_around and far.size:
        azimuth = np.concatenate([azimuth, far])
        sigma = np.concatenate([sigma, np.full(far.size, math.radians(FAR_WIDTH_DEG))])
        turned = np.concatenate([(1.0 - ANYWHERE) * turned, np.full(far.size, ANYWHERE / far.size)])
    known = 1.0 - ON_ANOTHERS_PAD - MISPLACED - LOST
    return Components(azimuth, sigma, np.log(np.maximum(known * turned, 1e-12)))


def unknown(heading_sigma: float) -> OwnPose:
    """What is known before anybody was looked at."""
    of = components(heading_sigma)
    weight = np.exp(of.log_prior)
    return OwnPose(heading_sigma, of, weight / weight.sum() * (1.0 - LOST), LOST, *NOWHERE_ELSE)


def elsewhere(
    places: Array, place_sigma: Array, p_seen: Array, *, pads: Array, whose: Sequence[int], own_pad: Array
) -> Elsewhere:
    """Where the drone may be instead. places (m, 3), place_sigma (m,) m: of the teammates; pads (k, 3) m: where they
    and others began, by their word, whose: their places' rows, −1 where there are none; own_pad (3,) m: where this
    drone thinks that it began."""
    k = len(pads)
    bearing = np.arange(DIRECTIONS) * (2.0 * math.pi / DIRECTIONS)
    around = np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(DIRECTIONS)])
    far = np.repeat(MISPLACED_M, DIRECTIONS)
    shift = np.concatenate([pads - own_pad, far[:, None] * np.tile(around, (len(MISPLACED_M), 1))])
    there = np.repeat(places[None], len(shift), axis=0)
    for pad, row in enumerate(whose):
        if row >= 0:
            there[pad, row] -= shift[pad]
    prior = np.concatenate([np.full(k, ON_ANOTHERS_PAD / max(k, 1)), np.full(len(far), MISPLACED / len(far))])
    sigma = np.concatenate([np.zeros(k), MISPLACED_SIGMA * far])
    return Elsewhere(shift, sigma, np.log(prior), there, place_sigma, p_seen)


def shifted(
    found: ReprojectionResiduals, predicted: Predictions, view: ObserverCamera, of: Components
) -> ReprojectionResiduals:
    """The residuals in each component, (c, n, k, 2) and (g, c, n, k, 2, 2), of those without the heading's variance.
    What no heading turns stays what it is."""
    pixel = _turned(predicted.pixel, view, of.azimuth)
    shift = np.where(np.any(predicted.turn, axis=1, keepdims=True), pixel - predicted.pixel, 0.0)
    turn = predicted.turn[:, :, None] * predicted.turn[:, None, :]
    wider = (of.sigma**2)[:, None, None, None] * turn
    return ReprojectionResiduals(
        found.mean - shift[:, None], found.cov[:, None] + wider[:, None], found.share
    )


class ScanEvidence(NamedTuple):
    """What one scan shows: n confirmed tracks at z (n, 2) ± variance (n,) px, and where k teammates ahead should be,
    without the heading's variance, of all m whose place is known: column (k,) among these. p_seen (k,): that one in
    view has a track; strangers (n,): expected in the image; motion (b, n, m): the log ratio that a track moves as a
    teammate says, zero where nobody says anything, by each turn of north that is thought of; vague (m,): of whom only
    the motion is known."""

    z: Array
    variance: Array
    found: ReprojectionResiduals
    predicted: Predictions
    column: list[int]
    p_seen: Array
    strangers: Array
    motion: Array
    vague: NDArray[np.bool_]


def weigh(look: ScanEvidence, view: ObserverCamera, others: Elsewhere | None = None) -> OwnPose:
    """What one scan tells of the own pose. others: None, where there is no reason to think of them."""
    sigma = math.sqrt(float(view.observer.attitude_cov[2, 2]))
    of = components(sigma, all_around=len(look.motion) > 1)
    here = shifted(look.found, look.predicted, view, of)
    missed = np.log1p(-look.p_seen * _in_view(look, here, view.camera))
    log_seen = np.log(look.p_seen) - np.log(look.strangers)[:, None]
    turned = log_ratios_of_each(here, view.camera) - PRIOR.log_ratio + log_seen - missed[:, None]
    anywhere = math.log1p(-PRIOR.p_seen * IN_VIEW)
    motion = look.motion[of.turns(len(look.motion))]
    lost = math.log(PRIOR.p_seen * IN_VIEW) - anywhere - np.log(look.strangers)[:, None] + look.motion
    # Who moves as a track does is that track, wherever it should be.
    elsewhere = np.where(look.vague, 0.0, np.where(look.motion > MOVES_AS, math.log(ASTRAY), -np.inf))
    astray = lost + elsewhere
    every = astray[of.turns(len(look.motion))]
    every[:, :, look.column] = np.logaddexp(every[:, :, look.column], turned + motion[:, :, look.column])
    announced = int((~look.vague).sum())
    log_weight, best = _log_weights(of.log_prior + missed.sum(axis=1), every)
    lost_weight, best = _log_weights(np.array([math.log(LOST) + announced * anywhere]), lost[:1], best)
    shift, shift_sigma, others_weight = NOWHERE_ELSE
    if others is not None:
        shift, shift_sigma = others.shift, others.sigma
        log_known, of_others = _of_others(look, view, others)
        there = np.repeat(astray[:1], len(log_known), axis=0)
        placed = np.flatnonzero(~look.vague)
        there[:, :, placed] = np.logaddexp(of_others + look.motion[0][:, placed], there[:, :, placed])
        others_weight, best = _log_weights(log_known, there, best)
    parts = [np.exp(part - best) for part in (log_weight, lost_weight, others_weight)]
    total = sum(float(part.sum()) for part in parts)
    return OwnPose(
        sigma, of, parts[0] / total, float(parts[1].sum()) / total, shift, shift_sigma, parts[2] / total
    )


def _of_others(look: ScanEvidence, view: ObserverCamera, others: Elsewhere) -> tuple[Array, Array]:
    """Of each: the logarithm (h,) of what is known before the matching, and the log ratios (h, n, m)."""
    camera, observer = view.camera, view.observer
    from_here = others.places - (view.team_from_camera.position + others.shift)[:, None]
    pixel, _, ahead = camera.project_undistorted((from_here @ view.team_from_camera.rotation).reshape(-1, 3))
    shape = from_here.shape[:2]
    pixel, ahead = np.where(ahead[:, None], pixel, OUTSIDE_PX).reshape(*shape, 2), ahead.reshape(shape)
    place = others.place_sigma**2 + others.sigma[:, None] ** 2 + observer.position_sigma**2
    distance = np.maximum(np.linalg.norm(from_here, axis=2), NEAREST)
    focal = np.broadcast_to(camera.per_radian(pixel.reshape(-1, 2))[..., 0], ahead.size).reshape(shape)
    variance = focal**2 * (place / distance**2 + observer.attitude_sigma**2)
    inside = _inside(pixel, np.sqrt(variance)[..., None], camera) * ahead
    missed = np.log1p(-others.p_seen * inside)
    of_pair = variance[:, None] + look.variance[:, None]
    squared = ((look.z[:, None] - pixel[:, None]) ** 2).sum(axis=3) / of_pair
    log_area = math.log(camera.width * camera.height)
    extent = np.minimum(LOG_TWO_PI + np.log(of_pair), log_area - math.log(IN_VIEW))
    ratio = np.log(others.p_seen) + log_area - extent - 0.5 * squared - missed[:, None]
    ratio = (
        np.where(squared < gate_threshold(GATE_PROBABILITY), ratio, -np.inf) - np.log(look.strangers)[:, None]
    )
    return others.log_prior + missed.sum(axis=1), np.asarray(ratio)


def _log_weights(log_known: Array, ratios: Array, best: float = -math.inf) -> tuple[Array, float]:
    """Of components (c,), by what is known before the matching and by its log ratios (c, n, m), and the best so far. Of
    those that are surely negligible beside it the weight is zero."""
    log_weight = np.full(len(log_known), -np.inf)
    bound = log_known + _at_most(ratios)
    likeliest_first = np.argsort(-bound)
    for some in (likeliest_first[:1], likeliest_first[1:]):
        worth = some[bound[some] >= best - NEGLIGIBLE]
        if worth.size:
            log_weight[worth] = log_known[worth] + matched_of_each(ratios[worth]).log_total
            best = max(best, float(log_weight[worth].max()))
    return log_weight, best


def _wrapped(angle: Array) -> Array:
    """rad, in −π … π."""
    return np.asarray((angle + math.pi) % (2.0 * math.pi) - math.pi)


def _turned(pixel: Array, view: ObserverCamera, azimuth: Array) -> Array:
    """(c, k, 2) px: where what should be at pixel (k, 2) is, if the autopilot's heading is too large by azimuth (c,)
    rad."""
    c, s, zero = np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)
    about = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]]).transpose(2, 0, 1)
    rays = view.rays(pixel) @ about.swapaxes(1, 2) @ view.team_from_camera.rotation
    turned, _, ahead = view.camera.project_undistorted(rays.reshape(-1, 3))
    return np.asarray(np.where(ahead[:, None], turned, OUTSIDE_PX).reshape(*rays.shape[:2], 2))


def _in_view(look: ScanEvidence, here: ReprojectionResiduals, camera: PinholeCamera) -> Array:
    """(c, k) that each is in the image, in each component."""
    found, predicted = look.found, look.predicted
    if not found.mean.shape[0]:
        return np.zeros((len(here.mean), len(predicted.drone_id)))
    pixel = predicted.pixel + found.mean[0] - here.mean[:, 0]
    variance = (predicted.cov[:, None] + here.cov[:, :, 0] - found.cov[:, None, 0]).diagonal(axis1=3, axis2=4)
    inside = _inside(pixel, np.sqrt(np.maximum(variance, 1.0)), camera)
    return np.asarray((found.share[:, None] * inside).sum(axis=0))


def _inside(pixel: Array, sigma: Array, camera: PinholeCamera) -> Array:
    """(…,) that what is at pixel (…, 2), ± sigma (…, 2), is in the image."""
    low, high = camera.frame_bounds
    reached: Array | float = 1.0
    if camera.is_wide:
        framed = camera.framed(pixel.reshape(-1, 2))
        sigma = sigma * np.reshape(framed.scale, pixel.shape)
        spread = np.sqrt(((sigma / [camera.fx, camera.fy]) ** 2).mean(axis=-1))
        reached = _below(camera.within_reach(framed.at).reshape(pixel.shape[:-1]) / spread)
        pixel = framed.at.reshape(pixel.shape)
    return np.asarray(
        (_below((high - pixel) / sigma) - _below((low - pixel) / sigma)).prod(axis=-1) * reached
    )


def _below(sigmas: Array) -> Array:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * LOGISTIC * sigmas))


def _at_most(log_ratio: Array) -> Array:
    """(c,): no less than the logarithm of the weight of all matchings of (c, n, m): rows, or columns, that share
    without dispute."""
    by_rows = np.logaddexp.reduce(log_ratio, axis=2, initial=0.0).sum(axis=1)
    by_columns = np.logaddexp.reduce(log_ratio, axis=1, initial=0.0).sum(axis=1)
    return np.asarray(np.minimum(by_rows, by_columns))
