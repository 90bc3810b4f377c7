"""Trackers of another library behind the same few methods: Stone Soup's GNN, JPDA and GM-PHD (the extra `peers`).

They are told what ours are told, and where the targets start; they neither begin nor end tracks. Where pyehm is
installed JPDA enumerates by its EHM2, else by Stone Soup's own, which is out of reach beyond six targets in a crowd.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
from stonesoup.dataassociator.probability import JPDA
from stonesoup.functions import gm_reduce_single
from stonesoup.hypothesiser.distance import DistanceHypothesiser
from stonesoup.hypothesiser.gaussianmixture import GaussianMixtureHypothesiser
from stonesoup.hypothesiser.probability import PDAHypothesiser
from stonesoup.measures import Mahalanobis
from stonesoup.mixturereducer.gaussianmixture import GaussianMixtureReducer
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.state import GaussianState, TaggedWeightedGaussianState
from stonesoup.types.track import Track as StoneTrack
from stonesoup.updater.kalman import KalmanUpdater
from stonesoup.updater.pointprocess import PHDUpdater

from swarmtrack.benchmarks.trackers.play import MakePlayer
from swarmtrack.benchmarks.trackers.scenes import Scene
from swarmtrack.messages import Array, Scan, Track, TrackStatus

EPOCH = datetime(2000, 1, 1)  # Stone Soup counts in calendar time
GATE_SIGMAS = 3.717  # √χ²(0.999) with two degrees of freedom
PHD_MERGE, PHD_PRUNE = 4.0, 1e-5
UNKNOWN_SIZE = np.full(2, np.nan)
try:
    from pyehm.plugins.stonesoup import JPDAWithEHM2
except ImportError:
    JPDAWithEHM2 = None


class _Peer:
    """What the three share: models, time, and how their states become tracks."""

    def __init__(self, scene: Scene, parameters: Mapping[str, Any]) -> None:
        told = scene.parameters() | dict(parameters)
        self._told = told
        self._R = told["measurement_sigma"] ** 2 * np.eye(2)
        self._clutter_density = told["clutter_per_scan"] / (scene.camera.width * scene.camera.height)
        velocity = ConstantVelocity(told["acceleration_psd"])
        self._predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([velocity, velocity]))
        self._measurement = LinearGaussian(ndim_state=4, mapping=(0, 2), noise_covar=self._R)
        self._updater = KalmanUpdater(self._measurement)
        self._t = 0.0

    def predict(self, t: float, rotation: Array | None = None, rotation_variance: float = 0.0) -> None:
        """They predict with the scan, for an observer at rest."""

    def _detections(self, scan: Scan) -> set[Any]:
        now = _instant(scan.t)
        return {Detection(z[:, None], timestamp=now, measurement_model=self._measurement) for z in scan.z}

    def _start(self, point: Array) -> tuple[Array, Array]:
        mean = np.array([point[0], 0.0, point[1], 0.0])
        fast = self._told["birth_speed_sigma"] ** 2
        return mean[:, None], np.diag([self._R[0, 0], fast, self._R[1, 1], fast])

    def _track(self, number: int, state: Any) -> Track:
        mean, cov = np.asarray(state.mean, float).ravel(), np.asarray(state.covar, float)
        return Track(number, self._t, mean, cov, TrackStatus.CONFIRMED, 1.0, UNKNOWN_SIZE)

    def at(self, t: float) -> tuple[Track, ...]:
        raise NotImplementedError("peers are shown no scene that asks for it")


class _Associating(_Peer):
    """One Stone Soup track for each target."""

    _associator: Any

    def initiate(self, t: float, points: Array) -> list[int]:
        self._t = t
        self._tracks = [
            StoneTrack([GaussianState(*self._start(point), timestamp=_instant(t))]) for point in points
        ]
        return list(range(len(points)))

    @property
    def tracks(self) -> tuple[Track, ...]:
        return tuple(self._track(number, track.state) for number, track in enumerate(self._tracks))

    def update(self, scan: Scan) -> bool:
        now = _instant(scan.t)
        hypotheses = self._associator.associate(set(self._tracks), self._detections(scan), now)
        for track in self._tracks:
            # A track of thousands of states slows everything down; only the last one is needed.
            track.states = [self._posterior(hypotheses[track])]
        self._t = scan.t
        return True

    def _posterior(self, hypothesis: Any) -> Any:
        raise NotImplementedError


class GlobalNearest(_Associating):
    def __init__(self, scene: Scene, parameters: Mapping[str, Any]) -> None:
        super().__init__(scene, parameters)
        self._associator = GNNWith2DAssignment(
            DistanceHypothesiser(self._predictor, self._updater, Mahalanobis(), missed_distance=GATE_SIGMAS)
        )

    def _posterior(self, hypothesis: Any) -> Any:
        return self._updater.update(hypothesis) if hypothesis.measurement else hypothesis.prediction


class JointProbabilistic(_Associating):
    def __init__(self, scene: Scene, parameters: Mapping[str, Any]) -> None:
        super().__init__(scene, parameters)
        self._associator = (JPDAWithEHM2 or JPDA)(
            PDAHypothesiser(
                self._predictor,
                self._updater,
                clutter_spatial_density=self._clutter_density,
                prob_detect=self._told["p_detection"],
                prob_gate=0.999,
            )
        )

    def _posterior(self, hypothesis: Any) -> Any:
        """The moments of the mixture over its single hypotheses."""

        states = [self._updater.update(single) if single else single.prediction for single in hypothesis]
        weights = np.array([float(single.probability) for single in hypothesis])
        mean, covar = gm_reduce_single(
            StateVectors([state.state_vector for state in states]),
            np.stack([state.covar for state in states], axis=2),
            weights,
        )
        return GaussianState(mean, covar, timestamp=states[0].timestamp)


class HypothesisDensity(_Peer):
    """GM-PHD with tags and without births; the heaviest component of a target's stands for it.

    Where several components share a tag after a scan, the library gives all but the heaviest new ones, and a target
    that clutter has led astray for one scan would be gone for good. So those new tags are remembered as the target's.
    """

    def __init__(self, scene: Scene, parameters: Mapping[str, Any]) -> None:
        super().__init__(scene, parameters)
        single = DistanceHypothesiser(
            self._predictor, self._updater, Mahalanobis(), missed_distance=GATE_SIGMAS
        )
        self._hypothesiser = GaussianMixtureHypothesiser(single, order_by_detection=True)
        self._density = PHDUpdater(
            self._updater,
            clutter_spatial_density=self._clutter_density,
            prob_detection=self._told["p_detection"],
            prob_survival=1.0,
        )
        self._reducer = GaussianMixtureReducer(
            prune_threshold=PHD_PRUNE, merge_threshold=PHD_MERGE, max_number_components=200
        )
        self._components: list[Any] = []
        self._target_of: dict[str, int] = {}

    def initiate(self, t: float, points: Array) -> list[int]:
        self._t = t
        self._components = [
            TaggedWeightedGaussianState(
                *self._start(point), weight=1.0, tag=str(number), timestamp=_instant(t)
            )
            for number, point in enumerate(points)
        ]
        self._target_of = {str(number): number for number in range(len(points))}
        return list(range(len(points)))

    @property
    def tracks(self) -> tuple[Track, ...]:
        heaviest: dict[int, Any] = {}
        for component in sorted(self._components, key=lambda component: float(component.weight)):
            heaviest[self._target_of[component.tag]] = component
        return tuple(self._track(number, component) for number, component in sorted(heaviest.items()))

    def update(self, scan: Scan) -> bool:
        hypotheses = self._hypothesiser.hypothesise(
            self._components, self._detections(scan), _instant(scan.t)
        )
        updated = list(self._density.update(hypotheses))
        before = [(np.asarray(one.mean, float).ravel(), self._target_of[one.tag]) for one in updated]
        self._components = list(self._reducer.reduce(updated))
        targets = {}
        for component in self._components:
            known = self._target_of.get(component.tag)
            targets[component.tag] = _nearest(component, before) if known is None else known
        self._target_of = targets
        self._t = scan.t
        return True


def _nearest(component: Any, before: list[tuple[Array, int]]) -> int:
    """The target of the component, before merging, that this one is made of."""
    mean = np.asarray(component.mean, float).ravel()
    return min(before, key=lambda one: float(np.abs(one[0] - mean).sum()))[1]


def _instant(t: float) -> datetime:
    return EPOCH + timedelta(seconds=t)


PEERS: Mapping[str, MakePlayer] = {
    "ss_gnn": GlobalNearest,
    "ss_jpda" if JPDAWithEHM2 is None else "ss_jpda_ehm2": JointProbabilistic,
    "ss_gmphd": HypothesisDensity,
}
