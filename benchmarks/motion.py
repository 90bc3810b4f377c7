"""Who is who by how they move alone: nobody says where it started, and any track may be a stranger (docs/swarm.md).

The observer hovers. Its attitude is off by 12 mrad, for some 15 s in the same way; clocks are off by 30 ms, and boxes
tell distances to 30 %. The posterior is the agent's (`team/identities.py`), without its tracker: a track is a drone.
Names are those that an agent would publish.

A lie is found out where the liar's track is called a stranger, or by its right name. It is said already where the track
has any other name than the one that the drone claims; a drone that did not lie and whose track has another name is
accused.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.benchmarks import harness
from swarmtrack.benchmarks.harness import Flights, quantile, seeds, several
from swarmtrack.geometry import rotation
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.pose import Pose
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.identity.parameters import IdentityParameters
from swarmtrack.identity.reprojection import ObserverCamera
from swarmtrack.messages import Announcement, Array, MotionReport, Track, TrackStatus
from swarmtrack.motion.ego import TeamPose
from swarmtrack.runtime.filed import SOMEWHERE_M
from swarmtrack.team.identities import Identities

TEAMS = (3, 5, 10)
SECONDS, SCAN_S, SAY_S = 20.0, 1 / 7, 0.2
STEP_S = SCAN_S / 4
CAMERA = PinholeCamera(600.0, 600.0, 319.5, 255.5, 640, 512)
MOUNT = Pose(BODY_FROM_FORWARD_CAMERA, np.zeros(3))
CENTRE_SIGMA_PX, P_DETECTION, SPAN_M, SPAN_SIGMA = 1.5, 0.9, 0.45, 0.3
ATTITUDE_SIGMA, ATTITUDE_S = 0.012, 15.0
SAID_M, SAID_M_S = 0.02, 0.05
CLOCK_S = 0.03
STRANGER = -1


class Row(NamedTuple):
    """How a team moves. sway [m]: RMS per axis of a hover, None: it flies at 1 m/s; lie: drone 0 tells another motion
    ("spoof"), or 0 and 1 each other's ("swap"); clock [s]: by how much clocks are off, either way; say_s: between two
    words of a drone."""

    name: str
    sway: float | None
    lie: str = ""
    clock: float = CLOCK_S
    say_s: float = SAY_S


ROWS = (
    Row("free flight", None),
    Row("hover, sways 15 cm", 0.15),
    Row("hover, told 10 times a second", 0.15, say_s=0.1),
    Row("hover, sways 5 cm", 0.05),
    Row("hover, clocks 0.2 s off", 0.15, clock=0.2),
    Row("free flight, one is spoofed", None, "spoof"),
    Row("hover, one is spoofed", 0.15, "spoof"),
    Row("hover, two IDs swapped", 0.15, "swap"),
)


class Trial(NamedTuple):
    """named [s]: when the last track had a name, inf: never; found [s]: when the lie was, and said: when an agent would
    have told of it; names: by track, what it was called first; accused: drones that did not lie; scan_s: CPU time per
    scan [s]."""

    named: float
    found: float
    said: float
    names: dict[int, int]
    accused: set[int]
    scan_s: float


class _Told(NamedTuple):
    """(drones, steps, 3): displacement [m] and velocity [m/s]."""

    place: Array
    speed: Array


def wander(rng: np.random.Generator, drones: int, sigma: float, bandwidth: float) -> _Told:
    """Hovers: critically damped wander of `sigma` m at `bandwidth` rad/s, per axis."""
    steps, w, dt = round(SECONDS / STEP_S), bandwidth, STEP_S
    F = math.exp(-w * dt) * np.array([[1.0 + w * dt, dt], [-w * w * dt, 1.0 - w * dt]])
    steady = np.diag([sigma**2, (sigma * w) ** 2])
    L = np.linalg.cholesky(steady - F @ steady @ F.T)
    x = np.sqrt(np.diag(steady)) * rng.standard_normal((drones, 3, 2))
    found = np.empty((steps, drones, 3, 2))
    for k in range(steps):
        found[k] = x
        x = x @ F.T + rng.standard_normal(x.shape) @ L.T
    found = found.transpose(3, 1, 0, 2)
    return _Told(found[0] - found[0][:, :1], found[1])


def flight(rng: np.random.Generator, drones: int) -> _Told:
    """Flies at 1 m/s RMS, on a course of 3 s."""
    steps, kept = round(SECONDS / STEP_S), math.exp(-STEP_S / 3.0)
    v = rng.standard_normal((drones, 3)) / math.sqrt(3.0)
    speed = np.empty((steps, drones, 3))
    for k in range(steps):
        speed[k] = v
        v = kept * v + math.sqrt((1.0 - kept**2) / 3.0) * rng.standard_normal(v.shape)
    speed = speed.transpose(1, 0, 2)
    place = np.cumsum(speed, axis=1) * STEP_S
    return _Told(place - place[:, :1], speed)


class _Scene:
    """One seed of a row: the truth, and what is seen and said of it."""

    def __init__(self, row: Row, n: int, seed: int) -> None:
        self.rng = rng = np.random.default_rng([seed, n])
        self.n = n
        self.truth = flight(rng, n) if row.sway is None else wander(rng, n, row.sway, 1.5)
        self.told = self._told(row)
        self._own = wander(rng, 1, 0.15, 1.5).place[0]
        bearing, height = rng.uniform(-0.45, 0.45, n), rng.uniform(-0.2, 0.2, n)
        north, east = np.cos(height) * np.cos(bearing), np.cos(height) * np.sin(bearing)
        ray = np.stack([north, east, np.sin(height)], axis=1)
        self._start = rng.uniform(5.0, 20.0, n)[:, None] * ray
        self._size = SPAN_M * np.exp(SPAN_SIGMA * rng.standard_normal(n)) * CAMERA.fx
        self._attitude = ATTITUDE_SIGMA * rng.standard_normal(2)
        sign = rng.choice((-1.0, 1.0), n)
        self._late = row.clock * (rng.standard_normal(n) if row.clock == CLOCK_S else sign)
        self._say_s = row.say_s
        self._phase = rng.uniform(0.0, row.say_s, n)

    def _told(self, row: Row) -> _Told:
        place, speed = self.truth.place.copy(), self.truth.speed.copy()
        if row.lie == "swap":
            place[[0, 1]], speed[[0, 1]] = place[[1, 0]], speed[[1, 0]]
        if row.lie == "spoof":
            other = flight(self.rng, 1) if row.sway is None else wander(self.rng, 1, row.sway, 1.5)
            place[0], speed[0] = other.place[0], other.speed[0]
        return _Told(place, speed)

    def deliver_reports(self, found: _Observer, t: float) -> None:
        """All that the drones said in the last scan's time."""
        for drone in range(self.n):
            first = math.ceil((t - SCAN_S - self._phase[drone]) / self._say_s)
            due = np.arange(first, 1 + (t - self._phase[drone]) // self._say_s)
            for k in due[due >= 0]:
                said = self._phase[drone] + k * self._say_s
                step = min(round(said / STEP_S), self.told.place.shape[1] - 1)
                place = self.told.place[drone, step] + SAID_M * self.rng.standard_normal(3)
                speed = self.told.speed[drone, step] + SAID_M_S * self.rng.standard_normal(3)
                found.hear(drone, step * STEP_S + self._late[drone], place, speed)

    def scan(self, k: int) -> tuple[list[Track], ObserverCamera]:
        """Of scan k: the tracks, by drone, and the camera as the observer believes that it is."""
        rng, t = self.rng, k * SCAN_S
        kept = math.exp(-SCAN_S / ATTITUDE_S)
        new = ATTITUDE_SIGMA * math.sqrt(1.0 - kept**2) * rng.standard_normal(2)
        self._attitude = kept * self._attitude + new
        turned = rotation.exp(np.array([0.0, *self._attitude]))
        sure = 1e-4 * np.eye(3)
        view = ObserverCamera.of(TeamPose(t, self._own[4 * k], np.eye(3), sure, sure), CAMERA, MOUNT)
        away = (self._start + self.truth.place[:, 4 * k] - self._own[4 * k]) @ turned.T
        pixel, _, _ = CAMERA.project_undistorted(away @ BODY_FROM_FORWARD_CAMERA)
        pixel = pixel + CENTRE_SIGMA_PX * rng.standard_normal(pixel.shape)
        side = self._size / np.linalg.norm(away, axis=1)
        cov = CENTRE_SIGMA_PX**2 * np.eye(4)
        seen = np.flatnonzero(rng.random(self.n) < P_DETECTION).tolist()
        mean = np.column_stack([pixel[:, 0], np.zeros(self.n), pixel[:, 1], np.zeros(self.n)])
        stage = TrackStatus.CONFIRMED
        return [Track(m, t, mean[m], cov, stage, 1.0, np.full(2, side[m])) for m in seen], view


class _Observer:
    """The posterior of a team without known starts: the names that an agent would publish."""

    def __init__(self, n: int) -> None:
        self._tracks: dict[int, Track] = {}
        self._identities = Identities(n + 1, cameras=[(CAMERA, MOUNT)], parameters=IdentityParameters())
        for drone in range(n):
            cov = SOMEWHERE_M**2 * np.eye(3)
            start = Announcement(drone + 1, "boot", 1, 0.0, 0.0, np.zeros(3), np.eye(3), cov)
            self._identities.announce(start)

    def hear(self, drone: int, t: float, displacement: Array, velocity: Array) -> None:
        cov, cov_velocity = SAID_M**2 * np.eye(3), SAID_M_S**2 * np.eye(3)
        report = MotionReport(drone + 1, "boot", 1, t, CLOCK_S, displacement, cov, velocity, cov_velocity)
        self._identities.on_motion(report)

    def observe(self, tracks: list[Track], view: ObserverCamera) -> None:
        t = view.observer.t
        shown = {track.id: track for track in tracks if np.isfinite(track.mean).all()}
        missed = {
            id: track._replace(t=t, coasting_since=track.coasting_since or t)
            for id, track in self._tracks.items()
            if id not in shown
        }
        self._tracks |= shown | missed
        self._identities.observe([*shown.values(), *missed.values()], view.observer)

    def called(self) -> dict[int, int]:
        """By track, the name that an agent would publish."""
        return {
            one.track.id: one.identity - 1 if isinstance(one.identity, int) else STRANGER
            for one in self._identities.label(self._tracks.values())
            if one.identity is not None
        }

    def speaks_against(self, drone: int) -> bool:
        """Whether the drone's track has another name."""
        return self.called().get(drone, drone) != drone


def trial(row: Row, n: int, seed: int) -> Trial:
    """One flight of n drones; the same arguments give the same."""
    scene = _Scene(row, n, seed)
    found = _Observer(n)
    names: dict[int, int] = {}
    named, exposed, said, spent, scans = math.inf, math.inf, math.inf, 0.0, 0
    accused: set[int] = set()
    honest = range({"spoof": 1, "swap": 2}.get(row.lie, 0), n)
    liar = {"spoof": STRANGER, "swap": 1}.get(row.lie)
    for k in range(round(SECONDS / SCAN_S)):
        scene.deliver_reports(found, k * SCAN_S)
        tracks, view = scene.scan(k)
        began = time.process_time()
        found.observe(tracks, view)
        spent, scans = spent + time.process_time() - began, scans + 1
        called = found.called()
        for track, name in called.items():
            names.setdefault(track, name)
        if called.get(0) == liar:
            exposed = min(exposed, k * SCAN_S)
        if found.speaks_against(0):
            said = min(said, k * SCAN_S)
        accused |= {drone for drone in honest if found.speaks_against(drone)}
        if len(names) == n:
            named = min(named, k * SCAN_S)
            if liar is None or max(exposed, said) < math.inf:
                break
    return Trial(named, exposed, said, names, accused, spent / scans)


def summarise(row: Row, n: int, trials: Sequence[Trial]) -> dict[str, Any]:
    """Of one row and team; times in s, None: not in every flight."""
    truth = {track: track for track in range(n)}
    if row.lie:
        truth |= {0: STRANGER} if row.lie == "spoof" else {0: 1, 1: 0}
    wrong = [name for t in trials for track, name in t.names.items() if name != truth[track]]

    def times(what: str, *, told: bool = True) -> dict[str, float | None]:
        values = [getattr(t, what) for t in trials]
        at = {f"{what}_s": quantile(values, 0.5), f"{what}_p95_s": quantile(values, 0.95)}
        return {name: round(s, 2) if told and s < math.inf else None for name, s in at.items()}

    return {
        **times("named"),
        **times("found", told=bool(row.lie)),
        **times("said", told=bool(row.lie)),
        "names": sum(len(t.names) for t in trials),
        "wrong": len(wrong),
        "wrong_as_stranger": wrong.count(STRANGER),
        "accused": sum(len(t.accused) for t in trials),
        "scan_ms": round(1e3 * float(np.mean([t.scan_s for t in trials])), 2),
    }


def _rows(args: argparse.Namespace) -> list[harness.Row]:
    def made(row: Row, n: int) -> harness.Row:
        facts = {"row": row.name, "drones": n, "flights": args.seeds}
        return harness.Row(row.name, partial(trial, row, n), partial(summarise, row, n), facts)

    return [made(row, n) for row in ROWS for n in args.teams if not row.lie or n > 1]


BENCH = Flights(
    name="motion",
    title="Who is who by motion alone",
    about="",
    seeds=seeds(60, quick=2),
    seeds_from=0,
    options=(several("--teams", "drones in view (default: %(default)s)", TEAMS),),
    rows=_rows,
    facts=lambda args: {"seconds": SECONDS},
    columns=(
        ("what they do", "{row}"),
        ("drones", "{drones}"),
        ("flights", "{flights}"),
        ("all named, s: median", "{named_s:.1f}"),
        ("p95", "{named_p95_s:.1f}"),
        ("lie said, s: median", "{said_s:.1f}"),
        ("p95", "{said_p95_s:.1f}"),
        ("lie found, s: median", "{found_s:.1f}"),
        ("p95", "{found_p95_s:.1f}"),
        ("wrong names", "{wrong} of {names}"),
        ("of these as strangers", "{wrong_as_stranger}"),
        ("accused", "{accused}"),
        ("CPU per scan, ms", "{scan_ms:.2f}"),
    ),
)
