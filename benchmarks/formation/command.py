"""What a formation's command costs, and whether it stays sound whatever it is told.

* Cost: `Formation.command` with its barrier, of 1, 5, 10 and 20 tracks that are all near enough to be kept clear of,
  half of which it would fly into. Processor time, median.
* Soundness: as many random states as `--states` says (`any_states.py`), each told twice: answers are numbers within the
  limits, and the same both times. Every fifth is one in which all others are too near: no command closes in on any of
  them faster than standing, or flying on, would.

    swarmtrack bench formation-command [--states N] [--quick] --out DIR
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtrack.arguments import count
from swarmtrack.benchmarks import report
from swarmtrack.benchmarks.command_line import add_common
from swarmtrack.benchmarks.formation.any_states import (
    HEIGHT_M,
    SLOTS,
    Squeezes,
    Stories,
    Story,
    closes_in,
    wrong_with,
)
from swarmtrack.benchmarks.relative_cost import median_cpu
from swarmtrack.formation.formation import Formation
from swarmtrack.formation.parameters import FormationParameters
from swarmtrack.formation.setpoint import OwnFlight, Setpoint
from swarmtrack.messages import IdentifiedTrack, RelativeState, Track, TrackStatus

NAME = "formation-command"
TRACKS = (1, 5, 10, 20)
BUDGET_MS = 0.3
BUDGET_TRACKS = 10
REPEATS, QUICK_REPEATS = 3000, 300
STATES, QUICK_STATES = 1_000_000, 20_000
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
        seen = Track(
            k, 0.0, np.zeros(4), np.eye(4), TrackStatus.CONFIRMED, 1.0, np.full(2, 20.0), coasting_since=None
        )
        tracks.append(IdentifiedTrack(seen, 1 if k == 0 else None, 0.999 if k == 0 else 0.0))
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
    return 1e3 * median_cpu(lambda: formation.command(states, own, tracks, next(times)), repeats)


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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_common(parser)
    parser.add_argument(
        "--states",
        type=count,
        metavar="N",
        help=f"random states (default: {STATES}; with --quick {QUICK_STATES})",
    )


def run(args: argparse.Namespace) -> None:
    states = args.states or (QUICK_STATES if args.quick else STATES)
    publish(args.out, QUICK_REPEATS if args.quick else REPEATS, -(-states // STATES_OF_A_STORY))


def publish(out: Path, repeats: int, stories: int) -> dict[str, Any]:
    """Measure, write formation-command.json and .md into `out`, and return what is in the JSON."""
    costs = {}
    with report.progress(NAME, len(TRACKS) + 1) as advance:
        for n in TRACKS:
            costs[n] = cost(n, repeats)
            advance(f"{n} tracks")
        found = soundness(stories)
        advance("random states")
    result = {"cost_ms": {str(n): value for n, value in costs.items()}, "soundness": found._asdict()}
    report.write(out, NAME, result, _markdown(costs, found))
    return result


def _markdown(costs: dict[int, float], found: Soundness) -> str:
    rows = [
        [str(n), f"{value:.3f} ms", f"{BUDGET_MS} ms" if n == BUDGET_TRACKS else ""]
        for n, value in costs.items()
    ]
    words = (
        f"Of {found.states} random states {found.unsound} answers were not sound and {found.answers_unlike} were not "
        f"the same again. Of {found.squeezed} in which all others were too near {found.closing_in} closed in on "
        "somebody without need."
    )
    return "\n\n".join(
        [
            "# What a formation's command costs",
            report.table(["tracks", "found", "at most"], rows),
            words,
            *found.wrong,
        ]
    )
