"""Labelled pictures of simulated worlds, as `swarmtrack sim` draws them: houses, trees and poles, and drones of other
shapes, sizes and colours than it flies, at other heights, seen by a camera that turns.

Seeds from `FIRST_SEED` on are kept for this, so that no scenario that people fly is one of these worlds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from swarmtrack.calibration.box_width import level_width
from swarmtrack.geometry import rotation
from swarmtrack.geometry.pose import Pose
from swarmtrack.lab.scenarios.scenario import CAMERA, ScenarioCamera
from swarmtrack.lab.score.swarm_truth import SwarmTruth
from swarmtrack.lab.world.airframe import Airframe
from swarmtrack.lab.world.rendering import Optics, Renderer
from swarmtrack.lab.world.world import World
from swarmtrack.messages import Array
from swarmtrack.training.labelled_images import LabelledFrame

SIMULATED = "simulated"
FIRST_SEED = 1_000_000
PER_WORLD = 12
DRONES_PER_WORLD = 3  # that are seen, but for the observer
OBSERVER = 0
SPANS_M = (0.3, 0.8)
SIZES_PX = (8.0, 140.0)
HEIGHTS_M = (1.5, 25.0)
OFF_MIDDLE_M = 15.0
# Of what an airframe's lengths are off from the usual shape, as factors.
SHAPES = (0.6, 1.6)


class Scattered:
    """A drone that is elsewhere in each second, and flies straight on within it."""

    def __init__(self, poses: list[Pose], velocity: Array, yaw_rate: float) -> None:
        """poses: of the middle of each second; velocity (3,) m/s; yaw_rate rad/s."""
        self._poses, self._velocity, self._yaw_rate = poses, velocity, yaw_rate

    def pose(self, t: float) -> Pose:
        """world_from_body."""
        second = min(max(int(t), 0), len(self._poses) - 1)
        since, middle = t - second - 0.5, self._poses[second]
        turn = rotation.from_euler(0.0, 0.0, self._yaw_rate * since)
        return Pose(turn @ middle.rotation, middle.position + self._velocity * since)

    def position(self, t: float) -> Array:
        return self.pose(t).position


def simulated_pictures(count: int, seed: int) -> Iterator[LabelledFrame]:
    """So many, by seed."""
    for number in range(math.ceil(count / PER_WORLD)):
        yield from _of_world(FIRST_SEED + 10_000 * seed + number, min(PER_WORLD, count - number * PER_WORLD))


def _of_world(seed: int, count: int) -> Iterator[LabelledFrame]:
    rng = np.random.default_rng(seed)
    mounted = ScenarioCamera(lens=replace(CAMERA, fx=(f := CAMERA.fx * rng.uniform(0.7, 1.6)), fy=f))
    airframes = {drone: _airframe(rng) for drone in range(1, DRONES_PER_WORLD + 1)}
    eyes = [_eye(rng) for _ in range(count)]
    drones = {OBSERVER: Scattered(eyes, rng.normal(0.0, 2.0, 3), rng.normal(0.0, 0.5))}
    for drone, airframe in airframes.items():
        poses = [_seen_from(eye @ mounted.body_from_camera, airframe, f, rng) for eye in eyes]
        drones[drone] = Scattered(poses, rng.normal(0.0, 1.5, 3), rng.normal(0.0, 0.5))
    world = World(seed, drones, airframes)
    optics = Optics(
        blur_px=rng.uniform(0.3, 1.2), noise=rng.uniform(0.5, 5.0), haze_m=math.exp(rng.uniform(4.6, 7.0))
    )
    renderer = Renderer(world, mounted.lens, mounted.body_from_camera, optics)
    truth = SwarmTruth(world, [mounted])
    for k in range(count):
        t = k + 0.5
        shown = [drone for drone in airframes if rng.random() < 0.7]
        boxes = {drone: box for drone, box in truth.view(OBSERVER, t).in_view.items() if drone in shown}
        camera = world.pose(OBSERVER, t) @ mounted.body_from_camera
        away = {drone: drones[drone].position(t) - camera.position for drone in boxes}
        spans = [
            level_width(away[drone], airframes[drone].span, mounted.lens, camera.rotation) for drone in boxes
        ]
        yield LabelledFrame(
            f"{seed}_{k}",
            SIMULATED,
            SIMULATED,
            renderer.image(OBSERVER, t, k, shown),
            np.array(list(boxes.values())).reshape(-1, 4),
            np.empty((0, 4)),
            spans_px=np.array(spans),
        )


def _airframe(rng: np.random.Generator) -> Airframe:
    """The usual one with other proportions."""
    usual = Airframe()
    low, high = np.log(SHAPES)

    def other() -> float:
        return math.exp(rng.uniform(low, high))

    shape = replace(
        usual,
        rotor_radius=usual.rotor_radius * math.exp(rng.uniform(low, 0.2)),
        body_length=usual.body_length * other(),
        body_width=usual.body_width * other(),
        body_top=usual.body_top * other(),
        body_bottom=usual.body_bottom * other(),
        legs_z=usual.legs_z * other(),
    )
    return shape.scaled(math.exp(rng.uniform(*np.log(SPANS_M))))


def _eye(rng: np.random.Generator) -> Pose:
    """Of the observer's body."""
    middle = rng.uniform(-OFF_MIDDLE_M, OFF_MIDDLE_M, 2)
    height = math.exp(rng.uniform(*np.log(HEIGHTS_M)))
    roll, pitch = rng.normal(0.0, 0.08, 2).tolist()
    turn = rotation.from_euler(roll, pitch, rng.uniform(0.0, 2.0 * math.pi))
    return Pose(turn, np.array([*middle, -height]))


def _seen_from(camera: Pose, airframe: Airframe, f: float, rng: np.random.Generator) -> Pose:
    """Somewhere in view of a camera with focal length f [px], above the ground."""
    distance = airframe.span * f / math.exp(rng.uniform(*np.log(SIZES_PX)))
    pixel = rng.uniform(0.0, 1.0, 2) * [CAMERA.width, CAMERA.height]
    ray = np.array([(pixel[0] - CAMERA.cx) / f, (pixel[1] - CAMERA.cy) / f, 1.0])
    place = camera.transform((distance * ray)[None])[0]
    place[2] = min(place[2], -0.5)
    roll, pitch = rng.normal(0.0, 0.15, 2).tolist()
    turn = rotation.from_euler(roll, pitch, rng.uniform(0.0, 2.0 * math.pi))
    return Pose(turn, place)
