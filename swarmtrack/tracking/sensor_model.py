"""Sensor model of the camera and its detector: detection probability, noise, and clutter."""

from __future__ import annotations

import math
from itertools import repeat
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.messages import Array, Scan
from swarmtrack.tracking.association import gate_threshold
from swarmtrack.tracking.gaussian import innovations, variances
from swarmtrack.tracking.lifecycle import probability_in_view
from swarmtrack.tracking.motion_model import POSITION
from swarmtrack.tracking.noise import NoiseScales, SurePairs
from swarmtrack.tracking.occlusion import hidden_behind, resolutions, unresolved
from swarmtrack.tracking.parameters import CommonParameters
from swarmtrack.tracking.priors import (
    BOX_SIZE_GATE_SIGMAS,
    CLUTTER_BOUND,
    CLUTTER_MEMORY_SCANS,
    CLUTTER_PRIOR_DETECTIONS,
    CLUTTER_PRIOR_SCANS,
    LEAST_MEASUREMENT_VARIANCE_PX2,
    LEAST_NOISE_SCORE,
    MISDRAWN_BOX_SIGMA,
    MOST_MEASUREMENT_CORRELATION,
    NOISE_BOUND,
    NOISE_MEMORY_DETECTIONS,
    NOISE_PRIOR_DETECTIONS,
    OUTLIER_SHARE,
    PIXEL_SIGMA_PX,
    SCORE_BOUNDS,
)


class Outliers(NamedTuple):
    """Detections that are off by more than their noise. share (m,): how often; R (m, 2, 2) px²: by how much;
    misdrawn: whether their looks show which they are. A box that looks normal and jumps is still the target's;
    one that looks odd was drawn around another object as well.
    """

    share: Array
    R: Array
    misdrawn: bool

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Outliers:
        return Outliers(self.share[rows], self.R[rows], self.misdrawn)


class Measurements(NamedTuple):
    """What can be used of a scan: z (m, 2), R (m, 2, 2), size (m, 2), odds (m,) of being no clutter; likeness (m,): the
    log odds of being a drone by looks alone, over those of `birth_score`; outliers: None where no detection is off by
    more than by R."""

    z: Array
    R: Array
    size: Array
    odds: Array
    likeness: Array
    outliers: Outliers | None = None

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Measurements:
        outliers = None if self.outliers is None else self.outliers.select(rows)
        return Measurements(
            self.z[rows], self.R[rows], self.size[rows], self.odds[rows], self.likeness[rows], outliers
        )


class Visibility(NamedTuple):
    """Visibility of n targets. p_detection (n,): that this scan detects it; in_view (n,): that it lies inside the
    image; overlap (n, n): that i and j are not resolved in it, but one detection; None where all are.
    """

    p_detection: Array
    in_view: Array
    overlap: Array | None


class Likelihoods(NamedTuple):
    """Likelihoods of n targets × m measurements. distance (n, m): squared Mahalanobis; log_ratio (n, m): how much
    more likely the measurement is as this target's than as clutter, log N(y; 0, S) − log κ and what the boxes
    say; −inf beyond the gate.
    """

    distance: Array
    log_ratio: Array


class SensorModel:
    """One camera with one detector, as a tracker's parameters describe it."""

    def __init__(self, camera: PinholeCamera, parameters: CommonParameters) -> None:
        self.camera = camera
        low, high = camera.ideal_bounds
        self._image = 0.5 * (low + high), high - low
        """Its middle and its extent (2,) in ideal px."""
        self.counters = {"unusable_detections": 0}
        self.R = parameters.measurement_sigma**2 * np.eye(2)
        self.clutter_per_scan = parameters.clutter_per_scan
        """As learned until now."""
        self._scans_learned = min(CLUTTER_PRIOR_SCANS, CLUTTER_PRIOR_DETECTIONS / parameters.clutter_per_scan)
        self._learns = parameters.learn_clutter and parameters.profile != "paper"
        self.noise_scale = 1.0
        """By which every R is multiplied, as learned until now, where it is learned upwards only."""
        self._detections_learned = NOISE_PRIOR_DETECTIONS
        self._noise_learned = parameters.learn_noise if parameters.profile != "paper" else "no"
        self.noise = NoiseScales(motion=self._noise_learned == "both" and parameters.has_calm_model)
        """Where it is learned both ways."""
        self.parameters = parameters
        self._gate = gate_threshold(parameters.gate_probability)
        bar = min(max(parameters.birth_score, SCORE_BOUNDS[0]), SCORE_BOUNDS[1])
        self._bar = math.log(bar / (1.0 - bar))
        """Of the likeness: the log odds that it is counted from."""
        self._uses_boxes = parameters.profile != "paper"
        self._occludes = parameters.occlusion and self._uses_boxes

    def usable(self, scan: Scan) -> Measurements:
        """The detections that are finite, near the image and known better than the image is large; the others are
        counted. A box larger than the image or without extent is none; a detection that came twice is two."""
        m, told = len(scan.z), self.parameters
        middle, extent = self._image
        if scan.size is not None and self._uses_boxes:
            size = np.asarray(scan.size, dtype=float)
            sensible = (size > 0.0) & (size < extent)
            if not sensible.all():
                size = np.where(sensible.all(axis=1)[:, None], size, np.nan)
        else:
            size = np.full((m, 2), np.nan)
        if scan.score is not None and self._uses_boxes:
            by_score = _odds(scan.score)
            odds = by_score**told.score_weight
            looks = by_score if scan.likeness is None else _odds(scan.likeness)
            likeness = np.log(looks) - self._bar
        else:
            odds, likeness = np.ones(m), np.full(m, np.inf)
        good = (np.abs(scan.z - middle) < extent).all(axis=1)  # NaN compares as False
        good &= np.isfinite(odds) & ~np.isnan(likeness)
        if scan.R is None:
            R = self.measurement_noise(size, scan.score)
        else:
            R, sound = _sound_covariances(scan.R, largest=float(extent.max()))
            good &= sound
        unusable = m - int(np.count_nonzero(good))
        self.counters["unusable_detections"] += unusable
        outliers = None
        if self._noise_learned == "both":
            told_R, R = R, self.noise.applied(R, size)
            by_looks = scan.likeness if self._uses_boxes else None
            outliers = _outliers(np.maximum(told_R, R), size, by_looks)
        elif self.noise_scale > 1.0:
            R = R * self.noise_scale
        measured = Measurements(scan.z, R, size, odds, likeness, outliers)
        return measured.select(good) if unusable else measured

    def measurement_noise(self, size: Array, score: Array | None) -> Array:
        """R (m, 2, 2) px² of detections that bring none; size (m, 2) px, NaN while unknown; score (m,).

        σ² = measurement_sigma² + side² (size_noise² + (score_noise (1 − s) / s)²) along each side of the box.
        """
        told, (widest, highest) = self.parameters, self._image[1].tolist()
        least = told.measurement_sigma**2
        if not self._uses_boxes:
            return np.tile(least * np.eye(2), (len(size), 1, 1))
        scores = repeat(1.0) if score is None else np.asarray(score).tolist()
        # In plain numbers: of a few boxes, arrays take five times as long.
        R = []
        for (width, height), score_of_it in zip(size.tolist(), scores, strict=False):
            s = min(max(LEAST_NOISE_SCORE, score_of_it), 1.0)
            share = told.size_noise**2 + (told.score_noise * (1.0 - s) / s) ** 2
            # A side that is not known, NaN, comes out of max as 0.
            w, h = min(max(0.0, width), widest), min(max(0.0, height), highest)
            R.append((least + w * w * share, 0.0, 0.0, least + h * h * share))
        return np.array(R).reshape(-1, 2, 2)

    def add_lasting_error(self, cov: Array) -> None:
        """To covariances (n, 4, 4) px², in place, where noise is measured: an error of the centre that lasts. Boxes
        have edges of whole pixels, and more boxes of a target that hovers round them the same way."""
        if self._noise_learned == "both":
            of_position = variances(cov)[:, POSITION]
            of_position += PIXEL_SIGMA_PX**2

    def visibility(
        self, mean: Array, cov: Array, size: Array | None = None, existence: Array | None = None
    ) -> Visibility:
        """Visibility of targets with means (n, 4), covariances (n, 4, 4), box sizes (n, 2) and existence (n,), both
        for who hides whom.
        """
        in_view = probability_in_view(mean, cov, self.camera)
        p_detection = self.parameters.p_detection * in_view
        if size is None:
            return Visibility(p_detection, in_view, None)
        overlap = self.overlap(mean, cov, size)
        if not overlap.any():
            return Visibility(p_detection, in_view, None)
        hidden = overlap * hidden_behind(size, self.parameters.size_sigma)
        if existence is not None:
            hidden *= existence
        return Visibility(p_detection * (1.0 - hidden).prod(axis=1), in_view, overlap)

    def overlap(self, mean: Array, cov: Array, size: Array) -> Array:
        """(n, n) that i and j are not resolved in this scan, but one detection; of means (n, 4), covariances (n, 4, 4)
        and box sizes (n, 2) px, NaN while unknown."""
        if not self._occludes:
            return np.zeros((len(mean), len(mean)))
        return unresolved(mean, cov, self.resolutions(mean, size))

    def resolutions(self, mean: Array, size: Array) -> Array:
        """(n, 2) px: how close another may come to targets with means (n, 4) and box sizes (n, 2) before the two are
        one detection; see `occlusion.resolutions`."""
        if self.camera.is_wide:
            # Boxes are measured in the image, of which this plane is stretched.
            at = mean[:, POSITION]
            size = size * self.camera.per_radian(at) / self.camera.box_per_radian(at)
        return resolutions(size, self.parameters.resolution_px)

    def box_likelihoods(self, size: Array, measured: Measurements) -> Array:
        """(n, m) what the boxes say for targets of sizes (n, 2) px, NaN while unknown: the part of the log-likelihoods
        that is the same wherever the targets are."""
        return _log_likelihood_of_sizes(size, measured.size, self.parameters.size_sigma)

    def likelihoods(self, mean: Array, cov: Array, boxes: Array, measured: Measurements) -> Likelihoods:
        """Likelihoods of targets with means (n, d) and covariances (n, d, d) of states that begin like [u, vu, v,
        vv]; boxes (n, m): see `box_likelihoods`. If measured.R is (k, m, 2, 2), the same with each of k noises,
        k in front.
        """
        distance, log_density = innovations(mean, cov, measured.z, measured.R)
        log_ratio = log_density - self.log_clutter_intensity(measured.odds)
        log_ratio += boxes
        log_ratio[distance > self._gate] = -np.inf
        return Likelihoods(distance, log_ratio)

    def learn_clutter(self, found: float, coverage: float = 1.0) -> None:
        """A scan of this share of the image is expected to have held `found` false detections.

        The mean of a Poisson rate's gamma posterior, whose memory fades; held within a factor of what was told, so
        that neither a flock of strangers nor an empty sky makes the filter blind.
        """
        if not self._learns:
            return
        told = self.parameters.clutter_per_scan
        self._scans_learned = min(self._scans_learned + coverage, CLUTTER_MEMORY_SCANS)
        learned = self.clutter_per_scan + (found - coverage * self.clutter_per_scan) / self._scans_learned
        self.clutter_per_scan = min(max(learned, told / CLUTTER_BOUND), told * CLUTTER_BOUND)

    def learn_noise(self, pairs: SurePairs, size: Array, *, steady: bool) -> None:
        """From who surely made which detections of a scan; size (m, 2) px of them; steady: see `NoiseScales.update`.

        Both ways where parameters say so. Else upwards only: stochastic approximation (Robbins & Monro, 1951) of the
        scale of R that makes squared Mahalanobis distances of the expected 2, as far as R is what they depend on. Too
        large an R makes tracks sluggish, too small a one loses targets; and the noise of real detectors has a small
        core and heavy tails, which one scale fitted to the core would cut off where there is no agile model.
        """
        if self._noise_learned == "no":
            return
        if self._noise_learned == "both":
            self.noise.update(pairs, size, steady=steady)
            return
        for distance in pairs.nis.tolist():
            self._detections_learned = min(self._detections_learned + 1.0, NOISE_MEMORY_DETECTIONS)
            learned = self.noise_scale * (1.0 + (0.5 * distance - 1.0) / self._detections_learned)
            self.noise_scale = min(max(learned, 1.0), NOISE_BOUND)

    def log_clutter_intensity(self, odds: Array) -> Array:
        """log κ (m,) per px²: uniform over the image, less for what the detector is sure of."""
        area = self.camera.width * self.camera.height
        return np.asarray(math.log(self.clutter_per_scan / area) - np.log(odds))

    @property
    def usual_birth(self) -> float:
        """`birth_existence` of a detection that brings no score."""
        birth = self.parameters.birth_per_scan
        return min(birth / (birth + self.clutter_per_scan), self.parameters.confirm_probability)

    def birth_existence(self, odds: Array) -> Array:
        """(m,) that a detection which no track explains is of a new target."""
        birth = self.parameters.birth_per_scan * odds
        return np.minimum(birth / (birth + self.clutter_per_scan), self.parameters.confirm_probability)


def within(values: Array, least: float | Array, most: float | Array) -> Array:
    """As `np.clip`, in half its time for a few values."""
    return np.minimum(np.maximum(values, least), most)


def _outliers(widest: Array, size: Array, likeness: Array | None) -> Outliers:
    """widest (m, 2, 2) px²: R of detections that only scatter; size (m, 2) px; likeness (m,)."""
    if likeness is None:
        return Outliers(np.full(len(size), OUTLIER_SHARE), widest, misdrawn=False)
    off = MISDRAWN_BOX_SIGMA * np.nan_to_num(size.max(axis=1, initial=0.0))
    share = within(1.0 - likeness, OUTLIER_SHARE, 1.0 - OUTLIER_SHARE)
    return Outliers(share, widest + (off * off)[:, None, None] * np.eye(2), misdrawn=True)


def _odds(score: Array) -> Array:
    """Of what a detector scores (m,), as far as it is believed."""
    p = within(score, *SCORE_BOUNDS)
    return p / (1.0 - p)


def _sound_covariances(R: Array, largest: float) -> tuple[Array, NDArray[np.bool_]]:
    """Covariances R (m, 2, 2) px² made symmetric and no smaller than `LEAST_MEASUREMENT_VARIANCE_PX2`, and which (m,)
    can be used: positive, with sigmas below `largest` px."""
    R = np.array(R, dtype=float, order="C")
    variance = variances(R)
    across = np.abs(R.reshape(-1, 4)[:, 1:3])
    most_across = MOST_MEASUREMENT_CORRELATION * np.sqrt(within(variance, 0.0, largest**2)).prod(axis=1)
    sound = ((variance > 0.0) & (variance < largest**2) & (across <= most_across[:, None])).all(axis=1)
    np.maximum(variance, LEAST_MEASUREMENT_VARIANCE_PX2, out=variance)
    R[:, 0, 1] = R[:, 1, 0]
    return R, sound


def _log_likelihood_of_sizes(tracks: Array, measured: Array, sigma: float) -> Array:
    """(n, m) of boxes (m, 2) px, known to have the sizes (n, 2) px up to a relative sigma per side, over a typical
    one.

    A side that differs by more than `BOX_SIZE_GATE_SIGMAS` sigma is that of a box around two drones: it speaks against,
    but no louder.
    """
    deviation = np.abs(np.log(measured)[None] - np.log(tracks)[:, None]) / sigma
    likelihood = 0.5 * (1.0 - np.minimum(deviation, BOX_SIZE_GATE_SIGMAS) ** 2)
    return np.asarray(np.where(np.isnan(likelihood), 0.0, likelihood).sum(axis=2))
