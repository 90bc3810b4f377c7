"""How high a drone says that it is above a teammate, against what its camera measures.

A barometer drifts, and the autopilot follows it without knowing. The camera sees it: the elevation of a teammate times
its distance is a height that no barometer had a part in. Here both are subtracted, scan by scan; what it means over
time is told by `formation/heights.py`.

The rays are those of raw detections, by the own attitude: a relative place that was filtered has taken what teammates
say as evidence, and hides what is looked for. Its distance serves as the lever alone.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

from swarmtrack.messages import MotionReport, RelativeState, SightingReport
from swarmtrack.relative.looks import TeamLook
from swarmtrack.relative.priors import (
    HEIGHT_ACCELERATION_SIGMA_M_S2,
    HEIGHT_CARRIED_S,
    HEIGHT_JITTER_M,
    HEIGHT_REPORTS_KEPT_S,
    HEIGHT_SPEED_SIGMA_M_S,
)


class HeightSight(NamedTuple):
    """One teammate in one scan, at t [s].

    off [m]: how high this drone says that it is above the teammate, less how high its camera has it. That is an unknown
    constant, and what has drifted. word: whose, and of which kind; the constant of each is its own. sigma [m]: of this
    scan alone. level [m]: level distance, by which an error of the own tilt [rad] counts; lever [m]: by how much an
    error of the distance of one sigma does. said [m]: the height that the teammate reports, as in `off`.
    range_sigma_log: of the distance, as a share: what was learned of it since an earlier scan has changed its error.
    """

    drone_id: int
    word: str
    t: float
    off: float
    sigma: float
    level: float
    lever: float
    said: float = 0.0
    range_sigma_log: float = 1.0


class _Word(NamedTuple):
    """t, t_sigma [s]; height [m], from anywhere; climb [m/s], None where it was not said."""

    t: float
    t_sigma: float
    height: float
    climb: float | None = None


class SaidHeights:
    """Reported heights of teammates; `sights` compares them with a scan."""

    def __init__(self) -> None:
        self._moved: dict[int, tuple[str, deque[_Word]]] = {}
        self._placed: dict[int, tuple[str, deque[_Word]]] = {}

    def hear_motion(self, said: MotionReport) -> None:
        """How far a teammate is from where it was first known to be, several times per second."""
        word = _Word(said.t, said.t_sigma, -float(said.displacement[2]), -float(said.velocity[2]))
        _remember(self._moved, said.drone_id, f"{said.boot} moved", word)

    def hear_sightings(self, said: SightingReport) -> None:
        """Where a teammate stands, once a second."""
        word = _Word(said.t, said.t_sigma, -float(said.position[2]))
        _remember(self._placed, said.observer, f"{said.boot} placed", word)

    def remove(self, drone_id: int) -> None:
        """Drop all reports under this ID."""
        self._moved.pop(drone_id, None)
        self._placed.pop(drone_id, None)

    def sights(self, look: TeamLook, states: Mapping[int, RelativeState]) -> tuple[HeightSight, ...]:
        """Height sights of a scan: teammates detected in it with a reported height. states: by track, at that time."""
        sights = []
        for i, (drone, track) in enumerate(look.keys):
            state = states.get(track)
            north, east, down = look.ray[i].tolist()
            if state is None or state.drone_id != drone or not math.isfinite(down):
                continue
            said = self._said(drone, look.t)
            if said is None:
                continue
            word, height, sigma = said
            distance = math.hypot(*state.position.tolist())
            off = -float(look.camera[2]) - height - distance * down
            ray_sigma = distance * math.sqrt(max(float(look.ray_cov[i, 2, 2]), 0.0))
            sights.append(
                HeightSight(
                    drone,
                    word,
                    look.t,
                    off,
                    math.hypot(sigma, ray_sigma, HEIGHT_JITTER_M),
                    distance * math.hypot(north, east),
                    distance * abs(down) * state.range_sigma_log,
                    height,
                    state.range_sigma_log,
                )
            )
        return tuple(sights)

    def _said(self, drone: int, t: float) -> tuple[str, float, float] | None:
        """The word, the height at t [m] and its sigma; None where nothing said is near enough. Its motion tells more
        than its places."""
        for heard in (self._moved, self._placed):
            kind, words = heard.get(drone, ("", ()))
            near = min(words, key=lambda word: abs(word.t - t), default=None)
            if near is None or abs(near.t - t) > HEIGHT_CARRIED_S:
                continue
            age = t - near.t
            climb = 0.0 if near.climb is None else near.climb
            speed = (
                HEIGHT_SPEED_SIGMA_M_S
                if near.climb is None
                else 0.5 * HEIGHT_ACCELERATION_SIGMA_M_S2 * abs(age)
            )
            late = abs(climb) * near.t_sigma
            return kind, near.height + climb * age, math.hypot(speed * age, late, HEIGHT_JITTER_M)
        return None


def _remember(heard: dict[int, tuple[str, deque[_Word]]], drone: int, kind: str, word: _Word) -> None:
    known = heard.get(drone)
    if known is None or known[0] != kind:
        known = heard[drone] = kind, deque()
    words = known[1]
    words.append(word)
    while words[0].t < word.t - HEIGHT_REPORTS_KEPT_S:
        words.popleft()
