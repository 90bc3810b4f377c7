"""What an agent takes for a drone among houses, poles and trees, in drawn flights (docs/detector.md).

Nothing moves in these worlds but drones. So a confirmed track in the picture that is on none of them, seen or hidden,
is on something that stands still.

* standing: such tracks, by how long they were confirmed. scenery.png shows what the longest of them were on.
* recall, precision: of (observer, drone in view, tenth of a second) those with a confirmed track; of all confirmed
  tracks in the picture, those on a drone. RMSE: of each flight the worst observer's, px.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from swarmtrack.arguments import positive
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.harness import (
    PROCESSES,
    SECOND_STAGE,
    TRACKER,
    Flights,
    Row,
    flag,
    option,
    scenarios,
    seeds,
    share,
    shares,
)
from swarmtrack.benchmarks.identity import recognition
from swarmtrack.benchmarks.rendered_eyes import rendered_eyes
from swarmtrack.benchmarks.virtual_swarm import VirtualSwarm
from swarmtrack.config.drone import DetectorSection
from swarmtrack.lab.scenarios.files import load_scenario
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.swarm_score import MIN_SWARM_HIT_RADIUS_PX, SCORE_HZ, Glance, NamedTrack, SwarmScore
from swarmtrack.lab.world.rendering import Renderer
from swarmtrack.messages import Image
from swarmtrack.tracking import DEFAULT_TRACKER

SCENARIOS = ("hover-triangle", "crossing", "fast-yaw", "errand")
SEEDS, QUICK_SEEDS = 20, 2
SECONDS, QUICK_SECONDS = 14.0, 8.0
FPS = 7.0  # drawing and detecting cost 30 ms per frame
LONG_S = 2.0
SHOWN = 12  # tracks, of which there are pictures
PICTURE_PX = 96
LOOKS_PX = 4 * PICTURE_PX


@dataclasses.dataclass(slots=True)
class Standing:
    """A confirmed track on no drone: whose, in which camera, since when [s, world time], where then [px], and for how
    long [s]."""

    observer: int
    camera: int
    since: float
    u: float
    v: float
    seconds: float = 0.0


class Flight(NamedTuple):
    """What came of one. tracks: glances at confirmed tracks in the picture; observed_s: of all observers."""

    seed: int
    score: SwarmScore
    standing: tuple[Standing, ...]
    tracks: int
    observed_s: float


@dataclasses.dataclass(slots=True)
class Watch:
    """Takes glances as they come, each observer's in order."""

    scenario: Scenario
    standing: dict[tuple[int, int], Standing] = dataclasses.field(default_factory=dict)
    tracks: int = 0
    glances: int = 0

    def add_glance(self, glance: Glance) -> None:
        self.glances += 1
        for track in glance.tracks or ():
            if not self._in_picture(track):
                continue
            self.tracks += 1
            if not _on_a_drone(track, glance):
                key = (glance.observer, track.id)
                first = Standing(glance.observer, track.camera, glance.t, track.u, track.v)
                self.standing.setdefault(key, first).seconds += 1.0 / SCORE_HZ

    def _in_picture(self, track: NamedTrack) -> bool:
        low, high = self.scenario.cameras[track.camera].lens.ideal_bounds
        return bool(((low < (track.u, track.v)) & ((track.u, track.v) < high)).all())


def _on_a_drone(track: NamedTrack, glance: Glance) -> bool:
    for drone_id in (*glance.in_view, *glance.hidden):
        box = glance.box(drone_id, track.camera)
        if box is not None:
            radius = max(MIN_SWARM_HIT_RADIUS_PX, 0.5 * box[2:].max())
            if np.hypot(track.u - box[0], track.v - box[1]) < radius:
                return True
    return False


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Programme:
    """How it is flown and looked at. second_stage: as in [detector] of a config."""

    seeds: int = SEEDS
    seconds: float = SECONDS
    fps: float = FPS
    tracker: str = DEFAULT_TRACKER
    second_stage: str = "auto"
    one_world: bool = False
    """All fly in the world of seed 1, and expose at other times."""


def scenario_of_seed(p: Programme, name: str, seed: int) -> Scenario:
    scenario = load_scenario(name, seed=1 if p.one_world else seed)
    later = np.random.default_rng(seed).uniform() if p.one_world else 0.0
    cameras = tuple(
        dataclasses.replace(camera, fps=p.fps, phase=camera.phase + later) for camera in scenario.cameras
    )
    return dataclasses.replace(scenario, cameras=cameras)


def fly(p: Programme, name: str, seed: int) -> Flight:
    """One flight, as fast as it computes; the same arguments give the same flight."""
    cv2.setNumThreads(1)  # a flight on each core
    flown = scenario_of_seed(p, name, seed)
    eyes = rendered_eyes(flown, DetectorSection(second_stage=p.second_stage))
    swarm, watch = VirtualSwarm(flown, tracker=p.tracker, eyes=eyes), Watch(flown)
    score = recognition.judge(swarm, flown, p.seconds, watch.add_glance).score
    return Flight(seed, score, tuple(watch.standing.values()), watch.tracks, watch.glances / SCORE_HZ)


def summary(flights: Sequence[Flight]) -> dict[str, Any]:
    """The columns of one row of the table."""
    scores = [flight.score for flight in flights]
    times = [standing.seconds for flight in flights for standing in flight.standing]
    minutes = sum(flight.observed_s for flight in flights) / 60.0
    tracks = np.array([flight.tracks for flight in flights])
    on_nothing = np.array([sum(s.seconds for s in flight.standing) * SCORE_HZ for flight in flights])
    named = [seconds for score in scores for seconds in score.time_to_identify_s.values()]
    rmse = [max(score.rmse_px.values(), default=np.nan) for score in scores]
    return {
        "minutes": minutes,
        "standing": len(times),
        "standing_per_minute": len(times) / minutes,
        "standing_long": sum(seconds > LONG_S for seconds in times),
        "standing_longest_s": max(times, default=0.0),
        **shares(scores, "recall"),
        "precision": share(tracks - on_nothing, tracks),
        "rmse_px": {"p50": float(np.nanmedian(rmse)), "max": float(np.nanmax(rmse))},
        "identified_median_s": float(np.median(named)) if named else None,
        "identified_slowest_s": max(named, default=None),
        **shares(scores, "wrong"),
    }


def _programme(args: argparse.Namespace) -> Programme:
    seconds = QUICK_SECONDS if args.quick else SECONDS
    told = {name: getattr(args, name) for name in ("seeds", "fps", "tracker", "second_stage", "one_world")}
    return Programme(seconds=seconds, **told)


def _rows(args: argparse.Namespace) -> list[Row]:
    for name in args.scenarios:
        load_scenario(name)  # now, not after an hour of others
    one = partial(fly, _programme(args))
    return [Row(n, partial(one, n), summary, {"name": n}, ("scenarios", n)) for n in args.scenarios]


def _plot(args: argparse.Namespace, flights: dict[str, list[Flight]]) -> None:
    """What the tracks were on that stood for longest."""
    figure, axes = report.pyplot().subplots(3, SHOWN // 3, figsize=(11.0, 9.0), layout="constrained")
    flown = [(name, flight) for name, many in flights.items() for flight in many]
    standing = [(name, flight.seed, one) for name, flight in flown for one in flight.standing]
    standing.sort(key=lambda each: -each[2].seconds)
    for spot in axes.flat:
        spot.axis("off")
    for spot, (name, seed, one) in zip(axes.flat, standing, strict=False):
        spot.imshow(cv2.cvtColor(picture_of(_programme(args), name, seed, one), cv2.COLOR_BGR2RGB))
        spot.set_title(f"{name}, seed {seed}, drone {one.observer}\n{one.seconds:.1f} s", fontsize=9)
    if not standing:
        figure.suptitle("no confirmed track but on drones")
    report.save(figure, args.out / "scenery.png", dpi=110)


def picture_of(p: Programme, name: str, seed: int, standing: Standing) -> Image:
    """(LOOKS_PX, LOOKS_PX, 3) BGR: where a track was when it was confirmed, in the middle."""
    scenario = scenario_of_seed(p, name, seed)
    camera = scenario.cameras[standing.camera]
    renderer = Renderer(scenario.world, camera.lens, camera.body_from_camera, number=standing.camera)
    image = renderer.image(standing.observer, standing.since, round(standing.since * p.fps))
    part = np.asarray(cv2.getRectSubPix(image, (PICTURE_PX, PICTURE_PX), (standing.u, standing.v)), np.uint8)
    return np.asarray(cv2.resize(part, (LOOKS_PX, LOOKS_PX), interpolation=cv2.INTER_NEAREST), np.uint8)


def _about(result: dict[str, Any]) -> str:
    return (
        f"{result['seeds']} flights of {result['seconds']:g} s{' in one world' if result['one_world'] else ''},"
        f" {result['fps']:g} frames/s, tracker `{result['tracker']}`, second stage `{result['second_stage']}`;"
        " shares with 95 % intervals over flights."
    )


BENCH = Flights(
    draws=True,
    name="scenery",
    title="Confirmed tracks among houses, poles and trees",
    about=_about,
    seeds=seeds(SEEDS, QUICK_SEEDS),
    options=(
        TRACKER,
        scenarios(SCENARIOS),
        option("--fps", "of the cameras (default: %(default)g)", type=positive, default=FPS, metavar="F"),
        SECOND_STAGE,
        flag("--one-world", "the world of seed 1 in all flights, seen at other times"),
        PROCESSES,
    ),
    rows=_rows,
    facts=lambda args: dataclasses.asdict(_programme(args)),
    finish=_plot,
    columns=(
        ("", "{name}"),
        ("minutes", "{minutes:.1f}"),
        ("standing, per minute", "{standing}, {standing_per_minute:.2f}"),
        (f"longer than {LONG_S:g} s", "{standing_long}"),
        ("longest, s", "{standing_longest_s:.1f}"),
        ("recall, %", "{recall:.2p}"),
        ("precision, %", "{precision:.2p}"),
        ("RMSE, px: median, worst", "{rmse_px[p50]:.2f}, {rmse_px[max]:.2f}"),
        ("identified after, s: median, slowest", "{identified_median_s:.1f}, {identified_slowest_s:.1f}"),
        ("wrong names, %", "{wrong:.2p}"),
    ),
)
