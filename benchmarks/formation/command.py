"""What a formation's command costs, and whether it stays sound whatever it is told.

* Cost: `Formation.command` with its barrier, of 1, 5, 10 and 20 tracks that are all near enough to be kept clear of,
  half of which it would fly into. Processor time, median.
* Soundness: as many random states as `--states` says (`any_states.py`), each told twice: answers are numbers within the
  limits, and the same both times. Every fifth is one in which all others are too near: no command closes in on any of
  them faster than standing, or flying on, would.

Both are parts of `swarmtrack bench cost --of command`.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from typing import NamedTuple

import numpy as np

from swarmtrack.benchmarks.figures import Figure, median_s
from swarmtrack.benchmarks.formation.any_states import (
    HEIGHT_M,
    SLOTS,
    Squeezes,
    Stories,
    Story,
    closes_in,
    seen_track,
    wrong_with,
)
from swarmtrack.formation.formation import Formation
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import OwnFlight, Setpoint
from swarmtrack.messages import RelativeState

TRACKS = (1, 5, 10, 20)
BUDGET_MS = 0.3
BUDGET_TRACKS = 10
REPEATS, QUICK_REPEATS = 3000, 300
STATES_OF_A_STORY = 1000
SQUEEZED_EVERY = 5
# m/s
SLACK_M_S = 1e-6


class Soundness(NamedTuple):
    """Of random states; squeezed: so many with all others too near; closing_in: answers to those that closed in on
    somebody without need; wrong: the first few that were not sound, in words."""

    states: int
    squeezed: int
    answers_unlike: int
    unsound: int
    closing_in: int
    wrong: list[str]


def crowd(n: int) -> Story:
    """The leader and n - 1 others within 4 m, each on its way here."""
    chance = np.random.default_rng(n)
    own = OwnFlight((-4.0, 3.0, -1.0 - HEIGHT_M), (0.5, 0.0, 0.0), -0.6)
    states, tracks = {}, []
    for k in range(n):
        away = np.array([4.0, -3.0, 1.0]) if k == 0 else chance.uniform(-1.8, 1.8, 3)
        speed = -0.1 * away
        states[k] = RelativeState(k + 1, 0.0, away, speed, 0.01 * np.eye(6), 0.05, ("size",))
        tracks.append(seen_track(k, 0.0, 1 if k == 0 else None))
    return states, own, tracks, 0.0


def cost(n: int, repeats: int) -> float:
    """ms of processor time that a command takes with n tracks."""
    formation = Formation(
        FormationParameters(drone_id=2, leader=1, slots=SLOTS, references=(1,), height=HEIGHT_M)
    )
    states, own, tracks, _ = crowd(n)
    times = (0.1 * k for k in itertools.count())
    for _ in range(20):
        formation.command(states, own, tracks, next(times))
    return 1e3 * median_s(
        lambda: formation.command(states, own, tracks, next(times)), repeats, time.process_time
    )


def soundness(stories: int) -> Soundness:
    """Of so many stories of `STATES_OF_A_STORY` states each."""
    squeezed = unlike = unsound = closing_in = 0
    wrong: list[str] = []
    for seed in range(stories):
        is_squeezed = seed % SQUEEZED_EVERY == 0
        told = Squeezes(seed) if is_squeezed else Stories(seed)
        one, again = Formation(told.parameters), Formation(told.parameters)
        before: Setpoint | None = None
        for story in itertools.islice(told, STATES_OF_A_STORY):
            setpoint = one.command(*story)
            unlike += again.command(*story) != setpoint
            words = wrong_with(setpoint, told.parameters.limits, before)
            unsound += bool(words)
            if is_squeezed:
                squeezed += 1
                faster = closes_in(setpoint, before, story)
                if faster > SLACK_M_S:
                    closing_in += 1
                    words = words or f"closes in {faster:.3f} m/s faster than it need"
            if words:
                wrong = [*wrong, f"story {seed}: {words}"][:5]
            before = setpoint
    return Soundness(stories * STATES_OF_A_STORY, squeezed, unlike, unsound, closing_in, wrong)


def measured(args: argparse.Namespace) -> list[Figure]:
    """Of so many tracks, and of --states random states."""
    repeats = QUICK_REPEATS if args.quick else REPEATS
    costs = [
        Figure(
            f"a command with {n} tracks", cost(n, repeats), "ms", BUDGET_MS if n == BUDGET_TRACKS else None
        )
        for n in TRACKS
    ]
    found = soundness(-(-args.states // STATES_OF_A_STORY))
    if found.wrong:
        print(*found.wrong, sep="\n", file=sys.stderr)
    return [
        *costs,
        Figure(f"of {found.states} random states, answers that were not sound", found.unsound, "", 0.0),
        Figure("… that were not the same again", found.answers_unlike, "", 0.0),
        Figure(
            f"of {found.squeezed} with all others too near, answers that closed in without need",
            found.closing_in,
            "",
            0.0,
        ),
    ]
