"""What places in metres cost a drone: reading them, folding a scan in, and publishing them at 100 Hz.

* Reading: `RelativeStates.at`, of 1, 5 and 10 teammates, between two scans.
* Scan: `RelativeStates.observe` of as many.
* Publishing: a whole `Onboard` that tracks five drones, asked for its tracks a hundred times a second while poses come
  at 50 Hz, and its message encoded; once of teammates with names and places, once of five that nobody announced. The
  difference is what metres (and names) cost.

Processor time: medians, and means of messages (`swarmtrack bench cost --of metres`).
"""

from __future__ import annotations

import argparse
import time
from itertools import count

import numpy as np

from swarmtrack.benchmarks.figures import UNCOUNTED, Figure, median_s
from swarmtrack.benchmarks.virtual_swarm import lone_onboard
from swarmtrack.geometry.camera import PinholeCamera
from swarmtrack.geometry.rotation import BODY_FROM_FORWARD_CAMERA
from swarmtrack.messages import Announcement, Array, Detections, EgoPose, FlightState, ImuSample, TrackList
from swarmtrack.motion.ego import EgoHistory
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.parameters import RelativeParameters
from swarmtrack.relative.reading import OwnMotion
from swarmtrack.relative.states import RelativeStates
from swarmtrack.tracking import AGENT_PARAMETERS, DEFAULT_TRACKER, create_tracker
from swarmtrack.wire import codec
from swarmtrack.wire.tracks import tracks_message

REPEATS, QUICK_REPEATS = 3000, 200
TEAMMATES = (1, 5, 10)
SPAN_M = 0.5
POSE_HZ, FPS, PUBLISH_HZ = 50.0, 15.0, 100.0
WARM_UP_S = 4.0
IN_VIEW = 5
READ_BUDGET_US, SCAN_BUDGET_MS, PUBLISH_BUDGET_MS = 60.0, 1.0, 0.1
CAMERA = PinholeCamera(430.0, 430.0, 319.5, 239.5, 640, 480)
STILL = OwnMotion(np.zeros(3), np.zeros(3), 0.01 * np.eye(3), 1e-4 * np.eye(3))


def places(n: int) -> Array:
    """(n, 3) m: teammates side by side, north of the drone."""
    return np.column_stack([np.full(n, 8.0), np.linspace(-4.0, 4.0, n) if n > 1 else [0.0], np.zeros(n)])


def watching(n: int) -> tuple[RelativeStates, float]:
    """Relative states of n teammates that were seen for two seconds, and the time of the last scan."""
    states = RelativeStates(RelativeParameters(airframe_span_m=SPAN_M))
    times = [k / 7.0 for k in range(14)]
    for t in times:
        states.observe(look(n, t))
    return states, times[-1]


def look(n: int, t: float) -> TeamLook:
    """What is seen of n teammates at t."""
    away = places(n)
    rho = np.linalg.norm(away, axis=1)
    rays, cov = away / rho[:, None], np.tile(1e-5 * np.eye(3), (n, 1, 1))
    teammates = tuple((i + 2, i) for i in range(n))
    return TeamLook(t, np.zeros(3), np.zeros(3), teammates, rays, cov, 1.14 * SPAN_M / rho, np.ones(n))


def reading(n: int, repeats: int) -> Figure:
    """Of all n states at once, at ever another time."""
    states, t = watching(n)
    ahead = count()
    spent = median_s(lambda: states.at(t + 1e-3 * (next(ahead) % 100), STILL), repeats, time.process_time)
    assert len(states.at(t, STILL)) == n
    return Figure(f"read {n}", 1e6 * spent, "µs", READ_BUDGET_US if n == max(TEAMMATES) else None)


def scanning(n: int, repeats: int) -> Figure:
    """One scan of n teammates folded in."""
    states, t = watching(n)
    looks = iter([look(n, t + (k + 1) / 7.0) for k in range(repeats + UNCOUNTED)])
    spent = median_s(lambda: states.observe(next(looks)), repeats, time.process_time)
    return Figure(f"scan of {n}", 1e3 * spent, "ms", SCAN_BUDGET_MS if n == max(TEAMMATES) else None)


class Hovering:
    """A drone that sees five others. announced: whether they are its teammates."""

    def __init__(self, *, announced: bool) -> None:
        self.onboard = lone_onboard(
            CAMERA,
            create_tracker(DEFAULT_TRACKER, camera=CAMERA, **AGENT_PARAMETERS),
            ego=EgoHistory(origin=np.zeros(3)),
            relative=RelativeParameters(airframe_span_m=SPAN_M),
        )
        self.t = 0.0
        self._chance = np.random.default_rng(1)
        self._pixels, _, _ = CAMERA.project(places(IN_VIEW) @ BODY_FROM_FORWARD_CAMERA)
        self._numbers = count()
        self.onboard.tell(FlightState(0.0, -60.0))
        self._pose()
        for i, place in enumerate(places(IN_VIEW) if announced else ()):
            start = Announcement(i + 2, "0000000a", 0, 0.0, 0.0, place, np.eye(3), 0.01 * np.eye(3))
            self.onboard.tell(start)
        for k in range(1, int(WARM_UP_S * POSE_HZ)):
            self.t = k / POSE_HZ
            self._pose()
            if k % round(POSE_HZ / FPS) == 0:
                self._scan()
            self.onboard.events()

    def fly_on(self) -> None:
        """A hundredth of a second goes by; every other time a pose comes, and now and then a scan."""
        number = next(self._numbers)
        self.t += 1.0 / PUBLISH_HZ
        if number % round(PUBLISH_HZ / POSE_HZ) == 0:
            self._pose()
        if number % round(PUBLISH_HZ / FPS) == 0:
            self._scan()
        self.onboard.events()

    def tracks(self) -> TrackList:
        """As of some milliseconds after the last pose."""
        return self.onboard.tracks(self.t + 4e-3)

    def message(self) -> bytes:
        """As it goes over the network."""
        return codec.encode(tracks_message(self.tracks(), 1, 0.0, 1e-3))

    def _pose(self) -> None:
        position = 0.01 * self._chance.standard_normal(3)
        self.onboard.tell(EgoPose(t=self.t, position=position, world_from_body=np.eye(3)))
        self.onboard.tell(ImuSample(self.t, np.zeros(3), np.full(3, np.nan)))

    def _scan(self) -> None:
        centre = self._pixels + self._chance.standard_normal((IN_VIEW, 2))
        size = np.tile([30.0, 12.0], (IN_VIEW, 1))
        self.onboard.tell(Detections(self.t, int(1e3 * self.t), centre, size, np.full(IN_VIEW, 0.9)))


def publishing(repeats: int) -> list[Figure]:
    """Of five teammates, beside five that are nobody."""
    spent = {}
    for announced in (False, True):
        drone = Hovering(announced=announced)
        placed = [entry.relative is not None for entry in drone.tracks().tracks]
        assert placed == [announced] * IN_VIEW, "tracks are what this is to measure"
        durations = []
        for _ in range(repeats):
            drone.fly_on()
            began = time.process_time_ns()
            drone.message()
            durations.append(time.process_time_ns() - began)
        spent[announced] = 1e-6 * float(np.mean(durations))
    metres, per_second = spent[True] - spent[False], f"metres in {PUBLISH_HZ:g} messages per second"
    return [
        Figure(f"message with {IN_VIEW} tracks that are nobody", spent[False], "ms"),
        Figure(f"message with {IN_VIEW} teammates in metres", spent[True], "ms"),
        Figure("metres in a message", metres, "ms", PUBLISH_BUDGET_MS),
        Figure(per_second, 0.1 * PUBLISH_HZ * metres, "%", 1.0),
    ]


def measured(args: argparse.Namespace) -> list[Figure]:
    """Everything."""
    repeats = QUICK_REPEATS if args.quick else REPEATS
    few = max(repeats // 10, 20)
    return [
        *(reading(n, repeats) for n in TEAMMATES),
        *(scanning(n, few) for n in TEAMMATES),
        *publishing(repeats),
    ]
