"""Recordings into what the monitor plays.

Theory of operation. What was heard of a swarm is played as it was heard. Where there is only what drones recorded
themselves, what they said is made again of it: their health as it is, whom they see as their teammates heard it (or,
where no teammate recorded, from their tracks and poses), and announcements as they heard them. Pictures, lenses and
tracks come from the drones' own recordings where there are any, else from what was heard. Each drone's clock is laid on
the first recording's as `swarmtrack log merge` does, by the numbers of what was said.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import msgspec

from swarmtrack.errors import RecordingError
from swarmtrack.monitor.own_recording import DroneRecording
from swarmtrack.monitor.team import DRONE_SILENT_S
from swarmtrack.monitor.timeline import BlobFile, HeardWords, Timeline, TimelineEvent, Tracked
from swarmtrack.recording.merge import SightingTimes, shifts_by, utc_offset
from swarmtrack.recording.reader import Recording, recordings_below
from swarmtrack.runtime.swarm_recorder import HEARD_TOPIC, read_heard
from swarmtrack.transport import keys
from swarmtrack.transport.base import Kind
from swarmtrack.wire import codec
from swarmtrack.wire.checks import DecodeError
from swarmtrack.wire.sightings import SightingsMessage

FLIGHTS_APART_S = 60.0  # s without a word of anybody: what comes after it is another flight


def read_timeline(paths: Sequence[Path]) -> Timeline:
    """Raises RecordingError where nothing of it can be played, and ConfigError for the config of another version."""
    recordings = recordings_below(*paths)
    recordings.sort(key=lambda recording: recording.kind == "drone")  # a swarm's clock is everybody's
    where = ", ".join(map(str, paths))
    teams = sorted({recording.preface.get("team", "") for recording in recordings})
    if len(teams) > 1:
        raise RecordingError(
            f"{where}: holds recordings of the teams {', '.join(teams)}, expected those of one"
        )
    blob_file = BlobFile()
    swarms = [_SwarmRecording(r, blob_file) for r in recordings if r.kind == "swarm"]
    drones = [DroneRecording(r, blob_file) for r in recordings if r.kind == "drone"]
    sources: list[_SwarmRecording | DroneRecording] = [*swarms, *drones]
    try:
        offsets = [utc_offset(recording) for recording in recordings]
    except (KeyError, ValueError):
        raise RecordingError(f"{where}: a recording has no time of its beginning, expected utc_s") from None
    for source in sources:
        source.read()
    moved = [shift.seconds for shift in shifts_by([source.hearsay for source in sources], offsets)]
    events: list[TimelineEvent] = []
    tracked: dict[int, list[Tracked]] = {}
    ends: list[TimelineEvent] = []
    recorded = {own.drone_id for own in drones}
    lives = {(own.drone_id, own.boot) for own in drones}
    for heard, shift in zip(swarms, moved, strict=False):
        events += heard.events(shift, recorded)
        for drone_id, told in heard.tracked.items():
            told.shift = shift
            if drone_id not in recorded:
                tracked.setdefault(drone_id, []).append(told)
    heard_of = set().union(*(own.observers for own in drones))
    for own, shift in zip(drones, moved[len(swarms) :], strict=True):
        events += own.views(shift)
        own.tracked.shift = shift
        tracked.setdefault(own.drone_id, []).append(own.tracked)
        if not swarms:
            events += own.events(shift, lives=lives, says_itself=own.drone_id not in heard_of)
            ends += filter(None, [own.departure(shift)])
    end = max((event.t for event in events), default=0.0)
    events += [
        event for event in ends if event.t < end - DRONE_SILENT_S
    ]  # later ones ended with the recording
    events.sort(key=lambda event: event.t)
    notes = [sentence for recording in recordings for sentence in recording.damage]
    if refused := sum(source.refused for source in sources):
        notes.append(f"{where}: {refused} records cannot be read and are left out")
    if not events:
        raise RecordingError(
            "; ".join([f"{where}: holds no message of any drone, expected the recording of a flight", *notes])
        )
    notes += _drop_all_but_the_last_flight(events, where)
    return Timeline(teams[0], events, tracked, blob_file, notes)


def _drop_all_but_the_last_flight(events: list[TimelineEvent], where: str) -> list[str]:
    """A note if there were several."""
    begins = [
        k for k, (one, next_one) in enumerate(pairwise(events), 1) if next_one.t - one.t > FLIGHTS_APART_S
    ]
    if not begins:
        return []
    del events[: begins[-1]]
    return [f"{where}: holds {len(begins) + 1} flights, plays the last; name the folder of another for it"]


class _SwarmRecording:
    """What `swarmtrack record` and `sim --record` heard."""

    def __init__(self, recording: Recording, blob_file: BlobFile) -> None:
        self.hearsay = SightingTimes()
        self.refused = 0
        self._words = HeardWords(blob_file)
        self.tracked = self._words.tracked
        self._recording = recording
        self._events: list[tuple[keys.Address, TimelineEvent]] = []

    def read(self) -> None:
        offset = utc_offset(self._recording)
        for message in self._recording.messages({HEARD_TOPIC}):
            try:
                heard = read_heard(message)
                address = keys.parse(heard.key)
                if address is None:
                    continue
                if address.kind is Kind.IDENTITIES:
                    said = codec.decode(SightingsMessage, heard.payload)
                    self.hearsay.received[said.drone_id, said.boot, said.sequence] = heard.t - said.age_s
                self._events.append((address, self._words.event(heard.sample, address, heard.t + offset)))
            except (RecordingError, DecodeError, msgspec.MsgspecError):
                self.refused += 1

    def events(self, shift: float, seen_by_themselves: set[int]) -> Iterator[TimelineEvent]:
        """But the views of those who recorded them themselves."""
        for address, event in self._events:
            if address.kind is not Kind.VIDEO or address.drone_id not in seen_by_themselves:
                yield _shifted(event, shift)


def _shifted(event: TimelineEvent, shift: float) -> TimelineEvent:
    """On another clock."""
    t = event.t + shift
    sample = event.sample and event.sample._replace(arrived=t)
    return event._replace(t=t, sample=sample)
