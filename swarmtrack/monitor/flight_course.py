"""A recorded flight as series over time, for plots: places, distances and names as told, and the truth where known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from swarmtrack.messages import Array, Identity
from swarmtrack.monitor.recorded import read_timeline
from swarmtrack.monitor.timeline import Timeline
from swarmtrack.recording.merge import utc_offset
from swarmtrack.recording.reader import FLIGHT_PLAN, recordings_below
from swarmtrack.runtime.swarm_recorder import TRUTH_TOPIC, read_truth
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.wire import codec
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.sightings import SightingsMessage, is_from_nowhere
from swarmtrack.wire.tracks import TracksMessage

LOOKS_HZ = 5.0  # of an observer's tracks: what a plot can show


class SeenTeammate(NamedTuple):
    """One confirmed track at an instant, s from the beginning. position: of its teammate from the observer's camera,
    m in team axes (NED), and sigma: of its distance, m; None while unknown."""

    t: float
    identity: Identity
    position: Array | None
    sigma: float


@dataclass(slots=True)
class FlightCourse:
    """By drone. places, truth: rows of t [s from the beginning], north, east, down [m]; truth is empty where unknown.

    notes: what is wrong with the recording.
    """

    team: str
    seconds: float
    places: dict[int, Array]
    seen: dict[int, list[SeenTeammate]] = field(default_factory=dict)
    truth: dict[int, Array] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def true_place(self, drone_id: int, t: float) -> Array | None:
        """None where it is not known at that time."""
        rows = self.truth.get(drone_id)
        if rows is None or not rows[0, 0] <= t <= rows[-1, 0]:
            return None
        return np.array([np.interp(t, rows[:, 0], rows[:, k]) for k in (1, 2, 3)])

    def true_offset(self, observer: int, one: SeenTeammate) -> Array | None:
        """True position of a named teammate from its observer, m."""
        if not isinstance(one.identity, int):
            return None
        here, there = self.true_place(observer, one.t), self.true_place(one.identity, one.t)
        return None if here is None or there is None else there - here


def read_course(paths: Sequence[Path]) -> FlightCourse:
    """Raises RecordingError where nothing of it can be drawn."""
    timeline = read_timeline(paths)
    course = FlightCourse(timeline.team, timeline.seconds, _places(timeline), notes=timeline.notes)
    for drone_id in sorted(timeline.tracked):
        course.seen[drone_id] = _seen(timeline, drone_id)
    course.truth = _truth(paths, timeline.begin)
    return course


def _places(timeline: Timeline) -> dict[int, Array]:
    rows: dict[int, list[tuple[float, ...]]] = {}
    for event in timeline.events:
        address = None if event.sample is None else keys.parse(event.sample.key)
        if address is None or event.sample is None or address.kind is not Kind.IDENTITIES:
            continue
        try:
            message = codec.decode(SightingsMessage, event.sample.payload)
        except DecodeError:
            continue
        if not is_from_nowhere(message):
            t = event.t - timeline.begin - message.age_s
            rows.setdefault(address.drone_id, []).append((t, *message.position_m))
    return {drone_id: np.array(sorted(of)) for drone_id, of in sorted(rows.items())}


def _seen(timeline: Timeline, drone_id: int) -> list[SeenTeammate]:
    """A few times a second: what was newest then."""
    found: list[SeenTeammate] = []
    for t in np.arange(0.0, timeline.seconds, 1.0 / LOOKS_HZ):
        message = timeline.newest_tracks(drone_id, timeline.begin + float(t), max_age=1.0 / LOOKS_HZ)
        if message is not None:
            found += _of_message(message, message.t_utc_s - timeline.begin)
    return found


def _of_message(message: TracksMessage, t: float) -> list[SeenTeammate]:
    relatives = {relative.track_id: relative for relative in message.relatives}
    seen = []
    for track in message.tracks:
        if track.status != "confirmed":
            continue
        relative, position, sigma = relatives.get(track.id), None, np.nan
        if relative is not None:
            position = np.array(relative.position_m)
            sigma = relative.range_sigma_log * float(np.linalg.norm(position))
        seen.append(SeenTeammate(t, track.identity, position, sigma))
    return seen


def _truth(paths: Sequence[Path], begin: float) -> dict[int, Array]:
    """As a simulation recorded it."""
    for recording in recordings_below(*paths):
        if not recording.is_simulated_flight:
            continue
        epoch = recording.attached(FLIGHT_PLAN)["epoch_s"] + utc_offset(recording) - begin
        rows: dict[int, list[tuple[float, ...]]] = {}
        for message in recording.messages({TRUTH_TOPIC}):
            true = read_truth(message)
            rows.setdefault(true.drone_id, []).append((epoch + true.t_s, *true.position_m))
        return {drone_id: np.array(sorted(of)) for drone_id, of in sorted(rows.items())}
    return {}
