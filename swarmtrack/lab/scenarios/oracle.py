"""What the detector of a simulated drone finds: drones, clutter, and what it takes for a drone again and again."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.world.sensors import Instant, detect
from swarmtrack.lab.world.world import frame_numbers
from swarmtrack.messages import Array, Detections

if TYPE_CHECKING:
    from swarmtrack.lab.scenarios.scenario import Ghost, Scenario

INSTANTS = 6  # kept: cameras that expose together look at the same one


class OracleDetector:
    """Knows where everybody is, and says it as a detector would: with misses, noise, clutter and ghosts."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._instant = lru_cache(maxsize=INSTANTS)(lambda t: Instant(scenario.world, t))

    def detections(self, drone_id: int, index: int, t: float, camera: int = 0) -> Detections:
        """Of the frame number `index` of a camera by its number, exposed and stamped at world time t. Which camera it
        was is not said: who listens knows whom."""
        scenario = self._scenario
        lens, mount = scenario.cameras[camera].lens, scenario.cameras[camera].body_from_camera
        frame = frame_numbers(drone_id, camera, index)
        clutter = scenario.detector.clutter_per_frame + scenario.extra_clutter(drone_id, t)
        found = detect(
            self._instant(t).visible(drone_id, lens, mount),
            lens,
            dataclasses.replace(scenario.detector, clutter_per_frame=clutter),
            scenario.world.chance("detector", *frame),
            t=t,
            sequence=index,
        )
        if not scenario.ghosts:
            return found
        eye = scenario.world.pose(drone_id, t) @ mount
        return _haunted(found, scenario.ghosts, lens, eye, scenario.world.chance("ghosts seen", *frame))


def _haunted(
    found: Detections,
    ghosts: tuple[Ghost, ...],
    camera: PinholeCamera,
    world_from_camera: Pose,
    chance: np.random.Generator,
) -> Detections:
    """The same with those of the ghosts in view on which the detector fires this time; the order tells nothing."""
    eye = world_from_camera.inverse()
    in_camera = eye.transform(np.array([ghost.position_m for ghost in ghosts]))
    pixels, _, valid = camera.project(in_camera)
    fires = chance.random(len(ghosts)) < [ghost.p_detection for ghost in ghosts]
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= -0.5) & (pixels < (camera.width - 0.5, camera.height - 0.5))).all(axis=1)
    shown = np.flatnonzero(valid & inside & fires)
    size_px = camera.fx * np.array([ghost.size_m for ghost in ghosts]) / camera.depth(in_camera)
    jitter = chance.standard_normal((len(ghosts), 4))
    centre = pixels + jitter[:, :2]
    size: Array = size_px[:, None] * np.exp(0.1 * jitter[:, 2:])
    low, high = np.array([ghost.score for ghost in ghosts]).T
    score = chance.uniform(low, high)
    order = chance.permutation(len(found) + len(shown))
    return dataclasses.replace(
        found,
        centre=np.concatenate([found.centre, centre[shown]])[order],
        size=np.concatenate([found.size, size[shown]])[order],
        score=np.concatenate([found.score, score[shown]])[order],
    )
