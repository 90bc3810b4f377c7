"""The camera's rotation by its images (`detection/visual_gyro.py`): its error, its claim and its cost in drawn flights,
and what it is worth to the tracks of a team that turns and has no gyro.

* error: root mean square over the image of how far the estimated rotation puts directions from where the true one does;
* claim: squared error of the angle over its stated variance, per axis; 1 is honest, more is overconfident;
* RMSE: of each flight the worst observer's tracks.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import PROCESSES, Benchmark, flown, seeds, shares
from swarmtrack.benchmarks.identity import recognition
from swarmtrack.benchmarks.virtual_swarm import VirtualSwarm
from swarmtrack.detection.visual_gyro import VisualGyro
from swarmtrack.geometry import rotation
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import HOVER_S, Scenario
from swarmtrack.lab.score.swarm_score import SwarmScore
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.messages import Array, Frame, StampKind
from swarmtrack.motion.priors import UNKNOWN_ANGLE_VARIANCE_RAD2

NAME = "visual-gyro"
SCENARIOS = ("hover-triangle", "crossing", "fast-yaw", "yawing-observer", "errand")
SECONDS, TEAM_SECONDS = 6.0, 14.0
SOURCES = ("gyro", "images", "nothing")
MOST_ERROR_PX, MOST_RATIO, MOST_MS = 0.3, 2.0, 4.0


class Turns(NamedTuple):
    """Of n pairs of frames: error (n,) px, NaN where nothing was known; claim (n,); ms (n,) of processor time."""

    error: Array
    claim: Array
    ms: Array


def measure(name: str, seed: int) -> Turns:
    """One drone of a flight, every frame, from when all move."""
    cv2.setNumThreads(1)
    scenario = load_scenario(name, seed=seed)
    camera, drone_id = scenario.cameras[0], min(scenario.members)
    renderer = Renderer(scenario.world, camera.lens, camera.body_from_camera)
    lens, gyro = camera.lens, VisualGyro(camera.lens)
    columns, rows = np.meshgrid(np.linspace(0, lens.width - 1, 8), np.linspace(0, lens.height - 1, 6))
    rays = lens.bearing(np.column_stack([columns.ravel(), rows.ravel()]))
    found, before = [], np.eye(3)
    first = round(HOVER_S * camera.fps)
    for k in range(first, first + round(SECONDS * camera.fps)):
        t = camera.exposure(k)
        image = renderer.image(drone_id, t, k)
        began = time.thread_time()
        seen = gyro.turn_to(Frame(t, 0.0, k, image, StampKind.EXPOSURE))
        ms = 1e3 * (time.thread_time() - began)
        now = scenario.world.pose(drone_id, t).rotation @ camera.body_from_camera.rotation
        if seen is not None:
            found.append((*_judge(rays, now.T @ before, seen.turn, seen.variance, scenario), ms))
        before = now
    return Turns(*np.array(found).T)


def _judge(
    rays: Array, truth: Array, turn: Array, variance: float, scenario: Scenario
) -> tuple[float, float]:
    """Error, px, and claim."""
    if variance >= UNKNOWN_ANGLE_VARIANCE_RAD2:
        return np.nan, np.nan
    estimated = rotation.exp(-turn)
    apart = [scenario.cameras[0].lens.project(rays @ R.T)[0] for R in (truth, estimated)]
    squared = ((apart[0] - apart[1]) ** 2).sum(axis=1)
    off = rotation.log(estimated @ truth.T)
    return float(np.sqrt(np.nanmean(squared))), float(off @ off) / 3.0 / variance


class _Blindfolded(VirtualSwarm):
    """A team whose gyros are silent. sees: whether it measures its turns in drawn images."""

    def __init__(self, scenario: Scenario, *, sees: bool) -> None:
        super().__init__(scenario)
        camera, members = scenario.cameras[0], scenario.members if sees else ()
        self._renderer = Renderer(scenario.world, camera.lens, camera.body_from_camera)
        self._gyros = {drone_id: VisualGyro(camera.lens) for drone_id in members}

    def _hear_autopilot(self, drone_id: int, what: str, index: int) -> None:
        if what != "imu":
            super()._hear_autopilot(drone_id, what, index)

    def _scan(self, drone_id: int, camera: int, index: int) -> None:
        if drone_id in self._gyros:
            t = self.scenario.cameras[camera].exposure(index)
            frame = Frame(t, 0.0, index, self._renderer.image(drone_id, t, index), StampKind.EXPOSURE)
            turn = self._gyros[drone_id].turn_to(frame)
            if turn is not None:
                self.onboard(drone_id).tell(turn)
        super()._scan(drone_id, camera, index)


def fly(source: str, seed: int) -> SwarmScore:
    """A team in `fast-yaw` that knows by `source` how its cameras turn."""
    cv2.setNumThreads(1)
    scenario = load_scenario("fast-yaw", seed=seed)
    swarm = VirtualSwarm(scenario) if source == "gyro" else _Blindfolded(scenario, sees=source == "images")
    return recognition.judge(swarm, scenario, TEAM_SECONDS).score


def _summary(turns: Sequence[Turns]) -> dict[str, float]:
    error, claim, ms = (np.concatenate([getattr(one, name) for one in turns]) for name in Turns._fields)
    return {
        "frames": len(error),
        "unknown": float(np.isnan(error).mean()),
        "median_px": float(np.nanmedian(error)),
        "p90_px": float(np.nanquantile(error, 0.9)),
        "claim": float(np.nanmean(claim)),
        "ms": float(np.median(ms)),
    }


def _team(scores: Sequence[SwarmScore]) -> dict[str, Any]:
    rmse = [max(score.rmse_px.values(), default=np.nan) for score in scores]
    return {"rmse_px": float(np.median(rmse)), **shares(scores, "recall", "correct", "wrong")}


def _measured(args: argparse.Namespace) -> dict[str, Any]:
    chosen = range(1, args.seeds + 1)
    parts = [(name, partial(measure, name)) for name in SCENARIOS]
    turns = dict(zip(SCENARIOS, flown(NAME, parts, chosen, processes=args.processes), strict=True))
    rows = {name: _summary(found) for name, found in turns.items()}
    rows["all"] = _summary([one for found in turns.values() for one in found])
    teams = flown(
        NAME, [(source, partial(fly, source)) for source in SOURCES], chosen, processes=args.processes
    )
    by_source = {source: _team(scores) for source, scores in zip(SOURCES, teams, strict=True)}
    ratio = by_source["images"]["rmse_px"] / by_source["gyro"]["rmse_px"]
    return {"seeds": args.seeds, "turns": rows, "teams": by_source, "ratio": ratio}


def _page(result: dict[str, Any]) -> str:
    every = result["turns"]["all"]
    goals = (
        ("median error, px", every["median_px"], MOST_ERROR_PX),
        ("processor time per frame, ms", every["ms"], MOST_MS),
        ("RMSE by images over that by the gyro", result["ratio"], MOST_RATIO),
    )
    return report.page(
        "# The camera's rotation by its images",
        f"Drawn flights, 640 × 480, {result['seeds']} seeds, one thread.",
        report.table_by_name(
            (
                ("scenario", "{name}"),
                ("pairs of frames", "{frames}"),
                ("unknown, %", "{unknown:.1p}"),
                ("error, median, px", "{median_px:.2f}"),
                ("90 %, px", "{p90_px:.2f}"),
                ("squared error over variance", "{claim:.2f}"),
                ("ms", "{ms:.1f}"),
            ),
            result["turns"],
        ),
        f"Scenario `fast-yaw`, synthetic detections, {TEAM_SECONDS:g} s:",
        report.table_by_name(
            (
                ("rotation from", "{name}"),
                ("RMSE, median, px", "{rmse_px:.2f}"),
                ("recall, %", "{recall:.2p}"),
                ("correct names, %", "{correct:.2p}"),
                ("wrong, %", "{wrong:.2p}"),
            ),
            result["teams"],
        ),
        report.table(
            ["goal", "found", "at most", ""],
            [
                [what, f"{found:.2f}", f"{most:g}", report.verdict(found <= most)]
                for what, found, most in goals
            ],
        ),
    )


BENCH = Benchmark(NAME, _measured, _page, options=(seeds(5, quick=1), PROCESSES))
