"""One flight on errands, judged scan by scan: offsets taken up, names, distances, and how soon named again.

A name is judged by what the camera saw when it exposed, a distance by the time that the drone gives to the scan. A
clock that is 70 ms off shifts every track of a camera that turns. That is an error of place, and counts as one; the
track is still on its drone, and so is the name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from swarmtrack.benchmarks.identity.recognition import SwarmJudge
from swarmtrack.benchmarks.virtual_swarm import ObservedScan, VirtualSwarm
from swarmtrack.lab.scenarios.scenario import Scenario
from swarmtrack.lab.score.swarm_score import GRACE, SwarmScore, confirmed_tracks
from swarmtrack.lab.score.swarm_truth import TrueView
from swarmtrack.messages import Array, TrackStatus
from swarmtrack.motion.time_offset import CameraClock

CLOSE_S = 3e-3  # within which an offset counts as found
TURNING_PX_S = 100.0
NEAR_PX = 35.0
HIT_PX = 15.0  # a detection further off than this, and than half the box, is of something else
BORDER_PX = 8.0
AWAY_S = 2.0
NIS_EVERY_S = 5.0
SIGMAS = 3.0


class Adopted(NamedTuple):
    """An offset that was taken into use: its error and its own σ then, s."""

    t: float
    error_s: float
    sigma_s: float

    @property
    def off(self) -> bool:
        return abs(self.error_s) > SIGMAS * self.sigma_s


@dataclass(slots=True)
class ClockRecord:
    """What one camera clock said, scan by scan. true_s: the offset that is right."""

    true_s: float
    turns_from: float
    adopted: list[Adopted] = field(default_factory=list)
    right_since: float = math.inf
    """World time since when what is used is right; inf while it is not."""
    _claims: dict[float, float] = field(default_factory=dict)
    _settled: float = 0.0
    _last: float = 0.0

    def add_sample(self, t: float, clock: CameraClock) -> None:
        if clock.found is not None:
            self._claims[clock.found.offset_s] = clock.found.sigma_s
        used = clock.used_s
        # It moves there by and by; what it has reached it stays at.
        if used == self._last and used != self._settled:
            self._settled = used
            if used in self._claims:
                self.adopted.append(Adopted(t, used - self.true_s, self._claims[used]))
        self._last = used
        if abs(used - self.true_s) > CLOSE_S:
            self.right_since = math.inf
        elif self.right_since == math.inf:
            self.right_since = t

    @property
    def found_after_s(self) -> float:
        return max(self.right_since - self.turns_from, 0.0)


@dataclass(slots=True)
class Stay:
    """A teammate in an observer's view, after it had been named and out of view for `AWAY_S`."""

    since: float
    detected: float = math.inf
    named: float = math.inf


@dataclass(slots=True)
class Acquaintance:
    """One observer and one teammate."""

    known: bool = False
    last_seen: float = math.inf
    stay: Stay | None = None


@dataclass(slots=True)
class Squares:
    """Squared distances to the nearest track, px²."""

    calm: list[float] = field(default_factory=list)
    turning: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class FlightRecord:
    """What came of one flight.

    names: that were on a track in a scan; names_elsewhere: those on a track further than `NEAR_PX` from their drone;
    names_on_others: those of them whose track is detected there, and so is a ghost or another drone; surest_on_others:
    the highest probability that was stated with one of these, NaN where there are none.
    named_again_s: infinite where it never came. nis: over what is expected. whole, settled: of the whole flight, and
    once the offset was right.
    """

    seed: int
    drones: int
    fps: float
    score: SwarmScore
    clocks: dict[int, ClockRecord]
    names: int
    names_elsewhere: int
    names_on_others: int
    surest_on_others: float
    named_again_s: list[float]
    nis: list[float]
    whole: Squares
    settled: Squares
    announcements_per_drone: float


class FlightJudge:
    """Takes the scans of a flight as they come."""

    def __init__(self, scenario: Scenario, swarm: VirtualSwarm) -> None:
        self._swarm = swarm
        self._judge = SwarmJudge(swarm, scenario, scenario.seconds)
        self._truth = self._judge.truth
        self._camera = scenario.camera
        self._nis_judged: dict[int, int] = {}
        self._pairs: dict[tuple[int, int], Acquaintance] = {}
        self._scans: list[tuple[int, float, bool, float]] = []
        self._names = self._elsewhere = self._on_others = 0
        self._surest_on_others = math.nan
        self.nis: list[float] = []
        self.named_again: list[float] = []
        turns = dict.fromkeys(scenario.members, math.inf)
        for event in scenario.events:
            if not event.words.startswith("takes off"):
                turns[event.drone_id] = min(turns[event.drone_id], event.t)
        self.clocks = {d: ClockRecord(-swarm.stamps_late(d), turns[d]) for d in scenario.members}

    def add_scan(self, scan: ObservedScan) -> None:
        onboard = self._swarm.onboard(scan.observer)
        clock = onboard.cameras[0].clock
        record = self.clocks[scan.observer]
        record.add_sample(scan.t, clock)
        self._distances(scan, self._truth.view(scan.observer, scan.t))
        shown = self._truth.view(scan.observer, scan.exposed_t)
        self._judge.add_scan(scan, scan.exposed_t)
        self._names_elsewhere(scan, shown)
        for drone_id in self.clocks:
            if drone_id != scan.observer:
                self._meet(scan, drone_id, shown)
        period = int(scan.t // NIS_EVERY_S)
        consistency = onboard.cameras[0].tracker.consistency
        if scan.t > record.turns_from and period != self._nis_judged.get(scan.observer) and consistency:
            self._nis_judged[scan.observer] = period
            self.nis.append(2.0 * consistency.nis / (consistency.low + consistency.high))

    def record(self, seed: int, fps: float) -> FlightRecord:
        whole, settled = Squares(), Squares()
        for observer, t, turning, square in self._scans:
            for squares in (whole, settled) if t >= self.clocks[observer].right_since else (whole,):
                (squares.turning if turning else squares.calm).append(square)
        for acquaintance in self._pairs.values():
            self._leave(acquaintance, math.inf)
        return FlightRecord(
            seed,
            len(self.clocks),
            fps,
            self._judge.scorer.score(),
            self.clocks,
            self._names,
            self._elsewhere,
            self._on_others,
            self._surest_on_others,
            self.named_again,
            self.nis,
            whole,
            settled,
            self._swarm.announcements / len(self.clocks),
        )

    def _distances(self, scan: ObservedScan, view: TrueView) -> None:
        tracks = np.array([(track.u, track.v) for track in confirmed_tracks(scan.tracks)]).reshape(-1, 2)
        soon = self._truth.view(scan.observer, scan.t + 0.02)
        for drone_id, box in view.in_view.items():
            if not self._well_inside(box) or drone_id not in soon.in_view or not len(tracks):
                continue
            nearest = float(np.hypot(*(tracks - box[:2]).T).min())
            speed = float(np.hypot(*(soon.in_view[drone_id][:2] - box[:2]))) / 0.02
            if nearest < NEAR_PX:
                self._scans.append((scan.observer, scan.t, speed > TURNING_PX_S, nearest**2))

    def _names_elsewhere(self, scan: ObservedScan, view: TrueView) -> None:
        """Teammates' names on tracks that are far from where that teammate is, in the image or beside it."""
        boxes = {**view.in_view, **view.hidden}
        for named in scan.tracks.tracks:
            track, name = named.track, named.identity
            if track.status is not TrackStatus.CONFIRMED or not isinstance(name, int):
                continue
            self._names += 1
            box = boxes.get(name)
            if box is not None and math.hypot(track.mean[0] - box[0], track.mean[2] - box[1]) <= NEAR_PX:
                continue
            self._elsewhere += 1
            if track.coasting_since is None:
                self._on_others += 1
                self._surest_on_others = float(np.fmax(self._surest_on_others, named.identity_probability))

    def _meet(self, scan: ObservedScan, drone_id: int, view: TrueView) -> None:
        """Is it named, detected, back, or away?"""
        pair = self._pairs.setdefault((scan.observer, drone_id), Acquaintance())
        box = view.in_view.get(drone_id)
        if box is None or not self._well_inside(box):
            self._leave(pair, scan.t)
            return
        radius = max(HIT_PX, 0.5 * float(box[2:].max()))
        if pair.stay is None and pair.known and scan.t - pair.last_seen >= AWAY_S:
            pair.stay = Stay(scan.t)
        pair.last_seen = scan.t
        named = any(
            track.identity == drone_id and math.hypot(track.u - box[0], track.v - box[1]) <= radius
            for track in confirmed_tracks(scan.tracks)
        )
        pair.known |= named
        if pair.stay is not None:
            if bool((np.hypot(*(scan.centres - box[:2]).T) <= radius).any()):
                pair.stay.detected = min(pair.stay.detected, scan.t)
            if named:
                pair.stay.named = scan.t
                self._leave(pair, scan.t)

    def _leave(self, pair: Acquaintance, t: float) -> None:
        stay, pair.stay = pair.stay, None
        if stay is None:
            return
        # A coasting track may have its name before the detector sees it.
        begins = min(stay.detected, stay.named)
        if stay.named < math.inf or pair.last_seen - begins >= GRACE:
            self.named_again.append(stay.named - begins)

    def _well_inside(self, box: Array) -> bool:
        u, v = box[:2]
        camera = self._camera
        return bool(BORDER_PX < u < camera.width - BORDER_PX and BORDER_PX < v < camera.height - BORDER_PX)
